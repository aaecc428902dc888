"""The problem that a fit solves: its specification, and residuals, cost and steps of integration at a point."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._common.lookup import as_names, hint, real_number, refuse_unknown
from .._integrate.trajectory import Trajectory
from .._kane.assemble import AssemblyProblem, NoConfiguration, euler_parameters
from .._kane.constraints import has_configuration_constraints
from .._kane.rhs import output_names
from .._scalarjit.compat import on_device
from .._system.system import System
from ..estimate._process_noise import noise_of
from ._block_lsq import Blocks
from ._declarations import Prior
from ._linearize import (
    Linearization,
    blocks_by_all_processes,
    blocks_of,
    check_same,
    starts_of,
    trajectories_of,
)
from ._model import Model, Nuisance, Simulation, Unknowns
from ._parameters import Parameters, as_items, parameters_of
from ._trial import Trial, as_trials
from ._windows import Reach, Shape, Windows, WindowSlice, check_starts, cut, state_names

Names = Sequence[str] | Mapping[str, float | None]
"""Names, or names with the standard deviation of a Gaussian prior around the initial guess (None: no prior)."""


@dataclasses.dataclass(frozen=True)
class ProblemSpec:
    """All that specifies a `Problem` but its trials. `jaxkane.fit.fit` says what the arguments are."""

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
            raise ValueError("`defect_std` links the windows of a trial: give their length, `window` [s].")


F = TypeVar("F", bound=Callable[..., Any])


def with_options(function: F) -> F:
    """Put the options of a `ProblemSpec`, which a function takes as `**options`, into its signature."""
    signature, spec = inspect.signature(function), inspect.signature(ProblemSpec)
    parameters = list(signature.parameters.values())
    options = [p for p in spec.parameters.values() if p.kind is p.KEYWORD_ONLY and p.name not in signature.parameters]
    places = [i for i, p in enumerate(parameters) if p.kind in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]
    parameters[places[0] : places[0]] = options
    parameters = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return function


def refuse_other(value: Any, wanted: type, name: str, instead: str) -> None:
    """Functions before a fit take a `Problem`, those after it a `Fit`.

    **Raises:** `TypeError` for anything else.
    """
    if not isinstance(value, wanted):
        raise TypeError(f"{name} takes a {wanted.__name__}, as in {instead}; got {type(value).__name__}.")


def checked_trials(system: System, trials: Sequence[Trial]) -> tuple[str, ...]:
    """The channels of all trials."""
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


def deviations_by_name(names: Names) -> dict[str, float | None]:
    """Each name with its standard deviation, or None."""
    return dict(names) if isinstance(names, Mapping) else dict.fromkeys(as_names(names))


def checked_names(system: System, what: str, names: Any, known: Sequence[str]) -> dict[str, float]:
    """Names with the deviations of their priors."""
    names = deviations_by_name(names)
    wrong = [name for name in names if name not in known]
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` names {', '.join(wrong)}; {hint(wrong, known, 'it may name')}"
            + (" Dependent coordinates and speeds follow from the others." if what == "unknown" else "")
        )
    numbers = {}
    for name, deviation in names.items():
        label = f"`{what}`: the standard deviation of {name}"
        numbers[name] = float("inf") if deviation is None else real_number(deviation, label)
        if not numbers[name] > 0:
            raise ValueError(f"{label} must be positive, or None for no prior; got {deviation!r}.")
    return numbers


class StartAssembly(NamedTuple):
    """How the starts of windows are made to satisfy the constraints, by `assemble`.

    - `moved`: the coordinates that it moves, None for those that it moves of an array.
    - `quaternions`: places of every four Euler parameters that are named, which are brought to unit norm before.
    - `guess`: where coordinates start of which nothing is known, if not at zero.
    """

    moved: tuple[str, ...] | None
    quaternions: tuple[tuple[int, ...], ...]
    guess: dict[str, float]


def start_assembly(system: System, trials: Sequence[Trial], unknown: Sequence[str]) -> StartAssembly:
    """How coordinates that a trial does not give are computed.

    **Raises:** `ValueError` for a trial that says nothing of a coordinate which others fix.
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
                f"{trial.name} says nothing of {', '.join(missing)}, which other trials fix at their start: name it "
                f"in `initial`, or give {type(system).__name__} its `dependent_coordinates`."
            )
    return StartAssembly(None if len(named) == len(system.coordinates) else moved, quaternions, guess)


