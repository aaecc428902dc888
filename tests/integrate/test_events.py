"""Events that end a simulation: exact times, directions, derivatives, batches, and cases without an end."""

import itertools
import re
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Bead, Sled
from scipy.special import ellipk
from slopes import differences, slopes

import jaxkane as jk

TS = jnp.linspace(0.0, 2.0, 11)


class Particle(jk.System):
    """Falls along h; `drive` is one more force."""

    mass: jk.Scalar = jk.parameter(1.0)
    gravity: jk.Scalar = jk.parameter(9.81)
    ends: str = eqx.field(static=True, default="ground")
    coordinates, speeds, inputs = ("h",), ("v",), ("drive",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q["h"] * N.y, u["v"] * N.y), N)])

    def loads(self, t, q, u, motion, inputs):
        body = motion.bodies[0]
        return [*jk.weight(motion, -self.gravity * motion.N.y), jk.Force(inputs["drive"] * motion.N.y, body.center)]

    def events(self, t, q, u):
        return {
            "ground": {"ground": jk.falling(q["h"])},
            "either": {"ground": q["h"]},
            "none": {},
            "root": {"low": jk.falling(jnp.sqrt(q["h"] - 0.2) - 0.1)},  # at 0.21 m; no number below 0.2 m
            "lost": {"low": jnp.sqrt(q["h"] - 0.2) + 1.0},
            "roof": {"a_late": jk.falling(q["h"]), "b_early": jk.falling(q["h"] - 0.1), "c_top": jk.falling(u["v"])},
        }[self.ends]


def dropped(h, v=0.0, system=None, **options):
    start = jk.State(jnp.stack([jnp.asarray(h)]), jnp.stack([jnp.asarray(v)]))
    return jk.simulate(system or Particle(), start, TS, **options)


def exact(h, v, g):
    """t_end, height and velocity there."""
    root = jnp.sqrt(v**2 + 2 * g * h)
    return jnp.stack([(v + root) / g, 0.0 * h, -root])


class Pendulum(jk.System):
    length: jk.Scalar = jk.parameter(1.3)
    way: int = eqx.field(static=True, default=0)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q[0], u[0])
        return jk.Motion([jk.Body(1.0, 0.0, O.fixed(-self.length * rod.y), rod)])

    def loads(self, t, q, u, motion, inputs):
        gravity = 9.81 + jnp.sin(3.0 * t) if self.way == 2 else 9.81
        return jk.weight(motion, -gravity * motion.N.y)

    def events(self, t, q, u):
        low = jk.falling(jnp.sin(q["angle"]) - 0.05 * t * u["rate"] ** 2 - 0.01 * self.length)
        return {"vertical": {0: q["angle"], 1: jk.rising(q["angle"]), -1: jk.falling(q["angle"]), 2: low}[self.way]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "quarters"), [(-1, 1), *(pytest.param(*x, marks=pytest.mark.weekly) for x in ((0, 1), (1, 3)))]
)
def test_a_pendulum_crosses_the_vertical_after_a_quarter_period(way, quarters):
    """A quarter of the period is sqrt(l / g) K(sin(a / 2)); its derivative by the length, that over 2 l."""

    def t_end(length):
        start = jk.State(jnp.array([0.9]), jnp.zeros(1))
        return jk.simulate(Pendulum(length, way), start, 2 * TS, rtol=1e-12, atol=1e-12, adjoint="forward").t_end

    expected = quarters * np.sqrt(1.3 / 9.81) * ellipk(np.sin(0.45) ** 2)
    found, slope = jax.jit(lambda x: jax.jvp(t_end, (x,), (1.0,)))(1.3)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(slope, expected / 2.6, rtol=1e-9)


