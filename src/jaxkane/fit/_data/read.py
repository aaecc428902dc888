"""Trials from a CSV file by a map of its columns. Knows files; knows no system."""

from __future__ import annotations

import csv
import gzip
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..._common.lookup import refuse_unknown
from ..._common.real_numbers import decimal_number
from .trial import Trial


def read_trials(
    path: str | os.PathLike[str],
    measured: Mapping[str, str],
    *,
    sigma: Mapping[str, Any] | float,
    inputs: Mapping[str, str] | None = None,
    initial: Mapping[str, str] | None = None,
    t: str = "t",
    by: str | None = None,
) -> list[Trial]:
    """Trials out of a CSV file with a header line.

        read_trials("rides.csv", {"roll": "roll_angle"}, sigma=0.01, inputs={"steer_torque": "torque"}, by="segment")

    **Arguments:**

    - `measured`, `inputs`, `initial`: the column of every channel, input and known start (see `Trial`).
    - `t`: the column of the times [s]. `by`: the column that names the trial of each row; without it the file is one
        trial.
    - `sigma`: as `Trial` takes it.

    Numbers are decimal (-1.5e-3); an empty cell, or one that says NaN, is a gap. The file is UTF-8, with or without a
    byte-order mark; compressed by gzip where its name ends in `.gz`.

    **Returns:** trials in the order of the file, named after the file and the value of `by`.

    **Raises:** `ValueError` that names file, line and column for a column that is missing or there twice, a short line,
    text in a number, another encoding, or a damaged file.
    """
    path = Path(path)
    groups = [dict(measured), dict(inputs or {}), dict(initial or {})]
    columns = list(dict.fromkeys([t, *(column for group in groups for column in group.values())]))
    rows = _read(path, columns, by)
    trials = []
    for key, table in rows.items():
        stem = path.name.partition(".")[0]
        name = stem if by is None else f"{stem}, {by} {key}"
        chosen = [{name: table[column] for name, column in group.items()} for group in groups]
        trials.append(Trial(table[t], chosen[0], chosen[1], sigma=sigma, initial=chosen[2], name=name))
    return trials


def _read(path: Path, columns: list[str], by: str | None) -> dict[str, dict[str, np.ndarray]]:
    """For every trial its columns (n_t,)."""
    try:
        return _tables(path, columns, by)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is no CSV file in UTF-8: {error}.") from None
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path} is damaged, or was not compressed by gzip: {error}.") from None


def _tables(path: Path, columns: list[str], by: str | None) -> dict[str, dict[str, np.ndarray]]:
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", newline="", encoding="utf-8-sig") as file:  # with or without a byte-order mark
        lines = csv.reader(file)
        header = [cell.strip() for cell in next(lines, [])]
        needed = (*columns, *([by] if by else []))
        refuse_unknown(needed, header, f"{path}: no column")
        twice = sorted({column for column in needed if header.count(column) > 1})
        if twice:
            raise ValueError(f"{path}: more than one column is called {', '.join(twice)}: which is meant? Rename one.")
        places = [header.index(c) for c in columns]
        found: dict[str, list[list[float]]] = {}
        for line in lines:
            if not any(cell.strip() for cell in line):
                continue
            if len(line) != len(header):
                raise ValueError(f"{path}, line {lines.line_num}: {len(line)} cells, the header has {len(header)}.")
            key = line[header.index(by)].strip() if by else ""
            numbers = [_number(line[i], path, lines.line_num, c) for i, c in zip(places, columns, strict=True)]
            found.setdefault(key, []).append(numbers)
    if not found:
        raise ValueError(f"{path}: there is no line of data.")
    return {key: dict(zip(columns, np.array(rows).T, strict=True)) for key, rows in found.items()}


def _number(cell: str, path: Path, line: int, column: str) -> float:
    cell = cell.strip()
    if cell.lower().lstrip("+-") in ("", "nan"):
        return float("nan")
    try:
        return decimal_number(cell)
    except ValueError:
        raise ValueError(f"{path}, line {line}, column {column}: {cell!r} is not a finite decimal number.") from None
