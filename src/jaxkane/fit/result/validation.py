"""Validation of parameters on trials that they were not estimated from: validation, cross-validation, prediction; and
comparison of fits.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from ..._common.lookup import hint, positive_number, refuse, refuse_unknown
from ..._scalarjit.compat import on_device
from ..._system.system import System
from ..problem.declarations import Free, leaf_names
from ..problem.model import Unknowns
from ..problem.problem import Problem, finer
from ..problem.specification import ProblemSpec, parameters_of, refuse_other, with_options
from ..problem.trial import Trial, as_trials, trial_names
from ..problem.windows import state_names
from ..solve.fit import search, uninterrupted, with_distributions
from ..solve.linearization import Blocks, Linearization
from ..solve.optimizers import LeastSquares, Unsimulated, solve_nuisance
from .data import Rows, Tables, html_tables, text_table, text_tables
from .diagnostics import AT_A_MINIMUM, STATUS, implausible, plausible_of
from .fit_result import Fit
from .linearized import trial_folds
from .statistics import LARGEST_LEVERAGE, intervals, t_quantile

if TYPE_CHECKING:
    import pandas as pd

# Largest number of samples of padding windows, which have zero weight. Simulating this many samples a few times takes
# as long as compiling a program without padding.
MOST_ADDED_SAMPLES = 100_000


@with_options
def validate(fit: Fit | System, trials: Sequence[Trial] | Trial, **options: Any) -> Fit:
    """Predict trials with fixed parameters. Only initial states and trial unknowns (offsets, gains, delays) are
    estimated.

        jk.fit.validate(result, validation_trials).variance_accounted_for
        jk.fit.validate(system, trials, unknown=("roll",))   # the parameter values of the system

    **Arguments:**

    - `fit`: a `Fit`, whose estimates and options are used, or a `System`, whose parameter values are used.
    - `trials`: trials that were not used for the fit. The compiled program of the fit is reused if no trial has more or
        longer windows than the fit.
    - `**options`: options of `jaxkane.fit.fit` such as `unknown` and `window`. Pass them only with a `System`.

    **Returns:** a `Fit` of these trials with the status "validated". Its `cost`, `variance_accounted_for`, `tests` and
    report refer to these trials. The standard errors of its parameters are NaN, because the parameters were not fitted
    to these trials. Trials that cannot be simulated with these parameters are left out; `failed` and `notes` state the
    reason.

    **Raises:** `ValueError` in the cases of `fit`, for trials that do not match the system, and if no trial can be
    simulated; `TypeError` for another type of first argument, and for options passed with a `Fit`.
    """
    return _validated(fit, trials, options)


def _validated(
    fit: Fit | System, trials: Sequence[Trial] | Trial, options: Mapping[str, Any], quick: bool = False
) -> Fit:
    """`validate`. With `quick`, the integration steps are the finest ones of the fit, and their error is not computed.

    Then the parameters are not differentiated either: for many short pieces this would take most of the time.
    """
    if isinstance(fit, System):
        # A problem needs at least one free parameter. It is fixed below, like the others.
        spec, room, method = ProblemSpec(fit, _first_number(fit), **options), None, "given values"
    else:
        refuse_other(fit, Fit, "validate", "validate(fit(...), trials) or validate(system, trials, unknown=...)")
        if options:
            raise TypeError(f"validate: the options {', '.join(options)} are already part of the Fit. Omit them.")
        spec, room, method = fit.problem.specification, fit.problem.windows.shape, fit.method

    def posed(trials: Sequence[Trial] | Trial) -> Problem:
        """The problem of these trials, with the tolerances and the error models of the fit. Fixed steps are chosen for
        these trials.
        """
        problem, x = Problem.with_first_steps(spec, trials, fit.parameters if isinstance(fit, Fit) else None), None
        if isinstance(fit, Fit):
            problem, x = problem.as_fine_as(fit.problem).with_errors_of(fit.problem), fit.point.parameters
            if not quick:
                return problem
            if problem.chooses_steps:
                finest = np.min(np.asarray(fit.problem.windows.step))
                problem = problem.with_steps(np.minimum(problem.windows.step, finest))
        none = problem.parameters.subset((), problem.start.parameters if x is None else x)
        return dataclasses.replace(problem, model=eqx.tree_at(lambda m: m.parameters, problem.model, none))

    problem, failed = posed(trials), {}
    names = trial_names(problem.trials)
    while True:
        x = fit.point.parameters if isinstance(fit, Fit) and not quick else problem.start.parameters
        lost, fits = {}, []
        for part, numbers in problem.parts(room, MOST_ADDED_SAMPLES):
            first = dataclasses.replace(part.start, parameters=x)
            try:
                if quick:
                    # Only the samples with weight determine the initial state.
                    has_weight = np.any(np.asarray(part.windows.weight) > 0, axis=1)  # (W, n_t)
                    seen = np.max(np.arange(2, has_weight.shape[1] + 2) * has_weight, axis=1)
                    whole = np.array([n for _, _, n in part.slices])
                    point, _ = solve_nuisance(part.shortened(np.minimum(seen, whole)), first, steps=20, rtol=1e-3)
                    at = part.linearize(point)
                    assert at is not None  # the initial states satisfy the constraints, as in the shortened windows
                    fits.append(Fit.of(part, point, at, (at.cost,), "validated", method, check_steps=False))
                    continue
                part = finer(part, first) if part.chooses_steps else part
                # Gauss-Newton steps converge quadratically. After a relative decrease below 1e-4, the next one is a
                # rounding error.
                point, at = solve_nuisance(part, first, steps=20, rtol=1e-4)
                fits.append(uninterrupted(Fit.of(part, point, at, (at.cost,), "validated", method)))
            except Unsimulated as error:
                lost |= {numbers[k]: why for k, why in error.reasons.items()}
        failed |= {names[k]: why for k, why in lost.items()}
        if not lost:
            return dataclasses.replace(_joined(problem, fits), failed=failed)
        kept = [k for k in range(len(names)) if k not in lost]
        if not kept:
            name, why = next(iter(failed.items()))
            raise ValueError(
                f"validate: none of these trials can be simulated with these parameters: {name}, {why}. Check the "
                "initial values of the trials."
            )
        problem = posed([problem.trials[k] for k in kept])
        names = tuple(names[k] for k in kept)


def _first_number(system: System) -> Any:
    """A `Free` for the first parameter of a system.

    **Raises:** `ValueError` for a system without parameters.
    """
    for name in leaf_names(system):
        with contextlib.suppress(ValueError):
            if parameters_of(system, Free(name, bounds=(None, None))).size:
                return Free(name, bounds=(None, None))
    raise ValueError(f"{type(system).__name__} has no parameter. Declare one with jk.parameter().")


def _joined(problem: Problem, fits: Sequence[Fit]) -> Fit:
    """One fit of all trials from the fits of the parts."""
    if len(fits) == 1:
        return fits[0]

    def joined(of: Callable[[Fit], Any]) -> Any:
        """Arrays by window (W, ...) or by trial (T, ...) of all parts."""
        return jax.tree.map(lambda *xs: on_device(np.concatenate([*map(np.asarray, xs)])), *map(of, fits))

    problem = problem.with_steps(joined(lambda one: one.problem.windows.step))
    b, z = joined(lambda one: (one.point.trial_unknowns, one.point.window_starts))
    prediction = joined(lambda one: one.linearization.prediction)
    # The number of triangular factors per window depends on the number of windows. QR reduces all to one factor.
    R = joined(lambda one: np.linalg.qr(np.asarray(one.linearization.blocks.R), mode="r"))
    point = Unknowns(fits[0].point.parameters, b, z)
    at = Linearization(Blocks.of(problem.model, R, problem.by_trial, point.parameters), prediction)
    return Fit(problem, point, at, joined(lambda one: one.step_errors), (at.cost,), "validated", fits[0].method)


@dataclasses.dataclass(frozen=True)
class CrossValidation:
    """The result of `cross_validate`: sums of squares of trials that are left out in turn. Print it for a table.

    The initial states and unknowns of each trial are estimated with fixed parameters. For fits with process noise or
    `errors`, the costs are minus twice the log likelihoods.

    - `fit`: the fit of all trials.
    - `trials`: names of the trials.
    - `n` (T,): number of residuals.
    - `at_start` (T,): cost with the initial guess of the parameters.
    - `fitted` (T,): cost with the parameters of the fit of all trials.
    - `held_out` (T,): cost with the parameters of the fit without the trial's fold. Infinite if the trial cannot be
        simulated with them. NaN if the fit of the other trials has not converged or does not determine a parameter.
    - `spread` (T,): sum of squares of the measurements about the mean of each channel, divided by `sigma`.
    - `estimates`: by parameter, the estimate of each fold (n_folds,). NaN for a fold whose fit has not converged, and
        for a parameter that the trials of the fold alone determine.
    - `cost_name`: name of the cost, used in the text.
    - `failures`: one sentence for each such fold, with the reason.
    - `held_out_kind`: which trials were left out together, as text.
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
    failures: tuple[str, ...] = ()
    held_out_kind: str = ""

    @property
    def score(self) -> float:
        """1 - held out / spread, over all trials: the predictive R^2.

        It is the share of the variance of the measurements that is accounted for by parameters from other trials. One
        is perfect, below zero is worse than a constant. It does not depend on the cost at the initial guess. NaN for
        likelihoods, which have no natural zero.
        """
        if self.cost_name != "sum of squares":
            return float("nan")
        return float(1 - self.held_out.sum() / self.spread.sum())

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Prediction intervals by name, for the estimate from a new data set of the size of one fold.

            estimate +- t s (1 + 1/K)^1/2,   s: of K estimates,   K estimate - (K - 1) (without the fold)   of each

        K is the number of folds and s the standard deviation of the K pseudo-values (Tukey 1958). t is the quantile of
        Student's distribution with K - 1 degrees of freedom. The intervals are truncated at the parameter's bounds.

        If the model is incomplete, each trial has a different best estimate. A confidence interval describes the mean
        of these estimates and need not contain the estimate from the next trial. All folds use the same priors. NaN if
        `failures` names a fold of the parameter. Infinite or NaN if the formal errors of the fit are.

        **Arguments:**

        - `level`: level of the interval, between 0 and 1.

        **Returns:** a dictionary of (lower, upper), in the parameter's unit.

        **Raises:** `ValueError` if `level` is not between 0 and 1.
        """
        without = np.array([self.estimates[name] for name in self.fit.names])
        K = without.shape[1]
        own = K * np.array([*self.fit.estimates.values()])[:, None] - (K - 1) * without
        half = t_quantile(level, K - 1) * np.std(own, axis=1, ddof=1) * (1 + 1 / K) ** 0.5
        errors = np.array([*self.fit.standard_errors.values()])
        half = np.where(np.isfinite(errors), half, errors)
        return intervals(self.fit.parameters, self.fit.point.parameters, half)

    @property
    def conclusion(self) -> str:
        """How well trials that were not used in a fit are predicted, as a sentence."""
        lost = [name for name, cost in zip(self.trials, self.held_out, strict=True) if np.isinf(cost)]
        if lost or self.failures:
            end = [f"{', '.join(lost)} cannot be simulated with the parameters of the others."] * bool(lost)
            return " ".join([*self.failures, *end])
        if self.cost_name != "sum of squares":
            drop = self.at_start.sum() - self.held_out.sum()
            return f"The held-out {self.cost_name} of all trials is {drop:.4g} below that of the initial guess."
        kind = f" (left out: {self.held_out_kind})" * bool(self.held_out_kind)
        return f"held-out score: {100 * self.score:.1f} % of the measurements' variance is accounted for{kind}."

    @property
    def rows(self) -> Rows:
        """Rows of the table: the header, each trial, and the sum over all trials."""
        columns = (self.spread, self.at_start, self.fitted, self.held_out)
        rows = [*zip(self.trials, self.n, *columns, strict=True), ("all", *(c.sum() for c in (self.n, *columns)))]
        cells = [[name, str(n), *(f"{cost:.5g}" for cost in costs)] for name, n, *costs in rows]
        return [("trial left out", "residuals", "spread", "start", "fitted", "held out"), *cells]

    def __repr__(self) -> str:
        return f"{text_table(self.rows)}\n{self.conclusion}"


def cross_validate(fit: Fit, folds: int | str | Sequence[Sequence[int]] | None = None) -> CrossValidation:
    """Cross-validation: fit some of the trials, and predict the others with these parameters.

    Each fold is a new fit that starts at the estimates of `fit`.

    **Arguments:**

    - `fit`: the `Fit` of all trials.
    - `folds`: number of folds, or a list of lists of the indices of trials that are left out together. By default each
        trial is left out alone; with eleven or more trials there are five folds. With the name of a label, as in
        `folds="speed"`, trials with the same value of the label are left out together. The cost of a kind of trial that
        the fit has not seen is often several times larger.

    **Returns:** a `CrossValidation`.

    **Raises:** `ValueError` with fewer than two trials.
    """
    refuse_other(fit, Fit, "cross_validate", "cross_validate(fit(...))")
    T = len(fit.problem.trials)
    if T < 2:
        raise ValueError(
            "cross_validate: at least two trials are needed, got one. Cut a long trial with `Trial.between`."
        )
    groups, kind = trial_folds(folds, fit.problem.trials)
    held_out, estimates, failures = np.full(T, np.nan), [], []
    with_all = fit.identifiability.given_sigma_errors
    for group in groups:
        training = fit.problem.only(set(range(T)) - set(group))
        run: dict[str, Any] = {"check_steps": False}
        trained = search(training, LeastSquares(), start=fit.point, **run)
        trained = uninterrupted(with_distributions(trained, LeastSquares(), run))
        values, without = np.array([*trained.estimates.values()]), ", ".join(fit.trial_names[k] for k in group)
        # A parameter that the other trials do not determine stays at the estimate from all trials. The fold predicts
        # nothing about it and would look precise.
        with np.errstate(invalid="ignore"):
            alone = 1 - (with_all / trained.identifiability.given_sigma_errors) ** 2 > LARGEST_LEVERAGE
        alone &= ~fit.parameters.has_distribution  # which predicts a group that is left out
        alone &= ~np.isin(fit.names, trained.identifiability.at_bound)  # the bound determines it
        if trained.status not in AT_A_MINIMUM:
            failures.append(f"Without {without} the fit has not converged ({STATUS[trained.status]}).")
            values[:] = np.nan
        elif alone.any():
            names = ", ".join(np.array(fit.names)[alone])
            failures.append(f"Without {without} the other trials do not determine {names}.")
            values[alone] = np.nan
        else:
            # The error models are those of the other trials. Estimated from the held-out ones, they would hide poor
            # predictions.
            held_out[group] = costs_by_trial(fit.problem.with_errors_of(trained.problem), trained.point)[group]
        estimates.append(values)
    counts = np.sum(np.asarray(fit.problem.windows.weight) > 0, axis=(1, 2))
    return CrossValidation(
        fit=fit,
        trials=fit.trial_names,
        n=np.bincount(np.asarray(fit.problem.windows.trial), counts, T).astype(int),
        at_start=costs_by_trial(fit.problem, fit.problem.start),
        fitted=costs_by_trial(fit.problem, fit.point),
        held_out=held_out,
        spread=spread_by_trial(fit.problem),
        estimates=dict(zip(fit.names, np.array(estimates).T, strict=True)),
        cost_name=fit.problem.cost_name,
        held_out_kind=kind,
        failures=tuple(failures),
    )


def costs_by_trial(problem: Problem, point: Unknowns) -> np.ndarray:
    """Sums of squares (T,) with these parameters. The initial states and unknowns of each trial are estimated for them.

    Priors of the initial states and unknowns of a trial are included. Priors of parameters are not, because they belong
    to no single trial. Infinite for trials that cannot be simulated.
    """
    try:
        _, at = solve_nuisance(problem, point, rtol=1e-5)
    except Unsimulated as error:
        costs, left = np.full(len(problem.trials), np.inf), np.delete(np.arange(len(problem.trials)), [*error.reasons])
        if left.size:
            left_out = problem.with_trials([problem.trials[k] for k in left])
            costs[left] = costs_by_trial(left_out, dataclasses.replace(left_out.start, parameters=point.parameters))
        return costs
    return np.bincount(np.asarray(problem.windows.trial), at.costs, minlength=len(problem.trials))


def spread_by_trial(problem: Problem) -> np.ndarray:
    """Sums of squares (T,) of the measurements about the mean of each channel, divided by their standard deviations.

    This is the cost of a model that predicts a constant.
    """
    windows, owner = problem.windows, np.asarray(problem.windows.trial)
    y, weight = np.asarray(windows.measured), np.asarray(windows.weight) ** 2  # (W, n_c, n_t)

    def total(x: np.ndarray) -> np.ndarray:
        """Sums by trial and channel (T, n_c)."""
        sums = np.zeros((len(problem.trials), x.shape[1]))
        np.add.at(sums, owner, x.sum(axis=2))
        return sums

    weights = total(weight)
    mean = total(weight * y) / np.where(weights > 0, weights, 1.0)
    return total(weight * (y - mean[owner][:, :, None]) ** 2).sum(axis=1)


def predict(
    fit: Fit,
    trials: Sequence[Trial] | Trial,
    ahead: Sequence[float] | float,
    *,
    past: float | None = None,
    start: str = "estimated",
) -> pd.DataFrame:
    """Prediction errors a given time ahead, restarted along each trial.

    A prediction starts at a time t. The initial state and the unknowns of the trial are estimated from the measurements
    in the `past` seconds before t. The simulation then continues from t with the measured inputs. With process noise
    the filter does both. A state that is not `unknown` starts `past` seconds before t, as in `fit`. Predictions do not
    overlap: t advances by the longest of `ahead`. The integration steps are the finest ones of the fit.

        errors = predict(fit, trials, ahead=(0.01, 0.1, 0.5))
        errors.groupby(["channel", "ahead"]).error.std()

    **Arguments:**

    - `fit`: a `Fit`, whose parameters are used.
    - `trials`: trials, preferably not those of the fit.
    - `ahead`: prediction times [s], rounded to the nearest sample.
    - `past`: duration [s] of the measurements before t that are used. By default so long that with the longest of
        `ahead` it is a window of the fit, whose compiled program is then reused, but at least half of a window. Without
        windows it is the longest of `ahead`. If offsets or delays of each trial are unknown, choose it long enough to
        estimate them.
    - `start`: "estimated", or "measured" to start at the sample at t. Every coordinate, independent speed and state
        must then be a channel or in `initial`, and the unknowns of the trial have their initial guesses. A time t
        without all these samples is omitted.

    **Returns:** a `pandas.DataFrame` with a row for each trial, time, channel and `ahead`. The columns are `trial`,
    `channel`, `ahead` [s], `t` [s], `measured`, `predicted`, `error` (predicted - measured, in the channel's unit) and
    `residual` (error / sigma). Gaps are left out. A prediction is NaN if the trial cannot be simulated.

    **Raises:** `ValueError` for times that are not positive or shorter than half a sample, for trials that are all
    shorter than `past` plus the longest of `ahead`, for another `start`, for `past` together with `start="measured"`,
    for a state that is then not measured, and in the cases of `validate`.
    """
    import pandas as pd

    refuse_other(fit, Fit, "predict", "predict(fit(...), trials, ahead=(0.1, 0.5))")
    times = np.array([positive_number(x, "predict: `ahead` [s]") for x in np.ravel(np.asarray(ahead, float))])
    spec = fit.problem.specification
    from_sample, system = start == "measured", fit.problem.system
    states = [name for name in state_names(system) if name not in system.dependent_coordinates]
    refuse(
        (start not in ("estimated", "measured"), f"predict: `start` must be 'estimated' or 'measured', got {start!r}."),
        (from_sample and past is not None, "predict: `past` has no effect with start='measured'. Omit it."),
    )
    given = past if past is None else positive_number(past, "predict: `past`")
    pieces, origins = [], []
    for trial in as_trials(trials):
        own = [trial.measured.get(name, trial.initial.get(name)) for name in states]
        unmeasured = ", ".join(name for name, x in zip(states, own, strict=True) if x is None)
        refuse(
            (
                from_sample and unmeasured,
                f"predict: {trial.name} has no samples of {unmeasured}. Pass them in `initial`, or omit "
                "start='measured'.",
            )
        )
        t, dt = trial.t, float(np.median(np.diff(trial.t)))
        if times.min() < 0.5 * dt:
            raise ValueError(
                f"predict: `ahead` = {times.min():g} s is shorter than half of the sample interval of {trial.name}, "
                f"{dt:.3g} s. Pass a longer time."
            )
        longest = spec.window or 2 * times.max() + dt
        past = max(longest - times.max() - dt, longest / 2) if given is None else given
        past = 0.0 if from_sample else past
        for now in np.arange(t[0] + past, t[-1] - times.max() + 0.5 * dt, times.max()):
            piece = trial.between(max(now - past, t[0]) - 0.25 * dt, now + times.max() + 0.5 * dt)
            # Quarters of an interval, because `now` and the times of the samples differ by rounding.
            unseen = piece.t > now + 0.25 * dt
            # The simulation continues through samples of NaN, but they do not influence the initial state.
            hidden = {name: np.where(unseen, np.nan, y) for name, y in piece.measured.items()}
            if unseen.sum() < 1 or not any(np.isfinite(y).any() for y in hidden.values()):
                continue
            initial = piece.initial
            if from_sample:  # `initial` would take precedence over the samples
                initial = {name: x for name, x in initial.items() if name not in piece.measured}
                if any(np.isnan(piece.measured[name][0]) for name in states if name in piece.measured):
                    continue
            options = {"sigma": piece.sigma, "initial": initial, "labels": piece.labels}
            pieces.append(Trial(piece.t, hidden, piece.inputs, name=str(len(pieces)), **options))
            origins.append((trial.name, piece, int(np.argmax(unseen)) - 1))
    if not pieces:
        raise ValueError(
            f"predict: no trial is longer than {past:g} s for the initial state plus {times.max():g} s to predict. "
            "Choose a shorter `past` or `ahead`."
        )
    unknown = () if from_sample else spec.unknown
    whole = dataclasses.replace(spec, window=None, defect_std=None, unknown=unknown)
    unwindowed = dataclasses.replace(fit, problem=dataclasses.replace(fit.problem, specification=whole))
    fitted, rows = _validated(unwindowed, pieces, {}, quick=True).fitted, []
    for number, (name, piece, last) in enumerate(origins):
        for channel, y in piece.measured.items():
            simulated = fitted[str(number)][channel] if str(number) in fitted else np.full_like(y, np.nan)
            for h in times:
                i = int(np.argmin(np.abs(piece.t - (piece.t[last] + h))))
                if i > last and np.isfinite(y[i]):
                    error = simulated[i] - y[i]
                    residual = error / piece.sigma[channel][i]
                    rows.append((name, channel, h, piece.t[i], y[i], simulated[i], error, residual))
    columns = ["trial", "channel", "ahead", "t", "measured", "predicted", "error", "residual"]
    return pd.DataFrame(rows, columns=columns)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The result of `compare`. Print it for the tables.

    - `fits`: the fits by name.
    - `held_out`: by name, the validation of each fit on the held-out trials. Empty without held-out trials.
    - `bound_violations`: by name of the fit, a sentence for each estimate that is not plausible.
    """

    fits: Mapping[str, Fit]
    held_out: Mapping[str, Fit]
    bound_violations: Mapping[str, tuple[str, ...]]

    @property
    def tables(self) -> Tables:
        """The tables, each as a heading and rows. The first row is the header."""
        units = {n: u for fit in self.fits.values() for n, u in zip(fit.names, fit.parameters.units, strict=True)}
        labels = {name: f"{name} [{unit}]" if unit else name for name, unit in units.items()}
        tables = [("Parameters, with the errors of their intervals", _rows("parameter", labels, self.fits, _estimate))]
        tables.append(("All", self._sums()))
        violations = [[name, violation] for name, of_fit in self.bound_violations.items() for violation in of_fit]
        if violations:
            tables.append(("Bound violations", [["fit", "violation"], *violations]))
        for where, fits in (("", self.fits), ("Held out: ", self.held_out)):
            if fits:
                channels = {channel: channel for fit in fits.values() for channel in fit.problem.channels}
                trials = {name: name for fit in fits.values() for name in (*fit.trial_names, *fit.failed)}
                heading = f"{where}Sum of squares and variance accounted for, by channel"
                tables.append((heading, _rows("channel", channels, fits, _of_channel)))
                tables.append((f"{where}Sum of squares, by trial", _rows("trial", trials, fits, _of_trial)))
        return tables

    def _sums(self) -> Rows:
        fits, held_out = [*self.fits.values()], self.held_out.values()
        rows = {"status": [fit.status for fit in fits]}
        for cost in dict.fromkeys(fit.problem.cost_name for fit in fits):
            rows[cost] = [f"{fit.cost:.6g}" if fit.problem.cost_name == cost else "" for fit in fits]
        rows |= {
            "of trials left out in turn": [f"{fit.held_out_cost:.6g}".replace("nan", "") for fit in fits],
            "held out": [
                f"{fit.cost:.6g}"
                + f" ({len(fit.trial_names)} of {len(fit.trial_names) + len(fit.failed)} trials)" * bool(fit.failed)
                for fit in held_out
            ],
            "residuals": [str(fit.problem.size[0]) for fit in fits],
            "unknowns": [str(fit.problem.size[1]) for fit in fits],
            "variance of a residual": [f"{fit.variance:.3g}" for fit in fits],
            "residuals' correlation": [f"{fit.autocorrelation:.2f}" for fit in fits],
        }
        return [["", *self.fits], *([label, *cells] for label, cells in rows.items() if any(cells))]

    def __repr__(self) -> str:
        return text_tables(self.tables)

    def _repr_html_(self) -> str:
        return html_tables(self.tables)


def _rows(head: str, labels: Mapping[str, str], fits: Mapping[str, Fit], cell: Callable[[Fit, str], str]) -> Rows:
    return [[head, *fits], *([label, *(cell(fit, name) for fit in fits.values())] for name, label in labels.items())]


def _estimate(fit: Fit, name: str) -> str:
    return f"{fit.estimates[name]:.5g} ({fit.errors[name]:.2g})" if name in fit.names else ""


def _of_channel(fit: Fit, channel: str) -> str:
    if channel not in fit.problem.channels:
        return ""
    squares = sum(of_trial.get(channel, 0.0) for of_trial in fit.costs.values())
    return f"{squares:.5g}, {100 * fit.variance_accounted_for[channel]:.1f} %"


def _of_trial(fit: Fit, trial: str) -> str:
    return (
        f"{sum(fit.costs[trial].values()):.5g}" if trial in fit.trial_names else "not simulated" * (trial in fit.failed)
    )


def compare(
    fits: Mapping[str, Fit] | Sequence[Fit],
    held_out: Sequence[Trial] | Trial | None = None,
    *,
    plausible: Mapping[str, Any] | None = None,
) -> Comparison:
    """Compare fits: their costs by channel and by trial, their parameters, and the plausibility of these.

        print(compare({"viscous": one, "with dry friction": other}, held_out=others))

    **Arguments:**

    - `fits`: fits by name. In a sequence, each fit is named after its free parameters.
    - `held_out`: trials that were not used in any of the fits. Only their initial states and unknowns are estimated
        (`validate`). For bicycles, construct them with `bicycle_rides`.
    - `plausible`: plausible ranges, as in `forward_selection`. Names that none of the fits frees are ignored.

    **Returns:** a `Comparison`. Its tables contain the parameters with the errors of their intervals, and the estimates
    that are not plausible. They also contain the sums of squares of fitted and held-out trials: in total, by channel
    and by trial.

    **Raises:** `TypeError` for a value that is not a `Fit`; `ValueError` without a fit, and for two fits with the same
    name.
    """
    if isinstance(fits, Fit):
        raise TypeError(
            "compare: `fits` is one Fit. Pass fits by name, such as compare({'first': one, 'second': other})."
        )
    given = [*(fits.values() if isinstance(fits, Mapping) else fits)]
    if not given:
        raise ValueError("compare: `fits` is empty. Pass at least one Fit.")
    for fit in given:
        refuse_other(fit, Fit, "compare", "compare({'first': fit(...), 'second': fit(...)})")
    named = dict(
        zip(fits if isinstance(fits, Mapping) else [", ".join(fit.names) for fit in given], given, strict=True)
    )
    if len(named) < len(given):
        raise ValueError("compare: two fits have the same free parameters. Name the fits: compare({'first': ...}).")
    ranges = plausible or {}
    free = {name for fit in named.values() for name in fit.names}
    if not free & set(ranges):  # ranges of a whole search may contain names that no fit frees
        refuse_unknown(ranges, free, "`plausible` contains unknown names:", "the free parameters are")
    return Comparison(
        fits=named,
        held_out={} if held_out is None else {name: validate(fit, held_out) for name, fit in named.items()},
        bound_violations={
            name: tuple(implausible(plausible_of(fit.parameters, ranges), fit.estimates).values())
            for name, fit in named.items()
        },
    )


def compare_estimates(fit: Fit, other: Fit | Mapping[str, float | tuple[float, float]]) -> pd.DataFrame:
    """Differences between two sets of estimates, in standard errors of the difference.

        z = (estimate - other) / (error^2 + other_error^2)^1/2

        jk.plot.estimates({"Monday": monday, "Tuesday": tuesday})  # the same as a forest plot
        compare_estimates(fit, {"mass": (2.1, 0.05), "length": 0.6})  # with values from elsewhere

    **Arguments:**

    - `fit`: a `Fit`, whose `errors` are used.
    - `other`: a fit of other data, or by name a value or (value, standard deviation). If both share data, their
        errors are correlated, and the denominator of `z` is usually too large.

    **Returns:** a `pandas.DataFrame` with a row for each parameter in both, and the columns `unit`, `estimate`,
    `error`, `other`, `other_error`, `difference` and `z`. `z` is NaN if an error is not finite.

    **Raises:** `TypeError` if `fit` is not a `Fit`; `ValueError` without a common parameter.
    """
    refuse_other(fit, Fit, "compare_estimates", "compare_estimates(fit(...), other)")
    if isinstance(other, Fit):
        others = {name: (value, other.errors[name]) for name, value in other.estimates.items()}
    else:
        others = {name: value if isinstance(value, tuple) else (value, 0.0) for name, value in other.items()}
    names = [name for name in fit.names if name in others]
    if not names:
        raise ValueError(
            f"compare_estimates: the two sets have no common parameter; {hint([], fit.names, 'the fit has')}"
        )
    frame = fit.to_pandas().loc[names, ["unit", "estimate", "error"]]
    frame[["other", "other_error"]] = np.array([others[name] for name in names], float)
    frame["difference"] = frame.estimate - frame.other
    error = np.hypot(frame.error, frame.other_error)
    frame["z"] = np.where(np.isfinite(error) & (error > 0), frame.difference / np.where(error > 0, error, 1.0), np.nan)
    return frame
