"""Fits of a double pendulum: exact derivatives, both optimizers, and parameters that are not identifiable."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from slopes import differences, slopes

import jaxkane as jk
from jaxkane.catalog import DoublePendulum
from jaxkane.fit import (
    Free,
    Gain,
    GradientDescent,
    LeastSquares,
    Offset,
    Problem,
    Trial,
    fit,
    identifiability,
    minimize,
)

TRUTH = DoublePendulum(mass=1.2, length=0.7)
GUESS = DoublePendulum(mass=1.0, length=0.8)
SIGMA = {"theta1": 0.01, "theta2": 0.01}
OPTIONS = {"unknown": ("theta1", "theta2", "theta1_dot", "theta2_dot"), "window": 0.7}


@pytest.fixture(scope="module")
def swings():
    """Two swings of different length, with torques, noise, gaps and an offset in one sensor."""
    rng = np.random.default_rng(3)
    trials = []
    t = np.arange(0.0, 2.1, 0.02)
    for duration, angle in ((1.5, 0.4), (2.1, -0.7)):
        inputs = {"shoulder_torque": 2.0 * np.sin(3.0 * t), "elbow_torque": np.cos(5.0 * t)}
        start = jk.assemble(TRUTH, {"theta1": angle, "theta2": 0.3})
        swing = jk.simulate(TRUTH, start, t, inputs)
        measured = {name: np.asarray(swing[name]) + rng.normal(0.0, s, t.size) for name, s in SIGMA.items()}
        measured["theta2"] += 0.05
        measured["theta1"][10:15] = np.nan
        trial = Trial(t, measured, inputs, sigma=SIGMA, name=f"{duration} s")
        trials.append(trial.between(0.0, duration - 0.01))
    return trials


@pytest.fixture(scope="module")
def problem(swings):
    return Problem.of(GUESS, swings, ("mass", "length", Offset("theta2", each="trial")), **OPTIONS)


@pytest.mark.weekly
def test_jacobian_against_central_differences(swings):
    tolerance = 1e-6
    own = (Offset("theta2", each="trial", prior=(0.0, 0.1)), Offset("shoulder_torque", each="trial"))
    free = (Free("mass", prior=(1.0, 0.3)), "length", Gain("elbow_torque"), *own)
    problem = Problem.of(GUESS, swings, free, **OPTIONS)
    window = jax.tree.map(lambda x: x[1], problem.windows)
    point = problem.start

    def residuals(unknowns, _=None):
        z, b, x = jnp.split(unknowns, (4, 6))
        return problem.model.residuals(window, problem.model.consistent(window, z, x), z, b, x)[0]

    x = 0.05 * jnp.arange(1.0, 10.0)
    both = slopes(residuals, "forward")
    exact, here = both(x)
    scale = jnp.max(jnp.abs(exact), axis=0, keepdims=True)
    assert float(jnp.max(jnp.abs(exact - differences(both, x, 1e-5)) / scale)) < tolerance

    # The triangle that `linearize` keeps of it has the same J^T J and J^T r, priors included.
    def at(x):
        z = jnp.zeros_like(point.window_starts).at[1].set(x[:4])
        b = jnp.zeros_like(point.trial_unknowns).at[0].set(x[4:6])
        return eqx.tree_at(lambda p: (p.window_starts, p.trial_unknowns, p.parameters), point, (z, b, x[6:]))

    R = problem.linearize(at(x)).blocks.R[1]
    A = jnp.column_stack([exact, here])
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-8, atol=1e-8 * float(jnp.max(A.T @ A)))


def check(result):
    assert result.ok, result.message
    n, unknown = result.problem.size
    assert result.cost == pytest.approx(n - unknown, rel=0.2)
    for name in ("mass", "length"):
        error = result.estimates[name] - float(getattr(TRUTH, name))
        assert abs(error) < 3.0 * result.standard_errors[name] < 0.1
    for trial in result.trial_names:
        assert result.nuisance[trial]["offset of theta2"] == pytest.approx(0.05, abs=0.01)
        assert np.isnan(result.residuals[trial]["theta1"]).sum() == 5
    assert "mass" in result.table(TRUTH)


OPTAX = GradientDescent(optax.adam(optax.cosine_decay_schedule(0.2, 100)), rtol=0.03)


@pytest.mark.slow
@pytest.mark.weekly_cases("LeastSquares", "GradientDescent")
@pytest.mark.parametrize(
    "optimizer", [LeastSquares(), GradientDescent(), OPTAX], ids=["LeastSquares", "GradientDescent", "optax"]
)
def test_estimates_by_each_optimizer(problem, optimizer):
    check(minimize(problem, optimizer))


def test_gradient_descent_without_preconditioning_reduces_the_cost(problem):
    result = minimize(problem, GradientDescent(refresh=None), steps=5)
    assert result.status == "steps"
    assert result.cost < result.history[0]


def test_steps_to_infinite_costs_are_halved(problem):
    leap = optax.sgd(1e6)
    result = minimize(problem, GradientDescent(leap), steps=2)
    assert np.all(np.isfinite(result.history))
    assert np.isfinite(result.cost)


@pytest.mark.weekly
def test_a_parameter_without_influence_is_reported(swings):
    # Without inputs only the ratio of gravity and length matters, and the mass not at all.
    quiet = [Trial(s.t, s.measured, sigma=SIGMA, name=s.name) for s in swings]
    seen = identifiability(Problem.of(GUESS, quiet, ("mass", "length", "gravity"), **OPTIONS))
    assert not seen.ok
    assert seen.without_influence == ("mass",)
    assert any("mass has no influence" in text for text in seen.messages)
    assert any("length, gravity trade off" in t or "gravity, length trade off" in t for t in seen.messages)
    assert seen.singular_values[-1] == 0.0
    result = fit(GUESS, quiet, ("mass", "length"), optimizer=LeastSquares(), **OPTIONS)
    assert not result.ok
    assert result.estimates["mass"] == 1.0
    assert np.isinf(result.standard_errors["mass"])
    assert np.isfinite(result.standard_errors["length"])
    assert "mass has no influence" in result.message
