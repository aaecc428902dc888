"""Every pair of a feature and a use of the library is tested, refused by name, or not applicable.

Entries of the tables are:

- the node name of a test, as `file::test`, relative to `tests/`; laws of this file have no file name;
- `Refused`: a call, and the message that names the feature and the cure;
- `NotApplicable`: the reason.

A pair without an entry fails. The laws need no reference: a result equals the same result computed in another way.
"""

import functools
import itertools
import pathlib
import re
import shutil
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

FEATURES = (
    "contacts",
    "jumps",  # events with `then`
    "states",  # of the first order
    "dependent speeds",
    "multipliers",  # `with_multipliers`
    "redundant loops",
    "functions",  # inputs by functions
    "samples",  # inputs by samples
    "delays",  # of samples
    "float32",
    "clocks",  # that start at 1.7e9 s
)
USES = ("simulate", "derivatives", "sweep", "fit", "collocation", "orbit", "filter", "FMU", "C")


class Oscillator(jk.System):
    """A force approaches the input exponentially. At the limit, the mass is thrown back."""

    mass: jk.Scalar = jk.parameter(2.0, positive=True, unit="kg")
    stiffness: jk.Scalar = jk.parameter(30.0, unit="N/m")
    limit: jk.Scalar = jk.parameter(0.2, unit="m")
    coordinates, speeds, states, inputs = ("x",), ("v",), ("force",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="mass")])

    def state_rates(self, t, q, u, x, motion, now):
        return {"force": (now["push"] - x["force"]) / 0.1}

    def loads(self, t, q, u, motion, inputs):
        force = inputs["force"] - self.stiffness * q["x"] - 0.5 * u["v"]
        return jk.Force(force * motion.N.x, motion["mass"])


class Jumping(Oscillator):
    def events(self, t, q, u):
        return {"limit": jk.rising(q["x"] - self.limit, then={"x": q["x"] - 0.05, "v": -0.8 * u["v"]})}


class Stopped(Oscillator):
    def contacts(self, t, q, u, motion):
        return {"stop": jk.Contact(gap=self.limit - q["x"], restitution=0.8)}


class Bead(jk.System):
    """On a parabola. A force approaches the input exponentially."""

    curvature: jk.Scalar = jk.parameter(2.0, unit="1/m")
    coordinates, dependent_coordinates = ("x", "y"), ("y",)
    speeds, dependent_speeds, states, inputs = ("v",), ("w",), ("force",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        bead = O.moving(q["x"] * N.x + q["y"] * N.y, u["v"] * N.x + u["w"] * N.y)
        return jk.Motion([jk.Body(1.5, 0.0, bead, name="bead")])

    def configuration_constraints(self, t, q):
        return [q["y"] - 0.5 * self.curvature * q["x"] ** 2]

    def state_rates(self, t, q, u, x, motion, now):
        return {"force": (now["push"] - x["force"]) / 0.1}

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["force"] * motion.N.x, motion["bead"])


class JumpingBead(Bead):
    def events(self, t, q, u):
        return {"limit": jk.rising(q["x"] - 0.4, then={"v": -0.8 * u["v"]})}


class StoppedBead(Bead):
    def contacts(self, t, q, u, motion):
        return {"stop": jk.Contact(gap=0.4 - q["x"], restitution=0.8)}


