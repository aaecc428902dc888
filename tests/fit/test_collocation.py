"""Fits by direct collocation: against windows, against the Kalman filter, and their coverage."""

import dataclasses
import itertools
import os
import signal

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from systems import Cart

import jaxkane as jk
from jaxkane._collocate.program import NonlinearProgram
from jaxkane.fit import Collocation, Delay, Free, Gain, JointPrior, Offset, Trial, fit

pytest.importorskip("casadi")

TRUTH = Cart(mass=1.3, stiffness=5.0, damping=0.4)
GUESS = Cart(mass=1.7, stiffness=4.0, damping=0.3)
NAMES = ("mass", "stiffness", "damping")
T = np.linspace(0.0, 3.0, 61)


def known_push(t):
    return np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t)


def exact(h, density=0.0):
    """Exact steps of the cart from sample to sample: state, linear push; and the covariance of white noise in push."""
    m, k, c = float(TRUTH.mass), float(TRUTH.stiffness), float(TRUTH.damping)
    A, B = np.array([[0.0, 1.0], [-k / m, -c / m]]), np.array([0.0, 1.0 / m])
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2], block[2, 3] = A, B, 1.0
    step = scipy.linalg.expm(h * block)
    van_loan = scipy.linalg.expm(h * np.block([[-A, density * np.outer(B, B)], [np.zeros((2, 2)), A.T]]))
    return step[:2, :2], step[:2, 2], step[:2, 3], van_loan[2:, 2:].T @ van_loan[:2, 2:]


def record(seed, density=0.0, sigma=(2e-3, 1e-2), t=T, **more):
    """A record of position and speed, with a known push, white noise in the push and noise of the sensors."""
    rng, h = np.random.default_rng(seed), t[1] - t[0]
    F, G0, G1, Q = exact(h, density)
    L = np.linalg.cholesky(Q) if density else np.zeros((2, 2))
    push = known_push(t)
    states = [np.array([0.2, 0.0])]
    for a, b in itertools.pairwise(push):
        states.append(F @ states[-1] + G0 * a + G1 * (b - a) / h + L @ rng.normal(size=2))
    y = np.array(states) + rng.normal(size=(len(t), 2)) * sigma
    return Trial(t, {"x": y[:, 0], "x_dot": y[:, 1]}, {"push": push}, sigma=dict(zip(("x", "x_dot"), sigma)), **more)


def by_collocation(trials, free=NAMES, guess=GUESS, unknown=("x", "x_dot"), **how):
    options = {k: how.pop(k) for k in ("priors", "constraints") if k in how}
    return fit(guess, trials, free, unknown=unknown, transcription=Collocation(**how), **options)


def test_equals_the_kalman_filter_if_an_input_is_unknown():
    """0.15 standard errors; standard errors within 15 %: observed and expected curvature differ."""
    trial = record(2, density=0.3)
    found = by_collocation(trial, unknown_inputs={"push": 0.3})
    other = fit(GUESS, trial, NAMES, unknown=("x", "x_dot"), noise={"push": 0.3})
    assert found.ok
    for name in NAMES:
        assert abs(found.estimates[name] - other.estimates[name]) < 0.15 * other.standard_errors[name]
        assert found.standard_errors[name] == pytest.approx(other.standard_errors[name], rel=0.15)
    motion = found.motions["trial"]
    assert set(motion) == {"x", "x_dot", "push"}
    assert np.std(motion["push"] - known_push(T)) > 0.1  # the unknown part is estimated, too


@pytest.mark.weekly
def test_unknown_roll_torque_of_a_bicycle():
    """An unstable bicycle: the Kalman filter within 0.05 standard errors, and the truth within three."""
    bicycle, t, rng = jk.catalog.WhippleBicycle.benchmark(), np.arange(121) / 40.0, np.random.default_rng(0)
    gusts = jk.Samples(np.arange(481) / 160.0, np.sqrt(4.0 * 160.0) * rng.normal(size=481), zero_order_hold=True)

    def rider(t, state):  # balances, because the weave is unstable at 3 m/s
        gains = {"roll": 48.7, "steer": -25.4, "roll_rate": 14.0, "steer_rate": -2.9}
        return 2.0 * sum(jnp.sin(w * t + w) for w in (1.3, 2.9, 5.1, 8.3)) + sum(k * state[x] for x, k in gains.items())

    start = jk.assemble(bicycle, {}, {"rear_wheel_rate": -3.0 / bicycle.rR})
    ride = jk.simulate(bicycle, start, t, {"roll_torque": gusts, "steer_torque": rider}, step=1.0 / 160.0)
    sigma = {"roll": 2e-3, "steer": 2e-3, "roll_rate": 5e-3, "steer_rate": 1e-2}
    measured = {name: np.asarray(ride[name]) + s * rng.normal(size=len(t)) for name, s in sigma.items()}
    known = {name: float(ride[name][0]) for name in (*bicycle.coordinates, *bicycle.speeds)}
    trial = Trial(t, measured, {"steer_torque": np.asarray(ride["steer_torque"])}, sigma=sigma, initial=known)
    guess, free = dataclasses.replace(bicycle, zB=-0.85, IBxx=8.8, c=0.07), ("zB", "IBxx", "c")
    found = by_collocation(trial, free, guess, tuple(sigma), unknown_inputs={"roll_torque": 4.0})
    other = fit(guess, trial, free, unknown=tuple(sigma), noise={"roll_torque": 4.0})
    assert found.ok
    for name in free:
        error = other.standard_errors[name]
        assert abs(found.estimates[name] - other.estimates[name]) < 0.05 * error
        assert found.standard_errors[name] == pytest.approx(error, rel=0.03)
        assert abs(found.estimates[name] - float(getattr(bicycle, name))) < 3.0 * error


