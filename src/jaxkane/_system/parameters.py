"""Physical parameters of systems: float arrays in SI units and radians; and the text of public objects, with numbers by
name and units. Batched and traced values print their shapes."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._common.lookup import checked, refuse_if
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Numbers


def parameter(
    default: Numbers = dataclasses.MISSING,
    *,
    positive: bool = False,
    within: tuple[float, float] = (-math.inf, math.inf),
    shape: tuple[int, ...] | None = None,
    unit: str = "",
) -> Any:
    """Declare a physical parameter of a `System`: a float array in SI units and radians.

        mass: Scalar = jk.parameter(positive=True, unit="kg")
        moments: Array = jk.parameter([0.1, 0.2, 0.2], positive=True, unit="kg m^2")

    **Arguments:**

    - `default`: a number, an array or nested lists of numbers. Without a default, the parameter must be given.
    - `positive`: reject zero and negative values. A fit then uses a logarithmic scale.
    - `within`: lower and upper bound, inclusive, to reject implausible values such as angles in degrees. In a batch,
        such a member has the status `invalid`.
    - `shape`: shape of the array. The default is the shape of `default`, or `()`. A value with additional leading axes
        is a batch.
    - `unit`: the unit that tables and plots show. Values are not converted.
    """
    checked(unit, str, 'parameter(unit="N m"): the unit must be a string')
    checked(shape, tuple | None, "parameter(shape=(3,)): the shape must be a tuple of integers")
    if default is dataclasses.MISSING:
        return eqx.field(converter=to_float, metadata={"jaxkane": ParameterInfo(positive, shape or (), unit, within)})
    # Copy to NumPy: later changes of a list must not change the default, and importing must not initialize JAX.
    default = default if isinstance(default, jax.Array) or np.ndim(default) == 0 else np.array(default)
    metadata = {"jaxkane": ParameterInfo(positive, np.shape(default) if shape is None else shape, unit, within)}
    return eqx.field(converter=to_float, metadata=metadata, default_factory=lambda: default)


def learned(default: object = dataclasses.MISSING) -> Any:
    """Declare a function with parameters, such as a small neural network, as a field of a `System`.

        friction: Any = jk.learned(eqx.nn.MLP("scalar", "scalar", 8, 1, jnp.tanh, key=jax.random.key(0)))

    Its arrays are parameters of the system. A fit estimates them by the name of the field, for example
    `Free("friction", prior=(0, 0.3))` with a prior that keeps them small. Everything else, such as the activation
    function, is static.

    **Arguments:**

    - `default`: an equinox module or any other callable pytree. Without a default, the field must be given.
    """
    if default is dataclasses.MISSING:
        return eqx.field(converter=Learned)
    return eqx.field(converter=Learned, default_factory=lambda: default)


class Learned(eqx.Module):
    """A callable pytree whose arrays are leaves and whose other fields are static."""

    arrays: Any
    rest: Any = eqx.field(static=True)

    def __init__(self, function: object):
        if isinstance(function, Learned):
            self.arrays, self.rest = function.arrays, function.rest
            return
        checked(function, Callable, "jk.learned() needs a function with parameters, such as an equinox module")
        arrays, rest = eqx.partition(function, eqx.is_array_like)
        leaves, structure = jax.tree.flatten(rest)  # static fields are compared and hashed, and a tree has no hash
        # It may have been created in float32, before `jk.configure()`.
        floats, others = eqx.partition(
            jax.tree.map(to_float, arrays), lambda x: jnp.isrealobj(x) and eqx.is_inexact_array(x)
        )
        self.arrays = eqx.combine(jax.tree.map(lambda x: x.astype(jnp.result_type(float)), floats), others)
        self.rest = (tuple(leaves), structure)

    @property
    def function(self) -> Any:
        """The callable with its current arrays."""
        leaves, structure = self.rest
        return eqx.combine(self.arrays, jax.tree.unflatten(structure, leaves))

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.function(*args, **kwargs)

    def __repr__(self) -> str:
        function, n = self.function, sum(np.size(x) for x in jax.tree.leaves(self.arrays))
        name = getattr(function, "__name__", type(function).__name__)
        return f"{name} with {n} numbers" if n else name

    def __reduce__(self):
        return Learned, (self.function,)  # pickle the module, because its tree structure cannot be pickled


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """The declaration of a parameter: whether it is positive, its shape, unit and bounds."""

    positive: bool
    shape: tuple[int, ...]
    unit: str = ""
    within: tuple[float, float] = (-math.inf, math.inf)

    @property
    def is_limited(self) -> bool:
        """Whether some finite values are rejected."""
        return self.positive or self.within != (-math.inf, math.inf)

    def allows(self, x: Numbers) -> Numbers:
        """Which values of an array are allowed. Values that are not finite are not allowed."""
        lower, upper = self.within
        conditions = [x > 0] if self.positive else []
        conditions += [x >= lower] if lower > -math.inf else []
        conditions += [x <= upper] if upper < math.inf else []
        return functools.reduce(operator.and_, conditions, abs(x) < math.inf)


ANY = ParameterInfo(False, ())
"""The declaration that is used for a number without a declaration."""


def parameter_info(system: eqx.Module | type[eqx.Module]) -> dict[str, ParameterInfo]:
    """Names and `ParameterInfo` of all parameters of a system, in the order of their declaration."""
    fields = dataclasses.fields(system)  # type: ignore[arg-type]
    return {f.name: f.metadata["jaxkane"] for f in fields if "jaxkane" in f.metadata}


def leaf_name(path: tuple[Any, ...]) -> str:
    """The name of a leaf as in Python: "mass", "frame.mass", "links[2].mass"."""
    return jax.tree_util.keystr(path).lstrip(".")


def names_of_leaf(path: tuple[Any, ...]) -> tuple[str, ...]:
    """The names that select a leaf: its own name and those of the parts that contain it."""
    return tuple(leaf_name(path[:n]) for n in range(1, len(path) + 1))


def _steps(part: PyTree, path: tuple[Any, ...]) -> Iterator[tuple[Any, ParameterInfo]]:
    """The objects along the path to a leaf, and the declaration of the field that contains it."""
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


def declared(system: PyTree, path: tuple[Any, ...]) -> ParameterInfo:
    """The declaration of the field that contains this leaf."""
    return [ANY, *(info for _, info in _steps(system, path))][-1]


def learned_part(system: PyTree, path: tuple[Any, ...]) -> str:
    """The name of the learned function that contains this leaf, or ""."""
    lengths = [n for n, (part, _) in enumerate(_steps(system, path), 1) if isinstance(part, Learned)]
    return leaf_name(path[: lengths[0]]) if lengths else ""


def parameters_in(system: PyTree) -> list[tuple[str, Any, ParameterInfo]]:
    """Name, value and declaration of each parameter, including those of parts. Omits parameters that are None."""
    leaves = [(path, x, declared(system, path)) for path, x in jax.tree_util.tree_leaves_with_path(system)]
    return [(leaf_name(path), x, info) for path, x, info in leaves if info is not ANY]


def in_batches(system: PyTree) -> list[str]:
    """Names of the parameters of a system, or of a part, that have more leading axes than declared."""
    return [
        leaf_name(path)
        for path, x in jax.tree_util.tree_leaves_with_path(system)
        if np.ndim(x) and (info := declared(system, path)) is not ANY and np.ndim(x) > len(info.shape)
    ]


def with_parameters(system: PyTree, values: Mapping[str, Any]) -> Any:
    """The system with other values of some parameters, by the names of `parameters_in`. Every part is constructed and
    checked again."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(system)] if values else []
    return _replaced(system, {path: values[name] for path in paths if (name := leaf_name(path)) in values})


