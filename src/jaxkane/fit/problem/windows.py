"""Trials cut into windows of one shape. Padded and missing samples have zero weight."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._integrate.inputs import is_coarse
from ..._kane.right_hand_side import reads_time
from ..._scalarjit.compat import on_device
from ..._system.system import System
from .parameters import floats
from .trial import Trial

DelayRange = tuple[float, float]
"""The largest delay and the largest advance of inputs [s]."""

WindowSlice = tuple[int, int, int]
"""A window: index of the trial, index of the first sample, number of samples."""


class Shape(NamedTuple):
    """The shape of `Windows`.

    - `windows`: the number of windows.
    - `samples`: the number of samples per window.
    - `inputs`: the number of input samples per window.
    - `acting`: the maximum number of input samples that act within a window.
    """

    windows: int
    samples: int
    inputs: int
    acting: int

    def holds(self, other: Shape) -> bool:
        return all(a >= b for a, b in zip(self, other, strict=True))


class Windows(eqx.Module):
    """All windows of all trials, stacked. A short window repeats its last time, with zero weight.

    - `t` (W, n_t): times [s]. With defects, the last time of a window is the first time of the next one.
    - `measured` (W, n_c, n_t): samples.
    - `weight` (W, n_c, n_t): 1 / sigma, or zero.
    - `t_input` (W, n_in): times of the input samples [s]. Delayed inputs have samples before and after the window.
    - `inputs` (W, inputs, n_in): samples of the inputs.
    - `step` (W,): integration steps [s].
    - `start` (W, n_q + n_u + n_x): the given or measured initial state.
    - `next_start` (W, n_q + n_u + n_x): the given or measured initial state of the next window.
    - `start_weight` (W, n_c): 1 / sigma of the first sample of a channel if a trial with process noise starts there,
        else zero. The `weight` of such a sample is zero, so that it is not counted twice.
    - `linked` (W,): one if a defect links the window to the next one, else zero.
    - `trial` (W,): the index of the trial.
    - `first` (W,): whether the window is the first of its trial.
    - `applies` (W, p): whether each parameter applies to the trial of the window.
    - `n_acting`: the maximum number of input samples that act within a window.
    """

    t: Float[Array, "W n_t"]
    measured: Float[Array, "W n_c n_t"]
    weight: Float[Array, "W n_c n_t"]
    t_input: Float[Array, "W n_in"]
    inputs: Float[Array, "W inputs n_in"]
    step: Float[Array, " W"]
    start: Float[Array, "W n"]
    next_start: Float[Array, "W n"]
    start_weight: Float[Array, "W n_c"]
    linked: Float[Array, " W"]
    trial: Int[Array, " W"]
    first: Bool[Array, " W"]
    applies: Bool[Array, "W p"]
    n_acting: int = eqx.field(static=True)

    def acting(self, delay: Array | float) -> tuple[Array, Array]:
        """The input samples of one window that act within it.

        Samples that act long before or after the window are excluded, because the computing time of a signal is
        proportional to its number of samples.

        **Arguments:**

        - `delay`: the delay [s].

        **Returns:** times with the delay (n,) [s] and samples (inputs, n).
        """
        times = self.t_input + delay
        if self.n_acting == times.shape[0]:
            return times, self.inputs
        # One step before the window, because a ramp (`Ramps`) begins one step before its discontinuity.
        first = jnp.maximum(jnp.searchsorted(times, self.t[0] - self.step, side="right") - 1, 0)
        chosen = (jax.lax.dynamic_slice_in_dim(x, first, self.n_acting, axis=-1) for x in (times, self.inputs))
        return tuple(chosen)  # type: ignore[return-value]

    @property
    def shape(self) -> Shape:
        (W, n_t), n_in = self.t.shape, self.t_input.shape[1]
        return Shape(W, n_t, n_in, self.n_acting)

    def of_rows(self, rows: np.ndarray) -> Windows:
        """The windows with the indices `rows` (m,): all windows of some trials. The trials are renumbered from zero."""
        own = jax.tree.map(lambda x: on_device(np.asarray(x)[rows]), self)
        _, trial = np.unique(np.asarray(own.trial), return_inverse=True)
        return dataclasses.replace(own, trial=on_device(trial, np.int32))

    def shortened(self, samples: np.ndarray, whole: np.ndarray) -> Windows:
        """The windows with only their first `samples` (W,), where `whole` (W,) is their number of samples."""
        t, keep, is_whole = np.asarray(self.t), samples[:, None], samples >= whole
        inside = np.arange(t.shape[1]) < keep  # (W, n_t)
        t = np.where(inside | is_whole[:, None], t, np.take_along_axis(t, keep - 1, axis=1))
        weight = np.where(inside[:, None, :], np.asarray(self.weight), 0)
        linked = np.where(is_whole, np.asarray(self.linked), 0)
        return dataclasses.replace(self, t=on_device(t), weight=on_device(weight), linked=on_device(linked))

    def starting_at_samples(self, trials: Sequence[Trial], channels: Sequence[str], names: Sequence[str]) -> Windows:
        """Use the first samples of these states as initial values instead of measurements, unless `initial` has them.

        Each trial must be one window.
        """
        is_start = np.array([[c in names and c not in trial.initial for c in channels] for trial in trials])  # (W, n_c)
        weight = np.array(self.weight)
        first = np.where(is_start, weight[:, :, 0], 0.0)
        weight[:, :, 0] -= first
        return dataclasses.replace(self, weight=on_device(weight), start_weight=on_device(first))

    def padded(self, shape: Shape) -> Windows:
        """Pad to a larger shape. Added samples have zero weight, and added windows end one sample after their start."""
        W, n_t = self.t.shape
        rows, places = np.minimum(np.arange(shape.windows), W - 1), np.minimum(np.arange(shape.samples), n_t - 1)
        added, spare = np.arange(shape.windows) >= W, np.arange(shape.samples) >= n_t
        own = jax.tree.map(lambda x: np.asarray(x)[rows], self)
        # The added input times must increase: `Samples` divides by the intervals between them.
        after = np.maximum(np.arange(shape.inputs) - own.t_input.shape[1] + 1, 0)  # samples behind the last
        inputs = np.minimum(np.arange(shape.inputs), own.t_input.shape[1] - 1)
        new = dataclasses.replace(
            own,
            t=np.where(added[:, None], own.t[:, np.minimum(places, 1)], own.t[:, places]),
            measured=own.measured[:, :, places],
            weight=np.where(spare, 0.0, own.weight[:, :, places]),
            t_input=own.t_input[:, inputs] + own.step[:, None] * after,
            inputs=own.inputs[:, :, inputs],
            n_acting=shape.acting,
        )
        return jax.tree.map(on_device, new)

    @property
    def by_trial(self) -> Array:
        """The windows of every trial (T, m), padded with W."""
        owner = np.asarray(self.trial)
        own = [np.flatnonzero(owner == k) for k in range(owner.max() + 1)]
        most = max(map(len, own))
        return on_device([np.append(i, np.full(most - len(i), len(owner))) for i in own], np.int32)


def cut(
    system: System,
    trials: Sequence[Trial],
    window: float | None,
    channels: Sequence[str],
    applies: np.ndarray,
    *,
    has_defects: bool = False,
    delay_range: DelayRange | None = None,
    step: float | None = None,
    guess: Mapping[str, float] | None = None,
    longest_delays: Mapping[str, float] | None = None,
    before: Mapping[str, float] | None = None,
) -> tuple[Windows, tuple[WindowSlice, ...]]:
    """Cut trials into windows.

    A last window shorter than half a window is joined to the one before. A single sample is joined to the following
    window.

    **Arguments:**

    - `system`: the `System`.
    - `trials`: the trials.
    - `window`: the length of a window [s]; None for one window per trial.
    - `channels`: names of the measured channels.
    - `applies`: whether each parameter applies to each trial (T, p).
    - `has_defects`: whether defects link the windows of a trial.
    - `delay_range`: the largest delay and advance of inputs [s]; None without delays.
    - `step`: the integration step [s]; by default the sample interval.
    - `guess`: by name, initial guesses other than zero for coordinates without data.
    - `longest_delays`: by input, its longest delay [s]; a trial starts after it.
    - `before`: by input, its value before the first sample.

    **Returns:** the windows, and the slice of each.
    """
    longest_delays, before = longest_delays or {}, before or {}
    firsts = [first_after(trial, longest_delays) for trial in trials]
    places = [(k, i, n) for k, trial in enumerate(trials) for i, n in _pieces(trial, window, has_defects, firsts[k])]
    if not has_defects:  # a window without measurements would only add unknowns
        places = [place for place in places if any(np.isfinite(_take(trials, place, c)).any() for c in channels)]
    linked = [
        has_defects and place[0] == after[0] for place, after in zip(places, [*places[1:], (-1, 0, 0)], strict=True)
    ]
    n_t = max(n + extra for (_, _, n), extra in zip(places, linked, strict=True))
    clocks = [_resolved(trial, system) for trial in trials]
    columns: dict[str, list[Any]] = {key: [] for key in ("t", "measured", "weight", "t_input", "inputs", "step")}
    spans: list[tuple[int, int]] = []  # the first sample of the inputs, and the end (exclusive)
    for (k, i, n), extra in zip(places, linked, strict=True):
        trial, last = trials[k], i + n - 1 + extra
        columns["t"].append(clocks[k][np.minimum(np.arange(i, i + n_t), last)])
        t, h = trial.t, _interval(trial.t[i : last + 1])
        # Not longer than the window, so that halving the step has an effect.
        h = h if step is None else min(step, t[last] - t[i])
        begin, stop = i, last + 1
        if delay_range is not None:
            begin = max(int(np.searchsorted(t, t[i] - delay_range[0] - h, side="right")) - 1, 0)
            stop = min(int(np.searchsorted(t, t[last] + delay_range[1] + h)) + 1, len(t))
        columns["step"].append(h)
        spans.append((begin - bool(before and begin == 0), stop))
        y = np.stack([_take(trials, (k, i, n), c) for c in channels])  # (n_c, n)
        sigma = np.stack([trial.sigma.get(c, np.ones_like(trial.t))[i : i + n] for c in channels])
        finite, padding = np.isfinite(y), ((0, 0), (0, n_t - n))
        columns["measured"].append(np.pad(np.where(finite, y, 0.0), padding))
        columns["weight"].append(np.pad(np.where(finite, 1.0 / sigma, 0.0), padding))
    n_in = max(stop - begin for begin, stop in spans)
    for (k, _, _), (begin, _), h in zip(places, spans, columns["step"], strict=True):
        trial, wanted = trials[k], np.arange(begin, begin + n_in)
        inside = np.clip(wanted, 0, len(trial.t) - 1)
        columns["t_input"].append(clocks[k][inside] + h * (wanted - inside))  # outside: the nearest sample
        rows = [trial.inputs.get(name, np.zeros_like(trial.t))[inside] for name in system.inputs]
        rows = [np.where(wanted < 0, before.get(name, x[0]), x) for name, x in zip(system.inputs, rows, strict=True)]
        columns["inputs"].append(np.array(rows).reshape(len(system.inputs), n_in))
    names, guess = state_names(system), guess or {}
    start = np.array([[_start(trials[k], i, n, name, guess.get(name, 0.0)) for name in names] for k, i, n in places])
    owner = np.array([k for k, _, _ in places])
    # One step on each side of a window, for the ramps that begin or end there.
    span = np.ptp(columns["t"], axis=1) + 2 * np.array(columns["step"])
    acting = []  # the maximum number of input samples within the longest window of a trial, one before and one after
    for k in set(owner.tolist()):
        t, lasts = trials[k].t, float(span[owner == k].max())
        acting.append(np.max(np.searchsorted(t, t + lasts * (1 + 1e-9), side="right") - np.arange(len(t))) + 2)
    windows = Windows(
        **{key: floats(value) for key, value in columns.items()},
        start=floats(start),
        next_start=floats(np.append(start[1:], start[-1:], axis=0)),
        start_weight=floats(np.zeros((len(places), len(channels)))),
        linked=floats(np.array(linked, float)),
        trial=on_device(owner, np.int32),
        first=on_device(np.append(True, owner[1:] != owner[:-1])),
        applies=on_device(applies[owner]),
        n_acting=min(n_in, int(max(acting))),
    )
    return windows, tuple(places)


def _interval(t: np.ndarray) -> float:
    """The sample interval [s] for the times t [s]: the mean if all intervals are equal within 1 %, else the median.

    The mean is used because of the rounding of the clock. With 1e5 POSIX times at 100 Hz, the error of the median adds
    up to 0.1 intervals over the trial.
    """
    intervals = np.diff(t)
    median = float(np.median(intervals))
    even = np.all(np.abs(intervals - median) <= 0.01 * median)
    return float(t[-1] - t[0]) / len(intervals) if even else median


def _resolved(trial: Trial, system: System) -> np.ndarray:
    """The times of a trial [s], relative to the first sample if the floating-point type of JAX cannot resolve them.

    **Raises:** `ValueError` if the system uses the time and the type cannot resolve it.
    """
    dtype = jnp.result_type(float)
    if not is_coarse(trial.t, dtype):
        return trial.t
    if reads_time(system, dtype):
        raise ValueError(
            f"{trial.name}: the times start at {trial.t[0]:.10g} s, and {dtype.name} cannot resolve the sample "
            f"intervals there. {type(system).__name__} may depend on the time. Use times that start near zero, or "
            "enable float64: jaxkane.configure()."
        )
    return trial.t - trial.t[0]


def state_names(system: System) -> tuple[str, ...]:
    """The names in an initial state: coordinates, independent speeds and first-order states."""
    return (*system.coordinates, *system.speeds, *system.states)


def state_sizes(system: System, trials: Sequence[Trial]) -> np.ndarray:
    """The size of each of `state_names` (n,), in its unit: half the range of its samples, or its initial value.

    A state without data has the smallest of the other sizes. If no state has data, all sizes are 1.
    """
    sizes = []
    for name in state_names(system):
        seen = [trial.measured[name] for trial in trials if name in trial.measured]
        seen = [y[np.isfinite(y)] for y in seen]
        ranges = [np.ptp(y) / 2 or np.max(np.abs(y)) for y in seen if y.size]
        sizes.append(max([0.0, *ranges, *(np.max(np.abs(t.initial[name])) for t in trials if name in t.initial)]))
    known = [size for size in sizes if size > 0]
    return np.array([size or min(known, default=1.0) for size in sizes])


def first_after(trial: Trial, longest_delays: Mapping[str, float]) -> int:
    """The index of the first sample at which all varying inputs are recorded, with their `longest_delays` [s].

    **Raises:** `ValueError` if fewer than two samples remain.
    """
    longest = max((lag for name, lag in longest_delays.items() if np.ptp(trial.inputs.get(name, 0.0)) > 0), default=0.0)
    # Without the tolerance, rounding would exclude a sample that is exactly `longest` after the first one.
    first = int(np.searchsorted(trial.t, trial.t[0] + longest * (1 - 1e-9)))
    if first > len(trial.t) - 2:
        raise ValueError(
            f"{trial.name}: its inputs may be delayed by {longest:g} s, and fewer than two samples are measured after "
            "that time. Pass narrower `bounds` of the `Delay`, or `before=`, the value of the input before the first "
            "sample."
        )
    return first


def _pieces(trial: Trial, window: float | None, has_defects: bool, first: int) -> list[tuple[int, int]]:
    """The first sample and the number of samples of every window of a trial, beginning at the sample `first`."""
    t = trial.t[first:]
    if window is None:
        return [(first, len(t))]
    # A sample at the end of a window belongs to the next window. The tolerance is needed for 0.1 + 0.2 == 0.3.
    number = np.floor((t - t[0]) / window + 1e-9).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(number) > 0))
    if len(starts) > 1 and (t[-1] - t[starts[-1]] < 0.5 * window or starts[-1] == len(t) - 1):
        starts = starts[:-1]
    if not has_defects:  # a window with one sample does not determine the motion, unless a defect links it
        between = np.median(np.diff(t))
        if window < between * (1 - 1e-9):
            raise ValueError(
                f"{trial.name}: the sample interval is {between:.6g} s, so a `window` of {window:.6g} s contains one "
                "sample, which does not determine a motion. Pass a longer `window`, or link the windows by "
                "`defect_std`."
            )
        kept = [0]  # a single sample is joined to the next window
        for start in starts[1:].tolist():
            if start - kept[-1] > 1 and start < len(t) - 1:
                kept.append(start)
        starts = np.array(kept)
    return [(first + int(i), int(n)) for i, n in zip(starts, np.diff(np.append(starts, len(t))), strict=True)]


def _take(trials: Sequence[Trial], place: WindowSlice, channel: str) -> np.ndarray:
    """Samples (n,) of one window; NaN if the trial does not have the channel."""
    k, i, n = place
    return trials[k].measured.get(channel, np.full_like(trials[k].t, np.nan))[i : i + n]


def check_starts(trials: Sequence[Trial], places: Sequence[WindowSlice], names: Sequence[str]) -> None:
    """Check that initial values that are not estimated are measured at the start of every window.

    **Raises:** `ValueError` if a sample is missing there: the simulation would start with a later sample.
    """
    for (k, i, _), name in itertools.product(places, names):
        trial = trials[k]
        samples = trial.measured.get(name)
        if samples is None or name in trial.initial or not np.isnan(samples[i]) or np.isnan(samples).all():
            continue
        raise ValueError(
            f"{trial.name}: {name} is not measured at t = {trial.t[i]:.6g} s, where a window starts. Add it to "
            "`unknown` to estimate its initial value, pass its value in `initial`, or cut the trial with `between`."
        )


def _start(trial: Trial, i: int, n: int, name: str, guess: float) -> float:
    """The initial value of a state in a window: from `initial`, else its first measurement, else the guess."""
    if name in trial.initial:
        return float(trial.initial[name][i])
    if name in trial.measured:
        samples = trial.measured[name][i : i + n]
        samples = samples[np.isfinite(samples)]
        if samples.size:
            return float(samples[0])
    return guess
