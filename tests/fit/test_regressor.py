"""The equations of motion as a matrix times bodies' parameters, which sums of these motions determine, and a first
guess."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import CATALOG
from jaxkane.fit import (
    Inertia,
    KinematicSamples,
    Trial,
    base_parameters,
    first_estimate,
    inertia_of,
    kinematic_samples,
    regressor,
)
from jaxkane.fit._base_parameters import random_states
from jaxkane.fit._diagnostics import describe_bodies
from jaxkane.fit._kinematics import max_spacing
from jaxkane.fit._parameters import parameters_of
from jaxkane.joints import Actuator, Link, Loop, Site, hinge, mechanism

FRICTION = ("k1", "k2")
ARMS = {"link1": ("m", "my", "Izz"), "link2": ("m", "my", "Izz")}
FREE = ("m1", "a1", "I1", "m2", "a2", "I2", "k1", "k2")


class Swing(jk.System):
    """Two arms from upright, each with its own mass, mass centre, inertia and viscous friction."""

    m1: jk.Scalar = jk.parameter(0.1, positive=True, unit="kg")
    a1: jk.Scalar = jk.parameter(0.11, unit="m")
    I1: jk.Scalar = jk.parameter(4e-4, positive=True, unit="kg m^2")
    m2: jk.Scalar = jk.parameter(0.14, positive=True, unit="kg")
    a2: jk.Scalar = jk.parameter(0.12, unit="m")
    I2: jk.Scalar = jk.parameter(1.2e-3, positive=True, unit="kg m^2")
    L1: jk.Scalar = jk.parameter(0.172719204, unit="m")
    k1: jk.Scalar = jk.parameter(2e-4, positive=True, unit="N m s/rad")
    k2: jk.Scalar = jk.parameter(3e-5, positive=True, unit="N m s/rad")

    coordinates = ("angle1", "angle2")
    speeds = ("rate1", "rate2")
    inputs = ("torque1",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A, B = N.rotate(3, q[0], u[0]), N.rotate(3, q[1], u[1])
        P = O.fixed(self.L1 * A.y)
        link1 = jk.Body(self.m1, (0.0, 0.0, self.I1), O.fixed(self.a1 * A.y), A, name="link1")
        link2 = jk.Body(self.m2, (0.0, 0.0, self.I2), P.fixed(self.a2 * B.y), B, name="link2")
        return jk.Motion([link1, link2], points={"O": O, "P": P})

    def loads(self, t, q, u, motion, inputs):
        k, link1, link2 = motion.N.z, motion["link1"], motion["link2"]
        return (
            self.weights(motion),
            jk.Torque((inputs["torque1"] - self.k1 * u[0]) * k, link1),
            jk.Torque(-self.k2 * (u[1] - u[0]) * k, link2, reaction_on=link1),
        )

    def weights(self, motion):
        return jk.weight(motion, -9.8 * motion.N.y)


class SwingByHand(Swing):
    """The same, with weights that do not read the bodies."""

    def weights(self, motion):
        down = -9.8 * motion.N.y
        return [jk.Force(m * down, motion[name]) for m, name in ((self.m1, "link1"), (self.m2, "link2"))]


class SwingElsewhere(Swing):
    """The same, with a weight at a point that is where the mass centre is, and is another."""

    def weights(self, motion):
        down = -9.8 * motion.N.y
        G = motion["P"].fixed(self.a2 * motion["link2"].frame.y)
        return jk.Force(self.m1 * down, motion["link1"]), jk.Force(self.m2 * down, G)


class SwingOfNumbers(Swing):
    """The second mass is a number, and its weight another."""

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        motion["link2"].mass = 0.14
        return motion

    def weights(self, motion):
        down = -9.8 * motion.N.y
        return jk.Force(self.m1 * down, motion["link1"]), jk.Force(0.14 * down, motion["link2"])


class SwingInAField(Swing):
    """The weight grows with the height of the mass centre."""

    def weights(self, motion):
        height = motion["link2"].center.position.dot(motion.N.y)
        return jk.weight(motion, -(9.8 + height) * motion.N.y)


class Sprung(Swing):
    """A spring of an unknown stiffness, at rest at an unknown angle, and a law that is not linear in a number."""

    stiffness: jax.Array = jk.parameter([0.3, 0.0])
    rest: jk.Scalar = jk.parameter(0.2)
    power: jk.Scalar = jk.parameter(0.0)

    def loads(self, t, q, u, motion, inputs):
        T = -self.stiffness[0] * (q[0] - self.rest) - self.stiffness[1] * q[0] ** 3 - self.power**2 * q[0]
        return self.weights(motion), jk.Torque(T * motion.N.z, motion["link1"])


class Sledge(jk.System):
    """On a knife edge, which does not move sideways: a dependent speed."""

    m: jk.Scalar = jk.parameter(2.0)
    a: jk.Scalar = jk.parameter(0.3)
    I: jk.Scalar = jk.parameter(0.5)
    coordinates, speeds, dependent_speeds = ("x", "yaw", "y"), ("x_dot", "yaw_rate"), ("y_dot",)
    inputs = ("push",)

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        B = N.rotate(3, q["yaw"], u["yaw_rate"], "B")
        P = jk.Point.at(u["x_dot"] * N.x + u["y_dot"] * N.y, q["x"] * N.x + q["y"] * N.y, "P")
        body = jk.Body(self.m, (0.0, 0.0, self.I), P.fixed(self.a * B.x), B, name="sledge")
        return jk.Motion([body], [P.velocity.dot(B.y)], points={"P": P}, frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force(inputs["push"] * motion["B"].x, motion["P"]),)


def random_instants(system, n=60, seed=0):
    """KinematicSamples at which a system moves as its own equations say, with any inputs."""
    rng = np.random.default_rng(seed)
    q, u = (jnp.asarray(rng.uniform(-2.0, 2.0, (n, len(names)))) for names in (system.coordinates, system.speeds))
    inputs = {name: jnp.asarray(rng.normal(0.0, 0.3, n)) for name in (*system.inputs, *system.states)}
    at = jax.jit(jax.vmap(lambda q, u, now: jk.accelerations(system, 0.0, q, u, now)))
    return KinematicSamples(np.zeros(n), q, u, at(q, u, inputs), inputs)


@functools.cache
def swings():
    """A system that was guessed, and what the true one does."""
    truth = Swing(m1=0.2, a1=0.07, I1=1e-3, m2=0.1, a2=0.15, I2=2e-3, k1=1e-3, k2=2e-3)
    return truth, random_instants(truth)


# ---- the matrix


@pytest.mark.parametrize(
    "name", ["DoublePendulum", "SliderWithPinnedBar", pytest.param("ColumnFrameAndDisk", marks=pytest.mark.slow)]
)
def test_matrix_times_parameters_is_what_kanes_equations_hold(name):
    """At any accelerations; `ColumnFrameAndDisk` has a body that spins in its frame."""
    tolerance = 1e-12
    entry = CATALOG[name]
    system, rng = entry.example(), np.random.default_rng(0)
    u_dot = rng.normal(size=len(system.speeds))
    at = (0.0, jnp.array(entry.q), jnp.array(entry.u))
    inputs = {name: 0.3 + 0.1 * i for i, name in enumerate(system.inputs)}
    found = regressor(system, *at, u_dot, inputs)
    F = jk.generalized_active_forces(system, *at, inputs)
    F_star = jk.generalized_inertia_forces(system, *at, inputs, u_dot=u_dot)
    np.testing.assert_allclose(found.matrix @ found.values - found.forces, -(F + F_star), atol=tolerance)


def test_the_matrix_does_not_depend_on_what_is_to_be_found(kernels):
    """Y of a guess, times the parameters of the truth, is what acts on the truth as it moves."""
    tolerance = 1e-12
    truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3], {"torque1": at.inputs["torque1"][3]})
    true, guessed = (regressor(system, *i, parameters=FRICTION) for system in (truth, Swing()))
    np.testing.assert_allclose(guessed.matrix, true.matrix, atol=tolerance)
    np.testing.assert_allclose(guessed.matrix @ true.values, [at.inputs["torque1"][3], 0.0], atol=tolerance)
    np.testing.assert_allclose(guessed.forces, true.forces, atol=tolerance)
    assert guessed.names[0] == "link1.m"
    assert guessed.names[-2:] == FRICTION
    assert guessed.matrix.shape == (2, 22)
    assert dict(guessed.about) == {"link1": "O", "link2": "P"}
    assert guessed.units[:5] == ("kg", "kg m", "kg m", "kg m", "kg m^2")
    assert guessed.units[-1] == "N m s/rad"


@pytest.mark.slow
def test_weights_that_are_written_by_hand_are_found_or_refused():
    _truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3])
    same = [regressor(kind(), *i).matrix for kind in (Swing, SwingByHand)]
    np.testing.assert_allclose(*same, atol=1e-14)
    with pytest.raises(ValueError, match=r"m2 changes the parameters of a body.*jk\.weight"):
        regressor(SwingElsewhere(), *i)
    with pytest.raises(ValueError, match=r"for link2, whose mass is a number in the description, none is found"):
        regressor(SwingOfNumbers(), *i)
    regressor(SwingElsewhere(), *i, bodies="link1")  # then the other's weight is known, as it is


def test_dependent_speeds():
    """Of a knife edge: Izz, the first moment along the edge, and the mass; none of what is across."""
    tolerance = 1e-11
    truth = Sledge(m=3.0, a=-0.2, I=0.7)
    at = random_instants(truth, 20)
    found = base_parameters(Sledge(), at, sigma={"x_dot": 1e-9, "yaw_rate": 1e-9})
    assert {"sledge.mz", "sledge.Ixx"} <= set(found.without_influence)
    named = dict(zip([found.names[i] for i in found.places], found.estimates, strict=True))
    assert set(named) == {"sledge.m", "sledge.mx", "sledge.my", "sledge.Izz"}
    expected = {"sledge.m": 3.0, "sledge.mx": -0.6, "sledge.my": 0.0, "sledge.Izz": 0.7 + 3.0 * 0.04}
    assert named == pytest.approx(expected, abs=tolerance)


@pytest.mark.slow
def test_batches_derivatives_and_traces():
    tolerance = 1e-10
    truth, at = swings()
    here = lambda q, u, u_dot: regressor(truth, 0.0, q, u, u_dot, parameters=FRICTION)  # noqa: E731
    rows = jax.jit(jax.vmap(here))(*(jnp.asarray(x[:3]) for x in (at.q, at.u, at.u_dot)))
    assert rows.matrix.shape == (3, 2, 22)
    assert rows.values.shape == (3, 22)
    np.testing.assert_allclose(rows.matrix[1], here(at.q[1], at.u[1], at.u_dot[1]).matrix, atol=1e-13)
    along = lambda q: here(q, at.u[0], at.u_dot[0]).matrix  # noqa: E731
    q, e = jnp.asarray(at.q[0]), jnp.array([1e-6, 0.0])
    forward, reverse = jax.jit(jax.jacfwd(along))(q), jax.jit(jax.jacrev(along))(q)
    np.testing.assert_allclose(forward, reverse, atol=tolerance)
    np.testing.assert_allclose((along(q + e) - along(q - e)) / 2e-6, forward[..., 0], atol=1e-7)
    # of a length of the system, with nothing known outside
    length = jax.jit(jax.grad(lambda L: regressor(dataclasses.replace(truth, L1=L), 0.0, q, q, q).matrix[1, 13]))
    assert np.isfinite(length(0.2))


def test_what_is_not_linear_is_refused():
    _truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3])
    for kwargs, said in (
        ({"parameters": "L1"}, "not linear in L1"),
        ({"parameters": "m1"}, "m1 belongs to a body that has columns"),
        ({"parameters": ("k1", "k1")}, "names k1 twice"),
        ({"parameters": "k3"}, "no parameter 'k3'"),
        ({"bodies": ("link1", "link1")}, "names link1 twice"),
        ({"bodies": "link3"}, "did you mean 'link2'"),
        ({"bodies": {"link1": ("Iww",)}}, "link1 has no parameter Iww"),
        ({"bodies": ()}, "no body with a mass is named"),
    ):
        with pytest.raises(ValueError, match=said):
            regressor(Swing(), *i, **kwargs)
    with pytest.raises(ValueError, match="a gravity that is not uniform"):
        regressor(SwingInAField(), *i)
    with pytest.raises(ValueError, match="not linear in stiffness"):
        regressor(Sprung(), *i, parameters=("stiffness", "rest"))
    with pytest.raises(ValueError, match="not linear in power"):
        regressor(Sprung(), *i, parameters="power")
    spring = regressor(Sprung(), *i, parameters="stiffness")
    assert spring.names[-2:] == ("stiffness[0]", "stiffness[1]")
    np.testing.assert_allclose(spring.matrix[0, -2:], [at.q[3, 0] - 0.2, at.q[3, 0] ** 3], rtol=1e-12)
    with pytest.raises(ValueError, match="m1 has more axes than it was declared with"):
        base_parameters(dataclasses.replace(Swing(), m1=jnp.ones(2)))
    with pytest.raises(ValueError, match="no input named tau"):
        regressor(Swing(), *i, {"tau": 1.0})
    with pytest.raises(ValueError, match="u_dot must have the shape"):
        regressor(Swing(), *i[:3], np.zeros(3))
    with pytest.raises(TypeError, match="instance of a System"):
        regressor(Swing, *i)


def test_known_bodies_stay_on_the_right_side():
    tolerance = 1e-12
    truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3], {"torque1": at.inputs["torque1"][3]})
    part = regressor(truth, *i, bodies={"link2": ("m", "my")})
    assert part.names == ("link2.m", "link2.my")
    np.testing.assert_allclose(part.matrix @ part.values, part.forces, atol=tolerance)
    none = regressor(truth, *i, bodies=(), parameters="k2")
    assert none.matrix.shape == (2, 1)
    np.testing.assert_allclose(none.matrix[:, 0], [at.u[3, 0] - at.u[3, 1], at.u[3, 1] - at.u[3, 0]], atol=tolerance)


def test_single_precision():
    truth, at = swings()
    small = jax.tree.map(lambda x: x.astype(jnp.float32), truth)
    i = [jnp.asarray(x[3], jnp.float32) for x in (at.t, at.q, at.u, at.u_dot)]
    found, exact = (
        regressor(small, *i, parameters=FRICTION),
        regressor(truth, *map(jnp.float64, i), parameters=FRICTION),
    )
    assert found.matrix.dtype == found.forces.dtype == jnp.float32
    np.testing.assert_allclose(found.matrix, exact.matrix, rtol=1e-4, atol=1e-4)


# ---- what motions determine


def test_double_pendulum_as_in_textbooks():
    """Khalil and Dombre: ZZ1 + L^2 M2, MX1 + L M2, MY1, ZZ2, MX2, MY2; with a free swing only their ratios."""
    found = base_parameters(Swing())
    assert found.texts == (
        "link1.Izz + L1^2 link2.m", "link1.mx", "link1.my + L1 link2.m", "link2.Izz", "link2.mx", "link2.my",
    )  # fmt: skip
    assert not found.ratios_only
    assert found.count == 6
    assert "link1.m" in found.without_influence
    assert "of 20 parameters 6 sums can be determined" in str(found)
    _truth, _ = swings()
    np.testing.assert_allclose(found.of(found.values)[0], 4e-4 + 0.1 * 0.11**2 + 0.14 * 0.172719204**2)


def arm(n, gravity=(0.0, -9.81, 0.0)):
    """n hinges about parallel axes, with friction; the mass centres of the links are on their lines."""
    links = [
        Link(
            f"L{i}",
            f"L{i - 1}" if i else None,
            joints=hinge(f"q{i}", (0, 0, 1), damping=0.1),
            position=(0.3 * (i > 0), 0, 0),
            mass=1.0 + i,
            center=(0.1, 0, 0),
            inertia=(0.0, 0.0, 0.02),
        )
        for i in range(n)
    ]
    return mechanism(links, gravity=gravity)


@pytest.mark.parametrize(
    ("n", "numbers"), [pytest.param(1, 2, marks=pytest.mark.slow), (2, 5), pytest.param(3, 8, marks=pytest.mark.slow)]
)
def test_free_swings_with_friction(n, numbers):
    """The data's README: 2 numbers of a single pendulum, 5 of a double one, 8 of a triple one with known lengths."""
    system = arm(n)
    bodies = {f"L{i}": ("m", "mx", "Izz") for i in range(n)}
    found = base_parameters(system, bodies=bodies, parameters=[f"damping.q{i}" for i in range(n)])
    assert found.ratios_only
    assert found.count == numbers
    assert len(found.places) == numbers + 1


