"""Numbers of a structure, which are exact, and of parameters. Knows no joint."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from .._scalars.types import Triple


def unit_vector(axis: Any, name: str) -> Triple:
    """A direction as three floats of length 1; what is zero or one but for rounding is made so."""
    a = exact_numbers(axis, f"The axis of {name!r}")
    length = float(np.linalg.norm(a)) if a.shape == (3,) else 0.0
    if not length > 0.0:
        raise ValueError(f"The axis of {name!r} is three numbers that are not all zero, got {axis!r}.")
    return tuple(exact(x) for x in a / length)  # type: ignore[return-value]


def exact_numbers(values: Any, what: str) -> np.ndarray:
    """Numbers of a structure, by which programs are kept: nothing is differentiated by them.

    **Raises:** `TypeError` for what is traced; `ValueError` for what is no finite number.
    """
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(values)):
        raise TypeError(
            f"{what} is part of the structure, of exact numbers: it cannot be traced, as by jax.jit, jax.grad or "
            "jax.vmap. Places, masses, inertias, gains, dampers and springs can."
        )
    try:
        numbers = np.asarray(values)
    except (TypeError, ValueError):
        numbers = np.array(None)
    if numbers.dtype.kind not in "iuf" or not np.all(np.isfinite(numbers)):  # text that reads as a number is none
        raise ValueError(f"{what}: finite numbers are asked for, got {values!r}.")
    return numbers.astype(float)


def exact(x: float) -> float:
    """A direction cosine, freed from the rounding of the angle that it came from."""
    nearest = float(round(x))
    return nearest if abs(x - nearest) < 1e-15 else float(x)


def is_structural_zero(value: Any) -> bool:
    """A zero that was written as a number is structure and costs nothing; a JAX array is a parameter whatever it is."""
    return not isinstance(value, jax.Array) and np.ndim(value) == 0 and not isinstance(value, str) and value == 0


def components(name: str, values: Any) -> dict[str, Any]:
    """Three numbers as parameters `name.x`, `name.y`, `name.z`."""
    if not hasattr(values, "__len__") or len(values) != 3:
        raise ValueError(f"{name} has three components, got {values!r}.")
    return {f"{name}.{end}": x for end, x in zip("xyz", values, strict=True) if not is_structural_zero(x)}
