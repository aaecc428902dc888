"""Steady motions, linear models about them, eigenvalues and critical speeds, all differentiable."""

from ._bicycle import LATERAL as LATERAL
from ._bicycle import Canonical as Canonical
from ._bicycle import canonical as canonical
from ._bicycle import straight_ahead as straight_ahead
from ._continuation import Family as Family
from ._control import FrequencyResponse as FrequencyResponse
from ._control import frequency_response as frequency_response
from ._control import lqr as lqr
from ._control import to_control as to_control
from ._eigenvalue_curves import CriticalSpeeds as CriticalSpeeds
from ._eigenvalue_curves import Eigenvalues as Eigenvalues
from ._eigenvalue_curves import critical_speeds as critical_speeds
from ._eigenvalue_curves import eigenvalues as eigenvalues
from ._families import Bifurcation as Bifurcation
from ._families import OrbitFamily as OrbitFamily
from ._families import family as family
from ._families import limit_cycle as limit_cycle
from ._linearize import LinearModel as LinearModel
from ._linearize import linearize as linearize
from ._linearize import with_speeds as with_speeds
from ._periodic import Orbit as Orbit
from ._periodic import periodic as periodic
from ._steady import SteadyMotion as SteadyMotion
from ._steady import cyclic_coordinates as cyclic_coordinates
from ._steady import equilibrium as equilibrium
from ._steady import steady_turn as steady_turn
