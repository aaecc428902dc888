"""Tyres that slip: the limit of ideal rolling, Sharp's motorcycle, energy, forces in turns, rest, going backwards."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.bicycles import (
    Bicycle,
    HeadTwist,
    LateralSlip,
    LongitudinalSlip,
    MagicFormula,
    MagicFormula89,
    Part,
    Road,
    Slope,
    Tyre,
    schwalbe_energizer,
    sharp_motorcycle,
)
from jaxkane.stability import eigenvalues, linearize, steady_turn, straight_ahead

SPEEDS = jnp.array([2.0, 4.6, 8.0])  # [m/s]


def with_tyres(**law):
    tyre = Tyre(lateral=LateralSlip(**law))
    return Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre)


@jax.jit
def slow_eigenvalues(bicycle):
    """Those four at each speed that do not grow with the tyres' stiffness."""

    def one(speed):
        found = linearize(bicycle, straight_ahead(bicycle, speed), states=bicycle.lateral).eigenvalues
        slow = found[jnp.argsort(jnp.abs(found))[:4]]
        return jnp.sort(slow)

    return jax.vmap(one)(SPEEDS)


def test_camber_is_equivalent_to_a_slip_angle():
    slip = LateralSlip(cornering_stiffness=2e4, camber_stiffness=900.0)
    force = slip.force(0.02 + slip.equivalent(0.1), 800.0, 0.1)
    np.testing.assert_allclose(force, 2e4 * 0.02 + 900.0 * 0.1, rtol=1e-15)
    assert LateralSlip(cornering_stiffness=2e4).equivalent(0.1) == 0.0


@pytest.mark.weekly
@pytest.mark.parametrize("relaxation", [None, 0.1])
def test_stiff_tyres_approach_ideal_rolling(relaxation):
    """1e-6 by extrapolation from 1e7 and 1e8 N/rad; the difference itself falls as one over the stiffness."""
    whipple = slow_eigenvalues(Bicycle.benchmark())
    stiffness = [1e7, 1e8]
    found = [
        slow_eigenvalues(with_tyres(cornering_stiffness=k, relaxation_length=relaxation and relaxation * 1e5 / k))
        for k in stiffness
    ]
    soft, stiff = (np.max(np.abs(x - whipple), axis=1) for x in found)
    np.testing.assert_allclose(soft / stiff, 10.0, rtol=5e-3)  # of the first order
    np.testing.assert_allclose((10.0 * found[1] - found[0]) / 9.0, whipple, atol=1e-6)


# Sharp (1971), tables 1 to 3, model 1, as printed; read in the public transcription 0tmeF/MotoDynamics,
# docs/research/sharp-1971-estabilidad-lineal.md. Real parts of capsize, weave, wobble [1/s]; imaginary parts [rad/s].
SHARP = {
    10: (-3.56, 2.01, 1.63, -5.20, 55.7),
    20: (-2.83, -0.18, 2.09, -5.91, 55.8),
    30: (-0.13, -3.36, 4.56, -6.42, 55.5),
    50: (0.08, -6.59, 11.4, -6.52, 54.6),
    70: (0.08, -3.97, 16.8, -5.70, 54.0),
    100: (0.07, -1.82, 19.2, -3.94, 54.3),
    130: (0.05, -1.13, 20.4, -2.24, 55.6),
    160: (0.04, -0.96, 21.2, -0.82, 57.5),
}
FOOT, POUND = 0.3048, 4.4482216152605


class RoundedLoad(Part):
    """What a rounded load of the front wheel does to the moment about the steer axis, as Sharp's table has it."""

    missing: Scalar = parameter(unit="N")
    trail: Scalar = parameter(0.38 * FOOT, unit="m")  # square to the steer axis

    def commands(self, bicycle, t, q, u, motion, values):
        lean = q["roll"] + jnp.sin(bicycle.lam) * q["steer"]  # of the front wheel
        return {"steer_torque": -self.missing * self.trail * lean}


