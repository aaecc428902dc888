"""Mechanisms as trees of links and joints, defined by data: `mechanism([Link(...), ...])` is an ordinary `System`."""

from ._joints import Joint as Joint
from ._joints import ball as ball
from ._joints import fixed as fixed
from ._joints import free as free
from ._joints import hinge as hinge
from ._joints import planar as planar
from ._joints import slide as slide
from ._joints import universal as universal
from ._links import Actuator as Actuator
from ._links import Coupling as Coupling
from ._links import Link as Link
from ._links import Loop as Loop
from ._links import Site as Site
from ._links import mechanism as mechanism
from ._mechanism import Mechanism as Mechanism
