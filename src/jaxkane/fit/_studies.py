"""Studies of a fit: multiple starts, profile likelihoods, the bootstrap, and a check of signs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm, qmc
from tqdm import tqdm

from .._common.lookup import hint, real_number
from ._covariance import bootstrap_steps, clustered
from ._diagnostics import poorly_fitted_channels
from ._fit import minimize, uninterrupted
from ._model import Unknowns
from ._nuisance import solve_nuisance
from ._optimizers import LeastSquares, Optimizer
from ._problem import Problem, refuse_other
from ._result import Fit
from ._statistics import t_quantile
from ._tables import text_table
from ._windows import Windows


@dataclasses.dataclass(frozen=True, repr=False)
class MultiStart:
    """What came of many initial guesses; print it for a table.

    - `fits`: those that ran, the best first; `guesses`: the values that each began with, by name.
    - `failures`: why the others could not be simulated. `untried`: how many were left when Ctrl-C came.
    - `agreeing`: how many fits ended where the best did (their cost within 0.1 %, or 0.1 % of the residuals' number).
    - `spread`: by name, the standard deviation of these estimates: what is left of the initial guess in the answer.
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
        slack = 1e-3 * max(self.best.cost, self.best.variance * self.best.problem.size[0])
        return [f for f in self.fits if f.cost <= self.best.cost + slack]

    def __str__(self) -> str:
        names = self.best.names
        rows = [("sum of squares", "steps", "ended", *names)]
        for f in self.fits:
            estimates = (f"{f.estimates[name]:.5g}" for name in names)
            rows.append((f"{f.cost:.6g}", str(len(f.history) - 1), f.status, *estimates))
        rows.append(("", "", "spread", *(f"{s:.2g}" for s in self.spread.values())))
        total = len(self.fits) + len(self.failures)
        lines = [text_table(rows, (2,)), f"{self.agreeing} of {total} initial guesses end at the best."]
        if self.agreeing == 1 and total > 1:
            lines.append("Nothing confirms that this is the lowest minimum: try more, or shorter windows.")
        if self.untried:
            lines.append(f"Interrupted: {self.untried} more initial guesses were not tried.")
        return "\n".join([*lines, *self.failures])

    __repr__ = __str__


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
    """Fit from many initial guesses.

    They are run one after another by one compiled program, which every fit of these trials shares. A batch of ten under
    `vmap` was measured (ten windows of a bicycle, two cores): a step takes 0.27 s instead of 0.42 s, but a program of
    its own is compiled for 3.5 s, and all wait for the slowest.

    **Arguments:**

    - `n`: how many fits. `spread`: of the initial guesses, a Latin hypercube within this many scales of every parameter
        on either side (for a positive one a factor between exp(-spread) and exp(spread)).
    - `candidates`: draw so many guesses, and fit the `n` with the lowest cost; by default `n`.
    - `seed`: of the Latin hypercube. `optimizer`: by default `LeastSquares()`. `steps`, `callback`: of every fit, as in
        `minimize`. `progress`: a progress bar.

    **Returns:** a `MultiStart`; after an interruption (Ctrl-C) of what was tried until then.

    **Raises:** `ValueError` where no guess can be simulated.
    """
    refuse_other(problem, Problem, "multi_start", "multi_start(fit.problem)")
    if n < 1:
        raise ValueError(f"`n` is how many initial guesses are tried, one at least; got {n}.")
    if not 0 <= real_number(spread, "`spread`") < math.inf:
        raise ValueError(f"`spread` is how far guesses lie from the first, in scales, not negative; got {spread}.")
    optimizer = LeastSquares() if optimizer is None else optimizer
    options: Any = {"seed": seed}  # SciPy 1.15 and later call it rng, too
    unit = qmc.LatinHypercube(len(problem.parameters.names), **options).random(max(n, candidates or n))
    drawn = spread * (2 * unit - 1)
    points = [eqx.tree_at(lambda q: q.x, problem.start, jnp.asarray(x, problem.windows.t.dtype)) for x in drawn]
    if len(points) > n:
        costs = np.nan_to_num([problem.cost(point) for point in points], nan=np.inf)
        points = [points[i] for i in np.argsort(costs)[:n]]
    fits, failures, untried = [], [], 0
    for i, point in enumerate(tqdm(points, disable=not progress, desc="initial guesses")):
        values = np.asarray(problem.parameters.values(point.x)).tolist()
        guess = dict(zip(problem.parameters.names, values, strict=True))
        try:
            fits.append((minimize(problem, optimizer, steps=steps, start=point, callback=callback), guess))
        except ValueError as error:
            failures.append(f"From {', '.join(f'{k} = {v:.4g}' for k, v in guess.items())}: {error}")
            continue
        except KeyboardInterrupt:  # before its first step
            if not fits:
                raise
            untried = len(points) - i
            break
        if fits[-1][0].status == "interrupted":
            untried = len(points) - i - 1
            break
    if not fits:
        raise ValueError(f"None of {n} initial guesses can be simulated. The last: {failures[-1]}")
    fits.sort(key=lambda pair: pair[0].cost)
    return MultiStart(tuple(f for f, _ in fits), tuple(g for _, g in fits), tuple(failures), untried)


@dataclasses.dataclass(frozen=True)
class Profile:
    """The sum of squares with one parameter fixed at values (n,), all others estimated anew.

    `interval`: where `costs` exceed their minimum by no more than chance does at `level`, with the quantile and the
    errors of `Fit.intervals`; up to the parameter's bound, or infinite, where they do not come so far. A parabola has
    the interval of `Fit.intervals`.
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
    values, fits = best + span * error * np.linspace(-1, 1, n | 1), {}
    for side in (values[values >= best], values[values < best][::-1]):
        point = fit.point
        for value in side:
            pinned = fit.problem.with_priors({name: (float(value), 1e-4 * error)})
            try:
                start = pinned.at({name: float(value)}, point)
                result = uninterrupted(minimize(pinned, LeastSquares(rtol=1e-5), start=start))
            except ValueError:  # outside its bounds, or nothing that can be simulated
                break
            if result.status != "converged":
                break
            pin = (result.estimates[name] - value) / (1e-4 * error)
            cost = result.cost - pin**2 + ((result.estimates[name] - prior[0]) / prior[1]) ** 2
            fits[float(value)], point = (cost, result.estimates), result.point
    if not fits:
        raise ValueError(f"{name}: no fit converges with it fixed at {best:.6g} or near: {fit.message}.")
    values = np.array(sorted(fits))
    costs = np.array([fits[v][0] for v in values])
    # The cost rises by one at the error that `sigma` as it was given would leave.
    limit = costs.min() + (fit.quantile(level) * fit.errors[name] / fit.identifiability.given_sigma_errors[i]) ** 2
    low, high = np.clip(_crossings(values, costs, limit), *fit.parameters.bounds[i])
    return Profile(name, values, costs, level, (float(low), float(high)), tuple(fits[v][1] for v in values))


def _crossings(values: np.ndarray, costs: np.ndarray, limit: float) -> tuple[float, float]:
    """Where the costs rise above the limit on both sides of their minimum; infinite where they do not."""
    best, ends = int(np.argmin(costs)), []
    # The root of what a cost exceeds its minimum by is linear where the cost is a parabola.
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


@dataclasses.dataclass(frozen=True, repr=False)
class Bootstrap:
    """Estimates from trials (or windows) that are drawn at random, as often as there are, some repeatedly.

    - `values`: by name, estimates (n,); `clusters`: what was drawn, "trial" or "window", and how many there are.
    """

    values: dict[str, np.ndarray]
    clusters: tuple[str, int]

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals by name: percentiles, those that Student's distribution makes of `level` where the
        clusters are few (Hesterberg, What teachers should know about the bootstrap, 2015). They follow a distribution
        that is not symmetric. Infinite where the data determine nothing.

        **Raises:** `ValueError` for a level that is not between 0 and 1.
        """
        G = self.clusters[1]
        tail = float(norm.cdf(-((G / (G - 1)) ** 0.5) * t_quantile(level, G - 1)))
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
    """How estimates scatter where other trials of the same kind had been measured: a block bootstrap, by trial where
    there are enough, else by window. Priors are drawn with their deviations. Nothing is fitted again: each draw is one
    step of Gauss and Newton from the fit.

    **Arguments:** `n`: draws; `seed`: of the generator.

    **Raises:** `ValueError` with fewer trials (or windows) than parameters and two, and for a validated fit.
    """
    refuse_other(fit, Fit, "bootstrap", "bootstrap(fit(...))")
    if not isinstance(n, int) or isinstance(n, bool) or n < 100:
        raise ValueError(f"bootstrap: `n` is a whole number of draws, of 100 at least; got {n!r}.")
    if fit.status == "validated":
        raise ValueError("bootstrap: these are the parameters of another fit: draw from the trials of that one.")
    directions = fit.identifiability.directions
    clusters = clustered(fit.problem, fit.point, fit.linearization, directions)
    if clusters is None:
        raise ValueError(
            f"bootstrap: {fit.problem.clusters} trials say nothing of how {len(fit.names)} parameters scatter; two "
            "more trials are needed than parameters. Cut long ones with `Trial.between`, or fit in windows."
        )
    steps = bootstrap_steps(clusters, np.random.default_rng(seed), n)[:, -directions.shape[1] :] @ directions.T
    x = jnp.asarray(np.asarray(fit.point.x) + steps, fit.point.x.dtype)
    values = np.array(jax.vmap(fit.parameters.values)(x), float)
    values[:, np.isinf(np.array([*fit.clustered_errors.values()]))] = np.nan
    return Bootstrap(dict(zip(fit.names, values.T, strict=True)), fit.clusters)


def check_signs(fit: Fit) -> tuple[str, ...]:
    """Inputs and channels with which the opposite sign would fit much better, in words.

    Where a channel fits badly (`Fit.notes` says so), each sign is turned round in turn and a few steps of a fit are
    made; where none does, nothing is tried.
    """
    if not any(poorly_fitted_channels(fit.tests, fit.variance)):
        return ()
    notes, problem = [], fit.problem
    for i, name in enumerate(problem.system.inputs):
        if name not in problem.model.sampled_inputs:
            continue
        flipped = problem.windows.inputs.at[:, i].multiply(-1.0)
        notes += _if_better(fit, eqx.tree_at(lambda w: w.inputs, problem.windows, flipped), f"the input {name}")
    for c, channel in enumerate(problem.channels):
        flipped = problem.windows.measured.at[:, c].multiply(-1.0)
        notes += _if_better(fit, eqx.tree_at(lambda w: w.measured, problem.windows, flipped), channel)
    return tuple(notes)


def _if_better(fit: Fit, windows: Windows, what: str) -> list[str]:
    problem = dataclasses.replace(fit.problem, windows=windows)
    try:
        # From both ends: a fit to the wrong sign may have led the parameters far away.
        costs = [solve_nuisance(problem, point, steps=4)[1].cost for point in (fit.point, problem.start)]
        if min(costs) > 0.5 * fit.cost:
            costs = [uninterrupted(minimize(problem, LeastSquares(rtol=1e-2), steps=4)).cost]
    except ValueError:
        return []
    if min(costs) < 0.5 * fit.cost:
        return [f"{what} seems to have the wrong sign: turned round, the sum of squares is below {min(costs):.4g}."]
    return []