@pytest.mark.slow
def test_a_vertical_axis_tells_one_number_and_a_horizontal_one_three():
    whole = {"center": (0.1, 0.02, 0.03), "inertia": ((0.02, 0.001, 0.002), (0.001, 0.03, 0.003), (0.002, 0.003, 0.04))}
    for axis, expected in (((0, 0, 1), ("Izz",)), ((0, 1, 0), ("mx", "mz", "Iyy"))):
        one = mechanism([Link("bob", joints=hinge("q", axis), mass=1.0, **whole)], actuators=[Actuator("tau", "q")])
        found = base_parameters(one)
        assert {one.rpartition(".")[2] for one in found.texts} == set(expected)
        assert found.count == len(expected)


@pytest.mark.slow
def test_a_puma_has_36():
    """Mayeda, Yoshida and Osuka, Base parameters of manipulator dynamic models, 1990; the sums are Khalil's."""
    quarter = np.pi / 2
    turns = (0.0, -quarter, 0.0, -quarter, quarter, -quarter)
    places = ((0, 0, 0), (0, 0, 0), (0.4318, 0, 0.15), (0.02, 0.4318, 0), (0, 0, 0), (0, 0, 0))
    whole = {"center": (0.1, 0.02, 0.03), "inertia": ((0.02, 0.001, 0.002), (0.001, 0.03, 0.003), (0.002, 0.003, 0.04))}
    links = [
        Link(f"L{i}", f"L{i - 1}" if i else None, hinge(f"q{i}", (0, 0, 1)), places[i], ("1", (turns[i],)), 1.0 + i,
             **whole)
        for i in range(6)
    ]  # fmt: skip
    found = base_parameters(mechanism(links, actuators=[Actuator(f"tau{i}", f"q{i}") for i in range(6)]))
    assert len(found.places) == found.count == 36
    assert "L3.Ixx - L3.Iyy + L4.Iyy" in found.texts
    assert "L5.Ixx - L5.Iyy" in found.texts
    assert found.texts[0].startswith("L0.Izz + L1.Iyy + ")
    assert "2 position.L2.z L2.mz" in found.texts[0]


