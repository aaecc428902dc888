"""The description of a mechanism: bodies, loads, motion, parameters. Describes; never differentiates or solves."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ._components import add, component, dot, is_zero, mul, sub
from ._lookup import not_there
from ._types import Component, Triple
from ._vectors import Frame, Point, Vector


def parameter(
    default: Any = dataclasses.MISSING, *, positive: bool = False, shape: tuple[int, ...] | None = None
) -> Any:
    """A physical parameter of a `System`: a float array from birth, in SI units and radians.

        mass: Scalar = jk.parameter(positive=True)  # [kg]
        moments: Array = jk.parameter([0.1, 0.2, 0.2], positive=True)  # [kg m^2]

    **Arguments:**

    - `default`: a number, or an array or nested lists of numbers; without one the parameter must be given.
    - `positive`: refuse zero and negative values, and let a fit move it on a logarithmic scale.
    - `shape`: of the array, by default that of `default`, or `()` for a number. A value with leading axes more is a
        batch.
    """
    if default is dataclasses.MISSING:
        return eqx.field(converter=_to_float, metadata={"jaxkane": ParameterInfo(positive, shape or ())})
    # A copy, as NumPy: a list that is changed later must not change the default, and JAX must not start yet.
    default = default if isinstance(default, jax.Array) or np.ndim(default) == 0 else np.array(default)
    metadata = {"jaxkane": ParameterInfo(positive, np.shape(default) if shape is None else shape)}
    return eqx.field(converter=_to_float, metadata=metadata, default_factory=lambda: default)


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What `parameter` was told: whether the value must be positive, and the shape of one value."""

    positive: bool
    shape: tuple[int, ...]


def parameter_info(system: System | type[System]) -> dict[str, ParameterInfo]:
    """Name and `ParameterInfo` of every parameter of a system, in the order of their declaration."""
    fields = dataclasses.fields(system)  # type: ignore[arg-type]
    return {f.name: f.metadata["jaxkane"] for f in fields if "jaxkane" in f.metadata}


def _to_float(value: Any) -> Any:
    # What is no number is left alone here: `System.__check_init__` refuses it by its name.
    if isinstance(value, (jax.Array, np.ndarray)) and jnp.issubdtype(value.dtype, jnp.inexact):
        return jnp.asarray(value)
    try:
        array = np.asarray(value) if not isinstance(value, jax.Array) else value
    except (TypeError, ValueError):
        numbers = jax.tree.leaves(value) if isinstance(value, (list, tuple)) else []
        traced = [x for x in numbers if isinstance(x, Tracer)]
        if not traced or any(isinstance(x, str) for x in numbers):
            return value
        return jnp.asarray(value, dtype=jnp.result_type(float, *traced))
    if array.dtype.kind in "iuf":
        return jnp.asarray(array, dtype=float)
    return value


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
        if not isinstance(center, Point):
            raise TypeError(
                f"Body(mass, inertia, center, ...): the mass centre of {name!r} is a Point, got {center!r}."
            )
        if not isinstance(frame, (Frame, type(None))):
            raise TypeError(f"Body(mass, inertia, center, frame): the frame of {name!r} is a Frame, got {frame!r}.")
        if not isinstance(angular_velocity, (Vector, type(None))):
            raise TypeError(f"Body: the angular velocity of {name!r} is a Vector, got {angular_velocity!r}.")
        if not isinstance(about, (Point, type(None))):
            raise TypeError(f"Body(..., about=P): the inertia of {name!r} is about a Point, got {about!r}.")
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
            self.inertia = _central(self.inertia, self.mass, center.position_from(about).components_in(self.frame))

    def __repr__(self) -> str:
        return f"Body({self.name})"


def _inertia(given: Any, name: str) -> tuple[Triple, Triple, Triple]:
    inertia: Any = (0.0, 0.0, 0.0) if isinstance(given, (int, float)) and given == 0 else given
    has_length = not hasattr(inertia, "shape") and isinstance(inertia, Sequence)
    shape = (len(inertia), *_inner(inertia)) if has_length else np.shape(inertia)
    if shape == (3,):
        a, b, c = (component(x) for x in inertia)
        return ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    if shape == (3, 3):
        return tuple(tuple(component(x) for x in row) for row in inertia)  # type: ignore[return-value]
    raise ValueError(
        f"{name}: the inertia is three principal moments or a (3, 3) matrix about the mass centre, got shape {shape}."
    )


