"""Steady motions and their families: closed forms, Basu-Mandal et al. (2007), and derivatives against differences."""

import dataclasses
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import RollingDisc

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.stability import cyclic_coordinates, equilibrium, family, steady_turn, straight_ahead, with_speeds

BIKE = jk.catalog.WhippleBicycle.benchmark()
CAPSIZE = 6.02426201538837  # [m/s] Meijaard et al. (2007), section 5


class Top(jk.System):
    """A symmetric top on a ball joint: precession about the vertical, nutation, spin; moments about the joint."""

    mass: Scalar = parameter(positive=True)  # [kg]
    distance: Scalar = parameter(positive=True)  # [m]
    across: Scalar = parameter(positive=True)  # [kg m^2]
    axial: Scalar = parameter(positive=True)  # [kg m^2]
    g: Scalar = parameter(9.81)  # [m/s^2]

    coordinates = ("precession", "nutation", "spin")
    speeds = ("precession_rate", "nutation_rate", "spin_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["precession"], u["precession_rate"]).rotate(1, q["nutation"], u["nutation_rate"])
        G = O.fixed(self.distance * A.z)
        I = self.across - self.mass * self.distance**2
        omega = A.angular_velocity + u["spin_rate"] * A.z
        return jk.Motion([jk.Body(self.mass, (I, I, self.axial), G, A, omega, "top")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.g * motion.N.z)


TOP = Top(mass=0.5, distance=0.1, across=0.006, axial=0.0008)


@pytest.mark.slow
def test_cyclic_coordinates():
    assert cyclic_coordinates(BIKE) == ("rear_wheel_angle", "yaw", "front_wheel_angle", "x", "y")
    assert cyclic_coordinates(TOP) == ("precession", "spin")
    assert cyclic_coordinates(jk.catalog.DoublePendulum(mass=1.0, length=1.0)) == ()


class Sailing(jk.System):
    """A cart on a rail, pushed by a wind that shears: it matters where the cart is only while the wind blows."""

    stiffness: Scalar = parameter(0.0)  # [N/m] of a spring to a second cart
    far: Scalar = parameter(0.0)  # [N/m^2] of a stop that begins at 5 m
    coordinates = ("x", "y", "z")
    speeds = ("x_dot", "y_dot", "z_dot")
    inputs = ("wind",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        place = lambda i, axis: O.moving(q[i] * axis, u[i] * axis)  # noqa: E731
        carts = [
            jk.Body(2.0, 0.0, place(i, axis), name=name)
            for i, (name, axis) in enumerate((("cart", N.x), ("other", N.y), ("third", N.z)))
        ]
        return jk.Motion(carts)

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        stop = -self.far * jnp.maximum(q["z"] - 5.0, 0.0)
        return (
            jk.Force(inputs["wind"] * (1 + 0.5 * q["x"]) * N.x, motion["cart"]),
            jk.Force(-self.stiffness * q["y"] * N.y, motion["other"]),
            jk.Force(stop * N.z, motion["third"]),
        )


@pytest.mark.slow
def test_a_coordinate_that_matters_only_with_an_input_is_not_cyclic():
    """x_ddot = wind (1 + x / 2) / m: the model about a wind that another force balances has its mode."""
    system = Sailing()
    assert cyclic_coordinates(system) == ()
    still = jk.State(jnp.zeros(3), jnp.zeros(3))
    at = jk.stability.linearize(system, still, {"wind": -4.0}, steady=False)
    np.testing.assert_allclose(at.A[at.states.index("x_dot"), at.states.index("x")], -4.0 * 0.5 / 2.0, rtol=1e-14)
    np.testing.assert_allclose(np.sort(at.eigenvalues.imag)[[0, -1]], [-1.0, 1.0], rtol=1e-12)


class Unreal(Sailing):
    """A wind that no parameter makes real."""

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force(jnp.sqrt(-1.0 - q["x"] ** 2) * motion.N.x, motion["cart"]),)


def test_cyclic_coordinates_of_a_non_finite_system_raise():
    with pytest.raises(ValueError, match="Unreal: the cyclic coordinates cannot be determined"):
        cyclic_coordinates(Unreal())


# -- closed forms


def precession(g, nutation, spin):
    """(A - C) W^2 cos - C s W + m g l = 0, for the spin s relative to the precessing frame; the slow root."""
    a, b, c = (TOP.across - TOP.axial) * jnp.cos(nutation), -TOP.axial * spin, TOP.mass * g * TOP.distance
    return (-b - jnp.sqrt(b**2 - 4 * a * c)) / (2 * a)


@pytest.mark.weekly
def test_steady_precession_of_the_top_and_its_derivatives():
    rtol = 1e-11

    def found(x):
        g, nutation, spin = x
        top = dataclasses.replace(TOP, g=g)
        guess = {"precession_rate": 2.0}
        return steady_turn(top, {}, guess, hold={"nutation": nutation, "spin_rate": spin})["precession_rate"]

    def derivatives(f):
        """Value, slope in reverse and in forward mode, and curvature, in one program."""

        def in_reverse(x):
            value, slope = jax.value_and_grad(f)(x)
            return (value, slope), (value, slope)

        (forward, curvature), (value, backward) = jax.jit(jax.jacfwd(in_reverse, has_aux=True))(at)
        return value, backward, forward, curvature

    at = jnp.array([9.81, 0.5, 300.0])
    value, backward, forward, curvature = derivatives(found)
    exact, slope, _, second = derivatives(lambda x: precession(*x))
    np.testing.assert_allclose(value, exact, rtol=rtol)
    np.testing.assert_allclose(backward, slope, rtol=rtol)
    np.testing.assert_allclose(forward, slope, rtol=rtol)
    np.testing.assert_allclose(curvature, second, rtol=1e-8, atol=1e-12)


@pytest.mark.slow
def test_a_disc_that_rolls_on_a_circle_agrees_with_the_closed_form():
    """r/4 u3^2 tan(lean) - 3/2 r u2 u3 = g sin(lean): moments about the centre of a uniform disc."""
    atol = 1e-12
    disc = RollingDisc(m=2.0, r=0.3, g=9.81)
    assert cyclic_coordinates(disc) == ("q1", "q3")
    turn = steady_turn(disc, {}, {"u2": 3.0, "u3": -1.0}, hold={"q2": 0.3, "u2": 5.0})
    u2, u3 = float(turn["u2"]), float(turn["u3"])
    assert abs(u3) > 0.1
    assert abs(0.3 / 4 * u3**2 * np.tan(0.3) - 1.5 * 0.3 * u2 * u3 - 9.81 * np.sin(0.3)) < atol


def test_equilibria():
    atol = 1e-13
    pendulum = jk.catalog.DoublePendulum(mass=2.0, length=1.0)
    at = equilibrium(pendulum, {"theta1": 0.3, "theta2": -0.2})
    np.testing.assert_allclose(np.sin(at.q), 0.0, atol=atol)
    np.testing.assert_array_equal(at.u, 0.0)


@pytest.mark.weekly
def test_trim_torques_for_a_given_lean_are_found():
    """Trim: turning at 3 m/s with a lean of 0.2 rad and a steer of 0.1 rad needs a roll and a steer torque."""
    atol = 1e-11
    hold = {"roll": 0.2, "steer": 0.1, "rear_wheel_rate": -10.0}
    turn = steady_turn(BIKE, {}, {}, hold=hold, find=("roll_torque", "steer_torque"))
    u_dot = jk.accelerations(BIKE, 0.0, turn.q, turn.u, turn.inputs)
    np.testing.assert_allclose(u_dot, 0.0, atol=atol)
    assert abs(float(turn["roll_torque"])) > 1.0
    assert float(turn["drive_torque"]) == 0.0


@pytest.mark.slow
def test_insufficient_or_invalid_hold_conditions_raise():
    with pytest.raises(ValueError, match=r"family of dimension 1, along which roll, steer, .* change\. Hold 1 more"):
        steady_turn(BIKE, {"roll": 0.1, "steer": 0.05}, {"rear_wheel_rate": -20.0})
    with pytest.raises(ValueError, match="no steady motion was found from this guess"):
        steady_turn(TOP, {}, {"precession_rate": 2.0}, hold={"nutation": 0.5, "spin_rate": 100.0})
    with pytest.raises(ValueError, match="no coordinate or speed lean; it has roll"):
        steady_turn(BIKE, hold={"lean": 0.1})
    with pytest.raises(ValueError, match="no input torque"):
        steady_turn(BIKE, find=("torque",))
    none = jax.jit(lambda s: steady_turn(TOP, {}, {"precession_rate": 2.0}, hold={"nutation": 0.5, "spin_rate": s}).u)
    assert np.isnan(none(100.0)).all()


# -- hands-free circular motions of the benchmark bicycle


def residuals(turns):
    """Largest accelerations, by the public functions."""
    rates = jax.jit(jax.vmap(lambda q, u: jk.accelerations(BIKE, 0.0, q, u)))(turns.q, turns.u)
    return np.abs(rates).max()


@pytest.fixture(scope="module")
def beside_capsize():
    return steady_turn(BIKE, {"steer": 0.01}, {"rear_wheel_rate": -20.08}, hold={"roll": 0.05})


@pytest.mark.weekly
def test_forward_handlebar_family_extends_from_capsize_to_rest(beside_capsize):
    """From the capsize speed, over a largest lean, to rest with the frame upright and the wheel turned by 76.76 deg."""
    atol = 1e-11
    turns = family(BIKE, beside_capsize, towards={"roll": 1}, until={"rear_wheel_rate": 0.0}, max_step=0.05)
    assert residuals(turns) < atol
    assert turns.reason == "rear_wheel_rate = 0"
    end = turns.motion(-1)
    np.testing.assert_allclose(end["roll"], 0.0, atol=atol)
    assert f"{np.rad2deg(end['steer']):.2f}" == "76.76"
    assert float(turns["roll"].max()) > 0.41 > float(turns["roll"][0])
    assert "steady motions over" in repr(turns)
    start = family(BIKE, beside_capsize, towards={"roll": -1}, until={"roll": 0.0}, step=0.01)
    assert abs(float(-BIKE.rR * start["rear_wheel_rate"][-1]) - CAPSIZE) < 1e-7  # where two families cross
    at = [steady_turn(BIKE, beside_capsize.q, beside_capsize.u, hold={"roll": s}) for s in (1e-3, 2e-3)]
    v = [float(-BIKE.rR * motion["rear_wheel_rate"]) for motion in at]
    assert abs((4 * v[0] - v[1]) / 3 - CAPSIZE) < 1e-9  # the speed is even in the roll


@pytest.mark.slow
def test_rest_with_a_turned_front_wheel_is_an_equilibrium():
    atol = 1e-12
    at = equilibrium(BIKE, {"steer": 1.3})
    assert f"{np.rad2deg(at['steer']):.2f}" == "76.76"
    np.testing.assert_allclose(at["roll"], 0.0, atol=atol)
    assert residuals(jax.tree.map(lambda x: x[None], at)) < 1e-11


def test_accelerations_do_not_depend_on_the_choice_of_independent_speeds():
    rtol = 1e-12
    bicycle = with_speeds(BIKE, ("yaw_rate", "pitch_rate", "roll_rate"))
    q = jk.assemble(BIKE, {"roll": 0.2, "steer": -0.3}).q
    u = jnp.array([0.4, -15.0, 0.3])
    at, torque = (0.0, q, u), {"steer_torque": 2.0}
    names = (*BIKE.dependent_speeds, *BIKE.speeds)
    speeds = dict(zip(names, [*jk.dependent_speeds(BIKE, *at), *u], strict=True))
    rates = [*jk.dependent_accelerations(BIKE, *at, torque), *jk.accelerations(BIKE, *at, torque)]
    u_dot = jk.accelerations(bicycle, 0.0, q, jnp.stack([speeds[k] for k in bicycle.speeds]), torque)
    np.testing.assert_allclose(u_dot, [rates[names.index(k)] for k in bicycle.speeds], rtol=rtol)
    with pytest.raises(ValueError, match="must name 3 different speeds of roll_rate"):
        with_speeds(BIKE, ("roll_rate", "speed", "yaw_rate"))


class Skate(jk.System):
    """A particle on a blade that is turned by `angle`, drawn by a motor that lags, with an accelerometer."""

    slope: jk.Scalar = jk.parameter(0.5)
    lag: jk.Scalar = jk.parameter(0.2)
    coordinates, speeds, dependent_speeds = ("x", "y"), ("x_dot",), ("y_dot",)
    inputs, states = ("command",), ("pull",)
    units = MappingProxyType({"x": "m", "pull": "N", "along": "m/s^2"})
    check_inertia = False

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["x_dot"], u["y_dot"], 0.0))
        flat = jk.Body(1.0, (1.0, 2.0, 9.0), P, N, name="flat")  # no body's, which check_inertia passes over
        return jk.Motion([flat], [u["y_dot"] - self.slope * u["x_dot"]], points={"P": P})

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["pull"] * motion.N.x, motion["P"])

    def state_rates(self, t, q, u, x, motion, now):
        return ((now["command"] - x["pull"] - 0.1 * now.u_dot[0]) / self.lag,)  # by place: of x_dot

    def outputs(self, t, q, u, motion, now):
        return {"along": now.acceleration(motion["P"]).dot(motion.N.x), "rate": u[0]}


