"""Scalar programs as one operation: the same numbers as plain JAX, in every transformation, and no aborted process."""

import functools
import subprocess
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit import program as programs
from jaxkane._scalarjit import xla
from jaxkane._scalarjit.compat import jaxpr_as_fun
from jaxkane._scalarjit.components import add, mul, sub
from jaxkane._scalarjit.jaxpr import cse, tangent_program
from jaxkane._scalarjit.scalar_function import ScalarFunction


def plain(a, b, x):
    s, c = jnp.sin(x[0]), jnp.cos(x[0])
    y = s * a + c * x[1] / jnp.sqrt(b * b + 1.0)
    return jnp.stack([y * s, s * s + c, a + 0.0 * y]), y**3


program = ScalarFunction(plain)
ARGUMENTS = (jnp.array(0.7), jnp.array(-1.2), jnp.array([0.3, 0.9]))


def total(f):
    return lambda *args: f(*args)[0].sum() + f(*args)[1]


TRANSFORMATIONS = {
    "itself": lambda f: f,
    "jit": jax.jit,
    "forward": lambda f: jax.jacfwd(f, argnums=(0, 1, 2)),
    "reverse": lambda f: jax.jacrev(f, argnums=(0, 1, 2)),
    "hessian": lambda f: jax.hessian(total(f), argnums=(0, 2)),
    "reverse of reverse": lambda f: jax.jacrev(jax.grad(total(f), argnums=2), argnums=(0, 2)),
    "linearize": lambda f: lambda *args: jax.linearize(f, *args)[1](*args),
    "batch": lambda f: lambda a, b, x: jax.vmap(f, in_axes=(0, None, 0))(jnp.stack([a, b]), b, jnp.stack([x, 2 * x])),
    "batch of gradients": lambda f: (
        lambda a, b, x: jax.vmap(jax.grad(total(f), argnums=(0, 2)), (None, 0, None))(a, jnp.stack([a, b]), x)
    ),
    "gradient of a batch": lambda f: jax.grad(
        lambda a, b, x: jax.vmap(total(f), in_axes=(None, None, 0))(a, b, jnp.stack([x, 2 * x, 3 * x])).sum(), (0, 1, 2)
    ),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(total(f)), argnums=(0, 2)),
    "in a loop": lambda f: lambda a, b, x: jax.lax.scan(lambda c, _: (f(c, b, x)[1], c), a, length=5),
    "gradient of a loop": lambda f: jax.grad(
        lambda a, b, x: jax.lax.scan(lambda c, _: (f(c, b, x)[1], c), a, length=5)[0], (0, 1, 2)
    ),
}


def chosen(a, b, x):
    y, z = plain(a, b, x)
    return jnp.where(x[0] < a, y, 2.0 * y), z


@functools.cache
def by_plain_jax(name, f=plain):
    return jax.jit(TRANSFORMATIONS[name](f))(*ARGUMENTS)


def assert_equal_trees(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14), found, expected)


@pytest.mark.weekly_cases(all_but=["native-jit-*", "native-eager-itself", "XLA-jit-itself", "XLA-jit-batch"])
@pytest.mark.parametrize("name", TRANSFORMATIONS)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_results_agree_with_plain_jax(name, compiled, kernels):
    ours = TRANSFORMATIONS[name](program)
    assert_equal_trees((jax.jit(ours) if compiled else ours)(*ARGUMENTS), by_plain_jax(name))


@pytest.mark.slow_cases(all_but=["plain-short-*", "plain-long-itself", "chosen-long-jit"])
@pytest.mark.parametrize("name", TRANSFORMATIONS)
@pytest.mark.parametrize(
    ("f", "long"), [(plain, False), (plain, True), (chosen, True)], ids=["plain-short", "plain-long", "chosen-long"]
)
def test_a_program_written_as_reduce_windows_agrees_with_plain_jax(name, f, long, by_xla, monkeypatch):
    monkeypatch.setattr(xla, "_SHORT", 0)
    monkeypatch.setattr(xla, "_LONG", 0 if long else 1000)
    assert_equal_trees(jax.jit(TRANSFORMATIONS[name](ScalarFunction(f)))(*ARGUMENTS), by_plain_jax(name, f))


