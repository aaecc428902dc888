"""Laws of friction, drag, stops and backlash, motors and rotors: limits, signs, slopes, and closed forms of motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxkane as jk
from jaxkane.loads import bouc_wen, coulomb, dc_motor, dead_zone, lugre, quadratic, smooth_abs, smooth_sign, stribeck

RTOL = 1e-12
V = np.array([-3.0, -0.4, -0.07, -0.011, 0.0, 0.011, 0.07, 0.4, 3.0])  # rates [m/s]


def sharp_stribeck(v, exponent):
    return (0.3 + 0.2 * np.exp(-((np.abs(v) / 0.1) ** exponent))) * np.sign(v)


LAWS = {
    "coulomb": (lambda v, width: coulomb(v, 0.7, width=width), lambda v: 0.7 * np.sign(v)),
    "stribeck": (lambda v, width: stribeck(v, 0.3, 0.5, 0.1, width=width), lambda v: sharp_stribeck(v, 2.0)),
    "tustin": (
        lambda v, width: stribeck(v, 0.3, 0.5, 0.1, exponent=1.0, width=width),
        lambda v: sharp_stribeck(v, 1.0),
    ),
    "bo": (lambda v, width: stribeck(v, 0.3, 0.5, 0.1, exponent=0.5, width=width), lambda v: sharp_stribeck(v, 0.5)),
    "quadratic": (lambda v, width: quadratic(v, 0.8), lambda v: 0.8 * v * np.abs(v)),
    "gap": (
        lambda v, width: dead_zone(v, -0.2, 0.2, width=width),
        lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.2, 0.0),
    ),
}
PAIRS = pytest.mark.parametrize(("law", "sharp"), LAWS.values(), ids=LAWS)


# Laws, as functions of numbers.


@PAIRS
def test_resistance_laws_are_odd_and_dissipative(law, sharp):
    found = np.asarray(law(jnp.array(V), 0.01))
    np.testing.assert_allclose(found, -found[::-1], atol=1e-15)
    assert np.all(found * V >= 0.0)
    assert found[4] == 0.0


@PAIRS
def test_smoothed_laws_converge_with_the_square_of_the_width(law, sharp):
    v = np.array([-3.0, -0.4, -0.07, 0.07, 0.4, 3.0])
    errors = [np.abs(np.asarray(law(jnp.array(v), width)) - sharp(v)) for width in (2e-4, 1e-4)]
    assert np.all(errors[0] < 1e-5)
    large = errors[1] > 1e-13
    np.testing.assert_allclose(errors[0][large] / errors[1][large], 4.0, rtol=1e-3)


@pytest.mark.slow_cases(all_but=["quadratic-float32", "quadratic-float64"])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@PAIRS
def test_derivatives_of_laws_are_finite_at_rest(law, sharp, dtype):
    v = jnp.array(V, dtype)
    f = lambda v: law(v, 0.01)  # noqa: E731

    @jax.jit
    def slopes(v):
        return jax.vmap(jax.jacfwd(f))(v), jax.vmap(jax.grad(f))(v), jax.vmap(jax.hessian(f))(v)

    forward, reverse, second = slopes(v)
    assert forward.dtype == dtype
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(forward, reverse, rtol=100 * eps, atol=100 * eps)
    assert np.all(np.isfinite(second))
    step = 1e-6
    if dtype == jnp.float64:
        np.testing.assert_allclose(forward, (f(v + step) - f(v - step)) / (2 * step), rtol=1e-5, atol=2e-6)


def test_the_error_of_smoothing_agrees_with_the_documented_formula():
    x, width = np.array([0.5, 2.0, 30.0]), 1e-3
    np.testing.assert_allclose(np.asarray(smooth_abs(jnp.array(x), width)) - x, width**2 / (2 * x), rtol=1e-4)
    np.testing.assert_allclose(1 - np.asarray(smooth_sign(jnp.array(x), width)), width**2 / (2 * x**2), rtol=1e-4)
    assert float(smooth_abs(jnp.array(0.0), width)) == pytest.approx(width, rel=RTOL)


def test_dead_zones_with_one_and_two_ends():
    """At an end the depth is width / 2; far from both, x - end but for width^2 / 4 of its inverse distance."""
    one, other = (lambda x: dead_zone(x, None, 1.5, width=1e-3)), (lambda x: dead_zone(x, -0.5, None, width=1e-3))
    both = lambda x: dead_zone(x, -0.5, 1.5, width=1e-3)  # noqa: E731
    x = jnp.array([-2.5, 0.5, 1.5, 3.5])
    np.testing.assert_allclose(one(x), [0.0, 0.0, 5e-4, 2.0], atol=3e-7)
    np.testing.assert_allclose(other(x), [-2.0, 0.0, 0.0, 0.0], atol=3e-7)
    np.testing.assert_allclose(both(x), one(x) + other(x), atol=1e-15)
    assert np.all(np.diff(np.asarray(both(jnp.linspace(-1.0, 2.0, 3001)))) > 0)
    with pytest.raises(ValueError, match="pass at least one of `lower`"):
        dead_zone(1.0, None, None)


# Bristles.

BRISTLES = {"stiffness": 1e4, "kinetic": 1.0, "static": 1.5, "falloff": 0.01}


def level(v):
    return 1.0 + 0.5 * np.exp(-((v / 0.01) ** 2))


@pytest.mark.slow
def test_lugre_friction_at_steady_rate_equals_the_stribeck_curve():
    v = np.array([-0.5, -0.02, 0.003, 0.2])
    z = np.sign(v) * level(v) / 1e4
    force, z_dot = lugre(jnp.array(v), jnp.array(z), damping=30.0, viscous=0.4, **BRISTLES)
    np.testing.assert_allclose(z_dot, 0.0, atol=1e-15)
    np.testing.assert_allclose(force, np.sign(v) * level(v) + 0.4 * v, rtol=RTOL)


@pytest.mark.slow
def test_lugre_deflection_is_bounded_by_static_friction():
    """Where |z| = static / stiffness, z_dot is not outwards, whatever the rate."""
    v = jnp.linspace(-2.0, 2.0, 401)
    for side in (-1.0, 1.0):
        _, z_dot = lugre(v, jnp.full(401, side * 1.5e-4), damping=30.0, **BRISTLES)
        assert np.all(side * np.asarray(z_dot) <= 1e-15)


@pytest.mark.slow
def test_lugre_friction_is_passive_up_to_the_documented_damping():
    """force v - d/dt (stiffness z^2 / 2) = a y^2 - damping a v y + damping v^2, a = |v| / level, y = stiffness z."""
    v, z = (x.ravel() for x in np.meshgrid(np.linspace(-0.3, 0.3, 41), np.linspace(-1.5e-4, 1.5e-4, 601)))

    def gained(share):
        damping = share * 4.0 * level(v) / np.maximum(np.abs(v), 1e-3)
        force, z_dot = lugre(jnp.array(v), jnp.array(z), damping=jnp.array(damping), **BRISTLES)
        return np.asarray(force) * v - 1e4 * z * np.asarray(z_dot)

    assert gained(1.0).min() > -1e-12
    assert gained(0.1).min() > -1e-15
    assert gained(1.3).min() < -1e-3


# In systems: decoupled coordinates, each with a closed form.


class Bench(jk.System):
    """A block that slides to a halt, a ball that falls in air, and a motor that starts; they do not feel each other."""

    friction: jk.Scalar = jk.parameter(0.4)
    air: jk.Scalar = jk.parameter(0.3)
    constant: jk.Scalar = jk.parameter(0.05)
    coordinates = ("block", "ball", "shaft")
    speeds = ("block_rate", "ball_rate", "shaft_rate")
    inputs = ("voltage",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        block, ball = O.moving(q[0] * N.x, u[0] * N.x), O.moving(q[1] * N.z, u[1] * N.z)
        spinning = jk.loads.rotor(2e-4, N.y, u[2], N, O)
        return jk.Motion([jk.Body(2.0, 0.0, block, name="block"), jk.Body(1.5, 0.0, ball, name="ball"), spinning])

    def loads(self, t, q, u, motion, inputs):
        torque = dc_motor(inputs["voltage"], u["shaft_rate"], self.constant, 2.0)
        return (
            jk.loads.friction(motion["block"], None, 2.0 * 9.81, self.friction, speed=0.05),
            jk.loads.drag(motion["ball"], self.air),
            jk.Force(1.5 * 9.81 * motion.N.z, motion["ball"]),
            jk.Torque(torque * motion.N.y, motion["rotor"]),
        )


TS = np.linspace(0.0, 0.5, 26)


@pytest.fixture(scope="module")
def bench():
    state = jk.State({}, {"block_rate": 1.5})
    return jk.simulate(Bench(), state, TS, {"voltage": 12.0}, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_the_slide_of_a_block_with_smoothed_friction_agrees_with_closed_form(bench):
    """x = integral of |v| dv / (mu g), |v| = sqrt(v^2 + w^2): its energy goes into friction; and the same of time."""
    v, w, a = bench["block_rate"], 0.05, 0.4 * 9.81
    path = lambda v: (v * np.hypot(v, w) + w**2 * np.arcsinh(v / w)) / (2 * a)  # noqa: E731
    np.testing.assert_allclose(bench["block"], path(1.5) - path(v), atol=1e-9)
    time = lambda v: (np.hypot(v, w) - w * np.arctanh(w / np.hypot(v, w))) / a  # noqa: E731
    moving = v > 1e-3
    np.testing.assert_allclose(bench.t[moving], time(1.5) - time(v[moving]), atol=1e-8)
    assert 0.0 < v[-1] < 1e-3  # it creeps


def test_a_fall_with_quadratic_drag_agrees_with_the_closed_form(bench):
    """v = v_end tanh(g t / v_end), v_end^2 = m g / c."""
    v_end = np.sqrt(1.5 * 9.81 / 0.3)
    np.testing.assert_allclose(bench["ball_rate"], v_end * np.tanh(9.81 * TS / v_end), rtol=1e-8)
    np.testing.assert_allclose(
        bench["ball"], v_end**2 / 9.81 * np.log(np.cosh(9.81 * TS / v_end)), rtol=1e-7, atol=1e-9
    )


def test_the_motor_speed_follows_its_time_constant(bench):
    """w = V / k (1 - exp(-t / T)), T = J R / k^2 = 0.16 s."""
    np.testing.assert_allclose(bench["shaft_rate"], 240.0 * (1 - np.exp(-TS / 0.16)), rtol=1e-8)


@pytest.mark.slow
def test_derivatives_of_a_system_at_rest_agree_with_closed_forms(kernels):
    """By hand: d a / d v of the block is -mu g / width, of the ball -c width / m, of the motor -k^2 / (R J)."""
    system, zeros = Bench(), jnp.zeros(3)

    @jax.jit
    def found(system, u):
        f = lambda s, u: jk.accelerations(s, 0.0, zeros, u, {"voltage": 12.0})  # noqa: E731
        return f(system, u), jax.jacfwd(f, 1)(system, u), jax.jacrev(f)(system, u)

    value, by_speeds, by_parameters = found(system, zeros)
    np.testing.assert_allclose(value, [0.0, 9.81, 0.05 * 12.0 / 2.0 / 2e-4], rtol=RTOL)
    np.testing.assert_allclose(np.diag(by_speeds), [-0.4 * 9.81 / 0.05, -0.3e-6 / 1.5, -6.25], rtol=1e-10)
    np.testing.assert_allclose(by_parameters.friction, 0.0, atol=1e-15)
    u = jnp.array([[0.02, -2.0, 5.0], [-1.0, 3.0, 0.0]])
    value, by_speeds, by_parameters = jax.vmap(found, (None, 0))(system, u)
    v, w = np.asarray(u), np.hypot(np.asarray(u)[:, 0], 0.05)
    np.testing.assert_allclose(value[:, 0], -0.4 * 9.81 * v[:, 0] / w, rtol=RTOL)
    np.testing.assert_allclose(value[:, 1], 9.81 - 0.2 * v[:, 1] * np.abs(v[:, 1]), rtol=1e-11)
    np.testing.assert_allclose(by_speeds[:, 0, 0], -0.4 * 9.81 * 0.05**2 / w**3, rtol=1e-10)
    np.testing.assert_allclose(by_parameters.air[:, 1], -v[:, 1] * np.abs(v[:, 1]) / 1.5, rtol=1e-10)


# Rotors.


class Gimbal(jk.System):
    """A flywheel on an oblique axis in a frame that turns about two axes: as a rotor, or in a frame of its own."""

    coordinates = ("yaw", "tilt", "spin")
    speeds = ("yaw_rate", "tilt_rate", "spin_rate")
    spins = False

    def motion(self, t, q, u):
        N, O = jk.inertial()
        F = N.rotate(3, q[0], u[0]).rotate(1, q[1], u[1])
        case = jk.Body(1.0, (0.3, 0.2, 0.4), O, F, name="case")
        axis = 2.0 * F.x + F.y - F.z
        if not self.spins:
            return jk.Motion([case, jk.loads.rotor(0.05, axis, u[2], case, O)])
        S = F.rotate(axis, q[2], u[2])
        a = np.array([2.0, 1.0, -1.0]) / np.sqrt(6.0)
        wheel = jk.Body(0.0, 0.05 * np.outer(a, a), O, S, name="wheel")  # the axis has the same components in F and S
        return jk.Motion([case, wheel])

    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(0.1 * motion.N.x, motion["case"])


@pytest.mark.slow
def test_a_rotor_includes_the_rotation_of_its_carrier():
    spinning = type("Spinning", (Gimbal,), {"spins": True})()
    for q, u in (((0.3, 0.5, 0.2), (1.0, -2.0, 30.0)), ((0.0, -1.0, 4.0), (0.5, 0.7, -80.0))):
        at = jnp.array(q), jnp.array(u)
        found, expected = (jk.accelerations(system, 0.0, *at) for system in (Gimbal(), spinning))
        np.testing.assert_allclose(found, expected, rtol=1e-11)
    jk.assemble(Gimbal(), {}, {})  # the moments (0.05, 0, 0) are no body's, but a rotor's


# Elements with states.

YIELDS = {"stiffness": 500.0, "yield_force": 2.0, "share": 0.7, "exponent": 1.5}
TOUCHES = BRISTLES | {"stiffness": 1e3, "falloff": 0.05, "damping": 40.0, "viscous": 0.4}


@pytest.mark.parametrize("share", [0.5, 0.7, 1.0])
def test_bouc_wen_hysteresis_is_passive_and_bounded(share):
    v, z = (x.ravel() for x in np.meshgrid(np.linspace(-0.3, 0.3, 21), np.linspace(-4e-3, 4e-3, 101)))
    force, z_dot = bouc_wen(jnp.array(v), jnp.array(z), **YIELDS | {"share": share})
    assert np.min(np.asarray(force) * v - 500.0 * z * np.asarray(z_dot)) > -1e-12
    _, outwards = bouc_wen(jnp.array(v), jnp.full_like(v, 4e-3), **YIELDS | {"share": share})
    assert np.max(np.asarray(outwards)) < 1e-12


class Held(jk.System):
    """Two blocks that are pushed alike: one on bristles, one on a spring that yields and a damper."""

    coordinates = ("rubbed", "tied")
    speeds = ("rubbed_rate", "tied_rate")
    states = ("bent", "extended")
    inputs = ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        bodies = [jk.Body(1.0, 0.0, O.moving(q[i] * N.x, u[i] * N.x), name=self.coordinates[i]) for i in (0, 1)]
        return jk.Motion(bodies)

    def elements(self, u, x):
        return lugre(u["rubbed_rate"], x["bent"], **TOUCHES), bouc_wen(u["tied_rate"], x["extended"], **YIELDS)

    def loads(self, t, q, u, motion, inputs):
        (rubs, _), (holds, _) = self.elements(u, inputs)
        forces = inputs["push"] - rubs, inputs["push"] - holds - 5.0 * u["tied_rate"]
        return [jk.Force(F * motion.N.x, body) for F, body in zip(forces, motion.bodies, strict=True)]

    def state_rates(self, t, q, u, x, motion, now):
        (_, bent), (_, extended) = self.elements(u, x)
        return {"bent": bent, "extended": extended}


@pytest.fixture(scope="module")
def held():
    """Pushed by less than what static friction holds, and by more."""
    push, ts = np.array([[1.2], [2.2]]), np.linspace(0.0, 2.0, 21)
    return jk.sweep.sweep(Held(), jk.State({}, {}, {}), ts, {"push": push}, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_lugre_and_bouc_wen_simulations_agree_with_scipy(held):
    def rates(t, y, push):
        v, w, z, s = y[2:]
        friction = 1.0 + 0.5 * np.exp(-((v / 0.05) ** 2))
        z_dot = v - 1e3 * abs(v) / friction * z
        s_dot = w * (1 - (0.7 * np.sign(w * s) + 0.3) * abs(s / 4e-3) ** 1.5)
        return [v, w, push - 1e3 * z - 40.0 * z_dot - 0.4 * v, push - 500.0 * s - 5.0 * w, z_dot, s_dot]

    for i, push in enumerate((1.2, 2.2)):
        options = {"args": (push,), "rtol": 1e-10, "atol": 1e-12}
        by_hand = solve_ivp(rates, (0.0, 2.0), np.zeros(6), "LSODA", np.linspace(0.0, 2.0, 21), **options).y
        for k, name in enumerate(("rubbed", "tied", "rubbed_rate", "tied_rate", "bent", "extended")):
            np.testing.assert_allclose(held[name][i], by_hand[k], rtol=1e-6, atol=1e-7, err_msg=name)


def test_lugre_friction_holds_a_block_that_creeps_with_smoothed_friction(held):
    """Less than static: the block comes to rest where the bristles carry the push, and stays there."""
    assert held["bent"][0, -1] == pytest.approx(1.2 / 1e3, rel=1e-6)
    assert np.ptp(held["rubbed"][0, 10:]) < 1e-9
    assert held["rubbed_rate"][1, -1] > 0.5


@pytest.mark.slow
def test_derivatives_by_element_states_at_rest_agree_with_closed_forms(kernels):
    """By hand: of accelerations by speeds, and by states."""
    system, zeros = Held(), jnp.zeros(2)

    @jax.jit
    def slopes(u, x):
        def f(u, x):
            return jk.accelerations(system, 0.0, zeros, u, {"push": 1.0, "bent": x[0], "extended": x[1]})

        return jax.jacfwd(f, (0, 1))(u, x), jax.jacrev(f, (0, 1))(u, x)

    forward, reverse = slopes(zeros, zeros)
    np.testing.assert_allclose(forward[0], np.diag([-40.4, -5.0]), rtol=RTOL)
    np.testing.assert_allclose(forward[1], np.diag([-1e3, -500.0]), rtol=RTOL)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=RTOL), forward, reverse)
