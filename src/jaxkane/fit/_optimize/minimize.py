"""The one loop in which every optimizer runs: start, steps, checkpoint, callback, progress, Ctrl-C. Knows no method."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable

import numpy as np
from tqdm import tqdm

from .._problem.arguments import refuse_other
from .._problem.linearization import linearize
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.result import Fit
from .checkpoint import Checkpoint
from .optimizer import Iterate, Optimizer
from .steps import solve_nuisance, usable


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
