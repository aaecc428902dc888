"""Impacts of unilateral contacts with Coulomb friction. Pure functions of arrays, independent of systems.

A contact pushes but does not pull. Its normal velocity is v_N, positive if the bodies separate, and its slip velocity
is v_T. L_N and L_T are the impulses of the whole impact:

    0 <= L_N,  0 <= v_N+ + e v_N-,  one of them is zero        Newton's restitution with Moreau's complementarity
    |L_T| <= mu L_N;  L_T = -mu L_N v_T+ / |v_T+| while sliding     Coulomb's law
    v+ = v- + G L,  G = C M^-1 C^T                             the Delassus matrix of all rows

Every contact is open, slides or sticks after the impact. For given states and directions of the slip, these are linear
equations. In a plane, all combinations of states are tried, and the admissible one with the largest sum of states is
taken. In space, the directions are unknown. Gauss-Seidel sweeps project the impulse of each contact onto its friction
cone in turn. Newton's method for the same projections refines the result (Alart and Curnier 1991, "A mixed formulation
for frictional contact problems prone to Newton like solution methods"). In both cases the result must pass
`is_admissible`. Then the equations of these states are solved again and differentiated, so derivatives do not contain
the search.

References: Moreau (1988), "Unilateral contact and dry friction in finite freedom dynamics"; Glocker (2001), "Set-Valued
Force Laws", for impacts with several contacts.
"""

from __future__ import annotations

import functools
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._scalarjit.nan import constant
from ..._scalarjit.scalar_function import ScalarFunction
from ..scaling import RowBasis

OPEN, SLIDES, STICKS = 0, 1, 2


def most_contacts(have_friction: bool, in_space: bool) -> int:
    """The contact forces of a motion are part of a program of scalars, which would be too long for more contacts. In a
    plane with friction, all combinations of their states are tried."""
    return 6 if have_friction and not in_space else 8


class ContactImpact(NamedTuple):
    """The solution of a `ContactProblem`, for c contacts with one normal row and d tangential rows each.

    - `impulses` (c, 1 + d): NaN if no states are admissible [N s].
    - `velocities` (c, 1 + d): after the impact [m/s].
    - `states` (c,): 0 open, 1 slides, 2 sticks.
    - `determined` (): whether the states are admissible.
    """

    impulses: Float[Array, "c rows"]
    velocities: Float[Array, "c rows"]
    states: Float[Array, " c"]
    determined: Bool[Array, ""]


class Slip(NamedTuple):
    """Slip directions of c contacts before the problem is solved.

    - `is_known` (c,): whether a contact already slips. It cannot stick: it slides along `directions`, or opens.
    - `directions` (c, d): unit vectors of this slip.
    - `static` (c,): the coefficients of static friction. A sticking contact has |L_T| <= static L_N.
    - `may_stick` (c,): whether a contact may stick.
    """

    is_known: Array
    directions: Array
    static: Array
    may_stick: Array

    @classmethod
    def unknown(cls, friction: Array, d: int) -> Slip:
        no = jnp.zeros(friction.shape, bool)
        return cls(no, jnp.zeros((len(friction), d), friction.dtype), friction, ~no)


class Choice(NamedTuple):
    """The states of c contacts after an impact, and the data to solve their equations. r = 1 + d. Not differentiated.

    - `states` (c,): open, slides or sticks.
    - `ways` (c,): slip direction of each sliding contact: its sign in a plane, its angle in space [rad].
    - `start` (c r,): initial impulses. If the solution is not unique, the one nearest to them is used.
    - `inverse` (c r, c r): the pseudo-inverse of the equations.
    - `is_admissible` (): whether the solution satisfies all laws.
    """

    states: Array
    ways: Array
    start: Array
    inverse: Array
    is_admissible: Array

    @classmethod
    def none(cls, v: Array) -> Choice:
        """All contacts (c, r) are open. Not admissible."""
        c, n = len(v), v.size
        none = jnp.zeros(c, v.dtype)
        return cls(none, none, jnp.zeros(n, v.dtype), jnp.zeros((n, n), v.dtype), jnp.array(False))


class _Solution(NamedTuple):
    """The solution for one combination of states.

    - `impulses`, `velocities` (c, 1 + d): impulses, and velocities after the impact.
    - `size` (c, 1 + d): sum of the absolute terms of each velocity, the scale of its rounding error.
    - `inverse`: as in `Choice`.
    """

    impulses: Array
    velocities: Array
    size: Array
    inverse: Array


