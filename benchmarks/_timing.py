"""Times that can be compared on a machine that others use too: taken in turns, the best of several."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any


def timed(f: Callable[[], Any]) -> tuple[Any, float]:
    """What `f` gives, and the seconds that it took."""
    began = time.perf_counter()
    result = f()
    return result, time.perf_counter() - began


def in_turns(rivals: Mapping[str, Callable[[], Any]], seconds: float, rounds: int = 3) -> dict[str, float]:
    """The shortest time of each rival [s]. In a round every one runs once, so that a slow minute is slow for all.

    **Arguments:** go on for so many `seconds`, and so many `rounds` at least; each has run once before.
    """
    for f in rivals.values():
        f()
    best = dict.fromkeys(rivals, float("inf"))
    began, done = time.perf_counter(), 0
    while done < rounds or time.perf_counter() - began < seconds:
        for name, f in rivals.items():
            best[name] = min(best[name], timed(f)[1])
        done += 1
    return best
