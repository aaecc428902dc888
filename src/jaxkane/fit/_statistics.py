"""Tests of a fit: of its residuals, of parameters beside zero (F, t and score test), and information criteria."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from scipy import stats

from .._common.lookup import real_number
from .._scalarjit.compat import on_device
from ._block_lsq import Blocks, eliminate
from ._covariance import enough_clusters, formal_covariance, jackknife_covariance
from ._linearize import Linearization
from ._model import Unknowns
from ._problem import Problem

ByTrial = dict[str, dict[str, np.ndarray]]
"""By the names of trial and channel, samples (n_t,)."""

CORRELATED = 0.2
"""Neighbouring residuals that correlate by more are no independent measurements."""


def check_level(level: float) -> None:
    """**Raises:** `ValueError` for what is no probability between 0 and 1."""
    if not 0 < real_number(level, "`level`") < 1:
        raise ValueError(f"`level` is a probability between 0 and 1, such as 0.95 or 0.05; got {level}.")


def t_quantile(level: float, degrees_of_freedom: float) -> float:
    """Two-sided, of Student's distribution; NaN without a degree of freedom."""
    check_level(level)
    return float(stats.t.ppf(0.5 * (1 + level), degrees_of_freedom)) if degrees_of_freedom > 0 else float("nan")


def trial_names(problem: Problem) -> tuple[str, ...]:
    """Names of the trials, numbered where they repeat."""
    names = [trial.name for trial in problem.trials]
    return tuple(n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names))


def by_trial(problem: Problem, simulated: np.ndarray) -> ByTrial:
    """Simulated measurements of windows (W, n_c, n_t), joined by trial and channel; NaN where no window is."""
    joined = [
        {channel: np.full(trial.t.shape, np.nan) for channel in problem.channels if channel in trial.measured}
        for trial in problem.trials
    ]
    for y, (owner, first, n) in zip(simulated, problem.slices, strict=True):
        for channel, series in joined[owner].items():
            series[first : first + n] = y[problem.channels.index(channel), :n]
    for series in (series for channels in joined for series in channels.values()):
        series.flags.writeable = False  # what follows from it is kept
    return dict(zip(trial_names(problem), joined, strict=True))


