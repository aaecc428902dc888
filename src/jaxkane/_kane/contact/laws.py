"""Impacts of unilateral contacts with Coulomb friction. Pure functions of arrays, independent of systems.

A contact pushes but does not pull. Its normal velocity is v_N, positive if the bodies separate, and its slip velocity
is v_T. L_N and L_T are the impulses of the whole impact:

    0 <= L_N,  0 <= v_N+ + e v_N-,  one of them is zero        Newton's restitution with Moreau's complementarity
    |L_T| <= mu L_N;  L_T = -mu L_N v_T+ / |v_T+| while sliding     Coulomb's law
    v+ = v- + G L,  G = C M^-1 C^T                             the Delassus matrix of all rows

Every contact is open, slides or sticks after the impact. For at most four contacts, all combinations of these states
are linear systems, which are solved at once. The first admissible combination is taken. Its system is then solved
again and differentiated, so derivatives do not contain the other combinations.

References: Moreau (1988), "Unilateral contact and dry friction in finite freedom dynamics"; Glocker (2001), "Set-Valued
Force Laws", for impacts with several contacts.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._common.lookup import refuse_if

MOST_CONTACTS = 4
"""More contacts have too many combinations of states: four contacts in a plane have 256."""

OPEN, SLIDES, STICKS = 0, 1, 2

_NEWTON_STEPS, _ANGLES = 20, 32


class ContactImpact(NamedTuple):
    """The result of `contact_impact`, for c contacts with one normal row and d tangential rows each.

    - `impulses` (c, 1 + d): NaN if no combination of states is admissible [N s].
    - `velocities` (c, 1 + d): after the impact [m/s].
    - `states` (c,): 0 open, 1 slides, 2 sticks.
    - `determined` (): whether a combination is admissible.
    - `unique` (): whether the velocities and impulses are unique. If a sticking row depends linearly on others, the
        impulses have the smallest norm.
    """

    impulses: Float[Array, "c rows"]
    velocities: Float[Array, "c rows"]
    states: Int[Array, " c"]
    determined: Bool[Array, ""]
    unique: Bool[Array, ""]


def contact_impact(
    G: Float[Array, "c rows c rows"],
    v: Float[Array, "c rows"],
    restitution: Float[Array, " c"],
    friction: Float[Array, " c"],
    closed: Bool[Array, " c"],
    has_friction: Sequence[bool] | None = None,
    slip: Slip | None = None,
) -> ContactImpact:
    """The impulses of an impact with up to four unilateral contacts.

    With accelerations instead of velocities and forces instead of impulses, these are the contact forces of a motion
    without an impact. Then the direction of the friction of contacts that already slip is known: `slip`.

    **Arguments:**

    - `G` (c, 1 + d, c, 1 + d): the Delassus matrix. A contact has a normal row and d tangential rows: 0 without
        friction, 1 in a plane, 2 in space.
    - `v` (c, 1 + d): velocities before the impact [m/s]. Normal velocities are positive if the bodies separate.
    - `restitution` (c,): coefficients of restitution.
    - `friction` (c,): coefficients of friction.
    - `closed` (c,): whether a contact takes part. The others transmit no impulse.
    - `has_friction`: for each contact, whether its tangential rows exist. By default, all exist. Other rows are zero.
    - `slip`: what is known about the slip. By default nothing.

    **Raises:** `ValueError` for more than four contacts.
    """
    c, d = v.shape[0], v.shape[1] - 1
    refuse_if(
        c > MOST_CONTACTS,
        f"An impact has at most {MOST_CONTACTS} contacts, got {c}. Use MuJoCo for systems with many contacts.",
    )
    rows = tuple(d if each else 0 for each in has_friction or (True,) * c)
    states, signs = _combinations(rows)
    each = _Combination(jnp.asarray(states), jnp.asarray(signs, G.dtype))
    is_impact = slip is None
    if slip is None:
        no = jnp.zeros(friction.shape, bool)
        slip = Slip(no, jnp.zeros((c, d), friction.dtype), friction, ~no)
    problem = _Problem(G, v, restitution, friction, slip, is_impact)
    fixed = jax.tree.map(jax.lax.stop_gradient, problem)
    found = jax.vmap(fixed.solved)(each)
    takes_part = jnp.all(closed[None] | (each.states == OPEN), axis=1)
    takes_part &= jnp.all(slip.may_stick[None] | (each.states != STICKS), axis=1)
    if d:
        # A contact that already slips has one sliding combination.
        is_repeated = (each.signs < 0) if d == 1 else jnp.zeros_like(each.states, bool)
        takes_part &= ~jnp.any(slip.is_known[None] & (is_repeated | (each.states == STICKS)), axis=1)
    is_admissible = takes_part & jax.vmap(fixed.is_admissible, (0, 0, None))(each, found, closed)
    k = jnp.argmax(is_admissible)  # the first one
    chosen, first = jax.tree.map(lambda x: x[k], (each, found))
    solution = problem.differentiable(chosen, first)
    differs = jnp.abs(found.velocities - first.velocities[None]) > 1e-6 * first.size[None]
    is_only = ~jnp.any(is_admissible & jnp.any(differs, axis=(1, 2)))
    impulses, velocities = (jnp.where(is_admissible[k], x, jnp.nan) for x in (solution.impulses, solution.velocities))
    return ContactImpact(impulses, velocities, chosen.states, is_admissible[k], first.is_regular & is_only)


class Slip(NamedTuple):
    """What is known about the slip of c contacts.

    - `is_known` (c,): whether a contact already slips, so that it slides in this direction or opens.
    - `directions` (c, d): unit vectors of this slip.
    - `static` (c,): the coefficients of static friction. A sticking contact has |L_T| <= static L_N.
    - `may_stick` (c,): whether a contact may stick.
    """

    is_known: Array
    directions: Array
    static: Array
    may_stick: Array


class _Combination(NamedTuple):
    """The states of all contacts after an impact.

    - `states` (c,): open, slides or sticks.
    - `signs` (c,): of the slip of sliding contacts with one tangential row. 0 for other contacts.
    """

    states: Array
    signs: Array


@functools.cache
def _combinations(n_tangential: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """States and signs of all combinations. Those with the most sticking and closed contacts are the first."""
    choices = {
        0: [(SLIDES, 0), (OPEN, 0)],
        1: [(STICKS, 0), (SLIDES, 1), (SLIDES, -1), (OPEN, 0)],
        2: [(STICKS, 0), (SLIDES, 0), (OPEN, 0)],
    }
    table = [*itertools.product(*(choices[d] for d in n_tangential))]
    table.sort(key=lambda contacts: -sum(state for state, _ in contacts))
    numbers = np.array(table).reshape(len(table), len(n_tangential), 2)
    return numbers[..., 0], numbers[..., 1]


class _Solution(NamedTuple):
    """The solution for one combination of states.

    - `impulses`, `velocities` (c, 1 + d): impulses, and velocities after the impact.
    - `size` (c, 1 + d): the size of the terms of each velocity.
    - `angles` (c,): directions of the slip in space [rad].
    - `inverse` (K, K): the pseudo-inverse of the linear system.
    - `is_regular`: whether the active rows are linearly independent.
    """

    impulses: Array
    velocities: Array
    size: Array
    angles: Array
    inverse: Array
    is_regular: Array


class _Problem(eqx.Module):
    G: Array
    v: Array
    restitution: Array
    friction: Array
    slip: Slip
    is_impact: bool = eqx.field(static=True)

    @property
    def in_space(self) -> bool:
        return self.v.shape[1] == 3

    def solved(self, combination: _Combination) -> _Solution:
        angles = jnp.zeros_like(self.friction)
        if self.in_space:
            start = self._solution(combination, angles, friction=jnp.zeros_like(self.friction)).velocities
            angles = _angle(start[:, 1], start[:, 2])
            known = _angle(self.slip.directions[:, 0], self.slip.directions[:, 1])
            angles = jnp.where(self.slip.is_known, known, angles)
            for _ in range(1 if len(angles) == 1 else 2):
                angles = jax.lax.fori_loop(0, len(angles), lambda i, x: self._best_angle(combination, x, i), angles)
            angles = jax.lax.fori_loop(0, _NEWTON_STEPS, lambda _, x: self._newton_step(combination, x), angles)
        return self._solution(combination, angles)

    def _best_angle(self, combination: _Combination, angles: Array, i: Array) -> Array:
        """The angles, with the one of contact i for which the slip is nearest to its assumed direction.

        Without this search, Newton's method finds no solution for 5 of 100 random impacts in space.
        """
        grid = jnp.asarray(np.arange(_ANGLES) * (2 * np.pi / _ANGLES), angles.dtype)
        each = jax.vmap(angles.at[i].set)(grid)
        found = jax.vmap(self._solution, (None, 0))(combination, each)
        v, L = found.velocities[:, i], found.impulses[:, i]
        slip = jnp.sqrt(v[:, 1] ** 2 + v[:, 2] ** 2)
        slip = jnp.where(slip > 0, slip, 1.0)
        sine = (jnp.cos(grid) * v[:, 2] - jnp.sin(grid) * v[:, 1]) / slip
        cosine = (jnp.cos(grid) * v[:, 1] + jnp.sin(grid) * v[:, 2]) / slip
        # The deviation changes its sign between this angle and the next one, which both have admissible impulses.
        is_before = (L[:, 0] >= 0) & (cosine >= 0)
        is_before = is_before & jnp.roll(is_before, -1) & (sine * jnp.roll(sine, -1) <= 0)
        best = each[jnp.argmax(cosine + jnp.where(L[:, 0] >= 0, 2.0, 0.0) + jnp.where(is_before, 4.0, 0.0))]
        return jnp.where(self.slip.is_known[i], angles, best)

    def differentiable(self, combination: _Combination, known: _Solution) -> _Solution:
        """The same with derivatives up to the third order, from two Newton steps at the known solution."""
        angles = known.angles
        if self.in_space:
            own = _angle(self.slip.directions[:, 0], self.slip.directions[:, 1])
            angles = jnp.where(self.slip.is_known, own, angles)
        for _ in range(2 if self.in_space else 0):
            angles = self._newton_step(combination, angles)
        return self._solution(combination, angles, inverse=known.inverse)

    def _newton_step(self, combination: _Combination, angles: Array) -> Array:
        """One step towards angles at which the slip has the assumed direction, n x v_T+ = 0."""
        slides = (combination.states == SLIDES) & ~self.slip.is_known

        def deviation(angles: Array) -> Array:
            v = self._solution(combination, angles).velocities
            return jnp.where(slides, jnp.cos(angles) * v[:, 2] - jnp.sin(angles) * v[:, 1], 0.0)

        slope = jax.jacfwd(deviation)(angles) + jnp.diag(jnp.where(slides, 0.0, 1.0).astype(angles.dtype))
        step = _pseudo_inverse(jax.lax.stop_gradient(slope))[0] @ deviation(angles)
        return angles - jnp.clip(step, -0.5, 0.5)

    def _solution(
        self,
        combination: _Combination,
        angles: Array,
        friction: Array | None = None,
        inverse: Array | None = None,
    ) -> _Solution:
        """The solution for given directions of the slip.

        L = W z with independent impulses z: all impulses of sticking contacts, the normal ones of sliding contacts.
        """
        c, rows = self.v.shape
        friction = self.friction if friction is None else friction
        slides, sticks = (combination.states == x for x in (SLIDES, STICKS))
        if self.in_space:
            slips = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        elif rows == 2:
            slips = jnp.where(self.slip.is_known[:, None], self.slip.directions, combination.signs[:, None])
        else:
            slips = jnp.zeros((c, 0), self.v.dtype)
        active = jnp.concatenate([(slides | sticks)[:, None], jnp.repeat(sticks[:, None], rows - 1, axis=1)], axis=1)
        target = jnp.concatenate([-(1.0 + self.restitution)[:, None] * self.v[:, :1], -self.v[:, 1:]], axis=1)
        # W = 1, and L_T = -mu n L_N while sliding
        ratios = jnp.where(slides, -friction, 0.0)[:, None] * slips[:, : rows - 1]
        ratios = jnp.concatenate([jnp.zeros_like(friction)[:, None], ratios], axis=1)
        W = with_friction(ratios)
        G, mask = self.G.reshape(c * rows, c * rows), active.reshape(-1)
        # For the active rows:  G W z = v+ - v-
        A = jnp.where(mask[:, None] & mask[None], G @ W, 0.0)
        b, is_regular = jnp.where(mask, target.reshape(-1), 0.0), jnp.ones((), bool)
        if inverse is None:
            fixed = jax.lax.stop_gradient(A)
            inverse, is_new = _pseudo_inverse(fixed)
            is_regular = jnp.all(is_new | ~mask)
            if c > 1 and rows > 1 and not self.is_impact:
                limits = self.slip.static * (W @ (inverse @ jax.lax.stop_gradient(b))).reshape(c, rows)[:, 0]
                scales = force_scales(limits, sticks, rows)
                inverse = scales[:, None] * _pseudo_inverse(fixed * scales[None])[0]
        z = inverse @ b
        for _ in range(2):  # the derivative of A z = b; the inverse is not differentiated
            z = z + inverse @ (b - A @ z)
        L = W @ z
        v, size = self.v.reshape(-1) + G @ L, jnp.abs(self.v.reshape(-1)) + jnp.abs(G) @ jnp.abs(L)
        L, v, size = (x.reshape(c, rows) for x in (L, v, size))
        return _Solution(L, v, size, angles, inverse, is_regular)

    def is_admissible(self, combination: _Combination, solution: _Solution, closed: Array) -> Array:
        eps = float(jnp.finfo(self.v.dtype).eps)
        L, v, d = solution.impulses, solution.velocities, self.v.shape[1] - 1
        rounding, inconsistent = 1e3 * eps * solution.size, eps**0.5 * solution.size
        is_open, slides, sticks = (combination.states == x for x in (OPEN, SLIDES, STICKS))
        rebound = v[:, 0] + self.restitution * self.v[:, 0]
        inertia = jnp.stack([self.G[i, 0, i, 0] for i in range(len(v))])
        # Impulses are compared as the changes of velocity that they cause.
        conditions = [L[:, 0] * inertia >= -rounding[:, 0]]
        conditions += [
            jnp.where(is_open, ~closed | (rebound >= -rounding[:, 0]), jnp.abs(rebound) <= inconsistent[:, 0])
        ]
        if d:
            force, slip = (jnp.sqrt(jnp.sum(x[:, 1:] ** 2, axis=1)) for x in (L, v))
            slack, limit = (jnp.max(x, axis=1) for x in (rounding, inconsistent))
            is_held = (slip <= limit) & ((force - self.slip.static * L[:, 0]) * inertia <= slack)
            if d == 1:
                is_opposite = combination.signs * v[:, 1] >= -rounding[:, 1]
            else:
                # L_T . v_T = -|L_T| |v_T|
                is_opposite = jnp.sum(L[:, 1:] * v[:, 1:], axis=1) + force * slip <= force * limit
            conditions += [~sticks | is_held, ~slides | is_opposite | self.slip.is_known]
        return jnp.all(jnp.stack(conditions)) & jnp.all(jnp.isfinite(v))


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


def _angle(x: Array, y: Array) -> Array:
    is_zero = (x == 0) & (y == 0)
    return jnp.arctan2(jnp.where(is_zero, 0.0, y), jnp.where(is_zero, 1.0, x))


def _pseudo_inverse(A: Array) -> tuple[Array, Array]:
    """P (K, K), for which P b is the smallest solution x of A x = b, and which rows of A (K,) are used.

    As `least_change` for all unit vectors b. A loop, because XLA needs 5 s to compile all combinations of states
    without one.
    """
    threshold = float(jnp.finfo(A.dtype).eps) ** 0.75

    def with_row(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        Q, Y, is_new = carry
        rest, value = A[i], jnp.eye(len(A), dtype=A.dtype)[i]
        for _ in range(2):
            along = Q @ rest
            rest, value = rest - along @ Q, value - along @ Y
        is_used = jnp.max(jnp.abs(rest)) > threshold * jnp.max(jnp.abs(A[i]))
        norm = jnp.sqrt(jnp.sum(jnp.where(is_used, rest, 1.0) ** 2))
        Q, Y = (x.at[i].set(jnp.where(is_used, row / norm, 0.0)) for x, row in ((Q, rest), (Y, value)))
        return Q, Y, is_new.at[i].set(is_used)

    start = jnp.zeros_like(A), jnp.zeros_like(A), jnp.zeros(len(A), bool)
    Q, Y, is_new = jax.lax.fori_loop(0, len(A), with_row, start)
    return Q.T @ Y, is_new