@pytest.mark.weekly
def test_with_speeds_preserves_states_inputs_and_units():
    rtol = 1e-6
    skate, start = Skate(), {"x_dot": 1.0}
    other = with_speeds(skate, ("y_dot",))
    assert (other.states, other.units, other.check_inertia) == (("pull",), skate.units, False)
    ts, inputs = jnp.linspace(0.0, 1.0, 5), {"command": 2.0}
    ride = jk.simulate(skate, jk.State({}, start, {"pull": 0.3}), ts, inputs=inputs)
    again = jk.simulate(other, jk.State({}, {"y_dot": 0.5}, {"pull": 0.3}), ts, inputs=inputs)
    np.testing.assert_allclose(again.x, ride.x, rtol=rtol)
    for name in ("along", "rate"):
        np.testing.assert_allclose(jk.outputs(other, again)[name], jk.outputs(skate, ride)[name], rtol=rtol)
    # Systems of one class may differ in their names.
    pair = [with_speeds(Row(n), ("v0",)) for n in (1, 2)]
    assert [each.dependent_speeds for each in pair] == [("v1",), ("v1", "v2")]


class Row(jk.System):
    """Particles on a line that move with the first."""

    n: int = eqx.field(static=True)
    coordinates = property(lambda self: tuple(f"x{i}" for i in range(self.n + 1)))
    speeds = ("v0",)
    dependent_speeds = property(lambda self: tuple(f"v{i + 1}" for i in range(self.n)))


