"""Measured pendulums are explained as well as by the published models, and what cannot be told of them is named."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import jaxkane as jk
from jaxkane.fit import Free, LeastSquares, Problem, Simulation, Trial, minimize

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


@pytest.mark.slow
def test_intervals_of_the_single_arm_cover():
    """Twenty simulated versions of the measured swings, of which every tenth sample is taken."""
    sigma, rng = 0.0009, np.random.default_rng(7)  # [rad], what the residuals are; another seed, another few per cent
    Arm = runpy.run_path(str(EXAMPLES / "identify_a_pendulum.py"))["Arm"]
    true = {"inertia": 0.0033414, "dry": 0.0005, "drag": 1.47e-5, "offset": 0.00085}
    truth = Arm(**true)
    free = ["inertia", Free("dry", scale=1e-4), Free("drag", scale=1e-5), Free("offset", scale=0.01)]
    clean = []
    for swing in jk.data.multi_arm_pendulum(1).trials:
        start = {"angle1": float(swing.measured["angle1"][0]), "rate1": float(swing.initial["rate1"][0])}
        ride = jk.simulate(truth, jk.State([start["angle1"]], [start["rate1"]]), swing.t[::10], rtol=1e-9, atol=1e-11)
        clean.append((swing.t[::10], np.asarray(ride["angle1"]), start))
    problem, covered = None, []
    for _ in range(20):
        noisy = [
            Trial(t, {"angle1": angle + rng.normal(0.0, sigma, t.size)}, sigma=sigma, initial=start)
            for t, angle, start in clean
        ]
        # At 1e-8 the errors of the steps are a noise of the cost, in which a fit may get stuck beside its minimum.
        posed = {"unknown": ("angle1", "rate1"), "simulation": Simulation(rtol=1e-10)}
        problem = Problem.of(truth, noisy, free, **posed) if problem is None else problem.with_trials(noisy)
        found = minimize(problem, LeastSquares())
        assert found.ok
        covered += [low <= true[name] <= high for name, (low, high) in found.intervals().items()]
    assert 0.9 <= np.mean(covered) <= 0.99
