"""Plans as trajectories, guesses, inputs of simulations and reports; phases; mesh refinement."""

import copy
import dataclasses
import pickle

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from mechanisms import RodOnPin, Sled

import jaxkane as jk
from jaxkane.collocation import Phases, Problem, continuation, solve
from jaxkane.fit.inverse.kinematics import kinematic_samples

pytest.importorskip("casadi")

mpl.use("Agg")
ENDS = {"start": {"x": 0.0, "v": 0.0}, "end": {"x": 1.0, "v": 0.0}}
SLED = Sled(drag=0.5)


def effort(t, now):
    return now["force"] ** 2


@pytest.fixture(scope="module")
def plan():
    return solve(Problem(SLED, 2.0, controls=["force"], cost=effort, **ENDS), intervals=10)


@pytest.fixture(scope="module")
def joined():
    """Two phases of 1 s, which are the same motion."""
    phases = [
        Problem(SLED, 1.0, controls=["force"], cost=effort, start=ENDS["start"]),
        Problem(SLED, 1.0, controls=["force"], cost=effort, end=ENDS["end"]),
    ]
    return solve(Phases(phases, [None]), intervals=5)


def test_functions_of_trajectories_accept_plans(plan, joined):
    for each in (plan, joined):
        np.testing.assert_allclose(jk.positions(SLED, each)["sled"][:, 0], each["x"], atol=1e-14)
        np.testing.assert_allclose(jk.velocities(SLED, each)["sled"][:, 0], each["v"], atol=1e-14)
        rates = jk.speed_rates(SLED, each)["v"]
        np.testing.assert_allclose(rates, each["force"] - 0.5 * each["v"], atol=1e-13)
        panel = jk.plot.trajectories(each, ["x", ("v", "force")])[0]
        np.testing.assert_array_equal(panel.lines[0].get_ydata(), each["x"])
        assert "Sled" in jk.animate(SLED, each).html()
    assert jk.audit(SLED, plan).energy_balance < 2e-3  # the forces between the nodes are interpolated linearly
    with pytest.raises(ValueError, match="the times must increase"):
        jk.audit(SLED, joined)
    samples = kinematic_samples(SLED, plan)
    forces = np.interp(samples.t, plan.t, plan["force"])
    np.testing.assert_allclose(samples.u_dot[:, 0], forces - 0.5 * samples.u[:, 0], atol=0.01)


def test_plans_of_other_systems_are_refused(plan):
    other = RodOnPin(length=1.0)
    for function in (jk.positions, jk.audit, jk.animate):
        with pytest.raises(ValueError, match="belongs to another system"):
            function(other, plan)
    with pytest.raises(TypeError, match="Pass only the system and the trajectory"):
        jk.positions(SLED, plan, plan.q)


@pytest.mark.weekly
def test_polynomials_between_the_nodes(plan):
    """`at`, `inputs` and the trajectory agree at the nodes; `replay` reproduces the plan there, and with the accuracy
    of a parabola elsewhere."""
    found = plan.at(plan.t)
    for name in ("x", "v", "force"):
        np.testing.assert_allclose(found[name], plan[name], atol=1e-12)
    ts = jnp.linspace(0.0, 2.0, 41)
    ride = plan.replay(ts)
    np.testing.assert_allclose(ride["x"], plan.at(ts)["x"], atol=2e-4)
    np.testing.assert_allclose(ride["force"], plan.at(ts)["force"], atol=1e-12)
    assert plan.deviation(plan.replay()) < 2e-6
    simulated = jk.simulate(plan.system, plan.state(0), ts, plan.inputs, rtol=1e-10, atol=1e-10)
    assert float(simulated["x"][-1]) == pytest.approx(1.0, abs=2e-6)
    with pytest.raises(ValueError, match="times from 0 to 2 s"):
        plan.at([2.1])
    with pytest.raises(ValueError, match="must have the 21 times"):
        plan.deviation(ride)
    with pytest.raises(KeyError, match="There is no 'force_x'"):
        plan["force_x"]


