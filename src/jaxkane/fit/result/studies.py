"""Studies of a fit: multiple starts, profile likelihood, bootstrap, and checks of signs and of the power of loads."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import ndtr
from tqdm import tqdm

from ..._common.lookup import positive_number, real_number, refuse_unknown, whole_number
from ..._integrate.trajectory import Trajectory
from ..._kane.api import generalized_active_forces
from ..._scalarjit.compat import on_device
from ..problem.model import Unknowns
from ..problem.problem import Problem
from ..problem.specification import refuse_other
from ..problem.windows import Windows
from ..solve.fit import minimize, search, uninterrupted
from ..solve.optimizers import LeastSquares, Optimizer, solve_nuisance
from .data import text_table
from .diagnostics import AT_A_MINIMUM, poorly_fitted_channels, refuse_unless_at_a_minimum
from .fit_result import Fit
from .statistics import FEWEST_TRIALS, bootstrap_steps, clustered, clusters_of, t_quantile


@dataclasses.dataclass(frozen=True)
class MultiStart:
    """The result of `multi_start`: fits from several initial guesses. Print it for a table.

    - `fits`: the fits that could be run, in the order of increasing cost.
    - `guesses`: by name, the initial guess of each fit.
    - `failures`: for each initial guess that could not be simulated, the reason.
    - `untried`: number of initial guesses that were not tried because of an interruption (Ctrl-C).
    - `agreeing`: number of fits that end at the same minimum as the best one. Their cost exceeds the lowest cost by
        less than 0.25 times the variance of a residual. This corresponds to half a standard error of one parameter.
    - `spread`: by name, the standard deviation of the estimates of these fits. It measures how much the estimate
        depends on the initial guess.
    """

    fits: tuple[Fit, ...]
    guesses: tuple[dict[str, float], ...]
    failures: tuple[str, ...]
    untried: int = 0

    @property
    def best(self) -> Fit:
        return self.fits[0]

    @property
    def agreeing(self) -> int:
        return len(self._same)

    @property
    def spread(self) -> dict[str, float]:
        return {name: float(np.std([f.estimates[name] for f in self._same])) for name in self.best.names}

    @property
    def _same(self) -> list[Fit]:
        # The tolerance is not relative to the cost. With 1e5 residuals, 0.1 % of the cost is the increase at ten
        # standard errors from the minimum.
        slack = 0.25 * np.nan_to_num(self.best.variance, nan=1.0) + 1e-9 * self.best.linearization.squares
        return [f for f in self.fits if f.cost <= self.best.cost + slack]

    def __repr__(self) -> str:
        names = self.best.names
        rows = [("sum of squares", "steps", "ended", *names)]
        for f in self.fits:
            estimates = (f"{f.estimates[name]:.5g}" for name in names)
            rows.append((f"{f.cost:.6g}", str(len(f.history) - 1), f.status, *estimates))
        rows.append(("", "", "spread", *(f"{s:.2g}" for s in self.spread.values())))
        total = len(self.fits) + len(self.failures)
        lines = [text_table(rows, (2,)), f"{self.agreeing} of {total} initial guesses end at the best."]
        if self.agreeing == 1 and total > 1:
            lines.append("This minimum may not be the lowest. Try more initial guesses, or shorter windows.")
        if self.untried:
            lines.append(f"Interrupted: {self.untried} more initial guesses were not tried.")
        return "\n".join([*lines, *self.failures])


def multi_start(
    problem: Problem,
    n: int = 10,
    *,
    spread: float = 0.3,
    candidates: int | None = None,
    seed: int = 0,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> MultiStart:
    """Fit from several initial guesses.

    The fits run one after another and share one compiled program. A batch of ten under `vmap` is not worthwhile. For
    ten windows of a bicycle on two cores, a step took 0.27 s instead of 0.42 s. However, the batch requires its own
    program, which compiled in 3.5 s, and all fits wait for the slowest one.

    **Arguments:**

    - `problem`: a `Problem`.
    - `n`: number of fits.
    - `spread`: range of the initial guesses. They are a Latin hypercube within +-`spread` scales of each parameter. A
        positive parameter is multiplied by a factor between exp(-spread) and exp(spread).
    - `candidates`: number of guesses that are drawn. The `n` with the lowest cost are fitted. By default `n`.
    - `seed`: seed of the Latin hypercube.
    - `optimizer`: by default `LeastSquares()`.
    - `steps`, `callback`: for every fit, as in `minimize`.
    - `progress`: whether to show a progress bar.

    **Returns:** a `MultiStart`. After an interruption (Ctrl-C) it contains the fits until then.

    **Raises:** `ValueError` if no guess can be simulated.
    """
    refuse_other(problem, Problem, "multi_start", "multi_start(fit.problem)")
    whole_number(n, 1, "multi_start: `n`, the number of initial guesses,")
    if not 0 <= real_number(spread, "`spread`") < math.inf:
        raise ValueError(
            "multi_start: `spread`, the distance of the guesses in scales, must be finite and not negative, got "
            f"{spread}."
        )
    optimizer = LeastSquares() if optimizer is None else optimizer
    from scipy.stats import qmc  # takes a second

    options: Any = {"seed": seed}  # SciPy 1.15 renamed it to rng and still accepts seed
    unit = qmc.LatinHypercube(len(problem.parameters.names), **options).random(max(n, candidates or n))
    drawn = spread * (2 * unit - 1)
    points = [
        eqx.tree_at(lambda q: q.parameters, problem.start, jnp.asarray(x, problem.windows.t.dtype)) for x in drawn
    ]
    if len(points) > n:
        costs = np.nan_to_num([problem.cost(point) for point in points], nan=np.inf)
        points = [points[i] for i in np.argsort(costs)[:n]]
    fits, failures = [], []
    for point in tqdm(points, disable=not progress, desc="initial guesses"):
        values = np.asarray(problem.parameters.values(point.parameters)).tolist()
        guess = dict(zip(problem.parameters.names, values, strict=True))
        try:
            fits.append((minimize(problem, optimizer, steps=steps, start=point, callback=callback), guess))
        except ValueError as error:
            failures.append(f"From {', '.join(f'{k} = {v:.4g}' for k, v in guess.items())}: {error}")
        except KeyboardInterrupt:  # before its first step
            if not fits:
                raise
            break
        if fits and fits[-1][0].status == "interrupted":
            break
    if not fits:
        raise ValueError(
            f"multi_start: none of the {n} initial guesses can be simulated. Pass a smaller `spread`. The last error "
            f"was: {failures[-1]}"
        )
    untried = len(points) - len(fits) - len(failures)
    fits.sort(key=lambda pair: pair[0].cost)
    return MultiStart(tuple(f for f, _ in fits), tuple(g for _, g in fits), tuple(failures), untried)


@dataclasses.dataclass(frozen=True)
class Profile:
    """The sum of squares with one parameter fixed at each of n values and all others estimated again.

    - `name`: the parameter.
    - `values` (n,): its fixed values, in its unit.
    - `costs` (n,): the sum of squares at each value.
    - `level`: confidence level of the interval.
    - `interval`: profile-likelihood interval. Its ends are where `costs` exceed their minimum by the threshold for
        `level`, which uses the quantile and the errors of `Fit.intervals`. If an end is outside the values, it is the
        parameter's bound or infinite. For a parabola it equals the interval of `Fit.intervals`. If the estimate is at a
        bound, the threshold is the square of the quantile times `Fit.variance`.
    - `estimates`: for each value, the estimates of all parameters by name.
    """

    name: str
    values: np.ndarray
    costs: np.ndarray
    level: float
    interval: tuple[float, float]
    estimates: tuple[dict[str, float], ...]

    def __repr__(self) -> str:
        low, high = self.interval
        pairs = zip(self.values, self.costs, strict=True)
        rows = [(self.name, "cost"), *((f"{value:.5g}", f"{cost:.6g}") for value, cost in pairs)]
        return f"{100 * self.level:g} % interval of {self.name}: {low:.4g} to {high:.4g}\n{text_table(rows)}"


def profile(fit: Fit, name: str, *, n: int = 9, span: float | None = None, level: float = 0.95) -> Profile:
    """The profile likelihood of one parameter. Its interval does not assume that the problem is linear.

    **Arguments:**

    - `fit`: a `Fit`.
    - `name`: a free parameter.
    - `n`: number of values, half of them on either side of the estimate. Without `span`, values are added on a side
        until the interval has an end there.
    - `span`: half-width of the range of values, in formal standard errors. By default 1.5 times the half-width of the
        interval, and at most six times on a side on which values are added.
    - `level`: confidence level of the interval, between 0 and 1.

    **Returns:** a `Profile`.

    **Raises:** `ValueError` for a name that is not free, for a fit that has not converged, for a parameter that the
    data do not determine, and if no fit with the parameter fixed converges.
    """
    refuse_other(fit, Fit, "profile", "profile(fit(...), name)")
    refuse_unknown([str(name)], fit.names, "profile: `name`: there is no free parameter", "the free parameters are")
    whole_number(n, 3, "profile: `n`")
    span = None if span is None else positive_number(span, "profile: `span`")
    refuse_unless_at_a_minimum(fit.status, "profile")
    i, error, best = fit.names.index(name), fit.standard_errors[name], fit.estimates[name]
    prior = float(fit.parameters.prior_mean[i]), float(fit.parameters.prior_deviation[i])

    def fixed_at(value: float, deviation: float, point: Unknowns) -> tuple[float, Fit]:
        pinned = fit.problem.with_priors({name: (value, deviation)})
        result = uninterrupted(search(pinned, LeastSquares(), start=pinned.at({name: value}, point)))
        pin = (result.estimates[name] - value) / deviation
        return result.cost - pin**2 + ((result.estimates[name] - prior[0]) / prior[1]) ** 2, result

    if name in fit.identifiability.at_bound:
        # The fit has no standard error there. Search the distance from the bound at which the cost has its limit.
        quantile = t_quantile(level, fit.degrees_of_freedom[name])
        (low, high), rise = fit.parameters.bounds[i].tolist(), quantile**2 * fit.variance
        inward, half = 1.0 if best - low < high - best else -1.0, 0.1 * float(fit.parameters.scale[i])
        for _ in range(8):
            half = min(half, 0.9 * (high - low))
            excess = fixed_at(best + inward * half, 1e-4 * half, fit.point)[0] - fit.cost
            if 0.5 * rise < excess < 2.0 * rise:
                break
            half *= float(np.clip((rise / max(excess, 1e-300)) ** 0.5, 0.1, 10.0))
        error = half / quantile
    elif not np.isfinite(error):
        raise ValueError(
            f"profile: these data do not determine {name}: {fit.message}. Add a prior, or omit it from `free`."
        )
    else:
        half = float(fit.half_widths(level)[i])  # of the interval before it is truncated at the bounds
        # At one standard error, computed with `sigma` as it was passed, the cost exceeds its minimum by one.
        rise = (half / fit.identifiability.given_sigma_errors[i]) ** 2
    step = (1.5 * (half if np.isfinite(half) else error) if span is None else span * error) / (n // 2)
    fits = {best: (fit.cost, fit.estimates)}
    for side in (1, -1):
        point, cost, k = fit.point, fit.cost, 1
        # Near a bound on the other side, the cost is not a parabola: continue until it exceeds the limit.
        while k <= n // 2 or (span is None and k <= 2 * n and cost <= fit.cost + rise < np.inf):
            value = best + side * k * step
            try:
                cost, result = fixed_at(value, 1e-4 * error, point)
            except ValueError:  # outside its bounds, or it cannot be simulated
                break
            if result.status not in AT_A_MINIMUM:
                break
            fits[value], point, k = (cost, result.estimates), result.point, k + 1
    if len(fits) < 2:
        raise ValueError(
            f"profile: no fit converges with {name} fixed near {best:.6g}: {fit.message}. Pass another `span`."
        )
    values = np.array(sorted(fits))
    costs = np.array([fits[v][0] for v in values])
    low, high = np.clip(_crossings(values, costs, costs.min() + rise), *fit.parameters.bounds[i])
    return Profile(name, values, costs, level, (float(low), float(high)), tuple(fits[v][1] for v in values))


def _crossings(values: np.ndarray, costs: np.ndarray, limit: float) -> tuple[float, float]:
    """Values at which the costs cross the limit on both sides of their minimum. Infinite where they do not."""
    best, ends = int(np.argmin(costs)), []
    # Interpolate the square root of the excess cost, because it is linear if the cost is a parabola.
    height, limit_height = np.sqrt(costs - costs[best]), np.sqrt(limit - costs[best])
    for side, infinite in ((range(best, -1, -1), -np.inf), (range(best, len(values)), np.inf)):
        above = next((k for k in side if height[k] > limit_height), None)
        if above is None:
            ends.append(infinite)
            continue
        inside = above - side.step
        share = (limit_height - height[inside]) / (height[above] - height[inside])
        ends.append(float(values[inside] + share * (values[above] - values[inside])))
    return ends[0], ends[1]


@dataclasses.dataclass(frozen=True)
class Bootstrap:
    """The result of `bootstrap`: estimates from trials (or windows) that are resampled with replacement. Print it for a
    table.

    - `values`: by name, the estimate of each draw (n,).
    - `clusters`: the unit that was resampled, "trial" or "window", and the number of clusters.
    """

    values: dict[str, np.ndarray]
    clusters: tuple[str, int]

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Percentile intervals by name.

        With few clusters, the percentiles are those of Student's distribution for `level` (Hesterberg, What teachers
        should know about the bootstrap, 2015). The intervals need not be symmetric. They are infinite for parameters
        that the data do not determine.

        **Arguments:**

        - `level`: confidence level, between 0 and 1.

        **Returns:** a dictionary of (lower, upper), in the parameter's unit.

        **Raises:** `ValueError` if `level` is not between 0 and 1.
        """
        G = self.clusters[1]
        tail = float(ndtr(-((G / (G - 1)) ** 0.5) * t_quantile(level, G - 1)))
        ends = {name: np.quantile(values, [tail, 1 - tail]) for name, values in self.values.items()}
        return {
            name: (float(low), float(high)) if np.isfinite(low) else (-math.inf, math.inf)
            for name, (low, high) in ends.items()
        }

    def __repr__(self) -> str:
        rows = [
            ("parameter", "2.5 %", "97.5 %"),
            *((name, f"{a:.5g}", f"{b:.5g}") for name, (a, b) in self.intervals().items()),
        ]
        return f"Bootstrap of {self.clusters[1]} {self.clusters[0]}s\n{text_table(rows)}"


