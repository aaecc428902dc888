"""Types of joints, with their coordinates, rates, kinematics and loads, and the functions that users call for
joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from .. import rotations
from .._common.lookup import refuse_if
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, ComponentsLike, Triple, is_zero, mul, sub
from .._system.kinematics import Frame, Point
from .._system.motion import Force, Load, ReflectedInertia, Torque


def unit_vector(axis: ComponentsLike, name: str) -> Triple:
    """A direction as three floats of length 1. Components within rounding of zero or one are made exact."""
    a = exact_numbers(axis, f"The axis of {name!r}")
    length = float(np.linalg.norm(a)) if a.shape == (3,) else 0.0
    refuse_if(not length > 0.0, f"The axis of {name!r} must be three numbers that are not all zero, got {axis!r}.")
    return tuple(exact(x) for x in a / length)  # type: ignore[return-value]


def exact_numbers(values: npt.ArrayLike, what: str) -> np.ndarray:
    """Numbers of a structure, which are constants of compiled programs and cannot be differentiated.

    **Raises:** `TypeError` for traced values; `ValueError` for values that are not finite numbers.
    """
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(values)):
        raise TypeError(
            f"{what} is part of the structure and must be concrete, but is traced (by jax.jit, jax.grad or jax.vmap). "
            "Positions, masses, inertias, gains, dampers and springs may be traced."
        )
    try:
        numbers = np.asarray(values)
    except (TypeError, ValueError):
        numbers = np.array(None)
    # text is refused, also if it could be converted to a number
    refuse_if(
        numbers.dtype.kind not in "iuf" or not np.all(np.isfinite(numbers)),
        f"{what} must be finite numbers, got {values!r}.",
    )
    return numbers.astype(float)


def exact(x: float) -> float:
    """A direction cosine without the rounding error of the angle from which it was computed."""
    nearest = float(round(x))
    return nearest if abs(x - nearest) < 1e-15 else float(x)


def is_structural_zero(value: object) -> bool:
    """Whether a value is a zero that was written as a number. Such a zero is structure and costs nothing; a JAX array
    is a parameter."""
    return not isinstance(value, jax.Array) and np.ndim(value) == 0 and not isinstance(value, str) and value == 0


def components(name: str, values: ComponentsLike) -> dict[str, Any]:
    """Three numbers as parameters `name.x`, `name.y`, `name.z`."""
    refuse_if(not hasattr(values, "__len__") or len(values) != 3, f"{name} must have three components, got {values!r}.")
    return {f"{name}.{end}": x for end, x in zip("xyz", values, strict=True) if not is_structural_zero(x)}


class JointKinematics(NamedTuple):
    """Frame and point of a joint on its parent, and on the child that it carries."""

    parent_frame: Frame
    parent_point: Point
    child_frame: Frame
    child_point: Point


@dataclasses.dataclass(frozen=True)
class JointType:
    """The static part of one joint. `axis`: a unit vector in the link's frame, for joints with an axis."""

    name: str
    axis: Triple = (0.0, 0.0, 1.0)
    reference: float = 0.0  # the coordinate at the link's initial position and orientation
    has_stops: tuple[bool, bool] = (False, False)  # a lower and an upper limit of the coordinate
    has_friction: bool = False  # dry friction

    coordinates: ClassVar[tuple[tuple[str, str], ...]] = ()  # ending of the name, unit
    speeds: ClassVar[tuple[tuple[str, str], ...]] = ()

    def names(self, endings: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
        return tuple(self.name + ending for ending, _ in endings)

    def kinematics(
        self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple
    ) -> JointKinematics:
        raise NotImplementedError

    def rates(self, q: Sequence[Component], u: Sequence[Component]) -> Sequence[Component]:
        return u

    def norm(self, q: Sequence[Component]) -> tuple[Component, ...]:
        """Residuals of the coordinates themselves: the norm of Euler parameters."""
        return ()

    def displacement(self, q: Sequence[Component], rest: Sequence[Component]) -> tuple[Component, ...]:
        """The displacement of the joint from the rest position of its spring, along each speed."""
        return (sub(q[0], rest[0]),)

    def loads(self, at: JointKinematics, forces: Sequence[Component]) -> tuple[Load, ...]:
        """Forces along each speed [N or N m], with their reactions on the parent."""
        raise NotImplementedError

    def rotors(self, N: Frame, at: Point, armature: Component, u: Sequence[Component]) -> tuple[ReflectedInertia, ...]:
        """Bodies of kinetic energy 1/2 armature u^2: they add `armature` to the diagonal of the mass matrix.

        The angular velocity u N.x does not depend on the motion of the carrier. Its direction is fixed, so that the
        moment depends only on u_dot.
        """
        triples = [[*u[i : i + 3], 0.0, 0.0][:3] for i in range(0, len(u), 3)]
        return tuple(
            ReflectedInertia(
                0.0,
                tuple(armature if 3 * i + j < len(u) else 0.0 for j in range(3)),
                at,
                N,
                N.vector(*triple),
                name=f"rotor of {self.name}" + (f", {i + 1}" if len(triples) > 1 else ""),
            )
            for i, triple in enumerate(triples)
        )


class Hinge(JointType):
    coordinates = (("", "rad"),)
    speeds = (("_rate", "rad/s"),)

    def kinematics(self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple):
        angle = sub(q[0], self.reference)
        G = F.rotate(F.vector(*self.axis), angle, u[0], f"{self.name} joint")
        return JointKinematics(F, P, G, _about(P, F, G, anchor))

    def loads(self, at: JointKinematics, forces: Sequence[Component]):
        return (Torque(forces[0] * at.child_frame.vector(*self.axis), at.child_frame, at.parent_frame),)


class Slide(JointType):
    coordinates = (("", "m"),)
    speeds = (("_rate", "m/s"),)

    def kinematics(self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple):
        axis = F.vector(*self.axis)
        return JointKinematics(F, P, F, P.moving(sub(q[0], self.reference) * axis, u[0] * axis, F))

    def loads(self, at: JointKinematics, forces: Sequence[Component]):
        push = forces[0] * at.parent_frame.vector(*self.axis)
        # The reaction acts on the parent's material point at the slider, which does not move with the slider.
        rail = at.parent_point.fixed(at.child_point.position_from(at.parent_point), at.parent_frame)
        return Force(push, at.child_point), Force(-push, rail)


_EULER = (("_e1", ""), ("_e2", ""), ("_e3", ""), ("_e4", ""))
_OMEGA = (("_w1", "rad/s"), ("_w2", "rad/s"), ("_w3", "rad/s"))


class Ball(JointType):
    coordinates = _EULER
    speeds = _OMEGA

    def kinematics(self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple):
        G = F.rotate_euler(q, u, f"{self.name} joint")
        return JointKinematics(F, P, G, _about(P, F, G, anchor))

    def rates(self, q: Sequence[Component], u: Sequence[Component]):
        return rotations.euler_parameter_rates(q, u)

    def norm(self, q: Sequence[Component]):
        return (rotations.euler_parameter_norm(q),)

    def displacement(self, q: Sequence[Component], rest: Sequence[Component]):
        return _rotation_vector(q)

    def loads(self, at: JointKinematics, forces: Sequence[Component]):
        return (Torque(at.child_frame.vector(*forces), at.child_frame, at.parent_frame),)


class Free(JointType):
    coordinates = (("_x", "m"), ("_y", "m"), ("_z", "m"), *_EULER)
    speeds = (("_vx", "m/s"), ("_vy", "m/s"), ("_vz", "m/s"), *_OMEGA)

    def kinematics(self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple):
        G = F.rotate_euler(q[3:], u[3:], f"{self.name} joint")
        return JointKinematics(F, P, G, P.moving(F.vector(*q[:3]), F.vector(*u[:3]), F))

    def rates(self, q: Sequence[Component], u: Sequence[Component]):
        return (*u[:3], *rotations.euler_parameter_rates(q[3:], u[3:]))

    def norm(self, q: Sequence[Component]):
        return (rotations.euler_parameter_norm(q[3:]),)

    def displacement(self, q: Sequence[Component], rest: Sequence[Component]):
        return (*(sub(x, r) for x, r in zip(q[:3], rest, strict=True)), *_rotation_vector(q[3:]))

    def loads(self, at: JointKinematics, forces: Sequence[Component]):
        return (
            Force(at.parent_frame.vector(*forces[:3]), at.child_point),
            Torque(at.child_frame.vector(*forces[3:]), at.child_frame),
        )


def _about(P: Point, F: Frame, G: Frame, anchor: Triple) -> Point:
    """P after a rotation from F to G about the point at `anchor` from it."""
    if all(is_zero(x) for x in anchor):
        return P
    return P.fixed(F.vector(*anchor)).fixed(G.vector(*(mul(-1.0, x) for x in anchor)))


def _rotation_vector(e: Sequence[Component]) -> tuple[Component, ...]:
    """Angle times axis of Euler parameters, scalar last; the shorter rotation [rad].

    2 atan2(|v|, w) / |v| is even in |v|. Near zero its series is used, because the derivatives of the formula are not
    finite there.
    """
    *v, w = (jnp.asarray(x) for x in e)
    sign = jnp.where(w < 0, -1.0, 1.0)
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    small = square < 1e-8
    s = jnp.sqrt(jnp.where(small, 1.0, square))
    far = 2.0 * jnp.arctan2(s, sign * w) / s
    beside = jnp.where(small, w, 1.0)
    y = square / (beside * beside)
    near = 2.0 / (sign * beside) * (1.0 - y / 3.0 + y * y / 5.0)
    factor = sign * jnp.where(small, near, far)
    return tuple(factor * x for x in v)


Stops = tuple[Component | None, Component | None]


class Joint(NamedTuple):
    """The connection of a link to its parent: a chain of joint types, and numbers by the names of parameters."""

    types: tuple[JointType, ...]
    values: Mapping[str, Any]


def hinge(
    name: str,
    axis: ComponentsLike = (0.0, 0.0, 1.0),
    *,
    anchor: ComponentsLike = (0.0, 0.0, 0.0),
    damping: Component = 0.0,
    stiffness: Component = 0.0,
    rest: Component = 0.0,
    armature: Component = 0.0,
    reference: float = 0.0,
    stops: Stops = (None, None),
    friction: Component = 0.0,
) -> Joint:
    """A hinge: the coordinate `name` [rad], the speed `name_rate` [rad/s].

    **Arguments:**

    - `axis`: of any length, in the link's frame.
    - `anchor` [m]: the position of the hinge, in the link's frame.
    - `damping` [N m s/rad], `stiffness` [N m/rad]: of a damper and a spring.
    - `rest` [rad]: the angle at which the spring is relaxed.
    - `armature` [kg m^2]: the inertia of a geared rotor, reflected to the joint. It is added to the diagonal of the
        mass matrix.
    - `reference` [rad]: the coordinate at the link's `position` and `orientation`. An exact number, not a parameter.
    - `stops` [rad]: the lower and the upper limit of the coordinate; None for no limit. Each limit is a
        `jaxkane.Contact` without restitution: `name lower`, `name upper`. At most four are possible, or eight
        without friction.
    - `friction` [N m]: of dry friction, a `jaxkane.DryFriction` with the name `name friction`. It is one of the
        contacts.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, rest=rest, armature=armature, friction=friction)
    return _with_axis(Hinge, name, axis, reference, stops, values | components(f"anchor.{name}", anchor))


def slide(
    name: str,
    axis: ComponentsLike = (0.0, 0.0, 1.0),
    *,
    damping: Component = 0.0,
    stiffness: Component = 0.0,
    rest: Component = 0.0,
    armature: Component = 0.0,
    reference: float = 0.0,
    stops: Stops = (None, None),
    friction: Component = 0.0,
) -> Joint:
    """A slider along `axis` of the link's frame: the coordinate `name` [m], the speed `name_rate` [m/s].

    **Arguments** as of `hinge`: `damping` [N s/m], `stiffness` [N/m], `rest` [m], `armature` [kg], `reference` [m],
    `stops` [m], `friction` [N].
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, rest=rest, armature=armature, friction=friction)
    return _with_axis(Slide, name, axis, reference, stops, values)