def variance_accounted_for(measured: Sequence[np.ndarray], fitted: Sequence[np.ndarray]) -> float:
    """1 - sum (y - fit)^2 / sum (y - mean y)^2, the mean of each series by itself; NaN of what does not vary."""
    left = sum(np.nansum((f - y) ** 2) for y, f in zip(measured, fitted, strict=True))
    total = sum(np.nansum((y - np.nanmean(y)) ** 2) for y in measured)
    return float(1 - left / total) if total > 0 else float("nan")


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
    - `variance_accounted_for`: 1 - sum (y - fit)^2 / sum (y - mean y)^2; below zero is worse than a constant.
    - `autocorrelation`: of neighbours. `ljung_box`: the probability that white noise has autocorrelations as large
        (Ljung and Box 1978, ten lags, or a fifth of the samples). `runs`: that it changes sign so seldom or so often
        (Wald and Wolfowitz 1940).
    """

    n: int
    mean: float
    rms: float
    variance_accounted_for: float
    autocorrelation: float
    ljung_box: float
    runs: float

    @property
    def is_white(self) -> bool:
        """Whether neither test says otherwise at one per cent."""
        return self.ljung_box > 0.01 and self.runs > 0.01


def residual_test(measured: np.ndarray, fitted: np.ndarray, residual: np.ndarray) -> ResidualTest:
    """Tests of one channel (n_t,); NaN is a gap."""
    finite = np.isfinite(residual)
    r = residual[finite]
    if r.size < 2:
        return ResidualTest(int(r.size), *[float("nan")] * 6)
    lags = autocorrelations([r], max(1, min(10, r.size // 5)))
    # Ljung and Box divide by the number of samples, not by that of the pairs.
    box = (r.size + 2) / r.size * np.sum(lags**2 * (r.size - np.arange(1, lags.size + 1)))
    return ResidualTest(
        n=int(r.size),
        mean=float(r.mean()),
        rms=float(np.sqrt(np.mean(r**2))),
        variance_accounted_for=variance_accounted_for([measured[finite]], [fitted[finite]]),
        autocorrelation=float(lags[0]),
        ljung_box=float(stats.chi2.sf(box, lags.size)),
        runs=runs_test(r),
    )


def runs_test(r: np.ndarray) -> float:
    """Probability, two-sided, of as few or as many runs of one sign (Wald and Wolfowitz 1940)."""
    up = r > 0
    n1, n2 = int(up.sum()), int((~up).sum())
    if min(n1, n2) == 0:
        return 0.0 if r.size > 10 else 1.0
    n, runs = n1 + n2, 1 + int(np.sum(up[1:] != up[:-1]))
    mean = 1 + 2 * n1 * n2 / n
    variance = (mean - 1) * (mean - 2) / (n - 1)
    return float(2 * stats.norm.sf(abs(runs - mean) / np.sqrt(variance))) if variance > 0 else 1.0


def effective_sample_fraction(correlation: float) -> float:
    """(1 - c) / (1 + c), as in an autoregression: as how much of an independent residual one counts whose neighbours
    correlate by c."""
    c = correlation if correlation > CORRELATED else 0.0
    return (1 - c) / (1 + c)


def f_test(drop: float, k: int, cost: float, degrees_of_freedom: float, correlation: float) -> float:
    """The probability that k parameters which are zero lower a sum of squares by `drop` to `cost` (Fisher's F)."""
    if degrees_of_freedom <= 0 or k == 0 or not drop > 0:
        return 1.0
    share = effective_sample_fraction(correlation)
    ratio = share * drop / k / max(cost / degrees_of_freedom, 1e-300)
    return float(stats.f.sf(ratio, k, max(share * degrees_of_freedom, 1.0)))


def wald_test(step: np.ndarray, covariance: np.ndarray, trials: int) -> float:
    """The probability that one of some parameters (q,) which are all zero is estimated as far from it, with a
    covariance from so many trials: Student's t of each, and Bonferroni's bound over them.

    Hotelling's test of all of them together rejects too often, up to 12 % at 5 %, where few trials tell most.
    """
    p = 2 * stats.t.sf(np.abs(step) / np.sqrt(np.diagonal(covariance)), trials - 1)
    return float(min(1.0, len(step) * p.min()))


def bic_change(before: float, after: float, more: int, n: int, correlation: float) -> float:
    """By how much a model with `more` unknowns changes the Bayesian information criterion (Schwarz 1978) of n residuals
    of unknown variance, nested or not: below zero it is the better one."""
    n_effective = max(effective_sample_fraction(correlation) * n, 1.0)
    return float(n_effective * np.log(max(after, 1e-300) / max(before, 1e-300)) + more * np.log(n_effective))


def folds_of(folds: int | Sequence[Sequence[int]] | None, T: int) -> list[list[int]]:
    """Which trials are left out together. None: each trial alone, and five folds from eleven trials on."""
    if folds is None:
        folds = T if T <= 10 else 5
    if isinstance(folds, int):
        if not 2 <= folds <= T:
            raise ValueError(f"`folds`: {T} trials can be left out in 2 to {T} parts, not in {folds}.")
        return [list(range(k, T, folds)) for k in range(folds)]
    groups = [[int(k) for k in group] for group in folds]
    if sorted(k for group in groups for k in group) != list(range(T)) or not all(groups) or len(groups) < 2:
        raise ValueError(f"`folds` must leave out each of the trials 0 to {T - 1} once, in two groups at least.")
    return groups


@dataclasses.dataclass(frozen=True)
class LinearizedProblem:
    """Least squares in x, in rows by trial: residuals A_t x + r_t, and priors of which each belongs to one x.

    - `data` (T, m, n + 1): A_t beside r_t. `priors` (n, n + 1): of each x its own.
    - `norms` (n,): of the columns, before other unknowns were eliminated from them.
    """

    data: np.ndarray
    priors: np.ndarray
    norms: np.ndarray

    def of(self, places: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (M, k) and residuals (M,) where only these may move, with their priors."""
        places = list(places)
        rows = np.concatenate([self.data.reshape(-1, self.data.shape[-1]), self.priors[places]])
        return rows[:, places], rows[:, -1]

    def minimum(self, places: Sequence[int]) -> tuple[np.ndarray, float]:
        """The step (k,) of these to the minimal sum of squares, and that sum."""
        A, r = self.of(places)
        x = solved(A, r)
        return x, float(np.sum((A @ x + r) ** 2))

    def costs_left_out(self, places: Sequence[int], folds: Sequence[Sequence[int]]) -> np.ndarray:
        """Cross validation: the sums of squares (n_folds,) of trials left out in turn, with these estimated from the
        others."""
        places, costs = list(places), []
        for fold in folds:
            x, _ = dataclasses.replace(self, data=np.delete(self.data, list(fold), axis=0)).minimum(places)
            out = self.data[list(fold)]
            costs.append(np.sum((out[:, :, places] @ x + out[:, :, -1]) ** 2))
        return np.array(costs)


def linearized_problem(
    problem: Problem, at: Linearization, point: Unknowns, b: Sequence[int] | None = None
) -> LinearizedProblem:
    """A linearization without priors, with starts and these unknowns of trials eliminated (None: all), others fixed."""
    blocks, parameters = at.blocks, problem.parameters
    b = range(blocks.n_b) if b is None else b
    first = blocks.n_z + blocks.n_next
    columns = [*range(first), *(first + i for i in b), *range(first + blocks.n_b, blocks.R.shape[-1])]
    R = on_device(np.asarray(blocks.R)[:, :, columns])
    reduced = eliminate(Blocks(R, blocks.windows, blocks.n_z, blocks.n_next, len(b)), 0.0)
    slopes = np.asarray(parameters.slopes(point.x)) / np.asarray(parameters.prior_deviation, float)[:, None]
    priors = np.column_stack([slopes, np.asarray(parameters.prior_residuals(point.x))])
    return LinearizedProblem(reduced.R.astype(float), priors, blocks.column_norms.astype(float))


def solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The shortest x (n,) that minimizes |A x + r|, or (n, k) for r (m, k); columns are scaled: units do not matter."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return (np.linalg.lstsq(A / size, -r, rcond=1e-11)[0].T / size).T


@dataclasses.dataclass(frozen=True)
class Score:
    """The score test of some parameters.

    - `step` (q,) of them, and its `covariance` (q, q). `drop`: by how much the sum of squares falls, to `minimal_cost`.
    - `p`: the probability of such a drop by chance.
    - `sensitive`, `distinguishable` (q,): whether the data depend on a parameter at all, and whether it can be told
        from those that are free already.
    """

    step: np.ndarray
    covariance: np.ndarray
    drop: float
    minimal_cost: float
    p: float
    sensitive: np.ndarray
    distinguishable: np.ndarray


def score_test(
    rows: LinearizedProblem,
    base: Sequence[int],
    new: Sequence[int],
    *,
    degrees_of_freedom: int,
    more: int = 0,
    correlation: float = 0.0,
    without: float | None = None,
) -> Score:
    """Rao's score test of `new` parameters beside `base` ones, by one linearization at the minimum without them.

        drop = g^T H^-1 g,   g = A'^T r,   H = A'^T A',   A' = A_new less what A_base can stand for

    **Arguments:** `degrees_of_freedom`: residuals less unknowns without them; `more`: unknowns of trials that come with
    them. `correlation`: of neighbouring residuals. Where it exceeds 0.2, a residual counts as (1 - c) / (1 + c) of one,
    as in an autoregression; the covariance is clustered by trial, where there are enough of them. `without`: the sum of
    squares without all that is new, where unknowns of trials come with it, which the rows have lost already.
    """
    base, new, q = list(base), list(new), len(new)
    A, r = rows.of([*base, *new])
    A0, A1 = A[:, : len(base)], A[:, len(base) :]
    rest = A1 + A0 @ solved(A0, A1)  # (M, q)
    sensitive = rows.norms[new] > 1e-11 * rows.norms.max(initial=0.0)
    # Less than 1e-7 of a column, once those of the others are taken out of it, is a rounding error.
    distinguishable = sensitive & (np.linalg.norm(rest, axis=0) > 1e-7 * rows.norms[new])
    before = r + A0 @ solved(A0, r)
    step = solved(rest, before) if q and np.all(distinguishable) else np.zeros(q)
    after = before + rest @ step
    minimal_cost, k = float(after @ after), q + more
    drop = float(before @ before if without is None else without) - minimal_cost
    covariance, p = np.full((q, q), np.nan), 1.0
    if np.all(distinguishable):
        p = f_test(drop, k, minimal_cost, degrees_of_freedom - k, correlation)
    if q and np.all(distinguishable):
        T, m, n = *rows.data.shape[:2], A.shape[1]
        of_priors = A[T * m :].T @ A[T * m :]
        if use_clusters(rows, n, correlation):
            A_t = rows.data[:, :, [*base, *new]]
            scores = np.einsum("tmi,tm->ti", A_t, after[: T * m].reshape(T, m))
            covariance = jackknife_covariance(A_t.mT @ A_t, scores, np.tile(np.arange(n), (T, 1)), of_priors)[-q:, -q:]
        elif degrees_of_freedom > k:
            variance = minimal_cost / (degrees_of_freedom - k) / effective_sample_fraction(correlation)
            size = np.linalg.norm(A, axis=0)
            inverse = np.linalg.pinv((A / size).T @ (A / size), rcond=1e-14) / np.outer(size, size)
            covariance = formal_covariance(inverse, of_priors, variance)[-q:, -q:]
    return Score(step, covariance, drop, minimal_cost, p, sensitive, distinguishable)


def use_clusters(rows: LinearizedProblem, parameters: int, correlation: float) -> bool:
    """Whether errors of so many parameters are clustered by trial: the residuals are no noise, and the trials are
    enough."""
    return abs(correlation) > CORRELATED and enough_clusters(rows.data.shape[0], parameters)
