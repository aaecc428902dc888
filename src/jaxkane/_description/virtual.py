"""Virtual motions of one point or frame, by which reactions are found. Knows the number that a point or frame has."""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from .._scalars.components import ZERO3
from .._scalars.types import Triple

if TYPE_CHECKING:
    from .frames import Frame
    from .points import Point


class Virtual(NamedTuple):
    """A velocity and a displacement that one point or frame does not have: the textbook's auxiliary speed.

    For a frame, an angular velocity and a small rotation. Components are in N.
    """

    number: int
    velocity: Triple = ZERO3
    displacement: Triple = ZERO3


_VIRTUAL: contextvars.ContextVar[Virtual | None] = contextvars.ContextVar("jaxkane_virtual", default=None)


def current_virtual() -> Virtual | None:
    """The virtual motion of descriptions that are read now."""
    return _VIRTUAL.get()


@contextlib.contextmanager
def virtual(part: Point | Frame, *, velocity: Triple = ZERO3, displacement: Triple = ZERO3) -> Iterator[None]:
    """Descriptions read in this context give that point or frame a virtual motion; what is built from it follows.

    `part` comes from a reading without one, and is found again by its number.
    """
    token = _VIRTUAL.set(Virtual(part.number, velocity, displacement))
    try:
        yield
    finally:
        _VIRTUAL.reset(token)
