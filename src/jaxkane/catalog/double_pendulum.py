"""Example 1: the planar double pendulum. The speeds are rates, so Kane's method is that of d'Alembert."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Example 1",
    "speeds are rates of angles; joint torques",
    q=(0.7, -0.4),
    u=(1.1, -0.8),
    operations=146,
)
class DoublePendulum(System):
    """Two identical uniform slender links in a vertical plane, driven at both joints (Kamman, Unit 5, Example 1).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | mass of each link [kg] |
    | `length` | l | length of each link [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `theta1`, `theta2`: angle of each link from the downward vertical, about N.z [rad].
    - Speeds: their rates [rad/s].
    - Inputs `shoulder_torque` (M1, ground on first link), `elbow_torque` (M2, first link on second) [N m].
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta1", "theta2")
    speeds = ("theta1_dot", "theta2_dot")
    inputs = ("shoulder_torque", "elbow_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t, q, u):
        m, l = self.mass, self.length
        N, O = inertial()
        L1 = N.rotate(3, q["theta1"], u["theta1_dot"], "L1")
        L2 = N.rotate(3, q["theta2"], u["theta2_dot"], "L2")
        A = O.fixed(-l * L1.y)  # a link hangs along -y of its frame
        G1 = O.fixed(-0.5 * l * L1.y)
        G2 = A.fixed(-0.5 * l * L2.y)
        I = m * l**2 / 12
        link1 = Body(m, (I, 0.0, I), G1, L1, name="link1")
        link2 = Body(m, (I, 0.0, I), G2, L2, name="link2")
        return Motion((link1, link2), points={"O": O, "A": A})

    def loads(self, t, q, u, motion, inputs):
        k, link1, link2 = motion.N.z, motion["link1"], motion["link2"]
        return (
            weight(motion, -self.gravity * motion.N.y),
            Torque(inputs["shoulder_torque"] * k, link1),
            Torque(inputs["elbow_torque"] * k, link2, reaction_on=link1),
        )
