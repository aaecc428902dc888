"""What a reader of a fit should know: of records, residuals, bodies and bounds. Fits nothing anew."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ._bijections import PossibleBody
from ._problem import Problem
from ._statistics import CORRELATED
from ._tables import STATUS
from ._trial import Trial
from ._windows import state_names

if TYPE_CHECKING:
    from ._result import Fit


DEGREE = 180.0 / np.pi
FEWEST = 20  # samples from which anything is concluded


def suspicious_records(problem: Problem) -> list[str]:
    """In words, each kind of suspicion once for all trials that share it."""
    found: dict[str, list[str]] = {}
    for trial in problem.trials:
        for what in (
            *_gaps(trial),
            *_of_channels(trial),
            *_of_pairs(trial),
            *_rates(trial, problem.system.coordinates),
        ):
            found.setdefault(what, []).append(trial.name)
    return [f"{_listed(trials)}: {what}" for what, trials in found.items()]


def _listed(trials: list[str]) -> str:
    more = len(trials) - 3
    return ", ".join(trials[:3]) + (f" and {more} more" if more > 0 else "")


def _gaps(trial: Trial) -> Iterator[str]:
    steps = np.diff(trial.t)
    varying = [name for name, x in trial.inputs.items() if np.ptp(x) > 0]
    if varying and len(steps) >= FEWEST and steps.max() > 5 * np.median(steps):
        yield (
            "the times leave out a stretch, several times as long as the others, in which the inputs "
            f"({', '.join(varying)}) are taken as linear. Cut the trial in two with `between`."
        )


def _of_channels(trial: Trial) -> Iterator[str]:
    for kind, group in (("", trial.measured), ("the input ", trial.inputs)):
        for name, y in group.items():
            y = y[np.isfinite(y)]
            if y.size < FEWEST or np.ptp(y) == 0:
                continue
            if _is_stale(y):
                yield (
                    f"{kind}{name} repeats its last value again and again while it moves: stale samples, of an "
                    "instrument that is slower than the times say. Keep those at which it changes, NaN elsewhere."
                )
            elif limit := _limit(y):
                yield (
                    f"{kind}{name} rests at its {limit} value for many samples: was it limited there? What lies beyond "
                    "is not recorded."
                )


def _is_stale(y: np.ndarray) -> bool:
    """Whether samples repeat each other, where a coarse resolution does not explain it."""
    moves = np.abs(np.diff(y))
    changes = moves[moves > 0]
    repeats = 1.0 - changes.size / moves.size
    resolution = changes.min()
    return bool(
        repeats > 0.25 and changes.size >= 10 and np.median(changes) > 5 * resolution and _short_runs(moves == 0)
    )


def _short_runs(equal: np.ndarray) -> bool:
    """Whether what repeats does so in many short runs, and not in one long rest."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], equal.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return bool(len(runs) >= 10 and runs.max() < 0.2 * len(equal))


def _limit(y: np.ndarray) -> str:
    """Which extreme value a record rests at, in runs; "" for none."""
    levels = len(np.unique(y))
    for word, extreme in (("largest", y.max()), ("smallest", y.min())):
        rests = y == extreme
        # Switched signals have few levels; what rests for once, at the beginning or the end, is at rest.
        inside = rests[1:-1] & rests[:-2] & rests[2:]
        starts = np.count_nonzero(np.diff(rests.astype(int)) == 1)
        if inside.sum() > 0.05 * y.size and starts >= 2 and levels > 0.2 * y.size and extreme != 0:
            return word
    return ""


def _of_pairs(trial: Trial) -> Iterator[str]:
    """Channels that are differences of each other."""
    names = list(trial.measured)
    for a in names:
        quotient = np.diff(trial.measured[a]) / np.diff(trial.t)
        if np.isfinite(quotient).sum() < FEWEST or not np.nanmax(np.abs(quotient)) > 0:
            continue
        central = np.gradient(trial.measured[a], trial.t)
        for b in (name for name in names if name != a):
            y = trial.measured[b]
            for same in (y[1:] - quotient, y[:-1] - quotient, y[1:-1] - central[1:-1]):
                seen = same[np.isfinite(same)]
                if seen.size >= FEWEST and np.max(np.abs(seen)) < 1e-6 * np.nanmax(np.abs(quotient)):
                    yield (
                        f"{b} is the difference quotient of {a}: it was computed, not measured, and says nothing new. "
                        "Leave it out."
                    )
                    break


