"""Events: functions of a system that cross zero, and the search for the first crossing; how a simulation ended.

An event ends the simulation, or changes the state (`jumps.py`).
"""

from __future__ import annotations

import dataclasses
import enum
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from .._kane.arguments import is_numeric
from .._kane.contact.forces import NO_CONTACTS, ContactLayout, layout_of
from .._kane.contact.impulses import Impact
from .._kane.contact.laws import OPEN
from .._kane.kanes_method import KaneEquations
from .._scalarjit.compat import depends_on
from .._scalarjit.components import Component, as_vector, determinant
from .._scalarjit.scalar_function import ScalarFunction
from .._system.system import NamedVector, State, System, call_with_states, unpacked


class Status(enum.IntEnum):
    """How a simulation ended. Codes from `EVENT` on are the system's events in alphabetical order."""

    COMPLETED = 0
    """The last time was reached."""
    SINGULAR_SPEEDS = 1
    """The independent speeds no longer determine the dependent ones: det C_dep crossed zero."""
    STEP_TOO_SMALL = 2
    """The step size fell below its minimum, e.g. because a value grows without bound."""
    MAX_STEPS = 3
    """The solver took `max_steps` steps before the last time."""
    INVALID = 4
    """A parameter or an initial value was not finite, a positive parameter was not positive, a body had an impossible
    mass or inertia, or the coordinates violated a configuration constraint. Nothing was solved."""
    INTERRUPTED = 5
    """A sweep was interrupted before this member was computed."""
    NO_SOLUTION = 6
    """The equations have no finite solution at the initial state: a speed does not move any mass, angles are in gimbal
    lock, or the constraints have no solution for the dependent speeds. `simulate` raises an exception instead."""
    MAX_JUMPS = 7
    """More than `max_jumps` jumps occurred before the last time."""
    REPEATED_JUMP = 8
    """A jump left its own event on zero and crossing again, so it would be repeated without end."""
    IMPOSSIBLE_JUMP = 9
    """The state after a jump is not finite, or it violates a configuration constraint."""
    UNDETERMINED_CONTACT = 10
    """The laws of contact and friction have no solution, e.g. for the rod of Painleve."""
    INVALID_COEFFICIENT = 11
    """The restitution of a contact left the range from 0 to 1, or a friction became negative or larger than the static
    friction."""
    EVENT = 12


def reason(code: int, events: tuple[str, ...]) -> str:
    """A status code in words; `events` are the names of a system's events."""
    name = events[code - Status.EVENT] if code >= Status.EVENT else Status(code).name.lower()
    return name.replace("_", " ")


REASONS = frozenset(reason(code, ()) for code in Status if code < Status.EVENT)
_ADVICE: dict[int, str] = {
    Status.SINGULAR_SPEEDS: "Simulate jaxkane.with_multipliers(system), or choose other dependent speeds: "
    "see jaxkane.best_dependent_speeds(system, t, q).",
    Status.STEP_TOO_SMALL: "A value grows without bound or is discontinuous. Plot the last samples before `t_end`.",
    Status.MAX_JUMPS: "Increase max_jumps. If jumps accumulate at one time, end the simulation there by another event.",
    Status.IMPOSSIBLE_JUMP: "Check `then` of the event at `t_end`. New coordinates must satisfy the constraints.",
    Status.UNDETERMINED_CONTACT: "Rigid contacts with this friction have no solution. Reduce the friction.",
    Status.INVALID_COEFFICIENT: "Limit the coefficients of contacts and dry friction: 0 <= restitution <= 1 and "
    "0 <= kinetic <= static friction.",
    Status.REPEATED_JUMP: "Let `then` move the event function away from zero, or change the direction of its rate.",
    Status.MAX_STEPS: "Increase max_steps (an input sample needs a step), or check for stiff or discontinuous loads.",
}


def advice(code: int, events: tuple[str, ...]) -> str:
    """Advice for a simulation that ended early; empty if there is none."""
    if reason(code, events).startswith("gimbal lock"):
        return "The angles are in gimbal lock. Use Euler parameters or another sequence of angles for the orientation."
    return _ADVICE.get(code, "")


Then: TypeAlias = Mapping[str, Component] | Impact | Callable[..., Any] | Sequence[Any] | None
"""What an event does to the state, see `falling`."""


@dataclasses.dataclass(frozen=True)
class Crossing:
    """An event function with a direction of crossing. See `rising` and `falling`.

    Fields:

    - `value`: the event function. `direction`: 1 upwards, -1 downwards, 0 both.
    - `stages`: what changes the state, in order. Empty if the event ends the simulation.
    - `when`: a quantity that must be positive at the event, or None.
    """

    value: Any
    direction: int
    stages: tuple[Any, ...] = ()
    when: Any = None

    def __post_init__(self):
        for name, x in (("quantity", self.value), ("when", 1.0 if self.when is None else self.when)):
            is_boolean = getattr(x, "dtype", type(x).__name__) == "bool"  # rejected later
            if not (is_numeric(x) or is_boolean):
                raise TypeError(f'rising, falling: `{name}` must be a number, such as q["angle"]; got {x!r}.')


def rising(quantity: Component, *, then: Then = None, when: Component | None = None) -> Crossing:
    """For `System.events`: an event where the quantity crosses zero upwards. See `falling`."""
    return Crossing(quantity, 1, _stages(then), when)


def falling(quantity: Component, *, then: Then = None, when: Component | None = None) -> Crossing:
    """For `System.events`: an event where the quantity crosses zero downwards.

        def events(self, t, q, u):
            bounce = {"climb": -self.restitution * u["climb"]}
            return {
                "floor": jk.falling(q["height"], then=bounce),
                "top": jk.falling(u["climb"]),
            }

    Without `then` the simulation ends at the event. With `then` the state jumps and the simulation continues.
    If the quantity is zero at the start, or after a jump, the event occurs at once if the quantity then decreases.

    **Arguments:**

    - `quantity`: a smooth signed number.
    - `then`: the state after the event. A dict contains new values by name, of coordinates, independent speeds and
        first-order states. All of them are computed from the state before the event. Names that are left out keep their
        values. `then` may also be a `jaxkane.Impact`, a function (t, q, u) or (t, q, u, x) that returns one of both,
        or a tuple of stages. Each stage is computed from the state that the previous stage left.
    - `when`: a number that must be positive at the event. Otherwise the crossing has no effect.
    """
    return Crossing(quantity, -1, _stages(then), when)


def _stages(then: Then) -> tuple[Any, ...]:
    if isinstance(then, (tuple, list)) and not then:
        raise ValueError("`then` is an empty tuple. Pass at least one stage, or omit `then` to end the simulation.")
    return tuple(then) if isinstance(then, (tuple, list)) else () if then is None else (then,)


def first_crossing(
    g0: Float[Array, " n"],
    slope0: Float[Array, " n"],
    g1: Float[Array, " n"],
    slope1: Float[Array, " n"],
    direction: Float[Array, " n"],
    resolution: Array | float = 0.0,
) -> Float[Array, " n"]:
    """Where in [0, 1] cubics through two ends first cross zero; infinity if they do not. A cubic that touches zero and
    turns back does not cross it.

    **Arguments:**

    - `g0`, `g1` (n,): values at 0 and 1.
    - `slope0`, `slope1` (n,): slopes at 0 and 1.
    - `direction` (n,): 1 upwards, -1 downwards, 0 both. A function that is zero at 0 crosses there if it then changes
        in its direction; with the direction 0 it does not.
    - `resolution`: a crossing within this distance of 1 is reported only if the value at 1 has changed its sign.
    """
    ends = zip(g0, slope0, g1, slope1, direction, strict=True)
    places = [_first_crossing(*(jnp.asarray(x, g0.dtype) for x in (*end, resolution))) for end in ends]
    return jnp.stack(places) if places else jnp.zeros_like(g0)


