"""Kalman filters in square-root form: roots of covariances, and their update by a measurement. Knows matrices."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def root(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "k n"]]:
    """S (n, n) = A Q with S S^T = A A^T, k >= n, and Q (k, n), whose columns are orthonormal.

    Q is held when this is differentiated: dS = dA Q is one of the many dS with d(S S^T) = d(A A^T), since the rows of A
    are combinations of the columns of Q, and unlike that of a triangle it exists where A has no full rank.
    """
    Q = jax.lax.stop_gradient(jnp.linalg.qr(jax.lax.stop_gradient(A).T)[0])
    return A @ Q, Q


def ordered(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The root S Q of the same covariance that is a triangle but for the order of its rows: that of S, with the rows at
    the end that those before them determine.

    It follows from the covariance alone, but for signs of columns. A plain triangle does not where S has no full rank:
    rounding errors choose its columns, and with them the points that an unscented filter takes.
    """
    n, size = len(S), jnp.linalg.norm(jax.lax.stop_gradient(S), axis=1)
    columns = jnp.arange(n)

    def reflect(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        M, is_done = carry
        rest = jnp.where((columns >= i)[None], M[:n], 0.0)
        remainder = jnp.linalg.norm(rest, axis=1)
        row = jnp.argmax(jnp.where(is_done, -1, (remainder > 1e-3 * size).astype(int)))  # the first of the largest
        a, norm = rest[row], remainder[row]
        beta = jnp.where(a[i] > 0, -norm, norm)
        v = a.at[i].add(-beta)
        scale = jnp.where(norm > 0, 1.0 / jnp.where(norm > 0, beta * (beta - a[i]), 1.0), 0.0)
        return M - scale * jnp.outer(M @ v, v), is_done.at[row].set(True)

    M = jnp.concatenate([jax.lax.stop_gradient(S), jnp.eye(n, dtype=S.dtype)])
    return S @ jax.lax.fori_loop(0, n, reflect, (M, jnp.zeros(n, bool)))[0][n:]


class Update(NamedTuple):
    """The update of a state m + S x, with x (n,) standard normal before, by the measurements of one instant.

    - `innovation`, `deviation` (n_c,): measured less predicted, each after those before it, and its standard deviation;
        zero and one where nothing was measured.
    - `known` (n_c,): by how much those before it raise what is predicted of a measurement.
    - `shift` (n,), `left` (n, n): x is Gaussian with this mean and the covariance left left^T after.
    """

    innovation: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    known: Float[Array, " n_c"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]


def update(
    error: Float[Array, " n_c"], F: Float[Array, "n_c n"], sigma: Float[Array, " n_c"], measured: Bool[Array, " n_c"]
) -> Update:
    """Measurements with independent errors, one after the other.

    `error`: measured less predicted at m; `F`: its sensitivity to x; `sigma`: the measurements' standard deviations;
    `measured`: which there are.

        s^2 = f f^T + sigma^2,   S+ = S (1 - f f^T / (s (s + sigma)))

    (Potter's form of the update; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, Chapter V.)
    """
    n = F.shape[1]
    shift, left = jnp.zeros(n, F.dtype), jnp.eye(n, dtype=F.dtype)
    innovations, deviations, known = [], [], []
    for c in range(F.shape[0]):
        is_measured = measured[c]
        f = jnp.where(is_measured, left.T @ F[c], 0.0)
        r = jnp.where(is_measured, sigma[c], 1.0)
        known.append(F[c] @ shift)
        e = jnp.where(is_measured, error[c] - known[-1], 0.0)
        s = jnp.sqrt(f @ f + r**2)
        moved = left @ f
        shift = shift + moved * e / s**2
        left = left - jnp.outer(moved, f) / (s * (s + r))
        innovations.append(e)
        deviations.append(s)
    return Update(jnp.stack(innovations), jnp.stack(deviations), jnp.stack(known), shift, left)
