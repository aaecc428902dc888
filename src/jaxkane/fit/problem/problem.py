"""The problem that a fit solves: residuals, cost, linearization and integration steps at a point."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from ..._common.lookup import counted, refuse, refuse_unknown
from ..._integrate.jumps import refuse_jumps
from ..._integrate.trajectory import Trajectory
from ..._kane.arguments import refuse_multipliers
from ..._kane.consistent_state import NoConfiguration
from ..._scalarjit.compat import on_device
from ..._system.system import System
from ...estimate._filter_step import noise_of
from ..solve.linearization import (
    Blocks,
    Linearization,
    blocks_of,
    half_cost,
    starts_of,
    trajectories_of,
)
from .declarations import Delay, Items, LowPass
from .errors import Errors, errors_of
from .model import Model, Simulation, Unknowns
from .parameters import Parameters, Prior
from .specification import (
    ProblemSpec,
    checked_names,
    checked_trials,
    delay_range_of,
    delayed_inputs,
    nuisance_of,
    parameters_of,
    start_assembly,
    with_options,
)
from .trial import Trial, as_trials
from .windows import Shape, Windows, WindowSlice, check_starts, cut, state_names, state_sizes

MOST_SPARE_DERIVATIVES = 100_000
"""The maximum number of samples times superfluous parameters with which the program of all parameters is reused.

