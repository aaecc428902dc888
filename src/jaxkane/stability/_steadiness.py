"""Whether a motion is steady and on its constraints. Knows the rates of the method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import refuse_unknown
from .._description.system import System
from .._method.description_facts import configuration_residual
from .._method.diagnose import diagnosis
from .._method.right_hand_side import rates, values_of
from .._scalars.versions import compiled
from ._cyclic import cyclic_coordinates


def inputs_by_name(system: System, w) -> dict[str, Any]:
    return {k: w[i] for i, k in enumerate(system.inputs)}


@compiled
def _rates(system, t, q, u, x, w):
    rate = rates(system, t, q, u, values_of(system, x, inputs_by_name(system, w)))
    return rate.q, rate.u, x if rate.x is None else rate.x, configuration_residual(system, t, q)


def _tolerances(system: System, u) -> tuple[float, Any]:
    """How far coordinates may be off the constraints, and rates from zero."""
    tol = float(jnp.finfo(u.dtype).eps) ** 0.4
    return tol, tol * (1.0 + jnp.max(jnp.abs(u), initial=0.0))


def _still(system: System) -> np.ndarray:
    """Places of the coordinates that stand still in a steady motion."""
    cyclic = cyclic_coordinates(system)
    return np.array([i for i, k in enumerate(system.coordinates) if k not in cyclic], int)


def check_dependent(system: System, dependent: Sequence[str], n_h: int) -> None:
    """**Raises:** `ValueError` where not as many coordinates are named as `n_h` configuration constraints determine."""
    name = type(system).__name__
    refuse_unknown(dependent, system.coordinates, f"{name}: `dependent` names coordinates; it has no", "it has")
    if len(set(dependent)) != n_h:
        raise ValueError(
            f"{name}: {n_h} configuration constraints determine as many coordinates, but "
            f"{len(set(dependent))} are named ({', '.join(dependent) or 'none'}). Give linearize(..., dependent=(...)) "
            f"{n_h} of {', '.join(system.coordinates)}."
        )


def is_wrong(system: System, t, q, u, x, w, steady: bool):
    """Whether a state is off the constraints, not finite or, where that is asked, not steady."""
    q_dot, u_dot, x_dot, h = _rates(system, t, q, u, x, w)
    tol, slack = _tolerances(system, u)
    moving = jnp.concatenate([u_dot, q_dot[_still(system)], x_dot]) if steady else jnp.zeros(0, q.dtype)
    fine = jnp.all(jnp.abs(h) <= tol) & jnp.all(jnp.abs(moving) <= slack)
    return jax.lax.stop_gradient(~(fine & jnp.all(jnp.isfinite(jnp.concatenate([q, u, x, w, t[None]])))))


def check_state(system: System, t, q, u, x, w, steady: bool) -> None:
    name = type(system).__name__
    q_dot, u_dot, x_dot, h = map(np.asarray, _rates(system, t, q, u, x, w))
    tol, slack = _tolerances(system, u)
    named = (
        (system.coordinates, q),
        (system.speeds, u),
        (system.states, x),
        (system.inputs, w),
        (("t",), t[None]),
    )
    bad = [k for names, y in named for k, value in zip(names, np.asarray(y), strict=True) if not np.isfinite(value)]
    if bad:
        raise ValueError(f"{name}: {', '.join(bad)} is not finite: there is no linear model there.")
    if h.size and not np.abs(h).max() <= tol:
        raise ValueError(f"{name}: the coordinates violate the configuration constraints by {h}. Use assemble.")
    if not np.all(np.isfinite(np.concatenate([q_dot, u_dot]))):
        wrong = diagnosis(system, t, q, u, values_of(system, x, inputs_by_name(system, w)))
        raise ValueError(wrong or f"{name}: rates are not finite there: there is no linear model.")
    if not steady:
        return
    found = {f"{k} is accelerated by": y for k, y in zip(system.speeds, u_dot, strict=True)}
    found |= {f"{system.coordinates[i]} changes with": q_dot[i] for i in _still(system)}
    found |= {f"{k} changes with": y for k, y in zip(system.states, x_dot, strict=True)}
    moving = [f"{k} {float(x):.3g}" for k, x in found.items() if not abs(x) <= float(slack)]
    if moving:
        raise ValueError(
            f"{name}: this motion is not steady: {', '.join(moving)}. Find one with equilibrium or steady_turn; or ask "
            "for the linear model of an instant with linearize(..., steady=False)."
        )
