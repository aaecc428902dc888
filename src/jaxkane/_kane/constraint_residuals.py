"""Configuration constraints and velocity residuals.

This module checks whether coordinates satisfy the constraints and computes the nearest coordinates that do. It finds
the speeds for which the velocity residuals can be solved. It does not depend on mechanisms or integrators.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from .._common.lookup import refuse_any, refuse_if
from .._scalarjit.cache import Cache
from .._scalarjit.compat import Tracer, concretely
from .._scalarjit.components import Component, Numbers, add, as_vector, dot, matvec, mul, stack, total
from .._scalarjit.jaxpr import LARGEST_SUM
from .._scalarjit.nan import nan_where
from .._scalarjit.scalar_function import ScalarFunction
from .._system.motion import SomeComponents, residual_groups
from .._system.system import System
from .arguments import as_array, check_is_system, check_time, is_concrete, refuse_incomplete
from .description import DescriptionEvaluator, at_random_point, structure_of
from .kanes_method import KaneEquations, unit
from .scaling import SMALLEST_SIZE, RowBasis, inside_pure_functions, relative, term_sizes, without_rounding

SINGULAR_ROUNDING = 1e-12
"""The reciprocal of the largest condition number that is accepted when residuals are solved for dependent speeds."""


@ScalarFunction
def configuration_residual(system: System, t: Component, q: Numbers):
    """Residuals (h,) of the configuration constraints."""
    return as_vector(DescriptionEvaluator(system).configuration(t, tuple(q[i] for i in range(len(q)))), q)


def _implied_groups(system: System, t: Component, q: Numbers) -> list[SomeComponents]:
    residuals = system.implied_constraints(t, tuple(q[i] for i in range(len(q))))
    return [*residual_groups(residuals, f"{type(system).__name__}: the residuals of implied_constraints")]


def implied_residual(system: System, t: Component, q: Numbers) -> Numbers:
    """Residuals (h,) that follow from the configuration constraints."""
    if has_no_implied(system):
        return np.zeros(0, q.dtype)
    return _by_numpy(_implied_residual, system, t, q)


_implied_residual = ScalarFunction(
    lambda system, t, q: as_vector([x for group in _implied_groups(system, t, q) for x in group.components], q)
)


def _by_numpy(f: ScalarFunction, *args: Any) -> PyTree:
    return f.numpy(*args) if is_concrete(args) else f(*args)


_ANGLES = Cache()  # indices of coordinates that are angles, by structure


def coordinate_units(system: System) -> tuple[str, ...]:
    """The units of the coordinates: as declared, "rad" if constraints use it in sin or cos, otherwise ""."""
    angles = _ANGLES.get(structure_of(system), lambda: _angles(system))
    return tuple(system.units.get(c, "rad" if i in angles else "") for i, c in enumerate(system.coordinates))


def _angles(system: System) -> set[int]:
    def wide(x: Numbers) -> Numbers:
        # The residuals are traced with JAX's default dtype. Mixing it with float32 parameters would raise an exception.
        return np.asarray(x, float) if eqx.is_inexact_array(x) and not isinstance(x, Tracer) else x

    with concretely():
        at, t, q = at_random_point((system, np.zeros(()), None), np.random.default_rng(0))
        at = jax.tree.map(wide, at)

        def residual(*q: Any) -> Array:
            return jnp.array(DescriptionEvaluator(at).configuration(t, q), float)

        return inside_pure_functions(residual, len(q))


def scales_along(system: System, t: Component, q: Numbers, directions: np.ndarray) -> Numbers:
    """The distance (d,) along each direction (d, n_q) that changes a residual by its size; 1 if no residual changes.

    Computed from the sizes of the terms of the slopes, because the slopes may be zero or rounding errors.
    """
    arguments = jax.lax.stop_gradient((system, t, q))
    each = [_by_numpy(_slope_sizes, *arguments, x) for x in directions.astype(q.dtype)]
    sizes = residual_sizes(*arguments)[0]
    xp: Any = np if is_concrete(each, sizes) else jnp
    slopes = [xp.max(x / xp.where(sizes > 0, sizes, 1.0), initial=0.0) for x in each]
    return xp.stack([1 / xp.where(x > 0, x, 1.0) for x in slopes]) if slopes else np.zeros(0, q.dtype)


def scales_by_unit(system: System, t: Component, q: Numbers) -> Numbers:
    """The scale of every coordinate (n_q,). Coordinates with the same unit have the same scale.

    Distances in scaled coordinates are the same in metres and in micrometres. The ratios between the components of a
    vector do not change.
    """
    units = coordinate_units(system)
    different = [*dict.fromkeys(units)]
    scales = scales_along(system, t, q, np.array([[unit == x for x in units] for unit in different]))
    xp: Any = np if isinstance(scales, np.ndarray) else jnp
    return xp.stack([scales[different.index(unit)] for unit in units])  # no array indices, for the export to C


@ScalarFunction.compile_cheaply
def _slope_sizes(system: System, t: Component, q: Numbers, direction: Numbers) -> Numbers:
    """The sizes of the terms of dh/dq (h,) along a direction. The largest coordinate of a unit sets the size of all."""
    units, row = coordinate_units(system), [q[i] for i in range(len(q))]

    def slope(system: System, t: Component, q: Numbers, direction: Numbers) -> Numbers:
        return jax.jvp(lambda q: configuration_residual(system, t, q), (q,), (direction,))[1]

    # Once for each unit: a robot with 100 free bodies has 728 coordinates.
    largest = {
        unit: functools.reduce(jnp.maximum, [abs(x) for x, other in zip(row, units, strict=True) if other == unit])
        for unit in dict.fromkeys(units)
    }
    sizes = [jnp.maximum(largest[unit], 1.0) if unit == "rad" else largest[unit] for unit in units]
    return term_sizes(slope, system, t, q, direction, sizes=(None, None, as_vector(sizes, q), None))


def residual_sizes(system: System, t: Component, q: Numbers, smallest: float = 0.0) -> tuple[Any, Any]:
    """The sizes of the terms of the configuration constraints (h,), and of the implied constraints (i,).

    All components of a vector have the size of the largest. A coordinate has its absolute value as size, but at least
    `smallest`; an angle has at least the size 1.
    """
    return _by_numpy(_residual_sizes, *jax.lax.stop_gradient((system, t, q)), np.asarray(smallest, q.dtype))


@ScalarFunction.compile_cheaply
def _residual_sizes(system: System, t: Component, q: Numbers, smallest: Numbers) -> tuple[Any, Any]:
    angles = np.array([unit == "rad" for unit in coordinate_units(system)])
    floors = jnp.where(angles, 1.0, smallest).astype(q.dtype)
    n_h: list[int] = []

    def vectors(system: System, t: Component, q: Numbers) -> list[Any]:
        evaluator, row = DescriptionEvaluator(system), tuple(q[i] for i in range(len(q)))
        own = evaluator.read("configuration_vectors", t, row, (0.0,) * (evaluator.n + evaluator.k))
        n_h.append(len(own))
        implied = [] if has_no_implied(system) else _implied_groups(system, t, q)
        return [as_vector(x, q) for x in (*own, *(group.all for group in implied for _ in group.components))]

    sizes = term_sizes(vectors, system, t, q, sizes=(None, None, jnp.maximum(jnp.abs(q), floors)))
    row = [functools.reduce(jnp.maximum, [x[i] for i in range(len(x))]) for x in sizes]
    return as_vector(row[: n_h[0]], q), as_vector(row[n_h[0] :], q)


def has_no_implied(system: System) -> bool:
    return type(system).implied_constraints is System.implied_constraints


def configuration_tolerance(dtype: DTypeLike) -> float:
    """The largest residual, relative to its terms, with which the configuration constraints are satisfied."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


