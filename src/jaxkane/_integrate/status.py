"""How a motion ended: the status codes, their words and their advice."""

from __future__ import annotations

import enum


class Status(enum.IntEnum):
    """How a simulation ended. Codes from `EVENT` on are events of the system, in the order of the alphabet."""

    COMPLETED = 0
    """Reached the last time."""
    SINGULAR_SPEEDS = 1
    """The dependent speeds are no longer determined by the independent ones: det C_dep passed zero."""
    STEP_TOO_SMALL = 2
    """The solver could not go on: the step fell below its minimum, as it does when something becomes infinite."""
    MAX_STEPS = 3
    """The solver took `max_steps` steps before the last time."""
    INVALID = 4
    """A parameter or an initial value was not finite, a positive parameter was not positive, a body had a mass or an
    inertia that no body has, or the coordinates violated a configuration constraint: nothing was solved."""
    INTERRUPTED = 5
    """A sweep was stopped before it came to this member."""
    NO_SOLUTION = 6
    """The equations have no finite solution at the first state: a speed that no mass moves with, angles that lock,
    constraints that cannot be solved for the dependent speeds. One simulation alone raises an error that says which."""
    EVENT = 10


def reason(code: int, events: tuple[str, ...]) -> str:
    """A status code in words; `events` are the names of a system's events."""
    name = events[code - Status.EVENT] if code >= Status.EVENT else Status(code).name.lower()
    return name.replace("_", " ")


REASONS = frozenset(reason(code, ()) for code in Status if code < Status.EVENT)
_ADVICE: dict[int, str] = {
    Status.SINGULAR_SPEEDS: "Choose other dependent speeds: see jaxkane.best_dependent_speeds(system, t, q).",
    Status.STEP_TOO_SMALL: "Something becomes infinite or jumps: look at the last times that were reached.",
    Status.MAX_STEPS: "Raise max_steps (a sample of an input takes a step); or look for what is stiff or jumps.",
}


def advice(code: int, events: tuple[str, ...]) -> str:
    """What helps against an early end; empty where nothing is to be done."""
    if reason(code, events).startswith("gimbal lock"):
        return "Angles lock there: describe the orientation with Euler parameters, or with another sequence of angles."
    return _ADVICE.get(code, "")
