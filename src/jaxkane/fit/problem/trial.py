"""Trials: measured motions, from arrays or a data frame, and checks of their records. Independent of a system."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..._common.lookup import DECIMAL, as_names, real_number, refuse_unknown

if TYPE_CHECKING:
    import pandas as pd

_FEEDBACK = (
    "A trial contains measurements. Put feedback, such as a controller or a rider, into the system's `loads`. There it "
    "depends on the simulated motion, and its gains can be free parameters."
)


class Trial:
    """The measurements of one experiment.

        Trial(t, {"roll": roll, "steer": steer}, {"steer_torque": torque}, sigma={"roll": 0.01, "steer": 0.02})

    **Arguments:**

    - `t`: increasing times (n_t,) [s].
    - `measured`: by channel, samples (n_t,) in the channel's unit. Missing samples are NaN or masked. A channel is a
        coordinate, a speed, a dependent speed, a state or one of the `outputs` of the system.
    - `inputs`: by name, a number or samples (n_t,) without gaps, in the input's unit. Inputs are linear between the
        samples. Inputs that are not given are zero. Pass only measured inputs. Put feedback (a controller, a
        rider) into the system's `loads`: there it depends on the simulated motion, and its gains can be estimated.
    - `sigma`: by channel, the standard deviation of the measurement, a positive number or samples (n_t,), in the
        channel's unit. Residuals are divided by it. A single number applies to all channels.
    - `initial`: by name, initial values of coordinates, speeds and states. A number applies to the start of every
        window. Of an array (n_t,), each window uses the sample at its start. A value that is neither given nor measured
        is zero (one for the last of four Euler parameters). `assemble` then satisfies the constraints from there. Four
        Euler parameters that are all given, measured or in `unknown` are normalized.
    - `name`: the name in messages, tables and plots.
    - `labels`: by name, text or numbers that group trials: `labels={"rider": "anna", "speed": 4.0}`. In
        cross-validation, `folds="speed"` leaves out the trials with the same speed together. Intervals of a fit are
        clustered by a label with at least three values, if there is one.

    **Raises:** `ValueError` that names the trial and the channel, for wrong shapes, text, times that do not increase,
    a channel without `sigma`, or a trial without a finite measurement.
    """

    __slots__ = ("initial", "inputs", "labels", "measured", "name", "sigma", "t")

    def __init__(
        self,
        t: ArrayLike,
        measured: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike] | None = None,
        *,
        sigma: Mapping[str, ArrayLike] | float,
        initial: Mapping[str, ArrayLike] | None = None,
        name: str = "trial",
        labels: Mapping[str, str | float] | None = None,
    ):
        self.name = str(name)
        for group, given in (("measured", measured), ("inputs", inputs), ("initial", initial), ("labels", labels)):
            what = f"a function. {_FEEDBACK}" if callable(given) else f"{type(given).__name__}."
            must, example = group == "measured", "{'rider': 'anna'}" if group == "labels" else "{'roll': samples}"
            self._require(
                (isinstance(given, Mapping) and (given or not must)) or (given is None and not must),
                f"`{group}` must be a {'nonempty ' * must}dict by name, such as {example}, got {what}",
            )
        self.labels = {
            key: x if isinstance(x, str) else real_number(x, f"{self.name}: labels[{key!r}]")
            for key, x in (labels or {}).items()
        }
        self.t = self._times(t)
        self.measured = {key: self._samples("measured", key, value) for key, value in measured.items()}
        self.inputs, self.initial = (
            {key: self._samples(group, key, value, number=True) for key, value in (given or {}).items()}
            for group, given in (("inputs", inputs), ("initial", initial))
        )
        by_channel = sigma if isinstance(sigma, Mapping) else dict.fromkeys(measured, sigma)
        missing = [key for key in measured if key not in by_channel]
        self._require(
            not missing,
            f"`sigma` has no value for {', '.join(missing)}. Pass the standard deviation of each measured channel.",
        )
        self.sigma = {key: self._samples("sigma", key, by_channel[key], number=True) for key in measured}
        for key, value in self.sigma.items():
            self._require(np.all(value > 0), f"sigma[{key!r}] must be positive, got {value.min():g}.")
        self._require(
            any(np.isfinite(x).any() for x in self.measured.values()),
            f"all measurements are NaN ({', '.join(measured)}). Omit this trial.",
        )

    def _require(self, is_right: object, message: str) -> None:
        if not is_right:
            raise ValueError(f"{self.name}: {message}")

    @classmethod
    def from_dataframe(
        cls,
        frame: pd.DataFrame,
        measured: Sequence[str] | Mapping[str, str],
        inputs: Sequence[str] | Mapping[str, str] = (),
        *,
        sigma: Mapping[str, ArrayLike] | float,
        initial: Sequence[str] | Mapping[str, str] = (),
        time: str = "t",
        name: str = "trial",
        labels: Mapping[str, str | float] | None = None,
    ) -> Trial:
        """A trial from the columns of a pandas data frame.

            frame = pd.read_csv("rides.csv")
            Trial.from_dataframe(frame, {"roll": "roll_angle"}, ["steer_torque"], sigma=0.01, time="seconds")
            [Trial.from_dataframe(run, ["roll"], sigma=0.01, name=key) for key, run in frame.groupby("run")]

        **Arguments:**

        - `frame`: the data frame, with one row per sample. A measured channel may have missing values.
        - `measured`: names of columns that are channels of the system, or a dict from channels to columns.
        - `inputs`: the same for inputs.
        - `sigma`: the standard deviations, as in `Trial`.
        - `initial`: the same as `measured`, for initial values.
        - `time`: the name of the column of times [s], or of the index.
        - `name`: the name of the trial, as in `Trial`.
        - `labels`: the labels of the trial, as in `Trial`.

        **Returns:** a `Trial`.

        **Raises:** `ValueError` that names a missing, repeated or non-numeric column, and the errors of `Trial`.
        """
        if frame.index.name == time and time not in frame.columns:
            frame = frame.reset_index()

        def samples(column: str) -> np.ndarray:
            refuse_unknown([column], [str(c) for c in frame.columns], f"{name}: no column", "the columns are")
            values = frame[column]
            if values.ndim != 1:
                raise ValueError(f"{name}: more than one column has the name {column!r}. Rename one.")
            if getattr(values.dtype, "kind", "") not in "iuf":
                text = [x for x in values.dropna() if isinstance(x, str) and not DECIMAL.fullmatch(x)]
                found = f" and contains {text[0]!r}" if text else ""
                raise ValueError(
                    f"{name}: column {column!r} must be real numbers. It has the type {values.dtype}{found}. Convert "
                    "it, for example with `pandas.to_numeric` or `Series.dt.total_seconds`."
                )
            return values.to_numpy(dtype=float, na_value=np.nan)

        columns = {"measured": measured, "inputs": inputs, "initial": initial}
        groups = [x if isinstance(x, Mapping) else {n: n for n in as_names(x, key)} for key, x in columns.items()]
        channels, signals, known = ({key: samples(c) for key, c in group.items()} for group in groups)
        return cls(samples(time), channels, signals, sigma=sigma, initial=known, name=name, labels=labels)

    def _times(self, t: ArrayLike) -> np.ndarray:
        t = self._numbers("t", t)
        self._require(t.ndim == 1 and t.size > 1, f"`t` must be at least two times (n_t,), got the shape {t.shape}.")
        finite, steps = np.isfinite(t), np.diff(t)
        self._require(finite.all(), f"t[{int(np.argmin(finite))}] is not finite. Omit this sample.")
        i = int(np.argmin(steps > 0))
        self._require(
            np.all(steps > 0),
            f"the times are {'repeated' if steps[i] == 0 else 'unsorted'}: t[{i}] = {t[i]:.6g} is followed by "
            f"{t[i + 1]:.6g}. Sort the samples, and keep one sample per time.",
        )
        return t

    def _numbers(self, label: str, value: ArrayLike) -> np.ndarray:
        self._require(not callable(value), f"{label} must be samples (n_t,), got a function. {_FEEDBACK}")
        try:
            if isinstance(value, np.ma.MaskedArray):  # masked samples are missing samples
                value = np.ma.filled(value.astype(float), np.nan) if value.dtype.kind in "iuf" else value.data
            array = np.asarray(value)
            # `astype(float)` alone would accept booleans, dates and the text "1.5" without an error.
            if array.dtype.kind not in "iuf":
                raise ValueError(f"their type is {array.dtype}")
            return array.astype(float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.name}: {label} must be real numbers: {error}.") from None

    def _samples(self, group: str, key: str, value: ArrayLike, number: bool = False) -> np.ndarray:
        """Samples (n_t,). `number`: whether a single number is allowed, and gaps are not."""
        label = f"{group}[{key!r}]"
        array = self._numbers(label, value)
        if array.ndim == 0 and number:
            array = np.full(self.t.shape, float(array))
        self._require(
            array.shape == self.t.shape,
            f"{label} has the shape {array.shape}, but `t` has {self.t.shape}. Pass one sample per time.",
        )
        wrong = ~np.isfinite(array) if number else np.isinf(array)
        i = int(np.argmax(wrong))
        self._require(
            not wrong.any(),
            f"{label}[{i}] is {'NaN' if np.isnan(array[i]) else 'infinite'}. Correct it, interpolate it, or cut the "
            "trial with `between`. Only missing samples of measured channels may be NaN.",
        )
        return array

    def between(self, start: float, stop: float) -> Trial:
        """The part of the trial with start <= t <= stop.

        **Arguments:**

        - `start`: the first time [s].
        - `stop`: the last time [s].

        **Returns:** a `Trial`. A number in `initial` also applies to its start.

        **Raises:** `ValueError` if the part has fewer than two samples.
        """
        start, stop = real_number(start, f"{self.name}: `start`"), real_number(stop, f"{self.name}: `stop`")
        inside = (self.t >= start) & (self.t <= stop)
        self._require(
            inside.sum() > 1,
            f"fewer than two samples are between {start:g} and {stop:g} s. The trial lasts from {self.t[0]:g} to "
            f"{self.t[-1]:g} s. Choose a longer part of it.",
        )
        groups = self.measured, self.inputs, self.sigma, self.initial
        measured, inputs, sigma, initial = ({key: x[inside] for key, x in group.items()} for group in groups)
        kept: dict[str, Any] = {"name": self.name, "labels": self.labels}
        return Trial(self.t[inside], measured, inputs, sigma=sigma, initial=initial, **kept)

    def with_initial_state(self, initial: Mapping[str, ArrayLike]) -> Trial:
        """A copy of the trial with other initial values, `initial` as in `Trial`."""
        kept = {"sigma": self.sigma, "name": self.name, "labels": self.labels}
        return Trial(self.t, self.measured, self.inputs, initial=initial, **kept)

    def __repr__(self) -> str:
        span = f"{len(self.t)} times from {self.t[0]:g} to {self.t[-1]:g} s"
        return f"Trial({self.name!r}, {span}: {', '.join(self.measured)})"


def trial_names(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Names of the trials. Repeated names get a number."""
    names = [trial.name for trial in trials]
    return tuple(n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names))


