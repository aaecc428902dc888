"""The options of `simulate`, and their checks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import DTypeLike

from .._scalarjit.compat import Tracer

ADJOINTS = "auto", "reverse", "forward", "both"
"""All four mean the same, because every simulation supports both modes. The last three are from earlier versions."""


class Settings(eqx.Module):
    """The options of `simulate`, with their defaults filled in.

    Attributes:

    - `rtol`, `atol`, `step`, `max_step`: numbers, or arrays if they may change without recompilation.
    - `adjoint`: None for an operation with derivatives of its own (see `with_own_tangents`).
    - `max_steps`: None for an unlimited number.
    - `rising`: whether the times were already checked to increase.
    - `check_bodies`: whether a simulation of bodies with an impossible inertia is invalid.
    - All others: see `simulate`.
    """

    rtol: Any
    atol: Any
    solver: diffrax.AbstractSolver
    step: Any
    max_step: Any
    controller: diffrax.AbstractStepSizeController | None
    adjoint: diffrax.AbstractAdjoint | None
    max_steps: int | None = eqx.field(static=True)
    max_jumps: int = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    project: bool = eqx.field(static=True)
    stabilize: float = eqx.field(static=True)
    rising: bool = eqx.field(static=True, default=False)
    check_bodies: bool = eqx.field(static=True, default=False)

    @property
    def is_forward(self) -> bool:
        return isinstance(self.adjoint, diffrax.ForwardMode)


def settings_for(
    dtype: DTypeLike,
    *,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    step: float | None = None,
    max_step: float | None = None,
    controller: diffrax.AbstractStepSizeController | None = None,
    project: bool = False,
    stabilize: float = 0.0,
    adjoint: str | diffrax.AbstractAdjoint = "auto",
    max_steps: int | None = 16384,
    max_jumps: int = 64,
    progress: bool = False,
    rising: bool = False,
    check_bodies: bool = False,
) -> Settings:
    """The options of `simulate`. The default tolerances depend on `dtype`, the type of the state or an array of it.

    **Raises:** `ValueError` or `TypeError` for invalid or contradictory options.
    """
    for label, flag in (("project", project), ("progress", progress)):
        _check_kind(label, flag, (bool, np.bool_), "True or False", may_be_omitted=False)
    _check_kind("solver", solver, diffrax.AbstractSolver, "a solver of diffrax, e.g. diffrax.Tsit5()")
    controllers = "a controller of diffrax, e.g. diffrax.PIDController(rtol=1e-6, atol=1e-6)"
    _check_kind("controller", controller, diffrax.AbstractStepSizeController, controllers)
    adjoints = f"one of {', '.join(ADJOINTS)}, or an adjoint of diffrax"
    if isinstance(adjoint, str) and adjoint not in ADJOINTS:
        raise ValueError(f"`adjoint` must be {adjoints}; got {adjoint!r}.")
    _check_kind("adjoint", adjoint, (str, diffrax.AbstractAdjoint), adjoints, may_be_omitted=False)
    method: Any = diffrax.Tsit5() if solver is None else solver
    name, is_adaptive = type(method).__name__, isinstance(method, diffrax.AbstractAdaptiveSolver)
    if method.term_structure is not diffrax.AbstractTerm and not isinstance(method, diffrax.AbstractImplicitSolver):
        raise TypeError(
            f"{name} needs several terms, but Kane's equations are one term. Use a solver of one term, e.g. "
            "diffrax.Tsit5(), or diffrax.Kvaerno5() for stiff equations."
        )
    for is_contradictory, message in (
        (
            step is not None and not (rtol is None and atol is None and max_step is None and controller is None),
            "Pass either `step` (fixed step size) or `rtol`, `atol`, `max_step`, `controller` (adaptive), not both.",
        ),
        (
            step is None and controller is None and not is_adaptive,
            f"{name} has no error estimate, so the step size cannot be adapted. Pass a fixed step, e.g. step=1e-3.",
        ),
        (
            controller is not None and not (rtol is None and atol is None),
            "Pass either `controller` or `rtol` and `atol`: the controller has its own tolerances.",
        ),
        (
            isinstance(controller, diffrax.ConstantStepSize | diffrax.StepTo),
            f"controller={type(controller).__name__}(...) has fixed steps. Pass `step`, e.g. step=1e-3.",
        ),
        (
            isinstance(adjoint, diffrax.ImplicitAdjoint),
            "adjoint=ImplicitAdjoint() differentiates a steady state, not a simulation. Omit it.",
        ),
    ):
        if is_contradictory:
            raise ValueError(message)
    default = 1e-8 if getattr(dtype, "dtype", dtype) == jnp.float64 else 1e-5
    if step is not None:
        # The default method of diffrax for implicit equations stops if it converges slowly, and relies on a shorter
        # step. Fixed steps need Newton's method.
        newton = {"root_finder": optx.Newton(rtol=default, atol=default), "root_find_max_steps": 50}
        method = _changed(
            method, lambda x: {k: v for k, v in newton.items() if hasattr(x, k)} if _takes_tolerances(x) else {}
        )
    for label, number in (("rtol", rtol), ("atol", atol), ("step", step), ("max_step", max_step)):
        if number is not None and not isinstance(number, Tracer):
            _check_number(label, number, lambda x: x > 0, "positive and finite")
    _check_number("stabilize", stabilize, lambda x: x >= 0, "a finite, nonnegative rate [1/s]")
    for label, number in (("max_steps", 1 if max_steps is None else max_steps), ("max_jumps", max_jumps)):
        _check_number(label, number, lambda x: x >= 1 and x == int(x), "a positive whole number")
    given: dict[str, Any] = {"rtol": rtol, "atol": atol}
    given = {label: float(getattr(controller, label, default) if x is None else x) for label, x in given.items()}
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and not adjoint.kwargs:
        # It needs a solver and a controller for its backward pass.
        control = diffrax.PIDController(**given)
        adjoint = diffrax.BacksolveAdjoint(solver=diffrax.Tsit5(), stepsize_controller=control)
    return Settings(
        **given,
        solver=method,
        step=step,
        max_step=max_step,
        controller=controller,
        adjoint=None if isinstance(adjoint, str) else adjoint,
        max_steps=None if max_steps is None else int(max_steps),
        max_jumps=int(max_jumps),
        progress=progress,
        project=project,
        stabilize=float(stabilize),
        rising=rising,
        check_bodies=check_bodies,
    )


def with_tolerances(solver: Any, rtol: Any, atol: Any) -> Any:
    """An implicit solver whose equations are solved with the tolerances of the steps. Other solvers do not change."""

    def changes(method: Any) -> dict[str, Any]:
        return {"root_finder": dataclasses.replace(method.root_finder, rtol=rtol, atol=atol, norm=optx.rms_norm)}

    return _changed(solver, lambda method: changes(method) if _takes_tolerances(method) else {})


def with_scan_kind(solver: Any, kind: str) -> Any:
    """A solver whose loop over its stages has derivatives in forward mode. A solver without such a loop does not
    change."""
    return _changed(solver, lambda method: {"scan_kind": kind} if getattr(method, "scan_kind", kind) is None else {})


def _takes_tolerances(method: Any) -> bool:
    """Whether a solver takes the tolerances of its equations from those of the steps."""
    of_steps = type(diffrax.with_stepsize_controller_tols(diffrax.VeryChord)().rtol)
    return isinstance(getattr(getattr(method, "root_finder", None), "rtol", None), of_steps)


def _changed(solver: Any, changes: Callable[[Any], dict[str, Any]]) -> Any:
    """The solver with other fields. For a wrapped solver, such as in `HalfSolver`, the fields of the inner one
    change."""
    if isinstance(getattr(solver, "solver", None), diffrax.AbstractSolver):
        return dataclasses.replace(solver, solver=_changed(solver.solver, changes))
    fields = changes(solver)
    return dataclasses.replace(solver, **fields) if fields else solver


def _check_kind(label: str, value: Any, kind: Any, expected: str, may_be_omitted: bool = True) -> None:
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(f"`{label}` must be an instance, not a class: {label}=diffrax.{value.__name__}().")
    if not isinstance(value, kind) and not (value is None and may_be_omitted):
        raise TypeError(f"`{label}` must be {expected}; got {value!r}.")


def _check_number(label: str, value: Any, is_allowed: Callable[[float], bool], allowed: str) -> None:
    try:
        number = math.nan if isinstance(value, (bool, np.bool_, str)) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and is_allowed(number)):
        raise ValueError(f"`{label}` must be {allowed}; got {value!r}.")


def with_array_tolerances(settings: Settings, dtype: DTypeLike) -> Settings:
    """The same with arrays as tolerances and step, so that other values do not cause a recompilation."""
    values = {name: getattr(settings, name) for name in ("rtol", "atol", "step", "max_step")}
    # Convert a number by NumPy, which compiles nothing.
    arrays = {
        name: x.astype(dtype) if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype))
        for name, x in values.items()
        if x is not None
    }
    return dataclasses.replace(settings, **arrays)
