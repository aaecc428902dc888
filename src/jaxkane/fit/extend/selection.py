"""Search for model extensions: add, exchange and remove candidates, decided by tests and by held-out trials."""

from __future__ import annotations

import dataclasses
import html
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from tqdm import tqdm

from ..._common.lookup import refuse, refuse_unknown, whole_number
from ..._scalarjit.compat import on_device
from ..problem.model import Simulation
from ..problem.specification import parameters_of, refuse_other
from ..result.data import Rows, Tables, html_tables, text_tables
from ..result.diagnostics import AT_A_MINIMUM, Ranges, implausible, plausible_of, refuse_unless_at_a_minimum
from ..result.fit_result import Fit
from ..result.linearized import LinearizedProblem, Score, linearized_problem, score_test, trial_folds
from ..result.statistics import check_level
from ..result.studies import energy_sources
from ..solve.fit import search, solve, uninterrupted
from ..solve.optimizers import LeastSquares, usable
from .candidates import (
    Alternative,
    Branch,
    Candidate,
    Candidates,
    Extension,
    Group,
    Model,
    Move,
    Round,
    Terms,
    augmented_problem,
    checked_terms,
    compatible_groups,
    extended_specification,
    mapped_point,
    scaled_terms,
)

HOPELESS_P, HOPELESS_COST = 0.2, 1.1
"""A candidate is not fitted if its score test has a larger p, or if its predicted held-out cost is larger by this
factor. In a search for the friction of a double pendulum, predicted held-out costs were right within 1 %."""

NESTED = 1e-6
"""Largest relative difference of the sum of squares at the start of a nested candidate."""


