"""Optimal control problems whose solutions are known, from formulas and publications."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from mechanisms import Sled

import jaxkane as jk
from jaxkane.collocation import Phases, Problem, solve
from jaxkane.stability import periodic

pytest.importorskip("casadi")

REST = {"x": 0.0, "v": 0.0}
REST_TO_REST = {"start": REST, "end": {"x": 1.0, "v": 0.0}}


def effort(t, now):
    return now["force"] ** 2


def time(t, now):
    return t


def test_least_energy_from_rest_to_rest():
    """u = 6 - 12 t: the energy is 12, and the last place x, if it were shifted, would change it by 24 x."""
    atol = 1e-9
    plan = solve(Problem(Sled(), 1.0, controls=["force"], cost=effort, **REST_TO_REST), intervals=5)
    assert plan.ok
    assert plan.cost == pytest.approx(12.0, abs=atol)
    np.testing.assert_allclose(plan["force"], 6 - 12 * np.asarray(plan.t), atol=atol)
    np.testing.assert_allclose(plan["x"], 3 * np.asarray(plan.t) ** 2 - 2 * np.asarray(plan.t) ** 3, atol=atol)
    assert plan.multipliers["x"][-1] == pytest.approx(24.0, abs=1e-6)
    assert plan.multipliers["v"][-1] == pytest.approx(-12.0, abs=1e-6)
    np.testing.assert_allclose(plan.multipliers.costate["x"], -24.0, atol=1e-6)


def test_a_range_at_the_end_does_not_replace_the_bounds_along_the_motion():
    """The spring pulls the sled back, so the least effort has a negative velocity at the end unless a bound holds."""
    atol = 1e-6
    problem = Problem(
        Sled(stiffness=4.0), 1.0, controls=["force"], cost=effort, start={"x": 1.0, "v": 0.0}, end={"v": (-1.0, 1.0)},
        within={"v": (0.0, None)},
    )  # fmt: skip
    plan = solve(problem, intervals=5, tolerance=None)
    assert plan.ok
    assert np.min(plan["v"]) >= -atol


def test_the_search_leaves_a_stationary_motion_that_is_not_a_minimum():
    """Rest is stationary by symmetry. In 4 s (less than 4.73 s, by cos s cosh s = 1) it is the minimum, in 6 s not."""

    def problem(duration):
        return Problem(
            Sled(), duration, controls={"force": (-5.0, 5.0)}, cost=lambda t, now: now["force"] ** 2 - now["x"] ** 2,
            start=REST, end=REST,
        )  # fmt: skip

    short = solve(problem(4.0), intervals=10, tolerance=None)
    assert short.ok
    assert short.cost == 0.0
    long = solve(problem(6.0), intervals=10, tolerance=None)
    assert long.ok
    assert long.cost < -10.0
    assert long.cost == pytest.approx(solve(problem(6.0), {"x": [0.0, 1.0, 0.0]}, intervals=10, tolerance=None).cost)


def test_a_plan_on_a_coarse_mesh_is_not_ok():
    """A free oscillation of 0.99 s in intervals of 0.5 s, without refinement."""
    problem = Problem(Sled(stiffness=40.0), 2.0, controls=[], start={"x": 1.0, "v": 0.0})
    plan = solve(problem, intervals=4, tolerance=None)
    assert not plan.ok
    assert np.max(np.abs(plan["x"] - np.cos(np.sqrt(40.0) * plan.t))) > 0.1
    assert "pass more `intervals` or a `tolerance`" in plan.reason
    assert solve(problem, intervals=32, tolerance=None).ok


class Metered(Sled):
    """The impulse of the force is a state that no rate depends on."""

    states = ("impulse",)

    def state_rates(self, t, q, u, x, motion, now):
        return {"impulse": now["force"]}


def test_states_that_no_rate_depends_on_are_periodic():
    """The impulse has the same value at both ends, so the mean force is zero. Without this link the force would be 1,
    and the cost 0."""
    atol = 1e-8
    problem = Problem(Metered(stiffness=4.0), 1.0, controls=["force"], cost=lambda t, now: (now["force"] - 1.0) ** 2)
    plan = solve(Phases([problem], [None]), intervals=1, method="trapezoid", tolerance=None)
    assert plan.ok
    assert plan.cost == pytest.approx(1.0, abs=atol)
    assert float(plan["impulse"][-1]) == pytest.approx(float(plan["impulse"][0]), abs=atol)


def test_errors_of_the_cost_are_those_of_its_integral():
    """Simpson's rule for the integral of t^4 over an interval of length h exceeds it by h^5 / 120. The sled stays at
    rest, so its states have no errors. The error of each interval is relative to the whole cost."""
    rtol = 1e-6
    problem = Problem(
        Sled(), 1.0, controls=["force"], cost=lambda t, now: t**4 + now["force"] ** 2, start=REST, end=REST
    )
    even = solve(problem, intervals=2, tolerance=None)
    mesh = np.array([0.0, 0.2, 1.0])
    errors = np.diff(mesh) ** 5 / 120
    errors /= 1 / 5 + errors.sum()
    plan = solve(
        problem, dataclasses.replace(even, mesh=mesh), intervals=2, tolerance=1.1 * errors.max(), max_intervals=2
    )
    assert plan.ok, plan.reason
    np.testing.assert_allclose(plan.mesh, mesh)
    np.testing.assert_allclose(plan.errors, errors, rtol=rtol)


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["within", "path"])
def test_least_time_with_a_speed_limit(limit):
    """0.5 s to the speed 0.5, as long to brake, and 0.75 / 0.5 s between. Controls are continuous, so that a switch
    costs an error of the second order in the length of an interval."""
    atol = 2e-5
    limits = {"within": {"within": {"v": (None, 0.5)}}, "path": {"path": lambda t, now: {"slow": 0.5 - now["v"]}}}
    problem = Problem(
        Sled(), (0.1, 10.0), controls={"force": (-1.0, 1.0)}, final_cost=time, **REST_TO_REST, **limits[limit]
    )
    plan = solve(problem, intervals=200, tolerance=None)
    assert plan.ok
    assert plan.duration == pytest.approx(2.5, abs=atol)
    assert ("slow" if limit == "path" else "v at its upper bound") in plan.active


def riccati(duration):
    """x' P x is the least integral of x^2 + v^2 + force^2 of a sled, by the matrix exponential of its Hamiltonian."""
    A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0], [1.0]])
    H = np.block([[A, -B @ B.T], [-np.eye(2), -A.T]])
    F = scipy.linalg.expm(H * duration)
    return -np.linalg.solve(F[2:, 2:], F[2:, :2])


