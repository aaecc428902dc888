"""Parameters of groups of trials and their distributions, against likelihoods in closed form and statsmodels."""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats
from systems import Track, responses

from jaxkane.fit import (
    Free,
    Gain,
    LeastSquares,
    Offset,
    Problem,
    Simulation,
    Trial,
    cross_validate,
    fit,
    load,
    minimize,
    multi_start,
    validate,
)
from jaxkane.fit.result.statistics import degrees_of_freedom
from jaxkane.fit.solve.fit import solve

TIGHT = 1e-6
T = np.linspace(0.0, 2.0, 21)
RIDERS = ("anna", "ben", "cleo", "dan", "eva")
EXACT = {"simulation": Simulation(step=0.1), "optimizer": LeastSquares(rtol=1e-14, damping=1e-7)}


PUSHES = [np.sin((1.0 + 0.3 * k) * T + k) for k in range(10)]
RESPONSES = [responses(T, push)[0] for push in PUSHES]


def recorded(seed=0, deviation=0.3, noise=0.05):
    """Two trials of each rider, whose gains have a normal distribution about 1.2; `sigma` is half of the noise."""
    rng = np.random.default_rng(seed)
    gains = 1.2 + deviation * rng.normal(size=len(RIDERS))
    trials = []
    for k, (push, A) in enumerate(zip(PUSHES, RESPONSES, strict=True)):
        x = A @ [gains[k % 5], 0.4] + noise * rng.normal(size=T.size)
        known = {"initial": {"x": 0.0, "x_dot": 0.0}, "labels": {"rider": RIDERS[k % 5]}, "name": f"run {k}"}
        trials.append(Trial(T, {"x": x}, {"push": push}, sigma=0.025, **known))
    return trials


def columns(trials):
    """Measurements, the rider of each, and the columns of gain and drift."""
    y = np.concatenate([trial.measured["x"] for trial in trials])
    return y, np.repeat(np.arange(len(trials)) % 5, T.size), np.vstack(RESPONSES)


def restricted(data, log_ratio):
    """Minus twice the restricted log likelihood of y = X b + noise with a random gain of each rider, whose deviation is
    a multiple of the noise's; the estimates b, their errors, and the noise's deviation. By dense matrices."""
    y, rider, X = data
    Z = X[:, :1] * (rider[:, None] == np.arange(5))
    V = np.eye(len(y)) + np.exp(2 * log_ratio) * Z @ Z.T
    W = np.linalg.solve(V, X)
    b = np.linalg.solve(X.T @ W, W.T @ y)
    e, nu = y - X @ b, len(y) - 2
    square = e @ np.linalg.solve(V, e) / nu
    value = nu * np.log(square) + np.linalg.slogdet(V)[1] + np.linalg.slogdet(X.T @ W)[1]
    return value, b, np.sqrt(square * np.linalg.inv(X.T @ W).diagonal()), np.sqrt(square)


@pytest.fixture(scope="module")
def mixed():
    trials = recorded()
    return trials, fit(Track(), trials, (Free("gain", each="rider", prior="normal"), "drift"), **EXACT)


def test_a_distribution_over_groups_maximizes_the_restricted_likelihood(mixed):
    trials, found = mixed
    best = optimize.minimize_scalar(
        lambda x: restricted(columns(trials), x)[0], bracket=(0.0, 3.0), options={"xtol": 1e-12}
    )
    _, b, errors, noise = restricted(columns(trials), best.x)
    assert found.deviations["gain"] == pytest.approx(np.exp(best.x) * noise, rel=TIGHT)
    assert [found.estimates[n] for n in ("mean of gain", "drift")] == pytest.approx(b, rel=TIGHT)
    assert [found.standard_errors[n] for n in ("mean of gain", "drift")] == pytest.approx(errors, rel=TIGHT)
    assert found.variance**0.5 * 0.025 == pytest.approx(noise, rel=TIGHT)
    assert found.ok, found.message


