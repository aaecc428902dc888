"""Error models against statsmodels, dense likelihoods and scipy: autoregressive, Student's t and Huber's errors."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy import stats
from systems import SETS, Track, coverage_band, responses

from jaxkane.fit import (
    AutoRegressive,
    Free,
    Huber,
    LeastSquares,
    Problem,
    Simulation,
    StudentT,
    Trial,
    cross_validate,
    fit,
    forward_selection,
    load,
    minimize,
    profile,
    report,
    validate,
)
from jaxkane.fit.problem.errors import Errors, innovations

t = np.arange(0.0, 4.0, 0.1)
SIGMA, TRUTH = 0.05, (1.2, 0.3)
REST = {"x": 0.0, "x_dot": 0.0}
STEP = {"simulation": Simulation(step=0.1)}
FREE = ("gain", "drift")


def autoregression(rng, phi, n=t.size):
    e = rng.normal(size=n + 200)
    for i in range(2, n + 200):
        e[i] += phi[0] * e[i - 1] + phi[1] * e[i - 2]
    return e[200:]


def trials(noise, T=3, sigma=SIGMA):
    """Of noise by channel: functions from the number of a trial to samples (n_t,) in units of 0.05."""
    made = []
    for k in range(T):
        push = np.sin((1.5 + 0.4 * k) * t + k)
        of = dict(zip(("x", "x_dot"), responses(t, push), strict=True))
        measured = {c: of[c] @ TRUTH + 0.05 * e(k) for c, e in noise.items()}
        made.append(Trial(t, measured, {"push": push}, sigma=sigma, initial=REST))
    return made


def covariance(phi, n=t.size):
    """Of a stationary autoregression with innovations of variance one (n, n), from its infinite moving average."""
    psi = np.zeros(500)
    psi[0], psi[1] = 1.0, phi[0]
    for i in range(2, psi.size):
        psi[i] = phi[0] * psi[i - 1] + phi[1] * psi[i - 2]
    gamma = np.array([psi[: psi.size - k] @ psi[k:] for k in range(n)])
    return gamma[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]


PHI_1, PHI_2 = (0.8, 0.0), (1.2, -0.5)


@pytest.fixture(scope="module")
def of_two_channels():
    """x with AR(1) errors and gaps, x_dot with Student's t: both with scales that `sigma` does not know."""
    rng = np.random.default_rng(0)
    walks, tails = [autoregression(rng, PHI_1) for _ in range(3)], rng.standard_t(3, size=(3, t.size))
    for walk in walks[:2]:
        walk[[7, 8, 20]] = np.nan
    data = trials({"x": lambda k: 0.5 * walks[k], "x_dot": lambda k: 2.0 * tails[k]})
    return fit(Track(), data, FREE, errors={"x": AutoRegressive(), "x_dot": StudentT()}, **STEP)


@pytest.fixture(scope="module")
def of_second_order():
    rng = np.random.default_rng(1)
    walks = [autoregression(rng, PHI_2) for _ in range(2)]
    walks[0][[5, 6, 7, 15]] = np.nan
    data = trials({"x": lambda k: walks[k]}, T=2)
    return fit(Track(), data, FREE, errors=AutoRegressive(order=2), **STEP)


@pytest.fixture(scope="module")
def of_huber():
    rng = np.random.default_rng(2)
    e = np.where(rng.random((3, t.size)) < 0.1, 15.0, 1.0) * rng.normal(size=(3, t.size))
    return fit(Track(), trials({"x": lambda k: e[k]}), FREE, errors=Huber(), **STEP)


def minus_twice(problem, theta):
    """-2 log likelihood of gain, drift and, of x, log scale and phi; of x_dot, log scale and log degrees of freedom:
    dense, by SciPy."""
    (gain, drift, log_s, phi), more, total = theta[:4], theta[4:], 0.0
    for trial in problem.trials:
        of = dict(zip(("x", "x_dot"), responses(t, trial.inputs["push"]), strict=True))
        e = {c: trial.measured[c] - of[c] @ (gain, drift) for c in trial.measured}
        seen = np.isfinite(e["x"])
        C = np.exp(2 * log_s) * SIGMA**2 * scipy.linalg.toeplitz(phi ** np.arange(t.size)) / (1 - phi**2)
        C = C[np.ix_(seen, seen)]
        total += stats.multivariate_normal.logpdf(e["x"][seen], cov=C)
        total += np.sum(stats.t.logpdf(e["x_dot"], np.exp(more[1]), scale=np.exp(more[0]) * SIGMA))
    return -2 * total