def bootstrap(fit: Fit, *, n: int = 2000, seed: int = 0) -> Bootstrap:
    """The scatter of the estimates over repeated experiments, by a block bootstrap.

    Trials are resampled if there are enough of them, otherwise windows. Priors are drawn from their own distributions.
    No fit is run again: each draw is one Gauss-Newton step from the fit.

    **Arguments:**

    - `fit`: a `Fit`.
    - `n`: number of draws, at least 100.
    - `seed`: seed of the random generator.

    **Returns:** a `Bootstrap`. For a parameter that one cluster alone determines, and for one at its bound, the values
    are NaN and the interval is infinite. `profile` finds the interval of a parameter at its bound.

    **Raises:** `ValueError` with too few trials and windows (`Fit.clusters`), for a fit that has not converged, and for
    a validated fit.
    """
    refuse_other(fit, Fit, "bootstrap", "bootstrap(fit(...))")
    refuse_unless_at_a_minimum(fit.status, "bootstrap")
    whole_number(n, 100, "bootstrap: `n`")
    if fit.status == "validated":
        raise ValueError(
            "bootstrap: the parameters were not estimated from these trials. Pass the fit that estimated them."
        )
    directions = fit.identifiability.directions
    clusters = clustered(fit.problem, fit.point, fit.linearization, directions, by_label=False)
    if clusters is None:
        raise ValueError(
            f"bootstrap: {fit.problem.clusters} trials are too few to estimate the scatter of the estimates. Use at "
            f"least {FEWEST_TRIALS} trials: cut long trials with `Trial.between`, or fit in windows with free initial "
            "states."
        )
    steps = bootstrap_steps(clusters, np.random.default_rng(seed), n)[:, -directions.shape[1] :] @ directions.T
    x = jnp.asarray(np.asarray(fit.point.parameters) + steps, fit.point.parameters.dtype)
    values = np.array(jax.vmap(fit.parameters.values)(x), float)
    # A draw without the only cluster that determines a parameter would not change its estimate and would look precise.
    values[:, np.isinf(np.array([*fit.clustered_errors.values()]))] = np.nan
    values[:, np.isin(fit.names, fit.identifiability.at_bound)] = np.nan  # the slope of the bijection vanishes there
    return Bootstrap(
        dict(zip(fit.names, values.T, strict=True)), clusters_of(fit.problem, fit.linearization, by_label=False)
    )


