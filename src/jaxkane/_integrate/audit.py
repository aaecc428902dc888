"""The audit of a motion: energy balance, momenta, residuals of the constraints, conditioning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._kane.constraints import configuration_residual, relative_condition
from .._kane.kanes_method import accelerations_and_mass_matrix
from .._kane.reactions import Reactions
from .._kane.rhs import rates
from .._scalarjit.cache_key import jit
from .._scalarjit.components import ZERO3, Triple, add3, as_vector, cross, dot, matvec, stack
from .._scalarjit.function import ScalarFunction
from .._system.kinematics import Point, Vector
from .._system.motion import Force, Motion, kinetic_energy_of
from .._system.system import System
from .trajectory import Trajectory, reached_times


@jit
def _quantities_along(system, t, q, u, inputs):
    def quantities(t, q, u, inputs):
        u_dot, M = accelerations_and_mass_matrix(system, t, q, u, inputs)
        return {**_quantities(system, t, q, u, inputs, u_dot), "M": M}

    return jax.vmap(quantities)(t, q, u, inputs)


@ScalarFunction
def _quantities(system, t, q, u, inputs, u_dot):
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
        "p": as_vector(p, q),
        "H": as_vector(H, q),
        "h": configuration_residual(system, t, q),
        "c": as_vector(equations.residuals(equations.t, equations.q, equations.u_all), q),
        "C": stack([(*a, *b) for a, b in zip(equations.C_ind, equations.C_dep, strict=True)]).astype(q.dtype),
    }


@jit
def _powers_along(system, t, q, u, values, input_rates):
    """Powers of the loads and of prescribed motions (n_t, l + 1), and their time derivatives along the motion, whose
    inputs have these rates by name."""

    def powers(t, q, u, values):
        u_dot, _ = accelerations_and_mass_matrix(system, t, q, u, values)
        quantities = _quantities(system, t, q, u, values, u_dot)
        return jnp.concatenate([quantities["power"], quantities["prescribed"][None]])

    def powers_and_rates(t, q, u, values, input_rates):
        dot = rates(system, t, q, u, values)
        of_states = dict(zip(system.states, () if dot.x is None else dot.x, strict=True))
        return jax.jvp(powers, (t, q, u, values), (jnp.ones_like(t), dot.q, dot.u, {**input_rates, **of_states}))

    return jax.vmap(powers_and_rates)(t, q, u, values, input_rates)


def _in_N(vector: Vector) -> Triple:
    """Components in N, by those of N's unit vectors, which remember every frame that they were resolved in.

    A vector that is resolved itself passes all frames of its chain, and with all of them the work is of order n^2.
    """
    N, frame = vector.frame.root, vector.frame
    return tuple(dot(axis.components_in(frame), vector.components) for axis in (N.x, N.y, N.z))  # type: ignore[return-value]


class _Places:
    """Positions in N, each from that of the point it was made from."""

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
    """Linear momentum, and angular momentum about the origin, in N."""
    p, H = ZERO3, ZERO3
    for body in motion.bodies:
        mv = _in_N(body.mass * body.center.velocity)
        spin = body.frame.vector(*matvec(body.inertia, body.angular_velocity.components_in(body.frame)))
        orbital = cross(places.of(body.center), mv) if body.center.has_position else (jnp.nan, jnp.nan, jnp.nan)
        p, H = add3(p, mv), add3(H, add3(_in_N(spin), orbital))
    return p, H


def _work(t: np.ndarray, quantities: dict[str, Any], pieces: Pieces) -> tuple[np.ndarray, float]:
    """Work (n_t,) of all loads and prescribed motions, and an estimate of its error."""
    work, integrated = np.zeros_like(t), np.ones(len(quantities["force"]) + 1)
    for i, (F, r) in enumerate(zip(quantities["force"], quantities["place"], strict=True)):
        if F is not None and np.ptp(F, axis=0).max() <= 1e-14 * np.abs(F).max():
            work += (r - r[0]) @ F[0]
            integrated[i] = 0.0
    if pieces.powers is not None:
        power, rate = (x @ integrated for x in pieces.powers)
        fine, coarse = (pieces.integral(t, power, 4, rate, spared) for spared in (0, 1))
        return work + fine, float(np.abs(fine - coarse).max())
    power = np.column_stack([quantities["power"], quantities["prescribed"]]) @ integrated
    fine, coarse = (pieces.integral(t, power, points) for points in (8, min(6, len(t) - 1)))
    # Two orders agree where both jump across the same place; half of the times then does not.
    sparse = Pieces(t[::2]).integral(t[::2], power[::2], 8) - fine[::2]
    return work + fine, float(max(np.abs(fine - coarse).max(), np.abs(sparse).max() / 16))


_NONE = np.zeros(0)


class Pieces:
    """The pieces of a motion between kinks and jumps of its inputs. A time (n_t,) at which one stands belongs to two
    pieces, with the inputs on its two sides: arrays of the pieces are (n,), in their order.

    `powers`: those of `_powers_along` at the times of the pieces, where there are kinks.
    """

    def __init__(self, t: np.ndarray, kinks: np.ndarray = _NONE, near: float = 0.0):
        """`near`: how far from a kink a time may be by rounding errors [s]."""
        self.inner = kinks = np.unique(kinks[(kinks > t[0] + near) & (kinks < t[-1] - near)])
        before, after = np.searchsorted(kinks, t - near), np.searchsorted(kinks, t + near)
        self.places = np.repeat(np.arange(len(t)), 1 + (before < after))
        again = np.append(False, self.places[1:] == self.places[:-1])
        self.is_after = again | (before == after)[self.places]
        self.is_after[-1] = False  # a jump at the last time is none of the motion
        self.t, self.piece = t[self.places], np.where(self.is_after, after[self.places], before[self.places])
        self.powers: Any = None

    def of(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Values (n_t,) on both sides of the times as those (n,) of the pieces."""
        return np.where(self.is_after, after[self.places], before[self.places])

    def rate(self, x: np.ndarray) -> np.ndarray:
        """Time derivatives (n,) of values (n,), by polynomials through eight times of a piece."""
        rate = np.zeros_like(x)
        for some, nearest in self._nearest(self.t, self.piece, 8):
            apart = self.t[nearest] - self.t[some, None]
            scale = np.abs(apart).max(axis=1)
            if nearest.shape[1] > 1:
                weights = _weights(apart / scale[:, None], np.eye(nearest.shape[1])[1])
                rate[some] = np.sum(weights * x[nearest], axis=1) / scale
        return rate

    def integral(
        self, t: np.ndarray, x: np.ndarray, points: int, rate: np.ndarray | None = None, spared: int = 0
    ) -> np.ndarray:
        """The integral (n_t,) from t[0] of values (n,), by polynomials through so many nearest points of their piece;
        they meet the rates (n,) too, where these are given, but at the farthest `spared` points."""
        ends = np.unique(np.concatenate([t, self.inner]))
        middle, half = 0.5 * (ends[1:] + ends[:-1]), 0.5 * np.diff(ends)
        # In a piece without any of the times nothing is known, but what stands beside it: it may be off by all of that.
        gained = 2 * half * (np.interp(middle, self.t, x) + spared * np.ptp(x))
        for some, nearest in self._nearest(middle, np.searchsorted(self.inner, middle), points):
            apart, m = self.t[nearest] - middle[some, None], nearest.shape[1]
            n_rates = 0 if rate is None else m - spared
            scale = np.maximum(np.abs(apart).max(axis=1), half[some])
            weights = _weights(apart / scale[:, None], _moments(m + n_rates, half[some] / scale), n_rates)
            values = x[nearest]
            if rate is not None:
                values = np.concatenate([values, scale[:, None] * rate[nearest[:, :n_rates]]], axis=1)
            gained[some] = scale * np.sum(weights * values, axis=1)
        return np.append(0.0, np.cumsum(gained))[np.searchsorted(ends, t)]

    def _nearest(self, t: np.ndarray, piece: np.ndarray, most: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """For times in these pieces, the nearest of the piece's own, `most` of them at most: which of the times (k,)
        have the same number m of these, and their places (k, m), the nearest first."""
        first, last = np.searchsorted(self.piece, piece), np.searchsorted(self.piece, piece, side="right")
        count = np.minimum(last - first, most)
        start = np.clip(np.searchsorted(self.t, t) - count // 2, first, last - count)
        for m in range(1, most + 1):
            some = np.flatnonzero(count == m)
            places = start[some, None] + np.arange(m)
            order = np.argsort(np.abs(self.t[places] - t[some, None]), axis=1, kind="stable")
            yield some, np.take_along_axis(places, order, axis=1)


def _weights(s: np.ndarray, moments: np.ndarray, rates: int = 0) -> np.ndarray:
    """Weights (k, m + rates) of values at the places s (k, m), and of rates at the first of them, whose sums are these
    moments (..., m + rates) of all powers of s."""
    j = np.arange(s.shape[1] + rates)[:, None]
    powers = [s[:, None, :] ** j, j * s[:, None, :rates] ** np.maximum(j - 1, 0)]  # (k, m + rates, m), (.., rates)
    moments = np.broadcast_to(moments, (len(s), len(j)))
    return np.linalg.solve(np.concatenate(powers, axis=2), moments[..., None])[..., 0]


def _moments(n: int, x: np.ndarray) -> np.ndarray:
    """The integrals (k, n) of the powers of s from -x to x (k,)."""
    j = np.arange(n)
    return np.where(j % 2 == 0, 2 * x[:, None] ** (j + 1) / (j + 1), 0.0)


def _condition_of_masses(M: np.ndarray) -> np.ndarray:
    """Condition numbers (n_t,) of mass matrices (n_t, n, n), each speed in units in which it moves a mass of one: that
    metres stand beside radians, as of a satellite, makes nothing badly conditioned."""
    diagonal = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1))
    sizes = np.where(diagonal > 0, diagonal, 1.0)
    return np.linalg.cond(M / (sizes[:, :, None] * sizes[:, None, :]))


