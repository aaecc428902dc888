"""Statistics of a fit: covariances of estimates, intervals, tests of residuals and parameters, information criteria."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from scipy import special  # all of scipy.stats would take a second to import

from ..._common.lookup import real_number
from ..._scalarjit.components import Numbers
from ..problem.model import Unknowns
from ..problem.parameters import Parameters
from ..problem.problem import Problem
from ..problem.trial import trial_names
from ..solve.linearization import Blocks, Eliminated, Linearization, eliminate


def formal_covariance(inverse: np.ndarray, of_priors: np.ndarray, variance: float) -> np.ndarray:
    """B (v D + P) B,   B = (D + P)^-1   (p, p)

    The covariance of unknowns with the information D from data whose residuals have the variance v, and the information
    P from priors. Priors are measurements with known standard deviations.

    **Arguments:**

    - `inverse`: B.
    - `of_priors`: P.
    - `variance`: v.
    """
    return variance * inverse + (1.0 - variance) * inverse @ of_priors @ inverse


class Jackknife(NamedTuple):
    """Cluster-robust statistics of q linear combinations of unknowns.

    - `covariance` (q, q): unbiased for white residuals.
    - `degrees_of_freedom` (q,): of its diagonal.
    - `leverage` (q,): the relative decrease of the information about a combination if the most influential cluster is
        left out. It is one if no other cluster determines the combination.
    """

    covariance: np.ndarray
    degrees_of_freedom: np.ndarray
    leverage: np.ndarray


# Above this leverage, a cluster-robust variance is unreliable (MacKinnon, Nielsen and Webb, Journal of Econometrics
# 232, 2023).
LARGEST_LEVERAGE = 0.9


def jackknife(clusters: Clusters, combinations: np.ndarray | None = None) -> Jackknife:
    """a sum_g d_g d_g^T a + C B P B C^T,   d_g = C (N - N_g)^-1 s_g,   B = N^-1,   N = sum_g N_g + P

    The covariance of the combinations C (q, n) of the unknowns, by default of the unknowns. d_g is the linearized
    change of the estimates if the cluster g is left out (CR3: Bell and McCaffrey 2002). The diagonal scale a and the
    degrees of freedom are those of sum_g d_g^2 for white residuals (as in Hansen, Jackknife standard errors for
    clustered regression, 2025). With G - 1 degrees of freedom instead, 95 % intervals would cover 80 % if two of many
    clusters contain all information.
    """
    information, scores, places, P = clusters
    N, G = P.copy(), len(places)
    rows, columns = places[:, :, None], places[:, None, :]
    np.add.at(N, (rows, columns), information)
    scale = np.sqrt(np.maximum(N.diagonal(), np.finfo(float).tiny))
    N, P = N / np.outer(scale, scale), P / np.outer(scale, scale)
    B = np.linalg.pinv(N, rcond=1e-13, hermitian=True)
    values, V = np.linalg.eigh(information / (scale[rows] * scale[columns]))
    roots = np.sqrt(np.maximum(values, 0.0))
    S, known = V * roots[:, None, :], roots > 1e-7  # N_g = S S^T,  s_g = S c
    c = np.einsum("gij,gi->gj", V, scores / scale[places]) * known / np.where(known, roots, 1.0)
    # (N - S S^T)^-1 S = B S (I - S^T B S)^-1, in the eigenvectors U of S^T B S. `rest` is the information along an
    # eigenvector without the cluster, divided by the information with it.
    shares, U = np.linalg.eigh(S.mT @ B[rows, columns] @ S)
    S, c, rest = S @ U, np.einsum("gji,gj->gi", U, c), np.maximum(1.0 - shares, 1e-9)
    CB = (np.eye(len(N)) if combinations is None else combinations) / scale @ B
    along = np.einsum("qgi,gij->qgj", CB[:, places], S)
    moved = along / rest
    d = np.sum(moved * c, axis=2)  # (q, G)
    formal, of_priors = np.sum(CB @ N * CB, axis=1), CB @ P @ CB.T
    leverage = np.max(np.sum(along**2 / rest, axis=2), axis=1)
    leverage = leverage / np.maximum(formal + leverage, np.finfo(float).tiny)
    # For white residuals cov(d_g, d_h) = (g = h) D_g - v_g^T K v_h.
    D, K = np.sum(moved**2, axis=2), B + B @ P @ B
    v = np.zeros((len(CB), G, len(N)))
    v[:, np.arange(G)[:, None], places] = np.einsum("gij,qgj->qgi", S, moved)
    weights = D - np.sum(v @ K * v, axis=2)
    if G <= MOST_EXACT:
        weights = np.linalg.eigvalsh(D[:, :, None] * np.eye(G) - v @ K @ v.mT)
    # If one cluster determines a combination, these weights are rounding errors.
    weights = np.maximum(np.where(leverage[:, None] < 0.99, weights, 0.0), 0.0)
    trace = np.sum(weights, axis=1)
    trace = np.where(trace > 0, trace, 1.0)
    of_data = formal - of_priors.diagonal()
    d = d * np.sqrt(np.maximum(of_data, 0.0) / trace)[:, None]
    covariance = d @ d.T + of_priors
    # The variance of priors is exact, so the sum has more degrees of freedom (Satterthwaite).
    share = np.sum(d**2, axis=1) / np.maximum(covariance.diagonal(), np.finfo(float).tiny)
    freedom = np.array([_freedom_of(w) for w in weights / trace[:, None]]) / np.maximum(share, 1e-4) ** 2
    return Jackknife(covariance, freedom, leverage)


# Largest number of clusters with exact degrees of freedom. With more, Satterthwaite's approximation is used.
MOST_EXACT = 200


def _freedom_of(weights: np.ndarray) -> float:
    """The degrees of freedom n of the t distribution whose 95 % quantile is that of Z / sqrt(sum_i w_i chi^2_i).

    The weights satisfy sum_i w_i = 1. P(Z^2 > c sum_i w_i chi^2_i) is computed with Imhof's method (Biometrika 48,
    1961). Satterthwaite's approximation 1 / sum_i w_i^2 is too small if the clusters are few and unequal: 95 %
    intervals covered 98 % in fits of eight trials.
    """
    if len(weights) > MOST_EXACT or not weights.any():
        return float(1.0 / np.sum(weights**2)) if weights.any() else np.inf
    log_u, du = np.linspace(-20.0, 20.0, 161, retstep=True)

    def exceeded(c: float) -> float:
        a = np.append(1.0, -c * weights)[:, None] * np.exp(log_u)
        angle, log_size = 0.5 * np.sum(np.arctan(a), axis=0), 0.25 * np.sum(np.log1p(a**2), axis=0)
        return 0.5 + np.sum(np.sin(angle) * np.exp(-log_size)) * du / np.pi

    root: Any = scipy.optimize.brentq
    q = root(lambda c: exceeded(c) - 0.05, 3.8, 200.0) ** 0.5
    return root(lambda n: special.stdtrit(n, 0.975) - q, 0.99, 1e6)


def infinite_along(covariance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A covariance (p, p) with undetermined directions (k, p) taken into account.

    Every parameter that has a nonzero component along one of these directions has an infinite variance. Its covariances
    with the others are NaN.
    """
    infinite = np.any(np.abs(directions) > 1e-5, axis=0)
    covariance = np.where(infinite[:, None] | infinite[None, :], np.nan, covariance)
    covariance[infinite, infinite] = np.inf
    return covariance


