"""Derivatives of eigenvalues of any order, and where there are none; derivatives of what was not found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane.stability._eig import eig, eigvals


def pair(p):
    """Coefficients of x^2 + 2 d x + k: eigenvalues -d +- sqrt(d^2 - k), closed to any order."""
    d, k = p
    return jnp.stack([jnp.stack([jnp.zeros_like(d), jnp.ones_like(d)]), jnp.stack([-k, -2 * d])])


def largest(values):
    return jnp.max(values.real), jnp.max(values.imag)


MODES = {
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("f", [lambda A: eig(A).values, eigvals], ids=["eig", "eigvals"])
@pytest.mark.parametrize("d, k", [(0.3, 2.0), (1.5, 0.7)], ids=["oscillating", "decaying"])
def test_second_derivatives_have_closed_forms(f, mode, d, k):
    rtol = 1e-11
    exact = {
        True: lambda p: (-p[0], jnp.sqrt(p[1] - p[0] ** 2)),
        False: lambda p: (-p[0] + jnp.sqrt(p[0] ** 2 - p[1]), 0.0 * p[0]),
    }[d**2 < k]
    p = jnp.array([d, k])
    found = jax.jit(MODES[mode](lambda p: largest(f(pair(p)))))(p)
    for x, y in zip(found, jax.hessian(exact)(p), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-12)


def test_third_derivatives_and_vectors_against_differences():
    """Of a general matrix: a parameter moves all of it; vectors as LAPACK scales them."""
    rtol = 1e-7
    rng = np.random.default_rng(3)
    A, B, C = rng.standard_normal((3, 3, 3))

    def along(p):
        found = eig(A + p * B + p**2 * C)
        return found.values, found.vectors, found.left, found.condition

    second = jax.jit(jax.jacfwd(jax.jacfwd(lambda p: along(p)[0])))
    third = jax.jit(jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda p: along(p)[0]))))
    h = 1e-4
    differences = (8 * (second(h) - second(-h)) - (second(2 * h) - second(-2 * h))) / (12 * h)
    np.testing.assert_allclose(third(0.0), differences, rtol=rtol, atol=rtol * np.abs(differences).max())
    at = jax.jit(along)
    for x, y in zip(
        jax.jit(jax.jacfwd(along))(0.0), zip(at(h), at(-h), at(2 * h), at(-2 * h), strict=True), strict=True
    ):
        a, b, c, d = y
        np.testing.assert_allclose(x, (8 * (a - b) - (c - d)) / (12 * h), rtol=rtol, atol=1e-9)


def test_one_that_is_separated_does_not_mind_that_others_coalesce():
    """1, 1 and 3, of which the first two are one defective (or one semisimple) double root."""
    rtol = 1e-11
    B = jnp.array([[0.1, 0.4, 0.2], [0.3, 0.2, -0.5], [0.7, 0.6, 0.5]])
    second = [jax.jit(mode(lambda p, A: eigvals(A + p * B).real)) for mode in MODES.values()]
    for coupled in (1.0, 0.0):
        A = jnp.array([[1.0, coupled, 0.2], [0.0, 1.0, 0.3], [0.0, 0.0, 3.0]])
        for derivative in second:
            found = derivative(0.0, A)
            np.testing.assert_array_equal(np.isnan(found), [True, True, False])
            # lambda'' = 2 y B (lambda - A)^+ B x, the pseudoinverse clear of x and y: by the projection off x y^T
            values, left, right = map(np.asarray, (eig(A).values.real, eig(A).left.real, eig(A).vectors.real))
            x, y = right[:, 2], left[:, 2] / (left[:, 2] @ right[:, 2])
            P = np.eye(3) - np.outer(x, y)
            S = P @ np.linalg.inv(values[2] * np.eye(3) - np.asarray(A) + np.outer(x, y)) @ P
            np.testing.assert_allclose(found[2], 2 * y @ B @ S @ B @ x, rtol=rtol)
        of_third = jax.jit(jax.hessian(lambda A: eigvals(A).real[2]))(A)
        assert np.isfinite(of_third).all()  # in reverse mode what is not read says nothing
        assert np.isinf(eig(A).condition[:2]).all()
        assert np.isfinite(eig(A).condition[2])


def test_in_single_precision_and_in_batches_of_none():
    slope = jax.jacfwd(lambda p: eigvals(pair(p)).real)(jnp.array([1.5, 0.7], jnp.float32))
    assert slope.dtype == jnp.float32
    assert np.isfinite(slope).all()
    assert jax.vmap(lambda p: jax.hessian(lambda p: eigvals(pair(p)).real)(p))(jnp.zeros((0, 2))).shape == (0, 2, 2, 2)
    found = eig(jnp.full((3, 3), jnp.nan))
    assert np.isnan(found.values).all()
    assert np.isnan(found.condition).all()
