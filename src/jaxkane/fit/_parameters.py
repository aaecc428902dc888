"""What a fit may move, and how: bijections from free numbers to parameters. Knows systems' leaves and no dynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._system import System


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter to be found, with what is known about it.

        Free("IBxx", bounds=(0.5, 20.0)), Free(lambda system: system.body.mass, prior=(12.0, 0.5))

    **Arguments:**

    - `where`: a name ("IBxx"), a path ("body.mass"), or a function from the system to a leaf as in `eqx.tree_at`. A
        leaf with axes counts as its entries.
    - `start`: the first guess; by default the system's value.
    - `bounds`: (lower, upper) of which either may be None; it never leaves them. By default (0, None), a logarithmic
        scale, where the parameter is declared positive, and none elsewhere.
    - `scale`: how much is a lot, in the parameter's unit; by default the start's magnitude, or 1 for zero.
    - `prior`: (mean, standard deviation) of what was measured elsewhere.
    - `name`: for tables.
    """

    where: str | Callable[[Any], Any]
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: tuple[float, float] | None = None
    name: str | None = None


@dataclasses.dataclass(frozen=True)
class Gain:
    """The gain of an input, common to all trials: the system receives gain * samples + bias.

    `input`: its name; the rest as in `Free`.
    """

    input: str
    start: float = 1.0
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: tuple[float, float] | None = None
    name: str | None = None


@dataclasses.dataclass(frozen=True)
class _Entry:
    """One free number: entry `place` of leaf `leaf` of the system, or the gain of `input`; bounds and scale settled."""

    name: str
    leaf: int
    place: int
    input: str | None
    start: float
    lower: float | None
    upper: float | None
    scale: float
    prior: tuple[float, float] | None


