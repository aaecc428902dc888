"""Shape aliases. Knows jaxtyping and nothing of mechanics."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

if TYPE_CHECKING:
    Scalar: TypeAlias = Any  # numbers are given, arrays are kept: no checker follows the conversion
else:
    Scalar = Float[Array, ""]
    """A physical parameter: one float array without axes."""

Component: TypeAlias = Any
"""One component of a vector: a float array without axes, or an exact Python float."""

Triple: TypeAlias = tuple[Component, Component, Component]

Inputs: TypeAlias = Mapping[str, Any] | Callable[..., Any] | None
"""Inputs by name; those left out are zero."""


ZERO3: Triple = (0.0, 0.0, 0.0)


def component(value: Component) -> Component:
    """`value` as a component: Python and NumPy numbers become exact floats, arrays stay what they are."""
    if isinstance(value, float):
        return value
    if isinstance(value, (int, np.number)) and not isinstance(value, bool):
        return float(value)
    shape, kind = getattr(value, "shape", None), getattr(getattr(value, "dtype", None), "kind", "")
    if shape != () or kind in tuple("cUSOmM"):
        raise TypeError(f"A component, an angle, a rate or a mass must be one number, got {_described(value, shape)}")
    return jnp.asarray(value) if isinstance(value, np.ndarray) else value


def components(values: Any, n: int, what: str) -> tuple[Component, ...]:
    """`n` numbers in a sequence as components; `what` stands before what is there instead."""
    return tuple(component(x) for x in several(values, n, what))


def several(values: Any, n: int, what: str) -> tuple[Any, ...]:
    """`n` items of a sequence; `what` stands before what is there instead."""
    if isinstance(values, str) or not hasattr(values, "__iter__") or getattr(values, "shape", None) == ():
        raise TypeError(f"{what}, got {values!r}.")
    items = tuple(values)
    if len(items) != n:
        raise ValueError(f"{what}, got {len(items)}.")
    return items


def positive(value: Component, what: str) -> Component:
    """`value`, refused where it is a number that is not positive."""
    if is_exact(component(value)) and not value > 0:
        raise ValueError(f"{what} is {value}: it is positive.")
    return value


def _described(value: Any, shape: Any) -> str:
    if shape:
        return f"an array of shape {shape}: take one entry, as a[0]."
    if isinstance(value, str):
        return f"{value!r}: by name it is q[{value!r}], u[{value!r}] or inputs[{value!r}]."
    return f"{value!r}."


def is_exact(a: Component) -> bool:
    return isinstance(a, float)


def is_zero(a: Component) -> bool:
    return isinstance(a, float) and a == 0.0


def add(a: Component, b: Component) -> Component:
    if is_zero(a):
        return b
    if is_zero(b):
        return a
    return a + b


def sub(a: Component, b: Component) -> Component:
    if is_zero(b):
        return a
    if is_zero(a):
        return -b
    return a - b


def mul(a: Component, b: Component) -> Component:
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float):
            if x == 0.0:
                return 0.0
            if x == 1.0:
                return y
            if x == -1.0:
                return -y
    return a * b


def total(terms: Iterable[Component]) -> Component:
    return functools.reduce(add, terms, 0.0)


def dot(a: Sequence[Component], b: Sequence[Component]) -> Component:
    return total(mul(x, y) for x, y in zip(a, b, strict=True))


def cross(a: Triple, b: Triple) -> Triple:
    (a1, a2, a3), (b1, b2, b3) = a, b
    return (
        sub(mul(a2, b3), mul(a3, b2)),
        sub(mul(a3, b1), mul(a1, b3)),
        sub(mul(a1, b2), mul(a2, b1)),
    )


def add3(a: Triple, b: Triple) -> Triple:
    return (add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


def scale3(s: Component, a: Triple) -> Triple:
    return (mul(s, a[0]), mul(s, a[1]), mul(s, a[2]))


def matvec(matrix: Sequence[Sequence[Component]], a: Sequence[Component]) -> tuple[Component, ...]:
    return tuple(dot(row, a) for row in matrix)
