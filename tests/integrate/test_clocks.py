"""The clock of a simulation does not matter: no time is lost at samples, whatever the start, the rate and the type."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk


class Particle(jk.System):
    """A particle of 1 kg on a line, and a first-order filter of the force on it."""

    coordinates, speeds, inputs = ("x",), ("v",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="mass")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["push"] * motion.N.x, motion["mass"])


def state(dtype):
    return jk.State(jnp.zeros(1, dtype), jnp.ones(1, dtype))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("t0", [0.0, 1e3, 1e6, 1.7e9])
@pytest.mark.parametrize("rate", [100.0, pytest.param(1e3, marks=pytest.mark.weekly)])
@pytest.mark.parametrize("hold", [True, False])
def test_elapsed_time_is_exact_at_samples(dtype, t0, rate, hold):
    """A free particle at 1 m/s: its place is the time."""
    n = 1 + int(4 * rate)
    ts = t0 + np.arange(n) / rate
    push = {"push": jk.Samples(ts, np.zeros(n), zero_order_hold=hold)}
    ride = jk.simulate(Particle(), state(dtype), ts[:: n // 4], push)
    assert ride.ok
    elapsed = np.asarray(ride.t, float) - float(ride.t[0])
    rtol = 20 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(ride["x"], elapsed, rtol=rtol)
    assert float(ride.t_end) == pytest.approx(t0 + 4.0, rel=rtol)


@pytest.mark.weekly
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("step", [None, 0.01])
def test_uneven_samples_under_a_hold(dtype, step):
    """Intervals of 10 ms and 1 s: rounding is that of the interval in question."""
    grid = np.concatenate([np.arange(20) * 0.01, 0.2 + np.arange(4)])
    values = np.where(np.arange(24) % 2, -1.0, 2.0)
    for t0 in (0.0, 1.7e9):
        push = {"push": jk.Samples(t0 + grid, values, zero_order_hold=True)}
        ride = jk.simulate(Particle(), state(dtype), t0 + np.array([0.0, 1.2, 3.2]), push, step=step)
        lengths, v, x = np.diff(grid), 1.0, 0.0
        for h, a in zip(lengths, values, strict=False):
            x, v = x + v * h + a * h**2 / 2, v + a * h
        atol = 2e-6 if t0 else 1e-12
        np.testing.assert_allclose([ride["x"][-1], ride["v"][-1]], [x, v], rtol=50 * jnp.finfo(dtype).eps, atol=atol)


@pytest.mark.weekly
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_hold_that_jumps_at_the_last_time(dtype):
    """As when the requested times are those of the samples: 125 steps more than the 50 of the longest step."""
    ts = np.array([0.0, 0.5, 1.0])

    def end(last):
        values = jnp.stack([jnp.ones_like(last), -jnp.ones_like(last), last])
        push = {"push": jk.Samples(ts, values, zero_order_hold=True)}
        ride = jk.simulate(Particle(), state(dtype), ts, push)
        return ride["v"][-1], (ride.stats["steps"], ride.status)

    (v, (steps, status)), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(jnp.asarray(7.0, dtype))
    assert status == jk.Status.COMPLETED
    assert steps < 60
    assert float(v) == pytest.approx(1.0, abs=4 * float(jnp.finfo(dtype).eps))
    assert slope == 0.0


class Thrown(Particle):
    """Thrown up, with an event where it returns; and one at a time of the clock."""

    gravity: jk.Scalar = jk.parameter(1.0)
    alarm: jk.Scalar = jk.parameter(0.0)
    has_alarm: bool = eqx.field(static=True, default=False)

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(-self.gravity * motion.N.x, motion["mass"])

    def events(self, t, q, u):
        return {"back": jk.falling(q["x"])} | ({"alarm": jk.rising(t - self.alarm)} if self.has_alarm else {})


def thrown(t0, duration, v, **parameters):
    ts = t0 + np.array([0.0, duration])
    return jk.simulate(Thrown(**parameters), jk.State([0.0], [v]), ts)


@pytest.mark.parametrize("t0", [0.0, 3e6, 1e7, 1.7e9])
def test_event_times_do_not_depend_on_the_start_time(t0):
    back = thrown(t0, 10.0, 1.5)
    assert back.reason == "back"
    assert float(back.t_end) - t0 == pytest.approx(3.0, abs=1e-10 + 4e-16 * t0)
    alarm = thrown(t0, 10.0, 8.0, alarm=t0 + 2.5, has_alarm=True)
    assert alarm.reason == "alarm"
    assert float(alarm.t_end) - t0 == pytest.approx(2.5, abs=1e-10 + 4e-16 * t0)


@pytest.mark.parametrize("flight", [1e-8, 1e-7, 1e-3])
@pytest.mark.parametrize("t0", [0.0, 1.7e9])
def test_a_short_flight_in_a_long_simulation(t0, flight):
    """Its resolution follows the step and the time since the start, not the duration of 1e4 s."""
    ride = thrown(t0, 1e4, 0.5 * flight)
    assert ride.reason == "back"
    height = float(ride.end.u[0])
    assert height == pytest.approx(-0.5 * flight, rel=1e-6)


@pytest.mark.weekly
def test_third_derivatives_of_the_end_time_are_nan():
    """A fall from h takes sqrt(2 h); its third derivative at h = 0.5 is 3, and two are exact."""

    def end(h):
        return jk.simulate(Thrown(), jk.State(jnp.stack([h]), jnp.zeros(1)), [0.0, 3.0], adjoint="forward").t_end

    first, second = jax.jacfwd(end), jax.jacfwd(jax.jacfwd(end))
    third = jax.jacfwd(second)
    found = jax.jit(lambda h: (end(h), first(h), second(h), third(h)))(jnp.array(0.5))
    np.testing.assert_allclose(found[:3], [1.0, 1.0, -1.0], rtol=1e-7)
    assert np.isnan(found[3])


class Clocked(Particle):
    """An event that oscillates in a motion without forces, so that error control alone would pass over it."""

    def events(self, t, q, u):
        return {"tick": jk.falling(jnp.cos(np.pi / 2 * q["x"]))}


@pytest.mark.slow
def test_the_first_of_several_fast_crossings_ends_the_simulation():
    ride = jk.simulate(Clocked(), jk.State([0.0], [1.0]), [0.0, 100.0])
    assert float(ride.t_end) == pytest.approx(1.0, abs=1e-9)
    bounded = jk.simulate(Clocked(), jk.State([0.0], [1.0]), [0.0, 100.0], max_step=0.3)
    assert float(bounded.t_end) == pytest.approx(1.0, abs=1e-9)
    free = jk.simulate(Particle(), jk.State([0.0], [1.0]), [0.0, 10.0], max_step=0.25)
    assert free.stats["steps"] >= 40


class Switched(Particle):
    """A load that jumps at a known time, and one that reads samples of the system itself."""

    wind: jk.Samples = eqx.field(default_factory=lambda: jk.Samples([0.0, 0.5, 1.0], [1.0, -3.0, 0.0], True))
    sampled: bool = eqx.field(static=True, default=False)

    def loads(self, t, q, u, motion, inputs):
        push = self.wind(t) if self.sampled else jnp.where(t < 0.5, 1.0, -3.0)
        return jk.Force(push * motion.N.x, motion["mass"])


@pytest.mark.weekly
@pytest.mark.filterwarnings("ignore:Switched")
@pytest.mark.parametrize(
    ("sampled", "options"), [(False, {}), (False, {"step": 0.05}), (True, {})], ids=["given", "fixed", "samples"]
)
def test_declared_discontinuities_of_the_system_end_steps(sampled, options):
    """v is 1 + 0.5 - 1.5. A step that reads the wrong side of the jump is off by 0.46."""
    given = {} if sampled else {"discontinuities": [0.5]}
    ride = jk.simulate(Switched(sampled=sampled), jk.State([0.0], [1.0]), [0.0, 1.0], **given, **options)
    assert float(ride["v"][-1]) == pytest.approx(0.0, abs=1e-12)
    assert ride.stats["steps"] < 60


OF_TIME = {
    "loads": lambda self, t, q, u, motion, inputs: jk.Force(t * motion.N.x, motion["mass"]),
    "events": lambda self, t, q, u: {"late": jk.rising(t - 1e6)},
    "outputs": lambda self, t, q, u, motion, now: {"phase": jnp.sin(t)},
}


@pytest.mark.parametrize("method", ["input", *OF_TIME])
def test_times_that_float32_cannot_resolve_are_rejected_if_something_depends_on_time(method):
    system = type("Timed", (Particle,), {} if method == "input" else {method: OF_TIME[method]})()
    inputs = {"push": lambda t, s: jnp.sin(t)} if method == "input" else None
    name = {"input": "push", "events": r"Timed\.events"}.get(method, "Timed")
    with pytest.raises(ValueError, match=f"float32 cannot resolve, and {name} may depend on the time"):
        jk.simulate(system, state(jnp.float32), 1e6 + np.array([0.0, 0.5, 1.0]), inputs)
