"""Whether a trajectory is a motion of a system, and one motion. Knows trajectories; knows no mechanism."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._description.system import System, names_of
from .._method.values import check_is_system
from .trajectory import Trajectory


def refuse_other_system(label: str, system: System, trajectory: Any) -> None:
    """Every function of a system and a trajectory, or a steady motion, asks this first; `label` is the one that was
    called, for the message.

    **Raises:** `ValueError` where the names differ, by which a motion is read; `TypeError` for what is no system.
    """
    check_is_system(system)
    kinds = ("coordinates", "speeds", "dependent speeds", "states")
    groups = zip(kinds, trajectory.names, names_of(system), strict=True)
    for kind, of_trajectory, own in (*groups, ("inputs", sorted(trajectory.inputs), sorted(system.inputs))):
        if tuple(of_trajectory) != tuple(own):
            raise ValueError(
                f"{label}: the motion has the {kind}: {', '.join(of_trajectory) or 'none'}, the system has: "
                f"{', '.join(own) or 'none'}: it is the motion of another system."
            )


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
    refuse_other_system(label, system, trajectory)
    reached = np.all(np.isfinite(np.asarray(trajectory.q)), axis=1)
    if reached.sum() < 2:
        raise ValueError(f"{label}: the simulation reached only {reached.sum()} of its times: {trajectory.reason}.")
    return reached
