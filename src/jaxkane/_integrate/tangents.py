"""A simulation as one operation of JAX with derivatives of its own.

The value of a simulation is computed without derivatives. Its tangents are computed by a second simulation, which also
controls their errors (see below). This second simulation is one linear operation: forward mode evaluates it, reverse
mode evaluates its transpose. Both modes are therefore supported, in any order with `jax.jit` and `jax.vmap`.

Steps that are short enough for a motion may be far too long for its tangents: a motion at rest has no error at all. All
tangents obey the same equation. Therefore one tangent with a generic direction determines how long the steps may be:

    y_dot = f(t, y, args),   d_dot = df/dy d + df/dargs args_dot

This tangent is called the probe. A first loop integrates motion and probe with error control, and records the ends of
its steps and its jumps. The loop that is differentiated takes the recorded steps. It decides nothing about steps, so
rounding errors cannot change them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from .._scalarjit.compat import as_lowering, is_no_tangent, is_undefined_primal, new_primitive
from .._scalarjit.components import Component, Numbers
from .._scalarjit.nan import constant
from .._scalarjit.scalar_function import Packed, tree_of
from .discontinuities import rounding
from .inputs import RateArguments, is_samples

Run = Callable[..., Any]
"""(arguments, moved, reverse) -> result. `moved`: the arguments with True for each array that is differentiated; None
for the value alone. `reverse`: whether the result supports reverse mode, else forward mode."""


def with_own_tangents(run: Run, arguments: PyTree, constants: PyTree) -> Any:
    """`run((arguments, constants), None, False)`, which can be differentiated with respect to `arguments` in both
    modes. A forward-mode derivative can be differentiated again in forward mode. `run` must not use traced numbers of
    a closure."""
    moving, other = eqx.partition(arguments, eqx.is_inexact_array)
    arrays, rest = eqx.partition((other, constants), eqx.is_array)
    moving, structure = jax.tree.flatten(moving)
    fixed, structure_of_fixed = jax.tree.flatten(arrays)
    after: list[Any] = []  # what the result contains beside float arrays, and its structure

    def outputs(moving: list[Any], fixed: list[Any], moved: tuple[bool, ...] | None, reverse: bool) -> Any:
        other, constants = eqx.combine(jax.tree.unflatten(structure_of_fixed, fixed), rest)
        arguments = eqx.combine(jax.tree.unflatten(structure, moving), other)
        flags = None if moved is None else jax.tree.unflatten(structure, moved)
        floats, others = eqx.partition(run((arguments, constants), flags, reverse), eqx.is_inexact_array)
        leaves, structure_of_floats = jax.tree.flatten(floats)
        if moved is None:
            integers, static = eqx.partition(others, eqx.is_array)
            after[:] = structure_of_floats, static
            return [leaves, integers]
        return leaves

    # `jax.jit`, because JAX calls this function once to differentiate it, and once for its value.
    @jax.custom_jvp
    @jax.jit
    def value(moving: list[Any], fixed: list[Any]) -> Any:
        floats, integers = outputs(moving, fixed, None, False)
        return [_in_one_batch.bind(*floats, *moving, *fixed, n=len(floats)), integers]

    @functools.partial(value.defjvp, symbolic_zeros=True)
    def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
        moving, fixed = primals
        moved = tuple(not isinstance(x_dot, SymbolicZero) for x_dot in tangents[0])
        floats, integers = value(moving, fixed)
        types = tuple([jax.typeof(x).update(weak_type=False) for x in floats])
        forward, reverse = (functools.partial(outputs, moved=moved, reverse=reverse) for reverse in (False, True))
        one = Simulated(forward, reverse, moved, types)
        dots = [x_dot for x_dot, moves in zip(tangents[0], moved, strict=True) if moves]
        floats_dot = _tangents.bind(*moving, *fixed, *dots, simulated=one, n=len(moving) + len(fixed))
        no_dots = jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), integers)
        return [floats, integers], [floats_dot, no_dots]

    floats, integers = value(moving, fixed)
    structure_of_floats, static = after
    return eqx.combine(jax.tree.unflatten(structure_of_floats, floats), integers, static)


class Simulated(NamedTuple):
    """The floats that a simulation returns, as two functions of (moving, fixed): with derivatives in forward mode, and
    in reverse mode. `moved`: which of the `moving` are differentiated. `types`: the abstract values of the floats."""

    forward: Callable[..., list[Any]]
    reverse: Callable[..., list[Any]]
    moved: tuple[bool, ...]
    types: tuple[Any, ...]

    def _at(self, run: Callable[..., list[Any]], values: Sequence[Any], used: Sequence[bool]) -> tuple[Any, list[Any]]:
        """The used floats as a function of the numbers that are differentiated, and these numbers."""
        n = len(self.moved)
        moving, fixed = list(values[:n]), list(values[n:])

        def floats(*differentiated: Any) -> list[Any]:
            each = iter(differentiated)
            all_of_them = [next(each) if moves else x for x, moves in zip(moving, self.moved, strict=True)]
            return [x for x, is_used in zip(run(all_of_them, fixed), used, strict=True) if is_used]

        return floats, [x for x, moves in zip(moving, self.moved, strict=True) if moves]

    def tangents(self, values: Sequence[Any], dots: Sequence[Any]) -> list[Any]:
        floats, x = self._at(self.forward, values, [True] * len(self.types))
        return jax.jvp(floats, x, list(dots))[1]

    def cotangents(self, values: Sequence[Any], cts: Sequence[Any]) -> list[Any]:
        used = [ct is not None for ct in cts]
        floats, x = self._at(self.reverse, values, used)
        return list(jax.vjp(floats, *x)[1]([ct for ct in cts if ct is not None]))


class Batch(NamedTuple):
    """A batch of simulations, or of directions of one simulation; interface as `Simulated`. `dims`: the axis of the
    batch of each value and of each tangent, or None; `size`: its length."""

    simulated: Any
    dims: tuple[Any, ...]
    n: int
    size: int

    @property
    def types(self) -> tuple[Any, ...]:
        return tuple([x.update(shape=(self.size, *x.shape)) for x in self.simulated.types])

    def tangents(self, values: Sequence[Any], dots: Sequence[Any]) -> list[Any]:
        dims = list(self.dims[: self.n]), list(self.dims[self.n :])
        return jax.vmap(self.simulated.tangents, dims, axis_size=self.size)(list(values), list(dots))

    def cotangents(self, values: Sequence[Any], cts: Sequence[Any]) -> list[Any]:
        dims = list(self.dims[: self.n]), [None if ct is None else 0 for ct in cts]
        found = jax.vmap(self.simulated.cotangents, dims, axis_size=self.size)(list(values), list(cts))
        of_dots = zip(found, self.dims[self.n :], strict=True)
        return [jnp.sum(x, 0) if dim is None else jnp.moveaxis(x, 0, dim) for x, dim in of_dots]


def _evaluated(*args: Any, simulated: Simulated | Batch, n: int) -> list[Any]:
    return simulated.tangents(args[:n], args[n:])


def _shapes(*args: Any, simulated: Simulated | Batch, n: int) -> list[Any]:
    return [*simulated.types]


def _jvp(primals: Sequence[Array], tangents: Sequence[Array], *, simulated: Simulated | Batch, n: int) -> Any:
    places = [i for i, x_dot in enumerate(tangents) if not is_no_tangent(x_dot)]

    def floats_dot(*moving: Any) -> list[Any]:
        values = dict(zip(places, moving, strict=True))
        args = [values.get(i, x) for i, x in enumerate(primals)]
        return simulated.tangents(args[:n], args[n:])

    found, found_dot = jax.jvp(floats_dot, [primals[i] for i in places], [tangents[i] for i in places])
    return found, [_forward_only.bind(x)[0] for x in found_dot]


def _transpose(cts: Sequence[Array], *args: Any, simulated: Simulated | Batch, n: int) -> Any:
    values = [_once(x) if eqx.is_inexact_array(x) else x for x in args[:n]]
    found = iter(simulated.cotangents(values, [None if is_no_tangent(ct) else _once(ct) for ct in cts]))
    return [None] * n + [next(found) for x in args[n:] if is_undefined_primal(x)]


def _batch(args: Sequence[Array], dims: Sequence[int | None], *, simulated: Simulated | Batch, n: int) -> Any:
    sizes = {x.shape[dim] for x, dim in zip(args, dims, strict=True) if dim is not None}
    batch = Batch(simulated, tuple(dims), n, sizes.pop())
    return _tangents.bind(*args, simulated=batch, n=n), [0] * len(batch.types)


def _refused(*_: Any) -> Any:
    raise TypeError(
        "A second derivative of a simulation cannot use reverse mode (jax.grad, jax.jacrev, jax.vjp, jax.hessian). "
        "Instead, use forward mode twice, as in jax.jacfwd(jax.jacfwd(f))."
    )


@jax.custom_jvp
def _once(x: Array) -> Any:
    # `x`, which cannot be differentiated: JAX's own message would name its loop.
    return x


_once.defjvp(_refused)
_tangents: Any = new_primitive(
    "tangents_of_a_simulation",
    evaluate=_evaluated,
    shapes=_shapes,
    jvp=_jvp,
    transpose=_transpose,
    batch=_batch,
    traced=_evaluated,
    lower_on_cpu=as_lowering(_evaluated),
)


def _same(x: Array) -> list[Any]:
    return [x]


# The identity, for a second derivative: the message of JAX in reverse mode would name its loop.
_forward_only: Any = new_primitive(
    "forward_mode_only",
    evaluate=_same,
    shapes=_same,
    jvp=lambda x, x_dot: (_forward_only.bind(*x), _forward_only.bind(*x_dot)),
    transpose=_refused,
    batch=lambda x, dims: (_forward_only.bind(*x), dims),
    traced=_same,
    lower_on_cpu=as_lowering(_same),
)


def _first(*args: Any, n: int) -> list[Any]:
    return [*args[:n]]


def _batch_all(args: Sequence[Array], dims: Sequence[int | None], *, n: int) -> Any:
    size = next(x.shape[dim] for x, dim in zip(args, dims, strict=True) if dim is not None)
    pairs = zip(args[:n], dims[:n], strict=True)
    first = [jnp.broadcast_to(x, (size, *x.shape)) if dim is None else jnp.moveaxis(x, dim, 0) for x, dim in pairs]
    return _in_one_batch.bind(*first, *args[n:], n=n), [0] * n


# The first n arguments. In a batch all of them are in the batch if any argument is, because all tangents are: JAX does
# not support an operation with values outside of a batch and tangents in it.
_in_one_batch: Any = new_primitive(
    "in_one_batch",
    evaluate=_first,
    shapes=_first,
    jvp=_refused,
    transpose=_refused,
    batch=_batch_all,
    traced=_first,
    lower_on_cpu=as_lowering(_first),
)

RECORDED = 2**18
"""The largest number of steps that can be differentiated if `max_steps` is None."""


class Probe(NamedTuple):
    """What a loop with a probe carries and records.

    - `size` (2, n): the largest sizes so far of motion and tangent, by component.
    - `ends` (m,): the ends of the steps [s]. They are negative for a rejected step at whose start a jump or the end of
      the simulation occurs. Other rejected steps are omitted.
    - `count`: the number of recorded steps; the ends of those after m are lost.
    - `jumps` (k, 3): for each jump the index of its step in `ends`, its event, and the distance to the event within
      which the step ends [s]. Unused rows are -1.
    """

    size: Array
    ends: Array
    count: Array
    jumps: Array

    def recorded(self, t1: Array, keep: Array, ends: Array, jump: tuple[Array, Array, Array] | None) -> Probe:
        """The same with a step that ends at t1, if it is accepted (`keep`) or the simulation `ends` here.

        `jump`: the number of the next jump, its event, or -1 if none is due, and its reach."""
        i, jumps = self.count, self.jumps
        if jump is not None:
            k, event, reach = jump
            ends |= event >= 0
            row = jnp.stack([i.astype(reach.dtype), event, reach])
            jumps = jumps.at[jnp.where(event >= 0, k, len(jumps))].set(row, mode="drop")
        times = self.ends.at[i].set(jnp.where(keep, t1, -t1))
        return self._replace(ends=times, count=i + (keep | ends).astype(i.dtype), jumps=jumps)


class Replay(NamedTuple):
    """The recorded steps of a loop with a probe.

    - `ends`, `count`, `jumps`: see `Probe`. Their bits are stored as integers: otherwise each step in reverse mode
      would add a cotangent of the size of the array, even if the array is constant.
    - `after` (k, n): the packed states after the jumps, None if no event changes the state.
    - `state`, `taken`, `accepted`: the results of that loop, see `Steps`.
    """

    ends: Array
    count: Array
    jumps: Array
    after: Array | None
    state: Any
    taken: Array
    accepted: Array

    @classmethod
    def of(cls, probe: Probe, after: Array | None, state: Any, taken: Array, accepted: Array) -> Replay:
        bits = {4: jnp.int32, 8: jnp.int64}[probe.ends.dtype.itemsize]
        ends, jumps = (jax.lax.bitcast_convert_type(x, bits) for x in (probe.ends, probe.jumps))
        return cls(ends, jnp.minimum(probe.count, len(ends)), jumps, after, state, taken, accepted)

    def end(self, i: Array, t0: Array, duration: Array, stop: Array | None) -> tuple[Array, Array, Array]:
        """The end of step i, which begins at t0; whether it is accepted; and whether it ends at a discontinuity.

        `stop`: the next discontinuity, or None. An end at `stop` or `duration` has the derivative of this time.
        After the last step, the end is t0."""
        recorded = jax.lax.bitcast_convert_type(self.ends[i], t0.dtype)
        t1, at_stop = jnp.abs(recorded), jnp.zeros_like(recorded, bool)
        t1 = jnp.where(t1 == duration, duration, t1)
        if stop is not None:
            at_stop = (recorded > 0) & (jnp.abs(t1 - stop) <= rounding(t1, duration))
            t1 = jnp.where(at_stop, stop, t1)
        return jnp.where(i < self.count, t1, constant(t0)), recorded > 0, at_stop

    def jump_of(self, i: Array, k: Array, like: Array) -> tuple[Array, Array]:
        """The event of the jump k, -1 if it does not occur in step i, and its reach [s]."""
        step, event, reach = jax.lax.bitcast_convert_type(self.jumps[jnp.minimum(k, len(self.jumps) - 1)], like.dtype)
        return jnp.where((step == i.astype(step.dtype)) & (k < len(self.jumps)), event, -1.0), reach


class Probing(NamedTuple):
    """How a loop integrates motion and tangent, (2, n), as one state.

    - `rates`: the rates of the motion.
    - `y` (n,): the tangent of the initial state.
    - `args`: the tangent of the arguments of the rates, None for those that are not differentiated.
    - `noise`: a component below this share of the largest one is regarded as a rounding error.
    """

    rates: Callable[..., Array]
    y: Array
    args: Any
    noise: Array

    def start(self, y: Array, most: int | None, most_jumps: int) -> tuple[Array, Probe]:
        """Motion and tangent at the start of a simulation of at most `most` steps, and the probe."""
        both, m = jnp.stack([y, self.y]), RECORDED if most is None else most
        jumps = jnp.full((most_jumps, 3), -1.0, y.dtype)
        return both, Probe(jnp.abs(both), jnp.zeros(m, y.dtype), jnp.zeros((), int), jumps)

    def again(self, y: Array, probe: Probe) -> Array:
        """Motion and tangent after a jump of the motion to y.

        The direction is generic again, because an event may reset a coordinate. Its components keep their sizes."""
        return jnp.stack([y, jnp.sign(generic(y, y.size)) * probe.size[1]])

    def step(self, probe: Probe, both: Array, error: Array) -> tuple[Array, Array]:
        """The error of the tangent in a step, relative to its size; and the sizes. `both`: the end of the step."""
        size = jnp.maximum(probe.size, jnp.abs(both))
        # A tangent that is zero but for rounding errors is not smooth: its steps would become as short as possible.
        least = jnp.maximum(size[1], self.noise * jnp.maximum(size[0], jnp.max(size[1])))
        share = jnp.where(least > 0, error[1] / jnp.where(least > 0, least, 1.0), 0.0)
        return jnp.sqrt(jnp.mean(share * share)), size

    def of_both(self, t: Array, both: Array, args: RateArguments) -> Array:
        """The rates of motion and tangent, (2, n). As one state, they need no more operations of the solver."""
        direction = self._along(args)
        moved = jax.tree.map(lambda d, x: None if d is None else x, direction, args, is_leaf=_is_none)
        still = jax.tree.map(lambda d, x: x if d is None else None, direction, args, is_leaf=_is_none)
        of_motion = lambda y, moved: self.rates(t, y, eqx.combine(moved, still))  # noqa: E731
        return jnp.stack(jax.jvp(of_motion, (both[0], moved), (both[1], direction)))

    def _along(self, args: RateArguments) -> Any:
        """The tangent of these arguments. A solver may have replaced samples by numbers."""
        if callable(args.signals):
            return self.args
        signals = {
            name: d
            if not is_samples(d) or is_samples(args.signals[name])
            else None
            if d.values is None
            else d.values[0]
            for name, d in self.args.signals.items()
        }
        return dataclasses.replace(self.args, signals=signals)


def generic(like: Array, n: int) -> Array:
    """A generic tangent of the first n numbers; zero for the others."""
    numbers = _factors(n)
    return jnp.asarray(np.concatenate([numbers, np.zeros(like.size - n)]), like.dtype)


def _factors(n: int) -> np.ndarray:
    """Numbers between 0.5 and 1.5 of both signs."""
    random = np.random.default_rng(20)
    return random.uniform(0.5, 1.5, n) * random.choice([-1.0, 1.0], n)


def direction_of(args: RateArguments, moved: PyTree[bool], signals_move: bool) -> Any:
    """A generic tangent of the arguments of the rates, None for those that are not differentiated.

    `moved`: the system with True for each number that is differentiated. The tangent of a number is proportional to its
    size. It is the same for all samples of a signal, because a rough tangent would need short steps.
    """
    factors = iter(_factors(len(jax.tree.leaves(moved))))
    system_dot = jax.tree.map(
        lambda moves, x: None if moves is None else _along(moves, x, next(factors)),
        moved, tree_of(args.system), is_leaf=_is_none,
    )  # fmt: skip
    nowhere = jax.tree.map(lambda _: None, args)
    if not jax.tree.leaves(system_dot):
        system_dot = nowhere.system
    elif isinstance(args.system, Packed):
        everywhere = jax.tree.map(
            lambda d, x: jnp.zeros_like(x) if d is None and eqx.is_inexact_array(x) else d,
            system_dot, tree_of(args.system), is_leaf=_is_none,
        )  # fmt: skip
        system_dot = Packed.of(everywhere, args.system.numbers.dtype)

    def of_signal(x: Numbers) -> Any:
        if not is_samples(x):
            return _along(signals_move, x, 1.0)
        size = _along(signals_move, x.values, 1.0)
        size = None if size is None else jnp.full_like(x.values, jnp.max(size))
        return eqx.tree_at(lambda s: s.values, jax.tree.map(lambda _: None, x), size, is_leaf=_is_none)

    signals_dot = jax.tree.map(of_signal, args.signals, is_leaf=is_samples)
    return dataclasses.replace(nowhere, system=system_dot, signals=signals_dot)


def _along(moves: bool, x: Numbers, factor: Component) -> Array | None:
    if not moves or not eqx.is_inexact_array(x):
        return None
    size = constant(jnp.where(jnp.isfinite(x), jnp.abs(x), 0.0))
    return jnp.asarray(factor, x.dtype) * jnp.where(jnp.any(size > 0), size, 1.0)


def _is_none(x: object) -> bool:
    return x is None
