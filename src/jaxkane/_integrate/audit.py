"""The audit of a trajectory: energy balance, momenta, residuals of the constraints, conditioning."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.constraint_residuals import configuration_residual, relative_condition
from .._kane.contact.forces import forces_in_contact
from .._kane.kanes_method import accelerations_and_mass_matrix
from .._kane.multipliers import Reactions
from .._kane.right_hand_side import vector_field
from .._kane.scaling import SMALLEST_SIZE, relative, term_sizes
from .._scalarjit.cache_key import jit
from .._scalarjit.components import ZERO3, Triple, add3, as_vector, cross, dot, matvec, stack
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Point, Vector
from .._system.motion import Force, Motion, ReflectedInertia, kinetic_energy_of
from .._system.system import State, System, packed, unpacked
from .inputs import Coordinates, Speeds
from .trajectory import Trajectory, as_trajectory, reached_times


@jit
def _quantities_along(
    system: System,
    t: Float[Array, " n_t"],
    q: Float[Array, "n_t n_q"],
    u: Float[Array, "n_t n_u"],
    inputs: dict[str, Array],
):
    def quantities(t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
        u_dot, M = accelerations_and_mass_matrix(system, t, q, u, inputs)
        return {**_quantities(system, t, q, u, inputs, u_dot), "M": M, "u_dot": u_dot}

    return jax.vmap(quantities)(t, q, u, inputs)


@jit
def _sizes_along(system: System, t: Float[Array, " n_t"], q: Float[Array, "n_t n_q"]):
    """Sizes (h,) of the terms of the configuration constraints along a trajectory."""
    largest = jnp.max(jnp.abs(t)), jnp.maximum(jnp.max(jnp.abs(q), axis=0), SMALLEST_SIZE)

    def sizes_at(t: Array, q: Coordinates):
        return term_sizes(lambda t, q: configuration_residual(system, t, q), t, q, sizes=largest)

    return jnp.max(jax.vmap(sizes_at)(t, q), axis=0)


@ScalarFunction
def _quantities(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array], u_dot: Speeds):
    equations = Reactions(system, t, q, u, inputs, u_dot)
    motion, places = equations.description, _Places()
    loads = equations.loads(motion)
    centers = [body.center for body in motion.bodies if body.center.has_position]
    at_centers = [load if isinstance(load, Force) and load.point in centers else None for load in loads]
    p, H = _momenta(motion, places)
    return {
        "T": as_vector([kinetic_energy_of(motion)], q)[0],
        "power": as_vector([load.vector.dot(load.velocity) for load in loads], q),
        "force": [load and as_vector(_in_N(load.vector), q) for load in at_centers],
        "place": [load and as_vector(places.of(load.point), q) for load in at_centers],
        "prescribed": as_vector([equations.power_of_prescribed_motions()], q)[0],
        "q_dot": as_vector(equations.q_dot, q),
        "p": as_vector(p, q),
        "H": as_vector(H, q),
        "h": configuration_residual(system, t, q),
        "c": as_vector(equations.residuals(equations.t, equations.q, equations.u_all), q),
        "C": stack([(*a, *b) for a, b in zip(equations.C_ind, equations.C_dep, strict=True)]).astype(q.dtype),
    }


@jit
def _powers_along(
    system: System,
    t: Float[Array, " n_t"],
    q: Float[Array, "n_t n_q"],
    u: Float[Array, "n_t n_u"],
    values: dict[str, Array],
    input_rates: dict[str, Array],
    contacts: Float[Array, "n_t m"] | None,
):
    """Powers of the loads, of prescribed motions and of contacts (n_t, l + 1 or 2), and their time derivatives.

    **Arguments:**

    - `values`: inputs and states of the first order by name.
    - `input_rates`: time derivatives of the inputs by name.
    - `contacts` (n_t, m): the contact states; None if the system has no contacts.
    """

    def powers(contacts: Float[Array, " m"] | None, t: Array, q: Coordinates, u: Speeds, values: dict[str, Array]):
        if contacts is None:
            u_dot, of_contacts = accelerations_and_mass_matrix(system, t, q, u, values)[0], []
        else:
            u_dot, power = _contact_power(system, t, q, u, values, contacts)
            of_contacts = [power[None]]
        quantities = _quantities(system, t, q, u, values, u_dot)
        return jnp.concatenate([quantities["power"], quantities["prescribed"][None], *of_contacts])

    def powers_and_rates(
        t: Array,
        q: Coordinates,
        u: Speeds,
        values: dict[str, Array],
        input_rates: dict[str, Array],
        contacts: Float[Array, " m"] | None,
    ):
        x = jnp.stack([values[name] for name in system.states]) if system.states else None
        inputs = {name: values[name] for name in input_rates}
        dot = unpacked(system, vector_field(system, t, packed(State(q, u, x, contacts)), inputs))
        of_states = dict(zip(system.states, () if dot.x is None else dot.x, strict=True))
        directions = jnp.ones_like(t), dot.q, dot.u, {**input_rates, **of_states}
        return jax.jvp(functools.partial(powers, contacts), (t, q, u, values), directions)

    return jax.vmap(powers_and_rates)(t, q, u, values, input_rates, contacts)


@ScalarFunction
def _contact_power(
    system: System, t: Array, q: Coordinates, u: Speeds, values: dict[str, Array], contacts: Float[Array, " m"]
):
    """Accelerations (n,) and the power of the contact forces on the mechanism [W]."""
    u, (forces, u_dot), terms = forces_in_contact(system, t, q, u, contacts, values)
    # Without the velocity of a surface, which is v - C u
    return u_dot, forces.reshape(-1) @ (terms.C @ u)


def _in_N(vector: Vector) -> Triple:
    # Components in N, computed from the components of N's unit vectors, which store every frame in which they were
    # resolved.
    #
    # Resolving each vector itself would pass all frames of its chain. For all vectors the work would be of order n^2.
    N, frame = vector.frame.root, vector.frame
    return tuple(dot(axis.components_in(frame), vector.components) for axis in (N.x, N.y, N.z))  # type: ignore[return-value]


class _Places:
    """Positions in N, each computed from the position of the point from which it was built."""

    def __init__(self) -> None:
        self._known: dict[Point, Triple] = {}

    def of(self, point: Point) -> Triple:
        place = ZERO3
        for each in reversed([*point.chain()]):
            if each not in self._known:
                self._known[each] = add3(place, _in_N(each._offset))  # type: ignore[arg-type]
            place = self._known[each]
        return place


def _momenta(motion: Motion, places: _Places) -> tuple[Triple, Triple]:
    # Linear momentum, and angular momentum about the origin, in N.
    #
    # Reflected inertias are omitted. With an `armature` of 0.2 kg m^2 on a joint of a free chain, H would appear to
    # change by half of its value, although it is conserved to 1e-10.
    p, H = ZERO3, ZERO3
    for body in motion.bodies:
        if isinstance(body, ReflectedInertia):
            continue
        mv = _in_N(body.mass * body.center.velocity)
        spin = body.frame.vector(*matvec(body.inertia, body.angular_velocity.components_in(body.frame)))
        orbital = cross(places.of(body.center), mv) if body.center.has_position else (jnp.nan, jnp.nan, jnp.nan)
        p, H = add3(p, mv), add3(H, add3(_in_N(spin), orbital))
    return p, H


def _work(
    system: System,
    trajectory: Trajectory,
    reached: np.ndarray,
    quantities: dict[str, Any],
    between: Callable[[np.ndarray], dict[str, Any]],
) -> tuple[np.ndarray, float, np.ndarray]:
    """Work (n_t,) of all loads and prescribed motions, an estimate of its error, and the losses (n_t,) in jumps.

    `between`: a function of times (n_t - 1,) between those of the trajectory that returns the quantities there.
    """
    t = np.asarray(trajectory.t, float)[reached]
    jumps, known = trajectory.jumps, trajectory.discontinuities
    has_jumps = jumps is not None and bool(int(jumps.count) or trajectory.contact_names)
    eps = float(np.finfo(np.asarray(trajectory.q).dtype).eps)
    work, rounding = np.zeros_like(t), 0.0
    integrated = np.ones(len(quantities["force"]) + 1 + bool(trajectory.contact_names and has_jumps))
    # The work of weights is exact. A jump may move a mass centre, and no load does work on that.
    for i, (F, r) in enumerate(zip(quantities["force"], quantities["place"], strict=True)):
        if not has_jumps and F is not None and np.ptp(F, axis=0).max() <= 1e-14 * np.abs(F).max():
            work += (r - r[0]) @ F[0]
            rounding += eps * np.abs(r).max() * np.linalg.norm(F[0])  # in float32, 1 km from the origin: 0.1 mm
            integrated[i] = 0.0
    breaks = np.zeros(0) if known is None else np.unique(np.asarray(known.times, float))
    near, gaps = 64 * eps * (t[-1] - t[0]), np.diff(breaks[np.isfinite(breaks)])
    if gaps.size:  # float32 at 1000 s: 64 roundings are 8 ms, and samples of 1 kHz would all be one discontinuity
        near = min(near, 0.1 * float(np.median(gaps)))
    if has_jumps or Pieces(t - t[0], breaks, near).inner.size:
        piecewise, error, lost = _work_of_pieces(system, trajectory, reached, integrated, breaks, near)
        return work + piecewise, error + rounding, lost

    def power_of(at: dict[str, Any]) -> np.ndarray:
        return np.column_stack([at["power"], at["prescribed"]]) @ integrated

    power, pieces, lost = power_of(quantities), Pieces(t), np.zeros_like(t)
    if not power.any():
        return work, float(rounding), lost
    fine, coarse = (pieces.integral(t, power, points) for points in (8, min(6, len(t) - 1)))
    # Two orders agree if both interpolate across the same discontinuity. Half of the times then gives another result.
    sparse = Pieces(t[::2]).integral(t[::2], power[::2], 8) - fine[::2]
    error = max(np.abs(fine - coarse).max(), np.abs(sparse).max() / 16)
    # If the samples miss an oscillation, all rules that use the powers at the samples agree by accident. With 33
    # samples of 32 periods, their estimate was 4e-8 of the error. The accelerations at the samples detect this: between
    # two samples, the power at interpolated coordinates and speeds then differs from the interpolated power.
    half, missed = 0.5 * np.diff(t), 0.0
    for place in (-1, 1):
        s = 0.5 * (t[1:] + t[:-1]) + place * half / 3**0.5  # Gauss points: the error may vanish in the middle
        missed += np.sum(half * np.abs(power_of(between(s)) - pieces.interpolated(s, power[:, None], 8)[:, 0]))
    return work + fine, float(np.nan_to_num(max(error, missed) + rounding, nan=np.inf)), lost


def _work_of_pieces(
    system: System, trajectory: Trajectory, reached: np.ndarray, integrated: np.ndarray, breaks: np.ndarray, near: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """As `_work`, between jumps and `breaks` of the inputs, for the loads that are `integrated`.

    The states before and after each jump are two more samples. `near`: the largest rounding error of a time [s].
    """
    jumps: Any = jax.tree.map(np.asarray, trajectory.jumps)
    t = np.asarray(trajectory.t, float)[reached]
    times, losses = np.zeros((2, 0)) if jumps is None else (np.asarray(x, float) for x in (jumps.t, jumps.energy))
    m = int(np.sum(times <= t[-1] + near))  # the trajectory of an orbit ends before its last jump
    until = times[:m]
    # Jumps within a rounding error are one: no polynomial can pass between them.
    first = np.flatnonzero(np.append(True, np.diff(until) > near)[:m])
    places, times = (first, np.append(first[1:], m)[: len(first)] - 1), times[first]
    is_own = np.abs(t[:, None] - times).min(axis=1, initial=np.inf) > near  # a sample at a jump is that after it
    known = trajectory.discontinuities
    sides = known.inputs if known is not None and known.inputs else (trajectory.inputs, trajectory.inputs)

    def rows(side: int) -> dict[str, Any]:
        """Samples of their own, then jumps, on one side of each time."""
        rows = {"q": trajectory.q, "u": trajectory.u, **trajectory.values, **sides[side]}
        if trajectory.contact_memory is not None:
            rows[CONTACTS] = trajectory.contact_memory
        rows = {name: np.asarray(x)[reached][is_own] for name, x in rows.items()}
        if jumps is None:
            return rows
        state = (jumps.before, jumps.after)[side]
        at_jumps = {"q": state.q, "u": state.u, CONTACTS: state.contacts, **jumps.inputs[side]}
        at_jumps |= {name: state.x[:, i] for i, name in enumerate(system.states)}
        return {name: np.concatenate([x, at_jumps[name][places[side]]]) for name, x in rows.items()}

    clock = np.concatenate([t[is_own], times]) - t[0]
    order = np.argsort(clock, kind="stable")
    clock, (before, after) = clock[order], ({name: x[order] for name, x in rows(side).items()} for side in (0, 1))
    breaks = np.concatenate([times - t[0], breaks])
    pieces = Pieces(clock, breaks[np.isfinite(breaks)], near)
    values = {}
    for name, x in before.items():
        is_after = pieces.is_after if x.ndim == 1 else pieces.is_after[:, None]
        values[name] = np.where(is_after, after[name][pieces.places], x[pieces.places])
    q, u, contacts = values.pop("q"), values.pop("u"), values.pop(CONTACTS, None)
    input_rates = {name: pieces.rate(values[name]) for name in trajectory.inputs}
    origin = np.asarray(trajectory.t)[reached][0]
    powers = _powers_along(system, (origin + pieces.t).astype(q.dtype), q, u, values, input_rates, contacts)
    power, rate = (np.asarray(x, float) @ integrated for x in powers)
    fine, coarse = (pieces.integral(clock, power, 4, rate, spared) for spared in (0, 1))
    lost = np.append(0.0, np.cumsum(losses[:m]))
    return (
        fine[np.searchsorted(clock, t - t[0] - near)],
        float(np.abs(fine - coarse).max()),
        lost[np.searchsorted(until, t + near)],
    )


_NONE = np.zeros(0)


class Pieces:
    """A trajectory, split into pieces between the discontinuities of its inputs.

    A time (n_t,) at a discontinuity belongs to two pieces, with the inputs on its two sides. Arrays of the pieces are
    (n,), in their order.
    """

    def __init__(self, t: np.ndarray, breaks: np.ndarray = _NONE, near: float = 0.0):
        """Split at discontinuities. `near`: the largest rounding error of a time [s]."""
        self.inner = breaks = np.unique(breaks[(breaks > t[0] + near) & (breaks < t[-1] - near)])
        before, after = np.searchsorted(breaks, t - near), np.searchsorted(breaks, t + near)
        self.places = np.repeat(np.arange(len(t)), 1 + (before < after))
        again = np.append(False, self.places[1:] == self.places[:-1])
        self.is_after = again | (before == after)[self.places]
        self.is_after[-1] = False  # a discontinuity at the last time has no effect on the trajectory
        self.t, self.piece = t[self.places], np.where(self.is_after, after[self.places], before[self.places])

    def rate(self, x: np.ndarray) -> np.ndarray:
        """Time derivatives (n,) of values (n,), by polynomials through eight times of a piece."""
        derivative = lambda n, half, scale: np.eye(2, n)[1] / scale[:, None]  # noqa: E731
        return self._of_polynomials(self.t, self.piece, x[:, None], 8, derivative)[:, 0]

    def interpolated(self, t: np.ndarray, x: np.ndarray, points: int, rate: np.ndarray | None = None) -> np.ndarray:
        """Values (n_t, c) at the times t, by polynomial interpolation of the values x (n, c) at `self.t`.

        **Arguments:**

        - `t` (n_t,), `x` (n, c): times, and the values to interpolate.
        - `points`: the number of nearest points of each polynomial.
        - `rate` (n, c): time derivatives, which the polynomials also match.
        """
        value = lambda n, half, scale: np.eye(n)[0]  # noqa: E731
        return self._of_polynomials(t, np.searchsorted(self.inner, t), x, points, value, rate)

    def integral(
        self, t: np.ndarray, x: np.ndarray, points: int, rate: np.ndarray | None = None, spared: int = 0
    ) -> np.ndarray:
        """The integral (n_t,) from t[0] of values (n,), by polynomials through the nearest points of each piece.

        **Arguments:**

        - `t` (n_t,), `x` (n,): times, and the values to integrate at `self.t`.
        - `points`: the number of nearest points of each polynomial.
        - `rate` (n,): time derivatives, which the polynomials also match.
        - `spared`: the number of farthest points at which they do not match the rates.
        """
        ends = np.unique(np.concatenate([t, self.inner]))
        middle, half = 0.5 * (ends[1:] + ends[:-1]), 0.5 * np.diff(ends)
        piece = np.searchsorted(self.inner, middle)

        def moments(n: int, half: np.ndarray, scale: np.ndarray) -> np.ndarray:
            """The integrals (k, n) of the powers of s = t / scale from -half to half (k,)."""
            j, x = np.arange(n), half / scale
            return scale[:, None] * np.where(j % 2 == 0, 2 * x[:, None] ** (j + 1) / (j + 1), 0.0)

        rates = None if rate is None else rate[:, None]
        gained = self._of_polynomials(middle, piece, x[:, None], points, moments, rates, spared, half)[:, 0]
        # A piece that contains none of the times uses interpolated neighbours. Their whole range is then a possible
        # error.
        guess = 2 * half * (np.interp(middle, self.t, x) + spared * np.ptp(x))
        gained = np.where(np.isin(piece, self.piece), gained, guess)
        return np.append(0.0, np.cumsum(gained))[np.searchsorted(ends, t)]

    def _of_polynomials(
        self,
        t: np.ndarray,
        piece: np.ndarray,
        x: np.ndarray,
        points: int,
        moments: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
        rate: np.ndarray | None = None,
        spared: int = 0,
        half: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """A linear functional (n_t, c) of polynomials about the times t; zero for a piece without points.

        `moments`: the functional of the powers of (time / scale), of (number of powers, `half`, scale). Otherwise as
        `integral`.
        """
        result, half = np.zeros((len(t), x.shape[1])), np.broadcast_to(half, t.shape)
        for some, nearest in self._nearest(t, piece, points):
            apart, m = self.t[nearest] - t[some, None], nearest.shape[1]
            n_rates = 0 if rate is None else m - spared
            scale = np.maximum(np.abs(apart).max(axis=1), half[some])
            scale = np.where(scale > 0, scale, 1.0)
            weights = _weights(apart / scale[:, None], moments(m + n_rates, half[some], scale), n_rates)[..., None]
            result[some] = np.sum(weights[:, :m] * x[nearest], axis=1)
            if rate is not None:
                rates = scale[:, None, None] * rate[nearest[:, :n_rates]]
                result[some] += np.sum(weights[:, m:] * rates, axis=1)
        return result

    def _nearest(self, t: np.ndarray, piece: np.ndarray, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The nearest times of the same piece.

        **Arguments:**

        - `t`, `piece`: times, and the pieces to which they belong.
        - `most`: the largest number of nearest times.

        **Returns:** for each number m: indices (k,) of the times that have m neighbours, and the neighbours (k, m), the
        nearest first.
        """
        first, last = np.searchsorted(self.piece, piece), np.searchsorted(self.piece, piece, side="right")
        count = np.minimum(last - first, most)
        start = np.clip(np.searchsorted(self.t, t) - count // 2, first, last - count)
        for m in range(1, most + 1):
            some = np.flatnonzero(count == m)
            places = start[some, None] + np.arange(m)
            order = np.argsort(np.abs(self.t[places] - t[some, None]), axis=1, kind="stable")
            yield some, np.take_along_axis(places, order, axis=1)


def _weights(s: np.ndarray, moments: np.ndarray, rates: int = 0) -> np.ndarray:
    """Weights (k, m + rates) of values and rates, for interpolation or integration.

    **Arguments:**

    - `s` (k, m): points.
    - `moments` (..., m + rates): the required sums for all powers of s.
    - `rates`: the number of points, the first ones, at which rates are used too.
    """
    j = np.arange(s.shape[1] + rates)[:, None]
    powers = [s[:, None, :] ** j, j * s[:, None, :rates] ** np.maximum(j - 1, 0)]  # (k, m + rates, m), (.., rates)
    moments = np.broadcast_to(moments, (len(s), len(j)))
    return np.linalg.solve(np.concatenate(powers, axis=2), moments[..., None])[..., 0]


def _condition_of_masses(M: np.ndarray) -> np.ndarray:
    # Condition numbers (n_t,) of mass matrices (n_t, n, n), scaled to a unit diagonal. Without scaling, different
    # units (metres and radians of a satellite) would look badly conditioned.
    diagonal = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1))
    sizes = np.where(diagonal > 0, diagonal, 1.0)
    return np.linalg.cond(M / (sizes[:, :, None] * sizes[:, None, :]))


