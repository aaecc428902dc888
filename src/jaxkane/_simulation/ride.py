"""One motion as one compiled program: integrated, ended, masked. Knows diffrax and the method, and no mechanism."""

from __future__ import annotations

import functools
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._common.lookup import not_there
from .._description.parameters import parameters_in
from .._description.system import State, System, names_of, packed, unpacked
from .._description.units import units_of
from .._method.checks import configuration_is_met
from .._method.drift import correction, has_configuration_constraints, projected
from .._method.equations import _dependent_speeds
from .._method.kane import Instant
from .._method.outputs import outputs_at
from .._method.right_hand_side import packed_rates, rates_are_native, values_of
from .._method.values import checked_inputs
from .._scalars.fuse import fused
from .._scalars.nan import all_finite, derivative_free_where_not_finite, flat, nan_derivative_where, nan_where
from .._scalars.types import Component
from .._scalars.versions import compiled
from .events import Events, at_zero, events_of, watched
from .kinks import ToKinks
from .settings import Settings, refuse_held
from .signals import evaluate, for_fixed_steps, sample_times, signals_are_sound, with_own_times, without_nonsense
from .stages import WrittenOut
from .stops import AdaptiveToStops, Limits, Quantities, ToStops
from .trajectory import Status, Trajectory


class Now(eqx.Module):
    """What an input function receives: `state.q`, `state.u`, `state.x`, and any coordinate, speed or state by name."""

    q: Array
    u: Array
    x: Array | None
    t: Any
    system: System

    def __getitem__(self, name: str) -> Component:
        system = self.system
        for names, values in ((system.coordinates, self.q), (system.speeds, self.u), (system.states, self.x)):
            if values is not None and name in names:
                return values[names.index(name)]
        if name in system.dependent_speeds:
            now = Instant(system, self.t, self.q, self.u)
            return jnp.asarray(now.u_dep[system.dependent_speeds.index(name)])
        raise not_there(name, [each for names in names_of(system) for each in names], "the state")


