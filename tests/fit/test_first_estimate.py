"""Accelerations from measurements, and first estimates of bodies by linear least squares."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from swings import FREE, Swing, random_samples, swings

import jaxkane as jk
from jaxkane.fit import Inertia, Trial, first_estimate, regressor
from jaxkane.fit.inverse.kinematics import kinematic_samples, max_spacing
from jaxkane.fit.problem.specification import parameters_of
from jaxkane.fit.result.diagnostics import describe_bodies
from jaxkane.joints import Actuator, Link, hinge, mechanism


def test_accelerations_of_noisy_samples():
    """Of sin 3t with noise: the smoothest spline within sigma. Gaps, and a spacing around them, are left out."""
    t, rng = np.linspace(0.0, 4.0, 401), np.random.default_rng(0)
    y = np.sin(3 * t) + 1e-3 * rng.standard_normal(401)
    y[100:140] = np.nan
    trial = Trial(t, {"angle1": y, "angle2": np.cos(t)}, {"torque1": t}, sigma=1e-3)
    assert 0.2 < float(max_spacing(trial, trial.measured)) < 0.6
    found = kinematic_samples(Swing(), trial, spacing=0.3)
    inside = (found.t > 0.5) & (found.t < 3.5)
    assert np.max(np.abs(found.u_dot[inside, 0] + 9 * np.sin(3 * found.t[inside]))) < 0.6  # of 9
    assert np.max(np.abs(found.u[inside, 0] - 3 * np.cos(3 * found.t[inside]))) < 0.02
    assert not np.any((found.t > 0.70) & (found.t < 1.69))
    assert len(found) > 150
    np.testing.assert_allclose(found.inputs["torque1"], found.t, atol=1e-9)
    two = kinematic_samples(Swing(), [trial, trial], spacing=0.2)
    assert set(two.trial) == {0, 1}


@pytest.mark.weekly
def test_first_guess_of_a_measured_double_pendulum():
    """Free swings: ratios of four base parameters of its makers' estimates within 3 %; friction has its sign."""
    recording = jk.data.multi_arm_pendulum(2)
    authors = recording.parameters
    guess = first_estimate(Swing(I2=3e-3), recording.trials[:8], FREE, spacing=0.025)
    assert guess.ok
    assert guess.base.ratios_only
    assert guess.base.count == 5
    ratios = guess.base.estimates[:4] / guess.base.estimates[0]
    m1, a1, I1, m2, a2, I2, L1 = (authors[name] for name in ("m1", "a1", "I1", "m2", "a2", "I2", "L1"))
    expected = np.array([I1 + m1 * a1**2 + m2 * L1**2, m1 * a1 + m2 * L1, I2 + m2 * a2**2, m2 * a2])
    np.testing.assert_allclose(ratios, expected / expected[0], rtol=0.03)
    assert guess.system.k1 > 0
    assert guess.system.k2 > 0
    assert guess.values["I2"] == guess.system.I2
    np.testing.assert_allclose(guess.feasible, guess.base.estimates, rtol=1e-3)
    assert "standard deviations from these" in str(guess)


@pytest.mark.weekly
def test_estimated_bodies_are_physically_consistent():
    """Torques that ask for a negative moment of inertia: what is returned has a positive pseudo-inertia."""
    ball = mechanism(
        [
            Link("base", joints=hinge("q0", (1, 0, 0)), mass=1.0, inertia=(0.02, 0.02, 0.02)),
            Link("bob", "base", hinge("q1", (0, 0, 1)), mass=1.0, center=(0.1, 0.02, 0.03),
                 inertia=((0.02, 0.001, 0.002), (0.001, 0.025, 0.003), (0.002, 0.003, 0.03))),
        ],
        actuators=[Actuator("tau0", "q0"), Actuator("tau1", "q1")],
    )  # fmt: skip
    exact = random_samples(ball, 40)
    body = Inertia.of(ball, "bob")
    assert (body.mass, body.center[0], body.moments[2]) == ("mass.bob", "center.bob.x", "inertia.bob.zz")
    same = first_estimate(ball, exact, body)
    assert same.ok
    assert same.values["inertia.bob.zz"] == pytest.approx(0.03, rel=1e-6)
    column = jax.jit(jax.vmap(lambda *x: regressor(ball, 0.0, *x, bodies={"bob": "Izz"}).matrix[:, 0]))(
        *map(jnp.asarray, (exact.q, exact.u, exact.u_dot))
    )
    asked = {name: x - 0.06 * column[:, i] for i, (name, x) in enumerate(exact.inputs.items())}
    guess = first_estimate(ball, dataclasses.replace(exact, inputs=asked), body)
    assert guess.base.estimates[list(guess.base.texts).index("bob.Izz")] == pytest.approx(0.0404 - 0.06)
    xx, yy, zz, xy, xz, yz = (guess.values[f"inertia.bob.{ij}"] for ij in ("xx", "yy", "zz", "xy", "xz", "yz"))
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    assert 0 < moments[0] < moments[2] < moments[0] + moments[1]
    assert not guess.ok
    assert guess.distance > 3
    assert not guess.infeasibility
    assert "kg, centre at (" in guess.bodies[0]
    assert f"principal moments {moments[0]:.5g}, {moments[1]:.5g}, {moments[2]:.5g} kg m^2, along (" in str(guess)
    jk.accelerations(guess.system, 0.0, exact.q[0], exact.u[0])  # which refuses bodies that cannot be


