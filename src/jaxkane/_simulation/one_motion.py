"""One motion of a system, checked before it is judged or drawn. Knows trajectories; knows no mechanism."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._description.system import System
from .trajectory import Trajectory


def reached_times(function: str, system: System, trajectory: Any) -> np.ndarray:
    """Which times (n_t,) a motion reached, at least two; `function` is the one that was called, for messages.

    **Raises:** `TypeError` for what is no `Trajectory`; `ValueError` for a batch, for the motion of another system, and
    for one that reached fewer than two of its times.
    """
    label = f"{function}({type(system).__name__})"
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"{label}: the second argument is a Trajectory, as from simulate, got {trajectory!r}.")
    if trajectory.t.ndim != 1:
        raise ValueError(
            f"{label}: takes one motion; of a batch of shape {trajectory.t.shape[:-1]} give one member: "
            "jax.tree.map(lambda x: x[0], rides)."
        )
    if trajectory.names[0] != tuple(system.coordinates):
        raise ValueError(
            f"{label}: the trajectory has the coordinates {', '.join(trajectory.names[0])}, the system has "
            f"{', '.join(system.coordinates)}: it is the motion of another system."
        )
    reached = np.all(np.isfinite(np.asarray(trajectory.q)), axis=1)
    if reached.sum() < 2:
        raise ValueError(f"{label}: the simulation reached only {reached.sum()} of its times: {trajectory.reason}.")
    return reached
