"""Results of one linearization: the posterior, smoothed trajectories, cross-validation and score tests. Runs no fit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from scipy.special import ndtri

from ..._common.lookup import by_name, whole_number
from ..._kane.api import _dependent_speeds
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import on_device
from ..._system.system import unpacked
from ...estimate._filter import brought_back
from ..problem.model import Model, Unknowns
from ..problem.problem import Problem
from ..problem.trial import Trial
from ..problem.windows import Windows, state_names
from ..solve.kalman import filtered, smoothed_moments
from ..solve.linearization import Blocks, Eliminated, Linearization, eliminate, map_windows, starts_of
from .statistics import (
    FEWEST_TRIALS_OF_A_TEST,
    LARGEST_LEVERAGE,
    Clusters,
    check_level,
    effective_sample_fraction,
    f_test,
    formal_covariance,
    jackknife,
    log_likelihood,
    wald_test,
)

LOG_2PI = math.log(2 * math.pi)

# Prior standard deviation of an initial state or trial unknown that has none, in multiples of its standard error.
DIFFUSE = 1e4


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
        whole_number(n, 0, "`n`")
        rng = np.random.default_rng(seed)
        x = jnp.asarray(rng.multivariate_normal(self.mean, self.covariance, size=n), self.fit.point.parameters.dtype)
        values = np.asarray(jax.vmap(self.fit.parameters.values)(x))
        return dict(zip(self.fit.names, values.T, strict=True))


@dataclasses.dataclass(frozen=True, repr=False)
class Smoothed:
    """The trajectory of one trial, given all of its measurements and the estimated parameters.

        motion = fit.smoothed()["ride 1"]
        motion["roll"], motion.deviation("roll"), motion.band("roll")

    - `t` (n_t,): times of the trial [s].
    - `names`: coordinates, independent speeds, states, dependent speeds, and the trial unknowns, such as "offset of
        roll".
    - `mean` (n_t, n), `covariance` (n_t, n, n): in the order of `names`. Dependent speeds and dependent coordinates
        follow from the others to first order, so the covariance is singular.

    The uncertainty of the parameters is not included.
    """

    t: np.ndarray
    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        return by_name(name, [(self.names, self.mean)], {}, "this motion")

    def deviation(self, name: str) -> np.ndarray:
        """Standard deviation (n_t,).

        **Arguments:**

        - `name`: one of `names`.
        """
        deviations = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return by_name(name, [(self.names, deviations)], {}, "this motion")

    def band(self, name: str, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Pointwise probability band.

        **Arguments:**

        - `name`: one of `names`.
        - `level`: probability, between 0 and 1.

        **Returns:** lower and upper ends (n_t,), which contain the value with this probability at each time.

        **Raises:** `ValueError` if `level` is not between 0 and 1.
        """
        check_level(level)
        half = float(ndtri(0.5 * (1 + level))) * self.deviation(name)
        return self[name] - half, self[name] + half

    def __repr__(self) -> str:
        return f"Smoothed({len(self.t)} times from {self.t[0]:g} to {self.t[-1]:g} s: {', '.join(self.names)})"


