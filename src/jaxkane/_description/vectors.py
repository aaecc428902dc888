"""Vectors, frames and points, as on paper. Knows kinematics; knows no body, no speed and no equation of motion.

A vector keeps its three components in the frame where they are simple, exact zeros and ones included, and is resolved
in another frame only when two frames meet. A frame knows its parent, its rotation and its angular velocity; a point
knows its velocity, and its position as a chain of vectors that is summed only when somebody asks.
"""

from __future__ import annotations

import contextlib
import contextvars
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import rotations
from .._scalars.components import ZERO3, add3, component, cross, dot, is_exact, is_zero, matvec, mul, scale3
from .._scalars.linear import stack
from .._scalars.types import Component, Triple
from ..rotations import Matrix


class Frame:
    """A rigid frame: a parent, a rotation and an angular velocity.

    Frames are made from other frames, the first by `jaxkane.inertial()`. `frame.x`, `frame.y`, `frame.z` are its unit
    vectors (the textbook's 1, 2 and 3), `frame.vector(a, b, c)` any other vector that is simple in it.
    """

    __slots__ = ("_made", "_omega", "_spin", "_to_child", "_units", "_virtual", "depth", "name", "number", "parent")

    def __init__(self, name: str, parent: Frame | None, to_child: Matrix, spin: Triple):
        self.name = name
        self.parent = parent
        self.depth: int = 0 if parent is None else parent.depth + 1
        self._spin = spin  # angular velocity relative to the parent, in this frame's components
        self._omega: Vector | None = None
        self._units: tuple[Vector, Vector, Vector] | None = None
        self._made: int = 0
        self._virtual: Virtual | None = None
        self.number = 0 if parent is None else self.root._next_number()
        self._to_child = self._turned(to_child)  # components in the parent -> components here

    def _turned(self, to_child: Matrix) -> Matrix:
        virtual = self.root._virtual
        if self.parent is None or virtual is None or virtual.number != self.number:
            return to_child
        # R (1 - [delta x]) for a small rotation delta, row by row: r - r x delta
        delta = self.root.vector(*virtual.displacement).components_in(self.parent)
        return tuple(add3(row, cross(delta, row)) for row in to_child)  # type: ignore[return-value]

    def __repr__(self) -> str:
        return f"Frame({self.name})"

    def _next_number(self) -> int:
        """Frames and points are numbered as they are made: a description that is read again makes them in the same
        order."""
        self._made += 1
        return self._made

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
        """Angular velocity in the inertial frame [rad/s]: the sum of the spins down to here (summation rule)."""
        if self._omega is None:
            if self.parent is None:
                self._omega = Vector(self, ZERO3)
            else:
                inherited = matvec(self._to_child, self.parent.angular_velocity.components)
                self._omega = Vector(self, add3(inherited, self._spin))  # type: ignore[arg-type]
                virtual = self.root._virtual
                if virtual is not None and virtual.number == self.number:
                    self._omega = self._omega + self.root.vector(*virtual.velocity)
        return self._omega

    def rotate(self, axis: int | Vector, angle: Component, rate: Component, name: str | None = None) -> Frame:
        """A frame turned from this one about one axis.

        **Arguments:**

        - `axis`: 1, 2 or 3, or a vector that is fixed in this frame (a hinge in any direction). Its length is of no
            account: an exact one is brought to 1 beforehand, and a unit vector costs nothing.
        - `angle`: right-hand rotation about the axis [rad].
        - `rate`: its time derivative [rad/s]; 0.0 for a fixed tilt.
        - `name`: for error messages and pictures.

        **Raises:** `ValueError` for an axis that is none of these, or a vector that is exactly zero.
        """
        angle, rate = component(angle), component(rate)
        if isinstance(axis, Vector):
            direction = axis.normalize().components_in(self)
            c, s = jnp.cos(angle), jnp.sin(angle)
            rotation = rotations.rodrigues_matrix(direction, c, s)
        else:
            if axis not in (1, 2, 3):
                raise ValueError(f"{self.name}.rotate: the axis is 1, 2, 3 or a unit Vector, got {axis!r}.")
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
        """A frame turned from this one by a body-fixed sequence, such as "3-2-1", "3-1-2", "3-1-3" or "1-2-3".

        **Arguments:**

        - `sequence`: the axes in their order.
        - `angles`: one for each axis [rad].
        - `rates`: their time derivatives [rad/s]. Or, where the speeds are angular velocity components:
        - `angular_velocity`: relative to this frame [rad/s]: three components in the new frame, or a Vector.
        """
        axes = rotations.axes_of(sequence)
        if len(angles) != len(axes):
            raise ValueError(f"The sequence {sequence!r} takes {len(axes)} angles, got {len(angles)}.")
        if (rates is None) == (angular_velocity is None):
            raise ValueError("rotate_sequence takes either the `rates` of the angles or the `angular_velocity`.")
        if rates is None:
            rotation = rotations.sequence_matrix(sequence, [component(a) for a in angles])
            return self._oriented(rotation, angular_velocity, name)  # type: ignore[arg-type]
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
        """A frame oriented in this one by Euler parameters.

        **Arguments:**

        - `parameters`: (e1, e2, e3, e4) of unit norm, e4 the scalar: scalar last, as in the textbook.
        - `angular_velocity`: relative to this frame [rad/s]: three components in the new frame, or a Vector. None for a
            fixed rotation, as of a sensor on its body; the norm of its parameters is of no account.
        """
        if len(parameters) != 4:
            raise ValueError(f"Euler parameters are four numbers, the scalar last; got {len(parameters)}.")
        e = [component(x) for x in parameters]
        if angular_velocity is None:
            e = rotations.normalized(e)
        return self._oriented(
            rotations.euler_parameters_matrix(e), ZERO3 if angular_velocity is None else angular_velocity, name
        )

    def rotate_fixed(self, rotation_vector: Sequence[Component], name: str | None = None) -> Frame:
        """A frame fixed in this one, turned by a rotation vector: how an instrument is mounted on its body.

        **Arguments:** `rotation_vector`: three components in this frame [rad], its length the angle, right-hand about
        its direction; smooth at zero, so that a fit can start there.
        """
        if len(rotation_vector) != 3:
            raise ValueError(f"A rotation vector has three components, got {len(rotation_vector)}.")
        e = rotations.of_rotation_vector([component(x) for x in rotation_vector])
        return self._oriented(rotations.euler_parameters_matrix(e), ZERO3, name)

    def rotate_by(
        self, orientation: Callable[..., Any], t: Component, q: Any, q_dot: Any, name: str | None = None
    ) -> Frame:
        """A frame whose orientation is a given function; its angular velocity is found by differentiation.

        **Arguments:**

        - `orientation`: (t, q) -> (3, 3) rotation matrix [R] that takes components in this frame to components in
            the new one. `q` is any pytree of floats.
        - `t`, `q`, `q_dot`: time [s], the function's variables, and their rates.
        """
        R, R_dot = _along(lambda t, q: jnp.asarray(orientation(t, q)), t, q, q_dot)  # (3,3) (3,3)
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
            if len(omega) != 3:
                raise ValueError(f"An angular velocity has three components, got {len(omega)}.")
            frame._spin = tuple(component(w) for w in omega)  # type: ignore[assignment]
        return frame

    def matrix(self, other: Frame) -> Float[Array, "3 3"]:
        """The rotation matrix (3, 3) that takes components in `other` to components in this frame."""
        return stack([Vector(other, unit).components_in(self) for unit in rotations.IDENTITY]).T