def check_signs(fit: Fit) -> tuple[str, ...]:
    """Find inputs, channels and parameters for which the opposite sign fits much better.

    Nothing is tried if every channel fits well (see `Fit.notes`). Otherwise the sign of each input, channel and
    parameter is changed in turn, followed by a few optimizer steps. Parameters that cannot be negative are skipped.

    **Arguments:**

    - `fit`: a `Fit`.

    **Returns:** one sentence for each probable sign error.
    """
    if not any(poorly_fitted_channels(fit.tests, fit.variance)):
        return ()
    problem, windows, notes = fit.problem, fit.problem.windows, []
    # Start at the estimates and at the initial guess: with a wrong sign, the estimates may be far from the true values.
    ends = (fit.point, problem.start)
    cases: list[tuple[str, Windows, Sequence[Unknowns]]] = []
    for i, name in enumerate(problem.system.inputs):
        if name in problem.model.sampled_inputs:
            inputs = windows.inputs.at[:, i].multiply(-1.0)
            cases.append((f"the input {name}", eqx.tree_at(lambda w: w.inputs, windows, inputs), ends))
    for i, channel in enumerate(problem.channels):
        measured = windows.measured.at[:, i].multiply(-1.0)
        cases.append((channel, eqx.tree_at(lambda w: w.measured, windows, measured), ends))
    for name in (name for name, learned in zip(fit.names, fit.parameters.learned, strict=True) if not learned):
        values = zip((fit.estimates, fit.start), ends, strict=True)
        with contextlib.suppress(ValueError):  # outside its bounds
            cases.append((f"the parameter {name}", windows, [problem.at({name: -of[name]}, end) for of, end in values]))
    for what, changed, points in cases:
        other = dataclasses.replace(problem, windows=changed)
        try:
            cost = min(solve_nuisance(other, point, steps=4)[1].cost for point in points)
            if cost > 0.5 * fit.cost:
                cost = uninterrupted(search(other, LeastSquares(rtol=1e-2), steps=4, start=points[-1])).cost
        except ValueError:
            continue
        if cost < 0.5 * fit.cost:
            notes.append(f"{what} seems to have the wrong sign: with the other sign the sum of squares is {cost:.4g}.")
    return tuple(notes)