class Posterior:
    """The methods of a `Fit` that treat its unknowns as random."""

    def laplace(self: Any) -> Laplace:
        """The Laplace approximation of the posterior. Nuisance parameters are integrated out, `sigma` is used as it was
        passed.

            log evidence = log p(measurements | unknowns) + log p(unknowns) + 1/2 log det(2 pi C)

        All terms are evaluated at the minimum. C is the covariance of all unknowns in their own units. `Free.scale` and
        the initial guess do not affect the result (MacKay, Bayesian interpolation, Neural Computation 4, 1992). The
        result is exact if the trajectory is linear in all unknowns.

        The prior of a parameter is its Gaussian prior, truncated at its bounds, or uniform between two `bounds`.
        Without a prior and without two bounds, the prior is improper and the evidence is NaN. Initial states and
        offsets without a standard deviation have a prior density of one per unit. Compare only models with the same
        such unknowns, or pass standard deviations.

        **Returns:** a `Laplace`.

        **Raises:** `ValueError` with the names of parameters that the data do not determine, and for a fit that is not
        at a minimum.
        """
        undetermined = [name for name, error in self.standard_errors.items() if np.isinf(error)]
        if undetermined:
            names = ", ".join(undetermined)
            raise ValueError(f"These data do not determine {names}. Add a prior, or omit it from `free`.")
        eliminated = eliminate(self.linearization.blocks, 0.0)
        to_gain = self.linearization.squares - eliminated.step(1e-9)[1]
        if self.status == "validated" or not to_gain < 0.1:
            raise ValueError(
                f"The fit has not converged ({self.status}): a step would lower the sum of squares by {to_gain:.3g}. "
                "Continue with `minimize(fit.problem, LeastSquares(), start=fit.point)`."
            )
        message = _why_improper(self, eliminated)
        s, parameters = np.linalg.svd(np.asarray(eliminated.rows[0], float), compute_uv=False), self.parameters
        evidence = log_likelihood(self.problem, self.cost) + _log_nuisance(self.problem, eliminated)
        evidence += float(np.sum(0.5 * LOG_2PI - np.log(s)) + parameters.log_determinant(self.point.parameters))
        evidence = math.nan if message else evidence + float(parameters.log_prior_constants.sum())
        covariance = self.identifiability.covariance_of_x
        return Laplace(self, np.asarray(self.point.parameters), covariance, evidence, message)

    def marginal_likelihood(self: Any) -> float:
        """The log density of the measurements at the estimates, with initial states and trial unknowns integrated out.

            log p = -1/2 sum of squares + log priors - 1/2 log det (J^T J / 2 pi)

        J is the Jacobian with respect to the initial states of all windows and the trial unknowns. With process noise,
        the filter computes this density. Both are equal if the trajectory is linear, each window is one sample long,
        and the `defect_std` of the windows is the process noise of one step. Initial states and offsets without a
        standard deviation have a prior density of one per unit.

        **Returns:** the log density.
        """
        problem, at = self.problem, self.linearization
        evidence = _log_nuisance(problem, eliminate(at.blocks, 0.0))
        return log_likelihood(problem, self.cost - at.prior_squares) + evidence

    def smoothed(self: Any) -> dict[str, Smoothed]:
        """The trajectory of each trial of a fit with process noise, estimated from all measurements of the trial.

        The method is the extended Bryson-Frazier smoother. It is equivalent to the Rauch-Tung-Striebel smoother and
        does not need the inverse of the covariance. An initial state or an offset without a standard deviation has a
        diffuse prior. The uncertainty of the parameters is not included.

        **Returns:** by trial, a `Smoothed` with mean and covariance.

        **Raises:** `ValueError` for a fit without process noise. Use `trajectories`.
        """
        problem, system = self.problem, self.problem.system
        if problem.model.noise is None:
            raise ValueError(
                "fit.smoothed: the fit has no process noise, so the motion follows from its initial state. Use "
                "`fit.trajectories()` or `fit.fitted`, or fit with `noise={...}`."
            )
        starts, _ = starts_of(problem.model, problem.windows, self.point)
        mean, root = _smoothed(problem.model, problem.windows, self.point, starts, _beginnings(self))
        unknowns = problem.model.nuisance.trial_names
        names = (*state_names(system), *system.dependent_speeds, *unknowns)
        mean, root = np.array(mean, float), np.asarray(root, float)
        mean[:, :, len(names) - len(unknowns) :] += np.asarray(problem.model.nuisance.trial_center)
        motions = {}
        for k, (name, (_, first, n)) in enumerate(zip(self.trial_names, problem.slices, strict=True)):  # window = trial
            covariance = np.einsum("tik,tjk->tij", root[k, :n], root[k, :n])
            motions[name] = Smoothed(problem.trials[k].t[first : first + n], names, mean[k, :n], covariance)
        return motions


def _why_improper(fit: Any, eliminated: Eliminated) -> str:
    """A sentence about parameters with an improper prior, or initial states and trial unknowns with neither data nor a
    prior, whose posterior is improper. Otherwise empty.
    """
    problem, n = fit.problem, fit.problem.model.nuisance
    improper = [name for name, c in zip(fit.names, fit.parameters.log_prior_constants, strict=True) if np.isnan(c)]
    if improper:
        return (
            f"No evidence: without a prior, or both bounds, any value of {', '.join(improper)} is as likely as any "
            "other, and no data are expected more than others. Give `prior` or `bounds`."
        )
    z, b = eliminated.informed  # (T, m, n_z), (T, n_b)
    counts = np.append(problem.active_windows, False)[np.asarray(problem.by_trial)]  # (T, m)
    names = [name for j, name in enumerate(n.window_names) if np.any(counts & ~z[..., j])]
    names += [name for j, name in enumerate(n.trial_names) if np.any(counts.any(axis=1) & ~b[:, j])]
    text = f"No evidence: the data do not determine {', '.join(names)} of every window. Pass a standard deviation."
    return text if names else ""


