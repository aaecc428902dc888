"""An audit, drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._simulation.audit import Audit
from ._axes import panels


def audit(audit: Audit, *, axes: Any = None) -> np.ndarray:
    """Energies, energy error, residuals of the constraints and conditioning over time.

        jk.plot.audit(jk.audit(system, ride))

    **Arguments:** an `Audit`; `axes`: four.

    **Returns:** the axes (2, 2).
    """
    if not isinstance(audit, Audit):
        raise TypeError(f"plot.audit draws an Audit, jk.audit(system, ride); got a {type(audit).__name__}.")
    found = panels(axes, 2, 2, size=(4.75, 2.75), sharex=True)
    audit.plot(found)
    return found
