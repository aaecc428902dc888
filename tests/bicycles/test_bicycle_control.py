"""Steering, drive and control of bicycles, compared with formulas, models assembled by hand, and known limits."""

import dataclasses
import pickle
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import (
    Bicycle,
    ConstantSpeed,
    Drag,
    LaneChange,
    LeanSteerGains,
    Part,
    PathFollower,
    ScheduledGains,
    SequentialLoopRider,
    SteerByWire,
    SteeringMotor,
    follow_gain,
    scheduled_lqr,
)
from jaxkane.stability import eigenvalues, linearize, lqr, straight_ahead

BENCHMARK = Bicycle.benchmark()
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")


def straight(bicycle, speed, states=None, outputs=None):
    """The linear model about riding straight."""
    at, states = straight_ahead(bicycle, speed), bicycle.lateral if states is None else states
    return linearize(bicycle, at, states=states, outputs=outputs, steady="yaw" not in states)


def sorted_eigenvalues(A):
    return np.sort_complex(np.linalg.eigvals(np.asarray(A)))


def split(bicycle, mass, x, z, Ixx, Iyy, Izz):
    """The bicycle whose fork has lost a handlebar: mass, mass centre and inertia of what is left."""
    b = {name: float(getattr(bicycle, name)) for name in ("mH", "xH", "zH", "IHxx", "IHyy", "IHzz", "IHxz")}
    left = b["mH"] - mass
    center = [(b["mH"] * whole - mass * part) / left for whole, part in ((b["xH"], x), (b["zH"], z))]

    def inertia(m, r):  # (xx, yy, zz, xz) of a mass at (x, z) from the whole one's centre
        dx, dz = r[0] - b["xH"], r[1] - b["zH"]
        return m * np.array([dz * dz, dx * dx + dz * dz, dx * dx, -dx * dz])

    whole = np.array([b["IHxx"], b["IHyy"], b["IHzz"], b["IHxz"]])
    own = whole - inertia(mass, (x, z)) - np.array([Ixx, Iyy, Izz, 0.0]) - inertia(left, center)
    return bicycle.with_parts(mH=left, xH=center[0], zH=center[1], **dict(zip(("IHxx", "IHyy", "IHzz", "IHxz"), own)))


# Steering


@pytest.mark.slow
def test_a_geared_rotor_adds_its_reflected_inertia_to_the_steer():
    """Upright, the frame yaws with the steer by c cos(lam) / w: the rotor turns with ratio + c cos(lam)^2 / w of it."""
    motor = SteeringMotor(rotor_inertia=1e-3, ratio=7.0)
    still = straight_ahead(BENCHMARK, 0.0)
    both = [jk.mass_matrix(b, 0.0, still.q, still.u) for b in (BENCHMARK.with_parts(steering=motor), BENCHMARK)]
    rate = 7.0 + float(BENCHMARK.c) * np.cos(float(BENCHMARK.lam)) ** 2 / float(BENCHMARK.w)
    np.testing.assert_allclose((both[0] - both[1])[2, 2], 1e-3 * rate**2, rtol=1e-12)


@pytest.mark.weekly
def test_a_steering_motor_has_delay_lag_and_torque_limit():
    """At 10 rad/s: a delay of 50 ms to the Pade approximation's error, (s T)^4 / 72 = 9e-4; a lag of 20 ms exactly."""
    motor = SteeringMotor(delay=0.05, lag=0.02, limit=1e9)
    model = straight(BENCHMARK.with_parts(steering=motor), 5.0, outputs=("steer_motor_torque",))
    s, j = 10.0j, model.inputs.index("steer_command")
    A, B, C = (np.asarray(x) for x in (model.A, model.B, model.C))
    found = (C @ np.linalg.solve(s * np.eye(len(A)) - A, B[:, j]))[0]
    assert abs(found - np.exp(-0.05 * s) / (1.0 + 0.02 * s)) < 9e-4
    limited = SteeringMotor(limit=2.0).commands(None, 0.0, {}, {}, None, {"steer_command": 50.0})
    np.testing.assert_allclose(limited["steer_torque"], 2.0, rtol=1e-12)