def _central(I: tuple[Triple, Triple, Triple], m: Component, r: Triple) -> tuple[Triple, Triple, Triple]:
    """The inertia about the mass centre, which is at `r` from the point about which it is I: I - m (r.r 1 - r r)."""
    squares = [mul(x, x) for x in r]
    rows = []
    for i in range(3):
        across = add(squares[(i + 1) % 3], squares[(i + 2) % 3])
        moved = [across if i == j else mul(-1.0, mul(r[i], r[j])) for j in range(3)]
        rows.append(tuple(sub(I[i][j], mul(m, moved[j])) for j in range(3)))
    return tuple(rows)  # type: ignore[return-value]


def _inner(rows: Sequence[Any]) -> tuple[int, ...]:
    inner = {len(row) for row in rows if isinstance(row, (tuple, list)) or np.ndim(row) == 1}
    return tuple(inner)


class Force:
    """A force [N] that acts at a point: a Point, or the mass centre of a Body."""

    __slots__ = ("point", "vector")

    def __init__(self, vector: Vector, point: Point | Body):
        self.vector = _checked(vector, "Force")
        self.point = point.center if isinstance(point, Body) else point
        if not isinstance(self.point, Point):
            raise TypeError(f"Force(vector, point): the second argument is a Point or a Body, got {point!r}.")

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


def weight(motion: Motion, gravity: Vector) -> tuple[Force, ...]:
    """The weight of every body of a motion; `gravity` [m/s^2] is a Vector such as `9.81 * N.z`."""
    return tuple(Force(body.mass * gravity, body.center) for body in motion.bodies)


def flatten_loads(loads: Any, method: str = "`loads`") -> tuple[Load, ...]:
    """Loads out of nested tuples and lists."""
    if isinstance(loads, (Force, Torque)):
        return (loads,)
    if isinstance(loads, Iterable) and not isinstance(loads, (str, Mapping)):
        return tuple(load for item in loads for load in flatten_loads(item, method))
    hint = " Does it end without a `return`?" if loads is None else ""
    raise TypeError(f"{method} returns Forces and Torques, got {loads!r}.{hint}")


def flatten_residuals(given: Any, what: str) -> tuple[Component, ...]:
    """Residuals out of numbers, arrays, Vectors (three components each) and nested tuples and lists of these."""
    if isinstance(given, Vector):
        return given.components
    if isinstance(given, (jax.Array, np.ndarray)) and given.ndim:
        return tuple(component(x) for x in given.reshape(-1))
    if isinstance(given, Iterable) and not isinstance(given, (str, Mapping, jax.Array, np.ndarray)):
        return tuple(x for item in given for x in flatten_residuals(item, what))
    try:
        return (component(given),)
    except TypeError:
        hint = " Does the method end without a `return`?" if given is None else ""
        raise TypeError(f"{what} are numbers and Vectors in a list, got {given!r}.{hint}") from None


class Motion:
    """What `System.motion` returns: bodies, velocity residuals, and the frames and points that others ask for.

    **Arguments:**

    - `bodies`: every Body.
    - `constraints`: velocity residuals [m/s or rad/s] that are zero in the motion and affine in the speeds; a Vector
        counts as its three components.
    - `points`, `frames`: those that `loads`, pictures or a user need, by name: `motion["P"]`.

    **Raises:** `ValueError` where one name stands for two of these; `TypeError` for what is no body, point or frame.
    """

    __slots__ = ("N", "_named", "bodies", "constraints", "frames", "points", "vanishing")

    def __init__(
        self,
        bodies: Iterable[Body],
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ):
        self.bodies: tuple[Body, ...] = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        if not self.bodies:
            raise ValueError("A Motion needs at least one Body.")
        given = (constraints,) if isinstance(constraints, (Vector, float, int, jax.Array)) else tuple(constraints)
        self.vanishing = given  # the residuals as they were given
        self.constraints = flatten_residuals(given, "Motion(bodies, constraints): the velocity residuals")
        self.points = dict(points or {})
        self.frames = dict(frames or {})
        self._named = self._by_name()
        self.N: Frame = self.bodies[0].center.velocity.frame.root
        for name, part in (*self.points.items(), *self.frames.items()):
            part.name = name

    def _by_name(self) -> dict[str, Body | Point | Frame]:
        named: dict[str, Any] = {}
        kinds = (
            (Body, [(getattr(body, "name", None), body) for body in self.bodies]),
            (Point, self.points.items()),
            (Frame, self.frames.items()),
        )
        for kind, parts in kinds:
            for name, part in parts:
                if not isinstance(part, kind):
                    raise TypeError(f"Motion: this is no {kind.__name__}, but stands among these: {part!r}.")
                if not isinstance(name, str):
                    raise TypeError(f"Motion: the name of {part!r} must be a string, got {name!r}.")
                if name in named and not (name == UNNAMED and kind is Body):
                    raise ValueError(
                        f"Motion: two parts have the name {name!r}, {_told(named[name])} and {_told(part)}: "
                        f"motion[{name!r}] could be either. Give them different names."
                    )
                named[name] = part
        return named

    def __getitem__(self, name: str) -> Any:
        if name not in self._named:
            raise not_there(name, self._named, "this motion, among its bodies, points and frames")
        if name == UNNAMED and sum(body.name == UNNAMED for body in self.bodies) > 1:
            raise KeyError("Several bodies of this motion have no name of their own: Body(..., name=...).")
        return self._named[name]


