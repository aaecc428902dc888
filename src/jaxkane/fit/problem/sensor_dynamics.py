"""Sensor dynamics: a delay and a first-order low-pass filter."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def delayed_signal(t: Float[Array, " n"], y: Float[Array, " n"], delay: Array) -> Float[Array, " n"]:
    """y(t - delay) for samples y, by cubic interpolation (Catmull and Rom).

    The slopes are those of parabolas through three neighbouring samples. The extrapolation is linear. The last time may
    be repeated, which occurs in padded windows.
    """
    h = jnp.diff(t)
    # Replace the divisor too: masking only the quotient leaves NaN in its derivative.
    lasting = jnp.where(h > 0, h, jnp.ones_like(h))
    d = jnp.where(h > 0, jnp.diff(y) / lasting, 0.0)  # (n-1,)
    d = jnp.where(h > 0, d, d[jnp.maximum(jnp.sum(h > 0) - 1, 0)])
    if t.shape[0] > 2:
        both = h[:-1] + h[1:]
        inner = (d[:-1] * h[1:] + d[1:] * h[:-1]) / jnp.where(both > 0, both, 1.0)
        before = jnp.concatenate([d[:1], inner[:-1]])
        # The last interval of nonzero length is treated as the end.
        inner = jnp.where(h[1:] > 0, inner, 2 * d[:-1] - before)
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


def low_passed(t: Float[Array, " n"], y: Float[Array, " n"], time_constant: Array) -> Float[Array, " n"]:
    """The solution x of time_constant dx/dt = y - x, for y linear between samples.

        x_k+1 = y_k+1 - T s_k + a_k (x_k - y_k + T s_k),   s_k: slopes,   a_k = exp(-h_k / T)

    The filter starts as if y had always had its initial slope. For T <= 0, the result is y - T s, so that it is
    differentiable at T = 0. The last time may be repeated, which occurs in padded windows.
    """
    h, T = jnp.diff(t), time_constant
    ramp = T * jnp.where(h > 0, jnp.diff(y) / jnp.where(h > 0, h, 1.0), 0.0)  # (n - 1,)
    lasts = T > 0
    a = jnp.where(lasts, jnp.exp(-h / jnp.where(lasts, T, 1.0)), 0.0)
    # A repeated last time must not change x, which it would for T <= 0.
    a = jnp.where(h > 0, a, 1.0)

    def go_on(x: Array, now: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        a, ramp, y, y_next = now
        x = y_next - ramp + a * (x - y + ramp)
        return x, x

    first = y[0] - ramp[0]
    return jnp.concatenate([first[None], jax.lax.scan(go_on, first, (a, ramp, y[:-1], y[1:]))[1]])
