"""The result of a simulation: values over time by name, and how the simulation ended. Independent of the solver."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._common.lookup import by_name
from .._kane.arguments import check_is_system
from .._scalarjit.compat import Tracer
from .._system.parameters import wrapped
from .._system.system import State, System, named_numbers, names_of
from .jumps import JumpTable
from .status import Status, advice, reason


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


def as_trajectory(value: Any) -> Any:
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


def reached_times(function: str, system: System, trajectory: Any) -> np.ndarray:
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
