"""A mechanism: its parameters, names, motion and loads. Describes; never differentiates or solves."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
from jaxtyping import Array, Float

from .._scalars.types import Component
from .bodies import Motion
from .parameters import check_fields, check_parameter, parameter_info, to_float
from .values import Values


class State(eqx.Module):
    """What is integrated: coordinates and independent speeds.

    Attributes: `q` (n_q,) [rad, m], `u` (n_u,) [rad/s, m/s]; a batch has leading axes. Or dicts by name, which are read
    where the state meets its system: `jk.State({"angle": 0.3}, {"rate": 1.0})`. Names left out are zero.
    """

    q: Float[Array, "*batch n_q"] = eqx.field(converter=to_float)
    u: Float[Array, "*batch n_u"] = eqx.field(converter=to_float)


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
            owner = next(base for base in cls.__mro__ if method in base.__dict__)
            if owner is cls or not issubclass(owner, System):  # a class without a System that is mixed in
                setattr(cls, method, _named(owner.__dict__[method]))

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
    units: ClassVar[Mapping[Any, str]] = {}
    """Units of coordinates, speeds and inputs by name, for pictures: `{"q0": "rad", "push": "N"}`. Those of usual
    names, as "roll", "x" or "steer_torque", are known without."""
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
