"""Figures: the sketch for users, bicycles and uniform solids, recorded at all times of a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._integrate.inputs import Coordinates, Speeds
from .._integrate.trajectory import Trajectory, as_trajectory, reached_times
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component, stack
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Body, Force, Motion, flatten_loads
from .._system.system import System
from ..catalog import WhippleBicycle
from ..loads import ElementForce
from ._scene import Builder

# Colours on a light and on a dark page. Any other name is passed to the browser as a CSS colour.
COLORS = {
    "paper": ("#fbfcfe", "#10141d"),
    "grid": ("#d3d9e3", "#364159"),
    "grey": ("#8a94a4", "#76829a"),
    "ink": ("#1d2430", "#eef1f6"),
    "gold": ("#b36b00", "#f0ab45"),
    "blue": ("#1769b5", "#58aaf0"),
    "green": ("#1f7a3d", "#5fc27a"),
    "violet": ("#7a3fb0", "#b78cf0"),
    "red": ("#c4302b", "#f0715f"),
}
CYCLE = ("gold", "blue", "green", "violet", "red")


class Element(eqx.Module):
    """Points (n, 3) in N, and how they are drawn: as a `kind` "line", "spring", "pairs", "dot", "center" or "trace".

    `body`: index of the body with which the points rotate, if its frame does not rotate with it.
    """

    places: Float[Array, "*times n 3"]
    kind: str = eqx.field(static=True)
    color: str = eqx.field(static=True)
    width: float = eqx.field(static=True, default=1.5)
    closed: bool = eqx.field(static=True, default=False)
    fill: float = eqx.field(static=True, default=0.0)
    body: int | None = eqx.field(static=True, default=None)
    label: str = eqx.field(static=True, default="")


Location = Vector | Point | Body


class Sketch:
    """The figure of a mechanism. It is drawn at one instant and then moves with the bodies.

        def figure(system, motion, sketch):
            sketch.line("gold", motion["O"], motion["A"])
            sketch.trace("blue", motion["link2"])

    A location is a `Point`, a `Body` (its mass centre) or a `Vector` from the origin. A colour is "ink", "grey",
    "gold", "blue", "green", "violet" or "red", which are legible on light and dark pages, or any colour of CSS such as
    "#4fa3e3".
    """

    def __init__(self, motion: Motion):
        self.motion = motion
        self.elements: list[Element] = []

    def _add(
        self, places: Float[Array, "n 3"], kind: str, color: str, turns_with: Body | None = None, **style: Any
    ) -> None:
        body = None if turns_with is None else self.motion.bodies.index(turns_with)
        self.elements.append(Element(places, kind, color, body=body, **style))

    def _at(self, place: Location) -> Float[Array, 3]:
        if isinstance(place, Body):
            place = place.center
        return (place.position if isinstance(place, Point) else place).to(self.motion.N)

    def line(
        self,
        color: str,
        *places: Location,
        width: float = 2.0,
        closed: bool = False,
        fill: float = 0.0,
        turns_with: Body | None = None,
    ) -> None:
        """A line through locations; `width` in pixels, `fill` is the opacity of the interior of a closed line."""
        at = jnp.stack([self._at(place) for place in places])
        self._add(at, "line", color, turns_with, width=width, closed=closed, fill=fill)

    def circle(
        self,
        color: str,
        center: Location,
        a: Vector,
        b: Vector,
        radius: Component,
        *,
        width: float = 2.0,
        fill: float = 0.0,
        turns_with: Body | None = None,
    ) -> None:
        """A circle in the plane of two unit vectors."""
        self._add(
            self._around(center, a, b, radius, 40), "line", color, turns_with, width=width, closed=True, fill=fill
        )

    def wheel(self, color: str, body: Body, radius: Component, *, axis: int = 2, spokes: int = 12) -> None:
        """A spoked wheel about the mass centre of a body and its `axis` 1, 2 or 3. It rotates with the body."""
        x, y, z = body.frame.x, body.frame.y, body.frame.z
        a, b = {1: (y, z), 2: (z, x), 3: (x, y)}[axis]
        self.circle(color, body, a, b, radius, width=3.5, fill=0.05, turns_with=body)
        rim = self._around(body, a, b, radius, spokes)
        hub = jnp.broadcast_to(self._at(body), rim.shape)
        self._add(jnp.stack([hub, rim], axis=1).reshape(-1, 3), "pairs", color, body, width=0.7)
        self.dot(color, body, 3.0)

    def _around(self, center: Location, a: Vector, b: Vector, radius: Component, n: int) -> Float[Array, "n 3"]:
        a_N, b_N = a.to(self.motion.N), b.to(self.motion.N)
        angles = 2.0 * np.pi * np.arange(n)[:, None] / n
        cos, sin = (jnp.asarray(f(angles), dtype=a_N.dtype) for f in (np.cos, np.sin))
        return self._at(center)[None, :] + jnp.asarray(radius, dtype=a_N.dtype) * (cos * a_N[None] + sin * b_N[None])

    def spring(self, color: str, start: Location, end: Location, *, width: float = 1.5) -> None:
        """A zigzag between two locations; `width` in pixels."""
        self._add(jnp.stack([self._at(start), self._at(end)]), "spring", color, width=width)

    def dot(self, color: str, place: Location, radius: float = 4.0, label: str = "") -> None:
        """A dot; `radius` in pixels."""
        self._add(self._at(place)[None], "dot", color, width=radius, label=label)

    def mass_center(self, color: str, place: Location, radius: float = 6.0, label: str = "") -> None:
        """The quartered disc that marks a mass centre; `radius` in pixels."""
        self._add(self._at(place)[None], "center", color, width=radius, label=label)

    def trace(self, color: str, *places: Location) -> None:
        """The paths of locations."""
        for place in places:
            self._add(self._at(place)[None], "trace", color, width=1.2)

    def axes(self, center: Location, frame: Frame, length: Component) -> None:
        """The axes 1, 2 and 3 of a frame in red, green and blue."""
        start = center.center.position if isinstance(center, Body) else center
        start = start.position if isinstance(start, Point) else start
        for color, axis in zip(("red", "green", "blue"), (frame.x, frame.y, frame.z), strict=True):
            self.line(color, start, start + length * axis)


Figure = Callable[[System, Motion, Sketch], None]


def rotation(frame: Frame, N: Frame) -> Float[Array, "3 3"]:
    """The rotation matrix from components in the frame to components in N, without names of frames."""
    return stack([unit.components_in(N) for unit in (frame.x, frame.y, frame.z)]).T


class Record(eqx.Module):
    """Bodies with a position, named points, frames and the elements of a figure at n_t times; components in N.

    - `orientation` (n_t, b, 3, 3): rotation matrices from components in a body's frame to components in N.
    - `place` (n_t, b, 3): mass centres.
    - `spin` (n_t, b, 3): angular velocity relative to the frame, in the frame.
    - `mass` (b,), `inertia` (b, 3, 3): in the bodies' frames.
    - `points` (n_t, p, 3): including the origin. `frames` (n_t, f, 3, 3): as `orientation`.
    - `forces` (n_t, l, 3): on mass centres, for the direction of gravity.
    - `ends` (n_t, s, 2, 3): of the springs, dampers and actuators between two points, which are `links`.
    - `shapes`: `center` and `halves` (n_t, 12) of each declared shape; `shape_styles`: its body's number, kind, colour.
    """

    t: Any
    orientation: Any
    place: Any
    spin: Any
    mass: Any
    inertia: Any
    points: Any
    frames: Any
    forces: Any
    ends: Any
    shapes: list[Any]
    elements: list[Element]
    bodies: tuple[str, ...] = eqx.field(static=True)
    body_numbers: tuple[int, ...] = eqx.field(static=True)
    point_names: tuple[str, ...] = eqx.field(static=True)
    links: tuple[str, ...] = eqx.field(static=True)
    shape_styles: tuple[tuple[int, str, str | None], ...] = eqx.field(static=True)


def record(system: System, trajectory: Trajectory, figure: Figure | None) -> Record:
    """Record the figure at the times that the trajectory reached.

    **Raises:** `ValueError` for a batch, for a trajectory of another system, and for one that reached fewer than two of
    its times.
    """
    name = type(system).__name__
    trajectory = as_trajectory(trajectory)
    reached = reached_times("animate", system, trajectory)
    # A plan with phases has the state before and after a link at the same time, between which no frame can be drawn.
    reached = reached & np.append(True, np.diff(np.asarray(trajectory.t)) > 0)
    t, q, u, u_dep = (np.asarray(x)[reached] for x in (trajectory.t, trajectory.q, trajectory.u, trajectory.u_dep))
    u = np.concatenate([u, u_dep], axis=1)
    motion = jax.tree.map(np.asarray, _record_along(system, figure, t, q, u))
    if not motion.bodies:
        raise ValueError(f"animate({name}): no body has a position. Define positions of points, see jaxkane.Point.at.")
    return eqx.tree_at(lambda r: (r.mass, r.inertia), motion, (motion.mass[0], motion.inertia[0]))


@jit
def _record_along(system: System, figure: Figure | None, t: Array, q: Coordinates, u: Speeds):
    # This program runs once or twice, so it should compile quickly: use one function for one instant.
    @ScalarFunction
    def at(system: System, t: Array, q: Coordinates, u: Speeds):
        return _record_at(system, figure, t, q, u)

    return jax.lax.map(lambda now: at(system, *now), (t, q, u))


def _record_at(system: System, figure: Figure | None, t: Array, q: Coordinates, u: Speeds) -> Any:
    motion = system.motion(t, q, u)
    N, dtype = motion.N, q.dtype
    placed = [i for i, body in enumerate(motion.bodies) if body.center.has_position]
    bodies = [motion.bodies[i] for i in placed]
    points = {"O": N.vector(0.0, 0.0, 0.0)}
    points |= {name: point.position for name, point in motion.points.items() if point.has_position}
    values = dict.fromkeys((*system.inputs, *system.states), jnp.zeros((), dtype))
    centers = [body.center for body in bodies]
    loads = flatten_loads(system.loads(t, q, u, motion, values))
    forces = [load.vector for load in loads if isinstance(load, Force) and load.point in centers]
    links = [load for load in loads if isinstance(load, ElementForce)]
    links = [link for link in links if link.point.has_position and link.other.has_position]
    shapes = [(k, shape) for k, body in enumerate(bodies) for shape in body.shapes]
    sketch = Sketch(motion)
    if figure is not None:
        figure(system, motion, sketch)

    def row(vector: Vector, frame: Frame = N):
        return stack([vector.components_in(frame)])[0].astype(dtype)

    def table(rows: list[Array], *shape):
        return jnp.stack(rows) if rows else jnp.zeros((0, *shape), dtype)

    def rotations(frames: list[Frame]):
        return table([rotation(frame, N).astype(dtype) for frame in frames], 3, 3)

    return Record(
        t=t,
        orientation=rotations([b.frame for b in bodies]),
        place=table([row(b.center.position) for b in bodies], 3),
        spin=table([row(b.angular_velocity - b.frame.angular_velocity, b.frame) for b in bodies], 3),
        mass=stack([[b.mass for b in bodies]])[0].astype(dtype),
        inertia=table([stack(b.inertia).astype(dtype) for b in bodies], 3, 3),
        points=table([row(position) for position in points.values()], 3),
        frames=rotations(list(motion.frames.values())),
        forces=table([row(force) for force in forces], 3),
        ends=table([jnp.stack([row(end.position) for end in (link.point, link.other)]) for link in links], 2, 3),
        shapes=[stack([[*shape.center, *shape.halves]])[0].astype(dtype) for _, shape in shapes],
        elements=sketch.elements,
        bodies=tuple(b.name for b in bodies),
        body_numbers=tuple(placed),
        point_names=tuple(points),
        links=tuple(link.kind for link in links),
        shape_styles=tuple((k, shape.kind, shape.color) for k, shape in shapes),
    )


_AROUND = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]


def bicycle(system: Any, motion: Motion, s: Sketch) -> None:
    """Spoked wheels, frame, fork, a rider's outline, the mass centre of frame and rider, traces of the contacts."""
    rear_wheel, frame, fork, front_wheel = (motion[n] for n in ("rear wheel", "rear frame", "fork", "front wheel"))
    B, C = motion["B"], motion["C"]
    rear, front, S = rear_wheel.center.position, front_wheel.center.position, motion["S"].position
    w, rR = system.w, system.rR

    def at(x: float, height: Component):  # measured from the rear contact of the upright bicycle
        return rear + B.vector(x * w, 0.0, rR - height)

    crank, seat = at(0.40, 0.9 * rR), at(0.22, rR + 0.55)
    head = S - (0.30 + system.rF) * 0.9 * C.z  # top of the steering head, above its point at the height of the axle
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
    if "U" in motion.frames:  # a rider with a separate body
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


