"""Systems that tests of several rooms use."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.catalog import CATALOG


class RodOnPin(jk.System):
    """A point on a rod in x and y, N.x down: x follows from y. SymPy's test_linearize_pendulum_kane_nonminimal."""

    length: Scalar = parameter(positive=True)  # [m]
    damping: Scalar = parameter(0.0)  # [N s/m]

    coordinates = ("y", "x")
    speeds = ("v",)
    dependent_speeds = ("x_dot",)
    dependent_coordinates = ("x",)
    inputs = ("push",)

    def configuration_constraints(self, t, q):
        return (q["x"] ** 2 + q["y"] ** 2 - self.length**2,)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["x_dot"], u["v"], 0.0))
        return jk.Motion([jk.Body(2.0, 0.0, P, N, name="point")])

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        return jk.weight(motion, 9.8 * N.x), jk.Force((inputs["push"] - self.damping * u["v"]) * N.y, motion["point"])


class OnACircle(jk.System):
    """A point on a circle of 1 m, N.y up: y follows from x."""

    coordinates, speeds = ("x", "y"), ("x_dot",)
    dependent_speeds, dependent_coordinates = ("y_dot",), ("y",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        return jk.Motion([jk.Body(1.0, 0.0, P)], points={"P": P})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def configuration_constraints(self, t, q):
        return [q["x"] ** 2 + q["y"] ** 2 - 1.0]


class Crank(jk.System):
    """A crank and the slider that it drives, whose place `x` is in units of `unit` metres."""

    radius: Scalar = parameter(1.0)  # [m]
    unit: Scalar = parameter(1.0)  # [m]
    coordinates, speeds = ("angle", "x"), ("rate",)

    def place(self, q):
        return q["x"] * self.unit / self.radius

    def q_dot(self, t, q, u):
        s, c = jnp.sin(q["angle"]), jnp.cos(q["angle"])
        return u["rate"], -(s + s * c / (self.place(q) - c)) * u["rate"] * self.radius / self.unit

    def configuration_constraints(self, t, q):
        s, c = jnp.sin(q["angle"]), jnp.cos(q["angle"])
        return [((self.place(q) - c) ** 2 + s**2 - 9.0) * (self.radius / self.unit) ** 2]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(1.0, 0.0, O.fixed(self.radius * B.x, B), N, name="pin")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * self.radius * motion.N.y)

    def outputs(self, t, q, u, motion, now):
        return {"ratio": self.place(q)}


class CrankAlone(Crank):
    """By its angle alone."""

    coordinates = ("angle",)

    def place(self, q):
        return jnp.cos(q["angle"]) + jnp.sqrt(9.0 - jnp.sin(q["angle"]) ** 2)

    def q_dot(self, t, q, u):
        return (u["rate"],)

    def configuration_constraints(self, t, q):
        return ()


