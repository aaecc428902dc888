"""Events that change the state: times, states, derivatives, order, batches, and what ends a simulation with jumps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Sled

import jaxkane as jk
from jaxkane.catalog import CompassGait, RimlessWheel

TS = jnp.linspace(0.0, 2.0, 21)
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


class Ball(jk.System):
    """A ball over a floor, with drag c |v| v. It counts its bounces."""

    restitution: jk.Scalar = jk.parameter(0.8)
    drag: jk.Scalar = jk.parameter(0.1, unit="kg/m")
    gravity: jk.Scalar = jk.parameter(9.81)
    coordinates, speeds, states, inputs = ("h",), ("v",), ("bounces",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["h"] * N.y, u["v"] * N.y), name="ball")])

    def loads(self, t, q, u, motion, inputs):
        resistance = (inputs["push"] - self.drag * u["v"] * jnp.abs(u["v"])) * motion.N.y
        return jk.weight(motion, -self.gravity * motion.N.y), jk.Force(resistance, motion["ball"])

    def state_rates(self, t, q, u, x, motion, now):
        return {}

    def bounce(self, t, q, u, x):
        return {"v": -self.restitution * u["v"], "bounces": x["bounces"] + 1.0}

    def events(self, t, q, u):
        return {"floor": jk.falling(q["h"], then=self.bounce)}


def drop(p, ts=TS, system=Ball, **options):
    """p: height, gravity, drag, restitution."""
    return jk.simulate(system(p[3], p[2], p[1]), jk.State(p[:1], jnp.zeros(1)), ts, **{**TIGHT, **options})


P = jnp.array([1.0, 9.81, 0.1, 0.8])
# Closed form with 40 digits: times of the bounces; height and velocity at 2 s.
TIMES = [0.4590853109923369, 1.1280946846381106, 1.6405736265752897]
END = [0.070195237373034289, -1.5596107399428191]


@pytest.mark.slow
def test_a_bouncing_ball_with_drag():
    atol = 1e-10
    ride = drop(P)
    assert ride.ok
    assert int(ride.jumps.count) == 3
    np.testing.assert_allclose(ride.jumps.t[:3], TIMES, atol=atol)
    np.testing.assert_allclose([ride.end.q[0], ride.end.u[0]], END, atol=atol)
    np.testing.assert_allclose(ride["bounces"], np.searchsorted(TIMES, TS), atol=0)
    before, after = ride.jumps.before, ride.jumps.after
    np.testing.assert_allclose(after.u[:3, 0], -0.8 * before.u[:3, 0], rtol=1e-14)
    np.testing.assert_allclose(ride.jumps.energy[:3], 0.18 * before.u[:3, 0] ** 2, rtol=1e-12)
    assert np.isnan(ride.jumps.t[3:]).all()
    assert np.isnan(before.u[3:]).all()
    assert ride.jumps.name(2) == "floor"
    with pytest.raises(IndexError, match="3 jumps"):
        ride.jumps.name(3)


@pytest.mark.weekly
def test_second_derivatives_through_a_jump():
    """Without drag, by height, gravity and restitution: the derivative of |v| v has a corner at the top."""
    rtol, ts, p = 1e-8, jnp.linspace(0.0, 1.0, 6), jnp.array([1.0, 9.81, 0.8])

    def end(p):
        return drop(jnp.array([p[0], p[1], 0.0, p[2]]), ts, adjoint="forward").end.q[0]

    def expected(p):
        h, g, e = p
        fall = jnp.sqrt(2 * h / g)
        return e * g * fall * (1.0 - fall) - g * (1.0 - fall) ** 2 / 2

    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(end)))(p), jax.hessian(expected)(p), rtol=rtol, atol=1e-8)
    third = jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda h: end(p.at[0].set(h)))))
    assert np.isnan(jax.jit(third)(1.0))


@pytest.mark.weekly
@pytest.mark.parametrize(
    "options",
    [
        {"step": 0.01},
        {"solver": diffrax.Heun(), "rtol": 1e-7, "atol": 1e-7},
        {"solver": diffrax.Kvaerno5(), "rtol": 1e-9, "atol": 1e-9},
    ],
    ids=["fixed steps", "without rates at ends", "implicit"],
)
def test_results_agree_for_other_solvers_and_options(options):
    options = {**({"rtol": None, "atol": None} if "step" in options else {}), **options}
    ride = drop(P, **options)
    assert int(ride.jumps.count) == 3
    np.testing.assert_allclose(ride.jumps.t[:3], TIMES, atol=1e-6)
    np.testing.assert_allclose([ride.end.q[0], ride.end.u[0]], END, atol=1e-5)


@pytest.mark.weekly
def test_each_member_of_a_batch_jumps_at_its_own_times():
    """A member equals its own simulation, beside one without jumps and one with as many as are allowed."""
    heights = jnp.array([0.01, 1.0, 30.0])

    def run(h):
        return drop(P.at[0].set(h), rtol=1e-8, atol=1e-8, max_jumps=5)

    batch = jax.jit(jax.vmap(run))(heights)
    assert batch.reason == ["max jumps", "completed", "completed"]
    np.testing.assert_array_equal(batch.jumps.count, [5, 3, 0])
    for i, h in enumerate(heights):
        one = run(h)
        np.testing.assert_allclose(batch.q[i], one.q, rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(batch.stats["steps"][i], one.stats["steps"])
        np.testing.assert_allclose(batch.jumps.t[i], one.jumps.t, rtol=1e-12)


def moving(events, v=1.0, x=0.0, ts=TS, **options):
    """A particle without forces, with the events of a function (t, q, u, x). The state `mode` counts or marks jumps."""
    members = {"states": ("mode",), "state_rates": lambda *_: {}, "events": lambda _, t, q, u, x: events(t, q, u, x)}
    kind = type("Moving", (Sled,), members)
    return jk.simulate(kind(), jk.State(jnp.array([x]), jnp.array([v])), ts, **options)


def kick(t, q, u, x):
    """Once at x = 1, since the condition is no longer met after the jump."""
    return {"kick": jk.rising(q["x"] - 1.0, when=0.5 - x["mode"], then={"v": 2.0 * u["v"], "mode": 1.0})}


@pytest.mark.weekly
def test_a_sample_at_the_time_of_a_jump_has_the_value_after_it():
    ride = moving(kick)
    np.testing.assert_allclose(ride["v"], np.where(np.asarray(TS) < 1.0 - 1e-9, 1.0, 2.0))
    at_end = moving(lambda t, q, u, x: {"kick": jk.rising(q["x"] - 2.0, then={"v": -3.0})})
    assert at_end.ok
    assert int(at_end.jumps.count) == 1
    assert float(at_end["v"][-1]) == float(at_end.end.u[0]) == -3.0
    np.testing.assert_allclose(at_end["x"], TS, atol=1e-12)


@pytest.mark.weekly
@pytest.mark.parametrize("t", [1.0, 2.0], ids=["sample", "end"])
def test_a_sample_or_an_end_at_a_jump_has_no_derivative_by_the_time_of_the_jump(t):
    """It does not exist if the time of the jump depends on the parameter. At a jump with a fixed time it does."""
    jump = t

    def found(v, at_time):
        def events(t, q, u, x):
            new = {"v": 2.0 * u["v"], "mode": 1.0}
            return {"kick": jk.rising((t if at_time else q["x"]) - jump, when=0.5 - x["mode"], then=new)}

        ride = moving(events, v, adjoint="forward")
        return jnp.concatenate([ride["x"][:-1], ride.end.q, ride.end.u])

    by_place = jax.jacfwd(lambda v: found(v, False))(1.0)
    assert np.flatnonzero(np.isnan(by_place)).tolist() == ([10] if t == 1.0 else [20, 21])
    by_time = jax.jacfwd(lambda v: found(v, True))(1.0)
    np.testing.assert_allclose(by_time, [*np.where(TS <= t, TS, 2 * TS - t), 2.0], atol=1e-9)


@pytest.mark.slow
def test_simultaneous_events_are_processed_in_alphabetical_order():
    """Each reads the state that the previous one left, and counts only if it still leaves in its direction."""

    def events(t, q, u, x):
        def at_one(new, until):
            return jk.rising(q["x"] - 1.0, when=until - x["mode"], then={"mode": 10.0 * x["mode"] + new})

        b = jk.rising(q["x"] - 1.0, then={"mode": 10.0 * x["mode"] + 2.0, "v": -u["v"]})
        return {"a": at_one(1.0, 0.5), "b": b, "c": at_one(3.0, 100.0)}

    ride = moving(events)
    assert [ride.jumps.name(i) for i in range(int(ride.jumps.count))] == ["a", "b"]
    np.testing.assert_allclose(ride.jumps.t[:2], 1.0, atol=1e-12)
    assert float(ride["mode"][-1]) == 12.0
    np.testing.assert_allclose(ride["x"][-1], 0.0, atol=1e-12)


@pytest.mark.weekly
def test_two_almost_simultaneous_events():
    for gap in (1e-13, 1e-9):

        def events(t, q, u, x, gap=gap):
            ones, tens = x["mode"] % 10.0, x["mode"] // 10.0
            return {
                "late": jk.rising(q["x"] - 1.0 - gap, when=0.5 - tens, then={"mode": x["mode"] + 10.0}),
                "soon": jk.rising(q["x"] - 1.0, when=0.5 - ones, then={"mode": x["mode"] + 1.0}),
            }

        ride = moving(events)
        assert float(ride["mode"][-1]) == 11.0
        assert ride.jumps.name(0) == "soon" or gap < 1e-12


@pytest.mark.weekly
def test_an_event_has_no_effect_while_its_condition_is_not_positive():
    """Crossings while `when` is not positive have no effect, and do not hide later ones."""

    def events(t, q, u, x):
        new = {"x": q["x"] + 0.1, "mode": x["mode"] + 1.0}
        return {"low": jk.falling(jnp.cos(4.0 * q["x"]), when=q["x"] - 1.0, then=new)}

    ts = jnp.linspace(0.0, 5.0, 11)
    ride = moving(events, ts=ts)
    crossings = (np.pi / 2 + 2 * np.pi * np.arange(4)) / 4
    expected = crossings[crossings > 1.0] - 0.1 * np.arange(3)
    np.testing.assert_allclose(ride.jumps.t[: int(ride.jumps.count)], expected, atol=1e-9)
    ends = moving(lambda t, q, u, x: {"low": jk.falling(jnp.cos(4.0 * q["x"]), when=q["x"] - 1.0)}, ts=ts)
    assert ends.reason == "low"
    np.testing.assert_allclose(ends.t_end, crossings[1], atol=1e-9)


@pytest.mark.slow
def test_stages_of_a_jump_read_the_state_after_the_previous_stage():
    def swap(t, q, u, x):
        return {"mode": u["v"], "v": 0.5 * u["v"]}

    ride = moving(lambda t, q, u, x: {"kick": jk.rising(q["x"] - 1.0, then=({"v": -3.0 * u["v"]}, swap))})
    assert float(ride["mode"][-1]) == -3.0
    assert float(ride["v"][-1]) == -1.5


@pytest.mark.slow
def test_an_event_at_zero_at_the_start_jumps_if_it_crosses_in_its_direction():
    def events(t, q, u, x):
        return {"wall": jk.falling(q["x"], then={"v": -u["v"]})}

    assert int(moving(events, v=1.0).jumps.count) == 0
    back = moving(events, v=-1.0)
    assert int(back.jumps.count) == 1
    np.testing.assert_allclose(back["x"], TS, atol=1e-12)


@pytest.mark.slow
def test_two_zero_crossings_of_a_gap_in_one_step():
    """A ball that leaves the floor with 1e-7 m/s lands after 2e-8 s."""
    ride = jk.simulate(Ball(0.5, 0.0), jk.State(jnp.zeros(1), jnp.array([1e-7])), TS, max_jumps=3)
    np.testing.assert_allclose(ride.jumps.t[:2], 2e-7 / 9.81 * np.array([1.0, 1.5]), rtol=1e-6)
    assert ride.reason == "max jumps"
    assert "max_jumps" in repr(ride)


def test_a_repeated_jump_has_a_status():
    rests = drop(P.at[3].set(0.0))
    assert rests.reason == "repeated jump"
    assert "then" in repr(rests)
    assert int(rests.jumps.count) == 1
    np.testing.assert_allclose(rests.t_end, TIMES[0], atol=1e-10)


@pytest.mark.slow
def test_a_jump_at_a_discontinuity_of_an_input():
    """The push changes its sign where the ball lands."""
    samples = jk.Samples(jnp.array([0.0, TIMES[0]]), jnp.array([0.0, 2.0]), zero_order_hold=True)
    ride = drop(P, inputs={"push": samples})
    p = P.at[1].set(9.81 - 2.0)
    v = 0.8 * np.sqrt(9.81 / 0.1 * (1 - np.exp(-0.2)))
    rise = np.arctan(v * np.sqrt(0.1 / p[1])) / np.sqrt(0.1 * p[1])
    top = np.log(1 + v * v * 0.1 / p[1]) / 0.2
    down = np.arccosh(np.exp(0.1 * top)) / np.sqrt(0.1 * p[1])
    np.testing.assert_allclose(ride.jumps.t[:2], [TIMES[0], TIMES[0] + rise + down], atol=1e-9)


def test_a_compass_gait():
    """The state after a step is that before it. Figures by mpmath and by Pinocchio's impulse dynamics."""
    rtol = 1e-9
    after = [-0.21866880293899055, 0.3233885580586503, 1.092383589883601, 0.3773739489071941]
    start = jk.State(jnp.array([*after[:2], 0.0]), jnp.array(after[2:]))
    ride = jk.simulate(CompassGait(), start, jnp.linspace(0.0, 1.0, 21), **TIGHT)
    assert int(ride.jumps.count) == 1
    np.testing.assert_allclose(ride.jumps.t[0], 0.7343463911587195, rtol=rtol)
    before = [after[1], after[0], 0.0, 1.4942048971003625, 1.8056788689878192]
    np.testing.assert_allclose([*ride.jumps.before.q[0], *ride.jumps.before.u[0]], before, rtol=rtol)
    step = [*after[:2], 0.5354454154300095, *after[2:]]  # with the step length
    np.testing.assert_allclose([*ride.jumps.after.q[0], *ride.jumps.after.u[0]], step, rtol=rtol)
    s, c = np.sin(CompassGait().slope), np.cos(CompassGait().slope)
    impulses = np.array([[c, -s], [s, c]]) @ [-2.619490477212034, 13.735598013322457]  # along the slope, normal to it
    np.testing.assert_allclose(ride.jumps.impulses[0], impulses, rtol=rtol)
    assert ride.jumps.energy[0] > 0


