"""Digests that outlive a process, and atomic writes. Knows JAX's programs; knows no mechanics."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import os
import re
import secrets
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np
from jax.core import Tracer


def digest(value: Any, code: Callable[[Any], bytes] | None = None) -> str:
    """Sixteen hexadecimal digits of data: numbers, arrays, and what holds them.

    `code`: gives a digest of a function that a program calls back, with all that it reads; by default its name.
    """
    return _Hash(code).of(value)


# Where and under which name a program runs is not what it computes.
_NOT_COMPUTED = frozenset(
    "name in_shardings out_shardings in_layouts out_layouts ctx_mesh mesh sharding donated_invars keep_unused inline "
    "debug_info".split()
)
_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+|0x[0-9a-fA-F]{8,}")


class _Hash:
    def __init__(self, code: Callable[[Any], bytes] | None, programs: dict[int, tuple[Any, str]] | None = None) -> None:
        self.sha = hashlib.sha256()
        self.code = code
        self.programs = {} if programs is None else programs  # those that were read: one is often called many times

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
        elif isinstance(value, Tracer):  # a rule of an operation that was traced within another, which holds the value
            self.say("traced", value.dtype, value.shape)
        elif isinstance(value, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(value)
            self.say("array", array.dtype.str, array.shape, np.ascontiguousarray(array).tobytes())
        elif isinstance(value, enum.Enum):
            self.say("enum", type(value).__qualname__, value.name)
        elif isinstance(value, Mapping):
            self.say("dict", len(value))
            for key, item in value.items():
                self.add(key)
                self.add(item)
        elif isinstance(value, (list, tuple)):
            self.say("sequence", len(value))
            for item in value:
                self.add(item)
        elif isinstance(value, (set, frozenset)):
            self.say("set", *sorted(digest(item, self.code) for item in value))
        elif hasattr(value, "eqns") or (hasattr(value, "jaxpr") and hasattr(value, "consts")):
            if id(value) not in self.programs:
                inner = _Hash(self.code, self.programs)
                inner.program(value)
                self.programs[id(value)] = value, inner.sha.hexdigest()
            self.say(self.programs[id(value)][1])
        else:
            self.thing(value)

    def thing(self, value: Any) -> None:
        """What is neither a number nor a program."""
        inner, params = getattr(value, "program", None), getattr(value, "params", None)
        if inner is not None:  # of scalars, see `_scalarjit.function`
            self.add(inner)
        elif isinstance(params, Mapping):  # an operation that holds programs itself: `jax.lax.custom_root`
            self.say("operation", type(value).__qualname__)
            self.add(params)
        elif self.code is not None and hasattr(value, "callback_func"):  # of `jax.pure_callback`, `io_callback`
            self.say("called back", self.code(value.callback_func))
        elif isinstance(value, (type, types.BuiltinFunctionType, np.dtype)):
            self.say("named", getattr(value, "__qualname__", value))
        elif dataclasses.is_dataclass(value):
            self.say("object", type(value).__qualname__)
            for field in dataclasses.fields(value):
                self.say(field.name)
                self.add(getattr(value, field.name, None))
        elif not jax.tree_util.all_leaves([value]):
            self.say("object", type(value).__qualname__)
            self.add(jax.tree.leaves(value))
        elif callable(value):
            self.say("named", type(value).__qualname__, getattr(value, "__qualname__", ""))
        else:
            self.say(type(value).__qualname__, _ADDRESS.sub("", str(value)))

    def program(self, program: Any) -> None:
        """Operations in their order, variables by the places where they were made."""
        constants = getattr(program, "consts", ())
        program = getattr(program, "jaxpr", program)
        numbers: dict[Any, int] = {}

        def name(variables: Sequence[Any]) -> None:
            self.say("variables", len(variables))
            for v in variables:
                if hasattr(v, "val"):
                    self.say("literal", v.aval)
                    self.add(v.val)
                else:
                    self.say(numbers.setdefault(v, len(numbers)), v.aval)

        self.say("program")
        name((*program.constvars, *program.invars))
        self.add(tuple(constants))
        for equation in program.eqns:
            self.say(equation.primitive.name)
            name(equation.invars)
            for key, value in sorted(equation.params.items()):
                if key not in _NOT_COMPUTED:
                    self.say(key)
                    self.add(value)
            name(equation.outvars)
        name(program.outvars)


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """In what two descriptions differ, in words: `option rtol (1e-08 there, 1e-06 here)`."""
    found = []
    for group in dict.fromkeys((*there, *here)):
        old, new = there.get(group, {}), here.get(group, {})
        if not isinstance(old, dict) or not isinstance(new, dict):
            old, new = {"": old}, {"": new}
        for key in dict.fromkeys((*old, *new)):
            a, b = (x.get(key) for x in (old, new))
            if a != b:
                a, b = ("nothing" if x in (None, {}) else x for x in (a, b))
                found.append(f"{group} {key}".strip() + f" ({a} there, {b} here)")
    return "; ".join(found)


SCRATCH = ".tmp"


def atomic_write(path: Path, put: Callable[[BinaryIO], Any], *, replace: bool = True) -> bool:
    """Write under a name of its own (`*.tmp`), bring that to the disk, rename it: no reader ever sees a part.

    **Arguments:** `put` writes into the open file. `replace`: with False a file that is there already stays.

    **Returns:** whether the file that is now there is this one.
    """
    scratch = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}{SCRATCH}")
    try:
        with open(scratch, "xb") as file:
            put(file)
            file.flush()
            os.fsync(file.fileno())
        if not replace and not _named_anew(scratch, path):
            return False
        if replace:
            os.replace(scratch, path)
        _name_to_disk(path.parent)
        return True
    finally:
        scratch.unlink(missing_ok=True)


def _named_anew(scratch: Path, path: Path) -> bool:
    """Give the file its name unless that is taken: of two processes one succeeds."""
    try:
        os.link(scratch, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without second names
        if path.exists():
            return False
        os.replace(scratch, path)
    return True


def _name_to_disk(folder: Path) -> None:
    if os.name == "posix":  # the name, too, must be on the disk
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
