"""Examples 1, 3, 4, 6, Exercises 5.1 to 5.5, 5.7: pendulums, and bars and a disk on sliders or rotating frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import NamedVector, System
from ._entry import Loads, Quantity, Values, entry


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

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        k, link1, link2 = motion.N.z, motion["link1"], motion["link2"]
        return (
            weight(motion, -self.gravity * motion.N.y),
            Torque(inputs["shoulder_torque"] * k, link1),
            Torque(inputs["elbow_torque"] * k, link2, reaction_on=link1),
        )


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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        first = rotations.angle_rates("3-1-3", q["theta11":"theta13"], u["omega11":"omega13"])
        second = rotations.angle_rates("3-1-3", q["theta21":"theta23"], u["omega21":"omega23"])
        return (*first, *second)

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"gimbal_lock_1": jnp.sin(q["theta12"]), "gimbal_lock_2": jnp.sin(q["theta22"])}


@entry(
    "Exercise 5.1",
    "a mechanism with one degree of freedom, spring and damper",
    q=(0.6,),
    u=(-0.9,),
    operations=121,
    conservative=False,  # a damper
)
class BarWithPiston(System):
    """A bar between a vertical piston at its upper end A and a light horizontal slider at its lower end B.

    A spring and a damper act on the slider (Kamman, Unit 5, Exercise 5.1).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | of the bar [kg] |
    | `length` | l | of the bar [m] |
    | `piston_mass` | m_p | [kg] |
    | `stiffness`, `damping` | k, c | of the spring [N/m] and the damper [N s/m] at B; unstretched at x_B = 0 |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinate `theta`: angle of the bar from the vertical; x_B = l sin(theta), y_A = l cos(theta) [rad].
    - Speed: its rate [rad/s].
    - Input `force` (F): downward on the piston [N].
    - Auxiliary speeds `piston_guide` (A along N.x) and `slider_guide` (B along N.y) [m/s]: their forces act
      from the walls on piston and slider [N] (`constraint_forces`).
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(0.5, positive=True, unit="m")
    piston_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    stiffness: Scalar = parameter(200.0, unit="N/m")
    damping: Scalar = parameter(5.0, unit="N s/m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta",)
    speeds = ("theta_dot",)
    auxiliary_speeds = ("piston_guide", "slider_guide")
    inputs = ("force",)
    units = {"theta": "rad", "force": "N", **dict.fromkeys(auxiliary_speeds, "m/s")}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        m, l = self.mass, self.length
        theta, theta_dot = q["theta"], u["theta_dot"]
        N, O = inertial()
        L = N.rotate(3, theta, theta_dot, "L")
        v_A = N.vector(u["piston_guide"], u["slider_guide"], 0.0) - l * jnp.sin(theta) * theta_dot * N.y
        A = O.moving(l * jnp.cos(theta) * N.y, v_A, name="A")
        B = A.fixed(-l * L.y)  # from A the bar runs along -L.y
        G = A.fixed(-0.5 * l * L.y)
        I = m * l**2 / 12
        bar = Body(m, (I, 0.0, I), G, L, name="bar")
        piston = Body(self.piston_mass, 0.0, A, N, name="piston")
        return Motion((bar, piston), points={"B": B})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        N, B = motion.N, motion["B"]
        x, x_dot = B.position.dot(N.x), B.velocity.dot(N.x)
        return (
            weight(motion, -self.gravity * N.y),
            Force(-inputs["force"] * N.y, motion["piston"]),
            Force(-(self.stiffness * x + self.damping * x_dot) * N.x, B),
        )


