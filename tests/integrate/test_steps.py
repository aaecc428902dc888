"""The steps of a motion: their length by their error, and the loop that takes them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Sled

import jaxkane as jk


def test_a_solver_without_error_estimate_requires_a_fixed_step():
    system, state = pendulum()
    with pytest.raises(ValueError, match="step=1e-3"):
        jk.simulate(system, state, jnp.linspace(0.0, 0.5, 3), solver=diffrax.Euler())
    with pytest.raises(TypeError, match="SemiImplicitEuler needs several terms"):
        jk.simulate(system, state, jnp.linspace(0.0, 0.5, 3), solver=diffrax.SemiImplicitEuler(), step=0.01)


@pytest.mark.weekly
@pytest.mark.parametrize("solver", [diffrax.Kvaerno5(), diffrax.ImplicitEuler()])
def test_implicit_solvers_with_fixed_steps_have_their_order(solver):
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


class Oscillator(Sled):
    mass: jk.Scalar = jk.parameter(1.0)
    stiffness: jk.Scalar = jk.parameter(4.0)
    level: jk.Scalar = jk.parameter(-2.0)

    def events(self, t, q, u):
        return {"level": jk.falling(q["x"] - self.level)}


AT_REST = jk.State([1.0], [0.0])


@pytest.mark.weekly
@pytest.mark.parametrize("adjoint", ["forward", pytest.param("reverse", marks=pytest.mark.weekly)])
def test_a_fixed_step_to_a_non_finite_state_ends_the_simulation(adjoint):
    """As one with tolerances: with a reason, and derivatives that are NaN where there is no motion."""

    def ride(stiffness, mass=1.0):
        push = {"force": lambda t, _: jnp.where(t > 0.55, jnp.nan, 0.0)}
        system = Oscillator(mass=mass, stiffness=stiffness)
        return jk.simulate(system, AT_REST, [0.0, 0.5, 1.0], push, step=0.01, adjoint=adjoint)

    def place(stiffness):
        motion = ride(stiffness)
        return motion["x"], motion

    jacobian = jax.jacfwd if adjoint == "forward" else jax.jacrev
    slopes, motion = jax.jit(jacobian(place, has_aux=True))(4.0)
    assert motion.status == jk.Status.STEP_TOO_SMALL
    assert 0.5 < motion.t_end < 0.6
    np.testing.assert_allclose(motion["x"], [1.0, np.cos(1.0), np.nan], atol=1e-8)
    np.testing.assert_allclose(slopes, [0.0, -np.sin(1.0) / 8, np.nan], atol=1e-8)
    first = jax.jit(jax.vmap(jacobian(lambda m: ride(4.0, m)["x"][1])))(jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(first, [np.sin(1.0) / 2, np.nan], atol=1e-8)


@pytest.mark.slow
def test_max_steps_limits_the_number_of_steps():
    system, state = pendulum()
    ride = lambda most: jk.simulate(system, state, [0.0, 0.5], max_steps=most)  # noqa: E731
    n = int(ride(1000).stats["steps"])
    assert ride(n).status == jk.Status.COMPLETED
    short = ride(n - 1)
    assert short.status == jk.Status.MAX_STEPS
    assert short.stats["steps"] == n - 1 == short.stats["accepted"] + short.stats["rejected"]


class Growth(Oscillator):
    states = ("size",)

    def state_rates(self, t, q, u, x, motion, now):
        return [x[0] ** 2 + 1.0]


@pytest.mark.slow
def test_an_implicit_step_without_a_solution_ends_the_simulation():
    """Of y = y0 + h (y^2 + 1), for h = 1."""
    state = jk.State([1.0], [0.0], [0.0])
    with pytest.raises(ValueError, match=r"cannot take a first step: .* or an implicit step has no solution"):
        jk.simulate(Growth(), state, [0.0, 1.0, 2.0], step=1.0, solver=diffrax.ImplicitEuler())


@pytest.mark.weekly
@pytest.mark.usefixtures("native")  # XLA alone leaves out a term for the time that it takes to compile
def test_the_derivative_of_an_event_early_in_a_long_motion():
    def end(level):
        system = Oscillator(stiffness=1e6, level=level)
        return jk.simulate(system, AT_REST, [0.0, 1e4], rtol=1e-11, atol=1e-11).t_end

    t, slope = jax.jit(jax.value_and_grad(end))(0.9)
    assert float(t) == pytest.approx(np.arccos(0.9) / 1e3, rel=1e-11)
    assert float(slope) == pytest.approx(-1e-3 / np.sqrt(1 - 0.81), rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.weekly)])
def test_results_are_differentiable_by_the_first_and_last_time(jacobian):
    system, state = pendulum()

    def end(times):
        ride_of = jk.simulate(system, state, jnp.stack([times[0], times[1]]))
        return ride_of.q[-1], (ride_of.u[-1], ride_of.q[0])

    times = jnp.array([0.2, 0.9])
    slopes, (u_end, _) = jacobian(end, has_aux=True)(times)
    np.testing.assert_allclose(slopes[:, 1], u_end, rtol=1e-6)  # dq/dt at the end
    np.testing.assert_allclose(slopes[:, 0], -u_end, rtol=1e-6)  # where nothing depends on the time itself


@pytest.mark.weekly
@pytest.mark.parametrize("adjoint", ["forward", "reverse"])
def test_an_invalid_batch_member_takes_no_steps(adjoint):
    """Beside one that can: a body with a negative mass, and a parameter that is no number."""

    def ride(mass, stiffness):
        motion = jk.simulate(Oscillator(mass=mass, stiffness=stiffness), AT_REST, [0.0, 0.5, 1.0], adjoint=adjoint)
        return motion["x"][-1], motion

    jacobian = jax.jacfwd if adjoint == "forward" else jax.jacrev
    batch = jnp.array([1.0, -1.0, 1.0]), jnp.array([4.0, 4.0, jnp.nan])
    slopes, found = jax.jit(jax.vmap(jacobian(ride, argnums=1, has_aux=True)))(*batch)
    np.testing.assert_array_equal(found.status, [jk.Status.COMPLETED, jk.Status.INVALID, jk.Status.INVALID])
    assert found.stats["steps"][0] > 2
    np.testing.assert_array_equal(found.stats["steps"][1:], 0)
    np.testing.assert_array_equal(found.t_end, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(slopes, [-np.sin(2.0) / 4, np.nan, np.nan], atol=1e-7)


@pytest.mark.slow
def test_a_massless_batch_member_does_not_affect_the_gradients_of_others():
    """In a system with an event: at the end, members without the event are evaluated at the start."""

    @jax.jit
    @jax.grad
    def slope(stiffness, masses):
        def last(mass):
            system = Oscillator(mass=mass, stiffness=stiffness)
            return jk.simulate(system, AT_REST, [0.0, 0.5], adjoint="reverse")["x"][-1]

        return jax.vmap(last)(masses)[0]

    expected = slope(4.0, jnp.array([1.0, 2.0]))
    assert slope(4.0, jnp.array([1.0, 0.0])) == expected
    assert slope(4.0, jnp.array([1.0, jnp.nan])) == expected


@pytest.mark.weekly
@pytest.mark.parametrize("method", [diffrax.Tsit5(), diffrax.Dopri8()], ids=["FSAL", "neither FSAL nor SSAL"])
def test_fixed_steps_and_their_derivatives_equal_those_of_diffrax(method):
    rtol, ts = 1e-11, jnp.linspace(0.0, 0.5, 6)
    _, start = pendulum()

    def ours(length):
        system = jk.catalog.DoublePendulum(mass=1.0, length=length)
        ride = jk.simulate(system, start, ts, solver=method, step=0.05, adjoint="forward")
        return jnp.stack([ride.q, ride.u])

    def theirs(length):
        term, args = jk.ode_term(jk.catalog.DoublePendulum(mass=1.0, length=length))
        saveat, adjoint = diffrax.SaveAt(ts=ts), diffrax.ForwardMode()
        control = diffrax.StepTo(jnp.linspace(0.0, 0.5, 11))
        found = diffrax.diffeqsolve(
            term, method, 0.0, 0.5, None, start, args, saveat=saveat, stepsize_controller=control, adjoint=adjoint
        )
        return jnp.stack([found.ys.q, found.ys.u])

    (value, slope), expected = (jax.jit(lambda x, f=f: jax.jvp(f, (x,), (1.0,)))(0.7) for f in (ours, theirs))
    np.testing.assert_allclose(value, expected[0], rtol=rtol, atol=rtol)
    np.testing.assert_allclose(slope, expected[1], rtol=rtol, atol=rtol)


def test_a_step_ends_at_a_discontinuity_or_halfway_to_it():
    """With the force t, each step of Heun's method misses h^3 / 6 of the place: x(1) shows the lengths of the steps.

    Steps grow by the factor 10 from 1 ms up to 0.3 s. From 0.111 s, two halves lead to 0.5 s, because a short remainder
    would make the next proposal fall below the shortest step.
    """
    force, loose = {"force": lambda t, state: t}, {"rtol": 1e6, "atol": 1e6}
    options = {"solver": diffrax.Heun(), "max_step": 0.3, "discontinuities": [0.5], **loose}
    ride = jk.simulate(Oscillator(stiffness=0.0), jk.State([0.0], [0.0]), [0.0, 1.0], force, **options)
    steps = np.array([0.001, 0.01, 0.1, 0.1945, 0.1945, 0.3, 0.2])
    np.testing.assert_allclose(ride["x"][-1], (1.0 - np.sum(steps**3)) / 6, rtol=1e-12)
