"""What is drawn of a system: a bicycle as a bicycle, any other by its bodies, points and frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._description.bodies import Body
from .._description.frames import Frame
from .._description.motion import Motion
from .._description.vectors import Vector
from ..catalog import WhippleBicycle
from ._builder import Builder
from ._record import Record
from ._sketch import CYCLE, Figure, Sketch

_AROUND = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]


def bicycle(system: Any, motion: Motion, s: Sketch) -> None:
    """Spoked wheels, frame, fork, a rider's outline, the mass centre of frame and rider, tracks of the contacts."""
    rear_wheel, frame, fork, front_wheel = (motion[n] for n in ("rear wheel", "rear frame", "fork", "front wheel"))
    B, C = motion["B"], motion["C"]
    rear, front, S = rear_wheel.center.position, front_wheel.center.position, motion["S"].position
    w, rR = system.w, system.rR

    def at(x, height):  # of the upright bicycle, measured from the rear contact
        return rear + B.vector(x * w, 0.0, rR - height)

    crank, seat = at(0.40, 0.9 * rR), at(0.22, rR + 0.55)
    head = S - (0.30 + system.rF) * 0.9 * C.z  # the top of the steering head, above the crossing of the axle's height
    low = head + 0.14 * C.z
    _wheel(s, rear_wheel, rR, getattr(system, "rear_tyre", None))
    _wheel(s, front_wheel, system.rF, getattr(system, "front_tyre", None))
    s.line("gold", rear, crank, low, head, seat, rear, width=3.0)
    s.line("gold", crank, seat, width=3.0)
    s.line("blue", front, low, head, width=3.0)
    s.line("ink", seat + 0.1 * B.x, seat - 0.14 * B.x, width=4.0)
    hips = seat - 0.07 * B.z
    s.line("grey", crank, at(0.52, rR + 0.33), hips, width=5.0)
    if "left_grip" in motion.points:
        grips = [motion[f"{side}_grip"].position for side in ("left", "right")]
        top = head + (0.5 * (grips[0] + grips[1]) - head).dot(C.z) * C.z
    else:
        top = head - 0.07 * C.z
        grips = [top + 0.02 * C.x + side * 0.27 * C.y for side in (-1.0, 1.0)]
    s.line("blue", head, top, width=3.0)
    s.line("blue", grips[0], top, grips[1], width=3.5)
    if "U" in motion.frames:  # of a rider with a body of his own
        rider, U = system.rider, motion["U"]
        shoulders = motion["rider"].center.position + U.vector(0.5 * w - rider.x, 0.0, -rR - 1.02 - rider.z)
        s.mass_center("violet", motion["rider"], label="rider")
    else:
        U, shoulders = B, at(0.50, rR + 1.02)
    _upper_body(s, motion, U, hips, shoulders, grips)
    s.mass_center("red", frame, label=frame.name)
    s.mass_center("blue", fork, 4.0, label=fork.name)
    s.trace("ink", motion["P"])
    s.trace("blue", motion["Q"])
    for part in getattr(system, "parts", ()):
        part.draw(system, motion, s)


def _wheel(s: Sketch, body: Body, radius: Any, tyre: Any) -> None:
    """A spoked wheel, and the sides of its tyre where that is round."""
    s.wheel("ink", body, radius)
    if getattr(tyre, "crown", None) is not None:
        A = body.frame
        for side in (-1.0, 1.0):
            center = body.center.position + side * tyre.crown * A.y
            s.circle("ink", center, A.z, A.x, radius - tyre.crown, width=1.2)


def _upper_body(s: Sketch, motion: Motion, U: Frame, hips: Vector, shoulders: Vector, grips: list[Vector]) -> None:
    """Trunk, head and arms; the arms by their joints where the motion knows them."""
    if "left_shoulder" in motion.points:
        left, right = (motion[f"{side}_shoulder"].position for side in ("left", "right"))
        shoulders = 0.5 * (left + right)
        s.line("grey", left, right, width=5.0)
    s.line("grey", hips, shoulders, width=5.0)
    if "left_elbow" in motion.points:
        for side in ("left", "right"):
            s.line("violet", *(motion[f"{side}_{joint}"] for joint in ("shoulder", "elbow", "hand")), width=4.0)
    else:
        s.line("grey", grips[0], shoulders, grips[1], width=3.0)
    s.circle("grey", shoulders + U.vector(0.08, 0.0, -0.2), U.x, U.z, 0.11, width=2.5, fill=0.25)
    s.line("grey", shoulders, shoulders + U.vector(0.04, 0.0, -0.1), width=5.0)


FIGURES: dict[type, Figure] = {WhippleBicycle: bicycle}


def figure_of(system: object) -> Figure | None:
    """The figure of a system's class, or of one that it inherits from."""
    return next((FIGURES[c] for c in type(system).__mro__ if c in FIGURES), None)


