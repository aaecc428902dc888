"""The result of a fit: estimates, their errors, residuals, and what the data do not determine; saved and loaded."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._common.files import differences
from .._common.lookup import refuse_unknown
from .._integrate.trajectory import Trajectory
from .._system.system import System
from . import _diagnostics as diagnostics
from . import _statistics as statistics
from ._block_lsq import Blocks
from ._covariance import cluster_robust_covariance, clusters_of, intervals
from ._identifiability import Identifiability, identifiability_at
from ._io import described, read_state, tree_of, write_state
from ._linearize import Linearization
from ._model import Prediction, Unknowns
from ._parameters import Parameters, leaf_names
from ._problem import STEP_TOLERANCE, Problem, refuse_other
from ._statistics import ByTrial, ResidualTest
from ._tables import Rows, text_table


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """The result of a fit; print it for a table, `jaxkane.fit.report(fit)` for more, and `jaxkane.fit.save_report(fit,
    path)` for a page with pictures.

    It holds numbers: to look at it simulates nothing and fits nothing.

    - `system`: with the estimates in it. `estimates`, `start`: values by name. Gains and delays are among them.
    - `standard_errors`: by name, formal: from the inverse of J^T J with the nuisance values eliminated, the data
        counted by the residuals' variance and priors by their own deviations. They hold for independent residuals of
        equal scaled size, and a right model.
    - `clustered_errors`: by name, cluster-robust, for residuals that are correlated within a trial (jackknife, each
        trial left out in turn, linearized). With fewer trials than parameters plus two: within a window that starts
        freely; NaN with too few of both. `clusters` says which. `errors`: those of the two that intervals are from.
    - `intervals(level)`: by name. `correlation` (p, p) of the estimates, in the order of `names`.
    - `cost`: sum of squared residuals, with process noise minus twice the log likelihood; `history`: of the cost.
        `status`, `message`: how it ended, in a word and in words.
    - `held_out_cost`: the sum of squares of trials that are left out in turn, linearized at the estimates, with starts
        and biases of their own; `cross_validate` fits anew instead. NaN with one trial, with process noise or priors,
        and where no fit has converged.
    - `identifiability`: singular values and directions of the sensitivity, and what the data do not determine.
    - `residuals`: by trial and channel, (simulated - measured) / sigma (n_t,), NaN in gaps; `fitted`: simulated (n_t,).
        With process noise: predicted, from all that was measured before, and the normalized innovations.
        `tests`: by trial and channel, a `ResidualTest`. `variance_accounted_for`: by channel, over all trials.
    - `nuisance`: by trial, values of the biases and of the windows' starts by name; with process noise, starts that
        were given a deviation are part of the filter (`jaxkane.fit.smoothed`).
    - `step_error`: by how much halving the step of integration moves the residuals.
    - `failed`: by name, trials that could not be simulated and are not among these, with the reason.
    - `notes`: what a reader should know, in words.
    """

    problem: Problem
    point: Unknowns
    linearization: Linearization
    step_errors: np.ndarray  # (W,), see `Problem.step_errors`
    history: tuple[float, ...]
    status: str
    method: str
    failed: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)

    @classmethod
    def of(
        cls, problem: Problem, point: Unknowns, at: Linearization, history: Sequence[float], status: str, method: str
    ) -> Fit:
        """The result at a point where the problem has been linearized.

        With a fixed step of integration all windows are simulated once more, with half of it; not after Ctrl-C.
        """
        errors = np.full(len(problem.slices), np.nan)
        if status != "interrupted":
            try:
                errors = problem.step_errors(point, at.prediction.with_deviations)
            except KeyboardInterrupt:
                status = "interrupted"
        return cls(problem, point, at, errors, tuple(history), status, method)

    @property
    def parameters(self) -> Parameters:
        return self.problem.parameters

    @property
    def names(self) -> tuple[str, ...]:
        return self.parameters.names

    @property
    def cost(self) -> float:
        return self.linearization.cost

    @property
    def variance(self) -> float:
        """Of a residual: the data's sum of squares by residuals less the unknowns that they and not priors determine;
        one where `sigma` and the model are right, NaN where nothing is left. With process noise it is taken to be one.
        """
        return self.identifiability.variance

    @property
    def mean_normalized_innovation_squared(self) -> float:
        """The mean square of the normalized residuals; with process noise one where all noise is as it was taken."""
        flat = np.concatenate([r for channels in self.residuals.values() for r in channels.values()])
        return float(np.nanmean(flat**2))

    @property
    def system(self) -> System:
        return self.parameters.apply(self.problem.system, self.point.x)[0]

    @property
    def start(self) -> dict[str, float]:
        return self._by_name(self.parameters.start)

    @property
    def estimates(self) -> dict[str, float]:
        return self._by_name(self.parameters.values(self.point.x))

    def _by_name(self, values: Any) -> dict[str, float]:
        return dict(zip(self.names, np.asarray(values).tolist(), strict=True))

    @functools.cached_property
    def identifiability(self) -> Identifiability:
        return identifiability_at(self.problem, self.point, self.linearization, fitted=self.status != "validated")

    @property
    def message(self) -> str:
        ending = diagnostics.STATUS[self.status]
        if self.status == "converged" and not self.identifiability.ok:
            ending = "the cost has converged, but not every parameter is determined"
        no_freedom = diagnostics.no_degrees_of_freedom(self.problem, self.variance)
        notes = (*self.identifiability.messages, *no_freedom, *self._coarse_steps)
        return "; ".join([ending, *(note.rstrip(".") for note in notes)])

    @property
    def _coarse_steps(self) -> tuple[str, ...]:
        return (diagnostics.coarse_steps(self.problem, self.step_error),) if self.too_coarse else ()

    @property
    def ok(self) -> bool:
        """Whether it converged, every parameter is determined, and the steps of integration are fine enough."""
        return self.status == "converged" and self.identifiability.ok and not self.too_coarse

    @property
    def step_error(self) -> float:
        """By how much halving the fixed step of integration moves all residuals together, in standard deviations: about
        by as many of its standard errors an estimate can be off at most. NaN where the step follows from tolerances,
        and after Ctrl-C."""
        return float(np.linalg.norm(self.step_errors))

    @property
    def too_coarse(self) -> bool:
        """Whether halving the fixed step moves all residuals together by more than a quarter of what noise does: by as
        much of its standard errors an estimate may be off."""
        noise = max(1.0, np.nan_to_num(self.variance, nan=1.0)) ** 0.5
        return bool(self.step_error > noise * STEP_TOLERANCE[1])

    @property
    def singular_values(self) -> np.ndarray:
        return self.identifiability.singular_values

    @property
    def covariance(self) -> np.ndarray:
        """(p, p), in the parameters' units; NaN of parameters that are those of another fit (`validate`)."""
        return self._of_estimates(self.identifiability.covariance)

    def _of_estimates(self, covariance: np.ndarray) -> np.ndarray:
        return np.full_like(covariance, np.nan) if self.status == "validated" else covariance

    @property
    def standard_errors(self) -> dict[str, float]:
        return self._by_name(np.sqrt(self.covariance.diagonal()))

    @functools.cached_property
    def clustered_covariance(self) -> np.ndarray:
        """(p, p), in the parameters' units, robust to residuals that are correlated within a trial, or a window: see
        `clusters`."""
        directions = self.identifiability.directions
        along = cluster_robust_covariance(self.problem, self.point, self.linearization, directions)
        return self._of_estimates(self.identifiability.in_units(along))

    @property
    def clustered_errors(self) -> dict[str, float]:
        return self._by_name(np.sqrt(self.clustered_covariance.diagonal()))

    @property
    def uses_clustered_errors(self) -> bool:
        """Whether `errors` are the cluster-robust ones: residuals are no noise, and trials or windows are enough."""
        return bool(self.clusters[1] and abs(self.autocorrelation) > statistics.CORRELATED)

    @property
    def errors(self) -> dict[str, float]:
        """Those of all intervals: the cluster-robust ones where `uses_clustered_errors`, else the formal ones."""
        return self.clustered_errors if self.uses_clustered_errors else self.standard_errors

    @property
    def clusters(self) -> tuple[str, int]:
        """Within what the cluster-robust errors take residuals to be correlated, "trial" or "window", and how many
        there are; ("", 0) where there are too few."""
        return clusters_of(self.problem)

    @property
    def degrees_of_freedom(self) -> float:
        """Of all intervals: trials (or windows) less one where `uses_clustered_errors`, else residuals less the
        unknowns that they and not priors determine."""
        return self.clusters[1] - 1 if self.uses_clustered_errors else self.identifiability.degrees_of_freedom

    def quantile(self, level: float = 0.95) -> float:
        """Of Student's distribution, two-sided, with as many degrees of freedom as `degrees_of_freedom`."""
        return statistics.t_quantile(level, self.degrees_of_freedom)

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals by name: symmetric, but for a bound of the parameter, at which they end.

        From `errors`; `degrees_of_freedom` says with how many degrees.

        **Raises:** `ValueError` for a level that is not between 0 and 1.
        """
        half = self.quantile(level) * np.array(list(self.errors.values()))
        return dict(zip(self.names, intervals(self.parameters, self.point.x, half), strict=True))

    @property
    def correlation(self) -> np.ndarray:
        deviation = np.sqrt(self.covariance.diagonal())
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(deviation, deviation)

    @functools.cached_property
    def fitted(self) -> ByTrial:
        return statistics.by_trial(self.problem, np.asarray(self.linearization.simulated))

    @functools.cached_property
    def residuals(self) -> ByTrial:
        deviation = self.linearization.prediction.deviation
        known = None if deviation is None else statistics.by_trial(self.problem, np.asarray(deviation))
        scaled = {}
        for (name, channels), trial in zip(self.fitted.items(), self.problem.trials, strict=True):
            sigma = trial.sigma if known is None else known[name]
            scaled[name] = {channel: (y - trial.measured[channel]) / sigma[channel] for channel, y in channels.items()}
            for residuals in scaled[name].values():
                residuals.flags.writeable = False  # what follows from them is kept
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
    def variance_accounted_for(self) -> dict[str, float]:
        """By channel, over all trials; below zero is worse than a constant."""
        shares, trials = {}, list(zip(self.fitted.values(), self.problem.trials, strict=True))
        for channel in self.problem.channels:
            measured = [trial.measured[channel] for _, trial in trials if channel in trial.measured]
            fitted = [channels[channel] for channels, _ in trials if channel in channels]
            shares[channel] = statistics.variance_accounted_for(measured, fitted)
        return shares

    @functools.cached_property
    def autocorrelation(self) -> float:
        """Of neighbouring residuals, over all channels, each weighted by its size."""
        every = (r for channels in self.residuals.values() for r in channels.values())
        return float(statistics.autocorrelations(every, 1)[0])

    @property
    def trial_names(self) -> tuple[str, ...]:
        """Names of the trials, numbered where they repeat."""
        return statistics.trial_names(self.problem)

    @property
    def nuisance(self) -> dict[str, dict[str, Any]]:
        """By trial, values of the biases and gains, and of the starts of its windows (W,), by name."""
        problem, n = self.problem, self.problem.model.nuisance
        starts = np.asarray(problem.starts(self.point))[:, problem.model.unknown_places]
        owner = np.array([k for k, _, _ in problem.slices])
        filtered = self.linearization.prediction.unknowns  # with process noise a window is a trial
        b = self.point.b if filtered is None else filtered
        in_filter = np.isfinite(np.asarray(n.start_deviation)) & (problem.model.noise is not None)
        values = {}
        for k, name in enumerate(self.trial_names):
            values[name] = {
                f"{kind.split()[0]} of {what}": float(b[k, j]) + (1.0 if kind.startswith("gain") else 0.0)
                for j, (kind, what) in enumerate(n.trial)
            }
            values[name] |= {f"start of {s}": starts[owner == k, j] for j, s in enumerate(n.start) if not in_filter[j]}
        return values

    @functools.cached_property
    def notes(self) -> tuple[str, ...]:
        """What a reader should know, in words."""
        problem, identifiability = self.problem, self.identifiability
        mean_squared = self.mean_normalized_innovation_squared
        return (
            *diagnostics.not_converged(self.status),
            *(f"{name} is left out: {why}." for name, why in self.failed.items()),
            *(() if self.status == "validated" else self._notes_on_parameters),
            *diagnostics.outlier_trials(self.residuals),
            *diagnostics.autocorrelated_residuals(self.autocorrelation),
            *(diagnostics.wrong_noise(self.residuals, mean_squared) if problem.model.noise is not None else ()),
            *diagnostics.wrong_sigma(problem, self.variance, identifiability.degrees_of_freedom),
            *diagnostics.no_degrees_of_freedom(problem, self.variance),
            *self._coarse_steps,
            *diagnostics.infeasible_bodies(problem, self.point),
            *diagnostics.constant_records(problem),
            *diagnostics.suspicious_records(problem),
            *diagnostics.duplicate_trials(problem),
            *diagnostics.wrong_units(problem, self.fitted),
            *diagnostics.poorly_fitted_channels(self.tests, self.variance),
        )

    @property
    def _notes_on_parameters(self) -> tuple[str, ...]:
        """Of those that were fitted."""
        parameters, identifiability = self.parameters, self.identifiability
        return (
            *filter(None, [identifiability.rank_message]),
            *identifiability.messages,
            *diagnostics.correlated_parameters(parameters, self.correlation),
            *diagnostics.bodies_at_the_boundary(parameters, self.point.x),
            *diagnostics.far_from_start(parameters, self.start, self.estimates, self.standard_errors),
            *diagnostics.known_by_prior(parameters, identifiability.given_sigma_errors),
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the numbers of this fit to one file, whole or not at all; `jaxkane.fit.load(path, problem)` reads it.

        **Returns:** the path.
        """
        path, versions = Path(path).expanduser(), ("jaxkane", "jax", "diffrax")
        key = {
            "fit": {"status": self.status, "method": self.method, "failed": dict(self.failed)},
            "versions": ", ".join(f"{name} {importlib.metadata.version(name)}" for name in versions),
            **described(self.problem),
        }
        at, step = self.linearization, self.problem.windows.step
        numbers = {"R": at.blocks.R, "prediction": at.prediction, "step_errors": self.step_errors}
        write_state(path, key, {"point": self.point, "step": step, "history": np.array(self.history), **numbers})
        return path

    @functools.cached_property
    def held_out_cost(self) -> float:
        """The sum of squares of trials that are left out in turn."""
        T, noise = len(self.problem.trials), self.problem.specification.noise
        if T < 2 or noise is not None or self.status != "converged" or self.parameters.has_prior.any():
            return math.nan
        linearized = statistics.linearized_problem(self.problem, self.linearization, self.point)
        return float(np.sum(linearized.costs_left_out(range(len(self.names)), statistics.folds_of(None, T))))

    @property
    def title(self) -> str:
        """How much was fitted, in a line."""
        problem, (n_r, n_unknown) = self.problem, self.problem.size
        return (
            f"{type(problem.system).__name__}: {len(problem.trials)} trials, {len(problem.slices)} windows, {n_r} "
            f"residuals, {len(self.names)} parameters, {n_unknown - len(self.names)} nuisance values"
        )

    def table(self, truth: Mapping[str, float] | System | None = None) -> str:
        """Name, start, estimate and standard error of every parameter; and the truth, where it is known."""
        return text_table(parameter_rows(self, truth))

    def __str__(self) -> str:
        bodies = diagnostics.describe_bodies(self.parameters, self.point.x)
        end = f"{self.problem.cost_name} {costs_in_words(self, '->')} by {self.method}"
        return "\n".join([self.title, self.table(), *bodies, f"{end}: {diagnostics.STATUS[self.status]}", *self.notes])

    __repr__ = __str__


