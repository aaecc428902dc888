"""Bicycles: three parameters of an unstable one, the damping of a measured one.

Four parameters of a simulated one: `examples/fit_bicycle.py`, which asserts that they are found.
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
    frame_inertia,
    minimize,
    multi_start,
)

SIGMA = {"roll": 0.005, "steer": 0.005, "roll_rate": 0.03, "steer_rate": 0.05}


def waves(rng, t, size, frequencies):
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    return size * sum(np.sin(2.0 * np.pi * f * t + p) for f, p in zip(frequencies, phases, strict=True))


@pytest.fixture(scope="module")
def unstable():
    """The benchmark bicycle at 3 m/s, kept up by a rider; noise and offsets, and no roll angle."""
    truth, rng, t = WhippleBicycle.benchmark(), np.random.default_rng(1), np.arange(0.0, 10.0, 0.01)
    poke = jk.Samples(jnp.asarray(t), jnp.asarray(waves(rng, t, 1.5, (0.35, 0.8, 1.3, 2.1))))

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


@pytest.mark.weekly
def test_estimated_bodies_of_a_bicycle_are_physically_possible(unstable):
    truth, trial, offsets, options = unstable
    rear = frame_inertia("B", fixed=("mB", "xB"))
    result = minimize(Problem.of(truth, trial, (rear, *offsets), window=1.0, **options), LeastSquares(), steps=6)
    assert set(result.names) == {"zB", "IBxx", "IByy", "IBzz", "IBxz"}
    assert not any("A body is not physically possible" in note for note in result.notes)
    assert abs(result.estimates["zB"] + 0.9) < 4.0 * result.standard_errors["zB"]


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


@pytest.fixture(scope="module")
def measured():
    """The first second of 31 rides of a steer-by-wire bicycle, and its authors' parameters."""
    recording = jk.data.steer_by_wire()
    return recording.trials, WhippleBicycle.from_parameters(recording.parameters)


OFFSETS = [Offset(name, each="trial") for name in ("roll_torque", "steer_torque")]


@pytest.mark.weekly
def test_steer_damping_of_a_measured_bicycle_by_descent(measured):
    """By least squares, with more parameters and with what the model lacks: `examples/identify_measured_bicycle.py` and
    notebook 13, which assert what they show."""
    rides, bicycle = measured
    result = fit_bicycle(
        rides, bicycle, ("steer_damping", *OFFSETS), optimizer=GradientDescent(), zero_order_hold="steer_torque"
    )
    assert result.ok, result.message
    assert len(rides) == 31
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


def test_a_bicycle_trial_requires_a_speed():
    t = np.linspace(0.0, 1.0, 11)
    ride = Trial(t, {"roll": 0.1 * t}, sigma=SIGMA, name="ride 7")
    with pytest.raises(ValueError, match="ride 7: the speed is missing"):
        fit_bicycle(ride, WhippleBicycle.benchmark(), "c")
    ride = Trial(t, {"roll": 0.1 * t}, sigma=SIGMA, initial={"speed": 5.0})
    with pytest.raises(ValueError, match="`free` contains rR"):
        fit_bicycle(ride, WhippleBicycle.benchmark(), ("c", "rR"))