def _rates(trial: Trial, coordinates: Sequence[str]) -> Iterator[str]:
    """A measured rate beside the change of its measured coordinate: signs and degrees."""
    for coordinate in coordinates:
        rates = [c for c in (f"{coordinate}_rate", f"{coordinate}_dot") if c in trial.measured]
        if coordinate not in trial.measured or not rates:
            continue
        change, rate = np.gradient(trial.measured[coordinate], trial.t), trial.measured[rates[0]]
        seen = np.isfinite(change) & np.isfinite(rate)
        if seen.sum() < 5 or np.ptp(change[seen]) == 0 or np.ptp(rate[seen]) == 0:
            continue
        agreement = float(np.corrcoef(change[seen], rate[seen])[0, 1])
        if agreement < -0.5:
            yield f"{rates[0]} runs against the change of {coordinate}: one of the two has the wrong sign."
        ratio = float(np.std(rate[seen]) / np.std(change[seen]))
        if abs(agreement) > 0.8 and seen.sum() >= FEWEST:
            for factor, which in ((DEGREE, rates[0]), (1 / DEGREE, coordinate)):
                if 0.7 < ratio / factor < 1.4:
                    other = coordinate if which == rates[0] else rates[0]
                    yield f"{which} seems to be in degrees: it is about 57 times as large as {other} lets expect."


def notes_of(fit: Fit) -> tuple[str, ...]:
    """All of them, for a fit."""
    problem = fit.problem
    return (
        *not_converged(fit),
        *(f"{name} is left out: {why}." for name, why in fit.failed.items()),
        *filter(None, [fit.identifiability.rank_message]),
        *fit.identifiability.messages,
        *trade_offs(fit),
        *odd_trials(fit),
        *coloured_residuals(fit),
        *wrong_noise(fit),
        *wrong_sigma(fit),
        *no_freedom(fit),
        *coarse_steps(fit),
        *impossible_bodies(fit),
        *bodies_at_the_edge(fit),
        *far_from_start(fit),
        *only_priors(fit),
        *empty_columns(problem),
        *suspicious_records(problem),
        *doubled_trials(problem),
        *other_units(fit),
        *bad_channels(fit),
    )


def not_converged(fit: Fit) -> list[str]:
    """Fits that ended before they had converged."""
    if fit.status in ("converged", "applied"):
        return []
    return [
        f"The fit has not converged ({STATUS[fit.status]}): its estimates and errors are not those of a minimum. Go on "
        "with `minimize(fit.problem, LeastSquares(), start=fit.point)`, or begin with other initial guesses."
    ]


def empty_columns(problem: Problem) -> list[str]:
    """Measurements and inputs that say nothing."""
    notes = []
    for trial in problem.trials:
        for channel, y in trial.measured.items():
            seen = y[np.isfinite(y)]
            if seen.size > 1 and np.ptp(seen) == 0:
                notes.append(f"{trial.name}: {channel} is {seen[0]:g} throughout: was it recorded?")
        for name, x in trial.inputs.items():
            varies = any(np.ptp(other.inputs[name]) > 0 for other in problem.trials if name in other.inputs)
            if np.ptp(x) == 0 and x[0] == 0 and varies:
                notes.append(f"{trial.name}: the input {name} is zero throughout, in other trials it is not.")
    return notes


def other_units(fit: Fit) -> list[str]:
    """Channels that go as the simulation does, but many times as far or the other way."""
    notes = []
    for channel in fit.problem.channels:
        pairs = [
            (trial.measured[channel], fit.fitted[name][channel])
            for name, trial in zip(fit.trial_names, fit.problem.trials, strict=True)
            if channel in trial.measured
        ]
        measured, simulated = (np.concatenate(part) for part in zip(*pairs, strict=True))
        agreement = _correlation(measured, simulated)
        seen = np.isfinite(measured) & np.isfinite(simulated)
        if abs(agreement) < 0.8:
            continue
        ratio = np.std(measured[seen]) / np.std(simulated[seen])
        if 0.7 < ratio / DEGREE < 1.4:
            notes.append(f"{channel} is about 57 times as large as simulated: it seems to be recorded in degrees.")
        elif agreement < 0:
            notes.append(f"{channel} goes the other way (correlation {agreement:.2f}): turned round, or upside down?")
    return notes


