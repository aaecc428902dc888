"""Riders, arms and parameter files, against BicycleParameters, SymBRiM, and bicycles whose riders do not move."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import moved

import jaxkane as jk
from jaxkane import Status
from jaxkane.bicycles import (
    Arms,
    Bicycle,
    LeaningRider,
    RigidRider,
    Trailer,
    Tyre,
    browser_jason,
    separate_rider,
    toroidal,
)
from jaxkane.stability import linearize, straight_ahead
from jaxkane.sweep import sweep

DATA = Path(__file__).parents[1] / "data"
LITERATURE = json.loads((DATA / "bicycle_parameters.json").read_text())
SYMBRIM = json.loads((DATA / "symbrim.json").read_text())

UPPER_BODY = {
    **{"mass": 48.816, "x": 0.231223496809401, "z": -1.283035074598082},
    **{"Ixx": 2.038073562525466, "Iyy": 1.692108544034995, "Izz": 1.100753962972129, "Ixz": 0.002113501449812},
}
HINGE = {"hinge_x": 0.2, "hinge_z": -1.011421527346159}
SHOULDER = [0.33, 0.21, -1.47]
ARMS = {
    **{"grip": [0.55, 0.28, -1.1], "upper_length": 0.3, "fore_length": 0.32},
    **{"upper_mass": 2.1, "fore_mass": 1.4, "upper_center": 0.13, "fore_center": 0.14},
    **{"upper_inertia": [0.019, 0.018, 0.003], "fore_inertia": [0.016, 0.015, 0.002]},
}


def yaml(values, folder, header=""):
    path = folder / "bicycle.yml"
    indent = "  " if header else ""
    path.write_text(header + "".join(f"{indent}{name}: {value}\n" for name, value in values.items()))
    return path


def leaning(folder):
    """BicycleParameters' browser with the leaning rider Jason, and a spring and a damper at his hinge."""
    values = LITERATURE["lean"]["parameters"]
    return Bicycle.from_file(yaml(values, folder, "parameterization: MooreRiderLean2012\nvalues:\n"))


def linear_models(bicycle, speeds, states):
    models = [linearize(bicycle, straight_ahead(bicycle, speed), states=states) for speed in speeds]
    return np.array([model.A for model in models]), np.array([model.B for model in models])


@pytest.mark.weekly
def test_the_linear_model_with_a_leaning_rider_agrees_with_bicycle_parameters(tmp_path):
    """1e-9 asked."""
    bicycle, known = leaning(tmp_path), LITERATURE["lean"]
    A, B = linear_models(bicycle, LITERATURE["speeds"], known["states"])
    inputs = [bicycle.inputs.index(name) for name in known["inputs"]]
    np.testing.assert_allclose(A, known["A"], rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(B[..., inputs], known["B"], rtol=1e-12, atol=1e-13)
    for found, values in zip(A, known["eigenvalues"], strict=True):
        found = np.linalg.eigvals(found)
        for value in np.array(values) @ [1.0, 1.0j]:
            assert np.abs(found - value).min() < 1e-9


def assembled(model):
    """The bicycle of a model of SymBRiM, from its parameters by name."""
    values = SYMBRIM["models"][model]["parameters"]
    own = {name: x for name, x in values.items() if "." not in name}
    inner = lambda of: {name.removeprefix(of): x for name, x in values.items() if name.startswith(of)}  # noqa: E731
    bicycle = Bicycle.from_parameters(own)
    if rider := inner("rider."):
        bicycle = bicycle.with_parts(rider=LeaningRider(**rider))
    if arms := inner("extra[0]."):
        bicycle = bicycle.with_parts(extra=[Arms(**arms)])
    tyres = {name: Tyre(**inner(f"{name}.")) for name in ("rear_tyre", "front_tyre") if inner(f"{name}.")}
    return bicycle.with_parts(**tyres)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [pytest.param(name, marks=[pytest.mark.weekly] if name == "arms" else []) for name in SYMBRIM["models"]]
)
def test_accelerations_agree_with_symbrim(model):
    """1e-11 asked."""
    bicycle = assembled(model)
    for state in SYMBRIM["models"][model]["states"]:
        q = jnp.array([state["q"][name] for name in bicycle.coordinates])
        u = jnp.array([state["u"][name] for name in bicycle.speeds])
        known = [state["accelerations"][name] for name in bicycle.speeds]
        np.testing.assert_allclose(jk.accelerations(bicycle, 0.0, q, u), known, rtol=1e-12, atol=1e-11)


