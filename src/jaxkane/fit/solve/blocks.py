"""Least squares with a block structure, by orthogonal elimination. This module uses only matrices.

The residuals of a window depend on unknowns of the window (z), the next window (z_next) and the trial (b), and on the
parameters (x). They are stored as a triangle: |J d + r|^2 = |R [d; 1]|^2 with columns [z, z_next, b, x, r]. The
elimination of z in every window, then of b in every trial, gives a small problem in x. This is equivalent to a Schur
complement of J^T J, but does not square the condition number. With linked windows (z_next), the elimination is the
square-root information filter, and the back substitution is its smoother (Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._scalarjit.compat import on_device


class Blocks(eqx.Module):
    """Linearized residuals.

    - `R` (W, m, k): stacked triangles of every window, with k = n_z + n_next + n_b + n_x + 1.
    - `priors` (m, n_x + 1): the rows of the priors of x, which belong to no window, with columns [x, r].
    - `windows` (T, m): indices of the windows of every trial, in order, padded with W.
    - `n_z`: the number of unknowns of a window.
    - `n_next`: n_z if windows are linked, else 0.
    - `n_b`: the number of unknowns of a trial.
    """

    R: Float[Array, "W m k"]
    priors: Float[Array, "m n"]
    windows: Int[Array, "T m"]
    n_z: int = eqx.field(static=True)
    n_next: int = eqx.field(static=True)
    n_b: int = eqx.field(static=True)

    @classmethod
    def of(cls, model: Any, R: Any, windows: Any, x: Any) -> Blocks:
        """Blocks with the numbers of unknowns and the priors of a `Model` at x."""
        nuisance, priors = model.nuisance, model.parameters.prior_rows(x).astype(R.dtype)
        n_z = len(nuisance.window_names)
        return cls(R, priors, windows, n_z, n_z if nuisance.has_defects else 0, len(nuisance.trial))

    @property
    def n_x(self) -> int:
        return self.R.shape[-1] - self.n_z - self.n_next - self.n_b - 1

    def of_x(self, places: Any) -> Blocks:
        """The blocks for a subset of x with the indices `places`. The other parameters are fixed."""
        first = self.n_z + self.n_next + self.n_b
        columns = np.concatenate([np.arange(first), first + np.asarray(places), [self.R.shape[-1] - 1]])
        R = triangle(self.triangles[..., columns])  # QR again, because `triangles` requires triangles
        return eqx.tree_at(lambda blocks: blocks.R, self, on_device(R.reshape(len(R), -1, len(columns))))

    @property
    def triangles(self) -> np.ndarray:
        """The triangles of every window: (W, n_parts + 1, k, k), the last for the priors; (W, 1, k, k) without
        parts."""
        W, _, k = self.R.shape
        return np.asarray(self.R).reshape(W, -1, k, k)

    @property
    def cost(self) -> Array:
        """The sum of squares of the residuals."""
        return jnp.sum(self.R[:, :, -1] ** 2) + jnp.sum(self.priors[:, -1] ** 2)

    @property
    def of_parameters(self) -> np.ndarray:
        """The sensitivity (m, n_x) of all rows to x, before elimination."""
        columns = np.asarray(self.R)[:, :, -1 - self.n_x : -1]
        return np.concatenate([*columns, np.asarray(self.priors)[:, :-1]])

    @property
    def column_norms(self) -> np.ndarray:
        """Norms (n_x,) of the columns of the sensitivity, before elimination."""
        return np.linalg.norm(self.of_parameters, axis=0)

    @property
    def without_influence(self) -> np.ndarray:
        """Whether an x (n_x,) does not influence any residual, except by rounding errors."""
        norms = self.column_norms
        return norms <= 1e4 * np.finfo(norms.dtype).eps * np.max(norms, initial=0.0)

    @property
    def gradient(self) -> tuple[Array, Array, Array]:
        """The gradient of half the sum of squares with respect to z (W, n_z), b (T, n_b) and x (n_x,)."""
        products = _by_trial(jnp.einsum("wij,wi->wj", self.R, self.R[:, :, -1]), self.windows)  # (T, m, k)
        z = products[:, :, : self.n_z]
        if self.n_next:
            z = z.at[:, 1:].add(products[:, :-1, self.n_z : 2 * self.n_z])
        shared = products[:, :, self.n_z + self.n_next : -1]
        b, x = shared[:, :, : self.n_b], shared[:, :, self.n_b :]
        W = self.R.shape[0]
        of_windows = jnp.zeros((W + 1, self.n_z), z.dtype).at[self.windows].set(z)[:W]
        of_priors = self.priors[:, :-1].T @ self.priors[:, -1]
        return of_windows, jnp.sum(b, axis=1), jnp.sum(x, axis=(0, 1)) + of_priors


class Eliminated(NamedTuple):
    """The least-squares problem in x, after the elimination of z and b.

    - `R` (T, n_x + 1, n_x + 1): triangles with columns [x, r].
    - `priors` (m, n_x + 1): the rows of the priors of x.
    - `z_rows`, `b_rows`: rows for the back substitution of z and b.
    - `scale` (n_x,): column norms before the elimination, as units of the damping.
    - `blocks`: the blocks before the elimination.
    """

    R: Float[np.ndarray, "T n n"]
    priors: Float[np.ndarray, "m n"]
    z_rows: Float[np.ndarray, "T m n_z k"]
    b_rows: Float[np.ndarray, "T n_b kb"]
    scale: Float[np.ndarray, " n_x"]
    blocks: Blocks

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (m, n_x) and residual (m,) of the remaining problem."""
        flat = np.concatenate([self.R.reshape(-1, self.R.shape[-1]), self.priors])
        return flat[:, :-1], flat[:, -1]

    @property
    def log_determinant(self) -> float:
        """log det of the information about z and b. Unknowns without information are excluded."""
        parts = zip(self._diagonals, self.informed, strict=True)
        return 2 * float(sum(np.sum(np.log(np.where(known, d, 1.0))) for d, known in parts))

    @property
    def informed(self) -> tuple[np.ndarray, np.ndarray]:
        """Whether there is information about z (T, m, n_z) and b (T, n_b).

        After the elimination, only rounding errors remain of a column that is linearly dependent on others, and less of
        a column without influence.
        """
        informed = []
        for d, squares in zip(self._diagonals, _column_squares(self.blocks), strict=True):
            norm, eps, tiny = _safe(squares), np.finfo(d.dtype).eps, np.finfo(d.dtype).tiny
            informed.append((d > 1e5 * eps * norm) & (norm > tiny**0.25))
        return informed[0], informed[1]

    @property
    def _diagonals(self) -> tuple[np.ndarray, np.ndarray]:
        parts = self.z_rows[..., : self.z_rows.shape[2]], self.b_rows[..., : self.b_rows.shape[1]]
        z, b = (np.abs(np.diagonal(R, axis1=-2, axis2=-1)) for R in parts)
        return z, b

    def step(self, damping: float, longest: np.ndarray | float = np.inf) -> tuple[np.ndarray, float]:
        """The damped step (n_x,) and the minimum of the damped sum of squares.

        **Arguments:**

        - `damping`: `damping` * |column| * x is appended to the residuals.
        - `longest`: the maximum of every |x| (n_x,). An x that would be longer is set to its maximum, and the others
            are solved again.
        """
        A, r = self.rows
        n = A.shape[1]
        A, r = np.concatenate([A, np.diag(damping * self.scale)]), np.append(r, np.zeros(n, r.dtype))
        x, free, longest = np.zeros(n, r.dtype), np.full(n, True), np.broadcast_to(longest, n)
        while True:
            R = triangle(np.column_stack([A[:, free], r + A[:, ~free] @ x[~free]]))
            m = int(free.sum())
            x[free] = _back(R[:m], np.zeros(0, r.dtype))
            over = free & (np.abs(x) > longest)
            if not over.any():
                return x, float(R[m, m] ** 2)
            x[over], free = np.sign(x[over]) * longest[over], free & ~over

    def back_substitute(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The steps z (W, n_z) and b (T, n_b) that correspond to a step x."""
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
        # One row more, because `windows` is padded with the index W. This row is removed below.
        of_windows = np.zeros((W + 1, n_z), x.dtype)
        of_windows[np.asarray(self.blocks.windows)] = z
        return of_windows[:W], shared[:, :n_b]


def eliminate(blocks: Blocks, damping: np.ndarray | float) -> Eliminated:
    """Eliminate z and b, each with `damping` * |column| * unknown appended to the residuals (Levenberg-Marquardt).

    NumPy is used because compiling a program would take a second. The simulation of the windows takes longer than the
    elimination.

    `damping`: a number, or one for every trial (T,).
    """
    R, n_z, n_next, n_b, n_x = np.array(blocks.R), blocks.n_z, blocks.n_next, blocks.n_b, blocks.n_x
    # Columns without influence contain only rounding errors, and a step along them would have an arbitrary length.
    without, priors = np.flatnonzero(blocks.without_influence), np.array(blocks.priors)
    R[:, :, -1 - n_x : -1][:, :, without] = priors[:, without] = 0.0
    of_z, of_b = _column_squares(blocks)
    T, m = blocks.windows.shape
    # The damping must not be exactly zero: an unknown without influence would become NaN instead of keeping its value.
    damping = np.broadcast_to(np.asarray(damping, R.dtype), T)
    damping = np.maximum(damping, 1e3 * np.finfo(R.dtype).eps)[:, None]
    rows, z_damping = _by_trial(R, blocks.windows), damping[:, None] * _safe(of_z)
    c = n_next + n_b + n_x + 1
    if n_next:
        z_rows = np.zeros((T, m, n_z, n_z + c), R.dtype)
        known = np.zeros((T, c, n_z + c), R.dtype)  # information of earlier windows about [z, z_next, b, x, r]
        for i in range(m):
            z_rows[:, i], rest = _triangle(np.concatenate([known, rows[:, i]], axis=1), n_z, z_damping[:, i])
            known = np.concatenate([rest[:, :, :n_z], np.zeros_like(rest[:, :, :n_z]), rest[:, :, n_z:]], axis=2)
        rest = rest[:, :, n_next:]  # the last window of a trial has no next window
    else:
        z_rows, rest = _triangle(rows, n_z, z_damping)
        rest = rest.reshape(T, m * c, c)
    b_rows, rest = _triangle(rest, n_b, damping * _safe(of_b))
    # `_safe` is not used here: it is relative to the largest column, so the damping of a small column would depend on
    # the units of the parameters.
    squares = np.sum(R**2, axis=(0, 1))[-1 - n_x : -1] + np.sum(priors[:, :-1] ** 2, axis=0)
    return Eliminated(rest, priors, z_rows, b_rows, np.sqrt(squares + np.finfo(R.dtype).tiny), blocks)


def _column_squares(blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Sums of squares of the columns of z (T, m, n_z) and b (T, n_b)."""
    n_z, n_next = blocks.n_z, blocks.n_next
    squares = _by_trial(np.sum(np.asarray(blocks.R) ** 2, axis=1), blocks.windows)  # (T, m, k)
    of_z = squares[:, :, :n_z].copy()
    if n_next:
        of_z[:, 1:] += squares[:, :-1, n_z : 2 * n_z]
    return of_z, np.sum(squares, axis=1)[:, n_z + n_next : n_z + n_next + blocks.n_b]


def _by_trial(x: Any, windows: Any) -> Any:
    """Rearrange (W, ...) to (T, m, ...), with zeros for padding."""
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x, xp.zeros_like(x[:1])])[xp.asarray(windows)]


