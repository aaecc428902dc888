"""States of the first order and outputs: beside exact solutions, through every part of the library, and refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Sled
from scipy.linalg import expm

import jaxkane as jk
from jaxkane.fit import LeastSquares, Simulation, Trial, fit
from jaxkane.stability import equilibrium, linearize
from jaxkane.sweep import sweep

ts = np.linspace(0.0, 1.0, 21)
GRAVITY = 9.81


class Cart(jk.System):
    """A cart on a spring, pushed by a motor that lags; an accelerometer behind a filter."""

    mass: jk.Scalar = jk.parameter(2.0)
    stiffness: jk.Scalar = jk.parameter(30.0)
    lag: jk.Scalar = jk.parameter(0.1)
    filter_time: jk.Scalar = jk.parameter(0.05)
    gain: jk.Scalar = jk.parameter(1.0)
    coordinates = ("place",)
    speeds = ("speed",)
    inputs = ("command",)
    states = ("force", "filtered")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["place"] * N.x, u["speed"] * N.x, frame=N)
        return jk.Motion([jk.Body(self.mass, 0.0, P, name="cart")], points={"P": P})

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["force"] - self.stiffness * q["place"]) * motion.N.x, motion["P"])

    def state_rates(self, t, q, u, x, motion, now):
        (motor,), _ = jk.sensors.low_pass(now["command"], x["force"], self.lag)
        (read,), _ = jk.sensors.low_pass(now.u_dot["speed"], x["filtered"], self.filter_time)
        return motor, read

    def outputs(self, t, q, u, motion, now):
        a = now.acceleration(motion["P"]).to(motion.N)
        return {"motor": {"force": now["force"]}, "acceleration": self.gain * a[0], "read": now["filtered"]}


@pytest.fixture(scope="module")
def cart():
    return Cart()


START = jk.State({"place": 0.2}, {"speed": -0.1}, {"force": 3.0})
NAMES = ("place", "speed", "force", "filtered")


def matrices(cart):
    m, k, lag, tau = (float(x) for x in (cart.mass, cart.stiffness, cart.lag, cart.filter_time))
    A = [[0, 1, 0, 0], [-k / m, 0, 1 / m, 0], [0, 0, -1 / lag, 0], [-k / m / tau, 0, 1 / m / tau, -1 / tau]]
    return np.array(A), np.array([0, 0, 1 / lag, 0])[:, None]


@pytest.fixture(scope="module")
def ride(cart):
    return jk.simulate(cart, START, ts, {"command": 5.0})


@pytest.mark.slow
def test_states_of_a_linear_system_agree_with_the_exact_solution(cart, ride):
    A, B = matrices(cart)
    augmented = np.block([[A, 5.0 * B], [np.zeros((1, 5))]])
    exact = np.array([(expm(augmented * t) @ [0.2, -0.1, 3.0, 0.0, 1.0])[:4] for t in ts])
    found = np.stack([ride[name] for name in NAMES], axis=1)
    assert np.abs(found - exact).max() < 1e-7
    assert ride.x.shape == (21, 2)
    assert ride.names[3] == ("force", "filtered")
    a = (np.asarray(ride["force"]) - 30.0 * np.asarray(ride["place"])) / 2.0
    np.testing.assert_allclose(ride["acceleration"], a, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(ride["motor.force"], ride["force"])
    assert ride.end.x.shape == (2,)
    again = jk.simulate(cart, ride.state(10), ts[10:] - ts[10], {"command": 5.0})
    np.testing.assert_allclose(again["force"][-1], ride["force"][-1], rtol=1e-7)


@pytest.mark.slow
def test_accelerations_state_rates_and_outputs_at_one_time(cart, ride):
    at = (0.3, [0.1], [0.5], {"force": 2.0, "command": 1.0, "filtered": 0.4})
    assert float(jk.accelerations(cart, *at)[0]) == pytest.approx((2.0 - 3.0) / 2.0)
    rates = jk.state_rates(cart, *at)
    assert float(rates["force"]) == pytest.approx(-10.0)
    assert float(rates["filtered"]) == pytest.approx((-0.5 - 0.4) / 0.05)
    assert float(jk.outputs(cart, *at)["acceleration"]) == pytest.approx(-0.5)
    along = jk.outputs(cart, ride)
    np.testing.assert_allclose(along["acceleration"], ride["acceleration"], atol=1e-13)
    np.testing.assert_allclose(jk.state_rates(cart, ride)["force"], (5.0 - ride["force"]) / 0.1, atol=1e-12)
    with pytest.raises(ValueError, match="no input or state named froce"):
        jk.accelerations(cart, 0.0, [0.0], [0.0], {"froce": 1.0})


@pytest.mark.weekly
def test_a_sweep_over_parameters_and_initial_states(cart):
    rides = sweep(cart, START, ts, {"command": 5.0}, table={"lag": [0.1, 0.2], "force": [3.0, 1.0]})
    assert rides["acceleration"].shape == (2, 21)
    assert rides.x.shape == (2, 21, 2)
    one = jk.simulate(Cart(lag=0.2), jk.State({"place": 0.2}, {"speed": -0.1}, {"force": 1.0}), ts, {"command": 5.0})
    np.testing.assert_allclose(rides.member(1)["acceleration"], one["acceleration"], atol=1e-6)
    assert rides.to_xarray()["motor.force"].shape == (2, 21)


@pytest.mark.weekly
def test_linear_models_and_steady_motions(cart):
    still = equilibrium(cart, inputs={"command": 5.0})
    assert float(still["place"]) == pytest.approx(5.0 / 30.0)
    assert float(still["force"]) == pytest.approx(5.0)
    assert "force" not in still.inputs
    model = linearize(cart, still, outputs=("acceleration", "read", "force"))
    A, B = matrices(cart)
    assert model.states == NAMES
    np.testing.assert_allclose(model.A, A, atol=1e-12)
    np.testing.assert_allclose(model.B, B, atol=1e-12)
    np.testing.assert_allclose(model.C, [[-15, 0, 0.5, 0], [0, 0, 0, 1], [0, 0, 1, 0]], atol=1e-13)
    np.testing.assert_allclose(linearize(cart, still, states=("place", "speed")).A, A[:2, :2], atol=1e-13)
    ride = jk.simulate(cart, still.state, ts, {"command": 5.0})
    np.testing.assert_allclose(ride["place"], 5.0 / 30.0, atol=1e-12)
    with pytest.raises(ValueError, match="force changes with 20"):
        linearize(cart, jk.State([0.1], [0.0], [3.0, 0.0]), {"command": 5.0})


@pytest.mark.slow
def test_a_controller_reads_a_state(cart):
    ride = jk.simulate(cart, START, ts, lambda t, state: {"command": -2.0 * state["force"] + state.x[1]})
    np.testing.assert_allclose(ride["command"], -2.0 * ride["force"] + ride["filtered"], atol=1e-12)


@pytest.mark.weekly
def test_the_audit_includes_the_power_of_states(cart):
    ride = jk.simulate(cart, START, np.linspace(0.0, 1.0, 201), {"command": 5.0})
    kept = jk.audit(cart, ride)
    assert np.abs(kept.energy_error).max() < 1e-6 * np.abs(kept.work).max()


@pytest.mark.weekly
def test_a_lag_and_the_initial_value_of_a_state_are_identified(cart):
    rng = np.random.default_rng(0)
    true = jk.simulate(Cart(lag=0.13, gain=1.2), START, ts, {"command": 5.0})
    names = ("place", "acceleration")
    noise = {"place": 1e-3, "acceleration": 1e-2}
    measured = {name: true[name] + noise[name] * rng.standard_normal(21) for name in names}
    trial = Trial(ts, measured, {"command": 5.0}, sigma=noise, initial={"force": 1.0})
    found = fit(
        cart,
        trial,
        ["lag", "gain"],
        unknown=("place", "speed", "force"),
        simulation=Simulation(step=0.05),
        optimizer=LeastSquares(),
    )
    for name, truth in (("lag", 0.13), ("gain", 1.2)):
        assert abs(found.estimates[name] - truth) < 3.5 * found.standard_errors[name] < 0.2 * truth
    with pytest.raises(ValueError, match="has no coordinate, independent speed or state froce"):
        fit(cart, Trial(ts, measured, sigma=noise, initial={"froce": 1.0}), "lag")
    with pytest.raises(ValueError, match="has no channel acceleratoin"):
        fit(cart, Trial(ts, {"acceleratoin": measured["place"]}, sigma=1.0), "lag")


@pytest.mark.slow
def test_initial_values_of_states_in_every_form(cart):
    assert jk.assemble(cart, {"place": 0.1}, x={"force": 2.0}).x.tolist() == [2.0, 0.0]
    assert jk.assemble(cart, {"place": 0.1}).x.tolist() == [0.0, 0.0]
    stateless = jk.catalog.DoublePendulum(mass=1.0, length=1.0)
    for call, message in (
        (lambda: jk.simulate(cart, jk.State([0.1], [0.0], [1.0]), ts), r"state.x must have the shape \(2,\) for force"),
        (lambda: jk.simulate(cart, jk.State([0.1], [0.0], {"froce": 1.0}), ts), "state.x has no froce"),
        (lambda: jk.simulate(cart, jk.State([0.0], [0.0], [np.nan, 0.0]), ts), r"state\.x: \w+ = nan is not finite"),
        (lambda: jk.simulate(stateless, jk.State([0.1, 0.2], [0.0, 0.0], [1.0]), ts), "has no first-order states"),
        (lambda: jk.assemble(stateless, {}, {}, [1.0]), "has no first-order states"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_exported_functions_take_states_after_the_inputs(cart):
    written = {}
    exec(str(jk.export.numpy(cart)), written)
    at = (0.3, [0.1], [0.5])
    w = {"command": 1.0, "force": 2.0, "filtered": 0.4}
    np.testing.assert_allclose(
        written["state_rates"](*at, [*w.values()]), [*jk.state_rates(cart, *at, w).values()][::-1]
    )
    np.testing.assert_allclose(written["rates"](*at, [*w.values()])[1], jk.accelerations(cart, *at, w), rtol=1e-15)
    with pytest.raises(ValueError, match="which are not supported here"):
        jk.symbolic.linearize(cart)
    with pytest.raises(ValueError, match="no first-order states"):
        jk.export.numpy(jk.catalog.DoublePendulum(mass=1.0, length=1.0), functions=("state_rates",))


def variant(**members):
    return type("Variant", (Cart,), members)()


@pytest.mark.slow_cases(all_but=["members9-*", "members3-*", "members10-*"])
@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"state_rates": lambda *args: (0.0,)}, "must have 2 entries .force, filtered., got 1"),
        ({"state_rates": lambda *args: {"froce": 0.0}}, "not a first-order state: froce"),
        ({"outputs": lambda self, t, q, u, motion, now: None}, "end without a `return`"),
        ({"outputs": lambda self, t, q, u, motion, now: {"place": 1.0}}, "place is already the name of a coordinate"),
        ({"outputs": lambda self, t, q, u, motion, now: {"v": motion.N.x}}, "'v' is a Vector"),
        ({"outputs": lambda self, t, q, u, motion, now: {"q": jnp.zeros(3)}}, "'q' must be one number"),
        (
            {"outputs": lambda self, t, q, u, motion, now: {"a.b": 1.0, "a": {"b": 2.0}}},
            "two outputs have the name a.b",
        ),
        ({"outputs": lambda self, t, q, u, motion, now: {"x": now["motor"]}}, "no 'motor' in the inputs and states"),
        ({"outputs": lambda self, t, q, u, motion, now: {"x": now.acceleration(motion)}}, "needs a Point"),
        ({"outputs": lambda self, t, q, u, motion, now: {"x": now.force("Q")}}, "no 'Q' in the named points"),
        ({"states": ("force", "place")}, "'place' appears in `coordinates` and in `states`"),
    ],
)
def test_invalid_states_raise_by_name(members, message):
    with pytest.raises((ValueError, TypeError, KeyError, NotImplementedError), match=message):
        jk.simulate(variant(**members), jk.State([0.0], [0.0]), ts)


@pytest.mark.parametrize("joined", [lambda base, rate: (*base, rate), lambda base, rate: {**base, "wear": rate}])
def test_states_can_be_added_to_a_base_without_states(joined):
    class Worn(Sled):
        states = ("wear",)

        def state_rates(self, t, q, u, x, motion, now):
            return joined(super().state_rates(t, q, u, x, motion, now), 0.5 + 0.0 * x["wear"])

    assert float(jk.state_rates(Worn(), 0.0, [0.0], [0.0])["wear"]) == 0.5


def test_states_without_rates_are_refused():
    kind = type("Unrated", (Sled,), {"states": ("wear",)})
    with pytest.raises(NotImplementedError, match="define state_rates"):
        jk.state_rates(kind(), 0.0, [0.0], [0.0])
