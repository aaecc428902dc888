"""A block that rocks on its two lower corners: contacts with friction, without restitution."""

from __future__ import annotations

from .._kane.contact import Contact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Housner (1963)",
    "two contacts with friction: a block rocks on its corners",
    q=(0.04, 0.65, 0.25),
    u=(0.02, 0.1, -0.3),
    operations=31,
)
class RockingBlock(System):
    """A uniform rectangular block on level ground, which rocks, slides and lifts off (Housner, 1963).

    The source is Housner (1963), *The behavior of inverted pendulum structures during earthquakes*, Bulletin of the
    Seismological Society of America 53(2). A slender block with sufficient friction rotates about one corner until
    the other corner lands. With `restitution` 0, each landing multiplies the rate by 1 - 3/2 sin^2 alpha, where
    tan(alpha) = b / h. A start at rest on one corner:

        jk.assemble(block, {"angle": 0.25}, touching=("left",))

    | parameter | source | meaning |
    |---|---|---|
    | `half_width` | b | half the width [m] |
    | `half_height` | h | half the height [m] |
    | `mass` | W / g | [kg] |
    | `friction` | | coefficient of friction of both corners (no unit) |
    | `restitution` | | coefficient of restitution of both corners (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`, `y`: of the mass centre [m]; `angle`: about N.z, positive if the block rotates about its left
      corner [rad].
    - Speeds `x_dot`, `y_dot`, `rate`: their rates [m/s, rad/s].
    - Contacts `left`, `right`: the lower corners on the ground y = 0. Points of `motion` have the same names.
    """

    half_width: Scalar = parameter(0.2, positive=True, unit="m")
    half_height: Scalar = parameter(0.6, positive=True, unit="m")
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    friction: Scalar = parameter(0.8, unit="1")
    restitution: Scalar = parameter(0.0, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "y", "angle")
    speeds = ("x_dot", "y_dot", "rate")
    units = {"x": "m", "y": "m", "angle": "rad", "x_dot": "m/s", "y_dot": "m/s", "rate": "rad/s"}

    def motion(self, t, q, u):
        N, O = inertial()
        b, h = self.half_width, self.half_height
        B = N.rotate(3, q["angle"], u["rate"], "B")
        G = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        I = self.mass * (b**2 + h**2) / 3.0
        corners = {"left": G.fixed(-b * B.x - h * B.y), "right": G.fixed(b * B.x - h * B.y)}
        return Motion([Body(self.mass, (0.0, 0.0, I), G, B, name="block")], points=corners)

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t, q, u, motion):
        laws = {"restitution": self.restitution, "friction": self.friction}
        return {name: Contact(motion[name], motion.N.y, **laws) for name in ("left", "right")}