@dataclasses.dataclass(frozen=True)
class Search:
    fit: Fit
    terms: Terms
    exchange: bool
    depth: int
    refits: int | None
    level: float
    plausible: Ranges
    folds: Sequence[Sequence[int]] | None
    bar: Any

    def run(self, beam: int) -> tuple[list[Branch], list[Branch]]:
        """Branches that could not be extended further, and all models that were accepted during the search."""
        first = Model.of(self.fit, self.terms.removable, self.folds, self.plausible)
        branches, ended, accepted = [Branch(first, ())], [], {}
        while branches:
            longer: dict[frozenset[str], Branch] = {}
            for branch in branches:
                extensions, models = self.round(branch.model)
                taken = [one for one in extensions if one.accepted]
                if not taken:
                    more = [Round(branch.model, extensions)] * bool(extensions or not branch.rounds)
                    ended.append(Branch(branch.model, (*branch.rounds, *more)))
                for one in taken:
                    ordered = (one, *(other for other in extensions if other is not one))
                    other = Branch(models[one.name], (*branch.rounds, Round(branch.model, ordered)))
                    key = other.model.key
                    # Several branches may lead to the same model. Only the best of them is extended.
                    if key not in accepted or other.model.rank < accepted[key].model.rank:
                        longer[key] = accepted[key] = other
            branches = sorted(longer.values(), key=lambda branch: branch.model.rank)[:beam]
        return ended, list(accepted.values())

    def round(self, model: Model) -> tuple[tuple[Extension, ...], dict[str, Model]]:
        """The extensions that are tried, the best accepted one first, and the models after them."""
        rest = [c for c in self.terms.all if c not in model.terms]
        added = [c for c in model.terms if c in self.terms.candidates]
        single, pairs = [], []
        if len(added) < self.depth:
            single = [Move((c,)) for c in rest]
        # A removal is decided by held-out trials. Without folds nothing is removed.
        asked = self.terms.all if self.exchange else self.terms.removable * bool(self.folds)
        dropped = [c for c in model.terms if c.has_parameters_only and c in asked]
        parameters_only = [c for c in rest if c.has_parameters_only]
        exchanges = [Move((), (d,)) for d in dropped if len(model.fit.names) > 1]
        exchanges += [Move((c,), (d,)) for d in dropped for c in parameters_only]
        if self.exchange and len(added) + 2 <= self.depth:
            pairs = [Move(pair) for pair in itertools.combinations(parameters_only, 2)]
        if not (single or exchanges):
            return (), {}
        share = 0.5 if pairs else 1.0  # split the level, so that pairs do not increase false positives
        groups, lost = self._groups(model, rest)
        kinds = (single, share * self.level), (exchanges, self.level * len(exchanges)), (pairs, share * self.level)
        extensions, models = [], {}
        for moves, level in kinds:
            if moves and not (moves is pairs and any(one.accepted for one in extensions)):
                others, more = self._tried(model, groups, moves, level / len(moves))
                extensions, models = extensions + others, models | more
        return tuple(sorted(extensions + lost, key=_order)), models

    def _groups(self, model: Model, rest: Sequence[Candidate]) -> tuple[dict[str, Group], list[Extension]]:
        """The group in which each candidate and selected term is tested, by name, and candidates that cannot be
        simulated.
        """
        groups: dict[str, Group] = {}
        lost: list[Extension] = []
        for members in compatible_groups(self.fit, rest) or [[]]:
            self.bar.set_postfix_str(f"{len(members)} linearized")
            try:
                group = self._group(model, members)
            except ValueError as error:
                lost += [Extension(c.name, reason=str(error)) for c in members]
            else:
                if not group.nested and self.folds is None:
                    reason = "not nested, and no trial can be left out"
                    lost += [Extension(c.name, nested=False, reason=reason) for c in members]
                    continue
                groups |= {c.name: group for c in members}
                if group.nested:
                    groups |= {c.name: group for c in model.terms}
            self.bar.update()
        return groups, lost

    def _group(self, model: Model, members: Sequence[Candidate]) -> Group:
        """The group of these candidates.

        **Raises:** `ValueError` if the augmented problem cannot be constructed or simulated.
        """
        order = [c.name for c in self.terms.all]  # a fixed order, so that all rounds share a compiled program
        both = sorted((*model.terms, *members), key=lambda c: order.index(c.name))
        problem, point = augmented_problem(self.terms.base, (model.fit.problem, model.fit.point, model.fit.names), both)
        at = problem.linearize(point)
        if at is None or not usable(at):
            raise ValueError("the simulation fails at its initial guess")
        names, linearized = problem.parameters.names, linearized_problem(at)
        own = {c.name: [names.index(name) for name in c.names(problem.system)] for c in both}
        of_terms = {i for places in own.values() for i in places}
        base = [i for i, name in enumerate(names) if name in model.fit.names and i not in of_terms]
        free = [names.index(name) for name in model.fit.names]
        of_priors = linearized.priors[[*free, *range(len(names), len(linearized.priors))], -1]
        cost = at.cost - at.prior_squares + float(np.sum(of_priors**2))
        # The absolute tolerance is for simulated measurements, whose cost is almost zero.
        nested = abs(cost - model.fit.cost) <= NESTED * model.fit.cost + 1e-9
        at_bound = [names.index(name) for name in model.at_bound]
        return Group(problem, point, cost, linearized, base, own, at_bound, nested)

    def _tried(
        self, model: Model, groups: Mapping[str, Group], moves: Sequence[Move], level: float
    ) -> tuple[list[Extension], dict[str, Model]]:
        """Linearize moves of one kind, fit the most promising ones, and decide at `level` for each move."""
        tried: list[tuple[Move, Group, Extension]] = []
        for move in moves:
            of_each = [groups.get(c.name) for c in move.add or move.drop]
            group = of_each[0]
            if group is not None and all(other is group for other in of_each):  # otherwise one cannot be simulated
                tried.append((move, group, self._predicted(model, move, group)))
        fitted = [item for item in tried if not item[2].reason]
        if self.refits is not None:
            # Plausible ones first, then by predicted cost, or for exchanges and removals by held-out cost.
            nested = sorted(
                (item for item in fitted if item[2].nested and not _is_hopeless(item[2], model, level)),
                key=lambda x: (bool(x[2].bound_violations), x[2].held_out_cost if x[0].drop else x[2].predicted_cost),
            )[: self.refits]
            fitted = nested + [item for item in fitted if not item[2].nested] * bool(self.refits)
        extensions, models = {move.name: extension for move, _, extension in tried}, {}
        for move, group, extension in fitted:
            self.bar.set_postfix_str(move.name)
            extensions[move.name], after = self._refitted(model, move, group, extension)
            models |= {} if after is None else {move.name: after}
            self.bar.update()
        decided = []
        for name, extension in extensions.items():
            after = models[name].bound_violations if name in models else {}
            worse = [words for of, words in after.items() if of not in model.bound_violations]
            decided.append(self._decided(model, extension, level, worse))
        shown = [e for e in decided if np.isfinite(e.cost) or all(not m.drop and len(m.add) == 1 for m in moves)]
        return shown, models

    def _predicted(self, model: Model, move: Move, group: Group) -> Extension:
        """The extension as predicted by the linearization at the minimum of the model."""
        base, both, dropped = group.places_of(model.terms, move)
        new, names = both[len(base) :], group.problem.parameters.names
        steps, of_base = ([i for i in places if i not in group.at_bound] for places in (both, base))
        x = np.asarray(group.point.parameters)
        linearized = _moved(group.linearized, dropped, -x[dropped])
        freedom = model.degrees_of_freedom + len(dropped)
        score = score_test(linearized, of_base, new, degrees_of_freedom=freedom, correlation=model.correlation)
        slopes, step = np.asarray(group.problem.parameters.slopes(group.point.parameters)), np.zeros(len(names))
        step[steps], cost = linearized.minimum(steps)
        values = np.asarray(group.problem.parameters.values(on_device(group.neutral(dropped)))) + slopes @ step
        new_names = tuple(names[i] for i in new)
        extension = Extension(
            name=move.name,
            parameters=new_names,
            values={names[i]: float(values[i]) for i in both},
            errors=_errors(new_names, slopes[np.ix_(new, new)], score.covariance),
            nested=group.nested,
        )
        if not group.nested:
            return extension
        held_out = math.nan if self.folds is None else float(np.sum(linearized.costs_left_out(steps, self.folds)))
        return dataclasses.replace(
            extension,
            predicted_cost=cost,
            p=self._one_sided(score, new_names, group) if new else math.nan,
            criterion="score test" if new else "",
            held_out_cost=held_out,
            bound_violations=tuple(implausible(self.plausible, extension.values).values()),
            reason=_undetermined(new_names, score),
        )

    def _refitted(self, model: Model, move: Move, group: Group, extension: Extension) -> tuple[Extension, Model | None]:
        """The extension and the model after a fit of all parameters that are then free."""
        base, both, dropped = group.places_of(model.terms, move)
        # A subset of the augmented problem, not a problem of its own, which would have to be compiled for each
        # candidate.
        parameters = group.problem.model.parameters.subset(both, on_device(group.neutral(dropped)))
        problem = dataclasses.replace(
            group.problem, model=eqx.tree_at(lambda m: m.parameters, group.problem.model, parameters)
        )
        if (problem.specification.simulation or Simulation()).chooses and not problem.has_steps:
            # Forces of dry friction are nearly discontinuous: integration errors would hide small changes of the cost.
            problem = problem.with_tolerances(1e-2 * np.asarray(self.fit.problem.model.settings.rtol))
        start = eqx.tree_at(lambda p: p.parameters, group.point, group.point.parameters[parameters.places])
        try:
            method = LeastSquares(horizons=())  # without restarts, because the start is near the minimum
            fit = uninterrupted(search(problem, method, start=start, check_steps=False))
            if fit.status not in AT_A_MINIMUM:
                return dataclasses.replace(extension, reason=f"its fit has not converged ({fit.status})"), None
            kept = (c for c in model.terms if c not in move.drop)
            after = Model.of(fit, (*kept, *move.add), self.folds, self.plausible)
        except ValueError as error:
            return dataclasses.replace(extension, reason=str(error)), None
        n = len(base)
        new, names = range(n, len(both)), fit.names[n:]
        x = np.asarray(fit.point.parameters)[n:]
        at_zero = _moved(after.linearized, new, -x)  # null hypothesis: no effect
        of_base = [i for i in range(n) if fit.names[i] not in after.at_bound]
        freedom = after.degrees_of_freedom + len(new)
        score = score_test(at_zero, of_base, new, degrees_of_freedom=freedom, correlation=after.correlation)
        slopes = np.asarray(problem.parameters.slopes(fit.point.parameters))
        tested = bool(move.add) and extension.nested
        return dataclasses.replace(
            extension,
            values=fit.estimates,
            errors=_errors(names, slopes[n:, n:], score.covariance),
            cost=fit.cost,
            p=self._one_sided(score, names, group) if tested else math.nan,
            criterion="Wald test" if tested else "trials left out",
            held_out_cost=after.held_out_cost,
            bound_violations=tuple(after.bound_violations.values()),
        ), after

    def _one_sided(self, score: Score, names: Sequence[str], group: Group) -> float:
        """The p-value, one-sided if the only tested parameter is plausible on one side of its start only."""
        if len(names) != 1 or not np.isfinite(score.p):
            return score.p
        parameters = group.problem.parameters
        start = float(parameters.start[parameters.names.index(names[0])])
        low, high = self.plausible.get(names[0], (-math.inf, math.inf))
        if start not in (low, high):
            return score.p
        inside = score.step[0] > 0 if start == low else score.step[0] < 0
        return score.p / 2 if inside else 1.0 - score.p / 2

    def _decided(self, model: Model, extension: Extension, level: float, worse: Sequence[str]) -> Extension:
        """The extension, accepted or with the first reason against it. `worse`: new implausible values."""
        is_fitted = np.isfinite(extension.cost)
        held_out = f"{extension.held_out_cost:.5g} against {model.held_out_cost:.5g}"
        reasons: tuple[tuple[Any, str], ...] = (
            (extension.reason, extension.reason),
            (worse, f"not plausible: {', '.join(worse)}"),
            (extension.p >= level, "no more than chance"),
            (not is_fitted and extension.bound_violations, "predicted values not plausible, not fitted"),
            (not is_fitted, "promising, not fitted" if extension.nested else "not nested, not fitted"),
            (
                is_fitted and np.isfinite(extension.p) and not extension.cost < model.fit.cost,
                "its fit does not lower the cost",
            ),
            (extension.held_out_cost >= model.held_out_cost, f"does not predict held-out trials better: {held_out}"),
        )
        reason = next((words for applies, words in reasons if applies), "")
        return dataclasses.replace(extension, reason=reason, accepted=not reason)


