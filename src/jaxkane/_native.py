"""Scalar programs as machine code, through LLVM. Knows jaxprs, LLVM's text and XLA's calling convention; no mechanics.

A traced program of small arrays is unrolled into a graph of scalars, every node once, and written out as one straight
function over vectors of lanes: members of a batch, or directions of a derivative. What all lanes share is computed
once, ahead of them. XLA calls the function as a custom call, inside `jit` and inside loops.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import hashlib
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

CALLS = ("jit", "pjit")

# Nodes of a graph are numbered; what is said of them: operation, operands (numbers of nodes), type.
_FLOATS = {"float64": "double", "float32": "float"}
_TYPES = {**_FLOATS, "bool": "i1"}
_BINARY = {"add": "fadd", "add_any": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "rem": "frem"}
_LOGIC = {"and": "and", "or": "or", "xor": "xor"}
_COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "max": "maximum", "min": "minimum"}
_LIBRARY = frozenset(
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p".split()
)
_LIBRARY |= {"pow", "cbrt", "erf"}
_SAME = frozenset("copy copy_p stop_gradient optimization_barrier".split())


class NotScalarError(Exception):
    """The program holds something that this file does not write."""


class _Node(NamedTuple):
    operation: str
    operands: tuple[Any, ...]
    dtype: str


class _Graph:
    """Scalars, each once. Constants are folded where that is exact: x + 0, x - 0, x * 1, x * 0 (an exact zero of the
    description or of a tangent, not a number that happens to be zero), x / 1, 0 / x."""

    def __init__(self) -> None:
        self.nodes: list[_Node] = []
        self._numbers: dict[_Node, int] = {}

    def add(self, operation: str, operands: tuple[Any, ...], dtype: str) -> int:
        if dtype not in _TYPES:
            raise NotScalarError(dtype)
        if operation in ("add", "add_any", "mul", "max", "min", "and", "or"):
            operands = tuple(sorted(operands))
        node = _Node("add" if operation == "add_any" else operation, operands, dtype)
        if node not in self._numbers:
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def constant(self, value: Any, dtype: str) -> int:
        # By its digits, since -0.0 == 0.0 and nan != nan.
        return self.add("constant", (float(value).hex() if dtype != "bool" else bool(value),), dtype)

    def value(self, number: int) -> float | bool | None:
        node = self.nodes[number]
        if node.operation != "constant":
            return None
        return float.fromhex(node.operands[0]) if node.dtype != "bool" else node.operands[0]

    def apply(self, operation: str, operands: tuple[int, ...], dtype: str) -> int:
        if operation in _BINARY:
            known = self._folded(operation, *operands, dtype)
            if known is not None:
                return known
        return self.add(operation, operands, dtype)

    def _folded(self, operation: str, a: int, b: int, dtype: str) -> int | None:
        x, y = self.value(a), self.value(b)
        match operation:
            case "add" | "add_any":
                return b if x == 0 else a if y == 0 else None
            case "sub":
                return a if y == 0 else self.add("neg", (b,), dtype) if x == 0 else None
            case "mul":
                if x == 0 or y == 0:
                    return self.constant(0.0, dtype)
                if x in (1, -1) or y in (1, -1):
                    other, unit = (b, x) if x in (1, -1) else (a, y)
                    return other if unit == 1 else self.add("neg", (other,), dtype)
            case "div":
                return a if y == 1 else self.constant(0.0, dtype) if x == 0 and y != 0 else None
        return None


def _unrolled(program: Jaxpr, consts: Sequence[Any], inputs: Sequence[np.ndarray], graph: _Graph) -> list[np.ndarray]:
    """The program's outputs as arrays of node numbers."""

    def constants(x: Any) -> np.ndarray:
        x = np.asarray(x)
        if str(x.dtype) in _TYPES:
            return _each(lambda v: graph.constant(v, str(x.dtype)), x)
        return x  # whole numbers: exponents, places

    values: dict[Any, np.ndarray] = {}
    values.update(zip(program.constvars, map(constants, consts), strict=True))
    values.update(zip(program.invars, inputs, strict=True))
    for equation in program.eqns:
        xs = [constants(v.val) if isinstance(v, Literal) else values[v] for v in equation.invars]
        if equation.primitive.name in CALLS:
            inner = equation.params["jaxpr"]
            outputs = _unrolled(inner.jaxpr, inner.consts, xs, graph)
        else:
            outputs = _operation(equation, xs, graph)
        values.update(zip(equation.outvars, outputs, strict=True))
    return [constants(v.val) if isinstance(v, Literal) else values[v] for v in program.outvars]


