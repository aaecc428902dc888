"""Systems of many speeds: columns of M and f by transposition, in the order of the bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.chain import Chain

import jaxkane as jk
from jaxkane._kane import kanes_method as rates
from jaxkane._scalarjit import components
from jaxkane._scalarjit.program import Program


class DampedChain(Chain):
    """With a damper in the last joint."""

    damping: jk.Scalar = jk.parameter(0.2)

    def loads(self, t, q, u, motion, inputs):
        last = motion.bodies[-1].frame
        torque = jk.Torque(-self.damping * u[self.n - 1] * (last.y if self.n % 2 == 0 else last.x), last)
        return [*super().loads(t, q, u, motion, inputs), torque]


def at(system, n, seed=0):
    rng = np.random.default_rng(seed)
    return system, jnp.array(0.4), jnp.asarray(rng.uniform(-2, 2, n)), jnp.asarray(rng.normal(size=n)), {}


def bicycle():
    system = jk.catalog.WhippleBicycle.benchmark()
    state = jk.assemble(system, {"roll": 0.1, "steer": 0.2}, {"roll_rate": 0.3, "rear_wheel_rate": -12.0})
    return system, jnp.array(0.0), state.q, state.u, {"steer_torque": jnp.array(0.7)}


SYSTEMS = {
    "chain": lambda: at(DampedChain(n=5), 5),
    "bicycle": bicycle,  # dependent speeds
    "double pendulum": lambda: at(jk.catalog.DoublePendulum(mass=1.0, length=0.7), 2),
}


@pytest.mark.weekly
@pytest.mark.parametrize("name", SYSTEMS)
def test_scalar_and_array_programs_agree(name, monkeypatch):
    args = SYSTEMS[name]()
    moved = jax.tree.map(lambda x: 0.3 * jnp.ones_like(x), args)
    found = []
    for most in (12, 0):
        monkeypatch.setattr(components, "_UNROLL_UP_TO", most)
        rates = lambda *args: (jk.equations_of_motion(*args), jk.accelerations(*args))  # noqa: E731
        found.append(jax.jit(lambda *args: jax.jvp(rates, args, moved))(*args))  # noqa: B023
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * np.abs(a).max())  # noqa: E731
    jax.tree.map(close, *found)


@pytest.mark.slow
def test_scalar_and_array_programs_agree_in_reverse_mode(monkeypatch):
    system, t, q, u, inputs = SYSTEMS["double pendulum"]()
    found = []
    for most in (12, 0):
        monkeypatch.setattr(components, "_UNROLL_UP_TO", most)
        last = lambda *args: jk.accelerations(args[0], t, *args[1:], inputs)[1]  # noqa: E731
        found.append(jax.jit(jax.grad(last, argnums=(0, 1, 2)))(system, q, u))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12), *found)


@pytest.mark.weekly
def test_the_energy_of_a_long_chain_is_conserved():
    chain, _, q, u, _ = at(Chain(n=14), 14)
    assert not components.is_written_out(14)
    state = jk.State(0.3 * q, 0.5 * u)
    ride = jk.simulate(chain, state, jnp.linspace(0.0, 0.5, 6), rtol=1e-9, atol=1e-9)
    assert ride.ok

    def energy(q, u):
        motion = chain.motion(0.0, q, u)
        height = sum(body.mass * body.center.position.to(motion.N)[2] for body in motion.bodies)
        return jk.kinetic_energy(chain, 0.0, q, u) + 9.81 * height

    E = jax.jit(jax.vmap(energy))(ride.q, ride.u)
    T = jk.kinetic_energy(chain, 0.0, ride.q[-1], ride.u[-1])
    assert float(jnp.abs(E - E[0]).max()) < 1e-7 * float(T)
    assert float(jnp.abs(ride.q[-1] - ride.q[0]).max()) > 0.3


@pytest.mark.slow
def test_the_operation_count_is_proportional_to_the_number_of_links():
    def operations(n):
        leaves, treedef = jax.tree.flatten((*at(Chain(n=n), n), jnp.ones(n)))
        column = lambda *x: rates._mass_times.__wrapped__(*jax.tree.unflatten(treedef, x))  # noqa: E731
        traced = jax.make_jaxpr(column)(*leaves)
        return len(traced.jaxpr.eqns), len(Program(traced).program.jaxpr.eqns)

    (traced_10, kept_10), (traced_40, kept_40) = operations(10), operations(40)
    assert traced_40 < 4.6 * traced_10
    assert kept_40 < 4.6 * kept_10 < 4.6 * 700
