"""How often 95 % intervals hold the truth, counted: of every kind of data those that are said to be valid for it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from systems import Track

from jaxkane.fit import (
    Free,
    LeastSquares,
    Problem,
    Simulation,
    Trial,
    bootstrap,
    cross_validate,
    laplace,
    minimize,
    profile,
    validate,
)
from jaxkane.fit._covariance import jackknife_covariance
from jaxkane.fit._statistics import autocorrelations, wald_test

LOW, HIGH = 0.93, 0.97
t = np.arange(0.0, 2.0, 0.1)
SIGMA = 0.05  # [m]
TRUTH = {"gain": 1.2, "drift": 0.3}


def white(rng, n):
    return rng.normal(size=n)


def correlated(rng, n):
    """Of neighbours by 0.9."""
    e = rng.normal(size=n)
    for i in range(1, n):
        e[i] = 0.9 * e[i - 1] + (1 - 0.81) ** 0.5 * e[i]
    return e


def padded(rng, n):
    """A channel that was measured at every third sample."""
    e = np.full(n, np.nan)
    e[::3] = correlated(rng, len(e[::3]))
    return e


def trial(k, noise, factor, rng):
    """Of x'' = gain push + drift from rest, with push linear between samples."""
    push = np.sin((1.5 + 0.3 * (k % 6)) * t + k)
    h, rows = np.diff(t), [(0.0, 0.1)]
    force = TRUTH["gain"] * push + TRUTH["drift"]
    for i, dt in enumerate(h):
        x, v = rows[-1]
        rows.append((x + v * dt + (2 * force[i] + force[i + 1]) * dt**2 / 6, v + (force[i] + force[i + 1]) * dt / 2))
    x = np.array(rows)[:, 0] + factor * SIGMA * noise(rng, t.size)
    return Trial(t, {"x": x}, {"push": push}, sigma=SIGMA, initial={"x": 0.0, "x_dot": 0.0})


KINDS = {  # noise, trials, residuals by sigma, deviations of priors; and what intervals are valid
    "white": (white, 8, 1.0, None, ("formal", "intervals", "laplace")),
    "correlated": (correlated, 12, 1.0, None, ("intervals",)),
    "padded": (padded, 12, 1.0, None, ("intervals",)),
    "priors": (white, 8, 1.0, (0.02, 0.03), ("formal", "intervals", "laplace")),
    "priors, sigma ten times too large": (white, 8, 0.1, (0.002, 0.003), ("formal", "intervals")),
    "few trials": (correlated, 4, 1.0, None, ("intervals",)),
}


def covered(kind, n, seed=0):
    """The share of all parameters that intervals hold, by name; a trial's start is unknown in all."""
    noise, T, factor, deviations, names = KINDS[kind]
    rng, hits = np.random.default_rng(seed), dict.fromkeys(names, 0)
    for i in range(n):
        free = ("gain", "drift")
        if deviations:  # measured elsewhere, with these errors
            free = [
                Free(name, prior=(TRUTH[name] + d * rng.normal(), d)) for name, d in zip(free, deviations, strict=True)
            ]
        trials = [trial(k, noise, factor, rng) for k in range(T)]
        if i == 0 or deviations:
            problem = Problem.of(Track(), trials, free, unknown=("x_dot",), simulation=Simulation(step=0.1))
        else:  # the same one of other measurements: to pose it again takes a third of the time
            measured = jnp.asarray(np.nan_to_num([one.measured["x"] for one in trials]))[:, None]
            problem = dataclasses.replace(problem, windows=dataclasses.replace(problem.windows, measured=measured))
        found = minimize(problem, LeastSquares(damping=1e-9))
        of_laplace = np.full(2, np.nan)
        if "laplace" in names:
            of_laplace = laplace(found).covariance.diagonal() ** 0.5 * np.array(problem.parameters.scale)
        quantile = stats.t.ppf(0.975, found.identifiability.degrees_of_freedom)
        intervals = found.intervals()
        for j, (name, value) in enumerate(TRUTH.items()):
            error, (low, high) = abs(found.estimates[name] - value), intervals[name]
            within = {
                "formal": error <= quantile * found.standard_errors[name],
                "intervals": low <= value <= high,
                "laplace": error <= stats.norm.ppf(0.975) * of_laplace[j],
            }
            for which in names:
                hits[which] += within[which] / n / 2
        if i == 0:  # The cost is a parabola: the interval by likelihood is the same one, and holds as often.
            assert profile(found, "gain", n=3).interval == pytest.approx(intervals["gain"], rel=1e-3)
    return hits


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_hold_the_truth_as_often_as_they_say(kind):
    for which, share in covered(kind, 300).items():
        assert LOW <= share <= HIGH, (which, share)