@compiled
def solve(
    system: System, state: State, ts: Array, signals: Any, settings: Settings, disturbance: Any = None
) -> Trajectory:
    """`simulate` without its checks: one compiled program.

    `disturbance`: of t, inputs and state, gives the inputs as disturbed, and a `State` of what is added to its rates.
    """
    signals = with_own_times(signals)
    if settings.step is not None:
        refuse_held(settings.solver, signals)
        signals = for_fixed_steps(signals)
    origin = flat((system, state, ts, signals, disturbance))
    valid = _is_valid(system, state, ts, signals)
    # What is not finite must not enter the solver, where it would spoil the gradient of what is shared. In its steps
    # what all members of a batch share remains shared, of which a kernel computes its part once.
    stepped = _sound(system)
    system, state = _safe(valid, (system, state))
    start = packed(state)
    ts = jnp.where(_is_rising(ts), ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    signals = without_nonsense(signals, valid)
    constrained = has_configuration_constraints(system, ts[0], state.q)

    def vector_field(t, y, args):
        system, signals, disturbance = args
        state = unpacked(system, y)
        inputs, more = inputs_at(system, signals, t, state), None
        if disturbance is not None:
            inputs, more = disturbance(t, inputs, state)
        y_dot = packed_rates(system, t, y, inputs)
        if more is not None:
            y_dot += packed(more)
        if constrained and settings.stabilize:
            back = settings.stabilize * correction(system, t, state.q)
            y_dot += jnp.concatenate([back, jnp.zeros_like(y_dot[back.size :])])
        return jnp.where(valid, y_dot, jnp.zeros_like(y_dot))

    def trial_rates(t, y, args):
        # A step that is rejected since its rates are not finite must not spoil a derivative in reverse mode.
        return derivative_free_where_not_finite(vector_field, t, y, args)

    forward = isinstance(settings.adjoint, diffrax.ForwardMode)
    events = events_of(system, ts[0], state)
    stops = bool(events.names or system.dependent_speeds)
    solver, inputs = settings.solver, inputs_at(system, signals, ts[0], state)
    is_native = rates_are_native(stepped, ts[0], start, inputs)
    step, controller, reach = _steps(ts, signals, settings)
    if stops:
        controller = _to_stops(controller, vector_field, events, system, ts, reach)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field if forward else trial_rates),
        WrittenOut(solver) if is_native and isinstance(solver, diffrax.AbstractERK) else solver,
        ts[0],
        ts[-1],
        step,
        start,
        (stepped, signals, disturbance),
        saveat=diffrax.SaveAt(subs=(diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)), controller_state=stops),
        stepsize_controller=controller,
        adjoint=settings.adjoint,
        max_steps=settings.max_steps,
        progress_meter=diffrax.TqdmProgressMeter() if settings.progress else diffrax.NoProgressMeter(),
        throw=False,
    )
    times, states = cast(Any, (solution.ts, solution.ys))
    (t_reached, t_last), (motion, last) = jax.lax.stop_gradient(times), states
    reached, t_end, end = jnp.isfinite(t_reached) & valid, t_last[0], last[0]

    which = cast(Any, solution.controller_state).which.astype(int) if stops else jnp.array(-1)
    status = jnp.where(valid, _status(solution, which, events), Status.INVALID).astype(jnp.int32)
    smooth = status == Status.COMPLETED
    t_end = jnp.where(smooth, ts[-1], jnp.where(valid, t_end, ts[0]))
    if events.names:
        happened = status >= Status.EVENT
        beside = jax.tree.map(lambda x, first: jnp.where(happened, x, first), (t_end, end), (ts[0], start))
        moving = lambda t, y: vector_field(t, y, (stepped, signals, disturbance))  # noqa: E731
        found = at_zero(stepped, beside[0], beside[1], jnp.maximum(which, 0), happened, moving, 4 * reach, events)
        t_end, end = jax.tree.map(lambda x, y: jnp.where(happened, x, y), (found.t, found.y), (t_end, end))
        smooth |= happened & found.smooth
        # The last step ends a little beside the event: samples from there to here are those of the event itself.
        here = 64 * jnp.finfo(ts.dtype).eps * jnp.max(jnp.abs(ts))
        late = happened & ~reached & (ts <= t_end + here)
        reached = jnp.where(happened, ts <= t_end + here, reached)
        motion = jnp.where(late[:, None], end[None], motion)

    # What follows from the motion is found where there is one, and from the first state elsewhere: a value that is
    # not finite has derivatives that a mask behind it cannot take away.
    motion = jnp.where(reached[:, None], motion, start[None])
    end = jnp.where(valid, end, start)
    if constrained and settings.project:

        def onto(t: Array, y: Array) -> Array:
            return jnp.concatenate([projected(system, t, y[: state.q.size]), y[state.q.size :]])

        motion, end = jax.vmap(onto)(ts, motion), onto(t_end, end)
    along = unpacked(system, motion)
    u_dep = jax.vmap(lambda t, y: _dependent_speeds(system, t, y.q, y.u, {}))(ts, along)
    inputs = jax.vmap(lambda t, y: inputs_at(system, signals, t, y, all_of_them=True))(ts, along)
    outputs = jax.vmap(lambda t, y, w: outputs_at(system, t, y.q, y.u, values_of(system, y.x, w)))(ts, along, inputs)
    motion, u_dep, inputs, outputs = nan_where(~reached, (motion, u_dep, inputs, outputs), origin)
    t_end, end = nan_derivative_where(~smooth, (t_end, end), origin)
    motion, end = unpacked(system, motion), unpacked(system, nan_where(~valid, end, origin))
    return Trajectory(
        t=ts,
        q=motion.q,
        u=motion.u,
        u_dep=u_dep,
        x=motion.u[:, :0] if motion.x is None else motion.x,
        inputs=inputs,
        outputs=outputs,
        status=status,
        t_end=t_end,
        stats={
            "steps": solution.stats["num_steps"],
            "accepted": solution.stats["num_accepted_steps"],
            "rejected": solution.stats["num_rejected_steps"],
        },
        names=names_of(system),
        events=events.names,
        adjoint=type(settings.adjoint).__name__,
        units=tuple(units_of(system).items()),
        end=end,
    )


def _steps(ts: Array, signals: Any, settings: Settings) -> tuple[Any, Any, Array]:
    """The first step, the controller of the others, and how near to an event the last one must end [s]."""
    whole = jax.lax.stop_gradient(ts[-1] - ts[0])
    rounding = 1e3 * jnp.finfo(ts.dtype).eps * whole
    reach = 8 * rounding + 1e-9 * whole
    if settings.step is not None:
        # A fixed step is spread evenly over the whole time: a rounding error must not make it one step more, after
        # which no step would end where a sample of an input stands.
        several = 1.0 + jnp.finfo(ts.dtype).eps ** 0.5
        return several * settings.step, diffrax.ConstantStepSize(), reach
    # A first step, right or wrong by a factor of ten, spares the two more copies of the right-hand side that diffrax
    # would compile to choose one.
    step = jnp.minimum(whole / 1000, jax.lax.stop_gradient(ts[1] - ts[0]))
    controller = diffrax.PIDController(rtol=settings.rtol, atol=settings.atol, dtmin=rounding, force_dtmin=False)
    kinks = sample_times(signals, ts.dtype)
    return step, controller if kinks is None else ToKinks(controller, *kinks, end=ts[-1]), reach


def _to_stops(controller: Any, vector_field: Any, events: Events, system: System, ts: Array, reach: Array) -> ToStops:
    """A controller that also ends the motion: at the events, and before the dependent speeds are singular."""

    def watch(t, y, args):
        return Quantities(*watched(args[0], t, y, vector_field(t, y, args) if events.read_speeds else None))

    whole = jax.lax.stop_gradient(ts[-1] - ts[0])
    adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    kind: Any = AdaptiveToStops if adaptive else ToStops
    rounding = 1e3 * jnp.finfo(ts.dtype).eps * whole
    limits = Limits(directions=events.directions, resolution=reach, rounding=rounding, shortest=whole / 1000)
    return kind(controller=controller, watch=watch, limits=limits)


