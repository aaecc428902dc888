"""Programs follow what their code reads: a global, an attribute, a closure, a function that changed between calls."""

import array
import collections
import functools
import gc
import re
import sys
import types
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._scalarjit.cache_key import version_of

RTOL = 1e-12
TS = np.linspace(0.0, 0.2, 3)
GRAVITY = 9.81  # [m/s^2]
HELD = {"gravity": 9.81}
TABLE = np.array([9.81, 0.0])
PUSH = 0.0  # [m/s^2]
SETTINGS, NAMES = type("Settings", (), {})(), types.SimpleNamespace(gravity=9.81)
SETTINGS.gravity = 9.81
Slots = type("Slots", (), {"__slots__": ("gravity",)})


def helper():
    return GRAVITY


def in_a_nested_lambda():
    return (lambda: (lambda: GRAVITY)())()


DEFAULT = [9.81]


def with_default(gravity=DEFAULT):
    return gravity[0]


def closure():
    gravity = 9.81

    def read():
        return gravity

    def change(value):
        nonlocal gravity
        gravity = value

    return read, change


READ, CHANGE = closure()


class Drop(jk.System):
    """A particle that falls: x_dot_dot = gravity + push, whatever its mass."""

    mass: jk.Scalar = jk.parameter(2.0)
    coordinates, speeds, inputs = ("x",), ("v",), ("push",)
    attribute = 9.81
    mutable = {"gravity": [9.81]}

    def gravity(self):
        return GRAVITY

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force(self.mass * (self.gravity() + inputs["push"]) * motion.N.x, motion.bodies[0])]


def accelerate(system):
    return float(jk.accelerations(system, 0.0, [0.0], [0.0])[0])


def with_gravity(read):
    """A system whose gravity is what `read` says."""
    return type("Drop", (Drop,), {"gravity": lambda self: read(self), "__module__": __name__})()


def put(monkeypatch, values):
    """Change the first entry, in place."""
    monkeypatch.setattr(sys.modules[__name__], "restore", lambda: values.__setitem__(0, 9.81))
    values[0] = 1.62


def restore():
    pass


def in_module(name, value):
    return lambda monkeypatch: monkeypatch.setattr(sys.modules[__name__], name, value)


