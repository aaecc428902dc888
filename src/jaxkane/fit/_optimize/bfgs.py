"""BFGS by optimistix, on all unknowns at once."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..._scalars.versions import compiled
from .._problem.blocks import eliminate
from .._problem.density import half_cost
from .._problem.linearization import Linearization, cost, linearize
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .optimizer import Iterate, Optimizer
from .steps import usable


class Memory(eqx.Module):
    """The unknowns are origin + unit * y; `of_optimistix` is its solver's state, which is `done`, with or without
    success."""

    origin: Unknowns
    unit: Unknowns
    y: Float[Array, " n"]
    of_optimistix: Any
    done: Bool[Array, ""]
    success: Bool[Array, ""]


@dataclasses.dataclass(frozen=True)
class BFGS(Optimizer):
    """BFGS on half the sum of squares, or another of optimistix's minimisers.

    Parameters, starts and biases are moved together, each in the unit in which the cost is equally curved at the start.
    It knows nothing of squares or blocks and takes many more steps than `LeastSquares`, which is to be preferred: this
    one is for comparison, and for costs that are no sums of squares.

    **Arguments:** `rtol`: stop where a step changes the cost and the unknowns by less than this part. `solver`: by
    default `optimistix.BFGS(rtol, rtol)`.
    """

    steps: ClassVar[int] = 300
    rtol: float = 1e-6
    solver: optx.AbstractMinimiser | None = None

    @property
    def name(self) -> str:
        return type(self._solver).__name__

    @property
    def _solver(self) -> optx.AbstractMinimiser:
        return optx.BFGS(rtol=self.rtol, atol=self.rtol) if self.solver is None else self.solver

    def depends_on(self, problem: Problem, steps: int) -> dict[str, Any]:
        return {"solver": repr(self._solver)}

    def begin(self, problem: Problem, point: Unknowns, at: Linearization) -> Memory:
        squares = jnp.sum(at.blocks.R**2, axis=(0, 1))
        n_z, n_x, n_b = at.blocks.n_z, at.blocks.n_x, at.blocks.n_b
        # Of each kind of unknown the mean curvature: what has no influence keeps a unit of its own.
        kinds = Unknowns(
            x=squares[-1 - n_x : -1],
            b=squares[-1 - n_x - n_b : -1 - n_x] / len(problem.trials),
            z=squares[:n_z] / len(problem.places),
        )
        unit = jax.tree.map(
            lambda u, c: jnp.broadcast_to(jnp.where(c > 0, jax.lax.rsqrt(c), 1.0), u.shape), point, kinds
        )
        y = jnp.zeros_like(ravel_pytree(point)[0])
        state = _begun(problem.model, problem.windows, problem.by_trial, self._solver, point, unit, y)
        return Memory(point, unit, y, state, jnp.asarray(False), jnp.asarray(True))

    def step(self, problem: Problem, now: Iterate, taken: int) -> Iterate | str:
        # One step at a time, so that after Ctrl-C the best so far is known: a running program cannot be interrupted.
        if now.memory.done:
            return "converged" if now.memory.success else "stuck"
        memory = _step(problem.model, problem.windows, problem.by_trial, self._solver, now.memory)
        point = _unknowns(memory.origin, memory.unit, memory.y)
        return Iterate(point, cost(problem, point), None, memory)

    def after(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        at = linearize(problem, best.point) if best.at is None else best.at
        if at is None or not usable(at):
            return best, status
        to_gain = at.squares - float(eliminate(at.blocks, 0.0).step(1e-9)[1])
        if status == "converged" and to_gain > 0.01 * at.squares:
            # Steps also become short before what cannot be simulated: no minimum while others would lower the cost.
            status = "stuck"
        return dataclasses.replace(best, cost=at.cost, at=at), status


@compiled
def _begun(model, windows, by_trial, solver, origin, unit, y):
    f = _of_round_unknowns(half_cost(model, windows, by_trial), origin, unit)
    return _of_strong_types(solver.init(f, y, None, {}, *jax.eval_shape(f, y, None), frozenset()))


@compiled
def _step(model, windows, by_trial, solver, memory):
    f = _of_round_unknowns(half_cost(model, windows, by_trial), memory.origin, memory.unit)
    y, state, _ = solver.step(f, memory.y, None, {}, memory.of_optimistix, frozenset())
    done, result = solver.terminate(f, y, None, {}, state, frozenset())
    success = result == optx.RESULTS.successful
    return _of_strong_types(Memory(memory.origin, memory.unit, y, state, done | ~success, success))


def _of_strong_types(memory):
    """As it comes back from a file, so that a fit that goes on does not compile its step anew."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype) if eqx.is_array(x) else x, memory)


def _of_round_unknowns(f, origin, unit):
    return lambda y, _: (f(_unknowns(origin, unit, y)), None)


def _unknowns(origin: Unknowns, unit: Unknowns, y: Array) -> Unknowns:
    flat, unravel = ravel_pytree(origin)
    return unravel(flat + ravel_pytree(unit)[0] * y)
