"""Optimal initial states and trial unknowns for fixed parameters: damped Gauss-Newton steps, each trial separately."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..._integrate.events import Status, reason
from ..._scalarjit.compat import on_device
from ..problem.model import Unknowns
from ..problem.problem import Problem
from .blocks import Eliminated, eliminate
from .linearization import Linearization


def moved(point: Unknowns, x: Any, eliminated: Eliminated) -> Unknowns:
    """The point after a step x of the parameters and the corresponding step of the nuisance values."""
    x = np.asarray(x)
    z, b = eliminated.back_substitute(x)
    before = point.parameters, point.trial_unknowns, point.window_starts
    after = (on_device(np.asarray(old) + step) for old, step in zip(before, (x, b, z), strict=True))
    return Unknowns(*after, meaning=point.meaning)


def usable(at: Linearization | None) -> bool:
    """Whether all residuals and derivatives are finite."""
    return at is not None and bool(np.all(at.good))


class Unsimulated(ValueError):
    """The simulation of some windows fails. `reasons`: by index of the trial, the reason."""

    def __init__(self, problem: Problem, point: Unknowns, at: Linearization | None, bad: np.ndarray):
        bad = problem.without_start(point) if at is None else bad
        first = jax.tree.map(lambda x: x[0], problem.windows)
        arguments = first.start, point.window_starts[0], point.trial_unknowns[0], point.parameters
        events = jax.eval_shape(problem.model.simulate, first, *arguments).events
        self.reasons: dict[int, str] = {}
        for i in np.flatnonzero(bad):
            (k, first, n), why = problem.slices[i], "its initial state cannot satisfy the constraints"
            if at is not None:
                status = int(at.status[i])
                why = "not finite" if status == Status.COMPLETED else reason(status, events)
            t = problem.trials[k].t
            self.reasons.setdefault(
                k, f"the residuals from {t[first]:g} to {t[first + n - 1]:g} s are not finite ({why})"
            )
        k, words = next(iter(self.reasons.items()))
        super().__init__(
            f"{problem.trials[k].name}: with the initial guess {words}, in {int(bad.sum())} of {len(bad)} windows. "
            "Choose shorter windows or other initial guesses, or omit this part of the trial."
        )


def solve_nuisance(
    problem: Problem, point: Unknowns, steps: int = 8, rtol: float = 1e-2
) -> tuple[Unknowns, Linearization]:
    """The optimal nuisance values for fixed parameters, by damped Gauss-Newton steps.

    If the simulation of a window fails with the initial guess (for example, an unstable bicycle falls over), the search
    starts with a shorter horizon. The horizon is doubled after each successful fit. If this fails for linked windows,
    each window is first solved separately.

    **Arguments:**

    - `problem`: the problem.
    - `point`: the parameters, and initial guesses of the nuisance values.
    - `steps`: the maximum number of steps with whole windows.
    - `rtol`: the steps end if they reduce the cost by less than this fraction.

    **Returns:** the point with the optimal nuisance values, and the linearization there.

    **Raises:** `Unsimulated` that names a window whose simulation fails.
    """
    try:
        return _solved(problem, point, steps, rtol)
    except Unsimulated:
        if not problem.model.nuisance.has_defects:
            raise
    point, _ = _solved(problem.without_defects(), point, steps, rtol)
    return _solved(problem, point, steps, rtol)


def _solved(problem: Problem, point: Unknowns, steps: int, rtol: float) -> tuple[Unknowns, Linearization]:
    whole = np.array([n for _, _, n in problem.slices])
    samples = whole.copy()
    at = problem.shortened(samples).linearize(point)
    while at is None or not at.good.all():
        bad = ~at.good if at is not None else np.full(len(whole), True)
        # A window of two samples has one interval and cannot be shortened further.
        if at is None or np.any(samples[bad] <= 2):
            raise Unsimulated(problem, point, at, bad & (samples <= 2))
        samples = np.where(bad, np.maximum(samples // 2, 2), samples)
        at = problem.shortened(samples).linearize(point)
    stuck = 0
    while True:
        # A shortened window only has to lead to a longer one, so two steps are enough.
        point, at = refined(problem.shortened(samples), point, at, steps if np.all(samples == whole) else 2, rtol)
        if np.all(samples == whole):
            return point, at
        # After a failure, a window grows by a quarter: an unstable motion that ends just behind the horizon would fail
        # again if the horizon were doubled.
        longer = (
            np.minimum(2 * samples, whole) if stuck == 0 else np.minimum(samples + np.maximum(samples // 4, 1), whole)
        )
        tried = problem.shortened(longer).linearize(point)
        bad = ~tried.good if tried is not None else np.full(len(whole), True)
        if np.all(samples[~bad] == longer[~bad]) and bad.any():
            stuck += 1
            if stuck > 2:
                raise Unsimulated(problem, point, tried, bad)
        samples = np.where(bad, samples, longer)
        at = tried if tried is not None and not bad.any() else problem.shortened(samples).linearize(point)
        assert at is not None


def refined(
    problem: Problem, point: Unknowns, at: Linearization, steps: int, rtol: float, enough: float = -np.inf
) -> tuple[Unknowns, Linearization]:
    """Improve the nuisance values by a few Gauss-Newton steps with fixed parameters.

    The steps end if they reduce the cost by less than the fraction `rtol`, or if the cost is at most `enough`.

    With fixed parameters, trials are independent. Each trial has its own damping and accepts a step only if its own
    cost decreases. A step that is too long in one trial therefore does not delay the others.
    """
    still, owner = np.zeros_like(point.parameters), np.asarray(problem.windows.trial)
    damping, before = np.zeros(len(problem.trials)), _by_owner(at, owner, len(problem.trials))
    for _ in range(steps):
        tried = moved(point, still, eliminate(at.blocks, damping))
        there = problem.linearize(tried)
        after = np.full_like(before, np.inf) if there is None else _by_owner(there, owner, len(before))
        better = (after <= before) & (after < np.inf)
        damping = np.where(better, damping / 10, np.maximum(10 * damping, 1e-2))
        gained = float(np.sum(before[better] - after[better]))
        if there is not None and better.any():
            point, at = _chosen(better, owner, (tried, there), (point, at))
            before = np.where(better, after, before)
        # At a minimum, rounding errors reject every step of a trial. Such a trial must not keep the loop running.
        done = better | (after <= before + 1e-9 * at.squares)
        if (done.all() and gained <= rtol * at.squares) or at.cost <= enough:
            break
    return point, at


def _by_owner(at: Linearization, owner: np.ndarray, n: int) -> np.ndarray:
    """The cost of each trial (T,)."""
    return np.bincount(owner, weights=at.costs, minlength=n)


def _chosen(better: np.ndarray, owner: np.ndarray, new: Any, old: Any) -> tuple[Unknowns, Linearization]:
    """Combine two points with the same parameters, and their linearizations: `new` for trials that are better, else
    `old`."""
    (tried, there), (point, at) = new, old

    def of(which: np.ndarray):
        return lambda a, b: on_device(np.where(np.reshape(which, (-1,) + (1,) * (a.ndim - 1)), a, b))

    of_windows = of(better[owner])
    R, seen = of_windows(there.blocks.R, at.blocks.R), jax.tree.map(of_windows, there.prediction, at.prediction)
    b, z = of(better)(tried.trial_unknowns, point.trial_unknowns), of_windows(tried.window_starts, point.window_starts)
    point = Unknowns(point.parameters, b, z, point.meaning)
    return point, Linearization(eqx.tree_at(lambda blocks: blocks.R, at.blocks, R), seen)
