"""A Kalman filter as pure functions of one time step: what is known of a motion while it goes on.

The state is v = [q, u, x, p], with the parameters p that are estimated too; its uncertainty is a root S of the
covariance, P = S S^T, which no rounding error makes indefinite. `lag` states before are kept with their correlations,
for a smoother of fixed lag and for measurements that arrive late.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import hint, real_number
from .._integrate.simulate import checked_state
from .._kane.arguments import check_is_system, checked_inputs
from .._kane.checks import check_system
from .._kane.constraints import check_state, configuration_residual, has_configuration_constraints, projected
from .._kane.equations import dependent_speeds
from .._kane.rhs import output_names, outputs_at, values_of, vector_field
from .._scalarjit.cache_key import jit
from .._system.parameters import parameters_in, with_parameters
from .._system.system import State, System, packed, unpacked
from ._process_noise import MODES, Disturbance, checked_noise
from ._square_root import ordered, root
from ._square_root import update as update_root

Inputs = Mapping[str, Any] | None


class Belief(eqx.Module):
    """What is known of the motion at a time.

    Attributes: `t` (lag + 1,) [s]: now, and the times before; `mean` (lag + 1, n); `root` (lag + 1, n, k): S, of which
    S S^T is the covariance, with the columns that all times have in common.
    """

    t: Float[Array, " m"]
    mean: Float[Array, "m n"]
    root: Float[Array, "m n k"]

    def covariance(self, age: int = 0) -> Float[Array, "n n"]:
        """Of the state `age` steps ago."""
        return self.root[age] @ self.root[age].T

    def deviation(self, age: int = 0) -> Float[Array, " n"]:
        """Standard deviations of the state `age` steps ago."""
        return jnp.sqrt(jnp.sum(self.root[age] ** 2, axis=1))


class Innovation(eqx.Module):
    """What a measurement said that was not expected.

    Attributes: `predicted` (n_c,): before anything was measured. `difference`, `deviation` (n_c,): measured less
    predicted, each after those before it, and the standard deviation of that; zero and one in gaps. `nis`: the
    normalized innovation squared, e^T (H P H^T + R)^-1 e, which is chi squared with `n` degrees of freedom where the
    filter is consistent.
    """

    predicted: Float[Array, " n_c"]
    difference: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    nis: Float[Array, ""]
    n: Array


class Filter(eqx.Module):
    """A system, its sensors and what disturbs it: all that `predict` and `update` need besides what is known.

        filter = Filter(bicycle, {"roll_rate": 0.01}, noise={"roll_rate": 0.1})
        belief = begin(filter, state, {"roll": 0.1, "roll_rate": 0.1})
        belief = predict(filter, belief, 0.01, {"steer_torque": 0.3})
        belief, innovation = update(filter, belief, {"roll_rate": 0.02})

    **Arguments:**

    - `sensors`: by name the standard deviation of a coordinate, speed, state or output that is measured.
    - `noise`: by name the spectral density of the white noise that disturbs an independent speed or a state
        [unit^2/s], or an input [unit^2 s].
    - `drift`: by name the spectral density of a parameter that is estimated too [unit^2/s]; 0.0 if it is constant.
    - `method`: "extended" linearizes at the mean; "unscented" takes the mean of points on both sides of it, of equal
        weight (the cubature filter).
    - `lag`: how many states before are kept. `substeps`: of the integration in one `predict`, by the classical
        Runge-Kutta method.
    """

    system: System
    sensors: tuple[str, ...] = eqx.field(static=True)
    sigma: Float[Array, " n_c"]
    noise: tuple[str, ...] = eqx.field(static=True)
    density: Float[Array, " n_w"]
    parameters: tuple[str, ...] = eqx.field(static=True)
    drift: Float[Array, " n_p"]
    method: Literal["extended", "unscented"] = eqx.field(static=True)
    lag: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        sensors: Mapping[str, float],
        *,
        noise: Mapping[str, float] | None = None,
        drift: Mapping[str, float] | None = None,
        method: Literal["extended", "unscented"] = "extended",
        lag: int = 0,
        substeps: int = 1,
    ):
        check_is_system(system)
        noise, drift = {} if noise is None else noise, {} if drift is None else drift
        measurable = (*system.coordinates, *system.speeds, *system.states, *system.dependent_speeds)
        known = {
            "sensors": (sensors, (*measurable, *output_names(system))),
            "drift": (drift, tuple(name for name, value, _ in parameters_in(system) if np.ndim(value) == 0)),
        }
        for label, (given, names) in known.items():
            if not isinstance(given, Mapping):
                raise TypeError(f"Filter: `{label}` is a dict of numbers by name, got {given!r}.")
            for name, value in given.items():
                if name not in names:
                    raise ValueError(f"Filter: `{label}` names {name!r}; {hint(name, names, 'it may name')}")
                number = real_number(value, f"Filter: `{label}` of {name}")
                if not (0 <= number < np.inf) or (label == "sensors" and number == 0):
                    raise ValueError(f"Filter: `{label}` of {name} is {number}: it must be positive and finite.")
        if not sensors:
            raise ValueError("Filter: `sensors` names nothing that is measured.")
        if method not in ("extended", "unscented"):
            raise ValueError(f'Filter: `method` is "extended" or "unscented", got {method!r}.')
        for label, number, least in (("lag", lag, 0), ("substeps", substeps, 1)):
            if not isinstance(number, int) or isinstance(number, bool) or number < least:
                raise ValueError(f"Filter: `{label}` is a whole number of {least} at least, got {number!r}.")
        array = lambda given: jnp.asarray(np.array([*given.values()], float), jnp.result_type(float))  # noqa: E731
        self.system, self.method, self.lag, self.substeps = system, method, lag, substeps
        self.sensors, self.parameters = tuple(sensors), tuple(drift)
        self.sigma, self.drift = array(sensors), array(drift)
        self.noise, self.density = checked_noise(system, noise, "Filter: `noise`")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the state that is estimated: coordinates, independent speeds, states, parameters."""
        return (*self.system.coordinates, *self.system.speeds, *self.system.states, *self.parameters)

    def system_at(self, v: Float[Array, " n"]) -> System:
        """The system with the parameters that are estimated."""
        p = v[len(self.names) - len(self.parameters) :]
        return (
            with_parameters(self.system, dict(zip(self.parameters, p, strict=True))) if self.parameters else self.system
        )


