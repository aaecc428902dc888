"""Which sums of the bodies' parameters motions determine, in words, and with which values. Knows regressors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from ..._description.system import System
from ..._method.body_parts import Bodies
from ..._method.drift import has_configuration_constraints
from .._result.base_parameters import BaseParameters
from .base_structure import equations_at, random_states, structure_of
from .base_words import with_lengths
from .columns import Chosen, Names, Regressor, chosen_of
from .equation_error import estimated
from .instants import Instants, Motions, instants_of
from .linearity import check_linear


def base_parameters(
    system: System | Regressor,
    motions: Motions | None = None,
    *,
    bodies: Bodies = None,
    parameters: Names = (),
    sigma: Mapping[str, float] | None = None,
    spacing: float | None = None,
    flat: float = 0.5,
) -> BaseParameters:
    """Which sums of mass, first moment, inertia and other parameters are determined, and with data their values.

        print(base_parameters(arm, parameters=("friction",)))     # by any motion
        print(base_parameters(arm, trials))                       # by these, with values and deviations

    **Arguments:**

    - `system`; `bodies`, `parameters`: as of `regressor`. Or a `Regressor` of many instants (by `jax.vmap`) alone.
    - `motions`: none, for what any motion determines; or measured or simulated ones, as of `instants_of`.
    - `sigma`: by speed, the standard deviation of what remains in its equation [N m, N]; by default estimated.
    - `spacing` [s]: of knots, as of `instants_of`.
    - `flat`: a combination whose standard deviation exceeds this part of its size is called undetermined.

    **Returns:** `BaseParameters`. Estimates come from measured accelerations, second derivatives of noisy measurements:
    they are biased towards zero where the noise is not small, a guess to begin a fit from.

    **Raises:** `ValueError` as `regressor` and `instants_of`.
    """
    if isinstance(system, Regressor):
        return _of_regressor(system, sigma, flat)
    chosen = chosen_of(system, bodies, parameters)
    dtype = jnp.result_type(float)
    check_linear(chosen, np.zeros((), dtype), None)
    structure = structure_of_states(chosen)
    if motions is None:
        return structure
    return estimated(structure, *equations_at(chosen, instants_of(system, motions, spacing=spacing)), sigma, flat)


def _of_regressor(given: Regressor, sigma: Mapping[str, float] | None, flat: float) -> BaseParameters:
    n, p = given.matrix.shape[-2:]
    if given.matrix.ndim < 3:
        raise ValueError(
            "base_parameters of a Regressor needs those of many instants: jax.vmap(lambda t, q, u, u_dot: "
            "regressor(system, t, q, u, u_dot))(...), whose matrix has leading axes."
        )
    Y, tau = np.asarray(given.matrix).reshape(-1, n, p), np.asarray(given.forces).reshape(-1, n)
    values = np.asarray(given.values).reshape(-1, p)[0]
    fine = np.all(np.isfinite(Y), axis=(1, 2)) & np.all(np.isfinite(tau), axis=1)
    structure = structure_of(given.names, given.units, values, Y[fine], tau[fine])
    return estimated(structure, given.speeds, Y[fine], tau[fine], np.zeros(int(fine.sum()), int), sigma, flat)


def structure_of_states(chosen: Chosen) -> BaseParameters:
    """From the regressor at random states."""
    system, states = chosen.system, states_for(chosen)
    _, Y, tau, _ = equations_at(chosen, states)
    values = np.asarray(chosen.values(jnp.asarray(states.t[0]), jnp.asarray(states.q[0])))
    found = structure_of(chosen.names, chosen.units, values, Y, tau)
    if has_configuration_constraints(system, jnp.zeros((), jnp.result_type(float)), jnp.asarray(states.q[0])):
        return found
    return dataclasses.replace(found, texts=with_lengths(found, chosen, states))


def states_for(chosen: Chosen) -> Instants:
    """Random states, some three times as many as the numbers that they could determine."""
    return random_states(chosen.system, 10 + 3 * -(-len(chosen.names) // len(chosen.system.speeds)))
