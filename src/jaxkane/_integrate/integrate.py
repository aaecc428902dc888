"""The simulation of a system as one program: initial check, steps, termination and trajectory."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._kane.api import _kinetic_energy
from .._kane.checks import bodies_are_possible
from .._kane.constraint_residuals import configuration_is_met, correction, has_configuration_constraints, projected
from .._kane.contact.forces import ContactMemory, layout_of
from .._kane.contact.laws import OPEN, SLIDES, STICKS
from .._kane.contact.states_after_jump import (
    REST,
    Change,
    ContactEvent,
    changed_contacts,
    contact_event_values,
    gaps_at_start,
    without_penetration,
)
from .._kane.kanes_method import KaneEquations
from .._kane.right_hand_side import outputs_at, outputs_in_contact, rates_are_native, values_of, vector_field
from .._scalarjit.cache_key import captured_tracers, captures_any, jit
from .._scalarjit.components import Component, Numbers, as_vector
from .._scalarjit.jaxpr import LARGEST_SUM
from .._scalarjit.nan import (
    all_finite,
    constant,
    derivative_free_where_not_finite,
    nan_beyond_second_derivative,
    nan_derivative_where,
    nan_where,
    parts_of,
)
from .._scalarjit.scalar_function import Packed, ScalarFunction, tree_of
from .._system.parameters import ANY, ParameterInfo, parameters_in
from .._system.system import State, System, names_of, packed, units_of, unpacked
from .discontinuities import Discontinuities, all_end_steps, discontinuities_of, rounding
from .events import EventPoint, Events, EventValues, Status, event_values, events_of, moved_to_event, next_point
from .inputs import (
    InputState,
    RateArguments,
    Samples,
    SharedTimes,
    Signals,
    for_fixed_steps,
    inputs_are_valid,
    inputs_at,
    is_samples,
    mask_invalid_inputs,
    restore_times,
    samples_of,
)
from .jumps import JumpTable, StagesOf, after_jump, without_derivative_at
from .loop import Jump, Steps, diffrax_loop, fast_loop, is_supported
from .settings import (
    Settings,
    UnrolledERK,
    is_explicit,
    last_stage_is_spare,
    with_scan_kind,
    with_stepwise_inputs,
    with_tolerances,
)
from .step_control import FEWEST_STEPS, SHARE, StepSizeController, evenly_spread, first_step
from .tangents import Probing, Replay, direction_of, generic, with_own_tangents
from .trajectory import InputDiscontinuities, Trajectory


@jit
def solve(
    system: System,
    state: State,
    origin: Array,
    taus: Array,
    signals: Signals | SharedTimes,
    settings: Settings,
    discontinuities: Array | None = None,
    closures: PyTree = (),
) -> Trajectory:
    """`simulate` without its checks: one compiled program.

    **Arguments:**

    - `system`; `state`: the system, and its state at the start.
    - `origin`: the start of the simulation [s], on the clock of the system.
    - `taus` (n_t,): times since the start [s] at which the state is saved; the first one is zero.
    - `signals`: inputs, whose samples have times since the start; see `as_signals` and `since`.
    - `settings`: the options of `simulate`.
    - `discontinuities` (n,): more times since the start at which steps end [s].
    - `closures`: values in closures of input functions. Derivatives with respect to them are NaN where the result is
        NaN.

    **Returns:** a `Trajectory` with the times `origin + taus`.
    """
    if settings.adjoint is not None:
        return _solved(system, state, origin, taus, signals, discontinuities, closures, settings)
    if closures:
        signals = _with_captured_numbers(system, state, origin, signals)

    def run(arguments: tuple[Any, ...], moved: PyTree, reverse: bool) -> Trajectory:
        given, (settings, closures) = arguments
        adjoint = diffrax.RecursiveCheckpointAdjoint() if reverse else diffrax.ForwardMode()
        settings = dataclasses.replace(settings, adjoint=adjoint, progress=settings.progress and moved is None)
        return _solved(*given, closures=closures, settings=settings, moved=moved)

    arguments = system, state, origin, taus, signals, discontinuities
    # The errors of tangents are not controlled with fixed steps, nor in the loop of diffrax.
    by_error = settings.controller is None and settings.solver.term_structure is diffrax.AbstractTerm
    how = "fixed steps" if settings.step is not None else "controlled" if by_error else "steps of the motion"
    both = arguments, (settings, closures)
    ride = with_own_tangents(run, *both) if settings.differentiable else run(both, None, False)
    return dataclasses.replace(ride, adjoint=how)


def _with_captured_numbers(system: System, state: State, t: Array, signals: Signals | SharedTimes) -> Any:
    """The signals. Traced numbers in the closure of an input function become numbers of its signal."""
    if isinstance(signals, SharedTimes):
        return dataclasses.replace(signals, signals=_with_captured_numbers(system, state, t, signals.signals))
    context = _with_arrays(InputState(state.q, state.u, state.x, t, system))

    def converted(f: Component | Callable[..., Any]) -> Any:
        if not callable(f) or is_samples(f):
            return f
        return _Converted(eqx.filter_closure_convert(f, t, context))

    return converted(signals) if callable(signals) else {name: converted(f) for name, f in signals.items()}


class _Converted(eqx.Module):
    # An input function whose captured numbers are leaves. Its arguments must have the types of its tracing.
    f: Any

    def __call__(self, t: Array, state: InputState) -> Any:
        return self.f(t, _with_arrays(state))


def _with_arrays(state: InputState) -> InputState:
    # The state, with arrays instead of Python floats in its system. A system that is not traced may contain both.
    as_array = lambda x: jnp.asarray(x, state.q.dtype) if isinstance(x, float) else x  # noqa: E731
    return dataclasses.replace(state, system=jax.tree.map(as_array, state.system))


def _solved(
    system: System,
    state: State,
    origin: Array,
    taus: Array,
    shared_signals: Signals | SharedTimes,
    discontinuities: Array | None,
    closures: PyTree,
    settings: Settings,
    moved: PyTree = None,
) -> Trajectory:
    """`solve` with an adjoint of diffrax. `moved`: the arguments with True for each number that is differentiated, if
    the errors of tangents are controlled."""
    # Here, not before: as arguments of an operation, shared times would no longer be the same array.
    signals, fixed = restore_times(shared_signals), settings.step is not None
    signals = for_fixed_steps(signals) if fixed else signals
    follows_from = parts_of((system, state, origin, taus, signals, discontinuities, closures))
    others_are_valid = inputs_are_valid(signals)
    if not settings.rising:
        # The last times of a window of a fit may be equal, because windows are padded with the last time.
        rises = jnp.all(taus[1:] >= taus[:-1]) & (taus[-1] > 0) & jnp.isfinite(origin) & jnp.isfinite(taus[-1])
        taus = jnp.where(rises, taus, jnp.arange(taus.shape[0], dtype=taus.dtype))
        others_are_valid &= rises
    if settings.check_bodies:
        others_are_valid &= bodies_are_possible(system, origin, state.q)
    # Values that are not finite must not reach the solver: the gradients of parameters that members share would be NaN.
    touches = None
    if (layout := layout_of(system)).names and state.contacts is None:
        memory = jnp.zeros(layout.memory_size, state.q.dtype)
        state = without_penetration(system, origin, State(state.q, state.u, state.x, memory))
        touches, is_apart = gaps_at_start(system, origin, state)
        others_are_valid &= is_apart
    if layout.names and jnp.ndim(settings.atol):
        # Contact states have no error.
        padded = jnp.concatenate([settings.atol, jnp.ones(layout.memory_size, settings.atol.dtype)])
        settings = dataclasses.replace(settings, atol=padded)
    valid, start, system = initial_check(system, packed(state), origin, others_are_valid)
    if fixed and discontinuities is not None:
        # Fixed steps do not end there. JAX would compute a derivative of 0 for these times, which is wrong.
        start = nan_derivative_where(jnp.array(True), start, discontinuities)
    signals, state = mask_invalid_inputs(signals, valid), unpacked(system, start)
    readers = _reads_samples(system)
    found = discontinuities_of(system, signals, readers, origin, state, fixed, settings.rtol, discontinuities)
    # In reverse mode, packing replaces a separate sum for the cotangent of each parameter in each loop by one sum. In
    # forward mode parameters are not packed, because members of a batch may share some of them.
    stepped = system if settings.is_forward else Packed.of(system, start.dtype)
    spare = fixed and last_stage_is_spare(settings.solver)
    only_samples = isinstance(signals, dict) and all(map(is_samples, signals.values()))
    has_pieces = found is not None and not (only_samples and discontinuities is None and not readers)
    if found is not None:
        # No step begins at the end of the simulation.
        ends = jnp.where(found.times < taus[-1] - rounding(taus[-1], taus[-1]), found.times, jnp.inf)
        found = found._replace(times=ends)
    problem = Problem(
        system=system,
        start=start,
        taus=taus,
        valid=valid,
        args=RateArguments(
            stepped,
            signals,
            origin,
            has_pieces=has_pieces,
            one_piece=not fixed and all_end_steps(signals),
            share=SHARE if fixed else 0.0,
            past_end=spare,
        ),
        discontinuities=found,
        events=events_of(system, origin, state),
        settings=settings,
    )
    if moved is not None and not fixed:
        args_dot = direction_of(problem.args, moved[0], any(jax.tree.leaves(moved[4])))
        # A parameter of a jump moves nothing before the jump.
        start_moves = problem.events.continue_ or any(jax.tree.leaves((*moved[1:4], moved[5])))
        problem = problem._replace(args_dot=args_dot, start_moves=start_moves)
    determined = None
    if touches is not None:
        problem, determined = problem.with_found_contacts(touches)
    steps = problem.steps()
    nothing = steps.accepted < 1
    end: End = _end(problem.valid, taus[-1], problem.start, steps.t, steps.y, steps.state.status, nothing)
    if determined is not None:
        end = end._replace(status=jnp.where(determined, end.status, float(Status.UNDETERMINED_CONTACT)))
    if problem.events.names:
        slack = 1.0 if steps.replay is None else SLACK
        end = problem.located(end, steps.rates, slack * steps.state.reach)
    return _trajectory(problem, steps, end, follows_from)


SLACK = 1e4
"""Recorded steps end this many times farther from an event: each bounce multiplies rounding errors by ten."""


class End(NamedTuple):
    """Where a simulation ends.

    Fields: the `status`, as a float; the time `t` since the start [s] and the packed state `y`; whether both are
    `smooth` functions of the arguments; and whether an event ended the simulation (`by_event`).
    """

    status: Array
    t: Array
    y: Array
    smooth: Array
    by_event: Array


class Problem(NamedTuple):
    """An initial value problem and the options of its solution.

    Fields:

    - `system`: the system, with ones for parameters that are not valid. `start`: the packed state at the start.
    - `taus` (n_t,): the requested times since the start [s]. `valid`: whether the simulation may begin.
    - `args`: the arguments of the right-hand side. `discontinuities`: where steps end, or None.
    - `events`: the event functions. `settings`: the options of `simulate`.
    - `args_dot`: the tangent of `args` if the errors of tangents are controlled, else None.
    - `start_moves`: whether the controlled tangent is nonzero at the start.
    """

    system: System
    start: Array
    taus: Array
    valid: Array
    args: RateArguments
    discontinuities: Discontinuities | None
    events: Events
    settings: Settings
    args_dot: Any = None
    start_moves: bool = False

    @property
    def constrained(self) -> bool:
        state = unpacked(self.system, self.start)
        return has_configuration_constraints(self.system, self.args.origin, state.q)

    def rates(self, forward: bool | None = None) -> Callable[..., Array]:
        settings = self.settings
        forward = settings.is_forward if forward is None else forward
        return _rates(settings.stabilize if self.constrained else 0.0, forward)

    def steps(self) -> Steps:
        """The states at the requested times, and where the steps end."""
        settings, rates = self.settings, self.rates()
        controller = self.controller(rates)

        # If a step is rejected because its rates are not finite, the reverse-mode derivative must not become NaN.
        trial_rates = functools.partial(derivative_free_where_not_finite, rates)
        solver = _solver_for(settings, self.args.system, self.args.origin, self.start, self.args.signals)
        how = rates if settings.is_forward else trial_rates, solver, controller, self.start, self.args, self.taus
        adjoint: Any = settings.adjoint  # not None: `solve` replaces None before it comes here
        limits = adjoint, settings.max_steps, self.valid
        if is_supported(solver, controller, adjoint, settings.progress):
            # Everything is constant, also what the jumps read, so that the loop for the steps is not differentiated.
            replay = None if self.args_dot is None else constant(self).steps_of_tangent(solver, constant(controller))
            jump = functools.partial(self.jump, slack=1.0 if replay is None else SLACK)
            jumps = (jump, settings.max_jumps) if self.events.continue_ else None
            return fast_loop(*how, *limits, jumps, replay=replay)
        if self.events.continue_:
            raise ValueError(
                f"{type(self.system).__name__} has contacts, or an event that changes the state (`then`). This needs "
                "the solver loop of jaxkane. Omit `controller` and `progress`, use adjoint='reverse', 'forward' or "
                "'both', and a solver that is not implicit-explicit."
            )
        return diffrax_loop(*how, *limits, settings.progress)

    def steps_of_tangent(self, solver: diffrax.AbstractSolver, controller: StepSizeController) -> Replay:
        """The steps that motion and a tangent need. `self` and `controller` must be constant (see `constant`)."""
        # The states of contacts have no tangent. A tangent that moves at the start would hide a smaller one of a
        # parameter, 1e-9 m/N for a heavy body for example.
        n = self.start.size - self.events.layout.memory_size if self.start_moves else 0
        noise = 10 * jnp.finfo(self.start.dtype).eps / controller.rtol
        probing = Probing(self.rates(True), generic(self.start, n), self.args_dot, noise)
        jumps = (self.jump, self.settings.max_jumps) if self.events.continue_ else None
        how = probing.rates, solver, controller, self.start, self.args, self.taus[-1:], diffrax.ForwardMode()
        replay = fast_loop(*how, self.settings.max_steps, self.valid, jumps, probing).replay
        assert replay is not None
        return replay

    def controller(self, rates: Callable[..., Any]) -> StepSizeController:
        system, settings, events = self.system, self.settings, self.events

        def quantities(t: Array, y: Array, args: RateArguments) -> EventValues:
            return self.event_values(t, y, args, rates(t, y, args) if events.read_rates else None)

        as_number = functools.partial(jnp.asarray, dtype=self.taus.dtype)
        fixed, may_end, found = settings.step is not None, events.names or system.dependent_speeds, self.discontinuities
        if found is not None and ((fixed and not found.jumps) or self.args.past_end):
            found = found._replace(restart=False)  # no stage of a step is used on the other side of a jump
        return StepSizeController(
            rtol=as_number(settings.rtol),
            atol=as_number(settings.atol),
            step=evenly_spread(self.taus[-1], as_number(settings.step)) if fixed else None,
            first=first_step(self.taus),
            longest=self.taus[-1] / FEWEST_STEPS if settings.max_step is None else as_number(settings.max_step),
            duration=self.taus[-1],
            discontinuities=found,
            event_values=quantities if may_end else None,
            events=events,
            inner=settings.controller,
        )

    def located(self, end: End, y_dot: Float[Array, " n"] | None, reach: Array) -> End:
        """The same, at the time of the event if an event ended the simulation."""
        # Members without an event are evaluated at the start, where all rates are finite.
        t, y = jnp.where(end.by_event, constant(end.t), 0.0), jnp.where(end.by_event, end.y, self.start)
        point = self.event_point(t, y, y_dot, end.status - Status.EVENT, reach, end.by_event)
        t, y = (jnp.where(end.by_event, new, old) for new, old in ((point.t, end.t), (point.y, end.y)))
        return end._replace(t=t, y=y, smooth=end.smooth | (end.by_event & point.smooth))

    def event_point(
        self, t: Array, y: Array, y_dot: Float[Array, " n"] | None, event: Array, reach: Array, happened: Array
    ) -> EventPoint:
        """The time and the state at an event, from a time and a state near it.

        A step ends so near to the event that the first step of Newton's method is exact. The second step has the
        derivatives of the implicit function theorem. They are exact up to the second order, because the state is
        corrected with the rates halfway to the event.
        """
        rates, args = self.rates(), dataclasses.replace(self.args, within=None)
        if not self.settings.is_forward:
            # The rates at the start are not finite in a batch member that cannot begin, such as one without mass.
            rates = functools.partial(derivative_free_where_not_finite, rates)
        if y_dot is None:
            y_dot = rates(*constant((t, y, args)))
        y_dot = jnp.where(happened, y_dot, jnp.zeros_like(y_dot))

        def stepped(point: EventPoint) -> EventPoint:
            read = y_dot if self.events.read_rates else None
            if self.events.layout.names:
                quantities = self.event_values(point.t, point.y, args, y_dot, differentiable=True)
                return moved_to_event(quantities, point, y_dot, reach, event, happened, REST * self.taus[-1])
            return next_point(args.system, args.origin, point, y_dot, read, reach, event, happened)

        near = stepped(EventPoint(t, y, jnp.zeros_like(t), jnp.array(True)))
        bend = near.step * (rates(t + 0.5 * near.step, y + 0.5 * near.step * y_dot, args) - y_dot)
        return stepped(near._replace(y=near.y + bend))

    def event_values(
        self, t: Array, y: Array, args: RateArguments, y_dot: Array | None, differentiable: bool = False
    ) -> EventValues:
        """The values of the event functions of the system and of its contacts. `t`: time since the start [s].

        `differentiable`: whether the event functions of the contacts have derivatives. Their rates are constant in both
        cases: nothing uses derivatives of the rates, and a program for second derivatives of contact forces is long.
        """
        events, system = self.events, tree_of(args.system)
        own = event_values(args.system, args.clock(t), y, y_dot)
        if not events.layout.names:
            return own

        def of_contacts(args: RateArguments, t: Array, y: Array) -> tuple[Array, Array]:
            inputs = args.inputs(system, t, unpacked(system, y))
            return contact_event_values(args.system, args.clock(t), y, inputs)

        fixed, at, along = constant((args, (t, y), (jnp.ones_like(t), y_dot)))
        (values, noise), (rates, _) = jax.jvp(functools.partial(of_contacts, fixed), at, along)
        values = of_contacts(args, t, y)[0] if differentiable else values
        # The own events and the contacts, each in alphabetical order
        n, places = len(own.values), itertools.count()
        order = [next(places) if contact is None else n + 2 * contact[0] + contact[1] for contact in events.contacts]
        pairs = (own.values, values), (own.rates, rates), (jnp.zeros_like(own.values), noise)
        values, rates, noise = (jnp.stack([jnp.concatenate(pair)[i] for i in order]) for pair in pairs)
        return own._replace(values=values, rates=rates, noise=noise)

    def jump(self, t: Array, y: Array, event: Array, reach: Array, slack: float = 1.0) -> Jump:
        """The jump of an event, from a time and a packed state near it. `slack`: see `SLACK`."""
        point = self.event_point(t, y, None, event, slack * reach, jnp.array(True))
        after, impulses, none = point.y, y[:0], float(Status.COMPLETED)
        if any((which := StagesOf.of(self.events)).stages):
            after, impulses = after_jump(tree_of(self.args.system), self.args.clock(point.t), point.y, event, which)
        is_possible = jnp.all(jnp.isfinite(after))
        if self.constrained:
            q = unpacked(self.system, jnp.where(is_possible, after, point.y)).q
            is_possible &= configuration_is_met(self.system, self.args.clock(point.t), q)
        smooth = point.smooth
        if self.discontinuities is not None:
            # An event function that jumps across zero with an input vanishes nowhere: its time is that of the input.
            apart = jnp.abs(constant(point.t) - constant(self.discontinuities.times))
            smooth |= jnp.any(apart <= 2 * reach)
        jump = Jump(point.t, event, point.y, after, smooth.astype(y.dtype), impulses, jnp.zeros_like(event))
        if self.events.layout.names:
            jump = self.contact_jump(jump._replace(after=jnp.where(is_possible, after, point.y)), event, reach)
        status = jnp.where(is_possible, jump.status, float(Status.IMPOSSIBLE_JUMP))
        return jump._replace(status=constant(jnp.where(jump.status == none, status, jump.status)))

    def contact_jump(self, jump: Jump, event: Array, reach: Array) -> Jump:
        """The same with the impact and the new states of the contacts."""
        events, args, system = self.events, dataclasses.replace(self.args, within=None), self.system
        memory = unpacked(system, jump.after).contacts
        assert memory is not None
        states = ContactMemory.unpacked(events.layout, memory).states

        def belongs(side: int) -> Array:
            places = [events.contacts.index((i, side)) for i in range(len(events.layout.names))]
            return event == jnp.asarray(places, event.dtype)

        normal, tangential = belongs(0), belongs(1)
        what = ContactEvent(
            touches=normal & (states == OPEN),
            opens=normal & (states != OPEN),
            slips=tangential & (states == STICKS),
            stops=tangential & (states == SLIDES),
            is_own=jnp.any(normal | tangential),
            is_start=jnp.array(False),
        )
        change = self._changed_contacts(jump.t, jump.after, what, reach)
        # The rest of infinitely many bounces: time passes, and the tangential motion continues.
        after = change.y + change.delay * self.rates()(jump.t, change.y, args)
        is_finite = jnp.all(jnp.isfinite(after))
        status = jnp.where(change.is_determined & is_finite, jump.status, float(Status.UNDETERMINED_CONTACT))
        status = jnp.where(change.is_lawful, status, float(Status.INVALID_COEFFICIENT))
        return jump._replace(t=jump.t + change.delay, after=after, impulses=change.impulses.reshape(-1), status=status)

    def _changed_contacts(self, t: Array, y: Array, what: ContactEvent, reach: Array) -> Change:
        args, system, settings = dataclasses.replace(self.args, within=None), self.system, self.settings
        inputs = args.inputs(tree_of(args.system), t, unpacked(system, y))
        tolerances = jnp.asarray(settings.rtol, y.dtype), jnp.max(jnp.asarray(settings.atol, y.dtype))
        rest = max(REST, 256 * float(jnp.finfo(y.dtype).eps)) * self.taus[-1]
        return changed_contacts(
            tree_of(args.system), self.events.layout, args.clock(t), y, inputs, what, reach, rest, tolerances
        )

    def with_found_contacts(self, touches: Array) -> tuple[Problem, Array]:
        """The same with the contact states at the start, and whether the contact laws have a solution there.

        A contact that touches and closes at the start remains open: its impact is the first jump.
        """
        reach = jnp.zeros_like(self.taus[0])
        change = self._changed_contacts(reach, self.start, ContactEvent.of_start(touches), reach)
        is_found = self.valid & change.is_determined & jnp.all(jnp.isfinite(change.y))
        problem = self._replace(start=jnp.where(is_found, change.y, self.start), valid=is_found)
        return problem, is_found | ~self.valid


@ScalarFunction.compile_cheaply
def _end(
    valid: Array, duration: Array, start: Array, t: Array, y: Array, status: Array, nothing_accepted: Array
) -> End:
    # The end of the last step; with an event, this is near the event. One `ScalarFunction`: XLA would compute it again
    # in every kernel that uses one of its results.
    unfinished = (status == Status.COMPLETED) & (t < duration)
    status = jnp.where(unfinished, float(Status.MAX_STEPS), status)
    status = jnp.where((status == Status.STEP_TOO_SMALL) & nothing_accepted, float(Status.NO_SOLUTION), status)
    status = jnp.where(valid, status, float(Status.INVALID))
    completed, by_event = status == Status.COMPLETED, status >= Status.EVENT
    t = jnp.where(completed, duration, jnp.where(valid, t, 0.0))
    return End(status, t, jnp.where(valid, y, start), completed, by_event)


def _is_small(x: Numbers) -> bool:
    return eqx.is_inexact_array(x) and 0 < x.size <= LARGEST_SUM


def is_valid(system: System, y: Array, t: Array, signals: Signals) -> Array:
    """Whether a simulation can start at `t`, with a packed state."""
    system, y, t = constant((system, y, t))
    return initial_check(system, y, t, inputs_are_valid(signals))[0]


def _limited(system: System) -> list[tuple[Array, ParameterInfo]]:
    """Values of the parameters with a limited range, and their ranges."""
    return [(value, info) for _, value, info in parameters_in(system) if info.is_limited]


def initial_check(system: System, y: Array, t: Array, others_are_valid: Array) -> tuple[Array, Array, System]:
    """Whether a simulation may begin; its packed state, ones if it may not; and the system with valid parameters.

    Invalid parameters are replaced by 1. Masking the result is not enough: NaN would still reach the reverse-mode
    gradients of parameters that a batch shares. Small arrays are checked in one program, large ones one by one.
    """
    others = all_finite(eqx.filter((system, y), _is_small, inverse=True)) & others_are_valid
    for x, info in _limited(system):
        others = others if _is_small(x) else others & jnp.all(info.allows(x))
    valid, start, small = _initial_check(system, y, t, others)
    large = _harmless(system, y, valid, lambda x: eqx.is_inexact_array(x) and not _is_small(x))
    rest = eqx.filter((y, system), eqx.is_inexact_array, inverse=True)
    return (valid, *eqx.combine((start, small), large, rest))


@ScalarFunction.compile_cheaply
def _initial_check(system: System, y: Array, t: Array, others: Array) -> tuple[Array, Any, Any]:
    conditions = [others, configuration_is_met(system, t, unpacked(system, y).q)]
    conditions += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, y)) if _is_small(x)]
    conditions += [jnp.all(info.allows(x)) for x, info in _limited(system) if _is_small(x)]
    valid = functools.reduce(jnp.logical_and, conditions)
    start, harmless = _harmless(system, y, valid, _is_small)
    # The initial state formally depends on the parameters. The first evaluation of the rates then uses the same
    # derivative program as the loop, so it is compiled once.
    numbers = [jnp.sum(x) for x in jax.tree.leaves(harmless) if x.dtype == y.dtype]
    start = jax.tree.map(lambda x: jnp.where(valid, x, x + 0.0 * sum(numbers)), start)
    return valid, start, harmless


def _harmless(system: System, y: Array, valid: Array, is_chosen: Callable[[Any], bool]) -> tuple[Any, Any]:
    """The chosen arrays of a state and a system, with invalid values replaced by 1; None for the other arrays."""
    limits = {id(x): info for x, info in _limited(system)}

    def where(condition: Array, x: Array) -> Array | None:
        return jnp.where(condition, x, jnp.ones_like(x)) if is_chosen(x) else None

    return where(valid, y), jax.tree.map(lambda x: where(limits.get(id(x), ANY).allows(x), x), system)


def one_step(
    system: System,
    y: Array,
    t0: Array,
    t1: Array,
    signals: Signals,
    settings: Settings,
    disturbance: Callable[..., Any] | None = None,
) -> Array:
    """The packed state after one step of the solver from `t0` to `t1`, without checks, events and outputs.

    NaN if an implicit solver finds no solution. The samples among the `signals` have the clock of `t0` and `t1`.
    """
    args = RateArguments(system, signals, jnp.zeros_like(t0), disturbance)
    constrained = has_configuration_constraints(system, t0, unpacked(system, y).q)
    rates = _rates(settings.stabilize if constrained else 0.0)
    solver = with_scan_kind(_solver_for(settings, system, t0, y, signals), "lax")
    term = diffrax.ODETerm(rates)
    state = solver.init(term, t0, t1, y, args)
    y1, _, _, _, result = solver.step(term, t0, t1, y, args, state, False)
    return jnp.where(result == diffrax.RESULTS.successful, y1, jnp.nan)


def _solver_for(settings: Settings, system: Any, t: Array, y: Array, signals: Signals) -> Any:
    solver: Any = settings.solver
    if is_explicit(solver):
        tree = tree_of(system)
        if rates_are_native(system, t, y, inputs_at(tree, signals, t, unpacked(tree, y))):
            return UnrolledERK(solver)
    return with_stepwise_inputs(with_tolerances(solver, settings.rtol, settings.atol))


def ends_between(system: System, t0: Array, y0: Array, t1: Array, y1: Array, signals: Signals) -> Array:
    """The status if an event or singular speeds end a simulation between two packed states, one step apart."""
    t0, y0, t1, y1 = jax.lax.stop_gradient((t0, y0, t1, y1))
    status, events = jnp.int32(Status.COMPLETED), events_of(system, t0, unpacked(system, y0))
    if not events.names and not system.dependent_speeds:
        return status

    def at(t: Array, y: Array) -> EventValues:
        rates = vector_field(system, t, y, inputs_at(system, signals, t, unpacked(system, y)))
        return event_values(system, t, y, rates if events.read_rates else None)

    before, after = at(t0, y0), at(t1, y1)
    for i, direction in enumerate(events.directions):
        a, b = before.values[i], after.values[i]
        passes = (direction * (b - a) >= 0) & (jnp.sign(a) * jnp.sign(b) < 0)
        status = jnp.where(passes & (status == Status.COMPLETED), jnp.int32(Status.EVENT + i), status)
    return jnp.where(jnp.sign(before.bound) * jnp.sign(after.bound) > 0, status, jnp.int32(Status.SINGULAR_SPEEDS))


def _reads_samples(system: System) -> dict[str, Callable[..., Any]]:
    """By the system's name, the right-hand side (t, state) of a system that uses samples as parameters or closures."""

    def rates(t: Array, state: InputState) -> Array:
        return vector_field(system, t, packed(State(state.q, state.u, state.x)), {})

    return {type(system).__name__: rates} if samples_of(system) or captures_any(Samples, system) else {}


