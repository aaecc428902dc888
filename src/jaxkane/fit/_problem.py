"""The residuals of a fit and their exact linearization. Knows windows, parameters, `simulate`; knows no optimizer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._assembly import assemble
from .._signals import Samples
from .._simulate import Settings, settings_for, solve
from .._system import State, System
from .._trajectory import Trajectory
from ._blocks import Blocks
from ._parameters import Parameters, parameters_of
from ._trial import Trial
from ._windows import Windows, cut


class Point(eqx.Module):
    """Where a fit stands: `x` (p,) the free parameters (see `Parameters`); `b` (T, n_b) sensor and input biases of
    every trial; `z` (W, n_z) unknown starts of every window."""

    x: Float[Array, " p"]
    b: Float[Array, "T n_b"]
    z: Float[Array, "W n_z"]


class Held(eqx.Module):
    """A signal that keeps each sample until the next: `ts`, `values` (n_t,)."""

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]

    def __call__(self, t: Array, state: Any = None) -> Array:
        # The end of a step is the beginning of the next sample, whichever way it was rounded.
        i = jnp.sum(self.ts <= t + 1e-4 * (self.ts[1] - self.ts[0])) - 1
        return self.values[jnp.clip(i, 0, self.ts.shape[0] - 1)]


class Nuisance(eqx.Module):
    """Unknowns that are not asked for: names, and standard deviations of their priors (infinite without one)."""

    start: tuple[str, ...] = eqx.field(static=True)
    sensors: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    start_deviation: tuple[float, ...] = eqx.field(static=True)
    bias_deviation: tuple[float, ...] = eqx.field(static=True)


class Problem(eqx.Module):
    """Trials, free parameters and nuisance values of one fit.

        residual = (simulated + bias - measured) / sigma

    Made by `Problem.of`; solved by `least_squares` or `gradient_descent`; looked at by `identifiability`.
    """

    system: System
    parameters: Parameters
    windows: Windows
    by_trial: Array
    nuisance: Nuisance
    settings: Settings
    trials: tuple[Trial, ...] = eqx.field(static=True)
    places: tuple[tuple[int, int, int], ...] = eqx.field(static=True)
    channels: tuple[str, ...] = eqx.field(static=True)
    held: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[tuple[str, Callable[[Trajectory], Array]], ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        system: System,
        trials: Sequence[Trial] | Trial,
        free: Any,
        *,
        unknown: Sequence[str] | Mapping[str, float | None] = (),
        sensor_bias: Sequence[str] | Mapping[str, float | None] = (),
        input_bias: Sequence[str] | Mapping[str, float | None] = (),
        hold: Sequence[str] = (),
        window: float | None = None,
        outputs: Mapping[str, Callable[[Trajectory], Array]] | None = None,
        rtol: float | None = None,
        atol: float | None = None,
        step: float | None = None,
        solver: diffrax.AbstractSolver | None = None,
        max_steps: int = 4096,
    ) -> Problem:
        """Pose a fit. The arguments are those of `jaxkane.fit.fit`."""
        trials = (trials,) if isinstance(trials, Trial) else tuple(trials)
        outputs = dict(outputs or {})
        channels = _checked_trials(system, trials, outputs)
        if window is not None and not window > 0:
            raise ValueError(f"`window` is a length of time [s], got {window}.")
        dtype = jnp.result_type(float)
        parameters = parameters_of(system, free)
        windows, places = cut(system, trials, window, channels, dtype)
        step = step if step is not None or rtol is not None else _sample_step(trials)
        settings = settings_for(
            windows.t[0],
            rtol=1e-6 if rtol is None else rtol,
            atol=atol,
            solver=solver if solver is not None else diffrax.Tsit5() if step is None else diffrax.Bosh3(),
            step=step,
            adjoint="forward",
            max_steps=max_steps,
        )
        owner = [k for k, _, _ in places]
        most = max(owner.count(k) for k in range(len(trials)))
        by_trial = np.full((len(trials), most), len(places))
        for k in range(len(trials)):
            own = [i for i, who in enumerate(owner) if who == k]
            by_trial[k, : len(own)] = own
        return cls(
            system=system,
            parameters=parameters,
            windows=windows,
            by_trial=jnp.asarray(by_trial, dtype=jnp.int32),
            nuisance=_nuisance(system, channels, unknown, sensor_bias, input_bias),
            settings=settings,
            trials=trials,
            places=places,
            channels=channels,
            held=_checked_names(system, "hold", hold, system.inputs),
            outputs=tuple(outputs.items()),
        )

    @property
    def start(self) -> Point:
        """No parameter changed, no bias, every window starts as it was measured."""
        p, T, W = len(self.parameters.entries), len(self.trials), len(self.places)
        dtype = self.windows.t.dtype
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        return Point(zeros(p), zeros(T, len(self.nuisance.bias_deviation)), zeros(W, len(self.nuisance.start)))

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of residuals and of unknowns."""
        start = self.start
        data = int(jnp.sum(self.windows.weight > 0))
        n = self.nuisance
        priors = sum(e.prior is not None for e in self.parameters.entries)
        priors += len(self.places) * int(np.isfinite(n.start_deviation).sum())
        priors += len(self.trials) * int(np.isfinite(n.bias_deviation).sum())
        return data + priors, start.x.size + start.b.size + start.z.size

    def consistent(self, window: Windows, z: Array, x: Array) -> Array:
        """The start (n_q + n_u,) of one window, its dependent coordinates found by `assemble`."""
        system, _ = self.parameters.apply(self.system, x)
        names = (*system.coordinates, *system.speeds)
        places = np.array([names.index(name) for name in self.nuisance.start], dtype=int)
        start = jnp.concatenate([window.q, window.u]).at[places].add(z)
        state = assemble(system, start[: len(system.coordinates)], start[len(system.coordinates) :], window.t[0])
        return jnp.concatenate([state.q, state.u])

    def simulate(self, window: Windows, start: Array, b: Array, x: Array) -> Trajectory:
        """One window's motion."""
        system, gains = self.parameters.apply(self.system, x)
        biases = dict(zip(self.nuisance.inputs, b[len(self.nuisance.sensors) :], strict=True))
        signals: dict[str, Any] = {}
        for i, name in enumerate(system.inputs):
            bias = biases.get(name, jnp.zeros((), x.dtype))
            if any(name in trial.inputs for trial in self.trials):
                samples = gains.get(name, jnp.ones((), x.dtype)) * window.inputs[i] + bias
                kind = Held if name in self.held else Samples
                signals[name] = kind(window.t_input, samples)
            elif name in biases:
                signals[name] = bias
        n_q = len(system.coordinates)
        return solve(system, State(start[:n_q], start[n_q:]), window.t, signals, self.settings)

    def residuals(self, window: Windows, start: Array, z: Array, b: Array, x: Array) -> tuple[Array, Any]:
        """Residuals of one window, priors included (m,); and what was simulated, biases included (n_c, n_t), with the
        simulation's status."""
        ride = self.simulate(window, start, b, x)
        outputs, n = dict(self.outputs), self.nuisance
        simulated = jnp.stack([outputs[c](ride) if c in outputs else ride[c] for c in self.channels])
        for i, name in enumerate(n.sensors):
            simulated = simulated.at[self.channels.index(name)].add(b[i])
        difference = jnp.where(window.weight > 0, (simulated - window.measured) * window.weight, 0.0)
        # A prior of infinite width is a row of zeros; a trial's prior is counted in its first window.
        of_start = z / jnp.asarray(n.start_deviation, z.dtype)
        of_trial = jnp.where(window.first, b / jnp.asarray(n.bias_deviation, b.dtype), 0.0)
        of_all = jnp.where(window.very_first, self.parameters.prior_residuals(x), 0.0)
        return jnp.concatenate([difference.ravel(), of_start, of_trial, of_all]), (simulated, ride.status)

    def trajectories(self, point: Point) -> list[Trajectory]:
        """The motion of every window, in the order of `places`."""
        rides = _rides(self, point, _starts(self, point)[0])
        return [
            jax.tree.map(lambda x, i=i, n=n: x[i, :n] if x.ndim > 1 else x[i], rides)
            for i, (_, _, n) in enumerate(self.places)
        ]

    def shortened(self, samples: Any) -> Problem:
        """The same problem with only the first `samples` (W,) of every window; nothing is compiled anew."""
        windows = self.windows
        keep = jnp.asarray(samples, dtype=jnp.int32)[:, None]  # (W, 1)
        inside = jnp.arange(windows.t.shape[1], dtype=jnp.int32)[None, :] < keep  # (W, n_t)
        t = jnp.where(inside, windows.t, jnp.take_along_axis(windows.t, keep - 1, axis=1))
        weight = jnp.where(inside[:, None, :], windows.weight, 0.0)
        return eqx.tree_at(lambda p: (p.windows.t, p.windows.weight), self, (t, weight))


