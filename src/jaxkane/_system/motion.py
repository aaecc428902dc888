"""Bodies, the forces and torques that act on them, and what `System.motion` returns.

Differentiates and solves nothing.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import jax
import numpy as np

from .._common.lookup import not_there
from .._scalarjit.components import Component, Triple, add, component, dot, is_zero, mul, sub
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


def flatten_residuals(residuals: Any, label: str) -> tuple[Component, ...]:
    """Residuals out of numbers, arrays, Vectors (three components each) and nested tuples and lists of these."""
    if isinstance(residuals, Vector):
        return residuals.components
    if isinstance(residuals, (jax.Array, np.ndarray)) and residuals.ndim:
        return tuple(component(x) for x in residuals.reshape(-1))
    if isinstance(residuals, Iterable) and not isinstance(residuals, (str, Mapping, jax.Array, np.ndarray)):
        return tuple(x for item in residuals for x in flatten_residuals(item, label))
    try:
        return (component(residuals),)
    except TypeError:
        hint = " Does the method end without a `return`?" if residuals is None else ""
        raise TypeError(f"{label} are numbers and Vectors in a list, got {residuals!r}.{hint}") from None


motion_number = itertools.count().__next__
"""A number that is larger at every call: it distinguishes a motion from one that was made before."""


class DuplicateName(ValueError):
    """A body, a point or a frame with the name of another."""


class Motion:
    """What `System.motion` returns: bodies, velocity residuals, and the frames and points that others ask for.

    **Arguments:**

    - `bodies`: every Body.
    - `constraints`: velocity residuals [m/s or rad/s] that are zero in the motion and affine in the speeds; a Vector
        counts as its three components.
    - `points`, `frames`: those that `loads`, pictures or a user need, by name: `motion["P"]`.

    **Raises:** `ValueError` where one name stands for two of these; `TypeError` for what is no body, point or frame.
    """

    __slots__ = ("N", "_named", "bodies", "constraints", "frames", "number", "points", "residuals")

    def __init__(
        self,
        bodies: Iterable[Body],
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ):
        for label, value, kind in (("bodies", bodies, Body), ("constraints", constraints, (float, int, Vector))):
            if not isinstance(value, (kind, Iterable)) or isinstance(value, str):
                raise TypeError(f"Motion(bodies, constraints): the {label} are a list, got {value!r}.")
        for label, value in (("points", points), ("frames", frames)):
            if not isinstance(value, (Mapping, type(None))):
                raise TypeError(f"Motion: the {label} are a dict by name, as {{'P': P}}; got {value!r}.")
        self.bodies = _as_tuple(bodies, Body)
        if not self.bodies:
            raise ValueError("A Motion needs at least one Body.")
        self.residuals = _as_tuple(constraints, (Vector, float, int, jax.Array))  # Vectors among them
        self.constraints = flatten_residuals(self.residuals, "Motion(bodies, constraints): the velocity residuals")
        self.points = dict(points or {})
        self.frames = dict(frames or {})
        self._named = self._by_name()
        self.number = motion_number()
        self.N: Frame = self.bodies[0].center.velocity.frame.root
        for name, part in (*self.points.items(), *self.frames.items()):
            part.name = name

    def extended(
        self,
        bodies: Iterable[Body] | Body = (),
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ) -> Self:
        """The same motion and more, for a class that inherits from another system's.

            def motion(self, t, q, u):
                motion = super().motion(t, q, u)
                basket = jk.Body(self.load, 0.0, motion["S"].fixed(0.3 * motion["H"].x), name="basket")
                return motion.extended([basket])

        **Arguments:** as of `Motion`: what comes behind the bodies and residuals that there are, and under other names.
        """
        for kind, old, new in (("point", self.points, points), ("frame", self.frames, frames)):
            twice = [name for name in new or {} if name in old]
            if twice:
                raise DuplicateName(f"Motion.extended: there is a {kind} of the name {twice[0]!r} already.")
        extended = copy.copy(self)  # with the attributes that a subclass adds
        Motion.__init__(
            extended,
            (*self.bodies, *_as_tuple(bodies, Body)),
            (*self.residuals, *_as_tuple(constraints, (Vector, float, int, jax.Array))),
            points={**self.points, **(points or {})},
            frames={**self.frames, **(frames or {})},
        )
        return extended

    def _by_name(self) -> dict[str, Body | Point | Frame]:
        named: dict[str, Any] = {}
        parts = [(Body, getattr(body, "name", None), body) for body in self.bodies]
        parts += [(Point, *item) for item in self.points.items()] + [(Frame, *item) for item in self.frames.items()]
        for kind, name, part in parts:
            if not isinstance(part, kind):
                raise TypeError(f"Motion: this is no {kind.__name__}, but stands among these: {part!r}.")
            if not isinstance(name, str):
                raise TypeError(f"Motion: the name of {part!r} must be a string, got {name!r}.")
            if name in named and not (name == UNNAMED and kind is Body):
                kinds = " and ".join(f"a {type(each).__name__.lower()}" for each in (named[name], part))
                raise DuplicateName(
                    f"Motion: two parts have the name {name!r}, {kinds}: motion[{name!r}] could be either. Give them "
                    "different names."
                )
            named[name] = part
        return named

    def __getitem__(self, name: str) -> Any:
        if name not in self._named:
            raise not_there(name, self._named, "this motion, among its bodies, points and frames")
        if name == UNNAMED and sum(body.name == UNNAMED for body in self.bodies) > 1:
            raise KeyError("Several bodies of this motion have no name of their own: Body(..., name=...).")
        return self._named[name]


def _as_tuple(values: Any, one: Any) -> tuple[Any, ...]:
    return (values,) if isinstance(values, one) else tuple(values)


def weight(motion: Motion, gravity: Vector) -> tuple[Force, ...]:
    """The weight of every body of a motion; `gravity` [m/s^2] is a Vector such as `9.81 * N.z`."""
    if not isinstance(motion, Motion):
        raise TypeError(f"weight(motion, gravity): the first argument is a Motion, got {motion!r}.")
    return tuple(Force(body.mass * gravity, body.center) for body in motion.bodies)


def kinetic_energy_of(motion: Motion) -> Component:
    """1/2 sum of m v.v + omega . I . omega over the bodies [J]."""
    total: Component = 0.0
    for body in motion.bodies:
        v = body.center.velocity.components
        w = body.angular_velocity.components_in(body.frame)
        H = tuple(dot(row, w) for row in body.inertia)
        total = total + 0.5 * (body.mass * dot(v, v) + dot(w, H))
    return total