SPRUNG = Sled(drag=0.3, stiffness=4.0)
FIRST = np.array([1.0, 0.5])


def regulated(**arguments):
    def cost(t, now):
        return now["x"] ** 2 + now["v"] ** 2 + now["force"] ** 2

    start = dict(zip(("x", "v"), FIRST, strict=True))
    return solve(Problem(SPRUNG, 2.0, controls=["force"], cost=cost, start=start), **arguments)


@pytest.mark.slow_cases(all_but=["lobatto-6"])
@pytest.mark.parametrize(("method", "order"), [("trapezoid", 2), ("hermite-simpson", 4), ("lobatto", 6)])
def test_order_of_convergence(method, order):
    """The end of a free oscillation against the matrix exponential, and the least cost of a linear-quadratic problem
    against the Riccati equation. The method of order 6 reaches the rounding errors of the solver."""
    within = 0.1  # of the order
    exact = scipy.linalg.expm(2.0 * np.array([[0.0, 1.0], [-4.0, -0.3]])) @ FIRST
    start = dict(zip(("x", "v"), FIRST, strict=True))
    free = [solve(Problem(SPRUNG, 2.0, controls=[], start=start), intervals=n, method=method, tolerance=None)
            for n in (8, 16)]  # fmt: skip
    errors = [np.linalg.norm([*plan.state().q, *plan.state().u] - exact) for plan in free]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=within)
    if order < 6:
        least = FIRST @ riccati(2.0) @ FIRST
        errors = [abs(regulated(intervals=n, method=method, tolerance=None).cost - least) for n in (8, 16)]
        assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)
    else:
        assert regulated(intervals=12, method=method, tolerance=None).cost == pytest.approx(3.1584649082719, rel=1e-8)


