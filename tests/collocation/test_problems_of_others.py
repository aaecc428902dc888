"""Problems of opty's gallery and of Moco. The references are formulas, costs from the gallery, or simulations."""

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


class Car(jk.System):
    """A car as a bicycle model: a body of 1200 kg, and a front wheel of 200 kg that a torque steers."""

    coordinates, speeds, dependent_speeds = (
        ("x", "y", "yaw", "steer"),
        ("forward", "steer_rate"),
        ("sideways", "yaw_rate"),
    )
    inputs, units = ("force", "torque"), {"yaw": "rad", "steer": "rad"}

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        A = N.rotate(3, q["yaw"], u["yaw_rate"])
        B = A.rotate(3, q["steer"], u["steer_rate"])
        center = jk.Point.at(u["forward"] * A.x + u["sideways"] * A.y, q["x"] * N.x + q["y"] * N.y)
        front, rear = center.fixed(1.5 * A.x), center.fixed(-1.5 * A.x)
        body = jk.Body(1200.0, (0.0, 0.0, 1300.0), center, A, name="body")
        wheel = jk.Body(200.0, (0.0, 0.0, 1300.0 / 32.0), front, B, name="wheel")
        slips = [rear.velocity.dot(A.y), front.velocity.dot(B.y)]
        return jk.Motion([body, wheel], slips, points={"rear": rear}, frames={"A": A})

    def q_dot(self, t, q, u):
        c, s = jnp.cos(q["yaw"]), jnp.sin(q["yaw"])
        v, w = u["forward"], u["sideways"]
        return c * v - s * w, s * v + c * w, u["yaw_rate"], u["steer_rate"]

    def loads(self, t, q, u, motion, inputs):
        torque = inputs["torque"] * motion.N.z
        steering = jk.Torque(torque, motion["wheel"]), jk.Torque(-torque, motion["body"])
        return jk.Force(inputs["force"] * motion["A"].x, motion["rear"]), *steering


@pytest.mark.slow
def test_a_car_is_parked_with_the_least_effort():
    """A simulation of the plan arrives 2 m to the side. The linearized car at rest cannot, so the guess steers."""
    still = {"yaw": 0.0, "steer": 0.0, "forward": 0.0, "steer_rate": 0.0}
    problem = Problem(
        Car(), 30.0, controls={"force": (-300.0, 300.0), "torque": (-50.0, 50.0)},
        cost=lambda t, now: now["force"] ** 2 + now["torque"] ** 2, within={"steer": (-math.pi / 4, math.pi / 4)},
        start={"x": 0.0, "y": 0.0, **still}, end={"x": 0.0, "y": 2.0, **still},
    )  # fmt: skip
    plan = solve(problem, {"x": [0.0, 3.0, 0.0], "steer": [0.0, 0.5, -0.5, 0.5, 0.0]})
    assert plan.ok
    assert plan.cost == pytest.approx(320236.0, rel=1e-4)
    assert plan.deviation(plan.replay()) < 1e-3


class Steamboat(jk.System):
    """A boat of 10 kg with two wheels of 1 kg. Drag acts on the boat and on the lowest points of the wheels."""

    coordinates, speeds = ("yaw", "x", "y", "left", "right"), ("yaw_rate", "vx", "vy", "left_rate", "right_rate")
    inputs, units = ("left_torque", "right_torque"), dict.fromkeys(("yaw", "left", "right"), "rad")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["yaw"], u["yaw_rate"])
        center = O.moving(q["x"] * N.x + q["y"] * N.y, u["vx"] * N.x + u["vy"] * N.y)
        bodies, points = [jk.Body(10.0, (0.0, 0.0, 10.0 * 26.0 / 12.0), center, A, name="boat")], {}
        for side, place in (("left", -1.1), ("right", 1.1)):
            wheel, hub = A.rotate(1, q[side], u[f"{side}_rate"]), center.fixed(place * A.x, A)
            bodies.append(jk.Body(1.0, (0.5, 0.25, 0.25), hub, wheel, name=side))
            points[f"{side} blade"] = hub.fixed(-1.0 * A.z, wheel)
        return jk.Motion(bodies, points=points, frames={"A": A})

    def loads(self, t, q, u, motion, inputs):
        A, boat, r = motion["A"], motion["boat"], u["yaw_rate"]
        v = boat.center.velocity
        loads = [jk.Force(drag(3.75, v.dot(A.x)) * A.x + drag(0.75, v.dot(A.y)) * A.y, boat)]
        loads.append(jk.Torque((drag(0.75 * 626.0 / 32.0, r)) * A.z + 3.75 * r * A.x, boat))
        for side in ("left", "right"):
            blade, torque = motion[f"{side} blade"], inputs[f"{side}_torque"] * A.x
            loads += [jk.Force(drag(0.75, blade.velocity.dot(A.y)) * A.y, blade), jk.Torque(torque, motion[side])]
        return loads


