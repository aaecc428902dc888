"""The bicycle of Example 7 against the literature, independent programs, and the book's misprints."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle, read_bicycle_file

DATA = Path(__file__).parents[1] / "data"
BIKE = WhippleBicycle.benchmark()
Q = ("phi", "thetaR", "delta", "psi", "theta", "thetaF", "x", "y")  # the book's letters for our coordinates


def load(name):
    return json.loads((DATA / name).read_text())


@jax.jit
def everything(bicycle, q, u, inputs):
    at = (bicycle, 0.0, q, u)
    return (jk.dependent_speeds(*at), jk.accelerations(*at, inputs), jk.dependent_accelerations(*at, inputs))


@pytest.mark.parametrize("i", range(8))
def test_accelerations_agree_with_three_independent_programs(i):
    """`whipple_nonlinear.json`: SymBRiM, PyDy and Moore's equations, to 2e-14 of each other."""
    rtol = 1e-12
    oracle = load("whipple_nonlinear.json")
    s = oracle["states"][i]
    q = jnp.array([s["q"][name] for name in Q])
    u = jnp.array([s["u_ind"][name] for name in ("phi_dot", "thetaR_dot", "delta_dot")])
    torques = [float(s["torque"][name]) for name in ("T_phi", "T_A", "T_delta")]
    bicycle = WhippleBicycle.from_parameters(oracle["parameters"])
    found = everything(bicycle, q, u, dict(zip(bicycle.inputs, torques, strict=True)))
    expected = (
        [s["u_dep"][name] for name in ("psi_dot", "theta_dot", "thetaF_dot")],
        [s["udot_ind"][name] for name in ("phi_ddot", "thetaR_ddot", "delta_ddot")],
        [s["udot_dep"][name] for name in ("psi_ddot", "theta_ddot", "thetaF_ddot")],
    )
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.abs(y).max())


@pytest.mark.slow
@pytest.mark.optimized
@pytest.mark.published
def test_accelerations_agree_with_the_nonlinear_state_of_basu_mandal(published):
    """Table 1, in the book's coordinates."""
    s = load("basu_mandal2007.json")["seed"]
    pitch_from_constraint = jk.assemble(BIKE, {"roll": s["q"]["phi"], "steer": s["q"]["delta"]}).q[4]
    assert abs(float(pitch_from_constraint) - s["q"]["theta"]) < 1e-12
    q = jnp.array([s["q"].get(name, 0.0) for name in Q])
    rates = s["qd_published"]
    u = jnp.array([rates[name] for name in ("phi_dot", "thetaR_dot", "delta_dot")])
    u_dep, u_dot, u_dep_dot = everything(BIKE, q, u, {})
    names = [("psi_dot", "theta_dot", "thetaF_dot"), ("phi_ddot", "thetaR_ddot", "delta_ddot")]
    names += [("psi_ddot", "theta_ddot", "thetaF_ddot")]
    theirs = [(rates | s["qdd_published"])[name] for row in names for name in row]
    source = "Basu-Mandal, Chatterjee, Papadopoulos and Ruina (2007)"
    quantity = "rates and accelerations of the leaning, steered bicycle, Table 1 [rad/s, rad/s^2]"
    published(source, quantity, theirs, np.concatenate([u_dep, u_dot, u_dep_dot]), 1e-11)


def moving_state():
    state = jk.assemble(
        BIKE, {"roll": 0.2, "steer": -0.3, "yaw": 0.5}, {"roll_rate": -0.4, "rear_wheel_rate": -12.0, "steer_rate": 0.9}
    )
    return state.q, state.u


@pytest.mark.slow
def test_J_dot_agrees_with_differences_and_not_with_the_printed_sign():
    """Erratum 1: the book prints C1_dot - C2_dot J; with a plus it agrees with differences of J."""
    q, u = moving_state()
    q_dot = jk.coordinate_rates(BIKE, 0.0, q, u)
    J = jax.jit(lambda q: jk.constraint_jacobian(BIKE, 0.0, q))
    J_dot = jk.constraint_jacobian_rate(BIKE, 0.0, q, u)
    h = 1e-5
    differences = (J(q + h * q_dot) - J(q - h * q_dot)) / (2 * h)
    np.testing.assert_allclose(J_dot, differences, atol=1e-8)

    def C(q):  # [C1 C2] of the front contact's velocity, in the fork's frame as in the book
        residual = lambda u: jnp.stack(BIKE.motion(0.0, list(q), list(u)).constraints)  # noqa: E731
        return jax.jacfwd(residual)(jnp.zeros(6))

    C_now, C_dot = jax.jvp(C, (q,), (q_dot,))
    C2, C1_dot, C2_dot = C_now[:, 3:], C_dot[:, :3], C_dot[:, 3:]
    right = -jnp.linalg.solve(C2, C1_dot + C2_dot @ J(q))
    as_printed = -jnp.linalg.solve(C2, C1_dot - C2_dot @ J(q))
    np.testing.assert_allclose(right, J_dot, atol=1e-12)
    assert np.abs(as_printed - J_dot).max() > 0.1