def _each(f: Callable[..., int], *xs: np.ndarray) -> np.ndarray:
    xs = np.broadcast_arrays(*xs)
    out = np.empty(xs[0].shape, dtype=np.int64)
    for place in np.ndindex(out.shape):
        out[place] = f(*(x[place] for x in xs))
    return out


def _operation(equation: Any, xs: list[np.ndarray], graph: _Graph) -> list[np.ndarray]:
    name, params, aval = equation.primitive.name, equation.params, equation.outvars[0].aval
    dtype = str(aval.dtype)
    x_dtype = str(equation.invars[0].aval.dtype) if equation.invars else dtype

    def each(operation: str, *ys: np.ndarray, dtype: str = dtype) -> np.ndarray:
        return _each(lambda *numbers: graph.apply(operation, tuple(map(int, numbers)), dtype), *ys)

    moved = _moved(name, params, xs, aval.shape)
    if moved is not None:
        return moved
    if x_dtype not in _TYPES or dtype not in _TYPES:
        raise NotScalarError(f"{name} of {x_dtype}")
    match name:
        case "neg" | "sign" | "logistic":
            return [each(name, *xs)]
        case "square":
            return [each("mul", xs[0], xs[0])]
        case "integer_pow":
            return [_power(xs[0], params["y"], each, graph, dtype)]
        case "rsqrt":
            return [each("div", _ones_like(xs[0], graph, dtype), each("sqrt", xs[0]))]
        case "is_finite":
            return [each("lt", each("abs", xs[0], dtype=x_dtype), _full_like(xs[0], np.inf, graph, x_dtype))]
        case "not" if dtype == "bool":
            return [each("xor", xs[0], _full_like(xs[0], True, graph, "bool"))]
        case "select_n" if len(xs) == 3 and x_dtype == "bool":
            return [each("select", xs[0], xs[2], xs[1])]
        case "clamp":
            return [each("min", each("max", xs[1], xs[0]), xs[2])]
        case "convert_element_type":
            return [xs[0] if x_dtype == dtype else _converted(xs[0], x_dtype, dtype, graph)]
        case "reduce_sum":
            return [_summed(xs[0], params["axes"], each, graph, dtype)]
    if name in _LOGIC and dtype == "bool":
        return [each(name, *xs)]
    if name in _COMPARISONS and x_dtype in _FLOATS:
        return [each(name, *xs)]
    if name in (*_BINARY, *_INTRINSICS, *_LIBRARY) and dtype in _FLOATS and x_dtype == dtype:
        return [each(name, *xs)]
    raise NotScalarError(f"{name} of {x_dtype}")


def _moved(name: str, params: Any, xs: list[np.ndarray], shape: tuple[int, ...]) -> list[np.ndarray] | None:
    """What only carries scalars from place to place."""
    x = xs[0] if xs else np.empty(0)
    match name:
        case _ if name in _SAME:
            return xs
        case "reshape" | "squeeze":
            return [x.reshape(shape)]
        case "broadcast_in_dim":
            kept = [shape[d] if d in params["broadcast_dimensions"] else 1 for d in range(len(shape))]
            places = dict(zip(params["broadcast_dimensions"], x.shape, strict=True))
            return [np.broadcast_to(x.reshape([places.get(d, 1) for d in range(len(kept))]), shape)]
        case "concatenate":
            return [np.concatenate(xs, axis=params["dimension"])]
        case "stack":
            return [np.stack(xs, axis=params["axis"])]
        case "unstack":
            return list(np.moveaxis(x, params["axis"], 0))
        case "split":
            return np.split(x, np.cumsum(params["sizes"])[:-1], axis=params["axis"])
        case "transpose":
            return [np.transpose(x, params["permutation"])]
        case "rev":
            return [np.flip(x, params["dimensions"])]
        case "slice":
            steps = params["strides"] or (1,) * x.ndim
            return [x[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]]
        case "pad" if all(low >= 0 and high >= 0 for low, high, _ in params["padding_config"]):
            out = np.full(shape, xs[1], dtype=x.dtype)
            inner = (slice(lo, s - hi, step + 1) for s, (lo, hi, step) in zip(shape, params["padding_config"]))
            out[tuple(inner)] = x
            return [out]
    return None


