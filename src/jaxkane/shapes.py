"""Shapes of bodies, which animations draw. They do not affect the motion.

    jk.Body(m, I, center, frame, shape=[jk.shapes.sphere(0.02), jk.shapes.line((0, 0, 0), (0, 0.5, 0))])

Positions are measured from the mass centre of a `Body`, or from the origin of a `jaxkane.joints.Link`, along its axes.
All numbers are in metres. Numbers of a `Body` may be parameters or depend on the coordinates. A colour is one of those
of `jaxkane.Sketch`; the default is the colour of the body, and grey for a body without mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ._common.lookup import checked
from ._scalarjit.components import ZERO3, Component, ComponentsLike, Triple, add, component, components, mul, sub
from .rotations import IDENTITY

__all__ = ["Shape", "box", "cylinder", "line", "sphere"]

Axes = Sequence[ComponentsLike]
"""The directions of the axes of a shape along those of the body: unit vectors, in the rows of a (3, 3) matrix."""


class Shape(NamedTuple):
    """A shape of a body, made by `sphere`, `box`, `cylinder` or `line`.

    - `kind`: the name of this function.
    - `center` (3,): its centre.
    - `halves` (9,): the vectors from the centre to its surface along its three axes. A line has the third one only.
    - `color`: None for the default.
    """

    kind: str
    center: Triple
    halves: tuple[Component, ...]
    color: str | None


def sphere(
    radius: Component, center: ComponentsLike = ZERO3, axes: Axes = IDENTITY, *, color: str | None = None
) -> Shape:
    """A sphere. The axes are those of its three circles."""
    return _shape("sphere", (radius, radius, radius), center, axes, color)


def box(
    edges: ComponentsLike, center: ComponentsLike = ZERO3, axes: Axes = IDENTITY, *, color: str | None = None
) -> Shape:
    """A box with `edges` (3,) along its axes."""
    halves = [mul(0.5, x) for x in components(edges, 3, "The edges of a box must be three numbers [m]")]
    return _shape("box", halves, center, axes, color)


def cylinder(
    radius: Component,
    length: Component,
    center: ComponentsLike = ZERO3,
    axes: Axes = IDENTITY,
    *,
    color: str | None = None,
) -> Shape:
    """A cylinder of a `length` along its third axis."""
    return _shape("cylinder", (radius, radius, mul(0.5, component(length))), center, axes, color)


def line(start: ComponentsLike, end: ComponentsLike, *, color: str | None = None) -> Shape:
    """A line from `start` (3,) to `end` (3,), such as a string."""
    a, b = (components(x, 3, "An end of a line must be three numbers [m]") for x in (start, end))
    half = [mul(0.5, sub(y, x)) for x, y in zip(a, b, strict=True)]
    return _shape(
        "line", (0.0, 0.0, 1.0), [add(x, y) for x, y in zip(a, half, strict=True)], (ZERO3, ZERO3, half), color
    )


def as_shapes(shapes: Shape | Sequence[Shape], label: str) -> tuple[Shape, ...]:
    """One shape or several as a tuple. **Raises:** `TypeError` for anything else."""
    what = f"{label}: `shape` must be a shape such as jk.shapes.sphere(0.1), or a list of these"
    shapes = (shapes,) if isinstance(shapes, Shape) else checked(shapes, (tuple, list), what)
    return tuple(checked(shape, Shape, what) for shape in shapes)


def _shape(kind: str, sizes: ComponentsLike, center: ComponentsLike, axes: Axes, color: str | None) -> Shape:
    checked(color, str | None, f"The colour of a {kind} must be a string")
    lengths = components(sizes, 3, f"The sizes of a {kind} must be numbers [m]")
    rows = [components(axis, 3, f"An axis of a {kind} must be three numbers") for axis in axes]
    halves = tuple(mul(length, x) for length, row in zip(lengths, rows, strict=True) for x in row)
    x, y, z = components(center, 3, f"The centre of a {kind} must be three numbers [m]")
    return Shape(kind, (x, y, z), halves, color)
