"""Initial guesses of motions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._collocate.functions import Condition, bounds_of
from .._collocate.transcription import Motion
from .._common.lookup import real_number, refuse_unknown
from .._integrate.trajectory import Trajectory
from .._kane.consistent_state import assemble
from .._kane.right_hand_side import vector_field
from .._system.system import units_of
from ._problem import Problem


def guess_of(problem: Problem, guess: Any, s: np.ndarray) -> Motion:
    """The guess of a motion at nodes.

    **Arguments:**

    - `problem`: the problem.
    - `guess`: None, a `Trajectory`, or by name numbers, arrays (n,) of samples at even distances, or functions of time;
        with "duration" a number.
    - `s` (K,): the nodes, as fractions of the duration.

    **Raises:** `ValueError` for unknown names and for values outside the bounds of the problem.
    """
    if isinstance(guess, Trajectory):
        return _of_trajectory(problem, guess, s)
    given = {} if guess is None else guess
    if not isinstance(given, Mapping):
        raise TypeError(
            "solve: `guess` must be None, a Plan, a Trajectory, a dict by name, or a sequence of these; "
            f"got {type(guess).__name__}."
        )
    names, controls = problem.names, tuple(problem.bounds_of_controls)
    refuse_unknown(given, [*names, *controls, "duration"], f"solve: `guess`: {problem.title} has no", "it has")
    low, high = problem.durations
    duration = real_number(given.get("duration", 0.5 * (low + high)), "solve: `guess` of 'duration'")
    if not low <= duration <= high:
        raise ValueError(
            f"solve: `guess` of 'duration' is {duration:.6g} s, but it must be from {low:g} to {high:g} s."
        )
    Y, W = _automatic(problem, s, duration)
    for name, value in given.items():
        if name != "duration":
            target, i = (Y, names.index(name)) if name in names else (W, controls.index(name))
            target[:, i] = _values(problem, name, value, s, duration)
    return Motion(s, duration, *_clipped(problem, s, Y, W, given))


def detoured(problem: Problem, motion: Motion, detour: np.ndarray) -> Motion:
    """A motion with sines of the amplitudes (n_q, 3) added to its coordinates. Both ends stay where they are."""
    k = np.arange(1, detour.shape[1] + 1)
    Y = motion.Y.copy()
    Y[:, : len(detour)] += np.sin(np.pi * np.outer(motion.s, k)) @ detour.T
    return motion._replace(Y=_clipped(problem, motion.s, Y, motion.W, {})[0])


def detours(problem: Problem, count: int, seed: int = 0) -> list[np.ndarray | None]:
    """Amplitudes of sines (n_q, 3) for random guesses. The first one is None."""
    rng, units = np.random.default_rng(seed), units_of(problem.system)
    sizes = []
    for name in problem.system.coordinates:
        spread = np.ptp([*problem.sizes_of(name), *[0.0] * (not problem.sizes_of(name))])
        sizes.append(1.0 if units.get(name, "") in ("", "rad") else spread)
    return [None, *(rng.normal(size=(3, len(sizes))).T * np.array(sizes)[:, None] for _ in range(count - 1))]


def _middle(value: Condition | None, otherwise: float) -> float:
    """The number, or a place between two bounds."""
    if value is None:
        return otherwise
    low, high = bounds_of("the guess", value)
    return 0.5 * (low + high) if math.isfinite(high - low) else min(max(otherwise, low), high)


def _automatic(problem: Problem, s: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines from the start to the end. Coordinates without an end continue with their initial rates."""
    system, names, limits = problem.system, problem.names, problem.limits
    ends, controls = problem.ends, tuple(problem.bounds_of_controls)
    numbers = [[_middle(ends[label].get(name), math.nan) for name in names] for label in ("start", "end")]
    first, last = np.array(numbers)
    inside = np.array([_middle(limits.get(name), 0.0) for name in names])
    start = np.where(np.isnan(first), np.where(np.isnan(last), inside, last), first)
    start = _assembled(problem, start, first)
    W0 = np.array([min(max(0.0, limits[name][0]), limits[name][1]) for name in controls])
    y_dot = _rates(problem, start, W0)
    n_q = len(system.coordinates)
    moving = start + duration * np.where(np.arange(len(names)) < n_q, y_dot, 0.0)
    moving = np.where(np.isfinite(moving), moving, start)
    end = np.where(np.isnan(last), np.where(np.isnan(first), start, moving), last)
    Y = start + s[:, None] * (end - start)
    return Y, np.tile(W0, (len(s), 1))


