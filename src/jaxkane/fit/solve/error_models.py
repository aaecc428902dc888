"""Estimation of error models together with the parameters: block coordinate ascent on the joint likelihood."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..problem.model import Unknowns
from ..problem.problem import Problem
from ..result.diagnostics import AT_A_MINIMUM
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
    """The problem with error models that are estimated from the residuals at a point."""
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
