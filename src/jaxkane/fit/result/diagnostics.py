"""Diagnostics of a fit as sentences: about its records, residuals, parameters and bodies; plausible values. Runs no
fit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Array

from ..problem.bodies import PossibleBody
from ..problem.model import Unknowns
from ..problem.parameters import Interval, Parameters
from ..problem.problem import Problem
from ..problem.specification import delayed_inputs
from ..problem.trial import DEGREE, check_records, trial_names
from ..problem.windows import first_after, state_names
from .statistics import FEWEST_TRIALS, LABEL, LARGEST_LEVERAGE, ByTrial, ResidualTest, clusters_of

# By status, why a fit ended.
STATUS = {
    "converged": "converged",
    "bound": "converged: a parameter rests at its bound",
    "unchecked": "converged, but the check or the refinement of the steps of integration failed, or was interrupted",
    "steps": "stopped after the last step, before it converged",
    "stuck": "stuck: no step lowers the cost",
    "interrupted": "interrupted: this is the best result so far",
    "validated": "not fitted: these are the parameters of another fit",
}

# Statuses of fits that have errors and intervals.
AT_A_MINIMUM = ("converged", "bound", "unchecked")


def not_converged(status: str) -> Iterator[str]:
    if status not in (*AT_A_MINIMUM, "validated"):
        yield (
            f"The fit has not converged ({STATUS[status]}): its estimates and errors are not valid. Continue "
            "with `minimize(fit.problem, LeastSquares(), start=fit.point)`, or start from other initial guesses."
        )


def refuse_unless_at_a_minimum(status: str, function: str) -> None:
    """**Raises:** `ValueError` if a fit has not converged."""
    for sentence in not_converged(status):
        raise ValueError(f"{function}: {sentence}")


def notes(fit: Any) -> Iterator[str]:
    """All warnings and remarks about a fit: see `Fit.notes`."""
    problem, late = fit.problem, delayed_inputs(fit.problem.specification)[0]
    yield from not_converged(fit.status)
    yield from (f"{name} is left out: {why}." for name, why in fit.failed.items())
    if fit.status != "validated":
        yield from _parameters(fit)
        yield from _constraints_and_priors(fit)
    yield from _residuals(fit)
    if problem.model.errors is None:  # otherwise the scales are estimated
        yield from wrong_sigma(problem, fit.variance, fit.identifiability.degrees_of_freedom)
    yield from numerical_limits(fit)
    reasons: list[Any] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            problem.check_system(fit.point)
        except ValueError as error:
            reasons.append(error)
    for reason in (*reasons, *(warning.message for warning in caught)):
        yield f"A body is not physically possible: {reason}"
    yield from _starts_at_zero(problem)
    trials = zip(fit.trial_names, problem.trials, strict=True)
    skipped = {name: trial.t[first_after(trial, late)] - trial.t[0] for name, trial in trials}
    skipped = {name: seconds for name, seconds in skipped.items() if seconds > 0}
    if skipped:
        yield (
            f"The first {max(skipped.values()):.4g} s of {', '.join(skipped)} are left out: {', '.join(late)} may "
            "be delayed by this time, and its value before a trial is not recorded. If the value is known, pass it: "
            "Delay(..., before=0.0)."
        )
    yield from fit._unrecorded_inputs
    yield from check_records(problem.trials)
    yield from _wrong_units(problem, fit.fitted)
    yield from poorly_fitted_channels(fit.tests, fit.variance)


def unrecorded_inputs(problem: Problem, point: Unknowns) -> Iterator[str]:
    """Inputs whose first sample is used for earlier times, because they are delayed by more than two intervals."""
    before, nuisance = delayed_inputs(problem.specification)[1], problem.model.nuisance
    names, calibration = trial_names(problem.trials), problem.parameters.apply(problem.system, point.parameters)[1]
    # Reversed, so that the dict keeps the first window of each trial.
    starts = {k: first for k, first, _ in reversed(problem.slices)}
    for name in (name for name in problem.system.inputs if name not in before):
        delays = [
            float(nuisance.with_local(calibration, b).get(("delay of input", name), 0.0)) for b in point.trial_unknowns
        ]
        early = [
            label
            for k, (label, trial, delay) in enumerate(zip(names, problem.trials, delays, strict=True))
            if np.ptp(trial.inputs.get(name, 0.0)) > 0
            and trial.t[starts.get(k, 0)] < trial.t[0] + delay - 2 * np.median(np.diff(trial.t))
        ]
        if early:
            yield (
                f"{name} is delayed by {max(delays):.4g} s, and its value before {', '.join(early)} is not recorded. "
                "Its first sample was used instead, which biases the estimates. Omit this time with the bounds "
                f"Delay({name!r}, bounds=(0.0, {1.5 * max(delays):.2g})), or pass the value before the trial as "
                "`before`."
            )


def _wrong_units(problem: Problem, fitted: ByTrial) -> Iterator[str]:
    """Channels that are proportional to the simulation, with a wrong unit or the wrong sign."""
    for channel in problem.channels:
        pairs = [
            (trial.measured[channel], simulated[channel])
            for simulated, trial in zip(fitted.values(), problem.trials, strict=True)
            if channel in trial.measured
        ]
        y, f = (np.concatenate(part) for part in zip(*pairs, strict=True))
        finite = np.isfinite(y) & np.isfinite(f)
        y, f = y[finite], f[finite]
        if y.size < 5 or np.ptp(y) == 0 or np.ptp(f) == 0:
            continue
        correlation = float(np.corrcoef(y, f)[0, 1])
        if abs(correlation) < 0.8:
            continue
        if 0.7 < np.std(y) / np.std(f) / DEGREE < 1.4:
            yield f"{channel} is about 57 times as large as simulated: it seems to be recorded in degrees."
        elif correlation < 0:
            yield (
                f"{channel} and its simulation have opposite signs (correlation {correlation:.2f}). Check the "
                "direction of the sensor."
            )


def poorly_fitted_channels(tests: Mapping[str, Mapping[str, ResidualTest]], variance: float) -> Iterator[str]:
    """Channels with less than half of the variance accounted for, if noise does not explain this."""
    worst: dict[str, float] = {}
    for channels in tests.values():
        for channel, test in channels.items():
            # `fmin` ignores NaN, which is the share of a constant channel.
            worst[channel] = np.fmin(worst.get(channel, np.inf), test.variance_accounted_for)
    poor = [channel for channel, share in worst.items() if share <= 0.5]
    if variance >= 2 and poor:
        yield (
            f"{', '.join(poor)}: less than half of the variance is accounted for in at least one trial. "
            "`jaxkane.fit.check_signs(fit)` tests whether a sign is wrong."
        )


def _residuals(fit: Any) -> Iterator[str]:
    """Outlier trials, residuals that are not white, and innovations of the wrong size."""
    squares = {
        name: np.concatenate([r[np.isfinite(r)] ** 2 for r in by.values()]) for name, by in fit.residuals.items()
    }
    sizes = {name: float(np.sqrt(np.mean(x))) for name, x in squares.items() if x.size}
    median = float(np.median([*sizes.values()])) if len(sizes) >= 3 else np.inf
    outliers = {name: size for name, size in sizes.items() if size > max(3 * median, 2.0)}
    if outliers and len(outliers) <= len(sizes) / 4:
        named = ", ".join(f"{name} ({size / median:.1f} times)" for name, size in outliers.items())
        yield (
            f"The residuals of {named} are several times as large as those of the other trials. The model "
            "lacks something that happened there, and this biases all parameters. Inspect these trials, and fit the "
            "others without them."
        )
    channels = [f"{name} ({c:.2f})" for name, c in fit.serial_correlation.items() if c]
    if channels:
        text = f"The residuals are not white noise: they are correlated in time ({', '.join(channels)})."
        unit, number = fit.clusters
        within = f"{number} {unit}s" if not unit.startswith(LABEL) else f"{number} values of the {unit}"
        yield (
            f"{text} Intervals account for this within each of {within}. Formal errors do not. "
            "For intervals of the estimate from another run, use `cross_validate(fit).intervals()`."
            if fit.uses_clustered_errors
            else f"{text} Errors and intervals are infinite, because there are too few trials to estimate how the "
            f"estimates scatter. Use at least {FEWEST_TRIALS} trials: cut a long trial with `Trial.between`."
        )
    n, mean_squared = sum(x.size for x in squares.values()), fit.mean_normalized_innovation_squared
    if fit.problem.model.noise is not None and abs(mean_squared - 1) > 4 * (2 / n) ** 0.5:
        yield (
            f"The innovations have the mean square {mean_squared:.2f}, but 1 is expected for the given noise: standard "
            "errors are wrong. Estimate the noise: add SpectralDensity(...) or NoiseScale(...) to `free`."
        )


def _fixed_starts(problem: Problem) -> tuple[list[str], dict[str, list[str]]]:
    """Independent initial values that are not estimated, and by name the trials in which a speed or a state starts at
    zero because no initial value is given.
    """
    names, estimated = state_names(problem.system), {*problem.model.nuisance.start}
    for four in problem.model.quaternions:
        euler = {names[i] for i in four}
        if len(euler & estimated) >= 3:  # the fourth Euler parameter follows from the norm
            estimated |= euler
    fixed = [name for name in names if name not in (*estimated, *problem.system.dependent_coordinates)]
    unstated: dict[str, list[str]] = {}
    for name in (name for name in fixed if name not in problem.system.coordinates):
        for label, trial in zip(trial_names(problem.trials), problem.trials, strict=True):
            if name not in trial.initial and not np.isfinite(trial.measured.get(name, np.nan)).any():
                unstated.setdefault(name, []).append(label)
    return fixed, unstated


def _starts_at_zero(problem: Problem) -> Iterator[str]:
    """Initial values that the user may have forgotten."""
    by_trials: dict[str, list[str]] = {}
    for name, trials in _fixed_starts(problem)[1].items():
        where = "all trials" if len(trials) == len(problem.trials) else ", ".join(trials)
        by_trials.setdefault(where, []).append(name)
    for where, names in by_trials.items():
        yield (
            f"{', '.join(names)} {'starts' if len(names) == 1 else 'start'} at zero in {where}: not measured, not in "
            f"`initial` and not in `unknown`. Estimate the initial value, "
            f"`unknown={(*problem.model.nuisance.start, *names)!r}`, or state that it is zero, "
            f"`initial={dict.fromkeys(names, 0.0)!r}`."
        )


def wrong_sigma(problem: Problem, variance: float, degrees_of_freedom: float) -> Iterator[str]:
    """Residuals whose size differs from `sigma` by more than four standard deviations of chi^2."""
    if np.isnan(variance) or not (variance - 1) ** 2 > 16 * 2 / degrees_of_freedom:
        return
    fixed, unstated = _fixed_starts(problem)
    noisy = tuple(n for n in fixed if any(n in t.measured and n not in t.initial for t in problem.trials))
    chi = f"chi^2 is {variance * degrees_of_freedom:.4g} with {degrees_of_freedom:.4g} degrees of freedom"
    size = f"{chi}: residuals are {variance**0.5:.2g} times as large as `sigma`"
    if variance < 1:
        yield f"{size}. The given `sigma` is too large."
    elif noisy:
        yield (
            f"{size}. The simulations start at measured samples of {', '.join(noisy)}, with their errors. Estimate the "
            f"initial values, `unknown={(*noisy, *unstated)!r}`. Otherwise `sigma` is too small, or the model lacks "
            "something."
        )
    else:
        yield f"{size}: `sigma` is too small, or the model lacks something (`forward_selection`)."


def numerical_limits(fit: Any) -> Iterator[str]:
    """Fits without degrees of freedom, and integration steps that bias the estimates."""
    problem = fit.problem
    if np.isnan(fit.variance):
        n_r, n_unknown = problem.size
        yield (
            f"There are {n_r} residuals for {n_unknown} unknowns, so nothing remains to estimate the size of the "
            "errors. The standard errors are NaN; `fit.laplace()` has errors for the given `sigma`."
        )
    if fit.too_coarse:
        which = f"step of integration ({np.asarray(problem.windows.step).max():.3g} s)"
        if not problem.has_steps:
            which = f"tolerance of integration (rtol {float(problem.model.settings.rtol):.2g})"
        yield (
            f"The {which} is too coarse at the estimates: a finer one changes the residuals by {fit.step_error:.2g} "
            "standard deviations in total. Pass a smaller `step`, or smaller `rtol` and `atol`."
        )


def _free_bodies(parameters: Parameters, x: Array) -> Iterator[tuple[str, PossibleBody, Array]]:
    """For each `Inertia(...)` that was freed: names, bijection and factors."""
    first, x = 0, parameters.all(x)
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        if isinstance(bijection, PossibleBody):
            names = ", ".join(entry.name for entry in parameters.all_entries[first : first + size])
            yield names, bijection, bijection.factors(x[first : first + size])
        first += size


def describe_bodies(parameters: Parameters, x: Array) -> Iterator[str]:
    """For each `Inertia(...)` that was freed: principal moments and axes, and mass and centre if they are free."""
    for names, bijection, factors in _free_bodies(parameters, x):
        m, *center, xx, yy, zz, xy, xz, yz = np.asarray(bijection.all_values(factors), float).tolist()
        moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        words = [f"{m:.5g} kg"] * (0 in bijection.moves)
        if any(i in bijection.moves for i in (1, 2, 3)):
            words.append(f"centre at ({', '.join(f'{c:.4g}' for c in center)}) m")
        words.append(f"principal moments {', '.join(f'{moment:.5g}' for moment in moments)} kg m^2")
        if any((xy, xz, yz)):
            signed = [axis * np.sign(axis[np.abs(axis).argmax()]) for axis in axes.T]
            words.append(f"along {', '.join('(' + ', '.join(f'{a:.3f}' for a in axis) + ')' for axis in signed)}")
        yield f"body of {names}: {', '.join(words)}"


def _parameters(fit: Any) -> Iterator[str]:
    """Parameters that these data do not determine well, or whose estimates are suspicious."""
    of, parameters, correlation = fit.identifiability, fit.parameters, fit.correlation
    names, learned = parameters.names, parameters.learned
    cluster = clusters_of(fit.problem, fit.linearization, by_label=False)[0]
    yield from filter(None, [of.rank_message, *of.messages])
    for (name, kind), h in zip(fit.error_kinds.items(), fit._jackknife.leverage, strict=True):
        if h > LARGEST_LEVERAGE and (cluster == "trial" or kind == "none"):
            which = "formal, for independent residuals" if kind == "formal" else "infinite"
            yield (
                f"One {cluster} alone determines {name} (leverage {h:.3g}): its scatter from {cluster} to {cluster} is "
                f"unknown, and its clustered error is infinite. Its interval is {which}."
            )
    for i, j in zip(*np.nonzero(np.abs(np.tril(correlation, -1)) > 0.95), strict=True):
        if not (learned[i] and learned[j]):
            yield f"{names[j]} and {names[i]} trade off: their correlation is {correlation[i, j]:.3f}."
    for body, _, factors in _free_bodies(parameters, fit.point.parameters):
        S = np.exp(np.asarray(factors)[4:7])
        if S.min() < 1e-2 * S.max():
            yield (
                f"{body}: the estimated inertia is at the limit of a possible body, with all mass in a plane or on a "
                "line. It compensates for something that the model lacks."
            )
    for entry, (name, value) in zip(parameters.entries, fit.estimates.items(), strict=True):
        start, error = fit.start[name], fit.errors[name]
        if not fit.autocorrelation or not entry.start_means_something or start == 0:
            continue
        if not 0.4 <= value / start <= 2.5 and error < 0.2 * abs(value):
            yield (
                f"{name} is {value / start:.2g} times its initial guess with a small error, and the residuals are not "
                "white noise. If the guess was a measured value, the parameter may compensate for missing physics."
            )


# With fewer groups, the estimated standard deviation of a distribution is uncertain. With five groups whose true
# standard deviation was 0.6 of the error of one group, 95 % intervals of the groups had a coverage of 0.80 to 0.90.
FEWEST_GROUPS = 10


def _constraints_and_priors(fit: Any) -> Iterator[str]:
    """Parameters that follow from others, sums at bounds, distributions over groups, and priors without new data."""
    parameters, errors = fit.parameters, fit.standard_errors
    for name, (value, error) in fit.dependent.items():
        yield f"{name} = {value:.5g} ± {error:.2g} follows from the other parameters."
    for text, place in parameters.inequalities:
        if place not in np.asarray(parameters.places):
            bound = float(parameters.sums(fit.point.parameters)[place])
            yield (
                f"{text} is at its bound, {bound:.5g}. Without the bound, the estimated sum would be beyond it. The "
                "intervals are those for a sum that equals the bound."
            )
    for name, deviation in fit.deviations.items():
        if deviation < 1e-2 * max(errors.get(f"{kind} of {name}", 0.0) for kind in ("mean", "median")):
            yield (
                f"{name}: the groups differ by no more than their errors. The deviation of the distribution is "
                "estimated as zero, and all groups have the same value. Their true values may differ by one or two "
                "standard errors."
            )
    for name, begin, end in parameters.distributions:
        if end - begin < FEWEST_GROUPS:
            yield (
                f"{name}: the standard deviation of {end - begin} groups is uncertain. If the groups hardly differ, "
                f"intervals are too narrow. Fit at least {FEWEST_GROUPS} groups, or use `each=` without a distribution."
            )
    columns = parameters.names, fit.identifiability.given_sigma_errors, parameters.prior_deviation, parameters.learned
    for name, error, deviation, is_learned in zip(*columns, strict=True):
        if not is_learned and np.isfinite(deviation) and error > 0.95 * deviation:
            yield f"{name} is determined by its prior alone: the data add no information."


Range = tuple[float, float]
Ranges = Mapping[str, Range]

# Largest plausible deviation from the mean of the prior, in standard deviations of the prior.
DEVIATIONS = 3.0


def implausible(ranges: Ranges, values: Mapping[str, float]) -> dict[str, str]:
    """By name, a sentence for each value that is outside its plausible range."""
    violations = {}
    for name, value in values.items():
        low, high = ranges.get(name, (-math.inf, math.inf))
        if not low <= value <= high:
            side = f"below {low:.4g}" if value < low else f"above {high:.4g}"
            violations[name] = f"{name} = {value:.4g} is {side}" if math.isfinite(value) else f"{name} is {value}"
    return violations


def plausible_of(parameters: Parameters, plausible: Mapping[str, Any]) -> dict[str, Range]:
    """By name of a parameter, the range of its plausible values.

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
            ranges[name] = _range(name, plausible[name], start)
        elif math.isfinite(deviation):
            ranges[name] = mean - DEVIATIONS * deviation, mean + DEVIATIONS * deviation
        elif isinstance(bijection, Interval) and bijection.uniform and math.isfinite(high - low):
            ranges[name] = low + 1e-3 * (high - low), high - 1e-3 * (high - low)
    return ranges


def _range(name: str, value: object, start: float) -> Range:
    low = high = math.nan
    if isinstance(value, (int, float)):
        low, high = start - value * abs(start), start + value * abs(start)
    elif isinstance(value, (tuple, list)) and len(value) == 2:
        low, high = (end if x is None else float(x) for x, end in zip(value, (-math.inf, math.inf), strict=True))
    if not low < high:
        raise ValueError(
            f"`plausible` of {name} must be (lower, upper) with lower < upper, or a positive relative deviation from "
            f"an initial guess other than zero; got {value!r} and the initial guess {start:g}."
        )
    return low, high
