"""Why Kane's equations have no solution at a state, in words. Called only after a result is not finite."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from .._description.loads import Force
from .._description.system import System
from .._scalars.linear import rounding_of_pivots
from .._scalars.versions import compiled
from .drift import constraint_rows, dependent_speeds_from
from .kane import Instant
from .rates import rates_and_equations

ROUNDING = 1e-12

_equations = compiled(rates_and_equations)


def diagnosis(system: System, t: Any, q: Any, u: Any, inputs: Any = None) -> str:
    """What is wrong at a state where accelerations or rates are not finite, and what can be done; "" if nothing is.

    Looks, in this order, at the numbers given, the dependent speeds, the mass matrix, the rates of the coordinates and
    the loads.
    """
    name = type(system).__name__
    place = _listed(f"{c} = {float(x):.4g}" for c, x in zip(system.coordinates, q, strict=True))
    given = [("q", system.coordinates, q), ("u", system.speeds, u)]
    for label, names, values in given:
        wrong = [n for n, x in zip(names, np.asarray(values), strict=True) if not np.isfinite(x)]
        if wrong:
            return f"{name}: {label} is not finite: {_listed(wrong)}."
    if system.dependent_speeds:
        C, c0 = (np.asarray(x, dtype=float) for x in constraint_rows(system, t, q))
        found = dependent_speeds_from(C, c0, (*system.speeds, *system.dependent_speeds), system.dependent_speeds, name)
        if not found.condition < 1 / ROUNDING:
            n = len(system.speeds)
            absent = [speed for speed, column in zip(system.dependent_speeds, C.T[n:], strict=True) if not column.any()]
            cause = f"no velocity residual depends on {_listed(absent)}" if absent else "det C_dep = 0"
            return (
                f"{name}: the constraints cannot be solved for {_listed(system.dependent_speeds)} at {place} "
                f"({cause}): {found.advice()}"
            )
    q_dot, M, f = (np.asarray(x) for x in _equations(system, t, q, u, inputs or {}))
    if np.all(np.isfinite(M)):
        massless = _massless(M.astype(float), system.speeds, rounding_of_pivots(M.dtype))
        if massless:
            return (
                f"{name}: {massless}, so Kane's equations have no solution. Give the bodies that it moves mass and "
                "moments of inertia about every axis they turn about (a line has none about itself); or leave the "
                "speed out of the description."
            )
    else:
        return f"{name}: the mass matrix is not finite at {place}."
    wrong = [c for c, x in zip(system.coordinates, q_dot, strict=True) if not np.isfinite(x)]
    if wrong:
        return (
            f"{name}: the rates of {_listed(wrong)} are not finite at {place}: angles of a sequence lock there (gimbal "
            "lock). Start elsewhere; or describe the orientation with Euler parameters, or with another sequence."
        )
    if not np.all(np.isfinite(f)):
        return f"{name}: {_loads_not_finite(system, t, q, u, inputs or {})} at {place}."
    return ""


def _loads_not_finite(system: System, t: Any, q: Any, u: Any, inputs: Any) -> str:
    now = Instant(system, t, q, u, inputs)
    motion = now.motion(now.t, now.q, now.u_all)
    reason = system.why_not_finite(motion, now.inputs)
    if reason:
        return reason
    loads = now.loads(motion)
    wrong = [x for x in loads if not all(np.isfinite(float(c)) for c in x.vector.components)]
    places = [f"the force at {x.point.name!r}" if isinstance(x, Force) else "a torque" for x in wrong]
    if not places:
        return "the loads are not finite"
    opposite = len(places) > 1 and all(isinstance(x, Force) for x in wrong)
    hint = " (between two points in one place there is no direction)" if opposite else ""
    return f"{_listed(places)} {'is' if len(places) == 1 else 'are'} not finite{hint}"


def _massless(M: np.ndarray, speeds: tuple[str, ...], rounding: float) -> str:
    """The null directions of a mass matrix, by the names of their speeds."""
    # Units apart: a speed is compared with the largest entry of its own row.
    rows = np.abs(M).max(axis=1)
    alone = [speed for speed, size in zip(speeds, rows, strict=True) if size <= rounding * rows.max()]
    if alone:
        return f"no mass moves with the speed{'s' * (len(alone) > 1)} {_listed(alone)}"
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
    if values[0] > rounding:
        return ""
    vector = np.abs(vectors[:, 0])
    together = [speed for speed, x in zip(speeds, vector, strict=True) if x > 1e-6 * vector.max()]
    return f"the mass matrix is singular: a combination of {_listed(together)} moves no mass"


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words)
