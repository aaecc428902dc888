"""Trials cut into windows of one shape, with zero weight where there is nothing. Knows arrays; knows no dynamics."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._system import System
from ._trial import Trial


class Windows(eqx.Module):
    """All windows of all trials, stacked; a short one repeats its last time with weight zero.

    - `t` (W, n_t) [s]; `t_input` (W, n_t) [s]: the same, but increasing where it is filled up.
    - `measured`, `weight` (W, n_c, n_t): samples, and 1/sigma or zero. `inputs` (W, n_in, n_t).
    - `q`, `u` (W, n_q), (W, n_u): the start as far as it is known or measured.
    - `trial` (W,): whose window it is; `first` (W,): whether it is its trial's first, `very_first` of all.
    """

    t: Float[Array, "W n_t"]
    t_input: Float[Array, "W n_t"]
    measured: Float[Array, "W n_c n_t"]
    weight: Float[Array, "W n_c n_t"]
    inputs: Float[Array, "W n_in n_t"]
    q: Float[Array, "W n_q"]
    u: Float[Array, "W n_u"]
    trial: Int[Array, " W"]
    first: Bool[Array, " W"]
    very_first: Bool[Array, " W"]


def cut(
    system: System, trials: Sequence[Trial], window: float | None, channels: Sequence[str], dtype: np.dtype
) -> tuple[Windows, tuple[tuple[int, int, int], ...]]:
    """Windows of `window` [s], or one a trial; and for each (trial, first sample, number of samples).

    A last piece shorter than half a window is joined to the one before.
    """
    places = [(k, start, n) for k, trial in enumerate(trials) for start, n in _pieces(trial.t, window)]
    # A window without one measurement would only add unknowns.
    places = [place for place in places if any(np.isfinite(_take(trials, place, c)).any() for c in channels)]
    n_t = max(n for _, _, n in places)
    stacked: dict[str, list[np.ndarray]] = {key: [] for key in ("t", "t_input", "measured", "weight", "inputs")}
    starts = []
    for k, i, n in places:
        trial, inside, more = trials[k], slice(i, i + n), n_t - n
        t = trial.t[inside]
        step = t[-1] - t[-2]
        stacked["t"].append(np.append(t, np.full(more, t[-1])))
        stacked["t_input"].append(np.append(t, t[-1] + step * np.arange(1, more + 1)))
        y = np.stack([_take(trials, (k, i, n), c) for c in channels])  # (n_c, n)
        sigma = np.stack([trial.sigma.get(c, np.ones_like(trial.t))[inside] for c in channels])
        seen = np.isfinite(y)
        stacked["measured"].append(_fill(np.where(seen, y, 0.0), more))
        stacked["weight"].append(_fill(np.where(seen, 1.0 / sigma, 0.0), more, last=False))
        rows = [trial.inputs.get(name, np.zeros_like(trial.t))[inside] for name in system.inputs]
        stacked["inputs"].append(_fill(np.array(rows).reshape(len(system.inputs), n), more))
        starts.append([[_start(trial, i, n, name) for name in group] for group in (system.coordinates, system.speeds)])
    owner = np.array([k for k, _, _ in places])
    first = np.append(True, owner[1:] != owner[:-1])
    array = lambda x: jnp.asarray(np.array(x), dtype=dtype)  # noqa: E731
    windows = Windows(
        **{key: array(value) for key, value in stacked.items()},
        q=array([q for q, _ in starts]),
        u=array([u for _, u in starts]),
        trial=jnp.asarray(owner, dtype=jnp.int32),
        first=jnp.asarray(first),
        very_first=jnp.asarray(np.arange(len(owner)) == 0),
    )
    return windows, tuple(places)


def _pieces(t: np.ndarray, window: float | None) -> list[tuple[int, int]]:
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
    # One sample tells nothing about motion.
    return [(i, n) for i, n in pieces if n > 1]


def _take(trials: Sequence[Trial], place: tuple[int, int, int], channel: str) -> np.ndarray:
    """Samples (n,) of one window, NaN where the trial has no such channel."""
    k, i, n = place
    return trials[k].measured.get(channel, np.full_like(trials[k].t, np.nan))[i : i + n]


def _fill(rows: np.ndarray, more: int, last: bool = True) -> np.ndarray:
    """(n, n_t - more) to (n, n_t), by the last value or by zeros."""
    return np.pad(rows, ((0, 0), (0, more)), mode="edge" if last else "constant") if more else rows


def _start(trial: Trial, i: int, n: int, name: str) -> float:
    """What is known of a coordinate or speed where a window starts, else its first measurement there, else zero."""
    if name in trial.initial:
        return float(trial.initial[name][i])
    if name in trial.measured:
        seen = trial.measured[name][i : i + n]
        seen = seen[np.isfinite(seen)]
        if seen.size:
            return float(seen[0])
    return 0.0
