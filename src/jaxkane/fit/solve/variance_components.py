"""Standard deviations that are estimated together with the parameters: of distributions over groups, and of errors."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import numpy as np
import scipy.linalg
from scipy import optimize

from ..._scalarjit.compat import on_device
from ..problem.model import Unknowns
from ..problem.problem import Problem
from ..result.diagnostics import AT_A_MINIMUM
from .blocks import eliminate, triangle
from .linearization import Linearization
from .local_unknowns import moved, usable
from .optimizers import Iterate, proposed

ROUNDS = 50
SETTLED = 1e-8
"""The change of minus twice the log likelihood in one round below which the search ends. It corresponds to a change of
the estimates by about 1e-4 standard errors."""
SMALL_GAIN = 0.01
"""The largest remaining gain at which the search has converged: a tenth of a standard error."""


def estimate_errors(problem: Problem, best: Iterate, status: str, history: list[float]) -> tuple[Problem, Iterate, str]:
    """Alternate between estimating the error models from the residuals and a step of all other unknowns.

    Parameters of the mean and of the covariance are orthogonal in the information matrix, so a few rounds are enough.
    Oberhofer and Kmenta (Econometrica 42, 1974) prove convergence to a stationary point of the joint likelihood. Each
    step is a step of Fisher scoring.

    **Arguments:**

    - `problem`: the problem with the initial error models.
    - `best`: the best iterate of the search with the initial error models.
    - `status`: the status of this search. If it has not converged, the error models are estimated only once.
    - `history`: the list to which the cost of every round is appended.

    **Returns:** the problem with the estimated error models, the iterate, and the status.
    """
    at = best.at if best.at is not None else problem.linearize(best.point)
    if at is None or not usable(at):
        return problem, best, status
    converged, point, ending = status in AT_A_MINIMUM, best.point, "steps"
    try:
        for _ in range(ROUNDS if converged else 1):
            before, estimated = at.cost, _with_estimated_errors(problem, at)
            again = estimated.linearize(point)
            assert again is not None  # the initial states exist, because they do not depend on error models
            gain = proposed(estimated, again, 0.0).gain
            problem, (point, at) = estimated, _step(estimated, point, again) if converged else (point, again)
            best = dataclasses.replace(best, point=point, cost=at.cost, at=at)
            history.append(at.cost)
            rounding = 1e2 * float(np.finfo(at.blocks.R.dtype).eps) * (abs(at.cost) + at.squares)
            if abs(at.cost - before) <= max(SETTLED, rounding):
                ending = status if gain <= max(SMALL_GAIN, rounding) else "stuck"
                break
    except KeyboardInterrupt:
        ending = "interrupted"
    return problem, best, ending if converged else status


def _with_estimated_errors(problem: Problem, at: Linearization) -> Problem:
    assert problem.model.errors is not None
    windows = problem.windows
    weight, measured = np.asarray(windows.weight), np.asarray(windows.measured)
    difference = np.where(weight > 0, (np.asarray(at.simulated) - measured) * weight, 0.0)
    # The scale needs a lower limit: residuals of simulated data are rounding errors, whose likelihood has no maximum.
    size = np.sqrt(np.sum((measured * weight) ** 2, axis=(0, 2)) / np.maximum(np.sum(weight > 0, axis=(0, 2)), 1))
    smallest = np.maximum(1e3 * np.finfo(weight.dtype).eps * size, np.finfo(weight.dtype).tiny ** 0.25)
    errors = problem.model.errors.estimated(difference, weight, smallest)
    return dataclasses.replace(problem, model=dataclasses.replace(problem.model, errors=errors))


def _step(problem: Problem, point: Unknowns, at: Linearization) -> tuple[Unknowns, Linearization]:
    """One step of Fisher scoring, damped if it does not reduce the cost. If no step does, the point is unchanged."""
    for damping in (0.0, 0.1, 1.0, 10.0):
        step = proposed(problem, at, damping)
        tried = moved(point, step.x, step.eliminated)
        there = problem.linearize(tried)
        if there is not None and usable(there) and there.cost <= at.cost:
            return tried, there
        if step.gain <= SMALL_GAIN:  # integration errors hide such a small gain
            break
    return point, at


def estimated_deviations(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """The standard deviations (n,) of all distributions, in standard deviations of a residual.

    The restricted likelihood of the model, linearized at the point, is maximized (Lindstrom and Bates, Nonlinear mixed
    effects models for repeated measures data, Biometrics 46, 1990). Up to a constant, minus twice its logarithm is

        nu log C + log det H + 2 sum_j q_j log d_j

    C is the minimum sum of squares for given standard deviations d_j. H is the information about all unknowns. q_j is
    the number of groups. nu is the number of measurements minus the number of unknowns without a distribution. The
    variance of a residual is estimated together with them, as C / nu.
    """
    parameters = problem.parameters
    # With infinite standard deviations, the rows of the distributions are zero. `criterion` adds them with its own.
    infinite, one = (parameters.with_deviations(np.full(len(parameters.distributions), d)) for d in (np.inf, 1.0))
    other_priors = on_device(infinite.prior_rows(point.parameters))
    blocks = eqx.tree_at(lambda blocks: blocks.priors, at.blocks, other_priors)
    data = triangle(np.column_stack(eliminate(blocks, 0.0).rows).astype(float))
    p = parameters.size
    rows = one.prior_rows(point.parameters)[p:].astype(float)
    places = [slice(begin, end) for _, begin, end in parameters.distributions]
    q = np.array([s.stop - s.start for s in places])
    scale = np.linalg.norm(np.concatenate([data, rows]), axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    nu = problem.size[0] - problem.size[1]

    def criterion(logs: np.ndarray) -> tuple[float, np.ndarray]:
        weighed = [np.exp(-log) * rows[s] for log, s in zip(logs, places, strict=True)]
        R = triangle(np.concatenate([data, *weighed]) / scale)
        cost = float((R[p, p] * scale[p]) ** 2)
        to_x = scipy.linalg.solve_triangular(R[:p, :p], np.eye(p), check_finite=False)
        x = -to_x @ R[:p, p]
        value = nu * np.log(cost) + 2 * np.sum(np.log(np.abs(R.diagonal()[:p]))) + 2 * q @ logs
        slopes = []
        for one, number in zip(weighed, q, strict=True):
            A, r = one[:, :p] / scale[:p], one[:, p] / scale[p]
            explained = np.sum((A @ to_x) ** 2)  # tr H^-1 A^T A
            slopes.append(2 * (number - explained - nu * np.sum((A @ x + r) ** 2) * scale[p] ** 2 / cost))
        return float(value), np.array(slopes)

    lower, upper = _limits(data[:p, :p], rows, places)
    along = np.linspace(lower, upper, 41)  # start from a grid: the criterion may be flat far from the minimum
    start = min(along, key=lambda logs: criterion(logs)[0])
    found = optimize.minimize(
        criterion, start, jac=True, method="L-BFGS-B", bounds=[*zip(lower, upper, strict=True)],
        options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 200},
    )  # fmt: skip
    return np.exp(found.x)


def _limits(R: np.ndarray, rows: np.ndarray, places: list[slice]) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of the logarithms of the standard deviations.

    The lower bound is a thousandth of the smallest standard error of a group: the groups do not differ. At the upper
    bound, the groups do not shrink towards the mean.
    """
    covariance = np.linalg.pinv(R.T @ R)
    ends = []
    for s in places:
        A, r = rows[s, :-1], rows[s, -1]
        error = np.sqrt(np.einsum("ki,ij,kj->k", A, covariance, A))
        error = error[error > 0] if np.any(error > 0) else np.ones(1)
        ends.append((np.log(1e-3 * error.min()), np.log(1e3 * (error.max() + np.abs(r).max()))))
    return np.array(ends).T[0], np.array(ends).T[1]


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
