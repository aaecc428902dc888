"""Which coordinates are moved to meet the constraints, and from where. Knows names; solves nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from .._common.lookup import as_names, refuse_unknown
from .._scalarjit.cache_key import Cache, jit
from .._scalarjit.compat import concretely
from .._scalarjit.components import Component
from .._scalarjit.nan import nan_where
from .._system.system import State, System
from .arguments import as_array, check_is_system, check_time, is_concrete
from .checks import check_system
from .constraints import configuration_residual, configuration_tolerance, implied_residual
from .equations import dependent_speeds
from .evaluate import at_random_point, structure_of


class Plan(NamedTuple):
    """Which coordinates are moved, which are `named`, and where some that were not named start.

    `lenient`: a constraint that does not read what is moved is no equation: it only has to be met.
    """

    moved: tuple[str, ...]
    named: tuple[str, ...]
    guess: dict[str, float]
    lenient: bool


def plan_of(system: System, q: Any, free: Sequence[str] | None) -> Plan:
    names = system.coordinates
    named = tuple(q) if isinstance(q, Mapping) else tuple(names)
    quaternions = euler_parameters(system) if isinstance(q, Mapping) else []
    guess = {names[four[3]]: 1.0 for four in quaternions if names[four[3]] not in named}
    if free is not None:
        free = as_names(free)
        refuse_unknown(free, names, f"{type(system).__name__} has no coordinate", "it has")
        return Plan(tuple(c for c in names if c in free), named, guess, lenient=True)
    if system.dependent_coordinates:
        return Plan(tuple(system.dependent_coordinates), named, guess, lenient=False)
    if not isinstance(q, Mapping):
        return Plan(tuple(names), named, guess, lenient=False)
    # Beside a scalar that is named, the axis of a rotation cannot be found: it is zero, or named too.
    still = {names[i] for four in quaternions if names[four[3]] in named for i in four}
    return Plan(tuple(c for c in names if c not in named and c not in still), named, guess, lenient=True)


def found_of(system: System, named: Iterable[str]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Of coordinates in a dict with these names: those that `assemble` moves, and where of those that are left out
    some start that do not start at zero."""
    plan = plan_of(system, dict.fromkeys(named, 0.0), None)
    return plan.moved, plan.guess


_EULER_PARAMETERS = Cache()  # places of Euler parameters by structure


def euler_parameters(system: System) -> list[tuple[int, ...]]:
    """Places of every four coordinates, one after the other, of which a constraint says that their norm is one."""
    return _EULER_PARAMETERS.get(structure_of(system), lambda: _search_euler_parameters(system))


def _search_euler_parameters(system: System) -> list[tuple[int, ...]]:
    rng = np.random.default_rng(0)
    probe = rng.uniform(0.2, 0.9, len(system.coordinates)).astype(jnp.result_type(float))
    with concretely():
        trial = at_random_point((system, np.zeros((), probe.dtype), probe), rng)
        values = np.abs(configuration_residual.numpy(*trial))
    return [
        (i, i + 1, i + 2, i + 3)
        for i, square in enumerate(np.convolve(probe**2, np.ones(4), "valid") if len(probe) > 3 else ())
        if any(np.any(np.abs(values - abs(x)) < 1e-5) for x in (square - 1.0, square**0.5 - 1.0))
    ]


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


@jit
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
        return configuration_residual.numpy_jvp((system, t, q), (None, None, along))

    h = configuration_residual.numpy(system, t, q0)
    beside, already_met = _of_slopes(np, h, _svd(slopes(q0)), slopes(_elsewhere(q0)))
    start, already_met = q0 + along @ beside.astype(q0.dtype), already_met & lenient
    n_h = len(already_met)
    directions = np.eye(n_h, dtype=q0.dtype) if len(places) == n_h and not lenient else slopes(start)

    def at(amount):
        """The coordinates, the residuals, and how what Newton's method sees of them changes with the amount."""
        q = start + along @ (amount @ directions)
        h = configuration_residual.numpy(system, t, q)
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


class NoConfiguration(ValueError):
    """The configuration constraints cannot be met, or not from there."""


