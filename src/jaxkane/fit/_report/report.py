"""A fit as a text, and as one HTML page with pictures that needs nothing else. Knows results and what can be asked."""

from __future__ import annotations

import datetime
import html
import importlib.metadata
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._description.system import System
from .._analysis.held_back import CrossValidation, cross_validate
from .._analysis.profile import Profile
from .._analysis.signs import contrary_signs
from .._analysis.suspected import Suspects
from .._problem.arguments import refuse_other
from .._result.identifiability import combination
from .._result.result import Fit
from .._result.text import STATUS, known_values
from . import pictures

Row = Sequence[str]


def report(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """All that is known about a fit, as a text: estimates, intervals, directions, residuals, notes.

    `truth`: parameters by name, or a system, where they are known. Where a channel fits badly, `contrary_signs` is
    asked, which makes a few steps of a fit with each sign turned round.
    """
    parts = [
        fit.title,
        _plain(*_parameters(fit, truth)),
        _ending(fit),
        fit.identifiability.table,
        _plain(*_correlations(fit)),
        _plain(*_channels(fit)),
        *([_plain(*_biases(fit, brief=True))] if fit.problem.model.nuisance.trial else []),
        "\n".join(f"- {note}" for note in _all_notes(fit)) or "Nothing to remark.",
        "; ".join(f"{key}: {value}" for key, value in _settings(fit)),
    ]
    return "\n\n".join(parts)


def save_report(
    fit: Fit,
    path: str | os.PathLike[str],
    *,
    truth: Mapping[str, float] | Any = None,
    cross_validation: CrossValidation | bool = False,
    profiles: Sequence[Profile] = (),
    suspects: Suspects | None = None,
    trials: int | None = 6,
    title: str | None = None,
) -> Path:
    """Write a fit as one HTML page that needs no other file: tables, pictures, and what a reader should know.

    **Arguments:**

    - `path`: of the page. `title`: its heading, by default the system's name.
    - `truth`: parameters by name, or a system, where they are known.
    - `cross_validation`: what `cross_validate` gave, or True to do it now. `profiles`: what `profile` gave.
    - `suspects`: what `suspects` gave, of this fit or of the one before it.
    - `trials`: how many are drawn, from the first to the last; None for all.

    **Returns:** the path.
    """
    refuse_other(fit, Fit, "save_report", 'save_report(fit(...), "fit.html")')
    if cross_validation is True:
        cross_validation = cross_validate(fit)
    title = title or f"Identification of {type(fit.problem.system).__name__}"
    sections = [
        ("", _paragraph(fit.title) + _paragraph(_ending(fit)) + _notes(fit)),
        (
            "Parameters",
            _table(*_parameters(fit, truth)) + _paragraph(_how_sure(fit)) + _picture(pictures.draw_estimates(fit)),
        ),
        ("What the data determine", _table(*_directions(fit)) + _picture(pictures.draw_correlation(fit))),
        ("Way down", _picture(pictures.draw_history(fit))),
        ("Measured and fitted", _table(*_channels(fit)) + "".join(map(_picture, pictures.draw_trials(fit, trials)))),
        ("Residuals", _picture(pictures.draw_residuals(fit)) + _details("Every trial", _table(*_tests(fit)))),
    ]
    if fit.problem.model.nuisance.trial:
        sections.append(("Unknowns of the trials", _details("Every trial", _table(*_biases(fit)))))
    if profiles:
        sections.append(("Profiles of the likelihood", _picture(pictures.draw_profiles(fit, profiles))))
    if cross_validation:
        rows = [line.rsplit(maxsplit=4) for line in str(cross_validation).splitlines()[1:-1]]
        head = ("trial left out", "residuals", "start", "fitted", "held out")
        said = cross_validation.verdict[0].upper() + cross_validation.verdict[1:]
        sections.append(("Trials left out", _paragraph(said) + _details("Every trial", _table(head, rows))))
    if suspects:
        refuse_other(suspects, Suspects, "`suspects=`", "save_report(fit, path, suspects=suspects(fit, candidates))")
        sections.append(("What may be missing", f'<div class="wide">{suspects._repr_html_()}</div>'))
    sections.append(("Settings", _table(("", ""), list(_settings(fit)))))
    body = "\n".join(f"<h2>{html.escape(head)}</h2>\n{part}" if head else part for head, part in sections)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_PAGE.format(title=html.escape(title), body=body), encoding="utf-8")
    return path


def _all_notes(fit: Fit) -> tuple[str, ...]:
    return (*fit.notes, *contrary_signs(fit))


# What is shown: a heading and rows of text for each table.


def _parameters(fit: Fit, truth: Any) -> tuple[Row, Sequence[Row]]:
    known, errors, robust = known_values(fit, truth), fit.standard_errors, fit.clustered_errors
    head = ["parameter", "unit", "start", "estimate", "std. error", f"by {fit.clusters[0] or 'trial'}", "95 % interval"]
    rows, intervals = [], fit.intervals()
    for name, unit in zip(fit.names, fit.parameters.units, strict=True):
        low, high = intervals[name]
        row = [name, unit, f"{fit.start[name]:.5g}", f"{fit.estimates[name]:.5g}", f"{errors[name]:.2g}"]
        row += [f"{robust[name]:.2g}", f"{low:.4g} to {high:.4g}"]
        rows.append([*row, *([f"{known[name]:.5g}" if name in known else ""] if known else [])])
    return [*head, *(["truth"] if known else [])], rows


