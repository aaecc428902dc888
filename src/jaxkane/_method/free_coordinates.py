"""Which coordinates are moved to meet the constraints, and from where. Knows names; solves nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._common.lookup import as_names, refuse_unknown
from .._common.memory import Memory
from .._description.system import System
from .._scalars.jax_internals import concretely
from .._scalars.numbers import in_numbers
from .description_facts import configuration_residual
from .trial_numbers import structure_of, with_trial_numbers


class Plan(NamedTuple):
    """Which coordinates are moved, which are `named`, and where some that were not named start.

    `lenient`: a constraint that does not read what is moved is no equation: it only has to be met.
    """

    moved: tuple[str, ...]
    named: tuple[str, ...]
    guess: dict[str, float]
    lenient: bool


def plan_of(system: System, q: Any, free: Sequence[str] | None) -> Plan:
    names = system.coordinates
    named = tuple(q) if isinstance(q, Mapping) else tuple(names)
    quaternions = euler_parameters(system) if isinstance(q, Mapping) else []
    guess = {names[four[3]]: 1.0 for four in quaternions if names[four[3]] not in named}
    if free is not None:
        free = as_names(free)
        refuse_unknown(free, names, f"{type(system).__name__} has no coordinate", "it has")
        return Plan(tuple(c for c in names if c in free), named, guess, lenient=True)
    if system.dependent_coordinates:
        return Plan(tuple(system.dependent_coordinates), named, guess, lenient=False)
    if not isinstance(q, Mapping):
        return Plan(tuple(names), named, guess, lenient=False)
    # Beside a scalar that is named, the axis of a rotation cannot be found: it is zero, or named too.
    still = {names[i] for four in quaternions if names[four[3]] in named for i in four}
    return Plan(tuple(c for c in names if c not in named and c not in still), named, guess, lenient=True)


def found_of(system: System, named: Iterable[str]) -> tuple[tuple[str, ...], dict[str, float]]:
    """Of coordinates in a dict with these names: those that `assemble` moves, and where of those that are left out
    some start that do not start at zero."""
    plan = plan_of(system, dict.fromkeys(named, 0.0), None)
    return plan.moved, plan.guess


_EULER_PARAMETERS = Memory()  # places of Euler parameters by structure


def euler_parameters(system: System) -> list[tuple[int, ...]]:
    """Places of every four coordinates, one after the other, of which a constraint says that their norm is one."""
    structure = structure_of(system)
    found = _EULER_PARAMETERS.get(structure)
    if found is None:
        rng = np.random.default_rng(0)
        probe = rng.uniform(0.2, 0.9, len(system.coordinates)).astype(jnp.result_type(float))
        with concretely():
            trial = with_trial_numbers((system, np.zeros((), probe.dtype), probe), rng)
            values = np.abs(in_numbers(configuration_residual, *trial))
        found = _EULER_PARAMETERS[structure] = [
            (i, i + 1, i + 2, i + 3)
            for i, square in enumerate(np.convolve(probe**2, np.ones(4), "valid") if len(probe) > 3 else ())
            if any(np.any(np.abs(values - abs(x)) < 1e-5) for x in (square - 1.0, square**0.5 - 1.0))
        ]
    return found
