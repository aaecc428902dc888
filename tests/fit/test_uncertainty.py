"""How far a fit can be trusted: errors, profiles, densities, trials left out, what looks wrong, and the report."""

import html.parser
import types

import browser
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import POSED, PUSH, TRIAL, Cart, Track, of_x
from systems import T as SAMPLED
from test_transcriptions import GUESS, TRUTH, record

import jaxkane as jk
from jaxkane.fit import (
    Fit,
    Free,
    LeastSquares,
    Problem,
    Simulation,
    Trial,
    bootstrap,
    check_signs,
    cross_validate,
    fit,
    identifiability,
    minimize,
    multi_start,
    profile,
    report,
    save_report,
    validate,
)
from jaxkane.fit.result.data import html_table, html_text
from jaxkane.fit.result.statistics import residual_test
from jaxkane.fit.result.studies import MultiStart

NAMES = ("mass", "stiffness", "damping")
T = np.arange(0.0, 4.0, 0.1)
UNKNOWN = {"unknown": ("x", "x_dot")}


@pytest.fixture(scope="module")
def trials():
    return [record(T, seed) for seed in range(6)]


@pytest.fixture(scope="module")
def problem(trials):
    return Problem.of(GUESS, trials, NAMES, **UNKNOWN)


@pytest.fixture(scope="module")
def result(problem) -> Fit:
    return minimize(problem, LeastSquares())


@pytest.mark.weekly
def test_interval_coverage_near_a_bound():
    """They are those of a fit without the bound, and end there."""
    rng, hits, clipped = np.random.default_rng(5), 0, 0
    for _ in range(40):
        noisy = Trial(SAMPLED, {"x": rng.normal(0.0, 0.005, SAMPLED.size)}, {"push": PUSH}, sigma=0.005)
        free, bounded = (
            minimize(Problem.of(Track(), noisy, [gain, "drift"], **POSED), LeastSquares())
            for gain in ("gain", Free("gain", bounds=(-0.05, 5.0)))  # it is 0
        )
        low, high = bounded.intervals()["gain"]
        hits += low <= 0.0 <= high
        if free.estimates["gain"] > -0.04:
            clipped += low == -0.05
            np.testing.assert_allclose((low, high), np.clip(free.intervals()["gain"], -0.05, 5.0), atol=0.002)
        elif not np.isfinite(bounded.errors["gain"]):
            assert (low, high) == (-0.05, 5.0)
    assert hits >= 35  # of 38 that are expected
    assert clipped > 5


@pytest.mark.slow
def test_white_residuals_pass_the_whiteness_tests(result):
    tests = [t["x"] for t in result.tests.values()]
    assert sum(t.is_white for t in tests) >= 5
    assert result.variance_accounted_for["x"] > 0.99
    assert result.autocorrelation == 0.0
    assert not any("noise" in note for note in result.notes)


def test_correlated_residuals_fail_the_whiteness_tests():
    rng = np.random.default_rng(0)
    t = np.arange(300.0)
    white = rng.normal(size=t.size)
    walk = np.convolve(white, np.ones(8) / 8, mode="same")
    assert residual_test(t, t + white, white).is_white
    coloured = residual_test(t, t + walk, walk)
    assert coloured.ljung_box < 1e-6
    assert coloured.runs < 1e-6
    assert coloured.autocorrelation > 0.7
    assert residual_test(t, t, np.full(300, np.nan)).n == 0


@pytest.mark.slow
def test_clustered_errors_include_variation_between_trials(result):
    # Every trial has its own stiffness: that is no noise of samples, and the formal error does not know it.
    rng = np.random.default_rng(5)
    varied = [
        record(T, seed, system=Cart(mass=1.3, stiffness=5.0 * np.exp(rng.normal(0.0, 0.05)), damping=0.4))
        for seed in range(6)
    ]
    found = minimize(Problem.of(GUESS, varied, NAMES, **UNKNOWN), LeastSquares())
    assert found.uses_clustered_errors
    assert found.clustered_errors["stiffness"] > 2.0 * found.standard_errors["stiffness"] / np.sqrt(found.variance)
    assert 0.3 < result.clustered_errors["stiffness"] / result.standard_errors["stiffness"] < 3.0
    assert any("not white noise" in note for note in found.notes)


