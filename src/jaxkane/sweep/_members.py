"""Members of a sweep: tables and grids, and the system, initial state and inputs of each member."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree

from .._common.lookup import not_there
from .._integrate.inputs import Samples, as_signals, real_array, since
from .._integrate.simulate import as_state, checked_state, clock_of, first_of, refuse_coarse_times
from .._kane.arguments import is_concrete
from .._kane.checks import check_system
from .._kane.consistent_state import assemble
from .._kane.contact_checks import check_contacts
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, Inputs, Numbers
from .._system.parameters import in_batches, parameters_in, with_parameters
from .._system.system import State, System, explain_value_of_traced


class Table(eqx.Module):
    """The swept values of all members by name: `table["speed"]`.

    - `columns`: by name (n, ...), one row for each member. A column of text labels a member and has no other effect.
    - `dims`, `shape`: axes of the results. A grid has one axis for each name, a table has the one axis "member".
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
        """The numerical columns."""
        return {name: column for name, column in self.columns.items() if column.dtype.kind == "f"}

    def axis(self, name: str) -> np.ndarray:
        """The values (shape[i],) along an axis of a grid."""
        i = self.dims.index(name)
        grid = self.columns[name].reshape(self.shape)
        return grid[(0,) * i + (slice(None),) + (0,) * (len(self.shape) - i - 1)]

    def __repr__(self) -> str:
        columns = []
        for name, column in self.columns.items():
            axis = f" ({self.shape[self.dims.index(name)]})" if name in self.dims else ""
            is_range = column.dtype.kind == "f" and column.size > 0
            columns.append(f"{name}{f' {column.min():.6g} to {column.max():.6g}' * is_range}{axis}")
        return f"Table({len(self)} members: {(', ' if self.dims == ('member',) else ' x ').join(columns)})"


def grid(**axes: Any) -> Table:
    """All combinations of values; the last name varies fastest.

        grid(speed=np.linspace(1, 10, 50), lam=np.linspace(0.2, 0.4, 20))

    **Arguments:**

    - `axes`: by name, values (k,). A name is a parameter, coordinate, speed or input, or one that a function given to
        `sweep` reads.

    **Returns:** a `Table`, here of shape (50, 20). The results of its sweep have the same shape.

    **Raises:** `ValueError` if the values of a name are not one-dimensional numbers.
    """
    if not axes:
        raise ValueError("grid: no values. Pass values by name, such as grid(speed=[4.0, 5.0], lam=[0.3, 0.4]).")
    rows = {name: _column(name, values) for name, values in axes.items()}
    for name, row in rows.items():
        if row.dtype.kind != "f":
            raise ValueError(f"grid: {name} is text. For labels, pass `table` as a dict or a DataFrame.")
        if row.ndim != 1:
            raise ValueError(f"grid: {name} must be a row of numbers (k,), got the shape {row.shape}.")
    full = np.meshgrid(*rows.values(), indexing="ij")
    columns = {name: x.reshape(-1) for name, x in zip(rows, full, strict=True)}
    return Table(columns, tuple(rows), tuple(len(row) for row in rows.values()))


def as_table(table: Any) -> Table | None:
    """A `Table` from a `Table`, columns by name, a DataFrame, or None."""
    if table is None or isinstance(table, Table):
        return table
    if not (isinstance(table, Mapping) or (hasattr(table, "items") and hasattr(table, "keys"))):
        raise TypeError(
            f"`table` must be jaxkane.sweep.grid(...), a dict of columns or a DataFrame; got {type(table).__name__}."
        )
    names = [str(name) for name, _ in table.items()]  # a DataFrame may have two columns of one name
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"`table` has more than one column named {', '.join(twice)}. Rename or remove the duplicates.")
    columns = {str(name): _column(str(name), values) for name, values in table.items()}
    lengths = {name: len(column) for name, column in columns.items()}
    if not lengths:
        raise ValueError("`table` has no columns.")
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"The columns of `table` differ in length: {listed}. Pass columns of equal length.")
    return Table(columns, ("member",), (next(iter(lengths.values())),))


def _column(name: str, values: Numbers) -> np.ndarray:
    if np.ma.is_masked(values):
        raise ValueError(f"{name!r} has masked entries: remove these members, or fill the entries.")
    try:
        column = np.asarray(values)
        if column.ndim and not len(column):
            return column.astype(float)  # no members
        if column.dtype.kind in "OUST":
            is_text = column.ndim == 1 and all(isinstance(x, str) for x in column)
            return column.astype(str) if is_text else _refuse(name, values)
        if column.dtype.kind not in "uif" or _has_truth_values(values):
            # complex numbers would lose a part, and dates would become counts of nanoseconds
            return _refuse(name, values)
        column = column.astype(float)
    except (TypeError, ValueError):
        return _refuse(name, values)
    return column if column.ndim else _refuse(name, column)


