"""A name that is not there is answered with what was probably meant, wherever names are looked up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import OnACircle

import jaxkane as jk

PENDULUM = jk.catalog.DoublePendulum()
TS = jnp.array([0.0, 0.1])


@pytest.fixture(scope="module")
def ride():
    return jk.simulate(PENDULUM, jk.State([0.1, 0.2], [0.0, 0.0]), TS)


def test_a_hint_is_short():
    names = {"coordinates": tuple(f"angle{i}" for i in range(49)), "speeds": tuple(f"rate{i}" for i in range(49))}
    many = type("Many", (type(PENDULUM),), names)()
    with pytest.raises(ValueError, match=r"\.\.\. \(49 in all\)") as raised:
        jk.accelerations(many, 0.0, {"wobble": 0.1}, {})
    assert len(str(raised.value)) < 250
    with pytest.raises(ValueError, match="did you mean 'angle7' or 'angle47'"):
        jk.accelerations(many, 0.0, {"angel7": 0.1}, {})


@pytest.mark.slow
def test_every_lookup_of_a_misspelt_name_suggests_the_correct_one(ride):
    meant = "did you mean 'theta1'"
    state = jk.State([0.1, 0.2], [0.0, 0.0])
    lookups = [
        lambda: ride["thetta1"],
        lambda: jk.assemble(PENDULUM, {"thetta1": 0.1}),
        lambda: jk.accelerations(PENDULUM, 0.0, {"thetta1": 0.1}, {}),
        lambda: jk.stability.equilibrium(PENDULUM, hold=("thetta1",)),
        lambda: jk.stability.linearize(PENDULUM, jk.State([0.0, 0.0], [0.0, 0.0]), outputs=("thetta1",)),
        lambda: jk.stability.linearize(PENDULUM, jk.State([0.0, 0.0], [0.0, 0.0]), states=("thetta1",)),
        lambda: jk.plot.trajectories(ride, ["thetta1"]),
        lambda: jk.fit.fit(PENDULUM, [jk.fit.Trial(np.array(TS), {"thetta1": [0.0, 0.0]}, sigma=1.0)], ["length"]),
        lambda: jk.sweep.grid(theta1=[0.1, 0.2])["thetta1"],
    ]
    for look_up in lookups:
        with pytest.raises((KeyError, ValueError), match=meant):
            look_up()
    with pytest.raises(ValueError, match="did you mean 'shoulder_torque'"):
        jk.simulate(PENDULUM, state, TS, {"sholder_torque": 1.0})
    with pytest.raises(KeyError, match="did you mean 'theta2_dot'"):
        jk.simulate(PENDULUM, state, TS, {"elbow_torque": lambda t, state: state["theta2_dott"]})


class Undeclared(OnACircle):
    """The same, which does not say which of its coordinates depends."""

    dependent_coordinates = ()


@pytest.mark.weekly
def test_dicts_are_accepted_for_coordinates_and_speeds():
    circle, at, moving = OnACircle(), {"y": -0.8, "x": 0.6}, {"x_dot": 0.5}
    q, u = np.array([0.6, -0.8]), np.array([0.5])
    for function in (jk.accelerations, jk.equations_of_motion, jk.dependent_speeds, jk.constraint_forces):
        by_name, by_place = function(circle, 0.0, at, moving), function(circle, 0.0, q, u)
        for one, other in zip(jax.tree.leaves(by_name), jax.tree.leaves(by_place), strict=True):
            np.testing.assert_array_equal(one, other)
    assert jk.best_dependent_speeds(circle, 0.0, at).current == ("y_dot",)
    by_name, by_place = (jk.simulate(circle, state, TS) for state in (jk.State(at, moving), jk.State(q, u)))
    np.testing.assert_array_equal(by_name.q, by_place.q)
    several = jk.sweep.sweep(PENDULUM, jk.State({"theta1": np.array([0.1, 0.2])}, {}), TS)
    np.testing.assert_array_equal(several["theta1"][:, 0], [0.1, 0.2])
    model = jk.stability.linearize(PENDULUM, jk.State({}, {}))
    np.testing.assert_array_equal(model.A, jk.stability.linearize(PENDULUM, jk.State([0.0, 0.0], [0.0, 0.0])).A)


def test_an_omitted_dependent_coordinate_is_rejected():
    circle, match = OnACircle(), r"OnACircle: q omits y.*jaxkane\.assemble"
    for evaluate in (
        lambda: jk.accelerations(circle, 0.0, {"x": 1.0}, {}),
        lambda: jax.jit(lambda x: jk.accelerations(circle, 0.0, {"x": x}, {}))(1.0),
        lambda: jk.constraint_forces(circle, 0.0, {"x": 1.0}, {}),
        lambda: jk.simulate(circle, jk.State({"x": 1.0}, {}), TS),
        lambda: jk.best_dependent_speeds(circle, 0.0, {"x": 1.0}),
        lambda: jk.stability.linearize(circle, jk.State({"x": 0.0}, {})),
        lambda: jk.sweep.sweep(circle, jk.State({"x": np.array([0.1, 0.2])}, {}), TS),
    ):
        with pytest.raises(ValueError, match=match):
            evaluate()
    with pytest.raises(ValueError, match=r"u contains y_dot, but dependent speeds .* Omit it"):
        jk.accelerations(circle, 0.0, {"x": 0.6, "y": -0.8}, {"y_dot": 1.0})


def test_omitted_coordinates_that_violate_a_constraint_are_rejected():
    with pytest.raises(ValueError, match=r"Undeclared: with y omitted from q.*violated by \[-0\.64\]"):
        jk.accelerations(Undeclared(), 0.0, {"x": 0.6}, {})
    at = jax.jit(lambda x: jk.accelerations(Undeclared(), 0.0, {"y": x}, {"x_dot": 0.5}))
    np.testing.assert_allclose(at(1.0), 0.0, atol=1e-15)
    assert np.isnan(at(0.9)).all()


def test_a_state_can_be_a_list_of_traced_numbers():
    """As plain numbers in a list are taken; d q / d x = (1, 0), and a type of its own is kept."""
    q = lambda x: jk.State([x, 1], [0.0, 0.0]).q  # noqa: E731
    np.testing.assert_array_equal(jax.jit(jax.jacfwd(q))(0.3), [1.0, 0.0])
    assert jax.eval_shape(q, np.float32(0.3)).dtype == np.float32


@pytest.mark.slow
def test_a_mixin_class_can_read_by_name():
    class Spring:  # no System
        def loads(self, t, q, u, motion, inputs):
            return super().loads(t, q, u, motion, inputs), jk.Torque(-5.0 * q["theta1"] * motion.N.z, motion.bodies[0])

    class Mixed(Spring, jk.catalog.DoublePendulum):
        pass

    class Written(jk.catalog.DoublePendulum):
        def loads(self, t, q, u, motion, inputs):
            return super().loads(t, q, u, motion, inputs), jk.Torque(-5.0 * q["theta1"] * motion.N.z, motion.bodies[0])

    mixed, written = (jk.accelerations(kind(), 0.0, [0.3, 0.1], [0.0, 0.0]) for kind in (Mixed, Written))
    np.testing.assert_array_equal(mixed, written)
    assert not np.allclose(mixed, jk.accelerations(PENDULUM, 0.0, [0.3, 0.1], [0.0, 0.0]))


T = np.linspace(0.0, 1.0, 5)
TRIAL = jk.fit.Trial(T, {"theta1": 0.1 * T}, {"shoulder_torque": T}, sigma=0.1)


def _model():
    at_rest = jk.State(np.zeros(2), np.zeros(2))
    return jk.stability.linearize(PENDULUM, at_rest)


def _posed(*free, **options):
    return jk.fit.Problem.of(PENDULUM, TRIAL, ("mass", *free), simulation=jk.fit.Simulation(step=0.1), **options)


ONE_NAME = {
    "steady_turn, hold": lambda one, ride: jk.stability.steady_turn(PENDULUM, hold=one),
    "linearize, outputs": lambda one, ride: jk.stability.linearize(PENDULUM, ride.state(), outputs=one, steady=False),
    "lqr, inputs": lambda one, ride: jk.stability.lqr(_model(), np.eye(4), 1.0, inputs=one),
    "assemble, free": lambda one, ride: jk.assemble(PENDULUM, ride.state().q, free=one),
    "trajectories, names": lambda one, ride: jk.plot.trajectories(ride, one),
    "symbolic linearize, states": lambda one, ride: jk.symbolic.linearize(PENDULUM, states=one),
    "robot_bicycle, channels": lambda one, ride: jk.data.robot_bicycle(one),
    "Inertia, fixed": lambda one, ride: jk.fit.Problem.of(
        jk.catalog.RigidBody(), TRIAL_OF_A_BODY, jk.fit.Inertia(("I11", "I22", "I33"), mass="mass", fixed=one)
    ),
    "Offset": lambda one, ride: _posed(jk.fit.Offset(one, each="trial")),
} | {
    f"fit, {argument}": lambda one, ride, argument=argument: _posed(**{argument: one})
    for argument in ("zero_order_hold", "unknown")
}
TRIAL_OF_A_BODY = jk.fit.Trial(T, {"omega1": 0.1 * T}, sigma=0.1)


@pytest.mark.parametrize("ask", ONE_NAME.values(), ids=ONE_NAME)
def test_a_single_name_is_not_split_into_letters(ask, ride):
    with pytest.raises((ValueError, KeyError), match="wobble"):
        ask("wobble", ride)


@pytest.mark.slow
def test_a_single_name_is_equivalent_to_a_list_of_one_name():
    assert (
        _posed(zero_order_hold="shoulder_torque").model.zero_order_hold
        == _posed(zero_order_hold=["shoulder_torque"]).model.zero_order_hold
        == ("shoulder_torque",)
    )
    models = [
        jk.stability.linearize(PENDULUM, jk.State(np.zeros(2), np.zeros(2)), outputs=o) for o in ("theta2", ["theta2"])
    ]
    np.testing.assert_array_equal(models[0].C, models[1].C)
    assert models[0].outputs == ("theta2",)


def test_an_unknown_attribute_of_the_module_raises():
    assert {"simulate", "animate", "fit"} <= set(dir(jk))
    with pytest.raises(AttributeError, match="module 'jaxkane' has no attribute 'simulated'"):
        _ = jk.simulated
