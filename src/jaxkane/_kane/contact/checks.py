"""Checks of contacts: contradictions between their gaps, velocities and speeds, and gaps that are negative."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Array

from ..._common.lookup import refuse_if
from ..._scalarjit.compat import concretely
from ..._scalarjit.components import Component, Numbers, as_vector
from ..._scalarjit.nan import constant
from ..._scalarjit.scalar_function import ScalarFunction
from ..._system.parameters import in_batches
from ..._system.system import System
from ..arguments import is_concrete
from ..constraint_residuals import configuration_residual
from ..description import at_random_point
from ..kanes_method import KaneEquations
from ..scaling import nearest_root
from .forces import PENETRATION, ContactLayout, ContactRows, gap_sizes, gap_tolerances, has_contacts, layout_of


@ScalarFunction
def _rows(system: System, t: Component, q: Array, u: Array) -> tuple[Array, Array, Array]:
    """The gaps of all contacts (c,), their rates, and the velocities (c r,)."""
    kane, layout = KaneEquations(system, t, q, u), layout_of(system)
    rows, at = ContactRows(kane, layout), (kane.t, kane.q, kane.u_all)
    v = as_vector([x for row in rows.velocities(*at) for x in row], q)
    return as_vector(rows.gaps(*at), q), as_vector(rows.gap_rates(*at), q), v


@ScalarFunction
def _gaps(system: System, t: Component, q: Array) -> Array:
    kane = KaneEquations(system, t, q, (0.0,) * len(system.speeds))
    return as_vector(ContactRows(kane, layout_of(system)).gaps(kane.t, kane.q, kane.u_all), q)


def check_contacts(system: System, t: Component, q: Numbers, *, may_penetrate: bool = False) -> None:
    """Raise `ValueError` if the gap of a contact contradicts the velocity of its point, or if bodies penetrate.

    A contact is checked at the coordinates `q`, and at nearby coordinates and a later time at which it touches. The
    result depends on the values of the parameters. Traced numbers, and coordinates that are None, are replaced as by
    `check_system`. With `may_penetrate`, the gaps at `q` may be negative.
    """
    if not has_contacts(system) or in_batches(system):
        return
    layout, rng = layout_of(system), np.random.default_rng(0)
    if not layout.names:
        return
    given = constant((system, t, q))
    with concretely(), np.errstate(all="ignore"):
        system, t, q = at_random_point(given, rng)
        t = np.asarray(t, q.dtype)
        _check_rows(system, layout, t, q, range(len(layout.names)))
        near, late = (q + rng.uniform(-0.1, 0.1, q.shape)).astype(q.dtype), t + np.asarray(0.3, q.dtype)
        for i, is_bearing in enumerate(layout.is_bearing):
            _check_rows(system, layout, late, near if is_bearing else _touching(system, late, near, i), [i])
        if may_penetrate or given[2] is None or not is_concrete(given):
            return
        gaps, sizes = gap_sizes.numpy(system, t, q, np.zeros(len(system.speeds), q.dtype))
    for name, gap, tolerance, size in zip(layout.names, gaps, gap_tolerances(sizes), sizes, strict=True):
        text = f"{type(system).__name__}.contacts: the gap of {name!r} is {gap:.6g} at the start."
        refuse_if(
            gap < -PENETRATION * size,
            f"{text} It must not be negative. Find touching coordinates with "
            f"jaxkane.assemble(system, q, touching=({name!r},)).",
        )
        if gap < -tolerance:
            warnings.warn(
                f"{text} The simulation starts from the nearest coordinates with a gap of zero.", stacklevel=2
            )


def _touching(system: System, t: np.ndarray, q: np.ndarray, i: int) -> np.ndarray:
    """Coordinates near `q` at which contact `i` touches, by the Gauss-Newton method; NaN if there are none.

    The gap to a curved surface need not be a distance. Only where it is zero, its rate must be the normal velocity.
    """
    along = None, None, np.eye(len(q), dtype=q.dtype)

    def scaled(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = system, t, q
        h = np.append(configuration_residual.numpy(*at), _gaps.numpy(*at)[i])
        G = np.vstack([configuration_residual.numpy_jvp(at, along), _gaps.numpy_jvp(at, along)[i]])
        norms = np.linalg.norm(G, axis=1)
        norms[:-1][norms[:-1] == 0] = 1.0  # a gap that does not change gives NaN
        return h / norms, G / norms[:, None]

    return nearest_root(scaled, q)


def _check_rows(system: System, layout: ContactLayout, t: np.ndarray, q: np.ndarray, which: range | list[int]) -> None:
    label = f"{type(system).__name__}.contacts"
    u = np.random.default_rng(0).uniform(0.5, 1.5, len(system.speeds)).astype(q.dtype)
    (gaps, rates, v), (gaps_0, _, v_0), (gaps_2, _, v_2) = (_rows.numpy(system, t, q, s * u) for s in (1.0, 0.0, -2.0))
    eps = float(np.finfo(q.dtype).eps)
    tolerance = 1e3 * eps**0.75
    v, v_0, v_2 = (x.reshape(len(layout.names), -1) for x in (v, v_0, v_2))
    for name, i in ((layout.names[i], i) for i in which):
        size = np.max(np.abs([v[i], v_0[i], v_2[i]]))
        size = size if size > 1e4 * eps else 1.0  # the velocity of a point that cannot move is a rounding error
        refuse_if(
            layout.has_point[i] and abs(rates[i] - v[i, 0]) > tolerance * (abs(rates[i]) + size),
            f"{label}: the gap of {name!r} changes by {rates[i]:.6g}, but the velocity of its point along the normal "
            f"is {v[i, 0]:.6g} (at speeds of size 1). Pass the material point that touches, and its gap. "
            "If the surface turns, also pass the point of the surface below it as `surface`.",
        )
        refuse_if(
            np.any(np.abs(v_2[i] - v_0[i] + 2.0 * (v[i] - v_0[i])) > tolerance * size)
            or (max(abs(gaps[i] - gaps_0[i]), abs(gaps_2[i] - gaps_0[i])) > tolerance * abs(gaps_0[i])),
            f"{label}: {name!r} needs a gap and a normal that do not depend on the speeds, and a slip that is "
            "affine in the speeds. Remove products, squares and abs() of speeds.",
        )
