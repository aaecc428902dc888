"""Check values that callers pass in order or by name. Depends on the names of a system, but not on mechanics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._common.lookup import checked, not_there, refuse_any, refuse_if, refuse_unknown
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, Numbers, component
from .._system.system import System

Row = tuple[Component, ...]

# Arguments of compiled functions, after `checked_arrays`: all of one dtype.
Time = Float[Array, ""]  # [s]
Coordinates = Float[Array, " n_q"]
Speeds = Float[Array, " n"]
PackedState = Float[Array, " n_y"]
InputArrays = dict[str, Float[Array, ""]]

InputValues = Mapping[str, Component] | None
"""Inputs by name, as users pass them; omitted ones are zero."""


def as_row(values: PyTree, names: Sequence[str], label: str) -> Row:
    """Convert a sequence, or an array of shape (len(names),), to a row of components."""
    if hasattr(values, "shape"):
        array = as_array(values, names, label)
        return tuple(array[i] for i in range(len(names)))
    if not isinstance(values, Iterable) or isinstance(values, Mapping):
        raise TypeError(f"{label} must be {len(names)} numbers in a sequence ({', '.join(names)}), got {values!r}.")
    try:
        row = tuple(component(x) for x in values)
    except TypeError as error:
        raise TypeError(f"{label} must be {len(names)} numbers ({', '.join(names)}): {error}") from None
    if len(row) != len(names):
        raise ValueError(f"{label} must have {len(names)} entries ({', '.join(names)}), got {len(row)}.")
    return row


def as_array(values: PyTree, names: Sequence[str], label: str) -> Array:
    """Convert numbers, in order or by name, to a float array of shape (len(names),). Omitted names are zero."""
    array = by_names(values, names, label) if isinstance(values, Mapping) else _numbers(values, names, label)
    if not _is_real(array):
        raise TypeError(f"{label} must be {len(names)} real numbers ({', '.join(names)}), got {values!r}.")
    if not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(float)
    if array.shape != (len(names),):
        hint = " For a batch use jax.vmap." if array.ndim > 1 else ""
        raise ValueError(f"{label} must have the shape ({len(names)},): {', '.join(names)}. Got {array.shape}.{hint}")
    return array


def _is_real(array: Numbers) -> bool:
    if getattr(array.dtype, "kind", "") == "m" or np.ma.is_masked(array):  # np.timedelta64 has its own unit
        return False
    return jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)


def is_concrete(*trees: Any) -> bool:
    """Whether no array in these trees is traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def is_one_number(value: object) -> bool:
    """Whether the value is one real number, concrete or traced."""
    return is_numeric(value) and not isinstance(value, (list, tuple)) and np.shape(value) == ()


def check_number(value: object, what: str, remedy: str = "") -> None:
    """**Raises:** `TypeError` if the value is not one real number, concrete or traced."""
    if not is_one_number(value):
        raise TypeError(f"{what} must be one number, got {value!r}.{remedy}")


def is_numeric(value: object) -> bool:
    """Whether the value is a real number, or an array or a sequence of real numbers, concrete or traced."""
    leaves = jax.tree.leaves(value, is_leaf=lambda x: x is None)
    if not any(isinstance(x, Tracer) for x in leaves):
        leaves = [value]
    try:
        return all(_is_real(x if isinstance(x, jax.Array) else np.asanyarray(x)) for x in leaves)
    except ValueError:  # a nested sequence of uneven lengths
        return False


def check_is_system(system: System) -> None:
    """**Raises:** `TypeError` if the argument is not an instance of `System`. `ValueError` without coordinates or
    speeds, unless it has first-order states only."""
    remedy = f" Create one with {system.__name__}(...)." if isinstance(system, type) else ""
    checked(system, System, "The first argument must be an instance of a System", remedy)
    groups = {"coordinates": system.coordinates, "speeds": (*system.speeds, *system.dependent_speeds)}
    for what, names in groups.items() if any(groups.values()) or not system.states else ():
        refuse_if(not names, f"{type(system).__name__} has no {what}. Name them in its class: {what} = (...).")


def has_multipliers(system: System) -> bool:
    """Whether the constraints of a system have multipliers instead of dependent speeds."""
    return hasattr(system, "multiplier_residuals")


def refuse_multipliers(system: System) -> None:
    """**Raises:** `ValueError` for a system of `with_multipliers`, whose equations are more than M u_dot = f."""
    if has_multipliers(system):
        raise ValueError(
            f"{type(system).__name__} has multipliers: it can be assembled, simulated and swept, but this function "
            "does not contain its constraint forces. Pass the system without multipliers (its attribute `inner`)."
        )


