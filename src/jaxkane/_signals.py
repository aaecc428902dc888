"""Inputs over time: numbers, samples, functions and controllers behind one call. Knows time; knows no mechanics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._lookup import refuse_unknown
from ._types import Component, Inputs


class Samples(eqx.Module):
    """A signal given at times: linear between them, constant outside.

    Attributes: `ts` (n_t,) [s], `values` (n_t,).
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]

    def __call__(self, t: Component, state: Any = None) -> Component:
        # Comparing with every sample is one short vector operation; a bisection is a loop of many small kernels.
        i = jnp.clip(jnp.sum(self.ts <= t) - 1, 0, self.ts.shape[0] - 2)
        t0, t1, x0, x1 = self.ts[i], self.ts[i + 1], self.values[i], self.values[i + 1]
        return x0 + (x1 - x0) * jnp.clip((t - t0) / (t1 - t0), 0.0, 1.0)


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
    array = jnp.asarray(value, dtype=ts.dtype)
    if array.ndim == 0:
        return array
    if array.shape != ts.shape:
        raise ValueError(
            f"The samples of {name!r} have the shape {array.shape}, the times `ts` {ts.shape}: an array is taken at "
            "the times `ts`, linear between them. For other times pass a function (t, state) -> number, such as "
            "jaxkane.Samples(times, values)."
        )
    if isinstance(value, np.ndarray) and not np.all(np.isfinite(value)):
        raise ValueError(f"The samples of {name!r} are not all finite: fill the gaps, or leave that stretch out.")
    return Samples(ts, array)


def sample_times(signals: Any) -> Array | None:
    """All times at which some signal has a kink, in their order; None where there is none."""
    samples = [x for x in jax.tree.leaves(signals, is_leaf=lambda x: isinstance(x, Samples)) if isinstance(x, Samples)]
    distinct = {id(x.ts): x.ts for x in samples}
    return jnp.sort(jnp.concatenate(list(distinct.values()))) if distinct else None


def evaluate(signals: Any, t: Component, state: Any) -> dict[str, Component]:
    """The inputs' values at one time."""
    if callable(signals):
        values: Any = signals(t, state)
        return dict(values)
    return {name: signal(t, state) if callable(signal) else signal for name, signal in signals.items()}
