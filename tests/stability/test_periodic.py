"""Periodic orbits and their families: closed forms, the van der Pol oscillator, and walkers with impacts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import OnACircle, Pendulum
from scipy.special import ellipk

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.catalog import CompassGait, RimlessWheel
from jaxkane.stability import equilibrium, family, limit_cycle, periodic


class Particle(jk.System):
    """A particle of 1 kg on a line."""

    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="particle")])

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force(self.force(t, q["x"], u["v"]) * motion.N.x, motion["particle"]),)


class VanDerPol(Particle):
    mu: Scalar = parameter(1.0)

    def force(self, t, x, v):
        return self.mu * (1 - x**2) * v - x


class WithSections(VanDerPol):
    def events(self, t, q, u):
        return {"top": jk.falling(u["v"]), "far": jk.rising(q["x"] - 9.0), "both": q["x"] - 8.0}


class Circle(Particle):
    """x'' + x = x' (mu - x^2 - x'^2): a circle of radius sqrt(mu) with the period 2 pi, from a Hopf point at mu = 0."""

    mu: Scalar = parameter(0.1)

    def force(self, t, x, v):
        return v * (self.mu - x**2 - v**2) - x


class Oscillator(Particle):
    damping: Scalar = parameter(0.1)
    cubic: Scalar = parameter(0.0)
    amplitude: Scalar = parameter(1.0)
    frequency: Scalar = parameter(1.3)

    def force(self, t, x, v):
        return self.amplitude * jnp.cos(self.frequency * t) - x - self.damping * v - self.cubic * x**3


# x_max, period and multiplier, and their derivatives in mu: integration in 30 digits
MU_1 = (2.0086198608748433, 6.66328685932313, 0.0008596950636038052)
MU_1_SLOPES = (0.01387413165103662, 0.7315965977659252, -0.007372959119115083)
MU_5 = (2.0215080615623213, 11.61223066771957, 7.738555086859359e-38)
NEAR = jk.State([2.0], [0.1])


def numbers(mu, guess=NEAR):
    orbit = periodic(WithSections(mu), guess, section="top", period=6.6)
    return jnp.stack([orbit["x"], orbit.period, orbit.multipliers[0].real])


@pytest.mark.slow
def test_van_der_pol():
    orbit = periodic(WithSections(1.0), NEAR, section="top", period=6.6)
    np.testing.assert_allclose([orbit["x"], orbit.period], MU_1[:2], rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, MU_1[2:], rtol=1e-8)
    np.testing.assert_allclose(orbit.trivial_multiplier, 1.0, rtol=1e-11)
    assert orbit.stable
    assert orbit.residual < 1e-11
    assert "period 6.663286859 s, stable, largest multiplier 0.000859695" in repr(orbit)


@pytest.mark.weekly
def test_derivatives_of_the_van_der_pol_orbit_in_both_modes_and_a_batch():
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(mode(numbers))(1.0)
        np.testing.assert_allclose(slopes, MU_1_SLOPES, rtol=1e-8)
    found = jax.jit(jax.vmap(numbers))(jnp.array([0.3, 1.0]))
    np.testing.assert_allclose(found[1], MU_1, rtol=1e-9)
    np.testing.assert_allclose(found[0, 1], 6.31844320345411, rtol=1e-11)


@pytest.mark.weekly
def test_periodic_without_section_and_without_period():
    orbit = periodic(VanDerPol(1.0), NEAR)
    ride = orbit.ride
    assert ride.ok
    np.testing.assert_allclose(ride["x"][-1], ride["x"][0], rtol=1e-11)
    np.testing.assert_allclose(orbit.period, MU_1[1], rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, MU_1[2:], rtol=1e-8)


@pytest.mark.weekly
def test_multiple_shooting_finds_an_unstable_orbit_and_tiny_multiplier():
    """With -mu, time runs backwards: the multiplier is 1e37, and a simulation of the orbit does not return to it."""
    orbit = periodic(WithSections(5.0), NEAR, section="top", segments=40)
    np.testing.assert_allclose([orbit["x"], orbit.period], MU_5[:2], rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, MU_5[2:], rtol=1e-7)
    forwards = orbit.ride
    backwards = dataclasses.replace(forwards, q=forwards.q[::-1], u=-forwards.u[::-1])
    orbit = periodic(WithSections(-5.0), backwards, section="top", segments=40)
    np.testing.assert_allclose(orbit.period, MU_5[1], rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, 1.0 / MU_5[2], rtol=1e-6)
    assert not orbit.stable


def period_of(system):
    return 2 * jnp.pi / system.frequency


FORCED = {"period": period_of, "autonomous": False}
REST = jk.State([0.0], [0.0])


def forced(frequency, xp=np):
    """x + i v / frequency at t = 0, and the magnitude of the multipliers."""
    response = 1 / (1 - frequency**2 + 0.1j * frequency)
    return xp.stack(
        [response.real, -frequency * response.imag, 2 * np.pi / frequency, xp.exp(-0.1 * np.pi / frequency)]
    )


class Driven(Particle):
    inputs = ("push",)

    def loads(self, t, q, u, motion, inputs):
        force = inputs["push"] - q["x"] - 0.1 * u["v"]
        return (jk.Force(force * motion.N.x, motion["particle"]),)


def push(amplitude, t, state):
    return amplitude * jnp.cos(1.3 * t)


def driven(amplitude=1.0, guess=REST, period=2 * np.pi / 1.3, t=0.0):
    inputs = {"push": jax.tree_util.Partial(push, jnp.asarray(amplitude))}
    return periodic(Driven(), guess, inputs, period=period, autonomous=False, t=t)


def test_an_input_function_forces_an_orbit():
    orbit = driven()
    np.testing.assert_allclose(orbit.states[0], forced(1.3)[:2], rtol=1e-10)
    assert np.isnan(orbit.trivial_multiplier)


def test_the_orbit_at_time_stamps_of_today_has_the_phase_of_the_force():
    """In extended precision. A time near 1.7e9 s is rounded to 2e-7 s."""
    orbit, t = driven(t=1.7e9), np.longdouble(1.7e9)
    response = (forced(1.3)[0] - 1j * forced(1.3)[1] / 1.3) * np.exp(1j * np.longdouble(1.3) * t)
    np.testing.assert_allclose(orbit.states[0], [response.real, (1.3j * response).real], rtol=1e-5)
    np.testing.assert_allclose(orbit.t, 1.7e9, rtol=1e-15)


def test_an_orbit_may_have_the_amplitude_zero():
    for start in (1e-9, 0.1):
        orbit = driven(0.0, jk.State([start], [0.0]))
        np.testing.assert_allclose(orbit.states[0], 0.0, atol=1e-12)
        assert orbit.residual < 1e-6
        np.testing.assert_allclose(np.abs(orbit.multipliers), forced(1.3)[3], rtol=1e-5)


def test_a_period_that_the_force_does_not_have_raises():
    for part in (0.5, 1.001):
        with pytest.raises(ValueError, match=r"the equations at t and t \+ period differ"):
            driven(period=part * 2 * np.pi / 1.3)


def test_input_functions_that_use_the_time_or_traced_numbers_raise():
    with pytest.raises(ValueError, match="the equations depend on the time"):
        periodic(Driven(), NEAR, {"push": lambda t, state: jnp.cos(t)}, period=6.3)
    with pytest.raises(TypeError, match="uses a traced number from a closure"):
        jax.eval_shape(lambda k: periodic(Driven(), NEAR, {"push": lambda t, state: k}, period=6.3).period, 1.0)


@pytest.mark.slow
def test_a_family_in_the_frequency_requires_the_period_as_a_function():
    orbit = periodic(Oscillator(), REST, period=2 * np.pi / 1.3, autonomous=False)
    with pytest.raises(ValueError, match="'frequency' changes the period of the force"):
        family(Oscillator(), orbit, towards={"frequency": 1})


class WithFilter(VanDerPol):
    """An event that reads a first-order state."""

    states = ("low",)

    def state_rates(self, t, q, u, x, motion, now):
        return (q["x"] - x["low"],)

    def events(self, t, q, u, x):
        return {"mean": jk.falling(q["x"] - x["low"])}


@pytest.mark.slow
def test_a_section_may_read_first_order_states_at_any_time():
    orbit = periodic(WithFilter(), jk.State([1.9], [-0.5], [1.9]), section="mean", period=6.66, t=1.7e9)
    np.testing.assert_allclose(orbit.period, MU_1[1], rtol=1e-11)
    np.testing.assert_allclose(orbit["x"], orbit["low"], rtol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, [np.exp(-MU_1[1]), MU_1[2]], rtol=1e-7)


class VibratingTable(Particle):
    """A ball of 1 kg on a table with the height A sin(w t).

    An orbit with one impact in a period T = 2 pi / w has A w cos(w t) = g T (1 - e) / (2 (1 + e)) at the impact.
    """

    amplitude: Scalar = parameter(0.03)
    frequency: Scalar = parameter(20.0)
    restitution: Scalar = parameter(0.5)

    def force(self, t, x, v):
        return -9.81

    def contacts(self, t, q, u, motion):
        table = self.amplitude * jnp.sin(self.frequency * t)
        return {"table": jk.Contact(gap=q["x"] - table, restitution=self.restitution)}


def on_table(amplitude, share):
    """Height and speed of the ball at this share of the period after the table's middle, by the formula above."""
    T, g = 2 * np.pi / 20, 9.81
    impact = np.arccos(g * T / 6 / (20 * amplitude)) / 20
    flight = share * T - impact
    flight += T * (flight < 0)
    height = amplitude * np.sin(20 * impact) + 0.5 * g * flight * (T - flight)
    return jk.State([height], [g * (0.5 * T - flight)])


