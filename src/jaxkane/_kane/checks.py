"""Checks of a description and of a state, and why Kane's equations have no solution, in words. Changes nothing."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._scalarjit.backends.numpy import in_numbers
from .._scalarjit.cache_key import compiled
from .._scalarjit.compat import concretely
from .._scalarjit.function import fused
from .._scalarjit.linear import as_vector, rounding_of_pivots, stack
from .._scalarjit.nan import nan_where
from .._system.bodies import Force
from .._system.motion import flatten_residuals
from .._system.parameters import in_batches
from .._system.system import State, System
from .arguments import Row
from .consistency import check_description
from .constraints import configuration_residual, constraint_rows, dependent_speeds_from
from .evaluate import DescriptionEvaluator
from .kane import KaneEquations, rates_and_equations

ROUNDING, MEASURED = 2e-3, 0.05


def is_concrete(*trees: Any) -> bool:
    """Whether all arrays in these are numbers rather than traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def check_system(system: System, t: Any, q: Any, *, bodies: bool = True) -> None:
    """Refuse a description that contradicts itself, once for each structure, and `bodies` that cannot be.

    What is traced is replaced by its value where it has one (in `jax.grad` alone), else by trial numbers, as are
    coordinates that are None; bodies are checked where all numbers are known.

    **Raises:** `ValueError` as `check_description`; for a negative mass, and an inertia that no body can have, as
    `check_bodies` says.
    """
    if in_batches(system):
        return
    system, t, q = jax.tree.map(_value, (system, t, q))
    # Always of one type: a Python number and an array would be two programs.
    t = t if isinstance(t, Tracer) else np.asarray(t, jnp.result_type(float) if q is None else q.dtype)
    with concretely(), np.errstate(invalid="ignore", over="ignore"):
        check_description(system, t, q)
        if bodies and q is not None and is_concrete(system, t, q):
            check_bodies(system, t, q)


def _value(x: Any) -> Any:
    # `stop_gradient` of a number that is being differentiated is the number; of one that is traced it is traced.
    return jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x


@fused
def _masses_and_inertias(system: System, t: Any, q: Any):
    bodies = DescriptionEvaluator(system).read("bodies", t, *_at_rest(system, q))
    return [(jnp.asarray(mass), stack(inertia)) for mass, inertia in bodies]


def _at_rest(system: System, q: Any) -> tuple[Row, Row]:
    still = (0.0,) * (len(system.speeds) + len(system.dependent_speeds))
    return tuple(q[i] for i in range(len(system.coordinates))), still


def check_bodies(system: System, t: Any, q: Any) -> None:
    """Refuse masses and inertias that no body can have.

    The largest principal moment of inertia is at most the sum of the other two. By up to 0.2 % more it is taken for
    rounding, by up to 5 % for measured and warned about, beyond that refused, unless the class has
    `check_inertia = False`. A moment about one axis alone, (0, 0, J), is a rotor's: the other two are elsewhere.
    """
    for i, (mass, I) in enumerate(in_numbers(_masses_and_inertias, system, t, q)):
        mass, I = float(mass), np.asarray(I, dtype=float)  # [kg], (3,3) [kg m^2]
        fault = _fault(mass, I) or (_excess_in_words(I) if system.check_inertia else "")
        if fault:
            body = DescriptionEvaluator(system).motion(t, *_at_rest(system, q)).bodies[i]
            message = f"{type(system).__name__}, body {body.name!r}: {fault}"
            if why_no_body(mass, I, system.check_inertia):
                raise ValueError(message)
            warnings.warn(message, UserWarning, stacklevel=4)


def why_no_body(mass: float, I: np.ndarray, check_inertia: bool) -> str:
    """Why no body has this mass and inertia (3, 3), even as measured; "" where one can."""
    return _fault(mass, I) or (_excess_in_words(I) if check_inertia and _excess(I) > MEASURED else "")


def _fault(mass: float, I: np.ndarray) -> str:
    """What is wrong with a body, whatever the accuracy of its numbers."""
    slack = 1e-6 * max(np.abs(I).max(), 1e-300)
    if not mass >= 0:
        return f"the mass is {mass:.6g} kg; it must not be negative."
    if not np.all(np.isfinite(I)):
        return f"the inertia is not finite: {I.tolist()}."
    if np.abs(I - I.T).max() > slack:
        return f"the inertia matrix is not symmetric: {I.tolist()}."
    moments = np.linalg.eigvalsh(I)
    if moments[0] < -slack:
        return f"the principal moments of inertia are {_listed(moments)} kg m^2; none may be negative."
    return ""


