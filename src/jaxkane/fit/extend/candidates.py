"""Candidate extensions of a model, which are checked, grouped, and combined in one problem; models and moves."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..._common.lookup import as_names, refuse, refuse_unknown
from ..._scalarjit.compat import on_device
from ..._system.system import System
from ..problem.declarations import CalibrationTerm, Declaration, Delay, Free, Item, Items
from ..problem.model import Simulation, Unknowns
from ..problem.parameters import Interval, with_entries
from ..problem.problem import Problem
from ..problem.specification import Names, ProblemSpec, as_items, deviations_by_name, parameters_of
from ..result.diagnostics import Ranges, implausible
from ..result.fit_result import Fit
from ..result.linearized import LinearizedProblem, linearized_problem
from ..result.statistics import predicts_as_well, serial_correlation
from ..solve.optimizers import usable

Bounds = tuple[float | None, float | None]


@dataclasses.dataclass(frozen=True)
class Candidate:
    """An extension of a model, to be tested by `forward_selection`.

        Candidate("motor lag", system=Lagging.from_parameters(values), free="lag", unknown="motor_torque")
        Candidate("the roll sensor", free=[Offset("roll"), Gain("roll_rate")])

    **Arguments:**

    - `name`: name in tables.
    - `free`: parameters, as in `fit`: names, `Free`, `Gain`, `Offset`, `Delay`, `LowPass`, `Inertia`. They start at the
        system's values, which do not change the model.
    - `system`: another system, with the free parameters of the fit under the same names. By default the system of the
        fit. If its trajectories differ before a parameter is freed, the candidate is tested by a fit only. Otherwise it
        is linearized first.
    - `unknown`: additional unknown initial states, such as those of additional states of `system`.
    - `plausible`: by name of a parameter, its plausible range (lower, upper). None for an open end.
    """

    name: str
    free: Items = ()
    system: System | None = None
    unknown: Names = ()
    plausible: Mapping[str, Bounds] = dataclasses.field(default_factory=dict, hash=False)

    @property
    def items(self) -> tuple[Declaration, ...]:
        return tuple(as_items(self.free))

    @property
    def has_parameters_only(self) -> bool:
        return self.system is None and not self.unknown

    def names(self, system: System) -> tuple[str, ...]:
        return _names_of(self.system or system, *self.items)


Candidates = Item | Candidate | Sequence[Item | Candidate]


@dataclasses.dataclass(frozen=True)
class Terms:
    """The terms that a search may add and remove.

    - `base`: the specification of the fit without the removable terms.
    - `removable`: terms that may be removed, as candidates.
    - `candidates`: terms that may be added.
    """

    base: ProblemSpec
    removable: tuple[Candidate, ...]
    candidates: tuple[Candidate, ...]

    @property
    def all(self) -> tuple[Candidate, ...]:
        return (*self.removable, *self.candidates)


def checked_terms(fit: Fit, candidates: Candidates, remove: str | Sequence[str] = ()) -> Terms:
    """The terms of a search.

    **Raises:** `ValueError` without a candidate, for a candidate that frees nothing or a parameter that is already
    free, for repeated names, for two candidates that free the same parameter differently, and for names in `remove`
    that are not free.
    """
    candidates = tuple(_candidate(fit, item) for item in as_items(candidates, (Declaration, Candidate)))
    remove = as_names(remove, "remove")
    refuse_unknown(remove, fit.names, "`remove` contains unknown names:", "the fit has")
    base, removable, system = [], [], fit.problem.system
    for item in fit.problem.specification.free:
        names = () if getattr(item, "each", None) else _names_of(system, item)
        if not set(names) & set(remove):
            base.append(item)
            continue
        # As a candidate it starts at the value of the system, and the search covers both sides of it.
        if isinstance(item, (Free, CalibrationTerm)):
            item = dataclasses.replace(item, start=type(item).start if isinstance(item, CalibrationTerm) else None)
        free, bounds = _unbounded(system, item, always=True)
        removable.append(Candidate(", ".join(names), free=(free,), plausible=bounds))
    names = [candidate.name for candidate in (*removable, *candidates)]
    twice = sorted({name for name in names if names.count(name) > 1} - {c.name for c in removable})
    refuse(
        (
            not names,
            "forward_selection: `candidates` is empty. Pass names of parameters, `Gain`, `Offset`, `Delay` or "
            "`Candidate`.",
        ),
        (
            twice,
            f"Two candidates have the name {', '.join(twice)}. Give each candidate its own name: Candidate(name, ...).",
        ),
    )
    known = deviations_by_name(fit.problem.specification.unknown)
    for candidate in candidates:
        names = candidate.names(fit.problem.system)
        free = ", ".join(name for name in names if name in fit.names)
        starts = ", ".join(name for name in deviations_by_name(candidate.unknown) if name in known)
        refuse(
            (free, f"{candidate.name}: the fit already estimates {free}. Omit this candidate."),
            (
                starts,
                f"{candidate.name}: the initial values of {starts} are already `unknown` in the fit. Omit them from "
                "the candidate.",
            ),
            (
                not names and candidate.has_parameters_only,
                f"{candidate.name}: the candidate adds no parameter and no unknown initial value. Pass `free` or "
                "`unknown`.",
            ),
        )
    specification = dataclasses.replace(fit.problem.specification, free=tuple(base) or ())
    for group in compatible_groups(fit, candidates):
        extended_specification(specification, group)  # rejects inconsistent candidates
    return Terms(specification, tuple(removable), candidates)


def _candidate(fit: Fit, item: Declaration | Candidate) -> Candidate:
    """The checked candidate. The bounds of a parameter that starts on one of them become its plausible range, as for
    friction at zero.
    """
    if not isinstance(item, Candidate):
        item = Candidate(str(item), free=(item,))
        if not any(getattr(one, "each", None) for one in item.items):
            names = _names_of(fit.problem.system, _unbounded(fit.problem.system, item.items[0])[0])
            item = dataclasses.replace(item, name=", ".join(names))
    system = item.system or fit.problem.system
    if not isinstance(system, System):
        raise TypeError(f"{item.name}: `system` must be a jaxkane.System, got {type(system).__name__}.")
    for one in item.items:
        if getattr(one, "each", None):
            raise ValueError(
                f"{item.name}: a candidate with `each` is not supported. Free it in a second fit, and compare the "
                "`bic` of both."
            )
    unbounded = [_unbounded(system, one) for one in item.items]
    free = tuple(one for one, _ in unbounded)
    bounds = {name: pair for _, of_one in unbounded for name, pair in of_one.items()}
    known = [name for one in free for name in _names_of(system, one)]
    refuse_unknown(
        item.plausible, (*known, *fit.names), f"{item.name}: `plausible` contains unknown names:", "the names are"
    )
    return dataclasses.replace(item, free=free, plausible={**bounds, **item.plausible})


def _unbounded(system: System, item: Declaration, always: bool = False) -> tuple[Declaration, Mapping[str, Bounds]]:
    """The item without bounds, and the bounds, if it starts on one of them (or `always`). Otherwise the same item."""
    if not isinstance(item, (Free, CalibrationTerm)):
        return item, {}
    free = parameters_of(system, item)
    ends = [(float(one.lower), float(one.upper)) for one in free.bijections if isinstance(one, Interval)]
    if not always and not any(start in pair for start, pair in zip(np.asarray(free.start), ends, strict=True)):
        return item, {}
    finite = {name: pair for name, pair in zip(free.names, ends, strict=True) if np.isfinite(pair).any()}
    return dataclasses.replace(item, bounds=(None, None)), finite


def _names_of(system: System, *items: Declaration) -> tuple[str, ...]:
    return parameters_of(system, [item for item in items if not item.is_eliminated]).names


def compatible_groups(fit: Fit, candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Groups of candidates that can be combined in one problem: the same system and the same unknown initial states.

    A delay of an input under a zero-order hold has a group of its own. The delay replaces discontinuities of the input
    by ramps of two steps, so the trajectories differ slightly even for a zero delay.
    """
    groups: list[tuple[Any, list[Candidate]]] = []
    for candidate in candidates:
        delayed = {name for item in candidate.items if isinstance(item, Delay) for name in item.channels}
        delayed &= {*fit.problem.model.zero_order_hold}
        kind = candidate.system or fit.problem.system, deviations_by_name(candidate.unknown), delayed
        group = next(
            (group for other, group in groups if other[1:] == kind[1:] and eqx.tree_equal(other[0], kind[0])), None
        )
        if group is None:
            groups.append((kind, group := []))
        group.append(candidate)
    return [group for _, group in groups]


