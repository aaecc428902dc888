"""Physical parameters: float arrays from birth, in SI units and radians. Knows no mechanics."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

if TYPE_CHECKING:
    from .system import System


def parameter(
    default: Any = dataclasses.MISSING,
    *,
    positive: bool = False,
    shape: tuple[int, ...] | None = None,
    unit: str = "",
) -> Any:
    """A physical parameter of a `System`: a float array from birth, in SI units and radians.

        mass: Scalar = jk.parameter(positive=True, unit="kg")
        moments: Array = jk.parameter([0.1, 0.2, 0.2], positive=True, unit="kg m^2")

    **Arguments:**

    - `default`: a number, or an array or nested lists of numbers; without one the parameter must be given.
    - `positive`: refuse zero and negative values, and let a fit move it on a logarithmic scale.
    - `shape`: of the array, by default that of `default`, or `()` for a number. A value with leading axes more is a
        batch.
    - `unit`: as tables and pictures show it; no number is converted.
    """
    if not isinstance(unit, str):
        raise TypeError(f'parameter(unit="N m"): a unit is a text for tables, got {unit!r}.')
    if default is dataclasses.MISSING:
        return eqx.field(converter=to_float, metadata={"jaxkane": ParameterInfo(positive, shape or (), unit)})
    # A copy, as NumPy: a list that is changed later must not change the default, and JAX must not start yet.
    default = default if isinstance(default, jax.Array) or np.ndim(default) == 0 else np.array(default)
    metadata = {"jaxkane": ParameterInfo(positive, np.shape(default) if shape is None else shape, unit)}
    return eqx.field(converter=to_float, metadata=metadata, default_factory=lambda: default)


def learned(default: Any = dataclasses.MISSING) -> Any:
    """A function of numbers with parameters of its own, a small neural network, as a part of a `System`.

        friction: Any = jk.learned(eqx.nn.MLP("scalar", "scalar", 8, 1, jnp.tanh, key=jax.random.key(0)))

    Its arrays are parameters of the system, which a fit frees by the field's name: `Free("friction", prior=(0, 0.3))`
    with a prior that keeps it small. What is no array in it, such as its activation, belongs to the description.

    **Arguments:** `default`: a module of equinox, or any other pytree that can be called; without one it must be given.
    """
    if default is dataclasses.MISSING:
        return eqx.field(converter=Learned)
    return eqx.field(converter=Learned, default_factory=lambda: default)


def _in_default_precision(x: Any) -> Any:
    x = to_float(x)
    return x.astype(jnp.result_type(float)) if jnp.issubdtype(x.dtype, jnp.floating) else x


class Learned(eqx.Module):
    """A callable pytree: its arrays as leaves, all else static. It is called as what it holds."""

    arrays: Any
    rest: Any = eqx.field(static=True)

    def __init__(self, function: Any):
        if isinstance(function, Learned):
            self.arrays, self.rest = function.arrays, function.rest
            return
        if not callable(function):
            raise TypeError(
                f"jk.learned() holds a function with parameters, such as an equinox module; got {function!r}."
            )
        arrays, rest = eqx.partition(function, eqx.is_array_like)
        leaves, structure = jax.tree.flatten(rest)
        self.arrays = jax.tree.map(_in_default_precision, arrays)  # it may have been made before `jk.configure()`
        self.rest = (tuple(leaves), structure)

    @property
    def function(self) -> Any:
        """What was given, with the arrays of now."""
        leaves, structure = self.rest
        return eqx.combine(self.arrays, jax.tree.unflatten(structure, leaves))

    def __call__(self, *args: Any, **more: Any) -> Any:
        return self.function(*args, **more)

    def __reduce__(self):
        return Learned, (self.function,)  # the structure of a module does not survive pickling, the module does


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What `parameter` was given: whether the value must be positive, the shape of one value, and its unit."""

    positive: bool
    shape: tuple[int, ...]
    unit: str = ""


