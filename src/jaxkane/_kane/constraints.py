"""Configuration constraints and velocity residuals: whether coordinates meet them, and the nearest that do.

And for which speeds the residuals can be solved. Knows no mechanism and no integrator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.components import Component, as_vector, solve, stack
from .._scalarjit.function import ScalarFunction
from .._scalarjit.nan import nan_where
from .._system.motion import flatten_residuals
from .._system.system import System
from .arguments import as_array, check_is_system, check_time, is_concrete, refuse_incomplete
from .kanes_method import DescriptionEvaluator, KaneEquations

SINGULAR_ROUNDING = 1e-12
"""The reciprocal of the largest condition number with which residuals are solved for dependent speeds."""


@ScalarFunction
def configuration_residual(system: System, t: Any, q: Any):
    """Residuals (h,) of the configuration constraints."""
    return as_vector(DescriptionEvaluator(system).configuration(t, tuple(q[i] for i in range(len(q)))), q)


@ScalarFunction
def _implied_residual(system: System, t: Any, q: Any):
    residuals = system.implied_constraints(t, tuple(q[i] for i in range(len(q))))
    return as_vector(flatten_residuals(residuals, f"{type(system).__name__}: the residuals of implied_constraints"), q)


def implied_residual(system: System, t: Any, q: Any) -> Any:
    """Residuals (h,) that follow from the configuration constraints."""
    if type(system).implied_constraints is System.implied_constraints:
        return np.zeros(0, q.dtype)
    return _residual_of(_implied_residual, system, t, q)


def _residual_of(f: Callable[..., Any], system: System, t: Any, q: Any) -> Any:
    """Of numbers by NumPy, so that nothing is compiled."""
    return f.numpy(system, t, q) if is_concrete(system, t, q) else f(system, t, q)


def configuration_tolerance(dtype: Any) -> float:
    """The largest residual of coordinates that meet the configuration constraints."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


def configuration_is_met(system: System, t: Any, q: Any) -> Any:
    """Whether the configuration constraints are met, and what follows from them."""
    residuals = [_residual_of(configuration_residual, system, t, q), implied_residual(system, t, q)]
    xp = np if is_concrete(residuals) else jnp
    h = xp.concatenate(residuals)
    return xp.all(xp.abs(h) <= configuration_tolerance(h.dtype)) if h.size else np.array(True)


def check_state(system: System, t: Any, q: Any) -> None:
    """Refuse coordinates that violate a configuration constraint, with the residual."""
    if not is_concrete(system, t, q) or configuration_is_met(system, t, q):
        return
    name, residual = type(system).__name__, configuration_residual.numpy(system, t, q)
    if not np.max(np.abs(residual), initial=0.0) <= configuration_tolerance(q.dtype):
        adjust = ", ".join(system.dependent_coordinates) or "the coordinates"
        raise ValueError(
            f"{name}: the coordinates violate the configuration constraints by "
            f"{np.array2string(residual, precision=3)}. Find {adjust} with jaxkane.assemble(system, q, u)."
        )
    raise ValueError(
        f"{name}: what follows from the configuration constraints is violated by "
        f"{np.array2string(implied_residual(system, t, q), precision=3)}: with these parameters the loop cannot be "
        "closed."
    )


def check_left_out(system: System, t: Any, q: Any, left_out: Sequence[str]) -> Any:
    """Coordinates of which some were left out, so that they are zero: refused where that violates a constraint.

    **Raises:** `ValueError` that names them; under a trace the coordinates become NaN.
    """
    residual = _residual_of(configuration_residual, system, t, q)
    if not residual.size:
        return q
    is_met = configuration_is_met(system, t, q)
    if not is_concrete(system, t, q):
        return nan_where(~is_met, q, (system, t, q))
    if is_met:
        return q
    raise ValueError(
        f"{type(system).__name__}: with {', '.join(left_out)} left out of q, and taken as zero, the configuration "
        f"constraints are violated by {np.array2string(residual, precision=3)}. Find the state with "
        "jaxkane.assemble(system, q, u), and give its state.q; or name them."
    )