def _log_nuisance(problem: Problem, eliminated: Eliminated) -> float:
    """Log prior density of initial states, links of windows and trial unknowns, without the squares that are in the
    cost, plus 1/2 log det(2 pi C) of those with information.
    """
    n, first = problem.model.nuisance, np.asarray(problem.windows.first).sum()
    counts = (  # number of densities of each nuisance parameter
        (n.start_deviation, first if n.has_defects else len(problem.slices)),
        (n.trial_deviation, first),
        (n.defect_std, np.asarray(problem.windows.linked).sum()),
    )
    total = 0.5 * sum(map(np.count_nonzero, eliminated.informed)) * LOG_2PI - 0.5 * eliminated.log_determinant
    for deviations, count in counts:
        known = np.asarray(deviations, float)[np.isfinite(deviations)]
        total -= float(count) * float(np.sum(np.log(known) + 0.5 * LOG_2PI))
    return total


def _beginnings(fit: Any) -> Array:
    """Initial standard deviations of the filters (W, n + n_b): those that were passed, otherwise very large ones."""
    problem, blocks = fit.problem, fit.linearization.blocks
    nuisance, n = problem.model.nuisance, len(state_names(problem.system))
    R, n_z, n_b = np.asarray(blocks.R, float), blocks.n_z, blocks.n_b
    information = np.linalg.norm(R[:, :, : n_z + n_b], axis=1)  # (W, n_z + n_b)
    wide = DIFFUSE / np.where(information > 0, information, 1.0)
    stated = np.concatenate([np.asarray(nuisance.start_deviation), np.asarray(nuisance.trial_deviation)])
    deviations = np.where(np.isfinite(stated), stated, wide)
    begin = np.zeros((R.shape[0], n + n_b))
    begin[:, problem.model.unknown_places] = deviations[:, :n_z]
    begin[:, n:] = deviations[:, n_z:]
    return jnp.asarray(begin, problem.windows.t.dtype)


@jit
def _smoothed(model: Model, windows: Windows, point: Unknowns, starts: Array, begin: Array) -> tuple[Array, Array]:
    """By trial, the mean (W, n_t, n) and a square root of the covariance (W, n_t, n, k) of [q, u, x, u_dep, b]."""
    n = len(state_names(model.system))

    def of_trial(arguments: PyTree) -> tuple[Array, Array]:
        window, b, start, begin = arguments
        system, _ = model.parameters.apply(model.system, point.parameters, window.applies)
        result = filtered(model, window, start, b, point.parameters, begin)
        v, S = smoothed_moments(result.steps)
        v, S = jax.vmap(lambda t, v, S: brought_back(lambda _: system, t, v, S))(window.t, v, S)

        def whole(t: Array, v: Array) -> Array:
            state = unpacked(system, v[:n])
            u_dep = _dependent_speeds(system, t, state.q, state.u, {})
            return jnp.concatenate([v[:n], u_dep, v[n:]])

        def at(t: Array, v: Array, S: Array) -> tuple[Array, Array]:
            along = jax.vmap(lambda dv: jax.jvp(lambda v: whole(t, v), (v,), (dv,)), in_axes=1, out_axes=(None, 1))
            return along(S)

        return jax.vmap(at)(window.t, v, S)

    return map_windows(of_trial, (windows, point.trial_unknowns[windows.trial], starts, begin))


