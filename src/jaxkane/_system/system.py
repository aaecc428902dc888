"""`System`, the base class of mechanisms: parameters, names, units, motion and loads; and `State`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._common.lookup import checked, not_there, refuse_any, refuse_if, refuse_unknown
from .._scalarjit.cache_key import leaked_tracer
from .._scalarjit.components import Component, Numbers
from .kinematics import Frame, Point, Vector
from .motion import Motion, motion_number
from .parameters import check_fields, check_parameter, concrete_numbers, module_text, parameter_info, text_of, to_float


class NamedVector(Sequence[Component]):
    """A vector (n,) that is indexed by number or by name.

        q[0]; q["roll"]; q["e1":"e4"], including both ends; q["x", "y"]; q[3:7]; a, b = q; "roll" in q

    Arithmetic and comparisons are elementwise and return arrays. `jnp.asarray(q)` is an array for all other operations.
    Items may be exact Python floats. Structural zeros are passed to the methods of a system in this way.
    """

    __slots__ = ("_items", "names")
    __hash__ = None  # type: ignore[assignment]  # as of arrays, which are compared number by number

    def __init__(self, items: Iterable[Component], names: Sequence[str] = ()):
        self._items = tuple(items)
        self.names = tuple(names)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, key: int | str | slice | Sequence[int | str]) -> Any:
        if isinstance(key, slice):
            start, stop = (self._place(end) if isinstance(end, str) else end for end in (key.start, key.stop))
            places = slice(start, stop + 1 if isinstance(key.stop, str) else stop, key.step)  # type: ignore[operator]
            return NamedVector(self._items[places], self.names[places])
        if isinstance(key, Sequence) and not isinstance(key, str):
            places = [self._place(k) for k in key]
            return NamedVector([self._items[i] for i in places], [self.names[i] for i in places if self.names])
        return self._items[self._place(key)]

    def _place(self, key: int | str) -> int:
        if isinstance(key, str):
            if key not in self.names:
                raise not_there(key, self.names, "these values")
            return self.names.index(key)
        try:
            return range(len(self))[key]
        except IndexError:
            named = f" ({', '.join(self.names)})" if self.names else ""
            raise IndexError(
                f"The index {key} is out of range for these {len(self)} values{named}. Indices begin at 0."
            ) from None
        except TypeError:
            raise TypeError(
                f"The index must be a name, an integer or a slice, got {key!r}. For a traced index use an array: "
                "jnp.asarray(q)[i]."
            ) from None

    def __iter__(self):
        return iter(self._items)

    def __contains__(self, name: object) -> bool:
        return checked(name, str, "`in` requires a name, such as 'roll' in q") in self.names

    def __getattr__(self, name: str) -> Any:
        if hasattr(jax.Array, name) and not name.startswith("__"):
            raise AttributeError(
                f"Named values do not have the method `.{name}`. Convert them to an array: jnp.asarray(q).{name}."
            )
        raise AttributeError(f"There is no attribute {name!r}. To read a value by name, write q[{name!r}].")

    def __jax_array__(self) -> Array:
        return jnp.stack([jnp.asarray(x) for x in self._items]) if self._items else jnp.zeros(0)

    def __repr__(self) -> str:
        items = map(text_of, self._items)
        return f"Values({', '.join(map('='.join, zip(self.names, items, strict=True)) if self.names else items)})"


def _elementwise(name: str) -> Callable[..., Array]:
    def operator(self: NamedVector, other: Numbers) -> Array:
        try:
            array = jnp.asarray(other)
        except (TypeError, ValueError):
            raise TypeError(
                f"Named values can only be combined with numbers and arrays, got {other!r}. To read one value, write "
                "q['name']."
            ) from None
        return getattr(self.__jax_array__(), name)(array)

    return operator


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"):
    setattr(NamedVector, f"__{_name}__", _elementwise(f"__{_name}__"))
    setattr(NamedVector, f"__r{_name}__", _elementwise(f"__r{_name}__"))
for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    setattr(NamedVector, f"__{_name}__", _elementwise(f"__{_name}__"))
for _name in ("__neg__", "__pos__", "__abs__"):
    setattr(NamedVector, _name, lambda self, name=_name: getattr(self.__jax_array__(), name)())


METHODS = ("motion", "q_dot", "loads", "configuration_constraints", "implied_constraints", "events", "contacts")
METHODS += ("state_rates", "outputs")
NAMES = ("coordinates", "speeds", "dependent_speeds", "auxiliary_speeds", "dependent_coordinates", "inputs", "states")


def _prepared(system: str, name: str, value: object) -> Any:
    """Prepare a class attribute: check names and units, and wrap methods so that they can read values by name."""
    if hasattr(value, "__get__") and not callable(value):  # a property is evaluated on an instance
        return value
    if name in NAMES:
        return _checked_names(system, name, value)
    if name == "units":
        return _checked_units(system, value)
    return _named(value, name) if name in METHODS and callable(value) else value


def _checked_units(system: str, units: object) -> Mapping[str, str]:
    what = f'{system}.units must be a dict of strings by name, such as {{"angle": "rad"}}'
    declared: Mapping[str, str] = checked(units, Mapping, what)
    for name, unit in declared.items():
        checked(checked(name, str, what) and unit, str, f"{what}: {name!r}")
    return declared


def _checked_names(system: str, kind: str, names: object) -> tuple[str, ...]:
    if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) and name for name in names):
        remedy = {str: f" Write ({names!r},).", dataclasses.Field: " Rename the field."}.get(type(names), "")
        raise TypeError(f"{system}.{kind} must be a tuple of names, such as ('angle',); got {names!r}.{remedy}")
    return tuple(names)


class SystemMeta(type(eqx.Module)):
    """The metaclass of systems.

    Attributes that are set on an existing class, such as `Pendulum.loads = f` in a notebook, are prepared like those of
    the class body.
    """

    def __new__(cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **kwargs: Any) -> Any:
        # For a class created by `type(name, bases, members)`, Python would report equinox as its module.
        module = sys._getframe(1).f_globals.get("__name__", "__main__")
        return super().__new__(cls, name, bases, {"__module__": module, **namespace}, **kwargs)

    def __setattr__(cls, name: str, value: object) -> None:
        super().__setattr__(name, _prepared(cls.__name__, name, value))


_VALUE_OF_TRACED = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)
_STATIC_FIELD = (
    " A number that is used in `range(...)` or `if`, such as the number of links, must be a static field: "
    "`links: int = equinox.field(static=True)`."
)


@contextlib.contextmanager
def explain_value_of_traced(label: str, hint: str = "") -> Iterator[None]:
    """Explain errors that occur when a user function needs the value of a traced number."""
    try:
        yield
    except _VALUE_OF_TRACED as error:
        raise TypeError(
            f"{label} uses a traced value where Python needs a concrete number. Time, coordinates, speeds, parameters "
            "and results computed from them are traced. Write jnp.sin for np.sin and math.sin (jnp.polyval for "
            "np.polyval), jnp.where(a > b, x, y) for `if`, and jnp.maximum and jnp.minimum for max and min. Do not use "
            f"float() or .item().{hint}"
        ) from error


def _named(method: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Wrap a method of a system, so that `q`, `u` and `x` may be any sequences and can be indexed by name."""
    # A decorator of such a method copies this attribute, although it is another function.
    if getattr(method, "reads_by_name", None) is method:
        return method

    @functools.wraps(method)
    def call(self: System, t: Component, q: Numbers, *rest: Any, **kwargs: Any) -> Any:
        method = vars(call)["__wrapped__"]  # IPython's autoreload replaces this attribute, but not closures
        q = _values(q, self.coordinates, f"{type(self).__name__}: q")
        if rest:
            names = (*self.speeds, *self.dependent_speeds, *self.auxiliary_speeds)
            rest = (_values(rest[0], names, f"{type(self).__name__}: u", len(self.auxiliary_speeds)), *rest[1:])
        if name == "state_rates" and len(rest) > 1:
            rest = (rest[0], _values(rest[1], self.states, f"{type(self).__name__}: x"), *rest[2:])
        number = motion_number()
        with explain_value_of_traced(f"{type(self).__name__}.{name}", _STATIC_FIELD):
            result = method(self, t, q, *rest, **kwargs)
        if isinstance(result, Motion) and result.number < number:
            raise leaked_tracer(type(self).__name__)
        return result

    vars(call)["reads_by_name"] = call
    return call


