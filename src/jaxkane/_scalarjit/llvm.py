"""Graphs of scalars as LLVM text, and the wrapper by which XLA calls a kernel. Does not compile.

The wrapper reads and writes XLA's structures at fixed byte offsets. With wrong offsets it would use invalid pointers.
Therefore `mismatch` compares their fields with the header of jaxlib before any kernel is compiled.
"""

from __future__ import annotations

import re
import types
from collections.abc import Callable, Iterator, Sequence, Set
from pathlib import Path

import jax
import numpy as np

from .graph import LIBRARY, Graph, NotScalarError, depth_first, needed, symbol

# Byte offsets in the structures of xla/ffi/api/c_api.h, major version 0, with addresses of eight bytes.
LAYOUT = types.SimpleNamespace(
    frame_extension=8,
    frame_arguments=40,
    frame_results=80,
    list_items=32,
    buffer_data=24,
    extension_type=8,
    extension_metadata=24,
    metadata_major=24,
    metadata_minor=28,
    metadata_traits=32,
)

# The fields of each structure that `LAYOUT` has an offset in. A later version may append fields to `_MAY_GROW`, which
# no other structure contains. The wrapper does not read such fields.
_MAY_GROW = ("CallFrame", "Buffer", "Metadata")
_STRUCTURES = {
    "InternalExtension": "size_t struct_size; InternalExtension_Type type; struct InternalExtension* next;",
    "Args": "size_t struct_size; InternalExtension* extension_start; int64_t size; ArgType* types; void** args;",
    "Rets": "size_t struct_size; InternalExtension* extension_start; int64_t size; RetType* types; void** rets;",
    "Buffer": "size_t struct_size; InternalExtension* extension_start; DataType dtype; void* data; int64_t rank; "
    "int64_t* dims;",
    "CallFrame": "size_t struct_size; InternalExtension* extension_start; const Api* api; InvokeContext* ctx; "
    "ExecutionStage stage; Args args; Rets rets; Attrs attrs;",
    "Metadata_Extension": "InternalExtension extension_base; Metadata* metadata;",
    "Metadata": "size_t struct_size; Api_Version api_version; Handler_Traits traits;",
    "Api_Version": "size_t struct_size; InternalExtension* extension_start; int major_version; int minor_version;",
}
# Names in jaxlib 0.10, and those of later versions.
_RENAMED = {
    "Extension_Base": "InternalExtension",
    " Extension_Type ": " InternalExtension_Type ",
    "ExecutionContext": "InvokeContext",
}


def mismatch(header: Path | None = None) -> str | None:
    """The reason why kernels cannot be called with `LAYOUT`; None if they can.

    `header`: the file to read, by default the one that jaxlib contains.
    """
    header = header or Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h")
    try:
        text = header.read_text(encoding="utf-8")
    except OSError as error:
        return f"the header of jaxlib, which states how kernels are called, cannot be read: {error}"
    text = re.sub(r"//[^\n]*", "", text).replace("XLA_FFI_", "")
    for old, new in _RENAMED.items():
        text = text.replace(old, new)
    found = {name: " ".join(fields.split()) for name, fields in re.findall(r"struct (\w+) \{([^{}]*)\}", text)}
    for name in _MAY_GROW:
        found[name] = found.get(name, "")[: len(_STRUCTURES[name])]
    changed = [f"struct XLA_FFI_{name}" for name, fields in _STRUCTURES.items() if found.get(name) != fields]
    if not re.search(r"#define API_MAJOR 0\b", text):
        changed.append("XLA_FFI_API_MAJOR")
    return f"jaxlib calls kernels in another way ({header}: {', '.join(changed)} has changed)" if changed else None


_METADATA = 1
_API_VERSION = (0, 1)


