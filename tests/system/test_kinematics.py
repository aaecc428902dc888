"""Vectors, frames and points: the algebra, the theorems, and the exact zeros."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

N, O = jk.inertial()


def test_constant_components_remain_exact():
    B = N.rotate(3, jnp.array(0.3), jnp.array(2.0))
    assert B.z.components_in(N) == (0.0, 0.0, 1.0)
    assert B.x.dot(N.z) == 0.0
    assert B.z.cross(N.z).components == (0.0, 0.0, 0.0)
    assert B.angular_velocity.components[:2] == (0.0, 0.0)


def test_algebra_across_frames():
    B = N.rotate(1, 0.4, 0.0)
    C = B.rotate(2, -0.7, 0.0)
    a, b = 2.0 * B.x - 0.5 * B.z, N.y / 4.0 + C.z
    A, D = np.asarray(a.to(N)), np.asarray(b.to(N))
    np.testing.assert_allclose((a + b).to(N), A + D, atol=1e-15)
    np.testing.assert_allclose((a - b).to(C), np.asarray(C.matrix(N)) @ (A - D), atol=1e-15)
    np.testing.assert_allclose(a.dot(b), A @ D, atol=1e-15)
    np.testing.assert_allclose(a.cross(b).to(N), np.cross(A, D), atol=1e-15)
    np.testing.assert_allclose((-a).norm(), np.linalg.norm(A))
    np.testing.assert_allclose(b.normalize().norm(), 1.0)
    np.testing.assert_allclose(sum([a, b]).to(N), A + D, atol=1e-15)
    np.testing.assert_allclose(b.express(B).to(N), D, atol=1e-15)


@pytest.mark.parametrize(
    "factor", [3, 3.0, np.float64(3.0), np.array(3.0), jnp.array(3.0)], ids=lambda x: type(x).__name__
)
def test_numbers_of_any_kind_multiply_from_both_sides(factor):
    for product in (factor * N.x, N.x * factor):
        assert isinstance(product, jk.Vector)
        np.testing.assert_allclose(product.to(N), [3.0, 0.0, 0.0])


def test_invalid_vector_algebra_raises():
    with pytest.raises(TypeError, match=r"a\.dot"):
        N.x * N.y
    with pytest.raises(TypeError):
        N.x + 1.0
    with pytest.raises(TypeError, match="one number"):
        jnp.ones(3) * N.x


def test_frames_of_different_evaluations_cannot_be_combined():
    M, _ = jk.inertial()
    A, B = N.rotate(3, 0.3, 1.0), M.rotate(3, 0.3, 1.0)
    np.testing.assert_allclose((2.0 * A.x).dot(M.y), 2.0 * np.sin(0.3))
    np.testing.assert_allclose((M.y + M.x).to(A), (N.y + N.x).to(A))
    with pytest.raises(ValueError, match="no common inertial frame"):
        A.x.dot(B.y + B.x)


def test_two_point_and_one_point_theorems_agree_with_differentiation():
    # A slider on a turning arm, said in three ways.
    angle, rate, s, s_dot = 0.8, 1.7, 0.4, -0.3
    B = N.rotate(3, angle, rate)
    arm = O.fixed(2.0 * B.x)
    slider = arm.moving(s * B.y, s_dot * B.y)

    def place(t, q):
        c, sn = jnp.cos(q[0]), jnp.sin(q[0])
        return (2.0 * c - q[1] * sn, 2.0 * sn + q[1] * c, 0.0)

    located = O.located(place, 0.0, [angle, s], [rate, s_dot])
    np.testing.assert_allclose(slider.velocity.to(N), located.velocity.to(N), atol=1e-15)
    np.testing.assert_allclose(slider.position.to(N), located.position.to(N), atol=1e-15)
    np.testing.assert_allclose(slider.position_from(arm).to(B), [0.0, s, 0.0], atol=1e-15)


def test_orientation_given_as_a_function():
    direct = N.rotate(2, 0.5, 1.2)

    def orientation(t, q):
        c, s = jnp.cos(q), jnp.sin(q)
        return jnp.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])

    given = N.rotate_by(orientation, 0.0, 0.5, 1.2)
    np.testing.assert_allclose(given.matrix(N), direct.matrix(N), atol=1e-15)
    np.testing.assert_allclose(given.angular_velocity.to(N), direct.angular_velocity.to(N), atol=1e-15)


def test_a_point_fixed_by_a_vector_of_two_frames_requires_a_frame():
    B = N.rotate(1, 0.4, 1.0)
    with pytest.raises(ValueError, match="Pass the frame"):
        O.fixed(N.x + B.y)
    assert O.fixed(N.x + B.y, B).velocity.frame is B


def test_a_point_known_by_its_velocity_alone_has_no_position():
    P = jk.Point.at(2.0 * N.x)
    assert not P.fixed(N.y, N).has_position
    with pytest.raises(ValueError, match="not known"):
        _ = P.position


@pytest.mark.parametrize("axis", [N.x + N.y, 2.0 * N.z, N.vector(jnp.array(1.0), 2.0, -0.5), -3.0 * N.x + 4.0 * N.y])
def test_the_length_of_an_axis_does_not_change_the_rotation(axis):
    unit = np.asarray(axis.to(N)) / np.linalg.norm(axis.to(N))
    K = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
    rodrigues = np.eye(3) + np.sin(0.6) * K + (1 - np.cos(0.6)) * K @ K  # takes components in B to components in N
    B = N.rotate(axis, jnp.array(0.6), jnp.array(1.5))
    np.testing.assert_allclose(N.matrix(B), rodrigues, atol=1e-15)
    np.testing.assert_allclose(B.angular_velocity.to(N), 1.5 * unit, rtol=1e-14)


@pytest.mark.parametrize(("axis", "name"), [(1, "x"), (2, "y"), (3, "z")])
def test_the_number_of_an_axis_is_that_of_a_unit_vector(axis, name):
    by_number, by_vector = N.rotate(axis, 0.6, 1.5), N.rotate(getattr(N, name), 0.6, 1.5)
    np.testing.assert_allclose(by_vector.matrix(N), by_number.matrix(N), atol=1e-15)
    with pytest.raises(ValueError, match="axis must be 1, 2 or 3"):
        N.rotate(0, 0.1, 0.0)


def test_a_zero_axis_raises_or_gives_nan():
    with pytest.raises(ValueError, match="is zero, so it has no direction"):
        N.rotate(N.x - N.x, 0.1, 0.0)
    lost = N.rotate(N.vector(*jnp.zeros(3)), jnp.array(0.1), 1.0)  # an array is not known while it is traced
    assert np.isnan(lost.matrix(N)).all()
    assert np.isnan(lost.angular_velocity.to(N)).all()


@pytest.mark.slow
def test_rotations_are_differentiable_by_the_direction_of_the_axis():
    def place(a):
        return N.rotate(N.vector(a, 1.0, 2.0), 0.7, 0.0).y.to(N)

    h = 1e-6
    numeric = (place(jnp.array(0.5 + h)) - place(jnp.array(0.5 - h))) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(place)(0.5), numeric, atol=1e-9)
    np.testing.assert_allclose(jax.jacrev(place)(0.5), numeric, atol=1e-9)


def test_a_fixed_rotation_takes_euler_parameters_of_any_norm():
    N, _ = jk.inertial()
    for e in ((0.0, 0.0, 1.2, 1.6), jnp.array([0.0, 0.0, 1.2, 1.6]), (0.0, 0.0, 0.6, 0.8)):
        R = N.rotate_euler(e).matrix(N)  # cos = 0.8^2 - 0.6^2
        np.testing.assert_allclose(R, [[0.28, 0.96, 0.0], [-0.96, 0.28, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    along = jax.grad(lambda s: N.rotate_euler(s * jnp.array([0.1, 0.2, 0.6, 0.8])).matrix(N).sum())(1.3)
    np.testing.assert_allclose(along, 0.0, atol=1e-14)
    with pytest.raises(ValueError, match="all zero"):
        N.rotate_euler((0.0, 0.0, 0.0, 0.0))


def test_relative_positions_are_exact_far_from_the_origin():
    """1e-15, a million kilometres away: from the last point that both were made from."""
    N, O = jk.inertial()
    away = O.fixed(1e9 * N.x)
    A, B = away.fixed(0.1 * N.y), away.fixed(0.3 * N.x).fixed(0.2 * N.z)
    np.testing.assert_allclose([float(x) for x in B.position_from(A).to(N)], [0.3, -0.1, 0.2], rtol=1e-15)
    np.testing.assert_allclose([float(x) for x in away.position_from(B).to(N)], [-0.3, 0.0, -0.2], rtol=1e-15)
    assert [float(x) for x in A.position_from(A).to(N)] == [0.0, 0.0, 0.0]
