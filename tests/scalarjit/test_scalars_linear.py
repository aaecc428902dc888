"""Small linear systems: those that fall apart by their exact zeros are solved among the scalars."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit.components import determinant, solve


def rows_of(A, values=None):
    """Rows of A with exact zeros, or of `values` with those of A."""
    values = jnp.asarray(A) if values is None else values
    return [[values[i, j] if x else 0.0 for j, x in enumerate(row)] for i, row in enumerate(A)]


@pytest.mark.parametrize("sizes", [(3, 3, 3), (1, 3, 3), (2, 3), (1, 1, 1, 3), (4,), (1, 4)])
def test_systems_in_blocks(sizes):
    """1e-12: against NumPy, rows and columns shuffled; a block of four goes to LAPACK."""
    rng = np.random.default_rng(len(sizes))
    n, end = sum(sizes), np.cumsum(sizes)
    A = np.eye(n)
    for size, last in zip(sizes, end, strict=True):
        A[last - size : last, :last] += 0.4 * rng.normal(size=(size, last))
    A = A[rng.permutation(n)][:, rng.permutation(n)]
    b = rng.normal(size=(2, n))
    found = solve(rows_of(A), *(list(map(jnp.asarray, right)) for right in b))
    np.testing.assert_allclose(np.array(found), np.linalg.solve(A, b.T).T, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(determinant(rows_of(A)), np.linalg.det(A), rtol=1e-12, atol=1e-12)
    traced = str(jax.make_jaxpr(lambda values: solve(rows_of(A, values), tuple(b[0])))(A))
    assert ("_solved_by_lapack" in traced) == (4 in sizes)


def test_a_system_that_is_singular_by_its_zeros_has_no_number():
    A = np.eye(5)
    A[4, 4] = 0.0
    assert not np.any(np.isfinite(np.array(solve(rows_of(A), [jnp.ones(())] * 5)[0])[4:]))