def extended_specification(base: ProblemSpec, candidates: Sequence[Candidate]) -> ProblemSpec:
    """The specification with these candidates added.

    **Raises:** `ValueError` if two of them free the same parameter differently, or have incompatible systems.
    """
    system, free = base.system, [*base.free]
    for candidate in candidates:
        other = candidate.system
        if other is None or bool(eqx.tree_equal(other, system)):
            continue
        if system is not base.system and not isinstance(other, type(system)):  # system of a previous candidate
            if isinstance(system, type(other)):
                continue  # the previous system extends this one
            raise ValueError(
                f"{candidate.name}: its `system`, {type(other).__name__}, is not a subclass of "
                f"{type(system).__name__}, the `system` of another candidate. Derive one class from the other."
            )
        system = other
    unknown, items = deviations_by_name(base.unknown), {}
    for candidate in candidates:
        unknown |= deviations_by_name(candidate.unknown)
        for item in candidate.items:
            names = _names_of(system, item)
            same = [other for name, other in items.items() if name in names]
            if any(other is not item and not bool(other == item) for other in same):
                raise ValueError(
                    f"Two candidates free {', '.join(names)} with different options. Use the same declaration in both."
                )
            if not same:
                free.append(item)
                items |= dict.fromkeys(names, item)
    return dataclasses.replace(base, system=system, free=free, unknown=unknown)