def _ending(fit: Fit) -> str:
    name = fit.problem.cost_name
    how = f"by {fit.method} in {len(fit.history) - 1} steps: {STATUS[fit.status]}."
    if fit.problem.model.noise is None:
        size = f"Variance of a residual: {fit.variance:.3g} (one where sigma and the model are right)."
    else:
        size = f"Mean square of the normalized innovations: {fit.innovation:.3g} (one where the noise is right)."
    return f"{name[0].upper()}{name[1:]} {fit.history[0]:.6g} → {fit.cost:.6g} {how} {size}"


def _how_sure(fit: Fit) -> str:
    if fit.robust:
        return (
            "Intervals are built on the cluster-robust errors "
            f"(by {fit.clusters[0]}), since the residuals are correlated "
            f"in time (neighbours by {fit.autocorrelation:.2f}); the formal ones take every sample for independent."
        )
    return "Intervals are built on the formal errors, for independent residuals of equal size."


def _directions(fit: Fit) -> tuple[Row, Sequence[Row]]:
    seen = fit.identifiability
    rows = [
        [f"{s:.4g}", f"{d:.2g}", combination(seen.names, row)]
        for s, d, row in zip(seen.singular_values, seen.deviations, seen.vectors, strict=True)
    ]
    return ("singular value", "deviation", "direction (scaled parameters)"), rows


def _correlations(fit: Fit) -> tuple[Row, Sequence[Row]]:
    rows = [[n, *(f"{c:.3f}" for c in row)] for n, row in zip(fit.names, fit.correlation, strict=True)]
    return ["correlation", *fit.names], rows


def _channels(fit: Fit) -> tuple[Row, Sequence[Row]]:
    rows = []
    for channel, share in fit.variance_accounted_for.items():
        tests = [channels[channel] for channels in fit.tests.values() if channel in channels]
        white, rms = sum(t.is_white for t in tests), np.sqrt(np.nanmean([t.rms**2 for t in tests]))
        row = [channel, f"{100 * share:.1f} %", f"{rms:.2f}", f"{np.nanmean([t.autocorrelation for t in tests]):.2f}"]
        rows.append([*row, f"{white} of {len(tests)}"])
    return (
        "channel",
        "variance accounted for",
        "rms [σ]",
        "neighbours' correlation",
        "trials with white residuals",
    ), rows


def _tests(fit: Fit) -> tuple[Row, Sequence[Row]]:
    rows = []
    for name, channels in fit.tests.items():
        for channel, t in channels.items():
            row = [name, channel, str(t.n), f"{100 * t.accounted:.1f} %", f"{t.rms:.2f}", f"{t.mean:+.2f}"]
            rows.append([*row, f"{t.ljung_box:.2g}", f"{t.runs:.2g}"])
    head = ("trial", "channel", "samples", "accounted for", "rms [σ]", "mean [σ]", "p, Ljung-Box", "p, runs")
    return head, rows


def _biases(fit: Fit, brief: bool = False) -> tuple[Row, Sequence[Row]]:
    names = [f"{kind.split()[0]} of {what}" for kind, what in fit.problem.model.nuisance.trial]
    table = np.array([[values[n] for n in names] for values in fit.nuisance.values()])
    of_all = {"mean of all": table.mean(axis=0), "smallest": table.min(axis=0), "largest": table.max(axis=0)}
    shown = of_all if brief and len(table) > 8 else dict(zip(fit.nuisance, table, strict=True))
    return ["trial", *names], [[name, *(f"{value:.4g}" for value in row)] for name, row in shown.items()]


def _settings(fit: Fit) -> Iterable[tuple[str, str]]:
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


def _plain(head: Row, rows: Sequence[Row]) -> str:
    widths = [max(len(str(row[i])) for row in (head, *rows)) for i in range(len(head))]
    line = lambda row: "  ".join(  # noqa: E731
        str(cell).ljust(w) if i == 0 else str(cell).rjust(w)
        for i, (cell, w) in enumerate(zip(row, widths, strict=True))
    )
    return "\n".join(line(row).rstrip() for row in (head, *rows))


# How it is written.


def _table(head: Row, rows: Sequence[Row]) -> str:
    line = lambda cells, tag: "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in cells)  # noqa: E731
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{line(head, "th")}</tr>{body}</table></div>'


def _paragraph(words: str) -> str:
    return f"<p>{html.escape(words)}</p>"


def _notes(fit: Fit) -> str:
    notes = _all_notes(fit)
    if not notes:
        return _paragraph("Every parameter is determined, and nothing looks suspicious.")
    return '<ul class="notes">' + "".join(f"<li>{html.escape(note)}</li>" for note in notes) + "</ul>"


def _details(summary: str, body: str) -> str:
    return f"<details><summary>{html.escape(summary)}</summary>{body}</details>"


def _picture(figure: Any) -> str:
    import io

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    drawing = buffer.getvalue()
    return f"<figure>{drawing[drawing.index('<svg') :]}</figure>"


_PAGE = """<!DOCTYPE html>
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