def _values(values: Sequence[Component], names: Sequence[str], label: str, n_optional: int = 0) -> NamedVector:
    if isinstance(values, NamedVector) and values.names == tuple(names):
        return values
    items = list(values)
    if len(items) == len(names) - n_optional:
        items += [0.0] * n_optional  # auxiliary speeds are zero
    if len(items) != len(names):
        raise ValueError(f"{label} must have {len(names)} entries ({', '.join(names)}), got {len(items)}.")
    return NamedVector(items, names)


class State(eqx.Module):
    """The state of a system: coordinates, independent speeds and first-order states.

    Attributes are arrays, with leading axes for a batch. They may also be dicts by name, such as
    `jk.State({"angle": 0.3}, {"rate": 1.0})`, in which omitted names are zero.

    - `q`: coordinates (n_q,) [rad, m].
    - `u`: independent speeds (n_u,) [rad/s, m/s].
    - `x`: first-order states (n_x,), or None if there are none. `State(x=...)` is the state of a system that has no
        coordinates and speeds.
    - `contacts`: the contact states, or None. A simulation that starts without them finds them from the gaps and the
        velocities. They contain, contact by contact in alphabetical order, 0 (open), 1 (slides) or 2 (sticks) and the
        direction of the slip.
    """

    q: Float[Array, "*batch n_q"] = eqx.field(converter=to_float, default=())
    u: Float[Array, "*batch n_u"] = eqx.field(converter=to_float, default=())
    x: Float[Array, "*batch n_x"] | None = eqx.field(converter=lambda x: x if x is None else to_float(x), default=None)
    contacts: Float[Array, "*batch m"] | None = eqx.field(
        converter=lambda x: x if x is None else to_float(x), default=None
    )

    def __repr__(self) -> str:
        return module_text(self, ndim=1)