def costs_in_words(fit: Fit, arrow: str) -> str:
    """From the initial guess to the end, and of trials left out in turn."""
    held_out = "" if math.isnan(fit.held_out_cost) else f" ({fit.held_out_cost:.6g} of trials left out in turn)"
    return f"{fit.history[0]:.6g} {arrow} {fit.cost:.6g}{held_out}"


def parameter_rows(fit: Fit, truth: Mapping[str, float] | System | None = None, detailed: bool = False) -> Rows:
    """Of every parameter name, unit, start, estimate and standard error; the cluster-robust error and the interval;
    the truth, where it is known, and how far the estimate is from it. Of a learned function one row for all numbers."""
    known, learned, errors = _true_values(fit, truth), fit.parameters.learned, fit.standard_errors
    clustered, ends = (fit.clustered_errors, fit.intervals()) if detailed else ({}, {})
    head = ["parameter", "unit", "start", "estimate", "std. error"]
    head += [f"by {fit.clusters[0] or 'trial'}", "95 % interval"] * detailed + ["truth", "error"] * bool(known)
    rows: list[list[str]] = [head]
    for name, unit, part in zip(fit.names, fit.parameters.units, learned, strict=True):
        if part:
            continue
        value = fit.estimates[name]
        row = [name, unit, f"{fit.start[name]:.5g}", f"{value:.5g}", f"{errors[name]:.2g}"]
        row += [f"{clustered[name]:.2g}", "{:.4g} to {:.4g}".format(*ends[name])] if detailed else []
        if name in known:
            right = known[name]
            row += [f"{right:.5g}", f"{value / right - 1:.2%}" if right else f"{value:.2g}"]
        rows.append(row)
    for part in dict.fromkeys(filter(None, learned)):
        own = [name for name, of in zip(fit.names, learned, strict=True) if of == part]
        start, end = (np.sqrt(np.mean([at[name] ** 2 for name in own])) for at in (fit.start, fit.estimates))
        rows.append([f"{part}, rms of {len(own)} learned numbers", "", f"{start:.5g}", f"{end:.5g}"])
    return [[*row, *[""] * (len(head) - len(row))] for row in rows]


