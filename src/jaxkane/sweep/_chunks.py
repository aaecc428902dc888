"""Chunks of a sweep as compiled programs, on devices here or on a Dask cluster's workers. Knows no mechanism."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from platform import python_version_tuple
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P

from .._integrate.integrate import solve
from .._integrate.settings import Settings
from .._integrate.trajectory import Trajectory
from .._kane.checks import with_possible_bodies
from .._scalarjit.backends import native as kernels
from .._scalarjit.cache_key import Cache, jit, version_of
from .._scalarjit.captured_values import CapturedValues
from .._scalarjit.digest import digest
from .._system.system import State
from ._members import start_of, system_and_signals

GROUP = 32


class Part(eqx.Module):
    """What comes back of some members: `values` are what `reduce` made of a ride, or its (q, u, u_dep,
    x, inputs, outputs, end, discontinuities)."""

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
            values = (ride.q, ride.u, ride.u_dep, ride.x, ride.inputs, ride.outputs, ride.end, ride.discontinuities)
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


@jit
def _starts(members: Any, job: Job) -> State:
    # A program of its own: lineax, which Newton's method calls, cannot be traced within shard_map.
    return jax.vmap(lambda own: start_of(own, job.shared, job.ts[0]))(members)


@jit
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


def traced(job: Job, own: Any) -> tuple[str, Part]:
    """The digest of the program for one member, `own` (shapes and types), and the shapes of what it gives."""
    numbers, rest = eqx.partition(job, eqx.is_array)  # numbers that are arguments are recorded by name elsewhere
    whole = lambda own, numbers: eqx.combine(numbers, rest).whole(own)  # noqa: E731
    program, like = jax.make_jaxpr(whole, return_shape=True)(own, numbers)
    return digest_of(program), like


def digest_of(program: Any) -> str:
    """The digest of a program of JAX; of functions that it calls back, with all that their code reads."""
    return digest(program, lambda f: CapturedValues(f, lasting=True).version)


def versions() -> dict[str, str]:
    """Of what traces and runs a program, by name."""
    found = {name: version(name) for name in ("jaxkane", "jax", "jaxlib", "diffrax", "equinox")}
    return found | {"python": ".".join(python_version_tuple()[:2])}


_FLAGS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")
_ANOTHER = (
    "sweep: this worker would compute another program than the one asked for. Functions and classes of a module that "
    "can be imported travel by name, and here the module has other numbers or other code: a global was changed after "
    "the import, or the file was. Make it a parameter of the system; or change it on the workers too, "
    "`client.run(...)`; or start them anew; or let the module travel whole: `cloudpickle.register_pickle_by_value`."
)


def on_cluster(
    job: Job, starts: list[int], members_at: Callable[[int], Any], size: int, client: Any
) -> Iterator[tuple[int, Part]]:
    """(start, part) of every chunk, as they are finished. A task whose worker dies is given to another by Dask."""
    try:
        import cloudpickle
        from distributed import as_completed
    except ImportError as error:
        raise ImportError("sweep(..., client=...) needs Dask: pip install 'jaxkane[cluster]'") from error

    # Arrays travel as numpy's: JAX's would be read before the worker knows their precision.
    sent = jax.tree.map(_as_numpy, dataclasses.replace(job, mesh=None))
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members_at(0))
    common = cloudpickle.dumps((sent, like))
    program = _program(jax.tree.map(_as_jax, sent), like)
    flags = {name: getattr(jax.config, name) for name in _FLAGS}
    with_kernels = kernels.is_on()
    left, tasks = iter(starts), {}
    finished = as_completed()

    def submit() -> None:
        # Twice as many as there are threads keep all of them busy; a cluster may grow meanwhile.
        while len(tasks) < max(2 * sum(client.nthreads().values()), 2):
            start = next(left, None)
            if start is None:
                return
            own = cloudpickle.dumps(members_at(start))
            task = client.submit(solve_elsewhere, common, own, size, flags, with_kernels, program, pure=False)
            tasks[task.key] = start
            finished.add(task)

    try:
        submit()
        while tasks:
            task = next(finished)
            yield tasks[task.key], task.result()
            del tasks[task.key]
            task.release()
            submit()
    finally:
        client.cancel([task for task in finished.futures if task.key in tasks])


def solve_elsewhere(
    common: bytes, own: bytes, size: int, flags: dict[str, Any], native: bool, program: tuple[str, str]
) -> Part:
    """A chunk, on a worker; arrays of numpy go there and come back.

    **Raises:** `RuntimeError` where this worker would compute something else than `program`.
    """
    import cloudpickle

    for name, value in flags.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    kernels.use(native)
    if native and not kernels.is_on():
        raise RuntimeError(
            f"This worker has no native kernels, and would round differently: {kernels.why_not()}. Or call "
            "jaxkane.configure(native=False) where the sweep is started."
        )
    job, like = _JOBS.get(common, lambda: _received(common))
    libraries, computed = _PROGRAMS.get((common, version_of(job)), lambda: _program(job, like))
    if libraries == program[0] and computed != program[1]:  # what another JAX has traced cannot be compared
        raise RuntimeError(_ANOTHER)
    part = job.solve(cloudpickle.loads(own), size)
    return jax.tree.map(np.asarray, part)


def _program(job: Job, like: Any) -> tuple[str, str]:
    """The libraries with which a program is traced, and the digest of what it computes for one member."""
    return repr(versions()), traced(job, like)[0]


# On a worker, once for all chunks: functions that are unpickled anew would be compiled anew.
_JOBS, _PROGRAMS = Cache(8), Cache(8)


def _received(common: bytes) -> tuple[Job, Any]:
    import cloudpickle

    job, like = cloudpickle.loads(common)
    return jax.tree.map(_as_jax, job), like


def _as_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _as_jax(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
