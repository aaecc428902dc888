"""Kane's equations with the forces of contacts and dry friction.

Every contact has a gap, a normal velocity v_N (positive if the bodies separate) and, with friction, the slip v_T. Its
contact state is open, slides or sticks, and changes only at jumps (see `states_after_jump`). Between two jumps the
closed contacts are constraints with multipliers:

    M u_dot = f + C^T F,   v = C u + c0
    v_N_dot = 0,  F_T = -mu F_N v_T / |v_T|         while a contact slides
    v_N_dot = 0,  v_T_dot = 0                       while it sticks
    F = 0                                           while it is open

The multipliers of contacts that are open are masked by numbers, so one program serves all contact states. With
M = X^-T X^-1 and F = W z:

    (C X)(C X)^T W z = -(C M^-1 f + v_dot at u_dot = 0)

Rows that depend linearly on previous ones are omitted. Then the accelerations are unique, and the forces are those of
the smallest norm. The right-hand side uses speeds that are projected onto the closed contacts, in the metric of M.
Otherwise the slip of a sticking contact would drift by the error of the solver, and the gap by its integral.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._common.lookup import checked, refuse_if
from ..._scalarjit.components import (
    ZERO3,
    Component,
    Numbers,
    add,
    as_vector,
    component,
    cross,
    is_exact,
    is_zero,
    stack,
)
from ..._scalarjit.scalar_function import ScalarFunction
from ..._system.kinematics import Frame, Vector
from ..._system.motion import Motion
from ..._system.system import System
from ..arguments import InputValues, Row, has_multipliers
from ..constraint_residuals import configuration_tolerance
from ..description import dtype_of, jvp
from ..kanes_method import KaneEquations
from ..scaling import RowBasis, term_sizes
from .declarations import Contact, DryFriction
from .impulses import Permanent, inverse_root
from .laws import SLIDES, STICKS, force_scales, most_contacts, with_friction


class ContactLayout(eqx.Module):
    """The contacts of a system, without numbers. All fields are static.

    - `names` (c,): in alphabetical order.
    - `has_friction` (c,): whether each contact has tangential rows.
    - `is_bearing` (c,): whether it is a `DryFriction`.
    - `in_space`: whether the slip has two components.
    - `planes` (c,): the axis of N along which no point of the contact moves, or None.
    - `has_point` (c,): whether a contact has a point.
    - `reads_time`: whether any contact uses the time.
    - `n_residuals`: the number of velocity residuals with multipliers (see `with_multipliers`).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    has_friction: tuple[bool, ...] = eqx.field(static=True)
    is_bearing: tuple[bool, ...] = eqx.field(static=True)
    in_space: bool = eqx.field(static=True)
    planes: tuple[int | None, ...] = eqx.field(static=True)
    has_point: tuple[bool, ...] = eqx.field(static=True)
    reads_time: bool = eqx.field(static=True, default=False)
    n_residuals: int = eqx.field(static=True, default=0)

    @property
    def d(self) -> int:
        """The number of tangential rows of each contact."""
        return (2 if self.in_space else 1) if any(self.has_friction) else 0

    @property
    def memory_width(self) -> int:
        """The number of floats of a contact state: the state itself, the direction of the slip, `slow` and an error."""
        return 6 if self.d == 2 else 1 + self.d

    @property
    def memory_size(self) -> int:
        return len(self.names) * self.memory_width


MOST_SPEEDS = 18
"""The largest number of speeds of a system with contacts. A program of scalars cannot contain large products of
matrices. Four contacts with friction and 18 speeds need (12, 18) (18, 18), which is just possible."""

NO_CONTACTS = ContactLayout((), (), (), False, (), ())


def has_contacts(system: System) -> bool:
    return type(system).contacts is not System.contacts


