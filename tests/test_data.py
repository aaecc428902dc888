"""The measured data sets are complete and small, have the stated units, and contain their licences."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

import jaxkane as jk

FILES = Path(jk.data.__file__).parent / "files"

# Trials, seconds in all and channels, as their sources say.
EXPECTED = {
    "single": (lambda: jk.data.multi_arm_pendulum(1), 4, 37, "angle1"),
    "double": (lambda: jk.data.multi_arm_pendulum(2), 26, 69, "angle1 angle2"),
    "triple": (lambda: jk.data.multi_arm_pendulum(3), 22, 34, "angle1 angle2 angle3"),
    "driven": (jk.data.driven_double_pendulum, 5, 50, "angle1 angle2 torque1 torque2"),
    "steer by wire": (jk.data.steer_by_wire, 31, 31, "roll steer roll_rate steer_rate steer_torque"),
    "robot": (jk.data.robot_bicycle, 4, 41, "steer roll_rate steer_torque drive_torque"),
    "Davis": (jk.data.davis_rider, 1, 40, "roll steer roll_rate steer_rate steer_torque lateral_force"),
    "elbow": (jk.data.tossed_elbow, 20, 3, "x y z e1 e2 e3 e4 hinge"),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_recording_is_complete(name):
    load, n, seconds, channels = EXPECTED[name]
    found = load()
    assert len(found.trials) == n
    assert sum(float(trial.t[-1] - trial.t[0]) for trial in found.trials) == pytest.approx(seconds, abs=1.0)
    for trial in found.trials:
        assert [*trial.measured, *trial.inputs] == channels.split()
        assert all(np.isfinite(x).all() for x in (*trial.measured.values(), *trial.inputs.values()))
    assert "Copyright" in found.licence or "copyright" in found.licence
    assert repr(found).startswith(f"Recording({n} trials, {seconds} s in all")


def slope(x, y):
    """Of y over x, with how well they agree."""
    return float(x @ y / (x @ x)), float(np.corrcoef(x, y)[0, 1])


def test_measured_rates_agree_with_the_measured_angles():
    for trial in jk.data.multi_arm_pendulum(2).trials[:3]:
        found, agreement = slope(np.gradient(trial.measured["angle1"], trial.t), trial.initial["rate1"])
        assert abs(found - 1.0) < 0.01
        assert agreement > 0.999
    for trial in jk.data.driven_double_pendulum().trials:
        angle, rate = trial.measured["angle2"], trial.initial["rate2"]
        steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(trial.t)
        off = np.abs(angle[0] + np.cumsum(steps) - angle[1:])
        assert np.quantile(off, 0.99) < 0.01  # [rad]; single samples jump


def test_angular_velocities_of_the_elbow_agree_with_its_quaternions():
    """The angular velocity along the body's axes, by two quaternions q1, q2: about 2 vec(q1^-1 q2) / dt."""
    trial = jk.data.tossed_elbow().trials[0]
    e = np.stack([trial.measured[f"e{i + 1}"] for i in range(4)])
    np.testing.assert_allclose(np.sum(e**2, axis=0), 1.0, atol=1e-4)
    v, s = e[:3], e[3]
    turned = s[:-1] * v[:, 1:] - s[1:] * v[:, :-1] - np.cross(v[:, :-1], v[:, 1:], axis=0)
    omega = np.stack([trial.initial[f"omega{i + 1}"] for i in range(3)])[:, :-1]
    assert slope((2 * turned / np.diff(trial.t)).ravel(), omega.ravel())[1] > 0.95


def test_bicycles_can_be_built_from_the_published_parameters():
    for values in (
        jk.data.steer_by_wire().parameters,
        jk.data.robot_bicycle().parameters,
        jk.data.davis_rider().parameters["rigid_rider_and_bicycle"],
    ):
        bicycle = jk.catalog.WhippleBicycle.from_parameters(values)
        assert float(bicycle.w) == values["w"]


def test_torque_source_and_channels_can_be_selected():
    measured, commanded = (jk.data.driven_double_pendulum(which).trials[3] for which in ("measured", "commanded"))
    assert np.all(commanded.inputs["torque1"] == 0.0)  # only the elbow is driven
    assert np.std(measured.inputs["torque1"]) > 0.01  # yet its drive feels something
    with pytest.raises(ValueError, match="no torque commandet; did you mean 'commanded'"):
        jk.data.driven_double_pendulum("commandet")
    imu = jk.data.robot_bicycle(("roll_rate", "acc_z")).trials[0]
    assert np.mean(imu.measured["acc_z"]) == pytest.approx(-9.81, abs=0.1)
    with pytest.raises(ValueError, match="no channel roll"):
        jk.data.robot_bicycle(("roll",))
    with pytest.raises(ValueError, match="must be 1, 2 or 3; got 4"):
        jk.data.multi_arm_pendulum(4)
    assert len(jk.data.steer_by_wire(seconds=0.5).trials[0].t) == 50


def test_other_files_with_the_same_columns_can_be_read(tmp_path):
    shipped = FILES / "multi_arm_pendulum" / "single.csv.gz"
    plain = tmp_path / "another.csv"
    plain.write_bytes(gzip.decompress(shipped.read_bytes()))
    found = jk.data.multi_arm_pendulum(1, file=plain)
    np.testing.assert_array_equal(
        found.trials[2].measured["angle1"], jk.data.multi_arm_pendulum(1).trials[2].measured["angle1"]
    )
    assert found.trials[0].name == "another, segment 0"
    with pytest.raises(ValueError, match="another, segment 0: no column angle2; did you mean"):
        jk.data.multi_arm_pendulum(2, file=plain)


def test_data_files_are_small_and_have_a_licence():
    assert sum(path.stat().st_size for path in FILES.rglob("*")) < 3e6
    for folder in FILES.iterdir():
        assert len((folder / "LICENCE").read_text(encoding="utf-8")) > 500
        for file in folder.glob("*.csv.gz"):
            with gzip.open(file, "rt", newline="", encoding="utf-8") as lines:
                header = next(csv.reader(lines))
            assert "t" in header
