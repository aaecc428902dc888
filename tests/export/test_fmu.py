"""Functional mock-up units, imported by FMPy: variables, simulations, events, and errors for unsupported systems."""

import shutil
import subprocess
import zipfile
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Bead, Bob, BouncingBall, Odd, SliderCrank
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxkane as jk
from jaxkane.catalog import CATALOG

fmpy = pytest.importorskip("fmpy")
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu
CallFailed = pytest.importorskip("fmpy.fmi1").FMICallException
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
VERSIONS, KINDS = ("2.0", "3.0"), ("ModelExchange", "CoSimulation")
pytestmark = [
    pytest.mark.skipif(CC is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore:.*its description uses"),
    pytest.mark.filterwarnings("error:jaxkane.export.fmu"),  # of a failure of the compiler
]


class Driven(jk.System):
    """A mass on a spring, driven by a motor with a lag: linear, with an input, a state and outputs."""

    mass: jk.Scalar = jk.parameter(2.0, positive=True, unit="kg")
    stiffness: jk.Scalar = jk.parameter(30.0, within=(0.0, 1e4), unit="N/m")
    lag: jk.Scalar = jk.parameter(0.1, positive=True, unit="s")
    coordinates, speeds, states, inputs = ("x",), ("v",), ("force",), ("command",)
    units = {"x": "m", "force": "N", "command": "N", "acceleration": "m/s^2"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["force"] - self.stiffness * q["x"]) * motion.N.x, motion.bodies[0])

    def state_rates(self, t, q, u, x, motion, now):
        return ((now["command"] - x["force"]) / self.lag,)

    def outputs(self, t, q, u, motion, now):
        return {"acceleration": now.u_dot["v"], "spring": self.stiffness * q["x"]}


def matrices(mass=2.0, stiffness=30.0, lag=0.1):
    """The rates of (x, v, force) of `Driven` are A (x, v, force) + B command."""
    A = np.array([[0.0, 1.0, 0.0], [-stiffness / mass, 0.0, 1.0 / mass], [0.0, 0.0, -1.0 / lag]])
    return A, np.array([0.0, 0.0, 1.0 / lag])


def after(t, y, command, **parameters):
    """The state of `Driven` after a time with a constant command."""
    A, B = matrices(**parameters)
    exponential = expm(np.block([[A, B[:, None] * command], [np.zeros((1, 4))]]) * t)
    return exponential[:3, :3] @ y + exponential[:3, 3]


class Ball(jk.System):
    """It bounces for a time. An event whose condition is not met is passed over."""

    restitution: jk.Scalar = jk.parameter(0.8, within=(0.0, 1.0))
    duration: jk.Scalar = jk.parameter(10.0, unit="s")
    coordinates, speeds, states = ("h",), ("v",), ("bounces",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["h"] * N.y, u["v"] * N.y))])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def state_rates(self, t, q, u, x, motion, now):
        return {}

    def events(self, t, q, u, x):
        bounce = {"v": -self.restitution * u["v"], "bounces": x["bounces"] + 1.0}
        wall = jk.falling(q["h"] - 0.2, then={"v": 0.0}, when=-1.0 - 0.0 * q["h"])
        return {"end": t - self.duration, "floor": jk.falling(q["h"], then=bounce), "wall": wall}


class Clock(jk.System):
    """It counts events that depend only on the time. Two of them occur together."""

    coordinates, speeds, states = ("x",), ("v",), ("waves", "at", "twice")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x))])

    def state_rates(self, t, q, u, x, motion, now):
        return {}

    def events(self, t, q, u, x):
        return {
            "at": jk.rising(t - 0.3, then={"at": x["at"] + 1.0}),
            "twice": jk.falling(0.6 - 2.0 * t, then={"twice": x["twice"] + 1.0}),
            "waves": jk.rising(jnp.sin(20.0 * t), then={"waves": x["waves"] + 1.0}),
        }


