"""`sweep`: simulations in chunks, in this process or on a cluster, with results as arrays by name and files."""

from __future__ import annotations

import dataclasses
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from .._common.lookup import not_there, refuse_unknown
from .._integrate.events import Status, reason
from .._integrate.integrate import refuse_captured
from .._integrate.settings import settings_for
from .._integrate.simulate import as_state, checked_times, clock_of
from .._integrate.trajectory import Trajectory
from .._kane.arguments import is_concrete
from .._scalarjit.cache_key import captured_tracers
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Inputs, Numbers
from .._system.system import State, System
from ._chunks import GROUP, ChunkResult, Folder, Task, manifest_of, mesh_of, on_cluster, trace
from ._members import Row, Table, as_table, members_of

_OPTIONS = (
    "rtol",
    "atol",
    "solver",
    "step",
    "adjoint",
    "max_steps",
    "max_jumps",
    "project",
    "stabilize",
)  # of `simulate`
_MEMBERS, _MEMBERS_ON_GPU = 256, 16_384  # per chunk; measured on an H200: half the time of 65 536


def sweep(
    system: System | Callable[[Row], System],
    state: State | Callable[[System, Row], State],
    ts: Numbers,
    inputs: Inputs = None,
    *,
    table: Table | Mapping[str, Any] | None = None,
    reduce: Callable[[Trajectory], Any] | None = None,
    chunk: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    client: Any = None,
    devices: Sequence[Any] | None = None,
    progress: bool = False,
    **options: Any,
) -> Sweep:
    """Simulate many members with different systems, initial states or inputs, in chunks of bounded memory.

        rides = sweep(bicycle, start, ts, table=grid(lam=np.linspace(0.2, 0.4, 20), roll_rate=[0.1, 0.5]))
        rides["roll"]  # (20, 2, n_t)

    A column of `table` with the name of a parameter, coordinate, independent speed or input sets its value. Dependent
    coordinates are then computed again (`assemble`). Other columns are read by functions `state` or `system`:

        def start(bicycle, row):
            return assemble(bicycle, {}, {"rear_wheel_rate": -row["speed"] / bicycle.rR})

    Both functions are compiled. A column that a function reads does not set a value by its name. Columns of text are
    labels.

    **Arguments:**

    - `system`: a system, whose parameters may have a leading axis (b, ...) of members; or a function (row) -> System.
    - `state`: `q` (b, n_q) or (n_q,), `u` (b, n_u) or (n_u,); or a function (system, row) -> State.
    - `ts`: (n_t,) times [s], the same for all members.
    - `inputs`: as for `simulate`. Samples may be (b, n_t); constants that differ between members are (b, 1).
    - `table`: the swept values by name: `grid(...)`, a dict of columns (b,) or a DataFrame.
    - `reduce`: a function of one member's `Trajectory` that returns the arrays to keep, e.g. `lambda trajectory:
        {"largest": jnp.max(jnp.abs(trajectory["roll"]))}`. It is compiled. The trajectories themselves are not kept.
    - `chunk`: members in one call of a compiled program, rounded up to whole groups of 32. Default: 256 on the CPU, 16
        384 on other devices. Memory grows with it.
    - `folder`: save every finished chunk there as a file. Call again to resume an interrupted sweep. The result is
        bit-identical to that of an uninterrupted sweep. A folder belongs to one program and its numbers; the folder of
        another sweep is refused.
    - `client`: a `dask.distributed.Client`, whose workers compute the chunks. Use workers of one thread. If a worker
        dies, its chunk is computed again. With other processors or libraries on the workers, the last bits may differ.
        Needs Dask: pip install 'jaxkane[cluster]'.
    - `devices`: the devices among which every chunk is divided. Default: all of this process (`jax.local_devices()`).
    - `progress`: show a progress bar.
    - `options`: those of `simulate`: rtol, atol, solver, step, adjoint, max_steps, max_jumps,
        project, stabilize.

    **Returns:** a `Sweep`. Its `status` states how each member ended; values after an early end are NaN.
    `Status.INVALID` means: a value is not finite, a positive parameter is not positive, a body is impossible, or a
    constraint is violated. After Ctrl-C the finished members are returned, the others have the status `INTERRUPTED`.
    Without `folder` this also holds for any other exception after the first chunk.

    **Raises:** `ValueError` if nothing is a batch, two batches differ in length, a column has no effect, or the folder
    contains another sweep; the message names the difference. With `folder` every exception is raised, with a note that
    the finished chunks are saved.

    **Warns:** `RuntimeWarning` if an exception ended a sweep without `folder` after its first chunk.
    """
    if chunk is None:
        chunk = _MEMBERS if jax.default_backend() == "cpu" else _MEMBERS_ON_GPU
    if not isinstance(chunk, int | np.integer) or chunk < 1:
        raise ValueError(f"sweep: `chunk` must be a positive number of members; got {chunk!r}.")
    refuse_unknown(options, _OPTIONS, "sweep has no option")
    if reduce is not None and not callable(reduce):
        raise TypeError(
            f"sweep: `reduce` must be a function of a Trajectory, e.g. lambda trajectory: trajectory['roll'][-1]; "
            f"got {reduce!r}."
        )
    table = as_table(table)
    if isinstance(state, State) and isinstance(system, System):
        state = as_state(system, state)
    dtype = jnp.result_type(getattr(state.q, "dtype", float) if isinstance(state, State) else float)
    ts = checked_times(ts, dtype)
    settings = settings_for(dtype, progress=False, rising=is_concrete(ts), check_bodies=True, **options)
    if isinstance(system, System):
        refuse_captured(system)
    members, shared, n = members_of(system, state, inputs, table, ts, dtype)
    axes = table if table is not None else Table({}, ("member",), (n,))
    closures = captured_tracers(shared, reduce)
    origin, taus = clock_of(ts, dtype)
    task = Task(shared, origin, taus, settings, reduce, None if client is not None else mesh_of(devices), closures)
    own = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members)
    if n == 0:
        like = jax.eval_shape(task.simulate, own)
        return Sweep.of(jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), like), axes, ts, reduce is not None)
    if not is_concrete(members, shared, ts, closures):  # inside jit, grad or vmap
        if folder is not None or client is not None:
            raise ValueError("sweep: `folder` and `client` cannot be used inside jit, grad or vmap.")
        return Sweep.of(task.solve(members, n), axes, ts, reduce is not None)

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
    members: PyTree,
    n: int,
    size: int,
    files: Folder | None,
    like: ChunkResult | None,
    client: Any,
    progress: bool,
) -> ChunkResult:
    """Compute n members, `size` at a time: read the chunks of the folder, then compute the others, here or on a
    cluster. After Ctrl-C the missing members have the status `INTERRUPTED`."""

    def members_at(start: int) -> Any:
        return jax.tree.map(lambda x: x[start : start + size], members)

    reached: Any = np.zeros(n, bool)
    arrays: Any = None
    remaining = list(range(0, n, size))

    def put(start: int, result: ChunkResult) -> None:
        nonlocal arrays
        if arrays is None:
            arrays = jax.tree.map(lambda x: np.empty((n, *x.shape[1:]), x.dtype), result)
        chunk = slice(start, start + result.status.shape[0])
        reached[chunk] = True
        jax.tree.map(lambda array, values: array.__setitem__(chunk, values), arrays, result)
        bar.update(result.status.shape[0])

    with tqdm(total=n, disable=not progress, unit="member", file=sys.stderr) as bar:
        try:
            for start in tuple(remaining):
                result = None if files is None else files.read(start, like, min(size, n - start))
                if result is not None:
                    remaining.remove(start)
                    put(start, result)
            if files is not None and files.damaged:
                warnings.warn(
                    f"{files.path}: {len(files.damaged)} chunks cannot be read and are computed again: "
                    f"{files.damaged[0]}" + (", ..." if len(files.damaged) > 1 else "."),
                    stacklevel=3,
                )
            bar.initial = bar.n  # chunks that were read from files would falsify the speed
            if client is None:
                chunks = ((start, task.solve(members_at(start), size)) for start in remaining)
            else:
                chunks = on_cluster(task, remaining, members_at, size, client)
            for start, result in chunks:
                result = jax.tree.map(np.asarray, result)
                if files is not None:
                    files.write(start, result)
                put(start, result)
        except (KeyboardInterrupt, Exception) as error:
            if arrays is None:
                raise
            finished = f"{int(reached.sum())} of {n} members are finished"
            if files is not None and not isinstance(error, KeyboardInterrupt):
                error.add_note(
                    f"sweep: {finished} and saved in {files.path}. Call sweep again with this folder to resume."
                )
                raise
            if not isinstance(error, KeyboardInterrupt):
                warnings.warn(
                    f"sweep: {finished} and returned; the others have the status INTERRUPTED, because of "
                    f"{type(error).__name__}: {str(error).rstrip(chr(46))}. Pass `folder` to make a sweep resumable.",
                    RuntimeWarning,
                    stacklevel=3,
                )
    if files is not None and reached.all():
        files.tidy()
    for x in jax.tree.leaves(arrays):
        x[~reached] = np.nan if jnp.issubdtype(x.dtype, jnp.inexact) else 0
    arrays.status[~reached] = Status.INTERRUPTED
    return arrays