def test_estimates_from_exact_data_are_exact():
    tolerance = 1e-9
    truth, at = swings()
    found = base_parameters(Swing(), at, parameters=FRICTION)
    expected = found.of(regressor(truth, 0.0, at.q[0], at.u[0], at.u_dot[0], parameters=FRICTION).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=tolerance, atol=tolerance)
    assert found.count == 8
    assert found.unexplained < 1e-12
    assert "8 numbers by these data" in str(found)


def test_a_regressor_of_many_instants_is_enough():
    truth, at = swings()
    rows = jax.vmap(lambda q, u, a: regressor(truth, 0.0, q, u, a, parameters=FRICTION))(
        *(jnp.asarray(x) for x in (at.q, at.u, at.u_dot))
    )
    found = base_parameters(rows)
    assert len(found.places) == 8
    assert found.texts[0] == f"link1.Izz + {0.172719204**2:.4g} link2.m"
    with pytest.raises(ValueError, match="many instants"):
        base_parameters(jax.tree.map(lambda x: x[0], rows))


@pytest.mark.slow
def test_deviations_cover_the_truth():
    """Of 25 data sets with noisy torques, each base parameter; with a known sigma, and with an estimated one."""
    truth, at = swings()
    expected = None
    for sigma in (None, {"rate1": 0.002, "rate2": 0.002}):
        z = []
        for seed in range(25):
            torque = at.inputs["torque1"] + np.random.default_rng(seed).normal(0.0, 0.002, len(at))
            noisy = dataclasses.replace(at, inputs={"torque1": torque})
            found = base_parameters(truth, noisy, bodies=ARMS, parameters=FRICTION, sigma=sigma)
            expected = found.of(found.values) if expected is None else expected
            z.append((found.estimates - expected) / found.deviations)
        assert 0.6 < np.std(z) < 1.3
        assert np.all(np.abs(np.mean(z, axis=0)) < 0.7)