LOOK, BAD = "look", "bad"


class Audit(eqx.Module):
    """What was kept along a motion, at the n_t times that it reached. `print(audit)` shows a table,
    `jk.plot.audit(audit)` draws it.

    Attributes, NumPy arrays:

    - `t` (n_t,) [s]. `kinetic_energy`, `work` (n_t,) [J]: the work of all loads and of what drives prescribed motions,
        since `t[0]`. `energy_error` (n_t,) [J]: kinetic energy gained, less work.
    - `work_error` [J]: what the quadrature of the work may have cost. Work of forces that are constant in N on mass
        centres (weights) is exact; the power of all else is integrated between the times of the trajectory, by
        polynomials through eight of them. More times, a smaller error; the solver's tolerances are not seen here.
    - `linear_momentum` (n_t, 3) [kg m/s]; `angular_momentum` (n_t, 3) [kg m^2/s] about the origin; components in N. NaN
        where a body has no position.
    - `configuration_residuals` (n_t, h), `velocity_residuals` (n_t, k): of all constraints, in their own units. Norms
        of Euler parameters are among the first.
    - `condition_M`, `condition_C_dep` (n_t,): condition numbers of the mass matrix, its diagonal brought to 1, since
        metres beside radians are no fault; and of what the dependent speeds are solved from, as
        `best_dependent_speeds` has them (1 without dependent speeds).
    - `reason`: how the simulation ended.
    """

    t: np.ndarray
    kinetic_energy: np.ndarray
    work: np.ndarray
    work_error: float
    linear_momentum: np.ndarray
    angular_momentum: np.ndarray
    configuration_residuals: np.ndarray
    velocity_residuals: np.ndarray
    condition_M: np.ndarray
    condition_C_dep: np.ndarray
    name: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    @property
    def energy_error(self) -> np.ndarray:
        return self.kinetic_energy - self.kinetic_energy[0] - self.work

    @property
    def energy_balance(self) -> float:
        """The largest energy error, relative to the largest kinetic energy or work."""
        return _relative(self.energy_error, self.kinetic_energy, self.work)

    @property
    def drift(self) -> float:
        """The largest residual of the configuration constraints."""
        return _largest(self.configuration_residuals)

    @property
    def ok(self) -> bool:
        """Whether no line of the table has the verdict "bad"."""
        return not any(verdict.startswith(BAD) for *_, verdict in self.lines())

    def lines(self) -> list[tuple[str, str, str]]:
        """The table: what, how much, verdict."""
        uncertain = self.work_error / max(_largest(self.kinetic_energy), _largest(self.work), 1e-300)
        energy = _verdict(self.energy_balance, 1e-6, 1e-3)
        if energy != "ok" and uncertain > 0.1 * self.energy_balance:
            energy = "save more times: the work is not known better"
        lines = [
            ("end", f"{self.t[-1]:.6g} s", self.reason),
            ("kinetic energy", f"{self.kinetic_energy.min():.4g} to {self.kinetic_energy.max():.4g} J", ""),
            ("work of loads", f"{self.work.min():.4g} to {self.work.max():.4g} J", f"+- {self.work_error:.1e} J"),
            ("energy balance", f"{self.energy_balance:.1e}", energy),
            ("linear momentum", *_conservation(self.linear_momentum)),
            ("angular momentum", *_conservation(self.angular_momentum)),
        ]
        if self.configuration_residuals.size:
            lines.append(("configuration", f"{self.drift:.1e}", _verdict(self.drift, 1e-6, 1e-3)))
        if self.velocity_residuals.size:
            largest = _largest(self.velocity_residuals)
            lines.append(("velocity constraints", f"{largest:.1e}", _verdict(largest, 1e-6, 1e-3)))
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
    """Whether a motion kept what it should: energy, momentum, constraints; and how well its equations were conditioned.

        T(t) - T(0) = integral of F . v + T . omega over all loads, and of what drives prescribed motions

    **Arguments:** the `system`, and a `Trajectory` of it; of a batch, one member.

    **Returns:** an `Audit`. What comes after the end of a simulation that stopped early is left out.

    **Raises:** `ValueError` for a batch, for the motion of another system, and for one that reached fewer than two
    of its times.
    """
    reached = reached_times("audit", system, trajectory)
    t, q, u, inputs = jax.tree.map(
        lambda x: np.asarray(x)[reached], (trajectory.t, trajectory.q, trajectory.u, trajectory.values)
    )
    unknown = [name for name, x in {"u": u, **inputs}.items() if not np.isfinite(x).all()]
    if unknown:
        raise ValueError(f"audit: {', '.join(unknown)} of the trajectory: not finite at times that the motion reached.")
    quantities = _quantities_along(system, t, q, u, inputs)
    quantities = jax.tree.map(lambda x: np.asarray(x, dtype=float), quantities)
    ts, C, independent = np.asarray(t, dtype=float), quantities["C"], len(system.speeds)
    work, work_error = _work(ts, quantities, _pieces(system, trajectory, reached))
    return Audit(
        t=ts,
        kinetic_energy=quantities["T"],
        work=work,
        work_error=work_error,
        linear_momentum=quantities["p"],
        angular_momentum=quantities["H"],
        configuration_residuals=quantities["h"],
        velocity_residuals=quantities["c"],
        condition_M=_condition_of_masses(quantities["M"]),
        condition_C_dep=relative_condition(C, range(independent, C.shape[-1])) if C.size else np.ones_like(ts),
        name=type(system).__name__,
        reason=trajectory.reason,
    )


