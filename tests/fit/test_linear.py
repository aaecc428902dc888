"""What a fit reports, against linear least squares in closed form: every number is computed here a second time."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy import stats
from systems import Track, responses

from jaxkane.fit import (
    Free,
    LeastSquares,
    Offset,
    Problem,
    Trial,
    bootstrap,
    compare,
    cross_validate,
    fit,
    identifiability,
    minimize,
    profile,
    report,
    validate,
)
from jaxkane.fit.result.statistics import _freedom_of

TIGHT, METHOD = 1e-6, LeastSquares(rtol=1e-12)
t = np.arange(0.0, 4.0, 0.1)
N = 6
SIGMA = np.repeat([0.02, 0.05], t.size)  # of positions [m], then speeds [m/s], as all rows of a trial
PRIOR = (1.1, 0.01)  # of the gain
BIAS = 0.05  # [m], a deviation


PUSHES = [np.sin((1.5 + 0.3 * k) * t + k) for k in range(N)]
ONE, ZERO = np.ones_like(t), np.zeros_like(t)
OWN_COLUMNS = np.vstack([np.column_stack([ONE, t, ONE]), np.column_stack([ZERO, ONE, ZERO])])
COLUMNS = [np.hstack([np.vstack(responses(t, push)), OWN_COLUMNS]) for push in PUSHES]
"""(2 n_t, 5) of positions, then speeds, by gain, drift, start, speed and the position sensor's offset."""


def recorded(seed, wander=0.0):
    """Noise half as large again as `sigma`, a gap, and in every trial another drift, for which errors by trial are."""
    rng = np.random.default_rng(seed)
    records = []
    for k, C in enumerate(COLUMNS):
        unknowns = [1.2, 0.3 + wander * rng.normal(), 0.1 * k, -0.2, 0.03 * rng.normal()]
        records.append(C @ unknowns + 1.5 * SIGMA * rng.normal(size=SIGMA.size))
    records[2][10:15] = np.nan
    return records


def trials_of(records, **more):
    found = []
    for k, (y, push) in enumerate(zip(records, PUSHES, strict=False)):
        channels = {"x": y[: t.size], "x_dot": y[t.size :]}
        channels = dict(sorted(channels.items(), reverse=k % 2 == 0))  # in whatever order
        sigma = {"x_dot": SIGMA[-1], "x": SIGMA[0]}
        found.append(Trial(t, channels, {"push": push}, sigma=sigma, name=f"run {k}", **more))
    return found


def weighed(C, y):
    """Rows and right-hand sides in standard deviations, zero where there is a gap."""
    seen = np.isfinite(y)
    return np.where(seen[:, None], C / SIGMA[:, None], 0.0), np.where(seen, y, 0.0) / SIGMA


def dense(records, prior=PRIOR):
    """All rows and right-hand sides, in standard deviations.

    Unknowns: gain, drift; start, speed and sensor's offset of each trial.
    """
    A, y = [], []
    for k, (C, record) in enumerate(zip(COLUMNS, records, strict=True)):
        rows, values = weighed(C, record)
        seen = np.isfinite(record)
        own = np.zeros((seen.sum(), 3 * N))
        own[:, 3 * k : 3 * k + 3] = rows[seen, 2:]
        A.append(np.hstack([rows[seen, :2], own]))
        y.append(values[seen])
    A, y = np.vstack(A), np.concatenate(y)
    of_bias = np.eye(A.shape[1])[4::3] / BIAS
    of_gain = np.eye(1, A.shape[1]) / prior[1]
    return np.vstack([A, of_bias, of_gain]), np.concatenate([y, np.zeros(N), [prior[0] / prior[1]]])


def by_trial(records):
    """Of each trial, its rows by gain and drift and its right-hand side with its own unknowns projected out."""
    for C, record in zip(COLUMNS, records, strict=True):
        rows, y = weighed(C, record)
        Q, _ = np.linalg.qr(np.vstack([rows[:, 2:], [[0.0, 0.0, 1 / BIAS]]]))
        clear = lambda a, Q=Q: a - Q @ (Q.T @ a)  # noqa: E731
        yield clear(np.vstack([rows[:, :2], [[0.0, 0.0]]])), clear(np.append(y, 0.0))


