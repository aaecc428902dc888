"""Five systems of SymPy's own tests, described with the public API alone and held to SymPy's accelerations.

Figures: tests/data/sympy_kane_systems.json, which SymPy 1.14's KanesMethod computed.
"""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from mechanisms import RollingDisc

import jaxkane as jk
from jaxkane import Scalar, parameter

FIGURES = json.loads((pathlib.Path(__file__).parents[1] / "data" / "sympy_kane_systems.json").read_text())["systems"]


class RollingDiscDependent(jk.System):
    """test_kane2.test_aux_dep: a disc whose height and centre's velocity are dependent; N.z down."""

    m: Scalar = parameter(positive=True)  # [kg]
    r: Scalar = parameter(positive=True)  # [m]
    g: Scalar = parameter()  # [m/s^2]
    I: Scalar = parameter(positive=True)  # [kg m^2], across
    J: Scalar = parameter(positive=True)  # [kg m^2], axial

    coordinates = ("q0", "q1", "q2", "q3")  # yaw, lean, spin, height of the centre along N.z
    speeds = ("u0", "u1", "u2")  # angular velocity in the lean frame B
    dependent_speeds = ("u3", "u4", "u5")  # velocity of the centre in the yaw frame A
    auxiliary_speeds = ("ua0", "ua1", "ua2")  # velocity of the contact point in A
    dependent_coordinates = ("q3",)

    def q_dot(self, t, q, u):
        return u["u2"] / jnp.cos(q["q1"]), u["u0"], u["u1"] - u["u2"] * jnp.tan(q["q1"]), u["u5"]

    def configuration_constraints(self, t, q):
        return (-self.r * jnp.cos(q["q1"]) - q["q3"],)

    def motion(self, t, q, u):
        yaw_rate, lean_rate, *_ = self.q_dot(t, q, u)
        N, _ = jk.inertial()
        A = N.rotate(3, q["q0"], yaw_rate)
        B = A.rotate(1, q["q1"], lean_rate)
        omega = B.vector(u["u0"], u["u1"], u["u2"])
        P = jk.Point.at(A.vector(u["ua0"], u["ua1"], u["ua2"]))
        G = jk.Point.at(A.vector(u["u3"], u["u4"], u["u5"]))
        slip = G.velocity - (P.velocity + omega.cross(-self.r * B.z))
        disc = jk.Body(self.m, (self.I, self.J, self.I), G, B, omega, "disc")
        return jk.Motion([disc], [slip])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, self.g * motion.N.z)


class FourBarLinkage(jk.System):
    """test_jointsmethod.test_four_bar_linkage_with_manual_constraints: a closed planar loop; link 1 is the ground."""

    l1: Scalar = parameter(positive=True)  # [m]
    l2: Scalar = parameter(positive=True)  # [m]
    l3: Scalar = parameter(positive=True)  # [m]
    l4: Scalar = parameter(positive=True)  # [m]
    rho: Scalar = parameter(positive=True)  # [kg/m]

    coordinates = ("q1", "q2", "q3")  # joint angles
    speeds = ("u1",)
    dependent_speeds = ("u2", "u3")
    dependent_coordinates = ("q2", "q3")

    def configuration_constraints(self, t, q):
        gap = self.motion(t, q, (0.0, 0.0, 0.0))["end"].position
        return gap.to(gap.frame.root)[:2]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        pin = O.fixed(self.l1 * N.x)
        frame, joint = N, pin
        links = []
        for l, angle, rate in zip((self.l2, self.l3, self.l4), q, u, strict=True):
            frame = frame.rotate(3, angle, rate)
            m = self.rho * l
            I = m * l**2 / 12
            links.append(jk.Body(m, (0.0, I, I), joint.fixed(0.5 * l * frame.x), frame))
            joint = joint.fixed(l * frame.x)
        return jk.Motion(links, points={"pin": pin, "end": joint})


class CartesianPendulum(jk.System):
    """test_linearize.test_linearize_pendulum_kane_nonminimal: a point on a rod, in x and y; gravity along N.x."""

    m: Scalar = parameter(positive=True)  # [kg]
    L: Scalar = parameter(positive=True)  # [m]

    coordinates = ("q2", "q1")  # y, x
    speeds = ("u2",)
    dependent_speeds = ("u1",)
    dependent_coordinates = ("q1",)

    def configuration_constraints(self, t, q):
        return (jnp.sqrt(q["q1"] ** 2 + q["q2"] ** 2) - self.L,)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["q1"], q["q2"], 0.0), N.vector(u["u1"], u["u2"], 0.0))
        return jk.Motion([jk.Body(self.m, 0.0, P, N)])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, 9.8 * motion.N.x)


class PendulumOnCart(jk.System):
    """models.n_link_pendulum_on_cart(3, True, True): three points in a chain, angles from the upward vertical."""

    masses: jax.Array = parameter(positive=True, shape=(4,))  # [kg], of the cart and the points
    lengths: jax.Array = parameter(positive=True, shape=(3,))  # [m]
    g: Scalar = parameter()  # [m/s^2]

    coordinates = ("q0", "q1", "q2", "q3")
    speeds = ("u0", "u1", "u2", "u3")
    inputs = ("F", "T1", "T2", "T3")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        point = O.moving(q[0] * N.x, u[0] * N.x)
        bodies = [jk.Body(self.masses[0], 0.0, point, N, name="cart")]
        for i in range(3):
            link = N.rotate(3, q[i + 1], u[i + 1])
            point = point.fixed(self.lengths[i] * link.y)
            bodies.append(jk.Body(self.masses[i + 1], 0.0, point, link, name=f"point{i + 1}"))
        return jk.Motion(bodies)

    def loads(self, t, q, u, motion, inputs):
        N, (cart, *points) = motion.N, motion.bodies
        torques = [
            jk.Torque(inputs[f"T{i + 1}"] * N.z, point, reaction_on=before)
            for i, (before, point) in enumerate(zip(motion.bodies, points, strict=False))
        ]
        return jk.weight(motion, -self.g * N.y), jk.Force(inputs["F"] * N.x, cart), torques


SYSTEMS = {
    "rolling_disc_minimal": RollingDisc,
    "rolling_disc_dependent_q_u_aux": RollingDiscDependent,
    "four_bar_linkage": FourBarLinkage,
    "pendulum_cartesian_nonminimal": CartesianPendulum,
    "n_link_pendulum_on_cart_n3": lambda g, **p: PendulumOnCart(
        masses=np.array([p[f"m{i}"] for i in range(4)]), lengths=np.array([p[f"l{i}"] for i in range(3)]), g=g
    ),
}
