"""The sequential-loop rider of Hess, Moore and Hubbard. Knows angles and a path; knows no bicycle."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import numpy as np

from .._description.parameters import Learned, parameter
from .._scalars.types import Component, Scalar
from ._gains import STEER
from ._part import Part

# speed, steer, roll_rate, roll, heading, deviation of the benchmark bicycle: gains/BenchmarkSteerGains.txt of
# github.com/moorepants/HumanControl at 37107d22, the code of the paper; "chosen manually by Ron Hess" or by that code.
_OF_BENCHMARK = np.array([
    (2.5, 22.0, -0.09, 23.3, 0.058, 0.195),
    (3.2, 29.283, -0.049, 25.64, 0.087, 0.15),
    (3.6, 33.1311, -0.0535, 19.8266, 0.1056, 0.1338),
    (4.8, 44.6406, -0.0529, 13.2253, 0.172, 0.1001),
    (5.0, 46.5457, -0.0522, 12.6611, 0.1849, 0.0959),
    (8.0, 74.988, -0.04, 9.351, 0.434, 0.06),
    (8.34, 78.2238, -0.0388, 9.2493, 0.4676, 0.0571),
    (12.0, 115.379, -0.029, 9.28, 0.855, 0.04),
])  # fmt: skip


class SequentialLoopRider(Part):
    """A human rider as five loops, one around the other, whose arms follow late.

        wanted heading   = deviation * (path - y)                    y, x of the front contact
        wanted roll      = heading * (wanted heading - yaw) + desired_roll
        wanted roll rate = roll * (wanted roll - roll angle)
        wanted steer     = roll_rate * (wanted roll rate - roll rate)
        torque'' + 2 damping frequency torque' + frequency^2 torque = frequency^2 steer * (wanted steer - steer angle)

    with each gain by its own name. Hess, Moore and Hubbard (2012), *Modeling the manually controlled bicycle*, IEEE
    Transactions on Systems, Man, and Cybernetics A 42(3). The torque [N m] and its rate are the states
    "rider_torque" and "rider_torque_rate".

    **Arguments:**

    - `steer` [N m/rad], `roll_rate` [s], `roll` [1/s]: gains of the inner loops. `heading`, `deviation` [rad/m]: of the
        outer ones, which act where there is a `path`, a function y(x) [m] as of `PathFollower`; without one the rider
        follows "desired_roll" alone.
    - `preview` [s]: the path is read where the front contact will be after that time.
    - `frequency` [rad/s] and `damping` of the neuromuscular lag. `command`: the input that is written to.
    """

    steer: Scalar = parameter(unit="N m/rad")
    roll_rate: Scalar = parameter(unit="s")
    roll: Scalar = parameter(unit="1/s")
    heading: Scalar = parameter(0.0)
    deviation: Scalar = parameter(0.0, unit="rad/m")
    path: Any = eqx.field(default=None, converter=lambda path: None if path is None else Learned(path))
    preview: Scalar = parameter(0.0, within=(0.0, 100.0), unit="s")
    frequency: Scalar = parameter(30.0, positive=True, unit="rad/s")
    damping: Scalar = parameter(0.707, positive=True)
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    states = ("rider_torque", "rider_torque_rate")
    units = {"desired_roll": "rad", "rider_torque": "N m", "rider_torque_rate": "N m/s"}

    @classmethod
    def benchmark(cls, speed: float, **more: Any) -> Self:
        """With the gains for the benchmark bicycle at a speed from 2.5 to 12 m/s, between those that its authors found.

        **Arguments:** `more`: fields of the rider, as `path`.

        **Raises:** `ValueError` for a speed outside.
        """
        speeds, *columns = _OF_BENCHMARK.T
        speed = float(speed)
        if not speeds[0] <= speed <= speeds[-1]:
            known = f"{speeds[0]:g} to {speeds[-1]:g} m/s"
            raise ValueError(f"SequentialLoopRider.benchmark: gains are known from {known}, not at {speed} m/s.")
        gains: list[Any] = [np.interp(speed, speeds, column) for column in columns]
        return cls(*gains, **more)

    def commands(self, bicycle, t, q, u, motion, values):
        return {self.command: values["rider_torque"]}

    def wanted_roll(self, q: Any, motion: Any, values: Any) -> Component:
        """[rad]: the command of the inner loops."""
        if self.path is None:
            return values["desired_roll"]
        x, y = (motion["Q"].position.dot(axis) for axis in (motion.N.x, motion.N.y))
        heading = self.deviation * (self.path(x + motion.rear.speed * self.preview) - y)
        return values["desired_roll"] + self.heading * (heading - q["yaw"])

    def state_rates(self, bicycle, t, q, u, x, motion, now):
        roll_rate = self.roll * (self.wanted_roll(q, motion, now) - q["roll"])
        steer = self.roll_rate * (roll_rate - u["roll_rate"])
        asked = self.steer * (steer - q["steer"])
        torque, slope = now["rider_torque"], now["rider_torque_rate"]
        return slope, self.frequency**2 * (asked - torque) - 2.0 * self.damping * self.frequency * slope
