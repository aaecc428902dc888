"""Rigid bodies: mass, inertia, mass centre and frame. Describes; never differentiates or solves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._scalarjit.components import Component, Triple, add, component, is_zero, mul, sub
from .frames import Frame
from .points import Point
from .vectors import Vector

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
        if not isinstance(center, Point):
            raise TypeError(
                f"Body(mass, inertia, center, ...): the mass centre of {name!r} is a Point, got {center!r}."
            )
        if not isinstance(frame, (Frame, type(None))):
            raise TypeError(f"Body(mass, inertia, center, frame): the frame of {name!r} is a Frame, got {frame!r}.")
        if not isinstance(angular_velocity, (Vector, type(None))):
            raise TypeError(f"Body: the angular velocity of {name!r} is a Vector, got {angular_velocity!r}.")
        if not isinstance(about, (Point, type(None))):
            raise TypeError(f"Body(..., about=P): the inertia of {name!r} is about a Point, got {about!r}.")
        if not isinstance(name, str):
            raise TypeError(f"Body(..., name=...): the name is a text, got {name!r}.")
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
            self.inertia = _central(self.inertia, self.mass, center.position_from(about).components_in(self.frame))

    def __repr__(self) -> str:
        return f"Body({self.name})"


def point_of(part: Point | Body) -> Point:
    """A point, or the mass centre of a body. **Raises:** `TypeError` for what is neither."""
    point = part.center if isinstance(part, Body) else part
    if not isinstance(point, Point):
        raise TypeError(f"A Point or a Body is asked for, got {part!r}.")
    return point


def _inertia(given: Any, name: str) -> tuple[Triple, Triple, Triple]:
    if isinstance(given, str) or given is None:
        raise TypeError(f"{name}: the inertia is three principal moments or a (3, 3) matrix, got {given!r}.")
    inertia: Any = (0.0, 0.0, 0.0) if isinstance(given, (int, float)) and given == 0 else given
    has_length = not hasattr(inertia, "shape") and isinstance(inertia, Sequence)
    shape = (len(inertia), *_inner(inertia)) if has_length else np.shape(inertia)
    if shape == (3,):
        a, b, c = (component(x) for x in inertia)
        return ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    if shape == (3, 3):
        return tuple(tuple(component(x) for x in row) for row in inertia)  # type: ignore[return-value]
    raise ValueError(
        f"{name}: the inertia is three principal moments or a (3, 3) matrix about the mass centre, got shape {shape}."
    )


def _central(I: tuple[Triple, Triple, Triple], m: Component, r: Triple) -> tuple[Triple, Triple, Triple]:
    """The inertia about the mass centre, which is at `r` from the point about which it is I: I - m (r.r 1 - r r)."""
    squares = [mul(x, x) for x in r]
    rows = []
    for i in range(3):
        across = add(squares[(i + 1) % 3], squares[(i + 2) % 3])
        moved = [across if i == j else mul(-1.0, mul(r[i], r[j])) for j in range(3)]
        rows.append(tuple(sub(I[i][j], mul(m, moved[j])) for j in range(3)))
    return tuple(rows)  # type: ignore[return-value]


def _inner(rows: Sequence[Any]) -> tuple[int, ...]:
    inner = {len(row) for row in rows if isinstance(row, (tuple, list)) or np.ndim(row) == 1}
    return tuple(inner)
