"""Which sums of parameters motions determine, and their values by least squares."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from swings import ARMS, FREE, FRICTION, Swing, random_samples, swings

import jaxkane as jk
from jaxkane.fit import Trial, base_parameters, regressor
from jaxkane.fit.inverse.base_parameters import random_states
from jaxkane.fit.inverse.kinematics import KinematicSamples, kinematic_samples
from jaxkane.joints import Actuator, Link, Loop, Site, hinge, mechanism


@pytest.mark.slow
def test_double_pendulum_has_the_base_parameters_of_khalil_and_dombre():
    """Khalil and Dombre: ZZ1 + L^2 M2, MX1 + L M2, MY1, ZZ2, MX2, MY2; with a free swing only their ratios."""
    found = base_parameters(Swing())
    assert found.texts == (
        "link1.Izz + L1^2 link2.m", "link1.mx", "link1.my + L1 link2.m", "link2.Izz", "link2.mx", "link2.my",
    )  # fmt: skip
    assert not found.ratios_only
    assert found.count == 6
    assert "link1.m" in found.without_influence
    assert "6 base parameters of 20 parameters" in str(found)
    _truth, _ = swings()
    np.testing.assert_allclose(found.of(found.values)[0], 4e-4 + 0.1 * 0.11**2 + 0.14 * 0.172719204**2)


@pytest.mark.slow
def test_free_swings_with_friction_determine_ratios_only():
    """Five numbers of a double pendulum with known lengths, as the README of `jk.data.multi_arm_pendulum` states."""
    at = {"center": (0.1, 0, 0), "inertia": (0.0, 0.0, 0.02)}
    links = [
        Link("L0", None, hinge("q0", (0, 0, 1), damping=0.1), mass=1.0, **at),
        Link("L1", "L0", hinge("q1", (0, 0, 1), damping=0.1), (0.3, 0, 0), mass=2.0, **at),
    ]
    bodies = {name: ("m", "mx", "Izz") for name in ("L0", "L1")}
    system = mechanism(links, gravity=(0.0, -9.81, 0.0))
    found = base_parameters(system, bodies=bodies, parameters=["damping.q0", "damping.q1"])
    assert found.ratios_only
    assert found.count == 5
    assert len(found.places) == 6


@pytest.mark.weekly
@pytest.mark.parametrize("second", [1e6, 1e-6])
def test_base_parameters_in_other_units_of_time(second):
    """A second is a million units of time, or the millionth part of one."""

    class Rescaled(Swing):
        def weights(self, motion):
            return jk.weight(motion, -9.8 / second**2 * motion.N.y)

    system = Rescaled(k1=2e-4 / second, k2=3e-5 / second)
    found, known = (base_parameters(x, bodies=ARMS, parameters=FRICTION) for x in (system, Swing()))
    assert found.without_influence == known.without_influence == ("link1.m",)
    assert found.texts == known.texts
    _, at = swings()
    rows = jax.vmap(lambda q, u, a: regressor(system, 0.0, q, u, a, bodies=ARMS, parameters=FRICTION))
    of_data = base_parameters(rows(at.q, at.u / second, at.u_dot / second**2), sigma={"rate1": 1.0, "rate2": 1.0})
    assert of_data.without_influence == ("link1.m",)


@pytest.mark.weekly
def test_a_puma_robot_has_36_base_parameters():
    """Mayeda, Yoshida and Osuka, Base parameters of manipulator dynamic models, 1990; the sums are Khalil's."""
    quarter = np.pi / 2
    turns = (0.0, -quarter, 0.0, -quarter, quarter, -quarter)
    places = ((0, 0, 0), (0, 0, 0), (0.4318, 0, 0.15), (0.02, 0.4318, 0), (0, 0, 0), (0, 0, 0))
    whole = {"center": (0.1, 0.02, 0.03), "inertia": ((0.02, 0.001, 0.002), (0.001, 0.03, 0.003), (0.002, 0.003, 0.04))}
    links = [
        Link(f"L{i}", f"L{i - 1}" if i else None, hinge(f"q{i}", (0, 0, 1)), places[i], ("1", (turns[i],)), 1.0 + i,
             **whole)
        for i in range(6)
    ]  # fmt: skip
    found = base_parameters(mechanism(links, actuators=[Actuator(f"tau{i}", f"q{i}") for i in range(6)]))
    assert len(found.places) == found.count == 36
    assert "L3.Ixx - L3.Iyy + L4.Iyy" in found.texts
    assert "L5.Ixx - L5.Iyy" in found.texts
    assert found.texts[0].startswith("L0.Izz + L1.Iyy + ")
    assert "2 position.L2.z L2.mz" in found.texts[0]


