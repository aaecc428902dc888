"""What was found of every trial's own unknowns, by name. Knows a problem at a point."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._problem.model import Seen, Unknowns
from .._problem.problem import Problem
from .._problem.programs import starts_of
from .residuals import trial_names


def nuisance_by_trial(problem: Problem, point: Unknowns, seen: Seen) -> dict[str, dict[str, Any]]:
    """By trial, values of the biases and gains, and of the starts of its windows (W,), by name."""
    n = problem.model.nuisance
    starts = np.asarray(starts_of(problem.model, problem.windows, point)[0])[:, problem.model.unknown_places]
    owner = np.array([k for k, _, _ in problem.places])
    found = {}
    b = point.b if seen.unknowns is None else seen.unknowns  # with process noise a window is a trial
    given = np.isfinite(np.asarray(n.start_deviation)) & (problem.model.noise is not None)
    for k, name in enumerate(trial_names(problem)):
        found[name] = {}
        for j, (kind, what) in enumerate(n.trial):
            value = float(b[k, j]) + (1.0 if kind.startswith("gain") else 0.0)
            found[name][f"{kind.split()[0]} of {what}"] = value
        found[name] |= {f"start of {s}": starts[owner == k, j] for j, s in enumerate(n.start) if not given[j]}
    return found
