"""Errors that hold where residuals are correlated, quantiles, and intervals that stay inside bounds. Knows numbers."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from ..._scalars.reads import compiled
from .._problem.blocks import eliminate
from .._problem.model import Unknowns
from .._problem.parameters import Parameters
from .._problem.problem import Linearization, Problem


def clustered_covariance(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """Cluster-robust covariance (p, p) of the parameters in their units, for residuals correlated within a trial.

        B (T / (T - 1) sum_t (A_t^T r_t) (A_t^T r_t)^T + P) B,   B = (A^T A)^-1

    (Liang and Zeger 1986; White's sandwich with a trial as the unit.) The parameters' priors, of information P, are
    measurements of their own with the deviations they were given, and no part of any trial. NaN with fewer trials than
    parameters plus two, and for parameters that the data do not determine.
    """
    blocks = np.asarray(eliminate(at.blocks, 0.0).R, float)  # (T, p+1, p+1)
    T, p, parameters, x = problem.clusters, len(problem.parameters.names), problem.parameters, point.x
    if p + 2 > T:
        return np.full((p, p), np.nan)
    A, r = blocks[:, :, :-1], blocks[:, :, -1]
    information, scores = np.einsum("tmi,tmj->ij", A, A), np.einsum("tmi,tm->ti", A, r)
    slopes = np.asarray(slopes_of(parameters, x), float)
    of_prior = slopes / np.asarray(parameters.prior_deviation, float)[:, None]
    # The rows of the priors stand among those of the first window's trial.
    scores[int(problem.windows.trial[0])] -= of_prior.T @ np.asarray(parameters.prior_residuals(x), float)
    bread = np.linalg.inv(information)
    of_x = bread @ (T / (T - 1) * scores.T @ scores + of_prior.T @ of_prior) @ bread
    return slopes @ of_x @ slopes.T


def intervals(parameters: Parameters, x: Array, half: np.ndarray) -> list[tuple[float, float]]:
    """Around every parameter an interval of half the width `half` (p,), inside its bounds: symmetric in the free
    numbers x (p,). What moves with others, as a body's values do, is taken as linear."""
    values, slopes = np.asarray(values_of(parameters, x)), np.asarray(slopes_of(parameters, x))
    alone = (np.count_nonzero(slopes, axis=1) == 1) & (slopes.diagonal() != 0)
    in_x = np.where(alone & np.isfinite(half), half / np.where(alone, np.abs(slopes.diagonal()), 1.0), 0.0)
    ends = [np.asarray(values_of(parameters, x + jnp.asarray(sign * in_x, x.dtype))) for sign in (-1, 1)]
    low, high = (np.where(in_x > 0, end, values + s * half) for s, end in zip((-1, 1), ends, strict=True))
    return [(float(min(a, b)), float(max(a, b))) for a, b in zip(low, high, strict=True)]


def t_quantile(level: float, freedom: int) -> float:
    """Two-sided, of Student's distribution; NaN without a degree of freedom."""
    if not 0 < level < 1:
        raise ValueError(f"`level` is a probability between 0 and 1, such as 0.95; got {level}.")
    return float(stats.t.ppf(0.5 * (1 + level), freedom)) if freedom > 0 else float("nan")


@compiled
def values_of(parameters: Parameters, x: Any) -> Any:
    """`parameters.values(x)`, as one program."""
    return parameters.values(x)


@compiled
def slopes_of(parameters: Parameters, x: Any) -> Any:
    """`parameters.slopes(x)`, as one program."""
    return parameters.slopes(x)
