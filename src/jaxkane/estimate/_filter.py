"""A Kalman filter as pure functions of one time step, for online estimation.

The state is v = [q, u, x, p], where p are the estimated parameters. Its uncertainty is stored as a root S of the
covariance, P = S S^T, so that rounding errors cannot make P indefinite. The previous `lag` states are kept with their
correlations, for a fixed-lag smoother and for measurements that arrive late.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from .._common.lookup import refuse_unknown, whole_number
from .._integrate.jumps import refuse_jumps
from .._integrate.simulate import checked_state
from .._kane.api import dependent_speeds
from .._kane.arguments import (
    check_is_system,
    check_time,
    checked_inputs,
    is_concrete,
    is_numeric,
    is_one_number,
    refuse_multipliers,
)
from .._kane.checks import check_system
from .._kane.consistent_state import AssemblyProblem, euler_parameters
from .._kane.constraint_residuals import (
    check_state,
    configuration_residual,
    coordinate_weights,
    has_configuration_constraints,
    least_change,
    projected,
)
from .._kane.right_hand_side import output_names, outputs_at, values_of, vector_field
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component, Scalar
from .._system.parameters import concrete_numbers, module_text, parameters_in, text_of, with_parameters, wrapped
from .._system.system import State, System, named_numbers, packed, units_of, unpacked
from ._filter_step import MODES, Disturbance, checked_noise, checked_numbers, moments, root
from ._filter_step import update as update_root

Inputs = Mapping[str, Any] | None


class Belief(eqx.Module):
    """The estimate of a filter: means and covariances of the present state and of the previous `lag` states.

    Attributes:

    - `t`: times (lag + 1,) [s], the present time first.
    - `mean`: means (lag + 1, n) of the states at these times. The order is that of `Filter.names`.
    - `root`: roots S (lag + 1, n, k) of the covariances S S^T. The columns of all times belong to the same variables,
        so the covariance of two times is S_i S_j^T.
    - `rounding`: the rounding error of the present time: the exact time minus `t[0]` [s].
    """

    t: Float[Array, " m"]
    mean: Float[Array, "m n"]
    root: Float[Array, "m n k"]
    rounding: Float[Array, ""]

    def __repr__(self) -> str:
        if concrete_numbers(self.root) is None or self.t.ndim > 1:
            return module_text(self, ndim=0)
        items = {"t": text_of(self.t[0], "s"), "mean": text_of(self.mean[0]), "deviation": text_of(self.deviation())}
        return wrapped(f"Belief({', '.join(map('='.join, items.items()))})")

    def covariance(self, age: int = 0) -> Float[Array, "n n"]:
        """Covariance (n, n) of the state `age` steps ago."""
        _check_age("covariance", self, age)
        return self.root[age] @ self.root[age].T

    def deviation(self, age: int = 0) -> Float[Array, " n"]:
        """Standard deviations (n,) of the state `age` steps ago."""
        _check_age("deviation", self, age)
        return jnp.sqrt(jnp.sum(self.root[age] ** 2, axis=1))


def _check_age(function: str, belief: Belief, age: int) -> None:
    """Check the age. Otherwise, JAX would return the oldest state for a larger age.

    **Raises:** `ValueError` for an age beyond the filter's lag.
    """
    lag = belief.t.shape[-1] - 1
    if not isinstance(age, (int, np.integer)) or not 0 <= age <= lag:
        raise ValueError(
            f"{function}: `age` must be an integer from 0 to the filter's lag {lag}, got {age!r}. A Filter with a "
            "larger `lag` keeps more states."
        )


class Innovation(eqx.Module):
    """The difference between measurements and their predictions.

    The sensors are processed one after the other.

    Attributes:

    - `predicted`: predicted measurements (n_c,) before the update.
    - `difference`: measured minus predicted (n_c,), where each prediction uses the previous sensors. Zero in gaps.
    - `deviation`: standard deviations (n_c,) of the differences. One in gaps.
    - `nis`: normalized innovation squared, e^T (H P H^T + R)^-1 e. If the filter is consistent, it is chi-squared
        distributed with `n` degrees of freedom.
    - `n`: number of measurements without gaps.
    """

    predicted: Float[Array, " n_c"]
    difference: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    nis: Float[Array, ""]
    n: Array

    def __repr__(self) -> str:
        return module_text(self, ndim=1)


class Filter(eqx.Module):
    """A Kalman filter: a system, its sensors and its process noise.

        filter = Filter(bicycle, {"roll_rate": 0.01}, noise={"roll_rate": 0.1})
        belief = begin(filter, state, {"roll": 0.1, "roll_rate": 0.1})
        belief = predict(filter, belief, 0.01, {"steer_torque": 0.3})
        belief, innovation = update(filter, belief, {"roll_rate": 0.02})

    **Arguments:**

    - `system`: the system.
    - `sensors`: standard deviations by name of the measured coordinates, speeds, first-order states or outputs.
    - `noise`: spectral densities by name of white noise that disturbs independent speeds or first-order states
        [unit^2/s], or inputs [unit^2 s].
    - `drift`: spectral densities by name of the parameters that are estimated [unit^2/s]. 0.0 for a constant parameter.
    - `method`: "extended" linearizes at the mean. "unscented" is the cubature filter: it averages over points of equal
        weight on both sides of the mean, and adds the covariance of the noise.
    - `lag`: number of previous states that are kept.
    - `substeps`: number of steps of the classical Runge-Kutta method in one `predict`.

    **Raises:** `TypeError` or `ValueError` for unknown names and invalid numbers.
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
        refuse_multipliers(system)
        refuse_jumps(system, "Filter", "A Kalman filter cannot represent jumps. Estimate between the jumps only.")
        noise, drift = {} if noise is None else noise, {} if drift is None else drift
        measurable = (*system.coordinates, *system.speeds, *system.states, *system.dependent_speeds)
        scalars = tuple(name for name, value, _ in parameters_in(system) if np.ndim(value) == 0)
        measured = checked_numbers(sensors, (*measurable, *output_names(system)), "Filter: `sensors`", positive=True)
        drifts = checked_numbers(drift, scalars, "Filter: `drift`")
        if not measured:
            raise ValueError(
                "Filter: `sensors` is empty. Pass at least one measured quantity with its standard deviation."
            )
        if method not in ("extended", "unscented"):
            raise ValueError(f"Filter: `method` must be 'extended' or 'unscented', got {method!r}.")
        for label, number, least in (("lag", lag, 0), ("substeps", substeps, 1)):
            whole_number(number, least, f"Filter: `{label}`")

        self.system, self.method, self.lag, self.substeps = system, method, lag, substeps
        self.sensors, self.parameters = tuple(measured), tuple(drifts)
        self.sigma, self.drift = (jnp.asarray([*x.values()], jnp.result_type(float)) for x in (measured, drifts))
        self.noise, self.density = checked_noise(system, noise, "Filter: `noise`")

    def __repr__(self) -> str:
        units = units_of(self.system) | {name: info.unit for name, _, info in parameters_in(self.system)}
        of = {"sensors": (self.sensors, self.sigma), "noise": (self.noise, self.density)}
        of["drift"] = (self.parameters, self.drift)
        parts = [type(self.system).__name__, self.method, f"lag={self.lag}, substeps={self.substeps}"]
        for kind, (names, numbers) in of.items():
            numbers_text = named_numbers((names,), (numbers,), {}, units if kind == "sensors" else ())
            parts += [f"{kind}: {numbers_text or text_of(numbers, ndim=1)}"] * bool(names)
        return wrapped(f"Filter({'; '.join(parts)})")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated state: coordinates, independent speeds, first-order states, parameters."""
        return (*self.system.coordinates, *self.system.speeds, *self.system.states, *self.parameters)

    def system_at(self, v: Float[Array, " n"]) -> System:
        """The system with the estimated parameters of the state `v` (n,)."""
        p = v[len(self.names) - len(self.parameters) :]
        return (
            with_parameters(self.system, dict(zip(self.parameters, p, strict=True))) if self.parameters else self.system
        )

    def onto(self, t: Array, v: Float[Array, " n"]) -> Float[Array, " n"]:
        """Project points of the unscented transform onto the constraints, because they violate curved constraints."""
        return v if self.method == "extended" else nearest(self.system_at, t, v)


def begin(filter: Filter, state: State, deviation: Mapping[str, float], t: float = 0.0) -> Belief:
    """The initial belief.

    **Arguments:**

    - `filter`: a `Filter`.
    - `state`: the mean, a `State` that satisfies the constraints, such as the result of `assemble`.
    - `deviation`: standard deviations by name, as in `filter.names`. If a coordinate without standard deviation is
        bound by the constraints, its uncertainty follows from the other coordinates. All others without standard
        deviation are exact.
    - `t`: time [s].

    **Returns:** a `Belief`.

    **Raises:** `ValueError` for a name that the filter does not estimate, for a state that is not finite or violates a
    constraint, and for a time that the type of the state cannot resolve.
    """
    names, state = filter.names, checked_state(filter.system, state)
    check_time("begin", t)
    check_state(filter.system, t, state.q)
    if is_concrete(t) and (step := float(np.spacing(np.abs(np.asarray(t, state.q.dtype))))) > 1e-3:
        raise ValueError(
            f"begin: {state.q.dtype} resolves times near t = {t:.10g} s only to {step:.3g} s. Pass the time since a "
            "later origin, or enable float64: jaxkane.configure()."
        )
    check_system(filter.system, t, state.q)
    deviations = checked_numbers(deviation, names, "begin: `deviation`")
    by_name = {name: value for name, value, _ in parameters_in(filter.system)}
    v = jnp.concatenate([packed(state), *(jnp.reshape(by_name[name], 1) for name in filter.parameters)])
    S = jnp.asarray(np.diag([deviations.get(name, 0.0) for name in names]), v.dtype)
    given = {name: 0.0 for name in filter.system.coordinates if deviations.get(name)}
    moved = {*AssemblyProblem.of(filter.system, given).moved} - {*given}
    moved |= {filter.system.coordinates[i] for four in euler_parameters(filter.system) for i in four}
    v = nearest(filter.system_at, jnp.asarray(t, v.dtype), v)
    S = begun(filter.system_at, jnp.asarray(t, v.dtype), v, S, np.isin(filter.system.coordinates, [*moved]))
    m, n = filter.lag + 1, len(names)
    wide = jnp.concatenate([S, jnp.zeros((n, n * m - S.shape[1]), S.dtype)], axis=1)
    return Belief(jnp.full(m, t, v.dtype), jnp.tile(v, (m, 1)), jnp.tile(wide, (m, 1, 1)), jnp.zeros((), v.dtype))


def _check_belief(function: str, filter: Filter, belief: object) -> None:
    """**Raises:** `TypeError` or `ValueError` if the belief does not belong to this filter."""
    if not isinstance(filter, Filter) or not isinstance(belief, Belief):
        kinds = f"{type(filter).__name__} and {type(belief).__name__}"
        raise TypeError(
            f"{function}: the first arguments must be a Filter and a Belief, as from begin(filter, ...); got {kinds}."
        )
    m, n = filter.lag + 1, len(filter.names)
    if belief.mean.shape != (m, n) or belief.root.shape != (m, n, m * n):
        hint = " For a batch use jax.vmap." if belief.mean.ndim > 2 else ""
        raise ValueError(
            f"{function}: the belief belongs to another filter: its mean has the shape {belief.mean.shape}, but this "
            f"filter needs ({m}, {n}): {', '.join(filter.names)}, with lag={filter.lag}. Call begin(filter, ...)."
            + hint
        )


@jit
def predict(filter: Filter, belief: Belief, dt: Scalar, inputs: Inputs = None) -> Belief:
    """The belief after one time step.

    **Arguments:**

    - `filter`: a `Filter`.
    - `belief`: the belief before the step.
    - `dt`: time step [s]. With 0, the belief is returned unchanged. With a negative number, everything becomes NaN.
    - `inputs`: values by name, constant during the step. Omitted inputs are zero.

    **Returns:** a `Belief`.

    **Raises:** `TypeError` or `ValueError` for the belief of another filter.
    """
    _check_belief("predict", filter, belief)
    m, n = belief.mean.shape
    k, n_w = belief.root.shape[2], len(filter.noise)
    t, dt = belief.t[0], jnp.asarray(dt, belief.mean.dtype)
    # The step is computed even if its length is zero, and would divide by it.
    still = dt == 0
    dt = jnp.where(still, 1.0, jnp.where(dt > 0, dt, jnp.nan))
    values = {name: jnp.asarray(x, dt.dtype) for name, x in checked_inputs(filter.system, inputs).items()}
    amplitude = jnp.tile(jnp.sqrt(filter.density), MODES)

    def flow(v: Array, xi: Array) -> Array:
        return _flow(filter, t, dt, filter.onto(t, v), xi.reshape(MODES, n_w), values)

    v, A = moments(flow, belief.mean[0], belief.root[0], amplitude, filter.method)
    n_y, n_p = n - len(filter.parameters), len(filter.parameters)
    wide = (
        jnp.zeros((m, n, A.shape[1] + n_p), dt.dtype).at[0, :, : A.shape[1]].set(A).at[1:, :, :k].set(belief.root[:-1])
    )
    wide = wide.at[0, n_y:, A.shape[1] :].set(jnp.diag(jnp.sqrt(filter.drift * dt)))
    S = root(wide.reshape(m * n, -1))[0].reshape(m, n, k)
    # Summation by Kahan: near 1.7e9 s, the rounding errors of 20 000 steps of 1 ms would add up to 1.5 ms.
    dt = dt + belief.rounding
    end = t + dt
    v, top = brought_back(filter.system_at, end, v, S[0])
    mean = jnp.concatenate([v[None], belief.mean[:-1]])
    after = Belief(jnp.concatenate([end[None], belief.t[:-1]]), mean, S.at[0].set(top), dt - (end - t))
    return jax.tree.map(lambda new, old: jnp.where(still, old, new), after, belief)


def update(
    filter: Filter,
    belief: Belief,
    measured: Mapping[str, Scalar] | Float[Array, " n_c"],
    inputs: Inputs = None,
    *,
    age: int = 0,
) -> tuple[Belief, Innovation]:
    """The belief after a measurement.

    **Arguments:**

    - `filter`: a `Filter`.
    - `belief`: the belief before the measurement.
    - `measured`: values by name, in which omitted sensors are gaps. Or an array (n_c,) in the order of
        `filter.sensors`, with NaN for gaps.
    - `inputs`: values by name at the time of the measurement, for sensors that depend on them (accelerometers).
    - `age`: number of steps since the measurement, at most `lag`.

    **Returns:** a `Belief` and an `Innovation`.

    **Raises:** `ValueError` for an unknown sensor, an infinite measurement, and the belief of another filter. If
    measurements are traced, an infinite one makes the belief infinite or NaN instead.
    """
    _check_belief("update", filter, belief)
    _check_age("update", belief, age)
    y = _as_measured(filter, measured, belief.mean.dtype)
    if is_concrete(y) and np.isinf(y).any():
        wrong = ", ".join(f"{name} = {x}" for name, x in zip(filter.sensors, np.asarray(y), strict=True) if np.isinf(x))
        raise ValueError(f"update: a measurement is infinite: {wrong}. If it is missing, pass NaN or leave it out.")
    return _update(filter, belief, y, inputs, age=age)


@jit
def _update(filter: Filter, belief: Belief, y: Array, inputs: Inputs, *, age: int) -> tuple[Belief, Innovation]:
    m, n = belief.mean.shape
    values = {name: jnp.asarray(x, y.dtype) for name, x in checked_inputs(filter.system, inputs).items()}
    is_measured = ~jnp.isnan(y)
    sigma = jnp.where(is_measured, filter.sigma.astype(y.dtype), 1.0)

    def h(v: Array, _: Array) -> Array:
        v, system = filter.onto(belief.t[age], v), filter.system_at(v)
        state = unpacked(system, v[: len(filter.names) - len(filter.parameters)])
        return sensed(system, filter.sensors, belief.t[age], state.q, state.u, values_of(system, state.x, values))

    predicted, F = moments(h, belief.mean[age], belief.root[age], jnp.zeros(0, y.dtype), filter.method)
    known = update_root(jnp.where(is_measured, y - predicted, 0.0), F, sigma, is_measured)
    k = belief.root.shape[2]
    mean = belief.mean + belief.root @ known.shift[:k]
    S = root(belief.root.reshape(m * n, k) @ known.left[:k])[0].reshape(m, n, k)
    v, top = brought_back(filter.system_at, belief.t[0], mean[0], S[0])
    after = Belief(belief.t, mean.at[0].set(v), S.at[0].set(top), belief.rounding)
    nis = jnp.sum((known.innovation / known.deviation) ** 2)
    return after, Innovation(predicted, known.innovation, known.deviation, nis, jnp.sum(is_measured))


def nees(belief: Belief, truth: Float[Array, " n"], age: int = 0) -> Array:
    """The normalized estimation error squared, (m - v)^T P^-1 (m - v), for a simulation with known true state.

    If the filter is consistent, it is chi-squared distributed. The number of degrees of freedom is the rank of P.

    **Arguments:**

    - `belief`: a `Belief`.
    - `truth`: the true state (n,) in the order of `filter.names`, including parameters.
    - `age`: number of steps ago, at most `lag`.

    **Raises:** `ValueError` for a wrong shape and for an age beyond the lag.
    """
    _check_age("nees", belief, age)
    n = belief.mean.shape[-1]
    if not is_numeric(truth) or np.shape(truth) != (n,):
        got = f"the shape {np.shape(truth)}" if is_numeric(truth) else f"{type(truth).__name__}"
        raise ValueError(
            f"nees: `truth` must be an array ({n},) in the order of `filter.names`, got {got}. The order is "
            "coordinates, speeds, states, parameters. For a State, pass jnp.concatenate([state.q, state.u])."
        )
    P, error = belief.covariance(age), truth - belief.mean[age]
    # Use the rank of the correlations. With metres and nanometres, eigenvalues of P cannot be compared.
    deviation = jnp.sqrt(jnp.where(jnp.diagonal(P) > 0, jnp.diagonal(P), 1.0))
    values, vectors = jnp.linalg.eigh(P / jnp.outer(deviation, deviation))
    counts = values > 1e-12 * jnp.max(values)
    along = vectors.T @ (error / deviation)
    return jnp.sum(jnp.where(counts, along**2 / jnp.where(counts, values, 1.0), 0.0))


def _flow(filter: Filter, t0: Array, dt: Array, v: Array, xi: Array, inputs: dict[str, Array]) -> Array:
    """The state after a time dt, by the classical Runge-Kutta method. `xi` (MODES, n_w): coefficients of the noise."""
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


def sensed(
    system: System, sensors: tuple[str, ...], t: Component, q: Array, u: Array, values: Mapping[str, Any]
) -> Array:
    """The readings (n_c,) of the sensors at a state. `values` contains inputs and first-order states by name."""
    by_name = dict(zip((*system.coordinates, *system.speeds), (*q, *u), strict=True))
    by_name |= {name: values[name] for name in system.states}
    if {*system.dependent_speeds} & {*sensors}:
        by_name |= dict(zip(system.dependent_speeds, dependent_speeds(system, t, q, u), strict=True))
    if not {*sensors} <= by_name.keys():
        by_name |= outputs_at(system, t, q, u, values)
    return jnp.stack([by_name[name] for name in sensors])


def _as_measured(filter: Filter, measured: Mapping[str, Scalar] | Float[Array, " n_c"], dtype: DTypeLike) -> Array:
    if isinstance(measured, Mapping):
        refuse_unknown(measured, filter.sensors, "update: `measured` contains unknown names:", "the filter has")
        for name, value in measured.items():
            if not is_one_number(value):
                raise TypeError(f"update: the measurement of {name!r} must be one number, got {value!r}.")
        values = [measured.get(name, np.nan) for name in filter.sensors]
        xp: Any = (
            np if is_concrete(values) else jnp
        )  # without jit, JAX would take longer for this than for the whole update
        return xp.stack([xp.asarray(x, dtype) for x in values])
    if not is_numeric(measured):
        raise TypeError(f"update: `measured` must be a dict by name or an array of numbers, got {measured!r}.")
    measured = jnp.asarray(measured, dtype)
    if measured.shape != (len(filter.sensors),):
        raise ValueError(f"update: `measured` must have the shape ({len(filter.sensors)},), got {measured.shape}.")
    return measured


SystemAt = Callable[[Array], System]
"""The system with the parameters that a state v contains."""


def brought_back(system_at: SystemAt, t: Array, v: Array, S: Array) -> tuple[Array, Array]:
    """The state with the nearest coordinates that satisfy the constraints, and a root S that is tangent to these."""
    v, system = nearest(system_at, t, v), system_at(v)
    q = v[: len(system.coordinates)]
    if not has_configuration_constraints(system, t, q):
        return v, S
    return v, _tangent(system_at, t, v, S, coordinate_weights(system, t, q))


def nearest(system_at: SystemAt, t: Array, v: Array) -> Array:
    """The state with the nearest coordinates that satisfy the constraints."""
    system, n_q = system_at(v), len(system_at(v).coordinates)
    if not has_configuration_constraints(system, t, v[:n_q]):
        return v
    return v.at[:n_q].set(projected(system, t, v[:n_q]))


def _tangent(system_at: SystemAt, t: Array, v: Array, S: Array, weights: Array) -> Array:
    """The nearest root S (n, k) of the covariance whose columns satisfy the constraints to first order.

    Changes of the coordinates are measured in `weights` (n_q,). Without weights, metres would be added to radians.
    """
    n_q = weights.size
    G = jax.jacfwd(lambda v: configuration_residual(system_at(v), t, v[:n_q]))(v)  # (h, n)
    return S.at[:n_q].add(-least_change(G[:, :n_q], G @ S, weights))


def begun(system_at: SystemAt, t: Array, v: Array, S: Array, moved: np.ndarray) -> Array:
    """A root S (n, k) of the initial covariance that satisfies the constraints.

    First, only the deviations of the coordinates in the mask `moved` (n_q,) are changed. If this does not suffice, the
    deviations contradict the constraints. The Gaussian distribution is then conditioned on the constraints. This is the
    smallest change in the metric of its own covariance.
    """
    system, n_q = system_at(v), moved.size
    if not has_configuration_constraints(system, t, v[:n_q]):
        return S
    weights = coordinate_weights(system, t, v[:n_q])
    S = _tangent(system_at, t, v, S, jnp.where(moved, weights, 0.0))
    return _tangent(system_at, t, v, S, jnp.linalg.norm(jax.lax.stop_gradient(S[:n_q]), axis=1))