@pytest.mark.weekly
def test_second_derivatives_along_several_directions():
    """By a length, an angle and a rate; rates and the event read coordinates, speeds and the time. In forward mode,
    against differences of first derivatives. Forward over reverse is refused."""

    def end(x):
        ride = jk.simulate(Pendulum(x[0], 2), jk.State(x[1:2], x[2:]), 2 * TS, rtol=1e-12, atol=1e-12)
        return jnp.stack([ride.t_end, ride.end.q[0], ride.end.u[0]])

    x = jnp.array([1.3, 0.9, 0.2])
    first = jax.jit(jax.jacfwd(end))
    second = jax.jit(jax.jacfwd(jax.jacfwd(end)))(x)
    numeric = jnp.stack([(first(x + e) - first(x - e)) / 2e-4 for e in 1e-4 * jnp.eye(3)], axis=-1)
    assert jnp.abs(numeric).min() > 1e-3
    np.testing.assert_allclose(second, numeric, atol=1e-6)
    with pytest.raises(TypeError, match="use forward mode twice"):
        jax.jacfwd(jax.jacrev(end))(x)


@pytest.mark.slow
def test_an_event_that_is_zero_at_the_start():
    """A particle that is thrown up returns later. If it is at rest or is thrown down, the event occurs at the start."""
    ride = dropped(0.0, 3.0)
    assert ride.reason == "ground"
    np.testing.assert_allclose(ride.t_end, 6.0 / 9.81, atol=1e-9)
    either = dropped(0.0, 3.0, Particle(ends="either"))
    np.testing.assert_allclose(either.t_end, 6.0 / 9.81, atol=1e-9)
    for v in (0.0, -1.0):
        at_once = dropped(0.0, v)
        assert at_once.reason == "ground"
        assert float(at_once.t_end) == 0.0
        assert np.isfinite(at_once.q[0]).all()
        assert np.isnan(at_once.q[1:]).all()


@pytest.mark.weekly
def test_the_earliest_of_several_events_in_one_step_is_located():
    ride = dropped(1.0, 1.0, Particle(ends="roof"), step=2.0)
    assert ride.reason == "c top"
    np.testing.assert_allclose(ride.t_end, 1.0 / 9.81, atol=1e-9)
    ride = dropped(1.0, -0.1, Particle(ends="roof"), step=2.0)
    assert ride.reason == "b early"
    np.testing.assert_allclose(ride.t_end, exact(0.9, -0.1, 9.81)[0], atol=1e-9)


def test_an_event_at_a_sample_and_at_the_last_time():
    for t, ends in itertools.product((float(TS[4]), float(TS[-1])), ("ground", "either")):
        ride = dropped(0.5 * 9.81 * t**2, system=Particle(ends=ends))
        assert ride.reason == "ground"
        np.testing.assert_allclose(ride.t_end, t, atol=1e-9)
        n = int(np.searchsorted(np.asarray(TS), t - 1e-9)) + 1
        assert np.isfinite(ride.q[:n]).all()
        assert np.isnan(ride.q[n:]).all()


class Suction(Particle):
    """A force that exists down to a centimetre under the ground only."""

    def loads(self, t, q, u, motion, inputs):
        force = jnp.sqrt(q["h"] + 0.01) * motion.N.y
        return [*super().loads(t, q, u, motion, inputs), jk.Force(force, motion.bodies[0])]


@pytest.mark.weekly
def test_non_finite_trial_steps_are_rejected_without_nan_in_derivatives():
    """Trial steps that end under the ground are rejected and leave no NaN in derivatives in either mode."""

    def read(v, adjoint):
        ride = dropped(1.0, v[0], Suction(), adjoint=adjoint, rtol=1e-10, atol=1e-10)
        wanted = (ride.status == jk.Status.EVENT) & (ride.stats["rejected"] > 5)
        return jnp.where(wanted, ride["h"][1] + ride.t_end, jnp.nan)

    v = jnp.array([-0.2])
    forward, reverse = (slopes(read, mode) for mode in ("forward", "reverse"))
    numeric = differences(forward, v, 1e-5)
    assert np.isfinite(numeric)
    for both in (forward, reverse):
        np.testing.assert_allclose(both(v)[0], numeric, rtol=1e-5)


class Brake(eqx.Module):
    gain: jk.Scalar

    def __call__(self, t, state):
        return self.gain * state["vy"]


TOP = jnp.array([0.0, 1.0])