def bodies_and_points(found: Record, build: Builder) -> None:
    """Every body as the uniform solid of its mass and inertia; points joined where nothing moves between them."""
    color = {k: CYCLE[k % len(CYCLE)] for k in range(len(found.bodies))}
    joined = _links(found, build)
    for k in color:
        _solid(build, k, color[k], found.inertia[k] / found.mass[k])
    for k, name in enumerate(found.bodies):
        build.moving(found.place[:, k : k + 1])
        build.shape("center", color[k], 1, width=5.0, label=name)
        _trace(build, found.place[:, k : k + 1], color[k])
    for i, name in enumerate(found.point_names):
        if i == 0 and not joined:
            continue  # nothing hangs on the origin: it would only be a dot far away
        x = found.points[:, i : i + 1]
        build.moving(x)
        build.shape("dot", "grey", 1, width=3.0, label=name)
        if np.abs(found.place - x).max(axis=(0, 2)).min() > build.tolerance:
            _trace(build, x, "grey")


def _trace(build: Builder, x: np.ndarray, color: str) -> None:
    if np.ptp(x, axis=0).max() > build.tolerance:
        build.moving(x)
        build.shape("trace", color, 1, width=1.2)


def _solid(build: Builder, body: int, color: str, inertia: np.ndarray) -> None:
    """A uniform box, cylinder, ball or rod with these moments (3, 3) per mass [m^2], or nothing for a particle."""
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, 0.0)
    largest = moments.max()
    if np.sqrt(largest) <= build.tolerance:
        return
    odd = [k for k in range(3) if abs(moments[k - 1] - moments[k - 2]) <= 1e-6 * largest]
    to_body = lambda x: np.asarray(x) @ axes.T  # noqa: E731

    def add(x, **style):
        build.local(to_body(x), body)
        build.shape(style.pop("kind", "line"), color, len(x), **style)

    if len(odd) == 3:
        radius = np.sqrt(2.5 * largest)
        for k in range(3):
            add(np.roll(_ring(radius, 0.0), k, axis=1), closed=True, fill=0.06)
    elif odd:
        k = odd[0]
        radius = np.sqrt(2.0 * moments[k])
        half = 0.5 * np.sqrt(max(12.0 * (moments[k - 1] - radius**2 / 4.0), 0.0))
        turn = lambda x: np.roll(x, k + 1, axis=1)  # the third axis of a ring becomes the odd one  # noqa: E731
        if radius < 0.02 * half:
            add(turn(np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])), width=4.0)
            return
        for z in (-half, half):
            add(turn(_ring(radius, z)), closed=True, fill=0.12)
        sides = np.stack([_ring(radius, -half)[::4], _ring(radius, half)[::4]], axis=1).reshape(-1, 3)
        add(turn(sides), kind="pairs", width=0.8)
        # a diameter on each end shows how far it has turned
        add(turn(np.array([[-radius, 0.0, half], [radius, 0.0, half], [radius, 0, -half], [-radius, 0, -half]])))
    else:
        box = np.sqrt(np.maximum(1.5 * (moments.sum() - 2.0 * moments), 0.0))  # half the edges
        square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        for k in range(3):
            for side in (-1.0, 1.0):
                face = np.roll(np.c_[square, np.full(4, side)], k + 1, axis=1)
                add(face * box, closed=True, fill=0.08)


def _ring(radius: float, z: float) -> np.ndarray:
    return np.stack([radius * np.cos(_AROUND), radius * np.sin(_AROUND), np.full_like(_AROUND, z)], axis=1)


def _links(found: Record, build: Builder) -> bool:
    """Lines between points and mass centres that stand still relative to each other in a frame that moves.

    Whether the origin, the first of the points, is among those that are joined.
    """
    points = np.concatenate([found.points, found.place], axis=1)  # (T, n, 3)
    frames = np.concatenate([found.orientation, found.frames], axis=1)
    frames = [R for R in np.moveaxis(frames, 1, 0) if np.abs(R - R[0]).max() > 1e-6]
    n = points.shape[1]
    group = list(range(n))

    def join(i, j):
        old, new = group[j], group[i]
        group[:] = [new if g == old else g for g in group]

    apart = {(i, j): points[:, j] - points[:, i] for i in range(n) for j in range(i + 1, n)}
    still = np.ptp(points, axis=0).max(axis=1) <= build.tolerance
    length = {pair: np.linalg.norm(r, axis=1).max() for pair, r in apart.items()}
    for i, j in sorted(apart, key=lambda pair: length[pair]):
        if group[i] == group[j] or (still[i] and still[j]):
            continue
        seen = [np.einsum("tji,tj->ti", R, apart[i, j]) for R in frames]
        if length[i, j] <= build.tolerance:
            join(i, j)
        elif any(np.ptp(r, axis=0).max() <= build.tolerance for r in seen):
            join(i, j)
            build.moving(points[:, [i, j]])
            build.shape("line", "grey", 2, width=2.0)
    return group.count(group[0]) > 1
