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
    """What ends a motion: its `end` [s], and quantities in these `directions` (see `first_crossing`).

    `numbers` (3,) [s]: how far behind a crossing the last step may end (`resolution`); what is no time (`rounding`);
    and a step that is not halved at the bound (`shortest`).
    """

    directions: tuple[int, ...] = eqx.field(static=True)
    end: Array
    numbers: Array

    @property
    def resolution(self) -> Array:
        return self.numbers[0]

    @property
    def rounding(self) -> Array:
        return self.numbers[1]

    @property
    def shortest(self) -> Array:
        return self.numbers[2]


class Stopping(NamedTuple):
    """The state of a controller that stops: that of its inner controller; the quantities at the step's start; which one
    ended the motion, as a float, -1 for none and n for the bound; the end of a step that was taken back, else
    -infinity; and the end of the first step over the bound, else infinity."""

    inner: Any
    start: Quantities | None
    which: Array
    until: Array
    last: Array


class ToStops(diffrax.AbstractStepSizeController[Any, Any]):
    """A controller that begins with a given step, and whose last step ends at the last time, or where a quantity
    vanishes. The solution then ends as one with an event.

    The motion is watched through the cubic between both ends of a step: their values and rates. Where that passes zero
    the step is taken back, and made anew to just beyond that time; so long, until the step that ends there is one that
    is right by the inner controller's measure. Two crossings within one step are seen where the cubic sees them.

    A step behind which a quantity is no number is halved; where it is as short as the resolution, the motion ends
    before it as one whose steps became too small, since whether the quantity passed zero cannot be said.

    A step over the bound is halved; where it is as short as the shortest, the motion ends before it. It also ends where
    the first step over the bound did, if shorter ones do not pass it: so near to it, what is found is by chance.

    `watch`: (t, y, args) -> `Quantities`; None where there are none.
    """

    controller: diffrax.AbstractStepSizeController[Any, Any]
    watch: Callable[..., Quantities] | None
    first: Array
    limits: Limits

    def wrap(self, direction: Any) -> ToStops:
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, inner = self.controller.init(terms, t0, t1, y0, self.first, args, func, error_order)
        start = self._watched(t0, y0, args)
        if start is not None:
            start = _begun(self.limits, start)
        return end, Stopping(inner, start, *(jnp.full_like(t0, x) for x in (-1.0, -jnp.inf, jnp.inf)))

    def adapt_step_size(self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        state: Stopping = controller_state
        following: Any = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state.inner
        )
        keep, next_t0, next_t1, jumped, inner, result = following
        now = self._watched(t1, y1_candidate, args)
        step = Step(t0, t1, next_t0, next_t1, jnp.asarray(keep))
        found = _decision(self.limits, state._replace(inner=None), now, step)
        state = found.state._replace(inner=_where(found.unchanged, state.inner, inner))
        result = diffrax.RESULTS.where(found.again, diffrax.RESULTS.successful, result)
        result = diffrax.RESULTS.where(found.ends, diffrax.RESULTS.event_occurred, result)
        result = diffrax.RESULTS.where(found.lost, diffrax.RESULTS.dt_min_reached, result)
        return found.keep, found.next_t0, found.next_t1, jumped, state, result

    def _watched(self, t: Any, y: Any, args: Any) -> Quantities | None:
        # Where steps end has no derivative, and compiling one would take its time.
        still = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x  # noqa: E731
        return None if self.watch is None else self.watch(*jax.tree.map(still, (t, y, args)))


class Step(NamedTuple):
    """A step from `t0` to `t1`, and what the inner controller makes of it: the next step, and whether this is kept."""

    t0: Array
    t1: Array
    next_t0: Array
    next_t1: Array
    keep: Array


class _Decision(NamedTuple):
    """What becomes of a step: whether it is kept; the next one; whether it is made `again`; `ends` the motion; is
    `lost`, since a quantity is no number behind it; whether the inner controller's state is `unchanged`; and the state
    that follows."""

    keep: Array
    next_t0: Array
    next_t1: Array
    again: Array
    ends: Array
    lost: Array
    unchanged: Array
    state: Stopping


@fused
def _begun(limits: Limits, start: Quantities) -> Quantities:
    # What would have vanished within a rounding error of the start is on zero there.
    on_zero = jnp.abs(start.values) <= jnp.abs(start.rates) * limits.rounding
    return start._replace(values=jnp.where(on_zero, jnp.zeros_like(start.values), start.values))


@fused
def _decision(limits: Limits, state: Stopping, now: Quantities | None, step: Step) -> _Decision:
    # One function of scalars: as a hundred operations it would be as many programs, and half of XLA's work.
    # What is left of a step that was taken back is gone at once: a fixed step stays on its grid.
    going_on = step.keep & (step.t1 < state.until)
    step = step._replace(next_t1=jnp.where(going_on, state.until, step.next_t1))
    none = jnp.zeros_like(step.keep)
    found = _Decision(step.keep, step.next_t0, step.next_t1, none, none, none, going_on, state)
    if now is not None:
        found = _watching(limits, state, now, step, going_on)
    # As diffrax does it, a last step is none of a rounding error, and one that was not kept is halved.
    near = found.next_t1 > limits.end - 100 * jnp.finfo(limits.end.dtype).eps * jnp.abs(limits.end)
    last = jnp.where(found.keep, limits.end, found.next_t0 + 0.5 * (limits.end - found.next_t0))
    arrived = found.keep & (found.next_t0 >= limits.end)
    return found._replace(next_t1=jnp.where(near, last, found.next_t1), ends=found.ends | arrived)


def _watching(limits: Limits, state: Stopping, now: Quantities, step: Step, going_on: Array) -> _Decision:
    start: Any = state.start
    t0, t1 = jax.lax.stop_gradient((step.t0, step.t1))
    h, kept = t1 - t0, step.keep
    unknown = kept & functools.reduce(operator.or_, [x != x for x in now.values], jnp.array(False))
    lost = unknown & (h <= limits.resolution)
    kept &= ~unknown
    first, x = _first(limits, start, now, h)
    crossed = kept & (x <= 1)
    over = kept & (start.bound * now.bound < 0)
    at_bound = (over & (h <= limits.shortest)) | (kept & ~over & (t1 >= state.last))
    at_start = crossed & (x == 0) & ~over
    there = crossed & ((1 - x) * h <= limits.resolution) & ~over & ~at_start & ~at_bound
    at_start &= ~at_bound
    again = ((crossed | over) & ~there & ~at_start & ~at_bound) | (unknown & ~lost)
    beyond = jnp.where(over | unknown, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * limits.resolution)
    taken_back = again | at_start | at_bound | lost
    which = jnp.where(there | at_start, first, jnp.where(at_bound, float(len(limits.directions)), state.which))
    return _Decision(
        keep=step.keep & ~taken_back,
        next_t0=jnp.where(taken_back, step.t0, step.next_t0),
        next_t1=jnp.where(again, t0 + beyond, step.next_t1),
        again=again,
        ends=there | at_start | at_bound,
        lost=lost,
        unchanged=going_on | taken_back,
        state=Stopping(
            inner=None,
            start=_where(kept & ~taken_back, now, start),
            which=which,
            until=jnp.where(again & ~over, jnp.maximum(state.until, t1), state.until),
            last=jnp.where(over, jnp.minimum(state.last, t1), state.last),
        ),
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