def _pieces(system: System, trajectory: Trajectory, reached: np.ndarray) -> Pieces:
    """The motion between kinks and jumps of its inputs."""
    kinks = trajectory.discontinuities
    t, q, u = (np.asarray(x)[reached] for x in (trajectory.t, trajectory.q, trajectory.u))
    if kinks is None:
        return Pieces(np.asarray(t, float))
    near = 64 * np.finfo(t.dtype).eps * np.abs(t).max()
    pieces = Pieces(np.asarray(t, float), np.asarray(kinks.times, float), near)
    if not pieces.inner.size:
        return pieces
    values = {name: np.asarray(x)[reached][pieces.places] for name, x in trajectory.values.items()}
    if kinks.inputs:
        before, after = ({name: np.asarray(x)[reached] for name, x in inputs.items()} for inputs in kinks.inputs)
        values |= {name: pieces.of(before[name], after[name]) for name in before}
    input_rates = {name: pieces.rate(values[name]) for name in trajectory.inputs}
    powers = _powers_along(system, *(x[pieces.places] for x in (t, q, u)), values, input_rates)
    pieces.powers = tuple(np.asarray(x, float) for x in powers)
    return pieces


def _largest(x: np.ndarray) -> float:
    return float(np.abs(x).max(initial=0.0))


def _relative(error: np.ndarray, *scales: np.ndarray) -> float:
    return _largest(error) / max(*map(_largest, scales), 1e-300)


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