def trial_folds(
    folds: int | str | Sequence[Sequence[int]] | None, trials: Sequence[Trial]
) -> tuple[list[list[int]], str]:
    """Groups of trials that are left out together, and their description as text.

    None: each trial alone; with eleven or more trials, five folds.

    **Raises:** `ValueError` for folds that do not leave out each trial exactly once, and for a label that a trial does
    not have.
    """
    T = len(trials)
    if isinstance(folds, str):
        missing = [trial.name for trial in trials if folds not in trial.labels]
        if missing:
            known = ", ".join(sorted({label for trial in trials for label in trial.labels})) or "none"
            raise ValueError(
                f"`folds`: {missing[0]} has no label {folds!r}; the labels of these trials are: {known}. Pass "
                f"Trial(..., labels={{{folds!r}: ...}})."
            )
        by_label: dict[str | float, list[int]] = {}
        for k, trial in enumerate(trials):
            by_label.setdefault(trial.labels[folds], []).append(k)
        if len(by_label) < 2:
            raise ValueError(
                f"`folds`: all trials have the same {folds}, {trials[0].labels[folds]!r}, so none can be left out. Use "
                "another label."
            )
        labels = (x if isinstance(x, str) else f"{x:g}" for x in by_label)
        return list(by_label.values()), f"each {folds}: {', '.join(labels)}"
    number = (T if T <= 10 else 5) if folds is None else folds
    groups = [range(k, T, number) for k in range(number)] if isinstance(number, int) else number
    groups = [[int(k) for k in group] for group in groups]
    if sorted(k for group in groups for k in group) != list(range(T)) or not all(groups) or len(groups) < 2:
        raise ValueError(
            f"`folds` must be between 2 and the number of trials, {T}, or contain each of the trials 0 to {T - 1} "
            f"exactly once, in at least two groups; got {folds}."
        )
    alone = all(len(group) == 1 for group in groups)
    return groups, "each trial alone" if alone else f"{len(groups)} folds of the trials"


