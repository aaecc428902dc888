"""The model of one window: how it is simulated, its start, its motion, its sensors, its residuals. Knows no trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._common.lookup import real_number
from .._integrate.inputs import Samples, share_times
from .._integrate.integrate import solve
from .._integrate.settings import Settings, settings_for
from .._integrate.trajectory import Trajectory
from .._kane.assemble import assemble
from .._scalarjit.cache_key import jit
from .._system.system import State, System, packed, unpacked
from ..estimate._process_noise import Noise
from ._parameters import LOW_PASSES, Parameters
from ._windows import Windows, state_names


@dataclasses.dataclass(frozen=True)
class Simulation:
    """How the motions of a fit are integrated.

        fit(system, trials, free, simulation=Simulation(step=0.01))

    By default, where inputs vary, one step of Bosh3 between neighbouring samples, halved until that changes what is
    simulated by less than a share of the noise, at the initial guess and again where the fit ended (`Fit.step_error`
    says what is left); elsewhere Tsit5 with a tolerance of 1e-6.

    **Arguments:**

    - `rtol`, `atol`: tolerances that the steps follow. `step` [s]: a fixed one, the same in all windows. Give
        tolerances or a step, not both.
    - `solver`: of diffrax. `max_steps`: of a window; by default as many as fixed steps take, and 4096 with tolerances.

    **Raises:** `ValueError` for numbers that are not positive and finite, and for a step beside tolerances.
    """

    rtol: float | None = None
    atol: float | None = None
    step: float | None = None
    solver: diffrax.AbstractSolver | None = None
    max_steps: int | None = None

    def __post_init__(self) -> None:
        for name in ("rtol", "atol", "step", "max_steps"):
            value = getattr(self, name)
            if value is not None and not 0 < real_number(value, f"`{name}`") < float("inf"):
                raise ValueError(f"`{name}` must be positive and finite, got {value}.")
        if self.step is not None and (self.rtol is not None or self.atol is not None):
            raise ValueError(
                "`step` fixes the step of integration, `rtol` and `atol` let it follow the error: give one."
            )

    def settings(self, t: Any, varying: bool) -> Settings:
        """For windows of the times t (n_t,), whose inputs vary or not. Each window has its own step, if it is fixed."""
        free = self.step is None and self.rtol is None and self.atol is None
        fixed = self.step is not None or (free and varying)
        solver = diffrax.Bosh3() if fixed else diffrax.Tsit5()
        return settings_for(
            t,
            rtol=None if fixed else 1e-6 if self.rtol is None else self.rtol,
            atol=self.atol,
            solver=solver if self.solver is None else self.solver,
            step=1.0 if fixed else None,
            adjoint="forward",
            # A fixed step is taken as often as it fits into the time.
            max_steps=self.max_steps if self.max_steps is not None or fixed else 4096,
        )


def delayed_signal(t: Float[Array, " n"], y: Float[Array, " n"], delay: Array) -> Float[Array, " n"]:
    """y(t - delay) of samples, by cubics with the slopes of parabolas through three neighbours (Catmull and Rom).

    Outside it is continued by a straight line. The last time may be repeated.
    """
    h = jnp.diff(t)
    lasting = jnp.where(h > 0, h, jnp.ones_like(h))
    d = jnp.where(h > 0, jnp.diff(y) / lasting, 0.0)  # (n-1,)
    d = jnp.where(h > 0, d, d[jnp.maximum(jnp.sum(h > 0) - 1, 0)])
    if t.shape[0] > 2:
        both = h[:-1] + h[1:]
        inner = (d[:-1] * h[1:] + d[1:] * h[:-1]) / jnp.where(both > 0, both, 1.0)
        before = jnp.concatenate([d[:1], inner[:-1]])
        inner = jnp.where(h[1:] > 0, inner, 2 * d[:-1] - before)  # the last that lasts, as at the end
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
    """x with time_constant dx/dt = y - x, for y linear between samples, and begun as if its first slope had lasted:

        x_k+1 = y_k+1 - T s_k + a_k (x_k - y_k + T s_k),   s_k: slopes,   a_k = exp(-h_k / T)

    Below T = 0 it goes on as it is at T = 0, y - T s. The last time may be repeated.
    """
    h, T = jnp.diff(t), time_constant
    ramp = T * jnp.where(h > 0, jnp.diff(y) / jnp.where(h > 0, h, 1.0), 0.0)  # (n - 1,)
    lasts = T > 0
    a = jnp.where(lasts, jnp.exp(-h / jnp.where(lasts, T, 1.0)), 0.0)
    a = jnp.where(h > 0, a, 1.0)

    def go_on(x: Array, now: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        a, ramp, y, y_next = now
        x = y_next - ramp + a * (x - y + ramp)
        return x, x

    first = y[0] - ramp[0]
    return jnp.concatenate([first[None], jax.lax.scan(go_on, first, (a, ramp, y[:-1], y[1:]))[1]])


Calibration = dict[tuple[str, str], Array]
"""Gains, offsets, delays and time constants that all trials have in common, by what they are of: ("gain of input",
name)."""


class Unknowns(eqx.Module):
    """Where a fit stands: `x` (p,) the free parameters (see `Parameters`); `b` (T, n_b) what is unknown of every trial,
    its sensors and inputs; `z` (W, n_z) unknown starts of every window."""

    x: Float[Array, " p"]
    b: Float[Array, "T n_b"]
    z: Float[Array, "W n_z"]


class Nuisance(eqx.Module):
    """Unknowns beside the parameters: `start`, names of the unknown part of a window's start; `trial`, pairs of a kind
    and a channel or input that every trial has its own of. Standard deviations are those of priors, infinite without.
    `defect_std` (n_z,): of the jump from a window's end to the next window's start, infinite where it is free.
    """

    start: tuple[str, ...] = eqx.field(static=True)
    trial: tuple[tuple[str, str], ...] = eqx.field(static=True)
    has_defects: bool = eqx.field(static=True)
    start_deviation: Float[Array, " n_z"]
    trial_deviation: Float[Array, " n_b"]
    defect_std: Float[Array, " n_z"]

    def of_trial(self, b: Array, kind: str, name: str, otherwise: float) -> Array:
        """The value of one of a trial's unknowns."""
        if (kind, name) in self.trial:
            return otherwise + b[self.trial.index((kind, name))]
        return jnp.asarray(otherwise, b.dtype)


