"""The audit: energy balance of every entry, its quadrature error, and its reports of faults."""

import dataclasses

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from mechanisms import Bead, Sled
from test_events import TOP, Particle
from test_laws_of_simulations import Bead as OnParabola

import jaxkane as jk
from jaxkane.catalog import CATALOG

RTOL = 1e-8
matplotlib.use("agg")


def run(name, end=10.0, times=1001, inputs=None, **options):
    entry = CATALOG[name]
    system, state = entry.example(), jk.State(jnp.array(entry.q), jnp.array(entry.u))
    return system, jk.simulate(system, state, jnp.linspace(0.0, end, times), inputs, **options)


@pytest.mark.weekly
@pytest.mark.parametrize("name", [name for name in CATALOG if name not in ("BarWithPiston", "KerbWheel")])
def test_energy_balance_of_ten_seconds(name):
    # Conservative or not: the audit counts the work of dampers, and of the motors of Example 5's engines.
    # Jumps accumulate. The accelerations of the wheel are discontinuous at the edge, so the energy has its own test.
    ends = {"BouncingBall": 3.0, "RockingBlock": 3.0, "SliderCrankWithClearance": 0.024, "Woodpecker": 0.7}
    end = ends.get(name, 10.0)
    times = 2001 if name == "Woodpecker" else 1001  # the work between its many impacts is a sum over samples
    audit = jk.audit(*run(name, end, times, rtol=1e-10, atol=1e-10))
    assert audit.energy_balance < RTOL
    assert audit.work_error < RTOL * audit.kinetic_energy.max()
    assert audit.ok
    assert audit.reason == "completed"
    assert audit.drift < RTOL


@pytest.mark.weekly
def test_unresolved_work_between_samples_does_not_fail_the_audit():
    # Exercise 5.1 comes to rest within a second: 100 times a second are too few for the damper's work.
    audit = jk.audit(*run("BarWithPiston", rtol=1e-10, atol=1e-10))
    assert audit.energy_balance > RTOL
    assert np.abs(audit.energy_error).max() < 3 * audit.work_error
    assert "save more times" in str(audit)
    # In the same program: as many times in a quarter of the time.
    assert jk.audit(*run("BarWithPiston", end=2.5, rtol=1e-10, atol=1e-10)).energy_balance < RTOL


@pytest.mark.weekly
def test_the_momenta_of_a_free_body_are_conserved():
    audit = jk.audit(*run("RigidBody", 2.0, 21))
    text = str(audit)
    assert text.count("conserved\n") == 2
    assert "configuration" in text  # the norm of the Euler parameters
    np.testing.assert_allclose(audit.angular_momentum, audit.angular_momentum[:1].repeat(21, 0), atol=1e-6)


def test_an_inaccurate_simulation_fails_the_audit():
    audit = jk.audit(*run("DoublePendulum", 2.0, 11, rtol=1e-2, atol=1e-2, max_step=1.0))
    assert not audit.ok
    assert "bad" in str(audit)


@pytest.mark.weekly
def test_the_audit_reports_the_conditioning_of_the_bicycle():
    system, ride = run("WhippleBicycle", 1.0, 11)
    audit = jk.audit(system, ride)
    M = jk.mass_matrix(system, 0.0, ride.q[0], ride.u[0])
    size = np.sqrt(np.diag(M))
    np.testing.assert_allclose(audit.condition_M[0], np.linalg.cond(M / np.outer(size, size)), rtol=1e-10)
    assert audit.velocity_residuals.shape == (11, 3)
    assert 1 < audit.condition_C_dep.max() < 10
    assert jk.plot.audit(audit).shape == (2, 2)


@pytest.mark.slow
def test_a_simulation_that_ended_early_is_audited_up_to_its_end():
    ts = jnp.linspace(0.0, 2.0, 11)
    audit = jk.audit(Bead(), jk.simulate(Bead(), jk.State(TOP, jnp.ones(1)), ts))
    np.testing.assert_array_equal(audit.t, ts[np.cos(ts) > 0.3])  # until y = 0.3 on the circle of 1 m
    assert "low" in str(audit)
    assert audit.energy_balance < 1e-7


@pytest.mark.parametrize("place", [0, 3, -1])
def test_non_finite_samples_within_the_trajectory_raise(place):
    ride = jk.simulate(Bead(), jk.State([0.0, 1.0], [0.1]), np.linspace(0.0, 1.0, 6))
    for name in ("q", "u"):
        spoilt = dataclasses.replace(ride, **{name: getattr(ride, name).at[place, 0].set(jnp.nan)})
        with pytest.raises(ValueError, match="not finite at"):
            jk.audit(Bead(), spoilt)


KNOTS = np.linspace(0.0, 2.0, 21)
TORQUE = jk.Samples(KNOTS, np.random.default_rng(5).normal(size=21), zero_order_hold=True)


