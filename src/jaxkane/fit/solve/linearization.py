"""Residuals and cost of all windows at a point, and their exact derivatives: compiled programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._integrate.trajectory import Trajectory
from ..._scalarjit.cache_key import jit
from ..problem.model import Model, Prediction, Unknowns
from ..problem.windows import Windows
from .blocks import Blocks
from .kalman import information_of


@jit
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Initial states (W, n) and their derivatives (W, n, n_z + n_b + p) with respect to z, b and x."""
    # A separate program: within that of the simulation, Newton's method would be differentiated one tangent at a time.
    n_b = point.trial_unknowns.shape[1]

    def start_of(arguments):
        window, z = arguments

        def both(z, x):
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

    def window_block(arguments):
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

    def triangle(rows):
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
    def f_jvp(primals, tangents):
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


def map_windows(f: Callable[..., Any], windows: Any) -> Any:
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