def _along(function, t, q, q_dot):
    """Value and time derivative of `function(t, q)` along the motion."""
    as_floats = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(float, x)), tree)  # noqa: E731
    t, q, q_dot = as_floats(t), as_floats(_plain(q)), as_floats(_plain(q_dot))
    q_dot = jax.tree.map(lambda x, dx: jnp.asarray(dx, dtype=x.dtype), q, q_dot)
    return jax.jvp(function, (t, q), (jnp.ones_like(t), q_dot))


def _plain(q):
    return jnp.asarray(q) if hasattr(q, "__jax_array__") else q


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
        if not isinstance(frame, Frame):
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
        _refuse_other(other, "dot")
        frame = self.frame if self._is_denser_than(other) else other.frame
        return dot(self.components_in(frame), other.components_in(frame))

    def cross(self, other: Vector) -> Vector:
        """The vector product."""
        _refuse_other(other, "cross")
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


def _refuse_other(given: Any, verb: str) -> None:
    if not isinstance(given, Vector):
        raise TypeError(f"{verb} takes a Vector such as 3.0 * N.x, got {given!r}.")


def _meet(a: Vector, b: Vector) -> tuple[Frame, Triple, Triple]:
    # The deeper frame is where both are likely to be needed next: velocities are built from the root outwards.
    frame = a.frame if a.frame.depth >= b.frame.depth else b.frame
    return frame, a.components_in(frame), b.components_in(frame)


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
        self._claim: Claim | None = None

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
        point._claim = Claim(carrier, Vector(carrier, ZERO3)) if frame is None else None
        return point

    def moving(self, r: Vector, velocity: Vector, frame: Frame | None = None, name: str | None = None) -> Point:
        """The point now at `r` from this one, that moves in a frame in which this one is fixed (one-point theorem).

            v_Q = v_P + omega x r + v_rel

        **Arguments:** `r` [m]; `velocity`: relative to the frame [m/s]; `frame`: by default the one that `r` is
        written in.
        """
        frame = frame or _own_frame(r, "moving")
        _refuse_other(velocity, "Point.moving, as the velocity,")
        carried = self.velocity + frame.angular_velocity.cross(r)
        point = Point(carried + velocity, self, r, name or f"{self.name}'")
        point._claim = Claim(frame, velocity)
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
        frame = frame or self.velocity.frame.root
        r, r_dot = _along(lambda t, q: jnp.stack([jnp.asarray(x, float) for x in position(t, q)]), t, q, q_dot)
        return self.moving(frame.vector(*r), frame.vector(*r_dot), frame, name)

    @staticmethod
    def at(velocity: Vector, position: Vector | None = None, name: str = "point") -> Point:
        """A point with a given velocity [m/s] and, where it is known, a given position from the origin [m].

        The contact point of a wheel that rolls is `Point.at(0.0 * N.x)`: a point of the wheel that is at rest now. It
        has no position, since the ground under the wheel is another point at every instant.
        """
        point = Point(velocity, None, position, name)
        point._claim = None if position is None else Claim(velocity.frame.root, velocity)
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
    _refuse_other(r, f"Point.{verb}")
    if r.mixed:
        raise ValueError(
            f"Point.{verb}: the vector adds parts written in different frames, so the frame it belongs to is not "
            f"clear. Say which: point.{verb}(r, ..., frame=B); or go there in two steps, one for each frame."
        )
    return r.frame


def inertial() -> tuple[Frame, Point]:
    """The inertial frame N and its origin O, the root of a description. Call it once, at the top of `motion`."""
    N = Frame("N", None, rotations.IDENTITY, ZERO3)
    N._virtual = _VIRTUAL.get()
    return N, Point(Vector(N, ZERO3), None, Vector(N, ZERO3), "O")


class Claim(NamedTuple):
    """How a point is said to move: its place, as seen in `frame` from the point it was made from, with `velocity`.

    The place is a function of time and coordinates, the velocity was given beside it: the two may contradict. A point
    without a claim is only where it is now, as the point of a wheel that is in contact.
    """

    frame: Frame
    velocity: Vector


class Virtual(NamedTuple):
    """A velocity and a displacement that one point or frame does not have: the textbook's auxiliary speed.

    For a frame, an angular velocity and a small rotation. Components are in N.
    """

    number: int
    velocity: Triple = ZERO3
    displacement: Triple = ZERO3


_VIRTUAL: contextvars.ContextVar[Virtual | None] = contextvars.ContextVar("jaxkane_virtual", default=None)


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
