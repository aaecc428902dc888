"""Derivatives of optimal motions by parameters of the mechanism, from the KKT matrix of the nonlinear program.

At a solution, the gradient of the Lagrangian and the active constraints are zero. Their derivatives by a parameter are
therefore zero too, which are linear equations for the derivatives of the variables and of the multipliers. The matrix of
these equations is the KKT matrix. The derivative of the least cost is the partial derivative of the Lagrangian.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._collocate.functions import Variables
from .._collocate.solvers import Solution, response
from .._collocate.transcription import Transcription
from .._common.lookup import not_there
from .._system.system import System
from ..fit.problem.specification import parameters_of


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """Derivatives of an optimal motion by one parameter: `sensitivity["roll"]` (K,) is that of any state or control.

    A node is a fraction of the duration: if the duration is free, the times of the nodes change too. A derivative that
    does not exist, or is not unique, is NaN.

    Attributes:

    - `cost`, `duration`: derivatives of the least cost and of its duration.
    - `estimates`: those of the free parameters of the problem, by name.
    - `reason`: why derivatives are NaN, as a sentence; "" if there are all.
    - `values` (K,): those of states and controls at the nodes, by name.
    """

    cost: float
    duration: float
    estimates: dict[str, float]
    reason: str
    values: dict[str, Float[np.ndarray, " K"]] = dataclasses.field(repr=False)

    def __getitem__(self, name: str) -> Float[np.ndarray, " K"]:
        if name not in self.values:
            raise not_there(name, self.values, "the sensitivity")
        return self.values[name]


def sensitivities_of(transcription: Transcription, solution: Solution, free: Any) -> dict[str, Sensitivity]:
    """See `Plan.sensitivities`."""
    layouts, own = transcription.layouts, transcription.parameters
    entries = {layout.problem.title: _entries(layout.problem.system, free) for layout in layouts}
    names = [*next(iter(entries.values()))]
    if both := {*names} & {*(() if own is None else own.names)}:
        raise ValueError(
            f"Plan.sensitivities: {', '.join(sorted(both))} is `free` in the problem: the least cost does not depend on "
            "its initial guess. Name other parameters."
        )
    tangents = []
    for layout in layouts:
        targets = _entries(layout.problem.system, free)
        tangents.append(tangent_of(layout.problem.system, [targets[name] for name in names]))
    cost, x, reason = derivatives_of(transcription, solution, tangents)
    theta = x[:, transcription.shared_parameters]
    values = None if own is None else np.asarray(jax.jacfwd(own.values)(jnp.asarray(transcription.theta(solution.z))))
    found = {}
    for k, name in enumerate(names):
        at = [
            (f"phase {p}: {each}" if len(layouts) > 1 else each, x[k, places])
            for p, layout in enumerate(layouts)
            for each, places in layout.by_name.items()
            if each != "duration"
        ]
        durations = [x[k, layout.duration] for layout in layouts if layout.duration is not None]
        estimates = {} if own is None else dict(zip(own.names, map(float, values @ theta[k]), strict=True))
        found[name] = Sensitivity(float(cost[k]), float(sum(durations)), estimates, reason, dict(at))
    return found


def _entries(system: System, free: Any) -> dict[str, Any]:
    parameters = parameters_of(system, free)
    if wrong := [e.name for e in parameters.entries if not e.targets]:
        raise ValueError(f"Plan.sensitivities: {', '.join(wrong)} is not a parameter of {type(system).__name__}.")
    return {e.name: e.targets for e in parameters.entries}


def tangent_of(system: System, directions: Sequence[Any]) -> System:
    """The arrays of a system with a leading axis p: its changes along directions (leaf, entry, factor)."""
    leaves, structure = jax.tree.flatten(system)
    changes = [np.zeros((len(directions), np.size(leaf))) for leaf in leaves]
    for k, targets in enumerate(directions):
        for leaf, entry, factor in targets:
            changes[leaf][k, entry] += factor
    arrays = [
        jnp.asarray(change.reshape(-1, *np.shape(leaf))) if eqx.is_inexact_array(leaf) else None
        for leaf, change in zip(leaves, changes, strict=True)
    ]
    return jax.tree.unflatten(structure, arrays)


def derivatives_of(
    transcription: Transcription, solution: Solution, tangents: Sequence[System]
) -> tuple[np.ndarray, np.ndarray, str]:
    """The derivatives of the cost (p,) and of the variables (p, n) along changes of the systems of all phases. Those
    that do not exist are NaN. A sentence states why."""
    program, layouts = transcription.program, transcription.layouts
    by_system = {id(layout.variables.system): t for layout, t in zip(layouts, tangents, strict=True)}
    p = len(jax.tree.leaves(tangents)[0])

    def tangent(part: Any) -> Any:
        zeros = jax.tree.map(lambda a: jnp.zeros((p, *a.shape)), eqx.filter(part, eqx.is_inexact_array))
        return dataclasses.replace(zeros, system=by_system[id(part.system)]) if isinstance(part, Variables) else zeros

    along = [jax.tree.map(tangent, f, is_leaf=lambda v: isinstance(v, Variables)) for f in program.functions]
    lagrangian, gradient, g = program.along(solution.z, solution.multipliers, along)
    found = response(program, solution, gradient, g)
    cost, x, reason = lagrangian * program.f_scale, found.z * transcription.x_scale, ""
    if found.unmet_rows.any():
        cost, name = cost * np.nan, _name(transcription, found.unmet_rows, is_row=True)
        reason = f"fixed values satisfy {name} for the present parameters only: leave one of them out"
    elif found.undetermined.any():
        name = _name(transcription, found.undetermined)
        reason = f"the KKT matrix is singular: the least cost does not determine {name}. Add a small cost of it"
    elif found.weak_variables.any() or found.weak_rows.any():
        name = _name(
            transcription, *([found.weak_variables] if found.weak_variables.any() else [found.weak_rows, True])
        )
        reason = f"{name} is at its bound with a multiplier of zero, where the derivatives to both sides differ"
    return cost, x * np.nan if reason else x, reason


def _name(transcription: Transcription, which: np.ndarray, is_row: bool = False) -> str:
    """The name, and the time, of the first of the marked variables or constraints."""
    i = int(np.argmax(which))
    if is_row:
        return next((row.name for row in transcription.rows if i in row.rows), "a constraint")
    for layout in transcription.layouts:
        for name, at in layout.by_name.items():
            if i in at:
                k = int(np.argmax(at == i))
                return name if len(at) == 1 else f"{name!r} at {layout.s[k]:.3g} of the duration"
    return "a free parameter"
