"""The motion of a system as one program: whether it can begin, its steps, its end, and what follows from it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._kane.checks import bodies_are_possible
from .._kane.constraints import configuration_is_met, correction, has_configuration_constraints, projected
from .._kane.kanes_method import KaneEquations
from .._kane.rhs import outputs_at, rates_are_native, values_of, vector_field
from .._scalarjit.cache_key import captured_tracers, captures_any, jit
from .._scalarjit.components import as_vector
from .._scalarjit.function import Packed, ScalarFunction, tree_of
from .._scalarjit.jaxpr import LARGEST_SUM
from .._scalarjit.nan import (
    all_finite,
    constant,
    derivative_free_where_not_finite,
    nan_derivative_where,
    nan_where,
    negligible,
    parts_of,
)
from .._system.parameters import ANY, ParameterInfo, parameters_in
from .._system.system import State, System, names_of, packed, units_of, unpacked
from .events import EventPoint, Events, EventValues, event_values, events_of, next_point
from .inputs import (
    Discontinuities,
    InputState,
    RateArguments,
    Samples,
    discontinuities_of,
    for_fixed_steps,
    inputs_are_valid,
    inputs_at,
    mask_invalid_inputs,
    restore_times,
    samples_of,
)
from .settings import Settings, with_scan_kind, with_tolerances
from .status import Status
from .step_control import ClipToDiscontinuities, ControlSettings, StepSizeController, Times, evenly_spread, times_of
from .steps import UnrolledERK, is_explicit, take_steps
from .trajectory import InputDiscontinuities, Trajectory


def _is_small(x: Any) -> bool:
    return eqx.is_inexact_array(x) and 0 < x.size <= LARGEST_SUM


def _is_rising(ts: Array) -> Array:
    # A window of a fit may stand still at its last time.
    return jnp.all(ts[1:] >= ts[:-1]) & (ts[-1] > ts[0]) & jnp.isfinite(ts[0]) & jnp.isfinite(ts[-1])


def is_valid(system: System, y: Array, t: Array, signals: Any) -> Array:
    """Whether a motion can begin at `t`, with a packed state."""
    others = _large_are_valid(system, y) & inputs_are_valid(signals)
    return _small_are_valid(*constant((system, y, t)), others)


def _large_are_valid(system: System, y: Array) -> Array:
    allowed = [jnp.all(info.allows(x)) for x, info in _limited(system) if not _is_small(x)]
    return functools.reduce(jnp.logical_and, allowed, all_finite(eqx.filter((system, y), _is_small, inverse=True)))


@ScalarFunction.once
def _small_are_valid(system: System, y: Array, t: Array, others_are_valid: Array) -> Array:
    conditions = [others_are_valid, configuration_is_met(system, t, unpacked(system, y).q)]
    conditions += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, y)) if _is_small(x)]
    conditions += [jnp.all(info.allows(x)) for x, info in _limited(system) if _is_small(x)]
    return functools.reduce(jnp.logical_and, conditions)


def _limited(system: System) -> list[tuple[Array, ParameterInfo]]:
    """Values of the parameters that cannot be any number, and what they can be."""
    return [(value, info) for _, value, info in parameters_in(system) if info.is_limited]


class Beginning(NamedTuple):
    """The `times` of a motion; whether it can begin; its packed state at the `start`, ones where it cannot; and its
    `system`, with ones for parameters that are not finite, or that no description can have: behind a mask these would
    still spoil the reverse gradient of what is shared. What all members of a batch share remains shared there, of which
    a kernel computes its part once.
    """

    times: Times
    valid: Array
    start: Array
    system: System


def beginning(system: System, y: Array, ts: Array, others_are_valid: Array) -> Beginning:
    """From a packed state, at the first of the times (n_t,) at which a motion is kept. Small arrays all in one program,
    large ones each by itself."""
    others = _large_are_valid(system, y) & others_are_valid
    small = _beginning(system, y, ts[0], ts[1], ts[-1], others)
    large = _harmless(system, y, small.valid, lambda x: eqx.is_inexact_array(x) and not _is_small(x))
    rest = eqx.filter((y, system), eqx.is_inexact_array, inverse=True)
    return Beginning(small.times, small.valid, *eqx.combine((small.start, small.system), large, rest))


@ScalarFunction.once
def _beginning(system: System, y: Array, first: Array, second: Array, last: Array, others: Array) -> Beginning:
    valid = _small_are_valid.__wrapped__(system, y, first, others)
    start, harmless = _harmless(system, y, valid, _is_small)
    # To JAX the state moves with the parameters, so that the derivative of the first rates is the program of the loop.
    numbers = [jnp.sum(x) for x in jax.tree.leaves(harmless) if x.dtype == y.dtype]
    start = jax.tree.map(lambda x: jnp.where(valid, x, x + 0.0 * sum(numbers)), start)
    return Beginning(times_of(first, second, last), valid, start, harmless)


def _harmless(system: System, y: Array, valid: Array, is_chosen: Callable[[Any], bool]) -> tuple[Any, Any]:
    """The state and the system of a `Beginning`: those of their arrays that are chosen, None for the others."""
    limits = {id(x): info for x, info in _limited(system)}

    def where(condition: Array, x: Array) -> Array | None:
        return jnp.where(condition, x, jnp.ones_like(x)) if is_chosen(x) else None

    return where(valid, y), jax.tree.map(lambda x: where(limits.get(id(x), ANY).allows(x), x), system)


class InitialValueProblem(NamedTuple):
    """`system`, `signals`: harmless ones where no motion can begin; `start`: the packed state; `rates`: (t, y, args) ->
    y_dot, whether these `are_native`, and the `args` that the steps pass to them."""

    system: System
    signals: Any
    start: Array
    ts: Array
    times: Times
    discontinuities: Discontinuities | None
    valid: Array
    rates: Callable[..., Any]
    are_native: bool
    args: RateArguments
    events: Events
    settings: Settings


class Ending(NamedTuple):
    """The `status`, as a float; the last time and packed state; whether these move `smooth`ly with what they come from;
    whether the motion ended `by_event`; and its last time, state and rates, `near` which the event is: those of the
    start, with rates of zero, where there was none; no rates (None) where the steps leave none."""

    status: Array
    t_end: Array
    end: Array
    smooth: Array
    by_event: Array
    near: tuple[Array, Array, Array | None]


class Solution(NamedTuple):
    """Packed states `motion` (n_t, n), and which of them were `reached` (n_t,); the `ending`; numbers of steps."""

    motion: Array
    reached: Array
    ending: Ending
    stats: dict[str, Array]


@jit
def solve(
    system: System,
    state: State,
    ts: Array,
    signals: Any,
    settings: Settings,
    disturbance: Any = None,
    closures: Any = (),
) -> Trajectory:
    """`simulate` without its checks: one compiled program.

    `closures`: what functions among the signals read by closures, so that derivatives by it are NaN where they are not.

    `disturbance`: of t, inputs and state, gives the inputs as disturbed, and a `State` of what is added to its rates.
    """
    signals = restore_times(signals)
    if settings.step is not None:
        signals = for_fixed_steps(signals, settings.solver)
    origin = parts_of((system, state, ts, signals, disturbance, closures))
    rises = None if settings.rising else _is_rising(ts)
    ts = ts if rises is None else jnp.where(rises, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    others_are_valid = inputs_are_valid(signals) & (True if rises is None else rises)
    if settings.check_bodies:
        others_are_valid &= bodies_are_possible(system, ts[0], state.q)
    # What is not finite must not enter the solver, where it would spoil the gradient of what is shared.
    times, valid, start, system = beginning(system, packed(state), ts, others_are_valid)
    # In reverse mode the cotangent of each number would be a sum of its own, in each of the loops. In forward mode they
    # stay apart, since in a batch some of them may be shared.
    stepped = system if settings.is_forward else Packed.of(system, start.dtype)
    signals, state = mask_invalid_inputs(signals, valid), unpacked(system, start)
    constrained = has_configuration_constraints(system, times.start, state.q)
    problem = InitialValueProblem(
        system=system,
        signals=signals,
        start=start,
        ts=ts,
        times=times,
        discontinuities=discontinuities_of(
            system, signals, _reads_samples(system), times.start, state, settings.step is not None, settings.rtol
        ),
        valid=valid,
        rates=_rates(settings.stabilize if constrained else 0.0, settings.is_forward),
        are_native=rates_are_native(stepped, times.start, start, inputs_at(system, signals, times.start, state)),
        args=RateArguments(stepped, signals, disturbance),
        events=events_of(system, times.start, state),
        settings=settings,
    )
    solution = _integrated(problem)
    if problem.events.names:
        solution = _to_event(problem, solution)
    return _trajectory(problem, _filled(problem, solution, constrained and settings.project), origin)


def one_step(
    system: System, y: Array, t0: Array, t1: Array, signals: Any, settings: Settings, disturbance: Any = None
) -> Array:
    """The packed state after one step of the solver from `t0` to `t1`: the motion of `solve` without its checks, events
    and outputs. NaN where an implicit solver finds no solution. `signals` for steps of one length."""
    args = RateArguments(system, signals, disturbance)
    constrained = has_configuration_constraints(system, t0, unpacked(system, y).q)
    rates = _rates(settings.stabilize if constrained else 0.0)
    inputs = inputs_at(system, signals, t0, unpacked(system, y))
    solver = with_scan_kind(_solver_for(settings, rates_are_native(system, t0, y, inputs)), "lax")
    term = diffrax.ODETerm(rates)
    state = solver.init(term, t0, t1, y, args)
    y1, _, _, _, result = solver.step(term, t0, t1, y, args, state, False)
    return jnp.where(result == diffrax.RESULTS.successful, y1, jnp.nan)


def _solver_for(settings: Settings, rates_are_native: bool) -> Any:
    solver: Any = settings.solver
    if is_explicit(solver):
        return UnrolledERK(solver) if rates_are_native else solver
    return with_tolerances(solver, settings.rtol, settings.atol)


def ends_between(system: System, t0: Array, y0: Array, t1: Array, y1: Array, signals: Any) -> Array:
    """The status by what ends a motion between two packed states, one step apart: an event, or singular speeds."""
    t0, y0, t1, y1 = jax.lax.stop_gradient((t0, y0, t1, y1))
    status, events = jnp.int32(Status.COMPLETED), events_of(system, t0, unpacked(system, y0))
    if not events.names and not system.dependent_speeds:
        return status

    def at(t: Array, y: Array) -> EventValues:
        rates = vector_field(system, t, y, inputs_at(system, signals, t, unpacked(system, y)))
        return event_values(system, t, y, rates if events.read_speeds else None)

    before, after = at(t0, y0), at(t1, y1)
    for i, direction in enumerate(events.directions):
        a, b = before.values[i], after.values[i]
        passes = jnp.where(direction * (b - a) >= 0, a * b < 0, False)
        status = jnp.where(passes & (status == Status.COMPLETED), jnp.int32(Status.EVENT + i), status)
    return jnp.where(before.bound * after.bound > 0, status, jnp.int32(Status.SINGULAR_SPEEDS))


def _reads_samples(system: System) -> dict[str, Callable[..., Any]]:
    """The right-hand side (t, state) of a system that has samples among its parameters, or whose code reads some from
    outside, by the system's name."""

    def rates(t: Array, state: InputState) -> Array:
        return vector_field(system, t, packed(State(state.q, state.u, state.x)), {})

    return {type(system).__name__: rates} if samples_of(system) or captures_any(Samples, system) else {}