def augmented_problem(
    base: ProblemSpec, at: tuple[Problem, Unknowns, Sequence[str]], candidates: Sequence[Candidate]
) -> tuple[Problem, Unknowns]:
    """The problem in which all these candidates are free, and a point of another problem as a point of it.

    **Arguments:**

    - `at`: the other problem, its point, and the names of the parameters whose values are used.

    **Raises:** `ValueError` if a system lacks a parameter that is free in the fit, or if two candidates free the same
    parameter differently.
    """
    source, point, names = at
    specification = extended_specification(base, candidates)
    if source.chooses_steps:  # use the steps that the fit has chosen
        step = float(np.median(np.asarray(source.windows.step)))
        simulation = dataclasses.replace(specification.simulation or Simulation(), step=step)
        specification = dataclasses.replace(specification, simulation=simulation)
    problem = source.with_specification(specification)
    return problem, mapped_point(source, point, problem, names)


def scaled_terms(fit: Fit, terms: Terms) -> Terms:
    """The terms with a scale, derived from the units of the data, for each parameter that starts at zero.

    The scale is the value that changes the residuals by as much as their size. The default scale of 1 depends on the
    units: with masses of 1e-12 kg, the data seem to be insensitive to all other parameters.
    """
    scaled: dict[str, Candidate] = {}
    for members in compatible_groups(fit, terms.candidates) or [[]]:
        both = (*terms.removable, *members)
        with contextlib.suppress(ValueError):  # the search states the reason
            problem, point = augmented_problem(terms.base, (fit.problem, fit.point, fit.names), both)
            at = problem.linearize(point)
            if at is None or not usable(at):
                continue
            names, starts = problem.parameters.names, np.asarray(problem.parameters.start)
            norms = at.blocks.column_norms / max(fit.cost, 1e-300) ** 0.5
            for candidate in both:
                free = []
                for item in candidate.items:
                    places = [names.index(name) for name in _names_of(problem.system, item)]
                    norm = float(np.linalg.norm(norms[places]))
                    unscaled = isinstance(item, (Free, CalibrationTerm)) and item.scale is None
                    at_zero = unscaled and norm > 0 and not starts[places].any()
                    free.append(dataclasses.replace(item, scale=1.0 / norm) if at_zero else item)
                scaled[candidate.name] = dataclasses.replace(candidate, free=tuple(free))
    removable, candidates = (tuple(scaled.get(c.name, c) for c in part) for part in (terms.removable, terms.candidates))
    return Terms(terms.base, removable, candidates)


def mapped_point(source: Problem, at: Unknowns, problem: Problem, names: Sequence[str]) -> Unknowns:
    """A point of one problem as a point of another with more unknowns. The additional unknowns have their initial
    guess.
    """
    values = dict(zip(source.parameters.names, np.asarray(source.parameters.values(at.parameters)), strict=True))
    point = problem.at({name: float(values[name]) for name in names}, problem.start)
    new, old = problem.model.nuisance, source.model.nuisance
    z = point.window_starts
    if old.window_names:
        places = np.array([new.window_names.index(name) for name in old.window_names])
        z = on_device(with_entries(np.asarray(z).T, places, np.asarray(at.window_starts).T).T)
    return Unknowns(point.parameters, at.trial_unknowns, z)


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
    - `is_as_good`: whether it predicts as well as the selected model (`predicts_as_well`).
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
        cls, fit: Fit, terms: Sequence[Candidate], folds: Sequence[Sequence[int]] | None, plausible: Ranges
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
        violations = implausible(plausible, fit.estimates)
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
        a, b = best.held_out, self.held_out
        is_as_good = a is not None and b is not None and predicts_as_well(a, b)
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