def _first_crossing(g0: Array, slope0: Array, g1: Array, slope1: Array, direction: Array, resolution: Array) -> Array:
    # The first crossing of one cubic. Arguments are scalars, so that everything is one function.
    a, b, c = 2 * (g0 - g1) + slope0 + slope1, 3 * (g1 - g0) - 2 * slope0 - slope1, slope0

    def p(x: Array) -> Array:
        return ((a * x + b) * x + c) * x + g0

    def p_dot(x: Array) -> Array:
        return (3 * a * x + 2 * b) * x + c

    # Between its extrema a cubic crosses zero at most once.
    low, high = _extrema(a, b, c)
    places = (jnp.zeros_like(a), low, high, jnp.ones_like(a))
    # The values at the extrema have rounding errors of this size: (x - 1)^2 has a minimum of -1e-17.
    noise = 8 * jnp.finfo(a.dtype).eps * (jnp.abs(g0) + jnp.abs(g1) + jnp.abs(slope0) + jnp.abs(slope1))
    values = (g0, *(jnp.where((jnp.abs(p(x)) <= noise) & (x > 0), 0.0, p(x)) for x in (low, high)), g1)
    # The sign of the slope at a crossing. With direction 0 the function must leave the side on which it is.
    side = jnp.where(g0 != 0, g0, jnp.where(values[1] != 0, values[1], jnp.where(values[2] != 0, values[2], g1)))
    way = jnp.where(direction == 0, -jnp.sign(side), direction)
    left, right, before, any_passes = places[0], places[1], values[0], jnp.zeros((), bool)
    last, is_after = jnp.where(g0 == 0, -way, g0), way * g1 > 0
    for i in range(3):
        passes = ~any_passes & (way * last < 0) & (is_after if i == 2 else way * values[i + 1] > 0)
        left, right = jnp.where(passes, places[i], left), jnp.where(passes, places[i + 1], right)
        before, any_passes = jnp.where(passes, values[i], before), any_passes | passes
        last = jnp.where(values[i + 1] == 0, last, values[i + 1])

    # Newton's method, on the root's side of the inflection. It starts where the cubic bends away from zero, so it
    # cannot pass a root. A few digits are enough, because the repeated step is evaluated again.
    inflection = jnp.clip(_ratio(-b, 3 * a), left, right)
    is_behind = way * p(inflection) < 0
    left, right = jnp.where(is_behind, inflection, left), jnp.where(is_behind, right, inflection)
    x = jnp.where(
        (jnp.abs(before) <= jnp.finfo(a.dtype).tiny) | (way * (3 * a * (left + right) + 2 * b) < 0), left, right
    )
    for _ in range(6):
        slope = p_dot(x)
        stays = (p(x) == 0) | (slope == 0)
        x = jnp.where(stays, x, x * x * (2 * a * x + b) - g0) / jnp.where(stays, 1.0, slope)
        x = jnp.clip(x, 0.0, 1.0)  # near a double root, rounding errors can move x anywhere
    any_passes &= is_after | (jnp.clip(x, left, right) < 1 - resolution)
    # Infinity by a division: XLA fuses the last operations into each kernel and would compute them several times.
    return jnp.where(any_passes, jnp.clip(x, left, right), 1.0) / jnp.where(any_passes, 1.0, 0.0)


