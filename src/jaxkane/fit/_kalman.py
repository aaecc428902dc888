"""Kalman filters: in square-root form for linear models, and extended for the motion of a trial.

Knows matrices and `Model`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._integrate.inputs import for_fixed_steps, inputs_at
from .._integrate.integrate import ends_between, is_valid, one_step
from .._integrate.status import Status
from .._kane.constraints import has_configuration_constraints
from .._kane.rhs import values_of
from .._system.system import System, unpacked
from ..estimate._filter import brought_back, sensed, tangent
from ..estimate._process_noise import MODES, Disturbance, Noise
from ..estimate._square_root import root, update
from ._windows import Windows, state_names


class Step(NamedTuple):
    """What a smoother needs of one instant of a filter.

    `mean` (n,), `S` (n, n): before its measurements. `shift`, `left`: as of an `Update`. `back` (n, n): how the x after
    the measurements before enters that of here, less what the noise in between adds.
    """

    mean: Float[Array, " n"]
    S: Float[Array, "n n"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]
    back: Float[Array, "n n"]


def smoothed_moments(steps: Step) -> tuple[Float[Array, "n_t n"], Float[Array, "n_t n n"]]:
    """Mean and a root of the covariance of every instant, all measurements known; `steps` has a leading axis (n_t).

    The smoother of Bryson and Frazier in the coordinates x, where the adjoint variable a and 1 - its matrix, here G,
    are of order one, and no covariance is inverted or subtracted from another:

        a = left a+ - shift,   G = left G+ left^T,   m + S (-a),   S G S^T
    """
    n = steps.S.shape[-1]
    one = jnp.eye(n, dtype=steps.S.dtype)

    def go_back(after: Any, step: Step) -> tuple[Any, Any]:
        a, G = after
        a, G = step.left @ a - step.shift, step.left @ G @ step.left.T
        moments = step.mean - step.S @ a, step.S @ _symmetric_root(G)
        return (step.back @ a, one - step.back @ (one - G) @ step.back.T), moments

    return jax.lax.scan(go_back, (jnp.zeros(n, one.dtype), one), steps, reverse=True)[1]


def _symmetric_root(G: Array) -> Array:
    values, vectors = jnp.linalg.eigh((G + G.T) / 2)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]


LOG_2PI = 1.8378770664093453


class Filtered(NamedTuple):
    """One trial, filtered.

    - `innovation`, `deviation` (n_c, n_t): measured less predicted from all that was measured before, and the standard
      deviation of that; zero and one in gaps. `predicted` (n_c, n_t).
    - `unknowns` (n_b,): the trial's own, in the end. `status`: of the first simulation that failed.
    - `steps`: what a smoother needs.
    """

    innovation: Array
    deviation: Array
    predicted: Array
    unknowns: Array
    status: Array
    steps: Step


def filtered(model: Any, window: Windows, start: Array, b: Array, x: Array, begin: Array | None = None) -> Filtered:
    """The filter along one trial from `start` (n_q + n_u + n_x,).

    `begin` (n,): standard deviations of v there, by default those that were given, and zero of what has none.
    """
    system, calibration = model.parameters.apply(model.system, x)
    y, weight, t = window.measured.T, window.weight.T, window.t  # (n_t, n_c), (n_t,)
    factor = jnp.stack([jnp.asarray(calibration.get(("noise scale", c), 1.0), x.dtype) for c in model.channels])
    begin = _given_deviations(model, start.shape[0]) if begin is None else begin
    S = jnp.diag(begin)
    if has_configuration_constraints(system, t[0], start[: len(system.coordinates)]):
        S = tangent(system, t[0], start, S, model.moved)
    motion = _Motion(model, system, calibration, window)

    def go_on(known: tuple[Array, Array, Reached], now: Any) -> tuple[Any, Any]:
        v, S, reached = known
        before, t, y, weight = now
        v, S, back, reached = motion.predicted(v, S, before, t, reached)
        along = lambda direction: jax.jvp(lambda v: motion.measured(v, t), (v,), (direction,))  # noqa: E731
        h, F = jax.vmap(along, in_axes=1, out_axes=(None, 1))(S)
        measured = weight > 0
        sigma = factor / jnp.where(measured, weight, 1.0)
        new = update(jnp.where(measured, y - h, 0.0), F, sigma, measured)
        mean, after = brought_back(system, t, v + S @ new.shift, S @ new.left)
        step = Step(v, S, new.shift, new.left, back)
        return (mean, after, reached), (new.innovation, new.deviation, h + new.known, step)

    v = jnp.concatenate([start, _fixed(model, b)])
    # The first sample is met where the motion begins, after no time at all.
    times = (jnp.concatenate([t[:1], t[:-1]]), t)
    (mean, _, reached), out = jax.lax.scan(go_on, (v, S, motion.start(v)), (*times, y, weight))
    e, s, predicted, steps = out
    return Filtered(e.T, s.T, predicted.T, mean[start.shape[0] :], reached.status, steps)


class Reached(NamedTuple):
    """Where the last step ended: `t`, the packed state `y` before its measurements, and the `status`. An event ends a
    motion that passes it from one such state to the next, by a step or by a measurement."""

    t: Array
    y: Array
    status: Array


@dataclasses.dataclass(frozen=True)
class _Motion:
    """The motion of one trial, disturbed, and what is measured of it."""

    model: Any
    system: System
    calibration: Any
    window: Windows

    @property
    def n(self) -> int:
        """How many of v are the state; the rest are the trial's own unknowns."""
        return len(state_names(self.system))

    def signals(self, b: Array) -> Any:
        return for_fixed_steps(self.model.signals(self.window, b, self.calibration), self.model.settings.solver)

    def start(self, v: Array) -> Reached:
        y, t = v[: self.n], self.window.t[0]
        valid = is_valid(self.system, y, t, self.signals(v[self.n :]))
        return Reached(t, y, jnp.where(valid, jnp.int32(Status.COMPLETED), jnp.int32(Status.INVALID)))

    def predicted(self, v: Array, S: Array, t0: Array, t1: Array, reached: Reached):
        """Mean v and root S at t1 from those at t0, and the rotation of the unit of S; by steps of at most the
        window's. NaN where the motion has ended."""
        noise: Noise = self.model.noise
        n, n_w, dtype = v.shape[0], len(noise.names), v.dtype
        density, named = noise.spectral_densities(self.calibration), (self.system.speeds, self.system.states)
        lasts = density > 0
        amplitude = jnp.tile(jnp.where(lasts, jnp.sqrt(jnp.where(lasts, density, 1.0)), 0.0), MODES)
        number = jnp.maximum(jnp.ceil((t1 - t0) / self.window.step - 1e-6), 1.0)
        moving = t1 > t0
        length = jnp.where(moving, (t1 - t0) / number, self.window.step)
        of_noise = jnp.concatenate([jnp.zeros((n, MODES * n_w), dtype), jnp.diag(amplitude)])

        def piece(i: Array, carry: Any) -> Any:
            v, S, back, reached = carry
            done = i.astype(dtype)
            t_start = t0 + done * length
            t_end = jnp.where(done + 1 >= number, t1, t_start + length)

            def flow(v: Array, xi: Array) -> Array:
                disturbance = Disturbance(t_start, t_end, xi.reshape(MODES, n_w), noise.names, *named)
                return self.moved(v, t_start, t_end, disturbance)

            directions = jnp.concatenate([S.T, jnp.zeros((MODES * n_w, n), dtype)]), of_noise
            along = lambda *direction: jax.jvp(flow, (v, jnp.zeros(MODES * n_w, dtype)), direction)  # noqa: E731
            v1, A = jax.vmap(along, out_axes=(None, 1))(*directions)
            reached = self.reached(v1, t_end, reached)
            S, Q = root(A)
            return jnp.where(reached.status > 0, jnp.nan, v1), S, back @ Q[:n], reached

        times = jnp.where(moving, number, 0.0).astype(jnp.int32)
        return jax.lax.fori_loop(jnp.int32(0), times, piece, (v, S, jnp.eye(n, dtype=dtype), reached))

    def moved(self, v: Array, t0: Array, t1: Array, disturbance: Disturbance) -> Array:
        """v after one step of integration."""
        y, b, settings = v[: self.n], v[self.n :], self.model.settings
        return jnp.concatenate([one_step(self.system, y, t0, t1, self.signals(b), settings, disturbance), b])

    def reached(self, v: Array, t: Array, before: Reached) -> Reached:
        y = jax.lax.stop_gradient(v[: self.n])
        ended = ends_between(self.system, before.t, before.y, t, y, self.signals(v[self.n :]))
        status = jnp.where(jnp.all(jnp.isfinite(y)), ended, jnp.int32(Status.STEP_TOO_SMALL))
        return Reached(t, y, jnp.where(before.status > 0, before.status, status))

    def measured(self, v: Array, t: Array) -> Array:
        """What the sensors read (n_c,)."""
        system, model = self.system, self.model
        state, b = unpacked(system, v[: self.n]), v[self.n :]
        values = values_of(system, state.x, inputs_at(system, self.signals(b), t, state))
        return model.as_read(sensed(system, model.channels, t, state.q, state.u, values), b, self.calibration)


