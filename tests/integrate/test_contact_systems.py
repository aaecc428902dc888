"""Contacts of several bodies, of a block with two corners, in space, and of mechanisms with loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._integrate.contact_jumps import ContactEvent, _states_by_accelerations
from jaxkane._kane.contact import ContactMemory, layout_of, terms_at
from jaxkane.catalog import RockingBlock

TIGHT = {"rtol": 1e-12, "atol": 1e-12}
OPEN, SLIDES, STICKS = 0, 1, 2


def end_of(ride):
    return np.concatenate([ride.end.q, ride.end.u])


def jumps_of(ride):
    """The times of the jumps that exist."""
    return np.asarray(ride.jumps.t)[: int(ride.jumps.count)]


# -- A block with two corners.
def tilted(angle, width=0.4, height=1.2, **speeds):
    """A block that stands on one corner. A positive angle lifts the right corner."""
    side = np.sign(angle) * width / 2
    y = side * np.sin(angle) + height / 2 * np.cos(angle)
    return jk.State({"x": -height / 2 * np.sin(angle) + side * np.cos(angle) - side, "y": y, "angle": angle}, speeds)


@pytest.mark.weekly
def test_a_rocking_block_agrees_with_the_closed_form():
    # Quadrature; the energy ratio of an impact is r^2 with r = 1 - 3/2 sin^2(alpha).
    atol = 1e-10
    ride = jk.simulate(RockingBlock(friction=2.0), tilted(0.25), jnp.linspace(0, 2.2, 21), **TIGHT)
    np.testing.assert_allclose(jumps_of(ride), [0.6402887800202485, 1.338581180728541, 1.8563203472495828], atol=atol)
    np.testing.assert_allclose(
        ride.jumps.after.u[:3, 2], [-0.9051977448109763, 0.7694180830893298, -0.6540053706259303], atol=atol
    )
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
        return jk.simulate(block, start, jnp.linspace(0, 3, 21), adjoint="forward", **TIGHT).jumps.t[5]

    p = jnp.array([0.2, 0.6, 0.25])
    np.testing.assert_allclose(sixth(p), 2.8724483216639736, atol=1e-10)
    expected = [-19.85579741496443, 9.012306073041456, 6.863674401308323]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(sixth))(p), expected, rtol=1e-8)


@pytest.mark.slow
def test_both_corners_of_a_wide_block_stick():
    """It falls on its whole base and stays there. Its Delassus matrix is singular: four rows, three speeds."""
    wide = RockingBlock(0.6, 0.3, friction=2.0)
    ride = jk.simulate(wide, tilted(0.1, 1.2, 0.6), jnp.linspace(0, 100, 21), **TIGHT)
    assert ride.ok
    assert int(ride.jumps.count) == 1
    for name in ("left", "right"):
        np.testing.assert_array_equal(ride.contacts[name][1:], STICKS)
        # 100 s at rest: the block does not sink, and both corners carry half of its weight.
        np.testing.assert_allclose(ride[f"{name}.normal"][1:], 9.81 / 2, rtol=1e-10)
    np.testing.assert_allclose(ride["y"][1:], 0.3, atol=1e-12)
    np.testing.assert_allclose([ride["x"][1:] - ride["x"][1], ride["angle"][1:]], 0.0, atol=1e-12)


def test_a_block_slides_on_both_corners():
    block = RockingBlock(friction=0.2)
    ride = jk.simulate(block, jk.State({"y": 0.6}, {"x_dot": 1.0}), jnp.linspace(0, 2, 21), **TIGHT)
    stops = 1 / (0.2 * 9.81)
    np.testing.assert_allclose(jumps_of(ride), [stops], atol=1e-10)
    np.testing.assert_allclose(end_of(ride), [stops / 2, 0.6, 0, 0, 0, 0], atol=1e-10)
    # Moments about the mass centre: (N_left - N_right) b = mu m g h
    slides = np.asarray(ride.t) < stops
    difference = np.where(slides, 0.2 * 9.81 * 1.2 / 0.4, 0.0)
    np.testing.assert_allclose((ride["right.normal"] - ride["left.normal"])[slides], difference[slides], rtol=1e-9)
    np.testing.assert_allclose(ride["left.normal"] + ride["right.normal"], 9.81, rtol=1e-10)


@pytest.mark.weekly
def test_random_blocks_satisfy_the_contact_laws():
    rng = np.random.default_rng(1)
    for _ in range(40):
        b, h = rng.choice([0.2, 0.6]), rng.choice([0.3, 0.6])
        mu, e = rng.choice([0.0, 0.1, 0.4, 0.8, 2.0]), rng.choice([0.0, 0.3])
        start = tilted(rng.uniform(-0.5, 0.5), 2 * b, 2 * h, rate=rng.choice([0.0, 1.0, -2.0]))
        q = {**start.q, "y": start.q["y"] + rng.choice([1e-3, 0.2])}
        block = RockingBlock(b, h, friction=mu, restitution=e)
        ride = jk.simulate(block, jk.State(q, start.u), jnp.linspace(0, 0.97, 21), **TIGHT)
        if ride.reason == "max jumps":  # e.g. infinitely many bounces of one corner between those of the other one
            continue
        assert ride.ok
        assert np.all(np.diff(jumps_of(ride)) >= 0)
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
    """Two independent points of 1 kg over a floor."""

    coordinates, speeds = ("x1", "y1", "x2", "y2"), ("x1_dot", "y1_dot", "x2_dot", "y2_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        points = [O.moving(q[i] * N.x + q[i + 1] * N.y, u[i] * N.x + u[i + 1] * N.y) for i in (0, 2)]
        bodies = [jk.Body(1.0, 0.0, point, name=f"body {i}") for i, point in enumerate(points)]
        return jk.Motion(bodies, points={f"point {i}": point for i, point in enumerate(points)})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -10.0 * motion.N.y)

    def contacts(self, t, q, u, motion):
        return {name: jk.Contact(motion[name], motion.N.y, friction=0.5) for name in ("point 0", "point 1")}


def test_a_point_that_stops_does_not_stop_another_point():
    """The contact states after the first point comes to rest, while the other one slides with 2 m/s. A simulation of
    both points takes 17 s, nearly all of it for compilation."""
    system, zero, no = TwoPoints(), jnp.zeros(()), jnp.zeros(2, bool)
    slides = ContactMemory(jnp.full(2, float(SLIDES)), jnp.ones((2, 1)), jnp.zeros((2, 0)))
    stops = ContactEvent(no, no, no, jnp.array([True, False]), jnp.array(True), jnp.array(False))
    layout, terms = layout_of(system), terms_at(system, zero, jnp.zeros(4), jnp.array([0.0, 0.0, 2.0, 0.0]), {})

    @jax.jit
    def changed(terms):
        negligible, tolerances, delays = jnp.zeros((2, 2)), (1e-6, 1e-6), jnp.zeros(2)
        return _states_by_accelerations(layout, terms, slides, ~no, no, stops, negligible, tolerances, delays)

    memory, is_determined = changed(terms)
    assert is_determined
    assert memory.states.tolist() == [STICKS, SLIDES]
    assert memory.directions[:, 0].tolist() == [0.0, 1.0]


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
def test_sequential_and_simultaneous_impacts_of_balls():
    atol = 1e-12
    start = jk.State({"b": 1.0, "c": 2.0, "d": 3 + 1 / 7, "e": 4.0}, {"a_dot": 1.0})
    ride = jk.simulate(BallsInARow(), start, jnp.linspace(0, 5, 21), **TIGHT)
    np.testing.assert_allclose(jumps_of(ride), [1.0, 37 / 19, 7513 / 2527, 177739 / 48013], atol=atol)
    np.testing.assert_allclose(
        ride.end.u, [7 / 45, 133 / 810, 2527 / 14580, 48013 / 262440, 130321 / 104976], atol=atol
    )
    # Three balls that touch: one impact of both contacts, with v = (1, 0, 0) and masses 1, 4/5, 16/25.
    touching = jk.State(jnp.array([0.0, 1.0, 1.0, 5.0, 9.0]), jnp.eye(5)[0])
    ride = jk.simulate(BallsInARow(1.0), touching, jnp.linspace(0, 2, 21), **TIGHT)
    rest = 2 / (1 + 1.44)
    np.testing.assert_allclose(ride.end.u, [rest - 1, rest, rest, 0, 0], atol=atol)
    assert int(ride.jumps.count) == 1
    # Gaps that differ by 1e-13: two events at almost the same time.
    ride = jk.simulate(
        BallsInARow(1.0), jk.State(touching.q.at[2].add(1e-13), touching.u), jnp.linspace(0, 2, 21), **TIGHT
    )
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


@pytest.mark.weekly
def test_a_particle_bounces_and_stops_in_space():
    """Impulses of friction mu L_N along the slip, then friction mu m g until it stops; all along one line."""
    atol = 1e-9
    ride = jk.simulate(
        Particle(0.1, 0.5), jk.State({"z": 1.0}, {"vx": 1.2, "vy": 1.6}), jnp.linspace(0, 3, 21), **TIGHT
    )
    # The figures of a particle with vx = 2 in a plane
    np.testing.assert_allclose(jumps_of(ride)[-1], 1.3545709229571927 + 0.6841650607329194, atol=atol)
    np.testing.assert_allclose(end_of(ride)[:3], [0.6 * 2.138735983690112, 0.8 * 2.138735983690112, 0.0], atol=atol)
    np.testing.assert_array_equal(ride.end.u, 0.0)
    np.testing.assert_array_equal(ride.contacts["plane"], np.repeat([OPEN, SLIDES, STICKS], [10, 4, 7]))


class Driven(Particle):
    """A horizontal force of 5 (0.9 + t) N, whose direction turns with 5 rad/s."""

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        force = 5.0 * (0.9 + t) * (jnp.cos(5.0 * t) * N.x + jnp.sin(5.0 * t) * N.y)
        return jk.weight(motion, -10.0 * N.z), jk.Force(force, motion["particle"])


@pytest.mark.weekly
@pytest.mark.parametrize(("tolerance", "atol"), [(1e-6, 1e-6), (1e-10, 1e-9)])
def test_slip_begins_with_zero_acceleration(tolerance, atol):
    """Static equals kinetic friction. In polar coordinates of the slip, by SciPy's Radau with 1e-11.

    s' = f cos(5 t - theta) - mu g,  theta' = f sin(5 t - theta) / s,  from s = 5/2 (t - 0.1)^2
    """
    options = {"rtol": tolerance, "atol": tolerance, "adjoint": "forward"}

    def speeds(friction):
        ride = jk.simulate(Driven(friction, 0.0), jk.State({}, {}), jnp.linspace(0, 0.6, 21), **options)
        return ride.u, ride

    slopes, ride = jax.jit(jax.jacfwd(speeds, has_aux=True))(0.5)
    np.testing.assert_array_equal(np.isnan(slopes).any(axis=1), ride.t > 0.1)  # correct derivatives or none
    np.testing.assert_allclose(ride.jumps.t[0], 0.1, atol=1e-12)
    np.testing.assert_allclose(ride.end.u[:2], [-0.5208914533291, 0.2588472904328], atol=atol)
    assert int(ride.stats["steps"]) < 1000  # there were 600 000, and an error of 3e-6, with the direction v / |v|


class Billiard(jk.System):
    """A ball of 1 kg on a table. Its attitude has Euler parameters."""

    radius: jk.Scalar = jk.parameter(0.1, unit="m")
    friction: jk.Scalar = jk.parameter(0.2)
    coordinates, speeds = ("x", "y", "z", "e1", "e2", "e3", "e4"), ("vx", "vy", "vz", "wx", "wy", "wz")
    dependent_coordinates = ("e4",)

    def configuration_constraints(self, t, q):
        return [sum(e**2 for e in q["e1":"e4"]) - 1.0]

    def q_dot(self, t, q, u):
        N, _ = jk.inertial()
        B = N.rotate_euler(q["e1":"e4"], N.vector(*u["wx":"wz"]), "B")
        w = B.angular_velocity.components_in(B)
        return (*u["vx":"vz"], *jk.rotations.euler_parameter_rates(q["e1":"e4"], w))

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate_euler(q["e1":"e4"], N.vector(*u["wx":"wz"]), "B")
        C = O.moving(N.vector(*q["x":"z"]), N.vector(*u["vx":"vz"]))
        I = 0.4 * self.radius**2
        return jk.Motion([jk.Body(1.0, (I, I, I), C, B, name="ball")], points={"C": C}, frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.z)

    def contacts(self, t, q, u, motion):
        bottom = motion["C"].fixed(-self.radius * motion.N.z, motion["B"])
        return {"table": jk.Contact(bottom, motion.N.z, friction=self.friction)}


@pytest.mark.weekly
def test_a_billiard_ball_with_side_spin():
    """The slip keeps its direction e and vanishes after 2 s0 / (7 mu g): v = v0 - (2/7) s0 e."""
    atol = 1e-9
    start = jk.State({"z": 0.1, "e4": 1.0}, {"vx": 2.0, "vy": 0.5, "wx": 30.0, "wy": -12.0, "wz": 8.0})
    ride = jk.simulate(Billiard(), start, jnp.linspace(0, 1, 21), **TIGHT)
    # v + w x (-r N.z) = (vx - r wy, vy + r wx)
    v0, s0 = np.array([2.0, 0.5]), np.array([2.0 + 0.1 * 12.0, 0.5 + 0.1 * 30.0])
    t = 2 * np.linalg.norm(s0) / (7 * 0.2 * 9.81)
    v = v0 - 2 / 7 * s0
    np.testing.assert_allclose(jumps_of(ride), [t], atol=atol)
    np.testing.assert_allclose(ride.end.u, [*v, 0.0, -v[1] / 0.1, v[0] / 0.1, 8.0], atol=atol)
    np.testing.assert_allclose(ride.end.q[:3], [*((v0 + v) / 2 * t + v * (1 - t)), 0.1], atol=atol)
    np.testing.assert_array_equal(ride.contacts["table"], np.where(ride.t < t, SLIDES, STICKS))


# -- Stops and loops.
