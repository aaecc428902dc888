"""What a sweep gives: arrays by name with an axis for every swept name. Knows names and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._common.lookup import not_there
from .._integrate.status import Status, reason
from .._integrate.trajectory import Trajectory
from .._scalarjit.compat import Tracer
from ._chunks import Part
from ._members import Table


class Sweep(eqx.Module):
    """The motions of a sweep's members, by name: `rides["roll"]` (*shape, n_t), `rides["speed"]` (*shape).

    The leading axes are those of the table: of a grid one for each name, of anything else the one of the members. What
    a member did not reach is NaN.

    Attributes:

    - `trajectory`: all motions as one `Trajectory` with leading axes, for whatever wants such (`constraint_forces`);
        `t`, `q`, `u`, `u_dep`, `x`, `inputs`, `outputs`, `names` are its own. None where `reduce` was given.
    - `values`: what `reduce` made of every motion, with leading axes; else None.
    - `status`, `t_end` [s], `stats`: how, when and in how many steps each ended; `ok`, `reason`: as of a `Trajectory`.
    - `table`: what was swept; `dims`, `shape`: names and lengths of the leading axes.
    """

    trajectory: Trajectory | None
    values: Any
    status: Any
    t_end: Any
    stats: dict[str, Any]
    table: Table
    events: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, part: Part, table: Table, ts: Any, reduced: bool) -> Sweep:
        """The results (b, ...) of all members, with the axes of their table."""
        shaped = jax.tree.map(lambda x: x.reshape(*table.shape, *x.shape[1:]), part)
        ride = None
        if not reduced:
            q, u, u_dep, x, inputs, outputs, end, discontinuities = shaped.values
            spread: Any = np.broadcast_to if isinstance(q, np.ndarray) else jax.numpy.broadcast_to
            t = spread(ts if isinstance(ts, Tracer) else np.asarray(ts), (*table.shape, ts.shape[0]))
            arrays: list[Any] = [t, q, u, u_dep, x, inputs, outputs, shaped.status, shaped.t_end, shaped.stats]
            static = {"names": part.names, "events": part.events, "adjoint": part.adjoint, "units": part.units}
            ride = Trajectory(*arrays, **static, end=end, discontinuities=discontinuities)
        values = shaped.values if reduced else None
        return cls(ride, values, shaped.status, shaped.t_end, shaped.stats, table, part.events)

    @property
    def dims(self) -> tuple[str, ...]:
        return self.table.dims

    @property
    def shape(self) -> tuple[int, ...]:
        return self.table.shape

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def _ride(self) -> Trajectory:
        if self.trajectory is None:
            raise AttributeError("This sweep kept what `reduce` made of the motions, in `values`, and no motion.")
        return self.trajectory

    @property
    def t(self) -> Any:
        return self._ride.t

    @property
    def q(self) -> Any:
        return self._ride.q

    @property
    def u(self) -> Any:
        return self._ride.u

    @property
    def u_dep(self) -> Any:
        return self._ride.u_dep

    @property
    def x(self) -> Any:
        return self._ride.x

    @property
    def inputs(self) -> dict[str, Any]:
        return self._ride.inputs

    @property
    def outputs(self) -> dict[str, Any]:
        return self._ride.outputs

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """Of coordinates, independent and dependent speeds, and states."""
        return self._ride.names

    @property
    def ok(self) -> Any:
        """Whether the last time was reached (*shape)."""
        return self.status == Status.COMPLETED

    @property
    def reason(self) -> Any:
        """The status in words, a list in the order of the members."""
        return [reason(int(code), self.events) for code in np.ravel(self.status)]

    def __getitem__(self, name: str) -> Any:
        """A coordinate, speed, state, input or output (*shape, n_t), what `reduce` called so, or a column of the table
        (*shape)."""
        if self.trajectory is not None and name in _names(self.trajectory):
            return self.trajectory[name]
        if isinstance(self.values, Mapping) and name in self.values:
            return self.values[name]
        if name in self.table.columns:
            column = self.table[name]
            return column.reshape(*self.shape, *column.shape[1:])
        known = list(self.values) if isinstance(self.values, Mapping) else []
        known += _names(self.trajectory) if self.trajectory is not None else []
        raise not_there(name, [*known, *self.table.columns], "this sweep")

    def member(self, *place: int) -> Trajectory:
        """The motion of one member, by its place along every axis."""
        if len(place) != len(self.shape):
            raise ValueError(f"A member is found by {len(self.shape)} places ({', '.join(self.dims)}), got {place}.")
        return jax.tree.map(lambda x: x[place], self._ride)

    @property
    def counts(self) -> dict[str, int]:
        """How many members ended in which way, the most frequent first."""
        codes, n = np.unique(np.asarray(self.status), return_counts=True)
        order = np.argsort(-n, kind="stable")
        return {reason(int(codes[i]), self.events): int(n[i]) for i in order}

    def to_xarray(self) -> Any:
        """An `xarray.Dataset`: a variable for every name, coordinates for the times and the table.

        A swept initial value of a coordinate or speed becomes the coordinate "initial ..."; a swept input is a
        coordinate only. Needs xarray: pip install 'jaxkane[xarray]'.
        """
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray: pip install 'jaxkane[xarray]'") from error
        ride, table = self.trajectory, self.table
        moving = _names(ride) if ride is not None else []
        inputs = list(ride.inputs) if ride is not None else []
        axis = {d: f"initial {d}" if d in moving and d not in inputs else d for d in (*self.dims, *table.columns)}
        dims = tuple(axis[d] for d in self.dims)
        coords: dict[str, Any] = {axis[d]: table.axis(d) for d in self.dims if d in table.columns}
        for name, column in table.columns.items():
            if name not in self.dims:
                extra = tuple(f"{name}_{i}" for i in range(column.ndim - 1))
                coords[axis[name]] = ((*dims, *extra), self[name] if name not in moving else column)
        found: dict[str, Any] = {}
        if ride is not None:
            coords["t"] = np.asarray(ride.t).reshape(-1, ride.t.shape[-1])[0]
            found = {name: ((*dims, "t"), np.asarray(ride[name])) for name in moving if name not in coords}
        for path, leaf in jax.tree_util.tree_flatten_with_path(self.values)[0]:
            name = jax.tree_util.keystr(path, simple=True, separator=".") or "value"
            extra = tuple(f"{name}_{i}" for i in range(leaf.ndim - len(dims)))
            found[name] = ((*dims, *extra), np.asarray(leaf))
        ends = {"status": self.status, "t_end": self.t_end, "steps": self.stats["steps"]}
        found |= {name: (dims, np.asarray(x)) for name, x in ends.items() if name not in found}
        return xarray.Dataset(found, coords)

    def __repr__(self) -> str:
        if isinstance(self.status, Tracer):
            return f"Sweep(shape={self.shape})"
        of = f"{np.size(self.status)} members"
        if self.dims != ("member",):
            of += ": " + " x ".join(f"{name} ({n})" for name, n in zip(self.dims, self.shape, strict=True))
        ended = ", ".join(f"{n} {why}" for why, n in self.counts.items())
        return f"Sweep({of}; {ended})"


def _names(ride: Trajectory) -> list[str]:
    return [*(name for names in ride.names for name in names), *ride.inputs, *ride.outputs]
