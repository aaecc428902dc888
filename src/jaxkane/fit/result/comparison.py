"""Comparison of fits, and plausibility of estimates. Runs no fit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ..._common.lookup import hint, refuse_unknown
from ..._kane.api import generalized_active_forces
from ..._scalarjit.compat import on_device
from ..problem.parameters import Interval, Parameters
from ..problem.specification import refuse_other
from ..problem.trial import Trial
from .fit_result import Fit
from .tables import Tables, html_tables, text_tables
from .validation import validate

if TYPE_CHECKING:
    import pandas as pd

Range = tuple[float, float]

DEVIATIONS = 3.0
"""Largest plausible deviation from the mean of the prior, in standard deviations of the prior."""


@dataclasses.dataclass(frozen=True)
class Plausible:
    """By name of a parameter, the range of its plausible values."""

    ranges: Mapping[str, Range]

    def bound_violations(self, values: Mapping[str, float]) -> dict[str, str]:
        """By name, a sentence for each value that is outside its plausible range."""
        violations = {}
        for name, value in values.items():
            low, high = self.ranges.get(name, (-math.inf, math.inf))
            if not low <= value <= high:
                side = f"below {low:.4g}" if value < low else f"above {high:.4g}"
                violations[name] = f"{name} = {value:.4g} is {side}" if math.isfinite(value) else f"{name} is {value}"
        return violations


def plausible_of(parameters: Parameters, plausible: Mapping[str, Any]) -> Plausible:
    """The plausible range of every parameter.

    A given range is (lower, upper) or a relative deviation from the start. By default it is three standard deviations
    of the prior. Without a prior it is the bounds, except for their ends. The initial guess alone implies no range.
    """
    ranges = {}
    for i, (name, owner, (low, high)) in enumerate(
        zip(parameters.names, parameters.owners, parameters.bounds.tolist(), strict=True)
    ):
        bijection, start = parameters.bijections[owner], float(parameters.start[i])
        mean, deviation = float(parameters.prior_mean[i]), float(parameters.prior_deviation[i])
        if name in plausible:
            ranges[name] = checked_range(name, plausible[name], start)
        elif math.isfinite(deviation):
            ranges[name] = mean - DEVIATIONS * deviation, mean + DEVIATIONS * deviation
        elif isinstance(bijection, Interval) and bijection.uniform and math.isfinite(high - low):
            ranges[name] = low + 1e-3 * (high - low), high - 1e-3 * (high - low)
    return Plausible(ranges)


MOST_SAMPLES = 2000
"""Largest number of samples of a fitted trajectory at which `energy_sources` evaluates the loads."""


def energy_sources(fit: Fit) -> dict[str, str]:
    """By name, a sentence for each parameter that acts like a negative damping.

        theta dP/dtheta >= 0   with   P = sum F_r u_r

    The condition is checked at all samples of the fitted trajectory and again with reversed speeds. The power of
    gravity, a spring or a motor changes its sign with the speeds. The power of friction does not and is negative. This
    detects a damping parameter without bounds whose estimate has the wrong sign.
    """
    problem, rides = fit.problem, fit.problem.trajectories(fit.point)

    def joined(of):
        return np.concatenate([np.asarray(of(ride)) for ride in rides])

    samples = {"t": joined(lambda r: r.t), "q": joined(lambda r: r.q), "u": joined(lambda r: r.u)}
    samples |= {name: joined(lambda r, name=name: r.values[name]) for name in rides[0].values}
    finite = np.flatnonzero(np.all([np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in samples.values()], axis=0))
    rows = finite[:: max(1, len(finite) // MOST_SAMPLES)]
    t, q, u, *values = (on_device(np.concatenate([x[rows], x[rows]])) for x in samples.values())
    u = on_device(np.asarray(u) * np.repeat([1.0, -1.0], len(rows))[:, None])

    def power(x: Any, t: Any, q: Any, u: Any, *values: Any) -> Any:
        system = problem.parameters.apply(problem.system, x)[0]
        return generalized_active_forces(system, t, q, u, dict(zip(rides[0].values, values, strict=True))) @ u

    slopes = jax.jit(jax.vmap(jax.jacfwd(power), in_axes=(None, *(0 for _ in samples))))
    P = np.asarray(slopes(fit.point.parameters, t, q, u, *values)) * np.sign([*fit.estimates.values()])  # (2 n, p)
    adds = (P.min(axis=0) >= -1e-9 * P.max(axis=0)) & (P.max(axis=0) > 0)
    words = "adds energy at every sample of the fitted motion, like a negative damping"
    entries = zip(fit.parameters.entries, adds, fit.estimates.items(), strict=True)
    return {name: f"{name} = {value:.4g} {words}" for entry, add, (name, value) in entries if add and entry.targets}


def checked_range(name: str, value: Any, start: float) -> Range:
    """(lower, upper) of a pair, or of a relative deviation from the start.

    **Raises:** `ValueError` if `value` is neither.
    """
    if isinstance(value, (int, float)):
        share = float(value)
        if not (share > 0 and start):
            raise ValueError(
                f"`plausible` of {name}: a relative deviation must be positive, and needs an initial guess other than "
                f"zero; got {value} and the initial guess {start:g}. Pass (lower, upper)."
            )
        return start - share * abs(start), start + share * abs(start)
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(
            f"`plausible` of {name} must be (lower, upper), or a relative deviation from the initial guess, got "
            f"{value!r}."
        )
    low = -math.inf if value[0] is None else float(value[0])
    high = math.inf if value[1] is None else float(value[1])
    if not low < high:
        raise ValueError(f"`plausible` of {name}: the lower end must be less than the upper end, got ({low}, {high}).")
    return low, high


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """The result of `compare`. Print it for the tables.

    - `fits`: the fits by name.
    - `held_out`: by name, the validation of each fit on the held-out trials. Empty without held-out trials.
    - `bound_violations`: by name of the fit, a sentence for each estimate that is not plausible.
    """

    fits: Mapping[str, Fit]
    held_out: Mapping[str, Fit]
    bound_violations: Mapping[str, tuple[str, ...]]

    @property
    def tables(self) -> Tables:
        """The tables, each as a heading and rows. The first row is the header."""
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

            def cell(f, n=name):
                return f"{f.estimates[n]:.5g} ({f.errors[n]:.2g})" if n in f.names else ""

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
        rows.append(["residuals' correlation", *(f"{fit.autocorrelation:.2f}" for fit in fits)])
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
    """Compare fits: their costs by channel and by trial, their parameters, and the plausibility of these.

        print(compare({"viscous": one, "with dry friction": other}, held_out=others))

    **Arguments:**

    - `fits`: fits by name. In a sequence, each fit is named after its free parameters.
    - `held_out`: trials that were not used in any of the fits. Only their initial states and unknowns are estimated
        (`validate`). For bicycles, construct them with `bicycle_rides`.
    - `plausible`: plausible ranges, as in `forward_selection`. Names that none of the fits frees are ignored.

    **Returns:** a `Comparison`. Its tables contain the parameters with the errors of their intervals, and the estimates
    that are not plausible. They also contain the sums of squares of fitted and held-out trials: in total, by channel
    and by trial.

    **Raises:** `TypeError` for a value that is not a `Fit`; `ValueError` without a fit, and for two fits with the same
    name.
    """
    if isinstance(fits, Fit):
        raise TypeError(
            "compare: `fits` is one Fit. Pass fits by name, such as compare({'first': one, 'second': other})."
        )
    if isinstance(fits, Mapping):
        named = dict(fits)
    else:
        for fit in fits:
            refuse_other(fit, Fit, "compare", "compare({'first': fit(...), 'second': fit(...)})")
        names = [", ".join(fit.names) for fit in fits]
        if len(set(names)) < len(names):
            raise ValueError("compare: two fits have the same free parameters. Name the fits: compare({'first': ...}).")
        named = dict(zip(names, fits, strict=True))
    if not named:
        raise ValueError("compare: `fits` is empty. Pass at least one Fit.")
    for fit in named.values():
        refuse_other(fit, Fit, "compare", "compare({'first': fit(...), 'second': fit(...)})")
    ranges = plausible or {}
    free = {name for fit in named.values() for name in fit.names}
    if not free & set(ranges):  # ranges of a whole search may contain names that no fit frees
        refuse_unknown(ranges, free, "`plausible` contains unknown names:", "the free parameters are")
    return Comparison(
        fits=named,
        held_out={} if held_out is None else {name: validate(fit, held_out) for name, fit in named.items()},
        bound_violations={
            name: tuple(plausible_of(fit.parameters, ranges).bound_violations(fit.estimates).values())
            for name, fit in named.items()
        },
    )


def compare_estimates(fit: Fit, other: Fit | Mapping[str, float | tuple[float, float]]) -> pd.DataFrame:
    """Differences between two sets of estimates, in standard errors of the difference.

        z = (estimate - other) / (error^2 + other_error^2)^1/2

        jk.plot.estimates({"Monday": monday, "Tuesday": tuesday})  # the same as a forest plot
        compare_estimates(fit, {"mass": (2.1, 0.05), "length": 0.6})  # with values from elsewhere

    **Arguments:**

    - `fit`: a `Fit`, whose `errors` are used.
    - `other`: a fit of other data, or by name a value or (value, standard deviation). If both share data, their
        errors are correlated, and the denominator of `z` is usually too large.

    **Returns:** a `pandas.DataFrame` with a row for each parameter in both, and the columns `unit`, `estimate`,
    `error`, `other`, `other_error`, `difference` and `z`. `z` is NaN if an error is not finite.

    **Raises:** `TypeError` if `fit` is not a `Fit`; `ValueError` without a common parameter.
    """
    refuse_other(fit, Fit, "compare_estimates", "compare_estimates(fit(...), other)")
    if isinstance(other, Fit):
        others = {name: (value, other.errors[name]) for name, value in other.estimates.items()}
    else:
        others = {name: value if isinstance(value, tuple) else (value, 0.0) for name, value in other.items()}
    names = [name for name in fit.names if name in others]
    if not names:
        raise ValueError(
            f"compare_estimates: the two sets have no common parameter; {hint([], fit.names, 'the fit has')}"
        )
    frame = fit.to_pandas().loc[names, ["unit", "estimate", "error"]]
    frame[["other", "other_error"]] = np.array([others[name] for name in names], float)
    frame["difference"] = frame.estimate - frame.other
    error = np.hypot(frame.error, frame.other_error)
    frame["z"] = np.where(np.isfinite(error) & (error > 0), frame.difference / np.where(error > 0, error, 1.0), np.nan)
    return frame
