"""Whether a motion can begin, and values in the place of those with which none can. Knows descriptions and arrays."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._description.parameters import parameters_in
from .._description.system import State, System
from .._method.checks import configuration_is_met
from .._scalars.fuse import fused
from .._scalars.nan import all_finite
from .settings import SCALARS_UP_TO
from .signals import signals_are_sound


def _is_few(x: Any) -> bool:
    return eqx.is_inexact_array(x) and 0 < x.size <= SCALARS_UP_TO


def is_rising(ts: Array) -> Array:
    # A window of a fit may stand still at its last time.
    return all_finite(ts) & jnp.all(ts[1:] >= ts[:-1]) & (ts[-1] > ts[0])


def is_valid(system: System, state: State, t: Array, signals: Any, rises: Array | None) -> Array:
    """Whether a motion can begin at `t`; `rises`: whether the times rise, None where that is known."""
    many = eqx.filter((system, state), _is_few, inverse=True)
    others = all_finite(many) & (True if rises is None else rises) & signals_are_sound(signals)
    for value in _positive(system):
        if not _is_few(value):
            others &= jnp.all(value > 0)
    numbers, static = eqx.partition((system, state, t), eqx.is_array)
    return _is_sound(*eqx.combine(jax.lax.stop_gradient(numbers), static), others)


@fused
def _is_sound(system: System, state: State, t: Array, others: Array) -> Array:
    """Whether a motion can begin there, one answer from all the numbers; `others`: from those that are too many."""
    facts = [others, configuration_is_met(system, t, state.q)]
    facts += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, state)) if _is_few(x)]
    return functools.reduce(jnp.logical_and, [*facts, *(jnp.all(x > 0) for x in _positive(system) if _is_few(x))])


def _positive(system: System) -> list[Array]:
    """Values of the parameters that must be positive."""
    return [value for _, value, info in parameters_in(system) if info.positive]


def safe(valid: Array, values: Any) -> Any:
    """The values where they are valid, ones elsewhere."""
    return _replaced(values, lambda xs: _safe_scalars(valid, xs), lambda x: jnp.where(valid, x, jnp.ones_like(x)))


def sound(system: System) -> System:
    """The system with ones for parameters that are not finite, or not positive as they must be: behind a mask these
    would still spoil the reverse gradient of what is shared."""
    must_be = {id(x) for x in _positive(system)}
    scalars = lambda xs: _sound_scalars(_Positive(tuple(id(x) in must_be for x in xs)), xs)  # noqa: E731
    return _replaced(system, scalars, lambda x: _sound_or_one(x, id(x) in must_be))


def _replaced(values: Any, scalars: Callable[[list[Array]], list[Array]], array: Callable[[Array], Array]) -> Any:
    """The values with others for numbers: small arrays all at once, as one program, and large ones each by itself."""
    few, rest = eqx.partition(values, _is_few)
    many, rest = eqx.partition(rest, eqx.is_inexact_array)
    leaves, treedef = jax.tree.flatten(few)
    found = scalars(leaves) if leaves else leaves
    return eqx.combine(jax.tree.unflatten(treedef, found), jax.tree.map(array, many), rest)


class _Positive(eqx.Module):
    """Which of some numbers must be positive."""

    these: tuple[bool, ...] = eqx.field(static=True)


@fused
def _sound_scalars(positive: _Positive, values: list[Array]) -> list[Array]:
    return [_sound_or_one(x, must_be) for x, must_be in zip(values, positive.these, strict=True)]


def _sound_or_one(x: Array, positive: bool) -> Array:
    return jnp.where(jnp.isfinite(x) & (x > 0) if positive else jnp.isfinite(x), x, jnp.ones_like(x))


@fused
def _safe_scalars(valid: Array, values: list[Array]) -> list[Array]:
    return [jnp.where(valid, x, jnp.ones_like(x)) for x in values]