def _safe(squares: np.ndarray) -> np.ndarray:
    """Column norms with a positive lower limit."""
    if squares.shape[-1] == 0:
        return squares
    largest = np.max(squares, axis=-1, keepdims=True)
    return np.sqrt(np.maximum(squares, 1e-16 * largest) + np.finfo(squares.dtype).tiny)


def _triangle(R: np.ndarray, n: int, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (..., n, k) for the first n unknowns, and the triangle (..., k-n, k-n) of the other unknowns."""
    k = R.shape[-1]
    # At least k rows in total. With fewer, QR returns a triangle that is too short for the slices below.
    rows = np.zeros((*R.shape[:-2], max(n, k - R.shape[-2]), k), R.dtype)
    rows[..., np.arange(n), np.arange(n)] = damping
    R = triangle(np.concatenate([R, rows], axis=-2))
    return R[..., :n, :], R[..., n:k, n:]


def triangle(A: np.ndarray) -> np.ndarray:
    """The triangle R of the QR decomposition; NaN for a matrix with entries that are not finite."""
    finite = np.all(np.isfinite(A), axis=(-2, -1), keepdims=True)
    return np.where(finite, np.linalg.qr(np.where(finite, A, 0.0), mode="r"), np.nan)


def _back(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Solve rows (..., n, n + m + 1) for n unknowns, given m known values; infinite for an unknown without
    information."""
    n = rows.shape[-2]
    right = -(np.einsum("...ij,...j->...i", rows[..., n:-1], known) + rows[..., -1])
    x = np.zeros_like(right)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in reversed(range(n)):
            rest = np.einsum("...j,...j->...", rows[..., i, i + 1 : n], x[..., i + 1 :])
            x[..., i] = (right[..., i] - rest) / rows[..., i, i]
    return x