def test_every_driver_estimates_the_deviation_of_groups(mixed):
    trials, found = mixed
    problem = Problem.of(
        Track(), trials, (Free("gain", each="rider", prior="normal"), "drift"), simulation=Simulation(step=0.1)
    )
    for other in (minimize(problem, LeastSquares(), start=found.point), multi_start(problem, 1, spread=0.0).best):
        assert other.deviations["gain"] == pytest.approx(found.deviations["gain"], rel=1e-3)
        assert other.estimates == pytest.approx(found.estimates, rel=1e-3)
    assert np.isnan([found.aic, found.bic]).all()  # the cost does not integrate out the groups


@pytest.mark.slow
def test_the_distribution_predicts_a_group_that_is_left_out(mixed):
    left_out = cross_validate(mixed[1], [[0, 5], [1, 2, 3, 4, 6, 7, 8, 9]])
    assert not left_out.failures
    assert np.all(np.isfinite(left_out.held_out))
    anna, mean = (left_out.estimates[name][0] for name in ("gain [anna]", "mean of gain"))
    assert anna == pytest.approx(mean, rel=1e-6)


@pytest.mark.weekly
def test_few_groups_give_few_degrees_of_freedom(mixed):
    """Satterthwaite's, by differences of the dense likelihood in the logarithms a of ratio and variance."""
    trials, found = mixed
    y, rider, X = columns(trials)
    Z = X[:, :1] * (rider[:, None] == np.arange(5))

    def of(a):
        V = np.exp(a[1]) * (np.eye(len(y)) + np.exp(2 * a[0]) * Z @ Z.T)
        C = np.linalg.inv(X.T @ np.linalg.solve(V, X))
        e = y - X @ C @ X.T @ np.linalg.solve(V, y)
        value = e @ np.linalg.solve(V, e) + np.linalg.slogdet(V)[1] - np.linalg.slogdet(C)[1]
        return np.append(value, C.diagonal())

    noise = found.variance**0.5 * 0.025
    best = np.log([found.deviations["gain"] / noise, noise**2])
    h = 1e-3 * np.eye(2)
    slopes = np.array([(of(best + d) - of(best - d)) / 2e-3 for d in h])[:, 1:]
    hessian = [
        [np.sum([i * j * of(best + i * a + j * b)[0] for i in (1, -1) for j in (1, -1)]) / 4e-6 for b in h] for a in h
    ]
    variance = of(best)[1:]
    expected = 2 * variance**2 / np.einsum("ap,ab,bp->p", slopes, 2 * np.linalg.inv(hessian), slopes)
    own = degrees_of_freedom(found.problem, found.point, found.linearization)
    places = [found.names.index(name) for name in ("mean of gain", "drift")]
    assert own[places] == pytest.approx(np.minimum(expected, len(y) - 2), rel=1e-3)
    assert own[places][0] < 4.5  # of five riders
    low, high = found.intervals()["mean of gain"]
    assert (high - low) / 2 == pytest.approx(
        stats.t.ppf(0.975, own[places[0]]) * found.standard_errors["mean of gain"], rel=1e-9
    )


@pytest.mark.filterwarnings("ignore")  # of statsmodels
def test_a_distribution_over_groups_agrees_with_statsmodels(mixed):
    models = pytest.importorskip("statsmodels.regression.mixed_linear_model")
    trials, found = mixed
    y, rider, X = columns(trials)
    other = models.MixedLM(y, X, rider, exog_re=X[:, :1]).fit(reml=True, gtol=1e-12, method=["bfgs"])
    assert found.deviations["gain"] == pytest.approx(float(other.cov_re[0, 0]) ** 0.5, rel=TIGHT)
    assert [found.estimates[n] for n in ("mean of gain", "drift")] == pytest.approx(other.fe_params, rel=TIGHT)
    effects = [other.random_effects[k].item() + other.fe_params[0] for k in range(5)]
    assert [found.estimates[f"gain [{r}]"] for r in RIDERS] == pytest.approx(effects, rel=TIGHT)


