"""The effect of the integration error on the residuals, and steps or tolerances that make it small enough.

An input that is linear between its samples has a discontinuous slope at every sample. Error control takes ten steps
there. A fixed step from sample to sample contains no discontinuity. Measured for rides of a steered bicycle (100 Hz,
1 s): 1300 adaptive steps at a tolerance of 1e-7, and 100 fixed steps of Bosh3. The results differ by 0.002 standard
deviations of the measurements.
"""

from __future__ import annotations

from typing import Any

import numpy as np

STEP_TOLERANCE = 0.05, 0.25
"""The largest norm of the change of the residuals by the integration error, in standard deviations: of one window, and
of all windows. It is an upper bound of the bias of an estimate, in standard errors."""

HALVINGS, STIFF_HALVINGS = 8, 5
"""The maximum number of times that a step is halved: in general, and while the simulation stops early. A system that
needs more is stiff or chaotic."""

SMALLEST_NOISE = 1e-6
"""The smallest assumed noise of a measurement, relative to the root mean square of the signal. Simulated measurements
do not contain noise. Their residuals are only integration errors, so they cannot be the reference for integration
errors."""


Problem = Any
"""`Problem` cannot be imported here, because its module imports this one."""


def residual_deviation(problem: Problem, squares: float) -> float:
    """The standard deviation of a residual in units of `sigma`, for a fit with this sum of squares."""
    (n_r, n_unknown), windows = problem.size, problem.windows
    if problem.model.noise is not None or n_r <= n_unknown:
        return 1.0
    weight = np.asarray(windows.weight)
    signal = np.linalg.norm(np.asarray(windows.measured) * weight) / max(np.count_nonzero(weight), 1) ** 0.5
    return max((squares / (n_r - n_unknown)) ** 0.5, SMALLEST_NOISE * float(signal))


def step_tolerance(problem: Problem) -> float:
    """The largest allowed norm of the change of one window's residuals by finer steps, in standard deviations."""
    one, together = STEP_TOLERANCE
    return min(one, together / len(problem.slices) ** 0.5)


def step_errors(problem: Problem, point: Any, now: Any = None) -> np.ndarray:
    """The norm of the change of every window's residuals (W,) by finer steps, in units of `sigma`.

    Finer means half of a fixed step, or a tenth of the tolerances. The result is NaN if both simulations of a window
    fail, and infinite if one of them fails.

    `now`: the simulation at the point, if it was already computed.
    """
    before = problem.simulated(point) if now is None else now
    return _distance(problem, before, _with_finer(problem).simulated(point))


def _with_finer(problem: Problem) -> Problem:
    if problem.has_steps:
        return problem.with_steps(np.asarray(problem.windows.step) / 2)
    return problem.with_tolerances(np.asarray(problem.model.settings.rtol) / 10)


def finer(problem: Problem, point: Any, deviation: float = 1.0) -> Problem:
    """The problem with finer steps.

    Fixed steps are halved, window by window, while this changes the simulation by more than a fraction of the noise.
    Tolerances are divided by ten, for all windows together.

    **Arguments:**

    - `problem`: the problem.
    - `point`: the `Unknowns` of the simulation.
    - `deviation`: the standard deviation of a residual, in units of `sigma`.
    """
    if not problem.has_steps:
        return _with_finer(problem)
    first, before = np.asarray(problem.windows.step), problem.simulated(point)
    going, last = np.full(len(problem.slices), True), np.full(len(problem.slices), np.inf)
    for halvings in range(HALVINGS):
        steps = np.asarray(problem.windows.step)
        half = steps / np.where(going, 2, 1).astype(steps.dtype)
        after = problem.with_steps(half).simulated(point)
        distance = _distance(problem, before, after)
        going &= ~(distance <= step_tolerance(problem) * deviation)
        # If halving does not reduce the difference, the motion is chaotic and no step is fine enough. If the simulation
        # stops early, the step may be too long for a stiff motion.
        falls = np.isfinite(distance) & (distance <= last / 2)
        going &= (halvings < 2) | falls | (~np.isfinite(distance) & (halvings < STIFF_HALVINGS))
        if not going.any():
            break
        problem = problem.with_steps(np.where(going, half, steps))
        before, last = np.where(going[:, None, None], after, before), distance
    lost = ~np.all(np.isfinite(np.where(_weights(problem, before) > 0, before, 0.0)), axis=(1, 2))
    # If the simulation of a window fails at the initial guess, it may succeed for better parameters. Such a window gets
    # the shortest step of the other windows.
    halvings = 0.0 if lost.all() else np.max(np.log2(np.asarray(first / problem.windows.step))[~lost])
    shortest = first / first.dtype.type(2.0**halvings)
    return problem.with_steps(np.where(lost, shortest, problem.windows.step))


def _distance(problem: Problem, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The norm of the difference of two simulations (W,), in units of `sigma`.

    The result is infinite if one of the two simulations failed, and NaN if both did.
    """
    weight = _weights(problem, a)
    lost = [np.any((weight > 0) & ~np.isfinite(x), axis=(1, 2)) for x in (a, b)]
    with np.errstate(invalid="ignore"):
        norm = np.linalg.norm(np.where(weight > 0, (b - a) * weight, 0.0), axis=(1, 2))
    return np.where(lost[0] & lost[1], np.nan, np.where(lost[0] | lost[1], np.inf, norm))


def _weights(problem: Problem, simulated: np.ndarray) -> np.ndarray:
    """One over the standard deviations of the measurements, repeated to the shape of `simulated`."""
    weight = np.asarray(problem.windows.weight)
    if problem.model.errors is not None:
        weight = weight / np.asarray(problem.model.errors.numbers.scale)[:, None]
    return np.tile(weight, (1, simulated.shape[1] // weight.shape[1], 1))