class Rockers(jk.System):
    """Two rockers carry a bar that remains horizontal: two residuals, of which one is redundant."""

    gravity: jk.Scalar = jk.parameter(9.81, unit="m/s^2")
    coordinates, speeds, inputs, states = ("a", "b"), ("a_dot", "b_dot"), ("push",), ("force",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A, B = N.rotate(3, q["a"], u["a_dot"], "A"), N.rotate(3, q["b"], u["b_dot"], "B")
        first = jk.Body(1.0, 0.0, O.fixed(-1.0 * A.y), name="first")
        second = jk.Body(3.0, 0.0, O.fixed(1.0 * N.x).fixed(-1.0 * B.y), name="second")
        return jk.Motion([first, second], frames={"A": A})

    def configuration_constraints(self, t, q):
        return [jnp.sin(q["a"]) - jnp.sin(q["b"]), jnp.cos(q["a"]) - jnp.cos(q["b"])]

    def state_rates(self, t, q, u, x, motion, now):
        return {"force": (now["push"] - x["force"]) / 0.1}

    def loads(self, t, q, u, motion, inputs):
        return *jk.weight(motion, -self.gravity * motion.N.y), jk.Torque(inputs["force"] * motion.N.z, motion["A"])


class JumpingRockers(Rockers):
    def events(self, t, q, u):
        return {"limit": jk.falling(q["a"] - 0.2, then={"a_dot": -0.8 * u["a_dot"]})}


class StoppedRockers(Rockers):
    def contacts(self, t, q, u, motion):
        return {"stop": jk.Contact(gap=q["a"] - 0.2, restitution=0.8)}


def without_redundancy(kind):
    """The same motion with one dependent speed."""
    names = {"dependent_coordinates": ("b",), "speeds": ("a_dot",), "dependent_speeds": ("b_dot",)}
    return type(kind.__name__, (kind,), {**names, "configuration_constraints": lambda self, t, q: [q["a"] - q["b"]]})


TS = np.array([0.0, 0.25, 0.5, 1.0])  # powers of two, which no clock rounds
PUSH = np.array([1.0, -2.0, 3.0, 0.5, -1.0])  # [N]
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
FREE = jk.State([0.1], [0.8], [1.0])
ON_PARABOLA = jk.State([0.3, 0.09], [1.0], [1.0])
HANGING = jk.State([0.5, 0.5], [0.0], [1.0])


def samples(t0=0.0, delay=0.0, dtype=np.float64):
    times = t0 + np.linspace(0.0, 1.0, PUSH.size) + delay
    return jk.Samples(times.astype(dtype), PUSH.astype(dtype))


def late(t, state):
    return samples()(t - 0.25)


def with_all_speeds(state):
    """The state with the dependent speeds of a bead on the parabola or of the rockers."""
    factor = 2.0 * state.q[0] if state is ON_PARABOLA else 1.0
    return jk.State(state.q, [state.u[0], factor * state.u[0]], state.x)


def ride_of(system, state, push=None, t0=0.0, **options):
    push = samples(t0) if push is None else push
    return jk.simulate(system, state, t0 + TS, {"push": push}, **{**TIGHT, **options})


@functools.cache
def solved(kind, multipliers=False):
    """A simulation with samples as input that uses its feature."""
    state = FREE if issubclass(kind, Oscillator) else ON_PARABOLA if issubclass(kind, Bead) else HANGING
    system = jk.with_multipliers(kind()) if multipliers else kind()
    ride = ride_of(system, with_all_speeds(state) if multipliers else state)
    assert ride.ok
    assert ride.jumps is None or int(ride.jumps.count) > 0
    return ride


def assert_same(found, expected, tolerance):
    for group in ("q", "x"):
        np.testing.assert_allclose(getattr(found, group), getattr(expected, group), rtol=0, atol=tolerance)
    speeds = [np.concatenate([ride.u, ride.u_dep], axis=1) for ride in (found, expected)]
    np.testing.assert_allclose(*speeds, rtol=0, atol=tolerance)
    if expected.jumps is not None:
        n = int(expected.jumps.count)
        assert int(found.jumps.count) == n
        times = [ride.jumps.t[:n] - ride.t[0] for ride in (found, expected)]
        np.testing.assert_allclose(*times, rtol=0, atol=max(tolerance, 3e-7))


SLOW_KINDS = pytest.mark.slow_cases("*Rockers")
WEEKLY_KINDS = pytest.mark.weekly_cases("Stopped*")
SINGLE = [Jumping, Stopped, JumpingBead, StoppedBead]
CONSTRAINED = [JumpingBead, JumpingRockers, StoppedBead, StoppedRockers]


def by_name(kinds):
    return pytest.mark.parametrize("kind", kinds, ids=lambda kind: kind.__name__)


@SLOW_KINDS
@WEEKLY_KINDS
@by_name(CONSTRAINED)
def test_multipliers_and_redundant_residuals_do_not_change_the_motion(kind):
    tolerance = 1e-7
    plain = without_redundancy(kind) if issubclass(kind, Rockers) else kind
    assert_same(solved(kind, multipliers=True), solved(plain), tolerance)


@SLOW_KINDS
@WEEKLY_KINDS
@by_name(CONSTRAINED)
def test_multipliers_do_not_depend_on_the_start_of_the_clock(kind):
    tolerance = 1e-9
    state = with_all_speeds(ON_PARABOLA if issubclass(kind, Bead) else HANGING)
    assert_same(ride_of(jk.with_multipliers(kind()), state, t0=1.7e9), solved(kind, multipliers=True), tolerance)


@SLOW_KINDS
@WEEKLY_KINDS
@by_name(SINGLE)
def test_jumps_and_contacts_with_states_and_samples_do_not_depend_on_the_start_of_the_clock(kind):
    tolerance = 1e-9
    state = FREE if issubclass(kind, Oscillator) else ON_PARABOLA
    assert_same(ride_of(kind(), state, t0=1.7e9), solved(kind), tolerance)


@pytest.mark.slow_cases("*Rockers", "*Bead")
@WEEKLY_KINDS
@by_name([*SINGLE, JumpingRockers, StoppedRockers])
def test_a_delay_in_a_function_equals_a_delay_of_the_samples(kind):
    tolerance = 1e-9
    multipliers = not issubclass(kind, Oscillator)
    state = FREE if issubclass(kind, Oscillator) else ON_PARABOLA if issubclass(kind, Bead) else HANGING
    system, state = (jk.with_multipliers(kind()), with_all_speeds(state)) if multipliers else (kind(), state)
    assert_same(ride_of(system, state, late), ride_of(system, state, samples(delay=0.25)), tolerance)


def in_float32(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


@pytest.mark.slow
@WEEKLY_KINDS
@by_name([Jumping, Stopped, *CONSTRAINED])
def test_float32_gives_the_motion_of_float64(kind):
    tolerance = 2e-3
    multipliers = not issubclass(kind, Oscillator)
    state = FREE if issubclass(kind, Oscillator) else ON_PARABOLA if issubclass(kind, Bead) else HANGING
    system, state = (jk.with_multipliers(kind()), with_all_speeds(state)) if multipliers else (kind(), state)
    for t0 in (0.0, 1.7e9):
        push = jk.Samples(t0 + np.linspace(0.0, 1.0, PUSH.size), PUSH.astype(np.float32))
        ride = jk.simulate(in_float32(system), in_float32(state), t0 + TS, {"push": push})
        assert ride.q.dtype == jnp.float32
        expected = solved(kind, multipliers)
        np.testing.assert_allclose(ride.q, expected.q, rtol=0, atol=tolerance)
        assert int(ride.jumps.count) == int(expected.jumps.count)


@pytest.mark.slow
def test_a_sweep_of_multipliers_equals_its_members():
    tolerance = 1e-9
    kind, state = JumpingRockers, with_all_speeds(HANGING)
    gravity = np.array([9.0, 9.81])
    system = jk.with_multipliers(kind(gravity))
    rides = jk.sweep.sweep(system, state, TS, {"push": samples()}, **TIGHT)
    np.testing.assert_allclose(rides.q[1], solved(kind, multipliers=True).q, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(rides.status, 0)


@pytest.mark.weekly
def test_derivatives_with_redundant_loops_equal_central_differences():
    rtol, h = 1e-5, 1e-4

    def last(gravity, adjoint):
        system = jk.with_multipliers(JumpingRockers(gravity))
        return ride_of(system, with_all_speeds(HANGING), adjoint=adjoint).q[-1, 0]

    values = [float(last(9.81 + step, "auto")) for step in (h, -h)]
    expected = (values[0] - values[1]) / (2 * h)
    for slope, adjoint in ((jax.jacfwd, "forward"), (jax.grad, "reverse")):
        found = jax.jit(slope(functools.partial(last, adjoint=adjoint)))(9.81)
        np.testing.assert_allclose(found, expected, rtol=rtol)


def fitted(system, ride, free, initial, t0=0.0, sigma=1e-3, **options):
    """A fit to one coordinate of a simulation."""
    channel = system.coordinates[0]
    trial = jk.fit.Trial(t0 + np.asarray(ride.t), {channel: np.asarray(ride[channel])}, sigma=sigma, initial=initial)
    return jk.fit.fit(system, [trial], [free], **options)


@pytest.mark.weekly
def test_a_fit_with_multipliers_recovers_the_parameter_of_its_simulation():
    rtol, ts = 1e-6, np.linspace(0.0, 1.0, 9)
    truth, state = jk.with_multipliers(Rockers()), with_all_speeds(HANGING)
    ride = jk.simulate(truth, state, ts, **TIGHT)
    initial = {"a": 0.5, "b": 0.5, "a_dot": 0.0, "b_dot": 0.0, "force": 1.0}
    accuracy = jk.fit.Simulation(rtol=1e-10, atol=1e-10)
    for t0 in (0.0, 1.7e9):
        found = fitted(jk.with_multipliers(Rockers(9.0)), ride, "inner.gravity", initial, t0, simulation=accuracy)
        assert found.ok
        np.testing.assert_allclose(found.estimates["inner.gravity"], 9.81, rtol=rtol)


@pytest.mark.weekly
def test_samples_over_one_period_force_an_orbit():
    """Samples that a function delays must cover two periods and the delay. Their orbit is the delayed orbit."""
    atol, period, delay = 1e-8, 0.5 * np.pi, 0.125 * np.pi

    def orbit(push, t=0.0):
        start = jk.State([0.0], [0.0], [0.0])
        return jk.stability.periodic(Oscillator(), start, {"push": push}, period=period, autonomous=False, t=t)

    def signal(first, n):  # four values in a period, and the first one again
        values = np.resize([1.0, -2.0, 3.0, 0.5], n)
        return jk.Samples(first + 0.25 * period * np.arange(n), values)

    once, several = signal(0.0, 5), signal(-period, 13)
    found = orbit(once)
    np.testing.assert_allclose(orbit(lambda t, state: several(t - delay), delay).state.q, found.state.q, atol=atol)
    with pytest.raises(ValueError, match="must cover two periods, and its delays"):
        orbit(lambda t, state: once(t - delay))


@pytest.mark.weekly
def test_an_orbit_in_float32_equals_the_closed_form():
    """m x'' + c x' + k x = F, with F = 1 / (1 + 0.1 i w) cos(w t)."""
    rtol, w = 1e-4, 4.0
    force = 1.0 / (1.0 + 0.1j * w)
    x = force / (30.0 - 2.0 * w**2 + 0.5j * w)
    start = in_float32(jk.State([0.0], [0.0], [0.0]))
    push = {"push": lambda t, state: jnp.cos(w * t)}
    orbit = jk.stability.periodic(
        in_float32(Oscillator()), start, push, period=np.float32(2 * np.pi / w), autonomous=False
    )
    assert orbit.states.dtype == jnp.float32
    expected = [x.real, (1j * w * x).real, force.real]
    np.testing.assert_allclose(orbit.states[0], expected, rtol=rtol, atol=rtol)


@pytest.mark.slow
def test_a_sweep_in_float32_with_time_stamps_of_today_equals_its_members():
    tolerance, of_float64, t0 = 1e-5, 2e-3, 1.7e9
    expected = solved(Jumping).q
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        push = jk.Samples(t0 + np.linspace(0.0, 1.0, PUSH.size), PUSH.astype(np.float32))
        table = {"stiffness": np.array([25.0, 30.0], np.float32)}
        system, state = in_float32(Jumping()), in_float32(FREE)
        rides = jk.sweep.sweep(system, state, t0 + TS, {"push": push}, table=table)
        assert rides.q.dtype == np.float32
        alone = jk.simulate(system, state, t0 + TS, {"push": push})
        np.testing.assert_allclose(rides.q[1], alone.q, rtol=0, atol=tolerance)
        np.testing.assert_allclose(rides.q[1], expected, rtol=0, atol=of_float64)
        np.testing.assert_allclose(rides.t_end, t0 + TS[-1], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_fit_in_float32_with_time_stamps_of_today_recovers_the_parameter_of_its_simulation():
    rtol, ts = 1e-3, np.linspace(0.0, 1.0, 9)
    ride = jk.simulate(Oscillator(), FREE, ts, **TIGHT)
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        initial = {"x": 0.1, "v": 0.8, "force": 1.0}
        found = fitted(in_float32(Oscillator(stiffness=28.0)), ride, "stiffness", initial, 1.7e9, sigma=0.01)
        # `ok` is not asserted. The residuals of exact measurements are rounding errors, which other steps change.
        np.testing.assert_allclose(found.estimates["stiffness"], 30.0, rtol=rtol)


def filtered(system, state, t=0.0):
    """The mean after three measurements."""
    of = jk.estimate.Filter(system, {"x": 0.01}, noise={"v": 0.01})
    belief = jk.estimate.begin(of, state, {"x": 0.1, "v": 0.1}, t)
    for x in (0.15, 0.14, 0.1):
        belief, _ = jk.estimate.update(of, jk.estimate.predict(of, belief, 0.0625, {"push": 0.3}), {"x": x})
    return belief.mean[0]


def test_a_filter_in_float32_equals_the_filter_in_float64():
    atol, of_clock = 1e-5, 1e-6
    expected = filtered(Oscillator(), FREE)
    np.testing.assert_allclose(filtered(Oscillator(), FREE, 1.7e9), expected, rtol=0, atol=of_clock)
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        system, state = in_float32(Oscillator()), in_float32(FREE)
        found = filtered(system, state)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
        with pytest.raises(ValueError, match=r"float32 resolves times near t = 1700000000 s only to 128 s\. Pass the"):
            filtered(system, state, 1.7e9)


CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")


@pytest.mark.slow
@needs_compiler
def test_an_fmu_does_not_depend_on_the_start_of_the_clock(tmp_path):
    """FMPy ends a simulation that is shorter than 1e-9 of its last time, so this simulation is longer."""
    atol = 1e-6  # the start times of the steps are rounded to 2.4e-7 s
    fmpy = pytest.importorskip("fmpy")
    path = str(jk.export.fmu(Oscillator(), tmp_path / "oscillator.fmu", kind="co-simulation", state=FREE))

    def simulated(t0):
        times = {"start_time": t0, "stop_time": t0 + 4.0, "output_interval": 0.25}
        return fmpy.simulate_fmu(path, **times, output=["x"], fmi_type="CoSimulation")["x"][:8]

    np.testing.assert_allclose(simulated(1.7e9), simulated(0.0), rtol=0, atol=atol)


def test_an_fmu_of_a_system_in_float32_contains_the_same_equations(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")

    def source(system, name):
        with pytest.warns(UserWarning, match="cannot be run"):
            path = jk.export.fmu(system, tmp_path / name / "oscillator.fmu", state=FREE)
        with zipfile.ZipFile(path) as archive:
            names = [each for each in archive.namelist() if each.endswith(".c")]
            return {each: archive.read(each) for each in names}

    with jax.numpy_dtype_promotion("standard"):
        system = Jumping(limit=0.25)  # float32 contains its parameters exactly
        assert source(in_float32(system), "single") == source(system, "double")


class Refused(NamedTuple):
    """A call that raises an exception, or warns. The message names the feature and the cure."""

    call: Callable[[], Any]
    message: str
    warns: bool = False


class NotApplicable(NamedTuple):
    reason: str


HAS_MULTIPLIERS = r"has multipliers.*Pass the system without multipliers"
REDUNDANT = r"configuration constraint 0 .*Omit the residual"
OMIT_NOISE = r"Fit with `noise`: events or contacts of \w+ change its state: \w+\..*Omit `noise`"


def problem(system, **more):
    return jk.collocation.Problem(system, 1.0, controls=[], **more)


def filter_of(system, **more):
    return jk.estimate.Filter(system, {system.coordinates[0]: 0.1}, **more)


def predicted(push):
    of = filter_of(Oscillator())
    return jk.estimate.predict(of, jk.estimate.begin(of, FREE, {"x": 0.1}), 0.1, {"push": push})


def with_noise(system, initial):
    ts, name = np.array([0.0, 0.5, 1.0]), system.coordinates[0]
    trial = jk.fit.Trial(ts, {name: 0.0 * ts}, {"push": 0.0 * ts}, sigma=0.1, initial=initial)
    return jk.fit.Problem.of(system, [trial], list(jk.export.parameters(system))[:1], noise={system.speeds[0]: 0.1})


def trial_with(push):
    return jk.fit.Trial(TS, {"x": TS}, {"push": push}, sigma=0.1)


def orbit_of(system, state):
    return jk.stability.periodic(system, state, period=1.0)


MULTIPLIERS, LOOP = (lambda: jk.with_multipliers(Bead())), (lambda: jk.with_multipliers(Rockers()))
INITIAL = {"x": 0.3, "y": 0.09, "v": 1.0, "w": 0.6, "force": 0.0}

SAMPLES_OF_FUNCTIONS = (
    "integrate/test_zero_order_hold.py::test_samples_called_by_a_function_equal_samples_passed_directly"
)
NO_INPUT = NotApplicable("inputs are numbers of each call")

WITH_USES: dict[str, dict[str, Any]] = {
    "contacts": {
        "simulate": "integrate/test_contact_laws.py::test_random_simulations_satisfy_the_contact_laws",
        "derivatives": "integrate/test_contact_laws.py::test_reverse_mode_equals_forward_mode",
        "sweep": "integrate/test_contact_laws.py::test_members_with_different_contact_states_are_independent",
        "fit": "fit/test_contacts.py::test_intervals_contain_restitution_friction_and_gap",
        "collocation": Refused(lambda: problem(Stopped()), r"Stopped has contacts.*link such phases"),
        "orbit": "stability/test_periodic.py::test_a_ball_on_a_vibrating_table_and_its_fold",
        "filter": Refused(lambda: filter_of(Stopped()), r"contacts of Stopped.*stop.*Estimate between the jumps"),
        "FMU": Refused(
            lambda: jk.export.fmu(Stopped(), "never.fmu"), r"cannot represent contacts: stop\. Replace them"
        ),
        "C": Refused(lambda: jk.export.c(Stopped(), "stopped.c", ("rates",)), r"stop\. .*do not contain them", True),
    },
    "jumps": {
        "simulate": "integrate/test_jumps.py::test_a_bouncing_ball_with_drag",
        "derivatives": "integrate/test_laws_of_simulations.py::test_forward_derivatives_equal_central_differences",
        "sweep": "integrate/test_laws_of_simulations.py::test_a_batch_equals_its_members_and_its_saved_files",
        "fit": Refused(lambda: with_noise(Jumping(), {"x": 0.1, "v": 0.0, "force": 0.0}), OMIT_NOISE),
        "collocation": "collocation/test_known_solutions.py::test_the_gait_of_a_walker",
        "orbit": "stability/test_periodic.py::test_rimless_wheel",
        "filter": Refused(lambda: filter_of(Jumping()), r"events .* of Jumping.*limit.*Estimate between the jumps"),
        "FMU": "export/test_fmu.py::test_events_reset_states_and_end_the_simulation",
        "C": Refused(lambda: jk.export.c(Jumping(), "jumping.c", ("rates",)), r"limit\. .*do not contain them", True),
    },
    "states": {
        "simulate": "integrate/test_states.py::test_states_of_a_linear_system_agree_with_the_exact_solution",
        "derivatives": "integrate/test_laws_of_simulations.py::test_forward_derivatives_equal_central_differences",
        "sweep": "integrate/test_states.py::test_a_sweep_over_parameters_and_initial_states",
        "fit": "integrate/test_states.py::test_a_lag_and_the_initial_value_of_a_state_are_identified",
        "collocation": "collocation/test_invariance.py::test_first_order_states_and_outputs",
        "orbit": "stability/test_periodic.py::test_a_section_may_read_first_order_states_at_any_time",
        "filter": "estimate/test_filter.py::test_derivatives_of_smoothed_and_late_states_are_exact",
        "FMU": "export/test_fmu.py::test_the_simulation_agrees_with_the_analytical_solution",
        "C": "integrate/test_states.py::test_exported_functions_take_states_after_the_inputs",
    },
    "dependent speeds": {
        "simulate": "integrate/test_audit.py::test_energy_balance_of_ten_seconds",
        "derivatives": "integrate/test_laws_of_simulations.py::test_forward_derivatives_equal_central_differences",
        "sweep": "sweep/test_sweep_tables.py::test_dependent_coordinates_are_recomputed_for_each_member",
        "fit": "fit/test_noise.py::test_the_likelihood_of_a_closed_loop_does_not_depend_on_units",
        "collocation": "collocation/test_invariance.py::test_dependent_coordinates_and_speeds",
        "orbit": "stability/test_periodic.py::test_constraints_add_no_floquet_multipliers",
        "filter": "estimate/test_filter.py::test_filtering_of_a_closed_loop_does_not_depend_on_units",
        "FMU": "export/test_fmu.py::test_start_values_satisfy_the_constraints",
        "C": "export/test_export.py::test_values_and_derivatives_in_c_agree_with_the_library",
    },
    "multipliers": {
        "simulate": "integrate/test_multipliers.py::test_with_multipliers_passes_singular_dependent_speeds",
        "derivatives": "integrate/test_laws_of_simulations.py::test_forward_derivatives_equal_central_differences",
        "sweep": "integrate/test_laws_of_simulations.py::test_a_batch_equals_its_members_and_its_saved_files",
        "fit": Refused(lambda: with_noise(MULTIPLIERS(), INITIAL), HAS_MULTIPLIERS),
        "collocation": Refused(lambda: problem(MULTIPLIERS()), HAS_MULTIPLIERS),
        "orbit": Refused(lambda: orbit_of(MULTIPLIERS(), with_all_speeds(ON_PARABOLA)), HAS_MULTIPLIERS),
        "filter": Refused(lambda: filter_of(MULTIPLIERS()), HAS_MULTIPLIERS),
        "FMU": Refused(
            lambda: jk.export.fmu(MULTIPLIERS(), "never.fmu"), r"cannot represent multipliers\. .*dependent speeds"
        ),
        "C": Refused(lambda: jk.export.c(MULTIPLIERS(), "never.c", ("rates",)), HAS_MULTIPLIERS),
    },
    "redundant loops": {
        "simulate": "test_multipliers_and_redundant_residuals_do_not_change_the_motion",
        "derivatives": "test_derivatives_with_redundant_loops_equal_central_differences",
        "sweep": "test_a_sweep_of_multipliers_equals_its_members",
        "fit": "test_a_fit_with_multipliers_recovers_the_parameter_of_its_simulation",
        "collocation": Refused(lambda: problem(Rockers()), REDUNDANT),
        "orbit": Refused(lambda: orbit_of(LOOP(), with_all_speeds(HANGING)), HAS_MULTIPLIERS),
        "filter": Refused(
            lambda: jk.estimate.begin(filter_of(Rockers()), with_all_speeds(HANGING), {"a": 0.1}), REDUNDANT
        ),
        "FMU": Refused(lambda: jk.export.fmu(Rockers(), "never.fmu"), r"no start values.*redundant constraints"),
        "C": Refused(lambda: jk.export.c(Rockers(), "never.c", ("rates",)), REDUNDANT),
    },
    "functions": {
        "simulate": "integrate/test_simulate.py::test_inputs_of_every_kind",
        "derivatives": "integrate/test_zero_order_hold.py::test_a_delay_in_a_function_or_a_system_is_differentiable",
        "sweep": "sweep/test_sweep_files.py::test_values_read_by_inputs_and_reduce_are_part_of_the_digest",
        "fit": Refused(lambda: trial_with(late), r"inputs\['push'\] must be samples .*Put feedback"),
        "collocation": "collocation/test_invariance.py::test_inputs_and_systems_that_depend_on_time",
        "orbit": "stability/test_periodic.py::test_an_input_function_forces_an_orbit",
        "filter": Refused(lambda: predicted(late), r"the input 'push' must be one number"),
        "FMU": NO_INPUT,
        "C": NO_INPUT,
    },
    "samples": {
        "simulate": SAMPLES_OF_FUNCTIONS,
        "derivatives": "integrate/test_laws_of_simulations.py::test_reverse_derivatives_equal_forward_derivatives",
        "sweep": "sweep/test_sweep.py::test_input_samples_with_different_times_and_missing_values",
        "fit": "fit/test_transcriptions.py::test_gradients_by_a_delay_with_shared_and_separate_sample_times",
        "collocation": "collocation/test_invariance.py::test_inputs_and_systems_that_depend_on_time",
        "orbit": "test_samples_over_one_period_force_an_orbit",
        "filter": Refused(lambda: predicted(samples()), r"must be one number, got Samples"),
        "FMU": NO_INPUT,
        "C": NO_INPUT,
    },
    "delays": {
        "simulate": "test_a_delay_in_a_function_equals_a_delay_of_the_samples",
        "derivatives": "integrate/test_zero_order_hold.py::test_a_delay_in_a_function_or_a_system_is_differentiable",
        "sweep": "sweep/test_sweep.py::test_a_member_has_the_discontinuities_of_its_input",
        "fit": "fit/test_transcriptions.py::test_the_delay_of_a_zero_order_hold_input_is_estimated",
        "collocation": NotApplicable("an input is a function of time, as above"),
        "orbit": "test_samples_over_one_period_force_an_orbit",
        "filter": "estimate/test_filter.py::test_fixed_lag_smoothing_and_late_measurements",
        "FMU": NO_INPUT,
        "C": NO_INPUT,
    },
    "float32": {
        "simulate": "integrate/test_laws_of_simulations.py::test_float32_gives_the_results_of_float64",
        "derivatives": "integrate/test_laws_of_simulations.py::test_float32_gives_the_results_of_float64",
        "sweep": "test_a_sweep_in_float32_with_time_stamps_of_today_equals_its_members",
        "fit": "test_a_fit_in_float32_with_time_stamps_of_today_recovers_the_parameter_of_its_simulation",
        "collocation": Refused(
            lambda: problem(in_float32(Oscillator())), r"needs float64 for collocation\. Call jaxkane\.configure"
        ),
        "orbit": "test_an_orbit_in_float32_equals_the_closed_form",
        "filter": "test_a_filter_in_float32_equals_the_filter_in_float64",
        "FMU": "test_an_fmu_of_a_system_in_float32_contains_the_same_equations",
        "C": "export/test_export.py::test_values_and_derivatives_in_c_agree_with_the_library",
    },
    "clocks": {
        "simulate": "integrate/test_clocks.py::test_elapsed_time_is_exact_at_samples",
        "derivatives": "integrate/test_laws_of_simulations.py::test_results_do_not_depend_on_the_start_of_the_clock",
        "sweep": "test_a_sweep_in_float32_with_time_stamps_of_today_equals_its_members",
        "fit": "fit/test_collocation.py::test_missing_samples_and_a_clock_offset_do_not_bias_estimates",
        "collocation": Refused(
            lambda: problem(Oscillator(), inputs={"push": samples(1.7e9)}), r"samples of the input 'push'.*subtract"
        ),
        "orbit": "stability/test_periodic.py::test_the_orbit_at_time_stamps_of_today_has_the_phase_of_the_force",
        "filter": "test_a_filter_in_float32_equals_the_filter_in_float64",
        "FMU": "test_an_fmu_does_not_depend_on_the_start_of_the_clock",
        "C": NotApplicable("the functions do not integrate"),
    },
}

JUMPS_OF_CONTACTS = "integrate/test_contact_systems.py::test_events_change_the_state_of_closed_contacts"
CLOCK = "test_jumps_and_contacts_with_states_and_samples_do_not_depend_on_the_start_of_the_clock"
CLOCK_OF_MULTIPLIERS = "test_multipliers_do_not_depend_on_the_start_of_the_clock"
SAME_MOTION = "test_multipliers_and_redundant_residuals_do_not_change_the_motion"
DELAY = "test_a_delay_in_a_function_equals_a_delay_of_the_samples"
SINGLE_PRECISION = "test_float32_gives_the_motion_of_float64"
COARSE_CLOCK = (
    "integrate/test_clocks.py::test_times_that_float32_cannot_resolve_are_rejected_if_something_depends_on_time"
)

# The laws simulate systems with states and with samples as inputs. The delays are delays in functions.
OF_TWO: dict[str, dict[str, Any]] = {
    "contacts": {
        "jumps": JUMPS_OF_CONTACTS,
        "states": CLOCK,
        "dependent speeds": SAME_MOTION,
        "multipliers": SAME_MOTION,
        "redundant loops": SAME_MOTION,
        "functions": DELAY,
        "samples": "integrate/test_contact_laws.py::test_an_input_discontinuity_at_the_time_of_an_impact",
        "delays": DELAY,
        "float32": SINGLE_PRECISION,
        "clocks": "integrate/test_contact_laws.py::test_results_do_not_depend_on_the_start_time",
    },
    "jumps": {
        "states": CLOCK,
        "dependent speeds": SAME_MOTION,
        "multipliers": SAME_MOTION,
        "redundant loops": SAME_MOTION,
        "functions": DELAY,
        "samples": "integrate/test_jumps.py::test_a_jump_at_a_discontinuity_of_an_input",
        "delays": DELAY,
        "float32": "integrate/test_jumps.py::test_times_of_jumps_in_float32_with_posix_times",
        "clocks": "integrate/test_laws_of_simulations.py::test_results_do_not_depend_on_the_start_of_the_clock",
    },
    "states": {
        "dependent speeds": SAME_MOTION,
        "multipliers": SAME_MOTION,
        "redundant loops": SAME_MOTION,
        "functions": DELAY,
        "samples": CLOCK,
        "delays": DELAY,
        "float32": SINGLE_PRECISION,
        "clocks": CLOCK,
    },
    "dependent speeds": {
        "multipliers": SAME_MOTION,
        "redundant loops": SAME_MOTION,
        "functions": "integrate/test_simulate.py::test_a_controller_reads_the_state_by_name",
        "samples": CLOCK,
        "delays": DELAY,
        "float32": "integrate/test_laws_of_simulations.py::test_float32_gives_the_results_of_float64",
        "clocks": CLOCK,
    },
    "multipliers": {
        "redundant loops": SAME_MOTION,
        "functions": DELAY,
        "samples": CLOCK_OF_MULTIPLIERS,
        "delays": DELAY,
        "float32": SINGLE_PRECISION,
        "clocks": CLOCK_OF_MULTIPLIERS,
    },
    "redundant loops": {
        "functions": DELAY,
        "samples": CLOCK_OF_MULTIPLIERS,
        "delays": DELAY,
        "float32": SINGLE_PRECISION,
        "clocks": CLOCK_OF_MULTIPLIERS,
    },
    "functions": {
        "samples": SAMPLES_OF_FUNCTIONS,
        "delays": DELAY,
        "float32": COARSE_CLOCK,
        "clocks": COARSE_CLOCK,
    },
    "samples": {
        "delays": DELAY,
        "float32": SINGLE_PRECISION,
        "clocks": CLOCK,
    },
    "delays": {
        "float32": COARSE_CLOCK,
        "clocks": "integrate/test_laws_of_simulations.py::test_results_do_not_depend_on_the_start_of_the_clock",
    },
    "float32": {"clocks": "integrate/test_jumps.py::test_times_of_jumps_in_float32_with_posix_times"},
}
PAIRS = {
    (feature, other): entry
    for table in (WITH_USES, OF_TWO)
    for feature in table
    for other, entry in table[feature].items()
}
REFUSED = {pair: entry for pair, entry in PAIRS.items() if isinstance(entry, Refused)}


def test_every_pair_has_an_entry():
    expected = [*itertools.product(FEATURES, USES), *itertools.combinations(FEATURES, 2)]
    assert sorted(PAIRS) == sorted(expected)


def test_named_tests_exist():
    here = pathlib.Path(__file__)
    for pair, entry in PAIRS.items():
        if isinstance(entry, NotApplicable):
            assert entry.reason, pair
        elif isinstance(entry, str):
            file, _, name = entry.rpartition("::")
            text = (here.parent / file if file else here).read_text(encoding="utf-8")
            assert re.search(rf"^def {name}\(", text, re.MULTILINE), (pair, entry)


@pytest.mark.parametrize("pair", REFUSED, ids=" and ".join)
def test_pairs_that_are_not_supported_are_refused_by_name(pair, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, message, warns = REFUSED[pair]
    message = f"(?s){message}"
    with pytest.warns(UserWarning, match=message) if warns else pytest.raises((ValueError, TypeError), match=message):
        call()
    assert not [*tmp_path.glob("never*")]
