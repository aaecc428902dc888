"""Native kernels take no process down: threads, damaged files, another jaxlib, an LLVM that fails."""

import ctypes
import re
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

from jaxkane._scalarjit.backends import compiler as objects
from jaxkane._scalarjit.backends import llvm, native
from jaxkane._scalarjit.backends.compiler import LLVMCompiler
from jaxkane._scalarjit.function import ScalarFunction

pytestmark = pytest.mark.usefixtures("native")

# Eight systems, each compiled by a thread of its own, all at once, and each compared with XLA's afterwards.
THREADS = """
import threading, numpy as np, jax, jaxkane as jk
from jaxkane._scalarjit.backends import native
jax.config.update("jax_enable_x64", True)
def system(k):
    class Arm(jk.System):
        mass: jk.Scalar = jk.parameter(1.0)
        coordinates, speeds = ("a", "b"), ("x", "y")
        def motion(self, t, q, u):
            N, O = jk.inertial()
            A = N.rotate(1 + k % 3, q["a"], u["x"])
            B = A.rotate(1 + (k + 1) % 3, q["b"], u["y"])
            P = O.fixed((1.0 + k) * A.x + A.y)
            return jk.Motion([jk.Body(self.mass, (2.0, 2.0, 1.0 + 0.5 * k), P, A),
                              jk.Body(self.mass, (1.0, 1.0, 1.0), P.fixed(B.x + 2 * B.y), B)])
        def loads(self, t, q, u, motion, inputs):
            return jk.weight(motion, -9.81 * motion.N.y)
    return Arm()
systems, found = [system(k // 2) for k in range(8)], {}
q, u = np.array([0.3, 0.4]), np.array([0.1, -0.2])
gate = threading.Barrier(len(systems))
def work(k):
    gate.wait()
    found[k] = np.asarray(jk.accelerations(systems[k], 0.0, q, u))
threads = [threading.Thread(target=work, args=(k,)) for k in range(len(systems))]
[t.start() for t in threads]
[t.join() for t in threads]
assert native.is_on()
again = [np.asarray(jk.accelerations(s, 0.0, q, u)) for s in systems]
native.use(False)
for k in range(0, len(systems), 2):
    by_xla = np.asarray(jk.accelerations(systems[k], 0.0, q, u))
    for numbers in (found[k], found[k + 1], again[k], again[k + 1]):
        np.testing.assert_allclose(numbers, by_xla, rtol=1e-11)
print("right")
"""


@pytest.mark.slow
def test_threads_that_compile_at_once():
    run = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=300, check=False)
    assert run.stdout.strip() == "right", (run.returncode, run.stderr[-2000:])


SQUARE = "define double @it(double %x) {\n%y = fmul double %x, %x\nret double %y\n}\n"
CUBE = SQUARE.replace("ret double %y", "%z = fmul double %y, %x\nret double %z")


def value(text, folder):
    """f(3), compiled or read by a machine that has compiled nothing yet."""
    compiler = LLVMCompiler()
    address, _ = compiler.compile(text, objects.ObjectCache(folder))
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
def test_damaged_code_is_thrown_away_by_name(damage, tmp_path):
    files = []
    for text, expected in ((SQUARE, 9.0), (CUBE, 27.0)):
        found, compiler = value(text, tmp_path)
        assert found == expected
        files.append(tmp_path / f"{compiler.name_of(text)}.o")
    damage(*files)
    with pytest.warns(UserWarning, match=rf"{files[0]} is damaged: it is thrown away and made again") as told:
        assert value(SQUARE, tmp_path)[0] == 9.0
    assert len(told) == 1
    assert value(SQUARE, tmp_path)[0] == 9.0  # and now it is whole: nothing is said


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.warns(UserWarning, match=r"Compiled code could not be kept in .*file.*: Not a directory") as told:
        assert value(SQUARE, tmp_path / "file" / "folder")[0] == 9.0
    assert len(told) == 1