def _has_truth_values(values: Numbers) -> bool:
    if isinstance(values, (list, tuple)):  # in a list with numbers, NumPy converts booleans to 0 and 1
        return any(isinstance(x, (bool, np.bool_)) for x in values)
    return np.asarray(values).dtype.kind == "b"


def _refuse(name: str, values: Numbers) -> Any:
    if isinstance(values, Tracer):
        raise TypeError(
            f"The column {name!r} of a table is traced (by jax.jit, jax.grad or jax.vmap), but a table needs concrete "
            "numbers. Omit this column, and add a leading axis of members to the parameter, the state or the input."
        )
    hint = " Write booleans as numbers, 0.0 and 1.0." if _has_truth_values(values) else ""
    raise ValueError(
        f"{name!r} must be a row of numbers (or of labels), got {type(values).__name__} {values!r:.60}.{hint}"
    )


class Row(Mapping[str, Any]):
    """One member's values by name, for functions of the user. It records which names were read."""

    def __init__(self, columns: dict[str, Any]):
        self.columns = columns
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Numbers:
        if name not in self.columns:
            raise not_there(name, self.columns, "the columns of the sweep's table")
        self.read.add(name)
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __repr__(self) -> str:
        return f"Row({', '.join(self.columns)})"

    def of(self, names: Iterable[str], but: Collection[str] = ()) -> dict[str, Any]:
        """The values that are set by name, except those that a function has read (`but`)."""
        return {name: self.columns[name] for name in names if name in self.columns and name not in but}

    def given_to(self, function: Callable[..., Any], *arguments: Any) -> tuple[Any, set[str]]:
        """The return value of `function(*arguments, row)`, and the names that it read. Names that were read are not
        set."""
        row = Row(self.columns)
        with explain_value_of_traced(f"sweep: the function {getattr(function, '__name__', repr(function))}"):
            made = function(*arguments, row)
        self.read |= row.read
        return made, row.read


class _Leaf:
    """A leaf with its own identity, because one array may occur twice in a tree."""

    def __init__(self, x: Numbers):
        self.x = x


def members_of(
    system: Any, state: Any, inputs: Inputs, table: Table | None, ts: Numbers, dtype: DTypeLike
) -> tuple[Any, Any, int]:
    """Split the data of a sweep.

    **Returns:** the batched leaves (b, ...), the shared leaves, and the number of members.

    **Raises:** `ValueError` if nothing is batched, if the batches differ in length, or if nothing reads a column.
    """
    columns = {name: np.asarray(x, dtype=dtype) for name, x in table.numbers.items()} if table is not None else {}
    _refuse_twice(columns, system, inputs)
    signals = inputs if callable(inputs) else since(first_of(ts), _signals(inputs, system, columns, ts), dtype)
    if isinstance(system, System):
        refuse_coarse_times(system, ts, dtype, signals)
    tree = (system, state, signals, columns)
    places = jax.tree.map(_Leaf, tree)
    batches = _batches(places)
    members, shared = eqx.partition(tree, jax.tree.map(lambda leaf: leaf in batches, places))
    lengths = {name: leaf.x.shape[0] for leaf, name in batches.items()}
    if table is not None and not columns:
        lengths["table"] = len(table)
    if not jax.tree.leaves(members):
        if table is not None:
            raise ValueError(
                f"sweep: all columns of `table` ({', '.join(table.columns)}) are text. Text only labels a member, so "
                "all members would be equal. Add a column of numbers; numbers that were read as text are converted by "
                "numpy.asarray(column, float)."
            )
        raise ValueError(
            "sweep: no argument is a batch. Pass a `table`, or add a leading axis to a parameter, state.q, state.u or "
            "an input. For one trajectory, call jaxkane.simulate."
        )
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"sweep: the batches differ in length: {listed}. Pass batches of equal length.")
    origin, _ = clock_of(ts, dtype)
    _check(members, shared, origin, table)
    _check_description(members, shared, origin)
    return members, shared, next(iter(lengths.values()))


def system_and_signals(own: PyTree, shared: PyTree) -> tuple[System, Any]:
    """The system and the signals of one member."""
    system, _, signals, columns = eqx.combine(own, shared)
    system, _ = _system(system, Row(columns))
    if not callable(signals):
        signals = {**signals, **{name: columns[name] for name in system.inputs if name in columns}}
    return system, signals


