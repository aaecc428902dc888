"""Starts and biases that fit best with the parameters fixed: damped Gauss-Newton steps, each trial by itself."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._integrate.status import Status, reason
from .._scalarjit.compat import on_device
from ._block_lsq import Eliminated, eliminate
from ._linearize import Linearization
from ._model import Unknowns
from ._problem import Problem


def moved(point: Unknowns, x: Any, eliminated: Eliminated) -> Unknowns:
    """The point after a step x of the parameters, with the nuisance values that go with it."""
    x = np.asarray(x)
    z, b = eliminated.back_substitute(x)
    after = lambda before, step: on_device(np.asarray(before) + step)  # noqa: E731
    return Unknowns(after(point.x, x), after(point.b, b), after(point.z, z))


def usable(at: Linearization | None) -> bool:
    """Whether a step led to finite residuals and derivatives."""
    return at is not None and bool(np.all(at.good))


class Unsimulated(ValueError):
    """Windows that cannot be simulated to their end. `reasons`: by the number of their trial, why."""

    def __init__(self, problem: Problem, point: Unknowns, at: Linearization | None, bad: np.ndarray):
        bad = problem.without_start(point) if at is None else bad
        self.reasons: dict[int, str] = {}
        for i in np.flatnonzero(bad):
            (k, first, n), why = problem.slices[i], "no consistent start"
            if at is not None:
                status = int(at.status[i])
                why = "not finite" if status == Status.COMPLETED else reason(status, _event_names(problem))
            t = problem.trials[k].t
            self.reasons.setdefault(
                k, f"from {t[first]:g} to {t[first + n - 1]:g} s there are no finite residuals ({why})"
            )
        k, words = next(iter(self.reasons.items()))
        super().__init__(
            f"{problem.trials[k].name}: with the initial guess {words}, as in {int(bad.sum())} of {len(bad)} windows. "
            "Choose shorter windows or other starting values, or leave this stretch out."
        )


def solve_nuisance(
    problem: Problem, point: Unknowns, steps: int = 8, rtol: float = 1e-2
) -> tuple[Unknowns, Linearization]:
    """The nuisance values that fit best with the parameters held: Gauss-Newton, damped where that fails.

    Windows that cannot be simulated to their end with the initial guess (an unstable ride falls over) begin with a
    shorter horizon, which is doubled as soon as it fits. Where that fails for windows that are chained, each is first
    solved for by itself.

    **Raises:** `Unsimulated` that names a window which does not reach its end.
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
        if at is None or np.any(samples[bad] <= 2):
            raise Unsimulated(problem, point, at, bad & (samples <= 2))
        samples = np.where(bad, np.maximum(samples // 2, 2), samples)
        at = problem.shortened(samples).linearize(point)
    stuck = 0
    while True:
        point, at = refined(problem.shortened(samples), point, at, steps if np.all(samples == whole) else 2, rtol)
        if np.all(samples == whole):
            return point, at
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
    """The nuisance values after a few Gauss-Newton steps with the parameters held, until these gain less than a part
    `rtol`, or the cost is `enough`.

    Trials then know nothing of one another: each has a damping of its own, and keeps a step only where its own cost
    falls, so that one in which a step leads too far holds up no other.
    """
    still, owner = np.zeros_like(point.x), np.asarray(problem.windows.trial)
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
        done = better | (after <= before + 1e-9 * at.squares)
        if (done.all() and gained <= rtol * at.squares) or at.cost <= enough:
            break
    return point, at


def _by_owner(at: Linearization, owner: np.ndarray, n: int) -> np.ndarray:
    """Costs of trials (T,)."""
    return np.bincount(owner, weights=at.costs, minlength=n)


def _chosen(better: np.ndarray, owner: np.ndarray, new: Any, old: Any) -> tuple[Unknowns, Linearization]:
    """Of two points with the same parameters, and what they were linearized to, the first where a trial is better."""
    (tried, there), (point, at) = new, old

    def of(which: np.ndarray):
        return lambda a, b: on_device(np.where(np.reshape(which, (-1,) + (1,) * (a.ndim - 1)), a, b))

    of_windows = of(better[owner])
    R, seen = of_windows(there.blocks.R, at.blocks.R), jax.tree.map(of_windows, there.prediction, at.prediction)
    b, z = of(better)(tried.b, point.b), of_windows(tried.z, point.z)
    return Unknowns(point.x, b, z), Linearization(eqx.tree_at(lambda blocks: blocks.R, at.blocks, R), seen)


def _event_names(problem: Problem) -> tuple[str, ...]:
    first = jax.tree.map(lambda x: x[0], problem.windows)
    start = problem.start
    return jax.eval_shape(problem.model.simulate, first, first.start, start.b[0], start.x).events