FREE = (Free("gain", prior=PRIOR), "drift")
OWN = Offset("x", each="trial", prior=(0.0, BIAS))
OPTIONS = {"unknown": ("x", "x_dot")}


def fitted(records, *free, start=None, **options):
    problem = Problem.of(Track() if start is None else start, trials_of(records), (*free, OWN), **(OPTIONS | options))
    return minimize(problem, LeastSquares(rtol=1e-14, damping=1e-7))


@pytest.fixture(scope="module", params=[0.0, 0.2], ids=["noise", "wander"])
def case(request):
    records = recorded(1, wander=request.param)
    found = fitted(records, *FREE)
    assert found.ok, found.message
    assert found.uses_clustered_errors
    A, y = dense(records)
    best = np.linalg.lstsq(A, y, rcond=None)[0]
    return records, found, A, y, best


def left_out_in_turn(rows, priors):
    """The jackknife: all solved for again without each of the `rows`, beside `priors`, which were measured apart. It is
    scaled to be unbiased for white errors; with the degrees of freedom of its variances.

    Every estimate is a matrix times the right-hand sides; so is its change if a cluster is left out.
    """
    ends = np.cumsum([0, *map(len, rows)])
    A = np.vstack([*rows, priors])
    of_data = np.arange(len(A)) < ends[-1]

    def estimator(left_out):
        kept = np.setdiff1d(np.arange(len(A)), left_out)
        matrix = np.zeros(A[:, :-1].T.shape)
        matrix[:, kept] = np.linalg.pinv(A[kept, :-1])
        return matrix

    whole = estimator([])
    moved = np.array([estimator(np.arange(*pair)) - whole for pair in itertools.pairwise(ends)])  # (G, n, m)
    d, O = moved @ A[:, -1], np.einsum("gnm,hnm->ngh", moved[..., of_data], moved[..., of_data])
    trace = np.einsum("ngg->n", O)
    of_priors = whole[:, ~of_data] @ whole[:, ~of_data].T
    scale = np.sum(whole[:, of_data] ** 2, axis=1) / trace
    C = d.T @ d * np.sqrt(np.outer(scale, scale)) + of_priors
    share = scale * np.sum(d**2, axis=0) / C.diagonal()
    freedom = [_freedom_of(np.linalg.eigvalsh(of / tr)) for of, tr in zip(O, trace, strict=True)]
    return whole @ A[:, -1], C, freedom / share**2


def errors_by_trial(records):
    """The covariance, and its degrees of freedom."""
    rows = [np.column_stack(pair) for pair in by_trial(records)]
    return left_out_in_turn(rows, np.array([[1.0, 0.0, PRIOR[0]]]) / PRIOR[1])[1:]


def formal(A, y, priors=N + 1):
    """Covariance, variance and degrees of freedom: data of one unknown variance, the last rows of their own."""
    N_inverse = np.linalg.inv(A.T @ A)
    of_data = A[:-priors].T @ A[:-priors]
    freedom = len(A) - priors - np.trace(of_data @ N_inverse)
    variance = np.sum((A @ (N_inverse @ A.T @ y) - y)[:-priors] ** 2) / freedom
    return N_inverse @ (variance * of_data + A.T @ A - of_data) @ N_inverse, variance, freedom


