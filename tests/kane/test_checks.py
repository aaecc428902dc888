"""Wrong descriptions and bad numbers: each is caught with an error that names what is wrong."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Bead, OnACircle, Sled, Slider

import jaxkane as jk
from jaxkane.catalog import DoublePendulum, WhippleBicycle

STATE = ([0.1, 0.2], [0.3, 0.4])


def evaluate(system, q=STATE[0], u=STATE[1]):
    return jk.accelerations(system, 0.0, q, u)


def variant(base=Slider, name="Wrong", **members):
    """An instance of a subclass. Each member replaces one of the base class."""
    return type(name, (base,), members)()


def sliding(q, u):
    N, O = jk.inertial()
    return N, O.moving(q["x"] * N.x, u["x_dot"] * N.x)


def with_residuals(*residuals):
    def motion(self, t, q, u):
        return jk.Motion(Slider.motion(self, t, q, u).bodies, [residual(u) for residual in residuals])

    return motion


def with_body(body):
    """A `motion` with the body that a function (N, P, q, u) returns."""

    def motion(self, t, q, u):
        N, P = sliding(q, u)
        return jk.Motion([body(N, P, q, u)])

    return motion


def not_fixed(N, P, q, u):
    B = N.rotate(3, q["angle"], u["angle_dot"], "B")
    return jk.Body(1.0, (0.1, 0.1, 0.1), jk.inertial()[1].fixed(q["x"] * B.x), B, name="rod")


HELD = {"speeds": ("x_dot",), "dependent_speeds": ("angle_dot",)}
SLOPE = lambda u: u["x_dot"] - u["angle_dot"]  # noqa: E731
INVALID = {
    "no motion": ({"motion": jk.System.motion}, "Wrong must define motion"),
    "fewer speeds": (
        {"speeds": ("x_dot",), "motion": with_body(lambda N, P, q, u: jk.Body(1.0, 0.0, P))},
        "Wrong has 2 coordinates and 1 speeds.*define q_dot",
    ),
    "two residuals": (
        HELD | {"motion": with_residuals(SLOPE, lambda u: u["x_dot"] + u["angle_dot"])},
        r"1 dependent speeds are named \(angle_dot\), but its motion has 2 velocity residuals",
    ),
    "no dependent speed": ({"motion": with_residuals(SLOPE)}, r"0 dependent speeds are named \(none\)"),
    "a square": (
        HELD | {"motion": with_residuals(lambda u: u["x_dot"] - u["angle_dot"] ** 2)},
        "the velocity residual 0 is not affine in angle_dot",
    ),
    "a product": (
        HELD | {"motion": with_residuals(lambda u: u["angle_dot"] + u["x_dot"] * u["angle_dot"])},
        "products of two speeds",
    ),
    "a square velocity": (
        {"motion": with_body(lambda N, P, q, u: jk.Body(1.0, 0.0, jk.Point.at(u[0] * u[0] * N.x), name="rod"))},
        "the velocity of 'rod' is not affine in x_dot",
    ),
    "a wrong rate": (
        {"motion": lambda self, t, q, u: Slider.motion(self, t, q, (u[0], 2.0 * u[1]))},
        "Wrong: the frame 'B' turns with .* rad/s by the rates of its coordinates",
    ),
    "not fixed": (
        {"motion": with_body(not_fixed)},
        r"the mass centre of 'rod' moves with .* m/s by the rates of its coordinates",
    ),
    "no symmetry": (
        {
            "motion": with_body(
                lambda N, P, q, u: jk.Body(1.0, (0.1, 0.2, 0.2), P, N, u["angle_dot"] * N.z, name="rotor")
            )
        },
        "'rotor' rotates in its frame 'N', but its inertia is not symmetric about that axis",
    ),
    "bodies": (
        {"motion": lambda self, t, q, u: Slider.motion(self, t, q, u).bodies},
        "Wrong.motion must return a jaxkane.Motion",
    ),
    "a number": (
        {"loads": lambda self, t, q, u, motion, inputs: [3.0]},
        "Wrong.loads must return Forces and Torques",
    ),
}


@pytest.mark.parametrize("case", INVALID)
def test_an_inconsistent_system_raises_by_name(case):
    members, message = INVALID[case]
    wrong = variant(**members)
    with pytest.raises((ValueError, TypeError, NotImplementedError), match=message):
        evaluate(wrong, u=STATE[1][: len(wrong.speeds)])


def test_a_consistent_system_passes():
    assert np.isfinite(evaluate(Slider())).all()
    with pytest.raises(TypeError, match="first argument must be a Vector"):
        jk.Force(3.0, None)


class Rotor(Slider):
    across: jk.Scalar = jk.parameter(0.1)

    def motion(self, t, q, u):
        N, P = sliding(q, u)
        return jk.Motion([jk.Body(1.0, (0.1, self.across, 0.1), P, N, u["angle_dot"] * N.z, name="rotor")])


def test_a_body_that_turns_in_its_frame_must_be_symmetric_for_all_parameters():
    assert np.isfinite(evaluate(Rotor())).all()
    with pytest.raises(ValueError, match="'rotor' rotates in its frame 'N'"):
        evaluate(Rotor(across=0.15))  # of one structure with what was right


class TwoHingesOnOneAxis(jk.System):
    """Two links turn about one axis, the first without mass: only the sum of their speeds moves anything.

    With many, there are other bodies beside it, so that LAPACK solves for the accelerations.
    """

    inertia: jk.Scalar = jk.parameter(0.0)  # [kg m^2] of the first link about the axis
    scale: jk.Scalar = jk.parameter(1.0)
    many: bool = eqx.field(static=True, default=False)

    @property
    def coordinates(self):
        return ("a", "b", "c", *(f"x{i}" for i in range(12 * self.many)))

    @property
    def speeds(self):
        return tuple(f"{name}_rate" for name in self.coordinates)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["a"], u["a_rate"])
        B = A.rotate(A.vector(0.3, 0.5, 0.81), q["b"], u["b_rate"])
        C = B.rotate(B.vector(0.3, 0.5, 0.81), q["c"], u["c_rate"])
        upper, lower = O.fixed(A.vector(0.3, 0.1, 0.7)), O.fixed(C.vector(0.1, 0.2, 0.3))
        moments = [[self.scale * x for x in I] for I in ((0.07, 0.1, 0.13), (0.3, 0.2, 0.17))]
        bodies = [jk.Body(0.3 * self.scale, moments[0], upper, A), jk.Body(0.2 * self.scale, moments[1], lower, C)]
        rotor = jk.Body(0.0, (self.inertia, 0.0, 0.0), O, N, u["b_rate"] * N.x, name="rotor")
        beside = [O.moving(q[i] * N.x, u[i] * N.x) for i in range(3, len(q))]
        return jk.Motion([*bodies, rotor, *(jk.Body(1.0, 0.0, P) for P in beside)])

    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(self.scale * (0.1 * motion.N.x + 0.4 * motion.N.z), motion.bodies[1].frame)


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.weekly)])
def test_a_numerically_singular_mass_matrix_raises(many):
    system = TwoHingesOnOneAxis(many=many)
    rng = np.random.default_rng(0)
    for q, u in rng.normal(size=(4, 2, len(system.coordinates))):
        with pytest.raises(ValueError, match="the mass matrix is singular: a combination of b_rate, c_rate does not"):
            evaluate(system, q, u)
    assert np.isnan(jax.jit(lambda u: evaluate(system, q, u))(u)).any()
    # Small masses are no fault, nor is a link of little inertia.
    for light in (dict(inertia=1e-9), dict(inertia=1e-21, scale=1e-12)):
        assert np.isfinite(evaluate(TwoHingesOnOneAxis(many=many, **light), q, u)).all()


# -- numbers


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        (np.nan, ValueError, "DoublePendulum.mass = nan is not finite"),
        (np.inf, ValueError, "DoublePendulum.mass = inf is not finite"),
        (0.0, ValueError, "DoublePendulum.mass = 0.0 must be positive"),
        (-1, ValueError, "DoublePendulum.mass = -1.0 must be positive"),
        *((x, TypeError, "DoublePendulum.mass must be a real number") for x in ("heavy", None, 1j, True)),
    ],
)
def test_parameter_values_are_checked(value, error, message):
    with pytest.raises(error, match=message):
        DoublePendulum(mass=value)
    assert DoublePendulum(mass=np.ones((2, 3))).mass.shape == (2, 3)  # a batch


def test_integers_become_floats():
    pendulum = DoublePendulum(mass=2, length=np.int64(1))
    assert pendulum.mass.dtype == pendulum.length.dtype == jnp.float64
    assert float(jax.grad(lambda p: jk.accelerations(p, 0, [1, 0], [0, 1]).sum())(pendulum).length) != 0.0


def test_a_negative_mass_from_an_unrestricted_parameter_raises():
    with pytest.raises(ValueError, match=r"Slider, body 'rod': the mass is -1 kg"):
        evaluate(Slider(mass=-1.0))


class Spinner(jk.System):
    """A body on a hinge, with any inertia."""

    I11: jk.Scalar = jk.parameter()
    I22: jk.Scalar = jk.parameter()
    I33: jk.Scalar = jk.parameter()
    mass: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q[0], u[0])
        return jk.Motion([jk.Body(self.mass, (self.I11, self.I22, self.I33), O.fixed(2.0 * B.x), B, name="disk")])


class AnyInertia(Spinner):
    check_inertia = False


RESTING = jk.State(np.array([0.3]), np.array([1.0]))
TS = np.linspace(0.0, 0.1, 3)
ASKED = {
    "accelerations": lambda body: jk.accelerations(body, 0.0, RESTING.q, RESTING.u),
    "assemble": lambda body: jk.assemble(body, RESTING.q, RESTING.u),
    "simulate": lambda body: jk.simulate(body, RESTING, TS),
    "linearize": lambda body: jk.stability.linearize(body, RESTING, steady=False),
    "grad": lambda body: jax.grad(lambda body: jk.kinetic_energy(body, 0.0, RESTING.q, RESTING.u))(body),
}


@pytest.mark.slow_cases(all_but=["assemble"])
@pytest.mark.parametrize("asked", ASKED.values(), ids=ASKED)
def test_impossible_inertias_are_checked_by_the_same_rule_everywhere(asked):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asked(Spinner(1.0, 1.0, 2.0))  # a flat plate
        asked(Spinner(1.0, 1.0, 2.003))  # rounded
        asked(Spinner(0.0, 0.0, 2.0))  # a rotor: the moment about its axis alone
        asked(AnyInertia(1.0, 1.0, 3.0))
    with pytest.warns(UserWarning, match=r"Spinner, body 'disk': .* 1, 1, 2.1 kg m\^2.*triangle inequality"):
        asked(Spinner(1.0, 2.1, 1.0))
    with pytest.raises(ValueError, match=r"triangle inequality.*a larger excess is rejected.*check_inertia = False"):
        asked(Spinner(1.0, 1.0, 2.2))
    with pytest.raises(ValueError, match="none may be negative"):
        asked(AnyInertia(1.0, -0.1, 1.0))


def test_an_inertia_needs_a_frame():
    N, O = jk.inertial()
    with pytest.raises(ValueError, match=r"'rod' has an inertia, but no frame"):
        jk.Body(1.0, (0.1, 0.1, 0.1), O, name="rod")
    with pytest.raises(ValueError, match="no frame"):
        jk.Body(1.0, jnp.eye(3), O)
    jk.Body(1.0, 0, O), jk.Body(1.0, (0.0, 0, 0.0), O), jk.Body(1.0, np.zeros(3), O)
    jk.Body(1.0, (0.1, 0.1, 0.1), O, angular_velocity=2.0 * N.z)  # a ball that turns
    with pytest.raises(TypeError, match="the mass centre of 'rod' is a Point"):
        jk.Body(1.0, 0.0, N, name="rod")
    with pytest.raises(TypeError, match="the frame of 'rod' must be a Frame"):
        jk.Body(1.0, 0.0, O, O, name="rod")


# -- names


def test_duplicate_names_in_a_motion_raise():
    N, O = jk.inertial()
    A, P = N.rotate(3, 0.1, 0.0, "A"), O.fixed(N.x)
    rod, other, unnamed = (jk.Body(1.0, 0.0, O, name=name) for name in ("A", "A", "body"))
    for parts, kinds in [
        (([rod], {"frames": {"A": A}}), "a body and a frame"),
        (([rod], {"points": {"A": P}}), "a body and a point"),
        (([rod, other], {}), "a body and a body"),
        (([unnamed], {"points": {"A": P}, "frames": {"A": A}}), "a point and a frame"),
    ]:
        with pytest.raises(ValueError, match=rf"two parts have the name 'A', {kinds}: motion\['A'\] could be either"):
            jk.Motion(parts[0], **parts[1])
    several = jk.Motion([unnamed, jk.Body(2.0, 0.0, P)], points={"P": P})
    assert several["P"] is P
    with pytest.raises(KeyError, match="Several bodies of this motion have no name"):
        several["body"]
    assert jk.Motion(unnamed)["body"] is unnamed
    for wrong in ({"points": {"P": A}}, {"frames": {"A": P}}, {"points": {1: P}}):
        with pytest.raises(TypeError, match="Motion: "):
            jk.Motion([unnamed], **wrong)
    with pytest.raises(TypeError, match="must be a Body"):
        jk.Motion([P])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"inputs": ("torque")}, r"inputs must be a tuple of names, .*got 'torque'. Write \('torque',\)"),
        ({"speeds": ("x_dot", 2)}, "speeds must be a tuple of names"),
        ({"dependent_speeds": None}, "dependent_speeds must be a tuple of names"),
        ({"auxiliary_speeds": ("",)}, "auxiliary_speeds must be a tuple of names"),
        ({"coordinates": ("x", "x")}, "the name 'x' appears twice in `coordinates`"),
        ({"dependent_speeds": ("x_dot",)}, "'x_dot' appears in `speeds` and in `dependent_speeds`"),
        ({"inputs": ("angle",)}, "'angle' appears in `coordinates` and in `inputs`"),
        ({"dependent_coordinates": ("y",)}, "y is not a coordinate, or is repeated"),
        ({"dependent_coordinates": ("x", "x")}, "x is not a coordinate, or is repeated"),
    ],
)
def test_invalid_names_of_a_class_raise(names, message):
    properties = {kind: property(lambda self, given=given: given) for kind, given in names.items()}
    for members in (names, properties):
        with pytest.raises((TypeError, ValueError), match=message):
            variant(**members)


def test_lists_of_names_are_accepted_and_auxiliary_speed_names_checked():
    listed = type("Listed", (Slider,), {"coordinates": ["x", "angle"]})
    assert listed.coordinates == ("x", "angle")
    assert np.isfinite(evaluate(listed())).all()

    class Held(Slider):
        auxiliary_speeds = ("P",)

        def motion(self, t, q, u):
            motion = super().motion(t, q, u)
            return jk.Motion(motion.bodies, points={"P": motion["rod"].center})

    with pytest.raises(ValueError, match="Held: P is the name of an auxiliary speed and of a point or a frame"):
        evaluate(Held())


def test_wrong_shapes_and_names_raise():
    bike = WhippleBicycle.benchmark()
    q, u = np.zeros(8), np.zeros(3)
    with pytest.raises(ValueError, match=r"u must have the shape \(3,\): roll_rate, .*Got \(4, 3\).*vmap"):
        jk.accelerations(bike, 0.0, q, np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"no input named brake; it has roll_torque, drive_torque, steer_torque"):
        jk.accelerations(bike, 0.0, q, u, {"brake": 1.0})


def test_missing_names_in_a_class_are_reported():
    for what in ("coordinates", "speeds"):
        with pytest.raises(ValueError, match=rf"Wrong has no {what}\. Name them in its class: {what} = "):
            jk.accelerations(variant(**{what: ()}), 0.0, {}, {})
    with pytest.raises(ValueError, match=r"Sled: no constraint force has a name\. Name the points of joints"):
        jk.constraint_forces(Sled(), 0.0, [0.0], [0.0])


@pytest.mark.slow
def test_assemble_reports_why_it_fails():
    bike = WhippleBicycle.benchmark()
    rates = {"rear_wheel_rate": -10.0, "pitch_rate": 3.0}
    for system, q, u, message in (
        (bike, {"roll": np.pi / 2}, None, r"constraints do not determine pitch with roll = 1\.571"),
        (OnACircle(), {"x": 2.0}, None, r"no y that .* constraints with x = 2\. From the guess y = 0, .* 8 other"),
        (bike, {"roll": 0.1}, rates, "pitch_rate = 3 contradicts the velocity constraints"),
        (bike, {"steer": np.nan}, {"roll_rate": np.inf}, "WhippleBicycle: steer, roll_rate is not finite"),
    ):
        with pytest.raises(ValueError, match=message):
            jk.assemble(system, q, u)
    given = jk.assemble(bike, {}, {"rear_wheel_rate": -10.0, "front_wheel_rate": -10.0 * 0.3 / 0.35})
    np.testing.assert_array_equal(given.u, [0.0, -10.0, 0.0])


@pytest.mark.weekly
def test_assemble_is_twice_differentiable_and_can_be_vmapped():
    bike = WhippleBicycle.benchmark()
    pitch = lambda x: jk.assemble(bike, jnp.zeros(8).at[jnp.array([0, 2])].set(x)).q[4]  # noqa: E731
    x, h = jnp.array([0.3, -0.5]), 1e-5
    forward, e = jax.jacfwd(pitch)(x), h * jnp.eye(2)
    numeric = jnp.stack([(pitch(x + d) - pitch(x - d)) / (2 * h) for d in e])
    np.testing.assert_allclose(forward, numeric, atol=1e-9)
    np.testing.assert_allclose(jax.grad(pitch)(x), forward, atol=1e-13)
    hessian = jax.jacfwd(jax.jacfwd(pitch))(x)
    slopes = jax.jit(jax.jacfwd(pitch))
    numeric = jnp.stack([(slopes(x + d) - slopes(x - d)) / (2 * h) for d in e])
    np.testing.assert_allclose(hessian, numeric, atol=1e-7)
    many = jax.vmap(pitch)(jnp.stack([x, jnp.array([np.pi / 2, 0.0]), jnp.array([np.nan, 0.0])]))
    assert np.isfinite(many[0])
    assert np.isnan(many[1:]).all()  # under a trace there is nobody to raise to


@pytest.mark.slow
def test_assemble_and_simulate_in_one_program():
    bead = Bead(ends=False)

    @jax.jit
    def final_height(x):
        state = jk.assemble(bead, {"x": x, "y": 1.0}, {"vx": 0.4})
        return jk.simulate(bead, state, TS)["y"][-1]

    # On a circle of 1 m, without weight: the speed is 0.4 m/s over the height at the start.
    end = np.arcsin(0.6) + 0.4 / 0.8 * float(TS[-1])
    np.testing.assert_allclose(final_height(0.6), np.cos(end), atol=1e-7)


class Coincident(jk.System):
    """A particle on a spring whose ends are in one place."""

    length: jk.Scalar = jk.parameter(0.1)
    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="P")], points={"O": O})

    def loads(self, t, q, u, motion, inputs):
        return jk.loads.spring(motion["O"], motion["P"], 3.0, self.length)


@pytest.mark.weekly
@pytest.mark.parametrize("derivative", [lambda f: f, jax.grad, jax.jacfwd])
def test_a_force_without_direction_is_rejected_under_derivatives(derivative):
    def end(length):
        return jk.simulate(Coincident(length), jk.State([0.0], [0.0]), jnp.linspace(0.0, 1.0, 3)).q[-1, 0]

    with pytest.raises(ValueError, match=r"force at 'O'.* not finite \(two points coincide"):
        derivative(end)(0.1)


class OnAPin(jk.System):
    """A pendulum in a plane, whose inertia is given about its pin."""

    inertia: jk.Scalar = jk.parameter(0.2)
    moments: str = eqx.field(static=True, default="plane")
    coordinates, speeds = ("a",), ("w",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["a"], u["w"])
        J = self.inertia
        return jk.Motion(
            [jk.Body(1.5, (0.0, 0.0, J) if self.moments == "plane" else (J, J, J), O.fixed(-0.3 * B.y), B, about=O)]
        )


def test_a_single_moment_of_inertia_may_refer_to_another_point():
    assert jk.mass_matrix(OnAPin(), 0.0, [0.3], [0.0]).item() == pytest.approx(0.2, rel=1e-12)
    with pytest.raises(ValueError, match=r"central moments: the inertia was given about the point 'O'"):
        jk.accelerations(OnAPin(inertia=0.1), 0.0, [0.3], [0.0])
    with pytest.raises(ValueError, match=r"central moments: the inertia was given about the point 'O'"):
        jk.accelerations(OnAPin(inertia=0.1, moments="all"), 0.0, [0.3], [0.0])
