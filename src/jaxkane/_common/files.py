"""Files that are written as a whole, and what two descriptions of files differ in."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO


def differences(old_groups: Mapping[str, Any], new_groups: Mapping[str, Any]) -> str:
    """In what two descriptions differ, in words: `option rtol (1e-08 there, 1e-06 here)`."""
    items = []
    for group in dict.fromkeys((*old_groups, *new_groups)):
        old, new = old_groups.get(group, {}), new_groups.get(group, {})
        if not isinstance(old, dict) or not isinstance(new, dict):
            old, new = {"": old}, {"": new}
        for key in dict.fromkeys((*old, *new)):
            a, b = (x.get(key) for x in (old, new))
            if a != b:
                a, b = ("nothing" if x in (None, {}) else x for x in (a, b))
                items.append(f"{group} {key}".strip() + f" ({a} there, {b} here)")
    return "; ".join(items)


SCRATCH = ".tmp"


def atomic_write(path: Path, put: Callable[[BinaryIO], Any], *, replace: bool = True) -> bool:
    """Write under a name of its own (`*.tmp`), bring that to the disk, rename it: no reader ever sees a part.

    **Arguments:** `put` writes into the open file. `replace`: with False a file that is there already stays.

    **Returns:** whether the file that is now there is this one.
    """
    scratch = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}{SCRATCH}")
    try:
        with open(scratch, "xb") as file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        if not replace and not _named_anew(scratch, path):
            return False
        if replace:
            os.replace(scratch, path)
        _name_to_disk(path.parent)
        return True
    finally:
        scratch.unlink(missing_ok=True)


def _named_anew(scratch: Path, path: Path) -> bool:
    """Give the file its name unless that is taken: of two processes one succeeds."""
    try:
        os.link(scratch, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without second names
        if path.exists():
            return False
        os.replace(scratch, path)
    return True


def _name_to_disk(folder: Path) -> None:
    if os.name == "posix":  # the name, too, must be on the disk
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