def refuse_captured(system: System) -> None:
    """**Raises:** `TypeError` where a description reads a number of a trace that is under way from outside: the rules
    by which events, constraints and steps are differentiated know what they are given alone."""
    if captured_tracers(system):
        raise TypeError(
            f"{type(system).__name__}: its description reads, by a closure or a global, a number that is being traced "
            "(by jax.grad, jax.jvp, jax.jit or jax.vmap). Make it a parameter of the system, or an input."
        )


def _rates(stabilize: float, forward: bool = False) -> Callable[..., Any]:
    """(t, y, args) -> y_dot. `stabilize` [1/s]: how fast constraints are led back; `forward`: see `vector_field`."""

    def rates(t: Array, y: Array, args: RateArguments) -> Array:
        packed_system, signals, disturbance = args
        system = tree_of(packed_system)
        state = unpacked(system, y)
        inputs, extra = inputs_at(system, signals, t, state), None
        if disturbance is not None:
            inputs, extra = disturbance(t, inputs, state)
        y_dot = vector_field(packed_system, t, y, inputs, forward)
        if extra is not None:
            y_dot += packed(extra)
        if stabilize:
            back = stabilize * correction(system, t, state.q)
            y_dot += jnp.concatenate([back, jnp.zeros_like(y_dot[back.size :])])
        return y_dot

    return rates