class Switches(jk.System):
    """Two particles in a line, without forces. `log` contains a digit for each jump."""

    place: jk.Scalar = jk.parameter(0.7)
    coordinates, speeds, states = ("x", "y"), ("vx", "vy"), ("log",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[i] * N.x, u[i] * N.x), name="xy"[i]) for i in (0, 1)])

    def state_rates(self, t, q, u, x, motion, now):
        return {}

    def events(self, t, q, u, x):
        def log(digit, **new):
            return {"log": 10.0 * x["log"] + digit, **new}

        return {
            "couples": jk.rising(q["x"] - 1.0, then=(jk.Impact(u["vx"] - u["vy"]), log(4.0))),
            "double": jk.rising(q["x"], then=log(1.0, vx=2.0 * u["vx"])),
            "place": jk.rising(q["x"] - self.place, then=log(2.0)),
            "pulled": jk.rising(q["y"], then=log(5.0)),
            "time": jk.falling(2.1 - 3.0 * t, then=log(3.0)),
            "touch": jk.falling((t - 0.7) ** 2, then=log(8.0)),
            "turns": jk.rising(q["x"] - 1.2, then=log(6.0, vx=-u["vx"])),
            "turns_late": jk.rising(q["x"] - 1.2, then=log(9.0)),
        }


STATES = {
    "Driven": jk.State([0.1], [0.2], [0.3]),
    "Bob": jk.State([0.6, -0.8], [0.5]),
    "Ball": jk.State([1.0], [0.0], [0.0]),
    "Bead": jk.State([0.0, 1.0], [1.0]),
}


@pytest.fixture(scope="module")
def fmu_of(tmp_path_factory):
    """A function that exports each system once."""
    folder, done = tmp_path_factory.mktemp("fmu"), {}

    def export(system, fmi):
        name = type(system).__name__
        if (name, fmi) not in done:
            entry = CATALOG.get(name)
            state = jk.State(entry.q, entry.u) if entry else STATES.get(name)
            done[name, fmi] = str(jk.export.fmu(system, folder / f"{name}{fmi[0]}.fmu", fmi=fmi, state=state))
        return done[name, fmi]

    return export


class Unit:
    """An instance of an FMU: FMPy's functions, by names of variables."""

    def __init__(self, path, kind="CoSimulation"):
        self.folder, self.messages = fmpy.extract(path), []
        self.description = fmpy.read_model_description(self.folder)
        self.is_2 = self.description.fmiVersion == "2.0"
        self.reference = {x.name: x.valueReference for x in self.description.modelVariables}
        self.unit = fmpy.simulation.instantiate_fmu(self.folder, self.description, kind)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.unit.freeInstance()
        shutil.rmtree(self.folder)

    def references(self, names):
        return [self.reference[name] for name in names]

    def get(self, *names):
        return np.array((self.unit.getReal if self.is_2 else self.unit.getFloat64)(self.references(names)))

    def set(self, values):
        (self.unit.setReal if self.is_2 else self.unit.setFloat64)(self.references(values), list(values.values()))

    def start(self, values=(), t=0.0):
        if self.is_2:
            self.unit.setupExperiment(startTime=t)
            self.unit.enterInitializationMode()
        else:
            self.unit.enterInitializationMode(startTime=t)
        self.set(dict(values))
        self.unit.exitInitializationMode()

    def step(self, t, h):
        self.unit.doStep(currentCommunicationPoint=t, communicationStepSize=h)

    def derivative(self, unknowns, known):
        arguments = self.references(unknowns), self.references([known]), [1.0]
        return np.array(self.unit.getDirectionalDerivative(*arguments))


