"""Whether two sweeps are the same: digests of numbers, structures and functions that outlive a process.

A function is told by its compiled code, by the values that it closes over and by the globals that it names: other
comments are the same sweep, another number is not.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import inspect
import types
from typing import Any

import jax
import numpy as np

# Told by their names here, and by their versions in the manifest.
_LIBRARIES = frozenset("jaxkane jax jaxlib numpy equinox diffrax optimistix lineax scipy builtins math abc".split())


def digest(value: Any) -> str:
    """Sixteen hexadecimal digits."""
    return _Hash().of(value)


class _Hash:
    def __init__(self) -> None:
        self.sha = hashlib.sha256()
        self.seen: set[int] = set()  # functions may name each other

    def of(self, value: Any) -> str:
        self.add(value)
        return self.sha.hexdigest()[:16]

    def say(self, *words: Any) -> None:
        for word in words:
            data = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(str(len(data)).encode() + b":" + data)

    def add(self, value: Any) -> None:
        if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
            self.say(type(value).__name__, value if isinstance(value, bytes) else repr(value))
        elif isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.ascontiguousarray(value)
            self.say("array", array.dtype.str, np.shape(value), array.tobytes())
        elif isinstance(value, enum.Enum):
            self.say("enum", type(value).__qualname__, value.name)
        elif isinstance(value, dict):
            self.say("dict", len(value))
            for key, item in value.items():
                self.add(key)
                self.add(item)
        elif isinstance(value, (list, tuple)):
            self.say(type(value).__name__, len(value))
            for item in value:
                self.add(item)
        elif isinstance(value, (set, frozenset)):
            self.say("set", *sorted(digest(item) for item in value))
        elif isinstance(value, functools.partial):
            self.say("partial")
            self.add((value.func, value.args, value.keywords))
        elif isinstance(value, types.MethodType):
            self.say("method")
            self.add((value.__func__, value.__self__))
        elif isinstance(value, type):
            self._class(value)
        elif inspect.isfunction(inspect.unwrap(value)) if callable(value) else False:
            self._function(inspect.unwrap(value))
        elif dataclasses.is_dataclass(value):
            self._class(type(value))
            for field in dataclasses.fields(value):
                self.say(field.name)
                self.add(getattr(value, field.name, None))
        elif isinstance(value, types.CodeType):
            self._code(value)
        else:  # a module, a ufunc, an object of a library: its name is what outlives the process
            self.say(type(value).__module__, type(value).__qualname__, getattr(value, "__name__", ""))

    def _is_library(self, thing: Any) -> bool:
        return (getattr(thing, "__module__", None) or "builtins").split(".")[0] in _LIBRARIES

    def _class(self, cls: type) -> None:
        self.say("class", cls.__module__ if self._is_library(cls) else "", cls.__qualname__)
        if id(cls) in self.seen or self._is_library(cls):
            return
        self.seen.add(id(cls))
        for base in cls.__mro__:
            for name in () if self._is_library(base) else sorted(vars(base)):
                item = getattr(base, name)  # equinox wraps methods; this is the function itself
                plain = inspect.isfunction(item) or isinstance(item, (tuple, str, int, float, property))
                if plain and (not name.startswith("__") or name == "__call__"):
                    self.say(name)
                    self.add(item.fget if isinstance(item, property) else item)

    def _function(self, f: Any) -> None:
        if self._is_library(f):
            self.say("function", f.__module__, f.__qualname__)
            return
        self.say("function")
        if id(f) in self.seen:
            return
        self.seen.add(id(f))
        self._code(f.__code__)
        self.add(f.__defaults__)
        self.add(f.__kwdefaults__)
        try:
            found = inspect.getclosurevars(f)
        except ValueError:  # a cell that is still empty
            return
        for group in (found.nonlocals, found.globals):
            for name, value in sorted(group.items()):
                self.say(name)
                self.add(value)

    def _code(self, code: types.CodeType) -> None:
        self.say("code", code.co_code, *code.co_names, "|", *code.co_varnames)
        doc = code.co_consts[0] if code.co_consts and isinstance(code.co_consts[0], str) else None
        for constant in code.co_consts:
            if constant is not doc:
                self.add(constant)