def layout_of(system: System) -> ContactLayout:
    """The `ContactLayout` of a system. The first call traces its contacts.

    **Raises:** `TypeError` or `ValueError` if `contacts` does not return a dict of contacts by name; `ValueError` for
    more than eight contacts (six in a plane with friction), and for too many speeds.
    """
    if not has_contacts(system) and not has_multipliers(system):
        return NO_CONTACTS
    n = len(system.speeds)
    refuse_if(
        n > (12 if has_multipliers(system) else MOST_SPEEDS),
        f"{type(system).__name__}: contacts need a system with at most {MOST_SPEEDS} speeds, or 12 with multipliers, "
        f"and this one has {n}. Use `jaxkane.loads.plane_contact`, or MuJoCo.",
    )
    dtype = dtype_of(system)
    q, u = (np.zeros(len(names), dtype) for names in (system.coordinates, system.speeds))
    arguments = system, np.zeros((), dtype), q, u
    numbers, program = _traced_layout.program(*arguments)
    if program is None:
        layout, reads_time = jax.eval_shape(_traced_layout.__wrapped__, *arguments)[0], True
    else:
        layout = jax.tree.unflatten(program.structure, program.out_avals)[0]
        reads_time = program.reads[len(numbers) - 3]
    return dataclasses.replace(layout, reads_time=reads_time)


@ScalarFunction
def _traced_layout(system: System, t: Component, q: Array, u: Array) -> Any:
    """The layout, and all numbers of the contacts (n,). They show whether a contact depends on the time."""
    kane = KaneEquations(system, t, q, u)
    at = kane.t, kane.q, kane.u_all
    motion, by_name = _contacts(kane, *at)
    contacts, names, own = [*by_name.values()], ", ".join(by_name), cast(Any, system)
    is_bearing = tuple(isinstance(x, DryFriction) for x in contacts)
    has_friction = tuple(isinstance(x, DryFriction) or not is_zero(component(x.friction)) for x in contacts)
    has_point = tuple(isinstance(x, Contact) and x.point is not None for x in contacts)
    planes = tuple(_plane(x, motion.N) if has else 2 for x, has in zip(contacts, has_point, strict=True))
    in_space = any(f and p is None for f, p in zip(has_friction, planes, strict=True))
    refuse_if(
        len(contacts) > (most := most_contacts(any(has_friction), in_space)),
        f"{kane.name} has {len(contacts)} contacts: {names}. At most {most} are possible. Use "
        "`jaxkane.loads.plane_contact` for more, or MuJoCo.",
    )
    n_residuals = len(own.multiplier_residuals(*at)) if has_multipliers(system) else 0
    layout = ContactLayout(
        tuple(by_name), has_friction, is_bearing, in_space, planes, has_point, n_residuals=n_residuals
    )
    rows = ContactRows(kane, layout)
    numbers = [rows.gaps(*at), *rows.velocities(*at), *map(_laws, contacts)]
    return layout, as_vector([x for row in numbers for x in row], q)


def _contacts(kane: KaneEquations, t: Component, q: Row, u: Row) -> tuple[Motion, dict[str, Any]]:
    motion = kane.motion(t, q, u)
    contacts = kane.system.contacts(t, q, u, motion)
    label = f"{kane.name}.contacts"
    for name, contact in checked(contacts, Mapping, f"{label} must return a dict of contacts by name").items():
        checked(name or None, str, f"{label}: the name of a contact must be a string")
        checked(contact, Contact | DryFriction, f"{label}: {name!r} must be a jaxkane.Contact or jaxkane.DryFriction")
    return motion, {name: contacts[name] for name in sorted(contacts)}


def _relative_velocity(contact: Contact) -> Vector:
    v = contact.point.velocity  # pyright: ignore[reportOptionalMemberAccess]
    return v if contact.surface is None else v - contact.surface.velocity


def _unit_normal(contact: Contact, N: Frame) -> tuple[Component, ...]:
    n = contact.normal.components_in(N)  # pyright: ignore[reportOptionalMemberAccess]
    if all(is_exact(x) for x in n) and sum(float(x) ** 2 for x in n) == 1.0:
        return n
    return contact.normal.normalize().components_in(N)  # pyright: ignore[reportOptionalMemberAccess]


def _plane(contact: Contact, N: Frame) -> int | None:
    v, n = _relative_velocity(contact).components_in(N), _unit_normal(contact, N)
    still = [i for i in range(3) if is_zero(v[i]) and is_zero(n[i])]
    return still[-1] if still else None


