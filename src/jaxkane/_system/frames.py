"""Virtual motions of one point or frame, by which reactions are found. Knows the number that a point or frame has."""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import rotations
from .._scalarjit.components import ZERO3, Component, Triple, add3, component, components, cross, matvec, scale3
from .._scalarjit.linear import stack
from ..rotations import Matrix
from .vectors import Vector

if TYPE_CHECKING:
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
            if isinstance(axis, bool) or not isinstance(axis, (int, np.integer)) or axis not in (1, 2, 3):
                raise ValueError(
                    f"{self.name}.rotate(axis, angle, rate): the axis is the whole number 1, 2 or 3, or a Vector as "
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
        """A frame turned from this one by a body-fixed sequence, such as "3-2-1", "3-1-2", "3-1-3" or "1-2-3".

        **Arguments:**

        - `sequence`: the axes in their order.
        - `angles`: one for each axis [rad].
        - `rates`: their time derivatives [rad/s]. Or, where the speeds are angular velocity components:
        - `angular_velocity`: relative to this frame [rad/s]: three components in the new frame, or a Vector.
        """
        axes = rotations.axes_of(sequence)
        angles = components(angles, len(axes), f"The sequence {sequence!r} takes {len(axes)} angles")
        if (rates is None) == (angular_velocity is None):
            raise ValueError("rotate_sequence takes either the `rates` of the angles or the `angular_velocity`.")
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
        """A frame oriented in this one by Euler parameters.

        **Arguments:**

        - `parameters`: (e1, e2, e3, e4) of unit norm, e4 the scalar: scalar last, as in the textbook.
        - `angular_velocity`: relative to this frame [rad/s]: three components in the new frame, or a Vector. None for a
            fixed rotation, as of a sensor on its body; the norm of its parameters is of no account.
        """
        e = components(parameters, 4, "Euler parameters are four numbers, the scalar last")
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
        e = rotations.of_rotation_vector(components(rotation_vector, 3, "A rotation vector has three components"))
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
        if not callable(orientation):
            raise TypeError(f"rotate_by: the orientation is a function (t, q) -> (3, 3), got {orientation!r}.")
        R, R_dot = value_and_rate(lambda t, q: jnp.asarray(orientation(t, q)), t, q, q_dot)  # (3,3) (3,3)
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
        """The rotation matrix (3, 3) that takes components in `other` to components in this frame."""
        return stack([Vector(other, unit).components_in(self) for unit in rotations.IDENTITY]).T


def value_and_rate(function, t, q, q_dot):
    """Value and time derivative of `function(t, q)` along the motion."""
    as_floats = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(float, x)), tree)  # noqa: E731
    t, q, q_dot = as_floats(t), as_floats(_plain(q)), as_floats(_plain(q_dot))
    q_dot = jax.tree.map(lambda x, dx: jnp.asarray(dx, dtype=x.dtype), q, q_dot)
    return jax.jvp(function, (t, q), (jnp.ones_like(t), q_dot))


def _plain(q):
    return jnp.asarray(q) if hasattr(q, "__jax_array__") else q
