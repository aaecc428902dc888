"""A fit as pandas, xarray and JSON: the same numbers as its attributes."""

import json

import numpy as np
import pytest
from systems import POSED, PUSH, SEEN, TRIAL, Track
from systems import T as t

from jaxkane.fit import LeastSquares, Problem, Trial, minimize

SHORT = Trial(t[:8], {"x": np.where(t[:8] > 0.5, np.nan, SEEN[:8])}, {"push": PUSH[:8]}, sigma=0.1, name="short")


@pytest.fixture(scope="module")
def fit():
    return minimize(Problem.of(Track(), [TRIAL, SHORT], ["gain", "drift"], **POSED), LeastSquares())


@pytest.mark.slow
def test_a_data_frame_of_the_estimates(fit):
    frame = fit.to_pandas(level=0.9)
    assert [*frame.columns] == ["unit", "start", "estimate", "error", "lower", "upper"]
    assert (frame.index.name, *frame.index) == ("parameter", "gain", "drift")
    assert frame.loc["gain", "estimate"] == fit.estimates["gain"]
    assert frame.error.to_dict() == fit.errors
    assert tuple(frame.loc["drift", ["lower", "upper"]]) == fit.intervals(0.9)["drift"]


def test_a_data_set_of_the_residuals(fit):
    pytest.importorskip("xarray")
    data = fit.to_xarray()
    assert data.residual.dims == ("trial", "channel", "sample")
    short = data.sel(trial="short", channel="x")
    np.testing.assert_array_equal(short.residual[:8], fit.residuals["short"]["x"])
    np.testing.assert_array_equal(short.fitted[:8], fit.fitted["short"]["x"])
    np.testing.assert_array_equal(short.t[:8], SHORT.t)
    assert np.isnan(short.t[8:]).all()
    assert np.isnan(short.residual[8:]).all()
    np.testing.assert_allclose(data.residual, (data.fitted - data.measured) / data.sigma)


def test_costs_by_trial_and_channel_add_up(fit):
    assert sum(fit.costs[name]["x"] for name in ("trial", "short")) == pytest.approx(fit.cost)


def test_json_contains_the_report_without_nan(fit):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    told = json.loads(fit.to_json(), parse_constant=refuse)
    assert told["parameters"]["gain"]["estimate"] == fit.estimates["gain"]
    assert told["parameters"]["gain"]["standard_error"] == fit.standard_errors["gain"]
    assert (told["status"], told["ok"], told["cost"]) == (fit.status, fit.ok, fit.cost)
    assert told["tests"]["short"]["x"]["n"] == 6
    assert told["notes"] == [*fit.notes]
    np.testing.assert_allclose(told["correlation"], fit.correlation)


@pytest.mark.slow
def test_json_of_a_parameter_that_is_not_identifiable(fit):
    still = Trial(t, {"x": SEEN}, sigma=0.1)
    told = json.loads(minimize(Problem.of(Track(), still, ["gain", "drift"], **POSED), LeastSquares()).to_json())
    assert told["held_out_cost"] is None
    assert told["parameters"]["gain"]["error"] == "Infinity"
    assert float(told["parameters"]["gain"]["lower"]) == -np.inf
