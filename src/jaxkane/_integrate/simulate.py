"""`simulate`: it checks its arguments and passes them to `solve`. `ode_term`: the equations for diffrax."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from .._kane.api import diagnosis
from .._kane.arguments import by_names, check_is_system, is_concrete, refuse_incomplete
from .._kane.checks import check_system
from .._kane.constraint_residuals import check_state
from .._kane.contact.checks import check_contacts
from .._kane.contact.forces import layout_of
from .._kane.right_hand_side import reads_time, values_of, vector_field
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.compat import Tracer, on_device
from .._scalarjit.components import Component, Inputs, Numbers
from .._scalarjit.configure import warn_of_float32
from .._system.system import State, System, packed, unpacked
from .events import Status, events_of
from .inputs import (
    Signals,
    as_signals,
    check_finite,
    inputs_at,
    is_coarse,
    is_samples,
    share_times,
    since,
    time_array,
    times_since,
)
from .integrate import refuse_captured, solve
from .settings import settings_for, with_array_tolerances
from .trajectory import Trajectory


def simulate(
    system: System,
    state: State,
    ts: Numbers,
    inputs: Inputs = None,
    *,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    step: float | None = None,
    max_step: float | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    discontinuities: Numbers = None,
    project: bool = False,
    stabilize: float = 0.0,
    adjoint: Literal["auto", "reverse", "forward", "both"] | diffrax.AbstractAdjoint = "auto",
    max_steps: int = 16384,
    max_jumps: int = 64,
    progress: bool = False,
) -> Trajectory:
    """Simulate a system from an initial state.

        M u_dot = f,  q_dot = q_dot(t, q, u)

    **Arguments:**

    - `system`: a `System`.
    - `state`: coordinates and independent speeds at `ts[0]`, as `assemble` returns them.
    - `ts` (n_t,): increasing times [s] at which the state is saved. The simulation starts at `ts[0]`.
    - `inputs`: a dict with a number, samples (n_t,) at `ts`, or a function (t, state) -> number for each input; or one
        function (t, state) -> dict, a controller. `state["roll"]` is any coordinate or speed. Omitted inputs are zero.
    - `rtol`, `atol`: error tolerances of a step; by default 1e-8 in float64 and 1e-5 in float32.
    - `solver`: a solver of diffrax, by default `Tsit5`.
    - `step`: a fixed step size [s], instead of error control. It is reduced so that the duration is a multiple of it.
    - `max_step`: the longest step with error control [s], by default a fiftieth of the duration. Pass it if a force
        acts for a short time after a rest, or if an event function may be constant at first and then change its sign
        twice within one step. Otherwise, both may be missed.
    - `controller`: a step size controller of diffrax, such as `diffrax.PIDController(pcoeff=0.3, icoeff=0.4, ...)`,
        instead of `rtol` and `atol`. Steps still end at discontinuities and events.
    - `discontinuities` (n,): times [s] at which inputs or loads are discontinuous. Steps end there. The times of
        `Samples` are included automatically. Fixed steps end there only if these times are multiples of the step.
    - `project`: project the saved coordinates onto the configuration constraints. The integration itself does not
        change. The dependent speeds are computed at the projected coordinates.
    - `stabilize`: Baumgarte stabilization: the rate [1/s] at which the residuals h of the configuration constraints
        decay, h_dot = -stabilize * h. About 10 suits some seconds. With 0.0 the residuals drift by the solver's error.
    - `adjoint`: how the simulation is differentiated. "auto" supports forward mode (`jax.jvp`, `jax.jacfwd`) and
        reverse mode (`jax.grad`, `jax.vjp`), with steps that limit the errors of derivatives too. Forward mode can be
        nested for second derivatives. It is cheaper for fewer than about fifty parameters. "forward", "reverse" and
        "both" mean the same as "auto". An adjoint of diffrax differentiates the steps of the motion instead.
        `Trajectory.adjoint` contains the choice.
    - `max_steps`: the largest number of steps.
    - `max_jumps`: the largest number of jumps: events with `then`, see `falling`.
    - `progress`: show a progress bar.

    **Returns:** a `Trajectory`. If the simulation cannot continue, it ends early, and `status` states the reason.

    **Raises:**

    - `ValueError`: wrong shapes or times; values that are not finite; an unknown input; coordinates that violate a
        constraint; an inconsistent system; equations without a finite solution at the initial state; times
        that the type of the state cannot resolve.
    - `TypeError`: a second derivative that uses reverse mode.
    """
    refuse_captured(system)
    warn_of_float32()
    state = checked_state(system, state)
    dtype = state.q.dtype
    ts = checked_times(ts, dtype)
    signals = as_signals(inputs, system.inputs, ts, type(system).__name__)
    refuse_coarse_times(system, ts, dtype, signals)
    origin, taus = clock_of(ts, dtype)
    check_state(system, origin, state.q)
    check_system(system, origin, state.q)
    check_contacts(system, origin, state.q, may_penetrate=state.contacts is not None)
    settings = settings_for(
        dtype,
        rtol=rtol,
        atol=atol,
        solver=solver,
        step=step,
        max_step=max_step,
        controller=controller,
        project=project,
        stabilize=stabilize,
        adjoint=adjoint,
        max_steps=max_steps,
        max_jumps=max_jumps,
        progress=progress,
        rising=not isinstance(ts, Tracer),
        check_bodies=not is_concrete(system),
    )
    given = checked_discontinuities(discontinuities, first_of(ts), dtype)
    settings, relative = with_array_tolerances(settings, dtype), share_times(since(first_of(ts), signals, dtype))
    closures = captured_tracers(signals)
    # A rule for derivatives would keep the input functions alive as long as the program, which is freed with them.
    traced = not is_concrete(system, state, ts, relative, settings, given, closures)
    settings = dataclasses.replace(settings, differentiable=traced)
    trajectory = solve(system, state, origin, taus, relative, settings, given, closures=closures)
    trajectory = dataclasses.replace(trajectory, **on_clock(ts, trajectory))
    if is_concrete(trajectory.status) and int(trajectory.status) == Status.NO_SOLUTION:
        values = values_of(system, state.x, inputs_at(system, signals, origin, state))
        raise ValueError(
            diagnosis(system, origin, state.q, state.u, values)
            or f"{type(system).__name__}: the solver cannot take a first step: accelerations, rates or events are not "
            "finite near the initial state, or an implicit step has no solution. Start elsewhere, or check the loads "
            "and events there."
        )
    return trajectory


def checked_times(ts: Numbers, dtype: DTypeLike) -> Any:
    """Times as an array of a type; in float64 of NumPy if this type would blur them.

    **Raises:** `ValueError` unless there are at least two times, finite and increasing.
    """
    ts = time_array(ts, "`ts`", dtype)
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(f"`ts` must be an array (n_t,) of at least two times; got the shape {ts.shape}.")
    if not isinstance(ts, Tracer):
        steps: Any = np.diff(np.asarray(ts))
        is_wrong = ~((steps > 0) & np.isfinite(steps))
        if is_wrong.any():
            i = int(np.argmax(is_wrong))
            text = f"ts[{i}] = {float(ts[i]):.6g} is followed by {float(ts[i + 1]):.6g}"
            raise ValueError(f"`ts` must be finite and increase: {text}.")
    return ts


def clock_of(ts: Numbers, dtype: DTypeLike) -> tuple[Array, Array]:
    """The start of a simulation [s], and times (n_t,) since then.

    The start is zero for times that the type of the state cannot resolve: code that reads the time is refused there.
    """
    if isinstance(ts, Tracer):
        return ts[0], times_since(ts[0], ts, dtype)
    start = first_of(ts)
    return on_device(start if isinstance(ts, jax.Array) else 0.0, dtype), times_since(start, ts, dtype)


def first_of(ts: Numbers) -> Any:
    """The first of times that may be traced. NumPy compiles nothing for that."""
    return ts[0] if isinstance(ts, Tracer) else np.asarray(ts)[0]


def checked_discontinuities(times: Numbers, start: Component, dtype: DTypeLike) -> Array | None:
    """Times since the start of the simulation [s]. **Raises:** `ValueError` for times that are not finite."""
    if times is None:
        return None
    times = time_array(times, "`discontinuities`", dtype)
    if times.ndim != 1:
        raise ValueError(f"`discontinuities` must be an array (n,) of times; got the shape {times.shape}.")
    check_finite("`discontinuities`", times)
    return times_since(start, times, dtype)


def refuse_coarse_times(system: System, ts: Numbers, dtype: DTypeLike, signals: Signals) -> None:
    """**Raises:** `ValueError` for code that uses a time which the type of the state cannot resolve.

    The integration and samples are not affected, because they use the time since the start.
    """
    if isinstance(ts, Tracer) or not is_coarse(np.asarray(ts, np.float64), dtype):
        return
    readers = [name for name, f in ({} if callable(signals) else signals).items() if callable(f) and not is_samples(f)]
    if callable(signals):
        readers = ["the function of the inputs"]
    else:
        zeros = (jnp.zeros(len(names), dtype) for names in (system.coordinates, system.speeds))
        events = events_of(system, jnp.zeros((), dtype), State(*zeros))
        uses_time = {"": reads_time(system, dtype), ".events": events.read_time}
        readers += [type(system).__name__ + part for part, is_used in uses_time.items() if is_used]
    if readers:
        raise ValueError(
            f"`ts` starts at {float(ts[0]):.10g} s with steps down to {float(np.min(np.diff(np.asarray(ts)))):.3g} s, "
            f"which {jnp.dtype(dtype).name} cannot resolve, and {', '.join(readers)} may depend on the time. Let `ts` "
            "start near zero, or enable float64: jaxkane.configure()."
        )


def on_clock(ts: Numbers, trajectory: Trajectory) -> dict[str, Any]:
    """Times of a trajectory on the clock of `ts`: in float64 of NumPy if its own type could not resolve them."""
    if isinstance(ts, jax.Array):
        return {"t": ts}

    def on(since: Component) -> Any:  # a traced number keeps its own type
        return ts[0].astype(since.dtype) + since if isinstance(since, Tracer) else ts[0] + np.asarray(since, np.float64)

    own: dict[str, Any] = {"t": ts, "t_end": on(trajectory.t_end)}
    if trajectory.jumps is not None:
        own["jumps"] = dataclasses.replace(trajectory.jumps, t=on(trajectory.jumps.t))
    return own


def checked_state(system: System, state: object) -> State:
    """A state of the right shape for a system. In a batch, the member's status reports values that are not finite."""
    check_is_system(system)
    name = type(system).__name__
    if not isinstance(state, State):
        raise TypeError(
            f"{name}: the state must be a jaxkane.State(q, u), as returned by assemble; got {type(state).__name__}."
        )
    state = as_state(system, state)
    parts = [("q", state.q, system.coordinates), ("u", state.u, system.speeds), ("x", state.x, system.states)]
    parts.append(("contacts", state.contacts, ("the contacts",) * layout_of(system).memory_size))
    for label, value, names in parts:
        if value is not None and value.shape != (len(names),):
            listed = ", ".join(dict.fromkeys(names)) or "no names"
            raise ValueError(
                f"{name}: state.{label} must have the shape ({len(names)},) for {listed}; got {value.shape}."
                + (" For a batch use jaxkane.sweep or jax.vmap." if value.ndim > 1 else "")
            )
        if label != "contacts" and value is not None and is_concrete(value) and not np.all(np.isfinite(value)):
            i = int(np.argmin(np.isfinite(value)))
            raise ValueError(
                f"{name}: state.{label}: {names[i]} = {float(value[i])} is not finite. Pass finite initial values."
            )
    return state