class Linearization(eqx.Module):
    """A problem at a point: its blocks, what was simulated (W, n_c, n_t) and the status of every window (W,)."""

    blocks: Blocks
    simulated: Array
    status: Array

    @property
    def cost(self) -> float:
        """Sum of squares; NaN or infinite where a window could not be simulated."""
        return float(self.blocks.cost)

    @property
    def good(self) -> np.ndarray:
        """Whether a window (W,) has finite residuals and derivatives."""
        return np.all(np.isfinite(np.asarray(self.blocks.R)), axis=(1, 2))


def linearize(problem: Problem, point: Point) -> Linearization | None:
    """Residuals and their exact derivatives, by forward mode through the simulation; None where no start is found."""
    try:
        start, start_dot = _starts(problem, point)
    except RuntimeError:  # Newton's linear solver raises on what is not finite
        return None
    return _linearize(problem, point, start, start_dot)


@eqx.filter_jit
def _starts(problem: Problem, point: Point) -> tuple[Array, Array]:
    """Starts (W, n) and their derivatives (W, n, k-1) by z, b and x."""
    # A program of its own: inside that of the simulation Newton's method would be differentiated a tangent at a time.
    n_b = point.b.shape[1]

    def start_of(arguments):
        window, z = arguments
        start = lambda z, x: problem.consistent(window, z, x)  # noqa: E731
        by_z, by_x = jax.jacfwd(start, argnums=(0, 1))(z, point.x)
        return start(z, point.x), jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (problem.windows, point.z))


