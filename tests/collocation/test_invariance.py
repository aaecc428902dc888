"""Units, durations, zeros, changed functions, threads and repeated solves do not change a plan."""

import gc
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import RodOnPin, Sled

import jaxkane as jk
from jaxkane.collocation import Problem, solve

pytest.importorskip("casadi")

ENDS = {"start": {"x": 0.0, "v": 0.0}, "end": {"x": 1.0, "v": 0.0}}


def effort(t, now):
    return now["force"] ** 2


class Plate(jk.System):
    """A point with a hardening spring along N.x; along N.y it stays at rest."""

    mass: jk.Scalar = jk.parameter(1.0, positive=True, unit="kg")
    stiffness: jk.Scalar = jk.parameter(1.0, unit="N/m")
    hardening: jk.Scalar = jk.parameter(1.0, unit="N/m^3")
    coordinates, speeds, inputs = ("x", "y"), ("vx", "vy"), ("force",)
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "force": "N"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(N.vector(*q, 0.0), N.vector(*u, 0.0)), N, name="plate")])

    def loads(self, t, q, u, motion, inputs):
        N, k = motion.N, self.stiffness
        along = inputs["force"] - k * q["x"] - self.hardening * q["x"] ** 3
        return jk.Force(along * N.x - k * q["y"] * N.y, motion["plate"])


SI = (1.0, 1.0, 1.0)
OTHERS = [(1e9, 1e-3, 1e6), (1e-9, 1e3, 1e-6)]  # nanometres, tonnes and microseconds; the opposite


def planned(units, is_fastest):
    L, M, T = units
    F, plate = M * L / T**2, Plate(mass=M, stiffness=M / T**2, hardening=M / T**2 / L**2)
    rest = {"x": 0.0, "y": 0.0, "vx": 0.0, "vy": 0.0}
    arguments = {"start": rest, "end": {"x": L, "vx": 0.0}, "controls": {"force": (-3 * F, 3 * F)}}
    if is_fastest:
        return solve(Problem(plate, (0.1 * T, 10 * T), final_cost=lambda t, now: t, **arguments), intervals=10)
    return solve(Problem(plate, 2 * T, cost=effort, **arguments), intervals=10)


@pytest.mark.weekly
@pytest.mark.parametrize("units", OTHERS)
def test_units_of_length_mass_and_time(units):
    rtol, (L, M, T) = 1e-9, units
    for is_fastest, factor in ((False, (M * L / T**2) ** 2 * T), (True, T)):
        plan, scaled = planned(SI, is_fastest), planned(units, is_fastest)
        assert plan.ok
        assert scaled.ok
        assert scaled.cost / factor == pytest.approx(plan.cost, rel=rtol)
        assert scaled.iterations == plan.iterations
        np.testing.assert_allclose(scaled.mesh / T, plan.mesh, rtol=1e-6)
        np.testing.assert_allclose(scaled["x"] / L, plan["x"], atol=1e-9)
        np.testing.assert_array_equal(scaled["y"], 0.0)


@pytest.mark.weekly
def test_states_that_are_zero_do_not_refine_the_mesh():
    """The flight of an aircraft straight ahead that rolls: y and z are zero but for errors of 2e-5 m beside 200 m. With
    these as sizes, the mesh grew from 40 to 316 intervals."""
    aircraft = jk.catalog.AircraftEulerParameters()
    turns = dict.fromkeys(("omega1", "omega2", "omega3"), 0.0)
    start = jk.assemble(aircraft, dict.fromkeys(("x", "y", "z", "e1", "e2", "e3"), 0.0), {"v1": 100.0})
    torques = ("torque1", "torque2", "torque3")
    problem = Problem(
        aircraft, 2.0, controls=torques, cost=lambda t, now: sum(now[name] ** 2 for name in torques), start=start,
        end={"e1": 0.5, "e2": 0.0, "e3": 0.2, **turns},
    )  # fmt: skip
    plan = solve(problem, intervals=10)
    assert plan.ok
    assert len(plan.mesh) - 1 <= 60
    norm = sum(np.asarray(plan[f"e{i}"]) ** 2 for i in range(1, 5))
    np.testing.assert_allclose(norm, 1.0, atol=1e-5)
    assert "configuration constraints: largest residual" in plan.report()


weight = 1.0


@pytest.mark.slow
def test_changed_values_of_functions_are_used():
    """A global and a closure that change between two solves; the compiled programs are of the new values."""
    global weight
    limit = {"x": 1.0}

    def least():
        problem = Problem(
            Sled(), 1.0, controls=["force"], cost=lambda t, now: weight * now["force"] ** 2, start=ENDS["start"],
            end={"v": 0.0}, conditions=lambda first, last, duration: {"there": last["x"] - limit["x"]},
        )  # fmt: skip
        return solve(problem, intervals=2).cost

    assert least() == pytest.approx(12.0)
    weight = 2.0
    assert least() == pytest.approx(24.0)
    limit["x"] = 0.5
    assert least() == pytest.approx(6.0)
    weight = 1.0


@pytest.mark.slow
def test_second_solve_compiles_nothing():
    """Also with another mass, and with another end, which has other sizes. With sizes of one power of ten each, the
    simulations of the intervals were compiled again for 2.5 s."""

    def once(mass, far):
        ends = {"start": ENDS["start"], "end": {"x": far, "v": 0.0}}
        return solve(Problem(Sled(mass=mass), 1.0, controls=["force"], cost=effort, **ends), intervals=10)

    compiled = []
    once(1.0, 1.0)
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, _, **__: compiled.append(name) if name == "/jax/core/compile/backend_compile_duration" else None
    )
    assert once(2.0, 30.0).cost == pytest.approx(12.0 * 4.0 * 900.0)
    assert not compiled


