"""Mechanisms for tests of inverse dynamics, and samples of their motions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane.fit.inverse.kinematics import KinematicSamples

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


def random_samples(system, n=60, seed=0):
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
    return truth, random_samples(truth)
