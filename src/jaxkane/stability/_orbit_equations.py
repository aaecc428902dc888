"""The equations of a periodic orbit by multiple shooting, their derivatives, and the quantities that must repeat."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from .._integrate.events import Status, event_values, events_of, own_events_of
from .._integrate.inputs import Samples, Signals, as_signals, inputs_at, samples_of
from .._integrate.jumps import StagesOf, after_jump, after_jump_written_out
from .._integrate.simulate import simulate
from .._integrate.trajectory import Trajectory
from .._kane.arguments import is_concrete
from .._kane.constraint_residuals import configuration_residual, coordinate_units, projected
from .._kane.contact.forces import has_contacts, layout_of, terms_at
from .._kane.contact.states_after_jump import rates_from_motion
from .._kane.kanes_method import KaneEquations
from .._kane.right_hand_side import reads_time, values_of, vector_field
from .._scalarjit.cache_key import captures_any, jit
from .._scalarjit.compat import concretely, depends_on
from .._scalarjit.components import Component, as_vector, is_written_out
from .._system.system import NamedVector, System, call_with_states, packed_motion, unpacked, with_class
from ._steady import cyclic_coordinates


class OrbitArguments(NamedTuple):
    """The data of a periodic orbit.

    Fields:

    - `system`: the system. `inputs`: as for `simulate`.
    - `t`: the time of the start [s], without `skipped`: seconds of an autonomous system, or whole periods of a force.
    - `period` [s]: of a force, unless it is a function of the system. With a jump at the section: an estimate of the
      period.
    - `start` (n_y,): a packed state, from which the drifting coordinates are taken.
    - `advance` (n_y,): the change of each entry of the state in one period.
    - `targets` (n_hold,): values of the held entries.
    - `center`, `normal` (n_y,): of the hyperplane that contains the start.
    """

    system: System
    inputs: Any
    t: Array
    skipped: Array
    period: Array
    start: Array
    advance: Array
    targets: Array
    center: Array
    normal: Array


class Evaluation(NamedTuple):
    """Residuals of an orbit and their derivatives.

    - `F` (m,): residuals. `J` (m, n_z): their derivatives with respect to the unknowns.
    - `segments` (K, n, n): derivatives of the end of each segment with respect to its start, of the closed entries.
    """

    F: Array
    J: Array
    segments: Array


class OrbitEquations(eqx.Module):
    """The unknowns z of a periodic orbit, and its equations F(z) = 0.

    z contains the closed entries of the packed state at the start of each segment, and the period if it is unknown.
    F contains for each segment the difference between its end and the next start, then the phase condition, the held
    entries and the configuration constraints.

    Attributes:

    - `closed`: indices of the n entries of the packed state that are periodic. The other coordinates drift.
    - `segments`: the number K of segments.
    - `hold`: indices of the entries that keep their value at the start.
    - `section`: the name of the event at which the orbit starts, or "".
    - `jumps`: whether the event of the section changes the state. The orbit then starts after this jump.
    - `returns`: the number of these jumps in one period. With more than one, there is one segment.
    - `autonomous`: whether the phase is free, so that the equations contain a phase condition.
    - `period_of`: the period of the force as a function of the system, or None.
    - `constrained`: whether the system has configuration constraints.
    - `rtol`, `atol`, `max_steps`, `solver`: as for `simulate`.
    """

    closed: tuple[int, ...] = eqx.field(static=True)
    segments: int = eqx.field(static=True)
    hold: tuple[int, ...] = eqx.field(static=True)
    section: str = eqx.field(static=True)
    jumps: bool = eqx.field(static=True)
    returns: int = eqx.field(static=True)
    autonomous: bool = eqx.field(static=True)
    period_of: Callable[[System], Any] | None = eqx.field(static=True)
    constrained: bool = eqx.field(static=True)
    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    solver: diffrax.AbstractSolver

    @property
    def places(self) -> np.ndarray:
        return np.array(self.closed, int)

    def period(self, z: Array, args: OrbitArguments) -> Array:
        """The period [s], which is the last unknown of an autonomous system."""
        if self.autonomous:
            return z[-1]
        return args.period if self.period_of is None else jnp.asarray(self.period_of(args.system), z.dtype)

    def skipped(self, z: Array, args: OrbitArguments) -> Array:
        """The time [s] at which the clock of the orbit starts. Time stamps near 1.7e9 s would round the times of its
        steps."""
        return args.skipped * (1.0 if self.autonomous else self.period(z, args))

    def rows(self, z: Array) -> Float[Array, "K n"]:
        """The closed entries at the start of each segment."""
        n = len(self.closed)
        return z[: self.segments * n].reshape(self.segments, n)

    def states(self, z: Array, args: OrbitArguments) -> Float[Array, "K n_y"]:
        """The packed state at the start of each segment."""
        return jnp.tile(args.start, (self.segments, 1)).at[:, self.places].set(self.rows(z))

    def unknowns(self, states: Array, period: Array) -> Array:
        """The inverse of `states` and `period`."""
        z = jnp.ravel(states[:, self.places])
        return jnp.append(z, period) if self.autonomous else z

    def _segment_starts(self, z: Array, args: OrbitArguments) -> Float[Array, "K n+2"]:
        """For each segment: the closed entries at its start, its start time and its duration."""
        duration = self.period(z, args) / self.segments
        times = args.t + jnp.arange(self.segments, dtype=z.dtype) * duration
        durations = jnp.broadcast_to(duration, times.shape)
        return jnp.concatenate([self.rows(z), times[:, None], durations[:, None]], axis=1)

    def _segment_end(self, segment: Array, args: OrbitArguments, last: bool) -> Array:
        """The closed entries at the end of a segment, and how much later it ends than its duration (n+1,).

        NaN if the simulation does not reach the end. If the section has a jump, the last segment ends after this jump.
        """
        n = len(self.closed)
        y, t, duration = args.start.at[self.places].set(segment[:n]), segment[n], segment[n + 1]
        if last and self.jumps:
            end, elapsed = self.until_return(args, y, t, 2.0 * args.period)
            return jnp.append(end[self.places], elapsed - duration)
        return jnp.append(self.flow(args, y, t, duration)[self.places], 0.0 * duration)

    def until_return(self, args: OrbitArguments, y: Array, t: Array, longest: Array) -> tuple[Array, Array]:
        """The packed state after `returns` jumps at the section, and the time until then. NaN if one takes longer."""
        if self.returns == 1:
            return self.until_jump(args, y, t, longest)

        def step(carry: tuple[Array, Array], _: None):
            y, elapsed = carry
            after, duration = self.until_jump(args, y, t + elapsed, longest)
            return (after, elapsed + duration), None

        return jax.lax.scan(step, (y, jnp.zeros_like(t)), length=self.returns)[0]

    def until_jump(self, args: OrbitArguments, y: Array, t: Array, longest: Array) -> tuple[Array, Array]:
        """The packed state after the next jump at the section, and the time until then. NaN if it takes longer."""
        ride = self.simulate(args, y, jnp.stack([t, t + longest]))
        assert ride.end is not None
        events = own_events_of(args.system, t, unpacked(args.system, y))
        place = events.names.index(self.section)
        # A simulation that ends elsewhere must not be passed to the jump: its derivatives could be NaN.
        ok = ride.status == Status.EVENT + ride.events.index(self.section)
        before, t_end = jnp.where(ok, packed_motion(ride.end), y), jnp.where(ok, ride.t_end, t)
        after, _ = after_jump(args.system, t_end, before, jnp.asarray(place, y.dtype), StagesOf.of(events))
        return jnp.where(ok, after, jnp.nan), jnp.where(ok, t_end - t, jnp.nan)

    def flow(self, args: OrbitArguments, y: Array, t: Array, duration: Array) -> Array:
        """The packed state after a duration, from a packed state at time t."""
        ride = self.simulate(args, y, jnp.stack([t, t + duration]))
        assert ride.end is not None
        return jnp.where(ride.ok, packed_motion(ride.end), jnp.nan)

    def simulate(self, args: OrbitArguments, y: Array, ts: Array, jumping: bool = False) -> Trajectory:
        """A simulation that does not end at the section, or ends there before its jump. With `jumping` it continues."""
        system = args.system if jumping else with_section(args.system, self.section, self.jumps)
        if self.constrained:  # `simulate` refuses a state that violates the constraints
            n_q = len(system.coordinates)
            y = jnp.concatenate([projected(system, ts[0], y[:n_q]), y[n_q:]])
        options = {"rtol": self.rtol, "atol": self.atol, "solver": self.solver, "max_steps": self.max_steps}
        return simulate(system, unpacked(system, y), ts, args.inputs, **options)

    def _ends(self, f: Callable[..., PyTree], segments: Array) -> Any:
        # f(segment, last) of all segments. They share one program, but the last one has its own if it ends by a
        # jump.
        if not self.jumps:
            return jax.lax.map(lambda segment: f(segment, False), segments)
        end = jax.tree.map(lambda x: x[None], f(segments[-1], True))
        if self.segments == 1:
            return end
        others = jax.lax.map(lambda segment: f(segment, False), segments[:-1])
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), others, end)

    def _targets(self, z: Array, args: OrbitArguments) -> Array:
        return jnp.roll(self.rows(z), -1, axis=0).at[-1].add(args.advance[self.places])

    def _conditions(self, z: Array, args: OrbitArguments) -> Array:
        """Phase condition, held entries and configuration constraints at the start."""
        y = self.states(z, args)[0]
        conditions = [y[np.array(self.hold, int)] - args.targets]
        if self.section and not self.jumps:
            conditions.append(section_value(args.system, self.section, args.t, y)[None])
        elif self.autonomous and not self.jumps:
            conditions.append(jnp.sum(args.normal * (y - args.center))[None])
        if self.constrained:
            conditions.append(configuration_residual(args.system, args.t, y[: len(args.system.coordinates)]))
        return jnp.concatenate(conditions)

    def residual(self, z: Array, args: OrbitArguments) -> Array:
        ends = self._ends(lambda segment, last: self._segment_end(segment, args, last), self._segment_starts(z, args))
        return self._residual(ends, self._targets(z, args), self._conditions(z, args))

    def _residual(self, ends: Array, targets: Array, conditions: Array) -> Array:
        late = ends[-1:, -1] if self.jumps else ends[:0, -1]
        return jnp.concatenate([jnp.ravel(ends[:, :-1] - targets), late, conditions])

    def evaluate(
        self,
        z: Array,
        args: OrbitArguments,
        p: Array | None = None,
        args_at: Callable[[Array], OrbitArguments] | None = None,
    ) -> Evaluation:
        """F and J. A segment is differentiated with respect to its own start only, so the cost is linear in K.

        `p` (n_p,) are further unknowns on which the arguments depend, as `args_at(p)`. J then has n_p more columns.
        """
        extra = jnp.zeros(0, z.dtype) if p is None else p
        n_p = extra.size

        def at(z_p: Array) -> tuple[Array, OrbitArguments]:
            return z_p[: z.size], args if args_at is None else args_at(z_p[z.size :])

        def with_slope(segment: Float[Array, " n_segment"], last: bool):
            def twice(segment: Float[Array, " n_segment"]):
                end = self._segment_end(segment, at(jnp.append(z, segment[segment.size - n_p :]))[1], last)
                return end, end

            return jax.jacfwd(twice, has_aux=True)(segment)

        def starts(z_p: Float[Array, " n_z+n_p"]):
            return jnp.concatenate(
                [self._segment_starts(*at(z_p)), jnp.tile(z_p[z.size :], (self.segments, 1))], axis=1
            )

        def targets(z_p: Float[Array, " n_z+n_p"]):
            return self._targets(*at(z_p))

        def conditions(z_p: Float[Array, " n_z+n_p"]):
            return self._conditions(*at(z_p))

        z_p = jnp.append(z, extra)
        slopes, ends = self._ends(with_slope, starts(z_p))  # (K, n+1, n+2+n_p), (K, n+1)
        J_ends, J_targets = jnp.einsum("kij,kjz->kiz", slopes, jax.jacfwd(starts)(z_p)), jax.jacfwd(targets)(z_p)
        J_others = jax.jacfwd(conditions)(z_p)
        columns = jax.vmap(self._residual, in_axes=-1, out_axes=-1)
        J = columns(J_ends, J_targets, J_others)
        F = self._residual(ends, targets(z_p), conditions(z_p))
        n = len(self.closed)
        return Evaluation(F, J, slopes[:, :n, :n])

    def rates(self, z: Array, args: OrbitArguments) -> Float[Array, "K n"]:
        """The rates of the closed entries at the start of each segment."""
        times = self._segment_starts(z, args)[:, -2]
        return jax.vmap(lambda t, y: packed_rates(args, t, y)[self.places])(times, self.states(z, args))

    def sizes(self, z: Array, args: OrbitArguments) -> Float[Array, " n_z"]:
        """The size of each unknown, in its unit: 1 for an angle, otherwise the amplitude of a harmonic motion with
        these values and rates."""
        T, system, closed = self.period(z, args), args.system, self.closed
        amplitudes = jnp.sqrt(self.rows(z) ** 2 + (self.rates(z, args) * T / (2 * np.pi)) ** 2)
        own, n_q, n_u = jnp.max(amplitudes, axis=0), len(system.coordinates), len(system.speeds)
        kind = np.array([(i >= n_q) + (i >= n_q + n_u) for i in closed], int)
        # An entry that is zero along the orbit is compared with others of its kind.
        size = jnp.max(jnp.where(kind[:, None] == kind, own, 0.0), axis=1)
        units = coordinate_units(system)
        is_angle = np.array([i < n_q and units[i] == "rad" for i in closed], bool)
        largest = jnp.where(is_angle, 1.0, jnp.maximum(own, jnp.where(size > 0, 1e-3 * size, 1.0)))
        # An orbit may have the amplitude zero. Errors of closing below `atol` are those of the simulation.
        sizes = jnp.tile(jnp.maximum(largest, self.atol / closing_tolerance(z.dtype)), self.segments)
        return jax.lax.stop_gradient(jnp.append(sizes, T) if self.autonomous else sizes)

    def return_matrix(self, segments: Array, z: Array, args: OrbitArguments) -> Float[Array, "m m"]:
        """The derivative of the return map: the product of the segments, each between the planes that are orthogonal to
        the flow (if the system is autonomous) and tangent to the configuration constraints.

        The flow maps its own direction onto itself, so these planes have all multipliers but the trivial one. A product
        of such small matrices keeps the relative accuracy of multipliers that are as small as 1e-38.
        """
        size = self.sizes(z, args)[: len(self.closed)]
        bases = jax.vmap(lambda y, t, f: self._basis(args, y, t, f, size))(
            self.states(z, args), self._segment_starts(z, args)[:, -2], self.rates(z, args)
        )
        scaled = segments * size[None, None, :] / size[None, :, None]
        product = jnp.eye(bases.shape[2], dtype=z.dtype)
        for i in range(self.segments):
            product = bases[(i + 1) % self.segments].T @ scaled[i] @ bases[i] @ product
        return product

    def trivial_multiplier(self, segments: Array, z: Array, args: OrbitArguments) -> Array:
        """The multiplier of the direction of the flow, which is 1 without numerical errors."""
        size = self.sizes(z, args)[: len(self.closed)]
        f = self.rates(z, args)
        after = jnp.roll(f, -1, axis=0) / size[None]
        along = jnp.einsum("kij,kj->ki", segments, f)
        if self.jumps:  # the last segment ends at the section, so that it has the same end for all starts along f
            along = along.at[-1].add(f[0])
        along = along / size[None]
        return jnp.prod(jnp.sum(after * along, axis=1) / jnp.sum(after**2, axis=1))

    def _basis(self, args: OrbitArguments, y: Array, t: Array, f: Array, size: Array) -> Array:
        # An orthonormal basis (n, m) of the scaled changes of a state that remain, in its columns.
        #
        # Householder's reflections depend smoothly on the state. The factor of `jnp.linalg.qr` has no derivative here.
        vectors = []
        if self.constrained:
            n_q = len(args.system.coordinates)
            G = jax.jacfwd(lambda q: configuration_residual(args.system, t, q))(y[:n_q])
            G = jnp.concatenate([G, jnp.zeros((len(G), len(y) - n_q), G.dtype)], axis=1)[:, self.places]
            vectors += list(G * size[None])
        vectors += [f / size] if self.autonomous else []
        basis = jnp.eye(len(self.closed), dtype=y.dtype)
        for k, vector in enumerate(vectors):
            v = basis.T @ vector
            v = v.at[:k].set(0.0)
            sign = jnp.where(jax.lax.stop_gradient(v[k]) < 0, -1.0, 1.0)
            v = v.at[k].add(sign * jnp.sqrt(jnp.sum(v**2)))
            basis = basis - 2.0 * jnp.outer(basis @ v, v) / jnp.sum(v**2)
        return basis[:, len(vectors) :]


def closing_tolerance(dtype: DTypeLike) -> float:
    """An orbit closes if its residuals are below this part of the amplitude. Newton's method reaches 1e-12 or fails."""
    return max(1e-6, float(jnp.finfo(dtype).eps) ** 0.5)


