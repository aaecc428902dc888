"""Native kernels take no process down: threads, damaged files, another jaxlib, an LLVM that fails."""

import ctypes
import re
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane._scalarjit import llvm, native
from jaxkane._scalarjit.native import LLVMCompiler
from jaxkane._scalarjit.scalar_function import ScalarFunction

pytestmark = pytest.mark.usefixtures("native")

# Eight systems, each compiled by a thread of its own, all at once, and each compared with XLA's afterwards.
THREADS = """
import threading, numpy as np, jax, jaxkane as jk
from jaxkane._scalarjit import native
jax.config.update("jax_enable_x64", True)
names = ("DoublePendulum", "SpinningTop", "RotatingFrameAndBar", "SliderWithPinnedBar")
entries, found = [jk.catalog.CATALOG[name] for name in names for _ in "ab"], {}
systems, states = [entry.example() for entry in entries], [(entry.q, entry.u) for entry in entries]
rates = lambda k: np.asarray(jk.accelerations(systems[k], 0.0, *states[k]))
gate = threading.Barrier(len(systems))
def work(k):
    gate.wait()
    found[k] = rates(k)
threads = [threading.Thread(target=work, args=(k,)) for k in range(len(systems))]
[t.start() for t in threads]
[t.join() for t in threads]
assert native.is_on()
again = [rates(k) for k in range(len(systems))]
native.use(False)
for k in range(0, len(systems), 2):
    by_xla = rates(k)
    for numbers in (found[k], found[k + 1], again[k], again[k + 1]):
        np.testing.assert_allclose(numbers, by_xla, rtol=1e-11, atol=1e-11)
print("right")
"""


@pytest.mark.weekly
def test_threads_that_compile_at_once():
    run = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=300, check=False)
    assert run.stdout.strip() == "right", (run.returncode, run.stderr[-2000:])


SQUARE = "define double @it(double %x) {\n%y = fmul double %x, %x\nret double %y\n}\n"
CUBE = SQUARE.replace("ret double %y", "%z = fmul double %y, %x\nret double %z")


def value(text, folder):
    """f(3), compiled or read by a machine that has compiled nothing yet."""
    compiler = LLVMCompiler()
    address, _ = compiler.compile(text, native.ObjectCache(folder))
    found = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(address)(3.0)
    return found, compiler  # whose code must live while it is called


def truncated(path, _):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zeroed(path, _):
    path.write_bytes(bytes(path.stat().st_size))


def empty(path, _):
    path.write_bytes(b"")


def swapped(path, other):
    path.write_bytes(other.read_bytes())


def one_bit(path, _):
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1
    path.write_bytes(bytes(whole))


@pytest.mark.parametrize("damage", [truncated, zeroed, empty, swapped, one_bit])
def test_damaged_object_files_are_reported_and_recompiled(damage, tmp_path):
    files = []
    for text, expected in ((SQUARE, 9.0), (CUBE, 27.0)):
        found, compiler = value(text, tmp_path)
        assert found == expected
        files.append(tmp_path / f"{compiler.name_of(text)}.o")
    damage(*files)
    with pytest.warns(UserWarning, match=rf"{files[0]} is damaged. It is deleted and compiled again") as told:
        assert value(SQUARE, tmp_path)[0] == 9.0
    assert len(told) == 1
    assert value(SQUARE, tmp_path)[0] == 9.0  # and now it is whole: nothing is said


