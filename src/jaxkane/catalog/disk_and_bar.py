"""Exercise 5.5: a bar pinned to a rotating disk, with a torsional spring and damper."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.5",
    "a damper, a bar on a turning disk",
    q=(0.3, 0.6),
    u=(1.5, -0.8),
    operations=108,
    conservative=False,  # a damper
)
class DiskAndBar(System):
    """A horizontal disk that rotates about the vertical, and a slender bar that hangs from a pin on the disk.

    See Kamman, Unit 5, Exercise 5.5.

    | parameter | book | meaning |
    |---|---|---|
    | `disk_mass`, `disk_radius` | m_d, R | [kg, m] |
    | `mass`, `length` | m, l | of the bar [kg, m] |
    | `pin_radius` | b | from the vertical axis to the pin P [m] |
    | `stiffness`, `damping` | k, c | of the torsional spring [N m/rad] and damper [N m s/rad] at P |
    | `gravity` | g | along -N.z [m/s^2] |

    - Coordinates `phi`: angle of the disk about N.z; `theta`: angle of the bar about the disk's x axis, from the
      downward vertical, where the spring is unstretched [rad].
    - Speeds: their rates [rad/s].
    - Inputs `disk_torque` (M_phi, ground on disk), `bar_torque` (M_theta, disk on bar) [N m].
    """

    disk_mass: Scalar = parameter(4.0, positive=True, unit="kg")
    disk_radius: Scalar = parameter(0.5, positive=True, unit="m")
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(0.6, positive=True, unit="m")
    pin_radius: Scalar = parameter(0.4, unit="m")
    stiffness: Scalar = parameter(2.0, unit="N m/rad")
    damping: Scalar = parameter(0.1, unit="N m s/rad")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("phi", "theta")
    speeds = ("phi_dot", "theta_dot")
    inputs = ("disk_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t, q, u):
        m, l = self.mass, self.length
        N, O = inertial()
        D = N.rotate(3, q["phi"], u["phi_dot"], "D")
        B = D.rotate(1, q["theta"], u["theta_dot"], "B")
        P = O.fixed(self.pin_radius * D.y)
        G = P.fixed(-0.5 * l * B.z)  # the bar hangs along -B.z
        I_D = self.disk_mass * self.disk_radius**2 / 4
        I_B = m * l**2 / 12
        disk = Body(self.disk_mass, (I_D, I_D, 2.0 * I_D), O, D, name="disk")
        bar = Body(m, (I_B, I_B, 0.0), G, B, name="bar")
        return Motion((disk, bar), points={"P": P})

    def loads(self, t, q, u, motion, inputs):
        disk, bar = motion["disk"], motion["bar"]
        joint_torque = inputs["bar_torque"] - self.stiffness * q["theta"] - self.damping * u["theta_dot"]
        return (
            weight(motion, -self.gravity * motion.N.z),
            Torque(inputs["disk_torque"] * motion.N.z, disk),
            Torque(joint_torque * disk.frame.x, bar, reaction_on=disk),
        )
