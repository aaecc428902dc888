"""The fitted motions, simulated when they are asked for."""

from __future__ import annotations

from ..._simulation.trajectory import Trajectory
from .._result.result import Fit


def trajectories(fit: Fit) -> list[tuple[str, Trajectory]]:
    """The fitted motion of every window, with the name of its trial, in their order.

    **Raises:** `ValueError` for a fit with process noise, whose motion is no simulation.
    """
    if fit.problem.model.noise is not None:
        raise ValueError("trajectories: process noise disturbs this fit's motion, which `smoothed(fit)` gives.")
    rides = fit.problem.trajectories(fit.point)
    return [(fit.trial_names[k], ride) for (k, _, _), ride in zip(fit.problem.places, rides, strict=True)]
