"""How to integrate: the options of `simulate`, checked, and the mode in which a motion will be differentiated."""

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
from jaxtyping import Array

from .._scalarjit.compat import (
    MISSING,
    Tracer,
    as_lowering,
    is_moved_forward,
    is_moved_forward_below,
    is_no_tangent,
    new_primitive,
    nothing_is_traced,
)

ADJOINTS = {
    "auto": diffrax.RecursiveCheckpointAdjoint,
    "reverse": diffrax.RecursiveCheckpointAdjoint,
    "forward": diffrax.ForwardMode,
    "both": diffrax.DirectAdjoint,
}


_ADJOINT = f"`adjoint` is one of {', '.join(ADJOINTS)}, or a diffrax adjoint; got {{!r}}."


class Settings(eqx.Module):
    """The options of `simulate`, with their defaults filled in.

    Tolerances and the step are numbers, or arrays where they may change without another compilation.
    """

    rtol: Any
    atol: Any
    solver: diffrax.AbstractSolver
    step: Any
    adjoint: diffrax.AbstractAdjoint
    max_steps: int | None = eqx.field(static=True)  # None: as many as it takes
    progress: bool = eqx.field(static=True)
    project: bool = eqx.field(static=True)
    stabilize: float = eqx.field(static=True)
    rising: bool = eqx.field(static=True, default=False)  # the times are known to rise
    check_bodies: bool = eqx.field(static=True, default=False)  # a motion of bodies that cannot be is invalid

    @property
    def is_forward(self) -> bool:
        """Whether derivatives are those in forward mode alone."""
        return isinstance(self.adjoint, ADJOINTS["forward"])


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
    rising: bool = False,
    check_bodies: bool = False,
) -> Settings:
    """The options of `simulate`, with defaults that follow the type of the times; `rising`: whether these are known to
    rise, as where `checked_times` saw their values; `check_bodies`: whether bodies that cannot be make a motion
    invalid, as those of members of a batch do.

    **Raises:** `ValueError` or `TypeError` for options that are no such, and for those that contradict one another.
    """
    _check_types(solver, adjoint, project=project, progress=progress)
    method: Any = diffrax.Tsit5() if solver is None else solver
    if step is not None and not (rtol is None and atol is None):
        raise ValueError(
            "`step` fixes the steps of integration, `rtol` and `atol` let them follow the error: give one."
        )
    if step is None and not isinstance(method, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            f"{type(method).__name__} estimates no error, which the steps would follow: give them, as in step=1e-3."
        )
    default = 1e-8 if ts.dtype == jnp.float64 else 1e-5
    if step is not None:
        method = _for_one_length(method, default)
    if not isinstance(adjoint, str) and type(adjoint) not in ADJOINTS.values():
        raise ValueError(
            f"adjoint={type(adjoint).__name__}() does not differentiate the steps, with their events and inputs. "
            'Use "reverse", or "forward" for few parameters.'
        )
    for label, number in (("rtol", rtol), ("atol", atol), ("step", step)):
        if number is not None and not isinstance(number, Tracer):
            _check_number(label, number, lambda x: x > 0, "positive and finite")
    _check_number("stabilize", stabilize, lambda x: x >= 0, "a rate [1/s], not negative and finite")
    if max_steps is not None:
        _check_number("max_steps", max_steps, lambda x: x >= 1 and x == int(x), "a whole number of 1 at least")
    return Settings(
        rtol=default if rtol is None else float(rtol),
        atol=default if atol is None else float(atol),
        solver=method,
        step=step,
        adjoint=ADJOINTS[adjoint]() if isinstance(adjoint, str) else adjoint,
        max_steps=max_steps,
        progress=progress,
        project=project,
        stabilize=float(stabilize),
        rising=rising,
        check_bodies=check_bodies,
    )


def _for_one_length(solver: Any, tolerance: float) -> Any:
    """An implicit solver for steps of one length. As diffrax makes it, it leaves what converges slowly to a shorter
    step: here Newton's method solves its equations."""
    newton = {"root_finder": optx.Newton(rtol=tolerance, atol=tolerance), "root_find_max_steps": 50}
    changes = lambda method: {name: x for name, x in newton.items() if hasattr(method, name)}  # noqa: E731
    return _changed(solver, lambda method: changes(method) if _takes_tolerances(method) else {})


def with_tolerances(solver: Any, rtol: Any, atol: Any) -> Any:
    """An implicit solver whose equations are solved with the tolerances of the steps; any other as it is."""
    of_steps = {"rtol": rtol, "atol": atol, "norm": optx.rms_norm}
    changes = lambda method: {"root_finder": dataclasses.replace(method.root_finder, **of_steps)}  # noqa: E731
    return _changed(solver, lambda method: changes(method) if _takes_tolerances(method) else {})


def with_scan_kind(solver: Any, kind: str) -> Any:
    """A solver whose loop over its stages has derivatives in forward mode; as it is where it has no such loop."""
    return _changed(solver, lambda method: {"scan_kind": kind} if getattr(method, "scan_kind", kind) is None else {})


def _takes_tolerances(method: Any) -> bool:
    """Whether it takes the tolerances of its equations from those of the steps."""
    of_steps = type(diffrax.with_stepsize_controller_tols(diffrax.VeryChord)().rtol)
    return isinstance(getattr(getattr(method, "root_finder", None), "rtol", None), of_steps)


