"""Steps of integration that follow the motion, at the start of a fit and at its end; an evidence by quadrature."""

import dataclasses

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.special
from systems import Cart, pushed

import jaxkane as jk
from jaxkane.fit import Free, GradientDescent, LeastSquares, Problem, Simulation, Trial, fit, minimize
from jaxkane.fit.problem.problem import finer, step_errors, step_tolerance

H, SIGMA = 0.25, 0.001
t = np.arange(0.0, 10.0, H)
PUSH = 20.0 * np.sin(3.0 * t) + 8.0 * np.cos(7.7 * t)


def exact(stiffness, damping):
    return pushed(1.0, stiffness, damping, [0.1, 0.0], t, PUSH)


@pytest.fixture(scope="module")
def trial():
    """Four samples a second of a mass that swings three times a second."""
    noisy = exact(400.0, 3.0) + SIGMA * np.random.default_rng(0).normal(size=t.size)
    return Trial(t, {"x": noisy}, {"push": PUSH}, sigma=SIGMA, initial={"x": 0.1, "x_dot": 0.0})


GUESS = Cart(mass=1.0, stiffness=350.0, damping=2.0)
NAMES = ("stiffness", "damping")


@pytest.mark.weekly
def test_few_samples_per_period_do_not_bias_the_estimates(trial):
    """Against estimates by the exact solution."""
    options = {"x_scale": (1.0, 0.1), "xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
    residuals = lambda p: (exact(*p) - trial.measured["x"]) / SIGMA  # noqa: E731
    best = scipy.optimize.least_squares(residuals, (390.0, 2.5), **options)
    errors = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    found = fit(GUESS, trial, NAMES, optimizer=LeastSquares())
    assert found.ok, found.message
    assert found.step_error < step_tolerance(found.problem)
    # The tolerance bounds what the steps do to the estimates.
    assert np.all(np.abs((np.array(list(found.estimates.values())) - best.x) / errors) < step_tolerance(found.problem))


@pytest.mark.slow
@pytest.mark.many_steps
def test_more_fixed_steps_than_any_default_allows(trial):
    # 10 s by steps of 1 ms are more than 4096.
    found = minimize(Problem.of(GUESS, trial, NAMES, simulation=Simulation(step=1e-3)), LeastSquares())
    assert found.ok, found.message


@pytest.mark.slow
@pytest.mark.many_steps
def test_too_coarse_steps_are_reported_or_halved(trial):
    # Slow where it starts: the steps that are chosen there are too coarse where it ends.
    slow = Cart(mass=1.0, stiffness=350.0, damping=40.0)
    problem = Problem.of(slow, trial, NAMES)
    direct = minimize(problem, LeastSquares())
    told = fit(GUESS, trial, NAMES, optimizer=LeastSquares(), simulation=Simulation(step=H / 4))
    assert float(told.problem.windows.step[0]) == H / 4
    assert told.status == "converged"
    assert told.too_coarse
    assert not told.ok
    assert "is too coarse at the estimates" in told.message
    assert told.message.split("; ")[-1] + "." in str(told)
    for refined in (direct, fit(slow, trial, NAMES, optimizer=LeastSquares())):
        assert refined.ok
        assert refined.problem.windows.step[0] < problem.windows.step[0]


def test_a_step_longer_than_a_window_has_the_error_of_the_window_length(trial):
    posed = [Problem.of(GUESS, trial, NAMES, simulation=Simulation(step=x)) for x in (t[-1], 100.0 * t[-1])]
    errors = [step_errors(problem, problem.start) for problem in posed]
    np.testing.assert_array_equal(errors[0], errors[1])
    assert not errors[1] < step_tolerance(posed[1])  # NaN where such a step goes nowhere


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": 0.1, "rtol": 1e-6}, "`step` is given together with"),
        ({"step": -1.0}, "`step` must be positive"),
        ({"atol": -1.0}, "`atol` must be positive"),
        ({"max_steps": 0}, "`max_steps` must be positive"),
    ],
)
def test_invalid_simulation_options_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        Simulation(**options)