@pytest.mark.parametrize("name", TRANSFORMATIONS)
@pytest.mark.parametrize("long", [False, True], ids=["short", "long"])
def test_on_a_gpu_a_short_program_is_one_kernel(name, long, monkeypatch):
    monkeypatch.setattr(xla, "_LONG", 0 if long else 1000)
    f = jax.jit(TRANSFORMATIONS[name](ScalarFunction(plain)))
    text = f.trace(*ARGUMENTS).lower(lowering_platforms=("cuda",)).as_text()
    sines, windows = text.count("stablehlo.sine"), text.count("stablehlo.reduce_window")
    assert windows == 0 if long else windows >= sines > 0  # one in each of its programs, that of values or a derivative


def test_an_empty_batch_on_a_gpu():
    f = jax.jit(jax.vmap(ScalarFunction(plain), in_axes=(None, None, 0)))
    text = f.trace(*ARGUMENTS[:2], jnp.zeros((0, 2))).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.reduce_window" not in text


@pytest.mark.parametrize("whole", [jnp.int32(3), jnp.array([1, 2])], ids=["int32", "two of int64"])
@pytest.mark.parametrize("transform", ["jit", "batch"])
@pytest.mark.filterwarnings("ignore:.*its description uses a result of int")
def test_integer_results_are_preserved(whole, transform, kernels):
    f = ScalarFunction(lambda a, b, x: (plain(a, b, x)[0], whole))
    _, found = jax.jit(TRANSFORMATIONS[transform](f))(*ARGUMENTS)
    np.testing.assert_array_equal(found, jnp.broadcast_to(whole, found.shape), strict=True)
    np.testing.assert_array_equal(f.numpy(*ARGUMENTS)[1], whole, strict=True)
    jax.jit(TRANSFORMATIONS[transform](f)).trace(*ARGUMENTS).lower(lowering_platforms=("cuda",))


def test_operations_with_exchanged_operands_are_different():
    f = ScalarFunction(lambda a, b: jnp.stack([a - b, b - a, a / b, b / a, jnp.arctan2(a, b), jnp.arctan2(b, a)]))
    a, b = 1.0, 4.0
    expected = [a - b, b - a, a / b, b / a, np.arctan2(a, b), np.arctan2(b, a)]
    np.testing.assert_allclose(f(jnp.array(a), jnp.array(b)), expected, rtol=1e-14)


# Each of these once ended the process: XLA checks, and aborts, where a parameter is never read.
CRASHES = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxkane._scalarjit.scalar_function import ScalarFunction
program = ScalarFunction(lambda a, b, t, x: (jnp.sin(x[0]) * a + t + jnp.cos(x[1]), 0.0 * b))
x = jnp.ones(3)
def loop(f, n=5):
    def body(c):
        i, x, big = c
        y = f(x)
        return i + 1, x.at[0].add(y), big.at[i].add(y)
    return jax.lax.while_loop(lambda c: c[0] < n, body, (0, x, jnp.zeros(1000)))[2].sum()