def _excess_in_words(I: np.ndarray) -> str:
    if _excess(I) <= ROUNDING:
        return ""
    return (
        f"no body has the principal moments of inertia {_listed(np.linalg.eigvalsh(I))} kg m^2: the largest exceeds "
        "the sum of the other two (triangle inequality). Measured values may do so by a few per cent; beyond 5 % they "
        "are refused. A class that is to have them all the same says `check_inertia = False`."
    )


def _excess(I: np.ndarray) -> float:
    """By how much of itself the largest principal moment exceeds the sum of the other two; 0 for a rotor's."""
    a, b, c = np.linalg.eigvalsh(I)
    return 0.0 if b <= 1e-12 * c else float((c - a - b) / c)


def _listed(moments: np.ndarray) -> str:
    return ", ".join(f"{x:.6g}" for x in moments)


def with_possible_bodies(system: System, t: Any, state: State) -> State:
    """The state, or NaN where the system has a body that `check_bodies` refuses: for members of a batch."""
    bodies = _masses_and_inertias(system, t, state.q)
    possible = jnp.all(jnp.stack([_is_possible(mass, I, system.check_inertia) for mass, I in bodies]))
    # Whether a body can be does not depend on the state; where it is NaN, it is another check's.
    return jax.tree.map(lambda x: jnp.where(possible, x, jnp.nan), state)


def _is_possible(mass: Any, I: Any, check_inertia: bool) -> Any:
    mass, I = jax.lax.stop_gradient((mass, I))
    trace = jnp.trace(I)
    # c - a - b > 5 % of c, where c > trace / 1.95: and no c is, where trace / 1.95 - I has no eigenvalue below zero.
    possible = (mass >= 0) & (jnp.max(jnp.abs(I - I.T)) <= 1e-6 * jnp.max(jnp.abs(I))) & _is_semidefinite(I)
    if check_inertia:
        rest = trace / (2.0 - MEASURED) * jnp.eye(3, dtype=I.dtype) - I
        is_rotor = sum(_minors(I)) <= 1e-12 * trace * trace
        possible &= _is_semidefinite(rest) | is_rotor
    return possible


def _is_semidefinite(A: Any) -> Any:
    # By principal minors: LAPACK's eigenvalues of many small matrices would be slow, and wait for each other.
    size = jnp.max(jnp.abs(A))
    det = jnp.dot(A[0], jnp.cross(A[1], A[2]))
    least = [(jnp.min(jnp.diag(A)), size), (jnp.min(jnp.stack(_minors(A))), size**2), (det, size**3)]
    return jnp.all(jnp.stack([x >= -1e-6 * scale for x, scale in least]))


def _minors(A: Any) -> list[Any]:
    return [A[i, i] * A[j, j] - A[i, j] * A[j, i] for i, j in ((0, 1), (0, 2), (1, 2))]


@fused
def _implied_residual(system: System, t: Any, q: Any):
    residuals = system.implied_constraints(t, tuple(q[i] for i in range(len(q))))
    return as_vector(flatten_residuals(residuals, f"{type(system).__name__}: the residuals of implied_constraints"), q)


def implied_residual(system: System, t: Any, q: Any) -> Any:
    """Residuals (h,) that follow from the configuration constraints."""
    if type(system).implied_constraints is System.implied_constraints:
        return np.zeros(0, q.dtype)
    return _residual_of(_implied_residual, system, t, q)


def _residual_of(f: Callable[..., Any], system: System, t: Any, q: Any) -> Any:
    """Of numbers by NumPy, so that nothing is compiled."""
    return in_numbers(f, system, t, q) if is_concrete(system, t, q) else f(system, t, q)


def configuration_is_met(system: System, t: Any, q: Any) -> Any:
    """Whether the configuration constraints are met, and what follows from them."""
    residuals = [_residual_of(configuration_residual, system, t, q), implied_residual(system, t, q)]
    xp = np if is_concrete(residuals) else jnp
    h = xp.concatenate(residuals)
    return xp.all(xp.abs(h) <= configuration_tolerance(h.dtype)) if h.size else np.array(True)


