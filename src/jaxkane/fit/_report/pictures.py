"""Pictures of a report. Knows results and matplotlib, which is imported when something is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..._common.lookup import label_of
from .._analysis.profile import Profile
from .._result.residuals import autocorrelations
from .._result.result import Fit


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def draw_estimates(fit: Fit) -> Any:
    """Estimates with their intervals, and where they started."""
    figure = _figure(8, 0.9 + 0.45 * len(fit.names))
    ax, intervals = figure.subplots(), fit.intervals()
    for i, name in enumerate(fit.names):
        scale = abs(fit.estimates[name]) or 1.0
        low, high = ((x - fit.estimates[name]) / scale * 100 for x in intervals[name])
        start = (fit.start[name] - fit.estimates[name]) / scale * 100
        if np.isfinite(low) and np.isfinite(high):
            ax.plot([low, high], [i, i], color="C0", linewidth=3, solid_capstyle="butt")
        ax.plot(0, i, "o", color="C0", label="estimate, 95 % interval" if i == 0 else None)
        ax.plot(start, i, "x", color="C3", label="start" if i == 0 else None)
    ax.set(
        yticks=range(len(fit.names)), yticklabels=[*map(label_of, fit.names)], xlabel="difference from the estimate [%]"
    )
    ax.set_ylim(len(fit.names) - 0.4, -0.6)
    ax.grid(alpha=0.3, axis="x")
    figure.legend(frameon=False, fontsize="small", loc="outside upper right", ncols=2)
    return figure


def draw_correlation(fit: Fit) -> Any:
    """Correlations of the estimates."""
    p = len(fit.names)
    figure = _figure(3.4 + 0.55 * p, 1.8 + 0.5 * p)
    ax = figure.subplots()
    shown = ax.imshow(fit.correlation, vmin=-1, vmax=1, cmap="RdBu_r")
    names = [*map(label_of, fit.names)]
    ax.set_xticks(range(p), names, rotation=45, ha="right")
    ax.set_yticks(range(p), names)
    for i in range(p):
        for j in range(p):
            c = fit.correlation[i, j]
            ax.text(j, i, f"{c:.2f}", ha="center", va="center", color="w" if abs(c) > 0.6 else "k", fontsize="x-small")
    figure.colorbar(shown, ax=ax, label="correlation", shrink=0.8)
    return figure


def draw_history(fit: Fit) -> Any:
    """The cost by step."""
    figure = _figure(6, 2.4)
    ax = figure.subplots()
    ax.plot(fit.history, "o-", markersize=3)
    ax.set(xlabel="step", ylabel=fit.problem.cost_name)
    if fit.problem.model.noise is None:
        n_r, n_unknown = fit.problem.size
        ax.set_yscale("log")
        ax.axhline(n_r - n_unknown, color="0.6", linestyle="--", linewidth=1)
        ax.annotate("sigma alone", (0, n_r - n_unknown), color="0.4", va="bottom", fontsize="small")
    ax.grid(alpha=0.3)
    return figure


def draw_trials(fit: Fit, number: int | None) -> list[Any]:
    """Measured and fitted, three trials a figure."""
    from ... import plot  # with matplotlib

    T, rows = len(fit.trial_names), 2 * len(fit.problem.channels)
    chosen = np.unique(np.linspace(0, T - 1, min(T, number or T)).astype(int)).tolist()
    figures = []
    for some in [chosen[i : i + 3] for i in range(0, len(chosen), 3)]:
        figure = _figure(1.0 + 3.2 * len(some), 1.0 * rows)
        heights = [3, 1.2] * len(fit.problem.channels)
        axes = figure.subplots(rows, len(some), sharex="col", sharey="row", squeeze=False, height_ratios=heights)
        plot.fits(fit, some, axes=axes, units=None)
        figures.append(figure)
    return figures


def draw_residuals(fit: Fit) -> Any:
    """Histograms and autocorrelations, by channel."""
    channels = fit.problem.channels
    figure = _figure(9, 1.9 * len(channels))
    axes = figure.subplots(len(channels), 2, squeeze=False, width_ratios=(1, 1.4))
    grid = np.linspace(-4, 4, 200)
    for (left, right), channel in zip(axes, channels, strict=True):
        every = [r[channel] for r in fit.residuals.values() if channel in r]
        flat = np.concatenate(every)
        left.hist(np.clip(flat[np.isfinite(flat)], -4, 4), bins=41, range=(-4, 4), density=True, color="C0", alpha=0.6)
        left.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color="C1", linewidth=1)
        left.set_ylabel(label_of(channel).replace("_", "\n"))
        lags = max(2, min(25, min(np.isfinite(r).sum() for r in every) // 3))
        mean = autocorrelations(every, lags)
        right.bar(np.arange(1, lags + 1), mean, width=0.7)
        limit = 1.96 / np.sqrt(max(np.isfinite(flat).sum(), 1))
        right.axhspan(-limit, limit, color="C1", alpha=0.3, linewidth=0)
        right.set_ylim(min(-0.3, 1.1 * mean.min()), 1)
    axes[-1, 0].set_xlabel("residual [σ]; line: what sigma says")
    axes[-1, 1].set_xlabel("lag [samples]; autocorrelation, band: noise")
    return figure


def draw_profiles(fit: Fit, profiles: Sequence[Profile]) -> Any:
    """Profile likelihoods, beside the parabola of the linearization."""
    figure = _figure(3.4 * min(3, len(profiles)), 2.6 * (1 + (len(profiles) - 1) // 3))
    axes = figure.subplots(1 + (len(profiles) - 1) // 3, min(3, len(profiles)), squeeze=False).ravel()
    for ax, profile in zip(axes, profiles, strict=False):
        ax.plot(profile.values, profile.costs, "o-", markersize=3)
        error, best = fit.identifiability.given_errors[fit.names.index(profile.name)], fit.estimates[profile.name]
        ax.plot(profile.values, fit.cost + ((profile.values - best) / error) ** 2, "--", color="0.6")
        for end in profile.interval:
            ax.axvline(end, color="C3", linewidth=1)
        ax.set(xlabel=label_of(profile.name), ylabel=fit.problem.cost_name)
    for ax in axes[len(profiles) :]:
        ax.remove()
    return figure
