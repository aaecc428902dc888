"""Motion over time: accuracy, inputs, statuses, gradients, and what is refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from slopes import differences, slopes

import jaxkane as jk
from jaxkane.catalog import DoublePendulum, WhippleBicycle

BIKE = WhippleBicycle.benchmark()
PENDULUM = DoublePendulum(mass=1.0, length=1.0)
TS = jnp.linspace(0.0, 1.0, 11)
START = jk.State(jnp.array([1.0, -0.5]), jnp.array([0.0, 0.3]))


@pytest.mark.weekly
def test_inputs_of_every_kind():
    forward = {"adjoint": "forward"}
    constant, number = (jk.simulate(PENDULUM, START, TS, {"elbow_torque": x}, **forward) for x in (2.0, jnp.array(2.0)))
    np.testing.assert_array_equal(constant["elbow_torque"], 2.0)
    np.testing.assert_array_equal(number.q, constant.q)
    ramp = jk.simulate(PENDULUM, START, TS, {"elbow_torque": np.asarray(TS) * 3.0}, **forward)
    assert float(jnp.abs(ramp.q - constant.q).max()) > 0.1
    kinds = {
        "function": {"elbow_torque": lambda t, state: 3.0 * t, "shoulder_torque": 0},
        "samples at other times": {"elbow_torque": jk.Samples(jnp.array([0.0, 9.0]), jnp.array([0.0, 27.0]))},
        "one function": lambda t, state: {"elbow_torque": 3.0 * t},
    }
    for kind, inputs in kinds.items():
        ride = jk.simulate(PENDULUM, START, TS, inputs, **forward)
        np.testing.assert_allclose(ride.q, ramp.q, atol=1e-7, err_msg=kind)
        np.testing.assert_allclose(ride["elbow_torque"], 3.0 * TS, rtol=1e-12, err_msg=kind)
        np.testing.assert_array_equal(ride["shoulder_torque"], 0.0)


class Wheel(jk.System):
    """It rolls along N.x, with a torque about its axle; how fast its centre goes follows from its spin."""

    coordinates, speeds, dependent_speeds, inputs = ("x", "spin"), ("spin_rate",), ("x_dot",), ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(2, q["spin"], u["spin_rate"])
        wheel = jk.Body(2.0, (0.15, 0.25, 0.15), O.moving(q["x"] * N.x, u["x_dot"] * N.x), B, name="wheel")
        return jk.Motion([wheel], [u["x_dot"] - 0.5 * u["spin_rate"]])

    def q_dot(self, t, q, u):
        return u["x_dot"], u["spin_rate"]

    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(inputs["torque"] * motion.N.y, motion["wheel"])


@pytest.mark.slow
def test_a_controller_reads_the_state_by_name():
    """A coordinate, a speed and a dependent speed: 1.5 x'' = -3 x - 0.6 x', by the matrix exponential."""

    def drive(t, state):
        return {"torque": -3.0 * state["x"] - 0.4 * state["x_dot"] - 0.1 * state["spin_rate"]}

    ride = jk.simulate(Wheel(), jk.State({"x": 0.4, "spin": 0.0}, {"spin_rate": 1.0}), TS, drive)
    A = np.array([[0.0, 1.0], [-2.0, -0.4]])
    x, x_dot = np.stack([expm(A * t) @ [0.4, 0.5] for t in np.asarray(TS)], axis=1)
    np.testing.assert_allclose(ride["x"], x, atol=1e-7)
    np.testing.assert_allclose(ride["x_dot"], x_dot, atol=1e-7)
    np.testing.assert_allclose(ride["torque"], -3.0 * x - 0.6 * x_dot, atol=1e-6)


@pytest.mark.weekly
def test_a_torque_that_becomes_nan_and_a_state_that_is_nan_under_jit_have_a_status():
    torque = {"torque": lambda t, state: jnp.where(t < 0.5, 1.0, jnp.nan)}
    run = jax.jit(lambda q: jk.simulate(Pendulum(), jk.State(q, jnp.zeros(1)), TS, torque))
    ride = run(jnp.array([0.4]))
    assert ride.status == jk.Status.STEP_TOO_SMALL
    assert not ride.ok
    assert 0.49 < float(ride.t_end) <= 0.5
    np.testing.assert_array_equal(np.isfinite(ride["angle"]), TS <= ride.t_end)
    bad = run(jnp.array([jnp.nan]))
    assert bad.reason == "invalid"
    assert np.isnan(bad.q).all()


