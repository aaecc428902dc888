"""Parameters of a system by name or function: the places of its leaves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..._common.lookup import hint
from ..._description.parameters import leaf_name, names_of_leaf
from ..._description.system import System


def one_leaf(system: System, name: str, shape: tuple[int, ...] = ()) -> int:
    """The leaf of this name, which has this shape."""
    (chosen, leaves) = find_leaves(system, name)
    if len(chosen) != 1 or leaves[chosen[0]][1].shape != shape:
        raise ValueError(f"{type(system).__name__}.{name} must have the shape {shape}.")
    return chosen[0]


def find_leaves(system: System, where: str | Callable[[Any], Any]) -> tuple[list[int], list[Any]]:
    """Numbers of the leaves that are meant, and all (path, leaf)."""
    title = type(system).__name__
    leaves, structure = jax.tree_util.tree_flatten_with_path(system)
    if isinstance(where, str):
        chosen = [i for i, (path, _) in enumerate(leaves) if where in names_of_leaf(path)]
    else:
        numbered = jax.tree.unflatten(structure, range(len(leaves)))  # where a leaf stands, its place in the list
        try:
            chosen = jax.tree.leaves(where(numbered))
        except (AttributeError, IndexError, KeyError, TypeError):
            chosen = []
    if not chosen or not all(isinstance(i, int) and 0 <= i < len(leaves) for i in chosen):
        known = [leaf_name(path) for path, _ in leaves]
        raise ValueError(f"{title} has no parameter {where!r}; {hint(str(where), known, 'it has')}")
    for i in chosen:
        path, leaf = leaves[i]
        if not (eqx.is_inexact_array(leaf) and not jnp.issubdtype(leaf.dtype, jnp.complexfloating)):
            raise ValueError(f"{title}.{leaf_name(path)} is no real number and cannot be fitted.")
    return chosen, leaves


def leaf_names(system: System) -> tuple[str, ...]:
    """The names of all parameters of a system, by which they can be freed."""
    return tuple(leaf_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(system)[0])
