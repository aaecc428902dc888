"""`sweep`: chunk by chunk, in this process or on a cluster, into arrays and files."""

from __future__ import annotations

import dataclasses
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._common.lookup import refuse_unknown
from .._integrate.integrate import refuse_captured
from .._integrate.settings import resolve_adjoint, settings_for, without_derivatives
from .._integrate.simulate import as_state, checked_times
from .._integrate.status import Status
from .._integrate.trajectory import Trajectory
from .._kane.arguments import is_concrete
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.components import Inputs
from .._system.system import State, System
from ._chunks import GROUP, ChunkResult, Task, mesh_of, on_cluster, trace
from ._files import Folder, manifest_of
from ._members import Row, Table, as_table, members_of
from ._result import Sweep

_OPTIONS = ("rtol", "atol", "solver", "step", "adjoint", "max_steps", "project", "stabilize")  # of `simulate`
_MEMBERS, _MEMBERS_ON_GPU = 256, 16_384  # in a chunk; an H200 takes half as long for these as for 65 536


def sweep(
    system: System | Callable[[Row], System],
    state: State | Callable[[System, Row], State],
    ts: Any,
    inputs: Inputs = None,
    *,
    table: Any = None,
    reduce: Callable[[Trajectory], Any] | None = None,
    chunk: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    client: Any = None,
    devices: Sequence[Any] | None = None,
    progress: bool = False,
    **options: Any,
) -> Sweep:
    """`simulate` for many members: systems, initial states or inputs that differ, in chunks of bounded memory.

        rides = sweep(bicycle, start, ts, table=grid(lam=np.linspace(0.2, 0.4, 20), roll_rate=[0.1, 0.5]))
        rides["roll"]  # (20, 2, n_t)

    **Arguments:**

    - `system`: any parameter may have a leading axis (b, ...) of members.
    - `state`: `q` (b, n_q) or (n_q,), `u` (b, n_u) or (n_u,).
    - `ts` (n_t,): times [s], the same for all.
    - `inputs`: as for `simulate`; samples may be (b, n_t), and numbers that differ from member to member (b, 1).
    - `table`: what differs, by name: `grid(...)`, a dict of columns (b,) or a DataFrame. Columns that are called as
        parameters, coordinates, independent speeds or inputs of the system take their place, and coordinates that
        depend on the others are found anew (`assemble`). Columns of text are labels, which have names of their own.
    - `state` may be a function (system, row) -> State, and `system` a function (row) -> System, for columns with
        other names: `lambda bicycle, row: assemble(bicycle, {}, {"rear_wheel_rate": -row["speed"] / bicycle.rR})`. They
        are compiled, with `system` as this member has it. What a function makes stands as it is: a column that it reads
        takes no place there by its name.
    - `reduce`: a function of one member's `Trajectory` that gives the few arrays to keep, such as
        `lambda ride: {"largest": jnp.max(jnp.abs(ride["roll"]))}`; it is compiled too. A million motions need not be
        kept to look at a million numbers.
    - `chunk`: members in one call of a compiled program, rounded up to whole groups of 32; by default 256, and 16 384
        where JAX does not compute on the CPU. The results of a chunk fill its memory.
    - `folder`: keep every finished chunk there, as a file. A sweep that was stopped, or killed, goes on from there when
        it is called again, and gives the same bytes as one that was not. It is known again by what it computes and the
        numbers that it computes from; a folder of another sweep is refused.
    - `client`: a `dask.distributed.Client`: its workers, here or elsewhere, compute the chunks; workers of one thread
        are best. A worker that dies costs its chunk's time. Where workers have other processors or libraries than this
        machine, the last bits differ. Needs Dask: pip install 'jaxkane[cluster]'.
    - `devices`: among which every chunk is divided; by default all of this process (`jax.local_devices()`).
    - `progress`: show a progress bar.
    - `options`: those of `simulate`: rtol, atol, solver, step, adjoint, max_steps, project, stabilize.

    **Returns:** a `Sweep`. A member that is not finite, has a parameter that must be positive and is not, a mass or an
    inertia that no body has, or violates a constraint gets the status `Status.INVALID`; one that falls or breaks down
    its own status; all with NaN from there on. After Ctrl-C what is finished comes back, the rest as `INTERRUPTED`.

    **Raises:** `ValueError` when nothing is a batch, two batches differ in length, a column changes nothing, or the
    folder holds another sweep: the message says in what it differs.
    """
    if chunk is None:
        chunk = _MEMBERS if jax.default_backend() == "cpu" else _MEMBERS_ON_GPU
    if not isinstance(chunk, int | np.integer) or chunk < 1:
        raise ValueError(f"sweep: `chunk` is a number of members, at least one; got {chunk!r}.")
    refuse_unknown(options, _OPTIONS, "sweep has no option")
    table = as_table(table)
    if isinstance(state, State) and isinstance(system, System):
        state = as_state(system, state)
    ts = checked_times(ts, getattr(state.q, "dtype", float) if isinstance(state, State) else float)
    settings = settings_for(ts, progress=False, rising=is_concrete(ts), check_bodies=True, **options)
    if isinstance(system, System):
        refuse_captured(system)
    members, shared, n = members_of(system, state, inputs, table, ts)
    axes = table if table is not None else Table({}, ("member",), (n,))
    closures = captured_tracers(shared, reduce)
    task = Task(shared, ts, settings, reduce, None if client is not None else mesh_of(devices), closures)
    own = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members)
    if n == 0:
        like = jax.eval_shape(task.simulate, own)
        return Sweep.of(jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), like), axes, ts, reduce is not None)
    if not is_concrete(members, shared, ts, closures):  # inside jit, grad or vmap
        if folder is not None or client is not None:
            raise ValueError("sweep: `folder` and `client` cannot be used inside jit, grad or vmap.")
        arguments = members, shared, ts, closures
        settings, (members, shared, ts, closures) = resolve_adjoint(settings, options.get("adjoint", "auto"), arguments)
        task = Task(shared, ts, settings, reduce, task.mesh, closures)
        return Sweep.of(task.solve(members, n), axes, ts, reduce is not None)

    task = dataclasses.replace(task, settings=without_derivatives(settings))
    size = n if n <= GROUP else GROUP * -(-min(chunk, n) // GROUP)
    files = like = None
    if folder is not None:
        layout = {"members": n, "chunk": size}
        program, like = trace(task, own)
        files = Folder(folder, manifest_of(program, system, state, inputs, table, ts, settings, reduce, layout))
    result = _in_chunks(task, jax.tree.map(np.asarray, members), n, size, files, like, client, progress)
    return Sweep.of(result, axes, ts, reduce is not None)


def _in_chunks(
    task: Task,
    members: Any,
    n: int,
    size: int,
    files: Folder | None,
    like: ChunkResult | None,
    client: Any,
    progress: bool,
) -> ChunkResult:
    """The results of n members, `size` at a time: those that stand in the folder, then the rest, in this process or on
    a cluster. What is missing after Ctrl-C has the status `INTERRUPTED`."""
    members_at = lambda start: jax.tree.map(lambda x: x[start : start + size], members)  # noqa: E731
    results = _Results(n)
    with tqdm(total=n, disable=not progress, unit="member", file=sys.stderr) as bar:
        try:
            remaining = list(range(0, n, size))
            for start, result in _finished(files, remaining, like, n, size):
                remaining.remove(start)
                bar.update(results.put(start, result))
            bar.initial = bar.n  # chunks that were read from files say nothing about the speed
            if client is None:
                chunks = ((start, task.solve(members_at(start), size)) for start in remaining)
            else:
                chunks = on_cluster(task, remaining, members_at, size, client)
            for start, result in chunks:
                result = jax.tree.map(np.asarray, result)
                if files is not None:
                    files.write(start, result)
                bar.update(results.put(start, result))
        except KeyboardInterrupt:
            if results.arrays is None:
                raise
    if files is not None and results.reached.all():
        files.tidy()
    return results.filled()


def _finished(
    files: Folder | None, starts: list[int], like: ChunkResult | None, n: int, size: int
) -> Iterator[tuple[int, ChunkResult]]:
    """(start, result) of the chunks that stand in the folder, each member of the shapes of `like`."""
    if files is None:
        return
    for start in tuple(starts):
        result = files.read(start, like, min(size, n - start))
        if result is not None:
            yield start, result
    if files.damaged:
        warnings.warn(
            f"{files.path}: {len(files.damaged)} chunks cannot be read and are computed again: {files.damaged[0]}"
            + (", ..." if len(files.damaged) > 1 else "."),
            stacklevel=3,
        )


class _Results:
    """The results of all members, filled chunk by chunk."""

    def __init__(self, n: int):
        self.n, self.reached, self.arrays = n, np.zeros(n, bool), None

    def put(self, start: int, result: ChunkResult) -> int:
        """Fill in the chunk that begins with a member. **Returns:** its size."""
        if self.arrays is None:
            self.arrays = jax.tree.map(lambda x: np.empty((self.n, *x.shape[1:]), x.dtype), result)
        size = result.status.shape[0]
        chunk = slice(start, start + size)
        self.reached[chunk] = True
        jax.tree.map(lambda array, values: array.__setitem__(chunk, values), self.arrays, result)
        return size

    def filled(self) -> ChunkResult:
        """With NaN, and the status `INTERRUPTED`, for members that were not reached."""
        assert self.arrays is not None
        for x in jax.tree.leaves(self.arrays):
            x[~self.reached] = np.nan if jnp.issubdtype(x.dtype, jnp.inexact) else 0
        self.arrays.status[~self.reached] = Status.INTERRUPTED
        return self.arrays
