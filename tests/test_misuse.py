"""Common mistakes raise errors of this library, instead of wrong results or errors of Python and JAX."""

import functools
import inspect
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Pendulum

import jaxkane as jk
from jaxkane.joints import Actuator, Coupling, Link, Loop, Site, hinge, mechanism

TS = jnp.linspace(0.0, 0.2, 3)
BAR = {"mass": 1.0, "center": (0.5, 0.0, 0.0), "inertia": (0.01, 0.1, 0.1)}


def fresh():
    """A class of its own for every test that changes one."""
    return type("Pendulum", (Pendulum,), {})


def acceleration(system, q=(0.3,), u=(0.5,)):
    return float(jk.accelerations(system, 0.0, jnp.array(q), jnp.array(u))[0])


# Methods and names that are assigned to a class.


def damped(self, t, q, u, motion, inputs):
    return jk.Torque(-u["rate"] * motion.N.z, motion["L"])


def halved(self, t, q, u):
    motion = Pendulum.motion(self, t, q, u)
    return jk.Motion([jk.Body(0.5 * self.mass, 0.0, motion["bob"].center, name="bob")], frames=motion.frames)


@pytest.mark.slow
def test_methods_assigned_to_a_class_can_read_by_name():
    """Moment about the pivot: m l^2 = 2 kg m^2; the torque is -0.5 N m."""
    kind = fresh()
    pendulum = kind()
    assert acceleration(pendulum) == pytest.approx(-9.81 * np.sin(0.3), rel=1e-12)
    kind.loads = damped
    assert acceleration(pendulum) == pytest.approx(-0.25, rel=1e-12)
    kind.motion = halved
    assert acceleration(pendulum) == pytest.approx(-0.5, rel=1e-12)
    kind.loads = Pendulum.loads  # prepared already
    assert acceleration(pendulum) == pytest.approx(-9.81 * np.sin(0.3), rel=1e-12)
    assert kind.loads is Pendulum.loads

    @functools.wraps(Pendulum.loads)
    def doubled(self, t, q, u, motion, inputs):  # reads by name itself, although what it decorates does so too
        return (Pendulum.loads(self, t, q, u, motion, inputs), jk.Torque(-q["angle"] * motion.N.z, motion["L"]))

    kind.loads = doubled
    assert acceleration(pendulum) == pytest.approx(-9.81 * np.sin(0.3) - 0.3, rel=1e-12)


def test_autoreload_replaces_methods():
    """As IPython's does it: what a method was made from changes in its `__dict__`, and its closure cannot."""
    old, new = fresh(), fresh()
    old.loads, new.loads = Pendulum.loads.__wrapped__, damped
    pendulum = old()
    assert acceleration(pendulum) == pytest.approx(-9.81 * np.sin(0.3), rel=1e-12)
    autoreload = pytest.importorskip("IPython.extensions.autoreload")
    autoreload.update_class(old, new)
    assert acceleration(pendulum) == pytest.approx(-0.25, rel=1e-12)


def test_names_and_units_assigned_to_a_class_are_checked():
    kind = fresh()
    with pytest.raises(TypeError, match=r"Pendulum.coordinates must be a tuple of names, .* got 'angle'"):
        kind.coordinates = "angle"
    kind.coordinates = ["angle"]
    assert kind.coordinates == ("angle",)
    with pytest.raises(TypeError, match=r"Pendulum.units must be a dict of strings by name.*got 'rad'"):
        kind.units = "rad"


@pytest.mark.parametrize(
    ("units", "error", "match"),
    [
        ({"angle": 3}, TypeError, r"must be a dict of strings by name.*got 3"),
        ({"angle": None}, TypeError, r"'angle', got None"),
        ({3: "rad"}, TypeError, r"got 3"),
        (["angle"], TypeError, r"must be a dict of strings by name.*got \['angle'\]"),
        ({"angel": "rad"}, ValueError, r"not a coordinate, speed, input or state: angel; did you mean 'angle'"),
    ],
)
def test_invalid_units_raise(units, error, match):
    with pytest.raises(error, match=match):
        type("Pendulum", (Pendulum,), {"units": units})()


def test_inherited_units_may_contain_additional_names():
    base = type("Base", (Pendulum,), {"units": {"angle": "rad", "torque": "N m"}})
    free = type("Free", (base,), {"inputs": (), "loads": jk.System.loads})()
    assert np.isfinite(jk.accelerations(free, 0.0, [0.1], [0.2])).all()


