"""Cache keys of programs. A program is traced again if its key differs, and only then.

A key contains

1. the structure, shapes and dtypes of the arguments, and their static values,
2. the settings of JAX on which a trace depends: precision, promotion, checks for NaN,
3. a digest of the values that the code in the arguments uses (`CapturedValues`; see `docs/caching.md`).

A check takes some microseconds. The digest is computed again only if a value has changed. If a value changes back, the
earlier program is used again. Mutations during tracing do not invalidate the trace. Programs are kept in `Cache`,
without the arguments. They are freed with the functions and controllers of the trace, or as the least recently used.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import threading
import types
import weakref
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .cache import Cache, owners_of
from .compat import Tracer, filter_jit_uncached, is_under_way, settings, storable_checks
from .digest import NUMBERS, CapturedValues, is_of_library

_count = itertools.count()
_forgotten = b"0"
_captured = Cache()  # by the identity of the root


class _Tracing(threading.local):
    captured: Mapping[int, CapturedValues] = {}  # at the start of the current traces of this thread; not mutated


_tracing = _Tracing()


def _captured_by(root: object) -> CapturedValues:
    values = _tracing.captured.get(id(root))
    if values is not None:
        return values
    values = _stored(root)
    if values is None or not values.unchanged(root):
        values = CapturedValues(root)
        _store(root, values)
    return values


def _stored(root: object) -> CapturedValues | None:
    return _captured.known(id(root), (None, None))[0]


def _store(root: object, values: CapturedValues) -> None:
    if not values.tracers:
        owners = owners_of(root)
        _captured.keep(id(root), (values, None if owners else root), owners)


_nothing_to_read: set[type] = {*NUMBERS, np.ndarray, np.dtype}


def _roots(value: object, roots: list[Any]) -> list[Any]:
    """Classes, functions and objects in a tree of arguments whose code, or contents, a program depends on."""
    kind = type(value)
    parts: Any = ()
    is_tree = True
    if isinstance(value, eqx.Module):
        # Its arrays are arguments of the program, and its static fields are compared with them.
        parts = vars(value).values()
    elif isinstance(value, (jax.Array, np.generic)):  # also tracers
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
        if isinstance(value, types.MethodType):
            # Each access makes a new method object, so its function and its object identify it.
            parts = value.__func__, value.__self__
        elif isinstance(value, type) or callable(value) or dataclasses.is_dataclass(value) or not is_of_library(kind):
            roots.append(value)
    if is_tree and not is_of_library(kind):
        roots.append(kind)
    for part in parts:
        if type(part) not in _nothing_to_read:
            _roots(part, roots)
    return roots


def version_of(*values: Any) -> bytes:
    """A digest of all values that the code in these values reads at this moment, for the key of a program."""
    return b"".join([_forgotten, *[_captured_by(root).version for root in _roots(values, [])]])


def captured_tracers(*values: Any) -> tuple[Tracer, ...]:
    """The tracers of unfinished traces that code in these values reads from outside, by a closure."""
    tracers = {id(x): x for root in _roots(values, []) for x in _captured_by(root).tracers}
    return tuple(filter(is_under_way, tracers.values()))


def captures_any(kind: type, *values: Any) -> bool:
    """Whether code in these values reads an object of a kind from outside: a global, or one in a closure."""
    return any(isinstance(x, kind) for root in _roots(values, []) for _, x in _captured_by(root).seen.values())


class CacheKey(NamedTuple):
    """Everything on which a traced program depends, except the numbers in its arguments."""

    structure: Any
    types: tuple[Any, ...]
    version: bytes
    settings: Any


def key_of(*args: Any) -> tuple[list[Any], CacheKey]:
    """The arrays of the arguments, and the key under which their programs are stored."""
    leaves, structure = jax.tree.flatten(args)
    # Not `jax.typeof`: it also looks up the sharding, on which no program here depends. 1 us for each parameter.
    types = tuple([x.aval if isinstance(x, jax.Array) else jax.typeof(x) for x in leaves])
    return leaves, CacheKey(structure, types, version_of(*args), settings())


def leaked_tracer(label: str) -> TypeError:
    """The exception if a function returns a value that it made in an earlier call, from other numbers."""
    return TypeError(
        f"{label}: its description returns a motion, a frame, a point or a number of an earlier call, which it has "
        "stored in a global, an attribute or a cache. It belongs to other coordinates. Compute everything that depends "
        "on t, q, u and the parameters again in every call."
    )


@contextlib.contextmanager
def explain_leaked_tracer(label: str) -> Iterator[None]:
    """Replace JAX's exception for a tracer of another trace by one that names the cause."""
    try:
        yield
    except jax.errors.UnexpectedTracerError as error:
        raise leaked_tracer(label) from error


