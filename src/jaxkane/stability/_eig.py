"""Eigenvalues with derivatives that say where there are none. Knows matrices and nothing of mechanics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .. import _native as native
from ._qr import CHUNK, SIZES, qr_eigenvalues

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
    values, left, vectors = jnp.vectorize(_decomposed, signature="(n,n)->(n),(n,n),(n,n)")(A)
    return Eig(values, vectors, left, _condition(left, vectors))


def eigvals(A: Float[Array, "*batch n n"]) -> Complex[Array, "*batch n"]:
    """Eigenvalues of A alone, with the derivatives that those of `eig` have: vectors are computed only for them."""
    return jnp.vectorize(_values, signature="(n,n)->(n)")(A)


def _condition(left, right):
    s = jnp.abs(jnp.sum(left.conj() * right, axis=-2))
    return 1.0 / jnp.where(s > 0, s, jnp.finfo(s.dtype).tiny)


# LAPACK gets one matrix at a time. jaxlib cuts a batch into tasks for XLA's pool of threads and waits for them; where
# the waiting threads are those of the pool, since several programs run at once, that is for ever (jaxlib 0.10).


@jax.custom_batching.sequential_vmap
def _by_lapack(A):
    return tuple(jax.lax.linalg.eig(A, compute_left_eigenvectors=True, compute_right_eigenvectors=True))


@jax.custom_batching.custom_vmap
def _values_alone(A):
    return jax.lax.linalg.eig(A, compute_left_eigenvectors=False, compute_right_eigenvectors=False)[0]


@_values_alone.def_vmap
def _(axis_size, is_batched, A):
    if native.is_on() and axis_size >= CHUNK and A.shape[-1] in SIZES:  # which takes a second to compile
        return jax.lax.map(qr_eigenvalues, A, batch_size=CHUNK), True
    return jax.lax.map(_values_alone, A), True


@jax.custom_jvp
def _decomposed(A):
    return _by_lapack(A)


@jax.custom_jvp
def _values(A):
    return _values_alone(A)


@_decomposed.defjvp
def _(primals, tangents):
    (A,), (dA,) = primals, tangents
    values, left, right = _decomposed(A)
    y, x = jax.lax.stop_gradient((left, right))
    # Y^H dA X, of which the diagonal; per unit of y^H x
    moved = jnp.einsum("ji,jk,ki->i", y.conj(), dA.astype(x.dtype), x)
    weight = 1.0 / jnp.sum(y.conj() * x, axis=0)
    weight = jnp.where(_condition(y, x) < MOST_CONDITION, weight, jnp.nan)
    zeros = jax.tree.map(jnp.zeros_like, (left, right))
    return (values, left, right), (_weighted(weight, moved), *zeros)


@_values.defjvp
def _(primals, tangents):
    return jax.jvp(lambda A: _decomposed(A)[0], primals, tangents)


def _weighted(weight, x):
    # weight * x, whose transpose leaves alone what no cotangent asks for: NaN of one eigenvalue is not that of all.
    # JAX lets the transpose of a linear solve be written, so this is one, of the diagonal 1 / weight.
    return jax.lax.custom_linear_solve(
        lambda y: y / weight,
        x,
        solve=lambda _, x: weight * x,
        transpose_solve=lambda _, ct: jnp.where(ct == 0, jnp.zeros_like(ct), weight * ct),
    )
