"""Events: the quantities of a description that end a motion where they pass zero, and the steps that end there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import depends_on
from .._scalarjit.components import Component, as_vector, determinant
from .._scalarjit.function import ScalarFunction
from .._system.system import State, System, unpacked
from .status import REASONS


class Crossing(eqx.Module):
    """A quantity that counts only where it passes zero in one direction. See `rising` and `falling`."""

    value: Any
    direction: int = eqx.field(static=True)


def rising(quantity: Component) -> Crossing:
    """For `System.events`: the motion ends where the quantity passes zero upwards.

        def events(self, t, q, u):
            return {"top": jk.falling(u["climb"]), "door": jk.rising(q["x"] - self.length)}

    A motion that starts on zero ends at once if the quantity leaves it upwards, and goes on if it does not.
    """
    return Crossing(quantity, 1)


def falling(quantity: Component) -> Crossing:
    """For `System.events`: the motion ends where the quantity passes zero downwards. See `rising`."""
    return Crossing(quantity, -1)


def first_crossing(
    g0: Float[Array, " n"],
    slope0: Float[Array, " n"],
    g1: Float[Array, " n"],
    slope1: Float[Array, " n"],
    direction: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Where in [0, 1] cubics through two ends first pass zero; infinite where they do not.

    **Arguments:** values `g0`, `g1` and slopes at 0 and 1; `direction`: 1 upwards, -1 downwards, 0 both. What is zero
    at 0 passes it if it leaves in its direction; without a direction, nothing passes zero at 0.
    """
    ends = zip(g0, slope0, g1, slope1, direction, strict=True)
    places = [_first_crossing(*(jnp.asarray(x, g0.dtype) for x in end)) for end in ends]
    return jnp.stack(places) if places else jnp.zeros_like(g0)


def _first_crossing(g0: Array, slope0: Array, g1: Array, slope1: Array, direction: Array) -> Array:
    """Of one cubic: scalars, so that all of it can be one function."""
    a, b, c = 2 * (g0 - g1) + slope0 + slope1, 3 * (g1 - g0) - 2 * slope0 - slope1, slope0
    p = lambda x: ((a * x + b) * x + c) * x + g0  # noqa: E731
    p_dot = lambda x: (3 * a * x + 2 * b) * x + c  # noqa: E731

    # Between its extrema a cubic passes zero once at most.
    low, high = _extrema(a, b, c)
    places = (jnp.zeros_like(a), low, high, jnp.ones_like(a))
    values = (g0, p(low), p(high), g1)
    # Which way it must go: without a direction, away from the side that it is on.
    side = jnp.where(g0 != 0, g0, jnp.where(values[1] != 0, values[1], jnp.where(values[2] != 0, values[2], g1)))
    way = jnp.where(direction == 0, -jnp.sign(side), direction)
    left, right, before, any_passes = places[0], places[1], values[0], jnp.zeros((), bool)
    for i in reversed(range(3)):
        passes = (way * values[i] <= 0) & (way * values[i + 1] >= 0) & (values[i] != values[i + 1])
        left, right = jnp.where(passes, places[i], left), jnp.where(passes, places[i + 1], right)
        before, any_passes = jnp.where(passes, values[i], before), any_passes | passes

    # Newton's method, on the side of the inflection on which the root is: from where the cubic bends away from zero it
    # passes over no root. The step that follows is measured anew, so a few digits are enough.
    inflection = jnp.clip(_ratio(-b, 3 * a), left, right)
    is_behind = way * p(inflection) < 0
    left, right = jnp.where(is_behind, inflection, left), jnp.where(is_behind, right, inflection)
    x = jnp.where((before == 0) | (way * (3 * a * (left + right) + 2 * b) < 0), left, right)
    for _ in range(6):
        slope = p_dot(x)
        stays = (p(x) == 0) | (slope == 0)
        x = jnp.where(stays, x, x * x * (2 * a * x + b) - g0) / jnp.where(stays, 1.0, slope)
        x = jnp.clip(x, 0.0, 1.0)  # rounding errors beside a double root send it anywhere
    # Infinity by a division: XLA computes in each of its kernels anew what comes after the last one.
    return jnp.where(any_passes, jnp.clip(x, left, right), 1.0) / jnp.where(any_passes, 1.0, 0.0)


