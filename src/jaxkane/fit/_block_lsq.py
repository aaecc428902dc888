"""Least squares with a block structure, by orthogonal elimination. Knows matrices; knows nothing of what they mean.

The unknowns of a window (z), of the window after it (z_next), of a trial (b) and of all (x) meet in residuals that are
kept, window by window, as a triangle: |J d + r|^2 = |R [d; 1]|^2 with columns [z, z_next, b, x, r]. Eliminating z from
window to window, then b in every trial, leaves one small problem in x: what a Schur complement of J^T J gives, without
squaring its condition number. Where windows are chained (z_next), that is the square-root information filter, and the
way back its smoother (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._scalarjit.compat import on_device


class Blocks(eqx.Module):
    """Linearized residuals: `R` (W, m, k) with k = n_z + n_next + n_b + n_x + 1, where n_next is n_z or, without
    chains, 0; and the windows of every trial in their order (T, m), padded with W."""

    R: Float[Array, "W m k"]
    windows: Int[Array, "T m"]
    n_z: int = eqx.field(static=True)
    n_next: int = eqx.field(static=True)
    n_b: int = eqx.field(static=True)

    @classmethod
    def of(cls, nuisance: Any, R: Any, windows: Any) -> Blocks:
        """With the numbers of unknowns of a `Nuisance`."""
        n_z = len(nuisance.start)
        return cls(R, windows, n_z, n_z if nuisance.has_defects else 0, len(nuisance.trial))

    @property
    def n_x(self) -> int:
        return self.R.shape[-1] - self.n_z - self.n_next - self.n_b - 1

    def of_x(self, places: Any) -> Blocks:
        """Those of the x at `places` alone; the others stay where they are."""
        first = self.n_z + self.n_next + self.n_b
        columns = np.concatenate([np.arange(first), first + np.asarray(places), [self.R.shape[-1] - 1]])
        return eqx.tree_at(lambda blocks: blocks.R, self, on_device(np.asarray(self.R)[:, :, columns]))

    @property
    def cost(self) -> Array:
        """Sum of squares of the residuals."""
        return jnp.sum(self.R[:, :, -1] ** 2)

    @property
    def column_norms(self) -> np.ndarray:
        """Norms (n_x,) of the sensitivity's columns before anything is eliminated."""
        return np.linalg.norm(np.asarray(self.R)[:, :, -1 - self.n_x : -1], axis=(0, 1))

    @property
    def without_influence(self) -> np.ndarray:
        """Whether an x (n_x,) moves no residual by more than rounding errors."""
        norms = self.column_norms
        return norms <= 1e4 * np.finfo(norms.dtype).eps * np.max(norms)

    @property
    def gradient(self) -> tuple[Array, Array, Array]:
        """Of half the sum of squares by z (W, n_z), b (T, n_b) and x (n_x,)."""
        products = _by_trial(jnp.einsum("wij,wi->wj", self.R, self.R[:, :, -1]), self.windows)  # (T, m, k)
        z = products[:, :, : self.n_z]
        if self.n_next:
            z = z.at[:, 1:].add(products[:, :-1, self.n_z : 2 * self.n_z])
        shared = products[:, :, self.n_z + self.n_next : -1]
        b, x = shared[:, :, : self.n_b], shared[:, :, self.n_b :]
        W = self.R.shape[0]
        of_windows = jnp.zeros((W + 1, self.n_z), z.dtype).at[self.windows].set(z)[:W]
        return of_windows, jnp.sum(b, axis=1), jnp.sum(x, axis=(0, 1))


class Eliminated(NamedTuple):
    """What is left: `R` (T, n_x + 1, n_x + 1) with columns [x, r], and the rows that give z and b back."""

    R: Float[np.ndarray, "T n n"]
    z_rows: Float[np.ndarray, "T m n_z k"]
    b_rows: Float[np.ndarray, "T n_b kb"]
    scale: Float[np.ndarray, " n_x"]
    blocks: Blocks

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (m, n_x) and residual (m,) of the remaining problem."""
        flat = self.R.reshape(-1, self.R.shape[-1])
        return flat[:, :-1], flat[:, -1]

    @property
    def log_determinant(self) -> float:
        """log det of the information about z and b, those without any left out."""
        parts = zip(self._diagonals, self.informed, strict=True)
        return 2 * float(sum(np.sum(np.log(np.where(known, d, 1.0))) for d, known in parts))

    @property
    def informed(self) -> tuple[np.ndarray, np.ndarray]:
        """Whether there is information about z (T, m, n_z) and b (T, n_b): elimination leaves rounding errors of a
        column that others can stand for, and less of one that moves no residual."""

        def of(d, squares):
            norm, eps, tiny = _safe(squares), np.finfo(d.dtype).eps, np.finfo(d.dtype).tiny
            return (d > 1e5 * eps * norm) & (norm > tiny**0.25)

        (of_z, of_b), (z, b) = _column_squares(self.blocks), self._diagonals
        return of(z, of_z), of(b, of_b)

    @property
    def _diagonals(self) -> tuple[np.ndarray, np.ndarray]:
        n_z, n_b = self.z_rows.shape[2], self.b_rows.shape[1]
        of = lambda R: np.abs(np.diagonal(R, axis1=-2, axis2=-1))  # noqa: E731
        return of(self.z_rows[..., :n_z]), of(self.b_rows[..., :n_b])

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """The x (n_x,) that minimizes the sum of squares with `damping` * |column| * x added, and that minimum."""
        A, r = self.rows
        n = A.shape[1]
        A = np.concatenate([A, np.diag(damping * self.scale)])
        R = _qr(np.column_stack([A, np.append(r, np.zeros(n, r.dtype))]))
        return _back(R[:n], np.zeros(0, r.dtype)), float(R[n, n] ** 2)

    def back_substitute(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z (W, n_z) and b (T, n_b) that go with a step x."""
        T, m, n_z, _ = self.z_rows.shape
        shared = np.broadcast_to(x, (T, len(x)))
        shared = np.concatenate([_back(self.b_rows, shared), shared], axis=-1)
        n_b, W = shared.shape[-1] - len(x), len(self.blocks.R)
        if self.blocks.n_next:
            z = np.zeros((T, m + 1, n_z), x.dtype)
            for i in reversed(range(m)):
                z[:, i] = _back(self.z_rows[:, i], np.concatenate([z[:, i + 1], shared], axis=-1))
            z = z[:, :m]
        else:
            z = _back(self.z_rows, np.broadcast_to(shared[:, None], (T, m, shared.shape[-1])))
        of_windows = np.zeros((W + 1, n_z), x.dtype)
        of_windows[np.asarray(self.blocks.windows)] = z
        return of_windows[:W], shared[:, :n_b]


