"""Missing values are NaN, and so are their derivatives. Depends on arrays only.

`jnp.where(missing, jnp.nan, x)` has the derivative zero where it is NaN, and an optimizer would regard that as
convergence. Multiplying by NaN does not work: in reverse mode a zero cotangent times NaN is NaN, even if the missing
value is never used.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, PyTree

from .compat import Tracer


def nan_where(missing: Bool[Array, " *leading"], values: PyTree, origin: PyTree) -> PyTree:
    """`values`, with NaN where they are missing; derivatives of any order are NaN there too.

    **Arguments:**

    - `missing` (*leading): where values are missing.
    - `values`: arrays (*leading, ...).
    - `origin`: all data from which the values are computed. Derivatives are taken with respect to its float arrays.

    The derivative of a missing value is NaN in every direction in which `origin` changes, and zero in the others. In
    reverse mode, a missing value that is not used contributes exactly zero.
    """
    return _with_rough_zero(1, missing, values, origin, lambda missing, x: jnp.where(missing, jnp.nan, x))


def nan_derivative_where(rough: Bool[Array, " *leading"], values: PyTree, origin: PyTree) -> PyTree:
    """`values` unchanged, with derivatives of any order that are NaN where they are `rough`. Arguments as
    `nan_where`."""
    return _with_rough_zero(1, rough, values, origin, lambda rough, x: jnp.where(rough, jax.lax.stop_gradient(x), x))


def all_finite(values: PyTree) -> Bool[Array, ""]:
    """Whether all float arrays in a tree are finite."""
    parts = parts_of(jax.lax.stop_gradient(eqx.filter(values, eqx.is_inexact_array)))
    return jnp.all(jnp.isfinite(jnp.concatenate(parts or [jnp.zeros(0)])))


def parts_of(values: PyTree) -> list[Array]:
    """All float arrays, with separate real and imaginary parts. Scalars are combined in one array, other arrays do not
    change."""
    rows = [jnp.ravel(x) for x in jax.tree.leaves(values) if eqx.is_inexact_array(x)]
    parts = [part for x in rows for part in ((x.real, x.imag) if jnp.iscomplexobj(x) else (x,))]
    single = [x for x in parts if x.size == 1]
    return [*([jnp.concatenate(single)] if single else []), *[x for x in parts if x.size > 1]]


def constant(values: PyTree) -> PyTree:
    """The same values without derivatives. Values of arrays that are differentiated without `jit` become concrete."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x, values)


def derivative_free_where_not_finite(f: Callable[..., Any], *arguments: Any) -> PyTree:
    """`f(*arguments)`, with zero derivatives if any of its values is not finite.

    For trial values that are discarded: they are not used, but in reverse mode 0 * NaN would make the derivatives with
    respect to the arguments NaN. Closed-over arrays count as arguments.
    """
    f = eqx.filter_closure_convert(f, *arguments)
    moving, other = eqx.partition((f, arguments), eqx.is_inexact_array)
    fixed, rest = eqx.partition(other, eqx.is_array)

    def value(moving: PyTree, fixed: PyTree) -> PyTree:
        f, arguments = eqx.combine(moving, fixed, rest)
        return f(*arguments)

    gated = jax.custom_jvp(value)

    @gated.defjvp
    def _(primals: PyTree, tangents: PyTree) -> PyTree:
        (moving, fixed), (moving_dot, _) = primals, tangents
        y, slope = jax.linearize(lambda moving: value(moving, fixed), moving)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]))
        return y, slope(jax.tree.map(lambda x_dot: jnp.where(finite, x_dot, jnp.zeros_like(x_dot)), moving_dot))

    return gated(moving, fixed)


def nan_beyond_second_derivative(rough: Bool[Array, ""], values: PyTree, origin: PyTree) -> PyTree:
    """`values`, with derivatives that are NaN from the third order on if they are `rough`. Arguments as `nan_where`."""
    return _with_rough_zero(3, rough, values, origin, lambda _, x: x)


def _with_rough_zero(
    order: int, rough: Array, values: PyTree, origin: PyTree, shown: Callable[[Array, Array], Array]
) -> PyTree:
    """`shown(rough, x)` for each array x of `values`; derivatives from this order on are NaN where `rough`."""
    parts = parts_of(origin)

    def one(x: Array) -> Array:
        if x.size == 0:
            return x
        where = jnp.reshape(rough, (*rough.shape, *(1,) * (x.ndim - rough.ndim)))
        real = jnp.finfo(x.dtype).dtype
        zero = _zero_until(order, where, jnp.zeros(x.shape, real), [part.astype(real) for part in parts])
        # Subtracted, so that -0.0 keeps its sign.
        return shown(where, x) - (jax.lax.complex(zero, zero) if jnp.iscomplexobj(x) else zero)

    return jax.tree.map(one, values)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _zero_until(order: int, rough: Array, zero: Array, point: list[Array]) -> Array:
    """Zero; its derivatives are zero below this order and NaN from this order on, where `rough`."""
    # Never true, but batched if any of `point` is. Primal and tangent must have the same batch axes in a `while_loop`.
    never = functools.reduce(jnp.logical_or, [jnp.any(jnp.isnan(x)) for x in point], jnp.array(False)) & False
    return jnp.where(never, jnp.nan, zero)


@functools.partial(_zero_until.defjvp, symbolic_zeros=True)
def _(order: int, primals: PyTree, tangents: PyTree) -> PyTree:
    (rough, zero, point), point_dot = primals, tangents[2]
    # A part of the point without a tangent, e.g. the times of samples, does not contribute to the derivative.
    moving = [tangent for tangent in point_dot if not isinstance(tangent, SymbolicZero)]
    y = _zero_until(order, rough, zero, point)
    if order == 1:
        return y, jnp.where(rough, nan_if_moved(moving, point, zero), zero)
    return y, _zero_until(order - 1, rough, zero, point) * sum(map(jnp.sum, moving), zero)


def nan_if_moved(tangents: list[Array], point: list[Array], like: Array) -> Array:
    """NaN everywhere if a `point` with these tangents changes, else zero. `like`: shape and dtype of the result.
    `nan_if_not_zero` is applied before and after the sum, so that neither tangents nor cotangents cancel."""
    moves = sum([jnp.sum(nan_if_not_zero(x, point)) for x in tangents], jnp.zeros((), like.dtype))
    return nan_if_not_zero(jnp.broadcast_to(moves, like.shape), point)


def nan_if_not_zero(b: Array, point: list[Array]) -> Array:
    """The x of 0 x = b: zero for b = 0, else NaN. Linear in b, and its own transpose.

    The zero belongs to a `point`: if it changes, the derivative of a NaN is NaN too.
    """
    return jax.lax.custom_linear_solve(
        lambda x: _zero_times(x, point), b, lambda _, b: jnp.where(b == 0, jnp.zeros_like(b), jnp.nan), symmetric=True
    )


@jax.custom_jvp
def _zero_times(x: Array, point: list[Array]) -> Array:
    # Not a constant: primal and tangent must have the same batch axes.
    return 0.0 * (x + sum(map(jnp.sum, point), jnp.zeros((), x.dtype)))


@_zero_times.defjvp
def _(primals: PyTree, tangents: PyTree) -> PyTree:
    (x, point), (_, tangents) = primals, tangents
    return _zero_times(x, point), jnp.where(x == 0, jnp.zeros_like(x), nan_if_moved(tangents, point, x))
