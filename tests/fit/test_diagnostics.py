"""Suspicious records are named, each kind once for all trials; good ones, coarse ones and switched ones are not."""

import numpy as np
import pytest
from systems import Cart

import jaxkane as jk
from jaxkane.fit import Free, LeastSquares, Simulation, Trial, check_records, fit

t = np.linspace(0.0, 4.0, 201)
x = 0.3 * np.sin(2.0 * t) + 0.05 * np.sin(7.3 * t)
v = 0.6 * np.cos(2.0 * t) + 0.365 * np.cos(7.3 * t)
noise = np.random.default_rng(0).normal(0.0, 1e-4, t.size)


def told(*trials):
    return list(check_records(trials))


def trial(measured, inputs=None, t=t, name="run"):
    return Trial(t, measured, inputs, sigma=1.0, name=name)


def test_valid_records_give_no_notes():
    coarse = np.round(x / 0.02) * 0.02
    slow = np.round(0.01 * x / 0.001) * 0.001
    switched = np.sign(np.sin(9.0 * t))
    rest = np.where(t < 2.0, 0.0, x)
    pulse = np.where((t > 1.0) & (t < 1.5), 2.0, 0.0)
    for y in (coarse, slow, rest, x + noise):
        assert told(trial({"x": y, "x_dot": v + noise}, {"push": switched, "pull": pulse})) == []


STALE, CLIPPED = np.repeat(x[::4], 4)[:201], np.clip(2.0 * np.sin(5.0 * t) + noise, -1.2, 1.2)


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (trial({"x": STALE}), "x repeats its last value many times"),
        (trial({"x": x}, {"push": CLIPPED}), "push has its largest value"),
        (trial({"x": np.maximum(0.3 * np.sin(6.0 * t), -0.2)}), "x has its smallest value"),
        (trial({"x": x, "x_dot": np.degrees(v) + noise}), "x_dot seems to be in degrees"),
        (trial({"x": np.degrees(x), "x_dot": v + noise}), "x seems to be in degrees"),
        (trial({"x": x, "x_dot": -v + noise}), "x_dot and the change of x have opposite signs"),
        (trial({"x": x, "x_dot": 0.0 * v}), "x_dot has the constant value 0. Check whether it was recorded."),
        (trial({"x": x + noise, "w": np.gradient(x + noise, t)}), "w is the difference quotient of x"),
        (trial({"x": x, "w": np.append(np.diff(x) / np.diff(t), np.nan)}), "w is the difference quotient of x"),
        (trial({"x": x[::2]}, {"push": x[::2]}, np.where(t < 2, t, t + 1)[::2]), "the times have a gap"),
    ],
)
def test_each_suspicious_record_is_reported(record, words):
    (note,) = told(record)
    assert note.startswith("run: ")
    assert words in note


def test_notes_of_several_trials():
    (note,) = told(*(trial({"x": STALE + 0.001 * i}, name=f"run {i}") for i in range(5)))
    assert note.startswith("run 0, run 1, run 2 and 2 more: x repeats")
    once = trial({"x": x}, {"push": v})
    assert told(once, once) == ["run has the same samples as run, so these are counted twice. Omit one trial."]
    zeros = lambda n: told(*(trial({"x": x + i}, {"push": (i >= n) * v}) for i in range(4)))  # noqa: E731
    assert zeros(1) == ["run: the input push is always zero, but not in other trials. Check the record."]
    assert zeros(0) == zeros(2) == []


class Sensed(Cart):
    def outputs(self, t, q, u, motion, now):
        return {"gyro": u["x_dot"]}


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("factor", "words"), [(57.3, "seems to be recorded in degrees"), (-1.0, "have opposite signs")]
)
def test_a_sensor_in_degrees_or_with_a_wrong_sign_is_reported(factor, words):
    system = Sensed(mass=1.0, stiffness=4.0, damping=0.2)
    ride = jk.simulate(system, jk.assemble(system, {"x": 0.5}), t[::4])
    gyro = factor * np.asarray(ride["gyro"])
    record = Trial(t[::4], {"x": ride["x"], "gyro": gyro}, sigma={"x": 1e-4, "gyro": 1e-1}, initial={"x": 0.5})
    found = fit(system, record, Free("stiffness"), optimizer=LeastSquares(), simulation=Simulation(step=0.08))
    assert any(note.startswith("gyro ") and words in note for note in found.notes)


@pytest.mark.weekly
def test_a_trial_with_large_residuals_is_reported():
    system = Cart(mass=1.0, stiffness=4.0, damping=0.2)
    rng, trials = np.random.default_rng(0), []
    for i in range(5):
        ride = jk.simulate(system, jk.assemble(system, {"x": 0.3 + 0.1 * i}), t[::4])
        bumped = 0.05 * np.sin(5.0 * t[::4]) if i == 3 else 0.0
        y = ride["x"] + bumped + rng.normal(0.0, 2e-3, 51)
        trials.append(Trial(t[::4], {"x": y}, sigma=2e-3, initial={"x": 0.3 + 0.1 * i}, name=f"run {i}"))
    found = fit(system, trials, Free("stiffness"), optimizer=LeastSquares(), simulation=Simulation(step=0.08))
    (note,) = [note for note in found.notes if "The residuals of run 3 (" in note]
    assert "fit the others without them" in note
    fine = fit(system, [x for x in trials if x.name != "run 3"], Free("stiffness"), optimizer=LeastSquares(), steps=4)
    assert not any("The residuals of run" in note for note in fine.notes)
