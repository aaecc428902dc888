"""A fit told: as a text, and as one HTML page with pictures that needs nothing else. Knows results; computes none."""

from __future__ import annotations

import datetime
import html
import importlib.metadata
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._uncertainty import CrossValidation, Profile, cross_validate

if TYPE_CHECKING:
    from ._result import Fit

Row = Sequence[str]


def text(fit: Fit, truth: Any = None) -> str:
    """All that is known about a fit, without pictures."""
    parts = [
        fit.title,
        _plain(*_parameters(fit, truth)),
        _ending(fit),
        str(fit.identifiability).split("\n" + fit.identifiability.messages[0])[0]
        if fit.identifiability.messages
        else str(fit.identifiability),
        _plain(*_correlations(fit)),
        _plain(*_channels(fit)),
        *([_plain(*_biases(fit, brief=True))] if fit.problem.model.nuisance.trial else []),
        "\n".join(f"- {note}" for note in fit.notes) or "Nothing to remark.",
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
    trials: int | None = 6,
    title: str | None = None,
) -> Path:
    """Write a fit as one HTML page that needs no other file: tables, pictures, and what a reader should know.

    **Arguments:**

    - `path`: of the page. `title`: its heading, by default the system's name.
    - `truth`: parameters by name, or a system, where they are known.
    - `cross_validation`: what `cross_validate` gave, or True to do it now. `profiles`: what `profile` gave.
    - `trials`: how many are drawn, from the first to the last; None for all.

    **Returns:** the path.
    """
    if cross_validation is True:
        cross_validation = cross_validate(fit)
    title = title or f"Identification of {type(fit.problem.system).__name__}"
    sections = [
        ("", _paragraph(fit.title) + _paragraph(_ending(fit)) + _notes(fit)),
        ("Parameters", _table(*_parameters(fit, truth)) + _paragraph(_how_sure(fit)) + _picture(_draw_estimates(fit))),
        ("What the data tell", _table(*_directions(fit)) + _picture(_draw_correlation(fit))),
        ("Way down", _picture(_draw_history(fit))),
        ("Measured and fitted", _table(*_channels(fit)) + "".join(map(_picture, _draw_trials(fit, trials)))),
        ("Residuals", _picture(_draw_residuals(fit)) + _details("Every trial", _table(*_tests(fit)))),
    ]
    if fit.problem.model.nuisance.trial:
        sections.append(("Unknowns of the trials", _details("Every trial", _table(*_biases(fit)))))
    if profiles:
        sections.append(("Profiles of the likelihood", _picture(_draw_profiles(fit, profiles))))
    if cross_validation:
        rows = [line.rsplit(maxsplit=4) for line in str(cross_validation).splitlines()[1:-1]]
        head = ("trial left out", "residuals", "start", "fitted", "held out")
        said = f"Held-out score: {100 * cross_validation.score:.1f} % of the start's sum of squares is taken away."
        sections.append(("Trials left out", _paragraph(said) + _details("Every trial", _table(head, rows))))
    sections.append(("Settings", _table(("", ""), list(_settings(fit)))))
    body = "\n".join(f"<h2>{html.escape(head)}</h2>\n{part}" if head else part for head, part in sections)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_PAGE.format(title=html.escape(title), body=body), encoding="utf-8")
    return path


# What is told: a heading and rows of text for each table.


def _parameters(fit: Fit, truth: Any) -> tuple[Row, Sequence[Row]]:
    from ._result import known_values

    known, errors, robust = known_values(fit, truth), fit.standard_errors, fit.clustered_errors
    head = ["parameter", "unit", "start", "estimate", "std. error", "by trial", "95 % interval"]
    rows = []
    for name, unit in zip(fit.names, fit.parameters.units, strict=True):
        low, high = fit.intervals()[name]
        row = [name, unit, f"{fit.start[name]:.5g}", f"{fit.estimates[name]:.5g}", f"{errors[name]:.2g}"]
        row += [f"{robust[name]:.2g}", f"{low:.4g} to {high:.4g}"]
        rows.append([*row, *([f"{known[name]:.5g}" if name in known else ""] if known else [])])
    return [*head, *(["truth"] if known else [])], rows


def _ending(fit: Fit) -> str:
    from ._result import STATUS

    return (
        f"Sum of squares {fit.history[0]:.6g} → {fit.cost:.6g} by {fit.method} in {len(fit.history) - 1} steps: "
        f"{STATUS[fit.status]}. Variance of a residual: {fit.variance:.3g} (one where sigma and the model are right)."
    )


def _how_sure(fit: Fit) -> str:
    if fit.robust:
        return (
            "Intervals are built on the errors by trial (clustered), since the residuals are correlated in time "
            f"(neighbours by {fit.autocorrelation:.2f}); the formal ones take every sample for independent."
        )
    return "Intervals are built on the formal errors, for independent residuals of equal size."


def _directions(fit: Fit) -> tuple[Row, Sequence[Row]]:
    from ._identifiability import combination

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
    fixed = f"steps of {steps.min():.3g} to {steps.max():.3g} s" if s.step is not None else f"rtol {s.rtol:g}"
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
    if not fit.notes:
        return _paragraph("Every parameter is determined, and nothing looks suspicious.")
    return '<ul class="notes">' + "".join(f"<li>{html.escape(note)}</li>" for note in fit.notes) + "</ul>"


