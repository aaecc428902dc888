"""Optimal design of experiments: the Fisher information of a planned trial, and the input that maximizes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree
from tqdm import tqdm

from ..._common.lookup import as_names, refuse_unknown
from ..._scalarjit.compat import filter_jit_uncached
from ..._system.system import System, packed_motion
from ..problem.declarations import Items
from ..problem.model import Model, Unknowns
from ..problem.problem import Problem
from ..problem.trial import Trial
from ..problem.windows import Windows, state_names
from ..solve.linearization import by_next, jacobian_of, map_windows, starts_of
from .data import text_table
from .statistics import infinite_along


@dataclasses.dataclass(frozen=True)
class Design:
    """The result of `design`: a planned experiment and the standard errors it leads to. Print it for a table.

    - `coefficients`: of the input.
    - `inputs`: samples of the input (n_t,) by name.
    - `trial`: the planned trial, with the predicted measurements.
    - `names`: names of the parameters.
    - `covariance` (p, p), `covariance_before` (p, p): of the parameters, for the planned input and for the initial one.
    - `history`: the objective after each step, including the penalty for exceeded limits.
    - `standard_errors`, `correlation`: of the parameters, for noise as in `sigma`. They are those of a fit of `trial`
        with the same options. Infinite without information.
    - `before`: the standard errors for the initial input.
    """

    coefficients: Any
    inputs: dict[str, np.ndarray]
    trial: Trial
    names: tuple[str, ...]
    covariance: np.ndarray
    covariance_before: np.ndarray
    history: tuple[float, ...]

    @property
    def standard_errors(self) -> dict[str, float]:
        return dict(zip(self.names, np.sqrt(self.covariance.diagonal()).tolist(), strict=True))

    @property
    def before(self) -> dict[str, float]:
        return dict(zip(self.names, np.sqrt(self.covariance_before.diagonal()).tolist(), strict=True))

    @property
    def correlation(self) -> np.ndarray:
        return _correlation(self.covariance)

    def __repr__(self) -> str:
        rows = [("parameter", "std. error before", "after", "ratio")]
        for name, after in self.standard_errors.items():
            rows.append((name, f"{self.before[name]:.3g}", f"{after:.3g}", f"{after / self.before[name]:.2f}"))
        largest = (
            np.abs(np.tril(_correlation(C), -1)).max(initial=0.0) for C in (self.covariance_before, self.covariance)
        )
        return "{}\nlargest correlation: {:.3f} before, {:.3f} after".format(text_table(rows), *largest)


def _correlation(covariance: np.ndarray) -> np.ndarray:
    deviation = np.sqrt(covariance.diagonal())
    return covariance / np.outer(deviation, deviation)


def design(
    system: System,
    t: Float[Array, " n_t"],
    inputs: Callable[[Any, Array], Mapping[str, Array]],
    coefficients: PyTree,
    free: Items,
    *,
    sigma: Mapping[str, float],
    initial: Mapping[str, Any] | None = None,
    about: Sequence[str] | None = None,
    criterion: Literal["D", "A"] = "D",
    rms: Mapping[str, float] | None = None,
    limits: Mapping[str, float] | None = None,
    steps: int = 50,
    rate: float = 0.1,
    progress: bool = False,
    **options: Any,
) -> Design:
    """Optimize an input so that a trial is most informative, by gradient descent.

        D: log det C,   A: trace C,   C the covariance of the scaled parameters, nuisance parameters eliminated

    These are the criteria of optimal design (Fedorov, Theory of Optimal Experiments, 1972). The gradient is exact. It
    is computed in forward mode over the forward mode of the sensitivities, so a few dozen coefficients are practical.

    **Arguments:**

    - `system`: a system with the parameter values for which the experiment is optimized.
    - `t` (n_t,): sample times [s].
    - `inputs`: a function (coefficients, t) -> samples (n_t,) by name, written in `jax.numpy`.
    - `coefficients`: any pytree of arrays, the initial guess of the search.
    - `free`: the parameters, as in `fit`.
    - `sigma`: by measured channel, the standard deviation of its noise.
    - `initial`: initial state of the trial.
    - `about`: names of the parameters in the criterion, by default all.
    - `criterion`: "D" or "A".
    - `rms`: by name, root mean squares to which inputs are scaled.
    - `limits`: by channel, the magnitude that it should not exceed.
    - `steps`, `rate`: number of steps and learning rate of Adam.
    - `progress`: whether to show a progress bar.
    - `**options`: as in `fit`, such as `unknown`, `constraints` and `window`. With `window` alone, every window starts
        at `initial`. With `defect_std`, the plan is one trajectory that is divided into windows.

    **Returns:** a `Design` at the best coefficients of the search. Print it for a table.

    **Raises:** `ValueError` for a name that is not free, for another criterion, for the options `noise` and `errors`,
    and for a trial that cannot be simulated.
    """
    t = jnp.asarray(t, jnp.result_type(float))
    if criterion not in ("D", "A"):
        raise ValueError(f"design: `criterion` must be 'D' or 'A', got {criterion!r}.")

    def signals(coefficients: PyTree, t: Array) -> dict[str, Array]:
        samples = dict(inputs(coefficients, t))
        for name, size in (rms or {}).items():
            samples[name] = size * samples[name] / jnp.sqrt(jnp.mean(samples[name] ** 2))
        return samples

    def planned(coefficients: PyTree, measured: Mapping[str, Any]) -> Trial:
        own = {name: np.asarray(x) for name, x in signals(coefficients, t).items()}
        return Trial(t, measured, own, sigma=sigma, initial=initial, name="plan")

    for name in ("noise", "errors"):
        if options.get(name) is not None:
            raise ValueError(
                f"design: `{name}` is not supported, because a design assumes white normal errors. Omit it."
            )
    problem = Problem.of(system, planned(coefficients, {name: np.zeros(t.shape) for name in sigma}), free, **options)
    names, about = problem.parameters.names, as_names(about or (), "about")
    refuse_unknown(about, names, "`about` contains unknown names:", "the free parameters are")
    places = np.array([names.index(name) for name in about or names])
    if problem.model.settings.step is None:
        raise ValueError(
            "design: all `inputs` are constant at the initial coefficients. Pass inputs that vary, or "
            "`Simulation(step=...)`."
        )
    objective = objective_of(problem, t, signals, places, criterion, limits or {})
    first, best, history = _minimized(problem, objective, coefficients, steps, rate, progress)
    scales = np.linalg.norm(np.asarray(problem.parameters.slopes(problem.start.parameters)), axis=1)
    before, after = (
        covariance_of(np.asarray(information)) * np.outer(scales, scales) for _, (information, *_) in (first, best)
    )
    coefficients, (_, windows, simulated) = best
    trial = planned(coefficients, _joined(problem, problem.channels, [*np.asarray(simulated)]))
    if problem.model.nuisance.has_defects:
        # The initial state of every window is that of the trajectory.
        rides = dataclasses.replace(problem, windows=windows).trajectories(problem.start)
        states = [np.concatenate([ride.q, ride.u, ride.x], axis=1).T for ride in rides]
        trial = trial.with_initial_state(_joined(problem, state_names(system), states))
    return Design(coefficients, trial.inputs, trial, names, after, before, history)


def _joined(problem: Problem, names: Sequence[str], of_windows: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Samples of the whole trial by name, from the rows (m, n_t) of its windows."""
    pairs = zip(of_windows, problem.slices, strict=True)
    return dict(zip(names, np.concatenate([rows[:, :n] for rows, (_, _, n) in pairs], axis=1), strict=True))


