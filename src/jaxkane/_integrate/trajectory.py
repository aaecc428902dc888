"""The result of a simulation: values over time by name, how the simulation ended, and quantities along it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._common.lookup import by_name
from .._kane.api import InputValues, _dependent_accelerations, checked_arrays, finite_or_explained
from .._kane.arguments import check_is_system, refuse_multipliers
from .._kane.kanes_method import KaneEquations, motion_rates
from .._kane.multipliers import forces_now, multipliers_now
from .._kane.right_hand_side import outputs_at, rates
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Numbers, as_vector
from .._scalarjit.nan import nan_where
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Point
from .._system.parameters import wrapped
from .._system.system import State, System, named_numbers, names_of
from .events import Status, advice, reason
from .inputs import Coordinates, Speeds
from .jumps import JumpTable


class InputDiscontinuities(eqx.Module):
    """Where the inputs of a trajectory are discontinuous.

    Attributes:

    - `times` (n,): since the first time of the trajectory [s]; infinite for times that steps skip, because the
        discontinuity there is smaller than the tolerance.
    - `inputs`: by name (n_t,), just before and just after each time of the trajectory; empty if all inputs are
        continuous.
    """

    times: Float[Array, "*batch n"]
    inputs: tuple[dict[str, Float[Array, "*batch n_t"]], ...]


class Trajectory(eqx.Module):
    """Values over time, by name: `trajectory["roll"]`, `trajectory["yaw_rate"]`, `trajectory["steer_torque"]`.

    Values after the end of a simulation that ended early are NaN. A batch has leading axes.

    Attributes:

    - `t` (n_t,) [s]: times.
    - `q` (n_t, n_q), `u` (n_t, n_u), `u_dep` (n_t, k): coordinates, independent speeds and dependent speeds.
    - `x` (n_t, n_x): states of the first order.
    - `inputs`, `outputs`: values (n_t,) of all inputs and outputs of the system, by name.
    - `status`: a `Status` code; `reason` states it in words.
    - `t_end` [s], `end`: the time and the state at which the simulation ended. They are differentiable if the
        simulation ended at the last time or by an event; the time of an event depends on the parameters. Otherwise
        their derivatives are NaN.
    - `stats`: numbers of steps taken, accepted and rejected.
    - `adjoint`: how the simulation is differentiated: "controlled" if the errors of derivatives are controlled too,
        "fixed steps", or "steps of the motion" (with `controller` or an implicit-explicit solver); or the name of an
        adjoint of diffrax.
    - `units`: pairs of a name and its unit, as the system declares them.
    - `discontinuities`: where inputs are discontinuous, and their values on both sides, for `audit`; else None.
    - `jumps`: the jumps of the state, a `JumpTable`; None if the system has neither contacts nor events with `then`.
    - `contact_memory` (n_t, m): `State.contacts` at the times; None if the system has no contacts.
    """

    t: Float[Array, "*batch n_t"]
    q: Float[Array, "*batch n_t n_q"]
    u: Float[Array, "*batch n_t n_u"]
    u_dep: Float[Array, "*batch n_t k"]
    x: Float[Array, "*batch n_t n_x"]
    inputs: dict[str, Float[Array, "*batch n_t"]]
    outputs: dict[str, Float[Array, "*batch n_t"]]
    status: Int[Array, "*batch"]
    t_end: Float[Array, "*batch"]
    stats: dict[str, Int[Array, "*batch"]]
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    events: tuple[str, ...] = eqx.field(static=True)
    adjoint: str = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    end: State | None = None
    discontinuities: InputDiscontinuities | None = None
    jumps: JumpTable | None = None
    contact_memory: Float[Array, "*batch n_t m"] | None = None
    contact_names: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def contacts(self) -> dict[str, Int[Array, "*batch n_t"]]:
        """The states of the contacts by name: 0 open, 1 slides, 2 sticks; -1 after the end of the simulation."""
        if self.contact_memory is None:
            return {}
        width = self.contact_memory.shape[-1] // len(self.contact_names)
        states = self.contact_memory[..., ::width]
        codes = jnp.where(jnp.isnan(states), -1.0, states).astype(jnp.int32)
        return {name: codes[..., i] for i, name in enumerate(self.contact_names)}

    def __getitem__(self, name: str) -> Float[Array, "*batch n_t"]:
        groups = zip(self.names, (self.q, self.u, self.u_dep, self.x), strict=True)
        return by_name(name, groups, {**self.inputs, **self.outputs}, "this trajectory")

    @property
    def values(self) -> dict[str, Float[Array, "*batch n_t"]]:
        """Inputs and states of the first order by name, as `loads` reads them."""
        return {**self.inputs, **{name: self.x[..., i] for i, name in enumerate(self.names[3])}}

    @property
    def ok(self) -> Any:
        """Whether the last time was reached; an array for a batch."""
        return self.status == Status.COMPLETED

    @property
    def reason(self) -> Any:
        """The status in words; a list for a batch."""
        codes = np.asarray(self.status)
        words = [reason(int(code), self.events) for code in codes.ravel()]
        return words[0] if codes.ndim == 0 else words

    def state(self, i: int = -1) -> State:
        """The state at the i-th time, e.g. to continue the simulation."""
        contacts = None if self.contact_memory is None else self.contact_memory[..., i, :]
        return State(self.q[..., i, :], self.u[..., i, :], self.x[..., i, :] if self.names[3] else None, contacts)

    def __repr__(self) -> str:
        if isinstance(self.status, Tracer) or np.ndim(self.status) > 0:
            return f"Trajectory(shape={self.t.shape})"
        steps = int(self.stats["steps"])
        text = f"Trajectory({self.t.shape[-1]} times to {float(self.t_end):.6g} s in {steps} steps: {self.reason})"
        text = f"{text}. {advice(int(self.status), self.events)}".removesuffix(". ")
        if self.end is None:
            return text
        names = (self.names[0], self.names[1], self.names[3])
        rows = (self.end.q, self.end.u, np.zeros(0) if self.end.x is None else self.end.x)
        return f"{text}\n{wrapped(f'At {float(self.t_end):.6g} s: {named_numbers(names, rows, {}, self.units)}')}"


def as_trajectory(value: object) -> Any:
    """The `Trajectory` that a plan of `jaxkane.collocation` contains. Any other value is returned unchanged."""
    contained = getattr(value, "trajectory", None)
    return contained if isinstance(contained, Trajectory) else value


def refuse_other_system(label: str, system: System, trajectory: Any) -> None:
    """Check that a trajectory or a steady motion belongs to a system. `label` is the calling function, for the message.

    **Raises:** `ValueError` if the names differ, by which values are read; `TypeError` if `system` is not a `System`.
    """
    check_is_system(system)
    kinds = ("coordinates", "speeds", "dependent speeds", "states")
    groups = zip(kinds, trajectory.names, names_of(system), strict=True)
    for kind, of_trajectory, own in (*groups, ("inputs", sorted(trajectory.inputs), sorted(system.inputs))):
        if tuple(of_trajectory) != tuple(own):
            raise ValueError(
                f"{label}: the trajectory belongs to another system. Its {kind}: {', '.join(of_trajectory) or 'none'}; "
                f"those of the system: {', '.join(own) or 'none'}."
            )


def reached_times(function: str, system: System, trajectory: object) -> np.ndarray:
    """Whether each time (n_t,) was reached, at least two. `function` is the calling function, for messages.

    **Raises:** `TypeError` if it is not a `Trajectory`. `ValueError` for a batch, for a trajectory of another system,
    for one that reached fewer than two of its times, and for coordinates that are not finite before the end.
    """
    label = f"{function}({type(system).__name__})"
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"{label}: the second argument must be a Trajectory, e.g. from simulate; got {trajectory!r}.")
    if trajectory.t.ndim != 1:
        raise ValueError(
            f"{label}: the trajectory is a batch of shape {trajectory.t.shape[:-1]}. Pass one member: "
            "jax.tree.map(lambda x: x[0], trajectories)."
        )
    refuse_other_system(label, system, trajectory)
    reached = np.all(np.isfinite(np.asarray(trajectory.q)), axis=1)
    until = len(reached) if trajectory.ok else len(reached) - int(np.argmax(reached[::-1]))
    if reached.any() and not reached[:until].all():
        when = float(trajectory.t[int(np.argmin(reached))])
        raise ValueError(f"{label}: q is not finite at t = {when:.6g} s, but the trajectory continues after that time.")
    if reached.sum() < 2:
        raise ValueError(
            f"{label}: the simulation reached only {reached.sum()} of its times, but at least two are needed. "
            f"Reason: {trajectory.reason}."
        )
    return reached


def along(f: Callable[..., Any], system: System, t: Numbers, q: Numbers, u: Numbers, inputs: InputValues) -> Any:
    """`f(system, t, q, u, inputs)` at one time, or at all times of a `Trajectory` or plan that is passed as `t`.

    After the end of a trajectory the result and its derivatives are NaN. `f` is evaluated at the first time instead: a
    NaN in its arguments would reach the derivatives at all other times.

    **Raises:** `ValueError` for a trajectory of another system, and at one time if equations without a solution make
    the result NaN. `TypeError` for a trajectory together with `q`, `u` or `inputs`.
    """
    if f not in (_positions, _velocities, _orientations):
        refuse_multipliers(system)
    t = as_trajectory(t)
    if not isinstance(t, Trajectory):
        arrays = checked_arrays(system, t, q, u, inputs)
        return finite_or_explained(f(*arrays), arrays)
    if not (q is None and u is None and inputs is None):
        raise TypeError(
            "A Trajectory already contains coordinates, speeds and inputs. Pass only the system and the trajectory."
        )
    refuse_other_system(type(system).__name__, system, t)
    if t.contact_names and f not in (_positions, _velocities, _orientations):
        raise ValueError(
            f"{type(system).__name__} has contacts ({', '.join(t.contact_names)}), and this function does not contain "
            "their forces. Define what you need in `outputs`: its accelerations contain the contact forces."
        )
    if t.t.shape[-1] == 0:
        raise ValueError(f"{type(system).__name__}: the trajectory contains no times.")
    return _over_times(system, f, t)


@jit
def _over_times(system: System, f: Callable[..., Any], t: Trajectory) -> Any:
    def at(system: System, sample: tuple[Any, ...], first: tuple[Any, ...]) -> Any:
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
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """Positions of the bodies' mass centres and the named points [m]: `positions(system, trajectory)["A"]`, components
    in N.

    The names are those of `Body(..., name=...)` and of `Motion(points=...)`. Points without a position are omitted.

    **Arguments:**

    - `system`: the system.
    - `t`: time [s]; or a `Trajectory`, also of a batch, for all of its times.
    - `q` (n_q,), `u` (n_u,): coordinates and speeds, as for `accelerations`.
    - `inputs`: numbers by name.

    **Returns:** by name (3,), or (*batch, n_t, 3) along a trajectory, NaN after its end. Differentiable with respect to
    the system and the trajectory.
    """
    return along(_positions, system, t, q, u, inputs)


def velocities(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """Velocities of the bodies' mass centres and the named points [m/s], components in N. Arguments as `positions`."""
    return along(_velocities, system, t, q, u, inputs)