@pytest.mark.slow_cases("noise")
def test_estimates_and_formal_errors(case):
    records, found, A, y, best = case
    np.testing.assert_allclose(list(found.estimates.values()), best[:2], rtol=TIGHT)
    own = [[x["start of x"][0], x["start of x_dot"][0], x["offset of x"]] for x in found.nuisance.values()]
    np.testing.assert_allclose(np.ravel(own), best[2:], rtol=TIGHT, atol=TIGHT)
    rss = np.sum((A @ best - y) ** 2)
    assert found.cost == pytest.approx(rss, rel=TIGHT)
    C, variance, freedom = formal(A, y)
    assert found.identifiability.degrees_of_freedom == pytest.approx(freedom, rel=TIGHT)
    assert found.variance == pytest.approx(variance, rel=TIGHT)
    np.testing.assert_allclose(found.covariance, C[:2, :2], rtol=10 * TIGHT)
    assert found.correlation[0, 1] == pytest.approx(C[0, 1] / np.sqrt(C[0, 0] * C[1, 1]), rel=TIGHT)
    # Of each channel, gaps left out.
    for channel, rows in (("x", slice(0, t.size)), ("x_dot", slice(t.size, None))):
        pairs = [(record[rows], f[channel]) for record, f in zip(records, found.fitted.values(), strict=True)]
        left = 1 - sum(np.nansum((y - f) ** 2) for y, f in pairs) / sum(
            np.nansum((y - np.nanmean(y)) ** 2) for y, _ in pairs
        )
        assert found.variance_accounted_for[channel] == pytest.approx(left, rel=TIGHT)
    residuals = np.concatenate([np.concatenate([r["x"], r["x_dot"]]) for r in found.residuals.values()])
    np.testing.assert_allclose(residuals[np.isfinite(residuals)], (A @ best - y)[: -N - 1], atol=1e-4)


def test_errors_by_trial(case):
    records, found, *_ = case
    C, freedom = errors_by_trial(records)
    np.testing.assert_allclose(found.clustered_covariance, C, rtol=1e-4)
    assert [*found.degrees_of_freedom.values()] == pytest.approx(freedom, rel=1e-3)
    assert [*found.error_kinds.values()] == ["trial", "trial"]


