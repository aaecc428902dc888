"""Optimizers of a fit: their interface, the last step, least squares and gradient descent; and optimal initial states
and trial unknowns for fixed parameters.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree
from numpy.typing import ArrayLike

from ..._common.lookup import real_number
from ..._integrate.events import Status, reason
from ..._scalarjit.compat import on_device
from ..._scalarjit.components import Numbers
from ..._scalarjit.digest import digest
from ..problem.model import Unknowns
from ..problem.problem import Problem
from .linearization import Eliminated, Linearization, eliminate


def moved(point: Unknowns, x: ArrayLike, eliminated: Eliminated) -> Unknowns:
    """The point after a step x of the parameters and the corresponding step of the nuisance values."""
    x = np.asarray(x)
    z, b = eliminated.back_substitute(x)
    before = point.parameters, point.trial_unknowns, point.window_starts
    after = (on_device(np.asarray(old) + step) for old, step in zip(before, (x, b, z), strict=True))
    return Unknowns(*after, meaning=point.meaning)


def usable(at: Linearization | None) -> bool:
    """Whether all residuals and derivatives are finite."""
    return at is not None and bool(np.all(at.good))


class Unsimulated(ValueError):
    """The simulation of some windows fails. `reasons`: by index of the trial, the reason."""

    def __init__(self, problem: Problem, point: Unknowns, at: Linearization | None, bad: np.ndarray):
        bad = problem.without_start(point) if at is None else bad
        first = jax.tree.map(lambda x: x[0], problem.windows)
        arguments = first.start, point.window_starts[0], point.trial_unknowns[0], point.parameters
        events = jax.eval_shape(problem.model.simulate, first, *arguments).events
        self.reasons: dict[int, str] = {}
        for i in np.flatnonzero(bad):
            (k, first, n), why = problem.slices[i], "its initial state cannot satisfy the constraints"
            if at is not None:
                status = int(at.status[i])
                why = "not finite" if status == Status.COMPLETED else reason(status, events)
            t = problem.trials[k].t
            self.reasons.setdefault(
                k, f"the residuals from {t[first]:g} to {t[first + n - 1]:g} s are not finite ({why})"
            )
        k, words = next(iter(self.reasons.items()))
        super().__init__(
            f"{problem.trials[k].name}: with the initial guess {words}, in {int(bad.sum())} of {len(bad)} windows. "
            "Choose shorter windows or other initial guesses, or omit this part of the trial."
        )


def solve_nuisance(
    problem: Problem, point: Unknowns, steps: int = 8, rtol: float = 1e-2
) -> tuple[Unknowns, Linearization]:
    """The optimal nuisance values for fixed parameters, by damped Gauss-Newton steps.

    If the simulation of a window fails with the initial guess (for example, an unstable bicycle falls over), the search
    starts with a shorter horizon. The horizon is doubled after each successful fit. If this fails for linked windows,
    each window is first solved separately.

    **Arguments:**

    - `problem`: the problem.
    - `point`: the parameters, and initial guesses of the nuisance values.
    - `steps`: the maximum number of steps with whole windows.
    - `rtol`: the steps end if they reduce the cost by less than this fraction.

    **Returns:** the point with the optimal nuisance values, and the linearization there.

    **Raises:** `Unsimulated` that names a window whose simulation fails.
    """
    try:
        return _solved(problem, point, steps, rtol)
    except Unsimulated:
        if not problem.model.nuisance.has_defects:
            raise
    point, _ = _solved(problem.without_defects(), point, steps, rtol)
    return _solved(problem, point, steps, rtol)


def _solved(problem: Problem, point: Unknowns, steps: int, rtol: float) -> tuple[Unknowns, Linearization]:
    whole = np.array([n for _, _, n in problem.slices])
    samples = whole.copy()
    at = problem.shortened(samples).linearize(point)
    while at is None or not at.good.all():
        bad = ~at.good if at is not None else np.full(len(whole), True)
        # A window of two samples has one interval and cannot be shortened further.
        if at is None or np.any(samples[bad] <= 2):
            raise Unsimulated(problem, point, at, bad & (samples <= 2))
        samples = np.where(bad, np.maximum(samples // 2, 2), samples)
        at = problem.shortened(samples).linearize(point)
    stuck = 0
    while True:
        # A shortened window only has to lead to a longer one, so two steps are enough.
        point, at = refined(problem.shortened(samples), point, at, steps if np.all(samples == whole) else 2, rtol)
        if np.all(samples == whole):
            return point, at
        # After a failure, a window grows by a quarter: an unstable motion that ends just behind the horizon would fail
        # again if the horizon were doubled.
        longer = (
            np.minimum(2 * samples, whole) if stuck == 0 else np.minimum(samples + np.maximum(samples // 4, 1), whole)
        )
        tried = problem.shortened(longer).linearize(point)
        bad = ~tried.good if tried is not None else np.full(len(whole), True)
        if np.all(samples[~bad] == longer[~bad]) and bad.any():
            stuck += 1
            if stuck > 2:
                raise Unsimulated(problem, point, tried, bad)
        samples = np.where(bad, samples, longer)
        at = tried if tried is not None and not bad.any() else problem.shortened(samples).linearize(point)
        assert at is not None


def refined(
    problem: Problem, point: Unknowns, at: Linearization, steps: int, rtol: float, enough: float = -np.inf
) -> tuple[Unknowns, Linearization]:
    """Improve the nuisance values by a few Gauss-Newton steps with fixed parameters.

    The steps end if they reduce the cost by less than the fraction `rtol`, or if the cost is at most `enough`.

    With fixed parameters, trials are independent. Each trial has its own damping and accepts a step only if its own
    cost decreases. A step that is too long in one trial therefore does not delay the others.
    """
    still, owner = np.zeros_like(point.parameters), np.asarray(problem.windows.trial)
    damping, before = np.zeros(len(problem.trials)), _by_owner(at, owner, len(problem.trials))
    for _ in range(steps):
        tried = moved(point, still, eliminate(at.blocks, damping))
        there = problem.linearize(tried)
        after = np.full_like(before, np.inf) if there is None else _by_owner(there, owner, len(before))
        better = (after <= before) & (after < np.inf)
        damping = np.where(better, damping / 10, np.maximum(10 * damping, 1e-2))
        gained = float(np.sum(before[better] - after[better]))
        if there is not None and better.any():
            point, at = _chosen(better, owner, (tried, there), (point, at))
            before = np.where(better, after, before)
        # At a minimum, rounding errors reject every step of a trial. Such a trial must not keep the loop running.
        done = better | (after <= before + 1e-9 * at.squares)
        if (done.all() and gained <= rtol * at.squares) or at.cost <= enough:
            break
    return point, at


def _by_owner(at: Linearization, owner: np.ndarray, n: int) -> np.ndarray:
    """The cost of each trial (T,)."""
    return np.bincount(owner, weights=at.costs, minlength=n)


def _chosen(
    better: np.ndarray, owner: np.ndarray, new: tuple[Unknowns, Linearization], old: tuple[Unknowns, Linearization]
) -> tuple[Unknowns, Linearization]:
    """Combine two points with the same parameters, and their linearizations: `new` for trials that are better, else
    `old`."""
    (tried, there), (point, at) = new, old

    def of(which: np.ndarray):
        return lambda a, b: on_device(np.where(np.reshape(which, (-1,) + (1,) * (a.ndim - 1)), a, b))

    of_windows = of(better[owner])
    R, seen = of_windows(there.blocks.R, at.blocks.R), jax.tree.map(of_windows, there.prediction, at.prediction)
    b, z = of(better)(tried.trial_unknowns, point.trial_unknowns), of_windows(tried.window_starts, point.window_starts)
    point = Unknowns(point.parameters, b, z, point.meaning)
    return point, Linearization(eqx.tree_at(lambda blocks: blocks.R, at.blocks, R), seen)


@dataclasses.dataclass(frozen=True)
class Iterate:
    """One iterate of a search.

    - `point`: the unknowns.
    - `cost`: the cost at `point`.
    - `at`: the linearization at `point`, or None if the optimizer does not need it.
    - `state`: the state of the optimizer, a tree of arrays. The next step depends on it.
    - `ended`: the status (see `STATUS`) with which the search ends here, or "" if it continues.
    """

    point: Unknowns
    cost: float
    at: Linearization | None
    state: Any
    ended: str = ""


class Optimizer(abc.ABC):
    """The base class of optimizers: a method with its options, as a frozen dataclass without a state."""

    steps: ClassVar[int]
    """The default maximum number of steps."""
    horizons: Sequence[float] | None = ()
    """Shares of every window that are fitted before the whole window; None: chosen if steps are rejected."""

    def __post_init__(self) -> None:
        for name in ("rtol", "damping"):
            label = f"{type(self).__name__}: `{name}`"
            value = real_number(getattr(self, name, 0.0), label)
            if not 0 <= value < float("inf"):
                raise ValueError(f"{label} must be finite and not negative, got {value}.")

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name of the method in tables."""

    def checkpoint_key(self, problem: Problem) -> dict[str, Any]:
        """By name, the options on which the next step depends, besides the problem and the state.

        A fit is resumed from a checkpoint only if they are the same.
        """
        return {}

    @abc.abstractmethod
    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> Any:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate:
        """The iterate after step number `i`, counted from 0."""


