"""The model of one window: integration settings, initial state, trajectory, sensors and residuals."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from ..._common.lookup import positive_number
from ..._integrate.inputs import Samples, share_times, since
from ..._integrate.integrate import solve
from ..._integrate.settings import Settings, settings_for, with_array_tolerances
from ..._integrate.trajectory import Trajectory
from ..._kane.consistent_state import assemble
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import on_device
from ..._system.system import State, System, packed, packed_motion, unpacked
from ...estimate._filter_step import Noise
from .errors import Errors
from .parameters import LOW_PASSES, Entry, Parameters
from .windows import Windows, state_names


@dataclasses.dataclass(frozen=True)
class Simulation:
    """The integration settings of a fit.

        fit(system, trials, free, simulation=Simulation(step=0.01))

    If inputs vary, or with `noise`, the default is Bosh3 with one step per sample interval. The step is halved until
    halving changes the simulation by less than a fraction of the noise. This check is made at the initial guess and at
    the result.

    Otherwise, the default is Tsit5 with adaptive steps. The relative tolerance is 1e-6. The absolute
    tolerance is 1e-8 times the size of each coordinate and speed. Both are divided by ten until the result changes
    little. `Fit.step_error` states the remaining integration error.

    **Arguments:**

    - `rtol`: the relative tolerance of adaptive steps.
    - `atol`: the absolute tolerance of adaptive steps.
    - `step`: a fixed step [s], the same in all windows. Pass either tolerances or a step, not both.
    - `solver`: a solver of diffrax.
    - `max_steps`: the maximum number of steps in a window. The default is the number of fixed steps, or 8192 with
        adaptive steps.

    **Raises:** `ValueError` if a number is not positive and finite, or if a step and a tolerance are both given.
    """

    rtol: float | None = None
    atol: float | None = None
    step: float | None = None
    solver: diffrax.AbstractSolver | None = None
    max_steps: int | None = None

    def __post_init__(self) -> None:
        for name in ("rtol", "atol", "step", "max_steps"):
            if getattr(self, name) is not None:
                positive_number(getattr(self, name), f"Simulation: `{name}`")
        if self.step is not None and (self.rtol is not None or self.atol is not None):
            raise ValueError(
                "Simulation: `step` is given together with `rtol` or `atol`. Pass `step` for fixed steps, or `rtol` "
                "and `atol` for adaptive steps."
            )

    @property
    def chooses(self) -> bool:
        """Whether the user gave neither a step nor a tolerance. The fit then refines them until they are fine
        enough."""
        return self.step is None and self.rtol is None and self.atol is None

    def settings(self, t: np.ndarray, varying: bool, sizes: np.ndarray) -> Settings:
        """The settings for the integrator.

        If the step is fixed, each window has its own step. Tolerances are arrays, so that other tolerances do not cause
        a recompilation.

        **Arguments:**

        - `t`: the times of a window (n_t,) [s].
        - `varying`: whether the inputs vary.
        - `sizes`: the size of each component of the state (n,), in its unit.
        """
        fixed = self.step is not None or (self.chooses and varying)
        solver = diffrax.Bosh3() if fixed else diffrax.Tsit5()
        solver = solver if self.solver is None else self.solver
        settings = settings_for(
            t,
            rtol=None if fixed else 1e-6 if self.rtol is None else self.rtol,
            atol=self.atol,
            solver=solver,
            # A placeholder: `Model.simulate` replaces it by the step of each window.
            step=1.0 if fixed else None,
            # With a fixed step, the default is the number of steps in a window.
            max_steps=self.max_steps if self.max_steps is not None or fixed else 8192,
        )
        if not fixed and self.atol is None:
            # The absolute tolerance must be relative to the size of the state: one in SI units would hide motions of
            # micrometres. Implicit solvers accept only a single number.
            atol = 1e-2 * settings.rtol * sizes
            implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
            settings = dataclasses.replace(settings, atol=on_device(atol.min() if implicit else atol, t.dtype))
        if not fixed:
            # Steps end at the samples of inputs, and a window may be as short as a few steps.
            settings = dataclasses.replace(settings, max_step=np.inf)
        return with_array_tolerances(settings, t.dtype)


Calibration = dict[tuple[str, str], Array]
"""Gains, offsets, delays and time constants that all trials share, by kind and name: ("gain of input", name)."""


class Unknowns(eqx.Module):
    """A point of the search.

    - `parameters` (p,): the unconstrained variables of the parameters (see `Parameters`).
    - `trial_unknowns` (T, n_b): the unknowns of every trial, such as the offsets of its sensors and inputs.
    - `window_starts` (W, n_z): the unknown part of the initial state of every window, relative to its initial guess,
        and gains and offsets of every window.
    - `meaning`: the names of all these, and the initial guesses and scales of the parameters; () if not known."""

    parameters: Float[Array, " p"]
    trial_unknowns: Float[Array, "T n_b"]
    window_starts: Float[Array, "W n_z"]
    meaning: tuple[Any, ...] = eqx.field(static=True, default=())


class Nuisance(eqx.Module):
    """The unknowns other than the parameters.

    - `start`: names of the unknown part of the initial state of a window.
    - `window`: gains and offsets with a separate value in every window.
    - `trial`: gains, offsets and delays with a separate value in every trial.
    - `has_defects`: whether the windows of a trial are linked by `defect_std`.
    - `start_deviation` (n_z,): standard deviations of the priors of `start` and `window`, infinite without a prior.
    - `window_center` (n_w,): values of `window` for z = 0.
    - `trial_center` (n_b,): values of the unknowns of a trial for b = 0.
    - `trial_deviation` (n_b,): standard deviations of their priors, infinite without a prior.
    - `defect_std` (n_z,): standard deviations of the defects between successive windows, infinite for free defects.
    """

    start: tuple[str, ...] = eqx.field(static=True)
    window: tuple[Entry, ...] = eqx.field(static=True)
    trial: tuple[Entry, ...] = eqx.field(static=True)
    has_defects: bool = eqx.field(static=True)
    start_deviation: Float[Array, " n_z"]
    window_center: Float[Array, " n_w"]
    trial_center: Float[Array, " n_b"]
    trial_deviation: Float[Array, " n_b"]
    defect_std: Float[Array, " n_z"]

    @property
    def window_names(self) -> tuple[str, ...]:
        return (*self.start, *(entry.name for entry in self.window))

    @property
    def trial_names(self) -> tuple[str, ...]:
        return tuple(entry.name for entry in self.trial)

    def with_local(self, calibration: Calibration, b: Array, z: Array | None = None) -> Calibration:
        """The common calibration, combined with the unknowns `b` of one trial and, if passed, `z` of one window."""
        merged, values = dict(calibration), [*zip(self.trial, self.trial_center + b, strict=True)]
        if z is not None:
            values += zip(self.window, self.window_center + z[len(self.start) :], strict=True)
        for entry, value in values:
            for role in entry.roles:
                combine = jnp.multiply if role[0].startswith("gain") else jnp.add
                merged[role] = combine(merged[role], value) if role in merged else value
        return merged


class Ramps(eqx.Module):
    """A delayed input under a zero-order hold, for fixed integration steps, which cannot end at its discontinuities.

    Each discontinuity is replaced by a linear ramp that is centred at its time. The value is then differentiable with
    respect to the delay.

    - `ts`: times of the discontinuities (n_t,) [s].
    - `values`: samples (n_t,).
    - `width`: the duration of a ramp [s], proportional to the integration step.
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]
    width: Float[Array, ""]

    def __call__(self, t: Array, state: State | None = None) -> Array:
        done = jnp.clip((t - self.ts[1:]) / self.width + 0.5, 0.0, 1.0)
        return self.values[0] + jnp.sum(done * jnp.diff(self.values))


