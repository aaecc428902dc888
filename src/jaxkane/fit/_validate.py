"""Parameters on trials that they were not estimated from: cross validation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._scalarjit.compat import on_device
from ._block_lsq import Blocks
from ._covariance import intervals
from ._fit import minimize, uninterrupted
from ._linearize import Linearization
from ._model import Unknowns
from ._nuisance import Unsimulated, solve_nuisance
from ._optimizers import LeastSquares
from ._problem import Problem, refuse_other
from ._result import Fit
from ._statistics import folds_of, t_quantile, trial_names
from ._tables import Rows, text_table
from ._trial import Trial

MOST_ADDED_SAMPLES = 100_000
"""Of windows that count nothing: to simulate so many some times takes as long as to compile a program without them."""


def validate(fit: Fit, trials: Sequence[Trial] | Trial, *, progress: bool = False) -> Fit:
    """The parameters of a fit on other trials, of which only starts and biases are estimated (held-out data).

        jk.fit.validate(result, validation_trials).variance_accounted_for

    The trials are simulated one by one, by the program of the fit where they are no longer than its own, else by one
    that is compiled for all of them. `progress`: a bar.

    **Returns:** a `Fit` of these trials, with the status "validated": its `cost`, `variance_accounted_for`, `tests` and
    report are those of these trials; its parameters were not fitted to them, and have no errors (NaN). Trials that
    cannot be simulated with these parameters are left out: `failed` says by name why, and so do the `notes`.

    **Raises:** `ValueError` as `fit` does, for trials that do not suit the system, and where none can be simulated.
    """
    refuse_other(fit, Fit, "validate", "validate(fit(...), trials)")
    problem = Problem.with_first_steps(fit.problem.specification, trials)
    names, failed, room = trial_names(problem), {}, fit.problem.windows.shape
    if room.windows * room.samples * len(names) > MOST_ADDED_SAMPLES:
        room = None
    while True:
        validated = {}
        ones = tqdm(problem.by_trials(room), disable=not progress, desc="validation", unit=" trial")
        for name, one in zip(names, ones, strict=True):
            try:
                validated[name] = _validated(fit, one)
            except Unsimulated as error:
                failed[name] = error.reasons[0]
        if not validated:
            name, why = next(iter(failed.items()))
            raise ValueError(f"None of these trials can be simulated with these parameters: {name}, {why}.")
        if len(validated) == len(names):
            return dataclasses.replace(_joined(fit, problem, [*validated.values()]), failed=failed)
        kept = [one.problem.trials[0] for one in validated.values()]
        problem, names = Problem.with_first_steps(fit.problem.specification, kept), tuple(validated)


def _validated(fit: Fit, problem: Problem) -> Fit:
    """Of one trial. **Raises:** `Unsimulated` where its motion cannot be followed with these parameters."""
    first = dataclasses.replace(problem.start, x=fit.point.x)
    if problem.chooses_steps:
        problem = problem.finer(first)
    point, at = solve_nuisance(problem, first, steps=20, rtol=1e-6)
    try:
        before = solve_nuisance(problem, problem.start)[1].cost
    except Unsimulated:  # with the initial guesses, which is no fault of the fit
        before = float("nan")
    return uninterrupted(Fit.of(problem, point, at, (before, at.cost), "validated", fit.method))


def _joined(fit: Fit, problem: Problem, fits: Sequence[Fit]) -> Fit:
    """One fit of all trials from one of each, of whose windows the last may count nothing."""
    counts = np.bincount(np.asarray(problem.windows.trial))

    def joined(of: Callable[[Fit], Any]) -> Any:
        """Arrays by window (W, ...)."""
        rows = [jax.tree.map(lambda x, n=n: np.asarray(x)[:n], of(one)) for one, n in zip(fits, counts, strict=True)]
        return jax.tree.map(lambda *xs: on_device(np.concatenate(xs)), *rows)

    problem = problem.with_steps(joined(lambda one: one.problem.windows.step))
    b, z = on_device(np.concatenate([one.point.b for one in fits])), joined(lambda one: one.point.z)
    R, prediction = joined(lambda one: (one.linearization.blocks.R, one.linearization.prediction))
    at = Linearization(Blocks.of(problem.model.nuisance, R, problem.by_trial), prediction)
    history = tuple(float(sum(costs)) for costs in zip(*(one.history for one in fits), strict=True))
    errors = np.concatenate([one.step_errors[:n] for one, n in zip(fits, counts, strict=True)])
    return Fit(problem, Unknowns(fit.point.x, b, z), at, errors, history, "validated", fit.method)


@dataclasses.dataclass(frozen=True)
class CrossValidation:
    """Trials left out in turn: sums of squares of each, its own starts and biases estimated with fixed parameters; of
    fits with process noise, minus twice the log likelihoods.

    - `fit`: that of all trials. `trials`: their names; `n`: numbers of residuals; `at_start`, `fitted`, `held_out`
        (T,): with the parameters of the start, of the fit of all, and of the fit of the others; infinite where these
        cannot simulate a trial.
    - `spread` (T,): sums of squares of the measurements about the mean of each channel, in their `sigma`.
    - `estimates`: by parameter, of each fold.
    """

    fit: Fit
    trials: tuple[str, ...]
    n: np.ndarray
    at_start: np.ndarray
    fitted: np.ndarray
    held_out: np.ndarray
    spread: np.ndarray
    estimates: dict[str, np.ndarray]
    cost_name: str = "sum of squares"

    @property
    def score(self) -> float:
        """1 - held out / spread, over all trials: the share of the measurements' variance that parameters from other
        trials account for (the predictive R^2; one is perfect, below zero is worse than a constant). The initial
        guess has no part in it. NaN of likelihoods, which have no zero."""
        if self.cost_name != "sum of squares":
            return float("nan")
        return float(1 - self.held_out.sum() / self.spread.sum())

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """By name, where the estimate from other data lies that are as many as those of one fold: prediction intervals
        by the scatter from fold to fold, inside a parameter's bounds.

            estimate +- t s (1 + 1/K)^1/2,   s: of K estimates,   K estimate - (K - 1) (without the fold)   of each

        t is Student's with K - 1 degrees of freedom. Where a model lacks something, each run has estimates of its own,
        and the next run does not lie in a confidence interval, which is about their mean. Priors are the same for all.
        Infinite, or NaN, where
        the fit's own intervals are. (The pseudo-values are Tukey's, 1958.)

        **Raises:** `ValueError` for a level that is not between 0 and 1.
        """
        without = np.array([self.estimates[name] for name in self.fit.names])
        K = without.shape[1]
        own = K * np.array([*self.fit.estimates.values()])[:, None] - (K - 1) * without
        half = t_quantile(level, K - 1) * np.std(own, axis=1, ddof=1) * (1 + 1 / K) ** 0.5
        errors = np.array([*self.fit.errors.values()])
        half = np.where(np.isfinite(errors), half, errors)
        return dict(zip(self.fit.names, intervals(self.fit.parameters, self.fit.point.x, half), strict=True))

    @property
    def conclusion(self) -> str:
        """How well trials are predicted that a fit has not seen, in words."""
        lost = [name for name, cost in zip(self.trials, self.held_out, strict=True) if not np.isfinite(cost)]
        if lost:
            return f"{', '.join(lost)} cannot be simulated with the parameters of the others."
        if self.cost_name != "sum of squares":
            drop = self.at_start.sum() - self.held_out.sum()
            return f"held out, the {self.cost_name} of all is {drop:.4g} below that of the start."
        return f"held-out score: {100 * self.score:.1f} % of the measurements' variance is accounted for."

    @property
    def rows(self) -> Rows:
        """Of every trial, and of all together; the first row is the head."""
        columns = (self.spread, self.at_start, self.fitted, self.held_out)
        rows = [*zip(self.trials, self.n, *columns, strict=True), ("all", *(c.sum() for c in (self.n, *columns)))]
        cells = [[name, str(n), *(f"{cost:.5g}" for cost in costs)] for name, n, *costs in rows]
        return [("trial left out", "residuals", "spread", "start", "fitted", "held out"), *cells]

    def __str__(self) -> str:
        return f"{text_table(self.rows)}\n{self.conclusion}"


def cross_validate(fit: Fit, folds: int | Sequence[Sequence[int]] | None = None) -> CrossValidation:
    """Cross-validation: fit some of the trials, and predict the others with these parameters.

    **Arguments:** `folds`: how many, or the numbers of the trials that are left out together; by default each trial
    alone, and five folds from eleven trials on.

    **Raises:** `ValueError` with fewer than two trials.
    """
    refuse_other(fit, Fit, "cross_validate", "cross_validate(fit(...))")
    T = len(fit.problem.trials)
    if T < 2:
        raise ValueError("Leaving trials out needs two at least: cut a long one with `Trial.between`.")
    groups = folds_of(folds, T)
    held_out, estimates = np.full(T, np.nan), []
    for group in groups:
        training = fit.problem.only(set(range(T)) - set(group))
        trained = uninterrupted(minimize(training, LeastSquares(), start=fit.point))
        held_out[group] = costs_by_trial(fit.problem, trained.point)[group]
        estimates.append(trained.estimates)
    owner = np.asarray(fit.problem.windows.trial)
    counts = np.sum(np.asarray(fit.problem.windows.weight) > 0, axis=(1, 2))
    return CrossValidation(
        fit=fit,
        trials=fit.trial_names,
        n=np.array([counts[owner == k].sum() for k in range(T)]),
        at_start=costs_by_trial(fit.problem, fit.problem.start),
        fitted=costs_by_trial(fit.problem, fit.point),
        held_out=held_out,
        spread=spread_by_trial(fit.problem),
        estimates={name: np.array([of_fold[name] for of_fold in estimates]) for name in fit.names},
        cost_name=fit.problem.cost_name,
    )


def costs_by_trial(problem: Problem, point: Unknowns) -> np.ndarray:
    """Sums of squares (T,) with these parameters, starts and biases estimated for them.

    With the priors of a trial's starts and biases, and without those of the parameters, which belong to no trial.
    Infinite of trials that cannot be simulated.
    """
    windows = eqx.tree_at(lambda w: w.very_first, problem.windows, jnp.zeros_like(problem.windows.very_first))
    problem = dataclasses.replace(problem, windows=windows)
    try:
        _, at = solve_nuisance(problem, point, rtol=1e-5)
    except Unsimulated as error:
        costs, left = np.full(len(problem.trials), np.inf), np.delete(np.arange(len(problem.trials)), [*error.reasons])
        if left.size:
            left_out = problem.with_trials([problem.trials[k] for k in left])
            costs[left] = costs_by_trial(left_out, dataclasses.replace(left_out.start, x=point.x))
        return costs
    value = at.prediction.cost
    costs = np.sum(np.asarray(at.blocks.R)[:, :, -1] ** 2, axis=1) if value is None else np.asarray(value)
    return np.bincount(np.asarray(problem.windows.trial), costs, minlength=len(problem.trials))


def spread_by_trial(problem: Problem) -> np.ndarray:
    """Sums of squares (T,) of the measurements about the mean of each channel, in their standard deviations: what a
    constant leaves of them."""
    windows, owner = problem.windows, np.asarray(problem.windows.trial)
    y, weight = np.asarray(windows.measured), np.asarray(windows.weight) ** 2  # (W, n_c, n_t)
    spread = []
    for k in range(len(problem.trials)):
        y_k, w_k = y[owner == k], weight[owner == k]
        total = w_k.sum(axis=(0, 2), keepdims=True)
        mean = np.sum(w_k * y_k, axis=(0, 2), keepdims=True) / np.where(total > 0, total, 1.0)
        spread.append(np.sum(w_k * (y_k - mean) ** 2))
    return np.array(spread)
