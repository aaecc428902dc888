"""A fit's state in a file, so that an interrupted one goes on as if nothing had been. Knows files; knows no method."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ._problem import Problem


class Checkpoint:
    """One file, `path`, for one problem and method; with `path` None nothing is kept."""

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, method: str):
        self.path = None if path is None else Path(path)
        self.key = "" if path is None else _fingerprint(problem, method)

    def write(self, **state: Any) -> None:
        """Keep the state, whole or not at all: a crash while writing leaves the one before."""
        if self.path is None:
            return
        arrays: dict[str, Any] = {"key": np.array(self.key)}
        for name, tree in state.items():
            arrays |= {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=self.path.parent, suffix=".tmp", delete=False) as file:
            np.savez(file, **arrays)
        os.replace(file.name, self.path)

    def read(self, point: Any, **like: Any) -> dict[str, Any] | None:
        """The state that was kept, or None; `point` and `like` are trees of the same structure as what was written.

        **Raises:** `ValueError` where the file belongs to another problem, data or method.
        """
        if self.path is None or not self.path.exists():
            return None
        with np.load(self.path, allow_pickle=False) as file:
            arrays = dict(file)
        if str(arrays.pop("key", "")) != self.key:
            raise ValueError(
                f"{self.path} is the state of another fit: other data, other parameters or another method. Name "
                "another file, or delete this one."
            )
        like = {"point": point, **like}
        found: dict[str, Any] = {}
        for name in {label.split("/")[0] for label in arrays}:
            leaves = [arrays[f"{name}/{i}"] for i in range(sum(label.split("/")[0] == name for label in arrays))]
            if name in like:
                leaves = [jax.numpy.asarray(leaf) for leaf in leaves]
                found[name] = jax.tree.unflatten(jax.tree.structure(like[name]), leaves)
            else:
                found[name] = leaves[0]
        return found


def _fingerprint(problem: Problem, method: str) -> str:
    """Of everything that a step depends on."""
    known = hashlib.sha256(method.encode())
    model = problem.model
    for text in (problem.parameters.entries, model.channels, model.held, model.nuisance.trial, model.nuisance.start):
        known.update(repr(text).encode())
    for leaf in jax.tree.leaves((model, problem.windows)):
        known.update(np.asarray(leaf).tobytes() if hasattr(leaf, "shape") else repr(leaf).encode())
    return known.hexdigest()