def violations(system: System, t: Component, q: Numbers) -> tuple[Any, Any]:
    """Residuals relative to their terms: of the configuration constraints (h,), and of the implied constraints (i,)."""
    h, implied = _by_numpy(configuration_residual, system, t, q), implied_residual(system, t, q)
    if not h.size + implied.size:
        return h, implied
    own, others = residual_sizes(system, t, q, SMALLEST_SIZE)
    return relative(h, own), relative(implied, others)


def configuration_is_met(system: System, t: Component, q: Numbers) -> Any:
    """Whether the configuration constraints and the implied constraints are satisfied."""
    relative_residuals = violations(system, t, q)
    if not any(h.size for h in relative_residuals):
        return np.array(True)
    xp = np if is_concrete(relative_residuals) else jnp
    are_met = xp.concatenate(relative_residuals) <= configuration_tolerance(q.dtype)
    parts = [xp.all(are_met[i : i + LARGEST_SUM]) for i in range(0, are_met.size, LARGEST_SUM)]
    return functools.reduce(xp.logical_and, parts)  # a longer reduction cannot be part of one compiled function


def check_state(system: System, t: Component, q: Numbers) -> None:
    """Raise `ValueError` with the residual if coordinates violate a configuration constraint or an implied one."""
    if not is_concrete(system, t, q) or configuration_is_met(system, t, q):
        return
    name, residual = type(system).__name__, configuration_residual.numpy(system, t, q)
    violation = np.max(violations(system, t, q)[0], initial=0.0)
    if not violation <= configuration_tolerance(q.dtype):
        adjust = ", ".join(system.dependent_coordinates) or "the coordinates"
        raise ValueError(
            f"{name}: the coordinates violate the configuration constraints by "
            f"{np.array2string(residual, precision=3)}, which is {violation:.2g} of their terms. "
            f"Find {adjust} with jaxkane.assemble(system, q, u)."
        )
    raise ValueError(
        f"{name}: a condition that the configuration constraints imply is violated by "
        f"{np.array2string(implied_residual(system, t, q), precision=3)}. With these parameters the loop cannot be "
        "closed. Change the parameters."
    )


