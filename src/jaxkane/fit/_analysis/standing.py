"""Where a search among candidates is: a minimum, and its linearization by parameters. Knows problems; fits nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._problem.blocks import Blocks, eliminate
from .._problem.linearization import Linearization, linearize
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.covariance import slopes_of, values_of
from .._result.result import Fit
from .extended import carried
from .score import Rows

Folds = Sequence[Sequence[int]] | None


@dataclasses.dataclass(frozen=True)
class Standing:
    """Where a search stands: at a minimum of a problem of whose parameters `names` are free, the others held. `rows`
    is its linearization there, in the columns of all its parameters; `freedom`: residuals less unknowns."""

    problem: Problem
    point: Unknowns
    names: tuple[str, ...]
    cost: float
    freedom: int
    correlation: float
    rows: Rows

    @classmethod
    def of(cls, fit: Fit) -> Standing:
        problem, at = fit.problem, fit.linearization
        if np.any(np.isfinite(np.asarray(fit.parameters.prior_deviation))):
            again = linearize(without_priors(problem), fit.point)
            assert again is not None
            at = again
        n_r, n_unknown = problem.size
        rows = rows_of(problem, at, fit.point, range(fit.point.b.shape[1]))
        return cls(problem, fit.point, fit.names, fit.cost, n_r - n_unknown, fit.autocorrelation, rows)

    @property
    def places(self) -> list[int]:
        return [self.problem.parameters.names.index(name) for name in self.names]

    @property
    def values(self) -> dict[str, float]:
        values = np.asarray(values_of(self.problem.parameters, self.point.x))
        return {name: float(values[i]) for name, i in zip(self.names, self.places, strict=True)}

    def left_out(self, folds: Folds) -> float:
        """The sum of squares of trials left out in turn, with the parameters that the others say; NaN without folds."""
        return self.rows.left_out(self.places, folds) if folds is not None else float("nan")

    def carried_to(self, problem: Problem) -> Unknowns:
        """The same point of a problem that has all these unknowns, and others."""
        return carried(self.problem, self.point, problem, self.names)


def without_priors(problem: Problem) -> Problem:
    """The same without priors of parameters; nothing is compiled anew."""
    return problem.with_priors(dict.fromkeys(problem.parameters.names, (0.0, float("inf"))))


def rows_of(problem: Problem, at: Linearization, point: Unknowns, b: Sequence[int]) -> Rows:
    """A linearization without priors, starts and these unknowns of trials eliminated, the others held."""
    blocks, parameters = at.blocks, problem.parameters
    first = blocks.n_z + blocks.n_next
    kept = [*range(first), *(first + i for i in b), *range(first + blocks.n_b, blocks.R.shape[-1])]
    R = blocks.R[:, :, jnp.asarray(kept, dtype=jnp.int32)]
    reduced = Blocks(R, blocks.windows, blocks.n_z, blocks.n_next, len(list(b)))
    deviation, norms = np.asarray(parameters.prior_deviation, float)[:, None], np.asarray(blocks.column_norms, float)
    slopes, off = np.asarray(slopes_of(parameters, point.x)), np.asarray(parameters.prior_residuals(point.x))
    return Rows(np.asarray(eliminate(reduced, 0.0).R, float), np.column_stack([slopes / deviation, off]), norms)
