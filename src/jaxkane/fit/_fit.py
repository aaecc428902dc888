"""A fit: the problem is specified, an optimizer's steps are made, with checkpoints, and the result is put together."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from .._system.system import System
from ._io import Checkpoint
from ._model import Unknowns
from ._nuisance import Unsimulated, solve_nuisance, usable
from ._optimizers import Iterate, LeastSquares, Optimizer
from ._problem import Problem, refuse_other, with_options
from ._result import Fit
from ._statistics import trial_names
from ._trial import Trial


@with_options
def fit(
    system: System,
    trials: Sequence[Trial] | Trial,
    free: Any,
    *,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
    **options: Any,
) -> Fit:
    """The parameters of a system with which its motion is nearest to what was measured.

        minimize  sum ((gain * simulated + bias - measured) / sigma)^2

    **Arguments:**

    - `system`: with initial guesses of its parameters. `trials`: one `Trial` or several.
    - `free`: what to find: names, paths, functions to leaves, `Free`, `Gain`, `Offset`, `Delay`, `LowPass`
        and `Inertia`.
    - `unknown`: coordinates, independent speeds and states of the first order whose value at the start of every window
        is to be found too; dependent ones follow from them (`assemble`). What is measured and not among them starts at
        its first sample, with the error of that. Four unknown Euler parameters are three degrees of freedom.
    - `sensor_bias`, `sensor_gain`: channels with an unknown constant offset and factor in every trial. `input_bias`,
        `input_gain`, `input_delay` [s]: inputs with an offset, a factor and a delay of every trial's own.
    - These are names, or a dict from names to the standard deviation of a Gaussian prior around the initial guess
        (None: no prior).
    - `priors`: (mean, standard deviation) by name, of parameters that were measured elsewhere; names that are not free
        are passed over.
    - `zero_order_hold`: inputs under a zero-order hold, which keep each sample until the next; the others are linear
        between their samples.
    - `window` [s]: cut the trials into windows of this length, each with its own unknown start (multiple shooting), as
        unstable motions need, and of two samples at least. By default a trial is one window (single shooting).
    - `defect_std`: by name, the standard deviation of the jump from a window's end to the next one's start, for what is
        `unknown`; names left out jump freely. Small ones ask for one motion through all windows; with windows as short
        as the samples they are a process noise, and the sum of squares is that of a Kalman filter's prediction errors.
    - `noise`: by name, spectral densities of the white noise that disturbs independent speeds and states [unit^2/s] and
        inputs [unit^2 s]. The motion is then a random one, the cost is minus twice the log likelihood by an extended
        Kalman filter, and `SpectralDensity` and `NoiseScale` in `free` estimate these and the sensors' deviations. {}
        for no noise but the sensors'. `unknown` starts with a deviation are what the filter begins with, those without
        are estimated; `window` is not needed, since the filter follows an unstable motion too.
    - `processes`: let all processes of `jax.distributed` simulate together. Each is started with the same script,
        calls `jax.distributed.initialize(...)` before anything else, and this with all trials; each simulates a share
        of the windows, all take the same steps and return the same `Fit`, that of one process alone.
    - `simulation`: how motions are integrated: `Simulation(rtol=1e-8)`, `Simulation(step=0.01)`.
    - `optimizer`: `LeastSquares()` (Levenberg-Marquardt, the default; with `damping=0` Gauss-Newton),
        `GradientDescent()` or `BFGS()`, with their options.
    - `steps`, `start`, `checkpoint`, `callback`, `progress`: of its run, as in `minimize`.

    **Returns:** a `Fit`. Trials that cannot be simulated with the initial guess are left out: its `failed` says by name
    why, and so do its `notes`.

    **Raises:** `ValueError` that names what is wrong with a trial, a channel, a parameter or a window, and where no
    trial can be simulated.
    """
    problem = Problem.of(system, trials, free, **options)
    run = {"steps": steps, "callback": callback, "progress": progress}
    return solve(problem, optimizer, start=start, checkpoint=checkpoint, **run)


def solve(
    problem: Problem,
    optimizer: Optimizer | None = None,
    *,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    **run: Any,
) -> Fit:
    """`minimize` without the trials that cannot be simulated, and again from where it ended while the steps of
    integration are too coarse there."""
    method: Any = LeastSquares() if optimizer is None else optimizer
    if start is not None:
        _refuse_start_of_another(problem, start)
    names, failed = trial_names(problem), {}
    while True:
        try:
            # A checkpoint is that of the problem without the trials that are left out. Shorter horizons may yet lead to
            # parameters by which all can be simulated.
            if checkpoint is not None and not method.horizons:
                solve_nuisance(problem, problem.start if start is None else start)
            result = minimize(problem, method, start=start, checkpoint=checkpoint, **run)
            break
        except Unsimulated as error:
            kept = [k for k in range(len(names)) if k not in error.reasons]
            if not kept:
                raise
            failed |= {names[k]: why for k, why in error.reasons.items()}
            start = None if start is None else problem.point_of(start, kept)
            problem, names = problem.with_trials([problem.trials[k] for k in kept]), tuple(names[k] for k in kept)
    # The checkpoint has the first run only: what follows begins near its end.
    for _ in range(3):
        if not result.problem.chooses_steps or result.status != "converged" or not result.too_coarse:
            break
        problem = result.problem.finer(result.point)
        if np.array_equal(problem.windows.step, result.problem.windows.step):
            break
        if method.horizons:
            method = dataclasses.replace(method, horizons=())
        again = minimize(problem, method, start=result.point, **run)
        result = dataclasses.replace(again, history=(*result.history, *again.history[1:]))
    return dataclasses.replace(result, failed=failed)


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
    """Solve a `Problem`; `fit` specifies it and solves it.

        minimize(Problem.of(system, trials, free), LeastSquares(rtol=1e-9), steps=200)

    **Arguments:**

    - `optimizer`: such as `LeastSquares()`, `GradientDescent()` or `BFGS()`.
    - `steps`: at most; by default as many as suit the optimizer.
    - `start`: `Unknowns` to go on from, such as `fit.point`; by default the system's values.
    - `checkpoint`: a file in which the state is kept after every step; where it exists the fit goes on from there.
    - `callback`: called with the unknowns and their cost at the start and after every step. `progress`: a progress bar.

    **Returns:** a `Fit` at the best point, with the history of the cost; after an interruption (Ctrl-C) too, and
    `status` says so.

    **Raises:** `TypeError` for what is no optimizer; `ValueError` where a window cannot be simulated with the initial
    guess, or a checkpoint is of another fit.
    """
    if not isinstance(optimizer, Optimizer):
        raise TypeError(f"`optimizer` is such as LeastSquares(), GradientDescent() or BFGS(); got {optimizer!r}.")
    refuse_other(problem, Problem, "minimize", "minimize(fit.problem, LeastSquares())")
    if start is not None:
        _refuse_start_of_another(problem, start)
    steps = optimizer.steps if steps is None else steps
    if not isinstance(steps, int) or steps < 0:
        raise ValueError(f"`steps` is a whole number that is not negative, got {steps!r}.")
    start = problem.start if start is None else start
    key = {} if checkpoint is None else {"method": optimizer.name, **optimizer.checkpoint_key(problem, steps)}
    file, optimizer = Checkpoint(checkpoint, problem, **key), optimizer.with_steps(steps)
    run = _resumed(file, problem, optimizer, start) or _first(problem, optimizer, start, steps)
    first, status = run.now, "steps"
    bar = tqdm(total=steps, initial=len(run.history) - 1, disable=not progress, desc=optimizer.name)
    try:
        if callback:
            callback(run.now.point, run.now.cost)
        for i in range(len(run.history) - 1, steps):
            now = optimizer.step(problem, run.now, i)
            if isinstance(now, str):
                status = now
                break
            run.add(now)
            file.write(point=now.point, state=now.state, best=run.best.point, history=np.array(run.history))
            if callback:
                callback(now.point, now.cost)
            bar.update()
            bar.set_postfix(cost=f"{now.cost:.6g}")
        run.best, status = optimizer.finish(problem, run.best, status)
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return _result(problem, optimizer, run, first, status)


def _refuse_start_of_another(problem: Problem, start: Any) -> None:
    refuse_other(start, Unknowns, "`start=`", "start=fit.point, or change the system's values")
    shapes, own = ([x.shape for x in (u.x, u.b, u.z)] for u in (start, problem.start))
    if shapes != own:
        raise ValueError(
            "`start` is of another problem: its parameters, unknowns of trials and unknown starts have the shapes "
            f"{shapes}; those of this one are {own}. A fit that left trials out has its own `fit.problem`."
        )


@dataclasses.dataclass
class _Run:
    """A search under way."""

    now: Iterate
    best: Iterate
    history: list[float]

    def add(self, now: Iterate) -> None:
        self.now = now
        self.history.append(now.cost)
        if now.cost < self.best.cost:
            self.best = now


def _first(problem: Problem, optimizer: Optimizer, start: Unknowns, steps: int) -> _Run:
    whole = np.array([n for _, _, n in problem.slices])
    for share in optimizer.horizons:
        coarse: Any = dataclasses.replace(optimizer, rtol=1e-3, horizons=())  # type: ignore[type-var]
        part = problem.shortened(np.maximum(2, np.round(share * whole).astype(int)))
        start = minimize(part, coarse, steps=steps, start=start).point
    point, at = solve_nuisance(problem, start)
    now = Iterate(point, at.cost, at, optimizer.init(problem, point, at))
    return _Run(now, now, [at.cost])


def _resumed(file: Checkpoint, problem: Problem, optimizer: Optimizer, start: Unknowns) -> _Run | None:
    """The search as a checkpoint has it; None without one."""
    saved = file.read(point=start, best=start, history=0.0)
    if saved is None:
        return None
    at, at_best = (problem.linearize(saved[name]) for name in ("point", "best"))
    if at is None or at_best is None or not (usable(at) and usable(at_best)):
        raise ValueError(f"{file.path}: the residuals are not finite where this fit was left; delete the file.")
    state = (file.read(state=optimizer.init(problem, saved["point"], at)) or {})["state"]
    now = Iterate(saved["point"], at.cost, at, state)
    return _Run(now, Iterate(saved["best"], at_best.cost, at_best, state), [float(c) for c in saved["history"]])


def _result(problem: Problem, optimizer: Optimizer, run: _Run, first: Iterate, status: str) -> Fit:
    best = run.best
    at = problem.linearize(best.point) if best.at is None else best.at
    if at is None or not usable(at):  # it can be simulated there, but has no derivatives
        best, at, status = first, first.at, status if status == "interrupted" else "stuck"
    assert at is not None
    return Fit.of(problem, best.point, at, run.history, status, optimizer.name)


def uninterrupted(fit: Any) -> Any:
    """A fit that is a part of a study. **Raises:** `KeyboardInterrupt` where Ctrl-C ended it: that ends the study."""
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit
