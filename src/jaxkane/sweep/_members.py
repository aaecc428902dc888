"""Members of a sweep: tables and grids, and the system, initial state and inputs of each member."""

from __future__ import annotations

import itertools
from collections import UserDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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
from .._kane.contact.checks import check_contacts
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
        if row.dtype.kind != "f" or row.ndim != 1:
            got = f"the shape {row.shape}" if row.dtype.kind == "f" else "text: pass labels in a dict or a DataFrame"
            raise ValueError(f"grid: {name} must be a row of numbers (k,), got {got}.")
    full = np.meshgrid(*rows.values(), indexing="ij")
    columns = {name: x.reshape(-1) for name, x in zip(rows, full, strict=True)}
    return Table(columns, tuple(rows), tuple(len(row) for row in rows.values()))


def as_table(table: Table | Mapping[str, Any] | None) -> Table | None:
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
    if not columns:
        raise ValueError("`table` has no columns.")
    n = _common_length({name: len(column) for name, column in columns.items()}, "The columns of `table`")
    return Table(columns, ("member",), (n,))


def _common_length(lengths: dict[str, int], what: str) -> int:
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"{what} differ in length: {listed}. Make their lengths equal.")
    return next(iter(lengths.values()))


def _column(name: str, values: Numbers) -> np.ndarray:
    """A column as floats, or as strings if all entries are labels."""
    if isinstance(values, Tracer):
        raise TypeError(
            f"The column {name!r} of a table is traced (by jax.jit, jax.grad or jax.vmap), but a table needs concrete "
            "numbers. Omit this column, and add a leading axis of members to the parameter, the state or the input."
        )
    if np.ma.is_masked(values):
        raise ValueError(f"{name!r} has masked entries: remove these members, or fill the entries.")
    try:
        column = np.asarray(values)
    except (TypeError, ValueError):  # of traced numbers, or of rows of different lengths
        column = np.array(None)
    if column.ndim and not len(column):
        return column.astype(float)  # no members
    if column.dtype.kind in "OUST" and column.ndim == 1 and all(isinstance(x, str) for x in column):
        return column.astype(str)
    # In a list with numbers, NumPy converts booleans to 0 and 1. Complex numbers would lose a part, and dates would
    # become numbers of nanoseconds.
    listed = values if isinstance(values, (list, tuple)) else ()
    has_booleans = column.dtype.kind == "b" or any(isinstance(x, (bool, np.bool_)) for x in listed)
    if column.ndim and column.dtype.kind in "uif" and not has_booleans:
        return column.astype(float)
    raise ValueError(
        f"{name!r} must be a row of numbers (or of labels), got {type(values).__name__} {values!r:.60}."
        + " Write booleans as numbers, 0.0 and 1.0." * has_booleans
    )


class Row(UserDict[str, Any]):
    """One member's values by name, for functions of the user. It records which names were `read`."""

    def __init__(self, columns: Mapping[str, Any]):
        super().__init__(columns)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Numbers:
        if name not in self.data:
            raise not_there(name, self.data, "the columns of the sweep's table")
        self.read.add(name)
        return self.data[name]

    def of(self, names: Iterable[str], but: Collection[str] = ()) -> dict[str, Any]:
        """The values that are set by name, except those that a function has read (`but`)."""
        return {name: self.data[name] for name in names if name in self.data and name not in but}

    def given_to(self, function: Callable[..., Any], *arguments: Any) -> tuple[Any, set[str]]:
        """The return value of `function(*arguments, row)`, and the names that it read. Names that were read are not
        set."""
        row = Row(self.data)
        with explain_value_of_traced(f"sweep: the function {getattr(function, '__name__', repr(function))}"):
            made = function(*arguments, row)
        self.read |= row.read
        return made, row.read


def members_of(
    system: System | Callable[[Row], System],
    state: State | Callable[[System, Row], State],
    inputs: Inputs,
    table: Table | None,
    ts: Numbers,
    dtype: DTypeLike,
) -> tuple[Any, Any, int]:
    """Split the data of a sweep.

    **Returns:** the batched leaves (b, ...), the shared leaves, and the number of members.

    **Raises:** `ValueError` if nothing is batched, if the batches differ in length, or if nothing reads a column.
    """
    columns = {name: np.asarray(x, dtype=dtype) for name, x in table.numbers.items()} if table is not None else {}
    # A column may replace a value that all members share, but not a batch.
    twice = {name: "`inputs`" for name in columns if isinstance(inputs, Mapping) and name in inputs}
    if isinstance(system, System):
        twice |= {name: f"a batch of {type(system).__name__}" for name in in_batches(system) if name in columns}
    if twice:
        listed = ", ".join(f"{name} (a column of the table, and in {where})" for name, where in twice.items())
        raise ValueError(f"sweep: passed twice: {listed}. Remove one of them.")
    signals = inputs if callable(inputs) else since(first_of(ts), _signals(inputs, system, columns, ts), dtype)
    if isinstance(system, System):
        refuse_coarse_times(system, ts, dtype, signals)
    tree = (system, state, signals, columns)
    leaves, structure = jax.tree.flatten(tree)
    places = jax.tree.unflatten(structure, range(len(leaves)))
    batches = _batches(places, [np.ndim(x) for x in leaves])
    members, shared = eqx.partition(tree, jax.tree.map(lambda i: i in batches, places))
    lengths = {name: leaves[i].shape[0] for i, name in batches.items()}
    if table is not None and not columns:
        lengths["table"] = len(table)
    if not jax.tree.leaves(members):
        if table is None:
            advice = (
                "no argument is a batch. Pass a `table`, or add a leading axis of members to a parameter, state.q, "
            )
            advice += "state.u or an input. For one trajectory, call jaxkane.simulate"
        else:
            advice = f"all columns of `table` ({', '.join(table.columns)}) are text. Text only labels a member, so all "
            advice += "members would be equal. Add a column of numbers; numpy.asarray(column, float) converts text"
        raise ValueError(f"sweep: {advice}.")
    n = _common_length(lengths, "sweep: the batches")
    origin, _ = clock_of(ts, dtype)
    _check(members, shared, origin, table)
    _check_description(members, shared, origin)
    return members, shared, n


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


def _system(system: System | Callable[[Row], System], row: Row) -> tuple[System, dict[str, Any]]:
    """The system of a row, and the parameters that were set by name."""
    read: set[str] = set()
    if not isinstance(system, System):
        system, read = row.given_to(system)
        if not isinstance(system, System):
            raise TypeError("sweep: the function `system` must return a System for each row.")
    parameters = row.of((name for name, _, _ in parameters_in(system)), but=read)
    return with_parameters(system, parameters), parameters


def _start(system: System, state: State | Callable[[System, Row], State], row: Row, t: Component) -> State:
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
    parts: list[Any] = []
    for values, columns, names in zip((state.q, state.u, state.x), (q, u, x), groups, strict=True):
        for name, value in columns.items():
            values = values.at[names.index(name)].set(value)  # pyright: ignore[reportOptionalMemberAccess]
        parts.append(values)
    # The contact states belong to coordinates, speeds and parameters.
    contacts = None if q or u or parameters else state.contacts
    state = State(parts[0], parts[1], parts[2], contacts)
    if system.dependent_coordinates and (q or parameters):  # they depend on the others
        state = assemble(system, state.q, state.u, state.x, t=t)
    return state


