"""Parameters on trials that they were not found from: scores, rides that cannot be simulated, starts and notes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import POSED, PUSH, TRIAL, T, Track, programs

import jaxkane as jk
from jaxkane.fit import (
    Delay,
    Free,
    Gain,
    LeastSquares,
    Offset,
    Problem,
    Simulation,
    Trial,
    compare,
    cross_validate,
    fit,
    load,
    minimize,
    validate,
)
from jaxkane.fit.result import validation
from jaxkane.fit.result.validation import CrossValidation, costs_by_trial
from jaxkane.fit.solve.linearization import trajectories_of


class Falling(Track):
    """A track that is steeper the farther one is: beyond some place the motion is infinite before its end."""

    def loads(self, t, q, u, motion, inputs):
        return (*super().loads(t, q, u, motion, inputs), jk.Force(jnp.exp(q["x"]) * motion.N.x, motion["cart"]))


RNG = np.random.default_rng(2)
NEAR = [
    Trial(T, {"x": 0.5 * T**2 + RNG.normal(0, 0.1, 11)}, {"push": PUSH}, sigma=0.1, name=f"near {i}") for i in "abc"
]
FAR = [Trial(T, {"x": np.full(11, x)}, {"push": PUSH}, sigma=0.1, initial={"x": x}, name="far") for x in (90.0, 95.0)]
FREE, STEP = ("gain", "drift"), Simulation(step=0.1)
OF_TRIAL = Offset("x", each="trial", prior=(0.0, 0.05))


@pytest.fixture(scope="module")
def falling():
    return fit(Falling(), NEAR, FREE, simulation=STEP, optimizer=LeastSquares())


@pytest.mark.weekly
def test_validation_reports_trials_that_fail_and_keeps_the_others(falling, tmp_path):
    held = validate(falling, [FAR[0], *NEAR, FAR[1]])
    alone = validate(falling, NEAR)
    assert held.trial_names == ("near a", "near b", "near c")
    assert held.cost == pytest.approx(alone.cost, rel=1e-6)
    assert list(held.failed) == ["far (0)", "far (4)"]
    assert all("no solution" in why for why in held.failed.values())
    assert any(note.startswith("far (4) is left out: the residuals from 0 to 1 s") for note in held.notes)
    assert alone.failed == {}
    # Parameters that were not fitted to these trials have no errors from them.
    errors = [alone.standard_errors["gain"], alone.clustered_errors["gain"], *alone.intervals()["gain"]]
    assert np.isnan(errors).all()
    assert load(held.save(tmp_path / "held.npz"), held.problem).failed == held.failed
    with pytest.raises(ValueError, match=r"none of these trials can be simulated .*: far \(0\), the residuals from"):
        validate(falling, FAR)
    text = str(compare({"one": falling}, held_out=[FAR[0], *NEAR]))
    assert "3 of 4 trials" in text
    assert "not simulated" in text


@pytest.mark.weekly
@pytest.mark.parametrize(
    "options",
    [
        {"window": 1.0, "unknown": {"x": 0.2, "x_dot": None}, "free": (Free("gain", prior=(1.5, 0.1)), OF_TRIAL)},
        {"zero_order_hold": "push"},
        {"free": ("gain", Free("drift", start=0.2), Delay("push", bounds=(0.0, 0.3)))},
        {"noise": {"x_dot": 0.1}},
        {"window": 1.0, "defect_std": {"x": 0.01, "x_dot": 0.02}},
    ],
    ids=["windows", "held", "late", "noise", "chained"],
)
def test_shorter_trials_run_the_program_of_the_fit(options, monkeypatch):
    """To the numbers of a program of their own. Their windows are fewer, of fewer samples, and inputs of fewer."""
    t = np.linspace(0.0, 3.0, 31)
    trials = [
        Trial(t[:n], {"x": 0.5 * t[:n] ** 2 + RNG.normal(0, 0.1, n)}, {"push": np.sin(t[:n])}, sigma=0.1)
        for n in (31, 25, 22, 16)
    ]
    options = {"free": FREE, "unknown": ("x", "x_dot"), "simulation": STEP, "optimizer": LeastSquares(), **options}
    found = fit(Track(), trials[:2], options.pop("free"), **options)
    compiled = programs()
    one, together = validate(found, trials[3]), validate(found, trials[2:])
    assert programs() <= compiled
    monkeypatch.setattr(validation, "MOST_ADDED_SAMPLES", 0)
    for held, asked in ((one, trials[3]), (together, trials[2:])):
        alone = validate(found, asked)
        assert held.cost == pytest.approx(alone.cost, rel=1e-8)
        for name, y in alone.fitted.items():
            np.testing.assert_allclose(held.fitted[name]["x"], y["x"], atol=1e-7)
        np.testing.assert_allclose(held.point.window_starts, alone.point.window_starts, atol=1e-6)
    assert programs() - compiled


def test_shortened_and_excluded_windows_are_not_linked():
    """A window that is shortened ends before its next one starts, and trials left out count nothing."""
    t = np.linspace(0.0, 3.0, 31)
    trial = Trial(t, {"x": t}, {"push": np.sin(t)}, sigma=0.1)
    chained = {"window": 1.0, "defect_std": {"x": 0.01, "x_dot": 0.02}, "unknown": ("x", "x_dot")}
    problem = Problem.of(Track(), [trial, trial], FREE, simulation=STEP, **chained)
    samples = np.array([n for *_, n in problem.slices])
    np.testing.assert_array_equal(problem.windows.linked, [1, 1, 0, 1, 1, 0])
    np.testing.assert_array_equal(problem.shortened(samples - [1, 0, 0, 0, 0, 0]).windows.linked, [0, 1, 0, 1, 1, 0])
    np.testing.assert_array_equal(problem.only([1]).windows.linked, [0, 0, 0, 1, 1, 0])


@pytest.mark.weekly
def test_windows_are_simulated_as_one_batch_on_a_gpu(monkeypatch):
    """Without states of its own the system has trajectories with arrays of size zero, which a batch must permit."""
    problem = Problem.of(Track(), [TRIAL, TRIAL.with_initial_state({"x": 0.5, "x_dot": 0.2})], FREE, simulation=STEP)
    point = problem.start
    here = problem.trajectories(point)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    program = jax.jit(lambda point, starts: trajectories_of.__wrapped__(problem.model, problem.windows, point, starts))
    there = program(point, problem.starts(point))
    assert 0 in {x.size for x in jax.tree.leaves(there)}
    for i, motion in enumerate(here):
        np.testing.assert_allclose(there.q[i], motion.q, rtol=1e-12)


@pytest.mark.weekly
def test_a_fit_continues_without_a_trial_that_cannot_be_simulated(falling, tmp_path):
    found = fit(Falling(), [FAR[0], *NEAR, FAR[1]], FREE, simulation=STEP, optimizer=LeastSquares())
    assert found.trial_names == ("near a", "near b", "near c")
    assert found.estimates == pytest.approx(falling.estimates, rel=1e-6)
    assert list(found.failed) == ["far (0)", "far (4)"]
    assert found.notes[0].startswith("far (0) is left out: the residuals from 0 to 1 s are not finite")
    posed = [FAR[0], *NEAR, FAR[1]]
    same = load(found.save(tmp_path / "found.npz"), Problem.of(Falling(), posed, FREE, simulation=STEP))
    assert same.failed == found.failed
    assert same.cost == found.cost
    with pytest.raises(ValueError, match="`start` belongs to another problem"):
        fit(Falling(), posed, FREE, simulation=STEP, start=found.point)
    for steps in (1, None):  # goes on
        kept = {"checkpoint": tmp_path / "checkpoint.npz", "steps": steps}
        again = fit(Falling(), posed, FREE, simulation=STEP, optimizer=LeastSquares(), **kept)
    assert again.estimates == pytest.approx(found.estimates, rel=1e-6)
    assert list(again.failed) == list(found.failed)
    with pytest.raises(ValueError, match=r"far: with the initial guess .* 2 of 2 windows"):
        fit(Falling(), FAR, FREE, simulation=STEP)


@pytest.mark.weekly
def test_growing_horizons_exclude_no_trial_with_or_without_a_checkpoint(falling, tmp_path):
    """The initial guess simulates no trial to its end. With growing horizons, the fit reaches parameters that do."""
    guess = Falling(drift=30.0)
    with pytest.raises(ValueError, match="3 of 3 windows"):
        fit(guess, NEAR, FREE, simulation=STEP, checkpoint=tmp_path / "none.npz")
    by_horizons = LeastSquares(horizons=(0.3, 0.6))
    for more in ({}, {"checkpoint": tmp_path / "horizons.npz"}):
        found = fit(guess, NEAR, FREE, simulation=STEP, optimizer=by_horizons, **more)
        assert found.failed == {}
        assert found.cost == pytest.approx(falling.cost, rel=1e-4)


def test_a_held_out_trial_that_cannot_be_simulated_has_infinite_cost(falling):
    both = falling.problem.with_trials([*NEAR, FAR[0]])
    costs = costs_by_trial(both, dataclasses.replace(both.start, parameters=falling.point.parameters))
    assert np.isinf(costs[3])
    np.testing.assert_allclose(costs[:3], costs_by_trial(falling.problem, falling.point), rtol=1e-6)
    left_out = CrossValidation(falling, ("a", "b"), *(np.array([1.0, 1.0]) for _ in range(3)), np.array([1.0, np.inf]),
                               np.array([2.0, 2.0]), {})  # fmt: skip
    assert left_out.conclusion == "b cannot be simulated with the parameters of the others."


@pytest.mark.slow
def test_the_held_out_score_is_independent_of_the_initial_guess():
    rtol = 1e-6
    trials = [Trial(T, {"x": y}, {"push": PUSH}, sigma=0.1) for y in (TRIAL.measured["x"], 0.7 * T**2, 0.5 * T**2)]
    fits = [fit(Track(gain=gain), trials, FREE, optimizer=LeastSquares(rtol=1e-12), **POSED) for gain in (1.0, 60.0)]
    near, far = map(cross_validate, fits)
    about_mean = [np.sum((10 * (y - y.mean())) ** 2) for y in (trial.measured["x"] for trial in trials)]
    np.testing.assert_allclose(near.spread, about_mean, rtol=rtol)
    assert near.score == pytest.approx(1 - near.held_out.sum() / near.spread.sum(), rel=rtol)
    assert far.score == pytest.approx(near.score, rel=rtol)
    assert 0.8 < near.score < 0.95
    assert f"{100 * near.score:.1f} % of the measurements' variance" in str(near)


@pytest.mark.weekly
def test_reported_initial_states_equal_those_of_the_trajectory():
    """The given initial states have a gain and an offset."""
    trial = TRIAL.with_initial_state({"x": 0.5, "x_dot": 0.2})
    free = (Gain("x_dot", of="start"), Offset("x", of="start", prior=(0.3, 0.05)))
    found = fit(Track(), trial, free, unknown={"x": 0.1}, simulation=STEP, optimizer=LeastSquares())
    (start,) = (values["start of x"] for values in found.nuisance.values())
    motion = found.problem.trajectories(found.point)[0]
    assert float(start[0]) == pytest.approx(float(motion["x"][0]), rel=1e-9)
    assert abs(float(start[0]) - 0.5) > 0.1


@pytest.mark.slow
def test_a_note_reports_a_fixed_initial_state_that_is_noisy():
    """The first sample is off by three of its deviations, and the whole motion with it."""
    y = 0.5 * T**2 + np.append(0.3, np.zeros(10))
    told = fit(Track(), Trial(T, {"x": y}, {"push": PUSH}, sigma=0.02), FREE, simulation=STEP, optimizer=LeastSquares())
    (note,) = [note for note in told.notes if "chi^2" in note]
    assert f"chi^2 is {told.cost:.4g} with 9 degrees of freedom" in note
    assert "start at measured samples of x" in note
    assert "`unknown=('x', 'x_dot')`" in note
    free = minimize(Problem.of(Track(), told.problem.trials, FREE, **POSED), LeastSquares())
    assert "chi^2" in " ".join(free.notes)  # one sample is still off
    loose = Trial(T, {"x": 0.5 * T**2}, {"push": PUSH}, sigma=1.0, initial={"x": 0.0})
    fine = fit(Track(), loose, FREE, simulation=STEP, optimizer=LeastSquares())
    assert not any("start" in note for note in fine.notes if "chi^2" in note)


@pytest.mark.slow
def test_validation_of_a_system_with_given_parameter_values():
    """A system and a fit with the same values give the same result. Only the initial states are estimated."""
    posed = {"unknown": ("x", "x_dot"), "simulation": STEP}
    found = fit(Track(), NEAR[:2], FREE, optimizer=LeastSquares(), **posed)
    assert validate(found, NEAR[:2]).cost == pytest.approx(found.cost, rel=1e-9)
    given = validate(found.system, NEAR, **posed)
    assert given.cost == pytest.approx(validate(found, NEAR).cost, rel=1e-9)
    assert (given.status, given.names, given.estimates) == ("validated", (), {})
    assert given.system == found.system
    assert "not fitted" in str(given)
    assert "sum of squares" in str(compare({"given": found}, held_out=NEAR))
    with pytest.raises(TypeError, match="the options unknown are already part of the Fit"):
        validate(found, NEAR, unknown="x")
    with pytest.raises(TypeError, match=r"validate requires a Fit, as in validate\(fit"):
        validate(found.problem, NEAR)
