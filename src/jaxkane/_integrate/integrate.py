"""Whether a motion can begin, and values in the place of those with which none can. Knows descriptions and arrays."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._common.lookup import not_there
from .._kane.arguments import checked_inputs
from .._kane.constraints import configuration_is_met, correction, has_configuration_constraints, projected
from .._kane.kane import KaneEquations
from .._kane.rhs import outputs_at, rates_are_native, values_of, vector_field
from .._scalarjit.cache_key import captured_tracers, captures_any, jit
from .._scalarjit.components import Component
from .._scalarjit.function import ScalarFunction
from .._scalarjit.linear import as_vector
from .._scalarjit.nan import all_finite, derivative_free_where_not_finite, flat, nan_derivative_where, nan_where
from .._system.parameters import ANY, ParameterInfo, parameters_in
from .._system.system import State, System, names_of, packed, units_of, unpacked
from .diffrax_compat import UnrolledERK, saveat_and_adjoint
from .events import Events, at_zero, events_of
from .inputs import (
    Kinks,
    Samples,
    evaluate,
    for_fixed_steps,
    kinks_of,
    mask_invalid_inputs,
    samples_of,
    signals_are_sound,
    with_own_times,
)
from .settings import SCALARS_UP_TO, Settings, refuse_held
from .step_control import Times, controller_of, times_of
from .trajectory import Sides, Status, Trajectory


def _is_few(x: Any) -> bool:
    return eqx.is_inexact_array(x) and 0 < x.size <= SCALARS_UP_TO


def is_rising(ts: Array) -> Array:
    # A window of a fit may stand still at its last time.
    return all_finite(ts) & jnp.all(ts[1:] >= ts[:-1]) & (ts[-1] > ts[0])


def is_valid(system: System, state: State, t: Array, signals: Any, rises: Array | None) -> Array:
    """Whether a motion can begin at `t`; `rises`: whether the times rise, None where that is known."""
    many = eqx.filter((system, state), _is_few, inverse=True)
    others = all_finite(many) & (True if rises is None else rises) & signals_are_sound(signals)
    for value, info in _limited(system):
        if not _is_few(value):
            others &= jnp.all(info.allows(value))
    numbers, static = eqx.partition((system, state, t), eqx.is_array)
    return _is_sound(*eqx.combine(jax.lax.stop_gradient(numbers), static), others)


@ScalarFunction
def _is_sound(system: System, state: State, t: Array, others: Array) -> Array:
    """Whether a motion can begin there, one answer from all the numbers; `others`: from those that are too many."""
    facts = [others, configuration_is_met(system, t, state.q)]
    facts += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, state)) if _is_few(x)]
    facts += [jnp.all(info.allows(x)) for x, info in _limited(system) if _is_few(x)]
    return functools.reduce(jnp.logical_and, facts)


def _limited(system: System) -> list[tuple[Array, ParameterInfo]]:
    """Values of the parameters that cannot be any number, and what they can be."""
    return [(value, info) for _, value, info in parameters_in(system) if info.is_limited]


def safe(valid: Array, values: Any) -> Any:
    """The values where they are valid, ones elsewhere."""
    return _replaced(values, lambda xs: _safe_scalars(valid, xs), lambda x: jnp.where(valid, x, jnp.ones_like(x)))


def sound(system: System) -> System:
    """The system with ones for parameters that are not finite, or that no description can have: behind a mask these
    would still spoil the reverse gradient of what is shared."""
    limits = {id(x): info for x, info in _limited(system)}
    of = lambda x: limits.get(id(x), ANY)  # noqa: E731
    scalars = lambda xs: _sound_scalars(_Limits(tuple(map(of, xs))), xs)  # noqa: E731
    return _replaced(system, scalars, lambda x: _sound_or_one(x, of(x)))


def _replaced(values: Any, scalars: Callable[[list[Array]], list[Array]], array: Callable[[Array], Array]) -> Any:
    """The values with others for numbers: small arrays all at once, as one program, and large ones each by itself."""
    few, rest = eqx.partition(values, _is_few)
    many, rest = eqx.partition(rest, eqx.is_inexact_array)
    leaves, treedef = jax.tree.flatten(few)
    found = scalars(leaves) if leaves else leaves
    return eqx.combine(jax.tree.unflatten(treedef, found), jax.tree.map(array, many), rest)


class _Limits(eqx.Module):
    """What some numbers can be."""

    these: tuple[ParameterInfo, ...] = eqx.field(static=True)


@ScalarFunction
def _sound_scalars(limits: _Limits, values: list[Array]) -> list[Array]:
    return [_sound_or_one(x, info) for x, info in zip(values, limits.these, strict=True)]


def _sound_or_one(x: Array, info: ParameterInfo) -> Array:
    return jnp.where(info.allows(x), x, jnp.ones_like(x))


@ScalarFunction
def _safe_scalars(valid: Array, values: list[Array]) -> list[Array]:
    return [jnp.where(valid, x, jnp.ones_like(x)) for x in values]


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
            now = KaneEquations(system, self.t, self.q, self.u)
            return jnp.asarray(now.u_dep[system.dependent_speeds.index(name)])
        raise not_there(name, [each for names in names_of(system) for each in names], "the state")


class _Asked(NamedTuple):
    """A motion that is to be found. `system`, `signals`: those asked for, and harmless ones where none can begin;
    `start`: the packed state. `rates`: (t, y, args) -> y_dot, and `args` that the steps pass to it."""

    system: System
    signals: Any
    start: Array
    ts: Array
    times: Times
    kinks: Kinks | None
    valid: Array
    rates: Callable[..., Any]
    args: Any
    events: Events
    settings: Settings


class _Found(NamedTuple):
    """What was found: packed states `motion` (n_t, n), and which of them were `reached` (n_t,); the end, and whether it
    moves `smooth`ly with what it comes from; the status; steps counted."""

    motion: Array
    reached: Array
    t_end: Array
    end: Array
    smooth: Array
    status: Array
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
    signals = with_own_times(signals)
    if settings.step is not None:
        refuse_held(settings.solver, signals)
        signals = for_fixed_steps(signals)
    origin = flat((system, state, ts, signals, disturbance, closures))
    rises = None if settings.rising else is_rising(ts)
    ts = ts if rises is None else jnp.where(rises, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    times = times_of(ts, settings)
    valid = is_valid(system, state, times.start, signals, rises)
    # What is not finite must not enter the solver, where it would spoil the gradient of what is shared. In its steps
    # what all members of a batch share remains shared, of which a kernel computes its part once.
    stepped = sound(system)
    system, state = safe(valid, (system, state))
    signals = mask_invalid_inputs(signals, valid)
    y = packed(state)
    state_at = lambda t, y: _now(system, t, unpacked(system, y))  # noqa: E731
    kinks = kinks_of(signals, _calling_samples(system), times.start, y, state_at, fixed=settings.step is not None)
    constrained = has_configuration_constraints(system, times.start, state.q)
    asked = _Asked(
        system=system,
        signals=signals,
        start=y,
        ts=ts,
        times=times,
        kinks=kinks,
        valid=valid,
        rates=_rates(valid, settings.stabilize if constrained else 0.0),
        args=(stepped, signals, disturbance),
        events=events_of(system, times.start, state),
        settings=settings,
    )
    found = _integrated(asked)
    if asked.events.names:
        found = _to_event(asked, found)
    return _trajectory(asked, _everywhere(asked, found, constrained and settings.project), origin)


def _calling_samples(system: System) -> dict[str, Callable[..., Any]]:
    """The right-hand side (t, state) of a system that has samples among its parameters, or whose code reads some from
    outside, by the system's name."""

    def rates(t: Array, now: Now) -> Array:
        return vector_field(system, t, packed(State(now.q, now.u, now.x)), {})

    return {type(system).__name__: rates} if samples_of(system) or captures_any(Samples, system) else {}


