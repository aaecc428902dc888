"""How a motion is stepped through: from its times and tolerances, the controller of the steps.

Knows diffrax's step size controllers and a description's events; knows no method.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._description.system import System
from .._scalars.fuse import fused
from .by_error import ByError
from .events import Events, watched
from .kinks import ToKinks
from .settings import Settings
from .signals import Kinks
from .stops import AdaptiveToStops, Limits, Quantities, ToStops


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


@fused
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
) -> ToStops:
    """The controller of the steps, which ends the motion: at the last time, at the events, and before the dependent
    speeds are singular."""

    def watch(t, y, args):
        return Quantities(*watched(args[0], t, y, vector_field(t, y, args) if events.read_speeds else None))

    controller: Any = ByError(times.tolerance)  # pyright: ignore[reportCallIssue]
    kind: Any = AdaptiveToStops
    first = times.first
    if settings.step is not None:
        # A fixed step is spread evenly over the whole time: a rounding error must not make it one step more, after
        # which no step would end where a sample of an input stands.
        first = (1.0 + jnp.finfo(times.end.dtype).eps ** 0.5) * settings.step
        controller, kind = diffrax.ConstantStepSize(), ToStops
    elif kinks is not None:
        controller = ToKinks(controller, kinks.times, kinks.anew, end=times.end)
    stops = events.names or system.dependent_speeds
    return kind(controller, watch if stops else None, first, Limits(events.directions, times.end, times.numbers))
