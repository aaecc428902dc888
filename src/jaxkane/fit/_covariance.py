"""Covariances of estimates, formal and cluster-robust; the information of priors; confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from ._block_lsq import Blocks, Eliminated, eliminate
from ._linearize import Linearization
from ._model import Unknowns
from ._parameters import Parameters
from ._problem import Problem


def formal_covariance(inverse: np.ndarray, of_priors: np.ndarray, variance: float) -> np.ndarray:
    """B (v D + P) B,   B = (D + P)^-1   (p, p)

    of unknowns with the information D from data whose residuals have the variance v, and P from priors, which are
    measurements with known deviations. `inverse`: B.
    """
    return variance * inverse + (1.0 - variance) * inverse @ of_priors @ inverse


def jackknife_covariance(
    information: np.ndarray, scores: np.ndarray, places: np.ndarray, of_priors: np.ndarray
) -> np.ndarray:
    """(G - 1) / G sum_g d_g d_g^T + B P B,   d_g = (N - N_g)^-1 s_g,   B = N^-1,   N = sum_g N_g + P   (n, n)

    The cluster-robust covariance, valid whatever correlates inside a cluster. d_g is what leaving out the cluster g
    moves, linearized (the jackknife; CR3 of Bell and McCaffrey 2002): a sandwich without it is too small where a
    cluster has much influence.

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
    """A covariance (p, p) with an infinite variance of every parameter that has a part in one of these directions
    (k, p), which nothing determines; its covariances with the others are NaN."""
    infinite = np.any(np.abs(directions) > 1e-5, axis=0)
    covariance = np.where(infinite[:, None] | infinite[None, :], np.nan, covariance)
    covariance[infinite, infinite] = np.inf
    return covariance


def enough_clusters(clusters: int, parameters: int) -> bool:
    """Whether so many clusters determine how parameters scatter."""
    return clusters >= parameters + 2


def clusters_of(problem: Problem) -> tuple[str, int]:
    """Within what residuals are taken to be correlated, and how many there are: trials, where these are more than the
    parameters by two; else windows, where these start freely and are more by two; ("", 0) where neither is.

    Windows of one trial have its biases in common, and whatever else differs from trial to trial: errors by window do
    not see that.
    """
    p = len(problem.parameters.names)
    if enough_clusters(problem.clusters, p):
        return "trial", problem.clusters
    windows, nuisance = int(problem.active_windows.sum()), problem.model.nuisance
    if enough_clusters(windows, p) and windows > problem.clusters and not nuisance.has_defects:
        return "window", windows
    return "", 0


class Clusters(NamedTuple):
    """What clusters of data say about n unknowns: the `information` (G, k, k) and the `scores` (G, k) of each, about
    those at `places` (G, k); `of_priors` (n, n): the information of priors, which are part of no cluster."""

    information: np.ndarray
    scores: np.ndarray
    places: np.ndarray
    of_priors: np.ndarray


def clustered(problem: Problem, point: Unknowns, at: Linearization, directions: np.ndarray) -> Clusters | None:
    """The clusters of `clusters_of`, about biases that they share and, at the end, about the free numbers along
    directions (p, k); None where there are too few. What every cluster has of its own is eliminated: by trial its
    starts and biases, by window its start. The priors of parameters, and by window those of biases, are part of no
    cluster."""
    kind, _ = clusters_of(problem)
    if not kind:
        return None
    blocks, owner, measured = at.blocks, np.asarray(problem.windows.trial), problem.active_windows
    clusters, n_own = owner, 0
    if kind == "window":  # each a trial of its own, whose biases are shared with others
        clusters, n_own = np.arange(len(owner), dtype=np.int32), blocks.n_b
        blocks = Blocks(blocks.R, jnp.asarray(clusters[:, None]), blocks.n_z, 0, 0)
    p, k = directions.shape

    def squares(rows: np.ndarray) -> np.ndarray:
        """Of clusters, information (G, c, c) about what is shared and along the directions, bordered by the scores."""
        rows = np.concatenate([rows[..., : -p - 1], rows[..., -p - 1 : -1] @ directions, rows[..., -1:]], axis=-1)
        return rows.mT @ rows

    data = squares(eliminate(blocks, 0.0).R.astype(float))
    of_priors = np.zeros_like(data)
    np.add.at(of_priors, clusters, squares(prior_rows(problem, point)[0][:, -n_own - p :, -n_own - p - 1 :]))
    n = len(problem.trials) * n_own + k
    places = np.tile(np.arange(n - k, n), (len(data), 1))
    if kind == "window":
        places = np.column_stack([owner[:, None] * n_own + np.arange(n_own), places])
    P = np.zeros((n, n))
    np.add.at(P, (places[:, :, None], places[:, None, :]), of_priors[:, :-1, :-1])
    used, data = np.unique(clusters[measured]), data - of_priors
    return Clusters(data[used, :-1, :-1], data[used, :-1, -1], places[used], P)