def check_state(system: System, t: Any, q: Any) -> None:
    """Refuse coordinates that violate a configuration constraint, with the residual."""
    if not is_concrete(system, t, q):
        return
    residual = in_numbers(configuration_residual, system, t, q)
    if residual.size and not np.max(np.abs(residual)) <= configuration_tolerance(residual.dtype):
        adjust = ", ".join(system.dependent_coordinates) or "the coordinates"
        raise ValueError(
            f"{type(system).__name__}: the coordinates violate the configuration constraints by "
            f"{np.array2string(residual, precision=3)}. Find {adjust} with jaxkane.assemble(system, q, u)."
        )
    implied = implied_residual(system, t, q)
    if implied.size and not np.max(np.abs(implied)) <= configuration_tolerance(implied.dtype):
        raise ValueError(
            f"{type(system).__name__}: what follows from the configuration constraints is violated by "
            f"{np.array2string(implied, precision=3)}: with these parameters the loop cannot be closed."
        )


def met_or_refused(system: System, t: Any, q: Any, left_out: Sequence[str]) -> Any:
    """Coordinates of which some were left out and taken as zero, unless that violates a configuration constraint.

    **Raises:** `ValueError` that names them; under a trace the coordinates become NaN.
    """
    concrete = is_concrete(system, t, q)
    residual = _residual_of(configuration_residual, system, t, q)
    if not residual.size:
        return q
    met = configuration_is_met(system, t, q)
    if not concrete:
        return nan_where(~met, q, (system, t, q))
    if met:
        return q
    raise ValueError(
        f"{type(system).__name__}: with {', '.join(left_out)} left out of q, and taken as zero, the configuration "
        f"constraints are violated by {np.array2string(residual, precision=3)}. Find the state with "
        "jaxkane.assemble(system, q, u), and give its state.q; or name them."
    )


def configuration_tolerance(dtype: Any) -> float:
    """How far coordinates may be from the configuration constraints and still be taken as given."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


SINGULAR_ROUNDING = 1e-12

_equations = compiled(rates_and_equations)


def diagnosis(system: System, t: Any, q: Any, u: Any, inputs: Any = None) -> str:
    """What is wrong at a state where accelerations or rates are not finite, and what can be done; "" if nothing is.

    Looks, in this order, at the numbers given, the dependent speeds, the mass matrix, the rates of the coordinates and
    the loads.
    """
    name = type(system).__name__
    place = _joined(f"{c} = {float(x):.4g}" for c, x in zip(system.coordinates, q, strict=True))
    given = [("q", system.coordinates, q), ("u", system.speeds, u)]
    for label, names, values in given:
        wrong = [n for n, x in zip(names, np.asarray(values), strict=True) if not np.isfinite(x)]
        if wrong:
            return f"{name}: {label} is not finite: {_joined(wrong)}."
    if system.dependent_speeds:
        C, c0 = (np.asarray(x, dtype=float) for x in constraint_rows(system, t, q))
        found = dependent_speeds_from(C, c0, (*system.speeds, *system.dependent_speeds), system.dependent_speeds, name)
        if not found.condition < 1 / SINGULAR_ROUNDING:
            n = len(system.speeds)
            absent = [speed for speed, column in zip(system.dependent_speeds, C.T[n:], strict=True) if not column.any()]
            cause = f"no velocity residual depends on {_joined(absent)}" if absent else "det C_dep = 0"
            return (
                f"{name}: the constraints cannot be solved for {_joined(system.dependent_speeds)} at {place} "
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
            f"{name}: the rates of {_joined(wrong)} are not finite at {place}: angles of a sequence lock there (gimbal "
            "lock). Start elsewhere; or describe the orientation with Euler parameters, or with another sequence."
        )
    if not np.all(np.isfinite(f)):
        return f"{name}: {_loads_not_finite(system, t, q, u, inputs or {})} at {place}."
    return ""


def _loads_not_finite(system: System, t: Any, q: Any, u: Any, inputs: Any) -> str:
    now = KaneEquations(system, t, q, u, inputs)
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
    return f"{_joined(places)} {'is' if len(places) == 1 else 'are'} not finite{hint}"


def _massless(M: np.ndarray, speeds: tuple[str, ...], rounding: float) -> str:
    """The null directions of a mass matrix, by the names of their speeds."""
    # Units apart: a speed is compared with the largest entry of its own row.
    rows = np.abs(M).max(axis=1)
    alone = [speed for speed, size in zip(speeds, rows, strict=True) if size <= rounding * rows.max()]
    if alone:
        return f"no mass moves with the speed{'s' * (len(alone) > 1)} {_joined(alone)}"
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
    if values[0] > rounding:
        return ""
    vector = np.abs(vectors[:, 0])
    together = [speed for speed, x in zip(speeds, vector, strict=True) if x > 1e-6 * vector.max()]
    return f"the mass matrix is singular: a combination of {_joined(together)} moves no mass"


def _joined(words: Iterable[str]) -> str:
    return ", ".join(words)
