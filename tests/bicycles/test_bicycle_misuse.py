"""Faulty bicycles and parts, and wrong combinations of parts, raise errors that state the remedy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import (
    Arms,
    Bicycle,
    ConstantSpeed,
    Drag,
    HeadTwist,
    LaneChange,
    LateralSlip,
    LeaningRider,
    LeanSteerGains,
    LongitudinalSlip,
    MagicFormula,
    Part,
    PathFollower,
    RigidRider,
    Road,
    ScheduledGains,
    Slope,
    SteeringMotor,
    Trailer,
    Tyre,
    scheduled_lqr,
    schwalbe_energizer,
    separate_rider,
)
from jaxkane.fit.problem.declarations import find_leaves, leaf_names
from jaxkane.stability import canonical, linearize, straight_ahead
from jaxkane.sweep import sweep

BENCHMARK = Bicycle.benchmark()
RIDER = RigidRider(mass=20.0, x=0.3, z=-1.0, Ixx=0.8, Iyy=0.8, Izz=0.4, Ixz=0.0, shoulder=[0.33, 0.2, -1.47])
ARMS = Arms.of_person(83.5, 1.83, grip=[0.55, 0.28, -1.05])
TRAILER = Trailer(
    hitch_x=-0.1, hitch_z=-0.5, length=1.2, wheel_radius=0.25, mass=20.0, center=0.1, height=0.2, Ixx=1.0, Iyy=1.0,
    Izz=1.2,
)  # fmt: skip
CONTROLLED = BENCHMARK.with_parts(control=LeanSteerGains())
SCHEDULED = ScheduledGains([4.0], "rol", [[1.0]], [1.0])
GAINS = LeanSteerGains(roll=-50.0, steer=35.0, roll_rate=-13.0, steer_rate=3.5, command="steer_command")


class Named(Part):
    """A coordinate whose name is no tuple."""

    coordinates = "drop"


class Aside(Part):
    def lateral(self):
        return ("lean",)


@pytest.mark.parametrize(
    ("made", "error", "words"),
    [
        (lambda: BENCHMARK.with_parts(rear_tyre=LateralSlip(9e3)), TypeError, "`rear_tyre` must be a Tyre"),
        (lambda: BENCHMARK.with_parts(extra=[HeadTwist(1e3)]), ValueError, r"with_parts\(head="),
        (lambda: BENCHMARK.with_parts(extra=[ARMS, RIDER]), ValueError, "before them has shoulders"),
        (lambda: BENCHMARK.with_parts(extra=[Aside()]), ValueError, "Aside.lateral: Bicycle has no lean"),
        (lambda: BENCHMARK.with_parts(front_tyre=Tyre(crown=0.35)), ValueError, r"front_tyre\.crown = 0\.35 m"),
        (lambda: BENCHMARK.with_parts(road=Road(lambda x, y: 0.0), extra=[TRAILER]), ValueError, "be used on a Road"),
        (lambda: Tyre(lateral=LongitudinalSlip(1e4)), TypeError, "got a LongitudinalSlip"),
        (lambda: Named(), TypeError, r"must be a tuple of names, .* got 'drop'"),
        (lambda: separate_rider(BENCHMARK.with_parts(rider=RIDER), RIDER), ValueError, "already has a separate rider"),
        (lambda: scheduled_lqr(CONTROLLED, [4.0], np.ones(4), 0.1), ValueError, "already has a cont"),
        (lambda: BENCHMARK.with_parts(control=SCHEDULED), ValueError, "no rol; did you mean 'roll'"),
    ],
)
def test_incompatible_parts_are_rejected_on_assembly(made, error, words):
    with pytest.raises(error, match=words):
        made()


LEANING = {"mass": 40.0, "x": 0.25, "z": -1.0, "Ixx": 1.8, "Iyy": 1.8, "Izz": 0.9, "Ixz": 0.1, "hinge_x": 0.2}
LEANING |= {"hinge_z": -0.8}
BAR = {"mass": 1.0, "x": 0.7, "z": -1.0, "Ixx": 0.02, "Iyy": 0.01, "Izz": 0.02, "stiffness": 50.0}


def changed(part, **more):
    return dataclasses.replace(part, **more)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: Slope(10.0), r"Slope\.angle = 10 rad must lie between -1\.57 and 1\.57 rad\. In degrees\?"),
        (lambda: BENCHMARK.with_parts(zB=0.9), r"Bicycle\.zB = 0\.9 m must lie .* With the other sign\?"),
        (lambda: BENCHMARK.with_parts(lam=18.0), r"Bicycle\.lam = 18 rad .* In degrees\?"),
        (lambda: BENCHMARK.with_parts(c=80.0), r"Bicycle\.c = 80 m .* In millimetres\?"),
        (lambda: BENCHMARK.with_parts(w=-1.0), r"Bicycle\.w = -1\.0 must be positive"),
        (lambda: BENCHMARK.with_parts(g=-9.81), r"Bicycle\.g = -9\.81 m/s\^2 .* With the other sign\?"),
        (lambda: jk.catalog.WhippleBicycle.from_parameters(PLAIN | {"zB": 0.9}), r"WhippleBicycle\.zB = 0\.9 m"),
        (lambda: changed(RIDER, mass=800.0), r"RigidRider\.mass = 800 kg .* In newtons\?"),
        (lambda: changed(RIDER, shoulder=[330.0, 200.0, -1470.0]), r"RigidRider\.shoulder = .* In millimetres\?"),
        (lambda: LeaningRider(**LEANING | {"hinge_z": 0.8}), r"LeaningRider\.hinge_z = 0\.8 m .* other sign\?"),
        (lambda: Arms.of_person(83.5, 183.0, grip=[0.55, 0.28, -1.05]), r"Arms\.upper_length = 34\.038 m"),
        (lambda: changed(TRAILER, hitch_z=0.5), r"Trailer\.hitch_z = 0\.5 m .* With the other sign\?"),
        (lambda: HeadTwist(1e3, height=400.0), r"HeadTwist\.height = 400 m .* In millimetres\?"),
        (lambda: ConstantSpeed(250.0), r"ConstantSpeed\.speed = 250 m/s .* In km/h\?"),
        (lambda: SteeringMotor(lag=20.0), r"SteeringMotor\.lag = 20 s .* In milliseconds\?"),
        (lambda: Tyre(rolling_resistance=-0.005), r"Tyre\.rolling_resistance = -0\.005 must .* With the other sign\?"),
        (lambda: LateralSlip(9e3, relaxation_length=100.0), r"LateralSlip\.relaxation_length = 100 m .* In milli"),
        (lambda: MagicFormula(14.0, friction=700.0), r"MagicFormula\.friction = 700 must lie between 0 and 10"),
        (lambda: changed(schwalbe_energizer(), largest_slip=10.0), r"largest_slip = 10\.0 rad .* In degrees\?"),
        (lambda: PathFollower(LaneChange(), limit=17.0), r"PathFollower\.limit = 17 rad .* In degrees\?"),
    ],
)
def test_implausible_parameters_are_rejected_with_the_likely_unit_error(made, words):
    """Degrees for radians, millimetres for metres, newtons for kilograms, a mass centre below the ground."""
    with pytest.raises(ValueError, match=words):
        made()


@pytest.mark.weekly
def test_a_batch_member_with_an_implausible_parameter_has_status_invalid():
    swept = sweep(BENCHMARK, straight_ahead(BENCHMARK, 5.0), jnp.array([0.0, 0.1]), table={"zB": [-0.9, 0.9, -0.8]})
    assert swept.counts == {"completed": 2, "invalid": 1}


@pytest.mark.weekly
@pytest.mark.parametrize(
    "ask",
    [
        lambda bicycle: jk.accelerations(bicycle, 0.0, jnp.zeros(8), jnp.zeros(5)),
        lambda bicycle: linearize(bicycle, straight_ahead(bicycle, 5.0), states=bicycle.lateral),
    ],
)
def test_a_load_beyond_the_measured_range_is_reported_with_the_tyre(ask):
    """A wheel of 1409 N on a tyre that was measured up to 1000 N."""
    city = Tyre(crown=0.022, lateral=schwalbe_energizer())
    bicycle = BENCHMARK.with_parts(mB=200.0, rear_tyre=city, front_tyre=city)
    with pytest.raises(ValueError, match=r"the rear tyre carries 1409 N, .* its MagicFormula89, 1000 N, at roll ="):
        ask(bicycle)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"rider": (LeaningRider(**LEANING),) * 2}, r"'rider_lean' .* in rider\[0\], .* rider\[1\]"),
        ({"rider": RIDER, "extra": [RIDER]}, r"extra\[0\], a RigidRider: .*'left_shoulder'.*write your own Part"),
        ({"control": (LeanSteerGains(), LeanSteerGains())}, r"'desired_roll' .* in control\[0\], a LeanSteerGains"),
        ({"drive": (Drag(), Drag())}, r"drive\[1\], a Drag: .* point with the name 'center of drag'"),
    ],
)
def test_two_parts_of_the_same_kind_are_rejected(parts, words):
    """Their values would have one name."""
    with pytest.raises(ValueError, match=words):
        jk.accelerations(BENCHMARK.with_parts(**parts), 0.0, jnp.zeros(8), jnp.zeros(3))


@pytest.mark.slow
def test_a_parameter_of_a_part_has_the_same_name_everywhere():
    """As Python writes it: in a fit, an export and a copy with other parameters."""
    name, bicycle = "extra[0].mass", BENCHMARK.with_parts(extra=[TRAILER])
    assert name in leaf_names(bicycle)
    assert name in jk.export.parameters(bicycle)
    assert find_leaves(bicycle, name)[0] == find_leaves(bicycle, lambda b: b.extra[0].mass)[0]
    assert len(find_leaves(bicycle, "extra[0]")[0]) == len(find_leaves(bicycle, "extra")[0]) == 11
    heavier = bicycle.with_parts(**{name: 30.0, "w": 1.1})
    assert (float(heavier.extra[0].mass), float(heavier.w), float(bicycle.extra[0].mass)) == (30.0, 1.1, 20.0)
    for wrong in ("extra.0.mass", "extra[1].mass"):
        for ask in (find_leaves, lambda b, name: b.with_parts(**{name: 30.0})):
            with pytest.raises(ValueError, match=r"did you mean 'extra\[0\]\.mass'"):
                ask(bicycle, wrong)
    with pytest.raises(ValueError, match=r"Trailer\.mass = -1\.0 must be positive"):
        bicycle.with_parts(**{name: -1.0})


def test_arms_can_be_passed_in_the_rider_field():
    bicycle = BENCHMARK.with_parts(rider=(RIDER, ARMS))
    assert bicycle.dependent_coordinates[1:] == Arms.coordinates


class Nothing(Part):
    """Every method forgets to return."""

    of: str = dataclasses.field(metadata={"static": True})

    def motion(self, bicycle, motion, t, q, u):
        return None if self.of == "motion" else motion

    def commands(self, bicycle, t, q, u, motion, values):
        return {"none": None, "number": 1.0}.get(self.of, {"steer_torque": None} if self.of == "value" else {})

    def outputs(self, bicycle, t, q, u, motion, now):
        return None if self.of == "outputs" else {}


class Twice(Part):
    def outputs(self, bicycle, t, q, u, motion, now):
        return {"front_lateral_force": 0.0}


class Filter(Part):
    """A state of the first order whose rate is given by name."""

    states = ("filtered",)

    def state_rates(self, bicycle, t, q, u, x, motion, now):
        return {"filtered": now["steer_torque"] - x["filtered"]}


class Counts(Filter):
    def state_rates(self, bicycle, t, q, u, x, motion, now):
        return (1.0, 2.0)


@pytest.mark.weekly_cases("part[456]-*")
@pytest.mark.parametrize(
    ("part", "error", "words"),
    [
        (Nothing("motion"), TypeError, r"Nothing\.motion must return `motion\.extended.*without a `return`"),
        (Nothing("none"), TypeError, r"Nothing\.commands must return a dict of numbers by name.*without a `return`"),
        (Nothing("number"), TypeError, r"Nothing\.commands must return a dict of numbers by name"),
        (Nothing("value"), TypeError, "one number, got None"),
        (Nothing("outputs"), TypeError, r"Nothing\.outputs must return a dict of numbers by name"),
        (Twice(), ValueError, r"Twice\.outputs: the output 'front_lateral_force' exists already"),
        (Counts(), ValueError, r"Counts\.state_rates must have 1 entries \(filtered\), got 2"),
    ],
)
def test_invalid_return_values_of_a_part_are_rejected(part, error, words):
    bicycle = BENCHMARK.with_parts(front_tyre=Tyre(lateral=LateralSlip(9e3)), extra=[part])
    with pytest.raises(error, match=words):
        jk.simulate(bicycle, straight_ahead(bicycle, 5.0), jnp.array([0.0, 0.1]))


@pytest.mark.parametrize(
    "parts",
    [
        {"control": SteeringMotor(), "steering": GAINS},
        {"control": (LeanSteerGains(roll=-50.0), PathFollower(LaneChange()))},
    ],
)
def test_a_command_computed_after_its_reader_is_rejected(parts):
    """It would be lost: the part that has the input has read it already."""
    bicycle = BENCHMARK.with_parts(**parts)
    with pytest.raises(ValueError, match="after the part that reads it"):
        jk.accelerations(bicycle, 0.0, jnp.zeros(8), jnp.zeros(3))


PLAIN = {field: getattr(BENCHMARK, field) for field in ("w", "c", "lam", "rR", "mR", "IRxx", "IRyy", "xB", "zB", "mB")}
PLAIN |= {f"IB{axes}": getattr(BENCHMARK, f"IB{axes}") for axes in ("xx", "yy", "zz", "xz")}
PLAIN |= {name: getattr(BENCHMARK, name) for name in ("xH", "zH", "mH", "IHxx", "IHyy", "IHzz", "IHxz")}
PLAIN |= {name: getattr(BENCHMARK, name) for name in ("rF", "mF", "IFxx", "IFyy")}


def written(folder, suffix=".txt", **more):
    lines = [f"{name} = {x}" if suffix == ".txt" else f"{name}: {x}" for name, x in (PLAIN | more).items()]
    path = folder / f"bicycle{suffix}"
    path.write_text("\n".join(lines), encoding="utf-8-sig")  # with the mark of some editors
    return path


@pytest.mark.parametrize("suffix", [".txt", ".yml"])
def test_implausible_units_in_files_are_rejected(suffix, tmp_path):
    assert Bicycle.from_file(written(tmp_path, suffix, v=4.6)).mB == BENCHMARK.mB
    with pytest.raises(ValueError, match=r"lam = 18 rad .* In degrees\?"):
        Bicycle.from_file(written(tmp_path, suffix, lam=18.0))
    with pytest.raises(ValueError, match=r"rR = 300 m .* In millimetres\?"):
        Bicycle.from_file(written(tmp_path, suffix, rR=300.0))
    with pytest.raises(ValueError, match=rf"bicycle{suffix}: Bicycle.zB = 0\.9 m must lie between -20 and 0 m"):
        Bicycle.from_file(written(tmp_path, suffix, zB=0.9))
    damaged = tmp_path / f"damaged{suffix}"
    damaged.write_bytes(b"\x00\xff\xfe\x81")
    with pytest.raises(ValueError, match=f"damaged{suffix} is not a text file"):
        Bicycle.from_file(damaged)


@pytest.mark.slow_cases("parts1-*")
@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"steering": SteeringMotor(lag=0.1)}, "steer_motor_torque, but the canonical equations contain only roll"),
        (
            {"control": ScheduledGains([2.0, 4.0], ["roll"], [[-20.0], [-10.0]], [-20.0, -10.0])},
            "contain terms of the speed other",
        ),
    ],
)
def test_canonical_matrices_are_rejected_if_they_omit_terms_of_the_parts(parts, words):
    with pytest.raises(ValueError, match=words):
        canonical(BENCHMARK.with_parts(**parts))
