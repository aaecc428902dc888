"""Trials cut into windows of one shape, with zero weight where there is nothing. Knows arrays; knows no dynamics."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._scalarjit.compat import on_device
from .._system.system import System
from ._trial import Trial

Reach = tuple[float, float]
"""By how much inputs may act late and early [s]."""

WindowSlice = tuple[int, int, int]
"""Of a window: trial, first sample, number of samples."""


class Shape(NamedTuple):
    """Numbers of windows, of samples, of samples of the inputs, and of those that act within a window."""

    windows: int
    samples: int
    inputs: int
    acting: int

    def holds(self, other: Shape) -> bool:
        return all(a >= b for a, b in zip(self, other, strict=True))


class Windows(eqx.Module):
    """All windows of all trials, stacked; a short one repeats its last time with weight zero.

    - `t` (W, n_t) [s]; where windows are has_defects, the last is the next window's first.
    - `measured`, `weight` (W, n_c, n_t): samples, and 1/sigma or zero.
    - `t_input` (W, n_in) [s], `inputs` (W, inputs, n_in): samples of the inputs, from before and after too where they
      are delayed. At most `n_acting` of them act within a window.
    - `step` (W,) [s]: of the integration. `start`, `next_start` (W, n_q + n_u + n_x): the start as far as it is known
        or measured, and that of the next window.
    - `linked` (W,): one where the next window goes on from this one, else zero.
    - `trial` (W,): whose window it is; `first` (W,): whether it is its trial's first, `very_first` of all.
    """

    t: Float[Array, "W n_t"]
    measured: Float[Array, "W n_c n_t"]
    weight: Float[Array, "W n_c n_t"]
    t_input: Float[Array, "W n_in"]
    inputs: Float[Array, "W inputs n_in"]
    step: Float[Array, " W"]
    start: Float[Array, "W n"]
    next_start: Float[Array, "W n"]
    linked: Float[Array, " W"]
    trial: Int[Array, " W"]
    first: Bool[Array, " W"]
    very_first: Bool[Array, " W"]
    n_acting: int = eqx.field(static=True)

    def acting(self, delay: Array | float) -> tuple[Array, Array]:
        """Of one window: the times (n,) [s] at which samples act that are late by `delay` [s], and samples (inputs, n).

        What acts long before or after the window is left out: a signal costs as much as it has samples.
        """
        times = self.t_input + delay
        if self.n_acting == times.shape[0]:
            return times, self.inputs
        first = jnp.maximum(jnp.searchsorted(times, self.t[0] - self.step, side="right") - 1, 0)
        chosen = lambda x: jax.lax.dynamic_slice_in_dim(x, first, self.n_acting, axis=-1)  # noqa: E731
        return chosen(times), chosen(self.inputs)

    @property
    def shape(self) -> Shape:
        (W, n_t), n_in = self.t.shape, self.t_input.shape[1]
        return Shape(W, n_t, n_in, self.n_acting)

    def where(self, counts: np.ndarray) -> Windows:
        """The same, in which only the measurements and links of some (W,) count."""
        weight = np.where(counts[:, None, None], np.asarray(self.weight), 0)
        linked = np.where(counts, np.asarray(self.linked), 0)
        return dataclasses.replace(self, weight=on_device(weight), linked=on_device(linked))

    def of_one_trial(self, rows: np.ndarray, counts: np.ndarray) -> Windows:
        """Those in these `rows` (m,), windows of one trial, of which only some (m,) count."""
        own = jax.tree.map(lambda x: on_device(np.asarray(x)[rows]), self).where(counts)
        first, very_first = (on_device(np.asarray(x) & counts) for x in (own.first, own.very_first))
        trial = on_device(np.zeros(len(rows)), np.int32)
        return dataclasses.replace(own, trial=trial, first=first, very_first=very_first)

    def shortened(self, samples: np.ndarray, whole: np.ndarray) -> Windows:
        """Of windows of `whole` (W,) samples only the first `samples` (W,)."""
        t, keep, is_whole = np.asarray(self.t), samples[:, None], samples >= whole
        inside = np.arange(t.shape[1]) < keep  # (W, n_t)
        t = np.where(inside | is_whole[:, None], t, np.take_along_axis(t, keep - 1, axis=1))
        weight = np.where(inside[:, None, :], np.asarray(self.weight), 0)
        linked = np.where(is_whole, np.asarray(self.linked), 0)
        return dataclasses.replace(self, t=on_device(t), weight=on_device(weight), linked=on_device(linked))

    def padded(self, shape: Shape) -> Windows:
        """With more samples, which count nothing, and more windows, which end one sample after their start."""
        W, n_t = self.t.shape
        rows, places = np.minimum(np.arange(shape.windows), W - 1), np.minimum(np.arange(shape.samples), n_t - 1)
        added, spare = np.arange(shape.windows) >= W, np.arange(shape.samples) >= n_t
        own = jax.tree.map(lambda x: np.asarray(x)[rows], self)
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
    *,
    has_defects: bool = False,
    reach: Reach | None = None,
    step: float | None = None,
    guess: Mapping[str, float] | None = None,
) -> tuple[Windows, tuple[WindowSlice, ...]]:
    """Windows of `window` [s], or one a trial; and the place of each.

    A last piece shorter than half a window is joined to the one before, a lone sample to what follows. `reach`: of
    delays, None where there are none. `step` [s]: of the integration, by default that of the samples. `guess`: by name,
    where coordinates start of which nothing is known, if not at zero.
    """
    places = [(k, i, n) for k, trial in enumerate(trials) for i, n in _pieces(trial, window, has_defects)]
    if not has_defects:  # a window without one measurement would only add unknowns
        places = [place for place in places if any(np.isfinite(_take(trials, place, c)).any() for c in channels)]
    linked = [
        has_defects and place[0] == after[0] for place, after in zip(places, [*places[1:], (-1, 0, 0)], strict=True)
    ]
    n_t = max(n + extra for (_, _, n), extra in zip(places, linked, strict=True))
    columns: dict[str, list[np.ndarray]] = {key: [] for key in ("t", "measured", "weight", "t_input", "inputs", "step")}
    spans: list[tuple[int, int]] = []  # the first sample of the inputs, and the one behind the last
    for (k, i, n), extra in zip(places, linked, strict=True):
        trial, last = trials[k], i + n - 1 + extra
        columns["t"].append(trial.t[np.minimum(np.arange(i, i + n_t), last)])
        between, lasts = np.median(np.diff(trial.t[i : last + 1])), trial.t[last] - trial.t[i]
        columns["step"].append(between if step is None else min(step, lasts))  # no longer, so that it can be halved
        spans.append((i, last + 1) if reach is None else _reached(trial.t, i, last, reach, float(columns["step"][-1])))
        y = np.stack([_take(trials, (k, i, n), c) for c in channels])  # (n_c, n)
        sigma = np.stack([trial.sigma.get(c, np.ones_like(trial.t))[i : i + n] for c in channels])
        finite = np.isfinite(y)
        columns["measured"].append(_fill(np.where(finite, y, 0.0), n_t))
        columns["weight"].append(_fill(np.where(finite, 1.0 / sigma, 0.0), n_t))
    n_in = max(stop - begin for begin, stop in spans)
    for (k, _, _), (begin, _), h in zip(places, spans, columns["step"], strict=True):
        trial, wanted = trials[k], np.arange(begin, begin + n_in)
        inside = np.minimum(wanted, len(trial.t) - 1)
        columns["t_input"].append(trial.t[inside] + h * (wanted - inside))  # what lies outside takes the last sample
        rows = [trial.inputs.get(name, np.zeros_like(trial.t))[inside] for name in system.inputs]
        columns["inputs"].append(np.array(rows).reshape(len(system.inputs), n_in))
    names = state_names(system)
    guesses = [(guess or {}).get(name, 0.0) for name in names]
    pairs = tuple(zip(names, guesses, strict=True))
    start = np.array([[_start(trials[k], i, n, *pair) for pair in pairs] for k, i, n in places])
    owner = np.array([k for k, _, _ in places])
    span = np.ptp(columns["t"], axis=1) + 2 * np.array(columns["step"])
    longest = {k: span[owner == k].max() for k in owner.tolist()}
    array = lambda x: on_device(x, jnp.result_type(float))  # noqa: E731
    windows = Windows(
        **{key: array(value) for key, value in columns.items()},
        start=array(start),
        next_start=array(np.append(start[1:], start[-1:], axis=0)),
        linked=array(np.array(linked, float)),
        trial=on_device(owner, np.int32),
        first=on_device(np.append(True, owner[1:] != owner[:-1])),
        very_first=on_device(np.arange(len(owner)) == 0),
        n_acting=min(n_in, max(_most_within(trials[k].t, lasts) for k, lasts in longest.items())),
    )
    return windows, tuple(places)


def state_names(system: System) -> tuple[str, ...]:
    """Of what a motion starts with: coordinates, independent speeds and states of the first order."""
    return (*system.coordinates, *system.speeds, *system.states)


def _pieces(trial: Trial, window: float | None, has_defects: bool) -> list[tuple[int, int]]:
    """First sample and number of samples of every window of a trial."""
    t = trial.t
    if window is None:
        return [(0, len(t))]
    # A sample at the end of a window belongs to the next; a little slack lets 0.1 + 0.2 be 0.3.
    number = np.floor((t - t[0]) / window + 1e-9).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(number) > 0))
    if len(starts) > 1 and (t[-1] - t[starts[-1]] < 0.5 * window or starts[-1] == len(t) - 1):
        starts = starts[:-1]
    if not has_defects:  # one sample says nothing about motion, unless the next window goes on from it
        between = np.median(np.diff(t))
        if window < between * (1 - 1e-9):
            raise ValueError(
                f"{trial.name}: its times are {between:.6g} s apart, so a `window` of {window:.6g} s holds one sample, "
                "from which no motion follows. Give a longer one, or bind the windows together by `defect_std`."
            )
        starts = np.array(_without_lone(starts.tolist(), len(t)))
    return [(int(i), int(n)) for i, n in zip(starts, np.diff(np.append(starts, len(t))), strict=True)]


def _without_lone(starts: list[int], n: int) -> list[int]:
    """Where windows begin, of which each has two samples at least: one alone is joined to what follows."""
    kept = [0]
    for start in starts[1:]:
        if start - kept[-1] > 1 and start < n - 1:
            kept.append(start)
    return kept


def _reached(t: np.ndarray, i: int, last: int, reach: Reach, step: float) -> tuple[int, int]:
    """The first of a trial's samples that may act within a window, and the one behind the last."""
    late, early = reach
    begin = np.searchsorted(t, t[i] - late - step, side="right") - 1
    stop = np.searchsorted(t, t[last] + early + step) + 1
    return max(int(begin), 0), min(int(stop), len(t))