@pytest.mark.weekly
def test_first_estimate_with_an_initial_mass_centre_at_the_joint():
    """There the moment of inertia about the joint does not change with it, and elsewhere it does."""
    truth, at = swings()
    start = dataclasses.replace(truth, a2=0.0)
    guess = first_estimate(start, at, ("a2", "k2"))
    assert guess.values["a2"] == pytest.approx(float(truth.a2), rel=1e-6)
    assert guess.ok


@pytest.mark.slow
def test_first_estimate_rejects_parameters_that_are_not_linear_or_unknown():
    _, at = swings()
    for free, said in (
        ("L1", "linear in L1, which changes lengths"),
        (jk.fit.Gain("torque1"), "gain of torque1"),
        ("k9", "no parameter"),
    ):
        with pytest.raises(ValueError, match=said):
            first_estimate(Swing(), at, free)


def test_spline_knots_are_not_closer_than_samples():
    """Each finer spacing explains more of a blow, down to one at which every interval would be a gap."""
    t = np.linspace(0.0, 1.0, 101)
    torque, rate = np.where((t > 0.5) & (t < 0.52), 16.0, 0.0), np.where(t < 0.51, 0.0, 6.3)
    angle = np.concatenate([[0.0], np.cumsum(0.01 * (rate[1:] + rate[:-1]) / 2)])
    measured = {"angle1": angle, "angle2": 0.1 * angle, "rate1": rate}
    guess = first_estimate(Swing(), Trial(t, measured, {"torque1": torque}, sigma=0.01), ("k1", "k2"))
    assert guess.spacing >= 0.02


def test_inertia_of_a_body_by_its_name():
    found = Inertia.of(jk.catalog.WhippleBicycle.benchmark(), "front wheel", fixed=("mF",))
    assert found == Inertia(moments=("IFxx", "IFyy", "IFxx"), mass="mF", fixed=("mF",))
    with pytest.raises(ValueError, match="Ixx, Iyy, Izz of 'link1' are not separate parameters"):
        Inertia.of(jk.catalog.DoublePendulum(), "link1")
    with pytest.raises(KeyError, match="link1"):
        Inertia.of(jk.catalog.DoublePendulum(), "link7")


def test_a_free_inertia_is_reported_as_one_body():
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    parameters = parameters_of(bicycle, (jk.fit.frame_inertia("H"), "mB", jk.fit.frame_inertia("F", fixed=())))
    fork, wheel = describe_bodies(parameters, parameters.start * 0.0)
    xx, zz, xz = (float(getattr(bicycle, name)) for name in ("IHxx", "IHzz", "IHxz"))
    small, large = np.linalg.eigvalsh([[xx, xz], [xz, zz]])
    assert f"principal moments {small:.5g}, 0.06, {large:.5g} kg m^2, along (" in fork
    assert fork.startswith("body of xH, zH, IHxx, IHyy, IHzz, IHxz: centre at (0.9, 0, -0.7) m")
    assert wheel == "body of mF, IFxx, IFyy: 3 kg, principal moments 0.1405, 0.1405, 0.28 kg m^2"
