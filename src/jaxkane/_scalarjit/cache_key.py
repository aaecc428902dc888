"""Programs that are made anew where what the code of their arguments reads has changed. Knows equinox and `reads`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from .captured_values import NUMBERS, CapturedValues, is_of_library
from .compat import is_under_way, settings

_MOST_KEPT = 256

_known: dict[int, CapturedValues] = {}
_count = itertools.count()
_lock = threading.Lock()
_forgotten = b"0"
_memories: list[Callable[[], None]] = []


class _Tracing(threading.local):
    """What is being traced in this thread: a trace belongs to what was read when it began."""

    def __init__(self) -> None:
        self.reads: dict[int, CapturedValues] = {}


_tracing = _Tracing()


def _reads_of(root: Any) -> CapturedValues:
    reads = _tracing.reads.get(id(root))
    if reads is not None:
        return reads
    reads = _known.get(id(root))
    if reads is None or reads.root is not root or not reads.unchanged():
        reads = _kept(CapturedValues(root))
    reads.used = next(_count)
    return reads


def _kept(reads: CapturedValues) -> CapturedValues:
    if reads.tracers:
        return reads
    with _lock:
        if len(_known) >= _MOST_KEPT:
            oldest = sorted(_known, key=lambda i: _known[i].used)
            for i in oldest[: _MOST_KEPT // 2]:
                del _known[i]
        reads.used = next(_count)
        _known[id(reads.root)] = reads
    return reads


_nothing_to_read: set[type] = {*NUMBERS, np.ndarray, np.dtype}


def _roots(value: Any, found: list[Any]) -> list[Any]:
    """Classes, functions and objects in a tree of arguments whose code, or contents, a program depends on."""
    kind = type(value)
    parts: Any = ()
    is_tree = True
    if isinstance(value, eqx.Module):
        # Its numbers are arguments of the program, and what is static in it is compared with them.
        parts = vars(value).values()
    elif isinstance(value, (jax.Array, np.generic)):  # a tracer too
        _nothing_to_read.add(kind)
    elif isinstance(value, jax.tree_util.Partial):
        parts = value.func, value.args, value.keywords
    elif isinstance(value, (tuple, list)):
        parts = value
    elif isinstance(value, dict):
        parts = value.values()
    elif not jax.tree_util.all_leaves([value]):
        own = getattr(value, "__dict__", None)
        parts = own.values() if own else jax.tree.leaves(value, is_leaf=lambda x: x is not value)
    else:
        is_tree = False
        if isinstance(value, type) or callable(value) or dataclasses.is_dataclass(value) or not is_of_library(kind):
            found.append(value)
    if is_tree and not is_of_library(kind):
        found.append(kind)
    for part in parts:
        if type(part) not in _nothing_to_read:
            _roots(part, found)
    return found


def version_of(*values: Any) -> bytes:
    """A digest of all that the code in these values reads at this moment, for the key of a program."""
    return b"".join([_forgotten, *[_reads_of(root).version for root in _roots(values, [])]])


def captured(*values: Any) -> tuple[Tracer, ...]:
    """The numbers under a trace that is under way which code in these values reads from outside: by a closure."""
    found = {id(x): x for root in _roots(values, []) for x in _reads_of(root).tracers}
    return tuple(filter(is_under_way, found.values()))


def reads_any(kind: type, *values: Any) -> bool:
    """Whether code in these values reads an object of a kind from outside: a global, or one in a closure."""
    return any(isinstance(x, kind) for root in _roots(values, []) for _, x in _reads_of(root).kept.values())


class Key(NamedTuple):
    """On what a program depends that is traced of these arguments."""

    structure: Any
    types: tuple[Any, ...]
    version: bytes
    settings: Any


def key_of(*args: Any) -> tuple[list[Any], Key]:
    """The numbers of the arguments, and the key under which what is traced of them is kept."""
    leaves, structure = jax.tree.flatten(args)
    return leaves, Key(structure, tuple(map(jax.typeof, leaves)), version_of(*args), settings())


def kept_from_a_trace(label: str) -> TypeError:
    """What is wrong where a function returns what it made in an earlier call, of other numbers."""
    return TypeError(
        f"{label}: its description returns what it has kept from an earlier call (in a global, an attribute or a "
        "cache): a motion, a frame, a point or a number that belongs to other coordinates. Make all that follows from "
        "t, q, u and the parameters anew in every call."
    )


@contextlib.contextmanager
def explain_leaked_tracer(label: str) -> Iterator[None]:
    """Where JAX meets a number of another trace, the error says what that comes from."""
    try:
        yield
    except jax.errors.UnexpectedTracerError as error:
        raise kept_from_a_trace(label) from error


def settling(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, which is being traced: what it changes itself in what it reads (a counter, a memory) is no change."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        before = [_reads_of(root) for root in _roots((args, kwargs), [])]
        outer = _tracing.reads
        _tracing.reads = {id(reads.root): reads for reads in before} | outer
        try:
            with _uncollected():
                found = f(*args, **kwargs)
        finally:
            _tracing.reads = outer
        for reads in before:
            now = _known.get(id(reads.root))
            if now is not None and now.version == reads.version and not now.unchanged():
                after = CapturedValues(reads.root)
                after.version = reads.version
                _kept(after)
        return found

    return call


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Python's search for cycles of garbage waits: a trace makes a hundred thousand objects that stay, and to look
    through them again and again takes a tenth of a first call."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def compiled(f: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit(f)`, traced again where what the code of its arguments reads has changed.

    How often it was traced, tests ask of its attribute `compiled`.
    """

    def run(version: bytes, args: Any, kwargs: Any) -> Any:
        return settling(f)(*args, **kwargs)

    run.__name__, run.__qualname__ = f.__name__, f.__qualname__  # under which programs are kept on disk
    jitted = eqx.filter_jit(run)

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        with explain_leaked_tracer(type(args[0]).__name__ if args else f.__name__):
            return jitted(version_of(args, kwargs), args, kwargs)

    vars(call)["compiled"] = jitted
    return call


def on_forget(memory: Callable[[], None]) -> None:
    """Call this function when everything is to be forgotten."""
    _memories.append(memory)


def forget() -> None:
    """Forget every compiled program, so that all is read and traced again at the next call.

        constants_of_a_library.gravity = 1.62  # nobody is told
        jk.forget()

    Changes of what a description, an input or a controller reads are noticed without it: see "What is noticed" on the
    page about speed. It is for what cannot be seen, and for functions that you compiled yourself with `jax.jit`: their
    programs are thrown away too (`jax.clear_caches`).
    """
    global _forgotten
    with _lock:
        _forgotten = b"%d" % next(_count)
        _known.clear()
    for memory in _memories:
        memory()
    jax.clear_caches()