def test_two_phases_equal_one_phase(plan, joined):
    rtol = 1e-6
    assert joined.ok
    assert joined.cost == pytest.approx(plan.cost, rel=rtol)
    assert joined.duration == 2.0
    assert len(joined.mesh) == len(joined.errors) + 1 == 11
    assert "10 intervals" in repr(joined)
    np.testing.assert_allclose(np.delete(np.asarray(joined.t), 10), np.asarray(plan.t), atol=1e-12)
    np.testing.assert_allclose(np.delete(np.asarray(joined["x"]), 10), np.asarray(plan["x"]), atol=1e-6)
    slope = joined.multipliers["phase 1: x"][-1]
    assert slope == pytest.approx(plan.multipliers["x"][-1], rel=1e-4)
    assert joined.multipliers["phase 0: link 0: x"] == pytest.approx(-slope, rel=1e-4)  # of first - last
    assert "phase 1" in joined.report()
    for call in (joined.replay, lambda: joined.at([0.0]), lambda: joined.inputs, lambda: joined.deviation(joined)):
        with pytest.raises(ValueError, match="the plan has 2 phases"):
            call()


class Barge(jk.System):
    """A point of 2 kg with its own names."""

    coordinates, speeds, inputs = ("place",), ("speed",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(2.0, 0.0, O.moving(q["place"] * N.x, u["speed"] * N.x), N, name="barge")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["push"] * motion.N.x, motion["barge"])


@pytest.mark.slow
def test_phases_of_different_systems():
    """A sled of 1 kg becomes a barge of 2 kg at 0.5 m, and keeps its momentum. By 1 N the sled has 1 m/s there, after
    1 s. The barge has 0.5 m/s, and -1 N stop it within 1 s and 0.25 m."""
    fast = {"force": (0.0, 1.0)}
    sled = Problem(Sled(), (0.2, 3.0), controls=fast, final_cost=lambda t, now: t, start=ENDS["start"])
    barge = Problem(
        Barge(), (0.2, 3.0), controls={"push": (-1.0, 0.0)}, final_cost=lambda t, now: t,
        end={"place": 0.75, "speed": 0.0},
    )  # fmt: skip

    def link(last, first):
        return {
            "place": first["place"] - last["x"],
            "momentum": 2.0 * first["speed"] - last["v"],
            "at": last["x"] - 0.5,
        }

    plan = solve(Phases([sled, barge], [link]), intervals=4, tolerance=None)
    assert plan.ok, plan.reason
    assert [phase.duration for phase in plan.phases] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert plan.trajectory is None
    assert plan.multipliers["phase 0: at"] != 0
    for wrong in (lambda: plan["x"], lambda: plan.t, lambda: plan.state()):
        with pytest.raises(ValueError, match="the phases have different states"):
            wrong()
    with pytest.raises(TypeError, match="must be a Trajectory"):
        jk.animate(Barge(), plan)
    assert jk.positions(Barge(), plan.phases[1])["barge"].shape == (9, 3)


@pytest.mark.slow
def test_plans_as_guesses(plan, joined):
    """A plan needs no iterations for its own problem, also if it has phases."""
    assert solve(plan.problem, plan, intervals=10).iterations <= 1
    assert solve(plan.problem, joined, intervals=10).cost == pytest.approx(plan.cost, rel=1e-6)
    phases = Phases([part.problem for part in joined.phases], [None])
    assert solve(phases, joined, intervals=5).iterations <= 1
    ride = plan.replay()
    assert solve(plan.problem, [None, ride, {"force": 0.3}], intervals=10, tolerance=None).starts[1][1] == "solved"
    assert len(solve(plan.problem, starts=3, intervals=10, tolerance=None).starts) == 3


