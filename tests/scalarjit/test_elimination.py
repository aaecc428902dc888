"""Linear systems along a graph of scalars, beside the solution by their matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit import elimination
from jaxkane._scalarjit.elimination import ScalarSolve

N = 9


def by_lapack(p, b):
    return jnp.full_like(b, -1.0)  # a mark


def solved(form, p, b):
    """x of M x = b, by the matrix itself."""
    values = jax.jit(jax.vmap(form, (None, 0)))(p, jnp.eye(N, dtype=b.dtype))
    z, D = (np.asarray(x, float) for x in values)
    return np.linalg.solve(np.einsum("aij,ijk,bik", z, D[0], z), np.asarray(b, float).T).T


def along_a_tree(p, x):
    """Nodes that pass what they receive on, turned, doubled, shifted and divided; two branches; some read twice."""
    z, first, second = [], x[0], x[0] - x[1]
    for i in range(2, N):
        c, s = jnp.cos(p[i]), jnp.sin(p[i])
        first, second = c * first + s * second + x[i], -s * first + (second + second) / p[0]
        z.append((first, second))
    z.append((x[1], x[1]))
    D = jnp.array([[2.0, 0.3], [0.3, 1.0]], x.dtype) * (1.0 + p[1] ** 2)
    return jnp.array([[*pair] for pair in z]), jnp.stack([D] * len(z))


def without_the_last(p, x):
    return x[:-1, None], jnp.ones((N - 1, 1, 1), x.dtype)


def two_as_one(p, x):
    """The last two unknowns are one, but for rounding."""
    z = [[x[i]] for i in range(N - 2)] + [[p[1] * x[-2] + p[1] * x[-1]], [p[2] * x[-2] + p[2] * x[-1]]]
    return jnp.array(z), jnp.ones((N, 1, 1), x.dtype)


tree, singular, rounded = (ScalarSolve(f, by_lapack) for f in (along_a_tree, without_the_last, two_as_one))
pytestmark = pytest.mark.usefixtures("native")


def numbers(batch=()):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.uniform(0.5, 2.0, N)), jnp.asarray(rng.normal(size=(*batch, N)))


@pytest.mark.slow
def test_the_solution_agrees_with_a_dense_solve():
    p, b = numbers()
    assert tree.is_native(p, b)
    np.testing.assert_allclose(tree(p, b), solved(along_a_tree, p, b), rtol=1e-11)


@pytest.mark.slow
def test_batches_of_right_hand_sides_and_of_matrices():
    p, b = numbers((11,))
    ps = p[None] * jnp.linspace(1.0, 1.3, 11)[:, None]
    of_sides, of_matrices, of_both = (
        jax.jit(jax.vmap(tree, axes))(*args)
        for axes, args in {(None, 0): (p, b), (0, None): (ps, b[0]), (0, 0): (ps, b)}.items()
    )
    np.testing.assert_allclose(of_sides, solved(along_a_tree, p, b), rtol=1e-11)
    for i in (0, 10):
        np.testing.assert_allclose(of_matrices[i], solved(along_a_tree, ps[i], b[0]), rtol=1e-11)
        np.testing.assert_allclose(of_both[i], solved(along_a_tree, ps[i], b[i]), rtol=1e-11)


@pytest.mark.slow
def test_elimination_in_float32():
    p, b = (x.astype(jnp.float32) for x in numbers())
    assert tree(p, b).dtype == jnp.float32
    np.testing.assert_allclose(tree(p, b), solved(along_a_tree, p, b), rtol=1e-3)


def test_dense_systems_are_solved_by_lapack(monkeypatch):
    monkeypatch.setattr(elimination, "_MOST_NODES", 5)
    solve = ScalarSolve(along_a_tree, by_lapack)
    assert not solve.is_native(*numbers())
    assert (solve(*numbers()) == -1.0).all()


@pytest.mark.parametrize("solve", [singular, rounded])
def test_a_singular_matrix_gives_nan(solve):
    assert np.isnan(solve(*numbers())).any()
