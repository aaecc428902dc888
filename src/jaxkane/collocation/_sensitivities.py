"""Derivatives of optimal motions by parameters of the mechanism.

At a solution, the gradient of the Lagrangian and the active constraints are zero, for all parameters. The KKT matrix
relates their derivatives to those of the variables and multipliers. The derivative of the least cost is the partial
derivative of the Lagrangian.
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
from .._collocate.solvers import UNMET, Solution, response
from .._collocate.transcription import Layout, Transcription
from .._common.lookup import not_there
from .._kane.constraint_residuals import configuration_residual
from .._system.system import System


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """Derivatives of an optimal motion by one parameter: `sensitivity["roll"]` (K,) is that of any state or control.

    A node is a fraction of the duration: if the duration is free, the times of the nodes change too. A derivative that
    does not exist is NaN.

    Attributes:

    - `cost`, `duration`: derivatives of the least cost and of its duration.
    - `estimates`: those of the free parameters of the problem, by name.
    - `reason`: why derivatives are NaN, as a sentence, or "".
    - `values` (K,): those of states and controls at the nodes, by name.
    """

    cost: float
    duration: float
    estimates: dict[str, float]
    reason: str
    values: dict[str, Float[np.ndarray, " K"]] = dataclasses.field(repr=False)

    def __getitem__(self, name: str) -> Float[np.ndarray, " K"]:
        if name not in self.values:
            raise not_there(name, self.values, "this sensitivity")
        return self.values[name]


def sensitivities_of(transcription: Transcription, solution: Solution, free: Any) -> dict[str, Sensitivity]:
    """See `Plan.sensitivities`."""
    if isinstance(free, list | tuple) and not free:
        raise ValueError("Plan.sensitivities: `free` names no parameter.")
    layouts, own, tangents, names = transcription.layouts, transcription.parameters, [], []
    for layout in layouts:
        problem: Any = layout.problem
        targets = {e.name: e.targets for e in dataclasses.replace(problem, free=free).parameters.entries}
        names = [*targets]
        tangents.append(tangents_of(layout.problem.system, [*targets.values()]))
    known: tuple[str, ...] = () if own is None else own.names
    if both := {*names} & {*known}:
        raise ValueError(f"Plan.sensitivities: {', '.join(sorted(both))} is already `free` in the problem.")
    cost, x, reason = derivatives_of(transcription, solution, tangents)
    theta = transcription.theta(solution.z * transcription.x_scale)
    slopes = np.zeros((0, 0)) if own is None else np.asarray(jax.jacfwd(own.values)(jnp.asarray(theta)))
    found = {}
    for k, name in enumerate(names):
        duration, values = 0.0, {}
        for p, layout in enumerate(layouts):
            values |= {f"phase {p}: " * (len(layouts) > 1) + name: x[k, at] for name, at in layout.by_name.items()}
            duration += 0.0 if layout.duration is None else x[k, layout.duration]
        estimates = dict(zip(known, map(float, slopes @ x[k, transcription.shared_parameters]), strict=True))
        found[name] = Sensitivity(float(cost[k]), float(duration), estimates, reason, values)
    return found


def tangents_of(system: System, directions: Sequence[Any]) -> System:
    """The arrays of a system with a leading axis p: its changes along directions of (leaf, entry, factor)."""
    leaves, structure = jax.tree.flatten(system)
    changes = [np.zeros((len(directions), np.size(leaf))) for leaf in leaves]
    for k, targets in enumerate(directions):
        for leaf, entry, factor in targets:
            changes[leaf][k, entry] = factor
    shaped = [jnp.asarray(x.reshape(-1, *np.shape(a))) for x, a in zip(changes, leaves, strict=True)]
    return eqx.filter(jax.tree.unflatten(structure, shaped), jax.tree.map(eqx.is_inexact_array, system))


def derivatives_of(
    transcription: Transcription, solution: Solution, tangents: Sequence[System]
) -> tuple[np.ndarray, np.ndarray, str]:
    """The derivatives of the cost (p,) and of the variables (p, n) along changes of the systems of all phases. Those
    that do not exist are NaN, and a sentence states why."""
    program, layouts = transcription.program, transcription.layouts
    of_system = {id(layout.variables.system): t for layout, t in zip(layouts, tangents, strict=True)}
    p = len(jax.tree.leaves(tangents)[0])

    def of(part: Any) -> Any:
        zeros = jax.tree.map(lambda a: jnp.zeros((p, *a.shape)), eqx.filter(part, eqx.is_inexact_array))
        return dataclasses.replace(zeros, system=of_system[id(part.system)]) if isinstance(part, Variables) else zeros

    def of_function(function: Any) -> Any:
        return jax.tree.map(of, function, is_leaf=lambda part: isinstance(part, Variables))

    lagrangian, gradient, g = program.along(solution.z, solution.multipliers, of_function)
    z, doubts = response(program, solution, gradient, g)
    cost, x = lagrangian * program.f_scale, z * transcription.x_scale
    for layout, t in zip(layouts, tangents, strict=True):
        if _moves_fixed_start(layout, t, solution.z * transcription.x_scale):
            return cost * np.nan, x * np.nan, UNMET.format("the configuration constraints at the start")
    for reason, (variables, rows) in doubts.items():
        if variables.any() or rows.any():
            where = _name(transcription, variables, rows)
            return cost * (np.nan if reason == UNMET else 1.0), x * np.nan, reason.format(where)
    return cost, x, ""


def _moves_fixed_start(layout: Layout, tangents: System, x: np.ndarray) -> bool:
    # If the start fixes all coordinates, the program does not contain the configuration constraints there.
    system, start = layout.problem.system, layout.problem.ends["start"]
    if not layout.problem.n_constraints or any(isinstance(start.get(c, ()), tuple) for c in system.coordinates):
        return False
    (arrays, rest), q = eqx.partition(system, eqx.is_inexact_array), jnp.asarray(x[layout.node(0)])

    def h(arrays: Any) -> Any:
        values = configuration_residual(eqx.combine(arrays, rest), jnp.zeros(()), q[: len(system.coordinates)])
        return jnp.stack([*values])

    return bool(np.any(np.abs(jax.vmap(lambda t: jax.jvp(h, (arrays,), (t,))[1])(tangents)) > 1e-9))


def _name(transcription: Transcription, variables: np.ndarray, rows: np.ndarray) -> str:
    """The name of the variable with the largest mark, and its place, or of the first marked constraint."""
    if not variables.any():
        return next((row.name for row in transcription.rows if np.argmax(rows) in row.rows), "a constraint")
    i = np.argmax(variables)
    places = [
        (name, s) for x in transcription.layouts for name, at in x.by_name.items() for s in x.s[: len(at)][at == i]
    ]
    return f"{places[0][0]!r} at {places[0][1]:.3g} of the duration" if places else "a free parameter"
