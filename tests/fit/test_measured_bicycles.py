"""What measured bicycles say: the damping of a robot bicycle, beside that of a linear model.

Where its IMU sits, what only a ratio tells, and whose clocks do not agree on a ride with a rider is asserted by those
who show it: notebooks 12 and 14.
"""

import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import LeastSquares, Offset, Trial, fit_bicycle

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


@pytest.mark.weekly
def test_the_damping_of_the_robot_bicycle(steered):
    bicycle = WhippleBicycle.from_parameters(jk.data.robot_bicycle().parameters)
    options = {
        "unknown": STARTS,
        "zero_order_hold": ("steer_torque",),
    }
    torques = {"roll_torque": 10.0, "steer_torque": 0.5}
    offsets = [Offset(name, each="trial", prior=(0.0, deviation)) for name, deviation in torques.items()]
    found = fit_bicycle(steered, bicycle, ("steer_damping", *offsets), optimizer=LeastSquares(), **options)
    assert found.status == "converged"
    # The linear model's 465 are of twice as many samples.
    assert len(steered) == 38
    assert found.cost < 465 / 2
    assert found.uses_clustered_errors
    low, high = found.intervals()["steer_damping"]
    assert low < 1.49 < high  # of the linear model
    assert found.clustered_errors["steer_damping"] > 5 * found.standard_errors["steer_damping"]
