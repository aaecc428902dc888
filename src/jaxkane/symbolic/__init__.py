"""Equations of motion as formulas of SymPy, in the declared names. Not used for numerical work.

The formulas are written from the graph of scalars that the library computes with, so the model is defined only once.
"""

from ._equations import Equations as Equations
from ._equations import LinearEquations as LinearEquations
from ._equations import equations as equations
from ._equations import linearize as linearize