def eliminate(blocks: Blocks, damping: np.ndarray | float) -> Eliminated:
    """z and b eliminated, each with `damping` * |column| * unknown added to the residuals (Levenberg-Marquardt).

    `damping`: a number, or one for every trial (T,). By NumPy, since a program would take a second to be compiled, and
    windows take longer to be simulated.
    """
    R, n_z, n_next, n_b, n_x = np.array(blocks.R), blocks.n_z, blocks.n_next, blocks.n_b, blocks.n_x
    # What has no influence has rounding errors; a step along them would lead anywhere.
    R[:, :, -1 - n_x : -1][:, :, np.asarray(blocks.without_influence)] = 0.0
    of_z, of_b = _column_squares(blocks)
    T, m = blocks.windows.shape
    # Never quite zero: an unknown without influence then stays where it is, instead of becoming NaN.
    damping = np.broadcast_to(np.asarray(damping, R.dtype), T)
    damping = np.maximum(damping, 1e3 * np.finfo(R.dtype).eps)[:, None]
    rows, z_damping = _by_trial(R, blocks.windows), damping[:, None] * _safe(of_z)
    c = n_next + n_b + n_x + 1
    if n_next:
        z_rows = np.zeros((T, m, n_z, n_z + c), R.dtype)
        known = np.zeros((T, c, n_z + c), R.dtype)  # what earlier windows say about [z, z_next, b, x, r]
        for i in range(m):
            z_rows[:, i], rest = _triangle(np.concatenate([known, rows[:, i]], axis=1), n_z, z_damping[:, i])
            known = np.concatenate([rest[:, :, :n_z], np.zeros_like(rest[:, :, :n_z]), rest[:, :, n_z:]], axis=2)
        rest = rest[:, :, n_next:]  # after a trial's last window there is no next
    else:
        z_rows, rest = _triangle(rows, n_z, z_damping)
        rest = rest.reshape(T, m * c, c)
    b_rows, rest = _triangle(rest, n_b, damping * _safe(of_b))
    scale = _safe(np.sum(R**2, axis=(0, 1))[-1 - n_x : -1])
    return Eliminated(rest, z_rows, b_rows, scale, blocks)


def _column_squares(blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Of the columns of z (T, m, n_z) and b (T, n_b)."""
    n_z, n_next = blocks.n_z, blocks.n_next
    squares = _by_trial(np.sum(np.asarray(blocks.R) ** 2, axis=1), blocks.windows)  # (T, m, k)
    of_z = squares[:, :, :n_z].copy()
    if n_next:
        of_z[:, 1:] += squares[:, :-1, n_z : 2 * n_z]
    return of_z, np.sum(squares, axis=1)[:, n_z + n_next : n_z + n_next + blocks.n_b]


def _by_trial(x: Any, windows: Any) -> Any:
    """(W, ...) to (T, m, ...), zero where there is no window."""
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x, xp.zeros_like(x[:1])])[xp.asarray(windows)]


def _safe(squares: np.ndarray) -> np.ndarray:
    """Column norms, kept from zero."""
    if squares.shape[-1] == 0:
        return squares
    largest = np.max(squares, axis=-1, keepdims=True)
    return np.sqrt(np.maximum(squares, 1e-16 * largest) + np.finfo(squares.dtype).tiny)


def _triangle(R: np.ndarray, n: int, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (..., n, k) that hold the first n unknowns, and the triangle (..., k-n, k-n) without them."""
    k = R.shape[-1]
    rows = np.zeros((*R.shape[:-2], max(n, k - R.shape[-2]), k), R.dtype)
    rows[..., np.arange(n), np.arange(n)] = damping
    R = _qr(np.concatenate([R, rows], axis=-2))
    return R[..., :n, :], R[..., n:k, n:]


def _qr(A: np.ndarray) -> np.ndarray:
    """The triangle; NaN where a matrix has numbers that are not finite."""
    finite = np.all(np.isfinite(A), axis=(-2, -1), keepdims=True)
    return np.where(finite, np.linalg.qr(np.where(finite, A, 0.0), mode="r"), np.nan)


def _back(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Unknowns (..., n) from rows (..., n, n + m + 1) and the m that are known; infinite where nothing is said."""
    n = rows.shape[-2]
    right = -(np.einsum("...ij,...j->...i", rows[..., n:-1], known) + rows[..., -1])
    x = np.zeros_like(right)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in reversed(range(n)):
            rest = np.einsum("...j,...j->...", rows[..., i, i + 1 : n], x[..., i + 1 :])
            x[..., i] = (right[..., i] - rest) / rows[..., i, i]
    return x
