"""Orientation: against the textbook's printed matrices, against SciPy, and against differentiation."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxkane as jk
from jaxkane import rotations

ANGLES, RATES = (0.3, -0.5, 0.7), (0.4, 1.1, -0.8)
SEQUENCES = ("3-2-1", "3-1-2", "3-1-3", "1-2-3")
ALL_SEQUENCES = ["".join(s) for s in itertools.product("123", repeat=3) if s[0] != s[1] and s[1] != s[2]]


def test_the_matrix_of_the_bicycle_frame_agrees_with_the_printed_one():
    # Example 7, [R_R2B], 3-1-2 angles psi, phi, theta
    (Sp, Sf, St), (Cp, Cf, Ct) = np.sin(ANGLES), np.cos(ANGLES)
    printed = [
        [Cp * Ct - Sp * Sf * St, Sp * Ct + Cp * Sf * St, -Cf * St],
        [-Sp * Cf, Cp * Cf, Sf],
        [Cp * St + Sp * Sf * Ct, Sp * St - Cp * Sf * Ct, Cf * Ct],
    ]
    np.testing.assert_allclose(jnp.array(rotations.sequence_matrix("3-1-2", ANGLES)), printed, atol=1e-15)
    # and its angular velocity: (phi' C - psi' Cphi S, theta' + psi' Sphi, phi' S + psi' Cphi C)
    psi, phi, theta = RATES
    omega = [phi * Ct - psi * Cf * St, theta + psi * Sf, phi * St + psi * Cf * Ct]
    np.testing.assert_allclose(rotations.angular_velocity("3-1-2", ANGLES, RATES), omega, atol=1e-15)


@pytest.mark.parametrize("sequence", ALL_SEQUENCES)
def test_body_fixed_sequences_against_scipy(sequence):
    letters = "".join("XYZ"[int(d) - 1] for d in sequence)
    theirs = Rotation.from_euler(letters, ANGLES).as_matrix().T  # theirs takes rotated components to the parent's
    np.testing.assert_allclose(jnp.array(rotations.sequence_matrix(sequence, ANGLES)), theirs, atol=1e-15)


@pytest.mark.parametrize("sequence", ALL_SEQUENCES)
def test_rates_of_angles_and_angular_velocity(sequence):
    matrix = lambda *angles: jnp.array(rotations.sequence_matrix(sequence, angles))  # noqa: E731
    R, R_dot = jax.jvp(matrix, [jnp.array(a) for a in ANGLES], [jnp.array(a) for a in RATES])
    skew = R @ R_dot.T  # [omega x], rotated components
    omega = rotations.angular_velocity(sequence, ANGLES, RATES)
    np.testing.assert_allclose(omega, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=1e-14)
    np.testing.assert_allclose(rotations.angle_rates(sequence, ANGLES, omega), RATES, atol=1e-14)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_frames_by_sequences(sequence):
    N, _ = jk.inertial()
    B = N.rotate_sequence(sequence, ANGLES, RATES)
    omega = rotations.angular_velocity(sequence, ANGLES, RATES)
    np.testing.assert_allclose(B.matrix(N), jnp.array(rotations.sequence_matrix(sequence, ANGLES)), atol=1e-15)
    np.testing.assert_allclose(B.angular_velocity.to(B), omega, atol=1e-15)
    C = N.rotate_sequence(sequence, ANGLES, angular_velocity=omega)
    np.testing.assert_allclose(C.angular_velocity.to(N), B.angular_velocity.to(N), atol=1e-15)


def test_euler_parameters_are_scalar_last_and_map_to_the_body():
    e = np.array([0.1, -0.4, 0.2, 0.8])
    e = e / np.linalg.norm(e)
    theirs = Rotation.from_quat(e).as_matrix().T  # SciPy is scalar-last too
    np.testing.assert_allclose(jnp.array(rotations.euler_parameters_matrix(e)), theirs, atol=1e-15)
    omega = (0.3, -0.9, 1.4)
    rates = jnp.stack(rotations.euler_parameter_rates(jnp.array(e), omega))
    matrix = lambda e: jnp.array(rotations.euler_parameters_matrix(e))  # noqa: E731
    R, R_dot = jax.jvp(matrix, (jnp.array(e),), (rates,))
    skew = R @ R_dot.T
    np.testing.assert_allclose([skew[2, 1], skew[0, 2], skew[1, 0]], omega, atol=1e-14)
    assert abs(float(rates @ e)) < 1e-16  # the norm is kept


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0099, 0.0101, 2.0])
def test_rotation_vectors_are_smooth_at_the_limit_of_the_series(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    e = jnp.stack(rotations.of_rotation_vector(jnp.asarray(vector)))
    np.testing.assert_allclose(e, Rotation.from_rotvec(vector).as_quat(), rtol=1e-14)


def test_bad_sequences_are_refused():
    N, _ = jk.inertial()
    with pytest.raises(ValueError, match="1, 2, 3"):
        N.rotate_sequence("zxy", ANGLES, RATES)
    with pytest.raises(ValueError, match="3 angles"):
        N.rotate_sequence("3-1-2", (0.1, 0.2), (0.0, 0.0))
    with pytest.raises(ValueError, match="either"):
        N.rotate_sequence("3-1-2", ANGLES)
    with pytest.raises(ValueError, match="four numbers"):
        N.rotate_euler(ANGLES, RATES)
