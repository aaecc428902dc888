"""Least squares with a block structure, by orthogonal elimination. Knows matrices; knows nothing of what they mean.

The unknowns of a window (z), of the window after it (z_next), of a trial (b) and of all (x) meet in residuals that are
kept, window by window, as a triangle: |J d + r|^2 = |R [d; 1]|^2 with columns [z, z_next, b, x, r]. Eliminating z from
window to window, then b in every trial, leaves one small problem in x: what a Schur complement of J^T J gives, without
squaring its condition number. Where windows are chained (z_next), that is the square-root information filter, and the
way back its smoother (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int


class Blocks(eqx.Module):
    """Linearized residuals: `R` (W, k, k) with k = n_z + n_next + n_b + n_x + 1, where n_next is n_z or, without
    chains, 0; and the windows of every trial in their order (T, m), padded with W."""

    R: Float[Array, "W k k"]
    windows: Int[Array, "T m"]
    n_z: int = eqx.field(static=True)
    n_next: int = eqx.field(static=True)
    n_b: int = eqx.field(static=True)

    @property
    def n_x(self) -> int:
        return self.R.shape[-1] - self.n_z - self.n_next - self.n_b - 1

    @property
    def cost(self) -> Array:
        """Sum of squares of the residuals."""
        return jnp.sum(self.R[:, :, -1] ** 2)

    @property
    def column_norms(self) -> Array:
        """Norms (n_x,) of the sensitivity's columns before anything is eliminated."""
        return jnp.sqrt(jnp.sum(self.R[:, :, -1 - self.n_x : -1] ** 2, axis=(0, 1)))

    @property
    def without_influence(self) -> Array:
        """Whether an x (n_x,) moves no residual by more than rounding errors."""
        norms = self.column_norms
        return norms <= 1e4 * jnp.finfo(norms.dtype).eps * jnp.max(norms)

    @property
    def gradient(self) -> tuple[Array, Array, Array]:
        """Of half the sum of squares by z (W, n_z), b (T, n_b) and x (n_x,)."""
        products = _by_trial(jnp.einsum("wij,wi->wj", self.R, self.R[:, :, -1]), self.windows)  # (T, m, k)
        z = products[:, :, : self.n_z]
        if self.n_next:
            z = z.at[:, 1:].add(products[:, :-1, self.n_z : 2 * self.n_z])
        shared = products[:, :, self.n_z + self.n_next : -1]
        b, x = shared[:, :, : self.n_b], shared[:, :, self.n_b :]
        return _of_windows(z, self.windows, self.R.shape[0]), jnp.sum(b, axis=1), jnp.sum(x, axis=(0, 1))


class Eliminated(eqx.Module):
    """What is left: `R` (T, n_x + 1, n_x + 1) with columns [x, r], and the rows that give z and b back."""

    R: Float[Array, "T n n"]
    z_rows: Float[Array, "T m n_z k"]
    b_rows: Float[Array, "T n_b kb"]
    scale: Float[Array, " n_x"]
    blocks: Blocks

    @property
    def rows(self) -> tuple[Array, Array]:
        """Sensitivity (m, n_x) and residual (m,) of the remaining problem."""
        flat = self.R.reshape(-1, self.R.shape[-1])
        return flat[:, :-1], flat[:, -1]

    @property
    def log_determinant(self) -> Array:
        """log det of the information about z and b, those without any left out."""
        logs = [
            jnp.sum(jnp.log(jnp.where(known, d, 1.0))) for d, known in zip(self._diagonals, self.informed, strict=True)
        ]
        return 2 * (logs[0] + logs[1])

    @property
    def informed(self) -> tuple[Array, Array]:
        """Whether there is information about z (T, m, n_z) and b (T, n_b): elimination leaves rounding errors of a
        column that others can stand for, and less of one that moves no residual."""

        def of(d: Array, squares: Array) -> Array:
            norm, eps, tiny = _safe(squares), jnp.finfo(d.dtype).eps, jnp.finfo(d.dtype).tiny
            return (d > 1e5 * eps * norm) & (norm > tiny**0.25)

        (of_z, of_b), (z, b) = _column_squares(self.blocks), self._diagonals
        return of(z, of_z), of(b, of_b)

    @property
    def _diagonals(self) -> tuple[Array, Array]:
        n_z, n_b = self.z_rows.shape[2], self.b_rows.shape[1]
        of = lambda R: jnp.abs(jnp.diagonal(R, axis1=-2, axis2=-1))  # noqa: E731
        return of(self.z_rows[..., :n_z]), of(self.b_rows[..., :n_b])

    @jax.jit
    def step(self, damping: Array | float) -> tuple[Array, Array]:
        """The x (n_x,) that minimizes the sum of squares with `damping` * |column| * x added, and that minimum."""
        A, r = self.rows
        n = A.shape[1]
        A = jnp.concatenate([A, jnp.diag(damping * self.scale)])
        R = jnp.linalg.qr(jnp.column_stack([A, jnp.append(r, jnp.zeros(n, r.dtype))]), mode="r")
        return solve_triangular(R[:n, :n], -R[:n, n]), R[n, n] ** 2

    @jax.jit
    def back_substitute(self, x: Array) -> tuple[Array, Array]:
        """z (W, n_z) and b (T, n_b) that go with a step x."""
        n_z = self.z_rows.shape[2]

        def of_trial(z_rows, b_rows):
            b = _back(b_rows, x)

            def of_window(z_next, rows):
                z = _back(rows, jnp.concatenate([z_next[: self.blocks.n_next], b, x]))
                return z, z

            return jax.lax.scan(of_window, jnp.zeros(n_z, x.dtype), z_rows, reverse=True)[1], b

        z, b = jax.vmap(of_trial)(self.z_rows, self.b_rows)
        return _of_windows(z, self.blocks.windows, self.blocks.R.shape[0]), b


