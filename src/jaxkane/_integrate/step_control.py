"""Where the step size is chosen: by the error of a step, clipped at the discontinuities of inputs and at events.

The error is that of `diffrax.PIDController`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._system.system import System
from .events import AdaptiveEventController, EventController, Events, EventValues, InnerTolerances, Limits, event_values
from .inputs import Discontinuities
from .settings import Settings


class ClipToDiscontinuities(InnerTolerances):
    """A controller whose steps do not run over those of `times` (n,), in rising order, that come before `end`.

    A step over a kink would be of first order, whatever the solver. What is left before a kink is gone in one step, or
    in two halves, so that no step is as short as a rounding error: after that, `dtmin` would end the solution.

    The derivative of a signal by the time of its kink differs on the two sides, and so a step must belong to one of
    them. Steps therefore end and begin a rounding error beside a kink, and move with it; other ends do not move. With
    `restart` they begin with a right-hand side of their own: where two signals have a kink at one time, and only one of
    them moves, the derivative that came from the left would be wrong on the right.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController[Any, Any]
    times: Float[Array, " n"]
    restart: bool = eqx.field(static=True)

    def __init__(self, controller: Any, times: Float[Array, " n"], restart: bool = False, end: Any = jnp.inf):
        self.controller, self.restart = controller, restart
        # A step that ends beside a kink at the end would leave the end out.
        self.times = jnp.where(times < end - _rounding(times), times, jnp.inf)

    def wrap(self, direction: Any) -> ClipToDiscontinuities:
        return ClipToDiscontinuities(self.controller.wrap(direction), jnp.sort(self.times * direction), self.restart)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self._clipped(t0, end), state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        rounding = _rounding(self.times)
        i = jnp.minimum(jnp.searchsorted(self.times, next_t0 - rounding), len(self.times) - 1)
        at_kink = keep & (jnp.abs(next_t0 - self.times[i]) <= rounding)
        next_t0 = jnp.where(at_kink, self.times[i] + 0.25 * rounding, next_t0)
        jumped = jumped | at_kink if self.restart else jumped
        return keep, next_t0, self._clipped(next_t0, next_t1), jumped, state, result

    def _clipped(self, t0: Any, t1: Any) -> Any:
        t1, rounding = jax.lax.stop_gradient(t1), _rounding(self.times)
        i = jnp.searchsorted(self.times, t0 + rounding, side="right")
        kink = jnp.where(i < len(self.times), self.times[jnp.minimum(i, len(self.times) - 1)], jnp.inf)
        halfway = jax.lax.stop_gradient(t0 + 0.5 * (kink - t0))
        return jnp.where(t1 >= kink, kink - 0.25 * rounding, jnp.minimum(t1, halfway))


def _rounding(times: Array) -> Array:
    """How near to one of these times rounding errors keep another."""
    times = jax.lax.stop_gradient(times)
    return 64 * jnp.finfo(times.dtype).eps * jnp.max(jnp.where(jnp.isfinite(times), jnp.abs(times), 0.0))


class Times(NamedTuple):
    """Of a motion [s]: its `start` and `end`; its `first` step by error control; the `shortest` step; how near to an
    event it is looked for; by how much times differ through `rounding` alone; and the tolerances of `Limits` (3,)."""

    start: Array
    end: Array
    first: Array
    shortest: Array
    event_reach: Array
    rounding: Array
    limits: Array


def times_of(start: Array, second: Array, end: Array) -> Times:
    """Of the first, the second and the last time at which the motion is kept."""
    eps, duration = jnp.finfo(end.dtype).eps, jax.lax.stop_gradient(end - start)
    shortest = 1e3 * eps * duration
    resolution = 8 * shortest + 1e-11 * duration
    return Times(
        start=start,
        end=end,
        # A first step, right or wrong by a factor of ten, spares the two more copies of the right-hand side that
        # diffrax would compile to choose one.
        first=jnp.minimum(duration / 1000, jax.lax.stop_gradient(second - start)),
        shortest=shortest,
        event_reach=4 * resolution,
        rounding=64 * eps * jax.lax.stop_gradient(jnp.maximum(jnp.abs(start), jnp.abs(end))),
        limits=jnp.stack([resolution, shortest, duration / 1000]),
    )


def controller_of(
    times: Times,
    vector_field: Callable[..., Array],
    events: Events,
    system: System,
    discontinuities: Discontinuities | None,
    settings: Settings,
) -> EventController:
    """The controller of the steps, which ends the motion: at the last time, at the events, and before the dependent
    speeds are singular."""

    def quantities(t: Array, y: Array, args: Any) -> EventValues:
        return event_values(args[0], t, y, vector_field(t, y, args) if events.read_speeds else None)

    limits = Limits(events.directions, times.end, times.limits)
    may_end = quantities if events.names or system.dependent_speeds else None
    if settings.step is not None:
        # A fixed step is spread evenly over the whole time: a rounding error must not make it one step more, after
        # which no step would end where a sample of an input stands.
        step = (1.0 + jnp.finfo(times.end.dtype).eps ** 0.5) * settings.step
        return EventController(diffrax.ConstantStepSize(), may_end, step, limits)
    controller: Any = diffrax.PIDController(settings.rtol, settings.atol, dtmin=times.shortest, force_dtmin=False)
    if discontinuities is not None:
        controller = ClipToDiscontinuities(controller, discontinuities.times, discontinuities.restart, end=times.end)
    return AdaptiveEventController(controller, may_end, times.first, limits)  # pyright: ignore[reportCallIssue]