@pytest.mark.weekly
@pytest.mark.optimized
@pytest.mark.published
def test_eigenvalues_of_sharps_motorcycle_agree_with_the_published_table(published):
    """40 of 40 to the printed digits, with the load of the front wheel that he rounds to 226 lb."""
    motorcycle = sharp_motorcycle()
    jk.assemble(motorcycle, {})  # which refuses inertias that no body has
    moments = motorcycle.mB * motorcycle.xB + motorcycle.mH * motorcycle.xH + motorcycle.mF * motorcycle.w
    load = motorcycle.g * moments / motorcycle.w
    np.testing.assert_allclose(load / POUND, 226.0, atol=0.5)
    rounded = motorcycle.with_parts(extra=[RoundedLoad(missing=load - 226.0 * POUND)])
    found = eigenvalues(rounded, FOOT * jnp.array([*SHARP], float))
    weave, wobble = (np.asarray(found[mode][:, 0]) for mode in ("weave", "wobble"))
    capsize = np.asarray(found["capsize"][:, 0])
    table = np.stack([capsize.real, weave.real, weave.imag, wobble.real, wobble.imag], axis=1)
    known = np.array([*SHARP.values()])
    last_digit = np.where(np.abs(known) < 10.0, 0.01, 0.1)
    published(
        "Sharp (1971)",
        "modes of a motorcycle, 10 to 160 ft/s, tables 1 to 3 [1/s]",
        known,
        table,
        0.5 * last_digit.ravel(),
    )


@pytest.mark.weekly
def test_modes_of_tyres_and_flexible_frame_are_named():
    """What bounces on the tyres, the wobble of a frame that gives way, and the bicycle's own modes, under jit too."""
    tyre = Tyre(lateral=LateralSlip(9000.0, 900.0, relaxation_length=0.1))
    bicycle = Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre, head=HeadTwist(3000.0, 1.0))
    found = eigenvalues(bicycle, jnp.array([1.0, 3.0, 5.0]))
    names = ("rear tyre", "rear tyre", "wobble", "wobble", "front end", "front end")
    assert found.modes == ("weave", "weave", "capsize", "castering", *names)
    frequency = {mode: float(jnp.abs(found[mode][-1, 0].imag)) for mode in found.modes}
    assert frequency["capsize"] == frequency["castering"] == 0.0
    assert frequency["weave"] < 6.0 < 40.0 < frequency["wobble"] < 50.0 < frequency["front end"]
    np.testing.assert_allclose(jnp.max(found["wobble"].real), 3.25, atol=0.01)  # it grows


LEANING = {"roll": 0.2, "steer": 0.15, "yaw": 0.3, "x": 0.5, "y": -0.2}
MOVING = {"roll_rate": 0.3, "rear_wheel_rate": -16.0, "steer_rate": -0.4}


@pytest.mark.weekly
def test_linear_models_on_a_grade():
    """1e-12: at an instant of a ride up a `Road` that rises evenly, and of the steady one up a `Slope`.

    Its drive carries the weight along the slope: total mass * g * sin(angle) * rR.
    """
    bicycle = Bicycle.benchmark()
    slope = bicycle.with_parts(road=Slope(jnp.arctan(0.1)))
    road = bicycle.with_parts(road=Road(lambda x, y: 0.1 * x))
    up = straight_ahead(slope, 5.0)
    mass = bicycle.mR + bicycle.mB + bicycle.mH + bicycle.mF
    np.testing.assert_allclose(up["drive_torque"], -mass * bicycle.g * 0.1 / np.sqrt(1.01) * bicycle.rR, rtol=1e-12)
    start = jk.assemble(road, {"x": 2.0}, {"rear_wheel_rate": -5.0 / bicycle.rR})
    here = linearize(road, start, up.inputs, states=road.lateral, outputs=(), steady=False)
    np.testing.assert_allclose(here.A, linearize(slope, up, states=slope.lateral).A, rtol=1e-12, atol=1e-12)


def test_linear_models_along_a_road_raise_with_advice():
    road = Bicycle.benchmark().with_parts(road=Road(lambda x, y: 0.1 * x))
    for ask in (straight_ahead, linearize_straight, eigenvalues):
        with pytest.raises(ValueError, match=r"along a Road .* Slope\(angle\).*steady=False"):
            ask(road, 5.0)


@pytest.mark.weekly
def test_linear_models_raise_if_straight_riding_is_not_steady():
    """The result is NaN instead if the caller passes a family of states."""
    across = Bicycle.benchmark().with_parts(road=Slope(0.1, towards=0.5 * np.pi))
    with pytest.raises(ValueError, match="no steady motion"):
        eigenvalues(across, 5.0)
    assert np.all(np.isnan(eigenvalues(across, 5.0, straight_ahead, states=across.lateral).eigenvalues))


