"""Physical parameters: float arrays from birth, in SI units and radians. Knows no mechanics."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._scalarjit.compat import Tracer


def parameter(
    default: Any = dataclasses.MISSING,
    *,
    positive: bool = False,
    within: tuple[float, float] = (-math.inf, math.inf),
    shape: tuple[int, ...] | None = None,
    unit: str = "",
) -> Any:
    """A physical parameter of a `System`: a float array from birth, in SI units and radians.

        mass: Scalar = jk.parameter(positive=True, unit="kg")
        moments: Array = jk.parameter([0.1, 0.2, 0.2], positive=True, unit="kg m^2")

    **Arguments:**

    - `default`: a number, or an array or nested lists of numbers; without one the parameter must be given.
    - `positive`: refuse zero and negative values, and let a fit move it on a logarithmic scale.
    - `within`: lower and upper bound, both allowed: a tilt in degrees, a mass centre below the
        ground are refused. In a batch such a member is `invalid`.
    - `shape`: of the array, by default that of `default`, or `()` for a number. A value with leading axes more is a
        batch.
    - `unit`: as tables and pictures show it; no number is converted.
    """
    if not isinstance(unit, str):
        raise TypeError(f'parameter(unit="N m"): a unit is a text for tables, got {unit!r}.')
    if not isinstance(shape, (tuple, type(None))):
        raise TypeError(f"parameter(shape=(3,)): a shape is a tuple of whole numbers, got {shape!r}.")
    if default is dataclasses.MISSING:
        return eqx.field(converter=to_float, metadata={"jaxkane": ParameterInfo(positive, shape or (), unit, within)})
    # A copy, as NumPy: a list that is changed later must not change the default, and JAX must not start yet.
    default = default if isinstance(default, jax.Array) or np.ndim(default) == 0 else np.array(default)
    metadata = {"jaxkane": ParameterInfo(positive, np.shape(default) if shape is None else shape, unit, within)}
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
        """The callable, with its present arrays."""
        leaves, structure = self.rest
        return eqx.combine(self.arrays, jax.tree.unflatten(structure, leaves))

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.function(*args, **kwargs)

    def __reduce__(self):
        return Learned, (self.function,)  # the structure of a module does not survive pickling, the module does


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What `parameter` declares: whether the value must be positive, the shape of one value, its unit, its bounds."""

    positive: bool
    shape: tuple[int, ...]
    unit: str = ""
    within: tuple[float, float] = (-math.inf, math.inf)

    @property
    def is_limited(self) -> bool:
        """Whether some finite number is refused."""
        return self.positive or self.within != (-math.inf, math.inf)

    def allows(self, x: Any) -> Any:
        """Which numbers of an array are allowed; what is not finite is not."""
        lower, upper = self.within
        conditions = [x > 0] if self.positive else []
        conditions += [x >= lower] if lower > -math.inf else []
        conditions += [x <= upper] if upper < math.inf else []
        return functools.reduce(operator.and_, conditions, abs(x) < math.inf)


ANY = ParameterInfo(False, ())
"""Of a number about which nothing was declared."""


def parameter_info(system: eqx.Module | type[eqx.Module]) -> dict[str, ParameterInfo]:
    """Name and `ParameterInfo` of every parameter of a system, in the order of their declaration."""
    fields = dataclasses.fields(system)  # type: ignore[arg-type]
    return {f.name: f.metadata["jaxkane"] for f in fields if "jaxkane" in f.metadata}


def leaf_name(path: tuple[Any, ...]) -> str:
    """A leaf's name as it is written in Python: "mass", "frame.mass", "links[2].mass"."""
    return jax.tree_util.keystr(path).lstrip(".")


def names_of_leaf(path: tuple[Any, ...]) -> tuple[str, ...]:
    """The names by which a leaf is meant: its own, and those of the parts that hold it."""
    return tuple(leaf_name(path[:n]) for n in range(1, len(path) + 1))


