"""Exercise 5.2: a sliding mass with a pinned bar."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.2",
    "spring, damper, driving force",
    q=(0.2, 0.7),
    u=(0.4, -1.2),
    operations=101,
    conservative=False,
)
class SliderWithPinnedBar(System):
    """A mass on a horizontal rail with a spring, a damper and a driving force, and a slender bar pinned to the mass.

    See Kamman, Unit 5, Exercise 5.2.

    | parameter | book | meaning |
    |---|---|---|
    | `slider_mass` | m1 | [kg] |
    | `bar_mass` | m2 | [kg] |
    | `length` | l | of the bar [m] |
    | `stiffness`, `damping` | k, c | of spring [N/m] and damper [N s/m] at the slider; unstretched at x = 0 |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`: position of the slider along N.x [m]; `theta`: angle of the bar from the downward vertical,
      about N.z [rad].
    - Speeds: their rates [m/s, rad/s].
    - Input `force` (F): on the slider along N.x [N].
    """

    slider_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    bar_mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    stiffness: Scalar = parameter(50.0, unit="N/m")
    damping: Scalar = parameter(1.0, unit="N s/m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "theta")
    speeds = ("x_dot", "theta_dot")
    inputs = ("force",)
    units = {"x": "m", "theta": "rad", "force": "N"}

    def motion(self, t, q, u):
        l, m2 = self.length, self.bar_mass
        N, O = inertial()
        A = O.moving(q["x"] * N.x, u["x_dot"] * N.x, name="A")
        L = N.rotate(3, q["theta"], u["theta_dot"], "L")
        G = A.fixed(-0.5 * l * L.y)
        I = m2 * l**2 / 12
        slider = Body(self.slider_mass, 0.0, A, N, name="slider")
        bar = Body(m2, (I, 0.0, I), G, L, name="bar")
        return Motion((slider, bar), points={"A": A})

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        F = inputs["force"] - self.stiffness * q["x"] - self.damping * u["x_dot"]
        return weight(motion, -self.gravity * N.y), Force(F * N.x, motion["slider"])