def numbers_of(found):
    """Estimates as `minus_twice` takes them."""
    x, v = (found.measurement_errors[c] for c in ("x", "x_dot"))
    logs = np.log([x["scale"], v["scale"], v["degrees of freedom"]])
    return np.array([*found.estimates.values(), logs[0], x["phi_1"], *logs[1:]])


@pytest.mark.parametrize("phi", [(0.9, 0.0), (-0.5, 0.3), (1.6, -0.8)])
def test_innovations_are_those_of_the_dense_covariance(phi):
    e, n = np.random.default_rng(3).normal(size=14), 14
    seen = np.ones(n, bool)
    seen[[0, 4, 5, 9, 13]] = False
    L = np.linalg.cholesky(covariance(phi, n)[np.ix_(seen, seen)])
    u, log_variance = innovations(jnp.array(phi), jnp.asarray(np.where(seen, e, 0.0)), jnp.asarray(seen))
    assert np.asarray(u)[seen] == pytest.approx(np.linalg.solve(L, e[seen]), rel=1e-9)
    assert np.asarray(log_variance)[seen] == pytest.approx(2 * np.log(L.diagonal()), rel=1e-9, abs=1e-9)
    assert not np.any(np.asarray([u, log_variance])[:, ~seen])


@pytest.mark.weekly
def test_two_channels_against_a_direct_likelihood(of_two_channels):
    found, theta = of_two_channels, numbers_of(of_two_channels)
    assert found.ok
    assert found.cost == pytest.approx(minus_twice(found.problem, theta), rel=1e-10)
    assert found.history[-1] == found.cost < found.history[1]
    best = theta + 1e-3
    for _ in range(3):  # Newton by differences: no line search is as exact as the sum of 240 logarithms
        h = 1e-4 * np.eye(6)
        f = lambda step, at=best: minus_twice(found.problem, at + step)  # noqa: E731
        g = np.array([(f(a) - f(-a)) / 2e-4 for a in h])
        H = [[(f(a + b) - f(a - b) - f(b - a) + f(-a - b)) / 4e-8 for a in h] for b in h]
        best = best - np.linalg.solve(H, g)
    assert theta == pytest.approx(best, rel=1e-6, abs=1e-6)


@pytest.mark.weekly
def test_autoregression_against_statsmodels(of_second_order):
    api, arima = pytest.importorskip("statsmodels.api"), pytest.importorskip("statsmodels.tsa.arima.model")
    found, numbers, total = of_second_order, of_second_order.measurement_errors["x"], 0.0
    phi = numbers["phi_1"], numbers["phi_2"]
    rows, y, blocks = [], [], []
    for trial in found.problem.trials:
        X, measured = responses(t, trial.inputs["push"])[0], trial.measured["x"]
        model = arima.ARIMA(measured, exog=X, order=(2, 0, 0), trend="n")
        total += model.loglike([*found.estimates.values(), *phi, (numbers["scale"] * SIGMA) ** 2])
        seen = np.isfinite(measured)
        rows, y = [*rows, X[seen]], [*y, measured[seen]]
        blocks.append(covariance(phi)[np.ix_(seen, seen)])
    assert found.cost == pytest.approx(-2 * total, rel=1e-8)
    n = sum(map(len, y))
    gls = api.GLS(np.concatenate(y), np.concatenate(rows), sigma=scipy.linalg.block_diag(*blocks)).fit()
    assert [*found.estimates.values()] == pytest.approx(gls.params, rel=1e-6)
    # The three numbers of the error model count as unknowns too.
    assert found.problem.size == (n, 5)
    assert [*found.standard_errors.values()] == pytest.approx(gls.bse * ((n - 2) / (n - 5)) ** 0.5, rel=1e-6)
    assert found.identifiability.degrees_of_freedom == pytest.approx(n - 5)


