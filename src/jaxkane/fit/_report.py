"""A fit as a text, and as one HTML page with pictures that needs nothing else, from the same sections."""

from __future__ import annotations

import dataclasses
import datetime
import html
import importlib.metadata
import io
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._common.lookup import label_of
from .._system.system import System
from ._diagnostics import STATUS
from ._extensions import ForwardSelection
from ._problem import refuse_other
from ._result import Fit, costs_in_words, parameter_rows
from ._statistics import autocorrelations
from ._studies import Profile, check_signs
from ._tables import Rows, html_table, text_table
from ._validate import CrossValidation, cross_validate


def report(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """All that is known about a fit, as a text: estimates, intervals, directions, residuals, notes.

    `truth`: parameters by name, or a system, where they are known. Where a channel fits badly, `check_signs` makes a
    few steps of a fit with each sign turned round.
    """
    return "\n\n".join(filter(None, (section.text for section in _sections(fit, truth))))


def save_report(
    fit: Fit,
    path: str | os.PathLike[str],
    *,
    truth: Mapping[str, float] | Any = None,
    cross_validation: CrossValidation | bool = False,
    profiles: Sequence[Profile] = (),
    forward_selection: ForwardSelection | None = None,
    trials: int | None = 6,
    title: str | None = None,
) -> Path:
    """Write a fit as one HTML page that needs no other file: tables, pictures, and what a reader should know.

    **Arguments:**

    - `path`: of the page. `title`: its heading, by default the system's name.
    - `truth`: parameters by name, or a system, where they are known.
    - `cross_validation`: what `cross_validate` gave, or True to do it now. `profiles`: what `profile` gave.
    - `forward_selection`: what `forward_selection` gave, of this fit or of the one before it.
    - `trials`: how many are drawn, from the first to the last; None for all.

    **Returns:** the path.
    """
    refuse_other(fit, Fit, "save_report", 'save_report(fit(...), "fit.html")')
    title = title or f"Identification of {type(fit.problem.system).__name__}"
    more = _sections_of_studies(fit, cross_validation, profiles, forward_selection)
    body = "\n".join(section.html for section in (*_sections(fit, truth, trials), *more))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(PAGE.format(title=html.escape(title), body=body), encoding="utf-8")
    return path


PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; color: #222; }}
h1 {{ font-size: 1.6em; }} h2 {{ font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ddd; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }} .wide {{ overflow-x: auto; }}
th, td {{ padding: .2em .8em; text-align: right; border-bottom: 1px solid #eee; }}
th:first-child, td:first-child {{ text-align: left; }} th {{ color: #555; font-weight: 600; }}
.notes {{ background: #fff8e6; border: 1px solid #f0d890; padding: .6em .6em .6em 2em; border-radius: 6px; }}
figure {{ margin: 1em 0; }} svg {{ max-width: 100%; height: auto; }} summary {{ cursor: pointer; color: #14507a; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


@dataclasses.dataclass(frozen=True)
class _Section:
    """A part of a report. `details`: a long table that the page folds and the text leaves out; `figures`: what draws
    the pictures of the page; `left`: columns of the table that stand to the left."""

    heading: str
    paragraphs: Sequence[str] = ()
    notes: Sequence[str] = ()
    table: Rows = ()
    details: Rows = ()
    figures: Callable[[], Iterable[Any]] = tuple
    left: Sequence[int] = (0,)

    @property
    def text(self) -> str:
        table = [text_table(self.table, self.left)] if self.table else []
        parts = [*self.paragraphs, *(f"- {note}" for note in self.notes), *table]
        return "\n".join([self.heading] * bool(self.heading) + parts) if parts else ""

    @property
    def html(self) -> str:
        wide = lambda rows: f'<div class="wide">{html_table(rows)}</div>' if rows else ""  # noqa: E731
        parts = [f"<h2>{html.escape(self.heading)}</h2>\n"] * bool(self.heading)
        parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in self.paragraphs]
        items = "".join(f"<li>{html.escape(note)}</li>" for note in self.notes)
        parts += [f'<ul class="notes">{items}</ul>'] * bool(items)
        parts += [wide(self.table), *(_picture(figure, self.heading) for figure in self.figures())]
        parts += [f"<details><summary>Every trial</summary>{wide(self.details)}</details>"] * bool(self.details)
        return "".join(parts)


def _sections(fit: Fit, truth: Any = None, trials: int | None = 6) -> Iterator[_Section]:
    notes = (*fit.notes, *check_signs(fit))
    fine = () if notes else ("Every parameter is determined, and nothing looks suspicious.",)
    yield _Section("", (fit.title, _ending(fit), *fine), notes)
    estimates = parameter_rows(fit, truth, detailed=True)
    yield _Section("Parameter estimates", [_errors(fit)], table=estimates, figures=lambda: [_draw_estimates(fit)])
    yield _Section("Identifiability", table=fit.identifiability.rows)
    correlation = [[n, *(f"{c:.3f}" for c in row)] for n, row in zip(fit.names, fit.correlation, strict=True)]
    table = [["correlation", *fit.names], *correlation]
    yield _Section("Correlation matrix", table=table, figures=lambda: [_draw_correlation(fit)])
    yield _Section("Convergence", figures=lambda: [_draw_history(fit)])
    yield _Section("Measured and fitted", figures=lambda: _draw_trials(fit, trials))
    residuals = {"table": _channel_rows(fit), "details": _residual_rows(fit), "figures": lambda: [_draw_residuals(fit)]}
    yield _Section("Residual analysis", **residuals)
    if fit.problem.model.nuisance.trial:
        yield _Section("Biases and gains", table=_bias_rows(fit, brief=True), details=_bias_rows(fit))
    yield _Section("Settings", table=[("setting", "value"), *_settings(fit)], left=(0, 1))


def _sections_of_studies(
    fit: Fit,
    cross_validation: CrossValidation | bool,
    profiles: Sequence[Profile],
    forward_selection: ForwardSelection | None,
) -> Iterator[_Section]:
    if profiles:
        yield _Section("Profile likelihood", figures=lambda: [_draw_profiles(fit, profiles)])
    if cross_validation:
        left_out: Any = cross_validate(fit) if cross_validation is True else cross_validation
        usage = "save_report(fit, path, cross_validation=True)"
        refuse_other(left_out, CrossValidation, "`cross_validation=`", usage)
        conclusion = left_out.conclusion[0].upper() + left_out.conclusion[1:]
        scatter = [(name, f"{low:.5g}", f"{high:.5g}") for name, (low, high) in left_out.intervals().items()]
        of_next = "Where the estimate from the next run would lie, by the scatter from fold to fold (95 %):"
        table = [("parameter", "from", "to"), *scatter]
        yield _Section("Cross validation", [conclusion, of_next], table=table, details=left_out.rows)
    if forward_selection:
        usage = "save_report(fit, path, forward_selection=forward_selection(fit, candidates))"
        refuse_other(forward_selection, ForwardSelection, "`forward_selection=`", usage)
        for heading, rows in forward_selection.tables:
            yield _Section("Model extensions", [heading], table=rows)
        yield _Section("", [forward_selection.conclusion])


def _ending(fit: Fit) -> str:
    name = fit.problem.cost_name
    how = f"by {fit.method} in {len(fit.history) - 1} steps: {STATUS[fit.status]}."
    if fit.problem.model.noise is None:
        size = f"Variance of a residual: {fit.variance:.3g} (one where sigma and the model are right)."
    else:
        nis = fit.mean_normalized_innovation_squared
        size = f"Mean square of the normalized innovations: {nis:.3g} (one where the noise is right)."
    return f"{name[0].upper()}{name[1:]} {costs_in_words(fit, '→')} {how} {size}"


def _errors(fit: Fit) -> str:
    if fit.uses_clustered_errors:
        return (
            f"Intervals are built on the cluster-robust errors (by {fit.clusters[0]}), since the residuals are "
            f"correlated in time (neighbours by {fit.autocorrelation:.2f}); the formal ones take every sample for "
            "independent."
        )
    return "Intervals are built on the formal errors, for independent residuals of equal size."


def _channel_rows(fit: Fit) -> Rows:
    rows = []
    for channel, share in fit.variance_accounted_for.items():
        tests = [channels[channel] for channels in fit.tests.values() if channel in channels]
        white, rms = sum(t.is_white for t in tests), np.sqrt(np.nanmean([t.rms**2 for t in tests]))
        row = [channel, f"{100 * share:.1f} %", f"{rms:.2f}", f"{np.nanmean([t.autocorrelation for t in tests]):.2f}"]
        rows.append([*row, f"{white} of {len(tests)}"])
    head = ("channel", "variance accounted for", "rms [σ]", "neighbours' correlation", "trials with white residuals")
    return [head, *rows]


def _residual_rows(fit: Fit) -> Rows:
    rows = []
    for name, channels in fit.tests.items():
        for channel, t in channels.items():
            row = [name, channel, str(t.n), f"{100 * t.variance_accounted_for:.1f} %", f"{t.rms:.2f}", f"{t.mean:+.2f}"]
            rows.append([*row, f"{t.ljung_box:.2g}", f"{t.runs:.2g}"])
    head = ("trial", "channel", "samples", "accounted for", "rms [σ]", "mean [σ]", "p, Ljung-Box", "p, runs")
    return [head, *rows]


def _bias_rows(fit: Fit, brief: bool = False) -> Rows:
    names = [f"{kind.split()[0]} of {what}" for kind, what in fit.problem.model.nuisance.trial]
    table = np.array([[values[n] for n in names] for values in fit.nuisance.values()])
    of_all = {"mean of all": table.mean(axis=0), "smallest": table.min(axis=0), "largest": table.max(axis=0)}
    shown = of_all if brief and len(table) > 8 else dict(zip(fit.nuisance, table, strict=True))
    return [["trial", *names], *([name, *(f"{value:.4g}" for value in row)] for name, row in shown.items())]


def _settings(fit: Fit) -> Iterator[tuple[str, str]]:
    problem, s = fit.problem, fit.problem.model.settings
    steps = np.asarray(problem.windows.step)
    fixed = f"rtol {s.rtol:g}"
    if s.step is not None:
        fixed = f"steps of {steps.min():.3g} to {steps.max():.3g} s, halved: {fit.step_error:.2g} standard deviations"
    yield "simulation", f"{type(s.solver).__name__}, {fixed}"
    lengths = np.asarray(problem.windows.t[:, -1] - problem.windows.t[:, 0])
    kind = "chained" if problem.model.nuisance.has_defects else "with free starts"
    yield "windows", f"{len(lengths)} of {lengths.min():.3g} to {lengths.max():.3g} s, {kind}"
    yield "unknown at their starts", ", ".join(problem.model.nuisance.start) or "nothing"
    yield "measured", ", ".join(problem.channels)
    yield "method", fit.method
    packages = ("jaxkane", "jax", "diffrax", "equinox", "numpy")
    yield "versions", ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    yield "machine", f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    yield "written", datetime.datetime.now().astimezone().isoformat(timespec="minutes")


def _picture(figure: Any, text: str) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    drawing = buffer.getvalue()
    return f'<figure role="img" aria-label="{html.escape(text)}">{drawing[drawing.index("<svg") :]}</figure>'


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _draw_estimates(fit: Fit) -> Any:
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


def _draw_correlation(fit: Fit) -> Any:
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


def _draw_history(fit: Fit) -> Any:
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


def _draw_trials(fit: Fit, number: int | None) -> Iterator[Any]:
    """Measured and fitted, three trials a figure."""
    from .. import plot  # with matplotlib

    T, rows = len(fit.trial_names), 2 * len(fit.problem.channels)
    chosen = np.unique(np.linspace(0, T - 1, min(T, number or T)).astype(int)).tolist()
    for some in [chosen[i : i + 3] for i in range(0, len(chosen), 3)]:
        figure = _figure(1.0 + 3.2 * len(some), 1.0 * rows)
        heights = [3, 1.2] * len(fit.problem.channels)
        axes = figure.subplots(rows, len(some), sharex="col", sharey="row", squeeze=False, height_ratios=heights)
        plot.fits(fit, some, axes=axes, units=None)
        yield figure


def _draw_residuals(fit: Fit) -> Any:
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


def _draw_profiles(fit: Fit, profiles: Sequence[Profile]) -> Any:
    """Profile likelihoods, beside the parabola of the linearization."""
    figure = _figure(3.4 * min(3, len(profiles)), 2.6 * (1 + (len(profiles) - 1) // 3))
    axes = figure.subplots(1 + (len(profiles) - 1) // 3, min(3, len(profiles)), squeeze=False).ravel()
    for ax, profile in zip(axes, profiles, strict=False):
        ax.plot(profile.values, profile.costs, "o-", markersize=3)
        error = fit.identifiability.given_sigma_errors[fit.names.index(profile.name)]
        ax.plot(
            profile.values, fit.cost + ((profile.values - fit.estimates[profile.name]) / error) ** 2, "--", color="0.6"
        )
        for end in profile.interval:
            ax.axvline(end, color="C3", linewidth=1)
        ax.set(xlabel=label_of(profile.name), ylabel=fit.problem.cost_name)
    for ax in axes[len(profiles) :]:
        ax.remove()
    return figure