def _full_like(x: np.ndarray, value: Any, graph: _Graph, dtype: str) -> np.ndarray:
    return np.full(x.shape, graph.constant(value, dtype), dtype=np.int64)


def _ones_like(x: np.ndarray, graph: _Graph, dtype: str) -> np.ndarray:
    return _full_like(x, 1.0, graph, dtype)


def _power(x: np.ndarray, y: int, each: Callable, graph: _Graph, dtype: str) -> np.ndarray:
    if y == 0:
        return _ones_like(x, graph, dtype)
    found, factor, n = None, x, abs(y)
    while n:
        if n & 1:
            found = factor if found is None else each("mul", found, factor)
        factor, n = each("mul", factor, factor) if n > 1 else factor, n >> 1
    return found if y > 0 else each("div", _ones_like(x, graph, dtype), found)  # type: ignore[return-value]


def _converted(x: np.ndarray, x_dtype: str, dtype: str, graph: _Graph) -> np.ndarray:
    if dtype not in _FLOATS:
        raise NotScalarError(f"{x_dtype} to {dtype}")
    return _each(lambda v: graph.add("convert", (int(v),), dtype), x)


def _summed(x: np.ndarray, axes: Iterable[int], each: Callable, graph: _Graph, dtype: str) -> np.ndarray:
    for axis in sorted(axes, reverse=True):
        x = functools.reduce(lambda a, b: each("add", a, b), np.moveaxis(x, axis, 0), graph_zero(x, axis, graph, dtype))
    return x


def graph_zero(x: np.ndarray, axis: int, graph: _Graph, dtype: str) -> np.ndarray:
    return np.full(np.delete(x.shape, axis), graph.constant(0.0, dtype), dtype=np.int64)


# ---- LLVM's text ----


