"""Mechanisms as trees of links and joints, given as data: `mechanism([Link(...), ...])` is an ordinary `System`."""

from ._joints import Joint as Joint
from ._joints import ball as ball
from ._joints import fixed as fixed
from ._joints import free as free
from ._joints import hinge as hinge
from ._joints import planar as planar
from ._joints import slide as slide
from ._joints import universal as universal
from ._mechanism import Mechanism as Mechanism
from ._parts import Actuator as Actuator
from ._parts import Coupling as Coupling
from ._parts import Link as Link
from ._parts import Loop as Loop
from ._parts import Site as Site
from ._tree import mechanism as mechanism