def begin(filter: Filter, state: State, deviation: Mapping[str, float], t: float = 0.0) -> Belief:
    """What is known at the start: a state, as `assemble` gives it, and standard deviations by name, zero of what is not
    named.

    **Raises:** `ValueError` for a name that the filter does not estimate, and for a state that violates a constraint.
    """
    names, state = filter.names, checked_state(filter.system, state)
    check_state(filter.system, t, state.q)
    check_system(filter.system, t, state.q)
    for name, value in deviation.items():
        if name not in names:
            raise ValueError(f"begin: `deviation` names {name!r}; {hint(name, names, 'the filter estimates')}")
        if not 0 <= real_number(value, f"begin: the deviation of {name}") < np.inf:
            raise ValueError(f"begin: the deviation of {name} is {value}: it is not negative, and finite.")
    by_name = {name: value for name, value, _ in parameters_in(filter.system)}
    v = jnp.concatenate([packed(state), *(jnp.reshape(by_name[name], 1) for name in filter.parameters)])
    S = jnp.asarray(np.diag([float(deviation.get(name, 0.0)) for name in names]), v.dtype)
    v, S = brought_back(filter.system, jnp.asarray(t, v.dtype), v, S)
    m, n = filter.lag + 1, len(names)
    return Belief(jnp.full(m, t, v.dtype), jnp.tile(v, (m, 1)), jnp.tile(_widened(S, n * m), (m, 1, 1)))


