"""What the arguments of a fit name, checked: trials and their channels, unknown starts and biases. Knows names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._common.lookup import hint, refuse_unknown
from ..._description.system import System
from .._data.trial import Trial
from .model import Nuisance

Names = Sequence[str] | Mapping[str, float | None]
"""Names, or names with the standard deviation of a Gaussian prior around the initial guess (None: no prior)."""


def checked_trials(system: System, trials: Sequence[Trial], outputs: Mapping[str, Any]) -> tuple[str, ...]:
    """The channels of all trials."""
    title = type(system).__name__
    if not trials:
        raise ValueError("There is no trial to fit.")
    named = (*system.coordinates, *system.speeds, *system.dependent_speeds)
    for trial in trials:
        if not isinstance(trial, Trial):
            raise TypeError(f"`trials` holds jaxkane.fit.Trial, got {type(trial).__name__}.")
        for what, given, known in (
            ("channel", trial.measured, (*named, *outputs)),
            ("input", trial.inputs, system.inputs),
            ("coordinate or independent speed", trial.initial, (*system.coordinates, *system.speeds)),
        ):
            refuse_unknown(given, known, f"{trial.name}: {title} has no {what}")
    return tuple(dict.fromkeys(channel for trial in trials for channel in trial.measured))


def checked_names(system: System, what: str, given: Any, known: Sequence[str]) -> dict[str, float]:
    """Names with the deviations of their priors."""
    given = (given,) if isinstance(given, str) else given
    given = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given)
    wrong = [name for name in given if name not in known]
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` names {', '.join(wrong)}; {hint(wrong, known, 'it may name')}"
            + (" Dependent coordinates and speeds follow from the others." if what == "unknown" else "")
        )
    bad = [name for name, deviation in given.items() if deviation is not None and not deviation > 0]
    if bad:
        raise ValueError(f"`{what}`: the standard deviation of {bad[0]} must be positive, or None for no prior.")
    return {name: float("inf") if deviation is None else float(deviation) for name, deviation in given.items()}


def nuisance_of(
    system: System, unknown: Names, per_trial: Mapping[str, Mapping[str, float]], continuity: Mapping[str, float] | None
) -> Nuisance:
    held = tuple(c for c in system.coordinates if c not in system.dependent_coordinates)
    start = checked_names(system, "unknown", unknown, (*held, *system.speeds))
    jump = checked_names(system, "continuity", continuity or {}, tuple(start))
    array = lambda numbers: jnp.asarray(np.array(list(numbers), float), jnp.result_type(float))  # noqa: E731
    return Nuisance(
        start=tuple(start),
        trial=tuple((kind, name) for kind, names in per_trial.items() for name in names),
        chained=continuity is not None,
        start_deviation=array(start.values()),
        trial_deviation=array(d for names in per_trial.values() for d in names.values()),
        jump=array(jump.get(name, float("inf")) for name in start),
    )
