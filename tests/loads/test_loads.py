"""Springs, dampers, actuators and friction: each in a description of a few lines, against what it must do by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

RTOL = 1e-12


class Two(jk.System):
    """Two particles in a plane, and between them what `law(P, Q, motion)` says."""

    coordinates = ("x1", "y1", "x2", "y2")
    speeds = ("vx1", "vy1", "vx2", "vy2")
    inputs = ("force",)
    law = staticmethod(lambda P, Q, inputs: ())

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P, Q = (O.moving(q[i] * N.x + q[i + 1] * N.y, u[i] * N.x + u[i + 1] * N.y) for i in (0, 2))
        bodies = [jk.Body(2.0, 0.0, P, N, name="one"), jk.Body(3.0, 0.0, Q, N, name="two")]
        return jk.Motion(bodies, points={"P": P, "Q": Q})

    def loads(self, t, q, u, motion, inputs):
        return self.law(motion["P"], motion["Q"], inputs)


def forces(law, q, u=(0.0, 0.0, 0.0, 0.0), inputs=None):
    """Forces on both particles (2, 2), from their accelerations."""
    system = type("Two", (Two,), {"law": staticmethod(law)})()
    u_dot = jk.accelerations(system, 0.0, jnp.array(q), jnp.array(u), inputs)
    return np.array(u_dot).reshape(2, 2) * np.array([[2.0], [3.0]])


Q0 = (1.0, 2.0, 4.0, 6.0)  # five metres apart, along (0.6, 0.8)
ALONG = np.array([0.6, 0.8])


@pytest.mark.parametrize(
    ("law", "tension"),
    [
        (lambda P, Q, i: jk.loads.spring(P, Q, 10.0, 4.5), 5.0),
        (lambda P, Q, i: jk.loads.spring(P, Q, 10.0), 50.0),
        (lambda P, Q, i: jk.loads.spring(P, Q, lambda x: 10.0 * x + 4.0 * x**3, 4.0), 14.0),
        (lambda P, Q, i: jk.loads.damper(P, Q, 2.0), 2.0 * 1.4),
        (lambda P, Q, i: jk.loads.damper(P, Q, lambda v: 3.0 * v**3), 3.0 * 1.4**3),
        (lambda P, Q, i: jk.loads.actuator(P, Q, i["force"]), -7.0),
    ],
)
def test_strut_forces_act_along_the_line_with_an_opposite_reaction(law, tension):
    on_P, on_Q = forces(law, Q0, (0.0, 1.0, 1.0, 2.0), {"force": 7.0})  # they part at (1, 1) . (0.6, 0.8)
    np.testing.assert_allclose(on_P, tension * ALONG, rtol=RTOL)
    np.testing.assert_allclose(on_Q, -tension * ALONG, rtol=RTOL)


@pytest.mark.slow
def test_a_spring_of_zero_rest_length_may_shrink_to_a_point():
    law = lambda P, Q, i: jk.loads.spring(P, Q, 10.0)  # noqa: E731
    system = type("Two", (Two,), {"law": staticmethod(law)})()
    f = lambda q: jk.accelerations(system, 0.0, q, jnp.zeros(4))  # noqa: E731
    stiffness = jax.jacfwd(f)(jnp.array([1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(stiffness[0], [-5.0, 0.0, 5.0, 0.0])


@pytest.mark.slow
def test_friction_approximates_coulombs_law():
    def law(P, Q, inputs):
        return jk.loads.friction(P, Q, 20.0, 0.5, speed=1e-6)

    on_P, on_Q = forces(law, Q0, (3.0, 4.0, 0.0, 0.0))
    np.testing.assert_allclose(on_P, -10.0 * ALONG, rtol=1e-10)
    np.testing.assert_allclose(on_Q, -on_P, rtol=RTOL)
    at_rest, _ = forces(lambda P, Q, i: jk.loads.friction(P, None, 20.0, 0.5), Q0)
    np.testing.assert_allclose(at_rest, 0.0)
    # along a surface only: the part of the velocity across it is not sliding
    on_P, on_Q = forces(
        lambda P, Q, i: jk.loads.friction(P, None, 20.0, 0.5, P.velocity.frame.y, speed=1e-6), Q0, (3.0, 4.0, 0.0, 0.0)
    )
    np.testing.assert_allclose([on_P, on_Q], [[-10.0, 0.0], [0.0, 0.0]], rtol=1e-10)


class Hinged(jk.System):
    """A disk on a shaft on the ground, both about N.z; spring, damper and dry friction between them."""

    coordinates = ("shaft", "disk")
    speeds = ("shaft_rate", "disk_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        S = N.rotate(3, q[0], u[0], "S")
        D = N.rotate(3, q[1], u[1], "D")
        bodies = [jk.Body(1.0, (0.5, 0.5, 1.0), O, S, name="shaft"), jk.Body(1.0, (1.0, 1.0, 2.0), O, D, name="disk")]
        return jk.Motion(bodies)

    def loads(self, t, q, u, motion, inputs):
        N, shaft, disk = motion.N, motion["shaft"], motion["disk"]
        return (
            jk.loads.torsional_spring(disk, shaft, N.z, q["disk"] - q["shaft"], lambda a: 8.0 * jnp.sin(a)),
            jk.loads.torsional_damper(disk, shaft, N.z, 0.3),
            jk.loads.torsional_friction(shaft, None, N.z, 0.7, rate=1e-8),
        )


def test_torsional_springs_and_dampers_of_hinges():
    u_dot = jk.accelerations(Hinged(), 0.0, jnp.array([0.2, 0.7]), jnp.array([1.5, -0.5]))
    on_disk = -8.0 * np.sin(0.5) + 0.3 * 2.0
    np.testing.assert_allclose(u_dot, [-on_disk - 0.7, on_disk / 2.0], rtol=1e-10)


@pytest.mark.weekly
def test_a_spring_conserves_energy():
    law = lambda P, Q, i: jk.loads.spring(P, Q, 10.0, 4.5)  # noqa: E731
    system = type("Two", (Two,), {"law": staticmethod(law)})()
    state = jk.State(jnp.array(Q0), jnp.array([0.0, 1.0, 1.0, -0.5]))
    ride = jk.simulate(system, state, jnp.linspace(0.0, 3.0, 301), rtol=1e-10, atol=1e-10)
    audit = jk.audit(system, ride)
    assert audit.energy_balance < 1e-9
    distance = np.hypot(ride["x2"] - ride["x1"], ride["y2"] - ride["y1"])
    potential = 5.0 * (distance - 4.5) ** 2
    np.testing.assert_allclose(audit.kinetic_energy + potential, audit.kinetic_energy[0] + potential[0], rtol=1e-9)
    assert "conserved" in str(audit)


def test_loads_on_bodies_act_at_their_mass_centres():
    class Bodies(Two):
        def loads(self, t, q, u, motion, inputs):
            return jk.loads.spring(motion["one"], motion["two"], 10.0, 4.5)

    u_dot = jk.accelerations(Bodies(), 0.0, jnp.array(Q0), jnp.zeros(4))
    np.testing.assert_allclose(u_dot[:2], 2.5 * ALONG, rtol=RTOL)


def test_axes_and_normals_may_have_any_length():
    class Long(Hinged):
        def loads(self, t, q, u, motion, inputs):
            N, shaft, disk = motion.N, motion["shaft"], motion["disk"]
            axis = jnp.array(3.0) * N.z
            return (
                jk.loads.torsional_spring(disk, shaft, 2.0 * N.z, q["disk"] - q["shaft"], lambda a: 8.0 * jnp.sin(a)),
                jk.loads.torsional_damper(disk, shaft, axis, 0.3),
                jk.loads.torsional_friction(shaft, None, 0.5 * N.z, 0.7, rate=1e-8),
            )

    at = jnp.array([0.2, 0.7]), jnp.array([1.5, -0.5])
    np.testing.assert_allclose(jk.accelerations(Long(), 0.0, *at), jk.accelerations(Hinged(), 0.0, *at), rtol=1e-14)
    rub = lambda n: lambda P, Q, i: jk.loads.friction(P, None, 20.0, 0.5, n * P.velocity.frame.y)  # noqa: E731
    moving = (3.0, 4.0, 0.0, 0.0)
    np.testing.assert_allclose(forces(rub(7.0), Q0, moving), forces(rub(1.0), Q0, moving), rtol=1e-14)


@pytest.mark.parametrize("length", [0, 0.0, np.float64(0.0), np.int64(0), jnp.array(0.0)])
def test_a_spring_of_zero_rest_length_in_every_number_type(length):
    together = (1.0, 1.0, 1.0, 1.0)
    law = lambda P, Q, i: jk.loads.spring(P, Q, 10.0, length)  # noqa: E731
    if isinstance(length, jax.Array):  # an array is a number that may change: it has no direction where it is zero
        with pytest.raises(
            ValueError, match=r"Two: the force at 'P', the force at 'Q' are not finite \(two points coincide"
        ):
            forces(law, together)
        return
    np.testing.assert_array_equal(forces(law, together), np.zeros((2, 2)))


def test_a_spring_between_coincident_points_raises():
    with pytest.raises(ValueError, match=r"is zero, so it has no direction. .* two points always coincide"):
        forces(lambda P, Q, i: jk.loads.spring(P, P.fixed(0.0 * P.velocity.frame.x), 10.0, 0.5), Q0)


LAWS = {
    "coulomb": (jk.loads.coulomb, {"v": 1.0, "level": 2.0, "width": 0.1}),
    "stribeck": (jk.loads.stribeck, {"v": 1.0, "kinetic": 1.0, "static": 2.0, "falloff": 0.1, "exponent": 1.0}),
    "quadratic": (jk.loads.quadratic, {"v": 1.0, "coefficient": 2.0}),
    "dead_zone": (jk.loads.dead_zone, {"x": 1.0, "lower": -1.0, "upper": 1.0, "width": 0.1}),
    "dc_motor": (jk.loads.dc_motor, {"voltage": 1.0, "rate": 0.0, "constant": 0.1, "resistance": 1.0}),
    "bouc_wen": (jk.loads.bouc_wen, {"v": 1.0, "z": 0.1, "stiffness": 2.0, "yield_force": 1.0, "share": 0.5}),
    "lugre": (
        jk.loads.lugre,
        {"v": 1.0, "z": 0.0, "stiffness": 1.0, "damping": 0.1, "kinetic": 1.0, "static": 2.0, "falloff": 0.1},
    ),
}


@pytest.mark.parametrize("name", LAWS)
def test_non_numeric_arguments_of_a_law_are_rejected_by_name(name):
    law, numbers = LAWS[name]
    law(**numbers)
    law(**{key: np.float32(x) for key, x in numbers.items()})
    for key in numbers:
        with pytest.raises(
            TypeError, match=rf"{name}: `{key}` must be one number, got 'rate'. By name it is q\['rate'\]"
        ):
            law(**numbers | {key: "rate"})
        for wrong in (True, [1.0], np.array("1")):
            with pytest.raises(TypeError, match=f"{name}: `{key}` must be one number, got"):
                law(**numbers | {key: wrong})