class _Writer:
    """The text of one function: `void kernel(ptr in, ptr out, i64 n)`, with pointers to n lanes of every argument.

    An argument that `varies` holds its elements lane after lane; one that does not is read once. The last lanes of the
    last group repeat lane n - 1, so that what a lane gives never depends on its place.
    """

    def __init__(self, graph: _Graph, varies: Sequence[bool], lanes: int):
        self.graph, self.varies, self.lanes = graph, varies, lanes
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.bases: set[str] = set()
        self.vector_library = _vector_library(lanes)

    def write(self, name: str, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]) -> str:
        nodes, lanes = self.graph.nodes, self.lanes
        used = _needed(nodes, outputs)
        wide = [False] * len(nodes)
        for k in used:
            node = nodes[k]
            if node.operation == "input":
                wide[k] = self.varies[node.operands[0]]
            elif node.operation != "constant":
                wide[k] = any(wide[i] for i in node.operands)
        # What lanes share goes through memory, whence it is broadcast for nothing.
        shared = {k for k in used if not wide[k] and nodes[k].operation != "constant"}
        carried = sorted(
            {i for k in used if wide[k] and nodes[k].operation != "input" for i in nodes[k].operands if i in shared}
            | {int(k) for out in outputs for k in out.flat if int(k) in shared}
        )
        slot = {k: i for i, k in enumerate(carried)}
        out = self.lines
        pointers = [*(("in", i) for i in range(len(inputs))), *(("out", i) for i in range(len(outputs)))]
        body: list[str] = []
        self.lines = body
        for where, i in pointers:
            body.append(f"%{where}{i}.at = getelementptr ptr, ptr %{where}, i64 {i}")
            body.append(f"%{where}{i} = load ptr, ptr %{where}{i}.at")
        body.append(f"%kept = alloca double, i64 {max(len(carried), 1)}, align 64")
        for k in used:
            if not wide[k]:
                self._node(k, 1, {})
                if k in slot:
                    kind = _TYPES[nodes[k].dtype]
                    body.append(f"%kept{k} = getelementptr double, ptr %kept, i64 {slot[k]}")
                    body.append(f"store {kind} %v{k}, ptr %kept{k}")
        body += ["%last = sub i64 %n, 1", "br label %lanes", "lanes:", "%i = phi i64 [0, %entry], [%next, %lanes]"]
        for lane in range(lanes):
            body.append(f"%i{lane}.open = add i64 %i, {lane}")
            body.append(f"%i{lane} = call i64 @llvm.umin.i64(i64 %i{lane}.open, i64 %last)")
        self.declared.add("declare i64 @llvm.umin.i64(i64, i64)")
        splats: dict[int, str] = {}
        for k in used:
            if wide[k]:
                self._node(k, lanes, splats, slot)
        for j, array in enumerate(outputs):
            for e, k in enumerate(map(int, array.flat)):
                self._store(f"out{j}", e, array.size, self._operand(k, lanes, splats, slot), nodes[k].dtype)
        body += [f"%next = add i64 %i, {lanes}", "%more = icmp ult i64 %next, %n"]
        body += ["br i1 %more, label %lanes, label %done", "done:", "ret void"]
        self.lines = out
        text = "\n".join(["entry:", *body])
        declarations = "\n".join(sorted(self.declared))
        return f"{declarations}\ndefine void @{name}(ptr %in, ptr %out, i64 %n) #0 {{\n{text}\n}}\n"

    def _type(self, dtype: str, lanes: int) -> str:
        return _TYPES[dtype] if lanes == 1 else f"<{lanes} x {_TYPES[dtype]}>"

    def _operand(self, k: int, lanes: int, splats: dict[int, str], slot: dict[int, int] | None = None) -> str:
        node = self.graph.nodes[k]
        if node.operation == "constant":
            number = self.graph.value(k)
            text = str(number).lower() if node.dtype == "bool" else _digits(number, node.dtype)
            return text if lanes == 1 else f"splat ({_TYPES[node.dtype]} {text})"
        if slot is None or k not in slot:
            return f"%v{k}"
        if k not in splats:
            kind = _TYPES[node.dtype]
            self.lines.append(f"%s{k} = load {kind}, ptr %kept{k}")
            splats[k] = self._splat(f"%s{k}", kind, lanes)
        return splats[k]

    def _splat(self, scalar: str, kind: str, lanes: int) -> str:
        if lanes == 1:
            return scalar
        self.lines.append(f"{scalar}.1 = insertelement <{lanes} x {kind}> poison, {kind} {scalar}, i64 0")
        self.lines.append(
            f"{scalar}.n = shufflevector <{lanes} x {kind}> {scalar}.1, <{lanes} x {kind}> poison, "
            f"<{lanes} x i32> zeroinitializer"
        )
        return f"{scalar}.n"

    def _node(self, k: int, lanes: int, splats: dict[int, str], slot: dict[int, int] | None = None) -> None:
        node = self.graph.nodes[k]
        name, kind = node.operation, self._type(node.dtype, lanes)
        if name == "constant":
            return
        if name == "input":
            self._load(k, *node.operands, lanes)
            return
        xs = [self._operand(i, lanes, splats, slot) for i in node.operands]
        first = self._type(self.graph.nodes[node.operands[0]].dtype, lanes)
        match name:
            case "neg":
                text = f"fneg {kind} {xs[0]}"
            case "select":
                text = f"select {first} {xs[0]}, {kind} {xs[1]}, {kind} {xs[2]}"
            case "convert":
                source = self.graph.nodes[node.operands[0]].dtype
                verb = "uitofp" if source == "bool" else "fpext" if node.dtype == "float64" else "fptrunc"
                text = f"{verb} {first} {xs[0]} to {kind}"
            case _ if name in _BINARY:
                text = f"{_BINARY[name]} contract {kind} {', '.join(xs)}"
            case _ if name in _LOGIC:
                text = f"{_LOGIC[name]} {kind} {', '.join(xs)}"
            case _ if name in _COMPARISONS:
                text = f"fcmp {_COMPARISONS[name]} {first} {', '.join(xs)}"
            case _ if name in _INTRINSICS:
                suffix = ("f64" if node.dtype == "float64" else "f32") if lanes == 1 else None
                suffix = suffix or f"v{lanes}{'f64' if node.dtype == 'float64' else 'f32'}"
                text = self._call(f"llvm.{_INTRINSICS[name]}.{suffix}", kind, xs)
            case _ if name in _LIBRARY:
                text = self._library(k, name, kind, node.dtype, xs, lanes)
            case _:
                raise NotScalarError(name)
        self.lines.append(f"%v{k} = {text}")

    def _call(self, function: str, kind: str, xs: Sequence[str]) -> str:
        self.declared.add(f"declare {kind} @{function}({', '.join([kind] * len(xs))})")
        return f"call {kind} @{function}({', '.join(f'{kind} {x}' for x in xs)})"

    def _library(self, k: int, name: str, kind: str, dtype: str, xs: Sequence[str], lanes: int) -> str:
        one = name if dtype == "float64" else name + "f"
        if lanes == 1:
            return self._call(one, kind, xs)
        vector = self.vector_library(name, len(xs)) if dtype == "float64" else None
        if vector:
            return self._call(vector, kind, xs)
        scalar, results = _TYPES[dtype], []
        for lane in range(lanes):
            parts = []
            for i, x in enumerate(xs):
                self.lines.append(f"%c{k}.{lane}.{i} = extractelement {kind} {x}, i64 {lane}")
                parts.append(f"%c{k}.{lane}.{i}")
            self.lines.append(f"%c{k}.{lane} = {self._call(one, scalar, parts)}")
            results.append(f"%c{k}.{lane}")
        self._gathered(results, scalar, f"%c{k}.g", f"%c{k}.all")
        return f"freeze {kind} %c{k}.all"

    def _at(self, pointer: str, element: int, size: int, lane: int, kind: str, tag: str) -> str:
        """The address of an element of an argument in a lane."""
        base = f"%{pointer}.{lane}"
        if base not in self.bases:
            self.bases.add(base)
            self.lines.append(f"{base}.o = mul i64 %i{lane}, {size}")
            self.lines.append(f"{base} = getelementptr {kind}, ptr %{pointer}, i64 {base}.o")
        self.lines.append(f"%{tag} = getelementptr {kind}, ptr {base}, i64 {element}")
        return f"%{tag}"

    def _load(self, k: int, argument: int, element: int, size: int, lanes: int) -> None:
        dtype = self.graph.nodes[k].dtype
        kind = _TYPES[dtype] if dtype != "bool" else "i8"
        varies = self.varies[argument]
        whole = f"%v{k}" if dtype != "bool" else f"%v{k}.byte"
        vector = f"<{lanes} x {kind}>" if varies and lanes > 1 else kind
        if not varies:
            self.lines.append(f"%a{k} = getelementptr {kind}, ptr %in{argument}, i64 {element}")
            self.lines.append(f"{whole} = load {kind}, ptr %a{k}")
        else:
            parts = []
            for lane in range(lanes):
                at = self._at(f"in{argument}", element, size, lane, kind, f"a{k}.{lane}")
                parts.append(whole if lanes == 1 else f"%l{k}.{lane}")
                self.lines.append(f"{parts[-1]} = load {kind}, ptr {at}")
            if lanes > 1:
                self._gathered(parts, kind, f"%g{k}", whole)
        if dtype == "bool":
            self.lines.append(f"%v{k} = icmp ne {vector} {whole}, {'0' if vector == 'i8' else 'zeroinitializer'}")

    def _gathered(self, parts: Sequence[str], kind: str, tag: str, whole: str) -> None:
        vector, so_far = f"<{len(parts)} x {kind}>", "poison"
        for lane, part in enumerate(parts):
            name = whole if lane == len(parts) - 1 else f"{tag}.{lane}"
            self.lines.append(f"{name} = insertelement {vector} {so_far}, {kind} {part}, i64 {lane}")
            so_far = name

    def _store(self, pointer: str, element: int, size: int, value: str, dtype: str) -> None:
        lanes, tag, kind = self.lanes, f"{pointer}.e{element}", _TYPES[dtype]
        if dtype == "bool":
            byte = "i8" if lanes == 1 else f"<{lanes} x i8>"
            self.lines.append(f"%{tag}.byte = zext {self._type(dtype, lanes)} {value} to {byte}")
            value, kind = f"%{tag}.byte", "i8"
        for lane in range(lanes):
            at = self._at(pointer, element, size, lane, kind, f"{tag}.{lane}.p")
            one = value
            if lanes > 1:
                one = f"%{tag}.{lane}.v"
                self.lines.append(f"{one} = extractelement <{lanes} x {kind}> {value}, i64 {lane}")
            self.lines.append(f"store {kind} {one}, ptr {at}")


