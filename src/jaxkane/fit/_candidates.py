"""Candidate extensions of a model: checked, grouped, and together in one augmented problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._common.lookup import refuse_unknown
from .._scalarjit.compat import on_device
from .._system.system import System
from ._bijections import Interval
from ._declarations import CalibrationTerm, Delay, Free
from ._model import Simulation, Unknowns
from ._parameters import as_items, parameters_of, with_entries
from ._problem import Names, Problem, ProblemSpec, deviations_by_name
from ._result import Fit

Bounds = tuple[float | None, float | None]

OF_TRIALS = ("sensor_bias", "sensor_gain", "input_bias", "input_gain", "input_delay")


@dataclasses.dataclass(frozen=True)
class Candidate:
    """An extension of a model, to be tested by `forward_selection`.

        Candidate("motor lag", system=Lagging.from_parameters(values), free="lag", unknown="motor_torque")
        Candidate("the roll sensor", free=[Offset("roll"), Gain("roll_rate")])
        Candidate("a zero of its own in every ride", sensor_bias="roll")

    **Arguments:**

    - `name`: for tables. `free`: parameters, as in `fit`: names, `Free`, `Gain`, `Offset`, `Delay`, `LowPass`,
        `Inertia`. With the system's values of them nothing changes.
    - `system`: another one, with the free parameters of the fit under the same names; by default the fit's. Where its
        motion is the same as long as nothing else is free, it is tested by linearization, else by a fit.
    - `unknown`: additional unknown starts, as those of its states.
    - `sensor_bias`, `sensor_gain`, `input_bias`, `input_gain`, `input_delay`: what every trial has its own of, as in
        `fit`.
    - `plausible`: by name of a parameter, its plausible range (lower, upper); None for an open side.
    """

    name: str
    free: Any = ()
    system: System | None = None
    unknown: Names = ()
    sensor_bias: Names = ()
    sensor_gain: Names = ()
    input_bias: Names = ()
    input_gain: Names = ()
    input_delay: Names = ()
    plausible: Mapping[str, Bounds] = dataclasses.field(default_factory=dict, hash=False)

    @property
    def items(self) -> tuple[Any, ...]:
        return tuple(as_items(self.free))

    @property
    def of_trials(self) -> dict[str, dict[str, float | None]]:
        """The unknowns of the trials' own, by the argument of `fit`."""
        return {key: deviations_by_name(getattr(self, key)) for key in OF_TRIALS}


def checked_candidates(fit: Fit, candidates: Any) -> tuple[Candidate, ...]:
    """**Raises:** `ValueError` for none, for one that frees nothing or what is free already, for names that repeat, and
    two that free the same differently.
    """
    items = (candidates,) if isinstance(candidates, Candidate) else as_items(candidates)
    candidates = tuple(_candidate(fit, item) for item in items)
    if not candidates:
        raise ValueError("There is no candidate: name parameters, `Gain`s, `Offset`s, `Delay`s or `Candidate`s.")
    names = [candidate.name for candidate in candidates]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"Two candidates are called {', '.join(twice)}: give each a name, Candidate(name, ...).")
    for candidate in candidates:
        _refuse_nothing_new(fit, candidate)
    for group in compatible_groups(fit, candidates):
        extended_specification(fit, group)  # refuses two that free the same differently
    return candidates


def _candidate(fit: Fit, item: Any) -> Candidate:
    """A parameter alone, with its bounds as its plausible range where it starts on one of them, as friction at zero."""
    if not isinstance(item, Candidate):
        names = _names_of(fit.problem.system, _without_bounds_at_start(fit.problem.system, item)[0])
        item = Candidate(", ".join(names), free=(item,))
    system = item.system or fit.problem.system
    if not isinstance(system, System):
        raise TypeError(f"{item.name}: `system` is a jaxkane.System, got {type(system).__name__}.")
    unbounded = [_without_bounds_at_start(system, one) for one in item.items]
    free = tuple(one for one, _ in unbounded)
    bounds = {name: pair for _, of_one in unbounded for name, pair in of_one.items()}
    known = [name for one in free for name in _names_of(system, one)]
    refuse_unknown(item.plausible, (*known, *fit.names), f"{item.name}: `plausible` names")
    return dataclasses.replace(item, free=free, plausible={**bounds, **item.plausible})


def _without_bounds_at_start(system: System, item: Any) -> tuple[Any, dict[str, Bounds]]:
    """The same without bounds, and these, where it starts on one of them; else as it is."""
    named = Free(item) if isinstance(item, str) or callable(item) else item
    if not isinstance(named, (Free, CalibrationTerm)):
        return item, {}
    free = parameters_of(system, named)
    ends = [(float(one.lower), float(one.upper)) for one in free.bijections if isinstance(one, Interval)]
    if not any(start in pair for start, pair in zip(np.asarray(free.start), ends, strict=True)):
        return item, {}
    return dataclasses.replace(named, bounds=(None, None)), dict(zip(free.names, ends, strict=True))


