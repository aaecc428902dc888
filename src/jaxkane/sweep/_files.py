"""Finished chunks as files, under a manifest of what they were computed from. Knows arrays and files."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._common.files import SCRATCH, atomic_write, differences
from .._integrate.settings import Settings
from .._scalarjit.backends.native import is_on
from .._scalarjit.digest import digest
from .._system.system import State, System
from ._chunks import versions
from ._members import Table


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
    if isinstance(system, System):
        kind: dict[str, Any] = {"class": type(system).__qualname__}
        parameters = {field.name: _entry(getattr(system, field.name)) for field in dataclasses.fields(system)}
    else:
        kind, parameters = {"function": _entry(system)}, {}
    if isinstance(state, State):
        initial = {name: _entry(x) for name, x in vars(state).items() if x is not None}
    else:
        initial = {"function": _entry(state)}
    return {
        "system": kind,
        "parameter": parameters,
        "state": initial,
        "input": _entry(inputs) if callable(inputs) else {name: _entry(x) for name, x in (inputs or {}).items()},
        "table": {name: _entry(column) for name, column in table.columns.items()} if table else {},
        "shape": dict(zip(table.dims, table.shape, strict=True)) if table else {},
        "times": _entry(ts),
        "option": {f.name: _entry(getattr(settings, f.name)) for f in dataclasses.fields(settings)},
        "reduce": _entry(reduce),
        "program": program,
        "layout": dict(layout),
        "device": jax.default_backend(),
        "kernels": "native" if is_on() and jax.default_backend() == "cpu" else "XLA",  # they round differently
        "version": versions(),
    }


def _entry(value: Any) -> Any:
    """Numbers as they are, functions by name (what they compute is in the program), all else by a digest."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        array = np.asarray(value)
        return array.item() if array.ndim == 0 else f"{array.dtype}{list(array.shape)} {digest(array)}"
    if inspect.isroutine(value):
        return value.__qualname__
    return f"{getattr(value, '__qualname__', type(value).__qualname__)} {digest(value)}"


MANIFEST = "sweep.json"


class Folder:
    """The chunks of one sweep: `chunk-00000000.npz`, named by the first member of each.

    **Raises:** `ValueError` where the folder holds another sweep, a manifest that cannot be read, or something else.
    """

    def __init__(self, path: str | os.PathLike[str], manifest: Mapping[str, Any]):
        self.path = Path(path).expanduser()
        self.sweep = digest(json.dumps(manifest, sort_keys=True))  # columns have no order
        self.damaged: list[str] = []
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file: `folder` is the name of a folder.")
        self.path.mkdir(parents=True, exist_ok=True)
        path = self.path / MANIFEST
        if not path.exists():
            # What a writer that was killed left behind holds nothing.
            if any(not file.name.endswith(SCRATCH) for file in self.path.iterdir() if file.name != MANIFEST):
                raise ValueError(
                    f"{self.path} is not empty, and holds no {MANIFEST}: a sweep wants a folder of its own."
                )
            text = json.dumps(manifest, indent=1).encode()
            if atomic_write(path, lambda file: file.write(text), replace=False):
                return
        _refuse_other(path, manifest)

    def file(self, start: int) -> Path:
        return self.path / f"chunk-{start:08d}.npz"

    def mark(self, start: int) -> dict[str, str]:
        """By which a chunk is known whose file was renamed, or came from another folder."""
        return {"chunk of": f"{self.sweep} from {start}"}

    def write(self, start: int, result: Any) -> None:
        """Keep the chunk that begins with a member."""
        try:
            atomic_write(self.file(start), lambda file: np.savez(file, **self.mark(start), **_by_path(result)))
        except FileNotFoundError:
            # Another process was done with the whole sweep, this chunk too, and has tidied up.
            if not self.file(start).exists():
                raise

    def read(self, start: int, like: Any, size: int) -> Any:
        """The chunk of `size` members that begins with a member, each in the structure of `like`; None where there is
        none that is whole, which `damaged` lists."""
        path = self.file(start)
        if not path.exists():
            return None
        try:
            with zipfile.ZipFile(path) as archive:
                damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{damaged} is damaged")
            with np.load(path, allow_pickle=False) as arrays:
                for name, mark in self.mark(start).items():
                    if name not in arrays or str(arrays[name]) != mark:
                        raise ValueError("it belongs elsewhere: renamed, or of another sweep")
                leaves = [_checked(name, arrays[name], leaf, size) for name, leaf in _by_path(like).items()]
        except (MemoryError, PermissionError):
            raise
        except Exception as error:  # whatever a decoder says of bytes that are not its own
            self.damaged.append(f"{path.name} ({type(error).__name__}: {error})")
            return None
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def tidy(self) -> None:
        """Take away what writers that were killed left behind, once every chunk is there."""
        for scratch in self.path.glob(f"*{SCRATCH}"):
            scratch.unlink(missing_ok=True)


def _by_path(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _checked(name: str, array: np.ndarray, like: Any, size: int) -> np.ndarray:
    if array.shape != (size, *like.shape) or array.dtype != like.dtype:
        raise ValueError(f"{name} is {array.dtype}{list(array.shape)}, not {like.dtype}{[size, *like.shape]}")
    return array


def _refuse_other(path: Path, manifest: Mapping[str, Any]) -> None:
    """**Raises:** `ValueError` where the file holds another manifest, or none."""
    try:
        stored = json.loads(path.read_bytes())
    except ValueError as error:  # of JSON, or of its encoding
        raise ValueError(
            f"{path} cannot be read ({error}): it is damaged, or no manifest of a sweep, so it is unknown whose chunks "
            "stand beside it. Choose another folder, or delete this one."
        ) from None
    if not isinstance(stored, dict) or not {"system", "times", "layout"} <= stored.keys():
        raise ValueError(f"{path} is no manifest of a sweep. Choose another folder: a sweep wants one of its own.")
    if "program" not in stored:
        raise ValueError(
            f"{path} holds a sweep of an earlier version of jaxkane, which kept no account of all that was computed: "
            "so it is unknown whether it is this one. Choose another folder, or delete this one."
        )
    different = differences(stored, manifest)
    if different:
        raise ValueError(
            f"{path} holds another sweep. It differs in {different}. Choose another folder, or delete this one. (The "
            "program is what the description, the inputs and the functions compute, with the numbers that they read.)"
        )
