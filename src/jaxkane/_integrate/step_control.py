"""What decides on each step: whether it is kept, how long the next one is, and whether the motion has ended.

A step is as long as its error allows, and ends at the kinks of inputs, at events and at the last time.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._scalarjit.function import ScalarFunction
from .._scalarjit.jaxpr import LARGEST_SUM
from .._scalarjit.nan import constant
from .events import EventValues, first_crossing
from .inputs import Discontinuities, count_until
from .status import Status


class Times(NamedTuple):
    """Of a motion [s]: its `start` and `end`; its `first` step by error control; the `shortest` step; how far behind an
    event the last step may end (`resolution`), and how near to an event it is looked for; a step that is not halved at
    the bound; and by how much times differ through `rounding` alone."""

    start: Array
    end: Array
    first: Array
    shortest: Array
    resolution: Array
    event_reach: Array
    at_bound: Array
    rounding: Array


def times_of(start: Array, second: Array, end: Array) -> Times:
    """Of the first, the second and the last time at which the motion is kept."""
    eps, duration = jnp.finfo(end.dtype).eps, jax.lax.stop_gradient(end - start)
    shortest = 1e3 * eps * duration
    resolution = 8 * shortest + 1e-11 * duration
    return Times(
        start=start,
        end=end,
        # A first step, right or wrong by a factor of ten, spares the two more copies of the right-hand side by which
        # the error could choose one.
        first=jnp.minimum(duration / 1000, jax.lax.stop_gradient(second - start)),
        shortest=shortest,
        resolution=resolution,
        event_reach=4 * resolution,
        at_bound=duration / 1000,
        rounding=64 * eps * jax.lax.stop_gradient(jnp.maximum(jnp.abs(start), jnp.abs(end))),
    )


def evenly_spread(times: Times, step: Array) -> Array:
    """The longest of the fixed steps, not longer than `step`, of which a whole number makes the whole time.

    A rounding error must not make it one step more, after which no step would end where a sample of an input stands.
    """
    duration, longest = times.end - times.start, step * (1.0 + jnp.finfo(step.dtype).eps ** 0.5)
    return duration / jax.lax.stop_gradient(jnp.ceil(duration / longest))


class ClipToDiscontinuities(eqx.Module):
    """The `times` (n,) of kinks, in rising order, that no step passes over; infinity for those that are none.

    A step over a kink would be of first order, whatever the solver. What is left before a kink is gone in one step, or
    in two halves, so that no step is as short as a rounding error: after that, the shortest would end the motion.

    The derivative of a signal by the time of its kink differs on the two sides, and so a step must belong to one of
    them. Steps therefore end and begin a rounding error beside a kink, and move with it; other ends do not move. With
    `restart` they begin with a right-hand side of their own: where two signals have a kink at one time, and only one of
    them moves, the derivative that came from the left would be wrong on the right.
    """

    times: Float[Array, " n"]
    rounding: Array
    restart: bool = eqx.field(static=True)

    @classmethod
    def of(cls, discontinuities: Discontinuities, times: Times) -> ClipToDiscontinuities:
        """Those before the end. A step that ends beside a kink at the end would leave the end out."""
        are_before = discontinuities.times < times.end - times.rounding
        return cls(jnp.where(are_before, discontinuities.times, jnp.inf), times.rounding, discontinuities.restart)

    def after(self, t: Array) -> Array:
        """The next kink; infinity where there is none."""
        i = count_until(*jax.lax.stop_gradient((self.times, t + self.rounding)))
        return jnp.where(i < len(self.times), self.times[jnp.minimum(i, len(self.times) - 1)], jnp.inf)

    def beside(self, t0: Array, t1: Array) -> NearbyDiscontinuities:
        """Of a step, which ends at the next kink after its start or before."""
        kink = self.after(t0)
        at_end = jnp.abs(t1 - kink) <= self.rounding
        start = jnp.where(at_end, kink + 0.25 * self.rounding, t1)
        return NearbyDiscontinuities(at_end, start, self.after(start), kink, self.rounding)


class NearbyDiscontinuities(NamedTuple):
    """The kinks beside a step: whether it ends `at_kink`; the `start` of the next step where this one is kept; the next
    kinks after that start, and after the start of this step; and their `rounding`."""

    at_kink: Array
    start: Array
    after: Array
    before: Array
    rounding: Array


def _clipped(t0: Array, t1: Array, kink: Array, rounding: Array) -> Array:
    """The end of a step that would end at t1, where the next kink may come before."""
    t1, halfway = jax.lax.stop_gradient((t1, t0 + 0.5 * (kink - t0)))
    return jnp.where(t1 >= kink, kink - 0.25 * rounding, jnp.minimum(t1, halfway))


class Progress(NamedTuple):
    """What one step leaves to the next, as floats: a loop masks, copies and saves each array of its state by a program
    of its own, and so this is one array where it is `packed`.

    `status` of the motion: `COMPLETED` until something else ends it; numbers of `steps`, and of those `accepted`;
    `rejected_end`: the end of a step that an event rejected, else -infinity; `over_bound`: the end of the first step
    over the bound, else infinity; `start`: the quantities at the start of the step, None where there are none.
    """

    status: Array
    steps: Array
    accepted: Array
    rejected_end: Array
    over_bound: Array
    start: EventValues | None

    def packed(self) -> Array:
        *numbers, start = self
        more: Any = () if start is None else (start.bound[None], start.values, start.rates)
        return jnp.concatenate([jnp.stack(numbers), *more])

    @classmethod
    def unpacked(cls, numbers: Array) -> Progress:
        n = len(cls._fields) - 1
        values = numbers[n + 1 :]
        middle = values.size // 2
        start = EventValues(values[:middle], values[middle:], numbers[n]) if numbers.size > n else None
        return cls(numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], start)


class Step(NamedTuple):
    """A step from `t0` to `t1`; the next step; and whether this one is kept."""

    t0: Array
    t1: Array
    next_t0: Array
    next_t1: Array
    keep: Array


class EventDecision(NamedTuple):
    """What events make of a step: whether it is kept; the next step; whether it is to `repeat`; whether the motion
    `ends`, or `fails` since a quantity is no number behind it; and the `progress`."""

    keep: Array
    next_t0: Array
    next_t1: Array
    repeat: Array
    ends: Array
    fails: Array
    progress: Progress


class Decision(NamedTuple):
    """What becomes of a step: whether it is kept; the ends of the next one; whether that begins behind a jump; the
    `progress`, packed; and whether the motion goes on."""

    keep: Array
    t0: Array
    t1: Array
    jumped: Array
    progress: Array
    is_running: Array


class ControlSettings(eqx.Module):
    """The numbers by which steps are chosen: tolerances and the `order` of the error, or a fixed `step` [s]; the times;
    at most `max_steps`; and the directions in which events count (see `first_crossing`)."""

    rtol: Any
    atol: Any
    step: Any
    times: Times
    order: Any = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True)
    directions: tuple[int, ...] = eqx.field(static=True)


class StepSizeController(NamedTuple):
    """The `settings`; `quantities`: (t, y, args) -> `EventValues`, None where there are none; and the kinks."""

    settings: ControlSettings
    quantities: Callable[..., EventValues] | None
    kinks: ClipToDiscontinuities | None

    def first(self, y0: Array, args: Any) -> tuple[Array, Array]:
        """The end of the first step, and the progress, packed."""
        start = self.settings.times.start
        kink = None if self.kinks is None else (self.kinks.after(start), self.kinks.rounding)
        return _first(self.settings, self._values(start, y0, args), kink)

    def following(
        self, progress: Array, t0: Array, t1: Array, y0: Array, y1: Array, error: Any, failed: Array | None, args: Any
    ) -> Decision:
        """What becomes of a step from (t0, y0) to (t1, y1).

        **Arguments:** the solver's estimate of the `error`, None where it has none; whether it `failed`, None where it
        cannot.
        """
        beside = None if self.kinks is None else self.kinks.beside(t0, t1)
        measured = constant((y0, y1, error))
        decide = _following if y0.size <= LARGEST_SUM else _following.__wrapped__
        return decide(self.settings, constant(progress), t0, t1, self._values(t1, y1, args), measured, failed, beside)

    def _values(self, t: Any, y: Any, args: Any) -> EventValues | None:
        # Where steps end has no derivative, and compiling one would take its time.
        return None if self.quantities is None else self.quantities(*constant((t, y, args)))


@ScalarFunction.once
def _first(settings: ControlSettings, quantities: EventValues | None, kink: Any) -> tuple[Array, Array]:
    times = settings.times
    h = jnp.maximum(times.first, times.shortest) if settings.step is None else settings.step
    end = times.start + h
    end = end if kink is None else _clipped(times.start, end, *kink)
    status, none, past, never = (jnp.full_like(h, x) for x in (Status.COMPLETED, 0.0, -jnp.inf, jnp.inf))
    start = None if quantities is None else _on_zero(quantities, times.shortest)
    return jnp.minimum(end, times.end), Progress(status, none, none, past, never, start).packed()


# One function of scalars: as a hundred operations it would be as many programs, and half of XLA's work.
@ScalarFunction
def _following(
    settings: ControlSettings,
    progress: Array,
    t0: Array,
    t1: Array,
    quantities: EventValues | None,
    measured: tuple[Array, Array, Any],
    failed: Array | None,
    beside: NearbyDiscontinuities | None,
) -> Decision:
    times, before = settings.times, Progress.unpacked(progress)
    y0, y1, error = measured
    if failed is not None:
        y1, error = jax.tree.map(lambda x: jnp.where(failed, jnp.inf, x), (y1, error))
    if settings.step is not None:
        keep = jnp.all(jnp.isfinite(y1))
        h, too_short = _to_next(settings, t1), ~keep
    else:
        keep, h, too_short = _by_error(settings, t1 - t0, y0, y1, error)
    if beside is None:
        next_t0, jumped = jnp.where(keep, t1, t0), jnp.zeros_like(keep)
        next_t1 = next_t0 + h
    else:
        next_t0, jumped = jnp.where(keep, beside.start, t0), keep & beside.at_kink
        next_t1 = _clipped(next_t0, next_t0 + h, jnp.where(keep, beside.after, beside.before), beside.rounding)
    # The rest of a step that an event rejected follows at once: a fixed step stays on its grid.
    resumes = keep & (t1 < before.rejected_end)
    next_t1 = jnp.where(resumes, before.rejected_end, next_t1)
    step = Step(t0, t1, next_t0, next_t1, keep)
    by_events = _after_events(settings.directions, times, before, quantities, step)
    too_short &= ~by_events.repeat
    # A last step is none of a rounding error, and one that was not kept is halved.
    near = by_events.next_t1 > times.end - 100 * jnp.finfo(times.end.dtype).eps * jnp.abs(times.end)
    last = jnp.where(by_events.keep, times.end, by_events.next_t0 + 0.5 * (times.end - by_events.next_t0))
    ends = by_events.ends | (by_events.keep & (by_events.next_t0 >= times.end))
    fails = (too_short & ~ends) | by_events.fails
    steps, accepted = before.steps + 1.0, before.accepted + by_events.keep.astype(before.steps.dtype)
    failure = jnp.where(accepted > 0, float(Status.STEP_TOO_SMALL), float(Status.NO_SOLUTION))
    status = jnp.where(fails, failure, by_events.progress.status)
    is_running = ~(ends | fails)
    if settings.max_steps is not None:
        is_last = is_running & (steps >= settings.max_steps)
        status, is_running = jnp.where(is_last, float(Status.MAX_STEPS), status), is_running & ~is_last
    return Decision(
        by_events.keep,
        by_events.next_t0,
        jnp.where(near, last, by_events.next_t1),
        jumped,
        by_events.progress._replace(status=status, steps=steps, accepted=accepted).packed(),
        is_running,
    )


def _to_next(settings: ControlSettings, t: Array) -> Array:
    """From a time to the next end of a fixed step. These stand on a grid from the start on, which rounding errors of
    the steps do not move; nor does a step that was halved."""
    start, step = settings.times.start, settings.step
    return start + step * (jnp.floor((t - start) / step + 0.01) + 1.0) - t


def _by_error(settings: ControlSettings, h: Array, y0: Array, y1: Array, error: Array) -> tuple[Array, Array, Array]:
    """Whether a step of the length h is kept, the length of the next one, and whether that is too short.

    As `diffrax.PIDController` with its own coefficients: of the error e by its tolerances,

        e < 1,   h clip(0.9 e^(-1 / order), 1 or 0.2, 10 or 0.9)      (where it is kept, or is not)
    """
    y1 = jnp.where(jnp.any(jnp.isnan(y1)), y0, y1)
    scaled = error / (settings.atol + settings.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1)))
    e = jnp.sqrt(jnp.mean(scaled * scaled))
    e = jnp.where(e < jnp.inf, e, jnp.inf)  # as large, where the rates are no numbers
    keep = e < 1
    factor = 0.9 * e ** (-1.0 / settings.order)
    factor = jnp.clip(factor, jnp.where(keep, 1.0, 0.2), jnp.where(keep, 10.0, 0.9))
    h = h * jax.lax.stop_gradient(factor)
    return keep, jnp.maximum(h, settings.times.shortest), h < settings.times.shortest


def _on_zero(start: EventValues, rounding: Array) -> EventValues:
    """At the start of a motion: what would have vanished within a rounding error [s] is on zero."""
    vanishes = jnp.abs(start.values) <= jnp.abs(start.rates) * rounding
    return start._replace(values=jnp.where(vanishes, jnp.zeros_like(start.values), start.values))


def _after_events(
    directions: tuple[int, ...], times: Times, progress: Progress, end: EventValues | None, step: Step
) -> EventDecision:
    """What becomes of a step at whose `end` the events have these values.

    A cubic through the values and rates at both ends of a step tells whether an event passes zero. Where it does, the
    step is rejected and repeated to just beyond that time, until a step is kept that ends there, which is the last.

    A step behind which a quantity is no number is halved. Where it is as short as the resolution, the motion ends
    before it as one whose steps became too small: whether the quantity passed zero is unknown.

    A step over the bound is halved; where it is as short as `times.at_bound`, the motion ends before it. It also ends
    where the first step over the bound did, if shorter ones do not pass it: so near to it, the outcome is chance.
    """
    false = jnp.zeros_like(step.keep)
    if end is None:
        return EventDecision(step.keep, step.next_t0, step.next_t1, false, false, false, progress)
    start: Any = progress.start
    t0, t1 = jax.lax.stop_gradient((step.t0, step.t1))
    h, kept = t1 - t0, step.keep
    unknown = kept & functools.reduce(operator.or_, [x != x for x in end.values], jnp.array(False))
    fails = unknown & (h <= times.resolution)
    kept &= ~unknown
    event, x = _first_event(directions, times.shortest, start, end, h)
    crossed = kept & (x <= 1)
    over = kept & (start.bound * end.bound < 0)
    at_bound = (over & (h <= times.at_bound)) | (kept & ~over & (t1 >= progress.over_bound))
    at_start = crossed & (x == 0) & ~over & ~at_bound
    at_end = crossed & ((1 - x) * h <= times.resolution) & ~over & (x != 0) & ~at_bound
    repeat = ((crossed | over) & ~at_end & ~at_start & ~at_bound) | (unknown & ~fails)
    beyond = jnp.where(over | unknown, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * times.resolution)
    rejected = repeat | at_start | at_bound | fails
    status = jnp.where(at_bound, float(Status.SINGULAR_SPEEDS), progress.status)
    return EventDecision(
        keep=step.keep & ~rejected,
        next_t0=jnp.where(rejected, step.t0, step.next_t0),
        next_t1=jnp.where(repeat, t0 + beyond, step.next_t1),
        repeat=repeat,
        ends=at_end | at_start | at_bound,
        fails=fails,
        progress=progress._replace(
            status=jnp.where(at_end | at_start, float(Status.EVENT) + event, status),
            rejected_end=jnp.where(repeat & ~over, jnp.maximum(progress.rejected_end, t1), progress.rejected_end),
            over_bound=jnp.where(over, jnp.minimum(progress.over_bound, t1), progress.over_bound),
            start=jax.tree.map(lambda new, old: jnp.where(kept & ~rejected, new, old), end, start),
        ),
    )


def _first_event(
    directions: tuple[int, ...], rounding: Array, start: EventValues, end: EventValues, h: Array
) -> tuple[Array, Array]:
    """Which quantity passes zero first in a step, and where in [0, 1]; infinite if none does."""
    direction = jnp.asarray(directions, h.dtype)
    # Where a quantity has no rate, as a norm at zero, the chord has to do.
    chord = end.values - start.values
    slopes = [jnp.where(jnp.abs(rates) < jnp.inf, h * rates, chord) for rates in (start.rates, end.rates)]
    x = first_crossing(start.values, slopes[0], end.values, slopes[1], direction)
    # What is to vanish within a rounding error behind the step vanishes at its end.
    coming = (end.values * end.rates < 0) & (direction * end.rates >= 0)
    coming &= jnp.abs(end.values) <= jnp.abs(end.rates) * rounding
    x = jnp.where(coming, jnp.minimum(x, 1.0), x)
    event, place = jnp.full_like(h, -1.0), jnp.full_like(h, jnp.inf)
    for i in reversed(range(len(directions))):
        nearer = x[i] <= place
        event, place = jnp.where(nearer, float(i), event), jnp.where(nearer, x[i], place)
    return event, place
