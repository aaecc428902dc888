"""What differs from member to member, by name: grids and tables. Knows columns of numbers; knows no system."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np

from .._common.lookup import not_there


class Table(eqx.Module):
    """Members of a sweep by name: `table["speed"]`.

    - `columns`: by name (n, ...), a row for every member; text labels a member and changes nothing.
    - `dims`, `shape`: of the results. A grid has an axis for every name, a table the one axis "member".
    """

    columns: dict[str, np.ndarray]
    dims: tuple[str, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.columns:
            raise not_there(name, self.columns, "this table")
        return self.columns[name]

    def __len__(self) -> int:
        return int(np.prod(self.shape))

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """The columns that are numbers."""
        return {name: column for name, column in self.columns.items() if column.dtype.kind == "f"}

    def axis(self, name: str) -> np.ndarray:
        """The values (shape[i],) along an axis of a grid."""
        i = self.dims.index(name)
        grid = self.columns[name].reshape(self.shape)
        return grid[(0,) * i + (slice(None),) + (0,) * (len(self.shape) - i - 1)]

    def __repr__(self) -> str:
        if self.dims == ("member",):
            return f"Table({len(self)} members: {', '.join(self.columns)})"
        axes = " x ".join(f"{name} ({n})" for name, n in zip(self.dims, self.shape, strict=True))
        return f"Table({len(self)} members: {axes})"


def grid(**axes: Any) -> Table:
    """Every combination of values, the last name running fastest.

        grid(speed=np.linspace(1, 10, 50), lam=np.linspace(0.2, 0.4, 20))

    **Arguments:** by name, values (k,): of parameters, coordinates, speeds or inputs, or of names that the functions
    given to `sweep` read.

    **Returns:** a `Table` of shape (50, 20), which the results of its sweep have too.

    **Raises:** `ValueError` where values are not a row of numbers.
    """
    if not axes:
        raise ValueError("grid: give values by name, such as grid(speed=[4.0, 5.0], lam=[0.3, 0.4]).")
    rows = {name: _column(name, values) for name, values in axes.items()}
    for name, row in rows.items():
        if row.ndim != 1 or row.dtype.kind != "f":
            raise ValueError(f"grid: {name} must be a row of numbers (k,), got the shape {row.shape}.")
    full = np.meshgrid(*rows.values(), indexing="ij")
    columns = {name: x.reshape(-1) for name, x in zip(rows, full, strict=True)}
    return Table(columns, tuple(rows), tuple(len(row) for row in rows.values()))


def as_table(table: Any) -> Table | None:
    """A `Table` from what a user has: a `Table`, columns by name, a DataFrame, or None."""
    if table is None or isinstance(table, Table):
        return table
    if not (isinstance(table, Mapping) or (hasattr(table, "items") and hasattr(table, "keys"))):
        raise TypeError(
            f"`table` is jaxkane.sweep.grid(...), a dict of columns or a DataFrame, got {type(table).__name__}."
        )
    names = [str(name) for name, _ in table.items()]  # a DataFrame may have two columns of one name
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"`table` has more than one column of the name {', '.join(twice)}: which is meant?")
    columns = {str(name): _column(str(name), values) for name, values in table.items()}
    lengths = {name: len(column) for name, column in columns.items()}
    if not lengths:
        raise ValueError("`table` has no columns.")
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"The columns of `table` differ in length: {listed}.")
    return Table(columns, ("member",), (next(iter(lengths.values())),))


def _column(name: str, values: Any) -> np.ndarray:
    if np.ma.is_masked(values):
        raise ValueError(f"{name!r} has masked entries: leave these members out, or fill them.")
    try:
        column = np.asarray(values)
        if column.ndim and not len(column):
            return column.astype(float)  # no members
        if column.dtype.kind in "OUST":
            is_text = column.ndim == 1 and all(isinstance(x, str) for x in column)
            return column.astype(str) if is_text else _refuse(name, values)
        if column.dtype.kind not in "buif":
            return _refuse(name, values)  # complex numbers would lose a part, dates become counts of nanoseconds
        column = column.astype(float)
    except (TypeError, ValueError):
        return _refuse(name, values)
    return column if column.ndim else _refuse(name, column)


def _refuse(name: str, values: Any) -> Any:
    raise ValueError(f"{name!r} must hold a row of numbers (or of labels), got {type(values).__name__} {values!r:.60}.")
