"""Vectors, frames, points and auxiliary speeds. Does not depend on bodies or equations of motion.

A vector stores its components in the frame in which they were given, including exact zeros and ones. It is resolved
in another frame only if an operation needs this. A point stores its velocity and a chain of vectors to the origin. The
chain is summed only if the position is needed.
"""

from __future__ import annotations

import contextlib
import contextvars
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .. import rotations
from .._common.lookup import checked, refuse_if
from .._scalarjit.components import (
    ZERO3,
    Component,
    Numbers,
    Triple,
    add3,
    component,
    components,
    cross,
    dot,
    is_exact,
    is_zero,
    matvec,
    mul,
    scale3,
    stack,
)
from ..rotations import Matrix
from .parameters import text_of


class AuxiliarySpeed(NamedTuple):
    """An auxiliary speed of the textbook: a virtual velocity and displacement of one point or frame.

    For a frame, these are an angular velocity and a small rotation. Components are in N.
    """

    number: int
    velocity: Triple = ZERO3
    displacement: Triple = ZERO3


_AUXILIARY: contextvars.ContextVar[AuxiliarySpeed | None] = contextvars.ContextVar("jaxkane_auxiliary", default=None)


@contextlib.contextmanager
def auxiliary_speed(part: Point | Frame, *, velocity: Triple = ZERO3, displacement: Triple = ZERO3) -> Iterator[None]:
    """A context in which a point or frame, and everything that is derived from it, has an auxiliary speed.

    `part` comes from an evaluation without auxiliary speed. It is identified by its number: frames and points are
    numbered in the order in which they are created, which is the same in every evaluation.
    """
    token = _AUXILIARY.set(AuxiliarySpeed(part.number, velocity, displacement))
    try:
        yield
    finally:
        _AUXILIARY.reset(token)


def inertial() -> tuple[Frame, Point]:
    """Return the inertial frame N and its origin O. Call this function once, at the start of `motion`."""
    N = Frame("N", None, rotations.IDENTITY, ZERO3)
    N._auxiliary = _AUXILIARY.get()
    return N, Point(Vector(N, ZERO3), None, Vector(N, ZERO3), "O")


class Vector:
    """A vector with components in one frame. Exact zeros and ones remain exact.

    Sums, multiples, `dot`, `cross` and `norm` accept vectors of different frames. `v.to(frame)` returns the components
    in a frame as an array (3,).
    """

    __slots__ = ("_above", "_resolved", "components", "frame", "mixed")
    __array_ufunc__ = None  # let __rmul__ handle products with a NumPy number on the left

    def __init__(self, frame: Frame, components: Triple, mixed: bool = False):
        self.frame = frame
        self.components = components
        self.mixed = mixed  # a sum of vectors of different frames need not be fixed in any frame
        self._resolved: dict[Frame, Triple] | None = None
        self._above: Vector | None = None  # the same vector in the parent frame

    def __repr__(self) -> str:
        axes = zip(self.components, "xyz", strict=True)
        terms = [f"{text_of(a)}*{self.frame.name}.{axis}" for a, axis in axes if not is_zero(a)]
        return " + ".join(terms).replace("+ -", "- ") or "0"

    def components_in(self, frame: Frame) -> Triple:
        """The three components in `frame`. Exact components are Python floats."""
        if frame is self.frame or all(is_zero(a) for a in self.components):
            return self.components
        if self._resolved is None:
            self._resolved = {}
        if frame not in self._resolved:
            self._resolved[frame] = self._resolve(frame)
        return self._resolved[frame]

    def _resolve(self, frame: Frame) -> Triple:
        # Resolve frame by frame and cache each result. A vector that all links of a chain need costs one step per link.
        checked(frame, Frame, "The components of a Vector need a Frame")
        if self.frame.root is not frame.root:
            # All inertial frames are the same: `events` may call `inertial()` beside `motion`.
            if self.frame.parent is None:
                return Vector(frame.root, self.components).components_in(frame)
            if frame.parent is None:
                return self.components_in(self.frame.root)
            raise ValueError(
                f"The frames {self.frame.name} and {frame.name} have no common inertial frame. Call "
                "jaxkane.inertial() once in `motion`. In `loads`, use the frames of the motion that it receives."
            )
        if frame.depth > self.frame.depth:
            above = self.components_in(frame.parent)  # type: ignore[arg-type]
            return matvec(frame._to_child, above)  # type: ignore[return-value]
        if self._above is None:
            to_parent = tuple(zip(*self.frame._to_child, strict=True))
            self._above = Vector(self.frame.parent, matvec(to_parent, self.components))  # type: ignore[arg-type]
        return self._above.components_in(frame)

    def to(self, frame: Frame) -> Float[Array, 3]:
        """Return the components in `frame` as an array (3,)."""
        return stack([self.components_in(frame)])[0]

    def express(self, frame: Frame) -> Vector:
        """Return the same vector with components in `frame`."""
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
        # Use the frame of the vector with more nonzero components.
        n, n_other = (sum(not is_zero(a) for a in v.components) for v in (self, other))
        frame = self.frame if n >= n_other else other.frame
        return dot(self.components_in(frame), other.components_in(frame))

    def cross(self, other: Vector) -> Vector:
        """The vector product."""
        check_vector(other, "cross")
        frame, a, b = _meet(self, other)
        return Vector(frame, cross(a, b), mixed=self.mixed or other.mixed or self.frame is not other.frame)

    def norm(self) -> Component:
        """The length. Its derivative is infinite if the vector is zero."""
        if all(is_exact(a) for a in self.components):
            return math.hypot(*self.components)
        return jnp.sqrt(dot(self.components, self.components))

    def normalize(self) -> Vector:
        """The unit vector in this direction.

        **Raises:** `ValueError` if the vector is exactly zero.
        """
        length = self.norm()
        if not is_exact(length):
            return self / length
        if length == 0.0:
            raise ValueError(
                f"The vector {self} is zero, so it has no direction. Check the axis or the normal, or whether two "
                "points always coincide."
            )
        return self if abs(length - 1.0) < 1e-15 else self / length