def test_an_unwritable_cache_folder_causes_a_warning(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.warns(UserWarning, match=r"Compiled code could not be stored in .*file.*: Not a directory") as told:
        assert value(SQUARE, tmp_path / "file" / "folder")[0] == 9.0
    assert len(told) == 1


def test_a_deleted_cache_folder_and_concurrent_writers(tmp_path):
    folder = tmp_path / "new" / "folder"
    assert value(SQUARE, folder)[0] == 9.0
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    assert value(CUBE, folder)[0] == 27.0
    store, code, read = native.ObjectCache(folder), bytes(range(256)) * 4096, []

    def write_and_read():
        for _ in range(5):
            store.write("same", code)
            read.append(store.read("same"))

    threads = [threading.Thread(target=write_and_read) for _ in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert read == [code] * 20
    assert sorted(path.suffix for path in folder.iterdir()) == [".o", ".o"]  # no scratch is left


HEADER = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h")


def test_structures_agree_with_the_header_of_jaxlib():
    if not HEADER.exists():
        pytest.skip(f"this jaxlib ships no header: {HEADER}")
    assert llvm.mismatch() is None


CHANGES = {
    "another order": (
        "XLA_FFI_DataType dtype;\n  void* data;",
        "void* data;\n  XLA_FFI_DataType dtype;",
        "struct XLA_FFI_Buffer has changed",
    ),
    "another version": ("XLA_FFI_API_MAJOR 0", "XLA_FFI_API_MAJOR 1", "XLA_FFI_API_MAJOR has changed"),
    "nothing in it": (None, "", "XLA_FFI_API_MAJOR has changed"),
}


@pytest.fixture
def unknown(monkeypatch):
    """A process that has not compared the header yet."""
    native.warn_not_native.cache_clear()
    native.why_not.cache_clear()
    yield
    monkeypatch.undo()
    native.why_not.cache_clear()


@pytest.mark.parametrize("change", CHANGES)
def test_with_a_different_header_xla_is_used(change, tmp_path, unknown, monkeypatch):
    old, new, words = CHANGES[change]
    text = HEADER.read_text()
    assert old is None or old in text
    header = tmp_path / "c_api.h"
    header.write_text("" if old is None else text.replace(old, new))
    why = llvm.mismatch(header)
    assert words in (why or "")
    monkeypatch.setattr(native, "mismatch", lambda: why)
    f = ScalarFunction(lambda x: jnp.sin(x) * 1.25)
    with pytest.warns(UserWarning, match="jaxkane does not use native kernels: ") as told:
        found = jax.jit(f)(0.5), *jax.jit(jax.vmap(f))(jnp.ones(3))
    np.testing.assert_allclose(found, np.sin([0.5, 1.0, 1.0, 1.0]) * 1.25)
    assert len(told) == 1
    assert not native.is_on()


def test_without_the_header_xla_is_used(tmp_path):
    assert "cannot be read" in (llvm.mismatch(tmp_path / "c_api.h") or "")


def test_fields_appended_to_a_structure_are_ignored(tmp_path):
    """Fields that a later jaxlib appends are not read."""
    text = HEADER.read_text()
    (body,) = re.findall(r"struct XLA_FFI_Buffer \{[^}]*", text)
    header = tmp_path / "c_api.h"
    header.write_text(text.replace(body, f"{body}  void* more;\n"))
    assert llvm.mismatch(header) is None


class Text:
    """A writer of kernels that writes what LLVM does not read."""

    def __init__(self, *_):
        pass

    def text(self, *_):
        return "define void @it( nonsense"


def test_after_an_llvm_error_xla_is_used(monkeypatch):
    native.warn_not_native.cache_clear()
    f = ScalarFunction(lambda x: jnp.sin(x) * 1.75)
    with monkeypatch.context() as broken:
        broken.setattr(native, "Writer", Text)
        with pytest.warns(UserWarning, match="does not use native kernels: LLVM fails at A function") as told:
            found = [*jax.jit(jax.vmap(f))(jnp.ones(1)), *jax.jit(jax.vmap(f))(jnp.ones(3))]
        np.testing.assert_allclose(found, np.sin(np.ones(4)) * 1.75)
        assert len(told) == 1
    assert native.is_on()


def test_without_a_required_library_function_xla_is_used(monkeypatch):
    """LLVM would end the process."""
    monkeypatch.setattr(LLVMCompiler, "has", lambda self, function: function != "fmod")
    with pytest.warns(UserWarning, match=r"uses fmod \(not in the mathematical library of this computer\)"):
        np.testing.assert_allclose(jax.jit(ScalarFunction(lambda x: jax.lax.rem(x, 0.7)))(2.0), 2.0 % 0.7)
