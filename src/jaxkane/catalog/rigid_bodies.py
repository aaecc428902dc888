"""Examples 2 and 5, Exercises 5.6 and 5.8, the rattleback: rigid bodies that are free, on a ball joint, or roll."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import Frame, Point, inertial
from .._system.motion import Body, Force, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import NamedVector, System
from ._entry import Loads, Quantity, Values, entry


class _EulerParameters(System):
    # Coordinates `e1` ... `e4` of unit norm, scalar last, with body-fixed speeds `omega1` ... `omega3`.
    dependent_coordinates = ("e4",)

    def configuration_constraints(self, t: Component, q: NamedVector) -> Sequence[Component]:
        return (q["e1"] ** 2 + q["e2"] ** 2 + q["e3"] ** 2 + q["e4"] ** 2 - 1.0,)

    def _frame(self, N: Frame, q: NamedVector, u: NamedVector, name: str) -> Frame:
        return N.rotate_euler(q["e1":"e4"], u["omega1":"omega3"], name)

    def _frame_rates(self, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return rotations.euler_parameter_rates(q["e1":"e4"], u["omega1":"omega3"])


class _FreeBody(System):
    # Body-fixed speeds. Subclasses define the orientation: `_frame` and `_frame_rates`.
    speeds = ("v1", "v2", "v3", "omega1", "omega2", "omega3")
    inputs = ("force1", "force2", "force3", "torque1", "torque2", "torque3")
    units = dict.fromkeys("xyz", "m") | dict.fromkeys(speeds[:3], "m/s") | dict.fromkeys(speeds[3:], "rad/s")
    units |= dict.fromkeys(inputs[:3], "N") | dict.fromkeys(inputs[3:], "N m")

    def _frame(self, N: Frame, q: NamedVector, u: NamedVector, name: str) -> Frame:
        raise NotImplementedError

    def _frame_rates(self, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        raise NotImplementedError

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        N, _ = inertial()
        velocity = self._frame(N, q, u, "B").vector(*u["v1":"v3"])
        return (*velocity.components_in(N), *self._frame_rates(q, u))

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        body = motion.bodies[0]
        F, T = (body.frame.vector(*(inputs[f"{name}{i}"] for i in (1, 2, 3))) for name in ("force", "torque"))
        return Force(F, motion["G"]), Torque(T, body)


@entry(
    "Example 2",
    "Euler parameters, body-fixed speeds",
    q=(0.3, -0.2, 0.5, 0.1, -0.3, 0.5, 0.65**0.5),
    u=(1.0, -0.5, 0.8, 0.6, -1.1, 0.9),
    operations=181,
)
class RigidBody(_EulerParameters, _FreeBody):
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

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, _ = inertial()
        B = self._frame(N, q, u, "B")
        G = Point.at(B.vector(*u["v1":"v3"]), N.vector(*q["x":"z"]), "G")
        body = Body(self.mass, (self.I11, self.I22, self.I33), G, B, name="body")
        return Motion([body], points={"G": G}, frames={"B": B})


_EULER = (0.1, -0.3, 0.5, 0.65**0.5)  # unit norm, scalar last
_ENGINES = {
    "engine1_speed": 400.0,
    "engine1_acceleration": 15.0,
    "engine2_speed": 380.0,
    "engine2_acceleration": -10.0,
}


class _Aircraft(_FreeBody):
    airframe_mass: Scalar = parameter(6000.0, positive=True, unit="kg")
    airframe_Ixx: Scalar = parameter(12000.0, positive=True, unit="kg m^2")
    airframe_Iyy: Scalar = parameter(30000.0, positive=True, unit="kg m^2")
    airframe_Izz: Scalar = parameter(38000.0, positive=True, unit="kg m^2")
    airframe_Ixz: Scalar = parameter(-1500.0, unit="kg m^2")
    engine_mass: Scalar = parameter(300.0, positive=True, unit="kg")
    engine_axial_inertia: Scalar = parameter(20.0, positive=True, unit="kg m^2")
    engine_transverse_inertia: Scalar = parameter(60.0, positive=True, unit="kg m^2")
    engine_x: Scalar = parameter(0.5, unit="m")
    engine_y: Scalar = parameter(2.5, unit="m")
    engine_z: Scalar = parameter(0.4, unit="m")
    engine1_speed: Scalar = parameter(400.0, unit="rad/s")
    engine1_acceleration: Scalar = parameter(0.0, unit="rad/s^2")
    engine2_speed: Scalar = parameter(400.0, unit="rad/s")
    engine2_acceleration: Scalar = parameter(0.0, unit="rad/s^2")

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        mA, mE = self.airframe_mass, self.engine_mass
        xE, yE, zE = self.engine_x, self.engine_y, self.engine_z
        N, _ = inertial()
        A = self._frame(N, q, u, "A")
        G = Point.at(A.vector(*u["v1":"v3"]), N.vector(*q["x":"z"]), "G")
        G_A = G.fixed(A.vector(-2.0 * mE * xE / mA, 0.0, -2.0 * mE * zE / mA))  # G is the mass centre of the aircraft
        G_1, G_2 = G.fixed(A.vector(xE, yE, zE)), G.fixed(A.vector(xE, -yE, zE))
        Ixz = self.airframe_Ixz
        I_A = (
            (self.airframe_Ixx, 0.0, Ixz),
            (0.0, self.airframe_Iyy, 0.0),
            (Ixz, 0.0, self.airframe_Izz),
        )
        I_E = (self.engine_axial_inertia, self.engine_transverse_inertia, self.engine_transverse_inertia)
        # The engines are axisymmetric, so their inertia is constant in the frame of the airframe although they spin.
        w_E1 = A.angular_velocity + (self.engine1_speed + self.engine1_acceleration * t) * A.x
        w_E2 = A.angular_velocity + (self.engine2_speed + self.engine2_acceleration * t) * A.x
        bodies = (
            Body(mA, I_A, G_A, A, name="airframe"),
            Body(mE, I_E, G_1, A, w_E1, name="engine1"),
            Body(mE, I_E, G_2, A, w_E2, name="engine2"),
        )
        return Motion(bodies, points={"G": G}, frames={"A": A})


@entry(
    "Example 5",
    "rotors with prescribed speeds; explicit time dependence",
    q=(100.0, -50.0, -1000.0, 0.4, 0.2, -0.3),
    u=(120.0, 4.0, 7.0, 0.3, -0.2, 0.15),
    operations=648,
    example=lambda: Aircraft(**_ENGINES),
    conservative=False,  # the motors that maintain the prescribed speeds of the engines do work
)
class Aircraft(_Aircraft):
    """An airframe with two engines that rotate at prescribed speeds; 3-2-1 angles (Kamman, Unit 5, Example 5).

    | parameter | book | meaning |
    |---|---|---|
    | `airframe_mass` | m_A | [kg] |
    | `airframe_Ixx`, `_Iyy`, `_Izz` | I^GA | moments of inertia of the airframe about its own mass centre [kg m^2] |
    | `airframe_Ixz` | -I_xz^GA | matrix entry of the airframe's inertia: minus the book's product [kg m^2] |
    | `engine_mass` | m_E | of each engine [kg] |
    | `engine_axial_inertia`, `engine_transverse_inertia` | I_xx^E, I_yy^E | of each, about A.x and across [kg m^2] |
    | `engine_x`, `engine_y`, `engine_z` | x_E, y_E, z_E | engine 1 from the aircraft's mass centre G; 2 at -y_E [m] |
    | `engine1_speed`, `engine2_speed` | omega_E1, omega_E2 | about A.x, relative to the airframe, at t = 0 [rad/s] |
    | `engine1_acceleration`, `engine2_acceleration` | their rates | constant [rad/s^2] |

    The mass centre of the airframe follows from G: x_A = -2 m_E x_E / m_A, z_A = -2 m_E z_E / m_A.

    - Coordinates `x`, `y`, `z`: G in N [m]; `psi`, `theta`, `phi`: yaw, pitch and roll of the 3-2-1 sequence [rad].
    - Speeds `v1`, `v2`, `v3` (the book's u, v, w): velocity of G along the airframe's axes [m/s]; `omega1`, `omega2`,
      `omega3`: angular velocity of the airframe along its axes [rad/s].
    - Inputs `force1`, `force2`, `force3` at G [N], `torque1`, `torque2`, `torque3` [N m]: resultants of all external
      forces, including the weight, along the airframe's axes.
    """

    coordinates = ("x", "y", "z", "psi", "theta", "phi")
    units = {**_Aircraft.units, **dict.fromkeys(coordinates[3:], "rad")}

    def _frame(self, N: Frame, q: NamedVector, u: NamedVector, name: str) -> Frame:
        return N.rotate_sequence("3-2-1", q["psi":"phi"], angular_velocity=u["omega1":"omega3"], name=name)

    def _frame_rates(self, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return rotations.angle_rates("3-2-1", q["psi":"phi"], u["omega1":"omega3"])

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"gimbal_lock": jnp.cos(q["theta"])}


@entry(
    "Example 5",
    "the same without gimbal lock",
    q=(100.0, -50.0, -1000.0, *_EULER),
    u=(120.0, 4.0, 7.0, 0.3, -0.2, 0.15),
    operations=657,
    example=lambda: AircraftEulerParameters(**_ENGINES),
    conservative=False,
)
class AircraftEulerParameters(_EulerParameters, _Aircraft):
    """`Aircraft` with Euler parameters, which have no gimbal lock (Kamman, Unit 5, Example 5, last paragraph).

    - Coordinates `x`, `y`, `z`: G in N [m]; `e1` ... `e4`: Euler parameters of the airframe, scalar last.
    """

    coordinates = ("x", "y", "z", "e1", "e2", "e3", "e4")


@entry(
    "Exercise 5.6",
    "a ball joint, Euler parameters",
    q=(0.15, -0.2, 0.35, 0.815**0.5),
    u=(0.8, -0.6, 40.0),
    operations=119,
)
class SpinningTop(_EulerParameters):
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

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return self._frame_rates(q, u)

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        T = self._frame(N, q, u, "T")
        G = O.fixed(self.distance * T.z)
        I = self.transverse_inertia
        return Motion([Body(self.mass, (I, I, self.axial_inertia), G, T, name="top")], frames={"T": T})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.z)


@entry(
    "Exercise 5.8",
    "a ball joint, body-fixed angles",
    q=(0.5, -0.4, 0.7),
    u=(0.9, -0.6, 1.2),
    operations=142,
)
class Bracket(System):
    """A cross of two identical slender bars OA and BC on a ball joint at O (Kamman, Unit 5, Exercise 5.8).

    OA is along axis 2 of the bracket, BC along axis 1. Their midpoints coincide at G. B is on the positive side of
    axis 1.

    | parameter | book | meaning |
    |---|---|---|
    | `mass` | m | of each bar [kg] |
    | `length` | L | of each bar [m] |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `theta1`, `theta2`, `theta3`: 1-2-3 angles [rad].
    - Speeds `omega1`, `omega2`, `omega3`: angular velocity along the bracket's axes [rad/s].
    - Inputs `tip_force1`, `tip_force3` (F_A1, F_A3, at A along axes 1 and 3), `arm_force` (F_B, at B along
      axis 3) [N].
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    length: Scalar = parameter(1.0, positive=True, unit="m")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("theta1", "theta2", "theta3")
    speeds = ("omega1", "omega2", "omega3")
    inputs = ("tip_force1", "tip_force3", "arm_force")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | dict.fromkeys(inputs, "N")

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        return rotations.angle_rates("1-2-3", q["theta1":"theta3"], u["omega1":"omega3"])

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        m, L = self.mass, self.length
        N, O = inertial()
        E = N.rotate_sequence("1-2-3", q["theta1":"theta3"], angular_velocity=u["omega1":"omega3"], name="E")
        G = O.fixed(0.5 * L * E.y)
        A = O.fixed(L * E.y)
        B = G.fixed(0.5 * L * E.x)
        I = m * L**2 / 12
        bracket = Body(2.0 * m, (I, I, 2.0 * I), G, E, name="bracket")
        return Motion([bracket], points={"A": A, "B": B}, frames={"E": E})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        E = motion["E"]
        return (
            weight(motion, -self.gravity * motion.N.y),
            Force(E.vector(inputs["tip_force1"], 0.0, inputs["tip_force3"]), motion["A"]),
            Force(inputs["arm_force"] * E.z, motion["B"]),
        )

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"gimbal_lock": jnp.cos(q["theta2"])}


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

    def body(self, q: NamedVector, u: NamedVector):
        """The frame of the body, the position of the contact relative to the centre, and the velocity of the centre."""
        N, O = inertial()
        B = N.rotate_sequence("3-1-2", q["yaw":"pitch"], angular_velocity=u["omega1":"omega3"], name="B")
        n1, n2, n3 = N.z.components_in(B)
        # The point of the ellipsoid with the outward normal -N.z.
        a2, b2, c2 = self.a**2, self.b**2, self.c**2
        depth = jnp.sqrt(a2 * n1**2 + b2 * n2**2 + c2 * n3**2)
        contact = -B.vector(a2 * n1 / depth, b2 * n2 / depth, c2 * n3 / depth)
        return N, O, B, depth, contact, B.angular_velocity.cross(-contact)

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        N, _, _, _, _, velocity = self.body(q, u)
        rates = rotations.angle_rates("3-1-2", q["yaw":"pitch"], u["omega1":"omega3"])
        return *rates, velocity.dot(N.x), velocity.dot(N.y)

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O, B, depth, contact, velocity = self.body(q, u)
        center = O.moving(N.vector(q["x"], q["y"], depth), velocity)
        I = ((self.I11, self.I12, 0.0), (self.I12, self.I22, 0.0), (0.0, 0.0, self.I33))
        stone = Body(self.mass, I, center.fixed(-self.offset * B.z), B, name="stone")
        return Motion([stone], points={"center": center, "contact": center.fixed(contact, B)}, frames={"B": B})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.z)

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"gimbal_lock": jnp.cos(q["roll"])}
