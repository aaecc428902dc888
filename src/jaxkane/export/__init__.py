"""Equations as C, NumPy source, a CasADi function or StableHLO. Simulates nothing.

All are written from the graph of scalars that native kernels are written from, so that no formula stands there twice.
"""

from ._filter import ExportedFilter as ExportedFilter
from ._filter import c_filter as c_filter
from ._programs import casadi as casadi
from ._programs import stablehlo as stablehlo
from ._source import ExportedFiles as ExportedFiles
from ._source import c as c
from ._source import numpy as numpy
from ._source import parameters as parameters
