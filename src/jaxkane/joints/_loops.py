"""Closed loops: which residuals are independent, and which speeds and coordinates they determine."""

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
    """The structure with its dependent speeds and coordinates, and with the independent residuals."""
    norms = [joint.name + joint.coordinates[-1][0] for joint in structure.joints if len(joint.coordinates) > 1]
    dependent = None if dependent is None else as_names(dependent)
    if not (structure.loops or structure.couplings):
        if dependent:
            raise ValueError(
                f"`dependent` names {', '.join(dependent)}, but the mechanism has no loop. Omit `dependent`."
            )
        return structure._replace(dependent_coordinates=tuple(norms))
    with jax.ensure_compile_time_eval():  # trial numbers must be concrete also inside `jax.jit`
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
    """Speeds and coordinates for which the residuals can be solved, including those for the `norms` of Euler
    parameters."""
    structure, C = trial.structure, trial.velocity_slopes(q)[rows]  # (k,n)
    if dependent is not None:
        simple = [joint.name for joint in structure.joints if len(joint.speeds) == 1]
        wrong = [name for name in dependent if name not in simple]
        if wrong:
            raise ValueError("`dependent`: " + str(not_there(wrong[0], simple, "the hinges and sliders").args[0]))
        if len(set(dependent)) != len(rows):
            raise ValueError(
                f"`dependent` names {len(set(dependent))} joints, but the loops have {len(rows)} independent "
                "residuals. Name one joint for each."
            )
        speeds = [f"{name}_rate" for name in dependent]
        columns = C[:, [trial.speeds.index(name) for name in speeds]]
        if np.linalg.svd(columns, compute_uv=False)[-1] < 1e-9 * np.abs(C).max():
            raise ValueError(f"`dependent`: the loops cannot be solved for {', '.join(dependent)}. Name other joints.")
        return speeds, [*dependent, *norms]
    follows = [f"{x.first}_rate" for x in structure.couplings]
    # The first joint of a coupling follows the second one, so its rate should be the dependent one.
    preferred = C * [1e3 if name in follows else 1.0 for name in trial.speeds]
    groups = _by_joints(structure, trial.speeds, lambda joint: joint.speeds)
    speeds = [trial.speeds[i] for i in _best_columns(preferred, groups)]
    if all(name.endswith("_rate") for name in speeds):
        return speeds, [*(name.removesuffix("_rate") for name in speeds), *norms]
    G = np.concatenate([trial.slopes(q)[rows], trial.norm_slopes(q)])
    groups = _by_joints(structure, trial.coordinates, lambda joint: joint.coordinates)
    return speeds, [trial.coordinates[i] for i in _best_columns(G, groups)]


