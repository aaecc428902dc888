"""Exercise 5.7: a column, a cross-shaped frame and a disk, driven at three revolute joints."""

from __future__ import annotations

import jax.numpy as jnp

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.7",
    "three nested rotations",
    q=(0.2, 0.9, -0.4),
    u=(-1.0, 0.2, 3.0),
    operations=265,
)
class ColumnFrameAndDisk(System):
    """A light column that rotates about the vertical, a frame A on the column, and a disk D on the frame.

    The axes are three revolute joints (Kamman, Unit 5, Exercise 5.7).

    | parameter | book | meaning |
    |---|---|---|
    | `frame_mass`, `disk_mass` | m_A, m_D | [kg] |
    | `distance` | b | from the column to G_A along A.y; G_D is at twice that [m] |
    | `frame_I11`, `frame_I22`, `frame_I33` | I^GA | of the frame about G_A [kg m^2] |
    | `disk_transverse_inertia` | I11^GD = I33^GD | of the disk about G_D, across its axis [kg m^2] |
    | `disk_axial_inertia` | I22^GD | of the disk about its axis A.y [kg m^2] |

    - Coordinates `phi`: column about N.z; `theta`: frame about the column's y axis; `psi`: disk about A.y [rad].
    - Speeds `omega1`, `omega2`: angular velocity of the frame along A.x and A.y; `omega_disk`: of the disk relative to
      the frame [rad/s]. At theta = 0, phi_dot = -omega1 / sin(theta) is not defined.
    - Inputs `column_torque` (T_phi, ground on column), `frame_torque` (T_theta, column on frame), `disk_torque`
      (T_psi, frame on disk) [N m].
    """

    frame_mass: Scalar = parameter(3.0, positive=True, unit="kg")
    disk_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    distance: Scalar = parameter(0.4, positive=True, unit="m")
    frame_I11: Scalar = parameter(0.22, positive=True, unit="kg m^2")
    frame_I22: Scalar = parameter(0.05, positive=True, unit="kg m^2")
    frame_I33: Scalar = parameter(0.20, positive=True, unit="kg m^2")
    disk_transverse_inertia: Scalar = parameter(0.02, positive=True, unit="kg m^2")
    disk_axial_inertia: Scalar = parameter(0.04, positive=True, unit="kg m^2")

    coordinates = ("phi", "theta", "psi")
    speeds = ("omega1", "omega2", "omega_disk")
    inputs = ("column_torque", "frame_torque", "disk_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | dict.fromkeys(inputs, "N m")

    def q_dot(self, t, q, u):
        return -u["omega1"] / jnp.sin(q["theta"]), u["omega2"], u["omega_disk"]

    def motion(self, t, q, u):
        phi_dot, theta_dot, psi_dot, *_ = self.q_dot(t, q, u)
        N, O = inertial()
        C = N.rotate(3, q["phi"], phi_dot, "C")
        A = C.rotate(2, q["theta"], theta_dot, "A")
        G_A, G_D = O.fixed(self.distance * A.y), O.fixed(2.0 * self.distance * A.y)
        I_A = (self.frame_I11, self.frame_I22, self.frame_I33)
        I_D = (self.disk_transverse_inertia, self.disk_axial_inertia, self.disk_transverse_inertia)
        frame = Body(self.frame_mass, I_A, G_A, A, name="frame")
        disk = Body(self.disk_mass, I_D, G_D, A, A.angular_velocity + psi_dot * A.y, name="disk")
        return Motion((frame, disk), frames={"C": C, "A": A})

    def loads(self, t, q, u, motion, inputs):
        C, frame, disk = motion["C"], motion["frame"], motion["disk"]
        return (
            Torque(inputs["column_torque"] * C.z, C),
            Torque(inputs["frame_torque"] * C.y, frame, reaction_on=C),
            Torque(inputs["disk_torque"] * C.y, disk, reaction_on=frame),
        )

    def events(self, t, q, u):
        return {"frame_level": jnp.sin(q["theta"])}
