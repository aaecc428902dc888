"""The information of a planned trial, as a function of its input that JAX can differentiate. Knows blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._description.system import packed
from .._data.windows import Windows
from .._problem.model import Model, Unknowns
from .._problem.problem import Problem
from .._problem.programs import by_next, each, jacobian_of, starts_of
from .._result.covariance import infinite_along

Goal = Callable[[Any, Model, Windows], tuple[Array, tuple[Array, Windows, Array]]]
"""Of coefficients, model and windows: the criterion, and with it the information about the scaled parameters (p, p),
the windows, and what would be measured (W, n_c, n_t)."""


def goal_of(
    problem: Problem,
    t: Array,
    signals: Callable[[Any, Array], Mapping[str, Array]],
    places: np.ndarray,
    criterion: str,
    limits: Mapping[str, float],
) -> Goal:
    """The criterion of optimal design, as a function that JAX can differentiate."""
    point, chained = problem.start, problem.model.nuisance.chained
    fixed = None if chained else starts_of(problem.model, problem.windows, point)
    bounds = jnp.asarray([limits.get(c, np.inf) for c in problem.channels], t.dtype)
    # Windows take their samples from the trial's; where a sample stands in it does not change.
    where = jnp.searchsorted(t, problem.windows.t_input).clip(0, t.shape[0] - 1)

    def goal(c: Any, model: Model, windows: Windows):
        now, zero = signals(c, t), jnp.zeros_like(t)
        samples = jnp.stack([now.get(name, zero)[where] for name in problem.system.inputs], axis=1)
        windows = eqx.tree_at(lambda w: w.inputs, windows, samples)
        windows = _one_motion(model, windows, point) if chained else windows
        starts, starts_dot = starts_of(model, windows, point) if fixed is None else fixed
        information, simulated = _information(model, windows, point, starts, starts_dot)
        floor = 1e-12 * jnp.trace(information) * jnp.eye(information.shape[0], dtype=information.dtype)
        part = jnp.linalg.inv(information + floor)[places][:, places]
        value = jnp.linalg.slogdet(part)[1] if criterion == "D" else jnp.trace(part)
        excess = jax.nn.relu(jnp.abs(simulated) / bounds[None, :, None] - 1.0)
        return value + 100.0 * jnp.mean(excess**2), (information, windows, simulated)

    return goal


def _one_motion(model: Model, windows: Windows, point: Unknowns) -> Windows:
    """Windows that each begin where the one before ends."""
    first = jax.tree.map(lambda x: x[0], windows)

    def go_on(start: Array, window: Windows) -> tuple[Array, Array]:
        ride = model.simulate(window, start, point.b[0], point.x)
        return packed(ride.state()), start

    end, starts = jax.lax.scan(go_on, model.consistent(first, point.z[0], point.x), windows)
    return eqx.tree_at(lambda w: (w.start, w.next_start), windows, (starts, jnp.append(starts[1:], end[None], axis=0)))


def _information(
    model: Model, windows: Windows, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Array, Array]:
    """About the scaled parameters (p, p), the others eliminated, and what would be measured (W, n_c, n_t).

    By normal equations, whose derivatives, unlike a QR decomposition's, always exist.
    """
    n_z, n_b, p = point.z.shape[1], point.b.shape[1], point.x.shape[0]
    n_next = n_z if model.nuisance.chained else 0

    def of_window(arguments):
        window, z, b, start, start_dot = arguments
        r, J, seen = jacobian_of(model, window, start, start_dot, z, b, point.x)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        J = jnp.column_stack([J[:, :n_z], links, J[:, n_z:]])  # by [z, z_next, b, x]
        return J.T @ J, seen.simulated

    N, simulated = each(of_window, (windows, point.z, point.b[windows.trial], starts, starts_dot))
    # What a window and those before it say about [z_next, b, x] is known of [z, b, x] in the next.
    places = np.r_[:n_next, n_z + n_next : n_z + n_next + n_b + p]

    def go_on(known: Array, N: Array) -> tuple[Array, None]:
        return _without(N.at[places[:, None], places[None, :]].add(known), n_z), None

    known, _ = jax.lax.scan(go_on, jnp.zeros((places.size, places.size), N.dtype), N)
    information = _without(known[n_next:, n_next:], n_b)
    slopes = model.parameters.slopes(point.x)
    to_x = jnp.linalg.solve(slopes, jnp.diag(jnp.linalg.norm(slopes, axis=1)))
    return to_x.T @ information @ to_x, simulated


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Its inverse (p, p), infinite for parameters of which it says nothing."""
    s, V = np.linalg.eigh(information)
    known = s > 1e-11 * s.max()
    return infinite_along((V[:, known] / s[known]) @ V[:, known].T, V[:, ~known].T)


def _without(N: Array, n: int) -> Array:
    """The Schur complement that is left of (k, k) when the first n unknowns are eliminated."""
    if n == 0:
        return N
    first, cross = N[:n, :n], N[:n, n:]
    size = jnp.sqrt(jnp.diagonal(first) + jnp.finfo(N.dtype).tiny)
    first = first / size[:, None] / size[None, :] + 1e-12 * jnp.eye(n, dtype=N.dtype)
    cross = cross / size[:, None]
    return N[n:, n:] - cross.T @ jnp.linalg.solve(first, cross)