def variance_of(problem: Problem, at: Linearization) -> float:
    """The estimated variance of a residual, if `at` is a minimum; 1 with process noise."""
    n_r, n_unknown = problem.size
    return 1.0 if problem.model.noise is not None else at.squares / max(n_r - n_unknown, 1)


def negligible_gain(problem: Problem, at: Linearization, rtol: float) -> float:
    """The reduction of the cost below which a step is the last one: `rtol` times the residual variance.

    The square root of a reduction, in units of the residual variance, is a distance in standard errors. A fraction of
    the cost is not: with 2e5 residuals, a millionth of the cost is half a standard error. If residuals are zero, their
    variance is zero. A reduction is then negligible if rounding or the error of adaptive steps explains it.
    """
    windows, settings = problem.windows, problem.model.settings
    eps = 32 * float(jnp.finfo(windows.measured.dtype).eps)
    eps = eps if settings.step is not None else max(eps, 1e-2 * float(settings.rtol))
    signal = np.linalg.norm(np.asarray(windows.measured) * np.asarray(windows.weight))
    return max(rtol * variance_of(problem, at), (eps * float(signal)) ** 2)


class Proposal(NamedTuple):
    """A step of the linearized problem.

    - `x` (p,): the step of the parameters.
    - `eliminated`: the eliminated nuisance values, whose step follows from `x`.
    - `gain`: the predicted reduction of the sum of squares.
    - `ending`: the status of the fit if this is the last step.
    """

    x: np.ndarray
    eliminated: Eliminated
    gain: float
    ending: str


