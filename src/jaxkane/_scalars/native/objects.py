"""Compiled code on disk, beside JAX's own. Knows folders and files; knows neither LLVM nor programs.

LLVM ends the process at an object file that is not one, so every file opens with a seal: a checksum of its name, which
stands for the text, the processor and the LLVM, and of the code.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax

_MARK = b"jaxkane compiled code 1\n"


def cache_folder() -> Path | None:
    """Beside JAX's persistent compilation cache, where that is on and is a folder of this machine."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir if config.jax_enable_compilation_cache else None
    return Path(folder) / "jaxkane" if folder and "://" not in folder else None


class Objects(NamedTuple):
    """A folder of compiled code."""

    folder: Path

    def read(self, name: str) -> bytes | None:
        path = self.folder / f"{name}.o"
        try:
            whole = path.read_bytes()
        except OSError:
            return None
        length = len(_seal(name, b""))
        seal, code = whole[:length], whole[length:]
        if seal == _seal(name, code):
            return code
        warnings.warn(f"The compiled code in {path} is damaged: it is thrown away and made again.", stacklevel=2)
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def write(self, name: str, code: bytes) -> None:
        try:
            write_whole(self.folder / f"{name}.o", _seal(name, code) + code)
        except OSError as error:
            text = f"Compiled code could not be kept in {self.folder}: {error.strerror or error}."
            warnings.warn(text, stacklevel=2)


def _seal(name: str, code: bytes) -> bytes:
    return _MARK + hashlib.sha256(name.encode() + b"\n" + code).hexdigest().encode() + b"\n"


def write_whole(path: Path, content: bytes) -> None:
    """A file that is either there as a whole or not at all, whoever else writes it and whenever the power goes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=".scratch-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(scratch)
        raise
