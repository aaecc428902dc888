"""Orientation of a rigid body: body-fixed sequences and Euler parameters. Does not depend on frames or bodies.

`[R]` is the transformation matrix of the textbook: it maps components in the parent frame to components in the rotated
frame. Every function operates on scalars and preserves exact zeros and ones.
Source: Kamman, Volume II, Unit 5, Examples 2, 6, 7 and Exercises 5.6, 5.8.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp

from ._common.lookup import refuse_if
from ._scalarjit.components import Component, Triple, add, cross, dot, is_exact, matvec, mul, several, sub

__all__ = [
    "IDENTITY", "Matrix", "angle_rates", "angular_velocity", "axes_of", "cosine_and_sine", "euler_parameter_norm",
    "euler_parameter_rates", "euler_parameters_matrix", "matmul", "normalized", "of_rotation_vector",
    "rodrigues_matrix", "sequence_matrix", "simple_rotation", "transpose",
]  # fmt: skip

Matrix = tuple[Triple, Triple, Triple]

_FOUR = "Euler parameters are four numbers, the scalar last"
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def axes_of(sequence: str) -> tuple[int, ...]:
    """The axes (0, 1 or 2) of a body-fixed sequence such as "3-1-2" or "312"."""
    digits = str(sequence).replace("-", "")
    refuse_if(
        not digits or any(d not in "123" for d in digits),
        f'A body-fixed sequence is written with the axes 1, 2, 3, such as "3-1-2"; got {sequence!r}.',
    )
    return tuple(int(d) - 1 for d in digits)


def simple_rotation(axis: int, angle: Component) -> Matrix:
    """[R] of a right-hand rotation by `angle` [rad] about axis 0, 1 or 2."""
    (c, s), i, j = cosine_and_sine(angle), (axis + 1) % 3, (axis + 2) % 3
    rows: list[list[Component]] = [[0.0] * 3 for _ in range(3)]
    rows[axis][axis] = 1.0
    rows[i][i], rows[i][j] = c, s
    rows[j][i], rows[j][j] = -s, c
    return _frozen(rows)


def cosine_and_sine(angle: Component) -> tuple[Component, Component]:
    """Those of an exact angle are exact numbers, which need no operation of JAX."""
    if is_exact(angle) and math.isfinite(angle):
        return math.cos(angle), math.sin(angle)
    return jnp.cos(angle), jnp.sin(angle)


def _frozen(rows: Iterable[Iterable[Component]]) -> Matrix:
    return tuple(tuple(row) for row in rows)  # type: ignore[return-value]


def transpose(matrix: Matrix) -> Matrix:
    """The transpose, which is the inverse of a rotation matrix."""
    return _frozen(zip(*matrix, strict=True))


def matmul(a: Matrix, b: Matrix) -> Matrix:
    """The product a b."""
    columns = transpose(b)
    return _frozen([dot(row, column) for column in columns] for row in a)


def sequence_matrix(sequence: str, angles: Sequence[Component]) -> Matrix:
    """[R] of a body-fixed sequence of rotations, from parent components to rotated components.

    **Arguments:**

    - `sequence`: the axes in their order, such as "3-1-2".
    - `angles`: one for each axis [rad].
    """
    rotation, axes = IDENTITY, axes_of(sequence)
    for axis, angle in zip(axes, several(angles, len(axes), f"{sequence!r} takes {len(axes)} angles"), strict=True):
        rotation = matmul(simple_rotation(axis, angle), rotation)
    return rotation


def _rate_directions(sequence: str, angles: Sequence[Component]) -> list[Triple]:
    # For each angle, the derivative of the angular velocity by its rate, in components of the rotated frame.
    rest = IDENTITY
    columns: list[Triple] = []
    axes = axes_of(sequence)
    angles = several(angles, len(axes), f"{sequence!r} takes {len(axes)} angles")
    for axis, angle in reversed(list(zip(axes, angles, strict=True))):
        columns.append((rest[0][axis], rest[1][axis], rest[2][axis]))
        rest = matmul(rest, simple_rotation(axis, angle))
    return columns[::-1]


def angular_velocity(sequence: str, angles: Sequence[Component], rates: Sequence[Component]) -> Triple:
    """Angular velocity of the rotated frame relative to its parent [rad/s], with components in the rotated frame.

    **Arguments:**

    - `sequence`: the axes in their order, such as "3-1-3".
    - `angles`: one for each axis [rad].
    - `rates`: time derivatives of the angles [rad/s].
    """
    columns = _rate_directions(sequence, angles)
    rates = several(rates, len(columns), f"{sequence!r} takes {len(columns)} rates")
    return matvec(list(zip(*columns, strict=True)), rates)  # type: ignore[return-value]


def angle_rates(sequence: str, angles: Sequence[Component], omega: Sequence[Component]) -> Triple:
    """Rates of the three angles of a body-fixed sequence [rad/s], from body-fixed components of angular velocity.

    This is the inverse of `angular_velocity`. In gimbal lock it does not exist: the sine (3-1-3) or the cosine
    (3-2-1, 3-1-2, 1-2-3) of the second angle is zero, and the rates become infinite.

    **Arguments:**

    - `sequence`: three axes in their order, such as "3-1-3".
    - `angles`: three angles [rad].
    - `omega`: three components of the angular velocity in the rotated frame [rad/s].
    """
    a, b, c = several(_rate_directions(sequence, angles), 3, "angle_rates takes a sequence of three axes")
    omega = several(omega, 3, "An angular velocity has three components")
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)  # the reciprocal basis of the three directions
    det = dot(a, bc)
    return tuple(_divide(dot(x, omega), det) for x in (bc, ca, ab))  # type: ignore[return-value]


def _divide(a: Component, b: Component) -> Component:
    return 0.0 if isinstance(a, float) and a == 0.0 else a / b


def euler_parameters_matrix(parameters: Sequence[Component]) -> Matrix:
    """[R] of Euler parameters (e1, e2, e3, e4) of unit norm.

    The scalar e4 is last, as in the textbook (Example 2). In jaxlie and MuJoCo, the scalar is first.
    """
    e1, e2, e3, e4 = several(parameters, 4, _FOUR)
    return (
        (e1 * e1 - e2 * e2 - e3 * e3 + e4 * e4, 2.0 * (e1 * e2 + e3 * e4), 2.0 * (e1 * e3 - e2 * e4)),
        (2.0 * (e1 * e2 - e3 * e4), e2 * e2 - e1 * e1 - e3 * e3 + e4 * e4, 2.0 * (e2 * e3 + e1 * e4)),
        (2.0 * (e1 * e3 + e2 * e4), 2.0 * (e2 * e3 - e1 * e4), e3 * e3 - e1 * e1 - e2 * e2 + e4 * e4),
    )


def normalized(parameters: Sequence[Component]) -> tuple[Component, ...]:
    """Euler parameters divided by their norm. Exact numbers remain exact.

    **Raises:** `ValueError` if all are exactly zero.
    """
    parameters = several(parameters, 4, _FOUR)
    square = dot(parameters, parameters)
    if not is_exact(square):
        norm = jnp.sqrt(square)
        return tuple(_divide(e, norm) for e in parameters)
    if square == 0.0:
        raise ValueError(
            "The Euler parameters are all zero, which does not describe an orientation. For the reference orientation, "
            "pass (0.0, 0.0, 0.0, 1.0)."
        )
    return tuple(parameters) if abs(square - 1.0) < 1e-15 else tuple(e / math.sqrt(square) for e in parameters)


def euler_parameter_rates(parameters: Sequence[Component], omega: Sequence[Component]) -> tuple[Any, Any, Any, Any]:
    """Rates of Euler parameters (scalar last) [1/s] from body-fixed components of angular velocity [rad/s].

    {e_dot} = 1/2 [E']^T {w1, w2, w3, 0}        (Example 2)
    """
    e1, e2, e3, e4 = several(parameters, 4, _FOUR)
    half = [mul(0.5, w) for w in several(omega, 3, "An angular velocity has three components")]
    rows = ((e4, -e3, e2), (e3, e4, -e1), (-e2, e1, e4), (-e1, -e2, -e3))
    return tuple(dot(row, half) for row in rows)  # type: ignore[return-value]


def euler_parameter_norm(parameters: Sequence[Component]) -> Component:
    """e1^2 + e2^2 + e3^2 + e4^2 - 1: the residual of the configuration constraint of Euler parameters."""
    e = several(parameters, 4, _FOUR)
    return sub(dot(e, e), 1.0)


def of_rotation_vector(vector: Sequence[Component]) -> tuple[Component, Component, Component, Component]:
    """Euler parameters (scalar last) of a rotation vector r [rad]: (r sin(a / 2) / a, cos(a / 2)), a = |r|.

    The function is smooth at zero.
    """
    vector = several(vector, 3, "A rotation vector has three components")
    square = dot(vector, vector)
    if is_exact(square):
        angle = math.sqrt(square)
        ratio, scalar = (math.sin(0.5 * angle) / angle if angle else 0.5), math.cos(0.5 * angle)
    else:
        # Below 1e-4, the series is exact within rounding. It avoids the square root of zero, which has no derivative.
        small = square < 1e-4
        angle = jnp.sqrt(jnp.where(small, 1.0, square))
        series = 0.5 - square / 48 + square**2 / 3840 - square**3 / 645120
        ratio = jnp.where(small, series, jnp.sin(0.5 * angle) / angle)
        series = 1.0 - square / 8 + square**2 / 384 - square**3 / 46080
        scalar = jnp.where(small, series, jnp.cos(0.5 * angle))
    return (*(mul(ratio, x) for x in vector), scalar)  # type: ignore[return-value]


def rodrigues_matrix(axis: Triple, c: Component, s: Component) -> Matrix:
    """[R] of a rotation about the unit vector `axis`, from the cosine and sine of its angle (Rodrigues' formula)."""
    is_along = all(is_exact(a) and abs(a) in (0.0, 1.0) for a in axis)  # one of the coordinate axes
    versine = 0.0 if is_along else sub(1.0, c)
    rows: list[list[Component]] = []
    for i in range(3):
        row = []
        for j in range(3):
            entry = mul(mul(axis[i], axis[j]), versine)
            if i == j:
                entry = 1.0 if is_along and axis[i] else add(entry, c)
            else:
                k = 3 - i - j
                turn = mul(s, axis[k])
                entry = add(entry, turn) if (j - i) % 3 == 1 else sub(entry, turn)
            row.append(entry)
        rows.append(row)
    return _frozen(rows)
