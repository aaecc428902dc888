"""Chunks of a sweep as compiled programs, on the devices of this process or on a Dask cluster, and as files."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from platform import python_version_tuple
from typing import Any, BinaryIO

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree

from .._common.files import SCRATCH, atomic_write, differences, remove_abandoned
from .._integrate.integrate import solve
from .._integrate.settings import Settings
from .._integrate.trajectory import Trajectory
from .._scalarjit import native as kernels
from .._scalarjit.cache import Cache
from .._scalarjit.cache_key import jit, version_of
from .._scalarjit.components import Inputs, Numbers
from .._scalarjit.digest import CapturedValues, digest
from .._scalarjit.native import is_on
from .._system.system import State, System, explain_value_of_traced
from ._members import Table, start_of, system_and_signals

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

    def on_one_device(members: PyTree, starts: State, arrays: PyTree):
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

    def simulate(own: PyTree, numbers: PyTree) -> ChunkResult:
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


def manifest_of(
    program: str,
    system: System | Callable[..., System],
    state: State | Callable[..., State],
    inputs: Inputs,
    table: Table | None,
    ts: Numbers,
    settings: Settings,
    reduce: Callable[[Trajectory], Any] | None,
    layout: Mapping[str, int],
) -> dict[str, Any]:
    """All data that determine the results, by name. `program` is the digest of the compiled program."""
    if isinstance(system, System):
        kind: dict[str, Any] = {"class": type(system).__qualname__}
        parameters = {field.name: _entry(getattr(system, field.name)) for field in dataclasses.fields(system)}
    else:
        kind, parameters = {"function": _entry(system)}, {}
    if isinstance(state, State):
        initial = {name: _entry(x) for name, x in vars(state).items() if x is not None}
    else:
        initial = {"function": _entry(state)}
    return {
        "system": kind,
        "parameter": parameters,
        "state": initial,
        "input": _entry(inputs) if callable(inputs) else {name: _entry(x) for name, x in (inputs or {}).items()},
        "table": {name: _entry(column) for name, column in table.columns.items()} if table else {},
        "shape": dict(zip(table.dims, table.shape, strict=True)) if table else {},
        "times": _entry(ts),
        "option": {f.name: _entry(getattr(settings, f.name)) for f in dataclasses.fields(settings)},
        "reduce": _entry(reduce),
        "program": program,
        "layout": dict(layout),
        "device": jax.default_backend(),
        # native kernels and XLA round differently
        "kernels": "native" if is_on() and jax.default_backend() == "cpu" else "XLA",
        "version": versions(),
    }


def _entry(value: object) -> Any:
    # Numbers unchanged, functions by name (`program` covers their code), everything else as a digest.
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        array = np.asarray(value)
        return array.item() if array.ndim == 0 else f"{array.dtype}{list(array.shape)} {digest(array)}"
    if inspect.isroutine(value):
        return value.__qualname__
    return f"{getattr(value, '__qualname__', type(value).__qualname__)} {digest(value)}"


MANIFEST = "sweep.json"
_MARK = "chunk of"
_RESUME = "Finished chunks are kept: call sweep again with this folder to resume."


class Folder:
    """The chunks of one sweep: `chunk-00000000.npz`, named by the first member of each.

    **Raises:** `ValueError` if the folder contains another sweep, an unreadable manifest, or other files; `OSError` if
    it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], manifest: Mapping[str, Any]):
        self.path = Path(path).expanduser()
        self.sweep = digest(json.dumps(manifest, sort_keys=True))  # the order of columns does not matter
        self.damaged: list[str] = []
        path = self.path / MANIFEST
        if self.path.is_dir():
            remove_abandoned(self.path)
        if not path.exists():
            # Chunks of this sweep are used, and damaged ones are computed again.
            files = [file for file in self.path.glob("*") if file.name != MANIFEST and file.suffix != SCRATCH]
            owners = {_owner(file) for file in files}
            if files and (self.sweep not in owners or owners - {self.sweep, None}):
                raise ValueError(
                    f"{self.path} has no {MANIFEST}, and its {len(files)} files are not the chunks of this sweep (e.g. "
                    f"{files[0].name}). Choose an empty folder, or one that does not exist."
                )
            text = json.dumps(manifest, indent=1).encode()
            if atomic_write(path, lambda file: file.write(text), replace=False):
                return
        try:
            stored = json.loads(path.read_bytes())
        except (ValueError, IsADirectoryError) as error:  # of the JSON parser, or of the decoder
            stored = error
        if not isinstance(stored, dict) or not {"system", "times", "layout"} <= stored.keys():
            raise ValueError(
                f"{path} is damaged, or not the manifest of a sweep: {stored!r:.200}. Choose another folder, or delete "
                "this file: chunks that belong to this sweep are then used."
            )
        if different := differences(stored, manifest):
            raise ValueError(
                f"{path} belongs to another sweep. It differs in {different}. Choose another folder, or delete this "
                "one. (The program contains the system, the inputs and the functions, with the numbers that they use.)"
            )

    def file(self, start: int) -> Path:
        return self.path / f"chunk-{start:08d}.npz"

    def write(self, start: int, result: PyTree) -> None:
        """Save the chunk whose first member is `start`."""

        def save(file: BinaryIO) -> None:
            # The mark detects a renamed file, and a file from another folder.
            np.savez(file, **{_MARK: f"{self.sweep} from {start}"}, **_by_path(result))

        try:
            atomic_write(self.file(start), save, remedy=_RESUME)
        except FileNotFoundError:
            # Another process has finished the whole sweep, including this chunk, and removed the temporary files.
            if not self.file(start).exists():
                raise

    def read(self, start: int, like: PyTree, size: int) -> PyTree:
        """Read the chunk of `size` members whose first member is `start`.

        **Arguments:**

        - `start`: the index of the first member.
        - `like`: shapes and types of one member's result.
        - `size`: the number of members.

        **Returns:** the chunk, or None if the file does not exist or is damaged. `damaged` lists the damaged files.
        """
        path = self.file(start)
        if not path.exists():
            return None
        try:
            with zipfile.ZipFile(path) as archive, np.load(path, allow_pickle=False) as arrays:
                leaves = {name: arrays[name] for name in _by_path(like)}
                is_own = archive.testzip() is None and str(arrays[_MARK]) == f"{self.sweep} from {start}"
            types = {name: ((size, *leaf.shape), leaf.dtype) for name, leaf in _by_path(like).items()}
            if not is_own or types != {name: (x.shape, x.dtype) for name, x in leaves.items()}:
                raise ValueError("the file was renamed, belongs to another sweep, or is damaged")
        except (MemoryError, PermissionError):
            raise
        except Exception as error:  # decoders raise various exceptions for damaged files
            self.damaged.append(f"{path.name} ({type(error).__name__}: {error})")
            return None
        return jax.tree.unflatten(jax.tree.structure(like), leaves.values())

    def tidy(self) -> None:
        """Remove the temporary files of interrupted writers. Call when every chunk exists."""
        for scratch in self.path.glob(f"*{SCRATCH}"):
            scratch.unlink(missing_ok=True)


def _owner(path: Path) -> str | None:
    """The digest of the sweep of a chunk; None if the file cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return str(arrays[_MARK]).partition(" ")[0]
    except (MemoryError, PermissionError):
        raise
    except Exception:  # decoders raise various exceptions for damaged files
        return None


def _by_path(tree: PyTree) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
