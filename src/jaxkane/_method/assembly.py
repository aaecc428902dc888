"""Consistent coordinates and speeds. Knows constraints and Newton's method; knows no mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._description.system import State, System
from .._scalars.numbers import is_in_numbers
from .._scalars.types import Component
from .checks import check_system, configuration_tolerance, is_concrete
from .description_facts import configuration_residual
from .equations import dependent_speeds
from .free_coordinates import Plan, plan_of
from .newton import Found, newton, newton_in_numbers
from .values import as_array, check_is_system, check_time


class NoConfiguration(ValueError):
    """The configuration constraints cannot be met, or not from there."""


def assemble(
    system: System,
    q: Any,
    u: Any = None,
    x: Any = None,
    *,
    t: Component = 0.0,
    free: Sequence[str] | None = None,
) -> State:
    """A state that satisfies the constraints: coordinates found by Newton's method, speeds checked.

        h(t, q) = 0

    **Arguments:**

    - `q` (n_q,), or a dict by name. What is held, and an initial guess of what is moved. Coordinates left out of a dict
        start at zero; of four Euler parameters the last starts at one, so that those left out are no rotation.
    - `u` (n_u,), or a dict by name in which speeds left out are zero: the independent speeds. Dependent speeds may be
        given too, and are then compared with what the residuals say.
    - `x` (n_x,), or a dict by name: states of the first order. Those left out are zero.
    - `t`: time [s], one finite number.
    - `free`: names of the coordinates that are moved. By default `system.dependent_coordinates`; of a system that
        names none, those left out of the dict `q`, or all of an array. Where more are moved than there are constraints,
        the nearest along the constraints' gradients is taken. All others are held.

    **Returns:** a `State`, differentiable (twice, both modes) in everything by the implicit function theorem.

    **Raises:** `ValueError` where no such configuration is found, or given dependent speeds contradict the residuals.
    Under a trace the coordinates, and all their derivatives, become NaN instead.
    """
    check_is_system(system)
    name = type(system).__name__
    check_time(name, t)
    plan = plan_of(system, q, free)
    q0 = as_array(plan.guess | dict(q) if isinstance(q, Mapping) else q, system.coordinates, f"{name}: q")
    given: dict[str, Any] = {}
    if isinstance(u, Mapping):
        given = {speed: u[speed] for speed in system.dependent_speeds if speed in u}
        u = {speed: value for speed, value in u.items() if speed not in given}
    u0 = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q0.dtype)
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{name} has no states of the first order: leave out x, got {x!r}.")
    x0 = as_array({} if x is None else x, system.states, f"{name}: x").astype(q0.dtype) if system.states else None
    given_numbers = [y for y in (q0, u0, x0) if y is not None]
    if is_concrete(given_numbers) and not np.all(np.isfinite(np.concatenate(given_numbers))):
        names = (*system.coordinates, *system.speeds, *system.states)
        bad = [n for n, y in zip(names, np.concatenate(given_numbers), strict=True) if not np.isfinite(y)]
        raise ValueError(f"{name}: {', '.join(bad)} is not finite.")
    q0 = _solve_configuration(system, q0, t, plan)
    if is_concrete(system, q0, u0, t):
        check_system(system, t, q0)
        if given:
            u_dep = dict(zip(system.dependent_speeds, dependent_speeds(system, t, q0, u0), strict=True))
            _check_dependent_speeds(name, given, u_dep)
    return State(q0, u0, x0)


def _solve_configuration(system: System, q0, t, plan: Plan):
    t = jnp.asarray(t if isinstance(t, jax.Array) else np.asarray(t, q0.dtype), dtype=q0.dtype)
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q0).shape[0]
    if n_h == 0:
        return q0
    if len(plan.moved) < n_h and not plan.lenient:
        raise ValueError(
            f"{type(system).__name__}: {n_h} configuration constraints cannot be met by moving {len(plan.moved)} "
            f"coordinates ({', '.join(plan.moved)})."
        )
    places = tuple(system.coordinates.index(c) for c in plan.moved)
    concrete = is_concrete(system, q0, t)
    in_python = concrete and is_in_numbers(configuration_residual, system, t, q0)
    found = (newton_in_numbers if in_python else newton)(system, q0, t, places, plan.lenient)
    if concrete and not bool(found.good):
        raise NoConfiguration(_why_not(system, q0, plan, found))
    return found.q


def _why_not(system: System, q0, plan: Plan, found: Found) -> str:
    name = type(system).__name__
    moved = ", ".join(plan.moved)
    held = ", ".join(
        f"{c} = {float(x):.4g}"
        for c, x in zip(system.coordinates, q0, strict=True)
        if c not in plan.moved and (x != 0 or (plan.lenient and c in plan.named))
    )
    held = held or "the others zero"
    more = ""
    if plan.lenient:
        more = " What is named is held: leave out what may be moved, or say so with free=(...)."
    if not moved:
        return (
            f"{name}: {held} does not satisfy the configuration constraints (the largest residual is "
            f"{float(found.remainder):.3g}), and nothing is left to be moved.{more}"
        )
    if float(found.follows) > configuration_tolerance(q0.dtype) >= float(found.remainder):
        return (
            f"{name}: the configuration constraints can be met, but what should follow from them is off by "
            f"{float(found.follows):.3g}: with these parameters the loop cannot be closed. The ends of a loop in a "
            "plane are at one height across it."
        )
    if float(found.remainder) < 1e-3 and not float(found.slope) > 1e-6:
        return (
            f"{name}: the configuration constraints do not determine {moved} with {held}: they do not change with it "
            f"(a singular configuration, or constraints that repeat each other). Change what is held.{more}"
        )
    return (
        f"{name}: no {moved} satisfies the configuration constraints with {held}: after {int(found.steps)} Newton "
        f"steps the residual is {float(found.remainder):.3g}. Start from another guess, or change what is held.{more}"
    )


def _check_dependent_speeds(name: str, given: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    for speed, value in given.items():
        value, right = float(value), float(found[speed])
        if not abs(value - right) <= 1e-6 * max(1.0, abs(right)):
            raise ValueError(
                f"{name}: {speed} = {value:.6g} contradicts the velocity constraints, which need {right:.6g} "
                f"(residual {value - right:.3g}). Leave the dependent speeds out: they follow from the others."
            )
