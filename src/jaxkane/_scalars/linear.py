"""Linear systems of a few scalars, solved without leaving the scalars. Knows no mechanics.

Small systems are written out (Cramer's rule up to three unknowns, L D L^T without pivoting for positive definite
ones), which keeps exact zeros and lets a batch stay component-major; larger ones go to LAPACK.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl

from .components import cross, dot, is_exact, is_zero, mul, sub
from .types import Component

Rows = Sequence[Sequence[Component]]

_CRAMER_UP_TO = 3
_UNROLL_UP_TO = 12


def solve(A: Rows, *rights: Sequence[Component]) -> list[tuple[Component, ...]]:
    """The solutions x of A x = b for several right-hand sides b."""
    n = len(A)
    if n == 0:
        return [() for _ in rights]
    if n > _CRAMER_UP_TO:
        matrix = stack(A)
        solution = _solved_by_lapack(matrix, jnp.stack([stack([b])[0] for b in rights], axis=-1))
        return [tuple(solution[i, j] for i in range(n)) for j in range(len(rights))]
    adjugate, det = _adjugate(A)
    if is_zero(det):  # an unknown that no equation holds: no number is right, and a zero must not hide it
        return [(math.nan,) * n for _ in rights]
    reciprocal = 1.0 / det
    return [tuple(mul(dot(row, b), reciprocal) for row in adjugate) for b in rights]


def determinant(A: Rows) -> Component:
    """det A."""
    return _adjugate(A)[1] if len(A) <= _CRAMER_UP_TO else _det_by_lapack(stack(A))


# By these names `fuse` knows that it is not the description that calls a library.


@jax.jit
def _solved_by_lapack(matrix, rights):
    return jnp.linalg.solve(matrix, rights)


@jax.jit
def _det_by_lapack(matrix):
    return jnp.linalg.det(matrix)


def _adjugate(A: Rows) -> tuple[Rows, Component]:
    if len(A) == 1:
        return ((1.0,),), A[0][0]
    if len(A) == 2:
        (a, b), (c, d) = A
        return ((d, mul(-1.0, b)), (mul(-1.0, c), a)), sub(mul(a, d), mul(b, c))
    r1, r2, r3 = (tuple(row) for row in A)
    columns = cross(r2, r3), cross(r3, r1), cross(r1, r2)  # type: ignore[arg-type]
    return tuple(zip(*columns, strict=True)), dot(r1, columns[0])


def is_written_out(n: int) -> bool:
    """Whether positive definite systems of n unknowns are solved among the scalars."""
    return n <= _UNROLL_UP_TO


def solve_positive_array(M, b):
    """The solution x (n,) of M x = b for a symmetric positive definite array M (n, n), by LAPACK."""
    return jsl.cho_solve(jsl.cho_factor(M), b)


def solve_positive(M: Rows, b: Sequence[Component]) -> tuple[Component, ...]:
    """The solution x of M x = b for a symmetric positive definite M, of which the upper triangle is read."""
    n = len(M)
    # M = L D L^T, column by column; d holds the pivots, L the rows below the diagonal.
    L: list[list[Component]] = [[0.0] * n for _ in range(n)]
    d: list[Component] = []
    for j in range(n):
        pivot = M[j][j]
        for k in range(j):
            pivot = sub(pivot, mul(mul(L[j][k], L[j][k]), d[k]))
        d.append(pivot)
        for i in range(j + 1, n):
            entry = M[j][i]
            for k in range(j):
                entry = sub(entry, mul(mul(L[i][k], L[j][k]), d[k]))
            L[i][j] = entry if is_zero(entry) else _quotient(entry, pivot)
    y = list(b)
    for i in range(n):
        for k in range(i):
            y[i] = sub(y[i], mul(L[i][k], y[k]))
    x = [_quotient(y_i, d_i) for y_i, d_i in zip(y, d, strict=True)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = sub(x[i], mul(L[k][i], x[k]))
    return tuple(x)


def _quotient(a: Component, b: Component) -> Component:
    if is_zero(b):
        return math.nan
    return a if is_zero(a) else a / b


def as_vector(row: Sequence[Component], like: Any) -> Any:
    """A row of components as an array (n,) of the type of `like`."""
    return stack([row])[0].astype(like.dtype)


def stack(rows: Rows):
    """Rows of components as an array (m, n)."""
    width = len(rows[0]) if rows else 0
    flat = [a for row in rows for a in row]
    if not flat:
        return jnp.zeros((len(rows), width))
    dtype = jnp.result_type(*([a for a in flat if not is_exact(a)] or [float]))
    return jnp.stack([jnp.asarray(a, dtype=dtype) for a in flat]).reshape(len(rows), width)