def _integrated(problem: InitialValueProblem) -> Solution:
    """The motion at the times that its steps reach."""
    settings, times = problem.settings, problem.times

    def trial_rates(t: Any, y: Any, args: Any) -> Any:
        # A step that is rejected since its rates are not finite must not spoil a derivative in reverse mode.
        return derivative_free_where_not_finite(problem.rates, t, y, args)

    steps = take_steps(
        problem.rates if settings.is_forward else trial_rates,
        _solver_for(settings, problem.are_native),
        _controller_of(problem),
        problem.valid,
        problem.start,
        problem.args,
        problem.ts,
        settings.adjoint,
        diffrax.TqdmProgressMeter() if settings.progress else diffrax.NoProgressMeter(),
    )
    progress = steps.progress
    numbers = (progress.steps, progress.accepted, progress.steps - progress.accepted)
    return Solution(
        motion=steps.motion,
        reached=(jnp.arange(len(problem.ts)) < steps.count) & problem.valid,
        ending=_ending(
            times, progress.status, problem.valid, steps.t_end, steps.end, constant(steps.rates), problem.start
        ),
        stats={name: x.astype(int) for name, x in zip(("steps", "accepted", "rejected"), numbers, strict=True)},
    )


def _controller_of(problem: InitialValueProblem) -> StepSizeController:
    """What ends the steps: the last time, events, and dependent speeds that are about to be singular."""
    system, settings, times, events = problem.system, problem.settings, problem.times, problem.events

    def quantities(t: Array, y: Array, args: RateArguments) -> EventValues:
        return event_values(args.system, t, y, problem.rates(t, y, args) if events.read_speeds else None)

    as_number = lambda x: jnp.asarray(x, times.end.dtype)  # noqa: E731
    fixed, kinks = settings.step is not None, problem.discontinuities
    control = ControlSettings(
        rtol=None if fixed else as_number(settings.rtol),
        atol=None if fixed else as_number(settings.atol),
        step=evenly_spread(times, as_number(settings.step)) if fixed else None,
        times=times,
        order=None if fixed else settings.solver.error_order(diffrax.ODETerm(problem.rates)),
        max_steps=settings.max_steps,
        directions=events.directions,
    )
    may_end = quantities if events.names or system.dependent_speeds else None
    return StepSizeController(
        control, may_end, None if kinks is None or fixed else ClipToDiscontinuities.of(kinks, times)
    )