def test_the_profile_interval_of_a_nearly_linear_problem(result):
    likelihood = profile(result, "stiffness", n=7)
    low, high = result.intervals()["stiffness"]
    width = high - low
    assert likelihood.interval == pytest.approx((low, high), abs=0.1 * width)
    assert likelihood.costs.min() == pytest.approx(result.cost, rel=1e-4)
    with pytest.raises(ValueError, match="no free parameter gravity; the free parameters are"):
        profile(result, "gravity")


@pytest.mark.slow
def test_the_profile_of_an_estimate_near_a_bound_has_both_ends():
    """The bound is a tenth of a standard error below the estimate. The cost is a parabola, so the other end is that of
    the interval."""
    free = fit(Track(), TRIAL, ("gain", "drift"), **POSED)
    error, upper = free.standard_errors["drift"], free.intervals()["drift"][1]
    bound = free.estimates["drift"] - 0.1 * error
    near = fit(Track(), TRIAL, ("gain", Free("drift", start=bound + error, bounds=(bound, None))), **POSED)
    assert profile(near, "drift", n=5).interval == pytest.approx((bound, upper), abs=1e-2 * error)


def test_studies_of_a_fit_that_has_not_converged_are_refused(problem):
    ended = minimize(problem, LeastSquares(), steps=0)
    assert ended.notes[0].startswith("The fit has not converged (stopped after the last step")
    for study in (lambda: profile(ended, "mass"), lambda: bootstrap(ended), ended.laplace):
        with pytest.raises(ValueError, match="The fit has not converged"):
            study()


def test_a_start_from_a_problem_with_other_initial_guesses_is_refused(trials, problem, result):
    """Of the same shape."""
    other = Problem.of(TRUTH, trials, NAMES, **UNKNOWN)
    with pytest.raises(ValueError, match="`start` belongs to another problem, with other names, initial guesses"):
        minimize(other, LeastSquares(), start=result.point)
    again = minimize(problem, LeastSquares(), start=problem.at(result.estimates, result.point))
    assert again.cost == pytest.approx(result.cost, rel=1e-6)


def test_residuals_are_not_written_to(result):
    for series in (result.residuals, result.fitted):
        with pytest.raises(ValueError, match="read-only"):
            next(iter(series.values()))["x"][:] = 0.0


def test_validation_keeps_the_parameters_fixed(result):
    others = [record(T, seed) for seed in range(20, 26)]
    held = validate(result, others)
    assert held.status == "validated"
    assert held.estimates == result.estimates
    # What is left is noise: the parameters were found elsewhere, only starts were found here.
    n, unknown = held.problem.size
    assert held.cost == pytest.approx(n - unknown, rel=0.25)
    assert held.history == (held.cost,)
    assert "not fitted" in str(held)


def test_multi_start_converges_to_one_minimum(problem, result):
    found = multi_start(problem, 4, candidates=8, spread=0.6, seed=1)
    assert len(found.fits) == found.agreeing == 4
    assert found.best.cost == pytest.approx(result.cost, rel=1e-4)
    assert all(spread < 0.1 * result.standard_errors[name] for name, spread in found.spread.items())
    assert "4 of 4 initial guesses end at the best" in str(found)


def test_agreeing_fits_are_counted_by_the_variance_of_a_residual():
    """Of 1e5 residuals, 0.1 % of the cost is a parameter ten standard errors away."""

    def found(cost):
        at = types.SimpleNamespace(squares=1e5)
        return types.SimpleNamespace(cost=1e5 + cost, variance=1.0, linearization=at, names=())

    several = MultiStart(tuple(map(found, (0.0, 0.2, 0.3, 81.0))), ({},) * 4, ())
    assert several.agreeing == 2


@pytest.mark.weekly
def test_the_log_density_is_minus_half_the_cost(problem, result):
    density = of_x(problem)
    both, there = jax.jit(jax.value_and_grad(density)), result.point
    assert float(both(there)[0]) == pytest.approx(-result.cost / 2, rel=1e-9)
    rng = np.random.default_rng(3)
    step = jax.tree.map(lambda x: jnp.asarray(rng.normal(0.0, 1e-4, x.shape)), there)
    away = jax.tree.map(lambda x, d: x + 30 * d, there, step)
    moved = [jax.tree.map(lambda x, d, s=s: x + s * d, away, step) for s in (-1.0, 1.0)]
    difference = float(both(moved[1])[0] - both(moved[0])[0]) / 2
    forward = float(jax.jit(lambda x: jax.jvp(density, (x,), (step,))[1])(away))
    here, backward = both(away)
    along = sum(float(jnp.sum(g * d)) for g, d in zip(jax.tree.leaves(backward), jax.tree.leaves(step), strict=True))
    assert forward == pytest.approx(difference, rel=1e-5)
    assert along == pytest.approx(forward, rel=1e-9)
    over_values = problem.log_density()
    extra = float(over_values(away) - here)
    assert extra == pytest.approx(float(problem.parameters.log_determinant(away.parameters)), abs=1e-9)


