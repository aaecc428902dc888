"""What a folder's sweep is, in words, so that two sweeps can be compared. Knows systems and their parameters."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

import jax
import numpy as np

from .._common.digest import digest
from .._description.system import State, System
from .._scalars.native import is_on
from .._simulation.settings import Settings
from ._fingerprint import versions
from ._table import Table


def manifest_of(
    program: str,
    system: Any,
    state: Any,
    inputs: Any,
    table: Table | None,
    ts: Any,
    settings: Settings,
    reduce: Any,
    layout: Any,
) -> dict[str, Any]:
    """All that the results follow from, by name; `program` is the digest of what is computed from it."""
    kind: dict[str, Any]
    if isinstance(system, System):
        kind = {"class": type(system).__qualname__}
        parameters = {field.name: _shown(getattr(system, field.name)) for field in dataclasses.fields(system)}
    else:
        kind, parameters = {"function": _shown(system)}, {}
    if isinstance(state, State):
        places = {part: _shown(x) for part, x in vars(state).items() if x is not None}
    else:
        places = {"function": _shown(state)}
    signals = {name: _shown(x) for name, x in (inputs or {}).items()} if not callable(inputs) else _shown(inputs)
    return {
        "system": kind,
        "parameter": parameters,
        "state": places,
        "input": signals,
        "table": {name: _shown(column) for name, column in table.columns.items()} if table else {},
        "shape": dict(zip(table.dims, table.shape, strict=True)) if table else {},
        "times": _shown(ts),
        "option": {f.name: _shown(getattr(settings, f.name)) for f in dataclasses.fields(settings)},
        "reduce": _shown(reduce),
        "program": program,
        "layout": dict(layout),
        "device": jax.default_backend(),
        "kernels": "native" if is_on() and jax.default_backend() == "cpu" else "XLA",  # they round differently
        "version": versions(),
    }


def _shown(value: Any) -> Any:
    """Numbers as they are, functions by name (what they compute is in the program), all else by a digest."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        array = np.asarray(value)
        if array.ndim == 0:
            return array.item()
        return f"{array.dtype}{list(array.shape)} {digest(array)}"
    if inspect.isroutine(value):
        return value.__qualname__
    return f"{getattr(value, '__qualname__', type(value).__qualname__)} {digest(value)}"