def _tangents(normal: Row, plane: int | None, in_space: bool) -> list[Row]:
    """Unit vectors of the slip, with components in N."""
    a, b, c = normal
    if plane is not None:
        # n x the axis, with the sign for which a floor has the slip along x (or y).
        along: Row = [(0.0, c, -b), (c, 0.0, -a), (b, -a, 0.0)][plane]
        return [along, (0.0, 0.0, 0.0)] if in_space else [along]
    is_flat = is_exact(a) and is_exact(b) and is_exact(c)
    if is_flat and abs(float(c)) > 0.9:
        first: Any = (c, 0.0, -a)
    elif is_flat:
        first = (b, -a, 0.0)
    else:
        steep = jnp.abs(jnp.asarray(c)) > 0.6
        first = tuple(jnp.where(steep, x, y) for x, y in zip((c, 0.0 * c, -a), (b, -a, 0.0 * c)))
    size = math.hypot(*first) if is_flat else jnp.sqrt(sum(jnp.asarray(x) ** 2 for x in first))
    first = first if is_flat and size == 1.0 else tuple(x / size for x in first)
    return [first, cross(normal, first)]  # pyright: ignore[reportArgumentType]


class Laws(NamedTuple):
    """Numbers of the contacts: restitution, kinetic and static friction (c,), each zero where it does not apply."""

    restitution: Array
    friction: Array
    static: Array

    def are_valid(self, strike: Array | bool = True, touch: Array | bool = True) -> Array:
        """Whether the restitution of contacts that `strike` (c,) and the friction of those that `touch` are possible.

        Static and kinetic friction may be two formulas for one number, which differ by a rounding error.
        """
        e, kinetic, static = jax.lax.stop_gradient(self)
        one = 1.0 + 64 * float(jnp.finfo(e.dtype).eps)
        is_possible = (e >= 0) & (e <= one), (kinetic >= 0) & (one * static >= kinetic)
        return jnp.all(jnp.where(strike, is_possible[0], True) & jnp.where(touch, is_possible[1], True))


class ContactTerms(NamedTuple):
    """Kane's equations of a system with c contacts of r = 1 + d rows each, at one state.

    - `gaps` (c,): of bearings infinite. `v` (c, r): velocities of the rows. `size` (c, r): sizes of their terms.
    - `C` (c r, n): derivatives of these velocities by the independent speeds. `b` (c r,): v_dot at u_dot = 0.
    - `X` (n, n): with X^T M X = 1. `w` (n,): X^T f.
    - `laws`: restitution and friction.
    - `tangents` (c, d, 3): directions of the slip in N.
    - `Q` (n_q, n): derivatives of the rates of the coordinates by the independent speeds.

    With residuals that have multipliers, X X^T is the inverse of M on the speeds that they permit. Then `a0` (n,) are
    the accelerations that the residuals require, and `shift` (n,) is the change of the speeds to the nearest ones that
    they permit.
    """

    gaps: Array
    v: Array
    size: Array
    C: Array
    b: Array
    X: Array
    w: Array
    laws: Laws
    tangents: Array
    Q: Array
    a0: Array
    shift: Array

    @property
    def B(self) -> Array:
        """C X (c r, n)."""
        return self.C @ self.X

    @property
    def a(self) -> Array:
        """v_dot (c, r) if all contacts were open."""
        return (self.B @ self.w + self.b).reshape(self.v.shape)

    @property
    def a_size(self) -> Array:
        """The sizes of the terms of `a` (c, r)."""
        return (jnp.abs(self.B) @ jnp.abs(self.w) + jnp.abs(self.b)).reshape(self.v.shape)

    @property
    def mobility(self) -> Array:
        """The acceleration (c, r) of each row by a force of 1 N along it: the diagonal of G."""
        return jnp.sum(self.B.reshape(*self.v.shape, -1) ** 2, axis=2)

    @property
    def delassus(self) -> Array:
        """G (c, r, c, r) = C M^-1 C^T."""
        return (self.B @ self.B.T).reshape(self.v.shape * 2)