def test_steer_by_wire_applies_torques_to_fork_and_handlebar():
    """1e-12: the coupling's torque on the fork, and its share on the handlebar, over their speeds."""
    wire = SteerByWire(1.0, 0.85, -0.95, 0.02, 0.01, 0.015, stiffness=100.0, ratio=0.5, feedback=0.8)
    q, u = {"handlebar": 0.1, "steer": 0.02}, {"rear_wheel_rate": -12.0}

    def forces(stiffness):
        bicycle = BENCHMARK.with_parts(steering=dataclasses.replace(wire, stiffness=stiffness))
        start = jk.assemble(bicycle, q, u)
        F = jk.generalized_active_forces(bicycle, 0.0, start.q, start.u)
        return np.array([F[bicycle.speeds.index(name)] for name in ("steer_rate", "handlebar_rate")])

    torque = (100.0 - 40.0) * (0.5 * 0.1 - 0.02)
    np.testing.assert_allclose(forces(100.0) - forces(40.0), [torque, -0.8 * 0.5 * torque], rtol=1e-12)


@pytest.mark.weekly
def test_a_stiff_steer_by_wire_coupling_approaches_a_rigid_steering():
    """1e-4 of the largest slow eigenvalue at 1e5 N m/rad, and ten times that at 1e4: of the first order."""
    bar = {"mass": 0.5, "x": 0.88, "z": -0.8, "Ixx": 0.005, "Iyy": 0.003, "Izz": 0.002}
    whole = sorted_eigenvalues(straight(BENCHMARK, 4.0).A)

    def gap(stiffness):
        wire = SteerByWire(**bar, stiffness=stiffness)
        found = np.linalg.eigvals(straight(split(BENCHMARK, **bar).with_parts(steering=wire), 4.0).A)
        slow = np.sort_complex(sorted(found, key=abs)[:4])
        return np.abs(slow - whole).max() / np.abs(whole).max()

    assert gap(1e5) < 1e-4
    np.testing.assert_allclose(gap(1e4) / gap(1e5), 10.0, rtol=0.05)


# Drive


@pytest.mark.weekly
def test_constant_speed_outputs_the_torque_that_balances_drag():
    """1e-10: power of the drag, 0.5 * 1.2 * 0.5 * 3^3 W, over the wheel's rate of 10 rad/s."""
    bicycle = BENCHMARK.with_parts(drive=(Drag(area=0.5, height=1.0), ConstantSpeed(3.0)))
    assert bicycle.speeds == ("roll_rate", "steer_rate")
    start = jk.assemble(bicycle, {}, {})
    torque = jk.outputs(bicycle, 0.0, start.q, start.u)["holding_torque"]
    np.testing.assert_allclose(torque, -0.3 * 27.0 / 10.0, rtol=1e-6)  # the drag is smooth below 1e-3 m/s
    by_hand = jk.constraint_multipliers(bicycle, 0.0, start.q, start.u)[-1]
    np.testing.assert_allclose(torque, by_hand, rtol=1e-10)
    with pytest.raises(ValueError, match=r"are roll_rate, steer_rate\. If a part prescribes the speed"):
        straight_ahead(bicycle, 3.0)


# Control


def test_commanded_torques_are_outputs():
    """The applied torque is the sum of the input torque and the torques of all parts."""
    bicycle = BENCHMARK.with_parts(control=LeanSteerGains(roll=2.0), steering=SteeringMotor(limit=1e9))
    leaning = jk.assemble(bicycle, {"roll": 0.5}, {"rear_wheel_rate": -10.0})
    found = jk.outputs(bicycle, 0.0, leaning.q, leaning.u, {"steer_torque": 4.0, "steer_command": 3.0})
    np.testing.assert_allclose(found["applied_steer_torque"], 4.0 - 1.0 + 3.0, rtol=1e-12)
    assert dict(bicycle.units)["applied_steer_torque"] == "N m"
    assert "applied_drive_torque" not in found


@pytest.mark.weekly
def test_feedback_gains_change_the_linear_model_to_A_minus_B_K():
    """A - B K, 1e-12."""
    plain = straight(BENCHMARK, 3.0)
    gains = {"roll": -50.0, "steer": 30.0, "roll_rate": -15.0, "steer_rate": 3.0}
    found = straight(BENCHMARK.with_parts(control=LeanSteerGains(**gains)), 3.0)
    B = np.asarray(plain.B)[:, plain.inputs.index("steer_torque")]
    known = np.asarray(plain.A) - np.outer(B, [gains[name] for name in plain.states])
    np.testing.assert_allclose(found.A, known, rtol=1e-12, atol=1e-11)
    assert max(np.linalg.eigvals(known).real) < 0.0


