"""Least squares with a block structure, by orthogonal elimination. Knows matrices; knows nothing of what they mean.

The unknowns of a window (z), of a trial (b) and of all (x) meet in residuals that are kept, window by window, as a
triangle: |J d + r|^2 = |R [d; 1]|^2 with columns [z, b, x, r]. Eliminating z in every window, then b in every trial,
leaves one small problem in x: what a Schur complement of J^T J gives, without squaring its condition number
(square-root information form: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int


class Blocks(eqx.Module):
    """Linearized residuals: `R` (W, k, k) with k = n_z + n_b + n_x + 1; `trial` (W,), and the windows of every trial
    (T, m), filled up with W."""

    R: Float[Array, "W k k"]
    trial: Int[Array, " W"]
    windows: Int[Array, "T m"]
    n_z: int = eqx.field(static=True)
    n_b: int = eqx.field(static=True)

    @property
    def cost(self) -> Array:
        """Sum of squares of the residuals."""
        return jnp.sum(self.R[:, :, -1] ** 2)

    @property
    def column_norms(self) -> Array:
        """Norms (n_x,) of the sensitivity's columns before anything is eliminated."""
        return jnp.sqrt(jnp.sum(self.R[:, :, self.n_z + self.n_b : -1] ** 2, axis=(0, 1)))

    @property
    def silent(self) -> Array:
        """Whether an x (n_x,) moves no residual by more than rounding errors."""
        norms = self.column_norms
        return norms <= 1e4 * jnp.finfo(norms.dtype).eps * jnp.max(norms)


class Eliminated(eqx.Module):
    """What is left: `R` (T, n_x + 1, n_x + 1) with columns [x, r], and the rows that give z and b back."""

    R: Float[Array, "T n n"]
    z_rows: Float[Array, "W n_z k"]
    b_rows: Float[Array, "T n_b kb"]
    scale: Float[Array, " n_x"]
    trial: Int[Array, " W"]

    @property
    def rows(self) -> tuple[Array, Array]:
        """Sensitivity (m, n_x) and residual (m,) of the remaining problem."""
        flat = self.R.reshape(-1, self.R.shape[-1])
        return flat[:, :-1], flat[:, -1]

    def step(self, damping: Array | float) -> tuple[Array, Array]:
        """The x (n_x,) that minimizes the sum of squares with `damping` * |column| * x added, and that minimum."""
        A, r = self.rows
        n = A.shape[1]
        A = jnp.concatenate([A, jnp.diag(damping * self.scale)])
        R = jnp.linalg.qr(jnp.column_stack([A, jnp.append(r, jnp.zeros(n, r.dtype))]), mode="r")
        return solve_triangular(R[:n, :n], -R[:n, n]), R[n, n] ** 2

    def others(self, x: Array) -> tuple[Array, Array]:
        """z (W, n_z) and b (T, n_b) that go with a step x."""
        b = _back(self.b_rows, jnp.broadcast_to(x, (self.b_rows.shape[0], x.shape[0])))
        shared = jnp.concatenate([b[self.trial], jnp.broadcast_to(x, (self.trial.shape[0], x.shape[0]))], axis=1)
        return _back(self.z_rows, shared), b


@jax.jit
def eliminate(blocks: Blocks, damping: Array | float) -> Eliminated:
    """z and b eliminated, each with `damping` * |column| * unknown added to the residuals (Levenberg-Marquardt)."""
    R, n_z, n_b = blocks.R, blocks.n_z, blocks.n_b
    # What has no influence has rounding errors; a step along them would lead anywhere.
    silent = jnp.zeros(R.shape[-1], bool).at[n_z + n_b : -1].set(blocks.silent)
    R = jnp.where(silent[None, None, :], 0.0, R)
    squares = jnp.sum(R**2, axis=1)  # (W, k)
    by_trial = jnp.zeros((blocks.windows.shape[0], R.shape[-1]), R.dtype).at[blocks.trial].add(squares)
    # Never quite zero: an unknown without influence then stays where it is, instead of becoming NaN.
    damping = jnp.maximum(jnp.asarray(damping, R.dtype), 1e3 * jnp.finfo(R.dtype).eps)
    z_rows, rest = _triangle(R, n_z, damping * _safe(squares[:, :n_z]))
    rest = jnp.concatenate([rest, jnp.zeros_like(rest[:1])])[blocks.windows]  # (T, m, k', k')
    rest = rest.reshape(rest.shape[0], -1, rest.shape[-1])
    b_rows, rest = _triangle(rest, n_b, damping * _safe(by_trial[:, n_z : n_z + n_b]))
    return Eliminated(rest, z_rows, b_rows, _safe(jnp.sum(squares, axis=0)[n_z + n_b : -1]), blocks.trial)


def _safe(squares: Array) -> Array:
    """Column norms, kept from zero."""
    if squares.shape[-1] == 0:
        return squares
    largest = jnp.max(squares, axis=-1, keepdims=True)
    return jnp.sqrt(jnp.maximum(squares, 1e-16 * largest) + jnp.finfo(squares.dtype).tiny)


def _triangle(R: Array, n: int, damping: Array) -> tuple[Array, Array]:
    """Rows (batch, n, k) that hold the first n unknowns, and the triangle (batch, k-n, k-n) without them."""
    batch, _, k = R.shape
    rows = jnp.zeros((batch, n, k), R.dtype).at[:, jnp.arange(n), jnp.arange(n)].set(damping)
    R = jnp.concatenate([R, rows], axis=1)
    if R.shape[1] < k:
        R = jnp.concatenate([R, jnp.zeros((batch, k - R.shape[1], k), R.dtype)], axis=1)
    R = jnp.linalg.qr(R, mode="r")
    return R[:, :n, :], R[:, n:k, n:]


def _back(rows: Array, known: Array) -> Array:
    """Unknowns (batch, n) from rows (batch, n, n + m + 1) and the m that are known."""
    n, m = rows.shape[1], known.shape[1]
    if n == 0:
        return jnp.zeros((rows.shape[0], 0), rows.dtype)
    right = jnp.einsum("bnm,bm->bn", rows[:, :, n : n + m], known) + rows[:, :, -1]
    return solve_triangular(rows[:, :, :n], -right[:, :, None])[:, :, 0]
