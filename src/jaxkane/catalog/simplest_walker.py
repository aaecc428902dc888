"""The simplest walker: a mass at the hip and a small mass at each foot."""

from __future__ import annotations

from .._integrate.events import rising
from .._kane.impact import Impact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Garcia et al. (1998)",
    "impacts with a small mass at the feet",
    q=(0.2, 0.4, 0.0),
    u=(-0.626, -0.05),
    operations=128,
)
class SimplestWalker(System):
    """A walker with massless legs on a slope, a mass at the hip and a small mass at each foot (Garcia et al., 1998).

    The source is Garcia et al. (1998), *The simplest walking model: stability, complexity, and scaling*, ASME Journal
    of Biomechanical Engineering 120(2). It contains the limit of feet without mass, in which the motion of the hip does
    not depend on the swing leg. The scuffing of the swing foot at mid-stance is ignored.

    | parameter | source | meaning |
    |---|---|---|
    | `slope` | gamma | of the ground [rad] |
    | `hip_mass` | M | [kg] |
    | `foot_mass` | m | of each foot; the limit of the source is 0 [kg] |
    | `length` | l | of the legs [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `theta`: angle of the stance leg from the normal of the slope, positive uphill [rad]; `phi`: angle
      between the legs [rad]; `foot`: distance of the stance foot from the origin, down the slope [m], constant between
      steps. The angle of the swing leg from the normal is theta - phi.
    - Speeds `theta_dot`, `phi_dot`: rates of the angles [rad/s]. The source divides them by sqrt(g / l).
    - Event `heel_strike`: the swing foot lands ahead of the stance foot.
    - Frame "S" in `motion`: x down the slope, y normal to it. Points: "foot" and "toe", the foot of the swing leg.
    """

    slope: Scalar = parameter(0.009, unit="rad")
    hip_mass: Scalar = parameter(1.0, positive=True, unit="kg")
    foot_mass: Scalar = parameter(0.001, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta", "phi", "foot")
    speeds = ("theta_dot", "phi_dot")
    units = {"theta": "rad", "phi": "rad", "foot": "m"} | dict.fromkeys(speeds, "rad/s")

    def q_dot(self, t, q, u):
        return u["theta_dot"], u["phi_dot"], 0.0

    def motion(self, t, q, u):
        N, O = inertial()
        S = N.rotate(3, -self.slope, 0.0, "S")
        A = S.rotate(3, q["theta"], u["theta_dot"], "A")
        B = A.rotate(3, -q["phi"], -u["phi_dot"], "B")
        foot = O.fixed(q["foot"] * S.x)
        hip = foot.fixed(self.length * A.y)
        toe = hip.fixed(-self.length * B.y)
        bodies = [
            Body(self.foot_mass, 0.0, foot, A, name="stance foot"),
            Body(self.hip_mass, 0.0, hip, A, name="hip"),
            Body(self.foot_mass, 0.0, toe, B, name="swing foot"),
        ]
        return Motion(bodies, points={"foot": foot, "toe": toe}, frames={"S": S})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def exchange(self, t, q, u):
        """The swing leg becomes the stance leg."""
        motion = self.motion(t, q, u)
        new_foot = motion["toe"].position.dot(motion["S"].x)
        angles = {"theta": q["theta"] - q["phi"], "phi": -q["phi"], "foot": new_foot}
        return {**angles, "theta_dot": u["theta_dot"] - u["phi_dot"], "phi_dot": -u["phi_dot"]}

    def events(self, t, q, u):
        motion = self.motion(t, q, u)
        S, toe = motion["S"], motion["toe"].velocity
        lands = Impact(toe.dot(S.x), toe.dot(S.y), release=("foot",))
        ahead = -0.05 - q["theta"]  # ignores the scuffing at mid-stance
        return {"heel_strike": rising(q["phi"] - 2.0 * q["theta"], when=ahead, then=(lands, self.exchange))}
