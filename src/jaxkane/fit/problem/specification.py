"""The specification of the problem that a fit solves, and the checks of its names and initial values."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, hint, real_number, refuse, refuse_unknown
from ..._kane.consistent_state import AssemblyProblem, euler_parameters
from ..._kane.constraint_residuals import has_configuration_constraints
from ..._kane.right_hand_side import output_names
from ..._scalarjit.compat import on_device
from ..._system.system import System
from .declarations import Delay
from .from_declarations import JointPrior, Linear, as_items, parameters_of
from .model import Nuisance, Simulation
from .parameters import Parameters, Prior, floats
from .trial import Trial
from .windows import DelayRange, state_names

Names = Sequence[str] | Mapping[str, float | None]
"""Names, or names with the standard deviation of a Gaussian prior around the initial guess (None: no prior)."""


@dataclasses.dataclass(frozen=True)
class ProblemSpec:
    """The specification of a `Problem` without its trials. `jaxkane.fit.fit` documents the arguments."""

    system: System
    free: Any
    _: dataclasses.KW_ONLY
    unknown: Names = ()
    priors: Mapping[str, Prior] | None = None
    constraints: Sequence[Linear | JointPrior] = ()
    zero_order_hold: Sequence[str] = ()
    window: float | None = None
    defect_std: Mapping[str, float] | None = None
    noise: Mapping[str, float] | None = None
    errors: Any = None
    simulation: Simulation | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(as_items(self.free)))
        for name, value in vars(self).items():
            if isinstance(value, (list, dict)):  # a copy, because the caller may change the original later
                object.__setattr__(self, name, copy.copy(value))
        if self.simulation is not None:
            refuse_other(self.simulation, Simulation, "`simulation=`", "Simulation(step=0.01)")
        dicts = {"priors": self.priors, "defect_std": self.defect_std}
        refuse(
            (
                not isinstance(self.system, System),
                f"`system` must be a jaxkane.System, got {type(self.system).__name__}.",
            ),
            *(
                (not isinstance(x, (Mapping, type(None))), f"`{n}` must be a dict, got {x!r}.")
                for n, x in dicts.items()
            ),
            error=TypeError,
        )
        other = "noise" if self.noise is not None else "defect_std"
        refuse(
            (
                self.window is not None and not real_number(self.window, "`window`") > 0,
                f"`window` must be a positive duration [s], got {self.window}.",
            ),
            (
                self.defect_std is not None and self.window is None,
                "`defect_std` is given without `window`. Pass the length of a window [s]: `defect_std` links the "
                "windows of a trial.",
            ),
            (
                self.errors is not None and getattr(self, other) is not None,
                f"Pass either `errors` or `{other}`, not both. Error models require a motion without process noise. "
                "With `noise`, `NoiseScale` in `free` estimates the standard deviation of a channel.",
            ),
        )


F = TypeVar("F", bound=Callable[..., Any])


def with_options(function: F) -> F:
    """Add the options of a `ProblemSpec`, which a function takes as `**options`, to its signature."""
    signature, spec = inspect.signature(function), inspect.signature(ProblemSpec)
    parameters = list(signature.parameters.values())
    options = [p for p in spec.parameters.values() if p.kind is p.KEYWORD_ONLY and p.name not in signature.parameters]
    places = [i for i, p in enumerate(parameters) if p.kind in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]
    parameters[places[0] : places[0]] = options
    parameters = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return function


def refuse_other(value: Any, wanted: type, name: str, instead: str) -> None:
    """Check the type of an argument: some functions require a `Problem`, others a `Fit`.

    **Raises:** `TypeError` for another type.
    """
    if not isinstance(value, wanted):
        raise TypeError(f"{name} requires a {wanted.__name__}, as in {instead}; got {type(value).__name__}.")


def checked_trials(system: System, trials: Sequence[Trial]) -> tuple[str, ...]:
    """The channels of all trials.

    **Raises:** `ValueError` if the system has no such channel, input or initial value.
    """
    title = type(system).__name__
    named = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.states, *output_names(system))
    for trial in trials:
        for what, names, known in (
            ("channel", trial.measured, named),
            ("input", trial.inputs, system.inputs),
            ("coordinate, independent speed or state", trial.initial, state_names(system)),
        ):
            refuse_unknown(names, known, f"{trial.name}: {title} has no {what}")
    return tuple(dict.fromkeys(channel for trial in trials for channel in trial.measured))


def deviations_by_name(names: Names, argument: str = "unknown") -> dict[str, float | None]:
    """Each name with its standard deviation, or None."""
    return dict(names) if isinstance(names, Mapping) else dict.fromkeys(as_names(names, argument))


def checked_names(system: System, what: str, names: Any, known: Sequence[str]) -> dict[str, float]:
    """Each name with the standard deviation of its prior, infinite without a prior.

    **Raises:** `ValueError` for an unknown name, or a standard deviation that is not positive.
    """
    names = deviations_by_name(names, what)
    wrong = [name for name in names if name not in known]
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` contains unknown names: {', '.join(wrong)}; "
            f"{hint(wrong, known, 'the names are')}"
            + (" Dependent coordinates and speeds follow from the constraints." if what == "unknown" else "")
        )
    numbers = {}
    for name, deviation in names.items():
        label = f"`{what}`: the standard deviation of {name}"
        numbers[name] = float("inf") if deviation is None else real_number(deviation, label)
        if not numbers[name] > 0:
            raise ValueError(f"{label} must be positive, or None for no prior; got {deviation!r}.")
    return numbers


class StartAssembly(NamedTuple):
    """How `assemble` makes the initial states of windows satisfy the constraints.

    - `moved`: names of the coordinates that `assemble` adjusts; None for its default choice.
    - `quaternions`: indices of each set of four Euler parameters that every trial names. They are normalized first.
    - `guess`: by name, initial guesses other than zero for coordinates without data.
    """

    moved: tuple[str, ...] | None
    quaternions: tuple[tuple[int, ...], ...]
    guess: dict[str, float]


def start_assembly(system: System, trials: Sequence[Trial], unknown: Sequence[str]) -> StartAssembly:
    """How coordinates without data are computed.

    **Raises:** `ValueError` if a trial has no data for a coordinate that other trials specify.
    """
    by_trial = [{*trial.initial, *trial.measured, *unknown} for trial in trials]
    named = [c for c in system.coordinates if any(c in names for names in by_trial)]
    fours = [(four, {system.coordinates[i] for i in four}) for four in euler_parameters(system)]
    quaternions = tuple(four for four, names in fours if all(names <= known for known in by_trial))
    moved = AssemblyProblem.of(system, dict.fromkeys(named, 0.0)).moved
    guess = AssemblyProblem.of(system, dict.fromkeys([c for c in named if c not in unknown], 0.0)).guess
    t, q = (on_device(np.zeros(shape), jnp.result_type(float)) for shape in ((), len(system.coordinates)))
    if system.dependent_coordinates or not has_configuration_constraints(system, t, q):
        return StartAssembly(None, quaternions, guess)
    for trial, names in zip(trials, by_trial, strict=True):
        missing = [c for c in named if c not in names]
        if missing:
            raise ValueError(
                f"{trial.name}: there are no data for {', '.join(missing)}, whose initial value is specified by other "
                f"trials. Add it to `initial`, or define `dependent_coordinates` in {type(system).__name__}."
            )
    return StartAssembly(None if len(named) == len(system.coordinates) else moved, quaternions, guess)


def nuisance_of(spec: ProblemSpec, channels: Sequence[str], sampled: Sequence[str]) -> Nuisance:
    """The nuisance values. `sampled`: names of the inputs with samples."""
    system = spec.system
    items = [item for item in spec.free if item.is_eliminated]
    own = parameters_of(system, items, spec.noise, channels)
    of_window = np.array([item.each == "window" for item in items], bool)
    if of_window.any() and (spec.noise is not None or spec.defect_std is not None):
        raise ValueError(
            f"{own.names[int(np.argmax(of_window))]}: each='window' is not supported together with `noise` or "
            "`defect_std`. Use each='trial'."
        )
    # `Model.priors` is zero at z = 0 and b = 0. So these must be the prior mean, not the initial guess.
    center, deviation = np.where(own.has_prior, own.prior_mean, own.start), np.asarray(own.prior_deviation)
    for kind, name in (role for entry in own.entries for role in entry.roles):
        known = channels if kind.endswith("sensor") else system.inputs if kind == "offset of input" else sampled
        refuse_unknown(
            [name],
            known,
            f"{type(system).__name__}: {kind} with `each` needs samples of",
            "there are samples of",
        )
    turned = {system.coordinates[i] for four in euler_parameters(system) for i in four}
    independent = tuple(c for c in system.coordinates if c not in system.dependent_coordinates or c in turned)
    start = checked_names(system, "unknown", spec.unknown, (*independent, *system.speeds, *system.states))
    defects = checked_names(system, "defect_std", spec.defect_std or {}, tuple(start))
    return Nuisance(
        start=tuple(start),
        window=tuple(entry for entry, each in zip(own.entries, of_window, strict=True) if each),
        trial=tuple(entry for entry, each in zip(own.entries, of_window, strict=True) if not each),
        has_defects=spec.defect_std is not None,
        start_deviation=floats([*start.values(), *deviation[of_window]]),
        window_center=floats(center[of_window]),
        trial_center=floats(center[~of_window]),
        trial_deviation=floats(deviation[~of_window]),
        defect_std=floats([defects.get(name, float("inf")) for name in start]),
    )


def delay_range_of(trials: Sequence[Trial], parameters: Parameters, nuisance: Nuisance) -> DelayRange | None:
    """The largest delay and the largest advance of inputs [s], from the bounds; None if no input has a delay.

    **Raises:** `ValueError` if a delay may be longer than a trial.
    """
    if any(kind == "delay of input" for entry in nuisance.trial for kind, _ in entry.roles):
        # A delay of each trial has no bounds (`is_eliminated`), so all input samples of the trial are kept.
        return np.inf, np.inf
    shortest = min(trials, key=lambda trial: np.ptp(trial.t))
    ranges = [(0.0, 0.0)]
    for entry, start, (lower, upper) in zip(
        parameters.entries, np.asarray(parameters.start), parameters.bounds.tolist(), strict=True
    ):
        if not any(kind == "delay of input" for kind, _ in entry.roles):
            continue
        for delay in (lower, upper, float(start)):
            if np.isfinite(delay) and abs(delay) > np.ptp(shortest.t):
                raise ValueError(
                    f"The bounds of {entry.name} allow {delay:g} s, but {shortest.name} lasts only "
                    f"{np.ptp(shortest.t):.6g} s. Pass narrower `bounds`, or omit short trials."
                )
        ranges.append((upper, -lower))
    latest, earliest = map(max, zip(*ranges, strict=True))
    return (latest, earliest) if len(ranges) > 1 else None


def delayed_inputs(spec: ProblemSpec) -> tuple[dict[str, float], dict[str, float]]:
    """By input, the longest delay [s] of inputs with an upper bound and without `before`; and by input, the value of
    `before`."""
    longest_delays, before = {}, {}
    for item in (item for item in spec.free if isinstance(item, Delay) and item.of != "sensor"):
        upper = (item.bounds or (None, None))[1]
        for name in {*item.channels} & {*spec.system.inputs}:
            if item.before is not None:
                before[name] = real_number(item.before, f"Delay({name!r}): `before`")
            elif upper is not None:
                longest_delays[name] = max(upper, 0.0)
    return longest_delays, before
