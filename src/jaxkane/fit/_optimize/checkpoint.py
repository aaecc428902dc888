"""A fit's state in a file, so that an interrupted one goes on as if nothing had been. Knows files; knows no method."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..._common.digest import differences, digest
from ..._common.whole_file import write_whole
from .._problem.problem import Problem


class Checkpoint:
    """One file, `path`, for one problem and method; with `path` None nothing is kept.

    `method`: its name, and whatever else of it the next step depends on, by name.
    """

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, **method: Any):
        self.path = None if path is None else Path(path).expanduser()
        self.key = {} if path is None else {**method, **_described(problem)}

    def write(self, **state: Any) -> None:
        """Keep the state, whole or not at all: a crash while writing leaves the one before."""
        if self.path is None:
            return
        arrays: dict[str, Any] = {"key": np.array(json.dumps(self.key))}
        for name, tree in state.items():
            arrays |= {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self.path, lambda file: np.savez(file, **arrays))

    def read(self, **like: Any) -> dict[str, Any] | None:
        """The state that was kept, or None; `like` has trees of the structure of what was written.

        **Raises:** `ValueError` where the file belongs to another problem, data or method, or cannot be read.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            with np.load(self.path, allow_pickle=False) as file:
                arrays = dict(file)
            there = dict(json.loads(str(arrays["key"])))
        except MemoryError:
            raise
        except Exception as error:  # whatever a decoder says of bytes that are not its own
            raise ValueError(
                f"{self.path} cannot be read as the state of a fit ({type(error).__name__}: {error}): it is damaged, "
                "was written by an earlier version of jaxkane, or is no checkpoint. Delete it, or name another file."
            ) from None
        wrong = differences(there, self.key)
        if wrong:
            raise ValueError(
                f"{self.path} is the state of another fit. It differs in {wrong}. Name another file, or delete this "
                "one."
            )
        return {name: self._tree(name, arrays, tree) for name, tree in like.items()}

    def _tree(self, name: str, arrays: dict[str, np.ndarray], like: Any) -> Any:
        leaves, structure = jax.tree.flatten(like)
        found = [arrays.get(f"{name}/{i}") for i in range(len(leaves))]
        if any(x is None for x in found) or f"{name}/{len(leaves)}" in arrays:
            raise ValueError(f"{self.path} lacks a part of the state of this fit ({name}): delete it.")
        return jax.tree.unflatten(structure, [jax.numpy.asarray(x) for x in found])


def _described(problem: Problem) -> dict[str, Any]:
    """All that a step depends on, by name."""
    model, settings = problem.model, problem.model.settings
    numbers, rest = eqx.partition(model, eqx.is_array)
    window = jax.tree.map(lambda x: x[0], problem.windows)
    point = problem.start

    def residuals(numbers, window, z, b, x):
        model = eqx.combine(numbers, rest)
        return model.residuals(window, model.consistent(window, z, x), z, b, x)[0]

    return {
        "system": type(problem.system).__name__,
        "free parameters": ", ".join(problem.parameters.names),
        "unknown starts": ", ".join(model.nuisance.start) or "none",
        "unknowns of trials": ", ".join(" ".join(pair) for pair in model.nuisance.trial) or "none",
        "channels": ", ".join(model.channels),
        "windows": len(problem.places),
        "rtol": settings.rtol,
        "atol": settings.atol,
        "max_steps": settings.max_steps,
        "solver": type(settings.solver).__name__,
        "first guesses, priors": digest(jax.tree.leaves(numbers)),
        "data": digest(jax.tree.leaves(problem.windows)),
        "program": digest(jax.make_jaxpr(residuals)(numbers, window, point.z[0], point.b[0], point.x)),
    }
