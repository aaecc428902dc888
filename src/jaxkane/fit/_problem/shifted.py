"""Sensors that report late: by how much is a number that can be found. Knows samples and times; knows no system."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def earlier(t: Float[Array, " n"], y: Float[Array, " n"], delay: Array) -> Float[Array, " n"]:
    """y(t - delay) of samples, by cubics with the slopes of parabolas through three neighbours (Catmull and Rom).

    Outside it is continued by a straight line. The last time may be repeated.
    """
    h = jnp.diff(t)
    lasting = jnp.where(h > 0, h, jnp.ones_like(h))
    d = jnp.where(h > 0, jnp.diff(y) / lasting, 0.0)  # (n-1,)
    d = jnp.where(h > 0, d, d[jnp.maximum(jnp.sum(h > 0) - 1, 0)])
    if t.shape[0] > 2:
        both = h[:-1] + h[1:]
        inner = (d[:-1] * h[1:] + d[1:] * h[:-1]) / jnp.where(both > 0, both, 1.0)
        before = jnp.concatenate([d[:1], inner[:-1]])
        inner = jnp.where(h[1:] > 0, inner, 2 * d[:-1] - before)  # the last that lasts, as at the end
        slopes = jnp.concatenate([2 * d[:1] - inner[:1], inner, 2 * d[-1:] - inner[-1:]])
    else:
        slopes = jnp.broadcast_to(d, t.shape)
    at = t - delay
    i = jnp.clip(jnp.searchsorted(t, at, side="right") - 1, 0, t.shape[0] - 2)
    s, step = (at - t[i]) / lasting[i], lasting[i]
    y0, y1, m0, m1 = y[i], y[i + 1], step * slopes[i], step * slopes[i + 1]
    inside = y0 + s * (m0 + s * (3 * (y1 - y0) - 2 * m0 - m1 + s * (2 * (y0 - y1) + m0 + m1)))
    before, after = y[0] + slopes[0] * (at - t[0]), y[-1] + slopes[-1] * (at - t[-1])
    return jnp.where(at < t[0], before, jnp.where(at > t[-1], after, inside))
