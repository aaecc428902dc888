"""Extensions of a model that are to be tried: checked, grouped, and as one augmented problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._common.lookup import refuse_unknown
from .._system.system import System
from ._bijections import Interval
from ._covariance import parameter_values
from ._declarations import CalibrationTerm, Delay, Free
from ._model import Simulation, Unknowns
from ._parameters import ParameterSubset, as_items, parameters_of
from ._problem import Names, Problem, ProblemSpec, deviations_by_name
from ._result import Fit

Bounds = tuple[float | None, float | None]

OF_TRIALS = ("sensor_bias", "sensor_gain", "input_bias", "input_gain", "input_delay")


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Something that a model may lack, to be tried by `forward_selection`.

        Candidate("motor lag", system=Lagging.from_parameters(values), free="lag", unknown="motor_torque")
        Candidate("the roll sensor", free=[Offset("roll"), Gain("roll_rate")])
        Candidate("a zero of its own in every ride", sensor_bias="roll")

    **Arguments:**

    - `name`: for tables. `free`: what is freed, as in `fit`: names, `Free`, `Gain`, `Offset`, `Delay`, `Inertia`. Where
        it stands in the system is where it is neutral.
    - `system`: another one, that has the parameters which are free in the fit under the same names; by default the
        fit's. Where its motion is the same as long as nothing more is freed, one linearization says what it promises;
        where it is not, it is fitted.
    - `unknown`: starts that are to be found besides, as those of its states.
    - `sensor_bias`, `sensor_gain`, `input_bias`, `input_gain`, `input_delay`: what every trial has its own of, as in
        `fit`.
    - `plausible`: by name of a parameter, (lower, upper), beyond which it is not believed; None for an open side.
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
        """What every trial has its own of, by the argument of `fit`."""
        return {key: deviations_by_name(getattr(self, key)) for key in OF_TRIALS}


def candidates_of(fit: Fit, given: Any) -> tuple[Candidate, ...]:
    """What was given, as candidates.

    **Raises:** `ValueError` for none, for one that frees nothing or what is free already, for names that repeat, and
    two that free the same differently.
    """
    given = (given,) if isinstance(given, Candidate) else as_items(given)
    found = tuple(_candidate(fit, each) for each in given)
    if not found:
        raise ValueError("There is no candidate: name parameters, `Gain`s, `Offset`s, `Delay`s or `Candidate`s.")
    names = [candidate.name for candidate in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"Two candidates are called {', '.join(twice)}: give each a name, Candidate(name, ...).")
    for candidate in found:
        _refuse_nothing_new(fit, candidate)
    for group in groups_of(fit, found):
        posed_with(fit, group)  # refuses two that free the same differently
    return found


def _candidate(fit: Fit, each: Any) -> Candidate:
    """A parameter alone, with its bounds as what is plausible where it stands on one of them, as friction on zero."""
    if not isinstance(each, Candidate):
        names = _named(fit.problem.system, _without_bounds_at_start(fit.problem.system, each)[0])
        each = Candidate(", ".join(names), free=(each,))
    system = each.system or fit.problem.system
    if not isinstance(system, System):
        raise TypeError(f"{each.name}: `system` is a jaxkane.System, got {type(system).__name__}.")
    items, plausible = [], {}
    for item in each.items:
        item, bounds = _without_bounds_at_start(system, item)
        items.append(item)
        plausible |= bounds
    known = [name for item in items for name in _named(system, item)]
    refuse_unknown(each.plausible, (*known, *fit.names), f"{each.name}: `plausible` names")
    return dataclasses.replace(each, free=tuple(items), plausible={**plausible, **each.plausible})


def _without_bounds_at_start(system: System, item: Any) -> tuple[Any, dict[str, Bounds]]:
    """The same to be searched for on both sides, where it starts on a bound; and that bound."""
    named = Free(item) if isinstance(item, str) or callable(item) else item
    if not isinstance(named, (Free, CalibrationTerm)):
        return item, {}
    free = parameters_of(system, named)
    ends = [(float(one.lower), float(one.upper)) for one in free.bijections if isinstance(one, Interval)]
    if not any(start in pair for start, pair in zip(np.asarray(free.start), ends, strict=True)):
        return item, {}
    return dataclasses.replace(named, bounds=(None, None)), dict(zip(free.names, ends, strict=True))


def _named(system: System, item: Any) -> tuple[str, ...]:
    return parameters_of(system, [item]).names


def _refuse_nothing_new(fit: Fit, candidate: Candidate) -> None:
    system = candidate.system or fit.problem.system
    names = parameters_of(system, candidate.items).names if candidate.items else ()
    free = [name for name in names if name in fit.names]
    if free:
        raise ValueError(f"{candidate.name}: {', '.join(free)} is free in the fit already.")
    asked, more = fit.problem.specification, candidate.of_trials
    for key in OF_TRIALS:
        there = [name for name in more[key] if name in deviations_by_name(getattr(asked, key))]
        if there:
            raise ValueError(f"{candidate.name}: every trial has its own {key} of {', '.join(there)} already.")
    starts = [name for name in deviations_by_name(candidate.unknown) if name in deviations_by_name(asked.unknown)]
    if starts:
        raise ValueError(f"{candidate.name}: the start of {', '.join(starts)} is unknown already.")
    if not names and not any(more.values()) and not candidate.unknown and candidate.system is None:
        raise ValueError(f"{candidate.name}: nothing is freed, and nothing else is unknown.")


def groups_of(fit: Fit, candidates: Sequence[Candidate]) -> Iterator[list[Candidate]]:
    """Candidates that one problem can hold: those of the same system, with the same unknown starts.

    What delays an input under a zero-order hold stands by itself: its jumps are then ramps of two steps, by which the
    motion differs a little before anything is delayed.
    """
    groups: list[list[Candidate]] = []
    for candidate in candidates:
        for group in groups:
            if _same_frame(fit, group[0], candidate):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    yield from groups


def _same_frame(fit: Fit, a: Candidate, b: Candidate) -> bool:
    systems = [c.system or fit.problem.system for c in (a, b)]
    same = deviations_by_name(a.unknown) == deviations_by_name(b.unknown) and _held_and_late(fit, a) == _held_and_late(
        fit, b
    )
    return same and bool(eqx.tree_equal(*systems))


def _held_and_late(fit: Fit, candidate: Candidate) -> set[str]:
    """Inputs under a zero-order hold that a candidate delays."""
    late = {item.what for item in candidate.items if isinstance(item, Delay)} | {
        *deviations_by_name(candidate.input_delay)
    }
    return late & {*fit.problem.model.zero_order_hold}


def posed_with(fit: Fit, candidates: Sequence[Candidate]) -> ProblemSpec:
    """What the fit was asked, with these candidates in it.

    **Raises:** `ValueError` where two of them free the same differently, or are of systems that exclude each other.
    """
    asked, system = fit.problem.specification, _system_of(fit, candidates)
    items: list[tuple[Any, tuple[str, ...]]] = []
    for item in (item for candidate in candidates for item in candidate.items):
        names = _named(system, item)
        same = [other for other, there in items if set(there) & set(names)]
        if same and not all(_equal(other, item) for other in same):
            raise ValueError(f"Two candidates free {', '.join(names)} in different ways.")
        if not same:
            items.append((item, names))
    more: dict[str, Any] = {"free": [*asked.free, *(item for item, _ in items)]}
    for key in ("unknown", *OF_TRIALS):
        more[key] = deviations_by_name(getattr(asked, key))
        for candidate in candidates:
            more[key] |= deviations_by_name(getattr(candidate, key))
    return dataclasses.replace(asked, system=system, **more)


def _system_of(fit: Fit, candidates: Sequence[Candidate]) -> System:
    system = fit.problem.system
    for candidate in candidates:
        other = candidate.system
        if other is None or bool(eqx.tree_equal(other, system)):
            continue
        if system is not fit.problem.system and not isinstance(other, type(system)):  # that of a candidate before
            if isinstance(system, type(other)):
                continue  # the one there has what this one has
            raise ValueError(f"{candidate.name}: {type(other).__name__} is no {type(system).__name__}.")
        system = other
    return system


def _equal(a: Any, b: Any) -> bool:
    return a is b or bool(a == b)


@dataclasses.dataclass(frozen=True)
class Extended:
    """One problem in which all candidates of one system are free, at the point where the fit ended.

    - `names`: of all parameters; the first are those of the fit. `own_x`, `own_b`: by candidate, which parameters and
        unknowns of trials are its own.
    - `base_x`, `base_b`: which are the fit's.
    """

    candidates: tuple[Candidate, ...]
    problem: Problem
    point: Unknowns
    base_x: tuple[int, ...]
    base_b: tuple[int, ...]
    own_x: dict[str, tuple[int, ...]]
    own_b: dict[str, tuple[int, ...]]

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.parameters.names

    def owned(self, active: Sequence[Candidate]) -> tuple[list[int], list[int]]:
        """Which parameters, and which unknowns of trials, are the fit's or of these candidates."""
        x, b = list(self.base_x), list(self.base_b)
        for candidate in active:
            x += [i for i in self.own_x[candidate.name] if i not in x]
            b += [i for i in self.own_b[candidate.name] if i not in b]
        return x, b

    def with_only(self, active: Sequence[Candidate], held: np.ndarray) -> tuple[Problem, Unknowns]:
        """The problem in which of all candidates only these are free, and the same point of it.

        Parameters of the others are left out; their unknowns of trials are held by priors of the deviations `held`. As
        many free ones run the same compiled program.
        """
        (free_x, free_b), model = self.owned(active), self.problem.model
        part = ParameterSubset(model.parameters, jnp.asarray(free_x, dtype=jnp.int32), self.point.x)
        of_trial = np.array(model.nuisance.trial_deviation)
        still = np.delete(np.arange(of_trial.size), free_b)
        of_trial[still] = held[still]
        where = lambda m: (m.parameters, m.nuisance.trial_deviation)  # noqa: E731
        model = eqx.tree_at(where, model, (part, jnp.asarray(of_trial, self.point.x.dtype)))
        point = eqx.tree_at(lambda p: p.x, self.point, self.point.x[part.places])
        return dataclasses.replace(self.problem, model=model), point


