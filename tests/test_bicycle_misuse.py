"""Bicycles and parts that are written or put together wrongly: each is refused by an error that says what to do."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import (
    Arms,
    Bicycle,
    HeadTwist,
    LaneChange,
    LateralSlip,
    LeaningRider,
    LeanSteerGains,
    LongitudinalSlip,
    Part,
    PathFollower,
    RigidRider,
    Road,
    ScheduledGains,
    SteeringMotor,
    Trailer,
    Tyre,
    lqr,
    separate_rider,
)
from jaxkane.stability import canonical, straight_ahead

BENCHMARK = Bicycle.benchmark()
RIDER = RigidRider(mass=20.0, x=0.3, z=-1.0, Ixx=0.8, Iyy=0.8, Izz=0.4, Ixz=0.0, shoulder=[0.33, 0.2, -1.47])
ARMS = Arms.of_person(83.5, 1.83, grip=[0.55, 0.28, -1.05])
TRAILER = Trailer(
    hitch_x=-0.1, hitch_z=-0.5, length=1.2, wheel_radius=0.25, mass=20.0, center=0.1, height=0.2, Ixx=1.0, Iyy=1.0,
    Izz=1.2,
)  # fmt: skip
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
        (lambda: BENCHMARK.with_parts(rear_tyre=LateralSlip(9e3)), TypeError, "`rear_tyre` is a Tyre, got a LateralSl"),
        (lambda: BENCHMARK.with_parts(extra=[HeadTwist(1e3)]), ValueError, r"with_parts\(head="),
        (lambda: BENCHMARK.with_parts(extra=[ARMS, RIDER]), ValueError, "does not have before them"),
        (lambda: BENCHMARK.with_parts(extra=[Aside()]), ValueError, "Aside.lateral: Bicycle has no lean"),
        (lambda: BENCHMARK.with_parts(front_tyre=Tyre(crown=0.35)), ValueError, r"front_tyre\.crown = 0\.35 m"),
        (lambda: BENCHMARK.with_parts(road=Road(lambda x, y: 0.0), extra=[TRAILER]), ValueError, "not on a Road"),
        (lambda: Tyre(lateral=9e3), TypeError, "law of lateral slip or None, got 9000.0"),
        (lambda: Tyre(lateral=LongitudinalSlip(1e4)), TypeError, "got a LongitudinalSlip"),
        (lambda: Tyre(longitudinal=LateralSlip(1e4)), TypeError, "got a LateralSlip"),
        (lambda: LateralSlip(None), TypeError, "cornering_stiffness must be a real number"),
        (lambda: LeaningRider(*np.ones(9), stiffness=None), TypeError, "stiffness must be a real number"),
        (lambda: Named(), TypeError, r"is a tuple of names, got 'drop'"),
        (lambda: separate_rider(BENCHMARK.with_parts(rider=RIDER), RIDER), ValueError, "has a rider already"),
        (
            lambda: lqr(BENCHMARK.with_parts(control=LeanSteerGains()), [4.0], np.ones(4), 0.1),
            ValueError,
            "balance alr",
        ),
        (
            lambda: BENCHMARK.with_parts(control=ScheduledGains([4.0], "rol", [[1.0]], [1.0])),
            ValueError,
            "Bicycle has no rol; did you mean 'roll'",
        ),
    ],
)
def test_what_does_not_fit_is_refused_where_it_is_put_together(made, error, words):
    with pytest.raises(error, match=words):
        made()


def test_arms_belong_to_a_rider_in_any_field():
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


@pytest.mark.parametrize(
    ("part", "error", "words"),
    [
        (Nothing("motion"), TypeError, r"Nothing\.motion returns `motion\.extended.*without a `return`"),
        (Nothing("none"), TypeError, r"Nothing\.commands returns numbers by name.*without a `return`"),
        (Nothing("number"), TypeError, r"Nothing\.commands returns numbers by name"),
        (Nothing("value"), TypeError, "one number, got None"),
        (Nothing("outputs"), TypeError, r"Nothing\.outputs returns numbers by name"),
        (Twice(), ValueError, r"Twice\.outputs: there is an output 'front_lateral_force' already"),
        (Counts(), ValueError, r"Counts\.state_rates must have 1 entries \(filtered\), got 2"),
    ],
)
def test_what_a_part_answers_wrongly_is_refused(part, error, words):
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
def test_a_command_that_comes_too_late_is_refused(parts):
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
def test_units_of_files(suffix, tmp_path):
    assert Bicycle.from_file(written(tmp_path, suffix, v=4.6)).mB == BENCHMARK.mB
    with pytest.raises(ValueError, match=r"lam = 18 rad .* In degrees\?"):
        Bicycle.from_file(written(tmp_path, suffix, lam=18.0))
    with pytest.raises(ValueError, match=r"rR = 300 m .* In millimetres\?"):
        Bicycle.from_file(written(tmp_path, suffix, rR=300.0))
    damaged = tmp_path / f"damaged{suffix}"
    damaged.write_bytes(b"\x00\xff\xfe\x81")
    with pytest.raises(ValueError, match=f"damaged{suffix} is no text file"):
        Bicycle.from_file(damaged)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"steering": SteeringMotor(lag=0.1)}, "steer_motor_torque, and has no equations in roll and steer alone"),
        (
            {"control": ScheduledGains([2.0, 4.0], ["roll"], [[-20.0], [-10.0]], [-20.0, -10.0])},
            "hold other terms of the speed",
        ),
    ],
)
def test_canonical_matrices_are_refused_where_they_do_not_tell_all(parts, words):
    with pytest.raises(ValueError, match=words):
        canonical(BENCHMARK.with_parts(**parts))


def test_parts_are_put_together_while_others_are_traced():
    thick = jax.jit(
        lambda x: BENCHMARK.with_parts(rear_tyre=Tyre(crown=0.02), front_tyre=Tyre(crown=x)).front_tyre.crown
    )
    assert thick(0.03) == 0.03
