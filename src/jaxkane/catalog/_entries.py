"""The table of the catalogue: an example of every system, so that laws can be run over all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from .._description.system import System
from .aircraft import Aircraft, AircraftEulerParameters
from .bar_with_piston import BarWithPiston
from .bicycle import WhippleBicycle
from .bracket import Bracket
from .column_frame_and_disk import ColumnFrameAndDisk
from .disk_and_bar import DiskAndBar
from .double_pendulum import DoublePendulum
from .rigid_body import RigidBody
from .rotating_frame import RotatingFrameAndBar, RotatingFrameAndBarChosenSpeeds
from .shaft_and_bar import LightShaftAndBar, ShaftAndBar
from .slider_with_pinned_bar import SliderWithPinnedBar
from .spatial_double_pendulum import SpatialDoublePendulum
from .spinning_top import SpinningTop


@dataclasses.dataclass(frozen=True)
class Entry:
    """One line of `CATALOG`.

    - `book`: its place in Kamman, Volume II, Unit 5.
    - `example`: makes an instance; a function, so that importing the catalogue makes no array.
    - `q`, `u`: a generic state, consistent with the constraints, in the order of `coordinates` and `speeds`; left to
        itself from there, the system moves for at least 10 s without meeting one of its `events`.
    - `conservative`: whether mechanical energy is constant when no input acts.
    """

    book: str
    example: Callable[[], System]
    q: tuple[float, ...]
    u: tuple[float, ...]
    conservative: bool = True


_EULER = (0.1, -0.3, 0.5, 0.65**0.5)  # of unit norm, the scalar last
_ENGINES = {
    "engine1_speed": 400.0,
    "engine1_acceleration": 15.0,
    "engine2_speed": 380.0,
    "engine2_acceleration": -10.0,
}

CATALOG: dict[str, Entry] = {
    "DoublePendulum": Entry("Example 1", DoublePendulum, (0.7, -0.4), (1.1, -0.8)),
    "RigidBody": Entry("Example 2", RigidBody, (0.3, -0.2, 0.5, *_EULER), (1.0, -0.5, 0.8, 0.6, -1.1, 0.9)),
    "RotatingFrameAndBar": Entry("Example 3", RotatingFrameAndBar, (0.5, 0.8), (1.3, -0.9)),
    "RotatingFrameAndBarChosenSpeeds": Entry("Example 4", RotatingFrameAndBarChosenSpeeds, (0.5, 0.8), (0.65, -0.9)),
    "Aircraft": Entry(
        "Example 5",
        lambda: Aircraft(**_ENGINES),
        (100.0, -50.0, -1000.0, 0.4, 0.2, -0.3),
        (120.0, 4.0, 7.0, 0.3, -0.2, 0.15),
        conservative=False,  # the motors that hold the engines' prescribed speeds do work
    ),
    "AircraftEulerParameters": Entry(
        "Example 5",
        lambda: AircraftEulerParameters(**_ENGINES),
        (100.0, -50.0, -1000.0, *_EULER),
        (120.0, 4.0, 7.0, 0.3, -0.2, 0.15),
        conservative=False,
    ),
    "SpatialDoublePendulum": Entry(
        "Example 6",
        SpatialDoublePendulum,
        (0.4, 1.1, -0.3, -0.6, 0.9, 0.8),
        (0.7, -0.4, 0.5, -0.6, 0.3, 0.9),
    ),
    "WhippleBicycle": Entry(
        "Example 7",
        lambda: WhippleBicycle.benchmark(),
        (0.2, 0.2, 0.15, -0.8, -0.0023122917367326048, -0.1, 0.3, -0.4),  # the pitch follows from roll and steer
        (0.3, -17.0, -0.4),  # about 5 m/s, where the benchmark bicycle rights itself
    ),
    "BarWithPiston": Entry("Exercise 5.1", BarWithPiston, (0.6,), (-0.9,), conservative=False),  # a damper
    "SliderWithPinnedBar": Entry("Exercise 5.2", SliderWithPinnedBar, (0.2, 0.7), (0.4, -1.2), conservative=False),
    "ShaftAndBar": Entry("Exercise 5.3", ShaftAndBar, (0.3, 0.9), (1.4, -0.7)),
    "LightShaftAndBar": Entry("Exercise 5.4", LightShaftAndBar, (0.3, 0.9), (-1.1, -0.7)),
    "DiskAndBar": Entry("Exercise 5.5", DiskAndBar, (0.3, 0.6), (1.5, -0.8), conservative=False),  # a damper
    "SpinningTop": Entry("Exercise 5.6", SpinningTop, (0.15, -0.2, 0.35, 0.815**0.5), (0.8, -0.6, 40.0)),
    "ColumnFrameAndDisk": Entry("Exercise 5.7", ColumnFrameAndDisk, (0.2, 0.9, -0.4), (-1.0, 0.2, 3.0)),
    "Bracket": Entry("Exercise 5.8", Bracket, (0.5, -0.4, 0.7), (0.9, -0.6, 1.2)),
}
"""Every system of the textbook by name, in the textbook's order."""