def start_of(own: PyTree, shared: PyTree, t: Component) -> State:
    """The initial state of one member, at the time t."""
    system, state, _, columns = eqx.combine(own, shared)
    return _start(system, state, Row(columns), t)


def _system(system: System, row: Row) -> tuple[System, dict[str, Any]]:
    """The system of a row, and the parameters that were set by name."""
    read: set[str] = set()
    if not isinstance(system, System):
        system, read = row.given_to(system)
        _refuse_no_system(system)
    parameters = row.of((name for name, _, _ in parameters_in(system)), but=read)
    return with_parameters(system, parameters), parameters


def _refuse_no_system(given: Any) -> None:
    if not isinstance(given, System):
        raise TypeError("sweep: the function `system` must return a System for each row.")


def _start(system: System, state: Any, row: Row, t: Component) -> State:
    system, parameters = _system(system, row)
    read: set[str] = set()
    if not isinstance(state, State):
        state, read = row.given_to(state, system)
        if not isinstance(state, State):
            raise TypeError(
                f"sweep: the function `state` must return a jaxkane.State for each row, got {type(state).__name__}: "
                "jk.State(q, u), of arrays or of dicts by name."
            )
    state = as_state(system, state)
    groups = (system.coordinates, system.speeds, system.states)
    q, u, x = (row.of(names, but=read) for names in groups)
    parts = zip((state.q, state.u, state.x), (q, u, x), groups, strict=True)
    # The contact states belong to coordinates, speeds and parameters.
    contacts = None if q or u or parameters else state.contacts
    q0, u0, x0 = (_with_columns(values, columns, names) for values, columns, names in parts)
    state = State(q0, u0, x0, contacts)
    if system.dependent_coordinates and (q or parameters):  # they depend on the others
        state = assemble(system, state.q, state.u, state.x, t=t)
    return state


def _with_columns(values: Numbers, columns: dict[str, Any], names: tuple[str, ...]) -> Any:
    for name, value in columns.items():
        values = values.at[names.index(name)].set(value)
    return values


def _check(members: PyTree, shared: PyTree, t: Component, table: Table | None) -> None:
    """Make one member with abstract values, and refuse data that do not match the system."""

    def trial(own):
        system, state, signals, columns = eqx.combine(own, shared)
        row = Row(columns)
        start = _start(system, state, row, t)
        system, _ = _system(system, row)
        seen.append((system, signals, row))
        return checked_state(system, start)

    seen: list[Any] = []
    jax.eval_shape(trial, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members))
    system, signals, row = seen[0]
    name = type(system).__name__
    known = {
        "parameter": [name for name, _, _ in parameters_in(system)],
        "coordinate": system.coordinates,
        "speed": (*system.speeds, *system.dependent_speeds),
        "input": system.inputs,
        "state": system.states,
    }
    for column in table.columns if table is not None else ():
        kinds = [kind for kind, names in known.items() if column in names]
        if len(kinds) > 1:
            raise ValueError(
                f"sweep: the column {column!r} is ambiguous: {name} has more than one number of that "
                f"name ({', '.join(kinds)}). Rename the column, and read it in `state` as a function of (system, row), "
                "or in `system` as a function of (row)."
            )
        if kinds and column not in row:
            raise ValueError(
                f"sweep: the column {column!r} is text, but {name} has a number of that name ({kinds[0]}). "
                "Convert numbers that were read as text by numpy.asarray(column, float), or rename a column of labels."
            )
    applied = row.of(itertools.chain(*known.values())).keys()
    applied -= {*system.dependent_coordinates, *system.dependent_speeds}
    if callable(signals) and applied & set(system.inputs):
        listed = ", ".join(sorted(applied & set(system.inputs)))
        raise ValueError(f"sweep: {listed} is a column of the table and is also returned by `inputs`. Remove one.")
    follow = {*system.dependent_coordinates, *system.dependent_speeds} & set(row) - row.read
    if follow:
        listed = ", ".join(sorted(follow))
        raise ValueError(f"sweep: {name}: {listed} is computed from the others. Remove this column.")
    unused = [column for column in row if column not in applied | row.read]
    if unused:
        raise ValueError(
            f"sweep: the columns {', '.join(unused)} have no effect: {name} has no parameter, independent coordinate, "
            "independent speed, state or input of that name. Pass `state` as a function of (system, row), or `system` "
            f"as a function of (row), which reads row[{unused[0]!r}]."
        )


