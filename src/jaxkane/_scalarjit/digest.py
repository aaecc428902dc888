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

    def parts(self, value: Any) -> tuple[str, Sequence[Any]]:
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

        name((*program.constvars, *program.invars))
        self.add(tuple(constants))
        for equation in program.eqns:
            self.words(equation.primitive.name)
            name(equation.invars)
            self.add({key: x for key, x in sorted(equation.params.items()) if key not in _NOT_COMPUTED})
            name(equation.outvars)
        name(program.outvars)
