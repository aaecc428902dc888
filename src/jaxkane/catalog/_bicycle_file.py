"""Text files of the package BicycleParameters: `NAME = value+/-deviation`, one a line."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

from .._common.real_numbers import decimal_number


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
