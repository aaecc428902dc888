"""How to integrate, and what a simulation is given: options, times and states, checked. Knows no mechanics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._kane.arguments import by_names, check_is_system, refuse_incomplete
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
from .._system.system import State, System
from .inputs import real_array, samples_of

SCALARS_UP_TO = 64
"""Beyond so many numbers an array is none for a program of scalars."""

ADJOINTS = {
    "auto": diffrax.RecursiveCheckpointAdjoint,
    "reverse": diffrax.RecursiveCheckpointAdjoint,
    "forward": diffrax.ForwardMode,
    "both": diffrax.DirectAdjoint,
}


class Settings(eqx.Module):
    """How to integrate: what `simulate` was given, with its defaults filled in.

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
) -> Settings:
    """The options of `simulate`, with defaults that follow the type of the times; `rising`: whether these are known to
    rise, as they do where `checked_times` saw their values."""
    _check_kinds(solver, adjoint, project=project, progress=progress)
    if step is not None and not (rtol is None and atol is None):
        raise ValueError(
            "`step` fixes the steps of integration, `rtol` and `atol` let them follow the error: give one."
        )
    default = 1e-8 if ts.dtype == jnp.float64 else 1e-5
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint=BacksolveAdjoint() solves the motion backwards, without its events, inputs and samples: its "
            'derivatives would be those of another motion. Use "reverse", or "forward" for few parameters.'
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
        solver=diffrax.Tsit5() if solver is None else solver,
        step=step,
        adjoint=ADJOINTS[adjoint]() if isinstance(adjoint, str) else adjoint,
        max_steps=max_steps,
        progress=progress,
        project=project,
        stabilize=float(stabilize),
        rising=rising,
    )


def _check_kinds(solver: Any, adjoint: Any, **flags: Any) -> None:
    """Refuse options of the wrong type. **Raises:** `TypeError`, or `ValueError` for the name of no adjoint."""
    if isinstance(adjoint, str):
        if adjoint not in ADJOINTS:
            raise ValueError(f"`adjoint` is one of {', '.join(ADJOINTS)}, or a diffrax adjoint; got {adjoint!r}.")
        adjoint = None
    for label, value, kind in (
        ("solver", solver, diffrax.AbstractSolver),
        ("adjoint", adjoint, diffrax.AbstractAdjoint),
    ):
        if isinstance(value, type) and issubclass(value, kind):
            raise TypeError(f"`{label}` is an instance, not a class: {label}=diffrax.{value.__name__}().")
        if value is not None and not isinstance(value, kind):
            raise TypeError(f"`{label}` is one of diffrax, as diffrax.Tsit5() is a solver; got {value!r}.")
    for label, value in flags.items():
        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"`{label}` is True or False, got {value!r}.")


def refuse_held(solver: Any, signals: Any) -> None:
    """Refuse steps of one length over the jumps of held inputs, for a solver that asks for the right-hand side at the
    end of a step: what is held has the next value there."""
    tableau = getattr(solver, "tableau", None)
    asks = True if tableau is None else np.any((np.asarray(tableau.c) == 1) & (np.asarray(tableau.b_sol)[1:] != 0))
    if asks and any(x.hold for x in samples_of(signals)):
        raise ValueError(
            f"Steps of one length and an input under a zero-order hold: {type(solver).__name__} reads the end of a "
            "step, where the next sample begins. Use solver=diffrax.Bosh3(); or leave out `step`, and the steps end "
            "where the input jumps."
        )


def of_any_accuracy(settings: Settings, dtype: Any) -> Settings:
    """The same, whose tolerances and step are arguments of a program, and no part of it."""
    numbers = {name: getattr(settings, name) for name in ("rtol", "atol", "step")}

    def array(x: Any) -> Any:
        # A number goes by way of NumPy, which compiles nothing for it.
        return x.astype(dtype) if isinstance(x, jax.Array) else jax.device_put(np.asarray(x, dtype))

    return dataclasses.replace(settings, **{name: x if x is None else array(x) for name, x in numbers.items()})


def _check_number(label: str, value: Any, fits: Callable[[float], bool], what: str) -> None:
    try:
        number = math.nan if isinstance(value, (bool, np.bool_, str)) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and fits(number)):
        raise ValueError(f"`{label}` must be {what}; got {value!r}.")


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
    found: list[Any] = []
    for label, values, names in parts:
        if isinstance(values, Mapping):
            values = by_names(values, names, f"{title}: state.{label}")
            values = values.astype(found[0].dtype) if found else values
        if not hasattr(values, "shape"):
            raise TypeError(f"{title}: state.{label} is an array of numbers, or a dict by name; got {values!r}.")
        found.append(values)
    return State(*found)


def goes_forward(values: Any) -> bool:
    """Whether a derivative in forward mode is under way by any of the arrays in `values`."""
    return any(map(is_moved_forward, jax.tree.leaves(values)))


def in_its_mode(settings: Settings, adjoint: Any, given: Any) -> tuple[Settings, Any]:
    """The settings for a derivative in forward mode that is under way, where `adjoint` leaves the choice; and what is
    given to a motion, guarded where that is for reverse mode."""
    if adjoint == "auto" and goes_forward(given):
        settings = dataclasses.replace(settings, adjoint=ADJOINTS["forward"]())
    if isinstance(settings.adjoint, ADJOINTS["reverse"]) and not nothing_is_traced():
        given = for_reverse_mode(given)
    return settings, given


def for_reverse_mode(values: Any) -> Any:
    """`values`, whose derivative in forward mode is an error that says what to do; in reverse mode it is untouched.

    A motion whose steps are taken back (`adjoint="reverse"`) can be differentiated in reverse mode alone. A program
    that was traced before, as by `jax.jit`, meets forward mode when JAX comes to compile its derivative.

    **Raises:** `TypeError`, there.
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
