"""What a linearization says of parameters that were held: score tests, and trials left out. Knows matrices.

A least-squares problem in x, in rows by trial: residuals A_t x + r_t (T, m, n + 1), and rows of priors (n, n + 1) of
which each belongs to one x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import stats

from ._statistics import CORRELATED, are_enough, clustered_covariance, formal_covariance

UNSEEN = 1e-7
"""What part of a column has to be left where those of the others have been taken out: less is a rounding error."""


@dataclasses.dataclass(frozen=True)
class Rows:
    """`data` (T, m, n + 1): by trial, what x moves, and the residuals. `priors` (n, n + 1): of each x its own.
    `norms` (n,): of the columns, before other unknowns were eliminated from them."""

    data: np.ndarray
    priors: np.ndarray
    norms: np.ndarray

    def of(self, places: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (M, k) and residuals (M,) where only these may move, with their priors."""
        places = list(places)
        rows = np.concatenate([self.data.reshape(-1, self.data.shape[-1]), self.priors[places]])
        return rows[:, places], rows[:, -1]

    def least(self, places: Sequence[int]) -> tuple[np.ndarray, float]:
        """The step (k,) of these that makes the sum of squares least, and that sum."""
        A, r = self.of(places)
        x = solved(A, r)
        return x, float(np.sum((A @ x + r) ** 2))

    def left_out(self, places: Sequence[int], folds: Sequence[Sequence[int]]) -> float:
        """The sum of squares of trials that are left out in turn, with what the others say of these parameters."""
        places, total = list(places), 0.0
        for fold in folds:
            kept = np.delete(self.data, list(fold), axis=0)
            A, r = Rows(kept, self.priors, self.norms).of(places)
            x = solved(A, r)
            out = self.data[list(fold)]
            total += float(np.sum((out[:, :, places] @ x + out[:, :, -1]) ** 2))
        return total


def solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The least x (n,) with the least |A x + r|, or (n, k) for r (m, k); columns are scaled: units do not matter."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return (np.linalg.lstsq(A / size, -r, rcond=1e-11)[0].T / size).T


@dataclasses.dataclass(frozen=True)
class Score:
    """What freeing some parameters promises.

    - `step` (q,) of them, and its `covariance` (q, q). `drop`: by how much the sum of squares falls, `least`: to what.
    - `p`: the probability that chance promises as much.
    - `seen`, `apart` (q,): whether the data depend on a parameter at all, and whether it can be distinguished from
        those that are free already.
    """

    step: np.ndarray
    covariance: np.ndarray
    drop: float
    least: float
    p: float
    seen: np.ndarray
    apart: np.ndarray


def score(
    rows: Rows,
    base: Sequence[int],
    new: Sequence[int],
    *,
    freedom: int,
    more: int = 0,
    correlation: float = 0.0,
    without: float | None = None,
) -> Score:
    """Rao's score test of `new` parameters beside `base` ones, by one linearization at the minimum without them.

        drop = g^T H^-1 g,   g = A'^T r,   H = A'^T A',   A' = A_new less what A_base can stand for

    **Arguments:** `freedom`: residuals less unknowns without them; `more`: unknowns of trials that come with them.
    `correlation`: of neighbouring residuals. Where it exceeds 0.2, a residual counts as (1 - c) / (1 + c) of one, as in
    an autoregression; the covariance is clustered by trial, where there are enough of them. `without`: the sum of
    squares without all that is new, where unknowns of trials come with it, which the rows have lost already.
    """
    base, new, q = list(base), list(new), len(new)
    A, r = rows.of([*base, *new])
    A0, A1 = A[:, : len(base)], A[:, len(base) :]
    rest = A1 + A0 @ solved(A0, A1)  # (M, q)
    seen = rows.norms[new] > 1e-11 * rows.norms.max(initial=0.0)
    apart = seen & (np.linalg.norm(rest, axis=0) > UNSEEN * rows.norms[new])
    before = r + A0 @ solved(A0, r)
    step = solved(rest, before) if q and np.all(apart) else np.zeros(q)
    after = before + rest @ step
    drop, least, k = (
        float((before @ before if without is None else without) - after @ after),
        float(after @ after),
        q + more,
    )
    covariance, p = np.full((q, q), np.nan), 1.0
    if q and np.all(apart):
        priors = A[rows.data[:, :, 0].size :]
        if is_clustered(rows, A.shape[1], correlation):
            covariance = _clustered(rows.data[:, :, [*base, *new]], after, priors)[-q:, -q:]
        elif freedom > k:
            variance = least / (freedom - k) / independent_share(correlation)
            covariance = formal_covariance(_inverse(A), priors.T @ priors, variance)[-q:, -q:]
    if np.all(apart):
        p = chance(drop, k, least, freedom - k, correlation)
    return Score(step, covariance, drop, least, p, seen, apart)


def is_clustered(rows: Rows, parameters: int, correlation: float) -> bool:
    """Whether errors of so many parameters are taken from what differs between the trials: the residuals are no noise,
    and the trials are enough."""
    return abs(correlation) > CORRELATED and are_enough(rows.data.shape[0], parameters)


def beside_zero(step: np.ndarray, covariance: np.ndarray, trials: int) -> float:
    """The probability that one of some numbers (q,) which are all zero is found as far from it, with a covariance from
    so many trials: Student's t of each, and Bonferroni's bound over them.

    Hotelling's test of all of them together rejects too often, up to 12 % at 5 %, where few trials tell most.
    """
    p = 2 * stats.t.sf(np.abs(step) / np.sqrt(np.diagonal(covariance)), trials - 1)
    return float(min(1.0, len(step) * p.min()))


def _inverse(A: np.ndarray) -> np.ndarray:
    """(A^T A)^-1, units aside."""
    size = np.linalg.norm(A, axis=0)
    return np.linalg.pinv((A / size).T @ (A / size), rcond=1e-14) / np.outer(size, size)


def _clustered(A: np.ndarray, residuals: np.ndarray, priors: np.ndarray) -> np.ndarray:
    """By trial, of sensitivities (T, m, n), the residuals of all rows, and the sensitivities of priors (k, n)."""
    T, m, n = A.shape
    scores = np.einsum("tmi,tm->ti", A, residuals[: T * m].reshape(T, m))
    return clustered_covariance(A.mT @ A, scores, np.tile(np.arange(n), (T, 1)), priors.T @ priors)


def independent_share(correlation: float) -> float:
    """Of a residual whose neighbours correlate."""
    c = max(correlation, 0.0) if correlation > CORRELATED else 0.0
    return (1 - c) / (1 + c)


def bic_change(before: float, after: float, more: int, n: int, correlation: float) -> float:
    """By how much a model with `more` unknowns changes the Bayesian information criterion (Schwarz 1978) of n residuals
    of unknown variance, nested or not: below zero it is the better one."""
    n_independent = max(independent_share(correlation) * n, 1.0)
    return float(n_independent * np.log(max(after, 1e-300) / max(before, 1e-300)) + more * np.log(n_independent))


def chance(drop: float, k: int, least: float, freedom: int, correlation: float) -> float:
    """The probability that k unknowns which mean nothing lower a sum of squares by `drop` to `least` (Fisher's F)."""
    if freedom <= 0 or k == 0 or not drop > 0:
        return 1.0
    share = independent_share(correlation)
    return float(stats.f.sf(share * drop / k / max(least / freedom, 1e-300), k, max(share * freedom, 1.0)))