class ContactRows:
    """The velocities of the contacts as functions of time, coordinates and all speeds."""

    def __init__(self, kane: KaneEquations, layout: ContactLayout):
        self.kane, self.layout = kane, layout

    def gaps(self, t: Component, q: Row, u: Row) -> list[Component]:
        motion, contacts = _contacts(self.kane, t, q, u)
        gaps: list[Component] = []
        for contact in contacts.values():
            if isinstance(contact, DryFriction) or contact.gap is not None:
                gaps.append(1.0 if isinstance(contact, DryFriction) else component(contact.gap))
                continue
            r = contact.point.position
            r = r if contact.surface is None else r - contact.surface.position
            gaps.append(r.dot(motion.N.vector(*_unit_normal(contact, motion.N))))
        return gaps

    def gap_rates(self, t: Component, q: Row, u: Row) -> list[Component]:
        direction = (1.0, *self.kane.rates(t, q, u))
        return jvp(lambda t, *q: self.gaps(t, q, u), (t, *q), direction)[1]

    def velocities(self, t: Component, q: Row, u: Row) -> list[list[Component]]:
        """The velocities (c, r): the normal one, and the tangential ones."""
        motion, contacts = _contacts(self.kane, t, q, u)
        needs_gap = any(isinstance(x, Contact) and x.point is None for x in contacts.values())
        rates = self.gap_rates(t, q, u) if needs_gap else [0.0] * len(contacts)
        d, rows = self.layout.d, []
        for i, contact in enumerate(contacts.values()):
            if isinstance(contact, DryFriction):
                rows.append([0.0, component(contact.slip), *[0.0] * (d - 1)])
            elif contact.point is None:
                rows.append([rates[i], *[0.0] * d])
            else:
                v = _relative_velocity(contact)
                rows.append([v.dot(motion.N.vector(*e)) for e in self.axes(contact, i, motion.N)])
        return rows

    def axes(self, contact: Contact | DryFriction, i: int, N: Frame) -> list[Row]:
        """The normal and the tangents of contact i, with components in N; zero if they do not exist."""
        d = self.layout.d
        if isinstance(contact, DryFriction) or not self.layout.has_point[i]:
            return [ZERO3] * (1 + d)
        normal = _unit_normal(contact, N)
        has_tangents = self.layout.has_friction[i]
        return [normal, *(_tangents(normal, self.layout.planes[i], d == 2) if has_tangents else [ZERO3] * d)]


class _Geometry:
    """Terms of `ContactTerms` that depend on time and coordinates, but not on speeds."""

    def __init__(self, kane: KaneEquations, layout: ContactLayout):
        self.layout, self.rows = layout, ContactRows(kane, layout)
        t, q, u = kane.t, kane.q, kane.u_all
        c, like = len(layout.names), jnp.zeros((), kane.dtype)
        self.C = kane.jacobian(lambda u: self._velocities(t, q, u)) if c else jnp.zeros((0, kane.n), kane.dtype)
        self.Q = kane.jacobian(lambda u: kane.rates(t, q, u))
        self.partials = kane.partial_velocities()
        mass = kane.mass_matrix(self.partials)
        permanent = Permanent.of(kane)
        if permanent is not None:
            A, M = permanent.C, stack(mass).astype(kane.dtype)
            # A massless link: M is regular for the permitted speeds only. On these, M + A^T W A is the same as M.
            m = jnp.stack([M[i, i] for i in range(kane.n)])[None]
            sizes = jax.lax.stop_gradient(jnp.max(jnp.where(m > 0, A**2 / jnp.where(m > 0, m, 1.0), 0.0), axis=1))
            M = M + A.T @ (A / jnp.where(sizes > 0, sizes, 1.0)[:, None])
            mass = [[M[i, j] for j in range(kane.n)] for i in range(kane.n)]
        self.root = self.X = stack(inverse_root(mass)).astype(kane.dtype)  # X^T M X = 1
        self.basis = None if permanent is None else permanent.basis(self.root)
        if self.basis is not None:
            self.X = self.root - (self.root @ self.basis.Q.T) @ self.basis.Q
        motion, contacts = _contacts(kane, t, q, u)
        axes = [self.rows.axes(x, i, motion.N)[1:] for i, x in enumerate(contacts.values())]
        tangents = [x for each in axes for e in each for x in e]
        self.tangents = as_vector(tangents, like).reshape(c, layout.d, 3)
        self.gaps = as_vector(self.rows.gaps(t, q, u), like)

    def _velocities(self, t: Component, q: Row, u: Row) -> list[Component]:
        return [x for row in self.rows.velocities(t, q, u) for x in row]

    def terms(self, kane: KaneEquations, with_forces: bool = True) -> ContactTerms:
        """All terms, with the speeds of `kane`. If `with_forces` is False, `b`, `w` and `a0` are zero."""
        t, q, u, like = kane.t, kane.q, kane.u_all, jnp.zeros((), kane.dtype)
        C, X, shape = self.C, self.X, (len(self.gaps), 1 + self.layout.d)
        along = (1.0, *kane.q_dot, *(0.0,) * kane.n, *kane.bias()) if with_forces else ()

        def with_rates(f: Callable[[Component, Row, Row], Sequence[Component]]) -> tuple[Array, Array]:
            """`f` and its rate at u_dot = 0; without forces, the rate is zero."""
            if not with_forces:
                return (value := as_vector(f(t, q, u), like)), jnp.zeros_like(value)
            value, rate = jvp(lambda t, *z: f(t, z[: len(q)], z[len(q) :]), (t, *q, *u), along)
            return as_vector(value, like), as_vector(rate, like)

        v, b = with_rates(self._velocities)
        w = a0 = shift = jnp.zeros(kane.n, kane.dtype)
        if with_forces:
            forces = zip(kane.active_forces(self.partials), kane.inertia_forces(self.partials), strict=True)
            w = X.T @ as_vector([add(x, y) for x, y in forces], like)
        if self.basis is not None:
            residuals, drift = with_rates(cast(Any, kane.system).multiplier_residuals)
            a0, shift = (self.root @ self.basis.least_norm(-x) for x in (drift, residuals))
            b = b + C @ a0
        size = jnp.abs(v) + jnp.abs(C) @ jnp.abs(as_vector(kane.u, like))
        laws = [_laws(x) for x in _contacts(kane, t, q, u)[1].values()]
        laws = Laws(*(as_vector([law[i] for law in laws], like) for i in range(3)))
        v, size, T, Q = v.reshape(shape), size.reshape(shape), self.tangents, self.Q
        return ContactTerms(self.gaps, v, size, C, b, X, w, laws, T, Q, a0, shift)