def nuisance_of(spec: ProblemSpec, channels: Sequence[str], sampled: Sequence[str]) -> Nuisance:
    """What is unknown beside the parameters; `sampled` are inputs with samples."""
    system = spec.system
    known = {
        "sensor_bias": channels,
        "sensor_gain": channels,
        "input_bias": system.inputs,
        "input_gain": sampled,
        "input_delay": sampled,
    }
    trial = {}
    for argument, names in known.items():
        where, kind = argument.split("_")
        for name, deviation in checked_names(system, argument, getattr(spec, argument), names).items():
            trial[f"{kind} of {where}", name] = deviation
    turned = {system.coordinates[i] for four in euler_parameters(system) for i in four}
    independent = tuple(c for c in system.coordinates if c not in system.dependent_coordinates or c in turned)
    start = checked_names(system, "unknown", spec.unknown, (*independent, *system.speeds, *system.states))
    defects = checked_names(system, "defect_std", spec.defect_std or {}, tuple(start))
    array = lambda numbers: on_device([*numbers], jnp.result_type(float))  # noqa: E731
    return Nuisance(
        start=tuple(start),
        trial=tuple(trial),
        has_defects=spec.defect_std is not None,
        start_deviation=array(start.values()),
        trial_deviation=array(trial.values()),
        defect_std=array(defects.get(name, float("inf")) for name in start),
    )


def reach_of(trials: Sequence[Trial], parameters: Parameters, nuisance: Nuisance) -> Reach | None:
    """By how much inputs may act late and early [s], as the bounds of their delays say; None where none is delayed.

    **Raises:** `ValueError` for a delay that may be longer than a trial.
    """
    if any(kind == "delay of input" for kind, _ in nuisance.trial):
        return np.inf, np.inf
    shortest = min(trials, key=lambda trial: np.ptp(trial.t))
    reaches = [(0.0, 0.0)]
    for entry, start, owner in zip(parameters.entries, np.asarray(parameters.start), parameters.owners, strict=True):
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


STEP_TOLERANCE = 0.05, 0.25
"""By how much halving the step of integration may move all residuals together, of a window and of all windows: it
bounds the bias of an estimate in its standard errors."""

MOST_SPARE_DERIVATIVES = 100_000
"""Of samples by parameters that are not free: they take about a tenth of a second, and to compile a program three."""

