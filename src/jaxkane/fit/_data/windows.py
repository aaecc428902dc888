"""Trials cut into windows of one shape, with zero weight where there is nothing. Knows arrays; knows no dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._description.system import System
from .trial import Trial

LONGEST_DELAY = 0.5
"""How far before and after a window samples of its inputs are kept where there are delays [s]."""

Place = tuple[int, int, int]
"""Of a window: trial, first sample, number of samples."""


class Windows(eqx.Module):
    """All windows of all trials, stacked; a short one repeats its last time with weight zero.

    - `t` (W, n_t) [s]; where windows are chained, the last is the next window's first.
    - `measured`, `weight` (W, n_c, n_t): samples, and 1/sigma or zero.
    - `t_input` (W, n_in) [s], `inputs` (W, inputs, n_in): samples of the inputs, from before and after too.
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

    @property
    def by_trial(self) -> Array:
        """The windows of every trial (T, m), padded with W."""
        owner = np.asarray(self.trial)
        own = [np.flatnonzero(owner == k) for k in range(owner.max() + 1)]
        most = max(map(len, own))
        return jnp.asarray([np.append(i, np.full(most - len(i), len(owner))) for i in own], dtype=jnp.int32)


def cut(
    system: System,
    trials: Sequence[Trial],
    window: float | None,
    channels: Sequence[str],
    *,
    chained: bool = False,
    delayed: bool = False,
    guess: Mapping[str, float] | None = None,
) -> tuple[Windows, tuple[Place, ...]]:
    """Windows of `window` [s], or one a trial; and the place of each.

    A last piece shorter than half a window is joined to the one before. `guess`: by name, where coordinates start of
    which nothing is known, if not at zero.
    """
    places = [(k, i, n) for k, trial in enumerate(trials) for i, n in _pieces(trial.t, window, chained)]
    if not chained:  # a window without one measurement would only add unknowns
        places = [place for place in places if any(np.isfinite(_take(trials, place, c)).any() for c in channels)]
    linked = [chained and place[0] == after[0] for place, after in zip(places, [*places[1:], (-1, 0, 0)], strict=True)]
    n_t = max(n + more for (_, _, n), more in zip(places, linked, strict=True))
    lead = _lead(trials) if delayed else 0
    found: dict[str, list[np.ndarray]] = {key: [] for key in ("t", "measured", "weight", "t_input", "inputs", "step")}
    for (k, i, n), more in zip(places, linked, strict=True):
        trial, last = trials[k], i + n - 1 + more
        found["t"].append(trial.t[np.minimum(np.arange(i, i + n_t), last)])
        found["step"].append(np.median(np.diff(trial.t[i : last + 1])))
        y = np.stack([_take(trials, (k, i, n), c) for c in channels])  # (n_c, n)
        sigma = np.stack([trial.sigma.get(c, np.ones_like(trial.t))[i : i + n] for c in channels])
        seen = np.isfinite(y)
        found["measured"].append(_fill(np.where(seen, y, 0.0), n_t))
        found["weight"].append(_fill(np.where(seen, 1.0 / sigma, 0.0), n_t))
        wanted = np.arange(i - lead, i + n_t + lead)
        there = np.clip(wanted, 0, len(trial.t) - 1)
        # What lies outside is never far, and takes the trial's first or last sample.
        found["t_input"].append(trial.t[there] + found["step"][-1] * (wanted - there))
        rows = [trial.inputs.get(name, np.zeros_like(trial.t))[there] for name in system.inputs]
        found["inputs"].append(np.array(rows).reshape(len(system.inputs), len(wanted)))
    names = state_names(system)
    guesses = [(guess or {}).get(name, 0.0) for name in names]
    pairs = tuple(zip(names, guesses, strict=True))
    start = np.array([[_start(trials[k], i, n, *pair) for pair in pairs] for k, i, n in places])
    owner = np.array([k for k, _, _ in places])
    array = lambda x: jnp.asarray(np.array(x), dtype=jnp.result_type(float))  # noqa: E731
    windows = Windows(
        **{key: array(value) for key, value in found.items()},
        start=array(start),
        next_start=array(np.append(start[1:], start[-1:], axis=0)),
        linked=array(np.array(linked, float)),
        trial=jnp.asarray(owner, dtype=jnp.int32),
        first=jnp.asarray(np.append(True, owner[1:] != owner[:-1])),
        very_first=jnp.asarray(np.arange(len(owner)) == 0),
    )
    return windows, tuple(places)


def state_names(system: System) -> tuple[str, ...]:
    """Of what a motion starts with: coordinates, independent speeds and states of the first order."""
    return (*system.coordinates, *system.speeds, *system.states)


def _pieces(t: np.ndarray, window: float | None, chained: bool) -> list[tuple[int, int]]:
    """First sample and number of samples of every window of a trial."""
    if window is None:
        return [(0, len(t))]
    # A sample at the end of a window belongs to the next; a little slack lets 0.1 + 0.2 be 0.3.
    number = np.floor((t - t[0]) / window + 1e-9).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(number) > 0))
    sizes = np.diff(np.append(starts, len(t)))
    pieces = [(int(i), int(n)) for i, n in zip(starts, sizes, strict=True)]
    if len(pieces) > 1 and (t[-1] - t[pieces[-1][0]] < 0.5 * window or pieces[-1][1] < 2):
        (i, n), (_, m) = pieces[-2:]
        pieces[-2:] = [(i, n + m)]
    # One sample says nothing about motion, unless the next window goes on from it.
    return [(i, n) for i, n in pieces if n > 1 or chained]


def _lead(trials: Sequence[Trial]) -> int:
    return max(int(np.ceil(LONGEST_DELAY / np.median(np.diff(trial.t)))) for trial in trials)


def _take(trials: Sequence[Trial], place: Place, channel: str) -> np.ndarray:
    """Samples (n,) of one window, NaN where the trial has no such channel."""
    k, i, n = place
    return trials[k].measured.get(channel, np.full_like(trials[k].t, np.nan))[i : i + n]


def _fill(rows: np.ndarray, n_t: int) -> np.ndarray:
    """(n, some) to (n, n_t) by zeros."""
    return np.pad(rows, ((0, 0), (0, n_t - rows.shape[1])))


def _start(trial: Trial, i: int, n: int, name: str, guess: float) -> float:
    """What is known of a coordinate or speed where a window starts, else its first measurement there, else a guess."""
    if name in trial.initial:
        return float(trial.initial[name][i])
    if name in trial.measured:
        seen = trial.measured[name][i : i + n]
        seen = seen[np.isfinite(seen)]
        if seen.size:
            return float(seen[0])
    return guess
