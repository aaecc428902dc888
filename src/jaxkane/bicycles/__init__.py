"""Bicycles put together from parts: tyres, riders, steering, frames, drives, and who steers them."""

from ._bicycle import Bicycle as Bicycle
from ._head import HeadTwist as HeadTwist
from ._motorcycle import sharp_motorcycle as sharp_motorcycle
from ._part import Part as Part
from ._slip import LateralSlip as LateralSlip
from ._slip import LongitudinalSlip as LongitudinalSlip
from ._slip import MagicFormula as MagicFormula
from ._slip import Slip as Slip
from ._tyre import Contact as Contact
from ._tyre import Tyre as Tyre