def test_separating_the_upper_body_leaves_the_published_values_of_the_frame():
    """The browser with Jason is the browser with his legs, and his upper body."""
    whole = {name: x for name, x in LITERATURE["feedback"]["parameters"].items() if name != "v"}
    bicycle = separate_rider(Bicycle.from_parameters(whole), LeaningRider(**UPPER_BODY, **HINGE))
    for name in ("mB", "xB", "zB", "IBxx", "IByy", "IBzz", "IBxz"):
        # Published for the whole and for the legs by separate measurements of the same body; to their rounding.
        np.testing.assert_allclose(getattr(bicycle, name), LITERATURE["legs"][name], rtol=5e-3, atol=1e-3)


@pytest.mark.slow
def test_a_rigid_rider_is_equivalent_to_a_heavier_frame():
    """1e-12: accelerations of a bicycle that counts him in B."""
    whole = Bicycle.from_parameters({n: x for n, x in LITERATURE["feedback"]["parameters"].items() if n != "v"})
    apart = separate_rider(whole, RigidRider(**UPPER_BODY))
    assert float(apart.mB) == pytest.approx(float(whole.mB) - UPPER_BODY["mass"])
    state = jk.assemble(whole, {"roll": 0.2, "steer": 0.3}, {"roll_rate": 0.4, "rear_wheel_rate": -12.0})
    known = jk.accelerations(whole, 0.0, state.q, state.u)
    np.testing.assert_allclose(jk.accelerations(apart, 0.0, state.q, state.u), known, rtol=1e-12, atol=1e-12)


def test_files_of_principal_inertias_contain_a_rigid_rider(tmp_path):
    """1e-12: BicycleParameters' own conversion of the same file, rider and frame in one."""
    known = Bicycle.from_parameters({n: x for n, x in LITERATURE["principal"]["meijaard"].items() if n != "v"})
    bicycle = Bicycle.from_file(yaml(LITERATURE["principal"]["parameters"], tmp_path))
    assert isinstance(bicycle.rider, RigidRider)
    apart = separate_rider(known, bicycle.rider)
    for path, x in jax.tree_util.tree_leaves_with_path(apart):
        name = jax.tree_util.keystr(path).lstrip(".")
        if "." not in name:
            np.testing.assert_allclose(getattr(bicycle, name), x, rtol=1e-12, atol=1e-12, err_msg=name)


def test_files_without_a_rider_and_separate_rider_files_can_be_read(tmp_path):
    values = LITERATURE["feedback"]["parameters"]
    bicycle = Bicycle.from_file(yaml(values, tmp_path))
    assert bicycle.rider is None
    assert float(bicycle.IBxz) == values["IBxz"]
    names = {"mB": "mass", "xB": "x", "zB": "z", "IBxx": "Ixx", "IByy": "Iyy", "IBzz": "Izz", "IBxz": "Ixz"}
    path = tmp_path / "JasonBrowserBenchmark.txt"
    path.write_text("".join(f"{name} = {UPPER_BODY[own]}\n" for name, own in names.items()) + "yB = 0.0\n")
    rider = LeaningRider.from_file(path, **HINGE)
    assert float(rider.Ixz) == UPPER_BODY["Ixz"]
    assert float(rider.hinge_z) == HINGE["hinge_z"]
    path.write_text("mB = 70.0\n")
    with pytest.raises(ValueError, match="missing: xB"):
        RigidRider.from_file(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("parameterization: Meijaard2007\nvalues:\n  mB: 85\n  IBxx 9.2\n", r"is not a YAML file: (.|\n)*line 5"),
        ("IBxx 9.2\n", "must contain lines of the form NAME: number"),
        ("", "must contain lines of the form NAME: number"),
        ("mB: {x: 1}\n", "line 1: mB: .* is not of the form"),
        ("mB: [1, 2]\n", "line 1: mB: .* is not of the form"),
        ("mB: 1:30\n", "line 1: mB: '1:30' is not of the form"),  # 90 to YAML 1.1
        ("IBxx: 9.2\nmB: 85.0\nIBxx: 9.3\n", "line 3: IBxx was given before, on line 1"),
        ("IBxx: nan\n", "line 1"),
        ("IBxx: 9.2\nmBB: 85.0\n", "missing: w.*unknown: mBB"),
        ("parameterization: Basu2007\nvalues:\n  a: 1.0\n", "'Basu2007' is not known"),
        ("wheels: 2\n", "no known parameterization"),
        ("parameterization: MooreRiderLean2012\nvalues:\n  d1: 0.9\n", "missing: d2"),
    ],
)
def test_an_unreadable_file_reports_the_location_of_the_error(text, said, tmp_path):
    path = tmp_path / "wrong.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        Bicycle.from_file(path)


