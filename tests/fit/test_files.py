"""Fits in files, and as pandas, xarray and JSON; checkpoints, Ctrl-C; a `Problem` before a fit, a `Fit` after it."""

import json

import jax
import numpy as np
import optax
import pytest
from systems import POSED, PUSH, SEEN, TRIAL, Cart, Track
from systems import T as t

import jaxkane as jk
from jaxkane.fit import (
    GradientDescent,
    LeastSquares,
    Problem,
    Simulation,
    Trial,
    cross_validate,
    fit,
    identifiability,
    load,
    minimize,
    multi_start,
    profile,
    report,
)

SHORT = Trial(t[:8], {"x": np.where(t[:8] > 0.5, np.nan, SEEN[:8])}, {"push": PUSH[:8]}, sigma=0.1, name="short")
TRIALS, FREE = [TRIAL, SHORT], ["gain", "drift"]


def pose(system=None, trials=TRIALS, free=FREE, **options):
    return Problem.of(Track() if system is None else system, trials, free, **POSED | options)


@pytest.fixture(scope="module")
def result():
    return minimize(pose(), LeastSquares())


@pytest.fixture(scope="module")
def problem():
    return pose(trials=TRIAL)


@pytest.fixture
def path(result, tmp_path):
    assert result.save(tmp_path / "fits" / "a.npz") == tmp_path / "fits" / "a.npz"
    return tmp_path / "fits" / "a.npz"


# Files of fits.


def test_a_loaded_fit_equals_the_saved_fit(result, path):
    again = load(path, pose())
    assert str(again) == str(result)
    assert report(again).split("versions")[0] == report(result).split("versions")[0]
    assert (again.status, again.method, again.history) == (result.status, result.method, result.history)
    for name in ("covariance", "clustered_covariance", "correlation", "singular_values"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    assert again.intervals() == result.intervals()
    np.testing.assert_array_equal(again.problem.windows.step, result.problem.windows.step)
    # The search can be continued.
    assert minimize(again.problem, LeastSquares(), start=again.point).cost == pytest.approx(result.cost, rel=1e-9)


class Slow(Track):
    """Other physics under the same parameters."""

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force((self.gain * inputs["push"] + 0.9 * self.drift) * motion.N.x, motion["cart"]),)


class Rewritten(Track):
    """The same physics in other words."""

    def loads(self, t, q, u, motion, inputs):
        push, steady = self.gain * inputs["push"] * motion.N.x, self.drift * motion.N.x
        return (jk.Force(push, motion["cart"]), jk.Force(steady, motion["cart"]))


@pytest.mark.weekly
def test_a_fit_of_changed_code_is_loaded_only_if_its_cost_is_unchanged(result, path):
    for kind in (Slow, Rewritten):
        kind.__name__ = "Track"
    assert load(path, pose(Rewritten())).estimates == result.estimates
    changed = r"a.npz: the sum of squares is now .*, but was .* jax .* The code has changed"
    with pytest.raises(ValueError, match=changed):
        load(path, pose(Slow()))


@pytest.mark.weekly
def test_a_fit_of_another_problem_is_refused(path):
    for other, message in (
        (pose(free=["gain"]), r"free parameters \(gain, drift there, gain here\)"),
        (pose(trials=TRIALS[:1]), r"windows \(2 there, 1 here\)"),
        (pose(trials=[TRIALS[0], TRIALS[0]]), r"data \("),
        (pose(unknown=()), r"unknown starts \(x there, none here\)"),
        (pose(simulation=Simulation(step=0.05)), r"data \("),
        (pose(simulation=Simulation(rtol=1e-7)), r"rtol \("),
        (pose(Track(gain=2.0)), r"initial guesses, priors \("),
        (pose(noise={"x_dot": 0.1}), "process noise"),
    ):
        differs = rf"a.npz contains the fit of another problem, which differs in .*{message}"
        with pytest.raises(ValueError, match=differs):
            load(path, other)


