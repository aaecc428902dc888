"""Assembly: compute a state that satisfies the configuration constraints, by Newton's method."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree

from .._common.lookup import as_names, refuse_any, refuse_unknown
from .._scalarjit.cache import Cache
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import concretely
from .._scalarjit.components import Component, Numbers
from .._scalarjit.nan import nan_where
from .._system.system import State, System, with_class
from .api import constraint_jacobian, dependent_speeds, diagnosis
from .arguments import Coordinates, as_array, check_is_system, check_time, has_multipliers, is_concrete
from .checks import check_system
from .constraint_residuals import (
    configuration_residual,
    configuration_tolerance,
    implied_residual,
    n_configuration_constraints,
    residual_sizes,
    scales_along,
    scales_by_unit,
    violations,
)
from .contact.checks import check_contacts
from .contact.forces import ContactRows, layout_of, speeds_in_contact
from .contact.impulses import REDUNDANT
from .description import at_random_point, structure_of
from .kanes_method import KaneEquations
from .scaling import SMALLEST_SIZE


class AssemblyProblem(NamedTuple):
    """Which coordinates are solved for, and the initial guess.

    - `moved`: names of the coordinates that are solved for.
    - `named`: names of the coordinates that the caller has passed.
    - `guess`: initial values by name, for omitted coordinates that do not start at zero.
    - `lenient`: whether a constraint that does not depend on the `moved` coordinates is only checked, not solved.
    """

    moved: tuple[str, ...]
    named: tuple[str, ...]
    guess: dict[str, float]
    lenient: bool

    @classmethod
    def of(cls, system: System, q: Numbers, free: Sequence[str] | None = None) -> AssemblyProblem:
        names = tuple(system.coordinates)
        named = tuple(q) if isinstance(q, Mapping) else names
        quaternions = euler_parameters(system) if isinstance(q, Mapping) else []
        guess = {names[four[3]]: 1.0 for four in quaternions if names[four[3]] not in named}
        if free is not None:
            free = as_names(free, "free")
            refuse_unknown(free, names, f"{type(system).__name__} has no coordinate", "it has")
            return cls(tuple(c for c in names if c in free), named, guess, lenient=True)
        left_out = [c for c in names if c not in named]
        is_named = any(c in named for c in system.dependent_coordinates)
        # Named dependent coordinates are fixed, and omitted ones are solved for, unless all relevant ones are named.
        if system.dependent_coordinates and not (left_out and is_named and _reads_any(system, left_out)):
            return cls(tuple(system.dependent_coordinates), named, guess, lenient=False)
        if not isinstance(q, Mapping):
            return cls(names, named, guess, lenient=False)
        # If the scalar Euler parameter is given, the constraint does not determine the axis of the rotation. Do not
        # solve for the other three: omitted ones are zero.
        still = {names[i] for four in quaternions if names[four[3]] in named for i in four}
        return cls(tuple(c for c in left_out if c not in still), named, guess, lenient=True)

    def for_contacts(self, system: System, q: Numbers, free: Sequence[str] | None) -> AssemblyProblem:
        """The same for touching contacts: omitted coordinates are solved for, too."""
        if free is not None:
            return self
        names = system.coordinates
        moved = names if not isinstance(q, Mapping) else [c for c in names if c in self.moved or c not in q]
        return self._replace(moved=tuple(moved), lenient=True)


def with_touching(system: System, touching: Sequence[str]) -> System:
    """A system whose configuration constraints contain the gaps of contacts.

    **Raises:** `ValueError` for unknown names and for bearings, which have no gap.
    """
    layout = layout_of(system)
    can_touch = [name for name, is_bearing in zip(layout.names, layout.is_bearing, strict=True) if not is_bearing]
    refuse_unknown(touching, can_touch, f"{type(system).__name__} has no contact", "it has")
    places, own = [layout.names.index(name) for name in touching], type(system)

    def configuration_constraints(self: System, t: Component, q: Numbers) -> Sequence[Any]:
        kane = KaneEquations(with_class(self, own), t, q, (0.0,) * len(system.speeds))
        gaps = ContactRows(kane, layout).gaps(kane.t, kane.q, kane.u_all)
        return [*own.configuration_constraints(self, t, q), *(gaps[i] for i in places)]

    name = f"{own.__name__} with {', '.join(touching)} touching"
    changed: Any = type(own)(own.__name__, (own,), {"configuration_constraints": configuration_constraints})  # type: ignore[misc]
    changed.__qualname__ = name
    return with_class(system, changed)


_EULER_PARAMETERS = Cache()  # indices of Euler parameters by structure


def euler_parameters(system: System) -> list[tuple[int, ...]]:
    """Indices of each four consecutive coordinates for which a constraint states that their norm is one."""
    return _EULER_PARAMETERS.get(structure_of(system), lambda: _search_euler_parameters(system))


def _search_euler_parameters(system: System) -> list[tuple[int, ...]]:
    """Those at two random points: with 700 coordinates and 100 constraints, one point gave seven wrong matches."""
    found: list[set[int]] = []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        probe = rng.uniform(0.2, 0.9, len(system.coordinates)).astype(jnp.result_type(float))
        with concretely():
            values = np.abs(
                configuration_residual.numpy(*at_random_point((system, np.zeros((), probe.dtype), probe), rng))
            )
        squares = np.convolve(probe**2, np.ones(4), "valid") if len(probe) > 3 else np.zeros(0)
        norms = np.abs([squares - 1.0, squares**0.5 - 1.0])  # the norm of four coordinates or its square, minus one
        found.append({*np.flatnonzero(np.any(np.abs(norms[..., None] - values) < 1e-5, axis=(0, 2))).tolist()})
    return [(i, i + 1, i + 2, i + 3) for i in sorted(found[0] & found[1])]


def _reads_any(system: System, names: Sequence[str]) -> bool:
    """Whether the configuration constraints depend on any of these coordinates, evaluated at a random point."""
    rng = np.random.default_rng(0)
    with concretely():
        system, t, q = at_random_point((system, np.zeros(()), None), rng)
        along = np.eye(len(q), dtype=q.dtype)[:, [system.coordinates.index(c) for c in names]]
        return bool(np.any(configuration_residual.numpy_jvp((system, np.asarray(t, q.dtype), q), (None, None, along))))


Equations = Callable[[Numbers], Numbers]

_MAX_STEPS = 64
_OTHER_GUESSES = 8


def _root(
    xp: ModuleType, equations: Equations, slopes: Equations, start: Numbers, met: float, redundant: bool
) -> tuple[Any, Any]:
    """The root of `equations` and the number of Newton steps. Values and unknowns are scaled to size 1.

    By NumPy, which takes less time than a compilation by XLA, or by JAX, with derivatives up to the third order by the
    implicit function theorem.

    **Arguments:**

    - `met`: the largest values that are regarded as zero.
    - `redundant`: whether equations may depend on others. Each step is then the shortest solution.
    """
    eps = float(jnp.finfo(start.dtype).eps)

    def solution(A: Numbers, b: Numbers) -> Numbers:
        if xp is jnp and not redundant:
            return jnp.linalg.solve(A, b)
        finite = xp.all(xp.isfinite(A)) & xp.all(xp.isfinite(b))
        A, b = xp.where(finite, A, 0.0), xp.where(finite, b, xp.zeros_like(b))
        return xp.where(finite, xp.linalg.lstsq(A, b, rcond=REDUNDANT if redundant else None)[0], xp.nan)

    def solve(equations: Equations, start: Numbers, slopes: Equations | None = None) -> tuple[Any, Any]:
        slopes = slopes or jax.jacfwd(equations)

        def step(carry: tuple[Numbers, ...]) -> PyTree:
            x, last, _, n = carry
            values = equations(x)
            dx = solution(slopes(x), values)
            finite, size = xp.all(xp.isfinite(dx)), xp.max(xp.abs(dx))
            # Steps that do not become shorter are rounding errors. Near a double root, each step is half the last one.
            stalls = (size > 0.75 * last) & xp.all(xp.abs(values) <= met)
            ends = ~finite | (size <= 8 * eps * (1 + xp.max(xp.abs(x)))) | stalls
            return xp.where(finite, x - dx, x), size, ends, n + 1

        carry = start, xp.asarray(np.inf, start.dtype), xp.asarray(False), xp.asarray(0)
        if xp is jnp:
            carry = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[3] < _MAX_STEPS), step, carry)
        while xp is np and not carry[2] and carry[3] < _MAX_STEPS:
            carry = step(carry)
        return carry[0], carry[3].astype(start.dtype)  # JAX 0.10 rejects the tangent of an integer

    def solve_linear(f: Equations, b: Numbers) -> Numbers:
        # The pseudo-inverse is finite for a singular matrix. NaN in one member of a batch would give NaN in the
        # derivatives of shared parameters. It is not differentiated, but the residual of the refined solution is.
        A = jax.jacfwd(f)(jnp.zeros_like(b))
        fixed = jax.lax.stop_gradient(jnp.where(jnp.isfinite(A), A, 0.0))
        inverse = jnp.linalg.pinv(fixed, rtol=REDUNDANT if redundant else None)
        x = inverse @ b
        for _ in range(2):
            x = x + inverse @ (b - A @ x)
        return x

    if xp is np:
        return solve(equations, start, slopes)
    return jax.lax.custom_root(equations, start, solve, solve_linear, has_aux=True)  # type: ignore[return-value]


def _singular(xp: ModuleType, A: Numbers) -> tuple[Any, Any]:
    """U and the singular values of A. NumPy raises an exception for entries that are not finite; replace them by 0."""
    A = A if xp is np else jax.lax.stop_gradient(A)
    return tuple(xp.linalg.svd(xp.where(xp.isfinite(A), A, 0.0), full_matrices=True)[:2])  # type: ignore[return-value]


def _met(dtype: DTypeLike) -> float:
    """The largest permitted residual after Newton's method, relative to its terms: 4e-10 (float32: 7e-5)."""
    return float(jnp.finfo(dtype).eps) ** 0.6


