"""Native kernels: LLVM in this process, compiled code on disk, whether kernels are enabled and possible, and programs
as such kernels."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import functools
import hashlib
import os
import platform
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from .._common.files import atomic_write
from .compat import ClosedJaxpr, types_of
from .graph import LIBRARY, Graph, NotScalarError, graph_of, symbol
from .llvm import Writer, mismatch, wrapper_text

_MARK = b"jaxkane compiled code 1\n"


def cache_folder() -> Path | None:
    """A folder next to JAX's persistent compilation cache, if that is enabled and a local folder."""
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
        warnings.warn(f"The compiled code in {path} is damaged. It is deleted and compiled again.", stacklevel=2)
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def write(self, name: str, code: bytes) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            atomic_write(self.folder / f"{name}.o", lambda file: file.write(_seal(name, code) + code))
        except OSError as error:
            text = f"Compiled code could not be stored in {self.folder}: {error.strerror or error}."
            warnings.warn(text, stacklevel=2)


def _seal(name: str, code: bytes) -> bytes:
    return _MARK + hashlib.sha256(name.encode() + b"\n" + code).hexdigest().encode() + b"\n"


_MATHEMATICS = {"Linux": "libm.so.6", "Darwin": "/usr/lib/libSystem.B.dylib", "Windows": "ucrtbase.dll"}


class LLVMCompiler:
    """LLVM for this processor: its name and `features`, and the number of float64 `lanes` of its vectors.

    LLVM may be used by one thread at a time. A function must not be compiled twice, because the first code would be
    freed while XLA calls it. Hold `lock` to compile and register.
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
        self._engines: dict[int, Any] = {}  # by optimization level
        self._compiled: dict[str, int] = {}

    def name_of(self, text: str, level: int = 2) -> str:
        """The name under which `compile(text)` defines its function. It depends on the text, the level, the processor
        and the version of LLVM."""
        return "jaxkane_" + hashlib.sha256("\n".join((text, str(level), *self.key)).encode()).hexdigest()[:32]

    @property
    def key(self) -> tuple[str, str, str]:
        return self.cpu, self.features, self.version

    def compile(self, text: str, store: ObjectCache | None = None, level: int = 2) -> tuple[int, str]:
        """Compile a text that defines the function @it.

        **Arguments:**

        - `text`: in LLVM's language.
        - `store`: the folder of compiled code, or None.
        - `level`: of optimization.

        **Returns:** the address of the function, and a name by which other texts can call it.
        """
        name = self.name_of(text, level)
        with self.lock:
            if name not in self._compiled:
                address = self._address(name, text.replace("@it(", f"@{name}("), store, level)
                self.llvm.add_symbol(name, address)
                self._compiled[name] = address
            return self._compiled[name], name

    def _address(self, name: str, text: str, store: ObjectCache | None, level: int) -> int:
        module = self.llvm.parse_assembly(text)
        module.name = name
        engine = self._engine(level)
        kept, made = store.read(name) if store else None, []
        engine.set_object_cache(lambda _, code: made.append(code), lambda _: kept)
        engine.add_module(module)
        engine.finalize_object()
        if store and made:
            store.write(name, made[0])
        return engine.get_function_address(name)

    def _engine(self, level: int) -> Any:
        """One engine for all functions; its code remains until the process ends. An engine with its target takes 0.8
        MB, a function in it 0.01 MB."""
        if level not in self._engines:
            target = self.llvm.Target.from_default_triple().create_target_machine(
                cpu=self.cpu, features=self.features, opt=level, codemodel="jitdefault", jit=True
            )
            engine = self._engines[level] = self.llvm.create_mcjit_compiler(self.llvm.parse_assembly(""), target)
            # otherwise the object cache of the first function would apply to this empty module
            engine.finalize_object()
        return self._engines[level]

    def has(self, function: str) -> bool:
        """Whether a function of the mathematical library can be called. LLVM terminates the process at an unknown
        function."""
        return self.llvm.address_of_symbol(function) is not None

    @functools.cache  # noqa: B019, there is one machine
    def of_lanes(self, function: str, arity: int, lanes: int) -> str | None:
        """The name in glibc's libmvec of a function for this number of float64 lanes, or None."""
        kind = {8: "e", 4: "d", 2: "b"}.get(lanes)
        name = f"_ZGV{kind}N{lanes}{'v' * arity}_{function}"
        return name if self.has_libmvec and kind and self.has(name) else None


@functools.cache
def without_llvm() -> str | None:
    """Why LLVM cannot be used in this process; None if it can."""
    try:
        import llvmlite.binding  # noqa: F401
    except ImportError:
        return "llvmlite is not installed: pip install llvmlite"
    except OSError as error:  # its shared library cannot be loaded
        return f"LLVM does not work here: {error}"
    return None


def _load(llvm: ModuleType, file: str | None, name: str) -> bool:
    """Make LLVM search a shared library for functions, found by its file or else by its name."""
    for place in (lambda: file, lambda: ctypes.util.find_library(name)):
        try:
            if path := place():
                llvm.load_library_permanently(path)
                return True
        except RuntimeError:  # llvmlite's exception for a missing file
            continue
    return False


_ON, _OFF = ("", "1", "true", "yes", "on"), ("0", "false", "no", "off")


def switched_on(word: str) -> bool:
    """The value of JAXKANE_NATIVE in the environment; empty means not set."""
    if word.strip().lower() not in (*_ON, *_OFF):
        raise ValueError(f"JAXKANE_NATIVE={word!r} in the environment must be one of {', '.join((*_ON[1:], *_OFF))}.")
    return word.strip().lower() in _ON


