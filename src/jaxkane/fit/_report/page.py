"""Pieces of an HTML page that needs no other file. Knows text and figures."""

from __future__ import annotations

import html
from typing import Any

from .._result.tables import table
from .rows import Rows


def wide_table(rows: Rows) -> str:
    """A table whose first row is the head, in a box that scrolls."""
    return f'<div class="wide">{table(rows)}</div>'


def paragraph(words: str) -> str:
    return f"<p>{html.escape(words)}</p>"


def details(summary: str, body: str) -> str:
    return f"<details><summary>{html.escape(summary)}</summary>{body}</details>"


def picture(figure: Any) -> str:
    import io

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    drawing = buffer.getvalue()
    return f"<figure>{drawing[drawing.index('<svg') :]}</figure>"


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