@pytest.mark.weekly
def test_the_energy_balance_includes_losses_in_jumps():
    """The audit counts what the impacts lose, and no work where a jump moves a mass centre."""
    p = P.at[2].set(0.0)
    ride = drop(p, jnp.linspace(0.0, 2.0, 201), max_jumps=5)
    audit = jk.audit(Ball(p[3], p[2], p[1]), ride)
    np.testing.assert_allclose(audit.lost[-1], jnp.sum(ride.jumps.energy[:3]))
    assert audit.energy_balance < 1e-9
    assert "lost in jumps" in str(audit)
    start = jk.State(jnp.array([-0.32, 0.0]), jnp.array([1.2]))
    wheel = jk.simulate(RimlessWheel(), start, jnp.linspace(0.0, 2.0, 201), **TIGHT)
    assert int(wheel.jumps.count) > 0
    assert jk.audit(RimlessWheel(), wheel).energy_balance < 1e-9


@pytest.mark.weekly
def test_invalid_jumps_raise():
    def then(new):
        return lambda t, q, u, x: {"kick": jk.rising(q["x"] - 1.0, then=new)}

    for events, options, message in (
        (then({"w": 1.0}), {}, "not a coordinate, an independent speed or a first-order state: w"),
        (then(3.0), {}, "must be a dict of new values by name"),
        (then(()), {}, "empty tuple"),
        (then({"v": "2"}), {}, "the new value of 'v' must be one number"),
        (then({"v": 2.0}), {"controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)}, "solver loop of jaxkane"),
        (lambda t, q, u, x: {"kick": jk.rising(q["x"], when=q["x"] > 0)}, {}, "`when` is a boolean"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            moving(events, **options)
    for new in ({"v": jnp.nan}, lambda t, q, u: jk.Impact(u["v"], restitution=1.0 + q["x"])):
        ride = moving(then(new))
        assert ride.reason == "impossible jump"
        np.testing.assert_allclose(ride.t_end, 1.0, atol=1e-9)


@pytest.mark.weekly
def test_a_jump_that_violates_a_configuration_constraint_ends_the_simulation():
    class Kicked(jk.catalog.WhippleBicycle):
        def events(self, t, q, u):
            return {"kick": jk.falling(q["roll"] + 0.02, then={"steer": 0.5})}

    bicycle = Kicked.benchmark()
    start = jk.assemble(bicycle, {}, {"roll_rate": -0.2, "rear_wheel_rate": -4.6 / bicycle.rR})
    assert jk.simulate(bicycle, start, jnp.linspace(0.0, 1.0, 3)).reason == "impossible jump"


@pytest.mark.slow
def test_an_event_unchanged_by_its_jump_occurs_once_per_crossing():
    """A switch at a time, and a counter of crossings."""

    def events(t, q, u, x):
        count = {"mode": x["mode"] + 1.0}
        return {"clock": jk.rising(jnp.sin(6 * jnp.pi * t + 1.0), then=count), "switch": jk.rising(t - 0.5, then=count)}

    ride = moving(events)
    assert ride.ok
    crossings = [(2 * np.pi * k - 1.0) / (6 * np.pi) for k in range(1, 7)]
    np.testing.assert_allclose(ride.jumps.t[:7], sorted([*crossings, 0.5]), atol=1e-9)
    assert float(ride["mode"][-1]) == 7.0


def test_each_of_several_events_at_one_time_occurs_once_in_alphabetical_order():
    """Events of the time and of the state, also at the end of the simulation; and a kick that does not reverse."""

    def events(t, q, u, x):
        def count(place):
            return {"mode": x["mode"] + place}

        return {
            "a": jk.rising(3.0 * t - 2.1, then=count(1.0)),
            "b": jk.falling(0.7 - t, then=count(10.0)),
            "kick": jk.rising(q["x"] - 0.7, then={"v": 2.0 * u["v"]}),
            "last": jk.rising(t - 2.0, then=count(100.0)),
            "later": jk.rising(4.0 * t - 8.0, then=count(1000.0)),
        }

    ride = moving(events)
    assert ride.ok
    names = [ride.jumps.name(i) for i in range(int(ride.jumps.count))]
    assert names == ["a", "b", "kick", "last", "later"]
    np.testing.assert_allclose(ride.jumps.t[:5], [0.7, 0.7, 0.7, 2.0, 2.0], atol=1e-12)
    assert float(ride["mode"][-1]) == 1111.0
    np.testing.assert_allclose(ride["x"][-1], 0.7 + 2.0 * 1.3, atol=1e-12)


@pytest.mark.slow
def test_a_jump_that_mirrors_the_function_of_another_event_does_not_cause_that_event():
    """The jump takes x from 1 to -1, so x does not cross zero before it moves up again."""
    count = {"mode": 1.0}
    ride = moving(
        lambda t, q, u, x: {
            "mirror": jk.rising(t - 0.5, then={"x": -q["x"]}),
            "down": jk.falling(q["x"], then=count),
            "up": jk.rising(q["x"], then=count),
        },
        x=0.5,
    )
    assert ride.ok
    assert [ride.jumps.name(i) for i in range(int(ride.jumps.count))] == ["mirror", "up"]
    np.testing.assert_allclose(ride.jumps.t[:2], [0.5, 1.5], atol=1e-12)


@pytest.mark.slow
def test_an_event_that_ends_the_simulation_is_not_hidden_by_a_jump_at_the_same_time():
    ride = moving(lambda t, q, u, x: {"a": jk.rising(t - 1.0, then={"mode": 1.0}), "stop": q["x"] - 1.0})
    assert ride.reason == "stop"
    np.testing.assert_allclose(ride.t_end, 1.0, atol=1e-12)


class OverMovingFloor(Ball):
    def events(self, t, q, u):
        floor, rate = 0.1 * jnp.sin(12 * t), 1.2 * jnp.cos(12 * t)
        new = {"v": rate - self.restitution * (u["v"] - rate)}
        return {"floor": jk.falling(q["h"] - floor, then=new)}


@pytest.mark.slow
def test_a_ball_does_not_penetrate_a_moving_floor():
    """Small dips through zero within long steps: the motion itself is a parabola, which does not limit them."""
    ts = jnp.linspace(0.0, 5.0, 1001)
    for h in (0.5446297531687792, 0.5278185456971314):
        ride = drop(jnp.array([h, 9.81, 0.0, 0.9]), ts, OverMovingFloor, rtol=1e-8, atol=1e-8)
        assert float(jnp.min(ride["h"] - 0.1 * jnp.sin(12 * ts))) > -1e-7


def test_times_of_jumps_in_float32_with_posix_times():
    start = jk.State(jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32))
    system = jax.tree.map(lambda x: x.astype(jnp.float32), Ball(0.8, 0.1))
    ride = jk.simulate(system, start, 1.7e9 + np.asarray(TS, np.float64))
    np.testing.assert_allclose(ride.jumps.t[:3] - 1.7e9, TIMES, atol=2e-4)


class Masses(jk.System):
    """Free masses on parallel lines, each with its own event: impacts with one and two residuals, and new values."""

    masses: jk.Vector = jk.parameter(tuple(np.linspace(1.0, 2.0, 14)), unit="kg")
    coordinates, speeds = tuple(f"x{i}" for i in range(14)), tuple(f"v{i}" for i in range(14))

    def motion(self, t, q, u):
        N, O = jk.inertial()
        points = [O.moving(x * N.x, v * N.x) for x, v in zip(q, u, strict=True)]
        return jk.Motion([jk.Body(m, 0.0, point) for m, point in zip(self.masses, points, strict=True)])

    def events(self, t, q, u):
        stops = {f"stop{i:02}": jk.rising(q[i] - 1.0, then=jk.Impact(u[i], restitution=0.5)) for i in range(2, 14)}
        both = jk.Impact(u[0] - u[1], u[1], restitution=(1.0, 0.0))
        first = {"both": jk.rising(q[0] - 1.0, then=(both, {"x0": 0.0}))}
        return {**stops, **first, "back": jk.rising(q[1] - 1.0, then={"v1": -u[1]})}


@pytest.mark.slow
def test_many_events_with_impacts_and_many_speeds():
    """Each event changes its own masses only. Closed form, also of the derivatives."""
    speeds = 1.0 / (0.1 + 0.05 * np.arange(14))  # mass i arrives after 0.1 + 0.05 i s; masses 0 and 1 together stop
    speeds[1] = 0.5

    def ride(masses):
        start = jk.State(jnp.zeros(14), jnp.asarray(speeds))
        return jk.simulate(Masses(masses), start, jnp.linspace(0.0, 0.8, 3), max_jumps=16)

    masses = Masses().masses
    found = ride(masses)
    assert found.ok
    assert [found.jumps.name(i) for i in range(int(found.jumps.count))] == ["both", *sorted(found.events)[2:]]
    after, impulses = np.asarray(found.end.u), np.asarray(found.jumps.impulses)
    np.testing.assert_allclose(after[2:], -0.5 * speeds[2:], rtol=1e-9)
    np.testing.assert_allclose(after[:2], [0.5 - speeds[0], 0.0], atol=1e-9)
    np.testing.assert_allclose(impulses[1:13, 0], -1.5 * masses[2:] * speeds[2:], rtol=1e-9)
    assert np.isnan(impulses[1:13, 1]).all()

    def of_both(masses):  # p1 = m0 (v0+ - v0), p2 = m1 (v1+ - v1) + p1
        first = masses[0] * (speeds[1] - 2 * speeds[0])
        return jnp.stack([first, first - masses[1] * speeds[1]])

    direction = jnp.linspace(1.0, -1.0, 14)
    exact, slope = jax.jvp(of_both, (masses,), (direction,))
    np.testing.assert_allclose(impulses[0], exact, rtol=1e-9)
    _, slopes = jax.jvp(lambda m: ride(m).jumps.impulses[:13], (masses,), (direction,))
    np.testing.assert_allclose(slopes[0], slope, rtol=1e-9)
    np.testing.assert_allclose(slopes[1:, 0], -1.5 * (direction * speeds)[2:], rtol=1e-9)