# The coefficients of one step of the search, and the quantities computed with them (see `Objective`).
_Iterate = tuple[Any, tuple[Array, Windows, Array]]


def _minimized(
    problem: Problem, objective: Objective, coefficients: PyTree, steps: int, rate: float, progress: bool
) -> tuple[_Iterate, _Iterate, tuple[float, ...]]:
    """The first and the best iterate of Adam, and the history of the objective.

    **Raises:** `ValueError` if the plan cannot be simulated at the start.
    """

    @filter_jit_uncached
    def gradient(c: PyTree, model: Model, windows: Windows):
        flat, unravel = ravel_pytree(c)

        def of_flat(flat: Array):
            return objective(unravel(flat), model, windows)

        value, aux = of_flat(flat)
        return value, unravel(jax.jacfwd(of_flat, has_aux=True)(flat)[0]), aux

    adam = optax.adam(optax.cosine_decay_schedule(rate, max(steps, 1), 0.1))
    state, c, history = adam.init(coefficients), coefficients, []
    iterates: list[_Iterate] = []  # the first and the best
    for _ in tqdm(range(steps + 1), disable=not progress, desc="design"):
        value, slope, aux = gradient(c, problem.model, problem.windows)
        if not np.isfinite(float(value)):
            break
        if not history or float(value) < min(history):
            iterates[1:] = [(c, aux)]
        history.append(float(value))
        with jax.numpy_dtype_promotion("standard"):
            updates, state = adam.update(slope, state, c)
            c = optax.apply_updates(c, updates)
    if not history:
        raise ValueError(
            "design: with the initial coefficients, the simulation fails or the data have no information about the "
            "parameters. Pass other coefficients."
        )
    return iterates[0], iterates[-1], tuple(history)


# A function of coefficients, model and windows. It returns the objective, and a tuple of the information about the
# scaled parameters (p, p), the windows, and the predicted measurements (W, n_c, n_t).
Objective = Callable[[Any, Model, Windows], tuple[Array, tuple[Array, Windows, Array]]]


