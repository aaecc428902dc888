"""Newton's method on configuration constraints, by XLA or by NumPy. Knows residuals; knows no names."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from .._description.system import System
from .._scalars.nan import nan_where
from .._scalars.numbers import derivative_in_numbers, in_numbers
from .._scalars.versions import compiled
from .checks import configuration_tolerance, implied_residual
from .description_facts import configuration_residual


def _met(residuals):
    """Which constraints are met."""
    return abs(residuals) <= float(jnp.finfo(residuals.dtype).eps) ** 0.6


def _flat(slopes):
    """Which slopes are no more than rounding."""
    return abs(slopes) <= float(jnp.finfo(slopes.dtype).eps) ** 0.9


def _slopes(system: System, t, q, places: np.ndarray):
    """How the constraints change with what is moved (h, moved)."""
    return jax.jacfwd(lambda dq: configuration_residual(system, t, q.at[places].add(dq)))(
        jnp.zeros(len(places), q.dtype)
    )


class Found(NamedTuple):
    q: Any  # NaN where it is not good
    good: Any  # the constraints are met, and determine what was moved
    remainder: Any  # largest residual
    follows: Any  # largest of those that follow from these
    slope: Any  # smallest singular value of the residuals' derivatives along what was moved
    steps: Any


@compiled
def newton(system: System, q0, t, where: tuple[int, ...], lenient: bool) -> Found:
    places, origin = np.array(where, int), (system, q0, t)
    # What is not finite must not enter the linear solver, which would raise for all members of a batch.
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, q0))]))
    system, q0 = jax.tree.map(lambda x: jnp.where(finite, x, jnp.ones_like(x)), (system, q0))
    start, already_met = _start(system, q0, t, places)
    already_met = already_met & lenient
    n_h = len(already_met)
    if len(places) == n_h and not lenient:
        directions = jnp.eye(n_h, dtype=q0.dtype)
    else:  # (h, moved): along the constraints' gradients only
        directions = _slopes(system, t, start, places)

    def residual(amount, args):
        system, t, start, directions = args
        h = configuration_residual(system, t, start.at[places].add(amount @ directions))
        return jnp.where(already_met, amount, h)

    eps = float(jnp.finfo(q0.dtype).eps)
    solver = optx.Newton(rtol=8 * eps, atol=8 * eps)
    args = (system, t, start, directions)
    solution = optx.root_find(residual, solver, jnp.zeros(n_h, q0.dtype), args, max_steps=_MOST_STEPS, throw=False)
    q = start.at[places].add(solution.value @ directions)
    h = configuration_residual(system, t, q)
    derivatives = jax.jacfwd(residual)(jax.lax.stop_gradient(solution.value), jax.lax.stop_gradient(args))
    slope = jnp.linalg.svd(derivatives, compute_uv=False)[-1]
    follows = jnp.max(jnp.abs(implied_residual(system, t, q)), initial=0.0)
    good = finite & jnp.all(_met(h)) & (slope > eps**0.6) & (follows <= configuration_tolerance(q0.dtype))
    q = nan_where(~good, q, origin)
    return Found(q, good, jnp.max(jnp.abs(h)), follows, slope, solution.stats["num_steps"])


def _start(system: System, q0, t, places: np.ndarray):
    """The initial guess (n_q,), and which constraints (h,) are met already and read nothing of what is moved."""
    q, system = jax.lax.stop_gradient((q0, system))
    here, there = jax.lax.map(lambda q: _slopes(system, t, q, places), jnp.stack([q, _elsewhere(q)]))
    directions = jnp.linalg.svd(here, full_matrices=True)[:2]
    beside, already_met = _of_slopes(jnp, configuration_residual(system, t, q), directions, there)
    return q0.at[places].add(beside.astype(q0.dtype)), already_met


def _elsewhere(q):
    """Coordinates at no special place."""
    return q + np.random.default_rng(0).uniform(0.3, 0.7, q.shape).astype(q.dtype)


def _of_slopes(xp: Any, h, directions, there):
    """What is moved before Newton's method begins (moved,), and which constraints (h,) are met already and read
    nothing of what is moved; from the residuals, U and the singular values of their slopes at the guess, and their
    slopes elsewhere (h, moved). `xp`: NumPy or JAX's.

    Where the slopes of the constraints depend on each other and the residuals contradict that, as for two rods in
    line, Newton's method knows no direction: then it starts beside the guess, in what these constraints read.
    """
    reads = ~_flat(there)  # (h,moved)
    U, s = directions
    unmoved = _flat(xp.concatenate([s, xp.zeros(len(h), s.dtype)])[: len(h)])
    left = U @ xp.where(unmoved, U.T @ h, 0.0)  # of the residuals, what no direction takes away
    beside = xp.any(reads & ~_met(left)[:, None], axis=0)
    return xp.where(beside, 1.0, 0.0), _met(h) & ~xp.any(reads, axis=1)


_MOST_STEPS = 64


def newton_in_numbers(system: System, q0, t, where: tuple[int, ...], lenient: bool) -> Found:
    """`newton` where all numbers are known: the same steps, by NumPy, before XLA would have begun to compile them."""
    system, q0, t = jax.device_get((system, q0, t))
    places, finite = np.array(where, int), all(np.all(np.isfinite(x)) for x in jax.tree.leaves((system, q0)))
    if not finite:
        system, q0 = jax.tree.map(np.ones_like, (system, q0))
    along = np.zeros((len(q0), len(places)), q0.dtype)
    along[places, np.arange(len(places))] = 1.0

    def slopes(q):
        return derivative_in_numbers(configuration_residual, (system, t, q), (None, None, along))

    h = in_numbers(configuration_residual, system, t, q0)
    beside, already_met = _of_slopes(np, h, _svd(slopes(q0)), slopes(_elsewhere(q0)))
    start, already_met = q0 + along @ beside.astype(q0.dtype), already_met & lenient
    n_h = len(already_met)
    directions = np.eye(n_h, dtype=q0.dtype) if len(places) == n_h and not lenient else slopes(start)

    def at(amount):
        """The coordinates, the residuals, and how what Newton's method sees of them changes with the amount."""
        q = start + along @ (amount @ directions)
        h = in_numbers(configuration_residual, system, t, q)
        derivatives = np.where(already_met[:, None], np.eye(n_h, dtype=q0.dtype), slopes(q) @ directions.T)
        return q, h, derivatives

    tolerance, amount, steps = 8 * float(np.finfo(q0.dtype).eps), np.zeros(n_h, q0.dtype), 0
    q, h, derivatives = at(amount)
    while steps < _MOST_STEPS:
        seen = np.where(already_met, amount, h)
        try:
            step = np.linalg.solve(derivatives, seen)
        except np.linalg.LinAlgError:
            break
        amount, steps = amount - step, steps + 1
        q, h, derivatives = at(amount)
        arrived = np.all(np.abs(step) < tolerance * (1 + np.abs(amount))) and np.all(np.abs(seen) < tolerance)
        if arrived or not np.all(np.isfinite(derivatives)):
            break
    slope = _svd(derivatives)[1][-1]
    follows = np.max(np.abs(implied_residual(system, t, q)), initial=0.0)
    good = finite and bool(np.all(_met(h))) and bool(slope > float(np.finfo(q0.dtype).eps) ** 0.6)
    good &= bool(follows <= configuration_tolerance(q0.dtype))
    return Found(jax.device_put(q), good, np.max(np.abs(h)), follows, slope, steps)


def _svd(A):
    """U and the singular values of an array of NumPy, NaN where it is not finite, as JAX has it."""
    if np.all(np.isfinite(A)):
        return np.linalg.svd(A, full_matrices=True)[:2]
    return np.full((len(A), len(A)), np.nan, A.dtype), np.full(min(A.shape), np.nan, A.dtype)