def _assembled(problem: Problem, start: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The start with coordinates that satisfy the configuration constraints."""
    system, n_q = problem.system, len(problem.system.coordinates)
    if not problem.n_constraints or np.all(np.isfinite(given[:n_q])):
        return start
    known = {c: float(start[i]) for i, c in enumerate(system.coordinates) if np.isfinite(given[i])}
    try:
        q = np.asarray(assemble(system, known).q)
    except ValueError:
        return start  # the solver closes the loop
    return np.concatenate([q, start[n_q:]])


def _rates(problem: Problem, y: np.ndarray, w: np.ndarray) -> np.ndarray:
    variables = problem.variables()
    x = jnp.concatenate([jnp.asarray(y), jnp.asarray(w)])
    tail = jnp.zeros(problem.has_free_duration + (0 if variables.parameters is None else variables.parameters.size))
    known = {} if callable(problem.signals) else problem.signals
    samples = {k: f for k, f in known.items() if k not in variables.signals}
    node = {"s": jnp.zeros(()), "inputs": {k: f(0.0) for k, f in samples.items()}}
    system, _, t, y_now, inputs = variables.at(node, jnp.concatenate([x, tail]))
    return np.asarray(vector_field(system, t, y_now, inputs))


def _values(problem: Problem, name: str, value: Any, s: np.ndarray, duration: float) -> np.ndarray:
    label = f"solve: `guess` of {name!r}"
    if callable(value):
        found = np.array([real_number(value(t), label) for t in s * duration])
    else:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or array.ndim > 1 or array.size == 0:
            raise ValueError(
                f"{label} must be a number, an array (n,) of samples, or a function of time; got {value!r}."
            )
        found = np.interp(s, np.linspace(0, 1, array.size), array) if array.size > 1 else np.full(len(s), array)
    low, high = (np.full(len(s), b) for b in problem.limits.get(name, (-math.inf, math.inf)))
    for end, k in (("start", 0), ("end", -1)):
        if name in problem.ends[end]:
            low[k], high[k] = bounds_of(label, problem.ends[end][name])
    slack = 1e-9 * np.max(np.abs([*found, *low, *high]), where=np.isfinite([*found, *low, *high]), initial=0.0)
    wrong = ~np.isfinite(found) | (found < low - slack) | (found > high + slack)
    if wrong.any():
        k = int(np.argmax(wrong))
        where = {0: "the start", len(s) - 1: "the end"}.get(k, f"{s[k] * duration:.6g} s")
        required = f"{low[k]:g}" if low[k] == high[k] else f"{low[k]:g} to {high[k]:g}"
        raise ValueError(f"{label} is {found[k]:.6g} at {where}, but the problem requires {required}.")
    return found


def _clipped(
    problem: Problem, s: np.ndarray, Y: np.ndarray, W: np.ndarray, given: Any
) -> tuple[np.ndarray, np.ndarray]:
    limits = problem.limits
    for rows, names in ((Y, problem.names), (W, tuple(problem.bounds_of_controls))):
        for i, name in enumerate(names):
            if name in limits and name not in given:
                rows[:, i] = np.clip(rows[:, i], *limits[name])
    return Y, W


def _of_trajectory(problem: Problem, trajectory: Trajectory, s: np.ndarray) -> Motion:
    """A simulation as a guess, stretched to the duration of the problem."""
    t = np.asarray(trajectory.t)
    if t.ndim != 1:
        raise ValueError("solve: `guess` is a batch of trajectories. Pass one member of it.")
    reached = np.isfinite(np.asarray(trajectory.q)).all(axis=1)
    if reached.sum() < 2:
        raise ValueError(f"solve: the trajectory in `guess` has fewer than two finite states: {trajectory.reason}.")
    t = t[reached]
    low, high = problem.durations
    duration = min(max(float(t[-1] - t[0]), low), high)
    at = t[0] + s * (t[-1] - t[0])

    def sampled(names: Any) -> np.ndarray:
        known = [np.asarray(trajectory[name])[reached] for name in names]
        return np.array([np.interp(at, t, x) for x in known]).reshape(len(known), len(s)).T

    Y, W = sampled(problem.names), sampled(tuple(problem.bounds_of_controls))
    return Motion(s, duration, *_clipped(problem, s, Y, W, {}))