@pytest.mark.weekly
def test_a_sampler_agrees_with_the_laplace_approximation():
    blackjax = pytest.importorskip("blackjax")
    begun = record(T, 0, initial={"x": 0.2, "x_dot": 0.0})
    mode = minimize(Problem.of(GUESS, begun, ("mass", "stiffness"), simulation=Simulation(step=0.1)), LeastSquares())
    density, (first, second) = jax.jit(of_x(mode.problem)), jax.random.split(jax.random.key(0))
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        warm, _ = blackjax.window_adaptation(blackjax.nuts, density).run(first, mode.point, num_steps=150)
        kernel = blackjax.nuts(density, **warm.parameters)
        step = lambda state, key: (kernel.step(key, state)[0],) * 2  # noqa: E731
        run = jax.jit(lambda keys: jax.lax.scan(step, warm.state, keys)[1])
        x = run(jax.random.split(second, 400)).position.parameters
    approximation = mode.laplace()
    deviation = np.sqrt(approximation.covariance.diagonal())
    np.testing.assert_allclose(np.mean(np.asarray(x), axis=0), approximation.mean, atol=0.3 * deviation.min())
    np.testing.assert_allclose(np.std(np.asarray(x), axis=0), deviation, rtol=0.25)


def test_priors_are_weighted_and_reported(problem, result):
    told = minimize(problem.with_priors({"mass": (1.0, 1e-4), "other": (0.0, 1.0)}), LeastSquares(), start=result.point)
    assert told.estimates["mass"] == pytest.approx(1.0, abs=5e-4)
    # A prior is a measurement of its own, of the deviation that it was given, however large residuals are.
    assert told.variance > 4
    for error in (
        told.standard_errors["mass"],
        told.clustered_errors["mass"],
        np.std(told.laplace().sample(4000)["mass"]),
    ):
        assert error == pytest.approx(1e-4, rel=0.05)
    assert any("mass is determined by its prior alone" in note for note in told.notes)


# Suspicious data, each reported by name.


@pytest.mark.weekly
def test_a_wrong_sign_of_an_input_is_reported(trials):
    wrong = [Trial(t.t, t.measured, {"push": -t.inputs["push"]}, sigma=0.01, name=t.name) for t in trials]
    # With the mass free, an infinite one takes the wrong push out of the model.
    found = minimize(Problem.of(GUESS, wrong, ("stiffness", "damping"), **UNKNOWN), LeastSquares())
    assert "`jaxkane.fit.check_signs(fit)` tests whether a sign is wrong" in str(found)
    (note,) = [note for note in check_signs(found) if "input" in note]
    assert "the input push seems to have the wrong sign" in note
    assert note in report(found)


class Twice(Cart):
    """Springs and dampers that act together."""

    more_stiffness: jk.Scalar = jk.parameter(2.0, positive=True, unit="N/m")
    more_damping: jk.Scalar = jk.parameter(0.1, unit="N s/m")

    def loads(self, t, q, u, motion, inputs):
        force = -self.more_stiffness * q["x"] - self.more_damping * u["x_dot"]
        return (*super().loads(t, q, u, motion, inputs), jk.Force(force * motion.N.x, motion["cart"]))


@pytest.mark.weekly
def test_undetermined_directions_are_reported_in_the_simplest_form(trials):
    free = ("stiffness", "more_damping", "damping", "more_stiffness")
    seen = identifiability(Problem.of(Twice(), trials, free, **UNKNOWN))
    assert seen.rank == 2
    assert seen.rank_message == "The data determine 2 combinations of the 4 parameters."
    pairs = {frozenset(name for name, _ in direction.parts) for direction in seen.undetermined}
    assert pairs == {frozenset({"stiffness", "more_stiffness"}), frozenset({"damping", "more_damping"})}
    for direction in seen.undetermined:  # as much of the one as less of the other
        (one, a), (other, b) = direction.parts
        assert a * seen.scales[seen.names.index(one)] == pytest.approx(-b * seen.scales[seen.names.index(other)])
    assert seen.rank_message in str(seen)
    assert "N/m" in str(seen)


