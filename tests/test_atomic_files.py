"""Files are whole, an old one outlives whatever happens to its successor, and an error says what to do."""

import errno
import os
import platform
import re

import numpy as np
import pytest
from mechanisms import Sled, moved

import jaxkane as jk


@pytest.fixture(scope="module")
def animation():
    t = np.linspace(0.0, 0.5, 6)
    return jk.animate(Sled(), moved(Sled(), t, 4.905 * t[:, None] ** 2, 9.81 * t[:, None]))


def full(*args):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    return path


@pytest.mark.parametrize("where", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(animation, old, monkeypatch, where):
    monkeypatch.setattr(os, where, full)
    message = r"report.html could not be written: No space left on device\. Free space .*The earlier"
    with pytest.raises(OSError, match=message) as seen:
        animation.save(old)
    assert seen.value.errno == errno.ENOSPC
    assert old.read_bytes() == b"old"
    assert names(old.parent) == ["report.html"]


def test_invalid_file_paths_raise_an_explained_error(animation, tmp_path, old, monkeypatch):
    (tmp_path / "folder.html").mkdir()
    for path, kind, reason in (
        (tmp_path / "folder.html", IsADirectoryError, "folder.html could not be written: Is a directory. Remove"),
        (old / "x.html", OSError, r"x.html could not be written: (Not a directory|File exists). A part of the"),
    ):
        with pytest.raises(kind, match=reason):
            animation.save(path)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError, match=r"report.html could not be written: the file is read-only. Choose"):
        animation.save(old)
    assert names(tmp_path) == ["folder.html", "report.html"]
    assert old.read_bytes() == b"old"


def test_missing_folders_are_created_and_links_and_file_modes_preserved(animation, tmp_path, old):
    animation.save(tmp_path / "a" / "b" / "x.html")
    assert names(tmp_path / "a" / "b") == ["x.html"]
    if os.name == "posix":
        old.chmod(0o640)
        link = tmp_path / "latest.html"
        link.symlink_to(old)
        animation.save(link)
        assert link.is_symlink()
        assert old.read_text(encoding="utf-8") == animation.html()
        assert old.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(os.name != "posix", reason="asks whether a process is running")
def test_temporary_files_of_a_killed_writer_are_removed_by_the_next_write(animation, old):
    host = re.sub(r"\W", "_", platform.node())
    dead, alive = (old.parent / f"report.html.{host}-{pid}-0123abcd.tmp" for pid in (2**22 + 1, os.getpid()))
    other = old.parent / "report.html.tmp"  # a file of the user's
    for path in (dead, alive, other):
        path.write_bytes(b"")
    animation.save(old)
    assert names(old.parent) == sorted(["report.html", alive.name, other.name])


@pytest.mark.slow
def test_pictures_and_exports_replace_files_atomically(animation, tmp_path, monkeypatch):
    writers = {
        "ride.gif": lambda path: animation.save(path, size=(40, 30), fps=5),
        "weight.c": lambda path: jk.export.c(Sled(), path, ("rates",)),
    }
    for name, write in writers.items():
        (tmp_path / name).write_bytes(b"old")
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(OSError, match=r"could not be written: No space left on device\. Free space"):
                write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"old"
    assert names(tmp_path) == sorted(writers)
    for name, write in writers.items():
        write(tmp_path / name)
        assert len((tmp_path / name).read_bytes()) > 3
    assert names(tmp_path) == sorted([*writers, "weight.h", "weight_test.c"])