@pytest.mark.slow
def test_a_fall_and_singular_speeds_end_a_bicycle_simulation():
    """A roll beyond 78 degrees is a fall. Steered to 1.6 rad it is just beside 91.77 degrees, where for the upright
    bicycle the dependent speeds are singular."""

    def ride(angles, rates):
        return jk.simulate(BIKE, jk.assemble(BIKE, angles, rates), TS)

    fell = ride({"roll": 1.2}, {"roll_rate": 2.0, "rear_wheel_rate": -10.0})
    assert fell.reason == "fell over"
    np.testing.assert_allclose(fell.end.q[BIKE.coordinates.index("roll")], np.arccos(0.2), atol=1e-9)
    assert np.isnan(fell.q[1:]).all()
    across = ride({"steer": 1.6}, {"steer_rate": 0.5, "rear_wheel_rate": -1.0})
    assert across.status == jk.Status.SINGULAR_SPEEDS
    np.testing.assert_allclose(across.end.q[BIKE.coordinates.index("steer")], np.deg2rad(91.77), atol=1e-4)
    assert np.isnan(across.q[1:]).all()


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("adjoint", "mode"),
    [
        ("auto", "forward"),
        ("both", "reverse"),
        (diffrax.DirectAdjoint(), "forward"),
        (diffrax.DirectAdjoint(), "reverse"),
        (diffrax.RecursiveCheckpointAdjoint(), "reverse"),
        (diffrax.ForwardMode(), "forward"),
    ],
    ids=str,
)
def test_every_adjoint_against_differences(adjoint, mode):
    """Derivatives by length, start and torque of a pendulum, in four steps. The trajectory states its adjoint."""

    def read(x, _):
        torque = {"torque": x[2] * TS[:3]}
        options = {"adjoint": adjoint, "step": 0.05, "max_steps": 4}
        ride = jk.simulate(Pendulum(length=x[0]), jk.State(x[1:2], jnp.zeros(1)), TS[:3], torque, **options)
        assert ride.adjoint == ("fixed steps" if isinstance(adjoint, str) else type(adjoint).__name__)
        return ride["angle"][-1] + ride["rate"][1]

    both, x = slopes(read, mode), jnp.array([1.1, 0.4, 3.0])
    np.testing.assert_allclose(both(x)[0], differences(both, x, 1e-4), rtol=1e-6)


@pytest.mark.slow
def test_every_order_of_transformations_has_the_same_derivative():
    def read(u):
        return jk.simulate(Pendulum(), jk.State(jnp.array([0.4]), u), TS[:3], step=0.05, max_steps=4)["angle"][-1]

    u = jnp.array([0.2])
    found = {
        "grad": jax.grad(read)(u),
        "jit of grad": jax.jit(jax.grad(read))(u),
        "grad of jit": jax.grad(jax.jit(read))(u),
        "jvp of jit": jax.jvp(jax.jit(read), (u,), (jnp.ones(1),))[1],
        "jacfwd of jit": jax.jacfwd(jax.jit(read))(u),
        "linearize": jax.linearize(read, u)[1](jnp.ones(1)),
        "vmap of grad": jax.vmap(jax.grad(read))(u[None])[0],
        "jvp of vmap": jax.jvp(jax.vmap(read), (u[None],), (jnp.ones((1, 1)),))[1],
        "grad of sum of vmap": jax.grad(lambda u: jnp.sum(jax.vmap(read)(u[None])))(u),
    }
    for how, slope in found.items():
        np.testing.assert_allclose(np.ravel(slope), np.ravel(found["grad"]), rtol=1e-12, err_msg=how)
    with pytest.raises(ValueError, match=r"ImplicitAdjoint\(\) differentiates a steady state"):
        jk.simulate(Pendulum(), jk.State(u, u), TS[:3], adjoint=diffrax.ImplicitAdjoint())


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["reverse over reverse", "forward over reverse", "reverse over forward"])
def test_second_derivatives_with_reverse_mode_raise_with_advice(mode):
    def read(rate):
        state = jk.State(jnp.array([0.4]), jnp.stack([rate]))
        return jk.simulate(Pendulum(), state, TS[:3], step=0.05, max_steps=4)["angle"][-1]

    derivative = {
        "reverse over reverse": jax.grad(jax.grad(read)),
        "forward over reverse": jax.hessian(read),
        "reverse over forward": jax.grad(jax.jacfwd(read)),
    }[mode]
    with pytest.raises(TypeError, match=r"use forward mode twice, as in jax.jacfwd\(jax.jacfwd\(f\)\)"):
        jax.eval_shape(derivative, 0.2)


@pytest.mark.slow
def test_a_state_of_mixed_types_is_promoted():
    state = jk.State(jnp.array([0.4], jnp.float32), jnp.array([0.1]))
    assert jk.simulate(Pendulum(), state, TS[:3], step=0.05, max_steps=4).q.dtype == jnp.float64


@pytest.mark.slow
def test_changing_the_accuracy_does_not_recompile():
    coarse, fine = (jk.simulate(PENDULUM, START, TS, step=x) for x in (0.1, 0.05))
    compiled = []
    listener = lambda event, _, **more: compiled.append(event) if "backend_compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listener)
    finer = jk.simulate(PENDULUM, START, TS, step=0.025)
    assert [int(ride.stats["steps"]) for ride in (coarse, fine, finer)] == [10, 20, 40]
    assert not compiled
    jk.simulate(PENDULUM, START, TS)
    compiled.clear()
    tolerant, strict = (jk.simulate(PENDULUM, START, TS, rtol=x, atol=x) for x in (1e-3, 1e-10))
    assert int(tolerant.stats["steps"]) < int(strict.stats["steps"])
    assert not compiled