def _laws(contact: Contact | DryFriction) -> tuple[Component, Component, Component]:
    if isinstance(contact, DryFriction):
        return 0.0, component(contact.kinetic), component(contact.static)
    return component(contact.restitution), component(contact.friction), component(contact.static)


def speeds_in_contact(
    system: System, t: Component, q: Array, u: Array, touching: Sequence[str], named: Sequence[str]
) -> tuple[Array, Array]:
    """The nearest speeds (n,), in the metric of M, for which the `touching` contacts neither approach nor separate.

    The `named` speeds keep their values. **Returns:** the speeds, and whether no such speeds exist.
    """
    layout, terms = layout_of(system), terms_at(system, t, q, u, {})
    kept = np.array([name in named for name in system.speeds])
    closed = np.array([name in touching for name in layout.names], bool)
    C = terms.C.reshape(*terms.v.shape, len(u))[:, 0]
    rows = jnp.concatenate([np.eye(len(u), dtype=u.dtype)[kept], C[closed]])
    needed = jnp.concatenate([np.zeros(sum(kept), u.dtype), -terms.v[closed, 0]])
    change = terms.shift
    if len(rows):
        change = change + terms.X @ RowBasis.of(rows @ terms.X).least_norm(needed - rows @ terms.shift)
    sizes = jnp.abs(rows) @ (jnp.abs(u) + jnp.abs(terms.shift) + jnp.abs(change))
    return u + change, jnp.any(jnp.abs(rows @ change - needed) > configuration_tolerance(u.dtype) * sizes)


class ContactMemory(NamedTuple):
    """The contact states: `states` (c,) as floats, `directions` (c, k) of the slip at its start, and `slow` (c, m).

    In a plane, a direction is a sign, k = 1, m = 0. In space it is a unit vector in N, k = 3, m = 2. Without friction,
    k = m = 0. `slow` has two speeds [m/s]. The first one is positive if the slip began from rest (see
    `slip_directions`). The second one is the error of a step when the slip began.
    """

    states: Array
    directions: Array
    slow: Array

    @classmethod
    def unpacked(cls, layout: ContactLayout, memory: Array) -> ContactMemory:
        table = memory.reshape(len(layout.names), layout.memory_width)
        return cls(table[:, 0], table[:, 1:4], table[:, 4:])

    def packed(self) -> Array:
        return jnp.concatenate([self.states[:, None], self.directions, self.slow], axis=1).reshape(-1)

    def starts(self, layout: ContactLayout, tangents: Array) -> Array:
        """The directions of the slip at its start, in the `tangents` (c, d, 3)."""
        if layout.d < 2:
            return self.directions
        starts = jnp.sum(tangents * self.directions[:, None, :], axis=2)
        bearing = jnp.asarray([[1.0, 0.0] if x else [0.0, 0.0] for x in layout.is_bearing], starts.dtype)
        return jnp.where(jnp.asarray(layout.is_bearing)[:, None], bearing * self.directions[:, :1], starts)


