"""Values that do not exist: NaN, and so is their derivative; and derivatives that are left out. Knows arrays only.

`jnp.where(missing, jnp.nan, x)` has the derivative zero where it is NaN, and an optimizer takes that for the end of its
search. A factor NaN instead would be read in reverse mode even by who does not read what is missing: 0 * NaN is NaN.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool


def nan_where(missing: Bool[Array, " *leading"], values: Any, origin: Any) -> Any:
    """`values`, and NaN where they are missing, with derivatives of any order that are NaN there too.

    **Arguments:**

    - `missing` (*leading): where there is no value. `values`: arrays (*leading, ...).
    - `origin`: all that the values follow from; its float arrays are what derivatives are taken by.

    The derivative of what is missing is NaN along every direction in which `origin` moves, and zero where it does not.
    In reverse mode, what is missing and not read adds exactly zero.
    """
    return _masked(False, missing, values, origin)


def nan_derivative_where(rough: Bool[Array, " *leading"], values: Any, origin: Any) -> Any:
    """`values` as they are, with derivatives of any order that are NaN where they are `rough`. As `nan_where`."""
    return _masked(True, rough, values, origin)


def all_finite(values: Any) -> Bool[Array, ""]:
    """Whether all float arrays in these are finite."""
    return jnp.all(jnp.isfinite(flat(jax.lax.stop_gradient(eqx.filter(values, eqx.is_inexact_array)))))


def flat(values: Any) -> Array:
    """All float arrays one after the other, real and imaginary parts apart."""
    parts = _raveled(values)
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def parts_of(values: Any) -> list[Array]:
    """All float arrays, real and imaginary parts apart: single numbers are one array, the others stay what they are."""
    parts = _raveled(values)
    single = [x for x in parts if x.size == 1]
    return [*([jnp.concatenate(single)] if single else []), *[x for x in parts if x.size > 1]]


def _raveled(values: Any) -> list[Array]:
    parts = [jnp.ravel(x) for x in jax.tree.leaves(values) if eqx.is_inexact_array(x)]
    return [part for x in parts for part in ((x.real, x.imag) if jnp.iscomplexobj(x) else (x,))]


def constant(values: Any) -> Any:
    """The same arrays, of which nothing has a derivative."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, values)