def packed_rates(args: OrbitArguments, t: Array, y: Array) -> Array:
    state = unpacked(args.system, y)
    signals = as_signals(args.inputs, args.system.inputs, jnp.stack([t, t + 1.0]), type(args.system).__name__)
    inputs = inputs_at(args.system, signals, t, state)
    rates = rates_from_motion if has_contacts(args.system) else vector_field
    return rates(args.system, t, y, inputs)


def section_value(system: System, section: str, t: Array, y: Array) -> Array:
    names = own_events_of(system, t, unpacked(system, y)).names
    return event_values(system, t, y, jnp.zeros_like(y)).values[names.index(section)]


def with_section(system: System, section: str, jumps: bool) -> System:
    """The system without the event of the section, at which a simulation that starts there would end; or, if this event
    changes the state, with an event that ends the simulation before the jump."""
    if not section:
        return system
    kind: Any = type(system)
    return with_class(system, _with_section(kind, section, jumps))


@functools.cache
def _with_section(kind: type[System], section: str, jumps: bool) -> Any:
    class WithSection(kind):
        def events(self, t: Component, q: NamedVector, u: NamedVector, x: NamedVector):
            events = call_with_states(super().events, t, q, u, x)
            ending = {section: dataclasses.replace(events[section], stages=())} if jumps else {}
            return {name: event for name, event in events.items() if name != section} | ending

    WithSection.__name__ = WithSection.__qualname__ = kind.__name__
    return WithSection