HALVINGS, STIFF_HALVINGS = 8, 5
"""Of a step between two samples, at most: what needs more is stiff or chaotic; and while the motion does not reach its
end."""


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
    room: Shape | None = None
    """Of the windows of a problem whose compiled program serves this one too, if it is large enough."""

    @classmethod
    @with_options
    def of(cls, system: System, trials: Sequence[Trial] | Trial, free: Any, **options: Any) -> Problem:
        """The problem that `jaxkane.fit.fit` solves, with the same arguments."""
        return cls.of_specification(ProblemSpec(system, free, **options), trials)

    @classmethod
    def of_specification(cls, spec: ProblemSpec, trials: Sequence[Trial] | Trial) -> Problem:
        problem = cls.with_first_steps(spec, trials)
        return problem.finer(problem.start) if problem.chooses_steps else problem

    @classmethod
    def with_first_steps(cls, spec: ProblemSpec, trials: Sequence[Trial] | Trial) -> Problem:
        """The problem whose steps of integration are those from sample to sample, and not yet `finer`."""
        system, simulation, trials = spec.system, spec.simulation or Simulation(), as_trials(trials)
        channels = checked_trials(system, trials)
        sampled = tuple(name for name in system.inputs if any(name in trial.inputs for trial in trials))
        nuisance = nuisance_of(spec, channels, sampled)
        noise = None
        if spec.noise is not None:
            if simulation.rtol is not None or simulation.atol is not None:
                raise ValueError(
                    "With `noise` a filter goes by steps of one length: give Simulation(step=...), or nothing, and the "
                    "step is halved until that changes nothing."
                )
            deviations = jnp.concatenate([nuisance.start_deviation, nuisance.trial_deviation])
            noise = noise_of(system, spec.noise, deviations, spec.window)
        starts = start_assembly(system, trials, nuisance.start)
        parameters = parameters_of(system, spec.free, spec.noise, channels).with_priors(spec.priors or {})
        windows, slices = cut(
            system,
            trials,
            spec.window,
            channels,
            has_defects=nuisance.has_defects,
            reach=reach_of(trials, parameters, nuisance),
            step=simulation.step,
            guess=starts.guess,
        )
        independent = (name for name in state_names(system) if name not in system.dependent_coordinates)
        check_starts(trials, slices, [name for name in independent if name not in nuisance.start])
        if noise is not None:  # a filter goes from sample to sample: a longer step is none, and half of it neither
            longest = np.max(np.diff(np.asarray(windows.t), axis=1), axis=1)
            windows = eqx.tree_at(lambda w: w.step, windows, on_device(np.minimum(windows.step, longest)))
        varying = any(np.ptp(x) > 0 for trial in trials for x in trial.inputs.values())
        model = Model(
            system=system,
            parameters=parameters,
            nuisance=nuisance,
            settings=simulation.settings(np.asarray(windows.t)[0], varying or noise is not None),
            channels=channels,
            sampled_inputs=sampled,
            zero_order_hold=tuple(checked_names(system, "zero_order_hold", spec.zero_order_hold, system.inputs)),
            assembled=starts.moved,
            quaternions=starts.quaternions,
            noise=noise,
        )
        if spec.processes:
            check_same(model, windows)
        problem = cls(model, windows, windows.by_trial, trials, slices, spec)
        problem.check_system(problem.start)
        return problem

    def check_system(self, point: Unknowns) -> None:
        """Refuse a description that contradicts itself, and bodies that cannot be, where the first window starts.

        Where the constraints cannot be met there is nothing to check: a fit says of which windows.
        """
        first, z = jax.tree.map(lambda x: np.asarray(x)[0], (self.windows, point.z))
        with contextlib.suppress(NoConfiguration):
            self.model.start(first, z, point.x)  # which checks the system there

    @property
    def cost_name(self) -> str:
        """For tables."""
        return "sum of squares" if self.model.noise is None else "-2 log likelihood"

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
        zeros = lambda *shape: on_device(np.zeros(shape, self.windows.t.dtype))  # noqa: E731
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
        own = np.any(np.asarray(self.windows.weight) > 0, axis=(1, 2))
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
        n, active, T = self.model.nuisance, self.active_windows, self.clusters
        finite = lambda x: int(np.isfinite(np.asarray(x)).sum())  # noqa: E731
        residuals = int(np.sum(np.asarray(self.windows.weight) > 0)) + finite(self.parameters.prior_deviation)
        residuals += (T if n.has_defects else int(active.sum())) * finite(n.start_deviation) + T * finite(
            n.trial_deviation
        )
        residuals += int(np.asarray(self.windows.linked)[active].sum()) * finite(n.defect_std)
        residuals += int(active.sum()) * len(self.model.norms)
        unknowns = len(self.parameters.entries) + T * len(n.trial) + int(active.sum()) * len(n.start)
        return residuals, unknowns

    def linearize(self, point: Unknowns) -> Linearization | None:
        """Residuals and their exact derivatives, by forward mode through the simulation; None where the constraints
        cannot be met at the start of a window."""
        model, windows, at = self._arguments(point)
        starts = _starts(model, windows, at)
        if starts is None:
            return None
        evaluate: Any = blocks_by_all_processes if self.specification.processes else blocks_of
        R, prediction = evaluate(model, windows, at, *starts)
        if windows.shape != self.windows.shape:
            W, n_t = self.windows.t.shape
            R, prediction = jax.tree.map(lambda x: on_device(np.asarray(x)[:W]), (R, prediction.until(n_t)))
        blocks = Blocks.of(self.model.nuisance, R, self.by_trial)
        if self.parameters.size < at.x.size:
            blocks = blocks.of_x(self.parameters.places)
        return Linearization(blocks, prediction)

    def _arguments(self, point: Unknowns) -> tuple[Model, Windows, Unknowns]:
        """What compiled programs take, which depend on the shape of the windows alone: the unknowns of its trial stand
        beside each. With `room` they are as many, and as long, as those of another problem. A subset of parameters runs
        the program of all of them, where compiling one for fewer takes longer than the derivatives that it spares."""
        model, windows, x, owner = self.model, self.windows, point.x, np.asarray(self.windows.trial)
        b, z = np.asarray(point.b)[owner], point.z
        if self.room is not None and self.room != windows.shape and self.room.holds(windows.shape):
            windows, rows = windows.padded(self.room), np.minimum(np.arange(self.room.windows), len(owner) - 1)
            b, z = b[rows], on_device(np.asarray(z)[rows])
        windows = dataclasses.replace(windows, trial=on_device(np.arange(len(b)), np.int32))
        spare = self.parameters.rest.size - self.parameters.size
        if 0 < spare * windows.t.size <= MOST_SPARE_DERIVATIVES:
            model, x = eqx.tree_at(lambda m: m.parameters, model, self.parameters.whole), self.parameters.all(x)
        return model, windows, Unknowns(x, on_device(b), z)

    def cost(self, point: Unknowns) -> float:
        """Sum of squares, with process noise minus twice the log likelihood; NaN or infinite where a window could not
        be simulated."""
        at = self.linearize(point)
        return float("nan") if at is None else at.cost

    def simulated(self, point: Unknowns) -> np.ndarray:
        """What the sensors would have measured (W, n_c, n_t), with process noise followed by its deviations (W, 2 n_c,
        n_t); NaN where that cannot be simulated."""
        at = self.linearize(point)
        if at is None:
            number = 1 if self.model.noise is None else 2
            return np.full(np.tile(self.windows.measured, (1, number, 1)).shape, np.nan)
        return at.prediction.with_deviations

    def without_start(self, point: Unknowns) -> np.ndarray:
        """Whether the constraints can be met nowhere near the start of a window (W,)."""
        missing = []
        for i in range(len(self.slices)):
            windows, z = jax.tree.map(lambda x, i=i: np.asarray(x)[i : i + 1], (self.windows, point.z))
            alone = dataclasses.replace(self, windows=windows)
            missing.append(alone.starts(Unknowns(point.x, point.b, z)) is None)
        return np.array(missing)

    def starts(self, point: Unknowns) -> Array | None:
        """Where windows start (W, n), dependent coordinates among it; None where the constraints cannot be met."""
        starts = _starts(*self._arguments(point))
        return None if starts is None else starts[0][: len(self.slices)]

    def trajectories(self, point: Unknowns) -> list[Trajectory]:
        """The motion of every window, in the order of `slices`."""
        rides = trajectories_of(self.model, self.windows, point, self.starts(point))
        return [
            jax.tree.map(lambda x, i=i, n=n: x[i, :n] if x.ndim > 1 else x[i], rides)
            for i, (_, _, n) in enumerate(self.slices)
        ]

    def shortened(self, samples: Any) -> Problem:
        """The same problem with only the first `samples` (W,) of every window; nothing is compiled anew."""
        windows, whole = self.windows, np.array([n for _, _, n in self.slices])
        if np.all(np.asarray(samples) >= whole):
            return self
        return dataclasses.replace(self, windows=windows.shortened(np.asarray(samples), whole))

    def only(self, trials: Collection[int]) -> Problem:
        """The same problem in which only these trials (by number) count; nothing is compiled anew."""
        windows = self.windows.where(np.isin(np.asarray(self.windows.trial), sorted(trials)))
        return dataclasses.replace(self, windows=windows)

    def with_trials(self, trials: Sequence[Trial] | Trial) -> Problem:
        """The same specification with other trials."""
        return Problem.of_specification(self.specification, trials)

    def point_of(self, point: Unknowns, trials: Sequence[int]) -> Unknowns:
        """A point of this problem, as one of the problem with these of its trials."""
        own = np.isin(np.asarray(self.windows.trial), trials)
        return Unknowns(point.x, *(on_device(np.asarray(x)[i]) for x, i in ((point.b, [*trials]), (point.z, own))))

    def by_trials(self, room: Shape | None = None) -> list[Problem]:
        """A problem of every trial, for all of which one program is compiled: a trial of fewer windows repeats its last
        one, which counts nothing. `room`: of the windows of another problem, whose program they may run."""
        owner, problems = np.asarray(self.windows.trial), []
        most = np.bincount(owner).max()
        for k, trial in enumerate(self.trials):
            own = np.flatnonzero(owner == k)
            i = np.append(own, np.full(most - len(own), own[-1]))
            windows = self.windows.of_one_trial(i, np.arange(most) < len(own))
            slices = tuple((0, *self.slices[j][1:]) for j in i)
            one = {"windows": windows, "by_trial": windows.by_trial, "trials": (trial,), "slices": slices}
            problems.append(dataclasses.replace(self, room=room, **one))
        return problems

    def with_specification(self, spec: ProblemSpec) -> Problem:
        """Another specification with the same trials, of which the same count, and the same steps of integration."""
        counted = np.unique(np.asarray(self.windows.trial)[self.active_windows])
        return Problem.of_specification(spec, self.trials).with_steps(self.windows.step).only(counted.tolist())

    def without_defects(self) -> Problem:
        """The same problem in which every window starts freely; nothing is compiled anew."""
        windows = eqx.tree_at(lambda w: w.linked, self.windows, jnp.zeros_like(self.windows.linked))
        return dataclasses.replace(self, windows=windows)

    def with_priors(self, priors: Mapping[str, Prior]) -> Problem:
        """The same problem with priors (mean, standard deviation) of parameters by name; nothing is compiled anew."""
        model = eqx.tree_at(lambda m: m.parameters, self.model, self.parameters.with_priors(priors))
        spec = dataclasses.replace(self.specification, priors={**(self.specification.priors or {}), **priors})
        return dataclasses.replace(self, model=model, specification=spec)

    @property
    def has_steps(self) -> bool:
        """Whether something follows from fixed steps: the motion, or what noise adds to it."""
        return self.model.settings.step is not None or self.model.noise is not None

    @property
    def chooses_steps(self) -> bool:
        """Whether fixed steps of integration are halved until they are fine enough: where no step was given."""
        simulation = self.specification.simulation
        return self.has_steps and (simulation is None or simulation.step is None)

    @property
    def step_tolerance(self) -> float:
        """By how much halving the step may move all residuals of one window together, in standard deviations."""
        one, together = STEP_TOLERANCE
        return min(one, together / len(self.slices) ** 0.5)

    def with_steps(self, step: Any) -> Problem:
        """The same problem with other steps of integration (W,) [s]; nothing is compiled anew."""
        return dataclasses.replace(self, windows=eqx.tree_at(lambda w: w.step, self.windows, on_device(step)))

    def step_errors(self, point: Unknowns, now: np.ndarray | None = None) -> np.ndarray:
        """By how much halving the step moves all residuals of every window (W,) together, in standard deviations; NaN
        where a window is not simulated to its end, or where the step follows from tolerances.

        `now`: what is simulated at the point, where that is known.
        """
        if not self.has_steps:
            return np.full(len(self.slices), np.nan)
        now = self.simulated(point) if now is None else now
        return self._distance(now, self.with_steps(np.asarray(self.windows.step) / 2).simulated(point))

    def finer(self, point: Unknowns) -> Problem:
        """The problem with steps halved where that changes what is simulated at a point by more than a share of the
        noise.

        An input that is linear between its samples has a kink at every sample, on which error control spends ten
        steps; a step from kink to kink meets none. Measured (the rides of a steered bicycle, 100 Hz, 1 s): 1300 steps
        at a tolerance of 1e-7 against 100 of Bosh3, which differ by 0.002 of the measurements' deviation.
        """
        problem, first, before = self, np.asarray(self.windows.step), self.simulated(point)
        going, last = np.full(len(self.slices), True), np.full(len(self.slices), np.inf)
        for halvings in range(HALVINGS):
            steps = np.asarray(problem.windows.step)
            half = steps / np.where(going, 2, 1).astype(steps.dtype)
            after = problem.with_steps(half).simulated(point)
            distance = self._distance(before, after)
            going &= ~(distance <= self.step_tolerance)
            # Where halving does not reduce the difference, no step is fine enough: the motion is chaotic. Where a
            # motion ends, it may have been stiff for the step.
            falls = np.isfinite(distance) & (distance <= last / 2)
            going &= (halvings < 2) | falls | (~np.isfinite(distance) & (halvings < STIFF_HALVINGS))
            if not going.any():
                break
            problem = problem.with_steps(np.where(going, half, steps))
            before, last = np.where(going[:, None, None], after, before), distance
        lost = ~np.all(np.isfinite(np.where(self._weights(before) > 0, before, 0.0)), axis=(1, 2))
        # What does not reach its end from the initial guess may do so from a better one: with steps as short as others
        # need.
        halvings = 0.0 if lost.all() else np.max(np.log2(np.asarray(first / problem.windows.step))[~lost])
        shortest = first / first.dtype.type(2.0**halvings)
        return problem.with_steps(np.where(lost, shortest, problem.windows.step))

    def _distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """The norm (W,) of a difference of simulations, in standard deviations; infinite where one of the two ended
        earlier, NaN where both did."""
        weight = self._weights(a)
        lost = [np.any((weight > 0) & ~np.isfinite(x), axis=(1, 2)) for x in (a, b)]
        with np.errstate(invalid="ignore"):
            norm = np.linalg.norm(np.where(weight > 0, (b - a) * weight, 0.0), axis=(1, 2))
        return np.where(lost[0] & lost[1], np.nan, np.where(lost[0] | lost[1], np.inf, norm))

    def _weights(self, simulated: np.ndarray) -> np.ndarray:
        """One over the standard deviations of what `simulated` gives."""
        weight = np.asarray(self.windows.weight)
        return np.tile(weight, (1, simulated.shape[1] // weight.shape[1], 1))


def _starts(*arguments: Any) -> tuple[Array, Array] | None:
    try:
        return starts_of(*arguments)
    except eqx.EquinoxRuntimeError:  # Newton's linear solver raises on what is not finite
        return None