def _with_axis(
    kind: type[JointType],
    name: str,
    axis: ComponentsLike,
    reference: float,
    stops: Stops,
    values: Mapping[str, Any],
) -> Joint:
    has_stops, limits = _limits(stops, name)
    origin = float(exact_numbers(reference, f"The reference of {name!r}"))
    joint = kind(name, unit_vector(axis, name), origin, has_stops, f"friction.{name}" in values)
    return Joint((joint,), {**values, **limits})


def _limits(stops: Stops, name: str) -> tuple[tuple[bool, bool], dict[str, Any]]:
    """Which limits a joint has, and their parameters.

    **Raises:** `ValueError` if they are not two numbers in increasing order, or None.
    """
    lower, upper = stops if isinstance(stops, (tuple, list)) and len(stops) == 2 else ("", "")
    limits = {end: x for end, x in (("lower", lower), ("upper", upper)) if x is not None}
    is_concrete = not any(isinstance(x, Tracer) for x in limits.values())
    if any(np.ndim(x) or isinstance(x, str) for x in limits.values()) or (
        is_concrete and len(limits) == 2 and not float(limits["lower"]) < float(limits["upper"])
    ):
        raise ValueError(f"The stops of {name!r} must be a lower and a larger upper limit, or None; got {stops!r}.")
    return (lower is not None, upper is not None), _numbers(name, **limits)