def extended(
    fit: Fit,
    standing: tuple[Problem, Unknowns],
    candidates: Sequence[Candidate],
    taken: Sequence[Candidate],
    order: Sequence[str],
) -> Extended:
    """The fit's problem with all that candidates of one group free; those `taken` before are free at `standing`.

    All stand in the `order` of their names, whoever was taken, so that each round runs the same compiled program.

    **Raises:** `ValueError` where a system lacks what is free in the fit, or two candidates free the same differently.
    """
    both = sorted((*taken, *candidates), key=lambda c: order.index(c.name))
    asked = posed_with(fit, both)
    if fit.problem.chooses_steps:  # the fit has chosen: nothing is tried again
        step = float(np.median(np.asarray(fit.problem.windows.step)))
        chosen = dataclasses.replace(asked.simulation or Simulation(), step=step)
        asked = dataclasses.replace(asked, simulation=chosen)
    problem = fit.problem.with_specification(asked)
    names, trial, system = problem.parameters.names, problem.model.nuisance.trial, asked.system
    own_x = {c.name: tuple(names.index(n) for n in _parameter_names(system, c)) for c in both}
    own_b = {c.name: tuple(trial.index(pair) for pair in _pairs(c)) for c in both}
    base_x = [names.index(name) for name in fit.names]
    base_b = [trial.index(pair) for pair in fit.problem.model.nuisance.trial]
    for before in taken:
        base_x += [i for i in own_x[before.name] if i not in base_x]
        base_b += [i for i in own_b[before.name] if i not in base_b]
    point = carried(*standing, problem, [names[i] for i in base_x])
    mine = [{c.name: own[c.name] for c in candidates} for own in (own_x, own_b)]
    return Extended(tuple(candidates), problem, point, tuple(base_x), tuple(base_b), *mine)