@pytest.mark.slow
def test_linear_quadratic_problem_against_riccati():
    """Cost, control and multipliers. The tolerance 1e-6 bounds the error of each interval."""
    rtol = 3e-6
    plan, P = regulated(intervals=10), riccati(2.0)
    assert plan.ok
    assert plan.cost == pytest.approx(FIRST @ P @ FIRST, rel=rtol)
    slopes = [plan.multipliers[name][0] for name in ("x", "v")]
    np.testing.assert_allclose(slopes, 2 * P @ FIRST, rtol=1e-4)
    assert float(plan["force"][0]) == pytest.approx(-(P @ FIRST)[1], rel=5e-3)  # of order 3
    assert np.max(plan.errors) <= 1e-6


@pytest.mark.weekly
def test_multipliers_are_derivatives_of_the_least_cost():
    """By finite differences: of a start, an end, a bound, a condition, a path constraint and the duration's bound."""
    rtol, step = 1e-4, 1e-3
    given = {"x": 0.2, "end": 1.0, "force": 3.3, "mean": 0.3, "fast": 0.8, "duration": 2.0}

    def least(**shifts):
        at = {k: x + shifts.get(k, 0.0) for k, x in given.items()}
        problem = Problem(
            SPRUNG, (0.5, at["duration"]), controls={"force": (None, at["force"])}, cost=effort,
            start={"x": at["x"], "v": 0.0}, end={"x": at["end"]},
            conditions=lambda first, last, duration: {"mean": (last["v"], at["mean"], at["mean"])},
            path=lambda t, now: {"fast": (now["v"], None, at["fast"])},
        )  # fmt: skip
        plan = solve(problem, intervals=20, tolerance=None, options={"tol": 1e-11})
        assert plan.ok
        return plan

    plan = least()
    found = {
        "x": plan.multipliers["x"][0], "end": plan.multipliers["x"][-1], "force": plan.multipliers["force"].sum(),
        "mean": plan.multipliers["mean"], "fast": plan.multipliers["fast"].sum(),
        "duration": plan.multipliers["duration"],
    }  # fmt: skip
    for name, slope in found.items():
        difference = (least(**{name: step}).cost - least(**{name: -step}).cost) / (2 * step)
        assert slope == pytest.approx(difference, rel=rtol, abs=1e-5), name


@pytest.mark.slow
def test_free_parameter():
    """Energy 12 m^2 / m^4 of the scaled force, and the mass itself: m^3 = 24."""
    rtol = 1e-7

    def cost(t, now):
        return (now["force"] / now.system.mass**2) ** 2 + now.system.mass

    problem = Problem(Sled(), 1.0, controls=["force"], cost=cost, free=["mass"], **REST_TO_REST)
    plan = solve(problem, intervals=5)
    assert plan.ok
    assert plan.estimates["mass"] == pytest.approx(24 ** (1 / 3), rel=rtol)
    assert float(plan.system.mass) == plan.estimates["mass"]
    assert "mass" in repr(plan)
    again = solve(problem, plan, intervals=5)
    assert again.iterations <= 3
    assert again.estimates["mass"] == pytest.approx(24 ** (1 / 3), rel=rtol)


class Hypersensitive(jk.System):
    """v_dot = -v^3 + force."""

    states, inputs = ("v",), ("force",)

    def state_rates(self, t, q, u, x, motion, now):
        return now["force"] - x["v"] ** 3


class Integrator(jk.System):
    states, inputs = ("x",), ("u",)

    def state_rates(self, t, q, u, x, motion, now):
        return {"x": now["u"]}


def test_controls_at_a_bound_and_in_between():
    """u is -1 until t = 1, then 0 until t = 3/2, then 1: the integral of x^2 is 1/3 + 1/24 = 3/8. A jump of the control
    takes one interval. With an interval more or less, the cost changes by its third power. The costate is (1 - t)^2, 0
    and -(t - 1.5)^2."""
    problem = Problem(
        Integrator(), 2.0, controls={"u": (-1.0, 1.0)}, cost=lambda t, now: now["x"] ** 2, start={"x": 1.0},
        end={"x": 0.5},
    )  # fmt: skip
    plan = solve(problem, intervals=24, tolerance=None)
    assert plan.ok
    assert plan.cost == pytest.approx(3 / 8, abs=2e-5)
    assert plan.at([0.5, 1.25, 1.75])["u"] == pytest.approx([-1.0, 0.0, 1.0], abs=0.02)
    assert plan.active == ("u at its lower bound", "u at its upper bound")
    t = plan.mesh
    exact = np.maximum(1.0 - t, 0.0) ** 2 - np.maximum(t - 1.5, 0.0) ** 2
    np.testing.assert_allclose(plan.multipliers.costate["x"], exact, atol=2e-3)


