"""Inputs over time: numbers, samples, functions and controllers behind one call. Knows time; knows no mechanics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._common.lookup import refuse_unknown
from .._scalars.types import Component, Inputs


def real_array(value: Any, label: str, dtype: Any = None) -> Array:
    """Real numbers as a float array. **Raises:** `TypeError` for complex numbers, texts and the like; `ValueError` for
    a masked array, whose gaps would be filled with what stands under the mask."""
    if np.ma.is_masked(value):
        raise ValueError(f"{label}: some values are masked. Fill the gaps, or leave that stretch out.")
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    if array.dtype.kind not in "iufb" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(f"{label} must be real numbers, got {array.dtype}.")
    floating = jnp.issubdtype(array.dtype, jnp.floating)
    return jnp.asarray(array, dtype=dtype or (None if floating else float))


class Samples(eqx.Module):
    """A signal given at times: linear between them, constant outside; or held from each sample to the next.

        Samples(ts + delay, values, hold=True)

    Steps of error control end at the times, so that a motion is as exact as without kinks and jumps, and has its
    derivative by the times too: by a delay.

    Attributes: `ts` (n_t,) [s], `values` (n_t,); `hold`: whether each value lasts until the next.
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]
    hold: bool = eqx.field(static=True)

    def __init__(self, ts: Any, values: Any, hold: bool = False):
        if not isinstance(hold, bool):
            raise TypeError(f"Samples: `hold` is True or False, got {hold!r}.")
        self.hold = hold
        self.ts, self.values = (real_array(x, f"Samples: {label}") for x, label in ((ts, "ts"), (values, "values")))
        n, m = (x.shape[-1] if x.ndim else 0 for x in (self.ts, self.values))
        if n != m or n < 2:
            raise ValueError(f"Samples needs as many `values` as `ts`, two at least; got {m} and {n}.")
        if not isinstance(self.ts, Tracer) and not np.all(np.diff(np.asarray(self.ts)) > 0):
            raise ValueError("Samples: `ts` must increase and be finite.")
        for label, x in (("ts", self.ts), ("values", self.values)):
            if not isinstance(x, Tracer) and not np.all(np.isfinite(np.asarray(x))):
                raise ValueError(f"Samples: `{label}` are not all finite: fill the gaps, or leave that stretch out.")

    def __call__(self, t: Component, state: Any = None) -> Component:
        # Comparing with every sample is one short vector operation; a bisection is a loop of many small kernels.
        if self.hold:
            return self._held(t)
        i = jnp.clip(jnp.sum(self.ts <= t) - 1, 0, self.ts.shape[0] - 2)
        t0, t1, x0, x1 = self.ts[i], self.ts[i + 1], self.values[i], self.values[i + 1]
        # On a kink the derivative by a time is that of the right side; that of `jnp.clip` is the mean of both.
        w = (t - t0) / (t1 - t0)
        return x0 + (x1 - x0) * jnp.where(w >= 1.0, jnp.ones_like(w), jnp.where(w < 0.0, jnp.zeros_like(w), w))

    def _held(self, t: Component) -> Component:
        return self.values[jnp.clip(jnp.sum(self.ts <= t) - 1, 0, self.ts.shape[0] - 1)]


class _OnGrid(Samples):
    """Held samples for steps that end at them but for a rounding error: the end of a step is the beginning of the next
    sample, whichever way it was rounded."""

    def _held(self, t: Component) -> Component:
        return super()._held(t + 1e-4 * (self.ts[1] - self.ts[0]))


def as_signals(inputs: Inputs, names: Sequence[str], ts: Array, system_name: str) -> Any:
    """Inputs as `simulate` takes them: a dict of numbers and callables (t, state), or one callable that gives a dict.

    **Raises:** `ValueError` for an unknown name, or samples that do not fit `ts`.
    """
    if inputs is None:
        return {}
    if callable(inputs):
        return inputs
    if not isinstance(inputs, Mapping):
        raise TypeError(f"`inputs` is a dict by name or a function (t, state) -> dict, got {type(inputs).__name__}.")
    refuse_unknown(inputs, names, f"{system_name} has no input named", "it has")
    return {name: _as_signal(name, value, ts) for name, value in inputs.items()}