def drifting_coordinates(system: System, inputs: Signals, y: Array) -> set[str]:
    """Names of the cyclic coordinates that need not be periodic: no event, no contact, no input function and no
    periodic coordinate uses them. They are detected with random parameters near one, also under a trace."""
    names, cyclic = system.coordinates, cyclic_coordinates(system)
    if not cyclic:
        return set()
    rng, slopes = np.random.default_rng(0), [np.array(np.nan)] * 3

    def trial(x: Array) -> Any:
        return jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) if eqx.is_inexact_array(x) else x

    with concretely():
        for k in range(4):
            args = jax.tree.map(trial, (system, inputs))
            if k >= 2 and is_concrete(system, inputs):  # for quantities that are NaN for parameters near one
                args = system, inputs
            found = _slopes_of_used(*args, jnp.asarray(rng.uniform(-1.0, 1.0, y.shape), y.dtype))
            slopes = [np.fmax(x, np.abs(np.asarray(more))) for x, more in zip(slopes, found, strict=True)]
    exact, rounded, of_coordinates = slopes
    # Contacts may depend on a rotation of everything by rounding errors.
    limit = float(jnp.finfo(y.dtype).eps) ** 0.6 * (1.0 + rounded.max(axis=1, initial=0.0, keepdims=True))
    periodic = np.array([name not in cyclic for name in names])
    periodic |= np.any(~(exact <= 0), axis=0) | np.any(~(rounded <= limit), axis=0)
    uses = np.any(~(of_coordinates <= 0), axis=0)  # (n_q, n_q)
    for _ in names:
        periodic |= uses[periodic].any(axis=0)
    return {name for name, is_periodic in zip(names, periodic, strict=True) if not is_periodic}


