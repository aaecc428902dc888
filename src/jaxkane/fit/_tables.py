"""Tables: rows of text, of which the first is the head, as plain text and as HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
Tables = Sequence[tuple[str, Rows]]  # with their headings


def text_table(rows: Rows, left: Sequence[int] = (0,)) -> str:
    """In columns, of which those that are named stand to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    place = lambda i, cell: cell.ljust(widths[i]) if i in left else cell.rjust(widths[i])  # noqa: E731
    return "\n".join("  ".join(place(i, cell) for i, cell in enumerate(row)).rstrip() for row in rows)


def html_table(rows: Rows) -> str:
    line = lambda cells, tag: "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells)  # noqa: E731
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows[1:])
    return f"<table><tr>{line(rows[0], 'th')}</tr>{body}</table>"


def text_tables(tables: Tables, left: Sequence[int] = (0,)) -> str:
    return "\n\n".join(f"{heading}\n{text_table(rows, left)}" for heading, rows in tables)


def html_tables(tables: Tables) -> str:
    return "".join(f"<p>{html.escape(heading)}</p>{html_table(rows)}" for heading, rows in tables)