def check_vector(value: object, verb: str) -> Vector:
    return checked(value, Vector, f"{verb} needs a Vector such as 3.0 * N.x")


def _meet(a: Vector, b: Vector) -> tuple[Frame, Triple, Triple]:
    # Use the deeper frame, because velocities are computed from the root outwards and are needed there next.
    frame = a.frame if a.frame.depth >= b.frame.depth else b.frame
    return frame, a.components_in(frame), b.components_in(frame)


class Frame:
    """A rigid frame: a parent, a rotation and an angular velocity.

    Create the first frame with `jaxkane.inertial()`, and other frames with the methods of a frame. `frame.x`,
    `frame.y` and `frame.z` are the unit vectors (1, 2 and 3 in the textbook). `frame.vector(a, b, c)` is a vector with
    these components.
    """

    __slots__ = ("_auxiliary", "_n_made", "_omega", "_spin", "_to_child", "_units", "depth", "name", "number", "parent")

    def __init__(self, name: str, parent: Frame | None, to_child: Matrix, spin: Triple):
        self.name = name
        self.parent = parent
        self.depth: int = 0 if parent is None else parent.depth + 1
        self._spin = spin  # angular velocity relative to the parent, in this frame's components
        self._omega: Vector | None = None
        self._units: tuple[Vector, Vector, Vector] | None = None
        self._n_made: int = 0  # number of frames and points of this root
        self._auxiliary: AuxiliarySpeed | None = None
        self.number = 0 if parent is None else self.root._next_number()
        self._to_child = to_child  # components in the parent -> components in this frame
        auxiliary = self._auxiliary_speed()
        if auxiliary is not None:
            # R (1 - [delta x]) for a small rotation delta, row by row: r - r x delta
            delta = self.root.vector(*auxiliary.displacement).components_in(parent)  # type: ignore[arg-type]
            self._to_child = tuple(add3(row, cross(delta, row)) for row in to_child)  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Frame({self.name})"

    def _next_number(self) -> int:
        self._n_made += 1
        return self._n_made

    def _auxiliary_speed(self) -> AuxiliarySpeed | None:
        auxiliary = self.root._auxiliary if self.parent is not None else None
        return auxiliary if auxiliary is not None and auxiliary.number == self.number else None

    @property
    def x(self) -> Vector:
        return self._unit(0)

    @property
    def y(self) -> Vector:
        return self._unit(1)

    @property
    def z(self) -> Vector:
        return self._unit(2)

    def _unit(self, axis: int) -> Vector:
        if self._units is None:
            self._units = tuple(Vector(self, unit) for unit in rotations.IDENTITY)  # type: ignore[assignment]
        return self._units[axis]  # type: ignore[index]

    def vector(self, x: Component, y: Component, z: Component) -> Vector:
        """The vector `x * frame.x + y * frame.y + z * frame.z`."""
        return Vector(self, (component(x), component(y), component(z)))

    @property
    def root(self) -> Frame:
        frame = self
        while frame.parent is not None:
            frame = frame.parent
        return frame

    @property
    def angular_velocity(self) -> Vector:
        """Angular velocity in the inertial frame [rad/s]: the sum of all relative ones (summation rule)."""
        if self._omega is None:
            if self.parent is None:
                self._omega = Vector(self, ZERO3)
            else:
                inherited = matvec(self._to_child, self.parent.angular_velocity.components)
                self._omega = Vector(self, add3(inherited, self._spin))  # type: ignore[arg-type]
                auxiliary = self._auxiliary_speed()
                if auxiliary is not None:
                    self._omega = self._omega + self.root.vector(*auxiliary.velocity)
        return self._omega

    def rotate(self, axis: int | Vector, angle: Component, rate: Component, name: str | None = None) -> Frame:
        """A frame that is rotated from this frame about one axis.

        **Arguments:**

        - `axis`: 1, 2 or 3, or a vector that is fixed in this frame. The length of the vector does not matter. Exact
            vectors are normalized once, while tracing.
        - `angle`: right-hand rotation about the axis [rad].
        - `rate`: the time derivative of the angle [rad/s]. Pass 0.0 for a fixed rotation.
        - `name`: used in error messages and animations.

        **Raises:** `ValueError` for any other axis, and for a vector that is exactly zero.
        """
        angle, rate = component(angle), component(rate)
        if isinstance(axis, Vector):
            direction = axis.normalize().components_in(self)
            rotation = rotations.rodrigues_matrix(direction, *rotations.cosine_and_sine(angle))
        else:
            if isinstance(axis, bool) or not isinstance(axis, (int, np.integer)) or axis not in (1, 2, 3):
                raise ValueError(
                    f"{self.name}.rotate(axis, angle, rate): the axis must be 1, 2 or 3, or a Vector such as "
                    f"{self.name}.vector(0, 1, 1); got {axis!r}."
                )
            direction = rotations.IDENTITY[axis - 1]
            rotation = rotations.simple_rotation(axis - 1, angle)
        return Frame(name or f"{self.name}'", self, rotation, scale3(rate, direction))

    def rotate_sequence(
        self,
        sequence: str,
        angles: Sequence[Component],
        rates: Sequence[Component] | None = None,
        *,
        angular_velocity: Sequence[Component] | Vector | None = None,
        name: str | None = None,
    ) -> Frame:
        """A frame that is rotated from this frame by a body-fixed sequence, such as "3-2-1", "3-1-2" or "3-1-3".

        Pass either `rates` or `angular_velocity`.

        **Arguments:**

        - `sequence`: the axes in their order.
        - `angles`: one for each axis [rad].
        - `rates`: the time derivatives of the angles [rad/s].
        - `angular_velocity`: relative to this frame [rad/s], three components in the new frame or a Vector.
        """
        axes = rotations.axes_of(sequence)
        angles = components(angles, len(axes), f"The sequence {sequence!r} takes {len(axes)} angles")
        refuse_if(
            (rates is None) == (angular_velocity is None),
            "rotate_sequence: pass either the `rates` of the angles or the `angular_velocity`, not both.",
        )
        if rates is None:
            rotation = rotations.sequence_matrix(sequence, angles)
            return self._oriented(rotation, angular_velocity, name)  # type: ignore[arg-type]
        rates = components(rates, len(axes), f"The sequence {sequence!r} takes {len(axes)} rates")
        frame = self
        for axis, angle, rate in zip(axes, angles, rates, strict=True):
            frame = frame.rotate(axis + 1, angle, rate)
        frame.name = name or frame.name
        return frame

    def rotate_euler(
        self,
        parameters: Sequence[Component],
        angular_velocity: Sequence[Component] | Vector | None = None,
        name: str | None = None,
    ) -> Frame:
        """A frame that is rotated from this frame by Euler parameters.

        **Arguments:**

        - `parameters`: (e1, e2, e3, e4) of unit norm. e4 is the scalar part (scalar last), as in the textbook.
        - `angular_velocity`: relative to this frame [rad/s], three components in the new frame or a Vector. Pass None
            for a fixed rotation, such as the mounting of a sensor. In this case the norm does not matter.
        """
        e = components(parameters, 4, "Euler parameters are four numbers, the scalar last")
        if angular_velocity is None:
            e, angular_velocity = rotations.normalized(e), ZERO3
        return self._oriented(rotations.euler_parameters_matrix(e), angular_velocity, name)

    def rotate_fixed(self, rotation_vector: Sequence[Component], name: str | None = None) -> Frame:
        """A frame that is fixed in this frame, rotated by a rotation vector, such as the mounting of a sensor.

        **Arguments:**

        - `rotation_vector`: three components in this frame [rad]. Its length is the angle of a right-hand rotation
            about its direction. The rotation is smooth at zero, so a fit can start there.
        """
        e = rotations.of_rotation_vector(components(rotation_vector, 3, "A rotation vector has three components"))
        return self._oriented(rotations.euler_parameters_matrix(e), ZERO3, name)

    def rotate_by(
        self, orientation: Callable[..., Any], t: Component, q: Numbers, q_dot: PyTree, name: str | None = None
    ) -> Frame:
        """A frame whose orientation is a function. Its angular velocity is computed by differentiation.

        **Arguments:**

        - `orientation`: (t, q) -> rotation matrix [R] (3, 3), which maps components in this frame to components in the
            new frame. `q` is a pytree of floats.
        - `t`: time [s].
        - `q`: the variables of the function.
        - `q_dot`: the rates of the variables.
        """
        checked(orientation, Callable, "rotate_by: the orientation must be a function (t, q) -> (3, 3)")
        R, R_dot = _value_and_rate(lambda t, q: jnp.asarray(orientation(t, q)), t, q, q_dot)  # (3,3) (3,3)
        if R.shape != (3, 3):
            raise ValueError(f"rotate_by: the orientation must be a (3, 3) matrix, got {R.shape}.")
        skew = R @ R_dot.T  # [omega x] in the new frame's components
        spin = tuple(0.5 * (skew[k, j] - skew[j, k]) for j, k in ((1, 2), (2, 0), (0, 1)))
        rows = tuple(tuple(R[i, j] for j in range(3)) for i in range(3))
        return Frame(name or f"{self.name}'", self, rows, spin)  # type: ignore[arg-type]

    def _oriented(self, rotation: Matrix, omega: Sequence[Component] | Vector, name: str | None) -> Frame:
        frame = Frame(name or f"{self.name}'", self, rotation, ZERO3)
        if isinstance(omega, Vector):
            frame._spin = omega.components_in(frame)
        else:
            frame._spin = components(omega, 3, "An angular velocity has three components")  # type: ignore[assignment]
        return frame

    def matrix(self, other: Frame) -> Float[Array, "3 3"]:
        """The rotation matrix (3, 3) that maps components in `other` to components in this frame."""
        return stack([Vector(other, unit).components_in(self) for unit in rotations.IDENTITY]).T


