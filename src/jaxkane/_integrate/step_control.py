"""Step sizes: from times and tolerances, by the error of a step, at discontinuities of inputs.

Knows diffrax's controllers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._scalarjit.function import ScalarFunction
from .._system.system import System
from .events import AdaptiveToStops, EventController, Events, Limits, Quantities, watched
from .inputs import Kinks
from .settings import SCALARS_UP_TO, Settings

_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 10.0


def rms(y: Array) -> Array:
    # That of optimistix has a rule of its own for derivatives, which a program of scalars cannot hold.
    return jnp.sqrt(jnp.mean(jnp.square(y)))


class ErrorController(diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """The steps of `diffrax.PIDController(rtol, atol)`, to rounding errors, by one program of scalars: as twenty
    operations of arrays they would take XLA a tenth of its time.

        error = rms(y_error / (atol + rtol max(|y0|, |y1|))),   h -> h min(max(0.9 error^(-1/p), 0.2), 10)

    A step whose error is below 1 is kept, and the next is no shorter; else it is made again, 0.9 times as long at most.
    The motion ends where a step would be shorter than the shortest.

    `tolerance` (3,): rtol, atol, and the shortest step.
    """

    tolerance: Array
    norm: Any = eqx.field(static=True, default=rms)  # type: ignore[override]

    @property
    def rtol(self) -> Array:  # type: ignore[override]
        return self.tolerance[0]

    @property
    def atol(self) -> Array:  # type: ignore[override]
        return self.tolerance[1]

    def wrap(self, direction: Any) -> ErrorController:
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        return t0 + jnp.maximum(dt0, self.tolerance[2]), None

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        if y_error is None:
            raise ValueError(
                "This solver estimates no error, which the steps would follow: give them, as in step=1e-3."
            )
        tolerance = _Tolerance(self.tolerance, float(error_order))
        still = jax.lax.stop_gradient((y0, y1_candidate, y_error))
        is_small = y0.size <= SCALARS_UP_TO
        keep, next_t0, next_t1, ends = (_adapted if is_small else _adapted.__wrapped__)(tolerance, t0, t1, *still)
        result = diffrax.RESULTS.where(ends, diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful)
        return keep, next_t0, next_t1, False, None, result


class _Tolerance(eqx.Module):
    numbers: Array
    order: float = eqx.field(static=True)


@ScalarFunction
def _adapted(tolerance: _Tolerance, t0: Array, t1: Array, y0: Array, y1: Array, y_error: Array):
    rtol, atol, shortest = tolerance.numbers
    # A step that leaves the domain of the equations is measured by its start.
    y1 = jnp.where(jnp.any(y1 != y1), y0, y1)
    error = rms(y_error / (atol + jnp.maximum(jnp.abs(y0), jnp.abs(y1)) * rtol))
    keep = error < 1
    factor = _SAFETY * (1 / error) ** (1 / tolerance.order)
    factor = jnp.where(keep, jnp.clip(factor, 1.0, _GROW), jnp.clip(factor, _SHRINK, _SAFETY))
    step = (t1 - t0) * jax.lax.stop_gradient(factor)
    next_t0 = jnp.where(keep, t1, t0)
    return keep, next_t0, next_t0 + step, step < shortest


class ClipToDiscontinuities(diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """A controller whose steps do not run over those of `times` (n,), in rising order, that come before `end`.

    A step over a kink would be of first order, whatever the solver. What is left before a kink is gone in one step, or
    in two halves, so that no step is as short as a rounding error: after that, `dtmin` would end the solution.

    The derivative of a signal by the time of its kink differs on the two sides, and so a step must belong to one of
    them. Steps therefore end and begin a rounding error beside a kink, and move with it; other ends do not move. With
    `anew` they begin with a right-hand side of their own: where two signals have a kink at one time, and only one of
    them moves, the derivative that came from the left would be wrong on the right.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController[Any, Any]
    times: Float[Array, " n"]
    anew: bool = eqx.field(static=True)

    def __init__(self, controller: Any, times: Float[Array, " n"], anew: bool = False, end: Any = jnp.inf):
        self.controller, self.anew = controller, anew
        # A step that ends beside a kink at the end would leave the end out.
        self.times = jnp.where(times < end - _rounding(times), times, jnp.inf)

    @property
    def rtol(self) -> Any:  # type: ignore[override]
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # type: ignore[override]
        return self.controller.atol

    @property
    def norm(self) -> Any:  # type: ignore[override]
        return self.controller.norm

    def wrap(self, direction: Any) -> ClipToDiscontinuities:
        return ClipToDiscontinuities(self.controller.wrap(direction), jnp.sort(self.times * direction), self.anew)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self._end(t0, end), state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        i = jnp.minimum(jnp.searchsorted(self.times, next_t0 - self._here), len(self.times) - 1)
        at_kink = keep & (jnp.abs(next_t0 - self.times[i]) <= self._here)
        next_t0 = jnp.where(at_kink, self.times[i] + 0.25 * self._here, next_t0)
        return keep, next_t0, self._end(next_t0, next_t1), jumped | at_kink if self.anew else jumped, state, result

    @property
    def _here(self) -> Array:
        """A kink as near as a rounding error is where a step starts."""
        return _rounding(self.times)

    def _end(self, t0: Any, t1: Any) -> Any:
        t1 = jax.lax.stop_gradient(t1)
        i = jnp.searchsorted(self.times, t0 + self._here, side="right")
        kink = jnp.where(i < len(self.times), self.times[jnp.minimum(i, len(self.times) - 1)], jnp.inf)
        halfway = jax.lax.stop_gradient(t0 + 0.5 * (kink - t0))
        return jnp.where(t1 >= kink, kink - 0.25 * self._here, jnp.minimum(t1, halfway))


