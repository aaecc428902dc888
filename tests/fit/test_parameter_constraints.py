"""Sums of parameters, exact, measured and bounded, and joint priors: against least squares in closed form."""

import jax
import numpy as np
import pytest
from systems import Track, responses

from jaxkane.fit import (
    Free,
    JointPrior,
    LeastSquares,
    Linear,
    Problem,
    Simulation,
    Trial,
    fit,
    load,
)

TIGHT = 1e-6
T = np.linspace(0.0, 2.0, 21)
PUSH = np.sin(2.0 * T)
EXACT = {"simulation": Simulation(step=0.1), "optimizer": LeastSquares(rtol=1e-14, damping=1e-7)}


A = responses(T, PUSH)[0] / 0.05


@pytest.fixture(scope="module")
def trial():
    x = 0.05 * (A @ [1.2, 0.4] + np.random.default_rng(0).normal(size=T.size))
    return Trial(T, {"x": x}, {"push": PUSH}, sigma=0.05, initial={"x": 0.0, "x_dot": 0.0})


def solved(trial, rows=(), values=()):
    """Least squares with more rows in standard deviations."""
    return np.linalg.lstsq(np.vstack([A, *rows]), np.append(trial.measured["x"] / 0.05, values), rcond=None)[0]


def values_of(found):
    return found.estimates | {name: value for name, (value, _) in found.dependent.items()}


@pytest.mark.weekly
@pytest.mark.parametrize("free", [("gain", "drift"), (Free("gain", bounds=(0.0, None)), Free("drift", scale=0.1))])
def test_an_exact_sum(trial, free):
    found = fit(Track(), trial, free, constraints=[Linear({"gain": 1.0, "drift": 2.0}, equals=1.9)], **EXACT)
    assert len(found.names) == 1
    # gain = 1.9 - 2 drift
    own, rest = A[:, 1] - 2 * A[:, 0], trial.measured["x"] / 0.05 - 1.9 * A[:, 0]
    drift = own @ rest / (own @ own)
    values = values_of(found)
    assert values["drift"] == pytest.approx(drift, rel=TIGHT)
    assert values["gain"] == pytest.approx(1.9 - 2 * drift, rel=1e-9)
    assert float(found.system.gain) == pytest.approx(values["gain"], rel=1e-12)
    error = (found.variance / (own @ own)) ** 0.5
    errors = found.standard_errors | {name: e for name, (_, e) in found.dependent.items()}
    assert [errors["drift"], errors["gain"]] == pytest.approx([error, 2 * error], rel=TIGHT)
    assert any("follows from the other parameters" in note for note in found.notes)
    assert found.problem.size == (T.size, 1)


@pytest.mark.slow
def test_a_measured_sum_and_a_joint_prior_equal_least_squares_rows(trial):
    found = fit(Track(), trial, ("gain", "drift"), constraints=[Linear({"gain": 1, "drift": 2}, 1.5, 0.01)], **EXACT)
    best = solved(trial, [[[100.0, 200.0]]], [150.0])
    assert [*found.estimates.values()] == pytest.approx(best, rel=TIGHT)
    C = np.array([[0.01, 0.004], [0.004, 0.0025]])
    prior = JointPrior({"drift": 0.2, "gain": 1.0}, C)
    joint = fit(Track(), trial, ("gain", "drift"), constraints=[prior], **EXACT)
    L = np.linalg.inv(np.linalg.cholesky(C))
    rows = L[:, ::-1]
    best = solved(trial, [rows], L @ [0.2, 1.0])
    assert [*joint.estimates.values()] == pytest.approx(best, rel=TIGHT)
    N, P, v = A.T @ A, rows.T @ rows, joint.variance
    B = np.linalg.inv(N + P)
    np.testing.assert_allclose(joint.covariance, B @ (v * N + P) @ B, rtol=TIGHT)
    assert joint.cost == pytest.approx(np.sum((A @ best - trial.measured["x"] / 0.05) ** 2)
                                       + np.sum((rows @ best - L @ [0.2, 1.0]) ** 2), rel=1e-9)  # fmt: skip
    assert "No evidence" in joint.laplace().message
    # The priors of parameters are not part of the likelihood.
    square, each = np.sum((A @ best - trial.measured["x"] / 0.05) ** 2), np.log(0.05 * np.sqrt(2 * np.pi))
    assert joint.marginal_likelihood() == pytest.approx(-square / 2 - T.size * each, rel=1e-9)


@pytest.mark.weekly
def test_the_cost_and_the_log_density_include_constraint_residuals(trial):
    """Of the likelihood of a filter, and of the density for samplers with its gradient."""
    known = [Linear({"gain": 1.0, "drift": 2.0}, 1.5, 0.1)]
    for options in ({"noise": {}}, {}):
        options = {"simulation": EXACT["simulation"], **options}
        plain, more = (Problem.of(Track(), trial, ("gain", "drift"), constraints=c, **options) for c in ((), known))
        point = more.at({"gain": 1.1, "drift": 0.4})
        assert more.cost(point) - plain.cost(point) == pytest.approx((0.4 / 0.1) ** 2, rel=1e-6)
    density = more.log_density()
    value, slope = jax.jit(jax.value_and_grad(density))(point)
    assert float(value - density(more.start)) == pytest.approx(
        -(more.cost(point) - more.cost(more.start)) / 2, rel=1e-9
    )
    np.testing.assert_allclose(slope.parameters, -more.linearize(point).blocks.gradient[2], rtol=1e-9)


