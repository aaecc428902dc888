"""A problem at a point: residuals, cost, and their exact derivatives. Knows programs of windows; knows no optimizer."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .blocks import Blocks
from .model import Seen, Unknowns
from .parallel import blocks_of_all, costs_of_all
from .programs import blocks_of, costs_of, starts_of

if TYPE_CHECKING:
    from .problem import Problem


class Linearization(eqx.Module):
    """A problem at a point: its blocks, and what was seen of every window."""

    blocks: Blocks
    seen: Seen

    @property
    def simulated(self) -> Array:
        """(W, n_c, n_t)."""
        return self.seen.simulated

    @property
    def status(self) -> Array:
        """Of every window (W,)."""
        return self.seen.status

    @property
    def cost(self) -> float:
        """Sum of squares, with process noise minus twice the log likelihood; NaN or infinite where a window could not
        be simulated."""
        return float(self.blocks.cost if self.seen.value is None else jnp.sum(self.seen.value))

    @property
    def costs(self) -> np.ndarray:
        """The part of every window (W,) in the cost; infinite where it is not `good`."""
        own = jnp.sum(self.blocks.R[:, :, -1] ** 2, axis=1) if self.seen.value is None else self.seen.value
        return np.where(self.good, np.asarray(own), np.inf)

    @property
    def squares(self) -> float:
        """The rows' sum of squares: what relative tolerances refer to, and what promises are counted from. It is the
        cost, but with process noise about twice the number of measurements, where the cost may have any sign."""
        return float(self.blocks.cost)

    @property
    def good(self) -> np.ndarray:
        """Whether a window (W,) has finite residuals and derivatives."""
        return np.all(np.isfinite(np.asarray(self.blocks.R)), axis=(1, 2))


def linearize(problem: Problem, point: Unknowns) -> Linearization | None:
    """Residuals and their exact derivatives, by forward mode through the simulation; None where no start is found."""
    found = _starts(problem, point)
    if found is None:
        return None
    blocks: Any = blocks_of_all if problem.processes else blocks_of
    return Linearization(*blocks(problem.model, problem.windows, problem.by_trial, point, *found))


def cost(problem: Problem, point: Unknowns) -> float:
    """Sum of squares, with process noise minus twice the log likelihood, without derivatives; NaN or infinite where a
    window could not be simulated."""
    found = _starts(problem, point)
    if found is None:
        return float("nan")
    return float(jnp.sum(_costs(problem, point, found[0])[0]))


def simulated(problem: Problem, point: Unknowns) -> np.ndarray:
    """What the sensors would have measured (W, n_c, n_t), with process noise followed by its deviations (W, 2 n_c,
    n_t); NaN where that cannot be simulated."""
    found = _starts(problem, point)
    if found is None:
        several = 1 if problem.model.noise is None else 2
        return np.full(np.tile(problem.windows.measured, (1, several, 1)).shape, np.nan)
    return all_of(_costs(problem, point, found[0])[1])


def all_of(seen: Seen) -> np.ndarray:
    """Simulated measurements and their deviations, as `simulated` gives them."""
    parts = [x for x in (seen.simulated, seen.deviation) if x is not None]
    return np.concatenate(parts, axis=1)


def without_start(problem: Problem, point: Unknowns) -> np.ndarray:
    """Whether the constraints can be met nowhere near the start of a window (W,)."""
    missing = []
    for i in range(len(problem.places)):
        windows, z = jax.tree.map(lambda x, i=i: x[i : i + 1], (problem.windows, point.z))
        alone = dataclasses.replace(problem, windows=windows)
        missing.append(_starts(alone, Unknowns(point.x, point.b, z)) is None)
    return np.array(missing)


def _costs(problem: Problem, point: Unknowns, starts: Array) -> tuple[Array, Seen]:
    return (costs_of_all if problem.processes else costs_of)(problem.model, problem.windows, point, starts)


def _starts(problem: Problem, point: Unknowns) -> tuple[Array, Array] | None:
    try:
        return starts_of(problem.model, problem.windows, point)
    except eqx.EquinoxRuntimeError:  # Newton's linear solver raises on what is not finite
        return None
