"""What the library uses of JAX and equinox beyond what they promise exists and behaves as expected."""

import importlib
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxkane._scalarjit import compat as internals
from jaxkane._scalarjit.scalar_function import ScalarFunction

USED = {
    "jax.extend.core": "ClosedJaxpr Jaxpr JaxprEqn Primitive jaxpr_as_fun",
    "jax.interpreters.ad": "Zero instantiate_zeros is_undefined_primal primitive_jvps primitive_transposes",
    "jax.interpreters.batching": "primitive_batchers",
    "jax.interpreters.mlir": "lower_fun register_lowering",
    "jax.interpreters.partial_eval": "dce_jaxpr",
    "jax.experimental.xla_metadata": "set_xla_metadata",
    "jax.experimental.compilation_cache.compilation_cache": "reset_cache",
    "jax.ffi": "ffi_lowering pycapsule register_ffi_target",
    "jax.core": "Tracer eval_context",
    "equinox._errors": "EQX_ON_ERROR",
}


@pytest.mark.parametrize("module", USED)
def test_the_used_interfaces_of_jax_exist(module):
    found = importlib.import_module(module)
    missing = [name for name in USED[module].split() if not hasattr(found, name)]
    assert not missing, f"{module} lacks {', '.join(missing)}"


def test_the_used_interfaces_of_jax_behave_as_expected(by_xla):
    traced = jax.jit(ScalarFunction(lambda x: jnp.sin(x) * 2.0)).trace(0.5)
    text = traced.lower(lowering_platforms=("cpu",)).as_text()
    assert "xla_cpu_small_call" in text
    before = internals.settings()
    with jax.enable_x64(not jax.config.jax_enable_x64):
        assert internals.settings() != before
    assert internals.settings() == before


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["", "--xla_cpu_enable_fast_math=false"])
def test_a_faulty_jax_release_is_corrected_by_xla_flags_on_import(flags):
    code = (
        "import os, jax; jax.__version_info__ = (0, 10, 2); import jaxkane; print(os.environ['XLA_FLAGS']); "
        "assert jax.jit(lambda x: x + 1)(1) == 2; import importlib; importlib.reload(jaxkane); "
        "print(os.environ['XLA_FLAGS'])"
    )
    env = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"} | ({"XLA_FLAGS": flags} if flags else {})
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], env=env, capture_output=True, text=True)
    assert run.stderr == ""
    assert run.stdout.splitlines() == [f"{flags} {internals.NO_FUSIONS}=".strip()] * 2


def test_a_faulty_jax_release_that_is_already_initialized_causes_a_warning(monkeypatch):
    jax.block_until_ready(jnp.zeros(1))
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(jax, "__version_info__", (0, 12, 0))
    internals.switch_off_wrong_fusions()  # which is right
    monkeypatch.setattr(jax, "__version_info__", (0, 11, 0))
    with pytest.warns(UserWarning, match="Import jaxkane before anything is computed"):
        internals.switch_off_wrong_fusions()
    assert os.environ["XLA_FLAGS"] == ""
    monkeypatch.setenv("XLA_FLAGS", f"{internals.NO_FUSIONS}=reduce")
    internals.switch_off_wrong_fusions()  # it is the user's