@pytest.mark.weekly
def test_a_ball_on_a_vibrating_table_and_its_fold():
    guess = on_table(0.0301, 0.5)
    start = jk.simulate(VibratingTable(), guess, np.array([0.5, 0.500001]) * np.pi / 10).state(0)
    assert start.contacts is not None
    orbit = periodic(VibratingTable(), start, t=np.pi / 20, **FORCED)
    np.testing.assert_allclose(orbit.states[0], [*on_table(0.03, 0.5).q, *on_table(0.03, 0.5).u], rtol=1e-9)
    np.testing.assert_allclose(
        orbit.multipliers, [-0.0862431836 + 0.4925059535j, -0.0862431836 - 0.4925059535j], rtol=1e-7
    )
    found = family(VibratingTable(), orbit, towards={"amplitude": -1}, steps=8)
    (fold,) = found.bifurcations
    assert fold.kind == "fold"
    np.testing.assert_allclose(fold.value, 9.81 * np.pi / 1200, rtol=1e-8)


@pytest.mark.weekly
def test_derivatives_of_a_forced_orbit_include_those_of_its_period():
    def found(frequency):
        orbit = periodic(Oscillator(frequency=frequency), REST, **FORCED)
        return jnp.stack([orbit["x"], orbit["v"], orbit.period, jnp.abs(orbit.multipliers[1])])

    np.testing.assert_allclose(found(1.3), forced(1.3), rtol=1e-10)
    slopes = jax.jit(jax.jacrev(found))(1.3)
    np.testing.assert_allclose(slopes, jax.jacfwd(lambda w: forced(w, jnp))(1.3), rtol=1e-8)


