"""Shapes of bodies, which animations draw. They do not affect the motion.

    jk.Body(m, I, center, frame, shape=[jk.shapes.sphere(0.02), jk.shapes.line((0, 0, 0), (0, 0.5, 0))])

Positions are measured from the mass centre of a `Body`, or from the origin of a `jaxkane.joints.Link`, along its axes.
All numbers are in metres. Numbers of a `Body` may be parameters or depend on the coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ._common.lookup import checked
from ._scalarjit.components import ZERO3, Component, ComponentsLike, Triple, add, component, components, mul, sub

__all__ = ["Shape", "box", "cylinder", "line", "sphere"]

_POSITION = "A position of a shape must be three numbers along the axes of the body [m]"


class Shape(NamedTuple):
    """A shape of a body, made by `sphere`, `box`, `cylinder` or `line`.

    - `kind`: the name of this function.
    - `center` (3,): its centre [m].
    - `sizes`: of a sphere its radius; of a box half its edges as three vectors; of a line the vector between its ends;
        of a cylinder its radius and the vector between its ends [m].
    - `color`: as in `jaxkane.Sketch`; None for the colour of the body.
    """

    kind: str
    center: Triple
    sizes: tuple[Component, ...]
    color: str | None = None


def sphere(radius: Component, center: ComponentsLike = ZERO3, *, color: str | None = None) -> Shape:
    """A sphere."""
    return _shape("sphere", center, (radius,), color)


def box(
    edges: ComponentsLike,
    center: ComponentsLike = ZERO3,
    axes: tuple[ComponentsLike, ComponentsLike, ComponentsLike] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    *,
    color: str | None = None,
) -> Shape:
    """A box.

    **Arguments:**

    - `edges` (3,): lengths [m].
    - `center` (3,): [m].
    - `axes` (3, 3): the directions of the three edges, as unit vectors in the rows.
    - `color`: as in `jaxkane.Sketch`.
    """
    lengths = components(edges, 3, "The edges of a box must be three lengths [m]")
    what = "The axes of a box must be three unit vectors of three numbers"
    rows = [components(axis, 3, what) for axis in axes]
    halves = [mul(mul(0.5, length), x) for length, row in zip(lengths, rows, strict=True) for x in row]
    return _shape("box", center, halves, color)


def cylinder(radius: Component, start: ComponentsLike, end: ComponentsLike, *, color: str | None = None) -> Shape:
    """A cylinder between the centres `start` (3,) and `end` (3,) of its ends [m]."""
    along = line(start, end)
    return _shape("cylinder", along.center, (radius, *along.sizes), color)


def line(start: ComponentsLike, end: ComponentsLike, *, color: str | None = None) -> Shape:
    """A line from `start` (3,) to `end` (3,) [m], such as a string."""
    a, b = components(start, 3, _POSITION), components(end, 3, _POSITION)
    middle = [mul(0.5, add(x, y)) for x, y in zip(a, b, strict=True)]
    return _shape("line", middle, [sub(y, x) for x, y in zip(a, b, strict=True)], color)


def as_shapes(shapes: Shape | Sequence[Shape], label: str) -> tuple[Shape, ...]:
    """One shape or several as a tuple. **Raises:** `TypeError` for anything else."""
    what = f"{label}: `shape` must be a shape such as jk.shapes.sphere(0.1), or a list of these"
    many = (shapes,) if isinstance(shapes, Shape) else checked(shapes, (tuple, list), what)
    return tuple(checked(shape, Shape, what) for shape in many)


def _shape(kind: str, center: ComponentsLike, sizes: Sequence[Any], color: str | None) -> Shape:
    numbers = tuple(component(size, f"A size of a {kind} [m]") for size in sizes)
    checked(color, str | None, f"The colour of a {kind} must be a string")
    x, y, z = components(center, 3, _POSITION)
    return Shape(kind, (x, y, z), numbers, color)