def cluster_robust_covariance(
    problem: Problem, point: Unknowns, at: Linearization, directions: np.ndarray
) -> np.ndarray:
    """The cluster-robust covariance (k, k) along directions (p, k) of the free numbers; NaN where clusters are too
    few."""
    clusters, k = clustered(problem, point, at, directions), directions.shape[1]
    return np.full((k, k), np.nan) if clusters is None else jackknife_covariance(*clusters)[-k:, -k:]


def bootstrap_steps(clusters: Clusters, rng: np.random.Generator, n: int) -> np.ndarray:
    """By how much the unknowns (n, n_unknowns) move, linearized, where as many clusters are drawn at random, each as
    often as the weights w_g say, and priors e_P are measured again with their own deviations:

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


def prior_rows(problem: Problem, point: Unknowns) -> tuple[np.ndarray, int]:
    """The rows (W, n_z + n_b + p, n) of all priors in the columns of a window's block [z, z_next, b, x, r], zero where
    there is none, and how many there are."""
    parameters, windows, nuisance = problem.parameters, problem.windows, problem.model.nuisance
    measured, owner = problem.active_windows, np.asarray(windows.trial)
    z, b, x = (np.asarray(u, float) for u in (point.z, point.b, parameters.prior_residuals(point.x)))
    of_trial = np.asarray(windows.first) & np.isin(owner, owner[measured])
    counts = (of_trial if nuisance.has_defects else measured, of_trial, np.asarray(windows.very_first))
    deviations = [np.asarray(d, float) for d in (nuisance.start_deviation, nuisance.trial_deviation)]
    residuals = (z / deviations[0], b[owner] / deviations[1], np.broadcast_to(x, (len(owner), len(x))))
    deviations.append(np.asarray(parameters.prior_deviation, float))
    of_x = np.asarray(parameters.slopes(point.x), float) / deviations[2][:, None]
    slopes = np.asarray(scipy.linalg.block_diag(*(np.diag(1.0 / d) for d in deviations[:2]), of_x))
    n_z, n_next = z.shape[1], z.shape[1] if nuisance.has_defects else 0
    slopes = np.insert(slopes, [n_z] * n_next, 0.0, axis=1)
    known = np.isfinite(np.concatenate(deviations))
    counted = np.concatenate([np.tile(c[:, None], r.shape[1]) for c, r in zip(counts, residuals, strict=True)], axis=1)
    counted &= known
    slopes = np.broadcast_to(slopes, (len(owner), *slopes.shape))
    rows = np.concatenate([slopes, np.hstack(residuals)[..., None]], axis=2)
    return counted[..., None] * rows, int(counted.sum())


class PriorInformation(NamedTuple):
    """All priors together.

    - `information` (p, p): about the free numbers, starts and biases following them.
    - `determined`: how many of the starts and biases they determine and not the data, a share where both do.
    - `number`: of them; `squares`: the sum of their squared residuals.
    """

    information: np.ndarray
    determined: float
    number: int
    squares: float


def prior_information(problem: Problem, point: Unknowns, eliminated: Eliminated) -> PriorInformation:
    """Of a problem whose linearization at the point has been `eliminated`."""
    (rows, number), blocks, p = prior_rows(problem, point), eliminated.blocks, point.x.shape[0]
    of_x, of_nuisance, determined = rows[:, -p:, -p - 1 : -1], rows[:, :-p], 0.0
    information = np.einsum("wmi,wmj->ij", of_x, of_x)
    if of_nuisance.any():
        still, *moved = (eliminated.back_substitute(x) for x in np.eye(p + 1, p, -1, dtype=point.x.dtype))
        z, b = (np.array([new - old for new in news]).T for *news, old in zip(*moved, still, strict=True))  # by x
        follow = np.concatenate([z.swapaxes(0, 1), b.swapaxes(0, 1)[np.asarray(problem.windows.trial)]], axis=1)
        places = [*range(blocks.n_z), *range(blocks.n_z + blocks.n_next, rows.shape[2] - p - 1)]
        J = of_nuisance[:, :, places] @ follow
        information += np.einsum("wmi,wmj->ij", J, J)
        # d log det (N + e P) / de = tr (P N^-1), of starts and biases
        e = float(jnp.finfo(blocks.R.dtype).eps) ** (1 / 3)
        R = np.linalg.qr(np.concatenate([np.asarray(blocks.R), e**0.5 * of_nuisance], axis=1), mode="r")
        with_more = eliminate(eqx.tree_at(lambda blocks: blocks.R, blocks, R.astype(blocks.R.dtype)), 0.0)
        determined = (with_more.log_determinant - eliminated.log_determinant) / e
    return PriorInformation(information, determined, number, float(np.sum(rows[:, :, -1] ** 2)))


def intervals(parameters: Parameters, x: Array, half: np.ndarray) -> list[tuple[float, float]]:
    """Around every parameter an interval of half the width `half` (p,), which ends at its bounds."""
    values = np.asarray(parameters.values(x))
    ends = np.clip([values - half, values + half], *np.expand_dims(parameters.bounds.T, 1))
    return [(float(low), float(high)) for low, high in ends.T]
