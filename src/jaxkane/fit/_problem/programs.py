"""What is compiled: starts, residuals, costs and motions of all windows. Knows a `Model`; knows no trials.

Nothing in a `Model` that is a number is fixed when it is compiled, so that other data, other initial guesses and other
priors of the same shapes run the same program.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._scalars.versions import compiled
from ..._simulation.trajectory import Trajectory
from .._data.windows import Windows
from .blocks import Blocks
from .filtered import Filtered, filtered, information_of, minus_twice_log_likelihood
from .model import Model, Seen, Unknowns


@compiled
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Starts (W, n) and their derivatives (W, n, n_z + n_b + p) by z, b and x."""
    # A program of its own: inside that of the simulation Newton's method would be differentiated a tangent at a time.
    n_b = point.b.shape[1]

    def start_of(arguments):
        window, z = arguments
        start = lambda z, x: model.consistent(window, z, x)  # noqa: E731
        by_z, by_x = jax.jacfwd(start, argnums=(0, 1))(z, point.x)
        return start(z, point.x), jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (windows, point.z))


def jacobian_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of a window, their derivatives (m, n_z + n_b + p), and what was seen."""
    n_z, n_b = z.shape[0], b.shape[0]
    unit = jnp.eye(n_z + n_b + x.shape[0], dtype=z.dtype)
    directions = (start_dot.T, unit[:, :n_z], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        residuals = lambda *unknowns: model.residuals(window, *unknowns)  # noqa: E731
        return jax.jvp(residuals, (start, z, b, x), direction, has_aux=True)

    return jax.vmap(along, out_axes=(None, -1, None))(*directions)


@compiled
def blocks_of(
    model: Model, windows: Windows, by_trial: Array, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Blocks, Seen]:
    """Blocks, and what was seen of every window."""
    n_z, n_b = point.z.shape[1], point.b.shape[1]
    n_next = n_z if model.nuisance.chained else 0

    def window_block(arguments):
        window, z, z_next, b, start, start_dot = arguments
        if model.noise is None:
            r, J, more = jacobian_of(model, window, start, start_dot, z, b, point.x)
        else:
            J, r, value, found = information_of(model, window, start, start_dot, z, b, point.x)
            more = _seen_by_filter(found, value)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        A = jnp.column_stack([J[:, :n_z], links, J[:, n_z:], r + links @ z_next[:n_next]])
        # The triangle says all that the (m, k) matrix says about least squares. QR of NaN is not everywhere NaN.
        bad = ~jnp.all(jnp.isfinite(A))
        A = jnp.concatenate([jnp.where(bad, 0.0, A), jnp.zeros((A.shape[1], A.shape[1]), A.dtype)])
        return jnp.where(bad, jnp.nan, jnp.linalg.qr(A, mode="r")), more

    R, seen = each(window_block, _arguments(windows, point, starts, starts_dot))
    return Blocks(R, by_trial, n_z, n_next, n_b), seen


@compiled
def costs_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> tuple[Array, Seen]:
    """Costs (W,), and what was seen: `blocks_of` without derivatives."""

    def window_cost(arguments):
        window, z, z_next, b, start = arguments
        if model.noise is not None:
            found = filtered(model, window, start, b, point.x)
            priors = model.priors(window, z, b, point.x)
            value = minus_twice_log_likelihood(found, window) + jnp.sum(priors**2)
            return value, _seen_by_filter(found, value)
        r, seen = model.residuals(window, start, z, b, point.x)
        if model.nuisance.chained:
            r = r + by_next(model, window, r.shape[0]) @ z_next
        return jnp.sum(r**2), seen

    return each(window_cost, _arguments(windows, point, starts))


@compiled
def rides_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> Trajectory:
    """The motion of every window, stacked."""
    return each(lambda now: model.simulate(now[0], now[4], now[3], point.x), _arguments(windows, point, starts))


def _seen_by_filter(found: Filtered, value: Array) -> Seen:
    return Seen(found.predicted, found.status, found.deviation, value, found.unknowns)


def _arguments(windows: Windows, point: Unknowns, *more: Array) -> tuple[Any, ...]:
    z_next = jnp.concatenate([point.z[1:], point.z[:1]])
    return windows, point.z, z_next, point.b[windows.trial], *more


def by_next(model: Model, window: Windows, m: int) -> Array:
    """Derivatives (m, n_z) of a window's residuals by the next window's start."""
    n_z, before = window_size(model), window.weight.size
    links = jnp.zeros((m, n_z), window.t.dtype)
    if not model.nuisance.chained:
        return links
    places = jnp.arange(n_z, dtype=jnp.int32)
    return links.at[before + places, places].set(-window.linked / model.nuisance.jump)


def window_size(model: Model) -> int:
    """How many of a window's starting values are unknown."""
    return len(model.nuisance.start)


def each(f: Callable[..., Any], windows: Any) -> Any:
    """`f` of every window."""
    # One ride after another is fastest on a CPU, where a right-hand side is one scalar function; elsewhere all at once.
    batch = None if jax.default_backend() == "cpu" else jax.tree.leaves(windows)[0].shape[0]
    return jax.lax.map(f, windows, batch_size=batch)