class ContactProblem(eqx.Module):
    """An impact with unilateral contacts.

    The same class computes contact forces between impacts. Then `v` contains accelerations; the unknowns are forces.

    - `G` (c, 1 + d, c, 1 + d): the Delassus matrix. A contact has a normal row and d tangential rows: 0 without
        friction, 1 in a plane, 2 in space.
    - `v` (c, 1 + d): velocities before the impact [m/s]. Normal velocities are positive if the bodies separate.
    - `restitution` (c,), `friction` (c,): coefficients.
    - `closed` (c,): whether a contact takes part. The others transmit no impulse.
    - `slip`: the directions of contacts that already slip.
    - `has_friction`: for each contact, whether its tangential rows exist. Other rows are zero.
    - `is_impact` (): False for accelerations and forces.
    """

    G: Float[Array, "c rows c rows"]
    v: Float[Array, "c rows"]
    restitution: Float[Array, " c"]
    friction: Float[Array, " c"]
    closed: Bool[Array, " c"]
    slip: Slip
    is_impact: Bool[Array, ""]
    has_friction: tuple[bool, ...] = eqx.field(static=True)

    @property
    def in_space(self) -> bool:
        return self.v.shape[1] == 3

    def choice(self) -> Choice:
        """The states that satisfy all laws. Not differentiated."""
        problem = constant(self)
        if self.in_space:
            return _searched(problem)
        d = self.v.shape[1] - 1
        states, signs = _combinations(tuple(d if each else 0 for each in self.has_friction))
        found = jax.vmap(functools.partial(_tried, problem))(*(jnp.asarray(x, self.v.dtype) for x in (states, signs)))
        k = jnp.argmax(found.is_admissible)  # the first one
        return jax.tree.map(lambda x: x[k], found)

    def solution(self, choice: Choice) -> ContactImpact:
        """The solution for these states, with derivatives up to the third order: two Newton steps at the solution."""
        ways = choice.ways
        if self.in_space:
            ways = jnp.where(self.slip.is_known, _angles(self.slip.directions), ways)
            for _ in range(2):
                ways = self._newton_step(choice, ways)
        found = self.solved(choice.states, ways, choice.start, choice.inverse)
        determined = choice.is_admissible & constant(self)._is_bounded(constant(found).velocities)
        impulses, velocities = (jnp.where(determined, x, jnp.nan) for x in (found.impulses, found.velocities))
        return ContactImpact(impulses, velocities, choice.states, determined)

    def _newton_step(self, choice: Choice, ways: Array) -> Array:
        """One step towards angles at which the slip has the assumed direction, n x v_T+ = 0."""
        slides = (choice.states == SLIDES) & ~self.slip.is_known

        def deviation(ways: Array) -> Array:
            v = self.solved(choice.states, ways, choice.start, choice.inverse).velocities
            return jnp.where(slides, jnp.cos(ways) * v[:, 2] - jnp.sin(ways) * v[:, 1], 0.0)

        # NumPy's unit matrix: the program of a `ScalarFunction` has constants only.
        unit = np.eye(len(ways), dtype=ways.dtype)
        columns = [jax.jvp(deviation, (ways,), (jnp.asarray(e),))[1] for e in unit]
        slope = jnp.stack(columns, axis=1) + jnp.where(slides, 0.0, 1.0).astype(ways.dtype)[:, None] * unit
        step = _written_out(jax.lax.stop_gradient(slope)) @ deviation(ways)
        # Where the equations are singular, a step may be long. The solution is known.
        return ways - jnp.clip(step, -1e-3, 1e-3)

    def solved(self, states: Array, ways: Array, start: Array, inverse: Array | None = None) -> _Solution:
        """The solution for given states and directions of the slip.

        L = W z with independent impulses z: all impulses of sticking contacts, the normal ones of sliding contacts.
        """
        c, rows = self.v.shape
        slides, sticks = (states == x for x in (SLIDES, STICKS))
        invert = _by_svd if self.in_space else _written_out
        if self.in_space:
            slips = jnp.stack([jnp.cos(ways), jnp.sin(ways)], axis=1)
        elif rows == 2:
            slips = jnp.where(self.slip.is_known[:, None], self.slip.directions, ways[:, None])
        else:
            slips = jnp.zeros((c, 0), self.v.dtype)
        active = jnp.concatenate([(slides | sticks)[:, None], jnp.repeat(sticks[:, None], rows - 1, axis=1)], axis=1)
        target = jnp.concatenate([-(1.0 + self.restitution)[:, None] * self.v[:, :1], -self.v[:, 1:]], axis=1)
        # W = 1, and L_T = -mu n L_N while sliding
        ratios = jnp.where(slides, -self.friction, 0.0)[:, None] * slips[:, : rows - 1]
        ratios = jnp.concatenate([jnp.zeros_like(self.friction)[:, None], ratios], axis=1)
        W = with_friction(ratios)
        G, mask = self.G.reshape(c * rows, c * rows), active.reshape(-1)
        # For the active rows:  G W z = v+ - v-
        A = jnp.where(mask[:, None] & mask[None], G @ W, 0.0)
        b, z = jnp.where(mask, target.reshape(-1), 0.0), jnp.where(mask, start, 0.0)
        if inverse is None:
            fixed = jax.lax.stop_gradient(A)
            inverse = invert(fixed)
            if c > 1 and rows > 1:
                limits = self.slip.static * (W @ (inverse @ jax.lax.stop_gradient(b))).reshape(c, rows)[:, 0]
                scales = jnp.where(self.is_impact, 1.0, force_scales(limits, sticks, rows))
                inverse = scales[:, None] * invert(fixed * scales[None])
        else:
            # If the solution is not unique, z - start = A^T y is the smallest one. Its part in the null space of A is
            # zero, but its derivative is not.
            y = inverse.T @ jax.lax.stop_gradient(inverse @ (b - A @ z))
            y = y + inverse.T @ (inverse @ (b - A @ (z + A.T @ y)))
            null = A.T @ y
            z = z + jnp.where(self.is_impact, null - inverse @ (A @ null), 0.0)
        for _ in range(3):  # the last two are the derivative of A z = b; the inverse is not differentiated
            z = z + inverse @ (b - A @ z)
        L = W @ z
        v, size = self.v.reshape(-1) + G @ L, jnp.abs(self.v.reshape(-1)) + jnp.abs(G) @ jnp.abs(L)
        L, v, size = (x.reshape(c, rows) for x in (L, v, size))
        return _Solution(L, v, size, inverse)

    def _is_bounded(self, v: Array) -> Array:
        """False for a solution (c, 1 + d) of singular equations. Its size hides every error."""
        before, change = (x**2 / jnp.where(self._mobility > 0, self._mobility, 1.0) for x in (self.v, v - self.v))
        return jnp.max(change) <= 1e12 * jnp.max(before)

    @property
    def _mobility(self) -> Array:
        """The diagonal (c, 1 + d) of G."""
        n = self.v.size
        return jnp.sum(self.G.reshape(n, n) * np.eye(n, dtype=self.v.dtype), axis=1).reshape(self.v.shape)

    def is_admissible(self, states: Array, ways: Array, solution: _Solution) -> Array:
        """Whether a solution satisfies all laws."""
        eps = float(jnp.finfo(self.v.dtype).eps)
        L, v, d = solution.impulses, solution.velocities, self.v.shape[1] - 1
        rounding, inconsistent = 1e3 * eps * solution.size, eps**0.5 * solution.size
        is_open, slides, sticks = (states == x for x in (OPEN, SLIDES, STICKS))
        rebound = v[:, 0] + self.restitution * self.v[:, 0]
        inertia = self._mobility[:, 0]
        # Impulses are compared as the changes of velocity that they cause.
        conditions = [L[:, 0] * inertia >= -rounding[:, 0], self.closed | is_open]
        conditions += [
            jnp.where(is_open, ~self.closed | (rebound >= -rounding[:, 0]), jnp.abs(rebound) <= inconsistent[:, 0])
        ]
        if d:
            force, slip = (jnp.sqrt(jnp.sum(x[:, 1:] ** 2, axis=1)) for x in (L, v))
            slack, limit = (jnp.max(x, axis=1) for x in (rounding, inconsistent))
            is_held = (slip <= limit) & ((force - self.slip.static * L[:, 0]) * inertia <= slack)
            if d == 1:
                is_opposite = ways * v[:, 1] >= -rounding[:, 1]
            else:
                # L_T . v_T = -|L_T| |v_T|, where L_T is more than a rounding error
                is_opposite = jnp.sum(L[:, 1:] * v[:, 1:], axis=1) + force * slip <= force * limit
                is_opposite |= force * inertia <= slack
            conditions += [~sticks | (is_held & self.slip.may_stick & ~self.slip.is_known)]
            conditions += [~slides | is_opposite | self.slip.is_known]
        return jnp.all(jnp.stack(conditions)) & self._is_bounded(v)  # not NaN


