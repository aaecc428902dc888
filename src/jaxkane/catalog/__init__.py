"""The systems of Kamman, Volume II, Unit 5: Examples 1 to 7 and Exercises 5.1 to 5.8; walkers and a ball, whose state
jumps at events; systems with contacts; and the rattleback. There is one file for each mechanism.

`CATALOG` lists all systems, each with an example instance and a consistent state. To add a mechanism, add a file with
`@entry(...)` above its class, and import the class below. It is then tested by `tests/catalog/test_laws.py` and shown
in the catalogue of the website.
"""

from ._entry import CATALOG as CATALOG
from ._entry import Entry as Entry
from ._entry import read_bicycle_file as read_bicycle_file
from .aircraft import Aircraft as Aircraft
from .aircraft import AircraftEulerParameters as AircraftEulerParameters
from .backlash import Backlash as Backlash
from .bar_with_piston import BarWithPiston as BarWithPiston
from .belt import Belt as Belt
from .bicycle import WhippleBicycle as WhippleBicycle
from .bouncing_ball import BouncingBall as BouncingBall
from .bracket import Bracket as Bracket
from .column_frame_and_disk import ColumnFrameAndDisk as ColumnFrameAndDisk
from .compass_gait import CompassGait as CompassGait
from .disk_and_bar import DiskAndBar as DiskAndBar
from .double_pendulum import DoublePendulum as DoublePendulum
from .kerb_wheel import KerbWheel as KerbWheel
from .rattleback import Rattleback as Rattleback
from .rigid_body import RigidBody as RigidBody
from .rimless_wheel import RimlessWheel as RimlessWheel
from .rocking_block import RockingBlock as RockingBlock
from .rotating_frame import RotatingFrameAndBar as RotatingFrameAndBar
from .rotating_frame import RotatingFrameAndBarChosenSpeeds as RotatingFrameAndBarChosenSpeeds
from .shaft_and_bar import LightShaftAndBar as LightShaftAndBar
from .shaft_and_bar import ShaftAndBar as ShaftAndBar
from .simplest_walker import SimplestWalker as SimplestWalker
from .slider_crank_with_clearance import SliderCrankWithClearance as SliderCrankWithClearance
from .slider_with_pinned_bar import SliderWithPinnedBar as SliderWithPinnedBar
from .spatial_double_pendulum import SpatialDoublePendulum as SpatialDoublePendulum
from .spinning_top import SpinningTop as SpinningTop
from .woodpecker import Woodpecker as Woodpecker
