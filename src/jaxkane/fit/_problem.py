"""A fit that is posed: trials, windows, what is free and what is unknown. Knows names; knows no optimizer."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._common.lookup import as_names, hint, real_number, refuse_unknown
from .._integrate.trajectory import Trajectory
from .._kane.assembly import NoConfiguration, euler_parameters, found_of
from .._kane.constraints import has_configuration_constraints
from .._kane.rhs import output_names
from .._system.system import System
from . import _linearize as step_halving
from ._declarations import Prior
from ._linearize import check_same, rides_of, starts_of
from ._model import Model, Nuisance, Simulation, Unknowns
from ._parameters import Parameters, as_items, parameters_of
from ._process_noise import noise_of
from ._trial import Trial, as_trials
from ._windows import Reach, Windows, WindowSlice, cut, state_names


@dataclasses.dataclass(frozen=True)
class ProblemSpec:
    """The arguments of `jaxkane.fit.fit` that pose it, but for the trials: all that a `Problem` is derived from, and
    what it is posed by again."""

    system: System
    free: Any
    _: dataclasses.KW_ONLY
    unknown: Names = ()
    sensor_bias: Names = ()
    sensor_gain: Names = ()
    input_bias: Names = ()
    input_gain: Names = ()
    input_delay: Names = ()
    priors: Mapping[str, Prior] | None = None
    zero_order_hold: Sequence[str] = ()
    window: float | None = None
    defect_std: Mapping[str, float] | None = None
    noise: Mapping[str, float] | None = None
    simulation: Simulation | None = None
    processes: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(as_items(self.free)))
        for name, value in vars(self).items():
            if isinstance(value, (list, dict)):  # the caller's own, who may change it later
                object.__setattr__(self, name, copy.copy(value))
        if self.simulation is not None:
            refuse_other(self.simulation, Simulation, "`simulation=`", "Simulation(step=0.01)")
        if not isinstance(self.system, System):
            raise TypeError(f"`system` is a jaxkane.System, got {type(self.system).__name__}.")
        for name in ("priors", "defect_std"):
            if not isinstance(getattr(self, name), (Mapping, type(None))):
                raise TypeError(f"`{name}` is a dict by name, got {getattr(self, name)!r}.")
        if self.window is not None and not real_number(self.window, "`window`") > 0:
            raise ValueError(f"`window` is a length of time [s], got {self.window}.")
        if self.defect_std is not None and self.window is None:
            raise ValueError("`defect_std` binds the windows of a trial together: give their length, `window` [s].")

    def with_priors(self, priors: Mapping[str, Prior]) -> ProblemSpec:
        """The same with these priors in the place of those of the same names."""
        return dataclasses.replace(self, priors={**(self.priors or {}), **priors})


def refuse_other(given: Any, wanted: type, name: str, instead: str) -> None:
    """What is asked before a fit takes a `Problem`, what is asked after it takes a `Fit`.

    **Raises:** `TypeError` for anything else.
    """
    if not isinstance(given, wanted):
        raise TypeError(f"{name} takes a {wanted.__name__}, as in {instead}; got {type(given).__name__}.")


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


def nuisance_of(asked: ProblemSpec, channels: Sequence[str], driven: Sequence[str]) -> Nuisance:
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
    jump = checked_names(system, "defect_std", asked.defect_std or {}, tuple(start))
    array = lambda numbers: jnp.asarray(np.array(list(numbers), float), jnp.result_type(float))  # noqa: E731
    return Nuisance(
        start=tuple(start),
        trial=tuple(trial),
        has_defects=asked.defect_std is not None,
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


@dataclasses.dataclass(frozen=True)
class Problem:
    """Trials, free parameters and nuisance values of one fit.

        residual = (gain * simulated + bias - measured) / sigma

    Made by `Problem.of`; solved by `minimize`; looked at by `identifiability`.
    """

    model: Model
    windows: Windows
    by_trial: Array
    trials: tuple[Trial, ...]
    slices: tuple[WindowSlice, ...]
    specification: ProblemSpec

    @classmethod
    def of(
        cls,
        system: System,
        trials: Sequence[Trial] | Trial,
        free: Any,
        **options: Any,
    ) -> Problem:
        """Pose a fit. The arguments are those of `jaxkane.fit.fit`, from `unknown` to `simulation`."""
        return cls.posed(ProblemSpec(system, free, **options), trials)

    @classmethod
    def posed(cls, asked: ProblemSpec, trials: Sequence[Trial] | Trial) -> Problem:
        """What is asked, of these trials."""
        system, window, simulation = asked.system, asked.window, asked.simulation or Simulation()
        trials = as_trials(trials)
        channels = checked_trials(system, trials)
        driven = tuple(name for name in system.inputs if any(name in trial.inputs for trial in trials))
        nuisance = nuisance_of(asked, channels, driven)
        deviations = jnp.concatenate([nuisance.start_deviation, nuisance.trial_deviation])
        of_noise = noise_of(system, asked.noise, deviations, window, asked.defect_std)
        held = tuple(checked_names(system, "zero_order_hold", asked.zero_order_hold, system.inputs))
        starts = starts_found(system, trials, nuisance.start)
        parameters = parameters_of(system, asked.free, asked.noise, channels).with_priors(asked.priors or {})
        windows, slices = cut(
            system,
            trials,
            window,
            channels,
            has_defects=nuisance.has_defects,
            reach=reach_of(trials, parameters, nuisance),
            step=simulation.step,
            guess=starts.guess,
        )
        varying = any(np.ptp(x) > 0 for t in trials for x in t.inputs.values())
        model = Model(
            system=system,
            parameters=parameters,
            nuisance=nuisance,
            settings=simulation.settings(windows.t[0], varying or of_noise is not None),
            channels=channels,
            driven=driven,
            zero_order_hold=held,
            assembled=starts.moved,
            quaternions=starts.quaternions,
            noise=of_noise,
        )
        if asked.processes:
            check_same(model, windows)
        problem = cls(model, windows, windows.by_trial, trials, slices, asked)
        problem.check_system(problem.start)
        return problem.finer(problem.start) if problem.chooses_steps else problem

    def check_system(self, point: Unknowns) -> None:
        """Refuse a description that contradicts itself, and bodies that cannot be, where the first window starts.

        Where the constraints cannot be met there is nothing to check: a fit says of which windows.
        """
        first = jax.tree.map(lambda x: x[0], self.windows)
        with contextlib.suppress(NoConfiguration):
            self.model.consistent(first, point.z[0], point.x)  # which checks the system there

    @property
    def cost_name(self) -> str:
        """For tables."""
        return "sum of squares" if self.model.noise is None else "-2 log likelihood"

    @property
    def chooses_steps(self) -> bool:
        """Whether fixed steps of integration are halved until they are fine enough: where no step was given."""
        given = self.specification.simulation
        return step_halving.has_steps(self) and (given is None or given.step is None)

    @property
    def processes(self) -> bool:
        return self.specification.processes

    def finer(self, point: Unknowns) -> Problem:
        """The problem with steps halved where that changes what is simulated at a point by more than a share of the
        noise."""
        return step_halving.finer(self, point)

    @property
    def step_tolerance(self) -> float:
        """By how much halving the step may move all residuals of one window together, in standard deviations."""
        return step_halving.step_tolerance(self)

    def step_errors(self, point: Unknowns, now: np.ndarray | None = None) -> np.ndarray:
        """By how much halving the step moves all residuals of every window (W,) together, in standard deviations; NaN
        where a window is not simulated to its end, or where the step follows from tolerances.

        `now`: what is simulated at the point, where that is known.
        """
        return step_halving.step_errors(self, point, now)

    def with_steps(self, step: Array) -> Problem:
        """The same problem with other steps of integration (W,) [s]; nothing is compiled anew."""
        return dataclasses.replace(self, windows=eqx.tree_at(lambda w: w.step, self.windows, step))

    @property
    def system(self) -> System:
        return self.model.system

    @property
    def parameters(self) -> Parameters:
        return self.model.parameters

    @property
    def channels(self) -> tuple[str, ...]:
        return self.model.channels

    @property
    def start(self) -> Unknowns:
        """No parameter changed, no bias, every window starts as it was measured."""
        p, T, W = len(self.parameters.entries), len(self.trials), len(self.slices)
        zeros = lambda *shape: jnp.zeros(shape, self.windows.t.dtype)  # noqa: E731
        return Unknowns(zeros(p), zeros(T, len(self.model.nuisance.trial)), zeros(W, len(self.model.nuisance.start)))

    def at(self, values: Mapping[str, float], point: Unknowns | None = None) -> Unknowns:
        """The point with these values of parameters, by name; the rest as in `point`, by default as at the start.

        **Raises:** `ValueError` for a value outside its bounds, or that no body can have.
        """
        point = self.start if point is None else point
        wrong = sorted(set(values) - set(self.parameters.names))
        if wrong:
            raise ValueError(f"{', '.join(wrong)} is not free; {', '.join(self.parameters.names)} are.")
        now = self.parameters.values(point.x)
        for name, value in values.items():
            now = now.at[self.parameters.names.index(name)].set(float(value))
        x = self.parameters.inverse(now)
        if not bool(jnp.all(jnp.isfinite(x))):
            bad = [n for n, ok in zip(self.parameters.names, np.isfinite(np.asarray(x)), strict=True) if not ok]
            raise ValueError(f"{', '.join(bad)}: these values are outside their bounds, or no body can have them.")
        return eqx.tree_at(lambda p: p.x, point, x)

    @property
    def active_windows(self) -> np.ndarray:
        """Whether a window (W,) holds a measurement that counts, or stands between such."""
        own = np.asarray(jnp.any(self.windows.weight > 0, axis=(1, 2)))
        if not self.model.nuisance.has_defects:
            return own
        owner = np.asarray(self.windows.trial)
        return np.isin(owner, owner[own])

    @property
    def clusters(self) -> int:
        """The number of trials that count."""
        return len(np.unique(np.asarray(self.windows.trial)[self.active_windows]))

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of residuals, priors and links among them, and of unknowns."""
        n, seen, T = self.model.nuisance, self.active_windows, self.clusters
        finite = lambda x: int(np.isfinite(np.asarray(x)).sum())  # noqa: E731
        residuals = int(jnp.sum(self.windows.weight > 0)) + finite(self.parameters.prior_deviation)
        residuals += (T if n.has_defects else int(seen.sum())) * finite(n.start_deviation) + T * finite(
            n.trial_deviation
        )
        residuals += int(np.asarray(self.windows.linked)[seen].sum()) * finite(n.jump)
        residuals += int(seen.sum()) * len(self.model.norms)
        unknowns = len(self.parameters.entries) + T * len(n.trial) + int(seen.sum()) * len(n.start)
        return residuals, unknowns

    def trajectories(self, point: Unknowns) -> list[Trajectory]:
        """The motion of every window, in the order of `slices`."""
        rides = rides_of(self.model, self.windows, point, starts_of(self.model, self.windows, point)[0])
        return [
            jax.tree.map(lambda x, i=i, n=n: x[i, :n] if x.ndim > 1 else x[i], rides)
            for i, (_, _, n) in enumerate(self.slices)
        ]

    def shortened(self, samples: Any) -> Problem:
        """The same problem with only the first `samples` (W,) of every window; nothing is compiled anew."""
        windows, whole = self.windows, np.array([n for _, _, n in self.slices])
        if np.all(np.asarray(samples) >= whole):
            return self
        keep = jnp.asarray(samples, dtype=jnp.int32)[:, None]  # (W, 1)
        inside = jnp.arange(windows.t.shape[1], dtype=jnp.int32)[None, :] < keep  # (W, n_t)
        t = jnp.where(inside, windows.t, jnp.take_along_axis(windows.t, keep - 1, axis=1))
        t = jnp.where(jnp.asarray(samples >= whole)[:, None], windows.t, t)
        weight = jnp.where(inside[:, None, :], windows.weight, 0.0)
        linked = jnp.where(jnp.asarray(samples >= whole), windows.linked, 0.0)
        new = eqx.tree_at(lambda w: (w.t, w.weight, w.linked), windows, (t, weight, linked))
        return dataclasses.replace(self, windows=new)

    def only(self, trials: Collection[int]) -> Problem:
        """The same problem in which only these trials (by number) count; nothing is compiled anew."""
        counts = jnp.isin(self.windows.trial, jnp.asarray(sorted(trials), dtype=self.windows.trial.dtype))
        weight = jnp.where(counts[:, None, None], self.windows.weight, 0.0)
        linked = jnp.where(counts, self.windows.linked, 0.0)
        new = eqx.tree_at(lambda w: (w.weight, w.linked), self.windows, (weight, linked))
        return dataclasses.replace(self, windows=new)

    def with_trials(self, trials: Sequence[Trial] | Trial) -> Problem:
        """The same question, asked of other trials."""
        return Problem.posed(self.specification, trials)

    def asking(self, other: ProblemSpec) -> Problem:
        """Another question, asked of the same trials, of which the same count, with the same steps of integration."""
        counted = np.unique(np.asarray(self.windows.trial)[self.active_windows])
        return Problem.posed(other, self.trials).with_steps(self.windows.step).only(counted.tolist())

    def without_defects(self) -> Problem:
        """The same problem in which every window starts freely; nothing is compiled anew."""
        windows = eqx.tree_at(lambda w: w.linked, self.windows, jnp.zeros_like(self.windows.linked))
        return dataclasses.replace(self, windows=windows)

    def with_priors(self, priors: Mapping[str, Prior]) -> Problem:
        """The same problem with priors (mean, standard deviation) of parameters by name; nothing is compiled anew."""
        model = eqx.tree_at(lambda m: m.parameters, self.model, self.parameters.with_priors(priors))
        return dataclasses.replace(self, model=model, specification=self.specification.with_priors(priors))