@functools.cache
def _combinations(n_tangential: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """States and signs of all combinations. Those with the largest sum of states are the first."""
    choices = {0: [(SLIDES, 0), (OPEN, 0)], 1: [(STICKS, 0), (SLIDES, 1), (SLIDES, -1), (OPEN, 0)]}
    table = [*itertools.product(*(choices[d] for d in n_tangential))]
    table.sort(key=lambda contacts: -sum(state for state, _ in contacts))
    numbers = np.array(table).reshape(len(table), len(n_tangential), 2)
    return numbers[..., 0], numbers[..., 1]


@ScalarFunction
def _tried(problem: ContactProblem, states: Array, signs: Array) -> Choice:
    start = jnp.zeros(problem.v.size, problem.v.dtype)
    found = problem.solved(states, signs, start)
    return Choice(states, signs, start, found.inverse, problem.is_admissible(states, signs, found))


_SWEEPS, _ATTEMPTS, _NEWTON_STEPS, _TURNS = 15, 4, 30, 8


def _searched(problem: ContactProblem) -> Choice:
    """The states in space by an iteration for all laws together; with more sweeps if they are not admissible.

    It begins where all contacts stick, and remains there if that is a solution. Rows are divided by the square root of
    the mobility of their contact: then one is a good step of the projections, whatever the units are.
    """
    (c, r), dtype = problem.v.shape, problem.v.dtype
    eps, is_known = float(jnp.finfo(dtype).eps), problem.slip.is_known
    mobility = jnp.einsum("iaia->i", problem.G)
    moves = problem.closed & (mobility > 0)
    scales = jnp.where(moves, 1.0 / jnp.sqrt(jnp.where(moves, mobility, 1.0)), 0.0)
    v = scales[:, None] * problem.v.at[:, 0].multiply(1.0 + problem.restitution)
    unit = jnp.max(jnp.abs(v))
    unit, scales = jnp.where(unit > 0, unit, 1.0), jnp.repeat(scales, r)
    v, G = v.reshape(-1) / unit, scales[:, None] * problem.G.reshape(c * r, c * r) * scales[None]

    def before_projection(L: Array) -> Array:
        return (L - (v + G @ L)).reshape(c, r)

    def projected(L: Array, friction: Array) -> Array:
        """Each impulse, changed against its velocity, on its friction cone. A solution does not change."""
        z = before_projection(L)
        normal = jnp.where(moves, jnp.maximum(z[:, 0], 0.0), 0.0)
        limit, squares = friction * normal, jnp.sum(z[:, 1:] ** 2, axis=1)
        exceeds = squares > limit**2
        share = jnp.where(exceeds, limit / jnp.sqrt(jnp.where(exceeds, squares, 1.0)), 1.0)[:, None]
        tangential = jnp.where(is_known[:, None], -limit[:, None] * problem.slip.directions, share * z[:, 1:])
        return jnp.concatenate([normal[:, None], tangential], axis=1).reshape(-1)

    def by_newton(L: Array, friction: Array) -> Array:
        def residual(L: Array) -> Array:
            return L - projected(L, friction)

        def step(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            k, L, F = carry
            change, lengths = -_by_svd(jax.jacfwd(residual)(L)) @ F, jnp.asarray(0.5 ** np.arange(12), dtype)
            each = jax.vmap(residual)(L[None] + lengths[:, None] * change[None])
            norms = jnp.linalg.norm(each, axis=1)
            falls = norms < (1.0 - 1e-4 * lengths) * jnp.linalg.norm(F)
            i = jnp.where(jnp.any(falls), jnp.argmax(falls), jnp.argmin(norms))
            return k + 1, L + lengths[i] * change, each[i]

        def goes_on(carry: tuple[Array, Array, Array]) -> Array:
            k, L, F = carry
            return (k < _NEWTON_STEPS) & (jnp.max(jnp.abs(F)) > 16 * eps * jnp.maximum(jnp.max(jnp.abs(L)), 1.0))

        return jax.lax.while_loop(goes_on, step, (jnp.array(0), L, residual(L)))[1]

    def at(L: Array, friction: Array, slack: Array, share: Array) -> Choice:
        """The states at a solution: closed rather than open within the `slack`. `share`: of L at the start."""
        z, can_stick = before_projection(L), np.array(problem.has_friction) & problem.slip.may_stick & ~is_known
        pushes = moves & (z[:, 0] >= -slack)
        size = jnp.sqrt(jnp.sum(z[:, 1:] ** 2, axis=1))
        sticks = pushes & can_stick & (size <= friction * z[:, 0] + slack)
        states = jnp.where(sticks, STICKS, jnp.where(pushes, SLIDES, OPEN)).astype(dtype)
        ways = jnp.where(is_known, _angles(problem.slip.directions), _angles(-z[:, 1:]))
        start = share * unit * scales * L

        def along(ways: Array) -> tuple[Choice, Array]:
            """The choice for these angles, and the angles of its velocities."""
            found = problem.solved(states, ways, start)
            moves = jnp.linalg.norm(found.velocities[:, 1:], axis=1) > eps**0.5 * jnp.max(found.size, axis=1)
            after = jnp.where(moves & ~is_known, _angles(found.velocities[:, 1:]), ways)
            return Choice(states, ways, start, found.inverse, problem.is_admissible(states, ways, found)), after

        # If the impulses are not unique, the smallest ones turn the slip. They are preferred to those at which Newton
        # ends, since they have a derivative.
        def goes_on(carry: tuple[Array, tuple[Choice, Array]]) -> Array:
            return (carry[0] < _TURNS) & (share == 0) & ~carry[1][0].is_admissible

        return jax.lax.while_loop(goes_on, lambda x: (x[0] + 1, along(x[1][1])), (jnp.array(0), along(ways)))[1][0]

    def attempt(carry: tuple[Array, Array, Array, Choice]) -> tuple[Array, Array, Array, Choice]:
        k, L, friction, _ = carry
        L = jnp.where(k == 1, 0.0, L)  # once without the sticking state

        def swept(i: Array, L: Array) -> Array:
            return jnp.where(jnp.repeat(jnp.arange(c) == (i // 3) % c, r), projected(L, friction), L)

        L = by_newton(jax.lax.fori_loop(0, 3 * c * _SWEEPS * 4**k, swept, L), friction)
        options = (jnp.asarray(x, dtype) for x in ([eps**0.6, eps**0.6, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]))
        found = jax.vmap(functools.partial(at, L, friction))(*options)
        choice = jax.tree.map(lambda x: x[jnp.argmax(found.is_admissible)], found)
        return k + 1, L, jnp.where(choice.states == SLIDES, problem.friction, limits), choice

    def goes_on(carry: tuple[Array, Array, Array, Choice]) -> Array:
        return (carry[0] < _ATTEMPTS) & ~carry[3].is_admissible

    # A contact slips where its static friction is not enough, and slides with the kinetic one.
    limits = jnp.where(problem.slip.may_stick & ~is_known, problem.slip.static, problem.friction)
    return jax.lax.while_loop(goes_on, attempt, (jnp.array(0), -_by_svd(G) @ v, limits, Choice.none(problem.v)))[3]


def with_friction(ratios: Array) -> Array:
    """W (c r, c r) of L = W z. `ratios` (c, r): of each impulse to the normal impulse z_N of its contact, for friction
    that is proportional to it; zero for other rows."""
    c, r = ratios.shape
    # NumPy's unit matrices: the program of a `ScalarFunction` has constants only.
    blocks = np.eye(r, dtype=ratios.dtype)[None] + ratios[:, :, None] * np.eye(r, dtype=ratios.dtype)[None, :1]
    W = np.eye(c, dtype=ratios.dtype)[:, None, :, None] * blocks[:, :, None, :]
    return jnp.asarray(W).reshape(c * r, c * r)


def force_scales(limits: Array, sticks: Array, rows: int) -> Array:
    """Scales (c rows,) of the forces of c contacts, in which the smallest forces are chosen if they are not unique.

    Those of friction are proportional to their `limits` (c,). Otherwise one corner of a block would reach its limit
    before the other one, which carries more weight, and neither of them could slip.
    """
    largest = jnp.max(jnp.where(sticks, limits, 0.0))
    # The smallest sum of F^2 / scale^2 has F proportional to scale^2.
    shares = jnp.clip(limits / jnp.where(largest > 0, largest, 1.0), 1e-8, 1.0)
    scales = jnp.where(sticks & (largest > 0), jnp.sqrt(shares), 1.0)[:, None]
    return jnp.concatenate([jnp.ones_like(scales), jnp.repeat(scales, rows - 1, axis=1)], axis=1).reshape(-1)


def _angles(directions: Array) -> Array:
    x, y = directions[:, 0], directions[:, 1]
    is_zero = (x == 0) & (y == 0)
    return jnp.arctan2(jnp.where(is_zero, 0.0, y), jnp.where(is_zero, 1.0, x))


def _written_out(A: Array) -> Array:
    """P, for which P b is the smallest solution x of A x = b. It can be part of a program of scalars."""
    return RowBasis.of(A).least_norm(jnp.asarray(np.eye(len(A), dtype=A.dtype)))


def _by_svd(A: Array) -> Array:
    """The same for any size."""
    return jnp.linalg.pinv(A, rtol=float(jnp.finfo(A.dtype).eps) ** 0.75)