def slip_directions(layout: ContactLayout, terms: ContactTerms, memory: ContactMemory) -> Array:
    """Directions (c, d) of the slip in the tangents, opposite to the friction.

    In a plane it is a sign. In space it is the direction of s v, where v is the velocity, e the direction at the start
    and s the sign of v . e: a step over a zero of v is smooth. If the slip began from rest, it is the direction of

        s v + slow (1 - v^2 / slow^2)^2 e    while |v| < slow [m/s]

    For small v this tends to e. The direction of v alone is then an error, and turns at the rate a / |v|, where a is
    the acceleration by friction. With it, a slip that began without an acceleration (static = kinetic friction) took
    600 000 steps for tolerances of 1e-10, and its error was 3e-6 m/s.
    """
    start = memory.starts(layout, terms.tangents)
    if layout.d < 2:
        return start
    v, slow = terms.v[:, 1:], memory.slow[:, 0]
    share = 1.0 - jnp.sum(v**2, axis=1) / jnp.where(slow > 0, slow, 1.0) ** 2
    rest = jnp.where((slow > 0) & (share > 0), slow * share**2, 0.0)
    way = jnp.where(jnp.sum(v * start, axis=1) < 0, -1.0, 1.0)
    directions = way[:, None] * v + rest[:, None] * start
    length2 = jnp.sum(directions**2, axis=1)
    is_known = length2 > (1e3 * float(jnp.finfo(v.dtype).eps) * jnp.sum(terms.size[:, 1:], axis=1)) ** 2
    length = jnp.sqrt(jnp.where(is_known, length2, 1.0))
    return jnp.where(is_known[:, None], directions / length[:, None], start)


class ContactForces(NamedTuple):
    """Contact forces and accelerations.

    - `forces` (c, r) [N]: normal and tangential. - `u_dot` (n,): accelerations of the independent speeds.
    """

    forces: Array
    u_dot: Array


def solve_forces(layout: ContactLayout, terms: ContactTerms, memory: ContactMemory) -> ContactForces:
    """The contact forces and the accelerations for given contact states."""
    c, r = terms.v.shape
    if not c:
        return ContactForces(jnp.zeros_like(terms.v), terms.a0 + terms.X @ terms.w)
    is_bearing = jnp.asarray(layout.is_bearing)
    closed = (memory.states >= SLIDES) & ~is_bearing
    slides = memory.states == SLIDES
    active = _active_rows(layout, memory)
    dirs, B, w = slip_directions(layout, terms, memory), terms.B, terms.w
    if layout.d:
        # A bearing that slides has a known force.
        known = jnp.where(is_bearing & slides, -terms.laws.friction, 0.0)[:, None] * dirs
        known = jnp.concatenate([jnp.zeros((c, 1), w.dtype), known], axis=1).reshape(-1)
        w = w + B.T @ known
        ratios = jnp.where(closed & slides, -terms.laws.friction, 0.0)[:, None] * dirs
        ratios = jnp.concatenate([jnp.zeros((c, 1), w.dtype), ratios], axis=1)
    else:
        known, ratios = jnp.zeros(c * r, w.dtype), jnp.zeros((c, r), w.dtype)
    # F = W z:  the friction of a contact that slides is proportional to its normal force
    W = with_friction(ratios)
    mask = active.reshape(-1)
    A = jnp.where(mask[:, None] & mask[None], (B @ B.T) @ W, 0.0)
    needed = jnp.where(mask, -(B @ w + terms.b), 0.0)
    z = RowBasis.of(A).least_norm(needed)
    if c > 1 and layout.d:
        normal = (W @ z).reshape(c, r)[:, 0]
        limits = terms.laws.static * jnp.where(is_bearing, 1.0, normal)
        scales = force_scales(limits, memory.states == STICKS, r)
        z = scales * RowBasis.of(A * scales[None]).least_norm(needed)
    forces = W @ z
    u_dot = terms.a0 + terms.X @ (w + B.T @ forces)
    return ContactForces((forces + known).reshape(c, r), u_dot)