@pytest.mark.weekly
def test_outputs_after_an_early_end_are_nan():
    """Dependent speeds, a controller's input and projected coordinates, where they were reached; NaN where not."""

    def read(x, adjoint):
        level, speed, gain = x
        options = {"project": True, "adjoint": adjoint, "rtol": 1e-10, "atol": 1e-10}
        ride = jk.simulate(Bead(level), jk.State(TOP, speed[None]), TS, {"push": Brake(gain)}, **options)
        reached = ride["vy"][3] + 2.0 * ride["push"][4] + 3.0 * ride["y"][4]
        return jnp.stack([reached, ride.t_end + ride.end.u[0], ride["vy"][-1], ride["push"][-1], ride["y"][-1]])

    x = jnp.array([0.3, 1.0, 0.2])
    forward, reverse = (slopes(read, mode) for mode in ("forward", "reverse"))
    numeric = differences(forward, x, 1e-5)
    assert np.isfinite(numeric[:2]).all()
    for both in (forward, reverse):
        found, value = both(x)
        np.testing.assert_allclose(found[:2], numeric[:2], rtol=1e-5, atol=1e-8)
        assert np.isnan(value[2:]).all()
        assert np.isnan(found[2:]).all()


@pytest.mark.weekly
def test_other_end_times_have_nan_derivatives():
    """The end time by `max_steps` is not a smooth function, so its derivative is NaN, as is that of missing samples."""

    def few(v, adjoint):
        ride = dropped(100.0, v, Particle(ends="none"), max_steps=3, adjoint=adjoint)
        return jnp.stack([ride.t_end, ride["h"][-1], ride["h"][0]])

    for mode, adjoint in ((jax.jacfwd, "forward"), (jax.jacrev, "reverse")):
        found = jax.jit(mode(lambda v: few(v, adjoint)))(0.1)  # noqa: B023
        assert np.isnan(found[:2]).all()
        assert found[2] == 0.0
    assert dropped(100.0, 0.1, Particle(ends="none"), max_steps=3).reason == "max steps"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ends", "height", "options"), [("root", 0.21, {"step": 0.07}), ("lost", 0.2, {})], ids=["fixed", "adaptive"]
)
def test_an_event_function_that_becomes_nan(ends, height, options):
    """A zero near the NaN values is found. If the function becomes NaN before its zero, the simulation ends there."""
    ride = dropped(1.0, 0.0, Particle(ends=ends), **options)
    assert ride.reason == {"root": "low", "lost": "step too small"}[ends]
    np.testing.assert_allclose(ride.t_end, np.sqrt(2 * (1.0 - height) / 9.81), atol=1e-8)
    reached = np.asarray(TS) <= float(ride.t_end)
    np.testing.assert_allclose(ride["h"][reached], (1.0 - 4.905 * TS**2)[reached], atol=1e-9)
    assert np.isnan(ride.q[~reached]).all()


def test_an_event_that_is_not_finite_at_the_start_raises():
    with pytest.raises(ValueError, match="accelerations, rates or events are not finite near the initial state"):
        dropped(0.1, 0.0, Particle(ends="lost"))


@pytest.mark.weekly
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"step": 0.13},
        {"solver": diffrax.Heun()},
        {"solver": diffrax.HalfSolver(diffrax.Bosh3())},
        {"solver": diffrax.Kvaerno5()},
    ],
    ids=["Tsit5", "fixed", "Heun", "HalfSolver", "Kvaerno5"],
)
def test_derivatives_of_the_end_time_with_every_solver(kernels, options):
    """After some steps, and before any step: the rates there are those that the steps leave, or evaluated once more."""

    def end(x):
        ride = dropped(x[0], x[1], Particle(gravity=x[2]), adjoint="forward", **options)
        found = jnp.stack([ride.t_end, ride.end.q[0], ride.end.u[0]])
        return found, found

    both = jax.jit(jax.jacfwd(end, has_aux=True))
    for x in ([1.0, 0.3, 9.81], [0.0, -1.0, 9.81]):
        slope, found = both(jnp.array(x))
        np.testing.assert_allclose(found, exact(*x), atol=1e-6)
        np.testing.assert_allclose(slope, jax.jacfwd(lambda x: exact(*x))(jnp.array(x)), atol=2e-5)


class Stretched(Particle):
    """On a spring, whose force is the only hyperbolic tangent of all programs."""

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force(-jnp.tanh(q["h"]) * motion.N.y, motion.bodies[0].center)]


