"""What is noticed when code or data change: a program is traced again where its cache key differs, and nowhere else.

1. A key is the structure, shapes and dtypes of the arguments, with all that is static in them;
2. the settings of JAX on which a trace depends: precision, promotion, checks for NaN;
3. and a digest of what the code in the arguments reads: globals, closures, defaults, attributes of classes, of objects
   and of modules, lists, dicts and arrays among these, modules that it imports, and the functions that it calls.
4. A look costs some microseconds; the digest is formed anew only where a look sees another value.
5. A value that comes back finds its program again. Mutations made while tracing do not invalidate the trace.
6. Not noticed: the environment, files, objects of libraries and C extensions, names put together for `getattr`,
7. arrays above a megabyte that are changed in place, the inside of what holds more than 20 000 objects,
8. and what a function read that was compiled by `jax.jit` outside of this library.
9. For these there is `jk.forget()`. Better: make a parameter of what changes, and nothing is compiled again.
10. Keys and programs are kept in `Cache`: a bounded number, shared by threads, and no arguments.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import gc
import itertools
import threading
import weakref
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .captured_values import NUMBERS, CapturedValues, is_of_library
from .compat import Tracer, is_under_way, settings

_MISSING = object()
_count = itertools.count()
_forgotten = b"0"


class Cache:
    """Results by key, of which those go first that were used least recently. `forget` empties every cache."""

    _all: weakref.WeakSet[Cache] = weakref.WeakSet()
    _all_lock = threading.Lock()

    def __init__(self, size: int = 256) -> None:
        self.size = size
        self._results: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._lock = threading.RLock()  # a key may compare by code that asks a cache
        with Cache._all_lock:
            Cache._all.add(self)

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The result of a key; the first time it is made, and kept unless that fails."""
        result = self.known(key)
        return self.keep(key, make()) if result is _MISSING else result

    def known(self, key: Hashable, default: Any = _MISSING) -> Any:
        with self._lock:
            if key not in self._results:
                return default
            self._results.move_to_end(key)
            return self._results[key]

    def keep(self, key: Hashable, result: Any) -> Any:
        with self._lock:
            self._results[key] = result
            self._results.move_to_end(key)
            if len(self._results) > self.size:
                self._results.popitem(last=False)
        return result

    def __len__(self) -> int:
        return len(self._results)

    def clear(self) -> None:
        with self._lock:
            self._results.clear()

    @classmethod
    def clear_all(cls) -> None:
        with cls._all_lock:
            caches = list(cls._all)
        for cache in caches:
            cache.clear()


_captured = Cache()  # by the identity of the root, which its entry keeps alive


class _Tracing(threading.local):
    """What is being traced in this thread: a trace belongs to the values that were captured when it began."""

    def __init__(self) -> None:
        self.captured: dict[int, CapturedValues] = {}


_tracing = _Tracing()


def _captured_by(root: Any) -> CapturedValues:
    values = _tracing.captured.get(id(root))
    if values is not None:
        return values
    values = _captured.known(id(root), None)
    if values is None or values.root is not root or not values.unchanged():
        values = CapturedValues(root)
        if not values.tracers:
            _captured.keep(id(root), values)
    return values


_nothing_to_read: set[type] = {*NUMBERS, np.ndarray, np.dtype}


def _roots(value: Any, roots: list[Any]) -> list[Any]:
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
            roots.append(value)
    if is_tree and not is_of_library(kind):
        roots.append(kind)
    for part in parts:
        if type(part) not in _nothing_to_read:
            _roots(part, roots)
    return roots


def version_of(*values: Any) -> bytes:
    """A digest of all that the code in these values reads at this moment, for the key of a program."""
    return b"".join([_forgotten, *[_captured_by(root).version for root in _roots(values, [])]])


def captured_tracers(*values: Any) -> tuple[Tracer, ...]:
    """The numbers under a trace that is under way which code in these values reads from outside: by a closure."""
    tracers = {id(x): x for root in _roots(values, []) for x in _captured_by(root).tracers}
    return tuple(filter(is_under_way, tracers.values()))


def captures_any(kind: type, *values: Any) -> bool:
    """Whether code in these values reads an object of a kind from outside: a global, or one in a closure."""
    return any(isinstance(x, kind) for root in _roots(values, []) for _, x in _captured_by(root).seen.values())


class CacheKey(NamedTuple):
    """On what a program depends that is traced of some arguments."""

    structure: Any
    types: tuple[Any, ...]
    version: bytes
    settings: Any


def key_of(*args: Any) -> tuple[list[Any], CacheKey]:
    """The numbers of the arguments, and the key under which what is traced of them is kept."""
    leaves, structure = jax.tree.flatten(args)
    return leaves, CacheKey(structure, tuple(map(jax.typeof, leaves)), version_of(*args), settings())


def leaked_tracer(label: str) -> TypeError:
    """The error where a function returns what it made in an earlier call, of other numbers."""
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
        raise leaked_tracer(label) from error


def trace_with_snapshot(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, to be traced: mutations that it makes itself in what it reads (a counter, a list) are no change."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        before = [_captured_by(root) for root in _roots((args, kwargs), [])]
        outer = _tracing.captured
        _tracing.captured = {id(values.root): values for values in before} | outer
        try:
            with _uncollected():
                result = f(*args, **kwargs)
        finally:
            _tracing.captured = outer
        for values in before:
            stored = _captured.known(id(values.root), None)
            if stored is not None and stored.version == values.version and not stored.unchanged():
                after = CapturedValues(values.root)
                after.version = values.version
                if not after.tracers:
                    _captured.keep(id(values.root), after)
        return result

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


def with_room(f: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """`f(*args, **kwargs)`, with memory for the frames of some ten thousand calls of Python.

    Python takes such memory from the system in pieces of 16 kB, and gives one back when the call returns that needed
    it first: a loop that calls from near the end of a piece has memory mapped and unmapped in each turn. As deep as
    JAX traces, that took an eighth of a first derivative. The frame of this function needs a large piece, of which it
    leaves the half to others.
    """
    return f(*args, **kwargs)


with_room.__code__ = with_room.__code__.replace(co_stacksize=1 << 18)


def jit(f: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit(f)` with one more static argument, `version_of` the others.

    How often it was traced, tests ask of its attribute `jitted`.
    """

    def run(version: bytes, args: Any, kwargs: Any) -> Any:
        return trace_with_snapshot(f)(*args, **kwargs)

    run.__name__, run.__qualname__ = f.__name__, f.__qualname__  # under which programs are kept on disk
    jitted = eqx.filter_jit(run)

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        with explain_leaked_tracer(type(args[0]).__name__ if args else f.__name__):
            return with_room(jitted, version_of(args, kwargs), args, kwargs)

    vars(call)["jitted"] = jitted
    return call


def forget() -> None:
    """Forget every compiled program, so that all is read and traced again at the next call.

        constants_of_a_library.gravity = 1.62  # nobody is told
        jk.forget()

    Changes of what a description, an input or a controller reads are noticed without it: see the page "What is
    noticed". It is for what cannot be seen, and for functions that you compiled yourself with `jax.jit`: their
    programs are thrown away too (`jax.clear_caches`).
    """
    global _forgotten
    _forgotten = b"%d" % next(_count)
    Cache.clear_all()
    jax.clear_caches()