class Prediction(eqx.Module):
    """The predictions of the model for every window.

    - `simulated` (W, n_c, n_t): simulated measurements; with process noise, predictions from earlier measurements.
    - `status` (W,): the status of the simulation.
    - `deviation` (W, n_c, n_t): standard deviations of the predictions, with process noise only.
    - `cost` (W,): minus twice the log likelihood, with process noise or estimated errors only.
    - `unknowns` (W, n_b): the unknowns of the trial, as estimated by the filter, with process noise only.
    """

    simulated: Float[Array, "W n_c n_t"]
    status: Int[Array, " W"]
    deviation: Float[Array, "W n_c n_t"] | None = None
    cost: Float[Array, " W"] | None = None
    unknowns: Float[Array, "W n_b"] | None = None

    @property
    def with_deviations(self) -> np.ndarray:
        """Simulated measurements, with process noise followed by their standard deviations: (W, n_c or 2 n_c, n_t)."""
        return np.concatenate([x for x in (self.simulated, self.deviation) if x is not None], axis=1)


class Model(eqx.Module):
    """A system with its free parameters, nuisance values, integration settings and measurement model.

        residual = (gain * simulated + offset - measured) / sigma

    With process noise (`noise`), each trial is one window, and `filtered` computes the likelihood. With estimated
    measurement errors (`errors`), the residuals are whitened.
    """

    system: System
    parameters: Parameters
    nuisance: Nuisance
    settings: Settings
    channels: tuple[str, ...] = eqx.field(static=True)
    sampled_inputs: tuple[str, ...] = eqx.field(static=True)
    zero_order_hold: tuple[str, ...] = eqx.field(static=True)
    assembled: tuple[str, ...] | None = eqx.field(static=True)  # coordinates that `assemble` adjusts; None: default
    quaternions: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())  # indices of Euler parameters
    noise: Noise | None = None
    errors: Errors | None = None

    @property
    def has_likelihood(self) -> bool:
        """Whether the cost is minus twice a log likelihood, and not a sum of squares."""
        return self.noise is not None or self.errors is not None

    @property
    def norms(self) -> tuple[tuple[int, ...], ...]:
        """Indices of Euler parameters that are all four unknown: three degrees of freedom and a norm."""
        return tuple(four for four in self.quaternions if {*four} <= {*self.unknown_places})

    @property
    def moved(self) -> tuple[int, ...]:
        """The indices of the coordinates that `assemble` adjusts to satisfy the constraints."""
        names = self.system.coordinates
        chosen = self.system.dependent_coordinates or names if self.assembled is None else self.assembled
        places = {i for four in self.quaternions for i in four}
        return tuple(i for i, name in enumerate(names) if name in chosen or i in places)

    @property
    def unknown_places(self) -> np.ndarray:
        """The indices of the unknown initial values in [q, u, x]."""
        names = state_names(self.system)
        return np.array([names.index(name) for name in self.nuisance.start], dtype=int)

    def consistent(self, window: Windows, z: Array, x: Array) -> Array:
        """The initial state (n_q + n_u + n_x,) of one window, with dependent coordinates from `assemble`. Euler
        parameters that are measured or unknown are normalized."""
        return packed(self.start(window, z, x))

    def start(self, window: Windows, z: Array, x: Array) -> State:
        system, state = self._guessed(window, z, x)
        return assemble(system, state.q, state.u, state.x, t=window.t[0], free=self.assembled)

    @jit
    def _guessed(self, window: Windows, z: Array, x: Array) -> tuple[System, State]:
        """The system with these parameters, and the initial state of a window before `assemble`."""
        system, calibration = self.parameters.apply(self.system, x, window.applies)
        if self.noise is not None:  # with a standard deviation, an initial value is part of the filter's initial state
            z = jnp.where(jnp.isfinite(self.nuisance.start_deviation), 0.0, z)
        start = self.known(window.start, calibration).at[self.unknown_places].add(z[: len(self.nuisance.start)])
        for four in self.quaternions:
            e = start[np.array(four)]
            start = start.at[np.array(four)].set(e / jnp.linalg.norm(e))
        return system, unpacked(system, start)

    def known(self, start: Array, calibration: Calibration) -> Array:
        """The given or measured initial state (n_q + n_u + n_x,), with the common gains and offsets applied."""
        for i, name in enumerate(state_names(self.system)):
            for kind, change in (("gain of start", jnp.multiply), ("offset of start", jnp.add)):
                if (kind, name) in calibration:
                    start = start.at[i].set(change(start[i], calibration[kind, name]))
        return start

    def simulate(self, window: Windows, start: Array, z: Array, b: Array, x: Array) -> Trajectory:
        system, calibration = self.parameters.apply(self.system, x, window.applies)
        settings = self.settings if self.settings.step is None else dataclasses.replace(self.settings, step=window.step)
        origin, t = window.t[0], window.t
        signals = self.signals(window, self.nuisance.with_local(calibration, b, z))
        # The integrator gets times since the start of the window: at 1e4 s, float32 resolves only 1 ms.
        signals = share_times(since(origin, signals, t.dtype))
        return dataclasses.replace(solve(system, unpacked(system, start), origin, t - origin, signals, settings), t=t)

    def signals(self, window: Windows, calibration: Calibration) -> dict[str, Any]:
        signals: dict[str, Any] = {}
        # All inputs without a delay share one array of times. Their common discontinuities then take no more computing
        # time than those of a single input.
        prompt = window.acting(0.0)
        for i, name in enumerate(self.system.inputs):
            gain, offset = _gain_and_offset("input", name, calibration, window.t.dtype)
            if name in self.sampled_inputs:
                delayed = ("delay of input", name) in calibration
                delay = calibration.get(("delay of input", name), 0.0)
                if delayed and name in self.zero_order_hold:
                    # Delays start at 0, and simultaneous discontinuities of two inputs are not differentiable with
                    # respect to a single delay. So each input is shifted by a different small time.
                    delay = delay + 1e-7 * (i + 1) * window.step
                times, samples = window.acting(delay) if delayed else prompt
                values = gain * samples[i] + offset
                if name in self.zero_order_hold and delayed and self.settings.step is not None:
                    signals[name] = Ramps(times, values, 2.0 * window.step)
                else:
                    signals[name] = Samples(times, values, zero_order_hold=name in self.zero_order_hold)
            elif ("offset of input", name) in calibration:
                signals[name] = offset
        return signals

    def simulated(self, ride: Trajectory, calibration: Calibration) -> Array:
        """Simulated measurements of all channels (n_c, n_t)."""
        rows = []
        for c in self.channels:
            y = ride[c]
            for times, kind in enumerate(LOW_PASSES, start=1):
                for _ in range(times if (f"{kind} of sensor", c) in calibration else 0):
                    y = low_passed(ride.t, y, calibration[f"{kind} of sensor", c])
            delay = calibration.get(("delay of sensor", c))
            rows.append(y if delay is None else delayed_signal(ride.t, y, delay))
        return self.as_read(rows, calibration)

    def as_read(self, rows: Sequence[Array], calibration: Calibration) -> Array:
        """The readings of all channels (n_c, ...): `rows` with the gains and offsets of the sensors applied."""
        factors = [
            _gain_and_offset("sensor", c, calibration, y.dtype) for c, y in zip(self.channels, rows, strict=True)
        ]
        return jnp.stack([gain * y + offset for y, (gain, offset) in zip(rows, factors, strict=True)])

    def residuals(self, window: Windows, start: Array, z: Array, b: Array, x: Array) -> tuple[Array, Prediction]:
        """Residuals of one window with its priors (m,), and the prediction. The defect is computed with the initial
        guess of the start of the next window."""
        ride = self.simulate(window, start, z, b, x)
        calibration, n = self.parameters.apply(self.system, x, window.applies)[1], self.nuisance
        simulated = self.simulated(ride, n.with_local(calibration, b, z))
        # `where`, because the product of a weight of zero and a simulated value of NaN is NaN.
        difference = jnp.where(window.weight > 0, (simulated - window.measured) * window.weight, 0.0)
        end = packed_motion(ride.state())
        following = self.known(window.next_start, calibration)
        jump = jnp.where(window.linked > 0, (end - following)[self.unknown_places] / n.defect_std, 0.0)
        priors, cost = self.priors(window, z, b), None
        if self.errors is not None:
            _, difference, cost = self.errors.whitened(difference, window.weight)
            cost = cost + jnp.sum(priors**2)
        rows = [difference.ravel(), *([jump] if n.has_defects else []), priors]
        return jnp.concatenate(rows), Prediction(simulated, ride.status, cost=cost)

    def priors(self, window: Windows, z: Array, b: Array) -> Array:
        """Prior residuals of the initial state and of the unknowns of the trial, divided by standard deviations."""
        n = self.nuisance
        # A prior with infinite standard deviation gives a row of zeros. The prior of a trial is counted only in its
        # first window. With `defect_std`, the same applies to the prior of the initial state.
        of_start = jnp.where(window.first, z / n.start_deviation, 0.0) if n.has_defects else z / n.start_deviation
        of_trial = jnp.where(window.first, b / n.trial_deviation, 0.0)
        # Initial states are normalized, so the measurements do not determine the norm of unknown Euler parameters. This
        # row sets it to one. At a minimum the row is zero, so it adds nothing to the cost.
        raw = window.start.at[self.unknown_places].add(z[: len(n.start)])
        of_norms = jnp.array([(raw[np.array(four)] @ raw[np.array(four)] - 1) / 2 for four in self.norms], z.dtype)
        return jnp.concatenate([of_start, of_trial, of_norms])


