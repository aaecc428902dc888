"""The extended Kalman filter of a trial, in square-root form, with a smoother and the expected information."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..._integrate.events import Status
from ..._integrate.inputs import for_fixed_steps, inputs_at
from ..._integrate.integrate import ends_between, is_valid, one_step
from ..._kane.right_hand_side import values_of
from ..._system.system import System, unpacked
from ...estimate._filter import begun, brought_back, sensed
from ...estimate._filter_step import MODES, Disturbance, moments, root, update
from ..problem.errors import LOG_2PI
from ..problem.model import Model, Prediction
from ..problem.windows import Windows, state_names


class Step(NamedTuple):
    """The data of one instant of a filter that a smoother needs.

    - `mean` (n,), `S` (n, n): the mean and the root of the covariance before the measurements of this instant.
    - `shift`, `left`: as in an `Update`.
    - `back` (n, n): maps x after the previous measurements to its contribution to x here, without process noise.
    """

    mean: Float[Array, " n"]
    S: Float[Array, "n n"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]
    back: Float[Array, "n n"]


def smoothed_moments(steps: Step) -> tuple[Float[Array, "n_t n"], Float[Array, "n_t n n"]]:
    """The smoothed mean and a root of the covariance of every instant, from all measurements of the trial.

    This is the smoother of Bryson and Frazier in normalized coordinates x. There, the adjoint variable a and the matrix
    G (one minus the adjoint matrix) are of order one. Covariances are not inverted or subtracted:

        a = left a+ - shift,   G = left G+ left^T,   m + S (-a),   S G S^T

    `steps`: the steps of the filter, with a leading axis (n_t).
    """
    n = steps.S.shape[-1]
    one = jnp.eye(n, dtype=steps.S.dtype)

    def go_back(after: tuple[Array, Array], step: Step) -> tuple[Any, Any]:
        a, G = after
        a, G = step.left @ a - step.shift, step.left @ G @ step.left.T
        values, vectors = jnp.linalg.eigh((G + G.T) / 2)
        moments = step.mean - step.S @ a, step.S @ (vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None])
        return (step.back @ a, one - step.back @ (one - G) @ step.back.T), moments

    return jax.lax.scan(go_back, (jnp.zeros(n, one.dtype), one), steps, reverse=True)[1]


class Filtered(NamedTuple):
    """The result of the filter for one trial.

    - `innovation` (n_c, n_t): measurements minus their predictions from all earlier measurements; zero in gaps.
    - `deviation` (n_c, n_t): standard deviations of the innovations; one in gaps.
    - `predicted` (n_c, n_t): the predictions.
    - `unknowns` (n_b,): the estimated unknowns of the trial, after the last measurement.
    - `status`: the status of the first simulation that failed, else "completed".
    - `steps`: the data for a smoother.
    """

    innovation: Array
    deviation: Array
    predicted: Array
    unknowns: Array
    status: Array
    steps: Step


def filtered(model: Model, window: Windows, start: Array, b: Array, x: Array, begin: Array | None = None) -> Filtered:
    """Filter one trial. The filtered vector v contains the state and the unknowns of the trial.

    If an initial value is a sample, its distribution follows from this sample alone.

    **Arguments:**

    - `model`: the `Model`.
    - `window`: the window of the trial.
    - `start`: the initial state (n_q + n_u + n_x,).
    - `b`: the unknowns of the trial (n_b,).
    - `x`: the unconstrained variables of the parameters (p,).
    - `begin`: standard deviations of v at the start (n,); by default those of the priors, and zero without a prior.
    """
    system, calibration = model.parameters.apply(model.system, x, window.applies)
    y, weight, t = window.measured.T, window.weight.T, window.t  # (n_t, n_c), (n_t,)
    factor = jnp.stack([jnp.asarray(calibration.get(("noise scale", c), 1.0), x.dtype) for c in model.channels])
    if begin is None:
        deviations = model.nuisance.start_deviation, model.nuisance.trial_deviation
        of_z, of_b = (jnp.where(jnp.isfinite(s), s, 0.0) for s in deviations)
        begin = jnp.concatenate([jnp.zeros_like(start).at[model.unknown_places].set(of_z), of_b])
    # The filter estimates unknowns of the trial with a prior, so they start at zero.
    b = jnp.where(jnp.isfinite(model.nuisance.trial_deviation), 0.0, b)
    v, system_at = jnp.concatenate([start, b]), lambda _: system
    moved = np.isin(np.arange(len(system.coordinates)), model.moved)
    motion = _Motion(model, system, calibration, window)
    noise: Any = model.noise
    if noise.starts_at_samples:
        # If a sample gives the initial value, its prior is so wide that only the sample has an influence.
        names, given = state_names(system), window.start_weight
        wide = float(jnp.finfo(begin.dtype).eps) ** (-1 / 3)  # its error is then as small as rounding
        for c, i in ((c, names.index(name)) for c, name in enumerate(model.channels) if name in names):
            begin = begin.at[i].set(jnp.where(given[c] > 0, wide / jnp.where(given[c] > 0, given[c], 1.0), begin[i]))
    S = begun(system_at, t[0], v, jnp.diag(begin), moved)

    def corrected(v: Array, S: Array, t: Array, y: Array, weight: Array) -> Any:
        """Correct v by the measurements at a time. Returns the mean, the root, the update and the predictions."""
        h, F = moments(lambda v, _: motion.measured(v, t), v, S, jnp.zeros(0, v.dtype))
        measured = weight > 0
        sigma = factor / jnp.where(measured, weight, 1.0)
        new = update(jnp.where(measured, y - h, 0.0), F, sigma, measured)
        return *brought_back(system_at, t, v + S @ new.shift, S @ new.left), new, h + new.known

    def go_on(known: tuple[Array, Array, Reached], now: tuple[Array, ...]) -> tuple[Any, Any]:
        v, S, reached = known
        before, t, y, weight = now
        v, S, back, reached = motion.predicted(v, S, before, t, reached)
        mean, after, new, predicted = corrected(v, S, t, y, weight)
        step = Step(v, S, new.shift, new.left, back)
        return (mean, after, reached), (new.innovation, new.deviation, predicted, step)

    if noise.starts_at_samples:
        v, S, *_ = corrected(v, S, t[0], y[0], window.start_weight)
    # The trial starts at its first sample, so the first step has zero length.
    times = (jnp.concatenate([t[:1], t[:-1]]), t)
    (mean, _, reached), out = jax.lax.scan(go_on, (v, S, motion.start(v)), (*times, y, weight))
    e, s, predicted, steps = out
    return Filtered(e.T, s.T, predicted.T, mean[start.shape[0] :], reached.status, steps)


class Reached(NamedTuple):
    """The end of the last step.

    An event ends the simulation if it crosses zero between two such states, by a step or by a correction.

    - `t`: the time [s].
    - `y`: the packed state before the correction by the measurements.
    - `status`: the status of the simulation.
    """

    t: Array
    y: Array
    status: Array


@dataclasses.dataclass(frozen=True)
class _Motion:
    """The motion of one trial with process noise, and its measurements."""

    model: Model
    system: System
    calibration: Any
    window: Windows

    @property
    def n(self) -> int:
        """The size of the state in v. The other entries of v are the unknowns of the trial."""
        return len(state_names(self.system))

    def signals(self, b: Array) -> Any:
        return for_fixed_steps(self.model.signals(self.window, self.model.nuisance.with_local(self.calibration, b)))

    def start(self, v: Array) -> Reached:
        y, t = v[: self.n], self.window.t[0]
        valid = is_valid(self.system, y, t, self.signals(v[self.n :]))
        return Reached(t, y, jnp.where(valid, jnp.int32(Status.COMPLETED), jnp.int32(Status.INVALID)))

    def predicted(self, v: Array, S: Array, t0: Array, t1: Array, reached: Reached):
        """The mean v and the root S at t1 from those at t0, and the rotation of the coordinates of S.

        The steps are at most those of the window. The result is NaN if the simulation has ended.
        """
        noise: Any = self.model.noise
        n, n_w, dtype = v.shape[0], len(noise.names), v.dtype
        density, named = noise.spectral_densities(self.calibration), (self.system.speeds, self.system.states)
        # The derivative of a square root is infinite at zero, and zero times infinity is NaN: mask the argument too.
        lasts = density > 0
        amplitude = jnp.tile(jnp.where(lasts, jnp.sqrt(jnp.where(lasts, density, 1.0)), 0.0), MODES)
        # Without the tolerance, rounding of the times would double the steps of an interval that is one step long.
        number = jnp.maximum(jnp.ceil((t1 - t0) / self.window.step - 1e-6), 1.0)
        moving = t1 > t0
        length = jnp.where(moving, (t1 - t0) / number, self.window.step)

        def piece(i: Array, carry: PyTree) -> Any:
            v, S, back, reached = carry
            done = i.astype(dtype)
            t_start = t0 + done * length
            # The last step must end exactly at the sample: the next step and its inputs start there.
            t_end = jnp.where(done + 1 >= number, t1, t_start + length)

            def flow(v: Array, xi: Array) -> Array:
                disturbance = Disturbance(t_start, t_end, xi.reshape(MODES, n_w), noise.names, *named)
                return self.moved(v, t_start, t_end, disturbance)

            v1, A = moments(flow, v, S, amplitude)
            reached = self.reached(v1, t_end, reached)
            S, Q = root(A)
            return jnp.where(reached.status > 0, jnp.nan, v1), S, back @ Q[:n], reached

        # The number of steps is traced, so JAX can differentiate this loop in forward mode only.
        times = jnp.where(moving, number, 0.0).astype(jnp.int32)
        return jax.lax.fori_loop(jnp.int32(0), times, piece, (v, S, jnp.eye(n, dtype=dtype), reached))

    def moved(self, v: Array, t0: Array, t1: Array, disturbance: Disturbance) -> Array:
        y, b, settings = v[: self.n], v[self.n :], self.model.settings
        return jnp.concatenate([one_step(self.system, y, t0, t1, self.signals(b), settings, disturbance), b])

    def reached(self, v: Array, t: Array, before: Reached) -> Reached:
        # A status is an integer. Without `stop_gradient`, the event functions would be differentiated for nothing.
        y = jax.lax.stop_gradient(v[: self.n])
        ended = ends_between(self.system, before.t, before.y, t, y, self.signals(v[self.n :]))
        status = jnp.where(jnp.all(jnp.isfinite(y)), ended, jnp.int32(Status.STEP_TOO_SMALL))
        return Reached(t, y, jnp.where(before.status > 0, before.status, status))

    def measured(self, v: Array, t: Array) -> Array:
        """The readings of the sensors (n_c,)."""
        system, model = self.system, self.model
        state, b = unpacked(system, v[: self.n]), v[self.n :]
        values = values_of(system, state.x, inputs_at(system, self.signals(b), t, state))
        calibration = model.nuisance.with_local(self.calibration, b)
        return model.as_read([*sensed(system, model.channels, t, state.q, state.u, values)], calibration)


def information_of(model: Model, window: Windows, start: Array, start_dot: Array, z: Array, b: Array, x: Array):
    """Residuals (m,) of one trial for Fisher scoring, their derivatives (m, n_z + n_b + p), and the prediction.

    J^T r is the gradient of half of minus twice the log likelihood. J^T J is the expected (Fisher) information. A
    least-squares step with these rows is a step of Fisher scoring. Given the earlier innovations, each innovation e is
    Gaussian with standard deviation s:

        e_dot / s,   e / s;      sqrt(2) s_dot / s,   (1 - e^2 / s^2) / sqrt(2)
    """
    noise: Any = model.noise
    n_z, n_b, k = z.shape[0], b.shape[0], z.shape[0] + b.shape[0] + x.shape[0]
    # An unknown that is a random variable of the filter does not need derivatives: the result does not depend on it.
    moves = np.array([j for j in range(k) if j >= n_z + n_b or not noise.random[j]], dtype=np.int32)
    unit = jnp.eye(k, dtype=z.dtype)[moves]
    directions = (start_dot.T[moves], unit[:, n_z : n_z + n_b], unit[:, n_z + n_b :])

    def along(*direction):
        def of(start: Array, b: Array, x: Array):
            result = filtered(model, window, start, b, x)
            return (result.innovation, result.deviation), result

        return jax.jvp(of, (start, b, x), direction, has_aux=True)

    (e, s), dots, result = jax.vmap(along, out_axes=(None, -1, None))(*directions)
    priors = model.priors(window, z, b)
    priors_dot = jnp.concatenate(jax.jacfwd(model.priors, argnums=(1, 2))(window, z, b), axis=1)
    priors_dot = jnp.pad(priors_dot, ((0, 0), (0, x.size)))
    measured = (window.weight > 0).ravel()
    e, s = e.ravel(), s.ravel()
    dots = (jnp.where(measured[:, None], d.reshape(e.size, -1), 0.0) for d in dots)
    e_dot, s_dot = (jnp.zeros((e.size, k), e.dtype).at[:, moves].set(d) for d in dots)
    r = jnp.where(measured, e / s, 0.0)
    of_size = jnp.where(measured, (1 - r**2) / 2**0.5, 0.0)
    J = jnp.concatenate([e_dot / s[:, None], 2**0.5 * s_dot / s[:, None], priors_dot])
    s, e, seen = result.deviation, result.innovation, window.weight > 0
    value = jnp.sum(jnp.where(seen, (e / s) ** 2 + 2 * jnp.log(s) + LOG_2PI, 0.0)) + jnp.sum(priors**2)
    # A sample that gives an initial value does not have an innovation.
    s = s.at[:, 0].set(jnp.where(window.start_weight > 0, jnp.nan, s[:, 0]))
    return (
        jnp.concatenate([r, of_size, priors]),
        J,
        Prediction(result.predicted, result.status, s, value, result.unknowns),
    )
