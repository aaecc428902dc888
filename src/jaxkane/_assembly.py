"""Consistent coordinates and speeds. Knows constraints and Newton's method; knows no mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from ._check import check_system, configuration_residual, is_concrete
from ._kane import Instant, as_array
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
    q0 = as_array(q, system.coordinates, f"{name}: q")
    given: dict[str, Any] = {}
    if isinstance(u, Mapping):
        given = {speed: u[speed] for speed in system.dependent_speeds if speed in u}
        u = {speed: value for speed, value in u.items() if speed not in given}
    u0 = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q0.dtype)
    if is_concrete(q0, u0) and not np.all(np.isfinite(np.concatenate([q0, u0]))):
        names = (*system.coordinates, *system.speeds)
        bad = [n for n, x in zip(names, np.concatenate([q0, u0]), strict=True) if not np.isfinite(x)]
        raise ValueError(f"{name}: {', '.join(bad)} is not finite.")
    q0 = _solve_configuration(system, q0, t, tuple(free if free is not None else system.dependent_coordinates))
    if is_concrete(system, q0, u0, t):
        check_system(system, t, q0, u0, strict=True)
        if given:
            u_dep = dict(zip(system.dependent_speeds, Instant(system, t, q0, u0).u_dep, strict=True))
            _check_dependent_speeds(name, given, u_dep)
    return State(q0, u0)


def _solve_configuration(system: System, q0, t, free: tuple[str, ...]):
    name = type(system).__name__
    unknown = sorted(set(free) - set(system.coordinates))
    if unknown:
        raise ValueError(f"{name} has no coordinate {', '.join(unknown)}; it has {', '.join(system.coordinates)}.")
    t = jnp.asarray(t, dtype=q0.dtype)
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q0).shape[0]
    if n_h == 0:
        return q0
    places = tuple(system.coordinates.index(c) for c in free) or tuple(range(len(system.coordinates)))
    if len(places) < n_h:
        raise ValueError(
            f"{name}: {n_h} configuration constraints cannot be met by moving {len(places)} coordinates "
            f"({', '.join(free)})."
        )
    found = _newton(system, q0, t, places)
    if is_concrete(system, found.q, t) and not bool(found.good):
        # The guess may be where the residual has no slope, as an Euler parameter of zero: look from beside it.
        again = _newton(system, q0.at[np.array(places)].add(1.0), t, places)
        if not bool(again.good):
            raise ValueError(_why_not(system, q0, places, found))
        found = again
    return jnp.where(found.good, found.q, jnp.nan)


class _Found(NamedTuple):
    q: Any
    good: Any  # the constraints are met, and determine what was moved
    remainder: Any  # largest residual
    slope: Any  # smallest singular value of the residuals' derivatives along what was moved
    steps: Any


@eqx.filter_jit
def _newton(system: System, q0, t, where: tuple[int, ...]) -> _Found:
    places = np.array(where)
    # What is not finite must not enter the linear solver, which would raise for all members of a batch.
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, q0))]))
    system, q0 = jax.tree.map(lambda x: jnp.where(finite, x, jnp.ones_like(x)), (system, q0))
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q0).shape[0]
    if len(places) == n_h:
        directions = jnp.eye(n_h, dtype=q0.dtype)
    else:  # (h, free): along the constraints' gradients only
        directions = jax.jacfwd(lambda q: configuration_residual(system, t, q))(q0)[:, places]

    def residual(amount, args):
        system, t, q0, directions = args
        return configuration_residual(system, t, q0.at[places].add(amount @ directions))

    eps = float(jnp.finfo(q0.dtype).eps)
    newton = optx.Newton(rtol=8 * eps, atol=8 * eps)
    args = (system, t, q0, directions)
    solution = optx.root_find(residual, newton, jnp.zeros(n_h, q0.dtype), args, max_steps=64, throw=False)
    q = q0.at[places].add(solution.value @ directions)
    remainder = jnp.max(jnp.abs(configuration_residual(system, t, q)))
    derivatives = jax.jacfwd(residual)(jax.lax.stop_gradient(solution.value), jax.lax.stop_gradient(args))
    slope = jnp.linalg.svd(derivatives, compute_uv=False)[-1]
    good = finite & (remainder <= eps**0.6) & (slope > eps**0.6)
    return _Found(q, good, remainder, slope, solution.stats["num_steps"])


def _why_not(system: System, q0, places, found: _Found) -> str:
    name = type(system).__name__
    moved = ", ".join(system.coordinates[i] for i in places)
    held = ", ".join(
        f"{c} = {float(x):.4g}"
        for i, (c, x) in enumerate(zip(system.coordinates, q0, strict=True))
        if i not in places and x != 0
    )
    held = held or "the others zero"
    if float(found.remainder) < 1e-3 and not float(found.slope) > 1e-6:
        return (
            f"{name}: the configuration constraints do not determine {moved} with {held}: they do not change with it "
            "(a singular configuration, or constraints that repeat each other). Change what is held."
        )
    return (
        f"{name}: no {moved} satisfies the configuration constraints with {held}: after {int(found.steps)} Newton "
        f"steps the residual is {float(found.remainder):.3g}. Start from another guess, or change what is held."
    )


def _check_dependent_speeds(name: str, given: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    for speed, value in given.items():
        value, right = float(value), float(found[speed])
        if not abs(value - right) <= 1e-6 * max(1.0, abs(right)):
            raise ValueError(
                f"{name}: {speed} = {value:.6g} contradicts the velocity constraints, which need {right:.6g} "
                f"(residual {value - right:.3g}). Leave the dependent speeds out: they follow from the others."
            )
