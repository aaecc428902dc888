"""A Lagrangian of which no bodies are known: its mass matrix, and what moves with that inertia. Solves nothing.

Lagrange's equations in momentum form, with L = 1/2 u.M u + b.u + L0 for the rates u of the coordinates:

    d/dt (M u)_r = dL/dq_r + Q_r - db_r/dt

With M = C C^T the left side is that of n particles of mass 1 which move with the velocities w = C^T u along one
direction, and of forces along the speeds: Kane's method gives C dw/dt, and d/dt (C w) = C dw/dt + dC/dt w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from .._scalarjit.components import Component, add, is_exact, is_zero, mul, sub

Triangle = Sequence[Sequence[Any]]  # row i has i + 1 entries


class Inertia(NamedTuple):
    """SymPy's expressions in the order of the speeds: M, dM/dt, and the forces of the momentum form."""

    M: Triangle = ()
    M_dot: Triangle = ()
    forces: Sequence[Any] = ()


def inertia_of(sympy: Any, lagrange: Any, speeds: dict[Any, Any], name: str) -> Inertia:
    """What a `LagrangesMethod` says about inertia and forces, without bodies.

    **Arguments:** `speeds`: the coordinates with their speeds, in the order of the speeds.

    **Raises:** `ValueError` where L is no quadratic function of the rates; for a load without a frame to measure its
    velocity in, and for one whose velocity does not follow from the rates of the coordinates. `TypeError` for a load
    that acts neither at a point nor on a frame.
    """
    t = sympy.physics.mechanics.dynamicsymbols._t
    to_speeds = {c.diff(t): u for c, u in speeds.items()}
    rate = lambda x: x.diff(t).xreplace(to_speeds)  # noqa: E731
    L, u = lagrange._L[0].xreplace(to_speeds), list(speeds.values())
    strange = sorted(map(str, L.atoms(sympy.Derivative)))
    if strange:
        raise ValueError(
            f"{name}: the Lagrangian holds {strange[0]}; of derivatives it may hold the first of the coordinates. What "
            "is prescribed in time is written as an expression of time."
        )
    M = [[_without(sympy, L.diff(x, y), u, name) for y in u[: i + 1]] for i, x in enumerate(u)]
    # The momenta beside M u: L may hold terms of the first order in the rates, as of a moving frame.
    at_rest = dict.fromkeys(u, sympy.S.Zero)
    forces = []
    for c, x in speeds.items():
        b = L.diff(x).xreplace(at_rest)
        forces.append(L.diff(c) - rate(b) + _of_loads(sympy, lagrange, c.diff(t), name))
    return Inertia(M, [[rate(entry) for entry in row] for row in M], forces)


def _without(sympy: Any, entry: Any, speeds: list[Any], name: str) -> Any:
    entry = sympy.simplify(entry)
    if entry.has(*speeds):
        raise ValueError(
            f"{name}: the Lagrangian is no quadratic function of the rates of the coordinates: a second derivative by "
            f"them is {entry}. A mass matrix depends on time and coordinates alone."
        )
    return entry


def _of_loads(sympy: Any, lagrange: Any, rate: Any, name: str) -> Any:
    """The generalized force along one rate: F . dv/du + T . domega/du, summed."""
    mechanics, N, total = sympy.physics.mechanics, lagrange.inertial, sympy.S.Zero
    known = {*lagrange.q, *lagrange._qdots}
    for part, vector in lagrange.forcelist:
        if N is None:
            raise ValueError(f"{name}: a load at {part} needs the inertial frame: LagrangesMethod(..., frame=N).")
        if not isinstance(part, (mechanics.Point, mechanics.ReferenceFrame)):
            raise TypeError(f"{name}: a load of LagrangesMethod acts at a Point or on a ReferenceFrame, got {part!r}.")
        try:
            v = part.ang_vel_in(N) if isinstance(part, mechanics.ReferenceFrame) else part.vel(N)
        except ValueError as error:
            raise ValueError(f"{name}: {part}, at which a load acts, has no velocity in {N}: {error}") from error
        foreign = sorted(mechanics.find_dynamicsymbols(v, reference_frame=N) - known, key=str) if v != 0 else []
        if foreign:
            raise ValueError(
                f"{name}: the velocity of {part}, at which a load acts, holds {foreign[0]}, which is neither "
                f"coordinate nor rate of one: write it by {rate} and the like."
            )
        total += v.diff(rate, N).dot(vector) if v != 0 else 0
    return total


# As numbers: scalars, of which exact zeros stay exact.


def factor(M: Triangle) -> list[list[Component]]:
    """C of M = C C^T, the lower triangle. NaN for what is not positive definite; a row of exact zeros is one of C."""
    return _factors(M, [[0.0] * len(row) for row in M])[0]


def factor_rate(M: Triangle, M_dot: Triangle) -> list[list[Component]]:
    """dC/dt of M = C C^T."""
    return _factors(M, M_dot)[1]


def _factors(M: Triangle, M_dot: Triangle) -> tuple[list[list[Component]], list[list[Component]]]:
    C: list[list[Component]] = []
    C_dot: list[list[Component]] = []
    for i, (row, row_dot) in enumerate(zip(M, M_dot, strict=True)):
        C.append([])
        C_dot.append([])
        for j in range(i + 1):
            entry, rate = row[j], row_dot[j]
            for k in range(j):
                entry = sub(entry, mul(C[i][k], C[j][k]))
                rate = sub(rate, add(mul(C_dot[i][k], C[j][k]), mul(C[i][k], C_dot[j][k])))
            if j < i:
                C[i].append(_quotient(entry, C[j][j]))
                C_dot[i].append(_quotient(sub(rate, mul(C[i][j], C_dot[j][j])), C[j][j]))
            else:
                C[i].append(_root(entry))
                C_dot[i].append(_quotient(mul(0.5, rate), C[i][i]))
    return C, C_dot


def _root(x: Component) -> Component:
    if is_exact(x):
        return math.sqrt(x) if x >= 0.0 else math.nan
    return jnp.sqrt(x)


def _quotient(a: Component, b: Component) -> Component:
    if is_zero(a):
        return 0.0
    return math.nan if is_zero(b) else a / b