@pytest.mark.weekly
def test_huber_against_statsmodels(of_huber):
    api = pytest.importorskip("statsmodels.api")
    found, trials = of_huber, of_huber.problem.trials
    X = np.concatenate([responses(t, trial.inputs["push"])[0] for trial in trials])
    y = np.concatenate([trial.measured["x"] for trial in trials])
    robust = api.RLM(y, X, M=api.robust.norms.HuberT(1.345)).fit(tol=1e-13, maxiter=500)
    assert found.ok
    assert [*found.estimates.values()] == pytest.approx(robust.params, rel=1e-6)
    assert found.measurement_errors["x"]["scale"] * SIGMA == pytest.approx(robust.scale, rel=1e-6)
    # Huber's sandwich, with degrees of freedom less that of the scale and without Huber's factor.
    u = (y - X @ robust.params) / robust.scale
    psi, inside = np.clip(u, -1.345, 1.345), np.mean(np.abs(u) <= 1.345)
    C = robust.scale**2 * np.sum(psi**2) / (y.size - 3) / inside**2 * np.linalg.inv(X.T @ X)
    assert [*found.standard_errors.values()] == pytest.approx(C.diagonal() ** 0.5, rel=1e-6)
    assert found.standard_errors["gain"] == pytest.approx(robust.bse[0], rel=0.02)
    assert found.variance == pytest.approx(y.size / (y.size - 3))
    # The density of this loss integrates to one.
    n, loss = found.problem.model.errors.numbers, -0.5 * found.cost
    s, c = (float(x[0]) for x in (n.scale, n.shape))
    density = lambda e: np.exp(-np.where(np.abs(e / s) < c, (e / s) ** 2 / 2, c * np.abs(e / s) - c**2 / 2))  # noqa: E731
    e = np.linspace(-60 * s, 60 * s, 240_001)
    of_all = np.log(density((y - X @ robust.params) / SIGMA) / SIGMA / np.trapezoid(density(e), e)).sum()
    assert loss == pytest.approx(of_all, rel=1e-6)


@pytest.mark.weekly
def test_estimates_do_not_depend_on_sigma_if_scales_are_estimated(of_two_channels):
    """A `sigma` that is wrong by another factor in each channel changes nothing."""
    found = of_two_channels
    sigma = {"x": 100 * SIGMA, "x_dot": 0.01 * SIGMA}
    data = [Trial(t, one.measured, one.inputs, sigma=sigma, initial=REST) for one in found.problem.trials]
    other = fit(Track(), data, FREE, errors={"x": AutoRegressive(), "x_dot": StudentT()}, **STEP)
    assert other.estimates == pytest.approx(found.estimates, rel=1e-6)
    assert other.standard_errors == pytest.approx(found.standard_errors, rel=1e-5)
    assert other.cost == pytest.approx(found.cost, rel=1e-8)
    scales = [one["scale"] for one in other.measurement_errors.values()]
    assert scales == pytest.approx([0.01 * 0.5, 200.0], rel=0.5)


@pytest.mark.weekly
def test_without_error_models_only_scales_are_estimated(of_second_order):
    problem = of_second_order.problem
    found = fit(Track(), problem.trials, FREE, errors={}, **STEP)
    X = np.concatenate([responses(t, trial.inputs["push"])[0] for trial in problem.trials])
    y = np.concatenate([trial.measured["x"] for trial in problem.trials])
    seen = np.isfinite(y)
    x, square, *_ = np.linalg.lstsq(X[seen], y[seen])
    n, s = seen.sum(), (square[0] / seen.sum()) ** 0.5
    assert [*found.estimates.values()] == pytest.approx(x, rel=1e-6)
    assert found.measurement_errors == {"x": {"scale": pytest.approx(s / SIGMA, rel=1e-8)}}
    assert found.cost == pytest.approx(n * (1 + np.log(2 * np.pi * s**2)), rel=1e-8)
    assert found.aic == pytest.approx(found.cost + 2 * 3)
    assert found.bic == pytest.approx(found.cost + 3 * np.log(n))
    assert of_second_order.aic < found.aic
    assert of_second_order.bic < found.bic
    # Without `errors` they are of the likelihood with the given sigma.
    plain = fit(Track(), problem.trials, FREE, **STEP)
    assert plain.aic == pytest.approx(plain.cost + n * np.log(2 * np.pi * SIGMA**2) + 2 * 2)
    assert plain.measurement_errors == {}


