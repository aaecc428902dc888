"""Forward selection of model extensions: candidates, score tests, refits, decisions."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._common.lookup import refuse_unknown
from ._candidates import (
    AugmentedProblem,
    Candidate,
    checked_candidates,
    compatible_groups,
    extended_specification,
    mapped_point,
)
from ._compare import Plausible, plausible_of
from ._fit import minimize, solve, uninterrupted
from ._linearize import Linearization
from ._model import Unknowns
from ._nuisance import usable
from ._optimizers import LeastSquares
from ._problem import Problem, refuse_other
from ._result import Fit
from ._statistics import (
    LinearizedProblem,
    Score,
    bic_change,
    check_level,
    effective_sample_fraction,
    f_test,
    folds_of,
    linearized_problem,
    score_test,
    solved,
    use_clusters,
    wald_test,
)
from ._tables import Rows, Tables, html_tables, text_tables

HEAD = ("candidate", "estimate", "std. error", "predicted cost", "cost", "p", "criterion", "held-out cost", "decision")

NESTED = 1e-6
"""By what part of it the sum of squares may differ at the start of a nested candidate."""


@dataclasses.dataclass(frozen=True)
class Extension:
    """A candidate and its tests.

    - `parameters`: those that it frees; `values`: by name, of these and of all that was free; `errors`: of these. Of
        its fit where `cost` is a number, else of the linearization.
    - `nested`: whether the motion is the same before anything is freed. `predicted_cost`: the sum of squares by the
        linearization, where it is nested; `cost`: after a fit (NaN without).
    - `p`: of the test, where it is nested. `criterion`: what decides beside the trials left out: "score test" before a
        fit, "F test" or "t test" after it; of what is not nested "trials left out" alone, or "BIC" where there is one.
    - `held_out_cost`: the sum of squares of trials that are left out in turn; unknowns of the trials' own, which are
        estimated for those too, count twice the variance of a residual each.
    - `bound_violations`: what is not plausible, in words. `accepted`, or the `reason` why not.
    """

    name: str
    parameters: tuple[str, ...] = ()
    values: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    nested: bool = True
    predicted_cost: float = math.nan
    cost: float = math.nan
    p: float = math.nan
    criterion: str = ""
    held_out_cost: float = math.nan
    bound_violations: tuple[str, ...] = ()
    reason: str = ""
    accepted: bool = False

    @property
    def cells(self) -> tuple[str, ...]:
        number = lambda x, form=".5g": "" if math.isnan(x) else f"{x:{form}}"  # noqa: E731
        known = [name for name in self.parameters if not math.isnan(self.errors[name])]
        estimates = ", ".join(f"{self.values[name]:.4g}" for name in known)
        errors = ", ".join(f"{self.errors[name]:.2g}" for name in known)
        costs, decision = (number(self.predicted_cost), number(self.cost)), self.reason or "accepted"
        return (
            *(self.name, estimates, errors, *costs),
            *(number(self.p, ".2g"), self.criterion, number(self.held_out_cost), decision),
        )


@dataclasses.dataclass(frozen=True)
class Alternative:
    """Candidates that were accepted together: their `names`, the sums of squares of their fit and of trials left out,
    and whether they predict as well as the selected ones, to twice the standard error of the differences by fold."""

    names: tuple[str, ...]
    cost: float
    held_out_cost: float
    is_as_good: bool


@dataclasses.dataclass(frozen=True, repr=False)
class ForwardSelection:
    """The result of `forward_selection`; print it for the tables.

    - `rounds`: the candidates of each round, the selected one first. `costs`, `held_out_costs`: the sums of squares
        with which each began, fitted and of trials left out in turn.
    - `selected`: the names of the selected candidates, in that order; `best`: the first one, or None. `fit`: with all
        of them; the one `before` where there is none.
    - `alternatives`: what else was accepted, the best first. `level`: of the test.
    """

    before: Fit
    rounds: tuple[tuple[Extension, ...], ...]
    costs: tuple[float, ...]
    held_out_costs: tuple[float, ...]
    selected: tuple[str, ...]
    alternatives: tuple[Alternative, ...]
    level: float
    fit: Fit

    @property
    def best(self) -> Extension | None:
        return self.rounds[0][0] if self.selected else None

    @property
    def tables(self) -> Tables:
        """A heading and rows, of which the first is the head, of every round."""
        tables: list[tuple[str, Rows]] = []
        for i, extensions in enumerate(self.rounds):
            beside = f" with {', '.join(self.selected[:i])}" if i else ""
            held_out = f"{self.held_out_costs[i]:.5g} of trials left out in turn"
            if math.isnan(self.held_out_costs[i]):
                held_out = "one trial, nothing is left out"
            heading = f"Sum of squares{beside} {self.costs[i]:.6g}; {held_out}."
            tables.append((heading, [HEAD, *(extension.cells for extension in extensions)]))
        if self.alternatives:
            rows = [("accepted too", "cost", "held-out cost", "against what is selected")]
            for one in self.alternatives:
                held_out = "" if math.isnan(one.held_out_cost) else f"{one.held_out_cost:.5g}"
                told = "predicts as well" if one.is_as_good else ""
                rows.append((", ".join(one.names), f"{one.cost:.5g}", held_out, told))
            tables.append(("Alternatives.", rows))
        return tables

    @property
    def conclusion(self) -> str:
        if not self.selected:
            return f"Nothing is selected: no candidate is accepted at a level of {self.level:g}."
        held_out = self.held_out_costs[0]
        left_out = "" if math.isnan(held_out) else f" (of trials left out: {held_out:.5g} before)"
        best = [extensions[0] for extensions in self.rounds[: len(self.selected)]]
        names = [one.name if one.nested else f"{one.name} (not nested: by {one.criterion})" for one in best]
        text = f"Selected: {', '.join(names)}. Sum of squares {self.before.cost:.6g} -> {self.fit.cost:.6g}{left_out}."
        as_good = [" and ".join(one.names) for one in self.alternatives if one.is_as_good]
        return text + (f" These data do not tell it from {'; '.join(as_good)}." if as_good else "")

    def __str__(self) -> str:
        tables = "\n\n".join(text_tables([table], (0, len(table[1][0]) - 1)) for table in self.tables)
        return f"{tables}\n\n{self.conclusion}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"{html_tables(self.tables)}<p>{html.escape(self.conclusion)}</p>"


def forward_selection(
    fit: Fit,
    candidates: Any,
    *,
    depth: int = 1,
    beam: int = 1,
    refits: int | None = 3,
    level: float = 0.05,
    plausible: Mapping[str, Any] | None = None,
    folds: int | Sequence[Sequence[int]] | None = None,
    progress: bool = False,
) -> ForwardSelection:
    """Model extensions by forward selection: by how much each lowers the sum of squares, whether it is plausible, and
    whether it predicts trials that were left out.

        candidates = ["dry_friction", Gain("torque"), Offset("angle"), Candidate("lag", system=Lagging())]
        selection = forward_selection(fit, candidates)
        print(selection)
        selection.fit                                       # with the selected ones

    All candidates of a system are linearized together, once, at the minimum of the fit; all that is free and unknown
    there is eliminated. This gives of each the predicted cost, an estimate with its error, and the p-value of a score
    test (Rao 1948). Residuals that are correlated count as what they are (see the page on model extensions). Those of
    the lowest predicted costs are then fitted, together with all that is free, by the same compiled program.

    A nested candidate, which changes nothing where it starts, is accepted where (1) its p-value is below `level`, over
    all candidates together (Bonferroni); (2) so it is after the fit; (3) no parameter becomes implausible, its own or
    one that was free; (4) trials left out in turn are predicted better with it. Of the accepted ones the one that
    predicts best is selected; with `depth` above one all others are tested again beside it, until none is accepted.

    A candidate that is not nested, as another system whose motion differs from the start, has no predicted cost. It is
    always fitted, besides the `refits`. Instead of (1) nothing is tested where trials can be left out, and where there
    is one trial, whether the Bayesian information criterion is lower. The `criterion` of each says what decided.

    **Arguments:**

    - `fit`: one that has converged. `candidates`: a list of names of parameters, `Free`, `Gain`, `Offset`, `Delay`,
        `LowPass`, `Inertia`, and `Candidate`, which may be several of these together, what every trial has its own of,
        or another system. Each starts where it changes nothing.
    - `depth`: how many may be selected. `beam`: how many branches are followed at once: with 1 the best candidate is
        taken, and the others are tested beside it; with more, the best few are, and in the end what predicts best is
        selected.
        `refits`: how many nested candidates are fitted in each round; None for all that the data can distinguish, 0 for
        no fit at all. `level`: of the test.
    - `plausible`: by name, (lower, upper), or a share of the start such as 0.2. By default `Candidate.plausible`,
        three deviations of a prior, or two bounds, without their ends. A parameter that starts on a bound, as friction
        at zero, is searched for on both sides and plausible on one.
    - `folds`: trials that are left out together, as in `cross_validate`. `progress`: a bar.

    **Returns:** `ForwardSelection`: print it for the table.

    **Raises:** `ValueError` for a fit that has not converged, no candidate, two of the same name, one that is free
    already, and names that do not exist.
    """
    refuse_other(fit, Fit, "forward_selection", "forward_selection(fit(...), candidates)")
    _check_arguments(fit, depth, beam, refits, level)
    candidates = list(checked_candidates(fit, candidates))
    order, plausible = tuple(candidate.name for candidate in candidates), dict(plausible or {})
    T, groups = len(fit.problem.trials), None
    if T >= 2:
        groups = folds_of(folds, T)
    elif folds is not None:
        raise ValueError("`folds`: one trial alone cannot be left out: cut it with `Trial.between`.")
    branches, ended, accepted = [Branch((), RestrictedModel.of(fit), ())], [], {}
    with tqdm(disable=not progress, desc="forward selection", unit=" step") as bar:
        for _ in range(depth):
            longer: dict[frozenset[str], Branch] = {}
            for branch in branches:
                rest = [c for c in candidates if c.name not in {one.name for one in branch.selected}]
                if not rest:
                    ended.append(branch)
                    continue
                level_of_each = level / len(rest)
                round = SelectionRound(fit, branch.model, branch.selected, order, level_of_each, plausible, groups, bar)
                for other in branch.extended(*round.run(rest, refits), candidates, groups):
                    names = frozenset(c.name for c in other.selected)
                    if len(other.selected) == len(branch.selected):
                        ended.append(other)
                    elif names not in longer or other.rank(groups) < longer[names].rank(groups):
                        longer[names] = accepted[names] = other
            branches = sorted(longer.values(), key=lambda branch: branch.rank(groups))[:beam]
    best = min([*branches, *ended], key=lambda branch: branch.rank(groups))
    tested = [one for branch in (*branches, *ended) for round in branch.rounds for one in round.candidates]
    names = {name for one in tested for name in one.values}
    refuse_unknown(plausible, (*fit.names, *names), "`plausible` names")
    after = fit
    if best.selected:  # as a user would pose it
        problem = fit.problem.with_specification(extended_specification(fit, best.selected))
        start = mapped_point(best.model.problem, best.model.point, problem, best.model.names)
        after = solve(problem, LeastSquares(), start=start)
    costs, held_out_costs, extensions = zip(*best.rounds, strict=True)
    selected = tuple(c.name for c in best.selected)
    others = [branch for names, branch in accepted.items() if not names <= {*selected}]
    others.sort(key=lambda branch: branch.rank(groups))
    alternatives = tuple(branch.beside(best, groups) for branch in others)
    return ForwardSelection(fit, extensions, costs, held_out_costs, selected, alternatives, level, after)


class Round(NamedTuple):
    """The sums of squares with which a round began, fitted and of trials left out, and its candidates, the selected one
    first."""

    cost: float
    held_out_cost: float
    candidates: tuple[Extension, ...]


@dataclasses.dataclass(frozen=True)
class Branch:
    """Candidates selected one after the other, and the rounds in which they were."""

    selected: tuple[Candidate, ...]
    model: RestrictedModel
    rounds: tuple[Round, ...]

    def extended(
        self,
        extensions: tuple[Extension, ...],
        models: Mapping[str, RestrictedModel],
        candidates: Sequence[Candidate],
        folds: Sequence[Sequence[int]] | None,
    ) -> list[Branch]:
        """By each candidate that was accepted; where none was, this one, with the round in which it ended."""
        before = self.model.cost, self.model.held_out_cost(folds)
        accepted = [one for one in extensions if one.accepted]
        if not accepted:
            return [Branch(self.selected, self.model, (*self.rounds, Round(*before, extensions)))]
        branches = []
        for one in accepted:
            first = (one, *(other for other in extensions if other is not one))
            candidate = next(c for c in candidates if c.name == one.name)
            branches.append(
                Branch((*self.selected, candidate), models[one.name], (*self.rounds, Round(*before, first)))
            )
        return branches

    def rank(self, folds: Sequence[Sequence[int]] | None) -> float:
        """By trials left out, as the last of its candidates was judged; with one trial by the sum of squares."""
        if folds is None:
            return self.model.cost
        return self.rounds[-1].candidates[0].held_out_cost if self.selected else self.model.held_out_cost(folds)

    def beside(self, best: Branch, folds: Sequence[Sequence[int]] | None) -> Alternative:
        names, is_as_good = tuple(c.name for c in self.selected), False
        if folds is not None and best.selected:
            by_fold = [branch.model.linearized.costs_left_out(branch.model.places, folds) for branch in (self, best)]
            difference = by_fold[0] - by_fold[1]
            error = np.std(difference, ddof=1) * math.sqrt(len(folds))
            rounding = 1e-9 * best.rank(folds)  # two that are the same model differ by nothing else
            is_as_good = bool(self.rank(folds) - best.rank(folds) <= 2.0 * error + rounding)
        return Alternative(names, self.model.cost, math.nan if folds is None else self.rank(folds), is_as_good)


def _check_arguments(fit: Fit, depth: Any, beam: Any, refits: Any, level: float) -> None:
    if fit.problem.specification.noise is not None:
        raise ValueError(
            "forward_selection compares sums of squares of fits without process noise; this fit has process noise, "
            "which makes up for what the model lacks. Fit without `noise`, or compare `marginal_likelihood`."
        )
    if fit.status != "converged":
        raise ValueError(
            f"The fit has not converged ({fit.status}), and a score test is one at a minimum. Go on with "
            "`minimize(fit.problem, LeastSquares(), start=fit.point)`."
        )
    for name, value, smallest in (
        ("depth", depth, 1),
        ("beam", beam, 1),
        ("refits", 0 if refits is None else refits, 0),
    ):
        if not isinstance(value, int) or value < smallest:
            raise ValueError(f"`{name}` is a whole number of {smallest} at least, got {value!r}.")
    check_level(level)


@dataclasses.dataclass(frozen=True)
class RestrictedModel:
    """The minimum of a problem of whose parameters `names` are free. `linearized`: there, in the columns of all its
    parameters; `degrees_of_freedom`: residuals less unknowns; `correlation`: of neighbouring residuals."""

    problem: Problem
    point: Unknowns
    names: tuple[str, ...]
    cost: float
    degrees_of_freedom: int
    correlation: float
    linearized: LinearizedProblem

    @classmethod
    def of(cls, fit: Fit) -> RestrictedModel:
        at: Any = fit.linearization
        if fit.parameters.has_prior.any():
            at = without_priors(fit.problem).linearize(fit.point)
        n_r, n_unknown = fit.problem.size
        linearized = linearized_problem(fit.problem, at, fit.point)
        return cls(fit.problem, fit.point, fit.names, fit.cost, n_r - n_unknown, fit.autocorrelation, linearized)

    @property
    def places(self) -> list[int]:
        return [self.problem.parameters.names.index(name) for name in self.names]

    @property
    def values(self) -> dict[str, float]:
        values = np.asarray(self.problem.parameters.values(self.point.x))[self.places]
        return dict(zip(self.names, values.tolist(), strict=True))

    def held_out_cost(self, folds: Sequence[Sequence[int]] | None) -> float:
        """The sum of squares of trials left out in turn, linearized; NaN without folds."""
        return float(np.sum(self.linearized.costs_left_out(self.places, folds))) if folds is not None else math.nan


def without_priors(problem: Problem) -> Problem:
    """The same without priors of parameters; nothing is compiled anew."""
    return problem.with_priors(dict.fromkeys(problem.parameters.names, (0.0, math.inf)))


@dataclasses.dataclass(frozen=True)
class Group:
    """Candidates of one system: their augmented problem, linearized, and what is plausible. `fixed` (n_b,): deviations
    of priors that fix the unknowns of trials of all candidates but one."""

    augmented: AugmentedProblem
    at: Linearization
    plausible: Plausible
    fixed: np.ndarray


@dataclasses.dataclass(frozen=True)
class SelectionRound:
    """One round: every candidate is tested beside those selected before."""

    fit: Fit
    model: RestrictedModel
    selected: tuple[Candidate, ...]
    order: tuple[str, ...]  # of all candidates
    level: float  # of each test
    plausible: Mapping[str, Any]
    folds: Sequence[Sequence[int]] | None
    bar: Any

    def run(
        self, candidates: Sequence[Candidate], refits: int | None
    ) -> tuple[tuple[Extension, ...], dict[str, RestrictedModel]]:
        """The candidates, the best accepted one first, and the restricted models of the next round."""
        extensions: dict[str, Extension] = {}
        models: dict[str, RestrictedModel] = {}
        testable: list[tuple[Candidate, Group]] = []
        for members in compatible_groups(self.fit, candidates):
            self.bar.set_postfix_str(f"{len(members)} linearized")
            try:
                augmented, at = self._linearized(members)
            except ValueError as error:
                extensions |= {c.name: Extension(c.name, reason=str(error)) for c in members}
            else:
                group = self._group(members, augmented, at)
                extensions |= {c.name: self._score_tested(c, group) for c in members}
                testable += [(c, group) for c in members if not extensions[c.name].reason]
            self.bar.update()
        for candidate, group in self._to_refit(testable, extensions, refits):
            self.bar.set_postfix_str(candidate.name)
            extension, model = self._refitted(candidate, group, extensions[candidate.name])
            extensions[candidate.name] = extension
            models |= {} if model is None else {candidate.name: model}
            self.bar.update()
        decided = sorted(map(self._decided, extensions.values()), key=self._rank)
        return tuple(decided), models

    def _to_refit(
        self, testable: Sequence[tuple[Candidate, Group]], extensions: Mapping[str, Extension], refits: int | None
    ) -> list[tuple[Candidate, Group]]:
        """Nested candidates of the lowest predicted costs, plausible ones first; and those that are not nested."""
        nested = [(c, group) for c, group in testable if extensions[c.name].nested]
        rest = [(c, group) for c, group in testable if not extensions[c.name].nested]
        if refits is not None:

            def rank(item: tuple[Candidate, Group]) -> tuple[bool, float]:
                extension = extensions[item[0].name]
                return bool(item[1].plausible.bound_violations(extension.values)), extension.predicted_cost

            nested = sorted((item for item in nested if extensions[item[0].name].p < self.level), key=rank)[:refits]
        return nested + (rest if refits != 0 else [])

    def _linearized(self, members: Sequence[Candidate]) -> tuple[AugmentedProblem, Linearization]:
        """**Raises:** `ValueError` where the augmented problem cannot be posed or simulated."""
        minimum = self.model.problem, self.model.point
        augmented = AugmentedProblem.of(self.fit, minimum, members, self.selected, self.order)
        at = without_priors(augmented.problem).linearize(augmented.point)
        if at is None or not usable(at):
            raise ValueError("cannot be simulated where it starts")
        return augmented, at

    def _group(self, members: Sequence[Candidate], augmented: AugmentedProblem, at: Linearization) -> Group:
        plausible = {name: bounds for c in members for name, bounds in c.plausible.items()}
        plausible |= {name: bounds for name, bounds in self.plausible.items() if name in augmented.names}
        # What was free has started where the fit did, whatever another system begins with.
        ranges = [plausible_of(parameters, plausible).ranges
                  for parameters in (augmented.problem.parameters, self.fit.parameters)]  # fmt: skip
        # Much closer than any data could determine.
        first = at.blocks.n_z + at.blocks.n_next
        norms = np.linalg.norm(np.asarray(at.blocks.R)[:, :, first : first + at.blocks.n_b], axis=(0, 1))
        fixed = float(jnp.finfo(at.blocks.R.dtype).eps) ** 0.4 / np.where(norms > 0, norms, 1.0)
        return Group(augmented, at, Plausible({**ranges[0], **ranges[1]}), fixed)

    def _score_tested(self, candidate: Candidate, group: Group) -> Extension:
        augmented, model = group.augmented, self.model
        problem, point, base_x = augmented.problem, augmented.point, augmented.base_x
        x, b = augmented.places(candidate)
        new, count = x[len(base_x) :], self._unknowns_of_trials(candidate, augmented)
        linearized = linearized_problem(problem, group.at, point, b)
        without = None
        if count:  # with the candidate's unknowns of trials fixed
            without = linearized_problem(problem, group.at, point, augmented.base_b).minimum(base_x)[1]
        score = score_test(
            linearized,
            base_x,
            new,
            degrees_of_freedom=model.degrees_of_freedom,
            more=count,
            correlation=model.correlation,
            without=without,
        )
        slopes, step = np.asarray(problem.parameters.slopes(point.x)), np.zeros(len(augmented.names))
        step[x] = solved(*linearized.of(x))
        values = np.asarray(problem.parameters.values(point.x)) + slopes @ step
        names = tuple(augmented.names[i] for i in new)
        cost = group.at.cost + float(np.sum(linearized.priors[x, -1] ** 2))
        extension = Extension(
            name=candidate.name,
            parameters=names,
            values={augmented.names[i]: float(values[i]) for i in x},
            errors=_errors(names, slopes[np.ix_(new, new)], score.covariance),
            nested=abs(cost - model.cost) <= NESTED * model.cost + 1e-9,
        )
        if not extension.nested:
            return extension
        held_out_cost = math.nan
        if self.folds is not None:
            degrees_of_freedom = model.degrees_of_freedom - len(new) - count
            optimism = _optimism(count, score.minimal_cost, degrees_of_freedom, model.correlation)
            held_out_cost = float(np.sum(linearized.costs_left_out(x, self.folds))) + optimism
        return dataclasses.replace(
            extension,
            predicted_cost=model.cost - score.drop,
            p=score.p,
            criterion="score test",
            held_out_cost=held_out_cost,
            reason=_undetermined(names, score),
        )

    def _refitted(
        self, candidate: Candidate, group: Group, extension: Extension
    ) -> tuple[Extension, RestrictedModel | None]:
        """After a fit of all that is free and this candidate."""
        model, augmented = self.model, group.augmented
        problem, start = augmented.with_only(candidate, group.fixed)
        try:
            fit = uninterrupted(minimize(problem, LeastSquares(), start=start))
            at = without_priors(problem).linearize(fit.point)
        except ValueError as error:
            return dataclasses.replace(extension, reason=str(error)), None
        if at is None or not usable(at) or fit.status != "converged":
            return dataclasses.replace(extension, reason=f"its fit has not converged ({fit.status})"), None
        n, count = len(augmented.base_x), self._unknowns_of_trials(candidate, augmented)
        new, k = range(n, len(fit.names)), len(fit.names) - n + count
        linearized = linearized_problem(problem, at, fit.point, augmented.places(candidate)[1])
        degrees_of_freedom, correlation = model.degrees_of_freedom - k, fit.autocorrelation
        after = RestrictedModel(problem, fit.point, fit.names, fit.cost, degrees_of_freedom, correlation, linearized)
        score = score_test(
            linearized,
            range(n),
            new,
            degrees_of_freedom=model.degrees_of_freedom,
            more=count,
            correlation=correlation,
        )
        p, criterion, reason = math.nan, "trials left out", ""
        if extension.nested:
            p, criterion = f_test(model.cost - fit.cost, k, fit.cost, degrees_of_freedom, correlation), "F test"
            if not count and use_clusters(linearized, len(fit.names), correlation):
                p = wald_test(np.asarray(fit.point.x - start.x)[n:], score.covariance, len(linearized.data))
                criterion = "t test"
        elif self.folds is None:
            change, criterion = bic_change(model.cost, fit.cost, k, self.fit.problem.size[0], correlation), "BIC"
            reason = "" if change < 0 else f"its BIC is higher by {change:.3g}"
        before = group.plausible.bound_violations(model.values)
        slopes = np.asarray(problem.parameters.slopes(fit.point.x))
        extension = dataclasses.replace(
            extension,
            values=after.values,
            errors=_errors(fit.names[n:], slopes[n:, n:], score.covariance),
            cost=fit.cost,
            p=p,
            criterion=criterion,
            held_out_cost=after.held_out_cost(self.folds) + _optimism(count, fit.cost, degrees_of_freedom, correlation),
            bound_violations=tuple(o for o in group.plausible.bound_violations(after.values) if o not in before),
            reason=reason,
        )
        return extension, after

    def _decided(self, extension: Extension) -> Extension:
        """Accepted, or with the first reason against it."""
        model, is_fitted = self.model, np.isfinite(extension.cost)
        reasons: tuple[tuple[Any, str], ...] = (
            (extension.reason, extension.reason),
            (extension.p >= self.level, "no more than chance"),
            (not is_fitted and np.isnan(extension.p), "not nested, not fitted"),
            (not is_fitted, "promising, not fitted"),
            (is_fitted and not extension.cost < model.cost, "its fit lowers nothing"),
            (extension.bound_violations, f"not plausible: {', '.join(extension.bound_violations)}"),
            (extension.held_out_cost >= model.held_out_cost(self.folds), "does not predict trials left out"),
        )
        reason = next((words for applies, words in reasons if applies), "")
        return dataclasses.replace(extension, reason=reason, accepted=not reason)

    def _rank(self, extension: Extension) -> tuple[bool, float]:
        """Accepted ones first; by the held-out cost, or by the cost as far as it is known."""
        if extension.accepted and self.folds:
            return False, extension.held_out_cost
        costs = [x for x in (extension.cost, extension.predicted_cost) if not math.isnan(x)]
        return not extension.accepted, costs[0] if costs else math.inf

    def _unknowns_of_trials(self, candidate: Candidate, augmented: AugmentedProblem) -> int:
        """How many unknowns of the trials' and windows' own come with a candidate."""
        own = set(augmented.own_b[candidate.name]) - set(augmented.base_b)
        return len(own) * augmented.problem.clusters + augmented.point.z.size - self.model.point.z.size


def _optimism(count: int, cost: float, degrees_of_freedom: int, correlation: float) -> float:
    """By how much unknowns of the trials' own make a prediction look better: they are estimated from the trials that
    are left out, which takes away a variance each, and adds one to what comes after (as in Akaike's criterion)."""
    if not count or degrees_of_freedom <= 0:
        return 0.0
    return 2.0 * count * cost / degrees_of_freedom / effective_sample_fraction(correlation)


def _errors(names: Sequence[str], slopes: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)) if names else []
    return {name: float(deviation) for name, deviation in zip(names, deviations, strict=True)}


def _undetermined(names: Sequence[str], score: Score) -> str:
    """Which parameters the data do not determine, in words."""
    insensitive, collinear = (", ".join(np.array(names, str)[~ok]) for ok in (score.sensitive, score.distinguishable))
    if insensitive:
        return f"these data do not depend on {insensitive}"
    return f"{collinear} cannot be distinguished from what is free" if collinear else ""
