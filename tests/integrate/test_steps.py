"""The steps of a motion: their length by their error, and the loop that takes them."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._integrate import diffrax_compat
from jaxkane._integrate.integrate import solve
from jaxkane._integrate.settings import settings_for
from jaxkane._integrate.step_control import ClipToDiscontinuities
from jaxkane._scalarjit.function import ScalarFunction


def test_a_solver_without_an_estimate_of_its_error_asks_for_a_step():
    system, state = pendulum()
    with pytest.raises(ValueError, match="step=1e-3"):
        jk.simulate(system, state, jnp.linspace(0.0, 0.5, 3), solver=diffrax.Euler())
    with pytest.raises(TypeError, match="KenCarp4 takes equations in two parts"):
        jk.simulate(system, state, jnp.linspace(0.0, 0.5, 3), solver=diffrax.KenCarp4(), step=0.01)


@pytest.mark.parametrize("solver", [diffrax.Kvaerno5(), diffrax.ImplicitEuler()])
def test_implicit_steps_of_one_length(solver):
    system, state = pendulum()
    ts = jnp.linspace(0.0, 0.4, 3)
    order = 1 if isinstance(solver, diffrax.ImplicitEuler) else 5
    exact = np.asarray(jk.simulate(system, state, ts, rtol=1e-11).q)
    errors = [
        np.abs(np.asarray(jk.simulate(system, state, ts, solver=solver, step=h).q) - exact).max() for h in (0.04, 0.02)
    ]
    assert errors[0] / errors[1] > 2 ** (order - 0.6)


def pendulum():
    return jk.catalog.DoublePendulum(mass=1.0, length=0.7), jk.State(jnp.array([1.0, -0.5]), jnp.zeros(2))


@pytest.mark.parametrize("adjoint", ["forward", pytest.param("reverse", marks=pytest.mark.slow)])
def test_the_loop_of_known_times_is_that_of_diffrax(adjoint, monkeypatch):
    """The way back, for a release of diffrax whose insides are others."""
    system, state = pendulum()
    ts = jnp.linspace(0.2, 1.0, 7)
    settings = settings_for(ts, adjoint=adjoint, rising=True)

    def ends(q):
        ride_of = eqx.filter_jit(solve.__wrapped__)(system, jk.State(q, state.u), ts, {}, settings)
        return jnp.sum(ride_of.q[-1] ** 2), ride_of

    def found():
        (_, motion), slope = (
            eqx.filter_value_and_grad(ends, has_aux=True)(state.q)
            if adjoint == "reverse"
            else (
                ends(state.q),
                jax.jvp(lambda q: ends(q)[0], (state.q,), (jnp.ones(2),))[1],
            )
        )
        return motion, slope

    assert diffrax_compat._AS_EXPECTED
    motion, slope = found()
    monkeypatch.setattr(diffrax_compat, "_AS_EXPECTED", False)
    other, other_slope = found()
    for x, y in zip(jax.tree.leaves(motion), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(slope, other_slope, rtol=1e-11)
    assert motion.status == jk.Status.COMPLETED
    assert motion.t_end == ts[-1]


@ScalarFunction
def _of_the_first(x, y):
    return jnp.sin(x) + 1.0


def test_what_a_program_does_not_read_is_not_computed_for_it(native):
    def f(x):
        return _of_the_first(x, jnp.exp(x))

    lowered = jax.jit(f).lower(jnp.array(0.5))
    assert "exponential" not in lowered.compile().as_text()
    assert float(jax.jit(f)(jnp.array(0.5))) == pytest.approx(np.sin(0.5) + 1.0, rel=1e-15)
    batch = jax.jit(jax.vmap(lambda x, y: _of_the_first(x, y), in_axes=(None, 0)))(jnp.array(0.5), jnp.arange(3.0))
    np.testing.assert_allclose(batch, np.sin(0.5) + 1.0, rtol=1e-15)
    slope = jax.jit(jax.grad(lambda x, y: _of_the_first(x, y), argnums=(0, 1)))(0.5, 2.0)
    np.testing.assert_allclose(slope, [np.cos(0.5), 0.0], rtol=1e-15)


@ScalarFunction
def _doubled_if_positive(x):
    positive = x > 0
    return jnp.where(positive, 2.0 * x, x), positive


def test_a_program_that_also_tells_what_is_true_has_derivatives(kernels):
    value = lambda x: _doubled_if_positive(x)[0]  # noqa: E731
    for x, slope in ((0.7, 2.0), (-0.7, 1.0)):
        assert jax.jit(jax.grad(value))(x) == slope
        (_, told), (x_dot, _) = jax.jit(lambda x: jax.jvp(_doubled_if_positive, (x,), (1.0,)))(x)
        assert x_dot == slope
        assert told == (x > 0)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(value)))(jnp.array([-1.0, 1.0])), [1.0, 2.0])


@pytest.mark.parametrize("jacobian", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_the_last_time_and_the_first_have_derivatives(jacobian):
    system, state = pendulum()

    def end(times):
        ride_of = jk.simulate(system, state, jnp.stack([times[0], times[1]]))
        return ride_of.q[-1], (ride_of.u[-1], ride_of.q[0])

    times = jnp.array([0.2, 0.9])
    slopes, (u_end, _) = jacobian(end, has_aux=True)(times)
    np.testing.assert_allclose(slopes[:, 1], u_end, rtol=1e-6)  # dq/dt at the end
    np.testing.assert_allclose(slopes[:, 0], -u_end, rtol=1e-6)  # where nothing depends on the time itself


def test_a_step_ends_beside_a_kink_or_leaves_half_of_the_way_to_it():
    clip = ClipToDiscontinuities(diffrax.PIDController(1e-6, 1e-6), jnp.array([0.5, 1.0]))
    for length in (0.1, 0.3, 0.5 - 1e-9, 0.5, 0.7, 1.2):
        end, _ = clip.init(None, jnp.array(0.0), jnp.array(2.0), jnp.zeros(1), jnp.array(length), None, None, 5)
        assert abs(0.5 - end) < 1e-13 or end == min(length, 0.25)
