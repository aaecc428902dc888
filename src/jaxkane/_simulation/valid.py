"""Whether a motion can begin, and values in the place of those with which none can. Knows descriptions and arrays."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._description.parameters import ANY, ParameterInfo, parameters_in
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
    for value, info in _limited(system):
        if not _is_few(value):
            others &= jnp.all(info.allows(value))
    numbers, static = eqx.partition((system, state, t), eqx.is_array)
    return _is_sound(*eqx.combine(jax.lax.stop_gradient(numbers), static), others)


@fused
def _is_sound(system: System, state: State, t: Array, others: Array) -> Array:
    """Whether a motion can begin there, one answer from all the numbers; `others`: from those that are too many."""
    facts = [others, configuration_is_met(system, t, state.q)]
    facts += [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((system, state)) if _is_few(x)]
    facts += [jnp.all(info.allows(x)) for x, info in _limited(system) if _is_few(x)]
    return functools.reduce(jnp.logical_and, facts)


def _limited(system: System) -> list[tuple[Array, ParameterInfo]]:
    """Values of the parameters that cannot be any number, and what they can be."""
    return [(value, info) for _, value, info in parameters_in(system) if info.is_limited]


def safe(valid: Array, values: Any) -> Any:
    """The values where they are valid, ones elsewhere."""
    return _replaced(values, lambda xs: _safe_scalars(valid, xs), lambda x: jnp.where(valid, x, jnp.ones_like(x)))


def sound(system: System) -> System:
    """The system with ones for parameters that are not finite, or that no description can have: behind a mask these
    would still spoil the reverse gradient of what is shared."""
    limits = {id(x): info for x, info in _limited(system)}
    of = lambda x: limits.get(id(x), ANY)  # noqa: E731
    scalars = lambda xs: _sound_scalars(_Limits(tuple(map(of, xs))), xs)  # noqa: E731
    return _replaced(system, scalars, lambda x: _sound_or_one(x, of(x)))


def _replaced(values: Any, scalars: Callable[[list[Array]], list[Array]], array: Callable[[Array], Array]) -> Any:
    """The values with others for numbers: small arrays all at once, as one program, and large ones each by itself."""
    few, rest = eqx.partition(values, _is_few)
    many, rest = eqx.partition(rest, eqx.is_inexact_array)
    leaves, treedef = jax.tree.flatten(few)
    found = scalars(leaves) if leaves else leaves
    return eqx.combine(jax.tree.unflatten(treedef, found), jax.tree.map(array, many), rest)


class _Limits(eqx.Module):
    """What some numbers can be."""

    these: tuple[ParameterInfo, ...] = eqx.field(static=True)


@fused
def _sound_scalars(limits: _Limits, values: list[Array]) -> list[Array]:
    return [_sound_or_one(x, info) for x, info in zip(values, limits.these, strict=True)]


def _sound_or_one(x: Array, info: ParameterInfo) -> Array:
    return jnp.where(info.allows(x), x, jnp.ones_like(x))


@fused
def _safe_scalars(valid: Array, values: list[Array]) -> list[Array]:
    return [jnp.where(valid, x, jnp.ones_like(x)) for x in values]