def _true_values(fit: Fit, truth: Mapping[str, float] | System | None) -> dict[str, float]:
    """Of free parameters, from a system or by name.

    **Raises:** `ValueError` for a name that is neither free nor a parameter; `TypeError` for another kind of system.
    """
    if truth is None:
        return {}
    system = fit.problem.system
    if isinstance(truth, Mapping):
        refuse_unknown(truth, (*fit.names, *leaf_names(system)), "`truth` names")
        return {name: float(truth[name]) for name in fit.names if name in truth}
    if type(truth) is not type(system):
        raise TypeError(f"`truth` is a {type(system).__name__}, or values by name; got {type(truth).__name__}.")
    leaves = jax.tree.leaves(truth)
    targets = {e.name: e.targets[0] for e in fit.parameters.entries if e.targets}
    return {name: float(jnp.ravel(leaves[leaf])[place]) for name, (leaf, place, _) in targets.items()}


SAME_COST = 1e-6
"""By what part of it the cost may differ where the code has changed since."""


def load(path: str | os.PathLike[str], problem: Problem) -> Fit:
    """A fit that `Fit.save` has written.

        problem = Problem.of(system, trials, free, unknown=("roll",))  # as it was posed
        result = load("fit.npz", problem)

    A file holds numbers only: no code, and no trials. `problem` is posed again from the same system, trials and
    options (for `fit_bicycle` by `bicycle_problem`); steps of integration that the fit has chosen come from the file.
    Where the code has changed since (the system's, jaxkane's or JAX's), the cost is computed anew, and a fit that no
    longer has it is refused.

    **Returns:** the same `Fit`: what it says are the numbers of the one that was saved.

    **Raises:** `ValueError` that says in what the problem differs, that the code gives another cost, or that the file
    is damaged; `FileNotFoundError`.
    """
    refuse_other(problem, Problem, "load", "load(path, Problem.of(system, trials, free))")
    path = Path(path).expanduser()
    saved, arrays = read_state(path)
    of_fit: dict[str, Any] = saved.pop("fit", {})
    if not of_fit:
        raise ValueError(f"{path} is the checkpoint of a fit, not a fit that was saved: give it as `checkpoint=`.")
    names, failed = statistics.trial_names(problem), of_fit["failed"]
    if failed and failed.keys() <= {*names}:
        kept = [trial for name, trial in zip(names, problem.trials, strict=True) if name not in failed]
        problem = problem.with_trials(kept)
    step = tree_of(path, arrays, "step", problem.windows.step)
    if problem.chooses_steps and step.shape == problem.windows.step.shape:
        problem = problem.with_steps(step)
    key = described(problem)
    wrong = differences(*({k: d[k] for k in d if k not in ("program", "versions")} for d in (saved, key)))
    if wrong:
        raise ValueError(f"{path} is the fit of another problem. It differs in {wrong}. Pose the problem as it was.")
    of_filter = jnp.zeros(()) if problem.model.noise is not None else None
    prediction = Prediction(jnp.zeros(()), jnp.zeros(()), of_filter, of_filter, of_filter)
    like = {"point": problem.start, "R": 0.0, "step_errors": 0.0, "history": 0.0, "prediction": prediction}
    state: dict[str, Any] = {name: tree_of(path, arrays, name, tree) for name, tree in like.items()}
    point = state["point"]
    at = Linearization(Blocks.of(problem.model.nuisance, state["R"], problem.by_trial), state["prediction"])
    if saved["program"] != key["program"]:
        now = problem.cost(point)
        if not abs(now - at.cost) <= SAME_COST * at.squares:
            raise ValueError(
                f"{path}: the code has changed since this fit was saved (by {saved['versions']}), and "
                f"{problem.cost_name} with it: {at.cost:.6g} then, {now:.6g} now. Fit anew, from `start=` if you like, "
                "or go back to that code."
            )
    errors, history = np.asarray(state["step_errors"]), tuple(float(c) for c in state["history"])
    return Fit(problem, point, at, errors, history, of_fit["status"], of_fit["method"], of_fit["failed"])


def trajectories(fit: Fit) -> list[tuple[str, Trajectory]]:
    """The fitted motion of every window, with the name of its trial, in their order.

    **Raises:** `ValueError` for a fit with process noise, whose motion is no simulation.
    """
    if fit.problem.model.noise is not None:
        raise ValueError("trajectories: process noise disturbs this fit's motion, which `smoothed(fit)` gives.")
    rides = fit.problem.trajectories(fit.point)
    return [(fit.trial_names[k], ride) for (k, _, _), ride in zip(fit.problem.slices, rides, strict=True)]