# What a description keeps from an earlier call.

KEPT = {}


def keeping(part):
    """A description that holds on to a part of its motion."""

    def motion(self, t, q, u):
        made = Pendulum.motion(self, t, q, u)
        if part == "motion":
            return KEPT.setdefault("motion", made)
        center = KEPT.setdefault("center", made.bodies[0].center) if part == "center" else made.bodies[0].center
        offset = 0.0 * KEPT.setdefault("number", 2.0 * q["angle"]) if part == "number" else 0.0
        return jk.Motion([jk.Body(self.mass + offset, 0.0, center, name="bob")], frames=made.frames)

    def loads(self, t, q, u, motion, inputs):
        made = Pendulum.loads(self, t, q, u, motion, inputs)
        return KEPT.setdefault("loads", made) if part == "loads" else made

    def q_dot(self, t, q, u):
        return KEPT.setdefault("rates", [1.0 * u["rate"]]) if part == "rates" else [u["rate"]]

    return type("Keeping", (Pendulum,), {"motion": motion, "loads": loads, "q_dot": q_dot})


@pytest.mark.slow_cases("loads", "rates")
@pytest.mark.parametrize("part", ["motion", "center", "number", "loads", "rates"])
def test_stored_results_of_an_earlier_call_are_rejected(part):
    KEPT.clear()
    pendulum = keeping(part)()
    with pytest.raises(TypeError, match=r"Keeping: its description returns .* of an earlier call, which it has stored"):
        [acceleration(pendulum, q=(angle,)) for angle in (0.3, 0.4)]
    with pytest.raises(TypeError, match=r"Keeping: its description returns .* of an earlier call, which it has stored"):
        jk.simulate(pendulum, jk.State([0.3], [0.0]), TS)


def test_a_stored_motion_of_plain_numbers_is_rejected():
    """Which would be a motion that does not depend on the coordinates."""
    KEPT.clear()
    pendulum = keeping("motion")()
    pendulum.motion(0.0, [0.3], [0.1])
    with pytest.raises(TypeError, match=r".* of an earlier call, which it has stored"):
        pendulum.motion(0.0, [0.4], [0.1])


# Mechanisms.


def four_bar(across):
    """A parallelogram in the plane across y; `across` is how far its ends are apart there."""
    links = [
        Link(name, parent, hinge(f"q{i + 1}", (0, 1, 0)), position=(float(i > 0), 0, 0), **BAR)
        for i, (name, parent) in enumerate([("a", None), ("b", "a"), ("c", "b")])
    ]
    sites = [Site("end", "c", (1.0, 0, 0)), Site("ground", None, (1.5, across, 0))]
    return mechanism(links, sites=sites, loops=[Loop("end", "ground")])


@pytest.mark.slow
def test_a_parameter_change_that_prevents_loop_closure_is_rejected():
    system = four_bar(jnp.zeros(()))
    broken = system.replace({"site.ground.y": 0.1})
    state = jk.assemble(system, {"q1": 0.9})
    with pytest.raises(ValueError, match=r"can be met, but the constraints implied by them are violated by 0.1"):
        jk.assemble(broken, {"q1": 0.9})
    with pytest.raises(ValueError, match=r"the configuration constraints imply is violated by \[-?0.1"):
        jk.simulate(broken, state, TS)

    found = jax.jit(lambda y: jk.assemble(system.replace({"site.ground.y": y}), {"q1": 0.9}).q)
    np.testing.assert_allclose(found(0.0), state.q, atol=1e-12)
    assert np.all(np.isnan(found(0.1)))


@pytest.mark.weekly
def test_a_batch_member_whose_loop_cannot_be_closed_has_status_invalid():
    system = four_bar(jnp.zeros(()))
    apart = np.linspace(0.0, 0.1, 2)
    members = jk.sweep.sweep(system.replace({"site.ground.y": apart}), jk.assemble(system, {"q1": 0.9}), TS)
    assert list(members.reason) == ["completed", "invalid"]


