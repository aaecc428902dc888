"""The public functions of Kane's method, as arrays. Knows `KaneEquations`, which holds the method itself.

Each is one compiled function (`_scalarjit.function`), alone, under `jax.jit` and in a derivative of any order.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.components import Component, matvec, sub
from .._scalarjit.function import fused
from .._scalarjit.linear import as_vector, stack
from .._system.motion import kinetic_energy_of
from .._system.system import System
from .arguments import as_array, as_row, check_is_system, check_time, checked_values, refuse_incomplete
from .checks import check_system, diagnosis, is_concrete, met_or_refused
from .evaluate import jvp
from .kane import KaneEquations, motion_rates, rates_and_equations

InputValues = Mapping[str, Component] | None


def _arrays(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None):
    """The arguments of a public function as arrays of one type, checked."""
    check_is_system(system)
    name = type(system).__name__
    refuse_incomplete(system, q, u)
    left_out = [c for c in system.coordinates if c not in q] if isinstance(q, Mapping) else []
    q = as_array(q, system.coordinates, f"{name}: q")
    u = as_array(u, system.speeds, f"{name}: u")
    check_time(name, t)
    t = jnp.asarray(t, dtype=q.dtype)
    checked_values(system, inputs)
    if left_out:
        q = met_or_refused(system, t, q, left_out)
    check_system(system, t, q)
    return system, t, q, u, {name: jnp.asarray(x, dtype=q.dtype) for name, x in (inputs or {}).items()}


def equations_of_motion(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """M and f of Kane's equations M u_dot = f.

    **Arguments:**

    - `system`: a `System`.
    - `t`: time [s].
    - `q` (n_q,): coordinates, consistent with the configuration constraints (see `assemble`).
    - `u` (n,): independent speeds.
    - `inputs`: numbers by name; those left out are zero.

    **Returns:** the generalized mass matrix M (n, n) and the right side f (n,).

    **Raises:** `ValueError` for wrong shapes, an unknown input, as many velocity residuals as there are not dependent
    speeds, or a description that contradicts itself.
    """
    return rates_and_equations(*_arrays(system, t, q, u, inputs))[1:]


def accelerations(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None) -> Float[Array, " n"]:
    """u_dot (n,): time derivatives of the independent speeds, M^-1 f. Arguments as `equations_of_motion`.

    **Raises:** `ValueError` as `equations_of_motion`, and for a speed that no mass moves with, or constraints that
    cannot be solved for the dependent speeds; under a trace these are NaN or infinite.
    """
    arrays = _arrays(system, t, q, u, inputs)
    return finite_or_explained(motion_rates(*arrays)[1], arrays)


def finite_or_explained(result: Any, arrays: Any) -> Any:
    """`result` of the checked arguments `arrays`, as it is under a trace, and where nothing explains that it is NaN.

    **Raises:** `ValueError` where it is not finite and the equations of motion have no solution.
    """
    numbers = jax.tree.leaves(result)
    if is_concrete(*numbers) and not all(np.all(np.isfinite(x)) for x in numbers):
        wrong = diagnosis(*arrays)
        if wrong:
            raise ValueError(wrong)
    return result


def mass_matrix(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None) -> Float[Array, "n n"]:
    """M (n, n), the generalized mass matrix of the independent speeds. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[0]


