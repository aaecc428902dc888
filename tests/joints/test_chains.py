"""Systems of many speeds: columns of M and f by transposition, in the order of the bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.chain import Chain
from programs import operations

import jaxkane as jk


def at(system, n, seed=0):
    rng = np.random.default_rng(seed)
    return system, jnp.array(0.4), jnp.asarray(rng.uniform(-2, 2, n)), jnp.asarray(rng.normal(size=n)), {}


@pytest.mark.weekly
def test_the_energy_of_a_long_chain_is_conserved():
    chain, _, q, u, _ = at(Chain(n=14), 14)
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
    of_10, of_40 = (operations("column of M", Chain(n=n), jnp.ones(n), jnp.ones(n), jnp.ones(n)) for n in (10, 40))
    assert of_40 < 4.6 * of_10 < 4.6 * 700