@jit
def predict(filter: Filter, belief: Belief, dt: Any, inputs: Inputs = None) -> Belief:
    """What is known a time `dt` [s] later, while `inputs` keep their values. A `dt` of 0 changes nothing; where it is
    negative, everything is NaN."""
    m, n = belief.mean.shape
    k, n_w = belief.root.shape[2], len(filter.noise)
    t, dt = belief.t[0], jnp.asarray(dt, belief.mean.dtype)
    still = dt == 0
    dt = jnp.where(still, 1.0, jnp.where(dt > 0, dt, jnp.nan))
    values = {name: jnp.asarray(x, dt.dtype) for name, x in checked_inputs(filter.system, inputs).items()}
    amplitude = jnp.tile(jnp.sqrt(filter.density), MODES)

    def flow(v: Array, xi: Array) -> Array:
        return _flow(filter, t, dt, v, (amplitude * xi).reshape(MODES, n_w), values)

    zero = jnp.zeros(MODES * n_w, dt.dtype)
    directions = jnp.concatenate([belief.root[0], jnp.zeros((n, zero.size), dt.dtype)], axis=1)
    unit = jnp.concatenate([jnp.zeros((zero.size, k), dt.dtype), jnp.eye(zero.size, dtype=dt.dtype)], axis=1)
    if filter.method == "extended":
        along = lambda *direction: jax.jvp(flow, (belief.mean[0], zero), direction)  # noqa: E731
        v, A = jax.vmap(along, in_axes=1, out_axes=(None, 1))(directions, unit)
        before = jnp.concatenate([belief.root[:-1], jnp.zeros((m - 1, n, zero.size), dt.dtype)], axis=2)
    else:
        spread = jnp.sqrt(jnp.asarray(k + zero.size, dt.dtype))
        points = jax.vmap(lambda s, d, e: flow(belief.mean[0] + s * spread * d, s * spread * e), in_axes=(None, 1, 1))
        ends = jnp.concatenate([points(one, directions, unit) for one in (jnp.ones_like(dt), -jnp.ones_like(dt))])
        v = jnp.mean(ends, axis=0)
        A = (ends - v[None]).T / jnp.sqrt(jnp.asarray(len(ends), dt.dtype))
        half = jnp.sqrt(jnp.asarray(0.5, dt.dtype))
        before = jnp.concatenate([belief.root[:-1], jnp.zeros((m - 1, n, zero.size), dt.dtype)], axis=2)
        before = jnp.concatenate([half * before, -half * before], axis=2)
    of_drift = jnp.zeros((n, n), dt.dtype)
    places = np.arange(n - len(filter.parameters), n)
    of_drift = of_drift.at[places, places].set(jnp.sqrt(filter.drift * dt))
    stacked = jnp.concatenate([A[None], before])
    stacked = jnp.concatenate([stacked, jnp.zeros((m, n, n), dt.dtype).at[0].set(of_drift)], axis=2)
    S = _root(filter, stacked.reshape(m * n, -1)).reshape(m, n, m * n)
    v, top = brought_back(filter.system_at(v), t + dt, v, S[0])
    mean = jnp.concatenate([v[None], belief.mean[:-1]])
    after = Belief(jnp.concatenate([(t + dt)[None], belief.t[:-1]]), mean, S.at[0].set(top))
    return jax.tree.map(lambda new, old: jnp.where(still, old, new), after, belief)


@jit
def update(
    filter: Filter, belief: Belief, measured: Any, inputs: Inputs = None, *, age: int = 0
) -> tuple[Belief, Innovation]:
    """What is known after a measurement.

    **Arguments:**

    - `measured`: by name, those left out are gaps; or (n_c,) in the order of `filter.sensors`, NaN in gaps.
    - `inputs`: that acted when it was measured, for sensors that feel them, as an accelerometer does.
    - `age`: how many steps ago it was measured, `lag` at most.
    """
    if not 0 <= age <= filter.lag:
        raise ValueError(f"update: `age` is {age}, and the filter keeps {filter.lag} states before: see `lag`.")
    m, n = belief.mean.shape
    y = _as_measured(filter, measured, belief.mean.dtype)
    values = {name: jnp.asarray(x, y.dtype) for name, x in checked_inputs(filter.system, inputs).items()}
    is_measured = jnp.isfinite(y)
    sigma = jnp.where(is_measured, filter.sigma.astype(y.dtype), 1.0)

    def h(v: Array) -> Array:
        system = filter.system_at(v)
        state = unpacked(system, v[: len(filter.names) - len(filter.parameters)])
        return sensed(system, filter.sensors, belief.t[age], state.q, state.u, values_of(system, state.x, values))

    v, S, k = belief.mean[age], belief.root[age], belief.root.shape[2]
    if filter.method == "extended":
        along = lambda direction: jax.jvp(h, (v,), (direction,))  # noqa: E731
        predicted, H = jax.vmap(along, in_axes=1, out_axes=(None, 1))(S)
        columns = belief.root
    else:
        spread = jnp.sqrt(jnp.asarray(k, y.dtype))
        ends = jnp.concatenate([jax.vmap(lambda d, s=s: h(v + s * spread * d), in_axes=1)(S) for s in (1.0, -1.0)])
        predicted = jnp.mean(ends, axis=0)
        H = (ends - predicted[None]).T / jnp.sqrt(jnp.asarray(len(ends), y.dtype))
        columns = jnp.concatenate([belief.root, -belief.root], axis=2) * jnp.sqrt(jnp.asarray(0.5, y.dtype))
    known = update_root(jnp.where(is_measured, y - predicted, 0.0), H, sigma, is_measured)
    columns = columns.reshape(m * n, -1)
    mean = belief.mean + (columns @ known.shift).reshape(m, n)
    S = _root(filter, columns @ known.left).reshape(m, n, m * n)
    v, top = brought_back(filter.system_at(mean[0]), belief.t[0], mean[0], S[0])
    after = Belief(belief.t, mean.at[0].set(v), S.at[0].set(top))
    nis = jnp.sum((known.innovation / known.deviation) ** 2)
    return after, Innovation(predicted, known.innovation, known.deviation, nis, jnp.sum(is_measured))