def wrapper_text(
    kernel: str,
    sizes: Sequence[int],
    batch_mask: Sequence[Sequence[bool]],
    n_in: int,
    bytes_of: Sequence[int],
    of_kernel: str = "",
) -> str:
    """The function that XLA calls. For each index of the outer dimensions it calls the kernel for the lanes of the last
    dimension.

    **Arguments:**

    - `kernel`: the name of the kernel.
    - `sizes`: of the batch dimensions.
    - `batch_mask`: for each argument and then each result, which dimensions it has.
    - `n_in`: the number of arguments.
    - `bytes_of`: for each argument and result, the size of an element.
    - `of_kernel`: the text of the kernel, which becomes a part of this one; empty if it is a separate function.
    """
    n_out = len(batch_mask) - n_in
    lines = [
        f"%in = alloca ptr, i64 {max(n_in, 1)}",
        f"%out = alloca ptr, i64 {max(n_out, 1)}",
        *_load("extension", "ptr", "frame", LAYOUT.frame_extension),
        "%plain = icmp eq ptr %extension, null",
        "br i1 %plain, label %run, label %extended",
        "extended:",
        *_load("type", "i32", "extension", LAYOUT.extension_type),
        f"%is.metadata = icmp eq i32 %type, {_METADATA}",
        "br i1 %is.metadata, label %describe, label %run",
        "describe:",
        *_load("metadata", "ptr", "extension", LAYOUT.extension_metadata),
        *_store("major", f"i32 {_API_VERSION[0]}", "metadata", LAYOUT.metadata_major),
        *_store("minor", f"i32 {_API_VERSION[1]}", "metadata", LAYOUT.metadata_minor),
        *_store("traits", "i32 0", "metadata", LAYOUT.metadata_traits),
        "ret ptr null",
        "run:",
    ]
    for side, n, place in (("in", n_in, LAYOUT.frame_arguments), ("out", n_out, LAYOUT.frame_results)):
        lines += _load(f"{side}.list", "ptr", "frame", place + LAYOUT.list_items)
        for i in range(n):
            b = f"{side}{i}"
            lines += _load(f"{b}.buffer", "ptr", f"{side}.list", 8 * i)
            lines += _load(f"{b}.data", "ptr", f"{b}.buffer", LAYOUT.buffer_data)
            lines.append(f"%{b}.slot = getelementptr ptr, ptr %{side}, i64 {i}")
    body = "\n".join(["entry:", *lines, *_calls(kernel, sizes, batch_mask, n_in, bytes_of)])
    declared = of_kernel or f"declare void @{kernel}(ptr, ptr, i64)\n"
    return f"{declared}define ptr @it(ptr %frame) {{\n{body}\n}}\n"


def _load(name: str, kind: str, base: str, place: int) -> list[str]:
    return [f"%{name}.at = getelementptr i8, ptr %{base}, i64 {place}", f"%{name} = load {kind}, ptr %{name}.at"]


def _store(name: str, value: str, base: str, place: int) -> list[str]:
    return [f"%{name}.at = getelementptr i8, ptr %{base}, i64 {place}", f"store {value}, ptr %{name}.at"]


def _calls(
    kernel: str, sizes: Sequence[int], batch_mask: Sequence[Sequence[bool]], n_in: int, bytes_of: Sequence[int]
) -> list[str]:
    """The loop over the indices of the outer dimensions."""
    outer, lanes = sizes[:-1], (sizes[-1] if sizes else 1)
    lines = ["br label %outer", "outer:", "%k = phi i64 [0, %run], [%k.next, %outer]"]
    for i in range(len(batch_mask)):
        b = f"%in{i}" if i < n_in else f"%out{i - n_in}"
        offset = f"{b}.0"
        lines.append(f"{offset} = add i64 0, 0")
        stride = bytes_of[i] * (lanes if sizes and batch_mask[i][-1] else 1)
        later = 1
        for d in reversed(range(len(outer))):
            if batch_mask[i][d]:
                lines.append(f"{b}.{d}.q = udiv i64 %k, {later}")
                lines.append(f"{b}.{d}.r = urem i64 {b}.{d}.q, {outer[d]}")
                lines.append(f"{b}.{d}.s = mul i64 {b}.{d}.r, {stride}")
                lines.append(f"{b}.{d}.o = add i64 {offset}, {b}.{d}.s")
                offset = f"{b}.{d}.o"
                stride *= outer[d]
            later *= outer[d]
        lines.append(f"{b}.here = getelementptr i8, ptr {b}.data, i64 {offset}")
        lines.append(f"store ptr {b}.here, ptr {b}.slot")
    return [
        *lines,
        f"call void @{kernel}(ptr %in, ptr %out, i64 {lanes})",
        "%k.next = add i64 %k, 1",
        f"%more = icmp ult i64 %k.next, {int(np.prod(outer, dtype=np.int64))}",
        "br i1 %more, label %outer, label %done",
        "done:",
        "ret ptr null",
    ]


# Operations of graphs in LLVM's language.
TYPES = {"float64": "double", "float32": "float", "bool": "i1"}
BINARY = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "rem": "frem"}
LOGIC = {"and": "and", "or": "or", "xor": "xor"}
COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "max": "maximum", "min": "minimum"}


# LLVM's time for a block grows faster than its length. With blocks of about this number of nodes, a long kernel
# compiles in two thirds of the time.
_BLOCK = 1000

# Longer kernels are ordered depth first. LLVM assigns registers in a time that grows with the number of values that are
# alive: the two kernels of a tree of 200 bodies (38 000 and 52 000 lines) compile in 5.9 s instead of 9.1 s. Shorter
# kernels keep the order of the program, in which a batch of bicycles is 7 % faster.
_LONG = 10_000


