"""Example 5: an aircraft whose two engines rotate at prescribed speeds; with angles or Euler parameters."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from .. import rotations
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import Frame, Point, inertial
from .._system.motion import Body, Force, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry

_EULER = (0.1, -0.3, 0.5, 0.65**0.5)  # unit norm, scalar last
_ENGINES = {
    "engine1_speed": 400.0,
    "engine1_acceleration": 15.0,
    "engine2_speed": 380.0,
    "engine2_acceleration": -10.0,
}


class _Aircraft(System):
    # The two subclasses below define the orientation of the airframe: `_airframe` and `_orientation_rates`.
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

    speeds = ("v1", "v2", "v3", "omega1", "omega2", "omega3")
    inputs = ("force1", "force2", "force3", "torque1", "torque2", "torque3")
    units = {
        **dict.fromkeys(speeds[:3], "m/s"),
        **dict.fromkeys(speeds[3:], "rad/s"),
        **dict.fromkeys(inputs[:3], "N"),
        **dict.fromkeys(inputs[3:], "N m"),
    }

    def _airframe(self, N: Frame, q, u) -> Frame:
        raise NotImplementedError

    def _orientation_rates(self, q, u) -> Sequence[Component]:
        raise NotImplementedError

    def q_dot(self, t, q, u):
        N, _ = inertial()
        velocity = self._airframe(N, q, u).vector(*u["v1":"v3"])
        return (*velocity.components_in(N), *self._orientation_rates(q, u))

    def motion(self, t, q, u):
        mA, mE = self.airframe_mass, self.engine_mass
        xE, yE, zE = self.engine_x, self.engine_y, self.engine_z
        N, _ = inertial()
        A = self._airframe(N, q, u)
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

    def loads(self, t, q, u, motion, inputs):
        A = motion["A"]
        F = A.vector(inputs["force1"], inputs["force2"], inputs["force3"])
        T = A.vector(inputs["torque1"], inputs["torque2"], inputs["torque3"])
        return Force(F, motion["G"]), Torque(T, motion["airframe"])


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
    units = {**_Aircraft.units, **dict.fromkeys(coordinates[:3], "m")} | dict.fromkeys(coordinates[3:], "rad")

    def _airframe(self, N, q, u):
        return N.rotate_sequence("3-2-1", q["psi":"phi"], angular_velocity=u["omega1":"omega3"], name="A")

    def _orientation_rates(self, q, u):
        return rotations.angle_rates("3-2-1", q["psi":"phi"], u["omega1":"omega3"])

    def events(self, t, q, u):
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
class AircraftEulerParameters(_Aircraft):
    """`Aircraft` with Euler parameters, which have no gimbal lock (Kamman, Unit 5, Example 5, last paragraph).

    - Coordinates `x`, `y`, `z`: G in N [m]; `e1` ... `e4`: Euler parameters of the airframe, scalar last.
    """

    coordinates = ("x", "y", "z", "e1", "e2", "e3", "e4")
    dependent_coordinates = ("e4",)
    units = {**_Aircraft.units, **dict.fromkeys(coordinates[:3], "m")}

    def configuration_constraints(self, t, q):
        return (q["e1"] ** 2 + q["e2"] ** 2 + q["e3"] ** 2 + q["e4"] ** 2 - 1.0,)

    def _airframe(self, N, q, u):
        return N.rotate_euler(q["e1":"e4"], u["omega1":"omega3"], "A")

    def _orientation_rates(self, q, u):
        return rotations.euler_parameter_rates(q["e1":"e4"], u["omega1":"omega3"])