CHANGES = {
    "global": (lambda self: GRAVITY, in_module("GRAVITY", 1.62)),
    "global of a helper": (lambda self: helper(), in_module("GRAVITY", 1.62)),
    "global of a nested lambda": (lambda self: in_a_nested_lambda(), in_module("GRAVITY", 1.62)),
    "another helper": (lambda self: helper(), in_module("helper", lambda: 1.62)),
    "code of a helper": (  # as an autoreload puts it in
        lambda self: helper(),
        lambda monkeypatch: monkeypatch.setattr(helper, "__code__", (lambda: 1.62).__code__),
    ),
    "entry of a dict": (lambda self: HELD["gravity"], lambda m: m.setitem(HELD, "gravity", 1.62)),
    "entry of an array": (lambda self: TABLE[0], lambda m: put(m, TABLE)),
    "attribute of an object": (lambda self: SETTINGS.gravity, lambda m: m.setattr(SETTINGS, "gravity", 1.62)),
    "attribute of a namespace": (lambda self: NAMES.gravity, lambda m: m.setattr(NAMES, "gravity", 1.62)),
    "default": (lambda self: with_default(), lambda m: put(m, DEFAULT)),
    "replaced default": (lambda self: with_default(), lambda m: m.setattr(with_default, "__defaults__", ([1.62],))),
    "closure": (lambda self: READ(), lambda m: CHANGE(1.62)),
    "method": (lambda self: Drop.gravity(self), lambda m: m.setattr(Drop, "gravity", lambda self: 1.62)),
    "class attribute": (lambda self: self.attribute, lambda m: m.setattr(Drop, "attribute", 1.62)),
    "mutable class attribute": (
        lambda self: self.mutable["gravity"][0],
        lambda m: put(m, Drop.mutable["gravity"]),
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_detected(name, monkeypatch):
    read, change = CHANGES[name]
    system = with_gravity(read)
    assert accelerate(system) == pytest.approx(9.81, rel=RTOL)
    change(monkeypatch)
    assert accelerate(system) == pytest.approx(1.62, rel=RTOL)
    restore()
    CHANGE(9.81)


@pytest.mark.parametrize("where", ["import moon", "from moon import gravity", "import planets.moon"])
def test_changes_in_modules_imported_within_a_method_are_detected(where, monkeypatch):
    moon, planets = types.ModuleType("moon"), types.ModuleType("planets")
    vars(moon)["gravity"], vars(planets)["moon"] = 9.81, moon
    for name, module in {"moon": moon, "planets": planets, "planets.moon": moon}.items():
        monkeypatch.setitem(sys.modules, name, module)
    found = "gravity" if "from" in where else where.split()[1] + ".gravity"
    inside, outside = {"Drop": Drop}, {"Drop": Drop, "__name__": "notebook"}
    exec(f"class Inside(Drop):\n    def gravity(self):\n        {where}\n        return {found}", inside)
    exec(f"{where}\nclass Outside(Drop):\n    def gravity(self):\n        return {found}", outside)
    systems = [inside["Inside"](), *([] if "from" in where else [outside["Outside"]()])]
    assert [accelerate(s) for s in systems] == pytest.approx([9.81] * len(systems), rel=RTOL)
    vars(moon)["gravity"] = 1.62
    assert [accelerate(s) for s in systems] == pytest.approx([1.62] * len(systems), rel=RTOL)


def places():
    """By name: what reads a number, and what changes it."""
    module, kind = types.ModuleType("moon"), type("DictOfAUser", (dict,), {})
    made, listed = kind(), type("ListOfAUser", (list,), {})()
    module.gravity = made.gravity = listed.gravity = 9.81
    holder = type("Holder", (), {"module": module, "__module__": __name__})
    by_attribute = lambda m: m.gravity  # noqa: E731
    own = lambda: own.gravity  # noqa: E731
    own.gravity = 9.81
    cube = jax.custom_jvp(lambda x: x**3)
    with_rule = lambda slope: cube.defjvps(lambda dx, y, x: slope * dx)  # noqa: E731
    with_rule(9.81)
    yield "rule for derivatives", lambda: cube, lambda: with_rule(1.62)
    yield "module given to a function", lambda: by_attribute(module), lambda: setattr(module, "gravity", 1.62)
    yield "module of a class", lambda: by_attribute(holder.module), lambda: setattr(module, "gravity", 1.62)
    yield "module in a list", lambda: [m.gravity for m in [module]], lambda: setattr(module, "gravity", 1.62)
    yield "attribute of a function", own, lambda: setattr(own, "gravity", 1.62)
    yield "attribute of a dict's class", lambda: made.gravity, lambda: setattr(made, "gravity", 1.62)
    yield "attribute of a list's class", lambda: listed.gravity, lambda: setattr(listed, "gravity", 1.62)
    yield "method of a dict's class", lambda: made, lambda: setattr(kind, "__missing__", lambda d, k: 1.62)


@pytest.mark.parametrize("name", [name for name, *_ in places()])
def test_changes_in_captured_objects_are_detected(name):
    read, change = {name: both for name, *both in places()}[name]
    before = version_of(read)
    assert version_of(read) == before
    change()
    assert version_of(read) != before


@pytest.mark.parametrize("make", [Slots, lambda: collections.deque([9.81]), lambda: np.array([9.81], dtype=object)])
def test_opaque_objects_are_compared_by_identity(make):
    things = [make(), make()]
    one, other, again = (version_of(lambda thing=thing: thing) for thing in (*things, things[0]))
    assert one == again != other


class Bead(jk.System):
    """A particle on a line, whose place, mass, force, sensor and state follow GRAVITY."""

    mass: jk.Scalar = jk.parameter(2.0)
    coordinates, speeds, inputs, states = ("x",), ("v",), ("push",), ("lag",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        arm = N.rotate(1, GRAVITY * q[0], GRAVITY * u[0])
        P = O.moving(GRAVITY * q[0] * N.x, GRAVITY * u[0] * N.x)
        body = jk.Body(self.mass * GRAVITY, 0.0, P, name="bead")
        return jk.Motion([body], points={"P": P, "O": O.fixed(0.0 * N.x)}, frames={"arm": arm})

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force((inputs["push"] - q[0]) * motion.N.x, motion.bodies[0])]

    def state_rates(self, t, q, u, x, motion, now):
        return [now["push"] - GRAVITY * x[0]]

    def outputs(self, t, q, u, motion, now):
        return {"reading": GRAVITY * q[0]}

    def events(self, t, q, u):
        return {"there": q[0] - 2.0 + 1e-3 * GRAVITY}


class Still(jk.System):
    """A particle on a spring, which reads nothing."""

    mass: jk.Scalar = jk.parameter(2.0)
    coordinates, speeds, inputs = ("x",), ("v",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force((inputs["push"] - q[0]) * motion.N.x, motion.bodies[0])]


SHORT = {"step": 0.1, "solver": diffrax.Midpoint()}  # exact here, and compiled quickly
PLACE = jk.State(np.array([0.5]), np.array([0.3]), np.array([0.2]))
CENTER = jk.State(np.zeros(1), np.zeros(1), np.zeros(1))
HALF = jk.State(np.array([0.5]), np.zeros(1))
TWO = {"mass": np.array([1.0, 2.0])}


def fixed_ride():
    """A motion as it was found with the first number, to ask of it what depends on the second."""
    if "ride" not in vars(fixed_ride):
        fixed_ride.ride = jk.simulate(Bead(), PLACE, TS, **SHORT)
    return fixed_ride.ride


QUESTIONS: dict[str, Callable[[], Any]] = {
    "orientations": lambda: jk.orientations(Bead(), 0.0, [0.5], [0.3]),
    "symbolic.equations": lambda: repr(vars(jk.symbolic.equations(Bead()))),
    "outputs": lambda: jk.outputs(Bead(), 0.0, [0.5], [0.3], {"lag": 0.2}),
    "numpy": lambda: jk.export.numpy(Bead()),
    "simulate": lambda: jk.simulate(Bead(), PLACE, TS, **SHORT).q,
    "simulate with inputs": lambda: jk.simulate(Still(), HALF, TS, {"push": lambda t, s: GRAVITY}, **SHORT).q,
    "positions of a ride": lambda: jk.positions(Bead(), fixed_ride()),
    "linearize": lambda: tuple(jk.stability.linearize(Bead(), CENTER, outputs=["reading"])),
    "linearize with outputs": lambda: jk.stability.linearize(Still(), CENTER_OF_STILL, outputs=OUTPUTS).C,
    "sweep": lambda: jk.sweep.sweep(Bead(), PLACE, TS, table=TWO, **SHORT).q,
    "sweep(reduce)": lambda: jk.sweep.sweep(Still(), HALF, TS, table=TWO, reduce=REDUCE, **SHORT).values,
    "sweep from functions": lambda: jk.sweep.sweep(Still(), START, TS, table=TWO, **SHORT).q,
    "sweep of functions": lambda: jk.sweep.sweep(SYSTEM, HALF, TS, table={"m": TWO["mass"]}, **SHORT).q,
    "audit": lambda: repr(jk.audit(Bead(), fixed_ride())),
    "Problem": lambda: (p := jk.fit.Problem.of(Drop(), TRIAL, ["mass"], simulation=SIMULATION)).cost(p.start),
}
SIMULATION, TRIAL = jk.fit.Simulation(**SHORT), jk.fit.Trial(TS, {"x": TS}, sigma=1.0)
CENTER_OF_STILL = jk.State(np.zeros(1), np.zeros(1))
OUTPUTS = {"f": lambda t, q, u: GRAVITY * q["x"]}
REDUCE = lambda ride: GRAVITY * ride["x"][-1]  # noqa: E731
START = lambda system, row: jk.State(jnp.full(1, GRAVITY), jnp.zeros(1))  # noqa: E731
SYSTEM = lambda row: Still(GRAVITY * row["m"])  # noqa: E731


def bytes_of(answer):
    return answer if isinstance(answer, str) else [np.asarray(x).tobytes() for x in jax.tree.leaves(answer)]


@pytest.mark.weekly_cases(all_but=["orientations", "symbolic.equations"])
@pytest.mark.parametrize("name", QUESTIONS)
def test_public_functions_detect_a_changed_global(name, monkeypatch):
    ask = QUESTIONS[name]
    fixed_ride()
    before = bytes_of(ask())
    monkeypatch.setattr(sys.modules[__name__], "GRAVITY", 1.62)
    after = bytes_of(ask())
    jk.forget()
    assert before != after == bytes_of(ask())


class Controller:
    def __init__(self):
        self.push = 0.0

    def __call__(self, t, state):
        return {"push": self.push}

    def method(self, t, state):
        return self.push


def push(t, state, scale=None):
    return PUSH


def test_changes_in_input_functions_of_every_kind_are_detected(monkeypatch):
    controller = Controller()
    ways = [controller, {"push": controller.method}, {"push": push}, {"push": functools.partial(push, scale=HELD)}]
    ways += [jax.tree_util.Partial(push), jax.jit(push), eqx.filter_jit(push), Holder(push, 1.0)]
    before = [version_of(way) for way in ways]
    assert [version_of(way) for way in ways] == before
    controller.push = 1.0
    monkeypatch.setattr(sys.modules[__name__], "PUSH", 1.0)
    assert not set(before) & {version_of(way) for way in ways}
    assert version_of(Holder(push, 1.0)) == version_of(Holder(push, 2.0))  # a number that is an argument of the program


class Walled(Still):
    """Beside a wall that it meets before the last sample."""

    def events(self, t, q, u):
        return {"wall": q[0] - 0.52}


@pytest.mark.weekly
@pytest.mark.parametrize("derivative", [pytest.param(jax.jacrev, marks=pytest.mark.weekly), jax.jacfwd])
def test_values_captured_by_an_input_function_are_differentiable(derivative):
    start = jk.State(np.array([0.5]), np.array([0.3]))
    given = lambda k: jk.simulate(Walled(), start, TS, {"push": k}, **SHORT)["x"]  # noqa: E731
    captured = lambda k: jk.simulate(Walled(), start, TS, {"push": lambda t, state: 1.0 * k}, **SHORT)["x"]  # noqa: E731
    slopes = derivative(captured)(jnp.array(1.0))
    np.testing.assert_allclose(slopes, derivative(given)(jnp.array(1.0)), rtol=RTOL)
    assert np.isnan(slopes[-1])  # the wall is met before


@pytest.mark.slow
def test_a_sweep_is_differentiable_by_values_captured_in_its_functions():
    start = jk.State(np.array([0.5]), np.array([0.3]))

    def last(k):
        inputs = {"push": lambda t, state: 1.0 * k}
        return jk.sweep.sweep(Walled(), start, TS, inputs, table={"mass": [2.0]}, **SHORT)["x"][0]

    _, slopes = jax.jvp(last, (jnp.array(1.0),), (jnp.array(1.0),))
    assert slopes[0] == 0.0
    assert np.isnan(slopes[-1])


@pytest.mark.parametrize("method", ["events", "loads"])
def test_a_traced_value_captured_by_a_system_is_rejected(method):
    def ends_at(k):
        read = {"events": lambda self, t, q, u: {"wall": q[0] - k}, "loads": lambda self, *_: [k]}[method]
        system = type("Walled", (Still,), {method: read, "__module__": __name__})()
        return jk.simulate(system, HALF, TS, **SHORT).t_end

    with pytest.raises(TypeError, match=r"Walled uses, in a closure .* Make it a parameter"):
        jax.grad(ends_at)(0.52)


@pytest.mark.slow
def test_tracers_stored_by_an_earlier_trace_are_not_captured_values():
    """A tracer of an earlier trace in a closure is ignored."""
    kept = []

    class Keeping(Still):
        def loads(self, t, q, u, motion, inputs):
            kept.append(q[0])
            return super().loads(t, q, u, motion, inputs)

    for _ in range(2):
        assert jk.simulate(Keeping(), HALF, TS, **SHORT).ok


class Holder(eqx.Module):
    f: Callable
    gain: jax.Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, state):
        return self.gain * self.f(t, state)


def test_unchanged_systems_are_not_retraced(monkeypatch):
    calls = []

    class Counted(Drop):
        def loads(self, t, q, u, motion, inputs):
            calls.append(1)  # what tracing itself changes is no change
            return super().loads(t, q, u, motion, inputs)

    system = Counted()
    accelerate(system)
    n = len(calls)
    assert n > 0
    accelerate(system)
    assert len(calls) == n
    monkeypatch.setattr(sys.modules[__name__], "GRAVITY", 1.62)
    assert accelerate(system) == pytest.approx(1.62, rel=RTOL)
    assert len(calls) > n


def test_nan_signed_zeros_and_arrays_of_other_types_are_distinguished():
    space: dict[str, Any] = {}
    exec("def f():\n    return x", space)
    versions, values = [], [np.nan, 0.0, -0.0, 0, False, None, "0", (0.0,), [0.0], np.zeros(1)]
    values += [np.zeros(1, np.float32), np.zeros((1, 1))]
    for space["x"] in [*values, np.zeros(1, np.int64), {0.0}, {"a": 0.0}, {"b": 0.0}, jnp, len]:
        versions.append(version_of(space["f"]))
        assert version_of(space["f"]) == versions[-1]
    assert len(set(versions)) == len(versions)
    space["x"] = np.zeros(1)
    assert version_of(space["f"]) == versions[9]  # not the same array, but the same numbers


def test_cyclic_references_and_deep_nesting_terminate():
    chain = []
    for _ in range(5000):
        chain = [chain]
    ring = {}
    ring["ring"] = ring
    space = {"chain": chain, "ring": ring}
    exec("def f():\n    return chain, ring, g()\ndef g():\n    return f()", space)
    assert version_of(space["f"]) == version_of(space["f"])
    before = version_of(space["f"])
    ring["x"] = 1.0
    assert version_of(space["f"]) != before


@pytest.mark.slow
def test_forget_discards_programs_with_undetectable_captured_values():
    hidden = array.array("d", [9.81])  # of a C extension
    system = with_gravity(lambda self: hidden[0])
    outer = jax.jit(lambda v: jk.accelerations(system, 0.0, jnp.zeros(1), v)[0])
    assert accelerate(system) == float(outer(jnp.zeros(1))) == pytest.approx(9.81, rel=RTOL)
    hidden[0] = 1.62
    jk.forget()
    assert accelerate(system) == float(outer(jnp.zeros(1))) == pytest.approx(1.62, rel=RTOL)


@pytest.mark.slow
def test_programs_do_not_keep_systems_and_their_arrays_alive():
    """A program takes the numbers of a system; it keeps neither them nor the system."""
    system = Bead(jnp.array(3.0))
    gone = [weakref.ref(system), weakref.ref(system.mass)]
    jk.kinetic_energy(system, 0.0, [0.5], [0.3])
    jk.equations_of_motion(system, 0.0, [0.5], [0.3], {"lag": 0.2})
    jk.positions(system, 0.0, [0.5], [0.3])
    jk.export.numpy(system)
    jk.symbolic.equations(system)
    del system
    gc.collect()
    assert [ref() for ref in gone] == [None, None]


def test_every_compiled_function_detects_changes():
    """A function that is compiled at module level by plain JAX would keep the values that it read while tracing."""
    source = Path(jk.__file__).parent
    wrong = r"^@(eqx\.filter_jit|jax\.jit)\s+def (\w+)"
    found = {m[2] for path in source.rglob("*.py") for m in re.finditer(wrong, path.read_text(), re.MULTILINE)}
    of_numbers = {"_eliminate", "moved", "_chosen", "_solved_by_lapack", "_det_by_lapack"}
    of_numbers |= {"_condition", "_in_order", "_factors", "_root_by_lapack"}
    assert found <= of_numbers, f"compile {found} with `cache_key.jit`, or show that they read no description"


def test_masked_arrays_differ_by_their_masks():
    arrays = [np.ma.array([1.0, 2.0], mask=mask) for mask in ([False, True], [True, False], False)]
    assert len({version_of(lambda array=array: array) for array in [*arrays, np.ma.masked]}) == 4