def _is_hopeless(extension: Extension, model: Model, level: float) -> bool:
    """Whether a score test or the linearized held-out cost already decides against a candidate."""
    if model.at_bound:  # only a fit can take a parameter off its bound
        return False
    is_chance = extension.p >= max(level, HOPELESS_P)
    return is_chance or extension.held_out_cost > HOPELESS_COST * model.held_out_cost


def _order(extension: Extension) -> tuple[bool, float]:
    """Sort key: accepted ones first, then by held-out cost, or by the cost or predicted cost."""
    if extension.accepted and math.isfinite(extension.held_out_cost):
        return False, extension.held_out_cost
    costs = [x for x in (extension.cost, extension.predicted_cost) if not math.isnan(x)]
    return not extension.accepted, costs[0] if costs else math.inf


def _moved(linearized: LinearizedProblem, places: Sequence[int], step: np.ndarray) -> LinearizedProblem:
    """The linearization expanded about another point, which is a `step` away in the columns at these places."""
    data, priors = linearized.data.copy(), linearized.priors.copy()
    for rows in (data, priors):
        rows[..., -1] += rows[..., list(places)] @ step
    return dataclasses.replace(linearized, data=data, priors=priors)


def _errors(names: Sequence[str], slopes: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)) if names else []
    return {name: float(deviation) for name, deviation in zip(names, deviations, strict=True)}