def _wheel(s: Sketch, body: Body, radius: Component, tyre: Any) -> None:
    """A spoked wheel, and the sides of its tyre if it has a round cross section."""
    s.wheel("ink", body, radius)
    if getattr(tyre, "crown", None) is not None:
        A = body.frame
        for side in (-1.0, 1.0):
            center = body.center.position + side * tyre.crown * A.y
            s.circle("ink", center, A.z, A.x, radius - tyre.crown, width=1.2)


def _upper_body(s: Sketch, motion: Motion, U: Frame, hips: Vector, shoulders: Vector, grips: list[Vector]) -> None:
    """Trunk, head and arms; the arms by their joints if the motion contains these."""
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


def figure_of(system: object) -> Figure | None:
    return bicycle if isinstance(system, WhippleBicycle) else None


def bodies_and_points(motion: Record, build: Builder) -> None:
    """Each body as its shapes or its uniform solid; points with constant distances are joined.

    A body without mass and shapes is drawn as its frame. Springs are zigzags; dampers and actuators are lines.
    """
    color = {k: CYCLE[k % len(CYCLE)] for k in range(len(motion.bodies))}
    joined, drawn = _links(motion, build), []
    for i in sorted(range(len(motion.links)), key=lambda i: motion.links[i] != "spring"):
        same = [np.abs(motion.ends[:, i] - x).max() for x in drawn]
        if min(same, default=np.inf) > build.tolerance:  # a damper beside a spring would hide it
            drawn += [motion.ends[:, i], motion.ends[:, i, ::-1]]
            build.moving(motion.ends[:, i])
            build.shape("spring" if motion.links[i] == "spring" else "line", "grey", 2, width=1.5)
    marks = {}
    for k in color:
        shapes = [number for number, (body, _, _) in enumerate(motion.shape_styles) if body == k]
        color[k] = "grey" if shapes and motion.mass[k] == 0 else color[k]
        for number in shapes:
            _shape(motion, build, number, color[k])
        if motion.mass[k] > 0:
            is_solid = shapes or _solid(build, k, color[k], motion.inertia[k] / motion.mass[k])
            marks[k] = "center", 5.0 if is_solid else 9.0
        else:
            # The axes of the body's frame, a tenth of the scene long
            axes = () if shapes else zip(("red", "green", "blue"), 0.1 * build.scale * np.eye(3), strict=True)
            for axis_color, axis in axes:
                build.local(np.array([np.zeros(3), axis]), k)
                build.shape("line", axis_color, 2, width=2.0)
            marks[k] = "dot", 3.0
    for k, name in enumerate(motion.bodies):
        build.moving(motion.place[:, k : k + 1])
        kind, width = marks[k]
        build.shape(kind, color[k], 1, width=width, label=name)
        _trace(build, motion.place[:, k : k + 1], color[k])
    for i, name in enumerate(motion.point_names):
        if i == 0 and not joined:
            continue  # an origin without a line would only be a dot far away
        x = motion.points[:, i : i + 1]
        build.moving(x)
        build.shape("dot", "grey", 1, width=3.0, label=name)
        if np.abs(motion.place - x).max(axis=(0, 2)).min() > build.tolerance:
            _trace(build, x, "grey")


