"""Steering by wire: a handlebar apart from the fork, and the law that couples them. Knows two joints on one axis."""

from __future__ import annotations

import equinox as eqx

from .._description.bodies import Body
from .._description.loads import Torque
from .._description.parameters import parameter
from .._scalars.types import Scalar
from ..catalog.bicycle import ABOVE_GROUND, FAR
from ._part import Part


class SteerByWire(Part):
    """A handlebar that turns about the steer axis apart from the fork, and motors that couple them.

        torque on the fork = stiffness * (ratio * handlebar - steer) + damping * (ratio * handlebar_rate - steer_rate)
        torque on the handlebar = handlebar_torque - feedback * ratio * torque on the fork

    each with its reaction on the frame. The coordinate "handlebar" [rad] is the handlebar's angle, "handlebar_torque"
    [N m] what the rider does to it. The bicycle's mH, xH, zH and IH.. are then those of the fork alone, S in the
    files of BicycleParameters, and the handlebar's are given here, G in those files.

    **Arguments:**

    - `mass` [kg]; `x`, `z` [m] of the mass centre, of the upright bicycle and from the rear contact; `Ixx`, `Iyy`,
        `Izz`, `Ixz` [kg m^2] in the axes of the frame: of the handlebar.
    - `stiffness` [N m/rad], `damping` [N m s/rad] of the coupling; `ratio`: the fork's angle over the handlebar's;
        `feedback`: the share of the fork's torque that the rider feels, 1 for a coupling that takes and gives no work
        but by its damping.
    - `command`: the input that has the torque on the fork, "steer_command" where it goes through a `SteeringMotor`:
        `steering=(SteerByWire(..., command="steer_command"), SteeringMotor(...))`.
    """

    mass: Scalar = parameter(positive=True, unit="kg")
    x: Scalar = parameter(within=(-FAR, FAR), unit="m")
    z: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    Ixx: Scalar = parameter(positive=True, unit="kg m^2")
    Iyy: Scalar = parameter(positive=True, unit="kg m^2")
    Izz: Scalar = parameter(positive=True, unit="kg m^2")
    stiffness: Scalar = parameter(positive=True, unit="N m/rad")
    Ixz: Scalar = parameter(0.0, unit="kg m^2")
    damping: Scalar = parameter(0.0, unit="N m s/rad")
    ratio: Scalar = parameter(1.0)
    feedback: Scalar = parameter(1.0)
    command: str = eqx.field(static=True, default="steer_torque")

    coordinates = ("handlebar",)
    speeds = ("handlebar_rate",)
    inputs = ("handlebar_torque",)
    units = {"handlebar": "rad", "handlebar_rate": "rad/s", "handlebar_torque": "N m"}

    def motion(self, bicycle, motion, t, q, u):
        turned = motion["C"].parent.rotate(3, q["handlebar"], u["handlebar_rate"], "handlebar")
        G = turned.rotate(2, -bicycle.lam, 0.0, "grips")  # aligned with the rear frame at a zero angle
        x, z = bicycle.steer_point
        center = motion["S"].fixed(((self.x - x) * G.x + (self.z - z) * G.z).express(turned))
        inertia = ((self.Ixx, 0.0, self.Ixz), (0.0, self.Iyy, 0.0), (self.Ixz, 0.0, self.Izz))
        bar = Body(self.mass, inertia, center, G, name="handlebar")
        return motion.extended([bar], frames={"grips": G})

    def _torque(self, q, u):
        apart, sliding = self.ratio * q["handlebar"] - q["steer"], self.ratio * u["handlebar_rate"] - u["steer_rate"]
        return self.stiffness * apart + self.damping * sliding

    def commands(self, bicycle, t, q, u, motion, values):
        return {self.command: self._torque(q, u)}

    def loads(self, bicycle, t, q, u, motion, values):
        torque = values["handlebar_torque"] - self.feedback * self.ratio * self._torque(q, u)
        return Torque(torque * motion["C"].parent.z, motion["handlebar"], reaction_on=motion["rear frame"])
