"""What measured bicycles say: where an IMU sits, what only a ratio tells, and whose clocks do not agree."""

import jax
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Delay, Free, Gain, LeastSquares, Offset, Trial, fit_bicycle

STARTS = {"roll": 0.1, "steer": None, "roll_rate": None, "steer_rate": None}


def windows_of(ride):
    """Trials of a second, each with offsets of its own."""
    count, first = int(ride.t[-1] - ride.t[0] + 1e-6), ride.t[0] - 1e-6
    return [ride.between(first + i, first + i + 1.0 - 1e-3) for i in range(count)]


def every_second(run, columns, sigma):
    """Every second sample, 100 Hz, under the names of the description."""
    measured = {new: run.measured[old][::2] for old, new in columns.items()}
    return Trial(
        run.t[::2],
        measured,
        {"steer_torque": run.inputs["steer_torque"][::2]},
        sigma={name: sigma.get(name, 2.0 * float(np.std(x))) for name, x in measured.items()},
        initial={"speed": run.initial["speed"][::2]},
    )


@pytest.fixture(scope="module")
def steered():
    """Windows of the robot bicycle with steer and roll rate, weighed as the linear fit that they are compared with."""
    columns = {"steer": "steer", "roll_rate": "roll_rate"}
    runs = [every_second(run, columns, {"steer": 0.01, "roll_rate": 0.03}) for run in jk.data.robot_bicycle().trials]
    return [window for run in runs for window in windows_of(run)]


@pytest.mark.slow
def test_the_damping_of_the_robot_bicycle(steered):
    bicycle = WhippleBicycle.from_parameters(jk.data.robot_bicycle().parameters)
    options = {"unknown": STARTS, "input_bias": {"roll_torque": 10.0, "steer_torque": 0.5}, "hold": ("steer_torque",)}
    found = fit_bicycle(steered, bicycle, "steer_damping", optimizer=LeastSquares(), **options)
    assert found.status == "converged"
    # The linear model's 465 are of twice as many samples.
    assert len(steered) == 38
    assert found.cost < 465 / 2
    assert found.robust
    low, high = found.intervals()["steer_damping"]
    assert low < 1.49 < high  # of the linear model
    assert found.clustered_errors["steer_damping"] > 5 * found.standard_errors["steer_damping"]


@pytest.mark.slow
def test_of_gain_damping_and_inertia_only_a_ratio_is_told(steered):
    bicycle = WhippleBicycle.from_parameters(jk.data.robot_bicycle().parameters)
    free = ("steer_damping", Gain("steer_torque"), "IHzz")
    options = {"input_bias": ("roll_torque", "steer_torque"), "hold": ("steer_torque",)}
    found = fit_bicycle(steered, bicycle, free, optimizer=LeastSquares(rtol=1e-3), steps=20, **options)
    assert any(note.startswith("steer_damping and gain of steer_torque trade off") for note in found.notes)
    assert np.abs(found.correlation).min() > 0.8  # all three run off together
    # Far less is known of each than of the ratio.
    i, C = found.names.index("gain of steer_torque"), found.covariance
    size = np.array([found.estimates[name] for name in found.names])
    apart = C / np.outer(size, size)
    ratio = apart[0, 0] + apart[i, i] - 2 * apart[0, i]
    assert ratio < 0.1 * min(apart[0, 0], apart[i, i])


class RobotBicycle(WhippleBicycle):
    place: jax.Array = jk.parameter((0.5, 0.0, -0.8), unit="m")
    mounting: jax.Array = jk.parameter((0.0, 0.0, 0.0), unit="rad")

    def outputs(self, t, q, u, motion, now):
        B = motion["B"]
        x, y, z = (self.place[i] for i in range(3))
        place = motion["rear wheel"].center.fixed(x * B.x + y * B.y + (z + self.rR) * B.z)
        return {"imu": jk.sensors.imu(now, place, B.rotate_fixed(self.mounting), self.g * motion.N.z)}


@pytest.mark.slow
def test_where_the_imu_of_the_robot_bicycle_sits():
    columns = {"steer": "steer", "roll_rate": "imu.gx", "gyro_z": "imu.gz"}
    columns |= {f"acc_{axis}": f"imu.a{axis}" for axis in "xyz"}
    recording = jk.data.robot_bicycle(tuple(columns))
    sigma = {"steer": 0.03, "imu.gx": 0.03, "imu.gz": 0.05}
    runs = [every_second(run.between(0.0, 4.999), columns, sigma) for run in recording.trials[:3]]
    free = ("steer_damping", Free("place", scale=0.1), Free("mounting", prior=(0.0, 0.05)))
    found = fit_bicycle(
        runs,
        RobotBicycle.from_parameters(recording.parameters),
        (*free, Offset("roll_torque", prior=(0.0, 5.0), scale=5.0)),
        window=1.0,
        unknown=STARTS,
        sensor_bias={"steer": 0.015, "imu.ax": 0.1, "imu.ay": 0.1},
        input_bias={"steer_torque": 0.5},
        hold=("steer_torque",),
        optimizer=LeastSquares(rtol=1e-4),
    )
    assert found.status == "converged"
    assert found.clusters == ("window", 15)
    assert found.robust
    # Behind the steering axis and above the top tube, as its author says; nobody has measured it.
    assert 0.4 < found.estimates["place[0]"] < 0.8
    assert -1.05 < found.estimates["place[2]"] < -0.65
    assert found.clustered_errors["place[0]"] < 0.1


class PulledBicycle(WhippleBicycle):
    """Pulled to the side at a place on the rear frame."""

    rope_height: jk.Scalar = jk.parameter(0.943, unit="m")
    inputs = (*WhippleBicycle.inputs, "lateral_force")

    def loads(self, t, q, u, motion, inputs):
        B = motion["B"]
        knot = motion["rear wheel"].center.fixed(0.2 * B.x + (self.rR - self.rope_height) * B.z)
        pull = jk.Force(inputs["lateral_force"] * motion["Y"].y, knot)
        return (*super().loads(t, q, u, motion, inputs), pull)


@pytest.mark.slow
def test_the_clocks_of_a_ride_with_a_rider():
    recording = jk.data.davis_rider()
    bicycle = PulledBicycle.from_parameters(recording.parameters["as_stored_in_the_run_file"])
    windows = windows_of(recording.trials[0])
    options = {"input_bias": ("roll_torque", "steer_torque"), "optimizer": LeastSquares()}
    free = ("steer_damping", "rope_height", Delay("steer"))
    found = fit_bicycle(windows, bicycle, free, **options)
    assert found.status == "converged"
    assert len(windows) == 39
    assert found.cost < 7250
    # Where it was measured; without the delay a tenth lower.
    assert found.estimates["rope_height"] == pytest.approx(0.943, abs=0.02)
    assert found.estimates["delay of steer"] == pytest.approx(-0.024, abs=0.003)
    assert 0.0 < found.estimates["steer_damping"] < 0.3
