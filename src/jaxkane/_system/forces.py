"""Forces and torques. Describes; never differentiates or solves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from .bodies import Body
from .frames import Frame
from .points import Point
from .vectors import Vector


class Force:
    """A force [N] that acts at a point: a Point, or the mass centre of a Body."""

    __slots__ = ("point", "vector")

    def __init__(self, vector: Vector, point: Point | Body):
        self.vector = _checked(vector, "Force")
        self.point = point.center if isinstance(point, Body) else point
        if not isinstance(self.point, Point):
            raise TypeError(f"Force(vector, point): the second argument is a Point or a Body, got {point!r}.")

    @property
    def velocity(self) -> Vector:
        """The velocity whose partial velocities the force is multiplied by."""
        return self.point.velocity


class Torque:
    """A torque [N m] that acts on a body or on a frame; its reaction, if one is meant, on another.

    Torque(T * C.z, fork, reaction_on=frame)

    **Raises:** `ValueError` for a particle, which has no frame that could turn.
    """

    __slots__ = ("vector", "velocity")

    def __init__(self, vector: Vector, on: Frame | Body, reaction_on: Frame | Body | None = None):
        self.vector = _checked(vector, "Torque")
        for part in (on, reaction_on):
            if not isinstance(part, (Frame, Body, type(None))):
                raise TypeError(f"Torque(vector, on): acts on a Body or a Frame, got {part!r}.")
            if isinstance(part, Body) and part.is_particle:
                raise ValueError(
                    f"Torque(vector, on): {part.name!r} is a particle, which a torque does not move. Let it act on the "
                    "frame that turns, or give the body that frame: Body(mass, inertia, center, frame)."
                )
        self.velocity = on.angular_velocity
        if reaction_on is not None:
            self.velocity = on.angular_velocity - reaction_on.angular_velocity


def _checked(vector: Any, what: str) -> Vector:
    if not isinstance(vector, Vector):
        raise TypeError(f"{what}(vector, ...): the first argument is a Vector such as 3.0 * N.x, got {vector!r}.")
    return vector


Load = Force | Torque


def flatten_loads(loads: Any, method: str = "`loads`") -> tuple[Load, ...]:
    """Loads out of nested tuples and lists."""
    if isinstance(loads, (Force, Torque)):
        return (loads,)
    if isinstance(loads, Iterable) and not isinstance(loads, (str, Mapping)):
        return tuple(load for item in loads for load in flatten_loads(item, method))
    hint = " Does it end without a `return`?" if loads is None else ""
    raise TypeError(f"{method} returns Forces and Torques, got {loads!r}.{hint}")
