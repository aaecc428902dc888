"""Sensors that report late, or through a low-pass filter: their formulas, and derivatives beside differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from systems import Track, responses

from jaxkane.fit import Delay, Gain, LowPass, Offset, Simulation, Trial, fit, forward_selection
from jaxkane.fit.problem import model

delayed_signal, low_passed = jax.jit(model.delayed_signal), jax.jit(model.low_passed)
T = jnp.linspace(0.0, 1.0, 41)


@pytest.mark.slow_cases("False")
@pytest.mark.parametrize("irregular", [False, True])
def test_a_delayed_signal_equals_the_earlier_signal(irregular):
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


def test_a_delayed_signal_with_a_repeated_last_time():
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


def test_a_low_pass_filter_satisfies_its_differential_equation():
    t = T + 0.004 * jnp.sin(40.0 * T)
    y, time_constant = jnp.sin(6.0 * t), 0.08
    slope = (y[1] - y[0]) / (t[1] - t[0])
    rate = lambda at, x: (np.interp(at, t, y) - x) / time_constant  # noqa: E731
    exact = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), [y[0] - time_constant * slope], t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.005
    )
    np.testing.assert_allclose(low_passed(t, y, jnp.array(time_constant)), exact.y[0], atol=1e-7)
    np.testing.assert_allclose(low_passed(t, y, jnp.array(0.0)), y, atol=1e-14)
    for at in (0.0, 1e-4, 0.05):  # derivatives, from both sides of zero
        ends = [low_passed(t, y, jnp.array(at + d)) for d in (-1e-6, 1e-6)]
        found = jax.jacfwd(low_passed, 2)(t, y, jnp.array(at))
        np.testing.assert_allclose(found, (ends[1] - ends[0]) / 2e-6, atol=1e-4)
    repeated = low_passed(jnp.append(t, t[-1]), jnp.append(y, y[-1]), jnp.array(0.05))
    np.testing.assert_allclose(repeated[:-1], low_passed(t, y, jnp.array(0.05)), atol=1e-14)
    assert repeated[-1] == repeated[-2]


def tracks(order):
    """Motions that are seen through a low-pass filter of 0.12 s."""
    rng, t, trials = np.random.default_rng(order), np.linspace(0.0, 3.0, 121), []
    for k in range(6):
        push = np.sin((2.0 + k) * t + k)
        rates = lambda at, s, push=push: [  # noqa: E731
            s[1], 1.2 * np.interp(at, t, push), (s[0] - s[2]) / 0.12, (s[2] - s[3]) / 0.12
        ]  # fmt: skip
        moved = scipy.integrate.solve_ivp(rates, (0.0, 3.0), [0.0] * 4, t_eval=t, rtol=1e-9, atol=1e-11).y
        seen = moved[1 + order] + 0.001 * rng.normal(size=t.size)
        trials.append(Trial(t, {"x": seen}, {"push": push}, sigma=0.001, initial={"x": 0.0, "x_dot": 0.0}))
    return trials


@pytest.mark.weekly
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.weekly)])
def test_a_low_pass_filter_is_selected_and_its_time_constant_estimated(order):
    before = fit(Track(gain=1.0), tracks(order), "gain", simulation=Simulation(step=0.025))
    candidates = [Gain("x"), Offset("x"), Delay("x"), LowPass("x"), LowPass("x", order=2)][-3 if order == 1 else 0 :]
    search = forward_selection(before, candidates, refits=None)
    name = ("time constant of x", "time constant (twice) of x")[order - 1]
    assert search.selected == (name,)
    low, high = search.fit.intervals()[name]
    assert high - low < 0.02
    assert low < 0.12 < high
    assert search.fit.variance < 1.3


@pytest.mark.weekly_cases(all_but=["Delay-2.5-1000.0"])
@pytest.mark.parametrize("unit", [2e-6, 1e3])  # [s] between samples: 500 kHz, and three times an hour
@pytest.mark.parametrize(("kind", "true"), [(LowPass, 4.0), (Delay, 2.5)])
def test_delays_and_time_constants_in_any_unit_of_time(unit, kind, true):
    """A time constant and a delay of some samples, without a scale."""
    t = np.arange(60.0)
    push = np.sin(0.3 * t)
    x = 1.2 * responses(t, push)[0][:, 0]
    changed = (low_passed if kind is LowPass else delayed_signal)(jnp.asarray(t), jnp.asarray(x), jnp.array(true))
    seen = np.asarray(changed) + 0.01 * np.random.default_rng(0).normal(size=t.size)
    trial = Trial(unit * t, {"x": seen}, {"push": push}, sigma=0.01, initial={"x": 0.0, "x_dot": 0.0})
    system, step = Track(gain=1.0 / unit**2), Simulation(step=unit)
    found = fit(system, trial, ["gain", kind("x", of="sensor")], simulation=step)
    gain, time = found.estimates.values()
    assert found.ok, found
    assert (gain * unit**2, time / unit) == pytest.approx((1.2, true), rel=0.02)


@pytest.mark.slow
def test_excluded_samples_do_not_count_in_the_variance_accounted_for():
    """The first 0.5 s precede the first delayed input. There, the measurements are far from all others."""
    t = np.linspace(0.0, 2.0, 21)
    x = np.where(t < 0.45, 1e3, 0.1 * np.sin(3.0 * t))
    trial = Trial(t, {"x": x}, {"push": np.sin(5.0 * t)}, sigma=0.1, initial={"x": 0.0, "x_dot": 0.0})
    free = ("gain", Delay("push", bounds=(0.0, 0.5)))
    found = fit(Track(), trial, free, steps=0, simulation=Simulation(step=0.1))
    used, r = x[5:], found.residuals["trial"]["x"][5:] * 0.1
    assert np.all(np.isnan(found.residuals["trial"]["x"][:5]))
    share = 1.0 - np.sum(r**2) / np.sum((used - used.mean()) ** 2)
    assert found.variance_accounted_for["x"] == pytest.approx(share, rel=1e-9)


def test_invalid_low_pass_filters_are_rejected():
    trials = tracks(1)[:1]
    for item, said in (
        (LowPass("push"), "no channel push"),
        (LowPass("x", of="input"), "`of` must be 'sensor' or None"),
        (LowPass("x", order=3), "`order` must be 1 or 2"),
        ((LowPass("x"), LowPass("x")), "more than once"),
    ):
        with pytest.raises(ValueError, match=said):
            fit(Track(), trials, item)
    with pytest.raises(TypeError, match="must be the name of a channel"):
        fit(Track(), trials, LowPass(3))
    with pytest.raises(ValueError, match=r"LowPass\('x'\): a fit with `noise` .* `jaxkane.sensors.low_pass`"):
        fit(Track(), trials, LowPass("x"), noise={"x_dot": 0.1})
