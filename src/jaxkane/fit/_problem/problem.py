"""A fit that is posed: trials, windows, what is free and what is unknown. Knows names; knows no optimizer."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._description.system import System
from ..._method.assembly import NoConfiguration
from ..._simulation.trajectory import Trajectory
from .._data.trial import Trial, as_trials
from .._data.windows import Place, Windows, cut
from . import step_halving
from .arguments import Specification
from .entries import parameters_of
from .free import Prior
from .model import Model, Unknowns
from .names import checked_names, checked_trials, nuisance_of, reach_of, starts_found
from .noise import noise_of
from .parallel import check_same
from .parameters import Parameters
from .programs import rides_of, starts_of
from .simulation import Simulation


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
    places: tuple[Place, ...]
    specification: Specification

    @classmethod
    def of(
        cls,
        system: System,
        trials: Sequence[Trial] | Trial,
        free: Any,
        **options: Any,
    ) -> Problem:
        """Pose a fit. The arguments are those of `jaxkane.fit.fit`, from `unknown` to `simulation`."""
        return cls.posed(Specification(system, free, **options), trials)

    @classmethod
    def posed(cls, asked: Specification, trials: Sequence[Trial] | Trial) -> Problem:
        """What is asked, of these trials."""
        system, window, simulation = asked.system, asked.window, asked.simulation or Simulation()
        trials = as_trials(trials)
        channels = checked_trials(system, trials)
        driven = tuple(name for name in system.inputs if any(name in trial.inputs for trial in trials))
        nuisance = nuisance_of(asked, channels, driven)
        deviations = jnp.concatenate([nuisance.start_deviation, nuisance.trial_deviation])
        of_noise = noise_of(system, asked.noise, deviations, window, asked.continuity)
        held = tuple(checked_names(system, "hold", asked.hold, system.inputs))
        starts = starts_found(system, trials, nuisance.start)
        parameters = parameters_of(system, asked.free, asked.noise, channels).with_priors(asked.priors or {})
        windows, places = cut(
            system,
            trials,
            window,
            channels,
            chained=nuisance.chained,
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
            held=held,
            assembled=starts.moved,
            quaternions=starts.quaternions,
            noise=of_noise,
        )
        if asked.processes:
            check_same(model, windows)
        problem = cls(model, windows, windows.by_trial, trials, places, asked)
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
        p, T, W = len(self.parameters.entries), len(self.trials), len(self.places)
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
    def seen(self) -> np.ndarray:
        """Whether a window (W,) holds a measurement that counts, or stands between such."""
        own = np.asarray(jnp.any(self.windows.weight > 0, axis=(1, 2)))
        if not self.model.nuisance.chained:
            return own
        owner = np.asarray(self.windows.trial)
        return np.isin(owner, owner[own])

    @property
    def clusters(self) -> int:
        """The number of trials that count."""
        return len(np.unique(np.asarray(self.windows.trial)[self.seen]))

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of residuals, priors and links among them, and of unknowns."""
        n, seen, T = self.model.nuisance, self.seen, self.clusters
        finite = lambda x: int(np.isfinite(np.asarray(x)).sum())  # noqa: E731
        residuals = int(jnp.sum(self.windows.weight > 0)) + finite(self.parameters.prior_deviation)
        residuals += (T if n.chained else int(seen.sum())) * finite(n.start_deviation) + T * finite(n.trial_deviation)
        residuals += int(np.asarray(self.windows.linked)[seen].sum()) * finite(n.jump)
        residuals += int(seen.sum()) * len(self.model.norms)
        unknowns = len(self.parameters.entries) + T * len(n.trial) + int(seen.sum()) * len(n.start)
        return residuals, unknowns

    def trajectories(self, point: Unknowns) -> list[Trajectory]:
        """The motion of every window, in the order of `places`."""
        rides = rides_of(self.model, self.windows, point, starts_of(self.model, self.windows, point)[0])
        return [
            jax.tree.map(lambda x, i=i, n=n: x[i, :n] if x.ndim > 1 else x[i], rides)
            for i, (_, _, n) in enumerate(self.places)
        ]

    def shortened(self, samples: Any) -> Problem:
        """The same problem with only the first `samples` (W,) of every window; nothing is compiled anew."""
        windows, whole = self.windows, np.array([n for _, _, n in self.places])
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

    def asking(self, other: Specification) -> Problem:
        """Another question, asked of the same trials, of which the same count, with the same steps of integration."""
        counted = np.unique(np.asarray(self.windows.trial)[self.seen])
        return Problem.posed(other, self.trials).with_steps(self.windows.step).only(counted.tolist())

    def unchained(self) -> Problem:
        """The same problem in which every window starts freely; nothing is compiled anew."""
        windows = eqx.tree_at(lambda w: w.linked, self.windows, jnp.zeros_like(self.windows.linked))
        return dataclasses.replace(self, windows=windows)

    def with_priors(self, priors: Mapping[str, Prior]) -> Problem:
        """The same problem with priors (mean, standard deviation) of parameters by name; nothing is compiled anew."""
        model = eqx.tree_at(lambda m: m.parameters, self.model, self.parameters.with_priors(priors))
        return dataclasses.replace(self, model=model, specification=self.specification.with_priors(priors))
