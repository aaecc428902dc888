"""Whether XLA can call native kernels here: one is called in another process, before this one calls any.

How XLA calls them is written down in `ffi` as numbers, and a jaxlib that has moved something would make wild
pointers of them. So the first kernel runs where it can do no harm. That takes about a second; the verdict is kept for
the next processes, by the versions of jaxlib and LLVM, the processor and the text itself.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jaxlib
import numpy as np

from ..._common.files import atomic_write
from ..graph import Graph
from .compiler import LLVMCompiler, cache_folder
from .ffi import wrapper_text
from .llvm import Writer

_PATIENCE = 120.0  # [s], of a busy machine
_A_DAY = 86400.0  # [s]: what could not be done may have been for lack of memory, and is tried again
_SHARED = 600  # values that all lanes share: more than a page of the stack

_LANES = 11  # no multiple of any processor's lanes
_X = np.stack([np.linspace(-2.0, 2.0, _LANES), np.linspace(0.5, 3.0, _LANES)], axis=1)
_A = 0.75


def verdict(compiler: LLVMCompiler) -> str | None:
    """Why native kernels cannot be called here; None where they can."""
    key = hashlib.sha256(
        "\n".join(
            [_wrapper("kernel"), *compiler.key, jaxlib.__version__, sys.version, platform.system(), platform.machine()]
        ).encode()
    ).hexdigest()[:32]
    folders = _folders()
    for folder in folders:
        known = _read(folder / f"kernels-{key}.json")
        if known is not None:
            return known or None
    refusal, is_final = _tried(compiler)
    if is_final:
        for folder in folders:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                text = json.dumps({"cannot": refusal or ""}).encode()
                atomic_write(folder / f"kernels-{key}.json", lambda file, text=text: file.write(text))
                break
            except OSError:
                continue  # where nothing can be written every process tries for itself
    return refusal


def _folders() -> list[Path]:
    """Beside compiled programs, where these are kept, else in the user's folder of caches."""
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    user = Path(home) if home else Path(os.path.expanduser("~")) / ".cache"
    beside = cache_folder()
    return [*([beside] if beside else []), user / "jaxkane"]


def _read(path: Path) -> str | None:
    try:
        known = json.loads(path.read_text())["cannot"]
        is_old = time.time() - path.stat().st_mtime > _A_DAY
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return known if isinstance(known, str) and not (known and is_old) else None


def _wrapper(kernel: str) -> str:
    return wrapper_text(kernel, (_LANES,), ((True,), (False,)), 3, [16, 8, 8, 8, 1])


def _kernel(compiler: LLVMCompiler) -> str:
    """(x, y), a -> y sin(x) + a^601 + ... + a, atan2(y, x), x < y"""
    graph = Graph()
    double = lambda operation, *operands: graph.apply(operation, operands, "float64")  # noqa: E731
    x, y = (graph.add("input", (0, e, 2), "float64") for e in range(2))
    a = graph.add("input", (1, 0, 1), "float64")
    total, power = double("mul", y, double("sin", x)), a
    for _ in range(_SHARED):
        total, power = double("add", total, power), double("mul", power, a)
    outputs = [total, double("atan2", y, x), graph.apply("lt", (x, y), "bool")]
    writer = Writer(graph, (True, False), compiler.lanes, lambda f, arity: compiler.of_lanes(f, arity, compiler.lanes))
    return writer.text(2, [np.array([k]) for k in outputs])


def _expected() -> list[Any]:
    x, y = _X.T
    return [y * np.sin(x) + np.sum(_A ** np.arange(1, _SHARED + 1)), np.arctan2(y, x), x < y]


def _tried(compiler: LLVMCompiler) -> tuple[str | None, bool]:
    """Why not, or None; and whether that is to be kept."""
    if getattr(sys, "frozen", False) or not sys.executable:
        return "there is no Python beside this program in which they could be tried", False
    kernel = _kernel(compiler)
    request = {
        "texts": [kernel, _wrapper(compiler.name_of(kernel))],
        "key": compiler.key,
        "jaxlib": jaxlib.__version__,
        "arguments": [_X.tolist(), [_A]],
        "results": [([_LANES], "float64"), ([_LANES], "float64"), ([_LANES], "bool")],
    }
    # On the CPU, whatever else there is; without this process' flags, which say how to compile and not how to call.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("XLA_", "JAX_"))}
    environment = kept | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        run = subprocess.run(
            # -P: its folder, where files have names such as numpy.py, is no place to import from
            [sys.executable, "-P", str(Path(__file__).with_name("probe_worker.py"))],
            input=json.dumps(request),
            env=environment,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )
    except (OSError, subprocess.SubprocessError) as error:
        return f"they could not be tried in another process: {error}", False
    return _judged(run), True


_FAILED = f"a first kernel, tried in another process under jaxlib {jaxlib.__version__}, {{}}"


def _judged(run: subprocess.CompletedProcess[str]) -> str | None:
    if run.returncode != 0:
        last = (run.stderr.strip().splitlines() or ["it said nothing"])[-1]
        return _FAILED.format(
            f"was ended by signal {-run.returncode}" if run.returncode < 0 else f"failed: {last[:300]}"
        )
    try:
        results = [np.array(x) for x in json.loads(run.stdout.splitlines()[-1])]
        right = all(np.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in zip(results, _expected(), strict=True))
    except (ValueError, IndexError, TypeError):
        right = False
    return None if right else _FAILED.format("gave wrong numbers")
