"""LLVM in this process: whether it is there, and what has been compiled by it. Knows no programs, only text."""

from __future__ import annotations

import ctypes.util
import functools
import hashlib
import os
import platform
import warnings
from pathlib import Path
from typing import Any

import jax

_OLDEST_LLVM = 20


class Machine:
    """This processor: its name and `features`, and how many float64 `lanes` its vectors have."""

    def __init__(self) -> None:
        import llvmlite.binding as llvm

        self.llvm = llvm
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        features = llvm.get_host_cpu_features()
        self.cpu, self.features = llvm.get_host_cpu_name(), features.flatten()
        self.lanes = 8 if features.get("avx512f") else 4 if features.get("avx2") else 2
        self.has_libmvec = platform.machine() == "x86_64" and _load(llvm, "mvec")
        _load(llvm, "m")
        self._compiled: dict[str, tuple[int, Any]] = {}

    def compile(self, text: str) -> tuple[int, str]:
        """The address of the function that `text` defines as @it, and a name for it that other texts may call."""
        digest = hashlib.sha256("\n".join((text, self.cpu, self.features)).encode())
        name = "jaxkane_" + digest.hexdigest()[:24]
        if name not in self._compiled:
            engine, keepers = self._engine(name, text.replace("@it(", f"@{name}("))
            address = engine.get_function_address(name)
            self.llvm.add_symbol(name, address)
            self._compiled[name] = address, keepers  # code lives as long as the process
        return self._compiled[name][0], name

    def _engine(self, name: str, text: str) -> tuple[Any, Any]:
        llvm = self.llvm
        module = llvm.parse_assembly(text)
        module.name = name
        target = llvm.Target.from_default_triple().create_target_machine(
            cpu=self.cpu, features=self.features, opt=2, codemodel="jitdefault", jit=True
        )
        engine = llvm.create_mcjit_compiler(module, target)
        folder = _cache_folder()
        if folder:
            engine.set_object_cache(functools.partial(_keep, folder), functools.partial(_kept, folder))
        engine.finalize_object()
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


def _load(llvm: Any, library: str) -> bool:
    path = ctypes.util.find_library(library)
    if path:
        llvm.load_library_permanently(path)
    return path is not None


@functools.cache
def machine() -> Machine:
    return Machine()


_wanted = os.environ.get("JAXKANE_NATIVE", "1") != "0"


def use(native: bool) -> None:
    """Whether programs that are compiled from now on become machine code through LLVM, or XLA's."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()
    os.environ["JAXKANE_NATIVE"] = str(int(native))


def is_on() -> bool:
    return _wanted and why_not() is None


@functools.cache
def why_not() -> str | None:
    """Why this process cannot have native kernels; None where it can."""
    if platform.system() != "Linux":
        return f"they are made for Linux, and this is {platform.system()}"
    try:
        version = machine().llvm.llvm_version_info
    except ImportError:
        return "llvmlite is not installed: pip install 'jaxkane[native]'"
    except Exception as error:  # an LLVM or a processor that is not known here
        return f"LLVM does not work here: {error}"
    return None if version >= (_OLDEST_LLVM,) else "llvmlite is too old: pip install 'llvmlite>=0.45'"


def _cache_folder() -> Path | None:
    """Beside JAX's persistent compilation cache, where that is on."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return Path(folder) / "jaxkane" if folder and config.jax_enable_compilation_cache else None


def _keep(folder: Path, module: Any, code: bytes) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        scratch = folder / f"{module.name}.{os.getpid()}"
        scratch.write_bytes(code)
        scratch.replace(folder / f"{module.name}.o")
    except OSError as error:
        warnings.warn(f"Compiled code could not be kept in {folder}: {error}", stacklevel=2)


def _kept(folder: Path, module: Any) -> bytes | None:
    try:
        return (folder / f"{module.name}.o").read_bytes()
    except OSError:
        return None