def _value_and_rate(function: Callable[[Component, PyTree], Array], t: Component, q: PyTree, q_dot: PyTree):

    def as_floats(tree: PyTree) -> PyTree:
        tree = jnp.asarray(tree) if hasattr(tree, "__jax_array__") else tree
        return jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(float, x)), tree)

    t, q, q_dot = as_floats(t), as_floats(q), as_floats(q_dot)
    q_dot = jax.tree.map(lambda x, dx: jnp.asarray(dx, dtype=x.dtype), q, q_dot)
    return jax.jvp(function, (t, q), (jnp.ones_like(t), q_dot))


class Point:
    """A point with its velocity in the inertial frame and, if known, its position from the origin.

    Create the first point with `jaxkane.inertial()`, and other points with the methods of a point: `fixed` is the
    two-point theorem, `moving` the one-point theorem, and `located` differentiates a position function.
    """

    __slots__ = ("_base", "_offset", "_relative_motion", "name", "number", "velocity")

    def __init__(self, velocity: Vector, base: Point | None = None, offset: Vector | None = None, name: str = "point"):
        N = velocity.frame.root
        self.number = N._next_number()
        auxiliary = N._auxiliary
        if auxiliary is not None and auxiliary.number == self.number:
            velocity = velocity + N.vector(*auxiliary.velocity)
            offset = None if offset is None else offset + N.vector(*auxiliary.displacement)
        self.velocity = velocity
        self.name = name
        self._base = base
        self._offset = offset
        self._relative_motion: RelativeMotion | None = None

    def __repr__(self) -> str:
        return f"Point({self.name})"

    def chain(self) -> Iterator[Point]:
        """This point, the point from which it was created, and so on."""
        point: Point | None = self
        while point is not None:
            yield point
            point = point._base

    @property
    def position(self) -> Vector:
        """Position from the inertial origin [m]."""
        if self._offset is None:
            raise ValueError(
                f"The position of {self.name} is not known, because only its velocity was given. Create the point with "
                "`fixed`, `moving` or `located`, or with Point.at(..., position=...)."
            )
        return self._offset if self._base is None else self._base.position + self._offset

    @property
    def has_position(self) -> bool:
        return all(point._offset is not None for point in self.chain())

    def fixed(self, r: Vector, frame: Frame | None = None, name: str | None = None) -> Point:
        """The point at `r` from this point, where both are fixed in one frame (two-point theorem).

            v_Q = v_P + omega x r

        **Arguments:**

        - `r`: position relative to this point [m].
        - `frame`: the frame in which both points are fixed. The default is the frame of `r`. With another frame, the
            result is the material point that is at `r` at this instant, such as the contact point of a wheel.
        """
        carrier = frame or _own_frame(r, "fixed")
        point = Point(self.velocity + carrier.angular_velocity.cross(r), self, r, name or f"{self.name}'")
        point._relative_motion = RelativeMotion(carrier, Vector(carrier, ZERO3)) if frame is None else None
        return point

    def moving(self, r: Vector, velocity: Vector, frame: Frame | None = None, name: str | None = None) -> Point:
        """The point at `r` from this point that moves in a frame in which this point is fixed (one-point theorem).

            v_Q = v_P + omega x r + v_rel

        **Arguments:**

        - `r`: position relative to this point [m].
        - `velocity`: velocity relative to the frame [m/s].
        - `frame`: the frame. The default is the frame of `r`.
        """
        frame = frame or _own_frame(r, "moving")
        check_vector(velocity, "Point.moving, as the velocity,")
        carried = self.velocity + frame.angular_velocity.cross(r)
        point = Point(carried + velocity, self, r, name or f"{self.name}'")
        point._relative_motion = RelativeMotion(frame, velocity)
        return point

    def located(
        self,
        position: Callable[..., Any],
        t: Component,
        q: Numbers,
        q_dot: PyTree,
        frame: Frame | None = None,
        name: str | None = None,
    ) -> Point:
        """The point whose position is a function. Its velocity is computed by differentiation.

        **Arguments:**

        - `position`: (t, q) -> three components in `frame` [m], from this point. `q` is a pytree of floats.
        - `t`: time [s].
        - `q`: the variables of the function.
        - `q_dot`: the rates of the variables.
        - `frame`: the frame of the components, in which this point must be fixed. The default is the inertial frame.
        """
        checked(position, Callable, "Point.located: the position must be a function (t, q) -> three components")
        frame = frame or self.velocity.frame.root
        r, r_dot = _value_and_rate(lambda t, q: jnp.stack([jnp.asarray(x, float) for x in position(t, q)]), t, q, q_dot)
        return self.moving(frame.vector(*r), frame.vector(*r_dot), frame, name)

    @staticmethod
    def at(velocity: Vector, position: Vector | None = None, name: str = "point") -> Point:
        """A point with a given velocity [m/s] and, optionally, a given position from the origin [m].

        The contact point of a rolling wheel is `Point.at(0.0 * N.x)`, the material point that is at rest at this
        instant. It needs no position.
        """
        point = Point(velocity, None, position, name)
        point._relative_motion = None if position is None else RelativeMotion(velocity.frame.root, velocity)
        return point

    def position_from(self, other: Point) -> Vector:
        """The vector from `other` to this point [m], by way of the last common point of their chains."""
        origins = {id(point) for point in other.chain()}
        common = next((point for point in self.chain() if id(point) in origins), None)
        if common is None:
            return self.position - other.position
        return self._from(common) - other._from(common)

    def _from(self, origin: Point) -> Vector:
        """The vector to this point from a point of its chain."""
        if self is origin:
            return Vector(self.velocity.frame.root, ZERO3)
        if self._offset is None or self._base is None or self._base is origin:
            return self.position if self._offset is None else self._offset
        return self._base._from(origin) + self._offset


def _own_frame(r: Vector, verb: str) -> Frame:
    check_vector(r, f"Point.{verb}")
    refuse_if(
        r.mixed,
        f"Point.{verb}: the vector is a sum of vectors of different frames, so its frame is ambiguous. Pass the "
        f"frame: point.{verb}(r, ..., frame=B). Or use two steps, one for each frame.",
    )
    return r.frame


class RelativeMotion(NamedTuple):
    """The velocity of a point relative to the point from which it was created, in `frame`.

    Position and velocity are given separately, so they may contradict each other; `checks.py` compares them. A point
    without relative motion has a position at this instant only, such as the contact point of a wheel.
    """

    frame: Frame
    velocity: Vector
