"""Optimal control by direct collocation: the least cost of a motion, its duration and the parameters of the system."""

from .._collocate.functions import Now as Now
from ._plan import Multipliers as Multipliers
from ._plan import Plan as Plan
from ._problem import Phases as Phases
from ._problem import Problem as Problem
from ._sensitivities import Sensitivity as Sensitivity
from ._solve import check_derivatives as check_derivatives
from ._solve import continuation as continuation
from ._solve import solve as solve