def correction(system: System, t: Component, q: Array) -> Float[Array, " n_q"]:
    """The smallest change of all coordinates (n_q,) that meets the configuration constraints, to first order.

    G = dh/dq,   dq = -G^T (G G^T)^-1 h
    """
    residual = lambda q: configuration_residual(system, t, q)  # noqa: E731
    h, G = residual(q), jax.jacfwd(residual)(q)  # (h,) (h,n_q)
    GG = G @ G.T
    rows = [[GG[i, j] for j in range(len(h))] for i in range(len(h))]
    (multipliers,) = solve(rows, [h[i] for i in range(len(h))])
    return -as_vector(multipliers, q) @ G


def projected(system: System, t: Component, q: Array, steps: int = 3) -> Float[Array, " n_q"]:
    """The nearest coordinates (n_q,) that meet the configuration constraints, from nearby: Gauss-Newton steps."""
    for _ in range(steps):
        q = q + correction(system, t, q)
    return q


def has_configuration_constraints(system: System, t: Component, q: Array) -> bool:
    return jax.eval_shape(lambda q: configuration_residual(system, t, q), q).shape[0] > 0


class DependentSpeeds(eqx.Module):
    """Which speeds the velocity residuals can be solved for. `print` shows the choices, the best first.

    Attributes:

    - `choices`: pairs of names and the condition number of their C_dep, beside the coefficients of the other speeds:
        the best first, with all that differ from it by one speed, and the current one. Infinite where the residuals
        cannot be solved for these speeds. It compares speeds of one unit best.
    - `current`: the names that the system chose, and `condition` their condition number.
    - `n_residuals`; `rank`: the number of them that are independent.
    - `redundant`: places of residuals that follow from those before them, and `conflicting`: those among them that no
        speeds can meet.
    """

    choices: tuple[tuple[tuple[str, ...], float], ...] = eqx.field(static=True)
    current: tuple[str, ...] = eqx.field(static=True)
    condition: float = eqx.field(static=True)
    n_residuals: int = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    redundant: tuple[int, ...] = eqx.field(static=True)
    conflicting: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def best(self) -> tuple[str, ...]:
        """The best conditioned choice."""
        return self.choices[0][0]

    def advice(self) -> str:
        """One or two sentences."""
        if self.rank < self.n_residuals:
            which = ", ".join(map(str, self.redundant))
            text = f"the {self.n_residuals} velocity residuals have the rank {self.rank}: residual {which} (counted "
            text += "from 0) follows from those before it. Leave it out, and name one dependent speed less for each."
            if self.conflicting:
                text += f" Residual {', '.join(map(str, self.conflicting))} also contradicts them: no speeds meet it."
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


def best_dependent_speeds(system: System, t: Component, q: Any) -> DependentSpeeds:
    """How well the velocity residuals can be solved for each choice of dependent speeds, and their rank.

        c = C u + c0,   C (k, n + k);   C_dep: the k columns of the choice

    **Arguments:** as `constraint_jacobian`: `t` [s], `q` (n_q,), numbers.

    **Returns:** `DependentSpeeds`.

    **Raises:** `ValueError` for a system without dependent speeds, and coordinates that are not finite.
    """
    check_is_system(system)
    name = type(system).__name__
    if not system.dependent_speeds:
        raise ValueError(f"{name} has no dependent speeds.")
    refuse_incomplete(system, q, {})
    q = as_array(q, system.coordinates, f"{name}: q")
    check_time(name, t)
    wrong = [c for c, x in zip(system.coordinates, np.asarray(q), strict=True) if not np.isfinite(x)]
    if wrong:
        raise ValueError(f"{name}: q is not finite: {', '.join(wrong)}.")
    C, c0 = (np.asarray(x, dtype=float) for x in constraint_rows(system, jnp.asarray(t, q.dtype), q))
    return dependent_speeds_from(C, c0, (*system.speeds, *system.dependent_speeds), system.dependent_speeds, name)