def _gain_and_offset(of: str, name: str, calibration: Calibration, dtype: DTypeLike) -> tuple[Array, Array]:
    numbers = calibration.get((f"gain of {of}", name), 1.0), calibration.get((f"offset of {of}", name), 0.0)
    return jnp.asarray(numbers[0], dtype), jnp.asarray(numbers[1], dtype)


def delayed_signal(t: Float[Array, " n"], y: Float[Array, " n"], delay: Array) -> Float[Array, " n"]:
    """y(t - delay) for samples y, by cubic interpolation (Catmull and Rom).

    The slopes are those of parabolas through three neighbouring samples. The extrapolation is linear. The last time may
    be repeated, which occurs in padded windows.
    """
    h = jnp.diff(t)
    # Replace the divisor too: masking only the quotient leaves NaN in its derivative.
    lasting = jnp.where(h > 0, h, jnp.ones_like(h))
    d = jnp.where(h > 0, jnp.diff(y) / lasting, 0.0)  # (n-1,)
    d = jnp.where(h > 0, d, d[jnp.maximum(jnp.sum(h > 0) - 1, 0)])
    if t.shape[0] > 2:
        both = h[:-1] + h[1:]
        inner = (d[:-1] * h[1:] + d[1:] * h[:-1]) / jnp.where(both > 0, both, 1.0)
        before = jnp.concatenate([d[:1], inner[:-1]])
        # The last interval of nonzero length is treated as the end.
        inner = jnp.where(h[1:] > 0, inner, 2 * d[:-1] - before)
        slopes = jnp.concatenate([2 * d[:1] - inner[:1], inner, 2 * d[-1:] - inner[-1:]])
    else:
        slopes = jnp.broadcast_to(d, t.shape)
    at = t - delay
    i = jnp.clip(jnp.searchsorted(t, at, side="right") - 1, 0, t.shape[0] - 2)
    s, step = (at - t[i]) / lasting[i], lasting[i]
    y0, y1, m0, m1 = y[i], y[i + 1], step * slopes[i], step * slopes[i + 1]
    inside = y0 + s * (m0 + s * (3 * (y1 - y0) - 2 * m0 - m1 + s * (2 * (y0 - y1) + m0 + m1)))
    before, after = y[0] + slopes[0] * (at - t[0]), y[-1] + slopes[-1] * (at - t[-1])
    return jnp.where(at < t[0], before, jnp.where(at > t[-1], after, inside))


