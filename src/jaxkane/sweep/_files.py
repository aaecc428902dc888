"""Finished chunks as files, with a manifest of the data from which they were computed. Handles arrays and files
only."""

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
from jaxtyping import PyTree

from .._common.files import SCRATCH, atomic_write, differences, remove_abandoned
from .._integrate.settings import Settings
from .._scalarjit.components import Numbers
from .._scalarjit.digest import digest
from .._scalarjit.native import is_on
from .._system.system import State, System
from ._chunks import versions
from ._members import Table


def manifest_of(
    program: str,
    system: Any,
    state: Any,
    inputs: Any,
    table: Table | None,
    ts: Numbers,
    settings: Settings,
    reduce: Any,
    layout: Any,
) -> dict[str, Any]:
    """All data that determine the results, by name. `program` is the digest of the compiled program."""
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
        # native kernels and XLA round differently
        "kernels": "native" if is_on() and jax.default_backend() == "cpu" else "XLA",
        "version": versions(),
    }


def _entry(value: Any) -> Any:
    """Numbers unchanged, functions by name (`program` covers their code), everything else as a digest."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        array = np.asarray(value)
        return array.item() if array.ndim == 0 else f"{array.dtype}{list(array.shape)} {digest(array)}"
    if inspect.isroutine(value):
        return value.__qualname__
    return f"{getattr(value, '__qualname__', type(value).__qualname__)} {digest(value)}"


MANIFEST = "sweep.json"
_MARK = "chunk of"
_RESUME = "Finished chunks are kept: call sweep again with this folder to resume."


class Folder:
    """The chunks of one sweep: `chunk-00000000.npz`, named by the first member of each.

    **Raises:** `ValueError` if the folder contains another sweep, an unreadable manifest, or other files; `OSError` if
    it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], manifest: Mapping[str, Any]):
        self.path = Path(path).expanduser()
        self.sweep = digest(json.dumps(manifest, sort_keys=True))  # the order of columns does not matter
        self.damaged: list[str] = []
        path = self.path / MANIFEST
        if self.path.is_dir():
            remove_abandoned(self.path)
        if not path.exists():
            # Chunks of this sweep are used, and damaged ones are computed again.
            files = [file for file in self.path.glob("*") if file.name != MANIFEST and file.suffix != SCRATCH]
            owners = {_owner(file) for file in files}
            if files and (self.sweep not in owners or owners - {self.sweep, None}):
                raise ValueError(
                    f"{self.path} has no {MANIFEST}, and its {len(files)} files are not the chunks of this sweep (e.g. "
                    f"{files[0].name}). Choose an empty folder, or one that does not exist."
                )
            text = json.dumps(manifest, indent=1).encode()
            if atomic_write(path, lambda file: file.write(text), replace=False):
                return
        try:
            stored = json.loads(path.read_bytes())
        except (ValueError, IsADirectoryError) as error:  # of the JSON parser, or of the decoder
            stored = error
        if not isinstance(stored, dict) or not {"system", "times", "layout"} <= stored.keys():
            raise ValueError(
                f"{path} is damaged, or not the manifest of a sweep: {stored!r:.200}. Choose another folder, or delete "
                "this file: chunks that belong to this sweep are then used."
            )
        if different := differences(stored, manifest):
            raise ValueError(
                f"{path} belongs to another sweep. It differs in {different}. Choose another folder, or delete this "
                "one. (The program contains the system, the inputs and the functions, with the numbers that they use.)"
            )

    def file(self, start: int) -> Path:
        return self.path / f"chunk-{start:08d}.npz"

    def write(self, start: int, result: Any) -> None:
        """Save the chunk whose first member is `start`."""

        def save(file: Any) -> None:
            # The mark detects a renamed file, and a file from another folder.
            np.savez(file, **{_MARK: f"{self.sweep} from {start}"}, **_by_path(result))

        try:
            atomic_write(self.file(start), save, remedy=_RESUME)
        except FileNotFoundError:
            # Another process has finished the whole sweep, including this chunk, and removed the temporary files.
            if not self.file(start).exists():
                raise

    def read(self, start: int, like: PyTree, size: int) -> PyTree:
        """Read the chunk of `size` members whose first member is `start`.

        **Arguments:**

        - `start`: the index of the first member.
        - `like`: shapes and types of one member's result.
        - `size`: the number of members.

        **Returns:** the chunk, or None if the file does not exist or is damaged. `damaged` lists the damaged files.
        """
        path = self.file(start)
        if not path.exists():
            return None
        try:
            with zipfile.ZipFile(path) as archive, np.load(path, allow_pickle=False) as arrays:
                leaves = {name: arrays[name] for name in _by_path(like)}
                is_own = archive.testzip() is None and str(arrays[_MARK]) == f"{self.sweep} from {start}"
            types = {name: ((size, *leaf.shape), leaf.dtype) for name, leaf in _by_path(like).items()}
            if not is_own or types != {name: (x.shape, x.dtype) for name, x in leaves.items()}:
                raise ValueError("the file was renamed, belongs to another sweep, or is damaged")
        except (MemoryError, PermissionError):
            raise
        except Exception as error:  # decoders raise various exceptions for damaged files
            self.damaged.append(f"{path.name} ({type(error).__name__}: {error})")
            return None
        return jax.tree.unflatten(jax.tree.structure(like), leaves.values())

    def tidy(self) -> None:
        """Remove the temporary files of interrupted writers. Call when every chunk exists."""
        for scratch in self.path.glob(f"*{SCRATCH}"):
            scratch.unlink(missing_ok=True)


def _owner(path: Path) -> str | None:
    """The digest of the sweep of a chunk; None if the file cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return str(arrays[_MARK]).partition(" ")[0]
    except (MemoryError, PermissionError):
        raise
    except Exception:  # decoders raise various exceptions for damaged files
        return None


def _by_path(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