@pytest.mark.weekly
def test_groups_without_a_distribution_equal_separate_fits():
    trials = recorded(1)
    found = fit(Track(), trials, Free("gain", each="rider"), **EXACT)
    assert found.names == tuple(f"gain [{rider}]" for rider in RIDERS)
    y, rider, X = columns(trials)
    for k, name in enumerate(RIDERS):
        own, seen = X[rider == k, 0], y[rider == k]
        assert found.estimates[f"gain [{name}]"] == pytest.approx(own @ seen / (own @ own), rel=TIGHT)
        assert float(found.systems[f"run {k}"].gain) == found.estimates[f"gain [{name}]"]
    with pytest.raises(ValueError, match=r"has a different value in each group of trials.* Use fit.systems\[trial\]"):
        _ = found.system
    with pytest.raises(ValueError, match=r"other belongs to none of the groups of gain \[anna\], gain"):
        validate(found, Trial(T, {"x": T}, sigma=0.1, labels={"rider": "fay"}, name="other"))
    alone = fit(Track(), trials[:3], (Free("gain", each="trial"), "drift"), **EXACT)
    assert alone.names == ("gain [run 0]", "gain [run 1]", "gain [run 2]", "drift")


def test_new_groups_use_the_mean_and_a_file_keeps_the_deviation(mixed, tmp_path):
    trials, found = mixed
    new = Trial(T, trials[0].measured, trials[0].inputs, sigma=0.025, initial={"x": 0.0, "x_dot": 0.0},
                labels={"rider": "fay"}, name="new")  # fmt: skip
    predicted = validate(found, new).fitted["new"]["x"]
    expected = RESPONSES[0] @ [found.estimates["mean of gain"], found.estimates["drift"]]
    np.testing.assert_allclose(predicted, expected, atol=1e-9)
    assert float(found.system.gain) == found.estimates["mean of gain"]
    path = found.save(tmp_path / "fit.npz")
    again = load(path, Problem.of(Track(), trials, found.problem.specification.free, simulation=EXACT["simulation"]))
    assert again.deviations == found.deviations
    assert again.standard_errors == found.standard_errors


def test_groups_without_differences_have_a_deviation_near_zero():
    trials = recorded(2, deviation=0.0)
    found = fit(Track(), trials, (Free("gain", each="rider", prior="normal"), "drift"), **EXACT)
    y, _, X = columns(trials)
    assert restricted(columns(trials), -12.0)[0] < restricted(columns(trials), -1.0)[0]
    assert found.deviations["gain"] < 1e-2 * found.standard_errors["mean of gain"]
    pooled = np.linalg.lstsq(X, y, rcond=None)[0]
    assert [found.estimates[n] for n in ("mean of gain", "drift")] == pytest.approx(pooled, rel=1e-4)
    assert any("the groups differ by no more than their errors" in note for note in found.notes)
    assert any("the standard deviation of 5 groups is uncertain" in note for note in found.notes)


@pytest.mark.weekly
def test_a_log_normal_distribution_equals_that_of_the_linearized_model():
    trials = recorded(5, deviation=0.2)
    free = (Free("gain", bounds=(0.0, None), each="rider", prior="lognormal"), "drift")
    found = fit(Track(), trials, free, **EXACT)
    y, rider, X = columns(trials)
    own = np.array([found.estimates[f"gain [{name}]"] for name in RIDERS])[rider]
    column = X[:, 0] * own  # d y / d log gain
    data = y - X[:, 0] * own + column * np.log(own), rider, np.column_stack([column, X[:, 1]])
    best = optimize.minimize_scalar(lambda x: restricted(data, x)[0], bracket=(0.0, 3.0), options={"xtol": 1e-12})
    _, b, _, noise = restricted(data, best.x)
    assert found.deviations["gain"] == pytest.approx(np.exp(best.x) * noise, rel=1e-5)
    assert found.estimates["median of gain"] == pytest.approx(np.exp(b[0]), rel=1e-5)