@pytest.mark.parametrize(
    "torque",
    [
        TORQUE,
        pytest.param(jk.Samples(KNOTS, TORQUE.values), marks=pytest.mark.weekly),
        pytest.param(jk.Samples(KNOTS + 0.0334, TORQUE.values, zero_order_hold=True), marks=pytest.mark.weekly),
        pytest.param(lambda t, s: TORQUE(t - 0.05) - 0.3 * s["theta1_dot"], marks=pytest.mark.weekly),
    ],
    ids=["held", "linear", "between the times", "in a function"],
)
def test_the_work_of_discontinuous_inputs_is_integrated_accurately(torque):
    rtol = 2e-7
    audit = jk.audit(*run("DoublePendulum", 2.0, 201, {"shoulder_torque": torque}, rtol=1e-11, atol=1e-11))
    assert audit.ok
    assert np.abs(audit.work).max() > 0.1
    assert audit.energy_balance < rtol
    assert audit.work_error < 10 * rtol * np.abs(audit.work).max()


@pytest.mark.slow
@pytest.mark.parametrize("times", [21, 2])
def test_an_undeclared_input_jump_does_not_fail_the_audit(times):
    """A function may jump where it likes: two orders of quadrature agree about that, half of the times does not."""
    system, start = Particle(gravity=0.1, ends="none"), jk.State(np.ones(1), np.zeros(1))
    drive = {"drive": lambda t, state: jnp.where(t > 1.03, 1.0, -1.0) * (1.0 - state["h"])}
    audit = jk.audit(system, jk.simulate(system, start, np.linspace(0.0, 2.0, times), drive))
    assert audit.ok
    assert 10 * audit.work_error > np.abs(audit.energy_error).max() > 1e-4


OSCILLATOR = Sled(1.0, 0.4, 400.0)  # 3.2 periods in a second, damped


@pytest.mark.weekly
@pytest.mark.parametrize("times", [2, 5, 33])
def test_work_between_too_few_samples_has_a_large_reported_error(times):
    """With 33 samples in 10 s, a sample a period, all rules of quadrature agree to 4e-8 and are wrong."""
    start = jk.State([0.1], [0.0])
    audit = jk.audit(OSCILLATOR, jk.simulate(OSCILLATOR, start, np.linspace(0.0, 10.0, times), rtol=1e-9, atol=1e-9))
    assert audit.ok
    assert 2 * audit.work_error > np.abs(audit.energy_error).max() > 1.0


@pytest.mark.slow
def test_verdicts_do_not_depend_on_the_units():
    """Lengths of 1e-6 to 1e6 m and times of 1e-12 s; a loop that is open by one per cent is found in all units."""
    tables = []
    for length, time in ((1.0, 1.0), (1e6, 1.0), (1e-6, 1e3), (1.0, 1e-12)):
        system = OnParabola(1.0, 1.0 / length, 9.81 * length / time**2)
        start = jk.State([0.6 * length, 0.18 * length], [0.5 * length / time])
        ts = np.linspace(0.0, time, 21)
        ride = jk.simulate(system, start, ts, rtol=1e-8, atol=1e-8 * length * min(1.0, 1.0 / time))
        audit = jk.audit(system, ride)
        assert audit.ok, audit
        tables.append([line for line in audit.lines() if line[0] in ("configuration", "velocity constraints")])
        open_loop = jk.audit(system, dataclasses.replace(ride, q=1.01 * ride.q))
        assert [verdict for what, _, verdict in open_loop.lines() if what == "configuration"] == ["bad"]
    for table in tables:
        assert [verdict for *_, verdict in table] == ["ok", "ok"]


def test_a_batch_is_refused():
    system, swing = run("DoublePendulum", 1.0, 11)
    batch = jk.Trajectory(**{f: getattr(swing, f) for f in swing.__dataclass_fields__} | {"t": swing.t[None]})
    with pytest.raises(ValueError, match="one member"):
        jk.audit(system, batch)


@pytest.mark.slow
def test_reflected_inertias_do_not_contribute_to_the_momentum():
    """A free chain with geared motors conserves the angular momentum of its links."""
    bar = {"mass": 2.0, "center": (0.0, 0.0, -0.2), "inertia": (0.03, 0.03, 0.002)}
    chain = [
        jk.joints.Link("a", None, jk.joints.free("root"), **bar),
        jk.joints.Link("b", "a", jk.joints.hinge("h", (0, 1, 0), armature=0.2, stiffness=3.0), (0, 0, -0.4), **bar),
    ]
    system = jk.joints.mechanism(chain, gravity=(0, 0, 0))
    start = jk.assemble(system, {"h": 0.7}, {"root_w1": 1.0, "root_w2": -0.5, "h_rate": 2.0})
    audit = jk.audit(system, jk.simulate(system, start, np.linspace(0.0, 0.5, 41), rtol=1e-10, atol=1e-10))
    np.testing.assert_allclose(audit.angular_momentum, audit.angular_momentum[:1].repeat(41, 0), atol=1e-8)
    assert np.ptp(audit.kinetic_energy) > 0.01
    assert audit.energy_balance < 1e-7  # their kinetic energy is counted