def bad_channels(fit: Fit) -> list[str]:
    """Channels of which less than half of the variance is accounted for, where noise does not explain that."""
    if not fit.variance >= 2:
        return []
    bad = [
        channel
        for channel in fit.problem.channels
        if any(c[channel].variance_accounted_for <= 0.5 for c in fit.tests.values() if channel in c)
    ]
    if not bad:
        return []
    return [
        f"{', '.join(bad)}: less than half of the variance is accounted for, in one trial at least. "
        "`jaxkane.fit.check_signs(fit)` tries whether a sign is wrong."
    ]


def odd_trials(fit: Fit) -> list[str]:
    """Trials that the parameters of all explain far worse than the others."""
    squares = {
        name: np.concatenate([r[np.isfinite(r)] ** 2 for r in channels.values()])
        for name, channels in fit.residuals.items()
    }
    sizes = {name: float(np.sqrt(np.mean(x))) for name, x in squares.items() if x.size}
    if len(sizes) < 3:
        return []
    usual = float(np.median([*sizes.values()]))
    odd = {name: size for name, size in sizes.items() if size > max(3 * usual, 2.0)}
    if not odd or len(odd) > len(sizes) / 4:
        return []
    named = ", ".join(f"{name} ({size / usual:.1f} times)" for name, size in odd.items())
    return [
        f"The residuals of {named} are several times as large as those of the other trials: something happened there "
        "that the model does not have, and all parameters pay for it. Look at it, and fit the others without it."
    ]


def coloured_residuals(fit: Fit) -> list[str]:
    """Residuals that are no noise, so that the formal errors are too small."""
    lag = fit.autocorrelation
    if lag <= CORRELATED:
        return []
    return [
        f"The residuals are not noise: neighbours correlate by {lag:.2f}. The formal standard errors are too "
        f"small by a factor of about {((1 + lag) / max(1 - lag, 0.01)) ** 0.5:.1f}; compare `clustered_errors`."
    ]


def wrong_noise(fit: Fit) -> list[str]:
    """Innovations of another size than the noise that they are judged by: the standard errors are as wrong."""
    if fit.problem.model.noise is None:
        return []
    n = sum(int(np.isfinite(r).sum()) for channels in fit.residuals.values() for r in channels.values())
    if not abs(fit.mean_normalized_innovation_squared - 1) > 4 * (2 / n) ** 0.5:
        return []
    return [
        f"The innovations have the mean square {fit.mean_normalized_innovation_squared:.2f}, where the noise as it was "
        "given says one: standard errors are wrong. Estimate them: SpectralDensity(...), NoiseScale(...) among `free`."
    ]


def wrong_sigma(fit: Fit) -> list[str]:
    """Residuals of another size than `sigma` says, by more than four deviations of chi^2."""
    freedom = fit.identifiability.degrees_of_freedom
    if np.isnan(fit.variance) or not (fit.variance - 1) ** 2 > 16 * 2 / freedom:
        return []
    chi = f"chi^2 is {fit.variance * freedom:.4g} with {freedom:.4g} degrees of freedom"
    size = f"{chi}: residuals are {fit.variance**0.5:.2g} times as "
    if fit.variance < 1:
        return [f"{size}large as `sigma` says, which is too large."]
    noisy = noisy_starts(fit.problem)
    if not noisy:
        return [
            f"{size}large as `sigma` says: `sigma` is too small, or the model lacks something (`forward_selection`)."
        ]
    return [
        f"{size}large as `sigma` says. The motions start at measured samples of {', '.join(noisy)}, with the errors of "
        f"these: have the starts found, `unknown={noisy!r}`. Else `sigma` is too small, or the model lacks something."
    ]


def noisy_starts(problem: Problem) -> tuple[str, ...]:
    """Coordinates, speeds and states that are held where a measurement of them begins."""
    known = [name for name in state_names(problem.system) if name not in problem.model.nuisance.start]
    return tuple(name for name in known if any(name in t.measured and name not in t.initial for t in problem.trials))


