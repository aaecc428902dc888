"""Steady motions, linear models, families and regulators at small and large lengths, masses and times."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.chain import Chain

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.stability import LinearModel, equilibrium, family, linearize, lqr, steady_turn, straight_ahead

BIKE = jk.catalog.WhippleBicycle.benchmark()
SCALES = [(1e-7, 1.0), (1e-2, 1.0), (1.0, 1e-9), (1.0, 1e6), (1e8, 1e5)]  # of length and time


class Ring(jk.System):
    """A bead on a ring, in x and y: gravity along N.x, a spring along N.y, a force that grows with time."""

    mass: Scalar = parameter(2.0)  # [kg]
    radius: Scalar = parameter(0.7)  # [m]
    gravity: Scalar = parameter(9.8)  # [m/s^2]
    stiffness: Scalar = parameter(5.0)  # [N/m]
    rest: Scalar = parameter(0.4)  # [m] length of the spring
    coordinates = ("y", "x")
    speeds = ("v",)
    dependent_speeds = ("x_dot",)
    dependent_coordinates = ("x",)

    def configuration_constraints(self, t, q):
        return (q["x"] ** 2 + q["y"] ** 2 - self.radius**2,)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["x_dot"], u["v"], 0.0))
        return jk.Motion([jk.Body(self.mass, 0.0, P, N, name="bead")])

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        return jk.weight(motion, self.gravity * N.x), jk.Force(
            self.stiffness * (self.rest - q["y"]) * N.y, motion["bead"]
        )


def ring(length, time):
    force = length / time**2
    one = Ring()
    return dataclasses.replace(
        one,
        radius=one.radius * length,
        rest=one.rest * length,
        gravity=one.gravity * force,
        stiffness=one.stiffness / time**2,
    )


@pytest.mark.parametrize(("length", "time"), SCALES)
def test_equilibrium_of_a_loop_does_not_depend_on_the_units(length, time):
    """tan(angle) = k (rest - y) / (m g): the force is radial. The linear model has the same modes."""
    rtol = 1e-9
    at = equilibrium(ring(length, time), {"y": 0.1 * length, "x": 0.6 * length})
    y, x = np.asarray(at.q) / length
    assert abs(y / x - 5.0 * (0.4 - y) / (2.0 * 9.8)) < rtol
    assert abs(np.hypot(x, y) - 0.7) < rtol
    assert 0.0 < y < 0.4
    assert float(at.residual) < 1e-12
    # v_dot = -(V''(y) / m) (x / radius)^2 to first order, with V = -m g sqrt(r^2 - y^2) + k (rest - y)^2 / 2
    curvature = 2.0 * 9.8 * 0.7**2 / x**3 + 5.0
    A = np.asarray(linearize(ring(length, time), at).A)
    np.testing.assert_allclose(A[1, 0] * time**2, -curvature / 2.0 * (x / 0.7) ** 2, rtol=1e-9)


def pendulum(period):
    """A double pendulum that takes about this time [s]."""
    return jk.catalog.DoublePendulum(gravity=40.0 / period**2)


@pytest.mark.parametrize("period", [1e-9, 1.0, 1e5])
def test_steadiness_does_not_depend_on_the_period(period):
    system = pendulum(period)
    inverted = linearize(system, jk.State(jnp.array([np.pi, np.pi]), jnp.zeros(2)))  # sin(pi) is 1e-16
    np.testing.assert_allclose(inverted.eigenvalues.imag, 0.0, atol=1e-9 / period)
    with pytest.raises(ValueError, match="is not steady: theta1_dot is accelerated by"):
        linearize(system, jk.State(jnp.array([0.5, 0.0]), jnp.zeros(2)))
    with pytest.raises(ValueError, match=r"is not steady: .*theta1 changes with"):
        linearize(system, jk.State(jnp.zeros(2), jnp.array([0.1 / period, 0.0])))


@pytest.mark.slow
def test_a_small_acceleration_in_a_fast_motion_is_not_steady():
    """Of a bar that turns in a frame: theta is accelerated by the rate of the frame. With 14 speeds, too."""
    system, chain = jk.catalog.RotatingFrameAndBar(), Chain(n=14)
    with pytest.raises(ValueError, match="theta_dot is accelerated by"):
        linearize(system, jk.State([0.5, 0.8], [0.5, 0.0]))
    for at, accelerated in ((0.0, False), (1e-6, True)):
        motion = jk.State(jnp.full(14, at), jnp.zeros(14))
        with pytest.raises(ValueError, match="is accelerated by") if accelerated else contextlib.nullcontext():
            linearize(chain, motion)


@pytest.mark.slow
def test_a_spring_without_gravity_has_an_equilibrium():
    """Its force vanishes there, so that it has no terms to compare with: the place is zero without rounding errors."""
    system = MassOnSpring(stiffness=3e-12)
    at = equilibrium(system, {"x": 0.1})
    assert float(at["x"]) == 0.0
    np.testing.assert_allclose(linearize(system, at).A, [[0.0, 1.0], [-3e-12, 0.0]])
    with pytest.raises(ValueError, match="x_dot is accelerated by -3e-13"):
        linearize(system, jk.State(jnp.array([0.1]), jnp.zeros(1)))


class MassOnSpring(jk.System):
    """One kilogram on a spring, whose stiffness may grow with time."""

    stiffness: Scalar = parameter(1.0)  # [N/m]
    growth: Scalar = parameter(0.0)  # [1/s]
    coordinates, speeds = ("x",), ("x_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["x_dot"] * N.x), name="mass")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(-self.stiffness * (1.0 + self.growth * t) * q["x"] * motion.N.x, motion["mass"])


def test_a_linear_model_uses_the_time_of_its_steady_motion():
    system = MassOnSpring(growth=1.0)
    at = equilibrium(system, {"x": 0.1}, t=2.0)
    assert float(linearize(system, at).A[1, 0]) == pytest.approx(-3.0, rel=1e-14)
    assert float(linearize(system, at, t=4.0).A[1, 0]) == pytest.approx(-5.0, rel=1e-14)
    still = jk.State(jnp.zeros(1), jnp.zeros(1))
    assert float(linearize(system, still).A[1, 0]) == pytest.approx(-1.0, rel=1e-14)


@pytest.mark.weekly_cases(all_but=["100000.0-10000000.0-10000.0"])
@pytest.mark.parametrize(("length", "mass", "time"), [(1.0, 1.0, 1.0), (1e-6, 1e-9, 1e-3), (1e5, 1e7, 1e4)])
def test_a_family_with_trim_does_not_depend_on_the_units(length, mass, time):
    """The torques that hold a pendulum from hanging to 1 rad: -m g l sin(angle) times 3/2 and 1/2 (uniform links)."""
    rtol = 1e-9
    system = jk.catalog.DoublePendulum(mass=mass, length=length, gravity=9.81 * length / time**2)
    torques, speeds = system.inputs, ("theta1_dot", "theta2_dot")
    start = equilibrium(system, {"theta1": 0.1, "theta2": 0.2}, hold=("theta1", "theta2"), find=torques)
    held = family(system, start, hold=(*speeds, "theta2"), find=torques, towards={"theta1": 1}, until={"theta1": 1.0})
    assert held.reason == "theta1 = 1"
    assert len(held) < 30
    unit = mass * 9.81 * length**2 / time**2
    np.testing.assert_allclose(held["theta2"], 0.2, rtol=rtol)
    elbow, shoulder = 0.5 * np.sin(0.2), 1.5 * np.sin(np.asarray(held["theta1"]))
    np.testing.assert_allclose(np.abs(held["elbow_torque"]) / unit, elbow, rtol=rtol)
    np.testing.assert_allclose(np.abs(held["shoulder_torque"]) / unit, shoulder + elbow, rtol=rtol)


@pytest.mark.slow
def test_a_trim_force_that_is_zero_is_found():
    """It alone balances one equation of a bracket, in which nothing else has a size; with times in units of 1e-9 s."""
    bracket = jk.catalog.Bracket(gravity=9.81e-18)
    names = bracket.coordinates
    trim = equilibrium(bracket, {"theta1": 0.5, "theta2": -0.4, "theta3": 0.7}, hold=names, find=bracket.inputs)
    assert float(trim["arm_force"]) == 0.0
    assert abs(float(trim["tip_force1"])) > 1e-18


def cart(second):
    """A cart and an unstable pendulum with times in units of `second` seconds."""
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, -1.2, -0.1, 0], [0, 14.0, 0.2, -0.3]])
    units = np.array([1, 1, 1 / second, 1 / second])
    A = A * units / units[:, None] / second
    B = np.array([[0.0], [0.0], [0.5], [-0.7]]) / units[:, None] / second
    names = ("x", "angle", "x_dot", "angle_dot")
    return LinearModel(A, B, np.eye(4), np.zeros((4, 1)), names, ("force",), names), units


@pytest.mark.parametrize("second", [1e-9, 1e-4, 1.0, 1e3, 1e9])
def test_a_regulator_does_not_depend_on_the_unit_of_time(second):
    rtol = 1e-9
    model, units = cart(1.0)
    K, P, poles = lqr(model, np.array([1.0, 2.0, 0.1, 0.1]), 0.5)
    scaled, units = cart(second)
    found = lqr(scaled, np.array([1.0, 2.0, 0.1, 0.1]) * units**2, 0.5)
    np.testing.assert_allclose(found[0] / units, K, rtol=rtol)
    np.testing.assert_allclose(found[1] / units / units[:, None] / second, P, rtol=rtol)
    np.testing.assert_allclose(np.sort_complex(found[2] * second), np.sort_complex(poles), rtol=rtol)


def test_an_unsolved_riccati_equation_raises(monkeypatch):
    import scipy.linalg

    model, _ = cart(1.0)
    right = lqr(model, np.ones(4), 1.0)[1]
    monkeypatch.setattr(scipy.linalg, "solve_continuous_are", lambda *args: 1.01 * right)
    with pytest.raises(ValueError, match=r"Riccati equation of x, .* by force was not solved: the residual is"):
        lqr(model, np.ones(4), 1.0)

    def refuse(*args):
        raise np.linalg.LinAlgError("Failed to find a finite solution.")

    monkeypatch.setattr(scipy.linalg, "solve_continuous_are", refuse)
    with pytest.raises(ValueError, match=r"was not solved: Failed to find a finite solution\. Check the weights"):
        lqr(model, np.ones(4), 1.0)


def test_non_finite_numbers_raise():
    with pytest.raises(
        ValueError, match=r"straight_ahead\(WhippleBicycle\): the speed must be .*finite number \[m/s\], got nan"
    ):
        straight_ahead(BIKE, np.nan)
    with pytest.raises(ValueError, match=r"Ring: y is not finite \(nan\)\. Pass finite numbers in `hold`"):
        equilibrium(Ring(), hold={"y": np.nan})
    with pytest.raises(ValueError, match=r"roll is not finite \(inf\)\. Pass finite numbers for the initial guess"):
        steady_turn(BIKE, {"roll": np.inf}, hold={"steer": 0.1})
    with pytest.raises(ValueError, match=r"yaw_rate is not finite \(nan\)\. Pass finite numbers in `hold`"):
        steady_turn(BIKE, {}, {"rear_wheel_rate": -12.0}, hold={"yaw_rate": np.nan})


def test_an_empty_list_of_parameter_values_raises():
    with pytest.raises(ValueError, match=r"WhippleBicycle: `values` is empty\. Pass at least one"):
        jk.stability.eigenvalues(BIKE, np.zeros(0))


@pytest.mark.slow
def test_a_changing_coordinate_is_not_steady_under_jit():
    """A mass that moves through the place of its spring's rest: no force acts."""
    model = jax.jit(lambda v: linearize(MassOnSpring(), jk.State(jnp.zeros(1), v)).A)
    assert np.isnan(model(jnp.array([0.1]))).all()
    assert np.isfinite(model(jnp.zeros(1))).all()
