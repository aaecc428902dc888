"""Sizes of terms, ranks and least-norm solutions do not depend on units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._kane.scaling import least_norm, rank_tolerance, relative, singular_values, term_sizes

FACTORS = [1e-9, 1.0, 1e9]


def residual(q, L):
    """Of a linkage: two loop equations, a circle, and a coupling that is linear in what may be zero."""
    return jnp.stack(
        [
            L[0] * jnp.cos(q[0]) + L[1] * jnp.cos(q[1]) - L[2],
            L[0] * jnp.sin(q[0]) - L[1] * jnp.sin(q[1]),
            (q[2] ** 2 + q[3] ** 2) / L[0] - jnp.sqrt(L[0] ** 2),
            q[2] - q[3],
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_term_sizes_scale_with_the_units(dtype):
    def sizes(factor):
        q, L = jnp.array([0.0, 0.0, factor, 0.0], dtype), factor * jnp.array([1.0, 2.0, 3.0], dtype)
        return term_sizes(residual, q, L)

    for factor in FACTORS:  # q[3] = 0: of the circle's terms and of the coupling's the other remains
        np.testing.assert_allclose(sizes(factor), factor * np.array([3.0, 2.0, 1.0, 1.0]), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(sizes)(1e9), sizes(1e9), rtol=1e-6)


def test_a_zero_argument_has_the_given_size():
    sizes = term_sizes(lambda a, b: a - 2.0 * b, jnp.zeros(()), jnp.zeros(()), sizes=(jnp.ones(()), None))
    assert sizes == 1.0
    np.testing.assert_array_equal(relative(np.zeros(2), np.array([0.0, 3.0])), 0.0)


def test_term_sizes_have_zero_derivatives():
    assert jax.grad(lambda x: term_sizes(lambda y: y - 1.0, x))(3.0) == 0.0


@pytest.mark.slow
def test_ranks_do_not_depend_on_the_units():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 5))
    A[0, 1] = 0.0
    A[2] = A[0] - 2 * A[1]
    for regular in (False, True):
        A[2, 2] += regular
        for _ in range(5):
            rows, columns = 10.0 ** rng.uniform(-9, 9, 3), 10.0 ** rng.uniform(-9, 9, 5)
            B = rows[:, None] * A * columns
            np.testing.assert_allclose(singular_values(B), singular_values(A), rtol=1e-9, atol=1e-13)
            for A in (B, jnp.asarray(B)):
                assert (singular_values(A) > rank_tolerance(A.dtype)).sum() == 2 + regular
            x = rng.normal(size=5)
            found, right = least_norm(B, B @ (x / columns)) * columns, least_norm(A, A @ x)
            np.testing.assert_allclose(found, right, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(A @ found, A @ x, rtol=1e-6, atol=1e-8)


@pytest.mark.weekly
def test_a_least_norm_solution_is_differentiable_with_repeated_rows():
    def x(a, xp=jnp):
        row = xp.stack([a, 2.0 + a * a, 1.0])
        return least_norm(xp.stack([row, 3.0 * row]), xp.stack([a, 3.0 * a]))

    a, step = 0.7, 1e-6
    difference = (x(np.float64(a + step), np) - x(np.float64(a - step), np)) / (2 * step)
    assert np.isfinite(difference).all()
    # The scaling is held in derivatives: it changes which solution is shortest, not that it is a solution.
    residual_slope = jax.jacfwd(lambda a: jnp.stack([a, 2.0 + a * a, 1.0]) @ x(a))(a)
    np.testing.assert_allclose(residual_slope, 1.0, rtol=1e-9)
    np.testing.assert_allclose(jax.jacrev(x)(a), jax.jacfwd(x)(a), rtol=1e-9)
