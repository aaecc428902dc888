"""Operations of the traced right-hand sides and of their derivatives."""

import pytest
from programs import count, program_of

from jaxkane.catalog import CATALOG

LARGE = "WhippleBicycle SpatialDoublePendulum Aircraft AircraftEulerParameters SliderCrankWithClearance Rattleback"
LARGE += " DoublePendulum CompassGait RigidBody ColumnFrameAndDisk"


@pytest.mark.weekly_cases(*LARGE.split())
@pytest.mark.parametrize("name", CATALOG)
def test_operation_counts_do_not_increase(name):
    entry = CATALOG[name]
    program = program_of("rates", entry.example(), entry.q, entry.u)
    n = len(program.program.jaxpr.invars)
    tangent = program.tangent((True,) * n)
    assert count(program) <= entry.operations
    assert count(tangent) <= 4 * entry.operations  # in all directions that there are
    assert count(tangent.transposed((False,) * n + (True,) * n))
