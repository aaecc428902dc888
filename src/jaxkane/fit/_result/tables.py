"""Rows of text as columns, and as HTML. Knows strings only."""

from __future__ import annotations

import html
from collections.abc import Sequence


def plain(rows: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Rows of text, of which the first is the head, in columns; those named stand to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    place = lambda i, cell: cell.ljust(widths[i]) if i in left else cell.rjust(widths[i])  # noqa: E731
    return "\n".join("  ".join(place(i, cell) for i, cell in enumerate(row)).rstrip() for row in rows)


def table(rows: Sequence[Sequence[str]]) -> str:
    """The same as HTML."""
    line = lambda cells, tag: "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells)  # noqa: E731
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows[1:])
    return f"<table><tr>{line(rows[0], 'th')}</tr>{body}</table>"
