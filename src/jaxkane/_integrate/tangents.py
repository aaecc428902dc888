"""A simulation as one operation of JAX with derivatives of its own.

The value of a simulation is computed without derivatives. Its tangents are computed by a second simulation, which also
controls their errors (see `probe`). This second simulation is one linear operation: forward mode evaluates it, reverse
mode evaluates its transpose. So it does not matter how a simulation is differentiated, or in which order with `jax.jit`
and `jax.vmap`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from .._scalarjit.compat import as_lowering, is_no_tangent, is_undefined_primal, new_primitive

Run = Callable[..., Any]
"""(arguments, moved, reverse) -> result. `moved`: the arguments with True for each array that is differentiated; None
for the value alone. `reverse`: whether the result supports reverse mode, else forward mode."""


def with_own_tangents(run: Run, arguments: Any, constants: Any) -> Any:
    """`run((arguments, constants), None, False)`, which can be differentiated with respect to `arguments` in both
    modes, and in forward mode again. `run` must not use traced numbers from outside."""
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
    def _(primals: Any, tangents: Any) -> Any:
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


def _evaluated(*args: Any, simulated: Any, n: int) -> list[Any]:
    return simulated.tangents(args[:n], args[n:])


def _shapes(*args: Any, simulated: Any, n: int) -> list[Any]:
    return [*simulated.types]


def _jvp(primals: Any, tangents: Any, *, simulated: Any, n: int) -> Any:
    places = [i for i, x_dot in enumerate(tangents) if not is_no_tangent(x_dot)]

    def floats_dot(*moving: Any) -> list[Any]:
        values = dict(zip(places, moving, strict=True))
        args = [values.get(i, x) for i, x in enumerate(primals)]
        return simulated.tangents(args[:n], args[n:])

    found, found_dot = jax.jvp(floats_dot, [primals[i] for i in places], [tangents[i] for i in places])
    return found, [_forward_only.bind(x)[0] for x in found_dot]


def _transpose(cts: Any, *args: Any, simulated: Any, n: int) -> Any:
    values = [_once(x) if eqx.is_inexact_array(x) else x for x in args[:n]]
    found = iter(simulated.cotangents(values, [None if is_no_tangent(ct) else _once(ct) for ct in cts]))
    return [None] * n + [next(found) for x in args[n:] if is_undefined_primal(x)]


def _batch(args: Any, dims: Any, *, simulated: Any, n: int) -> Any:
    sizes = {x.shape[dim] for x, dim in zip(args, dims, strict=True) if dim is not None}
    batch = Batch(simulated, tuple(dims), n, sizes.pop())
    return _tangents.bind(*args, simulated=batch, n=n), [0] * len(batch.types)


def _refused(*_: Any) -> Any:
    raise TypeError(
        "A derivative of a simulation is differentiated in reverse mode, or a derivative in reverse mode (jax.grad, "
        "jax.jacrev, jax.vjp) again. For a second derivative of a simulation use forward mode twice, as in "
        "jax.jacfwd(jax.jacfwd(f))."
    )


@jax.custom_jvp
def _once(x: Any) -> Any:
    """`x`, which cannot be differentiated: JAX's own message would name its loop."""
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


def _same(x: Any) -> list[Any]:
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


def _batch_all(args: Any, dims: Any, *, n: int) -> Any:
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
