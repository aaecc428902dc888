"""Intervals by label: the spread of the estimates between kinds of run, counted on simulated data."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from systems import SETS, Track, coverage_band, responses

from jaxkane.fit import LeastSquares, Problem, Simulation, Trial, bootstrap, minimize

t = np.arange(0.0, 2.0, 0.1)
SIGMA, TRUTH = 0.05, {"gain": 1.2, "drift": 0.3}
POSED = {"unknown": ("x_dot",), "simulation": Simulation(step=0.1)}


def measured(kinds, model_error, rng, correlation=0.0):
    """Positions (T, n_t). The gain and the drift differ between kinds of run by `model_error` times 0.1 and 0.05."""
    effects, found = model_error * rng.normal(size=(max(kinds) + 1, 2)) * (0.1, 0.05), []
    for k, kind in enumerate(kinds):
        gain, drift = [*TRUTH.values()] + effects[kind]
        e = rng.normal(size=t.size)
        for i in range(1, t.size):
            e[i] = correlation * e[i - 1] + (1 - correlation**2) ** 0.5 * e[i]
        found.append(responses(t, gain * push(k) + drift)[0][:, 0] + 0.1 * t + SIGMA * e)
    return np.array(found)


def push(k):
    return np.sin((1.5 + 0.3 * (k % 6)) * t + k)


def posed(labels, x):
    kept = {"sigma": SIGMA, "initial": {"x": 0.0, "x_dot": 0.0}}
    labels = [{} if label is None else {"speed": label} for label in labels]
    pairs = enumerate(zip(labels, x, strict=True))
    trials = [Trial(t, {"x": y}, {"push": push(k)}, name=f"run {k}", labels=own, **kept) for k, (own, y) in pairs]
    return Problem.of(Track(), trials, (*TRUTH,), **POSED)


METHOD, KINDS = LeastSquares(damping=1e-9), [k // 3 for k in range(12)]


def test_intervals_by_label_include_the_spread_between_its_values():
    x = measured(KINDS, 3.0, np.random.default_rng(0))
    plain, labelled = (minimize(posed(labels, x), METHOD) for labels in ([None] * 12, KINDS))
    assert plain.estimates == labelled.estimates
    assert labelled.clusters == ("label speed", 4)
    assert set(labelled.error_kinds.values()) == {"label speed"}
    assert plain.clusters == ("trial", 12)
    assert labelled.half_widths()[0] > 1.5 * plain.half_widths()[0]
    assert "Intervals are for runs of this kind." in str(plain)
    text = str(labelled)
    assert 'Intervals by "label speed" include the spread of the estimates between 4 values of speed.' in text
    assert "runs of this kind" not in text
    assert labelled.ok
    assert bootstrap(labelled, n=100).clusters == ("trial", 12)


def test_two_values_of_a_label_do_not_show_a_spread():
    x = measured(KINDS, 0.0, np.random.default_rng(0))
    two = minimize(posed([k % 2 for k in range(12)], x), METHOD)
    assert two.clusters == ("trial", 12)
    assert "Intervals are for runs of these kinds." in str(two)


def test_a_fit_without_a_finite_interval_is_not_ok():
    """Correlated residuals of three short trials: too few clusters, so all errors are infinite."""
    x = measured(KINDS, 0.0, np.random.default_rng(1), correlation=0.95)
    result = minimize(posed([None] * 12, x).only({0, 1, 2}), METHOD)
    assert result.identifiability.ok
    assert np.isinf(result.half_widths()).all()
    assert not result.ok
    assert "the interval of every parameter is its whole range" in result.message


@pytest.mark.weekly
@pytest.mark.parametrize("model_error", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("n_kinds", [3, 4, 6])
def test_coverage_with_a_model_error_that_depends_on_the_label(n_kinds, model_error):
    """docs/uncertainty.md has the figures of 300 sets. Clusters of single trials cover less."""
    rng, hits, of_trials = np.random.default_rng(n_kinds), 0, 0
    kinds = [k * n_kinds // 12 for k in range(12)]
    problem = posed(kinds, measured(kinds, 0.0, rng))
    unlabelled = posed([None] * 12, measured(kinds, 0.0, rng))
    for _ in range(SETS):
        windows = dataclasses.replace(problem.windows, measured=jnp.asarray(measured(kinds, model_error, rng)[:, None]))
        result = minimize(dataclasses.replace(problem, windows=windows), METHOD)
        off = np.abs(np.array([*result.estimates.values()]) - [*TRUTH.values()])
        hits += np.sum(off <= result.half_widths())
        assert np.isfinite(result.half_widths()).all()
        other = dataclasses.replace(result, problem=dataclasses.replace(unlabelled, windows=windows))
        of_trials += np.sum(off <= other.half_widths())
    low, high = coverage_band(SETS)
    share = hits / (2 * SETS)
    print(n_kinds, model_error, "by label", share, "by trial", of_trials / (2 * SETS))
    assert low - 0.01 <= share <= min(high + 0.02, 1.0)
    assert model_error < 3.0 or of_trials / (2 * SETS) < 0.9