def with_arms(**more):
    whole = Bicycle.from_parameters({n: x for n, x in LITERATURE["feedback"]["parameters"].items() if n != "v"})
    rider = LeaningRider(**UPPER_BODY, **HINGE, shoulder=SHOULDER)
    return separate_rider(whole, rider).with_parts(extra=[Arms(**ARMS | more)])


def test_hands_coincide_with_the_grips_after_assembly():
    """1e-12 m, after the assembly from one guess of zeros."""
    bicycle = with_arms()
    state = jk.assemble(bicycle, {"roll": 0.1, "steer": 0.35, "rider_lean": -0.02})
    zeros = jnp.zeros(len(bicycle.speeds) + len(bicycle.dependent_speeds))
    motion = bicycle.motion(0.0, state.q, zeros)
    for side in ("left", "right"):
        hand, grip = (motion[f"{side}_{place}"].position.to(motion.N) for place in ("hand", "grip"))
        np.testing.assert_allclose(hand, grip, atol=1e-12)
    turned = dict(zip(bicycle.coordinates, state.q, strict=True))
    assert turned["right_elbow"] > turned["left_elbow"] + 0.05  # steered to the right, the left arm stretches


def test_arms_without_shoulders_or_too_short_raise():
    bicycle = with_arms()
    short = dataclasses.replace(bicycle.extra[0], fore_length=0.05)
    aside = dataclasses.replace(bicycle.extra[0], grip=[0.45, 0.6, -1.3])
    rider = dataclasses.replace(bicycle.rider, shoulder=None)
    for parts, said in (
        ({"rider": None}, "rider with shoulders"),
        ({"rider": rider}, "rider with shoulders"),
        ({"extra": [short]}, "these arms reach from 0.25 to 0.35 m"),
        ({"extra": [aside]}, "too far to the side"),
        ({"extra": [bicycle.extra[0]] * 2}, "'left_shoulder_flexion' appears twice"),
    ):
        with pytest.raises(ValueError, match=said):
            bicycle.with_parts(**parts)


def small_ride():
    bicycle = Bicycle.benchmark().with_parts(rider=LeaningRider(**UPPER_BODY, **HINGE))
    start = straight_ahead(bicycle, 6.0)
    return bicycle, jk.State(start.q.at[0].set(0.05), start.u), jnp.linspace(0.0, 0.2, 3)


@pytest.mark.weekly
def test_parameters_of_parts_are_swept():
    bicycle, start, ts = small_ride()
    table = {"rider.stiffness": [0.0, 500.0, 500.0], "rider.mass": [48.0, 48.0, -1.0]}
    rides = sweep(bicycle, start, ts, table=table)
    assert [Status(s).name for s in rides.status] == ["COMPLETED", "COMPLETED", "INVALID"]
    lean = rides["rider_lean"][:, -1]
    assert lean[0] < 1.5 * lean[1] < 0  # to the other side, as the frame falls under him; a spring holds him
    assert np.isnan(lean[2])


