"""A walker with two straight legs on a slope: an impact, then the legs exchange their roles."""

from __future__ import annotations

import math

from .._integrate.events import falling
from .._kane.impact import Impact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Goswami et al. (1998)",
    "an impact, then the legs exchange their roles",
    q=(-0.22, 0.32, 0.0),
    u=(1.1, 0.4),
    operations=190,
)
class CompassGait(System):
    """A passive walker with two straight legs and point masses, on a slope (Goswami et al., 1998).

    The swing foot lands without bouncing or sliding. Then the legs exchange their roles. The scuffing of the swing foot
    at mid-stance is ignored. The source is Goswami et al. (1998), *A study of the passive gait of a compass-like biped
    robot: symmetry and chaos*, International Journal of Robotics Research 17(12). Its slope of 3 degrees has a stable
    gait. At 4.39 degrees the period of the gait doubles.

    | parameter | source | meaning |
    |---|---|---|
    | `hip_mass` | m_H | [kg] |
    | `leg_mass` | m | of each leg [kg] |
    | `slope` | phi | of the ground [rad] |
    | `shank` | a | from the foot to the mass of the leg [m] |
    | `thigh` | b | from the mass of the leg to the hip [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `stance`, `swing`: angle of each leg from the vertical, positive downhill [rad]; `foot`: distance of
      the stance foot from the origin, down the slope [m], constant between steps.
    - Speeds `stance_rate`, `swing_rate`: of the angles [rad/s].
    - Event `heel_strike`: the swing foot lands ahead of the stance foot.
    - Frame "S" in `motion`: x down the slope, y normal to it. Points: "foot" and "toe", the foot of the swing leg.
    """

    hip_mass: Scalar = parameter(10.0, positive=True, unit="kg")
    leg_mass: Scalar = parameter(5.0, positive=True, unit="kg")
    slope: Scalar = parameter(math.radians(3.0), unit="rad")
    shank: Scalar = parameter(0.5, positive=True, unit="m")
    thigh: Scalar = parameter(0.5, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("stance", "swing", "foot")
    speeds = ("stance_rate", "swing_rate")
    units = {"stance": "rad", "swing": "rad", "foot": "m"} | dict.fromkeys(speeds, "rad/s")

    def q_dot(self, t, q, u):
        return u["stance_rate"], u["swing_rate"], 0.0

    def motion(self, t, q, u):
        N, O = inertial()
        S = N.rotate(3, -self.slope, 0.0, "S")
        A = N.rotate(3, -q["stance"], -u["stance_rate"], "A")
        B = N.rotate(3, -q["swing"], -u["swing_rate"], "B")
        foot = O.fixed(q["foot"] * S.x)
        hip = foot.fixed((self.shank + self.thigh) * A.y)
        toe = hip.fixed(-(self.shank + self.thigh) * B.y)
        bodies = [
            Body(self.leg_mass, 0.0, foot.fixed(self.shank * A.y), A, name="stance leg"),
            Body(self.hip_mass, 0.0, hip, N, name="hip"),
            Body(self.leg_mass, 0.0, hip.fixed(-self.thigh * B.y), B, name="swing leg"),
        ]
        return Motion(bodies, points={"foot": foot, "toe": toe}, frames={"S": S})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def exchange(self, t, q, u):
        """The swing leg becomes the stance leg."""
        motion = self.motion(t, q, u)
        new_foot = motion["toe"].position.dot(motion["S"].x)
        angles = {"stance": q["swing"], "swing": q["stance"], "foot": new_foot}
        return {**angles, "stance_rate": u["swing_rate"], "swing_rate": u["stance_rate"]}

    def events(self, t, q, u):
        motion = self.motion(t, q, u)
        S, toe = motion["S"], motion["toe"].velocity
        lands = Impact(toe.dot(S.x), toe.dot(S.y), release=("foot",))
        # Not the height of the toe: it is also zero while the legs pass each other.
        height = 2.0 * self.slope - q["stance"] - q["swing"]
        ahead = q["stance"] - q["swing"]
        return {"heel_strike": falling(height, when=ahead, then=(lands, self.exchange))}