@pytest.mark.weekly
def test_the_folds_of_duffings_oscillator():
    """At a fold one multiplier is 1, and their product is exp(-damping * period) everywhere."""
    system = Oscillator(cubic=1.0, amplitude=0.3, frequency=0.6)
    start = periodic(system, REST, **FORCED)
    found = family(system, start, towards={"frequency": 1}, until={"frequency": 2.0}, step=0.05, max_step=0.2)
    assert [x.kind for x in found.bifurcations] == ["fold", "fold"]
    assert "fold at 1.779719524" in repr(found)
    assert found.reason == "frequency = 2"
    for fold in found.bifurcations:
        np.testing.assert_allclose(fold.orbit.multipliers[0], 1.0, rtol=1e-6)
        np.testing.assert_allclose(fold.orbit.multipliers[1], jnp.exp(-0.1 * fold.orbit.period), rtol=1e-6)
    np.testing.assert_allclose(found["frequency"][-1], 2.0, rtol=1e-14)
    assert np.all(np.diff(found.arclength) > 0)
    assert not np.all(found.stable)
    orbit = found.orbit(5)
    np.testing.assert_allclose(periodic(orbit.system, orbit, **FORCED)["x"], orbit["x"], rtol=1e-10)


def period_of_a_pendulum(angle):
    return 4 / np.sqrt(9.81) * ellipk(np.sin(np.asarray(angle) / 2) ** 2)


