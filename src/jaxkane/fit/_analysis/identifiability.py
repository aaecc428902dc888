"""What data will determine, before anything is fitted to them or measured. Knows how to find the nuisance values."""

from __future__ import annotations

from .._optimize.steps import solve_nuisance
from .._problem.arguments import refuse_other
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.identifiability import Identifiability, identifiability_at


def identifiability(problem: Problem, *, flat: float = 0.5, at: Unknowns | None = None) -> Identifiability:
    """Which parameters, or combinations of them, the data determine if their noise is as `sigma` says, whatever they
    are: a plan with simulated measurements will do. Of a `Fit`, `fit.identifiability` says it by the residuals left.

        identifiability(Problem.of(system, trials, free, unknown=("roll",)))

    The residuals' sensitivity to the scaled parameters, with the nuisance values eliminated, is taken apart by singular
    values. A direction whose standard deviation exceeds `flat` of the parameters' scale is called undetermined.

    **Arguments:**

    - `problem`: a `Problem`.
    - `flat`: where undetermined begins. `at`: a point of the problem; by default its start. The nuisance values are
        found for it.

    **Returns:** an `Identifiability`; print it for a table.

    **Raises:** `ValueError` that names a window which cannot be simulated to its end.
    """
    refuse_other(problem, Problem, "identifiability", "identifiability(fit.problem), or fit.identifiability")
    point, linearization = solve_nuisance(problem, problem.start if at is None else at)
    return identifiability_at(problem, point, linearization, flat, given=True)
