"""The table of the catalogue, and the types of what its systems receive and return."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias, TypeVar

from .._integrate.events import Crossing
from .._scalarjit.components import Component
from .._system.motion import Force, Torque
from .._system.system import System

Values: TypeAlias = Mapping[str, Component]
"""Inputs and first-order states by name."""
Quantity: TypeAlias = Component | Crossing
"""A quantity whose zero is an event."""
Loads: TypeAlias = Force | Torque | Sequence["Loads"]
_Class = TypeVar("_Class", bound=type[System])


@dataclasses.dataclass(frozen=True)
class Entry:
    """One entry of `CATALOG`.

    - `book`: the example or exercise in Kamman, Volume II, Unit 5, or another source with its year.
    - `shows`: the topic of the example.
    - `example`: a function that returns an instance. It is a function, so that importing the catalogue creates no
        array.
    - `q`: generic coordinates that satisfy the constraints, in the order of `coordinates`. Without inputs, a simulation
        from this state lasts at least 10 s. If jumps accumulate, it lasts 3 s (0.04 s for the slider-crank).
    - `u`: generic speeds, in the order of `speeds`.
    - `operations`: an upper limit for the number of operations of the traced (q_dot, u_dot). Common
        subexpressions are counted once. The limit is five per cent above the actual number.
    - `conservative`: whether the mechanical energy is constant without inputs and contacts, between jumps.
    """

    book: str
    shows: str
    example: Callable[[], System]
    q: tuple[float, ...]
    u: tuple[float, ...]
    operations: int
    conservative: bool = True


CATALOG: dict[str, Entry] = {}
"""Every system by name: first those of the textbook in its order, then the others by their source."""


def entry(
    book: str,
    shows: str,
    *,
    q: tuple[float, ...],
    u: tuple[float, ...],
    operations: int,
    example: Callable[[], System] | None = None,
    conservative: bool = True,
) -> Callable[[_Class], _Class]:
    """A decorator that adds a class to `CATALOG`. Arguments as `Entry`; the default example is `cls()`."""

    def enter(cls: _Class) -> _Class:
        entries = {**CATALOG, cls.__name__: Entry(book, shows, example or cls, q, u, operations, conservative)}
        CATALOG.clear()
        CATALOG.update(sorted(entries.items(), key=lambda named: named[1].book))
        return cls

    return enter
