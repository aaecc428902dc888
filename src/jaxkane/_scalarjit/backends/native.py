"""Native kernels: whether they are enabled and possible, and programs as such kernels."""

from __future__ import annotations

import ctypes
import functools
import os
import threading
import warnings
from collections.abc import Callable

import jax
import numpy as np

from ..compat import ClosedJaxpr, types_of
from ..graph import LIBRARY, Graph, NotScalarError, graph_of, symbol
from .compiler import LLVMCompiler, ObjectCache, cache_folder, without_llvm
from .llvm import Writer, mismatch, wrapper_text

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
    return llvm_compiler().compile(text, ObjectCache(folder) if folder else None, level)


@functools.cache
def _register(address: int, name: str) -> None:
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