@jit
def _slopes_of_used(system: System, inputs: Signals, y: Array) -> tuple[Array, ...]:
    n_q, t = len(system.coordinates), jnp.zeros((), y.dtype)
    return jax.jacfwd(lambda q: _used_quantities(system, inputs, t, y.at[:n_q].set(q)))(y[:n_q])


def _used_quantities(system: System, inputs: Signals, t: Array, y: Array) -> tuple[Array, Array, Array]:
    """What determines the motion in addition to the accelerations.

    - (m,): inputs, event functions, their conditions, new speeds and states after their jumps.
    - (k,): gaps, normal velocities, squares of the slips, and coefficients of contacts.
    - (1 + j, n_q): the rates of the coordinates, and their new values after each jump.
    """
    n_q, state = len(system.coordinates), unpacked(system, y)
    values, events = inputs_at(system, inputs, t, state), own_events_of(system, t, state)
    found, of_contacts = [jnp.zeros(0, y.dtype), *(jnp.reshape(x, 1) for x in values.values())], [y[:0]]
    of_coordinates = [as_vector(KaneEquations(system, t, state.q, state.u).q_dot, y)]
    if events.names:
        at = event_values(system, t, y, jnp.zeros_like(y))
        found += [at.values, at.conditions]
    for i in np.flatnonzero([len(stages) for stages in events.stages]):
        after, _ = after_jump(system, t, y, jnp.asarray(i, y.dtype), StagesOf.of(events))
        found, of_coordinates = [*found, after[n_q:]], [*of_coordinates, after[:n_q]]
    if has_contacts(system):
        terms = terms_at(system, t, state.q, state.u, values_of(system, state.x, values))
        of_contacts = [terms.gaps, terms.v[:, 0], jnp.sum(terms.v[:, 1:] ** 2, axis=1), *terms.laws]
    return jnp.concatenate(found), jnp.concatenate(of_contacts), jnp.stack(of_coordinates)