def test_mechanism_arguments_must_be_lists():
    link = Link("a", joints=hinge("q"), **BAR)
    with pytest.raises(TypeError, match=r"mechanism: `links` must be a list, e\.g\. \[Link\(...\), ...\]"):
        mechanism(link)
    with pytest.raises(TypeError, match=r"`actuators` must be a list, e\.g\. \[Actuator\(...\), ...\].*got a Actuator"):
        mechanism([link], actuators=Actuator("motor", "q"))
    with pytest.raises(TypeError, match=r"`dependent` must be a list of names, e\.g\. \['q'\]"):
        mechanism([link], dependent="q")
    assert mechanism(x for x in [link]).coordinates == ("q",)


def test_reading_a_structural_zero_raises_an_explanation():
    arm = mechanism([Link("a", joints=hinge("q", damping=0.1), **BAR)])
    assert arm.damping["q"] == 0.1
    assert arm.center["a"]["x"] == 0.5
    for read, name in (
        (lambda: arm.armature["q"], "armature.q"),
        (lambda: arm.center["a"]["z"], "center.a.z"),
        (lambda: arm.inertia["a"]["xy"], "inertia.a.xy"),
        (lambda: arm.gravity["x"], "gravity.x"),
    ):
        with pytest.raises(
            KeyError, match=rf"has no parameter {name}: it was defined as the number 0.*jax.numpy.zeros"
        ):
            read()
    with pytest.raises(KeyError, match=r"There is no 'p' in `damping`; there are q"):
        arm.damping["p"]
    with pytest.raises(KeyError, match=r"There is no 'a' in `armature`"):
        arm.armature["a"]


# Times and tables.


def test_named_parameters_are_a_pytree_like_a_dict():
    arm = mechanism([Link("a", joints=hinge("q", damping=0.1), **BAR)])
    doubled = jax.tree.map(lambda x: 2.0 * x, arm.center)
    assert doubled == {"a": {"x": 1.0}}
    assert len(jax.tree.leaves(arm.inertia)) == 3
    with pytest.raises(KeyError, match="it was defined as the number 0"):
        doubled["a"]["y"]
    assert pickle.loads(pickle.dumps(arm.center)) == {"a": {"x": 0.5}}


# Elements.


@pytest.mark.parametrize(
    ("element", "error", "match"),
    [
        (lambda A, O: jk.loads.coulomb(0.1, 1.0, width=0.0), ValueError, "smoothing must be positive, got 0.0"),
        (lambda A, O: jk.loads.dead_zone(0.1, 0.2, -0.2), ValueError, r"got 0.2 and -0.2. `lower` must be less"),
        (lambda A, O: jk.loads.dead_zone(0.1, -np.inf, 0.2), ValueError, r"got -inf and 0.2.*Pass None"),
        (
            lambda A, O: jk.loads.rotor(1.0, A.x, 1.0, jk.Body(1.0, 0.0, O, name="dot"), O),
            ValueError,
            "'dot' is a particle, which has no frame",
        ),
    ],
)
def test_invalid_load_elements_raise(element, error, match):
    N, O = jk.inertial()
    with pytest.raises(error, match=match):
        element(N.rotate(3, 0.1, 0.2), O)


NO_NUMBERS = {
    "text": "a",
    "None": None,
    "complex": 1j,
    "bool": True,
    "texts": ["a", "b"],
    "Nones": [None, 0.0],
    "bools": [True, False],
    "complexes": [1j, 0.0],
    "uneven": [[1.0], [1.0, 2.0]],
    "object": object(),
    "a duration": np.timedelta64(1, "s"),
    "masked": np.ma.masked,
    "three numbers": [0.0, 0.1, 0.2],
}
AT = {"t": 0.0, "q": [0.3], "u": [0.5], "inputs": {"torque": 1.0}}
OF_A_STATE = [
    name
    for name, f in ((name, getattr(jk, name)) for name in dir(jk))
    if inspect.isfunction(f) and {"system", "t", "q"} <= {*inspect.signature(f).parameters}
]