def _names_of(system: System, *items: Any) -> tuple[str, ...]:
    return parameters_of(system, items).names if items else ()


def _refuse_nothing_new(fit: Fit, candidate: Candidate) -> None:
    names = _names_of(candidate.system or fit.problem.system, *candidate.items)
    free = [name for name in names if name in fit.names]
    if free:
        raise ValueError(f"{candidate.name}: {', '.join(free)} is free in the fit already.")
    specification, of_trials = fit.problem.specification, candidate.of_trials
    for key in OF_TRIALS:
        both = [name for name in of_trials[key] if name in deviations_by_name(getattr(specification, key))]
        if both:
            raise ValueError(f"{candidate.name}: every trial has its own {key} of {', '.join(both)} already.")
    known = deviations_by_name(specification.unknown)
    starts = [name for name in deviations_by_name(candidate.unknown) if name in known]
    if starts:
        raise ValueError(f"{candidate.name}: the start of {', '.join(starts)} is unknown already.")
    if not names and not any(of_trials.values()) and not candidate.unknown and candidate.system is None:
        raise ValueError(f"{candidate.name}: nothing is freed, and nothing else is unknown.")


def compatible_groups(fit: Fit, candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Candidates that one problem can hold: those of the same system, with the same unknown starts.

    A delay of an input under a zero-order hold is in a group of its own: the jumps of the input are then ramps of two
    steps, by which the motion differs a little before anything is delayed.
    """
    groups: list[list[Candidate]] = []
    for candidate in candidates:
        group = next((group for group in groups if _are_compatible(fit, group[0], candidate)), None)
        if group is None:
            groups.append([candidate])
        else:
            group.append(candidate)
    return groups


def _are_compatible(fit: Fit, a: Candidate, b: Candidate) -> bool:
    same = deviations_by_name(a.unknown) == deviations_by_name(b.unknown) and _delayed(fit, a) == _delayed(fit, b)
    return same and bool(eqx.tree_equal(*(c.system or fit.problem.system for c in (a, b))))


def _delayed(fit: Fit, candidate: Candidate) -> set[str]:
    """Inputs under a zero-order hold that a candidate delays."""
    delayed = {item.what for item in candidate.items if isinstance(item, Delay)}
    return (delayed | {*deviations_by_name(candidate.input_delay)}) & {*fit.problem.model.zero_order_hold}


def extended_specification(fit: Fit, candidates: Sequence[Candidate]) -> ProblemSpec:
    """The specification of the fit, with these candidates in it.

    **Raises:** `ValueError` where two of them free the same differently, or are of systems that exclude each other.
    """
    specification, system = fit.problem.specification, fit.problem.system
    for candidate in candidates:
        other = candidate.system
        if other is None or bool(eqx.tree_equal(other, system)):
            continue
        if system is not fit.problem.system and not isinstance(other, type(system)):  # that of a candidate before
            if isinstance(system, type(other)):
                continue  # that one has all of this one
            raise ValueError(f"{candidate.name}: {type(other).__name__} is no {type(system).__name__}.")
        system = other
    items: list[tuple[Any, tuple[str, ...]]] = []
    for item in (item for candidate in candidates for item in candidate.items):
        names = _names_of(system, item)
        same = [other for other, other_names in items if set(other_names) & set(names)]
        if any(other is not item and not bool(other == item) for other in same):
            raise ValueError(f"Two candidates free {', '.join(names)} in different ways.")
        if not same:
            items.append((item, names))
    changes: dict[str, Any] = {"free": [*specification.free, *(item for item, _ in items)]}
    for key in ("unknown", *OF_TRIALS):
        changes[key] = deviations_by_name(getattr(specification, key))
        for candidate in candidates:
            changes[key] |= deviations_by_name(getattr(candidate, key))
    return dataclasses.replace(specification, system=system, **changes)


@dataclasses.dataclass(frozen=True)
class AugmentedProblem:
    """One problem in which all candidates of a group are free, at the minimum of the restricted model.

    - `base_x`, `base_b`: which parameters and unknowns of trials are free in the restricted model. `own_x`, `own_b`: by
        candidate, which are its own.
    """

    problem: Problem
    point: Unknowns
    base_x: tuple[int, ...]
    base_b: tuple[int, ...]
    own_x: dict[str, tuple[int, ...]]
    own_b: dict[str, tuple[int, ...]]

    @classmethod
    def of(
        cls,
        fit: Fit,
        minimum: tuple[Problem, Unknowns],
        candidates: Sequence[Candidate],
        selected: Sequence[Candidate],
        order: Sequence[str],
    ) -> AugmentedProblem:
        """The fit's problem with these candidates; those `selected` before are free at the `minimum`.

        All are in the `order` of their names, whichever are selected, so that each round runs the same compiled
        program.

        **Raises:** `ValueError` where a system lacks what is free in the fit, or two free the same differently.
        """
        both = sorted((*selected, *candidates), key=lambda c: order.index(c.name))
        specification = extended_specification(fit, both)
        if fit.problem.chooses_steps:  # the fit has chosen: nothing is tried again
            step = float(np.median(np.asarray(fit.problem.windows.step)))
            simulation = dataclasses.replace(specification.simulation or Simulation(), step=step)
            specification = dataclasses.replace(specification, simulation=simulation)
        problem = fit.problem.with_specification(specification)
        names, of_trial = problem.parameters.names, problem.model.nuisance.trial
        own_x = {c.name: tuple(map(names.index, _names_of(specification.system, *c.items))) for c in both}
        own_b = {}
        for c in both:  # as `Nuisance.trial` has them
            keys = [(*key.split("_"), name) for key, by_name in c.of_trials.items() for name in by_name]
            own_b[c.name] = tuple(of_trial.index((f"{kind} of {where}", name)) for where, kind, name in keys)
        base_x = [names.index(name) for name in fit.names] + [i for c in selected for i in own_x[c.name]]
        base_b = list(map(of_trial.index, fit.problem.model.nuisance.trial))
        base_b += [i for c in selected for i in own_b[c.name]]
        base_x, base_b = tuple(dict.fromkeys(base_x)), tuple(dict.fromkeys(base_b))
        point = mapped_point(*minimum, problem, [names[i] for i in base_x])
        return cls(problem, point, base_x, base_b, own_x, own_b)

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.parameters.names

    def places(self, candidate: Candidate) -> tuple[list[int], list[int]]:
        """Which parameters, and which unknowns of trials, are the restricted model's or this candidate's."""
        x, b = (*self.base_x, *self.own_x[candidate.name]), (*self.base_b, *self.own_b[candidate.name])
        return list(dict.fromkeys(x)), list(dict.fromkeys(b))

    def with_only(self, candidate: Candidate, fixed: np.ndarray) -> tuple[Problem, Unknowns]:
        """The problem in which of all candidates only this one is free, and the same point of it.

        The parameters of all other candidates are left out; their unknowns of trials are fixed by priors of the
        deviations `fixed`. Any candidates with as many free parameters run the same compiled program.
        """
        (free_x, free_b), model = self.places(candidate), self.problem.model
        subset = model.parameters.subset(free_x, self.point.x)
        deviation = np.array(fixed)
        deviation[free_b] = np.asarray(model.nuisance.trial_deviation)[free_b]
        where = lambda m: (m.parameters, m.nuisance.trial_deviation)  # noqa: E731
        model = eqx.tree_at(where, model, (subset, jnp.asarray(deviation, self.point.x.dtype)))
        point = eqx.tree_at(lambda p: p.x, self.point, self.point.x[subset.places])
        return dataclasses.replace(self.problem, model=model), point


def mapped_point(source: Problem, at: Unknowns, problem: Problem, names: Sequence[str]) -> Unknowns:
    """A point of one problem as one of another that has more unknowns; the new ones are where they start."""
    point, old, new = problem.start, source.model.nuisance, problem.model.nuisance
    source_names, targets = source.parameters.names, problem.parameters.names
    if bool(eqx.tree_equal(problem.system, source.system)):
        to, of = (np.array([one.index(name) for name in names], dtype=int) for one in (targets, source_names))
        point = eqx.tree_at(lambda p: p.x, point, on_device(with_entries(point.x, to, np.asarray(at.x)[of])))
    else:
        values = np.asarray(source.parameters.values(at.x))
        point = problem.at({name: float(values[source_names.index(name)]) for name in names}, point)
    b = [(new.trial.index(pair), i) for i, pair in enumerate(old.trial) if pair in new.trial]
    z = [(new.start.index(name), i) for i, name in enumerate(old.start)]
    for pairs, where in ((b, lambda p: p.b), (z, lambda p: p.z)):
        if pairs:
            to, of = (np.array(places, dtype=int) for places in zip(*pairs, strict=True))
            columns = with_entries(np.asarray(where(point)).T, to, np.asarray(where(at)).T[of])
            point = eqx.tree_at(where, point, on_device(columns.T))
    return point