# Largest number of samples of a fitted trajectory at which `energy_sources` evaluates the loads.
MOST_SAMPLES = 2000


def energy_sources(fit: Fit) -> dict[str, str]:
    """By name, a sentence for each parameter that acts like a negative damping.

        theta dP/dtheta >= 0   with   P = sum F_r u_r

    The condition is checked at all samples of the fitted trajectory and again with reversed speeds. The power of
    gravity, a spring or a motor changes its sign with the speeds. The power of friction does not and is negative. This
    detects a damping parameter without bounds whose estimate has the wrong sign.
    """
    problem, rides = fit.problem, fit.problem.trajectories(fit.point)

    def joined(of: Callable[[Trajectory], Any]):
        return np.concatenate([np.asarray(of(ride)) for ride in rides])

    samples = {"t": joined(lambda r: r.t), "q": joined(lambda r: r.q), "u": joined(lambda r: r.u)}
    samples |= {name: joined(lambda r, name=name: r.values[name]) for name in rides[0].values}
    finite = np.flatnonzero(np.all([np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in samples.values()], axis=0))
    rows = finite[:: max(1, len(finite) // MOST_SAMPLES)]
    t, q, u, *values = (on_device(np.concatenate([x[rows], x[rows]])) for x in samples.values())
    u = on_device(np.asarray(u) * np.repeat([1.0, -1.0], len(rows))[:, None])

    def power(x: Array, t: Array, q: Array, u: Array, *values: Any) -> Any:
        system = problem.parameters.apply(problem.system, x)[0]
        return generalized_active_forces(system, t, q, u, dict(zip(rides[0].values, values, strict=True))) @ u

    slopes = jax.jit(jax.vmap(jax.jacfwd(power), in_axes=(None, *(0 for _ in samples))))
    P = np.asarray(slopes(fit.point.parameters, t, q, u, *values)) * np.sign([*fit.estimates.values()])  # (2 n, p)
    adds = (P.min(axis=0) >= -1e-9 * P.max(axis=0)) & (P.max(axis=0) > 0)
    words = "adds energy at every sample of the fitted motion, like a negative damping"
    entries = zip(fit.parameters.entries, adds, fit.estimates.items(), strict=True)
    return {name: f"{name} = {value:.4g} {words}" for entry, add, (name, value) in entries if add and entry.targets}
