"""Files of a fit: arrays with a description of the problem that they belong to, and checkpoints."""

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

from .._common.files import atomic_write, differences
from .._scalarjit.digest import digest
from .._system.parameters import leaf_name
from ._kalman import filtered
from ._problem import Problem


def write_state(path: Path, key: Mapping[str, Any], trees: Mapping[str, Any]) -> None:
    """Write the arrays of trees, whole or not at all: a crash while writing leaves the file that was there."""
    arrays: dict[str, Any] = {"key": np.array(json.dumps(key))}
    for name, tree in trees.items():
        leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array_like))
        arrays |= {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, lambda file: np.savez(file, **arrays))


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The description and the arrays in a file.

    **Raises:** `ValueError` where it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        return dict(json.loads(str(arrays.pop("key")))), arrays
    except (MemoryError, FileNotFoundError):
        raise
    except Exception as error:  # whatever a decoder says of bytes that are not its own
        raise ValueError(
            f"{path} cannot be read as the state of a fit ({type(error).__name__}: {error}): it is damaged, "
            "was written by an earlier version of jaxkane, or is no file of a fit. Delete it, or name another file."
        ) from None


def tree_of(path: Path, arrays: Mapping[str, np.ndarray], name: str, like: Any) -> Any:
    """One of the trees that were written, which has the structure and the shapes of `like`.

    **Raises:** `ValueError` where a part of it is missing.
    """
    like, rest = eqx.partition(like, eqx.is_array_like)
    leaves, structure = jax.tree.flatten(like)
    new = [arrays.get(f"{name}/{i}") for i in range(len(leaves))]
    if any(x is None for x in new) or f"{name}/{len(leaves)}" in arrays:
        raise ValueError(f"{path} lacks a part of the state of this fit ({name}): delete it.")
    return eqx.combine(jax.tree.unflatten(structure, [jax.numpy.asarray(x) for x in new]), rest)


class Checkpoint:
    """A file with the state of a search, for one problem and method; with `path` None nothing is kept.

    `method`: by name, what else the next step depends on.
    """

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, **method: Any):
        self.path = None if path is None else Path(path).expanduser()
        self.key = {} if path is None else {**method, **described(problem)}

    def write(self, **state: Any) -> None:
        if self.path is not None:
            write_state(self.path, self.key, state)

    def read(self, **like: Any) -> dict[str, Any] | None:
        """The state in the file, or None; `like` has trees of the same structure.

        **Raises:** `ValueError` where the file belongs to another problem, data or method, or cannot be read.
        """
        if self.path is None or not self.path.exists():
            return None
        saved_key, arrays = read_state(self.path)
        wrong = differences(saved_key, self.key)
        if wrong:
            raise ValueError(
                f"{self.path} is the state of another fit. It differs in {wrong}. Name another file, or delete this "
                "one."
            )
        return {name: tree_of(self.path, arrays, name, tree) for name, tree in like.items()}


def described(problem: Problem) -> dict[str, Any]:
    """All that residuals and their derivatives depend on, by name."""
    model, settings = problem.model, problem.model.settings
    numbers, rest = eqx.partition(model, eqx.is_array)
    first = lambda tree: jax.tree.map(lambda x: np.asarray(x)[0], tree)  # noqa: E731
    window, point = first(problem.windows), problem.start
    fixed, guessed = _fixed_and_guessed(problem)

    def residuals(numbers, window, z, b, x):
        model = eqx.combine(numbers, rest)
        start = model.consistent(window, z, x)
        if model.noise is not None:
            return filtered(model, window, start, b, x)[:2], model.priors(window, z, b, x)
        return model.residuals(window, start, z, b, x)[0]

    return {
        "system": type(problem.system).__name__,
        "free parameters": ", ".join(problem.parameters.names),
        "unknown starts": ", ".join(model.nuisance.start) or "none",
        "unknowns of trials": ", ".join(" ".join(pair) for pair in model.nuisance.trial) or "none",
        "channels": ", ".join(model.channels),
        "process noise": ", ".join(model.noise.names) or "zero" if model.noise is not None else "none",
        "windows": len(problem.slices),
        "rtol": settings.rtol,
        "atol": settings.atol,
        "max_steps": settings.max_steps,
        "solver": type(settings.solver).__name__,
        "fixed parameter": {name: digest(x) if np.ndim(x) else float(x) for name, x in fixed.items()},
        "initial guesses, priors": digest(jax.tree.leaves(dataclasses.replace(numbers, system=guessed))),
        "data": digest(jax.tree.leaves(problem.windows)),
        "program": digest(jax.make_jaxpr(residuals)(numbers, window, first(point.z), first(point.b), point.x)),
    }


def _fixed_and_guessed(problem: Problem) -> tuple[dict[str, Any], list[Any]]:
    """Of the numbers of the system: those that the fit leaves as they are, by name; those that it starts from."""
    moved = {number for entry in problem.parameters.entries for number, *_ in entry.targets}
    leaves = jax.tree_util.tree_leaves_with_path(problem.system)
    arrays = [(i, leaf_name(path), x) for i, (path, x) in enumerate(leaves) if eqx.is_array(x)]
    return {name: x for i, name, x in arrays if i not in moved}, [x for i, _, x in arrays if i in moved]
