"""Examples 3 and 4, Exercises 5.3 to 5.5 and 5.7: bars and a disk on frames that rotate about the vertical."""

from __future__ import annotations

import jax.numpy as jnp

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


class _FrameAndBar(System):
    # The mechanism of both examples. Only `q_dot` depends on the choice of speeds.
    mass: Scalar = parameter(2.0, positive=True, unit="kg")
    length: Scalar = parameter(0.8, positive=True, unit="m")
    distance: Scalar = parameter(0.5, positive=True, unit="m")

    coordinates = ("phi", "theta")
    inputs = ("frame_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t, q, u):
        m, l, d = self.mass, self.length, self.distance
        phi_dot, theta_dot, *_ = self.q_dot(t, q, u)
        N, O = inertial()
        F = N.rotate(3, q["phi"], phi_dot, "F")
        B = F.rotate(2, q["theta"], theta_dot, "B")
        G = O.fixed(d * F.y)
        I = m * l**2 / 12
        bar = Body(m, (0.0, I, I), G, B, name="bar")  # the bar lies along B.x; the frame is light
        return Motion([bar], points={"G": G}, frames={"F": F, "B": B})

    def loads(self, t, q, u, motion, inputs):
        F = motion["F"]
        return (
            Torque(inputs["frame_torque"] * F.z, F),
            Torque(inputs["bar_torque"] * F.y, motion["bar"], reaction_on=F),
        )


@entry(
    "Example 3",
    "a light rotating frame",
    q=(0.5, 0.8),
    u=(1.3, -0.9),
    operations=64,
)
class RotatingFrameAndBar(_FrameAndBar):
    """A light frame that rotates about the vertical, and a slender bar pinned to it (Kamman, Unit 5, Example 3).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | mass of the bar [kg] |
    | `length` | l | length of the bar [m] |
    | `distance` | d | from the vertical axis to the bar's mass centre [m] |

    - Coordinates `phi`: angle of the frame about the vertical N.z; `theta`: angle of the bar about the frame's arm,
      from the horizontal [rad].
    - Speeds: their rates [rad/s].
    - Inputs `frame_torque` (M_phi, ground on frame), `bar_torque` (M_theta, frame on bar) [N m].
    """

    speeds = ("phi_dot", "theta_dot")


@entry(
    "Example 4",
    "the same with other generalized speeds",
    q=(0.5, 0.8),
    u=(0.65, -0.9),
    operations=93,
)
class RotatingFrameAndBarChosenSpeeds(_FrameAndBar):
    """The mechanism of `RotatingFrameAndBar` with the speeds of Example 4 (Kamman, Unit 5).

    - Speeds `center_speed` (v_G = d phi_dot): of the bar's mass centre [m/s]; `omega2` = theta_dot [rad/s].
    """

    speeds = ("center_speed", "omega2")
    units = {**_FrameAndBar.units, "center_speed": "m/s", "omega2": "rad/s"}

    def q_dot(self, t, q, u):
        return u["center_speed"] / self.distance, u["omega2"]


class _ShaftAndBar(System):
    # The mechanism of both exercises. Only `q_dot` depends on the choice of speeds.
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")

    coordinates = ("phi", "theta")
    inputs = ("shaft_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t, q, u):
        phi_dot, theta_dot, *_ = self.q_dot(t, q, u)
        N, O = inertial()
        S = N.rotate(3, q["phi"], phi_dot, "S")
        B = S.rotate(2, q["theta"], theta_dot, "B")
        I = self.mass * self.length**2 / 12
        return Motion([Body(self.mass, (I, I, 0.0), O, B, name="bar")], frames={"S": S})  # the bar lies along B.z

    def loads(self, t, q, u, motion, inputs):
        S = motion["S"]
        return (
            Torque(inputs["shaft_torque"] * S.z, S),
            Torque(inputs["bar_torque"] * S.y, motion["bar"], reaction_on=S),
        )


@entry(
    "Exercise 5.3",
    "speeds are rates of angles",
    q=(0.3, 0.9),
    u=(1.4, -0.7),
    operations=67,
)
class ShaftAndBar(_ShaftAndBar):
    """A shaft that rotates about the vertical, and a slender bar pinned to it at its centre.

    See Kamman, Unit 5, Exercise 5.3.

    | parameter | book | meaning |
    |---|---|---|
    | `mass`, `length` | m, l | of the bar [kg, m] |
    | `shaft_mass`, `shaft_radius` | m_s, r | of the shaft [kg, m] |

    - Coordinates `phi`: the shaft about N.z; `theta`: the bar about the shaft's y axis, from the vertical [rad].
    - Speeds: their rates [rad/s].
    - Inputs `shaft_torque` (M_phi, ground on shaft), `bar_torque` (M_theta, shaft on bar) [N m].
    """

    shaft_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    shaft_radius: Scalar = parameter(0.1, positive=True, unit="m")

    speeds = ("phi_dot", "theta_dot")

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        I = 0.25 * self.shaft_mass * self.shaft_radius**2  # only 2 I has an effect: the shaft rotates about S.z
        shaft = Body(self.shaft_mass, (I, I, 2.0 * I), motion["bar"].center, motion["S"], name="shaft")
        return motion.extended([shaft])


@entry(
    "Exercise 5.4",
    "the same mechanism, light shaft: body-fixed speeds",
    q=(0.3, 0.9),
    u=(-1.1, -0.7),
    operations=86,
)
class LightShaftAndBar(_ShaftAndBar):
    """`ShaftAndBar` with a light shaft and body-fixed speeds (Kamman, Unit 5, Exercise 5.4).

    | parameter | book | meaning |
    |---|---|---|
    | `mass`, `length` | m, l | of the bar [kg, m] |

    - Coordinates `phi`: the shaft about N.z; `theta`: the bar about the shaft's y axis, from the vertical [rad].
    - Speeds `omega1`, `omega2`: angular velocity of the bar along its own axes 1 and 2 [rad/s]. If the bar
      is parallel to the shaft, phi_dot = -omega1 / sin(theta) is not defined.
    - Inputs `shaft_torque` (M_phi, ground on shaft), `bar_torque` (M_theta, shaft on bar) [N m].
    """

    speeds = ("omega1", "omega2")
    units = {**_ShaftAndBar.units, **dict.fromkeys(speeds, "rad/s")}

    def q_dot(self, t, q, u):
        return -u["omega1"] / jnp.sin(q["theta"]), u["omega2"]

    def events(self, t, q, u):
        return {"bar_along_shaft": jnp.sin(q["theta"])}


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