@pytest.mark.slow_cases("at_most-1.7")
@pytest.mark.parametrize(("side", "bound"), [("at_most", 1.7), ("at_least", 2.3), ("at_most", 2.5), ("at_least", 1.5)])
def test_an_inequality(trial, side, bound, tmp_path):
    at = Track(gain=1.0, drift=0.2) if side == "at_most" else Track(gain=1.8, drift=0.5)
    constraints = [Linear({"gain": 1.0, "drift": 2.0}, **{side: bound})]
    found = fit(at, trial, ("gain", "drift"), constraints=constraints, **EXACT)
    free = solved(trial)
    total = free[0] + 2 * free[1]
    active = total > bound if side == "at_most" else total < bound
    assert active == (bound in (1.7, 2.3))
    values = values_of(found)
    if not active:
        assert [values["gain"], values["drift"]] == pytest.approx(free, rel=TIGHT)
        return
    exact = fit(at, trial, ("gain", "drift"), constraints=[Linear({"gain": 1.0, "drift": 2.0}, bound)], **EXACT)
    assert found.cost == pytest.approx(exact.cost, rel=1e-9)
    assert values["gain"] + 2 * values["drift"] == pytest.approx(bound, rel=1e-12)
    assert found.standard_errors == pytest.approx(exact.standard_errors, rel=TIGHT)
    assert any(f"gain + 2 drift is at its bound, {bound:.5g}" in note for note in found.notes)
    assert found.status == "converged"
    problem = Problem.of(at, trial, ("gain", "drift"), constraints=constraints, simulation=EXACT["simulation"])
    assert load(found.save(tmp_path / "fit.npz"), problem).estimates == found.estimates


def test_the_prior_of_a_dependent_parameter_is_used(trial):
    free = (Free("gain", prior=(1.0, 0.01)), Free("drift", prior=(0.3, 0.01)))
    found = fit(Track(), trial, free, constraints=[Linear({"gain": 1.0, "drift": 2.0}, equals=1.9)], **EXACT)
    rows = np.vstack([A, [[100.0, 0.0], [0.0, 100.0]]])
    y = np.append(trial.measured["x"] / 0.05, [100.0, 30.0])
    own, rest = rows[:, 1] - 2 * rows[:, 0], y - 1.9 * rows[:, 0]
    values = values_of(found)
    assert values["drift"] == pytest.approx(own @ rest / (own @ own), rel=TIGHT)


@pytest.mark.slow
def test_a_dependent_parameter_keeps_its_bounds(trial):
    """The gain would be negative: the sum alone would allow it."""
    sums = [Linear({"gain": 1.0, "drift": 1.0}, equals=0.3)]
    free = (Free("gain", start=0.2, scale=10.0, bounds=(0.0, None)), Free("drift", start=0.1))
    found = fit(Track(), trial, free, constraints=sums, **EXACT)
    assert found.names == ("gain",)  # which keeps the bijection that has bounds
    both = (free[0], Free("drift", start=0.1, bounds=(0.0, None)))
    kept = fit(Track(), trial, both, constraints=sums, **EXACT)
    values = values_of(kept)
    assert min(values.values()) >= 0.0
    assert values["gain"] + values["drift"] == pytest.approx(0.3, rel=1e-9)
    with pytest.raises(ValueError, match="gain starts outside its bounds"):
        fit(Track(), trial, (free[0], Free("drift", start=0.5, bounds=(0.0, None))), constraints=sums)


@pytest.mark.parametrize(
    ("ask", "error", "message"),
    [
        (lambda: Linear({"gain": 1.0}), ValueError, r"Linear\(gain\): pass either `equals`"),
        (lambda: Linear({"gain": 1.0}, 1.0, at_least=0.0), ValueError, r"pass either `equals`"),
        (lambda: Linear({"gain": 1.0}, at_least=0.0, std=1.0), ValueError, r"pass either `equals`"),
        (lambda: Linear({"gain": 0.0}, 1.0), ValueError, "the factor of gain must be finite"),
        (lambda: Linear({"gain": 1.0}, 1.0, 0.0), ValueError, "`std` must be finite"),
        (lambda: Linear("gain", 1.0), TypeError, "`factors` must be a dict"),
        (lambda: JointPrior({"gain": 1.0}, [[-1.0]]), ValueError, "positive eigenvalues"),
        (lambda: JointPrior({"gain": 1.0}, np.eye(2)), ValueError, r"symmetric matrix \(1, 1\)"),
        (lambda: posed("gain"), TypeError, "`constraints` must contain only"),
        (lambda: posed(Linear({"mass": 1.0}, 1.0)), ValueError, "Linear contains parameters that are not free: mass"),
        (lambda: posed(*[Linear({"gain": 1.0, "drift": 1.0}, 1.0)] * 2), ValueError, "linearly dependent"),
        (lambda: posed(Linear({"gain": 1.0, "drift": 1.0}, at_most=0.5)), ValueError, "not inside its bounds"),
    ],
)
def test_an_invalid_constraint_is_rejected(ask, error, message):
    with pytest.raises(error, match=message):
        ask()


def posed(*constraints):
    trial = Trial(T, {"x": T}, {"push": PUSH}, sigma=0.1)
    return Problem.of(Track(), trial, ("gain", "drift"), constraints=constraints, simulation=EXACT["simulation"])
