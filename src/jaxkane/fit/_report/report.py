"""A fit as a text, and as one HTML page with pictures that needs nothing else. Knows results and what can be asked."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..._description.system import System
from .._analysis.held_back import CrossValidation, cross_validate
from .._analysis.profile import Profile
from .._analysis.signs import contrary_signs
from .._analysis.suspected import Suspects
from .._problem.arguments import refuse_other
from .._result.result import Fit
from .._result.tables import plain
from . import pictures
from .page import PAGE, details, paragraph, picture, wide_table
from .rows import (
    bias_rows,
    channel_rows,
    correlation_rows,
    direction_rows,
    ending,
    how_sure,
    parameter_rows,
    residual_rows,
    settings_of,
)


def report(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """All that is known about a fit, as a text: estimates, intervals, directions, residuals, notes.

    `truth`: parameters by name, or a system, where they are known. Where a channel fits badly, `contrary_signs` is
    asked, which makes a few steps of a fit with each sign turned round.
    """
    parts = [
        fit.title,
        plain(parameter_rows(fit, truth)),
        ending(fit),
        fit.identifiability.table,
        plain(correlation_rows(fit)),
        plain(channel_rows(fit)),
        *([plain(bias_rows(fit, brief=True))] if fit.problem.model.nuisance.trial else []),
        "\n".join(f"- {note}" for note in _all_notes(fit)) or "Nothing to remark.",
        "; ".join(f"{key}: {value}" for key, value in settings_of(fit)),
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
    title = title or f"Identification of {type(fit.problem.system).__name__}"
    sections = _sections(fit, truth, cross_validation, profiles, suspects, trials)
    body = "\n".join(f"<h2>{html.escape(head)}</h2>\n{part}" if head else part for head, part in sections)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(PAGE.format(title=html.escape(title), body=body), encoding="utf-8")
    return path


def _sections(
    fit: Fit,
    truth: Mapping[str, float] | Any,
    cross_validation: CrossValidation | bool,
    profiles: Sequence[Profile],
    suspects: Suspects | None,
    trials: int | None,
) -> list[tuple[str, str]]:
    """Headings and what stands under them."""
    if cross_validation is True:
        cross_validation = cross_validate(fit)
    sections = [
        ("", paragraph(fit.title) + paragraph(ending(fit)) + _notes(fit)),
        (
            "Parameters",
            wide_table(parameter_rows(fit, truth)) + paragraph(how_sure(fit)) + picture(pictures.draw_estimates(fit)),
        ),
        ("What the data determine", wide_table(direction_rows(fit)) + picture(pictures.draw_correlation(fit))),
        ("Descent of the cost", picture(pictures.draw_history(fit))),
        (
            "Measured and fitted",
            wide_table(channel_rows(fit)) + "".join(map(picture, pictures.draw_trials(fit, trials))),
        ),
        ("Residuals", picture(pictures.draw_residuals(fit)) + details("Every trial", wide_table(residual_rows(fit)))),
    ]
    if fit.problem.model.nuisance.trial:
        sections.append(("Unknowns of the trials", details("Every trial", wide_table(bias_rows(fit)))))
    if profiles:
        sections.append(("Profiles of the likelihood", picture(pictures.draw_profiles(fit, profiles))))
    if cross_validation:
        refuse_other(
            cross_validation, CrossValidation, "`cross_validation=`", "save_report(fit, path, cross_validation=True)"
        )
        rows = [line.rsplit(maxsplit=5) for line in str(cross_validation).splitlines()[1:-1]]
        head = ("trial left out", "residuals", "spread", "start", "fitted", "held out")
        verdict = cross_validation.verdict[0].upper() + cross_validation.verdict[1:]
        sections.append(("Trials left out", paragraph(verdict) + details("Every trial", wide_table([head, *rows]))))
    if suspects:
        refuse_other(suspects, Suspects, "`suspects=`", "save_report(fit, path, suspects=suspects(fit, candidates))")
        sections.append(("What may be missing", f'<div class="wide">{suspects._repr_html_()}</div>'))
    sections.append(("Settings", wide_table([("", ""), *settings_of(fit)])))
    return sections


def _all_notes(fit: Fit) -> tuple[str, ...]:
    return (*fit.notes, *contrary_signs(fit))


def _notes(fit: Fit) -> str:
    notes = _all_notes(fit)
    if not notes:
        return paragraph("Every parameter is determined, and nothing looks suspicious.")
    return '<ul class="notes">' + "".join(f"<li>{html.escape(note)}</li>" for note in notes) + "</ul>"