def test_a_file_without_a_fit_is_rejected(path, tmp_path):
    problem, data, kept = pose(), path.read_bytes(), tmp_path / "checkpoint.npz"
    for damaged in (b"", bytes(500), data[:-40], b"thesis"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a.npz cannot be read as the state of a fit .*It is damaged"):
            load(path, problem)
    minimize(problem, LeastSquares(), steps=1, checkpoint=kept)
    with pytest.raises(ValueError, match=r"checkpoint.npz is the checkpoint of a fit"):
        load(kept, problem)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a.npz contains the state of another fit, which differs in"):
        minimize(problem, LeastSquares(), checkpoint=path)
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing.npz", problem)


# Checkpoints and Ctrl-C.


def after(n):
    """A callback that is stopped by Ctrl-C after n calls."""
    calls = []

    def callback(point, cost):
        calls.append(cost)
        if len(calls) > n:
            raise KeyboardInterrupt

    return callback


def interrupted(problem, path, method):
    assert minimize(problem, method, steps=5, checkpoint=path, callback=after(1)).status == "interrupted"
    return path


OPTIMIZERS = {
    "stateless": lambda rate=0.1: optax.sgd(rate),
    "momentum": lambda rate=0.1: optax.sgd(rate, momentum=0.5),
    "adam": lambda rate=0.1: optax.adam(rate),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_gradient_descent_is_resumed_only_with_the_same_optimizer(name, problem, tmp_path):
    path = interrupted(problem, tmp_path / "fit.npz", GradientDescent(OPTIMIZERS[name]()))
    others = [None, *(make() for other, make in OPTIMIZERS.items() if other != name)]
    for optimizer in (*others, *(make(0.2) for make in OPTIMIZERS.values())):
        with pytest.raises(ValueError, match=r"fit.npz contains the state of another fit, .* in optimizer \("):
            minimize(problem, GradientDescent(optimizer), steps=5, checkpoint=path)
    resumed = minimize(problem, GradientDescent(OPTIMIZERS[name]()), steps=5, checkpoint=path)
    whole = minimize(problem, GradientDescent(OPTIMIZERS[name]()), steps=5)
    assert resumed.history == pytest.approx(whole.history, rel=1e-12)


@pytest.mark.slow
def test_a_checkpoint_of_a_different_fit_is_rejected_with_the_differences(problem, tmp_path):
    path = interrupted(problem, tmp_path / "fit.npz", GradientDescent())
    before = path.read_bytes()
    for other, method, message in (
        (problem, LeastSquares(), r"method \(gradient descent there, Levenberg-Marquardt here\)"),
        (problem, GradientDescent(refresh=3), r"refresh \(10 there, 3 here\)"),
        (pose(trials=TRIAL, simulation=Simulation(rtol=1e-9)), GradientDescent(), r"rtol \("),
        (problem.with_priors({"gain": (1.0, 0.1)}), GradientDescent(), r"initial guesses, priors \("),
    ):
        with pytest.raises(ValueError, match=rf"fit.npz contains the state of another fit, .* in .*{message}"):
            minimize(other, method, checkpoint=path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("how", ["empty", "zeros", "cut", "text", "older"])
def test_an_unreadable_checkpoint_is_rejected(how, problem, tmp_path):
    path = interrupted(problem, tmp_path / "fit.npz", LeastSquares())
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "zeros": bytes(500), "cut": data[:-40], "text": b"thesis"}.get(how, data))
    if how == "older":
        np.savez(path, key=np.array("3f" * 32), damping=np.ones(()))
    unreadable = r"fit.npz cannot be read as the state of a fit .*Delete it, or choose another file"
    with pytest.raises(ValueError, match=unreadable):
        minimize(problem, LeastSquares(), checkpoint=path)
    assert [p.name for p in tmp_path.iterdir()] == ["fit.npz"]


def test_multi_start_stops_with_ctrl_c(problem):
    found = multi_start(problem, 4, callback=after(3), steps=20)
    assert [f.status for f in found.fits].count("interrupted") == 1
    assert len(found.fits) + found.untried == 4
    assert found.untried > 0
    assert f"Interrupted: {found.untried} more initial guesses were not tried" in str(found)


def test_a_profile_stops_with_ctrl_c(problem, monkeypatch):
    import jaxkane.fit.result.studies as module

    fit, search = minimize(problem, LeastSquares()), module.search
    stopped = lambda *args, **options: search(*args, **{**options, "callback": after(0)})  # noqa: E731
    monkeypatch.setattr(module, "search", stopped)
    with pytest.raises(KeyboardInterrupt):
        profile(fit, "gain")


def test_an_out_of_memory_error_is_raised(problem, monkeypatch):
    def exhausted(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")

    monkeypatch.setattr("jaxkane.fit.problem.problem.starts_of", exhausted)
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        problem.linearize(problem.start)


# Arguments.


def test_functions_reject_a_fit_for_a_problem_and_vice_versa(result):
    for ask in (identifiability, multi_start):
        with pytest.raises(TypeError, match=rf"{ask.__name__} requires a Problem, as in .*fit.problem"):
            ask(result)
    for ask in (cross_validate, lambda problem: profile(problem, "gain")):
        with pytest.raises(TypeError, match=r"requires a Fit, as in .*got Problem"):
            ask(result.problem)
    for optimizer in ("least_squares", LeastSquares):
        with pytest.raises(TypeError, match=r"`optimizer=` requires .*, as in LeastSquares\(\)"):
            minimize(result.problem, optimizer)
    with pytest.raises(TypeError, match=r"`simulation=` requires a Simulation, as in Simulation\(step=0.01\); got"):
        pose(simulation={"step": 0.1})
    seen = identifiability(result.problem, at=result.point)
    np.testing.assert_allclose(seen.singular_values, result.singular_values, rtol=1e-9)


@pytest.mark.weekly
def test_tolerances_of_optimizer_and_simulation_are_separate(result):
    coarse = minimize(pose(Track(gain=3.0)), LeastSquares(rtol=0.5, damping=3.0))
    assert coarse.status == "converged"
    assert coarse.cost > (1 + 1e-6) * result.cost
    options = {"optimizer": LeastSquares(rtol=1e-10), "simulation": Simulation(rtol=1e-9), "steps": 7}
    tight = fit(Track(), TRIALS, FREE, unknown=("x",), **options)
    assert tight.problem.model.settings.rtol == 1e-9
    assert tight.step_error < 1e-6


def test_true_values_are_given_by_name(result):
    assert "truth" in result.table({"gain": 1.0})
    assert "truth" in result.table(Track(gain=1.5))
    with pytest.raises(ValueError, match=r"truth.* gian; did you mean 'gain'\?"):
        result.table({"gian": 1.0})
    with pytest.raises(TypeError, match="a Track or a dict of values by name, got Cart"):
        report(result, Cart())


# Tables.


@pytest.mark.slow
def test_a_data_frame_of_the_estimates(result):
    frame = result.to_pandas(level=0.9)
    assert [*frame.columns] == ["unit", "start", "estimate", "error", "lower", "upper"]
    assert (frame.index.name, *frame.index) == ("parameter", "gain", "drift")
    assert frame.loc["gain", "estimate"] == result.estimates["gain"]
    assert frame.error.to_dict() == result.errors
    assert tuple(frame.loc["drift", ["lower", "upper"]]) == result.intervals(0.9)["drift"]


def test_a_data_set_of_the_residuals(result):
    pytest.importorskip("xarray")
    data = result.to_xarray()
    assert data.residual.dims == ("trial", "channel", "sample")
    short = data.sel(trial="short", channel="x")
    np.testing.assert_array_equal(short.residual[:8], result.residuals["short"]["x"])
    np.testing.assert_array_equal(short.fitted[:8], result.fitted["short"]["x"])
    np.testing.assert_array_equal(short.t[:8], SHORT.t)
    assert np.isnan(short.t[8:]).all()
    assert np.isnan(short.residual[8:]).all()
    np.testing.assert_allclose(data.residual, (data.fitted - data.measured) / data.sigma)


def test_costs_by_trial_and_channel_add_up(result):
    assert sum(result.costs[name]["x"] for name in ("trial", "short")) == pytest.approx(result.cost)


def test_json_contains_the_report_without_nan(result):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    parsed = json.loads(result.to_json(), parse_constant=refuse)
    assert parsed["parameters"]["gain"]["estimate"] == result.estimates["gain"]
    assert parsed["parameters"]["gain"]["standard_error"] == result.standard_errors["gain"]
    assert (parsed["status"], parsed["ok"], parsed["cost"]) == (result.status, result.ok, result.cost)
    assert parsed["tests"]["short"]["x"]["n"] == 6
    assert parsed["notes"] == [*result.notes]
    np.testing.assert_allclose(parsed["correlation"], result.correlation)


@pytest.mark.slow
def test_json_of_a_parameter_that_is_not_identifiable():
    parsed = json.loads(minimize(pose(trials=Trial(t, {"x": SEEN}, sigma=0.1)), LeastSquares()).to_json())
    assert parsed["held_out_cost"] is None
    assert parsed["parameters"]["gain"]["error"] == "Infinity"
    assert float(parsed["parameters"]["gain"]["lower"]) == -np.inf