def refuse_captured(system: System) -> None:
    """**Raises:** `TypeError` if a system uses a traced number from a closure or global variable. The derivatives of
    events, constraints and steps would not contain it: they are computed with respect to arguments only."""
    if captured_tracers(system):
        raise TypeError(
            f"{type(system).__name__} uses, in a closure or a global variable, a number that is traced by jax.grad, "
            "jax.jvp, jax.jit or jax.vmap. Make it a parameter of the system, or an input."
        )


def _rates(stabilize: float, forward: bool = False) -> Callable[..., Array]:
    """(t, y, args) -> y_dot. `stabilize` [1/s]: decay rate of constraint residuals; `forward`: see `vector_field`."""

    def rates(t: Array, y: Array, args: RateArguments) -> Array:
        system, clock = tree_of(args.system), args.clock(t)
        state = unpacked(system, y)
        inputs, extra = args.inputs(system, t, state), None
        if args.disturbance is not None:
            inputs, extra = args.disturbance(clock, inputs, state)
        y_dot = vector_field(args.system, clock, y, inputs, forward)
        if extra is not None:
            y_dot += packed(extra)
        if stabilize:
            back = stabilize * correction(system, clock, state.q)
            y_dot += jnp.concatenate([back, jnp.zeros_like(y_dot[back.size :])])
        return y_dot

    return rates