class Ramps(eqx.Module):
    """Held samples that jump at times of their own, for steps of one length, which cannot end there: each jump is a
    ramp about its time, of a `width` [s] that goes with the step. So it has a derivative by that time.

    Attributes: `ts`, `values` (n_t,); `width`.
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]
    width: Float[Array, ""]

    def __call__(self, t: Array, state: Any = None) -> Array:
        done = jnp.clip((t - self.ts[1:]) / self.width + 0.5, 0.0, 1.0)
        return self.values[0] + jnp.sum(done * jnp.diff(self.values))


class Prediction(eqx.Module):
    """What the model predicts of every window: `simulated` (W, n_c, n_t), with process noise from the measurements
    before; `status` (W,). With process noise only: `deviation` (W, n_c, n_t) of what is predicted, `cost` (W,), minus
    twice the log likelihood, and `unknowns` (W, n_b), the trial's own as the filter estimates them."""

    simulated: Float[Array, "W n_c n_t"]
    status: Int[Array, " W"]
    deviation: Float[Array, "W n_c n_t"] | None = None
    cost: Float[Array, " W"] | None = None
    unknowns: Float[Array, "W n_b"] | None = None

    def until(self, n_t: int) -> Prediction:
        """With so many samples."""
        return jax.tree.map(lambda x: np.asarray(x)[..., :n_t] if x.ndim == 3 else x, self)

    @property
    def with_deviations(self) -> np.ndarray:
        """Simulated measurements, followed by their deviations where there are such: (W, n_c or 2 n_c, n_t)."""
        return np.concatenate([x for x in (self.simulated, self.deviation) if x is not None], axis=1)


