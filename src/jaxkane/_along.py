"""Where the parts of a mechanism are and how they move, by name, at one time or along a trajectory.

Reads a description; knows no mechanism and solves nothing but Kane's equations for the accelerations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._equations import InputValues, _arrays, _dependent_accelerations
from ._fuse import fused
from ._kane import Instant
from ._linear import as_vector
from ._nan import nan_where
from ._rates import state_rates
from ._reads import compiled
from ._system import System
from ._trajectory import Trajectory
from ._vectors import Frame, Point


def along(f: Callable[..., Any], system: System, t: Any, q: Any, u: Any, inputs: InputValues) -> Any:
    """`f(system, t, q, u, inputs)` at one time, or at all times of a `Trajectory` in the place of `t`.

    NaN, with its derivatives, where a trajectory has ended. There `f` never sees the NaN of the trajectory, which would
    spoil the derivatives of all other times.
    """
    if not isinstance(t, Trajectory):
        return f(*_arrays(system, t, q, u, inputs))
    if not (q is None and u is None and inputs is None):
        raise TypeError("A Trajectory holds coordinates, speeds and inputs already: give the system and it alone.")

    def at(system: System, now: Any, start: Any) -> Any:
        reached = jnp.all(jnp.isfinite(jnp.concatenate([now[1], now[2]])))
        safe = jax.tree.map(lambda x, x0: jnp.where(reached, x, jnp.where(jnp.isfinite(x0), x0, 1.0)), now, start)
        return nan_where(~reached, f(system, *safe), (system, now))

    over_times = jax.vmap(at, in_axes=(None, 0, None))
    for _ in range(t.t.ndim - 1):
        over_times = jax.vmap(over_times, in_axes=(None, 0, 0))
    n_axes = t.t.ndim
    motion = (t.t, t.q, t.u, t.inputs)
    return over_times(system, motion, jax.tree.map(lambda x: x[(slice(None),) * (n_axes - 1) + (0,)], motion))


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
    return along(_compiled_positions, system, t, q, u, inputs)


def velocities(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """How fast the bodies' mass centres and the named points move [m/s], components in N. As `positions`."""
    return along(_compiled_velocities, system, t, q, u, inputs)


def orientations(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3 3"]]:
    """Rotation matrices (3, 3) of the bodies' frames and of the named ones, which take components in N to theirs.

    Their rows are the frame's unit vectors in N. The names are those of the bodies and of `Motion(frames=...)`; all
    else as `positions`.
    """
    return along(_compiled_orientations, system, t, q, u, inputs)


def speed_rates(
    system: System, t: Any, q: Any = None, u: Any = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The time derivatives of all speeds by name, independent and dependent: `speed_rates(system, ride)["roll_rate"]`.

    Those of `accelerations` and `dependent_accelerations`. Arguments as `positions`, and `inputs` as `accelerations`.
    """
    return along(_compiled_speed_rates, system, t, q, u, inputs)


def _points(now: Instant) -> dict[str, Point]:
    motion = now.motion(now.t, now.q, now.u_all)
    return {body.name: body.center for body in motion.bodies} | motion.points


def _frames(now: Instant) -> dict[str, Frame]:
    motion = now.motion(now.t, now.q, now.u_all)
    return {body.name: body.frame for body in motion.bodies} | motion.frames


@fused
def _positions(system, t, q, u, inputs):
    points = _points(Instant(system, t, q, u, inputs))
    found = {name: point.position for name, point in points.items() if point.has_position}
    return {name: as_vector(r.components_in(r.frame.root), q) for name, r in found.items()}


@fused
def _velocities(system, t, q, u, inputs):
    found = {name: point.velocity for name, point in _points(Instant(system, t, q, u, inputs)).items()}
    return {name: as_vector(v.components_in(v.frame.root), q) for name, v in found.items()}


@fused
def _orientations(system, t, q, u, inputs):
    frames = _frames(Instant(system, t, q, u, inputs))
    return {name: frame.matrix(frame.root).astype(q.dtype) for name, frame in frames.items()}


_compiled_positions = compiled(_positions)
_compiled_velocities = compiled(_velocities)
_compiled_orientations = compiled(_orientations)


@compiled
def _compiled_speed_rates(system, t, q, u, inputs):
    u_dot = state_rates(system, t, q, u, inputs)[1]
    u_dep_dot = _dependent_accelerations(system, t, q, u, inputs, u_dot)
    return dict(zip((*system.speeds, *system.dependent_speeds), (*u_dot, *u_dep_dot), strict=True))
