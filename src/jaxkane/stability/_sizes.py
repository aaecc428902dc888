"""Sizes of the terms in the equations of a steady motion, to decide in any units whether a rate or residual is zero.

Example: a pendulum with a period of hours has an acceleration of 1e-7 rad/s^2 at 0.5 rad from its equilibrium. A
pendulum with a period of nanoseconds has 1e2 rad/s^2 at its equilibrium by rounding. Both must be compared
with g / l, the acceleration by the weight without the constraint force.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._integrate.inputs import Coordinates, Speeds
from .._kane.arguments import Row, as_row
from .._kane.constraint_residuals import coordinate_units, residual_sizes
from .._kane.kanes_method import KaneEquations, unit
from .._kane.right_hand_side import first_order_rates
from .._kane.scaling import SMALLEST_SIZE, term_sizes
from .._scalarjit.components import Component, Numbers, as_vector, dot, is_written_out, mul, stack, total
from .._scalarjit.scalar_function import ScalarFunction
from .._system.system import System


class Sizes(NamedTuple):
    """The size of each independent speed, and of the terms of each rate, force and residual, in its unit.

    - `u` (n,): independent speeds.
    - `q_dot` (n_q,): rates of the coordinates.
    - `f` (n,): the right side of Kane's equations M u_dot = f: loads and rates of momenta before they cancel.
    - `x_dot` (n_x,): rates of the states of the first order.
    - `h` (h,): configuration constraints.
    - `u_dep` (k,): dependent speeds.
    """

    u: Any
    q_dot: Any
    f: Any
    x_dot: Any
    h: Any
    u_dep: Any


def coordinate_sizes(system: System, q: Numbers) -> Numbers:
    """The size (n_q,) of each coordinate: 1 for an angle, else its absolute value."""
    least = np.array([1.0 if unit == "rad" else SMALLEST_SIZE for unit in coordinate_units(system)], q.dtype)
    return (np if isinstance(q, np.ndarray) else jnp).maximum(abs(q), least)


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def sizes_of(
    system: System, t: Component, q: Numbers, u: Numbers, values: Numbers, sizes: PyTree, still: np.ndarray
) -> Sizes:
    """The sizes of all terms at a state, computed by NumPy if the arrays are NumPy arrays. Sizes are not
    differentiated.

    **Arguments:**

    - `system`, `t`, `q`, `u`: the system and its state.
    - `values`: inputs and states of the first order by name.
    - `sizes`: of (q, u, values), at least their absolute values.
    - `still`: indices of the coordinates that are not cyclic.
    """
    by_numpy = isinstance(q, np.ndarray)
    xp: Any = np if by_numpy else jnp
    call = (lambda f, *args: f.numpy(*args)) if by_numpy else (lambda f, *args: f(*args))
    at = jax.lax.stop_gradient((system, t, q, u, values))
    of_q, of_u, of_values = sizes = jax.lax.stop_gradient(sizes)
    if is_written_out(len(u)):
        (q_dot, u_dep, _), (f, m, D) = call(_all_sizes, *at, sizes)
    else:
        q_dot, u_dep, vectors = _sizes_of_terms(*at, sizes)
        f, m, D = jax.vmap(lambda e: _along(*at, vectors, e))(np.eye(len(u), dtype=q.dtype))
    # The size of a speed that is zero is a T. Here a = f_r / M_rr, and T is the shortest time in which these
    # accelerations change a coordinate by its size.
    a = xp.where(m > 0, f / xp.where(m > 0, m, 1.0), 0.0)
    of_rates = (a @ xp.abs(D))[still]
    T = xp.where(of_rates > 0, of_q[still] / xp.where(of_rates > 0, of_rates, 1.0), xp.inf)
    T = xp.sqrt(xp.min(T, initial=xp.inf))
    of_u = xp.maximum(of_u, a * xp.where(T < xp.inf, T, 0.0))
    x_dot = xp.zeros(0, q.dtype)
    if system.states:
        x_dot = call(_sizes_of_state_rates, *at, (of_q, of_u, of_values))
    h = residual_sizes(*at[:3], SMALLEST_SIZE)[0]
    return Sizes(of_u, xp.maximum(q_dot, of_u @ xp.abs(D)), f, x_dot, h, u_dep)


def _term_sizes(system: System, t: Component, q: Coordinates, u: Speeds, values: Mapping[str, Array], sizes: PyTree):
    """Sizes of q_dot and u_dep, and of the vectors that are projected onto speeds: rates of momenta, then forces."""

    def terms(system: System, t: Component, q: Coordinates, u: Speeds, values: Mapping[str, Array]):
        kane = KaneEquations(system, t, q, u, values)
        rates = [x for pair in kane.momentum_rates() for vector in pair for x in vector]
        vectors = [*rates, *(x for force in kane.force_components() for x in force)]
        return as_vector(kane.q_dot, q), as_vector(kane.u_dep, q), as_vector(vectors, q)

    return term_sizes(terms, system, t, q, u, values, sizes=(None, None, *sizes))


def _projected(kane: KaneEquations, vectors: Numbers, direction: Row) -> tuple[Any, Any, Row]:
    """Along a direction of the independent speeds: the size of the force, the mass, and the rates of coordinates."""
    speeds = kane.with_dependent(direction)
    bodies, loads = kane.along_speeds(kane.velocities, speeds)
    momenta = kane.along_speeds(kane.momenta, speeds)
    velocities = [x for pair in bodies for vector in pair for x in vector]
    mass = dot(velocities, [x for pair in momenta for vector in pair for x in vector])
    velocities += [x for vector in loads for x in vector]
    # f_r = sum F . V_r: the size of each component of a vector times that of the partial velocity
    force = total(mul(vectors[i], abs(v)) for i, v in enumerate(velocities))
    return force, mass, kane.along_speeds(lambda u: kane.rates(kane.t, kane.q, u), speeds)


@ScalarFunction
def _all_sizes(system: System, t: Component, q: Coordinates, u: Speeds, values: Mapping[str, Array], sizes: PyTree):
    kane = KaneEquations(system, t, q, u, values)
    terms = _term_sizes(system, t, q, u, values, sizes)
    rows = [_projected(kane, terms[2], unit(kane.n, r)) for r in range(kane.n)]
    forces, masses, rates = ([row[i] for row in rows] for i in range(3))
    return terms, (as_vector(forces, q), as_vector(masses, q), stack(rates).astype(q.dtype).reshape(kane.n, len(q)))


@ScalarFunction
def _sizes_of_terms(
    system: System, t: Component, q: Coordinates, u: Speeds, values: Mapping[str, Array], sizes: PyTree
):
    return _term_sizes(system, t, q, u, values, sizes)


@ScalarFunction
def _along(
    system: System,
    t: Component,
    q: Coordinates,
    u: Speeds,
    values: Mapping[str, Array],
    vectors: Float[Array, " m"],
    direction: Speeds,
):
    kane = KaneEquations(system, t, q, u, values)
    force, mass, rates = _projected(kane, vectors, as_row(direction, system.speeds, "direction"))
    return as_vector([force], q)[0], as_vector([mass], q)[0], as_vector(rates, q)


@ScalarFunction
def _sizes_of_state_rates(
    system: System, t: Component, q: Coordinates, u: Speeds, values: Mapping[str, Array], sizes: PyTree
):
    zero = jnp.zeros_like(u)
    return term_sizes(first_order_rates, system, t, q, u, values, zero, sizes=(None, None, *sizes, zero))
