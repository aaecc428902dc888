"""Example 2: the free rigid body, oriented by Euler parameters."""

from __future__ import annotations

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import Point, inertial
from .._system.motion import Body, Force, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Example 2",
    "Euler parameters, body-fixed speeds",
    q=(0.3, -0.2, 0.5, 0.1, -0.3, 0.5, 0.65**0.5),
    u=(1.0, -0.5, 0.8, 0.6, -1.1, 0.9),
    operations=181,
)
class RigidBody(System):
    """A free rigid body with body-fixed speeds and Euler parameters (Kamman, Unit 5, Example 2).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `I11`, `I22`, `I33` | I11, I22, I33 | principal moments of inertia about the mass centre G [kg m^2] |

    - Coordinates `x`, `y`, `z`: G in N [m]; `e1` ... `e4`: Euler parameters of the body, scalar last, of unit norm.
    - Speeds `v1`, `v2`, `v3` (the book's u, v, w): velocity of G along the body's axes [m/s]; `omega1`, `omega2`,
      `omega3`: angular velocity along the body's axes [rad/s].
    - Inputs `force1`, `force2`, `force3` at G [N], `torque1`, `torque2`, `torque3` [N m]: along the body's axes.
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    I11: Scalar = parameter(1.0, positive=True, unit="kg m^2")
    I22: Scalar = parameter(2.0, positive=True, unit="kg m^2")
    I33: Scalar = parameter(2.5, positive=True, unit="kg m^2")

    coordinates = ("x", "y", "z", "e1", "e2", "e3", "e4")
    speeds = ("v1", "v2", "v3", "omega1", "omega2", "omega3")
    dependent_coordinates = ("e4",)
    inputs = ("force1", "force2", "force3", "torque1", "torque2", "torque3")
    units = dict.fromkeys(coordinates[:3], "m") | dict.fromkeys(speeds[:3], "m/s") | dict.fromkeys(speeds[3:], "rad/s")
    units |= dict.fromkeys(inputs[:3], "N") | dict.fromkeys(inputs[3:], "N m")

    def q_dot(self, t, q, u):
        G = self.motion(t, q, u)["body"].center
        return (
            *G.velocity.components_in(G.velocity.frame.root),
            *rotations.euler_parameter_rates(q["e1":"e4"], u["omega1":"omega3"]),
        )

    def configuration_constraints(self, t, q):
        return (q["e1"] ** 2 + q["e2"] ** 2 + q["e3"] ** 2 + q["e4"] ** 2 - 1.0,)

    def motion(self, t, q, u):
        N, _ = inertial()
        B = N.rotate_euler(q["e1":"e4"], u["omega1":"omega3"], "B")
        G = Point.at(B.vector(*u["v1":"v3"]), N.vector(*q["x":"z"]), "G")
        return Motion([Body(self.mass, (self.I11, self.I22, self.I33), G, B, name="body")], frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        body, B = motion["body"], motion["B"]
        F = B.vector(inputs["force1"], inputs["force2"], inputs["force3"])
        T = B.vector(inputs["torque1"], inputs["torque2"], inputs["torque3"])
        return Force(F, body), Torque(T, body)
