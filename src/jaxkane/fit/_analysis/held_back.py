"""Parameters on trials that they were not found from: trials left out in turn, or measured later."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._data.trial import Trial
from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.steps import solve_nuisance, uninterrupted
from .._problem.arguments import refuse_other
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.result import Fit


def applied_to(fit: Fit, trials: Sequence[Trial] | Trial) -> Fit:
    """The parameters of a fit on other trials, of which only starts and biases are found (held-out data).

        jk.fit.applied_to(result, others).variance_accounted_for

    **Returns:** a `Fit` of these trials, with the status "applied": its `cost`, `variance_accounted_for`, `tests` and
    report are those of these trials.

    **Raises:** `ValueError` as `fit` does, for trials that do not suit the system or cannot be simulated.
    """
    refuse_other(fit, Fit, "applied_to", "applied_to(fit(...), trials)")
    problem = fit.problem.with_trials(trials)
    first = dataclasses.replace(problem.start, x=fit.point.x)
    if problem.chooses_steps:
        problem = problem.finer(first)
    before = solve_nuisance(problem, problem.start)[1].cost
    point, at = solve_nuisance(problem, first, steps=20, rtol=1e-6)
    return Fit.of(problem, point, at, (before, at.cost), "applied", fit.method)


@dataclasses.dataclass(frozen=True)
class CrossValidation:
    """Trials left out in turn: sums of squares of each, its own starts and biases found with the parameters held; of
    fits with process noise, minus twice the log likelihoods.

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
    cost_name: str = "sum of squares"

    @property
    def score(self) -> float:
        """The share of the sum of squares at the start that the fit takes away from trials it has not seen; NaN of
        likelihoods, which have no zero."""
        if self.cost_name != "sum of squares":
            return float("nan")
        return float(1 - self.held_out.sum() / self.at_start.sum())

    @property
    def verdict(self) -> str:
        """By how much a fit lowers the sum of squares of trials that it was not fitted to, in words."""
        if self.cost_name != "sum of squares":
            less = self.at_start.sum() - self.held_out.sum()
            return f"held out, the {self.cost_name} of all is {less:.4g} below that of the start."
        return f"held-out score: {100 * self.score:.1f} % of the start's sum of squares is taken away."

    def __str__(self) -> str:
        lines = [f"{'trial':<28}{'residuals':>10}{'start':>12}{'fitted':>12}{'held out':>12}"]
        rows = zip(self.trials, self.n, self.at_start, self.fitted, self.held_out, strict=True)
        lines += [f"{name:<28}{n:>10}{a:>12.5g}{b:>12.5g}{c:>12.5g}" for name, n, a, b, c in rows]
        total = (self.n.sum(), self.at_start.sum(), self.fitted.sum(), self.held_out.sum())
        lines.append("{:<28}{:>10}{:>12.5g}{:>12.5g}{:>12.5g}".format("all", *total))
        lines.append(self.verdict)
        return "\n".join(lines)


def cross_validate(fit: Fit, folds: int | Sequence[Sequence[int]] | None = None) -> CrossValidation:
    """Cross-validation: fit some of the trials, and predict the others with the parameters that were found.

    **Arguments:** `folds`: how many, or the numbers of the trials that are left out together; by default each trial
    alone, and five folds from eleven trials on.

    **Raises:** `ValueError` with fewer than two trials.
    """
    refuse_other(fit, Fit, "cross_validate", "cross_validate(fit(...))")
    T = len(fit.problem.trials)
    if T < 2:
        raise ValueError("Leaving trials out needs two at least: cut a long one with `Trial.between`.")
    if folds is None:
        folds = T if T <= 10 else 5
    groups = folds_of(folds, T)
    held, estimates = np.full(T, np.nan), {name: [] for name in fit.names}
    for group in groups:
        others = fit.problem.only(set(range(T)) - set(group))
        found = uninterrupted(minimize(others, LeastSquares(), start=fit.point))
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
        cost_name=fit.problem.cost_name,
    )


def folds_of(folds: int | Sequence[Sequence[int]], T: int) -> list[list[int]]:
    if isinstance(folds, int):
        if not 2 <= folds <= T:
            raise ValueError(f"`folds`: {T} trials can be left out in 2 to {T} parts, not in {folds}.")
        return [list(range(k, T, folds)) for k in range(folds)]
    groups = [[int(k) for k in group] for group in folds]
    if sorted(k for group in groups for k in group) != list(range(T)) or not all(groups) or len(groups) < 2:
        raise ValueError(f"`folds` must leave out each of the trials 0 to {T - 1} once, in two groups at least.")
    return groups


def costs_by_trial(problem: Problem, point: Unknowns) -> np.ndarray:
    """Sums of squares (T,) with these parameters, starts and biases found for them.

    With the priors of a trial's starts and biases, and without those of the parameters, which belong to no trial.
    """
    windows = eqx.tree_at(lambda w: w.very_first, problem.windows, jnp.zeros_like(problem.windows.very_first))
    problem = dataclasses.replace(problem, windows=windows)
    _, at = solve_nuisance(problem, point, rtol=1e-5)
    value = at.seen.value
    costs = np.sum(np.asarray(at.blocks.R)[:, :, -1] ** 2, axis=1) if value is None else np.asarray(value)
    return np.bincount(np.asarray(problem.windows.trial), costs, minlength=len(problem.trials))