def check_left_out(system: System, t: Component, q: Numbers, left_out: Sequence[str]) -> Numbers:
    """Check coordinates of which some were omitted and set to zero. Return them if no constraint is violated.

    **Raises:** `ValueError` with the omitted names. If arguments are traced, the coordinates become NaN instead.
    """
    residual = _by_numpy(configuration_residual, system, t, q)
    if not residual.size:
        return q
    is_met = configuration_is_met(system, t, q)
    if not is_concrete(system, t, q):
        return nan_where(~is_met, q, (system, t, q))
    if is_met:
        return q
    raise ValueError(
        f"{type(system).__name__}: with {', '.join(left_out)} omitted from q and set to zero, the configuration "
        f"constraints are violated by {np.array2string(residual, precision=3)}. Find the state with "
        "jaxkane.assemble(system, q, u) and pass its state.q, or pass values of these coordinates."
    )


def correction(system: System, t: Component, q: Array) -> Float[Array, " n_q"]:
    """The smallest change of coordinates (n_q,) that satisfies the configuration constraints to first order."""
    G = jax.jacfwd(lambda q: configuration_residual(system, t, q))(q)
    return -least_change(G, configuration_residual(system, t, q), coordinate_weights(system, t, q))


def coordinate_weights(system: System, t: Component, q: Numbers) -> Numbers:
    """The scales (n_q,) with which changes of coordinates of different units are compared: 1 if there is one unit."""
    return scales_by_unit(system, t, q) if len({*coordinate_units(system)}) > 1 else jnp.ones_like(q)


def least_change(G: Array, h: Array, weights: Array) -> Array:
    """The change dq (n_q,) or (n_q, k) with G dq = h, for h (h,) or (h, k), that minimizes the norm of dq / weights.

        G W = L Q with orthonormal rows of Q,   dq = W Q^T L^-1 h

    A coordinate of weight zero does not change. A residual is omitted if its gradient is zero or linearly dependent on
    the previous ones.
    """
    return weights.reshape(-1, *[1] * (h.ndim - 1)) * RowBasis.of(G * weights[None]).least_norm(h)


def projected(system: System, t: Component, q: Array, steps: int = 3) -> Float[Array, " n_q"]:
    """The nearest coordinates (n_q,) that satisfy the configuration constraints, by Gauss-Newton steps from nearby."""
    for _ in range(steps):
        q = q + correction(system, t, q)
    return q


def n_configuration_constraints(system: System, t: Component, q: Array | jax.ShapeDtypeStruct) -> int:
    """The number of residuals of the configuration constraints. `q` may be a `jax.ShapeDtypeStruct`."""
    return jax.eval_shape(lambda q: configuration_residual(system, t, q), q).shape[0]


def has_configuration_constraints(system: System, t: Component, q: Array) -> bool:
    return n_configuration_constraints(system, t, q) > 0


