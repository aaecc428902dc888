"""Bodies with parameters in a regressor, and what they add to Kane's equations, which are linear in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import as_names, refuse_unknown
from .._scalarjit.cache_key import Cache
from .._scalarjit.compat import concretely, depends_on
from .._scalarjit.components import ZERO3, Component, add, add3, dot, is_zero, mul, sub, total
from .._scalarjit.function import ScalarFunction
from .._scalarjit.linear import as_vector, stack
from .._system.bodies import UNNAMED, Body, Force
from .._system.kinematics import Point, Vector
from .._system.motion import Motion
from .._system.system import System
from .arguments import Row
from .evaluate import DescriptionEvaluator, EvaluatedDescription, at_random_point, dtype_of, jvp, structure_of
from .kane import KaneEquations

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
    relative = point._relative_motion
    still = relative is not None and relative.frame is body.frame and all(map(is_zero, relative.velocity.components))
    turns = not body.is_particle and body.angular_velocity is body.frame.angular_velocity
    return still and turns  # where a body spins in its frame, only points of the axis are fixed in both


_PARTS = Cache()  # by structure


def described(system: System, bodies: Bodies) -> Described:
    """A system and those of its bodies that are named, by default all that have a mass.

    **Raises:** `ValueError` for a name that is no body's, or no parameter's that it can have, and for a body that spins
    in its frame about no axis of it.
    """
    parts, leaves = _PARTS.get(structure_of(system), lambda: _read_parts(system))
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
        motion = DescriptionEvaluator(jax.tree.unflatten(structure, leaves)).motion(t, tuple(q), tuple(u))
        motions[:] = [motion]
        bodies = [body for body in motion.bodies if not is_zero(body.mass)]
        spins = [body.angular_velocity - body.frame.angular_velocity for body in bodies]
        rows = [spin.components_in(body.frame) for spin, body in zip(spins, bodies, strict=True)]
        return [jnp.asarray(body.mass, float) for body in bodies], [jnp.stack([*map(jnp.asarray, row)]) for row in rows]

    number = jax.ShapeDtypeStruct((), dtype_of(system))
    n_u = len(system.speeds) + len(system.dependent_speeds)
    rows = [[number] * n for n in (len(system.coordinates), n_u)]
    program = jax.make_jaxpr(lambda *args: read(*args)[0])(leaves, number, *rows)
    (motion,) = motions
    bodies = [(i, body) for i, body in enumerate(motion.bodies) if not is_zero(body.mass)]
    own = [body.angular_velocity is not body.frame.angular_velocity and not body.is_particle for _, body in bodies]
    axes: list[int | None] = [None] * len(bodies)
    if any(own):
        spins = _at_trial_numbers(lambda *args: read(*args)[1], system, n_u)
        axes = [_axis(spin) if has else None for has, spin in zip(own, spins, strict=True)]
    reads = np.array([depends_on(program, [i]) for i in range(len(leaves))], bool).reshape(len(leaves), -1)
    numbered = [not any(column) for column in reads.T]
    found = _parts(motion, list(zip([i for i, _ in bodies], axes, numbered, strict=True)))
    return found, tuple(int(i) for i in np.flatnonzero(reads.any(axis=1)))


def _at_trial_numbers(f: Callable[..., Any], system: System, n_u: int) -> Any:
    rng = np.random.default_rng(0)
    system, t, q = at_random_point((system, 0.3, None), rng)
    u = rng.uniform(0.5, 1.5, n_u).astype(q.dtype)
    with concretely():
        return jax.device_get(jax.jit(f)(jax.tree.leaves(system), jnp.asarray(t, q.dtype), list(q), list(u)))


SKEW = -1  # the axis of a body that turns about none of its frame's


def _axis(spin: np.ndarray) -> int | None:
    """The axis of its frame about which an axisymmetric body spins there; None where it turns with its frame."""
    turning = np.flatnonzero(np.abs(spin) > np.finfo(spin.dtype).eps ** 0.5 * max(1.0, float(np.abs(spin).max())))
    return None if not turning.size else int(turning[0]) if turning.size == 1 else SKEW


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


class Carried(NamedTuple):
    """Of the points of b bodies, each in its body's frame."""

    V: Float[Array, "b 3 n"]
    W: Float[Array, "b 3 n"]
    a: Float[Array, "b 3"]  # [m/s^2]
    alpha: Float[Array, "b 3"]
    omega: Float[Array, "b 3"]
    g: Float[Array, "b 3"]  # weight by mass [m/s^2]


