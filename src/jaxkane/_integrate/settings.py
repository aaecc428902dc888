"""The options of `simulate` and their checks; solvers with unrolled stages and one-sided look-up of inputs."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from .._scalarjit.compat import Tracer
from .._scalarjit.components import Bool, Component
from .inputs import RateArguments

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
    - `differentiable`: False if no number of the simulation is traced. Its program then has no rule for derivatives.
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
    differentiable: bool = eqx.field(static=True, default=True)

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


def with_tolerances(solver: diffrax.AbstractSolver, rtol: Array | float, atol: Array | float) -> Any:
    """An implicit solver whose equations are solved with the tolerances of the steps. Other solvers do not change."""

    def changes(method: Any) -> dict[str, Any]:
        return {"root_finder": dataclasses.replace(method.root_finder, rtol=rtol, atol=atol, norm=optx.rms_norm)}

    return _changed(solver, lambda method: changes(method) if _takes_tolerances(method) else {})


def with_scan_kind(solver: diffrax.AbstractSolver, kind: str) -> Any:
    """A solver whose loop over its stages has derivatives in forward mode. A solver without such a loop does not
    change."""
    return _changed(solver, lambda method: {"scan_kind": kind} if getattr(method, "scan_kind", kind) is None else {})


def _takes_tolerances(method: Any) -> bool:
    of_steps = type(diffrax.with_stepsize_controller_tols(diffrax.VeryChord)().rtol)
    return isinstance(getattr(getattr(method, "root_finder", None), "rtol", None), of_steps)


def _changed(solver: Any, changes: Callable[[Any], dict[str, Any]]) -> Any:
    """The solver with other fields. For a wrapped solver, such as in `HalfSolver`, the fields of the inner one
    change."""
    if isinstance(getattr(solver, "solver", None), diffrax.AbstractSolver):
        return dataclasses.replace(solver, solver=_changed(solver.solver, changes))
    fields = changes(solver)
    return dataclasses.replace(solver, **fields) if fields else solver


def _check_kind(
    label: str, value: object, kind: type | tuple[type, ...], expected: str, may_be_omitted: bool = True
) -> None:
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(f"`{label}` must be an instance, not a class: {label}=diffrax.{value.__name__}().")
    if not isinstance(value, kind) and not (value is None and may_be_omitted):
        raise TypeError(f"`{label}` must be {expected}; got {value!r}.")


def _check_number(label: str, value: Component, is_allowed: Callable[[float], bool], allowed: str) -> None:
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


def is_explicit(solver: diffrax.AbstractSolver) -> bool:
    """Whether this is an explicit Runge-Kutta method of diffrax. A `HalfSolver` passes `isinstance` but is not one."""
    return isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.HalfSolver)


def rates_at_ends(solver: Any) -> bool:
    """Whether the first and the last stage k_i = h f_i of a step are evaluated at its start and its end."""
    method = solver.method if isinstance(solver, UnrolledERK) else solver
    tableau: Any = method.tableau if is_explicit(method) else None
    return tableau is not None and tableau.fsal


def last_stage_is_spare(solver: Any) -> bool:
    """Whether the last stage of a step is only used as the first stage of the next step, as with Bosh3."""
    tableau: Any = solver.tableau if is_explicit(solver) else None
    return tableau is not None and tableau.fsal and not np.any((tableau.c == 1) & (tableau.b_sol[1:] != 0))


@functools.cache
def _stepwise(kind: type[diffrax.AbstractSolver]) -> Any:
    class StepwiseInputs(kind):
        def init(
            self, terms: diffrax.AbstractTerm, t0: Component, t1: Component, y0: PyTree[Array], args: RateArguments
        ) -> Any:
            return super().init(terms, t0, t1, y0, args.in_step(t0, t1))

        def step(
            self,
            terms: diffrax.AbstractTerm,
            t0: Component,
            t1: Component,
            y0: PyTree[Array],
            args: RateArguments,
            solver_state: PyTree[Array],
            made_jump: Bool,
        ) -> Any:
            return super().step(terms, t0, t1, y0, args.in_step(t0, t1), solver_state, made_jump)

    return StepwiseInputs


def with_stepwise_inputs(solver: diffrax.AbstractSolver) -> Any:
    """The solver, whose stages use the piece of each input that lies inside the step (see `RateArguments.in_step`).

    A solver of diffrax passes only the time to the right-hand side. At the end of a step, the time does not determine
    the side of a discontinuity.
    """
    stepwise = object.__new__(_stepwise(type(solver)))
    for field in dataclasses.fields(solver):
        object.__setattr__(stepwise, field.name, getattr(solver, field.name))
    return stepwise


class UnrolledERK(diffrax.AbstractAdaptiveSolver[Any]):
    """An explicit Runge-Kutta method of diffrax with unrolled stages.

        y_i = y0 + sum_j a_ij k_j,   k_i = h f(t0 + c_i h, y_i),   y1 = y0 + sum_i b_i k_i

    diffrax evaluates the stages in a loop, so that the right-hand side is compiled once. A native kernel is already
    compiled, so unrolled stages take no longer to compile and are faster: the loop carries all stages in one array,
    which XLA transposes in every pass. Samples are looked up at the times of all stages together. The results are equal
    to those of `method` within rounding.
    """

    method: diffrax.AbstractERK
    term_structure = diffrax.AbstractTerm
    always_succeeds: ClassVar[bool] = True

    @property
    def interpolation_cls(self) -> Any:  # type: ignore[override]
        return self.method.interpolation_cls

    def order(self, terms: diffrax.AbstractTerm) -> int | None:
        return self.method.order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.method.error_order(terms)

    def func(self, terms: diffrax.AbstractTerm, t0: Component, y0: PyTree[Array], args: RateArguments) -> Any:
        return terms.vf(t0, y0, args)

    def init(
        self, terms: diffrax.AbstractTerm, t0: Component, t1: Component, y0: PyTree[Array], args: RateArguments
    ) -> Any:
        """The rates at the start if the last stage of a step is the first of the next, else None."""
        tableau: Any = self.method.tableau
        return terms.vf(t0, y0, _in_step(args, t0, t1)) if tableau.fsal else None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Component,
        t1: Component,
        y0: PyTree[Array],
        args: RateArguments,
        solver_state: PyTree[Array],
        made_jump: Bool,
    ) -> Any:
        tableau: Any = self.method.tableau
        args = _in_step(args, t0, t1)
        h, times = terms.contr(t0, t1), [t0, *(t1 if c == 1 else t0 + float(c) * (t1 - t0) for c in tableau.c)]
        sampled = args.sampled(jnp.stack(times)) if isinstance(args, RateArguments) else {}

        @jax.jit
        def rates_at(t: Array, y: Array, numbers: dict[str, Array]) -> Array:
            return terms.vf(t, y, dataclasses.replace(args, signals=args.signals | numbers) if numbers else args)

        def rates(i: int, y: Array) -> Array:
            return rates_at(times[i], y, {name: x[i] for name, x in sampled.items()})

        if solver_state is None:
            f = rates(0, y0)
        elif made_jump is False:
            f = solver_state
        else:
            f = jax.lax.cond(made_jump, lambda: rates(0, y0), lambda: solver_state)
        k, y = [terms.prod(f, h)], y0
        for i, a in enumerate(tableau.a_lower, start=1):
            y = y0 + _weighted(a, k)
            f = rates(i, y)
            k.append(terms.prod(f, h))
        y1 = y if tableau.ssal else y0 + _weighted(tableau.b_sol, k)
        dense = {"y0": y0, "y1": y1, "k": jnp.stack(k)}
        return y1, _weighted(tableau.b_error, k), dense, f if tableau.fsal else None, diffrax.RESULTS.successful


def _in_step(args: object, t0: Component, t1: Component) -> Any:
    return args.in_step(t0, t1) if isinstance(args, RateArguments) else args


def _weighted(weights: np.ndarray, values: list[Any]) -> Any:
    return functools.reduce(operator.add, [float(w) * x for w, x in zip(weights, values, strict=True) if w != 0])