def test_scheduled_gains_are_interpolated_linearly_over_speed():
    """1e-3 of the step between two, away from the corners; outside of the schedule the gains of its ends."""
    control = ScheduledGains([2.0, 4.0, 6.0], ("roll",), [[1.0], [2.0], [5.0]], [1.0, 2.0, 5.0])
    motion = lambda v: SimpleNamespace(rear=SimpleNamespace(speed=v))  # noqa: E731

    def gains(v):
        at = ({"roll": 1.0}, {}, motion(v))
        still, asked = (control.commands(BENCHMARK, 0.0, *at, {"desired_roll": x}) for x in (0.0, 1.0))
        return float(-still["steer_torque"]), float(asked["steer_torque"] - still["steer_torque"])

    for v, known in ((-300.0, 1.0), (0.0, 1.0), (3.0, 1.5), (4.0, 2.0), (5.0, 3.5), (9.0, 5.0), (300.0, 5.0)):
        # where the slope changes by s, the corner is off by s / 2 times its width of 0.1 m/s
        np.testing.assert_allclose(gains(v), known, atol=0.055 if v == 4.0 else 8e-3)


@pytest.mark.weekly
def test_regulators_are_scheduled_over_speed():
    """1e-12 against the regulator of one speed; stable at the speeds between and above."""
    Q, R = [10.0, 1.0, 1.0, 0.1], 0.01
    control = scheduled_lqr(BENCHMARK, [2.0, 4.0, 6.0], Q, R)
    K, _, _ = lqr(straight(BENCHMARK, 4.0), Q, R, inputs=["steer_torque"])
    np.testing.assert_allclose(control.gains[1], K[0], rtol=1e-12)
    steered = eigenvalues(BENCHMARK.with_parts(control=control), np.linspace(2.0, 8.0, 13)).eigenvalues
    assert np.asarray(steered).real.max() < -1.0


@pytest.mark.weekly
def test_a_bicycle_follows_the_desired_roll_angle():
    """By `follow_gain`, 1e-9: the regulator's own is one at a speed of a schedule of one."""
    regulated = BENCHMARK.with_parts(control=scheduled_lqr(BENCHMARK, [4.0], [10.0, 1.0, 1.0, 0.1], 0.01))
    np.testing.assert_allclose(follow_gain(regulated, 4.0), 1.0, rtol=1e-9)
    with pytest.raises(ValueError, match="desired_roll"):
        follow_gain(BENCHMARK, 4.0)


@pytest.mark.weekly
def test_the_rider_of_hess_and_moore_closes_five_loops():
    """1e-9, against the matrix that the block diagram gives by hand; with the published gains it rides stably."""
    speed, w, z = 5.0, 30.0, 0.707
    rider = SequentialLoopRider.benchmark(speed, path=LaneChange(width=0.0))
    k_steer, k_rate, k_roll, k_heading, k_y = 46.5457, -0.0522, 12.6611, 0.1849, 0.0959
    names = ("yaw", "y", *LATERAL)
    front = lambda t, q, u: q["y"] + BENCHMARK.w * q["yaw"] - front_trail() * q["steer"]  # noqa: E731
    plain = straight(BENCHMARK, speed, states=names, outputs={"front": front})
    y = dict(zip(plain.states, np.asarray(plain.C)[0]))
    e = lambda name: np.array([float(name == each) for each in plain.states])  # noqa: E731
    to_front = np.array([y[name] for name in plain.states])
    wanted_roll = k_heading * (-k_y * to_front - e("yaw"))
    wanted_steer = k_rate * (k_roll * (wanted_roll - e("roll")) - e("roll_rate"))
    asked = k_steer * (wanted_steer - e("steer"))
    B = np.asarray(plain.B)[:, [plain.inputs.index("steer_torque")]]
    known = np.block([
        [np.asarray(plain.A), B, 0.0 * B],
        [0.0 * asked, 0.0, 1.0],
        [w * w * asked, -w * w, -2.0 * z * w],
    ])  # fmt: skip
    bicycle = BENCHMARK.with_parts(control=rider)
    states = (*names, "rider_torque", "rider_torque_rate")
    found = straight(bicycle, speed, states=states)
    order = [found.states.index(name) for name in (*plain.states, *states[-2:])]
    np.testing.assert_allclose(np.asarray(found.A)[np.ix_(order, order)], known, rtol=1e-9, atol=1e-9)
    assert np.linalg.eigvals(known).real.max() < -0.2


