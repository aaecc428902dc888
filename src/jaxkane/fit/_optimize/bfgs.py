"""BFGS by optimistix, on all unknowns at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from ..._scalars.reads import compiled
from .._problem.blocks import eliminate
from .._problem.density import half_cost
from .._problem.model import Point
from .._problem.problem import Problem, linearize
from .._result.result import Fit
from .steps import settle, usable


def bfgs(
    problem: Problem,
    *,
    steps: int = 300,
    rtol: float = 1e-6,
    solver: optx.AbstractMinimiser | None = None,
    start: Point | None = None,
) -> Fit:
    """Minimize half the sum of squares by BFGS, or by another of optimistix's minimisers.

    Parameters, starts and biases are moved together, each in the unit in which the cost is equally curved at the start.
    It knows nothing of squares or blocks and takes many more steps than `least_squares`, which is to be preferred: this
    one is for comparison, and for costs that are no sums of squares.

    **Arguments:** `steps`: at most. `rtol`: stop where a step changes the cost and the unknowns by less than this part.
    `solver`: by default `optimistix.BFGS`. `start`: a `Point`.

    **Returns:** a `Fit`, whose history is the cost at its two ends; after an interruption (Ctrl-C) the best so far, and
    `status` says so.

    **Raises:** `ValueError` where a window cannot be simulated with the first guess.
    """
    point, at = settle(problem, problem.start if start is None else start)
    squares = jnp.sum(at.blocks.R**2, axis=(0, 1))
    n_z, n_x = at.blocks.n_z, at.blocks.n_x
    # Of each kind of unknown the mean curvature: what has no influence keeps a unit of its own.
    kinds = Point(squares[-1 - n_x : -1], squares[-1 - n_x - at.blocks.n_b : -1 - n_x] / len(problem.trials),
                  squares[:n_z] / len(problem.places))  # fmt: skip
    units = jax.tree.map(lambda u, c: jnp.broadcast_to(jnp.where(c > 0, jax.lax.rsqrt(c), 1.0), u.shape), point, kinds)
    origin, unravel = ravel_pytree(point)
    unit, _ = ravel_pytree(units)
    solver = optx.BFGS(rtol=rtol, atol=rtol) if solver is None else solver
    cost = half_cost(problem)
    y, status, taken = jnp.zeros_like(origin), "steps", 0
    try:
        state = _begun(cost, solver, origin, unit, unravel, y)
        while taken < steps:
            y, state, done, sound = _step(cost, solver, origin, unit, unravel, y, state)
            taken += 1
            if done:
                status = "converged" if sound else "stuck"
                break
    except KeyboardInterrupt:
        status = "interrupted"
    end = unravel(origin + unit * y)
    there = linearize(problem, end)
    if not usable(there) or there is None or there.cost > at.cost:
        end, there, status = point, at, status if status == "interrupted" else "stuck"
    elif status == "converged" and there.cost - float(eliminate(there.blocks, 0.0).step(1e-9)[1]) > 0.01 * there.cost:
        # Steps also become short before what cannot be simulated: that is no minimum while others would lower the cost.
        status = "stuck"
    history = (at.cost, *np.full(max(taken - 1, 0), np.nan), there.cost)
    return Fit.of(problem, end, there, history, status, type(solver).__name__)


# One step at a time, so that Ctrl-C finds the best so far: within one program nothing could be told of it.


@compiled
def _begun(cost, solver, origin, unit, unravel, y):
    f = _of_round_unknowns(cost, origin, unit, unravel)
    return solver.init(f, y, None, {}, *jax.eval_shape(f, y, None), frozenset())


@compiled
def _step(cost, solver, origin, unit, unravel, y, state):
    """The unknowns and the state after a step, whether that was the last, and whether all is well with it."""
    f = _of_round_unknowns(cost, origin, unit, unravel)
    y, state, _ = solver.step(f, y, None, {}, state, frozenset())
    done, result = solver.terminate(f, y, None, {}, state, frozenset())
    return y, state, done | (result != optx.RESULTS.successful), result == optx.RESULTS.successful


def _of_round_unknowns(cost, origin, unit, unravel):
    return lambda y, _: (cost(unravel(origin + unit * y)), None)
