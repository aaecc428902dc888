"""Bicycles put together from parts: tyres, riders, steering, frames, drives, and who steers them."""

from ._bicycle import Bicycle as Bicycle
from ._by_wire import SteerByWire as SteerByWire
from ._drive import ConstantSpeed as ConstantSpeed
from ._drive import Drag as Drag
from ._gains import LeanSteerGains as LeanSteerGains
from ._gains import ScheduledGains as ScheduledGains
from ._gains import follow_gain as follow_gain
from ._gains import lqr as lqr
from ._head import HeadTwist as HeadTwist
from ._motorcycle import sharp_motorcycle as sharp_motorcycle
from ._part import Part as Part
from ._path import LaneChange as LaneChange
from ._path import PathFollower as PathFollower
from ._rider_model import SequentialLoopRider as SequentialLoopRider
from ._slip import LateralSlip as LateralSlip
from ._slip import LongitudinalSlip as LongitudinalSlip
from ._slip import MagicFormula as MagicFormula
from ._slip import Slip as Slip
from ._steering import SteeringFriction as SteeringFriction
from ._steering import SteeringMotor as SteeringMotor
from ._tyre import Contact as Contact
from ._tyre import Tyre as Tyre
