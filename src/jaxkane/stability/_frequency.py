"""Frequency responses of measurements and of a linear model. Uses records and linear models only."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from .._common.lookup import counted, refuse_unknown
from ._linearize import LinearModel


class Record(Protocol):
    """The attributes of a `jaxkane.fit.Trial` that are used here."""

    name: str
    t: np.ndarray
    measured: Mapping[str, np.ndarray]
    inputs: Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class FrequencyResponse:
    """A measured frequency response and that of a linear model, from `input` to `output`.

    - `frequencies` (m,) [rad/s].
    - `measured`, `model` (m,): complex, in the unit of the output divided by that of the input.
    - `coherence` (m,): the share of the output's power that is linear in this input, between 0 and 1.
    - `relative_error` (m,): the standard deviation of |measured| / |response|, due to the incoherent part.
    - `averages`: the number of segments.
    """

    input: str
    output: str
    frequencies: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    coherence: np.ndarray
    relative_error: np.ndarray
    averages: int

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return (
            f"FrequencyResponse({self.input} to {self.output}, {len(self.frequencies)} frequencies from {low:.3g} to "
            f"{high:.3g} rad/s, {self.averages} segments, median coherence {np.median(self.coherence):.2f})"
        )


def frequency_response(
    model: LinearModel, trials: Sequence[Record] | Record, input: str, output: str, *, segment: float | None = None
) -> FrequencyResponse:
    """The frequency response of trials with its coherence, and that of a linear model.

        G = S_wy / S_ww,   coherence = |S_wy|^2 / (S_ww S_yy),   model: C (i omega - A)^-1 B + D

    The spectra are averages over half-overlapping segments of all trials with a Hann window (Welch 1967). The error of
    |G| is ((1 - coherence) / (2 n coherence))^1/2 with n independent segments (Bendat and Piersol, Random Data, ch. 9).

        model = jk.stability.linearize(system, equilibrium)
        jk.plot.frequency_response(jk.stability.frequency_response(model, trials, "torque", "angle"))

    **Arguments:**

    - `model`: the linear model about the motion from which the trials deviate.
    - `trials`: `jaxkane.fit.Trial`, one or several. Irregular samples are interpolated to the median interval.
    - `input`, `output`: names that exist in the model and in the trials.
    - `segment`: the length of a segment [s]. Default: an eighth of all trials, at most the shortest one. The lowest
        frequency is 2 pi / segment.

    The estimate is valid for one input: the other inputs must be zero or uncorrelated with it. If the input is computed
    from the output (a controller, a rider), the estimate is biased toward the inverse of the controller, whatever the
    coherence is.

    **Raises:** `ValueError` for an unknown name, a channel with gaps, an input without power, and fewer than two
    segments. With one segment the coherence is one for any data.
    """
    from scipy.signal import csd  # imports all of scipy.stats

    i, o = place(model.inputs, input, "input"), place(model.outputs, output, "output")
    every = list(trials) if isinstance(trials, Sequence) else [trials]
    records = [_even(trial, input, output) for trial in every]
    dt = float(np.median([step for step, _, _ in records]))
    records = [(w, y) if step == dt else _resampled(step, dt, w, y) for step, w, y in records]
    lengths = [len(w) for w, _ in records]
    n = min(*lengths, sum(lengths) // 8) if segment is None else round(segment / dt)
    n = n - n % 2
    if n < 8 or n > max(lengths):
        raise ValueError(
            f"frequency_response: a segment of {n} samples of {dt:.3g} s must have at least 8 samples and fit into a "
            f"trial. The longest trial has {max(lengths)}. Choose another `segment` [s]."
        )
    averages, S = 0, np.zeros((3, n // 2 + 1), complex)
    for w, y in records:
        count = (len(w) - n) // (n // 2) + 1  # segments of n samples, each shifted by n / 2
        if count > 0:
            spectra = [csd(a, b, 1 / dt, "hann", n, n // 2, detrend="constant")[1] for a, b in ((w, w), (w, y), (y, y))]
            S += count * np.array(spectra)
            averages += count
    if averages < 2:
        raise ValueError(
            f"frequency_response: the trials contain {counted(averages, 'segment')} of {n * dt:.3g} s; at least two "
            "are needed. Pass longer trials or a shorter `segment` [s]."
        )
    ww, wy, yy = S[:, 1:-1]  # without the mean, and without half the sampling frequency
    if not np.all(ww.real > 1e-20 * ww.real.max()):
        raise ValueError(f"frequency_response: the input {input} has no power at some frequencies. Choose another one.")
    coherence = np.clip(np.abs(wy) ** 2 / (ww.real * np.maximum(yy.real, np.finfo(float).tiny)), 0.0, 1.0)
    independent = averages / (1 + (averages > 1) / 18)  # half-overlapping Hann windows correlate by 1/6
    with np.errstate(divide="ignore"):
        error = np.sqrt((1 - coherence) / (2 * independent * coherence))
    omega = 2 * np.pi * np.arange(1, n // 2) / (n * dt)
    A, B, C, D = (np.asarray(x) for x in model)
    x = np.linalg.solve(1j * omega[:, None, None] * np.eye(len(A)) - A, B[None, :, [i]].astype(complex))
    of_model = (C[[o]] @ x)[:, 0, 0] + D[o, i]
    return FrequencyResponse(input, output, omega, wy / ww.real, of_model, coherence, error, averages)


def _even(trial: Any, input: str, output: str) -> tuple[float, np.ndarray, np.ndarray]:
    """The median interval [s], and input and output at equidistant times."""
    t, steps = trial.t, np.diff(trial.t)
    w = trial.inputs[input] if input in trial.inputs else np.zeros_like(t)
    refuse_unknown([output], trial.measured, f"{trial.name} has no channel", "the channels are")
    y = trial.measured[output]
    if not np.all(np.isfinite(y)):
        raise ValueError(f"{trial.name}: {output} has gaps. Cut them out with `Trial.between`.")
    dt = float(np.median(steps))
    if np.ptp(steps) > 1e-6 * dt:
        even = np.arange(t[0], t[-1] + 0.5 * dt, dt)
        w, y = np.interp(even, t, w), np.interp(even, t, y)
    return dt, w, y


def _resampled(step: float, dt: float, *signals: np.ndarray) -> tuple[np.ndarray, ...]:
    t = step * np.arange(len(signals[0]))
    even = np.arange(0.0, t[-1] + 0.5 * dt, dt)
    return tuple(np.interp(even, t, x) for x in signals)


def place(names: Sequence[str], name: str, what: str) -> int:
    """The index of a name. **Raises:** `ValueError` for an unknown name."""
    refuse_unknown([name], names, f"The model has no {what}", "it has")
    return list(names).index(name)
