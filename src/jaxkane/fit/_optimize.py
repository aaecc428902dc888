"""The one loop in which every optimizer runs: steps and checkpoints."""

from __future__ import annotations

import abc
import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from tqdm import tqdm

from .._common.files import differences
from .._common.lookup import real_number
from ._io import described, read_state, tree_of, write_state
from ._linearize import Linearization, linearize
from ._model import Unknowns
from ._nuisance import solve_nuisance, usable
from ._problem import Problem, refuse_other
from ._result import Fit


@dataclasses.dataclass(frozen=True)
class Iterate:
    """Where a descent stands.

    - `point`, and `cost`: the sum of squares there. `at`: the problem linearized there, where the optimizer needs that.
    - `memory`: a tree of arrays, all else that the next step depends on.
    """

    point: Unknowns
    cost: float
    at: Linearization | None
    memory: Any


class Optimizer(abc.ABC):
    """A method and its options, without a state: a frozen dataclass.

    A new one is a file with a class like those beside this, and its line in `jaxkane.fit`.
    """

    steps: ClassVar[int]
    """At most, where `minimize` is not asked for another number."""

    def __post_init__(self) -> None:
        for name in ("rtol", "damping"):
            label = f"{type(self).__name__}: `{name}`"
            value = real_number(getattr(self, name, 0.0), label)
            if not 0 <= value < float("inf"):
                raise ValueError(f"{label} is a number that is not negative, got {value}.")

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """For tables."""

    def depends_on(self, problem: Problem, steps: int) -> dict[str, Any]:
        """By name, what the next step depends on besides the problem and the memory: a checkpoint goes on only where
        that is the same."""
        return {}

    def for_steps(self, steps: int) -> Optimizer:
        """The same for so many steps at most, where its options follow from that."""
        return self

    def before(self, problem: Problem, point: Unknowns, steps: int) -> Unknowns:
        """The point from which the descent shall begin, where another one is better."""
        return point

    def without_preparation(self) -> Optimizer:
        """The same for a start that is near the end: what `before` would do is left out."""
        return self

    @abc.abstractmethod
    def begin(self, problem: Problem, point: Unknowns, at: Linearization) -> Any:
        """The memory before the first step."""

    @abc.abstractmethod
    def step(self, problem: Problem, now: Iterate, taken: int) -> Iterate | str:
        """After one more step, of which `taken` were made before; or the status (see `STATUS`) with which it ends."""

    def after(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        """What is left to do with the best point that was seen, and the status."""
        return best, status


def uninterrupted(fit: Any) -> Any:
    """A fit that is a part of a study. **Raises:** `KeyboardInterrupt` where Ctrl-C ended it: that ends the study."""
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit


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


def minimize(
    problem: Problem,
    optimizer: Optimizer,
    *,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """Solve a problem that has been posed: `fit` does both.

        minimize(Problem.of(system, trials, free), LeastSquares(rtol=1e-9), steps=200)

    **Arguments:**

    - `optimizer`: such as `GradientDescent()`, `LeastSquares()` or `BFGS()`.
    - `steps`: at most; by default as many as suit the optimizer.
    - `start`: `Unknowns` to go on from, such as `fit.point`; by default the system's values.
    - `checkpoint`: a file in which the state is kept after every step; where it exists the fit goes on from there.
    - `callback`: called with the unknowns and their cost at the start and after every step. `progress`: a progress bar.

    **Returns:** a `Fit` at the best point seen, with the history of the cost; after an interruption (Ctrl-C) too, and
    `status` says so.

    **Raises:** `TypeError` for what is no optimizer; `ValueError` where a window cannot be simulated with the initial
    guess, or a checkpoint is of another fit.
    """
    if not isinstance(optimizer, Optimizer):
        raise TypeError(f"`optimizer` is such as GradientDescent(), LeastSquares() or BFGS(); got {optimizer!r}.")
    refuse_other(problem, Problem, "minimize", "minimize(fit.problem, LeastSquares())")
    if start is not None:
        refuse_other(start, Unknowns, "`start=`", "start=fit.point, or change the system's values")
    steps = optimizer.steps if steps is None else steps
    if not isinstance(steps, int) or steps < 0:
        raise ValueError(f"`steps` is a whole number that is not negative, got {steps!r}.")
    start = problem.start if start is None else start
    key = {} if checkpoint is None else {"method": optimizer.name, **optimizer.depends_on(problem, steps)}
    file, optimizer = Checkpoint(checkpoint, problem, **key), optimizer.for_steps(steps)
    run = _kept(file, problem, optimizer, start) or _begun(problem, optimizer, start, steps)
    first, status = run.now, "steps"
    bar = tqdm(total=steps, initial=len(run.history) - 1, disable=not progress, desc=optimizer.name)
    try:
        if callback:
            callback(run.now.point, run.now.cost)
        for taken in range(len(run.history) - 1, steps):
            found = optimizer.step(problem, run.now, taken)
            if isinstance(found, str):
                status = found
                break
            run.add(found)
            file.write(point=found.point, memory=found.memory, best=run.best.point, history=np.array(run.history))
            if callback:
                callback(found.point, found.cost)
            bar.update()
            bar.set_postfix(cost=f"{found.cost:.6g}")
        run.best, status = optimizer.after(problem, run.best, status)
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return _result(problem, optimizer, run, first, status)


@dataclasses.dataclass
class _Run:
    """A descent under way."""

    now: Iterate
    best: Iterate
    history: list[float]

    def add(self, found: Iterate) -> None:
        self.now = found
        self.history.append(found.cost)
        if found.cost < self.best.cost:
            self.best = found


def _begun(problem: Problem, optimizer: Optimizer, start: Unknowns, steps: int) -> _Run:
    point, at = solve_nuisance(problem, optimizer.before(problem, start, steps))
    now = Iterate(point, at.cost, at, optimizer.begin(problem, point, at))
    return _Run(now, now, [at.cost])


def _kept(file: Checkpoint, problem: Problem, optimizer: Optimizer, start: Unknowns) -> _Run | None:
    """The descent as a checkpoint has it; None without one."""
    saved = file.read(point=start, best=start, history=0.0)
    if saved is None:
        return None
    there = {name: linearize(problem, saved[name]) for name in ("point", "best")}
    at, at_best = there["point"], there["best"]
    if at is None or at_best is None or not (usable(at) and usable(at_best)):
        raise ValueError(f"{file.path}: the residuals are not finite where this fit was left; delete the file.")
    like = optimizer.begin(problem, saved["point"], at)
    memory = (file.read(memory=like) or {})["memory"]
    now = Iterate(saved["point"], at.cost, at, memory)
    return _Run(now, Iterate(saved["best"], at_best.cost, at_best, memory), [float(c) for c in saved["history"]])


def _result(problem: Problem, optimizer: Optimizer, run: _Run, first: Iterate, status: str) -> Fit:
    best = run.best
    at = linearize(problem, best.point) if best.at is None else best.at
    if at is None or not usable(at):  # it can be simulated there, but has no derivatives
        best, at, status = first, first.at, status if status == "interrupted" else "stuck"
    assert at is not None
    return Fit.of(problem, best.point, at, run.history, status, optimizer.name)
