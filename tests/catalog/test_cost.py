"""What the right-hand sides cost, counted: operations of the traced program, and of its derivative."""

import jax
import jax.numpy as jnp
import pytest
from programs import count, program_of, recorded
from test_laws import QUICK, SLOW

import jaxkane as jk
from jaxkane.catalog import CATALOG


@pytest.mark.weekly_cases(
    "WhippleBicycle",
    "SpatialDoublePendulum",
    "Aircraft",
    "AircraftEulerParameters",
    "SliderCrankWithClearance",
    "Rattleback",
    "DoublePendulum",
    "CompassGait",
    "RigidBody",
    "ColumnFrameAndDisk",
)
@pytest.mark.parametrize("name", CATALOG)
def test_operation_counts_do_not_increase(name):
    entry = CATALOG[name]
    program = program_of("rates", entry.example(), entry.q, entry.u)
    n = len(program.program.jaxpr.invars)
    tangent = program.tangent((True,) * n)
    assert count(program) <= entry.operations
    assert count(tangent) <= 4 * entry.operations  # in all directions that there are
    assert count(tangent.transposed((False,) * n + (True,) * n))


OF_STATES = "equations_of_motion accelerations partial_velocities generalized_inertia_forces coordinate_rates"
OF_CONSTRAINTS = "dependent_speeds dependent_accelerations constraint_jacobian_rate constraint_forces"


@pytest.mark.slow
@pytest.mark.filterwarnings("error:.*its description uses")
@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=SLOW) for name in CATALOG])
def test_every_public_function_is_one_program_of_scalars(name, monkeypatch):
    """Traced, and not compiled: what cannot be part of one function is told of, and is an error here."""
    entry = CATALOG[name]
    system, q, u = entry.example(), jnp.array(entry.q), jnp.array(entry.u)
    programs = recorded(monkeypatch)
    jk.forget()
    names = f"{OF_STATES} {OF_CONSTRAINTS if system.dependent_speeds else ''}".split()
    for f in (getattr(jk, name) for name in names):
        jax.eval_shape(lambda system, q, u, f=f: f(system, 0.0, q, u), system, q, u)
    assert len(programs) >= len(names)
    assert all(map(count, programs))
