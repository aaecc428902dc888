"""Equations taken elsewhere: C, CasADi, StableHLO, NumPy. Knows their languages; simulates nothing.

All are written from the graph of scalars that native kernels are written from, so that no formula stands there twice.
"""

from ._c import ExportedFiles as ExportedFiles
from ._c import c as c
from ._casadi import casadi as casadi
from ._functions import parameters as parameters
from ._numpy import numpy as numpy
from ._stablehlo import stablehlo as stablehlo