def _told(part: Body | Point | Frame) -> str:
    return f"a {type(part).__name__.lower()}"


class Values(Sequence[Component]):
    """Numbers by place and by name. JAX takes it for an array of shape (n,).

        q[0], q["roll"]; q["e1":"e4"], of which both ends are meant; q["x", "y"]; q[3:7]; a, b = q; "roll" in q

    Arithmetic gives arrays; `jnp.asarray(q)` is one, for all else. The items may be exact Python floats, which is how a
    structural zero reaches a description.
    """

    __slots__ = ("_items", "names")

    def __init__(self, items: Iterable[Component], names: Sequence[str] = ()):
        self._items = tuple(items)
        self.names = tuple(names)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            return self._items[self._place(key)]
        if isinstance(key, slice):
            start, stop = (self._place(end) if isinstance(end, str) else end for end in (key.start, key.stop))
            places = slice(start, stop + 1 if isinstance(key.stop, str) else stop, key.step)  # type: ignore[operator]
            return Values(self._items[places], self.names[places])
        if isinstance(key, (tuple, list)):
            places = [self._place(k) if isinstance(k, str) else range(len(self))[k] for k in key]
            return Values([self._items[i] for i in places], [self.names[i] for i in places if self.names])
        return self._items[key]

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise not_there(name, self.names, "these values")
        return self.names.index(name)

    def __iter__(self):
        return iter(self._items)

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str):
            raise TypeError(f"`in` asks for a name, as 'roll' in q; got {name!r}.")
        return name in self.names

    def __getattr__(self, name: str) -> Any:
        if hasattr(jax.Array, name) and not name.startswith("__"):
            raise AttributeError(
                f"Values are named numbers and have no `.{name}`: jnp.asarray(q) is an array, which has."
            )
        raise AttributeError(f"Values have no {name!r}; by name they are read as q[{name!r}].")

    def __jax_array__(self) -> Array:
        return jnp.stack([jnp.asarray(x) for x in self._items]) if self._items else jnp.zeros(0)

    def __repr__(self) -> str:
        return f"Values({dict(zip(self.names, self._items, strict=True)) if self.names else self._items})"

    def __neg__(self) -> Array:
        return -self.__jax_array__()

    def __pos__(self) -> Array:
        return self.__jax_array__()

    def __abs__(self) -> Array:
        return abs(self.__jax_array__())


def _elementwise(name: str) -> Callable[..., Array]:
    def operator(self: Values, other: Any) -> Array:
        return getattr(self.__jax_array__(), name)(jnp.asarray(other))

    return operator


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"):
    setattr(Values, f"__{_name}__", _elementwise(f"__{_name}__"))
    setattr(Values, f"__r{_name}__", _elementwise(f"__r{_name}__"))
for _name in ("lt", "le", "gt", "ge"):
    setattr(Values, f"__{_name}__", _elementwise(f"__{_name}__"))


class State(eqx.Module):
    """What is integrated: coordinates and independent speeds.

    Attributes: `q` (n_q,) [rad, m], `u` (n_u,) [rad/s, m/s]; a batch has leading axes. Or dicts by name, which are read
    where the state meets its system: `jk.State({"angle": 0.3}, {"rate": 1.0})`. Names left out are zero.
    """

    q: Float[Array, "*batch n_q"] = eqx.field(converter=_to_float)
    u: Float[Array, "*batch n_u"] = eqx.field(converter=_to_float)


