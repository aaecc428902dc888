"""Products of small matrices as sums of products of numbers, as in a small neural network. Knows arrays only."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

_LONGEST, _LARGEST = 64, 4096  # sum, number of products


def is_small(equation: Any) -> bool:
    """Whether a `dot_general` is one that is better written out."""
    (contracted, _), _ = equation.params["dimension_numbers"]
    shape = equation.invars[0].aval.shape
    length = math.prod(shape[i] for i in contracted)
    return length <= _LONGEST and length * equation.outvars[0].aval.size <= _LARGEST


def sum_of_products(equation: Any, x: Array, y: Array) -> Array:
    """What a `dot_general` gives: over (batch, free of x, free of y)."""
    contracted, batch = equation.params["dimension_numbers"]
    x, y = (_ordered(jnp.asarray(z), along, over) for z, along, over in zip((x, y), contracted, batch, strict=True))
    aval = equation.outvars[0].aval
    return jnp.sum(x[:, :, None, :] * y[:, None, :, :], axis=-1).reshape(aval.shape).astype(aval.dtype)


def _ordered(x: Array, contracted: tuple[int, ...], batch: tuple[int, ...]) -> Array:
    """As (batch, free, contracted)."""
    free = [i for i in range(x.ndim) if i not in (*contracted, *batch)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, contracted)]
    return jnp.transpose(x, (*batch, *free, *contracted)).reshape(sizes)
