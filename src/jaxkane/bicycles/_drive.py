"""What acts along the ride: drag of the air, and a prescribed speed."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.motion import Force
from .._system.parameters import parameter
from ..catalog.bicycle import FAR
from ..loads import smooth_abs
from ._part import Part


class Drag(Part):
    """Drag of still air at a point of the frame: -density / 2 * area * |v| v.

    **Arguments:** `area` [m^2]: frontal area times drag coefficient, of an upright rider some 0.5; `height` over the
    ground and place `ahead` of the rear contact [m] of the point at which it acts, when upright; `density` [kg/m^3].
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
        size = 0.5 * self.density * self.area * smooth_abs(v, 1e-3)  # [N s/m]; smooth below a millimetre a second
        return Force(-size * v, motion["center of drag"])


class ConstantSpeed(Part):
    """The rear wheel turns against the frame at a prescribed rate, whatever torque that takes.

        rear_wheel_rate = -speed / rR

    The rate is a dependent speed then, which an initial state leaves out. The output "holding_torque" [N m] is the
    torque that the drive has to give, on the rear wheel with its reaction on the frame, negative where it pushes on, as
    "drive_torque". Linear models over speeds are those of the bicycle without this part, with the "drive_torque" that
    riding straight and upright takes: deviations from it change the speed to second order only.

    **Arguments:** `speed` [m/s].
    """

    speed: Scalar = parameter(within=(-100.0, 100.0), unit="m/s")

    dependent_speeds = ("rear_wheel_rate",)
    units = {"holding_torque": "N m"}

    def motion(self, bicycle, motion, t, q, u):
        return motion.extended((), [u["rear_wheel_rate"] + self.speed / bicycle.rR])

    def outputs(self, bicycle, t, q, u, motion, now):
        return {"holding_torque": now.multipliers[bicycle.dependent_speeds.index("rear_wheel_rate")]}