FEWEST_TRIALS_OF_A_TEST = 3
# Smallest number of trials, of windows, and of independent samples per part, with which these are used as clusters. The
# number of parameters does not matter, because `jackknife` computes leverage and degrees of freedom of each.
FEWEST_TRIALS, FEWEST_WINDOWS, FEWEST_SAMPLES = 4, 8, 5.0
FEWEST_KINDS = 3
LABEL = "label "


def kinds_of(problem: Problem) -> tuple[str, dict[int, int]]:
    """The label with the fewest values of those with at least three, and by active trial the index of its value.

    ("", {}) without such a label. A label counts only if all active trials have it.
    """
    active = np.unique(np.asarray(problem.windows.trial)[problem.active_windows]).tolist()
    labels = {k: problem.trials[k].labels for k in active}
    of_all = [name for name in labels[active[0]] if all(name in own for own in labels.values())] if active else []
    values = {name: [*dict.fromkeys(own[name] for own in labels.values())] for name in of_all}
    name = min((name for name in of_all if len(values[name]) >= FEWEST_KINDS), key=lambda x: len(values[x]), default="")
    return name, {k: values[name].index(own[name]) for k, own in labels.items()} if name else {}


def clusters_of(problem: Problem, at: Linearization, by_label: bool = True) -> tuple[str, int]:
    """The cluster unit, and the number of clusters.

    The unit is a label if it has at least three values ("label speed"). Otherwise it is the trial if there are enough
    trials, otherwise the window with free initial states, otherwise a part of a window. The parts have equal numbers of
    samples. ("", 0) with few trials and process noise or chained windows.

    Windows and parts of one trial share its trial unknowns. They do not show differences between trials.

    `by_label`: False to ignore labels.
    """
    windows, model = int(problem.active_windows.sum()), problem.model
    label, kinds = kinds_of(problem) if by_label else ("", {})
    if label:
        return f"{LABEL}{label}", len({*kinds.values()})
    if problem.clusters >= FEWEST_TRIALS:
        return "trial", problem.clusters
    if model.nuisance.has_defects or model.noise is not None:
        return "", 0
    if windows >= FEWEST_WINDOWS:
        return "window", windows
    parts = int(np.any(at.blocks.triangles[problem.active_windows, :-1], axis=(2, 3)).sum())
    return ("part", parts) if parts >= FEWEST_WINDOWS // 2 else ("", 0)