def test_invalid_batches_of_part_parameters_are_rejected():
    bicycle, start, ts = small_ride()
    stiffness = jnp.array([0.0, 500.0, 500.0])
    batch = bicycle.with_parts(rider=dataclasses.replace(bicycle.rider, stiffness=stiffness))
    with pytest.raises(ValueError, match=r"rider\.stiffness has more axes"):
        jk.accelerations(batch, 0.0, start.q, start.u)
    with pytest.raises(ValueError, match=r"rider\.stiffness \(a column of the table, and in a batch of Bicycle"):
        sweep(batch, start, ts, table={"rider.stiffness": stiffness})
    arms = with_arms()
    longer = arms.with_parts(**{"extra[0].fore_length": 0.35, "rider.mass": 40.0, "mB": 50.0})
    assert [float(x) for x in (longer.extra[0].fore_length, longer.rider.mass, longer.mB)] == [0.35, 40.0, 50.0]
    with pytest.raises(ValueError, match="these arms reach"):
        arms.with_parts(**{"extra[0].fore_length": 0.01})


@pytest.mark.slow
def test_invalid_riders_in_a_batch_do_not_affect_other_members():
    """A heavier and an impossible rider; arms that reach and that do not."""
    whole = Bicycle.benchmark()
    light = {**UPPER_BODY, "mass": 5.0, "z": -0.9, "Ixx": 0.5, "Iyy": 0.5, "Izz": 0.3}
    riders = RigidRider(**{**light, "mass": jnp.array([5.0, 6.0, 90.0])})
    bicycles = separate_rider(whole, riders)
    np.testing.assert_allclose(bicycles.mB, [80.0, 79.0, -5.0], rtol=1e-15)
    one = separate_rider(whole, RigidRider(**light))
    np.testing.assert_allclose(bicycles.IBxx[0], one.IBxx, rtol=1e-15)
    arms = Arms(**ARMS | {"fore_length": jnp.array([0.32, 0.02])})
    rider = LeaningRider(**UPPER_BODY, **HINGE, shoulder=SHOULDER)
    held = whole.with_parts(rider=rider, extra=[arms])
    elbows = np.array(held.extra[0].posture(rider.shoulder)[2])
    assert np.isfinite(elbows).tolist() == [True, False]


def test_invalid_riders_are_rejected():
    with pytest.raises(TypeError, match="hinge_z"):
        LeaningRider(**UPPER_BODY, hinge_x=0.2)
    with pytest.raises(ValueError, match=r"LeaningRider\.mass = -1.0 must be positive"):
        LeaningRider(**{**UPPER_BODY, "mass": -1.0}, **HINGE)
    with pytest.raises(ValueError, match="is not finite"):
        LeaningRider(**UPPER_BODY, hinge_x=0.2, hinge_z=jnp.nan)
    rider = RigidRider(**UPPER_BODY)
    with pytest.raises(ValueError, match="mB does not"):
        separate_rider(Bicycle.benchmark(), rider)
    with pytest.raises(ValueError, match="too heavy for the frame B"):
        separate_rider(Bicycle.benchmark(), dataclasses.replace(rider, mass=90.0))


def trailer(**more):
    values = {"hitch_x": -0.2, "hitch_z": -0.35, "length": 1.1, "wheel_radius": 0.25, "mass": 30.0}
    return Trailer(**values | {"center": 0.1, "height": 0.15, "Ixx": 1.5, "Iyy": 2.0, "Izz": 2.5} | more)


@pytest.mark.slow
def test_a_trailer_follows_the_hitch():
    """1e-12: behind a bicycle that runs straight the angle falls as that of a tractrix, v / length * sin(angle)."""
    bicycle = Bicycle.benchmark().with_parts(extra=[trailer()])
    state = jk.assemble(bicycle, {"trailer_angle": 0.4}, {"rear_wheel_rate": -4.0 / bicycle.rR})
    rates = dict(zip(bicycle.dependent_speeds, jk.dependent_speeds(bicycle, 0.0, state.q, state.u), strict=True))
    hitch_to_axle = 1.1
    assert float(rates["trailer_angle_rate"]) == pytest.approx(-4.0 / hitch_to_axle * np.sin(0.4), rel=1e-12)
    leaned = jk.assemble(bicycle, {"roll": 0.4, "trailer_angle": -0.3})
    motion = bicycle.motion(0.0, leaned.q, jnp.zeros(len(bicycle.speeds) + len(bicycle.dependent_speeds)))
    assert float(motion["axle"].position.to(motion.N)[2]) == pytest.approx(-0.25, rel=1e-12)
    assert float(leaned.q[bicycle.coordinates.index("trailer_pitch")]) < -0.01  # the hitch sank


