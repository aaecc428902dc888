"""Contacts of several bodies, of a block with two corners, and in space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.contacts import Box
from test_contact_laws import OPEN, SLIDES, STICKS, TIGHT, end_of, jumps_of

import jaxkane as jk
from jaxkane.catalog import RockingBlock


# -- A block with two corners.
class PushedBlock(RockingBlock):
    """A horizontal force acts on its mass centre. The static friction of its corners may differ."""

    left: jk.Scalar = jk.parameter(0.0)
    right: jk.Scalar = jk.parameter(0.0)
    inputs = ("push",)

    def loads(self, t, q, u, motion, inputs):
        return super().loads(t, q, u, motion, inputs), jk.Force(inputs["push"] * motion.N.x, motion["block"])

    def contacts(self, t, q, u, motion):
        law = {"restitution": self.restitution, "friction": self.friction}
        corners = {"left": self.left, "right": self.right}
        return {x: jk.Contact(motion[x], motion.N.y, static=static, **law) for x, static in corners.items()}


def block_ride(state, duration, b=0.2, h=0.6, friction=2.0, restitution=0.0, static=None, push=0.0):
    """One program for all simulations. `static` of both corners is the kinetic friction by default."""
    static = (friction, friction) if static is None else static
    block = PushedBlock(b, h, friction=friction, restitution=restitution, left=static[0], right=static[1])
    return jk.simulate(block, state, jnp.linspace(0, duration, 21), {"push": push}, **TIGHT)


def tilted(angle, b=0.2, h=0.6, **speeds):
    """A block that stands on one corner. A positive angle lifts the right corner."""
    side = np.sign(angle) * b
    y = side * np.sin(angle) + h * np.cos(angle)
    return jk.State({"x": -h * np.sin(angle) + side * np.cos(angle) - side, "y": y, "angle": angle}, speeds)


def test_a_rocking_block_agrees_with_the_closed_form():
    # Quadrature; the energy ratio of an impact is r^2 with r = 1 - 3/2 sin^2(alpha) (Housner, 1963).
    atol = 1e-10
    ride = block_ride(tilted(0.25), 2.2)
    np.testing.assert_allclose(jumps_of(ride), [0.6402887800202485, 1.338581180728541, 1.8563203472495828], atol=atol)
    np.testing.assert_allclose(
        ride.jumps.after.u[:3, 2], [-0.9051977448109763, 0.7694180830893298, -0.6540053706259303], atol=atol
    )
    impulses = [0.39402725362360147, 0.33492316558006124, 0.284684690743052]
    np.testing.assert_allclose(ride.jumps.impulses[jnp.arange(3), jnp.array([2, 0, 2])], impulses, atol=atol)
    np.testing.assert_array_equal(ride.jumps.impulses[jnp.arange(3), jnp.array([0, 2, 0])], 0.0)
    state = [0.021247441986547815, 0.6066692039354292, -0.03521304161358452, -0.25908375349019, -0.07633795052670474]
    np.testing.assert_allclose(end_of(ride), [*state, 0.4270593460316235], atol=atol)
    energies = 0.5 * jnp.sum(ride.jumps.before.u[:3] ** 2 * jnp.array([[1.0, 1.0, 1.6 / 12]]), axis=1)
    np.testing.assert_allclose(ride.jumps.energy[:3] / energies, 1 - 0.85**2, rtol=1e-9)
    left = np.searchsorted(jumps_of(ride), ride.t) % 2 == 0
    np.testing.assert_array_equal(ride.contacts["left"], np.where(left, STICKS, OPEN))
    np.testing.assert_array_equal(ride.contacts["right"], np.where(left, OPEN, STICKS))


@pytest.mark.weekly
def test_derivatives_of_a_rocking_block():
    # Quadrature: of the time of the sixth impact by the half width, the half height and the angle at the start.
    def sixth(p):
        b, h, angle = p
        x, y = -h * jnp.sin(angle) + b * jnp.cos(angle), b * jnp.sin(angle) + h * jnp.cos(angle)
        start = jk.State(jnp.stack([x, y, angle]), jnp.zeros(3))
        block = RockingBlock(b, h, friction=2.0)
        time = jk.simulate(block, start, jnp.linspace(0, 3, 21), adjoint="forward", **TIGHT).jumps.t[5]
        return time, time

    slopes, time = jax.jit(jax.jacfwd(sixth, has_aux=True))(jnp.array([0.2, 0.6, 0.25]))
    np.testing.assert_allclose(time, 2.8724483216639736, atol=1e-10)
    np.testing.assert_allclose(slopes, [-19.85579741496443, 9.012306073041456, 6.863674401308323], rtol=1e-8)


def test_both_corners_of_a_wide_block_stick():
    """It falls on its whole base and stays there. Its Delassus matrix is singular: four rows, three speeds."""
    ride = block_ride(tilted(0.1, 0.6, 0.3), 100, 0.6, 0.3)
    assert ride.ok
    assert int(ride.jumps.count) == 1
    for name in ("left", "right"):
        np.testing.assert_array_equal(ride.contacts[name][1:], STICKS)
        # 100 s at rest: the block does not sink, and both corners carry half of its weight.
        np.testing.assert_allclose(ride[f"{name}.normal"][1:], 9.81 / 2, rtol=1e-10)
    np.testing.assert_allclose(ride["y"][1:], 0.3, atol=1e-12)
    np.testing.assert_allclose([ride["x"][1:] - ride["x"][1], ride["angle"][1:]], 0.0, atol=1e-12)


def test_a_block_slides_on_both_corners():
    ride = block_ride(jk.State({"y": 0.6}, {"x_dot": 1.0}), 2, friction=0.2)
    stops = 1 / (0.2 * 9.81)
    np.testing.assert_allclose(jumps_of(ride), [stops], atol=1e-10)
    np.testing.assert_allclose(end_of(ride), [stops / 2, 0.6, 0, 0, 0, 0], atol=1e-10)
    # Moments about the mass centre: (N_left - N_right) b = mu m g h
    slides = np.asarray(ride.t) < stops
    difference = np.where(slides, 0.2 * 9.81 * 1.2 / 0.4, 0.0)
    np.testing.assert_allclose((ride["right.normal"] - ride["left.normal"])[slides], difference[slides], rtol=1e-9)
    np.testing.assert_allclose(ride["left.normal"] + ride["right.normal"], 9.81, rtol=1e-10)


@pytest.mark.parametrize("static", [(0.5, 0.5), (0.5, 0.8)])
def test_friction_of_two_corners_is_proportional_to_their_limits(static):
    """A block at rest is pushed at its mass centre. Moments about it: (N_right - N_left) b = F h."""
    rtol, push = 1e-10, 1.0
    ride = block_ride(jk.State({"y": 0.6}, {}), 2, friction=0.5, static=static, push=push)
    normal = 0.5 * (9.81 + np.array([-1.0, 1.0]) * push * 0.6 / 0.2)
    limits = np.array(static) * normal
    for i, name in enumerate(("left", "right")):
        np.testing.assert_array_equal(ride.contacts[name], STICKS)
        np.testing.assert_allclose(ride[f"{name}.normal"], normal[i], rtol=rtol)
        np.testing.assert_allclose(ride[f"{name}.friction"], -push * limits[i] / limits.sum(), rtol=rtol)


@pytest.mark.weekly
def test_random_blocks_satisfy_the_contact_laws():
    rng = np.random.default_rng(1)
    for _ in range(40):
        b, h = rng.choice([0.2, 0.6]), rng.choice([0.3, 0.6])
        mu, e = rng.choice([0.0, 0.1, 0.4, 0.8, 2.0]), rng.choice([0.0, 0.3])
        start = tilted(rng.uniform(-0.5, 0.5), b, h, rate=rng.choice([0.0, 1.0, -2.0]))
        q = {**start.q, "y": start.q["y"] + rng.choice([1e-3, 0.2])}
        ride = block_ride(jk.State(q, start.u), 0.97, b, h, mu, e)
        if ride.reason == "max jumps":  # e.g. infinitely many bounces of one corner between those of the other one
            continue
        assert ride.ok
        assert np.all(np.diff(jumps_of(ride)) >= 0)
        impulses = np.asarray(ride.jumps.impulses)[: int(ride.jumps.count)].reshape(-1, 2, 2)
        assert np.all(impulses[..., 0] >= 0)
        assert np.all(np.abs(impulses[..., 1]) <= mu * impulses[..., 0] + 1e-12)
        for name, side in (("left", -b), ("right", b)):
            x = h * np.sin(ride["angle"]) + side * np.cos(ride["angle"])
            y = side * np.sin(ride["angle"]) - h * np.cos(ride["angle"])
            gap, slip = ride["y"] + y, ride["x_dot"] - ride["rate"] * y
            normal, friction, states = ride[f"{name}.normal"], ride[f"{name}.friction"], ride.contacts[name]
            closed = np.asarray(states) > OPEN
            assert np.min(gap) > -1e-9
            np.testing.assert_allclose(gap[closed], 0.0, atol=1e-9)
            np.testing.assert_allclose((ride["y_dot"] + ride["rate"] * x)[closed], 0.0, atol=1e-9)
            np.testing.assert_allclose(slip[states == STICKS], 0.0, atol=1e-9)
            assert np.all(normal > -1e-9)
            assert np.all(np.abs(friction) <= mu * normal + 1e-8)
            slides = (states == SLIDES) & (np.abs(slip) > 1e-6)
            np.testing.assert_allclose(friction[slides], (-np.sign(slip) * mu * normal)[slides], atol=1e-8)
        squares = ride["x_dot"] ** 2 + ride["y_dot"] ** 2 + (b**2 + h**2) / 3 * ride["rate"] ** 2
        assert np.all(np.diff(0.5 * squares + 9.81 * ride["y"]) < 1e-8)


class KickedBlock(RockingBlock):
    """It gets 1 m/s along the floor at 0.5 s, and 2 m/s away from it at 1 s."""

    states = ("kicks",)

    def state_rates(self, t, q, u, x, motion, now):
        return {}

    def events(self, t, q, u, x):
        along = {"x_dot": u["x_dot"] + 1.0, "kicks": x["kicks"] + 1.0}
        return {"along": jk.rising(t - 0.5, then=along), "away": jk.rising(t - 1.0, then={"y_dot": u["y_dot"] + 2.0})}


@pytest.mark.weekly
def test_events_change_the_state_of_closed_contacts():
    """Both corners slide, stick, open together and land together. Then the simulation continues from its end."""
    atol = 1e-10
    block = KickedBlock(0.6, 0.2, friction=0.4)
    ride = jk.simulate(block, jk.State({"y": 0.2}, {}), jnp.linspace(0, 2, 21), **TIGHT)
    stops, lands = 0.5 + 1 / (0.4 * 9.81), 1.0 + 4 / 9.81
    np.testing.assert_allclose(jumps_of(ride), [0.5, stops, 1.0, lands], atol=atol)
    assert [ride.jumps.name(i) for i in (0, 2)] == ["along", "away"]
    np.testing.assert_allclose(end_of(ride), [0.5 / (0.4 * 9.81), 0.2, 0, 0, 0, 0], atol=atol)
    t = np.asarray(ride.t)
    expected = np.select([(t >= 0.5) & (t < stops), (t >= 1) & (t < lands)], [SLIDES, OPEN], STICKS)
    for name in ("left", "right"):
        np.testing.assert_array_equal(ride.contacts[name], expected)
    half = jk.simulate(block, jk.State({"y": 0.2}, {}), jnp.linspace(0, 0.6, 21), **TIGHT)
    rest = jk.simulate(block, half.end, jnp.linspace(0.6, 2.0, 21), **TIGHT)
    np.testing.assert_array_equal(rest.contacts["left"][0], SLIDES)
    np.testing.assert_allclose(end_of(rest), end_of(ride), atol=atol)
    np.testing.assert_allclose(jumps_of(rest), [stops, 1.0, lands], atol=atol)


class TwoPoints(jk.System):
    """Two independent points of 1 kg on a floor, with forces along it. Friction: 3 N while they slide, 5 N at rest."""

    coordinates, speeds, inputs = ("x1", "y1", "x2", "y2"), ("vx1", "vy1", "vx2", "vy2"), ("push1", "push2")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        points = {f"point {i}": O.moving(N.vector(*q[k : k + 2], 0.0), N.vector(*u[k : k + 2], 0.0)) for i, k in PLACES}
        return jk.Motion(
            [jk.Body(1.0, 0.0, point, name=f"body {name}") for name, point in points.items()], points=points
        )

    def loads(self, t, q, u, motion, inputs):
        push = [jk.Force(inputs[f"push{i}"] * motion.N.x, motion[f"point {i}"]) for i, _ in PLACES]
        return jk.weight(motion, -10.0 * motion.N.y), push

    def contacts(self, t, q, u, motion):
        law = {"friction": 0.3, "static": 0.5}
        return {f"point {i}": jk.Contact(motion[f"point {i}"], motion.N.y, **law) for i, _ in PLACES}


PLACES = ((1, 0), (2, 2))


@pytest.mark.parametrize(
    ("u", "push", "ends", "friction"),
    [
        ((0.6, 0.0, 3.0, 0.0), (0.0, 0.0), (0.0, 1.5), (0.0, -3.0)),  # at 0.2 s one stops, and the other slides on
        ((0.0, 0.0, 0.0, 0.0), (4.0, 6.0), (0.0, 1.5), (-4.0, -3.0)),  # static friction holds only one
        ((0.0, 0.0, 3.0, 0.0), (2.0, 2.0), (0.0, 2.5), (-2.0, -3.0)),  # the smaller force does not stop the slip
        ((0.2, -1.0, 2.0, -1.0), (0.0, 0.0), (0.0, 0.2), (0.0, -3.0)),  # an impact stops one: impulses 0.2 and 0.3
    ],
    ids=["stops", "static", "slides", "impact"],
)
def test_independent_points_stick_and_slide_independently(u, push, ends, friction):
    atol = 1e-10
    inputs = dict(zip(("push1", "push2"), push, strict=True))
    ride = jk.simulate(TwoPoints(), jk.State(jnp.zeros(4), jnp.array(u)), jnp.linspace(0, 0.5, 21), inputs, **TIGHT)
    np.testing.assert_allclose(ride.end.u, [ends[0], 0.0, ends[1], 0.0], atol=atol)
    np.testing.assert_allclose([ride["point 1.friction"][-1], ride["point 2.friction"][-1]], friction, atol=atol)
    assert [int(ride.contacts[f"point {i}"][-1]) for i in (1, 2)] == [STICKS, SLIDES]
    if u[1]:
        np.testing.assert_allclose(ride.jumps.impulses[0], [1.0, -0.2, 1.0, -0.3], atol=atol)


# -- Balls in a row (exact fractions).
class BallsInARow(jk.System):
    restitution: jk.Scalar = jk.parameter(0.9)
    coordinates = ("a", "b", "c", "d", "e")
    speeds = ("a_dot", "b_dot", "c_dot", "d_dot", "e_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(0.8**i, 0.0, O.moving(q[i] * N.x, u[i] * N.x), name=f"ball {i}") for i in range(5)])

    def contacts(self, t, q, u, motion):
        return {f"{i} and {i + 1}": jk.Contact(gap=q[i + 1] - q[i], restitution=self.restitution) for i in range(4)}


@pytest.mark.weekly
def test_balls_in_a_row_are_hit_one_after_the_other():
    atol, ts = 1e-12, jnp.linspace(0, 5, 21)

    @jax.jit
    def run(restitution, q):
        ride = jk.simulate(BallsInARow(restitution), jk.State(q, jnp.eye(5)[0]), ts, adjoint="forward", **TIGHT)
        return ride.end.u, ride

    slopes = jax.jit(jax.jacfwd(run, has_aux=True))
    ride = slopes(0.9, jnp.array([0.0, 1.0, 2.0, 3 + 1 / 7, 4.0]))[1]
    np.testing.assert_allclose(jumps_of(ride), [1.0, 37 / 19, 7513 / 2527, 177739 / 48013], atol=atol)
    np.testing.assert_allclose(
        ride.end.u, [7 / 45, 133 / 810, 2527 / 14580, 48013 / 262440, 130321 / 104976], atol=atol
    )
    # Three balls that touch are hit one after the other, with masses 1, 4/5, 16/25: (1 - 4/5 e) / 1.8, (1 + e) / 1.8.
    touching = jnp.array([0.0, 1.0, 1.0, 50.0, 90.0])
    by_e, ride = slopes(1.0, touching)
    kept, passed = 1 / 9, 10 / 9
    np.testing.assert_allclose(ride.end.u, [kept, passed * kept, passed**2, 0, 0], atol=atol)
    np.testing.assert_allclose(by_e, [-4 / 9, (kept - 0.8 * passed) / 1.8, 2 * passed / 1.8, 0, 0], atol=atol)
    assert int(ride.jumps.count) == 2
    # Gaps that differ by 1e-13: two events at almost the same time.
    ride = slopes(1.0, touching.at[2].add(1e-13))[1]
    assert ride.ok
    energy = 0.5 * jnp.sum(ride.end.u**2 * 0.8 ** jnp.arange(5.0))
    np.testing.assert_allclose(energy, 0.5, rtol=1e-12)
    np.testing.assert_allclose(jnp.sum(ride.end.u * 0.8 ** jnp.arange(5.0)), 1.0, rtol=1e-12)


class BallOnABall(jk.System):
    """Two balls of 1 kg without a size, above each other. The lower one does not bounce."""

    coordinates, speeds = ("low", "high"), ("low_dot", "high_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[i] * N.y, u[i] * N.y), name=f"ball {i}") for i in range(2)])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def contacts(self, t, q, u, motion):
        balls = jk.Contact(gap=q["high"] - q["low"], restitution=0.5)
        return {"balls": balls, "floor": jk.Contact(gap=q["low"])}


@pytest.mark.weekly
def test_bounces_on_a_body_at_rest_end():
    """Without contacts, both balls would fall alike. The acceleration toward the lower one is due to its contact."""
    ride = jk.simulate(BallOnABall(), jk.State({"high": 1.0}, {}), jnp.linspace(0, 10, 21))
    assert ride.ok
    np.testing.assert_allclose(jumps_of(ride)[-1], 3 * np.sqrt(2 / 9.81), rtol=1e-11)
    np.testing.assert_array_equal(ride.contacts["balls"][-10:], SLIDES)
    np.testing.assert_allclose(end_of(ride), 0.0, atol=1e-12)


# -- In space.
class Particle(jk.System):
    """A particle over a plane through O, whose normal is N.z. Gravity has a component along N.x."""

    friction: jk.Scalar = jk.parameter(0.5)
    restitution: jk.Scalar = jk.parameter(0.5)
    slope: jk.Scalar = jk.parameter(0.0, unit="rad")
    coordinates, speeds = ("x", "y", "z"), ("vx", "vy", "vz")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(*q), N.vector(*u))
        return jk.Motion([jk.Body(1.0, 0.0, P, name="particle")], points={"P": P})

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        return jk.weight(motion, 9.81 * (jnp.sin(self.slope) * N.x - jnp.cos(self.slope) * N.z))

    def contacts(self, t, q, u, motion):
        law = {"restitution": self.restitution, "friction": self.friction}
        return {"plane": jk.Contact(motion["P"], motion.N.z, **law)}


@pytest.mark.weekly
def test_a_particle_on_a_slope_changes_the_direction_of_its_slip():
    """For mu = tan(slope), |v| + v_x is constant: the particle that started sideways ends with half of its speed."""
    rtol = 1e-10
    ts = jnp.linspace(0, 3, 21)
    ride = jk.simulate(Particle(0.5, 0.5, np.arctan(0.5)), jk.State({}, {"vy": 2.0}), ts, **TIGHT)
    speed = np.hypot(ride["vx"], ride["vy"])
    np.testing.assert_allclose(speed + ride["vx"], 2.0, rtol=rtol)
    assert float(ride["vx"][-1]) > 0.99 * 1.0
    np.testing.assert_array_equal(ride.contacts["plane"], SLIDES)
    np.testing.assert_allclose(ride["plane.normal"], 9.81 * np.cos(np.arctan(0.5)), rtol=rtol)


class Driven(Particle):
    """A horizontal force of 5 (0.9 + t) N, whose direction turns with 5 rad/s."""

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        force = 5.0 * (0.9 + t) * (jnp.cos(5.0 * t) * N.x + jnp.sin(5.0 * t) * N.y)
        return jk.weight(motion, -10.0 * N.z), jk.Force(force, motion["particle"])


@pytest.mark.weekly
@pytest.mark.parametrize(("tolerance", "atol"), [(1e-6, 1e-5), (1e-8, 1e-7), (1e-10, 1e-9)])
def test_slip_begins_with_zero_acceleration(tolerance, atol):
    """Static equals kinetic friction. In polar coordinates of the slip, by SciPy's Radau with 1e-11.

    s' = f cos(5 t - theta) - mu g,  theta' = f sin(5 t - theta) / s,  from s = 5/2 (t - 0.1)^2
    """
    options = {"rtol": tolerance, "atol": tolerance, "adjoint": "forward"}

    def speeds(friction):
        ride = jk.simulate(Driven(friction, 0.0), jk.State({}, {}), jnp.linspace(0, 0.6, 21), **options)
        return ride.u, ride

    slopes, ride = jax.jit(jax.jacfwd(speeds, has_aux=True))(0.5)
    # By central differences of fourth order with tolerances of 1e-12.
    np.testing.assert_allclose(slopes[-1, :2], [3.17694607, -3.04133415], rtol=0, atol=10 * atol)
    np.testing.assert_allclose(ride.jumps.t[0], 0.1, atol=1e-12)
    np.testing.assert_allclose(ride.end.u[:2], [-0.5208914533291, 0.2588472904328], atol=atol)
    assert int(ride.stats["steps"]) < 1000  # there were 600 000, and an error of 3e-6, with the direction v / |v|


class SlipperyBox(Box):
    friction: jk.Scalar = jk.parameter(0.4)

    def contacts(self, t, q, u, motion):
        law = {"friction": self.friction, "restitution": 0.2}
        return {f"{i}": jk.Contact(motion[f"{i}"], motion.N.z, **law) for i in range(self.corners)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("corners", "friction", "q", "u"),
    [
        (1, 0.42, [0.5, 0.12, -0.25, 0.2], [0.4, -0.3, 0.1, 0.8, -1.1, 0.6]),
        (4, 0.57, [0.35, 0.21, 0.13, -0.08], [-0.2, 0.5, 0.1, 0.7, 0.9, -0.4]),
    ],
)
def test_derivatives_of_a_box_that_lands_and_slides(corners, friction, q, u):
    """By the friction, against central differences. The four corners have more contact forces than equations."""

    def end(friction, rtol):
        box, start = SlipperyBox(corners=corners, friction=friction), jk.State([0.0, 0.0, *q], u)
        ride = jk.simulate(box, start, jnp.linspace(0.0, 1.0, 3), rtol=rtol, atol=rtol, max_jumps=300)
        return ride.q[-1], ride.ok

    slope, ok = jax.jit(jax.jacfwd(lambda x: end(x, 1e-9), has_aux=True))(friction)
    accurate, h = jax.jit(lambda x: end(x, 1e-11)[0]), 1e-5
    assert ok
    np.testing.assert_allclose(slope, (accurate(friction + h) - accurate(friction - h)) / (2 * h), rtol=0, atol=1e-6)


class Billiard(jk.System):
    """A ball of 1 kg on a table. Its attitude is not a coordinate."""

    radius: jk.Scalar = jk.parameter(0.1, unit="m")
    friction: jk.Scalar = jk.parameter(0.2)
    restitution: jk.Scalar = jk.parameter(0.0)
    coordinates, speeds = ("x", "y", "z"), ("vx", "vy", "vz", "wx", "wy", "wz")

    def q_dot(self, t, q, u):
        return u["vx":"vz"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        w = N.vector(*u["wx":"wz"])
        C = O.moving(N.vector(*q["x":"z"]), N.vector(*u["vx":"vz"]))
        I = 0.4 * self.radius**2
        bottom = jk.Point.at(C.velocity + w.cross(-self.radius * N.z))
        return jk.Motion([jk.Body(1.0, (I, I, I), C, N, w, name="ball")], points={"bottom": bottom})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.z)

    def contacts(self, t, q, u, motion):
        law = {"friction": self.friction, "restitution": self.restitution}
        return {"table": jk.Contact(motion["bottom"], motion.N.z, gap=q["z"] - self.radius, **law)}


@pytest.mark.weekly
def test_a_billiard_ball_with_side_spin():
    """The slip keeps its direction e and vanishes after 2 s0 / (7 mu g): v = v0 - (2/7) s0 e."""
    atol = 1e-9
    start = jk.State({"z": 0.1}, {"vx": 2.0, "vy": 0.5, "wx": 30.0, "wy": -12.0, "wz": 8.0})
    ride = jk.simulate(Billiard(), start, jnp.linspace(0, 1, 21), **TIGHT)
    # v + w x (-r N.z) = (vx - r wy, vy + r wx)
    v0, s0 = np.array([2.0, 0.5]), np.array([2.0 + 0.1 * 12.0, 0.5 + 0.1 * 30.0])
    t = 2 * np.linalg.norm(s0) / (7 * 0.2 * 9.81)
    v = v0 - 2 / 7 * s0
    np.testing.assert_allclose(jumps_of(ride), [t], atol=atol)
    np.testing.assert_allclose(ride.end.u, [*v, 0.0, -v[1] / 0.1, v[0] / 0.1, 8.0], atol=atol)
    np.testing.assert_allclose(ride.end.q[:3], [*((v0 + v) / 2 * t + v * (1 - t)), 0.1], atol=atol)
    np.testing.assert_array_equal(ride.contacts["table"], np.where(ride.t < t, SLIDES, STICKS))
    # An impact with 2 m/s and e = 1/2: the normal impulse is 3, and the tangential one 0.1 3 if it slides on, else
    # that which stops the slip.
    u = {"vx": 3.0, "vy": 1.0, "vz": -2.0, "wx": 5.0, "wy": -10.0, "wz": 3.0}
    slip = np.array([3.0 + 1.0, 1.0 + 0.5])
    for mu, impulse in ((0.1, -0.3 * slip / np.linalg.norm(slip)), (0.9, -2 / 7 * slip)):
        ride = jk.simulate(Billiard(0.1, mu, 0.5), jk.State({"z": 0.1}, u), jnp.linspace(0, 0.1, 21), **TIGHT)
        np.testing.assert_allclose(ride.jumps.after.u[0, :3], [*(np.array([3.0, 1.0]) + impulse), 1.0], atol=atol)
        spin = np.array([5.0, -10.0]) + np.array([impulse[1], -impulse[0]]) * 0.1 / 0.004
        np.testing.assert_allclose(ride.jumps.after.u[0, 3:], [*spin, 3.0], atol=atol)


# -- Bodies that touch.
class Cradle(jk.System):
    """Balls on strings of 0.5 m, without gaps between them."""

    n = 3
    coordinates, speeds = ("a", "b", "c"), ("a_dot", "b_dot", "c_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        strings = [N.rotate(3, angle, rate) for angle, rate in zip(q, u, strict=True)]
        bobs = [O.fixed(0.05 * i * N.x).fixed(-0.5 * string.y) for i, string in enumerate(strings)]
        return jk.Motion([jk.Body(0.1, 0.0, bob, name=f"ball {i}") for i, bob in enumerate(bobs)])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def contacts(self, t, q, u, motion):
        balls = [body.center for body in motion.bodies]
        gaps = [(balls[i + 1].position_from(balls[i])).norm() - 0.05 for i in range(self.n - 1)]
        return {f"{i}": jk.Contact(gap=gap, restitution=1.0) for i, gap in enumerate(gaps)}


class LongCradle(Cradle):
    n = 9
    coordinates, speeds = tuple("abcdefghi"), tuple(f"{name}_dot" for name in "abcdefghi")


@pytest.mark.parametrize("kind", [Cradle, LongCradle])
@pytest.mark.slow_cases("LongCradle")
def test_as_many_balls_leave_newtons_cradle_as_arrive(kind):
    n, ts = kind.n, jnp.array([0.0, 0.5])
    run = jax.jit(lambda q: jk.simulate(kind(), jk.State(q, jnp.zeros(n)), ts, max_jumps=500))
    together = run(jnp.full(n, 0.3))
    assert together.ok
    assert int(together.stats["steps"]) < 100  # they ended with "max steps"
    np.testing.assert_allclose(together.end.q, together.end.q[0], rtol=1e-9)
    for lifted in (1, 2):
        ride = run(jnp.where(np.arange(n) < lifted, -0.5, 0.0))
        assert ride.ok
        np.testing.assert_allclose(ride.end.q[: n - lifted], 0.0, atol=1e-7)
        assert (ride.end.q[n - lifted :] > 0.1).all()
        np.testing.assert_allclose(ride.jumps.energy[: int(ride.jumps.count)], 0.0, atol=1e-12)


class NoContacts(jk.System):
    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="mass")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(-q["x"] * motion.N.x, motion["mass"])

    def contacts(self, t, q, u, motion):
        return {}


def test_contacts_may_be_empty():
    ride = jk.simulate(NoContacts(), jk.State({"x": 1.0}, {}), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(ride.end.q, np.cos(1.0), rtol=1e-6)
    np.testing.assert_allclose(jk.stability.linearize(NoContacts(), jk.State({}, {})).A, [[0, 1], [-1, 0]], atol=1e-15)


# -- A box in space.
@pytest.mark.slow
def test_the_direction_of_a_slip_that_ends_needs_no_small_steps():
    """Starts that differ by a rounding error took 350 or 9600 steps."""

    @jax.jit
    @jax.vmap
    def run(vx):
        q, u = jnp.array([0.0, 0.0, 0.5, 0.1, 0.2, 0.15]), jnp.array([0.0, 0.0, 0.0, 0.3, 0.0, 1.0])
        return jk.simulate(Box(), jk.State(q, u.at[0].set(vx)), jnp.linspace(0.0, 1.0, 11))

    rides = run(0.5 + 1e-3 * jnp.arange(8.0))
    np.testing.assert_array_equal(rides.status, 0)
    assert rides.stats["steps"].max() < 600


@pytest.mark.weekly
@pytest.mark.parametrize(("corners", "tilt", "n_rides"), [(4, 0.3, 8), (8, 1.2, 3)])
def test_a_box_on_its_corners_comes_to_rest(corners, tilt, n_rides):
    """Impulses push and are within the friction cone. Energy is lost, except what Newton's law adds."""

    @jax.jit
    def run(q, u):
        return jk.simulate(Box(corners), jk.State(q, u), jnp.linspace(0.0, 2.0, 21), max_jumps=400)

    rng = np.random.default_rng(1)
    for _ in range(n_rides):
        q, u = np.append([0.0, 0.0, 0.5], rng.uniform(-tilt, tilt, 3)), rng.normal(size=6) * [0.5, 0.5, 0.2, 1, 1, 1]
        ride = run(jnp.array(q), jnp.array(u))
        assert ride.ok, ride.reason
        n = int(ride.jumps.count)
        impulses = np.asarray(ride.jumps.impulses[:n]).reshape(n, corners, 3)
        assert (impulses[..., 0] >= -1e-12).all()
        assert (np.hypot(impulses[..., 1], impulses[..., 2]) <= 0.4 * impulses[..., 0] + 1e-9).all()
        np.testing.assert_allclose(ride.end.u, 0.0, atol=1e-6)
        np.testing.assert_allclose(np.min(np.abs(np.array([0.1, 0.2, 0.3]) - ride.end.q[2])), 0.0, atol=1e-6)
        assert jk.audit(Box(corners), ride).ok


