"""An optimizer is one class: the loop gives it steps, a checkpoint, a callback, Ctrl-C and the result."""

import dataclasses
import inspect
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from systems import POSED, TRIAL, Track

import jaxkane as jk
from jaxkane.fit import (
    GradientDescent,
    LeastSquares,
    Problem,
    Trial,
    fit,
    fit_bicycle,
    minimize,
    multi_start,
)
from jaxkane.fit.problem.specification import ProblemSpec
from jaxkane.fit.solve.linearization import eliminate
from jaxkane.fit.solve.optimizers import Iterate, Optimizer, moved, refined


@dataclasses.dataclass(frozen=True)
class Part(Optimizer):
    """A part of the way to the minimum of the linearized problem: of a linear one, the same part of what is left."""

    steps: ClassVar[int] = 6
    part: float = 0.5

    @property
    def name(self):
        return "part of the way"

    def init(self, problem, point, at):
        return jnp.zeros(())

    def step(self, problem, now, taken):
        eliminated = eliminate(now.at.blocks, 0.0)
        point = moved(now.point, self.part * eliminated.step(0.0)[0], eliminated)
        at = problem.linearize(point)
        return Iterate(point, at.cost, at, now.state + 1)


@pytest.mark.slow
def test_a_custom_optimizer_is_fitted_interrupted_and_resumed(tmp_path):
    problem = Problem.of(Track(), TRIAL, ["gain", "drift"], **POSED)
    least = minimize(problem, LeastSquares(rtol=1e-13)).cost
    found = fit(Track(), TRIAL, ["gain", "drift"], optimizer=Part(), **POSED)
    assert (found.method, found.status, len(found.history)) == ("part of the way", "steps", 7)
    # What a linear problem costs more than its minimum falls by the square of what is left of the way.
    excess = np.array(found.history) - least
    np.testing.assert_allclose(excess[1:], 0.25 * excess[:-1], rtol=1e-6)
    calls, path = [], tmp_path / "fit.npz"

    def stop(point, cost):
        calls.append(cost)
        if len(calls) == 4:
            raise KeyboardInterrupt

    begun = minimize(problem, Part(), checkpoint=path, callback=stop)
    assert (begun.status, begun.cost) == ("interrupted", min(calls))
    resumed = minimize(problem, Part(), checkpoint=path)
    assert resumed.history == pytest.approx(found.history, rel=1e-12)
    # The best iterate is returned if the last is worse.
    away = minimize(problem, Part(part=2.5))
    np.testing.assert_allclose(away.history[-1] / away.history[-2], 2.25, rtol=0.05)  # (1 - 2.5)^2
    assert away.cost == away.history[0] == min(away.history)


def test_invalid_optimizer_options_are_rejected():
    problem = Problem.of(Track(), TRIAL, ["gain"], **POSED)
    for optimizer in (LeastSquares, GradientDescent):
        with pytest.raises(ValueError, match=rf"{optimizer.__name__}: `rtol`.*-1"):
            optimizer(rtol=-1.0)
    with pytest.raises(ValueError, match=r"LeastSquares: `damping`.*nan"):
        LeastSquares(damping=float("nan"))
    for steps in (-1, 1.5):
        with pytest.raises(ValueError, match=rf"`steps` must be an integer.*{steps}"):
            minimize(problem, LeastSquares(), steps=steps)
    for n in (0, -1):
        with pytest.raises(ValueError, match=f"number of initial guesses, must be an integer of at least 1, got {n}"):
            multi_start(problem, n)
    with pytest.raises(ValueError, match="`spread`, the distance of the guesses"):
        multi_start(problem, 2, spread=-1.0)
    with pytest.raises(TypeError, match=r"`start=` requires a Unknowns, as in start=fit.point"):
        minimize(problem, LeastSquares(), start={"gain": 1.0})
    with pytest.raises(TypeError, match=r"minimize requires a Problem, as in minimize\(fit.problem"):
        minimize(Track(), LeastSquares())


class Dial(jk.System):
    """A wheel that turns freely, seen by the sine of three times its angle."""

    coordinates, speeds = ("angle",), ("rate",)
    inertia: jk.Scalar = jk.parameter(1.0, positive=True)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        wheel = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, self.inertia), O, wheel, name="wheel")])

    def loads(self, t, q, u, motion, inputs):
        return ()

    def outputs(self, t, q, u, motion, now):
        return {"needle": jnp.sin(3.0 * q["angle"])}


@pytest.mark.slow
def test_a_rejected_step_in_one_trial_does_not_stop_the_other_trials():
    near, far = (Trial(TRIAL.t, {"needle": np.sin(3 * a + 0 * TRIAL.t)}, sigma=0.1) for a in (0.2, 0.25))
    problem = Problem.of(Dial(), [near, far], "inertia", unknown=("angle",), simulation=POSED["simulation"])
    # From here Gauss-Newton solves the first at once, and steps with the second beyond where it began.
    begun = eqx.tree_at(lambda p: p.window_starts, problem.start, jnp.array([[0.19], [0.48]]))
    before = problem.linearize(begun)
    whole = problem.linearize(moved(begun, jnp.zeros(1), eliminate(before.blocks, 0.0)))
    assert whole.costs[0] < 1e-2 * before.costs[0] < before.costs[1] < whole.costs[1]
    point, at = refined(problem, begun, before, steps=1, rtol=1e-2)
    assert at.costs == pytest.approx([whole.costs[0], before.costs[1]])
    point, at = refined(problem, begun, before, steps=20, rtol=1e-12)
    assert at.cost < 1e-6 * before.cost
    assert problem.linearize(point).cost == pytest.approx(at.cost, abs=1e-12)


def test_least_squares_is_the_default_and_signatures_contain_all_options():
    found = fit(Track(), TRIAL, ["gain", "drift"], **POSED)
    assert found.method == "Levenberg-Marquardt"
    options = [f.name for f in dataclasses.fields(ProblemSpec)][2:]
    for function in (fit, Problem.of, fit_bicycle):
        assert set(options) <= inspect.signature(function).parameters.keys()
