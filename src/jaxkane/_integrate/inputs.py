"""Inputs over time: numbers, samples, functions and controllers with one interface."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from .._common.lookup import by_name, refuse_unknown
from .._kane.arguments import checked_inputs, is_numeric
from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import Tracer, on_device
from .._scalarjit.components import Component, Inputs, Numbers
from .._scalarjit.nan import nan_derivative_where
from .._system.parameters import concrete_numbers, module_text
from .._system.system import State, System, explain_value_of_traced, names_of

Coordinates: TypeAlias = Float[Array, " n_q"]
"""Coordinates at one time."""

Speeds: TypeAlias = Float[Array, " n_u"]
"""Independent speeds at one time, or their rates."""

Signals: TypeAlias = dict[str, Any] | Callable[..., Any]
"""Inputs as from `as_signals`: numbers, `Samples` and functions of (t, state) by name; or a function of all."""


def real_array(value: Numbers, label: str, dtype: DTypeLike | None = None) -> Array:
    """Real numbers as a float array.

    **Raises:** `TypeError` for complex numbers, booleans, text and other types; `ValueError` for a masked array,
    because its masked values would be used.
    """
    if np.ma.is_masked(value):
        raise ValueError(f"{label}: some values are masked. Fill the gaps, or cut the record there.")
    if not is_numeric(value):
        raise TypeError(f"{label} must be real numbers, got {value!r}.")
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    floating = jnp.issubdtype(array.dtype, jnp.floating)
    return jnp.asarray(array, dtype=dtype or (None if floating else float))


class Samples(eqx.Module):
    """A signal from samples: linear between them and constant outside, or a zero-order hold.

        Samples(ts + delay, values, zero_order_hold=True)

    With error control, steps end at the samples. The simulation is as accurate as without discontinuities, and
    derivatives with respect to the times (a delay) are exact. The same is true if a function of (t, state) calls the
    samples at t or at t - delay. With more than 8192 linear samples, steps may skip samples where the signal is smooth
    within `rtol`. For a table over another quantity than time, use `jnp.interp`.

    Attributes:

    - `ts` (n_t,): increasing times [s], on the clock of the simulation.
    - `values` (n_t,): the signal at these times.
    - `zero_order_hold`: keep each value until the next sample, instead of linear interpolation.
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]
    zero_order_hold: bool = eqx.field(static=True)

    def __init__(self, ts: Numbers, values: Numbers, zero_order_hold: bool = False):
        if not isinstance(zero_order_hold, bool):
            raise TypeError(f"Samples: `zero_order_hold` must be True or False, got {zero_order_hold!r}.")
        self.zero_order_hold = zero_order_hold
        self.ts, self.values = time_array(ts, "Samples: ts"), real_array(values, "Samples: values")
        n, m = (x.shape[-1] if x.ndim else 0 for x in (self.ts, self.values))
        if n != m or n < 2:
            raise ValueError(f"Samples: `ts` and `values` must have the same length of at least two; got {n} and {m}.")
        if not isinstance(self.ts, Tracer) and not np.all(np.diff(np.asarray(self.ts)) > 0):
            raise ValueError("Samples: `ts` must increase and be finite.")
        check_finite("Samples: `ts`", self.ts)
        check_finite("Samples: `values`", self.values)

    def __repr__(self) -> str:
        ts, values = concrete_numbers(self.ts), concrete_numbers(self.values)
        if ts is None or values is None or ts.ndim > 1:
            return module_text(self, ndim=0)
        kind = "zero-order hold" if self.zero_order_hold else "linear"
        size = f"{values.min():.6g} to {values.max():.6g}"
        return f"Samples({len(ts)} values from {size}, at {ts[0]:.6g} to {ts[-1]:.6g} s, {kind})"

    def __call__(self, t: Component, state: State | InputState | None = None) -> Component:
        return self.piece(t, t)

    def piece(self, t: Component, at: Component) -> Component:
        """The value at `t` of the piece of the signal that contains the time `at`.

        At both ends of an integration step, the solver uses the piece inside the step and not the neighbouring pieces.
        """
        ts, values = jnp.asarray(self.ts), jnp.asarray(self.values)
        if self.zero_order_hold:
            return _entries(values, _INTERVALS["zero-order hold"](ts, at))
        i = _INTERVALS["linear"](ts, at)
        t0, t1, x0, x1 = _entries(ts, i), _entries(ts, i + 1), _entries(values, i), _entries(values, i + 1)
        w = (t - t0) / (t1 - t0)
        # Constant outside. Not `jnp.clip`, whose derivative at a sample is the mean of both sides.
        at = jax.lax.stop_gradient(jnp.asarray(at, ts.dtype))
        w = jnp.where(at >= ts[-1], jnp.ones_like(w), jnp.where(at < ts[0], jnp.zeros_like(w), w))
        return x0 + (x1 - x0) * w


