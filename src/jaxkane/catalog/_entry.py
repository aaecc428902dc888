"""The table of the catalogue, and files with the parameters of a bicycle."""

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


def text_of(path: str | os.PathLike[str]) -> str:
    """The text of a file, without the byte-order mark that some editors write.

    **Raises:** `ValueError` for a file that does not contain UTF-8 text.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{os.fspath(path)} is not a text file in UTF-8. Save it with this encoding.") from None


def read_bicycle_file(
    path: str | os.PathLike[str], known: Sequence[str] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Read values and standard deviations from a text file of BicycleParameters.

    **Arguments:**

    - `path`: path of the file.
    - `known`: names to accept. The default is all names.

    **Returns:** two dicts by name: the values, and their standard deviations (zero if not given).

    **Raises:** `ValueError` that lists every malformed, unknown or repeated entry with its line number.
    """
    values: dict[str, float] = {}
    deviations: dict[str, float] = {}
    lines: dict[str, int] = {}
    faults: list[str] = []
    for number, line in enumerate(text_of(path).splitlines(), start=1):
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
            faults.append(f"line {number}: {name} is not a parameter of this model")
        else:
            lines[name] = number
            values[name], deviations[name] = pair
    if faults:
        raise ValueError(f"{os.fspath(path)}: " + "; ".join(faults) + ".")
    return values, deviations
