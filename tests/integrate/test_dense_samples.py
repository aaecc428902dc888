"""Samples much denser than the motion needs: which of them steps pass over, which they end at, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_clocks import Particle

import jaxkane as jk


def wave(t):
    return np.sin(5 * t) + 0.3


def place(t):
    return t / 5 - np.sin(5 * t) / 25 + 0.15 * t**2


def ride(ts, values, **options):
    push = {"push": jk.Samples(ts, values)}
    return jk.simulate(Particle(), jk.State([0.0], [0.0]), np.linspace(0.0, 1.0, 3), push, **options)


@pytest.mark.weekly
@pytest.mark.parametrize("n", [100_000, pytest.param(1_000_000, marks=pytest.mark.weekly)])
def test_a_smooth_signal_and_a_peak_with_dense_samples(n):
    """The samples of a smooth signal; and the same with a peak of one sample: a push of `height` dt [N s]."""
    atol, ts = 1e-8, np.linspace(0.0, 1.0, n)
    smooth = ride(ts, wave(ts))
    np.testing.assert_allclose(smooth["x"], place(smooth.t), atol=atol)
    assert smooth.stats["steps"] < 100
    height, i = 1000.0, n // 3 + 1
    peak = ride(ts, wave(ts) + height * (np.arange(n) == i))
    gained = height * (ts[1] - ts[0]) * np.maximum(smooth.t - ts[i], 0.0)
    assert gained[-1] > 1e4 * atol * (100_000 / n)
    np.testing.assert_allclose(peak["x"], place(smooth.t) + gained, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["noise", "coarse", "uneven"])
def test_steps_end_at_the_samples_of_non_smooth_signals(signal):
    """A remainder of a thousand times the tolerance; discontinuities of the slope; a gap in which the line is no wave.
    The place is that of the integrated interpolant."""
    n, rng = 10_000, np.random.default_rng(0)
    ts = np.linspace(0.0, 1.0, n)
    if signal == "uneven":
        ts = np.where(ts < 0.5, ts, ts + 0.3)
    values = {"noise": np.sin(ts) + 1e-4 * rng.normal(size=n), "coarse": np.sin(50 * ts)}.get(signal, np.sin(ts))
    found = ride(ts, values)
    fine = np.union1d(ts[ts <= 1.0], [1.0])
    a, h = np.interp(fine, ts, values), np.diff(fine)
    v = np.append(0.0, np.cumsum(h * (a[1:] + a[:-1]) / 2))
    np.testing.assert_allclose(found["x"][-1], np.sum(h * v[:-1] + h**2 * (2 * a[:-1] + a[1:]) / 6), atol=1e-8)
    assert (int(found.stats["steps"]) > 0.9 * n) == (signal != "uneven")


@pytest.mark.weekly
def test_derivatives_by_delay_and_scale_of_samples_agree_with_the_closed_form():
    """By a delay and by a factor of all values, against those of the motion in closed form."""
    atol, n = 1e-7, 9001
    ts = np.linspace(-1.0, 2.0, n)

    def end(x):
        return ride(ts + x[0], (1 + x[1]) * wave(ts), adjoint="forward")["x"][-1]

    slopes = jax.jit(jax.jacfwd(end))(jnp.zeros(2))
    # By d at d = 0, of the integral of (1 - t) wave(t - d).
    by_delay = -(1 - np.cos(5)) / 5
    np.testing.assert_allclose(slopes, [by_delay, place(1.0)], atol=atol)


@pytest.mark.slow
def test_each_jump_of_a_zero_order_hold_ends_a_step():
    ts = np.linspace(0.0, 1.0, 10_000)
    push = {"push": jk.Samples(ts, np.sin(ts), zero_order_hold=True)}
    assert jk.simulate(Particle(), jk.State([0.0], [0.0]), np.linspace(0.0, 1.0, 3), push).stats["steps"] >= 9_999


@pytest.mark.slow
def test_interpolation_of_long_samples_agrees_with_numpy():
    # From 32768 samples on a CPU, bisection and reading go entry by entry.
    rng = np.random.default_rng(0)
    ts = np.cumsum(rng.uniform(0.5, 1.5, 40_000))
    values = rng.normal(size=ts.size)
    t = np.concatenate([[ts[0] - 1.0, ts[0], ts[-1], ts[-1] + 1.0], ts[[1, 777, -2]], rng.uniform(ts[0], ts[-1], 5)])
    linear, held = (jk.Samples(ts, values, zero_order_hold=z) for z in (False, True))
    between, last = jax.jit(jax.vmap(lambda t: (linear(t), held(t))))(jnp.asarray(t))
    np.testing.assert_allclose(between, np.interp(t, ts, values), rtol=1e-12)
    np.testing.assert_array_equal(last, values[np.clip(np.searchsorted(ts, t, side="right") - 1, 0, None)])
