"""Inputs over time: numbers, samples, functions and controllers behind one call; and their kinks and jumps."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from .._common.lookup import not_there, refuse_unknown
from .._kane.arguments import checked_inputs, is_numeric
from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import Tracer, evaluated, interpret, operation_of, programs_in, types_of
from .._scalarjit.components import Component, Inputs
from .._scalarjit.nan import nan_derivative_where
from .._system.system import State, System, explain_value_of_traced, names_of


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
    """A signal from samples at some times: linear between them, constant outside; or a zero-order hold, which keeps
    each value until the next.

        Samples(ts + delay, values, zero_order_hold=True)

    Steps of error control end at the times, so that a motion is as exact as without kinks and jumps, and has its
    derivative by the times too: by a delay. So they do where a function of (t, state) calls the samples at t, or at
    t - delay. Of an input of more than 8192 linear samples, steps pass over those at which the signal is smooth to
    within `rtol`. Samples of anything but time are refused: that is what `jnp.interp` is for.

    Attributes: `ts` (n_t,) [s], `values` (n_t,); `zero_order_hold`.
    """

    ts: Float[Array, " n_t"]
    values: Float[Array, " n_t"]
    zero_order_hold: bool = eqx.field(static=True)

    def __init__(self, ts: Any, values: Any, zero_order_hold: bool = False):
        if not isinstance(zero_order_hold, bool):
            raise TypeError(f"Samples: `zero_order_hold` is True or False, got {zero_order_hold!r}.")
        self.zero_order_hold = zero_order_hold
        self.ts, self.values = (real_array(x, f"Samples: {label}") for x, label in ((ts, "ts"), (values, "values")))
        n, m = (x.shape[-1] if x.ndim else 0 for x in (self.ts, self.values))
        if n != m or n < 2:
            raise ValueError(f"Samples needs as many `values` as `ts`, two at least; got {m} and {n}.")
        if not isinstance(self.ts, Tracer) and not np.all(np.diff(np.asarray(self.ts)) > 0):
            raise ValueError("Samples: `ts` must increase and be finite.")
        for label, x in (("ts", self.ts), ("values", self.values)):
            _check_finite(f"Samples: `{label}`", x)

    def __call__(self, t: Component, state: Any = None) -> Component:
        if self.zero_order_hold:
            return self.values[_INTERVALS["zero-order hold"](self.ts, t)]
        i = _INTERVALS["linear"](self.ts, t)
        t0, t1, x0, x1 = self.ts[i], self.ts[i + 1], self.values[i], self.values[i + 1]
        # On a kink the derivative by a time is that of the right side; that of `jnp.clip` is the mean of both.
        w = (t - t0) / (t1 - t0)
        return x0 + (x1 - x0) * jnp.where(w >= 1.0, jnp.ones_like(w), jnp.where(w < 0.0, jnp.zeros_like(w), w))


def _check_finite(label: str, values: Array) -> None:
    if not isinstance(values, Tracer) and not np.all(np.isfinite(np.asarray(values))):
        raise ValueError(f"{label} are not all finite: fill the gaps, or leave that stretch out.")


class _GridSamples(Samples):
    """Samples under a zero-order hold, for steps that end at them but for a rounding error: the end of a step is the
    beginning of the next sample, whichever way it was rounded."""

    def __call__(self, t: Component, state: Any = None) -> Component:
        return self.values[_INTERVALS["zero-order hold on a grid"](self.ts, t)]


_FEW = 8192  # comparisons, which are one short vector operation; a bisection is a loop of small kernels


def _count(ts: Array, t: Array) -> Array:
    # More comparisons would take memory for each sample at each time.
    if ts.size * t.size <= _FEW:
        shape = (*t.shape, ts.size)
        until = jnp.broadcast_to(ts, shape) <= jnp.broadcast_to(t[..., None], shape)
        return jnp.sum(until, axis=-1, dtype=jnp.int32)
    return jnp.searchsorted(ts, t, side="right")


@jax.custom_batching.custom_vmap
def count_until(ts: Array, t: Array) -> Array:
    """How many of the times `ts` (n_t,) are not later than t, of any shape."""
    return _count(ts, t)


@count_until.def_vmap
def _(size: int, is_batched: Any, ts: Array, t: Array) -> tuple[Array, bool]:
    if is_batched[0]:
        return jax.vmap(_count, (0, 0 if is_batched[1] else None))(ts, t), True
    return count_until(ts, t), True


def _interval(kind: str) -> Any:
    """The index of the interval of samples that a time is in; by its name `_trace_calls` knows it in a program."""

    def index(ts: Array, t: Component) -> Array:
        ts, at = jax.lax.stop_gradient((ts, jnp.asarray(t, ts.dtype)))
        if kind == "zero-order hold on a grid":
            at = at + 1e-4 * (ts[1] - ts[0])
        return jnp.clip(count_until(ts, at) - 1, 0, ts.shape[0] - (2 if kind == "linear" else 1))

    index.__name__ = index.__qualname__ = _INTERVAL_OF + kind
    return jax.jit(index)


_INTERVAL_OF = "interval of samples, "
_INTERVALS = {kind: _interval(kind) for kind in ("linear", "zero-order hold", "zero-order hold on a grid")}


class InputState(eqx.Module):
    """What an input function receives: `state.q`, `state.u`, `state.x`, and any coordinate, speed or state by name."""

    q: Array
    u: Array
    x: Array | None
    t: Any
    system: System

    def __getitem__(self, name: str) -> Component:
        system = self.system
        for names, values in ((system.coordinates, self.q), (system.speeds, self.u), (system.states, self.x)):
            if values is not None and name in names:
                return values[names.index(name)]
        if name in system.dependent_speeds:
            u_dep = KaneEquations(system, self.t, self.q, self.u).u_dep
            return jnp.asarray(u_dep[system.dependent_speeds.index(name)])
        raise not_there(name, [each for names in names_of(system) for each in names], "the state")


def inputs_at(
    system: System, signals: Any, t: Component, state: State, all_of_them: bool = False
) -> dict[str, Component]:
    """The inputs by name, at one time: all, or those of the signals."""
    at = InputState(state.q, state.u, state.x, t, system)
    if callable(signals):
        values: Any = _called(_CONTROLLER, signals, t, at)
        if not isinstance(values, Mapping):
            raise TypeError(f"{_CONTROLLER} gives a dict by name, got {values!r}.")
    else:
        values = {name: _called(_label(name), f, t, at) if callable(f) else f for name, f in signals.items()}
    names = checked_inputs(system, values)
    return {
        name: jnp.asarray(values.get(name, 0.0), dtype=state.q.dtype) for name in (names if all_of_them else values)
    }


class RateArguments(NamedTuple):
    """What the rates read beside time and state: the `system`, maybe packed; the `signals`; and the `disturbance`."""

    system: Any
    signals: Any
    disturbance: Any

    def sampled(self, times: Array) -> dict[str, Array]:
        """The signals that are samples at some times (n,), all of which are looked up at once."""
        signals = {} if callable(self.signals) else self.signals
        return {name: jax.vmap(x)(times) for name, x in signals.items() if _is_samples(x)}

    def with_numbers(self, inputs: dict[str, Array]) -> RateArguments:
        """With numbers for some of the signals."""
        return self._replace(signals=self.signals | inputs)


_CONTROLLER = "The function of the inputs"


def _label(name: str) -> str:
    return f"The input {name!r}"


def _called(label: str, f: Any, t: Component, state: InputState) -> Any:
    with explain_value_of_traced(label):
        return f(t, state)


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
        if not _is_samples(value):
            _check_takes(value, f"The input {name!r}")
        elif value.ts.ndim + value.values.ndim > 2:
            raise ValueError(f"The input {name!r} is a batch of samples: use jaxkane.sweep or jax.vmap.")
        return value
    array = real_array(value, _label(name), ts.dtype)
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
    _check_finite(f"The samples of {name!r}", array)
    return Samples(ts, array)


def _check_takes(f: Callable[..., Any], label: str) -> None:
    """**Raises:** `TypeError` for a function that does not take a time and a state."""
    try:
        inspect.signature(f).bind(None, None)
    except TypeError:
        raise TypeError(f"{label} is a function of (t, state), the time and the state there; got {f!r}.") from None
    except ValueError:  # a function in C, of which nothing is known
        pass


def samples_of(signals: Any) -> list[Samples]:
    """The signals that are samples."""
    return [x for x in jax.tree.leaves(signals, is_leaf=_is_samples) if _is_samples(x)]


def _is_samples(x: Any) -> bool:
    return isinstance(x, Samples)


class SharedTimes(eqx.Module):
    """Signals whose samples share their times, as an argument of a compiled program, in which arrays are no longer the
    same: `times` without repetition, and `signals` with an index in the place of their times."""

    times: tuple[Array, ...]
    signals: Any


def share_times(signals: Any) -> SharedTimes:
    """To be undone by `restore_times` where the program begins."""
    times: dict[int, Array] = {}

    def indexed(x: Any) -> Any:
        if not _is_samples(x):
            return x
        times.setdefault(id(x.ts), x.ts)
        return eqx.tree_at(lambda s: s.ts, x, list(times).index(id(x.ts)))

    signals = jax.tree.map(indexed, signals, is_leaf=_is_samples)
    return SharedTimes(tuple(times.values()), signals)


def restore_times(signals: Any) -> Any:
    """Signals with their times, the same array where they share them."""
    if not isinstance(signals, SharedTimes):
        return signals
    restored = lambda x: eqx.tree_at(lambda s: s.ts, x, signals.times[x.ts]) if _is_samples(x) else x  # noqa: E731
    return jax.tree.map(restored, signals.signals, is_leaf=_is_samples)


class Discontinuities(NamedTuple):
    """The `times` at which some signal has a kink or a jump that a step must not pass over, in their order, then
    infinity for the rest; whether there are `jumps`; and whether a step that begins at one of them needs a right-hand
    side of its own (`restart`): behind a jump, and where two signals may have their kinks at one time and not
    together."""

    times: Array
    jumps: bool
    restart: bool


def discontinuities_of(
    system: System, signals: Any, functions: Mapping[str, Any], t: Array, state: State, fixed: bool, rtol: Any = 0.0
) -> Discontinuities | None:
    """Those of signals, and of the samples that functions call. None where there are none.

    **Arguments:** `functions`: of (t, state) that are no inputs, by their labels in messages; a time and a state at
    which functions are traced; `fixed`: whether the steps have one length; `rtol`: how exact the input has to be.

    **Raises:** `ValueError` where the times of samples do not follow from how a function calls them.
    """
    named = {_CONTROLLER: signals} if callable(signals) else {_label(name): f for name, f in signals.items()}
    samples: list[Any] = [x for x in named.values() if _is_samples(x)]
    functions = {label: f for label, f in named.items() if callable(f) and not _is_samples(f)} | {**functions}
    called = [each for label, f in functions.items() for each in _called_samples(label, f, system, t, state, fixed)]
    shared: dict[int, list[Samples]] = {}
    for x in samples:
        shared.setdefault(id(x.ts), []).append(x)
    ends = [x[0].ts if fixed else _ends_of_steps(x, rtol) for x in shared.values()]
    times = [x.astype(t.dtype) for x in (*ends, *(ts for ts, _ in called))]
    jumps = any(x.zero_order_hold for x in samples) or any(kind != "linear" for _, kind in called)
    return Discontinuities(jnp.sort(jnp.concatenate(times)), jumps, jumps or len(times) > 1) if times else None


_MANY = 8192  # of fewer samples each ends a step: that takes no longer than to look for those that need not


def _ends_of_steps(samples: list[Samples], rtol: Any) -> Array:
    """The times at which steps have to end, of samples that share their times; infinity for the other times."""
    ts = samples[0].ts
    if ts.shape[0] <= _MANY or any(x.zero_order_hold for x in samples):
        return ts
    return _needed_times(ts, jnp.stack([x.values for x in samples]), rtol)


@jax.custom_jvp
def _needed_times(ts: Array, values: Array, rtol: Array) -> Array:
    needed = jax.vmap(lambda x: _needed_knots(ts, x, rtol))(values)
    return jnp.where(jnp.any(needed, axis=0), ts, jnp.inf)


def _all_times(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Where a derivative by samples' times or values is asked for, steps end at all of them: between its ends a step
    sees the samples beside its stages alone, and has no derivative by the others."""
    (ts, *_), (ts_dot, values_dot, _) = primals, tangents
    is_zero = [isinstance(x, SymbolicZero) for x in (ts_dot, values_dot)]
    return _needed_times(*primals) if all(is_zero) else ts, jnp.zeros_like(ts) if is_zero[0] else ts_dot


