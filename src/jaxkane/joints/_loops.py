"""What closes loops: which residuals count, which of them follow from others, and which speeds are dependent.

Knows a mechanism by its residuals, as functions of numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import scipy.linalg
from jax.core import Tracer

from .._common.lookup import as_names, not_there
from ._joints import Shape
from ._mechanism import Field, Mechanism, class_of
from ._tree import Structure


def with_dependent(
    structure: Structure, fields: tuple[Field, ...], values: dict[str, Any], dependent: Sequence[str] | None
) -> Structure:
    norms = [joint.name + joint.coordinates[-1][0] for joint in structure.joints if len(joint.coordinates) > 1]
    dependent = None if dependent is None else as_names(dependent)
    if not (structure.loops or structure.couplings):
        if dependent:
            raise ValueError(f"`dependent` names {', '.join(dependent)}, and nothing closes a loop: leave it out.")
        return structure._replace(dependent_coordinates=tuple(norms))
    with jax.ensure_compile_time_eval():  # trial numbers are numbers under `jax.jit` too
        return _with_dependent(structure, fields, values, dependent, norms)


def _with_dependent(
    structure: Structure,
    fields: tuple[Field, ...],
    values: dict[str, Any],
    dependent: Sequence[str] | None,
    norms: list[str],
) -> Structure:
    trial = jax.tree.map(float, class_of(structure, fields)(**_numbers(values)))  # read by Python, not by JAX
    q = _trial_coordinates(trial)
    kept = _independent_rows(_slopes_by_speeds(trial, q))
    closed = _closed(trial, q, kept)
    if closed is not None and not any(isinstance(x, Tracer) or np.ndim(x) for x in values.values()):
        _check_what_follows(trial, closed, kept)
    q = q if closed is None else closed
    C, G = _slopes_by_speeds(trial, q)[kept], _slopes_by_coordinates(trial, q)[kept]  # (k,n) (k,n_q)
    names = (*trial.speeds, *trial.dependent_speeds)
    if dependent is None:
        follows = [f"{x.first}_rate" for x in structure.couplings]
        preferred = C * [1e3 if name in follows else 1.0 for name in names]
        speeds = [names[i] for i in _columns(preferred, _by_joints(structure, names, lambda joint: joint.speeds))]
        if all(name.endswith("_rate") for name in speeds):
            coordinates = [*(name.removesuffix("_rate") for name in speeds), *norms]
        else:
            G = np.concatenate([G, _norm_slopes(trial, q)])
            groups = _by_joints(structure, trial.coordinates, lambda joint: joint.coordinates)
            coordinates = [trial.coordinates[i] for i in _columns(G, groups)]
    else:
        speeds, coordinates = _chosen(structure, dependent, len(kept)), [*dependent, *norms]
        places = [names.index(s) for s in speeds]
        if np.linalg.svd(C[:, places], compute_uv=False)[-1] < 1e-9 * np.abs(C).max():
            raise ValueError(f"`dependent`: what closes the loops cannot be solved for {', '.join(dependent)}.")
    start, loops = 0, []
    for loop in structure.loops:
        loops.append(loop._replace(kept=tuple(i - start for i in kept if start <= i < start + len(loop.kept))))
        start += len(loop.kept)
    couplings = [x._replace(is_kept=start + i in kept) for i, x in enumerate(structure.couplings)]
    return structure._replace(
        loops=tuple(loops),
        couplings=tuple(couplings),
        dependent_speeds=tuple(name for name in names if name in speeds),
        dependent_coordinates=tuple(name for name in trial.coordinates if name in coordinates),
    )


def _chosen(structure: Structure, dependent: Sequence[str], n: int) -> list[str]:
    simple = [joint.name for joint in structure.joints if len(joint.speeds) == 1]
    wrong = [name for name in dependent if name not in simple]
    if wrong:
        raise ValueError("`dependent`: " + str(not_there(wrong[0], simple, "the hinges and sliders").args[0]))
    if len(set(dependent)) != n:
        raise ValueError(f"`dependent` names {len(set(dependent))} joints, and what closes the loops takes {n}.")
    return [f"{name}_rate" for name in dependent]


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    """Numbers for what is traced or a batch: which rows are independent is a matter of structure."""
    rng = np.random.default_rng(0)

    def number(x: Any) -> float:
        try:
            return float(np.ravel(np.asarray(x))[0])
        except Exception:  # traced: it has no value
            return float(rng.uniform(0.5, 1.5))

    return {name: number(x) for name, x in values.items()}


def _slopes_by_speeds(trial: Mechanism, q: np.ndarray) -> np.ndarray:
    still, residuals = np.zeros(len(trial.speeds) + len(trial.dependent_speeds)), _residuals(trial)
    c = lambda u: np.array([float(x) for x in residuals(q, u)[1]])  # noqa: E731
    return np.array([c(e) - c(still) for e in np.eye(len(still))]).T


def _slopes_by_coordinates(trial: Mechanism, q: np.ndarray) -> np.ndarray:
    h = _residuals(trial)
    still = np.zeros(len(trial.speeds) + len(trial.dependent_speeds))
    ahead = lambda step: np.array([float(x) for x in h(q + step, still)[0]])  # noqa: E731
    return np.array([(ahead(1e-6 * e) - ahead(-1e-6 * e)) / 2e-6 for e in np.eye(len(q))]).T


def _trial_coordinates(trial: Mechanism) -> np.ndarray:
    rng = np.random.default_rng(1)
    q = np.array([1.0 if name.endswith("_e4") else 0.0 for name in trial.coordinates])
    for joint in trial.structure.joints:
        if len(joint.coordinates) == 1:
            q[trial.coordinates.index(joint.name)] = joint.reference
    return _normalized(trial, q + rng.uniform(-0.2, 0.2, q.shape))


def _normalized(trial: Mechanism, q: np.ndarray) -> np.ndarray:
    for joint in trial.structure.joints:
        if len(joint.coordinates) > 1:
            last = trial.coordinates.index(joint.name + joint.coordinates[-1][0])
            q[last - 3 : last + 1] /= np.linalg.norm(q[last - 3 : last + 1])
    return q


def _residuals(trial: Mechanism) -> Callable[[np.ndarray, np.ndarray], tuple[list[Any], list[Any]]]:
    """What closes the loops, as a function of numbers: of the configuration, of the velocities."""

    def residuals(q: np.ndarray, u: np.ndarray) -> tuple[list[Any], list[Any]]:
        motion = trial.motion(0.0, list(map(float, q)), list(map(float, u)))
        return trial._closed(motion.sites, _by_name(trial.coordinates, q), _by_name(trial.speeds, u))

    return residuals


def _closed(trial: Mechanism, q: np.ndarray, kept: list[int]) -> np.ndarray | None:
    """Coordinates near these at which the residuals that are kept are zero; None where there are none to be found."""
    residuals, still = _residuals(trial), np.zeros(len(trial.speeds) + len(trial.dependent_speeds))
    weights = np.ones(len(q))  # what will be dependent moves most
    for i, group in enumerate(_by_joints(trial.structure, trial.coordinates, lambda joint: joint.coordinates)):
        weights[group] = max(0.1**i, 1e-3)
    for _ in range(50):
        h = np.array([float(x) for x in residuals(q, still)[0]])[kept]
        if np.abs(h).max(initial=0.0) < 1e-9:
            return q
        norms = 0.5 * _norm_slopes(trial, q)
        rows = np.concatenate([_slopes_by_coordinates(trial, q)[kept], norms])
        step = weights * np.linalg.lstsq(rows * weights, -np.concatenate([h, np.zeros(len(norms))]), rcond=None)[0]
        q = _normalized(trial, q + step / max(1.0, 2.0 * np.linalg.norm(step)))
    return None  # not closed from here: `assemble` says so


def _check_what_follows(trial: Mechanism, closed: np.ndarray, kept: list[int]) -> None:
    """Residuals that are left out, since they follow from the others, have to be zero where those are.

    **Raises:** `ValueError` for one that is not, as where a loop in a plane ends beside its beginning.
    """
    still = np.zeros(len(trial.speeds) + len(trial.dependent_speeds))
    h = np.abs([float(x) for x in _residuals(trial)(closed, still)[0]])
    h[kept] = 0.0
    worst = int(np.argmax(h))
    if h[worst] > 1e-6:
        raise ValueError(
            f"{trial.structure.name}: {_closing(trial.structure)[worst]} can never hold: it stays off by "
            f"{h[worst]:.3g} wherever the joints are, and all else that closes loops is met. The sites of a loop "
            "in a plane are at one height across it, and two that hold one joint agree."
        )


def _closing(structure: Structure) -> list[str]:
    """Of each residual what it comes from."""
    loops = [f"Loop({x.first!r}, {x.second!r})" for x in structure.loops for _ in x.kept]
    return [*loops, *(f"Coupling({x.first!r}, {x.second!r})" for x in structure.couplings)]


def _by_name(names: Sequence[str], x: np.ndarray) -> dict[str, float]:
    return {name: float(a) for name, a in zip(names, x, strict=True)}


def _norm_slopes(trial: Mechanism, q: np.ndarray) -> np.ndarray:
    """Derivatives of the norms of Euler parameters by all coordinates (norms, n_q)."""
    rows = []
    for joint in trial.structure.joints:
        if len(joint.coordinates) > 1:
            last, places = trial.coordinates.index(joint.name + joint.coordinates[-1][0]), np.arange(len(q))
            rows.append(np.where((last - 4 < places) & (places <= last), 2.0 * q, 0.0))
    return np.array(rows).reshape(len(rows), len(q))


def _independent_rows(C: np.ndarray) -> list[int]:
    R, order = _qr(C.T)
    rank = int(np.sum(np.abs(np.diag(R)) > max(1e-9 * abs(R[0, 0]), 1e-13)))  # rounding errors of metres
    return sorted(int(i) for i in order[:rank])


def _by_joints(
    structure: Structure, names: Sequence[str], endings: Callable[[Shape], tuple[tuple[str, str], ...]]
) -> list[list[int]]:
    """Places of what is solved for first, and so on: balls and free links, those at the end of the tree first, so that
    a free link that is welded follows as a whole; then hinges and sliders."""
    groups = [[names.index(x) for x in joint.names(endings(joint))] for joint in reversed(structure.joints)]
    return [group for group in groups if len(group) > 1] + [[i for group in groups if len(group) == 1 for i in group]]


def _columns(A: np.ndarray, groups: list[list[int]]) -> list[int]:
    """The columns by which A is best solved, as many as it has rows: of the first groups all that are independent."""
    chosen, size = [], np.linalg.norm(A, axis=0)
    for group, least in (*((group, 1e-2) for group in groups), (range(A.shape[1]), 0.0)):
        rest = [i for i in group if i not in chosen]
        if rest and len(chosen) < len(A):
            Q = np.linalg.qr(A[:, chosen])[0]
            R, order = _qr(A[:, rest] - Q @ (Q.T @ A[:, rest]))
            good = [rest[j] for j, r in zip(order, np.abs(np.diag(R)), strict=False) if r > least * size[rest[j]]]
            chosen += good[: len(A) - len(chosen)]
    return chosen


def _qr(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    factors: Any = scipy.linalg.qr(A, mode="economic", pivoting=True)
    return factors[1], factors[2]