@ScalarFunction
def constraint_rows(system: System, t: Component, q: Array) -> tuple[Array, Array]:
    """C (k, n + k) and c0 (k,) of the velocity residuals."""
    kane = KaneEquations(system, t, q, jnp.zeros(len(system.speeds), q.dtype))
    rows = [(*a, *b) for a, b in zip(kane.C_ind, kane.C_dep, strict=True)]
    c0 = kane.residuals(kane.t, kane.q, (0.0,) * (kane.n + kane.k))
    return stack(rows).astype(q.dtype), as_vector(c0, q)


def dependent_speeds_from(
    C: np.ndarray, c0: np.ndarray, speeds: tuple[str, ...], current: tuple[str, ...], name: str
) -> DependentSpeeds:
    """`best_dependent_speeds` from the residuals' rows."""
    k = len(C)
    ranks = [int(np.linalg.matrix_rank(C[: i + 1], tol=1e-9 * _size(C))) for i in range(k)]
    redundant = tuple(i for i in range(k) if ranks[i] == (ranks[i - 1] if i else 0))
    kept = [i for i in range(k) if i not in redundant]
    conflicting = []
    for i in redundant:
        weights = np.linalg.lstsq(C[kept].T, C[i], rcond=None)[0]
        if abs(c0[i] - weights @ c0[kept]) > 1e-9 * max(_size(c0), 1.0):
            conflicting.append(i)
    own = tuple(speeds.index(s) for s in current)
    condition = relative_condition(C, own)
    conditions = {tuple(sorted(own)): condition} | _best_choices(C)
    ranked = sorted(((tuple(speeds[i] for i in c), float(x)) for c, x in conditions.items()), key=lambda pair: pair[1])
    return DependentSpeeds(tuple(ranked), current, condition, k, ranks[-1], redundant, tuple(conflicting), name)


def _best_choices(C: np.ndarray) -> dict[tuple[int, ...], float]:
    """The best conditioned choice of as many columns as C has rows, and those beside it, which differ in one column.

    A QR factorization with column pivoting begins; then columns are exchanged, one by one, while that improves it.
    """
    if not np.isfinite(C).all():
        return {}
    import scipy.linalg  # late: importing the library stays quick

    k, n = C.shape
    factors: Any = scipy.linalg.qr(_by_rows(C), mode="r", pivoting=True)
    best = tuple(sorted(factors[1][:k].tolist()))
    conditions = {best: relative_condition(C, best)}
    while True:
        exchanged = [tuple(sorted({*best, j} - {i})) for i in best for j in range(n) if j not in best]
        conditions = {c: conditions.get(c) or relative_condition(C, c) for c in (best, *exchanged)}
        better = min(conditions, key=lambda c: conditions[c])
        if not conditions[better] < conditions[best]:
            return conditions
        best = better


def relative_condition(C: np.ndarray, dependent: Sequence[int]) -> Any:
    """How badly the residuals' rows C (*n_t, k, n) are solved for the columns `dependent` (k,), as a number (*n_t).

        largest singular value of C / smallest of C_dep,   each row of C divided by its largest entry

    At least the condition number of C_dep. C_dep alone would not show that all of its entries are small beside those of
    the other speeds, so that these are multiplied by a large number: one residual has always the condition number 1.
    Infinite where the residuals cannot be solved, NaN where C is not finite.
    """
    finite: Any = np.isfinite(C).all(axis=(-2, -1))
    C = np.where(finite[..., None, None], C, 1.0)
    C = _by_rows(C)
    largest = np.linalg.svd(C, compute_uv=False)[..., 0]
    smallest = np.linalg.svd(C[..., list(dependent)], compute_uv=False)[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(smallest > 1e-14 * largest, largest / smallest, np.inf)
    condition = np.where(finite, condition, np.nan)
    return condition if condition.ndim else float(condition)


def _by_rows(C: np.ndarray) -> np.ndarray:
    """Each row divided by its largest entry."""
    size = np.abs(C).max(axis=-1, keepdims=True)
    return C / np.where(size > 0, size, 1.0)


def _size(x: np.ndarray) -> float:
    return float(np.abs(x).max(initial=0.0)) or 1.0
