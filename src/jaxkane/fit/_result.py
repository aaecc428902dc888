"""What a fit found, how sure it is, and what it could not tell."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._check import check_system
from .._system import System
from .._trajectory import Trajectory
from ._blocks import eliminate
from ._identifiability import Identifiability, look
from ._parameters import Parameters
from ._problem import Linearization, Point, Problem

STATUS = {
    "converged": "converged",
    "steps": "stopped after the last step, before it converged",
    "stuck": "stuck: no step lowers the cost",
    "interrupted": "interrupted: this is the best so far",
}


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """The result of a fit; print it for a table.

    - `system`: with the estimates in it. `estimates`, `start`: values by name. `gains` are among them.
    - `standard_errors`: by name, formal: from the inverse of J^T J with the nuisance values eliminated, times the
        residuals' variance. They hold for independent residuals of equal scaled size, and a right model.
    - `clustered_errors`: by name, robust to residuals that are correlated within a trial (sandwich, one cluster a
        trial); NaN with fewer trials than parameters plus two.
    - `correlation` (p, p) of the estimates, in the order of `names`.
    - `cost`: sum of squared residuals; `history`: of the cost. `status`, `message`: how it ended, in a word and in
        words.
    - `identifiability`: singular values and directions of the sensitivity, and what the data do not tell.
    - `residuals`: by trial and channel, (simulated - measured) / sigma (n_t,), NaN in gaps; `fitted`: simulated (n_t,).
    - `nuisance`: by trial, values of the biases and of the windows' starts by name.
    - `notes`: what a reader should know, in words.
    """

    problem: Problem
    point: Point
    linearization: Linearization
    history: tuple[float, ...]
    status: str
    method: str
    identifiability: Identifiability
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        problem: Problem,
        point: Point,
        at: Linearization,
        history: Sequence[float],
        status: str,
        method: str,
    ) -> Fit:
        """The result at a point."""
        seen = look(problem, at)
        fit = cls(problem, point, at, tuple(history), status, method, seen, ())
        return dataclasses.replace(fit, notes=(*seen.messages, *_notes(fit)))

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
    def system(self) -> System:
        return self.parameters.apply(self.problem.system, self.point.x)[0]

    @property
    def start(self) -> dict[str, float]:
        return dict(zip(self.names, self.parameters.start.tolist(), strict=True))

    @property
    def estimates(self) -> dict[str, float]:
        return dict(zip(self.names, np.asarray(self.parameters.values(self.point.x)).tolist(), strict=True))

    @property
    def message(self) -> str:
        words = STATUS[self.status]
        if self.status == "converged" and not self.identifiability.ok:
            words = "the cost has converged, but not every parameter is determined"
        return "; ".join([words, *(note.rstrip(".") for note in self.identifiability.messages)])

    @property
    def ok(self) -> bool:
        """Whether it converged and every parameter is determined."""
        return self.status == "converged" and self.identifiability.ok

    @property
    def singular_values(self) -> np.ndarray:
        return self.identifiability.singular_values

    @property
    def covariance(self) -> np.ndarray:
        """(p, p), in the parameters' units."""
        slope = np.asarray(jax.jacfwd(self.parameters.values)(self.point.x)).diagonal()
        return self.identifiability.covariance * np.outer(slope, slope)

    @property
    def standard_errors(self) -> dict[str, float]:
        return dict(zip(self.names, np.sqrt(self.covariance.diagonal()).tolist(), strict=True))

    @property
    def clustered_errors(self) -> dict[str, float]:
        blocks = np.asarray(eliminate(self.linearization.blocks, 0.0).R)  # (T, p+1, p+1)
        T, p = len(blocks), len(self.names)
        if p + 2 > T or not np.all(np.isfinite(self.identifiability.covariance)):
            return dict.fromkeys(self.names, float("nan"))
        A, r = blocks[:, :, :-1], blocks[:, :, -1]
        scores = np.einsum("tmi,tm->ti", A, r)
        bread = np.linalg.inv(np.einsum("tmi,tmj->ij", A, A))
        sandwich = T / (T - 1) * bread @ (scores.T @ scores) @ bread
        slope = np.asarray(jax.jacfwd(self.parameters.values)(self.point.x)).diagonal()
        return dict(zip(self.names, (np.sqrt(sandwich.diagonal()) * slope).tolist(), strict=True))

    @property
    def correlation(self) -> np.ndarray:
        covariance = self.identifiability.covariance
        deviation = np.sqrt(covariance.diagonal())
        with np.errstate(invalid="ignore"):
            return covariance / np.outer(deviation, deviation)

    @property
    def fitted(self) -> dict[str, dict[str, np.ndarray]]:
        return self._by_trial(lambda simulated, measured, sigma: simulated)

    @property
    def residuals(self) -> dict[str, dict[str, np.ndarray]]:
        return self._by_trial(lambda simulated, measured, sigma: (simulated - measured) / sigma)

    def _by_trial(self, value: Any) -> dict[str, dict[str, np.ndarray]]:
        problem, simulated = self.problem, np.asarray(self.linearization.simulated)
        found = {}
        for k, name in enumerate(self.trial_names):
            trial, found[name] = problem.trials[k], {}
            for c, channel in enumerate(problem.channels):
                if channel not in trial.measured:
                    continue
                y = np.full(trial.t.shape, np.nan)
                for i, (owner, first, n) in enumerate(problem.places):
                    if owner == k:
                        y[first : first + n] = simulated[i, c, :n]
                found[name][channel] = value(y, trial.measured[channel], trial.sigma[channel])
        return found

    @property
    def trial_names(self) -> tuple[str, ...]:
        """Names of the trials, numbered where they repeat."""
        names = [trial.name for trial in self.problem.trials]
        return tuple(n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names))

    @property
    def nuisance(self) -> dict[str, dict[str, Any]]:
        problem, n = self.problem, self.problem.nuisance
        names = (*problem.system.coordinates, *problem.system.speeds)
        guess = np.concatenate([np.asarray(problem.windows.q), np.asarray(problem.windows.u)], axis=1)
        starts = guess[:, [names.index(s) for s in n.start]] + np.asarray(self.point.z)
        owner = np.array([k for k, _, _ in problem.places])
        found = {}
        for k, name in enumerate(self.trial_names):
            labels = [f"bias of {c}" for c in (*n.sensors, *n.inputs)]
            found[name] = dict(zip(labels, np.asarray(self.point.b[k]).tolist(), strict=True))
            found[name] |= {f"start of {s}": starts[owner == k, j] for j, s in enumerate(n.start)}
        return found

    def trajectories(self) -> list[tuple[str, Trajectory]]:
        """The fitted motion of every window, with its trial's name."""
        names = self.trial_names
        rides = self.problem.trajectories(self.point)
        return [(names[k], ride) for (k, _, _), ride in zip(self.problem.places, rides, strict=True)]

    def table(self, truth: Mapping[str, float] | System | None = None) -> str:
        """Name, start, estimate and standard error of every parameter; and the truth, where it is known."""
        known = _truth(self, truth)
        head = f"{'parameter':<22}{'start':>12}{'estimate':>12}{'std. error':>12}"
        lines = [head + (f"{'truth':>12}{'error':>9}" if known else "")]
        errors, start = self.standard_errors, self.start
        for name, value in self.estimates.items():
            line = f"{name:<22}{start[name]:>12.5g}{value:>12.5g}{errors[name]:>12.2g}"
            if name in known:
                right = known[name]
                line += f"{right:>12.5g}{(value / right - 1 if right else value):>9.2{'%' if right else 'g'}}"
            lines.append(line)
        return "\n".join(lines)

    def __str__(self) -> str:
        n_r, n_unknown = self.problem.size
        title = (
            f"{type(self.problem.system).__name__}: {len(self.problem.trials)} trials, "
            f"{len(self.problem.places)} windows, {n_r} residuals, {len(self.names)} parameters, "
            f"{n_unknown - len(self.names)} nuisance values"
        )
        end = f"sum of squares {self.history[0]:.6g} -> {self.cost:.6g} by {self.method}: {STATUS[self.status]}"
        return "\n".join([title, self.table(), end, *self.notes])

    __repr__ = __str__


