"""The extended Kalman filter of one trial, and its likelihood, linearized. Knows `Model` and matrices; no optimizer.

What is filtered is v = [q, u, x, b]: coordinates, independent speeds, states of the first order, and the trial's own
unknowns (of its sensors and inputs), which stay as they are. From measurement to measurement the mean moves as
`simulate` moves it, and a root of the covariance as its exact derivatives do. Where constraints bind coordinates,
deviations are tangent to them: the flow keeps them so, and after every update the mean is brought back to the nearest
coordinates that meet the constraints, the deviations to their tangents there. What has a standard deviation of its own
(a start, a bias) begins with it; what has none is no random variable, but an unknown that is found with the parameters.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._description.system import System, packed, unpacked
from ..._method.description_facts import configuration_residual
from ..._method.drift import has_configuration_constraints, projected
from ..._simulation.ride import solve
from ..._simulation.signals import with_one_times
from .._data.windows import Windows, state_names
from .kalman import Step, root, update
from .noise import MODES, Disturbance, Noise

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
    system, roles = model.parameters.apply(model.system, x)
    y, weight, t = window.measured.T, window.weight.T, window.t  # (n_t, n_c), (n_t,)
    factor = jnp.stack([jnp.asarray(roles.get(("sigma", c), 1.0), x.dtype) for c in model.channels])
    begin = _given_deviations(model, start.shape[0]) if begin is None else begin
    S = jnp.diag(begin)
    if has_configuration_constraints(system, t[0], start[: len(system.coordinates)]):
        S = _tangent(system, t[0], start, S, model.moved)

    def go_on(known: tuple[Array, Array], now: Any) -> tuple[Any, Any]:
        before, t, y, weight = now
        v, S, h, F, back, status = _predicted(model, system, roles, window, known, before, t)
        seen = weight > 0
        sigma = factor / jnp.where(seen, weight, 1.0)
        new = update(jnp.where(seen, y - h, 0.0), F, sigma, seen)
        mean, after = brought_back(system, t, v + S @ new.shift, S @ new.left)
        step = Step(v, S, new.shift, new.left, back)
        return (mean, after), (new.innovation, new.deviation, h + new.known, status, step)

    began = (jnp.concatenate([start, _fixed(model, b)]), S)
    # The first sample is met where the motion begins, after no time at all.
    times = (jnp.concatenate([t[:1], t[:-1]]), t)
    (mean, _), (e, s, predicted, status, steps) = jax.lax.scan(go_on, began, (*times, y, weight))
    return Filtered(e.T, s.T, predicted.T, mean[start.shape[0] :], jnp.max(status), steps)


def _predicted(model: Any, system: System, roles: Any, window: Windows, known: Any, t0: Array, t1: Array):
    """Mean v and root S at t1, what is predicted there h (n_c,), its sensitivity F (n_c, n) in units of S, the rotation
    of that unit, and the worst status; by steps of at most the window's."""
    noise: Noise = model.noise
    v, S = known
    n, n_w, n_c, dtype = v.shape[0], len(noise.names), len(model.channels), v.dtype
    intensity, named = noise.intensities(roles), (system.speeds, system.states)
    lasts = intensity > 0
    amplitude = jnp.where(lasts, jnp.sqrt(jnp.where(lasts, intensity, 1.0)), 0.0)
    moving = t1 > t0
    number = jnp.maximum(jnp.ceil((t1 - t0) / window.step - 1e-6), 1.0)
    length = jnp.where(moving, (t1 - t0) / number, window.step)
    of_noise = jnp.tile(jnp.diag(amplitude), (MODES, 1)).reshape(MODES * n_w, n_w)
    xi_directions = jnp.zeros((MODES * n_w, MODES, n_w), dtype)
    places = jnp.arange(MODES * n_w, dtype=jnp.int32)
    xi_directions = xi_directions.at[places, places // max(n_w, 1)].set(of_noise)
    xi_directions = jnp.concatenate([jnp.zeros((n, MODES, n_w), dtype), xi_directions])

    def piece(i: Array, so_far: Any) -> Any:
        v, S, _, _, back, status = so_far
        i = i.astype(dtype)
        begun = t0 + i * length
        ended = jnp.where(moving & (i + 1 >= number), t1, begun + length)

        def flow(v: Array, xi: Array) -> Any:
            return _flow(model, system, roles, window, v, Disturbance(begun, ended, xi, noise.names, *named))

        v_directions = jnp.concatenate([S.T, jnp.zeros((MODES * n_w, n), dtype)])
        along = lambda *direction: jax.jvp(flow, (v, jnp.zeros((MODES, n_w), dtype)), direction, has_aux=True)  # noqa: E731
        (v1, h), (A, g), code = jax.vmap(along, out_axes=(None, -1, None))(v_directions, xi_directions)
        v1 = jnp.where(moving, v1, v)
        A = jnp.where(moving, A, v_directions.T)
        h, g = (jnp.where(moving, x[:, 1], x[:, 0]) for x in (h, g))  # (n_c,), (n_c, k)
        S, Q = root(A)
        return v1, S, h, g @ Q, back @ Q[:n], jnp.where(status > 0, status, code)

    nothing = jnp.zeros(n_c, dtype), jnp.zeros((n_c, n), dtype), jnp.eye(n, dtype=dtype), jnp.zeros((), jnp.int32)
    return jax.lax.fori_loop(jnp.int32(0), number.astype(jnp.int32), piece, (v, S, *nothing))


def _flow(model: Any, system: System, roles: Any, window: Windows, v: Array, disturbance: Disturbance):
    """v at the end of a step, what is measured at its two ends (n_c, 2); and the simulation's status."""
    n = len(state_names(system))
    b, ts = v[n:], jnp.stack([disturbance.t0, disturbance.t1])
    settings = model.settings
    if settings.step is not None:
        settings = dataclasses.replace(settings, step=ts[1] - ts[0])
    signals = with_one_times(model.signals(window, b, roles))
    ride = solve(system, unpacked(system, v[:n]), ts, signals, settings, disturbance)
    return (jnp.concatenate([packed(ride.state()), b]), model.simulated(ride, b, roles)), ride.status


def brought_back(system: System, t: Array, v: Array, S: Array) -> tuple[Array, Array]:
    """The nearest coordinates that meet the constraints, and deviations that are tangent to them there."""
    n_q = len(system.coordinates)
    if not has_configuration_constraints(system, t, v[:n_q]):
        return v, S
    v = v.at[:n_q].set(projected(system, t, v[:n_q]))
    return v, _tangent(system, t, v, S, tuple(range(n_q)))


def _tangent(system: System, t: Array, v: Array, S: Array, moved: tuple[int, ...]) -> Array:
    """Deviations S (n, k) that meet the constraints to first order: `moved` coordinates by as little as that takes."""
    n_q, at = len(system.coordinates), jnp.asarray(moved, dtype=jnp.int32)
    G = jax.jacfwd(lambda q: configuration_residual(system, t, q))(v[:n_q])  # (h, n_q)
    own = G[:, at]
    return S.at[at].add(-own.T @ jnp.linalg.solve(own @ own.T, G @ S[:n_q]))


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
            found = filtered(model, window, start, b, x)
            return (found.innovation, found.deviation), found

        return jax.jvp(of, (start, b, x), direction, has_aux=True)

    (e, s), dots, found = jax.vmap(along, out_axes=(None, -1, None))(*directions)
    priors = model.priors(window, z, b, x)
    priors_dot = jnp.concatenate(jax.jacfwd(model.priors, argnums=(1, 2, 3))(window, z, b, x), axis=1)
    seen = (window.weight > 0).ravel()
    e, s = e.ravel(), s.ravel()
    dots = (jnp.where(seen[:, None], d.reshape(e.size, -1), 0.0) for d in dots)
    e_dot, s_dot = (jnp.zeros((e.size, k), e.dtype).at[:, moves].set(d) for d in dots)
    r = jnp.where(seen, e / s, 0.0)
    of_size = jnp.where(seen, (1 - r**2) / 2**0.5, 0.0)
    J = jnp.concatenate([e_dot / s[:, None], 2**0.5 * s_dot / s[:, None], priors_dot])
    value = minus_twice_log_likelihood(found, window) + jnp.sum(priors**2)
    return J, jnp.concatenate([r, of_size, priors]), value, found


def minus_twice_log_likelihood(found: Filtered, window: Windows) -> Array:
    """Of the measurements of one trial."""
    seen, s = window.weight > 0, found.deviation
    return jnp.sum(jnp.where(seen, (found.innovation / s) ** 2 + 2 * jnp.log(s) + LOG_2PI, 0.0))