jax.jit(lambda a, b: loop(lambda x: program(a, b, 0.0, x)[0]))(1.0, 2.0)
jax.jit(lambda a: loop(lambda x: program(a, 3.0, 0.0, x)[0] + program(1.0, 2.0, 0.0, jnp.zeros(3))[0]))(1.0)
jax.jit(lambda: program(1.0, 2.0, 0.0, jnp.ones(3)))()
jax.jit(jax.vmap(lambda a: program(a, 2.0, 0.0, x)))(jnp.ones(5000))
jax.jit(jax.grad(lambda a: loop(lambda x: program(a, 2.0, 0.0, x)[0], 3) if False else program(a, 2.0, 0.0, x)[0]))(1.0)
jax.jit(jax.grad(lambda b: jax.vmap(lambda a: program(a, b, 0.0, x)[0] * b)(jnp.ones(5000)).sum()))(1.0)
jax.jit(lambda z: jax.lax.map(lambda a: program(a, 2.0, 0.0, x)[0], z))(jnp.ones(70))
print("alive")
"""


@pytest.mark.weekly
def test_unusual_programs_do_not_crash_the_process():
    run = subprocess.run([sys.executable, "-c", CRASHES], capture_output=True, text=True, timeout=300, check=False)
    assert run.stdout.strip() == "alive", run.stderr[-2000:]


@pytest.mark.slow
def test_tracers_of_the_current_trace_are_not_stored():
    box = {}
    f = ScalarFunction(lambda x: box["k"] * jnp.sin(x))

    def g(k, x):
        box["k"] = k
        return f(x)

    x = jnp.array(0.4)
    for k in (2.0, 3.0):
        np.testing.assert_allclose(jax.jit(g)(jnp.array(k), x), k * np.sin(0.4), rtol=1e-14)
        np.testing.assert_allclose(jax.grad(g)(jnp.array(k), x), np.sin(0.4), rtol=1e-14)
        np.testing.assert_allclose(jax.jvp(g, (k, x), (0.0, 1.0))[1], k * np.cos(0.4), rtol=1e-14)
        np.testing.assert_allclose(jax.vmap(g)(jnp.full(2, k), jnp.full(2, 0.4)), k * np.sin(0.4), rtol=1e-14)


FIRST_CALLS = {
    "jit": lambda f: jax.jit(f),
    "grad": lambda f: lambda x: jax.value_and_grad(f)(x)[0],
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (1.0,))[0],
    "vmap": lambda f: lambda x: jax.vmap(f)(jnp.stack([x, x]))[1],
    "jit of grad of vmap": lambda f: jax.jit(lambda x: jax.grad(lambda y: jax.vmap(f)(y).sum())(jnp.stack([x, x]))[0]),
}


@pytest.mark.parametrize("name", FIRST_CALLS)
def test_a_first_call_within_a_trace_leaks_no_tracers(name):
    f = ScalarFunction(lambda x: jnp.sin(x) * jnp.cos(0.5 * x))
    x = jnp.array(0.4)
    with jax.checking_leaks():
        FIRST_CALLS[name](f)(x)
    np.testing.assert_allclose(f(x), np.sin(0.4) * np.cos(0.2), rtol=1e-14)
    np.testing.assert_allclose(f(0.4), np.sin(0.4) * np.cos(0.2), rtol=1e-14)  # and of a weak type


def test_the_precision_can_be_changed_between_calls():
    f = ScalarFunction(lambda x: (2.0 * x, jnp.full(2, 0.5)))
    x = jnp.float32(0.4)
    assert [y.dtype for y in f(x)] == [jnp.float32, jnp.float64]
    with jax.enable_x64(False):
        assert [y.dtype for y in f(x)] == [jnp.float32, jnp.float32]
    assert [y.dtype for y in f(x)] == [jnp.float32, jnp.float64]


def test_constants_with_equal_printed_digits_are_not_merged():
    """Common ones are found by their bits: arrays print eight digits, -0.0 equals 0.0, and no NaN is itself."""
    near = [np.array(0.1234567891234), np.array(0.1234567895678)]
    f = lambda x: [x * near[0], x * near[1], jnp.arctan2(x * 0.0, -1.0), jnp.arctan2(x * -0.0, -1.0), x + jnp.nan]  # noqa: E731
    once = cse(jax.make_jaxpr(lambda x: [*f(x), *f(x)])(1.0))
    assert [e.primitive.name for e in once.jaxpr.eqns].count("mul") == 4
    assert [e.primitive.name for e in once.jaxpr.eqns].count("add") == 1
    np.testing.assert_array_equal(jnp.stack(ScalarFunction(f)(3.0)), [3 * near[0], 3 * near[1], np.pi, -np.pi, np.nan])


class Ball(eqx.Module):
    """A description's stand-in: its name is told."""

    a: jax.Array


@jax.custom_vjp
def in_reverse_mode(x):
    return x * x


in_reverse_mode.defvjp(lambda x: (x * x, x), lambda x, ct: (2.0 * x * ct,))

