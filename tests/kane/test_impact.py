"""Impacts against Pinocchio, published gaits, closed forms, and multipliers on all speeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Sled, SliderCrank

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.catalog import CompassGait

RTOL = 1e-12


class Chain(jk.System):
    """Links on hinges about x, y, z in turn, with fixed numbers."""

    def motion(self, t, q, u):
        N, P = jk.inertial()
        frame, bodies, points = N, [], {}
        for i in range(len(self.coordinates)):
            P = P.fixed(-(0.4 + 0.05 * i if i else 0.0) * frame.z, frame)
            frame = frame.rotate(1 + i % 3, q[i], u[i], f"B{i}")
            inertia = 0.02 * (i + 1), 0.03 * (i + 1), 0.01 * (i + 1)
            center = P.fixed(frame.vector(0.03, -0.02, -0.2))
            bodies.append(jk.Body(1.0 + 0.3 * i, inertia, center, frame, name=f"link {i}"))
            points |= {f"hinge {i}": P, f"middle {i}": P.fixed(frame.vector(0.02, 0.0, -0.3))}
        return jk.Motion(bodies, points=points | {"tip": P.fixed(frame.vector(0.0, 0.05, -0.45))})


def chain(n):
    names = tuple(f"q{i}" for i in range(n)), tuple(f"u{i}" for i in range(n))
    return type(f"Chain{n}", (Chain,), {"coordinates": names[0], "speeds": names[1]})()


def tip_z(t, q, u, motion):
    return motion["tip"].velocity.dot(motion.N.z)


def tip_and_middle_z(t, q, u, motion):
    return tip_z(t, q, u, motion), motion[f"middle {len(q) // 2}"].velocity.dot(motion.N.z)


def tip(t, q, u, motion):
    return motion["tip"].velocity.express(motion.N)


# Pinocchio's impulseDynamics: coordinates and speeds before; residuals, restitution, speeds after and impulses.
THREE = [0.25019093320933394, 0.794427601939151, 0.551371380490387]
THREE_BEFORE = [-1.0991712400376326, -0.7993348603550983, 1.4942137815850476]
FIVE = [-0.9894693908688506, 0.6424568367655326, 0.5941388575040925, -0.06413009431255845, -0.39393514636137295]
FIVE_BEFORE = [-0.8862975515969067, -0.9805216493835016, -0.2196947764694137, 0.018193035831813198, 0.21398940829796986]
THREE_AFTER = [-0.7628341445235738, 0.8971463950346212, 2.523253529194818]
THREE_AFTER_BOTH = [0.05001258516848717, 0.48084859410187786, -3.7180542874703555]
FIVE_AFTER_XYZ = [-1.3660969652185262, -0.9296782824544791, 2.040213282260614, 3.1937900338427863]
FIVE_AFTER_XYZ += [0.0027525998585989364]
Z, XYZ, BOTH = (tip_z, 0.5), (tip, 0.0), (tip_and_middle_z, 0.3)
PINOCCHIO = {
    "3 z": (THREE, THREE_BEFORE, *Z, THREE_AFTER, [2.4585216212613616]),
    "3 both": (THREE, THREE_BEFORE, *BOTH, THREE_AFTER_BOTH, [-3.5064707305054093, 18.64332802349147]),
    "5 xyz": (FIVE, FIVE_BEFORE, *XYZ, FIVE_AFTER_XYZ, [-1.0750988666405135, 5.149824677630524, 0.7080449645907833]),
}


@pytest.mark.slow
@pytest.mark.weekly_cases("5 *")
@pytest.mark.parametrize("case", PINOCCHIO)
def test_impulses_agree_with_pinocchio(case):
    q, before, residuals, e, u, p = PINOCCHIO[case]
    after = jk.impact(chain(len(q)), 0.0, q, before, residuals, e)
    np.testing.assert_allclose(after.u, u, rtol=0, atol=RTOL * np.abs(u).max())
    np.testing.assert_allclose(after.impulses, p, rtol=0, atol=RTOL * np.abs(p).max())
    assert after.unique


def in_plane(name, up="y"):
    def residuals(t, q, u, motion):
        v = motion[name].velocity
        return v.dot(motion.N.x), v.dot(getattr(motion.N, up))

    return residuals


toe = in_plane("toe")
STRIKE_Q = jnp.array([0.3233885580586503, -0.21866880293899055, 0.0])
STRIKE_U = jnp.array([1.4942048971003625, 1.8056788689878192])


class Massless(CompassGait):
    """A compass gait without mass, which `CompassGait` refuses."""

    hip_mass: Scalar = parameter(0.0)
    leg_mass: Scalar = parameter(0.0)


@pytest.mark.slow
def test_heel_strike_of_the_compass_gait():
    # the periodic gait at a slope of 3 degrees; the legs have not been exchanged yet
    walker = CompassGait()
    after = jk.impact(walker, 0.0, STRIKE_Q, STRIKE_U, toe, release=("foot",))
    np.testing.assert_allclose(after.u, [0.3773739489071941, 1.092383589883601], rtol=0, atol=RTOL)
    np.testing.assert_allclose(after.impulses, [-2.619490477212034, 13.735598013322457], rtol=0, atol=RTOL * 14)
    before = jk.kinetic_energy(walker, 0.0, STRIKE_Q, STRIKE_U)
    new_q = STRIKE_Q[jnp.array([1, 0, 2])]
    exchanged = jk.kinetic_energy(walker, 0.0, new_q, after.u[::-1])  # the new stance foot is at rest
    np.testing.assert_allclose(after.energy_lost, before - exchanged, rtol=1e-11)


@pytest.mark.slow
def test_a_walker_that_does_not_release_its_foot_stops():
    after = jk.impact(CompassGait(), 0.0, STRIKE_Q, STRIKE_U, toe)
    np.testing.assert_allclose(after.u, 0.0, atol=RTOL)


class Hoop(jk.System):
    """A wheel over a road along x, N.z up. Its two contact residuals make it roll."""

    height: Scalar = parameter(0.08)  # of a kerb [m]
    radius: Scalar = parameter(0.35)
    coordinates, speeds, dependent_speeds = ("angle", "x", "z"), ("rate",), ("x_dot", "z_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        W = N.rotate(2, q["angle"], u["rate"], "W")
        center = O.moving(q["x"] * N.x + q["z"] * N.z, u["x_dot"] * N.x + u["z_dot"] * N.z)
        hoop = jk.Body(1.0, (0.0, self.radius**2, 0.0), center, W, name="hoop")
        ground = center.fixed(-self.radius * N.z, W)
        depth = self.radius - self.height
        edge = center.fixed(jnp.sqrt(self.radius**2 - depth**2) * N.x - depth * N.z, W)
        residuals = ground.velocity.dot(N.x), ground.velocity.dot(N.z)
        return jk.Motion([hoop], residuals, points={"ground": ground, "edge": edge})


def over_kerb(hoop, release=("ground",)):
    return jk.impact(hoop, 0.0, [0.0, 0.0, 0.35], [4.5], in_plane("edge", "z"), release=release)


@pytest.mark.slow
def test_the_impact_of_a_hoop_on_a_kerb_agrees_with_the_closed_form():
    # Angular momentum about the edge. The velocity residuals of the road are released.
    after = over_kerb(Hoop())
    np.testing.assert_allclose(after.u, [3.9857142857142858], rtol=RTOL)
    np.testing.assert_allclose(after.impulses, [-0.49885714285714283, 0.8876607184169006], rtol=0, atol=RTOL)
    slope = jax.grad(lambda height: over_kerb(Hoop(height=height)).u[0])(0.08)
    np.testing.assert_allclose(slope, -6.428571428571429, rtol=RTOL)
    # If the road holds the wheel, it stops.
    np.testing.assert_allclose(over_kerb(Hoop(), release=()).u, 0.0, atol=RTOL)


@pytest.mark.slow
def test_an_impact_preserves_the_loop_closure_of_a_slider_crank():
    system = SliderCrank()
    q = jk.assemble(system, {"crank": 0.9, "rod": -0.3, "x": 0.5}, {}).q
    after = jk.impact(system, 0.0, q, [12.0], lambda t, q, u, motion: u["x_dot"], 0.4)
    np.testing.assert_allclose(after.u, [-4.8], rtol=RTOL)
    np.testing.assert_allclose(after.impulses, [3.8496550548882733], rtol=RTOL)
    u_dep = jk.dependent_speeds(system, 0.0, q, after.u)
    np.testing.assert_allclose(u_dep, [1.1705385664793941, 0.7015325286138013], rtol=RTOL)
    lost = 0.5 * 0.03349030561689822 * (12.0**2 - 4.8**2)
    np.testing.assert_allclose(after.energy_lost, lost, rtol=RTOL)


class Block(jk.System):
    """A rectangle in a plane, with two lower corners."""

    coordinates, speeds = ("x", "y", "angle"), ("x_dot", "y_dot", "rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"], "B")
        center = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        corners = {"left": center.fixed(-0.2 * B.x - 0.6 * B.y), "right": center.fixed(0.2 * B.x - 0.6 * B.y)}
        body = jk.Body(1.0, (0.0, 0.0, 0.13), center, B, name="block")
        return jk.Motion([body], points=corners | {"center": center}, frames={"N": N})


FALLS_Q, FALLS_U = [0.0, 0.6, 0.0], [0.3, -2.0, 0.7]
left = in_plane("left")


def both_corners(t, q, u, motion):
    return *left(t, q, u, motion), *in_plane("right")(t, q, u, motion)


@pytest.mark.slow
def test_both_corners_of_a_block_stick():
    """Four residuals have the rank 3. Impulses are those of the pseudo-inverse."""
    after = jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, both_corners)
    np.testing.assert_allclose(after.u, 0.0, atol=RTOL)
    M = np.diag([1.0, 1.0, 0.13])
    C = np.array([[1.0, 0.0, 0.6], [0.0, 1.0, -0.2], [1.0, 0.0, 0.6], [0.0, 1.0, 0.2]])
    p = np.linalg.pinv(C.T) @ M @ (0.0 - np.array(FALLS_U))
    np.testing.assert_allclose(after.impulses, p, rtol=0, atol=RTOL)
    assert not after.unique
    slopes = jax.jacfwd(lambda u: jk.impact(Block(), 0.0, FALLS_Q, u, both_corners).impulses)(jnp.array(FALLS_U))
    np.testing.assert_allclose(slopes, -np.linalg.pinv(C.T) @ M, rtol=0, atol=RTOL)


@pytest.mark.slow
def test_a_repeated_residual_divides_the_impulse_equally():
    once = jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, lambda *args: left(*args)[1], 0.5)
    twice = jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, lambda *args: left(*args)[1:] * 2, 0.5)
    assert once.unique
    assert not twice.unique
    np.testing.assert_allclose(twice.u, once.u, rtol=RTOL)
    np.testing.assert_allclose(twice.impulses, 0.5 * np.repeat(once.impulses, 2), rtol=RTOL)


@pytest.mark.slow
def test_contradictory_impact_residuals_raise():
    def after(u, e):
        return jk.impact(Block(), 0.0, FALLS_Q, u, lambda *a: left(*a)[1:] * 2, (0.5, e)).u

    with pytest.raises(ValueError, match="contradict each other"):
        after(FALLS_U, 0.6)
    u = jnp.array(FALLS_U)
    value, slope = jax.jit(lambda u: (after(u, 0.6), jax.jacfwd(after)(u, 0.6)))(u)
    assert np.isnan(value).all()
    assert np.isnan(slope).all()
    assert np.isfinite(jax.jit(after)(u, 0.5)).all()


@pytest.mark.slow
def test_restitution_is_relative_to_a_moving_surface():
    after = jk.impact(Sled(0.5), 2.0, [0.0], {"v": -4.0}, lambda t, q, u, motion: u["v"] - 3.0 * t, 0.7)
    np.testing.assert_allclose(after.u, [6.0 - 0.7 * (-4.0 - 6.0)], rtol=RTOL)
    np.testing.assert_allclose(after.impulses, [0.5 * (13.0 + 4.0)], rtol=RTOL)
    np.testing.assert_allclose(after.energy_lost, 0.25 * (4.0**2 - 13.0**2), rtol=RTOL)


class Carried(jk.System):
    """A pendulum on a pivot with a prescribed velocity."""

    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"], "B")
        pivot = O.moving(0.5 * t * t * N.x, t * N.x)
        return jk.Motion([jk.Body(2.0, 0.0, pivot.fixed(-1.5 * B.y), name="bob")])


@pytest.mark.slow
def test_a_prescribed_pivot_keeps_its_velocity():
    system, q, u, t = Carried(), [0.4], [1.3], 0.8
    after = jk.impact(system, t, q, u, lambda t, q, u, m: m["bob"].center.velocity.dot(m.N.x), 0.25)
    v = t + 1.5 * np.cos(0.4) * 1.3
    np.testing.assert_allclose(after.u, [(-0.25 * v - t) / (1.5 * np.cos(0.4))], rtol=RTOL)
    energies = [jk.kinetic_energy(system, t, q, x) for x in (u, after.u)]
    np.testing.assert_allclose(after.energy_lost, energies[0] - energies[1], rtol=RTOL)


class Hanging(jk.System):
    """The block of `Block` on a hinge at its left corner."""

    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"], "B")
        hinge = O.fixed(0.0 * B.y)
        center = hinge.fixed(0.2 * B.x + 0.6 * B.y)
        body = jk.Body(1.0, (0.0, 0.0, 0.13), center, B, name="block")
        return jk.Motion([body], points={"hinge": hinge, "right": hinge.fixed(0.4 * B.x), "center": center})


def right_y(t, q, u, motion):
    return motion["right"].velocity.dot(motion.N.y)


def test_releasing_a_hinge_gives_the_impact_of_a_free_body():
    # about the left corner: v = omega x r
    rate = 0.9
    free = jk.impact(Block(), 0.0, [0.0, 0.6, 0.0], [-0.6 * rate, 0.2 * rate, rate], right_y, 0.5)
    after = jk.impact(Hanging(), 0.0, [0.0], [rate], right_y, 0.5, release="hinge")
    np.testing.assert_allclose(after.u, free.u[2:], rtol=RTOL)
    np.testing.assert_allclose(after.impulses, free.impulses, rtol=RTOL)
    np.testing.assert_allclose(after.energy_lost, free.energy_lost, rtol=RTOL)


@pytest.mark.slow
def test_releasing_a_moving_point_does_not_change_the_impact():
    """Its auxiliary speeds along x and y have the same partial velocities as the speeds."""
    free, released = (jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, left, release=x) for x in ((), ("center",)))
    np.testing.assert_allclose(released.u, free.u, rtol=RTOL)
    np.testing.assert_allclose(released.impulses, free.impulses, rtol=RTOL)


def strike(x, e, leg, q):
    """All results of a heel strike, in one row."""
    after = jk.impact(CompassGait(leg_mass=leg), 0.0, q, x, toe, (e, 0.5 * e), ("foot",))
    return jnp.concatenate([after.u, after.impulses, after.energy_lost[None]])


@pytest.mark.weekly
def test_derivatives_agree_with_central_differences():
    # central differences; truncation h^2 = 1e-10
    point = STRIKE_U, jnp.array(0.3), jnp.array(5.0), STRIKE_Q
    f, h = jax.jit(strike), 1e-5
    forward, reverse = (jax.jit(jac(strike, argnums=(0, 1, 2, 3)))(*point) for jac in (jax.jacfwd, jax.jacrev))
    for i, (x, a, b) in enumerate(zip(point, forward, reverse, strict=True)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(a).max())
        for place in np.ndindex(x.shape):
            e = jnp.zeros_like(x).at[place].set(h)
            low, high = (f(*point[:i], x + sign * e, *point[i + 1 :]) for sign in (-1.0, 1.0))
            np.testing.assert_allclose(a[(..., *place)], (high - low) / (2 * h), rtol=0, atol=1e-8 * np.abs(a).max())


def test_an_elastic_impact_loses_no_energy():
    after = jk.impact(CompassGait(), 0.0, STRIKE_Q, STRIKE_U, toe, 1.0, "foot")
    assert abs(after.energy_lost) < RTOL * jk.kinetic_energy(CompassGait(), 0.0, STRIKE_Q, STRIKE_U)


@pytest.mark.slow
def test_float32_stays_float32():
    walker = jax.tree.map(lambda x: x.astype(jnp.float32), CompassGait())
    after = jk.impact(walker, 0.0, STRIKE_Q.astype(jnp.float32), STRIKE_U.astype(jnp.float32), toe, 0.3, ("foot",))
    wide = jk.impact(CompassGait(), 0.0, STRIKE_Q, STRIKE_U, toe, 0.3, ("foot",))
    assert {x.dtype for x in (after.u, after.impulses, after.energy_lost)} == {jnp.dtype(jnp.float32)}
    assert after.unique
    np.testing.assert_allclose(after.u, wide.u, rtol=0, atol=1e-5)
    twice = jk.impact(walker, 0.0, STRIKE_Q.astype(jnp.float32), STRIKE_U.astype(jnp.float32), lambda *a: toe(*a) * 2)
    assert not twice.unique
    np.testing.assert_allclose(twice.u, 0.0, atol=1e-5)


class Train(jk.System):
    """13 wagons on a line; the coordinates are their distances. The mass matrix is an array."""

    coordinates, speeds = tuple(f"q{i}" for i in range(13)), tuple(f"u{i}" for i in range(13))

    def motion(self, t, q, u):
        N, P = jk.inertial()
        points = {}
        for i in range(13):
            P = points[f"P{i}"] = P.moving(q[i] * N.x, u[i] * N.x, N)
        return jk.Motion([jk.Body(1.0 + i, 0.0, P) for i, P in enumerate(points.values())], points=points)


@pytest.mark.slow
def test_many_speeds():
    u = np.linspace(-1.0, 2.0, 13)
    after = jk.impact(Train(), 0.0, np.ones(13), u, lambda t, q, u, m: m["P5"].velocity.dot(m.N.x), 0.2)
    velocities = np.cumsum(u)
    velocities[5] *= -0.2  # a free mass
    np.testing.assert_allclose(np.cumsum(after.u), velocities, rtol=0, atol=1e-11)
    np.testing.assert_allclose(after.impulses, [-6.0 * 1.2 * np.sum(u[:6])], rtol=1e-11)
    np.testing.assert_allclose(after.energy_lost, 3.0 * (1 - 0.2**2) * np.sum(u[:6]) ** 2, rtol=1e-11)


def test_a_singular_mass_matrix_is_explained():
    with pytest.raises(ValueError, match="mass"):
        jk.impact(Massless(), 0.0, STRIKE_Q, STRIKE_U, toe)


def test_an_event_impact_stores_residuals_and_coefficients():
    N, _ = jk.inertial()
    hit = jk.Impact(1.0 * N.x, [2.0, 3.0], restitution=(0.5, 0.25), release="foot")
    assert hit.residuals == (1.0, 0.0, 0.0, 2.0, 3.0)
    assert hit.restitution == (0.5, 0.5, 0.5, 0.25, 0.25)
    assert hit.release == ("foot",)


MISUSES = {
    "no residuals": (lambda: jk.Impact(), "at least one velocity residual"),
    "above one": (lambda: jk.Impact(1.0, restitution=1.1), "restitution is 1.1"),
    "too many": (lambda: jk.Impact(1.0, 2.0, restitution=(0.1, 0.2, 0.3)), "2 residuals, but 3 coefficients"),
    "negative": (lambda: jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, left, -0.1), "restitution is -0.1"),
    "position": (lambda: jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, lambda t, q, u, m: q["y"]), "does not depend on"),
    "square": (lambda: jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, lambda t, q, u, m: u["y_dot"] ** 2), "not affine"),
    "unknown": (lambda: jk.impact(CompassGait(), 0.0, STRIKE_Q, STRIKE_U, toe, 0.0, "heel"), "heel"),
    "nothing": (lambda: jk.impact(CompassGait(), 0.0, STRIKE_Q, STRIKE_U, toe, 0.0, "toe"), "has no effect"),
    "inertial": (lambda: jk.impact(Block(), 0.0, FALLS_Q, FALLS_U, left, 0.0, "N"), "inertial frame"),
}


@pytest.mark.parametrize("case", MISUSES)
def test_misuse_is_explained(case):
    call, message = MISUSES[case]
    with pytest.raises((ValueError, TypeError, KeyError), match=message):
        call()
