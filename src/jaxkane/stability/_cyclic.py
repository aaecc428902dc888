"""Which coordinates nothing depends on. Knows a description's rates; knows no mechanism."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .._check import configuration_residual
from .._rates import state_rates
from .._system import System

_FOUND: dict[tuple, tuple[str, ...]] = {}
_TRIALS = 3


def cyclic_coordinates(system: System) -> tuple[str, ...]:
    """Names of the cyclic (ignorable) coordinates: those that may be shifted without any other rate noticing.

    Neither the accelerations, nor the configuration constraints, nor the rates of the other coordinates depend on
    them: a bicycle's wheel angles, yaw and place. They may grow in a steady motion, in which the others stand still.

    Found by shifting each coordinate at trial states with trial parameters, once for each class and shape of the
    parameters: a dependence that vanishes for special parameters (a spring of zero stiffness) counts as one.
    """
    leaves, treedef = jax.tree.flatten(system)
    key = (type(system), str(treedef), tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves))
    if key not in _FOUND:
        with jax.ensure_compile_time_eval():
            _FOUND[key] = _search(system, leaves, treedef)
    return _FOUND[key]


def _search(system: System, leaves: list, treedef) -> tuple[str, ...]:
    names = system.coordinates
    n_q, n = len(names), len(system.speeds)
    notices = np.zeros((n_q + 1, n_q), bool)  # row: a rate, the last those of the speeds and the constraints
    rng = np.random.default_rng(0)
    dtype = jnp.result_type(*leaves) if leaves else jnp.zeros(()).dtype
    eps = float(jnp.finfo(dtype).eps)
    for _ in range(_TRIALS):
        trial = jax.tree.unflatten(treedef, [jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) for x in leaves])
        q, u = rng.uniform(-0.4, 0.4, n_q), rng.uniform(-1.0, 1.0, n)

        def at(q, trial=trial, u=u):
            q, u = jnp.asarray(q, dtype), jnp.asarray(u, dtype)
            q_dot, u_dot = state_rates(trial, jnp.zeros((), dtype), q, u, {})
            h = configuration_residual(trial, jnp.zeros((), dtype), q)
            return np.asarray(q_dot), np.concatenate([u_dot, h])

        rates, rest = at(q)
        for i in range(n_q):
            rates_i, rest_i = at(q + 0.3 * np.eye(n_q)[i])
            for row, (a, b) in enumerate([*zip(rates, rates_i, strict=True), (rest, rest_i)]):
                a, b = np.atleast_1d(a), np.atleast_1d(b)
                finite = np.isfinite(a) & np.isfinite(b)
                size = 1.0 + np.abs(a[finite]).max(initial=0.0)
                notices[row, i] |= bool(np.any(np.abs(b - a)[finite] > eps**0.6 * size))
    kept = notices[-1].copy()  # not cyclic: the accelerations notice them,
    while (more := kept | notices[:-1][kept].any(axis=0)).sum() > kept.sum():
        kept = more  # or the rate of one that is not cyclic does
    return tuple(name for name, k in zip(names, kept, strict=True) if not k)
