"""Replays of a `ScalarFunction`, equation by equation: results, derivatives, cached values, captured tracers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit.scalar_function import ScalarFunction


@ScalarFunction
def _two(scale, x):
    (a, b), t = x
    product = a * b
    return {"product": [scale * product, 3.0], "sum": (a + b * t, jnp.where(a > b, a, b) / 2.0), "zero": 0.0 * t}


def test_a_replay_returns_the_requested_outputs_and_keeps_exact_values():
    scale, a, t = jnp.array(2.0), jnp.array(0.7), jnp.array(-1.3)
    product = _two.replay("product", scale, ((a, 0.0), t), {})
    assert product == [0.0, 3.0] and all(type(x) is float for x in product)  # noqa: PT018
    total, larger = _two.replay("sum", scale, ((0.0, 1.0), t), {})
    assert total is t
    assert float(larger) == 0.5
    assert np.isnan(_two.replay("zero", scale, ((a, a), jnp.array(jnp.nan)), {}))  # written so: not an exact zero


@pytest.mark.parametrize("derivative", [jax.jvp, jax.linearize])
def test_a_replay_has_the_derivatives_of_its_function(derivative):
    f = lambda a, t: _two.replay("sum", jnp.array(2.0), ((a, 0.5), t), {})[0]  # noqa: E731
    at, along = (jnp.array(0.7), jnp.array(-1.3)), (jnp.array(1.0), jnp.array(3.0))
    found = jax.jvp(f, at, along)[1] if derivative is jax.jvp else jax.linearize(f, *at)[1](*along)
    assert float(found) == pytest.approx(1.0 + 0.5 * 3.0, rel=1e-15)
    assert float(jax.jit(jax.grad(f, argnums=1))(*at)) == pytest.approx(0.5, rel=1e-15)
    batch = jax.vmap(f)(jnp.arange(3.0), jnp.ones(3))
    np.testing.assert_allclose(batch, np.arange(3.0) + 0.5, rtol=1e-15)


def test_values_independent_of_the_changed_arguments_are_cached():
    scale, t, memory = jnp.array(2.0), jnp.array(-1.3), {}
    _two.replay("sum", scale, ((jnp.array(0.7), 0.5), t), memory)
    n = len(memory)
    _two.replay("sum", scale, ((jnp.array(0.9), 0.5), t), memory)  # `b * t` is known
    assert n < len(memory) < 2 * n


def test_functions_that_capture_a_tracer_are_not_recorded():
    @jax.jit
    def f(x):
        g = ScalarFunction(lambda scale, y: {"all": scale * y[0] * x})
        return g.replay("all", jnp.array(2.0), (jnp.array(3.0),), {})

    assert float(f(jnp.array(5.0))) == 30.0
    assert float(f(jnp.array(7.0))) == 42.0