def _changed(solver: Any, changes: Callable[[Any], dict[str, Any]]) -> Any:
    """The solver whose method, the one that takes the half steps of a `HalfSolver` too, has other fields."""
    if isinstance(solver, diffrax.HalfSolver):
        return dataclasses.replace(solver, solver=_changed(solver.solver, changes))
    fields = changes(solver)
    return dataclasses.replace(solver, **fields) if fields else solver


def _check_types(solver: Any, adjoint: Any, **flags: Any) -> None:
    if isinstance(adjoint, str):
        if adjoint not in ADJOINTS:
            raise ValueError(_ADJOINT.format(adjoint))
        adjoint = None
    elif adjoint is None:
        raise TypeError(_ADJOINT.format(adjoint))
    for label, value, kind in (
        ("solver", solver, diffrax.AbstractSolver),
        ("adjoint", adjoint, diffrax.AbstractAdjoint),
    ):
        if isinstance(value, type) and issubclass(value, kind):
            raise TypeError(f"`{label}` is an instance, not a class: {label}=diffrax.{value.__name__}().")
        if value is not None and not isinstance(value, kind):
            is_solver = f"`solver` is one of diffrax, as diffrax.Tsit5() is; got {value!r}."
            raise TypeError(is_solver if label == "solver" else _ADJOINT.format(value))
    if solver is not None and solver.term_structure is not diffrax.AbstractTerm:
        raise TypeError(
            f"{type(solver).__name__} takes equations in several parts, such as stiff and other ones. These are in one "
            "part. A solver for stiff equations is diffrax.Kvaerno5()."
        )
    for label, value in flags.items():
        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"`{label}` is True or False, got {value!r}.")


def _check_number(label: str, value: Any, is_allowed: Callable[[float], bool], allowed: str) -> None:
    try:
        number = math.nan if isinstance(value, (bool, np.bool_, str)) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and is_allowed(number)):
        raise ValueError(f"`{label}` must be {allowed}; got {value!r}.")


def with_array_tolerances(settings: Settings, dtype: Any) -> Settings:
    """The same, whose tolerances and step are arguments of a program, and no part of it."""

    def array(x: Any) -> Any:
        # A number goes by way of NumPy, which compiles nothing for it.
        return x.astype(dtype) if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype))

    values = {name: getattr(settings, name) for name in ("rtol", "atol", "step")}
    return dataclasses.replace(settings, **{name: x if x is None else array(x) for name, x in values.items()})


def resolve_adjoint(settings: Settings, adjoint: Any, arguments: Any) -> tuple[Settings, Any]:
    """The settings for a derivative in forward mode that is under way, where `adjoint` is "auto"; and the arguments of
    a motion, guarded where that is for reverse mode."""
    if adjoint == "auto" and any(map(is_moved_forward, jax.tree.leaves(arguments))):
        settings = dataclasses.replace(settings, adjoint=ADJOINTS["forward"]())
    if isinstance(settings.adjoint, ADJOINTS["reverse"]) and not nothing_is_traced():
        arguments = _for_reverse_mode(arguments)
    return settings, arguments


def without_derivatives(settings: Settings) -> Settings:
    """The settings for a motion that nobody can differentiate, which is compiled without what its derivative in reverse
    mode would need: the same numbers."""
    if nothing_is_traced() and isinstance(settings.adjoint, ADJOINTS["reverse"]):
        return dataclasses.replace(settings, adjoint=ADJOINTS["forward"]())
    return settings


def _for_reverse_mode(values: Any) -> Any:
    """`values`, whose derivative in forward mode is an error that says what to do; in reverse mode it is untouched.

    A program that was traced before, as by `jax.jit`, meets forward mode when JAX comes to compile its derivative.
    """
    if any(map(is_moved_forward_below, jax.tree.leaves(values))):
        _refuse()
    if MISSING:
        return values
    return jax.tree.map(lambda x: _guarded(x) if eqx.is_inexact_array(x) else x, values)


@jax.custom_jvp
def _guarded(x: Any) -> Any:
    return x


@_guarded.defjvp
def _(primals: Any, tangents: Any) -> Any:
    return primals[0], _reverse_only.bind(tangents[0], primals[0])[0]


def _refuse(*_: Any) -> Any:
    raise TypeError(
        "A derivative in forward mode (jax.jvp, jax.jacfwd, jax.linearize, jax.hessian) of a motion that was simulated "
        'for reverse mode. Say simulate(..., adjoint="forward"): where a function was compiled or linearized before, '
        'as in jax.jacfwd(jax.jit(f)), "auto" cannot see what is to come. A second derivative is jacfwd(jacfwd(f)).'
    )


def _jvp(primals: Any, tangents: Any) -> Any:
    (x_dot, x), (x_ddot, _) = primals, tangents
    return _reverse_only.bind(x_dot, x), [x_ddot] if is_no_tangent(x_ddot) else _reverse_only.bind(x_ddot, x)


def _batch(values: Any, dims: Any) -> Any:
    if dims[0] is not None and dims[1] is None:  # many directions at one point: jax.jacfwd
        _refuse()
    return _reverse_only.bind(*values), [dims[0]]


# Linear in the first of its arguments, the tangent; the second is the point.
_reverse_only: Any = None if MISSING else new_primitive(
    "reverse_mode_only",
    evaluate=_refuse,
    shapes=lambda x_dot, x: [x_dot],
    jvp=_jvp,
    transpose=lambda cotangents, x_dot, x: [cotangents[0], None],
    batch=_batch,
    traced=_refuse,
    lower_on_cpu=as_lowering(_refuse),
)  # fmt: skip