def low_passed(t: Float[Array, " n"], y: Float[Array, " n"], time_constant: Array) -> Float[Array, " n"]:
    """The solution x of time_constant dx/dt = y - x, for y linear between samples.

        x_k+1 = y_k+1 - T s_k + a_k (x_k - y_k + T s_k),   s_k: slopes,   a_k = exp(-h_k / T)

    The filter starts as if y had always had its initial slope. For T <= 0, the result is y - T s, so that it is
    differentiable at T = 0. The last time may be repeated, which occurs in padded windows.
    """
    h, T = jnp.diff(t), time_constant
    ramp = T * jnp.where(h > 0, jnp.diff(y) / jnp.where(h > 0, h, 1.0), 0.0)  # (n - 1,)
    lasts = T > 0
    a = jnp.where(lasts, jnp.exp(-h / jnp.where(lasts, T, 1.0)), 0.0)
    # A repeated last time must not change x, which it would for T <= 0.
    a = jnp.where(h > 0, a, 1.0)

    def go_on(x: Array, now: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        a, ramp, y, y_next = now
        x = y_next - ramp + a * (x - y + ramp)
        return x, x

    first = y[0] - ramp[0]
    return jnp.concatenate([first[None], jax.lax.scan(go_on, first, (a, ramp, y[:-1], y[1:]))[1]])
