"""Equations that can be read: formulas of SymPy, in the declared names. Knows formulas; computes no numbers.

They are written from the graph of scalars that the library computes with, so that there is no second description.
"""

from ._equations import Equations as Equations
from ._equations import equations as equations
from ._linear import LinearEquations as LinearEquations
from ._linear import linearize as linearize