def as_state(system: System, state: State) -> State:
    """A state with arrays, from a state with arrays or dicts by name. Omitted values are zero.

    **Raises:** `ValueError` for an unknown name, an omitted dependent coordinate, or a dependent speed.
    """
    refuse_incomplete(system, state.q, state.u)
    title = type(system).__name__
    x: Any = {} if state.x is None and system.states else state.x
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{title} has no first-order states, but state.x is {x!r}. Omit x.")
    parts: list[Any] = [("q", state.q, system.coordinates), ("u", state.u, system.speeds)]
    parts += [("x", x, system.states)] if system.states else []
    arrays: list[Any] = []
    for label, values, names in parts:
        if isinstance(values, Mapping):
            values = by_names(values, names, f"{title}: state.{label}")
            values = values.astype(arrays[0].dtype) if arrays else values
        if not hasattr(values, "shape"):
            raise TypeError(f"{title}: state.{label} must be an array of numbers, or a dict by name; got {values!r}.")
        arrays.append(values)
    if state.contacts is not None:
        arrays.append(state.contacts)
    floats = [x for x in arrays if jnp.issubdtype(getattr(x, "dtype", int), jnp.floating)]
    if len({x.dtype for x in floats}) > 1:  # a loop cannot carry float32 coordinates and float64 speeds
        types = [x.dtype for x in floats if x.shape[-1]]  # an empty array has the default dtype
        arrays = [x.astype(functools.reduce(np.promote_types, types)) for x in arrays]
    contacts = None if state.contacts is None else arrays.pop()
    return State(arrays[0], arrays[1], arrays[2] if system.states else None, contacts)


