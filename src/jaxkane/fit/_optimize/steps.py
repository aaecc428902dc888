"""What every optimizer of a fit shares: initial guesses of the nuisance values, and steps that may fail."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._simulation.trajectory import Status, reason
from .._problem.blocks import Eliminated, eliminate
from .._problem.model import Unknowns
from .._problem.problem import Linearization, Problem, linearize


def moved(point: Unknowns, x: Array, eliminated: Eliminated) -> Unknowns:
    """The point after a step x of the parameters, with the nuisance values that go with it."""
    z, b = eliminated.others(x)
    return Unknowns(point.x + x, point.b + b, point.z + z)


def usable(at: Linearization | None) -> bool:
    """Whether a step led to finite residuals and derivatives."""
    return at is not None and bool(np.all(at.good))


def uninterrupted(fit: Any) -> Any:
    """A fit that is a part of a study. **Raises:** `KeyboardInterrupt` where Ctrl-C ended it: that ends the study."""
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit


def solve_nuisance(
    problem: Problem, point: Unknowns, steps: int = 8, rtol: float = 1e-2
) -> tuple[Unknowns, Linearization]:
    """The nuisance values that fit best with the parameters held: Gauss-Newton, damped where that fails.

    Windows that cannot be simulated to their end with the initial guess (an unstable ride falls over) begin with a
    shorter horizon, which is doubled as soon as it fits. Where that fails for windows that are chained, each is first
    solved for by itself.

    **Raises:** `ValueError` that names a window which does not reach its end.
    """
    try:
        return _solved(problem, point, steps, rtol)
    except ValueError:
        if not problem.model.nuisance.chained:
            raise
    point, _ = _solved(problem.unchained(), point, steps, rtol)
    return _solved(problem, point, steps, rtol)


def _solved(problem: Problem, point: Unknowns, steps: int, rtol: float) -> tuple[Unknowns, Linearization]:
    whole = np.array([n for _, _, n in problem.places])
    samples = whole.copy()
    at = linearize(problem.shortened(samples), point)
    while at is None or not at.good.all():
        bad = ~at.good if at is not None else np.full(len(whole), True)
        if at is None or np.any(samples[bad] <= 2):
            raise ValueError(_cannot_start(problem, at, bad))
        samples = np.where(bad, np.maximum(samples // 2, 2), samples)
        at = linearize(problem.shortened(samples), point)
    stuck = 0
    while True:
        point, at = _nuisance_steps(
            problem.shortened(samples), point, at, steps if np.all(samples == whole) else 2, rtol
        )
        if np.all(samples == whole):
            return point, at
        longer = (
            np.minimum(2 * samples, whole) if stuck == 0 else np.minimum(samples + np.maximum(samples // 4, 1), whole)
        )
        tried = linearize(problem.shortened(longer), point)
        bad = ~tried.good if tried is not None else np.full(len(whole), True)
        if np.all(samples[~bad] == longer[~bad]) and bad.any():
            stuck += 1
            if stuck > 2:
                raise ValueError(_cannot_start(problem, tried, bad))
        samples = np.where(bad, samples, longer)
        at = tried if tried is not None and not bad.any() else linearize(problem.shortened(samples), point)
        assert at is not None


def _nuisance_steps(problem: Problem, point: Unknowns, at: Linearization, steps: int, rtol: float):
    still = jnp.zeros_like(point.x)
    damping = 0.0
    for _ in range(steps):
        tried = moved(point, still, eliminate(at.blocks, damping))
        there = linearize(problem, tried)
        if there is not None and usable(there) and there.cost <= at.cost:
            gained = at.cost - there.cost
            point, at, damping = tried, there, damping / 10
            if gained <= rtol * at.squares:
                break
        elif there is not None and usable(there) and there.cost <= at.cost + 1e-9 * at.squares:
            break
        else:
            damping = max(10 * damping, 1e-2)
    return point, at


def _cannot_start(problem: Problem, at: Linearization | None, bad: np.ndarray) -> str:
    i = int(np.argmax(bad))
    k, first, n = problem.places[i]
    trial = problem.trials[k]
    why = "no consistent start"
    if at is not None:
        status = int(at.status[i])
        why = "not finite" if status == Status.COMPLETED else reason(status, _event_names(problem))
    return (
        f"{trial.name}: from {trial.t[first]:g} to {trial.t[first + n - 1]:g} s the initial guess gives no finite "
        f"residuals ({why}; {int(bad.sum())} of {len(bad)} windows). Choose shorter windows or other starting values, "
        "or leave this stretch out."
    )


def _event_names(problem: Problem) -> tuple[str, ...]:
    first = jax.tree.map(lambda x: x[0], problem.windows)
    start = problem.start
    return jax.eval_shape(problem.model.simulate, first, first.start, start.b[0], start.x).events
