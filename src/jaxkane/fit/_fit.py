"""The front door: pose a fit and run it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import diffrax
from jaxtyping import Array

from .._system import System
from .._trajectory import Trajectory
from ._gradient_descent import gradient_descent
from ._least_squares import least_squares
from ._problem import Problem
from ._result import Fit
from ._trial import Trial

METHODS = {"gradient_descent": gradient_descent, "least_squares": least_squares}


def fit(
    system: System,
    trials: Sequence[Trial] | Trial,
    free: Any,
    *,
    unknown: Sequence[str] | Mapping[str, float | None] = (),
    sensor_bias: Sequence[str] | Mapping[str, float | None] = (),
    input_bias: Sequence[str] | Mapping[str, float | None] = (),
    hold: Sequence[str] = (),
    window: float | None = None,
    outputs: Mapping[str, Callable[[Trajectory], Array]] | None = None,
    method: Literal["gradient_descent", "least_squares"] = "gradient_descent",
    rtol: float | None = None,
    atol: float | None = None,
    step: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 4096,
    **options: Any,
) -> Fit:
    """The parameters of a system with which its motion is nearest to what was measured.

        minimize  sum ((simulated + bias - measured) / sigma)^2

    **Arguments:**

    - `system`: with first guesses of its parameters. `trials`: one `Trial` or several.
    - `free`: what to find: names, paths, functions to leaves, `Free` and `Gain`.
    - `unknown`: coordinates and independent speeds whose value at the start of every window is to be found too;
        dependent ones follow from them (`assemble`).
    - `sensor_bias`: channels with an unknown constant offset in every trial. `input_bias`: inputs with one.
    - `unknown`, `sensor_bias` and `input_bias` are names, or a dict from names to the standard deviation of a Gaussian
        prior around the first guess (None: no prior).
    - `hold`: inputs that keep each sample until the next, as a digital controller's commands do; the others are linear
        between their samples.
    - `window` [s]: cut the trials into windows of this length, each with its own unknown start (multiple shooting), as
        unstable motions need. By default a trial is one window.
    - `outputs`: channels that are functions of the `Trajectory`, by name: values (n_t,).
    - `method`: "gradient_descent" or "least_squares"; `options` go to it (`steps`, `progress`, ...).
    - `rtol`, `atol`, `step`, `solver`, `max_steps`: of the simulation. By default one step of Bosh3 between
        neighbouring samples where inputs are sampled at a steady rate, and Tsit5 with a tolerance of 1e-6 elsewhere.

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
        input_bias=input_bias,
        hold=hold,
        window=window,
        outputs=outputs,
        rtol=rtol,
        atol=atol,
        step=step,
        solver=solver,
        max_steps=max_steps,
    )
    return METHODS[method](problem, **options)
