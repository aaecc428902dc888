"""Passive walkers on a slope: each step is an event with an impact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import jax.numpy as jnp

from .._integrate.events import falling, rising
from .._kane.contact.impulses import Impact
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import NamedVector, System
from ._entry import Loads, Quantity, Values, entry


@entry(
    "McGeer (1990)",
    "an impact by a formula: the next spoke carries the wheel",
    q=(-0.32, 0.0),
    u=(1.3,),
    operations=69,
)
class RimlessWheel(System):
    """A wheel that consists of a hub and spokes, on a slope (McGeer, 1990).

    The wheel rotates about the foot of one spoke until the next spoke lands without bouncing or sliding. The source is
    McGeer (1990), *Passive dynamic walking*, International Journal of Robotics Research 9(2). With the default inertia
    the mass is at the hub.

    | parameter | source | meaning |
    |---|---|---|
    | `half_angle` | alpha_0 | half the angle between two spokes [rad] |
    | `slope` | gamma | of the ground [rad] |
    | `mass` | m | [kg] |
    | `inertia` | m r_gyr^2 | about the hub [kg m^2] |
    | `length` | l | of a spoke [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `angle`: of the spoke on the ground from the vertical, positive downhill [rad]; `foot`: distance of
      its foot from the origin, down the slope [m], constant between steps.
    - Speed `rate`: of `angle` [rad/s].
    - Event `step`: the next spoke lands.
    - Frame "S" in `motion`: x down the slope, y normal to it. Points: "foot", "hub", and "toe", which is the foot of
      the next spoke.
    """

    half_angle: Scalar = parameter(0.4, within=(0.0, 1.57), unit="rad")
    slope: Scalar = parameter(0.08, unit="rad")
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    inertia: Scalar = parameter(0.0, unit="kg m^2")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("angle", "foot")
    speeds = ("rate",)
    units = {"angle": "rad", "foot": "m", "rate": "rad/s"}

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return u["rate"], 0.0

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        S = N.rotate(3, -self.slope, 0.0, "S")
        W = N.rotate(3, -q["angle"], -u["rate"], "W")
        foot = O.fixed(q["foot"] * S.x)
        hub = foot.fixed(self.length * W.y)
        next_spoke = W.rotate(3, 2.0 * self.half_angle, 0.0)
        toe = hub.fixed(-self.length * next_spoke.y)
        wheel = Body(self.mass, (0.0, 0.0, self.inertia), hub, W, name="wheel")
        return Motion([wheel], points={"foot": foot, "hub": hub, "toe": toe}, frames={"S": S})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        # The angular momentum about the next foot does not change when it lands.
        I, ml2 = self.inertia, self.mass * self.length**2
        ratio = (I + ml2 * jnp.cos(2.0 * self.half_angle)) / (I + ml2)
        motion = self.motion(t, q, u)
        next_foot = {
            "angle": q["angle"] - 2.0 * self.half_angle,
            "foot": motion["toe"].position.dot(motion["S"].x),
            "rate": ratio * u["rate"],
        }
        return {"step": falling(self.slope + self.half_angle - q["angle"], then=next_foot)}


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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return u["stance_rate"], u["swing_rate"], 0.0

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def exchange(self, t: Component, q: NamedVector, u: NamedVector) -> Values:
        """The swing leg becomes the stance leg."""
        motion = self.motion(t, q, u)
        new_foot = motion["toe"].position.dot(motion["S"].x)
        angles = {"stance": q["swing"], "swing": q["stance"], "foot": new_foot}
        return {**angles, "stance_rate": u["swing_rate"], "swing_rate": u["stance_rate"]}

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        motion = self.motion(t, q, u)
        S, toe = motion["S"], motion["toe"].velocity
        lands = Impact(toe.dot(S.x), toe.dot(S.y), release=("foot",))
        # Not the height of the toe: it is also zero while the legs pass each other.
        height = 2.0 * self.slope - q["stance"] - q["swing"]
        ahead = q["stance"] - q["swing"]
        return {"heel_strike": falling(height, when=ahead, then=(lands, self.exchange))}


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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return u["theta_dot"], u["phi_dot"], 0.0

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def exchange(self, t: Component, q: NamedVector, u: NamedVector) -> Values:
        """The swing leg becomes the stance leg."""
        motion = self.motion(t, q, u)
        new_foot = motion["toe"].position.dot(motion["S"].x)
        angles = {"theta": q["theta"] - q["phi"], "phi": -q["phi"], "foot": new_foot}
        return {**angles, "theta_dot": u["theta_dot"] - u["phi_dot"], "phi_dot": -u["phi_dot"]}

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        motion = self.motion(t, q, u)
        S, toe = motion["S"], motion["toe"].velocity
        lands = Impact(toe.dot(S.x), toe.dot(S.y), release=("foot",))
        ahead = -0.05 - q["theta"]  # ignores the scuffing at mid-stance
        return {"heel_strike": rising(q["phi"] - 2.0 * q["theta"], when=ahead, then=(lands, self.exchange))}
