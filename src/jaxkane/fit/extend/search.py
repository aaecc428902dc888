"""The search of `forward_selection`: candidates are linearized, tested, fitted and compared in rounds."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..._scalarjit.compat import on_device
from ..problem.model import Unknowns
from ..problem.problem import Problem
from ..result.diagnostics import AT_A_MINIMUM, Plausible
from ..result.fit_result import Fit
from ..result.linearized import LinearizedProblem, Score, linearized_problem, score_test
from ..result.statistics import serial_correlation
from ..solve.fit import search, uninterrupted
from ..solve.local_unknowns import usable
from ..solve.optimizers import LeastSquares
from .candidates import (
    Candidate,
    Terms,
    augmented_problem,
    compatible_groups,
)

NESTED = 1e-6
"""Largest relative difference of the sum of squares at the start of a nested candidate."""


@dataclasses.dataclass(frozen=True)
class Extension:
    """A change of the model and its tests.

    - `name`: name of the candidate; "a and b" for a pair, "a instead of b" for an exchange, "without b" for a removal.
    - `parameters`: names of the parameters that it frees.
    - `values`: by name, the values of these and of all other free parameters. From its fit if `cost` is not NaN,
        otherwise from the linearization.
    - `errors`: by name, standard errors of `parameters`, from the same source.
    - `nested`: whether the trajectories are the same as those of the model before a parameter is freed.
    - `predicted_cost`: sum of squares predicted by the linearization, if it is nested.
    - `cost`: sum of squares of its fit, NaN if it was not fitted.
    - `p`: p-value of the test of the added parameters. NaN if none is added, or if it is not nested. One-sided for a
        parameter whose plausible range starts where the parameter has no effect.
    - `criterion`: "score test" before a fit, "Wald test" after it, or "trials left out" alone.
    - `held_out_cost`: sum of squares of trials that are left out in turn.
    - `bound_violations`: a sentence for each implausible value of a free parameter.
    - `reason`: why it is not accepted, or "".
    - `accepted`: whether it is accepted.
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
        known = [name for name in self.parameters if not math.isnan(self.errors[name])]
        estimates = ", ".join(f"{self.values[name]:.4g}" for name in known)
        errors = ", ".join(f"{self.errors[name]:.2g}" for name in known)
        numbers = (self.predicted_cost, ".5g"), (self.cost, ".5g"), (self.p, ".2g"), (self.held_out_cost, ".5g")
        predicted, cost, p, held_out = ("" if math.isnan(x) else f"{x:{form}}" for x, form in numbers)
        decision = self.reason or "accepted"
        return self.name, estimates, errors, predicted, cost, p, self.criterion, held_out, decision


@dataclasses.dataclass(frozen=True)
class Alternative:
    """Another model that was accepted.

    - `names`: names of its candidates.
    - `cost`: sum of squares of its fit.
    - `held_out_cost`: sum of squares of trials that are left out in turn.
    - `is_as_good`: whether it predicts as well as the selected model, within two standard errors of the differences by
        fold.
    """

    names: tuple[str, ...]
    cost: float
    held_out_cost: float
    is_as_good: bool


