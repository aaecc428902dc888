"""Systems that have first-order states only: no coordinates, no speeds, no bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxkane as jk

TS = jnp.linspace(0.0, 2.0, 11)


class Lag(jk.System):
    """x_dot = (push - x) / lag: x = push + (x0 - push) exp(-t / lag)."""

    lag: jk.Scalar = jk.parameter(0.5, positive=True, unit="s")
    states, inputs, units = ("x",), ("push",), {"x": "m"}

    def state_rates(self, t, q, u, x, motion, now):
        return (now["push"] - x["x"]) / self.lag


class VanDerPol(jk.System):
    mu: jk.Scalar = jk.parameter(1.0)
    states = ("x", "v")

    def state_rates(self, t, q, u, x, motion, now):
        return {"x": x["v"], "v": self.mu * (1.0 - x["x"] ** 2) * x["v"] - x["x"]}

    def outputs(self, t, q, u, motion, now):
        return {"radius": jnp.hypot(now["x"], now["v"])}


class Relaxation(Lag):
    """Each time x reaches 0.5, it returns to 1."""

    def events(self, t, q, u, x):
        return {"reset": jk.falling(x["x"] - 0.5, then={"x": 1.0})}


def last(lag, x0):
    return jk.simulate(Lag(lag=lag), jk.State(x=jnp.stack([x0])), TS, {"push": 0.2}, rtol=1e-10, atol=1e-10)["x"][-1]


def exact(lag, x0):
    return 0.2 + (x0 - 0.2) * jnp.exp(-2.0 / lag)


@pytest.mark.slow_cases(all_but=["native-forward"])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad], ids=["forward", "reverse"])
def test_simulations_and_their_derivatives(derivative, kernels):
    rtol = 1e-8
    ours = jax.jit(lambda *at: (last(*at), derivative(last, (0, 1))(*at)))(0.5, 1.0)
    expected = exact(0.5, 1.0), jax.grad(exact, (0, 1))(0.5, 1.0)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol), ours, expected)


def test_batches():
    rtol, lags = 1e-5, jnp.array([0.4, 0.5, 0.8])
    rides = jk.sweep.sweep(jax.vmap(lambda lag: Lag(lag=lag))(lags), jk.State(x={"x": 1.0}), TS, {"push": 0.2})
    np.testing.assert_allclose(rides["x"][:, -1], exact(lags, 1.0), rtol=rtol)


@pytest.mark.slow
def test_a_mapped_simulation():
    lags = jnp.array([0.4, 0.5, 0.8])
    np.testing.assert_allclose(jax.vmap(last, (0, None))(lags, 1.0), exact(lags, 1.0), rtol=1e-8)


@pytest.mark.slow
def test_a_state_in_float32_stays_in_float32():
    lag = Lag(lag=jnp.float32(0.5))
    ride = jk.simulate(lag, jk.State(x=jnp.ones(1, jnp.float32)), TS, rtol=1e-5, atol=1e-5)
    assert ride.x.dtype == ride.q.dtype == jnp.float32
    assert ride["x"][-1] == pytest.approx(np.exp(-4.0), abs=1e-5)


@pytest.mark.slow
def test_events():
    """x returns to 1 in intervals of lag log 2."""
    period = 0.5 * np.log(2.0)
    ride = jk.simulate(Relaxation(), jk.State(x=[1.0]), TS, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(ride.jumps.t[:5], period * np.arange(1, 6), rtol=1e-7)
    assert ride["x"][-1] == pytest.approx(np.exp(-(2.0 % period) / 0.5), rel=1e-7)


@pytest.mark.slow
def test_outputs_audit_and_plots():
    ride = jk.simulate(VanDerPol(), jk.State(x=[3.0, 4.0]), TS)
    assert ride["radius"][0] == 5.0
    assert not jk.audit(VanDerPol(), ride).kinetic_energy.any()
    assert [ax.get_ylabel() for ax in jk.plot.trajectories(ride)] == ["x", "v"]


def test_values_at_one_instant():
    assert jk.outputs(VanDerPol(), 0.0, [], [], {"x": 3.0, "v": 4.0})["radius"] == 5.0
    assert jk.state_rates(VanDerPol(), 0.0, [], [], {"x": 3.0, "v": 4.0}) == {"x": 4.0, "v": -35.0}
    assert jk.equations_of_motion(VanDerPol(), 0.0, [], [])[0].shape == (0, 0)
    assert [x.shape for x in jk.partial_velocities(VanDerPol(), 0.0, [], [])] == [(0, 3, 0)] * 2


def test_linear_models():
    still = jk.stability.equilibrium(Lag(), inputs={"push": 0.3})
    np.testing.assert_allclose(still.x, 0.3, rtol=1e-12)
    model = jk.stability.linearize(VanDerPol(mu=3.0), jk.State(x=[0.0, 0.0]))
    assert model.states == ("x", "v")
    np.testing.assert_allclose(model.A, [[0.0, 1.0], [-1.0, 3.0]], atol=1e-12)


@pytest.mark.slow
def test_a_limit_cycle():
    """The period for mu = 1 is 6.6632868593 (Andersen and Geer 1982, Power series expansions for the frequency and
    period of the limit cycle of the van der Pol equation)."""
    orbit = jk.stability.periodic(VanDerPol(), jk.State(x=[2.0, 0.0]), period=6.6)
    assert orbit.period == pytest.approx(6.6632868593, rel=1e-9)
    assert "starts at x 2.0" in repr(orbit)


@pytest.fixture(scope="module")
def trial():
    """Measurements without noise by SciPy; mu = 1.3, x = 1 and v = 0 at the start."""
    ts = np.linspace(0.0, 6.0, 61)
    rates = lambda t, x: [x[1], 1.3 * (1.0 - x[0] ** 2) * x[1] - x[0]]  # noqa: E731
    x = scipy.integrate.solve_ivp(rates, (0.0, 6.0), [1.0, 0.0], "DOP853", ts, rtol=1e-11, atol=1e-11).y[0]
    return jk.fit.Trial(ts, {"x": x}, sigma=0.01)


@pytest.mark.slow_cases(all_but=["windows"])
@pytest.mark.parametrize(
    ("options", "atol"),
    [
        ({}, 1e-5),
        ({"transcription": jk.fit.Collocation()}, 1e-3),  # of one interval for each sample
        ({"noise": {"v": 1e-6}}, 1e-3),
    ],
    ids=["windows", "collocation", "process noise"],
)
def test_fits(trial, options, atol):
    fit = jk.fit.fit(VanDerPol(), [trial], ["mu"], unknown=("x", "v"), **options)
    assert fit.estimates["mu"] == pytest.approx(1.3, abs=atol)


@pytest.mark.slow
def test_filters():
    sensors = jk.estimate.Filter(Lag(), sensors={"x": 0.1}, noise={"x": 0.02})
    belief = jk.estimate.begin(sensors, jk.State(x=[1.0]), {"x": 0.1})
    belief = jk.estimate.predict(sensors, belief, 0.05)
    np.testing.assert_allclose(belief.mean, np.exp(-0.1), rtol=1e-6)


def test_code_of_other_languages(tmp_path):
    jk.export.numpy(VanDerPol(), tmp_path / "model.py")
    names = {}
    exec((tmp_path / "model.py").read_text(), names)
    np.testing.assert_allclose(names["state_rates"](0.0, [], [], [3.0, 4.0]), [4.0, -35.0])
    header = jk.export.c(VanDerPol(), tmp_path / "model.c").header.read_text()
    assert "state_rates" in header
    assert "jacobian" not in header


class Massless(jk.System):
    coordinates, speeds, states = ("q",), ("u",), ("x",)

    def motion(self, t, q, u):
        return jk.Motion([])

    def state_rates(self, t, q, u, x, motion, now):
        return {}


class NoRates(jk.System):
    states = ("x",)


def test_errors_name_what_is_missing():
    with pytest.raises(ValueError, match=r"Massless has speeds, so its Motion needs at least one Body\."):
        jk.simulate(Massless(), jk.State([0.0], [0.0]), TS)
    with pytest.raises(NotImplementedError, match=r"NoRates has states \(x\): define state_rates"):
        jk.simulate(NoRates(), jk.State(x=[0.0]), TS)
    with pytest.raises(ValueError, match=r"state\.q must have the shape \(0,\) for no names; got \(1,\)"):
        jk.simulate(Lag(), jk.State(q=[0.0], x=[0.0]), TS)
    with pytest.raises(ValueError, match=r"Lag has no speeds, so it has no equations of motion"):
        jk.fit.first_estimate(Lag(), [jk.fit.Trial(TS, {"x": TS}, sigma=0.1)], ["lag"])