@pytest.mark.parametrize(("T", "p", "spread"), [(8, 6, 0.0), (20, 3, 0.0), (8, 6, 0.5), (6, 2, 0.5)])
def test_few_trials_scatter_more_than_a_sandwich_sees(T, p, spread):
    """Trials of unlike inputs, correlated residuals: intervals, and the test of several parameters that are zero."""
    rng, time, n = np.random.default_rng(1), np.linspace(0.0, 4.0, 20), 500
    root = np.linalg.cholesky(0.9 ** np.abs(np.subtract.outer(np.arange(20), np.arange(20))))
    hits, false = 0.0, 0.0
    for _ in range(n):
        rates = 1 + 0.7 * np.arange(p) + 0.3 * rng.normal(size=(T, 1, p))
        sizes = np.exp(spread * rng.normal(size=(T, 1, 1)))  # of inputs: trials tell more and less
        A = sizes * np.sin(rates * time[:, None] + rng.uniform(0, 6, (T, 1, p)))
        e = rng.normal(size=(T, time.size)) @ root.T
        information, gradient = A.mT @ A, np.einsum("tmi,tm->ti", A, e)
        x = np.linalg.solve(information.sum(axis=0), gradient.sum(axis=0))
        scores = np.einsum("tmi,tm->ti", A, e - A @ x)
        places = np.tile(np.arange(p), (T, 1))
        C = jackknife_covariance(information, scores, places, np.zeros((p, p)))
        hits += np.mean(np.abs(x) <= stats.t.ppf(0.975, T - 1) * C.diagonal() ** 0.5) / n
        q = min(p, 3)
        false += (wald_test(x[:q], C[:q, :q], T) < 0.05) / n
    assert LOW <= hits <= HIGH
    assert 0.02 < false < 0.07


def test_neighbours_are_measurements_that_follow_each_other():
    """Padded with NaN, or beside channels of the same kind, residuals are as correlated as they are."""
    rng = np.random.default_rng(2)
    walk = correlated(rng, 4000)
    every_third = np.full(3 * walk.size, np.nan)
    every_third[::3] = walk
    (alone,), (within,) = (autocorrelations([r], 1) for r in (walk, every_third))
    assert alone == within == pytest.approx(0.9, abs=0.03)
    # Pairs by pairs: pieces that are short do not lose what has no neighbour.
    assert autocorrelations(walk.reshape(-1, 4), 2) == pytest.approx([0.9, 0.81], abs=0.03)
    assert autocorrelations([np.full(3, np.nan), np.zeros(5)], 1) == 0.0


FRICTION = 0.4  # [m/s^2], dry, which the model does not have


def rubbing(n, rng):
    """Motions (n, n_t) of x'' = gain push + drift - friction sign(x') from rest, with pushes (n, n_t) of random size
    and rate; what friction does to the estimates differs from motion to motion."""
    size, rate, phase = rng.uniform(0.8, 2.0, (n, 1)), rng.uniform(1.5, 3.5, (n, 1)), rng.uniform(0, 6, (n, 1))
    fine = 40
    times = np.linspace(t[0], t[-1], fine * (t.size - 1) + 1)
    push = size * np.sin(rate * t + phase)
    x, v, out = np.zeros(n), np.zeros(n), [np.zeros(n)]
    for i in range(times.size - 1):
        k, s = divmod(i + 0.5, fine)
        force = push[:, int(k)] + (push[:, int(k) + 1] - push[:, int(k)]) * s / fine
        a = TRUTH["gain"] * force + TRUTH["drift"] - FRICTION * np.tanh(v / 0.02)
        h = times[i + 1] - times[i]
        v, x = v + h * a, x + h * (v + h * a)
        if (i + 1) % fine == 0:
            out.append(x)
    return push, np.stack(out, axis=1)


@pytest.mark.slow
def test_intervals_that_hold_where_friction_is_left_out():
    """Of 100 sets of eight trials. The next run lies in the intervals by held-out scatter, and not in confidence
    intervals. These are about what all runs have in common: the estimates from very many."""
    rng, T, sets, sigma = np.random.default_rng(3), 8, 100, 0.003

    def fitted(n):
        push, x = rubbing(n, rng)
        trials = [
            Trial(t, {"x": y + sigma * rng.normal(size=t.size)}, {"push": u}, sigma=sigma, initial={"x": 0, "x_dot": 0})
            for u, y in zip(push, x, strict=True)
        ]
        options = {"unknown": ("x_dot",), "simulation": Simulation(step=0.1)}
        return minimize(Problem.of(Track(), trials, ("gain", "drift"), **options), LeastSquares(damping=1e-9))

    many = fitted(800).estimates
    hits = dict.fromkeys(("next run by scatter", "next run by confidence", "clustered", "bootstrap"), 0.0)
    for _ in range(sets):
        found, following = fitted(T), fitted(1).estimates
        scatter, confidence = cross_validate(found, T).intervals(), found.intervals()
        percentiles = bootstrap(found, n=500).intervals()
        for name, value in many.items():
            for which, (low, high), at in (
                ("next run by scatter", scatter[name], following[name]),
                ("next run by confidence", confidence[name], following[name]),
                ("clustered", confidence[name], value),
                ("bootstrap", percentiles[name], value),
            ):
                hits[which] += (low <= at <= high) / sets / 2
    assert found.uses_clustered_errors
    assert 0.9 <= hits["next run by scatter"] <= 0.99, hits
    assert hits["next run by confidence"] < 0.75, hits
    assert 0.88 <= hits["clustered"] <= 0.99, hits
    assert 0.85 <= hits["bootstrap"] <= 0.99, hits