def drag(c, v):
    return -c * v**2 * jnp.tanh(20.0 * v)


@pytest.mark.weekly
def test_a_steamboat_moves_to_the_side():
    """No other source gives a number. A simulation of the plan arrives."""
    rest = dict.fromkeys(("yaw_rate", "vx", "vy"), 0.0)
    still = {"left": 0.0, "right": 0.0, "left_rate": 0.0, "right_rate": 0.0}
    problem = Problem(
        Steamboat(), (1.0, 30.0), controls=dict.fromkeys(Steamboat.inputs, (-25.0, 25.0)),
        cost=lambda t, now: now["left_torque"] ** 2 + now["right_torque"] ** 2, final_cost=lambda t, now: 4e4 * t,
        start={"yaw": -math.pi / 2, "x": 0.0, "y": 0.0, **rest, **still},
        end={"yaw": -math.pi / 2, "x": 10.0, "y": 10.0, **rest},
    )  # fmt: skip
    guess = {"yaw": [-1.57, -0.3, -1.57], "vx": 1.0, "vy": 1.0, "left_rate": -5.0, "right_rate": -5.0}
    plan = solve(problem, guess)
    assert plan.ok
    assert plan.cost == pytest.approx(268776.6, rel=1e-4)
    assert plan.deviation(plan.replay()) < 1e-3


class Swing(jk.System):
    """A pendulum with an unknown squared frequency p (Vyasarayani et al., Multibody System Dynamics 26, 2011)."""

    p: jk.Scalar = jk.parameter(1.0, positive=True)
    states = ("angle", "rate")

    def state_rates(self, t, q, u, x, motion, now):
        return {"angle": x["rate"], "rate": -self.p * jnp.sin(x["angle"])}


def test_the_frequency_of_a_pendulum_from_noisy_data_over_many_periods():
    """From a tenth of its value, where shooting finds a local minimum. SciPy from the true value is the reference."""
    t, rng = np.linspace(0.0, 50.0, 501), np.random.default_rng(0)

    def simulated(p, angle, rate):
        f = lambda t, y: [y[1], -p * np.sin(y[0])]  # noqa: E731
        return scipy.integrate.solve_ivp(f, (0.0, 50.0), [angle, rate], "DOP853", t, rtol=1e-9, atol=1e-9).y

    sigma = np.array([[0.05], [0.1]])
    y = simulated(10.0, math.pi / 6, 0.0) + sigma * rng.normal(size=(2, 501))
    trial = jk.fit.Trial(t, dict(zip(Swing.states, y)), sigma={"angle": 0.05, "rate": 0.1})
    found = jk.fit.fit(Swing(), [trial], ["p"], unknown=Swing.states, transcription=jk.fit.Collocation())
    best = scipy.optimize.least_squares(lambda v: ((simulated(*v) - y) / sigma).ravel(), [10.0, math.pi / 6, 0.0])
    assert found.ok
    assert abs(found.estimates["p"] - best.x[0]) < 0.5 * found.standard_errors["p"]
    assert found.estimates["p"] == pytest.approx(10.0, abs=0.01)


class Drone(jk.System):
    """A box of 2 kg with four thrusts along its z axis, Euler parameters, and linear drag."""

    coordinates, speeds = ("x", "y", "z", "e1", "e2", "e3", "e4"), ("vx", "vy", "vz", "wx", "wy", "wz")
    inputs = ("F1", "F2", "F3", "F4")

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        A = N.rotate_euler(q[3:7], u[3:6])
        center = jk.Point.at(A.vector(*u[:3]), N.vector(*q[:3]))
        corners = zip(self.inputs, ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)))
        points = {name: center.fixed(0.5 * x * A.x + 0.25 * y * A.y) for name, (x, y) in corners}
        inertia = (2.0 * 0.26 / 12.0, 2.0 * 1.01 / 12.0, 2.0 * 1.25 / 12.0)
        return jk.Motion([jk.Body(2.0, inertia, center, A, name="box")], points=points, frames={"A": A})

    def q_dot(self, t, q, u):
        N, _ = jk.inertial()
        v = N.rotate_euler(q[3:7], u[3:6]).vector(*u[:3])
        return *v.components_in(N), *jk.rotations.euler_parameter_rates(q[3:7], u[3:6])

    def configuration_constraints(self, t, q):
        return [jk.rotations.euler_parameter_norm(q[3:7])]

    def loads(self, t, q, u, motion, inputs):
        A, box = motion["A"], motion["box"]
        thrusts = [jk.Force(inputs[name] * A.z, motion[name]) for name in self.inputs]
        return jk.weight(motion, -9.81 * motion.N.z), jk.Force(-0.06 * A.vector(*u[:3]), box), *thrusts