@pytest.fixture(scope="module")
def beyond():
    """Data of a spring that pushes: the minimum lies where a stiffness, declared positive, cannot be simulated."""
    pushed = Trial(t, {"x": exact(-0.05, 2.0)}, {"push": PUSH}, sigma=SIGMA, initial={"x": 0.1, "x_dot": 0.0})
    guess = Cart(mass=1.0, stiffness=0.5, damping=2.0)
    return Problem.of(guess, pushed, Free("stiffness", bounds=(None, None)), simulation=Simulation(step=0.05))


@pytest.mark.slow
@pytest.mark.weekly_cases("Levenberg-Marquardt")
@pytest.mark.parametrize("method", [GradientDescent(), LeastSquares()], ids=lambda m: m.name)
def test_no_method_reports_convergence_if_the_optimum_cannot_be_simulated(beyond, method):
    found = minimize(beyond, method)
    assert found.status in ("stuck", "steps"), found
    assert not found.ok
    assert np.isfinite(found.cost)
    assert found.cost < found.history[0]
    assert 0.0 < found.estimates["stiffness"] < 0.5


class Sticky(Cart):
    """Friction grows with the cube of the rate, so the motion needs steps shorter than 0.01 s."""

    def loads(self, t, q, u, motion, inputs):
        friction = -300.0 * u["x_dot"] ** 3
        return (*super().loads(t, q, u, motion, inputs), jk.Force(friction * motion.N.x, motion["cart"]))


@pytest.fixture(scope="module")
def stiff():
    """Guess, trials whose motion needs several steps per sample, and their fit with error control."""
    times, trials = np.arange(0.0, 2.0, 0.05), []
    for k in range(3):
        push = (3.0 + k) * np.sin(2.0 * times + k)
        truth = Sticky(mass=1.0, stiffness=6.0, damping=0.5)
        start = jk.State(q=[0.1], u=[0.8])
        ride = jk.simulate(truth, start, jnp.asarray(times), {"push": jk.Samples(times, push)}, rtol=1e-9)
        measured = {"x": np.asarray(ride["x"]) + 1e-4 * np.random.default_rng(k).normal(size=times.size)}
        trials.append(Trial(times, measured, {"push": push}, sigma=1e-4, initial={"x": 0.1, "x_dot": 0.8}))
    guess = Sticky(mass=1.0, stiffness=4.0, damping=0.5)
    by_error = fit(guess, trials, "stiffness", simulation=Simulation(rtol=1e-8))
    return guess, trials, by_error


@pytest.mark.weekly
@pytest.mark.many_steps
@pytest.mark.parametrize(
    "how", [None, Simulation(step=0.05 / 16, solver=diffrax.Kvaerno5())], ids=["halved", "implicit"]
)
def test_stiff_motions_are_fitted(stiff, how):
    guess, trials, by_error = stiff
    coarse = Problem.of(guess, trials, "stiffness", simulation=Simulation(step=0.05))
    assert not coarse.linearize(coarse.start).good.any()  # from sample to sample none reaches its end
    found = fit(guess, trials, "stiffness", simulation=how)
    assert found.status == "converged"
    assert found.failed == {}
    error = by_error.standard_errors["stiffness"]
    assert found.estimates["stiffness"] == pytest.approx(by_error.estimates["stiffness"], abs=0.3 * error)
    assert by_error.estimates["stiffness"] == pytest.approx(6.0, abs=3.5 * error)


@pytest.mark.weekly
@pytest.mark.many_steps
def test_a_window_that_fails_at_the_guess_uses_the_step_of_the_others(stiff):
    """One initial state is so wrong that no step size is accurate. Its window uses the shortest step of the others."""
    guess, trials, _ = stiff
    problem = Problem.of(guess, trials, "stiffness")
    steps = np.asarray(problem.windows.step)
    assert np.all(steps < 0.05 / 3)
    windows = eqx.tree_at(lambda w: w.start, problem.windows, problem.windows.start.at[1, 1].set(1e6))
    again = finer(dataclasses.replace(problem, windows=windows).with_steps(jnp.full(3, 0.05)), problem.start)
    assert float(again.windows.step[1]) == pytest.approx(np.min(steps))
