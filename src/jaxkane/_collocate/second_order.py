"""Whether a stationary point of a nonlinear program is a minimum.

A solver stops where the gradient of the Lagrangian is zero. It is also zero at a maximum or a saddle point. At a
minimum, the Hessian H of the Lagrangian has no negative curvature along directions d with J d = 0 (J. Nocedal, S.
Wright, Numerical Optimization, 2006, section 12.5). Here J contains the active constraints, and variables at their
bounds are fixed. The least curvature is computed by the method of Lanczos, which only needs products with H and
projections onto J d = 0. Each projection solves a system of linear equations with banded factors.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph

from .program import NonlinearProgram
from .solvers import Solution

NOT_A_MINIMUM = "stationary, but not a minimum: pass another guess"


def refused_unless_minimum(program: NonlinearProgram, border: np.ndarray, solution: Solution) -> Solution:
    """The solution, with the status `NOT_A_MINIMUM` if it is stationary but not a minimum.

    **Arguments:**

    - `program`: the nonlinear program.
    - `border`: the indices of the variables that occur in the equations of all nodes.
    - `solution`: the result of a solver.
    """
    if solution.ok and _has_negative_curvature(program, border, solution):
        return dataclasses.replace(solution, ok=False, status=NOT_A_MINIMUM)
    return solution


def _has_negative_curvature(program: NonlinearProgram, border: np.ndarray, solution: Solution) -> bool:
    """Whether the curvature along a direction of the active constraints is negative beyond rounding errors."""
    z, g = solution.z, program.constraints(solution.z)
    free = ~_at_bound(z, program.lower, program.upper, solution.bound_multipliers)
    active = _at_bound(g, program.g_lower, program.g_upper, solution.multipliers)
    rows, columns = program.hessian_structure
    lower = scipy.sparse.csr_matrix((program.hessian(z, solution.multipliers), (rows, columns)), (program.n,) * 2)
    H: Any = (lower + scipy.sparse.tril(lower, -1).T).tocsr()[free][:, free]
    J: Any = scipy.sparse.csr_matrix((program.jacobian(z), program.jacobian_structure), (program.m, program.n))
    is_border = np.isin(np.arange(program.n), border)[free]
    project = _Projection(J[active][:, free], is_border)
    v = project(project(np.random.default_rng(0).normal(size=int(free.sum()))))
    if not np.linalg.norm(v) > 1e-3:  # the constraints determine all variables
        return False
    V, diagonal, beside = np.zeros((min(_STEPS, v.size) + 1, v.size)), [], []
    V[0] = v / np.linalg.norm(v)
    for k in range(len(V) - 1):
        w = project(H @ V[k])
        diagonal.append(float(V[k] @ w))
        for _ in range(2):  # a single orthogonalization leaves rounding errors, which grow
            w = w - V[: k + 1].T @ (V[: k + 1] @ w)
        beside.append(float(np.linalg.norm(w)))
        if beside[-1] < 1e-9 * max(np.abs(diagonal)):
            break
        V[k + 1] = w / beside[-1]
    _, vectors = scipy.linalg.eigh_tridiagonal(diagonal, beside[: len(diagonal) - 1])
    # The direction is a proof, whether or not Lanczos converged, if it meets the constraints: steps beyond the number
    # of directions add vectors of rounding errors, which the projection removes.
    d = project(V[: len(diagonal)].T @ vectors[:, 0])
    negligible = max(1e-7 * float(np.max(np.abs(H.data), initial=0.0)), 1e-8)
    return bool(abs(np.linalg.norm(d) - 1.0) < 1e-3 and d @ (H @ d) < -negligible)


_STEPS = 80  # of the method of Lanczos


def _at_bound(x: np.ndarray, lower: np.ndarray, upper: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Whether numbers are at a bound. In an interior point method, their distance is then less than the multiplier."""
    distance = np.minimum(x - lower, upper - x)
    return (lower >= upper) | (distance < np.maximum(1e-6, np.abs(multipliers)))


class _Projection:
    """The orthogonal projection onto J d = 0, for J (m, n). `is_border` (n,): the columns that are eliminated last."""

    def __init__(self, J: Any, is_border: np.ndarray):
        self.inner, self.border, m = np.flatnonzero(~is_border), np.flatnonzero(is_border), J.shape[0]
        part, of_border = J[:, self.inner], J[:, self.border].toarray()
        # With a small number instead of zero, constraints that depend on each other do not make the matrix singular.
        blocks = [[scipy.sparse.identity(part.shape[1]), part.T], [part, -1e-12 * scipy.sparse.identity(m)]]
        matrix = scipy.sparse.bmat(blocks, format="csr")
        order = np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(matrix, symmetric_mode=True))
        self.factors = BandedFactors(matrix, order, order)
        self.coupling = np.concatenate([np.zeros((part.shape[1], len(self.border))), of_border])
        self.solved = self.factors.solve(self.coupling)
        self.schur = np.eye(len(self.border)) - self.coupling.T @ self.solved

    def __call__(self, v: np.ndarray) -> np.ndarray:
        right = np.concatenate([v[self.inner], np.zeros(len(self.coupling) - len(self.inner))])
        step = self.factors.solve(right[:, None])[:, 0]
        d, x = np.empty_like(v), np.linalg.solve(self.schur, v[self.border] - self.coupling.T @ step)
        d[self.border], d[self.inner] = x, (step - self.solved @ x)[: len(self.inner)]
        return d


class BandedFactors:
    """The LU factors of a sparse matrix that is banded in a suitable order.

    **Arguments:**

    - `matrix`: a sparse matrix (n, n).
    - `rows`, `columns`: an order of its rows and columns in which it is banded.

    **Raises:** `np.linalg.LinAlgError` if it is singular.
    """

    def __init__(self, matrix: Any, rows: np.ndarray, columns: np.ndarray):
        self.rows, self.columns, n = rows, columns, matrix.shape[0]
        ordered = scipy.sparse.coo_matrix(matrix.tocsr()[rows][:, columns])
        i, j = ordered.row, ordered.col
        self.below, self.above = int(np.max(i - j, initial=0)), int(np.max(j - i, initial=0))
        band = np.zeros((2 * self.below + self.above + 1, n))
        band[self.below + self.above + i - j, j] = ordered.data
        factorize, self._solve = scipy.linalg.get_lapack_funcs(("gbtrf", "gbtrs"), (band,))
        self.lu, self.pivots, info = factorize(band, self.below, self.above, overwrite_ab=True)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")

    @property
    def log_determinant(self) -> float:
        return float(np.sum(np.log(np.abs(self.lu[self.below + self.above]))))

    def solve(self, b: np.ndarray) -> np.ndarray:
        """The solution (n, k) for right-hand sides (n, k)."""
        x, info = self._solve(self.lu, self.below, self.above, b[self.rows], self.pivots)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")
        solved = np.empty_like(x)
        solved[self.columns] = x
        return solved
