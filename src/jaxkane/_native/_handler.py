"""The function by which XLA calls a kernel, as LLVM's text. Knows XLA's foreign function interface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Places in the structures of XLA's foreign function interface, xla/ffi/api/c_api.h, major version 0.
_FRAME_EXTENSION, _FRAME_ARGUMENTS, _FRAME_RESULTS = 8, 72, 112
_EXTENSION_TYPE, _EXTENSION_METADATA, _METADATA = 8, 24, 1
_METADATA_MAJOR, _METADATA_MINOR, _METADATA_TRAITS = 24, 28, 32
_BUFFER_DATA = 24
_API_VERSION = (0, 1)


def handler_text(
    kernel: str, sizes: Sequence[int], where: Sequence[Sequence[bool]], n_out: int, bytes_of: Sequence[int]
) -> str:
    """The function that XLA calls: for every place in the outer dimensions, the kernel on the lanes of the last.

    Argument i has those of the dimensions `sizes` that `where[i]` says, results have all; an element of each is so
    many bytes.
    """
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
    return f"declare void @{kernel}(ptr, ptr, i64)\ndefine ptr @it(ptr %frame) {{\n{body}\n}}\n"