def linearize_straight(bicycle, speed):
    return linearize(bicycle, straight_ahead(bicycle, speed))


@pytest.mark.weekly
def test_a_flat_road_equals_level_ground():
    """1e-12, a torus that slips behind, a knife edge that rolls before."""
    tyre = Tyre(crown=0.03, lateral=LateralSlip(9000.0, 900.0), longitudinal=LongitudinalSlip(2e4))
    level = Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre)
    flat = level.with_parts(road=Road(lambda x, y: 0.0))

    def found(bicycle):
        start = jk.assemble(bicycle, LEANING, MOVING | {"front_lateral_slip": 0.02, "rear_longitudinal_slip": -0.1})
        return jk.accelerations(bicycle, 0.0, start.q, start.u), jk.dependent_speeds(bicycle, 0.0, start.q, start.u)

    (a, u), (a_level, u_level) = found(flat), found(level)
    np.testing.assert_allclose(a, a_level, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(u[:3], u_level, rtol=1e-12, atol=1e-12)


@pytest.mark.weekly
def test_energy_is_conserved_and_wheels_keep_contact_over_a_bump():
    """1e-8 of the energy, 1e-8 m; 5 cm high, half a metre long, crossed at an angle with toroidal tyres."""
    bump = Road(lambda x, y: 0.05 * jnp.exp(-(((x - 2.0) / 0.5) ** 2)) * (1.0 + 0.2 * jnp.sin(y)))
    bicycle = Bicycle.benchmark().with_parts(road=bump, rear_tyre=Tyre(crown=0.03), front_tyre=Tyre(crown=0.02))
    start = jk.assemble(bicycle, {"roll": 0.05, "steer": 0.02}, {"rear_wheel_rate": -5.0 / 0.3})
    ride = jk.simulate(bicycle, start, jnp.linspace(0.0, 0.6, 41), rtol=1e-10, atol=1e-11)
    kept = jk.audit(bicycle, ride)
    assert float(jnp.max(ride["pitch"]) - jnp.min(ride["pitch"])) > 0.05
    assert kept.reason == "completed"
    assert kept.energy_balance < 1e-8
    assert kept.drift < 1e-8


@pytest.mark.weekly
def test_a_step_in_the_road_ends_the_simulation():
    """A kerb of 20 cm that is narrower than the solver's steps, and a start from where the wheel is in it."""
    kerb = Bicycle.benchmark().with_parts(road=Road(lambda x, y: 0.1 * (1.0 + jnp.tanh((x - 2.5) / 0.02))))
    start = jk.assemble(kerb, {}, {"rear_wheel_rate": -5.0 / 0.3})
    ride = jk.simulate(kerb, start, jnp.linspace(0.0, 1.0, 21))
    assert ride.reason == "wheel touches twice"
    assert 2.0 < float(jnp.nanmax(ride["front_x"])) < 2.3  # a third of a metre before the kerb
    with pytest.raises(ValueError, match="satisfies the configuration constraints"):
        jk.assemble(kerb, {"x": 2.3 - 1.02})


@pytest.mark.weekly
def test_the_energy_balance_includes_tyres_and_flexible_frame():
    """1e-9: lateral slip with relaxation and moments, longitudinal slip, rolling resistance, a frame that gives way."""
    rear = Tyre(0.02, MagicFormula(12.0, 1.1, camber_ratio=0.1, relaxation_length=0.1), rolling_resistance=0.005)
    front = Tyre(
        lateral=LateralSlip(9000.0, 900.0, relaxation_length=0.1, pneumatic_trail=0.02, twisting_stiffness=5.0),
        longitudinal=LongitudinalSlip(2e4),
    )
    bicycle = Bicycle.benchmark().with_parts(rear_tyre=rear, front_tyre=front, head=HeadTwist(3000.0, 3.0))
    start = jk.assemble(bicycle, {"roll": 0.1}, {"rear_wheel_rate": -4.6 / 0.3, "roll_rate": 0.2})
    ride = jk.simulate(bicycle, start, jnp.linspace(0.0, 0.2, 601), rtol=1e-11, atol=1e-12)
    kept = jk.audit(bicycle, ride)
    assert kept.reason == "completed"
    assert float(np.abs(kept.work).max()) > 1.0
    assert kept.energy_balance < 1e-9


@pytest.mark.weekly
def test_tyre_forces_balance_the_centripetal_acceleration_in_a_steady_turn():
    """1e-10: weight, and mass times speed squared over radius, of all bodies in a steady turn."""
    law = LateralSlip(9000.0, 900.0, relaxation_length=0.1, pneumatic_trail=0.02, twisting_stiffness=5.0)
    tyre = Tyre(crown=0.02, lateral=law)
    bicycle = Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre)
    leaning = jk.assemble(bicycle, {"roll": 0.3, "steer": 0.05})
    turn = steady_turn(
        bicycle,
        leaning.q,
        {"rear_wheel_rate": -5.0 / 0.3},
        hold=("roll", "rear_wheel_rate"),
        find=("steer_torque", "drive_torque"),
    )
    assert abs(float(turn["rear_lateral_slip"])) > 0.01
    at = (bicycle, 0.0, turn.q, turn.u, turn.inputs | dict(zip(bicycle.states, turn.x, strict=True)))
    constraints, slipping, places = jk.constraint_forces(*at), jk.outputs(*at), jk.positions(*at)
    yaw_rate, rates = float(turn["yaw_rate"]), jk.coordinate_rates(*at[:4])
    x_dot, y_dot = (float(rates[bicycle.coordinates.index(k)]) for k in ("x", "y"))
    middle = np.array([-y_dot, x_dot]) / yaw_rate  # of the turn; the rear contact is at the origin, its heading along x
    axle = np.asarray(jk.orientations(*at)["C"])[1]  # of the front wheel
    across = axle[:2] / np.hypot(axle[0], axle[1])  # on the ground
    tyres = slipping["rear_lateral_force"] * np.array([0.0, 1.0]) + slipping["front_lateral_force"] * across
    force = np.asarray(constraints["P"] + constraints["Q"])
    masses = {"rear wheel": bicycle.mR, "rear frame": bicycle.mB, "fork": bicycle.mH, "front wheel": bicycle.mF}
    needed = -(yaw_rate**2) * sum(m * (np.asarray(places[k])[:2] - middle) for k, m in masses.items())
    total = float(sum(masses.values()) * bicycle.g)
    np.testing.assert_allclose(-force[2], total, rtol=1e-10)
    np.testing.assert_allclose(force[:2] + tyres, needed, atol=1e-10 * total)