def packed(state: State) -> Float[Array, "*batch n"]:
    """q, u and, if present, x and contacts in one array."""
    parts = (state.q, state.u, state.x, state.contacts)
    return jnp.concatenate([part for part in parts if part is not None], axis=-1)


def packed_motion(state: State) -> Float[Array, "*batch n"]:
    """`packed` without the contact states, which follow from the motion."""
    return packed(State(state.q, state.u, state.x))


def unpacked(system: System, y: Float[Array, "*batch n"]) -> State:
    """The inverse of `packed`."""
    n_q = len(system.coordinates)
    n_y = n_q + len(system.speeds)
    q, u, x = jnp.split(y, [n_q, n_y], axis=-1)
    contacts = None
    if type(system).contacts is not System.contacts and y.shape[-1] > n_y + len(system.states):
        x, contacts = jnp.split(x, [len(system.states)], axis=-1)
    return State(q, u, x if system.states else None, contacts)


class Measurements(Mapping[str, Component]):
    """The type of the argument `now` of `state_rates` and `outputs`, see `MeasurementContext`."""

    u_dot: NamedVector

    def with_values(self, values: Mapping[str, Component]) -> Self: ...
    def acceleration(self, point: Point) -> Vector: ...
    def angular_acceleration(self, frame: Frame) -> Vector: ...
    def force(self, name: str) -> Any: ...


