"""Derivatives of a ride of 5 s with respect to all 26 parameters, against finite differences of compiled C.

The Jacobian of the motion at 51 times, by `jax.jacfwd`; the gradient of a scalar, by `jax.grad`. Both are compared with
central differences of odeint with a tolerance of 1e-12, to 1e-4 of the largest of each parameter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

from . import _bicycle as bicycle
from ._figures import Figure
from ._process import Setting
from ._timing import in_turns


def problem(n: int | None = None) -> tuple[Callable[[dict], jax.Array], dict[str, jax.Array]]:
    """The motion (n_t, n_q) as a function of the first n parameters by name, and their values."""
    start = bicycle.on_cpu(bicycle.member(bicycle.starts(1), 0))

    def ride(values):
        changed = dataclasses.replace(bicycle.BICYCLE, **values)
        return jk.simulate(changed, start, bicycle.TIMES).q

    return ride, {name: jnp.asarray(getattr(bicycle.BICYCLE, name)) for name in bicycle.FREE[:n]}


def measure(setting: Setting) -> Iterator[Figure]:
    ride, values = problem(2 if setting.quick else None)
    n = len(values)
    jacobian = jax.jit(jax.jacfwd(ride))
    gradient = jax.jit(jax.grad(lambda values: jnp.sum(ride(values) ** 2)))
    ours = {"forward": lambda: jax.block_until_ready(jacobian(values))}
    if not setting.quick:
        ours["reverse"] = lambda: jax.block_until_ready(gradient(values))
    columns, q = {name: np.asarray(x) for name, x in ours["forward"]().items()}, np.asarray(ride(values))
    if "reverse" in ours:
        forward = [np.sum(2 * q * column) for column in columns.values()]
        bicycle.agree("reverse against forward", list(ours["reverse"]().values()), forward, 1e-6)

    rivals, c = {}, bicycle.compiled_c(setting.folder)
    if c:
        from .bicycle_in_c import by_ctypes

        called, dy = by_ctypes(c), np.empty(14)
        y0 = bicycle.with_dependent_speeds(bicycle.starts(1))[0]
        # The dependent speeds at the start follow from the parameters: here they are zero, or the rolling of the front.
        front = list(bicycle.COLUMNS).index("front_wheel_rate")

        def once(f, tolerance, **changed):
            y = y0.copy()
            radii = [changed.get(name, float(getattr(bicycle.BICYCLE, name))) for name in ("rR", "rF")]
            y[front] = y0[9] * radii[0] / radii[1]
            return bicycle.ride_by(f, y, tolerance, bicycle.parameters(**changed), dy)[:, : bicycle.N_Q]

        for name, x in values.items():
            h = 1e-4 * max(abs(float(x)), 1e-2)
            ahead, behind = (once(c.rhs, 1e-12, **{name: float(x) + s * h}) for s in (1, -1))
            bicycle.agree(f"d ride / d {name}", columns[name], (ahead - behind) / (2 * h), 1e-4)
        for what, f in {"SymPy's C": called, "SymPy's C as a module": c.rhs}.items():
            rivals[what] = lambda f=f: [
                once(f, bicycle.TOLERANCE, **{name: 1.0001 * float(x)}) for name, x in values.items()
            ]

    best = in_turns(ours | rivals, 0.1 if setting.quick else 15.0)
    column = setting.column
    yield Figure("sensitivities", f"{n} sensitivities of a ride, jacfwd", 1e3 * best["forward"], "ms", column)
    if "reverse" in ours:
        yield Figure("sensitivities", "gradient of a scalar of a ride, grad", 1e3 * best["reverse"], "ms", column)
    for what in rivals:
        yield Figure("sensitivities", f"{n} rides by odeint, {what}", 1e3 * best[what], "ms", column)
    for what in rivals:
        least = setting.pick(2.0, 6.0) if what == "SymPy's C" else None
        faster = best[what] / best["forward"]
        row = f"{n} sensitivities, times faster than finite differences, {what}"
        yield Figure("sensitivities", row, faster, column=column, at_least=least)