@pytest.mark.slow
def test_what_data_do_not_tell_is_named_and_stays():
    """The second arm hangs still: its inertia is told by nothing."""
    truth, at = swings()
    rng = np.random.default_rng(1)
    q, u, u_dot = (np.array(x) for x in (at.q, at.u, at.u_dot))
    q[:, 1] = np.pi
    u[:, 0], u_dot[:, 0] = u[:, 0], u_dot[:, 0]
    u[:, 1] = u_dot[:, 1] = 0.0
    torque = {"torque1": rng.normal(0.0, 0.3, len(at))}
    still = KinematicSamples(at.t, q, u, u_dot, torque)
    found = base_parameters(truth, still, bodies=ARMS, parameters=FRICTION, sigma={"rate1": 0.01, "rate2": 0.01})
    assert "not determined by these data" in str(found)
    assert any("link2.Izz" in text for text in found.undetermined)
    assert found.estimates[list(found.texts).index("link2.Izz")] == pytest.approx(2e-3 + 0.1 * 0.15**2)
    assert np.isinf(found.deviations[list(found.texts).index("link2.Izz")])


def test_bad_data_are_refused_by_name():
    truth, at = swings()
    first = lambda n: KinematicSamples(at.t[:n], at.q[:n], at.u[:n], at.u_dot[:n])  # noqa: E731
    with pytest.raises(ValueError, match="not how large their errors are"):
        base_parameters(truth, first(1), bodies=ARMS, parameters=FRICTION)
    gaps = np.array(at.u_dot)
    gaps[5:] = np.nan
    assert len(KinematicSamples(at.t, at.q, at.u, gaps)) == 5
    with pytest.raises(ValueError, match="no instant at which all numbers are finite"):
        KinematicSamples(at.t, at.q, at.u, np.nan * at.u_dot)
    with pytest.raises(ValueError, match=r"`u` \(60,\)"):
        KinematicSamples(at.t, at.q, at.u[:, 0], at.u_dot)
    with pytest.raises(ValueError, match="has 2 coordinates and 2 independent speeds; the samples have 1"):
        base_parameters(truth, KinematicSamples(at.t, at.q[:, :1], at.u, at.u_dot))
    with pytest.raises(ValueError, match="no input or state named torque3"):
        base_parameters(truth, KinematicSamples(at.t, at.q, at.u, at.u_dot, {"torque3": 0.0}))
    with pytest.raises(ValueError, match="look at rate2"):
        base_parameters(truth, at, sigma={"rate1": 0.1})
    nothing = np.zeros((60, 2))
    with pytest.raises(ValueError, match="Nothing moves and nothing acts"):
        base_parameters(truth, KinematicSamples(at.t, nothing, nothing, nothing), bodies=ARMS)
    t = np.linspace(0.0, 1.0, 101)
    with pytest.raises(ValueError, match="angle2 was not measured"):
        kinematic_samples(truth, Trial(t, {"angle1": t}, sigma=0.1))
    turns = Trial(t, {"angle1": (30 * t + 1) % (2 * np.pi), "angle2": t}, sigma=0.1)
    with pytest.raises(ValueError, match=r"angle1 jumps by a whole turn at t = 0\.\d+ s: make it one curve"):
        kinematic_samples(truth, turns)
    with pytest.raises(ValueError, match="has 10 samples"):
        kinematic_samples(truth, Trial(t[:10], {"angle1": t[:10], "angle2": t[:10]}, sigma=0.1))
    with pytest.raises(ValueError, match="There is no motion"):
        kinematic_samples(truth, [])