def _trace(build: Builder, x: np.ndarray, color: str) -> None:
    if np.ptp(x, axis=0).max() > build.tolerance:
        build.moving(x)
        build.shape("trace", color, 1, width=1.2)


def _solid(build: Builder, body: int, color: str, inertia: np.ndarray) -> bool:
    """A uniform box, cylinder, ball or rod with these moments (3, 3) per mass [m^2]. False for a particle."""
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, 0.0)
    largest = moments.max()
    if np.sqrt(largest) <= build.tolerance:
        return False
    axial = [k for k in range(3) if abs(moments[k - 1] - moments[k - 2]) <= 1e-6 * largest]
    kind, k = "rings", 2
    if len(axial) == 3:
        halves = np.full(3, np.sqrt(2.5 * largest))
    elif axial:
        k = axial[0]  # the axis of symmetry becomes the third axis of the solid
        radius = np.sqrt(2.0 * moments[k])
        half = 0.5 * np.sqrt(max(12.0 * (moments[k - 1] - radius**2 / 4.0), 0.0))
        kind, halves = "cylinder" if radius >= 0.02 * half else "rod", np.array([radius, radius, half])
    else:
        kind, halves = "box", np.sqrt(np.maximum(1.5 * (moments.sum() - 2.0 * moments), 0.0))
    for x, style in _SOLIDS[kind]:
        build.local(x * halves @ np.roll(axes.T, 2 - k, axis=0), body)
        build.shape(color=color, count=len(x), **style)
    return True


