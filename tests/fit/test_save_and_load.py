"""Fits in files; and one way of saying things: a `Problem` before a fit, a `Fit` after it, options where they go."""

import numpy as np
import pytest
from systems import PUSH, SEEN, Cart, Track
from systems import T as t

import jaxkane as jk
from jaxkane.fit import (
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

TRIALS = [Trial(t, {"x": SEEN + 0.01 * k}, {"push": PUSH}, sigma=0.1, initial={"x_dot": 0.0}) for k in (0, 1)]
FREE = ["gain", "drift"]


def pose(system=None, trials=TRIALS, free=FREE, unknown=("x",), **options):
    return Problem.of(Track() if system is None else system, trials, free, unknown=unknown, **options)


@pytest.fixture(scope="module")
def result():
    return fit(Track(), TRIALS, FREE, unknown=("x",), optimizer=LeastSquares())


@pytest.fixture
def path(result, tmp_path):
    assert result.save(tmp_path / "fits" / "a.npz") == tmp_path / "fits" / "a.npz"
    return tmp_path / "fits" / "a.npz"


def test_a_loaded_fit_equals_the_saved_fit(result, path):
    again = load(path, pose())
    assert str(again) == str(result)
    assert report(again).split("versions")[0] == report(result).split("versions")[0]
    assert (again.status, again.method, again.history) == (result.status, result.method, result.history)
    for name in ("covariance", "clustered_covariance", "correlation", "singular_values"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    assert again.intervals() == result.intervals()
    assert again.step_error == result.step_error > 0
    np.testing.assert_array_equal(again.problem.windows.step, result.problem.windows.step)
    # One can go on with it.
    assert minimize(again.problem, LeastSquares(), start=again.point).cost == pytest.approx(result.cost, rel=1e-9)


@pytest.mark.slow
def test_printing_a_loaded_fit_does_not_simulate(path, monkeypatch):
    from jaxkane.fit.problem import problem

    again = load(path, pose())

    def refuse(*arguments):
        raise AssertionError("a fit that is looked at was simulated")

    for name in ("starts_of", "blocks_of", "trajectories_of"):
        monkeypatch.setattr(problem, name, refuse)
    assert repr(again) == str(again)
    assert again.ok is again.identifiability.ok
    assert again.message
    assert again.notes
    assert again.tests
    assert again.variance_accounted_for
    with pytest.raises(AssertionError, match="was simulated"):
        again.trajectories()


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
    with pytest.raises(
        ValueError, match=r"a.npz: the sum of squares is now .*, but was .* jax .* The code has changed"
    ):
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
    ):
        with pytest.raises(
            ValueError, match=rf"a.npz contains the fit of another problem, which differs in .*{message}"
        ):
            load(path, other)


def test_a_file_without_a_fit_is_rejected(path, tmp_path):
    problem, data = pose(), path.read_bytes()
    for damaged in (b"", bytes(500), data[:-40], b"thesis"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a.npz cannot be read as the state of a fit .*It is damaged"):
            load(path, problem)
    kept = tmp_path / "checkpoint.npz"
    minimize(problem, LeastSquares(), steps=1, checkpoint=kept)
    with pytest.raises(ValueError, match=r"checkpoint.npz is the checkpoint of a fit"):
        load(kept, problem)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a.npz contains the state of another fit, which differs in"):
        minimize(problem, LeastSquares(), checkpoint=path)
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing.npz", problem)


def test_functions_reject_a_fit_for_a_problem_and_vice_versa(result):
    for ask in (identifiability, multi_start):
        with pytest.raises(TypeError, match=rf"{ask.__name__} requires a Problem, as in .*fit.problem"):
            ask(result)
    for ask in (cross_validate, lambda problem: profile(problem, "gain")):
        with pytest.raises(TypeError, match=r"requires a Fit, as in .*got Problem"):
            ask(result.problem)
    seen = identifiability(result.problem, at=result.point)
    np.testing.assert_allclose(seen.singular_values, result.singular_values, rtol=1e-9)


@pytest.mark.weekly
def test_tolerances_of_optimizer_and_simulation_are_separate(result):
    coarse = fit(Track(gain=3.0), TRIALS, FREE, unknown=("x",), optimizer=LeastSquares(rtol=0.5, damping=3.0))
    assert coarse.status == "converged"
    assert coarse.cost > (1 + 1e-6) * result.cost
    tight = fit(
        Track(),
        TRIALS,
        FREE,
        unknown=("x",),
        optimizer=LeastSquares(rtol=1e-10),
        simulation=Simulation(rtol=1e-9),
        steps=7,
    )
    assert tight.problem.model.settings.rtol == 1e-9
    for optimizer in ("least_squares", LeastSquares):
        with pytest.raises(
            TypeError, match=r"`optimizer` must be an optimizer such as LeastSquares\(\) or GradientDescent\(\), got"
        ):
            minimize(result.problem, optimizer)
    with pytest.raises(
        TypeError, match=r"`simulation=` requires a Simulation, as in Simulation\(step=0.01\); got dict"
    ):
        pose(simulation={"step": 0.1})
    assert tight.step_error < 1e-6  # with tolerances too


def test_true_values_are_given_by_name(result):
    assert "truth" in result.table({"gain": 1.0})
    assert "truth" in result.table(Track(gain=1.5))
    with pytest.raises(ValueError, match=r"truth.* gian; did you mean 'gain'\?"):
        result.table({"gian": 1.0})
    with pytest.raises(TypeError, match="a Track or a dict of values by name, got Cart"):
        report(result, Cart())
