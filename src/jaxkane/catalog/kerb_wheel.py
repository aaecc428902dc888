"""A wheel that rolls off a kerb: contacts with a surface and its edge, and with the road below."""

from __future__ import annotations

import jax.numpy as jnp

from .._kane.contact import Contact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Irodov (1981)",
    "a contact with an edge: a wheel drops from a kerb",
    q=(-0.3, 0.45, 0.1),
    u=(1.2, -0.2, 2.0),
    operations=29,
)
class KerbWheel(System):
    """A wheel in a vertical plane that rolls off a kerb onto a road.

    The contact with the edge is that of the rolling cylinder in Irodov (1981), *Problems in General Physics*, chapter
    1.5: the cylinder rolls over an edge, and leaves it if it is too fast. The point of the wheel that touches changes
    continuously, so its gap is passed to `Contact` together with this point.

    | parameter | source | meaning |
    |---|---|---|
    | `radius` | R | of the wheel [m] |
    | `kerb` | | height of the kerb above the road [m] |
    | `mass` | m | [kg] |
    | `inertia` | | about the axle [kg m^2]; the default is that of a uniform disc |
    | `friction` | | coefficient of friction of kerb and road (no unit) |
    | `restitution` | | coefficient of restitution of kerb and road (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`, `y`: of the axle [m], with the road at y = 0 and the edge at x = 0, y = `kerb`; `angle` of the
      wheel, positive if it rolls along N.x [rad].
    - Speeds `x_dot`, `y_dot`, `spin`: their rates [m/s, rad/s].
    - Contacts `kerb`: its surface and its edge; `road`.
    """

    radius: Scalar = parameter(0.35, positive=True, unit="m")
    kerb: Scalar = parameter(0.08, unit="m")
    mass: Scalar = parameter(2.0, positive=True, unit="kg")
    inertia: Scalar = parameter(0.1225, positive=True, unit="kg m^2")
    friction: Scalar = parameter(0.8, unit="1")
    restitution: Scalar = parameter(0.0, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "y", "angle")
    speeds = ("x_dot", "y_dot", "spin")
    units = {"x": "m", "y": "m", "angle": "rad", "x_dot": "m/s", "y_dot": "m/s", "spin": "rad/s"}

    def motion(self, t, q, u):
        N, O = inertial()
        W = N.rotate(3, -q["angle"], -u["spin"], "W")
        axle = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        return Motion([Body(self.mass, (0.0, 0.0, self.inertia), axle, W, name="wheel")])

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t, q, u, motion):
        N, wheel = motion.N, motion["wheel"]
        # From the nearest point of the kerb to the axle
        x, y = jnp.maximum(q["x"], 0.0), q["y"] - self.kerb
        distance = jnp.sqrt(x**2 + y**2)
        away = (x / distance) * N.x + (y / distance) * N.y
        touching = wheel.center.fixed(-self.radius * away, wheel.frame)
        bottom = wheel.center.fixed(-self.radius * N.y, wheel.frame)
        laws = {"restitution": self.restitution, "friction": self.friction}
        return {
            "kerb": Contact(touching, away, gap=distance - self.radius, **laws),
            "road": Contact(bottom, N.y, **laws),
        }