@pytest.mark.weekly
def test_residual_tests_and_notes_use_innovations(of_second_order):
    found = of_second_order
    plain = fit(Track(), found.problem.trials, FREE, **STEP)
    assert plain.autocorrelation > 0.6
    assert abs(found.autocorrelation) < 0.2
    assert any("not white noise" in note for note in plain.notes)
    assert not any("not white noise" in note for note in found.notes)
    assert found.clusters[0] == "part"
    test = next(iter(found.tests.values()))["x"]
    assert test.is_white
    assert test.rms == pytest.approx(1.0, abs=0.3)
    first = next(iter(found.residuals.values()))["x"]
    assert np.array_equal(np.isnan(first), np.isnan(found.problem.trials[0].measured["x"]))
    assert found.standard_errors["gain"] > plain.standard_errors["gain"]
    assert "AR(2) (scale" in str(found)
    assert "phi_2" in report(found)


@pytest.mark.weekly
def test_the_evidence_equals_the_marginal_density_of_the_measurements():
    """Linear in the start, with a Gaussian prior: the dense marginal density, given the estimated numbers."""
    rng = np.random.default_rng(5)
    data = trials({"x": lambda k: autoregression(rng, PHI_1)}, T=2)
    free = [Free("gain", prior=(1.1, 0.2))]
    found = fit(Track(drift=0.3), data, free, unknown={"x": 0.1}, errors=AutoRegressive(), **STEP)
    numbers, given, total = found.measurement_errors["x"], 0.0, 0.0
    C = (numbers["scale"] * SIGMA) ** 2 * covariance((numbers["phi_1"], 0.0)) + 0.1**2
    X = [responses(t, trial.inputs["push"])[0] for trial in data]
    for trial, A in zip(data, X, strict=True):
        e = trial.measured["x"] - A @ (found.estimates["gain"], 0.3)
        given += stats.multivariate_normal.logpdf(e, cov=C)
    assert found.marginal_likelihood() == pytest.approx(given, rel=1e-7)
    z = np.zeros_like(C)
    cov = np.block([[C, z], [z, C]]) + 0.2**2 * np.outer(*2 * [np.concatenate([A[:, 0] for A in X])])
    y = np.concatenate([trial.measured["x"] - A @ (1.1, 0.3) for trial, A in zip(data, X, strict=True)])
    total = stats.multivariate_normal.logpdf(y, cov=cov)
    assert found.laplace().log_evidence == pytest.approx(total, rel=1e-7)
    # Priors are no part of the criteria.
    starts = np.array([one["start of x"][0] for one in found.nuisance.values()])
    pure = found.cost - np.sum((starts / 0.1) ** 2) - ((found.estimates["gain"] - 1.1) / 0.2) ** 2
    assert found.aic == pytest.approx(pure + 2 * 5)


def test_save_load_and_resume(of_two_channels, tmp_path):
    found = of_two_channels
    posed = Problem.of(Track(), found.problem.trials, FREE, errors={"x": AutoRegressive(), "x_dot": StudentT()}, **STEP)
    again = load(found.save(tmp_path / "fit.npz"), posed)
    assert again.cost == found.cost
    assert again.measurement_errors == found.measurement_errors
    assert again.intervals() == found.intervals()
    assert str(again) == str(found)
    other = Problem.of(Track(), found.problem.trials, FREE, errors={"x": AutoRegressive()}, **STEP)
    with pytest.raises(ValueError, match="error models"):
        load(tmp_path / "fit.npz", other)
    first = minimize(posed, LeastSquares(), checkpoint=tmp_path / "state.npz")
    resumed = minimize(posed, LeastSquares(), checkpoint=tmp_path / "state.npz")
    assert first.estimates == pytest.approx(resumed.estimates, rel=1e-7) == found.estimates