CONTACTS = "contact states"
LOOK, BAD = "look", "bad"


class Audit(eqx.Module):
    """Conserved quantities along a trajectory, at the n_t times that it reached. `print(audit)` shows a table,
    `jk.plot.audit(audit)` plots it.

    Attributes, NumPy arrays:

    - `t` (n_t,) [s]: times.
    - `kinetic_energy` (n_t,) [J].
    - `work` (n_t,) [J]: work of all loads and of prescribed motions since `t[0]`.
    - `lost` (n_t,) [J]: kinetic energy lost in jumps since `t[0]` (impacts, and events with `then`).
    - `energy_error` (n_t,) [J]: change of the kinetic energy minus work plus losses.
    - `work_error` [J]: the estimated quadrature error of the work. Work of forces that are constant in N on mass
        centres (weights) is exact. All other power is integrated between the times, by polynomials through eight of
        them. The result is compared with other rules, and with the power at interpolated coordinates and speeds. Save
        more times to reduce the error; the solver's tolerances have no influence.
    - `linear_momentum` (n_t, 3) [kg m/s], `angular_momentum` (n_t, 3) [kg m^2/s] about the origin: components in N. NaN
        if a body has no position. Reflected inertias (`armature`) are omitted.
    - `configuration_residuals` (n_t, h), `velocity_residuals` (n_t, k): of all constraints, in their own units. The
        configuration residuals include the norms of Euler parameters.
    - `configuration_sizes` (h,), `velocity_sizes` (k,): the largest terms of each residual along the trajectory. The
        table shows residuals relative to these, which do not depend on units.
    - `condition_M` (n_t,): condition numbers of the mass matrix, scaled to a unit diagonal, because different units are
        not a defect.
    - `condition_C_dep` (n_t,): condition numbers of the matrix that is solved for the dependent speeds, as in
        `best_dependent_speeds` (1 without dependent speeds).
    - `reason`: how the simulation ended.
    """

    t: np.ndarray
    kinetic_energy: np.ndarray
    work: np.ndarray
    lost: np.ndarray
    work_error: float
    linear_momentum: np.ndarray
    angular_momentum: np.ndarray
    configuration_residuals: np.ndarray
    velocity_residuals: np.ndarray
    configuration_sizes: np.ndarray
    velocity_sizes: np.ndarray
    condition_M: np.ndarray
    condition_C_dep: np.ndarray
    name: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    @property
    def energy_error(self) -> np.ndarray:
        return self.kinetic_energy - self.kinetic_energy[0] - self.work + self.lost

    @property
    def energy_balance(self) -> float:
        """The largest energy error, relative to the largest kinetic energy or work."""
        return _largest(self.energy_error) / max(_largest(self.kinetic_energy), _largest(self.work), 1e-300)

    @property
    def drift(self) -> float:
        """The largest residual of the configuration constraints, in its own unit."""
        return _largest(self.configuration_residuals)

    @property
    def ok(self) -> bool:
        """Whether no line of the table has the verdict "bad"."""
        return not any(verdict.startswith(BAD) for *_, verdict in self.lines())

    def lines(self) -> list[tuple[str, str, str]]:
        """The table: quantity, value, verdict."""
        uncertain = self.work_error / max(_largest(self.kinetic_energy), _largest(self.work), 1e-300)
        energy = _verdict(self.energy_balance, 1e-6, 1e-3)
        if energy != "ok" and uncertain > 0.1 * self.energy_balance:
            energy = "below the work's error: save more times, or use float64"
        lines = [
            ("end", f"{self.t[-1]:.6g} s", self.reason),
            ("kinetic energy", f"{self.kinetic_energy.min():.4g} to {self.kinetic_energy.max():.4g} J", ""),
            ("work of loads", f"{self.work.min():.4g} to {self.work.max():.4g} J", f"+- {self.work_error:.1e} J"),
            *([("lost in jumps", f"{self.lost[-1]:.4g} J", "")] if self.lost.any() else []),
            ("energy balance", f"{self.energy_balance:.1e}", energy),
            ("linear momentum", *_conservation(self.linear_momentum)),
            ("angular momentum", *_conservation(self.angular_momentum)),
        ]
        for what, residuals, sizes in (
            ("configuration", self.configuration_residuals, self.configuration_sizes),
            ("velocity constraints", self.velocity_residuals, self.velocity_sizes),
        ):
            if residuals.size:
                largest = _largest(relative(residuals, sizes))
                lines.append((what, f"{largest:.1e}", _verdict(largest, 1e-6, 1e-3)))
        lines.append(("condition of M", *_condition(self.condition_M)))
        if self.velocity_residuals.size:
            lines.append(("condition of C_dep", *_condition(self.condition_C_dep)))
        return lines

    def __str__(self) -> str:
        lines = self.lines()
        first, second = (max(len(line[i]) for line in lines) for i in (0, 1))
        table = [f"{what:<{first}}  {amount:>{second}}  {verdict}".rstrip() for what, amount, verdict in lines]
        return "\n".join([f"Audit of {self.name}", *table])

    __repr__ = __str__


