"""One motion as one compiled program: integrated, ended, masked. Knows diffrax and the method, and no mechanism."""

from __future__ import annotations

from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._common.lookup import not_there
from .._description.system import State, System, names_of, packed, unpacked
from .._description.units import units_of
from .._method.drift import correction, has_configuration_constraints, projected
from .._method.kane import Instant
from .._method.outputs import outputs_at
from .._method.right_hand_side import packed_rates, rates_are_native, values_of
from .._method.values import checked_inputs
from .._scalars.fuse import fused
from .._scalars.linear import as_vector
from .._scalars.nan import derivative_free_where_not_finite, flat, nan_derivative_where, nan_where
from .._scalars.types import Component
from .._scalars.versions import compiled
from .events import Events, at_zero, events_of
from .loops import keeping
from .settings import Settings, refuse_held
from .signals import evaluate, for_fixed_steps, with_own_times, without_nonsense
from .stages import WrittenOut
from .steps import controller_of, times_of
from .trajectory import Status, Trajectory
from .valid import is_rising, is_valid, safe, sound


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
    rises = None if settings.rising else is_rising(ts)
    ts = ts if rises is None else jnp.where(rises, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    times = times_of(ts, settings)
    valid = is_valid(system, state, times.start, signals, rises)
    # What is not finite must not enter the solver, where it would spoil the gradient of what is shared. In its steps
    # what all members of a batch share remains shared, of which a kernel computes its part once.
    stepped = sound(system)
    system, state = safe(valid, (system, state))
    start = packed(state)
    signals = without_nonsense(signals, valid)
    constrained = has_configuration_constraints(system, times.start, state.q)

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
    events = events_of(system, times.start, state)
    solver, inputs = settings.solver, inputs_at(system, signals, times.start, state)
    is_native = rates_are_native(stepped, times.start, start, inputs)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field if forward else trial_rates),
        WrittenOut(solver) if is_native and isinstance(solver, diffrax.AbstractERK) else solver,
        times.start,
        times.end,
        None,
        start,
        (stepped, signals, disturbance),
        stepsize_controller=controller_of(times, vector_field, events, system, signals, settings),
        **keeping(ts, settings.adjoint, anew=settings.progress),
        max_steps=settings.max_steps,
        progress_meter=diffrax.TqdmProgressMeter() if settings.progress else diffrax.NoProgressMeter(),
        throw=False,
    )
    at, states = cast(Any, (solution.ts, solution.ys))
    (t_reached, t_last), (motion, last) = jax.lax.stop_gradient(at), states
    reached, t_end, end = jnp.isfinite(t_reached) & valid, t_last[0], last[0]

    which = cast(Any, solution.controller_state).which.astype(int)
    status = jnp.where(valid, _status(solution, which, events), Status.INVALID).astype(jnp.int32)
    smooth = status == Status.COMPLETED
    t_end = jnp.where(smooth, times.end, jnp.where(valid, t_end, times.start))
    if events.names:
        happened = status >= Status.EVENT
        beside = jax.tree.map(lambda x, first: jnp.where(happened, x, first), (t_end, end), (times.start, start))
        moving = lambda t, y: vector_field(t, y, (stepped, signals, disturbance))  # noqa: E731
        found = at_zero(stepped, beside[0], beside[1], jnp.maximum(which, 0), happened, moving, times.beside, events)
        t_end, end = jax.tree.map(lambda x, y: jnp.where(happened, x, y), (found.t, found.y), (t_end, end))
        smooth |= happened & found.smooth
        # The last step ends a little beside the event: samples from there to here are those of the event itself.
        late = happened & ~reached & (ts <= t_end + times.here)
        reached = jnp.where(happened, ts <= t_end + times.here, reached)
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
    u_dep = jax.vmap(lambda t, y: _dependent_speeds_of(system, t, y))(ts, motion)
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


def inputs_at(system: System, signals: Any, t: Component, state: State, all_of_them: bool = False):
    """The inputs by name, at one time: all, or those that are given."""
    values = evaluate(signals, t, Now(state.q, state.u, state.x, t, system))
    names = checked_inputs(system, values) if all_of_them else values
    return {name: jnp.asarray(values.get(name, 0.0), dtype=state.q.dtype) for name in names}


@fused
def _dependent_speeds_of(system: System, t: Array, y: Array) -> Array:
    state = unpacked(system, y)
    return as_vector(Instant(system, t, state.q, state.u).u_dep, y)


def _status(solution: diffrax.Solution, which: Array, events: Events) -> Array:
    result = solution.result
    status = jnp.where(result == diffrax.RESULTS.successful, Status.COMPLETED, Status.STEP_TOO_SMALL)
    status = jnp.where(result == diffrax.RESULTS.max_steps_reached, Status.MAX_STEPS, status)
    unmoved = (status == Status.STEP_TOO_SMALL) & (solution.stats["num_accepted_steps"] == 0)
    status = jnp.where(unmoved, Status.NO_SOLUTION, status)
    stopped = jnp.where(which < len(events.names), Status.EVENT + which, Status.SINGULAR_SPEEDS)
    stopped = jnp.where(which < 0, Status.COMPLETED, stopped)
    return jnp.where(result == diffrax.RESULTS.event_occurred, stopped, status)
