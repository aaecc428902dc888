"""Plots of fits: measured and simulated, residuals, costs, estimates, profiles, and the path of a selection."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from .._common.lookup import as_names, hint, label_of, refuse_unknown
from .._scalarjit.components import Numbers
from .._system.system import refuse_no_angle, unit_of, units_of
from ._motions import SOFT, Axes, finish, panels, scale_of

Fit: TypeAlias = Any
"""A `jaxkane.fit.Fit`. This package does not import `jaxkane.fit`, which draws its reports with it."""

_TRIALS = 3


def fits(
    fit: Fit,
    trials: Sequence[str | int] | None = None,
    channels: Sequence[str] | None = None,
    *,
    residuals: bool = True,
    degrees: bool = False,
    units: Mapping[str, str] | None = None,
    axes: Axes = None,
) -> np.ndarray:
    """Measured (dots) and simulated (line) by channel and trial; below each, the residuals in standard deviations.

        result = jk.fit.fit(system, trials, ("mass", "damping"))
        jk.plot.fits(result, ["ride 1", "ride 7"], degrees=True)

    **Arguments:**

    - `fit`: a `jaxkane.fit.Fit`.
    - `trials`: names or numbers. Default: the first, the middle and the last.
    - `channels`: all by default.
    - `residuals`: whether they are drawn. Their grey band is two standard deviations of the measurement.
    - `degrees`, `units`: as for `trajectories`.
    - `axes`: a row for each channel, or two with residuals; a column for each trial.

    **Returns:** the axes (n_rows, n_trials).

    **Raises:** `ValueError` for a trial or a channel that the fit does not have.
    """
    names = list(fit.trial_names)
    if trials is None:
        chosen = np.unique(np.linspace(0, len(names) - 1, min(len(names), _TRIALS)).astype(int)).tolist()
    else:
        chosen = [_number(names, trial) for trial in ([trials] if isinstance(trials, (str, int)) else trials)]
    all_channels = list(fit.problem.channels)
    channels = all_channels if channels is None else list(as_names(channels, "channels"))
    refuse_unknown(channels, all_channels, "fits: the fit has no channel")
    if not channels:
        raise ValueError(f"fits: `channels` is empty; {hint([], all_channels)}")
    units_by_name = {
        channel: unit_of(channel, units_of(fit.problem.system) | dict(units or {})) for channel in channels
    }
    if degrees:
        refuse_no_angle(channels, units_by_name.values())
    each = 1 + residuals
    heights = {"height_ratios": [3, 1.2][:each] * len(channels)}
    axes = panels(axes, each * len(channels), len(chosen), size=(4.2, 1.5), sharex="col", sharey="row", **heights)
    fitted, all_residuals = fit.fitted, fit.residuals
    for column, k in zip(axes.T, chosen, strict=True):
        trial = fit.problem.trials[k]
        column[0].set_title(label_of(names[k]), fontsize="medium")
        column[-1].set_xlabel("time [s]")
        for ax, below, channel in zip(column[::each], column[each - 1 :: each], channels, strict=True):
            if channel not in trial.measured:
                ax.text(0.5, 0.5, "not measured", ha="center", va="center", color=SOFT, transform=ax.transAxes)
                continue
            scale, unit = scale_of(units_by_name[channel], degrees)
            ax.plot(
                trial.t, scale * trial.measured[channel], ".", color="C0", markersize=3, alpha=0.6, label="measured"
            )
            ax.plot(trial.t, scale * fitted[names[k]][channel], color="C1", linewidth=1.2, label="simulated")
            finish(ax, legend=False)
            if residuals:
                below.axhspan(-2.0, 2.0, color=SOFT, alpha=0.2, linewidth=0)
                below.plot(trial.t, all_residuals[names[k]][channel], ".", color="C0", markersize=2)
                finish(below, legend=False)
            if column is axes.T[0] or k == chosen[0]:
                words = label_of(channel).replace("_", " ")
                ax.set_ylabel(f"{words}\n[{label_of(unit)}]" if unit else words)
                if residuals:
                    below.set_ylabel("residual\n[σ]", fontsize="small")
    axes[0, 0].legend(frameon=False, fontsize="small", markerscale=2)
    return axes


def _number(names: list[str], trial: str | int) -> int:
    if isinstance(trial, str) and trial in names:
        return names.index(trial)
    if not isinstance(trial, str) and -len(names) <= trial < len(names):
        return range(len(names))[trial]
    raise ValueError(f"fits: the fit has no trial {trial!r}; {hint(str(trial), names)}")


def residuals(
    fit: Fit,
    over: str | Callable[[Any], Any] = "t",
    channels: Sequence[str] | None = None,
    trials: Sequence[str | int] | None = None,
    *,
    bins: int = 20,
    axes: Axes = None,
) -> np.ndarray:
    """Residuals of all samples over any quantity (dots), with the mean in bins of equally many samples (line).

        jk.plot.residuals(fit, over="speed")  # a trend indicates a missing effect in the model

    **Arguments:**

    - `fit`: a `jaxkane.fit.Fit`.
    - `over`: "t" [s]; a channel, as simulated; an input; another coordinate, speed, state or output of the fitted
        trajectory; or a function of a `jaxkane.fit.Trial` that returns samples (n_t,).
    - `channels`, `trials`: all by default; trials by name or number.
    - `bins`: the number of bins of the mean.
    - `axes`: one for each channel.

    **Returns:** the axes (n_channels, 1).

    **Raises:** `ValueError` for a channel or trial that the fit does not have; `KeyError` for another quantity.
    """
    names = list(fit.trial_names)
    chosen = names if trials is None else [names[_number(names, trial)] for trial in trials]
    channels = list(fit.problem.channels) if channels is None else list(as_names(channels, "channels"))
    refuse_unknown(channels, fit.problem.channels, "residuals: the fit has no channel")
    quantity, every = _quantity(fit, over), fit.residuals
    axes = panels(axes, len(channels), size=(6.4, 1.9), sharex=True)
    for ax, channel in zip(axes[:, 0], channels, strict=True):
        rows = [(quantity[name], every[name][channel]) for name in chosen if channel in every[name]]
        x, r = (np.concatenate([row[i] for row in rows]) for i in (0, 1))
        finite = np.isfinite(x) & np.isfinite(r)
        order = np.argsort(x[finite])
        x, r = x[finite][order], r[finite][order]
        ax.axhspan(-2.0, 2.0, color=SOFT, alpha=0.2, linewidth=0)
        ax.plot(x, r, ".", color="C0", markersize=2, alpha=0.6)
        parts = np.array_split(np.arange(len(x)), max(1, min(bins, len(x) // 4)))
        ax.plot([x[i].mean() for i in parts], [r[i].mean() for i in parts], color="C1", linewidth=1.5)
        ax.set_ylabel(f"{label_of(channel)}\n[σ]")
        finish(ax)
    label = over if isinstance(over, str) else getattr(over, "__name__", "")
    axes[-1, 0].set_xlabel("time [s]" if over == "t" else label_of(label))
    return axes


def _quantity(fit: Fit, over: str | Callable[[Any], Any]) -> dict[str, np.ndarray]:
    pairs = list(zip(fit.trial_names, fit.problem.trials, strict=True))
    if not isinstance(over, str):
        return {name: np.broadcast_to(np.asarray(over(trial), float), trial.t.shape) for name, trial in pairs}
    if over == "t":
        return {name: trial.t for name, trial in pairs}
    nothing = {name: np.full(trial.t.shape, np.nan) for name, trial in pairs}
    if over in fit.problem.channels:
        return {name: fit.fitted[name].get(over, nothing[name]) for name, _ in pairs}
    if over in fit.problem.system.inputs:
        return {name: trial.inputs.get(over, 0.0 * trial.t) for name, trial in pairs}
    for (k, first, n), ride in zip(fit.problem.slices, fit.problem.trajectories(fit.point), strict=True):
        name = fit.trial_names[k]
        n = min(n, len(nothing[name]) - first)  # linked windows share a sample
        nothing[name][first : first + n] = np.asarray(ride[over])[:n]
    return nothing


def costs(fit: Fit, *, ax: Axes = None) -> Axes:
    """A heat map of the mean squared residual by trial and channel. It is one if `sigma` and the model are right.

    **Arguments:**

    - `fit`: a `jaxkane.fit.Fit`, also of `validate`.
    - `ax`: the axes, or None for a new figure.

    **Returns:** the axes.
    """
    from matplotlib.colors import LogNorm

    trials, channels = list(fit.trial_names), list(fit.problem.channels)
    tests = fit.tests
    size = np.array([[tests[k][c].rms ** 2 if c in tests[k] else np.nan for c in channels] for k in trials])
    ax = panels(ax, 1, size=(2.4 + 0.9 * len(channels), 1.4 + 0.3 * min(len(trials), 30)))[0, 0]
    largest = float(np.nanmax(np.append(np.abs(np.log10(np.where(size > 0, size, np.nan))), 0.3)))
    shown = ax.imshow(size, norm=LogNorm(10**-largest, 10**largest), cmap="RdBu_r", aspect="auto")
    ax.set_xticks(range(len(channels)), [*map(label_of, channels)], rotation=45, ha="right")
    ax.set_yticks(range(len(trials)), [*map(label_of, trials)])
    for (i, j), value in np.ndenumerate(size):
        if len(trials) <= 30 and np.isfinite(value):
            color = "w" if abs(np.log10(value or 1.0)) > 0.6 * largest else "k"
            ax.text(j, i, f"{value:.2g}", ha="center", va="center", color=color, fontsize="x-small")
    ax.figure.colorbar(shown, ax=ax, label="mean squared residual [σ²]")
    return ax


def estimates(fits: Fit | Mapping[str, Fit], *, start: bool = False, ax: Axes = None) -> Axes:
    """A forest plot: estimates with their 95 % intervals, as differences from the first fit in per cent of its value.

        jk.plot.estimates({"Monday": one, "Tuesday": other})

    **Arguments:**

    - `fits`: one, or several by name. A parameter that is zero in the first fit is drawn in hundredths of its unit.
    - `start`: whether the initial guesses of the first fit are drawn (crosses).
    - `ax`: the axes, or None for a new figure.

    **Returns:** the axes. An estimate whose interval is not finite is drawn without one.
    """
    named = dict(fits) if isinstance(fits, Mapping) else {"estimate, 95 % interval": fits}
    reference: dict[str, float] = {}
    for fit in named.values():
        reference = fit.estimates | reference
    rows = {name: i for i, name in enumerate(reference)}
    ax = panels(ax, 1, size=(8.0, 0.9 + (0.3 + 0.15 * len(named)) * len(rows)))[0, 0]

    def percent(name: str, x: Numbers) -> Any:
        return (x - reference[name]) / (abs(reference[name]) or 1.0) * 100

    for j, (label, fit) in enumerate(named.items()):
        values, shift = fit.estimates, 0.6 * ((j + 0.5) / len(named) - 0.5)
        for i, (name, (low, high)) in enumerate(fit.intervals().items()):
            y, label_once = rows[name] + shift, label_of(label) if i == 0 else None
            if np.isfinite(low) and np.isfinite(high):
                ends = percent(name, np.array([low, high]))
                ax.plot(ends, [y, y], color=f"C{j}", linewidth=3, solid_capstyle="butt", alpha=0.6)
            ax.plot(percent(name, values[name]), y, "o", color=f"C{j}", label=label_once)
            if start and j == 0:
                mark = "start" if i == 0 else None
                ax.plot(percent(name, fit.start[name]), y, "x", color="C3", label=mark)
    ax.axvline(0.0, color=SOFT, linewidth=0.8)
    ax.set_yticks([*rows.values()], [*map(label_of, rows)])
    ax.set(xlabel="difference from the first estimate [%]", ylim=(len(rows) - 0.4, -0.6))
    finish(ax)
    return ax


def profiles(fit: Fit, profiles: Sequence[Any], *, axes: Axes = None) -> np.ndarray:
    """Profile likelihoods (dots), the parabola of the linearized problem (dashed), and their intervals.

    **Arguments:**

    - `fit`: a `jaxkane.fit.Fit`.
    - `profiles`: of its parameters, by `jaxkane.fit.profile`.
    - `axes`: one for each profile.

    **Returns:** the axes (1, n_profiles).
    """
    axes = panels(axes, 1, len(profiles), size=(3.4, 2.6))
    for ax, profile in zip(axes[0], profiles, strict=True):
        ax.plot(profile.values, profile.costs, "o-", markersize=3)
        error = fit.identifiability.given_sigma_errors[fit.names.index(profile.name)]
        parabola = fit.cost + ((profile.values - fit.estimates[profile.name]) / error) ** 2
        ax.plot(profile.values, parabola, "--", color=SOFT)
        for end in profile.interval:
            ax.axvline(end, color="C3", linewidth=1)
        ax.set(xlabel=label_of(profile.name), ylabel=fit.problem.cost_name)
    return axes


def selection_path(selection: Any, *, ax: Axes = None) -> Axes:
    """The cost of a forward selection after each accepted change, fitted and held out, and of the other candidates
    (dots).

    **Arguments:**

    - `selection`: a `jaxkane.fit.ForwardSelection`.
    - `ax`: the axes, or None for a new figure.

    **Returns:** the axes.
    """
    ax = panels(ax, 1, size=(6.4, 3.4))[0, 0]
    changes = [extensions[0] for extensions in selection.rounds if extensions and extensions[0].accepted]
    fitted = [selection.costs[0], *(one.cost for one in changes)]
    held_out = [selection.held_out_costs[0], *(one.held_out_cost for one in changes)]
    for i, extensions in enumerate(selection.rounds):
        others = [one.held_out_cost for one in extensions if not any(one is other for other in changes)]
        label = None if i else "other candidates, held out"
        ax.plot([i + 1] * len(others), others, ".", color=SOFT, label=label)  # NaN without a fit
    ax.plot(fitted, "o-", color="C0", label="fitted")
    if np.isfinite(held_out).any():
        ax.plot(held_out, "s--", color="C1", label="held out")
    ax.set_xticks(range(len(fitted)), ["before", *(label_of(one.name) for one in changes)])
    ax.set(ylabel="sum of squares", yscale="log")
    finish(ax)
    return ax