def _shape(motion: Record, build: Builder, number: int, color: str) -> None:
    """A shape that a body declares."""
    body, kind, own_color = motion.shape_styles[number]
    center, *halves = np.moveaxis(motion.shapes[number].reshape(-1, 4, 3), 1, 0)
    for unit, style in _SOLIDS[kind]:
        x = center[:, None] + unit @ np.stack(halves, axis=1)
        if np.ptp(x, axis=0).max() <= build.tolerance:
            build.local(x[0], body)
        else:  # its numbers depend on the coordinates
            build.moving(motion.place[:, body, None] + x @ motion.orientation[:, body].swapaxes(1, 2))
        build.shape(color=own_color or color, count=len(unit), **style)


def _ring(z: float) -> np.ndarray:
    return np.stack([np.cos(_AROUND), np.sin(_AROUND), np.full_like(_AROUND, z)], axis=1)


_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_SIDES = np.stack([_ring(-1.0)[::4], _ring(1.0)[::4]], axis=1).reshape(-1, 3)
_DIAMETERS = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]])  # show the rotation
_AXIS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
_CLOSED: dict[str, Any] = {"kind": "line", "closed": True}
_RINGS = [(np.roll(_ring(0.0), k, axis=1), _CLOSED | {"fill": 0.06}) for k in range(3)]
_FACES = [np.roll(np.c_[_SQUARE, np.full(4, side)], k + 1, axis=1) for k in range(3) for side in (-1.0, 1.0)]
_ENDS = [(_ring(z), _CLOSED | {"fill": 0.12}) for z in (-1.0, 1.0)]
_SOLIDS: dict[str, list[tuple[np.ndarray, dict[str, Any]]]] = {
    "rings": _RINGS,
    "box": [(face, _CLOSED | {"fill": 0.08}) for face in _FACES],
    "cylinder": [*_ENDS, (_SIDES, {"kind": "pairs", "width": 0.8}), (_DIAMETERS, {"kind": "line"})],
    "rod": [(_AXIS, {"kind": "line", "width": 4.0})],
    "line": [(_AXIS, {"kind": "line", "width": 2.0})],
    # the outline: the centre and three points on the surface, in orthogonal directions
    "sphere": [(np.eye(4, 3, -1), {"kind": "ball", "fill": 0.3}), *_RINGS],
}
"""The lines (n, 3) of solids between -1 and 1, and their styles."""


