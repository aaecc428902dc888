"""Longitudinal loads and constraints: aerodynamic drag, and a prescribed speed."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.motion import Force
from .._system.parameters import parameter
from ..catalog.bicycle import FAR
from ..loads import smooth_abs
from ._part import Part


class Drag(Part):
    """Drag of still air at a point of the frame: -density / 2 * area * |v| v.

    **Arguments:**

    - `area` [m^2]: frontal area times drag coefficient; about 0.5 for an upright rider.
    - `height`, `ahead` [m]: the point at which the drag acts on the upright bicycle, above the ground and ahead of the
        rear contact.
    - `density` [kg/m^3]: of the air.
    """

    area: Scalar = parameter(0.5, positive=True, unit="m^2")
    height: Scalar = parameter(1.1, within=(0.0, FAR), unit="m")
    ahead: Scalar = parameter(0.4, within=(-FAR, FAR), unit="m")
    density: Scalar = parameter(1.2, positive=True, unit="kg/m^3")

    resists = True

    def motion(self, bicycle, motion, t, q, u):
        B, hub = motion["B"], motion["rear wheel"].center
        place = hub.fixed(self.ahead * B.x + (bicycle.rR - self.height) * B.z, B)
        return motion.extended(points={"center of drag": place})

    def loads(self, bicycle, t, q, u, motion, values):
        v = motion["center of drag"].velocity
        size = 0.5 * self.density * self.area * smooth_abs(v, 1e-3)  # [N s/m]; smoothed below 1 mm/s
        return Force(-size * v, motion["center of drag"])


class ConstantSpeed(Part):
    """The rear wheel turns relative to the frame at a prescribed rate, with the torque that this needs.

        rear_wheel_rate = -speed / rR

    The rate is then a dependent speed; do not include it in an initial state. The output "holding_torque" [N m] is the
    necessary drive torque on the rear wheel, with its reaction on the frame. As for "drive_torque", a negative value
    accelerates. For linear models over speeds, remove this part. Straight, upright riding then has the "drive_torque"
    that it needs, and deviations from it change the speed to second order only.

    **Arguments:**

    - `speed` [m/s]: the forward speed.
    """

    speed: Scalar = parameter(within=(-100.0, 100.0), unit="m/s")

    dependent_speeds = ("rear_wheel_rate",)
    units = {"holding_torque": "N m"}

    def motion(self, bicycle, motion, t, q, u):
        return motion.extended((), [u["rear_wheel_rate"] + self.speed / bicycle.rR])

    def outputs(self, bicycle, t, q, u, motion, now):
        return {"holding_torque": now.multipliers[bicycle.dependent_speeds.index("rear_wheel_rate")]}
