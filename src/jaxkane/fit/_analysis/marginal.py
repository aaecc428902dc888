"""How likely measurements are once starts and biases are integrated out, and the noise that makes them most so.

What a filter says of a trial that is disturbed, windows that are linked say by their log-determinant. Knows fits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
import scipy.optimize

from ..._common.lookup import as_names, refuse_unknown
from .._data.trial import Trial
from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.steps import uninterrupted
from .._problem.arguments import refuse_other
from .._problem.blocks import eliminate
from .._problem.problem import Problem
from .._result.result import Fit
from .laplace import LOG_2PI, log_likelihood, log_nuisance_priors

SMALLEST = 1e-4
"""By what factor a deviation may fall, or its inverse may rise, from where the search begins."""


def marginal_likelihood(fit: Fit) -> float:
    """The logarithm of the density of the measurements, with the parameters as they were found; starts, jumps between
    windows, biases and gains are integrated out.

        log p = -1/2 sum of squares + log priors - 1/2 log det (J^T J / 2 pi)

    with J by the starts of all windows and the trials' unknowns. With process noise that is what its filter computes.
    Of windows as short as the samples, linked by `continuity`, both are the same number where the motion is linear and
    the noise of a step is that of the links. Starts and biases without a deviation have a density of one per unit.

    **Raises:** `TypeError` for what is no `Fit`.
    """
    refuse_other(fit, Fit, "marginal_likelihood", "marginal_likelihood(fit(...))")
    problem, priors = fit.problem, float(np.sum(np.asarray(fit.parameters.prior_residuals(fit.point.x)) ** 2))
    eliminated = eliminate(fit.linearization.blocks, 0.0)
    number = sum(int(np.count_nonzero(x)) for x in eliminated.informed)
    volume = 0.5 * number * LOG_2PI - 0.5 * float(eliminated.log_determinant)
    return log_likelihood(problem, fit.cost - priors) + log_nuisance_priors(problem) + volume


def find_continuity(fit: Fit, sigma: Sequence[str] = ()) -> Fit:
    """A fit of linked windows with the `continuity`, and the `sigma` of the channels that are named, for which the
    measurements are most likely: how much a motion is disturbed, and how well it was measured, found and not given.

        found = find_continuity(fit(..., window=0.1, continuity={"roll_rate": 0.1}), sigma=("roll",))
        found.problem.specification.continuity

    The deviations are varied by the simplex of Nelder and Mead, each from what was given; for each the parameters are
    found anew. Those of `sigma` are multiplied by one factor in all trials. For noise in continuous time, whatever the
    rate of the samples, fit with `noise` instead.

    **Returns:** the `Fit` with these deviations: of another `problem`, whose trials have the `sigma` that was found.

    **Raises:** `ValueError` for windows that are not linked, or a channel that is not measured.
    """
    refuse_other(fit, Fit, "find_continuity", "find_continuity(fit(..., continuity={...}))")
    problem = fit.problem
    links = dict(problem.specification.continuity or {})
    if not links:
        raise ValueError("find_continuity: no windows are linked here: give `window`, and `continuity` to begin with.")
    sigma = as_names(sigma)
    refuse_unknown(sigma, problem.channels, "find_continuity: `sigma` names")
    now, limit = fit, -np.log(SMALLEST)

    def cost(x: np.ndarray) -> float:
        nonlocal now
        x = np.clip(x, -limit, limit)
        now = _again(_scaled(problem, links, sigma, np.exp(x)), now)
        return -2 * marginal_likelihood(now)

    start = np.zeros(len(links) + len(sigma))
    simplex = np.vstack([start, start + 0.7 * np.eye(start.size)])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4}
    best = scipy.optimize.minimize(cost, start, method="Nelder-Mead", options=options)
    factors = np.exp(np.clip(best.x, -limit, limit))
    continuity = {name: float(x * factor) for (name, x), factor in zip(links.items(), factors, strict=False)}
    of_channels = dict(zip(sigma, factors[len(links) :], strict=True))
    trials = [_with_sigma(trial, of_channels) for trial in problem.trials]
    return _again(Problem.posed(dataclasses.replace(problem.specification, continuity=continuity), trials), now)


def _again(problem: Problem, near: Fit) -> Fit:
    return uninterrupted(minimize(problem, LeastSquares(rtol=1e-9), start=near.point))


def _scaled(problem: Problem, links: dict[str, float], sigma: Sequence[str], factors: np.ndarray) -> Problem:
    """The same problem with deviations multiplied by factors, those of links first; nothing is compiled anew."""
    jump, weight = problem.model.nuisance.jump, problem.windows.weight
    for name, factor in zip(links, factors, strict=False):
        i = problem.model.nuisance.start.index(name)
        jump = jump.at[i].multiply(float(factor))
    for name, factor in zip(sigma, factors[len(links) :], strict=True):
        weight = weight.at[:, problem.channels.index(name)].divide(float(factor))
    model = eqx.tree_at(lambda m: m.nuisance.jump, problem.model, jump)
    return dataclasses.replace(problem, model=model, windows=eqx.tree_at(lambda w: w.weight, problem.windows, weight))


def _with_sigma(trial: Trial, factors: dict[str, float]) -> Trial:
    sigma = {name: x * factors.get(name, 1.0) for name, x in trial.sigma.items()}
    return Trial(trial.t, trial.measured, trial.inputs, sigma=sigma, initial=trial.initial, name=trial.name)
