"""Outputs of a system by name. Knows the method at an instant; knows no mechanism and no time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._description.motion import Motion
from .._description.system import System
from .._description.vectors import Vector
from .._scalars.components import component
from .._scalars.fuse import fused
from .._scalars.linear import as_vector
from .._scalars.types import Component
from .kane import Instant
from .now import Now, read_at
from .rates import motion_rates
from .values import Row, as_row


def _outputs(system: System, t: Component, q: Row, u: Row, motion: Motion, now: Now) -> dict[str, Component]:
    return flatten_outputs(system, system.outputs(t, q, u, motion, now))


def flatten_outputs(system: System, given: Any) -> dict[str, Component]:
    """Outputs by name, those of nested dicts joined by dots.

    **Raises:** `TypeError` for what is no number; `ValueError` for a name that stands for something else already.
    """
    label = f"{type(system).__name__}.outputs"
    found = _flat(label, given)
    taken = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    twice = [name for name in found if name in taken]
    if twice:
        raise ValueError(
            f"{label}: {', '.join(twice)} is the name of a coordinate, a speed, an input or a state already, and "
            f"trajectories are read by name. Call what a sensor says of it otherwise: {'measured_' + twice[0]!r}."
        )
    return found


def _flat(label: str, given: Any) -> dict[str, Component]:
    if not isinstance(given, Mapping):
        hint = " Does it end without a `return`?" if given is None else ""
        raise TypeError(f"{label} returns numbers by name, in a dict; got {given!r}.{hint}")
    found: dict[str, Component] = {}
    for name, value in given.items():
        if not isinstance(name, str) or not name:
            raise TypeError(f"{label}: the name of an output is a string, got {name!r}.")
        inner = {f"{name}.{k}": x for k, x in _flat(label, value).items()} if isinstance(value, Mapping) else None
        for key, x in ({name: value} if inner is None else inner).items():
            if key in found:
                raise ValueError(f"{label}: the name {key!r} stands for two outputs.")
            found[key] = x if inner is not None else _number(label, key, x)
    return found


def _number(label: str, name: str, value: Any) -> Component:
    if isinstance(value, Vector):
        raise TypeError(f"{label}: {name!r} is a Vector; give its components, as in `a, b, c = v.to(frame)`.")
    try:
        return component(value)
    except TypeError as error:
        raise TypeError(f"{label}: {name!r} is one number: {error}") from None


def has_outputs(system: System) -> bool:
    """Whether a system says anything beside its coordinates, speeds, inputs and states."""
    return type(system).outputs is not System.outputs


def outputs_at(system: System, t: Array, q: Array, u: Array, inputs: Mapping[str, Array]) -> dict[str, Array]:
    """Outputs by name, from arrays that are known to fit; `inputs` holds the states too."""
    if not has_outputs(system):
        return {}
    inputs = dict(inputs)
    return _outputs_now(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


@fused
def _outputs_now(system, t, q, u, inputs, u_dot):
    now = Instant(system, t, q, u, inputs)
    found = read_at(now, as_row(u_dot, system.speeds, "u_dot"), _outputs)
    return {name: as_vector([x], q)[0] for name, x in found.items()}


def output_names(system: System) -> tuple[str, ...]:
    """The names of a system's outputs, in the order of the alphabet."""
    if not has_outputs(system):
        return ()
    q, u = (jnp.zeros(len(names)) for names in (system.coordinates, system.speeds))
    return tuple(jax.eval_shape(lambda t, q, u: outputs_at(system, t, q, u, {}), jnp.zeros(()), q, u))