@pytest.mark.slow
def test_a_fit_continues_from_its_error_model_parameters(of_two_channels):
    found = of_two_channels
    again = minimize(found.problem, LeastSquares(), start=found.point)
    assert len(again.history) <= 3
    assert again.cost == pytest.approx(found.cost, abs=1e-7)
    low, high = profile(found, "gain", n=5).interval
    # With the numbers of the error models estimated anew the profile is wider, but not by much.
    assert (low, high) == pytest.approx(found.intervals()["gain"], rel=0.03)


@pytest.mark.weekly
def test_held_out_trials_use_the_error_models_of_the_training_trials(of_two_channels):
    found = of_two_channels
    one = found.problem.trials[0]
    turned = Trial(t, dict(reversed(one.measured.items())), one.inputs, sigma=SIGMA, initial=REST)
    held = validate(found, [turned])
    assert held.measurement_errors == found.measurement_errors
    assert [*held.measurement_errors] == ["x_dot", "x"]
    assert held.cost == pytest.approx(minus_twice(held.problem, numbers_of(found)), rel=1e-8)
    left_out = cross_validate(found)
    assert left_out.held_out.sum() > left_out.fitted.sum() == pytest.approx(found.cost, rel=1e-6)
    assert left_out.cost_name == "-2 log likelihood"
    assert math.isnan(left_out.score)


@pytest.mark.weekly
def test_an_estimated_scale_is_not_reported_as_wrong():
    """With nearly as many unknown starts as residuals the ratio of residuals to degrees of freedom is far from one."""
    noise = np.random.default_rng(8).normal(size=(3, t.size))
    starts = {"window": 0.5, "unknown": ("x", "x_dot")}
    found = fit(Track(), trials({"x": lambda k: noise[k]}), FREE, errors={}, **starts, **STEP)
    assert found.variance > 1.6
    assert not any("as large as `sigma` says" in note for note in found.notes)


def test_the_likelihood_of_exact_measurements_is_bounded():
    data = trials({"x": lambda k: np.zeros(t.size)})
    found = fit(Track(), data, FREE, errors=Huber(), **STEP)
    assert found.estimates == pytest.approx(dict(zip(FREE, TRUTH, strict=True)), rel=1e-6)
    assert np.isfinite(found.cost)
    assert 0 < found.measurement_errors["x"]["scale"] < 1e-6


def test_ctrl_c_keeps_the_last_iterate(of_two_channels, monkeypatch):
    """The search with the first numbers has converged when the key comes."""
    problem, rounds = of_two_channels.problem.with_errors_of(None), []
    whole = Problem.linearize

    def linearize(self, point):
        if self.model.errors.numbers.phi[0, 0] != 0:
            rounds.append(point)
            if len(rounds) > 4:
                raise KeyboardInterrupt
        return whole(self, point)

    monkeypatch.setattr(Problem, "linearize", linearize)
    found = minimize(problem, LeastSquares())
    assert found.status == "interrupted"
    assert found.measurement_errors["x"]["phi_1"] > 0.5
    assert found.cost == found.history[-1]