def proposed(problem: Problem, at: Linearization, damping: float) -> Proposal:
    """The Levenberg-Marquardt step, limited so that no parameter gets too near its bound (`Interval.longest_step`)."""
    eliminated, longest = eliminate(at.blocks, damping), problem.parameters.longest_steps
    x, least = eliminated.step(damping, longest)
    lower, upper = np.isfinite(problem.parameters.bounds).T
    ending = "bound" if np.any((np.abs(x) >= longest) & np.where(x < 0, lower, upper)) else "converged"
    return Proposal(x, eliminated, at.squares - least, ending)


def followed(problem: Problem, now: Iterate, step: Proposal, rtol: float = np.inf, rise: float = 0.0) -> Iterate | None:
    """The iterate after a step; None if the step is rejected.

    A step is rejected if the cost does not decrease, or if the simulation fails.

    **Arguments:**

    - `rtol`: if finite, nuisance values are refined until the reduction is less than this fraction of the cost.
    - `rise`: the increase of the cost below which a step is still accepted.
    """
    at: Any = now.at
    point = moved(now.point, step.x, step.eliminated)
    there: Any = problem.linearize(point)
    has_nuisance = point.trial_unknowns.size + point.window_starts.size > 0
    if has_nuisance and np.isfinite(rtol) and usable(there) and there.cost >= at.cost:
        # Often the parameters are good and only the nuisance values are not, because their step was linearized.
        point, there = refined(problem, point, there, 3, rtol, enough=at.cost - 0.5 * step.gain)
    return Iterate(point, there.cost, there, now.state) if usable(there) and there.cost < at.cost + rise else None


def last_step(problem: Problem, now: Iterate, damping: float, negligible: float) -> Iterate:
    """The iterate after the last step, with its status. If a step with less damping gains more than `negligible`, the
    status is "" and the search continues.

    Damping hides the possible reduction along poorly determined combinations of parameters, so the damping is lowered
    first. For a combination that is determined 1e4 times less well, a damping of 1e-2 would hide all but 1e-4 of the
    reduction.
    """
    after: Iterate | None = None
    for d in (*(d for d in (1e-7, 1e-5, 1e-3) if d < damping), damping):
        step = proposed(problem, now.at, d)  # type: ignore[arg-type]
        # A simulation for a thousandth of a standard error (by default) is not worth the computing time.
        after = followed(problem, now, step) if step.gain > 1e-2 * negligible else None
        if step.gain <= negligible:
            return dataclasses.replace(after or now, ended=step.ending)
        if after is not None:
            return after
    return dataclasses.replace(now, ended="converged")


