"""Equations as C, NumPy source, a CasADi function, StableHLO or an FMU. Does not simulate.

All are written from the graph of scalars from which native kernels are written, so each formula is defined only once.
"""

from ._filter import ExportedFilter as ExportedFilter
from ._filter import c_filter as c_filter
from ._fmu import fmu as fmu
from ._programs import casadi as casadi
from ._programs import stablehlo as stablehlo
from ._source import ExportedFiles as ExportedFiles
from ._source import c as c
from ._source import numpy as numpy
from ._source import parameters as parameters
