"""A mechanism: its parameters, names, units, motion and loads. Describes; never differentiates or solves."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._common.lookup import not_there, refuse_unknown
from .._scalarjit.cache_key import leaked_tracer
from .._scalarjit.components import Component
from .motion import Motion, motion_number
from .parameters import check_fields, check_parameter, parameter_info, to_float


class NamedVector(Sequence[Component]):
    """Numbers by place and by name. JAX takes it for an array of shape (n,).

        q[0], q["roll"]; q["e1":"e4"], of which both ends are meant; q["x", "y"]; q[3:7]; a, b = q; "roll" in q

    Arithmetic and comparisons, `==` too, go number by number and give arrays; `jnp.asarray(q)` is one, for all else.
    The items may be exact Python floats, which is how a structural zero reaches a description.
    """

    __slots__ = ("_items", "names")
    __hash__ = None  # type: ignore[assignment]  # as of arrays, which are compared number by number

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
            return NamedVector(self._items[places], self.names[places])
        if isinstance(key, (tuple, list)):
            places = [self._place(k) if isinstance(k, str) else range(len(self))[k] for k in key]
            return NamedVector([self._items[i] for i in places], [self.names[i] for i in places if self.names])
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
    def operator(self: NamedVector, other: Any) -> Array:
        try:
            array = jnp.asarray(other)
        except (TypeError, ValueError):
            raise TypeError(
                f"Values are numbers, and meet numbers and arrays alone; got {other!r}. One of them is q['name']."
            ) from None
        return getattr(self.__jax_array__(), name)(array)

    return operator


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"):
    setattr(NamedVector, f"__{_name}__", _elementwise(f"__{_name}__"))
    setattr(NamedVector, f"__r{_name}__", _elementwise(f"__r{_name}__"))
for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    setattr(NamedVector, f"__{_name}__", _elementwise(f"__{_name}__"))


METHODS = ("motion", "q_dot", "loads", "configuration_constraints", "implied_constraints", "events")
METHODS += ("state_rates", "outputs")
NAMES = ("coordinates", "speeds", "dependent_speeds", "auxiliary_speeds", "dependent_coordinates", "inputs", "states")


def _prepared(system: str, name: str, value: Any) -> Any:
    """What a class gets under a name: checked, if it holds names or units; reading by name, if it is a method."""
    if hasattr(value, "__get__") and not callable(value):  # a property is read of an instance
        return value
    if name in NAMES:
        return _checked_names(system, name, value)
    if name == "units":
        return _checked_units(system, value)
    return _named(value, name) if name in METHODS and callable(value) else value


def _checked_units(system: str, units: Any) -> Mapping[str, str]:
    if not isinstance(units, Mapping):
        raise TypeError(f'{system}.units is a dict of texts by name, as {{"angle": "rad"}}; got {units!r}.')
    for name, unit in units.items():
        if not (isinstance(name, str) and isinstance(unit, str)):
            raise TypeError(f'{system}.units has texts by name, as {{"angle": "rad"}}; got {name!r}: {unit!r}.')
    return units


def _checked_names(system: str, kind: str, names: Any) -> tuple[str, ...]:
    if isinstance(names, str):
        raise TypeError(f"{system}.{kind} is a tuple of names; {names!r} is a string. One name is ({names!r},).")
    if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) and name for name in names):
        raise TypeError(f"{system}.{kind} is a tuple of names, such as ('angle',); got {names!r}.")
    return tuple(names)


class SystemMeta(type(eqx.Module)):
    """The metaclass of systems.

    What is set on an existing class, as `Pendulum.loads = f` in a notebook, is prepared as what its body
    defines.
    """

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **kwargs: Any) -> Any:
        # Of a class made by `type(name, bases, members)` Python would say that equinox has made it.
        module = sys._getframe(1).f_globals.get("__name__", "__main__")
        return super().__new__(mcs, name, bases, {"__module__": module, **namespace}, **kwargs)

    def __setattr__(cls, name: str, value: Any) -> None:
        super().__setattr__(name, _prepared(cls.__name__, name, value))


_VALUE_OF_TRACED = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)
_STATIC_FIELD = (
    " A number that a description counts with, as that of its links, is a static field: "
    "`links: int = equinox.field(static=True)`."
)


@contextlib.contextmanager
def explain_value_of_traced(label: str, hint: str = "") -> Iterator[None]:
    """Where a function of the user asks a traced number for its value, the error says which and what to write."""
    try:
        yield
    except _VALUE_OF_TRACED as error:
        raise TypeError(
            f"{label} asks for the value of a number that has none while it is traced: time, coordinates, speeds, "
            "parameters, and what follows from them. Write jnp.sin for np.sin and math.sin (jnp.polyval for "
            "np.polyval), jnp.where(a > b, x, y) for `if`, jnp.maximum and jnp.minimum for max and min, and neither "
            f"float() nor .item().{hint}"
        ) from error


def _named(method: Callable[..., Any], name: str) -> Callable[..., Any]:
    """A method of a description, of that name, whose `q`, `u` and `x` may be any sequence, and are read by place and
    by name."""
    # A decorator of such a method copies this attribute, and is another function.
    if getattr(method, "reads_by_name", None) is method:
        return method

    @functools.wraps(method)
    def call(self: System, t: Component, q: Any, *rest: Any, **kwargs: Any) -> Any:
        method = vars(call)["__wrapped__"]  # IPython's autoreload replaces this attribute, and no closure
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


def _values(values: Any, names: Sequence[str], label: str, n_optional: int = 0) -> NamedVector:
    if isinstance(values, NamedVector) and values.names == tuple(names):
        return values
    items = list(values)
    if len(items) == len(names) - n_optional:
        items += [0.0] * n_optional  # auxiliary speeds are zero in the motion
    if len(items) != len(names):
        raise ValueError(f"{label} must have {len(names)} entries ({', '.join(names)}), got {len(items)}.")
    return NamedVector(items, names)


class State(eqx.Module):
    """What is integrated: coordinates, independent speeds and, where a system has such, states of the first order.

    Attributes: `q` (n_q,) [rad, m], `u` (n_u,) [rad/s, m/s], `x` (n_x,) or None; a batch has leading axes. Or dicts by
    name, which are read where the state meets its system: `jk.State({"angle": 0.3}, {"rate": 1.0})`. Names left out are
    zero.
    """

    q: Float[Array, "*batch n_q"] = eqx.field(converter=to_float)
    u: Float[Array, "*batch n_u"] = eqx.field(converter=to_float)
    x: Float[Array, "*batch n_x"] | None = eqx.field(converter=lambda x: x if x is None else to_float(x), default=None)


def packed(state: State) -> Float[Array, "*batch n"]:
    """q, u and, where there are states of the first order, x in one array."""
    return jnp.concatenate([part for part in (state.q, state.u, state.x) if part is not None], axis=-1)


def unpacked(system: System, y: Float[Array, "*batch n"]) -> State:
    """The state of which `packed` makes y."""
    n_q = len(system.coordinates)
    q, u, x = jnp.split(y, [n_q, n_q + len(system.speeds)], axis=-1)
    return State(q, u, x if system.states else None)


class System(eqx.Module, metaclass=SystemMeta):
    """A mechanism: its array leaves are its parameters, its methods describe it.

    A subclass names its coordinates and speeds, and writes `motion`; and, where it needs them, `loads`, `q_dot`,
    `configuration_constraints` and `events`; `state_rates` of what has states of the first order, and `outputs` of what
    carries sensors. The `u` that these receive holds all speeds: first the independent, then the dependent, then the
    auxiliary ones. `q`, `u` and `x` are read by place or by name: `q[0]`, `q["roll"]`.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for kind in (*NAMES, "units"):
            if kind in cls.__dict__:
                setattr(cls, kind, cls.__dict__[kind])
        for method in METHODS:
            owner = next(base for base in cls.__mro__ if method in base.__dict__)
            if owner is cls or not issubclass(owner, System):  # a class without a System that is mixed in
                setattr(cls, method, owner.__dict__[method])

    coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the generalized coordinates."""
    speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the independent generalized speeds: one equation of motion for each."""
    dependent_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the speeds that the velocity residuals determine: as many as there are residuals."""
    auxiliary_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of speeds that are zero in the motion, for the forces that do no work."""
    dependent_coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the coordinates that `assemble` solves the configuration constraints for; the others are fixed."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the inputs that `loads` reads."""
    states: ClassVar[tuple[str, ...]] = ()
    """Names of states of the first order, which `state_rates` drives: motors that lag, bristles, filters."""
    units: ClassVar[Mapping[Any, str]] = {}
    """Units of coordinates, speeds, inputs, states and outputs by name, for tables and pictures: `{"q0": "rad", "push":
    "N"}`. Those of rates follow from what is declared; nothing is guessed from a name."""
    check_inertia: ClassVar[bool] = True
    """Whether bodies are refused whose principal moments of inertia break the triangle inequality by more than 5 %."""

    def __check_init__(self) -> None:
        _check_names(self)
        check_fields(self)
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
        """Active forces and torques: `Force`s and `Torque`s, nested in tuples as is convenient.

        `inputs` holds the values of the inputs, and of the states of the first order, by name.
        """
        return ()

    def why_not_finite(self, motion: Motion, inputs: Mapping[str, Component]) -> str:
        """Why loads are not finite at a state, in words: asked where they are not, for the error; "" if unknown."""
        return ""

    def state_rates(
        self, t: Component, q: Any, u: Any, x: Any, motion: Motion, now: Any
    ) -> Sequence[Component] | Mapping[str, Component]:
        """Rates of the states of the first order, in the order of `states`; or by name, in a dict.

            states = ("motor_torque",)

            def state_rates(self, t, q, u, x, motion, now):
                return ((now["command"] - x["motor_torque"]) / self.lag,)

        `now` is a `MeasurementContext`: inputs and states by name, and accelerations, for the filter of an
        accelerometer. Of a class without states there are none: `super().state_rates(...)` gives an empty dict.
        """
        if inspect.unwrap(type(self).state_rates) is not System.state_rates or not self.states:
            return {}
        raise NotImplementedError(
            f"{type(self).__name__} has states ({', '.join(self.states)}): define state_rates(self, t, q, u, x, "
            "motion, now), one rate for each."
        )

    def outputs(self, t: Component, q: Any, u: Any, motion: Motion, now: Any) -> Mapping[str, Any]:
        """What the sensors measure, by name: numbers, or dicts of such, whose names are joined by a dot.

            def outputs(self, t, q, u, motion, now):
                box = motion.frames["box"]
                return {"gyro": jk.sensors.gyroscope(box), "strain": self.stiffness * q["bend"]}

        `now` is a `MeasurementContext`: inputs and states by name, accelerations, and the forces of constraints.
        """
        return {}

    def configuration_constraints(self, t: Component, q: Any) -> Sequence[Component]:
        """Residuals that are zero in every possible configuration."""
        return ()

    def implied_constraints(self, t: Component, q: Any) -> Sequence[Component]:
        """Residuals that are zero wherever the configuration constraints are: those of a closed loop that follow from
        the others. Nothing is solved for them; a state that does not meet them is refused."""
        return ()

    def events(self, t: Component, q: Any, u: Any) -> Mapping[str, Any]:
        """Signed, smooth quantities by name; a simulation ends, with that name as its status, when one passes zero.

        `jaxkane.rising` or `jaxkane.falling` of a quantity counts in that direction only. A motion that starts on zero
        ends at once only if it leaves in its named direction.
        """
        return {}


