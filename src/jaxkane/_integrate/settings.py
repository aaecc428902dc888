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
"""All mean the same: every simulation supports both modes. The last three were necessary in earlier versions."""

_ADJOINT = f"`adjoint` must be one of {', '.join(ADJOINTS)}, or an adjoint of diffrax; got {{!r}}."


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
    def controls_tangents(self) -> bool:
        """Whether the errors of tangents are controlled: not with fixed steps, nor in the loop of diffrax."""
        has_one_term = self.solver.term_structure is diffrax.AbstractTerm
        return self.adjoint is None and self.step is None and self.controller is None and has_one_term

    @property
    def is_forward(self) -> bool:
        """Whether only forward mode is supported."""
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
    _check_types(solver, adjoint, controller, project=project, progress=progress)
    method: Any = diffrax.Tsit5() if solver is None else solver
    if step is not None and not (rtol is None and atol is None and max_step is None and controller is None):
        raise ValueError(
            "Pass either `step` (fixed step size) or `rtol`, `atol`, `max_step`, `controller` (adaptive), not both."
        )
    if step is None and controller is None and not isinstance(method, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            f"{type(method).__name__} has no error estimate, so the step size cannot be adapted. Pass a fixed step, "
            "e.g. step=1e-3."
        )
    default = 1e-8 if getattr(dtype, "dtype", dtype) == jnp.float64 else 1e-5
    if step is not None:
        method = _for_one_length(method, default)
    if controller is not None and not (rtol is None and atol is None):
        raise ValueError("Pass either `controller` or `rtol` and `atol`: the controller has its own tolerances.")
    if isinstance(controller, diffrax.ConstantStepSize | diffrax.StepTo):
        raise ValueError(f"controller={type(controller).__name__}(...) has fixed steps. Pass `step`, e.g. step=1e-3.")
    if isinstance(adjoint, diffrax.ImplicitAdjoint):
        raise ValueError("adjoint=ImplicitAdjoint() differentiates a steady state, not a simulation. Omit it.")
    for label, number in (("rtol", rtol), ("atol", atol), ("step", step), ("max_step", max_step)):
        if number is not None and not isinstance(number, Tracer):
            _check_number(label, number, lambda x: x > 0, "positive and finite")
    _check_number("stabilize", stabilize, lambda x: x >= 0, "a finite, nonnegative rate [1/s]")
    if max_steps is not None:
        _check_number("max_steps", max_steps, lambda x: x >= 1 and x == int(x), "a positive whole number")
    _check_number("max_jumps", max_jumps, lambda x: x >= 1 and x == int(x), "a positive whole number")
    tolerances = {"rtol": rtol, "atol": atol}
    given = {name: getattr(controller, name, default) if x is None else x for name, x in tolerances.items()}
    return Settings(
        rtol=float(given["rtol"]),
        atol=float(given["atol"]),
        solver=method,
        step=step,
        max_step=max_step,
        controller=controller,
        adjoint=None if isinstance(adjoint, str) else _whole_adjoint(adjoint, **given),
        max_steps=None if max_steps is None else int(max_steps),
        max_jumps=int(max_jumps),
        progress=progress,
        project=project,
        stabilize=float(stabilize),
        rising=rising,
        check_bodies=check_bodies,
    )


def _whole_adjoint(adjoint: Any, rtol: Any, atol: Any) -> Any:
    """The adjoint. `BacksolveAdjoint` without options gets a solver and a controller for its backward pass."""
    if not isinstance(adjoint, diffrax.BacksolveAdjoint) or adjoint.kwargs:
        return adjoint
    control = diffrax.PIDController(rtol=rtol, atol=atol)
    return diffrax.BacksolveAdjoint(solver=diffrax.Tsit5(), stepsize_controller=control)


def _for_one_length(solver: Any, tolerance: float) -> Any:
    """An implicit solver for fixed steps, whose equations are solved by Newton's method. The default method of diffrax
    stops if it converges slowly, and relies on a shorter step."""
    newton = {"root_finder": optx.Newton(rtol=tolerance, atol=tolerance), "root_find_max_steps": 50}

    def changes(method: Any) -> dict[str, Any]:
        return {name: x for name, x in newton.items() if hasattr(method, name)} if _takes_tolerances(method) else {}

    return _changed(solver, changes)


def with_tolerances(solver: Any, rtol: Any, atol: Any) -> Any:
    """An implicit solver whose equations are solved with the tolerances of the steps. Other solvers do not change."""
    of_steps = {"rtol": rtol, "atol": atol, "norm": optx.rms_norm}

    def changes(method: Any) -> dict[str, Any]:
        if not _takes_tolerances(method):
            return {}
        return {"root_finder": dataclasses.replace(method.root_finder, **of_steps)}

    return _changed(solver, changes)


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


def _check_types(solver: Any, adjoint: Any, controller: Any, **flags: Any) -> None:
    if isinstance(adjoint, str):
        if adjoint not in ADJOINTS:
            raise ValueError(_ADJOINT.format(adjoint))
        adjoint = None
    elif adjoint is None:
        raise TypeError(_ADJOINT.format(adjoint))
    for label, value, kind, example in (
        ("solver", solver, diffrax.AbstractSolver, "diffrax.Tsit5()"),
        ("adjoint", adjoint, diffrax.AbstractAdjoint, ""),
        ("controller", controller, diffrax.AbstractStepSizeController, "diffrax.PIDController(rtol=1e-6, atol=1e-6)"),
    ):
        if isinstance(value, type) and issubclass(value, kind):
            raise TypeError(f"`{label}` must be an instance, not a class: {label}=diffrax.{value.__name__}().")
        if value is not None and not isinstance(value, kind):
            expected = f"`{label}` must be a {label} of diffrax, e.g. {example}; got {value!r}."
            raise TypeError(expected if example else _ADJOINT.format(value))
    terms = diffrax.AbstractTerm if solver is None else solver.term_structure
    if terms is not diffrax.AbstractTerm and not isinstance(solver, diffrax.AbstractImplicitSolver):
        raise TypeError(
            f"{type(solver).__name__} needs several terms, but Kane's equations are one term. Use a solver of one "
            "term, e.g. diffrax.Tsit5(), or diffrax.Kvaerno5() for stiff equations."
        )
    for label, value in flags.items():
        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"`{label}` must be True or False, got {value!r}.")


def _check_number(label: str, value: Any, is_allowed: Callable[[float], bool], allowed: str) -> None:
    try:
        number = math.nan if isinstance(value, (bool, np.bool_, str)) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and is_allowed(number)):
        raise ValueError(f"`{label}` must be {allowed}; got {value!r}.")


def with_array_tolerances(settings: Settings, dtype: DTypeLike) -> Settings:
    """The same with arrays as tolerances and step, so that other values do not cause a recompilation."""

    def array(x: Any) -> Any:
        # Convert a number by NumPy, which compiles nothing.
        return x.astype(dtype) if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype))

    values = {name: getattr(settings, name) for name in ("rtol", "atol", "step", "max_step")}
    return dataclasses.replace(settings, **{name: x if x is None else array(x) for name, x in values.items()})
