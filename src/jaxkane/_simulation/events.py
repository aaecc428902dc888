"""What ends a motion: the quantities of a description that may vanish, and the instant at which one does.

Knows descriptions and their rates; knows no integrator.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._description.system import State, System, unpacked
from .._method.kane import Instant
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, determinant
from .._scalars.types import Component
from .crossings import Crossing
from .trajectory import Status, reason


class Events(NamedTuple):
    """The events of a system: their names in the order of the alphabet, the directions in which they count (1, -1, or 0
    for both), and whether any of them reads speeds."""

    names: tuple[str, ...]
    directions: tuple[int, ...]
    read_speeds: bool


def events_of(system: System, t: Array, state: State) -> Events:
    """What a description says may end its motion."""
    u_all = jnp.zeros(len(system.speeds) + len(system.dependent_speeds), state.q.dtype)

    def named(t: Array, q: Array, u_all: Array) -> dict[str, Any]:
        return _events(system, t, tuple(q), tuple(u_all), q.dtype)

    program, found = jax.make_jaxpr(named, return_shape=True)(t, state.q, u_all)
    directions = tuple(e.direction if isinstance(e, Crossing) else 0 for e in found.values())
    return Events(tuple(found), directions, _is_read(program.jaxpr, program.jaxpr.invars[-1]))


def _is_read(program: Any, variable: Any) -> bool:
    """Whether the results of a program depend on a variable at all."""
    needed = {id(v) for v in program.outvars}
    for equation in reversed(program.eqns):
        if any(id(v) in needed for v in equation.outvars):
            needed |= {id(v) for v in equation.invars}
    return id(variable) in needed


def _events(system: System, t: Component, q: Any, u_all: Any, dtype: Any) -> dict[str, Any]:
    found = system.events(t, q, u_all)
    if not isinstance(found, Mapping):
        raise TypeError(f"{type(system).__name__}.events returns quantities by name, a dict; got {found!r}.")
    reasons = {reason(code, ()) for code in Status if code < Status.EVENT}
    taken = [name for name in found if name.replace("_", " ") in reasons]
    if taken:
        raise ValueError(f"{type(system).__name__}: an event is called {taken[0]!r}, the reason of another end.")
    return {name: _as_float(name, found[name], dtype) for name in sorted(found)}


def _as_float(name: str, event: Any, dtype: Any) -> Any:
    if isinstance(event, Crossing):
        return Crossing(_as_float(name, event.value, dtype), event.direction)
    value = jnp.asarray(event)
    if value.dtype == bool:
        raise TypeError(
            f"The event {name!r} is a truth value, which passes no zero: give the signed, smooth quantity that "
            "vanishes, as q['h'] for q['h'] < 0; jaxkane.falling and jaxkane.rising say in which direction it counts."
        )
    return value.astype(dtype)


class Watched(NamedTuple):
    """All events (n,), their time derivatives (n,) along the motion, and det C_dep: where that vanishes, the dependent
    speeds no longer follow from the independent ones."""

    values: Array
    rates: Array
    determinant: Array


@fused
def watched(system: System, t: Component, y: Array, y_dot: Array | None) -> Watched:
    """What may end a motion, of a packed state. `y_dot`: None where no event reads speeds."""
    state, like = unpacked(system, y), y
    now = Instant(system, t, state.q, state.u)
    det = determinant(now.C_dep) if now.k else 1.0
    u_all_dot: Any = (0.0,) * len(now.u_all)
    if y_dot is not None:
        u_dot = tuple(unpacked(system, y_dot).u)
        u_all_dot = (*u_dot, *now.dependent_accelerations(u_dot))

    def read(t: Component, q: Any, u_all: Any) -> Array:
        events = _events(system, t, q, u_all, like.dtype).values()
        return as_vector([e.value if isinstance(e, Crossing) else e for e in events], like)

    at, along = (now.t, now.q, now.u_all), (1.0, now.q_dot, u_all_dot)
    values, rates = jax.jvp(read, *(jax.tree.map(lambda x: jnp.asarray(x, like.dtype), xs) for xs in (at, along)))
    return Watched(values, rates, as_vector([det], like)[0])


class End(NamedTuple):
    """Where a motion ended: `t` [s], the packed state `y`, and whether both move smoothly with what they come from."""

    t: Array
    y: Array
    smooth: Array


def at_zero(
    system: System, t: Array, y: Array, which: Array, happened: Array, rates: Any, reach: Array, events: Events
) -> End:
    """The instant beside `t` at which the event `which` vanishes, with derivatives up to the second order.

        t_end = t - g / g_dot,   y_end = y + (t_end - t) y_dot,   twice

    To first order that is the implicit function theorem. Here `t` is a number, near enough (within `reach`) that two
    steps of Newton's method are exact, and the packed state `y` is the motion at that time.

    **Arguments:** `rates`: (t, y) -> y_dot; `happened`: False where no event did: then it is `t` itself.
    """
    t = jax.lax.stop_gradient(t)

    def stage(carry: Any, k: Array):
        (t, y), step, smooth = carry
        y_dot = rates(t, y)
        watching = watched(system, t, y, y_dot if events.read_speeds else None)
        g, g_dot = watching.values[which], watching.rates[which]
        # Beside the first point, where to go; there halfway, by the rates in the middle; and there again.
        is_small = jnp.abs(g) <= jnp.abs(g_dot) * reach
        newton = -g / jnp.where(happened & is_small & (g_dot != 0), g_dot, jnp.ones_like(g_dot))
        newton = jnp.where(happened & is_small, newton, jnp.zeros_like(newton))
        step = jnp.where(k == 1, step, newton)
        ahead = jnp.where(k == 0, 0.5 * step, step)
        base = jax.tree.map(lambda x, x0: jnp.where(k == 1, x0, x), (t, y), first)
        moved = jax.tree.map(lambda x, x_dot: x + ahead * x_dot, base, (jnp.ones_like(t), y_dot))
        return (moved, step, smooth & (is_small | (k == 1))), None

    first = (t, y)
    start = (first, jnp.zeros_like(t), jnp.array(True))
    ((t, y), _, smooth), _ = jax.lax.scan(stage, start, np.arange(3))  # pyright: ignore[reportArgumentType]
    return End(t, y, smooth)