class Writer:
    """The text of one function: `void it(ptr in, ptr out, i64 n)`, with pointers to n lanes of every argument.

    An argument that `varies` and a result that `out_varies` contain their elements lane after lane. Others are read or
    written once. The last lanes of the last group repeat lane n - 1, so that the result of a lane never depends on its
    position.

    `is_derivative`: sums of products along several directions may be added in any order, which saves an eighth.
    """

    def __init__(
        self,
        graph: Graph,
        varies: Sequence[bool],
        out_varies: Sequence[bool],
        lanes: int,
        of_lanes: Callable[[str, int], str | None],
        is_derivative: bool = False,
    ):
        self.graph, self.lanes, self.of_lanes = graph, lanes, of_lanes
        self.varies, self.out_varies = varies, out_varies
        self.any_order = "reassoc contract" if is_derivative and lanes > 1 else "contract"
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.bases: set[str] = set()
        # Values that lanes share are stored in memory, from where a broadcast costs nothing: their places there, and
        # vectors.
        self.wide: set[int] = set()
        self.places: dict[int, int] = {}
        self.splats: dict[int, str] = {}

    def text(self, outputs: Sequence[np.ndarray]) -> str:
        nodes = self.graph.nodes
        used = needed(nodes, outputs)
        self.wide = wide = self._wide(used)
        shared = {k for k in used if k not in wide and nodes[k].operation != "constant"}
        read = {i for k in wide if nodes[k].operation != "input" for i in nodes[k].operands}
        read |= {int(k) for out, varies in zip(outputs, self.out_varies, strict=True) if varies for k in out.flat}
        for side, n in (("in", len(self.varies)), ("out", len(outputs))):
            for i in range(n):
                self.lines.append(f"%{side}{i}.at = getelementptr ptr, ptr %{side}, i64 {i}")
                self.lines.append(f"%{side}{i} = load ptr, ptr %{side}{i}.at")
        self.lines.append(f"%kept = alloca double, i64 {max(len(shared & read), 1)}, align 64")
        self.lines.append("%is.empty = icmp eq i64 %n, 0")
        for k in self._in_blocks("entry", shared, outputs):
            self._node(k, 1)
            if k in read:
                self.places[k] = len(self.places)
                self.lines.append(f"store {TYPES[nodes[k].dtype]} %v{k}, ptr {self._kept(k, 'kept')}")
        self._store_outputs(outputs, varying=False)
        self.lines += [
            "%last = sub i64 %n, 1",
            "br label %lanes",
            "lanes:",
            f"%i = phi i64 [0, %{self.block}], [%next, %stored]",
        ]
        self.declared.add("declare i64 @llvm.umin.i64(i64, i64)")
        for lane in range(self.lanes):
            self.lines.append(f"%i{lane}.open = add i64 %i, {lane}")
            self.lines.append(f"%i{lane} = call i64 @llvm.umin.i64(i64 %i{lane}.open, i64 %last)")
        for k in self._in_blocks("lanes", wide, outputs):
            self._node(k, self.lanes)
        self.lines += ["br label %stored", "stored:"]
        self._store_outputs(outputs, varying=True)
        self.lines += [f"%next = add i64 %i, {self.lanes}", "%more = icmp ult i64 %next, %n"]
        self.lines += ["br i1 %more, label %lanes, label %done", "done:", "ret void"]
        body = "\n".join(self.lines)
        return "\n".join(
            [*sorted(self.declared), "define void @it(ptr %in, ptr %out, i64 %n) nounwind {", "entry:", body, "}", ""]
        )

    def _in_blocks(self, label: str, nodes: Set[int], outputs: Sequence[np.ndarray]) -> Iterator[int]:
        """The nodes in order. Between blocks is a branch that is never taken, so that LLVM does not join them. The
        first block has this label; `self.block` is the last one."""
        self.block = label
        size = -(-len(nodes) // max(1, len(nodes) // _BLOCK))
        order = sorted(nodes)
        if len(nodes) > _LONG:
            order = depth_first(self.graph.nodes, nodes, (int(k) for out in outputs for k in out.flat))
        for i, k in enumerate(order):
            if i and i % size == 0:
                self.block = f"{label}.{i}"
                self.lines += [f"br i1 %is.empty, label %done, label %{self.block}", f"{self.block}:"]
            yield k

    def _wide(self, used: Sequence[int]) -> set[int]:
        """The nodes that may differ between lanes."""
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
        """The name of node k among the values that all lanes share."""
        node = self.graph.nodes[k]
        if node.operation != "constant":
            return f"%v{k}"
        number = self.graph.value(k)
        if node.dtype == "bool":
            return str(number).lower()
        # LLVM writes floats as the bits of a double, also those in single precision.
        return f"0x{np.float64(np.dtype(node.dtype).type(number)).view(np.uint64):016X}"

    def _in_lanes(self, k: int) -> str:
        """The name of node k as a vector of all lanes."""
        node, lanes = self.graph.nodes[k], self.lanes
        kind = TYPES[node.dtype]
        if node.operation == "constant":
            return self._alone(k) if lanes == 1 else f"splat ({kind} {self._alone(k)})"
        if k not in self.places:
            return f"%v{k}"
        if k not in self.splats:
            # LLVM would move an address that is computed outside the loop into it, which takes long.
            self.lines.append(f"%s{k} = load {kind}, ptr {self._kept(k, 'read')}")
            vector, self.splats[k] = f"<{lanes} x {kind}>", f"%s{k}"
            if lanes > 1:
                self.splats[k] = f"%s{k}.n"
                self.lines += [
                    f"%s{k}.1 = insertelement {vector} poison, {kind} %s{k}, i64 0",
                    f"%s{k}.n = shufflevector {vector} %s{k}.1, {vector} poison, <{lanes} x i32> zeroinitializer",
                ]
        return self.splats[k]

    def _kept(self, k: int, tag: str) -> str:
        self.lines.append(f"%{tag}{k} = getelementptr double, ptr %kept, i64 {self.places[k]}")
        return f"%{tag}{k}"

    def _node(self, k: int, lanes: int) -> None:
        """Node k, as one value for all lanes or as a vector of all lanes."""
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
                flags = self.any_order if k in self.wide else "contract"
                text = f"{BINARY[name]} {flags} {kind} {', '.join(xs)}"
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
            elements = []
            for i, x in enumerate(xs):
                self.lines.append(f"%c{k}.{lane}.{i} = extractelement {kind} {x}, i64 {lane}")
                elements.append(f"%c{k}.{lane}.{i}")
            self.lines.append(f"%c{k}.{lane} = {self._call(one, scalar, elements)}")
            results.append(f"%c{k}.{lane}")
        self._gathered(results, scalar, f"%c{k}.g", f"%c{k}.all")
        return f"freeze {kind} %c{k}.all"

    def _at(self, pointer: str, element: int, size: int, lane: int | None, kind: str, tag: str) -> str:
        """The address of an element of an argument or a result in a lane; `lane` is None if it does not vary."""
        base = f"%{pointer}" if lane is None else f"%{pointer}.{lane}"
        if lane is not None and base not in self.bases:
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
            at = self._at(f"in{argument}", element, size, None, kind, f"a{k}")
            self.lines.append(f"{whole} = load {kind}, ptr {at}")
        else:
            elements = []
            for lane in range(lanes):
                at = self._at(f"in{argument}", element, size, lane, kind, f"a{k}.{lane}")
                elements.append(whole if lanes == 1 else f"%l{k}.{lane}")
                self.lines.append(f"{elements[-1]} = load {kind}, ptr {at}")
            if lanes > 1:
                self._gathered(elements, kind, f"%g{k}", whole)
        if dtype == "bool":
            self.lines.append(f"%v{k} = icmp ne {vector} {whole}, {'0' if vector == 'i8' else 'zeroinitializer'}")

    def _gathered(self, elements: Sequence[str], kind: str, tag: str, whole: str) -> None:
        vector, so_far = f"<{len(elements)} x {kind}>", "poison"
        for lane, element in enumerate(elements):
            name = whole if lane == len(elements) - 1 else f"{tag}.{lane}"
            self.lines.append(f"{name} = insertelement {vector} {so_far}, {kind} {element}, i64 {lane}")
            so_far = name

    def _store_outputs(self, outputs: Sequence[np.ndarray], varying: bool) -> None:
        for j, array in enumerate(outputs):
            if self.out_varies[j] == varying:
                for element, k in enumerate(map(int, array.flat)):
                    self._store(f"out{j}", element, array.size, k, varying)

    def _store(self, pointer: str, element: int, size: int, k: int, varies: bool) -> None:
        """Store node k in each lane, or once if the result does not vary."""
        dtype, lanes = self.graph.nodes[k].dtype, self.lanes if varies else 1
        tag, kind, value = f"{pointer}.e{element}", TYPES[dtype], self._in_lanes(k) if varies else self._alone(k)
        if dtype == "bool":
            byte = "i8" if lanes == 1 else f"<{lanes} x i8>"
            self.lines.append(f"%{tag}.byte = zext {self._type(dtype, lanes)} {value} to {byte}")
            value, kind = f"%{tag}.byte", "i8"
        for lane in range(lanes):
            at = self._at(pointer, element, size, lane if varies else None, kind, f"{tag}.{lane}.p")
            one = value
            if lanes > 1:
                one = f"%{tag}.{lane}.v"
                self.lines.append(f"{one} = extractelement <{lanes} x {kind}> {value}, i64 {lane}")
            self.lines.append(f"store {kind} {one}, ptr {at}")
