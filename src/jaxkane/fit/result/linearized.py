"""Linearized least squares with parameters to choose: cross-validation and score tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..._scalarjit.compat import on_device
from ..solve.blocks import Blocks, eliminate
from ..solve.linearization import Linearization
from .statistics import (
    FEWEST_TRIALS_OF_A_TEST,
    LARGEST_LEVERAGE,
    Clusters,
    effective_sample_fraction,
    f_test,
    formal_covariance,
    jackknife,
    wald_test,
)


def folds_of(folds: int | Sequence[Sequence[int]] | None, T: int) -> list[list[int]]:
    """Groups of trials that are left out together. None: each trial alone; with eleven or more trials, five folds."""
    if folds is None:
        folds = T if T <= 10 else 5
    if isinstance(folds, int):
        if not 2 <= folds <= T:
            raise ValueError(f"`folds` must be between 2 and the number of trials, {T}; got {folds}.")
        return [list(range(k, T, folds)) for k in range(folds)]
    groups = [[int(k) for k in group] for group in folds]
    if sorted(k for group in groups for k in group) != list(range(T)) or not all(groups) or len(groups) < 2:
        raise ValueError(f"`folds` must contain each of the trials 0 to {T - 1} exactly once, in at least two groups.")
    return groups


@dataclasses.dataclass(frozen=True)
class LinearizedProblem:
    """Linear least squares in x, in rows by trial: residuals A_t x + r_t, and priors.

    - `data` (T, m, n + 1): A_t and r_t.
    - `priors` (k, n + 1): one row for each x, followed by the joint priors of several.
    - `norms` (n,): norms of the columns before other unknowns were eliminated.
    """

    data: np.ndarray
    priors: np.ndarray
    norms: np.ndarray

    def of(self, places: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (M, k) and residuals (M,) if only the unknowns at `places` are free, with their priors."""
        places = list(places)
        priors = self.priors[[*places, *range(self.priors.shape[1] - 1, len(self.priors))]]
        rows = np.concatenate([self.data.reshape(-1, self.data.shape[-1]), priors])
        return rows[:, places], rows[:, -1]

    def minimum(self, places: Sequence[int]) -> tuple[np.ndarray, float]:
        """The step (k,) of these unknowns to the minimum, and the sum of squares there."""
        A, r = self.of(places)
        x = solved(A, r)
        return x, float(np.sum((A @ x + r) ** 2))

    def costs_left_out(self, places: Sequence[int], folds: Sequence[Sequence[int]]) -> np.ndarray:
        """Cross-validation: sums of squares (n_folds,) of trials left out in turn, with these unknowns estimated from
        the others.

        Infinite if the others determine fewer of them.
        """
        places, costs = list(places), []
        rank = _rank(self.of(places)[0])
        for fold in folds:
            rest = dataclasses.replace(self, data=np.delete(self.data, list(fold), axis=0))
            (x, _), out = rest.minimum(places), self.data[list(fold)]
            predicts = _rank(rest.of(places)[0]) == rank
            costs.append(np.sum((out[:, :, places] @ x + out[:, :, -1]) ** 2) if predicts else np.inf)
        return np.array(costs)


def linearized_problem(at: Linearization, b: Sequence[int] | None = None) -> LinearizedProblem:
    """A linearization with nuisance parameters eliminated.

    `b`: trial unknowns that are eliminated together with the initial states, None for all. Others are fixed.
    """
    blocks = at.blocks
    b = range(blocks.n_b) if b is None else b
    first = blocks.n_z + blocks.n_next
    columns = [*range(first), *(first + i for i in b), *range(first + blocks.n_b, blocks.R.shape[-1])]
    R = on_device(np.asarray(blocks.R)[:, :, columns])
    reduced = eliminate(Blocks(R, blocks.priors, blocks.windows, blocks.n_z, blocks.n_next, len(b)), 0.0)
    return LinearizedProblem(reduced.R.astype(float), reduced.priors.astype(float), blocks.column_norms.astype(float))


def _rank(A: np.ndarray) -> int:
    """Numerical rank. The columns may have different units."""
    size = np.linalg.norm(A, axis=0)
    return int(np.linalg.matrix_rank(A / np.where(size > 0, size, 1.0), rtol=1e-7))


def solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The shortest x (n,) that minimizes |A x + r|, or (n, k) for r (m, k). It does not depend on the units of x."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return (np.linalg.lstsq(A / size, -r, rcond=1e-11)[0].T / size).T


@dataclasses.dataclass(frozen=True)
class Score:
    """The result of a score test of q parameters.

    - `step` (q,): estimated change of the parameters.
    - `covariance` (q, q): of the step.
    - `degrees_of_freedom` (q,): of the variances. None for formal variances.
    - `drop`: decrease of the sum of squares to `minimal_cost`.
    - `p`: p-value.
    - `sensitive` (q,): whether the data depend on the parameter.
    - `distinguishable` (q,): whether its effect is linearly independent of those of the free parameters.
    """

    step: np.ndarray
    covariance: np.ndarray
    degrees_of_freedom: np.ndarray | None
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
    correlation: float = 0.0,
) -> Score:
    """Rao's score test of `new` parameters in addition to `base` ones, with one linearization at the minimum without
    them.

        drop = g^T H^-1 g,   g = A'^T r,   H = A'^T A',   A' = A_new + A_base X

    X minimizes A', so A' is the part of A_new that is orthogonal to A_base. With enough trials the covariance is
    clustered by trial, and p is that of `wald_test`, unless one trial alone determines one of the parameters. Otherwise
    the number of residuals is multiplied by (1 - c) / (1 + c) (`f_test`).

    **Arguments:**

    - `degrees_of_freedom`: number of residuals minus the number of unknowns without the new parameters.
    - `correlation`: c of `serial_correlation`.
    """
    base, new, q = list(base), list(new), len(new)
    A, r = rows.of([*base, *new])
    A0, A1 = A[:, : len(base)], A[:, len(base) :]
    rest = A1 + A0 @ solved(A0, A1)  # (M, q)
    sensitive = rows.norms[new] > 1e-11 * rows.norms.max(initial=0.0)
    # A projected column below 1e-7 of the original one is a rounding error.
    distinguishable = sensitive & (np.linalg.norm(rest, axis=0) > 1e-7 * rows.norms[new])
    before = r + A0 @ solved(A0, r)
    step = solved(rest, before) if q and np.all(distinguishable) else np.zeros(q)
    after = before + rest @ step
    minimal_cost = float(after @ after)
    drop = float(before @ before) - minimal_cost
    covariance, freedom, p = np.full((q, q), np.nan), None, 1.0
    if np.all(distinguishable):
        p = f_test(drop, q, minimal_cost, degrees_of_freedom - q, correlation)
    if q and np.all(distinguishable):
        T, m, n = *rows.data.shape[:2], A.shape[1]
        of_priors, by_trial = A[T * m :].T @ A[T * m :], rows.data[np.any(rows.data, axis=(1, 2))]
        clustered = None
        # With three trials and slow errors, the F test accepted 11 % of null candidates at a level of 5 %. This test
        # accepted 3 %.
        if len(by_trial) >= FEWEST_TRIALS_OF_A_TEST:
            A_t = by_trial[:, :, [*base, *new]]
            left = by_trial[:, :, -1] + A_t @ solved(A, r)
            places = np.tile(np.arange(n), (len(A_t), 1))
            scores = np.einsum("tmi,tm->ti", A_t, left)
            clustered = jackknife(Clusters(A_t.mT @ A_t, scores, places, of_priors), np.eye(n)[-q:])
        if clustered is not None and np.all(clustered.leverage <= LARGEST_LEVERAGE):
            covariance, freedom, _ = clustered
            p = wald_test(step, covariance.diagonal(), freedom)
        elif degrees_of_freedom > q:
            variance = minimal_cost / (degrees_of_freedom - q) / effective_sample_fraction(correlation)
            size = np.linalg.norm(A, axis=0)
            inverse = np.linalg.pinv((A / size).T @ (A / size), rcond=1e-14) / np.outer(size, size)
            covariance = formal_covariance(inverse, of_priors, variance)[-q:, -q:]
            if clustered is not None and correlation > 0:
                p = 1.0  # one trial alone does not show the scatter between trials
    return Score(step, covariance, freedom, drop, minimal_cost, p, sensitive, distinguishable)
