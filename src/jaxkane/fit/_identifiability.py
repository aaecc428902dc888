"""What the data can tell: singular values of the sensitivity, and the directions in which nothing changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ._blocks import eliminate
from ._problem import Linearization, Point, Problem
from ._steps import settle


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of parameters, and how well it is known.

    Attributes: `singular_value`: by how many standard deviations of one measurement all residuals together move for a
    step of one along it; `deviation`: its own standard deviation, in scaled units (1 is a change by the whole scale,
    for a positive parameter by a factor of e); `parts`: the parameters in it with their shares; `text`: in words.
    """

    singular_value: float
    deviation: float
    parts: tuple[tuple[str, float], ...]
    text: str


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The sensitivity of all residuals to the free parameters, nuisance values eliminated.

    - `names` (p,); `singular_values` (p,), largest first; `vectors` (p, p), a row for each, in scaled parameters.
    - `deviations` (p,): standard deviation along each row, in scaled units.
    - `without_influence`: names of the parameters that change no residual at all.
    - `undetermined`: the directions that the data do not tell, weakest first.
    - `covariance` (p, p) of the scaled parameters, infinite for those without influence.
    """

    names: tuple[str, ...]
    singular_values: np.ndarray
    vectors: np.ndarray
    deviations: np.ndarray
    without_influence: tuple[str, ...]
    undetermined: tuple[Direction, ...]
    covariance: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether every parameter can be told."""
        return not self.undetermined

    @property
    def messages(self) -> tuple[str, ...]:
        return tuple(direction.text for direction in self.undetermined)

    def __str__(self) -> str:
        lines = ["singular value   deviation   direction (scaled parameters)"]
        for s, deviation, row in zip(self.singular_values, self.deviations, self.vectors, strict=True):
            lines.append(f"{s:14.4g}   {deviation:9.2g}   {_combination(self.names, row)}")
        return "\n".join([*lines, *self.messages])


def identifiability(
    problem: Any, trials: Any = None, free: Any = None, *, flat: float = 0.5, at: Point | None = None, **options: Any
) -> Identifiability:
    """Which parameters, or combinations of them, the data can tell.

        identifiability(result), identifiability(problem), identifiability(system, trials, free, unknown=("roll",))

    The residuals' sensitivity to the scaled parameters, with the nuisance values eliminated, is taken apart by singular
    values. A direction whose standard deviation exceeds `flat` of the parameters' scale is called undetermined.

    **Arguments:**

    - `problem`: a `Fit`, a `Problem`, or a system with `trials`, `free` and the other arguments of `fit`.
    - `flat`: where undetermined begins. `at`: a point of the problem; by default its start, nuisance values settled.

    **Returns:** an `Identifiability`; print it for a table.
    """
    if hasattr(problem, "identifiability"):
        return look(problem.problem, problem.linearization, flat)
    if not isinstance(problem, Problem):
        problem = Problem.of(problem, trials, free, **options)
    _, linearization = settle(problem, problem.start if at is None else at)
    return look(problem, linearization, flat)


def look(problem: Problem, at: Linearization, flat: float = 0.5) -> Identifiability:
    """Identifiability at a point where the problem has been linearized."""
    names = problem.parameters.names
    eliminated = eliminate(at.blocks, 0.0)
    A = np.asarray(eliminated.rows[0])
    n_r, n_unknown = problem.size
    variance = at.cost / max(n_r - n_unknown, 1)  # of a residual; one where `sigma` is right
    before = np.asarray(at.blocks.column_norms)
    silent = np.asarray(at.blocks.silent)
    # Elimination leaves rounding errors of what it removed: less than this is nothing.
    floor = 1e3 * float(jnp.finfo(eliminated.R.dtype).eps) * before.max()
    heard = np.flatnonzero(~silent)
    s, V = np.zeros(len(names)), np.zeros((len(names), len(names)))
    if heard.size:
        _, s[: heard.size], V[: heard.size, heard] = np.linalg.svd(A[:, heard], full_matrices=False)
    # Each silent parameter is a direction of its own.
    V[np.arange(heard.size, len(names)), np.flatnonzero(silent)] = 1.0
    s = np.where(s <= floor, 0.0, s)
    with np.errstate(divide="ignore"):
        deviations = np.sqrt(variance) / s
    signs = np.sign(V[np.arange(len(V)), np.abs(V).argmax(axis=1)])
    V = V * signs[:, None]
    directions = [
        _direction(names, s[i], deviations[i], V[i], silent) for i in range(len(s)) if not deviations[i] <= flat
    ]
    told = ~silent & np.all((np.abs(V) < 1e-6) | (s[:, None] > 0), axis=0)
    with np.errstate(divide="ignore"):
        inverse = np.where(s > 0, 1 / s, 0.0)
    covariance = variance * (V.T * inverse**2) @ V
    covariance[~told, :] = covariance[:, ~told] = np.nan
    covariance[~told, ~told] = np.inf
    return Identifiability(
        names,
        s,
        V,
        deviations,
        tuple(name for name, quiet in zip(names, silent, strict=True) if quiet),
        tuple(reversed(directions)),
        covariance,
    )


def _direction(names: tuple[str, ...], s: float, deviation: float, row: np.ndarray, silent: np.ndarray) -> Direction:
    main = np.abs(row) > 0.1
    parts = tuple((names[i], float(row[i])) for i in np.argsort(-np.abs(row)) if main[i])
    alone = len(parts) == 1
    if alone and silent[names.index(parts[0][0])]:
        text = f"{parts[0][0]} has no influence on these data; it stays at its start."
    elif alone and s == 0:
        text = f"{parts[0][0]} cannot be told from the unknown starts and biases."
    elif alone:
        text = f"{parts[0][0]} is undetermined: its standard deviation is {deviation:.2g} of its scale."
    else:
        known = "not at all" if s == 0 else f"only to {deviation:.2g}"
        text = f"{', '.join(n for n, _ in parts)} trade off: along {_combination(names, row)} they are known {known}."
    return Direction(float(s), float(deviation), parts, text)


def _combination(names: Sequence[str], row: np.ndarray) -> str:
    """`0.71 mB - 0.70 zB`."""
    order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > 0.1]
    text = " ".join(f"{'-' if row[i] < 0 else '+'} {abs(row[i]):.2f} {names[i]}" for i in order)
    return text.removeprefix("+ ")