class _SaidOfPoints(EvaluatedDescription):
    """As `EvaluatedDescription`, with the velocities of the bodies' points in the place of momenta."""

    def __init__(self, reading: DescriptionEvaluator, parts: tuple[Part, ...], *at: Any):
        super().__init__(reading, *at)
        self.parts = parts

    def velocities(self) -> tuple[list, list]:
        return self.momenta(), []

    def momenta(self) -> list[tuple[Row, Row]]:
        bodies = [self.motion.bodies[part.place] for part in self.parts]
        return [(origin_of(b)[0].velocity.components, b.angular_velocity.components_in(b.frame)) for b in bodies]

    def turning(self) -> list[tuple[Row, Row]]:
        bodies = [self.motion.bodies[part.place] for part in self.parts]
        frames = [(origin_of(b)[0].velocity.frame, b.frame) for b in bodies]
        return [(a.angular_velocity.components, b.angular_velocity.components) for a, b in frames]


@ScalarFunction
def _said(described: Described, components: Any) -> dict[str, Any]:
    inputs, t, q, u = components
    said = _SaidOfPoints(DescriptionEvaluator(described.system, inputs), described.parts, t, q, u)
    return {part: getattr(said, part)() for part in "rates configuration rolling velocities momenta turning".split()}


class _Points(KaneEquations):
    """An instant whose velocities and momenta are those of the bodies' points."""

    def __init__(self, described: Described, t: Any, q: Any, u: Any, inputs: Any):
        self.described = described
        super().__init__(described.system, t, q, u, inputs)

    def read(self, part: str, t: Component, q: Row, u: Row) -> Any:
        return _said.replay(part, self.described, (dict(self.inputs), t, tuple(q), tuple(u)), self._memory)

    def weights(self) -> list[tuple[Component, Row]]:
        """How each body's mass changes with the parameters that it reads, and how the forces at its centre do.

        A mass that is a number of the description is changed by itself: `weight` reads it off the body.
        """
        leaves, structure = jax.tree.flatten(self.system)
        moved, parts = self.described.leaves, self.described.parts
        u = tuple(jnp.asarray(x, self._zero().dtype) for x in self.u_all)

        def read(*moving: Any) -> list[tuple[Component, Row]]:
            own, more = moving[: len(moved)], moving[len(moved)]
            given = list(leaves)
            for i, x in zip(moved, own, strict=True):
                given[i] = x
            reading = DescriptionEvaluator(jax.tree.unflatten(structure, given), self.inputs)
            motion = reading.motion(self.t, self.q, u)
            bodies = [motion.bodies[part.place] for part in parts]
            for body, part in zip(bodies, parts, strict=True):
                body.mass = add(body.mass, more) if part.has_number else body.mass
            loads = reading.loads_at(self.t, self.q, u, motion)
            return [(body.mass, _at_center(body, loads)) for body in bodies]

        primals = [*[leaves[i] for i in moved], self._zero()]
        # Each by another amount, so that no sum or difference of them stays as it is.
        tangents = [jnp.full_like(x, 1.0 + 0.1 * i) for i, x in enumerate(primals)]
        return jvp(read, primals, tangents)[1]


def _by_mass(change: tuple[Component, Row]) -> tuple[Component, Row]:
    m, F = jnp.asarray(change[0]), change[1]
    return jnp.where(m == 0.0, 0.0, 1.0 / jnp.where(m == 0.0, 1.0, m)), F


def _at_center(body: Body, loads: Sequence[Any]) -> Row:
    total: Row = ZERO3
    for load in loads:
        if isinstance(load, Force) and load.point is body.center:
            total = add3(total, load.vector.components_in(body.frame))
    return total


@ScalarFunction
def carried(described: Described, t, q, u, inputs, u_dot) -> Carried:
    """`Carried` of the bodies of a system, at accelerations `u_dot` (n,) of the independent speeds."""
    now = _Points(described, t, q, u, inputs)
    row = tuple(u_dot[i] for i in range(now.n))
    partials = now.partials()
    rates = now.momentum_rates((*row, *now.dependent_accelerations(row)))
    omegas = [omega for _, omega in now.momenta(now.u_all)]
    motion = now.motion(now.t, now.q, now.u_all)
    V, W, a, alpha = [], [], [], []
    for i, part in enumerate(described.parts):
        body = motion.bodies[part.place]
        origin, _ = origin_of(body)
        own = origin.velocity.frame
        into = lambda x, frame=own, body=body: frame.vector(*x).components_in(body.frame)  # noqa: E731
        V.append([into(bodies[i][0]) for bodies, _ in partials])
        W.append([bodies[i][1] for bodies, _ in partials])
        a.append(into(rates[i][0]))
        alpha.append(rates[i][1])
    g = [tuple(mul(x, reciprocal) for x in F) for reciprocal, F in map(_by_mass, now.weights())]
    n, b = now.n, len(described.parts)
    array = lambda rows: stack(rows).astype(q.dtype).reshape(b, -1) if b else jnp.zeros((0, 3), q.dtype)  # noqa: E731
    columns = lambda rows: jnp.swapaxes(  # noqa: E731
        stack([x for row in rows for x in row]).astype(q.dtype).reshape(b, n, 3)
        if b
        else jnp.zeros((0, n, 3), q.dtype),
        1,
        2,
    )
    return Carried(columns(V), columns(W), array(a), array(alpha), array(omegas), array(g))


