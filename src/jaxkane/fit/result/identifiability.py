"""Identifiability: singular values of the sensitivity, and combinations that the data do not determine."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ..problem.model import Unknowns
from ..problem.problem import Problem
from ..problem.specification import refuse_other
from ..solve.linearization import Linearization, eliminate
from ..solve.optimizers import solve_nuisance
from .data import Rows, text_table
from .statistics import formal_covariance, infinite_along, prior_information


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of parameters and its uncertainty.

    - `singular_value`: norm of the change of all residuals, in standard deviations of one measurement, for a unit step
        along the direction.
    - `deviation`: standard deviation along the direction, in scaled units. One is a change by the whole scale, for a
        positive parameter by 100 %.
    - `parts`: its parameters and their coefficients.
    - `text`: a sentence about it.
    """

    singular_value: float
    deviation: float
    parts: tuple[tuple[str, float], ...]
    text: str


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The sensitivity of all residuals to the free parameters, with the nuisance parameters eliminated.

    - `names`, `units` (p,): of the parameters.
    - `scales` (p,): the scale of each parameter, in its unit. Scaled parameters are divided by it.
    - `singular_values` (p,): in descending order.
    - `vectors` (p, p): one row per singular value, in scaled parameters.
    - `deviations` (p,): standard deviation along each row, in scaled units.
    - `without_influence`: names of parameters that do not affect any residual.
    - `at_bound`: names of parameters at a bound.
    - `beyond`: those of them whose unconstrained optimum lies outside the bound by more than two standard errors.
    - `undetermined`: directions that the data do not determine, the weakest first. If several directions do not
        affect the residuals, their linear combinations do not either. The directions with the fewest parameters are
        reported.
    - `variance`: variance of a residual, used in `covariance` and `deviations`. For a `Fit` it is estimated from the
        residuals, otherwise it is one, because `sigma` is used as it was passed.
    - `degrees_of_freedom`: number of residuals minus the number of unknowns that the data, not priors, determine.
    - `covariance` (p, p): covariance of the parameters in their units. Infinite for parameters that are not determined.
    - `covariance_of_x` (p, p): covariance of the unconstrained parameters x, with `sigma` as it was passed (Laplace).
    - `directions` (p, k): unit steps in x along each row of `vectors` that the data determine.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: np.ndarray
    singular_values: np.ndarray
    vectors: np.ndarray
    deviations: np.ndarray
    without_influence: tuple[str, ...]
    at_bound: tuple[str, ...]
    beyond: tuple[str, ...]
    undetermined: tuple[Direction, ...]
    variance: float
    degrees_of_freedom: float
    covariance: np.ndarray
    covariance_of_x: np.ndarray
    directions: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether every parameter is determined, or is at a bound that is consistent with the data."""
        at_rest = {*self.at_bound} - {*self.beyond}
        return all({name for name, _ in direction.parts} <= at_rest for direction in self.undetermined)

    @property
    def rank(self) -> int:
        """The number of parameters, or combinations of them, that the data determine."""
        return len(self.names) - len(self.undetermined)

    @property
    def messages(self) -> tuple[str, ...]:
        return tuple(direction.text for direction in self.undetermined)

    @property
    def rank_message(self) -> str:
        """A sentence about the rank, if only combinations of some parameters are determined; otherwise ""."""
        if all(len(direction.parts) == 1 for direction in self.undetermined):
            return ""
        return f"The data determine {self.rank} combinations of the {len(self.names)} parameters."

    @property
    def information(self) -> np.ndarray:
        """Fisher information (p, p) of the scaled parameters, for residuals of variance one."""
        return (self.vectors.T * self.singular_values**2) @ self.vectors

    @property
    def given_sigma_errors(self) -> np.ndarray:
        """Standard errors (p,) with `sigma` as it was passed, independent of the residuals. Infinite for undetermined
        parameters.
        """
        known = self.singular_values > 0
        to_units = self.scales[:, None] * self.vectors[known].T / self.singular_values[known]
        return np.sqrt(infinite_along(to_units @ to_units.T, self.vectors[~known]).diagonal())

    @property
    def rows(self) -> Rows:
        """Directions, singular values and standard deviations. The first row is the header."""
        values = zip(self.vectors, self.singular_values, self.deviations, strict=True)
        rows = [[combination(self.names, row), f"{s:.4g}", f"{deviation:.2g}"] for row, s, deviation in values]
        return [("direction (scaled parameters)", "singular value", "deviation"), *rows]

    def __repr__(self) -> str:
        return "\n".join([text_table(self.rows), *filter(None, [self.rank_message]), *self.messages])


def identifiability(problem: Problem, *, flat: float = 0.5, at: Unknowns | None = None) -> Identifiability:
    """Find the parameters, or combinations of them, that the data determine if `sigma` is the noise.

        identifiability(Problem.of(system, trials, free, unknown=("roll",)))

    The result depends little on the measured values, so simulated measurements of a planned experiment can be used.
    `fit.identifiability` of a `Fit` uses the variance of its residuals instead of `sigma`.

    The sensitivity of the residuals to the scaled parameters, with the nuisance parameters eliminated, is decomposed by
    singular values. A direction is undetermined if its standard deviation exceeds `flat` times the scale of the
    parameters, or `flat` times their values if these are larger.

    **Arguments:**

    - `problem`: a `Problem`.
    - `flat`: largest relative standard deviation of a determined direction.
    - `at`: a point of the problem, by default its start. The nuisance parameters are estimated for it.

    **Returns:** an `Identifiability`. Print it for a table.

    **Raises:** `ValueError` with the name of a window that cannot be simulated to its end.
    """
    refuse_other(problem, Problem, "identifiability", "identifiability(fit.problem), or fit.identifiability")
    point, linearization = solve_nuisance(problem, problem.start if at is None else at)
    return identifiability_at(problem, point, linearization, flat, sigma="given")


def identifiability_at(
    problem: Problem,
    point: Unknowns,
    at: Linearization,
    flat: float = 0.5,
    sigma: str = "estimated",
    fitted: bool = True,
) -> Identifiability:
    """Identifiability at a point where the problem has been linearized.

    **Arguments:**

    - `problem`, `point`, `at`: the problem, the point and the linearization there.
    - `flat`: as in `identifiability`.
    - `sigma`: "given" for a residual variance of one, "estimated" for the variance of the residuals at the point.
    - `fitted`: whether the parameters were fitted to these residuals.
    """
    parameters = problem.parameters
    names, p = parameters.names, len(parameters.names)
    to_values = np.asarray(parameters.slopes(point.parameters))
    # The change of each parameter for a unit step of the unconstrained ones. It is zero at a bound.
    scales = np.maximum(np.linalg.norm(to_values, axis=1), 1e-100)
    # From scaled parameters. At the limit of physically consistent inertia, an unconstrained parameter has no effect.
    to_x = np.linalg.pinv(to_values / scales[:, None], rcond=1e-9)
    eliminated = eliminate(at.blocks, 0.0)
    A = eliminated.rows[0] @ to_x
    before = np.linalg.norm(at.blocks.of_parameters @ to_x, axis=0)
    eps = float(jnp.finfo(eliminated.R.dtype).eps)
    most = before.max(initial=0.0)
    no_influence = before <= 1e4 * eps * most
    s, V = _by_singular_values(A, no_influence, 1e3 * eps * most)
    inverse = (V[s > 0].T / s[s > 0] ** 2) @ V[s > 0]
    information, determined, n_priors, prior_squares = prior_information(problem, point, eliminated)
    of_priors = to_x.T @ information @ to_x
    n_data, n_unknown = problem.size[0] - n_priors, problem.size[1]
    by_parameters = p - np.sum(inverse * of_priors) if fitted else 0.0
    degrees_of_freedom = n_data - (n_unknown - p) + determined - by_parameters
    variance = 1.0
    if sigma == "estimated" and problem.model.noise is None:  # a filter has an absolute noise level
        variance = (at.squares - prior_squares) / degrees_of_freedom if degrees_of_freedom > 1e-3 else np.nan
    # Without a degree of freedom `sigma` cannot be checked and is used as it is.
    along = V @ formal_covariance(inverse, of_priors, 1.0 if np.isnan(variance) else variance) @ V.T
    covariance = formal_covariance(inverse, of_priors, variance) * np.outer(scales, scales)
    # Near a bound the slope of the bijection vanishes. This does not mean that the data are insensitive.
    alone = np.count_nonzero(to_values, axis=1) <= 1
    at_bound = alone & (scales < 1e-3 * np.asarray(parameters.scale))
    beyond, names_of = _beyond(*eliminated.rows, at_bound, variance), np.array(names, str)
    result = Identifiability(
        names=names,
        units=parameters.units,
        scales=scales,
        singular_values=s,
        vectors=V,
        deviations=np.where(s > 0, np.sqrt(np.maximum(along.diagonal(), 0.0)), np.inf),
        without_influence=tuple(names_of[no_influence & ~at_bound].tolist()),
        at_bound=tuple(names_of[at_bound].tolist()),
        beyond=tuple(names_of[beyond].tolist()),
        undetermined=(),
        variance=float(variance),
        degrees_of_freedom=float(degrees_of_freedom),
        covariance=infinite_along(covariance, np.concatenate([V[s == 0], np.eye(p)[at_bound]])),
        covariance_of_x=to_x @ inverse @ to_x.T,
        directions=to_x @ V[s > 0].T,
    )
    # Judge relative to the estimate if it is larger than the scale: an initial guess of 1e-6 is not a useful scale for
    # an estimate of 0.05.
    values = np.abs(np.asarray(parameters.values(point.parameters)))
    share = scales / np.where(at_bound, scales, np.maximum(scales, values))
    physical = np.array(parameters.learned) == ""
    return dataclasses.replace(result, undetermined=_undetermined(result, physical, share, flat))


def _beyond(A: np.ndarray, r: np.ndarray, at_bound: np.ndarray, variance: float) -> np.ndarray:
    """Whether the unconstrained optimum of a parameter (p,) lies outside its bound by more than two standard errors.

    The linear prediction is used, which the bijection does not affect.
    """
    beyond = np.full(len(at_bound), False)
    for j in np.flatnonzero(at_bound):
        others = A[:, ~at_bound]
        alone = A[:, j] - others @ np.linalg.lstsq(others, A[:, j], rcond=None)[0]
        beyond[j] = not abs(alone @ r) <= 2 * np.linalg.norm(alone) * variance**0.5
    return beyond


def _undetermined(
    result: Identifiability, physical: np.ndarray, share: np.ndarray, flat: float
) -> tuple[Direction, ...]:
    """Directions whose standard deviation exceeds `flat`, the weakest first.

    **Arguments:**

    - `physical` (p,): False for the numbers of a learned function, which need not be determined one by one.
    - `share` (p,): each scale, divided by the larger one of scale and estimate.
    """
    V, names = result.vectors, result.names
    deviations = result.deviations * np.linalg.norm(V * share, axis=1)
    weak = [
        i for i in reversed(range(len(names))) if not deviations[i] <= flat and np.any(np.abs(V[i, physical]) > 0.1)
    ]
    rows = V.copy()
    nothing = [
        i
        for i in weak
        if result.singular_values[i] == 0 and names[int(np.abs(V[i]).argmax())] not in result.without_influence
    ]
    if len(nothing) > 1 and physical.all():
        rows[nothing] = _with_fewest_parts(V[nothing])
    return tuple(_direction(result, i, rows[i]) for i in weak)


def _with_fewest_parts(V: np.ndarray, most: int = 20_000) -> np.ndarray:
    """Unit rows (k, p) that span the space of the rows of V, with as many zeros as possible.

    The candidates are reduced echelon forms. Each is defined by k places where all rows but one are zero. The one with
    the fewest nonzero entries is returned, or V if there are more than `most` candidates.
    """
    k, p = V.shape
    if math.comb(p, k) > most:
        return V
    places = np.array(list(itertools.combinations(range(p), k)))
    parts = np.moveaxis(V[:, places], 1, 0)  # (c, k, k)
    places = places[np.linalg.cond(parts) < 1e4]
    rows = np.linalg.solve(np.moveaxis(V[:, places], 1, 0), V[None])  # (c, k, p)
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    rows = np.where(np.abs(rows) > 1e-6, rows, 0.0)
    best = rows[np.argmin(np.count_nonzero(rows, axis=(1, 2)))]
    return best * np.sign(best[np.arange(k), np.abs(best).argmax(axis=1)])[:, None]


def _by_singular_values(A: np.ndarray, no_influence: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Singular values (p,) of a sensitivity (m, p), and a row (p, p) for each, whose largest entry is positive.

    Values below `rounding` are set to zero, because elimination leaves rounding errors. Each parameter without
    influence is a direction of its own.
    """
    p, sensitive = A.shape[1], np.flatnonzero(~no_influence)
    s, V = np.zeros(p), np.zeros((p, p))
    if p == 0:  # `validate` fixes all parameters
        return s, V
    if sensitive.size:
        # Parameters without influence have zero columns, so they need not be part of the decomposition.
        _, s[: sensitive.size], V[: sensitive.size, sensitive] = np.linalg.svd(A[:, sensitive], full_matrices=False)
    V[np.arange(sensitive.size, p), np.flatnonzero(no_influence)] = 1.0
    return np.where(s <= rounding, 0.0, s), V * np.sign(V[np.arange(p), np.abs(V).argmax(axis=1)])[:, None]


