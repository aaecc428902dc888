"""How a member is made: what it has of its own, what all share. Knows systems, states and signals by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import not_there
from .._description.parameters import in_batches, parameters_in, with_parameters
from .._description.system import State, System
from .._method.assembly import assemble
from .._method.checks import check_system, is_concrete
from .._scalars.types import Inputs
from .._simulation.settings import as_state, checked_state
from .._simulation.signals import Samples, as_signals
from ._table import Table

Tree = Any


class Row(dict):
    """One member's numbers by name, for the functions that a user gives; it records which names were read."""

    def __init__(self, values: dict[str, Any]):
        super().__init__(values)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        if name not in self:
            raise not_there(name, self, "the columns of the sweep's table")
        self.read.add(name)
        return super().__getitem__(name)


def members_of(system: Any, state: Any, inputs: Inputs, table: Table | None, ts: Any) -> tuple[Tree, Tree, int]:
    """What differs from member to member (b, ...), what is shared, and how many members there are.

    **Raises:** `ValueError` when nothing is a batch, when batches differ in length, or for a column that nothing reads.
    """
    columns = {name: np.asarray(x, dtype=ts.dtype) for name, x in table.numbers.items()} if table is not None else {}
    _refuse_twice(columns, system, inputs)
    signals = inputs if callable(inputs) else _signals(inputs, system, columns, ts)
    tree = (system, state, signals, columns)
    is_member = _batches(tree)
    members, shared = eqx.partition(tree, jax.tree.map(lambda x: id(x) in is_member, tree))
    lengths = {is_member[id(x)]: x.shape[0] for x in jax.tree.leaves(members)}
    if table is not None and not columns:
        lengths["table"] = len(table)
    if not jax.tree.leaves(members):
        if table is not None:
            raise ValueError(
                f"sweep: the columns of `table` ({', '.join(table.columns)}) are text, which labels a member and "
                "changes nothing: all members would be the same. Give a column of numbers; numbers that were read as "
                "text are converted by numpy.asarray(column, float)."
            )
        raise ValueError(
            "sweep: nothing here is a batch. Give a `table`, or a parameter, state.q, state.u or an input a leading "
            "axis; for one motion call jaxkane.simulate."
        )
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"sweep: the batches differ in length: {listed}.")
    _check(members, shared, ts[0])
    _check_description(members, shared, ts[0])
    return members, shared, next(iter(lengths.values()))


def system_and_signals(own: Tree, shared: Tree) -> tuple[System, Any]:
    """System and signals of one member."""
    system, _, signals, columns = eqx.combine(own, shared)
    system, _ = _system(system, Row(columns))
    if not callable(signals):
        signals = {**signals, **{name: columns[name] for name in system.inputs if name in columns}}
    return system, signals


def start_of(own: Tree, shared: Tree, t: Any) -> State:
    """The first state of one member, at the time t."""
    system, state, _, columns = eqx.combine(own, shared)
    return _start(system, state, Row(columns), t)


def _system(system: Any, row: Row) -> tuple[System, dict[str, Any]]:
    """The system of a row, and the parameters that were set by name."""
    if not isinstance(system, System):
        system = system(row)
    given = {name: dict.__getitem__(row, name) for name, _, _ in parameters_in(system) if name in row}
    return with_parameters(system, given), given


def _start(system: Any, state: Any, row: Row, t: Any) -> State:
    system, parameters = _system(system, row)
    state = as_state(system, state if isinstance(state, State) else state(system, row))
    groups = (system.coordinates, system.speeds, system.states)
    q, u, x = ({n: dict.__getitem__(row, n) for n in names if n in row} for names in groups)
    parts = zip((state.q, state.u, state.x), (q, u, x), groups, strict=True)
    state = State(*(_set(values, given, names) for values, given, names in parts))
    if system.dependent_coordinates and (q or parameters):  # they follow from the others
        state = assemble(system, state.q, state.u, state.x, t=t)
    return state


def _set(values: Any, given: dict[str, Any], names: tuple[str, ...]) -> Any:
    for name, value in given.items():
        values = values.at[names.index(name)].set(value)
    return values


