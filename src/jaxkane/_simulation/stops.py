"""Steps that end where the motion does. Knows diffrax's step size controllers; knows no mechanics."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._scalars.fuse import fused
from .crossings import first_crossing


class Quantities(NamedTuple):
    """What may end a motion, at one time: `values` (n,) and their `rates` (n,), and a `bound` that nothing may pass."""

    values: Array
    rates: Array
    bound: Array


class Limits(eqx.Module):
    """What ends a motion: the `directions` in which quantities count (see `first_crossing`); `resolution` [s]: how far
    behind a crossing the last step may end; `rounding` [s]: what is no time; `shortest` [s]: a step that is not halved
    at the bound."""

    directions: tuple[int, ...] = eqx.field(static=True)
    resolution: Array
    rounding: Array
    shortest: Array


class Stopping(NamedTuple):
    """The state of a controller that stops: that of its inner controller; the quantities at the step's start; which one
    ended the motion, as a float, -1 for none and n for the bound; the end of a step that was taken back, else
    -infinity; and the end of the first step over the bound, else infinity."""

    inner: Any
    start: Quantities
    which: Array
    until: Array
    last: Array


class ToStops(diffrax.AbstractStepSizeController[Any, Any]):
    """A controller whose last step ends where a quantity vanishes.

    The motion is watched through the cubic between both ends of a step: their values and rates. Where that passes zero
    the step is taken back, and made anew to just beyond that time; so long, until the step that ends there is one that
    is right by the inner controller's measure. Two crossings within one step are seen where the cubic sees them.

    A step behind which a quantity is no number is halved; where it is as short as the resolution, the motion ends
    before it as one whose steps became too small, since whether the quantity passed zero cannot be said.

    A step over the bound is halved; where it is as short as the shortest, the motion ends before it. It also ends where
    the first step over the bound did, if shorter ones do not pass it: so near to it, what is found is by chance.

    `watch`: (t, y, args) -> `Quantities`.
    """

    controller: diffrax.AbstractStepSizeController[Any, Any]
    watch: Callable[..., Quantities]
    limits: Limits

    def wrap(self, direction: Any) -> ToStops:
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        start = self._watched(t0, y0, args)
        # What would have vanished within a rounding error of the start is on zero there.
        on_zero = jnp.abs(start.values) <= jnp.abs(start.rates) * self.limits.rounding
        start = start._replace(values=jnp.where(on_zero, jnp.zeros_like(start.values), start.values))
        return end, Stopping(inner, start, *(jnp.full_like(t0, x) for x in (-1.0, -jnp.inf, jnp.inf)))

    def adapt_step_size(self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        state: Stopping = controller_state
        keep, next_t0, next_t1, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state.inner
        )
        # What is left of a step that was taken back is gone at once: a fixed step stays on its grid.
        going_on = keep & (t1 < state.until)
        next_t1 = jnp.where(going_on, state.until, next_t1)
        inner = _where(going_on, state.inner, inner)

        still = jax.lax.stop_gradient((t0, t1))
        now = self._watched(t1, y1_candidate, args)
        found = _decision(self.limits, state.start, now, *still, state.which, state.last, keep)
        state = Stopping(
            inner=_where(found.taken_back, state.inner, inner),
            start=found.start,
            which=found.which,
            until=jnp.where(found.again & ~found.over, jnp.maximum(state.until, t1), state.until),
            last=found.last,
        )
        result = diffrax.RESULTS.where(found.again, diffrax.RESULTS.successful, result)
        result = diffrax.RESULTS.where(found.ends, diffrax.RESULTS.event_occurred, result)
        result = diffrax.RESULTS.where(found.lost, diffrax.RESULTS.dt_min_reached, result)
        next_t0 = jnp.where(found.taken_back, t0, next_t0)
        next_t1 = jnp.where(found.again, found.end, next_t1)
        return keep & ~found.taken_back, next_t0, next_t1, jumped, state, result

    def _watched(self, t: Any, y: Any, args: Any) -> Quantities:
        # Where steps end has no derivative, and compiling one would take its time.
        still = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x  # noqa: E731
        return self.watch(*jax.tree.map(still, (t, y, args)))


class _Decision(NamedTuple):
    """What becomes of a step: whether it is made `again`, to `end`; is `over` the bound; `ends` the motion; is `lost`,
    since a quantity is no number behind it; is `taken_back`, for one of these. And the state of the controller that
    follows, as `Stopping` has it."""

    again: Array
    over: Array
    ends: Array
    lost: Array
    taken_back: Array
    end: Array
    start: Quantities
    which: Array
    last: Array


@fused
def _decision(limits: Limits, start: Quantities, now: Quantities, t0, t1, which, last, kept) -> _Decision:
    # One function of scalars: as sixty operations it would be as many programs, and a third of XLA's work.
    h = t1 - t0
    unknown = kept & functools.reduce(operator.or_, [x != x for x in now.values], jnp.array(False))
    lost = unknown & (h <= limits.resolution)
    kept &= ~unknown
    first, x = _first(limits, start, now, h)
    crossed = kept & (x <= 1)
    over = kept & (start.bound * now.bound < 0)
    at_bound = (over & (h <= limits.shortest)) | (kept & ~over & (t1 >= last))
    at_start = crossed & (x == 0) & ~over
    there = crossed & ((1 - x) * h <= limits.resolution) & ~over & ~at_start & ~at_bound
    at_start &= ~at_bound
    again = ((crossed | over) & ~there & ~at_start & ~at_bound) | (unknown & ~lost)
    beyond = jnp.where(over | unknown, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * limits.resolution)
    taken_back = again | at_start | at_bound | lost
    return _Decision(
        again=again,
        over=over,
        ends=there | at_start | at_bound,
        lost=lost,
        taken_back=taken_back,
        end=t0 + beyond,
        start=_where(kept & ~taken_back, now, start),
        which=jnp.where(there | at_start, first, jnp.where(at_bound, float(len(limits.directions)), which)),
        last=jnp.where(over, jnp.minimum(last, t1), last),
    )


def _first(limits: Limits, start: Quantities, now: Quantities, h: Array) -> tuple[Array, Array]:
    """Which quantity passes zero first in a step, and where in [0, 1]; infinite if none does."""
    direction = jnp.asarray(limits.directions, h.dtype)
    # Where a quantity has no rate, as a norm at zero, the chord has to do.
    chord = now.values - start.values
    slopes = [jnp.where(jnp.abs(rates) < jnp.inf, h * rates, chord) for rates in (start.rates, now.rates)]
    x = first_crossing(start.values, slopes[0], now.values, slopes[1], direction)
    # What is to vanish within a rounding error behind the step vanishes at its end.
    coming = (now.values * now.rates < 0) & (direction * now.rates >= 0)
    coming &= jnp.abs(now.values) <= jnp.abs(now.rates) * limits.rounding
    x = jnp.where(coming, jnp.minimum(x, 1.0), x)
    first, where = jnp.full_like(h, -1.0), jnp.full_like(h, jnp.inf)
    for i in reversed(range(len(limits.directions))):
        nearer = x[i] <= where
        first, where = jnp.where(nearer, float(i), first), jnp.where(nearer, x[i], where)
    return first, where


class AdaptiveToStops(ToStops, diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """`ToStops` around a controller with tolerances, which implicit solvers ask for."""

    @property
    def rtol(self) -> Any:  # type: ignore[override]
        return self.controller.rtol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def atol(self) -> Any:  # type: ignore[override]
        return self.controller.atol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def norm(self) -> Any:  # type: ignore[override]
        return self.controller.norm  # pyright: ignore[reportAttributeAccessIssue]


def _where(condition: Any, x: Any, y: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), x, y)
