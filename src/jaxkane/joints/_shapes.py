"""Shapes of joints: their coordinates, speeds, rates, motion and loads. Knows two frames and what turns between them.

A shape is the static part of a joint. It moves a frame and a point from before the joint to behind it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from .. import rotations
from .._description.bodies import Body
from .._description.frames import Frame
from .._description.loads import Force, Load, Torque
from .._description.points import Point
from .._scalars.components import is_zero, mul, sub
from .._scalars.types import Component, Triple


class Placed(NamedTuple):
    """A joint in a motion: the frame and the point before it and behind it."""

    frame: Frame
    point: Point
    moved: Frame
    end: Point


@dataclasses.dataclass(frozen=True)
class Shape:
    """One joint's static part. `axis` is a unit vector in the link's frame, where the joint has one."""

    name: str
    axis: Triple = (0.0, 0.0, 1.0)
    reference: float = 0.0  # the coordinate where the link stands as it was placed

    coordinates: ClassVar[tuple[tuple[str, str], ...]] = ()  # ending of the name, unit
    speeds: ClassVar[tuple[tuple[str, str], ...]] = ()

    def names(self, endings: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
        return tuple(self.name + ending for ending, _ in endings)

    def move(self, F: Frame, P: Point, q: Sequence[Component], u: Sequence[Component], anchor: Triple) -> Placed:
        raise NotImplementedError

    def rates(self, q: Sequence[Component], u: Sequence[Component]) -> Sequence[Component]:
        return u

    def norm(self, q: Sequence[Component]) -> tuple[Component, ...]:
        """Residuals of the coordinates' own: of Euler parameters, their norm."""
        return ()

    def stretch(self, q: Sequence[Component], rest: Sequence[Component]) -> tuple[Component, ...]:
        """How far the joint is from where its spring rests, along each speed."""
        raise NotImplementedError

    def loads(self, placed: Placed, forces: Sequence[Component]) -> tuple[Load, ...]:
        """Forces along each speed [N or N m], with their reactions on what is before the joint."""
        raise NotImplementedError

    def rotors(self, N: Frame, at: Point, armature: Component, u: Sequence[Component]) -> tuple[Body, ...]:
        """What adds `armature` to the diagonal of the mass matrix and nothing else, 1/2 armature u^2 for each speed.

        A rotor behind a gear turns with the joint's rate alone, whatever its carrier does: its angular velocity is
        u N.x, fixed in direction, so that its momentum changes with u_dot and nothing else.
        """
        triples = [[*u[i : i + 3], 0.0, 0.0][:3] for i in range(0, len(u), 3)]
        return tuple(
            Body(
                0.0,
                tuple(armature if 3 * i + j < len(u) else 0.0 for j in range(3)),
                at,
                N,
                N.vector(*triple),
                name=f"rotor of {self.name}" + (f", {i + 1}" if len(triples) > 1 else ""),
            )
            for i, triple in enumerate(triples)
        )


class Hinge(Shape):
    coordinates = (("", "rad"),)
    speeds = (("_rate", "rad/s"),)

    def move(self, F, P, q, u, anchor):
        angle = sub(q[0], self.reference)
        G = F.rotate(F.vector(*self.axis), angle, u[0], f"{self.name} joint")
        return Placed(F, P, G, _about(P, F, G, anchor))

    def stretch(self, q, rest):
        return (sub(q[0], rest[0]),)

    def loads(self, placed, forces):
        return (Torque(forces[0] * placed.moved.vector(*self.axis), placed.moved, placed.frame),)


class Slide(Shape):
    coordinates = (("", "m"),)
    speeds = (("_rate", "m/s"),)

    def move(self, F, P, q, u, anchor):
        axis = F.vector(*self.axis)
        return Placed(F, P, F, P.moving(sub(q[0], self.reference) * axis, u[0] * axis, F))

    def stretch(self, q, rest):
        return (sub(q[0], rest[0]),)

    def loads(self, placed, forces):
        push = forces[0] * placed.frame.vector(*self.axis)
        rail = placed.point.fixed(placed.end.position_from(placed.point), placed.frame)  # at the slider, not with it
        return Force(push, placed.end), Force(-push, rail)


_EULER = (("_e1", ""), ("_e2", ""), ("_e3", ""), ("_e4", ""))
_OMEGA = (("_w1", "rad/s"), ("_w2", "rad/s"), ("_w3", "rad/s"))


class Ball(Shape):
    coordinates = _EULER
    speeds = _OMEGA

    def move(self, F, P, q, u, anchor):
        G = F.rotate_euler(q, u, f"{self.name} joint")
        return Placed(F, P, G, _about(P, F, G, anchor))

    def rates(self, q, u):
        return rotations.euler_parameter_rates(q, u)

    def norm(self, q):
        return (rotations.euler_parameter_norm(q),)

    def stretch(self, q, rest):
        return _rotation_vector(q)

    def loads(self, placed, forces):
        return (Torque(placed.moved.vector(*forces), placed.moved, placed.frame),)


class Free(Shape):
    coordinates = (("_x", "m"), ("_y", "m"), ("_z", "m"), *_EULER)
    speeds = (("_vx", "m/s"), ("_vy", "m/s"), ("_vz", "m/s"), *_OMEGA)

    def move(self, F, P, q, u, anchor):
        G = F.rotate_euler(q[3:], u[3:], f"{self.name} joint")
        return Placed(F, P, G, P.moving(F.vector(*q[:3]), F.vector(*u[:3]), F))

    def rates(self, q, u):
        return (*u[:3], *rotations.euler_parameter_rates(q[3:], u[3:]))

    def norm(self, q):
        return (rotations.euler_parameter_norm(q[3:]),)

    def stretch(self, q, rest):
        return (*(sub(x, r) for x, r in zip(q[:3], rest, strict=True)), *_rotation_vector(q[3:]))

    def loads(self, placed, forces):
        return (
            Force(placed.frame.vector(*forces[:3]), placed.end),
            Torque(placed.moved.vector(*forces[3:]), placed.moved),
        )


def _about(P: Point, F: Frame, G: Frame, anchor: Triple) -> Point:
    """P behind a rotation from F to G about the point at `anchor` from it."""
    if all(is_zero(x) for x in anchor):
        return P
    return P.fixed(F.vector(*anchor)).fixed(G.vector(*(mul(-1.0, x) for x in anchor)))


def _rotation_vector(e: Sequence[Component]) -> tuple[Component, ...]:
    """Angle times axis of Euler parameters, scalar last; the shorter way round [rad].

    2 atan2(|v|, w) / |v| is even in |v|: beside zero its series is used, whose derivatives are right there too.
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
