"""Motions over time, by name and with units. Knows trajectories; knows no system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, label_of
from .._description.units import in_degrees, refuse_no_angle, unit_of
from .._simulation.trajectory import Status, Trajectory
from ._axes import SOFT, finish, panels

_MARKED = 200  # more members of a batch than this are drawn without a mark where they ended


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
    """Coordinates, speeds and inputs over time, a panel for each; and how the simulation ended, if it ended early.

        jk.plot.trajectories(ride, ["roll", "steer", ("roll_rate", "steer_rate")], degrees=True)

    **Arguments:**

    - `trajectory`: a `Trajectory`. Of a batch all members are drawn, faintly.
    - `names`: of what is drawn; names in a tuple share a panel. By default the coordinates.
    - `degrees`: angles in degrees instead of radians.
    - `units`: by name. By default those that the system declares (`System.units`); where it declares none, those of
        usual names, as "roll", "x", "yaw_rate" and "steer_torque" do.
    - `label`: what this motion is called in the legend, when several are drawn into the same `axes`.
    - `axes`: as many as there are panels. `style`: passed on to matplotlib's `plot`.

    **Returns:** the axes (n_panels,).

    **Raises:** `KeyError` for a name that the trajectory does not have; `ValueError` for `degrees` where nothing is
    known to be an angle.
    """
    groups = [as_names(group) for group in ([names] if isinstance(names, str) else names or trajectory.names[0])]
    drawn = [name for group in groups for name in group]
    known = {name: unit_of(name, dict(trajectory.units) | dict(units or {})) for name in drawn}
    values = {name: np.asarray(trajectory[name], dtype=float) for name in drawn}
    if degrees:
        refuse_no_angle(drawn, known.values())
    t = np.asarray(trajectory.t, dtype=float)
    found = panels(axes, len(groups), size=(7.0, 1.6 if len(groups) > 1 else 3.0), sharex=True)[:, 0]
    n = int(np.prod(t.shape[:-1]))
    members: dict[str, Any] = {"alpha": max(0.08, min(1.0, 4.0 / n**0.5)), "linewidth": 0.8} if t.ndim > 1 else {}
    t = t.reshape(n, -1)
    for ax, group in zip(found, groups, strict=True):
        shown = []
        for name in group:
            y, unit = _in_unit(values[name], known[name], degrees)
            parts = [part for part in (label_of(name) if len(group) > 1 else "", label) if part]
            y = y.reshape(n, -1)
            line = ax.plot(t[0], y[0], label=", ".join(parts) or None, **members | style)[0]
            ax.plot(t[1:].T, y[1:].T, **members | style | {"color": line.get_color()})
            _mark_ends(ax, trajectory, t, y, line.get_color())
            shown.append((name, unit))
        ax.set_ylabel(_axis_label(shown))
        finish(ax)
    if np.ndim(trajectory.status) == 0 and int(trajectory.status) != Status.COMPLETED:
        _tell_the_end(found, trajectory)
    found[-1].set_xlabel("time [s]")
    return found


def _in_unit(y: np.ndarray, unit: str, degrees: bool) -> tuple[np.ndarray, str]:
    return (np.degrees(y), unit.replace("rad", "deg")) if degrees and in_degrees(unit) else (y, unit)


def _axis_label(shown: Sequence[tuple[str, str]]) -> str:
    units = {unit for _, unit in shown}
    name = label_of(shown[0][0]).replace("_", " ") if len(shown) == 1 else ""
    unit = f"[{label_of(units.pop())}]" if len(units) == 1 and units != {""} else ""
    return f"{name}\n{unit}".strip()


def _mark_ends(ax: Any, trajectory: Trajectory, t: np.ndarray, y: np.ndarray, color: Any) -> None:
    """A cross at the last value of every motion that ended early."""
    early = np.flatnonzero(np.ravel(np.asarray(trajectory.status)) != Status.COMPLETED)
    if len(early) > _MARKED:
        return
    for k in early:
        reached = np.flatnonzero(np.isfinite(y[k]))
        if reached.size:
            ax.plot(t[k, reached[-1]], y[k, reached[-1]], "x", color=color, markersize=6, markeredgewidth=1.5)


def _tell_the_end(axes: np.ndarray, trajectory: Trajectory) -> None:
    for ax in axes:
        ax.axvline(float(trajectory.t_end), color=SOFT, linestyle=":", linewidth=1.0)
    axes[0].set_title(
        f"{label_of(trajectory.reason)} at {float(trajectory.t_end):.3g} s", loc="right", fontsize="small"
    )
