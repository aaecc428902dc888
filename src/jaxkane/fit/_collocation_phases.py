"""A fit as phases of a nonlinear program: one phase for each trial, and the squares of its residuals and priors."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from numpy.typing import ArrayLike

from .._collocate.functions import Bound, Variables
from .._collocate.lobatto import Lobatto
from .._collocate.program import Block, EvaluatedBlock
from .._collocate.transcription import Builder, Layout, Motion, PhaseProblem, nodes_of
from .._integrate.inputs import Samples, inputs_at
from .._kane.right_hand_side import vector_field
from .._scalarjit.cache_key import jit
from .._system.system import System, unpacked
from .problem.model import Model, Nuisance
from .problem.parameters import Parameters
from .problem.problem import Problem
from .problem.trial import Trial
from .problem.windows import Windows

DELAY = "delay of input"


class TrialParameters(eqx.Module):
    """Maps from [shared parameters (p,), unknowns of the trial (n_b,)] to a system and its calibration."""

    parameters: Parameters
    nuisance: Nuisance
    applies: Array

    @property
    def size(self) -> int:
        return self.parameters.size + self.nuisance.trial_center.size

    def apply(self, system: System, x: Array) -> tuple[System, dict[tuple[str, str], Array]]:
        n = self.parameters.size
        system, calibration = self.parameters.apply(system, x[:n], self.applies)
        return system, self.nuisance.with_local(calibration, x[n:])


class TrialVariables(Variables):
    """The variables of a node of a trial, whose recorded inputs have gains, offsets and delays.

    - `model`, `window`: the model of the fit, and the trial as one window.
    """

    model: Model
    window: Windows

    def at(self, node: PyTree, x: Array) -> tuple[System, Array, Array, Array, dict[str, Array]]:
        y, w, rest = x[: self.n_y], x[self.n_y : self.n_z], x[self.n_z :]
        duration = jnp.asarray(self.duration)
        t = self.origin + node["s"] * duration
        system, calibration = self.parameters.apply(self.system, rest)
        inputs = {}
        if any(kind == DELAY for kind, _ in calibration):  # the samples depend on the delay
            signals = self.model.signals(self.window, calibration)
            inputs = inputs_at(system, signals, t, unpacked(system, y))
        else:
            for name in system.inputs:
                gain = calibration.get(("gain of input", name), 1.0)
                offset = calibration.get(("offset of input", name), 0.0)
                inputs[name] = gain * node["inputs"].get(name, jnp.zeros_like(t)) + offset
        inputs |= {name: inputs.get(name, 0.0) + w[i] for i, name in enumerate(self.controls)}
        inputs |= {name: jnp.zeros_like(t) for name in system.inputs if name not in inputs}
        return system, duration, t, y, inputs


class Squares(eqx.Module):
    """The sum of the squared residuals of one sample (1,)."""

    variables: TrialVariables

    def __call__(self, data: PyTree, x: Array) -> Array:
        variables, node = self.variables, data["node"]
        now = variables.now(node, x)
        _, calibration = variables.parameters.apply(variables.system, x[variables.n_z :])
        read = variables.model.as_read([now[c] for c in variables.model.channels], calibration)
        # `where`, because zero times NaN is NaN.
        residual = jnp.where(data["weight"] > 0, (read - data["measured"]) * data["weight"], 0.0)
        return jnp.sum(residual**2)[None]


class Priors(eqx.Module):
    """The squares of the priors of the shared parameters (1,)."""

    parameters: Parameters

    def __call__(self, data: PyTree, x: Array) -> Array:
        return jnp.sum(jnp.asarray(self.parameters.prior_residuals(x)) ** 2)[None]


class Deviations(eqx.Module):
    """The squares of values relative to their prior means and standard deviations (1,)."""

    mean: Array
    deviation: Array

    def __call__(self, data: PyTree, x: Array) -> Array:
        return jnp.sum(((x - self.mean) / self.deviation) ** 2)[None]


@dataclasses.dataclass(frozen=True)
class TrialPhase(PhaseProblem):
    """One trial as a phase (see `PhaseProblem`), from the first sample of its window on.

    - `problem`: the problem of the fit. `k`: the index of the window. A trial without measurements has no window.
    - `unknown_inputs`: spectral densities by name. `within`: bounds by name.
    """

    problem: Problem
    k: int
    unknown_inputs: Mapping[str, float]
    within: Mapping[str, Bound]

    # Unknown inputs have independent values at the points of each interval, so that their integrals over intervals are
    # independent. With continuous inputs, those of neighbouring intervals were correlated, and an inertia was 8 % too
    # small. With one value in each interval, the variance of an angle after it was S h^3 / 4 instead of S h^3 / 3, and
    # the standard errors of a bicycle were 6 % too small.
    is_piecewise = True

    @functools.cached_property
    def trial(self) -> Trial:
        """The samples of the window: with `Delay(bounds=...)`, it begins later than the trial."""
        owner, first, n = self.problem.slices[self.k]
        whole = self.problem.trials[owner]
        return whole.between(whole.t[first], whole.t[first + n - 1])

    @property
    def window(self) -> Windows:
        return jax.tree.map(lambda x: x[self.k], self.problem.windows)

    @property
    def system(self) -> System:
        return self.problem.system

    @property
    def title(self) -> str:
        return self.trial.name

    @property
    def durations(self) -> Bound:
        duration = float(self.trial.t[-1] - self.trial.t[0])
        return duration, duration

    @property
    def bounds_of_controls(self) -> dict[str, Bound]:
        return dict.fromkeys(self.unknown_inputs, (-math.inf, math.inf))

    @property
    def limits(self) -> dict[str, Bound]:
        return {**self.bounds_of_controls, **self.within}

    @property
    def ends(self) -> dict[str, dict[str, float]]:
        """The states that are not `unknown` start at their given or measured values."""
        free = {*self.problem.model.nuisance.start, *self.system.dependent_coordinates}
        if self.problem.model.assembled is not None:
            free |= {*self.problem.model.assembled}
        start = dict(zip(self.names, np.asarray(self.window.start, float).tolist(), strict=True))
        return {"start": {name: value for name, value in start.items() if name not in free}, "end": {}}

    @property
    def signals(self) -> dict[str, Samples]:
        ts = jnp.asarray(self.trial.t)
        return {name: Samples(ts, jnp.asarray(x)) for name, x in self.trial.inputs.items()}

    @property
    def parameters(self) -> TrialParameters:
        model = self.problem.model
        return TrialParameters(model.parameters, model.nuisance, self.window.applies)

    @property
    def n_local(self) -> int:
        return self.problem.model.nuisance.trial_center.size

    def variables(self) -> TrialVariables:
        return TrialVariables(
            system=self.system,
            signals={},
            parameters=self.parameters,
            duration=jnp.asarray(self.durations[0]),
            origin=jnp.asarray(float(self.trial.t[0])),
            controls=tuple(self.unknown_inputs),
            n_y=len(self.names),
            model=self.problem.model,
            window=self.window,
        )

    def mesh(self, intervals_per_sample: int) -> np.ndarray:
        """The ends of intervals, as fractions of the duration: samples, and places between them."""
        s = (self.trial.t - self.trial.t[0]) / self.durations[0]
        places = np.arange(intervals_per_sample * (len(s) - 1) + 1) / intervals_per_sample
        return np.interp(places, np.arange(len(s)), s)


def add_squares(problem: Problem, densities: Array, every: int, builder: Builder, layouts: Sequence[Layout]) -> None:
    """Add the squares of residuals, unknown inputs and priors to the cost. `every`: nodes from sample to sample."""
    nuisance = problem.model.nuisance
    n = problem.parameters.size
    for k, layout in enumerate(layouts):
        window = jax.tree.map(lambda x, k=k: np.asarray(x)[k], problem.windows)
        count = problem.slices[k][2]
        places = np.arange(count) * every
        data = {
            "node": layout.node_data(layout.s[places]),
            "measured": np.nan_to_num(window.measured[:, :count].T),
            "weight": window.weight[:, :count].T,
        }
        variables: Any = layout.variables
        block = EvaluatedBlock(Block(Squares(variables), data, layout.columns[places], 1))
        builder.cost(block, np.ones(count))
        if densities.size:
            columns = layout.dynamics[1][:, variables.n_y : variables.n_z]
            durations = np.outer(np.diff(layout.mesh) * layout.problem.durations[0], builder.method.b).ravel()
            _add_deviations(builder, columns, np.zeros(densities.size), np.sqrt(densities), durations)
        names = layout.problem.names
        starts = np.asarray(nuisance.start_deviation)[: len(nuisance.start)]
        given = [i for i, deviation in enumerate(starts) if math.isfinite(deviation)]
        if given:
            at = np.array([names.index(nuisance.start[i]) for i in given])
            _add_deviations(builder, layout.node(0)[at][None], window.start[at], starts[given])
        if np.isfinite(nuisance.trial_deviation).any():
            own = np.isfinite(nuisance.trial_deviation)
            deviation = np.asarray(nuisance.trial_deviation)[own]
            _add_deviations(builder, layout.parameters[n:][own][None], np.zeros(deviation.size), deviation)
    if np.any(problem.parameters.has_prior):
        columns = layouts[0].parameters[:n][None]
        builder.cost(EvaluatedBlock(Block(Priors(problem.parameters), np.zeros((1, 0)), columns, 1)), np.ones(1))


def _add_deviations(
    builder: Builder, columns: np.ndarray, mean: ArrayLike, deviation: ArrayLike, weights: np.ndarray | None = None
) -> None:
    """Add the squares of variables (B, n) relative to their prior means and standard deviations (n,)."""
    block = Block(Deviations(jnp.asarray(mean), jnp.asarray(deviation)), np.zeros((len(columns), 0)), columns, 1)
    builder.cost(EvaluatedBlock(block), np.ones(1) if weights is None else weights)


def guessed(phase: TrialPhase, mesh: np.ndarray, method: Lobatto) -> Motion:
    """A motion from the measurements: measured states, speeds from measured coordinates, and integrated coordinates."""
    trial, system, names = phase.trial, phase.system, phase.names
    s = nodes_of(mesh, method)
    t = trial.t[0] + s * phase.durations[0]
    n_q, n_u = len(system.coordinates), len(system.speeds)
    Y = np.tile(np.asarray(phase.problem.starts(phase.problem.start))[phase.k], (len(s), 1))  # type: ignore[arg-type]
    measured = {name: y for name, y in trial.measured.items() if name in names and np.isfinite(y).any()}
    for name, samples in measured.items():
        seen = np.isfinite(samples)
        Y[:, names.index(name)] = np.interp(t, trial.t[seen], np.asarray(samples)[seen])
    W = np.zeros((len(s), len(phase.unknown_inputs)))
    known_q = [i for i in range(n_q) if names[i] in measured]
    free_u = [i for i in range(n_q, n_q + n_u) if names[i] not in measured]
    if known_q and free_u:  # speeds for which measured coordinates have their measured rates
        slopes = np.stack([np.gradient(_smoothed(Y[:, i]), t) for i in known_q], axis=1)
        rates, J = (np.asarray(x) for x in _coordinate_rates(system, jnp.asarray(t), jnp.asarray(Y)))
        for k in range(len(s)):
            change, *_ = np.linalg.lstsq(J[k][np.ix_(known_q, free_u)], slopes[k] - rates[k, known_q], rcond=1e-6)
            Y[k, free_u] += change
    rates = np.asarray(_coordinate_rates(system, jnp.asarray(t), jnp.asarray(Y))[0])
    for i in range(n_q):
        if names[i] not in measured:
            steps = 0.5 * (rates[1:, i] + rates[:-1, i]) * np.diff(t)
            Y[1:, i] = Y[0, i] + np.cumsum(steps)
    return Motion(s, phase.durations[0], Y, W)


def _smoothed(y: np.ndarray, half: int = 4) -> np.ndarray:
    """A moving mean, so that the derivative of a noisy record is a usable guess."""
    padded = np.concatenate([np.repeat(y[0], half), y, np.repeat(y[-1], half)])
    return np.convolve(padded, np.ones(2 * half + 1) / (2 * half + 1), mode="valid")


@jit
def _coordinate_rates(system: System, t: Array, Y: Array) -> tuple[Array, Array]:
    """q_dot (K, n_q) and its derivatives by all states (K, n_q, n)."""
    n_q = len(system.coordinates)

    def rates(y: Array, t: Array) -> Array:
        inputs = {name: jnp.zeros_like(t) for name in system.inputs}
        return vector_field(system, t, y, inputs)[:n_q]

    return jax.vmap(rates)(Y, t), jax.vmap(jax.jacfwd(rates))(Y, t)
