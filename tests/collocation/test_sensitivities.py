"""Derivatives of optimal motions by parameters: closed forms, differences of solutions, and `jax.jacfwd` of `solve`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import RodOnPin, Sled

import jaxkane as jk
from jaxkane.collocation import Phases, Problem, solve

pytest.importorskip("casadi")

REST_TO_REST = {"start": {"x": 0.0, "v": 0.0}, "end": {"x": 1.0, "v": 0.0}}
OPTIONS = {"tolerance": None, "options": {"tol": 1e-12, "bound_relax_factor": 0.0}}


def effort(t, now):
    return now["force"] ** 2


def time(t, now):
    return t


def least_energy(mass, controls=("force",), **arguments):
    return Problem(Sled(mass=mass), 1.0, controls=controls, **({"cost": effort} | REST_TO_REST | arguments))


def test_energy_and_force_by_the_mass():
    """The force is mass * (6 - 12 t), and the energy 12 mass^2."""
    atol = 1e-8
    plan = solve(least_energy(1.5), intervals=5, tolerance=None)
    found = plan.sensitivities(["mass", "drag"])["mass"]
    assert (found.reason, found.duration) == ("", 0.0)
    assert found.cost == pytest.approx(36.0, abs=atol)
    np.testing.assert_allclose(found["force"], 6 - 12 * np.asarray(plan.t), atol=atol)
    np.testing.assert_allclose(found["x"], 0.0, atol=atol)

    def optimum(mass):
        plan = solve(least_energy(mass), intervals=5, tolerance=None)
        return plan.cost, plan["force"]

    cost, force = jax.jacfwd(optimum)(1.5)
    assert float(cost) == pytest.approx(found.cost, abs=1e-12)
    np.testing.assert_allclose(force, found["force"], atol=1e-12)
    assert float(jax.grad(lambda mass: optimum(mass)[0])(1.5)) == pytest.approx(found.cost, abs=1e-12)
    with pytest.raises(TypeError, match="second derivatives are not supported"):
        jax.hessian(lambda mass: optimum(mass)[0])(1.5)


def test_derivatives_that_do_not_exist():
    """The force of least energy is 6 at the start, which is also its bound."""
    weak = solve(least_energy(1.0, {"force": (-6.0, 6.0)}), intervals=5, tolerance=None).sensitivities("mass")["mass"]
    assert "'force' at 0 of the duration is at a bound with a multiplier of zero" in weak.reason
    assert weak.cost == pytest.approx(24.0, abs=1e-3)
    assert np.isnan(weak["force"]).all()
    nothing = Problem(Sled(), 1.0, controls=["force"], **REST_TO_REST)
    found = solve(nothing, intervals=5, tolerance=None).sensitivities("mass")["mass"]
    assert "KKT matrix is singular: nothing determines" in found.reason


def test_numbers_that_must_not_be_traced():
    def cost(mass):
        return solve(least_energy(1.0, cost=lambda t, now: mass * now["force"] ** 2)).cost

    for f, message in (
        (cost, r"`cost` uses a traced number.*`plan.sensitivities`"),
        (lambda x: least_energy(1.0, end={"x": x}).duration, "`end` uses a traced number"),
        (lambda mass: Phases([least_energy(mass)]).links, "Use `plan.sensitivities`"),
    ):
        with pytest.raises(TypeError, match=message):
            jax.jacfwd(f)(1.0)


def test_plans_and_parameters_that_are_refused():
    plan = solve(least_energy(1.0), intervals=5, tolerance=None)
    with pytest.raises(ValueError, match="no parameter 'weight'"):
        plan.sensitivities("weight")
    with pytest.raises(ValueError, match="the plan is not `ok`"):
        dataclasses.replace(plan, ok=False).sensitivities("mass")


@pytest.mark.slow
def test_fixed_values_that_a_parameter_contradicts():
    """The start fixes x and y, which are on a circle whose radius is the parameter."""
    rod = RodOnPin(length=1.0)
    fixed = {"y": 0.0, "x": 1.0, "v": 0.0}
    problem = Problem(rod, 0.5, controls=["push"], cost=lambda t, now: now["push"] ** 2, start=fixed, end={"y": 0.1})
    found = solve(problem, intervals=10, tolerance=None).sensitivities(["length"])["length"]
    assert "for these parameters only" in found.reason
    assert np.isnan(found.cost)
    problem = dataclasses.replace(problem, start={"y": 0.0, "v": 0.0})
    assert solve(problem, {"x": 1.0}, intervals=10, tolerance=None).sensitivities(["length"])["length"].reason == ""


def phases(system):
    first = Problem(system, 1.0, controls=["force"], cost=effort, start=REST_TO_REST["start"])
    last = Problem(
        system, (0.5, 1.5), controls=["force"], cost=effort, final_cost=lambda t, now: 5.0 * t, end=REST_TO_REST["end"]
    )
    return Phases([first, last], [None])


def sled(duration=2.0, controls=("force",), cost=effort, **arguments):
    return lambda system: Problem(system, duration, controls=controls, cost=cost, **(REST_TO_REST | arguments))


PROBLEMS = {
    "fixed": (sled(), ["mass", "drag", "stiffness"]),
    "bounds": (sled(controls={"force": (-1.9, 1.9)}, within={"v": (None, 0.68)}), ["mass", "drag"]),
    "duration": (
        sled((0.5, 5.0), {"force": (-1.0, 1.0)}, lambda t, now: 1e-2 * now["force"] ** 2, final_cost=time,
             path=lambda t, now: {"slow": 0.8 - now["v"]}), ["mass", "drag"],
    ),
    "free": (
        sled(cost=lambda t, now: now["force"] ** 2 + (now.system.drag - 1.0) ** 2,
             free=[jk.fit.Free("drag", bounds=(0.0, 2.0))]), ["mass", "stiffness"],
    ),
    "phases": (phases, ["mass", "drag"]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_differences_of_solutions(name):
    make, names = PROBLEMS[name]
    system, rtol = Sled(mass=1.1, drag=0.4, stiffness=0.2), 1e-5
    plan = solve(make(system), intervals=12, **OPTIONS)
    assert plan.ok, plan.reason
    assert bool(plan.active) == (name in ("bounds", "duration"))
    sensitivities = plan.sensitivities(names)

    def at(parameter, step):
        moved = dataclasses.replace(system, **{parameter: getattr(system, parameter) + step})
        return solve(make(moved), list(plan.phases) or plan, intervals=12, **OPTIONS)

    for parameter in names:
        found, pair = sensitivities[parameter], [at(parameter, step) for step in (1e-4, -1e-4)]
        assert found.reason == ""

        def compared(own, read, pair=pair):
            difference = (np.asarray(read(pair[0])) - np.asarray(read(pair[1]))) / 2e-4
            np.testing.assert_allclose(own, difference, atol=rtol * max(np.max(np.abs(difference)), 1e-3))

        compared(found.cost, lambda plan: plan.cost)
        compared(found.duration, lambda plan: plan.duration)
        for each, value in found.estimates.items():
            compared(value, lambda plan, each=each: plan.estimates[each])
        for each in ("x", "v", "force") if not plan.phases else ():
            compared(found[each], lambda plan, each=each: plan[each])
        if plan.phases:
            compared(found["phase 1: force"], lambda plan: plan.phases[1]["force"])


@pytest.mark.slow
def test_tangents_of_duration_and_estimates():
    make, _ = PROBLEMS["free"]

    def optimum(mass):
        plan = solve(make(Sled(mass=mass)), intervals=12, tolerance=None)
        return plan.estimates["drag"], plan.system.drag, plan["v"]

    found = solve(make(Sled(mass=1.1)), intervals=12, tolerance=None).sensitivities("mass")["mass"]
    drag, same, v = jax.jacfwd(optimum)(jnp.asarray(1.1))
    assert float(drag) == pytest.approx(found.estimates["drag"], abs=1e-10)
    assert float(same) == pytest.approx(float(drag), abs=1e-12)
    np.testing.assert_allclose(v, found["v"], atol=1e-12)