# One function of scalars each: XLA would compute it anew in every program that reads any of it.


@ScalarFunction.once
def _ending(
    times: Times, status: Array, valid: Array, t_last: Array, last: Array, rates: Array | None, start: Array
) -> Ending:
    status = jnp.where(valid, status, float(Status.INVALID))
    completed, by_event = status == Status.COMPLETED, status >= Status.EVENT
    t_end, end = jnp.where(completed, times.end, jnp.where(valid, t_last, times.start)), jnp.where(valid, last, start)
    rates = None if rates is None else jnp.where(by_event, rates, jnp.zeros_like(rates))
    near = jnp.where(by_event, t_end, times.start), jnp.where(by_event, end, start), rates
    return Ending(status, t_end, end, completed, by_event, near)


@ScalarFunction.once
def _by_event(point: EventPoint, ending: Ending) -> Ending:
    t, y = (jnp.where(ending.by_event, new, old) for new, old in ((point.t, ending.t_end), (point.y, ending.end)))
    return ending._replace(t_end=t, end=y, smooth=ending.smooth | (ending.by_event & point.smooth))


def _located(problem: InitialValueProblem, ending: Ending) -> EventPoint:
    """Where the event is that ended the motion, with derivatives up to the second order; the start if none did.

    The last step ends so near to it that the first step of Newton's method is exact. The second step has the
    derivatives by the implicit function theorem, for which the rates are those halfway. Their own first derivative is
    negligible unless the motion is very much longer than what is fastest in it. XLA alone would compile it for seconds,
    and leaves it out.
    """
    system, events = problem.args.system, problem.events
    t, y, y_dot = ending.near
    t = constant(t)
    if y_dot is None:
        y_dot = problem.rates(*constant((t, y, problem.args)))

    def stepped(point: EventPoint) -> EventPoint:
        which = (ending.status - Status.EVENT, ending.by_event)
        read_rates = y_dot if events.read_speeds else None
        return next_point(system, point, y_dot, read_rates, problem.times.event_reach, *which)

    def bend(step: Array, y: Array, args: Any) -> Array:
        return step * (problem.rates(t + 0.5 * step, y + 0.5 * step * y_dot, args) - y_dot)

    near = stepped(EventPoint(t, y, jnp.zeros_like(t), jnp.array(True)))
    if problem.are_native:
        return stepped(near._replace(y=near.y + bend(near.step, y, problem.args)))
    bent = negligible(bend, near.step, y, problem.args, transposes=not problem.settings.is_forward)
    return stepped(near._replace(y=near.y + bent))


