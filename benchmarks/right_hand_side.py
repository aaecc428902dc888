"""The right-hand side of the bicycle in a batch: nanoseconds for each state, against SymPy's code."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

import jaxkane as jk

from . import _bicycle as bicycle
from ._figures import Figure
from ._peers import here
from ._process import Setting
from ._timing import in_turns

N = 4096
FEW = 50  # that Python is asked for one after the other


def measure(setting: Setting) -> Iterator[Figure]:
    states = bicycle.leaning(64 if setting.quick else N)
    q, u = bicycle.on_cpu((states.q, states.u))
    n = len(q)
    accelerations = jax.jit(jax.vmap(lambda q, u: jk.accelerations(bicycle.BICYCLE, 0.0, q, u)))
    found = np.asarray(accelerations(q, u))
    rivals = {"ours": lambda: accelerations(q, u).block_until_ready()}
    counts = {"ours": n}

    if here("SymPy + lambdify"):
        y, p, dy = bicycle.with_dependent_speeds(states), bicycle.parameters(), np.empty((n, 14))
        for name, evaluate in one_by_one(setting, p).items():
            bicycle.agree(name, [evaluate(row)[8:11].copy() for row in y[:FEW]], found[:FEW], 1e-9)
            rivals[name] = lambda evaluate=evaluate: [evaluate(row) for row in y[:FEW]]
            counts[name] = min(FEW, n)
        c = bicycle.compiled_c(setting.folder)
        if c:
            bicycle.agree("SymPy + C", c.batch(p, y, dy)[:, 8:11], found, 1e-9)
            rivals["C, scalar loop"] = lambda: c.batch(p, y, dy)
            counts["C, scalar loop"] = n

    best = in_turns(rivals, 0.1 if setting.quick else 5.0)
    each = {name: best[name] / counts[name] for name in rivals}
    yield Figure("right_hand_side", "a state of the batch, jaxkane", 1e9 * each["ours"], "ns", setting.column)
    for name in sorted(set(each) - {"ours"}, key=each.__getitem__):
        yield Figure("right_hand_side", f"a state, SymPy: {name}", 1e9 * each[name], "ns", setting.column)
    if "C, scalar loop" in each:
        ratio, most = each["ours"] / each["C, scalar loop"], setting.pick(2.0, 0.3)
        what = "batch right-hand side, time against SymPy's C, scalar loop"
        yield Figure("right_hand_side", what, ratio, column=setting.column, at_most=most)


def one_by_one(setting: Setting, p: np.ndarray) -> dict:
    """Right-hand sides that Python calls for every state."""
    from .bicycle_in_sympy import by_lambdify, derive

    lambdified = by_lambdify(derive())
    found = {"lambdify and numpy": lambda y: lambdified(y, 0.0, p)}
    cython = bicycle.pydy_cython(setting.folder)
    if cython:
        found["PyDy's Cython"] = lambda y: cython(y, 0.0, p)
    return found
