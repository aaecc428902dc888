"""Rigid bodies, and the forces and torques that act on them. Describes; never differentiates or solves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .._scalarjit.components import Component, Triple, add, component, is_zero, mul, sub
from .kinematics import Frame, Point, Vector

UNNAMED = "body"  # the name of bodies that were not given one


class Body:
    """A rigid body: mass, central inertia, mass centre and frame.

    **Arguments:**

    - `mass` [kg].
    - `inertia` [kg m^2] about the mass centre, resolved in `frame`: three principal moments, or a (3, 3) matrix
        whose off-diagonal entries are matrix entries (minus the integrals of xy). 0.0 for a particle.
    - `center`: the mass centre, a Point.
    - `frame`: a Frame in which the inertia does not change. A particle needs none, anything else does.
    - `angular_velocity`: a Vector, by default the frame's. An axisymmetric body (a wheel, a rotor) may stand in a
        frame that does not spin with it, with its own angular velocity: the textbook's Examples 5 and 7.
    - `name`: for error messages, forces, pictures and `motion["name"]`.
    - `about`: a Point that is fixed in `frame`, about which `inertia` is given instead: it is taken to the mass centre
        by the parallel axis theorem, I - m (r.r 1 - r r).

    **Raises:** `ValueError` for an inertia of another shape, and for one without a frame to turn with; `TypeError` for
    what is no point, frame or vector.
    """

    __slots__ = ("about", "angular_velocity", "center", "frame", "inertia", "is_particle", "mass", "name")

    def __init__(
        self,
        mass: Component,
        inertia: Any,
        center: Point,
        frame: Frame | None = None,
        angular_velocity: Vector | None = None,
        name: str = UNNAMED,
        about: Point | None = None,
    ):
        for label, value, kind in (
            (f"the mass centre of {name!r} is a Point", center, Point),
            (f"the frame of {name!r} is a Frame", frame, Frame | None),
            (f"the angular velocity of {name!r} is a Vector", angular_velocity, Vector | None),
            (f"the inertia of {name!r} is about a Point", about, Point | None),
            ("the name is a text", name, str),
        ):
            if not isinstance(value, kind):
                raise TypeError(f"Body(mass, inertia, center, frame): {label}, got {value!r}.")
        self.mass = component(mass)
        self.inertia = _inertia(inertia, name)
        self.is_particle = frame is None and angular_velocity is None
        has_inertia = about is not None or not all(is_zero(x) for row in self.inertia for x in row)
        if self.is_particle and has_inertia:
            raise ValueError(
                f"Body(mass, inertia, center): {name!r} has an inertia, but no frame to turn with. Give its frame, "
                "Body(mass, inertia, center, frame); for a particle write 0.0 for the inertia."
            )
        self.center = center
        self.frame = center.velocity.frame.root if frame is None else frame
        self.angular_velocity = self.frame.angular_velocity if angular_velocity is None else angular_velocity
        self.name = name
        self.about = about
        if about is not None:
            self.inertia = parallel_axis(self.inertia, self.mass, center.position_from(about).components_in(self.frame))

    def __repr__(self) -> str:
        return f"Body({self.name})"


def point_of(part: Point | Body) -> Point:
    """A point, or the mass centre of a body. **Raises:** `TypeError` for what is neither."""
    point = part.center if isinstance(part, Body) else part
    if not isinstance(point, Point):
        raise TypeError(f"A Point or a Body is asked for, got {part!r}.")
    return point


def _inertia(value: Any, name: str) -> tuple[Triple, Triple, Triple]:
    if isinstance(value, str) or value is None:
        raise TypeError(f"{name}: the inertia is three principal moments or a (3, 3) matrix, got {value!r}.")
    rows: Any = (0.0, 0.0, 0.0) if isinstance(value, (int, float)) and value == 0 else value
    if not hasattr(rows, "shape") and isinstance(rows, Sequence):  # of traced numbers, perhaps
        shape = (len(rows), *{len(row) for row in rows if isinstance(row, (tuple, list)) or np.ndim(row) == 1})
    else:
        shape = np.shape(rows)
    if shape == (3,):
        a, b, c = (component(x) for x in rows)
        return ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    if shape == (3, 3):
        return tuple(tuple(component(x) for x in row) for row in rows)  # type: ignore[return-value]
    raise ValueError(
        f"{name}: the inertia is three principal moments or a (3, 3) matrix about the mass centre, got shape {shape}."
    )


def parallel_axis(I: tuple[Triple, Triple, Triple], m: Component, r: Triple) -> tuple[Triple, Triple, Triple]:
    """The inertia about the mass centre, which is at `r` from the point about which it is I: I - m (r.r 1 - r r)."""
    squares = [mul(x, x) for x in r]
    rows = []
    for i in range(3):
        across = add(squares[(i + 1) % 3], squares[(i + 2) % 3])
        point_mass = [across if i == j else mul(-1.0, mul(r[i], r[j])) for j in range(3)]
        rows.append(tuple(sub(I[i][j], mul(m, point_mass[j])) for j in range(3)))
    return tuple(rows)  # type: ignore[return-value]


class Force:
    """A force [N] that acts at a point: a Point, or the mass centre of a Body."""

    __slots__ = ("point", "vector")

    def __init__(self, vector: Vector, point: Point | Body):
        self.vector = _checked(vector, "Force")
        if not isinstance(point, (Point, Body)):
            raise TypeError(f"Force(vector, point): the second argument is a Point or a Body, got {point!r}.")
        self.point = point_of(point)

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