class Slider(jk.System):
    """A rod hinged to a slider: right; the wrong ones differ from it in a line."""

    mass: jk.Scalar = jk.parameter(1.0)
    inertia: jk.Scalar = jk.parameter(0.1)
    coordinates = ("x", "angle")
    speeds = ("x_dot", "angle_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["x"] * N.x, self.rate(u) * N.x)
        B = N.rotate(3, q["angle"], u["angle_dot"], "B")
        return jk.Motion([jk.Body(self.mass, (self.inertia,) * 3, P.fixed(0.5 * B.x), B, name="rod")])

    def rate(self, u):
        return u["x_dot"]


class Bead(jk.System):
    """On a circle of 1 m, without weight: x = sin(w t). Its vertical speed depends on the horizontal one, for
    a quarter of a turn; there it no longer does. An event ends it before."""

    level: jk.Scalar = jk.parameter(0.3)
    ends: bool = eqx.field(static=True, default=True)
    coordinates, speeds, dependent_speeds, inputs = ("x", "y"), ("vx",), ("vy",), ("push",)
    dependent_coordinates = ("y",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        place, velocity = q["x"] * N.x + q["y"] * N.y, u["vx"] * N.x + u["vy"] * N.y
        body = jk.Body(1.0, 0.0, O.moving(place, velocity), N)
        return jk.Motion([body], [q["x"] * u["vx"] + q["y"] * u["vy"]])

    def configuration_constraints(self, t, q):
        return [q["x"] ** 2 + q["y"] ** 2 - 1.0]

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["push"] * motion.N.x, motion.bodies[0])

    def events(self, t, q, u):
        return {"low": jk.falling(q["y"] - self.level)} if self.ends else {}


class RollingDisc(jk.System):
    """test_kane.test_rolling_disc: a thin disc from its contact point up; speeds in the lean frame L, N.z up."""

    m: Scalar = parameter(positive=True)  # [kg]
    r: Scalar = parameter(positive=True)  # [m]
    g: Scalar = parameter()  # [m/s^2]

    coordinates = ("q1", "q2", "q3")  # yaw, lean, spin
    speeds = ("u1", "u2", "u3")

    def q_dot(self, t, q, u):
        return u["u3"] / jnp.cos(q["q2"]), u["u1"], u["u2"] - u["u3"] * jnp.tan(q["q2"])

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        yaw_rate, lean_rate, spin_rate = self.q_dot(t, q, u)
        L = N.rotate(3, q["q1"], yaw_rate).rotate(1, q["q2"], lean_rate)
        R = L.rotate(2, q["q3"], spin_rate)
        C = jk.Point.at(0.0 * N.x)  # the disc's point in contact; where it is, nothing depends on
        G = C.fixed(self.r * L.z, R)
        I = self.m * self.r**2 / 4
        return jk.Motion([jk.Body(self.m, (I, 2.0 * I, I), G, R, name="disc")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.g * motion.N.z)


class Part(eqx.Module):
    mass: jax.Array = jk.parameter(0.4, positive=True, unit="kg")


class Odd(jk.System):
    """Names that are words of C and of Python, Greek ones, one that stands for two things, one that ends a comment;
    parameters with axes and in parts; a whole number; branches of which one has no value; an auxiliary speed."""

    register: jk.Scalar = jk.parameter(2.0, positive=True, unit="kg */")
    angle: jk.Scalar = jk.parameter(0.3)
    θ0: jk.Scalar = jk.parameter(-0.2)
    moments: jax.Array = jk.parameter([0.1, 0.2, 0.3], positive=True)
    part: Part = Part()
    links: int = eqx.field(static=True, default=2)
    coordinates = ("angle", "x0")
    speeds = ("double", "lambda")
    auxiliary_speeds = ("while",)
    inputs = ("for", "I")
    units = {"angle": "rad", "x0": "m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle"], u["double"])
        P = O.moving(q["x0"] * A.x, u["lambda"] * A.x + u["while"] * A.z)
        return jk.Motion([jk.Body(self.register, tuple(self.moments), P, A), jk.Body(self.part.mass, 0.0, P)])

    def loads(self, t, q, u, motion, inputs):
        body, x = motion.bodies[0], q["x0"]
        reach = jnp.where(x > self.θ0, jnp.sqrt(x - self.θ0), 0.0) * self.links
        clipped = jnp.maximum(u["lambda"], -0.5) + jnp.minimum(x, 0.25) + jnp.clip(self.angle, 0.1, 0.2)
        ripple = jax.lax.rem(7.0 * x, jnp.asarray(0.3, x.dtype)) + jnp.sign(x) * jnp.abs(x) ** 1.5
        push = reach + clipped * ripple + jax.nn.softplus(u["double"]) + inputs["I"] * jnp.cos(3.0 * t)
        return [jk.Force(push * body.frame.x, body), jk.Torque(inputs["for"] * body.frame.z, body)]


class Bob(jk.System):
    """A pendulum in Cartesian coordinates: one dependent coordinate, one dependent speed, no input."""

    length: jk.Scalar = jk.parameter(1.0, positive=True, unit="m")
    coordinates = ("x", "y")
    dependent_coordinates = ("y",)
    speeds = ("vx",)
    dependent_speeds = ("vy",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(2.0, 0.0, O.moving(N.vector(*q, 0.0), N.vector(*u, 0.0)))])

    def configuration_constraints(self, t, q):
        return [q["x"] ** 2 + q["y"] ** 2 - self.length**2]

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)