class System(eqx.Module, metaclass=SystemMeta):
    """The base class of mechanisms. Its array fields are the parameters of the mechanism.

    A subclass names its coordinates and speeds and defines `motion`. A system of first-order states only needs `states`
    and `state_rates` instead. If required, it also defines `loads`, `q_dot`,
    `configuration_constraints`, `events`, `state_rates` (first-order states) and `outputs` (sensors). In these methods,
    `u` contains all speeds: first the independent, then the dependent, then the auxiliary speeds. `q`, `u` and `x` can
    be indexed by number or by name: `q[0]`, `q["roll"]`.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for kind in (*NAMES, "units"):
            if kind in cls.__dict__:
                setattr(cls, kind, cls.__dict__[kind])
        for method in METHODS:
            owner = next(base for base in cls.__mro__ if method in base.__dict__)
            if owner is cls or not issubclass(owner, System):  # a mixin class that is not a System
                setattr(cls, method, owner.__dict__[method])

    coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the generalized coordinates."""
    speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the independent generalized speeds. Each has one equation of motion."""
    dependent_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the speeds that the velocity residuals determine, one for each residual."""
    auxiliary_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of auxiliary speeds. They are zero in the motion and give the forces that do no work."""
    dependent_coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the coordinates for which `assemble` solves the configuration constraints. The others are fixed."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the inputs that `loads` reads."""
    states: ClassVar[tuple[str, ...]] = ()
    """Names of first-order states, whose rates `state_rates` returns, e.g. of motors with a lag, bristles, filters."""
    units: ClassVar[Mapping[Any, str]] = {}
    """Units of coordinates, speeds, inputs, states and outputs by name, for tables and plots: `{"q0": "rad", "push":
    "N"}`. Units of rates follow from the declared units. No unit is guessed from a name."""
    check_inertia: ClassVar[bool] = True
    """Whether to reject bodies whose principal moments of inertia violate the triangle inequality by more than 5 %."""

    __repr__ = module_text

    def __check_init__(self) -> None:
        wrong = [name for name in parameter_info(self) if name in _OF_SYSTEM]
        refuse_any(wrong, f"{type(self).__name__}: the parameter", " would replace a method of `System`. Rename it.")
        _check_names(self)
        check_fields(self)
        for name, info in parameter_info(self).items():
            check_parameter(f"{type(self).__name__}.{name}", getattr(self, name), info)

    def motion(self, t: Component, q: Numbers, u: Numbers) -> Motion:
        """Return the `Motion` at time `t` [s], coordinates `q` and speeds `u`.

        A system of first-order states only needs no motion: by default, its motion has no bodies.
        """
        if not (self.coordinates or self.speeds or self.dependent_speeds):
            return Motion([])
        raise NotImplementedError(f"{type(self).__name__} must define motion(self, t, q, u) and return a Motion.")

    def q_dot(self, t: Component, q: Numbers, u: Numbers) -> Sequence[Component]:
        """Return the rates of the coordinates. By default, these are the speeds."""
        n_q, n = len(self.coordinates), len(self.speeds) + len(self.dependent_speeds)
        refuse_if(
            n_q != n,
            f"{type(self).__name__} has {n_q} coordinates and {n} speeds, so its speeds cannot be the rates of its "
            "coordinates: define q_dot(self, t, q, u), one rate for each coordinate.",
        )
        return u[:n_q]

    def loads(self, t: Component, q: Numbers, u: Numbers, motion: Motion, inputs: Mapping[str, Component]) -> Any:
        """Return the active forces and torques: `Force`s and `Torque`s, also in nested tuples.

        `inputs` contains the values of the inputs and of the first-order states by name.
        """
        return ()

    def why_not_finite(self, motion: Motion, inputs: Mapping[str, Component]) -> str:
        """Explain why loads are not finite at a state, for the error message. Return "" if unknown."""
        return ""

    def state_rates(
        self, t: Component, q: Numbers, u: Numbers, x: Numbers, motion: Motion, now: Measurements
    ) -> Sequence[Component] | Mapping[str, Component]:
        """Return the rates of the first-order states, in the order of `states` or in a dict by name.

            states = ("motor_torque",)

            def state_rates(self, t, q, u, x, motion, now):
                return ((now["command"] - x["motor_torque"]) / self.lag,)

        `now` is a `MeasurementContext` with inputs and states by name, and accelerations. In a class without states,
        `super().state_rates(...)` returns an empty dict.
        """
        if inspect.unwrap(type(self).state_rates) is not System.state_rates or not self.states:
            return {}
        raise NotImplementedError(
            f"{type(self).__name__} has states ({', '.join(self.states)}): define state_rates(self, t, q, u, x, "
            "motion, now), one rate for each."
        )

    def outputs(self, t: Component, q: Numbers, u: Numbers, motion: Motion, now: Measurements) -> Mapping[str, Any]:
        """Return the outputs by name. Names of nested dicts are joined by a dot.

            def outputs(self, t, q, u, motion, now):
                box = motion.frames["box"]
                return {"gyro": jk.sensors.gyroscope(box), "strain": self.stiffness * q["bend"]}

        `now` is a `MeasurementContext` with inputs and states by name, accelerations and constraint forces.
        """
        return {}

    def configuration_constraints(self, t: Component, q: Numbers) -> Sequence[Component]:
        """Return the residuals of the holonomic constraints."""
        return ()

    def implied_constraints(self, t: Component, q: Numbers) -> Sequence[Component]:
        """Return residuals that depend on the configuration constraints, such as those of a redundant loop.

        They are checked but not solved: a state that violates them raises an exception.
        """
        return ()

    def events(self, t: Component, q: Numbers, u: Numbers) -> Mapping[str, Any]:
        """Return signed smooth quantities by name. A simulation ends when one of them crosses zero.

        `jaxkane.falling(quantity, then=...)` changes the state instead. A fourth argument `x`, if the method has it,
        contains the first-order states. The status of the simulation is the name of the event. `jaxkane.rising` and
        `jaxkane.falling` select the direction of the crossing. If a quantity is zero at the start, the simulation ends
        at once only if the quantity then changes in the selected direction.
        """
        return {}

    def contacts(self, t: Component, q: Numbers, u: Numbers, motion: Motion) -> Mapping[str, Any]:
        """Return contacts by name: `jaxkane.Contact` and `jaxkane.DryFriction`.

            def contacts(self, t, q, u, motion):
                return {"floor": jk.Contact(motion["foot"], motion.N.y, friction=self.friction)}

        The simulation finds touch-down, impact, rest, slip, stick and lift-off. At most eight contacts
        are possible, or six in a plane with friction.
        """
        return {}