@dataclasses.dataclass(frozen=True)
class LinearizedProblem:
    """Linear least squares in x, in rows by trial: residuals A_t x + r_t, and priors.

    - `data` (T, m, n + 1): A_t and r_t.
    - `priors` (k, n + 1): one row for each x, followed by the joint priors of several.
    - `norms` (n,): norms of the columns before other unknowns were eliminated.
    """

    data: np.ndarray
    priors: np.ndarray
    norms: np.ndarray

    def of(self, places: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Sensitivity (M, k) and residuals (M,) if only the unknowns at `places` are free, with their priors."""
        places = list(places)
        priors = self.priors[[*places, *range(self.priors.shape[1] - 1, len(self.priors))]]
        rows = np.concatenate([self.data.reshape(-1, self.data.shape[-1]), priors])
        return rows[:, places], rows[:, -1]

    def minimum(self, places: Sequence[int]) -> tuple[np.ndarray, float]:
        """The step (k,) of these unknowns to the minimum, and the sum of squares there."""
        A, r = self.of(places)
        x = solved(A, r)
        return x, float(np.sum((A @ x + r) ** 2))

    def costs_left_out(self, places: Sequence[int], folds: Sequence[Sequence[int]]) -> np.ndarray:
        """Cross-validation: sums of squares (n_folds,) of trials left out in turn, with these unknowns estimated from
        the others.

        Infinite if the others determine fewer of them.
        """
        places, costs = list(places), []
        rank = _rank(self.of(places)[0])
        for fold in map(list, folds):
            rest, out = dataclasses.replace(self, data=np.delete(self.data, fold, axis=0)), self.data[fold]
            x, _ = rest.minimum(places)
            predicts = _rank(rest.of(places)[0]) == rank
            costs.append(np.sum((out[:, :, places] @ x + out[:, :, -1]) ** 2) if predicts else np.inf)
        return np.array(costs)


def linearized_problem(at: Linearization, b: Sequence[int] | None = None) -> LinearizedProblem:
    """A linearization with nuisance parameters eliminated.

    `b`: trial unknowns that are eliminated together with the initial states, None for all. Others are fixed.
    """
    blocks = at.blocks
    b = range(blocks.n_b) if b is None else b
    first = blocks.n_z + blocks.n_next
    columns = [*range(first), *(first + i for i in b), *range(first + blocks.n_b, blocks.R.shape[-1])]
    R = on_device(np.asarray(blocks.R)[:, :, columns])
    reduced = eliminate(Blocks(R, blocks.priors, blocks.windows, blocks.n_z, blocks.n_next, len(b)), 0.0)
    return LinearizedProblem(reduced.R.astype(float), reduced.priors.astype(float), blocks.column_norms.astype(float))


def _rank(A: np.ndarray) -> int:
    """Numerical rank. The columns may have different units."""
    size = np.linalg.norm(A, axis=0)
    return int(np.linalg.matrix_rank(A / np.where(size > 0, size, 1.0), rtol=1e-7))


def solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The shortest x (n,) that minimizes |A x + r|, or (n, k) for r (m, k). It does not depend on the units of x."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return (np.linalg.lstsq(A / size, -r, rcond=1e-11)[0].T / size).T


@dataclasses.dataclass(frozen=True)
class Score:
    """The result of a score test of q parameters.

    - `step` (q,): estimated change of the parameters.
    - `covariance` (q, q): of the step.
    - `degrees_of_freedom` (q,): of the variances. None for formal variances.
    - `drop`: decrease of the sum of squares to `minimal_cost`.
    - `p`: p-value.
    - `sensitive` (q,): whether the data depend on the parameter.
    - `distinguishable` (q,): whether its effect is linearly independent of those of the free parameters.
    """

    step: np.ndarray
    covariance: np.ndarray
    degrees_of_freedom: np.ndarray | None
    drop: float
    minimal_cost: float
    p: float
    sensitive: np.ndarray
    distinguishable: np.ndarray


def score_test(
    rows: LinearizedProblem,
    base: Sequence[int],
    new: Sequence[int],
    *,
    degrees_of_freedom: int,
    correlation: float = 0.0,
) -> Score:
    """Rao's score test of `new` parameters in addition to `base` ones, with one linearization at the minimum without
    them.

        drop = g^T H^-1 g,   g = A'^T r,   H = A'^T A',   A' = A_new + A_base X

    X minimizes A', so A' is the part of A_new that is orthogonal to A_base. With enough trials the covariance is
    clustered by trial, and p is that of `wald_test`, unless one trial alone determines one of the parameters. Otherwise
    the number of residuals is multiplied by (1 - c) / (1 + c) (`f_test`).

    **Arguments:**

    - `degrees_of_freedom`: number of residuals minus the number of unknowns without the new parameters.
    - `correlation`: c of `serial_correlation`.
    """
    base, new, q = list(base), list(new), len(new)
    A, r = rows.of([*base, *new])
    A0, A1 = A[:, : len(base)], A[:, len(base) :]
    rest = A1 + A0 @ solved(A0, A1)  # (M, q)
    sensitive = rows.norms[new] > 1e-11 * rows.norms.max(initial=0.0)
    # A projected column below 1e-7 of the original one is a rounding error.
    distinguishable = sensitive & (np.linalg.norm(rest, axis=0) > 1e-7 * rows.norms[new])
    before = r + A0 @ solved(A0, r)
    cost = float(before @ before)
    if not q or not np.all(distinguishable):
        return Score(np.zeros(q), np.full((q, q), np.nan), None, 0.0, cost, 1.0, sensitive, distinguishable)
    step = solved(rest, before)
    minimal_cost = float(np.sum((before + rest @ step) ** 2))
    p = f_test(cost - minimal_cost, q, minimal_cost, degrees_of_freedom - q, correlation)
    covariance, freedom, clustered = np.full((q, q), np.nan), None, None
    T, m, n = *rows.data.shape[:2], A.shape[1]
    of_priors, by_trial = A[T * m :].T @ A[T * m :], rows.data[np.any(rows.data, axis=(1, 2))]
    # With three trials and slow errors, the F test accepted 11 % of null candidates at a level of 5 %. This test
    # accepted 3 %.
    if len(by_trial) >= FEWEST_TRIALS_OF_A_TEST:
        A_t = by_trial[:, :, [*base, *new]]
        left = by_trial[:, :, -1] + A_t @ solved(A, r)
        places = np.tile(np.arange(n), (len(A_t), 1))
        scores = np.einsum("tmi,tm->ti", A_t, left)
        clustered = jackknife(Clusters(A_t.mT @ A_t, scores, places, of_priors), np.eye(n)[-q:])
    if clustered is not None and np.all(clustered.leverage <= LARGEST_LEVERAGE):
        covariance, freedom, _ = clustered
        p = wald_test(step, covariance.diagonal(), freedom)
    elif degrees_of_freedom > q:
        variance = minimal_cost / (degrees_of_freedom - q) / effective_sample_fraction(correlation)
        size = np.linalg.norm(A, axis=0)
        inverse = np.linalg.pinv((A / size).T @ (A / size), rcond=1e-14) / np.outer(size, size)
        covariance = formal_covariance(inverse, of_priors, variance)[-q:, -q:]
        if clustered is not None and correlation > 0:
            p = 1.0  # one trial alone does not show the scatter between trials
    return Score(step, covariance, freedom, cost - minimal_cost, minimal_cost, p, sensitive, distinguishable)
