"""Scalar programs as machine code, through LLVM. Knows jaxprs and XLA's custom calls; no mechanics.

A traced program of small arrays is unrolled into a graph of scalars, every node once, and written out as one straight
function over vectors of lanes: members of a batch, or directions of a derivative. What all lanes share is computed
once, ahead of them. XLA calls the function as a custom call, inside `jit` and inside loops.
"""

from __future__ import annotations

import ctypes
import functools

import jax
import numpy as np

from ..graph import LIBRARY, NotScalarError, graph_of, symbol
from ..jax_internals import ClosedJaxpr, types_of
from .available import is_on, is_wanted, machine, tell, use, why_not
from .handler import handler_text
from .llvm import Writer
from .objects import Objects, cache_folder

__all__ = ["Scalars", "is_on", "is_wanted", "tell", "use", "why_not"]

Groups = tuple[tuple[int, ...], ...]
FMOD = "fmod"  # in the C library what is `rem` in JAX


class Scalars:
    """A program as a graph, and the targets compiled from it.

    Raises `NotScalarError` where the program cannot be written so.
    """

    def __init__(self, program: ClosedJaxpr):
        self.graph, self.outputs = graph_of(program)
        taken, given = types_of(program)
        self.bytes_of = [a.size * a.dtype.itemsize for a in (*taken, *given)]
        self.functions = {
            symbol(node._replace(operation=FMOD) if node.operation == "rem" else node)
            for node in self.graph.nodes
            if node.operation in LIBRARY or node.operation == "rem"
        }
        self.kernel = functools.cache(self._kernel)
        self.target = functools.cache(self._target)

    def _kernel(self, groups: Groups, varies: tuple[bool, ...], lanes: int) -> str:
        of_lanes = functools.partial(machine().of_lanes, lanes=lanes)
        writer = Writer(self.graph.reading_groups(groups), varies, lanes, of_lanes)
        return _compiled(writer.text(len(varies), self.outputs))[1]

    def _target(self, sizes: tuple[int, ...], where: tuple[tuple[bool, ...], ...], groups: Groups) -> str:
        """The name under which XLA calls the program for a batch of `sizes`, of whose dimensions argument i has those
        in `where[i]`. It is called with `groups` of the arguments: one, or several numbers as one array.

        **Raises:** `NotScalarError` where this machine lacks a function, `RuntimeError` where LLVM fails.
        """
        missing = sorted(f for f in self.functions if not machine().has(f))
        if missing:
            raise NotScalarError(f"{', '.join(missing)} (not in the mathematical library here)")
        bytes_of = [sum(self.bytes_of[i] for i in group) for group in groups] + self.bytes_of[len(where) :]
        where = tuple(where[group[0]] for group in groups)
        if all(all(w) or not any(w) for w in where):  # one long batch
            sizes, where = (int(np.prod(sizes)),) if sizes else (), tuple((any(w),) if sizes else () for w in where)
        lanes = min(machine().lanes, 1 << (sizes[-1] - 1).bit_length()) if sizes else 1
        with machine().lock:
            kernel = self.kernel(groups, tuple(bool(w and w[-1]) for w in where), lanes)
            address, name = _compiled(handler_text(kernel, sizes, where, len(self.outputs), bytes_of))
            _register(address, name)
        return name


def _compiled(text: str) -> tuple[int, str]:
    folder = cache_folder()
    return machine().compile(text, Objects(folder) if folder else None)


@functools.cache
def _register(address: int, name: str) -> None:
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
