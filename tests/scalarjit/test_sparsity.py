"""Patterns of first and second derivatives contain all entries of all branches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit.jaxpr import patterns


def branches(x):
    a, b, c, d, e = x
    return jnp.stack([
        jnp.where(a > 0.5, b * c, d), jnp.maximum(a, b), a / c, jnp.abs(d) * 3.0, jnp.floor(e) + b,
        jnp.where(a > 0.5, 1.0, 2.0), jnp.minimum(a, 0.3) - jax.lax.rem(b, 0.7), 0.0 * e, c**2, c**1, jnp.exp(a) * d,
        jnp.sign(a) * b, jnp.clip(c, -1.0, 1.0), jax.lax.select(d > 0.2, a * a, e), jnp.sqrt(a + b), (a + b) * (c - d),
    ])  # fmt: skip


@pytest.mark.slow
def test_patterns_contain_all_entries_of_both_branches():
    """At 60 random places no derivative lies outside the pattern; and what both branches lack is not in it."""
    first, second = patterns(branches, [jax.ShapeDtypeStruct((5,), jnp.float64)], 0)
    X = np.random.default_rng(0).uniform(-2.0, 2.0, (60, 5))
    X[:, 0], X[:, 1] = np.abs(X[:, 0]), np.abs(X[:, 1])  # under a root
    J = np.asarray(jax.jit(jax.vmap(jax.jacfwd(branches)))(X))
    H = np.asarray(jax.jit(jax.vmap(jax.hessian(branches)))(X))
    assert not np.any((J != 0).any(axis=0) & ~first)
    assert not np.any((H != 0).any(axis=(0, 1)) & ~second)
    assert [set(np.nonzero(row)[0].tolist()) for row in first[:7]] == [
        {1, 2, 3}, {0, 1}, {0, 2}, {3}, {1}, set(), {0, 1}
    ]  # fmt: skip
    assert not second[4].any()  # e occurs in pieces that are linear or constant
    assert second[1, 2]
    assert second[0, 3]
    assert second[2, 2]
    assert np.array_equal(second, second.T)


def test_pattern_of_a_function_that_is_not_a_graph_of_scalars():
    """A loop has a full pattern."""

    def looped(x):
        return jax.lax.fori_loop(0, 3, lambda i, x: x * jnp.roll(x, 1), x)

    first, second = patterns(looped, [jax.ShapeDtypeStruct((3,), jnp.float64)], 0)
    assert first.all()
    assert second.all()
