"""Chunks of a sweep as compiled programs, on the devices of this process or on the workers of a Dask cluster."""

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
from .._scalarjit.backends import native as kernels
from .._scalarjit.cache_key import Cache, jit, version_of
from .._scalarjit.captured_values import CapturedValues
from .._scalarjit.digest import digest
from .._system.system import State
from ._members import start_of, system_and_signals

GROUP = 32


class ChunkResult(eqx.Module):
    """The results of some members, with a leading axis: `values` are what `reduce` made of a `Trajectory`, or it, but
    for its times, and for what stands beside it here."""

    values: Any
    status: Any
    t_end: Any
    stats: dict[str, Any]
    events: tuple[str, ...] = eqx.field(static=True)


class Task(eqx.Module):
    """What all members of a sweep have in common."""

    shared: Any
    ts: Any
    settings: Settings
    reduce: Callable[[Trajectory], Any] | None
    mesh: Mesh | None = eqx.field(static=True)
    closures: tuple[Any, ...] = ()  # traced numbers that functions among these read by closures

    def simulate(self, own: Any) -> ChunkResult:
        """The motion of one member."""
        return self.simulate_from(own, start_of(own, self.shared, self.ts[0]))

    def simulate_from(self, own: Any, start: State) -> ChunkResult:
        """The motion of one member from its first state."""
        system, signals = system_and_signals(own, self.shared)
        motion = solve(system, start, self.ts, signals, self.settings, closures=self.closures)
        if self.reduce is None:
            values: Any = dataclasses.replace(motion, t=None, status=None, t_end=None, stats=None)
        else:
            values = jax.tree.map(jnp.asarray, self.reduce(motion))
        return ChunkResult(values, motion.status, motion.t_end, motion.stats, motion.events)

    def solve(self, members: Any, size: int) -> ChunkResult:
        """The motions of a chunk (n, ...), n at most `size`: one program serves every chunk of a size."""
        n = jax.tree.leaves(members)[0].shape[0]
        # Padded to whole groups on every device with copies of the last member.
        unit = GROUP * (1 if self.mesh is None else self.mesh.size)
        lanes = size if size <= GROUP and self.mesh is None else unit * -(-size // unit)
        places = np.minimum(np.arange(lanes), n - 1)
        members = jax.tree.map(lambda x: jnp.asarray(x if lanes == n else x[places]), members)
        result = _solve(members, _starts(members, self), self)
        return result if lanes == n else jax.tree.map(lambda x: x[:n], result)


def mesh_of(devices: Sequence[Any] | None) -> Mesh | None:
    """The devices of this process as one axis; None for a single one."""
    devices = jax.local_devices() if devices is None else list(devices)
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise TypeError(f"sweep: `devices` are some of jax.devices(), one at least; got {devices!r}.")
    if len(devices) < 2:
        return None
    return jax.make_mesh((len(devices),), ("members",), axis_types=(AxisType.Auto,), devices=devices)


@jit
def _starts(members: Any, task: Task) -> State:
    # A program of its own: lineax, which Newton's method calls, cannot be traced within shard_map.
    return jax.vmap(lambda own: start_of(own, task.shared, task.ts[0]))(members)


@jit
def _solve(members: Any, starts: State, task: Task) -> ChunkResult:
    arrays, static = eqx.partition(task, eqx.is_array)

    def on_one_device(members, starts, arrays):
        one = eqx.combine(arrays, static).simulate_from
        n = starts.q.shape[0]
        if jax.default_backend() != "cpu":
            return jax.vmap(one)(members, starts)
        group = min(n, GROUP)  # n is a multiple of it
        groups = jax.tree.map(lambda x: x.reshape(n // group, group, *x.shape[1:]), (members, starts))
        return jax.tree.map(lambda x: x.reshape(n, *x.shape[2:]), jax.lax.map(lambda g: jax.vmap(one)(*g), groups))

    if task.mesh is None:
        return on_one_device(members, starts, arrays)
    each, all_ = P("members"), P()
    across = jax.shard_map(on_one_device, mesh=task.mesh, in_specs=(each, each, all_), out_specs=each, check_vma=False)
    return across(members, starts, arrays)


def trace(task: Task, own: Any) -> tuple[str, ChunkResult]:
    """The digest of the program for one member, `own` (shapes and types), and the shapes of its result."""
    numbers, rest = eqx.partition(task, eqx.is_array)  # numbers that are arguments are recorded by name elsewhere
    simulate = lambda own, numbers: eqx.combine(numbers, rest).simulate(own)  # noqa: E731
    program, like = jax.make_jaxpr(simulate, return_shape=True)(own, numbers)
    return digest_of(program), like


def digest_of(program: Any) -> str:
    """The digest of a program of JAX; of functions that it calls back, with all that their code reads."""
    return digest(program, lambda f: CapturedValues(f, lasting=True).version)


def versions() -> dict[str, str]:
    """Of what traces and runs a program, by name."""
    libraries = {name: version(name) for name in ("jaxkane", "jax", "jaxlib", "diffrax", "equinox")}
    return libraries | {"python": ".".join(python_version_tuple()[:2])}


_FLAGS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")
_ANOTHER = (
    "sweep: this worker would compute another program than the one asked for. Functions and classes of a module that "
    "can be imported travel by name, and here the module has other numbers or other code: a global was changed after "
    "the import, or the file was. Make it a parameter of the system; or change it on the workers too, "
    "`client.run(...)`; or start them anew; or let the module travel whole: `cloudpickle.register_pickle_by_value`."
)


def on_cluster(
    task: Task, starts: list[int], members_at: Callable[[int], Any], size: int, client: Any
) -> Iterator[tuple[int, ChunkResult]]:
    """(start, result) of every chunk, as they are finished. A task whose worker dies is given to another by Dask."""
    try:
        import cloudpickle
        from distributed import as_completed
    except ImportError as error:
        raise ImportError("sweep(..., client=...) needs Dask: pip install 'jaxkane[cluster]'") from error

    # Arrays travel as numpy's: JAX's would be read before the worker knows their precision.
    arrays = jax.tree.map(_as_numpy, dataclasses.replace(task, mesh=None))
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members_at(0))
    common = cloudpickle.dumps((arrays, like))
    program = _program(jax.tree.map(_as_jax, arrays), like)
    flags = {name: getattr(jax.config, name) for name in _FLAGS}
    with_kernels = kernels.is_on()
    remaining, futures = iter(starts), {}
    finished = as_completed()

    def submit() -> None:
        # Twice as many as there are threads keep all of them busy; a cluster may grow meanwhile.
        while len(futures) < max(2 * sum(client.nthreads().values()), 2):
            start = next(remaining, None)
            if start is None:
                return
            own = cloudpickle.dumps(members_at(start))
            future = client.submit(solve_on_worker, common, own, size, flags, with_kernels, program, pure=False)
            futures[future.key] = start
            finished.add(future)

    try:
        submit()
        while futures:
            future = next(finished)
            yield futures[future.key], future.result()
            del futures[future.key]
            future.release()
            submit()
    finally:
        client.cancel([future for future in finished.futures if future.key in futures])


def solve_on_worker(
    common: bytes, own: bytes, size: int, flags: dict[str, Any], native: bool, program: tuple[str, str]
) -> ChunkResult:
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
    task, like = _TASKS.get(common, lambda: _received(common))
    libraries, digest_here = _PROGRAMS.get((common, version_of(task)), lambda: _program(task, like))
    if libraries == program[0] and digest_here != program[1]:  # what another JAX has traced cannot be compared
        raise RuntimeError(_ANOTHER)
    return jax.tree.map(np.asarray, task.solve(cloudpickle.loads(own), size))


def _program(task: Task, like: Any) -> tuple[str, str]:
    """The libraries with which a program is traced, and the digest of what it computes for one member."""
    return repr(versions()), trace(task, like)[0]


# On a worker, once for all chunks: functions that are unpickled again would be compiled again.
_TASKS, _PROGRAMS = Cache(8), Cache(8)


def _received(common: bytes) -> tuple[Task, Any]:
    import cloudpickle

    task, like = cloudpickle.loads(common)
    return jax.tree.map(_as_jax, task), like


def _as_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _as_jax(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