_NO_MOTION = "This sweep has no trajectories, because `reduce` was passed. Its results are in `values`."


def _of_trajectory(name: str) -> Any:
    def attribute(sweep: Sweep) -> Any:
        if sweep.trajectory is None:
            raise AttributeError(_NO_MOTION)
        return getattr(sweep.trajectory, name)

    return property(attribute)


class Sweep(eqx.Module):
    """The trajectories of a sweep's members, by name: `rides["roll"]` (*shape, n_t), `rides["speed"]` (*shape).

    A grid gives one leading axis for each name. Any other table, or a batch, gives one axis of members. Values are NaN
    from the time at which a member ended early.

    Attributes:

    - `trajectory`: all trajectories as one `Trajectory` with leading axes, e.g. for `constraint_forces`. `t`, `q`, `u`,
        `u_dep`, `x`, `inputs`, `outputs`, `names`, `jumps`, `contacts` are its attributes. None if `reduce` was passed.
    - `values`: the results of `reduce`, with leading axes; None without `reduce`.
    - `status`: the status code of each member; `ok` and `reason` as of a `Trajectory`.
    - `t_end`: the time [s] at which each member ended.
    - `stats`: numbers of steps and evaluations of each member.
    - `table`: the swept values.
    - `dims`, `shape`: names and lengths of the leading axes.
    """

    trajectory: Trajectory | None
    values: Any
    status: Any
    t_end: Any
    stats: dict[str, Any]
    table: Table
    events: tuple[str, ...] = eqx.field(static=True)

    t, q, u, u_dep, x, inputs, outputs, names, jumps, contacts = map(
        _of_trajectory, ("t", "q", "u", "u_dep", "x", "inputs", "outputs", "names", "jumps", "contacts")
    )

    @classmethod
    def of(cls, result: ChunkResult, table: Table, ts: Numbers, reduced: bool) -> Sweep:
        """The results (b, ...) of all members, with the axes of their table."""
        result = jax.tree.map(lambda x: x.reshape(*table.shape, *x.shape[1:]), result)
        own = {"status": result.status, "t_end": result.t_end, "stats": result.stats}
        if not isinstance(ts, jax.Array):  # times that the dtype of the state cannot resolve: see `clock_of`
            own["t_end"] = ts[0] + np.asarray(result.t_end, np.float64)
            jumps = None if reduced else getattr(result.values, "jumps", None)
            if jumps is not None:
                jumps = dataclasses.replace(jumps, t=ts[0] + np.asarray(jumps.t, np.float64))
                result = dataclasses.replace(result, values=dataclasses.replace(result.values, jumps=jumps))
        trajectory, values = None, result.values
        if not reduced:
            t = ts if isinstance(ts, Tracer) else np.asarray(ts)
            spread: Any = np.broadcast_to if isinstance(values.q, np.ndarray) else jax.numpy.broadcast_to
            trajectory = dataclasses.replace(values, t=spread(t, (*table.shape, *t.shape)), **own)
            values = None
        return cls(trajectory, values, **own, table=table, events=result.events)

    @property
    def dims(self) -> tuple[str, ...]:
        return self.table.dims

    @property
    def shape(self) -> tuple[int, ...]:
        return self.table.shape

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def ok(self) -> np.ndarray:
        """Whether the last time was reached (*shape)."""
        return self.status == Status.COMPLETED

    @property
    def reason(self) -> Any:
        """The status in words, a list in the order of the members."""
        return [reason(int(code), self.events) for code in np.ravel(self.status)]

    def __getitem__(self, name: str) -> Numbers:
        """The values of a name.

        **Arguments:**

        - `name`: a coordinate, speed, state, input or output; a key of the result of `reduce`; or a column of the
            table.

        **Returns:** (*shape, n_t) for a trajectory, (*shape) for a column.

        **Raises:** `KeyError` for an unknown name.
        """
        if self.trajectory is not None and name in _names(self.trajectory):
            return self.trajectory[name]
        if isinstance(self.values, Mapping) and name in self.values:
            return self.values[name]
        if name in self.table.columns:
            column = self.table[name]
            return column.reshape(*self.shape, *column.shape[1:])
        known = list(self.values) if isinstance(self.values, Mapping) else []
        raise not_there(name, [*known, *_names(self.trajectory), *self.table.columns], "this sweep")

    def member(self, *place: int) -> Trajectory:
        """The trajectory of one member.

        **Arguments:**

        - `place`: one index for each leading axis.

        **Raises:** `ValueError` if the number of indices is wrong, `AttributeError` if `reduce` was passed.
        """
        if len(place) != len(self.shape):
            raise ValueError(f"`member` needs {len(self.shape)} indices ({', '.join(self.dims)}); got {place}.")
        if self.trajectory is None:
            raise AttributeError(_NO_MOTION)
        return jax.tree.map(lambda x: x[place], self.trajectory)

    @property
    def counts(self) -> dict[str, int]:
        """The number of members with each status, the most frequent first."""
        codes, n = np.unique(np.asarray(self.status), return_counts=True)
        order = np.argsort(-n, kind="stable")
        return {reason(int(codes[i]), self.events): int(n[i]) for i in order}

    def to_xarray(self) -> Any:
        """Convert to an `xarray.Dataset`: a variable for every name, coordinates for the times and the table.

        A swept initial value of a coordinate or speed becomes the coordinate "initial ...". A swept input is only a
        coordinate. Needs xarray: pip install 'jaxkane[xarray]'.
        """
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray: pip install 'jaxkane[xarray]'") from error
        trajectory, table = self.trajectory, self.table
        moving = _names(trajectory)
        inputs = [] if trajectory is None else list(trajectory.inputs)
        axis = {d: f"initial {d}" if d in moving and d not in inputs else d for d in (*self.dims, *table.columns)}
        dims = tuple(axis[d] for d in self.dims)
        coords: dict[str, Any] = {axis[d]: table.axis(d) for d in self.dims if d in table.columns}
        for name, column in table.columns.items():
            if name not in self.dims:
                extra = tuple(f"{name}_{i}" for i in range(column.ndim - 1))
                coords[axis[name]] = ((*dims, *extra), self[name] if name not in moving else column)
        variables: dict[str, Any] = {}
        if trajectory is not None:
            coords["t"] = np.asarray(trajectory.t).reshape(-1, trajectory.t.shape[-1])[0]
            names = [name for name in moving if name not in coords]
            variables = {name: ((*dims, "t"), np.asarray(trajectory[name])) for name in names}
        for path, leaf in jax.tree_util.tree_flatten_with_path(self.values)[0]:
            name = jax.tree_util.keystr(path, simple=True, separator=".") or "value"
            extra = tuple(f"{name}_{i}" for i in range(leaf.ndim - len(dims)))
            variables[name] = ((*dims, *extra), np.asarray(leaf))
        ends = {"status": self.status, "t_end": self.t_end, "steps": self.stats["steps"]}
        variables |= {name: (dims, np.asarray(x)) for name, x in ends.items() if name not in variables}
        return xarray.Dataset(variables, coords)

    def __repr__(self) -> str:
        if isinstance(self.status, Tracer):
            return f"Sweep(shape={self.shape})"
        of = f"{np.size(self.status)} members"
        if self.dims != ("member",):
            of += ": " + " x ".join(f"{name} ({n})" for name, n in zip(self.dims, self.shape, strict=True))
        ended = ", ".join(f"{n} {why}" for why, n in self.counts.items())
        return f"Sweep({of}; {ended})"


def _names(trajectory: Trajectory | None) -> list[str]:
    if trajectory is None:
        return []
    return [*(name for names in trajectory.names for name in names), *trajectory.inputs, *trajectory.outputs]