@pytest.mark.slow
def test_partial_velocities_agree_with_the_book():
    """[WA] of Example 7: the rear wheel's partial angular velocities, with the dependent speeds eliminated."""
    q, u = moving_state()
    _, W = jk.partial_velocities(BIKE, 0.0, q, u)
    J = np.asarray(jk.constraint_jacobian(BIKE, 0.0, q))
    roll, _, _, _, pitch = np.asarray(q)[:5]
    (Sf, St), (Cf, Ct) = np.sin([roll, pitch]), np.cos([roll, pitch])
    printed = (
        np.array([[Ct, 0, 0], [0, 1, 0], [St, 0, 0]]) + np.array([[-Cf * St, 0, 0], [Sf, 1, 0], [Cf * Ct, 0, 0]]) @ J
    )
    motion = BIKE.motion(0.0, list(q), [0.0] * 6)
    np.testing.assert_allclose(np.asarray(motion["B"].matrix(motion.N)) @ np.asarray(W[0]), printed, atol=1e-14)


@pytest.mark.slow
def test_generalized_active_forces_of_the_inputs_are_the_torques():
    """The generalized active forces of (roll_rate, rear_wheel_rate, steer_rate) are the three torques themselves. The
    damping of the steer is such a torque."""
    q, u = moving_state()
    none = jk.generalized_active_forces(BIKE, 0.0, q, u)
    for i, name in enumerate(BIKE.inputs):
        with_it = jk.generalized_active_forces(BIKE, 0.0, q, u, {name: 7.0})
        np.testing.assert_allclose(with_it - none, 7.0 * np.eye(3)[i], atol=1e-12)
    damped = jk.generalized_active_forces(dataclasses.replace(BIKE, steer_damping=2.0), 0.0, q, u)
    np.testing.assert_allclose(damped - none, [0.0, 0.0, -2.0 * float(u[2])], atol=1e-12)


@pytest.mark.slow
def test_dependent_speeds_are_singular_at_the_predicted_steer_angle():
    """det C_dep changes sign at a steer of 91.77 degrees, upright; its condition number is about 120 at 90."""

    @jax.jit
    def C_dep(q):  # (3, 3): the derivatives of the velocity constraints by the dependent speeds
        residual = lambda u: jnp.stack(BIKE.motion(0.0, list(q), list(u)).constraints)  # noqa: E731
        return jax.jacfwd(residual)(jnp.zeros(6))[:, 3:]

    matrices = [C_dep(jk.assemble(BIKE, {"steer": float(np.deg2rad(x))}).q) for x in (90.0, 91.7, 91.85)]
    square, before, after = np.linalg.det(matrices)
    assert before * after < 0 < square * before
    assert 50 < np.linalg.cond(matrices[0]) < 300


# -- parameters from elsewhere


def text(**changes):
    values = load("meijaard2007.json")["parameters"] | changes
    return "".join(f"{name} = {value}+/-0.01\n" for name, value in values.items() if value is not None)


def test_from_file_reads_values_and_standard_deviations(tmp_path):
    path = tmp_path / "Benchmark.txt"
    path.write_text(text(yB=0.0, IRzz=0.0603))
    bicycle = WhippleBicycle.from_file(path)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), bicycle, BIKE))
    values, deviations = read_bicycle_file(path)
    assert values["mB"] == 85.0
    assert deviations["mB"] == 0.01


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text(wheelbase=1.0), r"line 27: wheelbase is not a parameter"),
        (text() + "mB = 80+/-1\n", r"line 27: mB was given before, on line 11"),
        (text(mB="heavy"), r"line 11: 'mB = heavy\+/-0.01' is not of the form"),
        (text(mB="nan"), r"line 11"),
        (text() + "what is this\n", r"line 27: 'what is this' is not"),
        (text(mB=None, w=None), r"missing: w, mB"),
        (text(IRzz=0.5), r"IRzz = 0.5, but the model requires IRzz = IRxx"),
        (text(mB=-85.0), r"WhippleBicycle.mB = -85.0 must be positive"),
    ],
)
def test_errors_in_a_file_are_reported_with_their_line(tmp_path, content, message):
    path = tmp_path / "Faulty.txt"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        WhippleBicycle.from_file(path)
    assert "Faulty.txt" in str(caught.value)


def test_from_parameters_reports_missing_and_unknown_names():
    with pytest.raises(ValueError, match=r"missing: .*IByy.*; unknown: mass"):
        WhippleBicycle.from_parameters({"w": 1.0, "mass": 3.0})
