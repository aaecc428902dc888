"""What the arguments of a fit name, checked: trials and their channels, unknown starts and biases. Knows names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, hint, refuse_unknown
from ..._common.real_numbers import real_number
from ..._description.system import System
from ..._method.drift import has_configuration_constraints
from ..._method.free_coordinates import euler_parameters, found_of
from ..._method.outputs import output_names
from .._data.trial import Trial
from .._data.windows import Reach, state_names
from .arguments import Specification
from .model import Nuisance
from .parameters import Parameters

Names = Sequence[str] | Mapping[str, float | None]
"""Names, or names with the standard deviation of a Gaussian prior around the initial guess (None: no prior)."""


def checked_trials(system: System, trials: Sequence[Trial]) -> tuple[str, ...]:
    """The channels of all trials."""
    title = type(system).__name__
    named = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.states, *output_names(system))
    for trial in trials:
        for what, given, known in (
            ("channel", trial.measured, named),
            ("input", trial.inputs, system.inputs),
            ("coordinate, independent speed or state", trial.initial, state_names(system)),
        ):
            refuse_unknown(given, known, f"{trial.name}: {title} has no {what}")
    return tuple(dict.fromkeys(channel for trial in trials for channel in trial.measured))


def deviations_by_name(given: Names) -> dict[str, float | None]:
    """Each name with its standard deviation, or None."""
    return dict(given) if isinstance(given, Mapping) else dict.fromkeys(as_names(given))


def checked_names(system: System, what: str, given: Any, known: Sequence[str]) -> dict[str, float]:
    """Names with the deviations of their priors."""
    given = deviations_by_name(given)
    wrong = [name for name in given if name not in known]
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` names {', '.join(wrong)}; {hint(wrong, known, 'it may name')}"
            + (" Dependent coordinates and speeds follow from the others." if what == "unknown" else "")
        )
    numbers = {}
    for name, deviation in given.items():
        label = f"`{what}`: the standard deviation of {name}"
        numbers[name] = float("inf") if deviation is None else real_number(deviation, label)
        if not numbers[name] > 0:
            raise ValueError(f"{label} must be positive, or None for no prior; got {deviation!r}.")
    return numbers


class Starts(NamedTuple):
    """How the windows' starts are made to satisfy the constraints: as `assemble` does with a dict that names what is
    known, measured or unknown.

    - `moved`: the coordinates that it moves, None for those that it moves of an array.
    - `quaternions`: places of every four Euler parameters that are named, which are brought to unit norm before.
    - `guess`: where coordinates start of which nothing is known, if not at zero.
    """

    moved: tuple[str, ...] | None
    quaternions: tuple[tuple[int, ...], ...]
    guess: dict[str, float]


def starts_found(system: System, trials: Sequence[Trial], unknown: Sequence[str]) -> Starts:
    """What a trial does not say of coordinates, and how that is found.

    **Raises:** `ValueError` for a trial that says nothing of a coordinate which is held in the others.
    """
    by_trial = [{*trial.initial, *trial.measured, *unknown} for trial in trials]
    named = [c for c in system.coordinates if any(c in names for names in by_trial)]
    fours = [(four, {system.coordinates[i] for i in four}) for four in euler_parameters(system)]
    quaternions = tuple(four for four, names in fours if all(names <= said for said in by_trial))
    moved = found_of(system, named)[0]
    guess = found_of(system, [c for c in named if c not in unknown])[1]
    q = jnp.zeros(len(system.coordinates))
    if system.dependent_coordinates or not has_configuration_constraints(system, jnp.zeros(()), q):
        return Starts(None, quaternions, guess)
    for trial, names in zip(trials, by_trial, strict=True):
        missing = [c for c in named if c not in names]
        if missing:
            raise ValueError(
                f"{trial.name} says nothing of {', '.join(missing)}, which is held where other trials start: name it "
                f"in `initial`, or give {type(system).__name__} its `dependent_coordinates`."
            )
    return Starts(None if len(named) == len(system.coordinates) else moved, quaternions, guess)


def nuisance_of(asked: Specification, channels: Sequence[str], driven: Sequence[str]) -> Nuisance:
    """What is unknown beside the parameters; `driven` are inputs with samples."""
    system = asked.system
    known = {
        "sensor_bias": channels,
        "sensor_gain": channels,
        "input_bias": system.inputs,
        "input_gain": driven,
        "input_delay": driven,
    }
    trial = {}
    for argument, names in known.items():
        where, kind = argument.split("_")
        for name, deviation in checked_names(system, argument, getattr(asked, argument), names).items():
            trial[f"{kind} of {where}", name] = deviation
    turned = {system.coordinates[i] for four in euler_parameters(system) for i in four}
    independent = tuple(c for c in system.coordinates if c not in system.dependent_coordinates or c in turned)
    start = checked_names(system, "unknown", asked.unknown, (*independent, *system.speeds, *system.states))
    jump = checked_names(system, "continuity", asked.continuity or {}, tuple(start))
    array = lambda numbers: jnp.asarray(np.array(list(numbers), float), jnp.result_type(float))  # noqa: E731
    return Nuisance(
        start=tuple(start),
        trial=tuple(trial),
        chained=asked.continuity is not None,
        start_deviation=array(start.values()),
        trial_deviation=array(trial.values()),
        jump=array(jump.get(name, float("inf")) for name in start),
    )


def reach_of(trials: Sequence[Trial], parameters: Parameters, nuisance: Nuisance) -> Reach | None:
    """By how much inputs may act late and early [s], as the bounds of their delays say; None where none is delayed.

    **Raises:** `ValueError` for a delay that may be longer than a trial.
    """
    if any(kind == "delay of input" for kind, _ in nuisance.trial):
        return np.inf, np.inf
    shortest = min(trials, key=lambda trial: np.ptp(trial.t))
    reaches = [(0.0, 0.0)]
    for entry, start, owner in zip(parameters.entries, parameters.start, parameters.owners, strict=True):
        if entry.role is None or entry.role[0] != "delay of input":
            continue
        lower, upper = (float(getattr(parameters.bijections[owner], end)) for end in ("lower", "upper"))
        for delay in (lower, upper, float(start)):
            if np.isfinite(delay) and abs(delay) > np.ptp(shortest.t):
                raise ValueError(
                    f"{entry.name} may be {delay:g} s, and {shortest.name} lasts {np.ptp(shortest.t):.6g} s: what "
                    "would act in it is not recorded. Give narrower `bounds`, or leave short trials out."
                )
        reaches.append((upper, -lower))
    late, early = map(max, zip(*reaches, strict=True))
    return (late, early) if len(reaches) > 1 else None
