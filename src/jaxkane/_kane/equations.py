"""The public functions of Kane's method, as arrays, and why the equations have no solution where they have none.

Each is one compiled function (`_scalarjit.function`), alone, under `jax.jit` and in a derivative of any order. The
method itself is `KaneEquations`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component, as_vector, matvec, rounding_of_pivots, stack, sub
from .._scalarjit.function import ScalarFunction
from .._system.motion import Force, kinetic_energy_of
from .._system.system import System
from .arguments import as_array, as_row, check_is_system, check_time, checked_values, is_concrete, refuse_incomplete
from .checks import check_system
from .constraints import SINGULAR_ROUNDING, check_left_out, constraint_rows, dependent_speeds_from
from .kanes_method import KaneEquations, jvp, motion_rates, rates_and_equations

InputValues = Mapping[str, Component] | None


def checked_arrays(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None):
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
        q = check_left_out(system, t, q, left_out)
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
    return rates_and_equations(*checked_arrays(system, t, q, u, inputs))[1:]


def accelerations(system: System, t: Component, q: Any, u: Any, inputs: InputValues = None) -> Float[Array, " n"]:
    """u_dot (n,): time derivatives of the independent speeds, M^-1 f. Arguments as `equations_of_motion`.

    **Raises:** `ValueError` as `equations_of_motion`, and for a speed that no mass moves with, or constraints that
    cannot be solved for the dependent speeds; under a trace these are NaN or infinite.
    """
    arrays = checked_arrays(system, t, q, u, inputs)
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
    return _partial_velocities(*checked_arrays(system, t, q, u, inputs))


@ScalarFunction
def _partial_velocities(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u, inputs)
    motion, partials = kane.motion(kane.t, kane.q, kane.u_all), kane.partials()
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
    return _generalized_active_forces(*checked_arrays(system, t, q, u, inputs))


@ScalarFunction
def _generalized_active_forces(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.active_forces(kane.partials()), q)


def generalized_inertia_forces(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None, *, u_dot: Any = None
) -> Float[Array, " n"]:
    """F*_r (n,) = -sum of V_r . dp/dt + W_r . dH/dt over the bodies, at accelerations `u_dot` (n,), by default zero.

    With `u_dot=accelerations(...)` the sum with `generalized_active_forces` vanishes: Kane's equations.
    Arguments as `equations_of_motion`.
    """
    arrays = checked_arrays(system, t, q, u, inputs)
    if u_dot is not None:
        u_dot = as_array(u_dot, system.speeds, f"{type(system).__name__}: u_dot")
    return _generalized_inertia_forces(*arrays, u_dot)


@ScalarFunction
def _generalized_inertia_forces(system, t, q, u, inputs, u_dot):
    kane = KaneEquations(system, t, q, u, inputs)
    partials = kane.partials()
    Fr_star = kane.inertia_forces(partials)
    if u_dot is not None:
        M_u_dot = matvec(kane.mass_matrix(partials), [u_dot[r] for r in range(kane.n)])
        Fr_star = [sub(x, y) for x, y in zip(Fr_star, M_u_dot, strict=True)]
    return as_vector(Fr_star, q)


def coordinate_rates(system: System, t: Component, q: Any, u: Any) -> Float[Array, " n_q"]:
    """q_dot (n_q,): rates of all coordinates, for integrators and controllers of one's own."""
    return _coordinate_rates(*checked_arrays(system, t, q, u))


@ScalarFunction
def _coordinate_rates(system, t, q, u, inputs):
    return as_vector(KaneEquations(system, t, q, u).q_dot, q)


def dependent_speeds(system: System, t: Component, q: Any, u: Any) -> Float[Array, " k"]:
    """u_dep (k,), from the velocity residuals: C_dep u_dep = -(C_ind u + c0)."""
    return _dependent_speeds(*checked_arrays(system, t, q, u))


@ScalarFunction
def _dependent_speeds(system, t, q, u, inputs):
    return as_vector(KaneEquations(system, t, q, u).u_dep, q)


def dependent_accelerations(
    system: System, t: Component, q: Any, u: Any, inputs: InputValues = None
) -> Float[Array, " k"]:
    """u_dep_dot (k,) = J u_dot - C_dep^-1 (dc/dt at frozen speeds). Arguments as `equations_of_motion`."""
    arrays = checked_arrays(system, t, q, u, inputs)
    return finite_or_explained(_dependent_accelerations(*arrays, motion_rates(*arrays)[1]), arrays)


@ScalarFunction
def _dependent_accelerations(system, t, q, u, inputs, u_dot):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.dependent_accelerations(as_row(u_dot, system.speeds, "u_dot")), q)


def constraint_jacobian(system: System, t: Component, q: Any) -> Float[Array, "k n"]:
    """J (k, n) = -C_dep^-1 C_ind: u_dep = J u for constraints without a term of their own in time."""
    return _constraint_jacobian(*checked_arrays(system, t, q, (0.0,) * len(system.speeds)))


@ScalarFunction
def _constraint_jacobian(system, t, q, u, inputs):
    return stack(KaneEquations(system, t, q, u).J).astype(q.dtype).T


