"""A fit as a text: its title, its table, how it ended. Knows results; simulates nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import refuse_unknown
from ..._description.system import System
from .._problem.leaves import leaf_names
from .bodies import bodies_in_words

if TYPE_CHECKING:
    from .result import Fit

STATUS = {
    "converged": "converged",
    "steps": "stopped after the last step, before it converged",
    "stuck": "stuck: no step lowers the cost",
    "interrupted": "interrupted: this is the best so far",
    "applied": "not fitted: these are the parameters of another fit",
}


def title(fit: Fit) -> str:
    """How much was fitted, in a line."""
    n_r, n_unknown = fit.problem.size
    return (
        f"{type(fit.problem.system).__name__}: {len(fit.problem.trials)} trials, "
        f"{len(fit.problem.places)} windows, {n_r} residuals, {len(fit.names)} parameters, "
        f"{n_unknown - len(fit.names)} nuisance values"
    )


def summary(fit: Fit) -> str:
    """A fit as a text: what was fitted, the table of parameters, how it ended, and the notes."""
    name = fit.problem.cost_name
    end = f"{name} {fit.history[0]:.6g} -> {fit.cost:.6g} by {fit.method}: {STATUS[fit.status]}"
    bodies = bodies_in_words(fit.parameters, fit.point.x)
    return "\n".join([title(fit), table(fit), *bodies, end, *fit.notes])


def table(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """Name, start, estimate and standard error of every parameter; and the truth, where it is known."""
    known = known_values(fit, truth)
    head = f"{'parameter':<22}{'start':>12}{'estimate':>12}{'std. error':>12}"
    lines = [head + (f"{'truth':>12}{'error':>9}" if known else "")]
    errors, start = fit.standard_errors, fit.start
    parameters = fit.parameters
    for name, unit, part in zip(fit.names, parameters.units, parameters.learned, strict=True):
        if part:
            continue
        value = fit.estimates[name]
        line = f"{name:<22}{start[name]:>12.5g}{value:>12.5g}{errors[name]:>12.2g}"
        if name in known:
            right = known[name]
            line += f"{right:>12.5g}{(value / right - 1 if right else value):>9.2{'%' if right else 'g'}}"
        lines.append(f"{line}  {unit}".rstrip())
    for part in dict.fromkeys(filter(None, parameters.learned)):
        own = [name for name, p in zip(fit.names, parameters.learned, strict=True) if p == part]
        size = [float(np.sqrt(np.mean([at[name] ** 2 for name in own]))) for at in (start, fit.estimates)]
        lines.append(f"{part:<22}{size[0]:>12.5g}{size[1]:>12.5g}  rms of {len(own)} learned numbers")
    return "\n".join(lines)


def known_values(fit: Fit, truth: Mapping[str, float] | System | None) -> dict[str, float]:
    """The true values of free parameters, from a system that has them or by name.

    **Raises:** `ValueError` for a name that is neither free nor a parameter; `TypeError` for another kind of system.
    """
    if truth is None:
        return {}
    system = fit.problem.system
    if isinstance(truth, Mapping):
        refuse_unknown(truth, (*fit.names, *leaf_names(system)), "`truth` names")
        return {name: float(truth[name]) for name in fit.names if name in truth}
    if type(truth) is not type(system):
        title = type(system).__name__
        raise TypeError(f"`truth` is a {title}, or values by name; got {type(truth).__name__}.")
    leaves = jax.tree.leaves(truth)
    targets = {e.name: e.targets[0] for e in fit.parameters.entries if e.targets}
    return {name: float(jnp.ravel(leaves[leaf])[place]) for name, (leaf, place, _) in targets.items()}