def _digits(value: Any, dtype: str) -> str:
    """A float as LLVM writes it: the bits of a double, also for a float32."""
    number = np.float64(value) if dtype == "float64" else np.float64(np.float32(value))
    return f"0x{number.view(np.uint64):016X}"


def _needed(nodes: Sequence[_Node], outputs: Sequence[np.ndarray]) -> list[int]:
    needed = [False] * len(nodes)
    for array in outputs:
        for k in array.flat:
            needed[int(k)] = True
    for k in range(len(nodes) - 1, -1, -1):
        if needed[k] and nodes[k].operation not in ("input", "constant"):
            for i in nodes[k].operands:
                needed[i] = True
    return [k for k, is_needed in enumerate(needed) if is_needed]


# ---- compiling, and XLA's calling convention ----

# Places in the structures of XLA's foreign function interface, xla/ffi/api/c_api.h, major version 0.
_FRAME_EXTENSION, _FRAME_ARGUMENTS, _FRAME_RESULTS = 8, 72, 112
_EXTENSION_TYPE, _EXTENSION_METADATA, _METADATA = 8, 24, 1
_METADATA_MAJOR, _METADATA_MINOR, _METADATA_TRAITS = 24, 28, 32
_BUFFER_DATA = 24
_API_VERSION = (0, 1)


