"""When a search ends: by the variance of the residuals, at bounds, after rejected steps, and with fine enough steps."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from systems import POSED, PUSH, SEEN, SETS, TRIAL, Cart, T, Track, coverage_band

import jaxkane.fit.solve.fit as search
from jaxkane.fit import Free, GradientDescent, LeastSquares, Problem, Simulation, Trial, fit, minimize
from jaxkane.fit.problem.parameters import Interval
from jaxkane.fit.solve.linearization import Blocks, eliminate
from jaxkane.fit.solve.optimizers import Optimizer, Unsimulated, negligible_gain, proposed, variance_of

FREE = ("gain", "drift")


def blocks_in(units, n_z=1):
    """Random residuals of two windows of one trial, with columns [z, x, r] in these units."""
    A = np.random.default_rng(0).normal(size=(2, 20, n_z + len(units) + 1))
    A[:, :, n_z:-1] *= units
    R = jnp.linalg.qr(jnp.asarray(A), mode="r")
    return A, Blocks(R, jnp.zeros((0, R.shape[-1] - n_z)), jnp.array([[0, 1]]), n_z, 0, 0)


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e-6, 1e3, 1.0)])
def test_a_damped_step_equals_dense_least_squares_in_any_units(units):
    damping, rtol = 0.3, 1e-9
    A, blocks = blocks_in(units)
    x, least = eliminate(blocks, damping).step(damping)
    dense = np.zeros((40, 5))
    dense[:20, 0], dense[20:, 1], dense[:, 2:] = A[0, :, 0], A[1, :, 0], A[:, :, 1:-1].reshape(40, 3)
    D = damping * np.diag(np.linalg.norm(dense, axis=0))
    whole, r = np.concatenate([dense, D]), np.concatenate([A[:, :, -1].ravel(), np.zeros(5)])
    solution = np.linalg.lstsq(whole / np.linalg.norm(dense, axis=0), -r, rcond=None)[0]
    np.testing.assert_allclose(x, (solution / np.linalg.norm(dense, axis=0))[2:], rtol=rtol)
    np.testing.assert_allclose(least, np.sum((whole @ (solution / np.linalg.norm(dense, axis=0)) + r) ** 2), rtol=rtol)


def test_a_limited_step_equals_bounded_least_squares():
    _, blocks = blocks_in((1.0, 2.0, 0.5))
    free, _ = eliminate(blocks, 0.0).step(0.0)
    longest = np.array([np.inf, np.abs(free[1]) / 4, np.inf])
    x, least = eliminate(blocks, 0.0).step(0.0, longest)
    rows, r = eliminate(blocks, 0.0).rows
    limited = scipy.optimize.lsq_linear(rows, -r, (-longest, longest), tol=1e-14)
    np.testing.assert_allclose(x, limited.x, rtol=1e-6)
    np.testing.assert_allclose(least, 2 * limited.cost, rtol=1e-9)


@pytest.mark.slow_cases("Levenberg-Marquardt")
@pytest.mark.parametrize("optimizer", [LeastSquares(), GradientDescent()], ids=lambda m: m.name)
def test_a_fit_converges_when_the_cost_reduction_is_small_to_the_variance(optimizer):
    problem = Problem.of(Track(), TRIAL, FREE, **POSED)
    found = minimize(problem, optimizer)
    assert found.status == "converged"
    assert len(found.history) <= 4
    variance = found.cost / (len(T) - 3)  # of 11 residuals, 2 parameters and a start
    assert variance_of(problem, found.linearization) == pytest.approx(variance)
    assert negligible_gain(problem, found.linearization, 1e-4) == pytest.approx(1e-4 * variance)
    # The last step is taken: nothing is left of what it gained.
    assert proposed(problem, found.linearization, 0.0).gain < 1e-6 * variance


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
    from test_parameters import Limited

    trials = [Trial(T, {"x": SEEN - 0.05 * np.sin(3.0 * T)}, {"push": -PUSH}, sigma=0.1, name=f"{k}") for k in range(3)]
    problem = Problem.of(Limited(), trials, FREE, **POSED)
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


def test_the_search_restarts_after_three_rejected_steps_only_once():
    class Long:
        slices, model = ((0, 0, 100),), type("M", (), {"noise": None})

    stiff = lambda history: search._is_stiff(Long, history)  # noqa: E731
    assert stiff([9.0, 4.0, 4.0, 4.0, 4.0])
    assert not stiff([9.0, 4.0, 4.0, 4.0])
    assert not stiff([4.0, 4.0, 4.0, 4.0, 4.0])  # once
    assert not stiff([4.0, 4.0, 4.0, 4.0, 3.0])
    Long.slices = ((0, 0, 99),)
    assert not stiff([9.0, 4.0, 4.0, 4.0, 4.0])


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


@pytest.mark.parametrize("error", [KeyboardInterrupt, Unsimulated])
def test_a_refinement_that_fails_keeps_the_fit(vibration, monkeypatch, error):
    t, _, x = vibration
    guess = Cart(mass=1.0, stiffness=390.0, damping=2.5)
    trial = Trial(t, {"x": x}, sigma=1e-9, initial={"x": 1e-6, "x_dot": 0.0})
    whole, raised = fit(guess, trial, ("stiffness", "damping")), error.__new__(error)
    monkeypatch.setattr(search.Fit, "too_coarse", True)

    def failing(*arguments):
        raise raised

    monkeypatch.setattr(search, "finer", failing)
    found = fit(guess, trial, ("stiffness", "damping"))
    assert found.status == "unchecked"
    assert found.cost == pytest.approx(whole.cost, rel=1e-6)
    assert "check or the refinement of the steps of integration failed" in str(found)
    assert not found.ok


class Many(Track):
    """A place that fifty sensors measure."""

    def outputs(self, t, q, u, motion, now):
        return {f"sensor {i}": q["x"] for i in range(50)}


def assert_coverage(fits, truth):
    """Assert the share of all intervals of `fits` that contain the truth. The estimates of a fit are independent."""
    held = [low <= truth[name] <= high for one in fits for name, (low, high) in one.intervals().items()]
    low, high = coverage_band(len(held))
    print(np.mean(held))
    assert low <= np.mean(held) <= high


@pytest.mark.weekly
def test_interval_coverage_with_200000_residuals_and_a_close_initial_guess():
    # A fit that stops by a fraction of the cost does not move from the truth: its intervals would hold it in all sets.
    t, rng, truth = np.linspace(0.0, 4.0, 4001), np.random.default_rng(0), {"gain": 1.0, "drift": 0.3}
    push = np.sin(3.0 * t)
    exact = truth["gain"] * (t / 3 - np.sin(3.0 * t) / 9) + truth["drift"] * t**2 / 2
    draw = lambda: exact + rng.normal(size=(50, t.size))  # noqa: E731
    measured = {f"sensor {i}": y for i, y in enumerate(draw())}
    trial = Trial(t, measured, {"push": push}, sigma=1.0, initial={"x": 0.0, "x_dot": 0.0})
    problem = Problem.of(Many(drift=0.3), trial, FREE, simulation=Simulation(step=1e-3))
    hits, (low, high) = 0, coverage_band(SETS)
    for _ in range(SETS):
        windows = dataclasses.replace(problem.windows, measured=jnp.asarray(draw())[None])
        found = minimize(dataclasses.replace(problem, windows=windows), LeastSquares())
        assert found.status == "converged"
        errors = {name: found.estimates[name] - value for name, value in truth.items()}
        hits += sum(abs(errors[name]) <= 1.96 * found.standard_errors[name] for name in truth)
    print(hits / (2 * SETS))
    assert low <= hits / (2 * SETS) <= high


@pytest.mark.weekly
@pytest.mark.parametrize("factor", [0.01, 100.0], ids=lambda f: f"sigma {f}")
def test_interval_coverage_with_a_wrong_sigma(factor):
    from test_fit_steps import GUESS, NAMES, PUSH, SIGMA, exact, t

    rng, fits = np.random.default_rng(1), []
    for _ in range(SETS // 2):
        noisy = exact(400.0, 3.0) + SIGMA * rng.normal(size=t.size)
        trial = Trial(t, {"x": noisy}, {"push": PUSH}, sigma=factor * SIGMA, initial={"x": 0.1, "x_dot": 0.0})
        fits.append(fit(GUESS, trial, NAMES))
        assert fits[-1].ok, fits[-1].message
    assert_coverage(fits, {"stiffness": 400.0, "damping": 3.0})


@pytest.mark.weekly
@pytest.mark.parametrize("sigma", [1e-9, 1.0])
def test_intervals_of_micrometres(vibration, sigma):
    t, exact, _ = vibration
    rng, fits, guess = np.random.default_rng(2), [], Cart(mass=1.0, stiffness=390.0, damping=2.5)
    for _ in range(SETS // 2):
        trial = Trial(t, {"x": exact + 1e-9 * rng.normal(size=t.size)}, sigma=sigma, initial={"x": 1e-6, "x_dot": 0.0})
        fits.append(fit(guess, trial, ("stiffness", "damping")))
        assert fits[-1].ok, fits[-1].message
    assert_coverage(fits, {"stiffness": 400.0, "damping": 3.0})


@dataclasses.dataclass(frozen=True)
class Rejecting(Optimizer):
    """All of its steps are rejected."""

    steps: ClassVar[int] = 6
    horizons: Any = None
    name = "rejecting"

    def init(self, problem, point, at):
        return jnp.zeros(())

    def step(self, problem, now, i):
        return dataclasses.replace(now)


@pytest.mark.parametrize("better", [True, False])
def test_the_search_continues_from_the_better_of_two_iterates(monkeypatch, better):
    problem = Problem.of(Track(), TRIAL, FREE, **POSED)
    first = search._first(problem, Rejecting(), problem.start, 6)
    again = search._first(problem, LeastSquares(), minimize(problem, LeastSquares()).point, 6)
    other = again if better else dataclasses.replace(again, now=dataclasses.replace(again.now, cost=1e9))
    cost = first.now.cost
    monkeypatch.setattr(search, "_is_stiff", lambda problem, history: len(history) == 4)
    monkeypatch.setattr(search, "_first", lambda *arguments: other)
    assert search._search(problem, Rejecting(), first, problem.start, 6) == "steps"
    assert first.best.cost == (again.now.cost if better else cost)
    assert first.now.cost == first.best.cost


@pytest.mark.parametrize(
    ("lower", "upper", "nearest"), [(1.0, np.inf, 1.0), (-np.inf, 7.0, 7.0), (1.0, 7.0, 1.0), (1.0, 7.0, 7.0)]
)
def test_the_longest_step_towards_a_bound_leaves_a_twentieth_of_the_distance(lower, upper, nearest):
    start, bounded = 2.0, (bool(np.isfinite(lower)), bool(np.isfinite(upper)))
    interval = Interval(*map(jnp.asarray, (start, lower, upper, 0.3)), bounded)
    x = interval.longest_steps[0] * np.sign(nearest - start)
    value = float(interval(jnp.asarray([x]))[0])
    # Of the distances to both bounds, the ratio; of one bound, the distance.
    odds = lambda v: abs(v - nearest) / (abs(v - (lower + upper - nearest)) if all(bounded) else 1.0)  # noqa: E731
    assert odds(value) == pytest.approx(np.exp(-3.0) * odds(start))
    assert Interval(*map(jnp.asarray, (start, -np.inf, np.inf, 0.3)), (False, False)).longest_steps == np.inf
