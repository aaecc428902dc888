"""`assemble` holds what is named and finds what is left out; what cannot be found is NaN with its derivatives."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import OnACircle

import jaxkane as jk
from jaxkane.catalog import RigidBody

PAGE = Path(__file__).parents[2] / "docs" / "constraints.md"
IDENTITY = [0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def balls():
    """The documentation's own recipe, which names no dependent coordinates."""
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        if "class TwoBalls" in block:
            exec(block, {"jk": jk}, names)
    return names["TwoBalls"]()


class Plane(jk.System):
    """A particle in a plane, on the parabola y = height + x^2; nothing is named as dependent."""

    height: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds = ("x", "y", "angle"), ("x_dot", "spin")
    dependent_speeds = ("y_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        B = N.rotate(3, q["angle"], u["spin"])
        return jk.Motion([jk.Body(1.0, (0.1, 0.1, 0.1), P, B)])

    def q_dot(self, t, q, u):
        return u["x_dot"], u["y_dot"], u["spin"]

    def configuration_constraints(self, t, q):
        return [q["y"] - self.height - q["x"] ** 2]


@pytest.mark.slow
def test_named_coordinates_are_fixed_and_unnamed_orientations_are_identity(balls):
    for given in ({"a4": 1.0}, {"x": 2.0, "a1": 0.0}):
        expected = np.array([given.get("x", 0.0), 0.0, 0.0, *IDENTITY, *IDENTITY])
        np.testing.assert_array_equal(jk.assemble(balls, given).q, expected)
    q = np.asarray(jk.assemble(balls, {"a1": 0.6, "z": 3.0}).q)
    np.testing.assert_allclose(q, [0, 0, 3.0, 0.6, 0, 0, 0.8, *IDENTITY], atol=1e-15)
    traced = jax.jit(lambda a: jk.assemble(balls, {"a1": a, "z": 3.0}).q)(0.6)
    np.testing.assert_allclose(traced, q, atol=1e-15)
    body = jk.assemble(RigidBody(), {"x": 1.0, "e2": -0.8}).q  # which names e4 as dependent
    np.testing.assert_allclose(body, [1.0, 0, 0, 0, -0.8, 0, 0.6], atol=1e-15)


def test_named_values_that_violate_the_constraints_are_rejected(balls):
    with pytest.raises(ValueError, match=r"TwoBalls: .*a4 = 0\.9.*Named values are fixed"):
        jk.assemble(balls, {"a4": 0.9})
    with pytest.raises(ValueError, match=r"b1 = 0\.1.*b4 = 0\.9"):
        jk.assemble(balls, {"b1": 0.1, "b4": 0.9})
    with pytest.raises(
        ValueError, match=r"Plane: x = 1, y = 3, angle = 0 does not satisfy .*is 1\).*no coordinate may be changed"
    ):
        jk.assemble(Plane(), {"x": 1.0, "y": 3.0, "angle": 0.0})
    with pytest.raises(ValueError, match=r"no a2, a3 that satisfies .*a1 = 2"):
        jk.assemble(balls, {"a1": 2.0, "a4": 0.0}, free=("a2", "a3"))
    moved = jk.assemble(balls, {"b1": 0.1, "b4": 0.9}, free=("b4",)).q
    np.testing.assert_allclose(moved[7:], [0.1, 0.0, 0.0, 0.99**0.5], atol=1e-15)
    everything = jk.assemble(balls, np.array([1.0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0.3, 0.4])).q  # an array names nothing
    np.testing.assert_allclose(everything, [1.0, 0, 0, *IDENTITY, 0, 0, 0.6, 0.8], atol=1e-12)


@pytest.mark.slow
def test_omitted_coordinates_are_solved_for():
    np.testing.assert_allclose(jk.assemble(Plane(), {"x": 2.0, "angle": 0.5}).q, [2.0, 5.0, 0.5], atol=1e-15)
    np.testing.assert_allclose(
        jk.assemble(Plane(), {"y": 5.0}).q, [2.0, 5.0, 0.0], atol=1e-12
    )  # looked for beside x = 0
    named = {"x": 2.0, "y": 5.0}  # the angle is left out, and does not enter the constraint
    np.testing.assert_array_equal(jk.assemble(Plane(), named).q, [2.0, 5.0, 0.0])
    np.testing.assert_array_equal(jk.assemble(Plane(), named | {"angle": 1.0}).q, [2.0, 5.0, 1.0])
    with pytest.raises(ValueError, match=r"cannot be met by moving 0 coordinates|does not satisfy"):
        jk.assemble(OnACircle(), {"x": 0.5}, free=())
    np.testing.assert_array_equal(jk.assemble(OnACircle(), {"x": 0.6, "y": 0.8}, free=()).q, [0.6, 0.8])


@pytest.mark.parametrize("given", [{"x": 2.0}, {"x": 1.0}])  # no such place; a place where y has no derivative
def test_derivatives_are_nan_if_assembly_fails(given):
    found = jax.jit(lambda x: jk.assemble(OnACircle(), {"x": x}).q[1])
    assert np.isnan(found(given["x"]))
    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        assert np.isnan(jax.jit(derivative(found))(given["x"]))


@pytest.mark.weekly
def test_a_failed_batch_member_does_not_affect_the_others():
    x = jnp.array([0.6, 2.0, 1.0, 0.0, jnp.nan])
    found = jax.vmap(lambda x: jk.assemble(OnACircle(), {"x": x}).q[1])
    good = np.array([True, False, False, True, False])
    y = jax.jit(found)(x)
    np.testing.assert_allclose(y[good], [0.8, 1.0], atol=1e-15)
    assert np.isnan(y[~good]).all()
    slopes = jax.jit(lambda x: jax.vjp(found, x)[1](jnp.ones_like(x))[0])(x)
    forward = jax.jit(lambda x: jax.jvp(found, (x,), (jnp.ones_like(x),))[1])(x)
    for derivative in (slopes, forward):  # dy/dx = -x / y
        np.testing.assert_allclose(derivative[good], [-0.75, 0.0], atol=1e-14)
        assert np.isnan(derivative[~good]).all()
    mean = jax.jit(jax.grad(lambda x: jnp.mean(found(x)[jnp.array([0, 3])])))(x)  # reads what was found only
    np.testing.assert_allclose(mean, [-0.375, 0, 0, 0, 0], atol=1e-14)


@pytest.mark.slow
def test_assembled_coordinates_are_differentiable_by_parameters():
    def y(height):
        return jk.assemble(Plane(height=height), {"x": 2.0}).q

    np.testing.assert_allclose(jax.jit(jax.jacfwd(y))(1.0), [0.0, 1.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.jacrev(y))(1.0), [0.0, 1.0, 0.0], atol=1e-14)


@pytest.mark.slow
def test_euler_parameters_among_many_coordinates_are_recognized():
    """120 quaternions between 120 other coordinates: with one random point, some of 600 windows matched by accident."""

    class Many(jk.System):
        coordinates = tuple(name for i in range(120) for name in (f"x{i}", *(f"e{i}_{k}" for k in range(4))))
        speeds = ("u",)

        def q_dot(self, t, q, u):
            return [u[0], 0.0, 0.0, 0.0, 0.0] * 120

        def motion(self, t, q, u):
            N, O = jk.inertial()
            return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[0] * N.x, u[0] * N.x), name="P")])

        def configuration_constraints(self, t, q):
            return [sum(q[5 * i + 1 + k] ** 2 for k in range(4)) - 1.0 for i in range(120)]

    given = {f"x{i}": 0.3 for i in range(120)}
    q = np.asarray(jk.assemble(Many(), given).q).reshape(120, 5)
    np.testing.assert_array_equal(q, np.tile([0.3, *IDENTITY], (120, 1)))
