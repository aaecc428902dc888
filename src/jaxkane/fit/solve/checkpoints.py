"""Files of a fit: arrays with a key that identifies their problem, and checkpoints."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, PyTree

from ..._common.files import atomic_write, differences
from ..._scalarjit.digest import digest
from ..._system.parameters import leaf_name
from ..problem.model import Model
from ..problem.problem import Problem
from ..problem.windows import Windows
from .kalman import filtered

_RESUME = (
    "An earlier file with this name is unchanged. If it is a checkpoint, call again with the same arguments to resume."
)


def write_state(path: Path, key: Mapping[str, Any], trees: Mapping[str, Any]) -> None:
    """Write the arrays of trees atomically: after a crash while writing, the earlier file is unchanged."""
    arrays: dict[str, Any] = {"key": np.array(json.dumps(key))}
    for name, tree in trees.items():
        leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array_like))
        arrays |= {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    atomic_write(path, lambda file: np.savez(file, **arrays), remedy=_RESUME)


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The key and the arrays in a file.

    **Raises:** `ValueError` if the file cannot be read.
    """
    try:
        # Unpickling could run code, and a checkpoint may come from another person.
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        return dict(json.loads(str(arrays.pop("key")))), arrays
    except (MemoryError, FileNotFoundError):
        raise
    except Exception as error:  # decoders raise exceptions of many types for invalid bytes
        raise ValueError(
            f"{path} cannot be read as the state of a fit ({type(error).__name__}: {error}). It is damaged, was "
            "written by another version of jaxkane, or is not a file of a fit. Delete it, or choose another file."
        ) from None


def tree_of(path: Path, arrays: Mapping[str, np.ndarray], name: str, like: PyTree) -> Any:
    """The saved tree with this name, with the structure of `like`.

    **Raises:** `ValueError` if a part of it is missing.
    """
    like, rest = eqx.partition(like, eqx.is_array_like)
    leaves, structure = jax.tree.flatten(like)
    new = [arrays.get(f"{name}/{i}") for i in range(len(leaves))]
    if any(x is None for x in new) or f"{name}/{len(leaves)}" in arrays:
        raise ValueError(f"{path} is incomplete: a part of the state of this fit ({name}) is missing. Delete it.")
    return eqx.combine(jax.tree.unflatten(structure, [jax.numpy.asarray(x) for x in new]), rest)


class Checkpoint:
    """A file with the state of a search, for one problem and method.

    **Arguments:**

    - `path`: the path of the file; with None, nothing is saved.
    - `problem`: the problem.
    - `method`: by name, other values on which the next step depends.
    """

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, **method: Any):
        self.path = None if path is None else Path(path).expanduser()
        self.key = {} if path is None else {**method, **described(problem)}

    def write(self, **state: Any) -> None:
        if self.path is not None:
            write_state(self.path, self.key, state)

    def read(self, **like: Any) -> dict[str, Any] | None:
        """The state in the file; None if there is no file. `like`: by name, trees of the same structure.

        **Raises:** `ValueError` if the file belongs to another problem, data or method, or cannot be read.
        """
        if self.path is None or not self.path.exists():
            return None
        saved_key, arrays = read_state(self.path)
        wrong = differences(saved_key, self.key)
        if wrong:
            raise ValueError(
                f"{self.path} contains the state of another fit, which differs in {wrong}. Choose another file, or "
                "delete this one."
            )
        return {name: tree_of(self.path, arrays, name, tree) for name, tree in like.items()}


def described(problem: Problem) -> dict[str, Any]:
    """By name, all properties of a problem on which residuals and their derivatives depend."""
    problem = problem.with_errors_of(None)  # the estimated error models are not part of the problem
    model, settings = problem.model, problem.model.settings
    numbers, rest = eqx.partition(model, eqx.is_array)

    point = problem.start
    window, z, b = jax.tree.map(
        lambda x: np.asarray(x)[0], (problem.windows, point.window_starts, point.trial_unknowns)
    )
    changed = {number for entry in problem.parameters.entries for number, *_ in entry.targets}
    leaves = [
        (i, leaf_name(path), x) for i, (path, x) in enumerate(jax.tree_util.tree_leaves_with_path(problem.system))
    ]
    fixed = {name: x for i, name, x in leaves if eqx.is_array(x) and i not in changed}
    guessed = [x for i, _, x in leaves if eqx.is_array(x) and i in changed]

    def residuals(numbers: Model, window: Windows, z: Array, b: Array, x: Array):
        model = eqx.combine(numbers, rest)
        start = model.consistent(window, z, x)
        if model.noise is not None:
            return filtered(model, window, start, b, x)[:2], model.priors(window, z, b)
        return model.residuals(window, start, z, b, x)[0]

    return {
        "system": type(problem.system).__name__,
        "free parameters": ", ".join(problem.parameters.names),
        "unknown starts": ", ".join(model.nuisance.window_names) or "none",
        "unknowns of trials": ", ".join(model.nuisance.trial_names) or "none",
        "channels": ", ".join(model.channels),
        "process noise": ", ".join(model.noise.names) or "zero" if model.noise is not None else "none",
        "error models": "none" if model.errors is None else ", ".join(map(repr, model.errors.distributions)),
        "windows": len(problem.slices),
        "rtol": float(settings.rtol),
        # The ratio is compared with six digits: a fit scales atol with rtol, so its rounding errors differ.
        "atol": " ".join(f"{x:.6g}" for x in np.ravel(settings.atol) / float(settings.rtol)) + " of rtol",
        "max_steps": settings.max_steps,
        "solver": type(settings.solver).__name__,
        "fixed parameter": {name: digest(x) if np.ndim(x) else float(x) for name, x in fixed.items()},
        "initial guesses, priors": digest(jax.tree.leaves(dataclasses.replace(numbers, system=guessed))),
        "data": digest(jax.tree.leaves(problem.windows)),
        "program": digest(jax.make_jaxpr(residuals)(numbers, window, z, b, point.parameters)),
    }