def test_estimates_from_exact_data_are_exact():
    tolerance = 1e-9
    truth, at = swings()
    row = lambda q, u, a: regressor(truth, 0.0, q, u, a, parameters=FRICTION)  # noqa: E731
    rows = jax.vmap(row)(*(jnp.asarray(x) for x in (at.q, at.u, at.u_dot)))
    found, of_rows = base_parameters(Swing(), at, parameters=FRICTION), base_parameters(rows)
    expected = found.of(jax.tree.map(lambda x: x[0], rows).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=tolerance, atol=tolerance)
    assert found.count == len(of_rows.places) == 8
    assert of_rows.texts[0] == f"link1.Izz + {0.172719204**2:.4g} link2.m"
    assert found.unexplained < 1e-12
    assert "Rank of these data: 8" in str(found)
    with pytest.raises(ValueError, match="many instants"):
        base_parameters(jax.tree.map(lambda x: x[0], rows))


@pytest.mark.weekly
def test_deviations_cover_the_truth():
    """Of 25 data sets with noisy torques, each base parameter; with a known sigma, and with an estimated one."""
    truth, at = swings()
    expected = None
    for sigma in (None, {"rate1": 0.002, "rate2": 0.002}):
        z = []
        for seed in range(25):
            torque = at.inputs["torque1"] + np.random.default_rng(seed).normal(0.0, 0.002, len(at))
            noisy = dataclasses.replace(at, inputs={"torque1": torque})
            found = base_parameters(truth, noisy, bodies=ARMS, parameters=FRICTION, sigma=sigma)
            expected = found.of(found.values) if expected is None else expected
            z.append((found.estimates - expected) / found.deviations)
        assert 0.6 < np.std(z) < 1.3
        assert np.all(np.abs(np.mean(z, axis=0)) < 0.7)


@pytest.mark.weekly
def test_unidentifiable_base_parameters_are_reported_and_keep_their_values():
    """The second arm hangs still: its inertia is told by nothing."""
    truth, at = swings()
    q, u, u_dot = (np.array(x) for x in (at.q, at.u, at.u_dot))
    q[:, 1], u[:, 1], u_dot[:, 1] = np.pi, 0.0, 0.0
    torque = {"torque1": np.random.default_rng(1).normal(0.0, 0.3, len(at))}
    still = KinematicSamples(at.t, q, u, u_dot, torque)
    found = base_parameters(truth, still, bodies=ARMS, parameters=FRICTION, sigma={"rate1": 0.01, "rate2": 0.01})
    assert "not determined by these data" in str(found)
    assert any("link2.Izz" in text for text in found.undetermined)
    place = list(found.texts).index("link2.Izz")
    assert found.estimates[place] == pytest.approx(2e-3 + 0.1 * 0.15**2)
    assert np.isinf(found.deviations[place])


@pytest.mark.slow
def test_invalid_samples_are_rejected():
    truth, at = swings()
    rest, gaps, t = np.zeros((60, 2)), np.array(at.u_dot), np.linspace(0.0, 1.0, 101)
    gaps[5:] = np.nan
    assert len(KinematicSamples(at.t, at.q, at.u, gaps)) == 5
    base = lambda *arrays, **more: base_parameters(truth, KinematicSamples(*arrays), **more)  # noqa: E731
    turns = Trial(t, {"angle1": (30 * t + 1) % (2 * np.pi), "angle2": t}, sigma=0.1)
    few = Trial(t[:10], {"angle1": t[:10], "angle2": t[:10]}, sigma=0.1)
    for ask, message in (
        (lambda: base(at.t[:1], at.q[:1], at.u[:1], at.u_dot[:1], bodies=ARMS), "nothing remains to estimate"),
        (lambda: KinematicSamples(at.t, at.q, at.u, np.nan * at.u_dot), "every instant contains a number that is not"),
        (lambda: KinematicSamples(at.t, at.q, at.u[:, 0], at.u_dot), r"`u` \(60,\)"),
        (lambda: base(at.t, at.q[:, :1], at.u, at.u_dot), "has 2 coordinates .*, but the samples have 1"),
        (lambda: base(at.t, at.q, at.u, at.u_dot, {"torque3": 0.0}), "no input or state named torque3"),
        (lambda: base_parameters(truth, at, sigma={"rate1": 0.1}), "`sigma` of rate2 must be"),
        (lambda: base(at.t, rest, rest, rest, bodies=ARMS), "nothing moves, and no load acts"),
        (lambda: kinematic_samples(truth, Trial(t, {"angle1": t}, sigma=0.1)), "need angle2, which was not measured"),
        (lambda: kinematic_samples(truth, turns), r"angle1 jumps by a whole turn at t = 0\.\d+ s. Make the angle"),
        (lambda: kinematic_samples(truth, few), "has 10 samples"),
        (lambda: kinematic_samples(truth, []), "`motions` is empty"),
    ):
        with pytest.raises(ValueError, match=message):
            ask()
    # A blow changes a rate by as much between two samples, and a torque: neither wraps. Nor does a length.
    wrapped = turns.measured["angle1"]
    blow = Trial(t, {"angle1": t, "angle2": t, "rate1": wrapped}, {"torque1": wrapped}, sigma=0.1)
    assert len(kinematic_samples(truth, blow, spacing=0.05)) > 50
    metres = type("Metres", (type(truth),), {"units": {"angle1": "m"}})()
    assert len(kinematic_samples(metres, turns, spacing=0.05)) > 50


