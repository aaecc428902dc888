"""The bicycle that all are measured on: that of Meijaard et al. (2007), its rides, and its peers' right-hand sides."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

from ._peers import here

BICYCLE = jk.catalog.WhippleBicycle.benchmark()
TIMES = np.linspace(0.0, 5.0, 51)  # [s]
TOLERANCE = 1e-8
N_Q, N_U = len(BICYCLE.coordinates), len(BICYCLE.speeds)
COLUMNS = (*BICYCLE.coordinates, *BICYCLE.speeds, *BICYCLE.dependent_speeds)  # of y, as SymPy's code has it
FREE = tuple(name for name in vars(BICYCLE) if name != "steer_damping")  # the 26 that SymPy's bicycle has


def starts(n: int) -> jk.State:
    """n upright bicycles: a speed of 4.3 to 6 m/s and a push of 0.1 to 0.5 rad/s each."""
    rng = np.random.default_rng(0)
    speed, push = rng.uniform(4.3, 6.0, n), rng.uniform(0.1, 0.5, n)
    return jk.State(np.zeros((n, N_Q)), np.stack([push, -speed / float(BICYCLE.rR), np.zeros(n)], axis=-1))


def leaning(n: int) -> jk.State:
    """n bicycles with random roll, steer, yaw and rates, and the pitch that belongs to them."""
    rng = np.random.default_rng(1)
    q, u = np.zeros((n, N_Q)), rng.normal(0.0, 1.0, (n, N_U))
    q[:, 0], q[:, 2], q[:, 3] = (rng.uniform(-most, most, n) for most in (0.4, 0.5, 3.0))
    u[:, 1] = -rng.uniform(3.0, 7.0, n) / float(BICYCLE.rR)
    return jk.State(jax.jit(jax.vmap(lambda q: jk.assemble(BICYCLE, q, np.zeros(N_U)).q))(q), u)


def with_dependent_speeds(states: jk.State) -> np.ndarray:
    """(b, 14): the state as SymPy's code has it."""
    u_dep = jax.jit(jax.vmap(lambda q, u: jk.dependent_speeds(BICYCLE, 0.0, q, u)))(states.q, states.u)
    return np.ascontiguousarray(np.concatenate([states.q, states.u, u_dep], axis=-1))


def member(states: jk.State, i: int) -> jk.State:
    return jk.State(states.q[i], states.u[i])


def parameters(**changed: float) -> np.ndarray:
    """The 26 parameters (26,) in the order of SymPy's code."""
    from .bicycle_in_sympy import PARAMETERS

    return np.array([changed.get(name, float(getattr(BICYCLE, name))) for name in PARAMETERS])


@functools.cache
def compiled_c(folder: str) -> Any:
    """SymPy's bicycle as a C module, or None where SymPy or a C compiler is missing."""
    if not here("SymPy + C"):
        return None
    from .bicycle_in_c import build
    from .bicycle_in_sympy import derive

    return build(derive(), Path(folder) / "generated").module


@functools.cache
def pydy_cython(folder: str) -> Callable[..., np.ndarray] | None:
    """PyDy's right-hand side f(y, t, p) in Cython, or None where it is missing."""
    if not here("PyDy's Cython"):
        return None
    from .bicycle_in_sympy import by_pydy, derive

    return by_pydy(derive(), Path(folder) / "generated")


def ride_by(f: Any, y0: np.ndarray, tolerance: float, *args: Any) -> np.ndarray:
    """One ride (n_t, 14) by scipy's odeint."""
    from scipy.integrate import odeint

    return odeint(f, y0, TIMES, args=args, rtol=tolerance, atol=tolerance, mxstep=5000)


def gap(a: Any, b: Any) -> float:
    """The largest difference, relative to the largest of `b`."""
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))) / np.max(np.abs(b)))


def agree(name: str, a: Any, b: Any, tolerance: float) -> None:
    """Refuse to time what does not give the same."""
    found = gap(a, b)
    assert found <= tolerance, f"{name}: differs by {found:.1e} of the largest, allowed are {tolerance:.0e}"


def on_cpu(tree: Any) -> Any:
    return jax.tree.map(jnp.asarray, tree)