def groups_of(trials: Sequence[Trial], each: str) -> tuple[str | float, ...]:
    """The group of every trial: the name of the trial if `each` is "trial", else the value of the label `each`.

    **Raises:** `ValueError` that names a trial without this label.
    """
    if each == "trial":
        return trial_names(trials)
    if each == "window":
        raise ValueError(
            "each='window' is possible only for a Gain or an Offset without bounds, without a distribution, and not "
            "with of='start'. Cut the trials with `between`, and use each='trial'."
        )
    for trial in trials:
        if each not in trial.labels:
            raise ValueError(
                f"{trial.name}: the label {each!r} is missing, but each={each!r} needs it in every trial. Pass "
                f"Trial(..., labels={{{each!r}: ...}})."
            )
    return tuple(trial.labels[each] for trial in trials)


def as_trials(trials: Sequence[Trial] | Trial) -> tuple[Trial, ...]:
    """Convert one trial or several trials to a tuple.

    **Raises:** `TypeError` if an element is not a `Trial`; `ValueError` if there is no trial.
    """
    trials = (trials,) if isinstance(trials, Trial) else tuple(trials) if isinstance(trials, Iterable) else (trials,)
    for trial in trials:
        if not isinstance(trial, Trial):
            raise TypeError(f"`trials` must contain only jaxkane.fit.Trial, got {type(trial).__name__}.")
    if not trials:
        raise ValueError("`trials` is empty. Pass at least one Trial.")
    return trials


