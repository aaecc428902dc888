"""Steady motions, linear models about them, eigenvalues, critical speeds, and their derivatives."""

from ._bicycle import Canonical as Canonical
from ._bicycle import canonical as canonical
from ._bicycle import straight_ahead as straight_ahead
from ._continuation import Family as Family
from ._continuation import family as family
from ._control import bode as bode
from ._control import lqr as lqr
from ._control import to_control as to_control
from ._control import transfer_function as transfer_function
from ._critical import CriticalSpeeds as CriticalSpeeds
from ._critical import critical_speeds as critical_speeds
from ._eigenvalues import Eigenvalues as Eigenvalues
from ._eigenvalues import eigenvalues as eigenvalues
from ._linearize import LinearModel as LinearModel
from ._linearize import linearize as linearize
from ._linearize import with_speeds as with_speeds
from ._modes import LATERAL as LATERAL
from ._steady import SteadyMotion as SteadyMotion
from ._steady import cyclic_coordinates as cyclic_coordinates
from ._steady import equilibrium as equilibrium
from ._steady import steady_turn as steady_turn
