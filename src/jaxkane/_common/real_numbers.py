"""Numbers that are given: as they stand in files of text, and as arguments. Knows no mechanics."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

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


def real_number(value: Any, what: str) -> float:
    """One real number that was given, as a float; it may be infinite or NaN.

    **Raises:** `ValueError` for text, truth values, complex numbers, arrays and all else.
    """
    array = np.asarray(value) if np.ndim(value) == 0 else None
    if array is None or array.dtype.kind not in "iuf":
        raise ValueError(f"{what} must be a real number, got {value!r}.")
    return float(array)


def positive_number(value: Any, what: str) -> float:
    """One positive finite number that was given, as a float.

    **Raises:** `ValueError` for anything else.
    """
    number = real_number(value, what)
    if not 0.0 < number < float("inf"):
        raise ValueError(f"{what} must be positive, got {value!r}.")
    return number