@entry(
    "Exercise 5.2",
    "spring, damper, driving force",
    q=(0.2, 0.7),
    u=(0.4, -1.2),
    operations=101,
    conservative=False,
)
class SliderWithPinnedBar(System):
    """A mass on a horizontal rail with a spring, a damper and a driving force, and a slender bar pinned to the mass.

    See Kamman, Unit 5, Exercise 5.2.

    | parameter | book | meaning |
    |---|---|---|
    | `slider_mass` | m1 | [kg] |
    | `bar_mass` | m2 | [kg] |
    | `length` | l | of the bar [m] |
    | `stiffness`, `damping` | k, c | of spring [N/m] and damper [N s/m] at the slider; unstretched at x = 0 |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`: position of the slider along N.x [m]; `theta`: angle of the bar from the downward vertical,
      about N.z [rad].
    - Speeds: their rates [m/s, rad/s].
    - Input `force` (F): on the slider along N.x [N].
    """

    slider_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    bar_mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    stiffness: Scalar = parameter(50.0, unit="N/m")
    damping: Scalar = parameter(1.0, unit="N s/m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "theta")
    speeds = ("x_dot", "theta_dot")
    inputs = ("force",)
    units = {"x": "m", "theta": "rad", "force": "N"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        l, m2 = self.length, self.bar_mass
        N, O = inertial()
        A = O.moving(q["x"] * N.x, u["x_dot"] * N.x, name="A")
        L = N.rotate(3, q["theta"], u["theta_dot"], "L")
        G = A.fixed(-0.5 * l * L.y)
        I = m2 * l**2 / 12
        slider = Body(self.slider_mass, 0.0, A, N, name="slider")
        bar = Body(m2, (I, 0.0, I), G, L, name="bar")
        return Motion((slider, bar), points={"A": A})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        N = motion.N
        F = inputs["force"] - self.stiffness * q["x"] - self.damping * u["x_dot"]
        return weight(motion, -self.gravity * N.y), Force(F * N.x, motion["slider"])


class _FrameAndBar(System):
    # The mechanism of both examples. Only `q_dot` depends on the choice of speeds.
    mass: Scalar = parameter(2.0, positive=True, unit="kg")
    length: Scalar = parameter(0.8, positive=True, unit="m")
    distance: Scalar = parameter(0.5, positive=True, unit="m")

    coordinates = ("phi", "theta")
    inputs = ("frame_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        m, l, d = self.mass, self.length, self.distance
        phi_dot, theta_dot, *_ = self.q_dot(t, q, u)
        N, O = inertial()
        F = N.rotate(3, q["phi"], phi_dot, "F")
        B = F.rotate(2, q["theta"], theta_dot, "B")
        G = O.fixed(d * F.y)
        I = m * l**2 / 12
        bar = Body(m, (0.0, I, I), G, B, name="bar")  # the bar lies along B.x; the frame is light
        return Motion([bar], points={"G": G}, frames={"F": F, "B": B})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return u["center_speed"] / self.distance, u["omega2"]


class _ShaftAndBar(System):
    # The mechanism of both exercises. Only `q_dot` depends on the choice of speeds.
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")

    coordinates = ("phi", "theta")
    inputs = ("shaft_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        phi_dot, theta_dot, *_ = self.q_dot(t, q, u)
        N, O = inertial()
        S = N.rotate(3, q["phi"], phi_dot, "S")
        B = S.rotate(2, q["theta"], theta_dot, "B")
        I = self.mass * self.length**2 / 12
        return Motion([Body(self.mass, (I, I, 0.0), O, B, name="bar")], frames={"S": S})  # the bar lies along B.z

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
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

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return -u["omega1"] / jnp.sin(q["theta"]), u["omega2"]

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
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

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return -u["omega1"] / jnp.sin(q["theta"]), u["omega2"], u["omega_disk"]

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        C, frame, disk = motion["C"], motion["frame"], motion["disk"]
        return (
            Torque(inputs["column_torque"] * C.z, C),
            Torque(inputs["frame_torque"] * C.y, frame, reaction_on=C),
            Torque(inputs["disk_torque"] * C.y, disk, reaction_on=frame),
        )

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"frame_level": jnp.sin(q["theta"])}
