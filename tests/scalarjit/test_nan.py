"""Missing values and all their derivatives are NaN. They do not affect results that do not use them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit.nan import (
    derivative_free_where_not_finite,
    nan_beyond_second_derivative,
    nan_derivative_where,
    nan_where,
)

P = {"a": jnp.array(0.7), "b": jnp.array([0.2, -0.4]), "n": 3}
MISSING = jnp.array([False, False, True, True])


def rows(a, b, missing=MISSING):
    """Four rows of two numbers; the last two are missing, and were inf before."""
    x = jnp.stack([jnp.stack([jnp.sin(a * i), b[0] * b[1] * a**i]) for i in (1.0, 2.0)])
    x = jnp.concatenate([x, jnp.full((2, 2), jnp.inf)])
    return nan_where(missing, {"x": x}, (a, b, 3))["x"]


def clean(a, b):
    return jnp.sum(rows(a, b)[:2] ** 2)


def expected(a, b):
    return sum(jnp.sin(a * i) ** 2 + (b[0] * b[1] * a**i) ** 2 for i in (1.0, 2.0))


def flat(tree):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


ORDERS = [modes for n in (1, 2) for modes in itertools.product((jax.jacfwd, jax.jacrev), repeat=n)]
# Of second derivatives, forward over reverse and reverse over reverse are enough for a plain run.
ORDERS = [pytest.param(m, marks=pytest.mark.weekly) if m[1:] and m[0] is jax.jacfwd else m for m in ORDERS]
named = lambda modes: "-".join(mode.__name__ for mode in modes)  # noqa: E731


def derivative(modes, f):
    for mode in modes:
        f = mode(f, argnums=(0, 1))
    return jax.jit(f)


@pytest.mark.weekly
@pytest.mark.parametrize("modes", ORDERS, ids=named)
def test_derivatives_of_valid_rows_contain_no_nan(modes):
    a, b = P["a"], P["b"]
    masked = lambda a, b: jnp.sum(jnp.where(MISSING[:, None], 0.0, rows(a, b)) ** 2)  # noqa: E731
    read = lambda a, b: jnp.stack([clean(a, b), masked(a, b), expected(a, b)])  # noqa: E731
    for slopes in jax.tree.leaves(derivative(modes, read)(a, b)):
        first, second, exact = slopes
        np.testing.assert_allclose(first, exact, rtol=1e-12)
        np.testing.assert_allclose(second, exact, rtol=1e-12)


@pytest.mark.weekly
@pytest.mark.parametrize("modes", ORDERS, ids=named)
def test_derivatives_of_missing_rows_are_nan(modes):
    """Also where the cotangents of two rows, or the tangents of two parameters, would cancel."""
    a, b = P["a"], P["b"]

    def read(a, b):
        x = rows(a, b)
        moved = rows(a - b[0], jnp.stack([b[0] - a, b[1]]))
        return jnp.stack([x[3, 0], x[0, 0] + 1e-200 * x[2, 1], x[3, 0] - x[2, 0], moved[2, 1]])

    assert np.isnan(read(a, b)).all()
    assert np.isnan(flat(derivative(modes, read)(a, b))).all()


def test_derivatives_by_unrelated_arguments_are_zero():
    x, x_dot = jax.jvp(lambda c: rows(P["a"], P["b"]) + 0.0 * c, (1.0,), (1.0,))
    assert np.isnan(x[2:]).all()
    np.testing.assert_array_equal(jax.grad(lambda c: c * clean(P["a"], P["b"]))(2.0), clean(P["a"], P["b"]))
    np.testing.assert_array_equal(x_dot[:2], np.zeros((2, 2)))


@pytest.mark.weekly
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_by_one_part_of_the_origin(mode):
    """Single numbers are one part of an origin, each other array is one; those that do not move take no part."""
    f = lambda a, b, c: nan_where(MISSING[1:3], jnp.stack([a * b[0], b[1] * c]), (a, b, c, jnp.arange(4.0)))  # noqa: E731
    first = [mode(f, argnums=i) for i in range(3)]
    at = jnp.array(0.7), jnp.array([0.2, -0.4]), jnp.array(2.0)
    for slope, (want, missing) in zip(first, [(0.2, np.nan), ([0.7, 0.0], [np.nan] * 2), (0.0, np.nan)], strict=True):
        np.testing.assert_allclose(slope(*at), [want, missing])
    for i, j in ((0, 1), (2, 0), (1, 1)):
        assert np.isnan(jax.jacfwd(first[i], argnums=j)(*at)[1]).all(), (i, j)


@pytest.mark.slow
def test_missing_rows_of_batch_members_are_independent():
    """In a shared parameter only the sum over who exists is clean; each member's own are its own."""
    missing = jnp.stack([MISSING, jnp.zeros(4, bool), jnp.ones(4, bool)])
    rows_of = jax.vmap(lambda a, b, missing: rows(a, b, missing)[:2], (None, 0, 0))
    bs = jnp.stack([P["b"], 2.0 * P["b"], P["b"]])
    first_two = lambda a, bs: jnp.sum(rows_of(a, bs, missing)[:2])  # noqa: E731
    all_three = lambda a, bs: jnp.sum(rows_of(a, bs, missing))  # noqa: E731
    for mode in (jax.jacfwd, jax.jacrev):
        shared, own = jax.jit(mode(first_two, argnums=(0, 1)))(P["a"], bs)
        assert np.isfinite(shared)
        assert np.isfinite(own).all()
        shared, own = jax.jit(mode(all_three, argnums=(0, 1)))(P["a"], bs)
        assert np.isnan(shared)
        assert np.isfinite(own[:2]).all()
        assert np.isnan(own[2]).all()


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_a_non_finite_trial_value_has_zero_derivative(mode):
    def trial(x):
        both = derivative_free_where_not_finite(lambda x: (jnp.stack([x**2, jnp.sqrt(x - 1.0)]), x**3), x)
        return both[0][0] + both[1] + jnp.where(x > 1.0, both[0][1], 0.0)

    np.testing.assert_allclose(mode(trial)(2.0), 4.0 + 12.0 + 0.5)
    np.testing.assert_array_equal(mode(trial)(0.5), 0.0)


