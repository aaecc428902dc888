"""Covariances of a fit by collocation, and the marginal likelihood of its parameters if inputs are unknown.

At the minimum of half a sum of squares with the linearized constraints J dx = 0, the covariance of the variables x is
the upper left block of the inverse of the matrix of Karush, Kuhn and Tucker

    [ H  J^T ]
    [ J   0  ]

with the Hessian H of the Lagrangian (Y. Bard, Nonlinear Parameter Estimation, 1974, section 7-6). The variables of the
nodes are eliminated first. In the order of Cuthill and McKee this part of the matrix is banded, and LAPACK factorizes
it in a fraction of a second. SuperLU took 40 to 90 s for 23 000 variables: the parameters occur in all equations.

If inputs are unknown, the estimate of all unknowns together is biased: for unknown inputs w with few measurements each,
the most probable (w, parameters) is not near the most probable parameters. With Laplace's approximation of the integral
over w,

    -2 log p(parameters) = min_w cost(w, parameters) + log det (Hessian of half the cost by w) + constant

(for a linear system with normal noise this is exact and equals the likelihood of a Kalman filter). The Hessian is the
one with all states as functions of w and the initial state, so that its determinant is that of the matrix above divided
by det(dg/dy)^2, where y are the states that the equations g determine.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..._collocate.program import NonlinearProgram
from ..._collocate.solvers import BandedFactors, Solution
from ..._collocate.transcription import Layout, Transcription


class Kkt:
    """The matrix at a point, without variables that are fixed or at a bound.

    **Arguments:**

    - `program`: the nonlinear program. Its cost is a sum of squares, of which minus the log density is half.
    - `border`: the variables that are eliminated last: parameters.
    - `z` (n,), `multipliers` (n_g,): the point, in scaled numbers.
    """

    def __init__(self, program: NonlinearProgram, border: np.ndarray, z: np.ndarray, multipliers: np.ndarray):
        self.program = program
        is_free = (z - program.lower > 1e-7) & (program.upper - z > 1e-7)
        self.inner, self.border = np.setdiff1d(np.flatnonzero(is_free), border), border[is_free[border]]
        rows, columns = program.hessian_structure
        lower = scipy.sparse.csr_matrix((program.hessian(z, multipliers), (rows, columns)), (program.n,) * 2)
        # Half of the cost, in its own unit, so that the matrix is the curvature of minus the log density.
        H = 0.5 * program.f_scale * (lower + scipy.sparse.tril(lower, -1).T).tocsr()
        J = scipy.sparse.csr_matrix((program.jacobian(z), program.jacobian_structure), (program.m, program.n))
        inner, border = self.inner, self.border
        K = scipy.sparse.bmat([[H[inner][:, inner], J[:, inner].T], [J[:, inner], None]], format="csr")
        order = np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(K, symmetric_mode=True))
        self.factors = BandedFactors(K, order, order)
        self.coupling = np.concatenate([H[inner][:, border].toarray(), J[:, border].toarray()])
        self.solved = self.factors.solve(self.coupling)
        self.schur = H[border][:, border].toarray() - self.coupling.T @ self.solved
        self.J = J

    def covariance(self, variables: np.ndarray) -> np.ndarray:
        """The covariance of some variables of the border, in their own units.

        It is zero for fixed variables, and NaN if the data do not determine the variables.
        """
        place = np.full(self.program.n, -1)
        place[self.border] = np.arange(len(self.border))
        own, scale = place[variables], self.program.x_scale[variables]
        result = inverse(self.schur)[np.ix_(own, own)] * np.outer(scale, scale)
        return np.where((own[:, None] < 0) | (own < 0), 0.0, result)


def inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of a positive-definite matrix; NaN if it is not positive definite."""
    if not information.size:
        return information
    size = np.sqrt(np.abs(np.diag(information)))
    scaled = information / np.outer(size, size)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return np.full_like(information, np.nan)
    return np.linalg.inv(scaled) / np.outer(size, size)


class Point(NamedTuple):
    """The most probable motion for some parameters.

    - `z` (n,), `multipliers` (n_g,): scaled variables and multipliers.
    - `value`: -2 log p.
    - `slopes` (n, p): derivatives of z by the scaled parameters, or None.
    """

    z: np.ndarray
    multipliers: np.ndarray
    value: float
    slopes: np.ndarray | None