def _active_rows(layout: ContactLayout, memory: ContactMemory) -> Array:
    """Which rows (c, r) are constraints."""
    is_bearing = jnp.asarray(layout.is_bearing)
    normal = (memory.states >= SLIDES) & ~is_bearing
    rows = np.zeros((len(layout.names), layout.d), bool)  # the tangential rows that exist
    for i, (has, plane, bearing) in enumerate(zip(layout.has_friction, layout.planes, layout.is_bearing, strict=True)):
        rows[i, : (1 if bearing or plane is not None else layout.d) if has else 0] = True
    tangential = (memory.states == STICKS)[:, None] & jnp.asarray(rows)
    return jnp.concatenate([normal[:, None], tangential], axis=1)


def are_independent(layout: ContactLayout, terms: ContactTerms, memory: ContactMemory) -> Array:
    """Whether the velocities that closed contacts fix are linearly independent."""
    mask = _active_rows(layout, memory).reshape(-1)
    return jnp.all(RowBasis.of(jnp.where(mask[:, None], terms.B, 0.0)).is_new | ~mask)


def projected_speeds(layout: ContactLayout, terms: ContactTerms, memory: ContactMemory, u: Array) -> Array:
    """The nearest speeds (n,), in the metric of M, for which closed contacts do not move."""
    if not layout.names:
        return u + terms.shift
    mask = _active_rows(layout, memory).reshape(-1)
    B = jnp.where(mask[:, None], terms.B, 0.0)
    v = terms.v.reshape(-1) + terms.C @ terms.shift
    return u + terms.shift + terms.X @ RowBasis.of(B).least_norm(jnp.where(mask, -v, 0.0))


def without_gaps(terms: ContactTerms, closed: Array, q: Array) -> Array:
    """The nearest coordinates (n_q,) at which the gaps of `closed` contacts (c,) vanish, to the first order.

    The displacement is that of virtual speeds, so it satisfies the velocity constraints.
    """
    rows = jnp.where(closed[:, None], terms.B.reshape(*terms.v.shape, -1)[:, 0], 0.0)
    return q + terms.Q @ (terms.X @ RowBasis.of(rows).least_norm(jnp.where(closed, -terms.gaps, 0.0)))


@ScalarFunction
def forces_in_contact(
    system: System, t: Component, q: Array, u: Array, memory: Array | None, values: InputValues
) -> tuple[Array, ContactForces, ContactTerms]:
    """The projected speeds (n,), and the contact forces, accelerations and terms at these speeds. The right-hand side,
    the event functions and the outputs contain this program, so that it is traced once."""
    layout = layout_of(system)
    states = ContactMemory.unpacked(layout, jnp.zeros(layout.memory_size, q.dtype) if memory is None else memory)
    free = KaneEquations(system, t, q, u, values)
    geometry = _Geometry(free, layout)
    u = projected_speeds(layout, geometry.terms(free, with_forces=False), states, u)
    terms = geometry.terms(KaneEquations(system, t, q, u, values))
    return u, solve_forces(layout, terms, states), terms


@ScalarFunction
def terms_at(system: System, t: Component, q: Array, u: Array, values: InputValues) -> ContactTerms:
    """The terms of all contacts at speeds that are not projected."""
    kane = KaneEquations(system, t, q, u, values)
    return _Geometry(kane, layout_of(system)).terms(kane)


@ScalarFunction.compile_cheaply
def gap_sizes(system: System, t: Component, q: Array, u: Array) -> tuple[Array, Array]:
    """The gaps (c,) of all contacts and the sizes of their terms. Of a bearing 1."""
    layout = layout_of(system)

    def gaps(system: System, t: Component, q: Array, u: Array) -> Array:
        kane = KaneEquations(system, t, q, u)
        return as_vector(ContactRows(kane, layout).gaps(kane.t, kane.q, kane.u_all), q)

    return gaps(system, t, q, u), term_sizes(gaps, system, t, q, u)