SLOW = {
    "in_reverse_mode": lambda b, x: in_reverse_mode(b.a * x),
    "cond": lambda b, x: jax.lax.cond(x > 0.0, lambda: b.a * x, lambda: x),
    "while": lambda b, x: jax.lax.while_loop(lambda c: c < b.a, lambda c: c + x * x + 1.0, x),
    "dot_general": lambda b, x: jnp.stack([x, *[b.a] * 64]) @ jnp.stack([*[b.a] * 64, x]),
    "gather": lambda b, x: jnp.take(jnp.array([1.0, 2.0, 3.0]) * b.a, (x > 0.0).astype(int)),
    "lu": lambda b, x: jnp.linalg.solve(jnp.full((2, 2), x).at[0, 0].add(b.a), jnp.ones(2))[0],
}


@pytest.mark.slow_cases(all_but=["cond", "while"])
@pytest.mark.parametrize("name", SLOW)
def test_operations_that_prevent_a_single_program_cause_one_warning(name):
    programs.warn_once.cache_clear()
    f = ScalarFunction(SLOW[name])
    ball, x = Ball(jnp.array(1.5)), jnp.array(0.4)
    with pytest.warns(UserWarning, match=rf"Ball: its description uses .*`{name}`.* cannot be part of one") as told:
        found = f(ball, x), jax.jit(f)(ball, x), jax.grad(lambda x: f(ball, x) if name != "while" else x)(x)
    assert len(told) == 1
    np.testing.assert_allclose(found[:2], np.full(2, SLOW[name](ball, x)), rtol=1e-14)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_products_of_small_matrices_are_expanded_to_scalars():
    A, B = (np.random.default_rng(i).normal(size=s) for i, s in ((0, (2, 3, 4)), (1, (4, 2, 5))))
    f = lambda b, x: jnp.einsum("bij,jbk->bik", b.a * A, x * jnp.asarray(B))  # noqa: E731
    ball, x = Ball(jnp.array(1.5)), jnp.array(0.4)
    exact = np.einsum("bij,jbk->bik", 1.5 * A, 0.4 * B)
    np.testing.assert_allclose(ScalarFunction(f)(ball, x), exact, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(lambda x: ScalarFunction(f)(ball, x))(x), exact / 0.4, rtol=1e-13, atol=1e-14)


@ScalarFunction
def of_two(a, b):
    return 2.0 * jnp.sin(a), a * b, b**2


@ScalarFunction
def with_a_constant(b):
    return jnp.ones(()), 2.0 * b


def moving_about(a, x, y):
    """Rearrangements, products with constants, and results that are inputs."""
    z = jnp.concatenate([a * x[1:3], x[::2] / (1.0 + a * a), jnp.stack([y, -y])])
    z = jax.lax.pad(z.reshape(3, 2).T, 0.0, ((1, 0, 0), (0, -1, 0)))
    z = jnp.where(a > 0, z, 2.0 * z) + jnp.broadcast_to(y, z.shape) - z[0, 0]
    return z, jnp.sum(z * jnp.cos(a), axis=1), x, y * 0.0 + x[2] + x[2], jnp.sin(a)


@pytest.mark.slow
def test_the_transpose_of_a_program_agrees_with_jax():
    x, y = jnp.arange(1.0, 5.0), jnp.array(0.7)
    program = ScalarFunction(moving_about)
    for a in (jnp.array(0.4), jnp.array(-0.4)):
        cts = [jnp.cos(jnp.arange(1.0, out.size + 1.0)).reshape(out.shape) for out in moving_about(a, x, y)]
        transposed = lambda f, a=a, cts=cts: jax.jit(lambda: jax.vjp(functools.partial(f, a), x, y)[1](tuple(cts)))()  # noqa: E731
        for ours, theirs in zip(transposed(program), transposed(moving_about), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-14)


