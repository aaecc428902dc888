"""Where a quantity passes zero: in which direction, and when for the first time within a step. Knows numbers only."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._scalars.types import Component


class Crossing(eqx.Module):
    """A quantity that counts only where it passes zero in one direction. See `rising` and `falling`."""

    value: Any
    direction: int = eqx.field(static=True)


def rising(quantity: Component) -> Crossing:
    """For `System.events`: the motion ends where the quantity passes zero upwards.

        def events(self, t, q, u):
            return {"top": jk.falling(u["climb"]), "door": jk.rising(q["x"] - self.length)}

    A motion that starts on zero ends at once if the quantity leaves it upwards, and goes on if it does not.
    """
    return Crossing(quantity, 1)


def falling(quantity: Component) -> Crossing:
    """For `System.events`: the motion ends where the quantity passes zero downwards. See `rising`."""
    return Crossing(quantity, -1)


def first_crossing(
    g0: Float[Array, " n"],
    slope0: Float[Array, " n"],
    g1: Float[Array, " n"],
    slope1: Float[Array, " n"],
    direction: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Where in [0, 1] cubics through two ends first pass zero; infinite where they do not.

    **Arguments:** values `g0`, `g1` and slopes at 0 and 1; `direction`: 1 upwards, -1 downwards, 0 both. What is zero
    at 0 passes it if it leaves in its direction; without a direction, nothing passes zero at 0.
    """
    ends = zip(g0, slope0, g1, slope1, direction, strict=True)
    found = [_first_crossing(*(jnp.asarray(x, g0.dtype) for x in end)) for end in ends]
    return jnp.stack(found) if found else jnp.zeros_like(g0)


def _first_crossing(g0: Array, slope0: Array, g1: Array, slope1: Array, direction: Array) -> Array:
    """Of one cubic: scalars, so that all of it can be one function."""
    a, b, c = 2 * (g0 - g1) + slope0 + slope1, 3 * (g1 - g0) - 2 * slope0 - slope1, slope0
    p = lambda x: ((a * x + b) * x + c) * x + g0  # noqa: E731
    p_dot = lambda x: (3 * a * x + 2 * b) * x + c  # noqa: E731

    # Between its extrema a cubic passes zero once at most.
    low, high = _extrema(a, b, c)
    places = (jnp.zeros_like(a), low, high, jnp.ones_like(a))
    values = (g0, p(low), p(high), g1)
    # Which way it must go: without a direction, away from the side that it is on.
    side = jnp.where(g0 != 0, g0, jnp.where(values[1] != 0, values[1], jnp.where(values[2] != 0, values[2], g1)))
    way = jnp.where(direction == 0, -jnp.sign(side), direction)
    left, right, before, after, any_passes = places[0], places[1], values[0], values[1], jnp.zeros((), bool)
    for i in reversed(range(3)):
        passes = (way * values[i] <= 0) & (way * values[i + 1] >= 0) & (values[i] != values[i + 1])
        passes &= (direction != 0) | (values[i] != 0)
        left, right = jnp.where(passes, places[i], left), jnp.where(passes, places[i + 1], right)
        before, after = jnp.where(passes, values[i], before), jnp.where(passes, values[i + 1], after)
        any_passes |= passes

    # Newton's method inside the bracket; the step that follows is measured anew, so a few digits are enough.
    x = left + (right - left) * _ratio(before, before - after)
    for _ in range(6):
        value = p(x)
        left, right = jnp.where(way * value <= 0, x, left), jnp.where(way * value > 0, x, right)
        newton = x - _ratio(value, p_dot(x))
        x = jnp.where((newton >= left) & (newton <= right), newton, 0.5 * (left + right))
    return jnp.where(any_passes, x, jnp.inf)


def _extrema(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Where 3 a x^2 + 2 b x + c vanishes, within [0, 1] and in their order; 0 where it does not."""
    discriminant = b**2 - 3 * a * c
    q = -(b + jnp.where(b < 0, -1.0, 1.0).astype(b.dtype) * jnp.sqrt(jnp.maximum(discriminant, 0.0)))
    inside = lambda x: jnp.where((discriminant > 0) & (x > 0) & (x < 1), x, 0.0)  # noqa: E731
    x, y = inside(_ratio(q, 3 * a)), inside(_ratio(c, q))
    return jnp.minimum(x, y), jnp.maximum(x, y)


def _ratio(x: Array, y: Array) -> Array:
    return jnp.where(y == 0, 0.0, x / jnp.where(y == 0, 1.0, y))