def refuse_captured(system: System) -> None:
    """**Raises:** `TypeError` where a description reads a number of a trace that is under way from outside: the rules
    by which events, constraints and steps are differentiated know what they are given alone."""
    if captured_tracers(system):
        raise TypeError(
            f"{type(system).__name__}: its description reads, by a closure or a global, a number that is being traced "
            "(by jax.grad, jax.jvp, jax.jit or jax.vmap). Make it a parameter of the system, or an input."
        )


def _rates(valid: Array, stabilize: float) -> Callable[..., Any]:
    """(t, y, args) -> y_dot, zero where no motion can begin. `stabilize` [1/s]: how fast constraints are led back."""

    def rates(t: Array, y: Array, args: Any) -> Array:
        system, signals, disturbance = args
        state = unpacked(system, y)
        inputs, more = inputs_at(system, signals, t, state), None
        if disturbance is not None:
            inputs, more = disturbance(t, inputs, state)
        y_dot = vector_field(system, t, y, inputs)
        if more is not None:
            y_dot += packed(more)
        if stabilize:
            back = stabilize * correction(system, t, state.q)
            y_dot += jnp.concatenate([back, jnp.zeros_like(y_dot[back.size :])])
        return jnp.where(valid, y_dot, jnp.zeros_like(y_dot))

    return rates