def _trajectory(problem: Problem, steps: Steps, end: End, follows_from: list[Array]) -> Trajectory:
    """The trajectory of these steps, NaN after the last one. `follows_from`: the values on which it depends."""
    system, taus, args, found = problem.system, problem.taus, problem.args, problem.discontinuities
    layout = problem.events.layout
    ts, blur = args.origin + taus, rounding(taus[-1], taus[-1])
    # The last step ends shortly before or after the event. Samples between both times get the state at the event.
    before = taus <= end.t + blur
    # A jump at the last time leaves the state after it.
    late = (end.by_event | (end.status == Status.COMPLETED)) & ~steps.reached & before
    reached = problem.valid & jnp.where(end.by_event, before, steps.reached | late)
    motion = jnp.where(late[:, None], end.y[None], steps.motion)
    if steps.jumps is not None:
        record = steps.jumps
        happened = jnp.arange(record.t.shape[0]) < steps.n_jumps

        def away_from_jumps(times: Array, states: Array) -> Array:
            apart = jnp.abs(times[:, None] - constant(record.t)[None])
            near = happened[None] & (apart <= 16 * rounding(times, taus[-1])[:, None])
            return without_derivative_at(near, states, record.t)

        motion = away_from_jumps(taus, motion)
        end = end._replace(y=jnp.where(end.by_event, end.y, away_from_jumps(end.t[None], end.y[None])[0]))
        smooth = record.smooth > 0
        if steps.replay is not None and steps.replay.after is not None and layout.names:
            # A jump at a limit, whose contact states depend on rounding errors
            memories = (x[:, x.shape[1] - layout.memory_size :] for x in (record.after, steps.replay.after))
            now, then = (x.reshape(len(x), len(layout.names), -1)[:, :, 0] for x in memories)
            smooth &= jnp.all(now == then, axis=1)
        rough = jnp.min(jnp.where(happened & ~smooth, constant(record.t), jnp.inf), initial=jnp.inf)
        motion = nan_derivative_where(taus >= rough, motion, follows_from)
        motion = nan_beyond_second_derivative(steps.n_jumps > 0, motion, follows_from)
        end = end._replace(smooth=end.smooth & (rough == jnp.inf))
    # States that were not reached are replaced by the first: masking the outputs would leave NaN in derivatives.
    motion = jnp.where(reached[:, None], motion, problem.start[None])
    if problem.settings.project and problem.constrained:
        n_q = len(system.coordinates)

        def onto_constraints(t: Array, y: Array) -> Array:
            return jnp.concatenate([projected(system, t, y[:n_q]), y[n_q:]])

        motion = jax.vmap(onto_constraints)(ts, motion)
        end = end._replace(y=onto_constraints(args.origin + end.t, end.y))
    states = unpacked(system, motion)
    u_dep = jax.vmap(lambda t, y: _dependent_speeds_of(system, t, y))(ts, motion)
    all_inputs = jax.vmap(lambda tau, y: args.inputs(system, tau, y, all_of_them=True))
    inputs, discontinuities = all_inputs(taus, states), None
    if found is not None:
        sides = (-blur, blur) if found.jumps else ()
        discontinuities = InputDiscontinuities(found.times, tuple(all_inputs(taus + x, states) for x in sides))
    if layout.names or layout.n_residuals:
        of_contacts = jax.vmap(lambda t, y, w: outputs_in_contact(system, t, y, w))
        speeds, outputs = of_contacts(ts, motion, inputs)
        n_q = len(system.coordinates)
        motion = jnp.concatenate([motion[:, :n_q], speeds, motion[:, n_q + len(system.speeds) :]], axis=1)
    else:
        of_state = jax.vmap(lambda t, y, w: outputs_at(system, t, y.q, y.u, values_of(system, y.x, w)))
        outputs = of_state(ts, states, inputs)
    motion, u_dep, inputs, outputs = nan_where(~reached, (motion, u_dep, inputs, outputs), follows_from)
    t_end, y_end = nan_derivative_where(~end.smooth, (end.t, end.y), follows_from)
    if problem.events.names:
        located = end.by_event if steps.jumps is None else end.by_event | (steps.n_jumps > 0)
        t_end, y_end = nan_beyond_second_derivative(located, (t_end, y_end), follows_from)
    states, last = unpacked(system, motion), unpacked(system, nan_where(~problem.valid, y_end, follows_from))
    return Trajectory(
        t=ts,
        q=states.q,
        u=states.u,
        u_dep=u_dep,
        x=states.u[:, :0] if states.x is None else states.x,
        contact_memory=states.contacts,
        contact_names=layout.names,
        inputs=inputs,
        outputs=outputs,
        status=end.status.astype(jnp.int32),
        t_end=args.origin + t_end,
        stats={"steps": steps.taken, "accepted": steps.accepted, "rejected": steps.taken - steps.accepted},
        names=names_of(system),
        events=problem.events.names,
        adjoint=type(problem.settings.adjoint).__name__,
        units=tuple(units_of(system).items()),
        end=last,
        discontinuities=discontinuities,
        jumps=None if steps.jumps is None else _jump_table(problem, steps.jumps, steps.n_jumps, follows_from),
    )


