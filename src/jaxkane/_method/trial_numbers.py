"""Trial numbers in the place of those that are traced, and what a system is apart from its numbers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._description.system import System
from .._scalars.versions import version_of


def structure_of(system: System) -> tuple[Any, ...]:
    """What a description is, apart from the values of its parameters."""
    return (version_of(system), jax.tree.structure(system), *(np.shape(x) for x in jax.tree.leaves(system)))


def dtype_of(system: System) -> Any:
    """The type of a system's parameters; that of Python's floats where it has none."""
    leaves = [x for x in jax.tree.leaves(system) if hasattr(x, "dtype")]
    dtypes = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    return np.result_type(*dtypes) if dtypes else jnp.result_type(float)


def with_trial_numbers(tree: tuple[System, Any, Any], rng: np.random.Generator) -> tuple[System, Any, Any]:
    """Numbers for what is traced: positive parameters, small coordinates; arrays of length 1, as axes and quaternions
    are, and unit matrices."""
    system, t, q = tree

    def parameter(x: Any) -> Any:
        if not isinstance(x, Tracer):
            return x
        if np.ndim(x) == 2 and x.shape[0] == x.shape[1]:
            return np.eye(len(x), dtype=x.dtype)
        value = rng.uniform(0.5, 1.5, x.shape)
        return np.asarray(value / np.linalg.norm(value) if value.ndim else value, x.dtype)

    system = jax.tree.map(parameter, system)
    if q is None or isinstance(q, Tracer):
        n, dtype = len(system.coordinates), dtype_of(system) if q is None else q.dtype
        q = rng.uniform(0.1, 0.5, n) * rng.choice((-1.0, 1.0), n)
        q = q.astype(dtype)
    return system, 0.3 if isinstance(t, Tracer) else t, np.asarray(q)