def audit(system: System, trajectory: Trajectory) -> Audit:
    """Check the conservation of energy, momentum and constraints along a trajectory, and the conditioning of its
    equations.

        T(t) - T(0) = integral of F . v + T . omega over all loads and prescribed motions

    **Arguments:**

    - `system`: the system.
    - `trajectory`: a `Trajectory` of this system; one member of a batch.

    **Returns:** an `Audit`. Times after the end of a simulation that ended early are omitted.

    **Raises:** `ValueError` for a batch, for a trajectory of another system, and for one that reached fewer than two of
    its times.
    """
    trajectory = as_trajectory(trajectory)
    reached = reached_times("audit", system, trajectory)
    if not np.all(np.diff(np.asarray(trajectory.t)) > 0):
        raise ValueError("audit: the times must increase. For a plan with phases, pass one phase: plan.phases[0].")
    t, q, u, inputs = jax.tree.map(
        lambda x: np.asarray(x)[reached], (trajectory.t, trajectory.q, trajectory.u, trajectory.values)
    )
    unknown = [name for name, x in {"u": u, **inputs}.items() if not np.isfinite(x).all()]
    if unknown:
        raise ValueError(f"audit: {', '.join(unknown)} is not finite at times that the simulation reached.")
    quantities = _quantities_along(system, t, q, u, inputs)
    quantities = jax.tree.map(lambda x: np.asarray(x, dtype=float), quantities)
    ts, C, independent = np.asarray(t, dtype=float), quantities["C"], len(system.speeds)

    def between(times: np.ndarray) -> dict[str, Any]:
        names, single = list(inputs), Pieces(ts)
        rows = [(q, quantities["q_dot"], 4), (u, quantities["u_dot"], 4)]
        rows += [(np.asarray(inputs[name])[:, None], None, 8) for name in names]
        q_s, u_s, *w = (single.interpolated(times, np.asarray(x, float), points, rate) for x, rate, points in rows)
        # As long as the trajectory, so that the same compiled program is used
        args = times, q_s, u_s, {name: x[:, 0] for name, x in zip(names, w, strict=True)}
        args = jax.tree.map(lambda x: np.append(x, x[-1:], axis=0).astype(q.dtype), args)
        return jax.tree.map(lambda x: np.asarray(x, float)[:-1], _quantities_along(system, *args))

    work, work_error, lost = _work(system, trajectory, reached, quantities, between)
    # Only the terms of C u: if C u + c0 = 0, c0 is not larger. Otherwise c0 would add the violation to the size.
    all_u = np.concatenate([u, np.asarray(trajectory.u_dep)[reached]], axis=1).astype(float)
    velocity_sizes = (np.abs(C) * np.abs(all_u).max(axis=0)).max(axis=(0, 2)) if C.size else np.zeros(0)
    return Audit(
        t=ts,
        kinetic_energy=quantities["T"],
        work=work,
        lost=lost,
        work_error=work_error,
        linear_momentum=quantities["p"],
        angular_momentum=quantities["H"],
        configuration_residuals=quantities["h"],
        velocity_residuals=quantities["c"],
        configuration_sizes=np.asarray(_sizes_along(system, t, q), float) if quantities["h"].size else np.zeros(0),
        velocity_sizes=velocity_sizes,
        condition_M=_condition_of_masses(quantities["M"]) if quantities["M"].size else np.ones_like(ts),
        condition_C_dep=relative_condition(C, range(independent, C.shape[-1])) if C.size else np.ones_like(ts),
        name=type(system).__name__,
        reason=trajectory.reason,
    )


def _largest(x: np.ndarray) -> float:
    return float(np.abs(x).max(initial=0.0))


def _verdict(x: float, look: float, bad: float) -> str:
    return "ok" if x <= look else LOOK if x <= bad else BAD


def _conservation(x: np.ndarray) -> tuple[str, str]:
    if not np.all(np.isfinite(x)):
        return "", "unknown: a body has no position"
    change = _largest(np.linalg.norm(x - x[0], axis=1))
    scale = _largest(np.linalg.norm(x, axis=1))
    kept = [axis for axis, row in zip("xyz", (x - x[0]).T, strict=True) if _largest(row) <= 1e-6 * max(scale, 1e-300)]
    words = {0: "changes", 3: "conserved"}.get(len(kept), f"conserved along N.{', N.'.join(kept)}")
    return f"{scale:.4g}, changes by {change:.1e}", words


def _condition(x: np.ndarray) -> tuple[str, str]:
    largest = float(np.nan_to_num(x, nan=np.inf).max())
    return f"{largest:.1e}", _verdict(largest, 1e8, 1e12)
