"""The posterior of a fit: Laplace's approximation, and the evidence of a model."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..problem.problem import Problem
from ..solve.blocks import Eliminated, eliminate
from .statistics import log_likelihood

LOG_2PI = math.log(2 * math.pi)


@dataclasses.dataclass(frozen=True)
class Laplace:
    """A Gaussian approximation of the posterior of the unconstrained parameters x, at the minimum of the fit.

    - `fit`: the fit.
    - `mean` (p,), `covariance` (p, p): of x.
    - `log_evidence`: log density of the measurements, with all unknowns integrated out. Twice the difference between
        two models is the difference of their costs, corrected for the widths of the priors (Occam's factor).
    - `message`: why the evidence is NaN, otherwise empty.
    """

    fit: Any
    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float
    message: str = ""

    def __repr__(self) -> str:
        text = f"Laplace(log_evidence={self.log_evidence:.6g}, parameters: {', '.join(self.fit.names)})"
        return f"{text}\n{self.message}".strip()

    def sample(self, n: int, seed: int = 0) -> dict[str, np.ndarray]:
        """Draw parameters from the posterior.

        **Arguments:**

        - `n`: number of draws.
        - `seed`: seed of the random generator.

        **Returns:** by name, values (n,) in the parameter's unit. They are always inside its bounds.
        """
        if not isinstance(n, (int, np.integer)) or n < 0:
            raise ValueError(f"`n` must be an integer that is not negative, got {n!r}.")
        rng = np.random.default_rng(seed)
        x = jnp.asarray(rng.multivariate_normal(self.mean, self.covariance, size=n), self.fit.point.parameters.dtype)
        values = np.asarray(jax.vmap(self.fit.parameters.values)(x))
        return dict(zip(self.fit.names, values.T, strict=True))


def laplace(fit: Any) -> Laplace:
    """See `Fit.laplace`."""
    undetermined = [name for name, error in fit.standard_errors.items() if np.isinf(error)]
    if undetermined:
        raise ValueError(f"These data do not determine {', '.join(undetermined)}. Add a prior, or omit it from `free`.")
    eliminated = eliminate(fit.linearization.blocks, 0.0)
    to_gain = fit.linearization.squares - eliminated.step(1e-9)[1]
    if fit.status == "validated" or not to_gain < 0.1:
        raise ValueError(
            f"The fit has not converged ({fit.status}): a step would lower the sum of squares by {to_gain:.3g}. "
            "Continue with `minimize(fit.problem, LeastSquares(), start=fit.point)`."
        )
    s = np.linalg.svd(np.asarray(eliminated.rows[0], float), compute_uv=False)
    log_prior, message = _log_priors(fit)
    message = message or _undetermined_nuisance(fit.problem, eliminated)
    evidence = log_likelihood(fit.problem, fit.cost) + log_prior + _log_volume(fit, eliminated, s)
    covariance = fit.identifiability.covariance_of_x
    return Laplace(fit, np.asarray(fit.point.parameters), covariance, math.nan if message else evidence, message)


def _log_priors(fit: Any) -> tuple[float, str]:
    """Log density of all priors, without the squares that are in the cost, and a sentence about improper priors."""
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
    """Log density of initial states, links of windows and trial unknowns, without the squares that are in the cost."""
    n, total = problem.model.nuisance, 0.0
    counts = (  # number of densities of each nuisance parameter
        (n.start_deviation, np.asarray(problem.windows.first).sum() if n.has_defects else len(problem.slices)),
        (n.trial_deviation, np.asarray(problem.windows.first).sum()),
        (n.defect_std, np.asarray(problem.windows.linked).sum()),
    )
    for deviations, count in counts:
        known = np.asarray(deviations, float)[np.isfinite(deviations)]
        total -= float(count) * float(np.sum(np.log(known) + 0.5 * LOG_2PI))
    return total


def _log_volume(fit: Any, eliminated: Eliminated, s: np.ndarray) -> float:
    """1/2 log det(2 pi C) of all unknowns in their units. Unknowns without any information are left out."""
    z, b = eliminated.informed
    number = s.size + np.count_nonzero(z) + np.count_nonzero(b)
    log_information = 2 * np.sum(np.log(s)) + eliminated.log_determinant
    to_units = float(fit.parameters.log_determinant(fit.point.parameters))
    return 0.5 * number * LOG_2PI - 0.5 * log_information + to_units


def _undetermined_nuisance(problem: Problem, eliminated: Eliminated) -> str:
    """A sentence about initial states and trial unknowns with neither data nor a prior. Their posterior is improper."""
    z, b = eliminated.informed  # (T, m, n_z), (T, n_b)
    counts, n = np.append(problem.active_windows, False)[np.asarray(problem.by_trial)], problem.model.nuisance  # (T, m)
    names = [name for j, name in enumerate(n.window_names) if np.any(counts & ~z[..., j])]
    names += [name for j, name in enumerate(n.trial_names) if np.any(counts.any(axis=1) & ~b[:, j])]
    if not names:
        return ""
    return f"No evidence: the data do not determine {', '.join(names)} of every window. Pass a standard deviation."


def marginal_likelihood(fit: Any) -> float:
    """See `Fit.marginal_likelihood`."""
    problem, at = fit.problem, fit.linearization
    eliminated = eliminate(at.blocks, 0.0)
    number = sum(map(np.count_nonzero, eliminated.informed))
    volume = 0.5 * number * LOG_2PI - 0.5 * eliminated.log_determinant
    return log_likelihood(problem, fit.cost - at.prior_squares) + log_nuisance_priors(problem) + volume
