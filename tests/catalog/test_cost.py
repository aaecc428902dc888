"""What the right-hand sides cost, counted: operations of the traced program, and of its derivative."""

import jax
import jax.numpy as jnp
import pytest
from test_laws import QUICK, SLOW

import jaxkane as jk
from jaxkane._kane.kanes_method import _motion_rates
from jaxkane._scalarjit.backends.native import Scalars
from jaxkane._scalarjit.program import Program
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
    system = entry.example()
    args = (
        system,
        jnp.array(0.0),
        jnp.array(entry.q),
        jnp.array(entry.u),
        dict.fromkeys(system.inputs, jnp.array(0.0)),
    )
    leaves, program = _motion_rates.program(*args)
    size = lambda program: len(program.program.jaxpr.eqns)  # noqa: E731
    tangent = program.tangent((True,) * len(leaves))
    assert size(program) <= entry.operations
    assert size(tangent) <= 4 * entry.operations  # in all directions that there are
    # One operation that cannot be written as scalars would cost a factor of ten to three thousand.
    cotangent = tangent.transposed((False,) * len(leaves) + (True,) * len(leaves))
    for one in (program, tangent, cotangent):
        assert one.is_fusable
        assert Scalars(one.program).graph.nodes  # raises, with the operation, where one is unknown


OF_STATES = "equations_of_motion accelerations partial_velocities generalized_inertia_forces coordinate_rates"
OF_CONSTRAINTS = "dependent_speeds dependent_accelerations constraint_jacobian_rate constraint_forces"


@pytest.mark.slow
@pytest.mark.filterwarnings("error:.*its description uses")
@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=SLOW) for name in CATALOG])
def test_every_public_function_is_one_program_of_scalars(name, monkeypatch):
    """Traced, and not compiled: what cannot be part of one function is told of, and is an error here."""
    entry, programs = CATALOG[name], []
    system, q, u = entry.example(), jnp.array(entry.q), jnp.array(entry.u)
    prepared = Program.__init__
    monkeypatch.setattr(
        Program, "__init__", lambda self, *args, **options: prepared(self, *args, **options) or programs.append(self)
    )
    jk.forget()
    names = f"{OF_STATES} {OF_CONSTRAINTS if system.dependent_speeds else ''}".split()
    for f in (getattr(jk, name) for name in names):
        jax.eval_shape(lambda system, q, u, f=f: f(system, 0.0, q, u), system, q, u)
    assert len(programs) >= len(names)
    assert all(one.is_fusable and Scalars(one.program).graph.nodes for one in programs)
