"""Sensors that report late, beside what their formulas say, and their derivatives beside differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane.fit import _model

delayed_signal = jax.jit(_model.delayed_signal)
T = jnp.linspace(0.0, 1.0, 41)


@pytest.mark.parametrize("irregular", [False, True])
def test_what_a_sensor_said_before(irregular):
    t = T + (0.004 * jnp.sin(40.0 * T) if irregular else 0.0)
    parabola = 1.0 + 2.0 * t - 3.0 * t**2
    for delay in (0.0, 0.013, 0.2, -0.05):
        at = t - delay
        inside = np.asarray((at >= t[0]) & (at <= t[-1]))
        found = delayed_signal(t, parabola, jnp.array(delay))
        np.testing.assert_allclose(found[inside], (1.0 + 2.0 * at - 3.0 * at**2)[inside], atol=1e-12)
    np.testing.assert_allclose(delayed_signal(t, parabola, jnp.array(0.1))[0], 1.0 - 0.2, atol=1e-12)  # straight on
    wave = jnp.sin(6.0 * t)
    slope = jax.jacfwd(delayed_signal, 2)(t, wave, jnp.array(0.0))
    np.testing.assert_allclose(slope[1:-1], -6.0 * jnp.cos(6.0 * t)[1:-1], atol=0.05)


def test_a_last_time_that_is_repeated():
    """As in a window that is shorter than others."""
    t, n = jnp.concatenate([T[:20], jnp.full(5, T[19])]), 20
    y = jnp.concatenate([jnp.sin(5.0 * T[:20]), jnp.full(5, jnp.sin(5.0 * T[19]))])
    found = delayed_signal(t, y, jnp.array(0.01))
    assert jnp.all(jnp.isfinite(found))
    np.testing.assert_allclose(found[:n], delayed_signal(t[:n], y[:n], jnp.array(0.01)), atol=1e-12)
    slope = jax.grad(lambda d: jnp.sum(delayed_signal(t, y, d)))(jnp.array(0.01))
    assert jnp.isfinite(slope)
    two = delayed_signal(T[:2], jnp.array([1.0, 3.0]), jnp.array(0.5 * T[1]))
    np.testing.assert_allclose(two, [0.0, 2.0], atol=1e-12)
