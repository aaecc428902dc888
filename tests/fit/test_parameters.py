"""Free parameters: entries of vectors, what is tied, bounds, scales, priors; each contradiction is one clear error."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import t as student
from systems import POSED, TRIAL, Track

import jaxkane as jk
from jaxkane.fit import (
    Delay,
    Free,
    Gain,
    Huber,
    LeastSquares,
    NoiseScale,
    Offset,
    Problem,
    SpectralDensity,
    Trial,
    bootstrap,
    cross_validate,
    fit,
    minimize,
    profile,
)
from jaxkane.fit.problem.parameters import Interval, log_gaussian_mass
from jaxkane.fit.problem.specification import parameters_of
from jaxkane.fit.result.diagnostics import plausible_of


class Springs(eqx.Module):
    """Parameters alone."""

    others: jk.Scalar = jk.parameter(positive=True)  # [N/m], three of them
    matrix: jk.Scalar = jk.parameter()  # [N/m]
    stiffness: jk.Scalar = jk.parameter(4.0, positive=True)  # [N/m]
    tilt: jk.Scalar = jk.parameter(0.5, within=(-1.5, 1.5))  # [rad]
    grip: jk.Scalar = jk.parameter(1.0, positive=True, within=(-1.0, 2.0))
    dry: jk.Scalar = jk.parameter(0.0, within=(0.0, np.inf))  # [N]
    offset: jk.Scalar = jk.parameter(0.0)  # [m]
    inputs = ("push",)


SYSTEM = Springs(others=jnp.array([1.0, 2.0, 3.0]), matrix=jnp.zeros((2, 2)))


@pytest.mark.slow
def test_a_tied_vector_follows_in_all_entries():
    free = Free("stiffness", tied={"others": 0.5, "matrix": -2.0})
    parameters = parameters_of(SYSTEM, free)
    system, _ = parameters.apply(SYSTEM, parameters.inverse(jnp.array([8.0])))
    np.testing.assert_allclose(system.others, [4.0, 4.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(system.matrix, np.full((2, 2), -16.0), rtol=1e-12)


def test_each_entry_of_a_free_vector_is_a_parameter():
    parameters = parameters_of(SYSTEM, (Free("others", prior=(2.0, 0.5)), "stiffness"))
    assert parameters.names == ("others[0]", "others[1]", "others[2]", "stiffness")
    system, _ = parameters.apply(SYSTEM, parameters.inverse(jnp.array([3.0, 2.0, 1.0, 7.0])))
    np.testing.assert_allclose(system.others, [3.0, 2.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(parameters.prior_residuals(jnp.zeros(4)), [-2.0, 0.0, 2.0, 0.0], atol=1e-12)
    one = parameters.with_priors({"others[1]": (1.0, 0.1)})
    assert float(one.prior_residuals(jnp.zeros(4))[1]) == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (("stiffness", Free("offset", tied={"stiffness": 1.0})), "sets offset, stiffness more than once"),
        (Free("stiffness", tied={"stiffness": 2.0}), "sets stiffness more than once"),
        ((Free("offset", tied={"others": 1.0}), "others"), "more than once"),
        ((Free("stiffness", name="k"), Free("offset", name="k")), "sets k more than once"),
        ((Gain("push"), Gain("push", name="another")), "sets another, gain of push more than once"),
        (Free("others", tied={"stiffness": 1.0}), "has several entries, and other parameters can be tied"),
        (Free("offset", tied={"others": -1.0}), "factor of others must be positive, as the parameter is declared"),
        (Free("offset", tied={"matrix": float("nan")}), "factor of matrix must be a finite number"),
        (Free("offset", tied={"missing": 1.0}), "has no parameter 'missing'"),
        (Free("stiffness", bounds=(5.0, 3.0)), r"stiffness: .* upper bound, got bounds=\(5.0, 3.0\)"),
        (Free("stiffness", bounds=(float("nan"), 3.0)), "stiffness: the lower bound must be less"),
        (Free("stiffness", bounds=(4.5, 6.0)), r"stiffness: the initial guess 4 is not inside its bounds"),
        (Free("stiffness", start=-1.0), "stiffness: the initial guess -1 is not inside its bounds"),
        (Free("stiffness", scale=float("inf")), "`scale` must be positive"),
        (Free("stiffness", scale=0.0), "`scale` must be positive"),
        (Free("stiffness", prior=(4.0, -1.0)), "`prior` must be"),
        (Free("stiffness", prior=(float("nan"), 1.0)), "`prior` must be"),
        (Free("stiffness", prior=4.0), "`prior` must be"),
    ],
)
def test_contradictory_free_parameters_are_rejected(free, message):
    with pytest.raises(ValueError, match=message):
        parameters_of(SYSTEM, free)


def test_infinite_bounds_equal_no_bounds():
    for bounds, bounded in (((0.0, np.inf), (True, False)), ((-np.inf, np.inf), (False, False))):
        parameters = parameters_of(SYSTEM, Free("stiffness", bounds=bounds))
        assert parameters.bijections[0].bounded == bounded
        assert float(parameters.values(jnp.array([0.5]))[0]) > 4.0


def test_default_scale_of_a_parameter():
    scale = lambda *free: parameters_of(SYSTEM, free).scale.tolist()  # noqa: E731
    assert scale("stiffness", "offset") == [4.0, 1.0]
    assert scale(Free("offset", prior=(0.0, 0.01))) == [0.01]
    assert scale(Free("offset", prior=(0.0, 0.01), scale=0.5)) == [0.5]


def test_priors_integrate_to_one():
    # exp(constant - residual^2 / 2) over what lies between the bounds, by the trapezoidal rule.
    for bounds, mean, deviation in (((None, None), 1.0, 0.3), ((0.0, None), -0.4, 0.5), ((-1.0, 2.0), 8.0, 2.0)):
        lower, upper = (x if x is not None else end for x, end in zip(bounds, (-6.0, 6.0), strict=True))
        start = jnp.asarray(0.5 * (lower + min(upper, 1.0)))
        ends = [jnp.asarray(end if x is None else x) for x, end in zip(bounds, (-np.inf, np.inf), strict=True)]
        interval = Interval(start, *ends, jnp.ones(()), bounded=tuple(x is not None for x in bounds))
        constant = interval.log_prior_constants(np.array([mean]), np.array([deviation]))[0]
        values = np.linspace(lower, upper, 20001)
        density = np.exp(constant - 0.5 * ((values - mean) / deviation) ** 2)
        assert np.trapezoid(density, values) == pytest.approx(1.0, abs=1e-6)
    # Far from the mean neither side cancels.
    assert log_gaussian_mass(30.0, 31.0) == pytest.approx(log_gaussian_mass(-31.0, -30.0), rel=1e-12)
    assert np.isfinite(log_gaussian_mass(30.0, np.inf))


@pytest.mark.parametrize(("bounds", "begins"), [((0.0, None), 0.05), ((None, 0.0), -0.05), ((0.0, 0.2), 0.02)])
def test_an_initial_guess_at_a_given_bound_is_moved_inside(bounds, begins):
    parameters = parameters_of(SYSTEM, Free("offset", bounds=bounds, scale=0.5))
    assert float(parameters.start[0]) == 0.0
    assert float(parameters.values(jnp.zeros(1))[0]) == pytest.approx(begins)


def test_plausible_ranges_do_not_depend_on_initial_guesses():
    free = (
        "gain",
        SpectralDensity("x_dot"),
        NoiseScale("x", bounds=(0.1, 10.0)),
        SpectralDensity("push", prior=(1.0, 0.1)),
    )
    parameters = parameters_of(Track(), free, {"x_dot": 0.2, "push": 1.0}, ("x",))
    assert {*plausible_of(parameters, {})} == {"noise scale of x", "spectral density of push"}
    assert plausible_of(parameters, {"spectral density of x_dot": (0.1, 0.3)})["spectral density of x_dot"] == (
        0.1,
        0.3,
    )


@pytest.mark.slow
def test_drift_with_initial_guess_at_its_bound_is_estimated():
    rtol = 1e-4
    free, bounded = (fit(Track(), TRIAL, ["gain", drift], optimizer=LeastSquares(rtol=1e-12), **POSED)
                     for drift in ("drift", Free("drift", bounds=(0.0, None))))  # fmt: skip
    assert bounded.status == "converged"
    assert bounded.start["drift"] == 0.0
    assert bounded.estimates["drift"] == pytest.approx(free.estimates["drift"], rel=rtol)
    assert not any("initial guess" in note for note in bounded.notes)


def test_a_respecified_problem_keeps_its_priors_and_active_trials():
    problem = Problem.of(Track(), [TRIAL, TRIAL], ["gain", "drift"], priors={"drift": (0.0, 2.0)}, **POSED)
    known = problem.with_priors({"gain": (1.0, 0.1)})
    for again in (known.with_trials(TRIAL), known.with_specification(known.specification)):
        assert again.parameters.prior_deviation.tolist() == [0.1, 2.0]
    one = known.only([1])
    assert one.with_specification(known.specification).size == one.size
    assert Problem.of(Track(), TRIAL, iter(["gain"]), **POSED).with_trials(TRIAL).parameters.names == ("gain",)


def test_a_specification_does_not_change_with_the_arguments_of_the_caller():
    free, priors = ["gain"], {"gain": (1.0, 0.1)}
    problem = Problem.of(Track(), TRIAL, free, priors=priors, **POSED)
    free.append("drift")
    priors["gain"] = (1.0, 9.0)
    again = problem.with_trials(TRIAL).parameters
    assert again.names == ("gain",)
    assert float(again.prior_deviation[0]) == 0.1


@pytest.mark.parametrize(
    ("free", "bounds"),
    [
        ("tilt", (-1.5, 1.5)),
        ("grip", (0.0, 2.0)),
        (Free("tilt", bounds=(-9.0, None)), (-1.5, 1.5)),
        (Free("tilt", bounds=(0.1, 9.0)), (0.1, 1.5)),
        (Free("tilt", bounds=(None, None)), (-np.inf, np.inf)),
        (Free("stiffness", bounds=(-1.0, 9.0)), (0.0, 9.0)),
        (Free("offset", start=0.2, tied={"tilt": -3.0}), (-0.5, 0.5)),
        (Free("offset", start=0.2, tied={"stiffness": 1.0}), (0.0, np.inf)),
    ],
)
def test_free_parameters_stay_within_their_declared_bounds(free, bounds):
    interval = parameters_of(SYSTEM, free).bijections[0]
    assert (float(interval.lower), float(interval.upper)) == pytest.approx(bounds)
    # What was declared is no prior: only two bounds that were given are.
    given = isinstance(free, Free) and free.bounds is not None and None not in free.bounds
    assert np.isfinite(interval.log_prior_constants(np.zeros(1), np.full(1, np.inf))[0]) == given


def test_an_initial_guess_outside_the_declared_bounds_is_rejected():
    with pytest.raises(ValueError, match=r"tilt: the initial guess 3 is not inside its bounds \(-1.5, 1.5\)"):
        parameters_of(SYSTEM, Free("tilt", start=3.0))
    with pytest.raises(ValueError, match="of the parameters tied to it"):
        parameters_of(SYSTEM, Free("offset", start=3.0, tied={"tilt": 1.0}))


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (Free("offset", tied=["tilt"]), "`tied` must be a dict from names to factors"),
        (Gain("push", name=3), "must be a string, got 3"),
    ],
)
def test_wrong_types_of_tied_and_name_are_rejected(free, message):
    with pytest.raises(TypeError, match=message):
        parameters_of(SYSTEM, free)


def test_initial_guesses_of_offsets_and_delays_do_not_set_a_scale():
    entries = parameters_of(Track(), ("gain", Gain("push"), Offset("push"), Delay("push"))).entries
    assert [entry.start_means_something for entry in entries] == [True, True, False, False]


def test_an_initial_guess_at_a_declared_bound_is_moved_inside():
    assert float(parameters_of(SYSTEM, "dry").values(jnp.zeros(1))[0]) == pytest.approx(0.1)


class Limited(Track):
    """The gain is at most 0.7."""

    gain: jk.Scalar = jk.parameter(0.5, within=(0.0, 0.7))  # [1/kg]


@pytest.mark.slow
def test_a_fit_ends_at_a_declared_bound_if_the_optimum_is_outside():
    T = np.linspace(0.0, 1.0, 11)
    of_drift, of_gain = T**2 / 2, T**3 / 6  # x, of a drift and of a push that grows by one a second
    trial = Trial(T, {"x": 0.3 * of_drift + of_gain}, {"push": T}, sigma=0.001, initial={"x": 0.0, "x_dot": 0.0})
    found = fit(Limited(), trial, ("gain", "drift"), optimizer=LeastSquares(), simulation=POSED["simulation"])
    assert found.status == "bound"
    assert found.identifiability.at_bound == found.identifiability.beyond == ("gain",)
    assert not found.ok
    best = 0.3 + 0.3 * (of_drift @ of_gain) / (of_drift @ of_drift)  # with a gain of 0.7
    assert found.estimates == pytest.approx({"gain": 0.7, "drift": best}, abs=1e-4)
    # The sum of squares is proportional to (1 - gain)^2.
    quantile = student.ppf(0.975, found.degrees_of_freedom["gain"])
    end = 1.0 - 0.3 * (1.0 + quantile**2 * found.variance / found.cost) ** 0.5
    assert profile(found, "gain", n=21).interval == pytest.approx((end, 0.7), rel=1e-3)


@pytest.mark.slow
def test_studies_of_an_estimate_at_its_bound():
    """The data are those of a small negative gain. Scales of errors are estimated with the bound, too."""
    T, r = np.linspace(0.0, 1.0, 11), np.random.default_rng(0)
    trials = [
        Trial(T, {"x": x}, {"push": T}, sigma=0.001, initial={"x": 0.0, "x_dot": 0.0})
        for x in 0.15 * T**2 - 0.01 * T**3 + 0.001 * r.normal(size=(12, 11))
    ]
    problem = Problem.of(Limited(), trials, ("gain", "drift"), simulation=POSED["simulation"])
    robust = problem.with_specification(dataclasses.replace(problem.specification, errors={"x": Huber()}))
    for found in (minimize(problem, LeastSquares()), minimize(robust, LeastSquares())):
        assert found.status == "bound"
        low, high = profile(found, "gain").interval
        assert low == 0.0
        assert 0.0 < high < 0.01
    found = minimize(problem, LeastSquares())
    assert bootstrap(found, n=200).intervals()["gain"] == (-np.inf, np.inf)
    assert np.isfinite(cross_validate(found).held_out).all()


@pytest.mark.slow
def test_errors_by_windows_with_an_unknown_of_the_trial_and_a_prior():
    """The windows are the clusters. The offset belongs to all of them, the prior to none."""
    T, r = np.linspace(0.0, 10.0, 201), np.random.default_rng(1)
    push = np.sin(3 * T) + 0.5 * np.cos(7 * T)
    x = 0.3 * T**2 / 2 + 0.5 * (-np.sin(3 * T) / 9 - np.cos(7 * T) / 98) + 0.01 * r.normal(size=201)
    trial, free = Trial(T, {"x": x}, {"push": push}, sigma=0.01), ("gain", "drift", Offset("push", each="trial"))
    options = {"window": 0.5, "priors": {"gain": (0.5, 0.1), "drift": (0.3, 0.1)}, "simulation": POSED["simulation"]}
    found = minimize(Problem.of(Track(), trial, free, **options), LeastSquares())
    assert found.clusters == ("window", 20)
    for name, right in {"gain": 0.5, "drift": 0.3}.items():
        assert 0.0 < found.clustered_errors[name] < np.inf
        assert abs(found.estimates[name] - right) < 4.0 * found.standard_errors[name]


def asked(parameters, x):
    y = parameters.values(x)
    return y, parameters.slopes(x), parameters.inverse(y), parameters.prior_residuals(x), parameters.all(x)


@pytest.mark.slow
def test_parameters_are_mapped_equally_with_and_without_tracing():
    """And while something else is traced: values, slopes, their inverse, and what priors say; of a subset, too."""
    whole = parameters_of(Track(), ("gain", Free("drift", start=0.2, bounds=(0.0, 1.0), prior=(0.3, 0.1))))
    for parameters, x in (
        (whole, jnp.array([0.3, -0.7])),
        (whole.subset([1], jnp.array([0.3, -0.7])), jnp.array([0.4])),
    ):
        numbers = asked(parameters, x)
        np.testing.assert_allclose(numbers[2], x, rtol=1e-12)
        while_traced = jax.jit(lambda _, p=parameters, x=x: asked(p, x))(0.0)
        for others in (jax.jit(asked)(parameters, x), while_traced):
            for a, b in zip(numbers, others, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)
