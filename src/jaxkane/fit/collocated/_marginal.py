"""The marginal likelihood of parameters, if inputs are unknown.

The estimate of all unknowns together is biased: for unknown inputs w with few measurements each, the most probable
(w, parameters) is not near the most probable parameters. With Laplace's approximation of the integral over w,

    -2 log p(parameters) = min_w cost(w, parameters) + log det (Hessian of half the cost by w) + constant

(for a linear system with normal noise this is exact and equals the likelihood of a Kalman filter). The Hessian is the
one with all states as functions of w and the initial state, so that its determinant is that of the matrix of Karush,
Kuhn and Tucker divided by det(dg/dy)^2, where y are the states that the equations g determine.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import NamedTuple

import numpy as np

from ..._collocate.second_order import BandedFactors
from ..._collocate.solvers import Solution
from ..._collocate.transcription import Layout, Transcription
from ._kkt import Kkt, inverse


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
        program = self.transcription.program
        half = 0.5 * program.f_scale
        z, multipliers = start.z.copy(), start.multipliers
        if start.slopes is not None:  # to first order
            z += start.slopes @ (theta - z[self.shared])
        z[self.shared] = theta
        for _ in range(_NEWTON):
            kkt = Kkt(program, self._border, z, multipliers)
            g, gradient = program.constraints(z), half * program.gradient(z)
            right = -np.concatenate([gradient[kkt.inner], g - np.clip(g, program.g_lower, program.g_upper)])
            step = kkt.factors.solve(right[:, None])[:, 0]
            is_local = np.isin(kkt.border, self.local)
            if is_local.any():
                rest = -gradient[kkt.border][is_local] - kkt.coupling[:, is_local].T @ step
                change = np.linalg.solve(kkt.schur[np.ix_(is_local, is_local)], rest)
                step = step - kkt.solved[:, is_local] @ change
                z[kkt.border[is_local]] += change
            n = len(kkt.inner)
            z[kkt.inner] += step[:n]
            multipliers = step[n:] / half
            if np.max(np.abs(step[:n])) < 1e-6:
                break
        return Point(z, multipliers, self._value(kkt, z), self._slopes(kkt))

    def _value(self, kkt: Kkt, z: np.ndarray) -> float:
        program = self.transcription.program
        value = program.objective(z) * program.f_scale + kkt.factors.log_determinant - 2.0 * self._log_jacobian(kkt)
        is_local = np.isin(kkt.border, self.local)
        if is_local.any():
            value += float(np.linalg.slogdet(kkt.schur[np.ix_(is_local, is_local)])[1])
        return value

    def _slopes(self, kkt: Kkt) -> np.ndarray:
        """The derivatives (n, p) of the most probable motion by the shared parameters."""
        slopes = np.zeros((self.transcription.program.n, len(self.shared)))
        is_local = np.isin(kkt.border, self.local)
        solved, schur = kkt.solved, kkt.schur
        direct = -solved[:, ~is_local]
        if is_local.any():
            of_local = -np.linalg.solve(schur[np.ix_(is_local, is_local)], schur[np.ix_(is_local, ~is_local)])
            slopes[np.ix_(kkt.border[is_local], self._free(kkt))] = of_local
            direct = direct - solved[:, is_local] @ of_local
        slopes[np.ix_(kkt.inner, self._free(kkt))] = direct[: len(kkt.inner)]
        return slopes

    def _free(self, kkt: Kkt) -> np.ndarray:
        """The indices, among the shared parameters, of the parameters that are not fixed."""
        return np.flatnonzero(np.isin(self.shared, kkt.border))

    @property
    def _border(self) -> np.ndarray:
        return np.concatenate([self.shared, self.local]).astype(int)

    def _log_jacobian(self, kkt: Kkt) -> float:
        """log |det dg/dy| of the states y that the equations determine."""
        total = 0.0
        for p, layout in enumerate(self.transcription.layouts):
            rows, columns = determined(self.transcription, p, layout)
            matrix = kkt.J[rows][:, columns]
            order = np.arange(len(rows))
            total += BandedFactors(matrix, order, order).log_determinant
        return total

    def minimum(self, solution: Solution) -> Found:
        """The most probable parameters, by Newton's method with a trust region.

        The gradient and the matrix of second derivatives are differences of values.

        **Arguments:**

        - `solution`: the most probable motion for the initial guess of the parameters.
        """
        now = self.at(solution.z[self.shared], Point(solution.z, solution.multipliers, np.inf, None))
        radius, ok = _FIRST, False
        local = self._quadratic(now)
        for _ in range(_STEPS):
            step = _within(local, radius)
            new = self._tried(now, step)
            predicted = local.gradient @ step + 0.5 * step @ local.curvature @ step
            ratio = (new.value - now.value) / min(predicted, -1e-300) if new is not None else -1.0
            if new is not None and (ratio > 0.05 or abs(new.value - now.value) < 1e-6):
                now, local = new, self._quadratic(new)
            radius = 2.0 * radius if ratio > 0.75 else 0.4 * radius if ratio < 0.25 else radius
            ok = bool(np.max(np.abs(step) / local.width) < 0.1)  # of a width, which is a third of a standard error
            if ok or radius < 1e-6:
                break
        return Found(now, inverse(0.5 * local.curvature), ok)

    def _tried(self, now: Point, step: np.ndarray) -> Point | None:
        """The point after a step, or None if the motion cannot be found there."""
        with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError, ValueError):
            new = self.at(now.z[self.shared] + step, now)
            if np.isfinite(new.value):
                return new
        return None

    def _quadratic(self, now: Point) -> Quadratic:
        """Gradient and curvature at a point, by differences over a third of a standard error."""
        kkt = Kkt(self.transcription.program, self._border, now.z, now.multipliers)
        p, theta = len(self.shared), now.z[self.shared]
        information = np.abs(np.diag(kkt.schur)[:p])
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
        return Quadratic((np.array(above) - below) / (2 * width), curvature, width)


class Found(NamedTuple):
    """The most probable parameters.

    - `point`: the point. `covariance` (p, p): of the scaled parameters, NaN if the curvature is not positive definite.
    - `ok`: whether the search converged.
    """

    point: Point
    covariance: np.ndarray
    ok: bool


class Quadratic(NamedTuple):
    """-2 log p near a point: its gradient (p,), its curvature (p, p), and the widths (p,) of the differences."""

    gradient: np.ndarray
    curvature: np.ndarray
    width: np.ndarray


_NEWTON = 8  # iterations for the motion
_STEPS = 30  # for the parameters
_WIDEST = 0.02  # of a typical change of a parameter
_FIRST = 0.3  # the first radius of the trust region, in the same unit


def _within(local: Quadratic, radius: float) -> np.ndarray:
    """The Newton step, with positive curvature, whose largest component is at most `radius`."""
    scaled = local.curvature * np.outer(local.width, local.width)
    values, vectors = np.linalg.eigh(scaled)
    sizes = np.maximum(np.abs(values), 1e-6 * np.max(np.abs(values), initial=1e-12))
    step = -local.width * (vectors @ ((vectors.T @ (local.width * local.gradient)) / sizes))
    return step * min(1.0, radius / max(float(np.max(np.abs(step))), 1e-300))


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
