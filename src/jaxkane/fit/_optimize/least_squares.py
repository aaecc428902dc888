"""Levenberg-Marquardt and Gauss-Newton with nuisance values eliminated block by block."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._problem.blocks import eliminate
from .._problem.model import Point
from .._problem.problem import Linearization, Problem, linearize
from .._result.result import Fit
from .checkpoint import Checkpoint
from .steps import moved, settle, usable


def least_squares(
    problem: Problem,
    *,
    steps: int = 50,
    rtol: float = 1e-6,
    damping: float = 1e-3,
    horizons: Sequence[float] = (),
    start: Point | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Point, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """Minimize the sum of squares by Levenberg-Marquardt with exact Jacobians.

        (J^T J + damping^2 diag(J^T J)) d = -J^T r

    The nuisance values of windows and trials are eliminated first, so a step costs one simulation of every window with
    its own few derivatives. (A solver that is not told of the blocks, such as optimistix's, differentiates every window
    in the direction of every other window's unknowns: 31 windows with 190 unknowns, twenty times the work.)

    **Arguments:**

    - `steps`: at most. `rtol`: stop when a step promises to lower the cost by less than this part.
    - `damping`: at the start; it falls where the promise is kept, and rises where it is not.
    - `horizons`: shares of every window, such as (0.25, 0.5), that are fitted before the whole: for first guesses from
        which the end of a window cannot be reached.
    - `start`: a `Point` to go on from, such as `fit.point`.
    - `checkpoint`: a file in which the state is kept after every step; where it exists the fit goes on from there.
    - `callback`: called with the point and its cost at the start and after every step. `progress`: a progress bar.

    **Returns:** a `Fit`; after an interruption (Ctrl-C) the best so far, and `status` says so.

    **Raises:** `ValueError` where a window cannot be simulated with the first guess, or a checkpoint is of another fit.
    """
    method = "Levenberg-Marquardt" if damping else "Gauss-Newton"
    start = problem.start if start is None else start
    file = Checkpoint(checkpoint, problem, method=method)
    saved = file.read(point=start, damping=0.0, history=0.0)
    if saved is None:
        for share in horizons:
            start = least_squares(_part(problem, share), steps=steps, rtol=1e-3, start=start, progress=progress).point
        point, at = settle(problem, start)
        state = _State(point, damping, [at.cost])
    else:
        state = _State(saved["point"], float(saved["damping"]), [float(c) for c in saved["history"]])
        at = linearize(problem, state.point)
        if not usable(at):
            raise ValueError(f"{checkpoint}: the residuals are not finite where this fit was left; delete the file.")
    assert at is not None
    status = "steps"
    bar = tqdm(total=steps, initial=len(state.history) - 1, disable=not progress, desc=method)
    try:
        if callback:
            callback(state.point, at.cost)
        while len(state.history) <= steps:
            found = _step(problem, state, at, rtol)
            if isinstance(found, str):
                status = found
                break
            at = found
            state.history.append(at.cost)
            file.write(point=state.point, damping=state.damping, history=np.array(state.history))
            if callback:
                callback(state.point, at.cost)
            bar.update()
            bar.set_postfix(cost=f"{at.cost:.6g}")
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return Fit.of(problem, state.point, at, state.history, status, method)


def gauss_newton(problem: Problem, **options: Any) -> Fit:
    """Minimize the sum of squares by Gauss-Newton: `least_squares` without damping, as long as every step succeeds.

    The fastest where the first guess is near; a step that fails is damped until it does not. Arguments and result are
    those of `least_squares`.
    """
    return least_squares(problem, **{**options, "damping": 0.0})


@dataclasses.dataclass
class _State:
    """Between two steps: all that the next one depends on."""

    point: Point
    damping: float
    history: list[float]


def _step(problem: Problem, state: _State, at: Linearization, rtol: float) -> Linearization | str:
    """One step, or why there is none. A step that is refused leaves the point and raises the damping."""
    damping = state.damping
    eliminated = eliminate(at.blocks, damping)
    x, promised = eliminated.step(damping)
    gain = at.cost - float(promised)
    # What is left of a cost that vanishes is rounding: a millionth of a standard error.
    if gain <= max(rtol * at.cost, 1e-12) and damping <= 1e-2:
        return "converged"
    tried = moved(state.point, x, eliminated)
    there = linearize(problem, tried)
    if there is not None and usable(there) and there.cost >= at.cost:
        # Often only the nuisance values, which went along a straight line, are not yet where they belong.
        tried = moved(tried, jnp.zeros_like(x), eliminate(there.blocks, 0.0))
        there = linearize(problem, tried)
    if there is not None and usable(there) and there.cost < at.cost:
        ratio = (at.cost - there.cost) / gain
        state.point = tried
        # Nielsen's rule: trust more where the promise was kept.
        state.damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)
        return there
    state.damping = max(5 * damping, 1e-3)
    return at if state.damping <= 1e8 else "stuck"


def _part(problem: Problem, share: float) -> Problem:
    """The first part of every window."""
    if not 0 < share < 1:
        raise ValueError(f"`horizons` are shares of a window, between 0 and 1; got {share}.")
    return problem.shortened(np.array([max(2, round(share * n)) for _, _, n in problem.places]))
