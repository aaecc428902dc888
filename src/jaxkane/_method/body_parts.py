"""Which bodies of a system have parameters in a regressor, about which points, and which values they may take.

Knows bodies and the points that they are built from; knows no equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import as_names, refuse_unknown
from .._common.memory import Memory
from .._description.bodies import UNNAMED, Body
from .._description.motion import Motion
from .._description.points import Point
from .._description.system import System
from .._description.vectors import Vector
from .._scalars.components import is_zero
from .._scalars.jax_internals import Literal, concretely
from .reading import Reading
from .trial_numbers import dtype_of, structure_of, with_trial_numbers

TEN = ("m", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Mass [kg], first moment [kg m], and inertia [kg m^2] as matrix entries, about the body's own point."""
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


Bodies = str | Sequence[str] | Mapping[str, str | Sequence[str]] | None
"""Names of bodies, or with each the names of its parameters that are columns; None for all."""


class Part(NamedTuple):
    """A body with parameters of its own in a regressor: its place among the motion's bodies, and which parameters it
    can have."""

    place: int
    name: str
    about: str  # name of the point that the first moment and the inertia are about
    kind: tuple[int, ...] = tuple(range(10))  # of the ten
    axis: int | None = None  # about which it spins in its frame: both moments of inertia across are one
    has_number: bool = False  # its mass is a number of the description, and no parameter

    @property
    def basis(self) -> np.ndarray:
        """(10, k): what one of each parameter is of the ten."""
        columns = np.eye(10)[:, list(self.kind)]
        if self._across in self.kind:
            columns[4:7, self.kind.index(self._across)] = [i != self.axis for i in range(3)]
        return columns

    @property
    def _across(self) -> int | None:
        return None if self.axis is None else 4 + (self.axis + 1) % 3

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.name}.{'Iacross' if i == self._across else TEN[i]}" for i in self.kind)


class Described(eqx.Module):
    """A system, and its bodies that have parameters in a regressor. `leaves`: of those that the bodies' masses read."""

    system: System
    parts: tuple[Part, ...] = eqx.field(static=True)
    leaves: tuple[int, ...] = eqx.field(static=True)


def origin_of(body: Body) -> tuple[Point, list[Vector]]:
    """The farthest point from which the mass centre was built inside its body, as a joint, and the way from there."""
    point, way = body.center, []
    while point._base is not None and _is_fixed_in(point, body):
        way.append(point._offset)
        point = point._base
    return point, way


def _is_fixed_in(point: Point, body: Body) -> bool:
    claim = point._claim
    still = claim is not None and claim.frame is body.frame and all(is_zero(x) for x in claim.velocity.components)
    turns = not body.is_particle and body.angular_velocity is body.frame.angular_velocity
    return still and turns  # where a body spins in its frame, only points of the axis are fixed in both


_PARTS = Memory()  # by structure


def described(system: System, bodies: Bodies) -> Described:
    """A system and those of its bodies that are named, by default all that have a mass.

    **Raises:** `ValueError` for a name that is no body's, or no parameter's that it can have, and for a body that spins
    in its frame about no axis of it.
    """
    structure = structure_of(system)
    if structure not in _PARTS:
        _PARTS[structure] = _read_parts(system)
    parts, leaves = _PARTS[structure]
    given = bodies
    if bodies is not None:
        bodies = as_names(bodies)
        named = [part.name for part in parts]
        refuse_unknown(bodies, named, f"{type(system).__name__} has no body with a mass named", "it has")
        twice = sorted({name for name in bodies if bodies.count(name) > 1})
        if twice:
            raise ValueError(f"`bodies` names {', '.join(twice)} twice.")
        of_bodies = given if isinstance(given, Mapping) else {}
        parts = tuple(_chosen_of(part, of_bodies.get(part.name)) for part in parts if part.name in bodies)
    skew = [part.name for part in parts if part.axis == SKEW]
    if skew:
        raise ValueError(
            f"{type(system).__name__}: the body {skew[0]!r} turns in its frame, and not about one of the frame's axes "
            "alone: which moments of inertia it may have there cannot be said. Give it a frame that turns with it, or "
            "name the others in `bodies`."
        )
    return Described(system, parts, leaves)


def _chosen_of(part: Part, names: Sequence[str] | None) -> Part:
    """A part with only some of its parameters."""
    if names is None:
        return part
    names = as_names(names)
    known = [name.rpartition(".")[2] for name in part.names]
    refuse_unknown(names, known, f"`bodies`: {part.name} has no parameter", "it has")
    if part.axis is None:
        return part._replace(kind=tuple(i for i in part.kind if TEN[i] in names))
    return part._replace(kind=tuple(i for i, name in zip(part.kind, known, strict=True) if name in names))