@pytest.mark.slow
def test_nan_where_with_complex_and_single_precision():
    for missing, dtype in itertools.product((False, True), (jnp.complex64, jnp.float32)):
        f = lambda a: nan_where(jnp.array(missing), (a * 2).astype(dtype), a)  # noqa: B023, E731
        value, slope = jax.jvp(f, (jnp.float32(2.0),), (jnp.float32(1.0),))
        assert value.dtype == slope.dtype == dtype
        assert bool(np.isnan(value)) == bool(np.isnan(slope)) == missing
        assert bool(np.isnan(jax.grad(lambda a: f(a).real)(jnp.float32(2.0)))) == missing  # noqa: B023


def test_nan_where_without_origin_and_without_rows():
    assert np.isnan(nan_where(jnp.array(True), jnp.array(1.0), None))
    assert nan_where(jnp.zeros(0, bool), jnp.zeros((0, 3)), P).shape == (0, 3)


@pytest.mark.parametrize("mask", [nan_where, nan_derivative_where])
@pytest.mark.parametrize("batched", ["missing", "origin"])
def test_shared_values_of_a_batch_within_a_loop(mask, batched):
    """The value is one for all, its derivative is each member's."""

    def one(x):
        missing = x > 1.5 if batched == "missing" else jnp.array(True)
        return jnp.sum(mask(missing, jnp.ones((2, 3)), x))

    x = jnp.array([[1.0, 2.0]])
    f = jax.jit(lambda x: jax.lax.map(jax.vmap(one), x))
    slopes = jax.jvp(f, (x,), (jnp.ones_like(x),))[1]
    np.testing.assert_array_equal(np.isnan(slopes), [[batched == "origin", True]])


@pytest.mark.weekly
@pytest.mark.parametrize("mask", [nan_where, nan_derivative_where])
def test_one_part_of_the_origin_in_a_batch_within_a_loop(mask):
    """To the second derivative, along the part that all members share, and along each member's own."""

    def one(shared, x):
        return jnp.sum(mask(jnp.array(True), jnp.ones((2, 3)), (shared, jnp.stack([x, x]))))

    f = jax.jit(lambda shared, x: jax.lax.map(lambda x: jax.vmap(one, (None, 0))(shared, x), x) * shared)
    x, shared = jnp.array([[1.0, 2.0]]), jnp.array(2.0)
    for argument in (0, 1):
        first = jax.jacfwd(f, argnums=argument)
        assert np.isnan(first(shared, x)).any(axis=tuple(range(2, 2 + 2 * argument))).all()
        for other in (0, 1):
            assert np.isnan(jax.jacfwd(first, argnums=other)(shared, x)).any()


def test_empty_values_of_a_batch_within_a_loop():
    f = jax.jit(lambda x: jax.lax.map(jax.vmap(lambda x: nan_where(x > jnp.ones(4), jnp.zeros((4, 0)), x)), x))
    x = jnp.array([[1.0, 2.0]])
    assert jax.jvp(f, (x,), (x,))[1].shape == (1, 2, 4, 0)


@pytest.mark.slow
def test_derivatives_beyond_second_order_are_nan_only_if_inexact():
    def f(rough, x):
        return nan_beyond_second_derivative(rough, x**3, x)

    for rough, third in ((jnp.array(True), np.nan), (jnp.array(False), 6.0)):
        found = [f(rough, jnp.array(2.0))]
        g = lambda x, rough=rough: f(rough, x)  # noqa: E731
        for _ in range(3):
            g = jax.jacfwd(g)
            found.append(g(jnp.array(2.0)))
        np.testing.assert_allclose(found, [8.0, 12.0, 12.0, third], rtol=1e-14)
        assert float(jax.grad(lambda x, rough=rough: f(rough, x))(2.0)) == 12.0
