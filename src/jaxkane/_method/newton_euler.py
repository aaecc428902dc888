"""What bodies with any mass, mass centre and inertia would add to Kane's equations, which is linear in them.

For a body and a point P that is fixed in it, with its mass m, first moment s = m r_PC and inertia I about P:

    force   F = m (a_P - g) + alpha x s + omega x (omega x s)
    moment  T = I alpha + omega x I omega + s x (a_P - g)            about P
    -F*_r - (weight)_r = V_Pr . F + W_r . T

(Newton and Euler; Atkeson, An and Hollerbach, Estimation of inertial parameters of manipulator loads and links, Int. J.
Robotics Research, 1986; Khalil and Dombre, Modeling, Identification and Control of Robots, 2002, chapter 12). Partial
velocities and accelerations of P are the method's own; the weight g is read off the loads that act at mass centres.
Knows Kane's method; knows no mechanism, and nothing of data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._description.bodies import Body
from .._description.loads import Force
from .._description.system import System
from .._scalars.components import ZERO3, add, add3, dot, mul, sub, total
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, stack
from .._scalars.record import recorded
from .._scalars.types import Component
from .body_parts import Described, Part, origin_of
from .derivatives import jvp
from .kane import Instant
from .reading import Parts, Reading
from .values import Row


class Carried(NamedTuple):
    """Of the points of b bodies, each in its body's frame."""

    V: Float[Array, "b 3 n"]
    W: Float[Array, "b 3 n"]
    a: Float[Array, "b 3"]  # [m/s^2]
    alpha: Float[Array, "b 3"]
    omega: Float[Array, "b 3"]
    g: Float[Array, "b 3"]  # weight by mass [m/s^2]


class _SaidOfPoints(Parts):
    """As `Parts`, with the velocities of the bodies' points in the place of momenta."""

    def __init__(self, reading: Reading, parts: tuple[Part, ...], *at: Any):
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


@recorded
def _said(described: Described, components: Any) -> dict[str, Any]:
    inputs, t, q, u = components
    said = _SaidOfPoints(Reading(described.system, inputs), described.parts, t, q, u)
    return {part: getattr(said, part)() for part in "rates configuration rolling velocities momenta turning".split()}


class _Points(Instant):
    """An instant whose velocities and momenta are those of the bodies' points."""

    def __init__(self, described: Described, t: Any, q: Any, u: Any, inputs: Any):
        self.described = described
        super().__init__(described.system, t, q, u, inputs)

    def read(self, part: str, t: Component, q: Row, u: Row) -> Any:
        return _said(part, self.described, (dict(self.inputs), t, tuple(q), tuple(u)), self._memory)

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
            reading = Reading(jax.tree.unflatten(structure, given), self.inputs)
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


@fused
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


@fused
def values_of(described: Described, t, q, u) -> Float[Array, " p"]:
    """The parameters of the bodies, in the order of the columns; they are the same at all times, `u` (n + k,)."""
    rows = [tuple(x[i] for i in range(x.shape[0])) for x in (q, u)]
    motion = Reading(described.system).motion(t, *rows)
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


@fused
def unbalanced(system: System, t, q, u, inputs, u_dot) -> Float[Array, " n"]:
    """-(F_r + F*_r) (n,) at accelerations `u_dot`: zero in the motion."""
    now = Instant(system, t, q, u, inputs)
    row = tuple(u_dot[i] for i in range(now.n))
    partials = now.partials()
    rates = now.momentum_rates((*row, *now.dependent_accelerations(row)))
    needed = [
        total(add(dot(V, p), dot(W, H)) for (V, W), (p, H) in zip(bodies, rates, strict=True)) for bodies, _ in partials
    ]
    return as_vector([sub(x, F) for x, F in zip(needed, now.active_forces(partials), strict=True)], q)
