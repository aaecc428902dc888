"""Springs, dampers, actuators and friction between points and between frames, against forces by hand."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.loads import friction, spring

RTOL = 1e-12
Q0 = (1.0, 2.0, 4.0, 6.0)  # five metres apart, along (0.6, 0.8)
ALONG = np.array([0.6, 0.8])


class Two(jk.System):
    """Particles P and Q of 2 and 3 kg in a plane, with the loads `law(P, Q, inputs)`."""

    law: Any = eqx.field(static=True)
    coordinates = ("x1", "y1", "x2", "y2")
    speeds = ("vx1", "vy1", "vx2", "vy2")
    inputs = ("force",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P, Q = (O.moving(q[i] * N.x + q[i + 1] * N.y, u[i] * N.x + u[i + 1] * N.y) for i in (0, 2))
        bodies = [jk.Body(2.0, 0.0, P, N, name="one"), jk.Body(3.0, 0.0, Q, N, name="two")]
        return jk.Motion(bodies, points={"P": P, "Q": Q})

    def loads(self, t, q, u, motion, inputs):
        return self.law(motion["P"], motion["Q"], inputs)


def forces(law, q, u=(0.0, 0.0, 0.0, 0.0), inputs=None):
    """Forces on both particles (2, 2), from their accelerations."""
    u_dot = jk.accelerations(Two(law), 0.0, jnp.array(q), jnp.array(u), inputs)
    return np.array(u_dot).reshape(2, 2) * np.array([[2.0], [3.0]])


@pytest.mark.parametrize(
    ("law", "tension"),
    [
        (lambda P, Q, i: spring(P, Q, 10.0, 4.5), 5.0),
        (lambda P, Q, i: spring(P, Q, 10.0), 50.0),
        (lambda P, Q, i: spring(P, Q, lambda x: 10.0 * x + 4.0 * x**3, 4.0), 14.0),
        (lambda P, Q, i: jk.loads.damper(P, Q, 2.0), 2.0 * 1.4),
        (lambda P, Q, i: jk.loads.damper(P, Q, lambda v: 3.0 * v**3), 3.0 * 1.4**3),
        (lambda P, Q, i: jk.loads.actuator(P, Q, i["force"]), -7.0),
    ],
)
def test_strut_forces_act_along_the_line_with_an_opposite_reaction(law, tension):
    on_P, on_Q = forces(law, Q0, (0.0, 1.0, 1.0, 2.0), {"force": 7.0})  # they part at (1, 1) . (0.6, 0.8)
    np.testing.assert_allclose(on_P, tension * ALONG, rtol=RTOL)
    np.testing.assert_allclose(on_Q, -tension * ALONG, rtol=RTOL)


def test_loads_on_bodies_act_at_their_mass_centres():
    class Bodies(Two):
        def loads(self, t, q, u, motion, inputs):
            return spring(motion["one"], motion["two"], 10.0, 4.5)

    u_dot = jk.accelerations(Bodies(None), 0.0, jnp.array(Q0), jnp.zeros(4))
    np.testing.assert_allclose(u_dot[:2], 2.5 * ALONG, rtol=RTOL)


@pytest.mark.parametrize("length", [0, 0.0, np.float64(0.0), np.int64(0)])
def test_a_spring_of_zero_rest_length_between_coincident_points(length):
    together = (1.0, 1.0, 1.0, 1.0)
    np.testing.assert_array_equal(forces(lambda P, Q, i: spring(P, Q, 10.0, length), together), np.zeros((2, 2)))


@pytest.mark.slow
def test_the_derivative_of_a_spring_of_zero_rest_length_between_coincident_points():
    f = lambda q: jk.accelerations(Two(lambda P, Q, i: spring(P, Q, 10.0)), 0.0, q, jnp.zeros(4))  # noqa: E731
    np.testing.assert_allclose(jax.jacfwd(f)(jnp.ones(4))[0], [-5.0, 0.0, 5.0, 0.0])


def test_a_spring_with_a_rest_length_between_coincident_points_raises():
    """An array may change, so that it is a rest length even while it is zero."""
    at = r"Two: the force at 'P', the force at 'Q' are not finite \(two points coincide"
    with pytest.raises(ValueError, match=at):
        forces(lambda P, Q, i: spring(P, Q, 10.0, jnp.array(0.0)), (1.0, 1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match=r"is zero, so it has no direction. .* two points always coincide"):
        forces(lambda P, Q, i: spring(P, P.fixed(0.0 * P.velocity.frame.x), 10.0, 0.5), Q0)


@pytest.mark.slow
def test_friction_approximates_coulombs_law():
    moving = (3.0, 4.0, 0.0, 0.0)
    on_P, on_Q = forces(lambda P, Q, i: friction(P, Q, 20.0, 0.5, speed=1e-6), Q0, moving)
    np.testing.assert_allclose(on_P, -10.0 * ALONG, rtol=1e-10)
    np.testing.assert_allclose(on_Q, -on_P, rtol=RTOL)
    by_slip, _ = forces(lambda P, Q, i: friction(P, Q, 20.0, lambda v: 0.1 * v, speed=1e-6), Q0, moving)
    np.testing.assert_allclose(by_slip, on_P, rtol=1e-10)
    at_rest, _ = forces(lambda P, Q, i: friction(P, None, 20.0, 0.5), Q0)
    np.testing.assert_allclose(at_rest, 0.0)
    # Along a surface, whose normal may have any length, the velocity across it is not sliding.
    for n in (1.0, 7.0):
        law = lambda P, Q, i, n=n: friction(P, None, 20.0, 0.5, n * P.velocity.frame.y, speed=1e-6)  # noqa: E731
        np.testing.assert_allclose(forces(law, Q0, moving), [[-10.0, 0.0], [0.0, 0.0]], rtol=1e-10)


class Hinged(jk.System):
    """A disk on a shaft on the ground, both about N.z; spring, damper and dry friction between them."""

    lengths: tuple = eqx.field(static=True, default=(1.0, 1.0, 1.0))  # of the axes
    coordinates = ("shaft", "disk")
    speeds = ("shaft_rate", "disk_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        S = N.rotate(3, q[0], u[0], "S")
        D = N.rotate(3, q[1], u[1], "D")
        bodies = [jk.Body(1.0, (0.5, 0.5, 1.0), O, S, name="shaft"), jk.Body(1.0, (1.0, 1.0, 2.0), O, D, name="disk")]
        return jk.Motion(bodies)

    def loads(self, t, q, u, motion, inputs):
        shaft, disk, (a, b, c) = motion["shaft"], motion["disk"], (x * motion.N.z for x in self.lengths)
        return (
            jk.loads.torsional_spring(disk, shaft, a, q["disk"] - q["shaft"], lambda a: 8.0 * jnp.sin(a)),
            jk.loads.torsional_damper(disk, shaft, b, lambda w: 0.1 * w**3),
            jk.loads.torsional_friction(shaft, None, c, 0.7, rate=1e-8),
        )


@pytest.mark.parametrize("lengths", [(1.0, 1.0, 1.0), (2.0, 3.0, 0.5)])
def test_torsional_springs_and_dampers_about_axes_of_any_length(lengths):
    u_dot = jk.accelerations(Hinged(lengths), 0.0, jnp.array([0.2, 0.7]), jnp.array([1.5, -0.5]))
    on_disk = -8.0 * np.sin(0.5) + 0.1 * 2.0**3
    np.testing.assert_allclose(u_dot, [-on_disk - 0.7, on_disk / 2.0], rtol=1e-10)


@pytest.mark.weekly
def test_a_spring_conserves_energy():
    system = Two(lambda P, Q, i: spring(P, Q, 10.0, 4.5))
    state = jk.State(jnp.array(Q0), jnp.array([0.0, 1.0, 1.0, -0.5]))
    ride = jk.simulate(system, state, jnp.linspace(0.0, 3.0, 301), rtol=1e-10, atol=1e-10)
    audit = jk.audit(system, ride)
    assert audit.energy_balance < 1e-9
    distance = np.hypot(ride["x2"] - ride["x1"], ride["y2"] - ride["y1"])
    potential = 5.0 * (distance - 4.5) ** 2
    np.testing.assert_allclose(audit.kinetic_energy + potential, audit.kinetic_energy[0] + potential[0], rtol=1e-9)
    assert "conserved" in str(audit)
