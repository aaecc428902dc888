"""Files of fits: `Fit.save` and `load`."""

from __future__ import annotations

import dataclasses
import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._common.files import differences
from ..._scalarjit.compat import on_device
from ..problem.model import Prediction, Simulation, Unknowns
from ..problem.problem import Problem
from ..problem.trial import trial_names
from ..solve.blocks import Blocks
from ..solve.checkpoints import described, read_state, tree_of, write_state
from ..solve.linearization import Linearization


@dataclasses.dataclass(frozen=True, repr=False)
class FitState:
    """The numbers from which all results of a fit follow. A file contains them, except for the problem."""

    problem: Problem
    point: Unknowns
    linearization: Linearization
    step_errors: np.ndarray  # (W,), see `problem.step_errors`
    history: tuple[float, ...]
    status: str
    method: str
    failed: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)


def write_fit(path: Path, fit: FitState) -> Path:
    """Write a fit to a file. See `Fit.save`."""
    versions = ("jaxkane", "jax", "diffrax")
    key = {
        "fit": {"status": fit.status, "method": fit.method, "failed": dict(fit.failed)}
        | {
            "deviations": fit.problem.parameters.deviations.tolist(),
            "places": np.asarray(fit.problem.parameters.places).tolist(),
        }
        | {"rest": np.asarray(fit.problem.parameters.rest).tolist()},
        "versions": ", ".join(f"{name} {importlib.metadata.version(name)}" for name in versions),
        **described(fit.problem),
    }
    at, step = fit.linearization, (fit.problem.windows.step, fit.problem.model.settings.rtol)
    numbers = {"R": at.blocks.R, "prediction": at.prediction, "step_errors": fit.step_errors}
    numbers["errors"] = fit.problem.model.errors
    write_state(path, key, {"point": fit.point, "step": step, "history": np.array(fit.history), **numbers})
    return path


SAME_COST = 1e-6
"""Largest relative difference of the cost that `load` accepts if the code has changed since the fit was saved."""


def read_fit(path: Path, problem: Problem) -> FitState:
    """Read a fit from a file. See `load`."""
    saved, arrays = read_state(path)
    of_fit: dict[str, Any] = saved.pop("fit", {})
    if not of_fit:
        raise ValueError(f"{path} is the checkpoint of a fit, not a saved fit. Pass it as `checkpoint=` of the fit.")
    names, failed = trial_names(problem.trials), of_fit["failed"]
    if failed and failed.keys() <= {*names}:
        kept = [trial for name, trial in zip(names, problem.trials, strict=True) if name not in failed]
        problem = problem.with_trials(kept)
    step, rtol = tree_of(path, arrays, "step", (problem.windows.step, problem.model.settings.rtol))
    if problem.chooses_steps and step.shape == problem.windows.step.shape:
        problem = problem.with_steps(step)
    elif (problem.specification.simulation or Simulation()).chooses:
        problem = problem.with_tolerances(rtol)
    parameters = problem.parameters.with_deviations(np.array(of_fit["deviations"]))
    if parameters.inequalities and {*of_fit["places"]} < {*np.asarray(parameters.places).tolist()}:  # some at a bound
        kept = np.flatnonzero(np.isin(np.asarray(parameters.places), of_fit["places"]))
        parameters = parameters.subset(kept.tolist(), problem.start.parameters)
        parameters = dataclasses.replace(parameters, rest=on_device(np.array(of_fit["rest"], parameters.rest.dtype)))
    problem = dataclasses.replace(problem, model=dataclasses.replace(problem.model, parameters=parameters))
    key = described(problem)
    wrong = differences(*({k: d[k] for k in d if k not in ("program", "versions")} for d in (saved, key)))
    if wrong:
        raise ValueError(
            f"{path} contains the fit of another problem, which differs in {wrong}. Create the problem with the "
            "original arguments."
        )
    of_filter = jnp.zeros(()) if problem.model.noise is not None else None
    cost = jnp.zeros(()) if problem.model.has_likelihood else None
    prediction = Prediction(jnp.zeros(()), jnp.zeros(()), of_filter, cost, of_filter)
    like = {
        "point": problem.start,
        "errors": problem.model.errors,
        "R": 0.0,
        "step_errors": 0.0,
        "history": 0.0,
        "prediction": prediction,
    }
    state: dict[str, Any] = {name: tree_of(path, arrays, name, tree) for name, tree in like.items()}
    point, model = state["point"], dataclasses.replace(problem.model, errors=state["errors"])
    problem = dataclasses.replace(problem, model=model)
    at = Linearization(Blocks.of(model, state["R"], problem.by_trial, point.parameters), state["prediction"])
    if saved["program"] != key["program"]:
        now = problem.cost(point)
        if not abs(now - at.cost) <= SAME_COST * at.squares:
            raise ValueError(
                f"{path}: the {problem.cost_name} is now {now:.6g}, but was {at.cost:.6g} when the fit was saved (by "
                f"{saved['versions']}). The code has changed since then. Fit again, for example from `start=`, or "
                "install these versions."
            )
    errors, history = np.asarray(state["step_errors"]), tuple(float(c) for c in state["history"])
    return FitState(problem, point, at, errors, history, of_fit["status"], of_fit["method"], of_fit["failed"])
