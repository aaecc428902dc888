"""Limit cycles of a motorcycle with tyres that saturate: weave and wobble, from the Hopf points of straight running."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import ConstantSpeed, MagicFormula, Tyre, sharp_motorcycle
from jaxkane.stability import family, limit_cycle, steady_turn

WEAVE, WOBBLE = 5.934966209, 55.37382006  # [m/s], `critical_speeds` of Sharp's motorcycle


def saturated(law, load):
    """The law with the same stiffness for small slip, whose largest force is the load [N]."""
    stiffness, ratio = law.cornering_stiffness / load, law.camber_stiffness / law.cornering_stiffness
    return Tyre(lateral=MagicFormula(stiffness, camber_ratio=ratio, relaxation_length=law.relaxation_length))


def motorcycle(speed):
    """Sharp's motorcycle with saturating tyres at a constant speed [m/s]."""
    sharp = sharp_motorcycle()
    loads = 1427.48564789, 1007.47086477  # [N], on the rear and the front wheel at rest
    tyres = zip((sharp.rear_tyre, sharp.front_tyre), loads, strict=True)
    rear, front = (saturated(tyre.lateral, load) for tyre, load in tyres)
    return sharp.with_parts(rear_tyre=rear, front_tyre=front, drive=ConstantSpeed(speed))


def cycles(speed, steer, until, **steps):
    """The limit cycles from a Hopf point near this speed, until another speed. `steer`: the first amplitude [rad]."""
    system = motorcycle(speed)
    straight = steady_turn(system, hold=("roll",))
    small = limit_cycle(system, straight, {"steer": steer}, parameter="drive.speed")
    # The amplitude is proportional to the square root of the distance from the Hopf point.
    assert abs(float(small.system.drive.speed) / speed - 1) < 1e-3
    towards = {"drive.speed": np.sign(until - speed)}
    return family(small.system, small, towards=towards, until={"drive.speed": until}, **steps)


@pytest.mark.weekly
def test_weave_and_wobble_have_limit_cycles():
    weave = cycles(WEAVE, 0.02, 5.87, step=0.3, max_step=1.0)
    assert np.all(weave.stable)  # below the weave speed, the motorcycle weaves and does not fall
    wobble = cycles(WOBBLE, 0.01, 56.5, step=0.3, max_step=1.0)
    # Straight running capsizes slowly at this speed. Wobble of a sufficient amplitude stops this.
    (point,) = wobble.bifurcations
    assert point.kind == "branch point"
    assert not wobble.stable[0]
    assert wobble.stable[-1]
    for found in (weave, wobble):
        check(found.orbit(len(found) - 1))


def check(orbit):
    """The orbit repeats itself in a simulation."""
    rtol, atol, system, start = 1e-7, 1e-9, orbit.system, orbit.state
    ts = jnp.linspace(0.0, 4.0 * orbit.period, 21)
    later = jk.simulate(system, start, ts, rtol=1e-11, atol=1e-11, max_steps=100_000).end
    drifts = [i for i, name in enumerate(system.coordinates) if name not in ("roll", "steer", "pitch")]
    np.testing.assert_allclose(np.delete(later.q, drifts), np.delete(start.q, drifts), rtol=rtol, atol=atol)
    np.testing.assert_allclose(later.u, start.u, rtol=rtol, atol=atol)
    np.testing.assert_allclose(later.x, start.x, rtol=rtol, atol=atol)