class Clusters(NamedTuple):
    """The information of clusters of data about n unknowns.

    - `information` (G, k, k), `scores` (G, k): of each cluster, about the unknowns at `places`.
    - `places` (G, k): indices of these unknowns.
    - `of_priors` (n, n): the information of priors, which belong to no cluster.
    """

    information: np.ndarray
    scores: np.ndarray
    places: np.ndarray
    of_priors: np.ndarray


def clustered(
    problem: Problem, point: Unknowns, at: Linearization, directions: np.ndarray, by_label: bool = True
) -> Clusters | None:
    """The clusters of `clusters_of`. None if there are too few.

    Their unknowns are those that clusters share, followed by the unconstrained parameters along directions (p, k).
    Unknowns of only one cluster are eliminated: trial unknowns, and initial states of windows. Priors of shared
    unknowns belong to no cluster.
    """
    kind, G = clusters_of(problem, at, by_label)
    if not kind:
        return None
    blocks, owner, measured = at.blocks, np.asarray(problem.windows.trial), problem.active_windows
    (p, k), W, n_b, n_z = directions.shape, len(owner), blocks.n_b, blocks.n_z
    of_b = owner[:, None] * n_b + np.arange(n_b)
    of_z = len(problem.trials) * n_b + np.arange(W * n_z).reshape(W, n_z)

    def squares(rows: np.ndarray) -> np.ndarray:
        """Information (..., c, c) about the shared unknowns and along the directions, bordered by the scores."""
        rows = np.concatenate([rows[..., : -p - 1], rows[..., -p - 1 : -1] @ directions, rows[..., -1:]], axis=-1)
        return rows.mT @ rows

    if kind == "part":
        data, shared = squares(blocks.triangles.astype(float)), np.column_stack([of_z, of_b])
        used = measured[:, None] & np.any(data[:, :-1], axis=(2, 3))
        data, of_priors = data[:, :-1], data[:, -1]
    else:
        clusters, shared = owner, np.zeros((len(problem.trials), 0), int)
        if kind == "window":  # treat each as a trial; trial unknowns are shared
            clusters, shared = np.arange(W, dtype=np.int32), of_b
            priors = jnp.pad(blocks.priors, ((0, 0), (n_b, 0)))
            blocks = Blocks(blocks.R, priors, jnp.asarray(clusters[:, None]), n_z, 0, 0)
        data = squares(eliminate(blocks, 0.0).R.astype(float))
        of_priors, n = np.zeros_like(data), shared.shape[1]
        rows = nuisance_prior_rows(problem, point)[0]
        np.add.at(of_priors, clusters, squares(rows[:, rows.shape[1] - n :, -n - p - 1 :]))
        data, used = (data - of_priors)[:, None], np.isin(np.arange(len(data)), clusters[measured])[:, None]
    if kind.startswith(LABEL):  # all trials with the same value are one cluster
        trials, values = (np.array([*x]) for x in zip(*kinds_of(problem)[1].items(), strict=True))
        sums = np.zeros((G, *data.shape[1:]))
        np.add.at(sums, values, data[trials])
        data, used, shared, of_priors = sums, np.full((G, 1), True), shared[:G], of_priors[:G]
    first = int(shared.max(initial=-1)) + 1
    places = np.column_stack([shared, np.tile(np.arange(first, first + k), (len(shared), 1))])
    P = np.zeros((first + k, first + k))
    np.add.at(P, (places[:, :, None], places[:, None, :]), of_priors[:, :-1, :-1])
    P[first:, first:] += squares(np.asarray(at.blocks.priors, float))[:-1, :-1]
    return Clusters(data[used][:, :-1, :-1], data[used][:, :-1, -1], places[np.nonzero(used)[0]], P)