def test_the_bootstrap_of_many_trials_scatters_as_the_jackknife():
    rng = np.random.default_rng(5)
    trials = [trial(k, correlated, 1.0, rng) for k in range(60)]
    options = {"unknown": ("x_dot",), "simulation": Simulation(step=0.1)}
    problem = Problem.of(Track(), trials, (Free("gain", prior=(1.2, 0.05)), "drift"), **options)
    found = minimize(problem, LeastSquares(damping=1e-9))
    draws = bootstrap(found, n=4000)
    assert draws.clusters == ("trial", 60)
    for name, error in found.clustered_errors.items():
        assert np.std(draws.values[name]) == pytest.approx(error, rel=0.12)
        assert np.mean(draws.values[name]) == pytest.approx(found.estimates[name], abs=0.2 * error)
        np.testing.assert_allclose(draws.intervals()[name], found.intervals()[name], atol=0.5 * error)
    again = bootstrap(found, n=4000)
    np.testing.assert_array_equal(again.values["gain"], draws.values["gain"])
    assert "Bootstrap of 60 trials" in repr(draws)
    with pytest.raises(ValueError, match="3 trials say nothing of how 2 parameters scatter"):
        bootstrap(minimize(problem.with_trials(trials[:3]), LeastSquares()))


def test_intervals_by_scatter_are_those_of_a_mean():
    """With one parameter and trials alike, each trial has an estimate of its own, and that of all is their mean."""
    rng, T = np.random.default_rng(6), 5
    push = np.sin(2.0 * t)
    steps = np.array([(2 * push[i] + push[i + 1]) / 6 for i in range(t.size - 1)])
    v = np.concatenate([[0.0], np.cumsum((push[1:] + push[:-1]) / 2 * 0.1)])
    y = np.concatenate([[0.0], np.cumsum(v[:-1] * 0.1 + steps * 0.01)])
    own = 1.2 + 0.1 * rng.normal(size=T)
    trials = [Trial(t, {"x": g * y}, {"push": push}, sigma=0.01, initial={"x": 0.0, "x_dot": 0.0}) for g in own]
    problem = Problem.of(Track(), trials, "gain", simulation=Simulation(step=0.1))
    low, high = cross_validate(minimize(problem, LeastSquares(damping=1e-9))).intervals(0.9)["gain"]
    half = stats.t.ppf(0.95, T - 1) * np.std(own, ddof=1) * (1 + 1 / T) ** 0.5
    assert (low, high) == pytest.approx((own.mean() - half, own.mean() + half), abs=1e-6)


def test_what_the_data_do_not_determine_has_no_narrow_interval():
    """Without a push its gain has no influence: infinite, or as wide as its prior says."""
    rng = np.random.default_rng(7)
    trials = [
        Trial(t, x.measured, {"push": 0.0 * t}, sigma=SIGMA) for x in (trial(k, white, 1.0, rng) for k in range(6))
    ]
    options = {"unknown": ("x_dot",), "simulation": Simulation(step=0.1)}
    found = minimize(Problem.of(Track(), trials, ("gain", "drift"), **options), LeastSquares(damping=1e-9))
    for intervals in (found.intervals(), bootstrap(found).intervals(), cross_validate(found).intervals()):
        assert intervals["gain"] == (-np.inf, np.inf)
        assert np.isfinite(intervals["drift"]).all()
    known = (Free("gain", prior=(1.2, 0.1)), "drift")
    found = minimize(Problem.of(Track(), trials, known, **options), LeastSquares(damping=1e-9))
    assert np.std(bootstrap(found).values["gain"]) == pytest.approx(0.1, rel=0.05)
    for wrong in (0, -1, 99, 2.5, True, "many"):
        with pytest.raises(ValueError, match="whole number of draws"):
            bootstrap(found, n=wrong)
    with pytest.raises(ValueError, match="parameters of another fit"):
        bootstrap(validate(found, trials))
    assert np.isnan(cross_validate(validate(found, trials)).intervals()["drift"]).all()
    with pytest.raises(ValueError, match="`start` is of another problem"):
        minimize(found.problem, LeastSquares(), start=validate(found, trials[:4]).point)
