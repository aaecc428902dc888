"""Parameters from measured motion: trials, residuals with exact derivatives, two optimizers, and what can be told."""

from ._fit import fit as fit
from ._gradient_descent import gradient_descent as gradient_descent
from ._identifiability import Direction as Direction
from ._identifiability import Identifiability as Identifiability
from ._identifiability import identifiability as identifiability
from ._least_squares import least_squares as least_squares
from ._parameters import Free as Free
from ._parameters import Gain as Gain
from ._problem import Point as Point
from ._problem import Problem as Problem
from ._read import read_trials as read_trials
from ._result import Fit as Fit
from ._trial import Trial as Trial
from .bicycle import fit_bicycle as fit_bicycle
