"""Vectors, as on paper. Knows frames by their parents and rotations; knows no body, no speed and no equation of motion.

A vector keeps its three components in the frame where they are simple, exact zeros and ones included, and is resolved
in another frame only when two frames meet.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._scalarjit.components import (
    Component,
    Triple,
    add3,
    component,
    cross,
    dot,
    is_exact,
    is_zero,
    matvec,
    mul,
    scale3,
)
from .._scalarjit.linear import stack

if TYPE_CHECKING:
    from .frames import Frame


class Vector:
    """A vector of space: components in one frame, exact zeros and ones kept.

    Sums, multiples, `dot`, `cross` and `norm` as on paper, across frames; `v.to(frame)` gives its components as an
    array of shape (3,).
    """

    __slots__ = ("_above", "_resolved", "components", "frame", "mixed")
    __array_ufunc__ = None  # a NumPy number on the left leaves the product to __rmul__

    def __init__(self, frame: Frame, components: Triple, mixed: bool = False):
        self.frame = frame
        self.components = components
        self.mixed = mixed  # summed from vectors of different frames: no frame in which it is fixed is known
        self._resolved: dict[Frame, Triple] | None = None
        self._above: Vector | None = None  # the same vector in the parent frame

    def __repr__(self) -> str:
        a, b, c = self.components
        name = self.frame.name
        return f"{a}*{name}.x + {b}*{name}.y + {c}*{name}.z"

    def components_in(self, frame: Frame) -> Triple:
        """The three components in `frame`, exact ones as Python floats."""
        if frame is self.frame or all(is_zero(a) for a in self.components):
            return self.components
        if self._resolved is None:
            self._resolved = {}
        if frame not in self._resolved:
            self._resolved[frame] = self._resolve(frame)
        return self._resolved[frame]

    def _resolve(self, frame: Frame) -> Triple:
        # Step by step, and every step is remembered: a vector that all links of a chain need costs each one step.
        if not isinstance(frame, type(self.frame)):  # `Frame`, which stands above this file
            raise TypeError(f"The components of a Vector are asked for in a Frame, got {frame!r}.")
        if self.frame.root is not frame.root:
            raise ValueError(
                f"The frames {self.frame.name} and {frame.name} have no common inertial frame. Call "
                "jaxkane.inertial() once in `motion`, and in `loads` take the frames from the motion it receives."
            )
        if frame.depth > self.frame.depth:
            above = self.components_in(frame.parent)  # type: ignore[arg-type]
            return matvec(frame._to_child, above)  # type: ignore[return-value]
        if self._above is None:
            to_parent = tuple(zip(*self.frame._to_child, strict=True))
            self._above = Vector(self.frame.parent, matvec(to_parent, self.components))  # type: ignore[arg-type]
        return self._above.components_in(frame)

    def to(self, frame: Frame) -> Float[Array, 3]:
        """Components in `frame`, an array of shape (3,)."""
        return stack([self.components_in(frame)])[0]

    def express(self, frame: Frame) -> Vector:
        """The same vector, its components kept in `frame` from here on."""
        return Vector(frame, self.components_in(frame), self.mixed)

    def __add__(self, other: Vector) -> Vector:
        if not isinstance(other, Vector):
            if isinstance(other, (int, float)) and other == 0:  # so that sum() works
                return self
            return NotImplemented
        frame, a, b = _meet(self, other)
        mixed = self.mixed or other.mixed or self.frame is not other.frame
        return Vector(frame, add3(a, b), mixed)

    __radd__ = __add__

    def __sub__(self, other: Vector) -> Vector:
        return self + (-other)

    def __neg__(self) -> Vector:
        return Vector(self.frame, tuple(mul(-1.0, a) for a in self.components), self.mixed)  # type: ignore[arg-type]

    def __mul__(self, factor: Component) -> Vector:
        if isinstance(factor, Vector):
            raise TypeError("The product of two vectors is ambiguous: write a.dot(b) or a.cross(b).")
        return Vector(self.frame, scale3(component(factor), self.components), self.mixed)

    __rmul__ = __mul__

    def __truediv__(self, divisor: Component) -> Vector:
        divisor = component(divisor)
        quotient = tuple(a if is_zero(a) else a / divisor for a in self.components)
        return Vector(self.frame, quotient, self.mixed)  # type: ignore[arg-type]

    def dot(self, other: Vector) -> Component:
        """The scalar product."""
        check_vector(other, "dot")
        frame = self.frame if self._is_denser_than(other) else other.frame
        return dot(self.components_in(frame), other.components_in(frame))

    def cross(self, other: Vector) -> Vector:
        """The vector product."""
        check_vector(other, "cross")
        frame, a, b = _meet(self, other)
        return Vector(frame, cross(a, b), mixed=self.mixed or other.mixed or self.frame is not other.frame)

    def norm(self) -> Component:
        """The length. Its derivative is infinite where the vector is zero."""
        if all(is_exact(a) for a in self.components):
            return math.hypot(*self.components)
        return jnp.sqrt(dot(self.components, self.components))

    def normalize(self) -> Vector:
        """The unit vector in this direction. **Raises:** `ValueError` for a vector that is exactly zero."""
        length = self.norm()
        if not is_exact(length):
            return self / length
        if length == 0.0:
            raise ValueError(
                f"The vector {self} is zero, and has no direction: an axis, a normal, or the line between two points "
                "that are always in one place."
            )
        return self if abs(length - 1.0) < 1e-15 else self / length

    def _is_denser_than(self, other: Vector) -> bool:
        count = lambda v: sum(not is_zero(a) for a in v.components)  # noqa: E731
        return count(self) >= count(other)


def check_vector(given: Any, verb: str) -> None:
    if not isinstance(given, Vector):
        raise TypeError(f"{verb} takes a Vector such as 3.0 * N.x, got {given!r}.")


def _meet(a: Vector, b: Vector) -> tuple[Frame, Triple, Triple]:
    # The deeper frame is where both are likely to be needed next: velocities are built from the root outwards.
    frame = a.frame if a.frame.depth >= b.frame.depth else b.frame
    return frame, a.components_in(frame), b.components_in(frame)