# ---- accelerations from measurements


def test_accelerations_of_noisy_samples():
    """Of sin 3t with noise: the smoothest spline within sigma. Gaps, and a spacing around them, are left out."""
    t, rng = np.linspace(0.0, 4.0, 401), np.random.default_rng(0)
    y = np.sin(3 * t) + 1e-3 * rng.standard_normal(401)
    y[100:140] = np.nan
    trial = Trial(t, {"angle1": y, "angle2": np.cos(t)}, {"torque1": t}, sigma=1e-3)
    assert 0.2 < float(max_spacing(trial, trial.measured)) < 0.6
    found = kinematic_samples(Swing(), trial, spacing=0.3)
    inside = (found.t > 0.5) & (found.t < 3.5)
    assert np.max(np.abs(found.u_dot[inside, 0] + 9 * np.sin(3 * found.t[inside]))) < 0.6  # of 9
    assert np.max(np.abs(found.u[inside, 0] - 3 * np.cos(3 * found.t[inside]))) < 0.02
    assert not np.any((found.t > 0.70) & (found.t < 1.69))
    assert len(found) > 150
    np.testing.assert_allclose(found.inputs["torque1"], found.t, atol=1e-9)
    two = kinematic_samples(Swing(), [trial, trial], spacing=0.2)
    assert set(two.trial) == {0, 1}