class DependentSpeeds(eqx.Module):
    """Which speeds the velocity residuals can be solved for. `print` shows the choices, the best first.

    Attributes:

    - `choices`: pairs of names and condition number, the best first. They are the best choice, all choices that differ
        from it by one speed, and the current choice. The condition number is that of C_dep relative to the
        coefficients of all speeds. It is infinite if the residuals cannot be solved for these speeds. Speeds are
        compared by kinetic energy, so their units do not matter.
    - `current`: names of the dependent speeds of the system.
    - `condition`: the condition number of the current choice.
    - `n_residuals`: number of velocity residuals.
    - `rank`: number of linearly independent velocity residuals.
    - `redundant`: indices of residuals that are linearly dependent on previous residuals.
    - `conflicting`: indices of redundant residuals that contradict the others, so that no speeds satisfy them.
    - `absent`: current dependent speeds on which no residual depends.
    - `name`: name of the system.
    """

    choices: tuple[tuple[tuple[str, ...], float], ...] = eqx.field(static=True)
    current: tuple[str, ...] = eqx.field(static=True)
    condition: float = eqx.field(static=True)
    n_residuals: int = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    redundant: tuple[int, ...] = eqx.field(static=True)
    conflicting: tuple[int, ...] = eqx.field(static=True)
    absent: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def best(self) -> tuple[str, ...]:
        """The best-conditioned choice."""
        return self.choices[0][0]

    def advice(self) -> str:
        """One or two sentences."""
        if self.rank < self.n_residuals:
            which = ", ".join(map(str, self.redundant))
            text = f"the {self.n_residuals} velocity residuals have the rank {self.rank}: residual {which} (counted "
            text += "from 0) follows from those before it. Omit it, and name one dependent speed less for each."
            if self.conflicting:
                conflicting = ", ".join(map(str, self.conflicting))
                text += f" Residual {conflicting} contradicts them, so no speeds satisfy all residuals."
            return text
        if self.condition <= 10 * self.choices[0][1]:
            return f"{', '.join(self.current)} are well chosen (condition {self.condition:.3g})."
        return (
            f"the residuals are solved for {', '.join(self.current)} with a condition number of {self.condition:.3g}; "
            f"for {', '.join(self.best)} it would be {self.choices[0][1]:.3g}."
        )

    def __str__(self) -> str:
        rows = [f"{condition:>10.3g}  {', '.join(names)}" for names, condition in self.choices[:10]]
        rows += [f"... and {len(self.choices) - 10} more"] if len(self.choices) > 10 else []
        return "\n".join([f"{self.name}: {self.advice()}", " condition  dependent speeds", *rows])

    __repr__ = __str__


def best_dependent_speeds(system: System, t: Component, q: Numbers) -> DependentSpeeds:
    """Compute how well the velocity residuals can be solved for different dependent speeds.

        c = C u + c0,   C (k, n + k);   C_dep: the k columns of the choice

    **Arguments:**

    - `system`: a `System` with dependent speeds.
    - `t`: time [s].
    - `q`: coordinates (n_q,), or a dict by name. They must not be traced.

    **Returns:** a `DependentSpeeds` with condition numbers and the rank of the residuals.

    **Raises:** `ValueError` for a system without dependent speeds, and for coordinates that are not finite.
    """
    check_is_system(system)
    name = type(system).__name__
    refuse_if(
        not system.dependent_speeds,
        f"best_dependent_speeds: {name} has no dependent speeds, so there is no choice to compare.",
    )
    refuse_incomplete(system, q, {})
    q = as_array(q, system.coordinates, f"{name}: q")
    check_time(name, t)
    wrong = [c for c, x in zip(system.coordinates, np.asarray(q), strict=True) if not np.isfinite(x)]
    refuse_any(wrong, f"{name}: q is not finite:", ".")
    return dependent_speeds_at(system, jnp.asarray(t, q.dtype), q)


def dependent_speeds_at(system: System, t: Component, q: Numbers) -> DependentSpeeds:
    """`best_dependent_speeds` for checked arrays."""
    found = (np.asarray(x, dtype=float) for x in _constraint_rows(system, t, q))
    C, c0, energies, C_sizes, c0_sizes, energy_sizes = found
    # Speeds in m/s and in rad/s are compared by kinetic energy. The scale of a speed without mass is chosen such that
    # it changes the residuals as much as the other speeds.
    has_mass = energies > 1e-20 * energy_sizes  # squares of rounding errors are smaller
    columns = np.where(has_mass, 1 / np.sqrt(np.where(has_mass, energies, 1.0)), 0.0)
    rows = np.max(C_sizes * columns, axis=1, initial=0.0)
    share = np.max(C_sizes / np.where(rows > 0, rows, np.inf)[:, None], axis=0, initial=0.0)
    columns = np.where(has_mass, columns, 1 / np.where(share > 0, share, 1.0))
    # Divide by the sizes of the terms, so that a row of rounding errors, e.g. at a dead centre, remains small.
    rows = np.max(C_sizes * columns, axis=1, initial=0.0)
    rows = np.where(rows > 0, rows, 1.0)
    C, c0, c0_sizes = without_rounding(C, C_sizes) * columns / rows[:, None], c0 / rows, c0_sizes / rows
    speeds, current, k = (*system.speeds, *system.dependent_speeds), system.dependent_speeds, len(C)
    ranks = [int(np.linalg.matrix_rank(C[: i + 1], tol=1e-9)) for i in range(k)]
    redundant = tuple(i for i in range(k) if ranks[i] == (ranks[i - 1] if i else 0))
    kept = [i for i in range(k) if i not in redundant]
    conflicting = []
    for i in redundant:
        weights = np.linalg.lstsq(C[kept].T, C[i], rcond=None)[0]
        if abs(c0[i] - weights @ c0[kept]) > 1e-9 * (c0_sizes[i] + np.abs(weights) @ c0_sizes[kept]):
            conflicting.append(i)
    own = tuple(speeds.index(s) for s in current)
    condition = _condition(C, own)
    conditions = {tuple(sorted(own)): condition} | _best_choices(C)
    ranked = sorted(((tuple(speeds[i] for i in c), float(x)) for c, x in conditions.items()), key=lambda pair: pair[1])
    absent = tuple(s for i, s in zip(own, current, strict=True) if not C[:, i].any())
    of_rows = ranks[-1], redundant, tuple(conflicting), absent
    return DependentSpeeds(tuple(ranked), current, condition, k, *of_rows, type(system).__name__)


