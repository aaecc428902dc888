"""A ball that falls through air and bounces on the ground: an event that changes the state."""

from __future__ import annotations

import jax.numpy as jnp

from .._integrate.events import falling
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Timmerman and van der Weele (1999)",
    "an event that changes the state: a ball bounces",
    q=(1.0,),
    u=(-0.5,),
    operations=23,
    conservative=False,  # drag
)
class BouncingBall(System):
    """A ball that falls with quadratic drag and bounces on level ground.

    The drag is that of Timmerman and van der Weele (1999), *On the rise and fall of a ball with linear or quadratic
    drag*, American Journal of Physics 67(6). Each bounce multiplies the speed by `restitution` (Newton). The bounces
    accumulate at a finite time, so a long simulation ends after `max_jumps`.

    | parameter | source | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `drag` | k | the force of the air is k v^2 [kg/m] |
    | `restitution` | e | coefficient of restitution of the ground (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinate `height`: of the lowest point of the ball above the ground [m].
    - Speed `climb`: its rate [m/s].
    - Event `bounce`: the ball reaches the ground.
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    drag: Scalar = parameter(0.1, unit="kg/m")
    restitution: Scalar = parameter(0.8, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("height",)
    speeds = ("climb",)
    units = dict.fromkeys(coordinates, "m")

    def motion(self, t, q, u):
        N, O = inertial()
        P = O.moving(q["height"] * N.y, u["climb"] * N.y)
        return Motion([Body(self.mass, 0.0, P, name="ball")])

    def loads(self, t, q, u, motion, inputs):
        v = u["climb"]
        resistance = -self.drag * v * jnp.abs(v) * motion.N.y
        return weight(motion, -self.gravity * motion.N.y), Force(resistance, motion["ball"])

    def events(self, t, q, u):
        return {"bounce": falling(q["height"], then={"climb": -self.restitution * u["climb"]})}