@pytest.mark.weekly
def test_invalid_families_raise_by_name(beside_capsize):
    with pytest.raises(ValueError, match=r"`towards` must be one name with .*; did you mean .steer."):
        family(BIKE, beside_capsize, towards={"speed": 1})
    with pytest.raises(ValueError, match="too many quantities are held"):
        family(BIKE, beside_capsize, towards={"roll": 1}, hold=("roll",))
    straight = straight_ahead(BIKE, CAPSIZE)
    at = steady_turn(BIKE, straight.q, straight.u, hold={"roll": 0.0, "rear_wheel_rate": straight.u[1]})
    with pytest.raises(ValueError, match="more than one curve of steady motions passes through the start"):
        family(BIKE, at, towards={"roll": 1})


class Lifted(jk.System):
    """A spring above a floor, lifted by an actuator with a lag. The stiffness is a plain number."""

    stiffness: float = 2.0
    coordinates, speeds, states, inputs = ("y",), ("v",), ("force",), ("command",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["y"] * N.y, u["v"] * N.y), name="block")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["force"] - self.stiffness * q["y"]) * motion.N.y, motion["block"])

    def state_rates(self, t, q, u, x, motion, inputs):
        return {"force": (inputs["command"] - x["force"]) / 0.2}

    def contacts(self, t, q, u, motion):
        return {"floor": jk.Contact(motion["block"].center, motion.N.y)}