def derivative_free_where_not_finite(f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, with the derivative zero where any of its values is not finite.

    For trial values that will be thrown away: nobody reads them, but in reverse mode 0 * NaN would spoil the
    derivative of what `f` reads. Closed-over arrays count as arguments.
    """
    value, moving, fixed = _of_arrays(f, arguments)

    @jax.custom_jvp
    def gated(moving: Any, fixed: Any) -> Any:
        return value(moving, fixed)

    @gated.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        (moving, fixed), (moving_dot, _) = primals, tangents
        y, slope = jax.linearize(lambda moving: value(moving, fixed), moving)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]))
        return y, slope(jax.tree.map(lambda x_dot: jnp.where(finite, x_dot, jnp.zeros_like(x_dot)), moving_dot))

    return gated(moving, fixed)


def negligible(f: Callable[..., Array], *arguments: Any, transposes: bool = True) -> Array:
    """Zeros for the array `f(*arguments)`, whose value and first derivative are negligible, as of a product of two
    numbers that are both small; its second derivatives are those of `f`. Closed-over arrays count as arguments.

    The derivatives of `f` are compiled only where second ones are asked for. `transposes`: whether any derivative is
    in reverse mode, for which `f` is transposed at once.
    """
    value, moving, fixed = _of_arrays(f, arguments)

    @jax.custom_jvp
    def zero(moving: Any, fixed: Any) -> Array:
        y = jax.eval_shape(value, moving, fixed)
        return jnp.where(_never(flat(moving)), jnp.nan, jnp.zeros(y.shape, y.dtype))

    @zero.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        # The solution of dy - J dx = 0, dx = dx, is said to be dy = 0, but is differentiated as it is. It is one array,
        # since JAX transposes no such equations of which a part of the right-hand side is known.
        (moving, fixed), (moving_dot, _) = primals, tangents
        y, (x_dot, as_tree) = zero(moving, fixed), ravel_pytree(moving_dot)

        def equations(both: Array) -> Array:
            y_dot, x_dot = both[: y.size], both[y.size :]
            slope = jax.jvp(lambda x: value(x, fixed), (moving,), (as_tree(x_dot),))[1]
            return jnp.concatenate([y_dot - jnp.ravel(slope).astype(both.dtype), x_dot])

        right, given = jnp.pad(x_dot, (y.size, 0)), lambda _, right: right
        solution = jax.lax.custom_linear_solve(equations, right, given, given if transposes else None)
        return y, solution[: y.size].reshape(y.shape).astype(y.dtype)

    return zero(moving, fixed)


def _of_arrays(f: Callable[..., Any], arguments: Any) -> tuple[Callable[..., Any], Any, Any]:
    """`f(*arguments)` as a function of its float arrays and its others, closed-over ones among them; and these."""
    f = eqx.filter_closure_convert(f, *arguments)
    moving, other = eqx.partition((f, arguments), eqx.is_inexact_array)
    fixed, rest = eqx.partition(other, eqx.is_array)

    def value(moving: Any, fixed: Any) -> Any:
        f, arguments = eqx.combine(moving, fixed, rest)
        return f(*arguments)

    return value, moving, fixed


def _never(*points: Array) -> Array:
    """False, and in a batch where any of `points` is: what is batched in a derivative must be so in the value, or JAX
    takes the one for the other inside of a loop."""
    return functools.reduce(jnp.logical_or, [jnp.any(jnp.isnan(x)) for x in points], jnp.array(False)) & False


def _masked(shown: bool, missing: Array, values: Any, origin: Any) -> Any:
    parts = parts_of(origin)

    def one(x: Array) -> Array:
        if x.size == 0:
            return x
        real = jnp.finfo(x.dtype).dtype
        there = jnp.broadcast_to(jnp.reshape(missing, (*missing.shape, *(1,) * (x.ndim - missing.ndim))), x.shape)
        point = [part.astype(real) for part in parts]
        if jnp.iscomplexobj(x):
            return jax.lax.complex(_mask(shown, there, x.real, point), _mask(shown, there, x.imag, point))
        return _mask(shown, there, x, point)

    return jax.tree.map(one, values)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _mask(shown: bool, missing: Array, x: Array, point: list[Array]) -> Array:
    missing = missing | _never(*point)
    return jnp.where(missing, x if shown else jnp.full_like(x, jnp.nan), x)


# A part of the point that does not move, as the times of samples, takes no part in the derivative.
@functools.partial(_mask.defjvp, symbolic_zeros=True)
def _(shown: bool, primals: Any, tangents: Any) -> Any:
    (missing, x, point), (_, x_dot, point_dot) = primals, tangents
    if isinstance(x_dot, SymbolicZero):
        x_dot = jnp.zeros_like(x)
    moving = [tangent for tangent in point_dot if not isinstance(tangent, SymbolicZero)]
    return _mask(shown, missing, x, point), jnp.where(missing, nan_if_moved(moving, point, x), x_dot)


def nan_if_moved(tangents: list[Array], point: list[Array], like: Array) -> Array:
    """NaN everywhere if a `point`, which has these tangents or some of them, moves; else zero. `like`: of what shape
    and type. Twice, so that neither tangents nor cotangents cancel in the sum."""
    moves = sum([jnp.sum(_nan_if_not_zero(x, point)) for x in tangents], jnp.zeros((), like.dtype))
    return _nan_if_not_zero(jnp.broadcast_to(moves, like.shape), point)


def _nan_if_not_zero(b: Array, point: list[Array]) -> Array:
    """The x of 0 x = b: zero for b = 0, else there is none. Linear in b, and its own transpose.

    The zero belongs to a `point`: where it moves, the derivative of an x that does not exist does not exist either.
    """
    return jax.lax.custom_linear_solve(
        lambda x: _zero_times(x, point), b, lambda _, b: jnp.where(b == 0, jnp.zeros_like(b), jnp.nan), symmetric=True
    )


@jax.custom_jvp
def _zero_times(x: Array, point: list[Array]) -> Array:
    # Not a constant: what is batched in the derivative must be so in the value.
    return 0.0 * (x + sum(map(jnp.sum, point), jnp.zeros((), x.dtype)))


@_zero_times.defjvp
def _(primals: Any, tangents: Any) -> Any:
    (x, point), (_, tangents) = primals, tangents
    return _zero_times(x, point), jnp.where(x == 0, jnp.zeros_like(x), nan_if_moved(tangents, point, x))
