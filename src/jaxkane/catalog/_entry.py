"""The table of the catalogue, and files of parameters of a bicycle."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from .._common.lookup import decimal_number
from .._system.system import System

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
        entries = {**CATALOG, cls.__name__: Entry(book, shows, example or cls, q, u, operations, conservative)}
        CATALOG.clear()
        CATALOG.update(sorted(entries.items(), key=lambda named: named[1].book))
        return cls

    return enter


def lines_of(path: str | os.PathLike[str]) -> list[str]:
    """The lines of a text file; the mark at its beginning that some editors write is none of its text.

    **Raises:** `ValueError` for a file that is no text.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{os.fspath(path)} is no text file in UTF-8.") from None


def read_bicycle_file(
    path: str | os.PathLike[str], known: Sequence[str] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations by name, from a text file of BicycleParameters.

    **Arguments:** `path`; `known`: names to accept, by default all.

    **Raises:** `ValueError` with one line for every entry that is malformed, unknown or repeated.
    """
    values: dict[str, float] = {}
    deviations: dict[str, float] = {}
    lines: dict[str, int] = {}
    faults: list[str] = []
    for number, line in enumerate(lines_of(path), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        name, equals, entry = (part.strip() for part in line.partition("="))
        value, _, deviation = entry.partition("+/-")
        try:
            pair = decimal_number(value.strip()), decimal_number(deviation.strip() or "0")
        except ValueError:
            pair = (math.nan, math.nan)
        if not equals or not name or not pair[1] >= 0:
            faults.append(f"line {number}: {line!r} is not of the form NAME = value+/-deviation")
        elif name in lines:
            faults.append(f"line {number}: {name} was given before, on line {lines[name]}")
        elif known is not None and name not in known:
            faults.append(f"line {number}: {name} is no parameter of this model")
        else:
            lines[name] = number
            values[name], deviations[name] = pair
    if faults:
        raise ValueError(f"{os.fspath(path)}: " + "; ".join(faults) + ".")
    return values, deviations