@pytest.mark.parametrize(
    "law",
    [
        LateralSlip(9000.0, 900.0, relaxation_length=0.1),
        MagicFormula(12.0, 1.1, camber_ratio=0.1, relaxation_length=0.1),
    ],
    ids=["linear", "magic formula"],
)
def test_a_relaxed_force_approaches_the_force_without_relaxation(law):
    """At the deflection whose rate is zero. Without relaxation, slip at small speeds is regularized, here by 2e-6."""
    rtol = 3e-6
    velocity, speed, camber, load = 0.2, 5.0, -0.3, 400.0
    without = dataclasses.replace(law, relaxation_length=None)
    # The rate is linear in the deflection.
    at = [law.deflection_rate(velocity, speed, camber, deflection) for deflection in (0.0, 1.0)]
    deflection = at[0] / (at[0] - at[1])
    relaxed = law.force(law.slip(velocity, speed, camber, deflection), load, camber)
    expected = without.force(without.slip(velocity, speed, camber, None), load, camber)
    np.testing.assert_allclose(relaxed, expected, rtol=rtol)


@pytest.mark.weekly
def test_tyres_with_relaxation_reverse_direction_with_finite_derivatives():
    """A torque against the motion; everything is finite, and so is the derivative in the stiffness."""

    def ride(stiffness):
        law = LateralSlip(stiffness, 900.0, relaxation_length=0.1)
        tyre = Tyre(None, law, LongitudinalSlip(2e4, relaxation_length=0.1), rolling_resistance=0.005)
        bicycle = Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre)
        start = jk.assemble(bicycle, {"roll": 0.001}, {"rear_wheel_rate": -1.0 / 0.3})
        found = jk.simulate(bicycle, start, jnp.linspace(0.0, 1.0, 21), inputs={"drive_torque": 75.0})
        return found["roll"][-1], found["rear_wheel_rate"]

    (roll, spin), slope = jax.jit(jax.value_and_grad(ride, has_aux=True))(9000.0)
    assert spin[0] < 0.0 < spin[-1]
    assert np.all(np.isfinite([roll, slope, *spin]))
    assert slope != 0.0


