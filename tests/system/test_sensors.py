"""Sensors beside MuJoCo's on trees, and beside closed forms; filters beside their transfer functions."""

import importlib.util
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane import rotations, sensors
from jaxkane.stability import linearize

needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="needs MuJoCo: pip install mujoco")

TREE = """<mujoco><option><flag contact="disable"/></option><compiler angle="radian"/><worldbody>
<body name="base" pos="0 0 1" euler="0.3 0.1 0"><joint name="swing" axis="0 1 0.2" damping="0.1"/>
 <geom type="box" size="0.1 0.05 0.2" mass="2"/><site name="s1" pos="0.1 0.02 -0.3" euler="0.2 -0.4 0.5"/>
 <body name="arm" pos="0.1 0 -0.4"><joint name="ball" type="ball"/>
  <geom type="box" size="0.04 0.03 0.15" pos="0 0.01 -0.1" mass="0.7"/><site name="s2" pos="0.05 0 -0.2" euler="1 0 0"/>
  <body name="tip" pos="0 0 -0.25" euler="0 0.5 0"><joint name="slide" type="slide" axis="1 0.3 0" stiffness="20"/>
   <geom type="sphere" size="0.05" mass="0.3"/><site name="s3" pos="0.01 0.02 0.03" euler="0 0 -0.7"/>
</body></body></body></worldbody><sensor>
 <gyro site="s1"/><accelerometer site="s1"/><gyro site="s2"/><accelerometer site="s2"/><gyro site="s3"/>
 <accelerometer site="s3"/><framepos objtype="site" objname="s3" reftype="site" refname="s1"/>
</sensor></mujoco>"""


def at_sites(self, t, q, u, motion, now):
    g = -9.81 * motion.N.z
    found = {}
    for name, (frame, point) in motion.sites.items():
        found[name] = {"gyro": sensors.gyroscope(frame), "accelerometer": sensors.accelerometer(now, point, frame, g)}
    (frame, point), (_, far) = motion.sites["s1"], motion.sites["s3"]
    return {**found, "seen": sensors.marker(far, point, frame)}


@needs_mujoco
def test_gyroscopes_accelerometers_and_markers_on_a_tree():
    tolerance = 1e-10
    import mujoco

    model = mujoco.MjModel.from_xml_string(TREE)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    tree = jk.convert.from_mjcf(TREE).with_outputs(at_sites)
    kept = pickle.loads(pickle.dumps(tree))
    assert type(kept) is type(tree)
    for _ in range(3):
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_forward(model, data)
        q = np.array([data.qpos[0], *data.qpos[2:5], data.qpos[1], data.qpos[5]])  # the scalar last
        found = jk.outputs(tree, 0.0, q, data.qvel)
        kinds = ("gyro", "accelerometer")
        names = [f"{site}.{kind}.{k}" for site in ("s1", "s2", "s3") for kind in kinds for k in "xyz"]
        names += [f"seen.{k}" for k in "xyz"]
        expected = data.sensordata
        error = np.array([float(found[name]) for name in names]) - expected
        assert np.abs(error).max() < tolerance * np.abs(expected).max()


ARM = """<mujoco><option><flag contact="disable"/></option><worldbody><body name="upper">
 <joint name="shoulder" axis="0 0 1"/><inertial pos="0 -0.2 0" mass="1.5" diaginertia="0.02 0.001 0.02"/>
 <body name="lower" pos="0 -0.4 0"><joint name="elbow" axis="0 1 0"/><site name="cell" pos="0 0 0"/>
  <inertial pos="0.05 -0.15 0.02" mass="0.8" diaginertia="0.01 0.002 0.011"/></body></body></worldbody>
 <sensor><force site="cell"/><torque site="cell"/></sensor></mujoco>"""


class Arm(jk.System):
    coordinates, speeds = ("shoulder", "elbow"), ("shoulder_rate", "elbow_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        upper = N.rotate(3, q[0], u[0])
        elbow = O.fixed(-0.4 * upper.y)
        lower = upper.rotate(2, q[1], u[1])
        first = jk.Body(1.5, (0.02, 0.001, 0.02), O.fixed(-0.2 * upper.y), upper, name="upper")
        center = elbow.fixed(lower.vector(0.05, -0.15, 0.02))
        second = jk.Body(0.8, (0.01, 0.002, 0.011), center, lower, name="lower")
        return jk.Motion([first, second], points={"elbow": elbow}, frames={"lower frame": lower})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.z)

    def outputs(self, t, q, u, motion, now):
        frame = motion.frames["lower frame"]
        force, moment = (sensors.load_cell(now, name, frame) for name in ("elbow", "lower frame"))
        return {"force": force, "moment": moment}