def check_finite(label: str, values: Array) -> None:
    if not isinstance(values, Tracer) and not np.all(np.isfinite(np.asarray(values))):
        raise ValueError(f"{label} contains values that are not finite: fill the gaps, or cut the record there.")


_FEW = 8192  # up to here, comparing with all samples (one vector operation) is faster than bisection (a loop)


def _count(ts: Array, t: Array) -> Array:
    # Above this size use bisection: comparisons need memory for each sample at each time.
    if ts.size * t.size <= _FEW:
        shape = (*t.shape, ts.size)
        until = jnp.broadcast_to(ts, shape) <= jnp.broadcast_to(t[..., None], shape)
        return jnp.sum(until, axis=-1, dtype=jnp.int32)
    if not _is_long(ts, t):
        return jnp.searchsorted(ts, t, side="right")

    def halved(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) // 2
        after = t < _entries(ts, middle)
        return jnp.where(after, low, middle), jnp.where(after, middle, high)

    low = jnp.full(t.shape, -1, jnp.int32)
    return 1 + jax.lax.fori_loop(0, ts.size.bit_length(), halved, (low, jnp.full_like(low, ts.size)))[0]


_LONG = 32768  # entries, from which XLA runs each gather on the CPU in two threads


def _is_long(x: Array, i: Array) -> bool:
    return x.size >= _LONG and i.ndim == 1 and i.size <= 16


def _entries(x: Array, i: Array) -> Array:
    # x[i].
    #
    # A few entries of a long array are read one by one. XLA takes a gather from 512 kB for large work, although it
    # reads four numbers. Starting two threads for it in every step made a fit of 1e5 samples four times slower.
    return jnp.stack([x[i[k]] for k in range(i.size)]) if _is_long(x, i) else x[i]


@jax.custom_batching.custom_vmap
def count_until(ts: Array, t: Array) -> Array:
    """The number of times in `ts` (n_t,) that are not later than t, of any shape."""
    return _count(ts, t)


@count_until.def_vmap
def _(size: int, is_batched: Sequence[bool], ts: Array, t: Array) -> tuple[Array, bool]:
    if is_batched[0]:
        return jax.vmap(_count, (0, 0 if is_batched[1] else None))(ts, t), True
    return count_until(ts, t), True


def _interval(kind: str) -> Any:
    # The index of the interval of samples that contains a time. `_trace_calls` identifies this function by name.

    def index(ts: Array, t: Component) -> Array:
        ts, at = jax.lax.stop_gradient((ts, jnp.asarray(t, ts.dtype)))
        return jnp.clip(count_until(ts, at) - 1, 0, ts.shape[0] - (2 if kind == "linear" else 1))

    index.__name__ = index.__qualname__ = INTERVAL_OF + kind
    return jax.jit(index)


INTERVAL_OF = "interval of samples, "
_INTERVALS = {kind: _interval(kind) for kind in ("linear", "zero-order hold")}


class InputState(eqx.Module):
    """The state that an input function receives: `state.q`, `state.u`, `state.x`, and each value by its name."""

    q: Array
    u: Array
    x: Array | None
    t: Any
    system: System

    def __getitem__(self, name: str) -> Component:
        system, u_dep = self.system, None
        if name in system.dependent_speeds:
            u_dep = jnp.stack([jnp.asarray(x) for x in KaneEquations(system, self.t, self.q, self.u).u_dep])
        groups = zip(names_of(system), (self.q, self.u, u_dep, self.x), strict=True)
        return by_name(name, groups, {}, "the state")