DEGREE = 180.0 / np.pi
FEWEST = 20  # the minimum number of samples for a conclusion


def check_records(trials: Sequence[Trial] | Trial) -> tuple[str, ...]:
    """Check trials for suspicious records. A fit reports the results in its `notes`.

    The function detects:

    - gaps between samples of inputs,
    - stale and limited samples,
    - channels that are difference quotients of other channels,
    - rates (`x_rate`, `x_dot`) with the wrong sign or in degrees,
    - constant channels,
    - inputs that are zero in a few trials,
    - trials with the samples of another trial.

    **Arguments:**

    - `trials`: one `Trial` or several.

    **Returns:** a tuple with one sentence per suspicion, which names the trials.
    """
    trials, by_note = as_trials(trials), {}
    for trial in trials:
        for note in (*_gaps(trial), *_stale_or_limited(trial), *_difference_quotients(trial), *_rates(trial)):
            by_note.setdefault(note, []).append(trial.name)
    for name in dict.fromkeys(name for trial in trials for name in trial.inputs):
        zero = [trial.name for trial in trials if name in trial.inputs and not np.any(trial.inputs[name])]
        # If many trials have a zero input, this is intended. In a few trials, it is a fault of the record.
        if 0 < len(zero) <= len(trials) / 4:
            by_note[f"the input {name} is always zero, but not in other trials. Check the record."] = zero
    notes = [f"{', '.join(n[:3])}{f' and {len(n) - 3} more' if len(n) > 3 else ''}: {x}" for x, n in by_note.items()]
    first: dict[bytes, str] = {}
    for trial in trials:
        key = b"".join([trial.t.tobytes(), *(c.encode() + y.tobytes() for c, y in sorted(trial.measured.items()))])
        if key in first:
            twice = f"{trial.name} has the same samples as {first[key]}"
            notes.append(f"{twice}, so these are counted twice. Omit one trial.")
        first.setdefault(key, trial.name)
    return tuple(notes)