@pytest.mark.weekly
def test_repeated_solves_do_not_grow_memory():
    problem = Problem(Sled(), 1.0, controls=["force"], cost=effort, **ENDS)

    def live():
        solve(problem, intervals=2)
        gc.collect()
        return len(gc.get_objects())

    live()
    first = live()
    for _ in range(5):
        last = live()
    assert last - first < 300


def test_two_threads():
    """Signals are handled by the main thread only."""
    found = {}

    def run(k):
        given = {"cost": effort} if k % 2 else {"final_cost": lambda t, now: t, "cost": None}
        duration = 1.0 if k % 2 else (0.1, 10.0)
        found[k] = solve(
            Problem(Sled(), duration, controls={"force": (-10.0, 10.0)}, **given, **ENDS), intervals=4
        ).cost  # fmt: skip

    threads = [threading.Thread(target=run, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[1], found[3]] == pytest.approx([12.0, 12.0], rel=1e-7)
    assert [found[0], found[2]] == pytest.approx([2 / np.sqrt(10.0)] * 2, rel=1e-7)


class Windy(Sled):
    """With a second input, and a wind that depends on time."""

    inputs = ("force", "gust")

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["force"] + inputs["gust"] + jnp.sin(t)) * motion.N.x, motion["sled"])


SIGNALS = {
    "samples": {"gust": jk.Samples(np.linspace(0.0, 3.0, 301), np.cos(np.linspace(0.0, 3.0, 301)))},
    "function": {"gust": lambda t, state: jnp.cos(t)},
    "all": lambda t, state: {"gust": jnp.cos(t)},
}


@pytest.mark.weekly
@pytest.mark.parametrize("name", SIGNALS)
def test_inputs_and_systems_that_depend_on_time(name):
    """The sum of all three forces is that of the undisturbed sled if the cost is that of the sum."""

    def whole(t, now):
        return (now["force"] + now["gust"] + jnp.sin(t)) ** 2

    problem = Problem(Windy(), (0.5, 1.5), controls=["force"], cost=whole, inputs=SIGNALS[name], **ENDS)
    plan = solve(problem, intervals=10, tolerance=1e-5)
    assert plan.ok
    assert plan.cost == pytest.approx(12.0 / 1.5**3, rel=1e-5)
    assert float(plan["gust"][-1]) == pytest.approx(np.cos(1.5), abs=1e-4)


class Valve(Sled):
    """The force follows its command with a delay of the first order."""

    states = ("actual",)
    inputs = ("command",)

    def state_rates(self, t, q, u, x, motion, now):
        return {"actual": 5.0 * (now["command"] - x["actual"])}

    def loads(self, t, q, u, motion, now):
        return jk.Force(now["actual"] * motion.N.x, motion["sled"])

    def outputs(self, t, q, u, motion, now):
        return {"power": now["actual"] * u["v"], "energy": {"kinetic": 0.5 * u["v"] ** 2}}


@pytest.mark.weekly
def test_first_order_states_and_outputs():
    """Outputs in the cost, along the motion, in a path constraint and at both ends."""
    problem = Problem(
        Valve(), 1.0, controls=["command"], cost=lambda t, now: now["command"] ** 2 + now["power"] ** 2,
        start={"x": 0.0, "v": 0.0, "actual": 0.0}, end={"x": 0.5, "power": (-0.1, 0.1), "energy.kinetic": 0.02},
        within={"power": (-0.5, None)}, path=lambda t, now: {"gentle": 1.0 - now["power"]},
    )  # fmt: skip
    plan = solve(problem, intervals=20, tolerance=1e-4)
    assert plan.ok, plan.reason
    np.testing.assert_allclose(plan["power"], plan["actual"] * plan["v"], atol=1e-12)
    assert float(plan["energy.kinetic"][-1]) == pytest.approx(0.02, abs=1e-8)
    assert -0.1 - 1e-6 <= float(plan["power"][-1]) <= 0.1 + 1e-6
    assert -0.5 - 1e-6 <= float(jnp.min(plan["power"]))
    assert float(jnp.max(plan["power"])) <= 1.0 + 1e-6
    assert "energy.kinetic at the end" in plan.multipliers


@pytest.mark.weekly
def test_dependent_coordinates_and_speeds():
    """A point on a circle, from its own start to a height, with bounds on the dependent speed."""
    rod = RodOnPin(length=1.0)
    problem = Problem(
        rod, 1.0, controls=["push"], cost=lambda t, now: now["push"] ** 2, start={"y": 0.1, "v": 0.0},
        end={"y": 0.6, "x_dot": 0.0}, within={"x_dot": (-0.5, 0.5)},
    )  # fmt: skip
    plan = solve(problem, intervals=20)
    assert plan.ok, plan.reason
    np.testing.assert_allclose(plan["x"] ** 2 + plan["y"] ** 2, 1.0, atol=1e-5)
    np.testing.assert_allclose(plan["x"] * plan["x_dot"], -plan["y"] * plan["v"], atol=1e-12)
    assert float(jnp.max(jnp.abs(plan["x_dot"]))) <= 0.5 + 1e-6
    assert plan.deviation(plan.replay()) < 1e-4
    assert float(plan["v"][-1]) == pytest.approx(0.0, abs=1e-6)
