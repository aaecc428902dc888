"""`simulate`: its arguments, checked, and the motion that `solve` makes of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import diffrax
import numpy as np
from jaxtyping import Array

from .._kane.arguments import by_names, check_is_system, is_concrete, refuse_incomplete
from .._kane.checks import check_system
from .._kane.constraints import check_state
from .._kane.equations import diagnosis
from .._kane.rhs import values_of
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Inputs
from .._system.system import State, System
from .inputs import as_signals, inputs_at, real_array, share_times
from .integrate import refuse_captured, solve
from .settings import resolve_adjoint, settings_for, with_array_tolerances, without_derivatives
from .status import Status
from .trajectory import Trajectory


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
    description that contradicts itself, or equations without a finite solution at the first state. `TypeError` for a
    derivative in forward mode through a motion for reverse mode, as in `jax.jacfwd(jax.jit(f))` with "auto".
    """
    refuse_captured(system)
    state = checked_state(system, state)
    ts = checked_times(ts, state.q.dtype)
    signals = as_signals(inputs, system.inputs, ts, type(system).__name__)
    t = ts[0] if isinstance(ts, Tracer) else np.asarray(ts)[0]
    check_state(system, t, state.q)
    check_system(system, t, state.q)
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
        rising=not isinstance(ts, Tracer),
        check_bodies=not is_concrete(system),
    )
    arguments = (system, state, ts, share_times(signals)), captured_tracers(signals)
    settings, (arguments, closures) = resolve_adjoint(settings, adjoint, arguments)
    name_of_adjoint = type(settings.adjoint).__name__
    settings = with_array_tolerances(without_derivatives(settings), ts.dtype)
    trajectory = solve(*arguments, settings, closures=closures)
    trajectory = dataclasses.replace(trajectory, adjoint=name_of_adjoint)
    if is_concrete(trajectory.status) and int(trajectory.status) == Status.NO_SOLUTION:
        values = values_of(system, state.x, inputs_at(system, signals, ts[0], state))
        raise ValueError(
            diagnosis(system, ts[0], state.q, state.u, values)
            or f"{type(system).__name__}: the solver cannot take a first step: accelerations, rates or events are not "
            "finite beside the first state, or an implicit step has no solution."
        )
    return trajectory


def checked_times(ts: Any, dtype: Any) -> Array:
    """Times as an array of a state's type. **Raises:** `ValueError` unless finite, increasing, and two at least."""
    ts = real_array(ts, "`ts`", dtype)
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
    check_is_system(system)
    name = type(system).__name__
    if not isinstance(state, State):
        raise TypeError(
            f"{name}: the state must be a jaxkane.State(q, u), as assemble gives it; got {type(state).__name__}."
        )
    state = as_state(system, state)
    parts = [("q", state.q, system.coordinates), ("u", state.u, system.speeds), ("x", state.x, system.states)]
    for label, value, names in parts:
        if value is not None and value.shape != (len(names),):
            raise ValueError(
                f"{name}: state.{label} must have the shape ({len(names)},) for {', '.join(names)}; got {value.shape}."
                + (" For a batch use jaxkane.sweep or jax.vmap." if value.ndim > 1 else "")
            )
    return state


def as_state(system: System, state: State) -> State:
    """A state in arrays, of one in dicts by name. What is left out is zero.

    **Raises:** `ValueError` for an unknown name, a dependent coordinate left out, a dependent speed that is named.
    """
    refuse_incomplete(system, state.q, state.u)
    title = type(system).__name__
    x: Any = {} if state.x is None and system.states else state.x
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{title} has no states of the first order, but state.x is {x!r}.")
    parts: list[Any] = [("q", state.q, system.coordinates), ("u", state.u, system.speeds)]
    parts += [("x", x, system.states)] if system.states else []
    arrays: list[Any] = []
    for label, values, names in parts:
        if isinstance(values, Mapping):
            values = by_names(values, names, f"{title}: state.{label}")
            values = values.astype(arrays[0].dtype) if arrays else values
        if not hasattr(values, "shape"):
            raise TypeError(f"{title}: state.{label} is an array of numbers, or a dict by name; got {values!r}.")
        arrays.append(values)
    return State(*arrays)