@pytest.mark.weekly
def test_the_handlebar_of_a_falling_bicycle_slips_in_a_stiff_direction():
    """The mobilities of the contact are 2.6e-8, 0.0117 and 0.657. A grid of directions misses the solution."""

    class Falling(jk.catalog.WhippleBicycle):
        def motion(self, t, q, u):
            motion = super().motion(t, q, u)
            fork = motion["fork"]
            return motion.extended([], points={"right": fork.center.fixed(0.3 * fork.frame.y - 0.25 * fork.frame.z)})

        def contacts(self, t, q, u, motion):
            return {"right": jk.Contact(motion["right"], -1.0 * motion.N.z, restitution=0.3, friction=0.5)}

    bicycle = Falling.benchmark()
    start = jk.assemble(bicycle, {"roll": 0.4}, {"rear_wheel_rate": -1.0 / bicycle.rR, "roll_rate": 1.0})
    hold = {"steer_torque": lambda t, state: -60.0 * state["steer"] - 6.0 * state["steer_rate"]}
    ride = jk.simulate(bicycle, start, jnp.linspace(0.0, 0.45, 46), hold, max_jumps=200)
    assert ride.ok
    np.testing.assert_allclose(jumps_of(ride)[0], 0.40920, atol=1e-5)
    # by an independent solution of the laws
    np.testing.assert_allclose(jnp.abs(ride.jumps.impulses[0]), [374.757745, 163.381180, 91.746564], rtol=1e-5)
    np.testing.assert_allclose(ride.jumps.energy[0], 532.0, atol=0.5)