def _integrated(asked: _Asked) -> _Found:
    """The motion at the times that its steps reach."""
    settings, times, (stepped, *_) = asked.settings, asked.times, asked.args

    def trial_rates(t: Any, y: Any, args: Any) -> Any:
        # A step that is rejected since its rates are not finite must not spoil a derivative in reverse mode.
        return derivative_free_where_not_finite(asked.rates, t, y, args)

    forward = isinstance(settings.adjoint, diffrax.ForwardMode)
    solver: Any = settings.solver
    inputs = inputs_at(asked.system, asked.signals, times.start, unpacked(asked.system, asked.start))
    if isinstance(solver, diffrax.AbstractERK) and rates_are_native(stepped, times.start, asked.start, inputs):
        solver = UnrolledERK(solver)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(asked.rates if forward else trial_rates),
        solver,
        times.start,
        times.end,
        None,
        asked.start,
        asked.args,
        stepsize_controller=controller_of(times, asked.rates, asked.events, stepped, asked.kinks, settings),
        **saveat_and_adjoint(asked.ts, settings.adjoint, anew=settings.progress),
        max_steps=settings.max_steps,
        progress_meter=diffrax.TqdmProgressMeter() if settings.progress else diffrax.NoProgressMeter(),
        throw=False,
    )
    at, states = cast(Any, (solution.ts, solution.ys))
    (t_reached, t_last), (motion, last) = jax.lax.stop_gradient(at), states
    status = jnp.where(asked.valid, _status(solution, asked.events), Status.INVALID).astype(jnp.int32)
    completed = status == Status.COMPLETED
    return _Found(
        motion=motion,
        reached=jnp.isfinite(t_reached) & asked.valid,
        t_end=jnp.where(completed, times.end, jnp.where(asked.valid, t_last[0], times.start)),
        end=last[0],
        smooth=completed,
        status=status,
        stats={name: solution.stats[of] for name, of in _COUNTED.items()},
    )


_COUNTED = {"steps": "num_steps", "accepted": "num_accepted_steps", "rejected": "num_rejected_steps"}


def _to_event(asked: _Asked, found: _Found) -> _Found:
    """The same, whose end is the instant of the event, where one happened."""
    times, happened = asked.times, found.status >= Status.EVENT
    which = jnp.maximum(found.status - Status.EVENT, 0)
    first, end = (times.start, asked.start), (found.t_end, found.end)
    t, y = jax.tree.map(lambda x, x0: jnp.where(happened, x, x0), end, first)
    rates = lambda t, y: asked.rates(t, y, asked.args)  # noqa: E731
    zero = at_zero(asked.args[0], t, y, which, happened, rates, times.beside, asked.events)
    t_end, end = jax.tree.map(lambda x, y: jnp.where(happened, x, y), (zero.t, zero.y), end)
    # The last step ends a little beside the event: samples from there to here are those of the event itself.
    before = asked.ts <= t_end + times.here
    late = happened & ~found.reached & before
    return found._replace(
        motion=jnp.where(late[:, None], end[None], found.motion),
        reached=jnp.where(happened, before, found.reached),
        t_end=t_end,
        end=end,
        smooth=found.smooth | (happened & zero.smooth),
    )


