"""Derivatives of the public functions in three modes against differences, over systems of different kinds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mechanisms import RodOnPin

import jaxkane as jk
from jaxkane.catalog import CATALOG
from jaxkane.stability import linearize

H = 1e-3
STEPS = jnp.array([0.0, -2.0, -1.0, 1.0, 2.0]) * H


def rod():
    """Dependent speeds and coordinates."""
    return RodOnPin(length=0.7, damping=0.4), jnp.array([0.42, 0.56]), jnp.array([0.3])


def entry(name):
    return lambda: (CATALOG[name].example(), jnp.array(CATALOG[name].q), jnp.array(CATALOG[name].u))


SYSTEMS = {"RodOnPin": rod, **{name: entry(name) for name in ("SliderWithPinnedBar", "BarWithPiston")}}


def equations(system, q, u, inputs):
    at = (system, 0.3, q, u, inputs)
    return jk.equations_of_motion(*at), jk.accelerations(*at), jk.dependent_accelerations(*at)


def forces(system, q, u, inputs):
    return jk.constraint_forces(system, 0.3, q, u, inputs), jk.generalized_active_forces(system, 0.3, q, u, inputs)


def kinematics(system, q, u, inputs):
    """What is read of a description, and the matrix of its speeds."""
    at = (system, 0.3, q, u)
    by_name = [f(*at) for f in (jk.positions, jk.velocities, jk.orientations)]
    return by_name, jk.kinetic_energy(*at), jk.mass_matrix(*at), jk.dependent_speeds(*at), jk.partial_velocities(*at)


def modes(system, q, u, inputs):
    """Of the linear model of an instant; coordinates go back to the constraint that parameters move."""
    if system.dependent_coordinates:
        q = jk.assemble(system, {"y": q[0], "x": q[1]}, free=("x",)).q
    model = linearize(system, jk.State(q, u), inputs, steady=False)
    x = model.eigenvalues
    return model.A, model.B, jnp.max(x.real), jnp.max(x.imag)


FUNCTIONS = {f.__name__: f for f in (equations, forces, kinematics, modes)}


@pytest.mark.weekly
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("f", FUNCTIONS)
def test_derivatives_in_three_modes_agree_with_differences(name, f):
    """The derivative of a weighted sum of all results, along one direction of parameters, state and inputs."""
    rtol = 1e-6
    system, q, u = SYSTEMS[name]()
    inputs = {k: jnp.array(0.5 + i) for i, k in enumerate(system.inputs)}
    x, unravel = ravel_pytree((system, q, u, inputs))
    rng = np.random.default_rng(7)
    direction = jnp.asarray(rng.uniform(-1, 1, x.size)) * jnp.maximum(jnp.abs(x), 0.1)
    weights = jnp.asarray(rng.uniform(0.5, 1.5, 300))

    def along(s):
        y = ravel_pytree(FUNCTIONS[f](*unravel(x + s * direction)))[0]
        return weights[: y.size] @ y  # as many weights as there are numbers, or an error

    @jax.jit
    def all_modes(s):
        reverse = jax.grad(along)
        value, forward = jax.jvp(along, (s,), (jnp.ones_like(s),))
        back, nested = jax.jvp(reverse, (s,), (jnp.ones_like(s),))
        return jnp.stack([value, forward, back, nested])

    rows = np.stack([all_modes(s) for s in STEPS])
    here, (a, b, c, d) = rows[0], rows[1:]
    slope, curvature = ((8 * (c - b) - (d - a)) / (12 * H))[[0, 2]]
    np.testing.assert_allclose(here[1:3], slope, rtol=rtol, atol=rtol * abs(here[0]))
    np.testing.assert_allclose(here[3], curvature, rtol=10 * rtol, atol=rtol * abs(here[1]))