@pytest.mark.weekly
def test_hypersensitive_problem():
    """J. T. Betts, Practical Methods for Optimal Control, example 10.7: 6.7241 over 10 000 s, which is at rest but for
    the first and last seconds."""
    problem = Problem(
        Hypersensitive(), 1e4, controls=["force"], cost=lambda t, now: now["v"] ** 2 + now["force"] ** 2,
        start={"v": 1.0}, end={"v": 1.5},
    )  # fmt: skip
    plan = solve(problem, intervals=20)
    assert plan.ok, plan.reason
    assert plan.cost == pytest.approx(6.7241, abs=2e-4)
    assert len(plan.mesh) - 1 <= 120


BICYCLE = jk.catalog.WhippleBicycle.benchmark()


@pytest.mark.weekly
def test_lane_change_of_notebook_9():
    """1.941733 N^2 m^2 s in the notebook, by CasADi's symbolic derivatives and 200 intervals."""
    rolling = jk.assemble(BICYCLE, {}, {"rear_wheel_rate": -6.0 / float(BICYCLE.rR)})
    end = dict.fromkeys(("roll", "steer", "yaw", "roll_rate", "steer_rate"), 0.0) | {"y": 1.5}
    problem = Problem(
        BICYCLE, 3.0, controls=["steer_torque"], cost=lambda t, now: now["steer_torque"] ** 2, start=rolling, end=end
    )
    plan = solve(problem, intervals=200, tolerance=None)
    assert plan.cost == pytest.approx(1.941733, abs=1e-6)
    refined = solve(problem, intervals=50)
    assert refined.ok
    assert refined.cost == pytest.approx(1.9417327, abs=1e-6)
    assert refined.deviation(refined.replay()) < 1e-4


@pytest.mark.weekly
def test_the_gait_of_a_walker():
    """A phase that its own heel strike leads back to its start is the periodic orbit."""
    rtol, walker, start = 1e-8, jk.catalog.CompassGait(), jk.State([-0.22, 0.32, 0.0], [1.1, 0.4])
    orbit = periodic(walker, start, section="heel_strike", period=0.73)
    step = Problem(walker, (0.4, 1.1), controls=[], start={"foot": 0.0})
    guess = jk.simulate(walker, start, jnp.linspace(0.0, 0.7, 50))
    plan = solve(Phases([step], links=["heel_strike"]), [guess], intervals=20, method="lobatto", tolerance=1e-8)
    assert plan.ok, plan.reason
    assert plan.duration == pytest.approx(float(orbit.period), rel=rtol)
    np.testing.assert_allclose(plan.state(0).q, orbit.state.q, atol=1e-7)
    np.testing.assert_allclose(plan.state(0).u, orbit.state.u, atol=1e-6)


@pytest.mark.weekly
@pytest.mark.parametrize("intervals", [7, 50])
@pytest.mark.parametrize("method", ["hermite-simpson", "lobatto"])
def test_a_switch_inside_an_interval_is_refined(method, intervals):
    """2 s, 1e-6. With seven intervals that are not refined, the time is 7e-3 s too long, and 2e-3 s too short."""
    fastest = Problem(Sled(), (0.1, 10.0), controls={"force": (-1.0, 1.0)}, final_cost=time, **REST_TO_REST)
    plan = solve(fastest, intervals=intervals, method=method)
    assert plan.ok
    assert plan.cost == plan.duration == pytest.approx(2.0, abs=1e-6)
    assert plan.active == ("force at its lower bound", "force at its upper bound")
    assert len(plan.mesh) - 1 <= 3 * intervals


