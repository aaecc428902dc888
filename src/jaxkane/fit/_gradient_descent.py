"""Gradient descent by optax on the parameters, the nuisance values following by variable projection."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array
from tqdm import tqdm

from ._blocks import Eliminated, eliminate
from ._problem import Linearization, Point, Problem, linearize
from ._result import Fit
from ._steps import moved, settle, usable


def gradient_descent(
    problem: Problem,
    *,
    steps: int = 100,
    optimizer: optax.GradientTransformation | None = None,
    learning_rate: float | optax.Schedule | None = None,
    precondition: bool = True,
    start: Point | None = None,
    progress: bool = False,
) -> Fit:
    """Minimize half the sum of squares by gradient descent.

        minimize over x  1/2 min over z, b of |residual(x, z, b)|^2

    The unknown starts z and biases b are re-solved to first order in every step (variable projection), so the gradient
    is that of the best fit with given parameters. The descent runs in coordinates in which the sensitivity at the start
    is round and the way to go about one: a step has the same meaning for every parameter, however differently the
    data know them.

    **Arguments:**

    - `steps`: how many. `optimizer`: any optax optimizer; by default Adam with `learning_rate`.
    - `learning_rate`: a number or an optax schedule; by default a cosine that falls from 0.1 to 0 over `steps`.
    - `precondition`: False for the plainly scaled parameters (`Free.scale`) instead of the round coordinates.
    - `start`: a `Point` to go on from, such as `fit.point`. `progress`: show a progress bar.

    A step whose simulation fails, or which multiplies the cost, is halved until it does not.

    **Returns:** a `Fit` at the best point seen, with the history of the cost; after an interruption (Ctrl-C) too, and
    `status` says so.

    **Raises:** `ValueError` where a window cannot be simulated with the first guess.
    """
    point, at = settle(problem, problem.start if start is None else start)
    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(0.1, steps) if learning_rate is None else learning_rate)
    elif learning_rate is not None:
        raise ValueError("`learning_rate` belongs to the default optimizer: give it to your own `optimizer` instead.")
    directions, unit = _coordinates(at, precondition)  # x = x0 + directions @ y

    @jax.jit
    def descend(gradient, memory, y):
        updates, memory = optimizer.update(directions.T @ gradient / unit**2, memory, y)
        return directions @ updates, y + updates, memory

    y = jnp.zeros(directions.shape[1], point.x.dtype)
    memory = optimizer.init(y)
    history, best, status = [at.cost], (point, at), "steps"
    bar = tqdm(total=steps, disable=not progress, desc="gradient descent")
    try:
        for _ in range(steps):
            eliminated = eliminate(at.blocks, 0.0)
            step, y, memory = descend(_gradient(eliminated), memory, y)
            after = _guarded(problem, point, at, step, eliminated)
            if after is None:
                status = "stuck"
                break
            point, at = after
            history.append(at.cost)
            if at.cost < best[1].cost:
                best = point, at
            bar.update()
            bar.set_postfix(cost=f"{at.cost:.6g}")
        point, at = settle(problem, best[0], steps=3, rtol=1e-9)
        best = (point, at) if at.cost <= best[1].cost else best
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    if status == "steps" and _is_minimum(best[1]):
        status = "converged"
    return Fit.of(problem, *best, history, status, "gradient descent")


def _gradient(eliminated: Eliminated) -> Array:
    """Of half the sum of squares, nuisance values following."""
    A, r = eliminated.rows
    return A.T @ r


def _coordinates(at: Linearization, precondition: bool) -> tuple[Array, float]:
    """Directions (p, p) in which the sensitivity is round, and their unit: how far the minimum seems to be."""
    eliminated = eliminate(at.blocks, 0.0)
    A, r = eliminated.rows
    p = A.shape[1]
    directions = jnp.eye(p, dtype=A.dtype)
    if precondition:
        _, s, V = jnp.linalg.svd(A, full_matrices=False)
        # What the data do not tell may not run away: as if every parameter were known to about its scale.
        floor = jnp.maximum(jnp.sqrt(jnp.mean(r**2)), 1e-6 * s[0]) + jnp.finfo(s.dtype).tiny
        directions = V.T / jnp.sqrt(s**2 + floor**2)
        unit = float(jnp.linalg.norm(directions.T @ A.T @ r))
        return directions * max(unit, 1e-12), max(unit, 1e-12)
    gradient = _gradient(eliminated)
    return directions, max(float(jnp.linalg.norm(gradient)) ** 0.5, 1e-12)


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


def _is_minimum(at: Linearization) -> bool:
    """Whether a Gauss-Newton step promises nothing worth a hundredth of a standard error."""
    eliminated = eliminate(at.blocks, 0.0)
    _, promised = eliminated.step(1e-9)
    return at.cost - float(promised) <= 1e-5 * at.cost