def _handler(
    name: str, kernel: str, sizes: Sequence[int], where: Sequence[Sequence[bool]], n_out: int, bytes_of: Sequence[int]
) -> str:
    """The function that XLA calls: for every place in the outer dimensions, the kernel on the lanes of the last."""
    n_in = len(where)
    outer, lanes = sizes[:-1], (sizes[-1] if sizes else 1)
    lines = [
        f"%extension.at = getelementptr i8, ptr %frame, i64 {_FRAME_EXTENSION}",
        "%extension = load ptr, ptr %extension.at",
        "%plain = icmp eq ptr %extension, null",
        "br i1 %plain, label %run, label %asked",
        "asked:",
        f"%type.at = getelementptr i8, ptr %extension, i64 {_EXTENSION_TYPE}",
        "%type = load i32, ptr %type.at",
        f"%is.metadata = icmp eq i32 %type, {_METADATA}",
        "br i1 %is.metadata, label %tell, label %run",
        "tell:",
        f"%metadata.at = getelementptr i8, ptr %extension, i64 {_EXTENSION_METADATA}",
        "%metadata = load ptr, ptr %metadata.at",
    ]
    for field, place, value in (
        ("major", _METADATA_MAJOR, _API_VERSION[0]),
        ("minor", _METADATA_MINOR, _API_VERSION[1]),
        ("traits", _METADATA_TRAITS, 0),
    ):
        lines.append(f"%{field} = getelementptr i8, ptr %metadata, i64 {place}")
        lines.append(f"store i32 {value}, ptr %{field}")
    lines += [
        "ret ptr null",
        "run:",
        f"%in = alloca ptr, i64 {max(n_in, 1)}",
        f"%out = alloca ptr, i64 {max(n_out, 1)}",
    ]
    for side, place, n in (("in", _FRAME_ARGUMENTS, n_in), ("out", _FRAME_RESULTS, n_out)):
        lines.append(f"%{side}.list.at = getelementptr i8, ptr %frame, i64 {place}")
        lines.append(f"%{side}.list = load ptr, ptr %{side}.list.at")
        for i in range(n):
            b = f"%{side}{i}"
            lines.append(f"{b}.buffer.at = getelementptr ptr, ptr %{side}.list, i64 {i}")
            lines.append(f"{b}.buffer = load ptr, ptr {b}.buffer.at")
            lines.append(f"{b}.data.at = getelementptr i8, ptr {b}.buffer, i64 {_BUFFER_DATA}")
            lines.append(f"{b}.data = load ptr, ptr {b}.data.at")
            lines.append(f"{b}.slot = getelementptr ptr, ptr %{side}, i64 {i}")
    lines += ["br label %outer", "outer:", "%k = phi i64 [0, %run], [%k.next, %outer]"]
    all_where = [*where, *([[True] * len(sizes)] * n_out)]
    for i in range(n_in + n_out):
        b = f"%in{i}" if i < n_in else f"%out{i - n_in}"
        offset = f"{b}.0"
        lines.append(f"{offset} = add i64 0, 0")
        stride = bytes_of[i] * (lanes if sizes and all_where[i][-1] else 1)
        later = 1
        for d in reversed(range(len(outer))):
            if all_where[i][d]:
                lines.append(f"{b}.{d}.q = udiv i64 %k, {later}")
                lines.append(f"{b}.{d}.r = urem i64 {b}.{d}.q, {outer[d]}")
                lines.append(f"{b}.{d}.s = mul i64 {b}.{d}.r, {stride}")
                lines.append(f"{b}.{d}.o = add i64 {offset}, {b}.{d}.s")
                offset = f"{b}.{d}.o"
                stride *= outer[d]
            later *= outer[d]
        lines.append(f"{b}.here = getelementptr i8, ptr {b}.data, i64 {offset}")
        lines.append(f"store ptr {b}.here, ptr {b}.slot")
    lines += [
        f"call void @{kernel}(ptr %in, ptr %out, i64 {lanes})",
        "%k.next = add i64 %k, 1",
        f"%more = icmp ult i64 %k.next, {int(np.prod(outer, dtype=np.int64))}",
        "br i1 %more, label %outer, label %done",
        "done:",
        "ret ptr null",
    ]
    body = "\n".join(["entry:", *lines])
    return f"declare void @{kernel}(ptr, ptr, i64)\ndefine ptr @{name}(ptr %frame) {{\n{body}\n}}\n"


