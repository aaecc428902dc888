"""Gradient descent by optax on the parameters, the nuisance values following by variable projection."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from ..._common.digest import digest
from .._problem.blocks import Eliminated, eliminate
from .._problem.linearization import Linearization, linearize
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .optimizer import Iterate, Optimizer
from .steps import moved, solve_nuisance, usable


class Memory(eqx.Module):
    """Between two steps: the displacement in the whitened coordinates, those coordinates, their unit, and optax's
    state."""

    y: Float[Array, " p"]
    directions: Float[Array, "p p"]
    unit: Float[Array, ""]
    of_optax: Any


@dataclasses.dataclass(frozen=True)
class GradientDescent(Optimizer):
    """Gradient descent on half the sum of squares.

        minimize over x  1/2 min over z, b of |residual(x, z, b)|^2

    The unknown starts z and biases b are re-solved to first order in every step (variable projection), so the
    gradient is that of the best fit with given parameters. The descent runs in whitened coordinates y, in which A^T A
    = 1 for the sensitivity A, x = x0 + (A^T A)^(-1/2) y: a step means the same for every parameter, however well it is
    known.

    A step whose simulation fails, or which multiplies the cost, is halved until it does not.

    **Arguments:**

    - `transform`: any optax optimizer, with its schedule; by default Nesterov's descent at a rate of 0.3 that falls
        along a cosine over all steps. The unit of y is the way that there seems to be to go, so rates about 0.1 suit
        Adam.
    - `refresh`: how many steps until the coordinates are whitened anew; None for the plainly scaled parameters
        (`Free.scale`) throughout.
    - `rtol`: stop when the linearized problem promises less than this part of the cost.
    """

    steps: ClassVar[int] = 100
    transform: optax.GradientTransformation | None = None
    refresh: int | None = 10
    rtol: float = 1e-6

    @property
    def name(self) -> str:
        return "gradient descent"

    def depends_on(self, problem: Problem, steps: int) -> dict[str, Any]:
        found: dict[str, Any] = {"refresh": self.refresh}
        if self.transform is None:
            return {**found, "optimizer": "default", "steps of its schedule": steps}
        y = jnp.zeros_like(problem.start.x)
        with jax.numpy_dtype_promotion("standard"):
            program = jax.make_jaxpr(self.transform.update)(y, self.transform.init(y), y)
        return {**found, "optimizer": digest(program)}

    def for_steps(self, steps: int) -> GradientDescent:
        if self.transform is not None:
            return self
        rate = optax.cosine_decay_schedule(0.3, max(steps, 1), 0.1)
        return dataclasses.replace(self, transform=optax.sgd(rate, momentum=0.6, nesterov=True))

    def begin(self, problem: Problem, point: Unknowns, at: Linearization) -> Memory:
        assert self.transform is not None
        y, p = jnp.zeros_like(point.x), point.x.shape[0]
        return Memory(y, jnp.eye(p, dtype=y.dtype), jnp.zeros((), y.dtype), self.transform.init(y))

    def step(self, problem: Problem, now: Iterate, taken: int) -> Iterate | str:
        at, memory = now.at, now.memory
        assert at is not None
        assert self.transform is not None
        eliminated = eliminate(at.blocks, 0.0)
        if _is_minimum(at, eliminated, self.rtol):
            return "converged"
        directions, unit, gradient = memory.directions, memory.unit, _gradient(eliminated)
        if taken == 0 or (self.refresh and taken % self.refresh == 0):
            directions = _directions(eliminated, at.squares / problem.size[0] if self.refresh else None)
        unit = unit if unit > 0 else jnp.linalg.norm(directions.T @ gradient)
        step, y, of_optax = _descend(self.transform)(directions, unit, gradient, memory.of_optax, memory.y)
        after = _guarded(problem, now.point, at, step, eliminated)
        if after is None:
            return "stuck"
        point, there = after
        return Iterate(point, there.cost, there, Memory(y, directions, unit, of_optax))

    def after(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        point, at = solve_nuisance(problem, best.point, steps=3, rtol=1e-9)
        return (Iterate(point, at.cost, at, best.memory) if at.cost <= best.cost else best), status


@functools.lru_cache(maxsize=16)
def _descend(transform: optax.GradientTransformation) -> Callable[..., tuple[Array, Array, Any]]:
    """optax's step: of the parameters, of the whitened coordinates, and its next state."""

    @jax.jit
    def descend(directions, unit, gradient, of_optax, y):
        # optax's schedules mix integers and floats, which a strict user's settings would refuse.
        with jax.numpy_dtype_promotion("standard"):
            updates, of_optax = transform.update(directions.T @ gradient / unit, of_optax, y)
        return unit * directions @ updates, y + updates, of_optax

    return descend


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
    # What the data do not determine may not run away: as if every parameter were known to about its scale.
    floor = jnp.maximum(variance**0.5, 1e-6 * s[0]) + jnp.finfo(s.dtype).tiny
    return (V.T / jnp.sqrt(s**2 + floor**2)[None, :]) @ V


def _is_minimum(at: Linearization, eliminated: Eliminated, rtol: float) -> bool:
    """Whether the linearized problem promises to lower the cost by less than `rtol` of it."""
    return at.squares - float(eliminated.step(1e-9)[1]) <= max(rtol * at.squares, 1e-12)


def _guarded(problem: Problem, point: Unknowns, at: Linearization, step: Array, eliminated: Eliminated):
    """Where a step leads, halved until it can be simulated; None where even a thousandth cannot."""
    for _ in range(12):
        tried = moved(point, step, eliminated)
        there = linearize(problem, tried)
        if there is not None and usable(there) and there.cost <= at.cost + 3 * at.squares:
            return tried, there
        step = step / 2
        # The nuisance values' own step may be what fails.
        eliminated = eliminate(at.blocks, 1e-2)
    return None
