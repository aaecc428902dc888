"""A fit as text, and as one self-contained HTML page with figures, from the same sections."""

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

from ... import plot  # imports matplotlib at its first call
from ..._common.files import write_file
from ..._common.lookup import label_of
from ..._system.system import System
from ..extend.selection import ForwardSelection
from ..problem.specification import refuse_other
from .data import Rows, costs_in_words, html_table, html_text, parameter_rows, text_table
from .diagnostics import STATUS
from .fit_result import Fit
from .statistics import autocorrelations
from .studies import Profile, check_signs
from .validation import CrossValidation, cross_validate


def report(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """All results of a fit as text: estimates, intervals, directions, residuals, notes.

    If a channel fits badly, `check_signs` runs a few optimizer steps with each sign changed.

    **Arguments:**

    - `fit`: a `Fit`.
    - `truth`: true parameters, by name or as a system.

    **Returns:** the text.
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
    """Write a fit as one self-contained HTML page with tables, figures and notes.

    **Arguments:**

    - `fit`: a `Fit`.
    - `path`: file to write.
    - `title`: heading of the page, by default the name of the system.
    - `truth`: true parameters, by name or as a system.
    - `cross_validation`: result of `cross_validate`, or True to run it now.
    - `profiles`: results of `profile`.
    - `forward_selection`: result of `forward_selection`, for this fit or for the one before it.
    - `trials`: number of trials in the figures, evenly chosen from the first to the last. None for all.

    **Returns:** the path.
    """
    refuse_other(fit, Fit, "save_report", 'save_report(fit(...), "fit.html")')
    title = title or f"Identification of {type(fit.problem.system).__name__}"
    more = _sections_of_studies(fit, cross_validation, profiles, forward_selection)
    body = "\n".join(section.html for section in (*_sections(fit, truth, trials), *more))
    path = Path(path)
    write_file(path, PAGE.format(title=html.escape(title), body=body))
    return path


PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; color: #222; }}
h1 {{ font-size: 1.6em; }} h2 {{ font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ddd; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }} .wide {{ overflow-x: auto; }}
th, td {{ padding: .2em .8em; text-align: right; border-bottom: 1px solid #eee; }}
th {{ color: #555; font-weight: 600; }} code {{ background: #0001; padding: 0 .2em; }}
.notes {{ background: #fff8e6; border: 1px solid #f0d890; padding: .6em .6em .6em 2em; border-radius: 6px; }}
figure {{ margin: 1em 0; }} svg {{ max-width: 100%; height: auto; }} summary {{ cursor: pointer; color: #14507a; }}
@media (max-width: 45em) {{  /* a row becomes a block: the name, then a line for each column */
.stacked th {{ display: none; }} .stacked table, .stacked tbody, .stacked tr {{ display: block; }}
.stacked td {{ display: flex; justify-content: space-between; gap: 1em; border: 0; padding: .1em 0; }}
.stacked td::before {{ content: attr(data-label); color: #555; }} .stacked td:empty {{ display: none; }}
.stacked td:first-child {{ font-weight: 600; border-top: 1px solid #ddd; margin-top: .4em; }}
.stacked td:first-child::before {{ content: none; }} }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


@dataclasses.dataclass(frozen=True)
class _Section:
    """A part of a report.

    - `details`: a long table, which the page folds and the text leaves out.
    - `figures`: functions that draw the figures of the page.
    - `left`: left-aligned columns of the table.
    - `stacked`: whether a narrow page writes the columns of the table below each other instead of scrolling it.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    notes: Sequence[str] = ()
    table: Rows = ()
    details: Rows = ()
    figures: Callable[[], Iterable[Any]] = tuple
    left: Sequence[int] = (0,)
    stacked: bool = False

    @property
    def text(self) -> str:
        table = [text_table(self.table, self.left)] if self.table else []
        parts = [*self.paragraphs, *(f"- {note}" for note in self.notes), *table]
        return "\n".join([self.heading] * bool(self.heading) + parts) if parts else ""

    @property
    def html(self) -> str:
        parts = [f"<h2>{html.escape(self.heading)}</h2>\n"] * bool(self.heading)
        parts += [f"<p>{html_text(paragraph)}</p>" for paragraph in self.paragraphs]
        items = "".join(f"<li>{html_text(note)}</li>" for note in self.notes)
        parts += [f'<ul class="notes">{items}</ul>'] * bool(items)
        if self.table:
            kind = "stacked" if self.stacked else "wide"
            parts.append(f'<div class="{kind}">{html_table(self.table, self.left)}</div>')
        for figure in self.figures():
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg")
            drawing = buffer.getvalue()[buffer.getvalue().index("<svg") :]
            parts.append(f'<figure role="img" aria-label="{html.escape(self.heading)}">{drawing}</figure>')
        if self.details:
            table = f'<div class="wide">{html_table(self.details)}</div>'
            parts.append(f"<details><summary>Every trial</summary>{table}</details>")
        return "".join(parts)


def _sections(
    fit: Fit, truth: Mapping[str, float] | System | None = None, trials: int | None = 6
) -> Iterator[_Section]:
    notes, n_c = (*fit.notes, *check_signs(fit)), len(fit.problem.channels)
    fine = () if notes else ("Every parameter is determined, and nothing looks suspicious.",)
    yield _Section("", (fit.title, _ending(fit), *fine), notes)
    kind = "formal, for independent residuals of equal size"
    if fit.uses_clustered_errors:
        kind = f"cluster-robust, by {fit.clusters[0]}"
    estimates = parameter_rows(fit, truth, detailed=True)
    yield _Section(
        "Parameter estimates",
        [f"Errors and intervals are {kind}, but for those marked otherwise. {fit.scope}".strip()],
        table=estimates,
        figures=lambda: [_drawn(lambda axes: plot.estimates(fit, start=True, ax=axes), 8, 0.9 + 0.45 * len(fit.names))],
        stacked=True,
    )
    yield _Section("Identifiability", table=fit.identifiability.rows)
    correlation = [[n, *(f"{c:.3f}" for c in row)] for n, row in zip(fit.names, fit.correlation, strict=True)]
    table = [["correlation", *fit.names], *correlation]
    yield _Section("Correlation matrix", table=table)
    yield _Section("Measured and fitted", figures=lambda: _draw_trials(fit, trials))
    yield _Section(
        "Residual analysis",
        table=_channel_rows(fit),
        details=_residual_rows(fit),
        figures=lambda: [
            _drawn(lambda axes: _draw_residuals(fit, axes), 9, 1.9 * n_c, n_c, 2, width_ratios=(1, 1.4)),
            _drawn(lambda axes: plot.costs(fit, ax=axes), 2.4 + 0.9 * n_c, 2.1 + 0.3 * min(len(fit.trial_names), 30)),
        ],
        stacked=True,
    )
    if fit.problem.model.nuisance.trial:
        yield _Section("Offsets and gains of each trial", table=_bias_rows(fit, brief=True), details=_bias_rows(fit))
    yield _Section("Settings", table=_settings(fit), left=(0, 1))


def _sections_of_studies(
    fit: Fit,
    cross_validation: CrossValidation | bool,
    profiles: Sequence[Profile],
    forward_selection: ForwardSelection | None,
) -> Iterator[_Section]:
    if profiles:
        n = len(profiles)
        drawn = _drawn(lambda axes: plot.profiles(fit, profiles, axes=axes), 3.4 * n, 2.6, 1, n)
        yield _Section("Profile likelihood", figures=lambda: [drawn])
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
    if (errors := fit.problem.model.errors) is not None:
        size = f"{errors.described(fit.problem.channels)}."
    elif fit.problem.model.noise is None:
        size = f"Variance of a residual: {fit.variance:.3g} (one where sigma and the model are right)."
    else:
        nis = fit.mean_normalized_innovation_squared
        size = f"Mean square of the normalized innovations: {nis:.3g} (one where the noise is right)."
    return f"{name[0].upper()}{name[1:]} {costs_in_words(fit)} {how} {size}"


def _channel_rows(fit: Fit) -> Rows:
    head = ("channel", "variance accounted for", "rms [σ]", "neighbours' correlation", "trials with white residuals")
    rows: list[Sequence[str]] = [head]
    for channel, share in fit.variance_accounted_for.items():
        tests = [channels[channel] for channels in fit.tests.values() if channel in channels]
        rms, neighbours = np.nanmean([t.rms**2 for t in tests]) ** 0.5, np.nanmean([t.autocorrelation for t in tests])
        white = f"{sum(t.is_white for t in tests)} of {len(tests)}"
        rows.append([channel, f"{100 * share:.1f} %", f"{rms:.2f}", f"{neighbours:.2f}", white])
    return rows


def _residual_rows(fit: Fit) -> Rows:
    rows: list[Sequence[str]] = [
        ("trial", "channel", "samples", "accounted for", "rms [σ]", "mean [σ]", "p, Ljung-Box", "p, runs")
    ]
    for name, tests in fit.tests.items():
        for channel, t in tests.items():
            sizes = [f"{100 * t.variance_accounted_for:.1f} %", f"{t.rms:.2f}", f"{t.mean:+.2f}"]
            rows.append([name, channel, str(t.n), *sizes, f"{t.ljung_box:.2g}", f"{t.runs:.2g}"])
    return rows


def _bias_rows(fit: Fit, brief: bool = False) -> Rows:
    names = fit.problem.model.nuisance.trial_names
    table = np.array([[values[n] for n in names] for values in fit.nuisance.values()])
    of_all = {"mean of all": table.mean(axis=0), "smallest": table.min(axis=0), "largest": table.max(axis=0)}
    shown = of_all if brief and len(table) > 8 else dict(zip(fit.nuisance, table, strict=True))
    return [["trial", *names], *([name, *(f"{value:.4g}" for value in row)] for name, row in shown.items())]


def _settings(fit: Fit) -> Rows:
    problem, s = fit.problem, fit.problem.model.settings
    steps = np.asarray(problem.windows.step)
    how = f"steps of {steps.min():.3g} to {steps.max():.3g} s" if s.step is not None else f"rtol {float(s.rtol):g}"
    lengths = np.asarray(problem.windows.t[:, -1] - problem.windows.t[:, 0])
    kind = "chained" if problem.model.nuisance.has_defects else "with free starts"
    packages = ("jaxkane", "jax", "diffrax", "equinox", "numpy")
    return [
        ("setting", "value"),
        ("simulation", f"{type(s.solver).__name__}, {how}, finer: {fit.step_error:.2g} standard deviations"),
        ("windows", f"{len(lengths)} of {lengths.min():.3g} to {lengths.max():.3g} s, {kind}"),
        ("unknown at their starts", ", ".join(problem.model.nuisance.start) or "nothing"),
        ("measured", ", ".join(problem.channels)),
        ("method", fit.method),
        ("versions", ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)),
        ("machine", f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"),
        ("written", datetime.datetime.now().astimezone().isoformat(timespec="minutes")),
    ]


def _drawn(
    draw: Callable[[Any], Any], width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> Any:
    """A figure that is not registered in pyplot. `draw` draws on its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    draw(figure.subplots(rows, columns, squeeze=False, **options))
    return figure


def _draw_trials(fit: Fit, number: int | None) -> Iterator[Any]:
    """Measured and fitted values, three trials per figure."""
    T, n_c = len(fit.trial_names), len(fit.problem.channels)
    chosen = np.unique(np.linspace(0, T - 1, min(T, number or T)).astype(int)).tolist()
    for some in (chosen[i : i + 3] for i in range(0, len(chosen), 3)):
        options = {"sharex": "col", "sharey": "row", "height_ratios": [3, 1.2] * n_c}
        size = 1.0 + 3.2 * len(some), 2.0 * n_c, 2 * n_c, len(some)
        yield _drawn(lambda axes, some=some: plot.fits(fit, some, axes=axes), *size, **options)


def _draw_residuals(fit: Fit, axes: np.ndarray) -> None:
    """By channel, a histogram of the residuals with the normal density, and their autocorrelation."""
    channels, grid = fit.problem.channels, np.linspace(-4, 4, 200)
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
    axes[-1, 0].set_xlabel("residual [σ]; line: white noise with the given sigma")
    axes[-1, 1].set_xlabel("lag [samples]; autocorrelation, band: white noise")
