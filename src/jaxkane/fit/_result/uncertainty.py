"""How far estimates can be trusted: robust errors, profile likelihood, trials left out."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy import stats

from ..._common.lookup import hint
from .._optimize.steps import settle, uninterrupted
from .._problem.blocks import eliminate
from .._problem.model import Point
from .._problem.problem import Problem

if TYPE_CHECKING:
    from .result import Fit


def clustered_covariance(fit: Fit) -> np.ndarray:
    """Covariance (p, p) of the free numbers, robust to residuals that are correlated within a trial.

        B (T / (T - 1) sum_t (A_t^T r_t) (A_t^T r_t)^T + P) B,   B = (A^T A)^-1

    (Liang and Zeger 1986; White's sandwich with a trial as the unit.) The parameters' priors, of information P, are
    measurements of their own with the deviations they were given, and no part of any trial. NaN with fewer trials than
    parameters plus two.
    """
    blocks = np.asarray(eliminate(fit.linearization.blocks, 0.0).R, float)  # (T, p+1, p+1)
    T, p = fit.problem.clusters, len(fit.names)
    if p + 2 > T or not np.all(np.isfinite(fit.covariance)):
        return np.full((p, p), np.nan)
    A, r = blocks[:, :, :-1], blocks[:, :, -1]
    information, scores = np.einsum("tmi,tmj->ij", A, A), np.einsum("tmi,tm->ti", A, r)
    parameters, x = fit.parameters, fit.point.x
    of_prior = np.asarray(parameters.slopes(x), float) / np.asarray(parameters.prior_deviation, float)[:, None]
    # The rows of the priors stand among those of the first window's trial.
    scores[int(fit.problem.windows.trial[0])] -= of_prior.T @ np.asarray(parameters.prior_residuals(x), float)
    bread = np.linalg.inv(information)
    return bread @ (T / (T - 1) * scores.T @ scores + of_prior.T @ of_prior) @ bread


@dataclasses.dataclass(frozen=True)
class Profile:
    """The sum of squares with one parameter held at values (n,), all others found anew.

    `interval`: where `costs` exceed their minimum by no more than chance does at `level`, with the quantile and the
    errors of `Fit.intervals` (where `Fit.robust`, as much more as the clustered error exceeds the formal one);
    infinite on a side where they do not come so far. A parabola has the interval of `Fit.intervals`.
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

    **Raises:** `ValueError` for a name that is not free, or a parameter that the data do not tell.
    """
    from .._optimize.least_squares import least_squares

    if name not in fit.names:
        raise ValueError(f"{name} is not free; {hint(name, fit.names, 'free are')}")
    if n < 3 or not (span is None or 0 < span < np.inf):
        raise ValueError(f"A profile has three values at least over a positive span, got n = {n}, span = {span}.")
    error, best = fit.standard_errors[name], fit.estimates[name]
    if not np.isfinite(error):
        raise ValueError(f"These data do not tell {name}: {fit.message}.")
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
                there = uninterrupted(least_squares(pinned, start=start, rtol=1e-5))
            except ValueError:  # outside its bounds, or nothing that can be simulated
                break
            if there.status != "converged":
                break
            pin = (there.estimates[name] - value) / (1e-4 * error)
            cost = there.cost - pin**2 + ((there.estimates[name] - prior[0]) / prior[1]) ** 2
            found[float(value)], point = (cost, there.estimates), there.point
    values = np.array(sorted(found))
    costs = np.array([found[v][0] for v in values])
    # Where residuals are correlated, chance raises the cost by more than independent ones would.
    inflation = (fit.clustered_errors[name] / error) ** 2 if fit.robust else 1.0
    limit = costs.min() + inflation * fit.variance * fit.quantile(level) ** 2
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


@dataclasses.dataclass(frozen=True)
class CrossValidation:
    """Trials left out in turn: sums of squares of each, its own starts and biases found with the parameters held.

    - `trials`: their names; `n`: numbers of residuals; `at_start`, `fitted`, `held_out` (T,): with the parameters of
        the start, of the fit of all, and of the fit of the others.
    - `estimates`: by parameter, of each fold.
    """

    trials: tuple[str, ...]
    n: np.ndarray
    at_start: np.ndarray
    fitted: np.ndarray
    held_out: np.ndarray
    estimates: dict[str, np.ndarray]

    @property
    def score(self) -> float:
        """The share of the sum of squares at the start that the fit takes away from trials it has not seen."""
        return float(1 - self.held_out.sum() / self.at_start.sum())

    def __str__(self) -> str:
        lines = [f"{'trial':<28}{'residuals':>10}{'start':>12}{'fitted':>12}{'held out':>12}"]
        rows = zip(self.trials, self.n, self.at_start, self.fitted, self.held_out, strict=True)
        lines += [f"{name:<28}{n:>10}{a:>12.5g}{b:>12.5g}{c:>12.5g}" for name, n, a, b, c in rows]
        total = (self.n.sum(), self.at_start.sum(), self.fitted.sum(), self.held_out.sum())
        lines.append("{:<28}{:>10}{:>12.5g}{:>12.5g}{:>12.5g}".format("all", *total))
        lines.append(f"held-out score: {100 * self.score:.1f} % of the start's sum of squares is taken away.")
        return "\n".join(lines)


def cross_validate(fit: Fit, folds: int | Sequence[Sequence[int]] | None = None) -> CrossValidation:
    """Fit some trials and look at the others: does what was found hold where it was not looked for?

    **Arguments:** `folds`: how many, or the numbers of the trials that are left out together; by default each trial
    alone, and five folds from eleven trials on.

    **Raises:** `ValueError` with fewer than two trials.
    """
    from .._optimize.least_squares import least_squares

    T = len(fit.problem.trials)
    if T < 2:
        raise ValueError("Leaving trials out needs two at least: cut a long one with `Trial.between`.")
    if folds is None:
        folds = T if T <= 10 else 5
    groups = _folds(folds, T)
    held, estimates = np.full(T, np.nan), {name: [] for name in fit.names}
    for group in groups:
        others = fit.problem.only(set(range(T)) - set(group))
        found = uninterrupted(least_squares(others, start=fit.point))
        held[group] = costs_by_trial(fit.problem, found.point)[group]
        for name, value in found.estimates.items():
            estimates[name].append(value)
    owner = np.asarray(fit.problem.windows.trial)
    counts = np.asarray(jnp.sum(fit.problem.windows.weight > 0, axis=(1, 2)))
    return CrossValidation(
        trials=fit.trial_names,
        n=np.array([counts[owner == k].sum() for k in range(T)]),
        at_start=costs_by_trial(fit.problem, fit.problem.start),
        fitted=costs_by_trial(fit.problem, fit.point),
        held_out=held,
        estimates={name: np.array(values) for name, values in estimates.items()},
    )


def _folds(folds: int | Sequence[Sequence[int]], T: int) -> list[list[int]]:
    if isinstance(folds, int):
        if not 2 <= folds <= T:
            raise ValueError(f"`folds`: {T} trials can be left out in 2 to {T} parts, not in {folds}.")
        return [list(range(k, T, folds)) for k in range(folds)]
    groups = [[int(k) for k in group] for group in folds]
    if sorted(k for group in groups for k in group) != list(range(T)) or not all(groups) or len(groups) < 2:
        raise ValueError(f"`folds` must leave out each of the trials 0 to {T - 1} once, in two groups at least.")
    return groups


def costs_by_trial(problem: Problem, point: Point) -> np.ndarray:
    """Sums of squares (T,) with these parameters, starts and biases found for them.

    With the priors of a trial's starts and biases, and without those of the parameters, which belong to no trial.
    """
    windows = eqx.tree_at(lambda w: w.very_first, problem.windows, jnp.zeros_like(problem.windows.very_first))
    problem = dataclasses.replace(problem, windows=windows)
    _, at = settle(problem, point, rtol=1e-5)
    costs = np.sum(np.asarray(at.blocks.R)[:, :, -1] ** 2, axis=1)
    return np.bincount(np.asarray(problem.windows.trial), costs, minlength=len(problem.trials))


def t_quantile(level: float, freedom: int) -> float:
    """Two-sided, of Student's distribution; NaN without a degree of freedom."""
    if not 0 < level < 1:
        raise ValueError(f"`level` is a probability between 0 and 1, such as 0.95; got {level}.")
    return float(stats.t.ppf(0.5 * (1 + level), freedom)) if freedom > 0 else float("nan")
