"""The function by which XLA calls a kernel, as LLVM's text. Knows XLA's foreign function interface.

The places of XLA's structures are written down here, as numbers. Three things stand between a jaxlib that moves them
and a wild pointer: a test reads them from the header that jaxlib ships, the probe calls a kernel in another process
before this one does, and every call compares the sizes that the structures state of themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Layout(NamedTuple):
    """Bytes from the beginning of the structures of xla/ffi/api/c_api.h, major version 0, where addresses have eight.

    `*_size` are the sizes of structures, as they state them in their first field.
    """

    frame_size: int = 168
    frame_extension: int = 8
    frame_api: int = 16
    frame_arguments: int = 40
    frame_results: int = 80
    list_size: int = 40  # of the arguments, and of the results
    list_count: int = 16
    list_items: int = 32
    buffer_size: int = 48
    buffer_data: int = 24
    extension_type: int = 8
    extension_metadata: int = 24
    metadata_major: int = 24
    metadata_minor: int = 28
    metadata_traits: int = 32
    api_error_create: int = 48
    error_size: int = 28
    error_message: int = 16
    error_code: int = 24


LAYOUT = Layout()
_METADATA = 1
_API_VERSION = (0, 1)
_INTERNAL = 13
_MOVED = (
    "jaxkane: this jaxlib calls native kernels in another way than they expect. "
    "Leave the work to XLA: jaxkane.configure(native=False)."
)


def wrapper_text(
    kernel: str, sizes: Sequence[int], where: Sequence[Sequence[bool]], n_out: int, bytes_of: Sequence[int]
) -> str:
    """The function that XLA calls: for every place in the outer dimensions, the kernel on the lanes of the last.

    Argument i has those of the dimensions `sizes` that `where[i]` says, results have all; an element of each is so
    many bytes. Where a structure is not as large as it is taken to be, XLA is handed an error.
    """
    n_in = len(where)
    lines = [
        f"%in = alloca ptr, i64 {max(n_in, 1)}",
        f"%out = alloca ptr, i64 {max(n_out, 1)}",
        f"%error = alloca i8, i64 {LAYOUT.error_size + 4}, align 8",
        *_load("extension", "ptr", "frame", LAYOUT.frame_extension),
        "%plain = icmp eq ptr %extension, null",
        "br i1 %plain, label %check, label %asked",
        "asked:",
        *_load("type", "i32", "extension", LAYOUT.extension_type),
        f"%is.metadata = icmp eq i32 %type, {_METADATA}",
        "br i1 %is.metadata, label %tell, label %check",
        "tell:",
        *_load("metadata", "ptr", "extension", LAYOUT.extension_metadata),
        *_store("major", f"i32 {_API_VERSION[0]}", "metadata", LAYOUT.metadata_major),
        *_store("minor", f"i32 {_API_VERSION[1]}", "metadata", LAYOUT.metadata_minor),
        *_store("traits", "i32 0", "metadata", LAYOUT.metadata_traits),
        "ret ptr null",
        "check:",
        *_checks(n_in, n_out),
        "run:",
    ]
    for side, n in (("in", n_in), ("out", n_out)):
        for i in range(n):
            b = f"{side}{i}"
            lines += _load(f"{b}.buffer", "ptr", f"{side}.list", 8 * i)
            lines += _load(f"{b}.data", "ptr", f"{b}.buffer", LAYOUT.buffer_data)
            lines.append(f"%{b}.slot = getelementptr ptr, ptr %{side}, i64 {i}")
    lines += [*_calls(kernel, sizes, where, n_out, bytes_of), *_refusal()]
    body = "\n".join(["entry:", *lines])
    message = "".join(f"\\{byte:02X}" for byte in _MOVED.encode())
    return (
        f'@moved = private constant [{len(_MOVED) + 1} x i8] c"{message}\\00"\n'
        f"declare void @{kernel}(ptr, ptr, i64)\ndeclare void @llvm.trap()\n"
        f"define ptr @it(ptr %frame) {{\n{body}\n}}\n"
    )


def _load(name: str, kind: str, base: str, place: int) -> list[str]:
    return [f"%{name}.at = getelementptr i8, ptr %{base}, i64 {place}", f"%{name} = load {kind}, ptr %{name}.at"]


def _store(name: str, value: str, base: str, place: int) -> list[str]:
    return [f"%{name}.at = getelementptr i8, ptr %{base}, i64 {place}", f"store {value}, ptr %{name}.at"]


def _checks(n_in: int, n_out: int) -> list[str]:
    """Go on to %run, or to %wrong: sizes and counts first, since pointers may be followed only if these are right."""
    lines: list[str] = []

    def need(name: str, condition: str, base: str, place: int) -> None:
        lines.extend(_load(name, "i64", base, place))
        comparison, number = condition.split()
        lines.append(f"%{name}.fine = icmp {comparison} i64 %{name}, {number}")
        lines.append(f"br i1 %{name}.fine, label %{name}.yes, label %wrong")
        lines.append(f"{name}.yes:")

    need("frame.size", f"uge {LAYOUT.frame_size}", "frame", 0)
    for side, place, count in (("in", LAYOUT.frame_arguments, n_in), ("out", LAYOUT.frame_results, n_out)):
        need(f"{side}.size", f"eq {LAYOUT.list_size}", "frame", place)
        need(f"{side}.count", f"eq {count}", "frame", place + LAYOUT.list_count)
        lines.extend(_load(f"{side}.list", "ptr", "frame", place + LAYOUT.list_items))
        if count:  # all are made alike
            lines.extend(_load(f"{side}.first", "ptr", f"{side}.list", 0))
            need(f"{side}.first.size", f"uge {LAYOUT.buffer_size}", f"{side}.first", 0)
    return [*lines, "br label %run"]


def _refusal() -> list[str]:
    """An error made by XLA's own function. Where that is not at its place either, the process ends, rather than go on
    with results that nobody has written."""
    return [
        "wrong:",
        *_load("api", "ptr", "frame", LAYOUT.frame_api),
        *_load("api.size", "i64", "api", 0),
        f"%api.fine = icmp uge i64 %api.size, {LAYOUT.api_error_create + 8}",
        "br i1 %api.fine, label %say, label %nothing",
        "nothing:",
        "call void @llvm.trap()",
        "unreachable",
        "say:",
        *_load("create", "ptr", "api", LAYOUT.api_error_create),
        f"store i64 {LAYOUT.error_size}, ptr %error",
        *_store("error.extension", "ptr null", "error", 8),
        *_store("error.message", "ptr @moved", "error", LAYOUT.error_message),
        *_store("error.code", f"i32 {_INTERNAL}", "error", LAYOUT.error_code),
        "%made = call ptr %create(ptr %error)",
        "ret ptr %made",
    ]


def _calls(
    kernel: str, sizes: Sequence[int], where: Sequence[Sequence[bool]], n_out: int, bytes_of: Sequence[int]
) -> list[str]:
    """Every place in the outer dimensions, one after the other."""
    n_in = len(where)
    outer, lanes = sizes[:-1], (sizes[-1] if sizes else 1)
    lines = ["br label %outer", "outer:", "%k = phi i64 [0, %run], [%k.next, %outer]"]
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
    return [
        *lines,
        f"call void @{kernel}(ptr %in, ptr %out, i64 {lanes})",
        "%k.next = add i64 %k, 1",
        f"%more = icmp ult i64 %k.next, {int(np.prod(outer, dtype=np.int64))}",
        "br i1 %more, label %outer, label %done",
        "done:",
        "ret ptr null",
    ]
