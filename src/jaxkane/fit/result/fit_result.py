"""The result of a fit: estimates, standard errors, residuals and identifiability."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._integrate.trajectory import Trajectory
from ..._system.system import System
from ..problem.errors import whitened
from ..problem.model import Unknowns
from ..problem.parameters import places_of
from ..problem.problem import STEP_TOLERANCE, Problem, residual_deviation, step_errors
from ..problem.specification import refuse_other
from ..problem.trial import trial_names
from ..solve.linearization import Linearization
from . import diagnostics as diagnostics
from . import statistics as statistics
from .data import Export, costs_in_words, read_fit
from .identifiability import Identifiability, identifiability_at
from .linearized import Posterior, linearized_problem, trial_folds
from .statistics import ByTrial, ResidualTest, infinite_along


@dataclasses.dataclass(frozen=True)
class Fit(Export, Posterior):
    """The result of a fit.

    Print it for a table. `jaxkane.fit.report(fit)` returns more, and `jaxkane.fit.save_report(fit, path)` writes a page
    with figures. Reading the attributes runs no simulation and no fit, except where an attribute's docstring states it.

    - `system`: the system with the estimates. `systems`: the same by trial, if parameters differ between trials.
    - `estimates`, `start`: estimates and initial guesses by name, gains and delays included.
    - `standard_errors`: formal standard errors by name, from the inverse of J^T J with the nuisance parameters
        eliminated. The data are weighted by the variance of the residuals, priors by their own standard deviations.
        They are correct if the residuals are independent, the scaled residuals have equal variance, and the model is
        right.
    - `clustered_errors`: cluster-robust standard errors by name, for residuals that are correlated within a cluster.
        They are computed with a linearized jackknife that leaves out each cluster in turn. `clusters` states the
        cluster unit. NaN without clusters. Infinite for a parameter that one cluster alone determines.
    - `correlation` (p, p): correlation of the estimates, in the order of `names`.
    - `cost`: sum of squared residuals. With process noise or `errors`: minus twice the log likelihood.
    - `history`: the cost at the initial guess and after each step.
    - `status`, `message`: why the fit ended, as one word and as a sentence.
    - `identifiability`: singular values and directions of the sensitivity, and the combinations of parameters that the
        data do not determine.
    - `residuals`: by trial and channel, (simulated - measured) / sigma (n_t,), NaN in gaps. With process noise: the
        normalized innovations. With `errors`: divided by the estimated scale, and for an autoregression its
        innovations.
    - `fitted`: by trial and channel, the simulated measurements (n_t,). With process noise: predictions from all
        earlier measurements.
    - `tests`: by trial and channel, a `ResidualTest`.
    - `failed`: by name, trials that could not be simulated, with the reason. The fit does not contain them.
    """

    problem: Problem
    point: Unknowns
    linearization: Linearization
    step_errors: np.ndarray  # (W,), see `problem.step_errors`
    history: tuple[float, ...]
    status: str
    method: str
    failed: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)

    @classmethod
    def of(
        cls,
        problem: Problem,
        point: Unknowns,
        at: Linearization,
        history: Sequence[float],
        status: str,
        method: str,
        check_steps: bool = True,
    ) -> Fit:
        """The result at a point where the problem has been linearized.

        All windows are simulated once more with finer steps to estimate the integration error, except after Ctrl-C and
        without `check_steps`.
        """
        errors = np.full(len(problem.slices), np.nan)
        if status != "interrupted" and check_steps:
            try:
                errors = step_errors(problem, point, at.prediction.with_deviations)
            except KeyboardInterrupt:
                status = "unchecked" if status in diagnostics.AT_A_MINIMUM else "interrupted"
        return cls(problem, point, at, errors, tuple(history), status, method)

    @property
    def cost(self) -> float:
        return self.linearization.cost

    @property
    def aic(self) -> float:
        """Akaike's information criterion: twice the number of maximized unknowns minus twice the log likelihood.

        `sigma` is used as it was passed, unless `errors` estimates its scale. Priors are not part of the likelihood.
        Unknowns that the filter integrates out (`noise`) are not counted. NaN with a distribution over groups.
        """
        return self._criterion(2.0)

    @property
    def bic(self) -> float:
        """The Bayesian information criterion (Schwarz 1978), with the likelihood of `aic`."""
        return self._criterion(math.log(np.count_nonzero(np.asarray(self.problem.windows.weight) > 0)))

    def _criterion(self, per_unknown: float) -> float:
        problem, n = self.problem, self.problem.model.nuisance
        if self.parameters.distributions:  # the cost does not integrate out the groups
            return math.nan
        n_maximized = problem.size[1]
        if problem.model.noise is not None:  # each trial is one window
            known = np.isfinite(np.concatenate([n.start_deviation, n.trial_deviation])).sum()
            n_maximized -= problem.clusters * int(known)
        of_nuisance = float(np.sum(statistics.nuisance_prior_rows(problem, self.point)[0][:, :, -1] ** 2))
        squares = self.cost - self.linearization.prior_squares - of_nuisance
        return per_unknown * n_maximized - 2 * statistics.log_likelihood(problem, squares)

    @property
    def measurement_errors(self) -> dict[str, dict[str, float]]:
        """By channel, the estimated parameters of its error model.

        Scales are in units of `Trial.sigma`. Empty without `errors`.
        """
        errors = self.problem.model.errors
        return {} if errors is None else dict(zip(self.problem.channels, errors.values, strict=True))

    @property
    def variance(self) -> float:
        """Estimated variance of a residual.

        It is the sum of squares of the data, divided by the degrees of freedom. These are the number of residuals minus
        the number of unknowns that the data, not priors, determine. It is near one if `sigma` and the model are right.
        NaN without degrees of freedom. With process noise it is set to one.
        """
        return self.identifiability.variance

    @property
    def mean_normalized_innovation_squared(self) -> float:
        """The mean square of the normalized residuals.

        With process noise it is near one if the process noise and `sigma` are specified correctly.
        """
        flat = np.concatenate([r for channels in self.residuals.values() for r in channels.values()])
        return float(np.nanmean(flat**2))

    @property
    def system(self) -> System:
        """The system with the estimates.

        **Raises:** `ValueError` if a parameter differs between trials and has no distribution over groups. Use
        `systems`.
        """
        # A distribution over groups has a mean that applies to all trials. Such a parameter has a common value.
        common = {place for e in self.parameters.all_entries if e.group is None for place in places_of(e)}
        differs = [
            e.name for e in self.parameters.all_entries if e.group and not common & {*places_of(e)} and e.targets
        ]
        if differs:
            raise ValueError(
                f"{', '.join(differs)} has a different value in each group of trials, so there is no common system. "
                "Use fit.systems[trial]."
            )
        return self.parameters.apply(self.problem.system, self.point.parameters)[0]

    @property
    def systems(self) -> dict[str, System]:
        """By trial, the system with the estimates of the trial's groups."""
        applies, apply = self.parameters.applies(self.problem.trials), self.parameters.apply
        own = [apply(self.problem.system, self.point.parameters, jnp.asarray(row))[0] for row in applies]
        return dict(zip(self.trial_names, own, strict=True))

    @property
    def dependent(self) -> dict[str, tuple[float, float]]:
        """By name, value and standard error of the parameters that are not free.

        These follow from the other parameters by exact sums in `constraints`, or are fixed at a bound.
        """
        parameters, x = self.parameters, self.point.parameters
        fixed = [i for i in range(len(parameters.all_entries)) if i not in np.asarray(parameters.places)]
        if parameters.mixing is None or not fixed:
            return {}
        values, slopes = np.asarray(parameters.all_values(x)), np.asarray(parameters.all_slopes(x))
        by_values = slopes[np.ix_(fixed, np.asarray(parameters.places))] @ np.linalg.pinv(parameters.slopes(x))
        errors = np.sqrt(np.einsum("ki,ij,kj->k", by_values, self.covariance, by_values))
        names = [parameters.all_entries[i].name for i in fixed]
        return dict(zip(names, zip(values[fixed].tolist(), errors.tolist(), strict=True), strict=True))

    @property
    def deviations(self) -> dict[str, float]:
        """By parameter, the standard deviation of its distribution over groups, estimated by restricted maximum
        likelihood.

        For a log-normal distribution it is the standard deviation of the logarithm.
        """
        names = [name for name, *_ in self.parameters.distributions]
        return dict(zip(names, (self.parameters.deviations * self.variance**0.5).tolist(), strict=True))

    @property
    def estimates(self) -> dict[str, float]:
        return self._by_name(self.parameters.values(self.point.parameters))

    @functools.cached_property
    def identifiability(self) -> Identifiability:
        return identifiability_at(self.problem, self.point, self.linearization, fitted=self.status != "validated")

    @property
    def message(self) -> str:
        ending, at_bound = diagnostics.STATUS[self.status], self.identifiability.at_bound
        if self.status in ("converged", "bound") and at_bound:
            ending = f"converged: {', '.join(at_bound)} rests at its bound"
        elif self.status == "converged" and not self.identifiability.ok:
            ending = "the cost has converged, but not every parameter is determined"
        elif self.status in ("converged", "bound") and self._says_nothing:
            ending = "the cost has converged, but the interval of every parameter is its whole range"
        notes = (*self.identifiability.messages, *diagnostics.numerical_limits(self))
        return "; ".join([ending, *(note.rstrip(".") for note in notes)])

    @property
    def ok(self) -> bool:
        """Whether the fit passes all checks.

        True if it converged, every parameter is determined, an interval is narrower than the whole range of its
        parameter, the integration steps are fine enough, and the values of all inputs that act are recorded.
        """
        converged = self.status in ("converged", "bound") and self.identifiability.ok and not self._says_nothing
        return converged and not self.too_coarse and not self._unrecorded_inputs

    @property
    def _says_nothing(self) -> bool:
        """Whether the interval of every parameter that is not at a bound is its whole range."""
        free = ~np.isin(self.names, self.identifiability.at_bound)
        low, high = np.array([*self.intervals().values()]).reshape(-1, 2)[free].T
        lowest, highest = np.asarray(self.parameters.bounds).reshape(-1, 2)[free].T
        return bool(free.any() and np.all((low <= lowest) & (high >= highest)))

    @functools.cached_property
    def _unrecorded_inputs(self) -> tuple[str, ...]:
        return tuple(diagnostics.unrecorded_inputs(self.problem, self.point))

    @property
    def step_error(self) -> float:
        """Change of all residuals together if the integration steps are refined, in standard deviations of a residual.

        A fixed step is halved, or the tolerances are divided by ten. The integration error biases no estimate by more
        than `step_error` standard errors. NaN after Ctrl-C.
        """
        return float(np.linalg.norm(self.step_errors)) / residual_deviation(self.problem, self.linearization.squares)

    @property
    def too_coarse(self) -> bool:
        """Whether `step_error` is larger than 0.25."""
        return bool(self.step_error > STEP_TOLERANCE[1])

    @property
    def singular_values(self) -> np.ndarray:
        return self.identifiability.singular_values

    @property
    def covariance(self) -> np.ndarray:
        """Formal covariance of the estimates (p, p), in the parameters' units.

        NaN for a validated fit, because its parameters were estimated from other data (`validate`).
        """
        return self.identifiability.covariance * (math.nan if self.status == "validated" else 1.0)

    @property
    def clusters(self) -> tuple[str, int]:
        """The cluster unit of the cluster-robust errors, and the number of clusters.

        Residuals of different clusters are assumed to be independent. The unit is "label NAME" if the label NAME of the
        trials has at least three values, otherwise "trial", "window", or "part" (of a window). ("", 0) if there are too
        few clusters.
        """
        return statistics.clusters_of(self.problem, self.linearization)

    @functools.cached_property
    def _jackknives(self) -> tuple[statistics.Jackknife, np.ndarray]:
        """Jackknife of the parameters in their units, NaN without clusters; by parameter, whether it ignores labels.

        Trials with one value of a label may be the only ones that determine a parameter. Its clusters are then those
        without labels. The covariances between both kinds of parameters are NaN.
        """
        first = self._jackknife_by(True)
        alone = first.leverage > statistics.LARGEST_LEVERAGE
        if not (self.clusters[0].startswith(statistics.LABEL) and alone.any()):
            return first, np.full(len(alone), False)
        other, both = self._jackknife_by(False), alone[:, None] & alone
        covariance = np.where(both, other.covariance, np.where(alone[:, None] | alone, np.nan, first.covariance))
        chosen = (np.where(alone, x, y) for x, y in zip(other[1:], first[1:], strict=True))
        return statistics.Jackknife(covariance, *chosen), alone

    @property
    def _jackknife(self) -> statistics.Jackknife:
        return self._jackknives[0]

    def _jackknife_by(self, by_label: bool) -> statistics.Jackknife:
        of, p = self.identifiability, len(self.names)
        clusters = statistics.clustered(self.problem, self.point, self.linearization, of.directions, by_label)
        if clusters is None:
            return statistics.Jackknife(np.full((p, p), np.nan), np.full(p, np.nan), np.full(p, np.nan))
        combinations = np.zeros((p, len(clusters.of_priors)))
        known = of.singular_values > 0
        combinations[:, combinations.shape[1] - known.sum() :] = of.scales[:, None] * of.vectors[known].T
        result = statistics.jackknife(clusters, combinations)
        alone = np.eye(p)[result.leverage > statistics.LARGEST_LEVERAGE]
        return result._replace(
            covariance=infinite_along(result.covariance, np.concatenate([of.vectors[~known], alone]))
        )

    @property
    def clustered_covariance(self) -> np.ndarray:
        """Covariance (p, p), in the parameters' units, robust to residuals that are correlated within `clusters`."""
        return self._jackknife.covariance * (math.nan if self.status == "validated" else 1.0)

    @property
    def clustered_errors(self) -> dict[str, float]:
        return self._by_name(np.sqrt(self.clustered_covariance.diagonal()))

    @functools.cached_property
    def serial_correlation(self) -> dict[str, float]:
        """Serial correlation of the residuals by channel, 0 if they are white. The page on uncertainty defines it."""
        return statistics.serial_correlation(self.residuals)

    @property
    def autocorrelation(self) -> float:
        """The largest `serial_correlation` of all channels."""
        return max(self.serial_correlation.values())

    @functools.cached_property
    def uses_clustered_errors(self) -> bool:
        """Whether `errors` are cluster-robust, whether or not the residuals look white.

        True if there are enough clusters. A slow error in one record is rarely detected, but formal 95 % intervals then
        cover only 75 %. False if the parts are too short for a detected correlation, because they are not independent.
        False with a distribution over groups: its groups are not independent trials, and its standard deviation is
        estimated for white residuals.
        """
        return self._is_valid(*self.clusters)

    def _is_valid(self, unit: str, n: int) -> bool:
        """Whether clusters of this unit give errors."""
        if unit == "part" and self.autocorrelation:
            samples = sum(n for _, _, n in self.problem.slices) / n
            if samples * statistics.effective_sample_fraction(self.autocorrelation) < statistics.FEWEST_SAMPLES:
                return False
        return bool(unit) and not self.parameters.distributions

    @functools.cached_property
    def error_kinds(self) -> dict[str, str]:
        """By name, the kind of `errors`: "label NAME", "trial", "window" or "part" if clustered, "formal", or "none" if
        infinite."""
        result, ignores_labels = self._jackknives
        other = statistics.clusters_of(self.problem, self.linearization, by_label=False)
        units = [other if ignored else self.clusters for ignored in ignores_labels]
        kind = "none" if self.autocorrelation else "formal"
        return {
            name: unit[0] if self._is_valid(*unit) and h <= statistics.LARGEST_LEVERAGE else kind
            for name, unit, h in zip(self.names, units, result.leverage, strict=True)
        }

    @property
    def scope(self) -> str:
        """The runs for which the intervals are valid, as a sentence; "" for a validated fit."""
        if self.status == "validated":
            return ""
        unit, number = self.clusters
        if unit in self.error_kinds.values() and unit.startswith(statistics.LABEL):
            label = unit.removeprefix(statistics.LABEL)
            return f'Intervals by "{unit}" include the spread of the estimates between {number} values of {label}.'
        kinds = {frozenset(trial.labels.items()) for trial in self.problem.trials}
        return f"Intervals are for runs of {'this kind' if len(kinds) < 2 else 'these kinds'}."

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors by name, used for all intervals.

        They are cluster-robust if `uses_clustered_errors`, else formal. If one cluster alone determines a parameter,
        its error is formal if all residuals are white, and infinite otherwise.
        """
        none = math.nan if self.status == "validated" else math.inf
        formal, clustered = (np.sqrt(C.diagonal()) for C in (self.covariance, self.clustered_covariance))
        return self._by_kind(clustered, {"formal": formal, "none": none})

    @property
    def degrees_of_freedom(self) -> dict[str, float]:
        """By name, the degrees of freedom of `errors`.

        For a cluster-robust error: those of its variance. For a formal error: the number of residuals minus the number
        of unknowns that the data, not priors, determine.
        """
        formal = np.full(len(self.names), self.identifiability.degrees_of_freedom)
        if self.parameters.distributions:
            formal = statistics.degrees_of_freedom(self.problem, self.point, self.linearization)
        return self._by_kind(self._jackknife.degrees_of_freedom, {"formal": formal, "none": 1.0})

    def _by_kind(self, clustered: np.ndarray, other: Mapping[str, Any]) -> dict[str, float]:
        kinds = np.array([*self.error_kinds.values()], str)
        return self._by_name(np.select([kinds == kind for kind in other], [*other.values()], clustered))

    def half_widths(self, level: float = 0.95) -> np.ndarray:
        """Half-widths of the intervals (p,), in the parameters' units.

        They are the product of `errors` and the quantile of Student's t distribution with `degrees_of_freedom`.
        """
        quantiles = [statistics.t_quantile(level, n) for n in self.degrees_of_freedom.values()]
        return np.array(quantiles) * np.array([*self.errors.values()])

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals by name, from `errors` and `degrees_of_freedom`.

        They are symmetric about the estimate and truncated at the bounds of the parameter.

        **Arguments:**

        - `level`: confidence level, between 0 and 1.

        **Returns:** a dictionary of (lower, upper), in the parameter's unit.

        **Raises:** `ValueError` if `level` is not between 0 and 1.
        """
        return statistics.intervals(self.parameters, self.point.parameters, self.half_widths(level))

    @functools.cached_property
    def fitted(self) -> ByTrial:
        return statistics.by_trial(self.problem, np.asarray(self.linearization.simulated))

    @functools.cached_property
    def residuals(self) -> ByTrial:
        deviation, errors = self.linearization.prediction.deviation, self.problem.model.errors
        if errors is not None:
            u = whitened(errors, self.problem.windows, self.linearization.simulated)
            return statistics.by_trial(self.problem, np.asarray(u))
        known = None if deviation is None else statistics.by_trial(self.problem, np.asarray(deviation))
        scaled = {}
        for (name, channels), trial in zip(self.fitted.items(), self.problem.trials, strict=True):
            sigma = trial.sigma if known is None else known[name]
            scaled[name] = {channel: (y - trial.measured[channel]) / sigma[channel] for channel, y in channels.items()}
            for residuals in scaled[name].values():
                residuals.flags.writeable = False  # cached results depend on them
        return scaled

    @functools.cached_property
    def tests(self) -> dict[str, dict[str, ResidualTest]]:
        return {
            name: {
                channel: statistics.residual_test(trial.measured[channel], self.fitted[name][channel], r)
                for channel, r in self.residuals[name].items()
            }
            for name, trial in zip(self.trial_names, self.problem.trials, strict=True)
        }

    @property
    def costs(self) -> dict[str, dict[str, float]]:
        """Sums of squared residuals by trial and channel. `jaxkane.plot.costs(fit)` draws a heat map."""
        return {
            name: {channel: float(np.nansum(r**2)) for channel, r in channels.items()}
            for name, channels in self.residuals.items()
        }

    @property
    def variance_accounted_for(self) -> dict[str, float]:
        """By channel, the share of the variance accounted for, over all samples that the fit uses. Below zero is worse
        than a constant."""
        shares, trials = {}, list(zip(self.fitted.values(), self.problem.trials, strict=True))
        for channel in self.problem.channels:
            measured = [trial.measured[channel] for _, trial in trials if channel in trial.measured]
            fitted = [channels[channel] for channels, _ in trials if channel in channels]
            shares[channel] = statistics.variance_accounted_for(measured, fitted)
        return shares

    @property
    def trial_names(self) -> tuple[str, ...]:
        """Names of the trials. Repeated names are numbered."""
        return trial_names(self.problem.trials)

    @property
    def nuisance(self) -> dict[str, dict[str, Any]]:
        """By trial and name, values of the trial's offsets, gains and delays. Initial states, offsets and gains of its
        windows are arrays (W,).
        """
        problem, n = self.problem, self.problem.model.nuisance
        starts = np.asarray(problem.starts(self.point))[:, problem.model.unknown_places]
        owner = np.array([k for k, _, _ in problem.slices])
        filtered = self.linearization.prediction.unknowns  # with process noise each trial is one window
        b = np.asarray(self.point.trial_unknowns if filtered is None else filtered) + np.asarray(n.trial_center)
        of_windows = np.asarray(self.point.window_starts)[:, len(n.start) :] + np.asarray(n.window_center)
        in_filter = np.isfinite(np.asarray(n.start_deviation)) & (problem.model.noise is not None)
        values = {}
        for k, name in enumerate(self.trial_names):
            values[name] = dict(zip(n.trial_names, b[k].tolist(), strict=True))
            values[name] |= {f"start of {s}": starts[owner == k, j] for j, s in enumerate(n.start) if not in_filter[j]}
            values[name] |= {entry.name: of_windows[owner == k, j] for j, entry in enumerate(n.window)}
        return values

    @functools.cached_property
    def notes(self) -> tuple[str, ...]:
        """Warnings and remarks about the fit, as sentences."""
        return tuple(diagnostics.notes(self))

    @functools.cached_property
    def held_out_cost(self) -> float:
        """Sum of squares of trials that are left out in turn, linearized at the estimates.

        Initial states and trial unknowns of a trial that is left out are estimated from that trial. `cross_validate`
        runs new fits instead. Priors of parameters are used, but their squares are not included. Parameters at a bound
        are fixed. NaN with one trial, with process noise or `errors`, if the fit has not converged, and if one fold
        alone determines a parameter.
        """
        trials = self.problem.trials
        if len(trials) < 2 or self.problem.model.has_likelihood or self.status not in diagnostics.AT_A_MINIMUM:
            return math.nan
        linearized = linearized_problem(self.linearization)
        free = [i for i, name in enumerate(self.names) if name not in self.identifiability.at_bound]
        cost = float(np.sum(linearized.costs_left_out(free, trial_folds(None, trials)[0])))
        return cost if math.isfinite(cost) else math.nan

    @property
    def title(self) -> str:
        """The size of the problem, in one line."""
        return self.problem.title

    def trajectories(self) -> list[tuple[str, Trajectory]]:
        """The fitted trajectory of every window, with the name of its trial, in the order of the windows.

        This simulates all windows.

        **Returns:** a list of (trial name, `Trajectory`).

        **Raises:** `ValueError` for a fit with process noise, because its states are filtered, not simulated. Use
        `smoothed`.
        """
        if self.problem.model.noise is not None:
            raise ValueError(
                "fit.trajectories: the fit has process noise, so the motion does not follow from its initial state. "
                "Use `fit.smoothed()`."
            )
        rides = self.problem.trajectories(self.point)
        return [(self.trial_names[k], ride) for (k, _, _), ride in zip(self.problem.slices, rides, strict=True)]

    def __repr__(self) -> str:
        bodies = diagnostics.describe_bodies(self.parameters, self.point.parameters)
        if (errors := self.problem.model.errors) is not None:
            bodies = [*bodies, errors.described(self.problem.channels)]
        end = f"{self.problem.cost_name} {costs_in_words(self)} by {self.method}"
        scope = [self.scope] if self.scope else []
        return "\n".join(
            [self.title, self.table(), *scope, *bodies, f"{end}: {diagnostics.STATUS[self.status]}", *self.notes]
        )


def load(path: str | os.PathLike[str], problem: Problem) -> Fit:
    """Load a fit that `Fit.save` has written.

        problem = Problem.of(system, trials, free, unknown=("roll",))  # as for the fit
        result = load("fit.npz", problem)

    The file contains numbers only: neither code nor trials. If the code has changed since (the system, jaxkane or JAX),
    the cost is computed again. A fit whose cost has changed is rejected.

    **Arguments:**

    - `path`: file to read.
    - `problem`: a `Problem` with the same system, trials and options as that of the fit. For `fit_bicycle`, construct
        it with `bicycle_problem`. Integration steps that the fit has chosen are read from the file.

    **Returns:** the same `Fit`, with the numbers of the saved one.

    **Raises:** `ValueError` if the problem differs (the message states the difference), if the code gives another cost,
    or if the file is damaged; `FileNotFoundError`.
    """
    refuse_other(problem, Problem, "load", "load(path, Problem.of(system, trials, free))")
    return Fit(**read_fit(Path(path).expanduser(), problem))
