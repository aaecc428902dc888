"""What is compiled: the residuals of one window and their exact linearization. Knows `simulate`; knows no trials.

Nothing in a `Model` that is a number is fixed when it is compiled, so that other data, other initial guesses and other
priors of the same shapes run the same program.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._description.system import System, packed, unpacked
from ..._method.assembly import assemble
from ..._scalars.versions import compiled
from ..._simulation.ride import solve
from ..._simulation.settings import Settings
from ..._simulation.signals import Samples, with_one_times
from ..._simulation.trajectory import Trajectory
from .._data.windows import Windows, state_names
from .blocks import Blocks
from .filtered import Filtered, filtered, information_of, minus_twice_log_likelihood
from .noise import Noise
from .parameters import Parameters
from .shifted import earlier

Roles = dict[tuple[str, str], Array]
"""Gains, offsets and delays that all trials have in common, by what they are of: ("gain of input", name)."""


class Unknowns(eqx.Module):
    """Where a fit stands: `x` (p,) the free parameters (see `Parameters`); `b` (T, n_b) what is unknown of every trial,
    its sensors and inputs; `z` (W, n_z) unknown starts of every window."""

    x: Float[Array, " p"]
    b: Float[Array, "T n_b"]
    z: Float[Array, "W n_z"]


class Nuisance(eqx.Module):
    """Unknowns that are not asked for: `start`, names of the unknown part of a window's start; `trial`, pairs of a kind
    and a channel or input that every trial has its own of. Standard deviations are those of priors, infinite without.
    `jump` (n_z,): of the difference between a window's end and the next window's start, infinite where it is free.
    """

    start: tuple[str, ...] = eqx.field(static=True)
    trial: tuple[tuple[str, str], ...] = eqx.field(static=True)
    chained: bool = eqx.field(static=True)
    start_deviation: Float[Array, " n_z"]
    trial_deviation: Float[Array, " n_b"]
    jump: Float[Array, " n_z"]

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


class Seen(eqx.Module):
    """What the model says of every window: `simulated` (W, n_c, n_t), with process noise predicted from what was
    measured before; `status` (W,). With process noise only: `deviation` (W, n_c, n_t) of what is predicted, `value`
    (W,), minus twice the log likelihood, and `unknowns` (W, n_b), what is unknown of the trial as it was found."""

    simulated: Float[Array, "W n_c n_t"]
    status: Int[Array, " W"]
    deviation: Float[Array, "W n_c n_t"] | None = None
    value: Float[Array, " W"] | None = None
    unknowns: Float[Array, "W n_b"] | None = None


class Model(eqx.Module):
    """A system, its free parameters, what else is unknown, and how measurements are compared with simulations.

        residual = (gain * simulated + bias - measured) / sigma

    With process noise (`noise`), a window is a trial, and `filtered` says what its measurements tell.
    """

    system: System
    parameters: Parameters
    nuisance: Nuisance
    settings: Settings
    channels: tuple[str, ...] = eqx.field(static=True)
    driven: tuple[str, ...] = eqx.field(static=True)  # inputs of which there are samples
    held: tuple[str, ...] = eqx.field(static=True)
    assembled: tuple[str, ...] | None = eqx.field(static=True)  # coordinates that `assemble` moves, if not its own
    noise: Noise | None = None

    @property
    def moved(self) -> tuple[int, ...]:
        """The places of the coordinates that `assemble` moves."""
        names = self.system.coordinates
        chosen = self.system.dependent_coordinates or names if self.assembled is None else self.assembled
        return tuple(i for i, name in enumerate(names) if name in chosen)

    @property
    def unknown_places(self) -> np.ndarray:
        """Where the unknown part of a start stands in [q, u, x]."""
        names = state_names(self.system)
        return np.array([names.index(name) for name in self.nuisance.start], dtype=int)

    def consistent(self, window: Windows, z: Array, x: Array) -> Array:
        """The start (n_q + n_u + n_x,) of one window, its dependent coordinates found by `assemble`."""
        system, roles = self.parameters.apply(self.system, x)
        if self.noise is not None:  # a start with a deviation is no unknown of a filter, but what it begins with
            z = jnp.where(jnp.isfinite(self.nuisance.start_deviation), 0.0, z)
        start = self.known(window.start, roles).at[self.unknown_places].add(z)
        state = unpacked(system, start)
        return packed(assemble(system, state.q, state.u, state.x, t=window.t[0], free=self.assembled))

    def known(self, start: Array, roles: Roles) -> Array:
        """What is known of a start (n_q + n_u + n_x,), with the gains and offsets that all trials have in common."""
        for i, name in enumerate(state_names(self.system)):
            for kind, change in (("gain of start", jnp.multiply), ("offset of start", jnp.add)):
                if (kind, name) in roles:
                    start = start.at[i].set(change(start[i], roles[kind, name]))
        return start

    def simulate(self, window: Windows, start: Array, b: Array, x: Array) -> Trajectory:
        """One window's motion."""
        system, roles = self.parameters.apply(self.system, x)
        settings = self.settings if self.settings.step is None else dataclasses.replace(self.settings, step=window.step)
        signals = with_one_times(self.signals(window, b, roles))
        return solve(system, unpacked(system, start), window.t, signals, settings)

    def signals(self, window: Windows, b: Array, roles: Roles) -> dict[str, Any]:
        """The inputs of one window by name."""
        system, signals = self.system, {}
        for i, name in enumerate(system.inputs):
            bias = self.nuisance.of_trial(b, "bias of input", name, 0.0) + roles.get(("offset of input", name), 0.0)
            if name in self.driven:
                gain = roles.get(("gain of input", name), 1.0) * self.nuisance.of_trial(b, "gain of input", name, 1.0)
                times, values = self._times_of(name, window, b, roles), gain * window.inputs[i] + bias
                if name in self.held and times is not window.t_input and self.settings.step is not None:
                    signals[name] = Ramps(times, values, 2.0 * window.step)
                else:
                    signals[name] = Samples(times, values, hold=name in self.held)
            elif ("bias of input", name) in self.nuisance.trial or ("offset of input", name) in roles:
                signals[name] = bias
        return signals

    def _times_of(self, name: str, window: Windows, b: Array, roles: Roles) -> Array:
        """When an input's samples act (n_in,) [s]: the same array for all that have no delay, since kinks that are
        known to be at the same times cost no more than those of one input."""
        if ("delay of input", name) not in roles and ("delay of input", name) not in self.nuisance.trial:
            return window.t_input
        delay = roles.get(("delay of input", name), 0.0) + self.nuisance.of_trial(b, "delay of input", name, 0.0)
        return window.t_input + delay

    def simulated(self, ride: Trajectory, b: Array, roles: Roles) -> Array:
        """What the sensors would have said (n_c, n_t)."""
        rows = []
        for c in self.channels:
            y = ride[c]
            if ("delay of sensor", c) in roles:
                y = earlier(ride.t, y, roles["delay of sensor", c])
            gain = self.nuisance.of_trial(b, "gain of sensor", c, 1.0) * roles.get(("gain of sensor", c), 1.0)
            bias = self.nuisance.of_trial(b, "bias of sensor", c, 0.0) + roles.get(("offset of sensor", c), 0.0)
            rows.append(gain * y + bias)
        return jnp.stack(rows)

    def residuals(self, window: Windows, start: Array, z: Array, b: Array, x: Array) -> tuple[Array, Any]:
        """Residuals of one window, priors included (m,), in which the next window starts where it is first thought to;
        and what was seen."""
        ride = self.simulate(window, start, b, x)
        roles = self.parameters.apply(self.system, x)[1]
        simulated, n = self.simulated(ride, b, roles), self.nuisance
        difference = jnp.where(window.weight > 0, (simulated - window.measured) * window.weight, 0.0)
        end = packed(ride.state())
        following = self.known(window.next_start, roles)
        jump = jnp.where(window.linked > 0, (end - following)[self.unknown_places] / n.jump, 0.0)
        rows = [difference.ravel(), *([jump] if n.chained else []), self.priors(window, z, b, x)]
        return jnp.concatenate(rows), Seen(simulated, ride.status)

    def priors(self, window: Windows, z: Array, b: Array, x: Array) -> Array:
        """Of starts, a trial's unknowns and the parameters, each divided by its standard deviation."""
        n = self.nuisance
        # A prior of infinite width is a row of zeros. A trial's prior is counted in its first window, and so is that of
        # a start from which all else follows.
        of_start = jnp.where(window.first, z / n.start_deviation, 0.0) if n.chained else z / n.start_deviation
        of_trial = jnp.where(window.first, b / n.trial_deviation, 0.0)
        of_all = jnp.where(window.very_first, self.parameters.prior_residuals(x), 0.0)
        return jnp.concatenate([of_start, of_trial, of_all])


