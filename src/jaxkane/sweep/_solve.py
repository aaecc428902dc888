"""One chunk as one compiled program. Knows groups of lanes and devices; knows no mechanism and no files.

On the CPU the members of a chunk are solved in small groups, one group after the other: as many as the vector units
can use, and few enough that one that needs many steps keeps few others waiting. A member that ends early or is invalid
stops there. On other devices all members of a chunk take their steps together (`vmap`). Several devices share a chunk,
each by a loop of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P

from .._description.system import State
from .._method.checks import with_possible_bodies
from .._scalars.versions import compiled
from .._simulation.ride import solve
from .._simulation.settings import Settings
from .._simulation.trajectory import Trajectory
from ._members import start_of, system_and_signals

GROUP = 32


class Part(eqx.Module):
    """What comes back of some members: `values` are what `reduce` made of a ride, or its (q, u, u_dep,
    x, inputs, outputs, end, sides)."""

    values: Any
    status: Any
    t_end: Any
    stats: dict[str, Any]
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    events: tuple[str, ...] = eqx.field(static=True)
    adjoint: str = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)


class Job(eqx.Module):
    """What all members of a sweep have in common."""

    shared: Any
    ts: Any
    settings: Settings
    reduce: Callable[[Trajectory], Any] | None
    mesh: Mesh | None = eqx.field(static=True)
    closures: tuple[Any, ...] = ()  # what is traced, and read from outside by the functions among these

    def whole(self, own: Any) -> Part:
        """The motion of one member."""
        return self.from_start(own, start_of(own, self.shared, self.ts[0]))

    def from_start(self, own: Any, start: State) -> Part:
        """The motion of one member from its first state."""
        system, signals = system_and_signals(own, self.shared)
        start = with_possible_bodies(system, self.ts[0], start)
        ride = solve(system, start, self.ts, signals, self.settings, closures=self.closures)
        if self.reduce is None:
            values = (ride.q, ride.u, ride.u_dep, ride.x, ride.inputs, ride.outputs, ride.end, ride.sides)
        else:
            values = jax.tree.map(jnp.asarray, self.reduce(ride))
        return Part(values, ride.status, ride.t_end, ride.stats, ride.names, ride.events, ride.adjoint, ride.units)

    def solve(self, members: Any, size: int) -> Part:
        """The motions of a chunk (n, ...), n at most `size`: one program serves every chunk of a size."""
        n = jax.tree.leaves(members)[0].shape[0]
        # Padded to whole groups on every device with copies of the last member.
        unit = GROUP * (1 if self.mesh is None else self.mesh.size)
        lanes = size if size <= GROUP and self.mesh is None else unit * -(-size // unit)
        places = np.minimum(np.arange(lanes), n - 1)
        members = jax.tree.map(lambda x: jnp.asarray(x if lanes == n else x[places]), members)
        part = _solve(members, _starts(members, self), self)
        return part if lanes == n else jax.tree.map(lambda x: x[:n], part)


def mesh_of(devices: Sequence[Any] | None) -> Mesh | None:
    """The devices of this process as one axis; None for a single one."""
    devices = jax.local_devices() if devices is None else list(devices)
    if len(devices) < 2:
        return None
    return jax.make_mesh((len(devices),), ("members",), axis_types=(AxisType.Auto,), devices=devices)


@compiled
def _starts(members: Any, job: Job) -> State:
    # A program of its own: lineax, which Newton's method calls, cannot be traced within shard_map.
    return jax.vmap(lambda own: start_of(own, job.shared, job.ts[0]))(members)


@compiled
def _solve(members: Any, starts: State, job: Job) -> Part:
    arrays, static = eqx.partition(job, eqx.is_array)

    def on_one_device(members, starts, arrays):
        one = eqx.combine(arrays, static).from_start
        n = starts.q.shape[0]
        if jax.default_backend() != "cpu":
            return jax.vmap(one)(members, starts)
        group = min(n, GROUP)  # n is a multiple of it
        groups = jax.tree.map(lambda x: x.reshape(n // group, group, *x.shape[1:]), (members, starts))
        return jax.tree.map(lambda x: x.reshape(n, *x.shape[2:]), jax.lax.map(lambda g: jax.vmap(one)(*g), groups))

    if job.mesh is None:
        return on_one_device(members, starts, arrays)
    each, all_ = P("members"), P()
    across = jax.shard_map(on_one_device, mesh=job.mesh, in_specs=(each, each, all_), out_specs=each, check_vma=False)
    return across(members, starts, arrays)