def parameter_info(system: System | type[System]) -> dict[str, ParameterInfo]:
    """Name and `ParameterInfo` of every parameter of a system, in the order of their declaration."""
    fields = dataclasses.fields(system)  # type: ignore[arg-type]
    return {f.name: f.metadata["jaxkane"] for f in fields if "jaxkane" in f.metadata}


def parameters_in(part: Any, prefix: str = "") -> Iterator[tuple[str, Any, ParameterInfo]]:
    """Name, value and what was declared of every parameter, those of parts that the system holds too: "mass",
    "frame.mass", "links[2].mass". A parameter that is None is not there."""
    for field in dataclasses.fields(part):
        value, info = getattr(part, field.name), field.metadata.get("jaxkane")
        if value is None:
            continue
        if info is not None:
            yield prefix + field.name, value, info
        elif isinstance(value, (list, tuple)):
            for i, each in enumerate(value):
                if isinstance(each, eqx.Module):
                    yield from parameters_in(each, f"{prefix}{field.name}[{i}].")
        elif isinstance(value, eqx.Module):
            yield from parameters_in(value, f"{prefix}{field.name}.")


def in_batches(system: Any) -> list[str]:
    """Parameters of a system, or of a part of one, that have leading axes more than they were declared with."""
    return [name for name, value, info in parameters_in(system) if np.ndim(value) > len(info.shape)]


def with_parameters(system: Any, values: Mapping[str, Any]) -> Any:
    """The system with other values of some parameters, by the names of `parameters_in`; each part is made anew, and
    checked as any other."""
    if not values:
        return system
    fields = {field.name for field in dataclasses.fields(system)}
    own: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        field, _, rest = name.partition(".")
        if name in fields or not rest:  # the names of a mechanism's own parameters have dots too: "mass.forearm"
            own[name] = value
        else:
            inner.setdefault(field, {})[rest] = value
    for field, its in inner.items():
        name, _, place = field.partition("[")
        held = own.get(name, getattr(system, name))
        if not place:
            own[name] = with_parameters(held, its)
            continue
        parts = list(held)
        parts[int(place[:-1])] = with_parameters(parts[int(place[:-1])], its)
        own[name] = type(held)(parts)
    return dataclasses.replace(system, **own)


def to_float(value: Any) -> Any:
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


def check_fields(system: System) -> None:
    """Refuse numbers that a description counts with, names and switches as fields that JAX would trace."""
    for path, value in jax.tree_util.tree_leaves_with_path(system):
        name = path[0].name
        if callable(value):
            raise TypeError(
                f"{type(system).__name__}.{name} holds a function, {value!r}, which JAX cannot trace. A function with "
                f"parameters, as a neural network, is declared by `{name}: Any = jk.learned()`; one without, by "
                f"`{name}: Any = equinox.field(static=True)`."
            )
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


def leaf_name(path: tuple[Any, ...]) -> str:
    """A leaf's name as it is written in Python: "mass", "frame.mass", "links[2].mass"."""
    return jax.tree_util.keystr(path).lstrip(".")


def learned_part(system: Any, path: tuple[Any, ...]) -> str:
    """The name of the learned function that holds this leaf, or ""."""
    for i, key in enumerate(path):
        if isinstance(key, jax.tree_util.GetAttrKey):
            system = getattr(system, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            system = system[key.idx]
        else:
            system = system[key.key] if isinstance(key, jax.tree_util.DictKey) else None
        if isinstance(system, Learned):
            return leaf_name(path[: i + 1])
    return ""


def declared(system: Any, path: tuple[Any, ...]) -> ParameterInfo:
    """What `parameter` was given of the field that holds this leaf."""
    found = _UNDECLARED
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            field = {f.name: f for f in dataclasses.fields(system)}.get(key.name)
            found = field.metadata.get("jaxkane", _UNDECLARED) if field else _UNDECLARED
            system = getattr(system, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            system = system[key.idx]
        elif isinstance(key, jax.tree_util.DictKey):
            system = system[key.key]
    return found


_UNDECLARED = ParameterInfo(False, ())