def _most_within(t: np.ndarray, lasts: float) -> int:
    """How many samples act within a time [s] that may begin anywhere, with the last before it and the first after."""
    return int(np.max(np.searchsorted(t, t + lasts * (1 + 1e-9), side="right") - np.arange(len(t)))) + 2


def _take(trials: Sequence[Trial], place: WindowSlice, channel: str) -> np.ndarray:
    """Samples (n,) of one window, NaN where the trial has no such channel."""
    k, i, n = place
    return trials[k].measured.get(channel, np.full_like(trials[k].t, np.nan))[i : i + n]


def _fill(rows: np.ndarray, n_t: int) -> np.ndarray:
    """(n, some) to (n, n_t) by zeros."""
    return np.pad(rows, ((0, 0), (0, n_t - rows.shape[1])))


def check_starts(trials: Sequence[Trial], places: Sequence[WindowSlice], names: Sequence[str]) -> None:
    """**Raises:** `ValueError` where one of the names, which are not estimated, is measured later than a window starts:
    the motion would begin with a value of another time."""
    for (k, i, _), name in itertools.product(places, names):
        trial = trials[k]
        samples = trial.measured.get(name)
        if samples is None or name in trial.initial or not np.isnan(samples[i]) or np.isnan(samples).all():
            continue
        raise ValueError(
            f"{trial.name}: {name} is not measured at t = {trial.t[i]:.6g} s, where a window starts. Name it in "
            "`unknown`, to have its start estimated; give what is known of it in `initial`; or cut the trial with "
            "`between`."
        )


def _start(trial: Trial, i: int, n: int, name: str, guess: float) -> float:
    """What is known of a coordinate or speed where a window starts, else its first measurement there, else a guess."""
    if name in trial.initial:
        return float(trial.initial[name][i])
    if name in trial.measured:
        samples = trial.measured[name][i : i + n]
        samples = samples[np.isfinite(samples)]
        if samples.size:
            return float(samples[0])
    return guess
