"""Problems of opty's gallery, solved by the default options.

The references are formulas, or costs from the gallery.
"""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import jaxkane as jk
from jaxkane.collocation import Problem, solve

pytest.importorskip("casadi")
pytestmark = pytest.mark.slow


def time(t, now):
    return t


def height(x):
    return 1.5 * x**2 * jnp.exp(2.5 - x)


def slope(x):
    return 1.5 * (2.0 * x - x**2) * jnp.exp(2.5 - x)


class Block(jk.System):
    """A block of 1 kg on a hill, with a tangential force."""

    coordinates, speeds, inputs = ("x",), ("v",), ("force",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        x = q["x"]
        block = O.moving(x * N.x + height(x) * N.y, u["v"] * (N.x + slope(x) * N.y))
        return jk.Motion([jk.Body(1.0, 0.0, block, N, name="block")])

    def loads(self, t, q, u, motion, inputs):
        N, s = motion.N, slope(q["x"])
        tangent = (N.x + s * N.y) / jnp.sqrt(1.0 + s**2)
        return jk.weight(motion, -9.81 * N.y), jk.Force(inputs["force"] * tangent, motion["block"])


def over_the_hill(duration, **arguments):
    return Problem(
        Block(), duration, controls={"force": (-10.0, 15.0)}, start={"x": 0.0, "v": 0.0}, end={"x": 10.0, "v": 0.0},
        within={"x": (0.0, 10.0), "v": (0.0, 100.0)}, **arguments,
    )  # fmt: skip


def shortest_time_over_the_hill():
    """The force is 15 N up to a distance where the work of -10 N stops the block at the end: energy gives the speed."""
    x = 10.0 * np.sin(np.linspace(0.0, 0.5 * np.pi, 200001)) ** 2  # dense at both ends, where the speed is zero
    s = scipy.integrate.cumulative_trapezoid(np.sqrt(1.0 + np.asarray(slope(x)) ** 2), x, initial=0.0)
    up = 9.81 * np.asarray(height(x))
    first, last = 15.0 * s - up, 10.0 * (s[-1] - s) + up[-1] - up  # half of the squared speed
    v = np.sqrt(2.0 * np.maximum(np.minimum(first, last), 0.0))
    return float(np.sum(2.0 * np.diff(s) / (v[1:] + v[:-1])))


def test_a_block_slides_over_a_hill_in_the_shortest_time():
    """opty's solution with 150 nodes is 3.98925 s."""
    plan = solve(over_the_hill((0.01, 20.0), final_cost=time))
    assert plan.ok
    assert plan.duration == pytest.approx(shortest_time_over_the_hill(), rel=1e-4)


def test_a_block_slides_over_a_hill_with_the_least_effort():
    plan = solve(over_the_hill(6.0, cost=lambda t, now: now["force"] ** 2))
    assert plan.ok
    assert plan.cost == pytest.approx(434.160, abs=1e-3)


class Crane(jk.System):
    """A load of 10 kg on a rod of 5 m below a trolley of 1 kg."""

    coordinates, speeds, inputs, units = ("x", "sway"), ("v", "sway_rate"), ("force",), {"sway": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        hook, A = O.moving(q["x"] * N.x, u["v"] * N.x), N.rotate(3, q["sway"], u["sway_rate"])
        load = hook.fixed(-5.0 * A.y)
        return jk.Motion([jk.Body(1.0, 0.0, hook, N, name="trolley"), jk.Body(10.0, 0.0, load, N, name="load")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["force"] * motion.N.x, motion["trolley"])


def test_a_crane_moves_a_load_in_the_shortest_time():
    """opty's solution with 150 nodes is 5.79574 s; a rigid load would take 2 (15 11 / 20)^0.5 = 5.745 s."""
    rest = {"sway": 0.0, "v": 0.0, "sway_rate": 0.0}
    problem = Problem(
        Crane(), (0.5, 20.0), controls={"force": (-20.0, 20.0)}, final_cost=time, start={"x": 0.0, **rest},
        end={"x": 15.0, **rest, "force": 0.0}, within={"x": (0.0, 15.0)},
        path=lambda t, now: {"load": (now["x"] + 5.0 * jnp.sin(now["sway"]), 0.0, 15.0)},
    )  # fmt: skip
    plan = solve(problem)
    assert plan.ok
    assert 2.0 * math.sqrt(15.0 * 11.0 / 20.0) < plan.duration < 5.79574
    assert plan.duration == pytest.approx(5.79345, abs=1e-4)
    assert plan.deviation(plan.replay()) < 1e-3


class Light(jk.System):
    """Light in media whose speed is 1 for 3 < x < 7, and 5 beside. A mass that does not matter stands beside it."""

    coordinates, speeds, states, inputs = ("place",), ("speed",), ("x", "y"), ("angle",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["place"] * N.x, u["speed"] * N.x), N, name="mass")])

    def state_rates(self, t, q, u, x, motion, now):
        c = speed_of_light(x["x"])
        return {"x": c * jnp.cos(now["angle"]), "y": c * jnp.sin(now["angle"])}