def front_trail():
    """How far the front contact moves aside for an angle of steer [m]: trail over the steer axis, upright."""
    return BENCHMARK.c * jnp.cos(BENCHMARK.lam)


@pytest.mark.slow
def test_the_path_follower_steers_along_an_arc_to_the_path():
    """2 aside / (g preview^2), 1e-12 for a small one; limited for a large one; also where it rides back."""
    motion = SimpleNamespace(rear=SimpleNamespace(speed=3.0))
    at = lambda aside: {"x": 5.0, "y": 1.0 - aside, "yaw": 0.0}  # noqa: E731
    follower = PathFollower(lambda x: 1.0, preview=2.0, limit=0.2)
    asked = lambda q: float(follower.commands(BENCHMARK, 0.0, q, {}, motion, {})["desired_roll"])  # noqa: E731
    np.testing.assert_allclose(asked(at(1e-5)), 2e-5 / (9.81 * 4.0), rtol=1e-8)
    np.testing.assert_allclose(asked(at(1e5)), 0.2, rtol=1e-12)
    np.testing.assert_allclose(asked(at(1e-5) | {"yaw": np.pi}), -asked(at(1e-5)), rtol=1e-4)
    lane = LaneChange(width=3.0, start=10.0, length=20.0, back=40.0)
    np.testing.assert_allclose(
        [lane(x) for x in (-5.0, 10.0, 20.0, 35.0, 50.0, 70.0)], [0, 0, 1.5, 3, 1.5, 0], atol=1e-12
    )
    np.testing.assert_allclose(jax.grad(lambda x: lane(x))(20.0), 3.0 / 20.0 * 1.875, rtol=1e-12)


# All together


def test_a_path_survives_pickling():
    follower = PathFollower(LaneChange(width=2.0, start=0.0, length=10.0))
    again = pickle.loads(pickle.dumps(follower))
    assert jax.tree.structure(again) == jax.tree.structure(follower)
    np.testing.assert_allclose(again.path(5.0), 1.0, rtol=1e-12)


# What does not fit


class Wrong(Part):
    def commands(self, bicycle, t, q, u, motion, values):
        return {"steer_torqe": 1.0}


@pytest.mark.parametrize(
    ("control", "words"),
    [
        (Wrong(), "steer_torqe.*did you mean 'steer_torque'"),
        (LeanSteerGains(command="steer_command"), "steer_command"),
        (PathFollower(LaneChange()), "desired_roll"),
    ],
)
def test_a_command_without_a_matching_input_raises(control, words):
    bicycle = BENCHMARK.with_parts(control=control)
    with pytest.raises(KeyError, match=words):
        jk.accelerations(bicycle, 0.0, jnp.zeros(8), jnp.zeros(3))


def test_invalid_control_parameters_raise():
    with pytest.raises(ValueError, match=r"LeanSteerGains\.roll = nan is not finite"):
        LeanSteerGains(roll=np.nan)
    with pytest.raises(ValueError, match=r"`at` must be increasing"):
        ScheduledGains([4.0, 2.0], LATERAL, np.ones((2, 4)), np.ones(2))
    with pytest.raises(ValueError, match=r"`gains` must have the shape \(2, 4\)"):
        ScheduledGains([2.0, 4.0], LATERAL, np.ones((2, 3)), np.ones(2))
    with pytest.raises(ValueError, match="`follow` contains a value that is not finite"):
        ScheduledGains([2.0, 4.0], LATERAL, np.ones((2, 4)), [1.0, np.inf])
    with pytest.raises(ValueError, match=r"from 2.5 to 12 m/s, got 1.0 m/s"):
        SequentialLoopRider.benchmark(1.0)
    with pytest.raises(TypeError, match="function with parameters"):
        PathFollower(3.0)
    with pytest.raises(ValueError, match="must be positive"):
        SteeringMotor(delay=0.0)
    with pytest.raises(ValueError, match="length"):
        LaneChange(length=0.0)
    with pytest.raises(ValueError, match="'desired_roll' appears twice"):
        BENCHMARK.with_parts(control=(LeanSteerGains(), SequentialLoopRider.benchmark(5.0)))
    assert dataclasses.replace(LeanSteerGains(), roll=1.0).roll == 1.0
