"""Trials: measured motions, from arrays or a data frame. This module does not depend on a system."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
        cross-validation, `folds="speed"` leaves out the trials with the same speed together.

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
        self.labels = self._checked_labels(labels)
        self.t = self._times(t)
        if not isinstance(measured, Mapping) or not measured:
            raise ValueError(
                f"{self.name}: `measured` must be a nonempty dict by channel, such as {{'roll': samples}}, got "
                f"{type(measured).__name__}."
            )
        for group, given in (("inputs", inputs), ("initial", initial)):
            if given is not None and not isinstance(given, Mapping):
                what = f"a function. {_FEEDBACK}" if callable(given) else f"{type(given).__name__}."
                raise ValueError(
                    f"{self.name}: `{group}` must be a dict by name, such as {{'name': samples}}, got {what}"
                )
        self.measured = {key: self._samples("measured", key, value) for key, value in measured.items()}
        self.inputs = {
            key: self._samples("inputs", key, value, number=True, gaps=False) for key, value in (inputs or {}).items()
        }
        self.initial = {
            key: self._samples("initial", key, value, number=True, gaps=False) for key, value in (initial or {}).items()
        }
        self.sigma = self._sigmas(sigma)
        if not any(np.isfinite(x).any() for x in self.measured.values()):
            raise ValueError(f"{self.name}: all measurements are NaN ({', '.join(self.measured)}). Omit this trial.")

    def _checked_labels(self, labels: Any) -> dict[str, str | float]:
        if labels is not None and not isinstance(labels, Mapping):
            raise ValueError(
                f"{self.name}: `labels` must be a dict by name, such as {{'rider': 'anna'}}, got {labels!r}."
            )

        def label(key, x):
            return x if isinstance(x, str) else real_number(x, f"{self.name}: labels[{key!r}]")

        return {key: label(key, value) for key, value in (labels or {}).items()}

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

    def _times(self, t: Any) -> np.ndarray:
        t = self._numbers("t", t)
        if t.ndim != 1 or t.shape[0] < 2:
            raise ValueError(f"{self.name}: `t` must be at least two times (n_t,), got the shape {t.shape}.")
        if not np.all(np.isfinite(t)):
            raise ValueError(f"{self.name}: t[{int(np.argmin(np.isfinite(t)))}] is not finite. Omit this sample.")
        steps = np.diff(t)
        if not np.all(steps > 0):
            i = int(np.argmax(steps <= 0))
            what = "repeated" if steps[i] == 0 else "unsorted"
            raise ValueError(
                f"{self.name}: the times are {what}: t[{i}] = {t[i]:.6g} is followed by {t[i + 1]:.6g}. Sort the "
                "samples, and keep one sample per time."
            )
        return t

    def _numbers(self, label: str, value: Any) -> np.ndarray:
        if callable(value):
            raise ValueError(f"{self.name}: {label} must be samples (n_t,), got a function. {_FEEDBACK}")
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

    def _samples(self, group: str, key: str, value: Any, number: bool = False, gaps: bool = True) -> np.ndarray:
        label = f"{group}[{key!r}]"
        array = self._numbers(label, value)
        if array.ndim == 0 and number:
            array = np.full(self.t.shape, float(array))
        if array.shape != self.t.shape:
            raise ValueError(
                f"{self.name}: {label} has the shape {array.shape}, but `t` has {self.t.shape}. Pass one sample per "
                "time."
            )
        if np.isinf(array).any():
            raise ValueError(
                f"{self.name}: {label}[{int(np.argmax(np.isinf(array)))}] is infinite. Correct it, or write NaN if a "
                "measurement is missing."
            )
        if not gaps and np.isnan(array).any():
            raise ValueError(
                f"{self.name}: {label}[{int(np.argmax(np.isnan(array)))}] is NaN. Only measured channels may have "
                "gaps. Interpolate it, or cut the trial with `between`."
            )
        return array

    def _sigmas(self, sigma: Any) -> dict[str, np.ndarray]:
        by_channel = sigma if isinstance(sigma, Mapping) else dict.fromkeys(self.measured, sigma)
        missing = [key for key in self.measured if key not in by_channel]
        if missing:
            raise ValueError(
                f"{self.name}: `sigma` has no value for {', '.join(missing)}. Pass the standard deviation of each "
                "measured channel."
            )
        sigmas = {key: self._samples("sigma", key, by_channel[key], number=True, gaps=False) for key in self.measured}
        for key, value in sigmas.items():
            if not np.all(value > 0):
                raise ValueError(f"{self.name}: sigma[{key!r}] must be positive, got {value.min():g}.")
        return sigmas

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
        if inside.sum() < 2:
            raise ValueError(
                f"{self.name}: fewer than two samples are between {start:g} and {stop:g} s. The trial lasts from "
                f"{self.t[0]:g} to {self.t[-1]:g} s. Choose a longer part of it."
            )

        def cut(group):
            return {key: value[inside] for key, value in group.items()}

        return Trial(
            self.t[inside],
            cut(self.measured),
            cut(self.inputs),
            sigma=cut(self.sigma),
            initial=cut(self.initial),
            name=self.name,
            labels=self.labels,
        )

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
