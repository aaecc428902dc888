"""A motor that drives a load with play: two contacts without friction, defined by gaps."""

from __future__ import annotations

from .._kane.contact import Contact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Nordin and Gutman (2002)",
    "contacts defined by gaps: a coupling with play",
    q=(0.03, -0.02),
    u=(1.5, 0.5),
    operations=21,
)
class Backlash(System):
    """A motor and a load, which a coupling with play connects (Nordin and Gutman, 2002).

    The source is Nordin and Gutman (2002), *Controlling mechanical systems with backlash: a survey*, Automatica 38(10).
    There the shaft is elastic. Here the coupling is rigid, so its sides meet in impacts. After an impact with
    `restitution` 0, motor and load move together until the contact force is zero.

    | parameter | source | meaning |
    |---|---|---|
    | `motor_inertia` | J_m | about N.z [kg m^2] |
    | `load_inertia` | J_l | about N.z [kg m^2] |
    | `play` | 2 alpha | of the coupling [rad] |
    | `restitution` | | coefficient of restitution of both sides (no unit) |

    - Coordinates `motor`, `load`: angles about N.z [rad]. The coupling is centred if they are equal.
    - Speeds `motor_rate`, `load_rate`: their rates [rad/s].
    - Input `torque`: on the motor [N m].
    - Contacts `drive`, `coast`: the motor pushes the load forwards, and backwards.
    """

    motor_inertia: Scalar = parameter(1e-3, positive=True, unit="kg m^2")
    load_inertia: Scalar = parameter(5e-3, positive=True, unit="kg m^2")
    play: Scalar = parameter(0.2, unit="rad")
    restitution: Scalar = parameter(0.3, within=(0.0, 1.0), unit="1")

    coordinates = ("motor", "load")
    speeds = ("motor_rate", "load_rate")
    inputs = ("torque",)
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | {"torque": "N m"}

    def motion(self, t, q, u):
        N, O = inertial()
        M = N.rotate(3, q["motor"], u["motor_rate"], "M")
        L = N.rotate(3, q["load"], u["load_rate"], "L")
        motor = Body(0.0, (0.0, 0.0, self.motor_inertia), O, M, name="motor")
        return Motion([motor, Body(0.0, (0.0, 0.0, self.load_inertia), O, L, name="load")])

    def loads(self, t, q, u, motion, inputs):
        return Torque(inputs["torque"] * motion.N.z, motion["motor"])

    def contacts(self, t, q, u, motion):
        lead = q["motor"] - q["load"]
        return {
            "drive": Contact(gap=0.5 * self.play - lead, restitution=self.restitution),
            "coast": Contact(gap=0.5 * self.play + lead, restitution=self.restitution),
        }