@pytest.mark.weekly
def test_a_drone_passes_through_a_prescribed_attitude():
    """The sum of thrusts must on average be the weight, so the cost is at least 10 s (2 kg 9.81 m/s^2)^2 / 4."""
    thrusts = dict.fromkeys(Drone.inputs, (-100.0, 100.0))
    level, rest = dict.fromkeys(("e1", "e2", "e3"), 0.0), dict.fromkeys(Drone.speeds, 0.0)
    given = {"controls": thrusts, "cost": lambda t, now: sum(now[name] ** 2 for name in Drone.inputs)}
    start = {"x": 0.0, "y": 0.0, "z": 0.0, **level, "e4": 1.0, **rest}
    first = Problem(Drone(), 5.0, start=start, end=level | {"e1": math.sqrt(0.5)}, **given)
    second = Problem(Drone(), 5.0, end={"x": 10.0, "y": 10.0, "z": 10.0, **level, **rest}, **given)
    plan = solve(jk.collocation.Phases([first, second], links=[None]))
    assert plan.ok
    assert 10.0 * (2.0 * 9.81) ** 2 / 4.0 < plan.cost < 1018.0
    norms = [np.sum(np.square([part[name] for name in ("e1", "e2", "e3", "e4")]), axis=0) for part in plan.phases]
    assert np.max(np.abs(np.concatenate(norms) - 1.0)) < 1e-4


F0, L0, TENDON, FASTEST = 30.0, 0.10, 0.05, 10.0  # [N], [m], [m], [1/s]
D1, D2, D3, D4 = -0.3211346127989808, -8.149, -0.374, 0.8825327733249912  # De Groote et al. (2016), as in Moco


class Muscle(jk.System):
    """A mass on a Hill muscle with activation, fibre and elastic tendon. The rate of the fibre is an input: an
    algebraic variable."""

    coordinates, speeds, states = ("x",), ("v",), ("activation", "fibre")
    inputs, units = ("excitation", "lengthening"), {"x": "m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(0.5, 0.0, O.moving(-q["x"] * N.y, -u["v"] * N.y), N, name="mass")])

    def loads(self, t, q, u, motion, inputs):
        force = F0 * tendon_force(q["x"], inputs["fibre"])
        return jk.weight(motion, -9.81 * motion.N.y), jk.Force(force * motion.N.y, motion["mass"])

    def state_rates(self, t, q, u, x, motion, now):
        more = now["excitation"] - x["activation"]
        rises = 0.5 + 0.5 * jnp.tanh(10.0 * more)
        return {"activation": more * (rises / 0.015 + (1.0 - rises) / 0.06), "fibre": FASTEST * now["lengthening"]}


def tendon_force(x, fibre):
    return 0.2 * jnp.exp(35.0 * ((x - L0 * fibre) / TENDON - 0.995)) - 0.25


def balance(t, now):
    length, z = now["fibre"], D2 * now["lengthening"] + D3
    active = now["activation"] * jnp.exp(-(((length - 1.0) / 0.45) ** 2)) * (D1 * jnp.arcsinh(z) + D4)
    passive = (jnp.exp(4.0 * (length - 1.0) / 0.6) - 1.0) / (math.exp(4.0) - 1.0)
    return {"tendon": (active + passive - tendon_force(now["x"], length), 0.0, 0.0)}


def lifting(duration, **arguments):
    """A mass is lifted by 1 cm."""
    return Problem(
        Muscle(), duration, controls={"excitation": (0.01, 1.0), "lengthening": (-1.0, 1.0)}, path=balance,
        within={"x": (0.14, 0.16), "v": (-1.0, 1.0), "activation": (0.01, 1.0), "fibre": (0.2, 1.8)},
        start={"x": 0.15, "v": 0.0, "activation": 0.01}, end={"x": 0.14, "v": 0.0}, **arguments,
    )  # fmt: skip


@pytest.mark.slow
def test_a_hill_muscle_lifts_a_mass_in_the_shortest_time():
    """With 20 intervals, two meshes alternated while neighbouring intervals were merged each time."""
    for intervals in (20, 50):
        plan = solve(lifting((0.05, 1.0), final_cost=time), intervals=intervals)
        assert plan.ok
        assert plan.duration == pytest.approx(0.096132, abs=6e-6)  # the figure with a tolerance of 1e-7


@pytest.mark.weekly
def test_a_control_that_oscillates_from_node_to_node_is_named():
    """The activation rises faster than it falls, so rapid changes of the excitation are of advantage."""
    plan = solve(lifting(0.5, cost=lambda t, now: now["activation"] ** 2))
    assert not plan.ok
    assert "excitation oscillates from node to node" in plan.reason