# ---- a first guess


@pytest.mark.slow
def test_first_guess_of_a_measured_double_pendulum():
    """Free swings: ratios of four base parameters of its makers' estimates within 3 %; friction has its sign."""
    recording = jk.data.multi_arm_pendulum(2)
    authors = recording.parameters
    guess = first_estimate(Swing(I2=3e-3), recording.trials[:8], FREE, spacing=0.025)
    assert guess.ok
    assert guess.base.ratios_only
    assert guess.base.count == 5
    ratios = guess.base.estimates[:4] / guess.base.estimates[0]
    m1, a1, I1, m2, a2, I2, L1 = (authors[name] for name in ("m1", "a1", "I1", "m2", "a2", "I2", "L1"))
    expected = np.array([I1 + m1 * a1**2 + m2 * L1**2, m1 * a1 + m2 * L1, I2 + m2 * a2**2, m2 * a2])
    np.testing.assert_allclose(ratios, expected / expected[0], rtol=0.03)
    assert guess.system.k1 > 0
    assert guess.system.k2 > 0
    assert guess.values["I2"] == guess.system.I2
    np.testing.assert_allclose(guess.feasible, guess.base.estimates, rtol=1e-3)
    assert "standard deviations from these" in str(guess)


@pytest.mark.slow
def test_bodies_that_can_be():
    """Torques that ask for a negative moment of inertia: what is returned has a positive pseudo-inertia."""
    ball = mechanism(
        [
            Link("base", joints=hinge("q0", (1, 0, 0)), mass=1.0, inertia=(0.02, 0.02, 0.02)),
            Link("bob", "base", hinge("q1", (0, 0, 1)), mass=1.0, center=(0.1, 0.02, 0.03),
                 inertia=((0.02, 0.001, 0.002), (0.001, 0.025, 0.003), (0.002, 0.003, 0.03))),
        ],
        actuators=[Actuator("tau0", "q0"), Actuator("tau1", "q1")],
    )  # fmt: skip
    exact = random_instants(ball, 40)
    body = inertia_of(ball, "bob")
    assert (body.mass, body.center[0], body.moments[2]) == ("mass.bob", "center.bob.x", "inertia.bob.zz")
    same = first_estimate(ball, exact, body)
    assert same.ok
    assert same.values["inertia.bob.zz"] == pytest.approx(0.03, rel=1e-6)
    column = jax.jit(jax.vmap(lambda *x: regressor(ball, 0.0, *x, bodies={"bob": "Izz"}).matrix[:, 0]))(
        *map(jnp.asarray, (exact.q, exact.u, exact.u_dot))
    )
    asked = {name: x - 0.06 * column[:, i] for i, (name, x) in enumerate(exact.inputs.items())}
    guess = first_estimate(ball, dataclasses.replace(exact, inputs=asked), body)
    assert guess.base.estimates[list(guess.base.texts).index("bob.Izz")] == pytest.approx(0.0404 - 0.06)
    xx, yy, zz, xy, xz, yz = (guess.values[f"inertia.bob.{ij}"] for ij in ("xx", "yy", "zz", "xy", "xz", "yz"))
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    assert 0 < moments[0] < moments[2] < moments[0] + moments[1]
    assert not guess.ok
    assert guess.distance > 3
    assert not guess.infeasibility
    assert "kg, centre at (" in guess.bodies[0]
    assert f"principal moments {moments[0]:.5g}, {moments[1]:.5g}, {moments[2]:.5g} kg m^2, along (" in str(guess)
    jk.accelerations(guess.system, 0.0, exact.q[0], exact.u[0])  # which refuses bodies that cannot be