def case(name):
    """A system with a time, coordinates, speeds and inputs."""
    if name in CATALOG:
        entry = CATALOG[name]
        system, q, u = entry.example(), entry.q, entry.u
    elif name == "Odd":
        system, q, u = Odd(), (0.4, 0.35), (0.6, -0.7)
    else:
        system, q, u = Bob(), (0.6, -0.8), (0.5,)
    return system, 0.7, np.array(q), np.array(u), np.linspace(-0.4, 0.9, len(system.inputs))


class BouncingBall(jk.catalog.BouncingBall):
    """The ball of the catalogue with a contact instead of an event."""

    def events(self, t, q, u):
        return {}

    def contacts(self, t, q, u, motion):
        return {"floor": jk.Contact(gap=q["height"], restitution=self.restitution)}


class SliderCrank(jk.System):
    """A crank, a rod and a slider on y = 0, closed by configuration constraints."""

    coordinates, speeds = ("crank", "rod", "x"), ("crank_rate",)
    dependent_coordinates, dependent_speeds = ("rod", "x"), ("rod_rate", "x_dot")

    def configuration_constraints(self, t, q):
        y = 0.15 * jnp.sin(q["crank"]) + 0.4 * jnp.sin(q["rod"])
        return 0.15 * jnp.cos(q["crank"]) + 0.4 * jnp.cos(q["rod"]) - q["x"], y

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["crank"], u["crank_rate"], "A")
        B = N.rotate(3, q["rod"], u["rod_rate"], "B")
        pin = O.fixed(0.15 * A.x)
        slider = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
        crank = jk.Body(0.6, (0.0, 0.0, 0.6 * 0.15**2 / 12), O.fixed(0.075 * A.x), A, name="crank")
        rod = jk.Body(0.9, (0.0, 0.0, 0.9 * 0.4**2 / 12), pin.fixed(0.2 * B.x), B, name="rod")
        return jk.Motion([crank, rod, jk.Body(0.5, 0.0, slider, name="slider")], points={"pin": pin})


class Sled(jk.System):
    """A point that a force moves along N.x, with a spring and drag; without units."""

    mass: Scalar = parameter(1.0, positive=True)
    drag: Scalar = parameter(0.0)
    stiffness: Scalar = parameter(0.0)
    coordinates, speeds, inputs = ("x",), ("v",), ("force",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), N, name="sled")])

    def loads(self, t, q, u, motion, inputs):
        force = inputs["force"] - self.drag * u["v"] - self.stiffness * q["x"]
        return jk.Force(force * motion.N.x, motion["sled"])


def moved(system, ts, q, u, u_dep=None):
    """A trajectory of given coordinates and speeds, without solving anything."""
    n = len(ts)
    dep = np.zeros((n, len(system.dependent_speeds))) if u_dep is None else u_dep
    x = np.zeros((n, len(system.states)))
    inputs = {name: jnp.zeros(n) for name in system.inputs}
    stats = {name: jnp.asarray(n) for name in ("steps", "accepted", "rejected")}
    return jk.Trajectory(
        **{name: jnp.asarray(array) for name, array in dict(t=ts, q=q, u=u, u_dep=dep, x=x).items()},
        inputs=inputs,
        outputs={},
        status=jnp.asarray(0),
        t_end=jnp.asarray(ts[-1]),
        stats=stats,
        names=(system.coordinates, system.speeds, system.dependent_speeds, system.states),
        events=(),
        adjoint="none",
    )


def declared(system):
    """The declarations of a system's parameters by name, with `positive`, `shape`, `unit` and `within`."""
    return {f.name: f.metadata["jaxkane"] for f in dataclasses.fields(system) if "jaxkane" in f.metadata}


class Pendulum(jk.System):
    """A bob at 1 m from a pin, N.y up, with a torque about the pin."""

    mass: Scalar = parameter(2.0)  # [kg]
    coordinates, speeds, inputs = ("angle",), ("rate",), ("torque",)
    units = {"angle": "rad", "rate": "rad/s", "torque": "N m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        L = N.rotate(3, q["angle"], u["rate"], "L")
        return jk.Motion([jk.Body(self.mass, 0.0, O.fixed(-1.0 * L.y), name="bob")], frames={"L": L})

    def loads(self, t, q, u, motion, inputs):
        return (*jk.weight(motion, -9.81 * motion.N.y), jk.Torque(inputs["torque"] * motion.N.z, motion["L"]))
