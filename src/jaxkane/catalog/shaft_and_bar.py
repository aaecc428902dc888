"""Exercises 5.3 and 5.4: a bar pinned through a vertical shaft; with rates, and with body-fixed speeds."""

from __future__ import annotations

import jax.numpy as jnp

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


def _shaft_and_bar(mass, length, q, q_dot):
    # The shaft and the bar, which both exercises have in common.
    N, O = inertial()
    S = N.rotate(3, q["phi"], q_dot[0], "S")
    B = S.rotate(2, q["theta"], q_dot[1], "B")
    I = mass * length**2 / 12
    return O, S, Body(mass, (I, I, 0.0), O, B, name="bar")  # the bar lies along B.z


def _motor_torques(motion, inputs):
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
class ShaftAndBar(System):
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

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    shaft_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    shaft_radius: Scalar = parameter(0.1, positive=True, unit="m")

    coordinates = ("phi", "theta")
    speeds = ("phi_dot", "theta_dot")
    inputs = ("shaft_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(inputs, "N m")

    def motion(self, t, q, u):
        O, S, bar = _shaft_and_bar(self.mass, self.length, q, u["phi_dot", "theta_dot"])
        I = 0.25 * self.shaft_mass * self.shaft_radius**2
        shaft = Body(self.shaft_mass, (I, I, 2.0 * I), O, S, name="shaft")  # only 2 I has an effect: rotation about S.z
        return Motion((shaft, bar), frames={"S": S})

    def loads(self, t, q, u, motion, inputs):
        return _motor_torques(motion, inputs)


@entry(
    "Exercise 5.4",
    "the same mechanism, light shaft: body-fixed speeds",
    q=(0.3, 0.9),
    u=(-1.1, -0.7),
    operations=86,
)
class LightShaftAndBar(System):
    """`ShaftAndBar` with a light shaft and body-fixed speeds (Kamman, Unit 5, Exercise 5.4).

    | parameter | book | meaning |
    |---|---|---|
    | `mass`, `length` | m, l | of the bar [kg, m] |

    - Coordinates `phi`: the shaft about N.z; `theta`: the bar about the shaft's y axis, from the vertical [rad].
    - Speeds `omega1`, `omega2`: angular velocity of the bar along its own axes 1 and 2 [rad/s]. If the bar
      is parallel to the shaft, phi_dot = -omega1 / sin(theta) is not defined.
    - Inputs `shaft_torque` (M_phi, ground on shaft), `bar_torque` (M_theta, shaft on bar) [N m].
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")

    coordinates = ("phi", "theta")
    speeds = ("omega1", "omega2")
    inputs = ("shaft_torque", "bar_torque")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | dict.fromkeys(inputs, "N m")

    def q_dot(self, t, q, u):
        return -u["omega1"] / jnp.sin(q["theta"]), u["omega2"]

    def motion(self, t, q, u):
        _, S, bar = _shaft_and_bar(self.mass, self.length, q, self.q_dot(t, q, u))
        return Motion([bar], frames={"S": S})

    def loads(self, t, q, u, motion, inputs):
        return _motor_torques(motion, inputs)

    def events(self, t, q, u):
        return {"bar_along_shaft": jnp.sin(q["theta"])}
