"""Residuals and cost of all windows at a point, and their exact derivatives: compiled programs."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._integrate.trajectory import Trajectory
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import process_allgather
from ._block_lsq import Blocks
from ._kalman import information_of
from ._model import Model, Prediction, Unknowns
from ._windows import Windows


@jit
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Starts (W, n) and their derivatives (W, n, n_z + n_b + p) by z, b and x."""
    # A program of its own: inside that of the simulation Newton's method would be differentiated a tangent at a time.
    n_b = point.b.shape[1]

    def start_of(arguments):
        window, z = arguments
        both = lambda z, x: (model.consistent(window, z, x),) * 2  # noqa: E731
        (by_z, by_x), start = jax.jacfwd(both, argnums=(0, 1), has_aux=True)(z, point.x)
        return start, jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (windows, point.z))


def jacobian_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of a window, their derivatives (m, n_z + n_b + p), and the prediction."""
    n_z, n_b = z.shape[0], b.shape[0]
    unit = jnp.eye(n_z + n_b + x.shape[0], dtype=z.dtype)
    directions = (start_dot.T, unit[:, :n_z], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        residuals = lambda *unknowns: model.residuals(window, *unknowns)  # noqa: E731
        return jax.jvp(residuals, (start, z, b, x), direction, has_aux=True)

    return jax.vmap(along, out_axes=(None, -1, None))(*directions)


@jit
def blocks_of(
    model: Model, windows: Windows, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Array, Prediction]:
    """The triangles R (W, k, k) of `Blocks`, and the prediction of every window."""
    n_z = point.z.shape[1]
    n_next = n_z if model.nuisance.has_defects else 0

    def window_block(arguments):
        window, z, z_next, b, start, start_dot = arguments
        if model.noise is None:
            r, J, prediction = jacobian_of(model, window, start, start_dot, z, b, point.x)
        else:
            J, r, value, result = information_of(model, window, start, start_dot, z, b, point.x)
            prediction = Prediction(result.predicted, result.status, result.deviation, value, result.unknowns)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        A = jnp.column_stack([J[:, :n_z], links, J[:, n_z:], r + links @ z_next[:n_next]])
        # The triangle says all that the (m, k) matrix says about least squares. QR of NaN is not everywhere NaN.
        bad = ~jnp.all(jnp.isfinite(A))
        A = jnp.concatenate([jnp.where(bad, 0.0, A), jnp.zeros((A.shape[1], A.shape[1]), A.dtype)])
        return jnp.where(bad, jnp.nan, jnp.linalg.qr(A, mode="r")), prediction

    return map_windows(window_block, _arguments(windows, point, starts, starts_dot))


def half_cost(model: Model, windows: Windows, by_trial: Array) -> Callable[[Unknowns], Array]:
    """Half a problem's cost as a function of `Unknowns` that JAX can differentiate, once, in either mode.

    The derivatives are those of `blocks_of`: forward through the simulation, a few directions a window, which is
    cheaper than one reverse pass and needs none of its memory.
    """

    @jax.custom_jvp
    def f(point: Unknowns) -> Array:
        return linearized(point)[1] / 2

    def linearized(point: Unknowns):
        R, prediction = blocks_of(model, windows, point, *starts_of(model, windows, point))
        blocks = Blocks.of(model.nuisance, R, by_trial)
        return blocks, blocks.cost if prediction.cost is None else jnp.sum(prediction.cost)

    @f.defjvp
    def f_jvp(primals, tangents):
        (blocks, cost), (direction,) = linearized(*primals), tangents
        z, b, x = blocks.gradient
        slope = jnp.sum(z * direction.z) + jnp.sum(b * direction.b) + jnp.sum(x * direction.x)
        return cost / 2, slope

    return f


@jit
def trajectories_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> Trajectory:
    """The motions of all windows, stacked."""
    return map_windows(lambda now: model.simulate(now[0], now[4], now[3], point.x), _arguments(windows, point, starts))


def _arguments(windows: Windows, point: Unknowns, *starts: Array) -> tuple[Any, ...]:
    z_next = jnp.concatenate([point.z[1:], point.z[:1]])
    return windows, point.z, z_next, point.b[windows.trial], *starts


def by_next(model: Model, window: Windows, m: int) -> Array:
    """Derivatives (m, n_z) of a window's residuals by the next window's start."""
    n_z, before = len(model.nuisance.start), window.weight.size
    links = jnp.zeros((m, n_z), window.t.dtype)
    if not model.nuisance.has_defects:
        return links
    places = jnp.arange(n_z, dtype=jnp.int32)
    return links.at[before + places, places].set(-window.linked / model.nuisance.defect_std)


def map_windows(f: Callable[..., Any], windows: Any) -> Any:
    # One ride after another is fastest on a CPU, where a right-hand side is one scalar function; elsewhere all at once.
    batch = None if jax.default_backend() == "cpu" else jax.tree.leaves(windows)[0].shape[0]
    return jax.lax.map(f, windows, batch_size=batch)


def blocks_by_all_processes(
    model: Model, windows: Windows, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Array, Prediction]:
    """`blocks_of`, each process for a share of the windows."""
    return _by_all_processes(functools.partial(blocks_of, model), windows, point, starts, starts_dot)


def check_same(model: Model, windows: Windows) -> None:
    """Refuse processes that pose different problems.

    **Raises:** `ValueError`, in all of them.
    """
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves((model, windows)):
        if isinstance(leaf, (jax.Array, np.ndarray)):
            sha.update(str(leaf.shape).encode() + np.ascontiguousarray(leaf).tobytes())
    own = np.frombuffer(sha.digest(), dtype=np.uint32)
    if not np.all(np.asarray(process_allgather(own)) == own):
        raise ValueError(
            "fit(..., processes=True): the processes pose different problems. Give every process the same system, the "
            "same initial guesses and all trials, in the same order; each takes its share of them."
        )


def _by_all_processes(evaluate: Callable[..., Any], windows: Windows, point: Unknowns, *starts: Array) -> Any:
    """evaluate(windows, point, *starts) -> arrays (W, ...)."""
    W = windows.trial.shape[0]
    m = -(-W // jax.process_count())
    # One more than its share, since a window is compared with the start of the next.
    share = (jax.process_index() * m + np.arange(m + 1)) % W
    windows, z, starts = jax.tree.map(lambda x: x[share], (windows, point.z, starts))
    own = evaluate(windows, Unknowns(point.x, point.b, z), *starts)
    whole = process_allgather(jax.tree.map(lambda x: np.asarray(x)[:m], own), tiled=True)
    return jax.tree.map(lambda x: jnp.asarray(x[:W]), whole)


class Linearization(eqx.Module):
    """A problem at a point: its blocks, and the prediction of every window."""

    blocks: Blocks
    prediction: Prediction

    @property
    def simulated(self) -> Array:
        """(W, n_c, n_t)."""
        return self.prediction.simulated

    @property
    def status(self) -> Array:
        """Of every window (W,)."""
        return self.prediction.status

    @property
    def cost(self) -> float:
        """Sum of squares, with process noise minus twice the log likelihood; NaN or infinite where a window could not
        be simulated."""
        return self.squares if self.prediction.cost is None else float(np.sum(self.prediction.cost))

    @property
    def costs(self) -> np.ndarray:
        """The part of every window (W,) in the cost; infinite where it is not `good`."""
        own = self._squares if self.prediction.cost is None else np.asarray(self.prediction.cost)
        return np.where(self.good, own, np.inf)

    @property
    def squares(self) -> float:
        """The rows' sum of squares: what relative tolerances refer to, and what promises are counted from. It is the
        cost, but with process noise about twice the number of measurements, where the cost may have any sign."""
        return float(np.sum(self._squares))

    @property
    def _squares(self) -> np.ndarray:
        """Of every window (W,)."""
        return np.sum(np.asarray(self.blocks.R)[:, :, -1] ** 2, axis=1)

    @property
    def good(self) -> np.ndarray:
        """Whether a window (W,) has finite residuals and derivatives."""
        return np.all(np.isfinite(np.asarray(self.blocks.R)), axis=(1, 2))
