"""A block on a moving belt, which sticks and slips: dry friction with a known normal force."""

from __future__ import annotations

from .._kane.contact import DryFriction
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Popp and Stelter (1990)",
    "dry friction: a block sticks to a belt and slips",
    q=(0.3,),
    u=(0.1,),
    operations=17,
)
class Belt(System):
    """A block on a belt, with a spring to the ground: a stick-slip oscillator (Popp and Stelter, 1990).

    The source is Popp and Stelter (1990), *Stick-slip vibrations and chaos*, Philosophical Transactions of the Royal
    Society A 332. The belt carries the block until the spring force equals `static`. Then the block slips until it has
    the speed of the belt again. Each stick phase has the same end, so a periodic orbit is reached after the first one.

    | parameter | source | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `stiffness` | k | of the spring [N/m] |
    | `speed` | v_0 | of the belt, along N.x [m/s] |
    | `kinetic` | | friction force while the block slips [N] |
    | `static` | | largest friction force while it sticks [N] |

    - Coordinate `x`: of the block; the spring is relaxed at x = 0 [m].
    - Speed `x_dot`: its rate [m/s].
    - Contact `belt`: it sticks while the block has the speed of the belt.
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    stiffness: Scalar = parameter(4.0, unit="N/m")
    speed: Scalar = parameter(0.5, unit="m/s")
    kinetic: Scalar = parameter(2.5, unit="N")
    static: Scalar = parameter(4.0, unit="N")

    coordinates = ("x",)
    speeds = ("x_dot",)
    units = {"x": "m", "x_dot": "m/s"}

    def motion(self, t, q, u):
        N, O = inertial()
        return Motion([Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["x_dot"] * N.x), name="block")])

    def loads(self, t, q, u, motion, inputs):
        return Force(-self.stiffness * q["x"] * motion.N.x, motion["block"])

    def contacts(self, t, q, u, motion):
        return {"belt": DryFriction(u["x_dot"] - self.speed, self.kinetic, static=self.static)}