class _Machine:
    """This processor, and what has been compiled for it."""

    def __init__(self) -> None:
        import llvmlite.binding as llvm

        self.llvm = llvm
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        features = llvm.get_host_cpu_features()
        self.cpu = llvm.get_host_cpu_name()
        self.features = features.flatten()
        self.lanes = 8 if features.get("avx512f") else 4 if features.get("avx2") else 2
        self.compiled: dict[str, tuple[int, Any]] = {}
        for library in ("m", "mvec"):
            path = ctypes.util.find_library(library)
            if path:
                llvm.load_library_permanently(path)

    def compile(self, name: str, text: str) -> int:
        """The address of the function `name`, which is named after its text. Code lives as long as the process."""
        if name in self.compiled:
            return self.compiled[name][0]
        llvm = self.llvm
        module = llvm.parse_assembly(text)
        module.name = name
        target = llvm.Target.from_default_triple()
        machine = target.create_target_machine(
            cpu=self.cpu, features=self.features, opt=2, codemodel="jitdefault", jit=True
        )
        engine = llvm.create_mcjit_compiler(module, machine)
        folder = _cache_folder()
        if folder:
            engine.set_object_cache(functools.partial(_keep, folder), functools.partial(_kept, folder))
        engine.finalize_object()
        address = engine.get_function_address(name)
        self.compiled[name] = address, (engine, machine)
        return address


@functools.cache
def machine() -> _Machine:
    return _Machine()


_wanted = True