class Lagging(Swing):
    """The torque is that of a motor that lags: a state of the first order."""

    states = ("motor",)

    def loads(self, t, q, u, motion, inputs):
        return self.weights(motion), jk.Torque(inputs["motor"] * motion.N.z, motion["link1"])

    def state_rates(self, t, q, u, x, motion, now):
        return [(now["torque1"] - x["motor"]) / 0.1]


@pytest.mark.weekly
def test_loads_that_depend_on_first_order_states():
    truth, _ = swings()
    system = Lagging(**{name: getattr(truth, name) for name in FREE if name[0] != "k"})
    at = random_samples(system, 20)
    found = base_parameters(Lagging(), at, bodies=ARMS)
    expected = found.of(regressor(system, 0.0, at.q[0], at.u[0], at.u_dot[0], bodies=ARMS).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=1e-9)
    with pytest.raises(ValueError, match="loads may depend on motor"):
        base_parameters(Lagging(), KinematicSamples(at.t, at.q, at.u, at.u_dot))


@pytest.mark.weekly
def test_base_parameters_estimated_from_a_simulation():
    truth, at = swings()
    torque = {"torque1": lambda t, state: 0.3 * jnp.cos(9 * t)}
    ride = jk.simulate(truth, jk.State([0.5, -0.4], [1.0, 2.0]), jnp.linspace(0.0, 2.0, 401), inputs=torque)
    found = base_parameters(Swing(), ride, bodies=ARMS, parameters=FRICTION)
    i = (0.0, at.q[0], at.u[0], at.u_dot[0])
    expected = found.of(regressor(truth, *i, bodies=ARMS, parameters=FRICTION).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=1e-3)
    with pytest.raises(ValueError, match="The trajectory has 11 times"):
        kinematic_samples(truth, jax.tree.map(lambda x: x[::40] if x.shape[:1] == (401,) else x, ride))


@pytest.mark.weekly
def test_base_parameters_of_a_closed_loop():
    """A four-bar linkage tells 8 sums; those of another one with the same lengths, from its motion, exactly."""

    def link(name, parent, position, mass=1.0, y=0.03):
        at = {"center": (0.2, y, 0), "inertia": (0, 0, 0.02)}
        return Link(name, parent, hinge(f"q{name}", (0, 0, 1)), position, mass=mass, **at)

    def four_bar(**b):
        links = [link("a", None, (0, 0, 0)), link("b", "a", (0.4, 0, 0), **b), link("c", "b", (0.9, 0, 0))]
        sites = [Site("end", "c", (0.6, 0, 0)), Site("ground", None, (0.8, 0, 0))]
        closed = [Loop("end", "ground")]
        down = (0, -9.81, 0)
        return mechanism(links, gravity=down, sites=sites, loops=closed, actuators=[Actuator("tau", "qa")])

    guess, truth = four_bar(), four_bar(mass=1.7, y=0.05)
    states = random_states(truth, 60)
    u_dot = jax.jit(jax.vmap(lambda t, q, u, now: jk.accelerations(truth, t, q, u, now)))(
        *(jnp.asarray(x) for x in (states.t, states.q, states.u)), {"tau": jnp.asarray(states.inputs["tau"])}
    )
    found = base_parameters(guess, dataclasses.replace(states, u_dot=u_dot))
    assert len(found.places) == found.count == 8
    i = (0.0, states.q[0], states.u[0], states.u_dot[0])
    np.testing.assert_allclose(found.estimates, found.of(regressor(truth, *i).values), atol=1e-7)