class Parameters(eqx.Module):
    """The free parameters of a fit: x (p,), zero at the start and about one where much has changed, to values (p,).

        p = p0 + s x,   lower + (p0 - lower) exp(c x),   lower + (upper - lower) logistic(c x + d)

    with c such that dp/dx is the scale at the start: a positive parameter moves as p0 exp(x).
    """

    entries: tuple[_Entry, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.entries)

    @property
    def start(self) -> np.ndarray:
        """Values (p,) at x = 0."""
        return np.array([e.start for e in self.entries])

    def values(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Parameters in their own units."""
        return jnp.stack([_value(e, x[i]) for i, e in enumerate(self.entries)])

    def apply(self, system: System, x: Float[Array, " p"]) -> tuple[System, dict[str, Array]]:
        """The system with these parameters, and the gains of the inputs by name."""
        leaves, structure = jax.tree.flatten(system)
        gains = {}
        for entry, value in zip(self.entries, self.values(x), strict=True):
            if entry.input is not None:
                gains[entry.input] = value
                continue
            leaf = leaves[entry.leaf]
            flat = jnp.ravel(leaf).at[entry.place].set(value.astype(leaf.dtype))
            leaves[entry.leaf] = flat.reshape(leaf.shape)
        return jax.tree.unflatten(structure, leaves), gains

    def prior_residuals(self, x: Float[Array, " p"]) -> Float[Array, " n"]:
        """(p - mean) / deviation of those with a prior."""
        values = self.values(x)
        terms = [(values[i] - e.prior[0]) / e.prior[1] for i, e in enumerate(self.entries) if e.prior]
        return jnp.stack(terms) if terms else jnp.zeros(0, x.dtype)


def _value(e: _Entry, x: Array) -> Array:
    if e.lower is None:
        if e.upper is None:
            return e.start + e.scale * x
        span = e.upper - e.start
        return e.upper - span * jnp.exp(-e.scale / span * x)
    if e.upper is None:
        span = e.start - e.lower
        return e.lower + span * jnp.exp(e.scale / span * x)
    width = e.upper - e.lower
    share = (e.start - e.lower) / width
    return e.lower + width * jax.nn.sigmoid(math.log(share / (1 - share)) + e.scale / (width * share * (1 - share)) * x)


def parameters_of(system: System, free: Sequence[Any] | Any) -> Parameters:
    """The free parameters of a system.

    **Raises:** `ValueError` that names a parameter or input that does not exist, is named twice, or starts outside its
    bounds.
    """
    free = [free] if isinstance(free, (str, Free, Gain)) or callable(free) else list(free)
    entries: list[_Entry] = []
    for item in free:
        if isinstance(item, Gain):
            entries.append(_gain(system, item))
        else:
            entries.extend(_leaf_entries(system, item if isinstance(item, Free) else Free(item)))
    if not entries:
        raise ValueError("`free` names no parameter: give names such as ('IBxx', 'steer_damping').")
    names = [e.name for e in entries]
    places = [(e.leaf, e.place, e.input) for e in entries]
    repeated = sorted({names[i] for i, place in enumerate(places) if place in places[:i]})
    if repeated or len(set(names)) < len(names):
        raise ValueError(f"`free` names {', '.join(repeated) or 'a parameter'} twice: {', '.join(names)}.")
    return Parameters(tuple(entries))


def _gain(system: System, item: Gain) -> _Entry:
    if item.input not in system.inputs:
        raise ValueError(
            f"{type(system).__name__} has no input {item.input!r}; it has {', '.join(system.inputs) or 'none'}."
        )
    return _entry(item.name or f"gain of {item.input}", item, item.start, False, leaf=-1, place=0, input=item.input)


def _leaf_entries(system: System, item: Free) -> list[_Entry]:
    title = type(system).__name__
    leaves, structure = jax.tree_util.tree_flatten_with_path(system)
    numbered = jax.tree.unflatten(structure, range(len(leaves)))  # where a leaf stands, its place in the list
    try:
        chosen = jax.tree.leaves(_follow(numbered, item.where) if isinstance(item.where, str) else item.where(numbered))
    except (AttributeError, IndexError, KeyError, TypeError):
        chosen = []
    if not chosen or not all(isinstance(i, int) and 0 <= i < len(leaves) for i in chosen):
        known = ", ".join(_path_name(path) for path, _ in leaves)
        raise ValueError(f"{title} has no parameter {item.where!r}; it has {known}.")
    entries = []
    for i in chosen:
        path, leaf = leaves[i]
        if not (eqx.is_inexact_array(leaf) and not jnp.issubdtype(leaf.dtype, jnp.complexfloating)):
            raise ValueError(f"{title}.{_path_name(path)} is no real number and cannot be fitted.")
        many = leaf.size > 1 or len(chosen) > 1
        for place, index in enumerate(np.ndindex(leaf.shape)):
            label = (item.name if item.name and not many else _path_name(path)) + (
                str(list(index)) if leaf.ndim else ""
            )
            start = float(leaf[index]) if item.start is None else float(item.start)
            entries.append(
                _entry(label, item, start, _declared_positive(system, path), leaf=i, place=place, input=None)
            )
    return entries


def _entry(name: str, item: Free | Gain, start: float, positive: bool, **where: Any) -> _Entry:
    lower, upper = item.bounds if item.bounds is not None else ((0.0, None) if positive else (None, None))
    if not math.isfinite(start):
        raise ValueError(f"{name} starts at {start}.")
    if (lower is not None and not start > lower) or (upper is not None and not start < upper):
        raise ValueError(f"{name} starts at {start:.6g}, which is not inside its bounds ({lower}, {upper}).")
    if item.prior is not None and not (len(item.prior) == 2 and item.prior[1] > 0):
        raise ValueError(f"{name}: a prior is (mean, standard deviation > 0), got {item.prior}.")
    scale = abs(start) or 1.0
    if item.scale is not None:
        if not item.scale > 0:
            raise ValueError(f"{name}: the scale must be positive, got {item.scale}.")
        scale = float(item.scale)
    return _Entry(name=name, start=start, lower=lower, upper=upper, scale=scale, prior=item.prior, **where)


def _follow(tree: Any, path: str) -> Any:
    for part in path.split("."):
        tree = tree[part] if isinstance(tree, Mapping) else tree[int(part)] if part.isdigit() else getattr(tree, part)
    return tree


def _path_name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path).lstrip(".")


def _declared_positive(system: Any, path: tuple[Any, ...]) -> bool:
    """Whether the field that holds this leaf was declared by `parameter(positive=True)`."""
    positive = False
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            field = {f.name: f for f in dataclasses.fields(system)}.get(key.name)
            positive = bool(field and "jaxkane" in field.metadata and field.metadata["jaxkane"].positive)
            system = getattr(system, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            system = system[key.idx]
        elif isinstance(key, jax.tree_util.DictKey):
            system = system[key.key]
    return positive
