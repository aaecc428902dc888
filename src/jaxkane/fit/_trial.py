"""Trials: measured rides, from arrays or CSV files. Knows numbers and names; knows no system."""

from __future__ import annotations

import csv
import gzip
import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._common.lookup import decimal_number, real_number, refuse_unknown

_FEEDBACK = (
    "A trial holds what was measured. Feedback, as of a controller or a rider, belongs into the system's `loads`, "
    "where it follows the simulated motion, and its gains can be free parameters."
)


class Trial:
    """Measurements of one motion, to be fitted.

        Trial(t, {"roll": roll, "steer": steer}, {"steer_torque": torque}, sigma={"roll": 0.01, "steer": 0.02})

    **Arguments:**

    - `t` (n_t,) [s]: increasing times.
    - `measured`: by channel, samples (n_t,) in the channel's unit; NaN, or masked, where there is a gap. A channel is
        the name of a coordinate, speed, dependent speed or state of the system, or of one of its `outputs`.
    - `inputs`: by name, a number or samples (n_t,) without gaps, taken as linear between the times. Those left out are
        zero. An input is what was measured: feedback (a controller, a rider) belongs into the system's `loads`, where
        it follows the simulated motion and its gains are parameters that can be found.
    - `sigma`: by channel, the standard deviation of the measurement, a positive number or (n_t,): residuals are divided
        by it. One number serves all channels.
    - `initial`: by name, what is known of coordinates, speeds and states: a number that holds wherever a window starts,
        or samples (n_t,) from which every window takes its start. What is neither known nor measured starts at zero, of
        four Euler parameters the last at one, and what the constraints ask of it is found from there as by `assemble`.
        Four Euler parameters of which all are known, measured or unknown are brought to unit norm.
    - `name`: for messages, tables and pictures.

    **Raises:** `ValueError` that names the trial and the channel, for wrong shapes, text, times that do not increase,
    a channel without `sigma`, or a trial without a single finite measurement.
    """

    __slots__ = ("initial", "inputs", "measured", "name", "sigma", "t")

    def __init__(
        self,
        t: Any,
        measured: Mapping[str, Any],
        inputs: Mapping[str, Any] | None = None,
        *,
        sigma: Mapping[str, Any] | float,
        initial: Mapping[str, Any] | None = None,
        name: str = "trial",
    ):
        self.name = str(name)
        self.t = self._times(t)
        if not isinstance(measured, Mapping) or not measured:
            raise ValueError(f"{self.name}: `measured` is a dict of channels, {{'roll': samples, ...}}, and not empty.")
        for group, given in (("inputs", inputs), ("initial", initial)):
            if given is not None and not isinstance(given, Mapping):
                what = f"a function. {_FEEDBACK}" if callable(given) else f"{type(given).__name__}."
                raise ValueError(f"{self.name}: `{group}` is a dict by name, {{'name': samples, ...}}; got {what}")
        self.measured = {key: self._samples("measured", key, value) for key, value in measured.items()}
        self.inputs = {
            key: self._samples("inputs", key, value, number=True, gaps=False) for key, value in (inputs or {}).items()
        }
        self.initial = {
            key: self._samples("initial", key, value, number=True, gaps=False) for key, value in (initial or {}).items()
        }
        self.sigma = self._sigmas(sigma)
        if not any(np.isfinite(x).any() for x in self.measured.values()):
            raise ValueError(
                f"{self.name}: every measurement is NaN ({', '.join(self.measured)}): there is nothing to fit. Leave "
                "this trial out."
            )

    def _times(self, t: Any) -> np.ndarray:
        t = self._numbers("t", t)
        if t.ndim != 1 or t.shape[0] < 2:
            raise ValueError(f"{self.name}: `t` must be at least two times (n_t,), got the shape {t.shape}.")
        if not np.all(np.isfinite(t)):
            raise ValueError(f"{self.name}: t[{int(np.argmin(np.isfinite(t)))}] is not finite.")
        steps = np.diff(t)
        if not np.all(steps > 0):
            i = int(np.argmax(steps <= 0))
            what = "repeated" if steps[i] == 0 else "unsorted"
            raise ValueError(
                f"{self.name}: the times are {what}: t[{i}] = {t[i]:.6g} is followed by {t[i + 1]:.6g}. Sort the "
                "samples, and keep one of each time."
            )
        return t

    def _numbers(self, label: str, value: Any) -> np.ndarray:
        if callable(value):
            raise ValueError(f"{self.name}: {label} is a function, and no samples (n_t,). {_FEEDBACK}")
        try:
            if isinstance(value, np.ma.MaskedArray):  # what is masked was not measured
                value = np.ma.filled(value.astype(float), np.nan) if value.dtype.kind in "iuf" else value.data
            array = np.asarray(value)
            if array.dtype.kind not in "iuf":
                raise ValueError(f"it holds {array.dtype}")
            return array.astype(float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.name}: {label} must be real numbers: {error}.") from None

    def _samples(self, group: str, key: str, value: Any, number: bool = False, gaps: bool = True) -> np.ndarray:
        label = f"{group}[{key!r}]"
        array = self._numbers(label, value)
        if array.ndim == 0 and number:
            array = np.full(self.t.shape, float(array))
        if array.shape != self.t.shape:
            raise ValueError(f"{self.name}: {label} has the shape {array.shape}, `t` has {self.t.shape}.")
        if np.isinf(array).any():
            raise ValueError(f"{self.name}: {label}[{int(np.argmax(np.isinf(array)))}] is infinite.")
        if not gaps and np.isnan(array).any():
            raise ValueError(
                f"{self.name}: {label}[{int(np.argmax(np.isnan(array)))}] is NaN; only measured channels may have "
                "gaps. Fill it, or cut that stretch out with `between`."
            )
        return array

    def _sigmas(self, sigma: Any) -> dict[str, np.ndarray]:
        by_channel = sigma if isinstance(sigma, Mapping) else dict.fromkeys(self.measured, sigma)
        missing = [key for key in self.measured if key not in by_channel]
        if missing:
            raise ValueError(
                f"{self.name}: `sigma` lacks {', '.join(missing)}: give the standard deviation of the measurement."
            )
        sigmas = {key: self._samples("sigma", key, by_channel[key], number=True, gaps=False) for key in self.measured}
        for key, value in sigmas.items():
            if not np.all(value > 0):
                raise ValueError(f"{self.name}: sigma[{key!r}] must be positive.")
        return sigmas

    def between(self, start: float, stop: float) -> Trial:
        """The stretch with start <= t <= stop [s]. A number in `initial` holds at its start too."""
        start, stop = real_number(start, f"{self.name}: `start`"), real_number(stop, f"{self.name}: `stop`")
        inside = (self.t >= start) & (self.t <= stop)
        if inside.sum() < 2:
            raise ValueError(
                f"{self.name}: fewer than two samples between {start:g} and {stop:g} s; it lasts from {self.t[0]:g} to "
                f"{self.t[-1]:g} s."
            )
        cut = lambda group: {key: value[inside] for key, value in group.items()}  # noqa: E731
        return Trial(
            self.t[inside],
            cut(self.measured),
            cut(self.inputs),
            sigma=cut(self.sigma),
            initial=cut(self.initial),
            name=self.name,
        )

    def with_initial_state(self, initial: Mapping[str, Any]) -> Trial:
        """The same, with another `initial`."""
        return Trial(self.t, self.measured, self.inputs, sigma=self.sigma, initial=initial, name=self.name)

    def __repr__(self) -> str:
        span = f"{len(self.t)} times from {self.t[0]:g} to {self.t[-1]:g} s"
        return f"Trial({self.name!r}, {span}: {', '.join(self.measured)})"