def with_load_transfer(lag, **more):
    law = MagicFormula(12.0, 1.1, camber_ratio=0.07, relaxation_length=0.1)
    tyre = Tyre(0.02, law, load_lag=lag, **more)
    return Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre)


@pytest.mark.weekly
def test_tyre_loads_equal_the_constraint_forces_during_braking():
    """1e-10: the load transfer is in equilibrium at the load that the moments about the rear contact require.

    N w = sum of m g x - a (sum of m h + IRyy / rR + IFyy / rF), with the acceleration a forwards.
    """
    bicycle = with_load_transfer(0.02)
    start = jk.assemble(bicycle, {}, {"rear_wheel_rate": -5.0 / 0.3})
    torque = {"drive_torque": 80.0}  # states that are left out are zero
    rates = jk.speed_rates(bicycle, 0.0, start.q, start.u, torque)
    a = -float(rates["rear_wheel_rate"] * bicycle.rR)
    masses = [(bicycle.mR, bicycle.rR), (bicycle.mF, bicycle.rF), (bicycle.mB, -bicycle.zB), (bicycle.mH, -bicycle.zH)]
    inertia = sum(m * h for m, h in masses) + bicycle.IRyy / bicycle.rR + bicycle.IFyy / bicycle.rF
    weight = sum(m for m, _ in masses) * bicycle.g
    transfer = -a * inertia / bicycle.w / weight
    assert a < -2.0
    assert transfer > 0.2  # more than a fifth of the weight
    moved = {"front_load_transfer": transfer, "rear_load_transfer": -transfer}
    at_rest = jk.state_rates(bicycle, 0.0, start.q, start.u, torque)
    still = jk.state_rates(bicycle, 0.0, start.q, start.u, torque | moved)
    np.testing.assert_allclose(at_rest["front_load_transfer"], 50.0 * transfer, rtol=1e-10)
    np.testing.assert_allclose([still[name] for name in moved], 0.0, atol=1e-10)


@pytest.mark.slow_cases(all_but=["law2"])
@pytest.mark.parametrize("law", [LateralSlip(9000.0), MagicFormula(12.0), LongitudinalSlip(2e4)])
def test_the_tyre_force_opposes_the_slip(law):
    """The force is within the friction limit and zero without slip or load. It has finite derivatives, also at rest."""

    def force(velocity, speed, load=400.0):
        return law.force(law.slip(velocity, speed, 0.0, None), load, 0.0)

    assert force(0.1, 5.0) < 0.0 < force(-0.1, -5.0)
    np.testing.assert_allclose(force(0.0, 0.0), 0.0, atol=1e-12)
    slopes = jax.grad(force, argnums=(0, 1))(0.0, 0.0)
    assert np.all(np.isfinite(slopes))
    assert slopes[0] < 0.0
    if isinstance(law, MagicFormula):
        assert abs(float(force(50.0, 5.0))) <= 400.0
        assert float(force(1.0, 5.0, load=-10.0)) == 0.0  # a wheel that would lift does not pull


@pytest.mark.parametrize("curvature", [-2.0, 0.0, 0.5])
def test_the_magic_formula_has_the_given_stiffness_and_peak(curvature):
    law = MagicFormula(12.0, friction=0.8, shape=1.4, curvature=curvature)
    np.testing.assert_allclose(jax.grad(law.force)(0.0, 400.0, 0.0), 12.0 * 400.0, rtol=1e-12)
    forces = law.force(jnp.linspace(0.0, 2.0, 2001), 400.0, 0.0)
    np.testing.assert_allclose(forces.max(), 0.8 * 400.0, rtol=1e-4)