def _parameter_names(system: System, candidate: Candidate) -> tuple[str, ...]:
    return parameters_of(system, candidate.items).names if candidate.items else ()


def _pairs(candidate: Candidate) -> list[tuple[str, str]]:
    """As `Nuisance.trial` has them."""
    found = []
    for key, names in candidate.of_trials.items():
        where, kind = key.split("_")
        found += [(f"{kind} of {where}", name) for name in names]
    return found


def carried(there: Problem, at: Unknowns, problem: Problem, names: Sequence[str]) -> Unknowns:
    """A point of one problem as one of another that has more unknowns: what is new is where it starts."""
    point, old, new = problem.start, there.model.nuisance, problem.model.nuisance
    known, values = there.parameters.names, np.asarray(parameter_values(there.parameters, at.x))
    if bool(eqx.tree_equal(problem.system, there.system)):
        to, of = (
            np.array([all_names.index(n) for n in names], dtype=int) for all_names in (problem.parameters.names, known)
        )
        point = eqx.tree_at(lambda p: p.x, point, point.x.at[to].set(at.x[of]))
    else:
        point = problem.at({name: float(values[known.index(name)]) for name in names}, point)
    b = [(new.trial.index(pair), i) for i, pair in enumerate(old.trial) if pair in new.trial]
    z = [(new.start.index(name), i) for i, name in enumerate(old.start)]
    for pairs, where in ((b, lambda p: p.b), (z, lambda p: p.z)):
        if pairs:
            to, of = (np.array(places, dtype=int) for places in zip(*pairs, strict=True))
            point = eqx.tree_at(where, point, where(point).at[:, to].set(where(at)[:, of]))
    return point
