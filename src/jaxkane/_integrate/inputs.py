"""Inputs over time: numbers, samples, functions and controllers behind one call. Knows time; knows no mechanics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import refuse_unknown
from .._kane.arguments import is_numeric
from .._scalarjit.compat import Tracer, evaluated, interpret, operation_of, programs_in, types_of
from .._scalarjit.components import Component, Inputs
from .._system.system import explain_value_of_traced


def real_array(value: Any, label: str, dtype: Any = None) -> Array:
    """Real numbers as a float array. **Raises:** `TypeError` for complex numbers, truth values, texts and the like;
    `ValueError` for a masked array, whose gaps would be filled with what stands under the mask."""
    if np.ma.is_masked(value):
        raise ValueError(f"{label}: some values are masked. Fill the gaps, or leave that stretch out.")
    if not is_numeric(value):
        raise TypeError(f"{label} must be real numbers, got {value!r}.")
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    floating = jnp.issubdtype(array.dtype, jnp.floating)
    return jnp.asarray(array, dtype=dtype or (None if floating else float))


class Samples(eqx.Module):
    """A signal given at times: linear between them, constant outside; or held from each sample to the next.

        Samples(ts + delay, values, hold=True)

    Steps of error control end at the times, so that a motion is as exact as without kinks and jumps, and has its
    derivative by the times too: by a delay. So they do where a function of (t, state) calls the samples at t, or at
    t - delay. Samples of anything but time are refused: that is what `jnp.interp` is for.

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
        i = _PLACES["held" if self.hold else "linear"](self.ts, t)
        if self.hold:
            return self.values[i]
        t0, t1, x0, x1 = self.ts[i], self.ts[i + 1], self.values[i], self.values[i + 1]
        # On a kink the derivative by a time is that of the right side; that of `jnp.clip` is the mean of both.
        w = (t - t0) / (t1 - t0)
        return x0 + (x1 - x0) * jnp.where(w >= 1.0, jnp.ones_like(w), jnp.where(w < 0.0, jnp.zeros_like(w), w))


class _OnGrid(Samples):
    """Held samples for steps that end at them but for a rounding error: the end of a step is the beginning of the next
    sample, whichever way it was rounded."""

    def __call__(self, t: Component, state: Any = None) -> Component:
        return self.values[_PLACES["held on a grid"](self.ts, t)]


_FEW = 2048  # comparing with so many samples is one short vector operation; a bisection, a loop of small kernels


def _count(ts: Array, t: Array) -> Array:
    return jnp.searchsorted(ts, t, side="right", method="compare_all" if ts.size <= _FEW else "scan")


@jax.custom_batching.custom_vmap
def _count_until(ts: Array, t: Array) -> Array:
    return _count(ts, t)


@_count_until.def_vmap
def _(size: int, is_batched: Any, ts: Array, t: Array) -> tuple[Array, bool]:
    if is_batched[0]:
        return jax.vmap(_count, (0, 0 if is_batched[1] else None))(ts, t), True
    # Of many times, comparisons would take memory for each sample at each time.
    return jnp.searchsorted(ts, t, side="right"), True


def _place(kind: str) -> Any:
    """Where a time stands among those of samples; under its name `called_samples` finds it in a traced program."""

    def place(ts: Array, t: Component) -> Array:
        ts, at = jax.lax.stop_gradient((ts, jnp.asarray(t, ts.dtype)))
        if kind == "held on a grid":
            at = at + 1e-4 * (ts[1] - ts[0])
        return jnp.clip(_count_until(ts, at) - 1, 0, ts.shape[0] - (2 if kind == "linear" else 1))

    place.__name__ = place.__qualname__ = _NAMED + kind
    return jax.jit(place)


_NAMED = "place among samples, "
_PLACES = {kind: _place(kind) for kind in ("linear", "held", "held on a grid")}


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
    """The signals that are samples."""
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


class Kinks(NamedTuple):
    """The `times` at which some signal has a kink or a jump, in their order; whether there are `jumps`; and whether a
    step that begins at one of them needs a right-hand side of its own (`anew`): behind a jump, and where two signals
    may have their kinks at one time and not together."""

    times: Array
    jumps: bool
    anew: bool


def kinks_of(
    signals: Any, others: Mapping[str, Any], t: Array, y: Array, state_of: Callable[..., Any], fixed: bool
) -> Kinks | None:
    """The `Kinks` of signals, with those of the samples that functions call. None where there are none.

    **Arguments:** `others`: functions (t, state) that are no inputs, by what they are called in a message; a time `t`,
    and a packed state `y` of which `state_of(t, y)` makes what the functions take; `fixed`: whether the steps have one
    length.

    **Raises:** `ValueError` where the times of samples do not follow from how a function calls them.
    """
    named = {} if callable(signals) else signals
    own = [x for x in named.values() if _is_samples(x)]
    functions = {_label_of(name): f for name, f in named.items() if callable(f) and not _is_samples(f)}
    functions |= {_label_of(None): signals} if callable(signals) else {}
    called = [
        kink
        for label, f in {**functions, **others}.items()
        for kink in _called_samples(label, f, t, y, state_of, fixed)
    ]
    distinct = {id(x.ts): x.ts.astype(t.dtype) for x in own}
    times = [*distinct.values(), *(x.astype(t.dtype) for x, _ in called)]
    jumps = any(x.hold for x in own) or any(kind != "linear" for _, kind in called)
    return Kinks(jnp.sort(jnp.concatenate(times)), jumps, jumps or len(times) > 1) if times else None


