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

from .._common.lookup import not_there
from ._mechanism import Field, Mechanism, class_of
from ._structure import Structure


def with_dependent(
    structure: Structure, fields: tuple[Field, ...], values: dict[str, Any], dependent: Sequence[str] | None
) -> Structure:
    norms = [joint.name + joint.coordinates[-1][0] for joint in structure.joints if len(joint.coordinates) > 1]
    if not (structure.loops or structure.couplings):
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
    trial = class_of(structure, fields)(**_numbers(values))
    C, G = _slopes(trial)  # (k,n) by speeds, (k,n_q) by coordinates
    kept = _independent_rows(C)
    if not any(isinstance(x, Tracer) or np.ndim(x) for x in values.values()):
        _check_what_follows(trial, kept)
    names = (*trial.speeds, *trial.dependent_speeds)
    if dependent is None:
        follows = [f"{x.first}_rate" for x in structure.couplings]
        speeds = [names[i] for i in _pivots(C[kept] * [1e3 if name in follows else 1.0 for name in names])]
        if all(name.endswith("_rate") for name in speeds):
            coordinates = [*(name.removesuffix("_rate") for name in speeds), *norms]
        else:
            coordinates = [trial.coordinates[i] for i in _pivots(np.concatenate([G[kept], _norm_slopes(trial)]))]
    else:
        speeds, coordinates = _chosen(structure, dependent, len(kept)), [*dependent, *norms]
        places = [names.index(s) for s in speeds]
        if np.linalg.svd(C[kept][:, places], compute_uv=False)[-1] < 1e-9 * np.abs(C).max():
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


def _slopes(trial: Mechanism) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the loops' residuals by all speeds and by all coordinates, near the reference."""
    q, residuals = _trial_coordinates(trial), _residuals(trial)
    still = np.zeros(len(trial.speeds) + len(trial.dependent_speeds))
    c = lambda u: np.array([float(x) for x in residuals(q, u)[1]])  # noqa: E731
    C = np.array([c(e) - c(still) for e in np.eye(len(still))]).T
    return C, _slopes_by_coordinates(trial, q)


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


def _check_what_follows(trial: Mechanism, kept: list[int]) -> None:
    """Residuals that are left out, since they follow from the others, have to be zero where those are.

    **Raises:** `ValueError` for one that is not, as where a loop in a plane ends beside its beginning.
    """
    residuals, q = _residuals(trial), _trial_coordinates(trial)
    still, index = np.zeros(len(trial.speeds) + len(trial.dependent_speeds)), np.arange(len(q))
    for _ in range(50):
        h = np.array([float(x) for x in residuals(q, still)[0]])
        if len(kept) == len(h):
            return
        if np.abs(h[kept]).max(initial=0.0) < 1e-9:
            break
        ends = np.flatnonzero(_norm_slopes(trial).any(axis=0))  # of the Euler parameters
        norms = np.array([np.where((i - 4 < index) & (index <= i), q, 0.0) for i in ends]).reshape(len(ends), len(q))
        rows = np.concatenate([_slopes_by_coordinates(trial, q)[kept], norms])
        step = np.linalg.lstsq(rows, -np.concatenate([h[kept], np.zeros(len(norms))]), rcond=None)[0]
        q = _normalized(trial, q + step / max(1.0, 2.0 * np.linalg.norm(step)))
    else:
        return  # not closed from here: `assemble` says so
    worst = max((i for i in range(len(h)) if i not in kept), key=lambda i: abs(h[i]))
    if abs(h[worst]) > 1e-6:
        raise ValueError(
            f"{trial.structure.name}: {_closing(trial.structure)[worst]} can never hold: it stays off by "
            f"{abs(h[worst]):.3g} wherever the joints are, and all else that closes loops is met. The sites of a loop "
            "in a plane are at one height across it, and two that hold one joint agree."
        )


def _closing(structure: Structure) -> list[str]:
    """Of each residual what it comes from."""
    loops = [f"Loop({x.first!r}, {x.second!r})" for x in structure.loops for _ in x.kept]
    return [*loops, *(f"Coupling({x.first!r}, {x.second!r})" for x in structure.couplings)]


def _by_name(names: Sequence[str], x: np.ndarray) -> dict[str, float]:
    return {name: float(a) for name, a in zip(names, x, strict=True)}


def _norm_slopes(trial: Mechanism) -> np.ndarray:
    rows = []
    for joint in trial.structure.joints:
        if len(joint.coordinates) > 1:
            row = np.zeros(len(trial.coordinates))
            row[trial.coordinates.index(joint.name + joint.coordinates[-1][0])] = 2.0
            rows.append(row)
    return np.array(rows).reshape(len(rows), len(trial.coordinates))


def _independent_rows(C: np.ndarray) -> list[int]:
    R, order = _qr(C.T)
    rank = int(np.sum(np.abs(np.diag(R)) > max(1e-9 * abs(R[0, 0]), 1e-13)))  # rounding errors of metres
    return sorted(int(i) for i in order[:rank])


def _pivots(A: np.ndarray) -> list[int]:
    """The columns by which A is best solved, as many as it has rows."""
    return [int(i) for i in _qr(A)[1][: len(A)]]


def _qr(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    found: Any = scipy.linalg.qr(A, mode="economic", pivoting=True)
    return found[1], found[2]