@pytest.mark.weekly
def test_a_family_of_a_conservative_system():
    orbit = periodic(Pendulum(), jk.State([0.5], [0.0]), hold=("angle",), period=2.0)
    np.testing.assert_allclose(orbit.multipliers, 1.0, rtol=1e-6)
    with pytest.raises(ValueError, match=r"form a family, along which (angle, period|period, angle) change"):
        periodic(Pendulum(), orbit.state, period=orbit.period)
    found = family(Pendulum(), orbit, towards={"angle": 1}, until={"angle": 2.5})
    np.testing.assert_allclose(found.period, period_of_a_pendulum(found["angle"]), rtol=1e-10)
    with pytest.raises(ValueError, match="rate, which is not in the `hold`"):
        family(Pendulum(), orbit, towards={"rate": 1})


@pytest.mark.weekly
def test_a_rotating_pendulum_advances_by_one_turn_per_period():
    turn = {"angle": 2 * np.pi}
    orbit = periodic(Pendulum(), jk.State([0.0], [8.0]), hold={"rate": 8.0}, advance=turn, period=1.0)
    np.testing.assert_allclose(orbit.period, 4 / 8 * ellipk(4 * 9.81 / 64), rtol=1e-11)


@pytest.mark.weekly
def test_a_hopf_point_starts_a_family_of_limit_cycles():
    system = Circle(0.001)
    orbit = limit_cycle(system, equilibrium(system), {"x": 0.1}, parameter="mu")
    np.testing.assert_allclose([orbit.system.mu, orbit.period], [0.01, 2 * np.pi], rtol=1e-9)
    found = family(orbit.system, orbit, towards={"mu": 1}, until={"mu": 0.5}, step=0.5, max_step=2.0)
    np.testing.assert_allclose(found["x"] ** 2 + found["v"] ** 2, found["mu"], rtol=1e-9)
    np.testing.assert_allclose(found.multipliers[-1, 0], 0.04321391826377225, rtol=1e-9)
    with pytest.raises(ValueError, match="there is no parameter nu"):
        limit_cycle(system, equilibrium(system), {"x": 0.1}, parameter="nu")
    with pytest.raises(ValueError, match="`amplitude` must be one of x, v"):
        limit_cycle(system, equilibrium(system), {"y": 0.1}, parameter="mu")


class Excited(jk.System):
    """A limit cycle x = cos t, whose square excites a second oscillator: its mean damping is `damping` - 0.03 / 2."""

    damping: Scalar = parameter(0.1)
    coordinates, speeds = ("x", "y"), ("v", "w")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        names = ("first", "second")
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[i] * N.x, u[i] * N.x), name=k) for i, k in enumerate(names)])

    def loads(self, t, q, u, motion, inputs):
        x, v, y, w = q["x"], u["v"], q["y"], u["w"]
        first = v * (1.0 - x**2 - v**2) - x + 0.1 * y
        second = (0.03 * x**2 - self.damping) * w - 1.7 * y
        return jk.Force(first * motion.N.x, motion["first"]), jk.Force(second * motion.N.x, motion["second"])


@pytest.mark.weekly
def test_a_neimark_sacker_point():
    start = periodic(Excited(), jk.State([1.0, 0.0], [0.0, 0.0]), period=6.3)
    (point,) = family(Excited(), start, towards={"damping": -1}, until={"damping": -0.1}).bifurcations
    assert point.kind == "Neimark-Sacker"
    np.testing.assert_allclose(point.value, 0.015, rtol=1e-9)
    np.testing.assert_allclose(jnp.abs(point.orbit.multipliers[:2]), 1.0, rtol=1e-9)


class Pushed(Excited):
    """The second particle has damping, and the square of a limit cycle pushes it: its place drifts."""

    def loads(self, t, q, u, motion, inputs):
        x, v = q["x"], u["v"]
        first, second = v * (0.1 - x**2 - v**2) - x, x**2 - 0.2 * u["w"]
        return jk.Force(first * motion.N.x, motion["first"]), jk.Force(second * motion.N.x, motion["second"])


