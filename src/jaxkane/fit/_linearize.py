"""A problem at a point: residuals, cost and their exact derivatives, compiled over all windows."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._integrate.trajectory import Trajectory
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import process_allgather
from ._block_lsq import Blocks
from ._kalman import Filtered, filtered, information_of, minus_twice_log_likelihood
from ._model import Model, Prediction, Unknowns
from ._windows import Windows

if TYPE_CHECKING:
    from ._problem import Problem


@jit
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Starts (W, n) and their derivatives (W, n, n_z + n_b + p) by z, b and x."""
    # A program of its own: inside that of the simulation Newton's method would be differentiated a tangent at a time.
    n_b = point.b.shape[1]

    def start_of(arguments):
        window, z = arguments
        start = lambda z, x: model.consistent(window, z, x)  # noqa: E731
        by_z, by_x = jax.jacfwd(start, argnums=(0, 1))(z, point.x)
        return start(z, point.x), jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (windows, point.z))


def jacobian_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of a window, their derivatives (m, n_z + n_b + p), and what was seen."""
    n_z, n_b = z.shape[0], b.shape[0]
    unit = jnp.eye(n_z + n_b + x.shape[0], dtype=z.dtype)
    directions = (start_dot.T, unit[:, :n_z], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        residuals = lambda *unknowns: model.residuals(window, *unknowns)  # noqa: E731
        return jax.jvp(residuals, (start, z, b, x), direction, has_aux=True)

    return jax.vmap(along, out_axes=(None, -1, None))(*directions)


@jit
def blocks_of(
    model: Model, windows: Windows, by_trial: Array, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Blocks, Prediction]:
    """Blocks, and what was seen of every window."""
    n_z, n_b = point.z.shape[1], point.b.shape[1]
    n_next = n_z if model.nuisance.has_defects else 0

    def window_block(arguments):
        window, z, z_next, b, start, start_dot = arguments
        if model.noise is None:
            r, J, more = jacobian_of(model, window, start, start_dot, z, b, point.x)
        else:
            J, r, value, found = information_of(model, window, start, start_dot, z, b, point.x)
            more = _seen_by_filter(found, value)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        A = jnp.column_stack([J[:, :n_z], links, J[:, n_z:], r + links @ z_next[:n_next]])
        # The triangle says all that the (m, k) matrix says about least squares. QR of NaN is not everywhere NaN.
        bad = ~jnp.all(jnp.isfinite(A))
        A = jnp.concatenate([jnp.where(bad, 0.0, A), jnp.zeros((A.shape[1], A.shape[1]), A.dtype)])
        return jnp.where(bad, jnp.nan, jnp.linalg.qr(A, mode="r")), more

    R, seen = each(window_block, _arguments(windows, point, starts, starts_dot))
    return Blocks(R, by_trial, n_z, n_next, n_b), seen


@jit
def costs_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> tuple[Array, Prediction]:
    """Costs (W,), and what was seen: `blocks_of` without derivatives."""

    def window_cost(arguments):
        window, z, z_next, b, start = arguments
        if model.noise is not None:
            found = filtered(model, window, start, b, point.x)
            priors = model.priors(window, z, b, point.x)
            value = minus_twice_log_likelihood(found, window) + jnp.sum(priors**2)
            return value, _seen_by_filter(found, value)
        r, seen = model.residuals(window, start, z, b, point.x)
        if model.nuisance.has_defects:
            r = r + by_next(model, window, r.shape[0]) @ z_next
        return jnp.sum(r**2), seen

    return each(window_cost, _arguments(windows, point, starts))


@jit
def rides_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> Trajectory:
    """The motion of every window, stacked."""
    return each(lambda now: model.simulate(now[0], now[4], now[3], point.x), _arguments(windows, point, starts))


def _seen_by_filter(found: Filtered, value: Array) -> Prediction:
    return Prediction(found.predicted, found.status, found.deviation, value, found.unknowns)


def _arguments(windows: Windows, point: Unknowns, *more: Array) -> tuple[Any, ...]:
    z_next = jnp.concatenate([point.z[1:], point.z[:1]])
    return windows, point.z, z_next, point.b[windows.trial], *more


def by_next(model: Model, window: Windows, m: int) -> Array:
    """Derivatives (m, n_z) of a window's residuals by the next window's start."""
    n_z, before = window_size(model), window.weight.size
    links = jnp.zeros((m, n_z), window.t.dtype)
    if not model.nuisance.has_defects:
        return links
    places = jnp.arange(n_z, dtype=jnp.int32)
    return links.at[before + places, places].set(-window.linked / model.nuisance.jump)


def window_size(model: Model) -> int:
    """How many of a window's starting values are unknown."""
    return len(model.nuisance.start)


