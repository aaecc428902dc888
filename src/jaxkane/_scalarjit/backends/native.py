"""Native kernels: whether they are wanted and possible here, and programs as such kernels.

How XLA calls them is written down in `llvm` as numbers, and a jaxlib that has moved something would make wild
pointers of them. So the first kernel runs where it can do no harm. That takes about a second; the verdict is kept for
the next processes, by the versions of jaxlib and LLVM, the processor and the text itself.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import json
import os
import platform
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jaxlib
import numpy as np

from ..._common.files import atomic_write
from ..compat import ClosedJaxpr, types_of
from ..graph import LIBRARY, Graph, NotScalarError, graph_of, symbol
from .compiler import LLVMCompiler, ObjectCache, cache_folder, without_llvm
from .llvm import Writer, wrapper_text

_PATIENCE = 120.0  # [s], of a busy machine
_A_DAY = 86400.0  # [s]: what could not be done may have been for lack of memory, and is tried again
_SHARED = 600  # values that all lanes share: more than a page of the stack

_LANES = 11  # no multiple of any processor's lanes
_X = np.stack([np.linspace(-2.0, 2.0, _LANES), np.linspace(0.5, 3.0, _LANES)], axis=1)
_A = 0.75


def probe_verdict(compiler: LLVMCompiler) -> str | None:
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
    return wrapper_text(kernel, (_LANES,), ((True,), (False,), *[(True,)] * 3), 2, [16, 8, 8, 8, 1])


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
    of_lanes = functools.partial(compiler.of_lanes, lanes=compiler.lanes)
    return Writer(graph, (True, False), (True,) * 3, compiler.lanes, of_lanes).text([np.array([k]) for k in outputs])


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


_ON, _OFF = ("", "1", "true", "yes", "on"), ("0", "false", "no", "off")


def switched_on(word: str) -> bool:
    """What JAXKANE_NATIVE says in the environment; where it is empty, it is as if it were not set."""
    if word.strip().lower() not in (*_ON, *_OFF):
        raise ValueError(f"JAXKANE_NATIVE={word!r} in the environment: it is one of {', '.join((*_ON[1:], *_OFF))}.")
    return word.strip().lower() in _ON


_wanted = switched_on(os.environ.get("JAXKANE_NATIVE", ""))
_lock = threading.RLock()
_told: set[str] = set()


def llvm_compiler() -> LLVMCompiler:
    with _lock:
        return _llvm_compiler()


@functools.cache
def _llvm_compiler() -> LLVMCompiler:
    return LLVMCompiler()


def use(native: bool) -> None:
    """Whether programs that are compiled from now on become machine code through LLVM, or XLA's."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()
    os.environ["JAXKANE_NATIVE"] = str(int(native))


def is_wanted() -> bool:
    return _wanted


def is_on() -> bool:
    """Whether programs become native kernels. A machine that has LLVM but fails the probe is told of, once."""
    if not _wanted or _without_llvm():
        return False
    why = why_not()
    if why:
        tell(why)
    return why is None


def why_not() -> str | None:
    """Why this process cannot have native kernels; None where it can."""
    return _without_llvm() or _refused()


def tell(why: str) -> None:
    """Warn that XLA does the work of native kernels; once for each reason."""
    with _lock:
        is_new = why not in _told
        _told.add(why)
    if is_new:
        warnings.warn(f"jaxkane: no native kernels, XLA does their work: {why}.", UserWarning, stacklevel=3)


@functools.cache
def _without_llvm() -> str | None:
    return without_llvm()


def _refused() -> str | None:
    with _lock:
        return _probed()


@functools.cache
def _probed() -> str | None:
    try:
        return probe_verdict(llvm_compiler())
    except RuntimeError as error:  # as llvmlite says that LLVM does not know this processor
        return f"LLVM does not work here: {error}"


Groups = tuple[tuple[int, ...], ...]
Where = tuple[tuple[bool, ...], ...]
FMOD = "fmod"  # in the C library what is `rem` in JAX


class Scalars:
    """A program as a graph, or what `as_graph` makes of it, and the targets compiled from that; those of what is called
    `once` quickly, those of what `is_derivative` with sums in any order.

    Raises `NotScalarError` where the program cannot be written so.
    """

    def __init__(
        self,
        program: ClosedJaxpr,
        once: bool = False,
        is_derivative: bool = False,
        as_graph: Callable[..., tuple[Graph, list[np.ndarray]]] = graph_of,
    ):
        self.once, self.is_derivative = once, is_derivative
        self.graph, self.outputs = as_graph(program)
        nodes, inputs = self.graph.nodes, types_of(program)[0]
        results = [[np.dtype(nodes[k].dtype) for k in x.flat] for x in self.outputs]
        self.bytes_of = [a.size * a.dtype.itemsize for a in inputs] + [sum(d.itemsize for d in x) for x in results]
        self.functions = {
            symbol(node._replace(operation=FMOD) if node.operation == "rem" else node)
            for node in self.graph.nodes
            if node.operation in LIBRARY or node.operation == "rem"
        }
        self.kernel = functools.cache(self._kernel)
        self.target = functools.cache(self._target)

    def _kernel(
        self, groups: Groups, varies: tuple[bool, ...], out_varies: tuple[bool, ...], lanes: int
    ) -> tuple[str, str]:
        """Its name; and its text, where that is to be part of the one function that calls it."""
        of_lanes = functools.partial(llvm_compiler().of_lanes, lanes=lanes)
        graph = self.graph.reading_groups(groups)
        text = Writer(graph, varies, out_varies, lanes, of_lanes, self.is_derivative).text(self.outputs)
        if not self.once:
            return _compiled(text)[1], ""
        return "kernel", text.replace("define void @it(", "define internal void @kernel(")

    def _target(self, sizes: tuple[int, ...], where: Where, groups: Groups, out_where: Where) -> str:
        """The name under which XLA calls the program for a batch of `sizes`, of whose dimensions argument i has those
        in `where[i]`, and result i those in `out_where[i]`. It is called with `groups` of the arguments: one, or
        several numbers as one array.

        **Raises:** `NotScalarError` where this machine lacks a function, `RuntimeError` where LLVM fails.
        """
        missing = sorted(f for f in self.functions if not llvm_compiler().has(f))
        if missing:
            raise NotScalarError(f"{', '.join(missing)} (not in the mathematical library here)")
        bytes_of = [sum(self.bytes_of[i] for i in group) for group in groups] + self.bytes_of[len(where) :]
        where = (*(where[group[0]] for group in groups), *out_where)
        if all(all(w) or not any(w) for w in where):  # one long batch
            sizes, where = (int(np.prod(sizes)),) if sizes else (), tuple((any(w),) if sizes else () for w in where)
        n, varies = len(groups), tuple(bool(w and w[-1]) for w in where)
        # What is called once is to have a short text.
        lanes = min(llvm_compiler().lanes, 1 << (sizes[-1] - 1).bit_length()) if sizes and not self.once else 1
        with llvm_compiler().lock:
            kernel, text = self.kernel(groups, varies[:n], varies[n:], lanes)
            wrapper = wrapper_text(kernel, sizes, where, n, bytes_of, text)
            address, name = _compiled(wrapper, level=0)
            _register(address, name)
        return name


def _compiled(text: str, level: int = 2) -> tuple[int, str]:
    folder = cache_folder()
    return llvm_compiler().compile(text, ObjectCache(folder) if folder else None, level)


@functools.cache
def _register(address: int, name: str) -> None:
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p)(address)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