@pytest.mark.slow_cases(all_but=["Bob-2.0", "Driven-3.0"])
@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize(
    "name", ["Driven", "Bob", "Ball", "Odd", *(pytest.param(n, marks=pytest.mark.weekly) for n in CATALOG)]
)
def test_fmpy_validates_the_fmu(name, fmi, fmu_of):
    own = {"Driven": Driven, "Bob": Bob, "Ball": Ball, "Odd": Odd}
    system = own[name]() if name in own else CATALOG[name].example()
    if type(system).contacts is not jk.System.contacts:
        with pytest.raises(ValueError, match="an FMU cannot represent contacts"):
            fmu_of(system, fmi)
        return
    path = fmu_of(system, fmi)
    assert validate_fmu(path) == []
    last = fmpy.simulate_fmu(path, stop_time=0.02, fmi_type="CoSimulation")[-1]
    assert np.all(np.isfinite([*last]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fmi", "kind"), [("2.0", "co-simulation"), ("3.0", "co-simulation"), ("3.0", "model exchange")]
)
def test_an_fmu_for_co_simulation_or_model_exchange_only(fmi, kind, tmp_path):
    path = str(jk.export.fmu(Ball(), tmp_path / "ball.fmu", fmi=fmi, kind=kind, state=STATES["Ball"], sources=False))
    assert validate_fmu(path) == []
    description = fmpy.read_model_description(path)
    assert (description.coSimulation is None, description.modelExchange is None) == (
        kind != "co-simulation", kind == "co-simulation"
    )  # fmt: skip
    assert len(description.eventIndicators) == (3 if kind == "model exchange" else 0)
    assert fmpy.simulate_fmu(path, stop_time=0.1)["h"][-1] == pytest.approx(1.0 - 9.81 * 0.1**2 / 2, abs=1e-5)


@pytest.mark.slow
def test_the_source_compiles_without_warnings(fmu_of, tmp_path):
    for name, system in {"Driven": Driven(), "Bob": Bob(), "Ball": Ball()}.items():
        for fmi in VERSIONS:
            with zipfile.ZipFile(fmu_of(system, fmi)) as archive:
                file = tmp_path / f"{name}{fmi[0]}.c"
                file.write_bytes(archive.read(f"sources/{file.name}"))
            flags = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O1")
            subprocess.run([CC, *flags, "-c", file, "-o", tmp_path / "o"], check=True)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_variables_have_units_bounds_and_dependencies(fmi, fmu_of):
    description = fmpy.read_model_description(fmu_of(Driven(), fmi))
    x = {each.name: each for each in description.modelVariables}
    found = {
        name: (x[name].causality, x[name].variability, x[name].start, x[name].unit)
        for name in ("mass", "command", "x", "der(v)", "spring")
    }
    assert found == {
        "mass": ("parameter", "tunable", "2.0", "kg"),
        "command": ("input", "continuous", "0.0", "N"),
        "x": ("output", "continuous", "0.1", "m"),
        "der(v)": ("local", "continuous", None, "m/s^2"),
        "spring": ("output", "continuous", None, None),
    }
    assert (x["mass"].min, x["stiffness"].min, x["stiffness"].max) == ("0.0", "0.0", "10000.0")
    assert x["der(v)"].derivative is x["v"]
    read = {y.variable.name: {z.name for z in y.dependencies} for y in description.outputs + description.derivatives}
    assert read["spring"] == {"x"}
    assert read["acceleration"] == read["der(v)"] == {"x", "force"}
    assert read["der(force)"] == {"force", "command"}
    assert description.description.startswith("A mass on a spring")
    # a parameter of a constraint cannot change during the motion, and its coordinate is a guess
    of_bob = {each.name: each for each in fmpy.read_model_description(fmu_of(Bob(), fmi)).modelVariables}
    assert (of_bob["length"].variability, of_bob["y"].initial, of_bob["x"].initial) == ("fixed", "approx", "exact")
    # a parameter and a coordinate of one name
    names = [each.name for each in fmpy.read_model_description(fmu_of(Odd(), fmi)).modelVariables]
    assert {"angle", "parameters.angle", "moments[2]", "part.mass", "θ0"} < set(names)


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_simulation_agrees_with_the_analytical_solution(fmi, kind, fmu_of):
    """A linear system with an input: the matrix exponential. A pendulum in Cartesian coordinates: SciPy."""
    atol = {"ModelExchange": 1e-7, "CoSimulation": 1e-9}[kind]
    options = {"fmi_type": kind, "stop_time": 1.0, "output_interval": 0.25, "relative_tolerance": 1e-11}
    found = fmpy.simulate_fmu(
        fmu_of(Driven(), fmi), **options, output=["x", "v", "force", "acceleration", "spring"],
        start_values={"command": 5.0, "stiffness": 20.0},
    )  # fmt: skip
    for row in found:
        x, v, force = after(row["time"], np.array([0.1, 0.2, 0.3]), 5.0, stiffness=20.0)
        expected = x, v, force, (force - 20.0 * x) / 2.0, 20.0 * x
        np.testing.assert_allclose([*row][1:], expected, rtol=0, atol=5 * atol)

    found = fmpy.simulate_fmu(fmu_of(Bob(), fmi), **options, output=["x", "y", "vx", "vy"])
    angle, rate = np.arctan2(0.6, 0.8), 0.5 / 0.8
    motion = solve_ivp(
        lambda t, y: (y[1], -9.81 * np.sin(y[0])), (0.0, 1.0), (angle, rate), rtol=1e-12, atol=1e-12,
        t_eval=np.linspace(0.0, 1.0, 5),
    )  # fmt: skip
    s, c, rate = np.sin(motion.y[0]), np.cos(motion.y[0]), motion.y[1]
    expected = np.stack([s, -c, rate * c, rate * s], axis=1)
    np.testing.assert_allclose([[*row][1:] for row in found], expected, rtol=0, atol=atol)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_parameters_inputs_and_states_can_be_set_between_steps(fmi, fmu_of):
    """A changed parameter and input, a restored state, a serialized one, and a new start, by the matrix exponential."""
    atol = 1e-10
    names = ("x", "v", "force")
    start = np.array([-0.1, 0.4, 0.0])
    with Unit(fmu_of(Driven(), fmi)) as unit:
        unit.start({**dict(zip(names, start, strict=True)), "command": 1.0, "mass": 4.0}, t=3.0)
        unit.step(3.0, 0.25)
        expected = after(0.25, start, 1.0, mass=4.0)
        np.testing.assert_allclose(unit.get(*names), expected, rtol=0, atol=atol)
        save, restore = (getattr(unit.unit, f"{way}FMU{'state' if unit.is_2 else 'State'}") for way in ("get", "set"))
        state = save()
        unit.set({"command": -2.0, "stiffness": 50.0, "lag": 0.3})
        for t in (3.25, 3.35):
            unit.step(t, 0.1)
        changed = after(0.2, expected, -2.0, mass=4.0, stiffness=50.0, lag=0.3)
        np.testing.assert_allclose(unit.get(*names), changed, rtol=0, atol=atol)
        twice = unit.get("time", *names)
        restore(state)
        assert unit.get("command", "lag") == pytest.approx((1.0, 0.1), rel=0)
        unit.set({"command": -2.0, "stiffness": 50.0, "lag": 0.3})
        for t in (3.25, 3.35):
            unit.step(t, 0.1)
        np.testing.assert_array_equal(unit.get("time", *names), twice)
        if unit.is_2:  # FMPy has no such function for FMI 3
            restore(unit.unit.deSerializeFMUstate(unit.unit.serializeFMUstate(state)))
            np.testing.assert_array_equal(unit.get(*names)[0], unit.get("x")[0])
            assert unit.get("time")[0] == 3.25
        unit.unit.reset()
        unit.start()
        assert unit.get("time", "x", "mass", "command") == pytest.approx((0.0, 0.1, 2.0, 0.0), rel=0)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_directional_derivatives(fmi, fmu_of):
    """Of a linear system its matrices; by a parameter, and of a pendulum, those of JAX."""
    rtol = 1e-12
    with Unit(fmu_of(Driven(), fmi), "ModelExchange") as unit:
        unit.start()
        A, B = matrices()
        rates = ("der(x)", "der(v)", "der(force)")
        found = np.stack([unit.derivative(rates, name) for name in ("x", "v", "force", "command")], axis=1)
        np.testing.assert_allclose(found, np.column_stack([A, B]), rtol=rtol, atol=0)
        np.testing.assert_allclose(unit.derivative(("acceleration", "spring"), "x"), (-15.0, 30.0), rtol=rtol)
        # v_dot = (force - stiffness x)/mass at x = 0.1, force = 0.3
        np.testing.assert_allclose(unit.derivative(("der(v)", "spring"), "mass"), ((3.0 - 0.3) / 4.0, 0.0), rtol=rtol)
        with pytest.raises(CallFailed, match="error"):
            unit.derivative(rates, "acceleration")

    def rates_of(q, u, length):
        system = Bob(length)
        return jnp.concatenate([jk.coordinate_rates(system, 0.0, q, u), jk.accelerations(system, 0.0, q, u, {})])

    q, u = jnp.array([0.6, -0.8]), jnp.array([0.5])
    expected = np.column_stack([np.reshape(x, (3, -1)) for x in jax.jit(jax.jacfwd(rates_of, (0, 1)))(q, u, 1.0)])
    with Unit(fmu_of(Bob(), fmi), "ModelExchange") as unit:
        unit.start()
        found = [unit.derivative(("der(x)", "der(y)", "der(vx)"), name) for name in ("x", "y", "vx")]
        np.testing.assert_allclose(np.transpose(found), expected, rtol=rtol, atol=1e-14)


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_events_reset_states_and_end_the_simulation(fmi, kind, fmu_of):
    """A ball: parabolas between its bounces, until an event ends the simulation."""
    atol = {"ModelExchange": 1e-8, "CoSimulation": 1e-12}[kind]
    path = fmu_of(Ball(), fmi)
    options = {"fmi_type": kind, "output_interval": 0.05, "relative_tolerance": 1e-12, "output": ["h", "v", "bounces"]}
    found = fmpy.simulate_fmu(path, stop_time=2.5, **options, record_events=False)
    rows = [[*row] for row in found]
    assert len(rows) == 51
    g, fall = 9.81, np.sqrt(2 / 9.81)
    for t, h, v, bounces in rows:
        at, n, speed, length = -fall, 0, g * fall, 2 * fall  # a bounce before the start has its top at the start
        while t - at > length:
            at, n = at + length, n + 1
            speed = 0.8**n * g * fall
            length = 2 * speed / g
        expected = speed * (t - at) - g * (t - at) ** 2 / 2, speed - g * (t - at)
        np.testing.assert_allclose((h, v, bounces), (*expected, n), rtol=0, atol=50 * atol)
    early = fmpy.simulate_fmu(path, stop_time=2.5, **options, start_values={"duration": 0.33})
    assert early["time"][-1] == pytest.approx(0.33, abs=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_time_events_occur_once(kind, fmu_of):
    """Also at the start, and at a communication point. The sine rises through zero at 0, 0.314, 0.628 and 0.942 s."""
    last = fmpy.simulate_fmu(fmu_of(Clock(), "3.0"), fmi_type=kind, stop_time=1.0, output_interval=0.1)[-1]
    assert [last[name] for name in ("waves", "at", "twice")] == [4.0, 1.0, 1.0]


@pytest.mark.slow_cases(all_but=["3.0"])
@pytest.mark.parametrize("fmi", VERSIONS)
def test_events_occur_as_in_simulate(fmi, tmp_path):
    """A kick that does not reverse, events of place and time at one instant, a function that touches zero, an impact
    that only slows, an event after the jump of another, and one that is reversed before it occurs."""
    start, names = jk.State([-0.35, 0.0], [1.0, 0.0], [0.0]), ["x", "y", "vx", "vy", "log"]
    expected = jk.simulate(Switches(), start, jnp.linspace(0.0, 1.28, 9))
    assert float(expected["log"][-1]) == 123456.0
    # In many short steps, rounding errors would separate the events that occur at one instant.
    path = str(jk.export.fmu(Switches(), tmp_path / "switches.fmu", fmi=fmi, step=0.01, state=start))
    for kind in KINDS:
        found = fmpy.simulate_fmu(
            path, fmi_type=kind, stop_time=1.28, output_interval=0.16, relative_tolerance=1e-10, record_events=False,
            output=names,
        )  # fmt: skip
        for name in names:
            np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-9, err_msg=f"{kind} {name}")
    with Unit(path) as unit:  # a changed parameter makes a function cross zero
        unit.start()
        unit.set({"place": -1.0})
        unit.step(0.0, 0.1)
        unit.step(0.1, 0.1)
        assert unit.get("log")[0] == 2.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_ball_does_not_fall_through_the_floor(kind, restitution, fmu_of):
    """Its bounces become shorter than any tolerance, at (1 + 2 e / (1 - e)) sqrt(2 h / g) = 0.45 and 1.35 s."""
    with pytest.raises(CallFailed, match="error"):
        fmpy.simulate_fmu(
            fmu_of(Ball(), "3.0"), fmi_type=kind, stop_time=3.0, start_values={"restitution": restitution},
            relative_tolerance=1e-10,
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("fmi", VERSIONS)
def test_singular_dependent_speeds_end_the_simulation(fmi, fmu_of):
    """A bead on a circle, x = sin t: at pi/2 its vertical speed no longer follows from the horizontal one. Steps of
    fixed length would turn back there."""
    with Unit(fmu_of(Bead(ends=False), fmi)) as unit:
        unit.start()
        unit.step(0.0, 1.5)
        if unit.is_2:
            with pytest.raises(CallFailed, match="discard"):
                unit.step(1.5, 0.1)
            terminates = unit.unit.getBooleanStatus(3)  # fmi2Terminated
        else:
            terminates = unit.unit.doStep(1.5, 0.1)[1]
        (t,) = unit.get("time")
        assert terminates
        assert 1.5 < t < np.pi / 2
        assert unit.get("x", "y") == pytest.approx((np.sin(t), np.cos(t)), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", VERSIONS)
def test_start_values_satisfy_the_constraints(fmi, fmu_of):
    atol = 1e-12
    with Unit(fmu_of(Bob(), fmi)) as unit:
        unit.start({"length": 2.0, "x": 1.2, "vx": 0.8})
        assert unit.get("y", "vy") == pytest.approx((-1.6, 0.6), abs=atol)  # x vx + y vy = 0
        with pytest.raises(CallFailed):  # a coordinate would violate the constraint
            unit.set({"length": 1.0})
    with Unit(fmu_of(Bob(), fmi)) as unit, pytest.raises(CallFailed):
        unit.start({"x": 3.0})  # longer than the pendulum
    with Unit(fmu_of(SliderCrank(), fmi)) as unit:
        unit.start({"crank": 1.0, "rod": 0.1, "x": 1.0})
        rod = -np.arcsin(0.15 * np.sin(1.0) / 0.4)
        assert unit.get("rod", "x") == pytest.approx((rod, 0.15 * np.cos(1.0) + 0.4 * np.cos(rod)), abs=atol)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_wrong_values_and_calls_are_refused(fmi, fmu_of):
    with Unit(fmu_of(Driven(), fmi)) as unit:
        unit.start()
        for wrong in ({"mass": 0.0}, {"mass": -1.0}, {"stiffness": 2e4}, {"lag": np.nan}, {"x": 1.0}, {"spring": 1.0}):
            with pytest.raises(CallFailed):
                unit.set(wrong)
        for t, h in ((0.5, 0.1), (0.0, -0.1), (0.0, np.nan)):
            with pytest.raises(CallFailed):
                unit.step(t, h)
        unit.set({"command": np.nan})
        with pytest.raises(CallFailed):
            unit.step(0.0, 0.1)


POWERS = {
    "N m/rad": {"kg": 1, "m": 2, "s": -2, "rad": -1},
    "kg m^2": {"kg": 1, "m": 2},
    "N/(m/s)": {"kg": 1, "s": -1},
    "m/s/s": {"m": 1, "s": -2},
    "1/s": {"s": -1},
    "W/m K": None,  # divided by K or not?
    "furlong": None,
    "kg */": None,
}


@pytest.mark.slow
def test_units_as_powers_of_base_units(tmp_path):
    parameters = {f"p{i}": jk.parameter(1.0, unit=unit) for i, unit in enumerate(POWERS)}
    system = type("Units", (Bob,), {"__annotations__": dict.fromkeys(parameters, jk.Scalar), **parameters})()
    with zipfile.ZipFile(jk.export.fmu(system, tmp_path / "units.fmu")) as files:
        units = ElementTree.fromstring(files.read("modelDescription.xml")).iter("Unit")
    found = {unit.get("name"): unit.find("BaseUnit") for unit in units}
    for unit, powers in POWERS.items():
        base = found.get(unit)
        assert (None if base is None else {name: int(n) for name, n in base.items()}) == powers, unit


def with_members(**members):
    return type("Driven", (Driven,), members)()


def jumps_by_a_loop(self, t, q, u):
    return {"e": jk.falling(q["x"], then={"v": jax.lax.fori_loop(0, 3, lambda i, v: 0.5 * v, u["v"])})}


def many(n):
    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(x * N.x, v * N.x)) for x, v in zip(q, u, strict=True)])

    names = {"coordinates": tuple(f"x{i}" for i in range(n)), "speeds": tuple(f"v{i}" for i in range(n))}
    return type("Many", (jk.System,), {**names, "motion": motion})()


