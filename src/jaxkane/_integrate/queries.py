"""Positions, velocities, orientations, forces of constraint and outputs, at one time or along a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._kane.equations import InputValues, _dependent_accelerations, checked_arrays, finite_or_explained
from .._kane.kanes_method import KaneEquations, motion_rates
from .._kane.reactions import forces_now, multipliers_now
from .._kane.rhs import outputs_at, rates
from .._scalarjit.cache_key import jit
from .._scalarjit.components import as_vector
from .._scalarjit.function import ScalarFunction
from .._scalarjit.nan import nan_where
from .._system.kinematics import Point
from .._system.system import System
from .trajectory import Trajectory, refuse_other_system


def along(f: Callable[..., Any], system: System, t: Any, q: Any, u: Any, inputs: InputValues) -> Any:
    """`f(system, t, q, u, inputs)` at one time, or at all times of a `Trajectory` in the place of `t`.

    NaN, with its derivatives, where a trajectory has ended. There `f` never sees the NaN of the trajectory, which would
    spoil the derivatives of all other times.

    **Raises:** `ValueError` for the trajectory of another system, and at one time where equations without a solution
    make the result NaN; `TypeError` for a trajectory beside `q`, `u` or `inputs`.
    """
    if not isinstance(t, Trajectory):
        arrays = checked_arrays(system, t, q, u, inputs)
        return finite_or_explained(f(*arrays), arrays)
    if not (q is None and u is None and inputs is None):
        raise TypeError("A Trajectory holds coordinates, speeds and inputs already: give the system and it alone.")
    refuse_other_system(type(system).__name__, system, t)
    if t.t.shape[-1] == 0:
        raise ValueError(f"{type(system).__name__}: a trajectory of no times.")
    return _over_times(system, f, t)


@jit
def _over_times(system: System, f: Callable[..., Any], t: Trajectory) -> Any:
    def at(system: System, sample: Any, first: Any) -> Any:
        reached = jnp.all(jnp.isfinite(jnp.concatenate([sample[1], sample[2]])))
        first = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 1.0), first)
        valid = jax.tree.map(lambda x, x0: jnp.where(reached, x, x0), sample, first)
        return nan_where(~reached, f(system, *valid), (system, sample))

    over_times = jax.vmap(at, in_axes=(None, 0, None))
    for _ in range(t.t.ndim - 1):
        over_times = jax.vmap(over_times, in_axes=(None, 0, 0))
    samples = (t.t, t.q, t.u, t.values)
    return over_times(system, samples, jax.tree.map(lambda x: jnp.moveaxis(x, t.t.ndim - 1, 0)[0], samples))


def positions(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """Where the bodies' mass centres and the named points are [m]: `positions(system, ride)["A"]`, components in N.

    The names are those of `Body(..., name=...)` and of `Motion(points=...)`; a point without a position is left out.

    **Arguments:** a `Trajectory`, of which all times are taken, also of a batch; or `t` [s], `q` (n_q,) and `u` (n_u,),
    as for `accelerations`.

    **Returns:** by name (3,), or (*batch, n_t, 3) along a trajectory, NaN after its end; differentiable in the system
    and in the trajectory.
    """
    return along(_positions, system, t, q, u, inputs)


def velocities(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """How fast the bodies' mass centres and the named points move [m/s], components in N. As `positions`."""
    return along(_velocities, system, t, q, u, inputs)


