"""How names and methods of a system's class are prepared: checked, and reading `q` and `u` by name.

Knows classes and what they are given; knows no mechanism.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax

from .._scalars.types import Component
from .._scalars.versions import kept_from_a_trace
from .motion import Motion, now
from .values import Values

if TYPE_CHECKING:
    from .system import System

METHODS = ("motion", "q_dot", "loads", "configuration_constraints", "implied_constraints", "events")
METHODS += ("state_rates", "outputs")
NAMES = ("coordinates", "speeds", "dependent_speeds", "auxiliary_speeds", "dependent_coordinates", "inputs", "states")


def _prepared(system: str, name: str, value: Any) -> Any:
    """What a class gets under a name: checked, if it holds names or units; reading by name, if it is a method."""
    if hasattr(value, "__get__") and not callable(value):  # a property is read of an instance
        return value
    if name in NAMES:
        return checked_names(system, name, value)
    if name == "units":
        return checked_units(system, value)
    return _named(value, name) if name in METHODS and callable(value) else value


def checked_units(system: str, given: Any) -> Mapping[str, str]:
    if not isinstance(given, Mapping):
        raise TypeError(f'{system}.units is a dict of texts by name, as {{"angle": "rad"}}; got {given!r}.')
    for name, unit in given.items():
        if not (isinstance(name, str) and isinstance(unit, str)):
            raise TypeError(f'{system}.units has texts by name, as {{"angle": "rad"}}; got {name!r}: {unit!r}.')
    return given


def checked_names(system: str, kind: str, given: Any) -> tuple[str, ...]:
    if isinstance(given, str):
        raise TypeError(f"{system}.{kind} is a tuple of names; {given!r} is a string. One name is ({given!r},).")
    if not isinstance(given, (tuple, list)) or not all(isinstance(name, str) and name for name in given):
        raise TypeError(f"{system}.{kind} is a tuple of names, such as ('angle',); got {given!r}.")
    return tuple(given)


class Kind(type(eqx.Module)):
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


_ASKED_FOR_A_VALUE = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,
)


_COUNTS = (
    " A number that a description counts with, as that of its links, is a static field: "
    "`links: int = equinox.field(static=True)`."
)


@contextlib.contextmanager
def naming_what_has_no_value(label: str, more: str = "") -> Iterator[None]:
    """Where a function of the user asks a traced number for its value, the error says which and what to write."""
    try:
        yield
    except _ASKED_FOR_A_VALUE as error:
        raise TypeError(
            f"{label} asks for the value of a number that has none while it is traced: time, coordinates, speeds, "
            "parameters, and what follows from them. Write jnp.sin for np.sin and math.sin (jnp.polyval for "
            "np.polyval), jnp.where(a > b, x, y) for `if`, jnp.maximum and jnp.minimum for max and min, and neither "
            f"float() nor .item().{more}"
        ) from error


def _named(method: Callable[..., Any], name: str) -> Callable[..., Any]:
    """A method of a description, of that name, whose `q`, `u` and `x` may be any sequence, and are read by place and
    by name."""
    # A decorator of such a method copies this attribute, and is another function.
    if getattr(method, "reads_by_name", None) is method:
        return method

    @functools.wraps(method)
    def call(self: System, t: Component, q: Any, *rest: Any, **more: Any) -> Any:
        method = vars(call)["__wrapped__"]  # IPython's autoreload replaces this attribute, and no closure
        q = _values(q, self.coordinates, f"{type(self).__name__}: q")
        if rest:
            names = (*self.speeds, *self.dependent_speeds, *self.auxiliary_speeds)
            rest = (_values(rest[0], names, f"{type(self).__name__}: u", len(self.auxiliary_speeds)), *rest[1:])
        if name == "state_rates" and len(rest) > 1:
            rest = (rest[0], _values(rest[1], self.states, f"{type(self).__name__}: x"), *rest[2:])
        began = now()
        with naming_what_has_no_value(f"{type(self).__name__}.{name}", _COUNTS):
            found = method(self, t, q, *rest, **more)
        if isinstance(found, Motion) and found.made < began:
            raise kept_from_a_trace(type(self).__name__)
        return found

    vars(call)["reads_by_name"] = call
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