@pytest.mark.weekly
def test_intervals_cover_the_truth():
    """95 % intervals, 40 records of 3 parameters: at least 107 of 120, which less than 1 % of such sets miss."""
    inside = 0
    for seed in range(100, 140):
        found = by_collocation(record(seed, density=0.3), unknown_inputs={"push": 0.3})
        assert found.ok, seed
        errors = {name: abs(found.estimates[name] - float(getattr(TRUTH, name))) for name in NAMES}
        inside += sum(errors[name] < 1.96 * found.standard_errors[name] for name in NAMES)
    assert inside >= 107


@pytest.mark.weekly
def test_gains_offsets_priors_and_several_trials():
    """Truth within four standard errors; a strong prior wins."""
    trials = [record(seed, name=f"run {seed}") for seed in (3, 4)]
    wrong = [Trial(t.t, {k: v + 0.05 * (k == "x") for k, v in t.measured.items()}, {"push": 2.0 * t.inputs["push"]},
                   sigma=t.sigma, name=t.name) for t in trials]  # fmt: skip
    free = (*NAMES[1:], Gain("push", bounds=(0.1, 2.0)), Offset("x", each="trial"))
    found = by_collocation(wrong, free, dataclasses.replace(GUESS, mass=TRUTH.mass))
    assert found.ok
    assert abs(found.estimates["gain of push"] - 0.5) < 4 * found.standard_errors["gain of push"]
    for row in found.nuisance().values():
        assert row["offset of x"] == pytest.approx(0.05, abs=0.01)
    held = by_collocation(trials, (*NAMES[1:], Free("mass", prior=(1.5, 1e-5))))
    assert held.estimates["mass"] == pytest.approx(1.5, abs=1e-3)


@pytest.mark.slow
@pytest.mark.weekly_cases("no priors")
@pytest.mark.parametrize(
    ("free", "joint", "within"),
    [
        (NAMES, {}, 4e-3),
        (
            (Free(NAMES[0], prior=(1.2, 0.02)), Free(NAMES[1], prior=("lognormal", 5.0, 0.02)), NAMES[2]),
            {"constraints": [JointPrior({NAMES[2]: 0.8, NAMES[1]: 5.0}, [[1e-3, 0.0], [0.0, 1.0]])]},
            5e-3,
        ),
    ],
    ids=["no priors", "priors"],
)
def test_equals_simulation_if_inputs_are_known(free, joint, within):
    """Also with a normal, a log-normal and a joint prior that contradict the data."""
    trial, unknown = record(1), ("x", "x_dot")
    found, other = by_collocation(trial, free, **joint), fit(GUESS, trial, free, unknown=unknown, **joint)
    assert found.ok
    assert found.cost == pytest.approx(other.cost, rel=5e-3)
    assert [*found.estimates.values()] == pytest.approx([*other.estimates.values()], rel=within)
    if joint:
        assert other.cost > 1.2 * fit(GUESS, trial, NAMES, unknown=unknown).cost
    else:  # `Fit` scales by the variance of the residuals
        formal = [x / np.sqrt(other.variance) for x in other.standard_errors.values()]
        assert [*found.standard_errors.values()] == pytest.approx(formal, rel=0.05)


@pytest.mark.slow
@pytest.mark.weekly_cases("0.0")
@pytest.mark.parametrize("before", [None, 0.0])
def test_delay_of_an_input(before):
    """0.1 s, within four standard errors. Without the input's value before the first sample, the first 0.3 s are
    excluded."""
    trial = record(5)
    late = Trial(T, trial.measured, {"push": known_push(T + 0.1)}, sigma=trial.sigma)
    found = by_collocation(late, ("mass", Delay("push", start=0.15, bounds=(0.0, 0.3), before=before)), TRUTH)
    assert found.ok
    assert found.mean_square < 1.5
    assert abs(found.estimates["delay of push"] - 0.1) < 4 * found.standard_errors["delay of push"]
    assert np.isnan(found.residuals["trial"]["x"]).sum() == (6 if before is None else 0)