def _details(summary: str, body: str) -> str:
    return f"<details><summary>{html.escape(summary)}</summary>{body}</details>"


def _picture(figure: Any) -> str:
    import io

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    drawing = buffer.getvalue()
    return f"<figure>{drawing[drawing.index('<svg') :]}</figure>"


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _draw_estimates(fit: Fit) -> Any:
    figure = _figure(8, 0.9 + 0.45 * len(fit.names))
    ax = figure.subplots()
    for i, name in enumerate(fit.names):
        scale = abs(fit.estimates[name]) or 1.0
        low, high = ((x - fit.estimates[name]) / scale * 100 for x in fit.intervals()[name])
        start = (fit.start[name] - fit.estimates[name]) / scale * 100
        if np.isfinite(low) and np.isfinite(high):
            ax.plot([low, high], [i, i], color="C0", linewidth=3, solid_capstyle="butt")
        ax.plot(0, i, "o", color="C0", label="estimate, 95 % interval" if i == 0 else None)
        ax.plot(start, i, "x", color="C3", label="start" if i == 0 else None)
    ax.set(yticks=range(len(fit.names)), yticklabels=fit.names, xlabel="difference from the estimate [%]")
    ax.set_ylim(len(fit.names) - 0.4, -0.6)
    ax.grid(alpha=0.3, axis="x")
    figure.legend(frameon=False, fontsize="small", loc="outside upper right", ncols=2)
    return figure


def _draw_correlation(fit: Fit) -> Any:
    p = len(fit.names)
    figure = _figure(3.4 + 0.55 * p, 1.8 + 0.5 * p)
    ax = figure.subplots()
    shown = ax.imshow(fit.correlation, vmin=-1, vmax=1, cmap="RdBu_r")
    ax.set_xticks(range(p), fit.names, rotation=45, ha="right")
    ax.set_yticks(range(p), fit.names)
    for i in range(p):
        for j in range(p):
            c = fit.correlation[i, j]
            ax.text(j, i, f"{c:.2f}", ha="center", va="center", color="w" if abs(c) > 0.6 else "k", fontsize="x-small")
    figure.colorbar(shown, ax=ax, label="correlation", shrink=0.8)
    return figure


def _draw_history(fit: Fit) -> Any:
    figure = _figure(6, 2.4)
    ax = figure.subplots()
    ax.semilogy(fit.history, "o-", markersize=3)
    n_r, n_unknown = fit.problem.size
    ax.axhline(n_r - n_unknown, color="0.6", linestyle="--", linewidth=1)
    ax.annotate("sigma alone", (0, n_r - n_unknown), color="0.4", va="bottom", fontsize="small")
    ax.set(xlabel="step", ylabel="sum of squares")
    ax.grid(alpha=0.3)
    return figure


def _draw_trials(fit: Fit, number: int | None) -> list[Any]:
    from .. import plot

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


def _draw_residuals(fit: Fit) -> Any:
    from ._residual_tests import autocorrelations

    channels = fit.problem.channels
    figure = _figure(9, 1.9 * len(channels))
    axes = figure.subplots(len(channels), 2, squeeze=False, width_ratios=(1, 1.4))
    grid = np.linspace(-4, 4, 200)
    for (left, right), channel in zip(axes, channels, strict=True):
        every = [r[channel] for r in fit.residuals.values() if channel in r]
        flat = np.concatenate(every)
        left.hist(np.clip(flat[np.isfinite(flat)], -4, 4), bins=41, range=(-4, 4), density=True, color="C0", alpha=0.6)
        left.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color="C1", linewidth=1)
        left.set_ylabel(channel.replace("_", "\n"))
        lags = max(2, min(25, min(len(r) for r in every) // 3))
        mean = np.mean([autocorrelations(r, lags) for r in every], axis=0)
        right.bar(np.arange(1, lags + 1), mean, width=0.7)
        limit = 1.96 / np.sqrt(max(np.isfinite(flat).sum(), 1))
        right.axhspan(-limit, limit, color="C1", alpha=0.3, linewidth=0)
        right.set_ylim(min(-0.3, 1.1 * mean.min()), 1)
    axes[-1, 0].set_xlabel("residual [σ]; line: what sigma says")
    axes[-1, 1].set_xlabel("lag [samples]; autocorrelation, band: noise")
    return figure


def _draw_profiles(fit: Fit, profiles: Sequence[Profile]) -> Any:
    figure = _figure(3.4 * min(3, len(profiles)), 2.6 * (1 + (len(profiles) - 1) // 3))
    axes = figure.subplots(1 + (len(profiles) - 1) // 3, min(3, len(profiles)), squeeze=False).ravel()
    for ax, profile in zip(axes, profiles, strict=False):
        ax.plot(profile.values, profile.costs, "o-", markersize=3)
        error, best = fit.standard_errors[profile.name], fit.estimates[profile.name]
        ax.plot(profile.values, fit.cost + fit.variance * ((profile.values - best) / error) ** 2, "--", color="0.6")
        for end in profile.interval:
            ax.axvline(end, color="C3", linewidth=1)
        ax.set(xlabel=profile.name, ylabel="sum of squares")
    for ax in axes[len(profiles) :]:
        ax.remove()
    return figure


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
