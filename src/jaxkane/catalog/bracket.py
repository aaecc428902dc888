"""Exercise 5.8: a bracket on a ball joint, oriented by 1-2-3 angles."""

from __future__ import annotations

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.8",
    "a ball joint, body-fixed angles",
    q=(0.5, -0.4, 0.7),
    u=(0.9, -0.6, 1.2),
    operations=142,
)
class Bracket(System):
    """A cross of two identical slender bars OA and BC on a ball joint at O (Kamman, Unit 5, Exercise 5.8).

    OA is along axis 2 of the bracket, BC along axis 1. Their midpoints coincide at G. B is on the positive side of
    axis 1.

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | of each bar [kg] |
    | `length` | L | of each bar [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `theta1`, `theta2`, `theta3`: 1-2-3 angles [rad].
    - Speeds `omega1`, `omega2`, `omega3`: angular velocity along the bracket's axes [rad/s].
    - Inputs `tip_force1`, `tip_force3` (F_A1, F_A3, at A along axes 1 and 3), `arm_force` (F_B, at B along
      axis 3) [N].
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta1", "theta2", "theta3")
    speeds = ("omega1", "omega2", "omega3")
    inputs = ("tip_force1", "tip_force3", "arm_force")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | dict.fromkeys(inputs, "N")

    def q_dot(self, t, q, u):
        return rotations.angle_rates("1-2-3", q["theta1":"theta3"], u["omega1":"omega3"])

    def motion(self, t, q, u):
        m, L = self.mass, self.length
        N, O = inertial()
        E = N.rotate_sequence("1-2-3", q["theta1":"theta3"], angular_velocity=u["omega1":"omega3"], name="E")
        G = O.fixed(0.5 * L * E.y)
        A = O.fixed(L * E.y)
        B = G.fixed(0.5 * L * E.x)
        I = m * L**2 / 12
        bracket = Body(2.0 * m, (I, I, 2.0 * I), G, E, name="bracket")
        return Motion([bracket], points={"A": A, "B": B}, frames={"E": E})

    def loads(self, t, q, u, motion, inputs):
        E = motion["E"]
        return (
            weight(motion, -self.gravity * motion.N.y),
            Force(E.vector(inputs["tip_force1"], 0.0, inputs["tip_force3"]), motion["A"]),
            Force(inputs["arm_force"] * E.z, motion["B"]),
        )

    def events(self, t, q, u):
        return {"gimbal_lock": jnp.cos(q["theta2"])}
