"""Checks of records: wrong signs, degrees, stale, limited, constant or repeated samples. They do not need a fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .trial import Trial, as_trials

DEGREE = 180.0 / np.pi
FEWEST = 20  # the minimum number of samples for a conclusion


def check_records(trials: Sequence[Trial] | Trial) -> tuple[str, ...]:
    """Check trials for suspicious records. A fit reports the results in its `notes`.

    The function detects:

    - gaps between samples of inputs,
    - stale and limited samples,
    - channels that are difference quotients of other channels,
    - rates (`x_rate`, `x_dot`) with the wrong sign or in degrees,
    - constant channels,
    - inputs that are zero in a few trials,
    - trials with the samples of another trial.

    **Arguments:**

    - `trials`: one `Trial` or several.

    **Returns:** a tuple with one sentence per suspicion, which names the trials.
    """
    trials, by_note = as_trials(trials), {}
    for trial in trials:
        notes = (*_gaps(trial), *_stale_or_limited(trial), *_difference_quotients(trial), *_rates(trial))
        for note in (*notes, *_constant(trial)):
            by_note.setdefault(note, []).append(trial.name)
    for name in dict.fromkeys(name for trial in trials for name in trial.inputs):
        zero = [trial.name for trial in trials if name in trial.inputs and not np.any(trial.inputs[name])]
        # If many trials have a zero input, this is intended. In a few trials, it is a fault of the record.
        if 0 < len(zero) <= len(trials) / 4:
            by_note[f"the input {name} is always zero, but not in other trials. Check the record."] = zero
    notes = [f"{', '.join(n[:3])}{f' and {len(n) - 3} more' if len(n) > 3 else ''}: {x}" for x, n in by_note.items()]
    return (*notes, *_duplicates(trials))


def _constant(trial: Trial) -> Iterator[str]:
    for channel, y in trial.measured.items():
        y = y[np.isfinite(y)]
        if y.size > 1 and np.ptp(y) == 0:
            yield f"{channel} has the constant value {y[0]:g}. Check whether it was recorded."


def _duplicates(trials: Sequence[Trial]) -> Iterator[str]:
    first: dict[bytes, str] = {}
    for trial in trials:
        key = b"".join([trial.t.tobytes(), *(c.encode() + y.tobytes() for c, y in sorted(trial.measured.items()))])
        if key in first:
            yield f"{trial.name} has the same samples as {first[key]}, so these are counted twice. Omit one trial."
        first.setdefault(key, trial.name)


def _gaps(trial: Trial) -> Iterator[str]:
    steps = np.diff(trial.t)
    varying = [name for name, x in trial.inputs.items() if np.ptp(x) > 0]
    if varying and len(steps) >= FEWEST and steps.max() > 5 * np.median(steps):
        yield (
            "the times have a gap that is several times longer than a sample interval. The inputs "
            f"({', '.join(varying)}) are treated as linear there. Cut the trial in two with `between`."
        )


def _stale_or_limited(trial: Trial) -> Iterator[str]:
    for kind, group in (("", trial.measured), ("the input ", trial.inputs)):
        for name, y in group.items():
            y = y[np.isfinite(y)]
            if y.size < FEWEST or np.ptp(y) == 0:
                continue
            if _is_stale(y):
                yield (
                    f"{kind}{name} repeats its last value many times while it changes: the instrument is slower than "
                    "the times. Keep the samples at which it changes, and write NaN elsewhere."
                )
            elif limit := _limit(y):
                yield (
                    f"{kind}{name} has its {limit} value in many successive samples. Check whether the instrument "
                    "limits its range: values beyond the limit are not recorded."
                )


def _is_stale(y: np.ndarray) -> bool:
    """Whether samples are repeated and a coarse resolution does not explain it."""
    moves = np.abs(np.diff(y))
    changes = moves[moves > 0]
    if changes.size > 0.75 * moves.size or changes.size < 10 or np.median(changes) <= 5 * changes.min():
        return False
    # Stale samples are repeated in many short runs. A system at rest gives one long run.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (moves == 0).astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return bool(len(runs) >= 10 and runs.max() < 0.2 * moves.size)


def _limit(y: np.ndarray) -> str:
    """The extreme value ("largest" or "smallest") that a record repeats in several runs; "" for none."""
    levels = len(np.unique(y))
    for word, extreme in (("largest", y.max()), ("smallest", y.min())):
        rests = y == extreme
        # Switched signals have few levels, so they are excluded. So is a single run, which is a system at rest.
        inside = rests[1:-1] & rests[:-2] & rests[2:]
        starts = np.count_nonzero(np.diff(rests.astype(int)) == 1)
        if inside.sum() > 0.05 * y.size and starts >= 2 and levels > 0.2 * y.size and extreme != 0:
            return word
    return ""


def _difference_quotients(trial: Trial) -> Iterator[str]:
    """Detect channels that are difference quotients of other channels."""
    names = list(trial.measured)
    for a in names:
        quotient = np.diff(trial.measured[a]) / np.diff(trial.t)
        if np.isfinite(quotient).sum() < FEWEST or not np.nanmax(np.abs(quotient)) > 0:
            continue
        central = np.gradient(trial.measured[a], trial.t)
        for b in (name for name in names if name != a):
            y = trial.measured[b]
            for difference in (y[1:] - quotient, y[:-1] - quotient, y[1:-1] - central[1:-1]):
                size = np.abs(difference[np.isfinite(difference)])
                if size.size >= FEWEST and np.max(size) < 1e-6 * np.nanmax(np.abs(quotient)):
                    yield (
                        f"{b} is the difference quotient of {a}: it was computed, not measured, and contains no new "
                        "information. Omit it."
                    )
                    break


def _rates(trial: Trial) -> Iterator[str]:
    """Compare a measured rate with the change of its measured coordinate: sign and unit (degrees)."""
    for coordinate in trial.measured:
        rates = [c for c in (f"{coordinate}_rate", f"{coordinate}_dot") if c in trial.measured]
        if not rates:
            continue
        change, rate = np.gradient(trial.measured[coordinate], trial.t), trial.measured[rates[0]]
        finite = np.isfinite(change) & np.isfinite(rate)
        change, rate = change[finite], rate[finite]
        if change.size < 5 or np.ptp(change) == 0 or np.ptp(rate) == 0:
            continue
        correlation = float(np.corrcoef(change, rate)[0, 1])
        if correlation < -0.5:
            yield f"{rates[0]} and the change of {coordinate} have opposite signs: one of them has the wrong sign."
        ratio = float(np.std(rate) / np.std(change))
        if abs(correlation) > 0.8 and change.size >= FEWEST:
            for factor, which in ((DEGREE, rates[0]), (1 / DEGREE, coordinate)):
                if 0.7 < ratio / factor < 1.4:
                    other = coordinate if which == rates[0] else rates[0]
                    yield f"{which} seems to be in degrees: it is about 57 times larger than expected from {other}."
