"""Numbers as they stand in files of text. Knows characters."""

from __future__ import annotations

import re

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def decimal_number(text: str) -> float:
    """A finite number in decimal notation: what Python reads besides (1_000, infinity, the digits of other scripts) is
    a slip of the pen in a file.

    **Raises:** `ValueError` for anything else.
    """
    number = float(text) if _DECIMAL.fullmatch(text) else float("inf")
    if abs(number) == float("inf"):
        raise ValueError(f"{text!r} is not a finite decimal number.")
    return number
