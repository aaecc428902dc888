"""A problem solved to its end: with steps of integration that are fine enough where it ends. Knows no method."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._system.system import System
from ._declarations import Prior
from ._model import Simulation, Unknowns
from ._optimize import Optimizer, minimize
from ._optimizers import GradientDescent
from ._problem import Names, Problem
from ._result import Fit
from ._trial import Trial


def solve(
    problem: Problem,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """`minimize`, gone on with from where it ended, as long as the steps of integration are too coarse there."""
    optimizer = GradientDescent() if optimizer is None else optimizer
    run: Any = {"steps": steps, "callback": callback, "progress": progress}
    result = minimize(problem, optimizer, start=start, checkpoint=checkpoint, **run)
    # The file is that of the first steps: what follows begins near its end.
    for _ in range(3):
        if not result.problem.chooses_steps or result.status != "converged" or not result.too_coarse:
            break
        problem = result.problem.finer(result.point)
        if np.array_equal(problem.windows.step, result.problem.windows.step):
            break
        again = minimize(problem, optimizer.without_preparation(), start=result.point, **run)
        result = dataclasses.replace(again, history=(*result.history, *again.history[1:]))
    return result


def fit(
    system: System,
    trials: Sequence[Trial] | Trial,
    free: Any,
    *,
    unknown: Names = (),
    sensor_bias: Names = (),
    sensor_gain: Names = (),
    input_bias: Names = (),
    input_gain: Names = (),
    input_delay: Names = (),
    priors: Mapping[str, Prior] | None = None,
    zero_order_hold: Sequence[str] = (),
    window: float | None = None,
    defect_std: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    processes: bool = False,
    simulation: Simulation | None = None,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """The parameters of a system with which its motion is nearest to what was measured.

        minimize  sum ((gain * simulated + bias - measured) / sigma)^2

    **Arguments:**

    - `system`: with initial guesses of its parameters. `trials`: one `Trial` or several.
    - `free`: what to find: names, paths, functions to leaves, `Free`, `Gain`, `Delay` and `Inertia`.
    - `unknown`: coordinates, independent speeds and states of the first order whose value at the start of every window
        is to be found too; dependent ones follow from them (`assemble`). What is measured and not among them starts at
        its first sample, with the error of that. Four unknown Euler parameters are three degrees of freedom.
    - `sensor_bias`, `sensor_gain`: channels with an unknown constant offset and factor in every trial. `input_bias`,
        `input_gain`, `input_delay` [s]: inputs with an offset, a factor and a delay of every trial's own.
    - These are names, or a dict from names to the standard deviation of a Gaussian prior around the initial guess
        (None: no prior).
    - `priors`: (mean, standard deviation) by name, of parameters that were measured elsewhere; names that are not free
        are passed over.
    - `zero_order_hold`: inputs under a zero-order hold, which keep each sample until the next; the others are linear
        between their samples.
    - `window` [s]: cut the trials into windows of this length, each with its own unknown start (multiple shooting), as
        unstable motions need, and of two samples at least. By default a trial is one window (single shooting).
    - `defect_std`: by name, the standard deviation of the jump from a window's end to the next one's start, for what is
        `unknown`; names left out jump freely. Small ones ask for one motion through all windows; with windows as short
        as the samples they are a process noise, and the sum of squares is that of a Kalman filter's prediction errors.
    - `noise`: by name, spectral densities of the white noise that disturbs independent speeds and states [unit^2/s] and
        inputs [unit^2 s]. The motion is then a random one, the cost is minus twice the log likelihood by an extended
        Kalman filter, and `SpectralDensity` and `NoiseScale` in `free` estimate these and the sensors' deviations. {}
        for no noise but the sensors'. `unknown` starts with a deviation are what the filter begins with, those without
        are estimated; `window` is not needed, since the filter follows an unstable motion too.
    - `processes`: let all processes of `jax.distributed` simulate together. Each is started with the same script,
        calls `jax.distributed.initialize(...)` before anything else, and this with all trials; each simulates a share
        of the windows, all take the same steps and return the same `Fit`, that of one process alone.
    - `simulation`: how motions are integrated: `Simulation(rtol=1e-8)`, `Simulation(step=0.01)`.
    - `optimizer`: `GradientDescent()`, `LeastSquares()` (Levenberg-Marquardt; with `damping=0` Gauss-Newton) or
        `BFGS()`, with their options; by default the first.
    - `steps`, `start`, `checkpoint`, `callback`, `progress`: of its run, as in `minimize`.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` that names what is wrong with a trial, a channel, a parameter or a window.
    """
    problem = Problem.of(
        system,
        trials,
        free,
        unknown=unknown,
        sensor_bias=sensor_bias,
        sensor_gain=sensor_gain,
        input_bias=input_bias,
        input_gain=input_gain,
        input_delay=input_delay,
        priors=priors,
        zero_order_hold=zero_order_hold,
        window=window,
        defect_std=defect_std,
        noise=noise,
        simulation=simulation,
        processes=processes,
    )
    return solve(problem, optimizer, steps, start, checkpoint, callback, progress)
