"""Bodies, forces, torques, and `Motion`, which `System.motion` returns."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self, TypeAlias

import jax
import numpy as np
from jaxtyping import Array

from .._common.lookup import Kind, checked, not_there, refuse_if
from .._scalarjit.components import Component, Triple, add, component, dot, is_zero, mul, sub
from ..shapes import Shape, as_shapes
from .kinematics import Frame, Point, Vector, inertial
from .parameters import concrete_numbers, text_of, wrapped

Inertia: TypeAlias = Component | Sequence[Component] | Sequence[Sequence[Component]] | Array
"""Three principal moments, a matrix (3, 3), or 0.0."""

Loads: TypeAlias = "Load | Iterable[Loads]"
Residuals: TypeAlias = "Component | Vector | Iterable[Residuals]"

UNNAMED = "body"  # the default name of bodies


class Body:
    """A rigid body: mass, central inertia, mass centre and frame.

    **Arguments:**

    - `mass`: [kg].
    - `inertia`: [kg m^2] about the mass centre, with components in `frame`. Either three principal moments, or a
        (3, 3) matrix whose off-diagonal entries are matrix entries (minus the integrals of xy). 0.0 for a particle.
    - `center`: the mass centre, a Point.
    - `frame`: a Frame in which the inertia is constant. A particle does not need a frame.
    - `angular_velocity`: a Vector. The default is the angular velocity of the frame. The frame of an axisymmetric body
        (a wheel, a rotor) need not spin with it; in this case pass the angular velocity of the body (Examples 5 and 7
        of the textbook).
    - `name`: for error messages, forces, animations and `motion["name"]`.
    - `about`: a Point that is fixed in `frame`, if `inertia` is about this point. The parallel axis theorem gives the
        central inertia, I - m (r.r 1 - r r). If the inertia is about one axis only, (0.0, 0.0, J), only this moment
        changes.
    - `shape`: what animations draw for the body, one of `jaxkane.shapes` or a list of these. Default: the uniform solid
        with its mass and inertia. A body of mass 0.0 in the inertial frame carries the shapes of the ground.

    **Raises:** `ValueError` for an inertia of another shape, and for an inertia without a frame. `TypeError` for
    arguments of a wrong type.
    """

    __slots__ = ("about", "angular_velocity", "center", "frame", "inertia", "is_particle", "mass", "name", "shapes")

    def __init__(
        self,
        mass: Component,
        inertia: Inertia,
        center: Point,
        frame: Frame | None = None,
        angular_velocity: Vector | None = None,
        name: str = UNNAMED,
        about: Point | None = None,
        shape: Shape | Sequence[Shape] = (),
    ):
        for label, value, kind in (
            (f"the mass centre of {name!r} is a Point", center, Point),
            (f"the frame of {name!r} must be a Frame", frame, Frame | None),
            (f"the angular velocity of {name!r} must be a Vector", angular_velocity, Vector | None),
            (f"the inertia of {name!r} must be about a Point", about, Point | None),
            ("the name must be a string", name, str),
        ):
            checked(value, kind, f"Body(mass, inertia, center, frame): {label}")
        self.mass = component(mass)
        self.inertia = _inertia(inertia, name)
        self.is_particle = frame is None and angular_velocity is None
        has_inertia = about is not None or not all(is_zero(x) for row in self.inertia for x in row)
        refuse_if(
            self.is_particle and has_inertia,
            f"Body(mass, inertia, center): {name!r} has an inertia, but no frame. Pass its frame: "
            "Body(mass, inertia, center, frame). For a particle, pass 0.0 as inertia.",
        )
        self.center = center
        self.frame = center.velocity.frame.root if frame is None else frame
        self.angular_velocity = self.frame.angular_velocity if angular_velocity is None else angular_velocity
        self.name = name
        self.shapes = as_shapes(shape, name)
        self.about = about
        if about is not None:
            given = self.inertia
            self.inertia = parallel_axis(given, self.mass, center.position_from(about).components_in(self.frame))
            places = [(i, j) for i in range(3) for j in range(3) if not is_zero(given[i][j])]
            if len(places) == 1:
                # An inertia about one axis only, of a plane mechanism. The parallel axis theorem would give negative
                # moments: (0, 0, J) about a pin at 0.3 m became (-0.14, 0, J - 0.14).
                rows: Any = [[self.inertia[i][j] if (i, j) in places else 0.0 for j in range(3)] for i in range(3)]
                self.inertia = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))

    def __repr__(self) -> str:
        items, moments = [self.name], [x for row in self.inertia for x in row if not is_zero(x)]
        if concrete_numbers(self.mass) is not None:
            items.append(f"mass={text_of(self.mass, 'kg')}")
        if moments and all(concrete_numbers(x) is not None for x in moments):
            principal = all(is_zero(self.inertia[i][j]) for i in range(3) for j in range(i))
            inertia = [self.inertia[i][i] for i in range(3)] if principal else [[*row] for row in self.inertia]
            items.append(f"inertia={text_of(inertia)} kg m^2")
        return wrapped(f"Body({', '.join(items)})")


class ReflectedInertia(Body):
    """The inertia of a geared rotor at its joint. It has kinetic energy but no momentum.

    The momentum of the real rotor is smaller by the gear ratio, and its axis is unknown. The angular momentum in the
    audit therefore does not contain these bodies.
    """

    __slots__ = ()


def point_of(part: Point | Body) -> Point:
    """A point, or the mass centre of a body.

    **Raises:** `TypeError` for other arguments.
    """
    return checked(part.center if isinstance(part, Body) else part, Point, "Pass a Point or a Body")


def _inertia(value: Inertia, name: str) -> tuple[Triple, Triple, Triple]:
    if isinstance(value, str) or value is None:
        raise TypeError(f"{name}: the inertia must be three principal moments or a (3, 3) matrix, got {value!r}.")
    rows: Any = (0.0, 0.0, 0.0) if isinstance(value, (int, float)) and value == 0 else value
    if not hasattr(rows, "shape") and isinstance(rows, Sequence):  # entries may be traced numbers
        shape = (len(rows), *{len(row) for row in rows if isinstance(row, (tuple, list)) or np.ndim(row) == 1})
    else:
        shape = np.shape(rows)
    if shape == (3,):
        a, b, c = (component(x) for x in rows)
        return ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    if shape == (3, 3):
        return tuple(tuple(component(x) for x in row) for row in rows)  # type: ignore[return-value]
    raise ValueError(
        f"{name}: the inertia must be three principal moments or a (3, 3) matrix about the mass centre, got the shape "
        f"{shape}."
    )


def parallel_axis(I: tuple[Triple, Triple, Triple], m: Component, r: Triple) -> tuple[Triple, Triple, Triple]:
    """The central inertia I - m (r.r 1 - r r). I is about a point, and `r` is from this point to the mass centre."""
    squares = [mul(x, x) for x in r]
    rows = []
    for i in range(3):
        across = add(squares[(i + 1) % 3], squares[(i + 2) % 3])
        point_mass = [across if i == j else mul(-1.0, mul(r[i], r[j])) for j in range(3)]
        rows.append(tuple(sub(I[i][j], mul(m, point_mass[j])) for j in range(3)))
    return tuple(rows)  # type: ignore[return-value]


class Force:
    """A force [N] that acts at a Point or at the mass centre of a Body."""

    __slots__ = ("point", "vector")

    def __init__(self, vector: Vector, point: Point | Body):
        self.vector = checked(
            vector, Vector, "Force(vector, ...): the first argument must be a Vector such as 3.0 * N.x"
        )
        self.point = point_of(
            checked(point, (Point, Body), "Force(vector, point): the second argument must be a Point or a Body")
        )

    def __repr__(self) -> str:
        return f"Force({self.vector} [N] at {self.point.name})"

    @property
    def velocity(self) -> Vector:
        """The velocity whose partial velocities multiply the force."""
        return self.point.velocity


class Torque:
    """A torque [N m] that acts on a body or a frame, with an optional reaction on another one.

        Torque(T * C.z, fork, reaction_on=frame)

    **Arguments:**

    - `vector`: the torque [N m], a Vector.
    - `on`: the Body or Frame on which the torque acts.
    - `reaction_on`: the Body or Frame on which the opposite torque acts, or None.

    **Raises:** `ValueError` for a particle, because it has no frame.
    """

    __slots__ = ("vector", "velocity")

    def __init__(self, vector: Vector, on: Frame | Body, reaction_on: Frame | Body | None = None):
        self.vector = checked(
            vector, Vector, "Torque(vector, ...): the first argument must be a Vector such as 3.0 * N.x"
        )
        for part in (on, reaction_on):
            checked(part, Frame | Body | None, "Torque(vector, on): a torque must act on a Body or a Frame")
            if isinstance(part, Body) and part.is_particle:
                raise ValueError(
                    f"Torque(vector, on): {part.name!r} is a particle, on which a torque has no effect. Apply it to "
                    "the frame that rotates, or pass this frame to the body: Body(mass, inertia, center, frame)."
                )
        self.velocity = on.angular_velocity
        if reaction_on is not None:
            self.velocity = on.angular_velocity - reaction_on.angular_velocity

    def __repr__(self) -> str:
        return f"Torque({self.vector} [N m])"


Load = Force | Torque


def flatten_loads(loads: Loads, method: str = "`loads`") -> tuple[Load, ...]:
    """Flatten nested tuples and lists of loads."""
    if isinstance(loads, (Force, Torque)):
        return (loads,)
    if isinstance(loads, Iterable) and not isinstance(loads, (str, Mapping)):
        return tuple(load for item in loads for load in flatten_loads(item, method))
    hint = " Does it end without a `return`?" if loads is None else ""
    raise TypeError(f"{method} must return Forces and Torques, got {loads!r}.{hint}")


class SomeComponents(NamedTuple):
    """Some components of one vector residual, and all components of this vector.

    Each component is compared with the size of `all`. Otherwise, the component normal to a plane mechanism would be
    compared with the rounding errors of its own terms.
    """

    components: tuple[Component, ...]
    all: tuple[Component, ...]


class GroupedResiduals(list[Component]):
    """A list of residuals, and their groups."""

    def __init__(self, groups: Iterable[SomeComponents]):
        self.groups = [*groups]
        super().__init__(x for group in self.groups for x in group.components)


def residual_groups(residuals: Residuals, label: str) -> Iterator[SomeComponents]:
    """Flatten residuals: numbers, arrays, Vectors (three components each), and nested tuples and lists of these."""
    if isinstance(residuals, GroupedResiduals):
        yield from residuals.groups
    elif isinstance(residuals, Vector):
        yield SomeComponents(residuals.components, residuals.components)
    elif isinstance(residuals, (jax.Array, np.ndarray)) and residuals.ndim:
        yield from residual_groups([*residuals.reshape(-1)], label)
    elif isinstance(residuals, Iterable) and not isinstance(residuals, (str, Mapping, jax.Array, np.ndarray)):
        for item in residuals:
            yield from residual_groups(item, label)
    else:
        try:
            yield SomeComponents((component(residuals),), (component(residuals),))
        except TypeError:
            hint = " Does the method end without a `return`?" if residuals is None else ""
            raise TypeError(f"{label} must be a list of numbers and Vectors, got {residuals!r}.{hint}") from None


def flatten_residuals(residuals: Residuals, label: str) -> tuple[Component, ...]:
    """The residuals of all groups in one list."""
    return tuple(x for group in residual_groups(residuals, label) for x in group.components)


_numbers = itertools.count()


def motion_number() -> int:
    """A number that increases with every call, to distinguish motions.

    This must be a function of this module, because cloudpickle stores it by its name. It would store a copy of
    `_numbers.__next__`, with other numbers.
    """
    return next(_numbers)


class DuplicateName(ValueError):
    """Two bodies, points or frames have the same name."""


class Motion:
    """The result of `System.motion`: bodies, velocity residuals, and named points and frames.

    **Arguments:**

    - `bodies`: a list of all Bodies. It may be empty in a system without speeds.
    - `constraints`: velocity residuals [m/s or rad/s], which are zero and affine in the speeds. A Vector is three
        residuals.
    - `points`: a dict of named points, for `loads`, animations and `motion["P"]`.
    - `frames`: a dict of named frames.

    **Raises:** `ValueError` if two parts have the same name. `TypeError` for arguments of a wrong type.
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
                raise TypeError(f"Motion(bodies, constraints): the {label} must be a list, got {value!r}.")
        for label, value in (("points", points), ("frames", frames)):
            checked(value, Mapping | None, f"Motion: the {label} must be a dict by name, e.g. {{'P': P}}")
        self.bodies = _as_tuple(bodies, Body)
        self.residuals = _as_tuple(constraints, (Vector, float, int, jax.Array))  # may contain Vectors
        self.constraints = flatten_residuals(self.residuals, "Motion(bodies, constraints): the velocity residuals")
        self.points = dict(points or {})
        self.frames = dict(frames or {})
        self._named = self._by_name()
        self.number = motion_number()
        velocities = [body.center.velocity for body in self.bodies] + [P.velocity for P in self.points.values()]
        starts = [*(v.frame for v in velocities), *self.frames.values(), inertial()[0]]
        self.N: Frame = starts[0].root
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
        """The motion with additional parts, for a subclass of another system.

            def motion(self, t, q, u):
                motion = super().motion(t, q, u)
                basket = jk.Body(self.load, 0.0, motion["S"].fixed(0.3 * motion["H"].x), name="basket")
                return motion.extended([basket])

        **Arguments:** as `Motion`. Bodies and residuals are appended. New names must differ from the existing ones.
        """
        for kind, old, new in (("point", self.points, points), ("frame", self.frames, frames)):
            twice = [name for name in new or {} if name in old]
            if twice:
                raise DuplicateName(
                    f"Motion.extended: a {kind} with the name {twice[0]!r} already exists. Choose another name."
                )
        extended = copy.copy(self)  # keeps the attributes of subclasses
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
            checked(part, kind, f"Motion: every {kind.__name__.lower()} must be a {kind.__name__}")
            name = checked(name, str, f"Motion: the name of a {kind.__name__.lower()} must be a string")
            if name in named and not (name == UNNAMED and kind is Body):
                kinds = " and ".join(f"a {type(each).__name__.lower()}" for each in (named[name], part))
                raise DuplicateName(
                    f"Motion: two parts have the name {name!r}, {kinds}: motion[{name!r}] could be either. Give them "
                    "different names."
                )
            named[name] = part
        return named

    def __repr__(self) -> str:
        parts = {"bodies": [body.name for body in self.bodies], "points": self.points, "frames": self.frames}
        texts = [f"{kind}: {', '.join(names)}" for kind, names in parts.items() if names]
        return f"Motion({'; '.join([*texts, f'{len(self.constraints)} velocity residuals'])})"

    def __getitem__(self, name: str) -> Any:
        if name not in self._named:
            raise not_there(name, self._named, "this motion, among its bodies, points and frames")
        if name == UNNAMED and sum(body.name == UNNAMED for body in self.bodies) > 1:
            raise KeyError("Several bodies of this motion have no name. Pass Body(..., name=...).")
        return self._named[name]


def _as_tuple(values: Iterable[Any] | Any, one: Kind) -> tuple[Any, ...]:
    return (values,) if isinstance(values, one) else tuple(values)


def weight(motion: Motion, gravity: Vector) -> tuple[Force, ...]:
    """The weights of all bodies of a motion.

    **Arguments:**

    - `motion`: a `Motion`.
    - `gravity`: the gravitational acceleration [m/s^2], a Vector such as `9.81 * N.z`.
    """
    checked(motion, Motion, "weight(motion, gravity): the first argument must be a Motion")
    return tuple(Force(body.mass * gravity, body.center) for body in motion.bodies)


def kinetic_energy_of(motion: Motion) -> Component:
    """Kinetic energy [J]: 1/2 of the sum of m v.v + omega . I . omega over the bodies."""
    total: Component = 0.0
    for body in motion.bodies:
        v = body.center.velocity.components
        w = body.angular_velocity.components_in(body.frame)
        H = tuple(dot(row, w) for row in body.inertia)
        total = total + 0.5 * (body.mass * dot(v, v) + dot(w, H))
    return total