def _flat(dtype: DTypeLike) -> float:
    """The largest slope that is only a rounding error, for quantities of size 1."""
    return float(jnp.finfo(dtype).eps) ** 0.9


class NewtonResult(NamedTuple):
    q: Any  # NaN if not converged
    converged: Any  # the constraints are satisfied and determine the unknown coordinates
    is_met: Any
    is_determined: Any
    remainder: Any  # largest residual
    implied: Any  # largest residual of the implied constraints
    steps: Any


def newton(system: System, q0: Coordinates, t: Component, where: tuple[int, ...], lenient: bool) -> NewtonResult:
    """Newton's method from q0, evaluated by NumPy if no number is traced.

    Residuals are divided by the sizes of their terms. Coordinates are divided by the change that changes a residual by
    its size. Therefore, no criterion depends on units.
    """
    if is_concrete(system, q0, t):
        system, q0, t = jax.device_get((system, q0, t))
        with np.errstate(all="ignore"):
            result = _newton(np, system, q0, t, where, lenient)
        return result._replace(q=jax.device_put(result.q))
    return newton_compiled(system, q0, t, where, lenient)


@jit
def newton_compiled(
    system: System, q0: Coordinates, t: Component, where: tuple[int, ...], lenient: bool
) -> NewtonResult:
    result = _newton(jnp, system, q0, t, where, lenient)
    return result._replace(q=nan_where(~result.converged, result.q, (system, q0, t)))