def ball(
    name: str,
    *,
    anchor: ComponentsLike = (0.0, 0.0, 0.0),
    damping: Component = 0.0,
    stiffness: Component = 0.0,
    armature: Component = 0.0,
) -> Joint:
    """A ball joint: Euler parameters `name_e1` ... `name_e4`, scalar last, and the relative angular velocity `name_w1`
    ... `name_w3` along the link's axes [rad/s].

    **Arguments:**

    - `anchor` [m]: in the link's frame.
    - `damping` [N m s/rad].
    - `stiffness` [N m/rad]: times the rotation vector from the orientation with zero vector part.
    - `armature` [kg m^2]: for each of the three speeds.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, armature=armature)
    return Joint((Ball(name),), values | components(f"anchor.{name}", anchor))


def free(
    name: str,
    *,
    damping: Component = 0.0,
    stiffness: Component = 0.0,
    rest: ComponentsLike = (0.0,) * 3,
    armature: Component = 0.0,
) -> Joint:
    """A free link on the ground: position `name_x`, `name_y`, `name_z` of its origin in the inertial frame [m] and
    Euler parameters `name_e1` ... `name_e4`; velocity `name_vx` ... in the inertial frame [m/s], angular velocity
    `name_w1` ... along its own axes [rad/s].

    **Arguments:**

    - `damping`, `stiffness`, `armature`: for all six speeds, in SI units.
    - `rest` (3,) [m]: the position at which the spring is relaxed.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, armature=armature)
    return Joint((Free(name),), values | components(f"rest.{name}", rest))