def _check_description(members: PyTree, shared: PyTree, t: Component) -> None:
    """Refuse a contradictory system, checked with the first member; contacts, where numbers decide, also with the last
    one. An impossible body makes only its member invalid."""
    if any(x.shape[0] == 0 for x in jax.tree.leaves(members)):
        return
    for i in (0, -1):
        own = jax.tree.map(lambda x, i=i: x[i], members)
        if i == -1 and not all(map(_is_finite, jax.tree.leaves(own))):
            return
        system, state, _, columns = eqx.combine(own, shared)
        system, _ = _system(system, Row(columns))
        q = as_state(system, state).q if isinstance(state, State) else None
        if q is not None and is_concrete(q) and not np.all(np.isfinite(q)):
            q = None
        if i == 0:
            check_system(system, t, q, bodies=False)
        check_contacts(system, t, q, may_penetrate=True)


def _is_finite(x: Any) -> bool:
    return not is_concrete(x) or not eqx.is_inexact_array_like(x) or bool(np.all(np.isfinite(x)))


def _signals(inputs: Inputs, system: System, columns: dict[str, Any], ts: Numbers) -> Any:
    """Signals as in `simulate`; samples may have a leading axis of members."""
    if not isinstance(system, System):  # a function of the row: only its names are needed
        system = jax.eval_shape(lambda row: system(Row(row)), {k: jnp.zeros(x.shape[1:]) for k, x in columns.items()})
        _refuse_no_system(system)
    assert not callable(inputs)
    single, batches, samples = {}, {}, {}
    for name, value in (inputs or {}).items():
        if isinstance(value, Samples):
            samples[name] = value
            continue
        array = None if callable(value) else real_array(value, f"The input {name!r}", jnp.result_type(ts.dtype))
        if array is None or array.shape in ((), ts.shape):
            single[name] = value
        elif array.ndim == 2 and array.shape[1] in (1, ts.shape[0]):
            batches[name] = array
        else:
            raise ValueError(
                f"The input {name!r} of a sweep must be a number, samples (n_t,), or a batch (b, n_t) or (b, 1) with "
                f"n_t = {ts.shape[0]}; got the shape {array.shape}."
            )
    known = as_signals(single | dict.fromkeys([*batches, *samples], 0.0), system.inputs, ts, type(system).__name__)
    for name, array in batches.items():
        # Check with ones: samples that are not finite make only their member invalid, and raise nothing.
        known[name] = array[:, 0] if array.shape[1] == 1 else _samples_of_members(ts, array)
    return known | samples


def _samples_of_members(ts: Numbers, values: Numbers) -> Samples:
    return eqx.tree_at(lambda samples: samples.values, Samples(ts, jnp.ones_like(values)), values)


def _refuse_twice(columns: dict[str, Any], system: System, inputs: Inputs) -> None:
    """A column may replace a value that all members share, but not a batch.

    **Raises:** `ValueError` if a column is also a batch or an input.
    """
    twice = {name: "`inputs`" for name in columns if isinstance(inputs, Mapping) and name in inputs}
    if isinstance(system, System):
        for name in in_batches(system):
            if name in columns:
                twice[name] = f"a batch of {type(system).__name__}"
    if twice:
        listed = ", ".join(f"{name} (a column of the table, and in {where})" for name, where in twice.items())
        raise ValueError(f"sweep: passed twice: {listed}. Remove one of them.")


def _batches(places: Any) -> dict[_Leaf, str]:
    """The leaves that have a leading axis of members, with their names."""
    system, state, signals, columns = places
    batches = {column: name for name, column in columns.items()}
    if isinstance(system, System):
        for name, leaf, info in parameters_in(system):
            if isinstance(leaf, _Leaf) and np.ndim(leaf.x) == len(info.shape) + 1:
                batches[leaf] = name
    if isinstance(state, State):
        for name, leaf in vars(state).items():
            if isinstance(leaf, _Leaf) and np.ndim(leaf.x) == 2:
                batches[leaf] = f"state.{name}"
    if isinstance(signals, dict):
        for name, signal in signals.items():
            is_samples = isinstance(signal, Samples)
            leaves = {name: signal.values, f"times of {name}": signal.ts} if is_samples else {name: signal}
            for label, leaf in leaves.items():
                if isinstance(leaf, _Leaf) and isinstance(leaf.x, jax.Array) and leaf.x.ndim == 1 + is_samples:
                    batches[leaf] = label
    return batches