def of_many_operations(a, x, y, n):
    """One of each kind, numbers that stand still, and results that do not move or are inputs."""
    z = jnp.sin(a * x) * jnp.exp(-x) + jnp.tanh(y) ** 3 - x[::-1] ** 1.5 / (1.0 + jnp.abs(y - x))
    z = jnp.where(a < x, z, jnp.maximum(z, y)) + jnp.arctan2(z, jnp.sqrt(a)) * jnp.array([0.5, 2.0, 3.0])
    still = jax.lax.stop_gradient(jnp.exp(1000.0 * y * z))  # infinite
    flag = (z > 0) & (n > 2)
    return z @ z, jnp.clip(z, -1.0, 1.0) + 0.0 * y, flag, jnp.floor(y), a, jnp.where(flag, 1.0, still), n, jnp.ones(2)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [(0, 1, 2), (1,), (0, 2)], ids=str)
def test_the_derivative_of_a_program_agrees_with_jax(moving):
    rtol = 1e-14
    args = (jnp.array(0.7), jnp.array([0.5, 0.9, 1.4]), jnp.array(0.8), jnp.array(3))
    dxs = [jnp.cos(jnp.arange(1.0, args[i].size + 1.0)).reshape(args[i].shape) for i in moving]
    program = cse(jax.make_jaxpr(of_many_operations)(*args))
    tangent, moves = tangent_program(program, moving)
    assert moves == (True, True, False, False, 0 in moving, False, False, False)
    found = jax.jit(jaxpr_as_fun(tangent))(*args, *dxs)
    of_moving = lambda *xs: of_many_operations(*[dict(zip(moving, xs)).get(i, x) for i, x in enumerate(args)])  # noqa: E731
    expected = jax.jit(lambda *dxs: jax.jvp(of_moving, [args[i] for i in moving], [*dxs])[1])(*dxs)
    for ours, theirs in zip(found, [dy for dy, m in zip(expected, moves) if m], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=rtol)
    # Nor is anything left in it that could be found once more, or that no result needs.
    assert len(cse(tangent).jaxpr.eqns) == len(tangent.jaxpr.eqns)


@pytest.mark.parametrize("operation", [add, sub, mul], ids=lambda f: f.__name__)
def test_numbers_of_two_types_and_shapes_are_converted(operation):
    x, y = jnp.array(3.0, jnp.float32), jnp.array([2.0, 5.0])
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = jax.jit(operation)(x, y)
    expected = {add: [5.0, 8.0], sub: [1.0, -2.0], mul: [6.0, 15.0]}[operation]
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == jnp.float64


def test_outputs_shared_by_batch_members_remain_unbatched():
    """Only an output without an axis of members may be given out without one."""
    a, b = jnp.array(0.7), jnp.arange(1.0, 4.0)
    shared, product, square = jax.jit(jax.vmap(of_two, in_axes=(None, 0), out_axes=(None, 0, 0)))(a, b)
    np.testing.assert_allclose(shared, 2 * np.sin(0.7), rtol=1e-15)
    np.testing.assert_allclose(product, 0.7 * b, rtol=1e-15)
    np.testing.assert_allclose(square, b**2, rtol=1e-15)
    inner = jax.vmap(of_two, in_axes=(None, 0), out_axes=(None, 0, 0))
    both = jax.jit(jax.vmap(inner, in_axes=(0, None), out_axes=(0, 0, None)))
    assert [x.shape for x in both(b, b)] == [(3,), (3, 3), (3,)]
    np.testing.assert_allclose(both(b, b)[1], np.outer(b, b), rtol=1e-15)
    slopes = jax.jit(jax.grad(lambda a: sum(jnp.sum(x) for x in inner(a, b))))
    np.testing.assert_allclose(slopes(a), 2 * np.cos(0.7) + 6.0, rtol=1e-14)
    batch = jax.jit(jax.vmap(with_a_constant))(b)
    np.testing.assert_array_equal(batch, [np.ones(3), 2 * b])


def test_a_sharded_program_is_one_operation():
    """JAX places constants on the devices of a mesh, by an operation that is none of scalars."""

    @ScalarFunction
    def nearest(x):
        return jnp.where(x > 0.0, x, jnp.full_like(2.0 * x, jnp.inf))

    mesh = jax.make_mesh((1,), ("members",), axis_types=(jax.sharding.AxisType.Auto,))
    over, spec = functools.partial(jax.shard_map, mesh=mesh, check_vma=False), jax.sharding.PartitionSpec("members")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = jax.jit(over(jax.vmap(nearest), in_specs=(spec,), out_specs=spec))(jnp.array([-1.0, 2.0]))
    np.testing.assert_array_equal(found, [jnp.inf, 2.0])