def inputs_at(
    system: System,
    signals: Signals,
    t: Component,
    state: State,
    *,
    at: Component | None = None,
    now: Component | None = None,
    all_of_them: bool = False,
) -> dict[str, Component]:
    """The inputs by name, at one time.

    **Arguments:**

    - `signals`: as from `as_signals`.
    - `t`: time [s], on the clock of the samples among the signals.
    - `at`: the time that selects the piece of a sampled signal, by default `t` (see `Samples.piece`).
    - `now`: the time that functions receive, by default `t`.
    - `all_of_them`: also return the inputs that are not among the signals. These are zero.
    """
    at, now = (t if x is None else x for x in (at, now))
    context = InputState(state.q, state.u, state.x, now, system)
    if callable(signals):
        values: Any = called(CONTROLLER, signals, now, context)
        if not isinstance(values, Mapping):
            raise TypeError(f"{CONTROLLER} must return a dict by name, got {values!r}.")
    else:
        values = {
            name: f.piece(t, at)
            if is_samples(f)
            else called(f"The input {name!r}", f, now, context)
            if callable(f)
            else f
            for name, f in signals.items()
        }
    names = checked_inputs(system, values)
    return {
        name: jnp.asarray(values.get(name, 0.0), dtype=state.q.dtype) for name in (names if all_of_them else values)
    }


def inside(
    t: Array, within: tuple[Array, Array], origin: Component = 0.0, share: float = 0.0, past_end: bool = False
) -> Array:
    """A time in a step, at least a few rounding errors of `origin + t` away from the ends of the step.

    Signals are looked up at this time, so that both ends of a step use the piece inside the step. The step itself is
    not shortened. Shortened steps would lose this time at every sample: 3 % of 8 s with 1 kHz in float32.

    `share`: minimum distance from the ends as a share of the step, in addition. Fixed steps end at samples only within
    the rounding of the clock, which is 0.24 % of a step for POSIX times at 10 kHz. `past_end`: at the end of the step,
    use the piece that begins there.
    """
    at, start, end = jax.lax.stop_gradient((t, *within))
    rounding = 2 * jnp.finfo(t.dtype).eps * (jnp.abs(jax.lax.stop_gradient(origin)) + jnp.abs(end))
    margin = jnp.minimum(rounding + share * (end - start), 0.25 * (end - start))
    moved = jnp.clip(at, start + margin, end - margin)
    if past_end:
        moved = jnp.where(at > end - margin, end + margin, moved)
    return t + (moved - at)


class RateArguments(eqx.Module):
    """The arguments of the right-hand side, in addition to time and state.

    Attributes:

    - `system`: the system, possibly packed. `signals`: its inputs, whose samples have times since `origin`.
    - `origin`: the start of the simulation [s]; the integration variable is the time since then.
    - `disturbance`: None, or a function (t, inputs, state) -> (inputs, a `State` to add to the rates).
    - `within`: start and end of the current step [s], None outside of steps.
    - `has_pieces`: whether functions of time are discontinuous, so that they are called with times inside the step.
    - `one_piece`: whether no step contains a sample in its interior, so that one look-up serves all stages.
    - `share`, `past_end`: see `inside`. `past_end` is for fixed steps of a solver whose last stage is only used by the
      next step.
    """

    system: Any
    signals: Any
    origin: Array
    disturbance: Any = None
    within: tuple[Array, Array] | None = None
    has_pieces: bool = eqx.field(static=True, default=False)
    one_piece: bool = eqx.field(static=True, default=False)
    share: float = eqx.field(static=True, default=0.0)
    past_end: bool = eqx.field(static=True, default=False)

    def in_step(self, start: Array, end: Array) -> RateArguments:
        """For the stages of a step from `start` to `end`."""
        return dataclasses.replace(self, within=jax.lax.stop_gradient((start, end)))

    def clock(self, t: Array) -> Array:
        """The time that is passed to the system and to input functions, `t` after the start."""
        return self.origin + (self._place(t, self.origin) if self.has_pieces else t)

    def inputs(self, system: System, t: Array, state: State, all_of_them: bool = False) -> dict[str, Component]:
        """The inputs by name, `t` after the start."""
        now = self.clock(t)
        return inputs_at(system, self.signals, t, state, at=self._piece_at(t), now=now, all_of_them=all_of_them)

    def sampled(self, times: Array) -> dict[str, Array]:
        """The sampled signals at the times (n,) in a step, with one look-up for all times."""
        signals = {} if callable(self.signals) else self.signals
        at = self._piece_at(times)
        along = jax.vmap(lambda x, t, at: x.piece(t, at), in_axes=(None, 0, 0 if at.ndim else None))
        return {
            name: x.piece(times, at) if x.ts.size >= _LONG else along(x, times, at)
            for name, x in signals.items()
            if is_samples(x)
        }

    def _piece_at(self, t: Array) -> Array:
        """The time that selects the piece of a sampled signal for the times t."""
        if self.within is None or not self.one_piece:
            return self._place(t)
        return 0.5 * (self.within[0] + self.within[1])

    def _place(self, t: Array, origin: Component = 0.0) -> Array:
        return t if self.within is None else inside(t, self.within, origin, self.share, self.past_end)


