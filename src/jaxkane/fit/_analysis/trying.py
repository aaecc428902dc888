"""One round of candidates: linearized together, the promising ones fitted. Knows problems, and what can be believed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.steps import uninterrupted, usable
from .._problem.linearization import Linearization, linearize
from .._result.covariance import slopes_of, values_of
from .._result.result import Fit
from .candidates import Candidate, groups_of
from .extended import Extended, extended
from .plausible import Plausible, plausible_of
from .score import beside_zero, bic_change, chance, independent_share, is_clustered, score, solved
from .standing import Folds, Standing, rows_of, without_priors
from .suspected import Suspect

NEUTRAL = 1e-6
"""By what part of it the sum of squares may differ where a candidate changes nothing at first."""


@dataclasses.dataclass(frozen=True)
class Trying:
    """What is the same for all candidates of a round."""

    fit: Fit
    standing: Standing
    taken: tuple[Candidate, ...]
    order: tuple[str, ...]  # of all candidates
    share: float  # of the level, for each
    said: Mapping[str, Any]
    folds: Folds

    def all_of(
        self, left: Sequence[Candidate], refits: int | None, bar: Any
    ) -> tuple[tuple[Suspect, ...], dict[str, Standing]]:
        """What every candidate promises, and of the promising ones what they keep; with where the search stands then.
        Those that stand come first, the best at the top."""
        promises = [promise for group in groups_of(self.fit, left) for promise in self._linearized(group, bar)]
        rows, found = {promise.row.name: promise.row for promise in promises}, {}
        able = [h for h in promises if h.extended is not None and not h.row.verdict]
        nested, others = ([h for h in able if h.nested is nested] for nested in (True, False))
        if refits is not None:
            nested = [h for h in nested if h.row.p < self.share]
            nested = sorted(nested, key=lambda h: (bool(h.objections), h.row.promised))[:refits]
        for promise in nested + (others if refits != 0 else []):  # what is not nested promises nothing before its fit
            bar.set_postfix_str(promise.row.name)
            rows[promise.row.name], after = self._fitted(promise)
            found |= {} if after is None else {promise.row.name: after}
            bar.update()
        done = [self._judged(row) for row in rows.values()]
        best = lambda row: (not row.stands, row.predicted if row.stands and self.folds else row.least)  # noqa: E731
        return tuple(sorted(done, key=best)), found

    def _linearized(self, group: Sequence[Candidate], bar: Any) -> list[Promise]:
        """The candidates of one system, by one linearization."""
        bar.set_postfix_str(f"{len(group)} linearized")
        try:
            more = extended(self.fit, (self.standing.problem, self.standing.point), group, self.taken, self.order)
            at, why = linearize(without_priors(more.problem), more.point), "cannot be simulated where it starts"
        except ValueError as error:
            more, at, why = None, None, str(error)
        bar.update()
        if more is None or at is None or not usable(at):
            return [Promise(c, Suspect(c.name, verdict=why)) for c in group]
        said = {name: value for c in group for name, value in c.plausible.items()}
        said |= {name: value for name, value in self.said.items() if name in more.names}
        # What was free has started where the fit did, whatever another system begins with.
        ranges = {
            p: r
            for of in (more.problem.parameters, self.fit.parameters)
            for p, r in plausible_of(of, said).ranges.items()
        }
        common = Common(more, at, _held(at), Plausible(ranges))
        return [self._promised(candidate, common) for candidate in group]

    def _promised(self, candidate: Candidate, common: Common) -> Promise:
        more, (x, b) = common.extended, common.extended.owned([candidate])
        new = [i for i in x if i not in more.base_x]
        rows, was = rows_of(more.problem, common.at, more.point, b), self.standing
        count = self._unknowns(candidate, more)
        without = None
        if count:  # what the fit has without them, in its own rows
            without = rows_of(more.problem, common.at, more.point, more.base_b).least(more.base_x)[1]
        found = score(
            rows, more.base_x, new, freedom=was.freedom, more=count, correlation=was.correlation, without=without
        )
        A, r = rows.of(x)
        here = common.at.cost + float(np.sum(rows.priors[x, -1] ** 2))
        nested = abs(here - was.cost) <= NEUTRAL * was.cost + 1e-9
        slopes = np.asarray(slopes_of(more.problem.parameters, more.point.x))
        moved = np.zeros(len(more.names))
        moved[x] = solved(A, r)
        values = np.asarray(values_of(more.problem.parameters, more.point.x)) + slopes @ moved
        left_out = float("nan")
        if nested and self.folds is not None:
            freedom = was.freedom - len(new) - count
            left_out = rows.left_out(x, self.folds) + _own_share(count, found.least, freedom, was.correlation)
        row_names = tuple(more.names[i] for i in new)
        row = Suspect(
            name=candidate.name,
            parameters=row_names,
            values={more.names[i]: float(values[i]) for i in x},
            errors=_errors(row_names, slopes[np.ix_(new, new)], found.covariance),
            promised=was.cost - found.drop if nested else float("nan"),
            p=found.p if nested else float("nan"),
            criterion="score test" if nested else "",
            predicted=left_out,
            verdict=_undetermined(more, new, found) if nested else "",
        )
        objections = common.plausible.objections(row.values)
        return Promise(candidate, row, more, common, nested, tuple(objections))

    def _fitted(self, promise: Promise) -> tuple[Suspect, Standing | None]:
        """After a fit of all that is free and this."""
        more, was, row, common = promise.extended, self.standing, promise.row, promise.common
        assert more is not None
        assert common is not None
        problem, start = more.with_only([promise.candidate], common.held)
        try:
            found = uninterrupted(minimize(problem, LeastSquares(), start=start))
            at = linearize(without_priors(problem), found.point)
        except ValueError as error:
            return dataclasses.replace(row, verdict=str(error)), None
        if at is None or not usable(at) or found.status != "converged":
            return dataclasses.replace(row, verdict=f"its fit has not converged ({found.status})"), None
        n, count = len(more.base_x), self._unknowns(promise.candidate, more)
        k = len(found.names) - n + count
        rows = rows_of(problem, at, found.point, more.owned([promise.candidate])[1])
        after = Standing(problem, found.point, found.names, found.cost, was.freedom - k, found.autocorrelation, rows)
        now = score(
            rows, range(n), range(n, len(found.names)), freedom=was.freedom, more=count, correlation=after.correlation
        )
        slopes = np.asarray(slopes_of(problem.parameters, found.point.x))
        p, criterion, verdict = float("nan"), "trials left out", ""
        if promise.nested:
            p, criterion = chance(was.cost - after.cost, k, after.cost, after.freedom, after.correlation), "F test"
            if not count and is_clustered(rows, len(found.names), after.correlation):
                p = beside_zero(np.asarray(found.point.x - start.x)[n:], now.covariance, len(rows.data))
                criterion = "t test"
        elif self.folds is None:
            change, criterion = bic_change(was.cost, after.cost, k, self.fit.problem.size[0], after.correlation), "BIC"
            verdict = "" if change < 0 else f"its BIC is higher by {change:.3g}"
        before = set(common.plausible.objections(was.values))
        row = dataclasses.replace(
            row,
            values=after.values,
            errors=_errors(found.names[n:], slopes[n:, n:], now.covariance),
            cost=after.cost,
            p=p,
            criterion=criterion,
            verdict=verdict,
            predicted=after.left_out(self.folds) + _own_share(count, after.cost, after.freedom, after.correlation),
            objections=tuple(o for o in common.plausible.objections(after.values) if o not in before),
        )
        return row, after

    def _unknowns(self, candidate: Candidate, more: Extended) -> int:
        """How many of the trials' and windows' own come with a candidate."""
        n_b = len(set(more.own_b[candidate.name]) - set(more.base_b)) * more.problem.clusters
        return n_b + more.point.z.size - self.standing.point.z.size

    def _judged(self, row: Suspect) -> Suspect:
        """With the verdict, in the order in which doubts are raised."""
        was, fitted = self.standing, np.isfinite(row.cost)
        doubts = (
            (bool(row.verdict), row.verdict),
            (not np.isnan(row.p) and row.p >= self.share, "no more than chance"),
            (not fitted and np.isnan(row.p), "not nested, not fitted"),
            (not fitted, "promising, not fitted"),
            (fitted and not row.cost < was.cost, "its fit lowers nothing"),
            (bool(row.objections), f"not plausible: {', '.join(row.objections)}"),
            (row.predicted >= was.left_out(self.folds), "does not predict trials left out"),
        )
        verdict = next((words for doubted, words in doubts if doubted), "")
        return dataclasses.replace(row, verdict=verdict or "stands", stands=not verdict)


@dataclasses.dataclass(frozen=True)
class Common:
    """Of the candidates of one system: their problem, linearized, how unknowns of trials are held, what is believed."""

    extended: Extended
    at: Linearization
    held: np.ndarray
    plausible: Plausible


@dataclasses.dataclass(frozen=True)
class Promise:
    """A candidate and what it promises; `nested`: whether it changes nothing where it starts."""

    candidate: Candidate
    row: Suspect
    extended: Extended | None = None
    common: Common | None = None
    nested: bool = True
    objections: tuple[str, ...] = ()


def _held(at: Linearization) -> np.ndarray:
    """Deviations of priors that hold unknowns of trials (n_b,) much closer than any data could tell."""
    blocks, first = at.blocks, at.blocks.n_z + at.blocks.n_next
    norms = np.linalg.norm(np.asarray(blocks.R)[:, :, first : first + blocks.n_b], axis=(0, 1))
    return float(jnp.finfo(blocks.R.dtype).eps) ** 0.4 / np.where(norms > 0, norms, 1.0)


def _own_share(count: int, cost: float, freedom: int, correlation: float) -> float:
    """What unknowns of the trials' own flatter a prediction by: trials that are left out find theirs, which takes away
    a variance each, and adds one to what comes after (as in Akaike's criterion)."""
    return 2.0 * count * cost / freedom / independent_share(correlation) if count and freedom > 0 else 0.0


def _errors(names: Sequence[str], slopes: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)) if names else []
    return {name: float(deviation) for name, deviation in zip(names, deviations, strict=True)}


def _undetermined(more: Extended, new: Sequence[int], found: Any) -> str:
    """What the data do not determine, in words."""
    unseen = [more.names[i] for i, seen in zip(new, found.seen, strict=True) if not seen]
    if unseen:
        return f"{', '.join(unseen)} is not seen by these data"
    lost = [more.names[i] for i, apart in zip(new, found.apart, strict=True) if not apart]
    return f"{', '.join(lost)} cannot be distinguished from what is free" if lost else ""
