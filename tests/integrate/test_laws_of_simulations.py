"""Laws of simulations, over a table of small systems: derivatives, clock, units, loop, batches and files.

Each law is a property of all simulations. A program is compiled once and shared by the laws. Compilation takes seconds,
so few systems have all features. For contacts, `test_contact_laws.py` has plain tests of the same laws.

| system | forward | reverse | clock | units | loop of diffrax | batch | file | float32 |
|---|---|---|---|---|---|---|---|---|
| event, hold, dependent, state | plain | plain | plain | plain | plain | plain | plain | plain |
| jump, linear | plain | slow | plain | plain | | slow | slow | |
| contact | slow | weekly | slow | slow | | weekly | weekly | |
| multipliers | plain | slow | plain | plain | slow | slow | slow | |

- event: ends the simulation. jump: an event with `then`. hold, linear: an input by samples. state: of the first order.
- The loop of diffrax does not support jumps and contacts.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_rescaled_systems import Units

import jaxkane as jk


class Oscillator(jk.System):
    mass: jk.Scalar = jk.parameter(unit="kg")
    stiffness: jk.Scalar = jk.parameter(unit="N/m")
    damping: jk.Scalar = jk.parameter(unit="N s/m")
    coordinates, speeds, inputs = ("x",), ("v",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="mass")])

    def loads(self, t, q, u, motion, inputs):
        force = inputs["push"] - self.stiffness * q["x"] - self.damping * u["v"]
        return jk.Force(force * motion.N.x, motion["mass"])


class ThrownBack(Oscillator):
    """At the limit, the mass is thrown back by a distance, and its velocity is reversed and reduced."""

    limit: jk.Scalar = jk.parameter(unit="m")
    distance: jk.Scalar = jk.parameter(unit="m")
    restitution: jk.Scalar = jk.parameter()

    def events(self, t, q, u):
        after = {"x": q["x"] - self.distance, "v": -self.restitution * u["v"]}
        return {"limit": jk.rising(q["x"] - self.limit, then=after)}


class WithStop(Oscillator):
    limit: jk.Scalar = jk.parameter(unit="m")
    restitution: jk.Scalar = jk.parameter()

    def contacts(self, t, q, u, motion):
        return {"stop": jk.Contact(gap=self.limit - q["x"], restitution=self.restitution)}


class Bead(jk.System):
    """A bead on a parabola."""

    mass: jk.Scalar = jk.parameter(unit="kg")
    curvature: jk.Scalar = jk.parameter(unit="1/m")
    gravity: jk.Scalar = jk.parameter(unit="m/s^2")
    coordinates, dependent_coordinates = ("x", "y"), ("y",)
    speeds, dependent_speeds = ("x_dot",), ("y_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        bead = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        return jk.Motion([jk.Body(self.mass, 0.0, bead, name="bead")])

    def configuration_constraints(self, t, q):
        return [q["y"] - 0.5 * self.curvature * q["x"] ** 2]

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.gravity * motion.N.y)


class PushedBead(Bead):
    """A force approaches the input exponentially. The simulation ends a `lead` time before a height is reached."""

    limit: jk.Scalar = jk.parameter(unit="m")
    lead: jk.Scalar = jk.parameter(unit="s")
    lag: jk.Scalar = jk.parameter(unit="s")
    states, inputs = ("force",), ("push",)

    def state_rates(self, t, q, u, x, motion, now):
        return {"force": (now["push"] - x["force"]) / self.lag}

    def loads(self, t, q, u, motion, inputs):
        push = jk.Force(inputs["force"] * motion.N.x, motion["bead"])
        return super().loads(t, q, u, motion, inputs), push

    def events(self, t, q, u):
        return {"high": jk.rising(q["y"] + self.lead * u["y_dot"] - self.limit)}


class Case(NamedTuple):
    """A system with its start and inputs as functions of a vector x (n,).

    Fields:

    - `x`, `units`: numbers by which the values are differentiated, and their units.
    - `states`: the units of the coordinates, independent speeds and first-order states.
    - `system`, `start`: functions of x.
    - `hold`: how the input is sampled; None without an input. The last entry of x is then the delay of the samples.
    """

    x: tuple[float, ...]
    units: tuple[str, ...]
    states: tuple[str, ...]
    system: Callable[[Any], jk.System]
    start: Callable[[Any], jk.State]
    hold: bool | None = None


OSCILLATOR, OF_OSCILLATOR = (2.0, 30.0, 0.5, 0.1, 0.8), ("kg", "N/m", "N s/m", "m", "m/s")


def oscillator(kind, more=(), units=(), hold=None):
    """`kind`: the class, whose other parameters are `more`."""
    return Case(
        (*OSCILLATOR, *more),
        (*OF_OSCILLATOR, *units),
        ("m", "m/s"),
        lambda x: kind(*x[:3], *(x[5:] if hold is None else x[5:-1])),
        lambda x: jk.State(x[3:4], x[4:5]),
        hold,
    )


CASES = {
    "event, hold, dependent, state": Case(
        (1.5, 2.0, 9.81, 0.3, 0.5, 0.07, 0.05, 0.3, 2.0, 0.0625),
        ("kg", "1/m", "m/s^2", "m", "m/s", "m", "s", "s", "N", "s"),
        ("m", "m", "m/s", "N"),
        lambda x: PushedBead(*x[:3], *x[5:8]),
        lambda x: jk.State(jnp.stack([x[3], 0.5 * x[1] * x[3] ** 2]), x[4:5], x[8:9]),
        hold=True,
    ),
    "jump, linear": oscillator(ThrownBack, (0.2, 0.05, 0.8, 0.0625), ("m", "m", "1", "s"), hold=False),
    "contact": oscillator(WithStop, (0.2, 0.8), ("m", "1")),
    "multipliers": Case(
        (1.5, 2.0, 9.81, 0.3, 0.5),
        ("kg", "1/m", "m/s^2", "m", "m/s"),
        ("m", "m", "m/s", "m/s"),
        lambda x: jk.with_multipliers(Bead(*x[:3])),
        lambda x: jk.State(jnp.stack([x[3], 0.5 * x[1] * x[3] ** 2]), jnp.stack([x[4], x[1] * x[3] * x[4]])),
    ),
}
HAS_JUMPS = ("jump, linear", "contact")
ENDS = ("event, hold, dependent, state",)

# Powers of two, so that no time is rounded after 1.7e9 s.
TS = np.array([0.0, 0.09375, 1.0])  # [s]
PUSH = np.array([1.0, -2.0, 3.0, 0.5, -1.0])  # [N]
# The tolerance does not depend on units, because `atol` is negligible.
TIGHT = {"rtol": 1e-10, "atol": 1e-30}


def inputs_of(name, x, ts, push):
    hold = CASES[name].hold
    if hold is None:
        return None
    times = ts[0] + np.linspace(0.0, 1.0, PUSH.size, dtype=ts.dtype) * (ts[-1] - ts[0]) + x[-1]
    return {"push": jk.Samples(times, push, zero_order_hold=hold)}


def ride_of(name, x, ts, push, **options):
    case = CASES[name]
    return jk.simulate(case.system(x), case.start(x), ts, inputs_of(name, x, ts, push), **{**TIGHT, **options})


def numbers_of(name, ride):
    """The states at the second time and at the end, and the times of the end and of the first jump since the start."""
    states = [x for state in (ride.state(1), ride.end) for x in (state.q, state.u, state.x) if x is not None]
    times = [ride.t_end, ride.jumps.t[0]] if name in HAS_JUMPS else [ride.t_end]
    return jnp.concatenate([*states, jnp.stack(times) - ride.t[0]])


def units_of(name):
    """The units of `numbers_of`."""
    return (*CASES[name].states * 2, *(("s", "s") if name in HAS_JUMPS else ("s",)))


def factors(units: Units, names):
    return np.array([units.factor(x) for x in names])


def assert_feature_is_used(name, ride):
    """A law would be true for a simulation without the event, the jump or the contact, too."""
    assert int(ride.status) == (jk.Status.EVENT if name in ENDS else jk.Status.COMPLETED)
    if name in HAS_JUMPS:
        assert int(ride.jumps.count) >= 1


@functools.cache
def forward(name):
    """(x, ts, push) -> the derivative (n_values, n) by x, the values, and the trajectory."""

    def values(x, ts, push):
        ride = ride_of(name, x, ts, push, adjoint="forward")
        found = numbers_of(name, ride)
        return found, (found, ride)

    return jax.jit(jax.jacfwd(values, has_aux=True))


@functools.cache
def solved(name, t0=0.0, units=Units()):  # noqa: B008
    """Derivatives and values, in SI units."""
    case = CASES[name]
    of_x, of_values = factors(units, case.units), factors(units, units_of(name))
    ts = t0 + TS * units.time
    slopes, (values, ride) = forward(name)(np.array(case.x) * of_x, ts, PUSH * units.factor("N"))
    assert_feature_is_used(name, ride)
    return np.asarray(slopes) * of_x / of_values[:, None], np.asarray(values) / of_values


def weighted(slopes, name):
    """Derivatives by the logarithms of x."""
    return slopes * np.abs(CASES[name].x)


@pytest.mark.slow_cases("contact")
@pytest.mark.parametrize("name", CASES)
def test_forward_derivatives_equal_central_differences(name):
    rtol, h = 1e-6, 1e-5
    slopes, values = solved(name)
    x = np.array(CASES[name].x)
    for i, slope in enumerate(weighted(slopes, name).T):
        after, before = (
            np.asarray(forward(name)(x + sign * h * np.abs(x) * np.eye(x.size)[i], TS, PUSH)[1][0]) for sign in (1, -1)
        )
        np.testing.assert_allclose(slope, (after - before) / (2 * h), rtol=rtol, atol=rtol * np.abs(values).max())


@pytest.mark.weekly_cases("contact")
@pytest.mark.slow_cases("jump, linear", "multipliers", "contact")
@pytest.mark.parametrize("name", CASES)
def test_reverse_derivatives_equal_forward_derivatives(name):
    """Of a sum of all values with unequal weights: one row is compiled in less time than a matrix."""
    rtol, of_values = 1e-9, 1e-12
    slopes, values = solved(name)
    weights = np.cos(np.arange(values.size))

    def total(x):
        found = numbers_of(name, ride_of(name, x, TS, PUSH, adjoint="reverse"))
        return weights @ found, found

    found, again = jax.jit(jax.grad(total, has_aux=True))(np.array(CASES[name].x))
    np.testing.assert_allclose(again, values, rtol=of_values)
    np.testing.assert_allclose(found, weights @ slopes, rtol=rtol, atol=rtol * np.abs(slopes).max())


@pytest.mark.slow_cases("contact")
@pytest.mark.parametrize("name", CASES)
def test_results_do_not_depend_on_the_start_of_the_clock(name):
    rtol, of_time = 1e-9, 2.4e-7  # [s] the resolution of float64 after 1.7e9 s
    (slopes, values), (expected_slopes, expected) = solved(name, t0=1.7e9), solved(name)
    n_times = units_of(name).count("s")
    np.testing.assert_allclose(slopes, expected_slopes, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(values[:-n_times], expected[:-n_times], rtol=rtol, atol=rtol)
    np.testing.assert_allclose(values[-n_times:], expected[-n_times:], rtol=0, atol=of_time)


UNITS = {
    "mm, t, ms": Units(1e3, 1e-3, 1e3),
    "short lengths": Units(1e-12, 1e-3, 1e3),
    "long lengths": Units(1e9, 1e3, 1e-3),
}


@pytest.mark.slow_cases("*-contact")
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("units", UNITS)
def test_results_do_not_depend_on_units(name, units):
    rtol = 1e-8
    for found, expected in zip(solved(name, units=UNITS[units]), solved(name), strict=True):
        np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * np.abs(expected).max())


class LoopOfDiffrax(diffrax.ForwardMode):
    """The loop of jaxkane supports `ForwardMode`, but not its subclasses."""


@pytest.mark.slow_cases("multipliers")
@pytest.mark.parametrize("name", [name for name in CASES if name not in HAS_JUMPS])
def test_the_loop_of_diffrax_gives_the_same_results(name):
    rtol = 1e-11
    ride = jax.jit(lambda x: ride_of(name, x, TS, PUSH, adjoint=LoopOfDiffrax()))(np.array(CASES[name].x))
    assert ride.adjoint == "LoopOfDiffrax"
    own = forward(name)(np.array(CASES[name].x), TS, PUSH)[1][1]
    assert int(ride.stats["steps"]) == int(own.stats["steps"])
    np.testing.assert_allclose(numbers_of(name, ride), solved(name)[1], rtol=rtol)


@pytest.mark.weekly_cases("contact")
@pytest.mark.slow_cases("jump, linear", "multipliers", "contact")
@pytest.mark.parametrize("name", CASES)
def test_a_batch_equals_its_members_and_its_saved_files(name, tmp_path):
    rtol = 1e-9  # of members; files are equal to the last bit
    case, factors = CASES[name], np.array([0.98, 1.0, 1.03])[:, None]
    xs = np.array(case.x) * factors
    inputs = None if case.hold is None else jax.vmap(lambda x: inputs_of(name, x, TS, PUSH))(xs)

    def swept():
        return jk.sweep.sweep(
            jax.vmap(case.system)(xs), jax.vmap(case.start)(xs), TS, inputs, folder=tmp_path / "rides", **TIGHT
        )

    rides = swept()
    for i, x in enumerate(xs):
        ride = forward(name)(x, TS, PUSH)[1][1]
        assert int(rides.status[i]) == int(ride.status)
        for group in ("q", "u", "x", "t_end"):
            np.testing.assert_allclose(getattr(rides, group)[i], getattr(ride, group), rtol=rtol, err_msg=group)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "rides").iterdir()}
    for loaded, saved in zip(jax.tree.leaves(swept()), jax.tree.leaves(rides), strict=True):
        np.testing.assert_array_equal(loaded, saved)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "rides").iterdir()} == written  # they were read


def test_float32_gives_the_results_of_float64():
    rtol, name = 1e-3, "event, hold, dependent, state"
    case = CASES[name]

    def values(x):
        ride = jk.simulate(case.system(x), case.start(x), ts, inputs_of(name, x, ts, push), adjoint="forward")
        found = numbers_of(name, ride)
        return found, found

    x, ts, push = (jnp.asarray(y, jnp.float32) for y in (case.x, TS, PUSH))
    slopes, found = jax.jit(jax.jacfwd(values, has_aux=True))(x)
    assert found.dtype == slopes.dtype == jnp.float32
    expected_slopes, expected = solved(name)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(slopes, expected_slopes, rtol=rtol, atol=rtol * np.abs(expected_slopes).max())