def ode_term(system: System, inputs: Inputs = None) -> tuple[diffrax.ODETerm, Any]:
    """The equations of motion as a term of diffrax, and the arguments to pass with it.

        term, args = jk.ode_term(system, {"push": 1.0})
        solution = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.01, state, args)
        solution.ys.q  # (1, n_q)

    The solution is a `State`. The system and the state are not checked. Steps do not end at discontinuities or events.
    Pass `stepsize_controller=diffrax.ClipStepSizeController(...)` and `event=diffrax.Event(...)`, or use `simulate`.

    **Arguments:**

    - `system`: a `System`.
    - `inputs`: a dict with a number, `Samples` or a function (t, state) -> number for each input; or one function
        (t, state) -> dict.

    **Returns:**

    - a `diffrax.ODETerm` of (t, y, args), in which y is a `State` with arrays, as from `assemble`.
    - args: the system and its inputs. Solutions can be differentiated with respect to them.

    **Raises:** `ValueError` for an unknown input, or for an array of samples without times.
    """
    check_is_system(system)
    no_times: Any = np.zeros(0)
    signals = as_signals(inputs, system.inputs, no_times, type(system).__name__)

    def rates(t: Component, y: State, args: tuple[System, Signals]) -> State:
        system, signals = args
        t = jnp.asarray(t, y.q.dtype)
        return unpacked(system, vector_field(system, t, packed(y), inputs_at(system, signals, t, y)))

    return diffrax.ODETerm(rates), (system, signals)  # pyright: ignore[reportArgumentType]