def as_trials(trials: Sequence[Trial] | Trial) -> tuple[Trial, ...]:
    """Trials, of which one alone may be given.

    **Raises:** `TypeError` for what are none, `ValueError` where there is none.
    """
    trials = (trials,) if isinstance(trials, Trial) else tuple(trials) if isinstance(trials, Iterable) else (trials,)
    for trial in trials:
        if not isinstance(trial, Trial):
            raise TypeError(f"`trials` holds jaxkane.fit.Trial, got {type(trial).__name__}.")
    if not trials:
        raise ValueError("There is no trial to fit.")
    return trials


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
        samples: dict[str, list[list[float]]] = {}
        for line in lines:
            if not any(cell.strip() for cell in line):
                continue
            if len(line) != len(header):
                raise ValueError(f"{path}, line {lines.line_num}: {len(line)} cells, the header has {len(header)}.")
            key = line[header.index(by)].strip() if by else ""
            numbers = [_number(line[i], path, lines.line_num, c) for i, c in zip(places, columns, strict=True)]
            samples.setdefault(key, []).append(numbers)
    if not samples:
        raise ValueError(f"{path}: there is no line of data.")
    return {key: dict(zip(columns, np.array(rows).T, strict=True)) for key, rows in samples.items()}


def _number(cell: str, path: Path, line: int, column: str) -> float:
    cell = cell.strip()
    if cell.lower().lstrip("+-") in ("", "nan"):
        return float("nan")
    try:
        return decimal_number(cell)
    except ValueError:
        raise ValueError(f"{path}, line {line}, column {column}: {cell!r} is not a finite decimal number.") from None
