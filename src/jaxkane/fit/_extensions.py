"""What a model may lack: candidates ranked by score tests, refitted, and decided on."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._common.lookup import refuse_unknown
from ._block_lsq import Blocks, eliminate
from ._candidates import Candidate, Extended, candidates_of, carried, extended, groups_of, posed_with
from ._compare import Plausible, plausible_of
from ._covariance import parameter_slopes, parameter_values
from ._fit import minimize, solve, uninterrupted
from ._linearize import Linearization
from ._model import Unknowns
from ._nuisance import usable
from ._optimizers import LeastSquares
from ._problem import Problem, refuse_other
from ._result import Fit
from ._statistics import (
    LinearizedProblem,
    bic_change,
    check_level,
    effective_sample_fraction,
    f_test,
    score_test,
    solved,
    use_clusters,
    wald_test,
)
from ._tables import Rows, html_tables, text_tables
from ._validate import folds_of

Folds = Sequence[Sequence[int]] | None


@dataclasses.dataclass(frozen=True)
class Standing:
    """Where a search stands: at a minimum of a problem of whose parameters `names` are free, the others held. `rows`
    is its linearization there, in the columns of all its parameters; `freedom`: residuals less unknowns."""

    problem: Problem
    point: Unknowns
    names: tuple[str, ...]
    cost: float
    freedom: int
    correlation: float
    rows: LinearizedProblem

    @classmethod
    def of(cls, fit: Fit) -> Standing:
        problem, at = fit.problem, fit.linearization
        if np.any(np.isfinite(np.asarray(fit.parameters.prior_deviation))):
            again = without_priors(problem).linearize(fit.point)
            assert again is not None
            at = again
        n_r, n_unknown = problem.size
        rows = rows_of(problem, at, fit.point, range(fit.point.b.shape[1]))
        return cls(problem, fit.point, fit.names, fit.cost, n_r - n_unknown, fit.autocorrelation, rows)

    @property
    def places(self) -> list[int]:
        return [self.problem.parameters.names.index(name) for name in self.names]

    @property
    def values(self) -> dict[str, float]:
        values = np.asarray(parameter_values(self.problem.parameters, self.point.x))
        return {name: float(values[i]) for name, i in zip(self.names, self.places, strict=True)}

    def held_out_cost(self, folds: Folds) -> float:
        """The sum of squares of trials left out in turn, with the parameters that the others say; NaN without folds."""
        return self.rows.cost_left_out(self.places, folds) if folds is not None else float("nan")

    def carried_to(self, problem: Problem) -> Unknowns:
        """The same point of a problem that has all these unknowns, and others."""
        return carried(self.problem, self.point, problem, self.names)


def without_priors(problem: Problem) -> Problem:
    """The same without priors of parameters; nothing is compiled anew."""
    return problem.with_priors(dict.fromkeys(problem.parameters.names, (0.0, float("inf"))))


def rows_of(problem: Problem, at: Linearization, point: Unknowns, b: Sequence[int]) -> LinearizedProblem:
    """A linearization without priors, starts and these unknowns of trials eliminated, the others held."""
    blocks, parameters = at.blocks, problem.parameters
    first = blocks.n_z + blocks.n_next
    kept = [*range(first), *(first + i for i in b), *range(first + blocks.n_b, blocks.R.shape[-1])]
    R = blocks.R[:, :, jnp.asarray(kept, dtype=jnp.int32)]
    reduced = Blocks(R, blocks.windows, blocks.n_z, blocks.n_next, len(list(b)))
    deviation, norms = np.asarray(parameters.prior_deviation, float)[:, None], np.asarray(blocks.column_norms, float)
    slopes, off = np.asarray(parameter_slopes(parameters, point.x)), np.asarray(parameters.prior_residuals(point.x))
    return LinearizedProblem(
        np.asarray(eliminate(reduced, 0.0).R, float), np.column_stack([slopes / deviation, off]), norms
    )


HEAD = ("candidate", "estimate", "std. error", "predicted cost", "cost", "p", "criterion", "held-out cost", "decision")


@dataclasses.dataclass(frozen=True)
class Extension:
    """One candidate.

    - `parameters`: what it frees; `values`: by name, of these and of all that was free; `errors`: of these. Fitted
        where `cost` is a number, else as the linearization has them.
    - `predicted_cost`, `cost`: the sum of squares by the linearization, and fitted (NaN where it was not). `p`: of the
        test, of what is nested. `criterion`: what decides beside the trials left
        out: "score test" before it is fitted, "F test" or "t test" after; of what is not nested "trials left out"
        alone, or "BIC" where none can be left out.
    - `held_out_cost`: the sum of squares of trials that are left out in turn; unknowns of the trials' own, which are
        estimated for those too, count twice the variance of a residual each.
    - `objections`: what is not plausible, in words. `accepted`, or the `reason` why not.
    """

    name: str
    parameters: tuple[str, ...] = ()
    values: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    predicted_cost: float = math.nan
    cost: float = math.nan
    p: float = math.nan
    criterion: str = ""
    held_out_cost: float = math.nan
    objections: tuple[str, ...] = ()
    reason: str = ""
    accepted: bool = False

    @property
    def least(self) -> float:
        """What is known of the sum of squares with it; infinite where nothing is."""
        known = [x for x in (self.cost, self.predicted_cost) if not math.isnan(x)]
        return known[0] if known else math.inf

    @property
    def cells(self) -> tuple[str, ...]:
        number = lambda x, form=".5g": "" if math.isnan(x) else f"{x:{form}}"  # noqa: E731
        known = [name for name in self.parameters if not math.isnan(self.errors[name])]
        estimates = ", ".join(f"{self.values[name]:.4g}" for name in known)
        errors = ", ".join(f"{self.errors[name]:.2g}" for name in known)
        tested = (number(self.predicted_cost), number(self.cost), number(self.p, ".2g"), self.criterion)
        return (
            self.name,
            estimates,
            errors,
            *tested,
            number(self.held_out_cost),
            "accepted" if self.accepted else self.reason,
        )


@dataclasses.dataclass(frozen=True, repr=False)
class ForwardSelection:
    """What `forward_selection` found; print it for the tables.

    - `rounds`: the candidates of each round, the accepted ones first. `costs`, `held_out_costs`: the sums of squares
        with which each began, fitted and of trials held out in turn.
    - `selected`: names of what was selected, in that order; `best`: the first one, or None. `fit`: with all of it
        free; where nothing was selected, the one `before`.
    - `level`: of the test.
    """

    before: Fit
    rounds: tuple[tuple[Extension, ...], ...]
    costs: tuple[float, ...]
    held_out_costs: tuple[float, ...]
    selected: tuple[str, ...]
    level: float
    fit: Fit

    @property
    def best(self) -> Extension | None:
        return self.rounds[0][0] if self.selected else None

    @property
    def tables(self) -> list[tuple[str, Rows]]:
        """A heading and rows, of which the first is the head, of every round."""
        tables: list[tuple[str, Rows]] = []
        for i, (cost, out, rows) in enumerate(zip(self.costs, self.held_out_costs, self.rounds, strict=True)):
            beside = f" with {', '.join(self.selected[:i])}" if i else ""
            left = "one trial, nothing is left out" if math.isnan(out) else f"{out:.5g} of trials left out in turn"
            heading = f"Sum of squares{beside} {cost:.6g}; {left}."
            tables.append((heading, [HEAD, *(row.cells for row in rows)]))
        return tables

    @property
    def conclusion(self) -> str:
        if not self.selected:
            return f"Nothing is selected: no candidate is accepted at a level of {self.level:g}."
        left = (
            "" if math.isnan(self.held_out_costs[0]) else f" (of trials left out: {self.held_out_costs[0]:.5g} before)"
        )
        best = zip(self.selected, self.rounds, strict=False)
        taken = [f"{name} (not nested: by {r[0].criterion})" if math.isnan(r[0].p) else name for name, r in best]
        return f"Selected: {', '.join(taken)}. Sum of squares {self.before.cost:.6g} -> {self.fit.cost:.6g}{left}."

    def __str__(self) -> str:
        return f"{text_tables(self.tables, (0, len(HEAD) - 1))}\n\n{self.conclusion}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"{html_tables(self.tables)}<p>{html.escape(self.conclusion)}</p>"


NEUTRAL = 1e-6
"""By what part of it the sum of squares may differ where a candidate changes nothing at first."""


@dataclasses.dataclass(frozen=True)
class Trying:
    """What is the same for all candidates of a round."""

    fit: Fit
    standing: Standing
    selected: tuple[Candidate, ...]
    order: tuple[str, ...]  # of all candidates
    share: float  # of the level, for each
    said: Mapping[str, Any]
    folds: Folds

    def all_of(
        self, left: Sequence[Candidate], refits: int | None, bar: Any
    ) -> tuple[tuple[Extension, ...], dict[str, Standing]]:
        """What every candidate promises, and of the promising ones what they keep; with where the search stands then.
        Those that stand come first, the best at the top."""
        promises = [promise for group in groups_of(self.fit, left) for promise in self._linearized(group, bar)]
        rows, found = {promise.row.name: promise.row for promise in promises}, {}
        able = [h for h in promises if h.extended is not None and not h.row.reason]
        nested, others = ([h for h in able if h.nested is nested] for nested in (True, False))
        if refits is not None:
            nested = [h for h in nested if h.row.p < self.share]
            nested = sorted(nested, key=lambda h: (bool(h.objections), h.row.predicted_cost))[:refits]
        for promise in nested + (others if refits != 0 else []):  # what is not nested promises nothing before its fit
            bar.set_postfix_str(promise.row.name)
            rows[promise.row.name], after = self._fitted(promise)
            found |= {} if after is None else {promise.row.name: after}
            bar.update()
        done = [self._judged(row) for row in rows.values()]
        best = lambda row: (not row.accepted, row.held_out_cost if row.accepted and self.folds else row.least)  # noqa: E731
        return tuple(sorted(done, key=best)), found

    def _linearized(self, group: Sequence[Candidate], bar: Any) -> list[Promise]:
        """The candidates of one system, by one linearization."""
        bar.set_postfix_str(f"{len(group)} linearized")
        try:
            more = extended(self.fit, (self.standing.problem, self.standing.point), group, self.selected, self.order)
            at, why = without_priors(more.problem).linearize(more.point), "cannot be simulated where it starts"
        except ValueError as error:
            more, at, why = None, None, str(error)
        bar.update()
        if more is None or at is None or not usable(at):
            return [Promise(c, Extension(c.name, reason=why)) for c in group]
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
            without = rows_of(more.problem, common.at, more.point, more.base_b).minimum(more.base_x)[1]
        found = score_test(
            rows,
            more.base_x,
            new,
            degrees_of_freedom=was.freedom,
            more=count,
            correlation=was.correlation,
            without=without,
        )
        A, r = rows.of(x)
        here = common.at.cost + float(np.sum(rows.priors[x, -1] ** 2))
        nested = abs(here - was.cost) <= NEUTRAL * was.cost + 1e-9
        slopes = np.asarray(parameter_slopes(more.problem.parameters, more.point.x))
        moved = np.zeros(len(more.names))
        moved[x] = solved(A, r)
        values = np.asarray(parameter_values(more.problem.parameters, more.point.x)) + slopes @ moved
        left_out = float("nan")
        if nested and self.folds is not None:
            freedom = was.freedom - len(new) - count
            left_out = rows.cost_left_out(x, self.folds) + _own_share(
                count, found.minimal_cost, freedom, was.correlation
            )
        row_names = tuple(more.names[i] for i in new)
        row = Extension(
            name=candidate.name,
            parameters=row_names,
            values={more.names[i]: float(values[i]) for i in x},
            errors=_errors(row_names, slopes[np.ix_(new, new)], found.covariance),
            predicted_cost=was.cost - found.drop if nested else float("nan"),
            p=found.p if nested else float("nan"),
            criterion="score test" if nested else "",
            held_out_cost=left_out,
            reason=_undetermined(more, new, found) if nested else "",
        )
        objections = common.plausible.bound_violations(row.values)
        return Promise(candidate, row, more, common, nested, tuple(objections))

    def _fitted(self, promise: Promise) -> tuple[Extension, Standing | None]:
        """After a fit of all that is free and this."""
        more, was, row, common = promise.extended, self.standing, promise.row, promise.common
        assert more is not None
        assert common is not None
        problem, start = more.with_only([promise.candidate], common.held)
        try:
            found = uninterrupted(minimize(problem, LeastSquares(), start=start))
            at = without_priors(problem).linearize(found.point)
        except ValueError as error:
            return dataclasses.replace(row, reason=str(error)), None
        if at is None or not usable(at) or found.status != "converged":
            return dataclasses.replace(row, reason=f"its fit has not converged ({found.status})"), None
        n, count = len(more.base_x), self._unknowns(promise.candidate, more)
        k = len(found.names) - n + count
        rows = rows_of(problem, at, found.point, more.owned([promise.candidate])[1])
        after = Standing(problem, found.point, found.names, found.cost, was.freedom - k, found.autocorrelation, rows)
        now = score_test(
            rows,
            range(n),
            range(n, len(found.names)),
            degrees_of_freedom=was.freedom,
            more=count,
            correlation=after.correlation,
        )
        slopes = np.asarray(parameter_slopes(problem.parameters, found.point.x))
        p, criterion, reason = float("nan"), "trials left out", ""
        if promise.nested:
            p, criterion = f_test(was.cost - after.cost, k, after.cost, after.freedom, after.correlation), "F test"
            if not count and use_clusters(rows, len(found.names), after.correlation):
                p = wald_test(np.asarray(found.point.x - start.x)[n:], now.covariance, len(rows.data))
                criterion = "t test"
        elif self.folds is None:
            change, criterion = bic_change(was.cost, after.cost, k, self.fit.problem.size[0], after.correlation), "BIC"
            reason = "" if change < 0 else f"its BIC is higher by {change:.3g}"
        before = set(common.plausible.bound_violations(was.values))
        row = dataclasses.replace(
            row,
            values=after.values,
            errors=_errors(found.names[n:], slopes[n:, n:], now.covariance),
            cost=after.cost,
            p=p,
            criterion=criterion,
            reason=reason,
            held_out_cost=after.held_out_cost(self.folds)
            + _own_share(count, after.cost, after.freedom, after.correlation),
            objections=tuple(o for o in common.plausible.bound_violations(after.values) if o not in before),
        )
        return row, after

    def _unknowns(self, candidate: Candidate, more: Extended) -> int:
        """How many of the trials' and windows' own come with a candidate."""
        n_b = len(set(more.own_b[candidate.name]) - set(more.base_b)) * more.problem.clusters
        return n_b + more.point.z.size - self.standing.point.z.size

    def _judged(self, row: Extension) -> Extension:
        """With the reason, in the order in which doubts are raised."""
        was, fitted = self.standing, np.isfinite(row.cost)
        doubts = (
            (bool(row.reason), row.reason),
            (not np.isnan(row.p) and row.p >= self.share, "no more than chance"),
            (not fitted and np.isnan(row.p), "not nested, not fitted"),
            (not fitted, "promising, not fitted"),
            (fitted and not row.cost < was.cost, "its fit lowers nothing"),
            (bool(row.objections), f"not plausible: {', '.join(row.objections)}"),
            (row.held_out_cost >= was.held_out_cost(self.folds), "does not predict trials left out"),
        )
        reason = next((words for doubted, words in doubts if doubted), "")
        return dataclasses.replace(row, reason=reason, accepted=not reason)


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
    row: Extension
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
    return 2.0 * count * cost / freedom / effective_sample_fraction(correlation) if count and freedom > 0 else 0.0


def _errors(names: Sequence[str], slopes: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)) if names else []
    return {name: float(deviation) for name, deviation in zip(names, deviations, strict=True)}


def _undetermined(more: Extended, new: Sequence[int], found: Any) -> str:
    """What the data do not determine, in words."""
    unseen = [more.names[i] for i, seen in zip(new, found.sensitive, strict=True) if not seen]
    if unseen:
        return f"{', '.join(unseen)} is not seen by these data"
    lost = [more.names[i] for i, apart in zip(new, found.distinguishable, strict=True) if not apart]
    return f"{', '.join(lost)} cannot be distinguished from what is free" if lost else ""


def forward_selection(
    fit: Fit,
    candidates: Any,
    *,
    depth: int = 1,
    refits: int | None = 3,
    level: float = 0.05,
    plausible: Mapping[str, Any] | None = None,
    folds: int | Sequence[Sequence[int]] | None = None,
    progress: bool = False,
) -> ForwardSelection:
    """Which of these extensions a model lacks: what each would lower the sum of squares by, whether it can be believed,
    and whether it predicts trials that were left out.

        candidates = ["dry_friction", Gain("torque"), Offset("angle"), Candidate("lag", system=Lagging())]
        selection = forward_selection(fit, candidates)
        print(selection)
        selection.fit                                       # with what was selected

    All candidates of a system are linearized together, once, where the fit ended; what is free and unknown already is
    eliminated. That says how much each promises, its estimate with its error, and by a score test (Rao 1948) whether
    chance promises as much. Residuals that are correlated count as what they are (see the page on identification).
    The most promising ones are then fitted, together with all that is free, from the same compiled program.

    A nested candidate, which changes nothing where it starts, stands where (1) chance promises so much with a
    probability below `level`, over all candidates together (Bonferroni); (2) fitted, it keeps that; (3) no parameter
    becomes implausible, its own or one that was free; (4) trials left out in turn are predicted better with it.
    Of those that stand, the one that predicts best is taken; with `depth` above one the others are tried again beside
    it, and so on, until none stands.

    What is not nested, as another system whose motion differs from the start, promises nothing before it is fitted, and
    always is, besides the `refits`. In the place of (1) nothing is asked where trials can be left out, and where there
    is one alone, whether the Bayesian information criterion is lower. The `criterion` of each says what decided.

    **Arguments:**

    - `fit`: one that has converged. `candidates`: a list of names of parameters, `Free`, `Gain`, `Offset`, `Delay`,
        `Inertia`, and `Candidate`, which may be several of these together, what every trial has its own of, or another
        system. Each starts where it is neutral.
    - `depth`: how many may be taken, one after the other. `refits`: how many that are nested are fitted in each round;
        None for all that the data can distinguish, 0 for none at all. `level`: of the test.
    - `plausible`: by name, (lower, upper), or a share of the start such as 0.2. Else what `Candidate.plausible` says,
        three deviations of a prior, and two bounds, of which it must stay away. What starts on a bound, given
        or declared, as friction at zero, is searched for on both sides and believed on one.
    - `folds`: trials that are left out together, as in `cross_validate`. `progress`: a bar.

    **Returns:** `ForwardSelection`: print it for the table.

    **Raises:** `ValueError` for a fit that has not converged, no candidate, two of the same name, one that is free
    already, and names that do not exist.
    """
    refuse_other(fit, Fit, "forward_selection", "forward_selection(fit(...), candidates)")
    _check(fit, depth, refits, level)
    left = list(candidates_of(fit, candidates))
    order = tuple(candidate.name for candidate in left)
    said = dict(plausible or {})
    T, groups = len(fit.problem.trials), None
    if T >= 2:
        groups = folds_of((T if T <= 10 else 5) if folds is None else folds, T)
    elif folds is not None:
        raise ValueError("`folds`: one trial alone cannot be left out: cut it with `Trial.between`.")
    standing, taken, rounds = Standing.of(fit), [], []
    with tqdm(disable=not progress, desc="forward_selection", unit=" step") as bar:
        for _ in range(depth):
            round = Trying(fit, standing, tuple(taken), order, level / len(left), said, groups)
            rows, ways = round.all_of(left, refits, bar)
            best = next((row for row in rows if row.accepted), None)
            rounds.append((standing.cost, standing.held_out_cost(groups), rows))
            if best is None:
                break
            taken.append(next(c for c in left if c.name == best.name))
            left = [c for c in left if c.name != best.name]
            standing = ways[best.name]
            if not left:
                break
    names = {name for _, _, rows in rounds for row in rows for name in row.values}
    refuse_unknown(said, (*fit.names, *names), "`plausible` names")
    return ForwardSelection(
        before=fit,
        rounds=tuple(rows for *_, rows in rounds),
        costs=tuple(cost for cost, *_ in rounds),
        held_out_costs=tuple(out for _, out, _ in rounds),
        selected=tuple(c.name for c in taken),
        level=level,
        fit=_fitted(fit, taken, standing) if taken else fit,
    )


def _check(fit: Fit, depth: Any, refits: Any, level: float) -> None:
    if fit.problem.specification.noise is not None:
        raise ValueError(
            "forward_selection compares sums of squares of fits without process noise; this fit has process noise, "
            "which makes up for what the model lacks. Fit without `noise`, or compare `marginal_likelihood`."
        )
    if fit.status != "converged":
        raise ValueError(
            f"The fit has not converged ({fit.status}): what is asked beside it is asked at a minimum. Go on with "
            "`minimize(fit.problem, LeastSquares(), start=fit.point)`."
        )
    for name, value, least in (("depth", depth, 1), ("refits", refits, 0)):
        if value is None and name == "refits":
            continue
        if not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` is a whole number of {least} at least, got {value!r}.")
    check_level(level)


def _fitted(fit: Fit, taken: Sequence[Candidate], standing: Standing) -> Fit:
    """The fit with what was taken, as a user would pose it."""
    problem = fit.problem.with_specification(posed_with(fit, taken))
    return solve(problem, LeastSquares(), start=standing.carried_to(problem))
