"""Kane's equations as compiled programs of arrays: rates, mass matrix and right side. Knows `Instant` and sizes.

A few speeds are one scalar program. For many, f and the columns of M are programs of their own, in the order of the
bodies, and the linear system goes to LAPACK: nothing here grows faster than M itself.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from .._description.system import System
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, is_written_out, solve_positive, solve_positive_array, stack
from .kane import Instant
from .values import as_row


def motion_rates(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n_q"], Float[Array, " n"]]:
    """q_dot and u_dot: the right-hand side, from arrays that are known to fit."""
    if is_written_out(len(system.speeds)):
        return _motion_rates(system, t, q, u, inputs)
    q_dot, M, f = rates_and_equations(system, t, q, u, inputs)
    return q_dot, solve_positive_array(M, f)


def rates_and_equations(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n_q"], Float[Array, "n n"], Float[Array, " n"]]:
    """q_dot, M and f of M u_dot = f, from arrays that are known to fit."""
    if is_written_out(len(system.speeds)):
        return _equations_written_out(system, t, q, u, inputs)
    # The columns of M are one program, whose lanes are the directions.
    q_dot, f = _rates_and_forcing(system, t, q, u, inputs)
    columns = jax.vmap(lambda direction: _mass_times(system, t, q, u, inputs, direction))
    return q_dot, columns(np.eye(len(system.speeds), dtype=q.dtype)), f


def accelerations_and_mass_matrix(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """u_dot and M, from arrays that are known to fit."""
    if is_written_out(len(system.speeds)):
        return _accelerations_and_mass_matrix(system, t, q, u, inputs)
    _, M, f = rates_and_equations(system, t, q, u, inputs)
    return solve_positive_array(M, f), M


@fused
def _motion_rates(system, t, q, u, inputs):
    now = Instant(system, t, q, u, inputs)
    return as_vector(now.q_dot, q), as_vector(now.accelerations(), q)


@fused
def _equations_written_out(system, t, q, u, inputs):
    now = Instant(system, t, q, u, inputs)
    M, f = now.equations()
    return as_vector(now.q_dot, q), stack(M).astype(q.dtype), as_vector(f, q)


@fused
def _accelerations_and_mass_matrix(system, t, q, u, inputs):
    M, f = Instant(system, t, q, u, inputs).equations()
    return as_vector(solve_positive(M, f), q), stack(M).astype(q.dtype)


@fused
def _rates_and_forcing(system, t, q, u, inputs):
    now = Instant(system, t, q, u, inputs)
    return as_vector(now.q_dot, q), as_vector(now.forcing(), q)


@fused
def _mass_times(system, t, q, u, inputs, direction):
    now = Instant(system, t, q, u, inputs)
    return as_vector(now.mass_times(as_row(direction, system.speeds, "direction")), q)
