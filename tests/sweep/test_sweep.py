"""Many motions at once: each as if it were alone."""

import numpy as np
import pytest
from mechanisms import Bead, Slider

import jaxkane as jk
from jaxkane.catalog import DoublePendulum

TS = np.linspace(0.0, 1.0, 6)


class Ring(Bead):
    """A bead on a ring, with a level at which it ends that must be positive."""

    level: jk.Scalar = jk.parameter(0.3, positive=True)


RING = Ring(level=np.full(6, 0.3))


def starts(n):
    return jk.State(np.tile([0.0, 1.0], (n, 1)), np.linspace(0.1, 0.5, n)[:, None])


@pytest.fixture(scope="module")
def rides():
    return jk.sweep.sweep(RING, starts(6), TS)


@pytest.mark.weekly
def test_input_samples_with_different_times_and_missing_values():
    ts, values = np.array([0.1, 0.4, 0.8]), np.array([1.0, -2.0, 0.5])
    names = {"shoulder_torque": np.outer([1.0, np.nan], np.ones(6))}
    shifted = jk.Samples(np.stack([ts, ts + 0.05]), np.stack([values, -values]))
    rest, pendulum = jk.State([0.3, 0.1], [0.0, 0.0]), DoublePendulum()
    found = jk.sweep.sweep(pendulum, rest, TS, {"elbow_torque": shifted})
    for i in range(2):
        alone = jk.simulate(pendulum, rest, TS, {"elbow_torque": jk.Samples(shifted.ts[i], shifted.values[i])})
        np.testing.assert_allclose(found.q[i], alone.q, atol=1e-12)
    found = jk.sweep.sweep(pendulum, rest, TS, names | {"elbow_torque": jk.Samples(shifted.ts, values)})
    np.testing.assert_array_equal(found.status, [jk.Status.COMPLETED, jk.Status.INVALID])
    with pytest.raises(ValueError, match=r"differ in length: elbow_torque \(3\), times of elbow_torque \(2\)"):
        jk.sweep.sweep(pendulum, rest, TS, {"elbow_torque": jk.Samples(shifted.ts, np.ones((3, 3)))})
    with pytest.raises(ValueError, match="'elbow_torque' is a batch of samples"):
        jk.simulate(pendulum, rest, TS, {"elbow_torque": shifted})


@pytest.mark.slow
def test_a_member_with_an_impossible_body_is_invalid():
    swept = jk.sweep.sweep(Slider(inertia=np.array([0.1, -0.1])), jk.State(np.array([0.0, 0.3]), np.ones(2)), TS)
    np.testing.assert_array_equal(swept.status, [jk.Status.COMPLETED, jk.Status.INVALID])
    assert np.isfinite(swept.q[0]).all()
    assert np.isnan(swept.q[1]).all()


@pytest.mark.weekly
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


def test_invalid_members_do_not_affect_the_others(rides):
    levels, (q, u) = np.full(6, 0.3), (np.array(x) for x in (starts(6).q, starts(6).u))
    levels[1], levels[3] = np.nan, -0.3
    u[4] = 3.0  # this one is soon below
    q[5, 0] = 0.3  # beside the ring
    mixed = jk.sweep.sweep(Ring(level=levels), jk.State(q, u), TS)
    assert mixed.reason == ["completed", "invalid", "completed", "invalid", "low", "invalid"]
    np.testing.assert_allclose(mixed.t_end[4], np.arccos(0.3) / 3.0, atol=1e-7)
    np.testing.assert_allclose(mixed.q[np.array([0, 2])], rides.q[np.array([0, 2])], atol=1e-12)
    assert np.isnan(mixed.q[np.array([1, 3, 5])]).all()
    assert list(mixed.stats["steps"][:3:2]) == list(rides.stats["steps"][:3:2])  # not slowed
    assert int(mixed.stats["steps"][1]) < 40  # nor does it keep anybody waiting


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match="no argument is a batch"):
        jk.sweep.sweep(Ring(), jk.State(np.array([0.0, 1.0]), np.zeros(1)), TS)
    with pytest.raises(ValueError, match=r"differ in length: level \(3\), state.q \(5\)"):
        jk.sweep.sweep(Ring(level=np.full(3, 0.3)), starts(5), TS)
    with pytest.raises(ValueError, match=r"input 'push' of a sweep .* got the shape \(5, 4\)"):
        jk.sweep.sweep(Ring(), starts(5), TS, {"push": np.zeros((5, 4))})
    with pytest.raises(ValueError, match="no input named brake"):
        jk.sweep.sweep(Ring(), starts(5), TS, {"brake": np.zeros((5, 1))})


@pytest.mark.weekly
def test_a_member_has_the_discontinuities_of_its_input():
    """So that its audit integrates the work from jump to jump."""
    rtol, ts = 1e-6, np.linspace(0.0, 1.0, 41)
    torque = jk.Samples(np.linspace(0.0, 1.0, 6), np.random.default_rng(2).normal(size=6), zero_order_hold=True)
    state = jk.State(np.array([0.5, -0.2]), np.linspace(0.0, 1.0, 4).reshape(2, 2))
    rides = jk.sweep.sweep(DoublePendulum(), state, ts, {"elbow_torque": torque})
    assert jk.audit(DoublePendulum(), rides.member(1)).energy_balance < rtol
