"""Examples 3 and 4: one rotating frame and bar, with two sets of speeds."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque
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
