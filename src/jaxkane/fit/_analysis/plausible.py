"""Whether a value can be believed: what was said of it, its prior, its bounds. Knows numbers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from .._problem.bijections import Interval
from .._problem.parameters import Parameters

Range = tuple[float, float]

DEVIATIONS = 3.0
"""Of its prior, by which a value may be off."""


@dataclasses.dataclass(frozen=True)
class Plausible:
    """By name of a parameter, between what it is believed."""

    ranges: Mapping[str, Range]

    def objections(self, values: Mapping[str, float]) -> list[str]:
        """What is not believed of these values, in words."""
        found = []
        for name, value in values.items():
            low, high = self.ranges.get(name, (-math.inf, math.inf))
            if not low <= value <= high:
                side = f"below {low:.4g}" if value < low else f"above {high:.4g}"
                found.append(f"{name} = {value:.4g} is {side}" if math.isfinite(value) else f"{name} is {value}")
        return found


def plausible_of(parameters: Parameters, said: Mapping[str, Any]) -> Plausible:
    """For every parameter what was said of it, (lower, upper) or a share of its start; else three deviations of its
    prior; else its bounds, of which it must stay away. Where a search starts says nothing."""
    ranges, first = {}, 0
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        for i in range(first, first + size):
            name, start = parameters.names[i], float(parameters.start[i])
            mean, deviation = float(parameters.prior_mean[i]), float(parameters.prior_deviation[i])
            if name in said:
                ranges[name] = checked_range(name, said[name], start)
            elif math.isfinite(deviation):
                ranges[name] = mean - DEVIATIONS * deviation, mean + DEVIATIONS * deviation
            elif isinstance(bijection, Interval) and all(bijection.bounded) and bijection.uniform:
                low, high = float(bijection.lower), float(bijection.upper)
                ranges[name] = low + 1e-3 * (high - low), high - 1e-3 * (high - low)
        first += size
    return Plausible(ranges)


def checked_range(name: str, given: Any, start: float) -> Range:
    """(lower, upper) of a pair, or of a share of the start.

    **Raises:** `ValueError` where it is neither.
    """
    if isinstance(given, (int, float)):
        share = float(given)
        if not (share > 0 and start):
            raise ValueError(
                f"`plausible` of {name}: a share is positive, and of a start that is not zero; got {given}."
            )
        return start - share * abs(start), start + share * abs(start)
    if not isinstance(given, (tuple, list)) or len(given) != 2:
        raise ValueError(f"`plausible` of {name} is (lower, upper), or a share of its start; got {given!r}.")
    low = -math.inf if given[0] is None else float(given[0])
    high = math.inf if given[1] is None else float(given[1])
    if not low < high:
        raise ValueError(f"`plausible` of {name}: nothing lies between {low} and {high}.")
    return low, high