@ScalarFunction
def _pair(p, y):
    return jnp.stack([jnp.sin(p * y[0]) + y[1], y[1] * p**2])


def once(f):
    return lambda v: f(2.0 * v[0], jnp.stack([v[1], v[0] * v[1]]))


def in_a_loop(f):
    return lambda v: jax.lax.fori_loop(0, 3, lambda _, y: f(v[0], y), v)


FWD, REV = jax.jacfwd, jax.jacrev
NESTED = [(FWD,), (REV,), (FWD, FWD), (FWD, REV), (REV, FWD), (FWD, FWD, FWD)]


@pytest.mark.weekly
@pytest.mark.parametrize("modes", NESTED, ids=lambda modes: "-".join(mode.__name__ for mode in modes))
@pytest.mark.parametrize("shape", [once, in_a_loop])
def test_value_and_derivative_in_one_program_agree_with_plain_jax(shape, modes, native):
    ours, plain = shape(_pair.in_forward_mode), shape(_pair.__wrapped__)
    for mode in reversed(modes):
        ours, plain = mode(ours), mode(plain)
    v = jnp.array([0.3, 0.7])
    np.testing.assert_allclose(jax.jit(ours)(v), jax.jit(plain)(v), rtol=1e-13, atol=1e-14)
    vs = jnp.stack([v, 2.0 * v, -v])
    np.testing.assert_allclose(jax.jit(jax.vmap(ours))(vs), jax.jit(jax.vmap(plain))(vs), rtol=1e-13, atol=1e-14)


@pytest.mark.weekly_cases(all_but=["XLA-once"])
@pytest.mark.parametrize("shape", [once, in_a_loop])
def test_value_and_derivative_in_one_program_with_linearize_and_vmap(shape, kernels):
    ours, plain = shape(_pair.in_forward_mode), shape(_pair.__wrapped__)
    v, dv = jnp.array([0.3, 0.7]), jnp.array([1.0, -2.0])
    for f in (ours, plain):
        value, slope = jax.linearize(f, v)
        np.testing.assert_allclose(value, plain(v), rtol=1e-14)
        np.testing.assert_allclose(slope(dv), jax.jvp(plain, (v,), (dv,))[1], rtol=1e-14)
    vs = jnp.stack([(1.0 + 0.01 * i) * v for i in range(150)])  # more than XLA takes at once
    for derivative in (lambda f: jax.vmap(FWD(f)), lambda f: lambda vs: jnp.sum(FWD(jax.vmap(f))(vs), axis=2)):
        found, expected = (jax.jit(derivative(f))(vs) for f in (ours, plain))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_value_and_derivative_are_one_kernel(native):
    f = once(_pair.in_forward_mode)
    along = lambda v: jax.vmap(lambda dv: jax.jvp(f, (v,), (dv,)), out_axes=(None, 0))(jnp.eye(2))  # noqa: E731
    program = jax.jit(along).lower(jnp.array([0.3, 0.7])).as_text()
    assert program.count("stablehlo.custom_call @jaxkane") == 1


@ScalarFunction
def _doubled_if_positive(x):
    positive = x > 0
    return jnp.where(positive, 2.0 * x, x), positive


@pytest.mark.slow
def test_a_program_with_boolean_results_is_differentiable(kernels):
    value = lambda x: _doubled_if_positive(x)[0]  # noqa: E731
    for x, slope in ((0.7, 2.0), (-0.7, 1.0)):
        assert jax.jit(jax.grad(value))(x) == slope
        (_, told), (x_dot, _) = jax.jit(lambda x: jax.jvp(_doubled_if_positive, (x,), (1.0,)))(x)
        assert x_dot == slope
        assert told == (x > 0)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(value)))(jnp.array([-1.0, 1.0])), [1.0, 2.0])
