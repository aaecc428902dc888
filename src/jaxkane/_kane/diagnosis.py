"""Why the equations of motion have no solution at a state: an explanation for the user."""

from __future__ import annotations

import numpy as np

from .._scalarjit.components import Component, Numbers, rounding_of_pivots, stack
from .._scalarjit.scalar_function import ScalarFunction
from .._system.motion import Force
from .._system.system import System
from .arguments import (
    Coordinates,
    InputValues,
    Speeds,
    Time,
    as_row,
    is_concrete,
    without_derivatives,
)
from .constraint_residuals import SINGULAR_ROUNDING, dependent_speeds_at
from .kanes_method import KaneEquations, compiled, rates_and_equations


def diagnosis(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None) -> str:
    """Explain why accelerations or rates are not finite at a state, and what to do. Return "" if no cause is found.

    The order of the checks is: the given numbers, the dependent speeds, the mass matrix, the rates of the coordinates,
    the loads.
    """
    system, t, q, u, inputs = without_derivatives((system, t, q, u, inputs))
    if not is_concrete(system, t, q, u, inputs):
        return ""
    name = type(system).__name__
    place = ", ".join(f"{c} = {float(x):.4g}" for c, x in zip(system.coordinates, q, strict=True))
    for label, names, values in (("q", system.coordinates, q), ("u", system.speeds, u)):
        wrong = [n for n, x in zip(names, np.asarray(values), strict=True) if not np.isfinite(x)]
        if wrong:
            return f"{name}: {label} is not finite: {', '.join(wrong)}."
    if system.dependent_speeds:
        choices = dependent_speeds_at(system, t, q)
        if not choices.condition < 1 / SINGULAR_ROUNDING:
            absent = ", ".join(choices.absent)
            cause = f"no velocity residual depends on {absent}" if absent else "det C_dep = 0"
            return (
                f"{name}: the constraints cannot be solved for {', '.join(system.dependent_speeds)} at {place} "
                f"({cause}): {choices.advice()}"
            )
    q_dot, M, f = (np.asarray(x) for x in compiled[rates_and_equations](system, t, q, u, inputs or {}))
    if not np.all(np.isfinite(M)):
        return f"{name}: the mass matrix is not finite at {place}."
    rounding, M = rounding_of_pivots(M.dtype), M.astype(float)
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
    null = vectors[:, 0] * scale / np.abs(vectors[:, 0] * scale).max()
    if values[0] <= rounding:  # a linear combination of the speeds without kinetic energy
        together = ", ".join(s for s, x in zip(system.speeds, null, strict=True) if abs(x) > 1e-6)
        if _moves_nothing(system, t, q, u, null):
            return (
                f"{name}: the speeds {together} can change together without moving any body at {place}, so that their "
                "accelerations are not determined. The cause is gimbal lock, or two speeds that describe the same "
                "motion. Choose another state, or use Euler parameters or another sequence of angles for the "
                "orientation."
            )
        # The mass of a speed is the largest entry of its row. Differences between the units are ignored.
        rows = np.abs(M).max(axis=1)
        alone = [speed for speed, size in zip(system.speeds, rows, strict=True) if size <= rounding * rows.max()]
        massless = f"no mass moves with the speed{'s' * (len(alone) > 1)} {', '.join(alone)}"
        if not alone:
            massless = f"the mass matrix is singular: a combination of {together} does not move any mass"
        return (
            f"{name}: {massless}, so Kane's equations have no solution. Add masses, and moments of inertia about "
            "all axes of rotation (a thin rod needs one about its own axis, too), or remove the speed from the system."
        )
    # cos(pi / 2) is 6e-17, so the rates of angles in gimbal lock are finite: 1e16 times the speeds.
    largest = 1e12 * float(np.abs(u).max(initial=0.0)) or np.inf
    wrong = [c for c, x in zip(system.coordinates, q_dot, strict=True) if not np.isfinite(x) or abs(x) > largest]
    if wrong:
        return (
            f"{name}: the rates of {', '.join(wrong)} are not finite, or above 1e12 times the speeds, at {place}: "
            "the angles are in gimbal lock. Choose another state, or use Euler parameters or another sequence of "
            "angles for the orientation."
        )
    if not np.all(np.isfinite(f)):
        return f"{name}: {_loads_not_finite(system, t, q, u, inputs or {})} at {place}."
    return ""


def _loads_not_finite(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues) -> str:
    kane = KaneEquations(system, t, q, u, inputs)
    motion = kane.motion(kane.t, kane.q, kane.u_all)
    reason = system.why_not_finite(motion, kane.inputs)
    if reason:
        return reason
    wrong = [x for x in kane.loads(motion) if not all(np.isfinite(float(c)) for c in x.vector.components)]
    if not wrong:
        return "the loads are not finite"
    places = [f"the force at {x.point.name!r}" if isinstance(x, Force) else "a torque" for x in wrong]
    opposite = len(places) > 1 and all(isinstance(x, Force) for x in wrong)
    hint = " (two points coincide, so the force between them has no direction)" if opposite else ""
    return f"{', '.join(places)} {'is' if len(places) == 1 else 'are'} not finite{hint}"


def _moves_nothing(system: System, t: Component, q: Numbers, u: Numbers, direction: np.ndarray) -> bool:
    """Whether a combination of the speeds leaves all bodies at rest, although the single speeds move bodies."""
    at = _body_velocities.numpy(system, t, q, u, np.asarray(direction, q.dtype))
    each = [_body_velocities.numpy(system, t, q, u, np.asarray(x, q.dtype)) for x in np.diag(direction)]
    sizes = np.max(np.linalg.norm(each, axis=-1), axis=0)  # (2b,) of velocities and angular velocities
    return bool(sizes.any() and np.all(np.linalg.norm(at, axis=-1) <= 1e-6 * sizes))


@ScalarFunction.compile_cheaply
def _body_velocities(system: System, t: Time, q: Coordinates, u: Speeds, direction: Speeds):
    kane = KaneEquations(system, t, q, u)
    along = kane.with_dependent(as_row(direction, system.speeds, "direction"))
    return stack([x for pair in kane.along_speeds(kane.velocities, along)[0] for x in pair]).astype(q.dtype)
