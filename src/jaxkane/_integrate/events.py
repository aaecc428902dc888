"""Events: the quantities of a description that end a motion where they pass zero, and the steps that end there."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.kane import KaneEquations
from .._scalarjit.compat import depends_on
from .._scalarjit.components import Component
from .._scalarjit.function import ScalarFunction
from .._scalarjit.linear import as_vector, determinant
from .._system.system import State, System, unpacked
from .trajectory import Status, reason


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
    found = [_first_crossing(*(jnp.asarray(x, g0.dtype) for x in end)) for end in ends]
    return jnp.stack(found) if found else jnp.zeros_like(g0)


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
    left, right, before, after, any_passes = places[0], places[1], values[0], values[1], jnp.zeros((), bool)
    for i in reversed(range(3)):
        passes = (way * values[i] <= 0) & (way * values[i + 1] >= 0) & (values[i] != values[i + 1])
        passes &= (direction != 0) | (values[i] != 0)
        left, right = jnp.where(passes, places[i], left), jnp.where(passes, places[i + 1], right)
        before, after = jnp.where(passes, values[i], before), jnp.where(passes, values[i + 1], after)
        any_passes |= passes

    # Newton's method inside the bracket; the step that follows is measured anew, so a few digits are enough.
    x = left + (right - left) * _ratio(before, before - after)
    for _ in range(6):
        value = p(x)
        left, right = jnp.where(way * value <= 0, x, left), jnp.where(way * value > 0, x, right)
        newton = x - _ratio(value, p_dot(x))
        x = jnp.where((newton >= left) & (newton <= right), newton, 0.5 * (left + right))
    return jnp.where(any_passes, x, jnp.inf)


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

    program, found = jax.make_jaxpr(named, return_shape=True)(t, state.q, u_all)
    directions = tuple(e.direction if isinstance(e, Crossing) else 0 for e in found.values())
    return Events(tuple(found), directions, any(depends_on(program, [2])))


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


@ScalarFunction
def watched(system: System, t: Component, y: Array, y_dot: Array | None) -> Watched:
    """What may end a motion, of a packed state. `y_dot`: None where no event reads speeds."""
    state, like = unpacked(system, y), y
    now = KaneEquations(system, t, state.q, state.u)
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


class Quantities(NamedTuple):
    """What may end a motion, at one time: `values` (n,) and their `rates` (n,), and a `bound` that nothing may pass."""

    values: Array
    rates: Array
    bound: Array


class Limits(eqx.Module):
    """What ends a motion: its `end` [s], and quantities in these `directions` (see `first_crossing`).

    `numbers` (3,) [s]: how far behind a crossing the last step may end (`resolution`); what is no time (`rounding`);
    and a step that is not halved at the bound (`shortest`).
    """

    directions: tuple[int, ...] = eqx.field(static=True)
    end: Array
    numbers: Array

    @property
    def resolution(self) -> Array:
        return self.numbers[0]

    @property
    def rounding(self) -> Array:
        return self.numbers[1]

    @property
    def shortest(self) -> Array:
        return self.numbers[2]


class EventState(NamedTuple):
    """The state of a controller that stops: that of its inner controller; the quantities at the step's start; which one
    ended the motion, as a float, -1 for none and n for the bound; the end of a step that was taken back, else
    -infinity; and the end of the first step over the bound, else infinity."""

    inner: Any
    start: Quantities | None
    which: Array
    until: Array
    last: Array


class EventController(diffrax.AbstractStepSizeController[Any, Any]):
    """A controller that begins with a given step, and whose last step ends at the last time, or where a quantity
    vanishes. The solution then ends as one with an event.

    The motion is watched through the cubic between both ends of a step: their values and rates. Where that passes zero
    the step is taken back, and made anew to just beyond that time; so long, until the step that ends there is one that
    is right by the inner controller's measure. Two crossings within one step are seen where the cubic sees them.

    A step behind which a quantity is no number is halved; where it is as short as the resolution, the motion ends
    before it as one whose steps became too small, since whether the quantity passed zero cannot be said.

    A step over the bound is halved; where it is as short as the shortest, the motion ends before it. It also ends where
    the first step over the bound did, if shorter ones do not pass it: so near to it, what is found is by chance.

    `watch`: (t, y, args) -> `Quantities`; None where there are none.
    """

    controller: diffrax.AbstractStepSizeController[Any, Any]
    watch: Callable[..., Quantities] | None
    first: Array
    limits: Limits

    def wrap(self, direction: Any) -> EventController:
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, inner = self.controller.init(terms, t0, t1, y0, self.first, args, func, error_order)
        start = self._watched(t0, y0, args)
        if start is not None:
            start = _begun(self.limits, start)
        return end, EventState(inner, start, *(jnp.full_like(t0, x) for x in (-1.0, -jnp.inf, jnp.inf)))

    def adapt_step_size(self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        state: EventState = controller_state
        following: Any = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state.inner
        )
        keep, next_t0, next_t1, jumped, inner, result = following
        now = self._watched(t1, y1_candidate, args)
        step = Step(t0, t1, next_t0, next_t1, jnp.asarray(keep))
        found = _decision(self.limits, state._replace(inner=None), now, step)
        state = found.state._replace(inner=_where(found.unchanged, state.inner, inner))
        result = diffrax.RESULTS.where(found.again, diffrax.RESULTS.successful, result)
        result = diffrax.RESULTS.where(found.ends, diffrax.RESULTS.event_occurred, result)
        result = diffrax.RESULTS.where(found.lost, diffrax.RESULTS.dt_min_reached, result)
        return found.keep, found.next_t0, found.next_t1, jumped, state, result

    def _watched(self, t: Any, y: Any, args: Any) -> Quantities | None:
        # Where steps end has no derivative, and compiling one would take its time.
        still = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x  # noqa: E731
        return None if self.watch is None else self.watch(*jax.tree.map(still, (t, y, args)))


class Step(NamedTuple):
    """A step from `t0` to `t1`, and what the inner controller makes of it: the next step, and whether this is kept."""

    t0: Array
    t1: Array
    next_t0: Array
    next_t1: Array
    keep: Array


class _Decision(NamedTuple):
    """What becomes of a step: whether it is kept; the next one; whether it is made `again`; `ends` the motion; is
    `lost`, since a quantity is no number behind it; whether the inner controller's state is `unchanged`; and the state
    that follows."""

    keep: Array
    next_t0: Array
    next_t1: Array
    again: Array
    ends: Array
    lost: Array
    unchanged: Array
    state: EventState


@ScalarFunction
def _begun(limits: Limits, start: Quantities) -> Quantities:
    # What would have vanished within a rounding error of the start is on zero there.
    on_zero = jnp.abs(start.values) <= jnp.abs(start.rates) * limits.rounding
    return start._replace(values=jnp.where(on_zero, jnp.zeros_like(start.values), start.values))


@ScalarFunction
def _decision(limits: Limits, state: EventState, now: Quantities | None, step: Step) -> _Decision:
    # One function of scalars: as a hundred operations it would be as many programs, and half of XLA's work.
    # What is left of a step that was taken back is gone at once: a fixed step stays on its grid.
    going_on = step.keep & (step.t1 < state.until)
    step = step._replace(next_t1=jnp.where(going_on, state.until, step.next_t1))
    none = jnp.zeros_like(step.keep)
    found = _Decision(step.keep, step.next_t0, step.next_t1, none, none, none, going_on, state)
    if now is not None:
        found = _watching(limits, state, now, step, going_on)
    # As diffrax does it, a last step is none of a rounding error, and one that was not kept is halved.
    near = found.next_t1 > limits.end - 100 * jnp.finfo(limits.end.dtype).eps * jnp.abs(limits.end)
    last = jnp.where(found.keep, limits.end, found.next_t0 + 0.5 * (limits.end - found.next_t0))
    arrived = found.keep & (found.next_t0 >= limits.end)
    return found._replace(next_t1=jnp.where(near, last, found.next_t1), ends=found.ends | arrived)


def _watching(limits: Limits, state: EventState, now: Quantities, step: Step, going_on: Array) -> _Decision:
    start: Any = state.start
    t0, t1 = jax.lax.stop_gradient((step.t0, step.t1))
    h, kept = t1 - t0, step.keep
    unknown = kept & functools.reduce(operator.or_, [x != x for x in now.values], jnp.array(False))
    lost = unknown & (h <= limits.resolution)
    kept &= ~unknown
    first, x = _first(limits, start, now, h)
    crossed = kept & (x <= 1)
    over = kept & (start.bound * now.bound < 0)
    at_bound = (over & (h <= limits.shortest)) | (kept & ~over & (t1 >= state.last))
    at_start = crossed & (x == 0) & ~over
    there = crossed & ((1 - x) * h <= limits.resolution) & ~over & ~at_start & ~at_bound
    at_start &= ~at_bound
    again = ((crossed | over) & ~there & ~at_start & ~at_bound) | (unknown & ~lost)
    beyond = jnp.where(over | unknown, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * limits.resolution)
    taken_back = again | at_start | at_bound | lost
    which = jnp.where(there | at_start, first, jnp.where(at_bound, float(len(limits.directions)), state.which))
    return _Decision(
        keep=step.keep & ~taken_back,
        next_t0=jnp.where(taken_back, step.t0, step.next_t0),
        next_t1=jnp.where(again, t0 + beyond, step.next_t1),
        again=again,
        ends=there | at_start | at_bound,
        lost=lost,
        unchanged=going_on | taken_back,
        state=EventState(
            inner=None,
            start=_where(kept & ~taken_back, now, start),
            which=which,
            until=jnp.where(again & ~over, jnp.maximum(state.until, t1), state.until),
            last=jnp.where(over, jnp.minimum(state.last, t1), state.last),
        ),
    )


def _first(limits: Limits, start: Quantities, now: Quantities, h: Array) -> tuple[Array, Array]:
    """Which quantity passes zero first in a step, and where in [0, 1]; infinite if none does."""
    direction = jnp.asarray(limits.directions, h.dtype)
    # Where a quantity has no rate, as a norm at zero, the chord has to do.
    chord = now.values - start.values
    slopes = [jnp.where(jnp.abs(rates) < jnp.inf, h * rates, chord) for rates in (start.rates, now.rates)]
    x = first_crossing(start.values, slopes[0], now.values, slopes[1], direction)
    # What is to vanish within a rounding error behind the step vanishes at its end.
    coming = (now.values * now.rates < 0) & (direction * now.rates >= 0)
    coming &= jnp.abs(now.values) <= jnp.abs(now.rates) * limits.rounding
    x = jnp.where(coming, jnp.minimum(x, 1.0), x)
    first, where = jnp.full_like(h, -1.0), jnp.full_like(h, jnp.inf)
    for i in reversed(range(len(limits.directions))):
        nearer = x[i] <= where
        first, where = jnp.where(nearer, float(i), first), jnp.where(nearer, x[i], where)
    return first, where


class AdaptiveToStops(EventController, diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """`EventController` around a controller with tolerances, which implicit solvers ask for."""

    @property
    def rtol(self) -> Any:  # type: ignore[override]
        return self.controller.rtol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def atol(self) -> Any:  # type: ignore[override]
        return self.controller.atol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def norm(self) -> Any:  # type: ignore[override]
        return self.controller.norm  # pyright: ignore[reportAttributeAccessIssue]


def _where(condition: Any, x: Any, y: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), x, y)