def uses_time(system: System, inputs: Signals, y: Array) -> tuple[bool, bool]:
    """Whether the rates and inputs use the time, and whether events, jumps and contacts do."""
    t, state = jnp.zeros((), y.dtype), unpacked(system, y)
    program = jax.make_jaxpr(lambda t: [*inputs_at(system, inputs, t, state).values()])(t)
    events, which = events_of(system, t, state), StagesOf.of(own_events_of(system, t, state))
    of_jumps = any(which.stages)
    if of_jumps and is_written_out(len(system.speeds)):
        jumps = after_jump_written_out.program(system, t, y, t, which)[1]
        of_jumps = jumps is None or jumps.reads[len(jax.tree.leaves(system))]
    return reads_time(system, y.dtype) or any(depends_on(program, [0])), events.read_time or of_jumps


@jit
def repeats(system: System, inputs: Signals, t: Array, y: Array, period: Array, skipped: Array) -> Array:
    """Whether the equations near a packed state are the same at random times, one `period` later, and `skipped` [s]
    later. True with `Samples`, which need not continue after one period. Samples that an input function evaluates must
    continue, because the function may delay them."""
    of_rates, of_events = uses_time(system, inputs, y)
    if not (of_rates or of_events) or samples_of((system, inputs)) or captures_any(Samples, system):
        return jnp.array(True)
    rng, eps = np.random.default_rng(0), float(jnp.finfo(y.dtype).eps)

    def quantities(t: Array, y: Array) -> Array:
        parts = [*map(jnp.ravel, _used_quantities(system, inputs, t, y))] if of_events else []
        if of_rates:
            with_memory = jnp.pad(y, (0, layout_of(system).memory_size))  # all contacts are open
            parts.append(vector_field(system, t, with_memory, inputs_at(system, inputs, t, unpacked(system, y))))
        return jnp.concatenate(parts)

    shifts = jnp.stack([0.0 * t, period, skipped])[None, None]
    times = t + period * jnp.asarray(rng.uniform(size=(1, 8, 1)), y.dtype) + shifts
    away = jnp.asarray(rng.uniform(-0.1, 0.1, y.shape), y.dtype) * (1.0 + jnp.abs(y))
    at = [x.reshape(48, -1) for x in jnp.broadcast_arrays(times[..., None], jnp.stack([y, y + away])[:, None, None])]
    found = jax.lax.map(lambda at: quantities(at[0][0], at[1]), tuple(at)).reshape(2, 8, 3, -1)
    blur = 100 * eps * jnp.abs(t + skipped) / period  # the type of the state must resolve the times
    size = (closing_tolerance(y.dtype) + blur) * jnp.ptp(found[:, :, :1], axis=1, keepdims=True)
    return (blur < 0.1) & ~jnp.any(jnp.abs(found - found[:, :, :1]) > size + 1e3 * eps * jnp.abs(found))