CONTROLLER = "The function of the inputs"


def called(label: str, f: Callable[..., Any], t: Component, state: InputState) -> Any:
    with explain_value_of_traced(label):
        return f(t, state)


def as_signals(inputs: Inputs, names: Sequence[str], ts: Array, system_name: str) -> Any:
    """Convert the inputs of `simulate`: a dict of numbers and callables (t, state), or one callable that returns a
    dict.

    **Raises:** `ValueError` for an unknown name, or samples that do not match `ts`.
    """
    if inputs is None:
        return {}
    if callable(inputs):
        return inputs
    if not isinstance(inputs, Mapping):
        raise TypeError(
            f"`inputs` must be a dict by name or a function (t, state) -> dict, got {type(inputs).__name__}."
        )
    refuse_unknown(inputs, names, f"{system_name} has no input named", "it has")
    return {name: _as_signal(f"The input {name!r}", value, ts) for name, value in inputs.items()}


def _as_signal(label: str, value: Numbers | Callable[..., Any], ts: Array) -> Any:
    if is_samples(value):
        if value.ts.ndim + value.values.ndim > 2:
            raise ValueError(f"{label} is a batch of samples: use jaxkane.sweep or jax.vmap.")
        return value
    if callable(value):
        try:
            inspect.signature(value).bind(None, None)
        except TypeError:
            raise TypeError(
                f"{label} must be a function of (t, state), the time and the state; got {value!r}."
            ) from None
        except ValueError:  # the signature of a function in C is unknown
            pass
        return value
    array = real_array(value, label, jnp.result_type(ts.dtype))  # without 64 bits, float32
    if array.shape not in ((), ts.shape):
        raise ValueError(
            f"{label} has samples of the shape {array.shape}, but `ts` has the shape {ts.shape}. Pass one value for "
            "each of the times `ts`. For other times, pass jaxkane.Samples(times, values)."
        )
    check_finite(label, array)
    return Samples(ts, array) if array.ndim else array


def samples_of(signals: PyTree) -> list[Samples]:
    return [x for x in jax.tree.leaves(signals, is_leaf=is_samples) if is_samples(x)]


def is_samples(x: object) -> bool:
    return isinstance(x, Samples)


def map_samples(f: Callable[[Any], Any], signals: PyTree) -> Any:
    """The signals, with `f` applied to those that are samples."""
    return jax.tree.map(lambda x: f(x) if is_samples(x) else x, signals, is_leaf=is_samples)


class SharedTimes(eqx.Module):
    """Signals with shared times, as an argument of a compiled program. Inside the program, equal arrays are no longer
    the same object, so sharing must be recorded.

    - `times`: without repetition.
    - `signals`: with an index instead of their times.
    """

    times: tuple[Array, ...]
    signals: Any


def share_times(signals: Signals) -> SharedTimes:
    """Replace times by indices; call `restore_times` at the beginning of the program."""
    times: dict[int, Array] = {}

    def indexed(x: Samples) -> Samples:
        times.setdefault(id(x.ts), x.ts)
        return eqx.tree_at(lambda s: s.ts, x, list(times).index(id(x.ts)))

    signals = map_samples(indexed, signals)
    return SharedTimes(tuple(times.values()), signals)


def restore_times(signals: Signals | SharedTimes) -> Any:
    """Signals with their times; shared times are the same array again."""
    if not isinstance(signals, SharedTimes):
        return signals

    return map_samples(lambda x: eqx.tree_at(lambda s: s.ts, x, signals.times[x.ts]), signals.signals)