def _extrema(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Where 3 a x^2 + 2 b x + c vanishes, within [0, 1] and in their order; 0 where it does not."""
    discriminant = b**2 - 3 * a * c
    q = -(b + jnp.where(b < 0, -1.0, 1.0).astype(b.dtype) * jnp.sqrt(jnp.maximum(discriminant, 0.0)))
    inside = lambda x: jnp.where((discriminant > 0) & (x > 0) & (x < 1), x, 0.0)  # noqa: E731
    x, y = inside(_ratio(q, 3 * a)), inside(_ratio(c, q))
    return jnp.minimum(x, y), jnp.maximum(x, y)


def _ratio(x: Array, y: Array) -> Array:
    return jnp.where(y == 0, 0.0, x / jnp.where(y == 0, 1.0, y))


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

    program, events = jax.make_jaxpr(named, return_shape=True)(t, state.q, u_all)
    directions = tuple(e.direction if isinstance(e, Crossing) else 0 for e in events.values())
    return Events(tuple(events), directions, any(depends_on(program, [2])))


def _events(system: System, t: Component, q: Any, u_all: Any, dtype: Any) -> dict[str, Any]:
    events = system.events(t, q, u_all)
    if not isinstance(events, Mapping):
        raise TypeError(f"{type(system).__name__}.events returns quantities by name, a dict; got {events!r}.")
    reserved = [name for name in events if name.replace("_", " ") in REASONS]
    if reserved:
        raise ValueError(f"{type(system).__name__}: an event is called {reserved[0]!r}, the reason of another end.")
    return {name: _as_float(name, events[name], dtype) for name in sorted(events)}


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


class EventValues(NamedTuple):
    """What may end a motion, at one time: all events (n,), their time derivatives (n,) along the motion, and a `bound`
    that nothing may pass: det C_dep. Where that vanishes, the independent speeds do not determine the dependent."""

    values: Array
    rates: Array
    bound: Array


@ScalarFunction
def event_values(system: System, t: Component, y: Array, y_dot: Array | None) -> EventValues:
    """Those of a packed state. `y_dot`: None where no event reads speeds."""
    state, like = unpacked(system, y), y
    equations = KaneEquations(system, t, state.q, state.u)
    det = determinant(equations.C_dep) if equations.k else 1.0
    u_all_dot: Any = (0.0,) * len(equations.u_all)
    if y_dot is not None:
        u_dot = tuple(unpacked(system, y_dot).u)
        u_all_dot = (*u_dot, *equations.dependent_accelerations(u_dot))

    def read(t: Component, q: Any, u_all: Any) -> Array:
        events = _events(system, t, q, u_all, like.dtype).values()
        return as_vector([e.value if isinstance(e, Crossing) else e for e in events], like)

    point, direction = (equations.t, equations.q, equations.u_all), (1.0, equations.q_dot, u_all_dot)
    as_like = lambda xs: jax.tree.map(lambda x: jnp.asarray(x, like.dtype), xs)  # noqa: E731
    values, rates = jax.jvp(read, as_like(point), as_like(direction))
    return EventValues(values, rates, as_vector([det], like)[0])


class EventPoint(NamedTuple):
    """Beside an event: `t` [s] and the packed state `y`, after a `step`, and whether they move smoothly with what they
    come from."""

    t: Array
    y: Array
    step: Array
    smooth: Array


@ScalarFunction.once
def next_point(system: System, point: EventPoint, y_dot, read_rates, reach, which, happened) -> EventPoint:
    """After a step of Newton's method towards the event `which`, a float; no step where none `happened`.

        t - g / g_dot,   y - (g / g_dot) y_dot

    It is smooth where the event is within `reach` [s]. The rates g_dot and y_dot are taken for numbers. `read_rates`:
    y_dot, None where no event reads speeds.
    """
    quantities = event_values(system, point.t, point.y, read_rates)
    g, g_dot = quantities.values[0], quantities.rates[0]
    for i in range(1, len(quantities.values)):
        g, g_dot = (jnp.where(which == i, x[i], x0) for x, x0 in ((quantities.values, g), (quantities.rates, g_dot)))
    g_dot = jax.lax.stop_gradient(g_dot)
    is_small = jnp.abs(g) <= jnp.abs(g_dot) * reach
    moves = happened & is_small & (g_dot != 0)
    step = jnp.where(moves, -g / jnp.where(moves, g_dot, jnp.ones_like(g_dot)), jnp.zeros_like(g))
    return EventPoint(point.t + step, point.y + step * y_dot, step, point.smooth & is_small)
