"""Discontinuities of inputs: the times at which steps end."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from .._scalarjit.compat import ClosedJaxpr, Equation, Tracer, evaluated, interpret, operation_of, programs_in, types_of
from .._scalarjit.nan import nan_if_not_zero
from .._system.system import State, System
from .inputs import CONTROLLER, INTERVAL_OF, InputState, Samples, Signals, called, count_until, is_samples, samples_of


class Discontinuities(NamedTuple):
    """Times at which signals are discontinuous, or have a discontinuous derivative.

    Fields:

    - `times` (n,): increasing times since the start of the simulation [s]; infinity for times that steps may skip.
    - `jumps`: whether any signal is itself discontinuous there.
    - `restart`: whether a step that begins there must evaluate the right-hand side again. This is necessary after a
      jump. It is also necessary if two signals have discontinuities at one time and only one is differentiated.
    """

    times: Array
    jumps: bool
    restart: bool

    def after(self, t: Array, duration: Array) -> Array:
        """The next of the times after `t`, infinity if there is none. Times within rounding of `t` are not after it."""
        i = count_until(*jax.lax.stop_gradient((self.times, t + rounding(t, duration))))
        return jnp.where(i < len(self.times), self.times[jnp.minimum(i, len(self.times) - 1)], jnp.inf)


def rounding(t: Array, duration: Array) -> Array:
    """The largest rounding error of a time since the start [s].

    It is proportional to the time and not to the duration. Otherwise a simulation of 1e4 s would miss a flight of
    1e-8 s. The second term keeps the result positive at the start.
    """
    eps = jnp.finfo(t.dtype).eps
    return 4 * eps * (jnp.abs(t) + eps * duration)


def discontinuities_of(
    system: System,
    signals: Signals,
    functions: Mapping[str, Any],
    origin: Array,
    state: State,
    fixed: bool,
    rtol: Array | float = 0.0,
    given: Array | None = None,
) -> Discontinuities | None:
    """The discontinuities of signals, and of the samples that functions call. None if there are none.

    **Arguments:**

    - `signals`: the inputs, whose samples have times since `origin`.
    - `functions`: other functions of (t, state), by their labels in messages.
    - `origin`: the start of the simulation [s]; `state`: the state there. Functions are traced at both.
    - `fixed`: whether the steps have a fixed length.
    - `rtol`: relative tolerance within which a signal is regarded as smooth.
    - `given` (n,): more times since `origin` [s], from the user.

    **Raises:** `ValueError` if a function calls samples at a time other than t or t - delay.
    """
    named = {CONTROLLER: signals} if callable(signals) else {f"The input {name!r}": f for name, f in signals.items()}
    samples: list[Any] = [x for x in named.values() if is_samples(x)]
    functions = {label: f for label, f in named.items() if callable(f) and not is_samples(f)} | {**functions}
    calls = [each for label, f in functions.items() for each in _called_samples(label, f, system, origin, state, fixed)]
    shared: dict[int, list[Samples]] = {}
    for x in samples:
        shared.setdefault(id(x.ts), []).append(x)
    times = [x[0].ts if fixed else _ends_of_steps(x, rtol) for x in shared.values()]
    times += [ts - origin for ts, _ in calls] + ([] if given is None else [given])
    jumps = any(x.zero_order_hold for x in samples) or any(kind != "linear" for _, kind in calls) or given is not None
    if not times:
        return None
    several, rising = len(times) > 1, jnp.sort(jnp.concatenate([x.astype(origin.dtype) for x in times]))
    if several:
        rising = _with_one_derivative(jumps, rising)
    return Discontinuities(rising, jumps, jumps or (several and not fixed))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_one_derivative(jumps: bool, times: Array) -> Array:
    # Times, whose derivative is NaN where several signals are discontinuous and only some are differentiated.
    #
    # One step ends there, and has one derivative with respect to its end. If two signals jump and one of them has the
    # delay 0, that was the derivative of both jumps or of none: -8 or 0 instead of 2 and -10. If no signal jumps, the
    # first derivatives are right, and the second ones are NaN.
    return times


@_with_one_derivative.defjvp
def _(jumps: bool, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
    (times,), (times_dot,) = primals, tangents
    mixed = _difference_of_coincident(times, times_dot)
    # In reverse mode this has to be linear in the tangent.
    mixed = nan_if_not_zero(mixed, [times]) if jumps else _zero_without_derivative(times) * mixed
    return _with_one_derivative(jumps, times), times_dot + jnp.pad(mixed, (0, 1)) + jnp.pad(mixed, (1, 0))


def _difference_of_coincident(times: Array, times_dot: Array) -> Array:
    near = jnp.diff(times) <= 2 * rounding(times[1:], times[1:])
    return jnp.where(near, jnp.diff(times_dot), 0.0)


@jax.custom_jvp
def _zero_without_derivative(times: Array) -> Array:
    return jnp.zeros_like(times[1:])


@_zero_without_derivative.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
    (times,), (times_dot,) = primals, tangents
    return _zero_without_derivative(times), nan_if_not_zero(_difference_of_coincident(times, times_dot), [times])


_MANY = 8192  # with fewer samples, steps end at each: searching for smooth blocks would take as long as these steps


def all_end_steps(signals: Signals) -> bool:
    """Whether steps with error control end at each sample of these signals."""
    return all(x.ts.shape[-1] <= _MANY or x.zero_order_hold for x in samples_of(signals))


def _ends_of_steps(samples: list[Samples], rtol: Array | float) -> Array:
    """The times at which steps must end, for samples with common times; infinity for the other times."""
    ts = samples[0].ts
    if ts.shape[0] <= _MANY or any(x.zero_order_hold for x in samples):
        return ts
    return _needed_times(ts, jnp.stack([x.values for x in samples]), rtol)


@jax.custom_jvp
def _needed_times(ts: Array, values: Array, rtol: Array) -> Array:
    needed = jax.vmap(lambda x: _needed_knots(ts, x, rtol))(values)
    return jnp.where(jnp.any(needed, axis=0), ts, jnp.inf)


def _all_times(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    # If the times or values of samples are differentiated, steps end at all samples. A step over several samples would
    # evaluate only those next to its stages, and the derivatives with respect to the others would be zero.
    (ts, *_), (ts_dot, values_dot, _) = primals, tangents
    is_zero = [isinstance(x, SymbolicZero) for x in (ts_dot, values_dot)]
    return _needed_times(*primals) if all(is_zero) else ts, jnp.zeros_like(ts) if is_zero[0] else ts_dot


_needed_times.defjvp(_all_times, symbolic_zeros=True)


def _needed_knots(ts: Float[Array, " n_t"], values: Float[Array, " n_t"], rtol: Array) -> Array:
    """Which knots of a linear signal (n_t,) are not inside a smooth block. Blocks have 8, 32, 128, .. intervals.

    A block is smooth if a polynomial of the fifth degree agrees with the signal at the knots and halfway between them.
    The permitted difference is 10 `rtol` times the standard deviation of the signal over this block and twenty blocks
    on each side. The error control of a step estimates the error of the polynomial, and the difference is within the
    tolerance. No step can miss a peak, because a polynomial does not agree with a peak of one sample.
    """
    n, rounding = ts.shape[0] - 1, 16 * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values))
    values, dt, k = values - jnp.mean(values), jnp.diff(ts), jnp.arange(n)

    def sums(y: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(y[:1]), jnp.cumsum(y)])

    moments = [sums(dt * values[1:] ** power) for power in (1, 2)]

    def without_inner(level: Array, needed: Array) -> Array:
        m = 8 * 4**level
        start = jnp.minimum(jnp.minimum(jnp.arange(n // 8 + 1), n // m + 1) * m, n)
        end = jnp.minimum(start + m, n)
        low, high = jnp.maximum(start - 20 * m, 0), jnp.minimum(end + 20 * m, n)
        mean, square = ((y[high] - y[low]) / (ts[high] - ts[low]) for y in moments)
        tolerance = 10 * rtol * jnp.sqrt(jnp.maximum(square - mean**2, 0.0)) + rounding
        # Newton's divided differences at the knots nearest to the Chebyshev points.
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


def _called_samples(
    label: str, f: Callable[..., Any], system: System, t: Array, state: State, fixed: bool
) -> list[tuple[Array, str]]:
    """The times and kinds of the samples that a function of (t, state) calls. For a call at t - delay, the times are
    later by the delay."""

    def arrays(t: Array, state: State) -> list[Any]:
        results = called(label, f, t, InputState(state.q, state.u, state.x, t, system))
        return [x for x in jax.tree.leaves(results) if isinstance(x, Tracer)]

    calls: list[_Call] = []
    varying = [_VARYING] * len(jax.tree.leaves(state))
    _trace_calls(jax.make_jaxpr(arrays)(t, state), [_ShiftedTime(jnp.zeros_like(t)), *varying], calls)
    times: list[tuple[Array, str]] = []
    for ts, offset, kind in calls:
        if fixed and kind == "zero-order hold":
            raise ValueError(
                f"{label} calls Samples with a zero-order hold, for which fixed steps are not accurate. Pass the "
                "Samples as the input itself, or omit `step`: steps with error control end at the samples."
            )
        if not fixed and offset is None:
            raise ValueError(
                f"{label} calls Samples at a time other than t or t - delay, so that integration steps cannot end at "
                "their discontinuities. Shift or scale the times of the Samples instead, e.g. "
                "jaxkane.Samples(0.5 * ts + delay, values)(t). For a table over another quantity, use jnp.interp."
            )
        if offset is not None:
            offset = jnp.expand_dims(offset, -1)  # a batch has one offset for each member
            shape = jnp.broadcast_shapes(ts.shape, offset.shape)
            times.append((jnp.ravel(jnp.broadcast_to(ts, shape) - jnp.broadcast_to(offset, shape)), kind))
    return times


class _ShiftedTime(NamedTuple):
    """In a traced program: t + `offset`."""

    offset: Any


_VARYING = object()  # in a traced program: any other number that depends on the time or the state


class _Call(NamedTuple):
    """Samples of the times `ts` and of this `kind` are called at t + `offset`; None for any other time."""

    ts: Any
    offset: Any
    kind: str


def _trace_calls(program: ClosedJaxpr, inputs: list[Any], calls: list[_Call]) -> list[Any]:
    """The outputs of a traced program for its inputs. Each of them is a known number, a `_ShiftedTime` or `_VARYING`.
    The samples that the program calls are added to `calls`."""

    def results(equation: Equation, xs: list[Any]) -> Any:
        operation = operation_of(equation)
        is_known = [x is not _VARYING and not isinstance(x, _ShiftedTime) for x in xs]
        ys: Any = [_VARYING] * operation.results
        if all(is_known) and operation.is_pure:
            return evaluated(equation, xs)
        if operation.function.startswith(INTERVAL_OF):
            offset = xs[1].offset if isinstance(xs[1], _ShiftedTime) and is_known[0] else None
            calls.append(_Call(xs[0], offset, operation.function.removeprefix(INTERVAL_OF)))
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
