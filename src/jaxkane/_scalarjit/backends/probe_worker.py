"""The probe's own process: compiles the texts that it is given, has XLA call the last of them, and tells the results.

Runs as a script, and loads what it needs of this package by its file: importing the whole would take seconds.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import sys
from pathlib import Path


def main() -> None:
    request = json.load(sys.stdin)
    spec = importlib.util.spec_from_file_location("compiler", Path(__file__).with_name("compiler.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    compiler = module.LLVMCompiler()
    if list(compiler.key) != request["key"]:
        raise SystemExit(f"another LLVM or processor than asked for: {compiler.key[0]}, {compiler.key[2]}")
    address, name = [compiler.compile(text) for text in request["texts"]][-1]

    import jax
    import jaxlib
    import numpy as np

    if jaxlib.__version__ != request["jaxlib"]:
        raise SystemExit(f"another jaxlib than asked for: {jaxlib.__version__}")
    jax.config.update("jax_enable_x64", True)
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
    results = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in request["results"]]
    call = jax.ffi.ffi_call(name, results)
    outputs = jax.jit(lambda *xs: call(*xs))(*[np.array(x, np.float64) for x in request["arguments"]])
    print(json.dumps([np.asarray(x).tolist() for x in outputs]))


if __name__ == "__main__":
    try:
        main()
    except Exception as error:
        raise SystemExit(f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}") from None