This many superfluous derivatives take about 0.1 s. Compiling a program for fewer parameters takes about 3 s.
"""

STEP_TOLERANCE = 0.05, 0.25
"""The largest norm of the change of the residuals by the integration error, in standard deviations: of one window, and
of all windows. It is an upper bound of the bias of an estimate, in standard errors."""

HALVINGS, STIFF_HALVINGS = 8, 5
"""The maximum number of times that a step is halved: in general, and while the simulation stops early. A system that
needs more is stiff or chaotic."""

SMALLEST_NOISE = 1e-6
"""The smallest assumed noise of a measurement, relative to the root mean square of the signal. Simulated measurements
do not contain noise. Their residuals are only integration errors, so they cannot be the reference for integration
errors."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """Trials, free parameters and nuisance values of one fit.

        residual = (gain * simulated + offset - measured) / sigma

    `Problem.of` creates a problem, `minimize` solves it, and `identifiability` analyses it.
    """

    model: Model
    windows: Windows
    by_trial: Array
    trials: tuple[Trial, ...]
    slices: tuple[WindowSlice, ...]
    specification: ProblemSpec
    program_shape: Shape | None = None
    """The shape of the windows of another problem. Its compiled program is reused if the own windows fit into it."""

    @classmethod
    @with_options
    def of(cls, system: System, trials: Sequence[Trial] | Trial, free: Items, **options: Any) -> Problem:
        """The problem that `jaxkane.fit.fit` solves, with the same arguments."""
        return cls.of_specification(ProblemSpec(system, free, **options), trials)

    @classmethod
    def of_specification(
        cls, spec: ProblemSpec, trials: Sequence[Trial] | Trial, parameters: Parameters | None = None
    ) -> Problem:
        problem = cls.with_first_steps(spec, trials, parameters)
        return finer(problem, problem.start) if problem.chooses_steps else problem

    @classmethod
    def with_first_steps(
        cls, spec: ProblemSpec, trials: Sequence[Trial] | Trial, parameters: Parameters | None = None
    ) -> Problem:
        """The problem with the first integration steps, from sample to sample, before `finer` refines them.

        `parameters`: those of a problem with the same specification, whose groups of trials may differ.
        """
        system, simulation, trials = spec.system, spec.simulation or Simulation(), as_trials(trials)
        channels = checked_trials(system, trials)
        sampled = tuple(name for name in system.inputs if any(name in trial.inputs for trial in trials))
        nuisance = nuisance_of(spec, channels, sampled)
        noise, common = None, [item for item in spec.free if not item.is_eliminated]
        given = [item for item in spec.free if isinstance(getattr(item, "prior", None), str)]
        adaptive = simulation.rtol is not None or simulation.atol is not None
        refuse(
            (
                not common,
                "`free` contains no parameter, or only terms with each='trial' or 'window'. Add the name of a "
                "parameter, such as 'IBxx'.",
            ),
            (
                spec.noise is not None and adaptive,
                "A fit with `noise` uses a filter with fixed steps, so `rtol` and `atol` cannot be used. Pass "
                "Simulation(step=...), or omit these options: the step is then halved until the result does not "
                "change.",
            ),
            (
                spec.noise is not None and given and parameters is None,
                f"{given}: distributions over groups are not supported together with `noise`. Pass "
                "prior=(mean, standard deviation).",
            ),
        )
        if spec.noise is not None:
            refuse_multipliers(system)
            refuse_jumps(system, "Fit with `noise`", "The filter cannot represent jumps. Omit `noise`.")
            deviations = jnp.concatenate([nuisance.start_deviation, nuisance.trial_deviation])
            noise = noise_of(system, spec.noise, deviations, spec.window)
        starts = start_assembly(system, trials, nuisance.start)
        # Delays and time constants of data range from microseconds to hours, so their scale is two sample intervals.
        scale = 2.0 * min(float(np.median(np.diff(trial.t))) for trial in trials)
        unscaled = [isinstance(item, (Delay, LowPass)) and item.scale is None for item in common]
        common = [dataclasses.replace(x, scale=scale) if n else x for x, n in zip(common, unscaled, strict=True)]
        if parameters is None:
            parameters = parameters_of(system, common, spec.noise, channels, trials, spec.constraints)
            parameters = parameters.with_priors(spec.priors or {})
        windows, slices = cut(
            system,
            trials,
            spec.window,
            channels,
            parameters.applies(trials),
            has_defects=nuisance.has_defects,
            delay_range=delay_range_of(trials, parameters, nuisance),
            step=simulation.step,
            guess=starts.guess,
            **dict(zip(("longest_delays", "before"), delayed_inputs(spec), strict=True)),
        )
        independent = (name for name in state_names(system) if name not in system.dependent_coordinates)
        check_starts(trials, slices, [name for name in independent if name not in nuisance.start])
        if noise is not None:  # the filter steps from sample to sample, so halving a longer step would not change it
            longest = np.max(np.diff(np.asarray(windows.t), axis=1), axis=1)
            windows = eqx.tree_at(lambda w: w.step, windows, on_device(np.minimum(windows.step, longest)))
            bound = (*nuisance.start, *system.dependent_coordinates, *(starts.moved or ()))
            sampled_starts = [name for name in state_names(system) if name not in bound]
            windows = windows.starting_at_samples(trials, channels, sampled_starts)
            noise = dataclasses.replace(noise, starts_at_samples=bool(np.any(np.asarray(windows.start_weight) > 0)))
        varying = any(np.ptp(x) > 0 for trial in trials for x in trial.inputs.values())
        model = Model(
            system=system,
            parameters=parameters,
            nuisance=nuisance,
            settings=simulation.settings(
                np.asarray(windows.t)[0], varying or noise is not None, state_sizes(system, trials)
            ),
            channels=channels,
            sampled_inputs=sampled,
            zero_order_hold=tuple(checked_names(system, "zero_order_hold", spec.zero_order_hold, system.inputs)),
            assembled=starts.moved,
            quaternions=starts.quaternions,
            noise=noise,
            errors=errors_of(spec.errors, trials, channels),
        )
        problem = cls(model, windows, windows.by_trial, trials, slices, spec)
        problem.check_system(problem.start)
        return problem

    def check_system(self, point: Unknowns) -> None:
        """Check the system at the initial state of the first window.

        If the constraints cannot be satisfied there, the check is skipped: the fit then reports the windows.

        **Raises:** an error of `assemble` if the system is inconsistent, or if a body is not physically possible.
        """
        first, z = jax.tree.map(lambda x: np.asarray(x)[0], (self.windows, point.window_starts))
        with contextlib.suppress(NoConfiguration):
            self.model.start(first, z, point.parameters)  # `assemble` checks the system

    @property
    def cost_name(self) -> str:
        return "-2 log likelihood" if self.model.has_likelihood else "sum of squares"

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
        """The initial guess: parameters of the system, unknowns of trials at their prior means (or initial guesses),
        and windows that start at their first measurements."""
        nuisance, T, W = self.model.nuisance, len(self.trials), len(self.slices)
        shapes = (self.parameters.size,), (T, len(nuisance.trial)), (W, len(nuisance.window_names))
        names = self.parameters.names, nuisance.trial_names, nuisance.window_names
        meaning = (*names, *(np.asarray(x).tobytes() for x in (self.parameters.start, self.parameters.scale)))
        return Unknowns(*(on_device(np.zeros(shape, self.windows.t.dtype)) for shape in shapes), meaning=meaning)

    def at(self, values: Mapping[str, float], point: Unknowns | None = None) -> Unknowns:
        """The point with given values of parameters.

        **Arguments:**

        - `values`: values by name of a parameter, in its unit.
        - `point`: the `Unknowns` from which all other values are taken; by default `start`.

        **Returns:** the `Unknowns`.

        **Raises:** `ValueError` for a name that is not free, a value outside its bounds, or an inertia that is not
        physically possible.
        """
        point = self.start if point is None else point
        refuse_unknown(values, self.parameters.names, "Not a free parameter:", "the free parameters are")
        now = self.parameters.values(point.parameters)
        for name, value in values.items():
            now = now.at[self.parameters.names.index(name)].set(float(value))
        x = self.parameters.inverse(now)
        bad = [n for n, ok in zip(self.parameters.names, np.isfinite(np.asarray(x)), strict=True) if not ok]
        words = "the values are outside their bounds, or the inertia is not physically possible. Pass other values."
        refuse((bad, f"{', '.join(bad)}: {words}"))
        return eqx.tree_at(lambda p: p.parameters, point, x)

    @property
    def active_windows(self) -> np.ndarray:
        """Whether a window (W,) is used in the fit: it contains measurements with weight, or, with `defect_std`,
        another window of its trial does."""
        own = np.any(np.asarray(self.windows.weight) > 0, axis=(1, 2))
        if not self.model.nuisance.has_defects:
            return own
        owner = np.asarray(self.windows.trial)
        return np.isin(owner, owner[own])

    @property
    def clusters(self) -> int:
        """The number of trials with active windows."""
        return len(np.unique(np.asarray(self.windows.trial)[self.active_windows]))

    @property
    def title(self) -> str:
        (n_r, n_unknown), n = self.size, len(self.parameters.entries)
        numbers = {"trial": len(self.trials), "window": len(self.slices), "residual": n_r, "parameter": n}
        parts = [counted(n, noun) for noun, n in {**numbers, "nuisance value": n_unknown - n}.items()]
        return f"{type(self.system).__name__}: {', '.join(parts)}"

    def __repr__(self) -> str:
        units = zip(self.parameters.names, self.parameters.units, strict=True)
        free = ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units)
        return f"Problem({self.title}. Free: {free}. Measured: {', '.join(self.channels)})"

    @property
    def size(self) -> tuple[int, int]:
        """The number of residuals, including priors and defects, and the number of unknowns."""
        n, own, T = self.model.nuisance, self.active_windows, self.clusters
        W, p = int(own.sum()), len(self.parameters.entries)
        deviations = self.parameters.prior_terms[2], n.start_deviation, n.trial_deviation, n.defect_std
        of_x, of_z, of_b, of_defect = (int(np.isfinite(np.asarray(x)).sum()) for x in deviations)
        residuals = int(np.sum(np.asarray(self.windows.weight) > 0)) + of_x + (T if n.has_defects else W) * of_z
        residuals += T * of_b + int(np.asarray(self.windows.linked)[own].sum()) * of_defect + W * len(self.model.norms)
        of_errors = 0 if self.model.errors is None else self.model.errors.n_estimated
        return residuals, p + T * len(n.trial) + W * len(n.window_names) + of_errors

    def log_density(self) -> Callable[[Unknowns], Array]:
        """The log posterior density, up to a constant, as a function of `Unknowns`.

            log p = -1/2 cost + log |det d values / d x|

        `Unknowns` are unconstrained, so every sample is inside the bounds and physically consistent. Priors are part of
        the cost. `sigma` is used as given, unless a factor of it is free. A parameter without a prior has a uniform
        density in its own unit. The function can be differentiated once, in forward or reverse mode.

            density = fit.problem.log_density()
            blackjax.nuts(density, ...)                                       # starts from fit.point
            numpyro.infer.NUTS(potential_fn=lambda point: -density(point))    # init_params=fit.point

        **Returns:** a function of `Unknowns`. It returns minus infinity if the simulation fails.
        """
        cost = half_cost(self.model, self.windows, self.by_trial)

        def density(point: Unknowns) -> Array:
            log_p = self.parameters.log_determinant(point.parameters) - cost(point)
            return jnp.where(jnp.isfinite(log_p), log_p, -jnp.inf)

        return density

    def linearize(self, point: Unknowns) -> Linearization | None:
        """Residuals and their exact derivatives, by forward-mode differentiation of the simulation; None if the
        constraints cannot be satisfied at the start of a window."""
        model, windows, at = self._arguments(point)
        starts = _starts(model, windows, at)
        if starts is None:
            return None
        R, prediction = blocks_of(model, windows, at, *starts)
        if windows.shape != self.windows.shape:
            W, n_t = self.windows.t.shape
            R, prediction = jax.tree.map(lambda x: np.asarray(x)[:W], (R, prediction))
            prediction = jax.tree.map(lambda x: on_device(x[..., :n_t] if x.ndim == 3 else x), prediction)
            R = on_device(R)
        blocks = Blocks.of(self.model, R, self.by_trial, point.parameters)
        if self.parameters.size < at.parameters.size:
            blocks = blocks.of_x(self.parameters.places)
        return Linearization(blocks, prediction)

    def _arguments(self, point: Unknowns) -> tuple[Model, Windows, Unknowns]:
        """The arguments of compiled programs, which depend only on the shape of the windows.

        Each window gets the unknowns of its trial. With `program_shape`, the windows are padded to the shape of another
        problem, to reuse its compiled program. A subset of parameters uses the program of all parameters if compiling a
        smaller one would take longer than computing the superfluous derivatives.
        """
        model, windows, x, owner = self.model, self.windows, point.parameters, np.asarray(self.windows.trial)
        b, z = np.asarray(point.trial_unknowns)[owner], point.window_starts
        shape = self.program_shape
        if shape is not None and shape != windows.shape and shape.holds(windows.shape):
            windows, rows = windows.padded(shape), np.minimum(np.arange(shape.windows), len(owner) - 1)
            b, z = b[rows], on_device(np.asarray(z)[rows])
        windows = dataclasses.replace(windows, trial=on_device(np.arange(len(b)), np.int32))
        spare = self.parameters.rest.size - self.parameters.size
        if 0 < spare * windows.t.size <= MOST_SPARE_DERIVATIVES:
            model, x = eqx.tree_at(lambda m: m.parameters, model, self.parameters.whole), self.parameters.all(x)
        return model, windows, Unknowns(x, on_device(b), z)

    def cost(self, point: Unknowns) -> float:
        """The sum of squares, or minus twice the log likelihood with process noise or error models. NaN or infinite if
        the simulation of a window fails."""
        at = self.linearize(point)
        return float("nan") if at is None else at.cost

    def simulated(self, point: Unknowns) -> np.ndarray:
        """Simulated measurements (W, n_c, n_t), NaN where the simulation fails. With process noise, predictions
        followed by their standard deviations (W, 2 n_c, n_t)."""
        at = self.linearize(point)
        if at is None:
            number = 1 if self.model.noise is None else 2
            return np.full(np.tile(self.windows.measured, (1, number, 1)).shape, np.nan)
        return at.prediction.with_deviations

    def without_start(self, point: Unknowns) -> np.ndarray:
        """Whether the constraints cannot be satisfied near the initial state of a window (W,)."""
        missing = []
        for i in range(len(self.slices)):
            windows, z = jax.tree.map(lambda x, i=i: np.asarray(x)[i : i + 1], (self.windows, point.window_starts))
            # One window at a time, because the exception that `_starts` catches does not identify the window.
            alone = dataclasses.replace(self, windows=windows)
            missing.append(alone.starts(Unknowns(point.parameters, point.trial_unknowns, z)) is None)
        return np.array(missing)

    def starts(self, point: Unknowns) -> Array | None:
        """Initial states of the windows (W, n), with dependent coordinates; None if the constraints cannot be
        satisfied."""
        starts = _starts(*self._arguments(point))
        return None if starts is None else starts[0][: len(self.slices)]

    def trajectories(self, point: Unknowns) -> list[Trajectory]:
        """The trajectory of every window, in the order of `slices`."""
        rides = trajectories_of(self.model, self.windows, dataclasses.replace(point, meaning=()), self.starts(point))
        return [
            jax.tree.map(lambda x, i=i, n=n: x[i, :n] if x.ndim > 1 else x[i], rides)
            for i, (_, _, n) in enumerate(self.slices)
        ]

    def shortened(self, samples: np.ndarray) -> Problem:
        """The same problem with only the first `samples` (W,) of every window. Nothing is recompiled."""
        windows, whole = self.windows, np.array([n for _, _, n in self.slices])
        if np.all(np.asarray(samples) >= whole):
            return self
        return dataclasses.replace(self, windows=windows.shortened(np.asarray(samples), whole))

    def only(self, trials: Collection[int]) -> Problem:
        """The same problem in which only these trials (by index) have weight. Nothing is recompiled."""
        windows = self.windows
        own = np.isin(np.asarray(windows.trial), sorted(trials))
        weight, linked = own[:, None, None] * np.asarray(windows.weight), own * np.asarray(windows.linked)
        windows = dataclasses.replace(windows, weight=on_device(weight), linked=on_device(linked))
        return dataclasses.replace(self, windows=windows)

    def with_trials(self, trials: Sequence[Trial] | Trial) -> Problem:
        """The same specification and parameters with other trials."""
        return Problem.of_specification(self.specification, trials, self.parameters)

    def point_of(self, point: Unknowns, trials: Sequence[int]) -> Unknowns:
        """Convert a point of this problem to the problem with a subset of its trials, given by index."""
        own = np.isin(np.asarray(self.windows.trial), trials)
        b, z = (on_device(np.asarray(x)[i]) for x, i in ((point.trial_unknowns, [*trials]), (point.window_starts, own)))
        return dataclasses.replace(point, trial_unknowns=b, window_starts=z)

    def parts(self, program_shape: Shape | None, most_added: int) -> list[tuple[Problem, list[int]]]:
        """Split this problem into parts of successive trials that can reuse the compiled program of another problem.

        **Arguments:**

        - `program_shape`: the shape of the windows of the other problem. Each part fits into it.
        - `most_added`: the maximum number of samples that padding may add.

        **Returns:** parts with the indices of their trials. The whole problem is one part if a trial does not fit, or
        if padding would add more samples.
        """
        owner, own, T = np.asarray(self.windows.trial), self.windows.shape, len(self.trials)
        counts = np.bincount(owner)
        if program_shape is None or not program_shape.holds(own._replace(windows=int(counts.max()))):
            return [(self, [*range(T)])]
        groups: list[list[int]] = [[]]
        for k in range(T):
            if counts[[*groups[-1], k]].sum() > program_shape.windows:
                groups.append([])
            groups[-1].append(k)
        if (len(groups) * program_shape.windows - own.windows) * program_shape.samples > most_added:
            return [(self, [*range(T)])]
        parts = []
        for group in groups:
            rows = np.flatnonzero(np.isin(owner, group))
            windows, trials = self.windows.of_rows(rows), tuple(self.trials[k] for k in group)
            slices = tuple((k - group[0], *rest) for k, *rest in (self.slices[i] for i in rows))
            part = dataclasses.replace(self, windows=windows, by_trial=windows.by_trial, trials=trials, slices=slices)
            parts.append((dataclasses.replace(part, program_shape=program_shape), group))
        return parts

    def with_specification(self, spec: ProblemSpec) -> Problem:
        """Another specification with the same trials, active trials, integration steps and standard deviations of
        distributions."""
        counted = np.unique(np.asarray(self.windows.trial)[self.active_windows])
        problem = Problem.of_specification(spec, self.trials).with_steps(self.windows.step)
        known = {name: d for (name, *_), d in zip(self.parameters.distributions, self.parameters.deviations)}
        own = zip(problem.parameters.distributions, problem.parameters.deviations, strict=True)
        problem = problem.with_deviations(np.array([known.get(name, d) for (name, *_), d in own]))
        return problem.as_fine_as(self).only(counted.tolist())

    def without_defects(self) -> Problem:
        """The same problem in which the initial state of every window is free. Nothing is recompiled."""
        windows = eqx.tree_at(lambda w: w.linked, self.windows, jnp.zeros_like(self.windows.linked))
        return dataclasses.replace(self, windows=windows)

    def with_priors(self, priors: Mapping[str, Prior]) -> Problem:
        """The same problem with other priors (mean, standard deviation) by name. Nothing is recompiled."""
        model = eqx.tree_at(lambda m: m.parameters, self.model, self.parameters.with_priors(priors))
        spec = dataclasses.replace(self.specification, priors={**(self.specification.priors or {}), **priors})
        return dataclasses.replace(self, model=model, specification=spec)

    def with_errors_of(self, other: Problem | None) -> Problem:
        """The same problem with the parameters of the error models of `other`, by channel. With None, the parameters
        are the initial ones. Nothing is recompiled."""
        if self.model.errors is None:
            return self
        errors = Errors.initial(self.model.errors.distributions)
        if other is not None and other.model.errors is not None:
            pairs = [(i, other.channels.index(c)) for i, c in enumerate(self.channels) if c in other.channels]
            to, of = (np.array(places, dtype=int) for places in zip(*pairs, strict=True))
            new = jax.tree.map(lambda x, y: x.at[to].set(y[of]), errors.numbers, other.model.errors.numbers)
            errors = Errors(errors.distributions, new)
        return dataclasses.replace(self, model=dataclasses.replace(self.model, errors=errors))

    def with_deviations(self, deviations: np.ndarray) -> Problem:
        """The same problem with these standard deviations of the distributions over groups. Nothing is recompiled."""
        model = eqx.tree_at(lambda m: m.parameters, self.model, self.parameters.with_deviations(deviations))
        return dataclasses.replace(self, model=model)

    @property
    def has_steps(self) -> bool:
        """Whether fixed steps are used, for the simulation or for the covariance of the process noise."""
        return self.model.settings.step is not None or self.model.noise is not None

    @property
    def chooses_steps(self) -> bool:
        """Whether fixed integration steps are halved until they are fine enough, because the user gave no step."""
        simulation = self.specification.simulation
        return self.has_steps and (simulation is None or simulation.step is None)

    def with_steps(self, step: ArrayLike) -> Problem:
        """The same problem with other integration steps (W,) [s]. Nothing is recompiled."""
        return dataclasses.replace(self, windows=eqx.tree_at(lambda w: w.step, self.windows, on_device(step)))

    def as_fine_as(self, other: Problem) -> Problem:
        """The same problem with the tolerances that the fit of another problem has chosen."""
        chosen = (self.specification.simulation or Simulation()).chooses and not self.has_steps
        return self.with_tolerances(other.model.settings.rtol) if chosen and not other.has_steps else self

    def with_tolerances(self, rtol: ArrayLike) -> Problem:
        """The same problem with another relative tolerance of adaptive steps. The absolute tolerances change by the
        same factor. Nothing is recompiled."""
        settings = self.model.settings
        rtol, before, atol = (np.asarray(x) for x in (rtol, settings.rtol, settings.atol))
        new = dataclasses.replace(settings, rtol=on_device(rtol), atol=on_device(atol * (rtol / before)))
        return dataclasses.replace(self, model=dataclasses.replace(self.model, settings=new))


def _starts(*arguments: Any) -> tuple[Array, Array] | None:
    try:
        return starts_of(*arguments)
    except eqx.EquinoxRuntimeError:  # the linear solver of Newton's method raises an exception if a value is not finite
        return None


# An input that is linear between its samples has a discontinuous slope at every sample. Error control takes ten steps
# there. A fixed step from sample to sample contains no discontinuity. Measured for rides of a steered bicycle (100 Hz,
# 1 s): 1300 adaptive steps at a tolerance of 1e-7, and 100 fixed steps of Bosh3. The results differ by 0.002 standard
# deviations of the measurements.


def residual_deviation(problem: Problem, squares: float) -> float:
    """The standard deviation of a residual in units of `sigma`, for a fit with this sum of squares."""
    (n_r, n_unknown), windows = problem.size, problem.windows
    if problem.model.noise is not None or n_r <= n_unknown:
        return 1.0
    weight = np.asarray(windows.weight)
    signal = np.linalg.norm(np.asarray(windows.measured) * weight) / max(np.count_nonzero(weight), 1) ** 0.5
    return max((squares / (n_r - n_unknown)) ** 0.5, SMALLEST_NOISE * float(signal))


def step_tolerance(problem: Problem) -> float:
    """The largest allowed norm of the change of one window's residuals by finer steps, in standard deviations."""
    one, together = STEP_TOLERANCE
    return min(one, together / len(problem.slices) ** 0.5)


