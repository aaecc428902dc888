"""The result of a sweep: arrays by name, with an axis for each swept name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._common.lookup import not_there
from .._integrate.status import Status, reason
from .._integrate.trajectory import Trajectory
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Numbers
from ._chunks import ChunkResult
from ._members import Table

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