def _check(members: PyTree, shared: PyTree, t: Component, table: Table | None) -> None:
    """Make one member with abstract values, and refuse data that do not match the system."""

    def trial(own: PyTree):
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
    columns = [] if table is None else [*table.columns]
    kinds = {column: [kind for kind, names in known.items() if column in names] for column in columns}
    applied = row.of(itertools.chain(*known.values())).keys()
    dependent = {*system.dependent_coordinates, *system.dependent_speeds}
    applied -= dependent
    unused = [column for column in row if column not in applied | dependent | row.read]
    problems = (
        (
            [f"{column!r} ({', '.join(kind)})" for column, kind in kinds.items() if len(kind) > 1],
            "is ambiguous: the system has more than one number of that name. Rename the column, and read it in `state` "
            "as a function of (system, row), or in `system` as a function of (row).",
        ),
        (
            [f"{column!r} ({kind[0]})" for column, kind in kinds.items() if kind and column not in row],
            "is text, but the system has a number of that name. Convert numbers that were read as text by "
            "numpy.asarray(column, float), or rename a column of labels.",
        ),
        (
            sorted(applied & set(system.inputs)) if callable(signals) else [],
            "is a column of the table and is also returned by `inputs`. Remove one.",
        ),
        (sorted(dependent & set(row) - row.read), "is computed from the others. Remove this column."),
        (
            unused,
            "has no effect: the system has no parameter, independent coordinate, independent speed, state or input of "
            "that name. Pass `state` as a function of (system, row), or `system` as a function of (row), which reads "
            f"row[{unused[0]!r}]."
            if unused
            else "",
        ),
    )
    for wrong, message in problems:
        if wrong:
            raise ValueError(f"sweep: {name}: {', '.join(wrong)} {message}")


def _check_description(members: PyTree, shared: PyTree, t: Component) -> None:
    # Refuse a contradictory system. The first member is checked, and also the last one, because checks of contacts
    # depend on numbers. An impossible body makes only its member invalid.
    if any(x.shape[0] == 0 for x in jax.tree.leaves(members)):
        return
    for i in (0, -1):
        own = jax.tree.map(lambda x, i=i: x[i], members)
        numbers = [x for x in jax.tree.leaves(own) if is_concrete(x) and eqx.is_inexact_array_like(x)]
        if i == -1 and not all(np.all(np.isfinite(x)) for x in numbers):
            return
        system, state, _, columns = eqx.combine(own, shared)
        system, _ = _system(system, Row(columns))
        q = as_state(system, state).q if isinstance(state, State) else None
        if q is not None and is_concrete(q) and not np.all(np.isfinite(q)):
            q = None
        if i == 0:
            check_system(system, t, q, bodies=False)
        check_contacts(system, t, q, may_penetrate=True)


def _signals(inputs: Inputs, system: System | Callable[[Row], System], columns: dict[str, Any], ts: Numbers) -> Any:
    """Signals as in `simulate`; samples may have a leading axis of members."""
    if not isinstance(system, System):  # a function of the row: only its names are needed
        row = {name: jnp.zeros(x.shape[1:]) for name, x in columns.items()}
        system = jax.eval_shape(lambda row: _system(system, Row(row))[0], row)
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
        if array.shape[1] > 1:
            # Check with ones: samples that are not finite make only their member invalid, and raise nothing.
            known[name] = eqx.tree_at(lambda x: x.values, Samples(ts, jnp.ones_like(array)), array)
        else:
            known[name] = array[:, 0]
    return known | samples


def _batches(places: PyTree[int], dims: Sequence[int]) -> dict[int, str]:
    """The names of the leaves that have a leading axis of members, by index.

    `places`: system, state, signals and columns, with indices as leaves. `dims`: the numbers of axes of the leaves.
    """
    system, state, signals, columns = places
    candidates: list[tuple[str, Any, int]] = []  # name, leaf, axes of one member
    if isinstance(system, System):
        candidates += [(name, leaf, len(info.shape)) for name, leaf, info in parameters_in(system)]
    if isinstance(state, State):
        candidates += [(f"state.{name}", leaf, 1) for name, leaf in vars(state).items()]
    for name, signal in signals.items() if isinstance(signals, dict) else ():
        if isinstance(signal, Samples):
            candidates += [(name, signal.values, 1), (f"times of {name}", signal.ts, 1)]
        else:
            candidates.append((name, signal, 0))
    batches = {leaf: name for name, leaf, ndim in candidates if isinstance(leaf, int) and dims[leaf] == ndim + 1}
    return {leaf: name for name, leaf in columns.items()} | batches
