"""Assembly: a state that meets the configuration constraints, by Newton's method.

Newton's method stands here twice. Where all numbers are known it runs by NumPy, long before XLA would have compiled it;
under a trace it is optimistix's, whose derivatives are those of the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from .kanes_method import at_random_point, structure_of


class AssemblyProblem(NamedTuple):
    """Which coordinates are moved, which are `named`, and the initial guess of some that are not.

    `lenient`: a constraint that does not read what is moved is no equation: it only has to be met.
    """

    moved: tuple[str, ...]
    named: tuple[str, ...]
    guess: dict[str, float]
    lenient: bool

    @classmethod
    def of(cls, system: System, q: Any, free: Sequence[str] | None = None) -> AssemblyProblem:
        names = tuple(system.coordinates)
        named = tuple(q) if isinstance(q, Mapping) else names
        quaternions = euler_parameters(system) if isinstance(q, Mapping) else []
        guess = {names[four[3]]: 1.0 for four in quaternions if names[four[3]] not in named}
        if free is not None:
            free = as_names(free)
            refuse_unknown(free, names, f"{type(system).__name__} has no coordinate", "it has")
            return cls(tuple(c for c in names if c in free), named, guess, lenient=True)
        if system.dependent_coordinates:
            return cls(tuple(system.dependent_coordinates), named, guess, lenient=False)
        if not isinstance(q, Mapping):
            return cls(names, named, guess, lenient=False)
        # Beside a scalar that is named, the axis of a rotation is not determined: it is zero, or named too.
        still = {names[i] for four in quaternions if names[four[3]] in named for i in four}
        return cls(tuple(c for c in names if c not in named and c not in still), named, guess, lenient=True)


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


def _is_met(residuals):
    return abs(residuals) <= float(jnp.finfo(residuals.dtype).eps) ** 0.6


def _is_flat(slopes):
    """Which slopes are rounding alone."""
    return abs(slopes) <= float(jnp.finfo(slopes.dtype).eps) ** 0.9


def _slopes(system: System, t, q, places: np.ndarray):
    """How the constraints change with what is moved (h, moved)."""
    along = jnp.zeros(len(places), q.dtype)
    return jax.jacfwd(lambda dq: configuration_residual(system, t, q.at[places].add(dq)))(along)


class NewtonResult(NamedTuple):
    q: Any  # NaN where it has not converged
    converged: Any  # the constraints are met, and determine what was moved
    remainder: Any  # largest residual
    implied: Any  # largest residual of those that follow from these
    slope: Any  # smallest singular value of the residuals' derivatives along what was moved
    steps: Any


def _result(xp: Any, system: System, t, q, h, slope, steps, finite) -> NewtonResult:
    implied = xp.max(xp.abs(implied_residual(system, t, q)), initial=0.0)
    is_met = xp.all(_is_met(h)) & (implied <= configuration_tolerance(q.dtype))
    is_determined = slope > float(jnp.finfo(q.dtype).eps) ** 0.6
    return NewtonResult(q, finite & is_met & is_determined, xp.max(xp.abs(h)), implied, slope, steps)


@jit
def newton(system: System, q0, t, where: tuple[int, ...], lenient: bool) -> NewtonResult:
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
    solution = optx.root_find(residual, solver, jnp.zeros(n_h, q0.dtype), args, max_steps=_MAX_STEPS, throw=False)
    q = start.at[places].add(solution.value @ directions)
    h = configuration_residual(system, t, q)
    derivatives = jax.jacfwd(residual)(jax.lax.stop_gradient(solution.value), jax.lax.stop_gradient(args))
    slope = jnp.linalg.svd(derivatives, compute_uv=False)[-1]
    result = _result(jnp, system, t, q, h, slope, solution.stats["num_steps"], finite)
    return result._replace(q=nan_where(~result.converged, q, origin))


def _start(system: System, q0, t, places: np.ndarray):
    """The initial guess (n_q,), and which constraints (h,) are met already and read nothing of what is moved."""
    q, system = jax.lax.stop_gradient((q0, system))
    at_q, at_random = jax.lax.map(lambda q: _slopes(system, t, q, places), jnp.stack([q, _random_q(q)]))
    directions = jnp.linalg.svd(at_q, full_matrices=True)[:2]
    offset, already_met = _offset(jnp, configuration_residual(system, t, q), directions, at_random)
    return q0.at[places].add(offset.astype(q0.dtype)), already_met


def _random_q(q):
    return q + np.random.default_rng(0).uniform(0.3, 0.7, q.shape).astype(q.dtype)


def _offset(xp: Any, h, directions, at_random):
    """By how much Newton's method begins beside the guess (moved,), and which constraints (h,) are met already and read
    nothing of what is moved; from the residuals, U and the singular values of their slopes at the guess, and their
    slopes at a random point (h, moved). `xp`: NumPy or JAX's.

    Where the slopes of the constraints depend on each other and the residuals contradict that, as for two rods in
    line, Newton's method knows no direction: then it starts beside the guess, in what these constraints read.
    """
    reads = ~_is_flat(at_random)  # (h,moved)
    U, s = directions
    unmoved = _is_flat(xp.concatenate([s, xp.zeros(len(h), s.dtype)])[: len(h)])
    rest = U @ xp.where(unmoved, U.T @ h, 0.0)  # of the residuals: no direction takes it away
    offset = xp.any(reads & ~_is_met(rest)[:, None], axis=0)
    return xp.where(offset, 1.0, 0.0), _is_met(h) & ~xp.any(reads, axis=1)


_MAX_STEPS = 64


def newton_in_numbers(system: System, q0, t, where: tuple[int, ...], lenient: bool) -> NewtonResult:
    """`newton` where all numbers are known: the same steps, by NumPy."""
    system, q0, t = jax.device_get((system, q0, t))
    places, finite = np.array(where, int), all(np.all(np.isfinite(x)) for x in jax.tree.leaves((system, q0)))
    if not finite:
        system, q0 = jax.tree.map(np.ones_like, (system, q0))
    along = np.zeros((len(q0), len(places)), q0.dtype)
    along[places, np.arange(len(places))] = 1.0

    def slopes(q):
        return configuration_residual.numpy_jvp((system, t, q), (None, None, along))

    h = configuration_residual.numpy(system, t, q0)
    offset, already_met = _offset(np, h, _svd(slopes(q0)), slopes(_random_q(q0)))
    start, already_met = q0 + along @ offset.astype(q0.dtype), already_met & lenient
    n_h = len(already_met)
    directions = np.eye(n_h, dtype=q0.dtype) if len(places) == n_h and not lenient else slopes(start)

    def at(amount):
        """The coordinates, the residuals, and the derivatives of the equations by the amount."""
        q = start + along @ (amount @ directions)
        h = configuration_residual.numpy(system, t, q)
        derivatives = np.where(already_met[:, None], np.eye(n_h, dtype=q0.dtype), slopes(q) @ directions.T)
        return q, h, derivatives

    tolerance, amount, steps = 8 * float(np.finfo(q0.dtype).eps), np.zeros(n_h, q0.dtype), 0
    q, h, derivatives = at(amount)
    while steps < _MAX_STEPS:
        equations = np.where(already_met, amount, h)
        try:
            step = np.linalg.solve(derivatives, equations)
        except np.linalg.LinAlgError:
            break
        amount, steps = amount - step, steps + 1
        q, h, derivatives = at(amount)
        is_small = np.all(np.abs(step) < tolerance * (1 + np.abs(amount)))
        if (is_small and np.all(np.abs(equations) < tolerance)) or not np.all(np.isfinite(derivatives)):
            break
    result = _result(np, system, t, q, h, _svd(derivatives)[1][-1], steps, finite)
    return result._replace(q=jax.device_put(q))


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
    """A state that satisfies the constraints: coordinates by Newton's method, speeds checked.

        h(t, q) = 0

    **Arguments:**

    - `q` (n_q,), or a dict by name. The coordinates that stay, and an initial guess of those that are moved. Those left
        out of a dict start at zero; of four Euler parameters the last starts at one, so that they are no rotation.
    - `u` (n_u,), or a dict by name in which speeds left out are zero: the independent speeds. Dependent speeds may be
        given too, and are then compared with what the residuals say.
    - `x` (n_x,), or a dict by name: states of the first order. Those left out are zero.
    - `t`: time [s], one finite number.
    - `free`: names of the coordinates that are moved. By default `system.dependent_coordinates`; of a system that
        names none, those left out of the dict `q`, or all of an array. Where more are moved than there are constraints,
        the nearest along the constraints' gradients is taken. All others stay.

    **Returns:** a `State`, differentiable (twice, both modes) in everything by the implicit function theorem.

    **Raises:** `ValueError` where there is no such configuration, or given dependent speeds contradict the residuals.
    Under a trace the coordinates, and all their derivatives, become NaN instead.
    """
    check_is_system(system)
    name = type(system).__name__
    check_time(name, t)
    problem = AssemblyProblem.of(system, q, free)
    q0 = as_array(problem.guess | dict(q) if isinstance(q, Mapping) else q, system.coordinates, f"{name}: q")
    u_dep: dict[str, Any] = {}
    if isinstance(u, Mapping):
        u_dep = {speed: u[speed] for speed in system.dependent_speeds if speed in u}
        u = {speed: value for speed, value in u.items() if speed not in u_dep}
    u0 = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q0.dtype)
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{name} has no states of the first order: leave out x, got {x!r}.")
    x0 = as_array({} if x is None else x, system.states, f"{name}: x").astype(q0.dtype) if system.states else None
    parts = [y for y in (q0, u0, x0) if y is not None]
    if is_concrete(parts):
        names = (*system.coordinates, *system.speeds, *system.states)
        bad = [n for n, y in zip(names, np.concatenate(parts), strict=True) if not np.isfinite(y)]
        if bad:
            raise ValueError(f"{name}: {', '.join(bad)} is not finite.")
    q0 = _solve_configuration(system, q0, t, problem)
    if is_concrete(system, q0, u0, t):
        check_system(system, t, q0)
        if u_dep:
            _check_dependent_speeds(system, u_dep, dependent_speeds(system, t, q0, u0))
    return State(q0, u0, x0)


def _solve_configuration(system: System, q0, t, problem: AssemblyProblem):
    t = jnp.asarray(t if isinstance(t, jax.Array) else np.asarray(t, q0.dtype), dtype=q0.dtype)
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q0).shape[0]
    if n_h == 0:
        return q0
    if len(problem.moved) < n_h and not problem.lenient:
        raise ValueError(
            f"{type(system).__name__}: {n_h} configuration constraints cannot be met by moving {len(problem.moved)} "
            f"coordinates ({', '.join(problem.moved)})."
        )
    places = tuple(system.coordinates.index(c) for c in problem.moved)
    concrete = is_concrete(system, q0, t)
    in_python = concrete and configuration_residual.is_numpy(system, t, q0)
    result = (newton_in_numbers if in_python else newton)(system, q0, t, places, problem.lenient)
    if concrete and not bool(result.converged):
        raise NoConfiguration(_why_not(system, q0, problem, result))
    return result.q


def _why_not(system: System, q0, problem: AssemblyProblem, result: NewtonResult) -> str:
    name = type(system).__name__
    moved = ", ".join(problem.moved)
    fixed = ", ".join(
        f"{c} = {float(x):.4g}"
        for c, x in zip(system.coordinates, q0, strict=True)
        if c not in problem.moved and (x != 0 or (problem.lenient and c in problem.named))
    )
    fixed = fixed or "the others zero"
    hint = " What is named is held: leave out what may be moved, or name it by free=(...)." if problem.lenient else ""
    if not moved:
        return (
            f"{name}: {fixed} does not satisfy the configuration constraints (the largest residual is "
            f"{float(result.remainder):.3g}), and nothing is left to be moved.{hint}"
        )
    if float(result.implied) > configuration_tolerance(q0.dtype) >= float(result.remainder):
        return (
            f"{name}: the configuration constraints can be met, but what should follow from them is off by "
            f"{float(result.implied):.3g}: with these parameters the loop cannot be closed. The ends of a loop in a "
            "plane are at one height across it."
        )
    if float(result.remainder) < 1e-3 and not float(result.slope) > 1e-6:
        return (
            f"{name}: the configuration constraints do not determine {moved} with {fixed}: they do not change with it "
            f"(a singular configuration, or constraints that repeat each other). Change what is held.{hint}"
        )
    return (
        f"{name}: no {moved} satisfies the configuration constraints with {fixed}: after {int(result.steps)} Newton "
        f"steps the residual is {float(result.remainder):.3g}. Start from another guess, or change what is held.{hint}"
    )


def _check_dependent_speeds(system: System, given: Mapping[str, Any], u_dep: Any) -> None:
    required = dict(zip(system.dependent_speeds, map(float, u_dep), strict=True))
    for speed, value in given.items():
        value, needed = float(value), required[speed]
        if not abs(value - needed) <= 1e-6 * max(1.0, abs(needed)):
            raise ValueError(
                f"{type(system).__name__}: {speed} = {value:.6g} contradicts the velocity constraints, which need "
                f"{needed:.6g} (residual {value - needed:.3g}). Leave the dependent speeds out: they follow from the "
                "others."
            )