def check_time(name: str, t: Component) -> None:
    """Raise an exception if `t` is not one finite number. `name` is the name of the system."""
    check_number(t, f"{name}: the time `t`")
    if not isinstance(t, Tracer) and not np.isfinite(np.asarray(t)):
        raise ValueError(f"{name}: the time t = {t} is not finite.")


def _numbers(values: PyTree, names: Sequence[str], label: str) -> Array:
    try:
        return jnp.asarray(values)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{label} must be {len(names)} numbers ({', '.join(names)}), got {values!r}.") from None


def by_names(values: Mapping[str, Any], names: Sequence[str], label: str) -> Array:
    """Convert numbers by name to an array (*batch, len(names)). Omitted names are zero."""
    refuse_unknown(values, names, f"{label} has no", "it has")
    # Use NumPy for concrete numbers: JAX would compile one program for each operation.
    is_traced = any(isinstance(x, Tracer) for value in values.values() for x in jax.tree.leaves(value))
    xp: Any = jnp if is_traced else np
    dtype = jnp.result_type(float)
    for name, value in values.items():
        if not is_numeric(value):
            raise TypeError(f"{label}: {name!r} must be a real number, or an array of such, got {value!r}.")
    columns = [xp.asarray(values.get(name, 0.0), dtype=dtype) for name in names]
    return jnp.asarray(xp.stack(xp.broadcast_arrays(*columns), axis=-1) if columns else np.zeros(0, dtype), dtype=dtype)


def refuse_incomplete(system: System, q: Numbers, u: Numbers) -> None:
    """Raise an exception if a dict omits a dependent coordinate or contains a dependent speed.

    Only `assemble` solves for omitted dependent coordinates, and for omitted speeds of a system with multipliers.
    Elsewhere, zero would be a wrong value for them.
    """
    name = type(system).__name__
    speeds = (*system.speeds, *system.dependent_speeds)
    for label, values, names in (("q", q, system.coordinates), ("u", u, speeds)):
        if isinstance(values, Mapping):
            refuse_unknown(values, names, f"{name}: {label} has no", "it has")
    missing = [c for c in system.dependent_coordinates if c not in q] if isinstance(q, Mapping) else []
    label, determined = "q", missing
    if not missing and isinstance(u, Mapping) and u and has_multipliers(system):
        label, determined = "u", [s for s in system.speeds if s not in u]
    after = ", which the others determine. Find the state with jaxkane.assemble(system, q, u) and "
    refuse_any(determined, f"{name}: {label} omits", f"{after}pass its state.{label}, or pass the value in {label}.")
    dependent = [s for s in system.dependent_speeds if s in u] if isinstance(u, Mapping) else []
    after = ", but dependent speeds are computed from the others. Omit it. "
    after += "jaxkane.assemble accepts it and compares it with the velocity residuals."
    refuse_any(dependent, f"{name}: u contains", after)


def inputs_of(system: System) -> str:
    """A phrase for the names that `loads` can read, for error messages."""
    return f"the inputs{' and states' if system.states else ''} of {type(system).__name__}"


class Inputs(dict[str, Component]):
    """Inputs and states by name, as passed to `loads`. An unknown name raises an error that lists the known names."""

    def __init__(self, values: Mapping[str, Component], of: str):
        super().__init__(values)
        self._of = of

    def __missing__(self, name: str) -> Component:
        raise not_there(name, self, self._of)


def checked_inputs(system: System, inputs: Mapping[str, Component] | None) -> dict[str, Component]:
    """All inputs of a system by name. Omitted inputs are exact zeros."""
    return checked_values(system, inputs, states=())


def checked_values(
    system: System, values: Mapping[str, Component] | None, states: Sequence[str] | None = None
) -> dict[str, Component]:
    """All inputs and states of a system by name, as passed to `loads`. Omitted ones are exact zeros."""
    states = system.states if states is None else states
    names, kind, title = (*system.inputs, *states), "input or state" if states else "input", type(system).__name__
    if not checked(values, Mapping | None, f"{title}: the inputs must be a dict {{name: number}}"):
        return dict.fromkeys(names, 0.0)
    refuse_unknown(values, names, f"{title} has no {kind} named", "it has")  # pyright: ignore[reportArgumentType]
    numbers = {name: values.get(name, 0.0) for name in names}  # pyright: ignore[reportOptionalMemberAccess]
    for name, value in numbers.items():
        check_number(value, f"{title}: the {kind} {name!r}")
    return {name: component(value) for name, value in numbers.items()}