def assemble(
    system: System,
    q: Any,
    u: Any = None,
    x: Any = None,
    *,
    t: Component = 0.0,
    free: Sequence[str] | None = None,
) -> State:
    """A state that satisfies the constraints: coordinates found by Newton's method, speeds checked.

        h(t, q) = 0

    **Arguments:**

    - `q` (n_q,), or a dict by name. What is held, and an initial guess of what is moved. Coordinates left out of a dict
        start at zero; of four Euler parameters the last starts at one, so that those left out are no rotation.
    - `u` (n_u,), or a dict by name in which speeds left out are zero: the independent speeds. Dependent speeds may be
        given too, and are then compared with what the residuals say.
    - `x` (n_x,), or a dict by name: states of the first order. Those left out are zero.
    - `t`: time [s], one finite number.
    - `free`: names of the coordinates that are moved. By default `system.dependent_coordinates`; of a system that
        names none, those left out of the dict `q`, or all of an array. Where more are moved than there are constraints,
        the nearest along the constraints' gradients is taken. All others are held.

    **Returns:** a `State`, differentiable (twice, both modes) in everything by the implicit function theorem.

    **Raises:** `ValueError` where no such configuration is found, or given dependent speeds contradict the residuals.
    Under a trace the coordinates, and all their derivatives, become NaN instead.
    """
    check_is_system(system)
    name = type(system).__name__
    check_time(name, t)
    plan = plan_of(system, q, free)
    q0 = as_array(plan.guess | dict(q) if isinstance(q, Mapping) else q, system.coordinates, f"{name}: q")
    given: dict[str, Any] = {}
    if isinstance(u, Mapping):
        given = {speed: u[speed] for speed in system.dependent_speeds if speed in u}
        u = {speed: value for speed, value in u.items() if speed not in given}
    u0 = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q0.dtype)
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{name} has no states of the first order: leave out x, got {x!r}.")
    x0 = as_array({} if x is None else x, system.states, f"{name}: x").astype(q0.dtype) if system.states else None
    given_numbers = [y for y in (q0, u0, x0) if y is not None]
    if is_concrete(given_numbers) and not np.all(np.isfinite(np.concatenate(given_numbers))):
        names = (*system.coordinates, *system.speeds, *system.states)
        bad = [n for n, y in zip(names, np.concatenate(given_numbers), strict=True) if not np.isfinite(y)]
        raise ValueError(f"{name}: {', '.join(bad)} is not finite.")
    q0 = _solve_configuration(system, q0, t, plan)
    if is_concrete(system, q0, u0, t):
        check_system(system, t, q0)
        if given:
            u_dep = dict(zip(system.dependent_speeds, dependent_speeds(system, t, q0, u0), strict=True))
            _check_dependent_speeds(name, given, u_dep)
    return State(q0, u0, x0)


def _solve_configuration(system: System, q0, t, plan: Plan):
    t = jnp.asarray(t if isinstance(t, jax.Array) else np.asarray(t, q0.dtype), dtype=q0.dtype)
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q0).shape[0]
    if n_h == 0:
        return q0
    if len(plan.moved) < n_h and not plan.lenient:
        raise ValueError(
            f"{type(system).__name__}: {n_h} configuration constraints cannot be met by moving {len(plan.moved)} "
            f"coordinates ({', '.join(plan.moved)})."
        )
    places = tuple(system.coordinates.index(c) for c in plan.moved)
    concrete = is_concrete(system, q0, t)
    in_python = concrete and configuration_residual.is_numpy(system, t, q0)
    found = (newton_in_numbers if in_python else newton)(system, q0, t, places, plan.lenient)
    if concrete and not bool(found.good):
        raise NoConfiguration(_why_not(system, q0, plan, found))
    return found.q


def _why_not(system: System, q0, plan: Plan, found: Found) -> str:
    name = type(system).__name__
    moved = ", ".join(plan.moved)
    held = ", ".join(
        f"{c} = {float(x):.4g}"
        for c, x in zip(system.coordinates, q0, strict=True)
        if c not in plan.moved and (x != 0 or (plan.lenient and c in plan.named))
    )
    held = held or "the others zero"
    more = ""
    if plan.lenient:
        more = " What is named is held: leave out what may be moved, or say so with free=(...)."
    if not moved:
        return (
            f"{name}: {held} does not satisfy the configuration constraints (the largest residual is "
            f"{float(found.remainder):.3g}), and nothing is left to be moved.{more}"
        )
    if float(found.follows) > configuration_tolerance(q0.dtype) >= float(found.remainder):
        return (
            f"{name}: the configuration constraints can be met, but what should follow from them is off by "
            f"{float(found.follows):.3g}: with these parameters the loop cannot be closed. The ends of a loop in a "
            "plane are at one height across it."
        )
    if float(found.remainder) < 1e-3 and not float(found.slope) > 1e-6:
        return (
            f"{name}: the configuration constraints do not determine {moved} with {held}: they do not change with it "
            f"(a singular configuration, or constraints that repeat each other). Change what is held.{more}"
        )
    return (
        f"{name}: no {moved} satisfies the configuration constraints with {held}: after {int(found.steps)} Newton "
        f"steps the residual is {float(found.remainder):.3g}. Start from another guess, or change what is held.{more}"
    )


def _check_dependent_speeds(name: str, given: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    for speed, value in given.items():
        value, right = float(value), float(found[speed])
        if not abs(value - right) <= 1e-6 * max(1.0, abs(right)):
            raise ValueError(
                f"{name}: {speed} = {value:.6g} contradicts the velocity constraints, which need {right:.6g} "
                f"(residual {value - right:.3g}). Leave the dependent speeds out: they follow from the others."
            )
