"""Residuals of all windows at a point with their exact derivatives, as least squares with a block structure.

The residuals of a window depend on unknowns of the window (z), the next window (z_next) and the trial (b), and on the
parameters (x). They are stored as a triangle: |J d + r|^2 = |R [d; 1]|^2 with columns [z, z_next, b, x, r]. The
elimination of z in every window, then of b in every trial, gives a small problem in x. This is equivalent to a Schur
complement of J^T J, but does not square the condition number. With linked windows (z_next), the elimination is the
square-root information filter, and the back substitution is its smoother (Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree
from numpy.typing import ArrayLike

from ..._integrate.trajectory import Trajectory
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import on_device
from ..._scalarjit.components import Numbers
from ..problem.model import Model, Prediction, Unknowns
from ..problem.windows import Windows
from .kalman import information_of


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
    def of(cls, model: Model, R: Float[Array, "W m k"], windows: Int[Array, "T m"], x: Float[Array, " n_x"]) -> Blocks:
        """Blocks with the numbers of unknowns and the priors of a `Model` at x."""
        nuisance, priors = model.nuisance, model.parameters.prior_rows(x).astype(R.dtype)
        n_z = len(nuisance.window_names)
        return cls(R, priors, windows, n_z, n_z if nuisance.has_defects else 0, len(nuisance.trial))

    @property
    def n_x(self) -> int:
        return self.R.shape[-1] - self.n_z - self.n_next - self.n_b - 1

    def of_x(self, places: ArrayLike) -> Blocks:
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


def _by_trial(x: Numbers, windows: Numbers) -> Any:
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


@jit
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Initial states (W, n) and their derivatives (W, n, n_z + n_b + p) with respect to z, b and x."""
    # A separate program: within that of the simulation, Newton's method would be differentiated one tangent at a time.
    n_b = point.trial_unknowns.shape[1]

    def start_of(arguments: PyTree):
        window, z = arguments

        def both(z: Array, x: Array):
            return (model.consistent(window, z, x),) * 2

        (by_z, by_x), start = jax.jacfwd(both, argnums=(0, 1), has_aux=True)(z, point.parameters)
        return start, jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (windows, point.window_starts))


def jacobian_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of a window, their derivatives (m, n_z + n_b + p), and the prediction."""
    n_z, n_b, parameters = z.shape[0], b.shape[0], model.parameters
    # A parameter has a value per group of trials, but only one of them applies to a window. All of them share one
    # direction of differentiation, so a hundred groups take no more computing time than one.
    shared = jax.scipy.linalg.block_diag(
        jnp.eye(n_z + n_b, dtype=z.dtype), parameters.shared_directions.astype(z.dtype)
    )
    directions = (start_dot @ shared).T, shared[:n_z].T, shared[n_z : n_z + n_b].T, shared[n_z + n_b :].T

    def along(*direction):

        def residuals(*unknowns):
            return model.residuals(window, *unknowns)

        return jax.jvp(residuals, (start, z, b, x), direction, has_aux=True)

    r, J, prediction = jax.vmap(along, out_axes=(None, -1, None))(*directions)
    if parameters.has_groups:
        applies = jnp.concatenate([jnp.full(n_z + n_b, True), window.applies[parameters.places]])
        J = jnp.where(applies, J @ shared.T, 0.0)
    return r, J, prediction


PARTS = 6
"""The minimum number of triangles for all windows together, without defects and without process noise.

