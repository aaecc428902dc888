"""Jumps: events that change the state, after which the simulation continues.

At an event, the time, the state and the state after the jump are

    t* = t - g / g_dot,   y* = y + (t* - t) y_dot,   y+ = then(t*, y*)

from a step that ends within a rounding error of the event. The derivative of these expressions is exact, and the next
step begins at t* with the derivative of t*. Their product is the saltation matrix (Aizerman and Gantmakher 1958,
"Determination of stability by linear approximation of a periodic solution of a system of differential equations with
discontinuous right-hand sides").
"""

from __future__ import annotations

import functools
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
from .._kane.contact.impulses import REDUNDANT, Impact, Permanent, impact_at, inverse_root
from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, as_vector, component, is_written_out, stack
from .._scalarjit.nan import nan_if_not_zero
from .._scalarjit.scalar_function import ScalarFunction
from .._system.parameters import wrapped
from .._system.system import State, System, unpacked
from .events import Events, StageKind, called, crossings, events_of, first_impact


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


class StagesOf(eqx.Module):
    """The part of `Events` that `after_jump` uses: the names, and the stages of the system's own events."""

    names: tuple[str, ...] = eqx.field(static=True)
    stages: tuple[tuple[StageKind, ...], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, events: Events, only: int | None = None) -> StagesOf:
        """The stages of all events, or of one."""
        numbered = enumerate(zip(events.stages, events.contacts or [None] * len(events.names), strict=True))
        stages = [own if contact is None and only in (None, i) else () for i, (own, contact) in numbered]
        return cls(events.names, tuple(stages))

    def together(self, stage: int) -> dict[StageKind, list[int]]:
        """The events that have this stage, by what it does: those with the same key are solved together."""
        kinds = [(i, kinds[stage]) for i, kinds in enumerate(self.stages) if len(kinds) > stage]
        keys = {i: kind and kind._replace(size=0) for i, kind in kinds}
        return {key: [i for i in keys if keys[i] == key] for key in keys.values()}


class _StageOf(eqx.Module):
    """One stage of the `events` with these numbers. Called, it is their impact, with the residuals of the one that
    happens. The equations of motion are then evaluated only once.

    - `x`: first-order states. `event`: the number of the event that happens, as a float.
    """

    x: Array | None
    event: Array
    which: StagesOf
    stage: int = eqx.field(static=True)
    events: tuple[int, ...] = eqx.field(static=True)

    def thens(self, system: System, t: Component, q: Sequence[Component], u_all: Sequence[Component]) -> list[Any]:
        """What the stage of each event does."""
        x = () if self.x is None else tuple(self.x)
        found = crossings(system, t, q, u_all, x, self.event.dtype)
        stages = [found[self.which.names[i]].stages[self.stage] for i in self.events]
        return [called(system, then, t, q, u_all, x) for then in stages]

    def __call__(self, system: System, t: Component, q: Sequence[Component], u_all: Sequence[Component]) -> Impact:
        impacts = self.thens(system, t, q, u_all)
        width = max(len(impact.residuals) for impact in impacts)
        values: list[Array] = []
        for i, impact in zip(self.events, impacts, strict=True):
            rows = [row + (0.0,) * (width - len(row)) for row in (impact.residuals, impact.restitution)]
            own = jnp.stack([as_vector(row, self.event) for row in rows])
            values.append(jnp.where(self.event == i, own, values[-1]) if values else own)
        return Impact(list(values[-1][0]), restitution=list(values[-1][1]), release=impacts[0].release)


def after_jump(system: System, t: Component, y: Array, event: Array, which: StagesOf) -> tuple[Array, Array]:
    """The packed state after all stages of an event, and the impulses (r,) of its first impact, NaN beyond the number
    of its residuals.

    **Arguments:**

    - `t`: time [s]. `y`: packed state before the jump. `event`: the number of the event, as a float.
    - `which`: the stages of all events.
    """
    f = after_jump_written_out if is_written_out(len(system.speeds)) else _after_jump
    return f(system, t, y, event, which)


def _after_jump(system: System, t: Any, y: Array, event: Array, which: StagesOf) -> tuple[Array, Array]:
    n_q, n = len(system.coordinates), len(system.speeds)
    impulses = jnp.full(max(first_impact(kinds)[1] for kinds in which.stages), jnp.nan, y.dtype)
    for stage in range(max(map(len, which.stages))):
        state, after = unpacked(system, y), y
        for kind, events in which.together(stage).items():
            read = _StageOf(state.x, event, which, stage, tuple(events))
            if kind is None:
                new = _replaced(system, t, y, read)
            else:
                result = impact_at(system, t, state.q, state.u, {}, read).result
                new = jnp.concatenate([y[:n_q], result.u.astype(y.dtype), y[n_q + n :]])
                for i in events:
                    first, size = first_impact(which.stages[i])
                    if first == stage:
                        own = jnp.concatenate([result.impulses[:size].astype(y.dtype), impulses[size:]])
                        impulses = jnp.where(event == i, own, impulses)
            happens = functools.reduce(jnp.logical_or, [event == i for i in events])
            after = jnp.where(happens, new, after)
        y = after
    return y, impulses


after_jump_written_out = ScalarFunction(_after_jump)


@ScalarFunction
def _replaced(system: System, t: Component, y: Array, read: _StageOf) -> Array:
    """The packed state with the new values of the event that happens."""
    state, after = unpacked(system, y), y
    kane = KaneEquations(system, t, state.q, state.u)
    for i, then in zip(read.events, read.thens(system, kane.t, kane.q, kane.u_all), strict=True):
        after = jnp.where(read.event == i, _with_values(system, t, y, read.which.names[i], then), after)
    return after


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


def _with_values(system: System, t: Component, y: Array, event: str, then: Mapping[str, Component]) -> Array:
    names = (*system.coordinates, *system.speeds, *system.states)
    label = f"{type(system).__name__}.events: `then` of {event!r}"
    refuse_unknown(then, names, f"{label}: not a coordinate, an independent speed or a first-order state:")
    new = []
    for i, key in enumerate(names):
        try:
            new.append(component(then[key]) if key in then else y[i])
        except TypeError as error:
            raise TypeError(f"{label}: the new value of {key!r} must be one number, got {then[key]!r}.") from error
    after = jnp.concatenate([as_vector(new, y), y[len(names) :]])
    return _onto_constraints(system, t, after, [key for key in system.speeds if key not in then])


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
