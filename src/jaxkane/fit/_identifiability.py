"""What the data determine: singular values of the sensitivity, and the directions in which nothing changes."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ._block_lsq import eliminate
from ._covariance import formal_covariance, infinite_along, prior_information
from ._linearize import Linearization
from ._model import Unknowns
from ._nuisance import solve_nuisance
from ._problem import Problem, refuse_other
from ._tables import Rows, text_table


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of parameters, and how well it is known.

    Attributes: `singular_value`: by how many standard deviations of one measurement all residuals together move for a
    step of one along it; `deviation`: its own standard deviation, in scaled units (1 is a change by the whole scale,
    for a positive parameter by all of itself); `parts`: the parameters in it with their shares; `text`: in words.
    """

    singular_value: float
    deviation: float
    parts: tuple[tuple[str, float], ...]
    text: str


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """The sensitivity of all residuals to the free parameters, nuisance values eliminated.

    - `names`, `units` (p,); `scales` (p,): what parameters are counted in, each in its unit.
    - `singular_values` (p,), largest first; `vectors` (p, p), a row for each, in scaled parameters.
    - `deviations` (p,): standard deviation along each row, in scaled units.
    - `without_influence`: names of the parameters that change no residual at all. `at_bound`: of those that went as far
        as their bounds let them.
    - `undetermined`: the directions that the data do not determine, weakest first. Where several change nothing at
        all, so does every sum of them: those are taken in which the fewest parameters move.
    - `variance` of a residual, by which `covariance` and `deviations` count the data: of a `Fit` what is left there, by
        `degrees_of_freedom`, the residuals less the unknowns that they and not priors determine; else one, as `sigma`
        says.
    - `covariance` (p, p) of the parameters in their units, infinite for those that are not determined.
    - `covariance_of_x` (p, p) of the free numbers x behind them, with `sigma` as it was given (Laplace); `directions`
        (p, k): steps of x, of one along each row of `vectors` that the data determine.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: np.ndarray
    singular_values: np.ndarray
    vectors: np.ndarray
    deviations: np.ndarray
    without_influence: tuple[str, ...]
    at_bound: tuple[str, ...]
    undetermined: tuple[Direction, ...]
    variance: float
    degrees_of_freedom: float
    covariance: np.ndarray
    covariance_of_x: np.ndarray
    directions: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether every parameter is determined."""
        return not self.undetermined

    @property
    def rank(self) -> int:
        """How many numbers the data determine: parameters, or combinations of them."""
        return len(self.names) - len(self.undetermined)

    @property
    def messages(self) -> tuple[str, ...]:
        return tuple(direction.text for direction in self.undetermined)

    @property
    def rank_message(self) -> str:
        """In words, where combinations are determined and not the parameters themselves; else ""."""
        if all(len(direction.parts) == 1 for direction in self.undetermined):
            return ""
        return f"Of {len(self.names)} parameters {self.rank} combinations are determined."

    @property
    def information(self) -> np.ndarray:
        """Fisher information (p, p) of the scaled parameters, for residuals of variance one."""
        return (self.vectors.T * self.singular_values**2) @ self.vectors

    @property
    def given_sigma_errors(self) -> np.ndarray:
        """Standard errors (p,) with `sigma` as it was given, whatever is left; infinite where nothing determines."""
        s = self.singular_values
        return np.sqrt(self.in_units(np.diag(s[s > 0] ** -2.0)).diagonal())

    def in_units(self, covariance: np.ndarray) -> np.ndarray:
        """The covariance (p, p) of the parameters from one (k, k) along the rows of `vectors` that are determined."""
        known = self.singular_values > 0
        to_units = self.scales[:, None] * self.vectors[known].T
        return infinite_along(to_units @ covariance @ to_units.T, self.vectors[~known])

    @property
    def rows(self) -> Rows:
        """Singular values, deviations and directions; the first row is the head."""
        values = zip(self.vectors, self.singular_values, self.deviations, strict=True)
        rows = [[combination(self.names, row), f"{s:.4g}", f"{deviation:.2g}"] for row, s, deviation in values]
        return [("direction (scaled parameters)", "singular value", "deviation"), *rows]

    def __str__(self) -> str:
        return "\n".join([text_table(self.rows), *filter(None, [self.rank_message]), *self.messages])


