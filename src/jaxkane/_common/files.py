"""Atomic writing of files, and differences between two manifests."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO


def differences(old_groups: Mapping[str, Any], new_groups: Mapping[str, Any]) -> str:
    """A text with the differences between two manifests: `option rtol (1e-08 there, 1e-06 here)`."""
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

_REMEDIES = {
    errno.EISDIR: "Remove that folder, or choose another path.",
    errno.ENOTDIR: "A part of the path is a file: choose another path.",
    errno.EEXIST: "A part of the path is a file: choose another path.",
    errno.EACCES: "Choose a path that you may write, or change the permissions.",
    errno.EROFS: "Choose a path that you may write.",
}


def atomic_write(
    path: str | os.PathLike[str], put: Callable[[BinaryIO], Any], *, replace: bool = True, remedy: str = ""
) -> bool:
    """Write a scratch file (`*.tmp`) in the folder of `path`, flush it to the disk, and rename it.

    A reader never gets a part of a file. If the disk is full or the process is killed, the old file is unchanged.
    Missing folders are made. Scratch files of killed processes are removed.

    **Arguments:**

    - `path`: path of the file.
    - `put`: a function that writes into the open file.
    - `replace`: whether to replace an existing file.
    - `remedy`: the last sentence of the error message; by default it states that the old file is unchanged.

    **Returns:** whether the file at `path` is the one written here. False if `replace` is False and a file existed.

    **Raises:** `OSError`, or its subclass for the `errno`, with the path, the cause and the remedy.
    """
    path = Path(os.path.realpath(path))  # writing to a symbolic link must not replace the link
    handled = sys.exception()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if replace and path.exists() and not os.access(path, os.W_OK):  # renaming would ignore this permission
            raise PermissionError(errno.EACCES, "the file is read-only")
        remove_abandoned(path.parent, path.name)
        return _write(path, put, replace)
    except Exception as error:
        cause = _os_error(error, handled)
        if cause is None:
            raise
        reason = cause.strerror or str(cause)
        first = _REMEDIES.get(cause.errno or 0, "Free space on the disk, or choose another path.")
        rest = remedy or ("The earlier file of that name is unchanged." if path.is_file() else "")
        raise OSError(cause.errno, f"{path} could not be written: {reason}. {first} {rest}".rstrip()) from error


def write_file(path: str | os.PathLike[str], content: bytes | str) -> None:
    """Write a file atomically, see `atomic_write`. Text is written in UTF-8."""
    encoded = content.encode() if isinstance(content, str) else content
    atomic_write(path, lambda file: file.write(encoded))


def _write(path: Path, put: Callable[[BinaryIO], Any], replace: bool) -> bool:
    scratch = path.with_name(f"{path.name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}{SCRATCH}")
    try:
        with open(scratch, "xb") as file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        if not replace and not _named_anew(scratch, path):
            return False
        if replace:
            if path.exists():
                shutil.copymode(path, scratch)
            os.replace(scratch, path)
        if os.name == "posix":  # the name must be on the disk, too
            handle = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        return True
    finally:
        scratch.unlink(missing_ok=True)


_HOST = re.sub(r"\W", "_", platform.node())


def remove_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove the scratch files of killed processes of this machine, for one file or for all files in a folder."""
    pattern = re.compile(
        rf"{'.+' if name is None else re.escape(name)}\.{_HOST}-(\d+)-[0-9a-f]{{8}}{re.escape(SCRATCH)}"
    )
    for entry in os.listdir(folder):
        match = pattern.fullmatch(entry)
        if match and not _is_running(int(match[1])):
            with contextlib.suppress(OSError):
                os.unlink(folder / entry)


def remove_broken_programs(folder: Path) -> None:
    """Remove empty files and the files of killed processes from JAX's folder of compiled programs.

    JAX does not replace existing files. An empty file (disk full, process killed) would cause a warning and a
    compilation in every later process.
    """
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            if entry.name.endswith("-cache") and entry.stat().st_size == 0:
                os.unlink(entry)
        remove_abandoned(folder)


def _is_running(process: int) -> bool:
    if os.name != "posix":  # on Windows, os.kill would end the process; Windows does not delete open files
        return process == os.getpid()
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def _os_error(error: BaseException | None, handled: BaseException | None) -> OSError | None:
    """The OSError that caused an exception. For example, `zipfile` raises its own exception if the disk is full.

    `handled`: an exception that was already handled before; it is not the cause.
    """
    while error is not None and error is not handled and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error if isinstance(error, OSError) and error is not handled else None


def _named_anew(scratch: Path, path: Path) -> bool:
    """Create `path` as a hard link to the scratch file unless it exists. If two processes do this, one succeeds."""
    try:
        os.link(scratch, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without hard links
        if path.exists():
            return False
        os.replace(scratch, path)
    return True
