"""LLVM in this process: the processor, texts compiled for it, and compiled code on disk.

Knows neither programs nor JAX.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import functools
import hashlib
import platform
import threading
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


class ObjectCache(NamedTuple):
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
        from ..._common.files import atomic_write  # the probe's worker loads this file alone, and writes nothing

        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            atomic_write(self.folder / f"{name}.o", lambda file: file.write(_seal(name, code) + code))
        except OSError as error:
            text = f"Compiled code could not be kept in {self.folder}: {error.strerror or error}."
            warnings.warn(text, stacklevel=2)


def _seal(name: str, code: bytes) -> bytes:
    return _MARK + hashlib.sha256(name.encode() + b"\n" + code).hexdigest().encode() + b"\n"


_OLDEST_LLVM = 20
_MATHEMATICS = {"Linux": "libm.so.6", "Darwin": "/usr/lib/libSystem.B.dylib", "Windows": "ucrtbase.dll"}


class LLVMCompiler:
    """This processor: its name and `features`, and how many float64 `lanes` its vectors have.

    LLVM is for one thread at a time, and a function must not be compiled twice: the code of the first would go while
    XLA calls it. Whoever compiles and registers holds `lock`.
    """

    def __init__(self) -> None:
        import llvmlite
        import llvmlite.binding as llvm

        self.llvm, self.lock = llvm, threading.RLock()
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        features = llvm.get_host_cpu_features()
        self.cpu, self.features = llvm.get_host_cpu_name(), features.flatten()
        self.version = f"llvmlite {llvmlite.__version__}, LLVM {'.'.join(map(str, llvm.llvm_version_info))}"
        self.lanes = 8 if features.get("avx512f") else 4 if features.get("avx2") else 2
        on_linux = platform.system() == "Linux"
        self.has_libmvec = on_linux and platform.machine() == "x86_64" and _load(llvm, "libmvec.so.1", "mvec")
        _load(llvm, _MATHEMATICS.get(platform.system()), "m")
        self._compiled: dict[str, tuple[int, Any]] = {}

    def name_of(self, text: str, level: int = 2) -> str:
        """The name under which `compile(text)` defines its function: of the text, the level, the processor and the
        LLVM."""
        return "jaxkane_" + hashlib.sha256("\n".join((text, str(level), *self.key)).encode()).hexdigest()[:32]

    @property
    def key(self) -> tuple[str, str, str]:
        return self.cpu, self.features, self.version

    def compile(self, text: str, store: ObjectCache | None = None, level: int = 2) -> tuple[int, str]:
        """The address of the function that `text` defines as @it, and a name for it that other texts may call; `level`:
        of optimization."""
        name = self.name_of(text, level)
        with self.lock:
            if name not in self._compiled:
                engine, keepers = self._engine(name, text.replace("@it(", f"@{name}("), store, level)
                address = engine.get_function_address(name)
                self.llvm.add_symbol(name, address)
                self._compiled[name] = address, keepers  # code lives as long as the process
            return self._compiled[name][0], name

    def _engine(self, name: str, text: str, store: ObjectCache | None, level: int) -> tuple[Any, Any]:
        llvm = self.llvm
        module = llvm.parse_assembly(text)
        module.name = name
        target = llvm.Target.from_default_triple().create_target_machine(
            cpu=self.cpu, features=self.features, opt=level, codemodel="jitdefault", jit=True
        )
        engine = llvm.create_mcjit_compiler(module, target)
        kept, made = store.read(name) if store else None, []
        engine.set_object_cache(lambda _, code: made.append(code), lambda _: kept)
        engine.finalize_object()
        if store and made:
            store.write(name, made[0])
        return engine, (engine, target)

    def has(self, function: str) -> bool:
        """Whether a function of the mathematical library can be called: LLVM ends the process at an unknown one."""
        return self.llvm.address_of_symbol(function) is not None

    @functools.cache  # noqa: B019, there is one machine
    def of_lanes(self, function: str, arity: int, lanes: int) -> str | None:
        """The name in glibc's libmvec of a function of so many lanes of float64, where there is one."""
        kind = {8: "e", 4: "d", 2: "b"}.get(lanes)
        name = f"_ZGV{kind}N{lanes}{'v' * arity}_{function}"
        return name if self.has_libmvec and kind and self.has(name) else None


def without_llvm() -> str | None:
    """Why there is no LLVM in this process that could be used; None where there is one."""
    try:
        from llvmlite.binding import llvm_version_info
    except ImportError:
        return "llvmlite is not installed: pip install llvmlite"
    except OSError as error:  # its shared library does not load
        return f"LLVM does not work here: {error}"
    return None if llvm_version_info >= (_OLDEST_LLVM,) else "llvmlite is too old: pip install 'llvmlite>=0.45'"


def _load(llvm: Any, file: str | None, name: str) -> bool:
    """Have LLVM look for functions in a shared library, known by its file or else by its name."""
    for place in (lambda: file, lambda: ctypes.util.find_library(name)):
        try:
            if path := place():
                llvm.load_library_permanently(path)
                return True
        except RuntimeError:  # as llvmlite says that there is no such file
            continue
    return False