def identifiability(problem: Problem, *, flat: float = 0.5, at: Unknowns | None = None) -> Identifiability:
    """Which parameters, or combinations of them, the data determine if their noise is as `sigma` says, whatever they
    are: a plan with simulated measurements will do. Of a `Fit`, `fit.identifiability` says it by the residuals left.

        identifiability(Problem.of(system, trials, free, unknown=("roll",)))

    The residuals' sensitivity to the scaled parameters, with the nuisance values eliminated, is decomposed by
    singular values. A direction whose standard deviation exceeds `flat` of the parameters' scale is undetermined.

    **Arguments:**

    - `problem`: a `Problem`.
    - `flat`: where undetermined begins. `at`: a point of the problem; by default its start. The nuisance values are
        estimated for it.

    **Returns:** an `Identifiability`; print it for a table.

    **Raises:** `ValueError` that names a window which cannot be simulated to its end.
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
    """Identifiability at a point where the problem has been linearized. With `sigma` "given" the variance of a residual
    is one, with "estimated" it is that of the residuals there; `fitted`: to which the parameters were."""
    parameters = problem.parameters
    names, p = parameters.names, len(parameters.names)
    to_values = np.asarray(parameters.slopes(point.x))
    # What a step of one in the free numbers does; at a bound, nothing at all.
    scales = np.maximum(np.linalg.norm(to_values, axis=1), 1e-100)
    # From scaled parameters; at the edge of what a body can have, a free number moves nothing any more.
    to_x = np.linalg.pinv(to_values / scales[:, None], rcond=1e-9)
    eliminated = eliminate(at.blocks, 0.0)
    A = eliminated.rows[0] @ to_x
    before = np.linalg.norm(np.asarray(at.blocks.R)[:, :, -1 - p : -1] @ to_x, axis=(0, 1))
    eps = float(jnp.finfo(eliminated.R.dtype).eps)
    no_influence = before <= 1e4 * eps * before.max()
    s, V = _by_singular_values(A, no_influence, 1e3 * eps * before.max())
    inverse = (V[s > 0].T / s[s > 0] ** 2) @ V[s > 0]
    priors = prior_information(problem, point, eliminated)
    of_priors = to_x.T @ priors.information @ to_x
    n_data, n_unknown = problem.size[0] - priors.number, problem.size[1]
    by_parameters = p - np.sum(inverse * of_priors) if fitted else 0.0
    degrees_of_freedom = n_data - (n_unknown - p) + priors.determined - by_parameters
    variance = 1.0
    if sigma == "estimated" and problem.model.noise is None:  # a likelihood knows how large residuals are
        variance = (at.cost - priors.squares) / degrees_of_freedom if degrees_of_freedom > 1e-3 else np.nan
    # Without a degree of freedom nothing says that `sigma` is wrong.
    along = V @ formal_covariance(inverse, of_priors, 1.0 if np.isnan(variance) else variance) @ V.T
    covariance = formal_covariance(inverse, of_priors, variance) * np.outer(scales, scales)
    # Beside a bound nothing moves any more: that is not a parameter which the data do not see.
    alone = np.count_nonzero(to_values, axis=1) <= 1
    at_bound = alone & (scales < 1e-3 * np.asarray(parameters.scale))
    named = lambda which: tuple(name for name, there in zip(names, which, strict=True) if there)  # noqa: E731
    result = Identifiability(
        names=names,
        units=parameters.units,
        scales=scales,
        singular_values=s,
        vectors=V,
        deviations=np.where(s > 0, np.sqrt(np.maximum(along.diagonal(), 0.0)), np.inf),
        without_influence=named(no_influence & ~at_bound),
        at_bound=named(at_bound),
        undetermined=(),
        variance=float(variance),
        degrees_of_freedom=float(degrees_of_freedom),
        covariance=infinite_along(covariance, V[s == 0]),
        covariance_of_x=to_x @ inverse @ to_x.T,
        directions=to_x @ V[s > 0].T,
    )
    return dataclasses.replace(result, undetermined=_undetermined(result, np.array(parameters.learned) == "", flat))


def _undetermined(result: Identifiability, physical: np.ndarray, flat: float) -> tuple[Direction, ...]:
    """Directions whose deviation exceeds `flat`, weakest first. `physical` (p,): which parameters are no numbers of a
    learned function, which need not be determined one by one."""
    V, names = result.vectors, result.names
    weak = [
        i
        for i in reversed(range(len(names)))
        if not result.deviations[i] <= flat and np.any(np.abs(V[i, physical]) > 0.1)
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
    """Rows (k, p) of length one that span what the rows of V span, with as many zeros as can be.

    Reduced echelon forms, of which each is given by k places where all rows but one are zero: the one with the fewest
    entries, of all if these are no more than `most`, else V.
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

    Values below `rounding` are zero: elimination leaves rounding errors of what it removed. Each parameter without
    influence is a direction of its own.
    """
    p, sensitive = A.shape[1], np.flatnonzero(~no_influence)
    s, V = np.zeros(p), np.zeros((p, p))
    if sensitive.size:
        # Columns that belong to free numbers without influence are left out of the elimination: nothing is lost.
        _, s[: sensitive.size], V[: sensitive.size, sensitive] = np.linalg.svd(A[:, sensitive], full_matrices=False)
    V[np.arange(sensitive.size, p), np.flatnonzero(no_influence)] = 1.0
    return np.where(s <= rounding, 0.0, s), V * np.sign(V[np.arange(p), np.abs(V).argmax(axis=1)])[:, None]


def _direction(of: Identifiability, i: int, row: np.ndarray) -> Direction:
    s, deviation = of.singular_values[i], of.deviations[i]
    order = [j for j in np.argsort(-np.abs(row), kind="stable") if abs(row[j]) > 0.1]
    parts = tuple((of.names[j], float(row[j])) for j in order)
    first = parts[0][0]
    if len(parts) == 1 and first in of.at_bound:
        text = f"{first} has gone to its bound: the data want it beyond. It may be making up for what the model lacks."
    elif len(parts) == 1 and first in of.without_influence:
        text = f"{first} has no influence on these data with these values: a fit does not move it from here."
    elif len(parts) == 1 and s == 0:
        text = f"{first} cannot be distinguished from the unknown starts and biases."
    elif len(parts) == 1:
        unit = f" {of.units[order[0]]}" * bool(of.units[order[0]])
        error = deviation * of.scales[order[0]]
        text = f"{first} is undetermined: its standard deviation is {error:.2g}{unit}, {deviation:.2g} of its scale."
    else:
        size = min(deviation, 1.0)
        together = ", ".join(
            f"{name} by {share * size * of.scales[j]:+.2g}{' ' * bool(of.units[j])}{of.units[j]}"
            for j, (name, share) in zip(order, parts, strict=True)
        )
        how = "changes nothing" if s == 0 else f"changes the fit by {size / deviation:.2g} standard deviations"
        text = f"{', '.join(name for name, _ in parts)} trade off: moving {together} together {how}."
    return Direction(float(s), float(deviation), parts, text)


def combination(names: Sequence[str], row: np.ndarray) -> str:
    """`0.71 mB - 0.70 zB`."""
    order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > 0.1]
    text = " ".join(f"{'-' if row[i] < 0 else '+'} {abs(row[i]):.2f} {names[i]}" for i in order)
    return text.removeprefix("+ ")