@compiled
def starts_of(model: Model, windows: Windows, point: Unknowns) -> tuple[Array, Array]:
    """Starts (W, n) and their derivatives (W, n, n_z + n_b + p) by z, b and x."""
    # A program of its own: inside that of the simulation Newton's method would be differentiated a tangent at a time.
    n_b = point.b.shape[1]

    def start_of(arguments):
        window, z = arguments
        start = lambda z, x: model.consistent(window, z, x)  # noqa: E731
        by_z, by_x = jax.jacfwd(start, argnums=(0, 1))(z, point.x)
        return start(z, point.x), jnp.concatenate([by_z, jnp.zeros((by_z.shape[0], n_b), by_z.dtype), by_x], axis=1)

    return jax.lax.map(start_of, (windows, point.z))


def jacobian_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of a window, their derivatives (m, n_z + n_b + p), and what was seen."""
    n_z, n_b = z.shape[0], b.shape[0]
    unit = jnp.eye(n_z + n_b + x.shape[0], dtype=z.dtype)
    directions = (start_dot.T, unit[:, :n_z], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        residuals = lambda *unknowns: model.residuals(window, *unknowns)  # noqa: E731
        return jax.jvp(residuals, (start, z, b, x), direction, has_aux=True)

    return jax.vmap(along, out_axes=(None, -1, None))(*directions)


@compiled
def blocks_of(
    model: Model, windows: Windows, by_trial: Array, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Blocks, Seen]:
    """Blocks, and what was seen of every window."""
    n_z, n_b = point.z.shape[1], point.b.shape[1]
    n_next = n_z if model.nuisance.chained else 0

    def window_block(arguments):
        window, z, z_next, b, start, start_dot = arguments
        if model.noise is None:
            r, J, more = jacobian_of(model, window, start, start_dot, z, b, point.x)
        else:
            J, r, value, found = information_of(model, window, start, start_dot, z, b, point.x)
            more = _seen_by_filter(found, value)
        links = by_next(model, window, r.shape[0])[:, :n_next]
        A = jnp.column_stack([J[:, :n_z], links, J[:, n_z:], r + links @ z_next[:n_next]])
        # The triangle says all that the (m, k) matrix says about least squares. QR of NaN is not everywhere NaN.
        bad = ~jnp.all(jnp.isfinite(A))
        A = jnp.concatenate([jnp.where(bad, 0.0, A), jnp.zeros((A.shape[1], A.shape[1]), A.dtype)])
        return jnp.where(bad, jnp.nan, jnp.linalg.qr(A, mode="r")), more

    R, seen = each(window_block, _arguments(windows, point, starts, starts_dot))
    return Blocks(R, by_trial, n_z, n_next, n_b), seen


@compiled
def costs_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> tuple[Array, Seen]:
    """Costs (W,), and what was seen: `blocks_of` without derivatives."""

    def window_cost(arguments):
        window, z, z_next, b, start = arguments
        if model.noise is not None:
            found = filtered(model, window, start, b, point.x)
            priors = model.priors(window, z, b, point.x)
            value = minus_twice_log_likelihood(found, window) + jnp.sum(priors**2)
            return value, _seen_by_filter(found, value)
        r, seen = model.residuals(window, start, z, b, point.x)
        if model.nuisance.chained:
            r = r + by_next(model, window, r.shape[0]) @ z_next
        return jnp.sum(r**2), seen

    return each(window_cost, _arguments(windows, point, starts))


@compiled
def rides_of(model: Model, windows: Windows, point: Unknowns, starts: Array) -> Trajectory:
    """The motion of every window, stacked."""
    return each(lambda now: model.simulate(now[0], now[4], now[3], point.x), _arguments(windows, point, starts))


def _seen_by_filter(found: Filtered, value: Array) -> Seen:
    return Seen(found.predicted, found.status, found.deviation, value, found.unknowns)


def _arguments(windows: Windows, point: Unknowns, *more: Array) -> tuple[Any, ...]:
    z_next = jnp.concatenate([point.z[1:], point.z[:1]])
    return windows, point.z, z_next, point.b[windows.trial], *more


def by_next(model: Model, window: Windows, m: int) -> Array:
    """Derivatives (m, n_z) of a window's residuals by the next window's start."""
    n_z, before = window_size(model), window.weight.size
    links = jnp.zeros((m, n_z), window.t.dtype)
    if not model.nuisance.chained:
        return links
    places = jnp.arange(n_z, dtype=jnp.int32)
    return links.at[before + places, places].set(-window.linked / model.nuisance.jump)


def window_size(model: Model) -> int:
    """How many of a window's starting values are unknown."""
    return len(model.nuisance.start)


def each(f: Callable[..., Any], windows: Any) -> Any:
    """`f` of every window."""
    # One ride after another is fastest on a CPU, where a right-hand side is one scalar function; elsewhere all at once.
    batch = None if jax.default_backend() == "cpu" else jax.tree.leaves(windows)[0].shape[0]
    return jax.lax.map(f, windows, batch_size=batch)
