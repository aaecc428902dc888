"""The state of a descent in a file, so that an interrupted one goes on where it was. Knows no method."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..._common.digest import differences
from .._problem.problem import Problem
from .._problem.state_file import described, read_state, tree_of, write_state


class Checkpoint:
    """One file, `path`, for one problem and method; with `path` None nothing is kept.

    `method`: its name, and whatever else of it the next step depends on, by name.
    """

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, **method: Any):
        self.path = None if path is None else Path(path).expanduser()
        self.key = {} if path is None else {**method, **described(problem)}

    def write(self, **state: Any) -> None:
        """Keep the state, whole or not at all: a crash while writing leaves the one before."""
        if self.path is not None:
            write_state(self.path, self.key, state)

    def read(self, **like: Any) -> dict[str, Any] | None:
        """The state that was kept, or None; `like` has trees of the structure of what was written.

        **Raises:** `ValueError` where the file belongs to another problem, data or method, or cannot be read.
        """
        if self.path is None or not self.path.exists():
            return None
        there, arrays = read_state(self.path)
        wrong = differences(there, self.key)
        if wrong:
            raise ValueError(
                f"{self.path} is the state of another fit. It differs in {wrong}. Name another file, or delete this "
                "one."
            )
        return {name: tree_of(self.path, arrays, name, tree) for name, tree in like.items()}
