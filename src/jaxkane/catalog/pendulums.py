"""Examples 1 and 6, Exercises 5.1 and 5.2: pendulums, and bars that hang from a slider or a piston."""

from __future__ import annotations

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, Torque, weight
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

    def motion(self, t, q, u):
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

    def loads(self, t, q, u, motion, inputs):
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

    def motion(self, t, q, u):
        l, m2 = self.length, self.bar_mass
        N, O = inertial()
        A = O.moving(q["x"] * N.x, u["x_dot"] * N.x, name="A")
        L = N.rotate(3, q["theta"], u["theta_dot"], "L")
        G = A.fixed(-0.5 * l * L.y)
        I = m2 * l**2 / 12
        slider = Body(self.slider_mass, 0.0, A, N, name="slider")
        bar = Body(m2, (I, 0.0, I), G, L, name="bar")
        return Motion((slider, bar), points={"A": A})

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        F = inputs["force"] - self.stiffness * q["x"] - self.damping * u["x_dot"]
        return weight(motion, -self.gravity * N.y), Force(F * N.x, motion["slider"])