@pytest.mark.parametrize(
    ("system", "options", "error", "match"),
    [
        (Driven, {"path": "driven.zip"}, ValueError, r"must end with .fmu.*driven.zip"),
        (Driven, {"fmi": "1.0"}, ValueError, r"`fmi` must be '2.0' or '3.0', got '1.0'"),
        (Driven, {"kind": "cosimulation"}, ValueError, r"no kind cosimulation; did you mean 'co-simulation'"),
        (Driven, {"step": 0.0}, ValueError, r"`step` \[s\] must be positive and finite, got 0.0"),
        (lambda: many(0), {}, ValueError, r"Many has no coordinates\. Name them"),
        (Driven, {"state": jk.State([1.0, 2.0], [0.0])}, ValueError, r"no start values. Driven: q must have the shape"),
        (lambda: Driven(jnp.ones(3)), {}, ValueError, r"Driven is a batch: mass has"),
        (BouncingBall, {}, ValueError, r"BouncingBall: an FMU cannot represent contacts: floor. Replace them"),
        (lambda: jk.with_multipliers(Bob()), {}, ValueError, r"Bob: an FMU cannot represent multipliers"),
        (lambda: many(13), {}, ValueError, r"at most 12 independent speeds, and this system has 13"),
        (lambda: with_members(events=jumps_by_a_loop), {}, ValueError, r"`then` of the event e.*contains scan"),
        (lambda: with_members(inputs=("command", "a\nb")), {}, ValueError, r"cannot contain the name or unit 'a\\n"),
    ],
)
def test_systems_not_supported_by_fmi_are_rejected(system, options, error, match, tmp_path):
    path = tmp_path / options.pop("path", "driven.fmu")
    with pytest.raises(error, match=match):
        jk.export.fmu(system(), path, **options)
    assert not path.exists()