@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_xla_compiles_the_accelerations_once(platform, by_xla):
    """The longest program of all; an event needs them at the end, where the last step leaves them."""
    lowered = jax.jit(lambda h: dropped(h, 0.0, Stretched()).t_end).trace(1.0).lower(lowering_platforms=(platform,))
    text = lowered.as_text()
    # On a CPU, the accelerations are one function with several calls. On a GPU, each evaluation is part of its caller.
    (function,) = [f for f in re.split(r"\n  func\.func ", text) if "stablehlo.tanh" in f]
    name = re.search(r"@([\w.]+)", function).group(1)
    calls = len(re.findall(rf"call @{name}\(", text))
    assert calls * function.count("stablehlo.tanh") == 2  # in the loop, and halfway to the event


@pytest.mark.weekly
def test_an_event_of_a_stabilized_simulation():
    ride = jk.simulate(Bead(), jk.State(TOP, jnp.ones(1)), TS, stabilize=10.0)
    assert ride.reason == "low"
    np.testing.assert_allclose(ride.t_end, np.arccos(0.3), atol=1e-6)
    np.testing.assert_allclose(ride.end.q, [np.sqrt(0.91), 0.3], atol=1e-6)


class Cubic(Sled):
    """Its event is a cubic polynomial of its place. Its speed is 1."""

    p: jax.Array = jk.parameter((0.0, 0.0, 0.0, 1.0))
    event: Callable = eqx.field(static=True, default=jk.rising)

    def events(self, t, q, u):
        a, b, c, d = (self.p[i] for i in range(4))
        return {"zero": self.event(((a * q["x"] + b) * q["x"] + c) * q["x"] + d)}


@pytest.mark.weekly_cases("falling", "both")
@pytest.mark.parametrize(
    ("event", "way"), [(jk.rising, 1), (jk.falling, -1), (lambda x: x, 0)], ids=["rising", "falling", "both"]
)
def test_the_first_crossing_of_cubics_within_one_step(event, way):
    """Against the roots of random cubics. Some begin at zero, and some cross zero twice in succession."""
    rng = np.random.default_rng(0)
    p = rng.normal(size=(100, 4))
    p[::7, 3] = 0.0
    p[:40:2] = [np.poly([x, x + 0.08, y]) for x, y in rng.uniform([0.1, 1.1], [0.9, 3.0], (20, 2))]
    p[1:3] = np.poly([0.2, 0.5, 0.8]), -np.poly([0.2, 0.5, 0.8])
    ends = jax.jit(
        jax.vmap(lambda p: jk.simulate(Cubic(p=p, event=event), jk.State([0.0], [1.0]), [0.0, 1.0], step=1.0).t_end)
    )
    for coefficients, t_end in zip(p, np.asarray(ends(p)), strict=True):
        roots = np.roots(coefficients)
        roots = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
        slopes = np.polyval(np.polyder(coefficients), roots)
        crossings = [r for r, s in zip(roots, slopes, strict=True) if 1e-9 < r <= 1 and way * s >= 0]
        if way and coefficients[3] == 0 and way * coefficients[2] > 0:
            crossings = [0.0]
        np.testing.assert_allclose(t_end, crossings[0] if crossings else 1.0, atol=1e-7)


