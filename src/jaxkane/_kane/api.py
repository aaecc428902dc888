"""The public functions of Kane's method, which return arrays; and why the equations have no solution at a state.

Each function runs as one compiled program (`_scalarjit.scalar_function`), also inside `jax.jit` and for derivatives of
any order. `KaneEquations` contains the equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._common.lookup import refuse_if
from .._scalarjit.components import Component, Numbers, as_vector, matvec, rounding_of_pivots, stack, sub
from .._scalarjit.nan import constant
from .._scalarjit.scalar_function import ScalarFunction
from .._system.motion import Force, kinetic_energy_of
from .._system.system import System
from .arguments import (
    Coordinates,
    InputArrays,
    InputValues,
    Speeds,
    Time,
    as_array,
    as_row,
    check_is_system,
    check_time,
    checked_values,
    is_concrete,
    refuse_incomplete,
    refuse_multipliers,
)
from .checks import check_system
from .constraint_residuals import SINGULAR_ROUNDING, check_left_out, dependent_speeds_at
from .kanes_method import KaneEquations, as_one_program, compiled, motion_rates, rates_and_equations


def _at_state(read: Callable[[KaneEquations, Array], Array]) -> ScalarFunction:
    return ScalarFunction(lambda system, t, q, u, inputs: read(KaneEquations(system, t, q, u, inputs), q))


_generalized_active_forces = _at_state(lambda kane, q: as_vector(kane.active_forces(kane.partial_velocities()), q))
_coordinate_rates = _at_state(lambda kane, q: as_vector(kane.q_dot, q))
_dependent_speeds = _at_state(lambda kane, q: as_vector(kane.u_dep, q))
_constraint_jacobian = _at_state(lambda kane, q: stack(kane.J).astype(q.dtype).T)
_constraint_jacobian_rate = _at_state(lambda kane, q: stack(kane.J_dot()).astype(q.dtype).T)
_kinetic_energy = _at_state(
    lambda kane, q: as_vector([kinetic_energy_of(kane.motion(kane.t, kane.q, kane.u_all))], q)[0]
)


def checked_arrays(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None, *, of_motion: bool = False
):
    """Check the arguments of a public function and return them as arrays of one dtype.

    `of_motion`: whether the result depends on the accelerations. Systems with multipliers are then refused.
    """
    check_is_system(system)
    if of_motion:
        refuse_multipliers(system)
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
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """The generalized mass matrix M and the right side f of Kane's equations M u_dot = f.

    **Arguments:**

    - `system`: a `System`.
    - `t`: time [s].
    - `q`: coordinates (n_q,), or a dict by name. They must satisfy the configuration constraints (see `assemble`).
    - `u`: independent speeds (n,), or a dict by name.
    - `inputs`: a dict of numbers by name. Omitted inputs are zero.

    **Returns:** M (n, n) and f (n,).

    **Raises:** `ValueError` for wrong shapes and for an unknown input. Also if the numbers of velocity residuals and
    dependent speeds differ, or if the methods of the system contradict each other.
    """
    arrays = checked_arrays(system, t, q, u, inputs, of_motion=True)
    return as_one_program(rates_and_equations, system)(*arrays)[1:]


def accelerations(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> Float[Array, " n"]:
    """u_dot (n,) = M^-1 f: time derivatives of the independent speeds. Arguments as `equations_of_motion`.

    **Raises:** `ValueError` as `equations_of_motion`. Also if the equations of motion have no solution: for example, if
    a speed moves no mass, or if the constraints cannot be solved for the dependent speeds. If the arguments are traced,
    the result is NaN or infinite instead.
    """
    arrays = checked_arrays(system, t, q, u, inputs, of_motion=True)
    return finite_or_explained(as_one_program(motion_rates, system)(*arrays)[1], arrays)


def finite_or_explained(result: PyTree, arrays: PyTree) -> PyTree:
    """Return `result` unchanged, or explain why it is not finite.

    **Arguments:**

    - `result`: numbers that were computed from `arrays`. A traced result is returned unchanged.
    - `arrays`: the checked arguments, as `checked_arrays` returns them.

    **Raises:** `ValueError` if the result is not finite and `diagnosis` finds the reason.
    """
    numbers = jax.tree.leaves(result)
    if is_concrete(*numbers) and not all(np.all(np.isfinite(x)) for x in numbers):
        wrong = diagnosis(*arrays)
        refuse_if(wrong, wrong)
    return result


def mass_matrix(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> Float[Array, "n n"]:
    """The generalized mass matrix M (n, n) of the independent speeds. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[0]