@ScalarFunction.compile_cheaply
def _constraint_rows(system: System, t: Component, q: Array) -> tuple[Array, ...]:
    """C (k, n + k) and c0 (k,) of the velocity residuals, kinetic energies (n + k,), and the sizes of their terms.

    A kinetic energy is multiplied by two. It belongs to a motion in which one speed is 1 and the others are zero.
    """

    def rows(system: System, t: Component, q: Array) -> tuple[Array, ...]:
        kane = KaneEquations(system, t, q, jnp.zeros(len(system.speeds), q.dtype))
        n, still = kane.n + kane.k, (0.0,) * (kane.n + kane.k)
        inertias, energies = kane.read("bodies", kane.t, kane.q, still), []
        for r in range(n):
            each = zip(kane.along_speeds(kane.velocities, unit(n, r))[0], inertias, strict=True)
            energies.append(total(add(mul(m, dot(V, V)), dot(W, matvec(I, W))) for (V, W), (m, I) in each))
        C = stack([(*a, *b) for a, b in zip(kane.C_ind, kane.C_dep, strict=True)]).astype(q.dtype)
        return C, as_vector(kane.residuals(kane.t, kane.q, still), q), as_vector(energies, q)

    return *rows(system, t, q), *term_sizes(rows, system, t, q)


def _best_choices(C: np.ndarray) -> dict[tuple[int, ...], float]:
    """Condition numbers of the best-conditioned choice of k columns, and of all choices that differ in one column.

    A QR factorization with column pivoting gives the first choice. Then single columns are exchanged, as long as an
    exchange decreases the condition number.
    """
    if not np.isfinite(C).all():
        return {}
    import scipy.linalg  # imported here, to keep the import of the library fast

    k, n = C.shape
    factors: Any = scipy.linalg.qr(C, mode="r", pivoting=True)
    best = tuple(sorted(factors[1][:k].tolist()))
    conditions = {best: _condition(C, best)}
    while True:
        exchanged = [tuple(sorted({*best, j} - {i})) for i in best for j in range(n) if j not in best]
        conditions = {c: conditions.get(c) or _condition(C, c) for c in (best, *exchanged)}
        better = min(conditions, key=lambda c: conditions[c])
        if not conditions[better] < conditions[best]:
            return conditions
        best = better


def relative_condition(C: np.ndarray, dependent: Sequence[int]) -> Numbers:
    """The condition number (*n_t) with which rows C (*n_t, k, n) are solved for the columns `dependent` (k,).

        largest singular value of C / smallest of C_dep,   each row of C divided by its largest entry

    It is at least the condition number of C_dep. C_dep alone does not show whether all its entries are small compared
    with those of the other speeds. These speeds would then be multiplied by a large number. For example, C_dep of one
    residual always has the condition number 1. The result is infinite if the residuals cannot be solved, and NaN if C
    is not finite.
    """
    size = np.abs(C).max(axis=-1, keepdims=True)
    return _condition(C / np.where(size > 0, size, 1.0), dependent)


def _condition(C: np.ndarray, dependent: Sequence[int]) -> Numbers:
    finite: Any = np.isfinite(C).all(axis=(-2, -1))
    C = np.where(finite[..., None, None], C, 1.0)
    largest = np.linalg.svd(C, compute_uv=False)[..., 0]
    smallest = np.linalg.svd(C[..., list(dependent)], compute_uv=False)[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(smallest > 1e-14 * largest, largest / smallest, np.inf)
    condition = np.where(finite, condition, np.nan)
    return condition if condition.ndim else float(condition)