def _rounding(times: Array) -> Array:
    """How near to one of these times rounding errors keep another."""
    times = jax.lax.stop_gradient(times)
    return 64 * jnp.finfo(times.dtype).eps * jnp.max(jnp.where(jnp.isfinite(times), jnp.abs(times), 0.0))


class Times(NamedTuple):
    """Of a motion [s]: its `start` and `end`, and its `first` step, unless one is asked for. How near to an event it is
    looked for (`beside`), and what differs by rounding errors alone (`here`). Then numbers as the controllers take
    them: the `tolerance` (3,), and what ends a motion (`numbers`, (3,))."""

    start: Array
    end: Array
    first: Array
    beside: Array
    here: Array
    tolerance: Array
    numbers: Array


def times_of(ts: Array, settings: Settings) -> Times:
    """Of rising times (n_t,)."""
    rtol, atol = (jnp.asarray(x, ts.dtype) for x in (settings.rtol, settings.atol))
    return _of_three(jnp.stack([ts[0], ts[1], ts[-1]]), rtol, atol)


@ScalarFunction
def _of_three(ts: Array, rtol: Array, atol: Array) -> Times:
    """Of the first, the second and the last time."""
    eps, whole = jnp.finfo(ts.dtype).eps, jax.lax.stop_gradient(ts[2] - ts[0])
    rounding = 1e3 * eps * whole
    resolution = 8 * rounding + 1e-9 * whole
    return Times(
        start=ts[0],
        end=ts[2],
        # A first step, right or wrong by a factor of ten, spares the two more copies of the right-hand side that
        # diffrax would compile to choose one.
        first=jnp.minimum(whole / 1000, jax.lax.stop_gradient(ts[1] - ts[0])),
        beside=4 * resolution,
        here=64 * eps * jax.lax.stop_gradient(jnp.max(jnp.abs(ts))),
        tolerance=jnp.stack([rtol, atol, rounding]),
        numbers=jnp.stack([resolution, rounding, whole / 1000]),
    )


def controller_of(
    times: Times,
    vector_field: Callable[..., Array],
    events: Events,
    system: System,
    kinks: Kinks | None,
    settings: Settings,
) -> EventController:
    """The controller of the steps, which ends the motion: at the last time, at the events, and before the dependent
    speeds are singular."""

    def watch(t, y, args):
        return Quantities(*watched(args[0], t, y, vector_field(t, y, args) if events.read_speeds else None))

    controller: Any = ErrorController(times.tolerance)  # pyright: ignore[reportCallIssue]
    kind: Any = AdaptiveToStops
    first = times.first
    if settings.step is not None:
        # A fixed step is spread evenly over the whole time: a rounding error must not make it one step more, after
        # which no step would end where a sample of an input stands.
        first = (1.0 + jnp.finfo(times.end.dtype).eps ** 0.5) * settings.step
        controller, kind = diffrax.ConstantStepSize(), EventController
    elif kinks is not None:
        controller = ClipToDiscontinuities(controller, kinks.times, kinks.anew, end=times.end)
    stops = events.names or system.dependent_speeds
    return kind(controller, watch if stops else None, first, Limits(events.directions, times.end, times.numbers))