def fixed() -> Joint:
    """A rigid connection, equivalent to no joint."""
    return Joint((), {})


def universal(name: str, axes: Sequence[ComponentsLike] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), **options: Any) -> Joint:
    """Two hinges about two axes, `name_1` on the parent and `name_2` on the link; `options` of `hinge`, for both."""
    refuse_if(
        len(axes) != 2,
        f"A universal joint needs two axes, but {name!r} has {len(axes)}. Pass several hinges to the link instead.",
    )
    return _chain([hinge(f"{name}_{i + 1}", axis, **options) for i, axis in enumerate(axes)])


def planar(name: str, axes: Sequence[ComponentsLike] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), **options: Any) -> Joint:
    """Two sliders `name_x` and `name_y` along two axes, and a hinge `name_angle` about the normal of their plane.

    `options`, e.g. `damping`, are for all three, in SI units.
    """
    first, second = (np.asarray(axis, float) for axis in axes)
    normal = np.cross(first, second)
    sliders = [slide(f"{name}_{end}", axis, **options) for end, axis in zip("xy", axes, strict=True)]
    return _chain([*sliders, hinge(f"{name}_angle", normal, **options)])


def _chain(joints: Sequence[Joint]) -> Joint:
    return Joint(
        tuple(each for joint in joints for each in joint.types),
        {name: value for joint in joints for name, value in joint.values.items()},
    )


def _numbers(joint: str, **values: Any) -> dict[str, Any]:
    return {f"{kind}.{joint}": x for kind, x in values.items() if not is_structural_zero(x)}