def _everywhere(asked: _Asked, found: _Found, project: bool) -> _Found:
    """The same with states in all places: the first where there is none, since a value that is not finite has
    derivatives that a mask behind it cannot take away. `project`: onto the configuration constraints."""
    motion = jnp.where(found.reached[:, None], found.motion, asked.start[None])
    end = jnp.where(asked.valid, found.end, asked.start)
    if project:
        n_q = len(asked.system.coordinates)

        def onto(t: Array, y: Array) -> Array:
            return jnp.concatenate([projected(asked.system, t, y[:n_q]), y[n_q:]])

        motion, end = jax.vmap(onto)(asked.ts, motion), onto(found.t_end, end)
    return found._replace(motion=motion, end=end)


def _trajectory(asked: _Asked, found: _Found, origin: Array) -> Trajectory:
    """What follows from the motion, and NaN where there is none. `origin`: what all of it comes from."""
    system, ts, motion = asked.system, asked.ts, found.motion
    along = unpacked(system, motion)
    u_dep = jax.vmap(lambda t, y: _dependent_speeds_of(system, t, y))(ts, motion)
    all_inputs = jax.vmap(lambda t, y: inputs_at(system, asked.signals, t, y, all_of_them=True))
    inputs, sides = all_inputs(ts, along), None
    if asked.kinks is not None:
        near = (-asked.times.here, asked.times.here) if asked.kinks.jumps else ()
        sides = Sides(asked.kinks.times, tuple(all_inputs(ts + x, along) for x in near))
    outputs = jax.vmap(lambda t, y, w: outputs_at(system, t, y.q, y.u, values_of(system, y.x, w)))(ts, along, inputs)
    motion, u_dep, inputs, outputs = nan_where(~found.reached, (motion, u_dep, inputs, outputs), origin)
    t_end, end = nan_derivative_where(~found.smooth, (found.t_end, found.end), origin)
    motion, end = unpacked(system, motion), unpacked(system, nan_where(~asked.valid, end, origin))
    return Trajectory(
        t=ts,
        q=motion.q,
        u=motion.u,
        u_dep=u_dep,
        x=motion.u[:, :0] if motion.x is None else motion.x,
        inputs=inputs,
        outputs=outputs,
        status=found.status,
        t_end=t_end,
        stats=found.stats,
        names=names_of(system),
        events=asked.events.names,
        adjoint=type(asked.settings.adjoint).__name__,
        units=tuple(units_of(system).items()),
        end=end,
        sides=sides,
    )


def _now(system: System, t: Component, state: State) -> Now:
    return Now(state.q, state.u, state.x, t, system)


def inputs_at(system: System, signals: Any, t: Component, state: State, all_of_them: bool = False):
    """The inputs by name, at one time: all, or those that are given."""
    values = evaluate(signals, t, _now(system, t, state))
    checked = checked_inputs(system, values)
    names = checked if all_of_them else values
    return {name: jnp.asarray(values.get(name, 0.0), dtype=state.q.dtype) for name in names}


@ScalarFunction
def _dependent_speeds_of(system: System, t: Array, y: Array) -> Array:
    state = unpacked(system, y)
    return as_vector(KaneEquations(system, t, state.q, state.u).u_dep, y)


def _status(solution: diffrax.Solution, events: Events) -> Array:
    result, which = solution.result, cast(Any, solution.controller_state).which.astype(int)
    status = jnp.where(result == diffrax.RESULTS.successful, Status.COMPLETED, Status.STEP_TOO_SMALL)
    status = jnp.where(result == diffrax.RESULTS.max_steps_reached, Status.MAX_STEPS, status)
    unmoved = (status == Status.STEP_TOO_SMALL) & (solution.stats["num_accepted_steps"] == 0)
    status = jnp.where(unmoved, Status.NO_SOLUTION, status)
    stopped = jnp.where(which < len(events.names), Status.EVENT + which, Status.SINGULAR_SPEEDS)
    stopped = jnp.where(which < 0, Status.COMPLETED, stopped)
    return jnp.where(result == diffrax.RESULTS.event_occurred, stopped, status)
