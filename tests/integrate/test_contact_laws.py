"""Contacts and dry friction: touch-down, impact, rest, slip, stick and lift-off, with derivatives.

Unless a test states another source, its figures were computed without this library: closed forms with 30 digits, or
integration in 40 digits.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Sled

import jaxkane as jk
from jaxkane.catalog import Belt

TIGHT = {"rtol": 1e-12, "atol": 1e-12}
OPEN, SLIDES, STICKS = 0, 1, 2


def simulate_with_slopes(system_at, state_at):
    """(p, ts, inputs, ...) -> derivatives by p of the end, the times of the jumps and q; and the trajectory.

    One program for all parameters, initial states, times and values of inputs.
    """

    @jax.jit
    def run(p, ts, inputs=None):
        def results(p):
            ride = jk.simulate(system_at(p), state_at(p), ts, inputs, adjoint="forward", **TIGHT)
            end = jnp.concatenate([ride.end.q, ride.end.u])
            return {"end": end, "t": ride.jumps.t, "q": ride.q}, ride

        return jax.jacfwd(results, has_aux=True)(p)

    return run


def end_of(ride):
    return np.concatenate([ride.end.q, ride.end.u])


# -- A ball in air (figures of a closed form).
# -- A rod with a round end, in a plane over a table. A ball has no length, a particle has no radius either.
class RoundRod(jk.System):
    """The table may oscillate along y and move along x. A horizontal force acts on the mass centre."""

    restitution: jk.Scalar = jk.parameter()
    friction: jk.Scalar = jk.parameter()
    static: jk.Scalar = jk.parameter()
    drag: jk.Scalar = jk.parameter(unit="kg/m")
    radius: jk.Scalar = jk.parameter(unit="m")
    length: jk.Scalar = jk.parameter(unit="m")
    mass: jk.Scalar = jk.parameter(unit="kg")
    inertia: jk.Scalar = jk.parameter(unit="kg m^2")
    gravity: jk.Scalar = jk.parameter(unit="m/s^2")
    shake: jk.Scalar = jk.parameter(unit="m")  # at SHAKE rad/s
    belt: jk.Scalar = jk.parameter(unit="m/s")
    change: jk.Scalar = jk.parameter(unit="1/s")  # the restitution grows, the friction decreases
    coordinates, speeds, inputs = ("x", "h", "angle"), ("vx", "vy", "w"), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["w"], "B")
        C = O.moving(q["x"] * N.x + q["h"] * N.y, u["vx"] * N.x + u["vy"] * N.y)
        rise, rate = self.shake * jnp.sin(SHAKE * t), self.shake * SHAKE * jnp.cos(SHAKE * t)
        table = O.moving(self.belt * t * N.x + rise * N.y, self.belt * N.x + rate * N.y)
        end = C.fixed(-self.length * B.y - self.radius * N.y, B)
        body = jk.Body(self.mass, (self.inertia,) * 3, C, B, name="rod")
        return jk.Motion([body], points={"end": end, "table": table})

    def loads(self, t, q, u, motion, inputs):
        square = u["vx"] ** 2 + u["vy"] ** 2
        speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        N = motion.N
        resistance = -self.drag * speed * (u["vx"] * N.x + u["vy"] * N.y)
        return jk.weight(motion, -self.gravity * N.y), jk.Force(resistance + inputs["push"] * N.x, motion["rod"])

    def contacts(self, t, q, u, motion):
        more, less = 1.0 + self.change * t, 1.0 - self.change * t
        law = {"restitution": self.restitution * more, "friction": self.friction * less, "static": self.static * less}
        return {"table": jk.Contact(motion["end"], motion.N.y, surface=motion["table"], **law)}


SHAKE = 20.0
NAMES = ("restitution", "friction", "static", "drag", "radius", "length", "mass", "inertia", "gravity", "shake", "belt")
NAMES += ("change",)
NAMES += ("x", "h", "angle", "vx", "vy", "w")
ROD = {"mass": 1.0, "inertia": 1.0, "gravity": 10.0}
rod = simulate_with_slopes(lambda p: RoundRod(*p[:12]), lambda p: jk.State(p[12:15], p[15:]))
ON_AND_OFF = jnp.arange(4.0)


def ride_of(ts, push=(0.0, 0.0, 0.0, 0.0), since=ON_AND_OFF, **values):
    """A simulation, and its derivatives by name. `push`: the force from each of the four times `since`.

    The static friction is the kinetic one by default.
    """
    values = {**ROD, **values}
    values.setdefault("static", values.get("friction", 0.0))
    p = jnp.array([values.get(name, 0.0) for name in NAMES])
    samples = jk.Samples(jnp.asarray(since), jnp.asarray(push, float), zero_order_hold=True)
    slopes, ride = rod(p, jnp.asarray(ts), {"push": samples})
    by_name = {name: {key: x[..., i] for key, x in slopes.items()} for i, name in enumerate(NAMES)}
    return ride, by_name


def jumps_of(ride):
    """The times of the jumps that exist."""
    return np.asarray(ride.jumps.t)[: int(ride.jumps.count)]


@pytest.mark.weekly
def test_a_ball_with_spin_drag_and_friction():
    # Extrapolation in 40 digits; derivatives by differences of the fourth order.
    atol, slope_rtol = 1e-10, 1e-8
    ball = {"mass": 0.15, "radius": 0.1, "inertia": 0.4 * 0.15 * 0.1**2, "drag": 0.02, "gravity": 9.81}
    start = {"h": 1.2, "vx": 2.0, "w": 30.0}
    ride, slopes = ride_of(np.linspace(0, 4.5, 21), restitution=0.85, friction=0.12, **ball, **start)
    state = [1.9966866161600083, 0.10035587197890085, 12.453830972876581, 0.18055590231948473, 0.07048186156355336]
    np.testing.assert_allclose(end_of(ride), [*state, -1.8057514907367946], atol=atol)
    times = [0.4890494647109329, 1.1999370532175246, 1.764264364453777, 2.223539147388193, 2.6026794679467793]
    times += [2.9185221893897166, 3.183224798910551, 3.4059797827390077, 3.5939684832227634, 3.752933945687954]
    np.testing.assert_allclose(jumps_of(ride)[:10], times, atol=atol)
    normal = [1.1887059096699417, 0.9278632515674384, 0.7484259579203826, 0.6144185061346573, 0.5099882203998913]
    tangential = [-0.142644709160393, -0.05128041211663547, 0.001005614329657916, 0.0006331188678131941]
    np.testing.assert_allclose(ride.jumps.impulses[:5, 0], normal, atol=atol)
    np.testing.assert_allclose(ride.jumps.impulses[:4, 1], tangential, atol=atol)
    by_e = [-0.7727091201694073, -1.6285260153964083, 2.83391684025877, -0.33144723525634073, 230.6189627440025]
    by_mu = [-2.160616763736638, -0.008926455340241727, -170.51801247731478, 0.7964358655504336, 1.243808070281746]
    by_c = [-52.76546197298989, 2.6498237638708435, 454.5810426253596, -11.21906764805386, -370.90552907031764]
    by_w = [-0.07917053308221941, -6.592576295884813e-05, 2.010863494125033, -0.02168258828154593, 0.00932039248892157]
    for name, column in {
        "restitution": [*by_e, 4.399003139696671],
        "friction": [*by_mu, -7.959974320216474],
        "drag": [*by_c, 110.44509232983519],
        "w": [*by_w, 0.21691134022252684],
    }.items():
        own = slopes[name]["end"] + (slopes["static"]["end"] if name == "friction" else 0.0)
        np.testing.assert_allclose(own, column, rtol=slope_rtol, atol=slope_rtol * np.abs(column).max())
    for name, last in {"restitution": 12.621866972949169, "drag": -28.83558221680791}.items():
        np.testing.assert_allclose(slopes[name]["t"][9], last, rtol=slope_rtol)


BACKSPIN = {
    "disk": (0.5, 1.1892626571525653, 2.7208064333446593, -14.41612866689319),
    "hoop": (1.0, 1.783893985728848, 2.1218144750254844, -41.218144750254844),
}
BY_MU_V_W = {
    "disk": (-6.9373655000566306, 1.729754219050855, -0.02702457809491449),
    "hoop": (-15.60907237512742, 1.891946992864424, -0.010805300713557602),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", BACKSPIN)
def test_a_ball_with_backspin_slides_and_then_rolls(kind):
    atol, slope_atol = 1e-10, 1e-8
    k, t_roll, x, angle = BACKSPIN[kind]
    start = {"h": 0.1, "vx": 3.0, "w": 40.0}
    ride, slopes = ride_of(np.linspace(0, 2, 21), friction=0.2, radius=0.1, inertia=0.01 * k, gravity=9.81, **start)
    np.testing.assert_allclose(jumps_of(ride), [t_roll], atol=atol)
    np.testing.assert_allclose([ride.end.q[0], -ride.end.q[2]], [x, angle], atol=atol)
    np.testing.assert_array_equal(ride.contacts["table"], np.where(np.linspace(0, 2, 21) < t_roll, SLIDES, STICKS))
    before = np.linspace(0, 2, 21) < t_roll
    np.testing.assert_allclose(ride["table.normal"], 9.81, rtol=1e-12)
    np.testing.assert_allclose(ride["table.friction"], np.where(before, -0.2 * 9.81, 0.0), atol=1e-12)
    by_mu, by_v, by_w = BY_MU_V_W[kind]
    found = [slopes["friction"]["end"][0] + slopes["static"]["end"][0], slopes["vx"]["end"][0], slopes["w"]["end"][0]]
    np.testing.assert_allclose(found, [by_mu, by_v, by_w], atol=slope_atol)


def test_infinitely_many_bounces_end_at_a_differentiable_time():
    # A particle with e = 0.5, h = 1, vx = 2, mu = 0.1: the closed form of the geometric series.
    atol, slope_atol = 1e-10, 1e-8
    values = {"restitution": 0.5, "friction": 0.1, "gravity": 9.81, "h": 1.0, "vx": 2.0}
    ride, slopes = ride_of(np.linspace(0, 3, 21), **values)
    n = int(ride.jumps.count)
    assert int(ride.status) == 0
    np.testing.assert_allclose(jumps_of(ride)[n - 2], 1.3545709229571927, atol=atol)
    np.testing.assert_allclose(ride.jumps.after.u[n - 2, 0], 0.6711659245789939, atol=atol)
    np.testing.assert_allclose(ride.jumps.after.q[n - 2, 0], 1.9091418459143854, atol=atol)
    np.testing.assert_allclose(jumps_of(ride)[n - 1], 1.3545709229571927 + 0.6841650607329194, atol=atol)
    np.testing.assert_allclose(end_of(ride)[[0, 1]], [2.138735983690112, 0.0], atol=atol)
    for name, slope in {
        "h": 0.6772854614785964,
        "gravity": -0.06904031207732889,
        "restitution": 3.612189127885847,
    }.items():
        np.testing.assert_allclose(slopes[name]["t"][n - 2], slope, atol=slope_atol)
    np.testing.assert_array_equal(ride.contacts["table"], np.repeat([OPEN, SLIDES, STICKS], [10, 4, 7]))


@pytest.mark.parametrize("duration", [10.0, 100.0])
def test_the_end_of_infinitely_many_bounces_does_not_depend_on_the_duration(duration):
    # t = sqrt(2 h / g) (1 + e) / (1 - e),  d t / d e = 2 sqrt(2 h / g) / (1 - e)^2
    rtol, slope_rtol = 1e-12, 1e-10
    ride, slopes = ride_of(np.linspace(0, duration, 21), restitution=0.7, gravity=9.81, h=1.0)
    n, falls = int(ride.jumps.count), np.sqrt(2 / 9.81)
    np.testing.assert_allclose(ride.jumps.t[n - 1], falls * 1.7 / 0.3, rtol=rtol)
    np.testing.assert_allclose(slopes["restitution"]["t"][n - 1], 2 * falls / 0.3**2, rtol=slope_rtol)
    np.testing.assert_allclose(slopes["h"]["t"][n - 1], falls / 2 * 1.7 / 0.3, rtol=slope_rtol)


def test_restitution_is_relative_to_a_moving_surface():
    # A ball falls on a table that rises: v+ - s' = -e (v- - s') and m (v+ - v-) = L at the time of the impact.
    rtol = 1e-10
    ride, slopes = ride_of(np.linspace(0, 0.4, 21), restitution=0.6, shake=0.02, h=0.3)
    t, before, after = ride.jumps.t[0], ride.jumps.before.u[0, 1], ride.jumps.after.u[0, 1]
    rate = 0.02 * SHAKE * np.cos(SHAKE * t)
    np.testing.assert_allclose(0.3 - 5.0 * t**2, 0.02 * np.sin(SHAKE * t), atol=1e-13)
    np.testing.assert_allclose(before, -10.0 * t, rtol=rtol)
    np.testing.assert_allclose(after - rate, -0.6 * (before - rate), rtol=rtol)
    np.testing.assert_allclose(ride.jumps.impulses[0, 0], after - before, rtol=rtol)
    # d t/d h = 1/(s' - v), from h - g t^2/2 = s(t)
    np.testing.assert_allclose(slopes["h"]["t"][0], 1 / (rate - before), rtol=rtol)


def test_a_particle_lands_on_a_belt_and_sticks():
    # mu = 0.1, drop of 0.3 m, e = 0: the impulse mu m sqrt(2 g h) and then the friction mu m g accelerate it.
    atol = 1e-10
    ride, _ = ride_of(np.linspace(0, 2, 21), friction=0.1, belt=1.43, h=0.3)
    lands = np.sqrt(2 * 0.3 / 10.0)
    first = 0.1 * 10.0 * lands
    sticks = 1.43 / (0.1 * 10.0)
    np.testing.assert_allclose(jumps_of(ride), [lands, sticks], atol=atol)
    np.testing.assert_allclose(ride.jumps.after.u[0], [first, 0.0, 0.0], atol=atol)
    np.testing.assert_allclose(end_of(ride)[0], (1.43**2 - first**2) / 2 + 1.43 * (2 - sticks), atol=atol)
    np.testing.assert_allclose(end_of(ride)[3:5], [1.43, 0.0], atol=1e-13)
    np.testing.assert_array_equal(ride.contacts["table"], np.repeat([OPEN, SLIDES, STICKS], [3, 12, 6]))


def test_a_contact_opens_if_the_table_falls_faster_than_gravity():
    # The force vanishes when the acceleration of the table is -g: sin(w t) = g / (A w^2).
    atol = 1e-10
    ride, slopes = ride_of(np.linspace(0, 0.1, 21), shake=0.05, vy=0.05 * SHAKE, friction=0.3)
    place = 10.0 / (0.05 * SHAKE**2)
    t = np.arcsin(place) / SHAKE
    # The normal force and the limit of the friction vanish together.
    np.testing.assert_allclose(jumps_of(ride), np.full(int(ride.jumps.count), t), atol=atol)
    v, x = 0.05 * SHAKE * np.cos(SHAKE * t), 0.05 * np.sin(SHAKE * t)
    np.testing.assert_allclose(
        end_of(ride)[[1, 4]], [x + v * (0.1 - t) - 5 * (0.1 - t) ** 2, v - 10 * (0.1 - t)], atol=atol
    )
    np.testing.assert_array_equal(ride.contacts["table"], np.where(ride.t < t, STICKS, OPEN))
    expected = np.where(ride.t < t, 10.0 - 0.05 * SHAKE**2 * np.sin(SHAKE * ride.t), 0.0)
    np.testing.assert_allclose(ride["table.normal"], expected, atol=1e-9)
    by_g = 1 / (0.05 * SHAKE**3 * np.cos(SHAKE * t))
    np.testing.assert_allclose(slopes["gravity"]["t"][0], by_g, rtol=1e-8)


def test_a_load_stays_on_a_shaking_table():
    """It neither sinks nor slips: A w^2 = 8 < g. The end of the rod is the contact."""
    atol = 1e-10
    ts = np.linspace(0, 10, 21)
    ride, _ = ride_of(ts, shake=0.02, h=0.7, length=0.5, radius=0.2, vy=0.02 * SHAKE, friction=0.3, vx=0.0)
    assert int(ride.jumps.count) == 0
    np.testing.assert_allclose(ride["h"], 0.7 + 0.02 * np.sin(SHAKE * ts), atol=atol)
    np.testing.assert_allclose([ride["x"], ride["angle"]], 0.0, atol=atol)


def test_slip_stops_and_reverses():
    """A force that changes at given times. Static friction 5 N, kinetic friction 3 N; then both 3 N."""
    atol = 1e-10
    ts = np.linspace(0, 4, 21)
    for static in (0.5, 0.3):
        push = {"push": (2.9, 7.0, -7.0, 0.0), "since": jnp.array([0.0, 0.5, 1.0, 2.0])}
        ride, slopes = ride_of(ts, **push, friction=0.3, static=static)
        # at rest to 0.5 s; a = 4 to 1 s; a = -10 to 1.2 s; a = -4 to 2 s; a = 3 to v = 0
        np.testing.assert_allclose(jumps_of(ride), [0.5, 1.2, 2.0 + 3.2 / 3.0], atol=atol)
        x = 0.5 * 4 * 0.5**2 + 2 * 0.2 - 5 * 0.2**2 - 2 * 0.8**2 - 3.2**2 / 6
        np.testing.assert_allclose(end_of(ride), [x, 0, 0, 0, 0, 0], atol=atol)
        states = np.where((ts < 0.5) | (ts > 2 + 3.2 / 3), STICKS, SLIDES)
        np.testing.assert_array_equal(ride.contacts["table"], states)

        def place(mu):
            """The closed form as a function of the kinetic friction, for g = 10."""
            v = (7 - 10 * mu) * 0.5
            s = v / (7 + 10 * mu)
            back = (7 - 10 * mu) * (1 - s)
            return v * 0.25 + v * s / 2 - back * (1 - s) / 2 - back**2 / (20 * mu)

        slope = (place(0.3 + 1e-6) - place(0.3 - 1e-6)) / 2e-6
        np.testing.assert_allclose(slopes["friction"]["end"][0], slope, rtol=1e-8)
        np.testing.assert_allclose(slopes["static"]["end"], 0.0, atol=1e-9)


def test_slip_stops_and_sticks_below_the_static_friction():
    ride, _ = ride_of(np.linspace(0, 2, 21), push=(-4.0,) * 4, friction=0.3, static=0.5, vx=2.0)
    np.testing.assert_allclose(jumps_of(ride), [2.0 / 7.0], atol=1e-10)
    np.testing.assert_allclose(end_of(ride)[[0, 3]], [2.0 / 7.0, 0.0], atol=1e-10)
    np.testing.assert_allclose(ride["table.friction"][-1], 4.0, rtol=1e-12)


def test_an_input_discontinuity_at_the_time_of_an_impact():
    """A force begins when a particle strikes the table, with friction; and one that ends the sticking."""
    atol = 1e-10
    lands = np.sqrt(0.2)
    since = {"since": jnp.array([0.0, lands, 1.0, 2.0])}
    ride, _ = ride_of(np.linspace(0, 1, 21), push=(0.0, 3.0, 3.0, 0.0), **since, restitution=0.5, friction=0.2, h=1.0)
    bounces = lands * np.array([1.0, 2.0])
    np.testing.assert_allclose(jumps_of(ride)[:2], bounces, atol=atol)
    # At the second impact the slip is 3 (t2 - t1) and the impulse of friction 0.2 (1 + e) e v: it slides on.
    v = 3.0 * lands - 0.2 * 1.5 * 0.5 * 10.0 * lands
    np.testing.assert_allclose(ride.jumps.after.u[:2, 0], [0.0, v], atol=atol)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_painleve_paradox_of_a_sliding_rod(direction):
    """A rod at 0.6 rad slides on its end. For mu = 3 the laws of contact have no solution in one direction.

    G_N + mu G_NT = 1/m + l sin(a) (l sin(a) - mu l cos(a)) / I < 0.
    """
    rod_at = {"length": 0.5, "inertia": 1 / 12, "angle": 0.6, "h": 0.5 * np.cos(0.6), "vx": direction}
    ride, _ = ride_of(np.linspace(0, 0.1, 21), friction=3.0, **rod_at)
    effective = 1 + 3 * np.sin(0.6) * (np.sin(0.6) - direction * 3 * np.cos(0.6))
    expected = jk.Status.UNDETERMINED_CONTACT if effective < 0 else jk.Status.COMPLETED
    assert int(ride.status) == expected
    smooth, _ = ride_of(np.linspace(0, 0.1, 21), friction=0.3, **rod_at)
    assert int(smooth.status) == jk.Status.COMPLETED


def test_a_friction_that_becomes_negative_ends_the_simulation():
    """mu = 0.2 (1 - t): v = 5 - 2 (t - t^2 / 2), until 1 s. It may be negative while the contact is open."""
    ride, slopes = ride_of(np.linspace(0, 2, 21), friction=0.2, vx=5.0, change=1.0)
    assert int(ride.status) == jk.Status.INVALID_COEFFICIENT
    assert ride.reason == "invalid coefficient"
    np.testing.assert_allclose(ride.t_end, 1.0, rtol=1e-11)
    np.testing.assert_allclose(end_of(ride)[[0, 3]], [5.0 - 1.0 + 1.0 / 3.0, 4.0], rtol=1e-9)
    assert np.isnan(slopes["vx"]["end"]).all()
    open_contact, _ = ride_of(np.linspace(0, 2, 21), friction=0.2, restitution=0.8, h=60.0, change=1.0)
    assert open_contact.ok


def test_a_restitution_above_one_ends_the_simulation_at_the_impact():
    """0.8 (1 + t) at sqrt(0.2) s. Otherwise the impact would increase the energy by 3.4 J."""
    ride, slopes = ride_of(np.linspace(0, 2, 21), restitution=0.8, h=1.0, change=1.0)
    assert int(ride.status) == jk.Status.INVALID_COEFFICIENT
    np.testing.assert_allclose(ride.t_end, np.sqrt(0.2), rtol=1e-11)
    np.testing.assert_allclose(end_of(ride)[4], -10.0 * np.sqrt(0.2), rtol=1e-11)
    np.testing.assert_allclose(ride.jumps.energy[:1], 0.0, atol=1e-12)
    assert np.isnan(slopes["h"]["end"]).all()


def test_two_zero_crossings_of_a_gap_in_one_step():
    """A particle leaves the table with 1e-7 m/s and lands after 2e-8 s."""
    ride, _ = ride_of(np.linspace(0, 2, 21), restitution=0.5, friction=0.1, vy=1e-7)
    np.testing.assert_allclose(jumps_of(ride)[:2], 2e-8 * np.array([1.0, 1.5]), rtol=1e-6)
    np.testing.assert_allclose(ride.jumps.impulses[0, 0], 1.5e-7, rtol=1e-6)
    assert ride.contacts["table"][1] == STICKS
    np.testing.assert_allclose(end_of(ride), 0.0, atol=1e-13)


@pytest.mark.parametrize("least", [1e-9, 0.0, -1e-6])
def test_grazing(least):
    """Gravity upward: the least gap of a particle that was thrown down. It strikes only if this gap is negative."""
    ride, slopes = ride_of(np.linspace(0, 1, 21), restitution=0.5, gravity=-10.0, vy=-4.0, h=0.8 + least)
    assert int(ride.status) == 0
    if least >= 0:
        assert int(ride.jumps.count) == 0 or least == 0
        np.testing.assert_allclose(end_of(ride)[[1, 4]], [0.8 + least - 4.0 + 5.0, 6.0], atol=1e-6)  # sqrt(2 g eps)
    else:
        v = np.sqrt(20 * 1e-6)
        np.testing.assert_allclose(ride.jumps.t[:1], 0.4 - v / 10, atol=1e-9)
        np.testing.assert_allclose(ride.jumps.after.u[0, 1], 0.5 * v, rtol=1e-6)
        assert np.isfinite(slopes["h"]["end"][1])


def test_a_sample_at_the_time_of_an_impact_has_the_value_after_the_impact():
    """It has the value after the impact, and no derivative by the height, on which this time depends."""
    ts = np.linspace(0, 1, 21)
    ride, slopes = ride_of(ts, restitution=0.6, h=10.0 / 8)
    np.testing.assert_allclose(ride["vy"], np.where(ts < 0.5 - 1e-9, -10 * ts, 3.0 - 10 * (ts - 0.5)), atol=1e-9)
    nan = np.isnan(slopes["h"]["q"]).any(axis=1)
    assert np.flatnonzero(nan).tolist() == [10]


def test_last_samples_close_to_an_impact():
    for late in (-1e-10, -1e-13, 0.0, 1e-15, 1e-13, 1e-10):
        ride, _ = ride_of(np.linspace(0, 0.5 + late, 21), restitution=0.5, h=10.0 / 8)
        assert int(ride.status) == 0
        assert int(ride.jumps.count) == (late > -1e-12) or late == -1e-13
        assert (float(ride["vy"][-1]) > 0) == (int(ride.jumps.count) == 1)


def test_results_do_not_depend_on_the_units():
    """Lengths in units of 1e-6 and masses in units of 1e3: the same times."""
    first, second = (
        ride_of(np.linspace(0, 2, 21), h=x, gravity=10.0 * x, vx=x, mass=m, inertia=m, restitution=0.7, friction=0.1)[0]
        for x, m in ((1.0, 1.0), (1e-6, 1e3))
    )
    n = 8
    np.testing.assert_allclose(jumps_of(first)[:n], jumps_of(second)[:n], rtol=1e-7)
    np.testing.assert_allclose(end_of(first)[0], 1e6 * end_of(second)[0], rtol=1e-6)
    np.testing.assert_array_equal(first.contacts["table"], second.contacts["table"])


def test_results_do_not_depend_on_the_start_time():
    ts = np.linspace(0, 2, 21)
    ball = {"restitution": 0.6, "friction": 0.1, "radius": 0.1, "inertia": 0.004, "h": 1.0, "w": 20.0}
    ride, _ = ride_of(ts, **ball)
    late, _ = ride_of(ts + 1.7e9, since=ON_AND_OFF + 1.7e9, **ball)
    assert int(late.status) == 0
    np.testing.assert_allclose(jumps_of(late)[:6] - 1.7e9, jumps_of(ride)[:6], atol=5e-7)
    np.testing.assert_allclose(late.q, ride.q, atol=2e-5)
    np.testing.assert_array_equal(late.contacts["table"], ride.contacts["table"])


def laws_of(ride, values):
    """Check the laws of contact at all samples that do not coincide with a discontinuity of the force."""
    v = {**dict.fromkeys(NAMES, 0.0), **ROD, **values}
    assert int(ride.status) == 0
    assert np.isfinite(ride.q).all()
    assert np.all(np.diff(jumps_of(ride), prepend=-1e-15) >= 0)
    t, states = np.asarray(ride.t), np.asarray(ride.contacts["table"])
    reach_x, reach_y = v["length"] * np.cos(ride["angle"]) + v["radius"], v["length"] * np.sin(ride["angle"])
    gap = ride["h"] - reach_x - v["shake"] * np.sin(SHAKE * t)
    rate = ride["vy"] + reach_y * ride["w"] - v["shake"] * SHAKE * np.cos(SHAKE * t)
    slip = ride["vx"] + reach_x * ride["w"] - v["belt"]
    normal, friction = np.asarray(ride["table.normal"]), np.asarray(ride["table.friction"])
    assert np.min(gap) > -1e-9
    closed = states > OPEN
    np.testing.assert_allclose([gap[closed], rate[closed]], 0.0, atol=1e-9)
    np.testing.assert_allclose(slip[states == STICKS], 0.0, atol=1e-9)
    np.testing.assert_array_equal([normal[~closed], friction[~closed]], 0.0)
    assert np.all(normal[closed] > -1e-9)
    static = v.get("static", v["friction"]) if "static" in values else v["friction"]
    assert np.all(np.abs(friction) <= static * normal + 1e-8)
    slides = (states == SLIDES) & (np.abs(slip) > 1e-6)
    kinetic = -np.sign(slip) * v["friction"] * normal
    np.testing.assert_allclose(friction[slides], kinetic[slides], atol=1e-8)
    # Jumps without an impulse do not change the speeds, and impulses push.
    energy = np.asarray(ride.jumps.energy)[: int(ride.jumps.count)]
    impulses = np.asarray(ride.jumps.impulses)[: int(ride.jumps.count)]
    np.testing.assert_allclose(energy[impulses[:, 0] == 0], 0.0, atol=1e-8)
    assert np.all(impulses[:, 0] >= 0)
    assert np.all(np.abs(impulses[:, 1]) <= v["friction"] * impulses[:, 0] + 1e-12)


def random_values(rng, kind):
    friction = rng.choice([0.0, 0.05, 0.3, 0.9])
    values = {
        "restitution": rng.choice([0.0, 0.3, 0.7]),
        "friction": friction,
        "static": friction * rng.choice([1.0, 1.5]),
    }
    values |= {"vx": rng.choice([0.0, 1.0, -2.0]), "w": rng.choice([0.0, 3.0, -10.0]), "vy": rng.choice([0.0, 0.5])}
    values |= {"shake": rng.choice([0.0, 0.005, 0.02, 0.04]), "belt": rng.choice([0.0, 0.0, 0.5, -1.0])}
    drop = rng.choice([1e-3, 0.3])
    if kind == "ball":
        return values | {"radius": 0.1, "inertia": 0.004, "h": 0.1 + drop}
    angle = rng.uniform(-1.0, 1.0)
    rod = {"radius": 0.05, "length": 0.5, "inertia": rng.choice([1 / 12, 0.25]), "angle": angle}
    return values | rod | {"h": 0.05 + 0.5 * np.cos(angle) + drop}


@pytest.mark.weekly
@pytest.mark.parametrize("kind", ["ball", "rod"])
def test_random_simulations_satisfy_the_contact_laws(kind):
    """They land, bounce until they rest, slide, stick, reverse, and lift off, while the force changes at 1 s."""
    rng = np.random.default_rng(7)
    for _ in range(60):
        values, push = random_values(rng, kind), rng.choice([0.0, 2.0, -4.0, 8.0], 4)
        ride, slopes = ride_of(np.linspace(0, 1.63 if kind == "ball" else 0.97, 21), push=push, **values)
        if ride.reason == "max jumps":
            continue
        laws_of(ride, values)
        assert all(np.isfinite(slope["end"]).all() for slope in slopes.values())


ROUNDED = {
    "a ball": {"restitution": 0.7, "h": 0.1, "vy": -1.0, "radius": 0.1, "inertia": 0.004},
    "a fast rod": {"restitution": 0.7, "friction": 0.3, "inertia": 0.25, "angle": 0.6488771128508386, "w": -10.0},
    "an inelastic rod": {"friction": 0.3, "inertia": 0.25, "angle": 0.008209005982792839, "vx": -2.0, "w": -10.0},
}


@pytest.mark.parametrize("kind", ROUNDED)
def test_a_contact_that_closes_at_the_start_has_an_impact(kind):
    """Its impact is the first jump, also if rounding errors make its gap 1e-17 instead of 0."""
    values = ROUNDED[kind]
    if kind != "a ball":
        values = values | {"radius": 0.05, "length": 0.5, "h": 0.05 + 0.5 * np.cos(values["angle"])}
        values |= {"shake": 0.04, "belt": 0.5} if kind == "an inelastic rod" else {}
    ride, _ = ride_of(np.linspace(0, 0.5, 21), **values)
    laws_of(ride, values)
    np.testing.assert_allclose(ride.jumps.t[0], 0.0, atol=1e-14)
    assert float(ride.jumps.impulses[0, 0]) > 0
    p = [{**ROD, "static": values.get("friction", 0.0), **values}.get(name, 0.0) for name in NAMES]
    alone = jk.impact(RoundRod(*p[:12]), 0.0, p[12:15], p[15:])
    np.testing.assert_allclose(alone.u, ride.jumps.after.u[0], atol=1e-14)
    np.testing.assert_allclose(alone.impulses, ride.jumps.impulses[0], atol=1e-14)
    np.testing.assert_allclose(alone.energy_lost, ride.jumps.energy[0], atol=1e-13)
    assert alone.unique


def test_a_start_that_penetrates_slightly_is_moved_out():
    at = [{**ROD, "radius": 0.1, "inertia": 0.004, "vy": -1.0}.get(name, 0.0) for name in NAMES]
    system, q, u = RoundRod(*at[:12]), jnp.array(at[12:15]), jnp.array(at[15:])
    ts, h = np.linspace(0.0, 0.3, 7), system.coordinates.index("h")
    touching = jk.simulate(system, jk.State(q.at[h].set(0.1), u), ts)
    with pytest.warns(UserWarning, match="gap of 'table' is -1e-06 at the start"):
        moved = jk.simulate(system, jk.State(q.at[h].set(0.1 - 1e-6), u), ts)
    np.testing.assert_allclose(moved.q, touching.q, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match=r"gap of 'table' is -0\.001 at the start\. It must not"):
        jk.simulate(system, jk.State(q.at[h].set(0.099), u), ts)


@pytest.mark.parametrize(
    ("h", "restitution", "message"),
    [(0.2, 0.5, "no contact touches"), (0.05, 0.5, "contacts penetrate: table"), (0.1, 1.5, "not in its range")],
)
def test_an_impact_of_contacts_that_is_impossible(h, restitution, message):
    ball = RoundRod(restitution, 0.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.004, 10.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=message):
        jk.impact(ball, 0.0, {"h": h}, {"vy": -1.0})


def test_derivatives_after_an_impact_at_the_start():
    """By the restitution, 0.1 s after the impact of a ball whose gap is a rounding error: v = e, h = e t."""
    _, slopes = ride_of(np.linspace(0, 0.1, 21), **ROUNDED["a ball"])
    np.testing.assert_allclose(slopes["restitution"]["end"], [0, 0.1, 0, 0, 1, 0], atol=1e-9)


def test_the_derivative_of_the_time_of_coming_to_rest():
    """Of a rod on a shaking table, whose acceleration is not constant. By differences."""
    values = {"restitution": 0.3, "friction": 0.9, "radius": 0.05, "length": 0.5, "inertia": 1 / 12, "vx": 1.0}
    values |= {"angle": 0.41535293854473077, "h": 0.508486981117146, "shake": 0.005}
    times = [
        jumps_of(ride_of(np.linspace(0, 0.2, 21), push=(-4.0, 0.0, 8.0, -4.0), **{**values, "h": values["h"] + d})[0])[
            -1
        ]
        for d in (-1e-6, 1e-6)
    ]
    ride, slopes = ride_of(np.linspace(0, 0.2, 21), push=(-4.0, 0.0, 8.0, -4.0), **values)
    last = int(ride.jumps.count) - 1
    np.testing.assert_allclose(slopes["h"]["t"][last], (times[1] - times[0]) / 2e-6, rtol=1e-4)
    assert np.isfinite(slopes["h"]["end"]).all()


def plain(p, ts, push, **options):
    samples = jk.Samples(ON_AND_OFF, push, zero_order_hold=True)
    return jk.simulate(RoundRod(*p[:12]), jk.State(p[12:15], p[15:]), ts, {"push": samples}, **TIGHT, **options)


# They land and rest on a belt, lift off a shaking table, never touch it.
MEMBERS = [
    {"restitution": 0.5, "friction": 0.1, "static": 0.2, "h": 1.0, "vx": 2.0, "belt": 0.5},
    {"friction": 0.3, "static": 0.3, "radius": 0.1, "inertia": 0.004, "h": 0.1, "vy": 1.0, "shake": 0.05, "w": 3.0},
    {"restitution": 0.5, "friction": 0.3, "static": 0.3, "h": 60.0, "vx": 1.0},
]
ALL = jnp.array([[{**ROD, **values}.get(name, 0.0) for name in NAMES] for values in MEMBERS])
PUSH = jnp.array([2.0, 0.0, -4.0, 0.0])


@pytest.mark.weekly
def test_members_with_different_contact_states_are_independent():
    """Each is the same to the last digit at every place of a batch."""
    batch = jax.jit(jax.vmap(lambda p: plain(p, jnp.linspace(0, 2.5, 21), PUSH)))
    first, turned = batch(ALL), batch(jnp.roll(ALL, 1, axis=0))
    np.testing.assert_array_equal(first.status, 0)
    assert int(first.jumps.count[2]) == 0
    for x, y in ((first.q, turned.q), (first.u, turned.u), (first.jumps.t, turned.jumps.t)):
        np.testing.assert_array_equal(np.roll(x, 1, axis=0), y)
    for i, values in enumerate(MEMBERS):
        one, _ = ride_of(np.linspace(0, 2.5, 21), push=PUSH, **values)
        np.testing.assert_allclose(first.q[i], one.q, atol=1e-8)
        np.testing.assert_array_equal(first.contacts["table"][i], one.contacts["table"])


@pytest.mark.weekly
def test_reverse_mode_equals_forward_mode():
    """Without NaN from contact states that do not occur."""
    reverse = jax.jit(jax.grad(lambda p: plain(p, jnp.linspace(0, 2.5, 21), PUSH, adjoint="reverse").end.q[0]))
    for p, values in zip(ALL, MEMBERS, strict=True):
        _, slopes = ride_of(np.linspace(0, 2.5, 21), push=PUSH, **values)
        forward = [slope["end"][0] for slope in slopes.values()]
        np.testing.assert_allclose(reverse(p), forward, rtol=1e-8, atol=1e-9)


# -- Dry friction (closed forms).
belt = simulate_with_slopes(lambda p: Belt(jnp.ones(()), *p[:4]), lambda p: jk.State(p[4:5], p[5:]))
BELT = jnp.array([4.0, 0.5, 2.5, 4.0, 0.0, 0.0])  # stiffness, speed, kinetic, static, x, x_dot


@pytest.mark.weekly
def test_a_block_on_a_belt_sticks_and_slips():
    atol, slope_atol = 1e-10, 1e-8
    slopes, ride = belt(BELT, jnp.linspace(0, 20, 21))
    times = [0.205758423033744, 2.101402346772704, 4.2602012771151685, 5.7602012771151685, 7.919000207457633]
    times += [9.419000207457632, 11.577799137800097, 13.077799137800097, 15.23659806814256, 16.736598068142563]
    np.testing.assert_allclose(jumps_of(ride), [*times, 18.895396998485026], atol=atol)
    sticks = np.searchsorted(times, np.linspace(0, 18, 19)) % 2 == 1
    np.testing.assert_array_equal(ride.contacts["belt"][:19], np.where(sticks, STICKS, SLIDES))
    np.testing.assert_allclose(end_of(ride), [0.8023015007574872, 0.5], atol=atol)
    np.testing.assert_allclose(ride["belt.friction"][-1], 4 * 0.8023015007574872, atol=1e-9)
    # By stiffness, speed, and the coefficients of friction for a normal force of 10 N.
    by_x = [1.46770928840823, 6.692554617561628, 1.751640446021439, -1.730769230769231]
    np.testing.assert_allclose(slopes["end"][0, :4], by_x, atol=slope_atol)
    np.testing.assert_allclose(slopes["end"][1, :4], [0.0, 1.0, 0.0, 0.0], atol=slope_atol)
    # The multiplier of the orbit is exactly zero: the first sticking forgets all of the initial state but its phase.
    np.testing.assert_array_equal(slopes["end"][1, 4:], 0.0)


class Brake(Sled):
    """Its dry friction decreases with the time."""

    decrease: jk.Scalar = jk.parameter(0.0, unit="N/s")

    def contacts(self, t, q, u, motion):
        return {"brake": jk.DryFriction(u["v"], 2.0 - self.decrease * t, static=2.5)}


@pytest.mark.weekly
def test_members_of_a_sweep_whose_dry_friction_becomes_impossible():
    """v = 5 - 2 t + d t^2 / 2. It becomes negative, larger than the static friction, or neither."""
    decreases, invalid = jnp.array([4.0, -1.0, 0.0]), jk.Status.INVALID_COEFFICIENT
    rides = jk.sweep.sweep(Brake(decrease=decreases), jk.State({}, {"v": 5.0}), jnp.linspace(0.0, 1.0, 21), **TIGHT)
    np.testing.assert_array_equal(rides.status, [invalid, invalid, jk.Status.COMPLETED])
    np.testing.assert_allclose(rides.t_end, [0.5, 0.5, 1.0], rtol=1e-11)
    t = rides.t[:, :10]
    np.testing.assert_allclose(rides["v"][:, :10], 5.0 - 2.0 * t + 0.5 * decreases[:, None] * t**2, rtol=1e-11)
    assert np.isnan(rides["v"][:2, 11:]).all()
    np.testing.assert_allclose(rides["v"][2, -1], 3.0, rtol=1e-11)


@pytest.mark.weekly
def test_static_friction_that_equals_the_kinetic_one():
    """The oscillator of Siconos: it rests after eight turns, half a period apart."""
    atol, slope_atol = 1e-10, 1e-8
    slopes, ride = belt(jnp.array([1.0, 0.0, 1.0, 1.0, 12.0, 6.0]), jnp.linspace(0, 30, 21))
    np.testing.assert_allclose(jumps_of(ride), 0.43240777557053783 + np.pi * np.arange(8), atol=atol)
    turns = 13.317821063276353 - 2.0 * np.arange(3)
    np.testing.assert_allclose(ride.jumps.after.q[:3, 0], turns * [1.0, -1.0, 1.0], atol=atol)
    np.testing.assert_allclose(end_of(ride), [0.6821789367236468, 0.0], atol=atol)
    np.testing.assert_allclose(slopes["end"][0, 5], -0.4190581774617469, atol=slope_atol)
