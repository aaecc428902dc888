"""Measured pendulums are explained as well as by the published models, and what cannot be told of them is named."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import jaxkane as jk
from jaxkane.fit import LeastSquares

EXAMPLES = Path(__file__).parents[1] / "examples"
# Least squares with free starts by NumPy and SciPy on the same files, to four digits after the point.
MEDIAN = {2: 0.0031, 3: 0.0018}  # [rad]
TOLD = {2: (7, 5), 3: (11, 8)}  # parameters, and combinations of them that free swings tell


@pytest.mark.slow
@pytest.mark.parametrize("arms", [2, 3])
def test_free_swings_of_two_and_three_arms(arms):
    tolerance = 0.5e-4  # [rad], of the last digit
    system = runpy.run_path(str(EXAMPLES / "identify_pendulums.py"))[{2: "TwoArms", 3: "ThreeArms"}[arms]]()
    free = [f"{what}{i + 1}" for what in ("mass", "center", "inertia", "viscous") for i in range(arms)][1:]
    unknown = (*system.coordinates, *system.speeds)
    swings = jk.data.multi_arm_pendulum(arms).trials
    found = jk.fit.fit(system, swings, free, unknown=unknown, optimizer=LeastSquares())
    errors = [0.001 * np.array(list(channels.values())) for channels in found.residuals.values()]
    assert np.median([np.sqrt(np.mean(e**2)) for e in errors]) < MEDIAN[arms] + tolerance
    seen = found.identifiability
    assert (len(seen.names), seen.count) == TOLD[arms]
    assert all(direction.singular_value == 0.0 and len(direction.parts) > 1 for direction in seen.undetermined)
    # With one arm's mass nothing of friction moves: the others' centres and inertias make up for it.
    assert any("viscous" not in direction.text for direction in seen.undetermined)
    bodies = {f"arm{i + 1}": ("m", "my", "Izz") for i in range(arms)}
    told = jk.fit.base_parameters(system, bodies=bodies, parameters=[f"viscous{i + 1}" for i in range(arms)])
    assert told.count == seen.count
