"""The operations of compiled functions. The only file outside `tests/scalarjit` that counts them."""

import jax
import jax.numpy as jnp

from jaxkane._integrate.audit import _quantities
from jaxkane._kane.kanes_method import _mass_times, _motion_rates
from jaxkane._scalarjit.native import Scalars
from jaxkane._scalarjit.program import Program

FUNCTIONS = {"rates": _motion_rates, "audit": _quantities, "column of M": _mass_times}


def program_of(function, system, q, u, *more):
    """The program of "rates" (q_dot, u_dot), of the "audit" of an instant, or of a "column of M"."""
    inputs = dict.fromkeys(system.inputs, jnp.array(0.0))
    leaves, tree = jax.tree.flatten((system, jnp.array(0.0), jnp.asarray(q), jnp.asarray(u), inputs, *more))
    return Program(jax.make_jaxpr(lambda *x: FUNCTIONS[function].__wrapped__(*jax.tree.unflatten(tree, x)))(*leaves))


def count(program):
    """Its operations. One that cannot be written as scalars is an error: it costs a factor of ten to three thousand."""
    assert program.is_fusable
    assert Scalars(program.program).graph.nodes
    return len(program.program.jaxpr.eqns)


def operations(function, system, q, u, *more):
    return count(program_of(function, system, q, u, *more))


def recorded(monkeypatch):
    """A list to which every program is added that is prepared from now on."""
    programs, prepared = [], Program.__init__
    monkeypatch.setattr(
        Program, "__init__", lambda self, *args, **options: prepared(self, *args, **options) or programs.append(self)
    )
    return programs
