"""Free parameters: entries of vectors, what is tied, bounds, scales, priors; each contradiction is one clear error."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import t as student
from systems import POSED, TRIAL, Track

import jaxkane as jk
from jaxkane.fit import (
    Free,
    Huber,
    LeastSquares,
    Problem,
    Trial,
    bootstrap,
    cross_validate,
    fit,
    minimize,
    profile,
)
from jaxkane.fit.problem.parameters import Interval, log_gaussian_mass
from jaxkane.fit.problem.specification import parameters_of


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
        (Free("others", tied={"stiffness": 1.0}), "has several entries, and other parameters can be tied"),
        (Free("offset", tied={"others": -1.0}), "factor of others must be positive, as the parameter is declared"),
        (Free("offset", tied={"matrix": float("nan")}), "factor of matrix must be a finite number"),
        (Free("offset", tied={"missing": 1.0}), "has no parameter 'missing'"),
        (Free("stiffness", bounds=(5.0, 3.0)), r"stiffness: .* upper bound, got bounds=\(5.0, 3.0\)"),
        (Free("stiffness", bounds=(float("nan"), 3.0)), "stiffness: the lower bound must be less"),
        (Free("stiffness", bounds=(4.5, 6.0)), r"stiffness: the initial guess 4 is not inside its bounds"),
        (Free("stiffness", start=-1.0), "stiffness: the initial guess -1 is not inside its bounds"),
        (Free("tilt", start=3.0), r"tilt: the initial guess 3 is not inside its bounds \(-1.5, 1.5\)"),
        (Free("offset", start=3.0, tied={"tilt": 1.0}), "of the parameters tied to it"),
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


@pytest.mark.parametrize(
    ("free", "begins"),
    [
        (Free("offset", bounds=(0.0, None), scale=0.5), 0.05),
        (Free("offset", bounds=(None, 0.0), scale=0.5), -0.05),
        (Free("offset", bounds=(0.0, 0.2), scale=0.5), 0.02),
        ("dry", 0.1),  # declared
    ],
)
def test_an_initial_guess_at_a_bound_is_moved_inside(free, begins):
    parameters = parameters_of(SYSTEM, free)
    assert float(parameters.start[0]) == 0.0
    assert float(parameters.values(jnp.zeros(1))[0]) == pytest.approx(begins)


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
        (Free("stiffness", bounds=(0.0, np.inf)), (0.0, np.inf)),
        (Free("stiffness", bounds=(-np.inf, np.inf)), (-np.inf, np.inf)),
        (Free("offset", start=0.2, tied={"tilt": -3.0}), (-0.5, 0.5)),
        (Free("offset", start=0.2, tied={"stiffness": 1.0}), (0.0, np.inf)),
    ],
)
def test_free_parameters_stay_within_their_declared_bounds(free, bounds):
    interval = parameters_of(SYSTEM, free).bijections[0]
    assert (float(interval.lower), float(interval.upper)) == pytest.approx(bounds)
    # What was declared is no prior: only two bounds that were given are.
    given = (
        isinstance(free, Free)
        and free.bounds is not None
        and None not in free.bounds
        and np.isfinite(free.bounds).all()
    )
    assert np.isfinite(interval.log_prior_constants(np.zeros(1), np.full(1, np.inf))[0]) == given


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
    assert any("gain is at its bound" in note for note in found.notes)
    with pytest.raises(ValueError, match=r"These data do not determine gain\. Add a prior"):
        found.laplace()
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
