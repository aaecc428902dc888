"""Coverage of intervals of parameters of groups and of their distribution, by simulation."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Track
from test_groups import EXACT, RESPONSES, RIDERS, T, recorded

from jaxkane.fit import Free, LeastSquares, Problem, Trial
from jaxkane.fit.solve.fit import solve

SETS = 100
SLACK = 0.066  # three standard deviations of a share of 0.95 among 100 sets


def covered(prior, deviation, noise=0.05, sets=SETS):
    """By name, the share of the sets whose intervals contain the truth; the riders' gains together."""
    free = (Free("gain", each="rider", prior=prior), "drift")
    problem = Problem.of(Track(), recorded(), free, simulation=EXACT["simulation"])
    rng, hits = np.random.default_rng(7), {"gain": [], "mean of gain": [], "drift": []}
    for _ in range(sets):
        gains = 1.2 + deviation * rng.normal(size=len(RIDERS))
        y = np.stack([A @ [gains[k % 5], 0.4] for k, A in enumerate(RESPONSES)])
        y = y + noise * rng.normal(size=y.shape)
        windows = eqx.tree_at(lambda w: w.measured, problem.windows, jnp.asarray(y[:, None]))
        trials = tuple(Trial(T, {"x": x}, sigma=0.025) for x in y)  # of which residuals are taken
        found = solve(dataclasses.replace(problem, windows=windows, trials=trials), LeastSquares())
        truth = dict(zip((f"gain [{rider}]" for rider in RIDERS), gains, strict=True))
        truth |= {"mean of gain": 1.2, "drift": 0.4}
        for name, (low, high) in found.intervals().items():
            hits[name.partition(" [")[0]].append(low <= truth[name] <= high)
    return {name: float(np.mean(of_one)) for name, of_one in hits.items() if of_one}


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("prior", "deviation", "least"),
    [(None, 0.3, 0.95), ("normal", 0.3, 0.95), ("normal", 0.03, 0.80)],  # a note warns of the last case
    ids=["free", "wide", "narrow"],
)
def test_interval_coverage_with_groups(prior, deviation, least):
    for name, share in covered(prior, deviation).items():
        assert least - SLACK < share, (name, share)
