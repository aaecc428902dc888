"""What is checked of the arguments of a fit. Knows types and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def check_windows(window: float | None, continuity: Mapping[str, float] | None) -> None:
    if window is not None and not window > 0:
        raise ValueError(f"`window` is a length of time [s], got {window}.")
    if continuity is not None and window is None:
        raise ValueError("`continuity` binds the windows of a trial together: give their length, `window` [s].")


def refuse_other(given: Any, wanted: type, name: str, instead: str) -> None:
    """What is asked before a fit takes a `Problem`, what is asked after it takes a `Fit`.

    **Raises:** `TypeError` for anything else.
    """
    if not isinstance(given, wanted):
        raise TypeError(f"{name} takes a {wanted.__name__}, as in {instead}; got {type(given).__name__}.")
