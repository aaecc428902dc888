"""A wheel without a rim that walks down a slope on its spokes: an event for each step."""

from __future__ import annotations

import jax.numpy as jnp

from .._integrate.events import falling
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


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

    def q_dot(self, t, q, u):
        return u["rate"], 0.0

    def motion(self, t, q, u):
        N, O = inertial()
        S = N.rotate(3, -self.slope, 0.0, "S")
        W = N.rotate(3, -q["angle"], -u["rate"], "W")
        foot = O.fixed(q["foot"] * S.x)
        hub = foot.fixed(self.length * W.y)
        next_spoke = W.rotate(3, 2.0 * self.half_angle, 0.0)
        toe = hub.fixed(-self.length * next_spoke.y)
        wheel = Body(self.mass, (0.0, 0.0, self.inertia), hub, W, name="wheel")
        return Motion([wheel], points={"foot": foot, "hub": hub, "toe": toe}, frames={"S": S})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def events(self, t, q, u):
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
