"""Jumps: events that change the state, after which the simulation continues.

At an event, the time, the state and the state after the jump are

    t* = t - g / g_dot,   y* = y + (t* - t) y_dot,   y+ = then(t*, y*)

from a step that ends within a rounding error of the event. The derivative of these expressions is exact, and the next
step begins at t* with the derivative of t*. Their product is the saltation matrix (Aizerman and Gantmakher 1958,
"Determination of stability by linear approximation of a periodic solution of a system of differential equations with
discontinuous right-hand sides").
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._common.lookup import refuse_unknown
from .._kane.contact.forces import has_contacts
from .._kane.contact.impulses import REDUNDANT, Impact, Permanent, after_impact, inverse_root
from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, as_vector, component, stack
from .._scalarjit.nan import nan_if_not_zero
from .._scalarjit.scalar_function import ScalarFunction
from .._system.parameters import wrapped
from .._system.system import NamedVector, State, System, call_with_states, unpacked
from .events import Events, crossings, events_of


class JumpTable(eqx.Module):
    """The jumps along a trajectory, in their order. Entries from `count` on are NaN.

    Attributes:

    - `t` (m,) [s]: times. Their derivatives are those of the times of the events.
    - `event` (m,): the number of the event, in alphabetical order; -1 if unused. `name(i)` is its name. A contact has
        two events: its normal and its tangential one.
    - `before`, `after`: states before and after the jumps, with arrays (m, ...).
    - `energy` (m,) [J]: the kinetic energy that was lost. It is negative if energy was gained.
    - `impulses` (m, r) [N s or N m s]: of the residuals of the `Impact` of the event. NaN for events without an
        `Impact`, and beyond the number of its residuals. For a system with contacts: of the contacts, in alphabetical
        order, each with its normal impulse first.
    - `inputs`: by name (m,), before and after the jumps.
    - `count`: the number of jumps.
    """

    t: Float[Array, "*batch m"]
    event: Int[Array, "*batch m"]
    before: State
    after: State
    energy: Float[Array, "*batch m"]
    impulses: Float[Array, "*batch m r"]
    inputs: tuple[dict[str, Float[Array, "*batch m"]], ...]
    count: Int[Array, "*batch"]
    names: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        if isinstance(self.count, Tracer) or np.ndim(self.count):
            return f"JumpTable(shape={self.t.shape})"
        n, shown = int(self.count), 8
        items = [f"{self.name(i)} at {float(self.t[i]):.6g} s" for i in range(min(n, shown))]
        more = [f"{n - shown} more"] if n > shown else []
        return wrapped(f"JumpTable({n} jumps{': ' * bool(n)}{', '.join([*items, *more])})")

    def name(self, i: int) -> str:
        """The name of the event of jump `i`."""
        event = int(np.asarray(self.event)[i])
        if event < 0:
            raise IndexError(f"Jump {i} does not exist: there are {int(np.asarray(self.count))} jumps.")
        return self.names[event]


@ScalarFunction
def state_after(system: System, t: Component, y: Array, event: Array, which: StagesOf) -> Array:
    """The packed state after the jump of an event, from the state before it.

    **Arguments:**

    - `t`: time [s]. `y`: packed state. `event`: the number of the event, as a float.
    - `which`: an object whose structure is the numbers of stages, by event (see `stages_of`).
    """
    after = y
    for i in range(len(which.names)):
        if which.stages[i]:
            after = jnp.where(event == i, after_stages(system, t, y, i, which)[0], after)
    return after


@ScalarFunction
def impulses_at(system: System, t: Component, y: Array, event: Array, which: StagesOf) -> Array:
    """The impulses (r,) of the first impact among the stages of an event. Arguments as `state_after`."""
    rows = {i: after_stages(system, t, y, i, which)[1] for i in range(len(which.names)) if which.stages[i]}
    width = max(len(row) for row in rows.values())
    impulses = jnp.full((width,), jnp.nan, y.dtype)
    for i, row in rows.items():
        padded = as_vector([*row, *[jnp.full((), jnp.nan, y.dtype)] * (width - len(row))], y)
        impulses = jnp.where(event == i, padded, impulses)
    return impulses


def after_stages(system: System, t: Component, y: Array, event: int, which: StagesOf) -> tuple[Array, Sequence[Array]]:
    """The packed state after all stages of an event, and the impulses of its first impact."""
    impulses: Sequence[Array] = ()
    for stage in range(which.stages[event]):
        y, more = _after_stage(system, t, y, which.names[event], stage)
        impulses = impulses or more
    return y, impulses


def names_of_jumps(system: System) -> tuple[str, ...]:
    """The names of the events that change the state, and of the contacts."""
    if type(system).events is System.events and not has_contacts(system):
        return ()
    zeros = [jnp.zeros(len(names)) for names in (system.coordinates, system.speeds)]
    events = events_of(system, jnp.zeros(()), State(*zeros))
    names = (name for name, stages in zip(events.names, events.stages, strict=True) if stages)
    return tuple(dict.fromkeys(names))


def refuse_jumps(system: System, label: str, why: str) -> None:
    """**Raises:** `ValueError` if events of the system change its state. `why`: what to do instead."""
    if names := names_of_jumps(system):
        raise ValueError(
            f"{label}: events or contacts of {type(system).__name__} change its state: {', '.join(names)}. {why}"
        )


def warn_of_jumps(system: System, label: str) -> None:
    """Warn that an exported right-hand side does not contain the jumps of a system."""
    if names := names_of_jumps(system):
        warnings.warn(
            f"{label}: events or contacts of {type(system).__name__} change its state: {', '.join(names)}. The "
            "exported functions are valid between the jumps, with open contacts, and do not contain them.",
            stacklevel=3,
        )


class StagesOf(eqx.Module):
    """The static part of `Events` that `state_after` uses."""

    names: tuple[str, ...] = eqx.field(static=True)
    stages: tuple[int, ...] = eqx.field(static=True)


def stages_of(events: Events) -> StagesOf:
    contacts = events.contacts or (None,) * len(events.names)
    stages = [0 if contact else n for n, contact in zip(events.stages, contacts, strict=True)]
    return StagesOf(events.names, tuple(stages))


def _after_stage(system: System, t: Component, y: Array, name: str, stage: int) -> tuple[Array, Sequence[Array]]:
    state = unpacked(system, y)
    x = () if state.x is None else tuple(state.x)
    kane = KaneEquations(system, t, state.q, state.u)

    def then_at(t: Component, q: Sequence[Component], u_all: Sequence[Component]) -> Any:
        then = crossings(system, t, q, u_all, x, y.dtype)[name].stages[stage]
        if callable(then):
            u_names = (*system.speeds, *system.dependent_speeds)
            named = NamedVector(q, system.coordinates), NamedVector(u_all, u_names)
            then = call_with_states(then, t, *named, NamedVector(x, system.states))
        return then

    then = then_at(kane.t, kane.q, kane.u_all)
    if isinstance(then, Impact):
        result = after_impact(kane, then_at).result
        n_q = len(system.coordinates)
        after = jnp.concatenate([y[:n_q], result.u.astype(y.dtype), y[n_q + len(system.speeds) :]])
        return after, list(result.impulses)
    if not isinstance(then, Mapping):
        raise TypeError(
            f"{type(system).__name__}.events: `then` of {name!r} must be a dict of new values by name, a "
            f"jaxkane.Impact, a function that returns one of both, or a tuple of these; got {then!r}."
        )
    names = (*system.coordinates, *system.speeds, *system.states)
    label = f"{type(system).__name__}.events: `then` of {name!r}"
    refuse_unknown(then, names, f"{label}: not a coordinate, an independent speed or a first-order state:")
    new = []
    for i, key in enumerate(names):
        try:
            new.append(component(then[key]) if key in then else y[i])
        except TypeError as error:
            raise TypeError(f"{label}: the new value of {key!r} must be one number, got {then[key]!r}.") from error
    after = jnp.concatenate([as_vector(new, y), y[len(names) :]])
    return _onto_constraints(system, t, after, [key for key in system.speeds if key not in then]), ()


def _onto_constraints(system: System, t: Component, y: Array, names: Sequence[str]) -> Array:
    # For a system with multipliers, the state with speeds that satisfy its constraints; NaN if no such speeds exist.
    #
    # Only speeds in `names` change. If the system without multipliers has dependent speeds, only these change. The
    # change has the smallest kinetic energy.
    state, n_q = unpacked(system, y), len(system.coordinates)
    kane = KaneEquations(system, t, state.q, state.u)
    permanent = Permanent.of(kane)
    if permanent is None:
        return y
    dependent = system.inner.dependent_speeds or system.speeds  # pyright: ignore[reportAttributeAccessIssue]
    free = [i for i, name in enumerate(system.speeds) if name in names and name in dependent]
    change, C, n = jnp.zeros_like(state.u), permanent.C, len(system.speeds)
    if free:
        M = kane.mass_matrix(kane.partial_velocities())
        X = stack(inverse_root([[M[i][j] for j in free] for i in free])).astype(y.dtype)
        A, b = permanent._replace(C=jnp.stack([C[:, i] for i in free], axis=1)).rows(X)
        values = X @ (b @ A)
        change = as_vector([values[free.index(i)] if i in free else 0.0 for i in range(n)], y)
    rest, size = permanent.residuals + C @ change, jnp.abs(C) @ (jnp.abs(state.u) + jnp.abs(change))
    change = jnp.where(jnp.all(jnp.abs(rest) <= REDUNDANT * size), change, jnp.nan)
    return jnp.concatenate([y[:n_q], state.u + change, y[n_q + n :]])


@jax.custom_jvp
def without_derivative_at(near: Array, values: Array, times: Array) -> Array:
    """Values (n_t, n), whose derivative is NaN where a sample is `near` (n_t, m) a jump whose time (m,) has a
    derivative: there the value jumps with the parameters."""
    return values


@without_derivative_at.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
    (near, values, times), (_, values_dot, times_dot) = primals, tangents
    undefined = jnp.broadcast_to(nan_if_not_zero(times_dot, [times])[None], near.shape)
    extra = jnp.sum(jnp.where(near, undefined, jnp.zeros_like(undefined)), axis=1)
    return without_derivative_at(near, values, times), values_dot + jnp.broadcast_to(extra[:, None], values.shape)