def _jump_table(problem: Problem, record: Jump, count: Array, follows_from: list[Array]) -> JumpTable:
    system, args = problem.system, problem.args
    unused = jnp.arange(record.t.shape[0]) >= count
    before, after = (jnp.where(unused[:, None], problem.start, y) for y in (record.before, record.after))
    times = args.clock(record.t)

    def energy(states: Array) -> Array:
        q, u = unpacked(system, states).q, unpacked(system, states).u
        return jax.vmap(lambda t, q, u: _kinetic_energy(system, t, q, u, {}))(times, q, u)

    lost = energy(before) - energy(after)
    sides = [
        jax.vmap(lambda tau, y: args.inputs(system, tau, unpacked(system, y), all_of_them=True))(record.t, y)
        for y in (before, after)
    ]
    values = times, before, after, lost, record.impulses, tuple(sides)
    rough = jnp.cumsum(jnp.where(unused, 0.0, 1.0 - constant(record.smooth))) > 0
    values = nan_derivative_where(rough, values, follows_from)
    values = nan_beyond_second_derivative(count > 0, values, follows_from)
    t, before, after, lost, impulses, inputs = nan_where(unused, values, follows_from)
    events = jnp.where(unused, -1, record.event.astype(jnp.int32))
    states = unpacked(system, before), unpacked(system, after)
    return JumpTable(t, events, *states, lost, impulses, inputs, count, problem.events.names)


@ScalarFunction
def _dependent_speeds_of(system: System, t: Array, y: Array) -> Array:
    state = unpacked(system, y)
    return as_vector(KaneEquations(system, t, state.q, state.u).u_dep, y)