@pytest.mark.weekly
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_by_sample_times_agree_with_differences(mode):
    """Two signals, one of whose kinks stand at one time; the times of the ride itself; against central differences."""
    kinks = jnp.array([0.1, 0.35, 0.8, 1.1, 1.7])
    others, values = jnp.array([0.05, 0.35, 0.6, 1.2, 1.9]), jnp.array([1.0, -2.0, 3.0, -1.0, 2.0])
    ts = jnp.linspace(0.02, 2.0, 5)

    def height(x, adjoint):
        """x: the delay of a signal; of all times of the ride."""
        one, other = jk.Samples(kinks + x[0], 5 * values), jk.Samples(others, -3 * values)
        options = {"rtol": 1e-11, "atol": 1e-11, "adjoint": adjoint}
        drive = {"drive": lambda t, state: one(t) + other(t)}
        ride = jk.simulate(Particle(), jk.State(jnp.array([9.0]), jnp.zeros(1)), ts + x[1], drive, **options)
        return ride["h"][-1] + ride["v"][2]

    both, x = slopes(height, mode), jnp.zeros(2)
    np.testing.assert_allclose(both(x)[0], differences(both, x, 1e-5), rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": -0.1}, "`step` must be positive"),
        ({"rtol": 0.0}, "`rtol` must be positive"),
        ({"stabilize": -1.0}, "`stabilize` must be a finite, nonnegative rate"),
        ({"max_steps": 0}, "`max_steps` must be a positive whole number"),
        ({"max_steps": 2.5}, "`max_steps` must be a positive whole number"),
        ({"step": 0.1, "rtol": 1e-6}, "Pass either `step`"),
        ({"step": 0.1, "atol": 1e-6}, "Pass either `step`"),
        ({"adjoint": "backwards"}, "`adjoint` must be one of"),
        ({"solver": diffrax.Tsit5}, r"`solver` must be an instance, not a class: solver=diffrax.Tsit5\(\)"),
        ({"adjoint": diffrax.DirectAdjoint}, r"`adjoint` must be an instance, not a class: .*DirectAdjoint\(\)"),
    ],
)
def test_invalid_and_contradictory_options_raise(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        dropped(1.0, **options)


@pytest.mark.parametrize(
    ("inputs", "label"),
    [
        ({"drive": lambda t, s: 1.0 if t > 0.5 else 0.0}, "The input 'drive'"),
        ({"drive": lambda t, s: np.polyval([1.0, 0.0], t)}, "The input 'drive'"),
        (lambda t, s: {"drive": float(s["h"])}, "The function of the inputs"),
    ],
)
def test_inputs_that_need_concrete_values_raise(inputs, label):
    with pytest.raises(
        TypeError, match=rf"{label} uses a traced value .*jnp.polyval .* jnp.where\(a > b, x, y\) for `if`"
    ):
        jk.simulate(Particle(), jk.State(jnp.ones(1), jnp.ones(1)), TS, inputs)


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (lambda q: {"low": q["h"] < 0.5}, "The event 'low' is a boolean"),
        (lambda q: {"low": jk.falling(q["h"] < 0.5)}, "The event 'low' is a boolean"),
        (lambda q: [q["h"]], "events must return a dict of quantities by name"),
        (lambda q: {"low": q["h"] if q["h"] > 0.1 else 1.0}, r"Watching.events uses a traced value .* jnp.where"),
        (lambda q: {"max_steps": q[0] - 0.5}, "the event name 'max_steps' is reserved"),
    ],
)
def test_events_that_are_not_named_scalars_raise(events, message):
    class Watching(Particle):
        def events(self, t, q, u):
            return events(q)

    with pytest.raises((TypeError, ValueError), match=message):
        dropped(1.0, system=Watching())


def test_invalid_samples_raise():
    times = np.array([0.0, 1.0, 2.0])
    masked = np.ma.masked_array(times, [0, 1, 0])
    for ts, values in ((times[::-1], times), (times, times[:2]), (times[:1], times[:1]), (masked, times)):
        with pytest.raises(ValueError, match="Samples"):
            jk.Samples(ts, values)
    with pytest.raises(TypeError, match="Samples"):
        jk.Samples(times, times + 1j)
    for value, error in ((np.nan, ValueError), ("a", TypeError), (np.ones(11, complex), TypeError)):
        with pytest.raises(error, match="drive"):
            jk.simulate(Particle(), jk.State(jnp.ones(1), jnp.ones(1)), TS, {"drive": value})


def _of_a_batch(x, adjoint):
    """Of four members: when it ended, height and speed there, and the height at the first two times and the last."""
    rides = jax.vmap(lambda h, v: dropped(h, v, Particle(gravity=x[2, 0]), adjoint=adjoint))(x[0], x[1])
    heights = rides["h"][:, jnp.array([0, 1, -1])].T
    return jnp.stack([rides.t_end, rides.end.q[:, 0], rides.end.u[:, 0], *heights, rides.status.astype(float)], axis=1)


def _formulas(h, v, g):
    ends = jnp.stack([*exact(h, v, g), h, h + v * TS[1] - 0.5 * g * TS[1] ** 2])
    high = jnp.stack([2.0 + 0 * h, h + 2 * v - 2 * g, v - 2 * g, *ends[3:], h + 2 * v - 2 * g])
    return jnp.where(h > 20.0, high, jnp.append(ends, jnp.nan))


