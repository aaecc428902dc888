"""Planned experiments: predicted errors equal those of a fit, also with linked windows, and gradients are exact."""

import jax.numpy as jnp
import numpy as np
import pytest
from slopes import differences, slopes
from systems import Track, responses

from jaxkane.fit import Free, LeastSquares, Linear, Offset, Problem, Trial, design, minimize
from jaxkane.fit.result.design import Design, covariance_of, objective_of

t = np.arange(0.0, 4.0, 0.1)
SIGMA = {"x": 0.01}
CHAIN = {"unknown": ("x", "x_dot"), "window": 1.0, "defect_std": {"x": 0.002, "x_dot": 0.01}}
C = jnp.array([1.0, 0.5])


def push(c, t):
    return {"push": c[0] * jnp.sin(2.0 * t) + c[1] * jnp.cos(5.0 * t)}


def exact_errors(push):
    """Errors of gain and drift in closed form, and the motion with a gain of one from rest.

    Unknowns: gain, drift, the start of the first window, and the jumps to each later one, which move what follows.
    """
    motion = responses(t, push)[0][:, 0]
    columns, jumps = [motion, t**2 / 2, np.ones_like(t), t], []
    for start in (1.0, 2.0, 3.0):
        later = t > start - 1e-9
        columns += [later * 1.0, later * (t - start)]
        jumps += [0.002, 0.01]
    A = np.column_stack(columns) / SIGMA["x"]
    information = A.T @ A + np.diag([0.0] * 4 + [jump**-2 for jump in jumps])
    return np.sqrt(np.diag(np.linalg.inv(information))[:2]), motion


def test_an_unknown_criterion_is_rejected():
    with pytest.raises(ValueError, match=r"`criterion` must be 'D' or 'A', got 'E'"):
        design(Track(), t, push, C, ("gain",), sigma=SIGMA, initial={"x": 0.1}, criterion="E")


def test_the_printed_correlation_is_the_largest_off_the_diagonal():
    """Mutation: with `initial=1.0` every printed design had a correlation of 1.000."""
    trial = Trial(t, {"x": 0.0 * t}, sigma=SIGMA)
    of_two = [[4.0, -1.0], [-1.0, 1.0]], [[1.0, 0.1], [0.1, 1.0]]
    for names, before, after, printed in (
        (("gain", "drift"), *of_two, "0.500 before, 0.100 after"),
        (("gain",), [[4.0]], [[1.0]], "0.000 before, 0.000 after"),
    ):
        plan = Design(C, {}, trial, names, np.array(after), np.array(before), ())
        assert str(plan).endswith(f"largest correlation: {printed}")


@pytest.mark.weekly
def test_a_design_optimizes_parameters_but_not_trial_offsets():
    free = ("gain", Offset("x", each="trial", prior=(0.0, 0.1)), "drift")
    plan = design(Track(), t[:11], push, C, free, sigma=SIGMA, initial={"x": 0.1}, steps=1)
    assert plan.names == ("gain", "drift")
    assert plan.covariance.shape == (2, 2)


@pytest.mark.weekly
def test_a_designed_input_reduces_the_standard_errors_as_predicted():
    names, limit = ("gain", "drift"), 0.6
    plan = design(
        Track(), t, push, C, names, sigma=SIGMA, initial={"x": 0.1}, steps=12, rms={"push": 1.0}, limits={"x": limit},
        **CHAIN,
    )  # fmt: skip
    assert plan.history[-1] < plan.history[0] - 1.0
    assert np.sqrt(np.mean(plan.inputs["push"] ** 2)) == pytest.approx(1.0)
    assert np.abs(plan.trial.measured["x"]).max() < 1.3 * limit
    # Links between windows are part of what a plan tells.
    first = np.asarray(push(C, jnp.asarray(t))["push"])
    before, _ = exact_errors(first / np.sqrt(np.mean(first**2)))
    after, motion = exact_errors(plan.inputs["push"])
    assert list(plan.before.values()) == pytest.approx(before, rel=1e-4)
    assert list(plan.standard_errors.values()) == pytest.approx(after, rel=1e-4)
    # The plan is one motion through all windows, and what a fit of such a trial finds.
    np.testing.assert_allclose(plan.trial.measured["x"], 0.1 + motion, atol=1e-9)
    seen = minimize(Problem.of(Track(), plan.trial, names, **CHAIN), LeastSquares())
    assert seen.cost < 1e-12
    of_fit = np.sqrt(np.diag(np.linalg.inv(seen.identifiability.information)))
    assert list(plan.standard_errors.values()) == pytest.approx(of_fit, rel=1e-4)


@pytest.mark.slow
def test_a_design_has_the_errors_of_a_fit_with_the_same_priors():
    """A log-normal prior and a constraint, both much better than the data."""
    free = (Free("gain", bounds=(0.0, None), prior=("lognormal", 1.0, 1e-3)), "drift")
    known = {"constraints": [Linear({"gain": 1.0, "drift": 1.0}, 1.0, 2e-3)]}
    plan = design(Track(), t[:11], push, C, free, sigma=SIGMA, initial={"x": 0.1}, steps=0, **known)
    seen = minimize(Problem.of(Track(), plan.trial, free, **known), LeastSquares())
    errors = [*plan.standard_errors.values()]
    assert errors == pytest.approx(seen.identifiability.given_sigma_errors, rel=1e-6)
    assert errors == pytest.approx([1e-3, 5**0.5 * 1e-3], rel=0.05)


@pytest.mark.weekly
def test_the_gradient_of_a_plan_against_differences():
    known = {name: np.asarray(x) for name, x in push(C, jnp.asarray(t)).items()}
    trial = Trial(t, {"x": 0.0 * t}, known, sigma=SIGMA, initial={"x": 0.1})
    problem = Problem.of(Track(), trial, ("gain", "drift"), **CHAIN)
    objective = objective_of(problem, jnp.asarray(t), push, np.arange(2), "A", {"x": 0.5})
    both = slopes(lambda c, _: objective(c, problem.model, problem.windows)[0], "forward")
    np.testing.assert_allclose(both(C)[0], differences(both, C, 1e-5), rtol=1e-5)


def test_an_unidentifiable_parameter_has_an_infinite_standard_error():
    # Of the first two only their sum is known.
    rows = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 1.0], [0.0, 0.0, 3.0]])
    covariance = covariance_of(rows.T @ rows)
    assert np.isinf(covariance.diagonal()[:2]).all()
    assert covariance[2, 2] == pytest.approx(np.linalg.pinv(rows.T @ rows)[2, 2])
