"""Functions with derivative rules of their own (`jax.custom_jvp`) are part of one program, and their rules are used."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit.jaxpr import patterns
from jaxkane._scalarjit.scalar_function import ScalarFunction

INF = np.inf
# Equal arguments, zeros, and arguments for which exp overflows or underflows.
POINTS = jnp.array([
    [0.3, -1.2], [1.0, 1.0], [0.0, 0.0], [0.0, 2.0], [1e3, -1e3], [-1e3, 1e3], [-INF, 1.0], [1.0, -INF], [-INF, -INF],
])  # fmt: skip


def of_jax(x):
    a, b = x
    nn = jax.nn
    return jnp.stack([
        jnp.logaddexp(a, b), jnp.hypot(a, b), jnp.sinc(a), nn.softplus(a), nn.relu(a), nn.silu(b), nn.log_sigmoid(b),
        jax.scipy.special.xlogy(a, b),
    ])  # fmt: skip


@jax.custom_jvp
def rounded(x):
    return jnp.round(x)


# Not the derivative of the value, which is zero.
rounded.defjvp(lambda x, dx: (rounded(*x), x[0] ** 2 * dx[0]))


@jax.custom_jvp
def recursive(x):
    return jnp.exp(x)


recursive.defjvp(lambda x, dx: (recursive(*x), 3.0 * recursive(*x) * dx[0]))


def of_user(x):
    return jnp.stack([rounded(x[0]) * x[1], recursive(x[0] * x[1]), rounded(recursive(x[1]))])


def results(f):
    """Values, first and second derivatives, in forward and in reverse mode."""
    each = f, jax.jacfwd(f), jax.jacrev(f), jax.jacfwd(jax.jacrev(f)), jax.jacrev(jax.jacfwd(f))
    return jax.jit(lambda x: [g(x) for g in each])


@pytest.mark.slow_cases(all_but=["native-of_jax", "native-of_user", "XLA-of_user"])
@pytest.mark.parametrize(("f", "points"), [(of_jax, POINTS), (of_user, POINTS[:3])], ids=["of_jax", "of_user"])
def test_derivatives_are_those_of_the_rules(f, points, kernels):
    """As by plain JAX to 1e-13, with NaN only where plain JAX has NaN."""
    program = ScalarFunction(f)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that the function is not one program
        ours, plain = results(program), results(f)
        for x in points:
            for found, expected in zip(ours(x), plain(x), strict=True):
                np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)
            np.testing.assert_allclose(program.numpy(x), f(x), rtol=1e-13)


def test_rules_that_contain_solves_are_used():
    @jax.custom_jvp
    def cubed(x):
        return x**3

    solved = lambda x: jnp.linalg.solve(jnp.array([[2.0, 0.0], [0.0, 1.0]]) * x, jnp.ones(2))[0]  # noqa: E731
    cubed.defjvp(lambda x, dx: (cubed(*x), solved(*x) * dx[0]))
    with pytest.warns(UserWarning, match=r"lu of float64, which native kernels do not support"):
        slope = jax.jit(jax.grad(ScalarFunction(lambda x: cubed(x))))(4.0)
    assert slope == pytest.approx(1 / 8, rel=1e-14)


def test_patterns_contain_derivatives_that_only_a_rule_has():
    f = lambda x: jnp.stack([rounded(x[0]), jnp.hypot(x[1], x[2]), x[0]])  # noqa: E731
    first, second = patterns(f, [jax.ShapeDtypeStruct((3,), jnp.float64)], 0)
    np.testing.assert_array_equal(first, [[True, False, False], [False, True, True], [True, False, False]])
    np.testing.assert_array_equal(second, [[True, False, False], [False, True, True], [False, True, True]])