@pytest.mark.slow
def test_a_simulation_can_be_resumed_from_its_end():
    whole = jk.simulate(PENDULUM, START, TS, rtol=1e-11, atol=1e-11)
    first = jk.simulate(PENDULUM, START, TS[:6], rtol=1e-11, atol=1e-11)
    second = jk.simulate(PENDULUM, first.state(), TS[5:], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(second.q[-1], whole.q[-1], atol=1e-9)


@pytest.mark.weekly
def test_invalid_times_and_samples_give_status_invalid_under_jit():
    """Under a trace, no check can read the values."""

    @jax.jit
    @jax.vmap
    def statuses(ts, knots, values):
        torques = [None, *({"torque": jk.Samples(knots, values, zero_order_hold=x)} for x in (False, True))]
        return [jk.simulate(Pendulum(), jk.State([0.4], [0.0]), ts, x).status for x in torques]

    ts, knots, values = np.array(TS), np.linspace(-0.5, 1.5, 9), np.ones(9)
    cases, of_times, of_samples = [(ts, knots, values)], [jk.Status.COMPLETED], [jk.Status.COMPLETED]
    for i, x in ((0, -np.inf), (0, np.nan), (-1, np.inf), (-1, np.nan), (4, np.nan), (4, 9.0)):
        for k in range(3):
            case = [ts.copy(), knots.copy(), values.copy()]
            case[k][i] = x
            cases.append(case)
            of_times.append(jk.Status.INVALID if k == 0 else jk.Status.COMPLETED)
            valid = k == 2 and x == 9.0  # any number is a valid value
            of_samples.append(jk.Status.COMPLETED if valid else jk.Status.INVALID)
    found = statuses(*(np.stack(x) for x in zip(*cases, strict=True)))
    np.testing.assert_array_equal(found, [of_times, of_samples, of_samples])


def test_progress_is_printed_on_request_only(capfd):
    jk.simulate(PENDULUM, START, TS)
    assert capfd.readouterr() == ("", "")
    jax.block_until_ready(jk.simulate(PENDULUM, START, TS, progress=True))
    jax.effects_barrier()
    assert "%" in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((PENDULUM, START, [0.0, 0.5, 0.4]), r"finite and increase: ts\[1\] = 0.5 is followed by 0.4"),
        ((PENDULUM, START, [0.0, 0.5, 0.5]), "must be finite and increase"),
        ((PENDULUM, START, [0.0]), "at least two times"),
        ((PENDULUM, START, TS, {"elbow": 1.0}), "no input named elbow; it has shoulder_torque, elbow_torque"),
        ((PENDULUM, START, TS, {"elbow_torque": np.ones(7)}), r"'elbow_torque' has samples of the shape \(7,\)"),
        ((PENDULUM, jk.State(np.zeros(3), np.zeros(2)), TS), r"state.q must have the shape \(2,\)"),
        ((PENDULUM, jk.State(np.zeros((4, 2)), np.zeros(2)), TS), "sweep or jax.vmap"),
        ((BIKE, jk.State(np.full(8, 0.3), np.zeros(3)), TS), r"violate the configuration constraints by \["),
        ((PENDULUM, jk.State([np.nan, 0.0], [0.0, 0.0]), TS), r"state.q: theta1 = nan is not finite"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        jk.simulate(*arguments)


def test_an_unknown_name_in_a_trajectory_raises():
    with pytest.raises(KeyError, match="no 'theta3' in this trajectory; did you mean 'theta"):
        _ = jk.simulate(PENDULUM, START, TS)["theta3"]


class Pendulum(jk.System):
    mass: jk.Scalar = jk.parameter(2.0)
    length: jk.Scalar = jk.parameter(1.1)
    coordinates, speeds, inputs = ("angle",), ("rate",), ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q[0], u[0])
        return jk.Motion([jk.Body(self.mass, 0.0, O.fixed(-self.length * rod.y), rod)])

    def loads(self, t, q, u, motion, inputs):
        return [*jk.weight(motion, -9.81 * motion.N.y), jk.Torque(inputs["torque"] * motion.N.z, motion.bodies[0])]


@pytest.mark.slow
def test_a_simulation_that_ends_at_an_inner_input_sample():
    """The last step once ended a rounding error before this sample. The sample was NaN, but the status "completed"."""
    ts, start = jnp.linspace(0.0, 2.5, 51), jk.State(jnp.array([0.1]), jnp.zeros(1))
    torque = {"torque": jk.Samples(ts, 3.0 * jnp.sin(2.0 * ts))}
    whole = jk.simulate(Pendulum(), start, ts, inputs=torque)
    part = jk.simulate(Pendulum(), start, ts[:3], inputs=torque)
    np.testing.assert_allclose(part.q, whole.q[:3], atol=1e-8)