_wanted = switched_on(os.environ.get("JAXKANE_NATIVE", ""))
_lock = threading.RLock()


def llvm_compiler() -> LLVMCompiler:
    with _lock:
        return _llvm_compiler()


@functools.cache
def _llvm_compiler() -> LLVMCompiler:
    return LLVMCompiler()


def use(native: bool) -> None:
    """Set whether programs that are compiled from now on become native kernels (LLVM) or are compiled by XLA."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()
    os.environ["JAXKANE_NATIVE"] = str(int(native))


def is_wanted() -> bool:
    return _wanted


def is_on() -> bool:
    """Whether programs become native kernels. Warns once if LLVM is installed but kernels cannot be called."""
    if not _wanted or without_llvm():
        return False
    if why := why_not():
        warn_not_native(why)
    return why is None


@functools.cache
def why_not() -> str | None:
    """Why native kernels are not possible in this process; None if they are."""
    if why := without_llvm() or mismatch():
        return why
    try:
        llvm_compiler()
    except RuntimeError as error:  # llvmlite raises it if LLVM does not support the processor
        return f"LLVM does not work here: {error}"
    return None


@functools.cache
def warn_not_native(why: str) -> None:
    """Warn that XLA replaces native kernels; once for each reason."""
    warnings.warn(
        f"jaxkane does not use native kernels: {why}. XLA compiles the equations instead.", UserWarning, stacklevel=3
    )


Groups = tuple[tuple[int, ...], ...]
BatchMask = tuple[tuple[bool, ...], ...]
Sizes = tuple[int, ...]
FMOD = "fmod"  # the C function of JAX's `rem`


class Scalars:
    """A program as a graph, by `as_graph`, and the targets compiled from it.

    - `compile_cheaply`: compile quickly, because the program is called once.
    - `is_derivative`: sums may be added in any order.

    **Raises:** `NotScalarError` if the program is not a program of scalars.
    """

    def __init__(
        self,
        program: ClosedJaxpr,
        compile_cheaply: bool = False,
        is_derivative: bool = False,
        as_graph: Callable[..., tuple[Graph, list[np.ndarray]]] = graph_of,
    ):
        self.compile_cheaply, self.is_derivative = compile_cheaply, is_derivative
        self.graph, self.outputs = as_graph(program)
        nodes, inputs = self.graph.nodes, types_of(program)[0]
        results = [[np.dtype(nodes[k].dtype) for k in x.flat] for x in self.outputs]
        self.bytes_of = [a.size * a.dtype.itemsize for a in inputs] + [sum(d.itemsize for d in x) for x in results]
        self.functions = {
            symbol(node._replace(operation=FMOD) if node.operation == "rem" else node)
            for node in self.graph.nodes
            if node.operation in LIBRARY or node.operation == "rem"
        }
        self.kernel = functools.cache(self._kernel)
        self.target = functools.cache(self._target)

    def _kernel(
        self, groups: Groups, varies: tuple[bool, ...], out_varies: tuple[bool, ...], lanes: int
    ) -> tuple[str, str]:
        """Its name; and its text, if it becomes part of the one function that calls it."""
        of_lanes = functools.partial(llvm_compiler().of_lanes, lanes=lanes)
        graph = self.graph.reading_groups(groups)
        text = Writer(graph, varies, out_varies, lanes, of_lanes, self.is_derivative).text(self.outputs)
        if not self.compile_cheaply:
            return _compiled(text)[1], ""
        return "kernel", text.replace("define void @it(", "define internal void @kernel(")

    def _target(self, sizes: tuple[int, ...], batch_mask: BatchMask, groups: Groups, out_batch_mask: BatchMask) -> str:
        """The name under which XLA calls the program for a batch.

        **Arguments:**

        - `sizes`: of the batch dimensions.
        - `batch_mask`: for each argument of the program, which dimensions it has.
        - `groups`: of arguments; each group is passed as one array.
        - `out_batch_mask`: for each result, which dimensions it has.

        **Raises:** `NotScalarError` if this machine lacks a function, `RuntimeError` if LLVM fails.
        """
        missing = sorted(f for f in self.functions if not llvm_compiler().has(f))
        if missing:
            raise NotScalarError(f"{', '.join(missing)} (not in the mathematical library of this computer)")
        bytes_of = [sum(self.bytes_of[i] for i in group) for group in groups] + self.bytes_of[len(batch_mask) :]
        batch_mask = (*(batch_mask[group[0]] for group in groups), *out_batch_mask)
        if all(all(mask) or not any(mask) for mask in batch_mask):  # one long batch
            batch_mask = tuple((any(mask),) if sizes else () for mask in batch_mask)
            sizes = (int(np.prod(sizes)),) if sizes else ()
        n, varies = len(groups), tuple(bool(mask and mask[-1]) for mask in batch_mask)
        lanes = 1
        if sizes and not self.compile_cheaply:  # a function that is called once should have a short text
            lanes = min(llvm_compiler().lanes, 1 << (sizes[-1] - 1).bit_length())
        with llvm_compiler().lock:
            kernel, text = self.kernel(groups, varies[:n], varies[n:], lanes)
            wrapper = wrapper_text(kernel, sizes, batch_mask, n, bytes_of, text)
            address, name = _compiled(wrapper, level=0)
            _register(address, name)
        return name


def _compiled(text: str, level: int = 2) -> tuple[int, str]:
    folder = cache_folder()
    if len(text) > 2_000_000:
        level = 0  # the time to optimize grows faster than the text: 5 s and 0.4 s for 3.6 MB
    return llvm_compiler().compile(text, ObjectCache(folder) if folder else None, level)


@functools.cache
def _register(address: int, name: str) -> None:
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