def _replaced(part: PyTree, values: Mapping[tuple[Any, ...], Any]) -> Any:
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


def to_float(value: PyTree) -> Numbers:
    # Keep values that are not numbers. `System.__check_init__` raises an exception with their name.
    if isinstance(value, np.ma.MaskedArray):
        refuse_if(np.ma.is_masked(value), "Some values are masked. Fill or remove them.")
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
    """Raise an exception for fields that JAX would trace, but which are counts, names or switches."""
    for path, value in jax.tree_util.tree_leaves_with_path(system):
        name = path[0].name
        if callable(value):
            raise TypeError(
                f"{type(system).__name__}.{name} is a function, {value!r}, which JAX cannot trace. Declare a function "
                f"with parameters, such as a neural network, as `{name}: Any = jk.learned()`. Declare any other "
                f"function as `{name}: Any = equinox.field(static=True)`."
            )
        if isinstance(value, (bool, int, str)) and name not in parameter_info(system):
            whole = getattr(system, name)
            kind = type(whole).__name__
            raise TypeError(
                f"{type(system).__name__}.{name} = {whole!r} would be traced as an array, so `range(...)` and `if` "
                f"could not use it. Declare a count, a name or a switch as `{name}: {kind} = "
                f"equinox.field(static=True)`, and a physical parameter as `{name}: jk.Scalar = jk.parameter()`."
            )