@pytest.mark.slow
def test_one_offset_is_shared_by_two_channels():
    rng = np.random.default_rng(3)
    trials = []
    for k in range(3):
        seen = {"x": 0.2 * T**2 + 0.1 * k, "x_dot": 0.4 * T + 0.1 * k}
        seen = {name: y + 0.01 * rng.normal(size=T.size) for name, y in seen.items()}
        trials.append(Trial(T, seen, sigma=0.01, initial={"x": 0.0, "x_dot": 0.0}, name=str(k)))
    found = fit(Track(), trials, ("drift", Offset(("x", "x_dot"), each="trial")), **EXACT)
    A = np.concatenate([T**2 / 2, T])
    rows = np.kron(np.eye(3), np.ones((2 * T.size, 1)))
    y = np.concatenate([np.concatenate([*trial.measured.values()]) for trial in trials])
    best = np.linalg.lstsq(np.column_stack([np.tile(A, 3), rows]), y, rcond=None)[0]
    assert found.estimates["drift"] == pytest.approx(best[0], rel=TIGHT)
    assert [v["offset of x, x_dot"] for v in found.nuisance.values()] == pytest.approx(best[1:], rel=TIGHT, abs=1e-7)


def test_gains_and_offsets_of_a_trial_combine_with_the_common_ones():
    free = ("gain", Gain("x"), Gain("x", each="trial", prior=(1.0, 0.1)), Offset("x", each="trial", prior=(0.2, 0.1)))
    problem = Problem.of(Track(), recorded()[:1], free, simulation=EXACT["simulation"])
    common = {("gain of sensor", "x"): 2.0}
    merged = problem.model.nuisance.with_local(common, np.array([0.5, 0.1]))
    assert {kind: float(value) for (kind, _), value in merged.items()} == pytest.approx(
        {"gain of sensor": 3.0, "offset of sensor": 0.3}
    )


@pytest.mark.weekly
def test_offsets_per_window_equal_offsets_of_trials_of_one_window():
    tolerance = 1e-6  # the end of the iterations differs by 1e-8 between processors
    rng, trials = np.random.default_rng(5), []
    for push, A in zip(PUSHES[:2], RESPONSES, strict=False):
        x = A @ [1.2, 0.4]
        y = 1.1 * x + np.where(T < 1.0, 0.1, -0.2) + 0.02 * rng.normal(size=T.size)
        trials.append(Trial(T, {"x": y}, {"push": push}, sigma=0.02, initial={"x": x}, name=f"run {len(trials)}"))

    def free(each):
        return "gain", Offset("x", each=each, prior=(0.05, 0.3)), Gain("x", each=each, prior=(1.0, 0.2))

    found = fit(Track(), trials, free("window"), unknown=("x_dot",), window=1.0, **EXACT)
    parts = [trials[k].between(T[i], T[i + n - 1]) for k, i, n in found.problem.slices]
    alone = fit(Track(), parts, free("trial"), unknown=("x_dot",), **EXACT)
    assert len(parts) == 4
    assert found.problem.size == alone.problem.size
    for name in ("estimates", "standard_errors"):
        assert getattr(found, name) == pytest.approx(getattr(alone, name), rel=tolerance)
    assert found.cost == pytest.approx(alone.cost, rel=tolerance)
    assert found.marginal_likelihood() == pytest.approx(alone.marginal_likelihood(), rel=tolerance)
    for name in ("offset of x", "gain of x", "start of x_dot"):
        of_windows = np.concatenate([found.nuisance[trial.name][name] for trial in trials])
        np.testing.assert_allclose(of_windows, np.ravel([x[name] for x in alone.nuisance.values()]), rtol=tolerance)
    again = validate(found, trials)
    assert again.cost == pytest.approx(found.cost, rel=1e-6)
    for options in ({"noise": {"x_dot": 0.1}}, {"window": 1.0, "defect_std": {}}):
        with pytest.raises(ValueError, match="offset of x: each='window' is not supported together with"):
            Problem.of(Track(), trials, free("window"), unknown=("x_dot",), **options)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (Free("gain", each="window"), "each='window' is possible only for .* Cut the trials"),
        (Free("gain", each="bike"), "run 0: the label 'bike' is missing"),
        (Free("gain", prior="normal"), "is a distribution over groups, but the parameter has no groups"),
        (Free("gain", each="rider", prior="gamma"), "'normal' or 'lognormal', got 'gamma'"),
        (Free("drift", each="rider", prior="lognormal"), "a log-normal prior needs a positive parameter"),
        (Free("drift", prior=("lognormal", 1.0, 0.1)), "a log-normal prior needs a positive parameter"),
        (Free("gain", bounds=(0.0, None), prior=("lognormal", 1.0, -0.1)), "`prior` must be"),
    ],
)
def test_invalid_groups_are_rejected(item, message):
    with pytest.raises(ValueError, match=message):
        Problem.of(Track(), recorded(), item, simulation=EXACT["simulation"])
    with pytest.raises(ValueError, match="a distribution needs at least three groups, but 'rider' has 2"):
        Problem.of(Track(), recorded()[:2], Free("gain", each="rider", prior="normal"), simulation=EXACT["simulation"])