def test_catalogue_riders_equal_those_read_from_files(tmp_path):
    """As the same set of names is read from a file."""
    read, built = leaning(tmp_path), browser_jason(stiffness=128.0, damping=50.0)
    assert jax.tree.structure(read) == jax.tree.structure(built)
    for x, y in zip(jax.tree.leaves(read), jax.tree.leaves(built), strict=True):
        np.testing.assert_array_equal(x, y)
    assert float(toroidal(0.01, 0.03).front_tyre.crown) == 0.03
    assert {**built.units}["rider_lean_torque"] == "N m"


def test_arms_scale_with_the_mass_and_height_of_the_person():
    """Winter (2009): an arm with forearm and hand is 5 % of the mass."""
    arms = Arms.of_person(80.0, 1.8, ARMS["grip"], elbow_damping=2.0)
    assert float(arms.upper_mass + arms.fore_mass) == pytest.approx(0.05 * 80.0)
    assert float(arms.upper_length + arms.fore_length) == pytest.approx(0.386 * 1.8)
    assert float(arms.elbow_damping) == 2.0


@pytest.mark.weekly
def test_riders_and_their_parts_are_drawn():
    """The picture's lines end where the arms' joints, the tyres' sides and the trailer are."""
    tyre = Tyre(crown=0.02)
    bicycle = with_arms().with_parts(rear_tyre=tyre, front_tyre=tyre)
    bicycle = bicycle.with_parts(extra=[*bicycle.extra, trailer()])
    q, u = jnp.zeros(len(bicycle.coordinates)), jnp.zeros(len(bicycle.speeds) + len(bicycle.dependent_speeds))
    motion = bicycle.motion(0.0, q, u)
    still = moved(bicycle, np.linspace(0.0, 0.1, 3), jnp.tile(q, (3, 1)), jnp.zeros((3, len(bicycle.speeds))))
    ends = jk.animate(bicycle, still).scene.at(0.0)[0][0] * [1.0, -1.0, -1.0]  # N.z is down, and the page's z is up
    for name in ("left_shoulder", "right_elbow", "left_hand", "hitch", "rider"):
        place = motion[name].center if name == "rider" else motion[name]
        assert np.linalg.norm(ends - np.array(place.position.to(motion.N)), axis=1).min() < 1e-6, name
    assert np.abs(np.abs(ends[:, 1]) - 0.02).min() < 1e-6


@pytest.mark.weekly
def test_the_energy_balance_of_a_rider_with_arms_holds():
    """1e-9 asked: springs and dampers of the hinge and the arms, weights and a torque at the hinge, along 0.3 s."""
    joints = {"shoulder_stiffness": 5.0, "shoulder_damping": 1.0, "elbow_stiffness": 8.0, "elbow_damping": 0.5}
    bicycle = with_arms(**joints)
    sprung = dataclasses.replace(bicycle.rider, stiffness=128.0, damping=50.0)
    bicycle = bicycle.with_parts(rider=sprung)
    start = jk.assemble(bicycle, {"roll": 0.05, "steer": 0.1, "rider_lean": 0.1}, {"rear_wheel_rate": -15.0})
    torque = {"rider_lean_torque": 5.0, "left_elbow_torque": 0.5}
    ride = jk.simulate(bicycle, start, jnp.linspace(0.0, 0.3, 61), torque, rtol=1e-11, atol=1e-11)
    audit = jk.audit(bicycle, ride)
    assert abs(float(audit.energy_balance)) < 1e-9