_needed_times.defjvp(_all_times, symbolic_zeros=True)


def _needed_knots(ts: Float[Array, " n_t"], values: Float[Array, " n_t"], rtol: Array) -> Array:
    """Which knots of a linear signal (n_t,) are not inside a smooth block: of blocks of 8, 32, 128, .. intervals.

    In a smooth block a polynomial of the fifth degree meets the signal, at its knots and halfway between them, to
    within ten times `rtol` of the signal's standard deviation over this block and twenty on each side. A step within it
    integrates the polynomial, whose error it estimates, and a remainder within the tolerance. So no step can miss a
    peak: a peak of one sample fits no polynomial.
    """
    n, rounding = ts.shape[0] - 1, 16 * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values))
    values, dt, k = values - jnp.mean(values), jnp.diff(ts), jnp.arange(n)
    sums = lambda y: jnp.concatenate([jnp.zeros_like(y[:1]), jnp.cumsum(y)])  # noqa: E731
    moments = [sums(dt * values[1:] ** power) for power in (1, 2)]

    def without_inner(level: Array, needed: Array) -> Array:
        m = 8 * 4**level
        start = jnp.minimum(jnp.minimum(jnp.arange(n // 8 + 1), n // m + 1) * m, n)
        end = jnp.minimum(start + m, n)
        low, high = jnp.maximum(start - 20 * m, 0), jnp.minimum(end + 20 * m, n)
        mean, square = ((y[high] - y[low]) / (ts[high] - ts[low]) for y in moments)
        tolerance = 10 * rtol * jnp.sqrt(jnp.maximum(square - mean**2, 0.0)) + rounding
        # Newton's divided differences, at the knots nearest to Chebyshev's.
        t0, duration = ts[start], ts[end] - ts[start]
        places = 0.5 * (1 - np.cos(np.pi * np.arange(6) / 5))
        nodes = [start + jnp.round((end - start).astype(ts.dtype) * x).astype(start.dtype) for x in places.tolist()]
        at, c = [(ts[i] - t0) / duration for i in nodes], [values[i] for i in nodes]
        for j in range(1, 6):
            c[j:] = [(c[i] - c[i - 1]) / (at[i] - at[i - j]) for i in range(j, 6)]
        block = k // m
        of_blocks = jax.lax.optimization_barrier((*at, *c, t0, duration, tolerance))

        def is_met(t: Array, x: Array) -> Array:
            *rest, t0, duration, tolerance = [y[block] for y in of_blocks]
            at, c, s = rest[:6], rest[6:], (t - t0) / duration
            p = c[5]
            for j in reversed(range(5)):
                p = c[j] + (s - at[j]) * p
            return jnp.abs(x - p) <= tolerance

        met = is_met(ts[:-1], values[:-1]) & is_met(ts[:-1] + 0.5 * dt, 0.5 * (values[:-1] + values[1:]))
        missed = sums(jnp.where(met, 0, 1))
        smooth = missed[end] == missed[start]
        return needed & ~(smooth[block] & (k % m > 0))

    levels = next(i for i in range(n) if 8 * 4**i > n)
    return jnp.append(jax.lax.fori_loop(0, levels, without_inner, jnp.ones(n, bool)), True)


def _called_samples(label: str, f: Any, system: System, t: Array, state: State, fixed: bool) -> list[tuple[Array, str]]:
    """The times and kinds of the samples that a function of (t, state) calls: those that it calls at t - delay act
    later by the delay."""

    def arrays(t: Array, state: State) -> list[Any]:
        results = _called(label, f, t, InputState(state.q, state.u, state.x, t, system))
        return [x for x in jax.tree.leaves(results) if isinstance(x, Tracer)]

    calls: list[_Call] = []
    varying = [_VARYING] * len(jax.tree.leaves(state))
    _trace_calls(jax.make_jaxpr(arrays)(t, state), [_ShiftedTime(jnp.zeros_like(t)), *varying], calls)
    times: list[tuple[Array, str]] = []
    for ts, offset, kind in calls:
        if fixed and kind == "zero-order hold":
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
            offset = jnp.expand_dims(offset, -1)  # of a batch: one for each of its members
            shape = jnp.broadcast_shapes(ts.shape, offset.shape)
            times.append((jnp.ravel(jnp.broadcast_to(ts, shape) - jnp.broadcast_to(offset, shape)), kind))
    return times


class _ShiftedTime(NamedTuple):
    """In a traced program: t + `offset`."""

    offset: Any


_VARYING = object()  # in a traced program: any other number that follows from the time or the state


class _Call(NamedTuple):
    """Samples of the times `ts` and of this `kind` are called at t + `offset`; None for any other time."""

    ts: Any
    offset: Any
    kind: str


def _trace_calls(program: Any, inputs: list[Any], calls: list[_Call]) -> list[Any]:
    """What a traced program makes of its inputs, each a number that is known, a `_ShiftedTime` or `_VARYING`; the
    samples that it calls are added to `calls`."""

    def results(equation: Any, xs: list[Any]) -> Any:
        operation = operation_of(equation)
        is_known = [x is not _VARYING and not isinstance(x, _ShiftedTime) for x in xs]
        ys: Any = [_VARYING] * operation.results
        if all(is_known) and operation.is_pure:
            return evaluated(equation, xs)
        if operation.function.startswith(_INTERVAL_OF):
            offset = xs[1].offset if isinstance(xs[1], _ShiftedTime) and is_known[0] else None
            calls.append(_Call(xs[0], offset, operation.function.removeprefix(_INTERVAL_OF)))
            return ys
        if operation.name in _SHIFTS and is_known.count(False) == 1 and xs[is_known.index(False)] is not _VARYING:
            if operation.name == "sub" and is_known[0]:
                return ys
            return [_ShiftedTime(*evaluated(equation, [x.offset if isinstance(x, _ShiftedTime) else x for x in xs]))]
        for inner in programs_in(equation):
            n = len(types_of(inner)[0])
            arguments = xs[1:] if operation.name == "cond" else xs
            if operation.name in ("scan", "while") or len(arguments) != n:
                arguments = [_VARYING] * n
            outputs = _trace_calls(inner, arguments, calls)
            ys = outputs if operation.name != "cond" and len(outputs) == len(ys) else ys
        return ys

    return interpret(program, inputs, results)


_SHIFTS = ("add", "sub", "convert_element_type", "broadcast_in_dim", "reshape", "squeeze", "copy")


def for_fixed_steps(signals: Any, solver: Any) -> Any:
    """Signals for steps of one length, which end where samples stand but for a rounding error.

    **Raises:** `ValueError` for a zero-order hold and a solver that evaluates the right-hand side at the end of a step,
    where the next sample begins.
    """
    tableau = getattr(solver, "tableau", None)
    at_end = True if tableau is None else np.any((np.asarray(tableau.c) == 1) & (np.asarray(tableau.b_sol)[1:] != 0))
    if at_end and any(x.zero_order_hold for x in samples_of(signals)):
        raise ValueError(
            f"Steps of one length and an input under a zero-order hold: {type(solver).__name__} reads the end of a "
            "step, where the next sample begins. Use solver=diffrax.Bosh3(); or leave out `step`, and the steps end "
            "where the input jumps."
        )

    def on_grid(x: Any) -> Any:
        if not _is_samples(x) or not x.zero_order_hold:
            return x
        # A jump between two steps is felt at the next: as a function of its time the motion is a staircase.
        by_time = nan_derivative_where(jnp.array(True), jnp.zeros((), x.values.dtype), x.ts)
        return _GridSamples(x.ts, x.values + by_time, True)

    return jax.tree.map(on_grid, signals, is_leaf=_is_samples)


def inputs_are_valid(signals: Any) -> Array:
    """Whether all samples and numbers are finite, and the samples' times increase: what no check sees under a trace."""
    # In one reduction, which the barrier keeps whole. Times that increase are finite where the first and the last are.
    numbers = [x.values if _is_samples(x) else x for x in _without_functions(signals).values()]
    numbers = [x for x in jax.tree.leaves(numbers) if eqx.is_inexact_array(x)]
    times = [*{id(x.ts): x.ts for x in samples_of(signals)}.values()]
    conditions = [jnp.isfinite(jnp.ravel(x)) for x in (*numbers, *(x[:: x.size - 1] for x in times))]
    conditions += [x[1:] > x[:-1] for x in times]
    return jnp.all(jax.lax.optimization_barrier(jnp.concatenate(conditions))) if conditions else jnp.array(True)


def mask_invalid_inputs(signals: Any, valid: Array) -> Any:
    """The signals where they are valid, else others of the same shapes that spoil no derivative."""
    times: dict[int, Array] = {}  # signals that share their times go on sharing them: see `discontinuities_of`

    def masked(x: Any) -> Any:
        if _is_samples(x):
            indices = jnp.arange(x.ts.shape[0], dtype=x.ts.dtype)
            ts = times.setdefault(id(x.ts), jnp.where(valid, x.ts, indices))
            return eqx.tree_at(lambda s: (s.ts, s.values), x, (ts, masked(x.values)))
        return jnp.where(valid, x, jnp.ones_like(x)) if eqx.is_inexact_array(x) else x

    if callable(signals):
        return signals
    return signals | {name: masked(x) for name, x in _without_functions(signals).items()}


def _without_functions(signals: Any) -> dict[str, Any]:
    """Samples and numbers, without what may be infinite with good reason: a controller's limits."""
    return {} if callable(signals) else {k: x for k, x in signals.items() if _is_samples(x) or not callable(x)}