def call_with_states(f: Callable[..., Any], t: Component, q: Numbers, u: Numbers, x: Numbers) -> Any:
    """f(t, q, u), or f(t, q, u, x) if the function has a fourth argument for the first-order states."""
    parameters = inspect.signature(f).parameters.values()
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return f(t, q, u, x) if len(positional) > 3 else f(t, q, u)


def with_class(system: System, kind: type) -> Any:
    """A system of another class, with the same fields."""
    copy = object.__new__(kind)
    for field, value in vars(system).items():
        object.__setattr__(copy, field, value)
    return copy


def has_outputs(system: System) -> bool:
    """Whether the system defines `outputs`. Their names are only known after `outputs` has been evaluated."""
    return type(system).outputs is not System.outputs


def names_of(system: System) -> tuple[tuple[str, ...], ...]:
    """Names of coordinates, independent and dependent speeds, and first-order states."""
    return tuple(map(tuple, (system.coordinates, system.speeds, system.dependent_speeds, system.states)))


_OF_SYSTEM = frozenset(dir(System))  # without attributes of the metaclass, e.g. `register`


def _check_names(system: System) -> None:
    name = type(system).__name__
    names = {kind: _checked_names(name, kind, getattr(system, kind)) for kind in NAMES}
    units = _checked_units(name, system.units)
    # Inherited units may contain names that this class does not have.
    if "units" in vars(type(system)) and not has_outputs(system):
        refuse_unknown(
            units,
            [each for named in names.values() for each in named],
            f"{name}.units: not a coordinate, speed, input or state:",
        )
    owners: dict[str, str] = {}
    for kind in NAMES:
        for each in names[kind] if kind != "dependent_coordinates" else ():  # these are coordinates
            if each in owners:
                places = f"twice in `{kind}`" if owners[each] == kind else f"in `{owners[each]}` and in `{kind}`"
                raise ValueError(
                    f"{name}: the name {each!r} appears {places}. Names must be unique, because values are read by "
                    "name."
                )
            owners[each] = kind
    dependent = names["dependent_coordinates"]
    wrong = [each for i, each in enumerate(dependent) if each not in names["coordinates"] or each in dependent[:i]]
    known = ", ".join(names["coordinates"]) or "none"
    after = f" is not a coordinate, or is repeated. The coordinates are: {known}."
    refuse_any(wrong, f"{name}.dependent_coordinates:", after)