def has_outputs(system: System) -> bool:
    """Whether sensors measure anything; the names of what they measure are known once `outputs` is evaluated."""
    return type(system).outputs is not System.outputs


def names_of(system: System) -> tuple[tuple[str, ...], ...]:
    """Of coordinates, independent and dependent speeds, and states of the first order: what a motion is read by."""
    return tuple(map(tuple, (system.coordinates, system.speeds, system.dependent_speeds, system.states)))


def _check_names(system: System) -> None:
    """Refuse names that stand for two things."""
    name = type(system).__name__
    names = {kind: _checked_names(name, kind, getattr(system, kind)) for kind in NAMES}
    units = _checked_units(name, system.units)
    if "units" in vars(type(system)) and not has_outputs(system):  # inherited units may name what this class lacks
        refuse_unknown(
            units,
            [each for named in names.values() for each in named],
            f"{name}.units names what is no coordinate, speed, input or state:",
        )
    owners: dict[str, str] = {}
    for kind in NAMES:
        for each in names[kind] if kind != "dependent_coordinates" else ():  # these are coordinates
            if each in owners:
                places = f"twice in `{kind}`" if owners[each] == kind else f"in `{owners[each]}` and in `{kind}`"
                raise ValueError(f"{name}: the name {each!r} stands {places}: q, u and trajectories are read by name.")
            owners[each] = kind
    dependent = names["dependent_coordinates"]
    wrong = [each for i, each in enumerate(dependent) if each not in names["coordinates"] or each in dependent[:i]]
    if wrong:
        raise ValueError(
            f"{name}.dependent_coordinates names coordinates, each once: {', '.join(wrong)} is none, or stands there "
            f"twice. The coordinates are: {', '.join(names['coordinates']) or 'none'}."
        )


