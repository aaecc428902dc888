"""When a search ends: by the variance of the residuals, at bounds, after rejected steps, and with fine enough steps."""

import numpy as np
import pytest
from systems import POSED, PUSH, SEEN, TRIAL, Cart, T, Track, responses

import jaxkane.fit.solve.fit as search
from jaxkane.fit import Free, GradientDescent, LeastSquares, Problem, Simulation, Trial, fit, minimize

FREE = ("gain", "drift")


@pytest.mark.slow_cases("Levenberg-Marquardt")
@pytest.mark.parametrize("optimizer", [LeastSquares(), GradientDescent()], ids=lambda m: m.name)
def test_a_fit_converges_when_the_cost_reduction_is_small_to_the_variance(optimizer):
    problem = Problem.of(Track(), TRIAL, FREE, **POSED)
    found, least = (minimize(problem, method) for method in (optimizer, LeastSquares(rtol=1e-13)))
    assert found.status == "converged"
    assert len(found.history) <= 4
    variance = found.cost / (len(T) - 3)  # of 11 residuals, 2 parameters and a start
    assert found.cost - least.cost < 1e-6 * variance


def test_nanometres_with_a_sigma_of_one_are_fitted_like_metres():
    small = Trial(T, {"x": 1e-9 * SEEN}, {"push": 1e-9 * PUSH}, sigma=1.0)
    free = ("gain", Free("drift", scale=1e-9))
    metres, nanometres = (fit(Track(), trial, f, **POSED) for trial, f in ((TRIAL, FREE), (small, free)))
    assert nanometres.status == "converged"
    assert nanometres.estimates["gain"] == pytest.approx(metres.estimates["gain"], rel=1e-6)
    assert nanometres.estimates["drift"] == pytest.approx(1e-9 * metres.estimates["drift"], rel=1e-6)
    assert nanometres.errors["gain"] == pytest.approx(metres.errors["gain"], rel=1e-6)


@pytest.mark.weekly
def test_a_fit_with_a_parameter_at_its_bound():
    trials = [Trial(T, {"x": SEEN - 0.05 * np.sin(3.0 * T)}, {"push": -PUSH}, sigma=0.1, name=f"{k}") for k in range(3)]
    problem = Problem.of(Track(), trials, (Free("gain", start=0.5, bounds=(0.0, 0.7)), "drift"), **POSED)
    bounded = minimize(problem, LeastSquares())
    assert minimize(Problem.of(Track(), trials, FREE, **POSED), LeastSquares()).estimates["gain"] < 0.0
    assert bounded.status == "bound"
    assert 0.0 < bounded.estimates["gain"] < 1e-3
    assert "gain rests at its bound, which the data do not contradict" in str(bounded)
    assert bounded.ok
    assert np.isfinite(bounded.held_out_cost)
    # The other parameter is at its minimum with a gain of zero.
    fixed = minimize(Problem.of(Track(gain=bounded.estimates["gain"]), trials, ("drift",), **POSED), LeastSquares())
    assert bounded.estimates["drift"] == pytest.approx(fixed.estimates["drift"], abs=0.01 * fixed.errors["drift"])
    assert minimize(problem, GradientDescent()).status == "bound"


CART = Cart(mass=1.0, stiffness=400.0, damping=2.5)


@pytest.fixture(scope="module")
def vibration():
    """A vibration of a micrometre, with noise of a nanometre, and no input: adaptive steps."""
    t = np.linspace(0.0, 1.0, 201)
    rate = (400.0 - 1.5**2) ** 0.5
    exact = 1e-6 * np.exp(-1.5 * t) * (np.cos(rate * t) + 1.5 / rate * np.sin(rate * t))
    noise = 1e-9 * np.random.default_rng(0).normal(size=t.size)
    return t, exact, exact + noise


@pytest.mark.slow
def test_micrometres_are_integrated_like_metres(vibration):
    t, _, x = vibration
    guess = Cart(mass=1.0, stiffness=390.0, damping=2.5)
    found = [
        fit(
            guess,
            Trial(t, {"x": unit * x}, sigma=sigma, initial={"x": unit * 1e-6, "x_dot": 0.0}),
            ("stiffness", "damping"),
        )
        for unit, sigma in ((1.0, 1e-9), (1e6, 1e-3), (1.0, 1.0))
    ]
    for one in found:
        assert one.ok, one.message
        assert one.step_error < 0.25
        for name, value in (("stiffness", 400.0), ("damping", 3.0)):
            assert abs(one.estimates[name] - value) < 3.5 * one.errors[name] < 0.01 * value
            assert one.estimates[name] == pytest.approx(found[0].estimates[name], abs=0.3 * one.errors[name])


@pytest.mark.slow
def test_loose_tolerances_are_reported(vibration):
    t, _, x = vibration
    trial = Trial(t, {"x": x}, sigma=1.0, initial={"x": 1e-6, "x_dot": 0.0})
    found = fit(CART, trial, "damping", simulation=Simulation(rtol=1e-3, atol=1e-7))
    assert found.too_coarse
    assert not found.ok
    assert "tolerance of integration (rtol 0.001) is too coarse" in found.message


def test_a_refinement_that_is_interrupted_keeps_the_fit(vibration, monkeypatch):
    t, _, x = vibration
    guess = Cart(mass=1.0, stiffness=390.0, damping=2.5)
    trial = Trial(t, {"x": x}, sigma=1e-9, initial={"x": 1e-6, "x_dot": 0.0})
    whole = fit(guess, trial, ("stiffness", "damping"))
    monkeypatch.setattr(search.Fit, "too_coarse", True)

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "finer", interrupted)
    found = fit(guess, trial, ("stiffness", "damping"))
    assert found.status == "unchecked"
    assert found.cost == pytest.approx(whole.cost, rel=1e-6)
    assert "check or the refinement of the steps of integration failed" in str(found)
    assert not found.ok


class Many(Track):
    """A place that fifty sensors measure."""

    def outputs(self, t, q, u, motion, now):
        return {f"sensor {i}": q["x"] for i in range(50)}


@pytest.mark.weekly
def test_a_close_initial_guess_moves_to_the_minimum_with_200000_residuals():
    """A fit that stops by a fraction of the cost would stay at the guess, which is the truth here."""
    t, truth = np.linspace(0.0, 4.0, 4001), {"gain": 1.0, "drift": 0.3}
    push = np.sin(3.0 * t)
    A = responses(t, push)[0]
    y = A @ [*truth.values()] + np.random.default_rng(0).normal(size=(50, t.size))
    measured = {f"sensor {i}": row for i, row in enumerate(y)}
    trial = Trial(t, measured, {"push": push}, sigma=1.0, initial={"x": 0.0, "x_dot": 0.0})
    found = fit(Many(drift=0.3), trial, FREE, simulation=Simulation(step=1e-3))
    assert found.status == "converged"
    best, errors = np.linalg.lstsq(A, y.mean(axis=0))[0], np.array([*found.standard_errors.values()])
    assert np.all(np.abs(np.array([*found.estimates.values()]) - best) < 0.02 * errors)
    assert np.any(np.abs(best - [*truth.values()]) > 0.1 * errors)