def forcing(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None) -> Float[Array, " n"]:
    """f (n,), the right side of M u_dot = f. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[1]


def partial_velocities(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None
) -> tuple[Float[Array, "b 3 n"], Float[Array, "b 3 n"]]:
    """V and W, each (b, 3, n): partial velocities of the mass centres and partial angular velocities of the b bodies.

    Components are in N. The dependent speeds are eliminated: the columns belong to the n independent speeds.
    Arguments as `equations_of_motion`.
    """
    return _partial_velocities(*_arrays(system, t, q, u, inputs))


@fused
def _partial_velocities(system, t, q, u, inputs):
    now = KaneEquations(system, t, q, u, inputs)
    motion, partials = now.motion(now.t, now.q, now.u_all), now.partials()
    V, W = [], []
    for i, body in enumerate(motion.bodies):
        for columns, j, frame in ((V, 0, body.center.velocity.frame), (W, 1, body.frame)):
            vectors = [frame.vector(*bodies[i][j]).components_in(motion.N) for bodies, _ in partials]
            columns.append(stack(vectors).astype(q.dtype).T)
    return jnp.stack(V), jnp.stack(W)


def generalized_active_forces(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None
) -> Float[Array, " n"]:
    """F_r (n,) = sum of F . V_r + T . W_r over the loads. Arguments as `equations_of_motion`."""
    return _generalized_active_forces(*_arrays(system, t, q, u, inputs))


@fused
def _generalized_active_forces(system, t, q, u, inputs):
    now = KaneEquations(system, t, q, u, inputs)
    return as_vector(now.active_forces(now.partials()), q)


def generalized_inertia_forces(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None, *, u_dot: Any = None
) -> Float[Array, " n"]:
    """F*_r (n,) = -sum of V_r . dp/dt + W_r . dH/dt over the bodies, at accelerations `u_dot` (n,), by default zero.

    With `u_dot=accelerations(...)` the sum with `generalized_active_forces` vanishes: Kane's equations.
    Arguments as `equations_of_motion`.
    """
    arrays = _arrays(system, t, q, u, inputs)
    if u_dot is not None:
        u_dot = as_array(u_dot, system.speeds, f"{type(system).__name__}: u_dot")
    return _generalized_inertia_forces(*arrays, u_dot)


@fused
def _generalized_inertia_forces(system, t, q, u, inputs, u_dot):
    now = KaneEquations(system, t, q, u, inputs)
    partials = now.partials()
    Fr_star = now.inertia_forces(partials)
    if u_dot is not None:
        M_u_dot = matvec(now.mass_matrix(partials), [u_dot[r] for r in range(now.n)])
        Fr_star = [sub(x, y) for x, y in zip(Fr_star, M_u_dot, strict=True)]
    return as_vector(Fr_star, q)


def coordinate_rates(system: System, t: Component, q: Any, u: Any) -> Float[Array, " n_q"]:
    """q_dot (n_q,): rates of all coordinates, for integrators and controllers of one's own."""
    return _coordinate_rates(*_arrays(system, t, q, u))


@fused
def _coordinate_rates(system, t, q, u, inputs):
    return as_vector(KaneEquations(system, t, q, u).q_dot, q)


def dependent_speeds(system: System, t: Component, q: Any, u: Any) -> Float[Array, " k"]:
    """u_dep (k,), from the velocity residuals: C_dep u_dep = -(C_ind u + c0)."""
    return _dependent_speeds(*_arrays(system, t, q, u))


@fused
def _dependent_speeds(system, t, q, u, inputs):
    return as_vector(KaneEquations(system, t, q, u).u_dep, q)


def dependent_accelerations(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None
) -> Float[Array, " k"]:
    """u_dep_dot (k,) = J u_dot - C_dep^-1 (dc/dt at frozen speeds). Arguments as `equations_of_motion`."""
    arrays = _arrays(system, t, q, u, inputs)
    return finite_or_explained(_dependent_accelerations(*arrays, motion_rates(*arrays)[1]), arrays)


@fused
def _dependent_accelerations(system, t, q, u, inputs, u_dot):
    now = KaneEquations(system, t, q, u, inputs)
    return as_vector(now.dependent_accelerations(as_row(u_dot, system.speeds, "u_dot")), q)


def constraint_jacobian(system: System, t: Component, q: Any) -> Float[Array, "k n"]:
    """J (k, n) = -C_dep^-1 C_ind: u_dep = J u for constraints without a term of their own in time."""
    return _constraint_jacobian(*_arrays(system, t, q, (0.0,) * len(system.speeds)))


@fused
def _constraint_jacobian(system, t, q, u, inputs):
    return stack(KaneEquations(system, t, q, u).J).astype(q.dtype).T


def constraint_jacobian_rate(system: System, t: Component, q: Any, u: Any) -> Float[Array, "k n"]:
    """J_dot (k, n), the time derivative of J along the motion.

        J_dot = -C_dep^-1 (C_ind_dot + C_dep_dot J)

    found by differentiating J(t, q) along (1, q_dot). The textbook prints a minus before C_dep_dot (Example 7).
    """
    return _constraint_jacobian_rate(*_arrays(system, t, q, u))


@fused
def _constraint_jacobian_rate(system, t, q, u, inputs):
    now = KaneEquations(system, t, q, u)
    still = (0.0,) * now.n
    _, J_dot = jvp(lambda t, *q: KaneEquations(system, t, q, still).J, (now.t, *now.q), (1.0, *now.q_dot))
    return stack(J_dot).astype(q.dtype).T


def kinetic_energy(system: System, t: Component, q: Any, u: Any) -> Float[Array, ""]:
    """Kinetic energy [J] of all bodies, dependent speeds included."""
    return _kinetic_energy(*_arrays(system, t, q, u))


@fused
def _kinetic_energy(system, t, q, u, inputs):
    now = KaneEquations(system, t, q, u)
    return as_vector([kinetic_energy_of(now.motion(now.t, now.q, now.u_all))], q)[0]