@pytest.mark.slow
def test_a_first_guess_may_start_with_a_centre_at_the_joint():
    """There the moment of inertia about the joint does not change with it, and elsewhere it does."""
    truth, at = swings()
    start = dataclasses.replace(truth, a2=0.0)
    guess = first_estimate(start, at, ("a2", "k2"))
    assert guess.values["a2"] == pytest.approx(float(truth.a2), rel=1e-6)
    assert guess.ok


def test_what_a_first_guess_refuses():
    _, at = swings()
    for free, said in (
        ("L1", "L1 changes lengths"),
        (jk.fit.Gain("torque1"), "gain of torque1"),
        ("k9", "no parameter"),
    ):
        with pytest.raises(ValueError, match=said):
            first_estimate(Swing(), at, free)


def test_inertia_of_a_body_by_its_name():
    found = inertia_of(jk.catalog.WhippleBicycle.benchmark(), "front wheel", fixed=("mF",))
    assert found == Inertia(moments=("IFxx", "IFyy", "IFxx"), mass="mF", fixed=("mF",))
    with pytest.raises(ValueError, match="Ixx, Iyy, Izz of 'link1' are no parameters of their own"):
        inertia_of(jk.catalog.DoublePendulum(), "link1")
    with pytest.raises(KeyError, match="link1"):
        inertia_of(jk.catalog.DoublePendulum(), "link7")


class Lagging(Swing):
    """The torque is that of a motor that lags: a state of the first order."""

    states = ("motor",)

    def loads(self, t, q, u, motion, inputs):
        return self.weights(motion), jk.Torque(inputs["motor"] * motion.N.z, motion["link1"])

    def state_rates(self, t, q, u, x, motion, now):
        return [(now["torque1"] - x["motor"]) / 0.1]


@pytest.mark.slow
def test_states_of_the_first_order_act_from_the_right_side():
    truth, _ = swings()
    system = Lagging(**{name: getattr(truth, name) for name in FREE if name[0] != "k"})
    at = random_instants(system, 20)
    found = base_parameters(Lagging(), at, bodies=ARMS)
    expected = found.of(regressor(system, 0.0, at.q[0], at.u[0], at.u_dot[0], bodies=ARMS).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=1e-9)
    with pytest.raises(ValueError, match="loads may follow motor"):
        base_parameters(Lagging(), KinematicSamples(at.t, at.q, at.u, at.u_dot))


@pytest.mark.slow
def test_a_simulated_motion_tells_of_the_system_that_made_it():
    truth, at = swings()
    torque = {"torque1": lambda t, state: 0.3 * jnp.cos(9 * t)}
    ride = jk.simulate(truth, jk.State([0.5, -0.4], [1.0, 2.0]), jnp.linspace(0.0, 2.0, 401), inputs=torque)
    found = base_parameters(Swing(), ride, bodies=ARMS, parameters=FRICTION)
    i = (0.0, at.q[0], at.u[0], at.u_dot[0])
    expected = found.of(regressor(truth, *i, bodies=ARMS, parameters=FRICTION).values)
    np.testing.assert_allclose(found.estimates, expected, rtol=1e-3)
    with pytest.raises(ValueError, match="A trajectory of 11 times"):
        kinematic_samples(truth, jax.tree.map(lambda x: x[::40] if x.shape[:1] == (401,) else x, ride))


def test_what_was_freed_as_an_inertia_is_told_as_a_whole():
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    parameters = parameters_of(bicycle, (jk.fit.frame_inertia("H"), "mB", jk.fit.frame_inertia("F", fixed=())))
    fork, wheel = describe_bodies(parameters, parameters.start * 0.0)
    xx, zz, xz = (float(getattr(bicycle, name)) for name in ("IHxx", "IHzz", "IHxz"))
    small, large = np.linalg.eigvalsh([[xx, xz], [xz, zz]])
    assert f"principal moments {small:.5g}, 0.06, {large:.5g} kg m^2, along (" in fork
    assert fork.startswith("body of xH, zH, IHxx, IHyy, IHzz, IHxz: centre at (0.9, 0, -0.7) m")
    assert wheel == "body of mF, IFxx, IFyy: 3 kg, principal moments 0.1405, 0.1405, 0.28 kg m^2"


