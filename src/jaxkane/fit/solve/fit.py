"""`fit` and `minimize`: specify the problem, run an optimizer with checkpoints, assemble the `Fit`; and the standard
deviations of errors and of distributions over groups, which are estimated together with the parameters.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import scipy.linalg
from scipy import optimize
from tqdm import tqdm

from ..._common.lookup import refuse
from ..._scalarjit.compat import on_device
from ..._system.system import System
from .._collocation import Collocation, CollocationFit
from ..problem.declarations import Items
from ..problem.model import Simulation, Unknowns
from ..problem.problem import Problem, finer, residual_deviation
from ..problem.specification import refuse_other, with_options
from ..problem.trial import Trial, trial_names
from ..result.data import Checkpoint
from ..result.diagnostics import AT_A_MINIMUM
from ..result.fit_result import Fit
from .linearization import Linearization, eliminate, triangle
from .optimizers import Iterate, LeastSquares, Optimizer, Unsimulated, moved, proposed, solve_nuisance, usable


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


def _again(before: Fit, problem: Problem, method: Optimizer, start: Unknowns, run: dict[str, Any]) -> Fit:
    """Another search, with the history of the ones before."""
    result = search(problem, method, start=start, **run)
    return dataclasses.replace(result, history=(*before.history, *result.history[1:]))


def with_distributions(result: Fit, method: Optimizer, run: dict[str, Any]) -> Fit:
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


def _with_fine_steps(result: Fit, method: Optimizer, run: dict[str, Any]) -> Fit:
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
    check_steps: bool = True,
) -> Fit:
    """One search of `minimize`, with the integration steps and the distributions over groups of the problem.

    `check_steps`: whether to estimate the integration error, which takes twice the time of a step of the search.
    """
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
    return _result(problem, optimizer, run, first, status, check_steps)


def _resting(result: Fit, place: int, method: Optimizer, run: dict[str, Any]) -> Fit:
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


def _refuse_start_of_another(problem: Problem, start: Unknowns) -> None:
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


def _result(problem: Problem, optimizer: Optimizer, run: _Run, first: Iterate, status: str, check_steps: bool) -> Fit:
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
    return Fit.of(problem, best.point, at, run.history, status, optimizer.name, check_steps)


def uninterrupted(fit: Fit) -> Any:
    """Return a fit that is part of a study.

    **Raises:** `KeyboardInterrupt` if Ctrl-C ended the fit, to end the study too.
    """
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit


ROUNDS = 50
SETTLED = 1e-8
"""The change of minus twice the log likelihood in one round below which the search ends. It corresponds to a change of
the estimates by about 1e-4 standard errors."""
SMALL_GAIN = 0.01
"""The largest remaining gain at which the search has converged: a tenth of a standard error."""


def estimate_errors(problem: Problem, best: Iterate, status: str, history: list[float]) -> tuple[Problem, Iterate, str]:
    """Alternate between estimating the error models from the residuals and a step of all other unknowns.

    Parameters of the mean and of the covariance are orthogonal in the information matrix, so a few rounds are enough.
    Oberhofer and Kmenta (Econometrica 42, 1974) prove convergence to a stationary point of the joint likelihood. Each
    step is a step of Fisher scoring.

    **Arguments:**

    - `problem`: the problem with the initial error models.
    - `best`: the best iterate of the search with the initial error models.
    - `status`: the status of this search. If it has not converged, the error models are estimated only once.
    - `history`: the list to which the cost of every round is appended.

    **Returns:** the problem with the estimated error models, the iterate, and the status.
    """
    at = best.at if best.at is not None else problem.linearize(best.point)
    if at is None or not usable(at):
        return problem, best, status
    converged, point, ending = status in AT_A_MINIMUM, best.point, "steps"
    try:
        for _ in range(ROUNDS if converged else 1):
            before, estimated = at.cost, _with_estimated_errors(problem, at)
            again = estimated.linearize(point)
            assert again is not None  # the initial states exist, because they do not depend on error models
            gain = proposed(estimated, again, 0.0).gain
            problem, (point, at) = estimated, _step(estimated, point, again) if converged else (point, again)
            best = dataclasses.replace(best, point=point, cost=at.cost, at=at)
            history.append(at.cost)
            rounding = 1e2 * float(np.finfo(at.blocks.R.dtype).eps) * (abs(at.cost) + at.squares)
            if abs(at.cost - before) <= max(SETTLED, rounding):
                ending = status if gain <= max(SMALL_GAIN, rounding) else "stuck"
                break
    except KeyboardInterrupt:
        ending = "interrupted"
    return problem, best, ending if converged else status


def _with_estimated_errors(problem: Problem, at: Linearization) -> Problem:
    assert problem.model.errors is not None
    windows = problem.windows
    weight, measured = np.asarray(windows.weight), np.asarray(windows.measured)
    difference = np.where(weight > 0, (np.asarray(at.simulated) - measured) * weight, 0.0)
    # The scale needs a lower limit: residuals of simulated data are rounding errors, whose likelihood has no maximum.
    size = np.sqrt(np.sum((measured * weight) ** 2, axis=(0, 2)) / np.maximum(np.sum(weight > 0, axis=(0, 2)), 1))
    smallest = np.maximum(1e3 * np.finfo(weight.dtype).eps * size, np.finfo(weight.dtype).tiny ** 0.25)
    errors = problem.model.errors.estimated(difference, weight, smallest)
    return dataclasses.replace(problem, model=dataclasses.replace(problem.model, errors=errors))


def _step(problem: Problem, point: Unknowns, at: Linearization) -> tuple[Unknowns, Linearization]:
    """One step of Fisher scoring, damped if it does not reduce the cost. If no step does, the point is unchanged."""
    for damping in (0.0, 0.1, 1.0, 10.0):
        step = proposed(problem, at, damping)
        tried = moved(point, step.x, step.eliminated)
        there = problem.linearize(tried)
        if there is not None and usable(there) and there.cost <= at.cost:
            return tried, there
        if step.gain <= SMALL_GAIN:  # integration errors hide such a small gain
            break
    return point, at


def estimated_deviations(problem: Problem, point: Unknowns, at: Linearization) -> np.ndarray:
    """The standard deviations (n,) of all distributions, in standard deviations of a residual.

    The restricted likelihood of the model, linearized at the point, is maximized (Lindstrom and Bates, Nonlinear mixed
    effects models for repeated measures data, Biometrics 46, 1990). Up to a constant, minus twice its logarithm is

        nu log C + log det H + 2 sum_j q_j log d_j

    C is the minimum sum of squares for given standard deviations d_j. H is the information about all unknowns. q_j is
    the number of groups. nu is the number of measurements minus the number of unknowns without a distribution. The
    variance of a residual is estimated together with them, as C / nu.
    """
    parameters = problem.parameters
    # With infinite standard deviations, the rows of the distributions are zero. `criterion` adds them with its own.
    infinite, one = (parameters.with_deviations(np.full(len(parameters.distributions), d)) for d in (np.inf, 1.0))
    other_priors = on_device(infinite.prior_rows(point.parameters))
    blocks = eqx.tree_at(lambda blocks: blocks.priors, at.blocks, other_priors)
    data = triangle(np.column_stack(eliminate(blocks, 0.0).rows).astype(float))
    p = parameters.size
    rows = one.prior_rows(point.parameters)[p:].astype(float)
    places = [slice(begin, end) for _, begin, end in parameters.distributions]
    q = np.array([s.stop - s.start for s in places])
    scale = np.linalg.norm(np.concatenate([data, rows]), axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    nu = problem.size[0] - problem.size[1]

    def criterion(logs: np.ndarray) -> tuple[float, np.ndarray]:
        weighed = [np.exp(-log) * rows[s] for log, s in zip(logs, places, strict=True)]
        R = triangle(np.concatenate([data, *weighed]) / scale)
        cost = float((R[p, p] * scale[p]) ** 2)
        to_x = scipy.linalg.solve_triangular(R[:p, :p], np.eye(p), check_finite=False)
        x = -to_x @ R[:p, p]
        value = nu * np.log(cost) + 2 * np.sum(np.log(np.abs(R.diagonal()[:p]))) + 2 * q @ logs
        slopes = []
        for one, number in zip(weighed, q, strict=True):
            A, r = one[:, :p] / scale[:p], one[:, p] / scale[p]
            explained = np.sum((A @ to_x) ** 2)  # tr H^-1 A^T A
            slopes.append(2 * (number - explained - nu * np.sum((A @ x + r) ** 2) * scale[p] ** 2 / cost))
        return float(value), np.array(slopes)

    lower, upper = _limits(data[:p, :p], rows, places)
    along = np.linspace(lower, upper, 41)  # start from a grid: the criterion may be flat far from the minimum
    start = min(along, key=lambda logs: criterion(logs)[0])
    found = optimize.minimize(
        criterion, start, jac=True, method="L-BFGS-B", bounds=[*zip(lower, upper, strict=True)],
        options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 200},
    )  # fmt: skip
    return np.exp(found.x)


def _limits(R: np.ndarray, rows: np.ndarray, places: list[slice]) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of the logarithms of the standard deviations.

    The lower bound is a thousandth of the smallest standard error of a group: the groups do not differ. At the upper
    bound, the groups do not shrink towards the mean.
    """
    covariance = np.linalg.pinv(R.T @ R)
    ends = []
    for s in places:
        A, r = rows[s, :-1], rows[s, -1]
        error = np.sqrt(np.einsum("ki,ij,kj->k", A, covariance, A))
        error = error[error > 0] if np.any(error > 0) else np.ones(1)
        ends.append((np.log(1e-3 * error.min()), np.log(1e3 * (error.max() + np.abs(r).max()))))
    return np.array(ends).T[0], np.array(ends).T[1]
