"""Wrong arguments and problems without solutions: one clear error each, or a status and the last iterate."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import BouncingBall, RodOnPin, Sled, SliderCrank

import jaxkane as jk
from jaxkane.collocation import Phases, Problem, solve

pytest.importorskip("casadi")

GIVEN = {
    "controls": ["force"], "cost": lambda t, now: now["force"] ** 2, "start": {"x": 0.0, "v": 0.0},
    "end": {"x": 1.0, "v": 0.0},
}  # fmt: skip


def problem(duration=1.0, system=None, **changes):
    return Problem(Sled() if system is None else system, duration, **(GIVEN | changes))


def solved(guess=None, duration=1.0, system=None, options=None, **changes):
    return solve(problem(duration, system, **changes), guess, intervals=4, options=options)


NAN = float("nan")
WRONG = {
    "control twice": ({"controls": ["force", "force"]}, "a name twice"),
    "no controls": ({"controls": None}, "`controls` must be a name or"),
    "one bound of a control": ({"controls": {"force": 5.0}}, "must be (lower, upper)"),
    "exchanged bounds": ({"controls": {"force": (1, -1)}}, "lower bound is greater"),
    "unknown within": ({"within": {"y": (0, 1)}}, "`within`: Sled has no y"),
    "start state NaN": ({"start": jk.State([NAN], [0.0])}, "finite numbers for x, v"),
    "start of another system": ({"start": jk.State([0.0, 1.0], [0.0])}, "numbers for x, v"),
    "start as a batch": ({"start": jk.State(np.zeros((3, 1)), np.zeros((3, 1)))}, "numbers for x, v"),
    "start outside": ({"within": {"x": (0.5, 2.0)}}, "`start` of 'x' is 0.0, but its bounds along the motion"),
    "one bound within": ({"within": {"x": 0.5}}, "must be (lower, upper)"),
    "within and controls": ({"controls": {"force": (0, 1)}, "within": {"force": (2, 3)}}, "exclude each other"),
    "duration 0": ({"duration": 0}, "must be a positive number"),
    "duration from None": ({"duration": (None, 3.0)}, "must be a positive number"),
    "three durations": ({"duration": (1, 2, 3)}, "`duration` must be a real number, got (1, 2, 3)"),
    "control as input": ({"inputs": {"force": 1.0}}, "in `controls` and in `inputs`"),
    "input as array": ({"controls": [], "inputs": {"force": np.zeros(2)}}, "Pass jaxkane.Samples"),
    "zero-order hold": (
        {"controls": [], "inputs": {"force": jk.Samples([0.0, 1.0], [0.0, 1.0], zero_order_hold=True)}},
        "needs continuous inputs, without a zero-order hold",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_of_a_problem(name):
    changes, message = WRONG[name]
    with pytest.raises((ValueError, TypeError)) as error:
        problem(**changes)
    assert message in str(error.value)


def test_a_start_as_a_state_by_name_equals_one_with_arrays():
    by_name, arrays = jk.State({}, {"v": 0.5}), jk.State([0.0], [0.5])
    assert problem(start=by_name).ends == problem(start=arrays).ends
    with pytest.raises(ValueError, match="Sled: q has no v; it has x"):
        problem(start=jk.State({"v": 0.5}, {}))


class Counted(Sled):
    count: int = eqx.field(static=True, default=2)


def test_systems_that_collocation_does_not_accept():
    for system, message in (
        (BouncingBall(), "has contacts"),
        (Sled(mass=jnp.ones(3)), "is a batch"),
        (Sled(mass=jnp.ones((), jnp.float32)), "needs float64"),
        (Sled, "must be an instance of a System"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            Problem(system, 1.0, controls=[])
    with pytest.raises(TypeError, match="is traced"):
        jax.jit(lambda mass: problem(system=Sled(mass=mass)).duration)(2.0)
    with pytest.raises(ValueError, match="no parameter 'count'"):
        problem(system=Counted(), free=["count"])


FUNCTIONS = {
    "cost NaN": ({"cost": lambda t, now: jnp.sqrt(now["x"] - 5.0)}, "`cost` is not finite at the initial guess"),
    "cost vector": ({"cost": lambda t, now: now.state.q}, "must return one real number"),
    "truth value": ({"cost": lambda t, now: now["x"] > 0}, "For a truth value, return a smooth"),
    "complex cost": ({"cost": lambda t, now: now["x"].astype(complex)}, "must return one real number"),
    "unknown name": ({"cost": lambda t, now: now["y"]}, "There is no 'y' in `now`"),
    "a branch": ({"cost": lambda t, now: now["x"] if now["x"] > 0 else 0.0}, "jnp.where"),
    "final cost NaN": ({"final_cost": lambda t, now: jnp.log(now["x"] - 5.0)}, "is not finite"),
    "condition as truth value": ({"conditions": lambda a, b, d: {"c": b["x"] > 0}}, "`c` must return one real"),
    "rounded condition": ({"conditions": lambda a, b, d: {"c": jnp.floor(b["x"])}}, "the derivative of 'c' is zero"),
    "conditions in a list": ({"conditions": lambda a, b, d: [b["x"]]}, "must return a dict"),
    "exchanged bounds": ({"conditions": lambda a, b, d: {"c": (b["x"], 2, 1)}}, "(number, lower, upper), is (2, 1)"),
    "two bounds": ({"conditions": lambda a, b, d: {"c": (b["x"], 2)}}, "(number, lower, upper)"),
    "control in all inputs": (
        {"inputs": lambda t, state: {"force": 0.0}}, "is in `controls`, and the function `inputs` returns it"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_that_cannot_be_used(name):
    changes, message = FUNCTIONS[name]
    with pytest.raises((ValueError, TypeError, KeyError)) as error:
        solved(**changes)
    assert message in str(error.value)


def test_wrong_guesses():
    for guess, message in (
        ({"y": 0.5}, "no y; it has x, v, force, duration"),
        ({"x": "0"}, "must be a number, an array"),
        ({"x": lambda t: np.zeros(2)}, "must be a real number"),
        ({"force": NAN}, "'force' must be finite"),
        ({"duration": 0.0}, "'duration' must be a positive number"),
        (3.0, "must be None, a Plan, a Trajectory"),
        ([], "an empty sequence"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            solved(guess, within={"x": (-2.0, 2.0)})


def test_wrong_arguments_of_solve():
    for arguments, message in (
        ({"intervals": 0}, "from 1 to 2000"), ({"intervals": 2.0}, "an integer"), ({"intervals": True}, "an integer"),
        ({"max_intervals": "a"}, "an integer"), ({"max_iterations": -1}, "an integer of at least 0"),
        ({"starts": 0}, "of at least 1"), ({"seed": "a"}, "an integer"), ({"method": "euler"}, "must be one of"),
        ({"tolerance": 0.0}, "must be positive"), ({"tolerance": "a"}, "real number"),
        ({"max_seconds": -1.0}, "must be positive"),
        ({"options": 3}, "must be a dict"),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=message):
            solve(problem(), **arguments)
    with pytest.raises(TypeError, match="must be a Problem or Phases"):
        solve(Sled())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="nonsense"):
        solved(options={"nonsense": 3})


def test_wrong_phases():
    one = problem()
    for arguments, message in (
        (([],), "sequence of Problem"), ((one,), "pass sequences"), (([one, Sled()],), "sequence of Problem"),
        (([one, one], []), "2 phases need 1 links, or 2"), (([one, one], [3]), "link 0 must be"),
        (([one], ["strike"]), "has no jump strike"), (([one], "strike"), "pass sequences"),
        (([one, Problem(RodOnPin(length=1.0), 1.0, controls=[])], [None]), "link 0: the states have other names"),
        (([problem(free=["mass"]), one], [None]), "the same `free`"),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=message):
            Phases(*arguments)
    for link, message in (
        (lambda last, first: {}, "returns no residuals"),
        (lambda last, first: [last["x"]], "must return a dict"),
        (lambda last, first: {"x": last["x"] > first["x"]}, "truth value"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            solve(Phases([problem(end=None), problem(start=None)], [link]), intervals=2)
    with pytest.raises(ValueError, match="3 guesses for 2 phases"):
        solve(Phases([problem(end=None), problem(start=None)], [None]), [None] * 3, intervals=2)


class Puck(jk.System):
    """A point in a plane with two forces."""

    coordinates, speeds, inputs = ("x", "y"), ("vx", "vy"), ("fx", "fy")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        point = O.moving(q["x"] * N.x + q["y"] * N.y, u["vx"] * N.x + u["vy"] * N.y)
        return jk.Motion([jk.Body(1.0, 0.0, point, N, name="puck")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["fx"] * motion.N.x + inputs["fy"] * motion.N.y, motion["puck"])


def test_a_path_that_fixed_ends_imply_is_dropped_there():
    """It took 327 iterations with singular Jacobians, and has 4. The fixed ends must satisfy it."""
    still = {"vx": 0.0, "vy": 0.0}
    arc = Problem(
        Puck(), 1.0, controls=["fx", "fy"], cost=lambda t, now: now["fx"] ** 2 + now["fy"] ** 2,
        start={"x": 1.0, "y": 0.0, **still}, end={"x": 0.0, "y": 1.0, **still},
        path=lambda t, now: {"circle": (now["x"] ** 2 + now["y"] ** 2, 1.0, 1.0)},
    )  # fmt: skip
    plan = solve(arc, intervals=10, tolerance=None, method="lobatto")
    assert plan.ok
    assert plan.iterations < 10
    assert plan.cost == pytest.approx(41.3707, abs=1e-2)
    assert plan.notes == ("dropped, because others imply it: circle at the start, circle at the end",)
    np.testing.assert_allclose(np.hypot(plan["x"], plan["y"]), 1.0, atol=1e-9)
    with pytest.raises(ValueError, match=r"fixed values make 'circle at the start' 1\.21, but it must be 1\."):
        solve(dataclasses.replace(arc, start={"x": 1.1, "y": 0.0, **still}), intervals=10)
    # The end is not fixed, but a condition implies the path there.
    far = dataclasses.replace(arc, end=still, conditions=lambda a, b, d: {"r": jnp.hypot(b["x"], b["y"]) - 1.0})
    plan = solve(far, intervals=10, tolerance=None, max_iterations=1)
    assert plan.notes == ("dropped, because others imply it: circle at the start, circle at the end",)


def test_a_path_equality_of_coordinates_alone_needs_another_method():
    """The puck of above, and its cost on a fine mesh. With its position prescribed, "hermite-simpson" finds 42.67."""
    still = {"vx": 0.0, "vy": 0.0}

    def arc(path):
        return Problem(
            Puck(), 1.0, controls=["fx", "fy"], cost=lambda t, now: now["fx"] ** 2 + now["fy"] ** 2,
            start={"x": 1.0, "y": 0.0, **still}, end={"x": 0.0, "y": 1.0, **still}, path=path,
        )  # fmt: skip

    plan = solve(arc(lambda t, now: {"circle": (now["x"] ** 2 + now["y"] ** 2, 1.0, 1.0)}), intervals=10)
    assert not plan.ok
    assert len(plan.costs) == 1
    assert "circle" in plan.reason
    assert "method='lobatto'" in plan.reason
    rate = arc(lambda t, now: {"circle": (now["x"] * now["vx"] + now["y"] * now["vy"], 0.0, 0.0)})
    plan = solve(rate, intervals=10, tolerance=None)
    assert plan.ok
    assert plan.cost == pytest.approx(41.3707, abs=1e-2)


class Metered(Sled):
    inputs = ("force", "size")


def test_the_integral_of_an_absolute_value():
    """Push for s, coast, brake for s, where s (3 - s) = 1. The function abs has no derivative while the sled coasts."""
    found = solved(duration=3.0, controls={"force": (-1.0, 1.0)}, cost=lambda t, now: jnp.abs(now["force"]))
    assert not found.ok
    assert "`cost` contains abs" in found.notes[0]
    plan = solve(
        problem(
            3.0, Metered(), controls={"force": (-1.0, 1.0), "size": (0.0, 1.0)}, cost=lambda t, now: now["size"],
            path=lambda t, now: {"above": now["size"] - now["force"], "below": now["size"] + now["force"]},
        ), intervals=30, tolerance=None,
    )  # fmt: skip
    assert plan.ok
    assert plan.cost == pytest.approx(3.0 - 5.0**0.5, abs=1e-3)


BICYCLE = jk.catalog.WhippleBicycle.benchmark()


def test_redundant_boundary_conditions_are_rejected():
    """A pitch that does not belong to roll and steer was once reached by the discretization error."""
    rod = RodOnPin(length=1.0)
    for system, end, message in (
        (rod, {"y": 0.5, "x": 0.8}, "Leave out x"),
        (rod, {"v": 0.0, "x_dot": 0.0}, "only 1 speeds are independent. Leave out x_dot"),
        (SliderCrank(), {"crank": 1.0, "x": 0.3}, "Leave out x"),
        (BICYCLE, {"roll": 0.0, "steer": 0.0, "pitch": 0.1}, "Leave out pitch"),
    ):
        with pytest.raises(ValueError, match=message):
            Problem(system, 1.0, controls=[], end=end)
    Problem(BICYCLE, 1.0, controls=[], end={"roll": 0.0, "pitch": 0.0})
    with pytest.raises(ValueError, match="violate the configuration constraints"):
        Problem(rod, 1.0, controls=[], start={"y": 0.0, "x": 0.9})


LIMITED = {"controls": {"force": (-1.0, 1.0)}}
INFEASIBLE = {  # what is infeasible, and what the report must name
    "short": (lambda: problem(**LIMITED), {"x at the end", "force at its upper bound (0 to 0.475 s)"}),
    "far": (
        lambda: problem(2.5, end=None, within={"x": (-2.0, 2.0)}, conditions=lambda a, b, d: {"far": b["x"] - 5.0}),
        {"far", "x at its upper bound (2.5 s)"},
    ),
    "speed": (lambda: problem(within={"v": (-1.0, 0.9)}), {"v at its upper bound (0.025 to 0.975 s)", "x at the end"}),
    "duration": (lambda: problem((0.5, 1.5), **LIMITED), {"duration at its upper bound"}),
    "slow": (lambda: problem(2.5, path=lambda t, now: {"slow": 0.3 - now["v"]}), {"slow ("}),
    "both": (
        lambda: problem(end=None, conditions=lambda a, b, d: {"one": b["x"] - 1.0, "two": b["x"] - 2.0}), {"one", "two"}
    ),
    "stop": (
        lambda: problem(2.5, start={"x": 0.0, "v": 3.0}, within={"x": (-0.1, 1.2)}, **LIMITED),
        {"v at the start", "x at its upper bound (1.44 s)", "force at its lower bound (0 to 1.44 s)"},
    ),
    "control": (
        lambda: Problem(Puck(), 1.0, controls=["fx"], start={"y": 0.0, "vy": 0.0}, end={"y": 1.0}), {"y at the end"}
    ),
    "phases": (
        lambda: Phases([problem(end={"x": 0.5}, **LIMITED), problem(0.8, start=None, **LIMITED)], [None]),
        {"link 0: x", "phase 1: x at the end"},
    ),
    "ball": (
        lambda: Problem(
            Puck(), 2.0, controls={"fx": (-9.0, 9.0), "fy": (-0.1, 0.1)}, cost=lambda t, now: now["fx"] ** 2,
            start={"x": 0.0, "y": 0.1, "vx": 0.0, "vy": 0.0}, end={"x": 2.0, "y": 0.1},
            path=lambda t, now: {"ball": (now["x"] - 1.0) ** 2 + now["y"] ** 2 - 0.64},
        ),
        {"ball (0.9 to 1 s)"},
    ),
}  # fmt: skip


@pytest.mark.slow_cases(all_but=["short", "far"])
@pytest.mark.parametrize("name", INFEASIBLE)
def test_the_cause_of_an_infeasible_problem(name):
    make, causes = INFEASIBLE[name]
    plan = solve(make(), intervals=20)
    assert not plan.ok
    assert all(any(text.startswith(cause) for text in plan.conflict) for cause in causes), plan.conflict
    assert plan.conflict[0] in plan.report()


@pytest.mark.slow
def test_an_infeasible_problem_reports_its_violated_constraints():
    plan = solved(controls={"force": (-1.0, 1.0)})
    assert not plan.ok
    assert "contradict" in plan.reason
    assert [name for name in plan.unmet if "equations of motion of x" in name]
    assert np.all(np.isfinite(plan["x"]))
    with pytest.raises(ValueError, match="fixed values make 'far' -4, but it must be 0"):
        solved(conditions=lambda first, last, duration: {"far": last["x"] - 5.0})


def test_a_derivative_that_is_not_finite_is_reported():
    plan = solved(cost=lambda t, now: jnp.sqrt(now["force"] ** 2))
    assert not plan.ok
    assert plan.reason == "the derivative of `cost` is not finite at the last iterate"


@pytest.mark.slow
def test_a_function_that_is_not_finite_on_a_finer_mesh_keeps_the_solution():
    """The speed at a new node is above the limit by the error of the interpolation."""
    plan = solved(path=lambda t, now: {"slow": jnp.sqrt(1.3 - now["v"]) - 0.01})
    assert plan.reason.startswith("solved, but not on a finer mesh: Problem: `path` is not finite") or plan.ok
    assert plan.violation < 1e-6
    assert plan.cost == pytest.approx(13.065, abs=0.2)


@pytest.mark.slow
def test_a_cost_without_a_lower_bound():
    plan = solved(cost=lambda t, now: -(now["force"] ** 2))
    assert not plan.ok
    assert "no lower bound; x, v, force without a sufficient bound" in plan.reason
    assert plan.cost < -1e6