def _undetermined(names: Sequence[str], score: Score) -> str:
    """The parameters that the data do not determine, as text."""
    insensitive, collinear = (", ".join(np.array(names, str)[~ok]) for ok in (score.sensitive, score.distinguishable))
    if insensitive:
        return f"these data do not depend on {insensitive}"
    return f"{collinear} cannot be distinguished from the free parameters" if collinear else ""


HEAD = ("candidate", "estimate", "std. error", "predicted cost", "cost", "p", "criterion", "held-out cost", "decision")


@dataclasses.dataclass(frozen=True, repr=False)
class ForwardSelection:
    """The result of `forward_selection`. Print it for the tables.

    - `before`: the fit that was passed.
    - `rounds`: the extensions that were tried in each round, the accepted one first.
    - `costs`, `held_out_costs`: sums of squares at the start of each round, of the fit and of trials left out in turn.
    - `selected`: names of the candidates in the final model.
    - `removed`: names of the parameters that were removed from the model.
    - `held_out`: which trials were left out together, as text.
    - `alternatives`: other accepted models, the best first.
    - `level`: significance level of the test.
    - `bound_violations`: a sentence for each implausible estimate of `fit`, also for parameters that were free before.
    - `fit`: the fit of the final model. It is `before` if nothing has changed.
    """

    before: Fit
    rounds: tuple[tuple[Extension, ...], ...]
    costs: tuple[float, ...]
    held_out_costs: tuple[float, ...]
    selected: tuple[str, ...]
    removed: tuple[str, ...]
    held_out: str
    alternatives: tuple[Alternative, ...]
    level: float
    bound_violations: tuple[str, ...]
    fit: Fit

    @property
    def best(self) -> Extension | None:
        return self.rounds[0][0] if self.selected or self.removed else None

    @property
    def tables(self) -> Tables:
        """The table of each round, as a heading and rows. The first row is the header."""
        tables: list[tuple[str, Rows]] = []
        for i, extensions in enumerate(self.rounds):
            after = f" after {', '.join(done[0].name for done in self.rounds[:i])}" if i else ""
            held_out = "with one trial, there is no held-out cost"
            if not math.isnan(self.held_out_costs[i]):
                held_out = f"{self.held_out_costs[i]:.5g} of trials left out in turn ({self.held_out})"
            heading = f"Sum of squares{after} {self.costs[i]:.6g}; {held_out}."
            tables.append((heading, [HEAD, *(extension.cells for extension in extensions)]))
        if self.alternatives:
            rows = [("also accepted", "cost", "held-out cost", "compared with the selection")]
            for one in self.alternatives:
                held_out = "" if math.isnan(one.held_out_cost) else f"{one.held_out_cost:.5g}"
                rows.append((", ".join(one.names), f"{one.cost:.5g}", held_out, "predicts as well" * one.is_as_good))
            tables.append(("Alternatives.", rows))
        return tables

    @property
    def conclusion(self) -> str:
        best = [of_round[0] for of_round in self.rounds if of_round and of_round[0].accepted]
        text = f"Nothing is selected: no candidate is accepted at a level of {self.level:g}."
        if best:
            held_out = ""
            if not math.isnan(best[-1].held_out_cost):
                costs = f"{self.held_out_costs[0]:.5g} -> {best[-1].held_out_cost:.5g}"
                held_out = f" (of trials left out, {self.held_out}: {costs})"
            not_nested = {one.name for one in best if not one.nested}
            names = [f"{n} (not nested: by trials left out)" if n in not_nested else n for n in self.selected]
            text = f"Selected: {', '.join(names)}." if names else "Nothing is added."
            text += f" Removed: {', '.join(self.removed)}." if self.removed else ""
            text += f" Sum of squares {self.before.cost:.6g} -> {self.fit.cost:.6g}{held_out}."
        if self.bound_violations:
            text += f" Not plausible: {', '.join(self.bound_violations)}."
        as_good = [" and ".join(one.names) for one in self.alternatives if one.is_as_good]
        return text + (f" These data do not distinguish it from {'; '.join(as_good)}." if as_good else "")

    def __str__(self) -> str:
        tables = "\n\n".join(text_tables([table], (0, len(table[1][0]) - 1)) for table in self.tables)
        return f"{tables}\n\n{self.conclusion}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"{html_tables(self.tables)}<p>{html.escape(self.conclusion)}</p>"


