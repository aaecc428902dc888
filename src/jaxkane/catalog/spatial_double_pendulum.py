"""Example 6: the three-dimensional double pendulum with body-fixed speeds."""

from __future__ import annotations

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Example 6",
    "ball joints, 3-1-3 angles",
    q=(0.4, 1.1, -0.3, -0.6, 0.9, 0.8),
    u=(0.7, -0.4, 0.5, -0.6, 0.3, 0.9),
    operations=594,
)
class SpatialDoublePendulum(System):
    """Two links on ball joints, oriented by 3-1-3 angles, with body-fixed speeds (Kamman, Unit 5, Example 6).

    | parameter | book | meaning |
    |---|---|---|
    | `mass1`, `mass2` | m1, m2 | of the links [kg] |
    | `length1`, `length2` | l1, l2 | of the links; mass centres at their midpoints [m] |
    | `I11_1`, `I22_1`, `I33_1` | I^1 | first link, about its mass centre; axis 2 is the link [kg m^2] |
    | `I11_2`, `I22_2`, `I33_2` | I^2 | second link, likewise [kg m^2] |
    | `gravity` | g | along -N.y [m/s^2] |

    With I22 = 0 (a line), no mass moves with the speeds omega12 and omega22, and the equations have no solution (note
    2).

    - Coordinates `theta11`, `theta12`, `theta13` and `theta21`, `theta22`, `theta23`: 3-1-3 angles of the links, both
      relative to the ground [rad]. At zero, a link hangs along -N.y, and its angles are in gimbal lock.
    - Speeds `omega11` ... `omega13`, `omega21` ... `omega23`: angular velocities along the links' own axes [rad/s].
    """

    mass1: Scalar = parameter(1.2, positive=True, unit="kg")
    mass2: Scalar = parameter(0.8, positive=True, unit="kg")
    length1: Scalar = parameter(1.0, positive=True, unit="m")
    length2: Scalar = parameter(0.75, positive=True, unit="m")
    I11_1: Scalar = parameter(0.1, positive=True, unit="kg m^2")
    I22_1: Scalar = parameter(0.002, unit="kg m^2")
    I33_1: Scalar = parameter(0.1, positive=True, unit="kg m^2")
    I11_2: Scalar = parameter(0.0375, positive=True, unit="kg m^2")
    I22_2: Scalar = parameter(0.001, unit="kg m^2")
    I33_2: Scalar = parameter(0.0375, positive=True, unit="kg m^2")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta11", "theta12", "theta13", "theta21", "theta22", "theta23")
    speeds = ("omega11", "omega12", "omega13", "omega21", "omega22", "omega23")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s")

    def q_dot(self, t, q, u):
        first = rotations.angle_rates("3-1-3", q["theta11":"theta13"], u["omega11":"omega13"])
        second = rotations.angle_rates("3-1-3", q["theta21":"theta23"], u["omega21":"omega23"])
        return (*first, *second)

    def motion(self, t, q, u):
        l1, l2 = self.length1, self.length2
        N, O = inertial()
        angles1, angles2 = q["theta11":"theta13"], q["theta21":"theta23"]
        L1 = N.rotate_sequence("3-1-3", angles1, angular_velocity=u["omega11":"omega13"], name="L1")
        L2 = N.rotate_sequence("3-1-3", angles2, angular_velocity=u["omega21":"omega23"], name="L2")
        G1 = O.fixed(-0.5 * l1 * L1.y)
        A = O.fixed(-l1 * L1.y)
        G2 = A.fixed(-0.5 * l2 * L2.y)
        link1 = Body(self.mass1, (self.I11_1, self.I22_1, self.I33_1), G1, L1, name="link1")
        link2 = Body(self.mass2, (self.I11_2, self.I22_2, self.I33_2), G2, L2, name="link2")
        return Motion((link1, link2), points={"O": O, "A": A})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def events(self, t, q, u):
        return {"gimbal_lock_1": jnp.sin(q["theta12"]), "gimbal_lock_2": jnp.sin(q["theta22"])}
