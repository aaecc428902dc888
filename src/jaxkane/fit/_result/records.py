"""Checks of records that need no model: stale samples, limits, degrees, differences of each other, gaps.

Knows samples and names; knows no system's equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .._data.trial import Trial
from .._problem.problem import Problem

DEGREE = 180.0 / np.pi
FEWEST = 20  # samples from which anything is concluded


def suspicious_records(problem: Problem) -> list[str]:
    """In words, each kind of suspicion once for all trials that share it."""
    found: dict[str, list[str]] = {}
    for trial in problem.trials:
        for what in (
            *_gaps(trial),
            *_of_channels(trial),
            *_of_pairs(trial),
            *_rates(trial, problem.system.coordinates),
        ):
            found.setdefault(what, []).append(trial.name)
    return [f"{_listed(trials)}: {what}" for what, trials in found.items()]


def _listed(trials: list[str]) -> str:
    more = len(trials) - 3
    return ", ".join(trials[:3]) + (f" and {more} more" if more > 0 else "")


def _gaps(trial: Trial) -> Iterator[str]:
    steps = np.diff(trial.t)
    varying = [name for name, x in trial.inputs.items() if np.ptp(x) > 0]
    if varying and len(steps) >= FEWEST and steps.max() > 5 * np.median(steps):
        yield (
            "the times leave out a stretch, several times as long as the others, in which the inputs "
            f"({', '.join(varying)}) are taken as linear. Cut the trial in two with `between`."
        )


def _of_channels(trial: Trial) -> Iterator[str]:
    for kind, group in (("", trial.measured), ("the input ", trial.inputs)):
        for name, y in group.items():
            y = y[np.isfinite(y)]
            if y.size < FEWEST or np.ptp(y) == 0:
                continue
            if _is_stale(y):
                yield (
                    f"{kind}{name} repeats its last value again and again while it moves: stale samples, of an "
                    "instrument that is slower than the times say. Keep those at which it changes, NaN elsewhere."
                )
            elif limit := _limit(y):
                yield (
                    f"{kind}{name} rests at its {limit} value for many samples: was it limited there? What lies beyond "
                    "is not recorded."
                )


def _is_stale(y: np.ndarray) -> bool:
    """Whether samples repeat each other, where a coarse resolution does not explain it."""
    moves = np.abs(np.diff(y))
    changes = moves[moves > 0]
    repeats = 1.0 - changes.size / moves.size
    resolution = changes.min()
    return bool(
        repeats > 0.25 and changes.size >= 10 and np.median(changes) > 5 * resolution and _short_runs(moves == 0)
    )


def _short_runs(equal: np.ndarray) -> bool:
    """Whether what repeats does so in many short runs, and not in one long rest."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], equal.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return bool(len(runs) >= 10 and runs.max() < 0.2 * len(equal))


def _limit(y: np.ndarray) -> str:
    """Which extreme value a record rests at, in runs; "" for none."""
    levels = len(np.unique(y))
    for word, extreme in (("largest", y.max()), ("smallest", y.min())):
        rests = y == extreme
        # Switched signals have few levels; what rests for once, at the beginning or the end, is at rest.
        inside = rests[1:-1] & rests[:-2] & rests[2:]
        starts = np.count_nonzero(np.diff(rests.astype(int)) == 1)
        if inside.sum() > 0.05 * y.size and starts >= 2 and levels > 0.2 * y.size and extreme != 0:
            return word
    return ""


def _of_pairs(trial: Trial) -> Iterator[str]:
    """Channels that are differences of each other."""
    names = list(trial.measured)
    for a in names:
        quotient = np.diff(trial.measured[a]) / np.diff(trial.t)
        if np.isfinite(quotient).sum() < FEWEST or not np.nanmax(np.abs(quotient)) > 0:
            continue
        central = np.gradient(trial.measured[a], trial.t)
        for b in (name for name in names if name != a):
            y = trial.measured[b]
            for same in (y[1:] - quotient, y[:-1] - quotient, y[1:-1] - central[1:-1]):
                seen = same[np.isfinite(same)]
                if seen.size >= FEWEST and np.max(np.abs(seen)) < 1e-6 * np.nanmax(np.abs(quotient)):
                    yield (
                        f"{b} is the difference quotient of {a}: it was computed, not measured, and says nothing new. "
                        "Leave it out."
                    )
                    break


def _rates(trial: Trial, coordinates: Sequence[str]) -> Iterator[str]:
    """A measured rate beside the change of its measured coordinate: signs and degrees."""
    for coordinate in coordinates:
        rates = [c for c in (f"{coordinate}_rate", f"{coordinate}_dot") if c in trial.measured]
        if coordinate not in trial.measured or not rates:
            continue
        change, rate = np.gradient(trial.measured[coordinate], trial.t), trial.measured[rates[0]]
        seen = np.isfinite(change) & np.isfinite(rate)
        if seen.sum() < 5 or np.ptp(change[seen]) == 0 or np.ptp(rate[seen]) == 0:
            continue
        agreement = float(np.corrcoef(change[seen], rate[seen])[0, 1])
        if agreement < -0.5:
            yield f"{rates[0]} runs against the change of {coordinate}: one of the two has the wrong sign."
        ratio = float(np.std(rate[seen]) / np.std(change[seen]))
        if abs(agreement) > 0.8 and seen.sum() >= FEWEST:
            for factor, which in ((DEGREE, rates[0]), (1 / DEGREE, coordinate)):
                if 0.7 < ratio / factor < 1.4:
                    other = coordinate if which == rates[0] else rates[0]
                    yield f"{which} seems to be in degrees: it is about 57 times as large as {other} lets expect."