def _newton(
    xp: ModuleType, system: System, q0: Coordinates, t: Component, where: tuple[int, ...], lenient: bool
) -> NewtonResult:
    places, dtype, redundant = np.array(where, int), q0.dtype, has_multipliers(system)
    met = configuration_tolerance(dtype) if redundant else _met(dtype)
    # Values that are not finite must not reach the linear solver. It would raise an exception for the whole batch.
    finite = functools.reduce(operator.and_, [xp.all(xp.isfinite(x)) for x in jax.tree.leaves((system, q0))])
    system, q0 = jax.tree.map(lambda x: xp.where(finite, x, xp.ones_like(x)), (system, q0))
    along = np.eye(len(q0), dtype=dtype)[:, places]  # (n_q,moved)

    def residuals(q: Numbers) -> Numbers:
        return configuration_residual.numpy(system, t, q) if xp is np else configuration_residual(system, t, q)

    def slopes(q: Numbers) -> Numbers:
        if xp is np:
            return configuration_residual.numpy_jvp((system, t, q), (None, None, along))
        return jax.jacfwd(lambda dq: residuals(q + along @ dq))(jnp.zeros(len(places), dtype))

    moved, sizes = scales_along(system, t, q0, along.T), residual_sizes(system, t, q0)[0]
    sizes = xp.where(sizes > 0, sizes, 1.0)

    def scaled_slopes(q: Numbers) -> Numbers:
        return slopes(q) * moved[None] / sizes[:, None]

    random = q0 + along @ (moved * np.random.default_rng(0).uniform(0.3, 0.7, len(places)).astype(dtype))
    h, at_guess, at_random = residuals(q0) / sizes, scaled_slopes(q0), scaled_slopes(random)
    reads = xp.abs(at_random) > _flat(dtype)  # (h,moved)
    already_met = (xp.abs(h) <= _met(dtype)) & ~xp.any(reads, axis=1) & lenient
    start = q0 + along @ xp.where(_offset(xp, h, _singular(xp, at_guess), reads), moved, 0.0)

    n_h = len(h)
    if len(places) == n_h and not lenient:
        directions = xp.diag(moved)
    else:  # (h, moved): only along the gradients of the constraints
        directions = slopes(start) / sizes[:, None] * scales_by_unit(system, t, q0)[places][None] ** 2

    def at(amount: Numbers) -> Numbers:
        return start + along @ (amount @ directions)

    def equations(amount: Numbers) -> Numbers:
        return xp.where(already_met, amount, residuals(at(amount)) / sizes)

    def equation_slopes(amount: Numbers) -> Numbers:
        G = slopes(at(amount)) / sizes[:, None] @ directions.T
        return xp.where(already_met[:, None], np.eye(n_h, dtype=dtype), G)

    amount, steps = _root(xp, equations, equation_slopes, xp.zeros(n_h, dtype), met, redundant)
    q = at(amount)
    own, implied = violations(system, t, q)
    is_met = xp.all(own <= met)
    implied_is_met = xp.all(implied <= configuration_tolerance(dtype))
    # At a double root, a residual of eps corresponds to a slope of sqrt(eps).
    smallest = _singular(xp, equation_slopes(amount))[1][-1]
    is_determined = (smallest > 4 * float(jnp.finfo(dtype).eps) ** 0.5) | redundant
    converged = finite & is_met & implied_is_met & is_determined
    remainder, implied = (xp.max(xp.abs(x), initial=0.0) for x in (residuals(q), implied_residual(system, t, q)))
    return NewtonResult(q, converged, is_met, is_determined, remainder, implied, steps)


