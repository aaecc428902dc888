"""The rattleback: an ellipsoid that rolls and reverses its spin."""

from __future__ import annotations

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Kane and Levinson (1982)",
    "rolling of an ellipsoid, a spin that reverses",
    q=(0.4, 0.01, -0.01, 0.1, -0.2),
    u=(0.1, -0.05, -1.5),
    operations=359,
)
class Rattleback(System):
    """An ellipsoid that rolls without slip on a level plane (Kane and Levinson, 1982).

    A principal axis of inertia is not parallel to the long axis of the ellipsoid, so spin about the vertical is
    unstable. At -5 rad/s oscillations grow by 2.1 per second, and the spin reverses. At 5 rad/s they grow by 0.2 per
    second. The source is Kane and Levinson (1982), *Realistic mathematical modeling of the rattleback*, International
    Journal of Non-Linear Mechanics 17(3). In the axes of the body the surface is (x/a)^2 + (y/b)^2 + (z/c)^2 = 1. The
    mass centre is below the centre of the ellipsoid.

    | parameter | source | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `a`, `b`, `c` | a, b, c | semi-axes of the ellipsoid [m] |
    | `offset` | h | from the centre of the ellipsoid to the mass centre, along -B.z [m] |
    | `I11`, `I22`, `I33`, `I12` | A, B, C, D | about the mass centre; `I12` is the matrix entry [kg m^2] |
    | `gravity` | g | along -N.z [m/s^2] |

    - Coordinates `yaw`, `roll`, `pitch`: 3-1-2 angles of the body [rad]; `x`, `y`: position of the centre of the
      ellipsoid [m]. The source has 1-2-3 angles. With the yaw angle first, spin about the vertical is a steady motion.
    - Speeds `omega1`, `omega2`, `omega3`: angular velocity along the axes of the body [rad/s]. The velocity of every
      point follows from them, so the constraints of rolling need no dependent speeds.
    - Frame "B" in `motion`: the axes of the body. Points: "center" of the ellipsoid and "contact".
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    a: Scalar = parameter(0.2, positive=True, unit="m")
    b: Scalar = parameter(0.03, positive=True, unit="m")
    c: Scalar = parameter(0.02, positive=True, unit="m")
    offset: Scalar = parameter(0.01, unit="m")
    I11: Scalar = parameter(0.0002, positive=True, unit="kg m^2")
    I22: Scalar = parameter(0.0016, positive=True, unit="kg m^2")
    I33: Scalar = parameter(0.0017, positive=True, unit="kg m^2")
    I12: Scalar = parameter(-0.00002, unit="kg m^2")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("yaw", "roll", "pitch", "x", "y")
    speeds = ("omega1", "omega2", "omega3")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys("xy", "m") | dict.fromkeys(speeds, "rad/s")

    def body(self, q, u):
        """The frame of the body, the position of the contact relative to the centre, and the velocity of the centre."""
        N, O = inertial()
        B = N.rotate_sequence("3-1-2", q["yaw":"pitch"], angular_velocity=u["omega1":"omega3"], name="B")
        n1, n2, n3 = N.z.components_in(B)
        # The point of the ellipsoid with the outward normal -N.z.
        a2, b2, c2 = self.a**2, self.b**2, self.c**2
        depth = jnp.sqrt(a2 * n1**2 + b2 * n2**2 + c2 * n3**2)
        contact = -B.vector(a2 * n1 / depth, b2 * n2 / depth, c2 * n3 / depth)
        return N, O, B, depth, contact, B.angular_velocity.cross(-contact)

    def q_dot(self, t, q, u):
        N, _, _, _, _, velocity = self.body(q, u)
        rates = rotations.angle_rates("3-1-2", q["yaw":"pitch"], u["omega1":"omega3"])
        return *rates, velocity.dot(N.x), velocity.dot(N.y)

    def motion(self, t, q, u):
        N, O, B, depth, contact, velocity = self.body(q, u)
        center = O.moving(N.vector(q["x"], q["y"], depth), velocity)
        I = ((self.I11, self.I12, 0.0), (self.I12, self.I22, 0.0), (0.0, 0.0, self.I33))
        stone = Body(self.mass, I, center.fixed(-self.offset * B.z), B, name="stone")
        return Motion([stone], points={"center": center, "contact": center.fixed(contact, B)}, frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.z)

    def events(self, t, q, u):
        return {"gimbal_lock": jnp.cos(q["roll"])}
