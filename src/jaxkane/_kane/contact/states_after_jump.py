"""Changes of the contact states: touch-down, impact, rest, slip, stick and lift-off.

All of them happen at jumps. A jump has two stages:

1. If contacts close, one impact with all of them and with the contacts that are closed already (`laws`).
2. For contacts with zero normal velocity, the same laws are solved again, with accelerations and forces instead of
   velocities and impulses. The solution gives their new states.

A contact rests if the rest of its bounces takes a negligible time (see `REST`). This time is added, so that the end of
infinitely many bounces has a derivative.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._scalarjit.nan import constant
from ..._scalarjit.scalar_function import ScalarFunction
from ..._system.system import State, System, packed, unpacked
from ..arguments import InputValues
from ..right_hand_side import values_of, vector_field
from .forces import (
    PENETRATION,
    ContactLayout,
    ContactMemory,
    ContactTerms,
    are_independent,
    event_functions,
    event_sizes,
    forces_in_contact,
    gap_sizes,
    gap_tolerances,
    layout_of,
    projected_speeds,
    solve_forces,
    terms_at,
    without_gaps,
)
from .laws import OPEN, SLIDES, STICKS, Choice, ContactProblem, Slip

REST = 1e-9
"""A contact rests if the rest of its bounces, 2 v / (a (1 - e)), takes less than this share of the duration."""


class ContactEvent(NamedTuple):
    """What happens to c contacts at an event. Fields (c,) are booleans.

    - `touches`: open contacts whose gap vanishes. `opens`: closed contacts whose force vanishes.
    - `slips`: sticking contacts whose friction reaches its limit.
    - `stops`: sliding contacts whose slip along its direction vanishes.
    - `is_own`: whether a contact causes this event. An event of the system may have changed the speeds.
    - `is_start`: whether this is the start of the simulation, where no impact occurs.
    """

    touches: Array
    opens: Array
    slips: Array
    stops: Array
    is_own: Array
    is_start: Array

    @classmethod
    def of_start(cls, touches: Array) -> ContactEvent:
        no = jnp.zeros_like(touches)
        return cls(touches, no, no, no, jnp.array(False), jnp.array(True))


def without_penetration(system: System, t: Array, state: State) -> State:
    """The nearest state without gaps that are slightly negative (see `PENETRATION`), in the metric of M."""
    # The displacement is a constant, so that the derivatives by a start that touches are the same with and without it.
    system, t, q, u = constant((system, t, state.q, state.u))
    none = dict.fromkeys(system.inputs, jnp.zeros_like(t))
    gaps, sizes = gap_sizes(system, t, q, u)
    is_slight = (gaps < -gap_tolerances(sizes)) & (gaps >= -PENETRATION * sizes)

    def step(_: Any, q: Array) -> Array:
        return without_gaps(terms_at(system, t, q, u, none), is_slight, q)

    moved = jax.lax.fori_loop(0, jnp.where(jnp.any(is_slight), 3, 0), step, q) - q
    return State(state.q + moved, state.u, state.x, state.contacts)


def gaps_at_start(system: System, t: Array, state: State) -> tuple[Array, Array]:
    """Which contacts touch (c,), and whether none penetrates by more than a rounding error and their laws are valid."""
    arguments = constant((system, t, state.q, state.u))
    gaps, sizes = gap_sizes(*arguments)
    tolerance = gap_tolerances(sizes)
    laws = terms_at(*arguments, dict.fromkeys(system.inputs, jnp.zeros((), gaps.dtype))).laws
    return jnp.abs(gaps) <= tolerance, jnp.all(gaps >= -tolerance) & laws.are_valid()


def rates_from_motion(system: System, t: Array, y: Array, inputs: dict[str, Array]) -> Array:
    """The packed rates without those of the contact states, at a packed state without contact states."""
    layout = layout_of(system)
    state = unpacked(system, jnp.concatenate([y, jnp.zeros(layout.memory_size, y.dtype)]))
    zero = jnp.zeros_like(t)
    event = ContactEvent.of_start(gaps_at_start(system, t, state)[0])
    found = changed_contacts(system, layout, t, packed(state), inputs, event, zero, zero, (zero, zero))
    return vector_field(system, t, found.y, inputs)[: y.size]


class Change(NamedTuple):
    """The result of `changed_contacts`.

    - `y`: the packed state afterwards.
    - `delay` [s]: duration of the remaining bounces of a contact that comes to rest.
    - `impulses` (c, r): of the impact, zero without one [N s].
    - `is_lawful`: whether the coefficients of the contacts are in their ranges.
    - `is_determined`: whether the contact laws have a solution.
    """

    y: Array
    delay: Array
    impulses: Array
    is_lawful: Array
    is_determined: Array


def changed_contacts(
    system: System,
    layout: ContactLayout,
    t: Array,
    y: Array,
    inputs: dict[str, Array],
    event: ContactEvent,
    reach: Array,
    rest: Array,
    tolerances: tuple[Any, Any],
) -> Change:
    """The contact states after an event, with the impact if contacts close.

    **Arguments:**

    - `t`, `y`, `inputs`: time [s], packed state and inputs at the event.
    - `event`: what happens.
    - `reach`: the time within which events are simultaneous [s].
    - `rest`: a contact rests if the rest of its bounces takes less than this time [s].
    - `tolerances`: relative and absolute, of a step.
    """
    state = unpacked(system, y)
    assert state.contacts is not None
    values = values_of(system, state.x, inputs)
    before: ContactTerms = terms_at(system, t, state.q, state.u, values)
    # Events are simultaneous within their rounding errors, which are large for a gap of large coordinates.
    errors = 256 * float(jnp.finfo(y.dtype).eps) * constant(gap_sizes(system, t, state.q, state.u)[1])
    first: _Impact = _impact(layout, before, state, event, errors, reach, rest)
    given = _Given(system, t, state, values, first, errors, rest, tolerances)
    fixed = constant(given)

    def stage(i: Array, choices: tuple[Choice, Choice]) -> tuple[Choice, Choice]:
        _, last = choices
        problems = fixed.first.problem, _given_impact(layout, fixed, last)[2].problem
        return last, jax.tree.map(functools.partial(jnp.where, i == 0), *problems).choice()

    # The stages are separate programs, because a choice is not part of a program of scalars. A loop makes both choices,
    # because XLA would compile two searches. At the start no contact strikes.
    none = Choice.none(before.v)
    hit, found = jax.lax.fori_loop(jnp.where(event.is_start, 1, 0), 2, stage, (none, none))
    after, second, third = _given_impact(layout, given, hit)
    return _changed(layout, y, after, state, first, second, third, found)


def impact_of_contacts(system: System, t: Array, state: State) -> tuple[Any, ...]:
    """The impact of all contacts that touch at a state without contact states, by the contact laws.

    **Returns:** the speeds (n,), impulses (c r,), lost energy and whether the impulses are unique; whether each contact
    touches, and whether it penetrates (c,); whether the coefficients are in their ranges, and whether there is a
    solution."""
    layout = layout_of(system)
    gaps, sizes = gap_sizes(system, t, state.q, state.u)
    tolerance, none = gap_tolerances(sizes), jnp.zeros_like(t)
    touches = (jnp.abs(gaps) <= tolerance) & ~jnp.asarray(layout.is_bearing)
    memory = jnp.zeros(layout.memory_size, gaps.dtype)
    state = State(state.q, state.u, contacts=memory)
    terms = terms_at(system, t, state.q, state.u, dict.fromkeys(system.inputs, none))
    event = ContactEvent.of_start(touches)._replace(is_start=jnp.array(False))
    first: _Impact = _impact(layout, terms, state, event, jnp.zeros_like(gaps), none, none)
    found: _AfterImpact = _after_impact(layout, first, first.problem.choice())
    p = found.impulses.reshape(-1)
    # The power of the impulses is that of the mean speeds, also on a surface that moves.
    energy = -0.5 * p @ (terms.C @ (state.u + found.u))
    states = jnp.where(found.is_impact & touches, found.states, 0.0)
    is_unique = are_independent(layout, terms, ContactMemory.unpacked(layout, memory)._replace(states=states))
    result = found.u, p, energy, is_unique
    return result, touches, gaps < -tolerance, found.is_lawful, found.is_determined


class _Given(NamedTuple):
    system: System
    t: Array
    state: State
    values: InputValues
    first: _Impact
    errors: Array
    rest: Array
    tolerances: tuple[Array, Array]


def _given_impact(
    layout: ContactLayout, given: _Given, hit: Choice
) -> tuple[ContactTerms, _AfterImpact, _Accelerations]:
    system, t, state, values, first, errors, rest, tolerances = given
    second: _AfterImpact = _after_impact(layout, first, hit)
    after: ContactTerms = terms_at(system, t, state.q, second.u, values)
    return after, second, _accelerations(layout, after, state, first, second, errors, rest, tolerances)


class _Impact(NamedTuple):
    """The impact if contacts close. (c,) unless stated otherwise.

    - `problem`: the contact problem of the impact.
    - `u` (n,): speeds before the impact.
    - `before`: the terms at these speeds.
    - `event`: the event, corrected: contacts whose normal force is zero open.
    - `closed`: whether a contact is closed before.
    - `near`: whether it closes within `reach` of the event.
    - `takes_part`: whether it is closed or closes now.
    - `strikes`: whether it takes part and its gap closes.
    - `rests`: whether its bounces end with this impact.
    - `bounces`: the time that all remaining bounces take [s].
    """

    problem: ContactProblem
    u: Array
    before: ContactTerms
    event: ContactEvent
    closed: Array
    near: Array
    takes_part: Array
    strikes: Array
    rests: Array
    bounces: Array


@ScalarFunction
def _impact(
    layout: ContactLayout,
    before: ContactTerms,
    state: State,
    event: ContactEvent,
    errors: Array,
    reach: Array,
    rest: Array,
) -> _Impact:
    memory, bearing = ContactMemory.unpacked(layout, cast(Array, state.contacts)), jnp.asarray(layout.is_bearing)
    # Closed contacts have no velocity: the error of the solver must not become an impact.
    u = jnp.where(event.is_own, projected_speeds(layout, before, memory, state.u), state.u)
    before = before._replace(v=before.v + (before.C @ (u - state.u)).reshape(before.v.shape))
    closed = (memory.states >= SLIDES) & ~bearing
    v_N = before.v[:, 0]
    # The limit of the friction and the normal force may vanish together. Then the contact opens.
    forces = solve_forces(layout, before, memory).forces
    vanishes = ~bearing & (forces[:, 0] * before.mobility[:, 0] <= 1e-8 * before.a_size[:, 0])
    opens, slips = event.opens | (event.slips & vanishes), event.slips & ~vanishes
    event = event._replace(opens=opens, slips=slips)
    near = (memory.states == OPEN) & ~bearing & (jnp.abs(before.gaps) <= jnp.abs(v_N) * reach + errors)
    closes, mobility = v_N < -_negligible(before)[:, 0], before.mobility[:, 0]
    # Beside an impact, an approach with 1e-20 of its energy is a rounding error.
    energies = jnp.where(closes, v_N**2 / jnp.where(mobility > 0, mobility, 1.0), 0.0)
    closes &= energies >= 1e-20 * jnp.max(energies, initial=0.0)
    takes_part = (closed | event.touches | near) & ~bearing & ~(event.is_start & closes)
    strikes = takes_part & closes & ~(closed & event.is_own)
    # With all contacts open, a body would not approach the resting body on which it bounces.
    pushed = jnp.sum(before.delassus[:, 0] * forces[None], axis=(1, 2))
    approach = -(before.a[:, 0] + jnp.where(closed, 0.0, pushed))
    # The time that all bounces after this impact take, 2 v / (a (1 - e)); infinity if they do not end.
    ends = strikes & (approach > 0) & (before.laws.restitution < 1)
    slowing = jnp.where(ends, approach * (1.0 - before.laws.restitution), 1.0)
    bounces = jnp.where(ends, -2.0 * before.laws.restitution * v_N / slowing, jnp.inf)
    # A bounce that is lower than the rounding error of the gap cannot be simulated.
    is_low = 0.5 * (before.laws.restitution * v_N) ** 2 <= approach * (errors / 16)
    rests = strikes & (bounces < jnp.inf) & ((bounces < rest) | is_low)
    e = jnp.where(strikes & ~rests, before.laws.restitution, 0.0)
    # One ball after the other, as in Newton's cradle: a contact without friction that bounces is hit next, if at all.
    waits = ~jnp.asarray(layout.has_friction) & ~strikes & (before.laws.restitution > 0)
    friction = jnp.where(bearing, 0.0, before.laws.friction)
    unknown = Slip.unknown(friction, layout.d)
    args = before.delassus, before.v, e, friction, takes_part & ~waits, unknown, jnp.array(True)
    problem = ContactProblem(*args, layout.has_friction)
    return _Impact(problem, u, before, event, closed, near, takes_part, strikes, rests, bounces)


class _AfterImpact(NamedTuple):
    """Speeds `u` (n,), `impulses` (c, r) and `states` (c,) after the impact, and whether there is one (`is_impact`).
    `is_lawful`, `is_determined`: see `Change`."""

    u: Array
    impulses: Array
    states: Array
    is_impact: Array
    is_lawful: Array
    is_determined: Array


@ScalarFunction
def _after_impact(layout: ContactLayout, first: _Impact, choice: Choice) -> _AfterImpact:
    before, hit, is_impact = first.before, first.problem.solution(choice), jnp.any(first.strikes)
    is_lawful = before.laws.are_valid(first.strikes, first.takes_part | jnp.asarray(layout.is_bearing))
    impulses = jnp.where(is_impact & hit.determined & is_lawful, hit.impulses, 0.0)
    u = first.u + before.X @ (before.B.T @ impulses.reshape(-1))
    return _AfterImpact(u, impulses, hit.states, is_impact, is_lawful, ~is_impact | hit.determined)


class _Accelerations(NamedTuple):
    """The contact problem for the accelerations after a jump, whose solution gives the new contact states. (c,) unless
    stated otherwise.

    - `delays`: the times that pass before contacts rest [s].
    - `is_still`: whether the slip is zero.
    - `slip` (c, d): the direction of the slip otherwise.
    - `slow` (c, 2): see `ContactMemory`.
    """

    problem: ContactProblem
    delays: Array
    is_still: Array
    slip: Array
    slow: Array


@ScalarFunction
def _accelerations(
    layout: ContactLayout,
    after: ContactTerms,
    state: State,
    first: _Impact,
    second: _AfterImpact,
    errors: Array,
    rest: Array,
    tolerances: tuple[Array, Array],
) -> _Accelerations:
    before, event, is_impact = first.before, first.event, second.is_impact
    memory, bearing = ContactMemory.unpacked(layout, cast(Array, state.contacts)), jnp.asarray(layout.is_bearing)
    negligible = jnp.maximum(_negligible(before), _negligible(after))
    v_N, goes_on = before.v[:, 0], first.strikes & ~first.rests & (first.bounces < jnp.inf)
    is_apart = after.v[:, 0] > negligible[:, 0] + jnp.where(is_impact, 1e-10 * jnp.abs(v_N), 0.0)
    is_apart &= is_impact | ~event.is_own | ~first.closed  # the speeds of closed contacts are rounding errors
    # A block that rocks on its corners in turn: each corner opens for a shorter time than the one before. For a contact
    # that bounces, this rule would omit the rest of the bounces, which is longer than one bounce.
    fall, rise = -after.a[:, 0], after.v[:, 0]
    is_apart &= goes_on | ~((fall > 0) & ((2.0 * rise < rest * fall) | (0.5 * rise**2 <= fall * (errors / 16))))
    is_apart |= is_impact & (rise < -negligible[:, 0])  # it is hit next
    bounces_on = is_impact & (second.states == OPEN) & first.strikes & (first.problem.restitution > 0)
    candidates = (first.takes_part & ~is_apart & ~event.opens & ~bounces_on) | bearing
    sticks = is_impact & ~bearing & (second.states == STICKS)
    delays = jnp.where(first.rests, first.bounces, 0.0)
    G, a, kinetic, d = after.delassus, after.a, after.laws.friction, layout.d
    is_still, slow = jnp.zeros_like(bearing), jnp.zeros((len(kinetic), 2), kinetic.dtype)
    slip, known = jnp.zeros((len(kinetic), d), kinetic.dtype), Slip.unknown(kinetic, d)
    if d:
        # A bearing is a contact with a normal force of its own: G_NN = 1 and a_N = -(the largest friction).
        corner, unit = np.zeros((1 + d, 1 + d), kinetic.dtype), np.eye(len(kinetic), dtype=kinetic.dtype)
        corner[0, 0] = 1.0
        own = jnp.where(bearing, 1.0, 0.0).astype(G.dtype)[:, None] * unit
        G = G + own[:, None, :, None] * corner[None, :, None, :]
        a = jnp.concatenate([jnp.where(bearing, -after.laws.static, a[:, 0])[:, None], a[:, 1:]], axis=1)
        ratio = kinetic / jnp.where(after.laws.static > 0, after.laws.static, 1.0)
        kinetic, static = (jnp.where(bearing, x, y) for x, y in ((ratio, kinetic), (1.0, after.laws.static)))
        v = after.v[:, 1:]
        speed = jnp.sqrt(jnp.sum(jax.lax.stop_gradient(v) ** 2, axis=1))
        stops, (rtol, atol) = event.stops, tolerances
        errors_of_steps = atol * jnp.sum(jnp.abs(after.C), axis=1).reshape(after.v.shape) + rtol * after.size
        error = jnp.sum(errors_of_steps[:, 1:], axis=1)
        is_slow = speed <= 100 * error
        slow = error / jnp.sqrt(jnp.maximum(rtol, float(jnp.finfo(v.dtype).eps)))
        slow = jnp.stack([slow, error], axis=1)
        if d == 2:
            # In space, the slip need not vanish where its component along its first direction does.
            is_slow |= speed <= 10 * memory.slow[:, 1]
            stops &= is_slow
        # Both corners of a block stop at the same time.
        stops |= jnp.any(stops) & is_slow & (memory.states == SLIDES) & ~bearing
        is_still = stops | sticks | (speed <= jnp.max(negligible[:, 1:], axis=1))
        is_still |= _stops_within(delays, after, jax.lax.stop_gradient(v), speed)
        # If one corner of a block is at its limit, both slip when the other one reaches its limit.
        slips = event.slips | (jnp.any(event.slips) & (memory.states == SLIDES) & is_still & ~stops)
        slip = v / jnp.where(is_still, 1.0, jnp.where(speed > 0, speed, 1.0))[:, None]
        slip = jnp.sign(jax.lax.stop_gradient(slip)) if d == 1 else slip
        known = Slip(~is_still, slip, static, ~slips & (after.laws.static > 0))
    args = G, a, jnp.zeros_like(kinetic), kinetic, candidates, known, jnp.array(False)
    problem = ContactProblem(*args, layout.has_friction)
    return _Accelerations(problem, delays, is_still, slip, slow)


@ScalarFunction
def _changed(
    layout: ContactLayout,
    y: Array,
    after: ContactTerms,
    state: State,
    first: _Impact,
    second: _AfterImpact,
    third: _Accelerations,
    choice: Choice,
) -> Change:
    memory, bearing = ContactMemory.unpacked(layout, cast(Array, state.contacts)), jnp.asarray(layout.is_bearing)
    found, event, is_still = third.problem.solution(choice), first.event, third.is_still
    states, directions, kept = jnp.where(third.problem.closed, found.states, OPEN), memory.directions, memory.slow
    if layout.d:
        # A slip that begins is opposite to the friction.
        slides = (states == SLIDES)[:, None]
        push = jnp.where(slides, -found.impulses[:, 1:], 0.0)
        strength2 = jnp.sum(push**2, axis=1)
        strength = jnp.sqrt(jnp.where(strength2 > 0, strength2, 1.0))[:, None]
        onset = jnp.where(slides, found.velocities[:, 1:], 0.0)
        squares = jnp.sum(onset**2, axis=1)
        onset = onset / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))[:, None]
        onset = jnp.where((strength2 > 0)[:, None], push / strength, onset)
        start = jnp.where(slides, jnp.where(is_still[:, None], onset, third.slip), 0.0)
        if layout.d == 1:
            directions = jnp.sign(jax.lax.stop_gradient(start))
        else:
            signs = jnp.sign(start[:, :1]) * np.array([[1.0, 0.0, 0.0]], start.dtype)
            directions = jnp.where(bearing[:, None], signs, jnp.sum(start[:, :, None] * after.tangents, axis=1))
            goes_on = (memory.states == SLIDES) & ~event.stops
            first_slow = jnp.where(is_still, third.slow[:, 0], jnp.where(goes_on, memory.slow[:, 0], 0.0))
            error = jnp.where(goes_on, memory.slow[:, 1], third.slow[:, 1])
            is_sliding = ((states == SLIDES) & ~bearing)[:, None]
            kept = jax.lax.stop_gradient(jnp.where(is_sliding, jnp.stack([first_slow, error], axis=1), 0.0))
    new = ContactMemory(states, directions, kept)
    u = projected_speeds(layout, after, new, second.u)
    # Gaps of closed contacts drift by the error of the solver. This is corrected where another contact closes: if a
    # slip began at other coordinates, the friction would not be at its limit, and the slip would end at once.
    closes = first.takes_part & (event.touches | first.near)
    touching = (closes | (first.takes_part & first.closed & jnp.any(closes))) & ~event.is_start
    q = without_gaps(after, touching, state.q)
    rest = y[len(q) + len(u) : y.size - layout.memory_size]
    y = jnp.concatenate([q, u, rest, new.packed()])
    delay = jnp.max(jnp.where(states != OPEN, third.delays, 0.0), initial=0.0)
    is_lawful = second.is_lawful & after.laws.are_valid(False, states >= SLIDES)
    return Change(y, delay, second.impulses, is_lawful, found.determined & second.is_determined)


def _negligible(terms: ContactTerms) -> Array:
    """Velocities (c, r) that are rounding errors. All velocities of a contact have the size of the largest."""
    size = jnp.max(terms.size, axis=1, keepdims=True)
    return 1e3 * float(jnp.finfo(terms.v.dtype).eps) * jnp.broadcast_to(size, terms.size.shape)


def _stops_within(delays: Array, terms: ContactTerms, v: Array, speed: Array) -> Array:
    """Whether the slip `v` (c, d) of each contact vanishes within the time that passes before the contact rests (c,).

    Otherwise the slip would be reversed after this time by up to 1e-7 m/s, and no event function would cross zero.
    """
    n, G, a = len(speed), terms.delassus, terms.a
    own = jnp.stack([G[i, :, i] for i in range(n)])  # (c, r, r): the other contacts are neglected
    way = v / jnp.where(speed > 0, speed, 1.0)[:, None]
    # F_T = -mu F_N way,  v_N_dot = 0
    push = own[:, :, 0] - terms.laws.friction[:, None] * jnp.sum(own[:, :, 1:] * way[:, None, :], axis=2)
    normal = -a[:, 0] / jnp.where(push[:, 0] > 0, push[:, 0], 1.0)
    slows = jnp.sum(way * (a[:, 1:] + push[:, 1:] * normal[:, None]), axis=1)
    return (delays > 0) & (push[:, 0] > 0) & (speed + slows * delays <= 0)


@ScalarFunction
def contact_event_values(system: System, t: Array, y: Array, inputs: dict[str, Array]) -> tuple[Array, Array]:
    """The event functions of all contacts (2 c,), normal and tangential ones, and their rounding errors.

    The rounding errors are NaN if the friction of a closed contact is impossible, so that the step is rejected.
    """
    layout, state = layout_of(system), unpacked(system, y)
    values = values_of(system, state.x, inputs)
    assert state.contacts is not None
    _, forces, terms = forces_in_contact(system, t, state.q, state.u, state.contacts, values)
    memory = ContactMemory.unpacked(layout, state.contacts)
    functions = event_functions(layout, terms, memory, forces.forces)
    sizes = event_sizes(layout, terms, memory, forces.forces, gap_sizes.__wrapped__(system, t, state.q, state.u)[1])
    normal, tangential = jax.lax.stop_gradient(sizes)
    eps, tiny = float(jnp.finfo(y.dtype).eps), float(jnp.finfo(y.dtype).tiny)
    # A contact without a force, as of two balls side by side, does not open. So the force must be negative.
    rests = (memory.states >= SLIDES) & ~jnp.asarray(layout.is_bearing)
    margins = jnp.where(rests, normal, 0.0), jnp.where(memory.states == STICKS, tangential, 0.0)
    functions = [f + (64 * eps * margin + 1e3 * tiny) for f, margin in zip(functions, margins, strict=True)]
    noise = 2 * eps * jnp.stack([normal, tangential], axis=1).reshape(-1)
    is_lawful = terms.laws.are_valid(False, memory.states >= SLIDES)
    return jnp.stack(functions, axis=1).reshape(-1), jnp.where(is_lawful, noise, jnp.nan)
