"""What a first call costs, counted: calls of the methods of a system, and compiled programs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import OnACircle

import jaxkane as jk

compiled: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **more: compiled.append(event) if "backend_compile" in event else None
)


@pytest.mark.slow
def test_system_methods_are_called_at_most_three_times():
    """Once for its check and once for all that the method asks; and the check of its constraints."""
    count = itertools.count()  # whose next number Python finds without changing what the class reads

    class Counted(OnACircle):
        def motion(self, t, q, u):
            next(count)
            return super().motion(t, q, u)

    state = jk.assemble(Counted(), {"x": 0.6, "y": -0.8}, {"x_dot": 0.1})
    ride = jk.simulate(Counted(), state, jnp.linspace(0.0, 1.0, 11))
    assert ride.ok
    assert 1 <= next(count) <= 3
    n = next(count)
    jk.accelerations(Counted(), 0.0, ride.q[0], ride.u[0])
    jk.kinetic_energy(Counted(), 0.0, ride.q[0], ride.u[0])
    assert next(count) <= n + 2


def test_assemble_compiles_nothing():
    """The check and Newton's method evaluate the system a few times only, so NumPy is used."""
    system = type("Another", (OnACircle,), {})()
    compiled.clear()
    state = jk.assemble(system, {"x": 0.3, "y": -0.9}, {"x_dot": 0.1})
    assert not compiled
    np.testing.assert_allclose(state.q, [0.3, -np.sqrt(1.0 - 0.3**2)], rtol=1e-15)