def coarse_steps(fit: Fit) -> list[str]:
    """Steps of integration that bias the estimates."""
    if not fit.too_coarse:
        return []
    steps = np.asarray(fit.problem.windows.step)
    return [
        f"The step of integration ({steps.max():.3g} s) is too coarse where the fit ended: half of it moves the "
        f"residuals by {fit.step_error:.2g} standard deviations together. Give a smaller `step`, or `rtol`."
    ]


def no_freedom(fit: Fit) -> list[str]:
    """Fits that meet every measurement because there are no more of them than unknowns."""
    n_r, n_unknown = fit.problem.size
    if not np.isnan(fit.variance):
        return []
    return [
        f"There are {n_r} residuals for {n_unknown} unknowns: nothing is left that says how large errors are. The "
        "standard errors are NaN; `laplace` has those for `sigma` as it was given."
    ]


def doubled_trials(problem: Problem) -> list[str]:
    """Trials with the same samples, which count as if they had been measured twice."""
    notes, first = [], {}
    for trial in problem.trials:
        key = b"".join([trial.t.tobytes(), *(c.encode() + y.tobytes() for c, y in sorted(trial.measured.items()))])
        if key in first:
            notes.append(f"{trial.name} has the samples of {first[key]}: what is measured once counts twice.")
        first.setdefault(key, trial.name)
    return notes


def impossible_bodies(fit: Fit) -> list[str]:
    """Bodies of the fitted system that no body can be."""
    notes = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            fit.problem.check_system(fit.point)
        except ValueError as error:
            notes.append(f"Not a possible body: {error}")
    return notes + [f"Not a possible body: {warning.message}" for warning in caught]


def bodies_at_the_edge(fit: Fit) -> list[str]:
    """Bodies whose parameters are kept possible, and which went as far as that lets them."""
    notes, first = [], 0
    for bijection, size in zip(fit.parameters.bijections, fit.parameters.sizes, strict=True):
        if isinstance(bijection, PossibleBody):
            names = ", ".join(fit.names[first : first + size])
            S = np.exp(np.asarray(bijection.factors(fit.point.x[first : first + size]))[4:7])
            if S.min() < 1e-2 * S.max():
                notes.append(
                    f"{names}: the data want a body that cannot be; this one is at the edge, its mass in a plane or on "
                    "a line. It is making up for what the model lacks."
                )
        first += size
    return notes


def trade_offs(fit: Fit) -> list[str]:
    """Pairs of parameters of which the data determine little more than a combination."""
    notes, correlation = [], fit.correlation
    learned = fit.parameters.learned
    for i, name in enumerate(fit.names):
        for j in range(i):
            if abs(correlation[i, j]) > 0.95 and not (learned[i] and learned[j]):
                notes.append(f"{fit.names[j]} and {name} trade off: their correlation is {correlation[i, j]:.3f}.")
    return notes


def only_priors(fit: Fit) -> list[str]:
    """Parameters of which the data say nothing beyond what was known."""
    notes, deviations = [], np.asarray(fit.parameters.prior_deviation)
    for i, (name, error) in enumerate(zip(fit.names, fit.identifiability.given_sigma_errors, strict=True)):
        if not fit.parameters.learned[i] and np.isfinite(deviations[i]) and error > 0.95 * deviations[i]:
            notes.append(f"{name} is known by its prior alone: the data add nothing.")
    return notes


def far_from_start(fit: Fit) -> list[str]:
    """Estimates that left what the user thought plausible by far, and are still called precise."""
    notes = []
    worthless = {entry.name for entry in fit.parameters.entries if not entry.start_means_something}
    for name, value in fit.estimates.items():
        start, error = fit.start[name], fit.standard_errors[name]
        if name in worthless:
            continue
        if start != 0 and not 0.4 <= value / start <= 2.5 and error < 0.2 * abs(value):
            notes.append(
                f"{name} went to {value / start:.2g} times its initial guess with a small formal error. Unless that "
                "guess was worth nothing, it is implausible: it may be making up for what the model lacks."
            )
    return notes


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    seen = np.isfinite(a) & np.isfinite(b)
    if seen.sum() < 5 or np.ptp(a[seen]) == 0 or np.ptp(b[seen]) == 0:
        return 0.0
    return float(np.corrcoef(a[seen], b[seen])[0, 1])