@eqx.filter_jit
def _linearize(problem: Problem, point: Point, starts: Array, starts_dot: Array) -> Linearization:
    n_z, n_b = point.z.shape[1], point.b.shape[1]

    def window_block(arguments):
        window, z, b, start, start_dot = arguments
        unit = jnp.eye(n_z + n_b + point.x.shape[0], dtype=z.dtype)
        directions = (start_dot.T, unit[:, :n_z], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

        def along(*direction):
            residuals = lambda *unknowns: problem.residuals(window, *unknowns)  # noqa: E731
            return jax.jvp(residuals, (start, z, b, point.x), direction, has_aux=True)

        r, J, more = jax.vmap(along, out_axes=(None, -1, None))(*directions)  # (m,), (m, k-1)
        A = jnp.column_stack([J, r])
        # The triangle says all that the (m, k) matrix says about least squares. QR of NaN is not everywhere NaN.
        bad = ~jnp.all(jnp.isfinite(A))
        A = jnp.concatenate([jnp.where(bad, 0.0, A), jnp.zeros((A.shape[1], A.shape[1]), A.dtype)])
        return jnp.where(bad, jnp.nan, jnp.linalg.qr(A, mode="r")), more

    windows = problem.windows
    each = (windows, point.z, point.b[windows.trial], starts, starts_dot)
    R, (simulated, status) = _each(problem, window_block, each)
    return Linearization(Blocks(R, windows.trial, problem.by_trial, n_z, n_b), simulated, status)


@eqx.filter_jit
def _rides(problem: Problem, point: Point, starts: Array) -> Trajectory:
    windows = problem.windows
    return _each(
        problem,
        lambda each: problem.simulate(each[0], each[1], each[2], point.x),
        (windows, starts, point.b[windows.trial]),
    )


def _each(problem: Problem, f: Callable[..., Any], windows: Any) -> Any:
    # One ride after another is fastest on a CPU, where a right-hand side is one scalar function; elsewhere all at once.
    batch = None if jax.default_backend() == "cpu" else len(problem.places)
    return jax.lax.map(f, windows, batch_size=batch)


def _checked_trials(system: System, trials: Sequence[Trial], outputs: Mapping[str, Any]) -> tuple[str, ...]:
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
            unknown = sorted(set(given) - set(known))
            if unknown:
                raise ValueError(
                    f"{trial.name}: {title} has no {what} {', '.join(unknown)}; there are {', '.join(known) or 'none'}."
                )
    return tuple(dict.fromkeys(channel for trial in trials for channel in trial.measured))


def _sample_step(trials: Sequence[Trial]) -> float | None:
    """The step between the samples of inputs, where there are any and it is the same everywhere [s].

    An input that is linear between its samples has a kink at every sample, on which error control spends ten steps;
    a step from kink to kink meets none. Measured (the rides of a steered bicycle, 100 Hz, 1 s): 1300 steps at a
    tolerance of 1e-7 against 100 of Bosh3, which differ by 0.002 of the measurements' deviation.
    """
    if not any(np.ptp(x) > 0 for trial in trials for x in trial.inputs.values()):
        return None
    steps = np.concatenate([np.diff(trial.t) for trial in trials])
    step = float(np.median(steps))
    return step if np.all(np.abs(steps - step) < 1e-3 * step) else None


def _checked_names(system: System, what: str, given: Any, known: Sequence[str]) -> tuple[str, ...]:
    given = (given,) if isinstance(given, str) else tuple(given)
    wrong = sorted(set(given) - set(known))
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` names {', '.join(wrong)}; it may name {', '.join(known) or 'nothing'}."
            + (" Dependent coordinates and speeds follow from the others." if what == "unknown" else "")
        )
    return given


def _nuisance(system: System, channels: Sequence[str], unknown: Any, sensors: Any, inputs: Any) -> Nuisance:
    groups = []
    held = tuple(c for c in system.coordinates if c not in system.dependent_coordinates)
    for what, given, known in (
        ("unknown", unknown, (*held, *system.speeds)),
        ("sensor_bias", sensors, channels),
        ("input_bias", inputs, system.inputs),
    ):
        given = (given,) if isinstance(given, str) else given
        given = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given)
        _checked_names(system, what, tuple(given), known)
        bad = [name for name, deviation in given.items() if deviation is not None and not deviation > 0]
        if bad:
            raise ValueError(f"`{what}`: the standard deviation of {bad[0]} must be positive, or None for no prior.")
        groups.append(
            {name: float("inf") if deviation is None else float(deviation) for name, deviation in given.items()}
        )
    start, sensor, inputs = groups
    return Nuisance(
        tuple(start), tuple(sensor), tuple(inputs), tuple(start.values()), (*sensor.values(), *inputs.values())
    )