@dataclasses.dataclass(frozen=True)
class Model:
    """A fitted model of the search.

    - `terms`: its candidates.
    - `fit`: its fit.
    - `correlation`: the largest serial correlation of the residuals of a channel, because a candidate may act on only
        that channel.
    - `linearized`: linearization at the minimum, with one column per free parameter.
    - `held_out` (K,): linearized sums of squares of the folds. None without folds.
    - `at_bound`: names of parameters that rest at a bound. The linearization would move them beyond it, so they are
        fixed there.
    - `bound_violations`: by name, implausible estimates.
    """

    terms: tuple[Candidate, ...]
    fit: Fit
    correlation: float
    linearized: LinearizedProblem
    held_out: np.ndarray | None
    at_bound: tuple[str, ...]
    bound_violations: Mapping[str, str]

    @classmethod
    def of(
        cls, fit: Fit, terms: Sequence[Candidate], folds: Sequence[Sequence[int]] | None, plausible: Plausible
    ) -> Model:
        """The model of a fit.

        **Raises:** `ValueError` if the residuals do not have finite derivatives at the minimum.
        """
        if not usable(fit.linearization):
            raise ValueError("the residuals have no finite derivatives at its minimum")
        linearized, at_bound = linearized_problem(fit.linearization), fit.identifiability.at_bound
        free = [i for i, name in enumerate(fit.names) if name not in at_bound]
        held_out = None if folds is None else linearized.costs_left_out(free, folds)
        correlation = max(serial_correlation(fit.residuals).values())
        violations = plausible.bound_violations(fit.estimates)
        return cls(tuple(terms), fit, correlation, linearized, held_out, at_bound, violations)

    @property
    def key(self) -> frozenset[str]:
        return frozenset(c.name for c in self.terms)

    @property
    def degrees_of_freedom(self) -> int:
        residuals, unknowns = self.fit.problem.size
        return residuals - unknowns

    @property
    def held_out_cost(self) -> float:
        return math.nan if self.held_out is None else float(np.sum(self.held_out))

    @property
    def rank(self) -> float:
        """The cost by which models are ranked: that of held-out trials, with one trial the sum of squares."""
        return self.fit.cost if self.held_out is None else self.held_out_cost

    def compared_with(self, best: Model) -> Alternative:
        is_as_good = False
        if self.held_out is not None and best.held_out is not None:
            difference = self.held_out - best.held_out
            error = np.std(difference, ddof=1) * math.sqrt(len(difference))
            rounding = 1e-9 * best.held_out_cost  # equivalent models differ only by rounding errors
            is_as_good = bool(difference.sum() <= 2.0 * error + rounding)
        return Alternative(tuple(c.name for c in self.terms), self.fit.cost, self.held_out_cost, is_as_good)


class Round(NamedTuple):
    model: Model
    extensions: tuple[Extension, ...]


class Branch(NamedTuple):
    """A model, and the rounds of the search that led to it."""

    model: Model
    rounds: tuple[Round, ...]


class Move(NamedTuple):
    """A change of a model: candidates that are added, and candidates that are dropped."""

    add: tuple[Candidate, ...]
    drop: tuple[Candidate, ...] = ()

    @property
    def name(self) -> str:
        added, dropped = (" and ".join(c.name for c in part) for part in self)
        if not self.add:
            return f"without {dropped}"
        return f"{added} instead of {dropped}" if self.drop else added


class Group(NamedTuple):
    """Candidates of one system together with the selected ones, in one problem that is linearized at the minimum of the
    model.

    - `problem`, `point`: the augmented problem and the minimum of the model in it.
    - `cost`: sum of squares at `point`.
    - `linearized`: the linearization at `point`.
    - `base`: places of the parameters of the model without its terms.
    - `own`: places of the parameters, by term.
    - `at_bound`: places of the parameters of the model that rest at a bound.
    - `nested`: whether the trajectories at `point` are those of the model.
    """

    problem: Problem
    point: Unknowns
    cost: float
    linearized: LinearizedProblem
    base: list[int]
    own: Mapping[str, list[int]]
    at_bound: list[int]
    nested: bool

    def places(self, terms: Sequence[Candidate]) -> list[int]:
        return list(dict.fromkeys([*self.base, *(i for c in terms for i in self.own[c.name])]))

    def places_of(self, terms: Sequence[Candidate], move: Move) -> tuple[list[int], list[int], list[int]]:
        """Places of the parameters that remain free, of these and the added ones, and of the dropped ones."""
        kept = [c for c in terms if c not in move.drop]
        base, both = self.places(kept), self.places([*kept, *move.add])
        return base, both, [i for i in self.places(terms) if i not in base]

    def neutral(self, places: Sequence[int]) -> np.ndarray:
        """Unconstrained parameters (p,). Those at these places have the value at which they have no effect."""
        x = np.array(self.point.parameters)
        x[list(places)] = 0.0
        return x


@dataclasses.dataclass(frozen=True)
class Search:
    fit: Fit
    terms: Terms
    exchange: bool
    depth: int
    refits: int | None
    level: float
    plausible: Plausible
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
                (item for item in fitted if item[2].nested),
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
            bound_violations=tuple(self.plausible.bound_violations(extension.values).values()),
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
        start = eqx.tree_at(lambda p: p.parameters, group.point, group.point.parameters[parameters.places])
        try:
            fit = uninterrupted(search(problem, LeastSquares(), start=start))
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
        low, high = self.plausible.ranges.get(names[0], (-math.inf, math.inf))
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
