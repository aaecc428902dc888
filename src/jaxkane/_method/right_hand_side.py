"""The right-hand side: rates of coordinates, speeds and states of the first order. Knows the method; no integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import Array

from .._common.lookup import refuse_unknown
from .._description.motion import Motion
from .._description.system import State, System, packed, unpacked
from .._scalars.fuse import fused, is_native
from .._scalars.linear import as_vector, is_written_out
from .._scalars.types import Component
from .kane import Instant
from .now import Now, read_at
from .rates import motion_rates
from .values import Row, as_row


def _state_rates(system: System, t: Component, q: Row, u: Row, motion: Motion, now: Now) -> Row:
    names, label = system.states, f"{type(system).__name__}.state_rates"
    return named_row(system.state_rates(t, q, u, [now[name] for name in names], motion, now), names, label)


def named_row(rates: Any, names: Sequence[str], label: str) -> Row:
    """Numbers in the order of `names`, or by name in a dict, as a row of components.

    **Raises:** `ValueError` or `TypeError` for what is not one number for each name.
    """
    if isinstance(rates, Mapping):
        refuse_unknown(rates, names, f"{label} names what is no state:")
        missing = [name for name in names if name not in rates]
        if missing:
            raise ValueError(f"{label} gives no rate of {', '.join(missing)}.")
        rates = [rates[name] for name in names]
    if isinstance(rates, (float, int)) or (hasattr(rates, "shape") and not rates.shape):
        rates = (rates,)  # the rate of a single state needs no tuple
    return as_row(rates, names, label)


def rates(system: System, t: Array, q: Array, u: Array, values: dict[str, Array]) -> State:
    """The right-hand side: the time derivatives of coordinates, independent speeds and states of the first order, from
    arrays that are known to fit; `values` of inputs and states by name."""
    if not system.states:
        return State(*motion_rates(system, t, q, u, values))
    x = as_vector([values[name] for name in system.states], q)
    return unpacked(system, packed_rates(system, t, packed(State(q, u, x)), values))


def packed_rates(system: System, t: Array, y: Array, inputs: Mapping[str, Any]) -> Array:
    """The right-hand side as a solver asks for it: of a packed state (n_q + n_u + n_x,), packed, so that one array goes
    through the steps."""
    if is_written_out(len(system.speeds)):
        return _packed_rates(system, t, y, dict(inputs))
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
    x_dot = first_order_rates(system, t, state.q, state.u, values, u_dot) if system.states else None
    return packed(State(q_dot, u_dot, x_dot))


def rates_are_native(system: System, t: Array, y: Array, inputs: Mapping[str, Any]) -> bool:
    """Whether `packed_rates` of these is one native kernel."""
    return is_written_out(len(system.speeds)) and is_native(_packed_rates, system, t, y, dict(inputs))


def values_of(system: System, x: Array | None, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs and states by name, as `loads` reads them; `x` (..., n_x)."""
    return {**inputs, **{name: x[..., i] for i, name in enumerate(system.states)}} if x is not None else dict(inputs)


@fused
def _packed_rates(system, t, y, inputs):
    state = unpacked(system, y)
    now = Instant(system, t, state.q, state.u, values_of(system, state.x, inputs))
    u_dot = now.accelerations()
    x_dot = read_at(now, u_dot, _state_rates) if system.states else ()
    return as_vector((*now.q_dot, *u_dot, *x_dot), y)


@fused
def first_order_rates(system, t, q, u, inputs, u_dot):
    """x_dot (n_x,) at the accelerations u_dot (n,)."""
    now = Instant(system, t, q, u, inputs)
    return as_vector(read_at(now, as_row(u_dot, system.speeds, "u_dot"), _state_rates), q)
