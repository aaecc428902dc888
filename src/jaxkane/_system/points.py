"""Points, and the inertial frame with its origin. Knows vectors and frames; knows no body and no equation of motion.

A point knows its velocity, and its position as a chain of vectors that is summed only when it is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import ZERO3, Component
from .frames import Frame, current_virtual, value_and_rate
from .vectors import Vector, check_vector


class Point:
    """A point: its velocity in the inertial frame, and its position from the origin where one is known.

    Points are made from other points, the first by `jaxkane.inertial()`: `fixed` is the two-point theorem, `moving`
    the one-point theorem, `located` differentiates a position function.
    """

    __slots__ = ("_base", "_claim", "_offset", "name", "number", "velocity")

    def __init__(self, velocity: Vector, base: Point | None = None, offset: Vector | None = None, name: str = "point"):
        N = velocity.frame.root
        self.number = N._next_number()
        if N._virtual is not None and N._virtual.number == self.number:
            velocity = velocity + N.vector(*N._virtual.velocity)
            offset = None if offset is None else offset + N.vector(*N._virtual.displacement)
        self.velocity = velocity
        self.name = name
        self._base = base
        self._offset = offset
        self._claim: RelativeMotion | None = None

    def __repr__(self) -> str:
        return f"Point({self.name})"

    @property
    def position(self) -> Vector:
        """Position from the inertial origin [m]."""
        if self._offset is None:
            raise ValueError(
                f"The position of {self.name} is not known: it was made from a velocity alone. Make it with `fixed`, "
                "`moving` or `located`, or with Point.at(..., position=...)."
            )
        return self._offset if self._base is None else self._base.position + self._offset

    @property
    def has_position(self) -> bool:
        return self._offset is not None and (self._base is None or self._base.has_position)

    def fixed(self, r: Vector, frame: Frame | None = None, name: str | None = None) -> Point:
        """The point at `r` from this one, both fixed in one frame (two-point theorem).

            v_Q = v_P + omega x r

        **Arguments:** `r` [m]; `frame`: the frame in which both points are fixed, by default the one that `r` is
        written in. With a frame the point may be that of a body which is at `r` now: of a wheel, at its contact.
        """
        carrier = frame or _own_frame(r, "fixed")
        point = Point(self.velocity + carrier.angular_velocity.cross(r), self, r, name or f"{self.name}'")
        point._claim = RelativeMotion(carrier, Vector(carrier, ZERO3)) if frame is None else None
        return point

    def moving(self, r: Vector, velocity: Vector, frame: Frame | None = None, name: str | None = None) -> Point:
        """The point now at `r` from this one, that moves in a frame in which this one is fixed (one-point theorem).

            v_Q = v_P + omega x r + v_rel

        **Arguments:** `r` [m]; `velocity`: relative to the frame [m/s]; `frame`: by default the one that `r` is
        written in.
        """
        frame = frame or _own_frame(r, "moving")
        check_vector(velocity, "Point.moving, as the velocity,")
        carried = self.velocity + frame.angular_velocity.cross(r)
        point = Point(carried + velocity, self, r, name or f"{self.name}'")
        point._claim = RelativeMotion(frame, velocity)
        return point

    def located(
        self,
        position: Callable[..., Any],
        t: Component,
        q: Any,
        q_dot: Any,
        frame: Frame | None = None,
        name: str | None = None,
    ) -> Point:
        """The point whose place is a given function; its velocity is found by differentiation.

        **Arguments:**

        - `position`: (t, q) -> three components in `frame` [m], from this point. `q` is any pytree of floats.
        - `t`, `q`, `q_dot`: time [s], the function's variables, and their rates.
        - `frame`: by default the inertial frame. This point must be fixed in it.
        """
        if not callable(position):
            raise TypeError(f"Point.located: the position is a function (t, q) -> three components, got {position!r}.")
        frame = frame or self.velocity.frame.root
        r, r_dot = value_and_rate(lambda t, q: jnp.stack([jnp.asarray(x, float) for x in position(t, q)]), t, q, q_dot)
        return self.moving(frame.vector(*r), frame.vector(*r_dot), frame, name)

    @staticmethod
    def at(velocity: Vector, position: Vector | None = None, name: str = "point") -> Point:
        """A point with a given velocity [m/s] and, where it is known, a given position from the origin [m].

        The contact point of a wheel that rolls is `Point.at(0.0 * N.x)`: a point of the wheel that is at rest now. It
        has no position, since the ground under the wheel is another point at every instant.
        """
        point = Point(velocity, None, position, name)
        point._claim = None if position is None else RelativeMotion(velocity.frame.root, velocity)
        return point

    def position_from(self, other: Point) -> Vector:
        """The vector from `other` to this point [m], by way of the last point that both were made from."""
        mine, others = self._origins(), other._origins()
        common = next((point for point in mine if any(point is each for each in others)), None)
        if common is None:
            return self.position - other.position
        return self._from(common) - other._from(common)

    def _origins(self) -> list[Point]:
        """This point, the one it was made from, and so on."""
        return [self, *([] if self._base is None else self._base._origins())]

    def _from(self, origin: Point) -> Vector:
        """The vector to this point from one of those that it was made from."""
        if self is origin:
            return Vector(self.velocity.frame.root, ZERO3)
        if self._offset is None or self._base is None or self._base is origin:
            return self.position if self._offset is None else self._offset
        return self._base._from(origin) + self._offset


def _own_frame(r: Vector, verb: str) -> Frame:
    check_vector(r, f"Point.{verb}")
    if r.mixed:
        raise ValueError(
            f"Point.{verb}: the vector adds parts written in different frames, so the frame it belongs to is not "
            f"clear. Say which: point.{verb}(r, ..., frame=B); or go there in two steps, one for each frame."
        )
    return r.frame


class RelativeMotion(NamedTuple):
    """How a point is said to move: its place, as seen in `frame` from the point it was made from, with `velocity`.

    The place is a function of time and coordinates, the velocity was given beside it: the two may contradict. A point
    without a claim is only where it is now, as the point of a wheel that is in contact.
    """

    frame: Frame
    velocity: Vector


def inertial() -> tuple[Frame, Point]:
    """The inertial frame N and its origin O, the root of a description. Call it once, at the top of `motion`."""
    N = Frame("N", None, rotations.IDENTITY, ZERO3)
    N._virtual = current_virtual()
    return N, Point(Vector(N, ZERO3), None, Vector(N, ZERO3), "O")