def test_a_traced_system_is_refused(tmp_path):
    with pytest.raises(TypeError, match="Driven is traced"):
        jax.eval_shape(lambda mass: jk.export.fmu(Driven(mass), tmp_path / "driven.fmu") and mass, jnp.ones(()))


def test_without_a_compiler_the_fmu_contains_sources(tmp_path, monkeypatch):
    path = tmp_path / "driven.fmu"
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.warns(UserWarning, match=r"'no-such-compiler' cannot be run.*driven.fmu contains only C source"):
        jk.export.fmu(Driven(), path)
    with pytest.raises(RuntimeError, match=r"cannot be run.*Install a C compiler, or pass sources=True"):
        jk.export.fmu(Driven(), path, sources=False)
    assert validate_fmu(str(path)) == []
    with zipfile.ZipFile(path) as archive:
        names, source = archive.namelist(), archive.read("sources/driven.c")
    monkeypatch.delenv("CC")
    first = jk.export.fmu(Driven(), path).read_bytes()
    with zipfile.ZipFile(path) as archive:
        (binary,) = {*archive.namelist()} - {*names}
        assert binary.startswith("binaries/")
        assert archive.read("sources/driven.c") == source
    assert jk.export.fmu(Driven(), path).read_bytes() == first  # equal systems give equal files