def _to_event(problem: InitialValueProblem, solution: Solution) -> Solution:
    """The same, whose end is the instant of the event, where one happened."""
    times, ending = problem.times, solution.ending
    end = _by_event(_located(problem, ending), ending)
    # The last step ends a little beside the event: samples from there to here are those of the event itself.
    before = problem.ts <= end.t_end + times.rounding
    late = ending.by_event & ~solution.reached & before
    return solution._replace(
        motion=jnp.where(late[:, None], end.end[None], solution.motion),
        reached=jnp.where(ending.by_event, before, solution.reached),
        ending=end,
    )


def _filled(problem: InitialValueProblem, solution: Solution, project: bool) -> Solution:
    """The same with the first state at the times that were not reached, since a value that is not finite has
    derivatives that a mask behind it cannot take away. `project`: onto the configuration constraints."""
    motion = jnp.where(solution.reached[:, None], solution.motion, problem.start[None])
    ending = solution.ending
    if project:
        n_q = len(problem.system.coordinates)

        def onto(t: Array, y: Array) -> Array:
            return jnp.concatenate([projected(problem.system, t, y[:n_q]), y[n_q:]])

        motion = jax.vmap(onto)(problem.ts, motion)
        ending = ending._replace(end=onto(ending.t_end, ending.end))
    return solution._replace(motion=motion, ending=ending)


def _trajectory(problem: InitialValueProblem, solution: Solution, origin: list[Array]) -> Trajectory:
    """What follows from the motion, and NaN where there is none. `origin`: what all of it comes from."""
    system, ts, kinks = problem.system, problem.ts, problem.discontinuities
    states = unpacked(system, solution.motion)
    u_dep = jax.vmap(lambda t, y: _dependent_speeds_of(system, t, y))(ts, solution.motion)
    all_inputs = jax.vmap(lambda t, y: inputs_at(system, problem.signals, t, y, all_of_them=True))
    inputs, discontinuities = all_inputs(ts, states), None
    if kinks is not None:
        beside = (-problem.times.rounding, problem.times.rounding) if kinks.jumps else ()
        discontinuities = InputDiscontinuities(kinks.times, tuple(all_inputs(ts + x, states) for x in beside))
    outputs = jax.vmap(lambda t, y, w: outputs_at(system, t, y.q, y.u, values_of(system, y.x, w)))(ts, states, inputs)
    values = nan_where(~solution.reached, (solution.motion, u_dep, inputs, outputs), origin)
    motion, u_dep, inputs, outputs = values
    ending = solution.ending
    t_end, end = nan_derivative_where(~ending.smooth, (ending.t_end, ending.end), origin)
    states, end = unpacked(system, motion), unpacked(system, nan_where(~problem.valid, end, origin))
    return Trajectory(
        t=ts,
        q=states.q,
        u=states.u,
        u_dep=u_dep,
        x=states.u[:, :0] if states.x is None else states.x,
        inputs=inputs,
        outputs=outputs,
        status=ending.status.astype(jnp.int32),
        t_end=t_end,
        stats=solution.stats,
        names=names_of(system),
        events=problem.events.names,
        adjoint=type(problem.settings.adjoint).__name__,
        units=tuple(units_of(system).items()),
        end=end,
        discontinuities=discontinuities,
    )


@ScalarFunction
def _dependent_speeds_of(system: System, t: Array, y: Array) -> Array:
    state = unpacked(system, y)
    return as_vector(KaneEquations(system, t, state.q, state.u).u_dep, y)
