"""Residuals by trial and channel, whether they are noise, and how much of a measurement they leave. Knows numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from scipy import stats

from .._problem.problem import Problem

ByTrial = dict[str, dict[str, np.ndarray]]
"""By the names of trial and channel, samples (n_t,)."""

CORRELATED = 0.2
"""Neighbouring residuals that correlate by more are no independent measurements."""


def trial_names(problem: Problem) -> tuple[str, ...]:
    """Names of the trials, numbered where they repeat."""
    names = [trial.name for trial in problem.trials]
    return tuple(n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names))


def by_trial(problem: Problem, simulated: np.ndarray) -> ByTrial:
    """What was simulated (W, n_c, n_t) in windows, put together; NaN where no window is."""
    found = {}
    for k, name in enumerate(trial_names(problem)):
        trial, found[name] = problem.trials[k], {}
        for c, channel in enumerate(problem.channels):
            if channel not in trial.measured:
                continue
            y = np.full(trial.t.shape, np.nan)
            for i, (owner, first, n) in enumerate(problem.places):
                if owner == k:
                    y[first : first + n] = simulated[i, c, :n]
            found[name][channel] = y
    return found


def scaled_residuals(problem: Problem, fitted: ByTrial, deviation: ByTrial | None = None) -> ByTrial:
    """(fitted - measured) / deviation, by default sigma; NaN in gaps."""
    found = {}
    for (name, channels), trial in zip(fitted.items(), problem.trials, strict=True):
        known = trial.sigma if deviation is None else deviation[name]
        found[name] = {channel: (y - trial.measured[channel]) / known[channel] for channel, y in channels.items()}
    return found


def variance_accounted_for(problem: Problem, fitted: ByTrial) -> dict[str, float]:
    """1 - sum (y - fit)^2 / sum (y - mean y)^2 of every channel, over all trials."""
    found = {}
    for channel in problem.channels:
        left = total = 0.0
        for channels, trial in zip(fitted.values(), problem.trials, strict=True):
            if channel in trial.measured:
                y, f = trial.measured[channel], channels[channel]
                left, total = left + np.nansum((f - y) ** 2), total + np.nansum((y - np.nanmean(y)) ** 2)
        found[channel] = float(1 - left / total) if total > 0 else float("nan")
    return found


def autocorrelations(series: Iterable[np.ndarray], n: int) -> np.ndarray:
    """Of the lags 1 to n, over all series (n_t,) together: the mean product of residuals by their mean square. What was
    not measured (NaN) is left out: neighbours are measurements that follow each other."""
    measured = [r[np.isfinite(r)] for r in series]
    square = sum(float(r @ r) for r in measured) / max(sum(r.size for r in measured), 1)

    def of(lag: int) -> float:
        pairs = sum(max(r.size - lag, 0) for r in measured)
        products = sum(float(r[lag:] @ r[:-lag]) for r in measured)
        return products / pairs / square if pairs and square > 0 else 0.0

    return np.array([of(lag) for lag in range(1, n + 1)])


@dataclasses.dataclass(frozen=True)
class ResidualTest:
    """One channel of one trial.

    - `n`: samples; `mean`, `rms`: of the residuals, in their standard deviation `sigma`.
    - `accounted`: the variance accounted for, 1 - sum (y - fit)^2 / sum (y - mean y)^2; below zero is worse than a
        constant.
    - `autocorrelation`: of neighbours. `ljung_box`: the probability that white noise has autocorrelations as large
        (Ljung and Box 1978, ten lags, or a fifth of the samples). `runs`: that it changes sign so seldom or so often
        (Wald and Wolfowitz 1940).
    """

    n: int
    mean: float
    rms: float
    accounted: float
    autocorrelation: float
    ljung_box: float
    runs: float

    @property
    def is_white(self) -> bool:
        """Whether neither test says otherwise at one per cent."""
        return self.ljung_box > 0.01 and self.runs > 0.01


def residual_test(measured: np.ndarray, fitted: np.ndarray, residual: np.ndarray) -> ResidualTest:
    """Tests of one channel (n_t,); NaN is a gap."""
    seen = np.isfinite(residual)
    r, y = residual[seen], measured[seen]
    nothing = float("nan")
    if r.size < 2:
        return ResidualTest(int(r.size), nothing, nothing, nothing, nothing, nothing, nothing)
    spread = float(np.sum((y - y.mean()) ** 2))
    accounted = 1 - float(np.sum((fitted[seen] - y) ** 2)) / spread if spread > 0 else nothing
    lags = autocorrelations([r], max(1, min(10, r.size // 5)))
    # Ljung and Box divide by the number of samples, not by that of the pairs.
    box = (r.size + 2) / r.size * np.sum(lags**2 * (r.size - np.arange(1, lags.size + 1)))
    return ResidualTest(
        n=int(r.size),
        mean=float(r.mean()),
        rms=float(np.sqrt(np.mean(r**2))),
        accounted=accounted,
        autocorrelation=float(lags[0]),
        ljung_box=float(stats.chi2.sf(box, lags.size)),
        runs=_runs(r),
    )


def _runs(r: np.ndarray) -> float:
    """Probability, two-sided, of as few or as many runs of one sign."""
    up = r > 0
    n1, n2 = int(up.sum()), int((~up).sum())
    if min(n1, n2) == 0:
        return 0.0 if r.size > 10 else 1.0
    n, runs = n1 + n2, 1 + int(np.sum(up[1:] != up[:-1]))
    mean = 1 + 2 * n1 * n2 / n
    variance = (mean - 1) * (mean - 2) / (n - 1)
    return float(2 * stats.norm.sf(abs(runs - mean) / np.sqrt(variance))) if variance > 0 else 1.0