def use(native: bool) -> None:
    """Whether programs that are compiled from now on become machine code through LLVM, or XLA's."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()


def is_on() -> bool:
    return _wanted and why_not() is None


@functools.cache
def why_not() -> str | None:
    """Why this process has no native kernels; None where it has them."""
    try:
        host = machine()
    except ImportError:
        return "llvmlite is not installed: pip install 'jaxkane[native]'"
    except Exception as error:  # an LLVM or a processor that this file does not know
        return f"LLVM does not work here: {error}"
    if host.llvm.llvm_version_info < (20,):
        return "llvmlite is too old: pip install 'llvmlite>=0.45'"
    return None


def _cache_folder() -> Path | None:
    """Beside JAX's persistent compilation cache, where that is on."""
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(folder) / "jaxkane" if folder and jax.config.jax_enable_compilation_cache else None  # type: ignore[attr-defined]


def _keep(folder: Path, module: Any, code: bytes) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        scratch = folder / f"{module.name}.{os.getpid()}"
        scratch.write_bytes(code)
        scratch.replace(folder / f"{module.name}.o")
    except OSError as error:
        warnings.warn(f"Compiled code could not be kept in {folder}: {error}", stacklevel=2)


def _kept(folder: Path, module: Any) -> bytes | None:
    try:
        return (folder / f"{module.name}.o").read_bytes()
    except OSError:
        return None


def _vector_library(lanes: int) -> Callable[[str, int], str | None]:
    return functools.partial(_vector_function, lanes)


@functools.cache
def _vector_function(lanes: int, name: str, arity: int) -> str | None:
    """The name in glibc's libmvec of a function of so many lanes, where there is one."""
    path = ctypes.util.find_library("mvec") if sys.platform == "linux" else None
    kind = {8: "e", 4: "d", 2: "b"}.get(lanes)
    if path is None or kind is None or os.uname().machine != "x86_64":
        return None
    symbol = f"_ZGV{kind}N{lanes}{'v' * arity}_{name}"
    return symbol if hasattr(ctypes.CDLL(path), symbol) else None


class Scalars:
    """A program as a graph, and the targets compiled from it."""

    def __init__(self, program: ClosedJaxpr):
        self.graph = _Graph()
        inputs = []
        for i, aval in enumerate(program.in_avals):
            array = np.empty(aval.shape, dtype=np.int64)
            for e, place in enumerate(np.ndindex(aval.shape)):
                array[place] = self.graph.add("input", (i, e, array.size), str(aval.dtype))
            inputs.append(array)
        self.inputs = inputs
        self.outputs = _unrolled(program.jaxpr, program.consts, inputs, self.graph)
        self.bytes_of = [a.size * a.dtype.itemsize for a in (*program.in_avals, *program.out_avals)]
        self.kernel = functools.cache(self._kernel)
        self.target = functools.cache(self._target)

    def _kernel(self, varies: tuple[bool, ...], lanes: int) -> str:
        text = _Writer(self.graph, varies, lanes).write("kernel", self.inputs, self.outputs)
        name = _name(text)
        text = text.replace("@kernel(", f"@{name}(") + "attributes #0 = { nounwind }\n"
        host = machine()
        host.llvm.add_symbol(name, host.compile(name, text))
        return name

    def _target(self, sizes: tuple[int, ...], where: tuple[tuple[bool, ...], ...]) -> str:
        """The name under which XLA calls the program for a batch of `sizes`, of whose dimensions argument i has those
        in `where[i]`."""
        if all(all(w) or not any(w) for w in where):  # one long batch
            sizes, where = (int(np.prod(sizes)),) if sizes else (), tuple((any(w),) if sizes else () for w in where)
        lanes = min(machine().lanes, 1 << (sizes[-1] - 1).bit_length()) if sizes else 1
        kernel = self.kernel(tuple(bool(w and w[-1]) for w in where), lanes)
        text = _handler("handler", kernel, sizes, where, len(self.outputs), self.bytes_of)
        name, host = _name(text), machine()
        if name not in host.compiled:
            address = host.compile(name, text.replace("@handler(", f"@{name}("))
            handler = jax.ffi.pycapsule(ctypes.CFUNCTYPE(ctypes.c_void_p)(address))
            jax.ffi.register_ffi_target(name, handler, platform="cpu")
        return name


def _name(text: str) -> str:
    host = machine()
    digest = hashlib.sha256("\n".join((text, host.cpu, host.features)).encode())
    return "jaxkane_" + digest.hexdigest()[:24]
