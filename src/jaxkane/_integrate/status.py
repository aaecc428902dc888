"""How a motion ended: the status codes, their words, their advice, and the decision which of them it is."""

from __future__ import annotations

import enum
from typing import NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array


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


class Outcome(NamedTuple):
    """What a solution says of its end: the status by its `EventController`, whether that ended it, whether it is
    `successful` or `out_of_steps` to diffrax, and whether it has `no_step` that was accepted."""

    by_controller: Array
    is_event: Array
    successful: Array
    out_of_steps: Array
    no_step: Array


def outcome_of(solution: diffrax.Solution) -> Outcome:
    result, state = solution.result, solution.controller_state
    return Outcome(
        by_controller=state.progress[0],  # pyright: ignore[reportOptionalMemberAccess]
        is_event=result == diffrax.RESULTS.event_occurred,
        successful=result == diffrax.RESULTS.successful,
        out_of_steps=result == diffrax.RESULTS.max_steps_reached,
        no_step=solution.stats["num_accepted_steps"] == 0,
    )


def status_of(outcome: Outcome, valid: Array) -> Array:
    """The status, as a float. The `EventController` says why it ended the motion, diffrax why else it ended.

    `valid`: whether the motion could begin.
    """
    failed = jnp.where(outcome.no_step, float(Status.NO_SOLUTION), float(Status.STEP_TOO_SMALL))
    status = jnp.where(outcome.successful, float(Status.COMPLETED), failed)
    status = jnp.where(outcome.out_of_steps, float(Status.MAX_STEPS), status)
    status = jnp.where(outcome.is_event, outcome.by_controller, status)
    return jnp.where(valid, status, float(Status.INVALID))


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
