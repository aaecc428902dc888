"""Plots of trajectories over time, and of audits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from .._common.lookup import as_names, label_of
from .._integrate.audit import Audit
from .._integrate.status import Status
from .._integrate.trajectory import Trajectory, as_trajectory
from .._system.system import in_degrees, refuse_no_angle, unit_of

Axes: TypeAlias = Any
"""matplotlib's `Axes`. matplotlib is imported only when something is drawn."""

SOFT = "0.55"  # a grey that is visible on white and on black
STABLE = "#2ca02c"


def panels(axes: Any, rows: int, columns: int = 1, *, size: tuple[float, float], **options: Any) -> np.ndarray:
    """An array (rows, columns) of axes: the passed ones, or those of a new figure, `size` [inches] for each."""
    if axes is not None:
        array = np.ravel(axes)
        if array.size != rows * columns:
            raise ValueError(f"{rows * columns} axes are needed ({rows} rows, {columns} columns), got {array.size}.")
        return array.reshape(rows, columns)
    import matplotlib.pyplot as plt

    figsize = (size[0] * columns, size[1] * rows)
    return plt.subplots(rows, columns, figsize=figsize, squeeze=False, layout="constrained", **options)[1]


def finish(ax: Axes, legend: bool = True) -> None:
    """A faint grid, and a legend without a frame if anything has a label."""
    ax.grid(alpha=0.25)
    if legend and ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False, fontsize="small")


_MARKED = 200  # with more members of a batch, the ends are not marked


def trajectories(
    trajectory: Trajectory,
    names: Sequence[str | Sequence[str]] | None = None,
    *,
    degrees: bool = False,
    units: Mapping[str, str] | None = None,
    label: str | None = None,
    axes: Any = None,
    **style: Any,
) -> np.ndarray:
    """Coordinates, speeds and inputs over time, one panel each. The end of a simulation that ended early is marked.

        jk.plot.trajectories(trajectory, ["roll", "steer", ("roll_rate", "steer_rate")], degrees=True)

    **Arguments:**

    - `trajectory`: a `Trajectory`. All members of a batch are drawn, faintly.
    - `names`: the quantities; names in a tuple share a panel. Default: the coordinates.
    - `degrees`: angles in degrees instead of radians.
    - `units`: by name. Default: those that the system declares (`System.units`), else those of usual names, e.g.
        "roll", "x", "yaw_rate" and "steer_torque".
    - `label`: of this trajectory in the legend, if several are drawn into the same `axes`.
    - `axes`: as many as there are panels.
    - `style`: passed to matplotlib's `plot`.

    **Returns:** the axes (n_panels,).

    **Raises:** `KeyError` for a name that the trajectory does not have; `ValueError` for `degrees` if no quantity is an
    angle.
    """
    trajectory = as_trajectory(trajectory)
    groups = [
        as_names(group, "names") for group in ([names] if isinstance(names, str) else names or trajectory.names[0])
    ]
    drawn = [name for group in groups for name in group]
    units_by_name = {name: unit_of(name, dict(trajectory.units) | dict(units or {})) for name in drawn}
    values = {name: np.asarray(trajectory[name], dtype=float) for name in drawn}
    if degrees:
        refuse_no_angle(drawn, units_by_name.values())
    t = np.asarray(trajectory.t, dtype=float)
    panel_axes = panels(axes, len(groups), size=(7.0, 1.6 if len(groups) > 1 else 3.0), sharex=True)[:, 0]
    n = int(np.prod(t.shape[:-1]))
    members: dict[str, Any] = {"alpha": max(0.08, min(1.0, 4.0 / n**0.5)), "linewidth": 0.8} if t.ndim > 1 else {}
    t = t.reshape(n, -1)
    for ax, group in zip(panel_axes, groups, strict=True):
        labelled = []
        for name in group:
            scale, unit = scale_of(units_by_name[name], degrees)
            parts = [part for part in (label_of(name) if len(group) > 1 else "", label) if part]
            y = (scale * values[name]).reshape(n, -1)
            lines = [_with_jumps(trajectory, name, k, t[k], y[k], scale) for k in range(n)]
            line = ax.plot(*lines[0], label=", ".join(parts) or None, **members | style)[0]
            for points in lines[1:]:
                ax.plot(*points, **members | style | {"color": line.get_color()})
            _mark_ends(ax, trajectory, t, y, line.get_color())
            labelled.append((name, unit))
        ax.set_ylabel(_axis_label(labelled))
        finish(ax)
    if np.ndim(trajectory.status) == 0 and int(trajectory.status) != Status.COMPLETED:
        for ax in panel_axes:
            ax.axvline(float(trajectory.t_end), color=SOFT, linestyle=":", linewidth=1.0)
        ended = f"{label_of(trajectory.reason)} at {float(trajectory.t_end):.3g} s"
        panel_axes[0].set_title(ended, loc="right", fontsize="small")
    panel_axes[-1].set_xlabel("time [s]")
    return panel_axes


