"""Levenberg-Marquardt and Gauss-Newton with nuisance values eliminated block by block."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._common.real_numbers import real_number
from .._problem.blocks import eliminate
from .._problem.linearization import Linearization, linearize
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .minimize import minimize
from .optimizer import Iterate, Optimizer
from .steps import moved, refined, usable


@dataclasses.dataclass(frozen=True)
class LeastSquares(Optimizer):
    """Levenberg-Marquardt with exact Jacobians; with `damping=0` Gauss-Newton.

        (J^T J + damping^2 diag(J^T J)) d = -J^T r

    The nuisance values of windows and trials are eliminated first, so a step costs one simulation of every window with
    its own few derivatives. (A solver that does not know of the blocks, such as optimistix's, differentiates every
    window in the direction of every other window's unknowns: 31 windows with 190 unknowns, twenty times the work.)

    **Arguments:**

    - `rtol`: stop when a step promises to lower the cost by less than this part; or where no step lowers it, and what
        is promised is less than a tenth of a standard error is worth.
    - `damping`: at the start; it falls where the promise is kept, and rises where it is not. Gauss-Newton is the
        fastest where the initial guess is near; a step that fails is damped until it does not.
    - `horizons`: shares of every window, such as (0.25, 0.5), that are fitted before the whole: for initial guesses
        from which the end of a window cannot be reached.
    """

    steps: ClassVar[int] = 50
    rtol: float = 1e-6
    damping: float = 1e-3
    horizons: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for share in self.horizons:
            if not 0 < real_number(share, "LeastSquares: each of `horizons`") < 1:
                raise ValueError(f"LeastSquares: `horizons` are shares of a window, between 0 and 1; got {share}.")

    @property
    def name(self) -> str:
        return "Levenberg-Marquardt" if self.damping else "Gauss-Newton"

    def before(self, problem: Problem, point: Unknowns, steps: int) -> Unknowns:
        for share in self.horizons:
            coarse = dataclasses.replace(self, rtol=1e-3, horizons=())
            point = minimize(_part(problem, share), coarse, steps=steps, start=point).point
        return point

    def without_preparation(self) -> LeastSquares:
        return dataclasses.replace(self, horizons=())

    def begin(self, problem: Problem, point: Unknowns, at: Linearization) -> Array:
        return jnp.asarray(self.damping, point.x.dtype)

    def step(self, problem: Problem, now: Iterate, taken: int) -> Iterate | str:
        """A step that is refused leaves the point and raises the damping."""
        damping, at = float(now.memory), now.at
        assert at is not None
        eliminated = eliminate(at.blocks, damping)
        x, promised = eliminated.step(damping)
        gain = at.squares - float(promised)
        # What is left of a cost that vanishes is rounding: a millionth of a standard error.
        if gain <= max(self.rtol * at.squares, 1e-12) and damping <= 1e-2:
            return "converged"
        if gain <= 0:  # all that a damped step promises is lost in rounding
            return "stuck"
        tried = moved(now.point, x, eliminated)
        there = linearize(problem, tried)
        if there is not None and usable(there) and there.cost >= at.cost:
            # Often only the nuisance values, which went along a straight line, are not yet where they belong.
            tried, there = refined(problem, tried, there, 3, self.rtol, enough=at.cost - 0.5 * gain)
        if there is not None and usable(there) and there.cost < at.cost:
            ratio = (at.cost - there.cost) / gain
            # Nielsen's rule: trust more where the promise was kept.
            damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)
            return Iterate(tried, there.cost, there, jnp.asarray(damping, x.dtype))
        if _is_refined(problem, at):
            return "converged"
        damping = max(5 * damping, 1e-3)
        return dataclasses.replace(now, memory=jnp.asarray(damping, x.dtype)) if damping <= 1e8 else "stuck"


def _is_refined(problem: Problem, at: Linearization) -> bool:
    """Whether an undamped step promises no more than a tenth of a standard error is worth. Where such a step is
    refused, errors of integration, which are no smooth function of the unknowns, hide what is left to gain."""
    n_r, n_unknown = problem.size
    known = problem.model.noise is not None or n_r <= n_unknown
    variance = 1.0 if known else at.squares / (n_r - n_unknown)
    return at.squares - float(eliminate(at.blocks, 0.0).step(0.0)[1]) <= 0.01 * variance


def _part(problem: Problem, share: float) -> Problem:
    """The first part of every window."""
    return problem.shortened(np.array([max(2, round(share * n)) for _, _, n in problem.places]))
