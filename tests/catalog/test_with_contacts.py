"""Entries with contacts. Independent implementations in 30 digits computed the figures."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import Backlash, Belt, KerbWheel, RockingBlock, SliderCrankWithClearance, Woodpecker

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.weekly
@pytest.mark.published
def test_a_rocking_block_agrees_with_housners_article(published):
    """From rest at 0.25 rad. The ratio of the rates at a landing is 1 - 3/2 sin^2 alpha = 0.85."""
    times = [0.6402887800202485, 1.338581180728541, 1.8563203472495828]
    start = jk.assemble(RockingBlock(), {"angle": 0.25}, touching=("left",))
    ride = jk.simulate(RockingBlock(), start, jnp.linspace(0.0, 2.2, 23), **TIGHT)
    jumps = ride.jumps
    assert int(jumps.count) == 3
    np.testing.assert_allclose(jumps.t[:3], times, rtol=1e-11)
    ratios = jumps.after.u[:3, 2] / jumps.before.u[:3, 2]
    quantity = "rates of a rocking block after a landing, relative to those before"
    published("Housner (1963)", quantity, [0.85] * 3, ratios, 1e-11)
    np.testing.assert_allclose(jumps.impulses[0], [0.0, 0.0, 0.39402725362360147, jumps.impulses[0, 3]], atol=1e-11)
    end = [0.6066692039354292, 0.03521304161358452, 0.25908375349019, -0.07633795052670474, -0.4270593460316235]
    found = [ride[name][-1] for name in ("y", "angle", "x_dot", "y_dot", "rate")]
    np.testing.assert_allclose(found, np.array(end) * [1, -1, -1, 1, -1], rtol=0, atol=1e-10)  # mirrored
    np.testing.assert_array_equal(ride.contacts["right"], np.where(ride["angle"] < 0, 2, 0))


@pytest.mark.weekly
def test_a_block_on_a_belt_sticks_and_slips_at_the_times_of_the_closed_form():
    """Closed forms of the times at which the block sticks and slips, from rest at x = 0."""
    times = [0.205758423033744, 2.101402346772704, 4.2602012771151685, 5.7602012771151685, 7.919000207457633]
    times += [9.419000207457632, 11.577799137800097, 13.077799137800097, 15.23659806814256, 16.736598068142563]
    times += [18.895396998485026]
    ride = jk.simulate(Belt(), jk.State([0.0], [0.0]), jnp.linspace(0.0, 20.0, 41), **TIGHT)
    assert int(ride.jumps.count) == len(times)
    np.testing.assert_allclose(ride.jumps.t[: len(times)], times, rtol=1e-11)
    np.testing.assert_allclose(ride["x"][-1], 0.8023015007574872, rtol=1e-11)
    sticks = np.asarray(ride.contacts["belt"]) == 2
    np.testing.assert_allclose(ride["x_dot"][sticks], 0.5, rtol=1e-12)
    np.testing.assert_allclose(ride["belt.friction"][~sticks], 2.5 * np.sign(0.5 - ride["x_dot"][~sticks]), rtol=1e-12)


@pytest.mark.weekly
def test_a_motor_drives_a_load_through_backlash():
    """With the torque A cos(w t) and e = 0. Momentum is conserved: the motor reaches the load with the speed
    A sin(w t) / w / J_m and continues with A sin(w t) / w / (J_m + J_l). It lifts off when the torque changes its sign.
    """
    A, w, Jm, Jl, half = 0.01, 3.0, 1e-3, 5e-3, 0.1
    meets, lifts = np.arccos(1.0 - half * Jm * w**2 / A) / w, 0.5 * np.pi / w
    torque = {"torque": lambda t, state: A * jnp.cos(w * t)}
    ride = jk.simulate(
        Backlash(restitution=0.0), jk.State([0.0] * 2, [0.0] * 2), jnp.linspace(0.0, 0.8, 17), torque, **TIGHT
    )
    jumps = ride.jumps
    assert int(jumps.count) == 2
    np.testing.assert_allclose(jumps.t[:2], [meets, lifts], rtol=1e-11)
    momenta = A * np.sin(w * jumps.t[:2]) / w
    np.testing.assert_allclose(jumps.after.u[:2], np.outer(momenta / (Jm + Jl), [1.0, 1.0]), rtol=1e-11)
    np.testing.assert_allclose(jumps.before.u[0], [momenta[0] / Jm, 0.0], rtol=1e-11)
    closed = (ride.t > meets) & (ride.t < lifts)
    force = A * np.cos(w * ride.t[closed]) * Jl / (Jm + Jl)
    np.testing.assert_allclose(ride["drive.normal"][closed], force, rtol=1e-10)


@pytest.mark.weekly
def test_a_slider_with_clearance():
    """The first two impacts and the end of the figures for the parameters of Flores et al. (2010)."""
    start = jk.State([0.0] * 3, [150.0, -75.0, 0.0])
    ride = jk.simulate(SliderCrankWithClearance(), start, jnp.linspace(0.0, 0.024, 25), **TIGHT)
    jumps = ride.jumps
    upper = [name.startswith("upper") for name in ride.contact_names]
    np.testing.assert_allclose(jumps.t[:2], [0.002692502752021212, 0.005612363190210417], rtol=1e-11)
    impulses = np.asarray(jumps.impulses[:2]).reshape(2, 4, 2)[:, upper, 0]
    expected = [[0.05574032307375234, 0.055185692993416496], [0.01667721707019048, 0.016511274611780626]]
    np.testing.assert_allclose(impulses, expected, rtol=1e-10)
    end = [1.9234696776339004, -0.4885840511083045, 84.84423130850142, 15.15940314237841]
    found = [ride[name][-1] for name in ("crank", "rod", "crank_rate", "rod_rate")]
    np.testing.assert_allclose(found, end, rtol=1e-7)  # impacts accumulate


@pytest.mark.weekly
def test_a_wheel_without_friction_leaves_the_edge():
    """Energy and the normal force m g cos(phi) - m v^2 / R give cos(phi) = (2 + v0^2 / (g R)) / 3 at the lift-off."""
    v0, g, R, kerb = 1.4, 9.81, 0.35, 0.08
    start = jk.State([-0.3, R + kerb, 0.0], [v0, 0.0, 0.0])
    jumps = jk.simulate(KerbWheel(friction=0.0), start, jnp.linspace(0.0, 1.5, 31), **TIGHT).jumps
    cosine = (2.0 + v0**2 / (g * R)) / 3.0
    sine = np.sqrt(1.0 - cosine**2)
    v = np.sqrt(g * R * cosine)
    np.testing.assert_allclose(jumps.before.q[0], [R * sine, kerb + R * cosine, 0.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(jumps.before.u[0], [v * cosine, -v * sine, 0.0], rtol=0, atol=1e-9)
    last = int(jumps.count) - 1
    fall = np.sqrt((v * sine) ** 2 + 2.0 * g * (kerb + R * cosine - R))
    np.testing.assert_allclose(jumps.before.u[last], [v * cosine, -fall, 0.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(jumps.t[last] - jumps.t[0], (fall - v * sine) / g, rtol=0, atol=1e-9)


@pytest.mark.weekly
def test_a_wheel_rolls_over_the_edge():
    """Without slip, the energy 3/4 m v^2 + m g y is constant."""
    v0, g, R, kerb = 1.0, 9.81, 0.35, 0.08
    start = jk.State([-0.3, R + kerb, 0.0], [v0, 0.0, v0 / R])
    ride = jk.simulate(KerbWheel(friction=1.5), start, jnp.linspace(0.0, 1.5, 31), **TIGHT)
    on_edge = np.asarray(ride.contacts["kerb"]) == 2
    assert 0 < np.sum(on_edge & np.asarray(ride["x"] > 0))
    squares = (ride["x_dot"] ** 2 + ride["y_dot"] ** 2)[on_edge]
    expected = v0**2 + 4.0 / 3.0 * g * (R + kerb - ride["y"][on_edge])
    np.testing.assert_allclose(squares, expected, rtol=1e-8)
    np.testing.assert_allclose(ride["spin"][on_edge], np.sqrt(squares) / R, rtol=1e-8)


@pytest.mark.weekly
@pytest.mark.published
def test_the_woodpecker_toy_has_the_published_period(published):
    """The sleeve jams in each period, so one multiplier is not zero."""
    jammed = jk.assemble(Woodpecker(), {"bird": -0.2788}, {"bird_rate": -7.4583, "climb": -0.3411}, touching=("lower",))
    ride = jk.simulate(Woodpecker(), jammed, jnp.linspace(0.0, 0.6, 601), rtol=1e-10, atol=1e-12)
    flies = np.max([ride.contacts[name] for name in ride.contact_names], axis=0) == 0
    i = np.flatnonzero(flies)[-10]
    orbit = jk.stability.periodic(Woodpecker(), jk.State(ride.q[i], ride.u[i]), period=0.146)
    source = "Leine, Van Campen and Glocker (2003)"
    published(source, "period of the woodpecker toy [s]", 0.146, orbit.period, 5e-4)
    np.testing.assert_allclose(orbit.period, 0.1459760651, rtol=1e-9)
    np.testing.assert_allclose(orbit.multipliers, [-0.839155653, 0.0, 0.0, 0.0], atol=1e-8)
    # In the simulation, the deviation of the period from its limit changes by the multiplier in each hop.
    events, jumps = ride.jumps.event[: int(ride.jumps.count)], ride.jumps
    strikes = [i for i, event in enumerate(events) if jumps.names[int(event)] == "beak" and jumps.impulses[i, 0] > 0]
    periods = np.diff(jumps.t[np.array(strikes)])
    ratios = (periods[1:] - orbit.period) / (periods[:-1] - orbit.period)
    np.testing.assert_allclose(ratios[-1], orbit.multipliers[0].real, rtol=0.1)