# mechmotum/bicycle-kickplate-model at commit 6cc4d65 (BSD 3-clause), inputs.calc_nonlinear_tire_force over its factor
# of friction 1.31917, with signs turned, as its axes are: pressure [Pa], slip angle [deg], camber [deg], load [N],
# force [N], moment [N m].
MEASURED = [
    (300e3, 1.0, 0.0, 343.0, 84.76835698090714, -1.190851541852463),
    (300e3, -4.0, 5.0, 526.0, -334.7838255839842, 4.717175159478536),
    (300e3, 8.0, -20.0, 800.0, 338.0190805614346, -10.511075753385656),
    (400e3, 1.0, 0.0, 343.0, 83.29686934137285, -1.0849434969232616),
    (400e3, -4.0, 5.0, 526.0, -364.8165838400431, 3.9478925760238326),
    (400e3, 8.0, -20.0, 800.0, 299.53332487324724, -10.80312026556378),
    (500e3, 1.0, 0.0, 343.0, 85.436008058033, -1.1590474034601674),
    (500e3, -4.0, 5.0, 526.0, -294.6676952348661, 3.9121966557663743),
    (500e3, 8.0, -20.0, 800.0, 462.2265650380066, -14.191612854953153),
]


@pytest.mark.parametrize("pressure", [300e3, 400e3, 500e3])
def test_forces_of_a_measured_tyre_agree_with_its_formula(pressure):
    """1e-12, with the offsets of the tyre; without them left and right are alike."""
    law, even = schwalbe_energizer(pressure, offsets=True), schwalbe_energizer(pressure)
    rows = [row for row in MEASURED if row[0] == pressure]
    assert rows
    for _, angle, camber, load, force, moment in rows:
        at = (np.tan(np.deg2rad(angle)), load, np.deg2rad(camber))
        np.testing.assert_allclose(law.force(*at), force, rtol=1e-12)
        np.testing.assert_allclose(law.moment(force, *at), moment, rtol=1e-11)
        turned = (-at[0], load, -at[2])
        np.testing.assert_allclose(even.force(*turned), -even.force(*at), rtol=1e-12)
        np.testing.assert_allclose(even.moment(force, *turned), -even.moment(force, *at), rtol=1e-11)


@pytest.mark.slow
def test_a_measured_tyre_outside_its_range_of_validity():
    """The force is constant at larger slip angles, zero for a negative load, and NaN above the largest load."""
    law = schwalbe_energizer(400e3, offsets=True)
    ends = [law.force(np.tan(np.deg2rad(angle)), 400.0, 0.1) for angle in (10.0, 60.0)]
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12)
    assert ends[0] > law.force(0.0, 400.0, 0.1) > law.force(0.0, 400.0, 0.0)  # against the slip, towards the lean
    assert float(law.force(0.05, -1.0, 0.1)) == float(law.moment(0.0, 0.05, -1.0, 0.1)) == 0.0
    force, slopes = jax.value_and_grad(law.force, argnums=(0, 1, 2))(0.05, 1001.0, 0.1)
    assert np.all(np.isnan([force, *slopes]))
    assert np.all(np.isfinite(jax.grad(law.force, argnums=(0, 1, 2))(0.0, 0.0, 0.0)))
    assert schwalbe_energizer().moment(0.0, 0.01, 400.0, 0.0) < 0.0  # turns out of its slip
    assert MagicFormula89(law.force_coefficients).moment(0.0, 0.05, 400.0, 0.1) == 0.0


def test_invalid_tyres_and_roads_are_rejected():
    with pytest.raises(ValueError, match=r"cornering_stiffness = 0\.0 must be positive"):
        LateralSlip(0.0)
    with pytest.raises(ValueError, match=r"relaxation_length = 0\.0 must be positive"):
        LateralSlip(9000.0, relaxation_length=0.0)
    with pytest.raises(ValueError, match=r"load_lag = 0\.0 must be positive"):
        Tyre(load_lag=0.0)
    with pytest.raises(ValueError, match=r"350000\.0 Pa was not measured"):
        schwalbe_energizer(350e3)
    with pytest.raises(ValueError, match=r"largest_load = 0\.0 must be positive"):
        MagicFormula89(jnp.ones(14), largest_load=0.0)
    with pytest.raises(ValueError, match="one number"):
        Road(lambda x, y: jnp.array([x, y])).at(0.0, 0.0)
    with pytest.raises(TypeError, match="`road` must be a Ground"):
        Bicycle.benchmark().with_parts(road=0.1)
