"""One problem in which all candidates of a system are free, and a point of it. Knows names; solves nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._description.system import System
from .._problem.entries import parameters_of
from .._problem.model import Unknowns
from .._problem.part import Part
from .._problem.problem import Problem
from .._problem.simulation import Simulation
from .._result.covariance import values_of
from .._result.result import Fit
from .candidates import Candidate, posed_with


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
        part = Part(model.parameters, jnp.asarray(free_x, dtype=jnp.int32), self.point.x)
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
    problem = fit.problem.asking(asked)
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
    known, values = there.parameters.names, np.asarray(values_of(there.parameters, at.x))
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
