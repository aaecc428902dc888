"""Finished chunks as files, under a manifest. Knows arrays and files; knows nothing of what they mean."""

from __future__ import annotations

import json
import os
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

MANIFEST = "sweep.json"


class Folder:
    """The chunks of one sweep: `chunk-00000000.npz`, named by the first member of each.

    A file appears whole or not at all: it is written under another name, brought to the disk, and renamed.

    **Raises:** `ValueError` where the folder holds another sweep, or something else.
    """

    def __init__(self, path: str | os.PathLike[str], manifest: Mapping[str, Any]):
        self.path = Path(path).expanduser()
        self.path.mkdir(parents=True, exist_ok=True)
        described = self.path / MANIFEST
        if described.exists():
            _compare(self.path, json.loads(described.read_text()), manifest)
        elif any(self.path.iterdir()):
            raise ValueError(f"{self.path} is not empty, and holds no {MANIFEST}: a sweep wants a folder of its own.")
        else:
            self._write(described, lambda file: file.write(json.dumps(manifest, indent=1).encode()))

    def file(self, start: int) -> Path:
        return self.path / f"chunk-{start:08d}.npz"

    def write(self, start: int, part: Any) -> None:
        """Keep the chunk that begins with a member."""
        self._write(self.file(start), lambda file: np.savez(file, **_named(part)))

    def read(self, start: int, like: Any) -> Any:
        """The chunk that begins with a member, in the structure of `like`; None where there is none that is whole."""
        if not self.file(start).exists():
            return None
        try:
            with np.load(self.file(start)) as found:
                return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in _named(like)])
        except (zipfile.BadZipFile, KeyError, ValueError, EOFError, OSError) as error:
            warnings.warn(f"{self.file(start)} cannot be read ({error}); it is computed again.", stacklevel=4)
            return None

    def tidy(self) -> None:
        """Take away what writers that were killed left behind."""
        for left in self.path.glob("*.tmp"):
            left.unlink(missing_ok=True)

    def _write(self, path: Path, put: Callable[[Any], Any]) -> None:
        scratch = path.with_name(f"{path.name}.{os.getpid()}.tmp")
        with open(scratch, "wb") as file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
        if os.name == "posix":  # the name, too, must be on the disk
            handle = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def _named(part: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(part)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _compare(path: Path, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    differences = []
    for group in dict.fromkeys((*there, *here)):
        old, new = there.get(group, {}), here.get(group, {})
        if not isinstance(old, dict) or not isinstance(new, dict):
            old, new = {"": old}, {"": new}
        for key in dict.fromkeys((*old, *new)):
            a, b = (x.get(key) for x in (old, new))
            if a != b:
                a, b = ("nothing" if x in (None, {}) else x for x in (a, b))
                differences.append(f"{group} {key}".strip() + f" ({a} there, {b} here)")
    if differences:
        raise ValueError(
            f"{path} holds another sweep. It differs in {'; '.join(differences)}. Choose another folder, or delete "
            "this one."
        )