def _read_parts(system: System) -> tuple[tuple[Part, ...], tuple[int, ...]]:
    """The parts, and the numbers of the leaves that the masses read."""
    leaves, structure = jax.tree.flatten(system)
    motions: list[Motion] = []

    def read(leaves: Any, t: Any, q: Any, u: Any) -> tuple[list[Any], list[Any]]:
        motion = Reading(jax.tree.unflatten(structure, leaves)).motion(t, tuple(q), tuple(u))
        motions[:] = [motion]
        bodies = [body for body in motion.bodies if not is_zero(body.mass)]
        spins = [body.angular_velocity - body.frame.angular_velocity for body in bodies]
        rows = [spin.components_in(body.frame) for spin, body in zip(spins, bodies, strict=True)]
        return [jnp.asarray(body.mass, float) for body in bodies], [jnp.stack([*map(jnp.asarray, row)]) for row in rows]

    number = jax.ShapeDtypeStruct((), dtype_of(system))
    n_u = len(system.speeds) + len(system.dependent_speeds)
    rows = [[number] * n for n in (len(system.coordinates), n_u)]
    program = jax.make_jaxpr(lambda *args: read(*args)[0])(leaves, number, *rows).jaxpr
    (motion,) = motions
    bodies = [(i, body) for i, body in enumerate(motion.bodies) if not is_zero(body.mass)]
    own = [body.angular_velocity is not body.frame.angular_velocity and not body.is_particle for _, body in bodies]
    axes: list[int | None] = [None] * len(bodies)
    if any(own):
        spins = _at_trial_numbers(lambda *args: read(*args)[1], system, n_u)
        axes = [_axis(spin) if has else None for has, spin in zip(own, spins, strict=True)]
    reads = np.array([_reach(program, v) for v in program.invars[: len(leaves)]], bool).reshape(len(leaves), -1)
    numbered = [not any(column) for column in reads.T]
    found = _parts(motion, list(zip([i for i, _ in bodies], axes, numbered, strict=True)))
    return found, tuple(int(i) for i in np.flatnonzero(reads.any(axis=1)))


def _at_trial_numbers(f: Callable[..., Any], system: System, n_u: int) -> Any:
    rng = np.random.default_rng(0)
    system, t, q = with_trial_numbers((system, 0.3, None), rng)
    u = rng.uniform(0.5, 1.5, n_u).astype(q.dtype)
    with concretely():
        return jax.device_get(jax.jit(f)(jax.tree.leaves(system), jnp.asarray(t, q.dtype), list(q), list(u)))


SKEW = -1  # the axis of a body that turns about none of its frame's


def _axis(spin: np.ndarray) -> int | None:
    """The axis of its frame about which an axisymmetric body spins there; None where it turns with its frame."""
    turning = np.flatnonzero(np.abs(spin) > np.finfo(spin.dtype).eps ** 0.5 * max(1.0, float(np.abs(spin).max())))
    return None if not turning.size else int(turning[0]) if turning.size == 1 else SKEW


def _reach(program: Any, variable: Any) -> list[bool]:
    """Which results of a program may depend on one of its arguments."""
    reached = {variable}
    for equation in program.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in equation.invars):
            reached.update(equation.outvars)
    return [not isinstance(v, Literal) and v in reached for v in program.outvars]


def _parts(motion: Motion, bodies: Sequence[tuple[int, int | None, bool]]) -> tuple[Part, ...]:
    """From the place of each body with a mass, the axis about which it spins, whether its mass is a number."""
    named = {point: name for name, point in motion.points.items()}
    unnamed = sum(body.name == UNNAMED for body in motion.bodies) > 1
    found = []
    for i, axis, has_number in bodies:
        body = motion.bodies[i]
        name = f"{body.name}[{i}]" if unnamed and body.name == UNNAMED else body.name
        origin, _ = origin_of(body)
        about = "its mass centre" if origin is body.center else named.get(origin, origin.name)
        kind = tuple(range(10))
        if body.is_particle:
            kind = (0,)
        elif axis is not None and axis != SKEW:
            kind = (0, 1 + axis, 4 + axis, 4 + (axis + 1) % 3)
        found.append(Part(i, name, about, kind, axis, has_number))
    return tuple(found)