def objective_of(
    problem: Problem,
    t: Array,
    signals: Callable[[Any, Array], Mapping[str, Array]],
    places: np.ndarray,
    criterion: str,
    limits: Mapping[str, float],
) -> Objective:
    """The criterion of optimal design plus a penalty for exceeded limits, as a function that JAX can differentiate."""
    point, is_one_motion = problem.start, problem.model.nuisance.has_defects
    # Only linked windows start at states that depend on the input. The others are computed once, outside the search.
    fixed = None if is_one_motion else starts_of(problem.model, problem.windows, point)
    bounds = jnp.asarray([limits.get(c, np.inf) for c in problem.channels], t.dtype)
    # Indices of the samples of the windows in the samples of the trial. They do not depend on the coefficients.
    sample = jnp.searchsorted(t, problem.windows.t_input).clip(0, t.shape[0] - 1)

    def objective(coefficients: PyTree, model: Model, windows: Windows):
        inputs, zero = signals(coefficients, t), jnp.zeros_like(t)
        samples = jnp.stack([inputs.get(name, zero)[sample] for name in problem.system.inputs], axis=1)
        windows = eqx.tree_at(lambda w: w.inputs, windows, samples)
        windows = _one_motion(model, windows, point) if is_one_motion else windows
        starts, starts_dot = starts_of(model, windows, point) if fixed is None else fixed
        information, simulated = _information(model, windows, point, starts, starts_dot)
        # Without the floor, a parameter without information makes the first value infinite, and the search cannot
        # start.
        floor = 1e-12 * jnp.trace(information) * jnp.eye(information.shape[0], dtype=information.dtype)
        covariance = jnp.linalg.inv(information + floor)[places][:, places]
        value = jnp.linalg.slogdet(covariance)[1] if criterion == "D" else jnp.trace(covariance)
        excess = jax.nn.relu(jnp.abs(simulated) / bounds[None, :, None] - 1.0)
        return value + 100.0 * jnp.mean(excess**2), (information, windows, simulated)

    return objective


def _one_motion(model: Model, windows: Windows, point: Unknowns) -> Windows:
    """Windows that each start where the previous one ends."""
    first = jax.tree.map(lambda x: x[0], windows)

    def step(start: Array, window: Windows) -> tuple[Array, Array]:
        ride = model.simulate(window, start, point.window_starts[0], point.trial_unknowns[0], point.parameters)
        return packed_motion(ride.state()), start

    end, starts = jax.lax.scan(step, model.consistent(first, point.window_starts[0], point.parameters), windows)
    return eqx.tree_at(lambda w: (w.start, w.next_start), windows, (starts, jnp.append(starts[1:], end[None], axis=0)))


def _information(
    model: Model, windows: Windows, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Array, Array]:
    """Information about the scaled parameters (p, p), the other unknowns eliminated, and the predicted measurements (W,
    n_c, n_t).

    It is computed from normal equations. In contrast to a QR decomposition, these are always differentiable.
    """
    n_z, n_b, p = point.window_starts.shape[1], point.trial_unknowns.shape[1], point.parameters.shape[0]
    n_next = n_z if model.nuisance.has_defects else 0

    def of_window(arguments: PyTree):
        window, z, b, start, start_dot = arguments
        r, J, prediction = jacobian_of(model, window, start, start_dot, z, b, point.parameters)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        J = jnp.column_stack([J[:, :n_z], links, J[:, n_z:]])  # by [z, z_next, b, x]
        return J.T @ J, prediction.simulated

    N, simulated = map_windows(
        of_window, (windows, point.window_starts, point.trial_unknowns[windows.trial], starts, starts_dot)
    )
    # The accumulated information about [z_next, b, x] of a window is the prior information about [z, b, x] of the next.
    places = np.r_[:n_next, n_z + n_next : n_z + n_next + n_b + p]

    def step(known: Array, N: Array) -> tuple[Array, None]:
        return _schur_complement(N.at[places[:, None], places[None, :]].add(known), n_z), None

    known, _ = jax.lax.scan(step, jnp.zeros((places.size, places.size), N.dtype), N)
    priors = model.parameters.prior_rows(point.parameters)[:, :-1]
    information = _schur_complement(known[n_next:, n_next:], n_b) + priors.T @ priors
    slopes = model.parameters.slopes(point.parameters)
    to_x = jnp.linalg.solve(slopes, jnp.diag(jnp.linalg.norm(slopes, axis=1)))
    return to_x.T @ information @ to_x, simulated


def covariance_of(information: np.ndarray) -> np.ndarray:
    """The inverse (p, p), with infinite variances of parameters about which there is no information."""
    s, V = np.linalg.eigh(information)
    known = s > 1e-11 * s.max()
    return infinite_along((V[:, known] / s[known]) @ V[:, known].T, V[:, ~known].T)


def _schur_complement(N: Array, n: int) -> Array:
    """The information (k, k) with the first n unknowns eliminated."""
    if n == 0:
        return N
    first, cross = N[:n, :n], N[:n, n:]
    size = jnp.sqrt(jnp.diagonal(first) + jnp.finfo(N.dtype).tiny)
    first = first / size[:, None] / size[None, :] + 1e-12 * jnp.eye(n, dtype=N.dtype)
    cross = cross / size[:, None]
    return N[n:, n:] - cross.T @ jnp.linalg.solve(first, cross)
