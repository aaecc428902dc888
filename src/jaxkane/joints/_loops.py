"""Closed loops: which of their residuals are independent, and which speeds and coordinates these determine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import scipy.linalg

from .._common.lookup import as_names, not_there
from .._scalarjit.compat import Tracer
from ._joints import JointType
from ._mechanism import Field, Structure, class_of, loop_residuals


def with_dependent(
    structure: Structure, fields: tuple[Field, ...], values: dict[str, Any], dependent: Sequence[str] | None
) -> Structure:
    """The structure with its dependent speeds and coordinates, and with the residuals that are independent."""
    norms = [joint.name + joint.coordinates[-1][0] for joint in structure.joints if len(joint.coordinates) > 1]
    dependent = None if dependent is None else as_names(dependent)
    if not (structure.loops or structure.couplings):
        if dependent:
            raise ValueError(f"`dependent` names {', '.join(dependent)}, and nothing closes a loop: leave it out.")
        return structure._replace(dependent_coordinates=tuple(norms))
    with jax.ensure_compile_time_eval():  # trial numbers are numbers under `jax.jit` too
        trial = _Trial(structure, fields, values)
        q = trial.start()
        rows = _independent_rows(trial.velocity_slopes(q))
        closed = trial.closed(q, rows)
        if closed is not None:
            q = closed
            if not any(isinstance(x, Tracer) or np.ndim(x) for x in values.values()):
                trial.check_implied(q, rows)
        speeds, coordinates = _dependent_names(trial, q, rows, dependent, norms)
    first, loops = 0, []
    for loop in structure.loops:
        loops.append(loop._replace(independent=tuple(i - first for i in rows if first <= i < first + loop.size)))
        first += loop.size
    return structure._replace(
        loops=tuple(loops),
        couplings=tuple(x._replace(is_independent=first + i in rows) for i, x in enumerate(structure.couplings)),
        dependent_speeds=tuple(name for name in trial.speeds if name in speeds),
        dependent_coordinates=tuple(name for name in trial.coordinates if name in coordinates),
    )


def _dependent_names(
    trial: _Trial, q: np.ndarray, rows: list[int], dependent: Sequence[str] | None, norms: list[str]
) -> tuple[list[str], list[str]]:
    """Speeds and coordinates for which the residuals can be solved, with those of the `norms` of Euler parameters."""
    structure, C = trial.structure, trial.velocity_slopes(q)[rows]  # (k,n)
    if dependent is not None:
        simple = [joint.name for joint in structure.joints if len(joint.speeds) == 1]
        wrong = [name for name in dependent if name not in simple]
        if wrong:
            raise ValueError("`dependent`: " + str(not_there(wrong[0], simple, "the hinges and sliders").args[0]))
        if len(set(dependent)) != len(rows):
            raise ValueError(
                f"`dependent` names {len(set(dependent))} joints, and what closes the loops takes {len(rows)}."
            )
        speeds = [f"{name}_rate" for name in dependent]
        columns = C[:, [trial.speeds.index(name) for name in speeds]]
        if np.linalg.svd(columns, compute_uv=False)[-1] < 1e-9 * np.abs(C).max():
            raise ValueError(f"`dependent`: what closes the loops cannot be solved for {', '.join(dependent)}.")
        return speeds, [*dependent, *norms]
    follows = [f"{x.first}_rate" for x in structure.couplings]
    preferred = C * [1e3 if name in follows else 1.0 for name in trial.speeds]
    groups = _by_joints(structure, trial.speeds, lambda joint: joint.speeds)
    speeds = [trial.speeds[i] for i in _best_columns(preferred, groups)]
    if all(name.endswith("_rate") for name in speeds):
        return speeds, [*(name.removesuffix("_rate") for name in speeds), *norms]
    G = np.concatenate([trial.slopes(q)[rows], trial.norm_slopes(q)])
    groups = _by_joints(structure, trial.coordinates, lambda joint: joint.coordinates)
    return speeds, [trial.coordinates[i] for i in _best_columns(G, groups)]


class _Trial:
    """A mechanism with numbers for what is traced or a batch: which residuals are independent is a matter of structure.

    Residuals are those of the loops and couplings, in their order.
    """

    def __init__(self, structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]):
        rng = np.random.default_rng(0)

        def number(x: Any) -> float:
            try:
                return float(np.ravel(np.asarray(x))[0])
            except Exception:  # traced: it has no value
                return float(rng.uniform(0.5, 1.5))

        self.structure = structure
        self.mechanism = class_of(structure, fields)(**{name: number(x) for name, x in values.items()})
        self.mechanism = jax.tree.map(float, self.mechanism)  # read by Python, not by JAX
        self.coordinates = self.mechanism.coordinates
        self.speeds = (*self.mechanism.speeds, *self.mechanism.dependent_speeds)
        self.rest = np.zeros(len(self.speeds))
        joints = [joint for joint in structure.joints if len(joint.coordinates) > 1]
        last = [self.coordinates.index(joint.name + joint.coordinates[-1][0]) for joint in joints]
        self.euler_parameters = [slice(i - 3, i + 1) for i in last]

    def residuals(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the configuration, and of the velocities."""
        q_row, u_row = list(map(float, q)), list(map(float, u))
        motion: Any = self.mechanism.motion(0.0, q_row, u_row)
        by_name = dict(zip(self.coordinates, q_row, strict=True)), dict(zip(self.mechanism.speeds, u_row, strict=True))
        h, c = loop_residuals(self.mechanism, motion.sites, *by_name)
        return np.array([float(x) for x in h]), np.array([float(x) for x in c])

    def velocity_slopes(self, q: np.ndarray) -> np.ndarray:
        c = lambda u: self.residuals(q, u)[1]  # noqa: E731
        return np.array([c(e) - c(self.rest) for e in np.eye(len(self.rest))]).T

    def slopes(self, q: np.ndarray) -> np.ndarray:
        h = lambda step: self.residuals(q + step, self.rest)[0]  # noqa: E731
        return np.array([(h(1e-6 * e) - h(-1e-6 * e)) / 2e-6 for e in np.eye(len(q))]).T

    def norm_slopes(self, q: np.ndarray) -> np.ndarray:
        """Derivatives of the norms of Euler parameters by all coordinates (norms, n_q)."""
        rows = np.zeros((len(self.euler_parameters), len(q)))
        for row, e in zip(rows, self.euler_parameters, strict=True):
            row[e] = 2.0 * q[e]
        return rows

    def normalized(self, q: np.ndarray) -> np.ndarray:
        for e in self.euler_parameters:
            q[e] /= np.linalg.norm(q[e])
        return q

    def start(self) -> np.ndarray:
        rng = np.random.default_rng(1)
        q = np.array([1.0 if name.endswith("_e4") else 0.0 for name in self.coordinates])
        for joint in self.structure.joints:
            if len(joint.coordinates) == 1:
                q[self.coordinates.index(joint.name)] = joint.reference
        return self.normalized(q + rng.uniform(-0.2, 0.2, q.shape))

    def closed(self, q: np.ndarray, rows: list[int]) -> np.ndarray | None:
        """Coordinates near these at which these residuals are zero; None where Newton's method does not reach any."""
        weights = np.ones(len(q))  # what will be dependent moves most
        for i, group in enumerate(_by_joints(self.structure, self.coordinates, lambda joint: joint.coordinates)):
            weights[group] = max(0.1**i, 1e-3)
        for _ in range(50):
            h = self.residuals(q, self.rest)[0][rows]
            if np.abs(h).max(initial=0.0) < 1e-9:
                return q
            norms = 0.5 * self.norm_slopes(q)
            J = np.concatenate([self.slopes(q)[rows], norms])
            step = weights * np.linalg.lstsq(J * weights, -np.concatenate([h, np.zeros(len(norms))]), rcond=None)[0]
            q = self.normalized(q + step / max(1.0, 2.0 * np.linalg.norm(step)))
        return None  # not closed from there: `assemble` says so

    def check_implied(self, q: np.ndarray, rows: list[int]) -> None:
        """Residuals that follow from the independent ones have to be zero where those are.

        **Raises:** `ValueError` for one that is not, as where a loop in a plane ends beside its beginning.
        """
        h = np.abs(self.residuals(q, self.rest)[0])
        h[rows] = 0.0
        worst = int(np.argmax(h))
        if h[worst] > 1e-6:
            origins = [f"Loop({x.first!r}, {x.second!r})" for x in self.structure.loops for _ in range(x.size)]
            origins += [f"Coupling({x.first!r}, {x.second!r})" for x in self.structure.couplings]
            raise ValueError(
                f"{self.structure.name}: {origins[worst]} can never hold: it stays off by {h[worst]:.3g} wherever the "
                "joints are, and all else that closes loops is met. The sites of a loop in a plane are at one height "
                "across it, and two that hold one joint agree."
            )


