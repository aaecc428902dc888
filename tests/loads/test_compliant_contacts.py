"""Compliant contacts: Hertz's closed forms, the balance of momentum, and the rigid contact as the limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import beta

import jaxkane as jk

RADIUS, SPEED = 0.1, 1.0


class TwoBalls(jk.System):
    """Two spheres in a plane: 1 kg and 2 kg."""

    stiffness: jk.Scalar = jk.parameter(1e6)
    dissipation: jk.Scalar = jk.parameter(0.0)
    friction: jk.Scalar = jk.parameter(0.3)
    coordinates = ("x1", "y1", "a1", "x2", "y2", "a2")
    speeds = ("vx1", "vy1", "w1", "vx2", "vy2", "w2")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        balls = []
        for i, mass in enumerate((1.0, 2.0)):
            (x, y, angle), (vx, vy, rate) = (z[3 * i : 3 * i + 3] for z in (q, u))
            frame = N.rotate(3, angle, rate)
            center = O.moving(x * N.x + y * N.y, vx * N.x + vy * N.y)
            balls.append(jk.Body(mass, (0.4 * mass * RADIUS**2,) * 3, center, frame, name=f"ball {i}"))
        return jk.Motion(balls)

    def loads(self, t, q, u, motion, inputs):
        law = {"dissipation": self.dissipation, "friction": self.friction, "speed": 1e-3}
        return jk.loads.sphere_contact(*motion.bodies, (RADIUS, RADIUS), self.stiffness, **law)


@jax.jit
def collide(balls, spin):
    start = jk.State({"x1": -2 * RADIUS}, {"vx1": SPEED, "w1": spin})
    ride = jk.simulate(balls, start, jnp.linspace(0, 0.02, 401), rtol=1e-9, atol=1e-11)
    return ride.q, ride.u


def test_the_impact_of_two_spheres_is_that_of_hertz():
    """m x'' = -k x^1.5 from the speed v. The largest depth is (5 m v^2 / (4 k))^0.4; the time has a beta function."""
    q, u = collide(TwoBalls(friction=0.0), 0.0)
    depth, m = 2 * RADIUS - (q[:, 3] - q[:, 0]), 2 / 3
    largest = (1.25 * m * SPEED**2 / 1e6) ** 0.4
    duration = 2 * largest / SPEED * beta(0.4, 0.5) / 2.5
    np.testing.assert_allclose(jnp.max(depth), largest, rtol=1e-4)
    assert abs(float(jnp.sum(depth > 0)) * 5e-5 - duration) <= 1e-4
    np.testing.assert_allclose(u[-1], [-1 / 3, 0, 0, 2 / 3, 0, 0], atol=1e-8)  # elastic


def test_action_and_reaction_act_at_one_point():
    q, u = collide(TwoBalls(dissipation=0.1), 5.0)

    def momenta(q, u):
        angular = q[0] * u[1] - q[1] * u[0] + 2 * (q[3] * u[4] - q[4] * u[3]) + 0.004 * u[2] + 0.008 * u[5]
        return jnp.array([u[0] + 2 * u[3], u[1] + 2 * u[4], angular])

    np.testing.assert_allclose(momenta(q[-1], u[-1]), momenta(q[0], u[0]), atol=1e-10)
    np.testing.assert_allclose(u[-1, 3] - u[-1, 0], 1 - 0.1 * SPEED, atol=0.01)  # of first order in the dissipation
    assert abs(float(u[-1, 1])) > 0.05  # by friction


class OnAPlate(jk.System):
    """A ball above a plate that turns about O."""

    stiffness: jk.Scalar = jk.parameter(1e6)
    coordinates, speeds = ("x", "y", "tilt"), ("x_dot", "y_dot", "tilt_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = N.rotate(3, q["tilt"], u["tilt_rate"], "P")
        center = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        ball = jk.Body(1.0, (0.004,) * 3, center, N, name="ball")
        return jk.Motion([ball, jk.Body(3.0, (0.5,) * 3, O, P, name="plate")])

    def loads(self, t, q, u, motion, inputs):
        ball, plate = motion.bodies
        law = {"radius": RADIUS, "surface": plate.center, "on": plate}
        return jk.loads.plane_contact(ball, plate.frame.y, self.stiffness, **law)


class OnARigidPlate(OnAPlate):
    def loads(self, t, q, u, motion, inputs):
        return ()

    def contacts(self, t, q, u, motion):
        ball, plate = motion.bodies
        up = plate.frame.y
        lowest = ball.center.fixed(-RADIUS * up, motion.N)
        below = plate.center.fixed(lowest.position_from(plate.center), plate.frame)
        gap = ball.center.position_from(plate.center).dot(up) - RADIUS
        return {"plate": jk.Contact(lowest, up, gap=gap, restitution=1.0, surface=below)}


@pytest.mark.slow
def test_a_stiff_contact_with_a_moving_body_approaches_the_rigid_one():
    start, ts = jk.State({"x": 0.5, "y": 0.2}, {"y_dot": -1.0}), jnp.linspace(0, 0.3, 4)
    rigid = jk.simulate(OnARigidPlate(), start, ts).u[-1]
    soft = [jk.simulate(OnAPlate(k), start, ts, rtol=1e-8).u[-1] for k in (1e4, 1e6, 1e8)]
    errors = [float(jnp.max(jnp.abs(u - rigid))) for u in soft]
    assert float(rigid[2]) < -0.5  # the plate was hit beside its axis
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 2e-3


def test_derivatives_of_the_law_are_finite_without_depth():
    of = jax.grad(jk.loads.hunt_crossley, argnums=(0, 1, 2, 3, 4))
    for depth in (0.0, -0.1):
        np.testing.assert_array_equal(of(depth, 0.2, 1e4, 0.1, 1.5), 0.0)
    assert float(jk.loads.hunt_crossley(0.1, -100.0, 1e4, 0.1)) == 0.0  # it does not pull


def test_arguments_that_contradict_each_other_are_refused():
    N, O = jk.inertial()
    with pytest.raises(ValueError, match="`on` needs `surface`"):
        jk.loads.plane_contact(O, N.y, 1.0, on=jk.Body(1.0, 0.0, O))
    with pytest.raises(TypeError, match="sphere must be a Body"):
        jk.loads.plane_contact(O, N.y, 1.0, radius=0.1)
