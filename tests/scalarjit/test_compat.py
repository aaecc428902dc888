"""What the library uses of JAX and equinox beyond what they promise exists and behaves as expected."""

import importlib
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
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


def test_jaxprs_have_the_expected_structure():
    """A program by its equations, in `interpret`; and what follows from which input."""
    program = jax.make_jaxpr(lambda x, y: (jnp.sin(x) * 2.0 + np.arange(3.0), y))(1.0, 2.0)
    names: list[str] = []

    def rule(equation, xs):
        operation = internals.operation_of(equation)
        names.append(operation.name)
        assert (operation.is_pure, operation.results) == (True, 1)
        return internals.evaluated(equation, xs)

    sums, y = internals.interpret(program, [0.5, 2.0], rule)
    np.testing.assert_allclose(sums, 2.0 * np.sin(0.5) + np.arange(3.0), rtol=1e-15)
    assert (names[:2], y) == (["sin", "mul"], 2.0)
    assert internals.dependencies(program) == [{0}, {1}]
    assert internals.depends_on(program, [0]) == [True, False]
    assert internals.depends_on(program, [1]) == [False, True]
    inner = jax.make_jaxpr(jax.jit(jnp.sin))(1.0).jaxpr.eqns[0]
    assert internals.operation_of(inner).function == "sin"
    assert [len(internals.types_of(p)[0]) for p in internals.programs_in(inner)] == [1]


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