class System(eqx.Module):
    """A mechanism: its array leaves are its parameters, its methods describe it.

    A subclass names its coordinates and speeds, and writes `motion`; and, where it needs them, `loads`, `q_dot`,
    `configuration_constraints` and `events`. The `u` that these receive holds all speeds: first the independent, then
    the dependent, then the auxiliary ones. `q` and `u` are read by place or by name: `q[0]`, `q["roll"]`.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for kind in NAMES:
            if kind in cls.__dict__ and not hasattr(cls.__dict__[kind], "__get__"):  # a property is read of an instance
                setattr(cls, kind, _checked_names(cls.__name__, kind, cls.__dict__[kind]))
        for method in ("motion", "q_dot", "loads", "configuration_constraints", "events"):
            if method in cls.__dict__:
                setattr(cls, method, _named(cls.__dict__[method]))

    coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the generalized coordinates."""
    speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the independent generalized speeds: one equation of motion for each."""
    dependent_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the speeds that the velocity residuals determine: as many as there are residuals."""
    auxiliary_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of speeds that are zero in the motion, for the forces that do no work."""
    dependent_coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the coordinates that `assemble` finds from the configuration constraints; the others are held."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the inputs that `loads` reads."""
    units: ClassVar[Mapping[str, str]] = {}
    """Units of coordinates, speeds and inputs by name, for pictures: `{"q0": "rad", "push": "N"}`. Those of usual
    names, as "roll", "x" or "steer_torque", are known without."""
    check_inertia: ClassVar[bool] = True
    """Whether bodies are refused whose principal moments of inertia break the triangle inequality by more than 5 %."""

    def __check_init__(self) -> None:
        _check_names(self)
        _check_fields(self)
        for name, info in parameter_info(self).items():
            check_parameter(f"{type(self).__name__}.{name}", getattr(self, name), info)

    def motion(self, t: Component, q: Any, u: Any) -> Motion:
        """Bodies and velocity residuals at time `t` [s], coordinates `q` and speeds `u`."""
        raise NotImplementedError(f"{type(self).__name__} must define motion(self, t, q, u) and return a Motion.")

    def q_dot(self, t: Component, q: Any, u: Any) -> Sequence[Component]:
        """Rates of the coordinates. By default they are the speeds."""
        n_q, n = len(self.coordinates), len(self.speeds) + len(self.dependent_speeds)
        if n_q != n:
            raise ValueError(
                f"{type(self).__name__} has {n_q} coordinates and {n} speeds, so its speeds cannot be the rates of its "
                "coordinates: define q_dot(self, t, q, u), one rate for each coordinate."
            )
        return u[:n_q]

    def loads(self, t: Component, q: Any, u: Any, motion: Motion, inputs: Mapping[str, Component]) -> Any:
        """Active forces and torques: `Force`s and `Torque`s, nested in tuples as is convenient."""
        return ()

    def configuration_constraints(self, t: Component, q: Any) -> Sequence[Component]:
        """Residuals that are zero in every possible configuration."""
        return ()

    def events(self, t: Component, q: Any, u: Any) -> Mapping[str, Any]:
        """Signed, smooth quantities by name; a simulation ends, with that name as its status, when one passes zero.

        `jaxkane.rising` or `jaxkane.falling` of a quantity counts in that direction only. A motion that starts on zero
        ends at once only if it leaves in its named direction.
        """
        return {}


NAMES = ("coordinates", "speeds", "dependent_speeds", "auxiliary_speeds", "dependent_coordinates", "inputs")
_FOUND_BY_NAME = tuple(kind for kind in NAMES if kind != "dependent_coordinates")  # these are coordinates


def _checked_names(system: str, kind: str, given: Any) -> tuple[str, ...]:
    if isinstance(given, str):
        raise TypeError(f"{system}.{kind} is a tuple of names; {given!r} is a string. One name is ({given!r},).")
    if not isinstance(given, (tuple, list)) or not all(isinstance(name, str) and name for name in given):
        raise TypeError(f"{system}.{kind} is a tuple of names, such as ('angle',); got {given!r}.")
    return tuple(given)


