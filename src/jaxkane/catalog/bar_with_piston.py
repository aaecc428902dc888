"""Exercise 5.1: a bar between a piston and a slider."""

from __future__ import annotations

import jax.numpy as jnp

from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Force, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Exercise 5.1",
    "a mechanism with one degree of freedom, spring and damper",
    q=(0.6,),
    u=(-0.9,),
    operations=121,
    conservative=False,  # a damper
)
class BarWithPiston(System):
    """A bar between a vertical piston at its upper end A and a light horizontal slider at its lower end B.

    A spring and a damper act on the slider (Kamman, Unit 5, Exercise 5.1).

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | of the bar [kg] |
    | `length` | l | of the bar [m] |
    | `piston_mass` | m_p | [kg] |
    | `stiffness`, `damping` | k, c | of the spring [N/m] and the damper [N s/m] at B; unstretched at x_B = 0 |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinate `theta`: angle of the bar from the vertical; x_B = l sin(theta), y_A = l cos(theta) [rad].
    - Speed: its rate [rad/s].
    - Input `force` (F): downward on the piston [N].
    - Auxiliary speeds `piston_guide` (A along N.x) and `slider_guide` (B along N.y) [m/s]: their forces act
      from the walls on piston and slider [N] (`constraint_forces`).
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(0.5, positive=True, unit="m")
    piston_mass: Scalar = parameter(2.0, positive=True, unit="kg")
    stiffness: Scalar = parameter(200.0, unit="N/m")
    damping: Scalar = parameter(5.0, unit="N s/m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta",)
    speeds = ("theta_dot",)
    auxiliary_speeds = ("piston_guide", "slider_guide")
    inputs = ("force",)
    units = {"theta": "rad", "force": "N", **dict.fromkeys(auxiliary_speeds, "m/s")}

    def motion(self, t, q, u):
        m, l = self.mass, self.length
        theta, theta_dot = q["theta"], u["theta_dot"]
        N, O = inertial()
        L = N.rotate(3, theta, theta_dot, "L")
        v_A = N.vector(u["piston_guide"], u["slider_guide"], 0.0) - l * jnp.sin(theta) * theta_dot * N.y
        A = O.moving(l * jnp.cos(theta) * N.y, v_A, name="A")
        B = A.fixed(-l * L.y)  # from A the bar runs along -L.y
        G = A.fixed(-0.5 * l * L.y)
        I = m * l**2 / 12
        bar = Body(m, (I, 0.0, I), G, L, name="bar")
        piston = Body(self.piston_mass, 0.0, A, N, name="piston")
        return Motion((bar, piston), points={"B": B})

    def loads(self, t, q, u, motion, inputs):
        N, B = motion.N, motion["B"]
        x, x_dot = B.position.dot(N.x), B.velocity.dot(N.x)
        return (
            weight(motion, -self.gravity * N.y),
            Force(-inputs["force"] * N.y, motion["piston"]),
            Force(-(self.stiffness * x + self.damping * x_dot) * N.x, B),
        )
