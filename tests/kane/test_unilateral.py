"""Impacts of unilateral contacts: published and exact impulses, closed forms, and the contact laws themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import SliderInGuides
from scipy.integrate import solve_ivp

import jaxkane as jk
from jaxkane._kane.contact.laws import OPEN, SLIDES, STICKS, Slip, contact_impact
from jaxkane._kane.right_hand_side import outputs_in_contact
from jaxkane._system.system import packed
from jaxkane.catalog import RockingBlock

RTOL = 1e-12
compiled = jax.jit(contact_impact)


def strike(M, C, u, e, mu, closed=None):
    """The speeds after an impact and the result, for C (c, rows, n). All contacts have the same e and mu."""
    M, C, u = (jnp.asarray(x, float) for x in (M, C, u))
    c, rows, n = C.shape
    Y = jnp.linalg.solve(M, C.reshape(-1, n).T)
    G = (C.reshape(-1, n) @ Y).reshape(c, rows, c, rows)
    closed = jnp.ones(c, bool) if closed is None else jnp.asarray(closed)
    result = compiled(G, C @ u, jnp.full(c, e), jnp.full(c, mu), closed)
    return u + Y @ result.impulses.reshape(-1), result


@pytest.mark.slow
def test_ten_bounces_of_a_ball_with_spin_and_drag():
    # m = 0.15, r = 0.1, I = 2/5 m r^2, e = 0.85, mu = 0.12, drag 0.02 |v| v; 40 digits, here to those of DOP853
    m, r, c = 0.15, 0.1, 0.02

    def rates(t, y):
        drag = c / m * np.hypot(y[2], y[3])
        return [y[2], y[3], -drag * y[2], -9.81 - drag * y[3]]

    def gap(t, y):
        return y[1] - r

    gap.terminal, gap.direction = True, -1
    y, w = np.array([0.0, 1.2, 2.0, 0.0]), 30.0
    normal = [1.1887059096699417, 0.9278632515674384, 0.7484259579203826, 0.6144185061346573, 0.5099882203998913]
    tangential = [-0.142644709160393, -0.05128041211663547, 0.001005614329657916, 0.0006331188678131941]
    tangential += [0.00041852217150371883]
    for i in range(5):
        y = solve_ivp(rates, (0, 2), y, method="DOP853", rtol=1e-13, atol=1e-14, events=gap).y_events[0][0]
        # v_N = y_dot, slip = x_dot + r w
        u, result = strike(np.diag([m, m, 0.4 * m * r**2]), [[[0.0, 1.0, 0.0], [1.0, 0.0, r]]], [*y[2:], w], 0.85, 0.12)
        np.testing.assert_allclose(result.impulses, [[normal[i], tangential[i]]], rtol=0, atol=1e-11)
        assert result.states[0] == (SLIDES if i == 0 else STICKS)
        assert result.determined
        assert result.unique
        y, w = np.array([y[0], r + 1e-15, *u[:2]]), u[2]


def block(b, h):
    """The mass matrix and the normal and tangential velocities of the left and the right corner."""
    M = np.diag([1.0, 1.0, (b**2 + h**2) / 3])
    return M, [[[0.0, 1.0, -b], [1.0, 0.0, h]], [[0.0, 1.0, b], [1.0, 0.0, h]]]


def test_impacts_of_a_rocking_block_agree_with_housner():
    # Housner: the ratio of the rates is 1 - 3/2 sin^2(alpha) = 0.85
    b, h = 0.2, 0.6
    rates = [1.064938523307031, -0.9051977448109763, 0.7694180830893298, -0.6540053706259303]
    for i, (rate, impulse) in enumerate(zip(rates, [0.39402725362360147, 0.33492316558006124, 0.284684690743052])):
        corner = -np.sign(rate) * b  # the block turns about the right corner, then about the left one
        u, result = strike(*block(b, h), [-rate * h, rate * corner, rate], 0.0, 2.0)
        np.testing.assert_allclose(u[2], -rates[i + 1], rtol=RTOL)
        closing = i % 2
        np.testing.assert_allclose(result.impulses[closing, 0], impulse, rtol=RTOL)
        np.testing.assert_allclose(result.impulses[1 - closing], 0.0, atol=RTOL)
        assert result.states.tolist() == [OPEN, STICKS] if closing else [STICKS, OPEN]


def test_both_corners_of_a_wide_block_stick():
    # The Delassus matrix is singular. Normal impulses are unique, tangential ones are those of smallest norm.
    u, result = strike(*block(0.6, 0.3), [0.3, -0.6, -1.0], 0.0, 2.0)
    np.testing.assert_allclose(u, 0.0, atol=RTOL)
    np.testing.assert_allclose(result.impulses, [[0.1, -0.15], [0.5, -0.15]], atol=RTOL)
    assert result.states.tolist() == [STICKS, STICKS]
    assert not result.unique


POINTS = np.eye(4), [[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]]
"""The mass matrix and the normal and tangential velocities of two independent points of 1 kg."""


def test_one_point_stops_in_an_impact_and_the_other_slides_on():
    """Both have the normal impulse 1. The first one needs the impulse 0.2 of friction to stop, the other one 2."""
    u, result = strike(*POINTS, [-1.0, 0.2, -1.0, 2.0], 0.0, 0.5)
    np.testing.assert_allclose(u, [0.0, 0.0, 0.0, 1.5], atol=RTOL)
    np.testing.assert_allclose(result.impulses, [[1.0, -0.2], [1.0, -0.5]], atol=RTOL)
    assert result.states.tolist() == [STICKS, SLIDES]


def contact_forces(M, C, f, mu, static, slips=(0.0, 0.0)):
    """The forces and accelerations of two contacts for the applied forces f. `slips`: signs, 0 for a contact at rest.

    The equations are those of an impact, with accelerations instead of velocities.
    """
    C, slips = jnp.asarray(C), jnp.asarray(slips)
    Y = jnp.linalg.solve(M, C.reshape(4, -1).T)
    G, a = (C.reshape(4, -1) @ Y).reshape(2, 2, 2, 2), C @ jnp.linalg.solve(M, jnp.asarray(f))
    both = jnp.ones(2, bool)
    slip = Slip(slips != 0, slips[:, None], jnp.broadcast_to(jnp.asarray(static, float), (2,)), both)
    return compiled(G, a, jnp.zeros(2), jnp.full(2, mu), both, slip=slip)


def test_friction_of_two_corners_is_proportional_to_their_limits():
    """A block at rest is pushed at its mass centre. Moments about it: (N_right - N_left) b = F h."""
    b, h, weight, push, static = 0.6, 0.3, 10.0, 2.0, np.array([0.5, 0.8])
    result = contact_forces(*block(b, h), [push, -weight, 0.0], 0.5, static)
    normal = 0.5 * (weight + np.array([-1.0, 1.0]) * push * h / b)
    limits = static * normal
    np.testing.assert_allclose(result.impulses, np.stack([normal, -push * limits / limits.sum()], axis=1), rtol=RTOL)
    assert result.states.tolist() == [STICKS, STICKS]


class PushedBlock(RockingBlock):
    """A horizontal force acts on its mass centre."""

    inputs = ("push",)

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        return jk.weight(motion, -self.gravity * N.y), jk.Force(inputs["push"] * N.x, motion["block"])


def test_friction_of_both_corners_of_a_block_system_is_proportional_to_their_limits():
    """The same in the equations of motion of a system, whose corners have the same coefficient of friction."""
    b, h, weight, push = 0.2, 0.6, 9.81, 1.0
    state = jk.State(jnp.array([0.0, h, 0.0]), jnp.zeros(3), None, jnp.array([STICKS, 0.0, STICKS, 0.0]))
    outputs = outputs_in_contact(PushedBlock(friction=0.5), jnp.zeros(()), packed(state), {"push": jnp.array(push)})[1]
    for name, side in (("left", -1.0), ("right", 1.0)):
        normal = 0.5 * (weight + side * push * h / b)
        np.testing.assert_allclose(outputs[f"{name}.normal"], normal, rtol=RTOL)
        np.testing.assert_allclose(outputs[f"{name}.friction"], -push * normal / weight, rtol=RTOL)


def test_a_contact_sticks_up_to_its_static_friction():
    """Forces of 4 N and 6 N. Kinetic friction 3 N, static friction 5 N."""
    result = contact_forces(*POINTS, [-10.0, 4.0, -10.0, 6.0], 0.3, 0.5)
    np.testing.assert_allclose(result.impulses, [[10.0, -4.0], [10.0, -3.0]], rtol=RTOL)
    np.testing.assert_allclose(result.velocities, [[0.0, 0.0], [0.0, 3.0]], atol=RTOL)
    assert result.states.tolist() == [STICKS, SLIDES]


def test_one_point_is_at_rest_and_the_other_slides_on():
    """The friction of the sliding point is the kinetic one, although a smaller force acts on it."""
    result = contact_forces(*POINTS, [-10.0, 2.0, -10.0, 2.0], 0.3, 0.5, slips=(0.0, 1.0))
    np.testing.assert_allclose(result.impulses, [[10.0, -2.0], [10.0, -3.0]], rtol=RTOL)
    assert result.states.tolist() == [STICKS, SLIDES]


def test_an_open_contact_transmits_no_impulse():
    u, result = strike(*block(0.2, 0.6), [0.0, -1.0, 0.0], 0.0, 2.0, closed=[True, False])
    alone, single = strike(block(0.2, 0.6)[0], block(0.2, 0.6)[1][:1], [0.0, -1.0, 0.0], 0.0, 2.0)
    np.testing.assert_allclose(u, alone, atol=RTOL)
    np.testing.assert_allclose(result.impulses[0], single.impulses[0], atol=RTOL)
    np.testing.assert_array_equal(result.impulses[1], 0.0)


@pytest.mark.slow
def test_sequential_and_simultaneous_impacts_of_balls():
    # masses (4/5)^i, e = 9/10, exact fractions; three equal balls at once by Newton's law
    M, u = np.diag([0.8**i for i in range(3)]), [1.0, 0.0, 0.0]
    gaps = [[[-1.0, 1.0, 0.0]], [[0.0, -1.0, 1.0]]]
    for closed in ([True, False], [False, True]):
        u, _ = strike(M, gaps, u, 0.9, 0.0, closed)
    np.testing.assert_allclose(u[:2], [7 / 45, 133 / 810], rtol=RTOL)
    np.testing.assert_allclose(u[2], (19 / 18) ** 2, rtol=RTOL)
    u, result = strike(np.eye(3), gaps, [1.0, 0.0, 0.0], 1.0, 0.0)
    np.testing.assert_allclose(u, [-1 / 3, 2 / 3, 2 / 3], rtol=RTOL)
    assert result.unique


class SliderCrank(SliderInGuides):
    """All corners strike at once."""

    def corner_velocities(self, t, q, u):
        motion, rows = self.motion(t, q, u), []
        for i, side in enumerate((-1.0, -1.0, 1.0, 1.0)):
            v = motion[f"corner {i}"].velocity
            rows += [v.dot(side * motion.N.y), v.dot(motion.N.x)]
        return rows


@pytest.mark.weekly
def test_a_slider_strikes_its_guide_with_two_corners():
    # the first impact from the state at t = 0.002692502752021212, which DOP853 computed at rtol 1e-13
    q = [0.355304455027672, -0.17150954094013907, 0.0]
    system, u = SliderCrank(), jnp.array([109.55768154315767, -49.33078996193669, 0.0])
    C = jax.jacfwd(lambda u: jnp.stack(system.corner_velocities(0.0, q, u)))(u).reshape(4, 2, 3)
    _, result = strike(jk.mass_matrix(system, 0.0, q, u), C, u, 0.4, 0.01, [True, True, False, False])
    expected = [0.05574032307375234, 0.055185692993416496]
    np.testing.assert_allclose(result.impulses[:2, 0], expected, rtol=1e-10)
    np.testing.assert_allclose(result.impulses[:2, 1], 0.01 * result.impulses[:2, 0], rtol=1e-10)
    assert result.states.tolist() == [SLIDES, SLIDES, OPEN, OPEN]


def sphere(u, mu, e=0.5):
    """A sphere of unit mass and radius on a plane: u = (v, omega), normal z."""
    C = [[0, 0, 1, 0, 0, 0], [1, 0, 0, 0, -1, 0], [0, 1, 0, 1, 0, 0]]
    return strike(np.diag([1, 1, 1, 0.4, 0.4, 0.4]), [C], u, e, mu)


@pytest.mark.weekly
def test_a_sphere_slides_or_sticks_in_three_dimensions():
    before = np.array([3.0, 1.0, -2.0, 0.5, -1.0, 0.3])
    slip = np.array([3.0 + 1.0, 1.0 + 0.5])
    _, slides = sphere(before, 0.1)
    np.testing.assert_allclose(slides.impulses[0], [3.0, *(-0.3 * slip / np.linalg.norm(slip))], atol=RTOL)
    u, sticks = sphere(before, 0.9)
    np.testing.assert_allclose(sticks.impulses[0], [3.0, *(-2 / 7 * slip)], atol=RTOL)
    np.testing.assert_allclose([u[0] - u[4], u[1] + u[3]], 0.0, atol=RTOL)
    assert (slides.states[0], sticks.states[0]) == (SLIDES, STICKS)


def random_problem(c, rows, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(c * rows, c * rows)) + 2 * np.eye(c * rows)
    v, e, mu = rng.normal(size=(c, rows)), rng.uniform(size=c), rng.uniform(0.1, 0.8, size=c)
    v[:, 0] = -np.abs(v[:, 0])
    return tuple(map(jnp.asarray, ((A @ A.T).reshape(c, rows, c, rows), v, e, mu)))


@pytest.mark.weekly
@pytest.mark.parametrize(("c", "rows"), [(2, 2), (1, 3)])
def test_random_impacts_satisfy_the_contact_laws(c, rows):
    each = [random_problem(c, rows, seed) for seed in range(200)]
    G, v, e, mu = (jnp.stack(x) for x in zip(*each, strict=True))
    result = jax.jit(jax.vmap(lambda *x: contact_impact(*x, jnp.ones(c, bool))))(G, v, e, mu)
    assert np.all(result.determined)
    L, after = np.asarray(result.impulses), np.asarray(result.velocities)
    np.testing.assert_allclose(after, v + np.einsum("nirjs,njs->nir", G, L), atol=1e-10)
    rebound = after[..., 0] + np.asarray(e * v[..., 0])
    force, slip = (np.linalg.norm(x[..., 1:], axis=-1) for x in (L, after))
    assert min(L[..., 0].min(), rebound.min()) > -1e-9
    np.testing.assert_allclose(L[..., 0] * rebound, 0.0, atol=1e-8)
    assert (force - mu * L[..., 0]).max() < 1e-9
    # the greatest dissipation: mu L_N |v_T| + L_T . v_T = 0
    np.testing.assert_allclose(mu * L[..., 0] * slip + (L * after)[..., 1:].sum(-1), 0.0, atol=1e-8)
    assert {SLIDES, STICKS} <= {*np.unique(result.states)}


@pytest.mark.slow
@pytest.mark.parametrize(("c", "rows"), [(2, 2), pytest.param(1, 3, marks=pytest.mark.weekly)])
def test_derivatives_agree_with_central_differences(c, rows):
    # central differences of step 1e-5; at least one contact slides
    G, v, e, mu = random_problem(c, rows, 0)
    closed = jnp.ones(c, bool)

    def f(v, mu):
        return contact_impact(G, v, e, mu, closed).impulses

    a, b = jax.jit(jax.jacrev(f, argnums=(0, 1)))(v, mu)
    assert SLIDES in compiled(G, v, e, mu, closed).states
    h = 1e-5
    for slope, x, at in ((a, v, lambda x: (x, mu)), (b, mu, lambda x: (v, x))):
        for place in np.ndindex(x.shape):
            d = jnp.zeros_like(x).at[place].set(h)
            low, high = (compiled(G, y, e, m, closed).impulses for y, m in (at(x - d), at(x + d)))
            np.testing.assert_allclose(slope[(..., *place)], (high - low) / (2 * h), atol=1e-8)


@pytest.mark.slow
def test_float32_stays_float32():
    G, v, e, mu = (x.astype(jnp.float32) for x in random_problem(2, 2, 0))
    result = compiled(G, v, e, mu, jnp.ones(2, bool))
    wide = compiled(*random_problem(2, 2, 0), jnp.ones(2, bool))
    assert result.impulses.dtype == jnp.float32
    np.testing.assert_array_equal(result.states, wide.states)
    np.testing.assert_allclose(result.impulses, wide.impulses, atol=1e-4)


def test_more_than_four_contacts_are_refused():
    G, v, e, mu = random_problem(5, 1, 0)
    with pytest.raises(ValueError, match="at most 4 contacts"):
        contact_impact(G, v, e, mu, jnp.ones(5, bool))
