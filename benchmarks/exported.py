"""The bicycle's right-hand side as exported C: nanoseconds for each state, against SymPy's C and the native kernel."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

import jaxkane as jk

from . import _bicycle as bicycle
from ._figures import Figure
from ._peers import here
from ._process import Setting
from ._timing import in_turns

N = 4096

LOOP = """
#include "bicycle.h"

void loop(int n, const double *q, const double *u, const double *inputs, const bicycle_parameters *p, double *q_dot,
          double *u_dot) {
    for (int i = 0; i < n; i++) bicycle_rates(0.0, q + 8 * i, u + 3 * i, inputs, p, q_dot + 8 * i, u_dot + 3 * i);
}
"""


def measure(setting: Setting) -> Iterator[Figure]:
    if not here("SymPy + C"):
        return
    states = bicycle.leaning(64 if setting.quick else N)
    q, u = bicycle.on_cpu((states.q, states.u))
    n = len(q)
    accelerations = jax.jit(jax.vmap(lambda q, u: jk.accelerations(bicycle.BICYCLE, 0.0, q, u)))
    expected = np.asarray(accelerations(q, u))
    ours, found = compiled(Path(setting.folder) / "generated", np.asarray(q), np.asarray(u))
    ours()
    bicycle.agree("exported C", found, expected, 1e-12)
    c = bicycle.compiled_c(setting.folder)
    y, p, dy = bicycle.with_dependent_speeds(states), bicycle.parameters(), np.empty((n, 14))
    bicycle.agree("SymPy + C", c.batch(p, y, dy)[:, 8:11], expected, 1e-9)
    rivals = {
        "ours": ours,
        "SymPy's": lambda: c.batch(p, y, dy),
        "native": lambda: accelerations(q, u).block_until_ready(),
    }
    best = in_turns(rivals, 0.1 if setting.quick else 5.0)
    for name, what in (("ours", "exported C"), ("SymPy's", "SymPy's C"), ("native", "the native kernel, in lanes")):
        yield Figure("exported", f"a state, {what}", 1e9 * best[name] / n, "ns")
    ratio = best["ours"] / best["SymPy's"]
    yield Figure("exported", "exported C, scalar loop, time against SymPy's C", ratio, at_most=1.0)


def compiled(folder: Path, q: np.ndarray, u: np.ndarray) -> tuple[Callable[[], None], np.ndarray]:
    """What asks the exported C for the rates at states (n, 8), (n, 3), and the accelerations (n, 3) that it writes."""
    from .bicycle_in_c import FLAGS, compiler

    files = jk.export.c(bicycle.BICYCLE, folder / "bicycle.c", ("rates",))
    loop, library = folder / "loop.c", folder / "bicycle_rates.so"
    loop.write_text(LOOP, encoding="utf-8")
    subprocess.run([str(compiler()), *FLAGS, str(files.source), str(loop), "-o", str(library), "-lm"], check=True)
    f = ctypes.CDLL(str(library)).loop
    p = np.array([float(x) for x in jk.export.parameters(bicycle.BICYCLE).values()])
    q_dot, u_dot = np.empty_like(q), np.empty_like(u)
    arrays = (q, u, np.zeros(3), p, q_dot, u_dot)
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]

    def ask() -> None:
        assert arrays  # kept alive by this
        f(len(q), *pointers)

    return ask, u_dot