# The report.


class _Page(html.parser.HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.open, self.kinds, self.outside = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.kinds[tag] = self.kinds.get(tag, 0) + 1
        places = [v for k, v in attrs if k in ("src", "href", "xlink:href")]
        self.outside += [v for v in places if not v.startswith(("#", "data:"))]


def test_the_report_is_one_complete_page(result, tmp_path):
    left_out, likelihood = cross_validate(result, folds=2), profile(result, "mass", n=3)
    with pytest.raises(TypeError, match="`cross_validation=` requires a CrossValidation"):
        save_report(result, tmp_path / "none.html", cross_validation="yes")
    path = save_report(
        result, tmp_path / "a" / "report.html", truth=TRUTH, cross_validation=left_out, profiles=[likelihood], trials=2
    )
    text = path.read_text()
    page = _Page(text)
    assert page.kinds["svg"] >= 5
    assert text.count('<figure role="img" aria-label="') == page.kinds["figure"]
    assert not page.outside
    assert "Held-out score" in text
    for words in (*NAMES, "Ljung-Box", "variance accounted for", "correlation", "singular value", "jax 0", "run 3"):
        assert words in text, words
    assert 'data-label="95 % interval"' in text
    assert "`" not in text
    told = report(result, TRUTH)
    assert "95 % interval" in told
    assert "truth" in told
    row = str(result).splitlines()[2].split()  # of the mass
    low, high = result.intervals()["mass"]
    assert row[-5:] == [f"{result.errors['mass']:.2g}", f"{low:.4g}", "to", f"{high:.4g}", "trial"]


def test_text_of_a_report_marks_code_and_escapes():
    assert html_text("cut it with `Trial.between`, if a < b") == "cut it with <code>Trial.between</code>, if a &lt; b"
    table = html_table([("name", '"x"'), ("`a`", "1 & 2")], left=(1,))
    assert '<td data-label="name"><code>a</code></td>' in table
    assert '<td style="text-align: left" data-label="&quot;x&quot;">1 &amp; 2</td>' in table


@pytest.mark.weekly
@pytest.mark.skipif(browser.PROGRAM is None, reason=browser.WHY_NOT)
def test_a_narrow_report_shows_all_columns_of_the_estimates(result, tmp_path):
    path = save_report(result, tmp_path / "report.html", truth=TRUTH)
    with browser.Page(tmp_path / "browser", 390, 844) as page:
        page.show(path)
        assert page.value("document.documentElement.scrollWidth") == 390
        cells = "[...document.querySelectorAll('.stacked td')].map(cell => cell.getBoundingClientRect().right)"
        assert page.value(f"Math.max(...{cells})") <= 390


@pytest.mark.slow
@pytest.mark.parametrize("fitted", [False, True])
def test_a_parameter_is_undetermined_if_its_error_exceeds_half_the_scale(fitted):
    """A parameter is determined if its standard deviation is less than half of the larger of scale and estimate. Here
    the data are noise, and the estimate is smaller than its deviation."""
    noise = np.random.default_rng(1).normal(0.0, 0.3, len(SAMPLED))
    trial = Trial(SAMPLED, {"x": noise}, {"push": PUSH}, sigma=0.3)

    def seen(scale):
        problem = Problem.of(Track(), trial, [Free("gain", start=1e-3, scale=scale)], **POSED)
        return minimize(problem, LeastSquares()).identifiability if fitted else identifiability(problem)

    error = np.sqrt(seen(1.0).covariance[0, 0])
    assert not seen(error / 0.7).ok
    assert seen(error / 0.3).ok


def test_a_wrong_sign_of_a_parameter_is_reported():
    trials = [Trial(SAMPLED, {"x": 0.3 * PUSH}, {"push": PUSH}, sigma=0.001)]
    problem = Problem.of(Track(gain=-20.0), trials, ["gain"], **POSED)
    (note,) = check_signs(minimize(problem, LeastSquares(), steps=0))[-1:]
    assert note.startswith("the parameter gain seems to have the wrong sign")
