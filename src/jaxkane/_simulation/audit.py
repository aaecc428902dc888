"""What a simulation should have kept, and whether it did. Knows the method and trajectories; knows no mechanism."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._description.bodies import Force, Motion, kinetic_energy_of
from .._description.points import Point
from .._description.system import System
from .._description.vectors import Vector
from .._method.description_facts import configuration_residual
from .._method.drift import relative_condition
from .._method.rates import accelerations_and_mass_matrix
from .._method.reactions import Reactions
from .._scalars.components import ZERO3, add3, cross, dot, matvec
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, stack
from .._scalars.types import Triple
from .._scalars.versions import compiled
from .trajectory import Trajectory

ORDERS = (8, 6)  # points under the polynomials whose integrals are the work, and its estimated error
LOOK, BAD = "look", "bad"


class Audit(eqx.Module):
    """What was kept along a motion, at the n_t times that it reached. `print(audit)` says it, `audit.plot()` draws it.

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

    def plot(self, axes: Any = None) -> Any:
        """Energies, energy error, residuals and conditioning, each in one of four matplotlib `axes`, which return."""
        if axes is None:
            import matplotlib.pyplot as plt

            _, axes = plt.subplots(2, 2, sharex=True, figsize=(9.5, 5.5), layout="constrained")
        energies, errors, residuals, conditions = np.ravel(axes)
        energies.plot(self.t, self.kinetic_energy, label="kinetic energy")
        energies.plot(self.t, self.work, label="work of the loads")
        energies.set(ylabel="[J]")
        errors.plot(self.t, self.energy_error, color="C3", label="kinetic energy gained, less work")
        errors.set(ylabel="[J]")
        for values, label in (
            (self.configuration_residuals, "configuration constraints"),
            (self.velocity_residuals, "velocity constraints"),
        ):
            if values.size:
                residuals.semilogy(self.t, np.maximum(np.abs(values).max(1), 1e-17), label=label)
        if not residuals.lines:
            residuals.text(0.5, 0.5, "no constraints", ha="center", transform=residuals.transAxes, color="0.5")
        conditions.semilogy(self.t, self.condition_M, label="condition of M")
        if self.velocity_residuals.size:
            conditions.semilogy(self.t, self.condition_C_dep, label="condition of C_dep")
        for panel in (energies, errors, residuals, conditions):
            panel.grid(alpha=0.25)
            if panel.lines:
                panel.legend(frameon=False, fontsize="small")
        for panel in (residuals, conditions):
            panel.set(xlabel="time [s]")
        return axes


def audit(system: System, trajectory: Trajectory) -> Audit:
    """Whether a motion kept what it should: energy, momentum, constraints; and how well its equations were conditioned.

        T(t) - T(0) = integral of F . v + T . omega over all loads, and of what drives prescribed motions

    **Arguments:** the `system`, and a `Trajectory` of it; of a batch, one member.

    **Returns:** an `Audit`. What comes after the end of a simulation that stopped early is left out.

    **Raises:** `ValueError` for a batch, and for a trajectory that reached fewer than two of its times.
    """
    name = type(system).__name__
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"audit({name}): the second argument is a Trajectory, as from simulate, got {trajectory!r}.")
    if trajectory.t.ndim != 1:
        raise ValueError(
            f"audit({name}): takes one motion; of a batch of shape {trajectory.t.shape[:-1]} give one member."
        )
    reached = np.all(np.isfinite(np.asarray(trajectory.q)), axis=1)
    if reached.sum() < 2:
        raise ValueError(
            f"audit({name}): the simulation reached only {reached.sum()} of its times: {trajectory.reason}."
        )
    t, q, u = (x[reached] for x in (trajectory.t, trajectory.q, trajectory.u))
    inputs = {key: x[reached] for key, x in trajectory.values.items()}
    now = jax.tree.map(lambda x: np.asarray(x, dtype=float), _measured_along(system, t, q, u, inputs))
    ts = np.asarray(t, dtype=float)
    work, work_error = _work(ts, now)
    return Audit(
        t=ts,
        kinetic_energy=now["T"],
        work=work,
        work_error=work_error,
        linear_momentum=now["p"],
        angular_momentum=now["H"],
        configuration_residuals=now["h"],
        velocity_residuals=now["c"],
        condition_M=_condition_of_masses(now["M"]),
        condition_C_dep=relative_condition(now["C"], range(len(system.speeds), now["C"].shape[-1]))
        if now["c"].size
        else np.ones_like(ts),
        name=name,
        reason=trajectory.reason,
    )