def _given_deviations(model: Any, n: int) -> Array:
    """Of v (n + n_b,) at the start, zero of what has none."""
    nuisance = model.nuisance
    finite = lambda x: jnp.where(jnp.isfinite(x), x, 0.0)  # noqa: E731
    y = jnp.zeros(n, nuisance.start_deviation.dtype).at[model.unknown_places].set(finite(nuisance.start_deviation))
    return jnp.concatenate([y, finite(nuisance.trial_deviation)])


def _fixed(model: Any, b: Array) -> Array:
    """The trial's own unknowns where the filter begins: those that are random variables with the mean zero."""
    return jnp.where(jnp.isfinite(model.nuisance.trial_deviation), 0.0, b)


def information_of(model: Any, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Rows [J, r] of one trial, for which J^T r is the gradient of half of what `minus_twice_log_likelihood` says, and
    J^T J the information that is expected (Fisher's); that sum; what was predicted, its deviation, the trial's own
    unknowns, and the status.

        e_dot / s,   e / s;      sqrt(2) s_dot / s,   (1 - e^2 / s^2) / sqrt(2)

    Each innovation e is Gaussian with the standard deviation s, given those before it. A step of least squares with
    these rows is one of Fisher's scoring.
    """
    n_z, n_b, k = z.shape[0], b.shape[0], z.shape[0] + b.shape[0] + x.shape[0]
    # What is a random variable of the filter is no unknown: nothing else moves with it.
    moves = np.array([j for j in range(k) if j >= n_z + n_b or not model.noise.random[j]], dtype=np.int32)
    unit = jnp.eye(k, dtype=z.dtype)[moves]
    directions = (start_dot.T[moves], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        def of(start, b, x):
            result = filtered(model, window, start, b, x)
            return (result.innovation, result.deviation), result

        return jax.jvp(of, (start, b, x), direction, has_aux=True)

    (e, s), dots, result = jax.vmap(along, out_axes=(None, -1, None))(*directions)
    priors = model.priors(window, z, b, x)
    priors_dot = jnp.concatenate(jax.jacfwd(model.priors, argnums=(1, 2, 3))(window, z, b, x), axis=1)
    measured = (window.weight > 0).ravel()
    e, s = e.ravel(), s.ravel()
    dots = (jnp.where(measured[:, None], d.reshape(e.size, -1), 0.0) for d in dots)
    e_dot, s_dot = (jnp.zeros((e.size, k), e.dtype).at[:, moves].set(d) for d in dots)
    r = jnp.where(measured, e / s, 0.0)
    of_size = jnp.where(measured, (1 - r**2) / 2**0.5, 0.0)
    J = jnp.concatenate([e_dot / s[:, None], 2**0.5 * s_dot / s[:, None], priors_dot])
    value = minus_twice_log_likelihood(result, window) + jnp.sum(priors**2)
    return J, jnp.concatenate([r, of_size, priors]), value, result


def minus_twice_log_likelihood(result: Filtered, window: Windows) -> Array:
    """Of the measurements of one trial."""
    measured, s = window.weight > 0, result.deviation
    return jnp.sum(jnp.where(measured, (result.innovation / s) ** 2 + 2 * jnp.log(s) + LOG_2PI, 0.0))
