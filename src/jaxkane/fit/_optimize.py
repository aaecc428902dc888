"""The one loop in which every optimizer runs, and what optimizers share: guesses, steps, checkpoints."""

from __future__ import annotations

import abc
import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from .._common.files import differences
from .._common.lookup import real_number
from .._integrate.trajectory import Status, reason
from ._block_lsq import Eliminated, eliminate
from ._io import described, read_state, tree_of, write_state
from ._linearize import Linearization, linearize, without_start
from ._model import Unknowns
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


def moved(point: Unknowns, x: Array, eliminated: Eliminated) -> Unknowns:
    """The point after a step x of the parameters, with the nuisance values that go with it."""
    z, b = eliminated.others(x)
    return Unknowns(point.x + x, point.b + b, point.z + z)


def usable(at: Linearization | None) -> bool:
    """Whether a step led to finite residuals and derivatives."""
    return at is not None and bool(np.all(at.good))


def uninterrupted(fit: Any) -> Any:
    """A fit that is a part of a study. **Raises:** `KeyboardInterrupt` where Ctrl-C ended it: that ends the study."""
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    return fit


class Unsimulated(ValueError):
    """Windows that cannot be simulated to their end. `reasons`: by the number of their trial, why."""

    def __init__(self, problem: Problem, point: Unknowns, at: Linearization | None, bad: np.ndarray):
        bad = without_start(problem, point) if at is None else bad
        self.reasons: dict[int, str] = {}
        for i in np.flatnonzero(bad):
            (k, first, n), why = problem.places[i], "no consistent start"
            if at is not None:
                status = int(at.status[i])
                why = "not finite" if status == Status.COMPLETED else reason(status, _event_names(problem))
            t = problem.trials[k].t
            self.reasons.setdefault(
                k, f"from {t[first]:g} to {t[first + n - 1]:g} s there are no finite residuals ({why})"
            )
        k, words = next(iter(self.reasons.items()))
        super().__init__(
            f"{problem.trials[k].name}: with the initial guess {words}, as in {int(bad.sum())} of {len(bad)} windows. "
            "Choose shorter windows or other starting values, or leave this stretch out."
        )


def solve_nuisance(
    problem: Problem, point: Unknowns, steps: int = 8, rtol: float = 1e-2
) -> tuple[Unknowns, Linearization]:
    """The nuisance values that fit best with the parameters held: Gauss-Newton, damped where that fails.

    Windows that cannot be simulated to their end with the initial guess (an unstable ride falls over) begin with a
    shorter horizon, which is doubled as soon as it fits. Where that fails for windows that are chained, each is first
    solved for by itself.

    **Raises:** `Unsimulated` that names a window which does not reach its end.
    """
    try:
        return _solved(problem, point, steps, rtol)
    except Unsimulated:
        if not problem.model.nuisance.chained:
            raise
    point, _ = _solved(problem.unchained(), point, steps, rtol)
    return _solved(problem, point, steps, rtol)


def _solved(problem: Problem, point: Unknowns, steps: int, rtol: float) -> tuple[Unknowns, Linearization]:
    whole = np.array([n for _, _, n in problem.places])
    samples = whole.copy()
    at = linearize(problem.shortened(samples), point)
    while at is None or not at.good.all():
        bad = ~at.good if at is not None else np.full(len(whole), True)
        if at is None or np.any(samples[bad] <= 2):
            raise Unsimulated(problem, point, at, bad & (samples <= 2))
        samples = np.where(bad, np.maximum(samples // 2, 2), samples)
        at = linearize(problem.shortened(samples), point)
    stuck = 0
    while True:
        point, at = refined(problem.shortened(samples), point, at, steps if np.all(samples == whole) else 2, rtol)
        if np.all(samples == whole):
            return point, at
        longer = (
            np.minimum(2 * samples, whole) if stuck == 0 else np.minimum(samples + np.maximum(samples // 4, 1), whole)
        )
        tried = linearize(problem.shortened(longer), point)
        bad = ~tried.good if tried is not None else np.full(len(whole), True)
        if np.all(samples[~bad] == longer[~bad]) and bad.any():
            stuck += 1
            if stuck > 2:
                raise Unsimulated(problem, point, tried, bad)
        samples = np.where(bad, samples, longer)
        at = tried if tried is not None and not bad.any() else linearize(problem.shortened(samples), point)
        assert at is not None


def refined(
    problem: Problem, point: Unknowns, at: Linearization, steps: int, rtol: float, enough: float = -np.inf
) -> tuple[Unknowns, Linearization]:
    """The nuisance values after a few Gauss-Newton steps with the parameters held, until these gain less than a part
    `rtol`, or the cost is `enough`.

    Trials then know nothing of one another: each has a damping of its own, and keeps a step only where its own cost
    falls, so that one in which a step leads too far holds up no other.
    """
    still, owner = jnp.zeros_like(point.x), np.asarray(problem.windows.trial)
    damping, before = np.zeros(len(problem.trials)), _by_owner(at, owner, len(problem.trials))
    for _ in range(steps):
        tried = moved(point, still, eliminate(at.blocks, damping))
        there = linearize(problem, tried)
        after = np.full_like(before, np.inf) if there is None else _by_owner(there, owner, len(before))
        better = (after <= before) & (after < np.inf)
        damping = np.where(better, damping / 10, np.maximum(10 * damping, 1e-2))
        gained = float(np.sum(before[better] - after[better]))
        if there is not None and better.any():
            point, at = _chosen(better, owner, (tried, there), (point, at))
            before = np.where(better, after, before)
        done = better | (after <= before + 1e-9 * at.squares)
        if (done.all() and gained <= rtol * at.squares) or at.cost <= enough:
            break
    return point, at


def _by_owner(at: Linearization, owner: np.ndarray, n: int) -> np.ndarray:
    """Costs of trials (T,)."""
    return np.bincount(owner, weights=at.costs, minlength=n)


def _chosen(better: np.ndarray, owner: np.ndarray, new: Any, old: Any) -> tuple[Unknowns, Linearization]:
    """Of two points with the same parameters, and what they were linearized to, the first where a trial is better."""
    (tried, there), (point, at) = new, old

    def of(which: np.ndarray):
        return lambda a, b: jnp.where(jnp.reshape(which, (-1,) + (1,) * (a.ndim - 1)), a, b)

    of_windows = of(better[owner])
    R, seen = of_windows(there.blocks.R, at.blocks.R), jax.tree.map(of_windows, there.seen, at.seen)
    b, z = of(better)(tried.b, point.b), of_windows(tried.z, point.z)
    return Unknowns(point.x, b, z), Linearization(eqx.tree_at(lambda blocks: blocks.R, at.blocks, R), seen)


def _event_names(problem: Problem) -> tuple[str, ...]:
    first = jax.tree.map(lambda x: x[0], problem.windows)
    start = problem.start
    return jax.eval_shape(problem.model.simulate, first, first.start, start.b[0], start.x).events


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