def _extrema(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Zeros of 3 a x^2 + 2 b x + c within [0, 1], in increasing order; 0 for a zero that does not exist there."""
    discriminant = b**2 - 3 * a * c
    q = -(b + jnp.where(b < 0, -1.0, 1.0).astype(b.dtype) * jnp.sqrt(jnp.maximum(discriminant, 0.0)))

    def inside(x: Array) -> Array:
        return jnp.where((discriminant > 0) & (x > 0) & (x < 1), x, 0.0)

    x, y = inside(_ratio(q, 3 * a)), inside(_ratio(c, q))
    return jnp.minimum(x, y), jnp.maximum(x, y)


def _ratio(x: Array, y: Array) -> Array:
    return jnp.where(y == 0, 0.0, x / jnp.where(y == 0, 1.0, y))


class ImpactKind(NamedTuple):
    """A stage of an event that is an `Impact`: the names that it releases, and the number of its residuals."""

    release: tuple[str, ...]
    size: int


StageKind: TypeAlias = ImpactKind | None
"""What a stage of an event does. None: it sets new values."""


def first_impact(kinds: Sequence[StageKind]) -> tuple[int, int]:
    """The first stage of an event that is an impact, and the number of its residuals; (-1, 0) if there is none."""
    return next(((stage, kind.size) for stage, kind in enumerate(kinds) if kind is not None), (-1, 0))


class Events(NamedTuple):
    """The events of a system.

    - `names`: in alphabetical order.
    - `directions`: 1, -1, or 0 for both.
    - `stages`: what each stage of `then` does; empty for an event that ends the simulation.
    - `conditions`: for each event its place among those with `when`, or None.
    - `read_rates`: whether any event uses speeds or first-order states, whose rates the solver must evaluate.
    - `read_time`: whether any event uses the time.
    - `contacts`: for each event that belongs to a contact its place and 0 for the normal, 1 for the tangential
      direction; None for the events of the system.
    - `layout`: the contacts.
    """

    names: tuple[str, ...]
    directions: tuple[int, ...]
    stages: tuple[tuple[StageKind, ...], ...]
    conditions: tuple[int | None, ...]
    read_rates: bool
    read_time: bool
    contacts: tuple[tuple[int, int] | None, ...] = ()
    layout: ContactLayout = NO_CONTACTS

    def with_contacts(self, layout: ContactLayout) -> Events:
        """The same with two events for each contact, in alphabetical order.

        **Raises:** `ValueError` if a contact has the name of an event.
        """
        if not layout.names:
            return self._replace(layout=layout)
        if both := set(self.names) & set(layout.names):
            raise ValueError(f"The name {both.pop()!r} is used twice, for an event and for a contact. Rename one.")
        own = [*zip(*self[:4], [None] * len(self.names), strict=True)]
        of_contacts = [(name, -1, (None,), None, (i, side)) for i, name in enumerate(layout.names) for side in (0, 1)]
        columns = zip(*sorted([*own, *of_contacts], key=lambda event: event[0]), strict=True)
        names, directions, stages, conditions, contacts = (tuple(column) for column in columns)
        return Events(names, directions, stages, conditions, True, self.read_time | layout.reads_time, contacts, layout)

    def closing_at_start(self, y: Array, values: EventValues, rounding: Array) -> Array | None:
        """Whether each function (n,) is the gap of an open contact that touches and closes; None without contacts."""
        if not self.layout.names or values.noise is None:
            return None
        states = y[y.size - self.layout.memory_size :: self.layout.memory_width]
        no = jnp.zeros((), bool)
        opens = [no if x is None or x[1] else states[x[0]] == OPEN for x in self.contacts]
        limit = jnp.maximum(jnp.abs(values.rates) * rounding, 64 * values.noise)
        return jnp.stack(opens) & (jnp.abs(values.values) <= limit) & (values.rates < 0)

    @property
    def n_impulses(self) -> int:
        """The number of impulses of a jump: of the contacts, otherwise of the largest first impact of an event."""
        of_contacts = len(self.layout.names) * (1 + self.layout.d)
        return of_contacts or max([first_impact(kinds)[1] for kinds in self.stages], default=0)

    @property
    def continue_(self) -> bool:
        """Whether any event changes the state, so that the simulation continues."""
        return any(self.stages)


def events_of(system: System, t: Array, state: State) -> Events:
    """The events of a system and of its contacts."""
    return own_events_of(system, t, state).with_contacts(layout_of(system))


def own_events_of(system: System, t: Array, state: State) -> Events:
    """The events of a system. They are traced once to detect their directions and what they use."""
    dtype = state.q.dtype
    u_all = jnp.zeros(len(system.speeds) + len(system.dependent_speeds), dtype)
    x, found = jnp.zeros(len(system.states), dtype), {}

    kinds: dict[str, tuple[StageKind, ...]] = {}

    def values(t: Array, q: Array, u_all: Array, x: Array) -> Any:
        point = t, tuple(q), tuple(u_all), tuple(x)
        found.update(crossings(system, *point, dtype))
        for name, event in found.items():
            thens = [called(system, then, *point) for then in event.stages]
            kinds[name] = tuple(_kind_of(then, f"{type(system).__name__}.events: `then` of {name!r}") for then in thens)
        return [(event.value, event.when) for event in found.values()]

    program = jax.make_jaxpr(values)(t, state.q, u_all, x)
    events = list(found.values())
    conditional = [name for name, event in found.items() if event.when is not None]
    return Events(
        tuple(found),
        tuple(event.direction for event in events),
        tuple(kinds.values()),
        tuple(conditional.index(name) if name in conditional else None for name in found),
        any(depends_on(program, [2, 3])),
        any(depends_on(program, [0])),
    )


def called(
    system: System,
    then: Any,
    t: Component,
    q: Sequence[Component],
    u_all: Sequence[Component],
    x: Sequence[Component],
) -> Any:
    """A stage of an event; if it is a function, its result."""
    if not callable(then):
        return then
    u = NamedVector(u_all, (*system.speeds, *system.dependent_speeds))
    return call_with_states(then, t, NamedVector(q, system.coordinates), u, NamedVector(x, system.states))


def _kind_of(then: Any, label: str) -> StageKind:
    if isinstance(then, Impact):
        return ImpactKind(then.release, len(then.residuals))
    if not isinstance(then, Mapping):
        raise TypeError(
            f"{label} must be a dict of new values by name, a jaxkane.Impact, a function that returns one of both, or "
            f"a tuple of these; got {then!r}."
        )
    return None


def crossings(
    system: System,
    t: Component,
    q: Sequence[Component],
    u_all: Sequence[Component],
    x: Sequence[Component],
    dtype: DTypeLike,
) -> dict[str, Crossing]:
    """The events by name, in alphabetical order, with floats as values.

    **Arguments:**

    - `t`: time [s]. `q`, `u_all`, `x`: coordinates, all speeds, first-order states.
    - `dtype`: the type of the values.

    **Raises:** `TypeError` or `ValueError` for events that are not a dict of numbers by name, or have reserved names.
    """
    x = NamedVector(x, system.states)
    events = call_with_states(system.events, t, q, u_all, x)
    if not isinstance(events, Mapping):
        raise TypeError(f"{type(system).__name__}.events must return a dict of quantities by name; got {events!r}.")
    reserved = [name for name in events if not isinstance(name, str) or name.replace("_", " ") in REASONS]
    if reserved:
        raise ValueError(
            f"{type(system).__name__}: the event name {reserved[0]!r} is reserved, or not a string. Use another name."
        )
    found = {}
    for name in sorted(events):
        is_crossing = isinstance(events[name], Crossing)
        event = events[name] if is_crossing else Crossing(_as_float(name, events[name], dtype), 0)
        when = None if event.when is None else _as_float(name, event.when, dtype, is_condition=True)
        found[name] = dataclasses.replace(event, value=_as_float(name, event.value, dtype), when=when)
    return found


def _as_float(name: str, event: Component, dtype: DTypeLike, is_condition: bool = False) -> Any:
    value, part = jnp.asarray(event), ": `when`" if is_condition else ""
    if value.dtype == bool:
        advice = (
            "a number that is positive where the event may occur, e.g. when=q['x'] instead of when=q['x'] > 0"
            if is_condition
            else "a smooth, signed quantity that is zero at the event, e.g. q['h'] instead of q['h'] < 0. "
            "jaxkane.falling and jaxkane.rising select the direction of the crossing"
        )
        raise TypeError(f"The event {name!r}{part} is a boolean. Return {advice}.")
    if value.shape:
        raise TypeError(
            f"The event {name!r}{part} has the shape {value.shape}. Return one number per name, e.g. one event for "
            "each component."
        )
    return value.astype(dtype)


class EventValues(NamedTuple):
    """The event functions at one time.

    Fields:

    - `values` (n,): the event functions. `rates` (n,): their time derivatives along the trajectory [1/s].
    - `bound`: det C_dep, whose sign must not change. If it is zero, the independent speeds do not determine the
      dependent speeds.
    - `conditions` (m,): the quantities `when` of the events that have one.
    - `noise` (n,): rounding errors of the functions of contacts, zero for events of the system; None without contacts.
      At the start of a step it is None. NaN if a coefficient of friction is impossible.
    """

    values: Array
    rates: Array
    bound: Array
    conditions: Array
    noise: Array | None = None

    def packed(self) -> Array:
        return jnp.concatenate([self.bound[None], self.values, self.rates, self.conditions])

    @classmethod
    def unpacked(cls, numbers: Array, n: int) -> EventValues:
        """The inverse of `packed`, for `n` events."""
        return cls(numbers[1 : n + 1], numbers[n + 1 : 2 * n + 1], numbers[0], numbers[2 * n + 1 :])

    def at_start(
        self,
        events: Events,
        rounding: Array,
        before: EventValues | None = None,
        event: Array | None = None,
        closing: Array | None = None,
    ) -> EventValues:
        """The same where steps begin: at the start, or after the jump of an `event`.

        A function is set to zero if it would reach zero within a rounding error [s]. If its condition is not met, the
        crossing has no effect: the function is set to its sign after the crossing.

        `before`: the values at the jump. Functions that cross zero together with the event have their sign from before
        the crossing (see `with_sides`). Their events follow if the jump does not change them. A function that is zero
        before and after the jump keeps its sign, so an event that has occurred does not occur again. The function of
        the `event` itself changes its sign if it then crosses zero in its direction.

        `closing` (n,): whether it is the gap of a contact that touches and closes at the start of the simulation.
        """
        limit, side = jnp.abs(self.rates) * rounding, jnp.zeros_like(self.values)
        is_due, tiny = jnp.zeros(side.shape, bool), jnp.finfo(side.dtype).tiny
        if before is not None:
            # A ball that stays on the floor has no rate after the impact, only before it.
            limit = jnp.maximum(jnp.abs(self.rates), jnp.abs(before.rates)) * rounding
            side, change = jnp.sign(before.values), jnp.abs(self.values) - jnp.abs(before.values)
            way, places = (jnp.asarray(x, side.dtype) for x in (events.directions, range(len(events.directions))))
            # A rate of 1e-17 m/s after an impact without restitution is a rounding error.
            rests = jnp.abs(self.rates) <= float(jnp.finfo(side.dtype).eps) ** 0.5 * jnp.abs(before.rates)
            self = self._replace(rates=jnp.where((event == places) & rests, 0.0, self.rates))
            side = jnp.where((event == places) & (way * self.rates > 0), way, side)
            is_due = (event != places) & (side * self.values < 0) & (jnp.abs(change) <= 4 * limit)
            # A jump from x to -x does not change the size of a function. It is due only if it was near zero before.
            is_due &= jnp.abs(before.values) <= 4 * limit
            side = jnp.where(is_due | (jnp.abs(before.values) <= 2 * limit), side, 0.0)
        vanishes = jnp.abs(self.values) <= jnp.where(is_due, 4.0, 1.0) * limit
        values = jnp.where(is_due, side * jnp.abs(self.values), self.values)
        values = jnp.where(vanishes, side * tiny, values)
        if any(contact is not None for contact in events.contacts):
            # The states of the contacts were just found, so none of their functions vanishes here.
            of_contacts = jnp.asarray([contact is not None for contact in events.contacts])
            if closing is not None:
                values = jnp.where(closing, 0.0, values)
                of_contacts &= ~closing
            own = jnp.where(of_contacts & vanishes, jnp.maximum(self.rates, 0.0), self.rates)
            values = jnp.where(of_contacts, jnp.maximum(values, tiny), values)
            return self._replace(values=values, rates=own).passed(events, vanishes)
        return self._replace(values=values).passed(events, vanishes)

    def with_sides(self, events: Events, start: EventValues, jumps: Array, resolution: Array) -> EventValues:
        """The same at the end of a step. A function that is zero gets its sign at the `start`. If the step ends at a
        jump (`jumps`), each function that crosses zero there in its direction also gets its sign at the start."""
        side, direction = jnp.sign(start.values), jnp.asarray(events.directions, self.values.dtype)
        way = jnp.where(direction == 0, -side, direction)
        # A crossing whose condition was not met may be earlier in the step.
        near, all_met = jnp.abs(self.values) <= 4 * jnp.abs(self.rates) * resolution, jnp.ones((), bool)
        met = [all_met if i is None else self.conditions[i] > 0 for i in events.conditions]
        crosses = jumps & (way * side <= 0) & (way * self.values >= 0) & (near | jnp.stack(met)) if met else near
        values = jnp.where(self.values == 0, side * jnp.finfo(side.dtype).tiny, self.values)
        return self._replace(values=jnp.where(crosses, side * jnp.abs(values), values))

    def passed(self, events: Events, near: Sequence[Array] | Array) -> EventValues:
        """The same, with the functions that are `near` zero (n,) set to their side after the crossing, where their
        condition is not met. Otherwise the next step would find the same crossing again, and hide later ones."""
        values = list(self.values)
        for i, place in enumerate(events.conditions):
            if place is not None:
                direction = jnp.asarray(events.directions[i], self.values.dtype)
                way = direction if events.directions[i] else jnp.sign(self.rates[i])
                crosses = near[i] & (self.conditions[place] <= 0) & (way * self.rates[i] > 0)
                values[i] = jnp.where(crosses, way * jnp.finfo(self.values.dtype).tiny, values[i])
        return self._replace(values=jnp.stack(values)) if any(x is not None for x in events.conditions) else self

    def growth(self, end: EventValues, h: Array, share: float) -> Array:
        """The largest ratio of the next step to this step, such that no event function oscillates within the next step.

        The error estimate does not contain the event functions. Here the difference between their change and the
        trapezoidal rule is limited to a share of their size. This difference is proportional to h^3.
        """
        growth = jnp.full_like(h, jnp.inf)
        for i in range(self.values.shape[0]):
            g0, s0, g1, s1 = self.values[i], self.rates[i], end.values[i], end.rates[i]
            size = jnp.abs(g0) + jnp.abs(g1) + 0.5 * h * (jnp.abs(s0) + jnp.abs(s1))
            bend = jnp.abs(g1 - g0 - 0.5 * h * (s0 + s1)) - 1e3 * jnp.finfo(h.dtype).eps * size
            if end.noise is not None:  # of a force that vanishes all the time, as between bodies that only touch
                bend = bend - 32 * end.noise[i]
            bends = (bend > 0) & (size < jnp.inf)  # a rate may be infinite, e.g. of a norm at zero
            allowed = jnp.where(bends, share * size, 1.0) / jnp.where(bends, bend, 1.0)
            # Not the cubic root, which is a slow call in native kernels: the fourth root is two square roots.
            growth = jnp.where(bends, jnp.minimum(growth, jnp.maximum(jnp.sqrt(jnp.sqrt(allowed)), 0.5)), growth)
        return growth


@ScalarFunction
def event_values(system: System, t: Component, y: Array, y_dot: Array | None) -> EventValues:
    """The event functions at a packed state. `y_dot`: None if no event uses speeds or first-order states."""
    state, like = unpacked(system, y), y
    equations = KaneEquations(system, t, state.q, state.u)
    det = determinant(equations.C_dep) if equations.k else 1.0
    x = () if state.x is None else tuple(state.x)
    u_all_dot: Any = (0.0,) * len(equations.u_all)
    x_dot: Any = (0.0,) * len(x)
    if y_dot is not None:
        dot = unpacked(system, y_dot)
        u_all_dot = (*dot.u, *equations.dependent_accelerations(tuple(dot.u)))
        x_dot = () if dot.x is None else tuple(dot.x)

    def read(
        t: Component, q: Sequence[Component], u_all: Sequence[Component], x: Sequence[Component]
    ) -> tuple[Array, Array]:
        events = crossings(system, t, q, u_all, x, like.dtype).values()
        conditions = [event.when for event in events if event.when is not None]
        return as_vector([event.value for event in events], like), as_vector(conditions, like)

    point, direction = (equations.t, equations.q, equations.u_all, x), (1.0, equations.q_dot, u_all_dot, x_dot)

    def as_like(xs: PyTree) -> Any:
        return jax.tree.map(lambda x: jnp.asarray(x, like.dtype), xs)

    (values, conditions), (rates, _) = jax.jvp(read, as_like(point), as_like(direction))
    return EventValues(values, rates, as_vector([det], like)[0], conditions)


def first_event(
    events: Events,
    rounding: Array,
    resolution: Array,
    start: EventValues,
    end: EventValues,
    h: Array,
    is_ahead: Array,
    is_last: Array,
) -> tuple[Array, Array]:
    """Which event function first crosses zero in a step, as a float, and where in [0, 1]; infinity if none does.

    If several events occur at the same time, the result is the first in alphabetical order.

    **Arguments:**

    - `events`: their directions. An event whose condition is not met at the crossing is passed over.
    - `rounding`: events within this time are simultaneous [s].
    - `resolution`: the longest time from an event to the end of its step [s].
    - `start`, `end`: the event functions at both ends of the step. `h`: its length [s].
    - `is_ahead`: whether an earlier, longer step has crossed zero.
    - `is_last`: whether the simulation ends at the end of the step.
    """
    # A gap opens like t^3. The cubic through both ends of a step may then be negative by a rounding error.
    shift = 0.0 if end.noise is None else end.noise
    direction = jnp.asarray(events.directions, h.dtype)
    # If a rate is not finite, e.g. of a norm at zero, the slope of the chord is used instead.
    chord = end.values - start.values
    slopes = [jnp.where(jnp.abs(rates) < jnp.inf, h * rates, chord) for rates in (start.rates, end.rates)]
    x = first_crossing(start.values + shift, slopes[0], end.values + shift, slopes[1], direction, resolution / h)
    # A function that is zero at the end, or would be within a rounding error, usually crosses in the next step. There
    # may be none, or another function crosses at the same time. The slope of one that touches zero vanishes.
    way = jnp.where(direction == 0, -jnp.sign(start.values), direction)
    coming = (way * end.values <= 0) & (way * slopes[1] > jnp.finfo(h.dtype).eps ** 0.5 * jnp.abs(chord))
    coming &= jnp.abs(end.values) <= jnp.abs(end.rates) * rounding
    coming &= is_last | (jnp.min(x, initial=jnp.inf) <= 1)
    if end.noise is not None:
        # A gap of two large coordinates does not change in steps that are too short for their digits.
        coming |= is_ahead & (jnp.abs(end.values) <= end.noise) & (direction * end.rates > 0)
    x = jnp.where(coming, jnp.minimum(x, 1.0), x)
    places, event, place = [], jnp.full_like(h, -1.0), jnp.full_like(h, jnp.inf)
    for i, (each, condition) in enumerate(zip(x, events.conditions, strict=True)):
        if not events.contacts or events.contacts[i] is None:
            # The cubic of t^4 crosses zero at the start of a step. A short step decides.
            later = jnp.maximum(each, 2 * jnp.finfo(h.dtype).eps ** 2)
            each = jnp.where(way[i] * end.values[i] > 0, each, later)
        if condition is not None:
            now, later = start.conditions[condition] > 0, end.conditions[condition] > 0
            is_met = jnp.where(is_at_start(each), now, later | (now & ((1 - each) * h > resolution)))
            each = jnp.where(is_met, each, jnp.inf)
        places.append(each)
    first = functools.reduce(jnp.minimum, places, place)
    first += rounding / h
    for i in reversed(range(len(places))):
        event, place = (jnp.where(places[i] <= first, new, old) for new, old in ((float(i), event), (places[i], place)))
    return event, jnp.where(event < 0, jnp.inf, place)


def is_at_start(place: Array) -> Array:
    """Whether a crossing is at the start of the step. A function that is zero there may be marked by a tiny number."""
    return place <= jnp.finfo(place.dtype).eps ** 2


class EventPoint(NamedTuple):
    """A point near an event.

    Fields: time `t` [s] and packed state `y`; the last `step` of Newton iteration [s]; and whether time and state are
    `smooth` functions of the arguments of the simulation.
    """

    t: Array
    y: Array
    step: Array
    smooth: Array


@ScalarFunction.compile_cheaply
def next_point(
    system: System,
    origin: Array,
    point: EventPoint,
    y_dot: Float[Array, " n"],
    read_rates: Float[Array, " n"] | None,
    reach: Array,
    which: Array,
    happened: Array,
) -> EventPoint:
    """The point after a step of Newton's method towards the event `which`, a float; the same if none `happened`.

        t - g / g_dot,   y - (g / g_dot) y_dot

    It is smooth if the event is within `reach` [s]. The rates g_dot and y_dot are treated as constants.
    `origin`: the start of the simulation [s]. `read_rates`: y_dot, None if no event uses speeds.
    """
    quantities = event_values(system, origin + point.t, point.y, read_rates)
    return moved_to_event(quantities, point, y_dot, reach, which, happened)


def moved_to_event(
    quantities: EventValues,
    point: EventPoint,
    y_dot: Array,
    reach: Array,
    which: Array,
    happened: Array,
    instant: Array | float = 0.0,
) -> EventPoint:
    """`next_point`, with the event functions at the point.

    `instant`: a gap of the size of its rounding errors may vanish within this time of the point [s].
    """
    g, g_dot = quantities.values[0], quantities.rates[0]
    for i in range(1, len(quantities.values)):
        g, g_dot = (jnp.where(which == i, x[i], x0) for x, x0 in ((quantities.values, g), (quantities.rates, g_dot)))
    g_dot = jax.lax.stop_gradient(g_dot)
    limit = jnp.abs(g_dot) * reach
    if quantities.noise is not None:
        noise = sum(jnp.where(which == i, x, 0.0) for i, x in enumerate(quantities.noise))
        # `reach` is proportional to the time. At the start it is 1e-27 s, and a gap of 4e-17 m would be too far away.
        limit += jnp.minimum(2 * noise, 1e6 * limit + jnp.abs(g_dot) * instant)
    is_small = jnp.abs(g) <= limit
    moves = happened & is_small & (g_dot != 0)
    step = jnp.where(moves, -g / jnp.where(moves, g_dot, jnp.ones_like(g_dot)), jnp.zeros_like(g))
    t = point.t + step
    t = jnp.where(t < 0, t - jax.lax.stop_gradient(t), t)  # no step can begin before the start
    return EventPoint(t, point.y + step * y_dot, step, point.smooth & is_small)
