"""What a reader of a fit should know, in words: of its records, residuals, parameters and bodies. Fits nothing anew."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ._bijections import PossibleBody
from ._model import Unknowns
from ._parameters import Parameters
from ._problem import Problem
from ._statistics import CORRELATED, ByTrial, ResidualTest
from ._trial import Trial
from ._windows import state_names

DEGREE = 180.0 / np.pi
FEWEST = 20  # samples from which anything is concluded

STATUS = {
    "converged": "converged",
    "steps": "stopped after the last step, before it converged",
    "stuck": "stuck: no step lowers the cost",
    "interrupted": "interrupted: this is the best so far",
    "validated": "not fitted: these are the parameters of another fit",
}
"""How a fit ended, in words."""


def not_converged(status: str) -> Iterator[str]:
    if status not in ("converged", "validated"):
        yield (
            f"The fit has not converged ({STATUS[status]}): its estimates and errors are not those of a minimum. Go on "
            "with `minimize(fit.problem, LeastSquares(), start=fit.point)`, or begin with other initial guesses."
        )


def suspicious_records(problem: Problem) -> Iterator[str]:
    """Each kind of suspicion once for all trials that share it."""
    trials: dict[str, list[str]] = {}
    for trial in problem.trials:
        rates = _rates(trial, problem.system.coordinates)
        for note in (*_gaps(trial), *_stale_or_limited(trial), *_difference_quotients(trial), *rates):
            trials.setdefault(note, []).append(trial.name)
    for note, names in trials.items():
        rest = f" and {len(names) - 3} more" if len(names) > 3 else ""
        yield f"{', '.join(names[:3])}{rest}: {note}"


def _gaps(trial: Trial) -> Iterator[str]:
    steps = np.diff(trial.t)
    varying = [name for name, x in trial.inputs.items() if np.ptp(x) > 0]
    if varying and len(steps) >= FEWEST and steps.max() > 5 * np.median(steps):
        yield (
            "the times leave out a stretch, several times as long as the others, in which the inputs "
            f"({', '.join(varying)}) are taken as linear. Cut the trial in two with `between`."
        )


def _stale_or_limited(trial: Trial) -> Iterator[str]:
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
    if changes.size > 0.75 * moves.size or changes.size < 10 or np.median(changes) <= 5 * changes.min():
        return False
    # Stale samples repeat in many short runs, a rest is one long run.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (moves == 0).astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return bool(len(runs) >= 10 and runs.max() < 0.2 * moves.size)


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


def _difference_quotients(trial: Trial) -> Iterator[str]:
    """Channels that are differences of each other."""
    names = list(trial.measured)
    for a in names:
        quotient = np.diff(trial.measured[a]) / np.diff(trial.t)
        if np.isfinite(quotient).sum() < FEWEST or not np.nanmax(np.abs(quotient)) > 0:
            continue
        central = np.gradient(trial.measured[a], trial.t)
        for b in (name for name in names if name != a):
            y = trial.measured[b]
            for difference in (y[1:] - quotient, y[:-1] - quotient, y[1:-1] - central[1:-1]):
                size = np.abs(difference[np.isfinite(difference)])
                if size.size >= FEWEST and np.max(size) < 1e-6 * np.nanmax(np.abs(quotient)):
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
        finite = np.isfinite(change) & np.isfinite(rate)
        change, rate = change[finite], rate[finite]
        if change.size < 5 or np.ptp(change) == 0 or np.ptp(rate) == 0:
            continue
        correlation = float(np.corrcoef(change, rate)[0, 1])
        if correlation < -0.5:
            yield f"{rates[0]} runs against the change of {coordinate}: one of the two has the wrong sign."
        ratio = float(np.std(rate) / np.std(change))
        if abs(correlation) > 0.8 and change.size >= FEWEST:
            for factor, which in ((DEGREE, rates[0]), (1 / DEGREE, coordinate)):
                if 0.7 < ratio / factor < 1.4:
                    other = coordinate if which == rates[0] else rates[0]
                    yield f"{which} seems to be in degrees: it is about 57 times as large as {other} lets expect."


def constant_records(problem: Problem) -> Iterator[str]:
    """Measurements and inputs that do not vary."""
    for trial in problem.trials:
        for channel, y in trial.measured.items():
            y = y[np.isfinite(y)]
            if y.size > 1 and np.ptp(y) == 0:
                yield f"{trial.name}: {channel} is {y[0]:g} throughout: was it recorded?"
        for name, x in trial.inputs.items():
            varies = any(np.ptp(other.inputs[name]) > 0 for other in problem.trials if name in other.inputs)
            if np.ptp(x) == 0 and x[0] == 0 and varies:
                yield f"{trial.name}: the input {name} is zero throughout, in other trials it is not."


def duplicate_trials(problem: Problem) -> Iterator[str]:
    """Trials with the same samples, which count as if they had been measured twice."""
    first: dict[bytes, str] = {}
    for trial in problem.trials:
        key = b"".join([trial.t.tobytes(), *(c.encode() + y.tobytes() for c, y in sorted(trial.measured.items()))])
        if key in first:
            yield f"{trial.name} has the samples of {first[key]}: what is measured once counts twice."
        first.setdefault(key, trial.name)


def wrong_units(problem: Problem, fitted: ByTrial) -> Iterator[str]:
    """Channels that go as the simulation does, but many times as far or the other way."""
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
            yield f"{channel} goes the other way (correlation {correlation:.2f}): turned round, or upside down?"


def poorly_fitted_channels(tests: Mapping[str, Mapping[str, ResidualTest]], variance: float) -> Iterator[str]:
    """Channels of which less than half of the variance is accounted for, where noise does not explain that."""
    worst: dict[str, float] = {}
    for channels in tests.values():
        for channel, test in channels.items():
            worst[channel] = np.fmin(worst.get(channel, np.inf), test.variance_accounted_for)
    poor = [channel for channel, share in worst.items() if share <= 0.5]
    if variance >= 2 and poor:
        yield (
            f"{', '.join(poor)}: less than half of the variance is accounted for, in one trial at least. "
            "`jaxkane.fit.check_signs(fit)` tries whether a sign is wrong."
        )


def outlier_trials(residuals: ByTrial) -> Iterator[str]:
    """Trials that the parameters of all explain far worse than the others."""
    squares = {
        name: np.concatenate([r[np.isfinite(r)] ** 2 for r in channels.values()])
        for name, channels in residuals.items()
    }
    sizes = {name: float(np.sqrt(np.mean(x))) for name, x in squares.items() if x.size}
    if len(sizes) < 3:
        return
    median = float(np.median([*sizes.values()]))
    outliers = {name: size for name, size in sizes.items() if size > max(3 * median, 2.0)}
    if outliers and len(outliers) <= len(sizes) / 4:
        named = ", ".join(f"{name} ({size / median:.1f} times)" for name, size in outliers.items())
        yield (
            f"The residuals of {named} are several times as large as those of the other trials: something happened "
            "there that the model does not have, and all parameters pay for it. Look at it, and fit the others without "
            "it."
        )


def autocorrelated_residuals(correlation: float) -> Iterator[str]:
    """Residuals that are no noise, so that the formal errors are too small."""
    if correlation > CORRELATED:
        yield (
            f"The residuals are not noise: neighbours correlate by {correlation:.2f}. The formal standard errors are "
            f"too small by a factor of about {((1 + correlation) / max(1 - correlation, 0.01)) ** 0.5:.1f}; compare "
            "`clustered_errors`. Where another run will lie, `cross_validate(fit).intervals()` says."
        )


def wrong_noise(residuals: ByTrial, mean_squared: float) -> Iterator[str]:
    """Innovations of another size than the noise that they are judged by: the standard errors are as wrong."""
    n = sum(int(np.isfinite(r).sum()) for channels in residuals.values() for r in channels.values())
    if abs(mean_squared - 1) > 4 * (2 / n) ** 0.5:
        yield (
            f"The innovations have the mean square {mean_squared:.2f}, where the given noise expects one: standard "
            "errors are wrong. Estimate the noise: SpectralDensity(...), NoiseScale(...) among `free`."
        )


def wrong_sigma(problem: Problem, variance: float, degrees_of_freedom: float) -> Iterator[str]:
    """Residuals of another size than `sigma` says, by more than four deviations of chi^2."""
    if np.isnan(variance) or not (variance - 1) ** 2 > 16 * 2 / degrees_of_freedom:
        return
    fixed = [name for name in state_names(problem.system) if name not in problem.model.nuisance.start]
    noisy = tuple(n for n in fixed if any(n in t.measured and n not in t.initial for t in problem.trials))
    chi = f"chi^2 is {variance * degrees_of_freedom:.4g} with {degrees_of_freedom:.4g} degrees of freedom"
    size = f"{chi}: residuals are {variance**0.5:.2g} times as large as `sigma` says"
    if variance < 1:
        yield f"{size}, which is too large."
    elif noisy:
        yield (
            f"{size}. The motions start at measured samples of {', '.join(noisy)}, with the errors of these: estimate "
            f"the starts, `unknown={noisy!r}`. Else `sigma` is too small, or the model lacks something."
        )
    else:
        yield f"{size}: `sigma` is too small, or the model lacks something (`forward_selection`)."


def no_degrees_of_freedom(problem: Problem, variance: float) -> Iterator[str]:
    """Fits that meet every measurement because there are no more of them than unknowns."""
    if np.isnan(variance):
        n_r, n_unknown = problem.size
        yield (
            f"There are {n_r} residuals for {n_unknown} unknowns: nothing is left that says how large errors are. The "
            "standard errors are NaN; `laplace` has those for `sigma` as it was given."
        )


def coarse_steps(problem: Problem, step_error: float) -> str:
    """Steps of integration that bias the estimates."""
    return (
        f"The step of integration ({np.asarray(problem.windows.step).max():.3g} s) is too coarse where the fit ended: "
        f"half of it moves the residuals by {step_error:.2g} standard deviations together. Give a smaller `step`, or "
        "`rtol`."
    )


def infeasible_bodies(problem: Problem, point: Unknowns) -> Iterator[str]:
    """Bodies of the fitted system that no body can be."""
    reasons: list[Any] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            problem.check_system(point)
        except ValueError as error:
            reasons.append(error)
    for reason in (*reasons, *(warning.message for warning in caught)):
        yield f"Not a possible body: {reason}"


def _free_bodies(parameters: Parameters, x: Any) -> Iterator[tuple[str, PossibleBody, Any]]:
    """Of everything that was freed as `Inertia(...)`: names, bijection and factors."""
    first = 0
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        if isinstance(bijection, PossibleBody):
            names = ", ".join(parameters.names[first : first + size])
            yield names, bijection, bijection.factors(x[first : first + size])
        first += size


def bodies_at_the_boundary(parameters: Parameters, x: Any) -> Iterator[str]:
    """Bodies whose parameters are kept possible, and which went as far as that lets them."""
    for names, _, factors in _free_bodies(parameters, x):
        S = np.exp(np.asarray(factors)[4:7])
        if S.min() < 1e-2 * S.max():
            yield (
                f"{names}: the data want a body that cannot be; this one is at the edge, its mass in a plane or on a "
                "line. It is making up for what the model lacks."
            )


def describe_bodies(parameters: Parameters, x: Any) -> Iterator[str]:
    """Of everything that was freed as `Inertia(...)`: principal moments and axes; mass and centre where they moved."""
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


def correlated_parameters(parameters: Parameters, correlation: np.ndarray) -> Iterator[str]:
    """Pairs of parameters of which the data determine little more than a combination."""
    names, learned = parameters.names, parameters.learned
    for i, name in enumerate(names):
        for j in range(i):
            if abs(correlation[i, j]) > 0.95 and not (learned[i] and learned[j]):
                yield f"{names[j]} and {name} trade off: their correlation is {correlation[i, j]:.3f}."


def known_by_prior(parameters: Parameters, given_sigma_errors: np.ndarray) -> Iterator[str]:
    """Parameters of which the data say nothing beyond their prior."""
    deviations = np.asarray(parameters.prior_deviation)
    for i, (name, error) in enumerate(zip(parameters.names, given_sigma_errors, strict=True)):
        if not parameters.learned[i] and np.isfinite(deviations[i]) and error > 0.95 * deviations[i]:
            yield f"{name} is known by its prior alone: the data add nothing."


def far_from_start(
    parameters: Parameters, start: Mapping[str, float], estimates: Mapping[str, float], errors: Mapping[str, float]
) -> Iterator[str]:
    """Estimates that left by far what the user thought plausible, and are still called precise."""
    worthless = {entry.name for entry in parameters.entries if not entry.start_means_something}
    for name, value in estimates.items():
        if name in worthless or start[name] == 0:
            continue
        ratio = value / start[name]
        if not 0.4 <= ratio <= 2.5 and errors[name] < 0.2 * abs(value):
            yield (
                f"{name} went to {ratio:.2g} times its initial guess with a small formal error. Unless that guess was "
                "worth nothing, it is implausible: it may be making up for what the model lacks."
            )