def orientations(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3 3"]]:
    """Rotation matrices (3, 3) of the bodies' frames and of the named frames, from components in N to components in the
    frame.

    Their rows are the frame's unit vectors in N. The names are those of the bodies and of `Motion(frames=...)`.
    Arguments as `positions`.
    """
    return along(_orientations, system, t, q, u, inputs)


def speed_rates(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The time derivatives of all speeds by name, independent and dependent: `speed_rates(system,
    trajectory)["roll_rate"]`.

    The values are those of `accelerations` and `dependent_accelerations`. Arguments as `positions`, and `inputs` as
    `accelerations`.
    """
    return along(_speed_rates, system, t, q, u, inputs)


def outputs(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The outputs of a system's sensors by name: `System.outputs`. The names of nested dicts are joined by a dot.

    A trajectory already contains them: `trajectory["imu.ay"]`. Arguments as `positions`. `inputs` as `accelerations`;
    it also contains the states of the first order.
    """
    return along(_outputs, system, t, q, u, inputs)


def state_rates(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t"]]:
    """The time derivatives of the states of the first order by name: `System.state_rates`.

    Arguments as `outputs`.
    """
    return along(_state_rates, system, t, q, u, inputs)


def constraint_forces(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> dict[str, Float[Array, "*n_t 3"]]:
    """Constraint forces and moments by name: `constraint_forces(system, t, q, u)["A"]`.

    The names are those of `Motion(points=..., frames=...)` and of the auxiliary speeds.

    - A point from which bodies are built (a joint): the force [N] on everything that is built from it, exerted by its
        support. Forces from `loads` and from other constraint residuals are excluded. A body whose mass centre is the
        point belongs to what is built from it.
    - A point whose velocity is a residual, or from which no body is built (a contact, the end of a closed loop): the
        force [N] of the constraints on the mechanism there. Use the Point from which the residual was formed, or the
        points from which that Point was built. Another Point at the same position has no residual; its force is zero.
        Example: the ends A and B of two bars meet by the residual `A.velocity - B.velocity`. A then gives the force on
        its bar, B the opposite force on the other bar.
        This force has the directions of the residuals only. A disc whose centre is built from the point G of the ground
        below it has no residual along the normal. Its normal force acts at G: name G too, and add both forces.
    - A frame: the moment [N m] on everything that rotates with it, about the points from which that is built. Torques
        from `loads` are excluded. The moment is zero in the directions of the frame's speeds.
    - An auxiliary speed: the force [N] or moment [N m] along it on the mechanism, a number.

    **Arguments:**

    - `system`: the system.
    - `t`: time [s]; or a `Trajectory`, for all of its times: `constraint_forces(system, trajectory)`.
    - `q` (n_q,), `u` (n_u,): coordinates and speeds, as for `accelerations`.
    - `inputs`: numbers by name.

    **Returns:** a dict: components in N, (3,) at one time and (n_t, 3) along a trajectory.

    **Raises:** `ValueError` as `accelerations`, for a trajectory of another system, and without names of forces;
    `TypeError` for a trajectory together with `q`, `u` or `inputs`.
    """
    forces = along(forces_now, system, t, q, u, inputs)
    if not forces:
        raise ValueError(
            f"{type(system).__name__}: no constraint force has a name. Name the points of joints and contacts, or "
            "frames: Motion(bodies, points={...}, frames={...})."
        )
    return forces


def constraint_multipliers(
    system: System, t: Numbers, q: Numbers = None, u: Numbers = None, inputs: InputValues = None
) -> Float[Array, "*n_t k"]:
    """The multipliers (k,) of the velocity residuals: the force [N] or moment [N m] along each residual.

        R_dep + C_dep^T lambda = 0

    Their order is that of the residuals: those of `Motion.constraints`, then the rates of the configuration
    constraints, if these were added. A residual that is a Vector counts as three, along the axes of the frame in which
    it is stored. Arguments as `constraint_forces`.
    """
    return along(multipliers_now, system, t, q, u, inputs)


_outputs = jit(outputs_at)


@jit
@ScalarFunction
def _positions(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
    points = _points(KaneEquations(system, t, q, u, inputs))
    positions = {name: point.position for name, point in points.items() if point.has_position}
    return {name: as_vector(r.components_in(r.frame.root), q) for name, r in positions.items()}


@jit
@ScalarFunction
def _velocities(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
    velocities = {name: point.velocity for name, point in _points(KaneEquations(system, t, q, u, inputs)).items()}
    return {name: as_vector(v.components_in(v.frame.root), q) for name, v in velocities.items()}


def _points(equations: KaneEquations) -> dict[str, Point]:
    motion = equations.motion(equations.t, equations.q, equations.u_all)
    return {body.name: body.center for body in motion.bodies} | motion.points


@jit
@ScalarFunction
def _orientations(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
    equations = KaneEquations(system, t, q, u, inputs)
    motion = equations.motion(equations.t, equations.q, equations.u_all)
    frames = {body.name: body.frame for body in motion.bodies} | motion.frames
    return {name: frame.matrix(frame.root).astype(q.dtype) for name, frame in frames.items()}


@jit
def _state_rates(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
    zeros = dict.fromkeys(system.states, jnp.zeros((), q.dtype))  # for omitted states
    x_dot = rates(system, t, q, u, zeros | inputs).x
    return {} if x_dot is None else dict(zip(system.states, x_dot, strict=True))


@jit
def _speed_rates(system: System, t: Array, q: Coordinates, u: Speeds, inputs: dict[str, Array]):
    u_dot = motion_rates(system, t, q, u, inputs)[1]
    u_dep_dot = _dependent_accelerations(system, t, q, u, inputs, u_dot)
    return dict(zip((*system.speeds, *system.dependent_speeds), (*u_dot, *u_dep_dot), strict=True))
