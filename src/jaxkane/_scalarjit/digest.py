"""Digests of data and of programs that outlive a process."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import re
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .compat import Tracer


def digest(value: Any, code: Callable[[Any], bytes] | None = None) -> str:
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
        self.code = code
        # programs that were already read: one is often called many times
        self.programs = {} if programs is None else programs

    def of(self, value: Any) -> str:
        self.add(value)
        return self.sha.hexdigest()[:16]

    def words(self, *words: Any) -> None:
        for word in words:
            data = word if isinstance(word, bytes) else str(word).encode()
            self.sha.update(str(len(data)).encode() + b":" + data)

    def add(self, value: Any) -> None:
        if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
            self.words(type(value).__name__, value if isinstance(value, bytes) else repr(value))
        elif isinstance(value, Tracer):  # in a rule of an operation that was traced within another trace
            self.words("traced", value.dtype, value.shape)
        elif isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(value)
            self.words("array", array.dtype.str, array.shape, np.ascontiguousarray(array).tobytes())
        elif isinstance(value, enum.Enum):
            self.words("enum", type(value).__qualname__, value.name)
        elif isinstance(value, Mapping):
            self.words("dict", len(value))
            for key, item in value.items():
                self.add(key)
                self.add(item)
        elif isinstance(value, (list, tuple)):
            self.words("sequence", len(value))
            for item in value:
                self.add(item)
        elif isinstance(value, (set, frozenset)):
            self.words("set", *sorted(digest(item, self.code) for item in value))
        elif hasattr(value, "eqns") or (hasattr(value, "jaxpr") and hasattr(value, "consts")):
            if id(value) not in self.programs:
                inner = _Hash(self.code, self.programs)
                inner.program(value)
                self.programs[id(value)] = value, inner.sha.hexdigest()
            self.words(self.programs[id(value)][1])
        else:
            self.thing(value)

    def thing(self, value: Any) -> None:
        """An object that is neither a number nor a program."""
        inner, params = getattr(value, "program", None), getattr(value, "params", None)
        if inner is not None:  # a program of scalars, see `_scalarjit.program`
            self.add(inner)
        elif isinstance(params, Mapping):  # an operation that contains programs itself: `jax.lax.custom_root`
            self.words("operation", type(value).__qualname__)
            self.add(params)
        elif self.code is not None and hasattr(value, "callback_func"):  # `jax.pure_callback`, `io_callback`
            self.words("called back", self.code(value.callback_func))
        elif isinstance(value, (type, types.BuiltinFunctionType, np.dtype)):
            self.words("named", getattr(value, "__qualname__", value))
        elif dataclasses.is_dataclass(value):
            self.words("object", type(value).__qualname__)
            for field in dataclasses.fields(value):
                self.words(field.name)
                self.add(getattr(value, field.name, None))
        elif not jax.tree_util.all_leaves([value]):
            self.words("object", type(value).__qualname__)
            self.add(jax.tree.leaves(value))
        elif callable(value):
            self.words("named", type(value).__qualname__, getattr(value, "__qualname__", ""))
        else:
            self.words(type(value).__qualname__, _ADDRESS.sub("", str(value)))

    def program(self, program: Any) -> None:
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

        self.words("program")
        name((*program.constvars, *program.invars))
        self.add(tuple(constants))
        for equation in program.eqns:
            self.words(equation.primitive.name)
            name(equation.invars)
            for key, value in sorted(equation.params.items()):
                if key not in _NOT_COMPUTED:
                    self.words(key)
                    self.add(value)
            name(equation.outvars)
        name(program.outvars)