@pytest.mark.slow_cases("trapezoid", "lobatto")
@pytest.mark.parametrize(("method", "atol"), [("trapezoid", 1e-2), ("hermite-simpson", 1e-6), ("lobatto", 1e-9)])
def test_costates_satisfy_the_adjoint_equation(method, atol):
    """x' = v, v' = w; integral of x^2 + w^2, and v^2 at the end; p' = -2 x, q' = -p, w = -q / 2, q(2) = 2 v(2)."""
    problem = Problem(
        Sled(), 2.0, controls=["force"], cost=lambda t, now: now["x"] ** 2 + now["force"] ** 2,
        final_cost=lambda t, now: now["v"] ** 2, start={"x": 1.0, "v": 0.0},
    )  # fmt: skip
    plan = solve(problem, intervals=16, tolerance=None, method=method)
    A = np.array([[0, 1, 0, 0], [0, 0, 0, -0.5], [-2, 0, 0, 0], [0, 0, -1, 0]], float)  # of x, v, p, q
    end, S = scipy.linalg.expm(2.0 * A), np.diag([0.0, 2.0])
    rest = np.linalg.solve(end[2:, 2:] - S @ end[:2, 2:], (S @ end[:2, :2] - end[2:, :2]) @ [1.0, 0.0])
    exact = np.array([scipy.linalg.expm(t * A) @ [1.0, 0.0, *rest] for t in plan.mesh])
    for name, column in (("x", exact[:, 2]), ("v", exact[:, 3])):
        np.testing.assert_allclose(plan.multipliers.costate[name], column, atol=atol)


class Motor(Sled):
    """The current pulls the sled. It is an algebraic variable, because its inductance is neglected."""

    inputs = ("voltage", "current")

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(2.0 * inputs["current"] * motion.N.x, motion["sled"])


@pytest.mark.slow_cases("trapezoid", "lobatto")
@pytest.mark.parametrize(("method", "rtol"), [("trapezoid", 1e-2), ("hermite-simpson", 2e-6), ("lobatto", 1e-7)])
def test_an_algebraic_variable_is_a_control_with_an_equation(method, rtol):
    """voltage = 0.5 current + 2 v, so v' = -8 v + 4 voltage. The least energy of the voltage is x' G^-1 x with the
    Gramian G. A constant voltage d in the circuit pushes the sled by -4 d."""
    A, B, end = np.array([[0.0, 1.0], [0.0, -8.0]]), np.array([[0.0], [4.0]]), np.array([1.0, 0.0])
    F = scipy.linalg.expm(np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]))
    lagrange = np.linalg.solve(F[2:, 2:].T @ F[:2, 2:], end)
    problem = Problem(
        Motor(), 1.0, controls=["voltage", "current"], cost=lambda t, now: now["voltage"] ** 2, **REST_TO_REST,
        path=lambda t, now: {"circuit": (now["voltage"] - 0.5 * now["current"] - 2.0 * now["v"], 0.0, 0.0)},
    )  # fmt: skip
    plan = solve(problem, intervals=20, tolerance=None, method=method)
    assert plan.ok
    assert not plan.notes
    assert plan.cost == pytest.approx(end @ lagrange, rel=rtol)
    costates = scipy.linalg.expm(np.block([[A.T, -2.0 * lagrange[:, None]], [np.zeros((1, 3))]]))[:2, 2]  # integrals
    assert plan.multipliers["circuit"].sum() == pytest.approx(-4.0 * costates[1], rel=1e-6)
    assert float(plan["current"][0]) == pytest.approx(2.0 * float(plan["voltage"][0]), rel=1e-6)


class Tide(Sled):
    """A current that depends on the time of the day."""

    launch: jk.Scalar = jk.parameter(1.0)

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["force"] + 2.0 * jnp.sin(t + self.launch)) * motion.N.x, motion["sled"])


@pytest.mark.slow
def test_a_free_start_time_and_duration():
    """The least energy for given times is d' G^-1 d, where d is the end minus that without a force, and G the Gramian
    of the double integrator."""
    rtol = 1e-5

    def least(times):
        launch, T = times
        speed = 2.0 * (np.cos(launch) - np.cos(launch + T))
        place = 2.0 * (T * np.cos(launch) - np.sin(launch + T) + np.sin(launch))
        d, G = np.array([-speed, 1.0 - place]), np.array([[T, T**2 / 2], [T**2 / 2, T**3 / 3]])
        return d @ np.linalg.solve(G, d) + 0.5 * T

    exact = scipy.optimize.minimize(least, [1.0, 2.0], tol=1e-12)
    problem = Problem(
        Tide(), (0.5, 4.0), controls=["force"], cost=lambda t, now: now["force"] ** 2 + 0.5, **REST_TO_REST,
        free=[jk.fit.Free("launch", bounds=(0.0, 7.0))],
    )  # fmt: skip
    plan = solve(problem, intervals=20, tolerance=None)
    assert plan.ok
    assert plan.cost == pytest.approx(exact.fun, rel=rtol)
    assert (plan.estimates["launch"], plan.duration) == pytest.approx((exact.x[0], exact.x[1]), rel=rtol)
