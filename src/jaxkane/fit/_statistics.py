"""Statistics of a fit: covariances, intervals, and tests of the residuals. Knows numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array
from scipy import stats

from .._common.lookup import real_number
from .._scalarjit.cache_key import compiled
from ._block_lsq import Blocks, Eliminated, eliminate
from ._linearize import Linearization
from ._model import Unknowns
from ._parameters import Parameters
from ._problem import Problem


def formal_covariance(inverse: np.ndarray, of_priors: np.ndarray, variance: float) -> np.ndarray:
    """B (v D + P) B,   B = (D + P)^-1   (p, p)

    of unknowns with the information D from data whose residuals have the variance v, and P from priors, which are
    measurements with the deviations that they were given. `inverse`: B.
    """
    return variance * inverse + (1.0 - variance) * inverse @ of_priors @ inverse


def clustered_covariance(
    information: np.ndarray, scores: np.ndarray, places: np.ndarray, of_priors: np.ndarray
) -> np.ndarray:
    """(G - 1) / G sum_g d_g d_g^T + B P B,   d_g = (N - N_g)^-1 s_g,   B = N^-1,   N = sum_g N_g + P   (n, n)

    Robust to whatever correlates inside a cluster. d_g is what leaving out the cluster g moves, linearized (the
    jackknife; CR3 of Bell and McCaffrey 2002): a sandwich without it is too small where a cluster has much influence.

    **Arguments:** of every cluster the `information` N_g (G, k, k) and the `scores` s_g (G, k) of its data about the
    unknowns at `places` (G, k); `of_priors`: P (n, n), of no cluster.
    """
    N, G = of_priors.copy(), len(places)
    rows, columns = places[:, :, None], places[:, None, :]
    np.add.at(N, (rows, columns), information)
    scale = np.sqrt(np.maximum(N.diagonal(), np.finfo(float).tiny))
    B = np.linalg.pinv(N / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    values, V = np.linalg.eigh(information / (scale[rows] * scale[columns]))
    roots = np.sqrt(np.maximum(values, 0.0))
    S, known = V * roots[:, None, :], roots > 1e-7  # N_g = S S^T,  s_g = S c
    c = np.einsum("gij,gi->gj", V, scores / scale[places]) * known / np.where(known, roots, 1.0)
    # (N - S S^T)^-1 S = B S (I - S^T B S)^-1. What one cluster alone determines stays where it is without it.
    left = np.linalg.pinv(np.eye(S.shape[2]) - S.mT @ B[rows, columns] @ S, rcond=1e-9, hermitian=True)
    moved = np.einsum("gni,gij,gj->gn", np.moveaxis(B[:, places], 1, 0) @ S, left, c)
    covariance = (G - 1) / G * moved.T @ moved + B @ (of_priors / np.outer(scale, scale)) @ B
    return covariance / np.outer(scale, scale)


def infinite_along(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A covariance (p, p) with the variance of every parameter infinite that has a part in one of these directions
    (k, p), which nothing determines; between it and the others NaN."""
    there = np.any(np.abs(directions) > 1e-5, axis=0)
    found = np.where(there[:, None] | there[None, :], np.nan, covariance)
    found[there, there] = np.inf
    return found


def are_enough(clusters: int, parameters: int) -> bool:
    """Whether so many clusters say how parameters scatter."""
    return clusters >= parameters + 2


def clusters_of(problem: Problem) -> tuple[str, int]:
    """Within what residuals are taken to be correlated, and how many there are: trials, where these are more than the
    parameters by two; else windows, where these start freely and are more by two; ("", 0) where neither is.

    Windows of one trial have its biases in common, and whatever else differs from trial to trial: errors by window do
    not see that.
    """
    p = len(problem.parameters.names)
    if are_enough(problem.clusters, p):
        return "trial", problem.clusters
    windows, nuisance = int(problem.active_windows.sum()), problem.model.nuisance
    if are_enough(windows, p) and windows > problem.clusters and not nuisance.has_defects:
        return "window", windows
    return "", 0


def covariance_by_cluster(problem: Problem, point: Unknowns, at: Linearization, directions: np.ndarray) -> np.ndarray:
    """Cluster-robust covariance (k, k) along directions (p, k) of the free numbers, by `clusters_of`; NaN where there
    are too few. What every cluster has of its own is eliminated: by trial its starts and biases, by window its start.
    The parameters' priors, and by window those of the biases, are part of no cluster."""
    kind, _ = clusters_of(problem)
    k = directions.shape[1]
    if not kind:
        return np.full((k, k), np.nan)
    blocks, owner, seen = at.blocks, np.asarray(problem.windows.trial), problem.active_windows
    clusters, n_own = owner, 0
    if kind == "window":  # each a trial of its own, whose biases are shared with others
        clusters, n_own = np.arange(len(owner), dtype=np.int32), blocks.n_b
        blocks = Blocks(blocks.R, jnp.asarray(clusters[:, None]), blocks.n_z, 0, 0)
    p = directions.shape[0]

    def squares(rows: np.ndarray) -> np.ndarray:
        """Of clusters, information (G, c, c) about what is shared and along the directions, bordered by the scores."""
        rows = np.concatenate([rows[..., : -p - 1], rows[..., -p - 1 : -1] @ directions, rows[..., -1:]], axis=-1)
        return rows.mT @ rows

    data = squares(np.asarray(eliminate(blocks, 0.0).R, float))
    of_priors = np.zeros_like(data)
    np.add.at(of_priors, clusters, squares(prior_rows(problem, point)[0][:, -n_own - p :, -n_own - p - 1 :]))
    n = len(problem.trials) * n_own + k
    places = np.tile(np.arange(n - k, n), (len(data), 1))
    if kind == "window":
        places = np.column_stack([owner[:, None] * n_own + np.arange(n_own), places])
    P = np.zeros((n, n))
    np.add.at(P, (places[:, :, None], places[:, None, :]), of_priors[:, :-1, :-1])
    kept, data = np.unique(clusters[seen]), data - of_priors
    return clustered_covariance(data[kept, :-1, :-1], data[kept, :-1, -1], places[kept], P)[-k:, -k:]


