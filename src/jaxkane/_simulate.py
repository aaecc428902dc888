"""Integration in time. The only file that sees diffrax; knows the method and no mechanism."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ._check import (
    check_state,
    check_system,
    configuration_residual,
    configuration_tolerance,
    is_concrete,
    with_possible_bodies,
)
from ._diagnose import diagnosis
from ._drift import correction, has_configuration_constraints, projected
from ._equations import dependent_speeds
from ._fuse import fused
from ._kane import Instant, by_names, checked_inputs, refuse_incomplete
from ._kinks import ToKinks
from ._linear import as_vector, determinant
from ._lookup import not_there
from ._rates import state_rates
from ._reads import compiled
from ._signals import as_signals, evaluate, sample_times
from ._system import State, System, parameter_info
from ._trajectory import Status, Trajectory
from ._types import Component, Inputs
from ._units import units_of

ADJOINTS = {
    "auto": diffrax.RecursiveCheckpointAdjoint,
    "reverse": diffrax.RecursiveCheckpointAdjoint,
    "forward": diffrax.ForwardMode,
    "both": diffrax.DirectAdjoint,
}


class Now(eqx.Module):
    """What an input function receives: `state.q`, `state.u`, and any coordinate or speed by name."""

    q: Array
    u: Array
    t: Any
    system: System

    def __getitem__(self, name: str) -> Component:
        system = self.system
        for names, values in ((system.coordinates, self.q), (system.speeds, self.u)):
            if name in names:
                return values[names.index(name)]
        if name in system.dependent_speeds:
            now = Instant(system, self.t, self.q, self.u)
            return jnp.asarray(now.u_dep[system.dependent_speeds.index(name)])
        raise not_there(name, (*system.coordinates, *system.speeds, *system.dependent_speeds), "the state")


def simulate(
    system: System,
    state: State,
    ts: Any,
    inputs: Inputs = None,
    *,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    step: float | None = None,
    project: bool = False,
    stabilize: float = 0.0,
    adjoint: Literal["auto", "reverse", "forward", "both"] | diffrax.AbstractAdjoint = "auto",
    max_steps: int = 16384,
    progress: bool = False,
) -> Trajectory:
    """The motion from a state, at given times.

        M u_dot = f,  q_dot = q_dot(t, q, u)

    **Arguments:**

    - `system`; `state`: coordinates and independent speeds at `ts[0]`, as `assemble` gives them.
    - `ts` (n_t,): increasing times [s] at which the motion is kept; it starts at `ts[0]`.
    - `inputs`: by name a number, samples (n_t,) at `ts`, or a function (t, state) -> number in which `state["roll"]`
        is any coordinate or speed; or one function (t, state) -> dict, a controller. Those left out are zero.
    - `rtol`, `atol`: error tolerances of a step; by default 1e-8 in float64 and 1e-5 in float32.
    - `solver`: any diffrax solver, by default `Tsit5`. `step`: a fixed step [s] instead of error control.
    - `project`: move the coordinates that are kept to the nearest that meet the configuration constraints. The
        integration itself does not see it; dependent speeds are those of the projected coordinates.
    - `stabilize`: a rate [1/s] at which the residuals h of the configuration constraints are led back to zero while
        integrating, h_dot = -stabilize * h; some 10 for seconds of motion. 0.0 lets them drift, by the solver's error.
    - `adjoint`: how the motion will be differentiated. "reverse": `jax.grad`, `jax.vjp`; "forward": `jax.jvp`,
        `jax.jacfwd`, and nested for Hessians, cheaper for fewer than about fifty parameters; "both" is slower; or a
        diffrax adjoint. "auto" (default) is reverse, or forward where a `jax.jvp` or `jax.jacfwd` is under way. The
        trajectory says which it was.
    - `max_steps`: of the solver. `progress`: show a progress bar.

    **Returns:** a `Trajectory`. A motion that cannot go on ends early, with its reason in `status`.

    **Raises:** `ValueError` for wrong shapes or times, an unknown input, coordinates that violate a constraint, a
    description that contradicts itself, or equations without a finite solution at the first state.
    """
    state = checked_state(system, state)
    ts = checked_times(ts, state.q.dtype)
    signals = as_signals(inputs, system.inputs, ts, type(system).__name__)
    check_state(system, ts[0], state.q)
    check_system(system, ts[0], state.q)
    if not is_concrete(system):
        state = with_possible_bodies(system, ts[0], state)
    settings = settings_for(
        ts,
        rtol=rtol,
        atol=atol,
        solver=solver,
        step=step,
        project=project,
        stabilize=stabilize,
        adjoint=adjoint,
        max_steps=max_steps,
        progress=progress,
    )
    try:
        ride = solve(system, state, ts, signals, settings)
    except TypeError as error:  # as JAX says, too, that a derivative forward through the reverse adjoint is asked for
        if adjoint != "auto":
            raise
        try:
            ride = solve(system, state, ts, signals, dataclasses.replace(settings, adjoint=ADJOINTS["forward"]()))
        except TypeError:
            raise error from None
    if is_concrete(ride.status) and ride.status == Status.NO_SOLUTION:
        inputs_now = _inputs(system, signals, ts[0], state.q, state.u)
        raise ValueError(
            diagnosis(system, ts[0], state.q, state.u, inputs_now) or _UNSOLVED.format(type(system).__name__)
        )
    return ride


_UNSOLVED = "{}: the solver cannot take a first step: accelerations or rates are not finite beside the first state."


class Settings(eqx.Module):
    """How to integrate: what `simulate` was told, with its defaults filled in."""

    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    solver: diffrax.AbstractSolver
    step: Any  # a number, or an array where it may change without another compilation
    adjoint: diffrax.AbstractAdjoint
    max_steps: int | None = eqx.field(static=True)  # None: as many as it takes
    progress: bool = eqx.field(static=True)
    project: bool = eqx.field(static=True)
    stabilize: float = eqx.field(static=True)


def settings_for(
    ts: Array,
    *,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    step: float | None = None,
    project: bool = False,
    stabilize: float = 0.0,
    adjoint: str | diffrax.AbstractAdjoint = "auto",
    max_steps: int | None = 16384,
    progress: bool = False,
) -> Settings:
    """The options of `simulate`, with defaults that follow the type of the times."""
    default = 1e-8 if ts.dtype == jnp.float64 else 1e-5
    if isinstance(adjoint, str) and adjoint not in ADJOINTS:
        raise ValueError(f"adjoint is one of {', '.join(ADJOINTS)}, or a diffrax adjoint; got {adjoint!r}.")
    return Settings(
        rtol=default if rtol is None else rtol,
        atol=default if atol is None else atol,
        solver=diffrax.Tsit5() if solver is None else solver,
        step=step,
        adjoint=ADJOINTS[adjoint]() if isinstance(adjoint, str) else adjoint,
        max_steps=max_steps,
        progress=progress,
        project=project,
        stabilize=float(stabilize),
    )


@compiled
def solve(system: System, state: State, ts: Array, signals: Any, settings: Settings) -> Trajectory:
    """`simulate` without its checks: one compiled program."""
    valid = _is_valid(system, state, ts[0])
    # What is not finite must not enter the solver, where it would spoil the gradient of what is shared.
    system, state = jax.tree.map(
        lambda x: jnp.where(valid, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x, (system, state)
    )

    constrained = has_configuration_constraints(system, ts[0], state.q)

    def vector_field(t, y, args):
        system, signals = args
        q, u = y
        q_dot, u_dot = state_rates(system, t, q, u, _inputs(system, signals, t, q, u))
        if constrained and settings.stabilize:
            q_dot = q_dot + settings.stabilize * correction(system, t, q)
        return tuple(jnp.where(valid, rate, jnp.zeros_like(rate)) for rate in (q_dot, u_dot))

    # A first step, right or wrong by a factor of ten, spares the two more copies of the right-hand side that diffrax
    # would compile to choose one.
    # A fixed step is spread evenly over the whole time: a rounding error must not make it one step more, after which no
    # step would end where a sample of an input stands.
    several = 1.0 + jnp.finfo(ts.dtype).eps ** 0.5
    step = jnp.minimum((ts[-1] - ts[0]) / 1000, ts[1] - ts[0]) if settings.step is None else several * settings.step
    if settings.step is None:
        smallest = 1e3 * jnp.finfo(ts.dtype).eps * (ts[-1] - ts[0])
        controller = diffrax.PIDController(rtol=settings.rtol, atol=settings.atol, dtmin=smallest, force_dtmin=False)
        kinks = sample_times(signals)
        if kinks is not None:
            controller = ToKinks(controller, kinks)
    else:
        controller = diffrax.ConstantStepSize()
    at_times = diffrax.SubSaveAt(ts=ts)
    at_end = diffrax.SubSaveAt(t1=True)
    stops = _stops(system, ts[0], state)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field),
        settings.solver,
        ts[0],
        ts[-1],
        step,
        (state.q, state.u),
        (system, signals),
        saveat=diffrax.SaveAt(subs=(at_times, at_end)),
        stepsize_controller=controller,
        adjoint=settings.adjoint,
        event=diffrax.Event(stops) if stops else None,
        max_steps=settings.max_steps,
        progress_meter=diffrax.TqdmProgressMeter() if settings.progress else diffrax.NoProgressMeter(),
        throw=False,
    )
    times, states = cast(Any, (solution.ts, solution.ys))
    (t_reached, t_end), ((q, u), _) = times, states
    reached = (jnp.isfinite(t_reached) & valid)[:, None]
    if constrained and settings.project:
        q = jnp.where(reached, q, state.q)  # what is not finite must not enter the projection either
        q = jax.vmap(lambda t, q: projected(system, t, q))(ts, q)
    q, u = (jnp.where(reached, y, jnp.nan) for y in (q, u))
    return Trajectory(
        t=ts,
        q=q,
        u=u,
        u_dep=jax.vmap(lambda t, q, u: dependent_speeds(system, t, q, u))(ts, q, u),
        inputs=jax.vmap(lambda t, q, u: _inputs(system, signals, t, q, u, all_of_them=True))(ts, q, u),
        status=jnp.where(valid, _status(solution, stops), Status.INVALID).astype(jnp.int32),
        t_end=jnp.where(valid, t_end[0], ts[0]),
        stats={
            "steps": solution.stats["num_steps"],
            "accepted": solution.stats["num_accepted_steps"],
            "rejected": solution.stats["num_rejected_steps"],
        },
        names=(tuple(system.coordinates), tuple(system.speeds), tuple(system.dependent_speeds)),
        events=tuple(name for name in stops if name != _SINGULAR),
        adjoint=type(settings.adjoint).__name__,
        units=tuple(units_of(system).items()),
    )


@fused
def _determinant(system: System, t: Component, q: Array, u: Array) -> Array:
    """det C_dep: where it vanishes, the dependent speeds no longer follow from the independent ones."""
    return as_vector([determinant(Instant(system, t, q, u).C_dep)], q)[0]


def _inputs(system: System, signals: Any, t: Component, q: Array, u: Array, all_of_them: bool = False):
    values = evaluate(signals, t, Now(q, u, t, system))
    names = checked_inputs(system, values) if all_of_them else values
    return {name: jnp.asarray(values.get(name, 0.0), dtype=q.dtype) for name in names}


def _is_valid(system: System, state: State, t0: Array) -> Array:
    finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, state)) if eqx.is_inexact_array(x)]
    positive = [jnp.all(getattr(system, name) > 0) for name, info in parameter_info(system).items() if info.positive]
    residual = configuration_residual(system, t0, state.q)
    consistent = jnp.all(jnp.abs(residual) <= configuration_tolerance(residual.dtype))
    return jnp.all(jnp.stack([*finite, *positive, consistent]))


_SINGULAR = "dependent speeds singular"


def _stops(system: System, t0: Array, state: State) -> dict[str, Any]:
    """Signed, smooth quantities (t, y, args) whose change of sign ends the simulation."""
    names = jax.eval_shape(_events, system, t0, state.q, state.u)
    stops: dict[str, Any] = {}
    for name in names:
        stops[name] = lambda t, y, args, name=name, **_: _event(name)(*_unmoved(args[0], t, *y))
    if system.dependent_speeds:
        stops[_SINGULAR] = lambda t, y, args, **_: _determinant(*_unmoved(args[0], t, *y))
    return stops


def _unmoved(*now: Any) -> Any:
    # A simulation ends between two steps: what ends it has no derivative, and compiling one would take its time.
    return jax.lax.stop_gradient(now)


def _events(system: System, t: Component, q: Array, u: Array) -> dict[str, Array]:
    now = Instant(system, t, q, u)
    return {name: jnp.asarray(value, dtype=q.dtype) for name, value in system.events(t, now.q, now.u_all).items()}


@functools.cache
def _event(name: str) -> Any:
    return fused(lambda *now: _events(*now)[name])


def _status(solution: diffrax.Solution, stops: dict[str, Any]) -> Array:
    result = solution.result
    status = jnp.where(result == diffrax.RESULTS.successful, Status.COMPLETED, Status.STEP_TOO_SMALL)
    status = jnp.where(result == diffrax.RESULTS.max_steps_reached, Status.MAX_STEPS, status)
    unmoved = (status == Status.STEP_TOO_SMALL) & (solution.stats["num_accepted_steps"] == 0)
    status = jnp.where(unmoved, Status.NO_SOLUTION, status)
    if stops:
        names = [name for name in stops if name != _SINGULAR]
        for name, happened in (solution.event_mask or {}).items():
            code = Status.SINGULAR_SPEEDS if name == _SINGULAR else Status.EVENT + names.index(name)
            status = jnp.where((result == diffrax.RESULTS.event_occurred) & happened, code, status)
    return status


def checked_times(ts: Any, dtype: Any) -> Array:
    """Times as an array of a state's type. **Raises:** `ValueError` unless finite, increasing, and two at least."""
    ts = jnp.asarray(ts, dtype=dtype)
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(f"`ts` must be at least two times in an array of shape (n_t,), got the shape {ts.shape}.")
    if not isinstance(ts, Tracer):
        steps: Any = np.diff(np.asarray(ts))
        if not np.all(np.isfinite(steps)):
            raise ValueError("`ts` holds times that are not finite.")
        if not np.all(steps > 0):
            i = int(np.argmax(steps <= 0))
            raise ValueError(f"`ts` must increase: ts[{i}] = {float(ts[i]):.6g} is followed by {float(ts[i + 1]):.6g}.")
    return ts