def _offset(xp: ModuleType, h: Numbers, singular: tuple[Any, Any], reads: Numbers) -> Numbers:
    """Which coordinates (moved,) are displaced from the initial guess before Newton's method starts.

    If the gradients of the constraints are linearly dependent, no direction may reduce some residuals to first order.
    Two rods in line are an example. The coordinates on which these residuals depend are then displaced.

    **Arguments:**

    - `h`: relative residuals (h,).
    - `singular`: U and the singular values of the gradients.
    - `reads`: on which coordinates each residual depends (h, moved).
    """
    U, s = singular
    unmoved = xp.concatenate([s, xp.zeros(len(h), s.dtype)])[: len(h)] <= _flat(s.dtype)
    rest = U @ xp.where(unmoved, U.T @ h, 0.0)  # the part of the residuals that no direction reduces to first order
    return xp.any(reads & (xp.abs(rest) > _met(s.dtype))[:, None], axis=0)


class NoConfiguration(ValueError):
    """The configuration constraints cannot be satisfied, or not from this initial guess."""


def assemble(
    system: System,
    q: Numbers,
    u: Numbers = None,
    x: Numbers = None,
    *,
    t: Component = 0.0,
    free: Sequence[str] | None = None,
    touching: Sequence[str] = (),
) -> State:
    """Compute a state that satisfies the constraints.

        h(t, q) = 0

    Newton's method solves for some of the coordinates.

    **Arguments:**

    - `system`: a `System`.
    - `q`: coordinates (n_q,), or a dict by name. Values in a dict are fixed. Omitted coordinates start at zero, but the
        last of four Euler parameters starts at one, which is the orientation without rotation. Values of coordinates
        that are solved for, such as dependent coordinates in an array, are initial guesses.
    - `u`: independent speeds (n_u,), or a dict by name. Omitted speeds are zero. A dict may also contain dependent
        speeds, which are compared with the solution of the velocity residuals. With `touching`, and for a system of
        `with_multipliers`, speeds in a dict are fixed, and omitted speeds are computed from them. All speeds of an
        array may change. The changes are the smallest in the metric of the mass matrix.
    - `x`: first-order states (n_x,), or a dict by name. Omitted states are zero.
    - `t`: time [s], one finite number.
    - `free`: names of the coordinates that are solved for. The default is `system.dependent_coordinates`. If a dict
        contains a dependent coordinate, all omitted coordinates are solved for instead. If the dict omits no coordinate
        that affects the constraints, its dependent coordinates are initial guesses. Without dependent coordinates in
        the system, the unknowns are the omitted coordinates of a dict, or all coordinates of an array. With more
        unknowns than constraints, the solution is the nearest to the initial guess along the gradients of the
        constraints.
    - `touching`: names of contacts whose gaps vanish. The coordinates that are solved for are then the dependent
        coordinates and all omitted ones, or all coordinates of an array. With the returned speeds, these contacts
        neither approach nor separate.

    **Returns:** a `State`. It can be differentiated (twice, in both modes) with respect to all numbers, by the implicit
    function theorem.

    **Raises:** `ValueError` if no such configuration is found, or if given speeds contradict the velocity residuals.
    If arguments are traced, the coordinates or speeds and all their derivatives become NaN instead.
    """
    check_is_system(system)
    name = type(system).__name__
    check_time(name, t)
    problem, touching = AssemblyProblem.of(system, q, free), as_names(touching, "touching")
    if touching:
        problem = problem.for_contacts(system, q, free)
    q0 = as_array(problem.guess | dict(q) if isinstance(q, Mapping) else q, system.coordinates, f"{name}: q")
    u_dep: dict[str, Any] = {}
    if isinstance(u, Mapping):
        u_dep = {speed: u[speed] for speed in system.dependent_speeds if speed in u}
        u = {speed: value for speed, value in u.items() if speed not in u_dep}
    u0 = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q0.dtype)
    if not system.states and x is not None and np.size(x):
        raise ValueError(f"{name} has no first-order states, got x = {x!r}. Omit x.")
    x0 = as_array({} if x is None else x, system.states, f"{name}: x").astype(q0.dtype) if system.states else None
    parts = [y for y in (q0, u0, x0) if y is not None]
    if is_concrete(parts):
        names = (*system.coordinates, *system.speeds, *system.states)
        bad = [n for n, y in zip(names, np.concatenate(parts), strict=True) if not np.isfinite(y)]
        refuse_any(bad, f"{name}:", " is not finite.")
    q0 = _solve_configuration(with_touching(system, touching) if touching else system, q0, t, problem)
    if touching or has_multipliers(system):
        named = dict(u) if isinstance(u, Mapping) else {}
        u0, contradict = speeds_in_contact(system, jnp.asarray(t, q0.dtype), q0, u0, touching, tuple(named))
        if is_concrete(contradict) and contradict:
            values = ", ".join(f"{speed} = {float(x):.6g}" for speed, x in named.items())
            raise ValueError(
                f"{name}: no speeds satisfy the velocity constraints{' of closed contacts' * bool(touching)} with "
                f"{values}. Omit the speeds that follow from the others."
            )
        if is_concrete(u0) and not np.all(np.isfinite(u0)):
            raise ValueError(diagnosis(system, t, q0, jnp.zeros_like(u0)) or f"{name}: the speeds are not finite.")
        u0 = nan_where(contradict, u0, (system, q0, u0, t))
    if is_concrete(system, q0, u0, t):
        check_system(system, t, q0)
        check_contacts(system, t, q0, may_penetrate=True)
        if u_dep:
            _check_dependent_speeds(system, u_dep, t, q0, u0)
    return State(q0, u0, x0)


