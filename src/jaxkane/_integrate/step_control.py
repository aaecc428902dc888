"""Step size control: how long the next step is, whether a step is accepted, and where the simulation ends.

A step is as long as its error allows, and ends at discontinuities of inputs, at events and at the end of the
simulation. The integration variable is the time since the start, so that the clock of the system does not matter.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, PyTree

from .._scalarjit.components import Component
from .._scalarjit.jaxpr import LARGEST_SUM
from .._scalarjit.nan import constant
from .._scalarjit.scalar_function import ScalarFunction
from .discontinuities import Discontinuities, rounding
from .events import Events, EventValues, Status, first_event, is_at_start
from .inputs import RateArguments


class ControllerState(NamedTuple):
    """The state of the controller between two steps.

    It is carried as one array (`packed`), since a loop masks, copies and saves each array by a program of its own.

    Fields, all floats:

    - `status`: a `Status` code; `COMPLETED` until the simulation ends early.
    - `rejected_end`: the end of a step that an event rejected [s], else -infinity.
    - `over_bound`: the end of the first step over the bound (see `EventValues`) [s], else infinity.
    - `reach`: the distance to the event within which the last step ends [s].
    - `length`: the length of the step that an event rejected first [s]. After a jump, steps continue with it.
    - `jump`: the event whose jump is due where this step ends, or where it begins if it was rejected; -1 if none is.
    - `last_jump`: the event of the jump at which this step begins; -1 if it begins at no jump.
    - `begin`: the start of the last accepted step [s].
    - `start`: the event functions at the start of the step; None if the system has none.
    """

    status: Array
    rejected_end: Array
    over_bound: Array
    reach: Array
    length: Array
    jump: Array
    last_jump: Array
    begin: Array
    start: EventValues | None

    def packed(self) -> Array:
        *numbers, start = self
        return jnp.concatenate([jnp.stack(numbers), *(() if start is None else (start.packed(),))])

    @classmethod
    def unpacked(cls, numbers: Array, n_events: int) -> ControllerState:
        n = len(cls._fields) - 1
        start = EventValues.unpacked(numbers[n:], n_events) if numbers.size > n else None
        return cls._make([*(numbers[i] for i in range(n)), start])


class Decision(NamedTuple):
    """The decision about a step.

    Fields:

    - `keep`: whether it is accepted.
    - `t0`, `t1`: start and end of the next step [s].
    - `jumped`: whether the next step begins at a discontinuity.
    - `state`: the `ControllerState`, packed.
    - `ended`: whether the simulation ends here.
    """

    keep: Array
    t0: Array
    t1: Array
    jumped: Array
    state: Array
    ended: Array


class StepSizeController(diffrax.AbstractAdaptiveStepSizeController[Array, None]):
    """A step size controller of diffrax that also ends steps at discontinuities and at events.

    Attributes:

    - `rtol`, `atol`: tolerances of a step; zero for fixed steps.
    - `step`: a fixed step [s], else None. `first`: the first step [s]. `longest`: the longest step [s], or infinity.
    - `duration`: the end of the simulation [s] since its start.
    - `discontinuities`: times at which steps end, or None.
    - `event_values`: (t, y, args) -> `EventValues`, None if nothing can end the simulation.
    - `events`: the events of the system.
    - `inner`: another controller of diffrax, which chooses the length and accepts the step, or None.
    - `norm`: the norm of the error, which implicit solvers use too.
    """

    rtol: Any
    atol: Any
    step: Any
    first: Array
    longest: Any
    duration: Array
    discontinuities: Discontinuities | None
    event_values: Callable[..., EventValues] | None
    events: Events = eqx.field(static=True)
    inner: diffrax.AbstractStepSizeController | None = None
    norm: Callable[[Any], Any] = eqx.field(static=True, default=optx.rms_norm)

    def wrap(self, direction: Component) -> StepSizeController:
        return self if self.inner is None else dataclasses.replace(self, inner=self.inner.wrap(direction))

    def init(
        self,
        terms: Any,
        t0: Component,
        t1: Component,
        y0: Array,
        dt0: Component,
        args: RateArguments,
        func: Callable[..., Array],
        error_order: Component,
    ) -> tuple[Array, Any]:
        """The end of the first step, and the state of the controller."""
        contacts = constant(y0) if self.events.layout.names else None
        end, state = _first(self._numbers(), contacts, self._values(t0, t0, y0, args), self._stop_after(t0))
        if self.inner is None:
            return end, (state, None)
        proposed, inner_state = self.inner.init(terms, t0, t1, y0, end - t0, args, func, error_order)
        return jnp.minimum(end, proposed), (state, inner_state)

    def adapt_step_size(
        self,
        t0: Component,
        t1: Component,
        y0: Array,
        y1_candidate: Array,
        args: RateArguments,
        y_error: Array | None,
        error_order: Component,
        controller_state: PyTree[Array],
        error_of_tangent: Array | None = None,
    ) -> tuple[Any, Array, Array, Any, Any, diffrax.RESULTS]:
        """Whether a step from (t0, y0) to (t1, y1_candidate) is accepted, and the next step: see diffrax.

        `error_of_tangent`: the error of a tangent, relative to its size, or None."""
        y1, (state, inner_state) = y1_candidate, controller_state
        chosen, measured = None, constant((y0, y1, y_error, error_of_tangent))
        if self.inner is not None:
            keep, start, end, _, inner_state, _ = self.inner.adapt_step_size(
                t0, t1, y0, y1, args, y_error, error_order, inner_state
            )
            chosen, measured = constant((keep, end - start)), (*constant((y0, y1)), None, None)
        decide = _decide if y0.size <= LARGEST_SUM else _decide.__wrapped__
        decision = decide(
            self._numbers(), constant(state), t0, t1, self._values(t0, t1, y1, args), measured, chosen,
            jnp.asarray(-1.0 / error_order if y_error is not None else 0.0, t1.dtype),
            self._stop_after(t0), self._stop_after(t1),
        )  # fmt: skip
        restart = self.discontinuities is not None and self.discontinuities.restart
        result = diffrax.RESULTS.where(decision.ended, diffrax.RESULTS.event_occurred, diffrax.RESULTS.successful)
        state = (decision.state, inner_state)
        return decision.keep, decision.t0, decision.t1, decision.jumped if restart else False, state, result

    def after_jump(self, state: PyTree[Array], t: Array, y: Array, args: RateArguments) -> tuple[Array, Any]:
        """The end of the step that begins after a jump to (t, y), and the state of the controller."""
        t, state = constant((t, state[0]))
        # If an input is discontinuous here, its event is still due: the value is that at the end of the last step.
        values = self._values(ControllerState.unpacked(state, len(self.events.names)).begin, t, y, args)
        end, state = _after_jump(self._numbers(), state, t, values, self._stop_after(t))
        return end, (state, None)

    def _numbers(self) -> StepSizeController:
        return dataclasses.replace(self, discontinuities=None, event_values=None, inner=None)

    def _stop_after(self, t: Array) -> Array | None:
        if self.discontinuities is None or self.step is not None:
            return None
        return self.discontinuities.after(t, self.duration)

    def _values(self, t0: Array, t1: Array, y1: Array, args: RateArguments) -> EventValues | None:
        # The end of a step has no derivative here: `Problem.located` differentiates the event itself.
        if self.event_values is None:
            return None
        return self.event_values(*constant((t1, y1, args if t0 is t1 else args.in_step(t0, t1))))


FEWEST_STEPS = 50
"""The fewest steps of a simulation with error control. While a system is at rest, its error does not limit the steps.
Longer steps would skip a force that begins later."""

TANGENT = 10.0
"""The permitted error of a tangent in a step, relative to its largest size so far, is this multiple of `rtol`."""

SHARE = 5e-3
"""The end of a fixed step and a sample are regarded as simultaneous within this share of the step."""


def first_step(taus: Array) -> Array:
    """The first step with error control, from the times (n_t,) since the start.

    A guess that is wrong by a factor of ten is cheaper than an estimate from the error, which would compile two more
    copies of the right-hand side.
    """
    return jax.lax.stop_gradient(jnp.minimum(taus[-1] / 1000, taus[1]))


def evenly_spread(duration: Array, step: Array) -> Array:
    """The longest fixed step that is at most `step` and divides the duration into a whole number of steps.

    The rounding of a clock must not add a step, because the steps would then not end at the samples of an input. This
    rounding is 0.24 % of the step for POSIX times at 10 kHz.
    """
    number = jax.lax.stop_gradient(duration / step)
    return duration / jnp.maximum(jnp.ceil(number * (1 - jnp.finfo(step.dtype).eps ** 0.5) - SHARE), 1.0)


def _shortest(t: Array, duration: Array) -> Array:
    # The shortest step [s]. The length of a shorter step would consist of rounding errors.
    return 16 * rounding(t, duration)


def almost(duration: Array) -> Array:
    """The time from which on a simulation ends: a step over the remainder would consist of rounding errors."""
    return duration * (1 - 100 * jnp.finfo(duration.dtype).eps)


def _resolution(t1: Array, h: Array, duration: Array) -> Array:
    """The longest permitted time from an event to the end of the step [s]."""
    return 8 * rounding(t1, duration) + 1e-11 * h


@ScalarFunction.compile_cheaply
def _first(
    control: StepSizeController, y0: Array | None, values: EventValues | None, stop: Array | None
) -> tuple[Array, Array]:
    end = jnp.minimum(control.first, control.longest) if control.step is None else control.step
    end = end if stop is None else _clipped(jnp.zeros_like(end), end, stop)
    status, past, never, zero = (jnp.full_like(end, x) for x in (Status.COMPLETED, -jnp.inf, jnp.inf, 0.0))
    start, rounding = None, 1e6 * jnp.finfo(end.dtype).eps * control.first
    if values is not None:
        closing = None if y0 is None else control.events.closing_at_start(y0, values, rounding)
        start = values._replace(noise=None).at_start(control.events, rounding, closing=closing)
    state = ControllerState(status, past, never, zero, end, zero - 1, zero - 1, zero, start)
    return jnp.minimum(end, control.duration), state.packed()


# One `ScalarFunction`, as `_decide`.
@ScalarFunction.compile_cheaply
def _after_jump(
    control: StepSizeController, packed: Array, t: Array, values: EventValues, stop: Array | None
) -> tuple[Array, Array]:
    state, duration = ControllerState.unpacked(packed, len(control.events.names)), control.duration
    end = t + (_to_next(control.step, t) if control.step is not None else jnp.minimum(state.length, control.longest))
    end = end if stop is None else _clipped(t, end, stop)
    # At the end of the simulation, a last short step finds the events at the same time.
    end = jnp.where(end > almost(duration), jnp.maximum(duration, t + _shortest(t, duration)), end)
    resolution = _resolution(t, state.length, duration)
    state = state._replace(
        rejected_end=jnp.full_like(t, -jnp.inf),
        jump=jnp.full_like(t, -1.0),
        last_jump=state.jump,
        start=values._replace(noise=None).at_start(control.events, resolution, state.start, state.jump),
    )
    return end, state.packed()


def _clipped(t0: Array, t1: Array, stop: Array) -> Array:
    # The end of a step that would end at t1, if steps must end at `stop`.
    #
    # The distance to `stop` is covered in one step or split in half. A very short remainder would make the next
    # proposal fall below the shortest step, which ends the simulation. Only an end at `stop` is differentiated.
    t1, halfway = jax.lax.stop_gradient((t1, t0 + 0.5 * (stop - t0)))
    return jnp.where(t1 >= stop, stop, jnp.minimum(t1, halfway))


# One `ScalarFunction`: as a hundred separate operations, this would be half of the work of XLA.
@ScalarFunction
def _decide(
    control: StepSizeController,
    packed: Array,
    t0: Array,
    t1: Array,
    end: EventValues | None,
    measured: tuple[Array, Array, Any, Array | None],
    chosen: tuple[Array, Array] | None,
    exponent: Array,
    stop_after_t0: Array | None,
    stop_after_t1: Any,
) -> Decision:
    before, duration = ControllerState.unpacked(packed, len(control.events.names)), control.duration
    before = before._replace(jump=jnp.full_like(before.jump, -1.0))
    _, y1, *_ = measured
    length = jax.lax.stop_gradient(t1 - t0)
    shortest = _shortest(t1, duration)
    if control.step is not None:
        keep = jnp.all(jnp.isfinite(y1))
        h, too_short = _to_next(control.step, t1), ~keep
    else:
        keep, h = _by_error(control, length, *measured, exponent) if chosen is None else chosen
        h = jnp.minimum(h, control.longest)
        too_short, h = ~keep & (h < shortest), jnp.maximum(h, shortest)
        if end is not None and before.start is not None:
            # A dip of a moving floor may be small: a missed jump is worse than a late end.
            share = 1e-3 if control.events.continue_ else 0.1
            h = jnp.where(keep, jnp.minimum(h, length * before.start.growth(end, length, share)), h)
    next_t0 = jnp.where(keep, t1, t0)
    next_t1 = next_t0 + h
    if control.step is not None:
        jumped = keep
    elif stop_after_t0 is None:
        jumped = jnp.zeros_like(keep)
    else:
        jumped = keep & (jnp.abs(t1 - stop_after_t0) <= rounding(t1, duration))
        next_t1 = _clipped(next_t0, next_t1, jnp.where(keep, stop_after_t1, stop_after_t0))
    # After an event has rejected a step, the next step covers the remainder: fixed steps then stay on their grid.
    next_t1 = jnp.where(keep & (t1 < before.rejected_end), before.rejected_end, next_t1)
    step = Decision(keep, next_t0, next_t1, jumped, packed, jnp.zeros_like(keep))
    decision, state = step, before
    if end is not None:
        decision, state = _at_events(control, before, end, t0, t1, step)
    # The end of the simulation. The last step must not consist of rounding errors. A rejected last step is halved.
    near = decision.t1 > almost(duration)
    halfway = jnp.where(decision.t0 > almost(duration), decision.t1, decision.t0 + 0.5 * (duration - decision.t0))
    last = jnp.where(decision.keep, duration, halfway)
    repeats = decision.keep != keep
    fails = too_short & ~repeats
    status = jnp.where(fails, float(Status.STEP_TOO_SMALL), state.status)
    return decision._replace(
        t1=jnp.where(near, last, decision.t1),
        jumped=decision.jumped & decision.keep,
        state=state._replace(status=status).packed(),
        ended=(status != float(Status.COMPLETED)) | (decision.keep & (decision.t0 >= duration)),
    )


def _to_next(step: Array, t: Array) -> Array:
    # The length from a time to the next end of a fixed step.
    #
    # The ends are multiples of the step. Neither rounding errors nor a step that was halved can shift them.
    return step * (jnp.floor(t / step + 0.01) + 1.0) - t


def _by_error(
    control: StepSizeController,
    h: Array,
    y0: Array,
    y1: Array,
    error: Array,
    error_of_tangent: Array | None,
    exponent: Array,
) -> tuple[Array, Array]:
    """Whether a step of the length h is accepted, and the length of the next one.

    The rule of `diffrax.PIDController` with its own coefficients; e is the error relative to the tolerances:

        e < 1,   h clip(0.9 e^(-1 / order), 1 or 0.2, 10 or 0.9)      (if it is accepted, or rejected)
    """
    y1 = jnp.where(jnp.any(jnp.isnan(y1)), y0, y1)
    scaled = error / (control.atol + control.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1)))
    e = jnp.sqrt(jnp.mean(scaled * scaled))
    if error_of_tangent is not None:
        e = jnp.maximum(e, error_of_tangent / (TANGENT * jnp.maximum(control.rtol, 100 * jnp.finfo(e.dtype).eps)))
    e = jnp.where(e < jnp.inf, e, jnp.inf)  # NaN rates make an infinite error
    keep = e < 1
    factor = jnp.clip(0.9 * e**exponent, jnp.where(keep, 1.0, 0.2), jnp.where(keep, 10.0, 0.9))
    return keep, h * jax.lax.stop_gradient(factor)


def _at_events(
    control: StepSizeController, before: ControllerState, end: EventValues, t0: Array, t1: Array, step: Decision
) -> tuple[Decision, ControllerState]:
    """The decision about a step at whose `end` the event functions have these values.

    A cubic through values and rates at both ends of the step detects whether an event function crosses zero. If so, the
    step is rejected and repeated to just after the crossing, until a step ends there. That step is the last.

    If an event function is NaN at the end of a step, the step is halved. If the step is as short as the resolution, the
    simulation ends before it, because it is unknown whether the function crossed zero. An impossible coefficient of
    friction has the same effect.

    A step over the bound is halved. If the step is as short as a thousandth of the duration, the simulation ends before
    it. If the shorter steps do not cross the bound, the simulation ends before the end of the first step over it.
    """
    start: Any = before.start
    events = control.events
    # A step that is repeated begins where it began, at a discontinuity perhaps, with the derivative of that time.
    begin, (t0, t1) = t0, jax.lax.stop_gradient((t0, t1))
    h, kept, duration = t1 - t0, step.keep, jax.lax.stop_gradient(control.duration)
    resolution = _resolution(t1, h, duration)
    values = [*end.values, *end.conditions]
    is_lawful = jnp.array(True) if end.noise is None else jnp.all(end.noise == end.noise)
    unknown = kept & functools.reduce(operator.or_, [x != x for x in values], ~is_lawful)
    fails = unknown & (h <= resolution)
    kept &= ~unknown
    is_ahead, is_last = t1 < before.rejected_end, t1 > almost(duration)
    event, x = first_event(events, _shortest(t1, duration), resolution, start, end, h, is_ahead, is_last)
    crossed = kept & (x <= 1)
    # Signs, since a product of two small determinants underflows in float32.
    over = kept & (jnp.sign(start.bound) * jnp.sign(end.bound) < 0)
    at_bound = (over & (h <= duration / 1000)) | (kept & ~over & (t1 >= before.over_bound))
    at_start = crossed & is_at_start(x) & ~over & ~at_bound
    is_near = (1 - x) * h <= resolution
    if end.noise is not None:
        sizes = zip(end.values, end.noise, strict=True)
        for i, (value, noise) in enumerate(sizes):
            is_near |= (event == i) & (jnp.abs(value) <= noise)
        end = end._replace(noise=None)
    at_end = crossed & is_near & ~over & ~at_start & ~at_bound
    repeat = ((crossed | over) & ~at_end & ~at_start & ~at_bound) | (unknown & ~fails)
    beyond = jnp.where(over | unknown, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * resolution)
    rejected = repeat | at_start | at_bound | fails
    status = jnp.where(at_bound, float(Status.SINGULAR_SPEEDS), before.status)
    status = jnp.where(fails, float(Status.STEP_TOO_SMALL), status)
    status = jnp.where(fails & ~is_lawful, float(Status.INVALID_COEFFICIENT), status)
    happens, jumps = at_end | at_start, jnp.zeros_like(kept)
    for i, stages in enumerate(events.stages):
        jumps |= happens & (event == i) & (len(stages) > 0)
    repeats = jumps & at_start & (event == before.last_jump)
    status = jnp.where(repeats, float(Status.REPEATED_JUMP), status)
    end = end.with_sides(events, start, jumps, resolution)
    is_first = repeat & (t1 > before.rejected_end)
    untouched = jumps & (t1 > before.rejected_end)
    state = ControllerState(
        status=jnp.where(happens & ~jumps, float(Status.EVENT) + event, status),
        rejected_end=jnp.where(repeat & ~over, jnp.maximum(before.rejected_end, t1), before.rejected_end),
        over_bound=jnp.where(over, jnp.minimum(before.over_bound, t1), before.over_bound),
        reach=4 * resolution + 1e-12 * t1,
        length=jnp.where(is_first | untouched, h, before.length),
        jump=jnp.where(jumps & ~repeats, event, -1.0),
        last_jump=jnp.where(kept & ~rejected, -1.0, before.last_jump),
        begin=jnp.where(kept & ~rejected, t0, before.begin),
        start=jax.tree.map(lambda new, old: jnp.where(kept & ~rejected, new, old), end, start),
    )
    next_t0, next_t1 = jnp.where(rejected, begin, step.t0), jnp.where(repeat, t0 + beyond, step.t1)
    return step._replace(keep=step.keep & ~rejected, t0=next_t0, t1=next_t1), state
