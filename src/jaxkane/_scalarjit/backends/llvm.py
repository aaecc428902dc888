"""Graphs of scalars as LLVM's text. Knows LLVM's language; compiles nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..graph import LIBRARY, Graph, NotScalarError, needed, symbol

# Operations of graphs as LLVM writes them.
TYPES = {"float64": "double", "float32": "float", "bool": "i1"}
BINARY = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "rem": "frem"}
LOGIC = {"and": "and", "or": "or", "xor": "xor"}
COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "max": "maximum", "min": "minimum"}


class Writer:
    """The text of one function: `void it(ptr in, ptr out, i64 n)`, with pointers to n lanes of every argument.

    An argument that `varies` holds its elements lane after lane; one that does not is read once. The last lanes of the
    last group repeat lane n - 1, so that what a lane gives never depends on its place.
    """

    def __init__(self, graph: Graph, varies: Sequence[bool], lanes: int, of_lanes: Callable[[str, int], str | None]):
        self.graph, self.varies, self.lanes, self.of_lanes = graph, varies, lanes, of_lanes
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.bases: set[str] = set()
        # What lanes share goes through memory, whence it is broadcast for nothing: its places there, and its vectors.
        self.wide: set[int] = set()
        self.places: dict[int, int] = {}
        self.splats: dict[int, str] = {}

    def text(self, n_in: int, outputs: Sequence[np.ndarray]) -> str:
        nodes = self.graph.nodes
        used = needed(nodes, outputs)
        self.wide = wide = self._wide(used)
        shared = {k for k in used if k not in wide and nodes[k].operation != "constant"}
        read = {i for k in wide if nodes[k].operation != "input" for i in nodes[k].operands}
        read |= {int(k) for out in outputs for k in out.flat}
        for where, n in (("in", n_in), ("out", len(outputs))):
            for i in range(n):
                self.lines.append(f"%{where}{i}.at = getelementptr ptr, ptr %{where}, i64 {i}")
                self.lines.append(f"%{where}{i} = load ptr, ptr %{where}{i}.at")
        self.lines.append(f"%kept = alloca double, i64 {max(len(shared & read), 1)}, align 64")
        for k in sorted(shared):
            self._node(k, 1)
            if k in read:
                self.lines.append(f"%kept{k} = getelementptr double, ptr %kept, i64 {len(self.places)}")
                self.lines.append(f"store {TYPES[nodes[k].dtype]} %v{k}, ptr %kept{k}")
                self.places[k] = len(self.places)
        self.lines += [
            "%last = sub i64 %n, 1",
            "br label %lanes",
            "lanes:",
            "%i = phi i64 [0, %entry], [%next, %lanes]",
        ]
        self.declared.add("declare i64 @llvm.umin.i64(i64, i64)")
        for lane in range(self.lanes):
            self.lines.append(f"%i{lane}.open = add i64 %i, {lane}")
            self.lines.append(f"%i{lane} = call i64 @llvm.umin.i64(i64 %i{lane}.open, i64 %last)")
        for k in sorted(wide):
            self._node(k, self.lanes)
        for j, array in enumerate(outputs):
            for e, k in enumerate(map(int, array.flat)):
                self._store(f"out{j}", e, array.size, self._in_lanes(k), nodes[k].dtype)
        self.lines += [f"%next = add i64 %i, {self.lanes}", "%more = icmp ult i64 %next, %n"]
        self.lines += ["br i1 %more, label %lanes, label %done", "done:", "ret void"]
        body = "\n".join(self.lines)
        return "\n".join(
            [*sorted(self.declared), "define void @it(ptr %in, ptr %out, i64 %n) nounwind {", "entry:", body, "}", ""]
        )

    def _wide(self, used: Sequence[int]) -> set[int]:
        """Those that may differ from lane to lane."""
        wide: set[int] = set()
        for k in used:
            node = self.graph.nodes[k]
            if node.operation == "input":
                wide |= {k} if self.varies[node.operands[0]] else set()
            elif node.operation != "constant" and not wide.isdisjoint(node.operands):
                wide.add(k)
        return wide

    def _type(self, dtype: str, lanes: int) -> str:
        return TYPES[dtype] if lanes == 1 else f"<{lanes} x {TYPES[dtype]}>"

    def _alone(self, k: int) -> str:
        """What node k is called among those that all lanes share."""
        node = self.graph.nodes[k]
        if node.operation != "constant":
            return f"%v{k}"
        number = self.graph.value(k)
        return str(number).lower() if node.dtype == "bool" else _digits(number, node.dtype)

    def _in_lanes(self, k: int) -> str:
        """What node k is called as a vector of all lanes."""
        node, lanes = self.graph.nodes[k], self.lanes
        kind = TYPES[node.dtype]
        if node.operation == "constant":
            return self._alone(k) if lanes == 1 else f"splat ({kind} {self._alone(k)})"
        if k not in self.places:
            return f"%v{k}"
        if k not in self.splats:
            self.lines.append(f"%s{k} = load {kind}, ptr %kept{k}")
            self.splats[k] = self._splat(f"%s{k}", kind, lanes)
        return self.splats[k]

    def _splat(self, scalar: str, kind: str, lanes: int) -> str:
        if lanes == 1:
            return scalar
        self.lines.append(f"{scalar}.1 = insertelement <{lanes} x {kind}> poison, {kind} {scalar}, i64 0")
        self.lines.append(
            f"{scalar}.n = shufflevector <{lanes} x {kind}> {scalar}.1, <{lanes} x {kind}> poison, "
            f"<{lanes} x i32> zeroinitializer"
        )
        return f"{scalar}.n"

    def _node(self, k: int, lanes: int) -> None:
        """Node k, of one lane for all or of all lanes."""
        node = self.graph.nodes[k]
        name, kind = node.operation, self._type(node.dtype, lanes)
        if name == "input":
            argument, element, size = node.operands
            self._load(k, argument, element, size, lanes)
            return
        xs = [(self._in_lanes if k in self.wide else self._alone)(i) for i in node.operands]
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
            case _ if name in BINARY:
                text = f"{BINARY[name]} contract {kind} {', '.join(xs)}"
            case _ if name in LOGIC:
                text = f"{LOGIC[name]} {kind} {', '.join(xs)}"
            case _ if name in COMPARISONS:
                text = f"fcmp {COMPARISONS[name]} {first} {', '.join(xs)}"
            case _ if name in INTRINSICS:
                suffix = ("" if lanes == 1 else f"v{lanes}") + node.dtype.replace("loat", "")
                text = self._call(f"llvm.{INTRINSICS[name]}.{suffix}", kind, xs)
            case _ if name in LIBRARY:
                text = self._library(k, kind, xs, lanes)
            case _:
                raise NotScalarError(name)
        self.lines.append(f"%v{k} = {text}")

    def _call(self, function: str, kind: str, xs: Sequence[str]) -> str:
        self.declared.add(f"declare {kind} @{function}({', '.join([kind] * len(xs))})")
        return f"call {kind} @{function}({', '.join(f'{kind} {x}' for x in xs)})"

    def _library(self, k: int, kind: str, xs: Sequence[str], lanes: int) -> str:
        node = self.graph.nodes[k]
        one = symbol(node)
        if lanes == 1:
            return self._call(one, kind, xs)
        vector = self.of_lanes(node.operation, len(xs)) if node.dtype == "float64" else None
        if vector:
            return self._call(vector, kind, xs)
        scalar, results = TYPES[node.dtype], []
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
        kind = TYPES[dtype] if dtype != "bool" else "i8"
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
        lanes, tag, kind = self.lanes, f"{pointer}.e{element}", TYPES[dtype]
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
