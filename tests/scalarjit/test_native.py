"""Native kernels: machine code through LLVM gives what XLA gives, in every shape of a batch."""

import re
import textwrap
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from operations import ODD, OPERATIONS

import jaxkane as jk
from jaxkane._scalarjit import llvm, xla
from jaxkane._scalarjit import native as native_kernels
from jaxkane._scalarjit import program as programs
from jaxkane._scalarjit.scalar_function import ScalarFunction

LARGEST = 19


SINGLE = pytest.param(jnp.float32, marks=pytest.mark.weekly)


@pytest.fixture(scope="module", params=[jnp.float64, SINGLE], ids=["float64", "float32"])
def plainly(request):
    """Rows, and every operation of each by plain JAX."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(LARGEST, 3)), request.param)
    return x, jax.jit(jax.vmap(every_operation))(x)


def every_operation(x):
    return {name: operation(x) for name, operation in OPERATIONS.items()}


# A warning that something cannot be part of a function or kernel means that XLA is compared with itself.
@pytest.mark.weekly
@pytest.mark.filterwarnings("error:.*its description uses")
@pytest.mark.parametrize(("kernels", "windows"), [("native", None), ("XLA", None), ("XLA", 0), ("XLA", 1000)])
def test_every_operation_agrees_with_xla(plainly, kernels, windows, monkeypatch):
    """Also if the program is written as reduce windows, short or long ones."""
    if windows is not None:
        monkeypatch.setattr(xla, "_SHORT", 0)
        monkeypatch.setattr(xla, "_LONG", windows)
    x, expected = plainly
    program = ScalarFunction(every_operation)
    assert native_kernels.Scalars(jax.make_jaxpr(every_operation)(x[0])).graph.nodes, "cannot be written as scalars"
    tolerance = 1e-14 if x.dtype == jnp.float64 else 1e-6
    check = lambda a, b: np.testing.assert_allclose(a, b, rtol=20 * tolerance, atol=tolerance)  # noqa: E731
    for n in (1, LARGEST):
        found = jax.jit(jax.vmap(program))(x[:n])
        for name in OPERATIONS:
            jax.tree.map(check, found[name], jax.tree.map(lambda a, n=n: a[:n], expected[name]))


@pytest.mark.weekly_cases(all_but=["native-float32"])
@pytest.mark.filterwarnings("error:.*its description uses")
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32], ids=["float64", "float32"])
def test_nan_and_signed_zeros_agree_with_xla(dtype, kernels):
    """Bit for bit, but for the sign of NaN."""
    x = jnp.array([0.0, -0.0, 1.0, -1.0, jnp.inf, -jnp.inf, jnp.nan], dtype)
    f = lambda x: {name: odd(x) for name, odd in ODD.items()}  # noqa: E731
    expected, found = jax.jit(jax.vmap(f))(x), jax.jit(jax.vmap(ScalarFunction(f)))(x)
    one = jax.jit(ScalarFunction(f))(x[1])
    for name in ODD:
        want, got = np.asarray(expected[name]), np.asarray(found[name])
        np.testing.assert_array_equal(got, want, err_msg=name)
        np.testing.assert_array_equal(one[name], want[1], err_msg=name)
        if want.dtype != bool:
            for a, b in ((got, want), (np.asarray(one[name]), want[1])):
                np.testing.assert_array_equal(np.signbit(a[~np.isnan(a)]), np.signbit(b[~np.isnan(b)]), err_msg=name)


@pytest.mark.slow
@pytest.mark.usefixtures("native")
def test_results_do_not_depend_on_the_position_in_the_batch():
    f = ScalarFunction(lambda x, a: jnp.sin(a * x) / (1.0 + x * x))
    x = jnp.linspace(-1.0, 1.0, LARGEST)
    together = jax.jit(jax.vmap(f, (0, None)))(x, 0.3)
    for n in (9, 16):
        np.testing.assert_array_equal(jax.jit(jax.vmap(f, (0, None)))(x[:n], 0.3), together[:n])


@pytest.mark.slow_cases(all_but=["once-3"])
@pytest.mark.usefixtures("native")
@pytest.mark.parametrize("long", [10_000, 3])
@pytest.mark.parametrize("made", [ScalarFunction, ScalarFunction.compile_cheaply], ids=["optimized", "once"])
def test_a_kernel_of_many_blocks_agrees_with_plain_jax(made, long, native, monkeypatch):
    """What all lanes share, what differs from lane to lane, and both; in the order of the program and depth first."""
    monkeypatch.setattr(llvm, "_BLOCK", 2)
    monkeypatch.setattr(llvm, "_LONG", long)

    def f(a, x):
        shared = jnp.sin(a) * a[::-1] + a**2
        return shared, x * shared - jnp.exp(x), jnp.where(x[0] < shared[1], x, -x)

    a, x = jnp.arange(1.0, 4.0), jnp.linspace(-1.0, 2.0, 57).reshape(19, 3)
    program = made(f)
    for n in (1, 19):
        found, expected = (jax.jit(jax.vmap(g, (None, 0)))(a, x[:n]) for g in (program, f))
        jax.tree.map(lambda got, want: np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-14), found, expected)
    jax.tree.map(lambda got, want: np.testing.assert_allclose(got, want, rtol=1e-14), program(a, x[0]), f(a, x[0]))
    assert program.is_native(a, x[0])


@pytest.mark.slow
def test_batches_of_batches():
    def plain(a, b, x):
        return jnp.stack([jnp.sin(a) * x[0], b * x[1] + a, a / b])

    f = ScalarFunction(plain)
    a, b = jnp.arange(1.0, 4.0), jnp.arange(1.0, 6.0)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(3, 5, 2)))
    for axes in (((0, None, 0), (None, 0, 0)), ((None, 0, 1), (0, None, 0))):  # outer, inner
        of = lambda g, axes=axes: jax.vmap(jax.vmap(g, axes[1]), axes[0])  # noqa: E731
        np.testing.assert_allclose(jax.jit(of(f))(a, b, x), of(plain)(a, b, x), rtol=1e-14)
    only_outer = lambda g: jax.vmap(jax.vmap(g, (None, 0, None)), (0, None, 0))  # noqa: E731
    np.testing.assert_allclose(jax.jit(only_outer(f))(a, b, x[:, 0]), only_outer(plain)(a, b, x[:, 0]), rtol=1e-14)
    assert jax.jit(jax.vmap(f, (0, None, None)))(jnp.zeros(0), 1.0, x[0, 0]).shape == (0, 3)


def test_unsupported_operations_are_left_to_xla(native):
    whole = lambda x: x.astype(jnp.int32).astype(x.dtype)  # noqa: E731
    f = ScalarFunction(lambda x: whole(x) + jnp.sin(x))
    programs.warn_once.cache_clear()
    match = "uses convert_element_type of float64, which native kernels do not support"
    with pytest.warns(UserWarning, match=match) as told:
        found = jax.jit(f)(jnp.array(1.7)), *jax.jit(jax.vmap(f))(jnp.array([1.7, 2.2]))
    np.testing.assert_allclose(found, np.floor([1.7, 1.7, 2.2]) + np.sin([1.7, 1.7, 2.2]))
    assert len(told) == 1


@pytest.mark.usefixtures("native")
def test_kernels_are_stored_in_the_cache_folder_of_jax(tmp_path):
    was = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        f = ScalarFunction(lambda x: jnp.sin(x) * 1.2345678)
        np.testing.assert_allclose(jax.jit(f)(0.5), np.sin(0.5) * 1.2345678)
        kept = list((tmp_path / "jaxkane").glob("jaxkane_*.o"))
        assert len(kept) == 2  # the kernel, and the function that XLA calls
    finally:
        jax.config.update("jax_compilation_cache_dir", was)


@pytest.mark.slow
@pytest.mark.skipif(not native_kernels.is_on(), reason="no native kernels here")
def test_single_precision_without_x64():
    """Numbers that are written in a program are rounded to its type, where JAX keeps them as floats of Python."""
    entry = jk.catalog.CATALOG["DoublePendulum"]
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        clipped = ScalarFunction(lambda x: jnp.clip(x, 0.2, 0.7) * 0.1)
        np.testing.assert_array_equal(jax.jit(clipped)(jnp.float32(0.0)), np.float32(0.2) * np.float32(0.1))
        system = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), entry.example())
        ride = jk.simulate(system, jk.State(entry.q, entry.u), jnp.linspace(0.0, 0.5, 3))
    assert ride.q.dtype == jnp.float32
    assert ride.status == jk.Status.COMPLETED


@pytest.mark.weekly
@pytest.mark.usefixtures("native")
def test_the_commands_of_the_readme_work(capsys, monkeypatch):
    """All backends agree, and the commands for a wrong kernel print what they promise. Tolerance: 1e-12."""
    page = (Path(native_kernels.__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    names, was_wanted = {}, native_kernels.is_wanted()
    monkeypatch.setenv("JAXKANE_NATIVE", "1")  # `native.use` changes it
    try:
        for block in re.findall(r"^ *```python\n(.*?)^ *```", page, re.DOTALL | re.MULTILINE):
            exec(textwrap.dedent(block), names)
    finally:
        native_kernels.use(was_wanted)
    expected = names["found"]["plain JAX"]
    for found in names["found"].values():
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12), tuple(found), tuple(expected))
    text = capsys.readouterr().out
    assert "Node(operation='sub'" in text
    assert "define void @it" in text