def _ten(body: Body) -> Row:
    """The ten values of a body, about the point that it was built from."""
    r: Row = ZERO3
    for step in origin_of(body)[1]:
        r = add3(r, step.components_in(body.frame))
    square = dot(r, r)
    I = [
        [add(body.inertia[i][j], mul(body.mass, sub(square if i == j else 0.0, mul(r[i], r[j])))) for j in range(3)]
        for i in range(3)
    ]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return (body.mass, *(mul(body.mass, x) for x in r), *(I[i][j] for i, j in pairs))


def columns_of(now: Carried, parts: Sequence[Part]) -> Float[Array, "n p"]:
    """The columns of all bodies' parameters, side by side."""
    a, alpha, omega = now.a - now.g, now.alpha, now.omega
    turn = _cross(omega)
    of_moment = _cross(alpha) + turn @ turn
    zero = jnp.zeros_like(of_moment)
    F = jnp.concatenate([a[:, :, None], of_moment, zero, zero], axis=2)  # (b,3,10)
    T = jnp.concatenate([jnp.zeros_like(a)[:, :, None], -_cross(a), _times(alpha) + turn @ _times(omega)], axis=2)
    Y = jnp.swapaxes(now.V, 1, 2) @ F + jnp.swapaxes(now.W, 1, 2) @ T  # (b,n,10)
    rows = [Y[i] @ jnp.asarray(part.basis, Y.dtype) for i, part in enumerate(parts)]
    return jnp.concatenate([jnp.zeros((now.V.shape[2], 0), Y.dtype), *rows], axis=1)


@ScalarFunction
def values_of(described: Described, t, q, u) -> Float[Array, " p"]:
    """The parameters of the bodies, in the order of the columns; they are the same at all times, `u` (n + k,)."""
    rows = [tuple(x[i] for i in range(x.shape[0])) for x in (q, u)]
    motion = DescriptionEvaluator(described.system).motion(t, *rows)
    ten = [_ten(motion.bodies[part.place]) for part in described.parts]
    values = [ten[i][k] for i, part in enumerate(described.parts) for k in part.kind]
    return as_vector(values, q) if values else jnp.zeros(0, q.dtype)


def _cross(x: Float[Array, "b 3"]) -> Float[Array, "b 3 3"]:
    """[x]: x cross y = [x] y."""
    zero = jnp.zeros_like(x[:, 0])
    a, b, c = x[:, 0], x[:, 1], x[:, 2]
    return jnp.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=1).reshape(-1, 3, 3)


def _times(x: Float[Array, "b 3"]) -> Float[Array, "b 3 6"]:
    """The matrix that takes (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) to I x."""
    zero = jnp.zeros_like(x[:, 0])
    a, b, c = x[:, 0], x[:, 1], x[:, 2]
    rows = [a, zero, zero, b, c, zero, zero, b, zero, a, zero, c, zero, zero, c, zero, a, b]
    return jnp.stack(rows, axis=1).reshape(-1, 3, 6)


@ScalarFunction
def unbalanced(system: System, t, q, u, inputs, u_dot) -> Float[Array, " n"]:
    """-(F_r + F*_r) (n,) at accelerations `u_dot`: zero in the motion."""
    now = KaneEquations(system, t, q, u, inputs)
    row = tuple(u_dot[i] for i in range(now.n))
    partials = now.partials()
    rates = now.momentum_rates((*row, *now.dependent_accelerations(row)))
    needed = [
        total(add(dot(V, p), dot(W, H)) for (V, W), (p, H) in zip(bodies, rates, strict=True)) for bodies, _ in partials
    ]
    return as_vector([sub(x, F) for x, F in zip(needed, now.active_forces(partials), strict=True)], q)
