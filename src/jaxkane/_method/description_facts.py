"""What a description says of velocities, places and orientations at one state, by kind and name. Judges nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from .._description.loads import Force, Load
from .._description.motion import Motion
from .._description.points import Point
from .._description.system import System
from .._scalars.components import is_exact
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, stack
from .._scalars.types import Component
from .reading import Reading, frames_of

Found = dict[tuple[Any, ...], Any]  # (number, kind, names ...) -> numbers; the number keeps the order of the reading


@fused
def facts_of(system: System, t: Any, q: Any, u: Any, inputs: Any) -> Found:
    reading = Reading(system, inputs)
    q, u, like = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u))), q
    motion = reading.motion(t, q, u)
    loads = reading.loads_at(t, q, u, motion)
    twice = sorted({*motion.points, *motion.frames} & {*system.auxiliary_speeds})
    if twice:
        raise ValueError(
            f"{reading.name}: {', '.join(twice)} is the name of an auxiliary speed and of a point or a frame: "
            "constraint_forces gives both a force by that name."
        )
    facts = [*_of_speeds(reading, t, q, u), *_of_bodies(motion), *_of_points(motion, loads), *_of_frames(motion, loads)]
    return {(i, *key): stack(rows).astype(like.dtype) for i, (key, rows) in enumerate(facts)}


@fused
def turning_of(system: System, t: Any, q: Any, u: Any) -> tuple[Any, Any, Any]:
    """Orientations of frames in their parents (f, 3, 3); of bodies that turn in their frames, how, and their inertia
    (b, 4, 3); and the velocity residuals (k,)."""
    reading, like = Reading(system), q
    q, u = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u)))
    orientations, spins = reading.read("orientations", t, q, u)
    as_arrays = lambda xs: [stack(x).astype(like.dtype) for x in xs]  # noqa: E731
    return as_arrays(orientations), as_arrays(spins), as_vector(reading.residuals(t, q, u), like)


Fact = tuple[tuple[str, ...], list[tuple[Component, ...]]]


def _of_speeds(reading: Reading, t: Any, q: Any, u: Any) -> Iterator[Fact]:
    for name, rate in zip(reading.system.coordinates, reading.rates(t, q, u), strict=True):
        yield ("rate", name), [(rate,)]
    for i, residual in enumerate(reading.residuals(t, q, u)):
        yield ("residual", str(i)), [(residual,)]
    for i, h in enumerate(reading.configuration(t, q)):
        yield ("constraint", str(i)), [(h,)]


def _of_bodies(motion: Motion) -> Iterator[Fact]:
    for body in motion.bodies:
        yield ("velocity", f"the velocity of {body.name!r}"), [body.center.velocity.components]
        yield ("velocity", f"the angular velocity of {body.name!r}"), [body.angular_velocity.components]
        if body.about is not None:
            r = body.about.position_from(body.center)
            carried = body.center.velocity + body.frame.angular_velocity.cross(r)
            velocities = [x.components_in(body.frame) for x in (body.about.velocity, carried)]
            yield ("about", body.name, body.frame.name), velocities
        if body.center.has_position and not all(_is_sure(point) for point in _chain(body.center)):
            place, velocity = (x.components_in(motion.N) for x in (body.center.position, body.center.velocity))
            yield ("center", f"the mass centre of {body.name!r}"), [place, velocity]


def _of_points(motion: Motion, loads: Iterable[Load]) -> Iterator[Fact]:
    """Named points, what loads act on, and what these and the bodies were made from."""
    seen: set[Point] = set()
    centers = {body.center: f"the mass centre of {body.name!r}" for body in motion.bodies}
    named = {point: f"the point {name!r}" for name, point in motion.points.items()}
    acted_on = {load.point: f"the point {load.point.name!r} of a load" for load in loads if isinstance(load, Force)}
    words = {**acted_on, **named, **centers}
    for point in words:
        if point not in centers:
            yield ("velocity", f"the velocity of {words[point]}"), [point.velocity.components]
        for link in _chain(point):
            if link in seen or link._claim is None or (link._base is None and link in centers):
                continue
            seen.add(link)
            frame, velocity = link._claim
            rows = [link._offset.components_in(frame), velocity.components_in(frame)]  # type: ignore[union-attr]
            if not all(is_exact(x) for x in rows[0]) or not all(is_exact(x) and x == 0.0 for x in rows[1]):
                # A point that `loads` made from a motion without speeds is at rest too, and is no point of contact.
                at_rest = link._base is None and frame is motion.N
                yield ("contact" if at_rest else "place", words.get(link, f"the point {link.name!r}"), frame.name), rows


def _of_frames(motion: Motion, loads: Iterable[Load]) -> Iterator[Fact]:
    for frame in frames_of(motion, loads):
        rows = [*frame._to_child, frame._spin]
        if not all(is_exact(x) for row in rows for x in row) or any(frame._spin):
            yield ("frame", frame.name, frame.parent.name), rows  # type: ignore[union-attr]


def _chain(point: Point | None) -> Iterator[Point]:
    while point is not None:
        yield point
        point = point._base


def _is_sure(point: Point) -> bool:
    """Whether a point moves as its place does, if what it was made from does and its claim is right."""
    if point._base is not None:
        return point._claim is not None
    known = (*point.velocity.components, *(point._offset.components if point._offset is not None else ()))
    return all(is_exact(x) and x == 0.0 for x in known)  # the origin


@fused
def configuration_residual(system: System, t: Any, q: Any):
    """Residuals (h,) of the configuration constraints."""
    return as_vector(Reading(system).configuration(t, tuple(q[i] for i in range(len(q)))), q)
