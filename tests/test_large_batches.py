"""A batch is its members, however many: beyond 16 384 JAX 0.10.2 gave wrong products of matrices (its issue 39103)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.chain import Chain

import jaxkane as jk
from jaxkane.fit.solve.linearization import Blocks, eliminate

N, SMALL = 40_000, 1000
SYSTEMS = {"double pendulum": jk.catalog.DoublePendulum(mass=1.0, length=0.7), "chain": Chain(n=14)}


def in_small_batches(f, *arrays):
    parts = [f(*(x[i : i + SMALL] for x in arrays)) for i in range(0, len(arrays[0]), SMALL)]
    return jax.tree.map(lambda *xs: np.concatenate(xs), *parts)


def assert_equal(whole, parts):
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.abs(b).max())


def test_matrix_products_in_user_code_are_correct_in_large_batches():
    """As a user writes them. See `switch_off_wrong_fusions` of the compiler."""
    turn, rows = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.5], [0.0, 0.0, 1.0]]), np.arange(3.0 * N).reshape(N, 3)
    squares = jax.jit(jax.vmap(lambda row: jnp.sum((turn @ row) ** 2)))(rows)
    np.testing.assert_allclose(squares, np.sum((rows @ turn.T) ** 2, axis=1), rtol=1e-12)


@pytest.mark.weekly
@pytest.mark.optimized
@pytest.mark.parametrize("name", SYSTEMS)
def test_accelerations_of_large_batches_are_correct(name, kernels):
    """Scalar programs, and above twelve speeds products of matrices."""
    system, rng = SYSTEMS[name], np.random.default_rng(0)
    q, u = (jnp.asarray(rng.uniform(-1.0, 1.0, (N, len(names)))) for names in (system.coordinates, system.speeds))

    def of(q, u):
        M, f = jk.equations_of_motion(system, 0.0, q, u)
        u_dot = jk.accelerations(system, 0.0, q, u)
        return M, f, u_dot, jnp.sum((M @ u_dot - f) ** 2) + u @ (M @ u), jk.kinetic_energy(system, 0.0, q, u)

    batch = jax.jit(jax.vmap(of))
    assert_equal(batch(q, u), in_small_batches(batch, q, u))


@pytest.mark.weekly
@pytest.mark.optimized
def test_reduce_functions_with_matrix_products_in_large_sweeps():
    """`reduce` is code of the user, which may multiply matrices."""
    system, turn = SYSTEMS["double pendulum"], jnp.array([[0.0, 1.0], [-1.0, 0.5]])
    starts = jk.State(jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (N, 2))), jnp.zeros(2))

    def swept(chunk):
        reduce = lambda ride: {"size": jnp.sum((turn @ ride.q[-1]) ** 2), "path": ride.q @ turn}  # noqa: E731
        return jk.sweep.sweep(system, starts, np.linspace(0.0, 0.02, 3), reduce=reduce, chunk=chunk).values

    assert_equal(swept(N), swept(SMALL))


@pytest.mark.weekly
@pytest.mark.optimized
def test_elimination_in_large_batches_of_windows():
    n_z, n_b, n_x = 2, 1, 3
    k = n_z + n_b + n_x + 1
    R = np.triu(np.random.default_rng(0).normal(size=(N, k, k))) + 2.0 * np.eye(k)

    def eliminated(R):
        windows = jnp.arange(len(R), dtype=jnp.int32)[:, None]
        found = eliminate(Blocks(jnp.asarray(R), jnp.zeros((0, R.shape[-1] - n_z - n_b)), windows, n_z, 0, n_b), 0.0)
        z, b = found.back_substitute(jnp.arange(1.0, n_x + 1.0))
        return found.R.mT @ found.R, z, b

    assert_equal(eliminated(R), in_small_batches(eliminated, R))
