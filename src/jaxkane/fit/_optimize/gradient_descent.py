"""Gradient descent by optax on the parameters, the nuisance values following by variable projection."""

from __future__ import annotations

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array
from tqdm import tqdm

from ..._common.digest import digest
from .._problem.blocks import Eliminated, eliminate
from .._problem.model import Point
from .._problem.problem import Linearization, Problem, linearize
from .._result.result import Fit
from .checkpoint import Checkpoint
from .steps import moved, settle, usable


def gradient_descent(
    problem: Problem,
    *,
    steps: int = 100,
    optimizer: optax.GradientTransformation | None = None,
    refresh: int | None = 10,
    rtol: float = 1e-6,
    start: Point | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Point, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """Minimize half the sum of squares by gradient descent.

        minimize over x  1/2 min over z, b of |residual(x, z, b)|^2

    The unknown starts z and biases b are re-solved to first order in every step (variable projection), so the
    gradient is that of the best fit with given parameters. The descent runs in coordinates y in which the sensitivity A
    is round, x = x0 + (A^T A)^(-1/2) y: a step means the same for every parameter, however well it is known.

    **Arguments:**

    - `steps`: at most. `rtol`: stop when the linearized problem promises less than this part of the cost.
    - `optimizer`: any optax optimizer, with its schedule; by default Nesterov's descent at a rate of 0.3 that falls
        along a cosine. The unit of y is the way that there seems to be to go, so rates about 0.1 suit Adam.
    - `refresh`: how many steps until the coordinates are made round anew; None for the plainly scaled
        parameters (`Free.scale`) throughout.
    - `start`: a `Point` to go on from, such as `fit.point`.
    - `checkpoint`: a file in which the state is kept after every step; where it exists the fit goes on from there.
    - `callback`: called with the point and its cost at the start and after every step. `progress`: a progress bar.

    A step whose simulation fails, or which multiplies the cost, is halved until it does not.

    **Returns:** a `Fit` at the best point seen, with the history of the cost; after an interruption (Ctrl-C) too, and
    `status` says so.

    **Raises:** `ValueError` where a window cannot be simulated with the first guess, or a checkpoint is of another fit.
    """
    start = problem.start if start is None else start
    descent = optimizer
    if descent is None:
        descent = optax.sgd(optax.cosine_decay_schedule(0.3, max(steps, 1), 0.1), momentum=0.6, nesterov=True)

    @jax.jit
    def descend(directions, unit, gradient, memory, y):
        # optax's schedules mix integers and floats, which a strict user's settings would refuse.
        with jax.numpy_dtype_promotion("standard"):
            updates, memory = descent.update(directions.T @ gradient / unit, memory, y)
        return unit * directions @ updates, y + updates, memory

    p = start.x.shape[0]
    # What one step hands to the next: the way gone in the round coordinates, those coordinates, and their unit.
    y, directions, unit = jnp.zeros_like(start.x), jnp.eye(p, dtype=start.x.dtype), jnp.zeros((), start.x.dtype)
    memory = descent.init(y)
    chosen = "default"
    if checkpoint is not None and optimizer is not None:
        with jax.numpy_dtype_promotion("standard"):
            chosen = digest(jax.make_jaxpr(optimizer.update)(y, memory, y))
    file = Checkpoint(checkpoint, problem, method="gradient descent", optimizer=chosen, refresh=refresh)
    like = {"y": y, "directions": directions, "unit": unit, "memory": memory, "best": start}
    saved = file.read(point=start, history=0.0, **like)
    if saved is None:
        point, at = settle(problem, start)
        history, best = [at.cost], (point, at)
    else:
        point, (y, directions, unit, memory, _) = saved["point"], (saved[name] for name in like)
        history = [float(c) for c in saved["history"]]
        at, at_best = linearize(problem, point), linearize(problem, saved["best"])
        if at is None or at_best is None:
            raise ValueError(f"{checkpoint}: the residuals are not finite where this fit was left; delete the file.")
        best = saved["best"], at_best
    status = "steps"
    bar = tqdm(total=steps, initial=len(history) - 1, disable=not progress, desc="gradient descent")
    try:
        if callback:
            callback(point, at.cost)
        for i in range(len(history) - 1, steps):
            eliminated = eliminate(at.blocks, 0.0)
            if _is_minimum(at, eliminated, rtol):
                status = "converged"
                break
            if i % (refresh or steps) == 0:
                directions = _directions(eliminated, at.cost / problem.size[0] if refresh else None)
            gradient = _gradient(eliminated)
            unit = unit if unit > 0 else jnp.linalg.norm(directions.T @ gradient)
            step, y, memory = descend(directions, unit, gradient, memory, y)
            after = _guarded(problem, point, at, step, eliminated)
            if after is None:
                status = "stuck"
                break
            point, at = after
            history.append(at.cost)
            if at.cost < best[1].cost:
                best = point, at
            now = {"point": point, "y": y, "directions": directions, "unit": unit, "memory": memory, "best": best[0]}
            file.write(**now, history=np.array(history))
            if callback:
                callback(point, at.cost)
            bar.update()
            bar.set_postfix(cost=f"{at.cost:.6g}")
        settled = settle(problem, best[0], steps=3, rtol=1e-9)
        best = settled if settled[1].cost <= best[1].cost else best
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return Fit.of(problem, *best, history, status, "gradient descent")


def _gradient(eliminated: Eliminated) -> Array:
    """Of half the sum of squares, nuisance values following."""
    A, r = eliminated.rows
    return A.T @ r


def _directions(eliminated: Eliminated, variance: float | None) -> Array:
    """(A^T A)^(-1/2), (p, p): symmetric, so that momentum keeps its meaning when it is made anew."""
    A, _ = eliminated.rows
    if variance is None:
        return jnp.eye(A.shape[1], dtype=A.dtype) / jnp.linalg.norm(A)
    _, s, V = jnp.linalg.svd(A, full_matrices=False)
    # What the data do not tell may not run away: as if every parameter were known to about its scale.
    floor = jnp.maximum(variance**0.5, 1e-6 * s[0]) + jnp.finfo(s.dtype).tiny
    return (V.T / jnp.sqrt(s**2 + floor**2)[None, :]) @ V


def _is_minimum(at: Linearization, eliminated: Eliminated, rtol: float) -> bool:
    """Whether the linearized problem promises to lower the cost by less than `rtol` of it."""
    return at.cost - float(eliminated.step(1e-9)[1]) <= max(rtol * at.cost, 1e-12)


def _guarded(problem: Problem, point: Point, at: Linearization, step: Array, eliminated: Eliminated):
    """Where a step leads, halved until it can be simulated; None where even a thousandth cannot."""
    for _ in range(12):
        tried = moved(point, step, eliminated)
        there = linearize(problem, tried)
        if there is not None and usable(there) and there.cost <= 4 * at.cost:
            return tried, there
        step = step / 2
        # The nuisance values' own step may be what fails.
        eliminated = eliminate(at.blocks, 1e-2)
    return None
