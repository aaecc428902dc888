"""Digests: of the values that the code of functions, classes and objects uses, and of data and programs.

`CapturedValues` visits every place once and computes a digest of the values. Later checks only compare each place with
its earlier value, which takes some microseconds. `docs/caching.md` lists the values whose contents are compared. Every
other object is identified by `_serial`: replacing it is detected, a change inside it is not. The digests of `digest`
outlive a process.
"""

from __future__ import annotations

import dataclasses
import dis
import enum
import functools
import hashlib
import itertools
import os
import pickle
import re
import sys
import sysconfig
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter, is_
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .cache import Cache, owners_of
from .compat import ClosedJaxpr, Tracer

_LARGEST_ARRAY = 1 << 20  # [bytes] compared number by number
_MOST_PLACES = 20_000  # beyond this number, objects are identified without their contents
_MADE_BY_PYTHON = 1 << 9  # Py_TPFLAGS_HEAPTYPE
_ROOT = object()
_MISSING: Any = type("_Missing", (), {"__repr__": lambda self: "missing"})()

# Code of libraries is assumed not to change. Catalogue files are systems like those of a user.
_LIBRARIES = frozenset("jax jaxlib numpy scipy equinox jaxtyping diffrax optimistix lineax optax".split())
_INSTALLED = tuple({sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")})
NUMBERS = frozenset((type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented)))

# Objects that call a function, and their attributes for the function and its arguments.
_WRAPPERS = types.MethodType, types.BuiltinMethodType, staticmethod, classmethod, property, functools.partial
_WRAPPED = ("__func__", "__self__", "fget", "func", "args", "keywords")


@functools.lru_cache(maxsize=4096)
def _is_library(module: str | None) -> bool:
    """Whether a module is part of Python, installed, or part of JAX."""
    name = module or "builtins"
    first = name.partition(".")[0]
    if first == "jaxkane":
        return not name.startswith("jaxkane.catalog")
    if first in _LIBRARIES or first == "__main__":  # the file of __main__ may be that of a notebook's kernel
        return first != "__main__"
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:  # defined in a notebook, or built into Python
        return first in sys.stdlib_module_names
    return file.startswith(_INSTALLED)


def is_of_library(kind: type) -> bool:
    if kind.__module__ == "builtins":  # also the module of a class that was defined without a `__name__`
        return not kind.__flags__ & _MADE_BY_PYTHON
    return _is_library(kind.__module__)


# The parts of a function that autoreload replaces.
_definition_of = attrgetter("__code__", "__defaults__", "__kwdefaults__")


def _items_of(mapping: Mapping[Any, Any]) -> tuple[Any, ...]:
    return *mapping, *mapping.values()


def _inside(cell: types.CellType) -> tuple[Any, ...]:
    try:
        return (cell.cell_contents,)
    except ValueError:  # still empty
        return ()


def _numbers_of(array: np.ndarray) -> tuple[Any, ...]:
    """The numbers of an array, and its mask if it has one."""
    return array.dtype.str, str(array.shape), np.ma.getdata(array).tobytes(), np.ma.getmask(array).tobytes()


def _add_words(sha: Any, *words: object) -> None:
    for word in words:
        data = word if isinstance(word, bytes) else str(word).encode()
        sha.update(b"%d:%b" % (len(data), data))  # with its length: ("ab", "c") differs from ("a", "bc")


def _wrapped_with_rule(f: Any) -> tuple[Any, ...]:
    """The decorated function; of `jax.custom_jvp`, also its rule."""
    return f.__wrapped__, vars(f).get("jvp")


class CapturedValues:
    """All places that the code of `root` uses, with their values. The constructor visits every place, records it and
    adds its value to a digest.

    root: a function, class or object. No reference to it is kept, so that a cache does not extend its lifetime.
    lasting: whether the digest is the same in another process. Other objects are then pickled.
    version: the digest.
    seen: every object that was visited, by identity. An identity is unique only while the object exists.
    tracers: traced values among these.
    """

    def __init__(self, root: object, lasting: bool = False):
        self.root, self.lasting = root, lasting
        self.sha = hashlib.blake2b(digest_size=16)
        self.add = functools.partial(_add_words, self.sha)
        self.seen: dict[Any, tuple[int, Any]] = {}
        self.named: list[tuple[dict[str, Any], str, Any]] = []
        self.places: list[tuple[Callable[[Any], tuple[Any, ...]], Any, tuple[Any, ...]]] = []
        self.arrays: list[tuple[np.ndarray, tuple[Any, ...]]] = []
        self.tracers: list[Tracer] = []
        self.names: set[str] = set()  # in all the code; only attributes of modules with these names are read
        self.modules: list[types.ModuleType] = []
        self.walk(root)
        # A function that receives `constants` as an argument may use `constants.gravity`.
        n_seen = -1
        while n_seen < len(self.seen):  # an attribute may be code with more names, or another module
            n_seen = len(self.seen)
            for module in tuple(self.modules):
                for name in sorted(self.names & vars(module).keys()):
                    self.walk(*self.place(vars(module), name))
        self.version = self.sha.digest()
        del self.root

    def unchanged(self, root: object) -> bool:
        """Whether every place still has its value."""
        try:
            for names, name, before in self.named:
                if names.get(name, _MISSING) is not before:
                    return False
            for read, thing, before in self.places:
                now = read(root if thing is _ROOT else thing)
                if len(now) != len(before) or not all(map(is_, now, before)):
                    return False
            return all(_numbers_of(array) == before for array, before in self.arrays)
        except RuntimeError:  # a dict or a set that another thread is changing
            return False

    def is_new(self, key: object, keep: object) -> bool:
        if key in self.seen:
            self.add("again", self.seen[key][0])
            return False
        self.seen[key] = len(self.seen), None if keep is self.root else keep
        return True

    def read(self, read: Callable[[Any], tuple[Any, ...]], thing: object) -> tuple[Any, ...]:
        """The values at a place, which is recorded."""
        values = read(thing)
        self.places.append((read, _ROOT if thing is self.root else thing, values))
        return values

    def walk(self, *values: Any) -> None:
        """Visit values and everything that they contain, in the order of a recursion."""
        waiting = [*reversed(values)]
        while waiting:
            value = waiting.pop()
            kind = type(value)
            if kind in NUMBERS:
                self.add(kind.__name__, value if kind is bytes else repr(value))
            elif isinstance(value, types.ModuleType):
                self.add("module", value.__name__)
                if not _is_library(value.__name__) and self.is_new(id(value), value):
                    self.modules.append(value)
            elif self.is_new(id(value), value):
                parts = self.parts(value) if len(self.seen) <= _MOST_PLACES else self.opaque(value)
                self.add(kind.__qualname__, len(parts))
                waiting += reversed(parts)

    def parts(self, value: object) -> Sequence[Any]:
        """The values that an object contains or uses, and what identifies it."""
        if isinstance(value, types.FunctionType):
            return self.function(value)
        if isinstance(value, type):
            return self.a_class(value)
        if isinstance(value, Tracer):
            self.tracers.append(value)
            return self.opaque(value)
        if isinstance(value, _WRAPPERS):
            return getattr(value, "__name__", ""), *(getattr(value, name, None) for name in _WRAPPED)
        if isinstance(value, np.ndarray) and value.nbytes <= _LARGEST_ARRAY and not value.dtype.hasobject:
            self.arrays.append((value, numbers := _numbers_of(value)))
            return numbers
        if isinstance(value, np.generic):
            return value.dtype.str, value.tobytes()
        if isinstance(value, (list, tuple, set, frozenset, dict)):
            return *self.items(value), *self.attributes(value)
        if _has_attributes(value):
            return self.attributes(value)
        if callable(getattr(value, "__dict__", {}).get("__wrapped__")):  # `jax.jit(f)`
            return self.read(_wrapped_with_rule, value)
        return self.opaque(value)

    def items(self, container: Collection[Any]) -> Sequence[Any]:
        if isinstance(container, (tuple, frozenset)):
            items = tuple(container)
        else:
            items = self.read(_items_of if isinstance(container, dict) else tuple, container)
        # the order of a set differs between processes
        return sorted(items, key=repr) if isinstance(container, (set, frozenset)) else items

    def attributes(self, thing: object) -> Sequence[Any]:
        """The class of an object of the user, and its attributes."""
        kind = () if is_of_library(type(thing)) else (type(thing),)
        return *kind, *(self.items(vars(thing)) if _has_attributes(thing) else ())

    def place(self, namespace: dict[str, Any], name: str) -> tuple[Any, ...]:
        """A name in a dict of globals, or of modules, with its value; nothing if it was visited."""
        if not self.is_new((id(namespace), name), None):
            return ()
        self.named.append((namespace, name, value := namespace.get(name, _MISSING)))
        return name, value

    def function(self, f: types.FunctionType) -> Sequence[Any]:
        inside = [x for cell in f.__closure__ or () for x in self.read(_inside, cell)]
        if _is_library(f.__globals__.get("__name__") or "__main__"):
            # Follow a library's decorator to the decorated function. IPython's autoreload changes the attribute, not
            # the closure.
            each = [y for x in inside for y in (x if isinstance(x, tuple) else (x,))]  # rules of `custom_jvp.defjvps`
            return f.__qualname__, *self.place(vars(f), "__wrapped__"), *filter(callable, each)
        code, *defaults = self.read(_definition_of, f)
        self.code(code)
        of_globals, imported, names = _names_of(code)
        self.names |= names
        places = [self.place(f.__globals__, name) for name in of_globals]
        places += [
            self.place(sys.modules, name) for name in imported if not (name in sys.modules and _is_library(name))
        ]
        own = self.items(vars(f)) if vars(f) else ()
        return f.__qualname__, *itertools.chain(*places), *inside, *defaults, *own

    def code(self, code: types.CodeType) -> None:
        self.add(code.co_code, *code.co_names, "|", *code.co_varnames, "|", *code.co_freevars)
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                self.code(constant)
            else:
                is_set = isinstance(constant, frozenset)
                self.add(type(constant).__name__, sorted(map(repr, constant)) if is_set else repr(constant))

    def a_class(self, cls: type) -> Sequence[Any]:
        parts: list[Any] = [cls.__module__, cls.__qualname__]
        for base in cls.__mro__:
            if is_of_library(base):
                continue
            self.read(_items_of, vars(base))
            for name, value in tuple(vars(base).items()):
                plain = not (name.startswith("__") and name.endswith("__")) and name != "_abc_impl"
                if plain or (isinstance(value, types.FunctionType) and value.__code__.co_filename != "<string>"):
                    parts += name, value
        return parts

    def opaque(self, thing: object) -> Sequence[Any]:
        """What identifies an object whose contents are not compared."""
        if not self.lasting:
            return (_serial(thing),)
        try:
            return (pickle.dumps(thing),)
        except Exception:  # a lock or a stream, which contains no numbers
            return ("not pickled",)


def _has_attributes(thing: object) -> bool:
    """Whether the values of an object are its `__dict__`: one of the user's classes without slots, or a record."""
    kind = type(thing)
    if not isinstance(getattr(thing, "__dict__", None), dict):
        return False
    if is_of_library(kind):
        return kind is types.SimpleNamespace or dataclasses.is_dataclass(thing)
    return not any(vars(base).get("__slots__") for base in kind.__mro__ if not is_of_library(base))


@functools.lru_cache(maxsize=1024)
def _names_of(code: types.CodeType) -> tuple[list[str], list[str], frozenset[str]]:
    """The global variables that a function uses, the modules that it imports, and all names in its code."""
    read: dict[str, set[str]] = {"LOAD_GLOBAL": set(), "LOAD_NAME": set(), "IMPORT_NAME": set()}
    names: set[str] = set()
    codes = [code]
    while codes:
        part = codes.pop()
        names |= {*part.co_names, *part.co_varnames, *part.co_freevars}
        codes += [c for c in part.co_consts if isinstance(c, types.CodeType)]
        for instruction in dis.get_instructions(part):
            if instruction.opname in read:
                read[instruction.opname].add(instruction.argval)
    of_globals = read["LOAD_GLOBAL"] | read["LOAD_NAME"]  # LOAD_NAME: in the body of a class
    return sorted(x for x in of_globals if not x.startswith("__")), sorted(read["IMPORT_NAME"]), frozenset(names)


_serials = Cache(10_000)
_count = itertools.count()


def _serial(thing: object) -> int:
    """A number that no other object has had or will have, unlike its `id`.

    An object without weak references (`np.random.Generator`) is kept, because its end cannot be detected. With a new
    number at each visit, programs would be compiled again in every call.
    """
    owners = owners_of(thing)
    return _serials.get(id(thing), lambda: (next(_count), None if owners else thing), owners)[0]


def digest(value: PyTree, code: Callable[[Any], bytes] | None = None) -> str:
    """Sixteen hexadecimal digits that identify data: numbers, arrays and containers of these.

    **Arguments:**

    - `value`: the data.
    - `code`: function -> digest, for functions that a program calls back, including all that they read. Default: the
        name.
    """
    return _Hash(code).of(value)


# Parameters that state where and under which name a program runs do not change its results.
_NOT_COMPUTED = frozenset(
    "name in_shardings out_shardings in_layouts out_layouts ctx_mesh mesh sharding donated_invars keep_unused inline "
    "debug_info".split()
)
_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+|0x[0-9a-fA-F]{8,}")


class _Hash:
    def __init__(self, code: Callable[[Any], bytes] | None, programs: dict[int, tuple[Any, str]] | None = None) -> None:
        self.sha = hashlib.sha256()
        self.words = functools.partial(_add_words, self.sha)
        self.code = code
        # programs that were already read: one is often called many times
        self.programs = {} if programs is None else programs

    def of(self, value: PyTree) -> str:
        self.add(value)
        return self.sha.hexdigest()[:16]

    def add(self, value: PyTree) -> None:
        if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
            self.words(type(value).__name__, value if isinstance(value, bytes) else repr(value))
        elif hasattr(value, "eqns") or (hasattr(value, "jaxpr") and hasattr(value, "consts")):
            if id(value) not in self.programs:
                inner = _Hash(self.code, self.programs)
                inner.program(value)
                self.programs[id(value)] = value, inner.sha.hexdigest()
            self.words(self.programs[id(value)][1])
        else:
            kind, parts = self.parts(value)
            self.words(kind, len(parts))
            for part in parts:
                self.add(part)

    def parts(self, value: PyTree) -> tuple[str, Sequence[Any]]:
        """What a value is, and its contents."""
        name = type(value).__qualname__
        inner, params = getattr(value, "program", None), getattr(value, "params", None)
        if isinstance(value, Tracer):  # in a rule of an operation that was traced within another trace
            return "traced", (str(value.dtype), value.shape)
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(value)
            return "array", (array.dtype.str, array.shape, array.tobytes())
        if isinstance(value, enum.Enum):
            return "enum", (name, value.name)
        if isinstance(value, Mapping):
            return "dict", [x for item in value.items() for x in item]
        if isinstance(value, (list, tuple)):
            return "sequence", value
        if isinstance(value, (set, frozenset)):
            return "set", sorted(digest(item, self.code) for item in value)
        if inner is not None:  # a program of scalars, see `_scalarjit.program`
            return "program", (inner,)
        if isinstance(params, Mapping):  # an operation that contains programs itself: `jax.lax.custom_root`
            return "operation", (name, params)
        if self.code is not None and hasattr(value, "callback_func"):  # `jax.pure_callback`, `io_callback`
            return "called back", (self.code(value.callback_func),)
        if isinstance(value, (type, types.BuiltinFunctionType, np.dtype)):
            return "named", (str(getattr(value, "__qualname__", value)),)
        if dataclasses.is_dataclass(value):
            return "object", (name, {x.name: getattr(value, x.name, None) for x in dataclasses.fields(value)})
        if not jax.tree_util.all_leaves([value]):
            return "object", (name, jax.tree.leaves(value))
        if callable(value):
            return "named", (name, str(getattr(value, "__qualname__", "")))
        return name, (_ADDRESS.sub("", str(value)),)

    def program(self, program: ClosedJaxpr) -> None:
        """Operations in their order; variables are identified by the position at which they were computed."""
        constants = getattr(program, "consts", ())
        program = getattr(program, "jaxpr", program)
        numbers: dict[Any, int] = {}

        def name(variables: Sequence[Any]) -> None:
            self.words("variables", len(variables))
            for v in variables:
                if hasattr(v, "val"):
                    self.words("literal", v.aval)
                    self.add(v.val)
                else:
                    self.words(numbers.setdefault(v, len(numbers)), v.aval)

        name((*program.constvars, *program.invars))
        self.add(tuple(constants))
        for equation in program.eqns:
            self.words(equation.primitive.name)
            name(equation.invars)
            self.add({key: x for key, x in sorted(equation.params.items()) if key not in _NOT_COMPUTED})
            name(equation.outvars)
        name(program.outvars)