def test_a_large_input_is_reached_from_a_guess_of_zero():
    heights = jax.vmap(lambda command: equilibrium(Lifted(), inputs={"command": command})["y"])
    np.testing.assert_allclose(heights(jnp.array([0.1, 2.0, 10.0, 1e3])), [0.05, 1.0, 5.0, 5e2], rtol=1e-12)


def test_closed_contacts_are_refused_by_name():
    # The equations of steady motions have no contact forces: a block below the floor is not at rest there.
    with pytest.raises(ValueError, match=r"Lifted has closed contacts here: floor.*no contact forces"):
        equilibrium(Lifted(), inputs={"command": -1.0})
    with pytest.raises(ValueError, match="Belt has closed contacts here: belt"):
        equilibrium(jk.catalog.Belt())
    above = equilibrium(Lifted(), inputs={"command": 1.0})
    models = jax.vmap(lambda y: jk.stability.linearize(Lifted(), jk.State([y], [0.0], [1.0]), steady=False).A)
    A = models(jnp.array([0.5, 0.0]))
    np.testing.assert_allclose(A[0], [[0.0, 1.0, 0.0], [-2.0, 0.0, 1.0], [0.0, 0.0, -5.0]])
    assert jnp.isnan(A[1]).all()
    with pytest.raises(ValueError, match="closed contacts here: floor"):
        jk.stability.linearize(Lifted(), jk.State([0.0], [0.0], [0.0]))
    lowered = family(Lifted(), above, find=("command",), towards={"y": -1})
    assert "a contact closes" in lowered.reason
    assert 0 < lowered["y"][-1] < 1e-3
