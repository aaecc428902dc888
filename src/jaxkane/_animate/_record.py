"""Where everything is along a motion: one program for all its instants. Knows descriptions; knows no picture."""

from __future__ import annotations

import functools
import weakref
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._description.loads import Force, flatten_loads
from .._description.system import System
from .._scalars.fuse import fused
from .._scalars.linear import stack
from .._scalars.reads import Reads
from .._scalars.versions import version_of
from .._simulation.one_motion import reached_times
from .._simulation.trajectory import Trajectory
from ._sketch import Element, Figure, Sketch, rotation


class Record(eqx.Module):
    """Bodies with a place, named points, frames and the elements of a figure, at n_t instants; components in N.

    - `orientation` (n_t, b, 3, 3): takes components in a body's frame to components in N; `place` (n_t, b, 3): mass
        centres; `spin` (n_t, b, 3): angular velocity relative to the frame, in the frame.
    - `mass` (b,), `inertia` (b, 3, 3), in the bodies' frames.
    - `points` (n_t, p, 3), the origin among them; `frames` (n_t, f, 3, 3).
    - `forces` (n_t, l, 3): on mass centres, for the direction of gravity.
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
    elements: list[Element]
    bodies: tuple[str, ...] = eqx.field(static=True)
    numbers: tuple[int, ...] = eqx.field(static=True)
    point_names: tuple[str, ...] = eqx.field(static=True)


def record(system: System, trajectory: Trajectory, figure: Figure | None) -> Record:
    """Everything at the times that the trajectory reached.

    **Raises:** `ValueError` for a batch, and for a trajectory of another system, or one that reached fewer than two of
    its times.
    """
    name = type(system).__name__
    reached = reached_times("animate", system, trajectory)
    numbers, rest = eqx.partition(system, eqx.is_array)
    drawing = None if figure is None else _Drawing(weakref.ref(figure), Reads(figure).version)
    t, q, u, u_dep = (np.asarray(x)[reached] for x in (trajectory.t, trajectory.q, trajectory.u, trajectory.u_dep))
    u = np.concatenate([u, u_dep], axis=1)
    found = jax.tree.map(np.asarray, _along(numbers, rest, drawing, version_of(system), t, q, u))
    if not found.bodies:
        raise ValueError(f"animate({name}): no body has a position. Give points their places, see jaxkane.Point.at.")
    return eqx.tree_at(lambda r: (r.mass, r.inertia), found, (found.mass[0], found.inertia[0]))


class _Drawing(eqx.Module):
    """A figure, by a weak reference: no program keeps alive what it holds; and a digest of all that its code reads."""

    figure: Any = eqx.field(static=True)
    version: bytes = eqx.field(static=True)


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _along(numbers, rest, drawing, version, t, q, u):
    # A picture's program runs once or twice: it should compile quickly, which one function for one instant does.
    system = eqx.combine(numbers, rest)
    return jax.lax.map(lambda now: _instant(system, drawing, *now), (t, q, u))


@fused
def _instant(system: System, drawing: _Drawing | None, t, q, u) -> Any:
    figure = None if drawing is None else drawing.figure()
    motion = system.motion(t, q, u)
    N, dtype = motion.N, q.dtype
    placed = [i for i, body in enumerate(motion.bodies) if body.center.has_position]
    bodies = [motion.bodies[i] for i in placed]
    points = {"O": N.vector(0.0, 0.0, 0.0)}
    points |= {name: point.position for name, point in motion.points.items() if point.has_position}
    values = dict.fromkeys((*system.inputs, *system.states), jnp.zeros((), dtype))
    centers = [body.center for body in bodies]
    forces = [
        load.vector
        for load in flatten_loads(system.loads(t, q, u, motion, values))
        if isinstance(load, Force) and load.point in centers
    ]
    sketch = Sketch(motion)
    if figure is not None:
        figure(system, motion, sketch)

    def row(vector, frame=N):
        return stack([vector.components_in(frame)])[0].astype(dtype)

    def table(rows, *shape):
        return jnp.stack(rows) if rows else jnp.zeros((0, *shape), dtype)

    def rotations(frames):
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
        elements=sketch.elements,
        bodies=tuple(b.name for b in bodies),
        numbers=tuple(placed),
        point_names=tuple(points),
    )