@dataclasses.dataclass(frozen=True)
class Marginal:
    """-2 log p as a function of the shared parameters.

    - `transcription`: the nonlinear program.
    - `shared`: the indices of the shared parameters. `local`: those of the unknowns of trials.
    """

    transcription: Transcription
    shared: np.ndarray
    local: np.ndarray

    def at(self, theta: np.ndarray, start: Point) -> Point:
        """The value at scaled parameters theta (p,), by Newton's method from a motion for similar parameters."""
        program, half = self.transcription.program, 0.5 * self.transcription.program.f_scale
        z, multipliers = start.z.copy(), start.multipliers
        if start.slopes is not None:  # to first order
            z += start.slopes @ (theta - z[self.shared])
        z[self.shared] = theta
        for _ in range(_NEWTON):
            kkt = self._kkt(z, multipliers)
            is_local = np.isin(kkt.border, self.local)
            S = kkt.schur[np.ix_(is_local, is_local)]
            g, gradient = program.constraints(z), half * program.gradient(z)
            right = -np.concatenate([gradient[kkt.inner], g - np.clip(g, program.g_lower, program.g_upper)])
            step = kkt.factors.solve(right[:, None])[:, 0]
            change = np.linalg.solve(S, -gradient[kkt.border][is_local] - kkt.coupling[:, is_local].T @ step)
            step = step - kkt.solved[:, is_local] @ change
            n = len(kkt.inner)
            z[kkt.border[is_local]] += change
            z[kkt.inner] += step[:n]
            multipliers = step[n:] / half
            if np.max(np.abs(step[:n])) < 1e-6:
                break
        value = program.objective(z) * program.f_scale + kkt.factors.log_determinant
        for p, layout in enumerate(self.transcription.layouts):  # log |det dg/dy|
            rows, columns = determined(self.transcription, p, layout)
            order = np.arange(len(rows))
            value -= 2.0 * BandedFactors(kkt.J[rows][:, columns], order, order).log_determinant
        value += float(np.linalg.slogdet(S)[1])
        # the derivatives of the motion by the shared parameters that are not fixed
        slopes, free = np.zeros((program.n, len(self.shared))), np.isin(self.shared, kkt.border)
        is_shared = np.logical_not(is_local)
        of_local = -np.linalg.solve(S, kkt.schur[np.ix_(is_local, is_shared)])
        slopes[np.ix_(kkt.border[is_local], free)] = of_local
        slopes[np.ix_(kkt.inner, free)] = -(kkt.solved[:, is_shared] + kkt.solved[:, is_local] @ of_local)[:n]
        return Point(z, multipliers, value, slopes)

    def _kkt(self, z: np.ndarray, multipliers: np.ndarray) -> Kkt:
        border = np.concatenate([self.shared, self.local]).astype(int)
        return Kkt(self.transcription.program, border, z, multipliers)

    def minimum(self, solution: Solution) -> tuple[Point, np.ndarray, bool]:
        """The most probable parameters, by Newton's method with a trust region.

        The gradient and the matrix of second derivatives are differences of values.

        **Arguments:**

        - `solution`: the most probable motion for the initial guess of the parameters.

        **Returns:** the point, the covariance (p, p) of the scaled parameters, NaN if the curvature is not positive
        definite, and whether the search converged.
        """
        now = self.at(solution.z[self.shared], Point(solution.z, solution.multipliers, np.inf, None))
        radius, ok = _FIRST, False
        gradient, curvature, width = self._quadratic(now)
        for _ in range(_STEPS):
            # the Newton step, with positive curvature, whose largest component is at most `radius`
            values, vectors = np.linalg.eigh(curvature * np.outer(width, width))
            sizes = np.maximum(np.abs(values), 1e-6 * np.max(np.abs(values), initial=1e-12))
            step = -width * (vectors @ ((vectors.T @ (width * gradient)) / sizes))
            step *= min(1.0, radius / max(float(np.max(np.abs(step))), 1e-300))
            predicted, ratio, new = gradient @ step + 0.5 * step @ curvature @ step, -1.0, None
            with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError, ValueError):
                new = self.at(now.z[self.shared] + step, now)
            if new is not None and np.isfinite(new.value):
                ratio = (new.value - now.value) / min(predicted, -1e-300)
                if ratio > 0.05 or abs(new.value - now.value) < 1e-6:
                    now, (gradient, curvature, width) = new, self._quadratic(new)
            radius = 2.0 * radius if ratio > 0.75 else 0.4 * radius if ratio < 0.25 else radius
            ok = bool(np.max(np.abs(step) / width) < 0.1)  # of a width, which is a third of a standard error
            if ok or radius < 1e-6:
                break
        return now, inverse(0.5 * curvature), ok

    def _quadratic(self, now: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient (p,) and curvature (p, p) at a point, by differences over the widths (p,): a third of a standard
        error."""
        p, theta = len(self.shared), now.z[self.shared]
        information = np.abs(np.diag(self._kkt(now.z, now.multipliers).schur)[:p])
        width = np.minimum(0.3 / np.sqrt(np.maximum(information, 1e-300)), _WIDEST)
        h = np.diag(width)

        def value(v: np.ndarray) -> float:
            return self.at(theta + v, now).value

        above, below = ([value(sign * v) for v in h] for sign in (1, -1))
        curvature = np.diag((np.array(above) + below - 2 * now.value) / width**2)
        for i in range(p):
            for j in range(i):
                both = value(h[i] + h[j]) - above[i] - above[j] + now.value
                curvature[i, j] = curvature[j, i] = both / (width[i] * width[j])
        return (np.array(above) - below) / (2 * width), curvature, width


_NEWTON = 8  # iterations for the motion
_STEPS = 30  # for the parameters
_WIDEST = 0.02  # of a typical change of a parameter
_FIRST = 0.3  # the first radius of the trust region, in the same unit


def determined(transcription: Transcription, p: int, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """The equations of a phase, and as many states: dependent coordinates at the start, then all later states."""
    n_y, names = layout.variables.n_y, layout.problem.names
    first = [names.index(c) for c in layout.problem.system.dependent_coordinates]
    constraints = [row.rows for row in transcription.rows if row.phase == p and row.kind == "conditions"]
    first = first[: sum(map(len, constraints))]
    dynamics = np.stack([row.rows for row in transcription.rows if row.phase == p and row.kind == "dynamics"], axis=-1)
    columns = np.concatenate([layout.node(0)[first], layout.node(np.arange(1, layout.K))[:, :n_y].ravel()])
    rows = np.concatenate([*constraints, dynamics.ravel()]).astype(int)
    return rows, columns.astype(int)