def test_continuation():
    """The energy of a mass m is 12 m^2."""
    masses = [1.0, 2.0, 4.0]
    plans = continuation(
        lambda mass: Problem(Sled(mass=mass), 1.0, controls=["force"], cost=effort, **ENDS), masses, intervals=5
    )
    np.testing.assert_allclose([plan.cost for plan in plans], 12 * np.square(masses), rtol=1e-8)
    limited = continuation(
        lambda limit: Problem(Sled(), 1.0, controls={"force": (-limit, limit)}, cost=effort, **ENDS), [8.0, 1.0, 0.5],
        intervals=4,
    )  # fmt: skip
    assert [plan.ok for plan in limited] == [True, False]


class WithWall(Sled):
    def events(self, t, q, u):
        return {"wall": jk.rising(q["x"] - 0.5, then={"v": -0.5 * u["v"]}), "gate": jk.rising(q["x"] - 0.3)}


def test_a_plan_through_an_event_that_changes_the_state_is_not_ok():
    problem = Problem(WithWall(), 2.0, controls=["force"], cost=effort, **ENDS)
    through = solve(problem, intervals=10)
    assert not through.ok
    assert "'wall' changes the state" in through.reason
    assert solve(dataclasses.replace(problem, end={"x": 0.5, "v": 1.0}), intervals=10).ok  # it ends at the event


def test_conditions_may_share_names_with_variables():
    plan = solve(
        Problem(
            Sled(), 1.0, controls=["force"], cost=effort, start=ENDS["start"],
            conditions=lambda first, last, duration: {"x": last["x"] - 1.0, "v": last["v"] - first["v"]},
            path=lambda t, now: {"v": 1.45 - now["v"]},
        ),
        intervals=4, tolerance=None,
    )  # fmt: skip
    assert plan.multipliers["x"].shape == plan["x"].shape
    assert plan.multipliers["x"][0] == pytest.approx(-plan.multipliers["conditions: x"], rel=1e-6)
    assert plan.multipliers["path: v"].shape == plan["v"].shape
    assert list(plan.multipliers) == ["x", "v", "force", "path: v", "conditions: x", "conditions: v"]


def test_copies_of_plans(plan):
    """A plan whose functions have names can be pickled."""
    for other in (copy.deepcopy(plan), pickle.loads(pickle.dumps(plan))):
        np.testing.assert_array_equal(other["x"], plan["x"])
        assert other.cost == plan.cost
        assert other.multipliers["x"][-1] == plan.multipliers["x"][-1]


@pytest.mark.weekly
def test_refinement_stays_within_its_limits():
    """Of a spring so stiff that the first mesh is far too coarse."""
    stiff = Problem(Sled(stiffness=4e4), 1.0, controls=[], start={"x": 1.0, "v": 0.0})
    plan = solve(stiff, intervals=4, max_intervals=60)
    assert not plan.ok
    assert plan.reason.startswith("solved, but the local error is ")
    assert len(plan.mesh) - 1 <= 60
    fine = solve(stiff, intervals=4)
    assert fine.ok
    assert np.max(fine.errors) <= 1e-6
    assert float(fine["x"][-1]) == pytest.approx(np.cos(200.0), abs=1e-3)


def test_a_guess_is_clipped_to_ends_and_bounds(plan):
    """The energy of a shorter motion, 12 N^2 s at a mass of 1 kg; the guess does not change it."""
    rtol = 1e-6
    problem = Problem(Sled(), 1.0, controls=["force"], cost=effort, within={"v": (-3.0, 3.0)}, **ENDS)
    names = lambda found: [note.partition(": ")[2] for note in found.notes]  # noqa: E731
    for guess, clipped in (
        ({"x": [0.0, 0.5, 1.0]}, []), ({"x": 0.5, "v": 9.0, "duration": 3.0}, ["x, v, duration"]), (plan, []),
    ):  # fmt: skip
        found = solve(problem, guess, intervals=10, tolerance=None)
        assert found.cost == pytest.approx(12.0, rel=rtol)
        assert names(found) == clipped
        assert all(note in repr(found) for note in found.notes)
    changed = dataclasses.replace(problem, start={"x": 0.5, "v": 0.0})
    assert names(solve(changed, plan, tolerance=None)) == ["x"]
