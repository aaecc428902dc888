"""Bicycles: three parameters of an unstable one, the damping of two measured ones.

`examples/fit_bicycle.py`, `examples/identify_measured_bicycle.py` and notebooks 12 to 14 assert what else they show.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import (
    GradientDescent,
    LeastSquares,
    NoiseScale,
    Offset,
    Problem,
    Simulation,
    SpectralDensity,
    Trial,
    bicycle_problem,
    fit_bicycle,
    multi_start,
)


@pytest.fixture(scope="module")
def unstable():
    """The benchmark bicycle at 3 m/s, kept up by a rider; noise and offsets, and no roll angle."""
    truth, rng, t = WhippleBicycle.benchmark(), np.random.default_rng(1), np.arange(0.0, 10.0, 0.01)
    f = np.array([0.35, 0.8, 1.3, 2.1])
    waves = 1.5 * np.sin(2.0 * np.pi * f * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 4)).sum(axis=1)
    poke = jk.Samples(jnp.asarray(t), jnp.asarray(waves))

    def rider(t, now):
        return 45.0 * (now["roll"] + 0.4 * now["roll_rate"]) - 4.0 * now["steer_rate"] + poke(t)

    start = jk.assemble(truth, {"roll": 0.03}, {"rear_wheel_rate": -3.0 / truth.rR})
    ride = jk.simulate(truth, start, t, {"steer_torque": rider})
    sigma = {"roll_rate": 0.01, "steer": 0.003, "steer_rate": 0.02}
    offset = {"roll_rate": 0.02, "steer": -0.01, "steer_rate": 0.03}
    measured = {c: np.asarray(ride[c]) + offset[c] + rng.normal(0.0, s, t.size) for c, s in sigma.items()}
    torque = {"steer_torque": np.asarray(ride.inputs["steer_torque"])}
    trial = Trial(t, measured, torque, sigma=sigma, initial={"rear_wheel_rate": -3.0 / float(truth.rR)})
    unknown = ("roll", "steer", "roll_rate", "steer_rate", "rear_wheel_rate")
    offsets = [Offset(channel, each="trial") for channel in sigma]
    return truth, trial, offsets, {"unknown": unknown}


@pytest.mark.weekly
def test_an_unstable_bicycle_from_five_initial_guesses(unstable):
    within = 0.01
    truth, trial, offsets, options = unstable
    names = ("IBxx", "zB", "c")
    free = (*names, *offsets)
    tight = {"roll": 1e-4, "steer": 1e-4, "roll_rate": 1e-3, "steer_rate": 1e-3, "rear_wheel_rate": 1e-4}
    problem = Problem.of(truth, trial, free, window=1.0, defect_std=tight, **options)
    found = multi_start(problem, 5, spread=0.3, seed=2)
    assert found.agreeing == 5
    for one in found.fits:
        for name in names:
            assert abs(one.estimates[name] / float(getattr(truth, name)) - 1.0) < within
    # A single shoot without growing horizons ends elsewhere, if it can be simulated at all.
    whole = {"spread": 0.3, "seed": 2, "steps": 25, "optimizer": LeastSquares(horizons=())}
    try:
        single = multi_start(Problem.of(truth, trial, free, **options), 2, **whole)
    except ValueError:
        return
    assert all(abs(one.estimates["IBxx"] / float(truth.IBxx) - 1.0) > within for one in single.fits)


def test_priors_of_a_file(tmp_path):
    path = tmp_path / "Bicycle.txt"
    path.write_text("mB = 85.0+/-0.5\nzB = -0.9+/-0.0\n")
    t = np.linspace(0.0, 1.0, 11)
    ride = Trial(t, {"roll": 0.1 * t}, sigma=1.0, initial={"speed": 5.0})
    options = {"priors": path, "simulation": Simulation(step=0.1)}
    problem = bicycle_problem(ride, WhippleBicycle.benchmark(), ("mB", "zB"), **options)
    assert dict(problem.specification.priors) == {"mB": (85.0, 0.5)}
    path.write_text("mB = 8_5.0+/-0.5\n")
    with pytest.raises(ValueError, match=r"line 1: 'mB = 8_5.*is not of the form"):
        bicycle_problem(ride, WhippleBicycle.benchmark(), ("mB", "zB"), **options)


@pytest.mark.weekly
def test_steer_damping_of_a_measured_bicycle_by_descent():
    """The first second of 31 rides of a steer-by-wire bicycle."""
    recording = jk.data.steer_by_wire()
    offsets = [Offset(name, each="trial") for name in ("roll_torque", "steer_torque")]
    bicycle, free = WhippleBicycle.from_parameters(recording.parameters), ("steer_damping", *offsets)
    options = {"optimizer": GradientDescent(), "zero_order_hold": "steer_torque"}
    result = fit_bicycle(recording.trials, bicycle, free, **options)
    assert result.ok, result.message
    assert len(recording.trials) == 31
    assert result.history[0] > 20000
    assert result.cost < 3920
    assert result.estimates["steer_damping"] == pytest.approx(0.545, abs=0.01)
    assert any("not white noise" in note for note in result.notes)


def test_noise_parameters_are_accepted_in_bicycle_problems():
    t = np.linspace(0.0, 1.0, 11)
    ride = Trial(t, {"roll": 0.1 * t, "steer": 0.1 * t}, sigma=1.0, initial={"speed": 5.0})
    free = ("c", SpectralDensity("roll_rate"), NoiseScale("steer", start=0.02))
    options = {"noise": {"roll_rate": 0.1}, "simulation": Simulation(step=0.1)}
    problem = bicycle_problem(ride, WhippleBicycle.benchmark(), free, **options)
    assert problem.parameters.names == ("c", "spectral density of roll_rate", "noise scale of steer")
    with pytest.raises(ValueError, match="needs a fit with a likelihood"):
        bicycle_problem(ride, WhippleBicycle.benchmark(), free)


@pytest.mark.weekly
def test_the_damping_of_the_robot_bicycle():
    """By windows of a second at 100 Hz, every second sample, weighed as the linear fit that they are compared with."""
    recording, windows, sigma = jk.data.robot_bicycle(), [], {"steer": 0.01, "roll_rate": 0.03}
    for run in recording.trials:
        measured, torque = ({c: x[::2] for c, x in group.items()} for group in (run.measured, run.inputs))
        measured = {c: measured[c] for c in sigma}
        speed = {"speed": run.initial["speed"][::2]}
        ride = Trial(run.t[::2], measured, {"steer_torque": torque["steer_torque"]}, sigma=sigma, initial=speed)
        first = ride.t[0] - 1e-6
        windows += [ride.between(first + i, first + i + 1.0 - 1e-3) for i in range(int(ride.t[-1] - first))]
    torques = {"roll_torque": 10.0, "steer_torque": 0.5}
    offsets = [Offset(name, each="trial", prior=(0.0, deviation)) for name, deviation in torques.items()]
    starts = {"roll": 0.1, "steer": None, "roll_rate": None, "steer_rate": None}
    bicycle, free = WhippleBicycle.from_parameters(recording.parameters), ("steer_damping", *offsets)
    found = fit_bicycle(windows, bicycle, free, unknown=starts, zero_order_hold=("steer_torque",))
    assert found.status == "converged"
    # The linear model's 465 are of twice as many samples.
    assert len(windows) == 38
    assert found.cost < 465 / 2
    assert found.uses_clustered_errors
    low, high = found.intervals()["steer_damping"]
    assert low < 1.49 < high  # of the linear model
    assert found.clustered_errors["steer_damping"] > 5 * found.standard_errors["steer_damping"]