def forward_selection(
    fit: Fit,
    candidates: Candidates,
    *,
    remove: str | Sequence[str] = (),
    exchange: bool = False,
    depth: int = 1,
    beam: int = 1,
    refits: int | None = 3,
    level: float = 0.05,
    plausible: Mapping[str, Any] | None = None,
    folds: int | str | Sequence[Sequence[int]] | None = None,
    progress: bool = False,
) -> ForwardSelection:
    """Select model extensions by forward selection.

    Each candidate is judged by the decrease of the sum of squares, the plausibility of the estimates, and the
    prediction of held-out trials.

        candidates = ["dry_friction", Gain("torque"), Offset("angle"), Candidate("lag", system=Lagging())]
        selection = forward_selection(fit, candidates, folds="speed")
        print(selection)
        selection.fit                                       # the fit with the selected candidates

    All candidates of a system are linearized together at the minimum of the fit, with all free parameters and other
    unknowns eliminated. For each candidate this gives a predicted cost and the p-value of a score test (Rao 1948). The
    candidates with the lowest predicted costs are fitted, together with all free parameters. One compiled program runs
    all these fits.

    A candidate is nested if it does not change the trajectories at its start. A nested candidate is accepted if three
    conditions are met. (1) Its p-value after the fit is below `level`, corrected for the number of candidates
    (Bonferroni). (2) No estimate becomes implausible, neither the candidate's nor one that was free before. (3) Trials
    that are left out in turn are predicted better with it.

    The accepted candidate that predicts best is selected. With `depth` above one, the others are then tested again in
    the extended model, until none is accepted. A candidate that is not nested, such as another system with different
    trajectories, is always fitted. It is accepted by (2) and (3).

    **Arguments:**

    - `fit`: a `Fit` that has converged.
    - `candidates`: a list of names of parameters, `Free`, `Gain`, `Offset`, `Delay`, `LowPass`, `Inertia`, and
        `Candidate`. A `Candidate` combines several of these, or is another system. Each starts where it does not change
        the model.
    - `remove`: names of free parameters that may be removed, or replaced by a candidate, if held-out trials are then
        predicted better. A parameter that is removed keeps its value in the system that was passed to `fit`.
    - `exchange`: whether to also remove and replace selected candidates, and to test pairs if no single candidate is
        accepted. Single candidates and pairs then share `level`. Requires two trials.
    - `depth`: largest number of candidates that are selected.
    - `beam`: number of models that are extended in each round. With 1, only the best model is extended.
    - `refits`: number of nested candidates that are fitted in each round, and of exchanges and of pairs. None for all,
        0 for none. Candidates whose score test or predicted held-out cost is hopeless are not among them.
    - `level`: significance level of the test, between 0 and 1.
    - `plausible`: by name, (lower, upper), or a relative deviation from the start such as 0.2. By default
        `Candidate.plausible`, three standard deviations of a prior, or the range between two bounds without its ends.
        For a parameter that starts on a bound, such as friction at zero, the search covers both sides. Only the side
        inside the bounds is plausible, and the test is one-sided.
    - `folds`: which trials are left out together, as in `cross_validate`. With the name of a label, as in
        `folds="speed"`, trials with the same value of the label are left out together.
    - `progress`: whether to show a progress bar.

    **Returns:** a `ForwardSelection`. Print it for the tables.

    **Raises:** `ValueError` for a fit that has not converged, without a candidate, for two candidates with the same
    name, for a parameter that is already free, and for names that do not exist.
    """
    refuse_other(fit, Fit, "forward_selection", "forward_selection(fit(...), candidates)")
    _check_arguments(fit, depth, beam, refits, level)
    terms = checked_terms(fit, candidates, remove)
    ranges = _plausible_ranges(fit, terms, plausible or {})
    groups, kind = None, ""
    if len(fit.problem.trials) >= 2:
        groups, kind = trial_folds(folds, fit.problem.trials)
    elif folds is not None or exchange:
        raise ValueError(
            "forward_selection: cross-validation (`folds`, `exchange`) needs at least two trials, got one. Cut the "
            "trial with `Trial.between`, or omit `folds` and `exchange`."
        )
    with tqdm(disable=not progress, desc="forward selection", unit=" step") as bar:
        terms = scaled_terms(fit, terms)
        ended, accepted = Search(fit, terms, exchange, depth, refits, level, ranges, groups, bar).run(beam)
    best = min([*ended, *accepted], key=lambda branch: branch.model.rank)
    after = fit
    changes = [extensions for _, extensions in best.rounds if extensions and extensions[0].accepted]
    if changes:  # refit in the specification that a user would write
        problem = fit.problem.with_specification(extended_specification(terms.base, best.model.terms))
        problem = problem.as_fine_as(best.model.fit.problem)
        start = mapped_point(best.model.fit.problem, best.model.fit.point, problem, best.model.fit.names)
        after = solve(problem, LeastSquares(), start=start)
    # A subset of the selected model is an earlier stage of it, not an alternative.
    others = {branch.model.key: branch for branch in accepted if not branch.model.key <= best.model.key}
    others = sorted(others.values(), key=lambda branch: branch.model.rank)
    selected = tuple(c.name for c in best.model.terms if c in terms.candidates)
    return ForwardSelection(
        before=fit,
        rounds=tuple(round.extensions for round in best.rounds),
        costs=tuple(round.model.fit.cost for round in best.rounds),
        held_out_costs=tuple(round.model.held_out_cost for round in best.rounds),
        selected=selected,
        removed=tuple(c.name for c in terms.removable if c not in best.model.terms),
        held_out=kind,
        alternatives=tuple(branch.model.compared_with(best.model) for branch in others),
        level=level,
        bound_violations=tuple({**energy_sources(after), **best.model.bound_violations}.values()),
        fit=after,
    )