def unit_of(name: str, declared: Mapping[str, str]) -> str:
    """The declared unit of a name, or "".

    If the unit of "q0" is rad, the unit of "q0_dot" and "q0_rate" is rad/s.
    """
    base = name.removesuffix("_rate").removesuffix("_dot")
    return declared.get(name) or (_rate_of(declared.get(base, "")) if base != name else "")


def units_of(system: System) -> dict[str, str]:
    """The declared units of a system by name, and those of speeds that are rates of such coordinates."""
    speeds = (*system.speeds, *system.dependent_speeds)
    names = (*system.coordinates, *speeds, *system.auxiliary_speeds, *system.inputs, *system.states)
    units = {name: unit for name, unit in system.units.items() if name in names or has_outputs(system)}
    if type(system).q_dot is System.q_dot:
        for coordinate, speed in zip(system.coordinates, speeds, strict=False):
            if coordinate in units:
                units.setdefault(speed, _rate_of(units[coordinate]))
    return units


def named_numbers(
    names: Sequence[Sequence[str]],
    rows: Sequence[Any],
    more: Mapping[str, Any],
    units: Mapping[str, str] | Iterable[tuple[str, str]],
) -> str:
    """Numbers by name: "roll=0.1 rad, roll_rate=2 rad/s". Empty if some of them are traced or batched.

    **Arguments:**

    - `names`, `rows`: groups of names, and for each group an array (n,).
    - `more`: further numbers by name.
    - `units`: pairs of a name and its unit.
    """
    units, items = dict(units), []
    for group, row in zip(names, rows, strict=True):
        numbers = concrete_numbers(row)
        if numbers is None or numbers.shape != (len(group),):
            return ""
        items += zip(group, numbers, strict=True)
    for name, value in more.items():
        number = concrete_numbers(value)
        if number is None or number.ndim:
            return ""
        items.append((name, number))
    return ", ".join(f"{name}={text_of(x, unit_of(name, units))}" for name, x in items)


def in_degrees(unit: str) -> bool:
    """Whether a quantity with this unit can be shown in degrees."""
    return unit in ("rad", "rad/s", "rad/s^2")


def refuse_no_angle(names: Iterable[str], units: Iterable[str]) -> None:
    """Raise `ValueError` if degrees are requested but none of the names is declared to be an angle."""
    names = tuple(names)
    if not any(in_degrees(unit) for unit in units):
        raise ValueError(
            f"degrees=True: none of {', '.join(names)} is declared to be an angle. Declare its unit in the system, "
            f'`units = {{{names[0]!r}: "rad"}}`, or pass `units={{{names[0]!r}: "rad"}}`.'
        )


def _rate_of(unit: str) -> str:
    return f"{unit}/s" if unit else ""