@pytest.mark.parametrize("wrong", NO_NUMBERS)
@pytest.mark.parametrize("name", OF_A_STATE)
def test_non_numeric_arguments_are_rejected_by_name(name, wrong):
    """By every public function of a state, in one line."""
    f, value = getattr(jk, name), NO_NUMBERS[wrong]
    system = Welded() if name == "best_dependent_speeds" else Pendulum()
    known = {"q": [0.3, 0.0]} if name == "best_dependent_speeds" else {}
    known |= {"residuals": lambda t, q, u, motion: u[0]} if name == "impact" else {}
    arguments = {key: x for key, x in (AT | known).items() if key in inspect.signature(f).parameters}
    wrongs = {key: value for key in arguments} | {"inputs": {"torque": value}}
    for key in AT.keys() & arguments.keys():
        if (name, key, wrong) == ("assemble", "u", "None"):
            continue  # at rest
        label = {"t": "`t`", "inputs": "'torque'"}.get(key, f": {key} must")
        with pytest.raises((TypeError, ValueError), match=label) as caught:
            f(system, **arguments | {key: wrongs[key]})
        assert "\n" not in str(caught.value)


class Welded(Pendulum):
    """With a speed that depends on the other, for what asks for such."""

    coordinates, speeds, dependent_speeds = ("angle", "twice"), ("rate",), ("double",)

    def motion(self, t, q, u):
        motion = Pendulum.motion(self, t, q, u)
        return jk.Motion(motion.bodies, [u["double"] - 2.0 * u["rate"]], frames=motion.frames)


@pytest.mark.parametrize("wrong", NO_NUMBERS)
def test_non_numeric_values_are_rejected_in_a_simulation(wrong):
    value, start = NO_NUMBERS[wrong], jk.State([0.3], [0.5])
    simulate = functools.partial(jk.simulate, Pendulum())
    cases = [
        ("'torque'", lambda: simulate(start, TS, {"torque": lambda t, state: value})),
        ("'torque'", lambda: simulate(start, TS, lambda t, state: {"torque": value})),
        ("function of the inputs", lambda: simulate(start, TS, lambda t, state: value)),
        (r"state\.q", lambda: simulate(jk.State({"angle": value}, [0.5]), TS)),
        ("instance of a System", lambda: jk.simulate(value, start, TS)),
    ]
    if wrong != "three numbers":
        cases += [
            ("'torque'", lambda: simulate(start, TS, {"torque": value})),
            ("values", lambda: jk.Samples([0.0, 1.0], value)),
        ]
    for label, call in cases:
        with pytest.raises((TypeError, ValueError), match=label) as caught:
            call()
        assert "\n" not in str(caught.value).split("\n-----")[0]


# Text for numbers, wrong shapes and wrong ranges: words of the field, and what is asked for.


def parts():
    N, O = jk.inertial()
    P = O.moving(0.5 * N.x, 0.1 * N.x)
    return N, O, P, N.rotate(3, 0.1, 0.2, "B")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda N, O, P, B: N.rotate(3.0, 0.1, 0.2), r"the axis must be 1, 2 or 3, .* got 3\.0"),
        (lambda N, O, P, B: N.rotate(jnp.ones(3), 0.1, 0.2), "the axis must be 1, 2 or 3"),
        (lambda N, O, P, B: N.vector("u3", 0, 0), r"must be one number, got 'u3': by name it is q\['u3'\], u\['u3'\]"),
        (lambda N, O, P, B: N.x * jnp.ones(3), r"shape \(3,\): take one entry"),
        (lambda N, O, P, B: N.vector(jnp.array(1j), 0, 0), "must be one number"),
        (lambda N, O, P, B: N.rotate_sequence("1-2", (1.0, 2.0), (1.0,)), "'1-2' takes 2 rates, got 1"),
        (lambda N, O, P, B: N.rotate_sequence("1-2-3", 1.0, (1.0,)), r"'1-2-3' takes 3 angles, got 1\.0"),
        (lambda N, O, P, B: N.rotate_euler(1.0), r"Euler parameters are four numbers, the scalar last, got 1\.0"),
        (lambda N, O, P, B: N.rotate_fixed(0.3), r"A rotation vector has three components, got 0\.3"),
        (lambda N, O, P, B: N.rotate_by(3.0, 0, 0, 0), "the orientation must be a function"),
        (lambda N, O, P, B: O.located(3.0, 0, 0, 0), "the position must be a function"),
        (lambda N, O, P, B: jk.rotations.euler_parameter_norm(jnp.ones(7)), "Euler parameters are four numbers"),
        (lambda N, O, P, B: jk.rotations.of_rotation_vector((1.0, 2.0)), "three components, got 2"),
        (lambda N, O, P, B: jk.rotations.angle_rates("1-2", (1.0, 2.0), (1.0, 2.0, 3.0)), "a sequence of three axes"),
        (lambda N, O, P, B: jk.parameter(shape=3), "the shape must be a tuple"),
        (lambda N, O, P, B: jk.loads.damper(O, P, "c"), "must be one number, got 'c'"),
        (lambda N, O, P, B: jk.loads.torsional_damper(O, None, N.z, 1.0), "connects Frames or Bodies, got Point"),
        (lambda N, O, P, B: jk.loads.stribeck(1.0, 1.0, 2.0, -0.1), r"`falloff` must be positive, got -0\.1"),
        (lambda N, O, P, B: jk.loads.dc_motor(1.0, 1.0, 1.0, 0.0), r"the resistance must be positive, got 0\.0"),
        (lambda N, O, P, B: jk.sensors.gyroscope(O), "The frame of a sensor must be a Frame, got Point"),
        (lambda N, O, P, B: jk.sensors.low_pass(1.0, 1.0, -0.1), r"the time constant must be positive, got -0\.1"),
        (lambda N, O, P, B: jk.sensors.delayed(1.0, (1.0, 2.0), -1.0), r"the delay must be positive, got -1\.0"),
        (lambda N, O, P, B: jk.sensors.encoder(1.0, resolution=0.0), r"the resolution must be positive, got 0\.0"),
        (
            lambda N, O, P, B: mechanism([Link("a", joints=hinge("h"), **BAR)], loops=[Coupling("h", None, ())]),
            "at least one number, got none",
        ),
    ],
)
def test_numbers_of_the_wrong_kind_raise_an_explained_error(wrong, words):
    with pytest.raises((TypeError, ValueError), match=words):
        wrong(*parts())