@pytest.mark.slow
@needs_mujoco
def test_load_cells_in_a_joint():
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.4, -0.7), (1.3, -2.1)
    mujoco.mj_forward(model, data)
    found = jk.outputs(Arm(), 0.0, [0.4, -0.7], [1.3, -2.1])
    ours = np.array([float(found[f"{kind}.{k}"]) for kind in ("force", "moment") for k in "xyz"])
    np.testing.assert_allclose(ours, data.sensordata, atol=1e-10 * np.abs(ours).max())
    forces = jk.constraint_forces(Arm(), 0.0, [0.4, -0.7], [1.3, -2.1])
    np.testing.assert_allclose(np.linalg.norm(ours[:3]), np.linalg.norm(forces["elbow"]), rtol=1e-13)
    broken = type("Broken", (Arm,), {"outputs": lambda self, t, q, u, motion, now: {"x": now.force("wrist")}})()
    with pytest.raises(KeyError, match="no 'wrist' in the named points"):
        jk.outputs(broken, 0.0, [0.0, 0.0], [0.0, 0.0])


@pytest.mark.slow
def test_a_mounting_rotation_is_differentiable_at_zero():
    def matrix(r):
        N, _ = jk.inertial()
        return N.rotate_fixed(r).matrix(N)

    slope = jax.jacfwd(matrix)(jnp.zeros(3))
    np.testing.assert_allclose(slope[:, :, 2], [[0, 1, 0], [-1, 0, 0], [0, 0, 0]], atol=1e-15)
    assert np.all(np.isfinite(jax.hessian(lambda r: matrix(r).sum())(jnp.zeros(3))))
    assert rotations.of_rotation_vector((0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0, 1.0)


def test_encoders_and_cameras():
    read = lambda angle: sensors.encoder(angle, zero=0.1, ratio=-2.0, resolution=0.05)  # noqa: E731
    assert float(read(jnp.array(0.33))) == pytest.approx(-0.45)
    assert float(jax.grad(read)(0.33)) == -2.0
    assert sensors.encoder(0.3, zero=0.1) == pytest.approx(0.2)
    N, O = jk.inertial()

    def seen(x):
        point = O.fixed(N.vector(x, 0.2, 2.0))
        return sensors.camera(point, O, N, focal_length=800.0, image_center=(320.0, 240.0))

    assert float(seen(0.5)["u"]) == pytest.approx(520.0)
    assert float(seen(0.5)["v"]) == pytest.approx(320.0)
    behind = sensors.camera(O.fixed(N.vector(0.0, 0.0, -1.0)), O, N, focal_length=1.0)
    assert np.isnan(float(behind["u"]))


class Filtered(jk.System):
    """A signal that a free mass receives, behind three filters."""

    coordinates, speeds, inputs = ("x",), ("v",), ("signal",)
    states = ("low", "first", "second", "one", "two", "three")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def filters(self, x, signal):
        second, pade = ([x[name] for name in pair] for pair in (("first", "second"), ("two", "three")))
        low = sensors.low_pass(signal, x["low"], 0.2)
        second = sensors.low_pass_second_order(signal, second, 3.0)
        return [low, second, sensors.delayed(signal, x["one"], 0.1), sensors.delayed(signal, pade, 0.1)]

    def state_rates(self, t, q, u, x, motion, now):
        return [rate for rates, _ in self.filters(x, now["signal"]) for rate in rates]

    def outputs(self, t, q, u, motion, now):
        y = [output for _, output in self.filters(now, now["signal"])]
        return dict(zip(("low pass", "butterworth", "pade 1", "pade 2"), y, strict=True))


def test_filters_have_their_transfer_functions():
    still = jk.State([0.0], [0.0], jnp.zeros(6))
    model = linearize(Filtered(), still, outputs=("low pass", "butterworth", "pade 1", "pade 2"))
    s = 2j * np.pi * 1.3
    w, d = 2 * np.pi * 3.0, 0.1
    exact = [
        1 / (1 + 0.2 * s),
        w**2 / (s**2 + np.sqrt(2) * w * s + w**2),
        (1 - d * s / 2) / (1 + d * s / 2),
        (1 - d * s / 2 + d**2 * s**2 / 12) / (1 + d * s / 2 + d**2 * s**2 / 12),
    ]
    n = len(model.states)
    A, B, C, D = (np.asarray(x) for x in model)
    found = (C @ np.linalg.solve(s * np.eye(n) - A, B) + D)[:, 0]
    np.testing.assert_allclose(found, exact, rtol=1e-12)
    assert abs(exact[3] - np.exp(-d * s)) < abs(s * d) ** 5 / 720
    with pytest.raises(ValueError, match="low_pass: the number of states must be 1, got 2"):
        sensors.low_pass(0.0, (0.0, 0.0), 1.0)
