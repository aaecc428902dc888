"""Derivatives of functions of components, exact zeros kept. Knows JAX; knows no mechanics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .._scalars.components import is_exact, is_zero
from .._scalars.types import Component
from .values import Row


def jvp(f: Callable[..., Any], primals: Sequence[Component], tangents: Sequence[Component]) -> tuple[Any, Any]:
    """`jax.jvp` of a function of components: exact inputs and outputs stay exact, and have exact zero derivatives."""
    moving = [i for i, dx in enumerate(tangents) if not is_zero(dx)]
    constants: list[Component | None] = []
    treedef = None

    def arrays_only(*xs):
        nonlocal treedef
        arguments = list(primals)
        for i, x in zip(moving, xs, strict=True):
            arguments[i] = x
        leaves, treedef = jax.tree.flatten(f(*arguments))
        constants[:] = [x if is_exact(x) else None for x in leaves]
        return [x for x in leaves if not is_exact(x)]

    arrays = [x for x in (*primals, *tangents) if not is_exact(x)]
    xs = [jnp.asarray(primals[i], dtype=jnp.result_type(*arrays)) for i in moving]
    dxs = [jnp.asarray(tangents[i], dtype=x.dtype) for i, x in zip(moving, xs, strict=True)]
    if moving:
        values, derivatives = jax.jvp(arrays_only, xs, dxs)
    else:
        values = arrays_only()
        derivatives = [0.0] * len(values)
    values, derivatives = iter(values), iter(derivatives)
    f_x = [next(values) if c is None else c for c in constants]
    f_dx = [next(derivatives) if c is None else 0.0 for c in constants]
    return jax.tree.unflatten(treedef, f_x), jax.tree.unflatten(treedef, f_dx)


def transposed(f: Callable[..., Any], primals: Sequence[Component], cotangents: Any) -> Row:
    """`jax.vjp` of a function of components: the derivative of `f` at `primals`, transposed, times `cotangents`.

    `cotangents` stand as f's outputs do. What f returns exactly is constant, and what meets it is dropped.
    """
    moves: list[bool] = []

    def arrays_only(*xs):
        leaves = jax.tree.leaves(f(*xs))
        moves[:] = [not is_exact(x) for x in leaves]
        return [x for x in leaves if not is_exact(x)]

    outputs, pull = jax.vjp(arrays_only, *primals)
    leaves = [ct for ct, m in zip(jax.tree.leaves(cotangents), moves, strict=True) if m]
    return pull([jnp.asarray(ct, dtype=x.dtype) for ct, x in zip(leaves, outputs, strict=True)])


def unit(n: int, r: int) -> Row:
    """The r-th of n directions of the speeds."""
    return tuple(1.0 if i == r else 0.0 for i in range(n))