@dataclasses.dataclass(frozen=True)
class LeastSquares(Optimizer):
    """Levenberg-Marquardt with exact Jacobians; with `damping=0` Gauss-Newton.

        (J^T J + damping^2 diag(J^T J)) d = -J^T r

    The nuisance values of windows and trials are eliminated first. A step therefore takes one simulation of every
    window, with derivatives for its own few unknowns. A solver without elimination, such as that of optimistix,
    differentiates every window with respect to the unknowns of all windows. With 31 windows and 190 unknowns, this is
    twenty times the work.

    If the unconstrained optimum of a parameter lies outside its bound, the parameter approaches the bound until the
    remaining reduction is negligible. The status is then "bound".

    **Arguments:**

    - `rtol`: the search ends after a step with a predicted reduction below this fraction of the residual variance. The
        default 1e-4 is a hundredth of a standard error.
    - `damping`: the initial damping. The damping decreases when the actual reduction agrees with the predicted one, and
        increases otherwise. Gauss-Newton (`damping=0`) is the fastest near the minimum. A rejected step is repeated
        with more damping.
    - `horizons`: shares of every window, such as (0.25, 0.5), that are fitted before the whole window. Use them if the
        simulation with the initial guess fails before the end of a window. By default (None), the whole window is
        fitted. If three successive steps are rejected and windows have at least 100 samples, the fit restarts with the
        shares (0.1, 0.2, 0.4, 0.7). With (), the fit does not restart.
    """

    steps: ClassVar[int] = 50
    rtol: float = 1e-4
    damping: float = 1e-3
    horizons: Sequence[float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for share in self.horizons or ():
            if not 0 < real_number(share, "LeastSquares: each of `horizons`") < 1:
                raise ValueError(f"LeastSquares: each of `horizons` must be between 0 and 1, got {share}.")

    @property
    def name(self) -> str:
        return "Levenberg-Marquardt" if self.damping else "Gauss-Newton"

    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> Array:
        return on_device(self.damping, point.parameters.dtype)

    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate:
        """The next iterate. A rejected step keeps the point and increases the damping."""
        damping, at = float(now.state), now.at
        assert at is not None
        negligible, step = negligible_gain(problem, at, self.rtol), proposed(problem, at, damping)
        if step.gain <= negligible and damping <= 1e-2:
            return last_step(problem, now, damping, negligible)
        after = followed(problem, now, step, rtol=negligible / at.squares) if step.gain > 0 else None
        if after is not None:
            ratio = (at.cost - after.cost) / step.gain
            damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)  # Nielsen's rule
            return dataclasses.replace(after, state=on_device(damping, step.x.dtype))
        undamped = proposed(problem, at, 0.0)
        if undamped.gain <= max(1e-2 * variance_of(problem, at), negligible):
            # The possible reduction is below a tenth of a standard error. The error of adaptive steps is not smooth and
            # can hide such a reduction, so the fit has converged although the step was rejected.
            return dataclasses.replace(now, ended=undamped.ending)
        if not step.gain > 0:  # the predicted reduction of the damped step is lost in rounding
            return dataclasses.replace(now, ended="stuck")
        damping = max(5 * damping, 1e-3)
        return dataclasses.replace(now, state=on_device(damping, step.x.dtype), ended="" if damping <= 1e8 else "stuck")


class DescentState(eqx.Module):
    """The state of gradient descent between two steps.

    - `y` (p,): the displacement in preconditioned coordinates.
    - `directions` (p, p): the preconditioner.
    - `unit`: the unit of `y`, the norm of the first gradient.
    - `of_optax`: the state of the optax optimizer.
    """

    y: Float[Array, " p"]
    directions: Float[Array, "p p"]
    unit: Float[Array, ""]
    of_optax: Any