def _check_names(system: System) -> None:
    """Refuse names that stand for two things."""
    name = type(system).__name__
    names = {kind: _checked_names(name, kind, getattr(system, kind)) for kind in NAMES}
    owners: dict[str, str] = {}
    for kind in _FOUND_BY_NAME:
        for each in names[kind]:
            if each in owners:
                places = f"twice in `{kind}`" if owners[each] == kind else f"in `{owners[each]}` and in `{kind}`"
                raise ValueError(f"{name}: the name {each!r} stands {places}: q, u and trajectories are read by name.")
            owners[each] = kind
    dependent = names["dependent_coordinates"]
    strange = [each for i, each in enumerate(dependent) if each not in names["coordinates"] or each in dependent[:i]]
    if strange:
        have = ", ".join(names["coordinates"]) or "none"
        raise ValueError(
            f"{name}.dependent_coordinates names coordinates, each once: {', '.join(strange)} is none, or stands there "
            f"twice. The coordinates are: {have}."
        )


_ASKED_FOR_A_VALUE = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)


def _named(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a description whose `q` and `u` may be any sequence, and are read by place and by name."""

    @functools.wraps(method)
    def call(self: System, t: Component, q: Any, *rest: Any, **more: Any) -> Any:
        q = _values(q, self.coordinates, f"{type(self).__name__}: q")
        if rest:
            names = (*self.speeds, *self.dependent_speeds, *self.auxiliary_speeds)
            rest = (_values(rest[0], names, f"{type(self).__name__}: u", len(self.auxiliary_speeds)), *rest[1:])
        try:
            return method(self, t, q, *rest, **more)
        except _ASKED_FOR_A_VALUE as error:
            raise TypeError(
                f"{type(self).__name__}.{method.__name__} asks for the value of a number that has none while the "
                "description is traced: time, coordinates, speeds, parameters, and what follows from them. Write "
                "jnp.sin for np.sin and math.sin, jnp.where(a > b, x, y) for `if`, jnp.maximum and jnp.minimum for max "
                "and min, and neither float() nor .item(). A number that a description counts with, as that of its "
                "links, is a static field: `links: int = equinox.field(static=True)`."
            ) from error

    return call


def _values(values: Any, names: Sequence[str], label: str, n_optional: int = 0) -> Values:
    if isinstance(values, Values) and values.names == tuple(names):
        return values
    items = list(values)
    if len(items) == len(names) - n_optional:
        items += [0.0] * n_optional  # auxiliary speeds are zero in the motion
    if len(items) != len(names):
        raise ValueError(f"{label} must have {len(names)} entries ({', '.join(names)}), got {len(items)}.")
    return Values(items, names)


def _check_fields(system: System) -> None:
    """Refuse numbers that a description counts with, names and switches as fields that JAX would trace."""
    for path, value in jax.tree_util.tree_leaves_with_path(system):
        name = path[0].name
        if isinstance(value, (bool, int, str)) and name not in parameter_info(system):
            whole = getattr(system, name)
            kind = type(whole).__name__
            raise TypeError(
                f"{type(system).__name__}.{name} = {whole!r} would be traced as an array, and a description could not "
                f"count with it. What belongs to the description, as a number of links: `{name}: {kind} = "
                f"equinox.field(static=True)`. A physical parameter: `{name}: jk.Scalar = jk.parameter()`."
            )


def check_parameter(label: str, value: Any, info: ParameterInfo) -> None:
    """Refuse what is no finite float; a batch is left to the status of its members."""
    if isinstance(value, Tracer):
        return
    if not (isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)):
        raise TypeError(f"{label} must be a real number or a float array, got {value!r}.")
    n = value.ndim - len(info.shape)
    if n < 0 or value.shape[n:] != info.shape:
        raise ValueError(
            f"{label} must have the shape {info.shape}, or leading axes more for a batch; got {value.shape}."
        )
    if n > 0:
        return
    array = np.asarray(value)
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{label} = {array} is not finite.")
    if info.positive and not np.all(array > 0):
        raise ValueError(f"{label} = {array} must be positive.")


def kinetic_energy_of(motion: Motion) -> Component:
    """1/2 sum of m v.v + omega . I . omega over the bodies [J]."""
    total: Component = 0.0
    for body in motion.bodies:
        v = body.center.velocity.components
        w = body.angular_velocity.components_in(body.frame)
        H = tuple(dot(row, w) for row in body.inertia)
        total = total + 0.5 * (body.mass * dot(v, v) + dot(w, H))
    return total