def inputs_at(system: System, signals: Any, t: Component, state: State, all_of_them: bool = False):
    """The inputs by name, at one time: all, or those that are given."""
    values = evaluate(signals, t, Now(state.q, state.u, state.x, t, system))
    names = checked_inputs(system, values) if all_of_them else values
    return {name: jnp.asarray(values.get(name, 0.0), dtype=state.q.dtype) for name in names}


_SCALARS_UP_TO = 64  # beyond so many numbers an array is none for a program of scalars


def _is_few(x: Any) -> bool:
    return eqx.is_inexact_array(x) and 0 < x.size <= _SCALARS_UP_TO


def _is_rising(ts: Array) -> Array:
    # A window of a fit may stand still at its last time.
    return all_finite(ts) & jnp.all(ts[1:] >= ts[:-1]) & (ts[-1] > ts[0])


def _is_valid(system: System, state: State, ts: Array, signals: Any) -> Array:
    many = eqx.filter((system, state), _is_few, inverse=True)
    others = all_finite(many) & _is_rising(ts) & signals_are_sound(signals)
    for value in _positive(system):
        if not _is_few(value):
            others &= jnp.all(value > 0)
    numbers, static = eqx.partition((system, state, ts[0]), eqx.is_array)
    return _is_sound(*eqx.combine(jax.lax.stop_gradient(numbers), static), others)


@fused
def _is_sound(system: System, state: State, t: Array, others: Array) -> Array:
    """Whether a motion can begin there, one answer from all the numbers; `others`: from those that are too many."""
    facts = [others, configuration_is_met(system, t, state.q)]
    facts += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, state)) if _is_few(x)]
    return functools.reduce(jnp.logical_and, [*facts, *(jnp.all(x > 0) for x in _positive(system) if _is_few(x))])


def _positive(system: System) -> list[Array]:
    """Values of the parameters that must be positive."""
    return [value for _, value, info in parameters_in(system) if info.positive]


def _safe(valid: Array, values: Any) -> Any:
    """The values where they are valid, ones elsewhere."""
    few, rest = eqx.partition(values, _is_few)
    many, rest = eqx.partition(rest, eqx.is_inexact_array)
    many = jax.tree.map(lambda x: jnp.where(valid, x, jnp.ones_like(x)), many)
    leaves, treedef = jax.tree.flatten(few)
    return eqx.combine(jax.tree.unflatten(treedef, _safe_scalars(valid, leaves)), many, rest)


def _sound(system: System) -> System:
    """The system with ones for parameters that are not finite, or not positive as they must be: behind a mask these
    would still spoil the reverse gradient of what is shared."""
    must_be = {id(x) for x in _positive(system)}
    few, rest = eqx.partition(system, _is_few)
    many, rest = eqx.partition(rest, eqx.is_inexact_array)
    many = jax.tree.map(lambda x: _sound_or_one(x, id(x) in must_be), many)
    leaves, treedef = jax.tree.flatten(few)
    positive = [id(x) in must_be for x in leaves]
    split = [[x for x, p in zip(leaves, positive, strict=True) if p == kind] for kind in (False, True)]
    found = [iter(each) for each in _sound_scalars(*split)] if leaves else []
    return eqx.combine(jax.tree.unflatten(treedef, [next(found[p]) for p in positive]), many, rest)


@fused
def _sound_scalars(values: list[Array], positive: list[Array]) -> tuple[list[Array], list[Array]]:
    return [_sound_or_one(x, False) for x in values], [_sound_or_one(x, True) for x in positive]


def _sound_or_one(x: Array, positive: bool) -> Array:
    return jnp.where(jnp.isfinite(x) & (x > 0) if positive else jnp.isfinite(x), x, jnp.ones_like(x))


@fused
def _safe_scalars(valid: Array, values: list[Array]) -> list[Array]:
    # One program: as an operation each, the parameters would be as many kernels of XLA.
    return [jnp.where(valid, x, jnp.ones_like(x)) for x in values]


def _status(solution: diffrax.Solution, which: Array, events: Events) -> Array:
    result = solution.result
    status = jnp.where(result == diffrax.RESULTS.successful, Status.COMPLETED, Status.STEP_TOO_SMALL)
    status = jnp.where(result == diffrax.RESULTS.max_steps_reached, Status.MAX_STEPS, status)
    unmoved = (status == Status.STEP_TOO_SMALL) & (solution.stats["num_accepted_steps"] == 0)
    status = jnp.where(unmoved, Status.NO_SOLUTION, status)
    stopped = jnp.where(which < len(events.names), Status.EVENT + which, Status.SINGULAR_SPEEDS)
    return jnp.where(result == diffrax.RESULTS.event_occurred, stopped, status)
