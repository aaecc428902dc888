"""Entries that are not from the textbook: figures in 30 digits, and equations that are derived by other methods."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import BouncingBall, Rattleback, RimlessWheel

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.slow
def test_bouncing_ball():
    """Closed form of a fall with drag from 1 m, in 30 digits."""
    times = [0.4590853109923369, 1.1280946846381106, 1.6405736265752897, 2.0400984767321484, 2.3546963595549943]
    times += [2.603903008180971, 2.802033708031122, 2.9599159114088045]
    speeds = [4.216931719040513, 3.193390741653651, 2.473748743919355, 1.940640102411667, 1.533784064034968]
    speeds += [1.217718328504519, 0.9694965104736087, 0.7732301009195972]
    ride = jk.simulate(BouncingBall(), jk.State([1.0], [0.0]), jnp.linspace(0.0, 3.0, 21), **TIGHT)
    np.testing.assert_allclose(ride.jumps.t[:8], times, rtol=1e-10)
    np.testing.assert_allclose(ride.jumps.before.u[:8, 0], -np.array(speeds), rtol=1e-10)
    end = [ride["height"][-1], ride["climb"][-1]]
    np.testing.assert_allclose(end, [0.016894590512326443, 0.22459525490753116], rtol=1e-9)
    assert int(ride.jumps.count) == 8


@pytest.mark.slow
def test_steps_of_the_rimless_wheel_agree_with_jk_impact():
    """With an inertia: a massless wheel about its hub has a singular mass matrix while its foot is released."""
    wheel = RimlessWheel(inertia=0.3)
    q, rate = jnp.array([0.48, 0.1]), 1.4

    def toe(t, q, u, motion):
        v = motion["toe"].velocity
        return v.dot(motion["S"].x), v.dot(motion["S"].y)

    after = jk.impact(wheel, 0.0, q, [rate], toe, release=("foot",))
    jumps = jk.simulate(wheel, jk.State(q, jnp.array([rate])), jnp.linspace(0.0, 0.1, 3), **TIGHT).jumps
    assert int(jumps.count) == 1
    np.testing.assert_allclose(jumps.after.u[0], after.u, rtol=1e-12)
    np.testing.assert_allclose(jumps.after.q[0], [-0.32, 0.1 + 2 * np.sin(0.4)], rtol=1e-12)


# -- the rattleback, by Newton's and Euler's equations in the axes of the body

a, b, c, h, m, g = 0.2, 0.03, 0.02, 0.01, 1.0, 9.81
I = np.array([[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]])
SQUARES = np.array([a, b, c]) ** 2


def lever(n):
    """From the contact to the mass centre; n is the upward normal in the axes of the body."""
    return SQUARES * n / np.sqrt(np.sum(SQUARES * n**2)) - np.array([0.0, 0.0, h])


def newton_euler(n, w):
    """dn/dt and dw/dt. With v = w x r and the force F of the ground: m dv/dt = F - m g n, dH/dt = -r x F."""
    n_dot = np.cross(n, w)
    D = np.sqrt(np.sum(SQUARES * n**2))
    r, r_dot = lever(n), SQUARES * n_dot / D - SQUARES * n * np.sum(SQUARES * n * n_dot) / D**3
    v = np.cross(w, r)
    known = np.cross(w, r_dot) + np.cross(w, v) + g * n  # dv/dt + g n without dw/dt x r
    A = I + m * (np.sum(r * r) * np.eye(3) - np.outer(r, r))
    return n_dot, np.linalg.solve(A, -np.cross(w, I @ w) - m * np.cross(r, known))


def normal(q):
    _, roll, pitch = q[:3]
    return np.array([-np.cos(roll) * np.sin(pitch), np.sin(roll), np.cos(roll) * np.cos(pitch)])


@pytest.mark.slow
def test_accelerations_of_the_rattleback():
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, u = rng.uniform(-0.6, 0.6, 5), rng.uniform(-5.0, 5.0, 3)
        n_dot, expected = newton_euler(normal(q), u)
        np.testing.assert_allclose(jk.accelerations(Rattleback(), 0.0, q, u), expected, rtol=1e-11)
        rates = jk.coordinate_rates(Rattleback(), 0.0, q, u)
        step = 1e-6 * np.array(rates)
        np.testing.assert_allclose((normal(q + step) - normal(q - step)) / 2e-6, n_dot, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_the_rattleback_reverses_its_spin():
    """From 0.5 degrees and 5 rad/s, as in the article. The energy of the motion without slip is constant."""
    start = jk.State(np.deg2rad([0.0, 0.5, 0.5, 0.0, 0.0]), [0.0, 0.0, -5.0])
    ride = jk.simulate(Rattleback(), start, jnp.linspace(0.0, 8.0, 201), rtol=1e-12, atol=1e-12, max_steps=100_000)
    assert ride.ok
    ns = np.array([normal(q) for q in np.asarray(ride.q)])
    speeds = np.asarray(ride.u)
    rs = np.array([lever(n) for n in ns])
    vs = np.cross(speeds, rs)
    energy = 0.5 * np.einsum("ti,ij,tj->t", speeds, I, speeds) + 0.5 * m * np.sum(vs**2, 1) + m * g * np.sum(rs * ns, 1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
    spin = np.einsum("ti,ti->t", speeds, ns)
    assert spin[0] < -4.9
    assert spin.max() > 4.9