def _check(members: Tree, shared: Tree, t: Any) -> None:
    """Make one member in the abstract, and refuse what does not fit."""

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
    parameters = (name for name, _, _ in parameters_in(system))
    applied = set(row) & {*parameters, *system.coordinates, *system.speeds, *system.inputs}
    applied |= set(row) & {*system.states}
    applied -= set(system.dependent_coordinates)
    name = type(system).__name__
    if callable(signals) and applied & set(system.inputs):
        listed = ", ".join(sorted(applied & set(system.inputs)))
        raise ValueError(f"sweep: {listed} is a column of the table, and `inputs` is a function that gives it too.")
    follow = {*system.dependent_coordinates, *system.dependent_speeds} & set(row) - row.read
    if follow:
        raise ValueError(f"sweep: {name}: {', '.join(sorted(follow))} follows from the others; it cannot be a column.")
    unused = [column for column in row if column not in applied | row.read]
    if unused:
        raise ValueError(
            f"sweep: the table's {', '.join(unused)} changes nothing: {name} has no parameter, independent coordinate, "
            "independent speed, state or input of that name. Give `state` as a function of (system, row), or `system` "
            f"as a function of (row), which reads row[{unused[0]!r}]."
        )


def _check_description(members: Tree, shared: Tree, t: Any) -> None:
    """Refuse a description that contradicts itself, by the first member; a bad body is its member's own."""
    if any(x.shape[0] == 0 for x in jax.tree.leaves(members)):
        return
    system, state, _, columns = eqx.combine(jax.tree.map(lambda x: x[0], members), shared)
    system, _ = _system(system, Row(columns))
    q = as_state(system, state).q if isinstance(state, State) else None
    if q is not None and is_concrete(q) and not np.all(np.isfinite(q)):
        q = None
    check_system(system, t, q, bodies=False)


def _signals(inputs: Inputs, system: Any, columns: dict[str, Any], ts: Any) -> Any:
    """Signals as `simulate` takes them; samples may have a leading axis of members."""
    if not isinstance(system, System):  # a function of the row: only to know the names
        system = jax.eval_shape(lambda row: system(Row(row)), {k: jnp.zeros(x.shape[1:]) for k, x in columns.items()})
    assert not callable(inputs)
    single, batches = {}, {}
    for name, value in (inputs or {}).items():
        array = None if callable(value) else jnp.asarray(value, dtype=ts.dtype)
        if array is None or array.ndim < 2:
            single[name] = value
        elif array.ndim == 2 and array.shape[1] in (1, ts.shape[0]):
            batches[name] = array
        else:
            raise ValueError(
                f"The input {name!r} of a sweep is a number, samples (n_t,), or a batch (b, n_t) or (b, 1) with n_t = "
                f"{ts.shape[0]}; got the shape {array.shape}."
            )
    known = as_signals(single | dict.fromkeys(batches, 0.0), system.inputs, ts, type(system).__name__)
    for name, array in batches.items():
        known[name] = array[:, 0] if array.shape[1] == 1 else Samples(ts, array)
    return known


def _refuse_twice(columns: dict[str, Any], system: Any, inputs: Inputs) -> None:
    """A column takes the place of the one value that all members have, but not of values of their own."""
    twice = {name: "`inputs`" for name in columns if isinstance(inputs, Mapping) and name in inputs}
    if isinstance(system, System):
        for name in in_batches(system):
            if name in columns:
                twice[name] = f"a batch of {type(system).__name__}"
    if twice:
        listed = ", ".join(f"{name} (a column of the table, and in {where})" for name, where in twice.items())
        raise ValueError(f"sweep: given twice: {listed}. Leave one of them out.")


def _batches(tree: Tree) -> dict[int, str]:
    """Name of every leaf that has a leading axis of members, by its identity."""
    system, state, signals, columns = tree
    found = {id(column): name for name, column in columns.items()}
    if isinstance(system, System):
        for name, value, info in parameters_in(system):
            if np.ndim(value) == len(info.shape) + 1:
                found[id(value)] = name
    if isinstance(state, State):
        for name, value in (("q", state.q), ("u", state.u), ("x", state.x)):
            if value is not None and np.ndim(value) == 2:
                found[id(value)] = f"state.{name}"
    if isinstance(signals, dict):
        for name, signal in signals.items():
            values = signal.values if isinstance(signal, Samples) else signal
            if isinstance(values, jax.Array) and values.ndim == (2 if isinstance(signal, Samples) else 1):
                found[id(values)] = name
    return found
