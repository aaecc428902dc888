"""What a figure is drawn with: lines, circles and dots between places of a motion. Knows vectors and colours only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._description.bodies import Body
from .._description.frames import Frame
from .._description.motion import Motion
from .._description.points import Point
from .._description.system import System
from .._description.vectors import Vector
from .._scalars.linear import stack

# On a light page and on a dark one. What is no name of these is taken for a colour of the browser's.
COLORS = {
    "paper": ("#fbfcfe", "#10141d"),
    "grid": ("#d3d9e3", "#364159"),
    "grey": ("#8a94a4", "#76829a"),
    "ink": ("#1d2430", "#eef1f6"),
    "gold": ("#b36b00", "#f0ab45"),
    "blue": ("#1769b5", "#58aaf0"),
    "green": ("#1f7a3d", "#5fc27a"),
    "violet": ("#7a3fb0", "#b78cf0"),
    "red": ("#c4302b", "#f0715f"),
}
CYCLE = ("gold", "blue", "green", "violet", "red")


class Element(eqx.Module):
    """Places (n, 3) in N, and how they are drawn: as a `kind` "line", "pairs", "dot", "center" or "trace".

    `body`: the number of the body that the places turn with, where its frame does not spin with it.
    """

    places: Float[Array, "*times n 3"]
    kind: str = eqx.field(static=True)
    color: str = eqx.field(static=True)
    width: float = eqx.field(static=True, default=1.5)
    closed: bool = eqx.field(static=True, default=False)
    fill: float = eqx.field(static=True, default=0.0)
    body: int | None = eqx.field(static=True, default=None)
    label: str = eqx.field(static=True, default="")


Place = Vector | Point | Body


class Sketch:
    """The figure of a mechanism, drawn once and then carried by its motion.

        def figure(system, motion, sketch):
            sketch.line("gold", motion["O"], motion["A"])
            sketch.trace("blue", motion["link2"])

    A place is a `Point`, a `Body` (its mass centre) or a `Vector` from the origin. A colour is "ink", "grey", "gold",
    "blue", "green", "violet" or "red", each legible on light and dark pages, or any colour of CSS such as "#4fa3e3".
    """

    def __init__(self, motion: Motion):
        self.motion = motion
        self.elements: list[Element] = []

    def _add(self, places: Any, kind: str, color: str, turns_with: Body | None = None, **style: Any) -> None:
        body = None if turns_with is None else self.motion.bodies.index(turns_with)
        self.elements.append(Element(places, kind, color, body=body, **style))

    def _at(self, place: Place) -> Float[Array, 3]:
        if isinstance(place, Body):
            place = place.center
        return (place.position if isinstance(place, Point) else place).to(self.motion.N)

    def line(
        self,
        color: str,
        *places: Place,
        width: float = 2.0,
        closed: bool = False,
        fill: float = 0.0,
        turns_with: Body | None = None,
    ) -> None:
        """A line through places; `width` in pixels, `fill` the opacity of what a closed one encloses."""
        at = jnp.stack([self._at(place) for place in places])
        self._add(at, "line", color, turns_with, width=width, closed=closed, fill=fill)

    def circle(
        self,
        color: str,
        center: Place,
        a: Vector,
        b: Vector,
        radius: Any,
        *,
        width: float = 2.0,
        fill: float = 0.0,
        turns_with: Body | None = None,
    ) -> None:
        """A circle in the plane of two unit vectors."""
        self._add(
            self._around(center, a, b, radius, 40), "line", color, turns_with, width=width, closed=True, fill=fill
        )

    def wheel(self, color: str, body: Body, radius: Any, *, axis: int = 2, spokes: int = 12) -> None:
        """A spoked wheel about the mass centre of a body, and its `axis` 1, 2 or 3; it turns with the body."""
        x, y, z = body.frame.x, body.frame.y, body.frame.z
        a, b = {1: (y, z), 2: (z, x), 3: (x, y)}[axis]
        self.circle(color, body, a, b, radius, width=3.5, fill=0.05, turns_with=body)
        rim = self._around(body, a, b, radius, spokes)
        hub = jnp.broadcast_to(self._at(body), rim.shape)
        self._add(jnp.stack([hub, rim], axis=1).reshape(-1, 3), "pairs", color, body, width=0.7)
        self.dot(color, body, 3.0)

    def _around(self, center: Place, a: Vector, b: Vector, radius: Any, n: int) -> Float[Array, "n 3"]:
        a_N, b_N = a.to(self.motion.N), b.to(self.motion.N)
        angles = 2.0 * np.pi * np.arange(n)[:, None] / n
        cos, sin = (jnp.asarray(f(angles), dtype=a_N.dtype) for f in (np.cos, np.sin))
        return self._at(center)[None, :] + jnp.asarray(radius, dtype=a_N.dtype) * (cos * a_N[None] + sin * b_N[None])

    def dot(self, color: str, place: Place, radius: float = 4.0, label: str = "") -> None:
        """A dot; `radius` in pixels."""
        self._add(self._at(place)[None], "dot", color, width=radius, label=label)

    def mass_center(self, color: str, place: Place, radius: float = 6.0, label: str = "") -> None:
        """The quartered disc that marks a mass centre; `radius` in pixels."""
        self._add(self._at(place)[None], "center", color, width=radius, label=label)

    def trace(self, color: str, *places: Place) -> None:
        """The paths that places leave behind."""
        for place in places:
            self._add(self._at(place)[None], "trace", color, width=1.2)

    def axes(self, center: Place, frame: Frame, length: Any) -> None:
        """The axes 1, 2 and 3 of a frame in red, green and blue."""
        start = center.center.position if isinstance(center, Body) else center
        start = start.position if isinstance(start, Point) else start
        for color, axis in zip(("red", "green", "blue"), (frame.x, frame.y, frame.z), strict=True):
            self.line(color, start, start + length * axis)


Figure = Callable[[System, Motion, Sketch], None]


def rotation(frame: Frame, N: Frame) -> Float[Array, "3 3"]:
    """Takes components in the frame to components in N, without a frame's name for either."""
    return stack([unit.components_in(N) for unit in (frame.x, frame.y, frame.z)]).T