def eliminate(blocks: Blocks, damping: Array | np.ndarray | float) -> Eliminated:
    """z and b eliminated, each with `damping` * |column| * unknown added to the residuals (Levenberg-Marquardt).

    `damping`: a number, or one for every trial (T,).
    """
    of_trials = jnp.broadcast_to(jnp.asarray(damping, blocks.R.dtype), blocks.windows.shape[:1])
    return _eliminate(blocks, of_trials)


@jax.jit
def _eliminate(blocks: Blocks, damping: Float[Array, " T"]) -> Eliminated:
    R, n_z, n_next, n_b, n_x = blocks.R, blocks.n_z, blocks.n_next, blocks.n_b, blocks.n_x
    # What has no influence has rounding errors; a step along them would lead anywhere.
    none = jnp.zeros(R.shape[-1], bool).at[-1 - n_x : -1].set(blocks.without_influence)
    R = jnp.where(none[None, None, :], 0.0, R)
    of_z, of_b = _column_squares(blocks)
    # Never quite zero: an unknown without influence then stays where it is, instead of becoming NaN.
    damping = jnp.maximum(damping, 1e3 * jnp.finfo(R.dtype).eps)[:, None]
    c = n_next + n_b + n_x + 1

    def of_trial(rows, z_damping):
        def of_window(known, now):  # known (c, c): what earlier windows say about [z if chained, b, x, r]
            rows, damping = now
            split = n_z if n_next else 0
            known = jnp.concatenate([known[:, :split], jnp.zeros((c, n_z), R.dtype), known[:, split:]], axis=1)
            z_rows, rest = _triangle(jnp.concatenate([known, rows]), n_z, damping)
            return rest, z_rows

        rest, z_rows = jax.lax.scan(of_window, jnp.zeros((c, c), R.dtype), (rows, z_damping))
        return rest[:, n_next:], z_rows  # after a trial's last window there is no next

    rest, z_rows = jax.vmap(of_trial)(_by_trial(R, blocks.windows), damping[:, None] * _safe(of_z))
    b_rows, rest = jax.vmap(lambda rows, d: _triangle(rows, n_b, d))(rest, damping * _safe(of_b))
    scale = _safe(jnp.sum(R**2, axis=(0, 1))[-1 - n_x : -1])
    return Eliminated(rest, z_rows, b_rows, scale, blocks)


def _column_squares(blocks: Blocks) -> tuple[Array, Array]:
    """Of the columns of z (T, m, n_z) and b (T, n_b)."""
    n_z, n_next = blocks.n_z, blocks.n_next
    squares = _by_trial(jnp.sum(blocks.R**2, axis=1), blocks.windows)  # (T, m, k)
    of_z = squares[:, :, :n_z]
    if n_next:
        of_z = of_z.at[:, 1:].add(squares[:, :-1, n_z : 2 * n_z])
    return of_z, jnp.sum(squares, axis=1)[:, n_z + n_next : n_z + n_next + blocks.n_b]


def _by_trial(x: Array, windows: Array) -> Array:
    """(W, ...) to (T, m, ...), zero where there is no window."""
    return jnp.concatenate([x, jnp.zeros_like(x[:1])])[windows]


def _of_windows(x: Array, windows: Array, W: int) -> Array:
    """(T, m, n) to (W, n)."""
    return jnp.zeros((W + 1, x.shape[-1]), x.dtype).at[windows].set(x)[:W]


def _safe(squares: Array) -> Array:
    """Column norms, kept from zero."""
    if squares.shape[-1] == 0:
        return squares
    largest = jnp.max(squares, axis=-1, keepdims=True)
    return jnp.sqrt(jnp.maximum(squares, 1e-16 * largest) + jnp.finfo(squares.dtype).tiny)


def _triangle(R: Array, n: int, damping: Array) -> tuple[Array, Array]:
    """Rows (n, k) that hold the first n unknowns, and the triangle (k-n, k-n) without them."""
    k = R.shape[1]
    rows = jnp.zeros((n, k), R.dtype).at[jnp.arange(n), jnp.arange(n)].set(damping)
    R = jnp.concatenate([R, rows, jnp.zeros((max(k - R.shape[0] - n, 0), k), R.dtype)])
    R = jnp.linalg.qr(R, mode="r")
    return R[:n, :], R[n:k, n:]


def _back(rows: Array, known: Array) -> Array:
    """Unknowns (n,) from rows (n, n + m + 1) and the m that are known."""
    n = rows.shape[0]
    if n == 0:
        return jnp.zeros(0, rows.dtype)
    return solve_triangular(rows[:, :n], -(rows[:, n:-1] @ known + rows[:, -1]))