def bootstrap_steps(clusters: Clusters, rng: np.random.Generator, n: int) -> np.ndarray:
    """Linearized changes of the unknowns (n, n_unknowns) in n bootstrap draws.

    Each draw resamples the clusters with the multiplicities w_g, and the priors with their own standard deviations
    (e_P):

        - (sum_g w_g N_g + P)^-1 (sum_g (w_g - 1) s_g + e_P)
    """
    G, m = len(clusters.places), len(clusters.of_priors)
    information, scores = np.zeros((G, m, m)), np.zeros((G, m))
    g = np.arange(G)[:, None]
    information[g[:, :, None], clusters.places[:, :, None], clusters.places[:, None, :]] = clusters.information
    scores[g, clusters.places] = clusters.scores
    weights = rng.multinomial(G, np.full(G, 1 / G), size=n)
    values, V = np.linalg.eigh(clusters.of_priors)
    of_priors = rng.standard_normal((n, m)) * np.sqrt(np.maximum(values, 0.0)) @ V.T
    N = clusters.of_priors + np.einsum("rg,gij->rij", weights, information)
    scale = np.sqrt(np.maximum(np.diagonal(information.sum(axis=0) + clusters.of_priors), np.finfo(float).tiny))
    inverse = np.linalg.pinv(N / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    return -np.einsum("rij,rj->ri", inverse, ((weights - 1) @ scores + of_priors) / scale) / scale


def nuisance_prior_rows(problem: Problem, point: Unknowns) -> tuple[np.ndarray, int]:
    """The rows (W, n_z + n_b, n) of the priors of initial states and trial unknowns, and their number.

    The columns are those of a window's block [z, z_next, b, x, r]. Rows without a prior are zero.
    """
    windows, nuisance, measured = problem.windows, problem.model.nuisance, problem.active_windows
    owner = np.asarray(windows.trial)
    z, b = np.asarray(point.window_starts, float), np.asarray(point.trial_unknowns, float)[owner]
    of_trial = np.asarray(windows.first) & np.isin(owner, owner[measured])
    counted = [(of_trial if nuisance.has_defects else measured, z), (of_trial, b)]
    counted = np.concatenate([np.tile(c[:, None], values.shape[1]) for c, values in counted], axis=1)
    deviations = np.asarray(jnp.concatenate([nuisance.start_deviation, nuisance.trial_deviation]), float)
    counted &= np.isfinite(deviations)
    n_z, n_next = z.shape[1], z.shape[1] if nuisance.has_defects else 0
    slopes = np.insert(np.diag(1.0 / deviations), [n_z] * n_next, 0.0, axis=1)
    slopes = np.pad(slopes, ((0, 0), (0, point.parameters.size)))
    slopes = np.broadcast_to(slopes, (len(owner), *slopes.shape))
    rows = np.concatenate([slopes, (np.hstack([z, b]) / deviations)[..., None]], axis=2)
    return counted[..., None] * rows, int(counted.sum())


def prior_information(
    problem: Problem, point: Unknowns, eliminated: Eliminated
) -> tuple[np.ndarray, float, int, float]:
    """The information of all priors of a problem whose linearization at the point is `eliminated`.

    **Returns:** (information, determined, number, squares).

    - information (p, p): about the unconstrained parameters, including priors of initial states and trial unknowns,
        which depend on the parameters.
    - determined: number of initial states and trial unknowns that priors determine. It is fractional if the data
        contribute.
    - number: number of priors.
    - squares: sum of their squared residuals.
    """
    (of_nuisance, number), parameters = nuisance_prior_rows(problem, point), problem.parameters
    blocks, p, determined = eliminated.blocks, parameters.size, 0.0
    # The standard deviations of distributions over groups are relative to that of the residuals, so these are treated
    # as data if the residuals are rescaled.
    parameters = parameters.with_deviations(np.full(len(parameters.distributions), np.inf))
    rows = parameters.prior_rows(point.parameters).astype(float)
    number += int(np.isfinite(parameters.prior_terms[2]).sum())
    information, squares = rows[:, :-1].T @ rows[:, :-1], np.sum(rows[:, -1] ** 2)
    if of_nuisance.any():
        still, *moved = (eliminated.back_substitute(x) for x in np.eye(p + 1, p, -1, dtype=point.parameters.dtype))
        z, b = (np.array([new - old for new in news]).T for *news, old in zip(*moved, still, strict=True))  # by x
        follow = np.concatenate([z.swapaxes(0, 1), b.swapaxes(0, 1)[np.asarray(problem.windows.trial)]], axis=1)
        places = [*range(blocks.n_z), *range(blocks.n_z + blocks.n_next, of_nuisance.shape[2] - p - 1)]
        J = of_nuisance[:, :, places] @ follow
        information += np.einsum("wmi,wmj->ij", J, J)
        # d log det (N + e P) / de = tr (P N^-1), of initial states and trial unknowns
        e = float(jnp.finfo(blocks.R.dtype).eps) ** (1 / 3)
        R = np.linalg.qr(np.concatenate([np.asarray(blocks.R), e**0.5 * of_nuisance], axis=1), mode="r")
        with_more = eliminate(eqx.tree_at(lambda blocks: blocks.R, blocks, R.astype(blocks.R.dtype)), 0.0)
        determined = (with_more.log_determinant - eliminated.log_determinant) / e
    return information, determined, number, float(squares + np.sum(of_nuisance[:, :, -1] ** 2))


def intervals(parameters: Parameters, x: Numbers, half: np.ndarray) -> dict[str, tuple[float, float]]:
    """By name, intervals with the half-widths `half` (p,) around the parameters at x (p,), truncated at the bounds."""
    values = np.asarray(parameters.values(x))
    ends = np.clip([values - half, values + half], *np.expand_dims(parameters.bounds.T, 1))
    return {name: (float(low), float(high)) for name, low, high in zip(parameters.names, *ends, strict=True)}


# By name of the trial and of the channel, samples (n_t,).
ByTrial = dict[str, dict[str, np.ndarray]]


def check_level(level: float) -> None:
    """**Raises:** `ValueError` if `level` is not a probability between 0 and 1."""
    if not 0 < real_number(level, "`level`") < 1:
        raise ValueError(f"`level` must be a probability between 0 and 1, such as 0.95 or 0.05, got {level}.")


def t_quantile(level: float, degrees_of_freedom: float) -> float:
    """Two-sided quantile of Student's distribution. NaN without a degree of freedom."""
    check_level(level)
    return float(special.stdtrit(degrees_of_freedom, 0.5 * (1 + level))) if degrees_of_freedom > 0 else float("nan")


def by_trial(problem: Problem, simulated: np.ndarray) -> ByTrial:
    """Simulated measurements of windows (W, n_c, n_t), joined by trial and channel. NaN outside the windows."""
    joined = [
        {channel: np.full(trial.t.shape, np.nan) for channel in problem.channels if channel in trial.measured}
        for trial in problem.trials
    ]
    for y, (owner, first, n) in zip(simulated, problem.slices, strict=True):
        for channel, series in joined[owner].items():
            series[first : first + n] = y[problem.channels.index(channel), :n]
    for series in (series for channels in joined for series in channels.values()):
        series.flags.writeable = False  # cached results depend on it
    return dict(zip(trial_names(problem.trials), joined, strict=True))


def variance_accounted_for(measured: Sequence[np.ndarray], fitted: Sequence[np.ndarray]) -> float:
    """1 - sum (y - fit)^2 / sum (y - mean y)^2 over the samples that the fit uses, with the mean of each series. NaN
    for constant measurements."""
    used = [(y[both], f[both]) for y, f in zip(measured, fitted, strict=True) for both in [np.isfinite(y + f)]]
    left = sum(np.sum((f - y) ** 2) for y, f in used)
    total = sum(np.sum((y - np.mean(y)) ** 2) for y, _ in used if y.size)
    return float(1 - left / total) if total > 0 else float("nan")


def autocorrelations(series: Iterable[np.ndarray], n: int) -> np.ndarray:
    """Autocorrelations of the lags 1 to n, over all series (n_t,) together.

    It is the mean product of residuals, divided by their mean square. Gaps (NaN) are removed first, so successive
    measurements are neighbours.
    """
    measured = [r[np.isfinite(r)] for r in series]
    square = sum(float(r @ r) for r in measured) / max(sum(r.size for r in measured), 1)

    pairs = np.array([sum(max(r.size - lag, 0) for r in measured) for lag in range(1, n + 1)])
    products = np.array([sum(float(r[lag:] @ r[:-lag]) for r in measured) for lag in range(1, n + 1)])
    return products / np.maximum(pairs, 1) / (square or 1.0)


def serial_correlation(residuals: ByTrial) -> dict[str, float]:
    """By channel, the correlation c of an autoregression whose mean has the same variance; 0 for white residuals.

        (1 + c) / (1 - c) = 1 + 2 sum_l (1 - l / (L + 1)) rho_l,   L = 1, 2, 4 ... a quarter of a trial, at most 400

    The L with the largest sum is used (Newey and West, Econometrica 55, 1987). Residuals are white if no sum is
    significant (approximately chi^2) and the Ljung-Box test does not reject. Channels are tested separately, because
    one correlated channel of four is not detected in their mean. Many lags are needed: a slow error of 0.4 sigma gives
    a correlation of only 0.14 between neighbours, but contributes to all lags.
    """
    by_channel: dict[str, list[np.ndarray]] = {}
    for name, r in ((name, r[np.isfinite(r)]) for channels in residuals.values() for name, r in channels.items()):
        by_channel.setdefault(name, []).append(r)
    correlations = {}
    for name, series in by_channel.items():
        n = sum(r.size for r in series)
        most = int(min(max(n / len(series) / 4, 1), 400))
        rho, lags = autocorrelations(series, most), np.arange(1, most + 1)
        # Few lags detect brief errors, many lags detect slow ones.
        weights = [np.maximum(1 - lags / (L + 1), 0.0) for L in (*2 ** np.arange(int(np.log2(most)) + 1), most)]
        more = np.array([2 * w @ rho for w in weights])
        freedom, few = np.array([0.5 * max(n, 1) / (w @ w) for w in weights]), min(most, 20)
        box = special.chdtrc(few, n * rho[:few] @ rho[:few])
        p = *special.chdtrc(freedom, np.maximum(1 + more, 0.0) * freedom), box  # a negative argument gives NaN
        is_white = min(p) > 3e-4
        correlations[name] = 0.0 if is_white else float(max(more.max() / (2 + more.max()), rho[0], 0.01))
    return correlations


@dataclasses.dataclass(frozen=True)
class ResidualTest:
    """Tests of the residuals of one channel of one trial.

    - `n`: number of samples.
    - `mean`, `rms`: of the residuals, in units of `sigma`.
    - `variance_accounted_for`: 1 - sum (y - fit)^2 / sum (y - mean y)^2. Below zero is worse than a constant.
    - `autocorrelation`: of neighbours.
    - `ljung_box`: p-value of the Ljung-Box test for autocorrelation (1978), with ten lags or a fifth of the samples.
    - `runs`: p-value of the runs test for too few or too many sign changes (Wald and Wolfowitz 1940).
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
        """Whether neither test rejects white residuals at the 1 % level."""
        return self.ljung_box > 0.01 and self.runs > 0.01


def residual_test(measured: np.ndarray, fitted: np.ndarray, residual: np.ndarray) -> ResidualTest:
    """Tests of one channel (n_t,). NaN is a gap."""
    finite = np.isfinite(residual)
    r = residual[finite]
    if r.size < 2:
        return ResidualTest(int(r.size), *[float("nan")] * 6)
    lags = autocorrelations([r], max(1, min(10, r.size // 5)))
    # The Ljung-Box test divides by the number of samples, not by the number of pairs.
    box = (r.size + 2) / r.size * np.sum(lags**2 * (r.size - np.arange(1, lags.size + 1)))
    return ResidualTest(
        n=int(r.size),
        mean=float(r.mean()),
        rms=float(np.sqrt(np.mean(r**2))),
        variance_accounted_for=variance_accounted_for([measured[finite]], [fitted[finite]]),
        autocorrelation=float(lags[0]),
        ljung_box=float(special.chdtrc(lags.size, box)),
        runs=runs_test(r),
    )


def runs_test(r: np.ndarray) -> float:
    """Two-sided p-value of the number of runs of one sign (Wald and Wolfowitz 1940)."""
    up = r > 0
    n1, n2 = int(up.sum()), int((~up).sum())
    if min(n1, n2) == 0:
        return 0.0 if r.size > 10 else 1.0
    n, runs = n1 + n2, 1 + int(np.sum(up[1:] != up[:-1]))
    mean = 1 + 2 * n1 * n2 / n
    variance = (mean - 1) * (mean - 2) / (n - 1)
    return float(2 * special.ndtr(-abs(runs - mean) / np.sqrt(variance))) if variance > 0 else 1.0


def effective_sample_fraction(correlation: float) -> float:
    """(1 - c) / (1 + c): effective number of independent residuals per residual, as in an autoregression."""
    return (1 - correlation) / (1 + correlation)


def f_test(drop: float, k: int, cost: float, degrees_of_freedom: float, correlation: float) -> float:
    """p-value of the decrease `drop` of a sum of squares to `cost` by k parameters (Fisher's F). The null hypothesis is
    that these are zero.
    """
    if degrees_of_freedom <= 0 or k == 0 or not drop > 0:
        return 1.0
    share = effective_sample_fraction(correlation)
    ratio = share * drop / k / max(cost / degrees_of_freedom, 1e-300)
    return float(special.fdtrc(k, max(share * degrees_of_freedom, 1.0), ratio))


def wald_test(step: np.ndarray, variance: np.ndarray, degrees_of_freedom: np.ndarray) -> float:
    """p-value of estimates (q,) whose true values are all zero: Student's t of each, with Bonferroni's correction.

    Hotelling's test of all of them together rejects too often if few trials contain most information: up to 12 % at a
    level of 5 %.
    """
    p = 2 * special.stdtr(degrees_of_freedom, -np.abs(step) / np.sqrt(variance))
    return float(min(1.0, len(step) * p.min()))


def predicts_as_well(better: np.ndarray, other: np.ndarray) -> bool:
    """Whether a model with the held-out costs `other` (K,) of K folds predicts as well as one with lower costs in sum.

    Two conditions, with the 95 % quantile q of Student's t and the standard deviation s over folds:

        sum_k log(other_k / better_k) <= q s(log(other / better)) K^1/2
        sum_k (other_k - better_k) <= min(q s(better) (2 K)^1/2, sum_k better_k)

    The first is a paired test in which no fold can dominate. In a test of the differences, one very bad fold increases
    the standard error by more than the mean. The second limits the difference by the noise of two independent sums of
    the better model, and to a factor of two.
    """
    difference, K = float(np.sum(other - better)), len(better)
    if difference <= 1e-9 * np.sum(better):  # equivalent models differ only by rounding errors
        return True
    if not (math.isfinite(difference) and np.min(better) > 0 and np.min(other) > 0):
        return False
    q, ratios = t_quantile(0.95, K - 1), np.log(other / better)
    noise = q * np.std(better, ddof=1) * (2 * K) ** 0.5
    is_paired = np.sum(ratios) <= q * np.std(ratios, ddof=1) * K**0.5
    return bool(is_paired and difference <= min(noise, np.sum(better)))


def log_likelihood(problem: Problem, cost: float) -> float:
    """-cost/2 with the normalizing constants of the densities of the measurements."""
    if problem.model.has_likelihood:
        return -0.5 * cost
    weight = np.asarray(problem.windows.weight, float)
    return -0.5 * cost + float(np.sum(np.log(weight[weight > 0]) - 0.5 * math.log(2 * math.pi)))


def degrees_of_freedom(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """The degrees of freedom (p,) of Student's t distribution of each estimate. They are few for a mean of few groups.

        2 V^2 / var(V),   var(V) = (dV/da)^T cov(a) dV/da

    V is the variance of an estimate. a contains the logarithms of the distributions' standard deviations and of the
    residual variance (Satterthwaite; Giesbrecht and Burns, Two-stage analysis based on a mixed model, Biometrics 41,
    1985).
    """
    parameters, M = problem.parameters, np.column_stack(eliminate(at.blocks, 0.0).rows).astype(float)
    rows = parameters.prior_rows(point.parameters)[parameters.size :].astype(float)
    scale = np.linalg.norm(M, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    parts = [(rows[begin:end] / scale).T @ (rows[begin:end] / scale) for _, begin, end in parameters.distributions]
    data, nu = (M / scale).T @ (M / scale) - sum(parts), problem.size[0] - problem.size[1]
    q = np.array([end - begin for _, begin, end in parameters.distributions])
    to_values = np.asarray(parameters.slopes(point.parameters), float) / scale[:-1]
    s = len(parts)

    def inverse(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """H^-1, the optimal x, and the information from each distribution."""
        weighed = [np.exp(-2 * log) * part for log, part in zip(a[:s], parts, strict=True)]
        N = data + sum(weighed)
        H = np.linalg.pinv(N[:-1, :-1], rcond=1e-14, hermitian=True)
        return H, np.append(-H @ N[:-1, -1], 1.0), weighed

    def gradient(a: np.ndarray) -> np.ndarray:
        """The gradient of minus twice the restricted log likelihood."""
        H, x, weighed = inverse(a)
        cost = x @ (data + sum(weighed)) @ x
        own = [2 * (n - np.sum(H * P[:-1, :-1]) - np.exp(-a[s]) * (x @ P @ x)) for n, P in zip(q, weighed, strict=True)]
        return np.array([*own, nu - np.exp(-a[s]) * cost])

    H, x, weighed = inverse(np.zeros(s + 1))
    best = np.append(np.zeros(s), np.log(x @ (data + sum(weighed)) @ x / nu))
    steps = 1e-4 * np.eye(s + 1)
    hessian = np.array([(gradient(best + h) - gradient(best - h)) / 2e-4 for h in steps])
    # The pseudo-inverse excludes a distribution whose standard deviation is zero: its groups do not differ.
    covariance = 2 * np.linalg.pinv((hessian + hessian.T) / 2, rcond=1e-4, hermitian=True)
    variance = np.einsum("ki,ij,kj->k", to_values, H, to_values)
    slopes = [2 * np.einsum("ki,ij,kj->k", to_values, H @ P[:-1, :-1] @ H, to_values) for P in weighed]
    slopes = np.array([*slopes, variance])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.minimum(2 * variance**2 / np.einsum("ap,ab,bp->p", slopes, covariance, slopes), nu)
