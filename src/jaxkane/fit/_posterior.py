"""The posterior of a fit: its density for samplers, Laplace's approximation, and the evidence of a model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._block_lsq import Eliminated, eliminate
from ._linearize import half_cost
from ._model import Unknowns
from ._problem import Problem, refuse_other
from ._result import Fit

LOG_2PI = math.log(2 * math.pi)


def log_density(problem: Problem, *, over: str = "values") -> Callable[[Unknowns], Array]:
    """The logarithm of the posterior density, up to a constant, as a function of `Unknowns`.

        log p = -1/2 cost + log |det d values / d x|

    `Unknowns` are unconstrained numbers only, so a sampler may go anywhere: parameters stay inside their bounds, and
    bodies possible. Priors are part of the cost; `sigma` is taken as it was given, unless a factor of it is free. It
    may be differentiated once, in either mode (`jax.grad`, `jax.jvp`).

        density = log_density(fit.problem)
        blackjax.nuts(density, ...)                                       # starts from fit.point
        numpyro.infer.NUTS(potential_fn=lambda point: -density(point))    # init_params=fit.point

    **Arguments:**

    - `problem`: a `Problem`, such as `fit.problem`.
    - `over`: "values": where there is no prior, all values of a parameter are as likely; "x": all its free numbers are,
        as all orders of magnitude of a positive one.

    **Returns:** a function of `Unknowns`; minus infinity where nothing can be simulated.
    """
    if over not in ("values", "x"):
        raise ValueError(f"`over` is 'values' or 'x', got {over!r}.")
    refuse_other(problem, Problem, "log_density", "log_density(fit.problem)")
    cost = half_cost(problem.model, problem.windows, problem.by_trial)

    def density(point: Unknowns) -> Array:
        log_p = -cost(point)
        if over == "values":
            log_p = log_p + problem.parameters.log_determinant(point.x)
        return jnp.where(jnp.isfinite(log_p), log_p, -jnp.inf)

    return density


@dataclasses.dataclass(frozen=True)
class Laplace:
    """A Gaussian for the posterior of the free numbers x, at the fit's minimum.

    - `mean` (p,), `covariance` (p, p): of x.
    - `log_evidence`: the logarithm of the density of the measurements, all unknowns integrated out. Twice the
        difference of two models' is what a prior's width (Occam's factor) leaves of the difference of their costs.
    - `message`: why there is no evidence where it is NaN, in words; else empty.
    """

    fit: Fit
    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float
    message: str = ""

    def sample(self, n: int, seed: int = 0) -> dict[str, np.ndarray]:
        """Parameters (n,) by name, in their units: never outside their bounds."""
        if not isinstance(n, (int, np.integer)) or n < 0:
            raise ValueError(f"`n` is how many are drawn, a whole number that is not negative; got {n!r}.")
        rng = np.random.default_rng(seed)
        x = jnp.asarray(rng.multivariate_normal(self.mean, self.covariance, size=n), self.fit.point.x.dtype)
        values = np.asarray(jax.vmap(self.fit.parameters.values)(x))
        return dict(zip(self.fit.names, values.T, strict=True))


def laplace(fit: Fit) -> Laplace:
    """The Laplace approximation: `sigma` is taken as it was given, priors count, nuisance values are integrated out.

        log evidence = log p(measurements | unknowns) + log p(unknowns) + 1/2 log det(2 pi C)

    at the minimum, with C the covariance of all unknowns in their own units: of parameters in theirs, so that neither
    `Free.scale` nor the choice of bounds for the search's sake changes it (MacKay, Bayesian interpolation, Neural
    Computation 4, 1992). Exact where the motion is linear in all unknowns.

    What a parameter's prior is: the Gaussian it was given, cut off at its bounds; without one, with two `bounds`, the
    uniform density between them; else it is improper, and the evidence is NaN. Starts and biases without a standard
    deviation have a density of one per unit: compare only models that have the same of these, or give deviations.

    **Raises:** `ValueError` that names the parameters that the data do not determine (nothing bounds their posterior),
    and for a fit that is not at a minimum.
    """
    refuse_other(fit, Fit, "laplace", "laplace(fit(...))")
    undetermined = [name for name, error in fit.standard_errors.items() if np.isinf(error)]
    if undetermined:
        raise ValueError(
            f"These data do not determine {', '.join(undetermined)}: give a prior, or leave something out."
        )
    eliminated = eliminate(fit.linearization.blocks, 0.0)
    to_gain = fit.linearization.squares - eliminated.step(1e-9)[1]
    if fit.status == "validated" or not to_gain < 0.1:
        raise ValueError(
            f"This is no minimum ({fit.status}): a step would lower the sum of squares by {to_gain:.3g}. Go on with "
            "`minimize(fit.problem, LeastSquares(), start=fit.point)`."
        )
    s = np.linalg.svd(np.asarray(eliminated.rows[0], float), compute_uv=False)
    log_prior, message = _log_priors(fit)
    message = message or _undetermined_nuisance(fit.problem, eliminated)
    evidence = log_likelihood(fit.problem, fit.cost) + log_prior + _log_volume(fit, eliminated, s)
    covariance = fit.identifiability.covariance_of_x
    return Laplace(fit, np.asarray(fit.point.x), covariance, math.nan if message else evidence, message)


def log_likelihood(problem: Problem, cost: float) -> float:
    """-cost/2 with the constants of the measurements' densities, so that they integrate to one."""
    if problem.model.noise is not None:
        return -0.5 * cost
    weight = np.asarray(problem.windows.weight, float)
    return -0.5 * cost + float(np.sum(np.log(weight[weight > 0]) - 0.5 * LOG_2PI))