@pytest.mark.slow
@pytest.mark.weekly_cases("window-*")
@pytest.mark.parametrize(("kind", "parts", "options"), [("window", 4, {"window": 1.0}), ("part", 3, {})])
def test_errors_by_windows_and_by_parts(kind, parts, options):
    """Two trials: each window or part left out in turn, all others solved for again. The offset belongs to a trial;
    starts belong to a window, or to a trial without windows."""
    records = recorded(2, wander=0.2)[:2]
    found = fitted(records, *FREE, **options)
    assert found.clusters == (kind, 2 * parts)
    own = [4] if kind == "window" else [2, 3, 4]  # the columns of a trial's unknowns, of which the last is the offset
    m, rows = len(own), []
    for k, (C, record) in enumerate(zip(COLUMNS, records, strict=False)):
        A, y = weighed(C, record)
        for w in range(parts):
            at = np.tile(np.arange(t.size) // -(-t.size // parts) == w, 2)
            piece = np.zeros((at.sum(), 3 + 2 * m))
            piece[:, :2], piece[:, 2 + m * k : 2 + m * k + m], piece[:, -1] = A[at][:, :2], A[at][:, own], y[at]
            Q, _ = np.linalg.qr(A[at][:, 2:4])
            rows.append(piece - Q @ (Q.T @ piece) if kind == "window" else piece)
    priors = np.zeros((3, 3 + 2 * m))
    priors[0, [0, -1]], priors[1, 1 + m], priors[2, 1 + 2 * m] = [1 / PRIOR[1], PRIOR[0] / PRIOR[1]], 1 / BIAS, 1 / BIAS
    best, C, _ = left_out_in_turn(rows, priors)
    np.testing.assert_allclose(list(found.estimates.values()), best[:2], rtol=TIGHT)
    np.testing.assert_allclose(found.clustered_covariance, C[:2, :2], rtol=1e-3)


@pytest.mark.weekly
def test_linked_windows_are_not_clusters():
    chained = fitted(recorded(2, wander=0.2)[:2], *FREE, window=1.0, defect_std={"x": 0.1, "x_dot": 0.1})
    assert chained.clusters == ("", 0)
    assert np.all(np.isnan(chained.clustered_covariance))
    with pytest.raises(ValueError, match="bootstrap: 2 trials are too few"):
        bootstrap(chained)


@pytest.mark.slow
def test_intervals_and_profiles_have_the_same_degrees_of_freedom(case):
    records, found, *_, best = case
    C, freedom = errors_by_trial(records)
    half = stats.t.ppf(0.95, freedom) * np.sqrt(C.diagonal())
    for i, name in enumerate(("gain", "drift")):
        low, high = best[i] - half[i], best[i] + half[i]
        assert found.intervals(0.9)[name] == pytest.approx((low, high), abs=1e-4 * half[i])
        # The cost is a parabola: so is its profile, whatever the grid.
        assert profile(found, name, n=5, level=0.9).interval == pytest.approx((low, high), abs=1e-3 * half[i])


def test_identifiability_of_a_planned_experiment_depends_on_sigma():
    """Simulated measurements are met exactly: what the plan determines depends on `sigma` alone."""
    records = [C @ [1.0, 0.0, 0.1, -0.2, 0.0] for C in COLUMNS]
    seen = identifiability(Problem.of(Track(), trials_of(records), (*FREE, OWN), **OPTIONS))
    A = dense(records)[0]
    np.testing.assert_allclose(seen.covariance, np.linalg.inv(A.T @ A)[:2, :2], rtol=TIGHT)
    assert seen.ok
    loud = [Trial(x.t, x.measured, x.inputs, sigma=1e4 * SIGMA[0]) for x in trials_of(records)]
    assert not identifiability(Problem.of(Track(), loud, ("gain", "drift", OWN), **OPTIONS)).ok


@pytest.mark.slow
def test_cross_validation_equals_refits_without_each_trial(case):
    records, found, *_, best = case
    left_out = cross_validate(found)
    pieces = list(by_trial(records))
    for k in range(N):
        keep = [p for i, p in enumerate(pieces) if i != k]
        B = np.vstack([*(a for a, _ in keep), [[1 / PRIOR[1], 0.0]]])
        rhs = np.concatenate([*(r for _, r in keep), [PRIOR[0] / PRIOR[1]]])
        others = np.linalg.lstsq(B, rhs, rcond=None)[0]
        found_others = [values[k] for values in left_out.estimates.values()]
        np.testing.assert_allclose(found_others, others, atol=0.02 * found.standard_errors["gain"])
        # A trial is charged with its own residuals alone, not with the parameters' priors.
        for values, costs in ((others, left_out.held_out), (best[:2], left_out.fitted), ((1, 0), left_out.at_start)):
            assert costs[k] == pytest.approx(np.sum((pieces[k][0] @ values - pieces[k][1]) ** 2), rel=1e-3)
    assert left_out.n.tolist() == [np.isfinite(y).sum() for y in records]


@pytest.mark.weekly_cases("noise")
def test_the_held_out_cost_equals_that_of_cross_validation(case):
    rtol = 1e-5  # of starts and offsets that are searched for
    free = ("gain", "drift", Offset("x_dot", each="trial", prior=(0.0, 0.5)))  # which starts cannot stand for
    found = fit(Track(), trials_of(recorded(3)), free, **OPTIONS)
    assert found.held_out_cost == pytest.approx(cross_validate(found).held_out.sum(), rel=rtol)
    assert found.held_out_cost > found.cost
    told = f"{found.held_out_cost:.6g}"
    assert f"({told} of trials left out in turn)" in str(found)
    assert f"({told} of trials left out in turn)" in report(found)
    alone = fit(Track(), trials_of(recorded(3))[:1], free, **OPTIONS)
    with_prior = case[1]
    assert with_prior.held_out_cost == pytest.approx(cross_validate(with_prior).held_out.sum(), rel=1e-4)
    for other in (alone, validate(found, trials_of(recorded(4)))):  # one trial; nothing was fitted
        assert math.isnan(other.held_out_cost)
        assert "left out in turn" not in str(other)
    row = next(line for line in str(compare({"all": found, "one": alone})).splitlines() if "left out in turn" in line)
    assert row.split()[-1] == told


def test_the_evidence_equals_the_gaussian_density_of_the_data():
    # All unknowns have Gaussian priors, so the data are Gaussian: their density needs no integral.
    records = recorded(2)
    at_rest = trials_of(records, initial={"x": 0.0, "x_dot": 0.0})
    free = (Free("gain", prior=(1.0, 0.5), scale=7.0), Free("drift", prior=(0.0, 2.0)))
    starts = {"x": 0.4, "x_dot": 0.3}
    gaussian = minimize(
        Problem.of(Track(), at_rest, (*free, OWN), **(OPTIONS | {"unknown": starts})), LeastSquares(rtol=1e-14)
    ).laplace()
    y, sigma = np.concatenate(records), np.tile(SIGMA, N)
    y, sigma = y[np.isfinite(y)], sigma[np.isfinite(y)]
    A = dense(records)[0][: -N - 1] * sigma[:, None]
    P = np.diag([0.5, 2.0, *[0.4, 0.3, BIAS] * N]) ** 2
    mean = A[:, 0]  # with a gain of one
    exact = stats.multivariate_normal(mean, A @ P @ A.T + np.diag(sigma**2)).logpdf(y)
    assert gaussian.log_evidence == pytest.approx(exact, abs=1e-4)
    assert gaussian.message == ""
    # C = (A^T A / sigma^2 + P^-1)^-1, of x in the unit of the scales
    scales = np.outer([7.0, 2.0], [7.0, 2.0])  # of a start at zero it is the prior's deviation
    covariance = np.linalg.inv(A.T @ (A / sigma[:, None] ** 2) + np.linalg.inv(P))[:2, :2] / scales
    np.testing.assert_allclose(gaussian.covariance, covariance, rtol=TIGHT)
    draws = gaussian.sample(2000)
    assert np.std(draws["gain"]) == pytest.approx(7.0 * covariance[0, 0] ** 0.5, rel=0.05)


@pytest.fixture(scope="module")
def evidence():
    records = recorded(2)

    def of(*free):
        return fitted(records, *free, start=Track(gain=1.1, drift=0.2)).laplace()

    return of


@pytest.mark.weekly
def test_the_evidence_depends_on_priors_but_not_on_scales(evidence):
    prior = (1.0, 0.5)
    drift = Free("drift", prior=(0.0, 2.0))
    first = evidence(Free("gain", prior=prior), drift).log_evidence
    # Starts without a prior have a density of one: they are integrated in closed form.
    records = recorded(2)
    A, y = dense(records, (1.0, 0.5))
    A, y = np.vstack([A, np.eye(1, A.shape[1], 1) / 2.0]), np.append(y, 0.0)
    rss = np.linalg.lstsq(A, y, rcond=None)[1][0]
    exact = (
        -0.5 * rss
        - np.log(np.tile(SIGMA, N)[np.isfinite(np.concatenate(records))]).sum()
        - N * np.log(BIAS)
        - np.log(0.5)
        - np.log(2.0)
    )
    exact += 0.5 * (A.shape[1] - len(A)) * np.log(2 * math.pi) - 0.5 * np.linalg.slogdet(A.T @ A)[1]
    assert first == pytest.approx(exact, abs=1e-5)
    # How far a step goes, where it begins, and bounds that leave the prior whole are no part of a model.
    for other in (
        Free("gain", prior=prior, scale=1e-3),
        Free("gain", prior=prior, start=2.0),
        Free("gain", prior=prior, bounds=(-20.0, 25.0)),
    ):
        assert evidence(other, drift).log_evidence == pytest.approx(first, abs=1e-4), other
    # Half of a prior whose mean is at a bound is cut off: the other half counts twice.
    cut = evidence(Free("gain", prior=(0.0, 5.0), bounds=(0.0, 1e3)), drift).log_evidence
    whole = evidence(Free("gain", prior=(0.0, 5.0)), drift).log_evidence
    assert cut - whole == pytest.approx(np.log(2.0), abs=1e-4)


@pytest.mark.weekly
def test_a_wider_prior_reduces_the_evidence(evidence):
    drift = Free("drift", prior=(0.0, 2.0))
    wide = [evidence(Free("gain", prior=(1.2, width)), drift).log_evidence for width in (10.0, 1000.0)]
    assert wide[1] - wide[0] == pytest.approx(-np.log(100.0), abs=1e-3)
    flat = [evidence(Free("gain", bounds=(0.0, width)), drift).log_evidence for width in (10.0, 1000.0)]
    assert flat[1] - flat[0] == pytest.approx(-np.log(100.0), abs=1e-3)
    none = evidence("gain", drift)
    assert np.isnan(none.log_evidence)
    assert "any value of gain is as likely" in none.message
    assert none.sample(3)["gain"].shape == (3,)
    with pytest.raises(ValueError, match="`n` must be an integer"):
        none.sample(-1)


@pytest.mark.slow
def test_identifiability_does_not_depend_on_units():
    # A push in mN with a gain in 1/g is the same experiment: so is what the data tell.
    def told(unit, noise):
        records = [y + noise * SIGMA * np.random.default_rng(9).normal(size=y.size) for y in recorded(3)]
        trials = trials_of(records)
        for trial in trials:
            trial.inputs["push"] = trial.inputs["push"] * unit
        problem = Problem.of(Track(gain=1.1 / unit, drift=0.2), trials, ("gain", "drift", OWN), **OPTIONS)
        return minimize(problem, LeastSquares(rtol=1e-12))

    for noise in (0.0, 300.0):
        one, other = told(1.0, noise), told(1e-3, noise)
        assert other.singular_values == pytest.approx(one.singular_values, rel=1e-6)
        assert other.ok == one.ok == (noise == 0.0)
        assert len(other.identifiability.messages) == len(one.identifiability.messages)
        assert other.standard_errors["gain"] == pytest.approx(1e3 * one.standard_errors["gain"], rel=1e-6)


@pytest.mark.slow
def test_identifiability_does_not_depend_on_the_initial_guess():
    """A small initial guess is a small scale; the estimate is known to a hundredth of itself all the same."""
    trials = trials_of(recorded(3))
    for start in (1.0, 1e-6):
        found = minimize(Problem.of(Track(gain=start, drift=0.2), trials, ("gain", "drift", OWN), **OPTIONS), METHOD)
        assert found.ok, found
        assert found.standard_errors["gain"] < 0.05 * found.estimates["gain"]
    # The data say of a value that is zero within its error no more than before.
    flat = [Trial(x.t, {"x_dot": SIGMA[-1] * np.random.default_rng(k).normal(size=t.size)}, x.inputs, sigma=SIGMA[-1])
            for k, x in enumerate(trials)]  # fmt: skip
    unknown = {**OPTIONS, "unknown": "x_dot"}
    found = minimize(Problem.of(Track(gain=1e-6, drift=0.2), flat, ("gain", "drift"), **unknown), METHOD)
    assert "gain is undetermined" in found.message


def test_as_many_unknowns_as_residuals():
    # Two of each trial, and its sensor's prior, for three unknowns of its own: nothing is left for the common ones.
    records = [np.where(np.isin(np.arange(y.size), (5, 30)), y, np.nan) for y in recorded(4)]
    found = fitted(records, *FREE)
    assert found.problem.size[0] < found.problem.size[1]
    assert np.isnan(found.variance)
    assert all(not np.isfinite(error) for error in found.standard_errors.values())
    assert any("residuals for" in note for note in found.notes)


@pytest.mark.weekly
def test_the_held_out_cost_with_a_parameter_at_its_bound():
    """A parameter at its bound is fixed: as in a fit that does not free it."""
    records, bounded = trials_of(recorded(3)), Free("gain", start=0.5, bounds=(0.0, 1.0))  # it is 1.2
    at_bound = fit(Track(), records, (bounded, "drift"), **OPTIONS)
    fixed = fit(Track(gain=1.0), records, "drift", **OPTIONS)
    assert at_bound.identifiability.at_bound == ("gain",)
    at_bound = dataclasses.replace(at_bound, status="converged")
    assert at_bound.held_out_cost == pytest.approx(fixed.held_out_cost, rel=1e-3)
    assert at_bound.message.startswith("converged: gain rests at its bound")
