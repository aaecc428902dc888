"""The text of public objects: numbers by name with units. Batched and traced values print their shapes."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .parameters import Learned, parameter_info

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