CHAIN = {"window": 1.0, "unknown": ("x",), "defect_std": {"x": 1.0}}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: posed({"y": Huber()}), "`errors` contains unknown channels: y"),
        (lambda: posed({"x": "huber"}), "Pass AutoRegressive"),
        (lambda: posed(AutoRegressive(), noise={}), "either `errors` or `noise`, not both"),
        (lambda: posed(AutoRegressive(), **CHAIN), "either `errors` or `defect_std`"),
        (lambda: AutoRegressive(3), "Pass"),
        (lambda: StudentT(0.5), "Pass|must be positive"),
        (lambda: StudentT(math.inf), "Pass|must be positive"),
        (lambda: Huber(0.0), "Pass|must be positive"),
    ],
)
def test_invalid_error_models_are_rejected(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


@pytest.mark.weekly
def test_error_model_parameters_estimated_from_known_residuals():
    """Of one channel each: given degrees of freedom, normal residuals, a random walk, and a channel without samples."""
    rng = np.random.default_rng(9)
    walk = np.cumsum(rng.normal(size=(2, 150)), axis=1)
    e = np.stack([rng.standard_t(4, size=(2, 150)), rng.uniform(-1, 1, (2, 150)), walk, 0 * walk], axis=1)
    weight = np.broadcast_to(np.array([1.0, 1.0, 1.0, 0.0])[:, None], e.shape)
    models = [StudentT(4.0), StudentT(), AutoRegressive(), AutoRegressive()]
    found = Errors.initial(models).estimated(e, weight, np.full(4, 1e-9))
    given, normal, walked, missing = found.values
    u = e[:, 0] / given["scale"]
    assert given["degrees of freedom"] == 4.0
    assert np.mean(5 * u**2 / (4 + u**2)) == pytest.approx(1.0, rel=1e-8)  # the score of the scale
    assert normal["degrees of freedom"] > 1000  # the tails are lighter than those of a normal distribution
    assert normal["scale"] == pytest.approx(np.sqrt(np.mean(e[:, 1] ** 2)), rel=1e-2)
    assert 0.9 < walked["phi_1"] < 1
    assert missing == {"scale": 1.0, "phi_1": 0.0}
    assert found.n_estimated == 1 + 2 + 2 + 2


def posed(errors, **more):
    return Problem.of(Track(), trials({"x": lambda k: np.zeros(t.size)}, T=1), FREE, errors=errors, **STEP, **more)


def test_an_autoregression_needs_equal_intervals():
    data = trials({"x": lambda k: np.zeros(t.size)}, T=2)
    kept, one = np.delete(np.arange(t.size), 12), data[1]
    measured, push = {"x": one.measured["x"][kept]}, {"push": one.inputs["push"][kept]}
    data[1] = Trial(t[kept], measured, push, sigma=SIGMA, initial=REST)
    with pytest.raises(ValueError, match=r"t = 1\.1 s and 1\.3 s are not 0\.1 s apart"):
        Problem.of(Track(), data, FREE, errors=AutoRegressive(), **STEP)
    Problem.of(Track(), data, FREE, errors=StudentT(), **STEP)


def test_the_search_does_not_continue_if_it_has_not_converged(of_two_channels):
    found = minimize(of_two_channels.problem.with_errors_of(None), LeastSquares(), steps=1)
    assert found.status == "steps"
    assert len(found.history) == 3
    assert found.measurement_errors["x"]["phi_1"] > 0.5
    with pytest.raises(ValueError, match="error models"):
        forward_selection(of_two_channels, ["drift"])


def outliers(rng, n):
    return np.where(rng.random(n) < 0.05, 10.0, 1.0) * rng.normal(size=n)


KINDS = {  # models by channel, and what makes their errors
    "AR(1) in one of two channels": {
        "x": (AutoRegressive(), lambda rng, n: autoregression(rng, (0.9, 0.0), n)),
        "x_dot": (AutoRegressive(0), lambda rng, n: 3.0 * rng.normal(size=n)),
    },
    "AR(2)": {"x": (AutoRegressive(2), lambda rng, n: autoregression(rng, (1.4, -0.6), n))},
    "Student's t": {"x": (StudentT(), lambda rng, n: rng.standard_t(3, size=n))},
    "outliers": {"x": (Huber(), outliers)},
}


@pytest.mark.weekly
@pytest.mark.parametrize("kind", KINDS)
def test_interval_coverage_with_error_models(kind):
    models, T = KINDS[kind], 6
    rng, hits = np.random.default_rng(7), 0.0
    posed = trials({c: lambda _: np.zeros(t.size) for c in models}, T=T)
    problem = Problem.of(Track(), posed, FREE, errors={c: model for c, (model, _) in models.items()}, **STEP)
    exact = np.asarray(problem.windows.measured)  # (T, n_c, n_t)
    for _ in range(SETS):
        e = np.array([[make(rng, t.size) for _, make in models.values()] for _ in range(T)])
        windows = dataclasses.replace(problem.windows, measured=jnp.asarray(exact + 0.05 * e))
        found = minimize(dataclasses.replace(problem, windows=windows), LeastSquares(damping=1e-9))
        assert found.status == "converged"
        ends = found.intervals().values()
        hits += sum(low <= truth <= high for (low, high), truth in zip(ends, TRUTH, strict=True)) / SETS / 2
    low, high = coverage_band(SETS)
    print(kind, hits)
    assert low <= hits <= high, hits