class Stopped(Cart):
    def events(self, t, q, u):
        return {"wall": jk.falling(q["x"] + 1.0, then={"x_dot": 0.0})}


@pytest.mark.slow
def test_bounds_of_states_are_met():
    found = by_collocation(record(6), within={"x": (-0.1, None)}, unknown_inputs={})
    assert found.motions["trial"]["x"].min() >= -0.1 - 1e-6
    assert record(6).measured["x"].min() < -0.11  # the bound contradicts the data


def test_missing_samples_and_a_clock_offset_do_not_bias_estimates():
    """The same estimates, 1e-6, if the clock starts at 1.7e9 s; missing samples are not used."""
    trial = record(7)
    gap = {k: np.where((T > 1.0) & (T < 1.3), np.nan, v) for k, v in trial.measured.items()}
    found = by_collocation(Trial(T, gap, trial.inputs, sigma=trial.sigma))
    late = by_collocation(Trial(T + 1.7e9, gap, trial.inputs, sigma=trial.sigma))
    assert found.ok
    for name in NAMES:
        assert late.estimates[name] == pytest.approx(found.estimates[name], rel=1e-5)
    assert np.isnan(found.residuals["trial"]["x"]).sum() == np.isnan(gap["x"]).sum()


def test_undetermined_parameters_have_no_interval():
    """Mass, stiffness and damping of a free motion are known up to a factor."""
    trial = record(8)
    still = Trial(T, trial.measured, {"push": 0.0 * T}, sigma=trial.sigma)
    found = by_collocation(still)
    assert not found.ok
    assert found.status in ("undetermined", "failed")


def test_interrupted_fit_keeps_its_iterate(monkeypatch):
    gradient, count = NonlinearProgram.gradient, itertools.count()

    def interrupted(program, z):
        if next(count) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return gradient(program, z)

    monkeypatch.setattr(NonlinearProgram, "gradient", interrupted)
    found = by_collocation(record(9))
    assert found.status == "interrupted"
    assert not found.ok
    assert np.isfinite([*found.estimates.values()]).all()


def test_the_longest_time_of_a_fit():
    found = by_collocation(record(9), max_seconds=1e-9)
    assert (found.ok, found.message) == (False, "The search ended early: the longest time was reached.")
    assert np.isfinite([*found.estimates.values()]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unknown_inputs": {"pull": 1.0}}, "pull"),
        ({"unknown_inputs": {"push": -1.0}}, "unknown_inputs"),
        ({"unknown_inputs": {"push": "much"}}, "unknown_inputs"),
        ({"within": {"y": (0.0, 1.0)}}, "within"),
        ({"within": {"x": (1.0, 0.0)}}, "lower bound"),
        ({"intervals_per_sample": 0}, "intervals_per_sample"),
        ({"method": "euler"}, "method"),
        ({"max_seconds": 0.0}, "max_seconds"),
        ({"free": (*NAMES, Delay("x"))}, "delay of sensor"),
        ({"free": (*NAMES, Gain("x", of="start")), "unknown": ("x_dot",)}, "does not support the .* of start x"),
        ({"free": (*NAMES, Offset("x", of="start")), "unknown": ("x_dot",)}, "does not support the .* of start x"),
        ({"guess": Stopped()}, "Collocation: events or contacts of Stopped change its state: wall"),
    ],
)
def test_wrong_options(change, words):
    with pytest.raises(ValueError, match=words):
        by_collocation(record(1), **change)


@pytest.mark.parametrize(
    "option", [{"window": 0.5}, {"noise": {"push": 1.0}}, {"zero_order_hold": ("push",)}, {"steps": 3}]
)
def test_options_not_supported_by_collocation_are_rejected(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        fit(GUESS, record(1), NAMES, transcription=Collocation(), **option)


@pytest.mark.weekly
def test_wrong_standard_deviations_are_noted():
    """With a tenth of the true errors of the sensors, the mean square is not one. A free mass would hide this:
    a smaller mass moves more, and the Kalman filter estimates the same."""
    trial = record(2, density=0.3)
    wrong = Trial(T, trial.measured, trial.inputs, sigma={"x": 2e-4, "x_dot": 1e-3})
    known = NAMES[1:], dataclasses.replace(GUESS, mass=TRUTH.mass)
    found = by_collocation(wrong, *known, unknown_inputs={"push": 0.3})
    assert found.mean_square > 2.0
    assert "spectral densities" in found.notes[0]
    assert "mean square" in repr(found)
    assert not by_collocation(trial, unknown_inputs={"push": 0.3}).notes
