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


@pytest.mark.slow_cases("sizes8", "sizes7", "sizes6")
@pytest.mark.parametrize("sizes", [(3, 3, 3), (1, 3, 3), (2, 3), (1, 1, 1, 3), (4,), (1, 4), (5, 6), (7,), (1, 7)])
def test_block_triangular_systems_agree_with_numpy(sizes):
    """1e-12: against NumPy, rows and columns shuffled; a block of seven goes to LAPACK."""
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
    assert ("_solved_by_lapack" in traced) == (7 in sizes)


def test_a_structurally_singular_system_gives_non_finite_values():
    A = np.eye(5)
    A[4, 4] = 0.0
    assert not np.any(np.isfinite(np.array(solve(rows_of(A), [jnp.ones(())] * 5)[0])[4:]))


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 6])
def test_elimination_pivots_rows(n):
    """1e-10: numbers that are zero on the diagonal, and pivots of 1e-17; derivatives by the linear equations."""
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(20, n, n)), rng.normal(size=(20, n))
    A[:, np.arange(n), np.arange(n)] = 0.0
    A[10:] += 1e-17 * np.eye(n)
    dA, db = rng.normal(size=A.shape), rng.normal(size=b.shape)

    def solved(A, b):
        rows = [[*row] for row in A]
        return jnp.stack(solve(rows, [*b])[0]), determinant(rows)

    values, moved = jax.vmap(lambda *args: jax.jvp(solved, args[:2], args[2:]))(A, b, dA, db)
    x = np.linalg.solve(A, b[..., None])
    dx = np.linalg.solve(A, db[..., None] - dA @ x)
    det = np.linalg.det(A)
    for found, expected in (
        (values[0], x[..., 0]),
        (values[1], det),
        (moved[0], dx[..., 0]),
        (moved[1], det * np.trace(np.linalg.solve(A, dA), axis1=1, axis2=2)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_elimination_skips_exact_zeros():
    """1e-12: a row without a leading entry, and others whose entry becomes one."""
    pattern = np.array([[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1]])
    A, b = pattern * np.random.default_rng(0).normal(size=(4, 4)), np.arange(1.0, 5.0)
    np.testing.assert_allclose(solve(rows_of(A), [*b])[0], np.linalg.solve(A, b), rtol=1e-12)
    np.testing.assert_allclose(determinant(rows_of(A)), np.linalg.det(A), rtol=1e-12)
    exact = [[float(x) for x in row] for row in pattern + np.diag([1e-20, 1.0, 1.0, 1.0])]
    np.testing.assert_allclose(solve(exact, [*b])[0], np.linalg.solve(exact, b), rtol=1e-12)


def test_elimination_of_a_singular_matrix_gives_non_finite_values():
    row = [jnp.asarray(x) for x in (1.0, 2.0, 3.0, 4.0)]
    rows = [row, row, row[::-1], [2.0, 1.0, jnp.asarray(5.0), jnp.asarray(-1.0)]]
    assert determinant(rows) == 0.0
    assert not np.any(np.isfinite(np.array(solve(rows, row)[0])))


def test_elimination_preserves_the_dtype():
    rows = [[jnp.asarray(float(1 + i * j), jnp.float32) if i != j else 2.0 for j in range(4)] for i in range(4)]
    assert {x.dtype for x in solve(rows, rows[0])[0]} == {determinant(rows).dtype} == {np.dtype("float32")}
