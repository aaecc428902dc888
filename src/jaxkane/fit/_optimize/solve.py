"""A problem solved to its end: with steps of integration that are fine enough where it ends. Knows no method."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.result import Fit
from .gradient_descent import GradientDescent
from .minimize import minimize
from .optimizer import Optimizer


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
