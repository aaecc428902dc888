"""Whether the sign of an input or a channel is wrong, by trying the other one. Knows least squares."""

from __future__ import annotations

import dataclasses

import equinox as eqx

from .._data.windows import Windows
from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.steps import solve_nuisance, uninterrupted
from .._result.notes import bad_channels
from .._result.result import Fit


def contrary_signs(fit: Fit) -> tuple[str, ...]:
    """Inputs and channels with which the opposite sign would fit much better, in words.

    Where a channel fits badly (`Fit.notes` says so), each sign is turned round in turn and a few steps of a fit are
    made; where none does, nothing is tried.
    """
    if not bad_channels(fit):
        return ()
    notes, problem = [], fit.problem
    for i, name in enumerate(problem.system.inputs):
        if name not in problem.model.driven:
            continue
        flipped = problem.windows.inputs.at[:, i].multiply(-1.0)
        notes += _if_better(fit, eqx.tree_at(lambda w: w.inputs, problem.windows, flipped), f"the input {name}")
    for c, channel in enumerate(problem.channels):
        flipped = problem.windows.measured.at[:, c].multiply(-1.0)
        notes += _if_better(fit, eqx.tree_at(lambda w: w.measured, problem.windows, flipped), channel)
    return tuple(notes)


def _if_better(fit: Fit, windows: Windows, what: str) -> list[str]:
    problem = dataclasses.replace(fit.problem, windows=windows)
    try:
        # From both ends: a fit to the wrong sign may have led the parameters far away.
        costs = [solve_nuisance(problem, point, steps=4)[1].cost for point in (fit.point, problem.start)]
        if min(costs) > 0.5 * fit.cost:
            costs = [uninterrupted(minimize(problem, LeastSquares(rtol=1e-2), steps=4)).cost]
    except ValueError:
        return []
    if min(costs) < 0.5 * fit.cost:
        return [f"{what} seems to have the wrong sign: turned round, the sum of squares is below {min(costs):.4g}."]
    return []