def _log_priors(fit: Fit) -> tuple[float, str]:
    """The logarithm of all priors' densities, but for the squares in the cost; and what is improper, in words."""
    constants = fit.parameters.log_prior_constants
    improper = [name for name, constant in zip(fit.names, constants, strict=True) if np.isnan(constant)]
    total = float(constants.sum()) + log_nuisance_priors(fit.problem)
    if not improper:
        return total, ""
    return total, (
        f"No evidence: without a prior, or both bounds, any value of {', '.join(improper)} is as likely as any other, "
        "and no data are expected more than others. Give `prior` or `bounds`."
    )


def log_nuisance_priors(problem: Problem) -> float:
    """Of starts, links of windows and trials' unknowns, the logarithm of their densities, but for the squares."""
    n, total = problem.model.nuisance, 0.0
    counts = (  # how many densities of each nuisance value there are, whose squares are in the cost
        (n.start_deviation, np.asarray(problem.windows.first).sum() if n.has_defects else len(problem.slices)),
        (n.trial_deviation, np.asarray(problem.windows.first).sum()),
        (n.defect_std, np.asarray(problem.windows.linked).sum()),
    )
    for deviations, count in counts:
        known = np.asarray(deviations, float)[np.isfinite(deviations)]
        total -= float(count) * float(np.sum(np.log(known) + 0.5 * LOG_2PI))
    return total


def _log_volume(fit: Fit, eliminated: Eliminated, s: np.ndarray) -> float:
    """1/2 log det(2 pi C) of all unknowns in their units; those that have no density at all are left out."""
    z, b = eliminated.informed
    number = s.size + np.count_nonzero(z) + np.count_nonzero(b)
    log_information = 2 * np.sum(np.log(s)) + eliminated.log_determinant
    to_units = float(fit.parameters.log_determinant(fit.point.x))
    return 0.5 * number * LOG_2PI - 0.5 * log_information + to_units


def _undetermined_nuisance(problem: Problem, eliminated: Eliminated) -> str:
    """The starts and biases that have neither data nor a prior, in words: nothing bounds their posterior."""
    z, b = eliminated.informed  # (T, m, n_z), (T, n_b)
    counts, n = np.append(problem.active_windows, False)[np.asarray(problem.by_trial)], problem.model.nuisance  # (T, m)
    names = [name for j, name in enumerate(n.start) if np.any(counts & ~z[..., j])]
    names += [" ".join(pair) for j, pair in enumerate(n.trial) if np.any(counts.any(axis=1) & ~b[:, j])]
    if not names:
        return ""
    return f"No evidence: the data do not determine {', '.join(names)} of every window. Give a standard deviation."


def marginal_likelihood(fit: Fit) -> float:
    """The logarithm of the density of the measurements, with the parameters as they were found; starts, jumps between
    windows, biases and gains are integrated out.

        log p = -1/2 sum of squares + log priors - 1/2 log det (J^T J / 2 pi)

    with J by the starts of all windows and the trials' unknowns. With process noise that is what its filter computes.
    Of windows as short as the samples, linked by `defect_std`, both are the same number where the motion is linear and
    the noise of a step is that of the links. Starts and biases without a deviation have a density of one per unit.

    **Raises:** `TypeError` for what is no `Fit`.
    """
    refuse_other(fit, Fit, "marginal_likelihood", "marginal_likelihood(fit(...))")
    problem, priors = fit.problem, float(np.sum(np.asarray(fit.parameters.prior_residuals(fit.point.x)) ** 2))
    eliminated = eliminate(fit.linearization.blocks, 0.0)
    number = sum(map(np.count_nonzero, eliminated.informed))
    volume = 0.5 * number * LOG_2PI - 0.5 * eliminated.log_determinant
    return log_likelihood(problem, fit.cost - priors) + log_nuisance_priors(problem) + volume