Longer parts include slower errors, but leave fewer degrees of freedom. With one record and an error of 0.4 sigma that
is correlated over a fifth of the record, 95 % intervals covered 89 % with 8 parts, 91 % with 6 and 92 % with 4. For
white residuals, they were 1.3, 1.4 and 1.65 times as wide as formal intervals.
"""


@jit
def blocks_of(
    model: Model, windows: Windows, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Array, Prediction]:
    """The triangles R (W, k, k) of `Blocks`, and the prediction of every window."""
    n_z = point.window_starts.shape[1]
    n_next = n_z if model.nuisance.has_defects else 0
    # If there are few windows, they are divided, because cluster-robust errors need the scores of several parts.
    n_parts = -(-PARTS // windows.t.shape[0]) if model.noise is None and not n_next else 1

    # The transcription gives residuals, derivatives and a prediction. All else is the same for every transcription.
    rows_of = jacobian_of if model.noise is None else information_of

    def window_block(arguments: PyTree):
        window, z, z_next, b, start, start_dot = arguments
        r, J, prediction = rows_of(model, window, start, start_dot, z, b, point.parameters)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        A = jnp.column_stack([J[:, :n_z], links, J[:, n_z:], r + links @ z_next[:n_next]])
        # For least squares, the triangle is equivalent to the (m, k) matrix. Invalid rows are masked before and set to
        # NaN after, because QR of a matrix with NaN does not give NaN everywhere.
        bad = ~jnp.all(jnp.isfinite(A))
        R = _triangles(jnp.where(bad, 0.0, A), window.weight.shape, n_parts)
        return jnp.where(bad, jnp.nan, R), prediction

    return map_windows(window_block, _arguments(windows, point, starts, starts_dot))


def _triangles(A: Array, shape: tuple[int, int], n_parts: int) -> Array:
    """The triangle of the rows A (m, k) of a window.

    With several parts, the triangles of parts with equal numbers of samples, followed by the triangle of the priors.
    The rows of the priors follow the (n_c, n_t) residuals of the measurements.
    """
    (n_c, n_t), k = shape, A.shape[1]

    def triangle(rows: Array):
        return jnp.linalg.qr(jnp.pad(rows, ((0, 0), (0, k), (0, 0))), mode="r").reshape(-1, k)

    if n_parts == 1:
        return triangle(A[None])
    length = -(-n_t // n_parts)
    data = jnp.pad(A[: n_c * n_t].reshape(n_c, n_t, k), ((0, 0), (0, n_parts * length - n_t), (0, 0)))
    data = data.reshape(n_c, n_parts, length, k).swapaxes(0, 1).reshape(n_parts, n_c * length, k)
    return jnp.concatenate([triangle(data), triangle(A[None, n_c * n_t :])])


def half_cost(model: Model, windows: Windows, by_trial: Array) -> Callable[[Unknowns], Array]:
    """Half the cost of a problem, as a function of `Unknowns` that JAX can differentiate once, in either mode.

    The derivatives are those of `blocks_of`: forward mode through the simulation, with a few directions per window.
    This takes less computing time than one reverse pass and does not need its memory.
    """

    @jax.custom_jvp
    def f(point: Unknowns) -> Array:
        return linearized(point)[1] / 2

    def linearized(point: Unknowns):
        R, prediction = blocks_of(model, windows, point, *starts_of(model, windows, point))
        blocks = Blocks.of(model, R, by_trial, point.parameters)
        of_priors = jnp.sum(blocks.priors[:, -1] ** 2)
        return blocks, blocks.cost if prediction.cost is None else jnp.sum(prediction.cost) + of_priors

    @f.defjvp
    def f_jvp(primals: tuple[Unknowns], tangents: tuple[Unknowns]):
        (blocks, cost), (direction,) = linearized(*primals), tangents
        z, b, x = blocks.gradient
        slope = (
            jnp.sum(z * direction.window_starts)
            + jnp.sum(b * direction.trial_unknowns)
            + jnp.sum(x * direction.parameters)
        )
        return cost / 2, slope

    return f


@jit
def trajectories_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> Trajectory:
    """The trajectories of all windows, stacked."""
    return map_windows(
        lambda now: model.simulate(now[0], now[4], now[1], now[3], point.parameters), _arguments(windows, point, starts)
    )


def _arguments(windows: Windows, point: Unknowns, *starts: Array) -> tuple[Any, ...]:
    z_next = jnp.concatenate([point.window_starts[1:], point.window_starts[:1]])
    return windows, point.window_starts, z_next, point.trial_unknowns[windows.trial], *starts


def by_next(model: Model, window: Windows, m: int) -> Array:
    """Derivatives (m, n_z) of a window's residuals with respect to the initial state of the next window."""
    n_z, before = len(model.nuisance.window_names), window.weight.size
    links = jnp.zeros((m, n_z), window.t.dtype)
    if not model.nuisance.has_defects:
        return links
    places = jnp.arange(n_z, dtype=jnp.int32)
    return links.at[before + places, places].set(-window.linked / model.nuisance.defect_std)


def map_windows(f: Callable[..., Any], windows: PyTree) -> Any:
    """Apply `f` to every window: sequentially on a CPU, as one batch on other devices.

    Sequential simulations are fastest on a CPU, where a right-hand side is one scalar function.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(f, windows)
    # Not `jax.lax.map(..., batch_size=n)`: with results of size zero, such as no unknown initial states, it raises
    # ZeroDivisionError (JAX 0.10 to 0.12).
    return jax.vmap(f)(windows)


class Linearization(eqx.Module):
    """A problem, linearized at a point: its blocks, and the prediction of every window."""

    blocks: Blocks
    prediction: Prediction

    @property
    def simulated(self) -> Array:
        """Simulated measurements (W, n_c, n_t)."""
        return self.prediction.simulated

    @property
    def status(self) -> Array:
        """The status of the simulation of every window (W,)."""
        return self.prediction.status

    @property
    def cost(self) -> float:
        """The sum of squares, or minus twice the log likelihood with process noise or error models. NaN or infinite if
        the simulation of a window fails."""
        return float(np.sum(self._own)) + self.prior_squares

    @property
    def costs(self) -> np.ndarray:
        """The contribution of every window (W,) to the cost, without priors of parameters; infinite if the window is
        not `good`."""
        return np.where(self.good, self._own, np.inf)

    @property
    def _own(self) -> np.ndarray:
        """The contribution of every window (W,) to the cost."""
        cost = self.prediction.cost
        return np.sum(np.asarray(self.blocks.R)[:, :, -1] ** 2, axis=1) if cost is None else np.asarray(cost)

    @property
    def prior_squares(self) -> float:
        """The sum of squares of the priors of parameters."""
        return float(np.sum(np.asarray(self.blocks.priors)[:, -1] ** 2))

    @property
    def squares(self) -> float:
        """The sum of squares of the rows, to which relative tolerances and predicted reductions refer.

        In ordinary least squares it equals the cost. With process noise, it is about twice the number of measurements,
        whereas the cost may be negative.
        """
        return float(np.sum(np.sum(np.asarray(self.blocks.R)[:, :, -1] ** 2, axis=1))) + self.prior_squares

    @property
    def good(self) -> np.ndarray:
        """Whether a window (W,) has finite residuals and derivatives."""
        finite = np.all(np.isfinite(np.asarray(self.blocks.R)), axis=(1, 2))
        return finite & np.all(np.isfinite(np.asarray(self.blocks.priors)))