def _plausible_ranges(fit: Fit, terms: Terms, plausible: Mapping[str, Any]) -> Ranges:
    """Plausible ranges by name, of all parameters that are free or may be freed."""
    ranges, known, priors = {}, set(fit.names), fit.problem.specification.priors or {}
    for candidate in terms.all:
        if not candidate.items:
            continue
        parameters = parameters_of(candidate.system or fit.problem.system, candidate.items, trials=fit.problem.trials)
        parameters = parameters.with_priors(priors)
        of_fit = {name: pair for name, pair in plausible.items() if name in parameters.names}
        ranges |= plausible_of(parameters, {**candidate.plausible, **of_fit})
        known |= {*parameters.names, *candidate.plausible}
    refuse_unknown(plausible, known, "`plausible` contains unknown names:", "the names are")
    asked = {name: pair for candidate in terms.all for name, pair in candidate.plausible.items()} | {**plausible}
    # Parameters that are already free use the initial guess of the fit, not the value of a candidate's system.
    of_fit = {name: pair for name, pair in asked.items() if name in fit.names}
    return {**ranges, **plausible_of(fit.parameters, of_fit)}


def _check_arguments(fit: Fit, depth: int, beam: int, refits: int | None, level: float) -> None:
    refuse(
        (
            fit.problem.model.errors is not None,
            "forward_selection: the fit has error models, and the search compares sums of squares. Fit without "
            "`errors`, or compare the `bic` of fits with each candidate.",
        ),
        (
            fit.problem.specification.noise is not None,
            "forward_selection: the fit has process noise, which can hide missing physics. Fit without `noise`, or "
            "compare `fit.marginal_likelihood()` of fits with each candidate.",
        ),
    )
    refuse_unless_at_a_minimum(fit.status, "forward_selection")  # a score test is only valid at a minimum
    for name, value, smallest in (
        ("depth", depth, 1),
        ("beam", beam, 1),
        ("refits", 0 if refits is None else refits, 0),
    ):
        whole_number(value, smallest, f"forward_selection: `{name}`")
    check_level(level)
