"""Which coordinates nothing depends on. Knows a description's rates; knows no mechanism."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .._description.system import System
from .._method.checks import is_concrete
from .._method.description_facts import configuration_residual
from .._method.right_hand_side import rates as rates_of
from .._method.values import check_is_system
from .._scalars.jax_internals import concretely
from .._scalars.versions import on_forget, version_of

_FOUND: dict[tuple, tuple[str, ...]] = {}
_TRIALS = 3  # at which the rates are finite
_MOST_TRIALS = 12
_SHIFTS = (0.3, -7.0, 150.0)  # of a coordinate [rad, m]: what begins far away counts too
_INPUTS = (1.0, 30.0, 1000.0)  # sizes of trial inputs

on_forget(_FOUND.clear)


def cyclic_coordinates(system: System) -> tuple[str, ...]:
    """Names of the cyclic (ignorable) coordinates: those that may be shifted without a change of any other rate.

    Neither the accelerations, nor the configuration constraints, nor the rates of the other coordinates depend on
    them: a bicycle's wheel angles, yaw and place. They may grow in a steady motion, in which the others stand still.

    Found by shifting each coordinate at trial states, times, inputs and parameters, once for each class and shape of
    the parameters: a dependence that vanishes for special parameters (a spring of zero stiffness), or as long as an
    input is zero (a force that follows a steer angle), counts as one.

    **Raises:** `ValueError` where no trial has finite accelerations.
    """
    check_is_system(system)
    leaves, treedef = jax.tree.flatten(system)
    shapes = tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
    key = (type(system), str(treedef), shapes, version_of(system))
    if key not in _FOUND:
        with concretely():
            _FOUND[key] = _search(system, leaves, treedef)
    return _FOUND[key]


def _search(system: System, leaves: list, treedef) -> tuple[str, ...]:
    names, n_q = system.coordinates, len(system.coordinates)
    rng = np.random.default_rng(0)
    dtype = jnp.result_type(*leaves) if leaves else jnp.zeros(()).dtype
    as_floats = lambda x: jnp.asarray(x, dtype)  # noqa: E731

    @jax.jit
    def rates(trial, t, q, u, w):
        moves = rates_of(trial, t, q, u, w)
        others = [moves.u, configuration_residual(trial, t, q)]
        return moves.q, jnp.concatenate(others if moves.x is None else [*others, moves.x])

    notices = np.zeros((n_q + 1, n_q), bool)  # row: a rate, the last those of the speeds and the constraints
    compared = 0
    for k in range(_MOST_TRIALS):
        # Parameters are about one; where these cannot be, those of the system itself.
        trial = jax.tree.unflatten(treedef, [jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) for x in leaves])
        if k >= _MOST_TRIALS // 2 and is_concrete(leaves):
            trial = system
        q, u = rng.uniform(-0.4, 0.4, n_q), rng.uniform(-1.0, 1.0, len(system.speeds))
        size = _INPUTS[compared % len(_INPUTS)]
        w = {
            name: as_floats(size * rng.choice([-1, 1]) * rng.uniform(0.5, 1.5))
            for name in (*system.inputs, *system.states)
        }
        t, u = as_floats(rng.uniform(0.0, 2.0)), as_floats(u)
        at = lambda q, trial=trial, t=t, u=u, w=w: tuple(map(np.asarray, rates(trial, t, as_floats(q), u, w)))  # noqa: E731
        here = at(q)
        if not all(np.all(np.isfinite(x)) for x in here):
            continue
        for i in range(n_q):
            for shift in _SHIFTS:
                notices[:, i] |= _noticed(here, at(q + shift * np.eye(n_q)[i]), 1 + abs(shift))
        compared += 1
        if compared == _TRIALS:
            break
    if not compared:
        raise ValueError(
            f"{type(system).__name__}: which coordinates are cyclic cannot be found: at none of {_MOST_TRIALS} trial "
            "states, with parameters of about one and with its own, are its accelerations finite."
        )
    kept = notices[-1].copy()  # not cyclic: the accelerations depend on them,
    while (more := kept | notices[:-1][kept].any(axis=0)).sum() > kept.sum():
        kept = more  # or the rate of one that is not cyclic does
    return tuple(name for name, k in zip(names, kept, strict=True) if not k)


def _noticed(here: tuple[np.ndarray, ...], there: tuple[np.ndarray, ...], rounding: float) -> np.ndarray:
    """Which rates of the coordinates, and last whether any of the others, differ beyond rounding."""
    eps = float(np.finfo(here[0].dtype).eps)
    rows = []
    for a, b in (*zip(here[0], there[0], strict=True), (here[1], there[1])):
        a, b = np.atleast_1d(a), np.atleast_1d(b)
        size = rounding * (1.0 + np.abs(a).max(initial=0.0))
        # What is not finite after a shift of a cyclic coordinate was not finite before.
        rows.append(not np.all(np.abs(b - a) <= eps**0.6 * size))
    return np.array(rows)