PENETRATION = 3e-4
"""The largest penetration at the start that is removed, as a share of the size of the terms of the gap: published
starts have three or four digits."""


def gap_tolerances(sizes: Array) -> Array:
    """The largest gaps (c,) that are rounding errors, for gaps whose terms have these sizes (c,)."""
    return float(jnp.finfo(sizes.dtype).eps) ** 0.6 * sizes


def closed_contacts(system: System, t: Component, q: Numbers) -> Array:
    """Whether each contact (c,) touches or penetrates. True for each `DryFriction`, which always acts."""
    if not has_contacts(system):
        return jnp.zeros(0, bool)
    gaps, sizes = gap_sizes(system, t, q, jnp.zeros(len(system.speeds), q.dtype))
    return jnp.asarray(layout_of(system).is_bearing, bool) | ~(gaps > gap_tolerances(sizes))


def refuse_closed_contacts(system: System, closed: Array) -> None:
    """**Raises:** `ValueError` if any of the contacts (c,) is closed, for functions without contact forces."""
    if np.any(closed):
        names = ", ".join(np.array(layout_of(system).names)[np.asarray(closed)])
        raise ValueError(
            f"{type(system).__name__} has closed contacts here: {names}. Steady motions and linear models contain "
            "no contact forces and no dry friction. Simulate until the system is at rest, or replace a contact that "
            "remains closed by a constraint."
        )


def event_functions(
    layout: ContactLayout, terms: ContactTerms, memory: ContactMemory, forces: Array
) -> tuple[Array, Array]:
    """Two functions of each contact (c,) that fall through zero when its state changes.

    - The gap of an open contact, the normal force of a closed one.
    - While a contact slides, the slip along its direction at the start. While it sticks, the distance of the friction
      from its limit.
    """
    closed, one = memory.states >= SLIDES, jnp.ones_like(terms.gaps)
    is_bearing = jnp.asarray(layout.is_bearing)
    normal = jnp.where(is_bearing, one, jnp.where(closed, forces[:, 0], terms.gaps))
    if not layout.d:
        return normal, one
    starts = memory.starts(layout, terms.tangents)
    slip = jnp.sum(terms.v[:, 1:] * starts, axis=1)
    if layout.d == 2:
        # A slip in space ends a tenth of the error of a step before zero. What remains is this error, and its direction
        # turns ever faster (9000 steps instead of 350). A slip that begins without an acceleration does not end.
        rates = terms.a + jnp.sum(terms.delassus * forces[None, None], axis=(2, 3))
        by_friction = jnp.sum(terms.mobility[:, 1:] * jnp.abs(forces[:, 1:]), axis=1)
        slows = jnp.sum(rates[:, 1:] * starts, axis=1) < -0.01 * by_friction
        slip = slip - jnp.where(slows, 0.1 * memory.slow[:, 1], 0.0)
    squares = jnp.sum(forces[:, 1:] ** 2, axis=1)  # the derivative of the length is zero at zero
    length = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)
    friction = jnp.abs(forces[:, 1]) if layout.d == 1 else length
    bound = jnp.where(is_bearing, terms.laws.static, terms.laws.static * forces[:, 0])
    has = jnp.asarray(layout.has_friction) & (terms.laws.static > 0)
    tangential = jnp.where(memory.states == STICKS, bound - friction, jnp.where(closed, slip, one))
    return normal, jnp.where(has, tangential, one)


def event_sizes(
    layout: ContactLayout, terms: ContactTerms, memory: ContactMemory, forces: Array, gap_sizes: Array
) -> tuple[Array, Array]:
    """The sizes of the terms of both `event_functions` of each contact (c,)."""
    closed, d = memory.states >= SLIDES, layout.d
    sizes = terms.a_size / jnp.where(terms.mobility > 0, terms.mobility, 1.0) + jnp.abs(forces)
    normal = jnp.where(jnp.asarray(layout.is_bearing), 0.0, jnp.where(closed, sizes[:, 0], gap_sizes))
    if not d:
        return normal, jnp.zeros_like(normal)
    tangential = jnp.where(memory.states == STICKS, jnp.sum(sizes[:, 1:], axis=1), jnp.sum(terms.size[:, 1:], axis=1))
    return normal, jnp.where(closed & jnp.asarray(layout.has_friction), tangential, 0.0)
