"""Measured against simulated. Knows the results of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, hint, label_of, refuse_unknown
from .._description.units import in_degrees, refuse_no_angle, unit_of, units_of
from ._axes import SOFT, finish, panels

_TRIALS = 3


def fits(
    fit: Any,
    trials: Sequence[str | int] | None = None,
    channels: Sequence[str] | None = None,
    *,
    residuals: bool = True,
    degrees: bool = False,
    units: Mapping[str, str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Measured (dots) and simulated (line) by channel and trial; below each, the residuals in standard deviations.

        result = jk.fit.fit(system, trials, ("mass", "damping"))
        jk.plot.fits(result, ["ride 1", "ride 7"], degrees=True)

    **Arguments:**

    - `fit`: a `jaxkane.fit.Fit`.
    - `trials`: names or numbers; by default the first, the middle and the last. `channels`: by default all.
    - `residuals`: whether they are drawn. Their grey band is two standard deviations of the measurement.
    - `degrees`, `units`: as for `trajectories`.
    - `axes`: a row for each channel, or two with residuals; a column for each trial.

    **Returns:** the axes (n_rows, n_trials).

    **Raises:** `ValueError` for a trial or a channel that the fit does not have.
    """
    names = list(fit.trial_names)
    if trials is None:
        chosen = _spread(len(names))
    else:
        chosen = [_number(names, trial) for trial in ([trials] if isinstance(trials, (str, int)) else trials)]
    all_channels = list(fit.problem.channels)
    channels = all_channels if channels is None else list(as_names(channels))
    refuse_unknown(channels, all_channels, "fits: there is no channel")
    if not channels:
        raise ValueError(f"fits: `channels` is empty; {hint([], all_channels)}")
    known = {channel: unit_of(channel, units_of(fit.problem.system) | dict(units or {})) for channel in channels}
    if degrees:
        refuse_no_angle(channels, known.values())
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
            scale, unit = _scale(known[channel], degrees)
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
    raise ValueError(f"fits: there is no trial {trial!r}; {hint(str(trial), names)}")


def _spread(n: int) -> list[int]:
    return np.unique(np.linspace(0, n - 1, min(n, _TRIALS)).astype(int)).tolist()


def _scale(unit: str, degrees: bool) -> tuple[float, str]:
    turns = degrees and in_degrees(unit)
    return (180.0 / np.pi, unit.replace("rad", "deg")) if turns else (1.0, unit)