def test_a_folder_that_goes_and_many_who_write(tmp_path):
    folder = tmp_path / "new" / "folder"
    assert value(SQUARE, folder)[0] == 9.0
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    assert value(CUBE, folder)[0] == 27.0
    store, code, read = objects.ObjectCache(folder), bytes(range(256)) * 4096, []

    def write_and_read():
        for _ in range(5):
            store.write("same", code)
            read.append(store.read("same"))

    threads = [threading.Thread(target=write_and_read) for _ in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert read == [code] * 20
    assert sorted(path.suffix for path in folder.iterdir()) == [".o", ".o"]  # no scratch is left


def test_places_are_those_of_the_header_of_jaxlib():
    header = Path(jaxlib.__file__).parent / "include/xla/ffi/api/c_api.h"
    if not header.exists():
        pytest.skip(f"this jaxlib ships no header: {header}")
    text = re.sub(r"//[^\n]*", "", header.read_text())
    text = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\);", r"\1* \1;", text)
    bodies = dict(re.findall(r"struct (\w+) \{([^{}]*)\}", text))
    scalars = {"size_t": 8, "int64_t": 8, "int32_t": 4, "int": 4, "uint32_t": 4, "XLA_FFI_Handler_Traits": 4}
    scalars |= dict.fromkeys(re.findall(r"enum \{[^{}]*\} (\w+);", text), 4)

    def fields(struct):
        """Where each field begins, how large it is; and at last the largest alignment."""
        at, largest, found = 0, 8, {}
        for kind, name in re.findall(r"([\w\s]+?[\s*]+)(\w+);", bodies[struct]):
            kind = kind.strip().removeprefix("const ").removeprefix("struct ").strip()
            size = 8 if "*" in kind else scalars.get(kind) or size_of(kind)
            step = min(size, 8) if "*" in kind or kind in scalars else 8
            at = -(-at // step) * step
            found[name] = at, size
            at += size
        return found, -(-at // largest) * largest

    def size_of(struct):
        return fields(struct)[1]

    def at(struct, field):
        return fields(struct)[0][field][0]

    def stated(struct):
        """The size that a structure states: to the end of the field which its traits name."""
        last = re.search(rf"XLA_FFI_DEFINE_STRUCT_TRAITS\({struct},\s*(\w+)\)", text).group(1)
        return sum(fields(struct)[0][last])

    frame, arguments, base = "XLA_FFI_CallFrame", "XLA_FFI_Args", "XLA_FFI_Extension_Base"
    base = base if base in bodies else "XLA_FFI_InternalExtension"
    assert re.search(r"#define XLA_FFI_API_MAJOR 0\b", text)
    for lists, items in ((arguments, "args"), ("XLA_FFI_Rets", "rets")):
        places = at(lists, "size"), at(lists, items), stated(lists)
        assert places == (llvm.LAYOUT.list_count, llvm.LAYOUT.list_items, llvm.LAYOUT.list_size), lists
    version = at("XLA_FFI_Metadata", "api_version")
    expected = llvm.Layout(
        frame_size=stated(frame),
        frame_extension=at(frame, "extension_start"),
        frame_api=at(frame, "api"),
        frame_arguments=at(frame, "args"),
        frame_results=at(frame, "rets"),
        list_size=stated(arguments),
        list_count=at(arguments, "size"),
        list_items=at(arguments, "args"),
        buffer_size=stated("XLA_FFI_Buffer"),
        buffer_data=at("XLA_FFI_Buffer", "data"),
        extension_type=at(base, "type"),
        extension_metadata=at("XLA_FFI_Metadata_Extension", "metadata"),
        metadata_major=version + at("XLA_FFI_Api_Version", "major_version"),
        metadata_minor=version + at("XLA_FFI_Api_Version", "minor_version"),
        metadata_traits=at("XLA_FFI_Metadata", "traits"),
        api_error_create=at("XLA_FFI_Api", "XLA_FFI_Error_Create"),
        error_size=stated("XLA_FFI_Error_Create_Args"),
        error_message=at("XLA_FFI_Error_Create_Args", "message"),
        error_code=at("XLA_FFI_Error_Create_Args", "errc"),
    )
    assert expected == llvm.LAYOUT


@pytest.fixture
def unproven(tmp_path, monkeypatch):
    """A process that has tried nothing yet, and folders without verdicts."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native, "cache_folder", lambda: None)
    monkeypatch.setattr(native, "_told", set())
    native._probed.cache_clear()
    yield tmp_path
    monkeypatch.undo()
    native._probed.cache_clear()


# Places that make a wild pointer of the buffers' list, and a size that the handler finds wrong.
@pytest.mark.parametrize(("place", "number", "how"), [("list_items", 24, "signal"), ("list_size", 48, "another way")])
def test_a_moved_structure_leaves_the_work_to_xla(place, number, how, unproven, monkeypatch):
    monkeypatch.setattr(llvm, "LAYOUT", llvm.LAYOUT._replace(**{place: number}))
    f = ScalarFunction(lambda x: jnp.sin(x) * number)
    with pytest.warns(UserWarning, match=f"no native kernels, XLA does their work: a first kernel.*{how}") as told:
        found = jax.jit(f)(0.5), *jax.jit(jax.vmap(f))(jnp.ones(3))
    np.testing.assert_allclose(found, np.sin([0.5, 1.0, 1.0, 1.0]) * number)
    assert len(told) == 1
    assert not native.is_on()
    assert "first kernel" in (native.why_not() or "")
    # The next process reads it, and tries for itself again a day later.
    native._probed.cache_clear()
    monkeypatch.setattr(subprocess, "run", None)
    assert not native.is_on()
    monkeypatch.setattr(native, "_A_DAY", -1.0)
    native._probed.cache_clear()
    with pytest.raises(TypeError):
        native.is_on()


def test_a_handler_that_finds_a_moved_structure_makes_an_error(monkeypatch):
    assert native.is_on()
    monkeypatch.setattr(llvm, "LAYOUT", llvm.LAYOUT._replace(frame_size=4096))
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"calls native kernels in another way .*native=False"):
        jax.block_until_ready(jax.jit(ScalarFunction(lambda x: jnp.cos(x) * 1.25))(0.5))


def test_the_probe_is_not_run_again_nor_where_kernels_are_off(unproven, monkeypatch):
    assert native.is_on()
    (verdict,) = (unproven / "jaxkane").glob("kernels-*.json")
    monkeypatch.setattr(subprocess, "run", None)  # whoever calls it fails
    native._probed.cache_clear()
    assert native.is_on()
    verdict.write_text("{")
    native._probed.cache_clear()
    with pytest.raises(TypeError):
        native.is_on()
    monkeypatch.setattr(native, "_wanted", False)
    assert not native.is_on()


def test_without_a_place_for_the_verdict(unproven, monkeypatch):
    (unproven / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(unproven / "file"))
    monkeypatch.setattr(native, "_tried", lambda machine: (None, True))
    assert native.is_on()


class Text:
    """A writer of kernels that writes what LLVM does not read."""

    def __init__(self, *_):
        pass

    def text(self, *_):
        return "define void @it( nonsense"


def test_an_error_of_llvm_leaves_the_work_to_xla(monkeypatch):
    monkeypatch.setattr(native, "_told", set())
    f = ScalarFunction(lambda x: jnp.sin(x) * 1.75)
    with monkeypatch.context() as broken:
        broken.setattr(native, "Writer", Text)
        with pytest.warns(UserWarning, match="XLA does their work: LLVM fails at A function") as told:
            found = [*jax.jit(jax.vmap(f))(jnp.ones(1)), *jax.jit(jax.vmap(f))(jnp.ones(3))]
        np.testing.assert_allclose(found, np.sin(np.ones(4)) * 1.75)
        assert len(told) == 1
    assert native.is_on()


def test_a_function_that_is_missing_leaves_the_work_to_xla(monkeypatch):
    """LLVM would end the process."""
    monkeypatch.setattr(LLVMCompiler, "has", lambda self, function: function != "fmod")
    with pytest.warns(UserWarning, match=r"uses fmod \(not in the mathematical library here\)"):
        np.testing.assert_allclose(jax.jit(ScalarFunction(lambda x: jax.lax.rem(x, 0.7)))(2.0), 2.0 % 0.7)