def constraint_jacobian_rate(system: System, t: Component, q: Any, u: Any) -> Float[Array, "k n"]:
    """J_dot (k, n), the time derivative of J along the motion.

        J_dot = -C_dep^-1 (C_ind_dot + C_dep_dot J)

    the derivative of J(t, q) along (1, q_dot). The textbook prints a minus before C_dep_dot (Example 7).
    """
    return _constraint_jacobian_rate(*checked_arrays(system, t, q, u))


@ScalarFunction
def _constraint_jacobian_rate(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u)
    still = (0.0,) * kane.n
    _, J_dot = jvp(lambda t, *q: KaneEquations(system, t, q, still).J, (kane.t, *kane.q), (1.0, *kane.q_dot))
    return stack(J_dot).astype(q.dtype).T


def kinetic_energy(system: System, t: Component, q: Any, u: Any) -> Float[Array, ""]:
    """Kinetic energy [J] of all bodies, dependent speeds included."""
    return _kinetic_energy(*checked_arrays(system, t, q, u))


@ScalarFunction
def _kinetic_energy(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u)
    return as_vector([kinetic_energy_of(kane.motion(kane.t, kane.q, kane.u_all))], q)[0]


# -- why the equations have no solution

_equations = jit(rates_and_equations)


def diagnosis(system: System, t: Any, q: Any, u: Any, inputs: Any = None) -> str:
    """What is wrong at a state where accelerations or rates are not finite, and what can be done; "" if nothing is.

    Looks, in this order, at the numbers given, the dependent speeds, the mass matrix, the rates of the coordinates and
    the loads.
    """
    name = type(system).__name__
    place = ", ".join(f"{c} = {float(x):.4g}" for c, x in zip(system.coordinates, q, strict=True))
    for label, names, values in (("q", system.coordinates, q), ("u", system.speeds, u)):
        wrong = [n for n, x in zip(names, np.asarray(values), strict=True) if not np.isfinite(x)]
        if wrong:
            return f"{name}: {label} is not finite: {', '.join(wrong)}."
    if system.dependent_speeds:
        C, c0 = (np.asarray(x, dtype=float) for x in constraint_rows(system, t, q))
        speeds = (*system.speeds, *system.dependent_speeds)
        choices = dependent_speeds_from(C, c0, speeds, system.dependent_speeds, name)
        if not choices.condition < 1 / SINGULAR_ROUNDING:
            absent = [s for s, column in zip(speeds, C.T, strict=True) if not column.any()]
            absent = [s for s in absent if s in system.dependent_speeds]
            cause = f"no velocity residual depends on {', '.join(absent)}" if absent else "det C_dep = 0"
            return (
                f"{name}: the constraints cannot be solved for {', '.join(system.dependent_speeds)} at {place} "
                f"({cause}): {choices.advice()}"
            )
    q_dot, M, f = (np.asarray(x) for x in _equations(system, t, q, u, inputs or {}))
    if not np.all(np.isfinite(M)):
        return f"{name}: the mass matrix is not finite at {place}."
    massless = _massless(M.astype(float), system.speeds, rounding_of_pivots(M.dtype))
    if massless:
        return (
            f"{name}: {massless}, so Kane's equations have no solution. Give the bodies that it moves mass and "
            "moments of inertia about every axis they turn about (a line has none about itself); or leave the "
            "speed out of the description."
        )
    wrong = [c for c, x in zip(system.coordinates, q_dot, strict=True) if not np.isfinite(x)]
    if wrong:
        return (
            f"{name}: the rates of {', '.join(wrong)} are not finite at {place}: angles of a sequence lock there "
            "(gimbal lock). Start elsewhere; or describe the orientation by Euler parameters or another sequence."
        )
    if not np.all(np.isfinite(f)):
        return f"{name}: {_loads_not_finite(system, t, q, u, inputs or {})} at {place}."
    return ""


def _loads_not_finite(system: System, t: Any, q: Any, u: Any, inputs: Any) -> str:
    kane = KaneEquations(system, t, q, u, inputs)
    motion = kane.motion(kane.t, kane.q, kane.u_all)
    reason = system.why_not_finite(motion, kane.inputs)
    if reason:
        return reason
    wrong = [x for x in kane.loads(motion) if not all(np.isfinite(float(c)) for c in x.vector.components)]
    if not wrong:
        return "the loads are not finite"
    places = [f"the force at {x.point.name!r}" if isinstance(x, Force) else "a torque" for x in wrong]
    opposite = len(places) > 1 and all(isinstance(x, Force) for x in wrong)
    hint = " (between two points in one place there is no direction)" if opposite else ""
    return f"{', '.join(places)} {'is' if len(places) == 1 else 'are'} not finite{hint}"


def _massless(M: np.ndarray, speeds: tuple[str, ...], rounding: float) -> str:
    """The null directions of a mass matrix, by the names of their speeds."""
    # Units apart: a speed is compared with the largest entry of its own row.
    rows = np.abs(M).max(axis=1)
    alone = [speed for speed, size in zip(speeds, rows, strict=True) if size <= rounding * rows.max()]
    if alone:
        return f"no mass moves with the speed{'s' * (len(alone) > 1)} {', '.join(alone)}"
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
    if values[0] > rounding:
        return ""
    vector = np.abs(vectors[:, 0])
    together = [speed for speed, x in zip(speeds, vector, strict=True) if x > 1e-6 * vector.max()]
    return f"the mass matrix is singular: a combination of {', '.join(together)} moves no mass"