def orientations(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3 3"]]:
    """Rotation matrices (3, 3) of the bodies' frames and of the named ones, which take components in N to theirs.

    Their rows are the frame's unit vectors in N. The names are those of the bodies and of `Motion(frames=...)`; all
    else as `positions`.
    """
    return along(_orientations, system, t, q, u, inputs)


def speed_rates(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The time derivatives of all speeds by name, independent and dependent: `speed_rates(system, ride)["roll_rate"]`.

    Those of `accelerations` and `dependent_accelerations`. Arguments as `positions`, and `inputs` as `accelerations`.
    """
    return along(_speed_rates, system, t, q, u, inputs)


def outputs(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """What the sensors of a system say, by name: `System.outputs`, those of nested dicts joined by a dot.

    A trajectory holds them already: `ride["imu.ay"]`. Arguments as `positions`; `inputs` as `accelerations`, in which
    states of the first order are given too.
    """
    return along(_outputs, system, t, q, u, inputs)


def state_rates(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The time derivatives of the states of the first order by name: `System.state_rates`.

    Arguments as `outputs`.
    """
    return along(_state_rates, system, t, q, u, inputs)


def constraint_forces(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """The forces and moments that constraints carry, by name: `constraint_forces(system, t, q, u)["A"]`.

    The names are those of `Motion(points=..., frames=...)` and of the auxiliary speeds.

    - A point from which bodies are built (a joint): the force [N] on all that is built from it, by what it is built on.
        Forces from `loads` and forces of other constraint residuals are not in it. A body whose mass centre is the
        point belongs to what is built from it.
    - A point whose velocity is a residual, or from which no body is built (a contact, the end of a closed loop): the
        force [N] of the constraints on the mechanism there.
        It is read at the Point from which the residual was formed, and at those this was built from: a second Point
        made at the same place is another point, at which no residual pulls: zero. Where the ends A and B of two bars
        meet, by the residual `A.velocity - B.velocity`, A tells the force on its bar, B the opposite on its own.
    - A frame: the moment [N m] on all that turns with it, about the points from which that is built; torques from
        `loads` are not in it. In the directions of the frame's speeds it is zero.
    - An auxiliary speed: the force [N] or moment [N m] along it on the mechanism, a number.

    **Arguments:** as `accelerations`: `t` [s], `q` (n_q,), `u` (n_u,), `inputs` numbers by name. Or a `Trajectory` in
    the place of `t`, for all of its times: `constraint_forces(system, trajectory)`.

    **Returns:** a dict: components in N, (3,) at one time and (n_t, 3) along a trajectory.

    **Raises:** `ValueError` as `accelerations`, and for the trajectory of another system; `TypeError` for a trajectory
    together with `q`, `u` or `inputs`.
    """
    return along(forces_now, system, t, q, u, inputs)


def constraint_multipliers(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> Float[Array, "*n_t k"]:
    """The multipliers (k,) of the velocity residuals: the force [N] or moment [N m] along each residual.

        R_dep + C_dep^T lambda = 0

    In the order of the residuals: those of `Motion.constraints`, then the rates of the configuration constraints, where
    these were added. A residual that was given as a Vector counts as three, along the axes of the frame it is kept in.
    Arguments as `constraint_forces`.
    """
    return along(multipliers_now, system, t, q, u, inputs)


_outputs = jit(outputs_at)


@jit
@ScalarFunction
def _positions(system, t, q, u, inputs):
    points = _points(KaneEquations(system, t, q, u, inputs))
    positions = {name: point.position for name, point in points.items() if point.has_position}
    return {name: as_vector(r.components_in(r.frame.root), q) for name, r in positions.items()}


@jit
@ScalarFunction
def _velocities(system, t, q, u, inputs):
    velocities = {name: point.velocity for name, point in _points(KaneEquations(system, t, q, u, inputs)).items()}
    return {name: as_vector(v.components_in(v.frame.root), q) for name, v in velocities.items()}


def _points(equations: KaneEquations) -> dict[str, Point]:
    motion = equations.motion(equations.t, equations.q, equations.u_all)
    return {body.name: body.center for body in motion.bodies} | motion.points


@jit
@ScalarFunction
def _orientations(system, t, q, u, inputs):
    equations = KaneEquations(system, t, q, u, inputs)
    motion = equations.motion(equations.t, equations.q, equations.u_all)
    frames = {body.name: body.frame for body in motion.bodies} | motion.frames
    return {name: frame.matrix(frame.root).astype(q.dtype) for name, frame in frames.items()}


@jit
def _state_rates(system, t, q, u, inputs):
    zeros = dict.fromkeys(system.states, jnp.zeros((), q.dtype))  # for states that are left out
    x_dot = rates(system, t, q, u, zeros | inputs).x
    return {} if x_dot is None else dict(zip(system.states, x_dot, strict=True))


@jit
def _speed_rates(system, t, q, u, inputs):
    u_dot = motion_rates(system, t, q, u, inputs)[1]
    u_dep_dot = _dependent_accelerations(system, t, q, u, inputs, u_dot)
    return dict(zip((*system.speeds, *system.dependent_speeds), (*u_dot, *u_dep_dot), strict=True))