class Model(eqx.Module):
    """A system, its free parameters, what else is unknown, and how measurements are compared with simulations.

        residual = (gain * simulated + bias - measured) / sigma

    With process noise (`noise`), a window is a trial, and `filtered` follows its measurements.
    """

    system: System
    parameters: Parameters
    nuisance: Nuisance
    settings: Settings
    channels: tuple[str, ...] = eqx.field(static=True)
    sampled_inputs: tuple[str, ...] = eqx.field(static=True)
    zero_order_hold: tuple[str, ...] = eqx.field(static=True)
    assembled: tuple[str, ...] | None = eqx.field(static=True)  # coordinates that `assemble` moves, if not its own
    quaternions: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())  # places of Euler parameters
    noise: Noise | None = None

    @property
    def norms(self) -> tuple[tuple[int, ...], ...]:
        """Those Euler parameters of which all four are unknown: three degrees of freedom, and their norm."""
        return tuple(four for four in self.quaternions if {*four} <= {*self.unknown_places})

    @property
    def moved(self) -> tuple[int, ...]:
        """The places of the coordinates that follow from constraints."""
        names = self.system.coordinates
        chosen = self.system.dependent_coordinates or names if self.assembled is None else self.assembled
        places = {i for four in self.quaternions for i in four}
        return tuple(i for i, name in enumerate(names) if name in chosen or i in places)

    @property
    def unknown_places(self) -> np.ndarray:
        """Where the unknown part of a start stands in [q, u, x]."""
        names = state_names(self.system)
        return np.array([names.index(name) for name in self.nuisance.start], dtype=int)

    def consistent(self, window: Windows, z: Array, x: Array) -> Array:
        """The start (n_q + n_u + n_x,) of one window, its dependent coordinates found by `assemble`. Euler
        parameters that were measured, or are unknown, are brought to unit norm."""
        return packed(self.start(window, z, x))

    def start(self, window: Windows, z: Array, x: Array) -> State:
        """The same as a `State`."""
        system, state = self._guessed(window, z, x)
        return assemble(system, state.q, state.u, state.x, t=window.t[0], free=self.assembled)

    @jit
    def _guessed(self, window: Windows, z: Array, x: Array) -> tuple[System, State]:
        """The system with these parameters, and where a window starts but for its dependent coordinates."""
        system, calibration = self.parameters.apply(self.system, x)
        if self.noise is not None:  # a start with a deviation is no unknown of a filter, but what it begins with
            z = jnp.where(jnp.isfinite(self.nuisance.start_deviation), 0.0, z)
        start = self.known(window.start, calibration).at[self.unknown_places].add(z)
        for four in self.quaternions:
            e = start[np.array(four)]
            start = start.at[np.array(four)].set(e / jnp.linalg.norm(e))
        return system, unpacked(system, start)

    def known(self, start: Array, calibration: Calibration) -> Array:
        """What is known of a start (n_q + n_u + n_x,), with the gains and offsets that all trials have in common."""
        for i, name in enumerate(state_names(self.system)):
            for kind, change in (("gain of start", jnp.multiply), ("offset of start", jnp.add)):
                if (kind, name) in calibration:
                    start = start.at[i].set(change(start[i], calibration[kind, name]))
        return start

    def simulate(self, window: Windows, start: Array, b: Array, x: Array) -> Trajectory:
        """One window's motion."""
        system, calibration = self.parameters.apply(self.system, x)
        settings = self.settings if self.settings.step is None else dataclasses.replace(self.settings, step=window.step)
        signals = share_times(self.signals(window, b, calibration))
        return solve(system, unpacked(system, start), window.t, signals, settings)

    def signals(self, window: Windows, b: Array, calibration: Calibration) -> dict[str, Any]:
        """The inputs of one window by name."""
        signals: dict[str, Any] = {}
        # One array of times for all that have no delay: kinks that are known to be at the same times cost no more than
        # those of one input.
        prompt = window.acting(0.0)
        for i, name in enumerate(self.system.inputs):
            gain, bias = self._gain_and_bias("input", name, b, calibration)
            if name in self.sampled_inputs:
                kind = ("delay of input", name)
                delayed = kind in calibration or kind in self.nuisance.trial
                delay = self.nuisance.of_trial(b, *kind, 0.0) + calibration.get(kind, 0.0)
                times, samples = window.acting(delay) if delayed else prompt
                values = gain * samples[i] + bias
                if name in self.zero_order_hold and delayed and self.settings.step is not None:
                    signals[name] = Ramps(times, values, 2.0 * window.step)
                else:
                    signals[name] = Samples(times, values, zero_order_hold=name in self.zero_order_hold)
            elif ("bias of input", name) in self.nuisance.trial or ("offset of input", name) in calibration:
                signals[name] = bias
        return signals

    def simulated(self, ride: Trajectory, b: Array, calibration: Calibration) -> Array:
        """What the sensors would have measured (n_c, n_t)."""
        rows = []
        for c in self.channels:
            y = ride[c]
            for times, kind in enumerate(LOW_PASSES, start=1):
                for _ in range(times if (f"{kind} of sensor", c) in calibration else 0):
                    y = low_passed(ride.t, y, calibration[f"{kind} of sensor", c])
            delay = calibration.get(("delay of sensor", c))
            rows.append(y if delay is None else delayed_signal(ride.t, y, delay))
        return self.as_read(rows, b, calibration)

    def as_read(self, rows: Sequence[Array], b: Array, calibration: Calibration) -> Array:
        """Of every channel (n_c, ...), with the gains and offsets of its sensor."""
        factors = [self._gain_and_bias("sensor", c, b, calibration) for c in self.channels]
        return jnp.stack([gain * y + bias for y, (gain, bias) in zip(rows, factors, strict=True)])

    def _gain_and_bias(self, of: str, name: str, b: Array, calibration: Calibration) -> tuple[Array, Array]:
        """Of an input or a sensor: the trial's own and that of all trials together."""
        gain = self.nuisance.of_trial(b, f"gain of {of}", name, 1.0) * calibration.get((f"gain of {of}", name), 1.0)
        bias = self.nuisance.of_trial(b, f"bias of {of}", name, 0.0) + calibration.get((f"offset of {of}", name), 0.0)
        return gain, bias

    def residuals(self, window: Windows, start: Array, z: Array, b: Array, x: Array) -> tuple[Array, Prediction]:
        """Residuals of one window, priors included (m,), in which the next window starts at its initial guess; and the
        prediction."""
        ride = self.simulate(window, start, b, x)
        calibration = self.parameters.apply(self.system, x)[1]
        simulated, n = self.simulated(ride, b, calibration), self.nuisance
        difference = jnp.where(window.weight > 0, (simulated - window.measured) * window.weight, 0.0)
        end = packed(ride.state())
        following = self.known(window.next_start, calibration)
        jump = jnp.where(window.linked > 0, (end - following)[self.unknown_places] / n.defect_std, 0.0)
        rows = [difference.ravel(), *([jump] if n.has_defects else []), self.priors(window, z, b, x)]
        return jnp.concatenate(rows), Prediction(simulated, ride.status)

    def priors(self, window: Windows, z: Array, b: Array, x: Array) -> Array:
        """Of starts, a trial's unknowns and the parameters, each divided by its standard deviation."""
        n = self.nuisance
        # A prior of infinite width is a row of zeros. A trial's prior is counted in its first window, and so is that of
        # a start from which all else follows.
        of_start = jnp.where(window.first, z / n.start_deviation, 0.0) if n.has_defects else z / n.start_deviation
        of_trial = jnp.where(window.first, b / n.trial_deviation, 0.0)
        of_all = jnp.where(window.very_first, self.parameters.prior_residuals(x), 0.0)
        # What no measurement can tell, since starts are brought to unit norm: that it is one. It costs nothing.
        raw = window.start.at[self.unknown_places].add(z)
        of_norms = jnp.array([(raw[np.array(four)] @ raw[np.array(four)] - 1) / 2 for four in self.norms], z.dtype)
        return jnp.concatenate([of_start, of_trial, of_all, of_norms])