def each(f: Callable[..., Any], windows: Any) -> Any:
    """`f` of every window."""
    # One ride after another is fastest on a CPU, where a right-hand side is one scalar function; elsewhere all at once.
    batch = None if jax.default_backend() == "cpu" else jax.tree.leaves(windows)[0].shape[0]
    return jax.lax.map(f, windows, batch_size=batch)


def blocks_of_all(
    model: Model, windows: Windows, by_trial: Array, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Blocks, Prediction]:
    """`blocks_of`, by all processes together."""

    def own(windows, point, starts, starts_dot):
        blocks, seen = blocks_of(model, windows, by_trial, point, starts, starts_dot)
        return blocks.R, seen

    R, seen = _by_all(own, windows, point, starts, starts_dot)
    n_z, n_b = point.z.shape[1], point.b.shape[1]
    return Blocks(R, by_trial, n_z, n_z if model.nuisance.has_defects else 0, n_b), seen


def costs_of_all(model: Model, windows: Windows, point: Unknowns, starts: Array) -> tuple[Array, Prediction]:
    """`costs_of`, by all processes together."""
    return _by_all(lambda *share: costs_of(model, *share), windows, point, starts)


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


def _by_all(evaluate: Callable[..., Any], windows: Windows, point: Unknowns, *more: Array) -> Any:
    """evaluate(windows, point, *more) -> arrays (W, ...), each process for a share of the windows."""
    W = windows.trial.shape[0]
    m = -(-W // jax.process_count())
    # One more than its share, since a window is compared with the start of the next.
    share = (jax.process_index() * m + np.arange(m + 1)) % W
    windows, z, more = jax.tree.map(lambda x: x[share], (windows, point.z, more))
    found = evaluate(windows, Unknowns(point.x, point.b, z), *more)
    found = process_allgather(jax.tree.map(lambda x: np.asarray(x)[:m], found), tiled=True)
    return jax.tree.map(lambda x: jnp.asarray(x[:W]), found)


class Linearization(eqx.Module):
    """A problem at a point: its blocks, and what was seen of every window."""

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
        return float(self.blocks.cost if self.prediction.value is None else jnp.sum(self.prediction.value))

    @property
    def costs(self) -> np.ndarray:
        """The part of every window (W,) in the cost; infinite where it is not `good`."""
        own = jnp.sum(self.blocks.R[:, :, -1] ** 2, axis=1) if self.prediction.value is None else self.prediction.value
        return np.where(self.good, np.asarray(own), np.inf)

    @property
    def squares(self) -> float:
        """The rows' sum of squares: what relative tolerances refer to, and what promises are counted from. It is the
        cost, but with process noise about twice the number of measurements, where the cost may have any sign."""
        return float(self.blocks.cost)

    @property
    def good(self) -> np.ndarray:
        """Whether a window (W,) has finite residuals and derivatives."""
        return np.all(np.isfinite(np.asarray(self.blocks.R)), axis=(1, 2))


def linearize(problem: Problem, point: Unknowns) -> Linearization | None:
    """Residuals and their exact derivatives, by forward mode through the simulation; None where no start is found."""
    found = _starts(problem, point)
    if found is None:
        return None
    blocks: Any = blocks_of_all if problem.processes else blocks_of
    return Linearization(*blocks(problem.model, problem.windows, problem.by_trial, point, *found))


def cost(problem: Problem, point: Unknowns) -> float:
    """Sum of squares, with process noise minus twice the log likelihood, without derivatives; NaN or infinite where a
    window could not be simulated."""
    found = _starts(problem, point)
    if found is None:
        return float("nan")
    return float(jnp.sum(_costs(problem, point, found[0])[0]))


def simulated(problem: Problem, point: Unknowns) -> np.ndarray:
    """What the sensors would have measured (W, n_c, n_t), with process noise followed by its deviations (W, 2 n_c,
    n_t); NaN where that cannot be simulated."""
    found = _starts(problem, point)
    if found is None:
        several = 1 if problem.model.noise is None else 2
        return np.full(np.tile(problem.windows.measured, (1, several, 1)).shape, np.nan)
    return all_of(_costs(problem, point, found[0])[1])


def all_of(seen: Prediction) -> np.ndarray:
    """Simulated measurements and their deviations, as `simulated` gives them."""
    parts = [x for x in (seen.simulated, seen.deviation) if x is not None]
    return np.concatenate(parts, axis=1)


def without_start(problem: Problem, point: Unknowns) -> np.ndarray:
    """Whether the constraints can be met nowhere near the start of a window (W,)."""
    missing = []
    for i in range(len(problem.slices)):
        windows, z = jax.tree.map(lambda x, i=i: x[i : i + 1], (problem.windows, point.z))
        alone = dataclasses.replace(problem, windows=windows)
        missing.append(_starts(alone, Unknowns(point.x, point.b, z)) is None)
    return np.array(missing)


def _costs(problem: Problem, point: Unknowns, starts: Array) -> tuple[Array, Prediction]:
    return (costs_of_all if problem.processes else costs_of)(problem.model, problem.windows, point, starts)


def _starts(problem: Problem, point: Unknowns) -> tuple[Array, Array] | None:
    try:
        return starts_of(problem.model, problem.windows, point)
    except eqx.EquinoxRuntimeError:  # Newton's linear solver raises on what is not finite
        return None


STEP_TOLERANCE = 0.05, 0.25
"""By how much halving the step of integration may move all residuals together, of a window and of all windows: it
bounds the bias of an estimate in its standard errors."""

HALVINGS = 8
"""Of a step between two samples, at most: what needs more is stiff or chaotic."""


def has_steps(problem: Problem) -> bool:
    """Whether something follows from fixed steps: the motion, or what noise adds to it."""
    return problem.model.settings.step is not None or problem.model.noise is not None


def finer(problem: Problem, point: Unknowns) -> Problem:
    """The problem with steps halved where that changes what is simulated at a point by more than a share of the noise.

    An input that is linear between its samples has a kink at every sample, on which error control spends ten
    steps; a step from kink to kink meets none. Measured (the rides of a steered bicycle, 100 Hz, 1 s): 1300 steps
    at a tolerance of 1e-7 against 100 of Bosh3, which differ by 0.002 of the measurements' deviation.
    """
    first, before = problem.windows.step, simulated(problem, point)
    going, last = np.full(len(problem.slices), True), np.full(len(problem.slices), np.inf)
    for halvings in range(HALVINGS):
        half = jnp.where(jnp.asarray(going), problem.windows.step / 2, problem.windows.step)
        halved = problem.with_steps(half)
        after = simulated(halved, point)
        apart = _apart(problem, before, after)
        going &= ~(apart <= step_tolerance(problem))
        # Where halving does not reduce the difference, no step is fine enough: the motion is chaotic, or ends early.
        going &= (halvings < 2) | (np.isfinite(apart) & (apart <= last / 2))
        if not going.any():
            break
        problem = problem.with_steps(jnp.where(jnp.asarray(going), half, problem.windows.step))
        before, last = np.where(going[:, None, None], after, before), apart
    lost = ~np.all(np.isfinite(np.where(_weight_of(problem, before) > 0, before, 0.0)), axis=(1, 2))
    return problem.with_steps(jnp.where(jnp.asarray(lost), first, problem.windows.step))


def step_tolerance(problem: Problem) -> float:
    """By how much halving the step may move all residuals of one window together, in standard deviations."""
    one, together = STEP_TOLERANCE
    return min(one, together / len(problem.slices) ** 0.5)


def step_errors(problem: Problem, point: Unknowns, now: np.ndarray | None = None) -> np.ndarray:
    """By how much halving the step moves all residuals of every window (W,) together, in standard deviations; NaN
    where a window is not simulated to its end, or where the step follows from tolerances.

    `now`: what is simulated at the point, where that is known.
    """
    if not has_steps(problem):
        return np.full(len(problem.slices), np.nan)
    now = simulated(problem, point) if now is None else now
    return _apart(problem, now, simulated(problem.with_steps(problem.windows.step / 2), point))


def _apart(problem: Problem, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The norm (W,) of a difference of simulations, in standard deviations; infinite where one of the two ended
    earlier, NaN where both did."""
    weight = _weight_of(problem, a)
    lost = [np.any((weight > 0) & ~np.isfinite(x), axis=(1, 2)) for x in (a, b)]
    with np.errstate(invalid="ignore"):
        moved = np.linalg.norm(np.where(weight > 0, (b - a) * weight, 0.0), axis=(1, 2))
    return np.where(lost[0] & lost[1], np.nan, np.where(lost[0] | lost[1], np.inf, moved))


def _weight_of(problem: Problem, simulated: np.ndarray) -> np.ndarray:
    """One over the standard deviations of what `simulated` gives."""
    weight = np.asarray(problem.windows.weight)
    return np.tile(weight, (1, simulated.shape[1] // weight.shape[1], 1))
