"""One step of a Kalman filter in square-root form: moments of a function, and their update by measurements.

Shared by `fit` and `estimate`; `export.c_filter` writes the same step in C. Depends on matrices and functions only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def root(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "k n"]]:
    """S (n, n) = A Q with S S^T = A A^T, k >= n, and Q (k, n), whose columns are orthonormal.

    Q is constant in derivatives: dS = dA Q. This satisfies d(S S^T) = d(A A^T), because the rows of A are linear
    combinations of the columns of Q. Unlike the derivative of a triangular factor, it also exists if A does not have
    full rank.
    """
    Q = jax.lax.stop_gradient(jnp.linalg.qr(jax.lax.stop_gradient(A).T)[0])
    return A @ Q, Q


@jax.custom_jvp
def polar(B: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "n k"], Float[Array, "n n"]]:
    """The polar decomposition B = H X: the symmetric root H (n, n) of B B^T, X (n, k), and I - X X^T.

    X X^T is the projection onto the range of B. H depends only on the covariance B B^T, even if this is singular. A
    rounding error of B changes H by at most twice as much (Higham, Functions of Matrices, 2008, Section 8.2). A
    triangular root has neither property: if B does not have full rank, its columns depend on rounding errors.
    """
    return _polar(B)[:3]


def _polar(B: Array) -> Any:
    U, s, V = jnp.linalg.svd(B, full_matrices=False)
    known = s > float(jnp.finfo(B.dtype).eps) ** (2 / 3) * s[0]
    inside, outside = jnp.where(known[None], U, 0.0), jnp.where(known[None], 0.0, U)
    return (U * s[None]) @ U.T, inside @ V, outside @ outside.T, U, s, known


@polar.defjvp
def _polar_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """H dH + dH H = d(B B^T),  X = H^+ B. Exact as long as the rank does not change."""
    (B,), (dB,) = primals, tangents
    H, X, rest, U, s, known = _polar(B)
    half, either = U.T @ dB @ (B.T @ U), known[:, None] | known[None, :]
    dH = U @ jnp.where(either, (half + half.T) / jnp.where(either, s[:, None] + s[None, :], 1.0), 0.0) @ U.T
    inverse = (U * jnp.where(known, 1 / jnp.where(known, s, 1.0), 0.0)[None]) @ U.T
    turn = rest @ dH @ inverse
    return (H, X, rest), (dH, inverse @ (dB - dH @ X) + turn @ X, -turn - turn.T)


def moments(
    f: Callable[[Array, Array], Array], m: Array, S: Array, amplitude: Array, method: str = "extended"
) -> tuple[Float[Array, " c"], Float[Array, "c k_all"]]:
    """The mean (c,) of f(m + S x, amplitude * w) and a root (c, k_all) of its covariance.

    x (k,) and w are standard normal. The first k columns of the root belong to x. They contain the correlation with all
    other functions of x.

    "extended" linearizes f at (m, 0). "unscented" evaluates f at the 2 n points m +- sqrt(n) L e_j, L L^T = S S^T (the
    cubature rule of Arasaratnam and Haykin, Cubature Kalman filters, 2009), and at (m, +- amplitude) for each w. The
    points depend only on the covariance. They must not depend on the number of columns of S, which grows with `lag`,
    nor on the number of w. Otherwise, the present estimate would depend on both numbers.
    """
    n, n_w = S.shape[0], amplitude.size
    zero = jnp.zeros_like(amplitude)

    def with_w(steps: Array) -> tuple[Array, Array]:
        """Steps of m (j, n) and of w. Each step changes only one of the two."""
        w_alone, m_alone = jnp.zeros((n_w, n), S.dtype), jnp.zeros((len(steps), n_w), S.dtype)
        return jnp.concatenate([steps, w_alone]), jnp.concatenate([m_alone, jnp.diag(amplitude)])

    if method == "extended":

        def along(*direction):
            return jax.jvp(f, (m, zero), direction)

        return jax.vmap(along, out_axes=(None, 1))(*with_w(S.T))
    squares = jnp.sum(S**2, axis=1, keepdims=True)
    size = jnp.sqrt(jnp.where(squares > 0, squares, 1.0))  # so that units have no effect
    H, X, rest = polar(S / size)
    spread = jnp.sqrt(jnp.asarray(n, S.dtype))
    steps = with_w(spread * (size * H).T)
    plus, minus = (jax.vmap(lambda d, e, s=s: f(m + s * d, s * e))(*steps) for s in (1.0, -1.0))
    mean = jnp.mean(jnp.concatenate([plus[:n], minus[:n]]), axis=0)
    odd, even = (plus - minus).T / 2, (plus + minus - 2 * mean[None])[:n].T / 2
    parts = [odd[:, :n] / spread @ X, odd[:, :n] / spread @ rest, even / spread, odd[:, n:]]
    return mean, jnp.concatenate(parts, axis=1)


class Update(NamedTuple):
    """The update of a state m + S x by the measurements of one instant. Before the update, x (n,) is standard normal.

    - `innovation`: measured minus predicted (n_c,), where each prediction uses the previous measurements. Zero in gaps.
    - `deviation`: standard deviations (n_c,) of the innovations. One in gaps.
    - `known`: change (n_c,) of each prediction by the previous measurements.
    - `shift`: mean (n,) of x after the update.
    - `left`: root (n, n) of the covariance of x after the update, left left^T.
    """

    innovation: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    known: Float[Array, " n_c"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]


def update(
    error: Float[Array, " n_c"], F: Float[Array, "n_c n"], sigma: Float[Array, " n_c"], measured: Bool[Array, " n_c"]
) -> Update:
    """Update by measurements with independent errors, one after the other.

    **Arguments:**

    - `error`: measured minus predicted at m (n_c,).
    - `F`: sensitivities of the predicted measurements to x (n_c, n).
    - `sigma`: standard deviations of the measurements (n_c,).
    - `measured`: which measurements exist (n_c,).

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
