"""Errors that hold where residuals are correlated, quantiles, and intervals that stay inside bounds. Knows numbers."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from ..._scalars.versions import compiled
from .._problem.blocks import Blocks, eliminate
from .._problem.linearization import Linearization
from .._problem.model import Unknowns
from .._problem.parameters import Parameters
from .._problem.problem import Problem


def clusters_of(problem: Problem) -> tuple[str, int]:
    """Within what residuals are taken to be correlated, and how many there are: trials, where these are more than the
    parameters by two; else windows, where these start freely and are more by two; ("", 0) where neither is.

    Windows of one trial have its biases in common, and whatever else differs from trial to trial: errors by window do
    not see that.
    """
    least = len(problem.parameters.names) + 2
    if problem.clusters >= least:
        return "trial", problem.clusters
    windows, nuisance = int(problem.seen.sum()), problem.model.nuisance
    if windows >= least and windows > problem.clusters and not nuisance.chained:
        return "window", windows
    return "", 0


def clustered_covariance(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """Cluster-robust covariance (p, p) of the parameters in their units, for residuals that are correlated within a
    trial, or within a window where there are too few trials (`clusters_of`); NaN where there are too few of both, and
    for parameters that the data do not determine."""
    kind, _ = clusters_of(problem)
    if not kind:
        p = len(problem.parameters.names)
        return np.full((p, p), np.nan)
    slopes = np.asarray(slopes_of(problem.parameters, point.x), float)
    of_x = (_by_trial if kind == "trial" else _by_window)(problem, point, at)
    return slopes @ of_x @ slopes.T


def _of_priors(problem: Problem, point: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Information (p, p) and score (p,) of the parameters' priors, by the free numbers."""
    rows = np.asarray(slopes_of(problem.parameters, point.x), float)
    rows = rows / np.asarray(problem.parameters.prior_deviation, float)[:, None]
    return rows.T @ rows, rows.T @ np.asarray(problem.parameters.prior_residuals(point.x), float)


def _by_trial(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """B (T / (T - 1) sum_t (A_t^T r_t) (A_t^T r_t)^T + P) B,   B = (A^T A)^-1

    (Liang and Zeger 1986; White's sandwich with a trial as the unit.) The parameters' priors, of information P, are
    measurements of their own with the deviations they were given, and no part of any trial.
    """
    blocks, T = np.asarray(eliminate(at.blocks, 0.0).R, float), problem.clusters  # (T, p+1, p+1)
    A, r = blocks[:, :, :-1], blocks[:, :, -1]
    information, scores = np.einsum("tmi,tmj->ij", A, A), np.einsum("tmi,tm->ti", A, r)
    of_prior, score = _of_priors(problem, point)
    # The rows of the priors stand among those of the first window's trial.
    scores[int(problem.windows.trial[0])] -= score
    bread = np.linalg.inv(information)
    return bread @ (T / (T - 1) * scores.T @ scores + of_prior) @ bread


def _by_window(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """(W - 1) / W sum_w d_w d_w^T + B P B,   d_w = (N - N_w)^-1 g_w,   B = N^-1

    d_w is what leaving out the window w moves, linearized (the jackknife; CR3 of Bell and McCaffrey 2002), N_w and g_w
    are its information and score of the parameters and of its trial's own unknowns, and N is the sum with the priors of
    both, of information P. Where unknowns are many, a window has much influence: a sandwich would be too small.
    """
    blocks, windows, p = at.blocks, problem.windows, point.x.shape[0]
    alone = Blocks(blocks.R, jnp.arange(blocks.R.shape[0], dtype=jnp.int32)[:, None], blocks.n_z, 0, 0)
    rows = np.asarray(eliminate(alone, 0.0).R, float)  # (W, n_b + p + 1, n_b + p + 1)
    first, owner, n_b = np.asarray(windows.first), np.asarray(windows.trial), blocks.n_b
    deviation, b = np.asarray(problem.model.nuisance.trial_deviation, float), np.asarray(point.b, float)
    n = len(problem.trials) * n_b + p
    shared, (of_prior, score_of_prior) = n - p + np.arange(p), _of_priors(problem, point)

    def of_window(w: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The unknowns of a window, its information about them and its score; without the priors in its rows."""
        own, A, r = owner[w] * n_b + np.arange(n_b), rows[w, :, :-1], rows[w, :, -1]
        information, score = A.T @ A, A.T @ r
        if first[w]:
            information[:n_b, :n_b] -= np.diag(deviation**-2.0)
            score[:n_b] -= b[owner[w]] / deviation**2
        if w == 0:
            information[n_b:, n_b:] -= of_prior
            score[n_b:] -= score_of_prior
        return np.append(own, shared), information, score

    P = np.diag(np.append(np.tile(deviation**-2.0, len(problem.trials)), np.zeros(p)))
    P[np.ix_(shared, shared)] = of_prior
    N = P.copy()
    for w in range(len(owner)):
        places, information, _ = of_window(w)
        N[np.ix_(places, places)] += information
    scale = np.sqrt(np.maximum(N.diagonal(), np.finfo(float).tiny))

    def inverse(M: np.ndarray) -> np.ndarray:
        # One window alone may determine a trial's unknowns: without it nothing does, and they stay.
        return np.linalg.pinv(M / np.outer(scale, scale), rcond=1e-13, hermitian=True) / np.outer(scale, scale)

    def moved_without(w: int) -> np.ndarray:
        places, information, score = of_window(w)
        rest = N.copy()
        rest[np.ix_(places, places)] -= information
        return inverse(rest)[np.ix_(shared, places)] @ score

    moved = np.array([moved_without(w) for w in np.flatnonzero(problem.seen).tolist()])
    bread, W = inverse(N)[shared], len(moved)
    return (W - 1) / W * moved.T @ moved + bread @ P @ bread.T


def intervals(parameters: Parameters, x: Array, half: np.ndarray) -> list[tuple[float, float]]:
    """Around every parameter an interval of half the width `half` (p,), inside its bounds: symmetric in the free
    numbers x (p,). What moves with others, as a body's values do, is taken as linear."""
    values, slopes = np.asarray(values_of(parameters, x)), np.asarray(slopes_of(parameters, x))
    alone = (np.count_nonzero(slopes, axis=1) == 1) & (slopes.diagonal() != 0)
    in_x = np.where(alone & np.isfinite(half), half / np.where(alone, np.abs(slopes.diagonal()), 1.0), 0.0)
    ends = [np.asarray(values_of(parameters, x + jnp.asarray(sign * in_x, x.dtype))) for sign in (-1, 1)]
    low, high = (np.where(in_x > 0, end, values + s * half) for s, end in zip((-1, 1), ends, strict=True))
    return [(float(min(a, b)), float(max(a, b))) for a, b in zip(low, high, strict=True)]


def check_level(level: float) -> None:
    """**Raises:** `ValueError` for what is no probability between 0 and 1."""
    if not 0 < level < 1:
        raise ValueError(f"`level` is a probability between 0 and 1, such as 0.95 or 0.05; got {level}.")


def t_quantile(level: float, freedom: int) -> float:
    """Two-sided, of Student's distribution; NaN without a degree of freedom."""
    check_level(level)
    return float(stats.t.ppf(0.5 * (1 + level), freedom)) if freedom > 0 else float("nan")


@compiled
def values_of(parameters: Parameters, x: Any) -> Any:
    """`parameters.values(x)`, as one program."""
    return parameters.values(x)


@compiled
def slopes_of(parameters: Parameters, x: Any) -> Any:
    """`parameters.slopes(x)`, as one program."""
    return parameters.slopes(x)
