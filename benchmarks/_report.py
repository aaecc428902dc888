"""The table of the figures: in Markdown for readers, in JSON for the next run and for the picture."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Mapping
from pathlib import Path

from ._figures import Figure

TITLES = {
    "right_hand_side": "One evaluation of the right-hand side",
    "assemblies": "Bicycles with parts",
    "exported": "The right-hand side as exported C",
    "rides": "Rides of 5 s",
    "sensitivities": "Derivatives of a ride",
    "first_calls": "First calls: trace, compile and run in a fresh process",
    "contacts": "First calls with contacts, in first calls of the bicycle without",
    "from_description": "From the description to the first trajectory",
    "chains": "Three-dimensional chains of n links",
    "gpu": "On a GPU",
    "million": "A million bicycles",
    "walkers": "Walkers: 20 steps, and families of gaits",
    "eigenvalues": "Eigenvalues of ten thousand bicycles",
    "identification": "Identification",
    "swing_up": "Optimal control: a double pendulum swung up",
    "opti": "Optimal control: a bar on a cart, against CasADi's Opti",
}


@dataclasses.dataclass
class Results:
    """Everything measured so far: figures, or the words of a script, by part; what was missing; the machine."""

    machine: dict[str, str]
    missing: dict[str, str]
    figures: dict[str, list[Figure]] = dataclasses.field(default_factory=dict)
    words: dict[str, str] = dataclasses.field(default_factory=dict)

    def write(self, path: Path) -> None:
        kept = dataclasses.asdict(self)
        path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path, machine: dict[str, str], missing: dict[str, str]) -> Results:
        """Those of an earlier run on the same machine with the same versions, to which parts can be added."""
        results = cls(machine, missing)
        kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if kept.get("machine") == machine:
            results.figures = {part: [Figure(**f) for f in figures] for part, figures in kept["figures"].items()}
            results.words = kept["words"]
        return results


def markdown(results: Results) -> str:
    lines = ["# Figures", "", "Made by `python -m benchmarks`; do not edit.", ""]
    lines.append(f"- written: {datetime.date.today()}")
    lines += [f"- {what}: {told}" for what, told in results.machine.items()]
    lines += [f"- not installed, and left out: {name} ({how})" for name, how in results.missing.items()]
    lines += ["", _PREFACE, ""]
    for part, title in TITLES.items():
        if results.figures.get(part):
            lines += [f"## {title}", "", *_table(results.figures[part]), ""]
        elif results.words.get(part):
            lines += [f"## {title}", "", "```text", results.words[part].strip(), "```", ""]
    return "\n".join(lines)


_PREFACE = """\
Float64, one thread unless said. Ratios are taken within one process, in which both sides run in turns; the best time of
each counts. `XLA` is jaxkane with native kernels switched off, `native` with them."""


def _table(figures: list[Figure]) -> list[str]:
    rows: dict[str, dict[str, Figure]] = {}
    for figure in sorted(figures, key=lambda f: f.target != ""):  # times first, then ratios; what has a target last
        rows.setdefault(figure.what, {})[figure.column] = figure
    if all(set(row) == {""} for row in rows.values()):
        return ["| measure | |", "|---|---|", *(f"| {what} | {row['']} |" for what, row in rows.items())]
    lines = ["| measure | XLA | target | native | target |", "|---|---|---|---|---|"]
    for what, row in rows.items():
        cells = [cell for column in ("XLA", "native") for cell in _cells(row.get(column) or row.get(""))]
        lines.append(f"| {what} | {' | '.join(cells)} |")
    return lines


def _cells(figure: Figure | None) -> tuple[str, str]:
    if figure is None:
        return "", ""
    verdict: Mapping[bool | None, str] = {True: "met", False: "**missed**", None: ""}
    return str(figure), f"{figure.target}: {verdict[figure.met]}" if figure.target else ""
