"""Plots of motions: trajectories, audits, eigenvalues, root loci, mode shapes and frequency responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from .._common.lookup import as_names, label_of, refuse_unknown
from .._integrate.audit import Audit
from .._integrate.events import Status
from .._integrate.trajectory import Trajectory, as_trajectory
from .._scalarjit.components import Numbers
from .._system.system import in_degrees, refuse_no_angle, unit_of

Axes: TypeAlias = Any
"""matplotlib's `Axes`. matplotlib is imported only when something is drawn."""

SOFT = "0.55"  # a grey that is visible on white and on black
STABLE = "#2ca02c"


def panels(axes: Axes, rows: int, columns: int = 1, *, size: tuple[float, float], **options: Any) -> np.ndarray:
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
    axes: Axes = None,
    **style: Any,
) -> np.ndarray:
    """Coordinates, speeds and inputs over time, one panel each. The end of a simulation that ended early is marked.

        jk.plot.trajectories(trajectory, ["roll", "steer", ("roll_rate", "steer_rate")], degrees=True)

    **Arguments:**

    - `trajectory`: a `Trajectory`. All members of a batch are drawn, faintly.
    - `names`: the quantities; names in a tuple share a panel. Default: the coordinates, or the
        first-order states if there are no coordinates.
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
        as_names(group, "names")
        for group in ([names] if isinstance(names, str) else names or trajectory.names[0] or trajectory.names[-1])
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
    # Times and values of member `k`, with the values before and after each jump of the state and a gap between them.
    #
    # Without them, a line would slope from the last sample before a jump to the first one after it. Quantities that are
    # not in the state have a gap only.
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


def _mark_ends(ax: Axes, trajectory: Trajectory, t: np.ndarray, y: np.ndarray, color: str) -> None:
    """A cross at the last value of each trajectory that ended early."""
    early = np.flatnonzero(np.ravel(np.asarray(trajectory.status)) != Status.COMPLETED)
    if len(early) > _MARKED:
        return
    for k in early:
        reached = np.flatnonzero(np.isfinite(y[k]))
        if reached.size:
            ax.plot(t[k, reached[-1]], y[k, reached[-1]], "x", color=color, markersize=6, markeredgewidth=1.5)


def audit(audit: Audit, *, axes: Axes = None) -> np.ndarray:
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


def mode_shapes(
    eigenvalues: Numbers,
    vectors: Numbers = None,
    states: Sequence[str] | None = None,
    *,
    at: float | None = None,
    modes: Sequence[str] | None = None,
    only: Sequence[str] | None = None,
    axes: Axes = None,
) -> np.ndarray:
    """Each mode's eigenvector as arrows in the complex plane: amplitude and phase of each state.

        modes = jk.stability.eigenvalues(bicycle, speeds)
        jk.plot.mode_shapes(modes, at=5.0, only=("roll", "steer"))

    Each vector is normalized so that its largest state has length one and phase zero. One mode of a conjugate pair is
    drawn.

    **Arguments:**

    - `eigenvalues`: the result of `jaxkane.stability.eigenvalues`; or eigenvalues (n,) [1/s] together with `vectors`.
    - `vectors` (n_states, n): one column for each mode.
    - `states`: names of the rows of `vectors`.
    - `at`: the value of the parameter; the nearest one of the result is used.
    - `modes`: names of the columns.
    - `only`: the states to draw. Angles and rates have different units, so their arrows cannot be compared.
    - `axes`: polar axes, as many as modes are drawn.

    **Returns:** the axes (n_drawn,).
    """
    lam, X, labels, names, where = _one_point(eigenvalues, vectors, states, at, modes)
    chosen = labels if only is None else as_names(only, "only")
    refuse_unknown(chosen, labels, "mode_shapes: the model has no state")
    rows = [i for i, state in enumerate(labels) if state in chosen]
    drawn = [k for k in range(len(lam)) if lam[k].imag >= -1e-9 * abs(lam[k])]
    if not np.all(np.isfinite(lam)):
        raise ValueError(
            "mode_shapes: the eigenvalues are not finite, because there is no steady motion. Choose another value `at`."
        )
    axes = panels(axes, 1, len(drawn), size=(3.1, 3.6), subplot_kw={"projection": "polar"})[0]
    for ax, k in zip(axes, drawn, strict=True):
        phasors = X[rows, k] / X[rows, k][np.argmax(np.abs(X[rows, k]))]
        for i, (row, z) in enumerate(zip(rows, phasors, strict=True)):
            arrow = {"arrowstyle": "-|>", "color": f"C{i}", "linewidth": 2.0, "shrinkA": 0, "shrinkB": 0}
            ax.annotate("", (np.angle(z), abs(z)), (0.0, 0.0), arrowprops=arrow)
            ax.plot([], [], color=f"C{i}", linewidth=2.0, label=label_of(labels[row]).replace("_", " "))
        name = f"{label_of(names[k])}: " if names[k] else ""
        ax.set_title(f"{name}{_in_words(lam[k])}{where}", fontsize="medium")
        ax.set(rlim=(0.0, 1.05), yticks=[0.5, 1.0], yticklabels=[])
        ax.set_xticks(np.deg2rad([0, 90, 180, 270]))
        ax.tick_params(labelsize="small", labelcolor=SOFT)
        ax.grid(alpha=0.3)
    axes[0].legend(loc="upper left", bbox_to_anchor=(-0.15, -0.08), frameon=False, fontsize="small", ncols=2)
    return axes


def _one_point(
    model: Numbers, vectors: Numbers, states: Sequence[str] | None, at: float | None, modes: Sequence[str] | None
) -> tuple[Any, ...]:
    where = ""
    if vectors is None:
        if not hasattr(model, "vectors"):
            raise TypeError(
                "mode_shapes: pass eigenvalues (n,), vectors (n_states, n) and the states' names, or the result of "
                "jaxkane.stability.eigenvalues(...) and `at`."
            )
        values = np.asarray(model.values, dtype=float)
        if at is None and len(values) > 1:
            raise ValueError(f"mode_shapes: pass `at`, a value between {values.min():g} and {values.max():g}.")
        i = 0 if at is None else int(np.argmin(np.abs(values - at)))
        where = f"\nat {values[i]:.4g}" if len(values) > 1 else ""
        states = model.states if states is None else states
        modes = getattr(model, "modes", None) if modes is None else modes
        model, vectors = model.eigenvalues[i], model.vectors[i]
    lam, X = np.asarray(model, dtype=complex), np.atleast_1d(np.asarray(vectors, complex))
    states = [f"state {i + 1}" for i in range(len(X))] if states is None else list(as_names(states, "states"))
    names = [""] * lam.size if modes is None else list(as_names(modes, "modes"))
    if X.ndim != 2 or lam.shape != X.shape[1:] or (len(states), len(names)) != X.shape:
        raise ValueError(
            f"mode_shapes: `vectors` must be (n_states, n) for `eigenvalues` (n,), n_states `states` and n `modes`; "
            f"got {X.shape}, {lam.shape}, {len(states)} states and {len(names)} modes."
        )
    return lam, X, states, names, where


def _in_words(lam: complex) -> str:
    if abs(lam.imag) <= 1e-9 * abs(lam):
        return f"{lam.real:.3g} 1/s"
    return f"{lam.real:.3g} ± {abs(lam.imag):.3g}i 1/s"


def eigenvalues(
    values: Numbers,
    eigenvalues: Numbers = None,
    *,
    modes: Sequence[str] | None = None,
    xlabel: str | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Axes = None,
) -> Axes:
    """Real parts (lines) and imaginary parts (thin, dotted) over a parameter. Stable ranges are shaded.

        modes = jk.stability.eigenvalues(bicycle, jnp.linspace(0.0, 10.0, 401))
        jk.plot.eigenvalues(modes)

    **Arguments:**

    - `values`: the result of `jaxkane.stability.eigenvalues`; or values (m,) of a parameter together with
        `eigenvalues`.
    - `eigenvalues` (m, n) [1/s]: one column for each mode, NaN if it does not exist.
    - `modes`: names of the columns; those of one name share a colour. Default: those of the result, if any.
    - `xlabel`: the parameter and its unit. Default: the label of the result.
    - `ylim`: limits. Default: the range of the real parts and of the slower oscillations.
    - `ax`: the axes, or None for a new figure.

    **Returns:** the axes. The borders of the shaded ranges are found by linear interpolation between the values.
    """
    x, lam, names = _table(values, eigenvalues, modes)
    xlabel = getattr(values, "parameter", "parameter") if xlabel is None else xlabel
    ax = panels(ax, 1, size=(6.4, 4.2))[0, 0]
    low, high = _limits(lam) if ylim is None else ylim
    borders = []
    for start, stop in stable_ranges(x, lam):
        ax.axvspan(start, stop, color=STABLE, alpha=0.15, linewidth=0)
        borders += [border for border in (start, stop) if x[0] < border < x[-1]]
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(names))}
    for column, name in zip(lam.T, names, strict=True):
        ax.plot(x, column.real, color=colors[name], label=label_of(name) or "real part")
        swings = np.where(np.abs(column.imag) > 1e-9, column.imag, np.nan)
        if np.isfinite(swings).any() and np.nanmax(swings) > 0:
            label = f"{label_of(name)}, imaginary" if name else "imaginary part"
            ax.plot(x, np.where(swings > 0, swings, np.nan), ":", color=colors[name], linewidth=1.2, label=label)
    for border in borders:
        ax.annotate(f"{border:.3g}", (border, low), xytext=(2, 3), textcoords="offset points", fontsize="small")
    ax.set(xlabel=xlabel, ylabel="eigenvalues [1/s]", xlim=(x[0], x[-1]), ylim=(low, high))
    finish(ax, legend=False)
    handles, labels = ax.get_legend_handles_labels()
    handle_of = dict(zip(labels, handles, strict=True))  # modes of one name share an entry
    ax.legend(handle_of.values(), handle_of.keys(), frameon=False, fontsize="small")
    return ax


def root_locus(
    values: Numbers,
    eigenvalues: Numbers = None,
    *,
    label: str | None = None,
    ax: Axes = None,
) -> Axes:
    """The path of the eigenvalues in the complex plane. The colour is the parameter, the stable half-plane is shaded.

    **Arguments:**

    - `values`, `eigenvalues`: as for `eigenvalues`.
    - `label`: of the colour bar, as `xlabel` there.
    - `ax`: the axes, or None for a new figure.

    **Returns:** the axes. A cross marks the start of each path.
    """
    from matplotlib.collections import LineCollection

    x, lam, _ = _table(values, eigenvalues, None)
    label = getattr(values, "parameter", "parameter") if label is None else label
    ax = panels(ax, 1, size=(6.4, 4.2))[0, 0]
    for column in lam.T:
        at = np.stack([column.real, column.imag], axis=1)  # (m, 2)
        pieces = np.stack([at[:-1], at[1:]], axis=1)
        lines = LineCollection(list(pieces), array=0.5 * (x[1:] + x[:-1]), cmap="cool", linewidth=2.0)
        lines.set_clim(x[0], x[-1])
        ax.add_collection(lines)
        ax.plot(*at[0], "x", color=SOFT, markersize=6)
    finite = lam[np.isfinite(lam)]
    width, height = np.ptp(finite.real), np.ptp(finite.imag)
    ax.set_xlim(finite.real.min() - 0.05 * width - 1e-3, max(finite.real.max(), 0.0) + 0.05 * width + 1e-3)
    ax.set_ylim(finite.imag.min() - 0.05 * height - 1e-3, finite.imag.max() + 0.05 * height + 1e-3)
    ax.axvspan(ax.get_xlim()[0], 0.0, color=STABLE, alpha=0.12, linewidth=0, zorder=0)
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    ax.axvline(0.0, color=SOFT, linewidth=0.8)
    ax.figure.colorbar(lines, ax=ax, label=label)
    ax.set(xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    finish(ax, legend=False)
    return ax


def frequency_response(response: Any, *, axes: Axes = None) -> np.ndarray:
    """Magnitude, phase and coherence over frequency: measured (dots, two standard errors) and of the model (line).

        jk.plot.frequency_response(jk.stability.frequency_response(model, trials, "torque", "angle"))

    **Arguments:**

    - `response`: a `jaxkane.stability.FrequencyResponse`.
    - `axes`: three.

    **Returns:** the axes (3, 1).
    """
    axes = panels(axes, 3, size=(6.4, 1.9), sharex=True)
    magnitude, phase, coherence = axes[:, 0]
    w, error = response.frequencies, 2 * response.relative_error
    size = np.abs(response.measured)
    low, high = size * np.maximum(1 - error, 1e-3), size * (1 + np.minimum(error, 1e3))
    magnitude.vlines(w, low, high, color="C0", alpha=0.4, linewidth=1)
    magnitude.loglog(w, size, ".", color="C0", markersize=3, label="measured")
    magnitude.loglog(w, np.abs(response.model), color="C1", linewidth=1.2, label="model")
    of_model = np.unwrap(np.angle(response.model))
    off = np.angle(response.measured / response.model)  # unwrapping the measured phase would add turns by noise
    phase.semilogx(w, np.rad2deg(of_model + off), ".", color="C0", markersize=3)
    phase.semilogx(w, np.rad2deg(of_model), color="C1", linewidth=1.2)
    coherence.semilogx(w, response.coherence, ".", color="C0", markersize=3)
    magnitude.set(ylabel=f"{label_of(response.output)} /\n{label_of(response.input)}")
    phase.set(ylabel="phase [deg]")
    coherence.set(ylabel="coherence", xlabel="frequency [rad/s]", ylim=(0.0, 1.05))
    for ax in (magnitude, phase, coherence):
        finish(ax)
    return axes


def stable_ranges(x: np.ndarray, eigenvalues: Numbers) -> list[tuple[float, float]]:
    """The ranges in which all real parts are negative, by linear interpolation between the values x (m,)."""
    largest = eigenvalues.real.max(axis=1)  # NaN if any is NaN
    ranges, start = [], None
    for k, y in enumerate(largest):
        before = largest[k - 1] if k else np.nan
        crossing = x[k - 1] - before * (x[k] - x[k - 1]) / (y - before) if before * y < 0 else x[k]
        if y < 0 and start is None:
            start = crossing
        elif not y < 0 and start is not None:
            ranges.append((float(start), float(crossing if y > 0 else x[k - 1])))
            start = None
    return ranges if start is None else [*ranges, (float(start), float(x[-1]))]


def _table(values: Numbers, eigenvalues: Numbers, modes: Sequence[str] | None) -> tuple[Any, Any, list[str]]:
    if eigenvalues is None:
        if not hasattr(values, "eigenvalues"):
            raise TypeError(
                "Pass values (m,) and eigenvalues (m, n), or the result of jaxkane.stability.eigenvalues(...)."
            )
        modes = getattr(values, "modes", None) if modes is None else modes
        values, eigenvalues = values.values, values.eigenvalues
    x, lam = np.asarray(values, dtype=float), np.asarray(eigenvalues, dtype=complex)
    names = [""] * (lam.shape or (0,))[-1] if modes is None else list(as_names(modes, "modes"))
    if lam.ndim != 2 or x.shape != lam.shape[:1] or len(x) < 2 or len(names) != lam.shape[1]:
        raise ValueError(
            "Eigenvalues must have the shape (m, n) for m >= 2 values of the parameter and n `modes`; got "
            f"{lam.shape} for {x.shape} and {len(names)} modes."
        )
    if not np.any(np.isfinite(lam)):
        raise ValueError(
            "All eigenvalues are NaN, because no steady motion exists at these values. Choose other values."
        )
    return x, lam, names


def _limits(lam: Numbers) -> tuple[float, float]:
    """Limits that include the largest real part and oscillation. Modes that decay much faster than any oscillation are
    cut off."""
    finite = lam[np.isfinite(lam)]
    top = max(finite.real.max(), finite.imag.max(), 1e-6)
    return max(float(finite.real.min()), -1.2 * float(top)) - 0.05 * float(top), 1.05 * float(top)
