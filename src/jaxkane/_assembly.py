"""Consistent coordinates and speeds. Knows constraints and Newton's method; knows no mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from ._check import check_system, configuration_residual, is_concrete
from ._kane import Instant
from ._linear import stack
from ._system import State, System
from ._types import Component


def assemble(
    system: System,
    q: Any,
    u: Any = None,
    t: Component = 0.0,
    *,
    free: Sequence[str] | None = None,
) -> State:
    """A state that satisfies the constraints: coordinates found by Newton's method, speeds checked.

        h(t, q) = 0

    **Arguments:**

    - `q` (n_q,), or a dict by name in which coordinates left out are zero: what is to be held, and a first guess of
        the rest.
    - `u` (n_u,), or a dict by name in which speeds left out are zero: the independent speeds. Dependent speeds may be
        given too, and are then compared with what the residuals say.
    - `t`: time [s].
    - `free`: names of the coordinates to find; by default `system.dependent_coordinates`, or all of them. Where there
        are more than constraints, the nearest along the constraints' gradients is taken.

    **Returns:** a `State`, differentiable (twice, both modes) in everything by the implicit function theorem.

    **Raises:** `ValueError` where no such configuration is found, or given dependent speeds contradict the residuals.
    Under a trace the coordinates become NaN instead.
    """
    name = type(system).__name__
    q0 = _by_name(q, system.coordinates, f"{name}: coordinate")
    speeds = (*system.speeds, *system.dependent_speeds)
    n = len(system.speeds)
    u_all = jnp.zeros(n, q0.dtype) if u is None else _by_name(u, system.speeds, f"{name}: speed", speeds)
    q_found = _solve_configuration(system, q0, t, tuple(free if free is not None else system.dependent_coordinates))
    state = State(q_found, u_all[:n])
    if is_concrete(system, state, t):
        check_system(system, t, state.q, state.u)
        if isinstance(u, Mapping) and set(u) & set(system.dependent_speeds):
            now = Instant(system, t, state.q, state.u)
            given = {s: u[s] for s in system.dependent_speeds if s in u}
            _check_dependent_speeds(name, given, dict(zip(system.dependent_speeds, now.u_dep, strict=True)))
    return state


def _by_name(values: Any, required: Sequence[str], label: str, allowed: Sequence[str] | None = None):
    """Values by name or in order, as a float array of those required."""
    if isinstance(values, Mapping):
        unknown = sorted(set(values) - set(allowed or required))
        if unknown:
            raise ValueError(f"{label} {', '.join(unknown)} is unknown; there are {', '.join(allowed or required)}.")
        return stack([[jnp.asarray(values.get(name, 0.0), dtype=float) for name in required]])[0]
    array = jnp.asarray(values)
    if not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(float)
    if array.shape != (len(required),):
        raise ValueError(
            f"{label}s: expected {len(required)} numbers ({', '.join(required)}), got the shape {array.shape}."
        )
    return array


def _solve_configuration(system: System, q0, t, free: tuple[str, ...]):
    name = type(system).__name__
    unknown = sorted(set(free) - set(system.coordinates))
    if unknown:
        raise ValueError(f"{name} has no coordinate {', '.join(unknown)}; it has {', '.join(system.coordinates)}.")
    h = lambda q: configuration_residual(system, t, q)  # noqa: E731
    n_h = jax.eval_shape(h, q0).shape[0]
    if n_h == 0:
        return q0
    places = [system.coordinates.index(c) for c in free] or list(range(len(system.coordinates)))
    if len(places) < n_h:
        raise ValueError(
            f"{name}: {n_h} configuration constraints cannot be met by moving {len(places)} coordinates "
            f"({', '.join(free)})."
        )
    places = np.array(places)
    # (h, free): along the constraints' gradients where there is a choice
    directions = jnp.eye(n_h, dtype=q0.dtype) if len(places) == n_h else jax.jacfwd(h)(q0)[:, places]

    def residual(amount, args):
        h_args, q0, directions = args
        return configuration_residual(h_args[0], h_args[1], q0.at[places].add(amount @ directions))

    args = ((system, jnp.asarray(t, dtype=q0.dtype)), q0, directions)
    eps = float(jnp.finfo(q0.dtype).eps)
    newton = optx.Newton(rtol=8 * eps, atol=8 * eps)
    solution = optx.root_find(residual, newton, jnp.zeros(n_h, q0.dtype), args, max_steps=64, throw=False)
    q = q0.at[places].add(solution.value @ directions)
    remainder = jnp.max(jnp.abs(h(q)))
    good = remainder <= eps**0.6
    if is_concrete(system, q, t) and not bool(good):
        moved = ", ".join(system.coordinates[i] for i in places)
        held = ", ".join(
            f"{c} = {float(x):.4g}"
            for i, (c, x) in enumerate(zip(system.coordinates, q0, strict=True))
            if i not in places
        )
        raise ValueError(
            f"{name}: no {moved} satisfies the configuration constraints with {held}: after "
            f"{int(solution.stats['num_steps'])} Newton steps the residual is {float(remainder):.3g}. Start from "
            "another guess, or change what is held."
        )
    return jnp.where(good, q, jnp.nan)


def _check_dependent_speeds(name: str, given: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    for speed, value in given.items():
        value, right = float(value), float(found[speed])
        if not abs(value - right) <= 1e-6 * max(1.0, abs(right)):
            raise ValueError(
                f"{name}: {speed} = {value:.6g} contradicts the velocity constraints, which need {right:.6g} "
                f"(residual {value - right:.3g}). Leave the dependent speeds out: they follow from the others."
            )
