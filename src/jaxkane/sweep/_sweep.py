"""The front door of sweeps: chunk by chunk, here or on a cluster, into arrays and files."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._integrate.integrate import refuse_captured
from .._integrate.settings import resolve_adjoint, settings_for
from .._integrate.simulate import as_state, checked_times
from .._integrate.status import Status
from .._integrate.trajectory import Trajectory
from .._kane.arguments import is_concrete
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.components import Inputs
from .._system.system import State, System
from ._chunks import GROUP, Job, Part, mesh_of, on_cluster, traced
from ._files import Folder, manifest_of
from ._members import Row, Table, as_table, members_of
from ._result import Sweep


def sweep(
    system: System | Callable[[Row], System],
    state: State | Callable[[System, Row], State],
    ts: Any,
    inputs: Inputs = None,
    *,
    table: Any = None,
    reduce: Callable[[Trajectory], Any] | None = None,
    chunk: int = 256,
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
    - `chunk`: members in one call of a compiled program, rounded up to whole groups of 32.
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
    if chunk < 1:
        raise ValueError(f"sweep: `chunk` is a number of members, at least one; got {chunk}.")
    table = as_table(table)
    if isinstance(state, State) and isinstance(system, System):
        state = as_state(system, state)
    ts = checked_times(ts, getattr(state.q, "dtype", float) if isinstance(state, State) else float)
    settings = settings_for(ts, progress=False, rising=is_concrete(ts), **options)
    if isinstance(system, System):
        refuse_captured(system)
    members, shared, n = members_of(system, state, inputs, table, ts)
    found = table if table is not None else Table({}, ("member",), (n,))
    closures = captured_tracers(shared, reduce)
    job = Job(shared, ts, settings, reduce, None if client is not None else mesh_of(devices), closures)
    own = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members)
    if n == 0:
        like = jax.eval_shape(job.whole, own)
        return Sweep.of(jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), like), found, ts, reduce is not None)
    if not is_concrete(members, shared, ts, closures):  # inside jit, grad or vmap
        if folder is not None or client is not None:
            raise ValueError("sweep: `folder` and `client` cannot be used inside jit, grad or vmap.")
        given = members, shared, ts, closures
        settings, (members, shared, ts, closures) = resolve_adjoint(settings, options.get("adjoint", "auto"), given)
        job = Job(shared, ts, settings, reduce, job.mesh, closures)
        return Sweep.of(job.solve(members, n), found, ts, reduce is not None)

    size = n if n <= GROUP else GROUP * -(-min(chunk, n) // GROUP)
    kept = like = None
    if folder is not None:
        layout = {"members": n, "chunk": size}
        program, like = traced(job, own)
        kept = Folder(folder, manifest_of(program, system, state, inputs, table, ts, settings, reduce, layout))
    part = _in_chunks(job, jax.tree.map(np.asarray, members), n, size, kept, like, client, progress)
    return Sweep.of(part, found, ts, reduce is not None)


def _in_chunks(
    job: Job, members: Any, n: int, size: int, kept: Folder | None, like: Part | None, client: Any, progress: bool
) -> Part:
    """The results of n members, `size` at a time: those that stand in the folder, then the others, here or on a
    cluster. What is missing after Ctrl-C has the status `INTERRUPTED`."""
    members_at = lambda start: jax.tree.map(lambda x: x[start : start + size], members)  # noqa: E731
    result = _Result(n)
    with tqdm(total=n, disable=not progress, unit="member", file=sys.stderr) as bar:
        try:
            left = list(range(0, n, size))
            for start, part in _finished(kept, left, like, n, size):
                left.remove(start)
                bar.update(result.put(start, part))
            bar.initial = bar.n  # chunks that were read from files say nothing about the speed
            if client is None:
                run = ((start, job.solve(members_at(start), size)) for start in left)
            else:
                run = on_cluster(job, left, members_at, size, client)
            for start, part in run:
                part = jax.tree.map(np.asarray, part)
                if kept is not None:
                    kept.write(start, part)
                bar.update(result.put(start, part))
        except KeyboardInterrupt:
            if result.all is None:
                raise
    if kept is not None and result.reached.all():
        kept.tidy()
    return result.filled()


def _finished(
    kept: Folder | None, starts: list[int], like: Part | None, n: int, size: int
) -> Iterator[tuple[int, Part]]:
    """(start, part) of the chunks that stand in the folder, each member of the shapes of `like`."""
    if kept is None:
        return
    for start in tuple(starts):
        part = kept.read(start, like, min(size, n - start))
        if part is not None:
            yield start, part
    if kept.damaged:
        warnings.warn(
            f"{kept.path}: {len(kept.damaged)} chunks cannot be read and are computed again: {kept.damaged[0]}"
            + (", ..." if len(kept.damaged) > 1 else "."),
            stacklevel=3,
        )


class _Result:
    """The results of all members, filled chunk by chunk."""

    def __init__(self, n: int):
        self.n, self.reached, self.all = n, np.zeros(n, bool), None

    def put(self, start: int, part: Part) -> int:
        """Take in the chunk that begins with a member. **Returns:** its size."""
        if self.all is None:
            self.all = jax.tree.map(lambda x: np.empty((self.n, *x.shape[1:]), x.dtype), part)
        size = part.status.shape[0]
        self.reached[start : start + size] = True

        def copy(whole, some):
            whole[start : start + size] = some

        jax.tree.map(copy, self.all, part)
        return size

    def filled(self) -> Part:
        """With NaN, and the status `INTERRUPTED`, for members that were not reached."""
        assert self.all is not None
        for x in jax.tree.leaves(self.all):
            x[~self.reached] = np.nan if jnp.issubdtype(x.dtype, jnp.inexact) else 0
        self.all.status[~self.reached] = Status.INTERRUPTED
        return self.all