@pytest.mark.weekly
def test_a_cyclic_coordinate_drifts():
    orbit = periodic(Pushed(), jk.State([0.3, 5.0], [0.0, 0.2]), period=6.3)
    np.testing.assert_allclose(orbit.multipliers, [0.5334880910911032, np.exp(-0.4 * np.pi)], rtol=1e-10)
    moved = orbit.ride["y"][-1] - orbit.ride["y"][0]
    np.testing.assert_allclose(moved, 0.05 / 0.2 * orbit.period, rtol=1e-9)
    np.testing.assert_allclose(orbit["y"], 5.0, rtol=1e-14)


@pytest.mark.weekly
def test_constraints_add_no_floquet_multipliers():
    released = jk.assemble(OnACircle(), {"x": np.sin(1.0), "y": -np.cos(1.0)}, {"x_dot": 0.0})
    orbit = periodic(OnACircle(), released, hold=("x",), period=2.1)
    np.testing.assert_allclose(orbit.period, period_of_a_pendulum(1.0), rtol=1e-10)
    np.testing.assert_allclose(orbit.multipliers, [1.0], rtol=1e-5)


# -- walkers: the section is an event with a jump


def wheel_by_formula(half, slope):
    rate = jnp.sqrt(4 * 9.81 * jnp.sin(half) * jnp.sin(slope)) / jnp.tan(2 * half)
    return jnp.stack([rate, jnp.cos(2 * half) ** 2])


def wheel(half, slope):
    orbit = periodic(RimlessWheel(half, slope), jk.State([-0.32, 0.0], [1.2]), section="step", period=1.2)
    return jnp.stack([orbit["rate"], orbit.multipliers[0].real])


@pytest.mark.slow
def test_rimless_wheel():
    orbit = periodic(RimlessWheel(), jk.State([-0.32, 0.0], [1.2]), section="step")
    np.testing.assert_allclose([orbit["rate"], orbit.multipliers[0].real], wheel_by_formula(0.4, 0.08), rtol=1e-11)
    np.testing.assert_allclose([orbit["angle"], orbit.trivial_multiplier], [0.08 - 0.4, 1.0], rtol=1e-11)
    ride = orbit.ride
    np.testing.assert_allclose(ride["angle"][-1], 0.08 + 0.4, rtol=1e-8)
    assert int(ride.jumps.count) == 1
    np.testing.assert_allclose(ride.jumps.t[0], orbit.period, rtol=1e-10)
    np.testing.assert_allclose(ride.jumps.energy[0], 0.5 * (orbit["rate"] * np.tan(0.8)) ** 2, rtol=1e-9)


@pytest.mark.weekly
def test_derivatives_of_the_rimless_wheel_agree_with_the_closed_form():
    found = jax.jit(jax.jacrev(wheel, argnums=(0, 1)))(0.4, 0.08)
    expected = jax.jacfwd(wheel_by_formula, argnums=(0, 1))(0.4, 0.08)
    np.testing.assert_allclose(jnp.stack(found), jnp.stack(expected), rtol=1e-8, atol=1e-8)


@pytest.mark.weekly
def test_the_compass_gait_and_its_period_doubling_are_found():
    guess = jk.State([-0.22, 0.32, 0.0], [1.09, 0.38])
    orbit = periodic(CompassGait(), guess, section="heel_strike")
    found = [orbit["stance"], orbit["swing"], orbit["stance_rate"], orbit["swing_rate"], orbit.period]
    expected = [-0.21866880293899055, 0.3233885580586503, 1.092383589883601, 0.3773739489071941, 0.7343463911587195]
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    gaits = family(CompassGait(), orbit, towards={"slope": 1}, until={"slope": 0.08})
    (doubling,) = gaits.bifurcations
    assert doubling.kind == "period doubling"
    np.testing.assert_allclose(doubling.value, 0.07663563158, rtol=1e-9)  # 4.39 degrees
    expected = [-1.0, -0.30505240096878733, 0.10566775299514994]
    np.testing.assert_allclose(doubling.orbit.multipliers, expected, rtol=1e-8)


