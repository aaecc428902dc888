"""Fits beside each other, and whether a value can be believed. Fits nothing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._common.lookup import refuse_unknown
from ._bijections import Interval
from ._parameters import Parameters
from ._problem import refuse_other
from ._result import Fit
from ._tables import Tables, html_tables, text_tables
from ._trial import Trial
from ._validate import validate

Range = tuple[float, float]

DEVIATIONS = 3.0
"""Of its prior, by which a value may be off."""


@dataclasses.dataclass(frozen=True)
class Plausible:
    """By name of a parameter, the range in which it is believed."""

    ranges: Mapping[str, Range]

    def bound_violations(self, values: Mapping[str, float]) -> list[str]:
        """Which of these values lie outside, in words."""
        violations = []
        for name, value in values.items():
            low, high = self.ranges.get(name, (-math.inf, math.inf))
            if not low <= value <= high:
                side = f"below {low:.4g}" if value < low else f"above {high:.4g}"
                violations.append(f"{name} = {value:.4g} is {side}" if math.isfinite(value) else f"{name} is {value}")
        return violations


def plausible_of(parameters: Parameters, plausible: Mapping[str, Any]) -> Plausible:
    """For every parameter the given range, (lower, upper) or a share of its start; else three deviations of its prior;
    else its bounds, of which it must stay away. Where a search starts says nothing."""
    ranges, first = {}, 0
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        for i in range(first, first + size):
            name, start = parameters.names[i], float(parameters.start[i])
            mean, deviation = float(parameters.prior_mean[i]), float(parameters.prior_deviation[i])
            if name in plausible:
                ranges[name] = checked_range(name, plausible[name], start)
            elif math.isfinite(deviation):
                ranges[name] = mean - DEVIATIONS * deviation, mean + DEVIATIONS * deviation
            elif isinstance(bijection, Interval) and all(bijection.bounded) and bijection.uniform:
                low, high = float(bijection.lower), float(bijection.upper)
                ranges[name] = low + 1e-3 * (high - low), high - 1e-3 * (high - low)
        first += size
    return Plausible(ranges)


def checked_range(name: str, value: Any, start: float) -> Range:
    """(lower, upper) of a pair, or of a share of the start.

    **Raises:** `ValueError` where it is neither.
    """
    if isinstance(value, (int, float)):
        share = float(value)
        if not (share > 0 and start):
            raise ValueError(
                f"`plausible` of {name}: a share is positive, and of a start that is not zero; got {value}."
            )
        return start - share * abs(start), start + share * abs(start)
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(f"`plausible` of {name} is (lower, upper), or a share of its start; got {value!r}.")
    low = -math.inf if value[0] is None else float(value[0])
    high = math.inf if value[1] is None else float(value[1])
    if not low < high:
        raise ValueError(f"`plausible` of {name}: nothing lies between {low} and {high}.")
    return low, high


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """What `compare` gives; print it for the tables.

    - `fits`: by name. `held_out`: by name, the parameters of each on held-out trials; empty without any.
    - `bound_violations`: by name, what is not plausible of each fit's parameters, in words.
    """

    fits: Mapping[str, Fit]
    held_out: Mapping[str, Fit]
    bound_violations: Mapping[str, tuple[str, ...]]

    @property
    def tables(self) -> Tables:
        """A heading and rows, of which the first is the head, for each."""
        tables = [("Parameters, with the errors of their intervals", self._parameters()), ("All", self._sums())]
        violations = [[name, violation] for name, of_fit in self.bound_violations.items() for violation in of_fit]
        if violations:
            tables.append(("Bound violations", [["fit", "violation"], *violations]))
        for where, fits in (("", self.fits), ("Held out: ", self.held_out)):
            if fits:
                tables.append((f"{where}Sum of squares and variance accounted for, by channel", self._channels(fits)))
                tables.append((f"{where}Sum of squares, by trial", self._trials(fits)))
        return tables

    def _parameters(self) -> list[list[str]]:
        names = list(dict.fromkeys(name for fit in self.fits.values() for name in fit.names))
        units = {n: u for fit in self.fits.values() for n, u in zip(fit.names, fit.parameters.units, strict=True)}
        rows = [["parameter", *self.fits]]
        for name in names:
            cell = lambda f, n=name: f"{f.estimates[n]:.5g} ({f.errors[n]:.2g})" if n in f.names else ""  # noqa: E731
            rows.append([f"{name} [{units[name]}]" if units[name] else name, *map(cell, self.fits.values())])
        return rows

    def _sums(self) -> list[list[str]]:
        fits, columns = list(self.fits.values()), list(self.fits)
        rows = [["", *columns], ["status", *(fit.status for fit in fits)]]
        for cost in dict.fromkeys(fit.problem.cost_name for fit in fits):
            rows.append([cost, *(f"{fit.cost:.6g}" if fit.problem.cost_name == cost else "" for fit in fits)])
        if any(not math.isnan(fit.held_out_cost) for fit in fits):
            cells = ("" if math.isnan(fit.held_out_cost) else f"{fit.held_out_cost:.6g}" for fit in fits)
            rows.append(["of trials left out in turn", *cells])
        if self.held_out:
            rows.append(["held out", *(_held_out_cost(self.held_out[name]) for name in columns)])
        rows.append(["residuals", *(str(fit.problem.size[0]) for fit in fits)])
        rows.append(["unknowns", *(str(fit.problem.size[1]) for fit in fits)])
        rows.append(["variance of a residual", *(f"{fit.variance:.3g}" for fit in fits)])
        rows.append(["neighbours' correlation", *(f"{fit.autocorrelation:.2f}" for fit in fits)])
        return rows

    def _channels(self, fits: Mapping[str, Fit]) -> list[list[str]]:
        channels = list(dict.fromkeys(c for fit in fits.values() for c in fit.problem.channels))

        def cell(fit: Fit, channel: str) -> str:
            if channel not in fit.problem.channels:
                return ""
            squares = sum(float(np.nansum(r[channel] ** 2)) for r in fit.residuals.values() if channel in r)
            return f"{squares:.5g}, {100 * fit.variance_accounted_for[channel]:.1f} %"

        return [["channel", *fits], *([name, *(cell(fit, name) for fit in fits.values())] for name in channels)]

    def _trials(self, fits: Mapping[str, Fit]) -> list[list[str]]:
        trials = list(dict.fromkeys(name for fit in fits.values() for name in (*fit.trial_names, *fit.failed)))
        of = {name: dict.fromkeys(fit.failed, "not simulated") for name, fit in fits.items()}
        for name, fit in fits.items():
            for trial, channels in fit.residuals.items():
                of[name][trial] = f"{sum(float(np.nansum(r**2)) for r in channels.values()):.5g}"
        return [["trial", *fits], *([trial, *(of[name].get(trial, "") for name in fits)] for trial in trials)]

    def __str__(self) -> str:
        return text_tables(self.tables)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_tables(self.tables)


def _held_out_cost(fit: Fit) -> str:
    n = len(fit.trial_names)
    return f"{fit.cost:.6g}" + (f" ({n} of {n + len(fit.failed)} trials)" if fit.failed else "")


def compare(
    fits: Mapping[str, Fit] | Sequence[Fit],
    held_out: Sequence[Trial] | Trial | None = None,
    *,
    plausible: Mapping[str, Any] | None = None,
) -> Comparison:
    """Fits beside each other: which is nearer to what was measured, where, and which can be believed.

        print(compare({"viscous": one, "with dry friction": other}, held_out=others))

    **Arguments:**

    - `fits`: by name; of a sequence, the free parameters are the names.
    - `held_out`: trials that none of them has seen: their starts and biases are found, the parameters are not
        (`validate`). Those of bicycles by `bicycle_rides`.
    - `plausible`: as in `forward_selection`; names that none of the fits frees are passed over.

    **Returns:** a `Comparison`: print it for tables of parameters with errors (clustered by trial where the residuals
    are correlated), sums of squares on both sides, as a whole, by channel and by trial, and what is not plausible.

    **Raises:** `TypeError` for what is no `Fit`; `ValueError` for none, and two of the same name.
    """
    if isinstance(fits, Fit):
        raise TypeError("compare takes fits by name, as in compare({'first': one, 'second': other}); got one Fit.")
    if isinstance(fits, Mapping):
        named = dict(fits)
    else:
        for fit in fits:
            refuse_other(fit, Fit, "compare", "compare({'first': fit(...), 'second': fit(...)})")
        names = [", ".join(fit.names) for fit in fits]
        if len(set(names)) < len(names):
            raise ValueError("Two of these fits have the same free parameters: name them, compare({'first': ...}).")
        named = dict(zip(names, fits, strict=True))
    if not named:
        raise ValueError("There is no fit to compare.")
    for fit in named.values():
        refuse_other(fit, Fit, "compare", "compare({'first': fit(...), 'second': fit(...)})")
    ranges = plausible or {}
    free = {name for fit in named.values() for name in fit.names}
    if not free & set(ranges):  # of a table that served a search, names that no fit frees are no slip
        refuse_unknown(ranges, free, "`plausible` names")
    return Comparison(
        fits=named,
        held_out={} if held_out is None else {name: validate(fit, held_out) for name, fit in named.items()},
        bound_violations={
            name: tuple(plausible_of(fit.parameters, ranges).bound_violations(fit.estimates))
            for name, fit in named.items()
        },
    )