def _with_jumps(
    trajectory: Trajectory, name: str, k: int, t: np.ndarray, y: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of member `k`, with the values before and after each jump of the state and a gap between them.

    Without them, a line would slope from the last sample before a jump to the first one after it. Quantities that are
    not in the state have a gap only.
    """
    jumps = trajectory.jumps
    if jumps is None:
        return t, y
    lead = np.ndim(jumps.count)
    member = jax.tree.map(lambda x: np.reshape(np.asarray(x), (-1, *np.shape(x)[lead:]))[k], jumps)
    count = int(member.count)
    times, sides = member.t[:count], [np.full(count, np.nan)] * 2
    if name in member.inputs[0]:
        sides = [side[name][:count] for side in member.inputs]
    for names, part in zip(
        (trajectory.names[0], trajectory.names[1], trajectory.names[3]), ("q", "u", "x"), strict=True
    ):
        if name in names:
            sides = [getattr(side, part)[:count, names.index(name)] for side in (member.before, member.after)]
    # Before a jump, a gap, and after it; samples at the time of a jump have the value after it.
    at = np.repeat(times, 3)
    points = np.stack([scale * sides[0], np.full(count, np.nan), scale * sides[1]], axis=1).reshape(-1)
    places = np.repeat(np.searchsorted(t, times, side="left"), 3)
    return np.insert(t, places, at), np.insert(y, places, points)


def scale_of(unit: str, degrees: bool) -> tuple[float, str]:
    """The factor to the unit that is drawn, and this unit."""
    return (180.0 / np.pi, unit.replace("rad", "deg")) if degrees and in_degrees(unit) else (1.0, unit)


def _axis_label(labelled: Sequence[tuple[str, str]]) -> str:
    units = {unit for _, unit in labelled}
    name = label_of(labelled[0][0]).replace("_", " ") if len(labelled) == 1 else ""
    unit = f"[{label_of(units.pop())}]" if len(units) == 1 and units != {""} else ""
    return f"{name}\n{unit}".strip()


def _mark_ends(ax: Axes, trajectory: Trajectory, t: np.ndarray, y: np.ndarray, color: Any) -> None:
    """A cross at the last value of each trajectory that ended early."""
    early = np.flatnonzero(np.ravel(np.asarray(trajectory.status)) != Status.COMPLETED)
    if len(early) > _MARKED:
        return
    for k in early:
        reached = np.flatnonzero(np.isfinite(y[k]))
        if reached.size:
            ax.plot(t[k, reached[-1]], y[k, reached[-1]], "x", color=color, markersize=6, markeredgewidth=1.5)


def audit(audit: Audit, *, axes: Any = None) -> np.ndarray:
    """Energies, energy error, residuals of the constraints and conditioning over time.

        jk.plot.audit(jk.audit(system, trajectory))

    **Arguments:**

    - `audit`: an `Audit`.
    - `axes`: four.

    **Returns:** the axes (2, 2).
    """
    if not isinstance(audit, Audit):
        raise TypeError(f"plot.audit needs an Audit, e.g. jk.audit(system, trajectory); got a {type(audit).__name__}.")
    panel_axes = panels(axes, 2, 2, size=(4.75, 2.75), sharex=True)
    energies, errors, residuals, conditions = np.ravel(panel_axes)
    energies.plot(audit.t, audit.kinetic_energy, label="kinetic energy")
    energies.plot(audit.t, audit.work, label="work of the loads")
    energies.set(ylabel="[J]")
    errors.plot(audit.t, audit.energy_error, color="C3", label="change of kinetic energy minus work")
    errors.set(ylabel="[J]")
    for values, label in (
        (audit.configuration_residuals, "configuration constraints"),
        (audit.velocity_residuals, "velocity constraints"),
    ):
        if values.size:
            residuals.semilogy(audit.t, np.maximum(np.abs(values).max(1), 1e-17), label=label)
    if not residuals.lines:
        residuals.text(0.5, 0.5, "no constraints", ha="center", transform=residuals.transAxes, color=SOFT)
    conditions.semilogy(audit.t, audit.condition_M, label="condition of M")
    if audit.velocity_residuals.size:
        conditions.semilogy(audit.t, audit.condition_C_dep, label="condition of C_dep")
    for panel in panel_axes.flat:
        finish(panel)
    for panel in (residuals, conditions):
        panel.set(xlabel="time [s]")
    return panel_axes