@dataclasses.dataclass(frozen=True)
class GradientDescent(Optimizer):
    """Gradient descent on half the sum of squares.

        minimize over x  1/2 min over z, b of |residual(x, z, b)|^2

    The unknown initial states z and biases b are solved to first order in every step (variable projection). The
    gradient is therefore that of the best fit for given parameters. The descent is preconditioned so that A^T A is the
    identity for the sensitivity A: x = x0 + (A^T A)^(-1/2) y. A step then has the same statistical meaning for every
    parameter, well or poorly determined.

    A step is halved if it increases the cost, or if the simulation fails. With a `transform`, the cost may increase
    by up to three times the sum of squares.

    **Arguments:**

    - `transform`: an optax optimizer, with its schedule. The unit of y is the first gradient, so learning rates of
        about 0.1 suit Adam. The default (None) is `optax.sgd(1.0)`, preconditioned in every step. This converges in
        about as many steps as Gauss-Newton.
    - `refresh`: the number of steps after which a `transform` is preconditioned again. With None, the parameters are
        only scaled (`Free.scale`).
    - `rtol`: the tolerance, as in `LeastSquares`.
    """

    steps: ClassVar[int] = 100
    transform: optax.GradientTransformation | None = None
    refresh: int | None = 10
    rtol: float = 1e-4

    @property
    def name(self) -> str:
        return "gradient descent"

    @property
    def _optax(self) -> optax.GradientTransformation:
        return _PLAIN if self.transform is None else self.transform

    def checkpoint_key(self, problem: Problem) -> dict[str, Any]:
        y = jnp.zeros_like(problem.start.parameters)
        with jax.numpy_dtype_promotion("standard"):
            program = jax.make_jaxpr(self._optax.update)(y, self._optax.init(y), y)
        return {"refresh": self.refresh, "optimizer": digest(program)}

    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> DescentState:
        y, p = jnp.zeros_like(point.parameters), point.parameters.shape[0]
        return DescentState(y, jnp.eye(p, dtype=y.dtype), jnp.zeros((), y.dtype), self._optax.init(y))

    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate:
        at, state = now.at, now.state
        assert at is not None
        negligible = negligible_gain(problem, at, self.rtol)
        if proposed(problem, at, 1e-3).gain <= negligible:
            return last_step(problem, now, 1e-3, negligible)
        eliminated, refresh = eliminate(at.blocks, 0.0), self.refresh and (self.refresh if self.transform else 1)
        A, r = eliminated.rows
        directions, unit, gradient = np.asarray(state.directions), np.asarray(state.unit), A.T @ r
        if i == 0 or (refresh and i % refresh == 0):
            floor = (1.0 if self.transform else 1e-3) * variance_of(problem, at) ** 0.5
            directions = _directions(A, floor if refresh else None)
        unit = unit if unit > 0 else np.linalg.norm(directions.T @ gradient)
        directions, unit = on_device(directions), on_device(unit)
        step, y, of_optax = _descend(self._optax)(directions, unit, gradient, state.of_optax, state.y)
        new = _guarded(problem, now, np.asarray(step), eliminated, 0.0 if self.transform is None else 3 * at.squares)
        if new is None:
            return dataclasses.replace(now, ended="stuck")
        return dataclasses.replace(new, state=DescentState(y, directions, unit, of_optax))


_PLAIN = optax.sgd(1.0)  # a single object, because a program is compiled for each object


@functools.lru_cache(maxsize=16)
def _descend(transform: optax.GradientTransformation) -> Callable[..., tuple[Array, Array, Any]]:
    """A function for the step of optax: the parameter step, the new preconditioned coordinates, the new state."""

    @jax.jit
    def descend(directions: Numbers, unit: Numbers, gradient: Numbers, of_optax: PyTree, y: Numbers):
        # The schedules of optax mix integers and floats, which JAX rejects if the user has set strict type promotion.
        with jax.numpy_dtype_promotion("standard"):
            updates, of_optax = transform.update(directions.T @ gradient / unit, of_optax, y)
        return unit * directions @ updates, y + updates, of_optax

    return descend


def _directions(A: np.ndarray, floor: float | None) -> np.ndarray:
    """The preconditioner (A^T A)^(-1/2) (p, p).

    The symmetric square root is used, so that the momentum of an optimizer remains valid when the preconditioner is
    updated. Directions with singular values below `floor` are not determined by the data. A step along them is limited
    to about the scale of a parameter.
    """
    if floor is None:
        return np.eye(A.shape[1], dtype=A.dtype) / np.linalg.norm(A)
    _, s, V = np.linalg.svd(A, full_matrices=False)
    floor = max(floor, 1e-6 * float(s[0])) + float(np.finfo(s.dtype).tiny)
    return (V.T / np.sqrt(s**2 + floor**2)) @ V


def _guarded(problem: Problem, now: Iterate, x: np.ndarray, eliminated: Eliminated, rise: float) -> Iterate | None:
    """The iterate after a step that is halved until the cost increases by less than `rise`.

    **Returns:** None if even a thousandth of the step increases the cost by more.
    """
    if np.any(np.abs(x) > problem.parameters.longest_steps):
        # Near a bound the step is shortened. The other parameters must follow the shortened step, not the whole one.
        x = proposed(problem, now.at, 1e-3).x  # type: ignore[arg-type]
    for _ in range(12):
        new = followed(problem, now, Proposal(x, eliminated, 0.0, ""), rtol=1e-2, rise=rise)
        if new is not None:
            return new
        x = x / 2
        # The step of the nuisance values may be the cause of the failure, so it is damped too.
        eliminated = eliminate(now.at.blocks, 1e-2)  # type: ignore[union-attr]
    return None
