"""The structures by which XLA calls a native kernel, and whether this jaxlib has them.

`llvm.wrapper_text` reads and writes these structures at fixed byte offsets. With wrong offsets it would use
invalid pointers. Therefore `mismatch` compares their fields with the header of jaxlib before any kernel is compiled.
"""

from __future__ import annotations

import re
import types
from pathlib import Path

import jax

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
