"""What a simulation gives: motion over time by name, and how it ended. Knows names and numbers; knows no solver."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from .._common.lookup import by_name
from .._kane.arguments import check_is_system
from .._scalarjit.compat import Tracer
from .._system.system import State, System, names_of
from .status import Status, advice, reason


class InputDiscontinuities(eqx.Module):
    """Where inputs that are samples have kinks and jumps: at `times` (n,) [s], infinite for kinks that steps pass over
    since they are smaller than the tolerance. Where there are jumps, `inputs` (n_t,)
    by name just before and just after each time of the trajectory."""

    times: Float[Array, "*batch n"]
    inputs: tuple[dict[str, Float[Array, "*batch n_t"]], ...]


class Trajectory(eqx.Module):
    """Motion over time, by name: `ride["roll"]`, `ride["yaw_rate"]`, `ride["steer_torque"]`, `ride["imu.ay"]`.

    Values after the end of a simulation that stopped early are NaN. A batch has leading axes.

    Attributes:

    - `t` (n_t,) [s]; `q` (n_t, n_q); `u` (n_t, n_u) independent speeds; `u_dep` (n_t, k) dependent speeds;
        `x` (n_t, n_x) states of the first order.
    - `inputs`, `outputs`: values (n_t,) of every input, and of every output of the system, by name.
    - `status`: a `Status` code; `reason` says it in words.
    - `t_end` [s] and `end`, the state there: where the simulation ended. They have derivatives where it ended at the
        last time or by an event, whose time moves with what it follows from; otherwise their derivatives are NaN.
    - `stats`: numbers of steps taken, accepted and rejected. `adjoint`: how it is differentiated.
    - `units`: pairs of a name and its unit, as the system declares them.
    - `discontinuities`: where inputs have kinks and jumps, and their values on both sides, for `audit`; else None.
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
        """The state at the i-th time, to go on from."""
        return State(self.q[..., i, :], self.u[..., i, :], self.x[..., i, :] if self.names[3] else None)

    def __repr__(self) -> str:
        if isinstance(self.status, Tracer) or np.ndim(self.status) > 0:
            return f"Trajectory(shape={self.t.shape})"
        steps = int(self.stats["steps"])
        text = f"Trajectory({self.t.shape[-1]} times to {float(self.t_end):.6g} s in {steps} steps: {self.reason})"
        return f"{text}. {advice(int(self.status), self.events)}".removesuffix(". ")


def refuse_other_system(label: str, system: System, trajectory: Any) -> None:
    """Every function of a system and a trajectory, or a steady motion, asks this first; `label` is the one that was
    called, for the message.

    **Raises:** `ValueError` where the names differ, by which a motion is read; `TypeError` for what is no system.
    """
    check_is_system(system)
    kinds = ("coordinates", "speeds", "dependent speeds", "states")
    groups = zip(kinds, trajectory.names, names_of(system), strict=True)
    for kind, of_trajectory, own in (*groups, ("inputs", sorted(trajectory.inputs), sorted(system.inputs))):
        if tuple(of_trajectory) != tuple(own):
            raise ValueError(
                f"{label}: the motion has the {kind}: {', '.join(of_trajectory) or 'none'}, the system has: "
                f"{', '.join(own) or 'none'}: it is the motion of another system."
            )


def reached_times(function: str, system: System, trajectory: Any) -> np.ndarray:
    """Which times (n_t,) a motion reached, at least two; `function` is the one that was called, for messages.

    **Raises:** `TypeError` for what is no `Trajectory`; `ValueError` for a batch, for the motion of another system, for
    one that reached fewer than two of its times, and for coordinates that are not finite at times between.
    """
    label = f"{function}({type(system).__name__})"
    if not isinstance(trajectory, Trajectory):
        raise TypeError(f"{label}: the second argument is a Trajectory, as from simulate, got {trajectory!r}.")
    if trajectory.t.ndim != 1:
        raise ValueError(
            f"{label}: takes one motion; of a batch of shape {trajectory.t.shape[:-1]} give one member: "
            "jax.tree.map(lambda x: x[0], rides)."
        )
    refuse_other_system(label, system, trajectory)
    reached = np.all(np.isfinite(np.asarray(trajectory.q)), axis=1)
    until = len(reached) if trajectory.ok else len(reached) - int(np.argmax(reached[::-1]))
    if reached.any() and not reached[:until].all():
        when = float(trajectory.t[int(np.argmin(reached))])
        raise ValueError(f"{label}: q is not finite at t = {when:.6g} s, and the motion goes on from there.")
    if reached.sum() < 2:
        raise ValueError(f"{label}: the simulation reached only {reached.sum()} of its times: {trajectory.reason}.")
    return reached
