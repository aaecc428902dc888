"""How a simulation ended: the status codes, their words and advice."""

from __future__ import annotations

import enum


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
