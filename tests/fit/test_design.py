"""Planned experiments: their errors are those of a fit of the plan, links between windows included; exact gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Track

from jaxkane.fit import Problem, Trial, design, identifiability, least_squares
from jaxkane.fit._design import _covariance, goal_of

t = np.arange(0.0, 4.0, 0.1)
SIGMA = {"x": 0.01}
CHAIN = {"unknown": ("x", "x_dot"), "window": 1.0, "continuity": {"x": 0.002, "x_dot": 0.01}}
C = jnp.array([1.0, 0.5])


def push(c, t):
    return {"push": c[0] * jnp.sin(2.0 * t) + c[1] * jnp.cos(5.0 * t)}


def test_links_between_windows_are_part_of_a_plan():
    plan = design(Track(), t, push, C, ("gain", "drift"), sigma=SIGMA, initial={"x": 0.1}, steps=0, **CHAIN)
    # In closed form: what is measured, by gain, drift and the start of the first window; a jump moves what follows it.
    h, p = 0.1, np.asarray(push(C, jnp.asarray(t))["push"])
    rows = [(0.0, 0.0)]
    for i in range(t.size - 1):
        x, v = rows[-1]
        rows.append((x + v * h + (2 * p[i] + p[i + 1]) * h**2 / 6, v + (p[i] + p[i + 1]) * h / 2))
    columns = [np.array(rows)[:, 0], t**2 / 2, np.ones_like(t), t]
    deviations = []
    for start in (1.0, 2.0, 3.0):
        later = t > start - 1e-9
        columns += [later * 1.0, later * (t - start)]
        deviations += [0.002, 0.01]
    A = np.column_stack(columns) / 0.01
    information = A.T @ A + np.diag([0.0] * 4 + [d**-2 for d in deviations])
    exact = np.sqrt(np.diag(np.linalg.inv(information))[:2])
    assert list(plan.standard_errors.values()) == pytest.approx(exact, rel=1e-4)
    motion = 0.1 + columns[0]  # with a gain of one, no drift, from rest
    np.testing.assert_allclose(plan.trial.measured["x"], motion, atol=1e-9)
    seen = least_squares(Problem.of(Track(), plan.trial, ("gain", "drift"), **CHAIN))
    assert seen.cost < 1e-12
    of_fit = np.sqrt(np.diag(np.linalg.inv(identifiability(seen).information)))
    assert list(plan.standard_errors.values()) == pytest.approx(of_fit, rel=1e-4)
    assert plan.covariance == pytest.approx(plan.covariance_before)


def test_the_gradient_of_a_plan_against_differences():
    known = {name: np.asarray(x) for name, x in push(C, jnp.asarray(t)).items()}
    trial = Trial(t, {"x": 0.0 * t}, known, sigma=SIGMA, initial={"x": 0.1})
    problem = Problem.of(Track(), trial, ("gain", "drift"), **CHAIN)
    goal = goal_of(problem, jnp.asarray(t), push, np.arange(2), "A", {"x": 0.5})
    value = jax.jit(lambda c: goal(c, problem.model, problem.windows)[0])
    h = 1e-5
    slopes = [float(value(C + h * e) - value(C - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(C), slopes, rtol=1e-5)


def test_what_a_plan_does_not_tell_has_an_infinite_error():
    # Of the first two only their sum is known.
    rows = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 1.0], [0.0, 0.0, 3.0]])
    covariance = _covariance(rows.T @ rows)
    assert np.isinf(covariance.diagonal()[:2]).all()
    assert covariance[2, 2] == pytest.approx(np.linalg.pinv(rows.T @ rows)[2, 2])
