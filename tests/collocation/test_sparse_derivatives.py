"""First and second derivatives of whole nonlinear programs, and their sparsity, against JAX."""

import jax.numpy as jnp
import pytest
from mechanisms import Sled, SliderCrank

import jaxkane as jk
from jaxkane.catalog import CATALOG
from jaxkane.collocation import Phases, Problem, check_derivatives

WITHOUT_CONTACTS = [name for name in CATALOG if getattr(jk.catalog, name).contacts is jk.System.contacts]


@pytest.mark.weekly
@pytest.mark.parametrize("name", WITHOUT_CONTACTS)
def test_derivatives_of_the_catalogue(name):
    rtol = 1e-10
    entry = CATALOG[name]
    system = entry.example()
    guess = dict(zip((*system.coordinates, *system.speeds), (*entry.q, *entry.u), strict=True))
    problem = Problem(
        system, (0.5, 2.0), controls=system.inputs, final_cost=lambda t, now: t * now[system.coordinates[0]] ** 3
    )
    found = check_derivatives(problem, guess, intervals=1, method="trapezoid")
    assert max(found.values()) < rtol, found


@pytest.mark.weekly
def test_derivatives_of_all_kinds_of_functions():
    """Cost, final cost, conditions and path constraints, with a free duration."""
    rtol, system = 1e-10, CATALOG["DoublePendulum"].example()
    first, last = system.coordinates[0], system.speeds[-1]

    def cost(t, now):
        return sum(now[name] ** 2 for name in (*system.coordinates, *system.inputs)) * jnp.cos(t)

    problem = Problem(
        system, (0.5, 2.0), controls=system.inputs, cost=cost, final_cost=lambda t, now: t * now[first],
        conditions=lambda a, b, duration: {"back": b[last] * a[first] - duration},
        path=lambda t, now: {"far": (jnp.sin(now[first]) * now[last], -1e3, 1e3)},
    )  # fmt: skip
    found = check_derivatives(problem, {first: 0.3, last: 0.5})
    assert max(found.values()) < rtol, found


@pytest.mark.weekly
def test_derivatives_with_a_free_parameter_and_phases():
    rtol = 1e-10
    one = Problem(
        Sled(drag=0.2), (0.5, 2.0), controls=["force"], cost=lambda t, now: now["force"] ** 2 / now.system.mass,
        start={"x": 0.0}, free=["mass", "drag"],
    )  # fmt: skip
    other = Problem(Sled(stiffness=0.5), 1.0, controls=["force"], end={"x": 1.0}, free=["mass", "drag"])
    links = [None, lambda last, first: {"v": first["v"] + last["v"] ** 2}]
    found = check_derivatives(Phases([one, other], links), intervals=2, method="lobatto")
    assert max(found.values()) < rtol, found


class Stops(Sled):
    """Springs that act outside of -0.1 m to 0.2 m."""

    def loads(self, t, q, u, motion, inputs):
        push = jnp.maximum(0.0, q["x"] - 0.2) ** 2 + jnp.where(q["x"] < -0.1, u["v"] * q["x"], 0.0)
        return jk.Force((inputs["force"] - push) * motion.N.x, motion["sled"])


def test_derivatives_with_branches():
    rtol = 1e-10
    problem = Problem(
        Stops(), (0.5, 2.0), controls=["force"], cost=lambda t, now: jnp.abs(now["force"]) ** 3 / (1 + t),
        final_cost=lambda t, now: t * now["x"],
    )  # fmt: skip
    found = check_derivatives(problem, {"x": [-0.3, 0.4], "v": 0.5}, intervals=4, method="trapezoid")
    assert max(found.values()) < rtol, found


@pytest.mark.weekly
def test_derivatives_with_dependent_coordinates_and_speeds():
    rtol = 1e-9

    class Driven(SliderCrank):
        inputs = ("torque",)

        def loads(self, t, q, u, motion, inputs):
            return jk.Torque(inputs["torque"] * motion.N.z, motion["crank"])

    problem = Problem(
        Driven(), 1.0, controls=["torque"], cost=lambda t, now: now["x_dot"] ** 2, end={"x_dot": 0.0},
        within={"rod_rate": (-9.0, 9.0)},
    )  # fmt: skip
    found = check_derivatives(problem, {"crank": 0.3, "crank_rate": 1.0})
    assert max(found.values()) < rtol, found