def check_parameter(label: str, value: object, info: ParameterInfo) -> None:
    """Raise an exception for values that are not finite floats. Batches are judged by the status of their members."""
    if isinstance(value, Tracer):
        return
    if not (isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating)):
        raise TypeError(f"{label} must be a real number or a float array, got {value!r}.")
    n = value.ndim - len(info.shape)
    if n < 0 or value.shape[n:] != info.shape:
        raise ValueError(
            f"{label} must have the shape {info.shape}, with additional leading axes for a batch; got {value.shape}."
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
"""For each unit, the probable mistake if a number is too large."""


_WIDTH = 100  # of a line
_MOST_NUMBERS = 100  # of an array; a larger one prints its shape
_TIE = "\N{NO-BREAK SPACE}"  # lines are not broken between a number and its unit


def concrete_numbers(value: object) -> np.ndarray | None:
    """The numbers of an array, or None for a traced or deleted one, and for other objects."""
    if not isinstance(value, (jax.Array, np.ndarray, np.number, bool, int, float, complex)):
        return None
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError):  # traced; deleted, or on the devices of other processes
        return None


def text_of(value: object, unit: str = "", ndim: int | None = None) -> str:
    """A value as text, such as "0.3 rad" and "[1, 2] kg", with spaces at which `wrapped` does not break a line.

    **Arguments:**

    - `value`: a number, an array, a module, a container of these, or any other object.
    - `unit`: its unit.
    - `ndim`: the declared number of axes. An array with more axes is a batch.
    """
    numbers = concrete_numbers(value)
    if numbers is not None:
        is_batch = ndim is not None and numbers.ndim > ndim
        if is_batch or numbers.size > _MOST_NUMBERS:
            return eqx.tree_pformat(value)
        return _tied(f"{_nested(numbers.tolist())} {unit}".rstrip())
    if isinstance(value, jax.Array):
        return eqx.tree_pformat(value)
    if isinstance(value, Learned) and type(value.function).__repr__ is module_text:
        return _one_line(value.function)
    if isinstance(value, eqx.Module) and type(value).__repr__ in (module_text, eqx.Module.__repr__):
        return _one_line(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {text_of(x)}" for name, x in value.items()) + "}"
    if isinstance(value, (tuple, list)) and type(value) in (tuple, list):
        start, end = "()" if isinstance(value, tuple) else "[]"
        return start + ", ".join(map(text_of, value)) + "," * (isinstance(value, tuple) and len(value) == 1) + end
    return _tied(repr(value).replace("\n", " "))


def module_text(self: Any, ndim: int | None = None) -> str:
    """The `__repr__` of a module: its fields by name, with the units of its parameters. Empty fields are omitted.

    `ndim`: as of `text_of`, for the arrays that are not declared as parameters.
    """
    return wrapped(_one_line(self, ndim))


def wrapped(text: str) -> str:
    """Break a line after commas."""
    lines = textwrap.wrap(text, _WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace(_TIE, " ")


def _one_line(module: eqx.Module, ndim: int | None = None) -> str:
    infos = parameter_info(module)
    items = []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)  # missing while the module is constructed
        is_empty = value is None or (isinstance(value, (tuple, list, dict, str)) and not value)
        if field.repr and not is_empty:
            info = infos.get(field.name)
            text = text_of(value, ndim=ndim) if info is None else text_of(value, info.unit, len(info.shape))
            items.append(f"{field.name}={text}")
    return f"{type(module).__name__}({', '.join(items)})"


def _nested(x: object) -> str:
    if isinstance(x, list):
        return f"[{', '.join(map(_nested, x))}]"
    return f"{x + 0.0:.6g}" if isinstance(x, (float, complex)) else str(x)  # -0.0 + 0.0 is 0.0


def _tied(text: str) -> str:
    return text if len(text) > _WIDTH // 2 else text.replace(" ", _TIE)
