"""Checks of a description and of a state, with errors that name what is wrong. Knows the method; changes nothing.

Numbers are checked only where they are numbers: under a trace, and in a batch, a bad member gets a status instead.
"""

from __future__ import annotations

import warnings
import weakref
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._fuse import evaluated, fused
from ._kane import Instant
from ._linear import as_vector, stack
from ._system import Motion, System, parameter_info
from ._vectors import Frame

_CHECKED: weakref.WeakSet[type] = weakref.WeakSet()


def is_concrete(*trees: Any) -> bool:
    """Whether all arrays in these are numbers rather than traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def is_batch(system: System) -> bool:
    """Whether some parameter has leading axes more than it was declared with."""
    return any(np.ndim(getattr(system, name)) > len(info.shape) for name, info in parameter_info(system).items())


def check_system(system: System, t: Any, q: Any, u: Any, *, strict: bool = False) -> None:
    """Refuse bodies that cannot be, and, once for each class of systems, a description that contradicts itself.

    Moments of inertia that no body can have are refused where motions begin (`strict`), and elsewhere warned about:
    equations may be compared at any numbers.

    **Raises:** `ValueError` for velocities or residuals that are not affine in the speeds, frames and points that do
    not move as their coordinates' rates say, a body whose inertia is not constant in its frame, a negative mass, an
    inertia that no body can have.
    """
    if not is_concrete(system, t, q, u) or is_batch(system):
        return
    with jax.ensure_compile_time_eval(), np.errstate(invalid="ignore"):
        if type(system) not in _CHECKED:
            if not np.all(np.isfinite(np.asarray(q, dtype=float))):
                return
            velocities, u_all = evaluated(_trial_velocities, system, t, q, u)
            eps = float(jnp.finfo(jnp.asarray(q).dtype).eps)
            _check_affine(system, velocities, eps)
            if not np.all(np.isfinite(u_all)):
                return
            _check_rates(system, t, q, u, eps)
            _CHECKED.add(type(system))
        _check_bodies(system, t, q, u, strict)


@fused
def _masses_and_inertias(system: System, t: Any, q: Any, u: Any):
    now = Instant(system, t, q, u)
    bodies = now.motion(now.t, now.q, now.u_all).bodies
    return [(jnp.asarray(body.mass), stack(body.inertia)) for body in bodies]


def _check_bodies(system: System, t: Any, q: Any, u: Any, strict: bool) -> None:
    for i, (mass, I) in enumerate(_masses_and_inertias(system, t, q, u)):
        mass, I = float(mass), np.asarray(I)  # [kg], (3,3) [kg m^2]
        fault, is_grave = _fault(mass, I)
        if fault:
            now = Instant(system, t, q, u)
            body = now.motion(now.t, now.q, now.u_all).bodies[i]
            message = f"{type(system).__name__}, body {body.name!r}: {fault}"
            if is_grave or (strict and _excess(I) > 0.05):
                raise ValueError(message)
            warnings.warn(message, UserWarning, stacklevel=4)


def _fault(mass: float, I: np.ndarray) -> tuple[str, bool]:
    """What is wrong with a body, and whether there is no arguing about it."""
    slack = 1e-6 * max(np.abs(I).max(), 1e-300)
    if not mass >= 0:
        return f"the mass is {mass:.6g} kg; it must not be negative.", True
    if not np.all(np.isfinite(I)):
        return f"the inertia is not finite: {I.tolist()}.", True
    if np.abs(I - I.T).max() > slack:
        return f"the inertia matrix is not symmetric: {I.tolist()}.", True
    moments = np.linalg.eigvalsh(I)
    listed = ", ".join(f"{x:.6g}" for x in moments)
    if moments[0] < -slack:
        return f"the principal moments of inertia are {listed} kg m^2; none may be negative.", True
    if _excess(I) > 2e-3:  # beyond what the rounding of printed values does
        return (
            f"no body has the principal moments of inertia {listed} kg m^2: the largest exceeds the sum of the other "
            "two (triangle inequality). Measured values may do so by a few per cent; more is a mistake."
        ), False
    return "", False


def _excess(I: np.ndarray) -> float:
    """By how much of itself the largest principal moment exceeds the sum of the other two."""
    a, b, c = np.linalg.eigvalsh(I)
    return float((c - a - b) / max(c, 1e-300))


def _velocities(now: Instant, u) -> dict[str, Any]:
    motion = now.motion(now.t, now.q, u)
    found: dict[str, Any] = {}
    for i, residual in enumerate(motion.constraints):
        found[f"the velocity residual {i}"] = [residual]
    for body in motion.bodies:
        found[f"the velocity of {body.name!r}"] = body.center.velocity.components
        found[f"the angular velocity of {body.name!r}"] = body.angular_velocity.components
    for name, rate in zip(now.system.coordinates, now.rates(now.t, now.q, u), strict=True):
        found[f"the rate of the coordinate {name!r}"] = [rate]
    return {name: stack([values])[0] for name, values in found.items()}


def _trial_velocities(system: System, t: Any, q: Any, u: Any):
    """All velocities at no speed, at all speeds, at each alone and at twice each; and the speeds at `u`."""
    now = Instant(system, t, q, u)
    n = now.n + now.k
    points = np.random.default_rng(0).uniform(0.5, 1.5, n)
    at = lambda *places, by=1.0: tuple(by * float(points[i]) if i in places else 0.0 for i in range(n))  # noqa: E731
    zero, full = _velocities(now, at()), _velocities(now, at(*range(n)))
    single = [_velocities(now, at(i)) for i in range(n)]
    twice = [_velocities(now, at(i, by=2.0)) for i in range(n)]
    return (zero, full, single, twice), stack([now.u_all])


def _check_affine(system: System, velocities: Any, eps: float) -> None:
    zero, full, single, twice = velocities
    names = (*system.speeds, *system.dependent_speeds)
    for what in zero:
        curved = [
            name
            for name, one, two in zip(names, single, twice, strict=True)
            if _differs(two[what] - 2.0 * one[what] + zero[what], one[what], eps)
        ]
        sum_of_parts = zero[what] + sum(s[what] - zero[what] for s in single)
        if curved or _differs(full[what] - sum_of_parts, full[what], eps):
            which = f"in {', '.join(curved)}" if curved else "in the speeds: it holds products of two speeds"
            raise ValueError(
                f"{type(system).__name__}: {what} is not affine {which}. Kane's method needs velocities that are "
                "linear in the speeds, plus a term that may depend on time and coordinates."
            )


def _differs(difference: Any, size: Any, eps: float) -> bool:
    difference, size = np.max(np.abs(difference), initial=0.0), np.max(np.abs(size), initial=1.0)
    return bool(np.isfinite(difference) and difference > eps**0.5 * size)


def _trial_rates(system: System, t: Any, q: Any, u: Any):
    """By name and beside the given state: how frames and mass centres move by their places and by their velocities, in
    N; and how bodies turn in their frames (spin, inertia)."""
    rng = np.random.default_rng(1)
    now = Instant(system, t, q, u)
    beside = list(now.q)
    if not now.configuration(now.t, now.q):  # free to look beside the given configuration
        beside = [x + jnp.asarray(rng.uniform(-0.1, 0.1), x.dtype) for x in beside]
    dtype = beside[0].dtype
    now = Instant(system, now.t, beside, [jnp.asarray(rng.uniform(0.5, 1.5), dtype) for _ in now.u])

    def geometry(t, *q):
        motion = now.motion(t, q, now.u_all)
        points = [b.center.position.to(motion.N) for b in motion.bodies if b.center.has_position]
        return [_rotation(f) for f in _frames(motion)], points

    primals, tangents = ([jnp.asarray(x, dtype) for x in xs] for xs in ((now.t, *now.q), (1.0, *now.q_dot)))
    (rotations, _), (rotations_dot, points_dot) = jax.jvp(geometry, primals, tangents)
    motion = now.motion(now.t, now.q, now.u_all)
    # Keys are numbered, since two frames may have one name.
    frames = {
        (i, frame.name): (R, R_dot, frame.angular_velocity.to(motion.N))
        for i, (frame, R, R_dot) in enumerate(zip(_frames(motion), rotations, rotations_dot, strict=True))
    }
    placed = [b for b in motion.bodies if b.center.has_position]
    points = {
        (i, b.name): (x_dot, b.center.velocity.to(motion.N))
        for i, (b, x_dot) in enumerate(zip(placed, points_dot, strict=True))
    }
    bodies = {
        (i, b.name, b.frame.name): ((b.angular_velocity - b.frame.angular_velocity).to(b.frame), stack(b.inertia))
        for i, b in enumerate(motion.bodies)
    }
    return frames, points, bodies


def _check_rates(system: System, t: Any, q: Any, u: Any, eps: float) -> None:
    name = type(system).__name__
    frames, points, bodies = evaluated(_trial_rates, system, t, q, u)
    for (_, frame), (R, R_dot, stated) in frames.items():
        skew = R_dot.T @ R  # [omega x] in N, for R from N to the frame
        by_orientation = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        _compare(f"{name}: the frame {frame!r} turns", "rad/s", by_orientation, stated, eps)
    for (_, body), (by_position, stated) in points.items():
        _compare(f"{name}: the mass centre of {body!r} moves", "m/s", by_position, stated, eps)
    for (_, body, frame), (spin, I) in bodies.items():
        turned = np.cross(spin, I.T).T  # [spin x] I
        if _differs(turned + turned.T, np.abs(I).max() * max(np.abs(spin).max(), 1.0), eps):
            raise ValueError(
                f"{name}: the body {body!r} turns in its frame {frame!r}, but its inertia is not symmetric about that "
                "axis, so it is not constant there. Give the body a frame that turns with it."
            )


def _compare(what: str, unit: str, by_position: Any, stated: Any, eps: float) -> None:
    if _differs(by_position - stated, stated, eps):
        show = lambda x: "(" + ", ".join(f"{a:.4g}" for a in x) + ")"  # noqa: E731
        raise ValueError(
            f"{what} with {show(by_position)} {unit} by the rates of its coordinates, but with {show(stated)} {unit} "
            "by its description (components in N, at a trial state). A rate that is given to a frame or a point "
            "contradicts q_dot; or a point is called fixed in a frame in which it moves."
        )


def _frames(motion: Motion) -> list[Frame]:
    frames: list[Frame] = []
    for body in motion.bodies:
        for frame in (body.frame, body.center.velocity.frame):
            while frame is not None and frame not in frames:
                frames.append(frame)
                frame = frame.parent
    return frames


def _rotation(frame: Frame):
    return frame.matrix(frame.root)


def check_state(system: System, t: Any, q: Any) -> None:
    """Refuse coordinates that violate a configuration constraint, with the residual."""
    if not is_concrete(system, t, q):
        return
    residual = configuration_residual(system, t, q)
    if residual.size and not np.max(np.abs(residual)) <= configuration_tolerance(residual.dtype):
        adjust = ", ".join(system.dependent_coordinates) or "the coordinates"
        raise ValueError(
            f"{type(system).__name__}: the coordinates violate the configuration constraints by "
            f"{np.array2string(np.asarray(residual), precision=3)}. Find {adjust} with jaxkane.assemble(system, q, u)."
        )


def configuration_tolerance(dtype: Any) -> float:
    """How far coordinates may be from the configuration constraints and still be taken as given."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


@fused
def configuration_residual(system: System, t: Any, q: Any):
    """Residuals (h,) of the configuration constraints."""
    residuals = system.configuration_constraints(t, [q[i] for i in range(len(system.coordinates))])
    return as_vector(tuple(residuals), q)
