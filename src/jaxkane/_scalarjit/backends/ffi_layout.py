"""The structures by which XLA calls a native kernel, and whether this jaxlib has them.

`llvm.wrapper_text` reads and writes these structures at fixed byte offsets. With wrong offsets it would use
invalid pointers. Therefore `mismatch` compares the offsets with the header of jaxlib before any kernel is compiled. In
addition, every call compares the sizes that the structures contain in their first field (`llvm`).
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import NamedTuple

import jax


class Layout(NamedTuple):
    """Byte offsets in the structures of xla/ffi/api/c_api.h, major version 0, with addresses of eight bytes.

    The `*_size` are sizes of structures, as the structures state them in their first field.
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
_MAY_GROW = ("frame_size", "buffer_size")  # a later version may append fields, which the wrapper does not read


def mismatch(header: Path | None = None) -> str | None:
    """The reason why kernels cannot be called with `LAYOUT`; None if they can.

    `header`: the file to read, by default the one that jaxlib contains.
    """
    if sys.maxsize < 2**32:
        return "addresses do not have eight bytes"
    header = header or Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h")
    try:
        found = layout_of(header.read_text(encoding="utf-8"))
    except OSError as error:
        return f"the header of jaxlib, which states how kernels are called, cannot be read: {error}"
    except (KeyError, ValueError, AttributeError) as error:
        return f"the header of jaxlib, {header}, has changed: {type(error).__name__}: {error}"
    moved = [
        f"{name} is {new}, not {old}"
        for name, old, new in zip(Layout._fields, LAYOUT, found, strict=True)
        if new != old and not (name in _MAY_GROW and new > old)
    ]
    return f"jaxlib calls kernels in another way ({header}: {', '.join(moved)})" if moved else None


_SCALARS = {"size_t": 8, "int64_t": 8, "int32_t": 4, "int": 4, "uint32_t": 4, "XLA_FFI_Handler_Traits": 4}


def layout_of(header: str) -> Layout:
    """The layout that the text of the header describes.

    **Raises:** `KeyError` or `AttributeError` for a structure or field that is missing, `ValueError` for another major
    version.
    """
    text = re.sub(r"//[^\n]*", "", header)
    if not re.search(r"#define XLA_FFI_API_MAJOR 0\b", text):
        raise ValueError("XLA_FFI_API_MAJOR is not 0")
    text = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\);", r"\1* \1;", text)
    structs = dict(re.findall(r"struct (\w+) \{([^{}]*)\}", text))
    scalars = _SCALARS | dict.fromkeys(re.findall(r"enum \{[^{}]*\} (\w+);", text), 4)

    def fields(struct: str) -> dict[str, tuple[int, int]]:
        """Offset and size of each field, by the rules of C: a field begins at a multiple of its own alignment."""
        offset, found = 0, {}
        for kind, name in re.findall(r"([\w\s]+?[\s*]+)(\w+);", structs[struct]):
            kind = kind.strip().removeprefix("const ").removeprefix("struct ").strip()
            is_struct = "*" not in kind and kind not in scalars
            # Each structure has a field of eight bytes, so that its size is a multiple of eight.
            size = -(-sum([*fields(kind).values()][-1]) // 8) * 8 if is_struct else 8 if "*" in kind else scalars[kind]
            alignment = min(size, 8)
            offset = -(-offset // alignment) * alignment
            found[name] = offset, size
            offset += size
        return found

    def offset(struct: str, field: str) -> int:
        return fields(struct)[field][0]

    def stated(struct: str) -> int:
        """The size that a structure states: up to the end of the field that its traits name."""
        last = re.search(rf"XLA_FFI_DEFINE_STRUCT_TRAITS\({struct},\s*(\w+)\)", text)
        if last is None:
            raise KeyError(f"XLA_FFI_DEFINE_STRUCT_TRAITS of {struct}")
        return sum(fields(struct)[last.group(1)])

    frame, version = "XLA_FFI_CallFrame", offset("XLA_FFI_Metadata", "api_version")
    lists = {
        (offset(struct, "size"), offset(struct, items), stated(struct))
        for struct, items in (("XLA_FFI_Args", "args"), ("XLA_FFI_Rets", "rets"))
    }
    if len(lists) != 1:
        raise ValueError("arguments and results are not listed in the same way")
    list_count, list_items, list_size = lists.pop()
    extension = "XLA_FFI_Extension_Base" if "XLA_FFI_Extension_Base" in structs else "XLA_FFI_InternalExtension"
    return Layout(
        frame_size=stated(frame),
        frame_extension=offset(frame, "extension_start"),
        frame_api=offset(frame, "api"),
        frame_arguments=offset(frame, "args"),
        frame_results=offset(frame, "rets"),
        list_size=list_size,
        list_count=list_count,
        list_items=list_items,
        buffer_size=stated("XLA_FFI_Buffer"),
        buffer_data=offset("XLA_FFI_Buffer", "data"),
        extension_type=offset(extension, "type"),
        extension_metadata=offset("XLA_FFI_Metadata_Extension", "metadata"),
        metadata_major=version + offset("XLA_FFI_Api_Version", "major_version"),
        metadata_minor=version + offset("XLA_FFI_Api_Version", "minor_version"),
        metadata_traits=offset("XLA_FFI_Metadata", "traits"),
        api_error_create=offset("XLA_FFI_Api", "XLA_FFI_Error_Create"),
        error_size=stated("XLA_FFI_Error_Create_Args"),
        error_message=offset("XLA_FFI_Error_Create_Args", "message"),
        error_code=offset("XLA_FFI_Error_Create_Args", "errc"),
    )
