"""Many motions at once: each as if it were alone."""

import dataclasses

import numpy as np
import pytest

import jaxkane as jk
import jaxkane.sweep._solve as solving
from jaxkane.catalog import DoublePendulum, WhippleBicycle

BIKE = WhippleBicycle.benchmark()
TS = np.linspace(0.0, 1.0, 6)


def starts(n):
    u = np.stack([np.linspace(0.1, 0.5, n), np.linspace(-15.0, -20.0, n), np.zeros(n)], axis=1)
    return jk.State(np.zeros(8), u)


@pytest.fixture(scope="module")
def rides():
    return jk.sweep.sweep(BIKE, starts(6), TS)


def test_members_move_as_if_alone(rides):
    state = starts(6)
    assert rides.q.shape == (6, 6, 8)
    assert rides["roll"].shape == (6, 6)
    for i in (0, 5):
        alone = jk.simulate(BIKE, jk.State(state.q, state.u[i]), TS)
        np.testing.assert_allclose(rides.q[i], alone.q, atol=1e-12)
        assert int(rides.stats["steps"][i]) == int(alone.stats["steps"])
        for end in (rides.trajectory.end, rides.member(i).end):
            q = end.q if end.q.ndim == 1 else end.q[i]
            np.testing.assert_allclose(q, alone.end.q, atol=1e-12)


@pytest.mark.slow
def test_parameters_states_and_inputs_together_and_in_chunks():
    n = 70
    pendulums = DoublePendulum(mass=np.linspace(1.0, 2.0, n), length=1.0)
    state = jk.State(np.array([0.5, -0.2]), np.linspace(0.0, 1.0, 2 * n).reshape(n, 2))
    inputs = {
        "shoulder_torque": np.linspace(0.0, 1.0, n)[:, None],
        "elbow_torque": np.outer(np.linspace(0.0, 1.0, n), np.asarray(TS)),
    }
    whole = jk.sweep.sweep(pendulums, state, TS, inputs)
    parts = jk.sweep.sweep(pendulums, state, TS, inputs, chunk=32)
    assert whole.q.shape == (n, 6, 2)
    np.testing.assert_array_equal(whole.q, parts.q)
    i = 69
    alone = jk.simulate(
        DoublePendulum(mass=2.0, length=1.0),
        jk.State(state.q, state.u[i]),
        TS,
        {"shoulder_torque": inputs["shoulder_torque"][i, 0], "elbow_torque": inputs["elbow_torque"][i]},
    )
    np.testing.assert_allclose(whole.q[i], alone.q, atol=1e-12)


def test_bad_members_keep_to_themselves(rides):
    n = 6
    good = starts(n)
    masses = np.full(n, 85.0)
    masses[1], masses[3] = np.nan, -85.0
    u = np.array(good.u)
    u[4] = [3.0, -2.0, 0.0]  # this one falls
    q = np.zeros((n, 8))
    q[5, 4] = 0.3  # a pitch that lifts the front wheel
    bikes = dataclasses.replace(BIKE, mB=masses)
    mixed = jk.sweep.sweep(bikes, jk.State(q, u), TS)
    reasons = mixed.reason
    assert reasons[:4] == ["completed", "invalid", "completed", "invalid"]
    assert reasons[4] in ("fell over", "singular speeds")
    assert reasons[5] == "invalid"
    np.testing.assert_allclose(mixed.q[np.array([0, 2])], rides.q[np.array([0, 2])], atol=1e-12)
    assert np.isnan(mixed.q[np.array([1, 3, 5])]).all()
    assert list(mixed.stats["steps"][:3:2]) == list(rides.stats["steps"][:3:2])  # not slowed
    assert int(mixed.stats["steps"][1]) < 40  # nor does it keep anybody waiting


def test_what_is_refused():
    with pytest.raises(ValueError, match="nothing here is a batch"):
        jk.sweep.sweep(BIKE, jk.State(np.zeros(8), np.zeros(3)), TS)
    with pytest.raises(ValueError, match=r"differ in length: mB \(3\), state.u \(5\)"):
        jk.sweep.sweep(dataclasses.replace(BIKE, mB=np.full(3, 85.0)), starts(5), TS)
    with pytest.raises(ValueError, match=r"input 'steer_torque' of a sweep .* got the shape \(5, 4\)"):
        jk.sweep.sweep(BIKE, starts(5), TS, {"steer_torque": np.zeros((5, 4))})
    with pytest.raises(ValueError, match="no input named brake"):
        jk.sweep.sweep(BIKE, starts(5), TS, {"brake": np.zeros((5, 1))})


def test_an_interrupted_sweep_keeps_what_is_done(monkeypatch):
    calls = []
    original = solving._solve

    def interrupted(*args):
        calls.append(1)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(solving, "_solve", interrupted)
    state = jk.State(np.array([0.5, -0.2]), np.linspace(0.0, 1.0, 140).reshape(70, 2))
    rides = jk.sweep.sweep(DoublePendulum(mass=1.0, length=1.0), state, TS, chunk=32)
    assert rides.reason[0] == "completed"
    assert rides.reason[-1] == "interrupted"
    assert rides.q.shape == (70, 6, 2)
    assert np.isfinite(rides.q[:32]).all()
    assert np.isnan(rides.q[32:]).all()
