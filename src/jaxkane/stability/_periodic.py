"""Periodic orbits, their Floquet multipliers, and the derivatives of both by the implicit function theorem."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, PyTree

from .._common.lookup import as_names, by_name, refuse_unknown
from .._integrate.events import event_values, own_events_of
from .._integrate.inputs import as_signals, inputs_at, samples_of
from .._integrate.simulate import checked_state
from .._integrate.trajectory import Trajectory, as_trajectory, reached_times
from .._kane.arguments import check_time, is_concrete, is_one_number
from .._kane.checks import check_system
from .._kane.constraint_residuals import check_state, has_configuration_constraints
from .._kane.scaling import least_norm, rank_tolerance
from .._scalarjit.cache_key import captured_tracers, jit
from .._scalarjit.components import Component, Inputs
from .._scalarjit.nan import constant, nan_where
from .._system.system import State, System, packed_motion, unpacked
from ._matrix_eigenvalues import eigvals
from ._orbit_equations import (
    Evaluation,
    OrbitArguments,
    OrbitEquations,
    closing_tolerance,
    drifting_coordinates,
    packed_rates,
    repeats,
    section_value,
    uses_time,
)
from ._steady import is_not_steady

_MAX_STEPS = 100  # of Newton's method
_SAMPLES = 513  # of the ride in which the first return is sought
_DOUBLINGS = 40  # of its duration, at most
_is_not_steady = jit(is_not_steady)


class Orbit(eqx.Module):
    """A periodic orbit. `orbit["x"]` is a value at the start by name.

    Attributes:

    - `system`: the system, with the parameters of the orbit.
    - `period` [s]. `state`: the `State` at the start. `t` [s]: the time of the start.
    - `inputs`: as for `simulate`.
    - `residual`: the largest error of closing, relative to the amplitude (no unit).
    - `trivial_multiplier`: of a change along the orbit. It is 1 without numerical errors. A forced orbit has none: NaN.
    - `states` (K, n_y): the packed states at the start of the segments.
    """

    system: System
    period: Float[Array, "*batch"]
    state: State
    t: Float[Array, "*batch"]
    inputs: Any
    residual: Float[Array, "*batch"]
    trivial_multiplier: Float[Array, "*batch"]
    states: Float[Array, "*batch K n_y"]
    unknowns: Float[Array, "*batch n_z"]
    arguments: OrbitArguments
    segments: Float[Array, "*batch K n n"]
    equations: OrbitEquations

    @property
    def multipliers(self) -> Complex[Array, "*batch m"]:
        """The Floquet multipliers without the trivial one, the largest magnitude first.

        The orbit is stable if all of them are inside the unit circle. They are differentiable in the parameters of the
        system; the derivative of multipliers that coincide is NaN.
        """
        return _multipliers(self.equations, self.segments, self.unknowns, self.arguments)

    @property
    def stable(self) -> Bool[Array, "*batch"]:
        """Whether all multipliers are inside the unit circle. False for an orbit of a conservative system, whose
        multipliers come in pairs with the product 1."""
        return jnp.all(jnp.abs(self.multipliers) < 1.0, axis=-1)

    @property
    def ride(self) -> Trajectory:
        """The motion over one period at 201 times, simulated when it is read. `jumps` contains a jump at its end."""
        return _ride(self.equations, self.unknowns, self.arguments)

    def __getitem__(self, name: str) -> Any:
        x = self.state.u[..., :0] if self.state.x is None else self.state.x
        groups = zip(
            (self.system.coordinates, self.system.speeds, self.system.states),
            (self.state.q, self.state.u, x),
            strict=True,
        )
        return by_name(name, groups, {}, "this orbit")

    def __repr__(self) -> str:
        names = (*self.system.coordinates, *self.system.speeds, *self.system.states)
        if not is_concrete(self.period) or np.ndim(self.period):
            return f"Orbit({', '.join(names)})"
        sizes = np.abs(np.asarray(self.multipliers))
        largest = f"largest multiplier {sizes[0]:.6g}" if sizes.size else "no multipliers"
        stable = "stable" if bool(self.stable) else "unstable"
        start = ", ".join(f"{k} {float(self[k]):.6g}" for k in names)
        return (
            f"Orbit(period {float(self.period):.10g} s, {stable}, {largest}; starts at {start}; "
            f"closes to {float(self.residual):.1g})"
        )


def periodic(
    system: System,
    guess: State | Trajectory | Orbit,
    inputs: Inputs = None,
    *,
    section: str | None = None,
    period: Component | Callable[[System], Component] | None = None,
    autonomous: bool = True,
    hold: Sequence[str] | Mapping[str, Any] = (),
    advance: Mapping[str, Any] | None = None,
    segments: int = 1,
    returns: int = 1,
    t: float = 0.0,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 100_000,
) -> Orbit:
    """The periodic orbit near a state, by Newton's method and multiple shooting.

        y(t + T) = y(t)

    Cyclic coordinates drift, such as the position and the wheel angles of a bicycle: they need not be periodic, unless
    an event, a contact or an input function uses them.

    **Arguments:**

    - `guess`: a `State` near the orbit; an `Orbit` of similar parameters; or a `Trajectory` over about one period, at
        whose times the segments begin.
    - `inputs`: as for `simulate`: numbers or functions (t, state) by name.
    - `section`: the name of an event of the system, with a direction (`jaxkane.rising` or `jaxkane.falling`). The orbit
        starts there. If the event changes the state, the guess and the orbit start after the jump. Without a section
        the orbit starts in the plane through the guess that is orthogonal to the flow.
    - `period`: a guess of the period [s]. By default, the time of the first return of the guess. If `autonomous` is
        False, it is a period of the force itself, which is checked: a number, or a function of the system such as
        `lambda s: 2 * jnp.pi / s.frequency`.
    - `autonomous`: False for a system that is forced periodically in time.
    - `hold`: names of coordinates, independent speeds and first-order states that keep the value of the guess at the
        start; or a dict of names and values. Orbits of a conservative system form a family, so one quantity must be
        held.
    - `advance`: by name, the change of a coordinate in one period [rad, m], e.g. `{"angle": 2 * jnp.pi}` for a pendulum
        that rotates. By default 0.
    - `segments`: the number of segments of multiple shooting. More segments find orbits whose multipliers are large,
        and give multipliers that are tiny with full relative accuracy.
    - `returns`: the number of returns to the section in one period: 2 for a walker whose gait repeats after two steps.
        The orbit with fewer returns is also a solution, so pass a guess that is nearer to the orbit with more returns.
        Without a jump at the section, `returns` only selects the default of `period`. With a jump, use one segment.
    - `t`: the time of the start [s].
    - `rtol`, `atol`, `max_steps`: as for `simulate`; by default 1e-12 in float64.
    - `solver`: as for `simulate`, by default `diffrax.Dopri8`.

    **Returns:** an `Orbit`. Its state, period and multipliers are differentiable in the parameters of the system, in
    numbers of `inputs` and in the values of `hold`, by the implicit function theorem in forward and reverse mode.

    **Raises:** `ValueError` if no orbit is found, if the guess is an equilibrium, if the section is unknown or is never
    crossed, or if more quantities must be held. Under a trace the orbit is NaN instead.
    """
    name = f"periodic({type(system).__name__})"
    for key, value in {"segments": segments, "returns": returns}.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}: `{key}` must be a positive whole number, got {value!r}.")
    if not isinstance(autonomous, (bool, np.bool_)):
        raise TypeError(f"{name}: `autonomous` must be True or False, got {autonomous!r}.")
    if not autonomous and (period is None or section is not None):
        raise ValueError(
            f"{name}: with autonomous=False, pass the period of the force as `period` [s]. Omit `section`: the orbit "
            "starts at the time `t`."
        )
    y, T, states = _checked_guess(name, system, guess, segments, t)
    if period is not None:
        T: Any = period(system) if callable(period) else period
        if not is_one_number(T) or (is_concrete(T) and not 0 < float(T) < np.inf):
            raise ValueError(
                f"{name}: `period` must be a positive and finite number [s], or a function of the system; got {T!r}."
            )
    equations, args = orbit_equations(
        system, y, inputs, hold=hold, advance=advance, section=section, segments=segments, returns=returns, t=t,
        rtol=rtol, atol=atol, solver=solver, max_steps=max_steps, autonomous=bool(autonomous),
        period_of=period if callable(period) else None,
    )  # fmt: skip
    if equations.jumps and returns > 1 and segments > 1:
        raise ValueError(
            f"{name}: `returns` = {returns} with `segments` = {segments}: the jumps at the section {section!r} can be "
            "in any segment. Omit `segments`."
        )
    if autonomous and any(uses_time(system, args.inputs, args.start)):
        raise ValueError(
            f"{name}: the equations depend on the time, so the phase of an orbit is not free. Pass the period of the "
            "force: period=..., autonomous=False."
        )
    y, entries = args.start, (*system.coordinates, *system.speeds, *system.states)
    _refuse_equilibrium(name, equations, args, y)
    normal = _normal(equations, args, y)
    args = args._replace(normal=normal)
    if T is None:
        y, T = _first_return(name, equations, args, y)
        args = args._replace(center=constant(y), normal=_normal(equations, args, y))
    T = jnp.asarray(T, y.dtype)
    if not autonomous:
        is_blurred = float(jnp.finfo(y.dtype).eps) * jnp.abs(args.t) > 0.1 * equations.rtol * T
        skipped = jnp.where(is_blurred & (not samples_of(args.inputs)), constant(jnp.round(args.t / T)), 0.0)
        args = args._replace(t=args.t - skipped * T, skipped=skipped)
    args = args._replace(period=constant(T) if autonomous else T)
    T = jax.lax.stop_gradient(T)
    orbit, found = _solve(equations, args, constant(y), T, states)
    if is_concrete(orbit.period, found) and not bool(found["ok"]):
        raise ValueError(_no_orbit(name, equations, entries, found))
    return orbit


def orbit_equations(
    system: System,
    y: Array,
    inputs: Inputs = None,
    *,
    hold: Sequence[str] | Mapping[str, Any] = (),
    advance: Mapping[str, Any] | None = None,
    section: str | None = None,
    segments: int = 1,
    returns: int = 1,
    t: Component = 0.0,
    rtol: float | None = None,
    atol: float | None = None,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 100_000,
    autonomous: bool = True,
    period_of: Callable[[System], Any] | None = None,
) -> tuple[OrbitEquations, OrbitArguments]:
    """The equations of an orbit that starts near the packed state y, and their data without a period and a normal.
    Arguments as for `periodic`."""
    name = f"periodic({type(system).__name__})"
    entries = (*system.coordinates, *system.speeds, *system.states)
    t = jnp.asarray(t, y.dtype)
    values = dict(hold) if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold, "hold"))
    refuse_unknown(values, entries, f"{name}: `hold` must name coordinates, independent speeds or states; unknown:")
    places = {key: entries.index(key) for key in values}
    targets = [y[i] if values[key] is None else jnp.asarray(values[key], y.dtype) for key, i in places.items()]
    targets = jnp.stack(targets) if targets else jnp.zeros(0, y.dtype)
    y = constant(y.at[np.array(list(places.values()), int)].set(targets))
    advances = dict(advance or {})
    refuse_unknown(advances, system.coordinates, f"{name}: `advance` must name coordinates; unknown:")
    change = jnp.stack([jnp.asarray(advances.get(key, 0.0), y.dtype) for key in entries])
    signals = as_signals(inputs, system.inputs, t[None], name)
    if captured_tracers(signals):
        raise TypeError(
            f"{name}: an input function uses a traced number from a closure. Make it a parameter of the system, or "
            "pass jax.tree_util.Partial(lambda number, t, state: ..., number)."
        )
    drifting = drifting_coordinates(system, signals, y).difference(advances)
    default = 1e-12 if y.dtype == jnp.float64 else 1e-6
    equations = OrbitEquations(
        closed=tuple(i for i, key in enumerate(entries) if key not in drifting),
        segments=segments,
        hold=tuple(places.values()),
        section=section or "",
        jumps=_jumps_at(name, system, section, y),
        returns=returns,
        autonomous=autonomous,
        period_of=None if autonomous else period_of,
        constrained=has_configuration_constraints(system, t, unpacked(system, y).q),
        rtol=default if rtol is None else float(rtol),
        atol=default if atol is None else float(atol),
        max_steps=max_steps,
        solver=diffrax.Dopri8() if solver is None else solver,
    )
    times = (jnp.zeros_like(t), t) if autonomous else (t, jnp.zeros_like(t))
    data = jnp.ones((), y.dtype), y, change, targets, y, jnp.zeros_like(y)
    return equations, OrbitArguments(system, signals, *times, *data)


def _checked_guess(name: str, system: System, guess: object, segments: int, t: Component) -> tuple[Array, Any, Any]:
    """The packed state of a guess, its period, and the states (K, n_y) at the starts of its segments; None if
    unknown."""
    check_time(name, t)
    T = states = None
    guess = as_trajectory(guess)
    if isinstance(guess, Trajectory):
        reached_times("periodic", system, guess)
        ys = packed_motion(State(guess.q, guess.u, guess.x if system.states else None))
        T, parts = guess.t[-1] - guess.t[0], jnp.arange(segments) / segments
        states = jax.vmap(lambda y: jnp.interp(guess.t[0] + parts * T, guess.t, y), 1, 1)(ys)
        state = unpacked(system, ys[0])
    elif isinstance(guess, Orbit):
        T, state = guess.period, guess.state
        states = guess.states if guess.states.shape[0] == segments else None
    else:
        state = guess
    state = checked_state(system, state)
    check_state(system, jnp.asarray(t, state.q.dtype), state.q)
    check_system(system, jnp.asarray(t, state.q.dtype), state.q)
    return packed_motion(state), T, states


def _jumps_at(name: str, system: System, section: str | None, y: Array) -> bool:
    """Whether the event of a section changes the state.

    **Raises:** `ValueError` for an event that does not exist or has no direction.
    """
    if section is None:
        return False
    events = own_events_of(system, jnp.zeros((), y.dtype), unpacked(system, y))
    refuse_unknown([str(section)], events.names, f"{name}: `section`: there is no event", "the events are")
    place = events.names.index(section)
    if not events.directions[place]:
        raise ValueError(
            f"{name}: the event {section!r} has no direction, so an orbit would cross it twice. Return "
            "jaxkane.rising(...) or jaxkane.falling(...)."
        )
    return len(events.stages[place]) > 0


def _refuse_equilibrium(name: str, equations: OrbitEquations, args: OrbitArguments, y: Array) -> None:
    state = unpacked(args.system, y)
    w = inputs_at(args.system, args.inputs, args.t, state, all_of_them=True)
    if not equations.autonomous or not is_concrete(args.system, y, w):
        return
    w = jnp.stack([w[key] for key in args.system.inputs]) if w else jnp.zeros(0, y.dtype)
    x = jnp.zeros(0, y.dtype) if state.x is None else state.x
    if not _is_not_steady(args.system, args.t, state.q, state.u, x, w, True):
        raise ValueError(
            f"{name}: the guess is an equilibrium or a steady motion. Pass a state on the orbit. For the small orbits "
            "at a Hopf point, use jaxkane.stability.limit_cycle."
        )


@jit
def _normal(equations: OrbitEquations, args: OrbitArguments, y: Array) -> Array:
    y, args = constant((y, args))
    z = equations.unknowns(jnp.tile(y, (equations.segments, 1)), jnp.ones((), y.dtype))
    return normal_at(equations, z, args)


def normal_at(equations: OrbitEquations, z: Array, args: OrbitArguments) -> Array:
    """The normal (n_y,) of the plane through the start that is orthogonal to the flow, in scaled unknowns."""
    size = equations.sizes(z, args)[: len(equations.closed)]
    f = equations.rates(z, args)[0] / size
    normal = f / size / jnp.linalg.norm(f)
    return constant(jnp.zeros_like(args.start).at[equations.places].set(normal))


def _first_return(name: str, equations: OrbitEquations, args: OrbitArguments, y: Array) -> tuple[Array, Any]:
    """The state of the guess, or of its first crossing of the section, and the time until it returns."""
    if not is_concrete(args.system, y):
        raise ValueError(
            f"{name}: under jax.jit, jax.vmap and derivatives, pass `period` (a guess for its solver) [s]."
        )
    if equations.jumps:
        duration = 1e-2
        for _ in range(_DOUBLINGS // 2):
            time = float(_until_return(equations, args, y, args.t, jnp.asarray(duration, y.dtype))[1])
            if np.isfinite(time):
                return y, time
            duration *= 2.0
        raise ValueError(
            f"{name}: the section {equations.section!r} is not crossed within {duration:.3g} s. Start nearer to the "
            "orbit, just after the jump at the section, or pass a guess of the period as `period`."
        )
    duration, direction = 1e-3, 1.0
    if equations.section:
        events = own_events_of(args.system, args.t, unpacked(args.system, y))
        direction = float(events.directions[events.names.index(equations.section)])
    for _ in range(_DOUBLINGS):
        ride, ys, g = _sampled(equations, args, y, jnp.asarray(duration, y.dtype))
        if not ride.ok:
            raise ValueError(
                f"{name}: the simulation of the guess ends at {float(ride.t_end):.6g} s: {ride.reason}. Start nearer "
                "to the orbit, or pass a guess of the period as `period`."
            )
        ys, g, taus = np.asarray(ys), direction * np.asarray(g), np.linspace(0.0, duration, len(g))
        closed = ys[:, equations.places]
        size = np.maximum(np.ptp(closed, axis=0), 1e-300)
        crossed = [i for i in range(1, len(g) - 1) if g[i] < 0 <= g[i + 1]]
        starts_there = abs(g[0]) <= 1e-6 * np.max(np.abs(g)) and g[1] > g[0]
        if equations.section and crossed and not starts_there:
            i, crossed = crossed[0], crossed[1:]
            first = _crossing(g, taus, ys, i)
        else:
            first = taus[0], ys[0]
        far = np.linalg.norm((first[1][equations.places] - closed) / size, axis=1)
        found = [i for i in crossed if equations.section or far[i] <= 0.25 * np.max(far)]
        if len(found) >= equations.returns:
            time, _ = _crossing(g, taus, ys, found[equations.returns - 1])
            return jnp.asarray(first[1], y.dtype), time - first[0]
        duration *= 2.0
    what = f"the section {equations.section!r} is not crossed" if equations.section else "the guess does not return"
    raise ValueError(
        f"{name}: {what} within {duration:.3g} s. Start nearer to the orbit"
        + (", choose another section," if equations.section else "")
        + " or pass a guess of the period as `period`."
    )


def _crossing(g: np.ndarray, taus: np.ndarray, ys: np.ndarray, i: int) -> tuple[Any, Any]:
    part = g[i] / (g[i] - g[i + 1])
    return taus[i] + part * (taus[i + 1] - taus[i]), ys[i] + part * (ys[i + 1] - ys[i])


@jit
def _sampled(equations: OrbitEquations, args: OrbitArguments, y: Array, duration: Array):
    """A ride, its packed states, and the quantity whose sign changes at the section."""
    ride = equations.simulate(args, y, args.t + jnp.linspace(0.0, 1.0, _SAMPLES, dtype=y.dtype) * duration)
    ys = packed_motion(State(ride.q, ride.u, ride.x if args.system.states else None))
    if equations.section:
        g = jax.vmap(lambda y: section_value(args.system, equations.section, args.t, y))(ys)
    else:
        g = jnp.sum(args.normal[None, :] * (ys - args.center[None, :]), axis=1)
    return ride, ys, g


_until_return = jit(OrbitEquations.until_return)


@jit
def _solve(equations: OrbitEquations, args: OrbitArguments, y: Array, T: Array, states: Array | None):
    """The orbit, and how the search ended.

    - "ok": whether an orbit was found. "residual": the largest error of closing relative to the amplitude.
    - "change" (n_z,): the scaled change of the unknowns that changes the residuals least.
    - "speed": the largest change of a closed entry in one period at the initial rate, relative to its size.
    - "crosses": whether the orbit crosses the section in the direction of its event.
    - "repeats": whether the equations have the period of the orbit.
    """
    known = constant(args)
    states = _shots(equations, known, y, T) if states is None else jax.lax.stop_gradient(states).at[0].set(y)
    z, at = _root(equations, equations.unknowns(states, T), args)
    z_known = jax.lax.stop_gradient(z)
    sizes, _, residual = scales_at(equations, z_known, known, at)
    _, _, _, s, Vt = _scaled_svd(equations, at._replace(J=jnp.where(jnp.isfinite(at.J), at.J, 0.0)), sizes)
    period = equations.period(z_known, known)
    speed = jnp.max(jnp.abs(equations.rates(z_known, known)[0] * period / sizes[: len(equations.closed)]))
    speed = speed if equations.autonomous else jnp.ones_like(speed)
    singular = s / s[0]
    crosses, has_period = _crosses(equations, z_known, known), jnp.array(True)
    if not equations.autonomous:
        has_period = repeats(*known[:3], known.start, period, equations.skipped(z_known, known))
    ok = (
        (residual <= closing_tolerance(y.dtype))
        & (singular[-1] > rank_tolerance(y.dtype))
        & (speed > 1e-6)
        & crosses
        & has_period
    )
    z, segments = nan_where(~ok, (z, at.segments), args)
    orbit = as_orbit(equations, z, args, segments, residual)
    found = {"ok": ok, "residual": residual, "change": Vt[-1], "speed": speed, "crosses": crosses}
    return orbit, jax.lax.stop_gradient(found | {"repeats": has_period})


def _crosses(equations: OrbitEquations, z: Array, args: OrbitArguments) -> Array:
    """Whether the start is a crossing of the section in the direction of its event."""
    if not equations.section or equations.jumps:
        return jnp.array(True)
    system, y = args.system, equations.states(z, args)[0]
    events = own_events_of(system, args.t, unpacked(system, y))
    place = events.names.index(equations.section)
    rates = event_values(system, args.t, y, packed_rates(args, args.t, y)).rates
    return events.directions[place] * rates[place] > 0


def scales_at(equations: OrbitEquations, z: Array, args: OrbitArguments, at: Evaluation) -> tuple[Array, Array, Array]:
    """The sizes of the unknowns (n_z,) and of the residuals (m,), and the largest relative residual."""
    sizes = equations.sizes(z, args)
    rows = _row_sizes(equations, at, sizes)
    return sizes, rows, jnp.max(jnp.abs(at.F / rows))


def as_orbit(equations: OrbitEquations, z: Array, args: OrbitArguments, segments: Array, residual: Array) -> Orbit:
    """The orbit of these unknowns. `segments`: the derivatives of the segments there."""
    trivial = equations.trivial_multiplier(segments, jax.lax.stop_gradient(z), constant(args))
    trivial = trivial if equations.autonomous else jnp.full_like(trivial, jnp.nan)
    states, period = equations.states(z, args), equations.period(z, args)
    state = unpacked(args.system, states[0])
    t = args.t + equations.skipped(z, args)
    return Orbit(args.system, period, state, t, args.inputs, residual, trivial, states, z, args, segments, equations)


def _shots(equations: OrbitEquations, args: OrbitArguments, y: Array, T: Array) -> Array:
    """The packed states (K, n_y) at the start of each segment, from a simulation of the guess."""
    if equations.segments == 1:
        return y[None]
    duration = T / equations.segments

    def shot(carry: tuple[Any, ...], _: None):
        y, t = carry
        end = equations.flow(args, y, t, duration)
        return (jnp.where(jnp.all(jnp.isfinite(end)), end, y), t + duration), y

    return jax.lax.scan(shot, (y, args.t), length=equations.segments)[1]


def _row_sizes(equations: OrbitEquations, at: Evaluation, sizes: Array) -> Array:
    """The size (m,) of each residual: of the entry that must close, or of the change of a condition."""
    closing = equations.segments * len(equations.closed)
    others = jnp.linalg.norm(at.J[closing:, : sizes.size] * sizes[None, :], axis=1)
    return jnp.concatenate([sizes[:closing], jnp.where(others > 0, others, 1.0)])


@eqx.filter_custom_jvp
def _root(equations: OrbitEquations, guess: Array, args: OrbitArguments) -> tuple[Array, Evaluation]:
    """z (n_z,) with F(z) = 0 by Newton's method with damped steps, and the last evaluation.

    A step is accepted if it reduces the next correction -J^+ F with the same J (Deuflhard, Newton Methods for Nonlinear
    Problems, 2004, section 3.3). The sum of squares of F is not suitable: it decreases by 1 % per step along the curved
    valley of a relaxation oscillation with 40 segments. The loop contains one evaluation only, because its program is
    the largest part of the compilation.
    """
    sizes, eps = equations.sizes(guess, args), float(jnp.finfo(guess.dtype).eps)
    shapes = eqx.filter_eval_shape(equations.evaluate, guess, args)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    zero, one = jnp.zeros((), guess.dtype), jnp.ones((), guess.dtype)

    def step(carry: tuple[Any, ...]):
        z, at, inverse, dz, damping, k = carry
        trial = z + damping * sizes * dz
        new = equations.evaluate(trial, args)
        finite = jnp.all(jnp.isfinite(new.F)) & jnp.all(jnp.isfinite(new.J))
        length, after = jnp.linalg.norm(dz), jnp.linalg.norm(inverse @ jnp.where(finite, new.F, 0.0))
        better = finite & ((after <= (1.0 - 0.25 * damping) * length) | (k == 0))
        last = (jnp.max(jnp.abs(dz)) < eps**0.5) & (damping == 1.0) & (k > 0)
        z = jnp.where(better, trial, z)
        at = jax.tree.map(lambda x, y: jnp.where(better, x, y), new, at)
        rows, size, U, s, Vt = _scaled_svd(equations, at, sizes)
        inverse = jnp.where(s > 1e3 * eps * s[0], 1.0 / jnp.where(s > 0, s, 1.0), 0.0)
        inverse = (Vt.T @ (inverse[:, None] * U.T)) / size[:, None] / rows[None, :]
        dz = -inverse @ at.F
        damping = jnp.where(better, jnp.minimum(1.0, 4.0 * damping), 0.25 * damping)
        if equations.autonomous:  # a step to a period of zero, or to a multiple, would end at another solution
            damping = jnp.minimum(damping, 0.3 * z[-1] / jnp.maximum(jnp.abs(sizes[-1] * dz[-1]), 1e-3 * z[-1]))
        stop = last | (damping < 1e-6) | ((k == 0) & ~finite)
        return z, at, inverse, dz, damping, jnp.where(stop, _MAX_STEPS, k + 1)

    start = (guess, nothing, jnp.zeros(nothing.J.T.shape, guess.dtype), jnp.zeros_like(guess), one, jnp.zeros((), int))
    z, at, *_ = jax.lax.while_loop(lambda carry: carry[-1] < _MAX_STEPS, step, start)
    missing = jnp.all(at.J == zero)  # the first evaluation was not finite
    return z, at._replace(F=jnp.where(missing, jnp.inf, at.F))


def _scaled_svd(equations: OrbitEquations, at: Evaluation, sizes: Array) -> tuple[Array, ...]:
    """The sizes of the residuals (m,), the lengths (n_z,) of the columns of J for unknowns that are divided by their
    sizes and residuals by theirs, and the singular value decomposition of this J with columns of unit length."""
    rows = _row_sizes(equations, at, sizes)
    J = at.J * sizes[None, :] / rows[:, None]
    length = jnp.linalg.norm(J, axis=0)
    length = jnp.where(length > 0, length, 1.0)
    return rows, length, *jnp.linalg.svd(J / length[None, :], full_matrices=False)


@_root.def_jvp
def _root_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    equations, guess, args = primals
    z, at = _root(equations, guess, args)
    _, _, moved = tangents
    slopes, directions = _slopes(equations, at, z, args, moved)
    none = jax.tree.map(jnp.zeros_like, at)
    return (z, at), (slopes @ directions, none)


def _moving(args: OrbitArguments, tangents: PyTree) -> tuple[Callable[[Array], Any], Array, Array]:
    # The arguments as a function of one array of all numbers that have tangents; these numbers; and their tangents.
    #
    # A matrix of derivatives with respect to these numbers is computed in forward mode. Its product with the tangents
    # can be transposed, so that reverse mode works. A simulation in forward mode could not be transposed.
    leaves, structure = jax.tree.flatten(args)
    moved = jax.tree.flatten(tangents, is_leaf=lambda x: x is None)[0]
    which = [i for i, dx in enumerate(moved) if dx is not None]
    numbers, unravel = ravel_pytree([leaves[i] for i in which])
    directions, _ = ravel_pytree([moved[i] for i in which])

    def at(numbers: Float[Array, " n_p"]):
        new = list(leaves)
        for i, x in zip(which, unravel(numbers), strict=True):
            new[i] = x
        return jax.tree.unflatten(structure, new)

    return at, numbers, directions


def _slopes(equations: OrbitEquations, at: Evaluation, z: Array, args: OrbitArguments, tangents: PyTree):
    """dz / dp (n_z, n_p) with respect to all numbers p that have tangents, and these tangents (n_p,).

    dF/dz dz + dF/dp dp = 0
    """
    args_at, numbers, directions = _moving(args, tangents)

    def along(direction: Float[Array, " n_p"]):
        return jax.jvp(lambda p: equations.residual(z, args_at(p)), (numbers,), (direction,))[1]

    F_p = jax.lax.map(along, jnp.eye(numbers.size, dtype=z.dtype))  # (n_p, m)
    finite = jnp.all(jnp.isfinite(at.J))
    J = jnp.where(finite, at.J, 0.0)
    tolerance = 10 * max(J.shape) * float(jnp.finfo(z.dtype).eps)
    return -jax.vmap(lambda F: least_norm(J, F, tolerance), out_axes=1)(F_p), directions


@jit
def _multipliers(equations: OrbitEquations, segments: Array, z: Array, args: OrbitArguments) -> Array:
    values = eigvals(_return_matrix(equations, segments, z, args))
    return values[jnp.argsort(-jnp.abs(jax.lax.stop_gradient(values)))]


@eqx.filter_custom_jvp
def _return_matrix(equations: OrbitEquations, segments: Array, z: Array, args: OrbitArguments) -> Array:
    return equations.return_matrix(segments, z, args)


@_return_matrix.def_jvp
def _return_matrix_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    equations, _, z, args = primals
    at = equations.evaluate(z, args)
    args_at, numbers, _ = _moving(args, tangents[3])
    slopes, directions = _slopes(equations, at, z, args, tangents[3])

    def matrix(z: Float[Array, " n_z"], p: Float[Array, " n_p"]):
        args = args_at(p)
        return equations.return_matrix(equations.evaluate(z, args).segments, z, args)

    def along(direction: Float[Array, " n_p"]):
        return jax.jvp(matrix, (z, numbers), (slopes @ direction, direction))[1]

    columns = jax.lax.map(along, jnp.eye(numbers.size, dtype=z.dtype))  # (n_p, m, m)
    return equations.return_matrix(primals[1], z, args), jnp.tensordot(directions, columns, axes=1)


@jit
def _ride(equations: OrbitEquations, z: Array, args: OrbitArguments) -> Trajectory:
    y, T = equations.states(z, args)[0], equations.period(z, args)
    # Samples end just before a jump at the section. One more time is after it, so that `jumps` contains it.
    margin, skipped = max(1e-9, 10 * equations.rtol), equations.skipped(z, args)
    parts = np.append(np.linspace(0.0, 1.0 - margin, 201), 1.0 + margin) if equations.jumps else np.linspace(0, 1, 201)
    ts = args.t + jnp.asarray(parts, z.dtype) * T
    ride = equations.simulate(args, y, ts, jumping=equations.jumps)
    if equations.jumps:
        names = ("t", "q", "u", "u_dep", "x", "inputs", "outputs", "contact_memory")
        kept = {name: jax.tree.map(lambda x: x[:-1], getattr(ride, name)) for name in names}
        ride = dataclasses.replace(ride, t_end=ride.t[-2], end=ride.state(-2), **kept)
    jumps = None if ride.jumps is None else dataclasses.replace(ride.jumps, t=ride.jumps.t + skipped)
    return dataclasses.replace(ride, t=ride.t + skipped, t_end=ride.t_end + skipped, jumps=jumps)


def _no_orbit(name: str, equations: OrbitEquations, entries: tuple[str, ...], found: dict[str, Array]) -> str:
    residual = float(found["residual"])
    for is_so, reason in (
        (
            not found["repeats"],
            "the equations at t and t + period differ, or the type of the state cannot resolve these times. Pass a "
            "period of the force with all its digits, e.g. as a function of the system. Samples that an input function "
            "evaluates must cover two periods and the delays.",
        ),
        (
            not np.isfinite(residual),
            "the simulation of the guess does not reach the end of its period. A value may grow without bound, or an "
            "event may end the simulation. Pass a guess that is nearer to the orbit, or its period.",
        ),
        (
            not residual <= closing_tolerance(found["residual"].dtype),
            f"no periodic orbit was found near this guess (the largest error of closing is {residual:.3g} of the "
            "amplitude). Pass a nearer guess, more `segments` if the orbit is strongly unstable, or `hold` if the "
            "system is conservative.",
        ),
        (
            not float(found["speed"]) > 1e-6,
            "the search ended at an equilibrium or a steady motion. Pass a guess that is nearer to the orbit.",
        ),
        (
            not found["crosses"],
            f"the orbit crosses the section {equations.section!r} against the direction of its event. Pass a guess "
            "near the other crossing, or omit `period`.",
        ),
    ):
        if is_so:
            return f"{name}: {reason}"
    names = [*(entries[i] for i in equations.closed)] * equations.segments + ["period"]
    moves = np.abs(np.asarray(found["change"]))
    which = dict.fromkeys(names[i] for i in np.argsort(-moves) if moves[i] > 1e-2 * np.max(moves))
    return (
        f"{name}: the orbits near this guess form a family, along which {', '.join(which)} change. Hold one of these, "
        f"e.g. hold=({next(k for k in which if k != 'period')!r},)."
    )
