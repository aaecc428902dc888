"""Eigenvalues with derivatives that say where there are none. Knows matrices and nothing of mechanics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._scalars import native
from .._scalars.nan import _spread
from ._qr import CHUNK, SIZES, qr_eigenvalues

MOST_CONDITION = 1e6
_APART = 1e4  # rounding errors of the largest eigenvalue: nearer ones are one, whose vectors are any of a plane


class Eig(NamedTuple):
    """Eigenvalues and what belongs to them.

    `values` (n,) [1/s]: the real ones, the largest first, and then the pairs by rising frequency; `vectors` (n, n),
    right eigenvectors of unit length in its columns, and `left`; `condition` (n,): 1 / |y^H x| of the left and right
    eigenvectors of unit length, by how much an error of A is magnified in the eigenvalue, infinite where two coalesce.
    """

    values: Complex[Array, "*batch n"]
    vectors: Complex[Array, "*batch n n"]
    left: Complex[Array, "*batch n n"]
    condition: Float[Array, "*batch n"]


def eig(A: Float[Array, "*batch n n"]) -> Eig:
    """Eigenvalues and eigenvectors of A by LAPACK.

        d lambda = y^H dA x / (y^H x)

    and so any number of times, the eigenvectors' part included. Where two eigenvalues coalesce they have no derivative,
    and near it this formula loses its digits: there, at a `condition` above 1e6, the derivatives are NaN.
    """
    values, left, vectors = jnp.vectorize(_decomposed, signature="(n,n)->(n),(n,n),(n,n)")(A)
    return Eig(values, vectors, left, _condition(values, left, vectors))


def eigvals(A: Float[Array, "*batch n n"]) -> Complex[Array, "*batch n"]:
    """Eigenvalues of A alone, with the derivatives that those of `eig` have: vectors are computed only for them."""
    return jnp.vectorize(_values, signature="(n,n)->(n)")(A)


def _condition(values, left, right):
    s = jnp.abs(jnp.sum(left.conj() * right, axis=-2))
    far = jax.lax.stop_gradient(jnp.abs(values[..., :, None] - values[..., None, :]))
    far = jnp.where(jnp.eye(values.shape[-1], dtype=bool), jnp.inf, far)
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(values)), axis=-1, keepdims=True)
    apart = jnp.min(far, axis=-1) > _APART * jnp.finfo(s.dtype).eps * size
    return jnp.where((apart & (s > 0)) | jnp.isnan(s), 1.0 / jnp.where(s == 0, 1.0, s), jnp.inf)


# LAPACK gets one matrix at a time. jaxlib cuts a batch into tasks for XLA's pool of threads and waits for them; where
# the waiting threads are those of the pool, since several programs run at once, that is a deadlock (jaxlib 0.10).


@jax.custom_batching.sequential_vmap
def _by_lapack(A):
    values, Y, X = jax.lax.linalg.eig(A, compute_left_eigenvectors=True, compute_right_eigenvectors=True)
    order = jnp.lexsort(_keys(values))
    return values[order], Y[:, order], X[:, order]


@jax.custom_batching.custom_vmap
def _values_alone(A):
    return _in_order(jax.lax.linalg.eig(A, compute_left_eigenvectors=False, compute_right_eigenvectors=False)[0])


@_values_alone.def_vmap
def _(axis_size, is_batched, A):
    if native.is_on() and axis_size >= CHUNK and A.shape[-1] in SIZES:  # which takes a second to compile
        return jax.lax.map(lambda A: _in_order(qr_eigenvalues(A)), A, batch_size=CHUNK), True
    return jax.lax.map(_values_alone, A), True


def _keys(values):
    # The frequency first: what hardly decays has a real part of rounding errors, by which no two algorithms agree.
    return -values.imag, -values.real, jnp.abs(values.imag)


def _in_order(values):
    return values[jnp.lexsort(_keys(values))]


@jax.custom_jvp
def _decomposed(A):
    return _by_lapack(A)


@jax.custom_jvp
def _values(A):
    return _values_alone(A)


@_decomposed.defjvp
def _(primals, tangents):
    (A,), (dA,) = primals, tangents
    values, Y, X = _decomposed(A)
    lost = ~(jax.lax.stop_gradient(_condition(values, Y, X)) < MOST_CONDITION)
    A_c, dA_c = A.astype(X.dtype), dA.astype(X.dtype)
    # Ones stand for what is lost, since NaN would spoil the gradients of callers who do not use it (0 * NaN).
    still, y, x = (jnp.where(lost, 1.0, z) for z in (values, Y, X))
    # Y^H dA X, of which the diagonal; per unit of y^H x
    d_values = jnp.einsum("ji,jk,ki->i", y.conj(), dA_c, x) / jnp.where(lost, 1.0, jnp.sum(y.conj() * x, axis=0))
    dX = _turned(A_c, dA_c, still, x, lost)
    dY = _turned(A_c.conj().T, dA_c.conj().T, still.conj(), y, lost)
    none = _spread(dA, A, lost.shape)
    none = jax.lax.complex(none, none)
    return (values, Y, X), tuple(jnp.where(lost, none, d) for d in (d_values, dY, dX))


@_values.defjvp
def _(primals, tangents):
    values = _values(*primals)
    decomposed, slopes = jax.jvp(lambda A: _decomposed(A)[0], primals, tangents)
    same = jnp.argmin(jnp.abs(values[:, None] - decomposed[None, :]), axis=1)
    return values, slopes[same]


def _turned(A, dA, values, X, lost):
    """dX (n, n) of the eigenvectors in the columns of X, of unit length and with a real largest entry, as LAPACK's.

        (lambda - A) dx + d lambda x = dA x,   x^H dx = 0,   and a turn i x so that the largest entry stays real

    Unlike a sum over the other eigenvectors this holds where others coalesce, as long as this one is separated.
    """

    def one(value, x, lost):
        bordered = jnp.block([[value * jnp.eye(len(A), dtype=x.dtype) - A, x[:, None]], [x.conj()[None], 0j]])
        bordered = jnp.where(lost, jnp.eye(len(A) + 1, dtype=x.dtype), bordered)
        dx = jnp.linalg.solve(bordered, jnp.append(dA @ x, jnp.zeros(1, x.dtype)))[:-1]
        k = jnp.argmax(jnp.abs(jax.lax.stop_gradient(x)))
        turn = (dx[k] / x[k]).imag
        return dx - jax.lax.complex(jnp.zeros_like(turn), turn) * x

    return jax.vmap(one, in_axes=(0, 1, 0), out_axes=1)(values, X, lost)
