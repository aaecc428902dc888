"""Files are whole, an old one outlives whatever happens to its successor, and an error says what to do."""

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import jaxkane as jk
from jaxkane._common import files
from jaxkane._common.files import atomic_write, remove_broken_programs

KILLED = """
import importlib.util, os, signal, sys
from pathlib import Path

spec = importlib.util.spec_from_file_location("files", sys.argv[1])
files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(files)
os.replace = lambda *paths: os.kill(os.getpid(), signal.SIGKILL)
files.atomic_write(Path(sys.argv[2]), lambda file: file.write(b"new"))
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    return path


@pytest.mark.parametrize("where", ["write", "fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(old, monkeypatch, where):
    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if where != "write":
        monkeypatch.setattr(os, where, full)
    put = full if where == "write" else lambda file: file.write(b"new")
    with pytest.raises(
        OSError, match=r"report.html could not be written: No space left on device\. Free space .*The earlier"
    ) as seen:
        atomic_write(old, put)
    assert seen.value.errno == errno.ENOSPC
    assert old.read_bytes() == b"old"
    assert names(old.parent) == ["report.html"]


def test_a_full_disk_is_reported_when_zipfile_raises_another_error(old):
    """`zipfile` raises a ValueError of its own when it closes a file that the disk cut short."""

    def put(file):
        try:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            raise ValueError("Can't close the ZIP file while there is an open writing handle on it.")

    with pytest.raises(OSError, match="No space left on device"):
        atomic_write(old, put)
    try:
        raise OSError(errno.EIO, "elsewhere")
    except OSError:  # it is being handled, and not the cause of what follows
        with pytest.raises(ZeroDivisionError):
            atomic_write(old, lambda file: 1 / 0)


def test_invalid_file_paths_raise_an_explained_error(tmp_path, old, monkeypatch):
    (tmp_path / "folder").mkdir()
    for path, kind, reason in (
        (tmp_path / "folder", IsADirectoryError, r"folder could not be written: Is a directory. Remove that folder"),
        (
            old / "x.html",
            OSError,
            r"report.html.x.html could not be written: (Not a directory|File exists). A part of the",
        ),
    ):
        with pytest.raises(kind, match=reason):
            atomic_write(path, lambda file: file.write(b"new"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(
        PermissionError, match=r"report.html could not be written: the file is read-only. Choose a path"
    ):
        atomic_write(old, lambda file: file.write(b"new"))
    assert names(tmp_path) == ["folder", "report.html"]
    assert old.read_bytes() == b"old"


def test_missing_folders_are_created_and_links_and_file_modes_preserved(tmp_path, old):
    atomic_write(tmp_path / "a" / "b" / "x.c", lambda file: file.write(b"new"))
    assert names(tmp_path / "a" / "b") == ["x.c"]
    if os.name == "posix":
        old.chmod(0o640)
        link = tmp_path / "latest.html"
        link.symlink_to(old)
        atomic_write(link, lambda file: file.write(b"new"))
        assert link.is_symlink()
        assert old.read_bytes() == b"new"
        assert old.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_temporary_files_of_a_killed_writer_are_removed_by_the_next_write(old):
    process = subprocess.run([sys.executable, "-c", KILLED, files.__file__, old])
    assert process.returncode == -signal.SIGKILL
    assert old.read_bytes() == b"old"
    assert len(names(old.parent)) == 2
    alive = old.parent / f"report.html.{files._HOST}-{os.getpid()}-0123abcd.tmp"
    alive.write_bytes(b"")
    other = old.parent / "report.html.tmp"  # a file of the user's
    other.write_bytes(b"")
    atomic_write(old, lambda file: file.write(b"new"))
    assert names(old.parent) == sorted(["report.html", alive.name, other.name])
    assert old.read_bytes() == b"new"


class Weight(jk.System):
    """A particle that falls."""

    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="weight")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, 9.81 * motion.N.x)


@pytest.mark.slow
def test_animations_and_exports_replace_files_atomically(tmp_path, monkeypatch):
    ride = jk.simulate(Weight(), jk.State([0.0], [0.0]), np.linspace(0.0, 0.5, 6))
    animation = jk.animate(Weight(), ride)
    writers = {
        "ride.html": lambda path: animation.save(path),
        "ride.gif": lambda path: animation.save(path, size=(40, 30), fps=5),
        "weight.c": lambda path: jk.export.c(Weight(), path, ("rates",)),
    }
    for name in writers:
        (tmp_path / name).write_bytes(b"old")

    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for is_full in (True, False):
        with monkeypatch.context() as patch:
            if is_full:
                patch.setattr(os, "fsync", full)
            for name, write in writers.items():
                if is_full:
                    with pytest.raises(OSError, match=r"could not be written: No space left on device\. Free space"):
                        write(tmp_path / name)
                    assert (tmp_path / name).read_bytes() == b"old"
                else:
                    write(tmp_path / name)
                    assert len((tmp_path / name).read_bytes()) > 3
        assert names(tmp_path) == sorted([*writers, *([] if is_full else ["weight.h", "weight_test.c"])])


def test_configure_removes_empty_programs(tmp_path):
    """JAX would warn of them, and compile anew, in every process."""
    (tmp_path / "jit_f-0123-cache").write_bytes(b"")
    (tmp_path / "jit_g-0123-cache").write_bytes(b"program")
    (tmp_path / "notes.txt").write_bytes(b"")
    remove_broken_programs(tmp_path)
    assert names(tmp_path) == ["jit_g-0123-cache", "notes.txt"]
    remove_broken_programs(tmp_path / "missing")
