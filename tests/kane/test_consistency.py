"""Descriptions that contradict themselves: each is refused by name, wherever it is met, and right ones are not."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Slider

import jaxkane as jk

TS = np.linspace(0.0, 0.1, 3)


STATE = jk.State(np.array([0.1, 0.2]), np.array([0.3, 0.4]))


def evaluate(system, state=STATE):
    return jk.accelerations(system, 0.0, state.q, state.u)


# -- speeds


@pytest.mark.parametrize(
    "bent",
    [
        lambda x: jnp.abs(x),
        lambda x: jnp.maximum(x, 0.0),
        lambda x: jnp.minimum(x, 0.0),
        lambda x: jnp.clip(x, -50.0, 50.0),
        lambda x: x + 1e-5 * x * x,
        lambda x: jnp.where(x > 500.0, 2.0 * x, x),
    ],
    ids=["abs", "maximum", "minimum", "clip", "square", "where"],
)
def test_non_affine_velocities_are_detected_at_speeds_of_any_sign_and_size(bent):
    class Bent(Slider):
        def rate(self, u):
            return bent(u["x_dot"])

    with pytest.raises(ValueError, match=r"Bent: the velocity of 'rod' is not affine in x_dot\."):
        evaluate(Bent())


# -- where the numbers are traced


class Doubled(Slider):
    """Wrong: the slider moves twice as fast as its coordinate."""

    def rate(self, u):
        return 2.0 * u["x_dot"]


REFUSED = r"the mass centre of 'rod' moves|the point .* moves"


def calls():
    ride = lambda system: jk.simulate(system, STATE, TS).q.sum()  # noqa: E731
    heavier = lambda system: lambda mass: ride(dataclasses.replace(system, mass=mass))  # noqa: E731
    table = {"mass": np.array([1.0, 2.0])}
    trial = jk.fit.Trial(TS, {"x": np.array([0.1, 0.13, 0.16])}, sigma={"x": 0.01})
    return {
        "simulate": ride,
        "assemble": lambda s: jk.assemble(s, {}),
        "jit": lambda s: jax.jit(heavier(s))(1.0),
        "jit_of_the_state": lambda s: jax.jit(lambda q: jk.accelerations(s, 0.0, q, STATE.u))(STATE.q),
        "grad": lambda s: jax.grad(heavier(s))(1.0),
        "vmap": lambda s: jax.vmap(heavier(s))(np.array([1.0, 2.0])),
        "sweep": lambda s: jk.sweep.sweep(s, STATE, TS, table=jk.sweep.grid(**table)),
        "linearize": lambda s: jk.stability.linearize(s, STATE, steady=False),
        "fit": lambda s: jk.fit.fit(s, trial, ["mass"]),
    }


@pytest.mark.parametrize("call", calls())
def test_every_function_rejects_an_inconsistent_system(call):
    wrong = type("Wrong", (Doubled,), {})()  # a class of its own, which nobody has looked at
    with pytest.raises(ValueError, match=REFUSED):
        calls()[call](wrong)


def test_traced_parameters_without_defaults_are_checked_at_random_values():
    class Tilted(jk.System):
        """Right for any axis and any quaternion of length one."""

        axis: jk.Scalar = jk.parameter(shape=(3,))
        tilt: jk.Scalar = jk.parameter(shape=(4,))
        length: jk.Scalar = jk.parameter(positive=True)
        coordinates, speeds = ("angle",), ("rate",)

        def motion(self, t, q, u):
            N, O = jk.inertial()
            A = N.rotate_euler(self.tilt, (0.0, 0.0, 0.0), "A")
            B = A.rotate(A.vector(*self.axis), q[0], u[0], "B")
            return jk.Motion([jk.Body(1.0, (0.1, 0.1, 0.1), O.fixed(self.length * B.x), B)])

    def energy(axis, tilt, length):
        return jk.kinetic_energy(Tilted(axis, tilt, length), 0.0, jnp.array([0.3]), jnp.array([2.0]))

    given = jnp.array([0.0, 0.0, 3.0]), jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array(0.5)
    np.testing.assert_allclose(jax.jit(energy)(*given), 0.5 * (0.1 + 0.25) * 4.0, rtol=1e-12)


def test_every_static_structure_is_checked():
    class Geared(Slider):
        ratio: int = eqx.field(static=True, default=1)

        def rate(self, u):
            return self.ratio * u["x_dot"]

    assert np.isfinite(evaluate(Geared())).all()
    with pytest.raises(ValueError, match=REFUSED):
        evaluate(Geared(ratio=2))


def test_prescribed_motions_are_checked_at_times_when_they_move():
    class Driven(Slider):
        factor: float = eqx.field(static=True, default=1.0)

        def motion(self, t, q, u):
            N, O = jk.inertial()
            T = N.rotate(1, 0.5 * t**2, self.factor * t, "T")  # at rest at t = 0
            B = T.rotate(3, q["angle"], u["angle_dot"], "B")
            return jk.Motion([jk.Body(1.0, (0.1, 0.1, 0.1), O.moving(q["x"] * B.x, u["x_dot"] * B.x), B)])

    assert np.isfinite(evaluate(Driven())).all()
    with pytest.raises(ValueError, match="the frame 'T' turns with"):
        evaluate(Driven(factor=2.0))


# -- named points and frames, constraints


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            lambda m, q, u: {"frames": {"C": m.N.rotate(1, q["x"], -u["x_dot"])}},
            r"the frame 'C' turns with \(.*\) rad/s by the rates of its coordinates",
        ),
        (
            lambda m, q, u: {"points": {"P": jk.Point.at(3.0 * u["x_dot"] * m.N.y, q["x"] * m.N.y)}},
            r"the point 'P' moves with \(0, .*, 0\) m/s by the rates",
        ),
        (
            lambda m, q, u: {"points": {"P": m["rod"].center.fixed(q["x"] * m["rod"].frame.y)}},
            "the point 'P' moves",
        ),
    ],
    ids=["frame", "velocity", "not fixed"],
)
def test_inconsistent_named_frames_and_points_raise(parts, message):
    class Named(Slider):
        def motion(self, t, q, u):
            motion = super().motion(t, q, u)
            return jk.Motion(motion.bodies, **parts(motion, q, u))

    with pytest.raises(ValueError, match=message):
        evaluate(Named())


def test_contact_points_fixed_to_a_body_pass_the_check():
    class Wheel(jk.System):
        """A wheel that slides and turns on the ground. Its contact is another point of it at every instant."""

        coordinates, speeds = ("x", "spin"), ("x_dot", "spin_rate")

        def motion(self, t, q, u):
            N, O = jk.inertial()
            W = N.rotate(2, q["spin"], u["spin_rate"], "W")
            C = O.moving(q["x"] * N.x - 0.3 * N.z, u["x_dot"] * N.x)
            ground = jk.Point.at(0.0 * N.x, q["x"] * N.x)
            points = {"touching": C.fixed(0.3 * N.z, W), "ground": ground}
            return jk.Motion([jk.Body(2.0, (0.1, 0.2, 0.1), C, W)], points=points)

        def loads(self, t, q, u, motion, inputs):
            return jk.loads.friction(motion["touching"], motion["ground"], 10.0, 0.5, speed=1e-8)

    # It slides with 1.0 + 0.3 * 2.0 m/s: the friction is 5 N backwards, its moment 0.3 * 5 N m.
    u_dot = jk.accelerations(Wheel(), 0.0, jnp.array([0.5, 0.7]), jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(u_dot, [-2.5, -7.5], rtol=1e-9)


def test_a_velocity_residual_that_contradicts_the_configuration_raises():
    class OnACircle(jk.System):
        sign: float = eqx.field(static=True)
        coordinates, speeds = ("x", "y"), ("x_dot",)
        dependent_speeds, dependent_coordinates = ("y_dot",), ("y",)

        def motion(self, t, q, u):
            N, O = jk.inertial()
            ball = jk.Body(1.0, 0.0, O.moving(q[0] * N.x + q[1] * N.y, u[0] * N.x + u[1] * N.y))
            return jk.Motion([ball], [q["x"] * u["x_dot"] + self.sign * q["y"] * u["y_dot"]])

        def configuration_constraints(self, t, q):
            return [q["x"] ** 2 + q["y"] ** 2 - 1.0]

    at = jk.State(np.array([0.6, 0.8]), np.array([1.0]))
    # The speed is kept: u_dot = -(u^2 + v^2) x, with v = -0.75 from x u + y v = 0.
    np.testing.assert_allclose(evaluate(OnACircle(1.0), at), [-1.5625 * 0.6], rtol=1e-12)
    with pytest.raises(ValueError, match=r"the configuration constraint 0 .* changes at a rate of"):
        evaluate(OnACircle(-1.0), at)
    with pytest.raises(ValueError, match=r"the configuration constraint 0 .* changes at a rate of"):
        jk.assemble(OnACircle(0.5), {"x": 0.6, "y": 0.7})


@pytest.mark.slow
def test_rates_of_euler_parameters_that_violate_the_unit_norm_raise():
    class Top(jk.System):
        factor: float = eqx.field(static=True)
        coordinates, speeds = ("e1", "e2", "e3", "e4"), ("w1", "w2", "w3")

        def motion(self, t, q, u):
            N, O = jk.inertial()
            return jk.Motion([jk.Body(1.0, (0.1, 0.2, 0.2), O, N.rotate_euler(q, u, "T"))])

        def q_dot(self, t, q, u):
            return [self.factor * e for e in jk.rotations.euler_parameter_rates(q, u)]

        def configuration_constraints(self, t, q):
            return [jk.rotations.euler_parameter_norm(q)]

    turning, upright = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 0.0, 1.0])
    unbound = type("Unbound", (Top,), {"configuration_constraints": lambda self, t, q: ()})
    for kind in (Top, unbound):  # also without the constraint
        assert np.isfinite(evaluate(kind(1.0), jk.State(upright, turning))).all()
        with pytest.raises(ValueError, match=r"the frame 'T' turns with"):
            evaluate(kind(2.0), jk.State(upright, turning))
    for top in (Top(1.0), type("Top", (Top,), {})(1.0)):  # after a good state, and as the first
        with pytest.raises(ValueError, match=r"Top: .* frame 'T' .* Euler parameters have the norm 2 instead of 1"):
            evaluate(top, jk.State(2.0 * upright, turning))
    assert np.isfinite(evaluate(Top(1.0), jk.State(1.0001 * upright, turning))).all()  # measured to four digits


@pytest.mark.filterwarnings("ignore:.*its description uses:UserWarning")  # a constant matrix is no single numbers
def test_a_matrix_that_is_not_a_rotation_raises():
    class Sheared(Slider):
        def motion(self, t, q, u):
            N, O = jk.inertial()
            sheared = lambda t, q: jnp.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # noqa: E731
            B = N.rotate_by(sheared, t, q, u, "B")
            return jk.Motion([jk.Body(1.0, (0.1, 0.1, 0.1), O.moving(q["x"] * N.x, u["x_dot"] * N.x), B)])

    with pytest.raises(
        ValueError, match=r"the orientation of the frame 'B' in 'N' is not a rotation: \[R\] \[R\]\^T differs"
    ):
        evaluate(Sheared())


# -- points that `loads` makes


class Pushed(jk.System):
    """A rod on a hinge with a force and a torque on it, said in different ways."""

    way: str = eqx.field(static=True)
    coordinates, speeds, inputs = ("angle",), ("rate",), ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q[0], u[0], "B")
        return jk.Motion([jk.Body(2.0, (0.0, 0.5, 0.5), O.fixed(0.5 * B.x), B, name="rod")], frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        read = {"again": lambda: self.motion(t, q, u), "still": lambda: self.motion(t, q, (0.0,))}
        m = read.get(self.way, lambda: motion)()
        B, damping = m["B"], -3.0 * u["rate"]
        tip = jk.Point.at(u["rate"] * B.y) if self.way == "at" else m["rod"].center.fixed(0.5 * B.x)
        return jk.Force((7.0 + damping) * B.y, tip), jk.Torque(inputs["torque"] * B.z, B)


@pytest.mark.parametrize("way", ["given", "again", "at"])
def test_loads_may_act_on_points_created_in_loads(way):
    q, u, w = jnp.array([0.4]), jnp.array([0.5]), {"torque": 0.3}
    np.testing.assert_allclose(jk.accelerations(Pushed(way), 0.0, q, u, w), [(7.0 - 1.5 + 0.3) / 1.0], rtol=1e-12)
    np.testing.assert_allclose(jk.generalized_active_forces(Pushed(way), 0.0, q, u, w), [5.8], rtol=1e-12)
    slope = jax.jit(jax.grad(lambda u: jk.accelerations(Pushed(way), 0.0, q, u, w)[0]))(u)
    np.testing.assert_allclose(slope, [-3.0], rtol=1e-12)


@pytest.mark.slow
def test_loads_on_points_created_in_loads_do_work():
    ride = jk.simulate(Pushed("again"), jk.State([0.4], [0.5]), np.linspace(0.0, 0.1, 6), {"torque": 0.3})
    audit = jk.audit(Pushed("again"), ride)
    assert audit.ok
    assert audit.work[-1] > 0.1


def test_loads_on_points_of_a_motion_without_speeds_are_refused():
    with pytest.raises(ValueError, match=r"Pushed: the (frame 'B' turns|point .* moves) with .*self.motion\(t, q"):
        evaluate(Pushed("still"), jk.State(np.array([0.4]), np.array([0.5])))


# -- what methods return, and ask for


@pytest.mark.parametrize(
    ("ask", "error"),
    [
        (lambda x: np.sin(x), "np.sin"),
        (lambda x: x if x > 0 else -x, "jnp.where"),
        (lambda x: max(x, 0.5), "jnp.maximum"),
        (lambda x: float(x), "float"),
        (lambda x: x.item(), "float"),
        (lambda x: [1.0, 2.0][x.astype(int)], "static"),
    ],
    ids=["numpy", "if", "max", "float", "item", "index"],
)
@pytest.mark.parametrize("method", ["motion", "q_dot", "loads", "configuration_constraints"])
def test_methods_that_need_concrete_values_raise(ask, error, method):
    class Asking(Slider):
        def motion(self, t, q, u):
            return super().motion(t, (ask(q[0]) if method == "motion" else q[0], q[1]), u)

        def q_dot(self, t, q, u):
            return (u[0], 0.0 * ask(q[0]) + u[1]) if method == "q_dot" else u

        def loads(self, t, q, u, motion, inputs):
            return jk.weight(motion, (ask(q[0]) if method == "loads" else 1.0) * motion.N.y)

        def configuration_constraints(self, t, q):
            return [ask(q[0])] if method == "configuration_constraints" else []

    with pytest.raises(TypeError, match=rf"Asking.{method} uses a traced value .* {error}") as caught:
        evaluate(Asking())
    assert "jax.errors" in str(caught.value.__cause__)


@pytest.mark.slow
def test_nested_residuals_of_numbers_and_vectors_are_accepted():
    class Nested(Slider):
        speeds, dependent_speeds = ("x_dot",), ("angle_dot",)

        def motion(self, t, q, u):
            return jk.Motion(super().motion(t, q, u).bodies, self.wrap(u["x_dot"] - 2.0 * u["angle_dot"]))

    at = jk.State(STATE.q, np.array([0.3]))
    ways = (lambda c: [c], lambda c: c, lambda c: [[c]], lambda c: jnp.stack([c]))
    for i, wrap in enumerate(ways):
        system = type(f"Nested{i}", (Nested,), {"wrap": staticmethod(wrap)})()
        np.testing.assert_allclose(jk.dependent_speeds(system, 0.0, at.q, at.u), [0.15], rtol=1e-14)
    for wrong in (None, "x", True):
        system = type("Wrong", (Nested,), {"wrap": staticmethod(lambda c, wrong=wrong: [wrong])})()
        with pytest.raises(TypeError, match="velocity residuals must be a list of numbers and Vectors"):
            evaluate(system, at)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda u: None, r"Odd.q_dot must be 2 numbers in a sequence \(x, angle\), got None"),
        (lambda u: u[:1], r"Odd.q_dot must have 2 entries \(x, angle\), got 1"),
        (lambda u: [[u[0], u[1]]], r"Odd.q_dot must be 2 numbers"),
        (lambda u: (u[0], jnp.stack([u[1], u[1]])), r"Odd.q_dot must be 2 numbers .*shape \(2,\)"),
    ],
)
def test_invalid_return_values_of_q_dot_raise(returned, message):
    class Odd(Slider):
        def q_dot(self, t, q, u):
            return returned(u)

    with pytest.raises((TypeError, ValueError), match=message):
        evaluate(Odd())


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("loads", r"Silent.loads must return Forces and Torques, got None. Does it end without"),
        ("configuration_constraints", "Silent: the residuals of configuration_constraints must be a list of numbers"),
    ],
)
def test_methods_without_a_return_value_raise(method, message):
    returns_none = {
        "loads": lambda self, t, q, u, motion, inputs: None,
        "configuration_constraints": lambda self, t, q: None,
    }
    silent = type("Silent", (Slider,), {method: returns_none[method]})
    with pytest.raises(TypeError, match=message):
        evaluate(silent())


# -- dependent speeds that no residual holds


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 2])
def test_a_residual_without_its_dependent_speed_raises(k):
    class Blind(jk.System):
        coordinates = ("x", "y", "z")
        speeds = ("x_dot", "y_dot", "z_dot")[: 3 - k]
        dependent_speeds = ("x_dot", "y_dot", "z_dot")[3 - k :]

        def motion(self, t, q, u):
            N, O = jk.inertial()
            P = O.moving(N.vector(*q), N.vector(*u))
            return jk.Motion([jk.Body(1.0, 0.0, P)], [u["x_dot"], u["y_dot"] - u["x_dot"]][:k])

    system, q, u = Blind(), np.zeros(3), np.ones(3 - k)
    with pytest.raises(ValueError, match=r"Blind: the constraints .* \(no velocity residual depends on .*z_dot\)"):
        jk.accelerations(system, 0.0, q, u)
    found = jk.best_dependent_speeds(system, 0.0, q)
    assert found.condition == np.inf
    assert set(found.best) == {"x_dot", "y_dot"} if k == 2 else found.best == ("x_dot",)
    assert np.isnan(jax.jit(lambda u: jk.dependent_speeds(system, 0.0, q, u))(u)).any()


def test_a_force_on_a_massless_point_raises():
    class Light(jk.System):
        coordinates, speeds = ("x", "y"), ("x_dot", "y_dot")

        def motion(self, t, q, u):
            N, O = jk.inertial()
            P = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
            return jk.Motion([jk.Body(1.0, 0.0, P)], points={"Q": P.moving(q["y"] * N.y, u["y_dot"] * N.y)})

        def loads(self, t, q, u, motion, inputs):
            return jk.Force(3.0 * motion.N.y, motion["Q"])

    with pytest.raises(ValueError, match="no mass moves with the speed y_dot"):
        evaluate(Light())
