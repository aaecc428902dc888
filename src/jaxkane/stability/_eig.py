"""Eigenvalues with derivatives that say where there are none. Knows matrices and nothing of mechanics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

MOST_CONDITION = 1e6


class Eig(NamedTuple):
    """Eigenvalues and what belongs to them.

    `values` (n,) [1/s]; `vectors` (n, n), right eigenvectors of unit length in its columns, and `left`; `condition`
    (n,): 1 / |y^H x| of the left and right eigenvectors of unit length, by how much an error of A is magnified in the
    eigenvalue, infinite where two coalesce. Only the values have derivatives.
    """

    values: Complex[Array, "*batch n"]
    vectors: Complex[Array, "*batch n n"]
    left: Complex[Array, "*batch n n"]
    condition: Float[Array, "*batch n"]


def eig(A: Float[Array, "*batch n n"]) -> Eig:
    """Eigenvalues and eigenvectors of A by LAPACK.

        d lambda = y^H dA x / (y^H x)

    Where two eigenvalues coalesce they have no derivative, and near it this formula loses its digits: there, at a
    `condition` above 1e6, the derivative is NaN.
    """
    values, left, vectors = _decomposed(A)
    return Eig(values, vectors, left, _condition(left, vectors))


def _condition(left, right):
    s = jnp.abs(jnp.sum(left.conj() * right, axis=-2))
    return 1.0 / jnp.where(s > 0, s, jnp.finfo(s.dtype).tiny)


@jax.custom_jvp
def _decomposed(A):
    return tuple(jax.lax.linalg.eig(A, compute_left_eigenvectors=True, compute_right_eigenvectors=True))


@_decomposed.defjvp
def _(primals, tangents):
    (A,), (dA,) = primals, tangents
    values, left, right = _decomposed(A)
    y, x = jax.lax.stop_gradient((left, right))
    # Y^H dA X, of which the diagonal; per unit of y^H x
    moved = jnp.einsum("...ji,...jk,...ki->...i", y.conj(), dA.astype(x.dtype), x)
    weight = 1.0 / jnp.sum(y.conj() * x, axis=-2)
    good = _condition(y, x) < MOST_CONDITION
    weight = jnp.where(good, weight, jnp.nan)
    zeros = jax.tree.map(jnp.zeros_like, (left, right))
    return (values, left, right), (_weighted(weight, moved), *zeros)


def _weighted(weight, x):
    # weight * x, whose transpose leaves alone what no cotangent asks for: NaN of one eigenvalue is not that of all.
    # JAX lets the transpose of a linear solve be written, so this is one, of the diagonal 1 / weight.
    return jax.lax.custom_linear_solve(
        lambda y: y / weight,
        x,
        solve=lambda _, x: weight * x,
        transpose_solve=lambda _, ct: jnp.where(ct == 0, jnp.zeros_like(ct), weight * ct),
    )
