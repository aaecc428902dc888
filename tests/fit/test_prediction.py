"""Prediction errors some time ahead, and estimates that are compared: against closed forms."""

import dataclasses

import numpy as np
import pytest
from systems import Track
from test_files import result as result

from jaxkane.fit import LeastSquares, Problem, Simulation, Trial, compare_estimates, minimize, predict

DT, SIGMA, PAST, AHEAD = 0.1, 0.05, 1.0, (0.1, 0.5)
t = np.arange(0.0, 40.05, DT)


@pytest.fixture(scope="module")
def drifting():
    """No push, a drift of 0.2 m/s^2: x = 0.1 t^2 with white noise; and the fit of the first 2 s of it."""
    noise = SIGMA * np.random.default_rng(3).standard_normal(t.size)
    trial = Trial(t, {"x": 0.1 * t**2 + noise}, {"push": 0.0}, sigma=SIGMA)
    options = {"unknown": ("x", "x_dot"), "simulation": Simulation(step=DT)}
    result = minimize(Problem.of(Track(drift=0.2), trial.between(0.0, 2.0), ["drift"], **options), LeastSquares())
    point = dataclasses.replace(result.point, parameters=result.point.parameters * 0.0 + 0.2)
    return dataclasses.replace(result, point=point), trial


@pytest.mark.weekly
def test_prediction_errors_have_the_variance_of_a_linear_regression(drifting):
    """A line through the 11 samples of the past second, extrapolated; the mean square within four deviations."""
    result, trial = drifting
    errors = predict(result, trial, AHEAD, past=PAST)
    assert [*errors.columns] == ["trial", "channel", "ahead", "t", "measured", "predicted", "error", "residual"]
    X = np.column_stack([np.ones(11), DT * np.arange(-10, 1)])
    for ahead in AHEAD:
        rows = errors[errors.ahead == ahead]
        n = len(rows)
        assert n > 75
        x = np.array([1.0, ahead])
        expected = 1 + x @ np.linalg.solve(X.T @ X, x)  # in sigma^2
        assert np.mean(rows.residual**2) == pytest.approx(expected, rel=4 * np.sqrt(2 / n))
        np.testing.assert_allclose(rows.error, rows.predicted - rows.measured)
    np.testing.assert_allclose(np.diff(errors[errors.ahead == 0.5].t), 0.5, atol=1e-9)


def test_predictions_ignore_later_samples_and_omit_gaps(drifting):
    result, trial = drifting
    short = trial.between(0.0, 2.0)
    y = short.measured["x"].copy()
    before = predict(result, short, AHEAD, past=PAST)
    y[12:] = np.nan  # the first prediction starts at 1 s, and has its first sample at 1.1 s
    y[16:] = 1e3
    after = predict(result, Trial(short.t, {"x": y}, short.inputs, sigma=SIGMA), AHEAD, past=PAST)
    one = lambda frame: frame[(frame.t > 1.05) & (frame.t < 1.15)].predicted.item()  # noqa: E731
    assert one(after) == pytest.approx(one(before), rel=1e-9)
    assert not ((after.t > 1.15) & (after.t < 1.55)).any()


def test_predictions_start_at_the_measured_sample(drifting):
    """x + v h + drift h^2 / 2 from each sample, in closed form. A time without a sample is omitted."""
    result, trial = drifting
    short = trial.between(0.0, 2.0)
    v = 0.2 * short.t + 0.01 * np.cos(short.t)
    v[5] = np.nan
    both = Trial(short.t, {**short.measured, "x_dot": v}, short.inputs, sigma=SIGMA)
    errors = predict(result, both, AHEAD, start="measured")
    of_x = errors[errors.channel == "x"]
    for k in (0, 10, 15):
        for ahead, n in zip(AHEAD, (1, 5), strict=True):
            row = of_x[(of_x.ahead == ahead) & (np.abs(of_x.t - t[k + n]) < 0.01)]
            expected = short.measured["x"][k] + v[k] * ahead + result.estimates["drift"] * ahead**2 / 2
            assert row.predicted.item() == pytest.approx(expected, rel=1e-6)
    assert len(of_x) == 6  # the fourth start, at 0.5 s, has no sample of the speed
    with pytest.raises(ValueError, match="trial has no samples of x_dot"):
        predict(result, short, AHEAD, start="measured")
    with pytest.raises(ValueError, match="`past` has no effect"):
        predict(result, both, AHEAD, past=1.0, start="measured")
    with pytest.raises(ValueError, match="must be 'estimated' or 'measured', got 'now'"):
        predict(result, both, AHEAD, start="now")


@pytest.mark.weekly
def test_predictions_of_a_filter():
    exact = Trial(t[:61], {"x": 0.1 * t[:61] ** 2}, {"push": 0.0}, sigma=SIGMA)
    options = {"unknown": ("x", "x_dot"), "noise": {"x_dot": 1e-4}, "simulation": Simulation(step=DT)}
    result = minimize(Problem.of(Track(drift=0.2), exact, ["drift"], **options), LeastSquares(), steps=1)
    errors = predict(result, exact, 0.5, past=2.0)
    assert len(errors) == 8
    assert np.abs(errors.error).max() < 1e-3


@pytest.mark.parametrize(
    ("ahead", "past", "message"),
    [
        (0.0, 1.0, r"`ahead` \[s\] must be positive and finite, got"),
        ((0.1, np.nan), 1.0, r"`ahead` \[s\] must be positive and finite, got"),
        (0.01, 1.0, "`ahead` = 0.01 s is shorter than half of the sample interval of trial, 0.1 s"),
        (0.5, -1.0, "`past` must be positive"),
        (0.5, 100.0, "no trial is longer than 100 s for the initial state plus 0.5 s to predict"),
    ],
)
def test_invalid_arguments_of_a_prediction_are_rejected(ahead, past, message, drifting):
    with pytest.raises(ValueError, match=message):
        predict(*drifting, ahead, past=past)


def test_estimates_are_compared_in_standard_errors(result):
    frame = compare_estimates(result, {"gain": (1.0, 0.2), "weight": 3.0})
    assert [*frame.index] == ["gain"]
    value, error = result.estimates["gain"], result.errors["gain"]
    assert frame.z["gain"] == pytest.approx((value - 1.0) / np.hypot(error, 0.2))
    assert not compare_estimates(result, result).z.any()
    assert [*compare_estimates(result, result).other_error] == [*result.errors.values()]
    assert compare_estimates(result, {"drift": 0.0}).z["drift"] == result.estimates["drift"] / result.errors["drift"]
    with pytest.raises(ValueError, match="no common parameter; the fit has gain, drift"):
        compare_estimates(result, {"weight": 3.0})
    with pytest.raises(TypeError, match="compare_estimates requires a Fit"):
        compare_estimates(result.problem, result)
