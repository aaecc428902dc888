"""The values that the code of functions, classes and objects reads, and whether they have changed. `cache_key` says
what is noticed. Their digest is formed once; after that, a look at every place costs some microseconds."""

from __future__ import annotations

import argparse
import collections
import contextlib
import dataclasses
import dis
import enum
import functools
import hashlib
import importlib.util
import itertools
import os
import pickle
import sys
import sysconfig
import types
import weakref
from collections.abc import Mapping
from operator import is_
from typing import Any, NamedTuple

import numpy as np

from .compat import Tracer

_LARGEST_ARRAY = 1 << 20  # [bytes] compared number by number
_MOST_PLACES = 20_000  # beyond these what a place holds is told by its identity
_MADE_BY_PYTHON = 1 << 9  # Py_TPFLAGS_HEAPTYPE
_MISSING: Any = type("_Missing", (), {"__repr__": lambda self: "missing"})()

# Libraries are taken to stay as they are. Catalogue files are descriptions like a user's.
_LIBRARIES = frozenset("jax jaxlib numpy scipy equinox jaxtyping diffrax optimistix lineax optax".split())
_INSTALLED = tuple({sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")})
# Objects of Python's library whose attributes are the user's own.
_NAMESPACES = (
    types.SimpleNamespace,
    argparse.Namespace,
    collections.ChainMap,
    collections.UserDict,
    collections.UserList,
)
NUMBERS = frozenset((type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented)))


@functools.lru_cache(maxsize=4096)
def _is_library(module: str | None) -> bool:
    """Whether a module is one whose code stays as it is: of Python, of JAX and its company, or installed."""
    name = module or "builtins"
    first = name.partition(".")[0]
    if first == "jaxkane":
        return not name.startswith("jaxkane.catalog")
    if first in _LIBRARIES or first == "__main__":  # whose file may be that of a notebook's kernel
        return first != "__main__"
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:  # made in a notebook, or built into Python
        return first in sys.stdlib_module_names
    return file.startswith(_INSTALLED)


def is_of_library(kind: type) -> bool:
    if kind.__module__ == "builtins":  # said of a class, too, that was made where there is no `__name__`
        return not kind.__flags__ & _MADE_BY_PYTHON
    return _is_library(kind.__module__)


class CapturedValues:
    """All places that the code of `root` reads, with their values; `version` is a digest of these.

    `lasting`: the digest is the same in another process, where what cannot be looked into is told by its pickle.
    """

    def __init__(self, root: Any, lasting: bool = False):
        self.root, self.lasting = root, lasting
        self.tracers: list[Tracer] = []  # what is being traced in it, and must not be held on to
        self.named: list[tuple[Mapping[str, Any], str, Any]] = []
        self.attributes: list[tuple[Any, str, Any]] = []
        self.cells: list[tuple[types.CellType, Any]] = []
        self.functions: list[tuple[types.FunctionType, Any, Any, Any]] = []
        self.sequences: list[tuple[Any, tuple[Any, ...]]] = []
        self.mappings: list[tuple[Mapping[Any, Any], tuple[Any, ...], tuple[Any, ...]]] = []
        self.arrays: list[tuple[np.ndarray, np.ndarray]] = []
        walk = _Walk(self)
        walk.value(root)
        walk.into_modules()
        self.version = walk.sha.digest()
        self.seen = walk.seen  # an identity means nothing once its object is gone

    def unchanged(self) -> bool:
        """Whether every place still has its value."""
        try:
            for names, name, value in self.named:
                if names.get(name, _MISSING) is not value:
                    return False
            for f, code, defaults, more in self.functions:
                if f.__code__ is not code or f.__defaults__ is not defaults or f.__kwdefaults__ is not more:
                    return False
            for mapping, keys, values in self.mappings:
                present = tuple(mapping.values())
                if len(present) != len(values) or not all(map(is_, present, values)) or tuple(mapping) != keys:
                    return False
            return (
                all(_inside(cell) is value for cell, value in self.cells)
                and all(getattr(x, name, _MISSING) is value for x, name, value in self.attributes)
                and all(len(x) == len(items) and all(map(is_, tuple(x), items)) for x, items in self.sequences)
                and all(_same_numbers(array, copy) for array, copy in self.arrays)
            )
        except RuntimeError:  # a dict or a set that another thread is changing
            return False


def _inside(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # still empty
        return _MISSING


def _same_numbers(array: np.ndarray, copy: np.ndarray) -> bool:
    return array.shape == copy.shape and array.dtype == copy.dtype and _bytes(array) == _bytes(copy)


def _bytes(array: np.ndarray) -> tuple[bytes, bytes]:
    """Of its numbers, and of its mask where it has one."""
    return np.ma.getdata(array).tobytes(), np.ma.getmask(array).tobytes()


class _Walk:
    """Goes from a root to everything that its code reads, noting the places and hashing what stands there."""

    def __init__(self, captured: CapturedValues):
        self.captured = captured
        self.sha = hashlib.blake2b(digest_size=16)
        self.seen: dict[Any, tuple[int, Any]] = {}
        self.depth = 0
        self.names: set[str] = set()  # in all the code: of a module, what these name is read
        self.modules: list[types.ModuleType] = []

    def add(self, *words: Any) -> None:
        for word in words:
            data = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(b"%d:" % len(data))
            self.sha.update(data)

    def is_new(self, key: Any, keep: Any) -> bool:
        if key in self.seen:
            self.add("again", self.seen[key][0])
            return False
        self.seen[key] = len(self.seen), keep
        return True

    def value(self, value: Any) -> None:
        kind = type(value)
        if kind in NUMBERS:
            self.add(kind.__name__, value if kind is bytes else repr(value))
        elif isinstance(value, types.ModuleType):
            self.add("module", value.__name__)
            if not _is_library(value.__name__) and self.is_new(id(value), value):
                self.modules.append(value)
        elif self.is_new(id(value), value):
            if self.depth > 100 or len(self.seen) > _MOST_PLACES:
                return self.opaque(value)
            self.depth += 1
            self.composite(value)
            self.depth -= 1

    def composite(self, value: Any) -> None:
        if isinstance(value, types.FunctionType):
            self.function(value)
        elif isinstance(value, type):
            self.a_class(value)
        elif isinstance(value, (types.MethodType, staticmethod, classmethod)):
            self.parts("method", (value.__func__, getattr(value, "__self__", None)))
        elif isinstance(value, property):
            self.parts("property", (value.fget, value.fset))
        elif isinstance(value, (functools.partial, functools.partialmethod)):
            self.parts("partial", (value.func, value.args, value.keywords))
        elif isinstance(value, functools.cached_property):
            self.parts("property", (value.func,))
        elif isinstance(value, Tracer):
            self.captured.tracers.append(value)
            self.opaque(value)
        elif isinstance(value, np.ndarray):
            self.array(value)
        elif isinstance(value, np.generic):
            self.add("number", value.dtype.str, value.tobytes())
        elif isinstance(value, (list, tuple, set, frozenset, collections.deque)):
            self.add(type(value).__qualname__)
            if not isinstance(value, (tuple, frozenset)):
                self.captured.sequences.append((value, tuple(value)))
            is_set = isinstance(value, (set, frozenset))  # whose order differs from process to process
            self.parts("items", tuple(sorted(value, key=repr) if is_set else value))
            self.own(value)
        elif isinstance(value, (dict, types.MappingProxyType)):
            self.mapping(value)
            self.own(value)
        elif isinstance(value, enum.Enum):
            self.parts("enum", (type(value).__qualname__, value.name, value.value))
        else:
            self.an_object(value)

    def parts(self, kind: str, parts: tuple[Any, ...]) -> None:
        self.add(kind, len(parts))
        for part in parts:
            self.value(part)

    def mapping(self, mapping: Mapping[Any, Any]) -> None:
        items = tuple(mapping.items())
        self.captured.mappings.append((mapping, tuple(k for k, _ in items), tuple(v for _, v in items)))
        for key, value in items:
            self.parts("entry", (key, value))

    def into_modules(self) -> None:
        """Of modules that are no libraries, what the code names, wherever in it: `constants.gravity` may be read by a
        function that is given `constants`."""
        self.depth = 0
        read = -1
        while read < len(self.seen):  # what stands there may be code with more names, and other modules
            read = len(self.seen)
            for module in tuple(self.modules):
                for name in sorted(self.names & vars(module).keys()):
                    self.place(vars(module), name)

    def place(self, where: dict[str, Any], name: str) -> None:
        """What stands in a dict of globals, or of modules, by name."""
        if self.is_new((id(where), name), None):
            value = where.get(name, _MISSING)
            self.captured.named.append((where, name, value))
            self.add(name)
            self.value(value)

    def function(self, f: types.FunctionType) -> None:
        self.add("function", f.__qualname__)
        self.captured.functions.append((f, f.__code__, f.__defaults__, f.__kwdefaults__))
        cells = f.__closure__ or ()
        if _is_library(f.__globals__.get("__name__") or "__main__"):
            # Of a library's decorator, what it decorates; IPython's autoreload changes the attribute, not the closure.
            self.captured.named.append((vars(f), "__wrapped__", vars(f).get("__wrapped__", _MISSING)))
            inside = [_inside(cell) for cell in cells] + [vars(f).get("__wrapped__")]
            self.parts("decorates", tuple(x for x in inside if callable(x)))
            return
        self.code(f.__code__)
        read = _names_of(f.__code__)
        self.names |= read.names
        for name in read.globals:
            self.place(f.__globals__, name)
        for level, name in read.imported:
            if module := _absolute(level, name, f.__globals__):
                self.place(sys.modules, module)
        for cell in cells:
            value = _inside(cell)
            self.captured.cells.append((cell, value))
            self.value(value)
        self.parts("defaults", (f.__defaults__, f.__kwdefaults__))
        if vars(f):
            self.mapping(vars(f))

    def code(self, code: types.CodeType) -> None:
        self.add("code", code.co_code, *code.co_names, "|", *code.co_varnames, "|", *code.co_freevars)
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self.code(constant)
            else:
                is_set = isinstance(constant, frozenset)
                self.add(type(constant).__name__, sorted(map(repr, constant)) if is_set else repr(constant))

    def a_class(self, cls: type) -> None:
        self.add("class", cls.__module__, cls.__qualname__)
        for base in cls.__mro__:
            own = vars(base)
            if is_of_library(base):
                continue
            self.captured.mappings.append((own, tuple(own), tuple(own.values())))
            for name, value in tuple(own.items()):
                plain = not (name.startswith("__") and name.endswith("__")) and name != "_abc_impl"
                if plain or (isinstance(value, types.FunctionType) and value.__code__.co_filename != "<string>"):
                    self.add(name)
                    self.value(value)

    def array(self, array: np.ndarray) -> None:
        if array.dtype == object:
            self.captured.sequences.append((array, tuple(array)))
            return self.parts("objects", (array.shape, *array.flat))
        if array.nbytes > _LARGEST_ARRAY or array.dtype.hasobject:
            return self.opaque(array)
        self.captured.arrays.append((array, array.copy()))
        self.add("array", array.dtype.str, array.shape, *_bytes(array))

    def an_object(self, thing: Any) -> None:
        kind = type(thing)
        if not is_of_library(kind) or kind in _NAMESPACES:
            self.add("object")
            return self.own(thing)
        attributes = getattr(thing, "__dict__", None)
        wrapped = attributes.get("__wrapped__") if isinstance(attributes, dict) else None
        if isinstance(attributes, dict) and dataclasses.is_dataclass(thing):
            self.add("object", kind.__qualname__)
            self.mapping(attributes)
        elif wrapped is not None:  # a function that is compiled, or remembers
            self.parts("wrapper", (wrapped,))
        else:
            self.opaque(thing)

    def own(self, thing: Any) -> None:
        """The class and the attributes of an object that is no library's."""
        kind = type(thing)
        if is_of_library(kind) and kind not in _NAMESPACES:
            return
        self.value(kind)
        if isinstance(attributes := getattr(thing, "__dict__", None), dict):
            self.mapping(attributes)
        for base in kind.__mro__:
            for name, member in vars(base).items():
                if isinstance(member, types.MemberDescriptorType) and not is_of_library(base):
                    value = getattr(thing, name, _MISSING)
                    self.captured.attributes.append((thing, name, value))
                    self.parts("slot", (name, value))

    def opaque(self, thing: Any) -> None:
        """What cannot be looked into is told by which object it is, or by its pickle."""
        which: Any = None
        if not self.captured.lasting:
            which = _serial(thing)
        else:
            with contextlib.suppress(Exception):  # a lock, a stream: it has no numbers
                which = pickle.dumps(thing)
        self.add("opaque", type(thing).__qualname__, which)


class _Names(NamedTuple):
    """Of a function's code: the globals that it reads; the modules that it imports, with the number of dots before
    each; and all names in it."""

    globals: tuple[str, ...]
    imported: tuple[tuple[int, str], ...]
    names: frozenset[str]


@functools.lru_cache(maxsize=1024)
def _names_of(code: types.CodeType) -> _Names:
    read: dict[str, None] = {}
    imported: dict[tuple[int, str], None] = {}
    names: set[str] = set()
    codes = [code]
    while codes:
        now = codes.pop()
        names |= {*now.co_names, *now.co_varnames, *now.co_freevars}
        codes += [c for c in now.co_consts if isinstance(c, types.CodeType)]
        constants: list[Any] = []
        for i in dis.get_instructions(now):
            if i.opname in ("LOAD_GLOBAL", "LOAD_NAME"):  # the latter in the body of a class
                read[i.argval] = None
            elif i.opname == "IMPORT_NAME":
                level, of_it = constants[-2:]
                of_it = [f"{i.argval}.{name}".removeprefix(".") for name in of_it or ()]  # modules too, some of them
                imported.update(dict.fromkeys((level, name) for name in (i.argval, *of_it)))
            elif i.opname in ("LOAD_CONST", "LOAD_SMALL_INT"):
                constants.append(i.argval)
    return _Names(tuple(name for name in read if not name.startswith("__")), tuple(imported), frozenset(names))


def _absolute(level: int, name: str, where: dict[str, Any]) -> str | None:
    """The whole name of a module that code imports, whose globals are `where`; None where that belongs to a library."""
    if level:
        package = where.get("__package__") or where.get("__name__", "").rpartition(".")[0]
        try:
            name = importlib.util.resolve_name("." * level + name, package)
        except ImportError:
            return None
    return None if name in sys.modules and _is_library(name) else name


_serials: dict[int, tuple[Any, int]] = {}
_count = itertools.count()


def _serial(thing: Any) -> int:
    """A number that no other object has had or will have, unlike its `id`."""
    known = _serials.get(id(thing))
    if known is not None and known[0]() is thing:
        return known[1]
    number, place = next(_count), id(thing)
    try:
        reference = weakref.ref(thing, lambda gone: _gone(place, gone))
    except TypeError:  # one that has no weak references is another every time
        return number
    _serials[place] = reference, number
    return number


def _gone(place: int, reference: Any) -> None:
    known = _serials.get(place)
    if known is not None and known[0] is reference:
        _serials.pop(place, None)
