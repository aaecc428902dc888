"""Import of existing models as systems: MJCF and URDF files, and models of SymPy's mechanics."""

from ._mjcf import from_mjcf as from_mjcf
from ._sympy import from_sympy as from_sympy
from ._urdf import from_urdf as from_urdf