def checked_state(system: System, state: Any) -> State:
    """A state of the right shape for a system."""
    name = type(system).__name__
    if not isinstance(state, State):
        raise TypeError(
            f"{name}: the state must be a jaxkane.State(q, u), as assemble gives it; got {type(state).__name__}."
        )
    state = as_state(system, state)
    for label, value, names in (("q", state.q, system.coordinates), ("u", state.u, system.speeds)):
        if value.shape != (len(names),):
            raise ValueError(
                f"{name}: state.{label} must have the shape ({len(names)},) for {', '.join(names)}; got {value.shape}."
                + (" For a batch use jaxkane.sweep or jax.vmap." if value.ndim > 1 else "")
            )
    return state


def as_state(system: System, state: State) -> State:
    """A state in arrays, of one in dicts by name. Coordinates and speeds that are left out are zero.

    **Raises:** `ValueError` for an unknown name, a dependent coordinate left out, a dependent speed that is named.
    """
    refuse_incomplete(system, state.q, state.u)
    title = type(system).__name__
    q, u = (
        by_names(values, names, f"{title}: state.{label}") if isinstance(values, Mapping) else values
        for label, values, names in (("q", state.q, system.coordinates), ("u", state.u, system.speeds))
    )
    for label, values in (("q", q), ("u", u)):
        if not hasattr(values, "shape"):
            raise TypeError(f"{title}: state.{label} is an array of numbers, or a dict by name; got {values!r}.")
    return State(q, u.astype(q.dtype) if isinstance(state.u, Mapping) else u)