def _independent_rows(C: np.ndarray) -> list[int]:
    R, order = _qr(C.T)
    rank = int(np.sum(np.abs(np.diag(R)) > max(1e-9 * abs(R[0, 0]), 1e-13)))  # rounding errors of metres
    return sorted(int(i) for i in order[:rank])


def _by_joints(
    structure: Structure, names: Sequence[str], endings: Callable[[JointType], tuple[tuple[str, str], ...]]
) -> list[list[int]]:
    """Places of what is solved for first, and so on: balls and free links, those at the end of the tree first, so that
    a free link that is welded follows as a whole; then hinges and sliders."""
    groups = [[names.index(x) for x in joint.names(endings(joint))] for joint in reversed(structure.joints)]
    return [group for group in groups if len(group) > 1] + [[i for group in groups if len(group) == 1 for i in group]]


def _best_columns(A: np.ndarray, groups: list[list[int]]) -> list[int]:
    """The columns by which A is best solved, as many as it has rows: of the first groups all that are independent."""
    chosen, size = [], np.linalg.norm(A, axis=0)
    for group, threshold in (*((group, 1e-2) for group in groups), (range(A.shape[1]), 0.0)):
        rest = [i for i in group if i not in chosen]
        if rest and len(chosen) < len(A):
            Q = np.linalg.qr(A[:, chosen])[0]
            R, order = _qr(A[:, rest] - Q @ (Q.T @ A[:, rest]))
            good = [rest[j] for j, r in zip(order, np.abs(np.diag(R)), strict=False) if r > threshold * size[rest[j]]]
            chosen += good[: len(A) - len(chosen)]
    return chosen


def _qr(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    factors: Any = scipy.linalg.qr(A, mode="economic", pivoting=True)
    return factors[1], factors[2]