def _direction(of: Identifiability, i: int, row: np.ndarray) -> Direction:
    s, deviation = of.singular_values[i], of.deviations[i]
    order = [j for j in np.argsort(-np.abs(row), kind="stable") if abs(row[j]) > 0.1]
    parts = tuple((of.names[j], float(row[j])) for j in order)
    first, alone, units = parts[0][0], len(parts) == 1, [f" {unit}".rstrip() for unit in of.units]
    size, error = min(deviation, 1.0), f"{deviation * of.scales[order[0]]:.2g}{units[order[0]]}"
    changes = [f"{of.names[j]} by {row[j] * size * of.scales[j]:+.2g}{units[j]}" for j in order]
    how = "changes nothing" if s == 0 else f"changes the fit by {size / deviation:.2g} standard deviations"
    texts = (
        (
            alone and first in of.beyond,
            f"{first} is at its bound, and its best value is beyond it. It may compensate for missing physics.",
        ),
        (alone and first in of.at_bound, f"{first} rests at its bound, which the data do not contradict."),
        (
            alone and first in of.without_influence,
            f"{first} has no influence on these data at these values, so a fit does not change it.",
        ),
        (alone and s == 0, f"{first} cannot be distinguished from unknown initial values and offsets."),
        (alone, f"{first} is undetermined: its standard deviation is {error}, {deviation:.2g} of its scale."),
        (True, f"{', '.join(n for n, _ in parts)} trade off: moving {', '.join(changes)} together {how}."),
    )
    text = next(text for applies, text in texts if applies)
    return Direction(float(s), float(deviation), parts, text)


def combination(names: Sequence[str], row: np.ndarray) -> str:
    """A linear combination as text, such as `0.71 mB - 0.70 zB`."""
    order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > 0.1]
    text = " ".join(f"{'-' if row[i] < 0 else '+'} {abs(row[i]):.2f} {names[i]}" for i in order)
    return text.removeprefix("+ ")