@pytest.mark.weekly
def test_gaits_of_two_and_four_steps_begin_at_period_doublings():
    """Goswami, Thuilot and Espiau (1998), *A study of the passive gait of a compass-like biped robot*: near 4.4 and
    4.9 degrees."""
    orbit, angles = (
        periodic(CompassGait(slope=0.0765), jk.State([-0.241, 0.38, 0.0], [1.16, 0.2]), section="heel_strike"),
        [],
    )
    switch: dict = {}
    for n, end in ((1, 0.0768), (2, 0.086), (4, 0.0865)):
        gaits = family(orbit.system, orbit, towards={"slope": 1}, until={"slope": end}, **switch)
        assert np.all(gaits.stable[2:-1] if n > 1 else gaits.stable[:1])
        np.testing.assert_allclose(gaits.period[-1], 0.75 * n, rtol=0.02)
        if n < 4:
            (doubling,) = gaits.bifurcations
            angles.append(float(np.rad2deg(doubling.value)))
            orbit, switch = doubling.orbit, {"switch": "doubling"}
    np.testing.assert_allclose(angles, [4.39090, 4.91406], atol=1e-4)
    walk = jk.simulate(
        gaits.orbit(-1).system, gaits.orbit(-1).state, jnp.linspace(0.0, 3.05, 3), rtol=1e-12, atol=1e-12
    )
    after, start = walk.jumps.after, gaits.orbit(-1).state
    assert int(walk.jumps.count) == 4
    np.testing.assert_allclose([*after.q[3, :2], *after.u[3]], [*start.q[:2], *start.u], rtol=1e-7)
    assert np.abs(after.q[1, :2] - start.q[:2]).max() > 1e-3


class Escape(Particle):
    """x'' + 0.1 x' + x - x^2 = F sin(0.85 t)."""

    amplitude: Scalar = parameter(0.1)

    def force(self, t, x, v):
        return self.amplitude * jnp.sin(0.85 * t) - x + x**2 - 0.1 * v