def trace_with_snapshot(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, to be traced: its own changes of values that it reads (a counter, a list) do not count as changes."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        before = [(root, _captured_by(root)) for root in _roots((args, kwargs), [])]
        outer = _tracing.captured
        _tracing.captured = {id(root): values for root, values in before} | {**outer}
        try:
            with storable_checks():
                result = f(*args, **kwargs)
        finally:
            _tracing.captured = outer
        for root, values in before:
            stored = _stored(root)
            if stored is not None and stored.version == values.version and not stored.unchanged(root):
                after = CapturedValues(root)
                after.version = values.version
                _store(root, after)
        return result

    return call


class _Compiled:
    """One program of a function, compiled by `eqx.filter_jit`.

    JAX's caches keep a compiled function and its static arguments longer than its program. Therefore the compiled
    function refers to this object only by a weak reference, and has arrays as its only arguments.
    """

    def __init__(self, f: Callable[..., Any], structure: PyTree, fixed: list[Callable[[], Any] | None]) -> None:
        self.f, self.structure, self.fixed = f, structure, fixed
        itself = weakref.ref(self)

        def run(arrays: list[Any]) -> PyTree:
            return cast(_Compiled, itself()).traced(arrays)

        run.__name__, run.__qualname__ = f.__name__, f.__qualname__  # the name of programs that are stored on disk
        self.run = filter_jit_uncached(run)

    def traced(self, arrays: list[Any]) -> PyTree:
        remaining = iter(arrays)
        args, kwargs = jax.tree.unflatten(self.structure, [next(remaining) if x is None else x() for x in self.fixed])
        return trace_with_snapshot(self.f)(*args, **kwargs)


def _static(x: object) -> tuple[Hashable, Callable[[], Any], list[Any]]:
    """For a static leaf of the arguments: its part of the key, a function that returns it, and its owners. Programs are
    freed with their owners."""
    if isinstance(x, types.MethodType) and owners_of(x.__self__):
        return (id(x.__self__), id(x.__func__)), weakref.WeakMethod(x), [x.__self__, x.__func__]
    if type(x).__hash__ in (object.__hash__, None):  # None: a dataclass that is not frozen
        owners = owners_of(x)
        return id(x), weakref.ref(x) if owners else lambda: x, owners
    return (type(x), x), lambda: x, []


def _key_with_functions(args: PyTree) -> tuple[list[Any], Any, list[Any], Hashable, list[Any]]:
    """The arrays of arguments that may contain functions, their structure, the static leaves (see `_static`; None for
    arrays), the key of their programs, and the owners of the key."""
    leaves, structure = jax.tree.flatten(args)
    arrays = [x for x in leaves if eqx.is_array(x)]
    static = [None if eqx.is_array(x) else _static(x) for x in leaves]
    names, types_of_arrays = tuple(x and x[0] for x in static), tuple(map(jax.typeof, arrays))
    key = (structure, names, types_of_arrays, version_of(args), settings())
    return arrays, structure, static, key, [owner for x in static if x for owner in x[2]]


def kept(cache: Cache, args: PyTree, make: Callable[[], Any]) -> Any:
    """A result that depends on the code and the types of `args`, but not on numbers; computed once and kept in
    `cache`."""
    *_, key, owners = _key_with_functions(args)
    return cache.get(key, make, owners)


def jit(f: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit(f)` with a program for each key (see above), in the `Cache` that is its attribute
    `programs`."""
    programs = Cache(programs=True)

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        arrays, structure, static, key, owners = _key_with_functions((args, kwargs))
        program = programs.get(key, lambda: _Compiled(f, structure, [x and x[1] for x in static]), owners)
        with explain_leaked_tracer(type(args[0]).__name__ if args else f.__name__):
            return program.run(arrays)

    vars(call)["programs"] = programs
    return call


def forget() -> None:
    """Free every compiled program, so that everything is traced again at the next call.

        constants_of_a_library.gravity = 1.62  # is not detected
        jk.forget()

    Most changes of values that a system, an input or a controller uses are detected automatically. The page
    "Recompilation and caching" lists them. The programs of functions that you compiled with `jax.jit` are freed too
    (`jax.clear_caches`).
    """
    global _forgotten
    _forgotten = b"%d" % next(_count)
    for cache in Cache.all():
        cache.clear()
    jax.clear_caches()
