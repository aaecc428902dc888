"""Coordinates and speeds as a description receives them: by place and by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._common.lookup import not_there
from .._scalars.types import Component


class Values(Sequence[Component]):
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
        try:
            array = jnp.asarray(other)
        except (TypeError, ValueError):
            raise TypeError(
                f"Values are numbers, and meet numbers and arrays alone; got {other!r}. One of them is q['name']."
            ) from None
        return getattr(self.__jax_array__(), name)(array)

    return operator


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"):
    setattr(Values, f"__{_name}__", _elementwise(f"__{_name}__"))
    setattr(Values, f"__r{_name}__", _elementwise(f"__r{_name}__"))
for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    setattr(Values, f"__{_name}__", _elementwise(f"__{_name}__"))
