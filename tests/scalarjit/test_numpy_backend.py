"""Fused functions evaluated with numbers, by NumPy: the same values and derivatives as compiled programs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._scalarjit.scalar_function import ScalarFunction

ARGUMENTS = ({"a": jnp.array(0.7)}, np.array(-1.2), np.array([0.3, 0.9, -0.4]))


@ScalarFunction
def functions(given, b, x):
    a, (y, z, w) = given["a"], x
    waves = jnp.sin(a) + jnp.cos(b) * jnp.tan(y) - jnp.arctan2(z, b) + jnp.arcsin(y) * jnp.arccos(y) / jnp.arctan(b)
    growing = jnp.sinh(y) + jnp.cosh(z) * jnp.tanh(w) - jnp.arctanh(y)
    powers = jnp.exp(y) + jnp.exp2(w) + jnp.expm1(w) + jnp.log(z) * jnp.log1p(y) + a**z + b**3 + jnp.cbrt(z) + a**-2
    others = jnp.sqrt(a) + abs(w) + jnp.maximum(y, w) * jnp.minimum(z, b) + jnp.sign(w)
    steps = jnp.where((y > w) & ~(z <= b), a, b) + jax.lax.rem(b, a) + jnp.clip(w, -0.1, 0.1)
    return {
        "numbers": jnp.stack([waves, growing, powers]),
        "rest": (others, steps),
        "both": x * jnp.sum(x),
    }


@ScalarFunction
def error_function(x):
    return jax.scipy.special.erf(x)


@ScalarFunction
def by_a_library(b, x):
    return jnp.linalg.det(jnp.diag(x)) * b


def the_same(found, right, **tolerance):
    assert jax.tree.structure(found) == jax.tree.structure(right)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        assert isinstance(x, np.ndarray)
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, **tolerance)


@pytest.mark.slow
def test_values_agree_with_jax():
    assert functions.is_numpy(*ARGUMENTS)
    the_same(functions.numpy(*ARGUMENTS), functions.__wrapped__(*jax.tree.map(jnp.asarray, ARGUMENTS)), rtol=1e-14)

    the_same(error_function.numpy(np.array(0.3)), np.array(0.3286267594591274), rtol=1e-15)  # math.erf


def test_nan_and_inf_agree_with_jax_without_warnings(recwarn):
    arguments = ({"a": np.array(-1.0)}, np.array(0.0), np.array([2.0, -1.0, np.nan]))
    right = jax.jit(functions.__wrapped__)(*arguments)
    the_same(functions.numpy(*arguments), right, rtol=1e-14, equal_nan=True)
    assert not recwarn


@pytest.mark.slow
def test_derivatives_along_several_directions_agree_with_jax():
    directions = np.array([[1.0, 0.0], [0.5, 2.0], [0.0, -1.0]])  # (x,d)
    along_b = np.array([0.3, 0.0])
    found = functions.numpy_jvp(ARGUMENTS, (None, along_b, directions))
    f = lambda b, x: functions.__wrapped__(ARGUMENTS[0], b, x)  # noqa: E731
    slope = lambda b, x: jax.jvp(f, tuple(map(jnp.asarray, ARGUMENTS[1:])), (b, x))[1]  # noqa: E731
    the_same(found, jax.jit(jax.vmap(slope, in_axes=-1, out_axes=-1))(along_b, directions), rtol=1e-13, atol=1e-15)
    assert functions.numpy_jvp(ARGUMENTS, (None, None, np.zeros((3, 0))))["both"].shape == (3, 0)


@pytest.mark.slow
def test_programs_with_array_operations_are_left_to_jax():
    b, x = np.array(2.0), np.array([0.5, 3.0])
    with pytest.warns(UserWarning, match="its description uses"):
        assert not by_a_library.is_numpy(b, x)
    assert by_a_library.numpy(b, x) == pytest.approx(3.0, rel=1e-15)
    np.testing.assert_allclose(by_a_library.numpy_jvp((b, x), (None, np.eye(2))), [6.0, 1.0], rtol=1e-15)


@pytest.mark.slow
def test_float32_stays_float32():
    arguments = jax.tree.map(lambda x: np.asarray(x, np.float32), ARGUMENTS)
    found = functions.numpy(*arguments)
    the_same(found, jax.jit(functions.__wrapped__)(*arguments), rtol=1e-5)
    assert found["both"].dtype == np.float32


class Rods(jk.System):
    """Two rods of one length that close a triangle with the ground, and their angles."""

    length: jk.Scalar = jk.parameter(1.0)
    base: jk.Scalar = jk.parameter(1.5)
    coordinates, dependent_coordinates = ("a", "b", "c"), ("a", "b")
    speeds, dependent_speeds = ("c_rate",), ("a_rate", "b_rate")

    def q_dot(self, t, q, u):
        return u["a_rate", "b_rate", "c_rate"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A, B, C = (N.rotate(3, q[name], u[f"{name}_rate"]) for name in "abc")
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, 1.0), O, frame) for frame in (A, B, C)])

    def configuration_constraints(self, t, q):
        x = self.length * (jnp.cos(q["a"]) + jnp.cos(q["b"])) - self.base
        return [x, self.length * (jnp.sin(q["a"]) + jnp.sin(q["b"]))]


@pytest.mark.slow_cases("start0-1.5")
@pytest.mark.parametrize("base", [1.5, 2.0, 3.0, np.nan])
@pytest.mark.parametrize("start", [(0.5, -0.3), (0.0, 0.0), (np.pi, np.pi)])
def test_newtons_method_agrees_in_numpy_and_compiled(base, start):
    """Where there is one place, two rods in line, none, and no number; from beside, and from where all slopes agree."""
    system = eqx.tree_at(lambda s: s.base, Rods(), jnp.array(base))
    q = jnp.array([*start, 0.2])
    right = jax.jit(lambda system, q: jk.assemble(system, q).q)(system, q)
    try:
        found = jk.assemble(system, q).q
    except ValueError:
        found = np.full(3, np.nan)
    if start == (0.5, -0.3) or base != 1.5:  # beside a place where all slopes agree, NumPy tries other guesses
        np.testing.assert_allclose(found, right, atol=1e-14 if base < 2.0 else 1e-11)  # of a double root