@pytest.mark.slow
def test_a_log_normal_prior():
    trials = recorded(4)[:1]
    free = (Free("gain", bounds=(0.0, None), prior=("lognormal", 1.0, 0.05)),)
    found = fit(Track(drift=0.4), trials, free, **EXACT)
    A, y = RESPONSES[0], trials[0].measured["x"]

    def cost(gain):
        return np.sum(((A @ [gain, 0.4] - y) / 0.025) ** 2) + (math.log(gain) / 0.05) ** 2

    best = optimize.minimize_scalar(cost, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-10})
    assert found.estimates["gain"] == pytest.approx(best.x, rel=1e-6)
    assert found.cost == pytest.approx(best.fun, rel=1e-9)


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("prior", "deviation", "least"),
    [(None, 0.3, 0.95), ("normal", 0.3, 0.95), ("normal", 0.03, 0.80)],  # a note warns of the last case
    ids=["free", "wide", "narrow"],
)
def test_interval_coverage_with_groups(prior, deviation, least):
    """Of 100 sets, three standard deviations of a share of 0.95 are 0.066."""
    free = (Free("gain", each="rider", prior=prior), "drift")
    problem = Problem.of(Track(), recorded(), free, simulation=EXACT["simulation"])
    rng, hits = np.random.default_rng(7), {"gain": [], "mean of gain": [], "drift": []}
    for _ in range(100):
        gains = 1.2 + deviation * rng.normal(size=len(RIDERS))
        y = np.stack([A @ [gains[k % 5], 0.4] for k, A in enumerate(RESPONSES)])
        y = y + 0.05 * rng.normal(size=y.shape)
        windows = eqx.tree_at(lambda w: w.measured, problem.windows, jnp.asarray(y[:, None]))
        trials = tuple(Trial(T, {"x": x}, sigma=0.025) for x in y)  # of which residuals are taken
        found = solve(dataclasses.replace(problem, windows=windows, trials=trials), LeastSquares())
        truth = dict(zip((f"gain [{rider}]" for rider in RIDERS), gains, strict=True))
        truth |= {"mean of gain": 1.2, "drift": 0.4}
        for name, (low, high) in found.intervals().items():
            hits[name.partition(" [")[0]].append(low <= truth[name] <= high)
    for name, of_one in hits.items():
        assert not of_one or np.mean(of_one) > least - 0.066, (name, np.mean(of_one))
