"""The systems of Kamman, Volume II, Unit 5: Examples 1 to 7 and Exercises 5.1 to 5.8; walkers and a ball, whose state
jumps at events; systems with contacts; and the rattleback. There is one file for each kind of mechanism.

`CATALOG` lists all systems, each with an example instance and a consistent state. To add a mechanism, add a class
with `@entry(...)` above it to one of the files, and import the class below. It is then tested by
`tests/catalog/test_laws.py` and shown in the catalogue of the website.
"""

from ._entry import CATALOG as CATALOG
from ._entry import Entry as Entry
from .bars import BarWithPiston as BarWithPiston
from .bars import ColumnFrameAndDisk as ColumnFrameAndDisk
from .bars import DiskAndBar as DiskAndBar
from .bars import DoublePendulum as DoublePendulum
from .bars import LightShaftAndBar as LightShaftAndBar
from .bars import RotatingFrameAndBar as RotatingFrameAndBar
from .bars import RotatingFrameAndBarChosenSpeeds as RotatingFrameAndBarChosenSpeeds
from .bars import ShaftAndBar as ShaftAndBar
from .bars import SliderWithPinnedBar as SliderWithPinnedBar
from .bars import SpatialDoublePendulum as SpatialDoublePendulum
from .bicycle import WhippleBicycle as WhippleBicycle
from .bicycle import read_bicycle_file as read_bicycle_file
from .contacts import Backlash as Backlash
from .contacts import Belt as Belt
from .contacts import BouncingBall as BouncingBall
from .contacts import KerbWheel as KerbWheel
from .contacts import RockingBlock as RockingBlock
from .contacts import SliderCrankWithClearance as SliderCrankWithClearance
from .contacts import Woodpecker as Woodpecker
from .rigid_bodies import Aircraft as Aircraft
from .rigid_bodies import AircraftEulerParameters as AircraftEulerParameters
from .rigid_bodies import Bracket as Bracket
from .rigid_bodies import Rattleback as Rattleback
from .rigid_bodies import RigidBody as RigidBody
from .rigid_bodies import SpinningTop as SpinningTop
from .walkers import CompassGait as CompassGait
from .walkers import RimlessWheel as RimlessWheel
from .walkers import SimplestWalker as SimplestWalker
