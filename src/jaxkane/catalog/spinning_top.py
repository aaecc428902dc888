"""Exercise 5.6: the spinning top, oriented by Euler parameters."""

from __future__ import annotations

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.6",
    "a ball joint, Euler parameters",
    q=(0.15, -0.2, 0.35, 0.815**0.5),
    u=(0.8, -0.6, 40.0),
    operations=119,
)
class SpinningTop(System):
    """A symmetric top on a ball joint at O, with body-fixed speeds (Kamman, Unit 5, Exercise 5.6).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `distance` | L | from O to the mass centre, along the axis of symmetry [m] |
    | `transverse_inertia` | I | about the mass centre, across the axis [kg m^2] |
    | `axial_inertia` | I3 | about the axis [kg m^2] |
    | `gravity` | g | along -N.z [m/s^2] |

    - Coordinates `e1` ... `e4`: Euler parameters of the top, scalar last, of unit norm.
    - Speeds `omega1`, `omega2`, `omega3`: angular velocity along the top's axes, the third its axis [rad/s].
    """

    mass: Scalar = parameter(0.5, positive=True, unit="kg")
    distance: Scalar = parameter(0.1, positive=True, unit="m")
    transverse_inertia: Scalar = parameter(0.001, positive=True, unit="kg m^2")
    axial_inertia: Scalar = parameter(0.0008, positive=True, unit="kg m^2")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("e1", "e2", "e3", "e4")
    speeds = ("omega1", "omega2", "omega3")
    units = dict.fromkeys(speeds, "rad/s")
    dependent_coordinates = ("e4",)

    def q_dot(self, t, q, u):
        return rotations.euler_parameter_rates(q["e1":"e4"], u["omega1":"omega3"])

    def configuration_constraints(self, t, q):
        return (q["e1"] ** 2 + q["e2"] ** 2 + q["e3"] ** 2 + q["e4"] ** 2 - 1.0,)

    def motion(self, t, q, u):
        N, O = inertial()
        T = N.rotate_euler(q["e1":"e4"], u["omega1":"omega3"], "T")
        G = O.fixed(self.distance * T.z)
        I = self.transverse_inertia
        return Motion([Body(self.mass, (I, I, self.axial_inertia), G, T, name="top")], frames={"T": T})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.z)
