"""Levenberg-Marquardt with nuisance values eliminated block by block."""

from __future__ import annotations

import jax.numpy as jnp
from tqdm import tqdm

from ._blocks import eliminate
from ._problem import Point, Problem, linearize
from ._result import Fit
from ._steps import moved, settle, usable


def least_squares(
    problem: Problem, *, steps: int = 50, rtol: float = 1e-6, start: Point | None = None, progress: bool = False
) -> Fit:
    """Minimize the sum of squares by Levenberg-Marquardt with exact Jacobians.

        (J^T J + damping^2 diag(J^T J)) d = -J^T r

    The nuisance values of windows and trials are eliminated first, so a step costs one simulation of every window with
    its own few derivatives. (A solver that is not told of the blocks, such as optimistix's, differentiates every window
    in the direction of every other window's unknowns: 31 windows with 190 unknowns, twenty times the work.)

    **Arguments:**

    - `steps`: at most. `rtol`: stop when a step promises to lower the cost by less than this part.
    - `start`: a `Point` to go on from, such as `fit.point`. `progress`: show a progress bar.

    **Returns:** a `Fit`; after an interruption (Ctrl-C) the best so far, and `status` says so.

    **Raises:** `ValueError` where a window cannot be simulated with the first guess.
    """
    point, at = settle(problem, problem.start if start is None else start)
    history, status, damping = [at.cost], "steps", 1e-3
    bar = tqdm(total=steps, disable=not progress, desc="least squares")
    try:
        for _ in range(steps):
            eliminated = eliminate(at.blocks, damping)
            x, promised = eliminated.step(damping)
            gain = at.cost - float(promised)
            if gain <= rtol * at.cost and damping <= 1e-2:
                status = "converged"
                break
            tried = moved(point, x, eliminated)
            there = linearize(problem, tried)
            if there is not None and usable(there) and there.cost >= at.cost:
                # Often only the nuisance values, which went along a straight line, are not yet where they belong.
                tried = moved(tried, jnp.zeros_like(x), eliminate(there.blocks, 0.0))
                there = linearize(problem, tried)
            if there is not None and usable(there) and there.cost < at.cost:
                ratio = (at.cost - there.cost) / gain
                point, at = tried, there
                # Nielsen's rule: trust more where the promise was kept.
                damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)
            else:
                damping *= 5
                if damping > 1e8:
                    status = "stuck"
                    break
            history.append(at.cost)
            bar.update()
            bar.set_postfix(cost=f"{at.cost:.6g}")
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return Fit.of(problem, point, at, history, status, "Levenberg-Marquardt")
