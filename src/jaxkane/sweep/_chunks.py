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
from jaxtyping import PyTree

from .._integrate.integrate import solve
from .._integrate.settings import Settings
from .._integrate.trajectory import Trajectory
from .._scalarjit import native as kernels
from .._scalarjit.cache import Cache
from .._scalarjit.cache_key import jit, version_of
from .._scalarjit.components import Numbers
from .._scalarjit.digest import CapturedValues, digest
from .._system.system import State, explain_value_of_traced
from ._members import start_of, system_and_signals

GROUP = 32


class ChunkResult(eqx.Module):
    """The results of some members, with a leading axis.

    - `values`: the result of `reduce`; without `reduce` the `Trajectory`, except its times and the other fields of this
        record.
    - `status`, `t_end` [s], `stats`: as of a `Trajectory`.
    - `events`: names of the events, for the words of a status.
    """

    values: Any
    status: Any
    t_end: Any
    stats: dict[str, Any]
    events: tuple[str, ...] = eqx.field(static=True)


class Task(eqx.Module):
    """The data that all members of a sweep share."""

    shared: Any
    origin: Any
    taus: Any
    settings: Settings
    reduce: Callable[[Trajectory], Any] | None
    mesh: Mesh | None = eqx.field(static=True)
    closures: tuple[Any, ...] = ()  # traced values that these functions read by closures

    def simulate(self, own: PyTree, start: State | None = None) -> ChunkResult:
        """The trajectory of one member. `start`: its initial state, if it was computed before."""
        start = start_of(own, self.shared, self.origin) if start is None else start
        system, signals = system_and_signals(own, self.shared)
        motion = solve(system, start, self.origin, self.taus, signals, self.settings, closures=self.closures)
        if self.reduce is None:
            values: Any = dataclasses.replace(motion, t=None, status=None, t_end=None, stats=None)
        else:
            values = _reduced(self.reduce, motion)
        return ChunkResult(values, motion.status, motion.t_end, motion.stats, motion.events)

    def solve(self, members: PyTree, size: int) -> ChunkResult:
        """The trajectories of a chunk (n, ...), n at most `size`. One program serves every chunk of this size."""
        n = jax.tree.leaves(members)[0].shape[0]
        # Every device gets whole groups; copies of the last member fill them. Other shapes would need another program.
        unit = GROUP * (1 if self.mesh is None else self.mesh.size)
        lanes = size if size <= GROUP and self.mesh is None else unit * -(-size // unit)
        places = np.minimum(np.arange(lanes), n - 1)
        members = jax.tree.map(lambda x: jnp.asarray(x if lanes == n else x[places]), members)
        result = _solve(members, _starts(members, self), self)
        return result if lanes == n else jax.tree.map(lambda x: x[:n], result)


def _reduced(reduce: Callable[[Trajectory], Any], motion: Trajectory) -> PyTree:
    """The arrays that `reduce` returns for a trajectory.

    **Raises:** `TypeError` if `reduce` needs the value of a traced number, or returns values that are not numbers.
    """
    with explain_value_of_traced("sweep: `reduce`"):
        made = reduce(motion)
    leaves = jax.tree.leaves(made, is_leaf=lambda x: x is None)
    wrong = [x for x in leaves if not isinstance(x, (bool, int, float, complex, jax.Array, np.generic, np.ndarray))]
    wrong += [x for x in leaves if isinstance(x, (np.generic, np.ndarray)) and x.dtype.kind not in "biufc"]
    if wrong:
        hint = " Does it end without a `return`?" if made is None else ""
        raise TypeError(
            f"sweep: `reduce` must return numbers and arrays, also in dicts and tuples; got {wrong[0]!r}.{hint}"
        )
    return jax.tree.map(jnp.asarray, made)


def mesh_of(devices: Sequence[Any] | None) -> Mesh | None:
    """The devices of this process as one axis; None for a single one."""
    devices = jax.local_devices() if devices is None else list(devices)
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise TypeError(f"sweep: `devices` must contain at least one of jax.devices(); got {devices!r}.")
    if len(devices) < 2:
        return None
    return jax.make_mesh((len(devices),), ("members",), axis_types=(AxisType.Auto,), devices=devices)


@jit
def _starts(members: PyTree, task: Task) -> State:
    # A separate program: Newton's method uses lineax, which cannot be traced within shard_map.
    return jax.vmap(lambda own: start_of(own, task.shared, task.origin))(members)


@jit
def _solve(members: PyTree, starts: State, task: Task) -> ChunkResult:
    arrays, static = eqx.partition(task, eqx.is_array)

    def on_one_device(members, starts, arrays):
        one = eqx.combine(arrays, static).simulate
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


def trace(task: Task, own: PyTree) -> tuple[str, ChunkResult]:
    """The digest of the program for one member and the shapes of its result.

    **Arguments:**

    - `task`: the data that all members share.
    - `own`: shapes and types of one member's data.
    """
    numbers, rest = eqx.partition(task, eqx.is_array)  # the manifest records numbers that are arguments by name

    def simulate(own: PyTree, numbers: Any) -> ChunkResult:
        return eqx.combine(numbers, rest).simulate(own)

    program, like = jax.make_jaxpr(simulate, return_shape=True)(own, numbers)
    # With all that the code of callback functions reads
    return digest(program, lambda f: CapturedValues(f, lasting=True).version), like


def versions() -> dict[str, str]:
    """Versions of the libraries that trace and run a program, by name."""
    libraries = {name: version(name) for name in ("jaxkane", "jax", "jaxlib", "diffrax", "equinox")}
    return libraries | {"python": ".".join(python_version_tuple()[:2])}


_FLAGS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")
_ANOTHER = (
    "sweep: this worker would compute a different program. Functions and classes of an importable module are sent by "
    "name. The worker's module has other values or other code: a global was changed after the import, or the file was "
    "edited. Make the value a parameter of the system, or change it on the workers too (`client.run(...)`), or restart "
    "the workers, or send the module itself (`cloudpickle.register_pickle_by_value`)."
)


def on_cluster(
    task: Task, starts: list[int], members_at: Callable[[int], Any], size: int, client: Any
) -> Iterator[tuple[int, ChunkResult]]:
    """(start, result) of every chunk, in the order in which they finish. If a worker dies, Dask gives its chunk to
    another."""
    try:
        import cloudpickle
        from distributed import as_completed
    except ImportError as error:
        raise ImportError("sweep(..., client=...) needs Dask: pip install 'jaxkane[cluster]'") from error

    # Send NumPy arrays: a worker would convert JAX arrays before it has set their precision.
    arrays = dataclasses.replace(task, mesh=None)
    arrays = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, arrays)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members_at(0))
    common = cloudpickle.dumps((arrays, like))
    program = _program(jax.tree.map(_as_jax, arrays), like)
    flags = {name: getattr(jax.config, name) for name in _FLAGS}
    with_kernels = kernels.is_on()
    remaining, futures = iter(starts), {}
    finished = as_completed()

    def submit() -> None:
        # Two tasks per thread keep all threads busy. The number of threads is read anew, because a cluster may grow.
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
    """Compute a chunk on a worker. Arguments and results are NumPy arrays.

    **Raises:** `RuntimeError` if this worker would compute a program other than `program`.
    """
    import cloudpickle

    for name, value in flags.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    kernels.use(native)
    if native and not kernels.is_on():
        raise RuntimeError(
            f"This worker cannot use native kernels: {kernels.why_not()}. Its rounding errors would be different. "
            "Enable native kernels there, or call jaxkane.configure(native=False) in the process that starts the sweep."
        )
    task, like = _TASKS.get(common, lambda: _received(common))
    libraries, digest_here = _PROGRAMS.get((common, version_of(task)), lambda: _program(task, like))
    if libraries == program[0] and digest_here != program[1]:  # digests of other JAX versions cannot be compared
        raise RuntimeError(_ANOTHER)
    return jax.tree.map(np.asarray, task.solve(cloudpickle.loads(own), size))


def _program(task: Task, like: PyTree) -> tuple[str, str]:
    """The versions of the libraries that trace the program, and its digest for one member."""
    return repr(versions()), trace(task, like)[0]


# Kept on the worker for all chunks: a function that is unpickled again would be compiled again.
_TASKS, _PROGRAMS = Cache(8), Cache(8)


def _received(common: bytes) -> tuple[Task, Any]:
    import cloudpickle

    task, like = cloudpickle.loads(common)
    return jax.tree.map(_as_jax, task), like


def _as_jax(x: Numbers) -> PyTree:
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
