"""Optimizers of a fit: their interface, least squares, gradient descent, BFGS."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .._common.lookup import real_number
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import on_device
from .._scalarjit.digest import digest
from ._block_lsq import Eliminated, eliminate
from ._linearize import Linearization, half_cost
from ._model import Unknowns
from ._nuisance import moved, refined, solve_nuisance, usable
from ._problem import Problem


@dataclasses.dataclass(frozen=True)
class Iterate:
    """A point of a search, its `cost`, and the problem linearized `at` it, where the optimizer needs that. `state`: a
    tree of arrays, all else that the next step depends on."""

    point: Unknowns
    cost: float
    at: Linearization | None
    state: Any


class Optimizer(abc.ABC):
    """A method and its options: a frozen dataclass, without a state."""

    steps: ClassVar[int]
    """At most, by default."""
    horizons: Sequence[float] = ()
    """Shares of every window that are fitted before the whole."""

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

    def checkpoint_key(self, problem: Problem, steps: int) -> dict[str, Any]:
        """By name, what the next step depends on besides the problem and the state: a checkpoint is resumed only where
        that is the same."""
        return {}

    def with_steps(self, steps: int) -> Optimizer:
        """The same for so many steps at most, where its options follow from that."""
        return self

    @abc.abstractmethod
    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> Any:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate | str:
        """The iterate after step number i, from 0; or the status (see `STATUS`) with which the search ends."""

    def finish(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        """The best iterate, refined at the end, and the status."""
        return best, status


@dataclasses.dataclass(frozen=True)
class LeastSquares(Optimizer):
    """Levenberg-Marquardt with exact Jacobians; with `damping=0` Gauss-Newton.

        (J^T J + damping^2 diag(J^T J)) d = -J^T r

    The nuisance values of windows and trials are eliminated first, so a step costs one simulation of every window with
    its own few derivatives. (A solver that does not know of the blocks, such as optimistix's, differentiates every
    window in the direction of every other window's unknowns: 31 windows with 190 unknowns, twenty times the work.)

    **Arguments:**

    - `rtol`: stop when a step promises to lower the cost by less than this part; or where no step lowers it, and what
        is predicted is less than a tenth of a standard error is worth.
    - `damping`: at the start; it falls where the promise is kept, and rises where it is not. Gauss-Newton is the
        fastest where the initial guess is near; a step that fails is damped until it does not.
    - `horizons`: shares of every window, such as (0.25, 0.5), that are fitted before the whole: for initial guesses
        from which the end of a window cannot be reached.
    """

    steps: ClassVar[int] = 50
    rtol: float = 1e-6
    damping: float = 1e-3
    horizons: Sequence[float] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for share in self.horizons:
            if not 0 < real_number(share, "LeastSquares: each of `horizons`") < 1:
                raise ValueError(f"LeastSquares: `horizons` are shares of a window, between 0 and 1; got {share}.")

    @property
    def name(self) -> str:
        return "Levenberg-Marquardt" if self.damping else "Gauss-Newton"

    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> Array:
        return on_device(self.damping, point.x.dtype)

    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate | str:
        """A step that is refused leaves the point and raises the damping."""
        damping, at = float(now.state), now.at
        assert at is not None
        eliminated = eliminate(at.blocks, damping)
        x, predicted = eliminated.step(damping)
        gain = at.squares - predicted
        # What is left of a cost that vanishes is rounding: a millionth of a standard error.
        if gain <= max(self.rtol * at.squares, 1e-12) and damping <= 1e-2:
            return "converged"
        if gain <= 0:  # all that a damped step promises is lost in rounding
            return "stuck"
        tried = moved(now.point, x, eliminated)
        at_tried = problem.linearize(tried)
        if at_tried is not None and usable(at_tried) and at_tried.cost >= at.cost:
            # Often only the nuisance values, which went along a straight line, are not yet where they belong.
            tried, at_tried = refined(problem, tried, at_tried, 3, self.rtol, enough=at.cost - 0.5 * gain)
        if at_tried is not None and usable(at_tried) and at_tried.cost < at.cost:
            ratio = (at.cost - at_tried.cost) / gain
            # Nielsen's rule: trust more where the promise was kept.
            damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)
            return Iterate(tried, at_tried.cost, at_tried, on_device(damping, x.dtype))
        if _is_refined(problem, at):
            return "converged"
        damping = max(5 * damping, 1e-3)
        return dataclasses.replace(now, state=on_device(damping, x.dtype)) if damping <= 1e8 else "stuck"


def _is_refined(problem: Problem, at: Linearization) -> bool:
    """Whether an undamped step promises no more than a tenth of a standard error is worth. Where such a step is
    refused, errors of integration, which are no smooth function of the unknowns, hide what is left to gain."""
    n_r, n_unknown = problem.size
    known = problem.model.noise is not None or n_r <= n_unknown
    variance = 1.0 if known else at.squares / (n_r - n_unknown)
    return at.squares - eliminate(at.blocks, 0.0).step(0.0)[1] <= 0.01 * variance


class DescentState(eqx.Module):
    """Between two steps: the displacement in the whitened coordinates, those coordinates, their unit, and optax's
    state."""

    y: Float[Array, " p"]
    directions: Float[Array, "p p"]
    unit: Float[Array, ""]
    of_optax: Any


@dataclasses.dataclass(frozen=True)
class GradientDescent(Optimizer):
    """Gradient descent on half the sum of squares.

        minimize over x  1/2 min over z, b of |residual(x, z, b)|^2

    The unknown starts z and biases b are re-solved to first order in every step (variable projection), so the
    gradient is that of the best fit with given parameters. The descent runs in whitened coordinates y, in which A^T A
    = 1 for the sensitivity A, x = x0 + (A^T A)^(-1/2) y: a step means the same for every parameter, however well it is
    known.

    A step whose simulation fails, or which multiplies the cost, is halved until it does not.

    **Arguments:**

    - `transform`: any optax optimizer, with its schedule; by default Nesterov's descent at a rate of 0.3 that falls
        along a cosine over all steps. The unit of y is the way that there seems to be to go, so rates about 0.1 suit
        Adam.
    - `refresh`: how many steps until the coordinates are whitened anew; None for the plainly scaled parameters
        (`Free.scale`) throughout.
    - `rtol`: stop when the linearized problem promises less than this part of the cost.
    """

    steps: ClassVar[int] = 100
    transform: optax.GradientTransformation | None = None
    refresh: int | None = 10
    rtol: float = 1e-6

    @property
    def name(self) -> str:
        return "gradient descent"

    def checkpoint_key(self, problem: Problem, steps: int) -> dict[str, Any]:
        key: dict[str, Any] = {"refresh": self.refresh}
        if self.transform is None:
            return {**key, "optimizer": "default", "steps of its schedule": steps}
        y = jnp.zeros_like(problem.start.x)
        with jax.numpy_dtype_promotion("standard"):
            program = jax.make_jaxpr(self.transform.update)(y, self.transform.init(y), y)
        return {**key, "optimizer": digest(program)}

    def with_steps(self, steps: int) -> GradientDescent:
        if self.transform is not None:
            return self
        rate = optax.cosine_decay_schedule(0.3, max(steps, 1), 0.1)
        return dataclasses.replace(self, transform=optax.sgd(rate, momentum=0.6, nesterov=True))

    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> DescentState:
        assert self.transform is not None
        y, p = jnp.zeros_like(point.x), point.x.shape[0]
        return DescentState(y, jnp.eye(p, dtype=y.dtype), jnp.zeros((), y.dtype), self.transform.init(y))

    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate | str:
        at, state = now.at, now.state
        assert at is not None
        assert self.transform is not None
        eliminated = eliminate(at.blocks, 0.0)
        if _is_minimum(at, eliminated, self.rtol):
            return "converged"
        directions, unit, gradient = np.asarray(state.directions), np.asarray(state.unit), _gradient(eliminated)
        if i == 0 or (self.refresh and i % self.refresh == 0):
            directions = _directions(eliminated, at.squares / problem.size[0] if self.refresh else None)
        unit = unit if unit > 0 else np.linalg.norm(directions.T @ gradient)
        directions, unit = on_device(directions), on_device(unit)
        step, y, of_optax = _descend(self.transform)(directions, unit, gradient, state.of_optax, state.y)
        new = _guarded(problem, now.point, at, step, eliminated)
        if new is None:
            return "stuck"
        point, at_new = new
        return Iterate(point, at_new.cost, at_new, DescentState(y, directions, unit, of_optax))

    def finish(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        point, at = solve_nuisance(problem, best.point, steps=3, rtol=1e-9)
        return (Iterate(point, at.cost, at, best.state) if at.cost <= best.cost else best), status


@functools.lru_cache(maxsize=16)
def _descend(transform: optax.GradientTransformation) -> Callable[..., tuple[Array, Array, Any]]:
    """optax's step: of the parameters, of the whitened coordinates, and its next state."""

    @jax.jit
    def descend(directions, unit, gradient, of_optax, y):
        # optax's schedules mix integers and floats, which a strict user's settings would refuse.
        with jax.numpy_dtype_promotion("standard"):
            updates, of_optax = transform.update(directions.T @ gradient / unit, of_optax, y)
        return unit * directions @ updates, y + updates, of_optax

    return descend


def _gradient(eliminated: Eliminated) -> np.ndarray:
    """Of half the sum of squares, nuisance values following."""
    A, r = eliminated.rows
    return A.T @ r


def _directions(eliminated: Eliminated, variance: float | None) -> np.ndarray:
    """(A^T A)^(-1/2), (p, p): symmetric, so that momentum keeps its meaning when it is made anew."""
    A, _ = eliminated.rows
    if variance is None:
        return np.eye(A.shape[1], dtype=A.dtype) / np.linalg.norm(A)
    _, s, V = np.linalg.svd(A, full_matrices=False)
    # What the data do not determine may not run away: as if every parameter were known to about its scale.
    floor = max(variance**0.5, 1e-6 * float(s[0])) + float(np.finfo(s.dtype).tiny)
    return (V.T / np.sqrt(s**2 + floor**2)) @ V


def _is_minimum(at: Linearization, eliminated: Eliminated, rtol: float) -> bool:
    """Whether the linearized problem promises to lower the cost by less than `rtol` of it."""
    return at.squares - eliminated.step(1e-9)[1] <= max(rtol * at.squares, 1e-12)


def _guarded(problem: Problem, point: Unknowns, at: Linearization, step: Array, eliminated: Eliminated):
    """Where a step leads, halved until it can be simulated; None where even a thousandth cannot."""
    for _ in range(12):
        tried = moved(point, step, eliminated)
        at_tried = problem.linearize(tried)
        if at_tried is not None and usable(at_tried) and at_tried.cost <= at.cost + 3 * at.squares:
            return tried, at_tried
        step = step / 2
        # The nuisance values' own step may be what fails.
        eliminated = eliminate(at.blocks, 1e-2)
    return None


class BFGSState(eqx.Module):
    """The unknowns are origin + unit * y; `of_optimistix` is its solver's state, which is `done`, with or without
    success."""

    origin: Unknowns
    unit: Unknowns
    y: Float[Array, " n"]
    of_optimistix: Any
    done: Bool[Array, ""]
    success: Bool[Array, ""]


@dataclasses.dataclass(frozen=True)
class BFGS(Optimizer):
    """BFGS on half the sum of squares, or another of optimistix's minimisers.

    Parameters, starts and biases are moved together, each in the unit in which the cost is equally curved at the start.
    It knows nothing of squares or blocks and takes many more steps than `LeastSquares`, which is to be preferred: this
    one is for comparison, and for costs that are no sums of squares.

    **Arguments:** `rtol`: stop where a step changes the cost and the unknowns by less than this part. `solver`: by
    default `optimistix.BFGS(rtol, rtol)`.
    """

    steps: ClassVar[int] = 300
    rtol: float = 1e-6
    solver: optx.AbstractMinimiser | None = None

    @property
    def name(self) -> str:
        return type(self._solver).__name__

    @property
    def _solver(self) -> optx.AbstractMinimiser:
        return optx.BFGS(rtol=self.rtol, atol=self.rtol) if self.solver is None else self.solver

    def checkpoint_key(self, problem: Problem, steps: int) -> dict[str, Any]:
        return {"solver": repr(self._solver)}

    def init(self, problem: Problem, point: Unknowns, at: Linearization) -> BFGSState:
        squares = jnp.sum(at.blocks.R**2, axis=(0, 1))
        n_z, n_x, n_b = at.blocks.n_z, at.blocks.n_x, at.blocks.n_b
        # Of each kind of unknown the mean curvature: what has no influence keeps a unit of its own.
        kinds = Unknowns(
            x=squares[-1 - n_x : -1],
            b=squares[-1 - n_x - n_b : -1 - n_x] / len(problem.trials),
            z=squares[:n_z] / len(problem.slices),
        )
        unit = jax.tree.map(
            lambda u, c: jnp.broadcast_to(jnp.where(c > 0, jax.lax.rsqrt(c), 1.0), u.shape), point, kinds
        )
        y = jnp.zeros_like(ravel_pytree(point)[0])
        state = _init(problem.model, problem.windows, problem.by_trial, self._solver, point, unit, y)
        return BFGSState(point, unit, y, state, jnp.asarray(False), jnp.asarray(True))

    def step(self, problem: Problem, now: Iterate, i: int) -> Iterate | str:
        # One step at a time, so that after Ctrl-C the best so far is known: a running program cannot be interrupted.
        if now.state.done:
            return "converged" if now.state.success else "stuck"
        state = _step(problem.model, problem.windows, problem.by_trial, self._solver, now.state)
        point = _unknowns(state.origin, state.unit, state.y)
        return Iterate(point, problem.cost(point), None, state)

    def finish(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        at = problem.linearize(best.point) if best.at is None else best.at
        if at is None or not usable(at):
            return best, status
        to_gain = at.squares - eliminate(at.blocks, 0.0).step(1e-9)[1]
        if status == "converged" and to_gain > 0.01 * at.squares:
            # Steps also become short before what cannot be simulated: no minimum while others would lower the cost.
            status = "stuck"
        return dataclasses.replace(best, cost=at.cost, at=at), status


@jit
def _init(model, windows, by_trial, solver, origin, unit, y):
    f = _scaled(half_cost(model, windows, by_trial), origin, unit)
    return _of_strong_types(solver.init(f, y, None, {}, *jax.eval_shape(f, y, None), frozenset()))


@jit
def _step(model, windows, by_trial, solver, state):
    f = _scaled(half_cost(model, windows, by_trial), state.origin, state.unit)
    y, of_optimistix, _ = solver.step(f, state.y, None, {}, state.of_optimistix, frozenset())
    done, result = solver.terminate(f, y, None, {}, of_optimistix, frozenset())
    success = result == optx.RESULTS.successful
    return _of_strong_types(BFGSState(state.origin, state.unit, y, of_optimistix, done | ~success, success))


def _of_strong_types(state):
    """As it comes back from a file, so that a resumed fit does not compile its step anew."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype) if eqx.is_array(x) else x, state)


def _scaled(f, origin, unit):
    return lambda y, _: (f(_unknowns(origin, unit, y)), None)


def _unknowns(origin: Unknowns, unit: Unknowns, y: Array) -> Unknowns:
    flat, unravel = ravel_pytree(origin)
    return unravel(flat + ravel_pytree(unit)[0] * y)