def _called_samples(
    label: str, f: Any, t: Array, y: Array, state_of: Callable[..., Any], fixed: bool
) -> list[tuple[Array, str]]:
    """When the samples act that a function of (t, state) calls, and of which kind they are: those that it calls at
    t - delay act later by the delay."""
    arrays = lambda x: [each for each in jax.tree.leaves(x) if eqx.is_array(each)]  # noqa: E731
    program = jax.make_jaxpr(lambda t, y: arrays(_asked(label, f, t, state_of(t, y))))(t, y)
    calls: list[_Call] = []
    _follow(program, [_Shifted(jnp.zeros_like(t)), _MOVING], calls)
    times: list[tuple[Array, str]] = []
    for ts, offset, kind in calls:
        if fixed and kind == "held":
            raise ValueError(
                f"{label} calls Samples under a zero-order hold, which steps of one length cannot meet to the last "
                "digit: give the Samples as the input itself; or leave out `step`, and the steps end where they jump."
            )
        if not fixed and offset is None:
            raise ValueError(
                f"{label} calls Samples at something else than t or t - delay, so that the steps of integration cannot "
                "end at their kinks and jumps. Give Samples whose own times are moved or scaled, as "
                "jaxkane.Samples(0.5 * ts + delay, values)(t); for a table over anything but time use jnp.interp."
            )
        if offset is not None:
            earlier = jnp.expand_dims(offset, -1)  # of a batch: one for each of its members
            shape = jnp.broadcast_shapes(ts.shape, earlier.shape)
            times.append((jnp.ravel(jnp.broadcast_to(ts, shape) - jnp.broadcast_to(earlier, shape)), kind))
    return times


class _Shifted(NamedTuple):
    """In a traced program: t + `offset`."""

    offset: Any


_MOVING = object()  # in a traced program: any other number that follows from the time or the state


class _Call(NamedTuple):
    """That samples of the times `ts` and of this `kind` are called at t + `offset`; None for any other time."""

    ts: Any
    offset: Any
    kind: str


def _follow(program: Any, inputs: list[Any], calls: list[_Call]) -> list[Any]:
    """What a traced program makes of its inputs, each a number that is known, `_Shifted` or `_MOVING`; the samples that
    it calls are added to `calls`."""

    def results(equation: Any, xs: list[Any]) -> Any:
        operation = operation_of(equation)
        is_known = [x is not _MOVING and not isinstance(x, _Shifted) for x in xs]
        ys: Any = [_MOVING] * operation.results
        if all(is_known) and operation.is_pure:
            return evaluated(equation, xs)
        if operation.function.startswith(_NAMED):
            offset = xs[1].offset if isinstance(xs[1], _Shifted) and is_known[0] else None
            calls.append(_Call(xs[0], offset, operation.function.removeprefix(_NAMED)))
            return ys
        if operation.name in _SHIFTS and is_known.count(False) == 1 and isinstance(xs[is_known.index(False)], _Shifted):
            if operation.name == "sub" and is_known[0]:
                return ys
            return [_Shifted(*evaluated(equation, [x.offset if isinstance(x, _Shifted) else x for x in xs]))]
        for inner in programs_in(equation):
            n = len(types_of(inner)[0])
            passed = xs[1:] if operation.name == "cond" else xs
            if operation.name in ("scan", "while") or len(passed) != n:
                passed = [_MOVING] * n
            outputs = _follow(inner, passed, calls)
            ys = outputs if operation.name != "cond" and len(outputs) == len(ys) else ys
        return ys

    return interpret(program, inputs, results)


_SHIFTS = ("add", "sub", "convert_element_type", "broadcast_in_dim", "reshape", "squeeze", "copy")


def for_fixed_steps(signals: Any) -> Any:
    """Signals for steps of one length, which end where samples stand but for a rounding error."""
    on_grid = lambda x: _OnGrid(x.ts, x.values, True) if _is_samples(x) and x.hold else x  # noqa: E731
    return jax.tree.map(on_grid, signals, is_leaf=_is_samples)


def signals_are_sound(signals: Any) -> Array:
    """Whether all samples and numbers are finite, and the samples' times increase: what tracing kept from a check."""
    numbers = [x for x in jax.tree.leaves(_plain(signals)) if eqx.is_inexact_array(x)]
    finite = [jnp.all(jnp.isfinite(x)) for x in numbers]
    return jnp.all(jnp.stack([jnp.array(True), *finite, *(jnp.all(x.ts[1:] > x.ts[:-1]) for x in samples_of(signals))]))


def mask_invalid_inputs(signals: Any, valid: Array) -> Any:
    """The signals where they are valid, else others of the same shapes that spoil no derivative."""

    times: dict[int, Array] = {}  # signals that share their times go on sharing them: see `kinks_of`

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
        values: Any = _asked(_label_of(None), signals, t, state)
        if not isinstance(values, Mapping):
            raise TypeError(f"{_label_of(None)} gives a dict by name, got {values!r}.")
        return dict(values)
    return {name: _asked(_label_of(name), f, t, state) if callable(f) else f for name, f in signals.items()}


def _label_of(name: str | None) -> str:
    return "The function of the inputs" if name is None else f"The input {name!r}"


def _asked(label: str, f: Any, t: Component, state: Any) -> Any:
    with explain_value_of_traced(label):
        return f(t, state)