def step_errors(problem: Problem, point: Unknowns, now: np.ndarray | None = None) -> np.ndarray:
    """The norm of the change of every window's residuals (W,) by finer steps, in units of `sigma`.

    Finer means half of a fixed step, or a tenth of the tolerances. The result is NaN if both simulations of a window
    fail, and infinite if one of them fails.

    `now`: the simulation at the point, if it was already computed.
    """
    before = problem.simulated(point) if now is None else now
    return _distance(problem, before, _with_finer(problem).simulated(point))


def _with_finer(problem: Problem) -> Problem:
    if problem.has_steps:
        return problem.with_steps(np.asarray(problem.windows.step) / 2)
    return problem.with_tolerances(np.asarray(problem.model.settings.rtol) / 10)


def finer(problem: Problem, point: Unknowns, deviation: float = 1.0) -> Problem:
    """The problem with finer steps.

    Fixed steps are halved, window by window, while this changes the simulation by more than a fraction of the noise.
    Tolerances are divided by ten, for all windows together.

    **Arguments:**

    - `problem`: the problem.
    - `point`: the `Unknowns` of the simulation.
    - `deviation`: the standard deviation of a residual, in units of `sigma`.
    """
    if not problem.has_steps:
        return _with_finer(problem)
    first, before = np.asarray(problem.windows.step), problem.simulated(point)
    going, last = np.full(len(problem.slices), True), np.full(len(problem.slices), np.inf)
    for halvings in range(HALVINGS):
        steps = np.asarray(problem.windows.step)
        half = steps / np.where(going, 2, 1).astype(steps.dtype)
        after = problem.with_steps(half).simulated(point)
        distance = _distance(problem, before, after)
        going &= ~(distance <= step_tolerance(problem) * deviation)
        # If halving does not reduce the difference, the motion is chaotic and no step is fine enough. If the simulation
        # stops early, the step may be too long for a stiff motion.
        falls = np.isfinite(distance) & (distance <= last / 2)
        going &= (halvings < 2) | falls | (~np.isfinite(distance) & (halvings < STIFF_HALVINGS))
        if not going.any():
            break
        problem = problem.with_steps(np.where(going, half, steps))
        before, last = np.where(going[:, None, None], after, before), distance
    lost = ~np.all(np.isfinite(np.where(_weights(problem, before) > 0, before, 0.0)), axis=(1, 2))
    # If the simulation of a window fails at the initial guess, it may succeed for better parameters. Such a window gets
    # the shortest step of the other windows.
    halvings = 0.0 if lost.all() else np.max(np.log2(np.asarray(first / problem.windows.step))[~lost])
    shortest = first / first.dtype.type(2.0**halvings)
    return problem.with_steps(np.where(lost, shortest, problem.windows.step))


def _distance(problem: Problem, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The norm of the difference of two simulations (W,), in units of `sigma`.

    The result is infinite if one of the two simulations failed, and NaN if both did.
    """
    weight = _weights(problem, a)
    lost = [np.any((weight > 0) & ~np.isfinite(x), axis=(1, 2)) for x in (a, b)]
    with np.errstate(invalid="ignore"):
        norm = np.linalg.norm(np.where(weight > 0, (b - a) * weight, 0.0), axis=(1, 2))
    return np.where(lost[0] & lost[1], np.nan, np.where(lost[0] | lost[1], np.inf, norm))


def _weights(problem: Problem, simulated: np.ndarray) -> np.ndarray:
    """One over the standard deviations of the measurements, repeated to the shape of `simulated`."""
    weight = np.asarray(problem.windows.weight)
    if problem.model.errors is not None:
        weight = weight / np.asarray(problem.model.errors.numbers.scale)[:, None]
    return np.tile(weight, (1, simulated.shape[1] // weight.shape[1], 1))
