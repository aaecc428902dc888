"""The front door: pose a fit and run it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import diffrax
import numpy as np
from jaxtyping import Array

from .._description.system import System
from .._simulation.trajectory import Trajectory
from ._data.trial import Trial
from ._optimize.bfgs import bfgs
from ._optimize.gradient_descent import gradient_descent
from ._optimize.least_squares import gauss_newton, least_squares
from ._problem.names import Names
from ._problem.parameters import Prior
from ._problem.problem import Problem
from ._result.result import Fit

METHODS = {
    "gradient_descent": gradient_descent,
    "least_squares": least_squares,
    "gauss_newton": gauss_newton,
    "bfgs": bfgs,
}


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
    hold: Sequence[str] = (),
    window: float | None = None,
    continuity: Mapping[str, float] | None = None,
    outputs: Mapping[str, Callable[[Trajectory], Array]] | None = None,
    method: Literal["gradient_descent", "least_squares", "gauss_newton", "bfgs"] = "gradient_descent",
    rtol: float | None = None,
    atol: float | None = None,
    step: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int | None = None,
    processes: bool = False,
    **options: Any,
) -> Fit:
    """The parameters of a system with which its motion is nearest to what was measured.

        minimize  sum ((gain * simulated + bias - measured) / sigma)^2

    **Arguments:**

    - `system`: with first guesses of its parameters. `trials`: one `Trial` or several.
    - `free`: what to find: names, paths, functions to leaves, `Free`, `Gain`, `Delay` and `Inertia`.
    - `unknown`: coordinates and independent speeds whose value at the start of every window is to be found too;
        dependent ones follow from them (`assemble`).
    - `sensor_bias`, `sensor_gain`: channels with an unknown constant offset and factor in every trial. `input_bias`,
        `input_gain`, `input_delay` [s]: inputs with an offset, a factor and a delay of every trial's own.
    - These are names, or a dict from names to the standard deviation of a Gaussian prior around the first guess (None:
        no prior).
    - `priors`: (mean, standard deviation) by name, of parameters that were measured elsewhere; names that are not free
        are passed over.
    - `hold`: inputs that keep each sample until the next, as a digital controller's commands do; the others are linear
        between their samples.
    - `window` [s]: cut the trials into windows of this length, each with its own unknown start (multiple shooting), as
        unstable motions need. By default a trial is one window (single shooting).
    - `continuity`: by name, the standard deviation of the jump from a window's end to the next one's start, for what is
        `unknown`; names left out jump freely. Small ones ask for one motion through all windows; with windows as short
        as the samples they are a process noise, and the sum of squares is that of a Kalman filter's prediction errors.
    - `outputs`: channels that are functions of the `Trajectory`, by name: values (n_t,).
    - `method`: "gradient_descent", "least_squares" (Levenberg-Marquardt), "gauss_newton" or "bfgs"; `options` go to it
        (`steps`, `start`, `checkpoint`, `progress`, ...).
    - `rtol`, `atol`, `step`, `solver`, `max_steps`: of the simulation. By default, where inputs vary and neither
        tolerances nor a step are given, one step of Bosh3 between neighbouring samples, halved until that changes what
        is simulated by less than a share of the noise, at the first guess and again where the fit ended; elsewhere
        Tsit5 with a tolerance of 1e-6. `Fit.step_error` says what is left. `max_steps`: by default as many as fixed
        steps take, and 4096 with tolerances.
    - `processes`: let all processes of `jax.distributed` simulate together. Each is started with the same script,
        calls `jax.distributed.initialize(...)` before anything else, and this with all trials; each simulates a share
        of the windows, all take the same steps and return the same `Fit`, that of one process alone.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` that names what is wrong with a trial, a channel, a parameter or a window.
    """
    if method not in METHODS:
        raise ValueError(f"`method` is one of {', '.join(METHODS)}; got {method!r}.")
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
        hold=hold,
        window=window,
        continuity=continuity,
        outputs=outputs,
        rtol=rtol,
        atol=atol,
        step=step,
        solver=solver,
        max_steps=max_steps,
        processes=processes,
    )
    return _with_fine_steps(METHODS[method](problem, **options), METHODS[method], options)


def _with_fine_steps(result: Fit, method: Callable[..., Fit], options: Mapping[str, Any]) -> Fit:
    """The fit gone on with from where it ended, as long as the steps of integration are too coarse there."""
    if result.problem.posed["step"] is not None:
        return result
    # The file is that of the first steps: what follows begins near its end.
    options = {key: value for key, value in options.items() if key not in ("start", "checkpoint", "horizons")}
    for _ in range(3):
        if result.status != "converged" or not result.too_coarse:
            break
        problem = result.problem.finer(result.point)
        if np.array_equal(problem.windows.step, result.problem.windows.step):
            break
        again = method(problem, start=result.point, **options)
        result = dataclasses.replace(again, history=(*result.history, *again.history[1:]))
    return result
