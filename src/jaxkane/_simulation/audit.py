"""Whether a motion kept what it should: energy, momenta, constraints. Knows trajectories; knows no mechanism."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._description.system import System
from .._method.drift import relative_condition
from .balance import Pieces, condition_of_masses, measured_along, powers_along, work_of
from .one_motion import reached_times
from .trajectory import Trajectory

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

    **Raises:** `ValueError` for a batch, for the motion of another system, and for one that reached fewer than two
    of its times.
    """
    name = type(system).__name__
    reached = reached_times("audit", system, trajectory)
    t, q, u = (x[reached] for x in (trajectory.t, trajectory.q, trajectory.u))
    inputs = {key: x[reached] for key, x in trajectory.values.items()}
    now = jax.tree.map(lambda x: np.asarray(x, dtype=float), measured_along(system, t, q, u, inputs))
    ts = np.asarray(t, dtype=float)
    work, work_error = work_of(ts, now, _pieces(system, trajectory, reached))
    return Audit(
        t=ts,
        kinetic_energy=now["T"],
        work=work,
        work_error=work_error,
        linear_momentum=now["p"],
        angular_momentum=now["H"],
        configuration_residuals=now["h"],
        velocity_residuals=now["c"],
        condition_M=condition_of_masses(now["M"]),
        condition_C_dep=relative_condition(now["C"], range(len(system.speeds), now["C"].shape[-1]))
        if now["c"].size
        else np.ones_like(ts),
        name=name,
        reason=trajectory.reason,
    )


def _pieces(system: System, trajectory: Trajectory, reached: np.ndarray) -> Pieces | None:
    """The motion between kinks and jumps of its inputs, where it has any."""
    sides = trajectory.sides
    if sides is None:
        return None
    t, q, u = (np.asarray(x)[reached] for x in (trajectory.t, trajectory.q, trajectory.u))
    near = 64 * np.finfo(t.dtype).eps * np.abs(t).max()
    pieces = Pieces(np.asarray(t, float), np.asarray(sides.times, float), near)
    if not pieces.inner.size:
        return None
    values = {name: np.asarray(x)[reached][pieces.places] for name, x in trajectory.values.items()}
    if sides.inputs:
        before, after = ({name: np.asarray(x)[reached] for name, x in inputs.items()} for inputs in sides.inputs)
        values |= {name: pieces.of(before[name], after[name]) for name in before}
    input_rates = {name: pieces.rate(values[name]) for name in trajectory.inputs}
    powers = powers_along(system, *(x[pieces.places] for x in (t, q, u)), values, input_rates)
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