def _truth(fit: Fit, truth: Any) -> dict[str, float]:
    if truth is None or isinstance(truth, Mapping):
        return dict(truth or {})
    leaves = jax.tree.leaves(truth)
    entries = fit.parameters.entries
    return {e.name: float(np.ravel(leaves[e.leaf])[e.place]) for e in entries if e.input is None}


def _notes(fit: Fit) -> list[str]:
    """Warnings, in words: trade-offs, correlated residuals, bodies that cannot be."""
    notes = []
    correlation = fit.correlation
    for i, name in enumerate(fit.names):
        for j in range(i):
            if abs(correlation[i, j]) > 0.95:
                notes.append(f"{fit.names[j]} and {name} trade off: their correlation is {correlation[i, j]:.3f}.")
    lag = _autocorrelation(fit.residuals)
    if lag > 0.3:
        notes.append(
            f"The residuals are not noise: neighbours correlate by {lag:.2f}. The formal standard errors are too "
            f"small by a factor of about {((1 + lag) / max(1 - lag, 0.01)) ** 0.5:.1f}; compare `clustered_errors`."
        )
    problem = fit.problem
    window = jax.tree.map(lambda x: x[0], problem.windows)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_system(fit.system, window.t[0], window.q, window.u)
        except ValueError as error:
            notes.append(f"Not a possible body: {error}")
    notes.extend(f"Not a possible body: {warning.message}" for warning in caught)
    return notes


def _autocorrelation(residuals: Mapping[str, Mapping[str, np.ndarray]]) -> float:
    """Of neighbours, over all channels, each weighted by its size."""
    above = below = 0.0
    for channels in residuals.values():
        for r in channels.values():
            pairs = np.isfinite(r[1:]) & np.isfinite(r[:-1])
            above += float(np.sum(r[1:][pairs] * r[:-1][pairs]))
            below += float(np.sum(r[np.isfinite(r)] ** 2))
    return above / below if below > 0 else 0.0
