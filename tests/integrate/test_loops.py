"""The fast loop and `diffrax.diffeqsolve` take the same steps. A progress bar needs the loop of diffrax."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from test_clocks import Particle, Thrown

import jaxkane as jk

SAMPLED = {"push": jk.Samples(np.linspace(0.0, 1.0, 5), np.array([1.0, -2.0, 0.5, 3.0, 1.0]), zero_order_hold=True)}


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("system", "inputs", "options"),
    [
        (Thrown(), None, {}),
        (Particle(), SAMPLED, {"step": 0.05}),
        (Particle(), SAMPLED, {"solver": diffrax.Kvaerno3(), "rtol": 1e-6}),
        (Particle(), None, {"max_steps": 3}),
    ],
    ids=["event", "fixed", "implicit", "max steps"],
)
def test_the_fast_loop_and_diffrax_agree_with_events_and_discontinuities(system, inputs, options):
    run = lambda **more: jk.simulate(system, jk.State([0.0], [0.4]), [0.0, 0.5, 1.0], inputs, **options, **more)  # noqa: E731
    for x, y in zip(jax.tree.leaves(run()), jax.tree.leaves(run(progress=True)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


def swing(**options):
    """A pendulum, and the derivative of its last angle by its length."""

    def last(length):
        system = jk.catalog.DoublePendulum(mass=1.0, length=length)
        ride = jk.simulate(system, jk.State(jnp.array([1.0, -0.5]), jnp.zeros(2)), jnp.linspace(0.0, 0.3, 3), **options)
        return ride.q[-1, 0], ride.status

    (angle, status), slope = jax.jit(jax.value_and_grad(last, has_aux=True))(0.7)
    return np.array([angle, slope, status])


@pytest.mark.weekly
@pytest.mark.parametrize(
    "options",
    [
        {"adjoint": diffrax.BacksolveAdjoint()},
        {"solver": diffrax.KenCarp4()},
        {"controller": diffrax.PIDController(rtol=1e-9, atol=1e-9, pcoeff=0.3, icoeff=0.4, norm=optx.max_norm)},
        {"progress": True},
    ],
    ids=["backsolve", "imex", "controller", "progress"],
)
def test_diffrax_options_are_supported(options):
    np.testing.assert_allclose(swing(**options), swing(), rtol=1e-6, atol=1e-6)


@pytest.mark.weekly
def test_a_diffrax_controller_still_locates_events():
    control = diffrax.PIDController(rtol=1e-7, atol=1e-7, pcoeff=0.2, icoeff=0.5)
    ride = jk.simulate(Thrown(), jk.State([0.0], [1.5]), [0.0, 10.0], controller=control)
    assert ride.reason == "back"
    assert float(ride.t_end) == pytest.approx(3.0, abs=1e-9)


def test_ode_term_can_be_passed_to_diffrax():
    system, state = jk.catalog.DoublePendulum(), jk.State(jnp.array([1.0, -0.5]), jnp.zeros(2))
    term, args = jk.ode_term(system, {"elbow_torque": lambda t, s: 0.3 * jnp.sin(t)})
    control = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    solution = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 0.5, 0.01, state, args, stepsize_controller=control)
    ride = jk.simulate(system, state, [0.0, 0.5], {"elbow_torque": lambda t, s: 0.3 * jnp.sin(t)}, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solution.ys.q[0], ride.q[-1], atol=1e-8)
    with pytest.raises(ValueError, match="The input 'elbow_torque'"):
        jk.ode_term(system, {"elbow_torque": np.zeros(3)})
