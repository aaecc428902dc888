"""A fit that was saved, read back beside the problem that it belongs to. Knows files and results."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._common.digest import differences
from .._problem.arguments import refuse_other
from .._problem.blocks import Blocks
from .._problem.linearization import Linearization, cost
from .._problem.model import Seen, Unknowns
from .._problem.problem import Problem
from .._problem.state_file import described, read_state, tree_of
from .result import Fit

SAME_COST = 1e-6
"""By what part of it the cost may differ where the code has changed since."""


def load(path: str | os.PathLike[str], problem: Problem) -> Fit:
    """A fit that `Fit.save` has written.

        problem = Problem.of(system, trials, free, unknown=("roll",))  # as it was posed
        result = load("fit.npz", problem)

    A file holds numbers only: no code, and no trials. `problem` is posed again from the same system, trials and
    options (for `fit_bicycle` by `bicycle_problem`); steps of integration that the fit has chosen come from the file.
    Where the code has changed since (the system's, jaxkane's or JAX's), the cost is computed anew, and a fit that no
    longer has it is refused.

    **Returns:** the same `Fit`: what it says are the numbers of the one that was saved.

    **Raises:** `ValueError` that says in what the problem differs, that the code gives another cost, or that the file
    is damaged; `FileNotFoundError`.
    """
    refuse_other(problem, Problem, "load", "load(path, Problem.of(system, trials, free))")
    path = Path(path).expanduser()
    there, arrays = read_state(path)
    of_fit: dict[str, Any] = there.pop("fit", {})
    if not of_fit:
        raise ValueError(f"{path} is the checkpoint of a fit, not a fit that was saved: give it as `checkpoint=`.")
    step = tree_of(path, arrays, "step", problem.windows.step)
    if problem.chooses_steps and step.shape == problem.windows.step.shape:
        problem = problem.with_steps(step)
    here = described(problem)
    wrong = differences(*({key: d[key] for key in d if key not in ("program", "versions")} for d in (there, here)))
    if wrong:
        raise ValueError(f"{path} is the fit of another problem. It differs in {wrong}. Pose the problem as it was.")
    like: dict[str, Any] = {"point": problem.start, "R": 0.0, "step_errors": 0.0, "history": 0.0}
    there_too = jnp.zeros(()) if problem.model.noise is not None else None
    like["seen"] = Seen(jnp.zeros(()), jnp.zeros(()), there_too, there_too, there_too)
    found = {name: tree_of(path, arrays, name, tree) for name, tree in like.items()}
    point, n_z, n_b = found["point"], found["point"].z.shape[1], found["point"].b.shape[1]
    blocks = Blocks(found["R"], problem.by_trial, n_z, n_z if problem.model.nuisance.chained else 0, n_b)
    at = Linearization(blocks, found["seen"])
    if there["program"] != here["program"]:
        _refuse_changed(path, problem, point, at, there["versions"])
    errors, history = np.asarray(found["step_errors"]), tuple(float(c) for c in found["history"])
    return Fit(problem, point, at, errors, history, of_fit["status"], of_fit["method"], of_fit["failed"])


def _refuse_changed(path: Path, problem: Problem, point: Unknowns, at: Linearization, versions: str) -> None:
    """`ValueError` where what the code computes today is not what was computed for the fit."""
    now = cost(problem, point)
    if not abs(now - at.cost) <= SAME_COST * at.squares:
        raise ValueError(
            f"{path}: the code has changed since this fit was saved (by {versions}), and {problem.cost_name} with it: "
            f"{at.cost:.6g} then, {now:.6g} now. Fit anew, from `start=` if you like, or go back to that code."
        )