def speed_of_light(x):
    return 5.0 - 2.0 * (jnp.tanh(20.0 * (x - 3.0)) - jnp.tanh(20.0 * (x - 7.0)))


def test_light_is_refracted_by_the_law_of_snell():
    """sin(angle) / speed is a constant along the path; the end determines it."""
    x = np.linspace(0.0, 10.0, 20001)
    c = np.asarray(speed_of_light(x))

    def way(p):
        return scipy.integrate.trapezoid(p * c / np.sqrt(1.0 - (p * c) ** 2), x)

    p = scipy.optimize.brentq(lambda p: way(p) - 10.0, 0.01, 0.1999999)
    least = scipy.integrate.trapezoid(1.0 / (c * np.sqrt(1.0 - (p * c) ** 2)), x)
    problem = Problem(
        Light(), (1.0, 50.0), controls={"angle": (-1.5, 1.5)}, final_cost=time,
        start={"place": 0.0, "speed": 0.0, "x": 0.0, "y": 0.0}, end={"x": 10.0, "y": 10.0},
    )  # fmt: skip
    plan = solve(problem)
    assert plan.ok
    assert plan.duration == pytest.approx(least, rel=1e-5)


class TwoLinks(jk.System):
    """Two rods on a cart, with absolute angles from the horizontal."""

    coordinates, speeds, inputs = ("x", "one", "two"), ("v", "one_rate", "two_rate"), ("force",)
    units = {"one": "rad", "two": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        cart = O.moving(q["x"] * N.x, u["v"] * N.x)
        A, B = N.rotate(3, q["one"], u["one_rate"]), N.rotate(3, q["two"], u["two_rate"])
        elbow = cart.fixed(2.0 * A.x)
        I = (0.0, 0.0, 2.0)
        bodies = [jk.Body(1.0, 0.0, cart, N, name="cart"), jk.Body(1.0, I, elbow, A, name="one")]
        return jk.Motion([*bodies, jk.Body(1.0, I, elbow.fixed(2.0 * B.x), B, name="two")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["force"] * motion.N.x, motion["cart"])


def test_two_links_on_a_cart_are_raised_in_the_shortest_time():
    """A bound, from the first solution of this program, that a simulation confirms; no other source gives a number."""
    rest = {"v": 0.0, "one_rate": 0.0, "two_rate": 0.0}
    hanging, upright = (dict.fromkeys(("one", "two"), sign * math.pi / 2) for sign in (-1.0, 1.0))
    problem = Problem(
        TwoLinks(), (0.5, 20.0), controls={"force": (-50.0, 50.0)}, final_cost=time, within={"x": (-5.0, 5.0)},
        start={"x": 0.0, **hanging, **rest}, end={**upright, **rest, "force": 0.0},
    )  # fmt: skip
    plan = solve(problem, {"duration": 3.0})
    assert plan.ok
    assert plan.duration < 2.8910
    assert plan.deviation(plan.replay(feedback=True)) < 1e-2