def prior_rows(problem: Problem, point: Unknowns) -> tuple[np.ndarray, int]:
    """The rows (W, n_z + n_b + p, n) of all priors in the columns of a window's block [z, z_next, b, x, r], zero where
    there is none, and how many there are."""
    parameters, windows, nuisance = problem.parameters, problem.windows, problem.model.nuisance
    seen, owner = problem.active_windows, np.asarray(windows.trial)
    z, b, x = (np.asarray(u, float) for u in (point.z, point.b[windows.trial], parameters.prior_residuals(point.x)))
    of_trial = np.asarray(windows.first) & np.isin(owner, owner[seen])
    counts = (of_trial if nuisance.has_defects else seen, of_trial, np.asarray(windows.very_first))
    deviations = [np.asarray(d, float) for d in (nuisance.start_deviation, nuisance.trial_deviation)]
    residuals = (z / deviations[0], b / deviations[1], np.broadcast_to(x, (len(owner), len(x))))
    of_x = np.asarray(slopes_of(parameters, point.x), float) / np.asarray(parameters.prior_deviation, float)[:, None]
    slopes = np.asarray(scipy.linalg.block_diag(*(np.diag(1.0 / d) for d in deviations), of_x))
    n_z, n_next = z.shape[1], z.shape[1] if nuisance.has_defects else 0
    slopes = np.insert(slopes, [n_z] * n_next, 0.0, axis=1)
    known = np.isfinite(np.concatenate([*deviations, np.asarray(parameters.prior_deviation, float)]))
    there = np.concatenate([np.tile(c[:, None], r.shape[1]) for c, r in zip(counts, residuals, strict=True)], axis=1)
    there &= known
    rows = np.concatenate(
        [np.broadcast_to(slopes, (len(owner), *slopes.shape)), np.hstack(residuals)[..., None]], axis=2
    )
    return there[..., None] * rows, int(there.sum())


class Priors(NamedTuple):
    """What all priors say together.

    - `information` (p, p): about the free numbers, starts and biases following them.
    - `determined`: how many of the starts and biases they determine and not the data, a share where both do.
    - `number`: of them; `squares`: the sum of their squared residuals.
    """

    information: np.ndarray
    determined: float
    number: int
    squares: float


def priors_of(problem: Problem, point: Unknowns, eliminated: Eliminated) -> Priors:
    """Of a problem whose linearization at the point has been `eliminated`."""
    (rows, number), blocks, p = prior_rows(problem, point), eliminated.blocks, point.x.shape[0]
    of_x, others, determined = rows[:, -p:, -p - 1 : -1], rows[:, :-p], 0.0
    information = np.einsum("wmi,wmj->ij", of_x, of_x)
    if others.any():
        still, *moved = (eliminated.back_substitute(x) for x in jnp.eye(p + 1, p, -1, dtype=point.x.dtype))
        z, b = (np.array([new - old for new in news]).T for *news, old in zip(*moved, still, strict=True))  # by x
        follow = np.concatenate([z.swapaxes(0, 1), b.swapaxes(0, 1)[np.asarray(problem.windows.trial)]], axis=1)
        places = [*range(blocks.n_z), *range(blocks.n_z + blocks.n_next, rows.shape[2] - p - 1)]
        J = others[:, :, places] @ follow
        information += np.einsum("wmi,wmj->ij", J, J)
        # d log det (N + e P) / de = tr (P N^-1), of starts and biases
        e = float(jnp.finfo(blocks.R.dtype).eps) ** (1 / 3)
        R = np.linalg.qr(np.concatenate([np.asarray(blocks.R), e**0.5 * others], axis=1), mode="r")
        more = eliminate(eqx.tree_at(lambda blocks: blocks.R, blocks, jnp.asarray(R, blocks.R.dtype)), 0.0)
        determined = float(more.log_determinant - eliminated.log_determinant) / e
    return Priors(information, determined, number, float(np.sum(rows[:, :, -1] ** 2)))


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
    if not 0 < real_number(level, "`level`") < 1:
        raise ValueError(f"`level` is a probability between 0 and 1, such as 0.95 or 0.05; got {level}.")


def t_quantile(level: float, freedom: float) -> float:
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
            for i, (owner, first, n) in enumerate(problem.slices):
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
