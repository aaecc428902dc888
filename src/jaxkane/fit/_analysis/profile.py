"""Profile likelihoods: one parameter held at values, all others found anew. Knows least squares."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..._common.lookup import hint
from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.steps import uninterrupted
from .._problem.arguments import refuse_other
from .._result.result import Fit


@dataclasses.dataclass(frozen=True)
class Profile:
    """The sum of squares with one parameter held at values (n,), all others found anew.

    `interval`: where `costs` exceed their minimum by no more than chance does at `level`, with the quantile and the
    errors of `Fit.intervals`; infinite on a side where they do not come so far. A parabola has the interval of
    `Fit.intervals`.
    """

    name: str
    values: np.ndarray
    costs: np.ndarray
    level: float
    interval: tuple[float, float]
    estimates: tuple[dict[str, float], ...]


def profile(fit: Fit, name: str, *, n: int = 9, span: float | None = None, level: float = 0.95) -> Profile:
    """The profile likelihood of one parameter: no assumption that the problem is linear between the ends.

    **Arguments:** `name`; `n`: values, half on either side of the estimate; `span`: how many formal standard errors to
    either side, by default half as far again as the interval reaches; `level` of the interval.

    **Raises:** `ValueError` for a name that is not free, or a parameter that the data do not determine.
    """
    refuse_other(fit, Fit, "profile", "profile(fit(...), name)")
    if name not in fit.names:
        raise ValueError(f"{name} is not free; {hint(name, fit.names, 'free are')}")
    if n < 3 or not (span is None or 0 < span < np.inf):
        raise ValueError(f"A profile has three values at least over a positive span, got n = {n}, span = {span}.")
    error, best = fit.standard_errors[name], fit.estimates[name]
    if not np.isfinite(error):
        raise ValueError(f"These data do not determine {name}: {fit.message}.")
    if span is None:
        low, high = fit.intervals(level)[name]
        span = 0.75 * (high - low) / error
    i = fit.names.index(name)
    prior = float(fit.parameters.prior_mean[i]), float(fit.parameters.prior_deviation[i])
    values, found = best + span * error * np.linspace(-1, 1, n | 1), {}
    for side in (values[values >= best], values[values < best][::-1]):
        point = fit.point
        for value in side:
            pinned = fit.problem.with_priors({name: (float(value), 1e-4 * error)})
            try:
                start = pinned.at({name: float(value)}, point)
                there = uninterrupted(minimize(pinned, LeastSquares(rtol=1e-5), start=start))
            except ValueError:  # outside its bounds, or nothing that can be simulated
                break
            if there.status != "converged":
                break
            pin = (there.estimates[name] - value) / (1e-4 * error)
            cost = there.cost - pin**2 + ((there.estimates[name] - prior[0]) / prior[1]) ** 2
            found[float(value)], point = (cost, there.estimates), there.point
    if not found:
        raise ValueError(f"{name}: no fit converges with it held at {best:.6g} or near: {fit.message}.")
    values = np.array(sorted(found))
    costs = np.array([found[v][0] for v in values])
    # The cost rises by one at the error that `sigma` as it was given would leave.
    limit = costs.min() + (fit.quantile(level) * fit.errors[name] / fit.identifiability.given_errors[i]) ** 2
    return Profile(name, values, costs, level, _crossings(values, costs, limit), tuple(found[v][1] for v in values))


def _crossings(values: np.ndarray, costs: np.ndarray, limit: float) -> tuple[float, float]:
    """Where the costs rise above the limit on both sides of their minimum."""
    least, ends = int(np.argmin(costs)), []
    # The root of what a cost exceeds its minimum by is linear where the cost is a parabola.
    height, wanted = np.sqrt(costs - costs[least]), np.sqrt(limit - costs[least])
    for beyond, infinite in ((range(least, -1, -1), -np.inf), (range(least, len(values)), np.inf)):
        order = list(beyond)
        above = next((k for k in order if height[k] > wanted), None)
        if above is None:
            ends.append(infinite)
            continue
        inside = order[order.index(above) - 1]
        share = (wanted - height[inside]) / (height[above] - height[inside])
        ends.append(float(values[inside] + share * (values[above] - values[inside])))
    return ends[0], ends[1]