def _links(motion: Record, build: Builder) -> bool:
    """Lines between points and mass centres that are fixed relative to each other in a moving frame.

    **Returns:** whether the origin, which is the first point, is joined.
    """
    points = np.concatenate([motion.points, motion.place], axis=1)  # (T, n, 3)
    frames = np.concatenate([motion.orientation, motion.frames], axis=1)
    frames = [R for R in np.moveaxis(frames, 1, 0) if np.abs(R - R[0]).max() > 1e-6]
    n = points.shape[1]
    group = list(range(n))

    def join(i: int, j: int):
        old, new = group[j], group[i]
        group[:] = [new if g == old else g for g in group]

    separation = {(i, j): points[:, j] - points[:, i] for i in range(n) for j in range(i + 1, n)}
    still = np.ptp(points, axis=0).max(axis=1) <= build.tolerance
    length = {pair: np.linalg.norm(r, axis=1).max() for pair, r in separation.items()}
    for i, j in sorted(separation, key=lambda pair: length[pair]):
        if group[i] == group[j] or (still[i] and still[j]):
            continue
        in_frames = [np.einsum("tji,tj->ti", R, separation[i, j]) for R in frames]
        if length[i, j] <= build.tolerance:
            join(i, j)
        elif any(np.ptp(r, axis=0).max() <= build.tolerance for r in in_frames):
            join(i, j)
            build.moving(points[:, [i, j]])
            build.shape("line", "grey", 2, width=2.0)
    return group.count(group[0]) > 1