@pytest.mark.slow
def test_forced_orbits_with_twice_the_period():
    T = 2 * np.pi / 0.85
    orbit = periodic(Escape(), jk.State([0.05], [-0.49]), period=T, autonomous=False)
    options = {"towards": {"amplitude": 1}, "until": {"amplitude": 0.102}}
    (doubling,) = family(Escape(), orbit, **options).bifurcations
    assert doubling.kind == "period doubling"
    branch = family(doubling.orbit.system, doubling.orbit, **options, switch="doubling")
    double = branch.orbit(-1)
    ride = jk.simulate(double.system, double.state, np.array([0.0, T, 2 * T]), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(double.period, 2 * T, rtol=1e-12)
    np.testing.assert_allclose(ride["x"][2], ride["x"][0], atol=1e-8)
    assert abs(ride["x"][1] - ride["x"][0]) > 0.1
    with pytest.raises(ValueError, match="exist on the other side"):
        family(doubling.orbit.system, doubling.orbit, towards={"amplitude": -1}, steps=2, switch="doubling")
    with pytest.raises(ValueError, match="has no multiplier of -1"):
        family(Escape(), orbit, towards={"amplitude": 1}, switch="doubling")


def gait_of_two_steps(slope):
    guess = jk.State([-0.241, 0.398, 0.0], [1.166, 0.114])
    return periodic(CompassGait(slope=slope), guess, section="heel_strike", returns=2, period=1.5)


@pytest.mark.weekly
def test_a_two_step_gait_beyond_the_period_doubling():
    slope = np.deg2rad(4.5)
    orbit = gait_of_two_steps(slope)
    walk = jk.simulate(orbit.system, orbit.state, jnp.linspace(0.0, 1.6, 3), rtol=1e-12, atol=1e-12)
    assert int(walk.jumps.count) == 2
    after, start = walk.jumps.after, orbit.state
    np.testing.assert_allclose([*after.q[1, :2], *after.u[1]], [*start.q[:2], *start.u], rtol=1e-9)
    np.testing.assert_allclose(walk.jumps.t[1], orbit.period, rtol=1e-10)
    assert np.abs(after.q[0, :2] - start.q[:2]).min() > 0.01
    jumps = orbit.ride.jumps
    assert np.max(np.abs(jk.audit(orbit.system, orbit.ride).energy_error)) < 1e-6
    assert int(jumps.count) == 2  # the samples end before the second jump
    np.testing.assert_allclose(jumps.energy[:2], walk.jumps.energy[:2], rtol=1e-9)
    np.testing.assert_allclose(jumps.impulses[:2], walk.jumps.impulses[:2], rtol=1e-9)
    np.testing.assert_allclose(orbit.ride["swing"][-1], orbit["stance"], rtol=1e-7)  # 1e-9 of a period before it
    low, high = (gait_of_two_steps(slope + h).period for h in (-1e-4, 1e-4))
    slope_of_period = jax.jit(jax.grad(lambda slope: gait_of_two_steps(slope).period))(slope)
    np.testing.assert_allclose(slope_of_period, (high - low) / 2e-4, rtol=1e-4)


def test_two_returns_to_a_section_in_five_segments():
    orbit = periodic(WithSections(1.0), NEAR, section="top", returns=2, segments=5)
    np.testing.assert_allclose(orbit.period, 2.0 * MU_1[1], rtol=1e-11)
    np.testing.assert_allclose(orbit.trivial_multiplier, 1.0, rtol=1e-9)


def test_a_crossing_of_the_start_plane_far_from_the_start_is_not_a_return():
    """From inside the limit cycle, the motion crosses the plane v = 0 downwards near x = 2 in each turn."""
    with pytest.raises(ValueError, match=r"the simulation of the guess ends at [0-9.]* s: max steps"):
        periodic(VanDerPol(1.0), jk.State([0.2], [0.0]), max_steps=300)


class Ratchet(Pushed):
    """A coordinate that drifts, and an event that reads it in its condition only."""

    def events(self, t, q, u):
        return {"tooth": jk.falling(u["v"] - 9.0, when=q["y"])}


@pytest.mark.slow
def test_a_coordinate_in_the_condition_of_an_event_must_be_periodic():
    with pytest.raises(ValueError, match="no periodic orbit was found"):
        periodic(Ratchet(), jk.State([0.3, 5.0], [0.0, 0.2]), period=6.3)


def test_an_orbit_under_a_trace_has_the_multipliers_of_all_states_that_events_use():
    found = jax.eval_shape(lambda T: periodic(Ratchet(), jk.State([0.3, 5.0], [0.0, 0.2]), period=T).multipliers, 6.3)
    assert found.shape == (3,)


# -- bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"section": "tap"}, "there is no event tap; did you mean 'top'"),
        ({"section": "both"}, "'both' has no direction"),
        ({"section": "far"}, "the simulation of the guess ends at 0.04[0-9]* s: top"),
        ({"period": 0.0}, "`period` must be a positive .* got 0"),
        ({"period": float("nan")}, "`period` must be a positive"),
        ({"autonomous": False}, "pass the period of the force"),
        ({"autonomous": False, "period": 6.6, "section": "top"}, "Omit `section`"),
        ({"hold": ("z",)}, "unknown: z; there are x, v"),
        ({"segments": 0}, "`segments` must be a positive whole number"),
        ({"returns": 1.0}, "`returns` must be a positive whole number, got 1.0"),
    ],
)
def test_invalid_options_raise(options, message):
    with pytest.raises(ValueError, match=message):
        periodic(WithSections(), NEAR, **options)


@pytest.mark.weekly
def test_guesses_without_a_periodic_orbit_raise():
    with pytest.raises(ValueError, match="the guess is an equilibrium or a steady motion"):
        periodic(WithSections(), REST, section="top", period=6.6)
    with pytest.raises(ValueError, match="the equations depend on the time"):
        periodic(Oscillator(), NEAR, period=1.0)
    with pytest.raises(ValueError, match=r"no periodic orbit was found|does not reach the end|ended at an equilibrium"):
        periodic(WithSections(), jk.State([0.5], [0.0]), section="top", period=1.0)
    with pytest.raises(ValueError, match="crosses the section 'top' against the direction"):
        periodic(WithSections(), jk.State([-2.0], [0.0]), section="top", period=6.66)
    with pytest.raises(ValueError, match="`returns` = 2 with `segments` = 3"):
        periodic(RimlessWheel(), jk.State([-0.32, 0.0], [1.1]), section="step", returns=2, segments=3)
    with pytest.raises(ValueError, match="the section 'step' is not crossed within"):
        periodic(RimlessWheel(), jk.State([-0.32, 0.0], [0.1]), section="step")


def test_periodic_under_jit_requires_a_period():
    with pytest.raises(ValueError, match=r"under jax\.jit, jax\.vmap and derivatives, pass `period`"):
        jax.eval_shape(lambda mu: periodic(WithSections(mu), NEAR, section="top").period, 1.0)