def nees(belief: Belief, truth: Float[Array, " n"], age: int = 0) -> Array:
    """The normalized estimation error squared, (m - v)^T P^-1 (m - v), of a simulation whose truth is known: chi
    squared with as many degrees of freedom as P has rank, where the filter is consistent."""
    return _of_rank(belief.covariance(age), truth - belief.mean[age])


def _of_rank(P: Array, error: Array) -> Array:
    values, vectors = jnp.linalg.eigh(P)
    counts = values > 1e-12 * jnp.max(values)
    along = vectors.T @ error
    return jnp.sum(jnp.where(counts, along**2 / jnp.where(counts, values, 1.0), 0.0))


def _flow(filter: Filter, t0: Array, dt: Array, v: Array, xi: Array, inputs: dict[str, Array]) -> Array:
    """The state a time dt later, by the classical Runge-Kutta method; `xi` (MODES, n_w): what noise does."""
    system, n = filter.system_at(v), len(filter.names) - len(filter.parameters)
    h = dt / filter.substeps
    disturbance = Disturbance(t0, t0 + dt, xi, filter.noise, system.speeds, system.states)

    def rates(t: Array, y: Array) -> Array:
        state = unpacked(system, y)
        disturbed, extra = disturbance(t, inputs, state)
        return vector_field(system, t, y, disturbed) + packed(extra)

    def substep(y: Array, i: Array) -> tuple[Array, None]:
        t = t0 + i * h
        k1 = rates(t, y)
        k2 = rates(t + h / 2, y + h / 2 * k1)
        k3 = rates(t + h / 2, y + h / 2 * k2)
        k4 = rates(t + h, y + h * k3)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    y, _ = jax.lax.scan(substep, v[:n], jnp.arange(filter.substeps, dtype=v.dtype), unroll=filter.substeps < 3)
    return jnp.concatenate([y, v[n:]])


def sensed(system: System, sensors: tuple[str, ...], t: Any, q: Array, u: Array, values: Mapping[str, Any]) -> Array:
    """What the sensors read (n_c,) at a state, whose states of the first order stand among the `values` of inputs."""
    by_name = dict(zip((*system.coordinates, *system.speeds), (*q, *u), strict=True))
    by_name |= {name: values[name] for name in system.states}
    if {*system.dependent_speeds} & {*sensors}:
        by_name |= dict(zip(system.dependent_speeds, dependent_speeds(system, t, q, u), strict=True))
    if not {*sensors} <= by_name.keys():
        by_name |= outputs_at(system, t, q, u, values)
    return jnp.stack([by_name[name] for name in sensors])


def _as_measured(filter: Filter, measured: Any, dtype: Any) -> Array:
    if isinstance(measured, Mapping):
        for name in measured:
            if name not in filter.sensors:
                raise ValueError(f"update: {name!r} is measured; {hint(name, filter.sensors, 'the filter has')}")
        return jnp.stack([jnp.asarray(measured.get(name, jnp.nan), dtype) for name in filter.sensors])
    measured = jnp.asarray(measured, dtype)
    if measured.shape != (len(filter.sensors),):
        raise ValueError(f"update: `measured` has the shape {measured.shape}, not ({len(filter.sensors)},).")
    return measured


def _root(filter: Filter, A: Array) -> Array:
    return root(A)[0] if filter.method == "extended" else ordered(root(A)[0])


def _widened(S: Array, k: int) -> Array:
    return jnp.concatenate([S, jnp.zeros((S.shape[0], k - S.shape[1]), S.dtype)], axis=1)


def brought_back(system: System, t: Array, v: Array, S: Array) -> tuple[Array, Array]:
    """The nearest coordinates that meet the constraints, and deviations that are tangent to them there."""
    n_q = len(system.coordinates)
    if not has_configuration_constraints(system, t, v[:n_q]):
        return v, S
    v = v.at[:n_q].set(projected(system, t, v[:n_q]))
    return v, tangent(system, t, v, S, tuple(range(n_q)))


def tangent(system: System, t: Array, v: Array, S: Array, moved: tuple[int, ...]) -> Array:
    """Deviations S (n, k) that meet the constraints to first order: `moved` coordinates by as little as that takes."""
    n_q, at = len(system.coordinates), jnp.asarray(moved, dtype=jnp.int32)
    G = jax.jacfwd(lambda q: configuration_residual(system, t, q))(v[:n_q])  # (h, n_q)
    own = G[:, at]
    return S.at[at].add(-own.T @ jnp.linalg.solve(own @ own.T, G @ S[:n_q]))