def test_masked_values_are_rejected_and_unmasked_arrays_accepted():
    masked = np.ma.array([0.3], mask=[True])
    for make in (lambda: jk.State(masked, [0.5]), lambda: Pendulum(mass=np.ma.masked)):
        with pytest.raises(ValueError, match="Some values are masked"):
            make()
    trial = jk.fit.Trial(TS, {"angle": np.zeros_like(TS)}, sigma=0.1)
    with pytest.raises(ValueError, match="`start` must be a real number, got masked"):
        trial.between(np.ma.masked, 1.0)
    np.testing.assert_array_equal(jk.State(np.ma.array([0.3]), [0.5]).q, [0.3])


@pytest.mark.parametrize("name", ["q_dot", "events", "outputs", "loads"])
def test_a_parameter_named_like_a_method_is_rejected(name):
    """It replaced the method: events never came, and accelerations were those of other rates."""
    kind = type("Named", (Pendulum,), {"__annotations__": {name: jk.Scalar}, name: jk.parameter(1.0)})
    with pytest.raises(ValueError, match=rf"Named: the parameter {name} would replace"):
        kind()


def test_a_parameter_named_like_a_class_attribute_is_rejected():
    members = {"__annotations__": {"inputs": jk.Scalar}, "inputs": jk.parameter(1.0)}
    with pytest.raises(TypeError, match=r"Named.inputs must be a tuple of names, such as .*Rename the field"):
        type("Named", (Pendulum,), members)


@pytest.mark.parametrize(
    ("key", "error", "message"),
    [
        (3, IndexError, r"index 3 is out of range for these 1 values \(angle\). Indices begin at 0"),
        (-2, IndexError, r"index -2 is out of range for these 1 values \(angle\)"),
        ([0, 5], IndexError, "index 5 is out of range for these 1 values"),
        (0.0, TypeError, "must be a name, an integer or a slice, got 0.0"),
        (None, TypeError, "must be a name, an integer or a slice, got None"),
    ],
)
def test_an_invalid_index_or_name_raises(key, error, message):
    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(jnp.sum(jnp.asarray(q[key])) * motion.N.z, motion["L"])

    with pytest.raises(error, match=message):
        acceleration(type("Pendulum", (Pendulum,), {"loads": loads})())


def test_a_traced_index_can_be_used():
    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(q[jnp.asarray(t, int)] * motion.N.z, motion["L"])

    with pytest.raises(TypeError, match=r"For a traced index use an array: jnp.asarray\(q\)\[i\]"):
        acceleration(type("Pendulum", (Pendulum,), {"loads": loads})())
