"""`simulate`: what is asked for, checked, and integrated by `ride`. Knows neither mechanisms nor solvers."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import diffrax
import numpy as np

from .._kane.arguments import is_concrete
from .._kane.checks import check_system, with_possible_bodies
from .._kane.constraints import check_state
from .._kane.equations import diagnosis
from .._kane.rhs import values_of
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.compat import Tracer, nothing_is_traced
from .._scalarjit.components import Inputs
from .._system.system import State, System
from .inputs import as_signals, with_one_times
from .integrate import inputs_at, refuse_captured, solve
from .settings import ADJOINTS, checked_state, checked_times, in_its_mode, of_any_accuracy, settings_for
from .trajectory import Status, Trajectory


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
    if not is_concrete(system):
        state = with_possible_bodies(system, t, state)
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
    )
    given = (system, state, ts, with_one_times(signals)), captured_tracers(signals)
    settings, (parts, closures) = in_its_mode(settings, adjoint, given)
    name_of_adjoint = type(settings.adjoint).__name__
    if nothing_is_traced() and isinstance(settings.adjoint, ADJOINTS["reverse"]):
        # A motion that nobody can differentiate is compiled without what its derivative would need: the same numbers.
        settings = dataclasses.replace(settings, adjoint=ADJOINTS["forward"]())
    ride = solve(*parts, of_any_accuracy(settings, ts.dtype), closures=closures)
    ride = dataclasses.replace(ride, adjoint=name_of_adjoint)
    if is_concrete(ride.status) and int(ride.status) == Status.NO_SOLUTION:
        inputs_now = values_of(system, state.x, inputs_at(system, signals, ts[0], state))
        raise ValueError(
            diagnosis(system, ts[0], state.q, state.u, inputs_now) or _UNSOLVED.format(type(system).__name__)
        )
    return ride


_UNSOLVED = (
    "{}: the solver cannot take a first step: accelerations, rates or events are not finite beside the first state."
)
