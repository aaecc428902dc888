"""Whether programs become native kernels: what is wanted, and what this machine can do. Knows no programs."""

from __future__ import annotations

import ctypes
import functools
import os
import threading
import warnings

import jax
import numpy as np

from ..compat import ClosedJaxpr, types_of
from ..graph import LIBRARY, NotScalarError, graph_of, symbol
from . import probe
from .compiler import LLVMCompiler, ObjectCache, cache_folder, without_llvm
from .ffi import wrapper_text
from .llvm import Writer

_ON, _OFF = ("", "1", "true", "yes", "on"), ("0", "false", "no", "off")


def switched_on(word: str) -> bool:
    """What JAXKANE_NATIVE says in the environment; where it is empty, it is as if it were not set."""
    if word.strip().lower() not in (*_ON, *_OFF):
        raise ValueError(f"JAXKANE_NATIVE={word!r} in the environment: it is one of {', '.join((*_ON[1:], *_OFF))}.")
    return word.strip().lower() in _ON


_wanted = switched_on(os.environ.get("JAXKANE_NATIVE", ""))
_lock = threading.RLock()
_told: set[str] = set()


def llvm_compiler() -> LLVMCompiler:
    with _lock:
        return _llvm_compiler()


@functools.cache
def _llvm_compiler() -> LLVMCompiler:
    return LLVMCompiler()


def use(native: bool) -> None:
    """Whether programs that are compiled from now on become machine code through LLVM, or XLA's."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()
    os.environ["JAXKANE_NATIVE"] = str(int(native))


def is_wanted() -> bool:
    return _wanted


def is_on() -> bool:
    """Whether programs become native kernels. A machine that has LLVM but fails the probe is told of, once."""
    if not _wanted or _without_llvm():
        return False
    why = why_not()
    if why:
        tell(why)
    return why is None


def why_not() -> str | None:
    """Why this process cannot have native kernels; None where it can."""
    return _without_llvm() or _refused()


def tell(why: str) -> None:
    """Warn that XLA does the work of native kernels; once for each reason."""
    with _lock:
        is_new = why not in _told
        _told.add(why)
    if is_new:
        warnings.warn(f"jaxkane: no native kernels, XLA does their work: {why}.", UserWarning, stacklevel=3)


@functools.cache
def _without_llvm() -> str | None:
    return without_llvm()


def _refused() -> str | None:
    with _lock:
        return _verdict()


@functools.cache
def _verdict() -> str | None:
    try:
        return probe.verdict(llvm_compiler())
    except RuntimeError as error:  # as llvmlite says that LLVM does not know this processor
        return f"LLVM does not work here: {error}"


Groups = tuple[tuple[int, ...], ...]
FMOD = "fmod"  # in the C library what is `rem` in JAX


class Scalars:
    """A program as a graph, and the targets compiled from it.

    Raises `NotScalarError` where the program cannot be written so.
    """

    def __init__(self, program: ClosedJaxpr):
        self.graph, self.outputs = graph_of(program)
        inputs, results = types_of(program)
        self.bytes_of = [a.size * a.dtype.itemsize for a in (*inputs, *results)]
        self.functions = {
            symbol(node._replace(operation=FMOD) if node.operation == "rem" else node)
            for node in self.graph.nodes
            if node.operation in LIBRARY or node.operation == "rem"
        }
        self.kernel = functools.cache(self._kernel)
        self.target = functools.cache(self._target)

    def _kernel(self, groups: Groups, varies: tuple[bool, ...], lanes: int) -> str:
        of_lanes = functools.partial(llvm_compiler().of_lanes, lanes=lanes)
        writer = Writer(self.graph.reading_groups(groups), varies, lanes, of_lanes)
        return _compiled(writer.text(len(varies), self.outputs))[1]

    def _target(self, sizes: tuple[int, ...], where: tuple[tuple[bool, ...], ...], groups: Groups) -> str:
        """The name under which XLA calls the program for a batch of `sizes`, of whose dimensions argument i has those
        in `where[i]`. It is called with `groups` of the arguments: one, or several numbers as one array.

        **Raises:** `NotScalarError` where this machine lacks a function, `RuntimeError` where LLVM fails.
        """
        missing = sorted(f for f in self.functions if not llvm_compiler().has(f))
        if missing:
            raise NotScalarError(f"{', '.join(missing)} (not in the mathematical library here)")
        bytes_of = [sum(self.bytes_of[i] for i in group) for group in groups] + self.bytes_of[len(where) :]
        where = tuple(where[group[0]] for group in groups)
        if all(all(w) or not any(w) for w in where):  # one long batch
            sizes, where = (int(np.prod(sizes)),) if sizes else (), tuple((any(w),) if sizes else () for w in where)
        lanes = min(llvm_compiler().lanes, 1 << (sizes[-1] - 1).bit_length()) if sizes else 1
        with llvm_compiler().lock:
            kernel = self.kernel(groups, tuple(bool(w and w[-1]) for w in where), lanes)
            address, name = _compiled(wrapper_text(kernel, sizes, where, len(self.outputs), bytes_of))
            _register(address, name)
        return name


def _compiled(text: str) -> tuple[int, str]:
    folder = cache_folder()
    return llvm_compiler().compile(text, ObjectCache(folder) if folder else None)


@functools.cache
def _register(address: int, name: str) -> None:
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