def _steps(part: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ParameterInfo]]:
    """What stands at every step of the path to a leaf, and what was declared of the field that holds it."""
    info = ANY
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            field = getattr(part, "__dataclass_fields__", {}).get(key.name)
            info = field.metadata.get("jaxkane", ANY) if field else ANY
            part = getattr(part, key.name)
        elif isinstance(key, (jax.tree_util.SequenceKey, jax.tree_util.DictKey)):
            part = part[key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key]
        else:
            return
        yield part, info


def declared(system: Any, path: tuple[Any, ...]) -> ParameterInfo:
    """What `parameter` was given of the field that holds this leaf."""
    return [ANY, *(info for _, info in _steps(system, path))][-1]


def learned_part(system: Any, path: tuple[Any, ...]) -> str:
    """The name of the learned function that holds this leaf, or ""."""
    lengths = [n for n, (part, _) in enumerate(_steps(system, path), 1) if isinstance(part, Learned)]
    return leaf_name(path[: lengths[0]]) if lengths else ""


def parameters_in(system: Any) -> list[tuple[str, Any, ParameterInfo]]:
    """Name, value and what was declared of every parameter, those of parts that the system holds too. A parameter that
    is None is not there."""
    leaves = [(path, x, declared(system, path)) for path, x in jax.tree_util.tree_leaves_with_path(system)]
    return [(leaf_name(path), x, info) for path, x, info in leaves if info is not ANY]


def in_batches(system: Any) -> list[str]:
    """Parameters of a system, or of a part of one, that have leading axes more than they were declared with."""
    arrays = [(path, x) for path, x in jax.tree_util.tree_leaves_with_path(system) if np.ndim(x)]
    declarations = [declared(system, path) for path, _ in arrays]
    return [
        leaf_name(path)
        for (path, x), info in zip(arrays, declarations, strict=True)
        if info is not ANY and np.ndim(x) > len(info.shape)
    ]


def with_parameters(system: Any, values: Mapping[str, Any]) -> Any:
    """The system with other values of some parameters, by the names of `parameters_in`; each part is made anew, and
    checked as any other."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(system)] if values else []
    return _replaced(system, {path: values[name] for path in paths if (name := leaf_name(path)) in values})


def _replaced(part: Any, values: Mapping[tuple[Any, ...], Any]) -> Any:
    if not values or () in values:
        return values.get((), part)
    inner: dict[Any, dict[tuple[Any, ...], Any]] = {}
    for (key, *rest), value in values.items():
        inner.setdefault(key, {})[tuple(rest)] = value
    if isinstance(part, eqx.Module):
        return dataclasses.replace(part, **{k.name: _replaced(getattr(part, k.name), v) for k, v in inner.items()})  # type: ignore[arg-type]
    items: Any = dict(part) if isinstance(part, Mapping) else list(part)
    for key, each in inner.items():
        place = key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key
        items[place] = _replaced(items[place], each)
    kind: Any = type(part)
    return kind(items)


def to_float(value: Any) -> Any:
    # What is no number is left alone here: `System.__check_init__` refuses it by its name.
    if isinstance(value, np.ma.MaskedArray):
        if np.ma.is_masked(value):
            raise ValueError("Some values are masked: fill them, or leave these out.")
        value = np.asarray(value)
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


def check_fields(system: eqx.Module) -> None:
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
    if not np.all(info.allows(array)):
        lower, upper = info.within
        hint = " With the other sign?" if np.all(info.allows(-array)) else ""
        if np.abs(array).max() > 2.0 * max(abs(lower), abs(upper)):
            hint = _LIKELY.get(info.unit, "")
        number = f"{array:.6g}" if array.ndim == 0 else f"{array}"
        unit = f" {info.unit}" if info.unit else ""
        raise ValueError(f"{label} = {number}{unit} must lie between {lower:g} and {upper:g}{unit}.{hint}")


_LIKELY = {
    "rad": " In degrees?",
    "m": " In millimetres?",
    "m/s": " In km/h?",
    "kg": " In newtons?",
    "s": " In milliseconds?",
}
"""What a number that is too large for its unit probably is in."""
