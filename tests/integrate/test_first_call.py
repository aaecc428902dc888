"""What a first call costs, counted: readings of the description, compiled programs, equations of a motion's program."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._integrate.integrate import solve
from jaxkane._integrate.settings import settings_for
from jaxkane._scalarjit import native
from jaxkane._scalarjit.scalar_function import ScalarFunction
from jaxkane.catalog import DoublePendulum

TS = jnp.linspace(0.0, 1.0, 11)

compiled: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **more: compiled.append(event) if "backend_compile" in event else None
)


class Bead(jk.System):
    """A particle on a circle, by its Cartesian coordinates: x_dot_dot = 0 where it is lowest and at rest."""

    mass: jk.Scalar = jk.parameter(0.7)  # [kg]
    radius: jk.Scalar = jk.parameter(0.5)  # [m]
    coordinates, dependent_coordinates = ("x", "y"), ("y",)
    speeds, dependent_speeds = ("x_rate",), ("y_rate",)
    inputs = ("push",)  # [N]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_rate"] * N.x + u["y_rate"] * N.y)
        return jk.Motion([jk.Body(self.mass, 0.0, P)])

    def loads(self, t, q, u, motion, inputs):
        bead = motion.bodies[0]
        return [jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["push"] * motion.N.x, bead)]

    def configuration_constraints(self, t, q):
        return [q["x"] ** 2 + q["y"] ** 2 - self.radius**2]


def first_trajectory(system):
    state = jk.assemble(system, {"x": 0.3, "y": -0.3}, {"x_rate": 0.1})
    return jk.simulate(system, state, TS)


@pytest.mark.slow
def test_system_methods_are_called_at_most_three_times():
    """Once for its check and once for all that the method asks; and the check of its constraints."""
    count = itertools.count()  # whose next number Python finds without changing what the class reads

    class Counted(Bead):
        def motion(self, t, q, u):
            next(count)
            return super().motion(t, q, u)

    ride = first_trajectory(Counted())
    assert ride.ok
    assert 1 <= next(count) <= 3
    n = next(count)
    jk.accelerations(Counted(), 0.0, ride.q[0], ride.u[0], {"push": 1.0})
    jk.kinetic_energy(Counted(), 0.0, ride.q[0], ride.u[0])
    assert next(count) <= n + 2


def test_assemble_compiles_nothing():
    """What is asked a few times, by the check and by Newton's method, is answered by NumPy."""

    class Another(Bead):
        radius: jk.Scalar = jk.parameter(0.4)

    system = Another()
    compiled.clear()
    state = jk.assemble(system, {"x": 0.3, "y": -0.3}, {"x_rate": 0.1})
    assert not compiled
    np.testing.assert_allclose(state.q, [0.3, -np.sqrt(0.4**2 - 0.3**2)], rtol=1e-15)


@pytest.mark.slow
def test_the_first_simulation_compiles_few_programs():
    """diffrax compares its own result codes before it is compiled."""

    class Another(Bead):
        radius: jk.Scalar = jk.parameter(0.45)

    system = Another()
    compiled.clear()
    assert first_trajectory(system).ok
    assert 1 <= len(compiled) <= 4


@pytest.mark.slow
def test_a_simulation_without_differentiation_gives_the_same_numbers():
    ride, other = first_trajectory(Bead()), jax.jit(lambda x: first_trajectory(Bead(radius=x)))(0.5)
    for x, y in zip(jax.tree.leaves(ride), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-13)
    assert ride.adjoint == other.adjoint == "controlled"


def equations(jaxpr):
    """Those inside others, too."""
    values = [jax.tree.leaves(equation.params) for equation in jaxpr.eqns]
    inner = [getattr(x, "jaxpr", x) for x in itertools.chain(*values)]
    return len(jaxpr.eqns) + sum(equations(x) for x in inner if hasattr(x, "eqns"))


@pytest.mark.slow
def test_the_program_of_a_simulation_without_events_is_small():
    """Measured, with ten per cent to spare for other releases of diffrax, whose loop most of it is."""
    system = jk.catalog.DoublePendulum(mass=1.0, length=1.0)
    state = jk.State(jnp.array([1.0, -0.5]), jnp.array([0.0, 0.3]))
    arguments = (system, state, TS[0], TS, {}, settings_for(TS))
    moving, fixed = eqx.partition(arguments, eqx.is_array)
    program = jax.make_jaxpr(lambda x: eqx.filter(solve.__wrapped__(*eqx.combine(x, fixed)), eqx.is_array))(moving)
    assert equations(program.jaxpr) <= 1380


# A record is the function that it was made from.


@ScalarFunction
def _two(scale, x):
    (a, b), t = x
    product = a * b
    return {"product": [scale * product, 3.0], "sum": (a + b * t, jnp.where(a > b, a, b) / 2.0), "zero": 0.0 * t}


@pytest.mark.slow
@pytest.mark.skipif(not native.is_on(), reason="the stages are a loop without native kernels")
def test_samples_are_looked_up_once_in_a_step():
    push = {"shoulder_torque": jk.Samples(TS, jnp.cos(TS))}
    q, u = jnp.zeros(2), jnp.zeros(2)
    program = jax.make_jaxpr(lambda q: jk.simulate(DoublePendulum(), jk.State(q, u), TS, push).q)(q)
    assert "f64[7]" in str(program)  # all stages read one piece of the signal
    assert "bool[7,11]" not in str(program)


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
