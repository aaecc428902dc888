"""What a report shows, as a head and rows of text for each table. Knows results; writes nothing."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .._result.identifiability import combination
from .._result.result import Fit
from .._result.text import STATUS, known_values

Rows = list[Sequence[str]]
"""Cells of a table, whose first row is the head."""


def parameter_rows(fit: Fit, truth: Any) -> Rows:
    known, errors, robust = known_values(fit, truth), fit.standard_errors, fit.clustered_errors
    head = ["parameter", "unit", "start", "estimate", "std. error", f"by {fit.clusters[0] or 'trial'}", "95 % interval"]
    rows, intervals = [], fit.intervals()
    for name, unit in zip(fit.names, fit.parameters.units, strict=True):
        low, high = intervals[name]
        row = [name, unit, f"{fit.start[name]:.5g}", f"{fit.estimates[name]:.5g}", f"{errors[name]:.2g}"]
        row += [f"{robust[name]:.2g}", f"{low:.4g} to {high:.4g}"]
        rows.append([*row, *([f"{known[name]:.5g}" if name in known else ""] if known else [])])
    return [[*head, *(["truth"] if known else [])], *rows]


def ending(fit: Fit) -> str:
    name = fit.problem.cost_name
    how = f"by {fit.method} in {len(fit.history) - 1} steps: {STATUS[fit.status]}."
    if fit.problem.model.noise is None:
        size = f"Variance of a residual: {fit.variance:.3g} (one where sigma and the model are right)."
    else:
        size = f"Mean square of the normalized innovations: {fit.innovation:.3g} (one where the noise is right)."
    return f"{name[0].upper()}{name[1:]} {fit.history[0]:.6g} → {fit.cost:.6g} {how} {size}"


def how_sure(fit: Fit) -> str:
    if fit.robust:
        return (
            "Intervals are built on the cluster-robust errors "
            f"(by {fit.clusters[0]}), since the residuals are correlated "
            f"in time (neighbours by {fit.autocorrelation:.2f}); the formal ones take every sample for independent."
        )
    return "Intervals are built on the formal errors, for independent residuals of equal size."


def direction_rows(fit: Fit) -> Rows:
    seen = fit.identifiability
    rows = [
        [f"{s:.4g}", f"{d:.2g}", combination(seen.names, row)]
        for s, d, row in zip(seen.singular_values, seen.deviations, seen.vectors, strict=True)
    ]
    return [("singular value", "deviation", "direction (scaled parameters)"), *rows]


def correlation_rows(fit: Fit) -> Rows:
    rows = [[n, *(f"{c:.3f}" for c in row)] for n, row in zip(fit.names, fit.correlation, strict=True)]
    return [["correlation", *fit.names], *rows]


def channel_rows(fit: Fit) -> Rows:
    rows = []
    for channel, share in fit.variance_accounted_for.items():
        tests = [channels[channel] for channels in fit.tests.values() if channel in channels]
        white, rms = sum(t.is_white for t in tests), np.sqrt(np.nanmean([t.rms**2 for t in tests]))
        row = [channel, f"{100 * share:.1f} %", f"{rms:.2f}", f"{np.nanmean([t.autocorrelation for t in tests]):.2f}"]
        rows.append([*row, f"{white} of {len(tests)}"])
    head = ("channel", "variance accounted for", "rms [σ]", "neighbours' correlation", "trials with white residuals")
    return [head, *rows]


def residual_rows(fit: Fit) -> Rows:
    rows = []
    for name, channels in fit.tests.items():
        for channel, t in channels.items():
            row = [name, channel, str(t.n), f"{100 * t.accounted:.1f} %", f"{t.rms:.2f}", f"{t.mean:+.2f}"]
            rows.append([*row, f"{t.ljung_box:.2g}", f"{t.runs:.2g}"])
    head = ("trial", "channel", "samples", "accounted for", "rms [σ]", "mean [σ]", "p, Ljung-Box", "p, runs")
    return [head, *rows]


def bias_rows(fit: Fit, brief: bool = False) -> Rows:
    names = [f"{kind.split()[0]} of {what}" for kind, what in fit.problem.model.nuisance.trial]
    table = np.array([[values[n] for n in names] for values in fit.nuisance.values()])
    of_all = {"mean of all": table.mean(axis=0), "smallest": table.min(axis=0), "largest": table.max(axis=0)}
    shown = of_all if brief and len(table) > 8 else dict(zip(fit.nuisance, table, strict=True))
    return [["trial", *names], *([name, *(f"{value:.4g}" for value in row)] for name, row in shown.items())]


def settings_of(fit: Fit) -> Iterable[tuple[str, str]]:
    problem, s = fit.problem, fit.problem.model.settings
    steps = np.asarray(problem.windows.step)
    fixed = f"rtol {s.rtol:g}"
    if s.step is not None:
        fixed = f"steps of {steps.min():.3g} to {steps.max():.3g} s, halved: {fit.step_error:.2g} standard deviations"
    yield "simulation", f"{type(s.solver).__name__}, {fixed}"
    lengths = np.asarray(problem.windows.t[:, -1] - problem.windows.t[:, 0])
    kind = "chained" if problem.model.nuisance.chained else "with free starts"
    yield "windows", f"{len(lengths)} of {lengths.min():.3g} to {lengths.max():.3g} s, {kind}"
    yield "unknown at their starts", ", ".join(problem.model.nuisance.start) or "nothing"
    yield "measured", ", ".join(problem.channels)
    yield "method", fit.method
    packages = ("jaxkane", "jax", "diffrax", "equinox", "numpy")
    yield "versions", ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    yield "machine", f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    yield "written", datetime.datetime.now().astimezone().isoformat(timespec="minutes")