def _solve_configuration(system: System, q0: Coordinates, t: Component, problem: AssemblyProblem):
    t = jnp.asarray(t if isinstance(t, jax.Array) else np.asarray(t, q0.dtype), dtype=q0.dtype)
    n_h = n_configuration_constraints(system, t, q0)
    if n_h == 0:
        return q0
    if len(problem.moved) < n_h:  # e.g. a plane loop that is closed by a Vector, whose third component is always zero
        problem = problem._replace(lenient=True)
    places = tuple(system.coordinates.index(c) for c in problem.moved)
    result = newton(system, q0, t, places, problem.lenient)
    if not is_concrete(system, q0, t) or bool(result.converged):
        return result.q
    if places and not (result.is_met and not result.is_determined):
        along = np.eye(len(q0), dtype=q0.dtype)[list(places)]
        scales, rng = np.asarray(scales_along(system, t, q0, along)), np.random.default_rng(0)
        found = []
        for i in range(_OTHER_GUESSES):
            offset = 0.25 * (1 + i // 2) * rng.uniform(-1.0, 1.0, len(places)) * scales
            other = newton(system, q0 + (offset @ along).astype(q0.dtype), t, places, problem.lenient)
            found += [other.q] if bool(other.converged) else []
        if found:
            return min(found, key=lambda q: float(np.linalg.norm((along @ np.asarray(q - q0)) / scales)))
    raise NoConfiguration(_why_not(system, q0, problem, result))


def _why_not(system: System, q0: Coordinates, problem: AssemblyProblem, result: NewtonResult) -> str:
    name = type(system).__name__
    moved = ", ".join(problem.moved)
    fixed = ", ".join(
        f"{c} = {float(x):.4g}"
        for c, x in zip(system.coordinates, q0, strict=True)
        if c not in problem.moved and (x != 0 or (problem.lenient and c in problem.named))
    )
    fixed = fixed or "the others zero"
    hint = " Named values are fixed: omit the unknown coordinates, or pass free=(...)." if problem.lenient else ""
    if not moved:
        return (
            f"{name}: {fixed} does not satisfy the configuration constraints (the largest residual is "
            f"{float(result.remainder):.3g}), and no coordinate may be changed.{hint}"
        )
    if result.is_met and result.is_determined:
        return (
            f"{name}: the configuration constraints can be met, but the constraints implied by them are violated "
            f"by {float(result.implied):.3g}: with these parameters the loop cannot be closed. In a plane loop, "
            "place both ends in one plane."
        )
    if result.is_met:
        return (
            f"{name}: the configuration constraints do not determine {moved} with {fixed}: they do not depend on it "
            f"(a singular configuration, or redundant constraints). Change the fixed values, or assemble "
            f"jaxkane.with_multipliers(system) if constraints are redundant.{hint}"
        )
    guess = ", ".join(f"{c} = {float(q0[system.coordinates.index(c)]):.4g}" for c in problem.moved)
    return (
        f"{name}: Newton's method found no {moved} that satisfies the configuration constraints with {fixed}. "
        f"From the guess {guess}, the residual is {float(result.remainder):.3g} after {int(result.steps)} steps, and "
        f"{_OTHER_GUESSES} other guesses failed, too. Start from another guess, or fix other values.{hint}"
    )


def _check_dependent_speeds(system: System, given: Mapping[str, Any], t: Component, q: Numbers, u: Numbers) -> None:
    required = np.asarray(dependent_speeds(system, t, q, u))
    # Relative to the terms of u_dep = J u + drift, so that the result does not depend on units.
    drift = np.asarray(dependent_speeds(system, t, q, jnp.zeros_like(u)))
    sizes = np.abs(drift) + np.abs(np.asarray(constraint_jacobian(system, t, q))) @ np.abs(np.asarray(u))
    for speed, value in given.items():
        i, value = system.dependent_speeds.index(speed), float(value)
        if not abs(value - required[i]) <= 1e-6 * max(SMALLEST_SIZE, float(sizes[i])):
            raise ValueError(
                f"{type(system).__name__}: {speed} = {value:.6g} contradicts the velocity constraints, which require "
                f"{required[i]:.6g} (residual {value - required[i]:.3g}). Omit the dependent speeds: they are computed "
                "from the others."
            )