@compiled
def _measured_along(system, t, q, u, inputs):
    def measured(t, q, u, inputs):
        u_dot, M = accelerations_and_mass_matrix(system, t, q, u, inputs)
        return {**_measured(system, t, q, u, inputs, u_dot), "M": M}

    return jax.vmap(measured)(t, q, u, inputs)


@fused
def _measured(system, t, q, u, inputs, u_dot):
    now = Reactions(system, t, q, u, inputs, u_dot)
    motion, places = now.description, _Places()
    loads = now.loads(motion)
    centers = [body.center for body in motion.bodies if body.center.has_position]
    at_centers = [load if isinstance(load, Force) and load.point in centers else None for load in loads]
    p, H = _momenta(motion, places)
    return {
        "T": as_vector([kinetic_energy_of(motion)], q)[0],
        "power": as_vector([load.vector.dot(load.velocity) for load in loads], q),
        "force": [load and as_vector(_in_N(load.vector), q) for load in at_centers],
        "place": [load and as_vector(places.of(load.point), q) for load in at_centers],
        "prescribed": as_vector([now.power_of_prescribed_motions()], q)[0],
        "p": as_vector(p, q),
        "H": as_vector(H, q),
        "h": configuration_residual(system, t, q),
        "c": as_vector(now.residuals(now.t, now.q, now.u_all), q),
        "C": stack([(*a, *b) for a, b in zip(now.C_ind, now.C_dep, strict=True)]).astype(q.dtype),
    }


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
        chain = []
        while point is not None and point not in self._known:
            chain.append(point)
            point = point._base  # type: ignore[assignment]
        place = ZERO3 if point is None else self._known[point]
        for point in reversed(chain):
            place = self._known[point] = add3(place, _in_N(point._offset))  # type: ignore[arg-type]
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


def _work(t: np.ndarray, now: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Work (n_t,) of all loads and prescribed motions, and an estimate of its error."""
    work = np.zeros_like(t)
    power = now["prescribed"].copy()
    for i, (F, r) in enumerate(zip(now["force"], now["place"], strict=True)):
        if F is not None and np.ptp(F, axis=0).max() <= 1e-14 * np.abs(F).max():
            work += (r - r[0]) @ F[0]
        else:
            power += now["power"][:, i]
    fine, coarse = (_cumulative_integral(t, power, order) for order in ORDERS)
    return work + fine, float(np.abs(fine - coarse).max())


def _cumulative_integral(t: np.ndarray, x: np.ndarray, points: int) -> np.ndarray:
    """The integral (n,) of samples x (n,) from t[0], by a polynomial through the nearest `points` of each interval."""
    n = len(t)
    m = min(points, n)
    first = np.clip(np.arange(n - 1) - (m - 2) // 2, 0, n - m)
    places = first[:, None] + np.arange(m)  # (n-1, m)
    middle, half = 0.5 * (t[1:] + t[:-1]), 0.5 * np.diff(t)
    s = (t[places] - middle[:, None]) / half[:, None]  # the interval is -1 .. 1
    powers = s[:, None, :] ** np.arange(m)[:, None]  # (n-1, m, m)
    moments = np.array([2 / (j + 1) if j % 2 == 0 else 0.0 for j in range(m)])
    weights = np.linalg.solve(powers, np.broadcast_to(moments[:, None], (n - 1, m, 1)))[..., 0]
    return np.concatenate([[0.0], np.cumsum(half * np.sum(weights * x[places], axis=1))])


def _condition_of_masses(M: np.ndarray) -> np.ndarray:
    """Condition numbers (n_t,) of mass matrices (n_t, n, n), each speed in units in which it moves a mass of one: that
    metres stand beside radians, as of a satellite, makes nothing badly conditioned."""
    diagonal = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1))
    sizes = np.where(diagonal > 0, diagonal, 1.0)
    return np.linalg.cond(M / (sizes[:, :, None] * sizes[:, None, :]))


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