def for_fixed_steps(signals: Signals) -> Any:
    """Signals for fixed steps, whose derivative with respect to the times of a zero-order hold is NaN.

    A jump inside a step acts from the next stage on. The trajectory is piecewise constant in the time of the jump, and
    the derivative that JAX would compute is 0, which is wrong.
    """

    def checked(x: Samples) -> Samples:
        if not x.zero_order_hold:
            return x
        by_time = nan_derivative_where(jnp.array(True), jnp.zeros((), x.values.dtype), x.ts)
        return Samples(x.ts, x.values + by_time, True)

    return map_samples(checked, signals)


def since(origin: Numbers, signals: Signals, dtype: DTypeLike) -> Any:
    """The same signals with times since `origin` [s]. Samples that share their times still do."""
    times: dict[int, Array] = {}

    def relative(x: Samples) -> Samples:
        if id(x.ts) not in times:
            times[id(x.ts)] = times_since(origin, x.ts, dtype)
        values = x.values if x.values.dtype == dtype else x.values.astype(dtype)
        return eqx.tree_at(lambda s: (s.ts, s.values), x, (times[id(x.ts)], values))

    return map_samples(relative, signals)


def times_since(origin: Numbers, ts: Numbers, dtype: DTypeLike) -> Array:
    """Times since `origin` [s], of any shape.

    Concrete numbers are subtracted in float64, because float32 resolves a POSIX time only to 128 s.
    """
    if isinstance(origin, Tracer) or isinstance(ts, Tracer):
        ts = jnp.asarray(ts)
        return (ts - jnp.asarray(origin, ts.dtype)).astype(dtype)
    return on_device(np.asarray(ts, np.float64) - np.float64(origin), dtype)


def time_array(ts: Numbers, label: str, dtype: DTypeLike | None = None) -> Any:
    """Times as an array of a dtype; as a float64 array of NumPy if this dtype cannot resolve neighbouring times."""
    array = real_array(ts, label, dtype)
    if isinstance(ts, jax.Array) or array.size < 2:  # also traced times
        return array
    exact = np.asarray(ts, np.float64)
    return exact if is_coarse(exact, array.dtype) else array


def is_coarse(ts: np.ndarray, dtype: DTypeLike) -> bool:
    """Whether rounding to a dtype changes the differences of neighbouring times (..., n) by more than a thousandth."""
    shortest = np.min(np.diff(ts, axis=-1), initial=np.inf)
    return bool(jnp.finfo(dtype).eps * np.max(np.abs(ts)) > 1e-3 * shortest)


def inputs_are_valid(signals: Signals) -> Array:
    """Whether all samples and numbers are finite, and the samples' times increase. Checks outside cannot see traced
    values."""
    # One reduction; the barrier keeps XLA from splitting it. Increasing times are finite if the first and the last are.
    numbers = [x.values if is_samples(x) else x for x in _without_functions(signals).values()]
    numbers = [x for x in jax.tree.leaves(numbers) if eqx.is_inexact_array(x)]
    times = [*{id(x.ts): x.ts for x in samples_of(signals)}.values()]
    conditions = [jnp.isfinite(jnp.ravel(x)) for x in (*numbers, *(x[:: x.size - 1] for x in times))]
    conditions += [x[1:] > x[:-1] for x in times]
    return jnp.all(jax.lax.optimization_barrier(jnp.concatenate(conditions))) if conditions else jnp.array(True)


def mask_invalid_inputs(signals: Signals, valid: Array) -> Any:
    """The signals if they are valid, else finite signals of the same shapes, which do not make derivatives NaN."""
    times: dict[int, Array] = {}  # signals that share their times must continue to share them: see `discontinuities_of`

    def masked(x: Numbers) -> Any:
        if is_samples(x):
            indices = jnp.arange(x.ts.shape[0], dtype=x.ts.dtype)
            ts = times.setdefault(id(x.ts), jnp.where(valid, x.ts, indices))
            return eqx.tree_at(lambda s: (s.ts, s.values), x, (ts, masked(x.values)))
        return jnp.where(valid, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x

    if callable(signals):
        return signals
    return signals | {name: masked(x) for name, x in _without_functions(signals).items()}


def _without_functions(signals: Signals) -> dict[str, Any]:
    # Samples and numbers. Functions are omitted, because their numbers may be infinite on purpose, e.g. a controller's
    # limits.
    return {} if callable(signals) else {k: x for k, x in signals.items() if is_samples(x) or not callable(x)}