class _Trial:
    """A mechanism with trial numbers for traced or batched parameters, because the independence of residuals is
    structural.

    Residuals are those of the loops and couplings, in their order. Lengths are in units of the largest length of the
    mechanism. Coordinates, speeds and residuals in m and in rad can then be compared, at any scale.
    """

    def __init__(self, structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]):
        rng = np.random.default_rng(0)

        def number(x: Any) -> float:
            try:
                return float(np.ravel(np.asarray(x))[0])
            except Exception:  # a traced value is not available
                return float(rng.uniform(0.5, 1.5))

        self.structure = structure
        numbers = {name: number(x) for name, x in values.items()}
        self.mechanism = class_of(structure, fields)(**numbers)
        # Python numbers, because JAX would compile every operation
        self.mechanism = jax.tree.map(float, self.mechanism)
        self.coordinates = self.mechanism.coordinates
        self.speeds = (*self.mechanism.speeds, *self.mechanism.dependent_speeds)
        places = [abs(numbers[name]) for name, _, unit in fields if unit == "m"]
        places += [abs(joint.reference) for joint in structure.joints if joint.coordinates[0][1] == "m"]
        self.length = max(places, default=0.0) or 1.0  # [m]

        def in_unit(unit: Any) -> float:
            return self.length if unit == "m" else 1.0

        units = self.mechanism.units
        self.coordinate_units = np.array([in_unit(units.get(name)) for name in self.coordinates])
        self.speed_units = np.array([in_unit("m" if units.get(name) == "m/s" else "") for name in self.speeds])
        loops = [self.length if i < 3 else 1.0 for loop in structure.loops for i in range(loop.size)]
        first = [in_unit(units.get(x.first)) for x in structure.couplings]
        self.residual_units = np.array([*loops, *first])
        self.rest = np.zeros(len(self.speeds))
        joints = [joint for joint in structure.joints if len(joint.coordinates) > 1]
        last = [self.coordinates.index(joint.name + joint.coordinates[-1][0]) for joint in joints]
        self.euler_parameters = [slice(i - 3, i + 1) for i in last]

    def residuals(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the configuration and of the velocities."""
        q_row, u_row = list(map(float, q * self.coordinate_units)), list(map(float, u * self.speed_units))
        motion: Any = self.mechanism.motion(0.0, q_row, u_row)
        by_name = dict(zip(self.coordinates, q_row, strict=True)), dict(zip(self.mechanism.speeds, u_row, strict=True))
        h, c = loop_residuals(self.mechanism, motion.sites, *by_name)
        return tuple(np.array([float(x) for x in row]) / self.residual_units for row in (h, c))  # type: ignore

    def velocity_slopes(self, q: np.ndarray) -> np.ndarray:

        def velocity_residuals(u: np.ndarray) -> np.ndarray:
            return self.residuals(q, u)[1]

        # Velocity residuals are affine in the speeds, so differences are their exact derivatives, whatever the step.
        at_rest = velocity_residuals(self.rest)
        return np.array([velocity_residuals(e) - at_rest for e in np.eye(len(self.rest))]).T

    def slopes(self, q: np.ndarray) -> np.ndarray:

        def h(step: np.ndarray) -> np.ndarray:
            return self.residuals(q + step, self.rest)[0]

        # Central differences, because JAX would compile the residuals of each mechanism. Rounding limits their error
        # to about 1e-10.
        return np.array([(h(1e-6 * e) - h(-1e-6 * e)) / 2e-6 for e in np.eye(len(q))]).T

    def norm_slopes(self, q: np.ndarray) -> np.ndarray:
        """Derivatives of the norms of Euler parameters with respect to all coordinates (norms, n_q)."""
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
                place = self.coordinates.index(joint.name)
                q[place] = joint.reference / self.coordinate_units[place]
        # Not at the reference: residuals that are independent elsewhere may be dependent there, if links are in line.
        return self.normalized(q + rng.uniform(-0.2, 0.2, q.shape))

    def closed(self, q: np.ndarray, rows: list[int]) -> np.ndarray | None:
        """Coordinates near q at which these residuals are zero; None if Newton's method does not converge."""
        weights = np.ones(len(q))  # prefer to change the coordinates that will be dependent
        for i, group in enumerate(_by_joints(self.structure, self.coordinates, lambda joint: joint.coordinates)):
            weights[group] = max(0.1**i, 1e-3)
        for _ in range(50):
            h = self.residuals(q, self.rest)[0][rows]
            if np.abs(h).max(initial=0.0) < 1e-9:
                return q
            norms = 0.5 * self.norm_slopes(q)
            J = np.concatenate([self.slopes(q)[rows], norms])
            step = weights * np.linalg.lstsq(J * weights, -np.concatenate([h, np.zeros(len(norms))]), rcond=None)[0]
            # At most 0.5 (largest lengths or rad) in one step, so that a loop closes near q and not in another branch.
            q = self.normalized(q + step / max(1.0, 2.0 * np.linalg.norm(step)))
        return None  # not closed from there: `assemble` reports it

    def check_implied(self, q: np.ndarray, rows: list[int]) -> None:
        """Check that residuals that depend on the independent ones are zero where those are.

        **Raises:** `ValueError` for one that is not zero, e.g. if the sites of a planar loop are not in one plane.
        """
        h = np.abs(self.residuals(q, self.rest)[0])
        h[rows] = 0.0
        worst = int(np.argmax(h))
        if h[worst] > 1e-6:
            off = h[worst] * self.residual_units[worst]
            origins = [f"Loop({x.first!r}, {x.second!r})" for x in self.structure.loops for _ in range(x.size)]
            origins += [f"Coupling({x.first!r}, {x.second!r})" for x in self.structure.couplings]
            raise ValueError(
                f"{self.structure.name}: {origins[worst]} cannot be satisfied: its residual is {off:.3g} for all "
                "positions of the joints that satisfy the other loops. In a plane loop, place all sites in one plane. "
                "Two constraints on one joint must agree."
            )


def _independent_rows(C: np.ndarray) -> list[int]:
    R, order = _qr(C.T)
    rank = int(
        np.sum(np.abs(np.diag(R)) > max(1e-9 * abs(R[0, 0]), 1e-13))
    )  # 1e-13: all entries may be rounding errors
    return sorted(int(i) for i in order[:rank])


def _by_joints(
    structure: Structure, names: Sequence[str], endings: Callable[[JointType], tuple[tuple[str, str], ...]]
) -> list[list[int]]:
    """Indices in the order in which they are solved for. Balls and free links come first, those at the end of the tree
    first, so that a welded free link depends as a whole. Hinges and sliders follow."""
    groups = [[names.index(x) for x in joint.names(endings(joint))] for joint in reversed(structure.joints)]
    return [group for group in groups if len(group) > 1] + [[i for group in groups if len(group) == 1 for i in group]]


def _best_columns(A: np.ndarray, groups: list[list[int]]) -> list[int]:
    """The columns for which A is best solved, as many as it has rows: all independent ones of the first groups
    first."""
    chosen, size = [], np.linalg.norm(A, axis=0)
    # A column that nearly depends on the chosen ones would be solved for with a large error. Only the last pass takes
    # it, if there is no other.
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