@pytest.mark.slow
def test_a_closed_loop():
    """A four-bar linkage tells 8 sums; those of another one with the same lengths, from its motion, exactly."""

    def link(name, parent, position, mass=1.0, y=0.03):
        at = {"center": (0.2, y, 0), "inertia": (0, 0, 0.02)}
        return Link(name, parent, hinge(f"q{name}", (0, 0, 1)), position, mass=mass, **at)

    def four_bar(**b):
        links = [link("a", None, (0, 0, 0)), link("b", "a", (0.4, 0, 0), **b), link("c", "b", (0.9, 0, 0))]
        sites = [Site("end", "c", (0.6, 0, 0)), Site("ground", None, (0.8, 0, 0))]
        closed = [Loop("end", "ground")]
        down = (0, -9.81, 0)
        return mechanism(links, gravity=down, sites=sites, loops=closed, actuators=[Actuator("tau", "qa")])

    guess, truth = four_bar(), four_bar(mass=1.7, y=0.05)
    states = random_states(truth, 60)
    u_dot = jax.jit(jax.vmap(lambda t, q, u, now: jk.accelerations(truth, t, q, u, now)))(
        *(jnp.asarray(x) for x in (states.t, states.q, states.u)), {"tau": jnp.asarray(states.inputs["tau"])}
    )
    found = base_parameters(guess, dataclasses.replace(states, u_dot=u_dot))
    assert len(found.places) == found.count == 8
    i = (0.0, states.q[0], states.u[0], states.u_dot[0])
    np.testing.assert_allclose(found.estimates, found.of(regressor(truth, *i).values), atol=1e-7)


@pytest.mark.slow
def test_a_bicycle_tells_twenty():
    """Of frame, fork and wheels; the whole mass, the height and place of its centre, and both wheels' spin moments."""
    found = base_parameters(jk.catalog.WhippleBicycle.benchmark(), parameters="steer_damping")
    assert len(found.places) == 20
    assert "rear wheel.m + rear frame.m + fork.m + front wheel.m" in found.texts
    assert {"rear wheel.Iyy", "front wheel.Iyy", "steer_damping"} <= set(found.texts)


class Driven(jk.System):
    """A double pendulum with geared motors, as its makers describe it; see `jaxkane.data`."""

    m1: jk.Scalar = jk.parameter(0.5, positive=True)
    r1: jk.Scalar = jk.parameter(0.2)
    I1: jk.Scalar = jk.parameter(0.01, positive=True)
    m2: jk.Scalar = jk.parameter(0.5, positive=True)
    r2: jk.Scalar = jk.parameter(0.3)
    I2: jk.Scalar = jk.parameter(0.01, positive=True)
    Ir: jk.Scalar = jk.parameter(1e-4, positive=True)
    b1: jk.Scalar = jk.parameter(0.01, positive=True)
    b2: jk.Scalar = jk.parameter(0.01, positive=True)
    c1: jk.Scalar = jk.parameter(0.05, positive=True)
    c2: jk.Scalar = jk.parameter(0.05, positive=True)

    coordinates, speeds, inputs = ("angle1", "angle2"), ("rate1", "rate2"), ("torque1", "torque2")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q[0], u[0])
        B = A.rotate(3, q[1], u[1])
        P = O.fixed(-0.2 * A.y)
        rotor = (0.0, 0.0, self.Ir)
        upper = jk.Body(self.m1, (0.0, 0.0, self.I1), O.fixed(-self.r1 * A.y), A, name="upper")
        lower = jk.Body(self.m2, (0.0, 0.0, self.I2), P.fixed(-self.r2 * B.y), B, name="lower")
        shoulder = jk.Body(0.0, rotor, O, N, 6 * u[0] * N.z, name="shoulder motor")
        elbow = jk.Body(0.0, rotor, P, A, (u[0] - 6 * u[1]) * N.z, name="elbow motor")
        return jk.Motion([upper, lower, shoulder, elbow])

    def loads(self, t, q, u, motion, inputs):
        upper, lower, k = motion["upper"], motion["lower"], motion.N.z
        drags = [b * w + c * jnp.arctan(100 * w) for b, c, w in zip((self.b1, self.b2), (self.c1, self.c2), u)]
        return (
            jk.weight(motion, -9.81 * motion.N.y),
            jk.Torque((inputs["torque1"] - drags[0]) * k, upper),
            jk.Torque((inputs["torque2"] - drags[1]) * k, lower, reaction_on=upper),
        )


@pytest.mark.slow
def test_first_guess_of_a_driven_double_pendulum():
    """Nine numbers, with rotors and friction, within a third of what fits by simulation find; the rotors' inertia is
    small beside the links', and drawn towards zero by noise."""
    free = ("m1", "r1", "I1", "m2", "r2", "I2", "Ir", "b1", "b2", "c1", "c2")
    trials = [trial for trial in jk.data.driven_double_pendulum().trials if not trial.name.endswith("sysid_00")]
    guess = first_estimate(Driven(), trials, free)
    assert guess.base.count == 9
    assert guess.distance < 3
    assert guess.base.unexplained < 0.1
    # m1r1 0.134, I1 0.0244, m2r2 0.193, m2 0.475, I2 0.0577 about the joints: a fit of ten parameters by others
    expected = [0.0244 + 0.475 * 0.04, -(0.134 + 0.475 * 0.2), 0.0577, -0.193]
    np.testing.assert_allclose(guess.base.estimates[:4], expected, rtol=0.33)
    assert 2e-5 < guess.system.Ir < 2e-4
    assert all(0.02 < guess.values[name] < 0.1 for name in ("c1", "c2"))
