"""The table of the catalogue: an example of every system, so that laws can be run over all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeVar

from .._description.system import System

_Class = TypeVar("_Class", bound=type[System])


@dataclasses.dataclass(frozen=True)
class Entry:
    """One line of `CATALOG`.

    - `book`: its place in Kamman, Volume II, Unit 5. `shows`: what it is an example of.
    - `example`: makes an instance; a function, so that importing the catalogue makes no array.
    - `q`, `u`: a generic state, consistent with the constraints, in the order of `coordinates` and `speeds`; left to
        itself from there, the system moves for at least 10 s without meeting one of its `events`.
    - `operations`: of the traced (q_dot, u_dot), each common one once; counted, with five per cent to spare.
    - `conservative`: whether mechanical energy is constant when no input acts.
    """

    book: str
    shows: str
    example: Callable[[], System]
    q: tuple[float, ...]
    u: tuple[float, ...]
    operations: int
    conservative: bool = True


CATALOG: dict[str, Entry] = {}
"""Every system of the textbook by name, in the textbook's order."""


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
    """Put the class that follows into `CATALOG`, with the arguments of `Entry`; its example is `cls()` by default."""

    def enter(cls: _Class) -> _Class:
        found = {**CATALOG, cls.__name__: Entry(book, shows, example or cls, q, u, operations, conservative)}
        CATALOG.clear()
        CATALOG.update(sorted(found.items(), key=lambda named: named[1].book))
        return cls

    return enter
