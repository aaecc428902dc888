"""`fit` and `minimize`: specify the problem, run an optimizer with checkpoints, assemble the `Fit`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from ..._common.lookup import refuse
from ..._scalarjit.compat import on_device
from ..._system.system import System
from ..collocated._fit import Collocation, CollocationFit
from ..problem.declarations import Items
from ..problem.model import Simulation, Unknowns
from ..problem.problem import Problem, finer, residual_deviation
from ..problem.specification import refuse_other, with_options
from ..problem.trial import Trial, trial_names
from ..result.diagnostics import AT_A_MINIMUM
from ..result.fit_result import Fit
from .checkpoints import Checkpoint
from .local_unknowns import Unsimulated, solve_nuisance, usable
from .optimizers import Iterate, LeastSquares, Optimizer
from .variance_components import estimate_errors, estimated_deviations


@with_options
def fit(
    system: System,
    trials: Sequence[Trial] | Trial,
    free: Items,
    *,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
    transcription: Collocation | None = None,
    **options: Any,
) -> Fit | CollocationFit:
    """Estimate parameters of a system from measured trials.

        minimize  sum ((gain * simulated + offset - measured) / sigma)^2

    **Arguments:**

    - `system`: the `System`, with initial guesses of its parameters.
    - `trials`: one `Trial` or several.
    - `free`: the parameters to estimate: names, paths, functions to leaves, `Free`, `Gain`, `Offset`, `Delay`,
        `LowPass` and `Inertia`. With `each="trial"`, each trial has its own value, for example
        `Offset("roll", each="trial", prior=(0.0, 0.02))`.
    - `unknown`: coordinates, independent speeds and first-order states whose initial value in every window is
        estimated too. Pass names, or a dict from names to the standard deviation of a Gaussian prior around the initial
        guess (None: no prior). Dependent coordinates and speeds follow from the others (`assemble`). A measured
        state that is not in `unknown` starts at its first sample. Without `noise`, this sample is taken as exact.
        With `noise`, the filter uses its measurement error. Four unknown Euler parameters are three degrees of freedom.
    - `priors`: by name, (mean, standard deviation) of parameters that were measured independently. Names that are not
        free are ignored.
    - `constraints`: `Linear(...)` and `JointPrior(...)`: prior information about several parameters together.
    - `zero_order_hold`: names of the inputs under a zero-order hold, which keep each sample until the next one. Other
        inputs are interpolated linearly.
    - `window`: the length of a window [s]. The trials are cut into windows with their own initial states (multiple
        shooting), which unstable motions require. A window must have at least two samples, except with `defect_std`. By
        default each trial is one window (single shooting).
    - `defect_std`: by name, the standard deviation of the defect between the end of a window and the start of the next
        one, for names in `unknown`. The defects of other names are not penalized. Small values make the trajectory
        almost continuous. With windows of one sample interval, defects are process noise, and the cost is the sum of
        squares of a Kalman filter's prediction errors.
    - `noise`: by name, spectral densities of the white process noise of independent speeds and states [unit^2/s] and
        of inputs [unit^2 s]. The cost is then minus twice the log likelihood from an extended Kalman filter.
        `SpectralDensity` and `NoiseScale` in `free` estimate these densities and the standard deviations of the
        sensors. With {}, only the sensors are noisy. For names in `unknown`, a standard deviation is that of the
        filter's initial state; initial values without one are estimated. Unstable motions do not require a `window`,
        because the filter follows the measurements.
    - `errors`: an error model for all channels, or a dict by channel: `AutoRegressive()`, `StudentT()` or `Huber()`.
        The parameters of the error models are estimated together with those of the system, by maximum likelihood. The
        errors of other channels are white and normal. The scale of `sigma` is estimated in every channel. With {},
        only the scales are estimated. The cost is minus twice the log likelihood.
    - `simulation`: the settings of the integration, such as `Simulation(rtol=1e-8)` or `Simulation(step=0.01)`.
    - `optimizer`: `LeastSquares()` (default: Levenberg-Marquardt; with `damping=0` Gauss-Newton) or
        `GradientDescent()`.
    - `steps`: the maximum number of steps, as in `minimize`.
    - `start`: the `Unknowns` at which the search starts, as in `minimize`.
    - `checkpoint`: a file from which an interrupted fit can be resumed, as in `minimize`.
    - `callback`: a function of the unknowns and their cost, as in `minimize`.
    - `progress`: whether to show a progress bar.
    - `transcription`: `Collocation(...)` to fit by direct collocation, for long unstable motions and unknown inputs.
        The result is then a `CollocationFit`. `window`, `defect_std`, `noise`, `errors`, `zero_order_hold`,
        `simulation`, `optimizer`, `steps`, `start`, `checkpoint` and `callback` cannot be used with it.

    **Returns:** a `Fit`. Trials that cannot be simulated with the initial guess are excluded. `Fit.failed` and
    `Fit.notes` state the reason for each of them.

    **Raises:** `ValueError` if a trial, a channel, a parameter or a window is invalid, or if no trial can be simulated.
    """
    if transcription is not None:
        refuse_other(transcription, Collocation, "`transcription=`", "transcription=Collocation()")
        run = {"optimizer": optimizer, "steps": steps, "start": start, "checkpoint": checkpoint, "callback": callback}
        used = [name for name, value in run.items() if value is not None]
        if used:
            raise ValueError(f"`{used[0]}` cannot be used with `transcription=Collocation()`. Omit it.")
        return transcription.fit(system, trials, free, progress=progress, **options)
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
    """Run `minimize` without the trials that cannot be simulated."""
    method: Any = LeastSquares() if optimizer is None else optimizer
    if start is not None:
        _refuse_start_of_another(problem, start)
    names, failed = trial_names(problem.trials), {}
    while True:
        try:
            # A checkpoint belongs to the problem without the excluded trials, so these must be found before it is
            # opened. With `horizons` this check is skipped: shorter horizons may lead to parameters with which all
            # trials can be simulated.
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
    return dataclasses.replace(result, failed=failed)


def _again(before: Fit, problem: Problem, method: Any, start: Unknowns, run: dict[str, Any]) -> Fit:
    """Another search, with the history of the ones before."""
    result = search(problem, method, start=start, **run)
    return dataclasses.replace(result, history=(*before.history, *result.history[1:]))


def with_distributions(result: Fit, method: Any, run: dict[str, Any]) -> Fit:
    """Estimate the standard deviations of the distributions over groups and all other unknowns alternately."""
    for _ in range(20 if result.problem.parameters.distributions else 0):
        if result.status not in AT_A_MINIMUM:
            break
        before = result.problem.parameters.deviations
        after = estimated_deviations(result.problem, result.point, result.linearization)
        result = _again(result, result.problem.with_deviations(after), method, result.point, run)
        if np.all(np.abs(np.log(after / before)) < 1e-5):
            break
    return result


def _with_fine_steps(result: Fit, method: Any, run: dict[str, Any]) -> Fit:
    """Repeat the fit with finer integration steps while these change the result and the user gave no step or tolerance.

    If the repeated fit fails, does not converge or is interrupted, the first fit is returned with the status
    "unchecked".
    """
    before = result.problem
    chosen = (before.specification.simulation or Simulation()).chooses or before.chooses_steps
    for _ in range(3):
        if not chosen or result.status not in ("converged", "bound") or not result.too_coarse:
            break
        before, again = result.problem, None
        with contextlib.suppress(KeyboardInterrupt, Unsimulated):
            problem = finer(before, result.point, residual_deviation(before, result.linearization.squares))
            if problem.has_steps and np.array_equal(problem.windows.step, before.windows.step):
                break
            again = _again(result, problem, method, result.point, run)
        if again is None or again.status not in AT_A_MINIMUM:
            return dataclasses.replace(result, status="unchecked")
        result = again
    return result


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
    """Solve a `Problem`. `fit` specifies the problem and solves it.

        minimize(Problem.of(system, trials, free), LeastSquares(rtol=1e-9), steps=200)

    As in `fit`, the search is repeated with finer integration steps if these change the result. The standard deviations
    of distributions over groups are estimated. A sum near its bound is fixed at the bound.

    **Arguments:**

    - `problem`: the `Problem`.
    - `optimizer`: `LeastSquares()`, `GradientDescent()` or another `Optimizer`.
    - `steps`: the maximum number of steps; by default that of the optimizer.
    - `start`: the `Unknowns` at which the search starts, such as `fit.point`; by default the values of the system.
    - `checkpoint`: a file in which the state is saved after every step. If the file exists, the fit is resumed from it.
    - `callback`: a function that is called with the unknowns and their cost, at the start and after every step.
    - `progress`: whether to show a progress bar.

    **Returns:** a `Fit` at the best point, with the history of the cost. After Ctrl-C, `status` is "interrupted".

    **Raises:** `TypeError` if `optimizer` is not an `Optimizer`; `ValueError` if a window cannot be simulated with the
    initial guess, or if the checkpoint belongs to another fit.
    """
    refuse_other(optimizer, Optimizer, "`optimizer=`", "LeastSquares() or GradientDescent()")
    refuse_other(problem, Problem, "minimize", "minimize(fit.problem, LeastSquares())")
    if start is not None:
        _refuse_start_of_another(problem, start)
    steps = optimizer.steps if steps is None else steps
    if not isinstance(steps, int) or steps < 0:
        raise ValueError(f"`steps` must be an integer that is not negative, got {steps!r}.")
    run: dict[str, Any] = {"steps": steps, "callback": callback, "progress": progress}
    result = search(problem, optimizer, start=start, checkpoint=checkpoint, **run)
    # Only the first search has a checkpoint, and only it may restart: the others start near the minimum.
    method: Any = optimizer if optimizer.horizons == () else dataclasses.replace(optimizer, horizons=())  # type: ignore
    result = with_distributions(_with_fine_steps(result, method, run), method, run)
    for _, place in result.parameters.inequalities:
        result = _resting(result, place, method, run)
    return result


def search(
    problem: Problem,
    optimizer: Optimizer,
    *,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> Fit:
    """One search of `minimize`, with the integration steps and the distributions over groups of the problem."""
    steps = optimizer.steps if steps is None else steps
    start = problem.start if start is None else start
    key = {} if checkpoint is None else {"method": optimizer.name, **optimizer.checkpoint_key(problem)}
    file = Checkpoint(checkpoint, problem, **key)
    run = _resumed(file, problem, optimizer, start) or _first(problem, optimizer, start, steps)
    first = run.now
    bar = tqdm(total=steps, initial=len(run.history) - 1, disable=not progress, desc=optimizer.name)

    def report(run: _Run) -> None:
        file.write(point=run.now.point, state=run.now.state, best=run.best.point, history=np.array(run.history))
        if callback:
            callback(run.now.point, run.now.cost)
        bar.update()
        bar.set_postfix(cost=f"{run.now.cost:.6g}")

    try:
        if callback:
            callback(run.now.point, run.now.cost)
        status = _search(problem, optimizer, run, start, steps, report)
        if problem.model.errors is not None:
            problem, run.best, status = estimate_errors(problem, run.best, status, run.history)
    except KeyboardInterrupt:
        status = "interrupted"
    finally:
        bar.close()
    return _result(problem, optimizer, run, first, status)


def _resting(result: Fit, place: int, method: Any, run: dict[str, Any]) -> Fit:
    """Fix the sum of an inequality at its bound, if the sum is near the bound and the cost does not increase.

    The search uses unconstrained variables, so a sum approaches its bound and never reaches it. Near the bound, these
    variables do not influence the cost.
    """
    parameters, point = result.parameters, result.point
    resting = parameters.resting(place, point.parameters)
    if resting is None:
        return result
    fixed, x = resting
    problem = dataclasses.replace(result.problem, model=dataclasses.replace(result.problem.model, parameters=fixed))
    start = dataclasses.replace(point, parameters=on_device(x), meaning=problem.start.meaning)
    with contextlib.suppress(Unsimulated):
        again = _again(result, problem, method, start, run)
        if again.cost <= result.cost + 1e-6 * result.linearization.squares:
            return again
    return result


def _refuse_start_of_another(problem: Problem, start: Any) -> None:
    refuse_other(start, Unknowns, "`start=`", "start=fit.point, or change the system's values")
    shapes, own = ([x.shape for x in (u.parameters, u.trial_unknowns, u.window_starts)] for u in (start, problem.start))
    refuse(
        (
            shapes != own,
            "`start` belongs to another problem: its parameters, unknowns of trials and initial values of windows "
            f"have the shapes {shapes}, but this problem has {own}. If a fit omitted trials, use `fit.problem`.",
        ),
        (
            start.meaning not in ((), problem.start.meaning),
            "`start` belongs to another problem, with other names, initial guesses or scales of its parameters. Pass "
            "values by name: start=problem.at({name: fit.estimates[name], ...}).",
        ),
    )


@dataclasses.dataclass
class _Run:
    now: Iterate
    best: Iterate
    history: list[float]

    def add(self, now: Iterate) -> None:
        self.now = now
        self.history.append(now.cost)
        if now.cost < self.best.cost:
            self.best = now


HORIZONS = 0.1, 0.2, 0.4, 0.7
"""Shares of the windows with which a fit restarts if steps are rejected. Example: a friction model with six parameters
(LuGre) and one window of 800 samples. With these shares, the fit takes 3 steps with the whole window. Without them, it
does not converge in 50 steps."""


def _search(
    problem: Problem,
    optimizer: Optimizer,
    run: _Run,
    start: Unknowns,
    steps: int,
    report: Callable[[_Run], None] = lambda run: None,
) -> str:
    """Iterate until the search ends. **Returns:** the status."""
    for i in range(len(run.history) - 1, steps):
        if optimizer.horizons is None and _is_stiff(problem, run.history):
            with contextlib.suppress(Unsimulated):
                again = _first(problem, dataclasses.replace(optimizer, horizons=HORIZONS), start, steps)  # type: ignore
                if again.now.cost < run.now.cost:
                    run.add(again.now)
        now = optimizer.step(problem, run.now, i)
        if now.ended and now.point is run.now.point:
            return now.ended
        run.add(now)
        report(run)
        if now.ended:
            return now.ended
    return "steps"


def _is_stiff(problem: Problem, history: Sequence[float]) -> bool:
    """Whether the last three steps were rejected, for the first time, in a fit with windows of at least 100 samples.

    The result depends only on the history and the problem. A fit that is resumed from a checkpoint therefore restarts
    at the same step.
    """
    rejected = [a == b == c == d for a, b, c, d in zip(*(history[i:] for i in range(4)), strict=False)]
    long = max(n for _, _, n in problem.slices) >= 100 and problem.model.noise is None
    return long and rejected[-1:] == [True] and sum(rejected) == 1


def _first(problem: Problem, optimizer: Optimizer, start: Unknowns, steps: int) -> _Run:
    whole = np.array([n for _, _, n in problem.slices])
    for share in optimizer.horizons or ():
        # Without `horizons=()`, `_first` would call itself without end. `rtol=1.0`, because only a start for the next
        # share is needed.
        coarse: Any = dataclasses.replace(optimizer, rtol=1.0, horizons=())  # type: ignore[type-var]
        part = problem.shortened(np.maximum(2, np.round(share * whole).astype(int)))
        run = _first(part, coarse, start, steps)
        _search(part, coarse, run, start, steps)
        start = run.best.point
    # A coarse tolerance is sufficient: the parameters will change, so accurate nuisance values are soon outdated.
    point, at = solve_nuisance(problem, start, rtol=0.3)
    now = Iterate(point, at.cost, at, optimizer.init(problem, point, at))
    return _Run(now, now, [at.cost])


def _resumed(file: Checkpoint, problem: Problem, optimizer: Optimizer, start: Unknowns) -> _Run | None:
    saved = file.read(point=start, best=start, history=0.0)
    if saved is None:
        return None
    at, at_best = (problem.linearize(saved[name]) for name in ("point", "best"))
    if at is None or at_best is None or not (usable(at) and usable(at_best)):
        raise ValueError(f"{file.path}: the residuals are not finite at the saved state. Delete the file.")
    state = (file.read(state=optimizer.init(problem, saved["point"], at)) or {})["state"]
    now = Iterate(saved["point"], at.cost, at, state)
    return _Run(now, Iterate(saved["best"], at_best.cost, at_best, state), [float(c) for c in saved["history"]])


def _result(problem: Problem, optimizer: Optimizer, run: _Run, first: Iterate, status: str) -> Fit:
    best = run.best
    at = problem.linearize(best.point) if best.at is None else best.at
    if at is None or not usable(at):  # the simulation succeeds there, but the derivatives are not finite
        best, at, status = first, first.at, status if status == "interrupted" else "stuck"
    assert at is not None
    if status in ("converged", "bound"):
        # A parameter very near its bound does not influence the cost, so its last step does not reveal the bound.
        slopes = np.abs(np.asarray(problem.parameters.slopes(best.point.parameters)))
        rests = (np.count_nonzero(slopes, axis=1) <= 1) & (slopes.sum(axis=1) < 1e-3 * problem.parameters.scale)
        status = "bound" if np.any(rests) else status
    return Fit.of(problem, best.point, at, run.history, status, optimizer.name)


def uninterrupted(fit: Any) -> Any:
    """Return a fit that is part of a study.

    **Raises:** `KeyboardInterrupt` if Ctrl-C ended the fit, to end the study too.
    """
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit
