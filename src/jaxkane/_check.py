"""Checks of a description and of a state, with errors that name what is wrong. Knows the method; changes nothing.

Numbers are checked only where they are numbers: under a trace, and in a batch, a bad member gets a status instead.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._components import cross
from ._fuse import fused
from ._kane import Instant
from ._linear import as_vector, stack
from ._nan import nan_where
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
            now = Instant(system, t, q, u)
            if not np.all(np.isfinite([float(x) for x in now.q])):
                return
            _check_affine(now)
            if not np.all(np.isfinite([float(x) for x in now.u_all])):
                return
            _check_rates(now)
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
    return {name: np.array([float(x) for x in values]) for name, values in found.items()}


def _check_affine(now: Instant) -> None:
    names = (*now.system.speeds, *now.system.dependent_speeds)
    n = len(names)
    points = np.random.default_rng(0).uniform(0.5, 1.5, n)
    at = lambda *places: tuple(float(points[i]) if i in places else 0.0 for i in range(n))  # noqa: E731
    zero, full = _velocities(now, at()), _velocities(now, at(*range(n)))
    single = [_velocities(now, at(i)) for i in range(n)]
    twice = [_velocities(now, tuple(2.0 * x for x in at(i))) for i in range(n)]
    for what in zero:
        curved = [
            names[i]
            for i in range(n)
            if _differs(now, twice[i][what] - 2.0 * single[i][what] + zero[what], single[i][what])
        ]
        sum_of_parts = zero[what] + sum(s[what] - zero[what] for s in single)
        if curved or _differs(now, full[what] - sum_of_parts, full[what]):
            which = f"in {', '.join(curved)}" if curved else "in the speeds: it holds products of two speeds"
            raise ValueError(
                f"{now.name}: {what} is not affine {which}. Kane's method needs velocities that are linear in the "
                "speeds, plus a term that may depend on time and coordinates."
            )


def _differs(now: Instant, difference: Any, size: Any) -> bool:
    eps = float(jnp.finfo(jnp.result_type(*[x for x in now.q if not isinstance(x, float)] or [float])).eps)
    difference, size = np.max(np.abs(difference), initial=0.0), np.max(np.abs(size), initial=1.0)
    return bool(np.isfinite(difference) and difference > eps**0.5 * size)


def _check_rates(now: Instant) -> None:
    rng = np.random.default_rng(1)
    q = [jnp.asarray(x) for x in now.q]
    if not now.configuration(now.t, now.q):  # free to look beside the given configuration
        q = [x + jnp.asarray(rng.uniform(-0.1, 0.1), x.dtype) for x in q]
    u = [jnp.asarray(rng.uniform(0.5, 1.5), x.dtype) for x in map(jnp.asarray, now.u)]
    now = Instant(now.system, now.t, q, u)

    def geometry(t, *q):
        motion = now.motion(t, q, now.u_all)
        frames = [_rotation(f) for f in _frames(motion)]
        points = [
            b.center.position.to(motion.N) if b.center.has_position else jnp.zeros(3, q[0].dtype) for b in motion.bodies
        ]
        return frames, points

    tangents = (1.0, *now.q_dot)
    primals = [jnp.asarray(x, dtype=q[0].dtype) for x in (now.t, *now.q)]
    (rotations, _), (rotations_dot, points_dot) = jax.jvp(
        geometry, primals, [jnp.asarray(x, dtype=q[0].dtype) for x in tangents]
    )
    motion = now.motion(now.t, now.q, now.u_all)
    for frame, R, R_dot in zip(_frames(motion), rotations, rotations_dot, strict=True):
        skew = R_dot.T @ R  # [omega x] in N, for R from N to the frame
        by_orientation = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        _compare(now, f"frame {frame.name!r}", "turns", "rad/s", by_orientation, frame.angular_velocity.to(motion.N))
    for body, by_position in zip(motion.bodies, points_dot, strict=True):
        if body.center.has_position:
            velocity = body.center.velocity.to(motion.N)
            _compare(now, f"mass centre of {body.name!r}", "moves", "m/s", by_position, velocity)
        _check_axisymmetry(now, body)
        _check_about(now, body)


def _compare(now: Instant, what: str, verb: str, unit: str, by_position: Any, stated: Any) -> None:
    by_position, stated = np.asarray(by_position), np.asarray(stated)
    if _differs(now, by_position - stated, stated):
        show = lambda x: "(" + ", ".join(f"{a:.4g}" for a in x) + ")"  # noqa: E731
        raise ValueError(
            f"{now.name}: the {what} {verb} with {show(by_position)} {unit} by the rates of its coordinates, but with "
            f"{show(stated)} {unit} by its description (components in N, at a trial state). A rate that is given to a "
            "frame or a point contradicts q_dot; or a point is called fixed in a frame in which it moves."
        )


def _check_about(now: Instant, body) -> None:
    """The point about which an inertia was given moves with the body's frame, or the inertia would change there."""
    if body.about is None:
        return
    N = body.frame.root
    r = body.about.position_from(body.center)
    carried = (body.center.velocity + body.frame.angular_velocity.cross(r)).to(N)
    if _differs(now, np.asarray(body.about.velocity.to(N)) - np.asarray(carried), carried):
        raise ValueError(
            f"{now.name}: the inertia of the body {body.name!r} is given about a point that moves in its frame "
            f"{body.frame.name!r}, so that it is not constant there. Give it about a point of the body, or about the "
            "mass centre."
        )


def _check_axisymmetry(now: Instant, body) -> None:
    spin = body.angular_velocity - body.frame.angular_velocity
    I = np.asarray(stack(body.inertia))
    s = np.array([float(x) for x in spin.components_in(body.frame)])
    turned = np.array([[float(x) for x in cross(tuple(s), tuple(column))] for column in I.T]).T  # [s x] I
    if _differs(now, turned + turned.T, np.abs(I).max() * max(np.abs(s).max(), 1.0)):
        raise ValueError(
            f"{now.name}: the body {body.name!r} turns in its frame {body.frame.name!r}, but its inertia is not "
            "symmetric about that axis, so it is not constant there. Give the body a frame that turns with it."
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


def met_or_refused(system: System, t: Any, q: Any, left_out: Sequence[str]) -> Any:
    """Coordinates of which some were left out and taken as zero, unless that violates a configuration constraint.

    **Raises:** `ValueError` that names them; under a trace the coordinates become NaN.
    """
    residual = configuration_residual(system, t, q)
    if not residual.size:
        return q
    met = jnp.max(jnp.abs(residual)) <= configuration_tolerance(residual.dtype)
    if is_concrete(met) and not met:
        raise ValueError(
            f"{type(system).__name__}: with {', '.join(left_out)} left out of q, and taken as zero, the configuration "
            f"constraints are violated by {np.array2string(np.asarray(residual), precision=3)}. Find the state with "
            "jaxkane.assemble(system, q, u), and give its state.q; or name them."
        )
    return nan_where(~met, q, (system, t, q))


def configuration_tolerance(dtype: Any) -> float:
    """How far coordinates may be from the configuration constraints and still be taken as given."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


@fused
def configuration_residual(system: System, t: Any, q: Any):
    """Residuals (h,) of the configuration constraints."""
    residuals = system.configuration_constraints(t, [q[i] for i in range(len(system.coordinates))])
    return as_vector(tuple(residuals), q)