_OF_A_BATCH = {mode: slopes(_of_a_batch, mode) for mode in ("forward", "reverse")}
_BY_FORMULA = jax.jit(jax.vmap(slopes(lambda x, _: _formulas(*x), "forward"), in_axes=1))


@pytest.mark.weekly
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize(("h", "v", "g"), [(0.5, -0.5, 12.0), (1.2, 0.0, 9.81), (1.5, 2.0, 5.0)])
def test_batch_members_end_at_their_own_times_with_correct_derivatives(mode, h, v, g):
    """Two end early, one completes, and the start of one is no number. Derivatives by what is theirs and by what all
    share (g, in the first column) are those of the formula, and NaN where what is missing is read."""
    rtol = 1e-6
    x = jnp.array([[h, 50.0, jnp.nan, 1.1 * h], [v, v, 0.0, v + 0.1], [g] * 4])
    (found, values), (right, right_values) = _OF_A_BATCH[mode](x), _BY_FORMULA(x)  # (4,7,3,4) (4,7); (4,6,3) (4,6)
    ground, completed, invalid = jk.Status.EVENT, jk.Status.COMPLETED, jk.Status.INVALID
    assert list(values[:, 6]) == [ground, completed, invalid, ground]
    for k in (0, 1, 3):
        np.testing.assert_allclose(values[k, :6], right_values[k], atol=1e-8)
        n = 6 if k == 1 else 5  # a ride that ended has no height at the last time, and no derivative of it
        np.testing.assert_allclose(found[k, :n, :2, k], right[k, :n, :2], rtol=rtol, atol=rtol)
        np.testing.assert_allclose(found[k, :n, 2, 0], right[k, :n, 2], rtol=rtol, atol=rtol)
        assert not np.any(np.delete(found[k, :n, :2], k, axis=-1)), "of other members' numbers"
        assert k == 1 or np.isnan(found[k, 5, 0, k])
        assert k == 1 or np.isnan(found[k, 5, 2, 0])
    assert np.isnan(values[2, 1:6]).all()
    assert np.isnan(found[2, 1:6, 0, 2]).all(), "what is missing has no derivative"


@pytest.mark.weekly
@pytest.mark.parametrize(("adjoint", "derivative"), [("forward", jax.jacfwd), ("reverse", jax.jacrev)])
def test_derivatives_of_an_event_after_an_input_jump(adjoint, derivative):
    """A force of 1 N from 0.5 s + delay on. The step that begins there is rejected and repeated."""

    class Pushed(Particle):
        def events(self, t, q, u):
            return {"fast": jk.rising(u["v"] - 0.3)}

    def end(delay):
        drive = {"drive": jk.Samples(jnp.array([-1.0, 0.5]) + delay, jnp.array([0.0, 1.0]), zero_order_hold=True)}
        ride = jk.simulate(Pushed(gravity=0.0), jk.State([0.0], [0.0]), TS, drive, adjoint=adjoint)
        return jnp.stack([ride.t_end, ride.end.q[0], ride.end.u[0]]), ride["v"][3]

    found, slope = jax.jit(lambda d: (end(d), derivative(end)(d)))(0.01)
    np.testing.assert_allclose(found[0], [0.81, 0.045, 0.3], atol=1e-9)
    np.testing.assert_allclose(slope[0], [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(slope[1], -1.0, atol=1e-9)  # at 0.6 s


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"step": 0.05}], ids=["adaptive", "fixed"])
def test_a_function_that_touches_zero_without_crossing_it_is_not_an_event(options):
    class Passing(Particle):
        at: jk.Scalar = jk.parameter(0.5)

        def events(self, t, q, u):
            return {"square": (t - self.at) ** 2, "wave": jk.falling(1.0 - jnp.cos(3.0 * (t - self.at)))}

    start, ts = jk.State(jnp.array([1.0]), jnp.array([0.0])), jnp.linspace(0.0, 2.0, 21)
    times = jnp.concatenate([jnp.linspace(0.1, 1.9, 37), jnp.linspace(0.1234, 1.8, 100)])
    status = jax.jit(jax.vmap(lambda at: jk.simulate(Passing(at=at), start, ts, **options).status))(times)
    np.testing.assert_array_equal(status, 0)