def unit_of(name: str, declared: Mapping[str, str]) -> str:
    """The declared unit of a name, or "".

    A name with `_rate` or `_dot` behind one that was declared has its unit by the second: "q0_dot" rad/s where "q0" is
    declared in rad.
    """
    base = name.removesuffix("_rate").removesuffix("_dot")
    return declared.get(name) or (_rate_of(declared.get(base, "")) if base != name else "")


def units_of(system: System) -> dict[str, str]:
    """Units by name that a system declares; and of speeds that are the rates of such coordinates."""
    speeds = (*system.speeds, *system.dependent_speeds)
    names = (*system.coordinates, *speeds, *system.auxiliary_speeds, *system.inputs, *system.states)
    units = {name: unit for name, unit in system.units.items() if name in names or has_outputs(system)}
    if type(system).q_dot is System.q_dot:
        for coordinate, speed in zip(system.coordinates, speeds, strict=False):
            if coordinate in units:
                units.setdefault(speed, _rate_of(units[coordinate]))
    return units


def in_degrees(unit: str) -> bool:
    """Whether a unit can be shown in degrees."""
    return unit in ("rad", "rad/s", "rad/s^2")


def refuse_no_angle(names: Iterable[str], units: Iterable[str]) -> None:
    """`ValueError` where degrees are asked for and nothing that is drawn is known to be an angle."""
    names = tuple(names)
    if not any(in_degrees(unit) for unit in units):
        raise ValueError(
            f"degrees=True: none of {', '.join(names)} is declared to be an angle. Say so where they are named, in the "
            f'system: `units = {{{names[0]!r}: "rad"}}`; or here, by `units={{{names[0]!r}: "rad"}}`.'
        )


def _rate_of(unit: str) -> str:
    return f"{unit}/s" if unit else ""