def _gaps(trial: Trial) -> Iterator[str]:
    steps = np.diff(trial.t)
    varying = [name for name, x in trial.inputs.items() if np.ptp(x) > 0]
    if varying and len(steps) >= FEWEST and steps.max() > 5 * np.median(steps):
        yield (
            "the times have a gap that is several times longer than a sample interval. The inputs "
            f"({', '.join(varying)}) are treated as linear there. Cut the trial in two with `between`."
        )


def _stale_or_limited(trial: Trial) -> Iterator[str]:
    for kind, group in (("", trial.measured), ("the input ", trial.inputs)):
        for name, y in group.items():
            y = y[np.isfinite(y)]
            if y.size > 1 and np.ptp(y) == 0 and not kind:
                yield f"{name} has the constant value {y[0]:g}. Check whether it was recorded."
            if y.size < FEWEST or np.ptp(y) == 0:
                continue
            if _is_stale(y):
                yield (
                    f"{kind}{name} repeats its last value many times while it changes: the instrument is slower than "
                    "the times. Keep the samples at which it changes, and write NaN elsewhere."
                )
            elif limit := _limit(y):
                yield (
                    f"{kind}{name} has its {limit} value in many successive samples. Check whether the instrument "
                    "limits its range: values beyond the limit are not recorded."
                )


def _is_stale(y: np.ndarray) -> bool:
    """Whether samples are repeated and a coarse resolution does not explain it."""
    moves = np.abs(np.diff(y))
    changes = moves[moves > 0]
    if changes.size > 0.75 * moves.size or changes.size < 10 or np.median(changes) <= 5 * changes.min():
        return False
    # Stale samples are repeated in many short runs. A system at rest gives one long run.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (moves == 0).astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    return bool(len(runs) >= 10 and runs.max() < 0.2 * moves.size)


def _limit(y: np.ndarray) -> str:
    """The extreme value ("largest" or "smallest") that a record repeats in several runs; "" for none."""
    levels = len(np.unique(y))
    for word, extreme in (("largest", y.max()), ("smallest", y.min())):
        rests = y == extreme
        # Switched signals have few levels, so they are excluded. So is a single run, which is a system at rest.
        inside = rests[1:-1] & rests[:-2] & rests[2:]
        starts = np.count_nonzero(np.diff(rests.astype(int)) == 1)
        if inside.sum() > 0.05 * y.size and starts >= 2 and levels > 0.2 * y.size and extreme != 0:
            return word
    return ""


def _difference_quotients(trial: Trial) -> Iterator[str]:
    """Detect channels that are difference quotients of other channels."""
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
                        f"{b} is the difference quotient of {a}: it was computed, not measured, and contains no new "
                        "information. Omit it."
                    )
                    break


def _rates(trial: Trial) -> Iterator[str]:
    """Compare a measured rate with the change of its measured coordinate: sign and unit (degrees)."""
    for coordinate in trial.measured:
        rates = [c for c in (f"{coordinate}_rate", f"{coordinate}_dot") if c in trial.measured]
        if not rates:
            continue
        change, rate = np.gradient(trial.measured[coordinate], trial.t), trial.measured[rates[0]]
        finite = np.isfinite(change) & np.isfinite(rate)
        change, rate = change[finite], rate[finite]
        if change.size < 5 or np.ptp(change) == 0 or np.ptp(rate) == 0:
            continue
        correlation = float(np.corrcoef(change, rate)[0, 1])
        if correlation < -0.5:
            yield f"{rates[0]} and the change of {coordinate} have opposite signs: one of them has the wrong sign."
        ratio = float(np.std(rate) / np.std(change))
        if abs(correlation) > 0.8 and change.size >= FEWEST:
            for factor, which in ((DEGREE, rates[0]), (1 / DEGREE, coordinate)):
                if 0.7 < ratio / factor < 1.4:
                    other = coordinate if which == rates[0] else rates[0]
                    yield f"{which} seems to be in degrees: it is about 57 times larger than expected from {other}."