def _as_signal(name: str, value: Any, ts: Array) -> Any:
    if callable(value):
        return value
    array = real_array(value, f"The input {name!r}", ts.dtype)
    if array.ndim == 0:
        if not isinstance(array, Tracer) and not np.isfinite(float(array)):
            raise ValueError(f"The input {name!r} = {float(array)} is not finite.")
        return array
    if array.shape != ts.shape:
        raise ValueError(
            f"The samples of {name!r} have the shape {array.shape}, the times `ts` {ts.shape}: an array is taken at "
            "the times `ts`, linear between them. For other times pass a function (t, state) -> number, such as "
            "jaxkane.Samples(times, values)."
        )
    if not isinstance(array, Tracer) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError(f"The samples of {name!r} are not all finite: fill the gaps, or leave that stretch out.")
    return Samples(ts, array)


def samples_of(signals: Any) -> list[Samples]:
    """All signals that are samples."""
    return [x for x in jax.tree.leaves(signals, is_leaf=_is_samples) if _is_samples(x)]


def _is_samples(x: Any) -> bool:
    return isinstance(x, Samples)


class OneTimes(eqx.Module):
    """Signals whose samples share their times, fit to be an argument of a compiled program, in which arrays are no
    longer the same: `times` without repetition, and `signals` with a number in the place of their times."""

    times: tuple[Array, ...]
    signals: Any


def with_one_times(signals: Any) -> OneTimes:
    """To be undone by `with_own_times` where the program begins."""
    times: dict[int, Array] = {}

    def numbered(x: Any) -> Any:
        if not _is_samples(x):
            return x
        times.setdefault(id(x.ts), x.ts)
        return eqx.tree_at(lambda s: s.ts, x, list(times).index(id(x.ts)))

    signals = jax.tree.map(numbered, signals, is_leaf=_is_samples)
    return OneTimes(tuple(times.values()), signals)


def with_own_times(given: Any) -> Any:
    """Signals with their times, the same array where they share them."""
    if not isinstance(given, OneTimes):
        return given
    there = lambda x: eqx.tree_at(lambda s: s.ts, x, given.times[x.ts]) if _is_samples(x) else x  # noqa: E731
    return jax.tree.map(there, given.signals, is_leaf=_is_samples)


def sample_times(signals: Any, dtype: Any) -> tuple[Array, bool] | None:
    """All times at which some signal has a kink or a jump, in their order, and whether a step that begins at one of
    them needs a right-hand side of its own: behind a jump, and where two signals may have their kinks at one time and
    not together. None where there is none."""
    distinct = {id(x.ts): x.ts.astype(dtype) for x in samples_of(signals)}
    anew = len(distinct) > 1 or any(x.hold for x in samples_of(signals))
    return (jnp.sort(jnp.concatenate(list(distinct.values()))), anew) if distinct else None


def for_fixed_steps(signals: Any) -> Any:
    """Signals for steps of one length, which end where samples stand but for a rounding error."""
    on_grid = lambda x: _OnGrid(x.ts, x.values, True) if _is_samples(x) and x.hold else x  # noqa: E731
    return jax.tree.map(on_grid, signals, is_leaf=_is_samples)


def signals_are_sound(signals: Any) -> Array:
    """Whether all samples and numbers are finite, and the samples' times increase: what tracing kept from a check."""
    numbers = [x for x in jax.tree.leaves(_plain(signals)) if eqx.is_inexact_array(x)]
    finite = [jnp.all(jnp.isfinite(x)) for x in numbers]
    return jnp.all(jnp.stack([jnp.array(True), *finite, *(jnp.all(x.ts[1:] > x.ts[:-1]) for x in samples_of(signals))]))


def without_nonsense(signals: Any, valid: Array) -> Any:
    """The signals where they are valid, else others of the same shapes that spoil no derivative."""

    times: dict[int, Array] = {}  # signals that share their times go on sharing them: see `sample_times`

    def safe(x: Any) -> Any:
        if _is_samples(x):
            other = jnp.arange(x.ts.shape[0], dtype=x.ts.dtype)
            ts = times.setdefault(id(x.ts), jnp.where(valid, x.ts, other))
            return eqx.tree_at(lambda s: (s.ts, s.values), x, (ts, safe(x.values)))
        return jnp.where(valid, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x

    if callable(signals):
        return signals
    return {name: safe(x) if _is_samples(x) or not callable(x) else x for name, x in signals.items()}


def _plain(signals: Any) -> Any:
    """Samples and numbers, without what may be infinite with good reason: a controller's limits."""
    return {} if callable(signals) else {k: x for k, x in signals.items() if _is_samples(x) or not callable(x)}


def evaluate(signals: Any, t: Component, state: Any) -> dict[str, Component]:
    """The inputs' values at one time."""
    if callable(signals):
        values: Any = signals(t, state)
        return dict(values)
    return {name: signal(t, state) if callable(signal) else signal for name, signal in signals.items()}