def forcing(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None) -> Float[Array, " n"]:
    """The right side f (n,) of M u_dot = f. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[1]


def partial_velocities(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> tuple[Float[Array, "b 3 n"], Float[Array, "b 3 n"]]:
    """Partial velocities V (b, 3, n) of the mass centres and partial angular velocities W (b, 3, n) of the b bodies.

    Components are in N. The dependent speeds are eliminated, so the columns belong to the n independent speeds.
    Arguments as `equations_of_motion`.
    """
    return _partial_velocities(*checked_arrays(system, t, q, u, inputs))


@ScalarFunction
def _partial_velocities(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    kane = KaneEquations(system, t, q, u, inputs)
    motion, partials = kane.motion(kane.t, kane.q, kane.u_all), kane.partial_velocities()
    V, W = [], []
    for i, body in enumerate(motion.bodies):
        for columns, j, frame in ((V, 0, body.center.velocity.frame), (W, 1, body.frame)):
            vectors = [frame.vector(*bodies[i][j]).components_in(motion.N) for bodies, _ in partials]
            columns.append(stack(vectors).astype(q.dtype).T)
    V, W = (jnp.asarray(columns, q.dtype).reshape(len(motion.bodies), 3, kane.n) for columns in (V, W))
    return V, W


def generalized_active_forces(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> Float[Array, " n"]:
    """Generalized active forces F_r (n,): the sum of F . V_r + T . W_r over all loads.

    Arguments as `equations_of_motion`.
    """
    return _generalized_active_forces(*checked_arrays(system, t, q, u, inputs))


def generalized_inertia_forces(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None, *, u_dot: Numbers = None
) -> Float[Array, " n"]:
    """Generalized inertia forces F*_r (n,): minus the sum of V_r . dp/dt + W_r . dH/dt over all bodies.

    Kane's equations are F_r + F*_r = 0, with F_r from `generalized_active_forces` and `u_dot=accelerations(...)`.

    **Arguments:** as `equations_of_motion`, and

    - `u_dot`: accelerations (n,), or a dict by name. The default is zero.
    """
    arrays = checked_arrays(system, t, q, u, inputs, of_motion=True)
    if u_dot is not None:
        u_dot = as_array(u_dot, system.speeds, f"{type(system).__name__}: u_dot")
    return _generalized_inertia_forces(*arrays, u_dot)


@ScalarFunction
def _generalized_inertia_forces(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds | None
):
    kane = KaneEquations(system, t, q, u, inputs)
    partials = kane.partial_velocities()
    Fr_star = kane.inertia_forces(partials)
    if u_dot is not None:
        M_u_dot = matvec(kane.mass_matrix(partials), [u_dot[r] for r in range(kane.n)])
        Fr_star = [sub(x, y) for x, y in zip(Fr_star, M_u_dot, strict=True)]
    return as_vector(Fr_star, q)


def coordinate_rates(system: System, t: Component, q: Numbers, u: Numbers) -> Float[Array, " n_q"]:
    """Rates q_dot (n_q,) of all coordinates, for your own integrators and controllers.

    Arguments as `equations_of_motion`, without `inputs`.
    """
    return _coordinate_rates(*checked_arrays(system, t, q, u))


def dependent_speeds(system: System, t: Component, q: Numbers, u: Numbers) -> Float[Array, " k"]:
    """Dependent speeds u_dep (k,) from the velocity residuals: C_dep u_dep = -(C_ind u + c0).

    Arguments as `equations_of_motion`, without `inputs`.
    """
    return _dependent_speeds(*checked_arrays(system, t, q, u))


def dependent_accelerations(
    system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None
) -> Float[Array, " k"]:
    """Dependent accelerations u_dep_dot (k,) = J u_dot - C_dep^-1 (dc/dt at constant speeds).

    Arguments as `equations_of_motion`.
    """
    arrays = checked_arrays(system, t, q, u, inputs, of_motion=True)
    u_dot = as_one_program(motion_rates, system)(*arrays)[1]
    return finite_or_explained(_dependent_accelerations(*arrays, u_dot), arrays)


@ScalarFunction
def _dependent_accelerations(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.dependent_accelerations(as_row(u_dot, system.speeds, "u_dot")), q)


def constraint_jacobian(system: System, t: Component, q: Numbers) -> Float[Array, "k n"]:
    """The Jacobian J (k, n) = -C_dep^-1 C_ind of the velocity residuals C_ind u + C_dep u_dep + c0.

    With c0 = 0, u_dep = J u. Arguments as `equations_of_motion`, without `u` and `inputs`.
    """
    return _constraint_jacobian(*checked_arrays(system, t, q, (0.0,) * len(system.speeds)))


def constraint_jacobian_rate(system: System, t: Component, q: Numbers, u: Numbers) -> Float[Array, "k n"]:
    """J_dot (k, n), the time derivative of J along the motion.

        J_dot = -C_dep^-1 (C_ind_dot + C_dep_dot J)

    This is the derivative of J(t, q) along (1, q_dot). The textbook prints a minus sign before C_dep_dot (Example 7).
    Arguments as `equations_of_motion`, without `inputs`.
    """
    return _constraint_jacobian_rate(*checked_arrays(system, t, q, u))


def kinetic_energy(system: System, t: Component, q: Numbers, u: Numbers) -> Float[Array, ""]:
    """Kinetic energy [J] of all bodies. The dependent speeds are computed from the constraints.

    Arguments as `equations_of_motion`, without `inputs`.
    """
    return _kinetic_energy(*checked_arrays(system, t, q, u))


def diagnosis(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None) -> str:
    """Explain why accelerations or rates are not finite at a state, and what to do. Return "" if no cause is found.

    The order of the checks is: the given numbers, the dependent speeds, the mass matrix, the rates of the coordinates,
    the loads.
    """
    system, t, q, u, inputs = constant((system, t, q, u, inputs))
    if not is_concrete(system, t, q, u, inputs):
        return ""
    name = type(system).__name__
    place = ", ".join(f"{c} = {float(x):.4g}" for c, x in zip(system.coordinates, q, strict=True))
    for label, names, values in (("q", system.coordinates, q), ("u", system.speeds, u)):
        wrong = [n for n, x in zip(names, np.asarray(values), strict=True) if not np.isfinite(x)]
        if wrong:
            return f"{name}: {label} is not finite: {', '.join(wrong)}."
    if system.dependent_speeds:
        choices = dependent_speeds_at(system, t, q)
        if not choices.condition < 1 / SINGULAR_ROUNDING:
            absent = ", ".join(choices.absent)
            cause = f"no velocity residual depends on {absent}" if absent else "det C_dep = 0"
            return (
                f"{name}: the constraints cannot be solved for {', '.join(system.dependent_speeds)} at {place} "
                f"({cause}): {choices.advice()}"
            )
    q_dot, M, f = (np.asarray(x) for x in compiled[rates_and_equations](system, t, q, u, inputs or {}))
    if not np.all(np.isfinite(M)):
        return f"{name}: the mass matrix is not finite at {place}."
    rounding, M = rounding_of_pivots(M.dtype), M.astype(float)
    scale = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    values, vectors = np.linalg.eigh(M * scale[:, None] * scale)
    null = vectors[:, 0] * scale / np.abs(vectors[:, 0] * scale).max()
    if values[0] <= rounding:  # a linear combination of the speeds without kinetic energy
        together = ", ".join(s for s, x in zip(system.speeds, null, strict=True) if abs(x) > 1e-6)
        if _moves_nothing(system, t, q, u, null):
            return (
                f"{name}: the speeds {together} can change together without moving any body at {place}, so that their "
                "accelerations are not determined. The cause is gimbal lock, or two speeds that describe the same "
                "motion. Choose another state, or use Euler parameters or another sequence of angles for the "
                "orientation."
            )
        # The mass of a speed is the largest entry of its row. Differences between the units are ignored.
        rows = np.abs(M).max(axis=1)
        alone = [speed for speed, size in zip(system.speeds, rows, strict=True) if size <= rounding * rows.max()]
        massless = f"no mass moves with the speed{'s' * (len(alone) > 1)} {', '.join(alone)}"
        if not alone:
            massless = f"the mass matrix is singular: a combination of {together} does not move any mass"
        return (
            f"{name}: {massless}, so Kane's equations have no solution. Add masses, and moments of inertia about "
            "all axes of rotation (a thin rod needs one about its own axis, too), or remove the speed from the system."
        )
    # cos(pi / 2) is 6e-17, so the rates of angles in gimbal lock are finite: 1e16 times the speeds.
    largest = 1e12 * float(np.abs(u).max(initial=0.0)) or np.inf
    wrong = [c for c, x in zip(system.coordinates, q_dot, strict=True) if not np.isfinite(x) or abs(x) > largest]
    if wrong:
        return (
            f"{name}: the rates of {', '.join(wrong)} are not finite, or above 1e12 times the speeds, at {place}: "
            "the angles are in gimbal lock. Choose another state, or use Euler parameters or another sequence of "
            "angles for the orientation."
        )
    if not np.all(np.isfinite(f)):
        return f"{name}: {_loads_not_finite(system, t, q, u, inputs or {})} at {place}."
    return ""


def _loads_not_finite(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues) -> str:
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
    hint = " (two points coincide, so the force between them has no direction)" if opposite else ""
    return f"{', '.join(places)} {'is' if len(places) == 1 else 'are'} not finite{hint}"


def _moves_nothing(system: System, t: Component, q: Numbers, u: Numbers, direction: np.ndarray) -> bool:
    """Whether a combination of the speeds leaves all bodies at rest, although the single speeds move bodies."""
    at = _body_velocities.numpy(system, t, q, u, np.asarray(direction, q.dtype))
    each = [_body_velocities.numpy(system, t, q, u, np.asarray(x, q.dtype)) for x in np.diag(direction)]
    sizes = np.max(np.linalg.norm(each, axis=-1), axis=0)  # (2b,) of velocities and angular velocities
    return bool(sizes.any() and np.all(np.linalg.norm(at, axis=-1) <= 1e-6 * sizes))


@ScalarFunction.compile_cheaply
def _body_velocities(system: System, t: Time, q: Coordinates, u: Speeds, direction: Speeds):
    kane = KaneEquations(system, t, q, u)
    along = kane.with_dependent(as_row(direction, system.speeds, "direction"))
    return stack([x for pair in kane.along_speeds(kane.velocities, along)[0] for x in pair]).astype(q.dtype)
